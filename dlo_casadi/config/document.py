"""YAML text <-> plain data. The only module that imports yaml."""

from __future__ import annotations

import re
from collections.abc import Hashable, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

from dlo_casadi.config.problems import Place, Problem, did_you_mean
from dlo_casadi.errors import ConfigError


def read_yaml(path: str | Path) -> Any:
    """Read a YAML file as plain dicts, lists, text and numbers.

    Numbers such as 1e-3 are numbers here, as in YAML 1.2; a key that occurs twice is an error.

    Parameters
    ----------
    path : str or Path
        The file.

    Returns
    -------
    object
        Its contents.

    Raises
    ------
    ConfigError
        If the file cannot be read, is empty, or is not YAML.
    """
    return Document.read(Path(path)).data


def dump_yaml(data: object) -> str:
    """Write plain data as YAML: every digit of a float, keys in their order, no aliases.

    Parameters
    ----------
    data : object
        Mappings, sequences, arrays, numbers, text, paths, None; nested as you like.

    Returns
    -------
    str
        Text that `read_yaml` turns into the same data.
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
    """Arrays, tuples and subclasses of the basic types as what YAML knows."""
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


def _with_numbers_of_yaml_1_2(resolver: type[yaml.resolver.BaseResolver]) -> None:
    """Let 1e-3 be a number, 012 twelve, 1:30 and 2024-01-01 text."""
    replaced = [f"tag:yaml.org,2002:{kind}" for kind in ("int", "float", "timestamp")]
    resolver.yaml_implicit_resolvers = {
        first: [(tag, pattern) for tag, pattern in known if tag not in replaced]
        for first, known in resolver.yaml_implicit_resolvers.items()
    }
    resolver.add_implicit_resolver("tag:yaml.org,2002:int", _INT, list("-+0123456789"))
    resolver.add_implicit_resolver("tag:yaml.org,2002:float", _FLOAT, list("-+.0123456789"))


class _Loader(yaml.SafeLoader):
    """SafeLoader with the numbers of YAML 1.2."""

    def construct_decimal(self, node: yaml.ScalarNode) -> int:
        return int(self.construct_scalar(node))

    def construct_number(self, node: yaml.ScalarNode) -> float:
        return float(re.sub(r"\.(?=inf|nan)", "", self.construct_scalar(node).lower()))


_with_numbers_of_yaml_1_2(_Loader)
_Loader.add_constructor("tag:yaml.org,2002:int", _Loader.construct_decimal)
_Loader.add_constructor("tag:yaml.org,2002:float", _Loader.construct_number)


class _Dumper(yaml.SafeDumper):
    """SafeDumper that repeats instead of referring, and quotes what any YAML takes for a number."""

    def ignore_aliases(self, data: object) -> bool:
        return True


_Dumper.add_implicit_resolver("tag:yaml.org,2002:float", _FLOAT, list("-+.0123456789"))


@dataclass(frozen=True)
class Document:
    """A YAML file: its data, and the node tree that knows the lines."""

    source: Path
    root: yaml.Node
    data: Any

    @classmethod
    def read(cls, source: Path) -> Document:
        """Read a file, or raise a ConfigError."""
        try:
            text = source.read_bytes()
        except FileNotFoundError:
            near = did_you_mean(source.name, [p.name for p in source.parent.glob("*.y*ml")])
            raise ConfigError(f"no such file{near}", file=source) from None
        except OSError as error:
            raise ConfigError(f"cannot be read: {error.strerror}", file=source) from None
        try:
            loader = _Loader(text)
            root = loader.get_single_node()
            if root is None:
                raise ConfigError("the file is empty", file=source)
            _refuse_repeated_keys(root, source)
            return cls(source, root, loader.construct_document(root))
        except yaml.MarkedYAMLError as error:
            mark = error.problem_mark or error.context_mark
            hint = " (indent with spaces)" if "'\\t'" in str(error.problem) else ""
            raise ConfigError(
                f"not valid YAML: {error.problem}{hint}",
                file=source,
                line=None if mark is None else mark.line + 1,
            ) from None
        except (yaml.YAMLError, UnicodeDecodeError, RecursionError) as error:
            reason = str(error).splitlines()[0]
            raise ConfigError(f"not a YAML text file: {reason}", file=source) from None

    def line(self, place: Place) -> int:
        """Line of a place; of the nearest enclosing one if it is not in the file."""
        node = self.root
        line = int(node.start_mark.line) + 1
        for part in place:
            if isinstance(node, yaml.MappingNode):
                found = [(k, v) for k, v in node.value if getattr(k, "value", None) == str(part)]
                if not found:
                    continue
                key, node = found[0]
                line = key.start_mark.line + 1
            elif isinstance(node, yaml.SequenceNode) and isinstance(part, int):
                if part >= len(node.value):
                    break
                node = node.value[part]
                line = node.start_mark.line + 1
            else:
                break
        return line

    def error(self, problems: Iterable[Problem], heading: str = "") -> ConfigError:
        """All problems as one error, in the order of their lines."""
        most = 12
        lines = sorted({(self.line(problem.place), problem.message) for problem in problems})
        if len(lines) == 1:
            line, message = lines[0]
            return ConfigError(": ".join(filter(None, (heading, message))), self.source, line)
        listed = [f"  line {line}: {message}" for line, message in lines[:most]]
        if len(lines) > most:
            listed.append(f"  ... and {len(lines) - most} more")
        heading = heading or f"{len(lines)} problems"
        return ConfigError("\n".join([heading, *listed]), self.source)


def _refuse_repeated_keys(root: yaml.Node, source: Path) -> None:
    waiting, seen = [root], set()
    while waiting:
        node = waiting.pop()
        if id(node) in seen:
            continue
        seen.add(id(node))
        if isinstance(node, yaml.SequenceNode):
            waiting.extend(node.value)
        elif isinstance(node, yaml.MappingNode):
            first: dict[Hashable, int] = {}
            for key, value in node.value:
                line = key.start_mark.line + 1
                if isinstance(key, yaml.ScalarNode) and key.value in first:
                    raise ConfigError(
                        f"key {key.value!r} occurs twice, first in line {first[key.value]}",
                        file=source,
                        line=line,
                    )
                if isinstance(key, yaml.ScalarNode):
                    first[key.value] = line
                waiting.append(value)
