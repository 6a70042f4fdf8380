"""Convert YAML text <-> plain data. No other module imports yaml."""

import re
from codecs import BOM_UTF16_BE, BOM_UTF16_LE
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

import yaml

from dlo_casadi.config.problems import Place, Source, did_you_mean, show
from dlo_casadi.errors import ConfigError

# Largest file [bytes]: PyYAML reads it in five seconds. A session of a thousand poses has 80,000.
_LARGEST = 500_000
# Largest number of values after expanding aliases: as many as the largest file can hold.
_MOST_VALUES = _LARGEST // 2
# Maximum nesting of lists and mappings; a configuration has seven levels.
_DEEPEST = 30
# Refused characters: control characters other than tab and line breaks, which a terminal would
# obey; and lone surrogates, except those that stand for bytes of file names (PEP 383).
_NO_TEXT = re.compile("[\x00-\x08\x0b\x0c\x0e-\x1f\x7f\ud800-\udc7f\udd00-\udfff]")


def read_yaml(path: str | Path) -> Any:
    """Read a YAML file as plain dicts, lists, text and numbers.

    1e-3 is a number here, as in YAML 1.2; a key that occurs twice is an error.
    Raises ConfigError if the file cannot be read, is empty, or is not YAML.
    """
    return Document.read(Path(path)).data


def yaml_text(path: Path) -> str:
    """Text of a YAML file, in the encoding that `read_yaml` takes it in; raises OSError."""
    with path.open("rb") as file:
        wide = file.read(2) in (BOM_UTF16_LE, BOM_UTF16_BE)
    return path.read_text(encoding="utf-16" if wide else "utf-8-sig", errors="replace")


def dump_yaml(data: object) -> str:
    """Write plain data as YAML: all digits of floats, keys in their order, no aliases.

    Data: mappings, sequences, arrays, numbers, text, paths and None, in any nesting; `read_yaml`
    turns the text back into the same data.
    """
    return yaml.dump(
        _plain(data),
        Dumper=_Dumper,
        sort_keys=False,
        default_flow_style=None,
        allow_unicode=True,
        width=100,
    )


def _plain(data: object) -> object:
    """Convert arrays, tuples and subclasses of the basic types to types that YAML knows."""
    if hasattr(data, "tolist"):
        data = data.tolist()
    if data is None or isinstance(data, bool):
        return data
    if isinstance(data, Mapping):
        return {_plain(key): _plain(value) for key, value in data.items()}
    if isinstance(data, list | tuple):
        return [_plain(value) for value in data]
    for basic in (int, float, str):
        if isinstance(data, basic):
            return basic(data)
    if isinstance(data, Path):
        return str(data)
    raise TypeError(f"{type(data).__name__} cannot be written as YAML: {data!r}")


_FLOAT = re.compile(
    r"^(?:[-+]?(?:[0-9]+\.[0-9]*|\.[0-9]+|[0-9]+)(?:[eE][-+]?[0-9]+)?"
    r"|[-+]?\.(?:inf|Inf|INF)|\.(?:nan|NaN|NAN))$"
)
_INT = re.compile(r"^[-+]?[0-9]+$")
_REPLACED = ("int", "float", "timestamp")


_TAG = "tag:yaml.org,2002:"


class _Loader(yaml.SafeLoader):
    """SafeLoader with YAML 1.2 numbers: 1e-3 is one, 012 is 12; 1:30 and 2024-01-01 are text."""

    def construct_object(self, node: yaml.Node, deep: bool = False) -> Any:
        try:
            return super().construct_object(node, deep)
        except yaml.YAMLError:
            raise
        except (ArithmeticError, AttributeError, LookupError, TypeError, ValueError):
            kind = node.tag.rpartition(":")[2]
            raise yaml.constructor.ConstructorError(
                None,
                None,
                f"{show(node.value)} cannot be read as {kind}. Try: a number of usual size, or "
                f"the value without a tag such as !!{kind}",
                node.start_mark,
            ) from None


def _int(loader: yaml.SafeLoader, node: yaml.ScalarNode) -> int:
    return int(loader.construct_scalar(node))


def _float(loader: yaml.SafeLoader, node: yaml.ScalarNode) -> float:
    return float(re.sub(r"\.(?=inf|nan)", "", loader.construct_scalar(node).lower()))


_Loader.yaml_implicit_resolvers = {
    first: [item for item in known if item[0].removeprefix(_TAG) not in _REPLACED]
    for first, known in yaml.SafeLoader.yaml_implicit_resolvers.items()
}
_Loader.add_implicit_resolver(f"{_TAG}int", _INT, list("-+0123456789"))
_Loader.add_implicit_resolver(f"{_TAG}float", _FLOAT, list("-+.0123456789"))
_Loader.add_constructor(f"{_TAG}int", _int)
_Loader.add_constructor(f"{_TAG}float", _float)


