"""Report what is wrong with a file or with arguments: place, reason, what to try."""

import difflib
import re
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple, TypeVar, get_args, get_origin

from pydantic import TypeAdapter, ValidationError
from pydantic.dataclasses import is_pydantic_dataclass
from pydantic.fields import FieldInfo
from pydantic_core import ErrorDetails

from dlo_casadi.errors import ConfigError
from dlo_casadi.rod.supports import SupportKind

Section = TypeVar("Section")
Place = tuple[str | int, ...]
"""Keys and indices that lead from the top of a file to a value."""

PLACEHOLDER = "FILL_IN"
"""What stands in a new configuration where only its user knows the value."""


class ConfigProblem(NamedTuple):
    """A problem and its place in the file."""

    place: Place
    message: str


class Contradiction(ValueError):  # noqa: N818  (a ValueError is what pydantic collects)
    """A contradiction inside one section: problems by the key they belong to."""

    def __init__(self, *problems: ConfigProblem) -> None:
        super().__init__("; ".join(problem.message for problem in problems))
        self.problems = problems


def show(value: object) -> str:
    """Show a value as it is written in the file."""
    if value is None:
        return "nothing"
    text = repr(value) if not isinstance(value, bool) else str(value).lower()
    return text if len(text) <= 60 else text[:57] + "..."


def kind_of(value: object) -> str:
    """Describe a value: a mapping, a list, text, nothing, or the value itself."""
    kinds: dict[type, str] = {dict: "a mapping", list: "a list", str: "text"}
    return kinds.get(type(value), show(value))


def did_you_mean(word: str, known: Iterable[str]) -> str:
    """Name the nearest known word if one is similar, otherwise all of them."""
    words = sorted(set(known))
    if near := difflib.get_close_matches(word, words, 1, cutoff=0.6):
        return f"; did you mean {near[0]!r}?"
    return f"; known here: {', '.join(words)}" if words else ""


# ---- what pydantic finds ---------------------------------------------------------------------


def keys_of(section: type) -> dict[str, FieldInfo]:
    """The keys of a section, with what pydantic knows of each."""
    return section.__pydantic_fields__  # type: ignore[attr-defined]


def _is_mapping(field: FieldInfo) -> bool:
    """Whether a key has a mapping of names that no section knows."""
    return get_origin(field.annotation) is dict


# Maps the path of keys in a file, with the kinds chosen in it, to the class of the section there
# and its name in messages.
_Sections = dict[Place, tuple[type, str]]


def _sections(model: type, at: Place = (), name: str = "") -> _Sections:
    found = {at: (model, name)}
    for key, field in keys_of(model).items():
        for inner in _models(field.annotation):
            kind = keys_of(inner).get("kind")
            kinds = () if kind is None else get_args(kind.annotation)
            # The key alone selects a class that covers several kinds.
            kinds = kinds if len(kinds) == 1 else ()
            named = f"{name}.{key}".lstrip(".") + "".join(f" (kind: {kind})" for kind in kinds)
            found |= _sections(inner, (*at, key, *kinds), named)
    return found


def _models(annotation: Any) -> list[type]:
    """The sections that an annotation names."""
    if isinstance(annotation, type) and is_pydantic_dataclass(annotation):
        return [annotation]
    return [model for part in get_args(annotation) for model in _models(part)]


def _section_at(place: Place, sections: _Sections) -> type:
    """The section at a place; parts that are no keys of a section, such as indices, are skipped."""

    def leads(at: Place) -> bool:
        left = iter(place)
        return all(part in left for part in at)

    return sections[max(filter(leads, sections), key=len)][0]


