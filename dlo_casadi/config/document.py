"""Convert YAML text <-> plain data. No other module imports yaml."""

import re
from codecs import BOM_UTF16_BE, BOM_UTF16_LE
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any, Self

import yaml

from dlo_casadi.config.problems import Place, Source, did_you_mean, show
from dlo_casadi.errors import ConfigError, counted

# Largest file [bytes]: PyYAML reads it in five seconds. A session of a thousand poses has 80,000.
_LARGEST = 500_000
# Largest number of values after expanding aliases: as many as the largest file can hold.
_MOST_VALUES = _LARGEST // 2
# Maximum nesting of lists and mappings; a configuration has seven levels.
_DEEPEST = 30
# What helps against a backslash that is more than itself.
BACKSLASH = (
    "In double quotes a backslash begins an escape. Try: single quotes, as in 'C:\\lab\\a.csv', or "
    "forward slashes, C:/lab/a.csv"
)
# Refused characters: control characters other than tab and line breaks, which a terminal would
# obey; and lone surrogates, except those that stand for bytes of file names (PEP 383).
_NO_TEXT = re.compile("[\x00-\x08\x0b\x0c\x0e-\x1f\x7f\ud800-\udc7f\udd00-\udfff]")


def read_yaml(path: str | Path) -> Any:
    """Read a YAML file as plain dicts, lists, text and numbers.

    1e-3 is a number here, as in YAML 1.2; a key that occurs twice is an error.
    Raises ConfigError if the file cannot be read, is empty, or is not YAML.
    """
    return Document.read(Path(path)).data


def parsed_yaml(content: bytes, source: Path) -> Any:
    """Plain data of the content of a YAML file, as `read_yaml` returns them."""
    return Document.of(content, source).data


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
        return cls.of(_read_bytes(source, largest), source)

    @classmethod
    def of(cls, text: bytes, source: Path) -> Self:
        """Document of the content of a file, or a ConfigError."""
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
            said = f"{error.problem}{hint}" if "escape" not in str(error.problem) else BACKSLASH
            raise ConfigError(
                f"not valid YAML: {said}",
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


_WHOLE, _DIGITS = re.compile(r"[-+]?[0-9]+"), re.compile(r"[0-9]+(?:[eE][-+]?[0-9]+)?")


def _tight(one: yaml.Node, other: yaml.Node) -> bool:
    """Whether a comma without a blank is between two whole numbers, as in a decimal of a comma."""
    if not (isinstance(one, yaml.ScalarNode) and isinstance(other, yaml.ScalarNode)):
        return False
    plain = not (one.style or other.style)
    together = other.start_mark.index - one.end_mark.index == 1
    whole = _WHOLE.fullmatch(one.value) and _DIGITS.fullmatch(other.value)
    return bool(plain and together and whole)


def _split_numbers(node: yaml.MappingNode) -> Iterator[str]:
    """Decimal commas in braces: {length: 0,8} has the value 0, and a key 8 without one."""
    for (key, value), (other, nothing) in pairwise(node.value):
        empty = nothing.start_mark.index == nothing.end_mark.index
        if empty and _tight(value, other):
            yield f"{key.value}: {value.value},{other.value} means {value.value}.{other.value}"


def _split_list(items: Sequence[yaml.Node]) -> Iterator[str]:
    """Decimal commas in brackets: [0,6, 0,1] has four numbers.

    If no comma has a blank behind it, they may be what they are in other lists.
    """
    if all(b.start_mark.index - a.end_mark.index == 1 for a, b in pairwise(items)):
        return
    tight = [_tight(a, b) for a, b in pairwise(items)]
    if not any(tight):
        return
    found = meant = str(items[0].value)
    for item, joined in zip(items[1:], tight, strict=True):
        found += f"{',' if joined else ', '}{item.value}"
        meant += f"{'.' if joined else ', '}{item.value}"
    several = counted(len(items), "number")
    yield f"[{found}] means [{meant}], or {several} with a blank behind each comma"


def _too_deep() -> str:
    return f"lists and mappings more than {_DEEPEST} levels deep. Try: brackets and braces closed?"


def _inspect(root: yaml.Node, source: Path) -> None:
    """Refuse valid YAML that is not plain data; nodes are visited once, aliases counted in full."""
    measured: dict[int, tuple[int, int]] = {}
    above: set[int] = set()
    split: set[tuple[int, str]] = set()  # lines and words of decimal commas

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
                hint = f". {BACKSLASH}" if node.style == '"' else ""
                raise refuse(f"{show(node.value)} holds {found[0]!r}, which is no text{hint}", node)
        elif isinstance(node, yaml.MappingNode):
            commas = [(node.start_mark.line + 1, said) for said in _split_numbers(node)]
            split.update(commas)
            first: dict[str, int] = {}
            keys = [] if commas else [key for key, _ in node.value]
            for key in (key for key in keys if isinstance(key, yaml.ScalarNode)):
                if key.value in first:
                    text = f"occurs twice, first in line {first[key.value]}"
                    raise refuse(f"key {show(key.value)} {text}", key)
                first[key.value] = key.start_mark.line + 1
            parts = [part for pair in node.value for part in pair]
        else:
            parts = node.value
            split.update((node.start_mark.line + 1, said) for said in _split_list(parts))
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
    if split:
        told = "; ".join(f"line {line}: {said}" for line, said in sorted(split))
        raise ConfigError(f"the decimal sign is a point; {told}", file=source)
