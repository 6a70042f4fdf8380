"""The words for what pydantic finds: place, reason, and what to try."""

from __future__ import annotations

import difflib
import re
from collections.abc import Sequence
from typing import Any, get_args

from pydantic_core import ErrorDetails

from dlo_casadi.config.problems import (
    PLACEHOLDER,
    Contradiction,
    Place,
    Problem,
    did_you_mean,
    kind_of,
    show,
)
from dlo_casadi.config.sections import File
from dlo_casadi.config.values import Section

_NUMBER = r"[-+]?[0-9.]+(?:[eE][-+]?[0-9]+)?"


def _label(place: Place, data: Any) -> str:
    """Name a place in words: cable.length, pose 4 (pose_04.jpg) end."""
    words: list[str] = []
    for part in place:
        if isinstance(data, dict) and part in data:
            data = data[part]
            words.append(str(part))
        elif isinstance(data, list) and isinstance(part, int) and part < len(data):
            data = data[part]
            if words == ["experiment", "poses"]:
                file = data.get("file", data.get("files")) if isinstance(data, dict) else None
                said = ", ".join(map(str, file)) if isinstance(file, list) else file
                words = [f"pose {part + 1}" + (f" ({said})" if isinstance(said, str) else "")]
            else:
                words[-1] += f"[{part}]"
    return ".".join(words) or "the top of the file"


def _sections(annotation: Any) -> list[type[Section]]:
    """Find the sections that an annotation names."""
    if isinstance(annotation, type) and issubclass(annotation, Section):
        return [annotation]
    return [section for part in get_args(annotation) for section in _sections(part)]


def _kinds(section: type[Section]) -> tuple[str, ...]:
    """The values of `kind` by which a file chooses the section, if it does so."""
    return (
        get_args(section.model_fields["kind"].annotation) if "kind" in section.model_fields else ()
    )


def _section_at(place: Place) -> type[Section]:
    """Find the section at a place; what is no key of it (index, kind) is passed over."""
    found: list[type[Section]] = [File]
    for part in place:
        fields = [outer.model_fields[str(part)] for outer in found if part in outer.model_fields]
        inner = [section for field in fields for section in _sections(field.annotation)]
        found = inner or [section for section in found if part in _kinds(section)] or found
    return found[0]


def _homes(key: str, section: type[Section] = File, at: str = "") -> list[str]:
    """List the sections that know a key."""
    homes = [at or "the top"] if key in section.model_fields else []
    for name, field in section.model_fields.items():
        for inner in _sections(field.annotation):
            kind = "".join(f" (kind: {kind})" for kind in _kinds(inner))
            homes += _homes(key, inner, f"{at}.{name}".lstrip(".") + kind)
    return homes


def _help(section: type[Section], key: object) -> str:
    """Help on a key, where the section knows it."""
    field = section.model_fields.get(str(key))
    return f": {field.description.rstrip('.')}" if field and field.description else ""


def _about_number(value: object) -> str:
    """Guess why text stands where a number belongs."""
    text = str(value).strip()
    if isinstance(value, str) and re.fullmatch(_NUMBER, text):
        return "; write it without quotes"
    if re.fullmatch(r"[-+]?[0-9]+,[0-9]+", text):
        return f"; the decimal sign is a point: {text.replace(',', '.')}"
    if found := re.fullmatch(rf"({_NUMBER})\s*[a-zA-Z/^*0-9]+", text):
        return f"; write it in SI units without the unit, such as {found[1]}"
    return ""


def _allowed(section: type[Section], key: object) -> str:
    """The range of a number, where it has two ends."""
    field = section.model_json_schema()["properties"].get(str(key), {})
    ends: dict[str, float] = {}
    for part in (field, *field.get("anyOf", ())):
        ends |= {name: part[name] for name in ("minimum", "maximum") if name in part}
    return "; {minimum:g} to {maximum:g} is possible".format(**ends) if len(ends) == 2 else ""


