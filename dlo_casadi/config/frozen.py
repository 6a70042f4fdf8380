"""Frozen dataclasses that pydantic checks where they are made: from a file, or from Python."""

import copy
import inspect
import textwrap
from collections.abc import Collection, Mapping, Sequence
from typing import (
    TYPE_CHECKING,
    Any,
    ClassVar,
    Generic,
    Literal,
    Protocol,
    Self,
    SupportsFloat,
    TypeAlias,
    TypeVar,
    dataclass_transform,
)

from pydantic import BeforeValidator, ConfigDict, Field, ValidationError
from pydantic.dataclasses import dataclass as pydantic_dataclass
from pydantic.fields import FieldInfo
from pydantic_core import PydanticUndefined

from dlo_casadi.config.problems import Arguments, did_you_mean, explain, keys_of
from dlo_casadi.errors import ConfigError, DloError, counted


class _Array(Protocol):
    def __array__(self) -> Any: ...


class _Rotation(Protocol):
    def as_quat(self) -> Any: ...


# What a caller in Python may give, see `plain`: lists, arrays, tables, CasADi's DM; and for an
# orientation SciPy's Rotation.
Numbers: TypeAlias = Sequence[SupportsFloat] | _Array
Rows: TypeAlias = Sequence[Sequence[SupportsFloat]] | _Array
Turned: TypeAlias = Numbers | _Rotation

if TYPE_CHECKING:
    _Stored = TypeVar("_Stored", covariant=True)
    _Accepted = TypeVar("_Accepted", contravariant=True)

    class Given(Generic[_Stored, _Accepted]):
        """Type of a key that is stored in one form and accepted in others."""

        def __get__(self, section: object, kind: type | None = None) -> _Stored: ...
        def __set__(self, section: object, value: _Accepted) -> None: ...
else:

    class Given:
        """Type of a key that is stored in one form and accepted in others."""

        def __class_getitem__(cls, stored_accepted: tuple[Any, Any]) -> Any:
            return stored_accepted[0]


def entry(
    *, default: Any = PydanticUndefined, kw_only: bool = True, validate_default: bool = False
) -> Any:
    """A key that pydantic's `Field` describes; `kw_only=False`: its name may be left out."""
    return Field(default=default, kw_only=kw_only, validate_default=validate_default)


# Longest list that is shown in full when a section is printed.
_SHOWN = 6


def plain(value: Any) -> Any:
    """Convert arrays, tables, CasADi matrices and NumPy numbers to Python numbers as in a file."""
    if hasattr(value, "as_quat"):  # SciPy's Rotation: x, y, z, w
        value = value.as_quat()
    if hasattr(value, "full"):  # a CasADi matrix, of which vectors are columns
        value = value.full().ravel() if value.is_column() else value.full()
    if hasattr(value, "to_numpy"):  # a table of pandas
        value = value.to_numpy()
    if hasattr(value, "tolist"):
        return value.tolist()
    if isinstance(value, list | tuple):
        return [plain(item) for item in value]
    if isinstance(value, Mapping):
        return {key: plain(item) for key, item in value.items()}
    return value


class _Long(int):
    """A long list, printed as its number of items."""

    def __repr__(self) -> str:
        return f"<{counted(int(self), 'item')}>"


