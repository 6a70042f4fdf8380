"""Help to write a configuration: a commented template, and a schema for editors."""

import json
from collections.abc import Mapping, Sequence
from importlib.resources import files as folder_of
from typing import Any, Literal

from jinja2 import Template
from pydantic import TypeAdapter

from dlo_casadi.config.document import dump_yaml
from dlo_casadi.config.problems import PLACEHOLDER
from dlo_casadi.config.sections import Config
from dlo_casadi.errors import counted
from dlo_casadi.rod.supports import SupportKind

Kind = Literal["images", "centerlines"]


def template(
    name: str,
    files: Sequence[str] = (),
    kind: Kind = "images",
    in_space: bool = False,
    *,
    cable: Mapping[str, str] = {},
    poses: Sequence[Mapping[str, str]] = (),
    end: str = SupportKind.CLAMPED,
    clips: Sequence[str] = (),
    tolerances: Mapping[str, str] = {},
    remarks: Sequence[str] = (),
    motions: Sequence[Mapping[str, str]] = (),
) -> str:
    """Text of a configuration with placeholders for what only the user knows.

    Parameters
    ----------
    name : str
        Name of the cable.
    files : sequence of str
        One pose each, relative to the configuration; one placeholder if there are none.
    kind : "images" or "centerlines"
        What the files are in a plane; in space they are always centre-lines.
    in_space : bool
        Whether the cable may leave the plane.
    cable : mapping of str to str
        Known values of the cable, by key.
    poses : sequence of mapping of str to str
        In space, one per file: known values of its pose, by key, and a `remark`.
    end : str
        How the end is held in space.
    clips : sequence of str
        Kinds of the clips of every pose.
    tolerances : mapping of str to str
        In space: tolerances that differ from the usual ones, by key.
    remarks : sequence of str
        Comment lines at the top of the configuration.
    motions : sequence of mapping of str to str
        Keys and values of recordings of the moving cable; none by default.

    Returns
    -------
    str
        Valid YAML. `load_config` reports each remaining placeholder.
    """
    text = (folder_of("dlo_casadi.config") / "templates" / "session.yaml.in").read_text("utf-8")
    filled = Template(text, trim_blocks=True, keep_trailing_newline=True)
    quoted = [_quoted(file) for file in files or [PLACEHOLDER]]
    return filled.render(
        name=_quoted(name),
        files=list(zip(quoted, poses or [{}] * len(quoted), strict=True)),
        kind=kind,
        in_space=in_space,
        cable=cable,
        end=end,
        held=SupportKind(end).place,
        clips=[_clip(one, in_space) for one in clips],
        tolerances=tolerances,
        remarks=remarks,
        motions=[{**one, "file": _quoted(one["file"])} for one in motions],
    )


def to_fill_in(text: str) -> str:
    """What a configuration leaves to its user, in words; empty if nothing."""
    left = text.count(PLACEHOLDER) - 1  # one is in a comment
    return f"{counted(left, 'place')} to fill in, each marked {PLACEHOLDER}" if left else ""


def _clip(kind: str, in_space: bool) -> str:
    """A clip with placeholders."""
    held = SupportKind(kind)
    keys = [] if held.slides else ["at"]
    keys += ["place"] + ["orientation" if in_space else "heading"] * held.direction
    return f"{{kind: {kind}, {', '.join(f'{key}: {PLACEHOLDER}' for key in keys)}}}"


def _quoted(text: str) -> str:
    """Quote text for use inside a YAML list where it needs quotes."""
    return dump_yaml([text]).strip()[1:-1]


def config_schema() -> dict[str, Any]:
    """JSON schema of a configuration, made from the checked sections.

    It covers keys, types, ranges and help; only `load_config` checks several values together.
    """
    schema: dict[str, Any] = _plain(TypeAdapter(Config).json_schema())
    dialect = "https://json-schema.org/draft/2020-12/schema"
    return {"$schema": dialect, **schema, "title": "Configuration of dlo_casadi"}


def schema_text() -> str:
    """The schema as the text of configs/schema.json."""
    return json.dumps(config_schema(), indent=1, sort_keys=True) + "\n"


def _plain(schema: Any) -> Any:
    """Write tuples of equal items as fixed-length arrays, which older editors understand."""
    if isinstance(schema, list):
        return [_plain(item) for item in schema]
    if not isinstance(schema, dict):
        return schema
    plain = {key: _plain(value) for key, value in schema.items()}
    items = plain.get("prefixItems")
    if isinstance(items, list) and all(item == items[0] for item in items):
        plain["items"] = plain.pop("prefixItems")[0]
    return plain