class Source:
    """Data to check, and how to describe a place in them."""

    data: Any
    source: Path | None
    """The file, if they are of one."""
    hidden: tuple[str, ...] = ()
    """Keys that are left out of the name of a place."""
    names: tuple[str, ...] = ()
    """What may stand at the top, where it is not the keys of the checked section."""
    top = "the top of the file"

    @property
    def folder(self) -> Path:
        """Where the files are that it names."""
        return Path() if self.source is None else self.source.absolute().parent

    def checked(self, model: type[Section], heading: str = "", remedy: str = "") -> Section:
        """Check the data against a model; raises one ConfigError with all problems, see `error`."""
        try:
            checker = TypeAdapter(model)
            return checker.validate_python(self.data, context={"folder": self.folder})
        except ValidationError as error:
            raise self.error(explain(model, error.errors(), self), heading, remedy) from None

    def error(
        self, problems: Iterable[ConfigProblem], heading: str = "", remedy: str = ""
    ) -> ConfigError:
        """Combine all problems into one error, in the order of their lines, below a heading."""
        most = 12
        lines = sorted({(self.line(problem.place), problem.message) for problem in problems})
        if len(lines) == 1:
            line, message = lines[0]
            said = ": ".join(filter(None, (heading, message)))
            return ConfigError(said + remedy, self.source, line or None)
        listed = [f"  {f'line {line}: ' if line else ''}{said}" for line, said in lines[:most]]
        if len(lines) > most:
            listed.append(f"  ... and {len(lines) - most} more")
        heading = heading or f"{len(lines)} problems"
        return ConfigError("\n".join([heading, *listed]) + remedy, self.source)

    def line(self, place: Place) -> int:
        """Line of a place in a file; 0 where there is none."""
        return 0

    def inside(self, key: str, section: str) -> str:
        """Say that a key belongs in a section; empty if there is no section."""
        return section

    def instead(self, section: str) -> str:
        """Advice on what may stand for a section, by the name of its class; empty without any."""
        return ""

    def label(self, place: Place) -> str:
        """Name a place in words: cable.length, pose 4 (pose_04.jpg).end."""
        data, words = self.data, []
        for part in place:
            if isinstance(data, dict) and part in data:
                data = data[part]
                words.append(str(part))
            elif isinstance(data, list | tuple) and isinstance(part, int) and part < len(data):
                data = data[part]
                if words == ["experiment", "poses"]:
                    file = data.get("file", data.get("files")) if isinstance(data, dict) else None
                    said = ", ".join(map(str, file)) if isinstance(file, list) else file
                    words = [f"pose {part + 1}" + (f" ({said})" if isinstance(said, str) else "")]
                else:
                    words[-1] += f"[{part}]"
        return ".".join(word for word in words if word not in self.hidden) or self.top


# Classes of sections that a caller in Python makes.
_OBJECTS = ("Cable", "Clip", "Obstacle", "Pose")


class Arguments(Source):
    """Arguments of a call: places are named by their arguments only."""

    hidden = ("experiment", "measurement")
    top = "the arguments"

    def __init__(self, data: dict[str, Any], names: tuple[str, ...] = ()) -> None:
        self.data, self.source, self.names = data, None, names

    def instead(self, section: str) -> str:
        """Advice to pass an object of the library, if there is one for the section."""
        return f". Try: dlo.{section}(...)" if section in _OBJECTS else ""

    def inside(self, key: str, section: str) -> str:
        """Say that a key belongs in a mapping passed as an argument."""
        own = re.sub(r"^experiment\.(measurement [^.]*\.)?", "", section)
        known = not self.names or own.partition(".")[0] in self.names
        return f'{own}={{"{key}": ...}}' if known else ""


def _help(section: type, key: object) -> str:
    """Help on a key, if the section has any."""
    field = keys_of(section).get(str(key))
    description = " ".join((field.description or "").split()) if field else ""
    return f": {description.rstrip('.')}" if description else ""


def _about_number(value: object) -> str:
    """Guess why a number was written as text."""
    text = value.strip() if isinstance(value, str) else ""
    if re.fullmatch(_NUMBER, text):
        return "; write it without quotes"
    if re.fullmatch(r"[-+]?[0-9]+,[0-9]+", text):
        return f"; the decimal sign is a point: {text.replace(',', '.')}"
    if re.fullmatch(rf"{_NUMBER}\s*[a-zA-Z][a-zA-Z/^*0-9]*", text):
        return "; write the number alone, in SI units"
    return ""


def _allowed(section: type, key: object) -> str:
    """The range of a number with two limits."""
    field = TypeAdapter(section).json_schema()["properties"].get(str(key), {})
    ends: dict[str, float] = {}
    for part in (field, *field.get("anyOf", ())):
        ends |= {name: part[name] for name in ("minimum", "maximum") if name in part}
    return "; {minimum:g} to {maximum:g} is possible".format(**ends) if len(ends) == 2 else ""


_NUMBER = r"[-+]?(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:[eE][-+]?[0-9]+)?"