@dataclass_transform(kw_only_default=True, frozen_default=True, field_specifiers=(entry,))
class ConfigSection:
    """A frozen mapping of the file: unknown keys are errors, the docstring of a key is its help.

    Each subclass is a frozen dataclass that is checked where it is made: from a file, or from
    Python, where its keys are arguments and arrays are taken for lists.
    """

    _unknown: ClassVar[Literal["forbid", "ignore"]] = "forbid"
    if TYPE_CHECKING:
        __dataclass_fields__: ClassVar[dict[str, Any]]
    else:

        def __init__(self, *first: Any, **values: Any) -> None:
            unnamed = [key for key, field in keys_of(type(self)).items() if field.kw_only is False]
            if len(first) > len(unnamed):
                alone = " and ".join(unnamed)
                text = (
                    f"{alone} alone may stand without their names" if alone else "all need theirs"
                )
                count = f"{counted(len(first), 'argument')} without a name"
                raise ConfigError(f"{type(self).__name__}: {count}: {text}")
            named = dict(zip(unnamed, first, strict=False))
            if twice := named.keys() & values.keys():
                raise ConfigError(f"{type(self).__name__}: {min(twice)} is given twice")
            given = Arguments(plain(named | values))
            try:
                self.__pydantic_validator__.validate_python(given.data, self_instance=self)
            except ValidationError as error:
                raise given.error(explain(type(self), error.errors(), given)) from None

    def __init_subclass__(cls) -> None:
        """Make the class a dataclass that pydantic checks; put the help of its keys in `help`."""
        if not inspect.get_annotations(cls):
            return  # the keys are those of the class before it
        own = {"__init__": cls.__init__, "__setattr__": cls.__setattr__, "__repr__": cls.__repr__}
        help_text = inspect.cleandoc(cls.__doc__ or "")
        config = ConfigDict(
            extra=cls._unknown,
            use_attribute_docstrings=True,
            json_schema_extra={"description": help_text},
        )
        pydantic_dataclass(cls, frozen=True, kw_only=True, config=config)
        for name, method in own.items():
            setattr(cls, name, method)
        keys = keys_of(cls)
        cls.__signature__ = _signature(keys)  # type: ignore[attr-defined]
        if "Parameters\n" not in help_text:
            rows = [
                f"{key}\n{textwrap.indent(field.description or '', '    ')}"
                for key, field in keys.items()
            ]
            cls.__doc__ = "\n".join([help_text, "", "Parameters", "----------", *rows])

    def __setattr__(self, name: str, value: Any) -> None:
        kind = type(self).__name__
        raise DloError(f"{name} of a {kind} cannot be set.\n  Try: another {kind}, made with it")

    def changed(self, **values: Any) -> Self:
        """Copy with other values, unchecked; values of a nested section are given as a mapping.

        Raises DloError if there is no such key.
        """
        keys, copied = keys_of(type(self)), copy.copy(self)
        if strange := [name for name in values if name not in keys]:
            hint = did_you_mean(strange[0], keys)
            raise DloError(f"{type(self).__name__} has no {strange[0]!r}{hint}")
        for name, value in values.items():
            now = getattr(self, name)
            inner = isinstance(now, ConfigSection) and isinstance(value, dict)
            vars(copied)[name] = now.changed(**value) if inner else value
        return copied

    def without(self, keys: Collection[str]) -> Self:
        """Copy with the defaults of these keys, as if they were not given."""
        return self.changed(**{key: keys_of(type(self))[key].default for key in keys})

    @property
    def declared(self) -> dict[str, Any]:
        """What differs from the defaults, by its key."""
        fields = keys_of(type(self)).items()
        return {key: getattr(self, key) for key, x in fields if getattr(self, key) != x.default}

    @property
    def plain(self) -> dict[str, Any]:
        """`declared` as plain data, sections inside as well."""
        return {key: _plain_section(value) for key, value in self.declared.items()}

    def __repr__(self) -> str:
        """What differs from the defaults; long lists are shown by their length."""
        shown = [
            f"{key}={_Long(len(x)) if isinstance(x, tuple) and len(x) > _SHOWN else x!r}"
            for key, x in self.declared.items()
        ]
        return f"{type(self).__name__}({', '.join(shown)})"


def _signature(keys: Mapping[str, FieldInfo]) -> inspect.Signature:
    """Names and defaults; types are in the help, and for type checkers in the class."""
    unnamed, named = inspect.Parameter.POSITIONAL_OR_KEYWORD, inspect.Parameter.KEYWORD_ONLY
    parameters = [
        inspect.Parameter(
            name,
            unnamed if field.kw_only is False else named,
            default=inspect.Parameter.empty if field.is_required() else field.default,
        )
        for name, field in keys.items()
    ]
    return inspect.Signature(sorted(parameters, key=lambda one: one.kind))


def _plain_section(value: Any) -> Any:
    if isinstance(value, ConfigSection):
        return value.plain
    if isinstance(value, tuple):
        return [_plain_section(item) for item in value]
    if isinstance(value, dict):
        return {key: _plain_section(item) for key, item in value.items()}
    return value


class OpenSection(ConfigSection):
    """A section that may have other keys than those that are read."""

    _unknown = "ignore"


def optional(section: type[ConfigSection]) -> BeforeValidator:
    """Let a section be empty, such as `model:` without a value."""
    return BeforeValidator(
        lambda value: {} if value is None else value, json_schema_input_type=section | None
    )