class _Dumper(yaml.SafeDumper):
    """SafeDumper without aliases; it quotes text that any YAML version reads as a number."""

    def ignore_aliases(self, data: object) -> bool:
        return True


_Dumper.add_implicit_resolver(f"{_TAG}float", _FLOAT, list("-+.0123456789"))


@dataclass(frozen=True)
class Document(Source):
    """A YAML file: its data, and the node tree with the lines."""

    source: Path
    root: yaml.Node
    data: Any

    @classmethod
    def read(cls, source: Path, largest: int = _LARGEST) -> Self:
        """Read a file of at most `largest` bytes, or raise a ConfigError."""
        text = _read_bytes(source, largest)
        try:
            loader = _Loader(text)
            root = loader.get_single_node()
            if root is None:
                raise ConfigError("the file is empty", file=source)
            _inspect(root, source)
            return cls(source, root, loader.construct_document(root))
        except yaml.MarkedYAMLError as error:
            mark = error.problem_mark or error.context_mark
            hint = " (indent with spaces)" if "'\\t'" in str(error.problem) else ""
            raise ConfigError(
                f"not valid YAML: {error.problem}{hint}",
                file=source,
                line=None if mark is None else mark.line + 1,
            ) from None
        except RecursionError:
            raise ConfigError(_too_deep(), file=source) from None
        except (yaml.YAMLError, UnicodeDecodeError) as error:
            reason = str(error).splitlines()[0]
            raise ConfigError(f"not a YAML text file: {reason}", file=source) from None

    def line(self, place: Place) -> int:
        """Line of a place, or of the nearest enclosing one if the place is not in the file."""
        node = self.root
        line = int(node.start_mark.line) + 1
        for part in place:
            if isinstance(node, yaml.MappingNode):
                found = [(k, v) for k, v in node.value if getattr(k, "value", None) == str(part)]
                if not found:
                    continue
                key, node = found[-1]  # a merge (<<) puts the values that it overrides first
                line = key.start_mark.line + 1
            elif isinstance(node, yaml.SequenceNode) and isinstance(part, int):
                if part >= len(node.value):
                    break
                node = node.value[part]
                line = node.start_mark.line + 1
            else:
                break
        return line


def _read_bytes(source: Path, largest: int) -> bytes:
    """Contents of a file, unless it is too large."""
    try:
        with source.open("rb") as file:
            text = file.read(largest + 1)
    except FileNotFoundError:
        near = did_you_mean(source.name, [p.name for p in source.parent.glob("*.y*ml")])
        raise ConfigError(f"no such file{near}", file=source) from None
    except (OSError, ValueError) as error:  # a NUL in the name is a ValueError
        reason = getattr(error, "strerror", None) or error
        raise ConfigError(f"cannot be read: {reason}", file=source) from None
    if len(text) > largest:
        raise ConfigError(
            f"larger than {largest:d} bytes, which no configuration or fitted cable is. Try: is it "
            "the right file?",
            file=source,
        )
    return text


def _too_deep() -> str:
    return f"lists and mappings more than {_DEEPEST} levels deep. Try: brackets and braces closed?"


def _inspect(root: yaml.Node, source: Path) -> None:
    """Refuse valid YAML that is not plain data; nodes are visited once, aliases counted in full."""
    measured: dict[int, tuple[int, int]] = {}
    above: set[int] = set()

    def refuse(message: str, node: yaml.Node) -> ConfigError:
        return ConfigError(message, file=source, line=node.start_mark.line + 1)

    def inspect(node: yaml.Node) -> tuple[int, int]:
        """Number of values and levels of a node with its aliases expanded."""
        if id(node) in above:
            raise refuse("an anchor (&) around its own alias (*): it contains itself", node)
        if id(node) in measured:
            return measured[id(node)]
        above.add(id(node))
        parts: list[yaml.Node] = []
        if isinstance(node, yaml.ScalarNode):
            if found := _NO_TEXT.search(node.value):
                raise refuse(f"{show(node.value)} holds {found[0]!r}, which is no text", node)
        elif isinstance(node, yaml.MappingNode):
            first: dict[str, int] = {}
            for key in (key for key, _ in node.value if isinstance(key, yaml.ScalarNode)):
                if key.value in first:
                    text = f"occurs twice, first in line {first[key.value]}"
                    raise refuse(f"key {show(key.value)} {text}", key)
                first[key.value] = key.start_mark.line + 1
            parts = [part for pair in node.value for part in pair]
        else:
            parts = node.value
        inner = [inspect(part) for part in parts]
        values = 1 + sum(size for size, _ in inner)
        levels = 1 + max((depth for _, depth in inner), default=0)
        if values > _MOST_VALUES:
            raise refuse(
                f"{values:.3g} values, once its aliases (*) are written out; at most "
                f"{_MOST_VALUES} are read. Try: without aliases",
                node,
            )
        if levels > _DEEPEST:
            raise refuse(_too_deep(), node)
        above.discard(id(node))
        measured[id(node)] = values, levels
        return values, levels

    inspect(root)