_MAPPING = "a mapping of keys and values belongs here, found {kind}"
_NUMBER_TYPE = "a number belongs here, found {input}{number}"
_WHOLE = "a whole number belongs here, found {input}"
_MESSAGES: dict[str, str] = {
    "float_type": _NUMBER_TYPE,
    "float_parsing": _NUMBER_TYPE,
    "finite_number": "a finite number belongs here, found {input}",
    "int_type": _WHOLE,
    "int_parsing": _WHOLE,
    "int_from_float": _WHOLE,
    "bool_type": "true or false belongs here, found {input}",
    "string_type": "text belongs here, found {input}",
    "greater_than": "must be larger than {gt:g}, found {input}",
    "greater_than_equal": "must not be smaller than {ge:g}, found {input}{allowed}",
    "less_than": "must be smaller than {lt:g}, found {input}",
    "less_than_equal": "must not be larger than {le:g}, found {input}{allowed}",
    "literal_error": "allowed are {expected}, found {input}",
    "model_type": _MAPPING,
    "model_attributes_type": _MAPPING,
    "dict_type": _MAPPING,
    "tuple_type": "a list belongs here, found {kind}",
    "too_short": "at least {min_length} belongs here, found {actual_length}",
    "too_long": "at most {max_length} belong here, found {actual_length}",
    "invalid_key": "a key must be text, found {input}",
}


def explain(errors: Sequence[ErrorDetails], data: Any) -> list[Problem]:
    """Say what pydantic found in the words of the file."""
    problems: list[Problem] = []
    suggested: set[Place] = set()
    for error in errors:
        if error["type"] == "extra_forbidden":
            *above, key = error["loc"]
            known = list(_section_at(tuple(above)).model_fields)
            near = difflib.get_close_matches(str(key), known, 1, cutoff=0.6)
            suggested.update((*above, name) for name in near)
    for error in errors:
        place, context = error["loc"], error.get("ctx", {})
        section, label = _section_at(place[:-1]), _label(place, data)
        kind = error["type"]
        if error["input"] == PLACEHOLDER:
            text = f"{label} is still to be filled in{_help(section, place[-1])}"
        elif kind == "missing":
            if place in suggested:
                continue
            key = place[-1]
            text = (
                f"{label} has only {key} of its values"
                if isinstance(key, int)
                else f"{key!r} is missing in {label}{_help(section, key)}"
            )
        elif kind == "extra_forbidden":
            key = str(place[-1])
            homes = _homes(key)
            hint = did_you_mean(key, section.model_fields)
            if homes and "did you mean" not in hint:
                hint = f"; it belongs into {' or '.join(homes)}"
            text = f"unknown key {show(key)} in {_label(place[:-1], data)}{hint}"
        elif kind in ("union_tag_invalid", "union_tag_not_found"):
            place = (*place, "kind")
            text = f"{label}: kind must be images or centerlines, found {show(context.get('tag'))}"
        elif kind == "value_error" and isinstance(context["error"], Contradiction):
            for inner in context["error"].problems:
                at = (*place, *inner.place)
                problems.append(Problem(at, f"{_label(at, data)}: {inner.message}"))
            continue
        elif kind == "value_error":
            text = f"{label}: {context['error']}"
        elif kind in _MESSAGES:
            words = {
                "input": show(error["input"]),
                "kind": kind_of(error["input"]),
                "number": _about_number(error["input"]),
                "allowed": _allowed(section, place[-1]),
            }
            text = f"{label}: {_MESSAGES[kind].format(**(context | words))}"
            if place[-1] == "start" and error["input"] == "free":
                text += "; only the end can be free"
            if "tolerances" in place and error["input"] == 0:
                text += "; for a value that is known exactly write a small one, such as 1.0e-6"
        else:
            text = f"{label}: {error['msg']}"
        problems.append(Problem(place, text))
    return problems