_MAPPING = "a mapping of keys and values belongs here, found {kind}{object}"
_NUMBER_TYPE = "a number belongs here, found {input}{number}"
_WHOLE = "a whole number belongs here, found {input}"
_MESSAGES: dict[str, str] = {
    **dict.fromkeys(("float_type", "float_parsing"), _NUMBER_TYPE),
    "finite_number": "a finite number belongs here, found {input}",
    **dict.fromkeys(("int_type", "int_parsing", "int_from_float"), _WHOLE),
    "bool_type": "true or false belongs here, found {input}",
    "string_type": "text belongs here, found {input}",
    "greater_than": "must be larger than {gt:g}, found {input}",
    "greater_than_equal": "must not be smaller than {ge:g}, found {input}{allowed}",
    "less_than": "must be smaller than {lt:g}, found {input}",
    "less_than_equal": "must not be larger than {le:g}, found {input}{allowed}",
    "literal_error": "allowed are {expected}, found {input}",
    **dict.fromkeys(("dataclass_type", "dict_type"), _MAPPING),
    "tuple_type": "a list belongs here, found {kind}",
    "too_short": "at least {min_length} belongs here, found {actual_length}",
    "too_long": "at most {max_length} belong here, found {actual_length}",
    "invalid_key": "a key must be text, found {input}",
}


def explain(model: type, errors: Sequence[ErrorDetails], source: Source) -> Iterator[ConfigProblem]:
    """Rewrite what pydantic found in the words of the source."""
    sections = _sections(model)
    suggested: set[Place] = set()
    for error in errors:
        if error["type"] == "unexpected_keyword_argument":
            *above, key = error["loc"]
            known = keys_of(_section_at(tuple(above), sections))
            near = difflib.get_close_matches(str(key), known, 1, cutoff=0.6)
            suggested.update((*above, name) for name in near)
    for error in errors:
        place, kind, found = error["loc"], error["type"], error["input"]
        context = error.get("ctx", {})
        section, label = _section_at(place[:-1], sections), source.label(place)
        key = place[-1] if place else ""
        if isinstance(found, str) and found == PLACEHOLDER:  # other types may not compare
            text = f"{label} is still to be filled in{_help(section, key)}"
        elif kind == "missing" and isinstance(key, int):
            text = f"{label} has only {key} of its values"
        elif kind == "missing":
            if place in suggested:
                continue
            text = f"{key!r} is missing in {label}{_help(section, key)}"
        elif kind == "unexpected_keyword_argument":
            at_top = len(place) == 1 and source.names
            names = source.names if at_top else tuple(keys_of(section))
            hint = did_you_mean(str(key), names)
            homes = [
                source.inside(str(key), name) if name else source.top
                for inner, name in sections.values()
                if str(key) in keys_of(inner)
            ]
            homes = [home for home in homes if home]
            # Names of the user's own, such as parameters of an effect, belong into a mapping.
            of_names = [name for name, field in keys_of(section).items() if _is_mapping(field)]
            homes = [f"{name}: {{{key}: ...}}" for name in of_names] or homes
            if homes and "did you mean" not in hint:
                hint = f"; it belongs into {' or '.join(homes)}"
            text = f"unknown key {show(str(key))} in {source.label(place[:-1])}{hint}"
        elif kind in ("union_tag_invalid", "union_tag_not_found"):
            place = (*place, "kind")
            text = f"{label}: kind must be images or centerlines, found {show(context.get('tag'))}"
        elif kind == "value_error":
            wrong = context["error"]
            for inner in getattr(wrong, "problems", (ConfigProblem((), str(wrong)),)):
                at = (*place, *inner.place)
                yield ConfigProblem(at, f"{source.label(at)}: {inner.message}")
            continue
        elif kind in _MESSAGES:
            words = {
                "input": show(found),
                "kind": kind_of(found),
                "number": _about_number(found),
                "allowed": _allowed(section, key),
                "object": source.instead(str(context.get("class_name"))),
            }
            text = f"{label}: {_MESSAGES[kind].format(**(context | words))}"
            if key == "start" and found == SupportKind.FREE:
                text += "; only the end can be free"
            if "tolerances" in place and found == 0:
                text += "; for a value that is known exactly write a small one, such as 1.0e-6"
        else:
            text = f"{label}: {error['msg']}"
        yield ConfigProblem(place, text)
