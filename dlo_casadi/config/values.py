"""What may stand behind a key of a configuration: numbers, places, orientations."""

from __future__ import annotations

from typing import Annotated

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field

from dlo_casadi.config.problems import show


def optional(section: type[Section]) -> BeforeValidator:
    """Let a section be empty: `model:` with nothing behind it."""
    return BeforeValidator(_empty_section, json_schema_input_type=section | None)


def _pair(value: object) -> object:
    if not isinstance(value, list | tuple) or len(value) != 2:
        raise ValueError(f"two numbers [x, y] belong here, found {show(value)}")
    return value


def _place(value: object) -> object:
    if not isinstance(value, list | tuple) or len(value) not in (2, 3):
        raise ValueError(
            f"two numbers [x, y] belong here, in space three [x, y, z], found {show(value)}"
        )
    return value


def _moment(value: object) -> object:
    if isinstance(value, list | tuple):
        if len(value) == 3:
            return value
    elif isinstance(value, int | float) and not isinstance(value, bool):
        return (value,)
    raise ValueError(f"one number belongs here, in space three [mx, my, mz], found {show(value)}")


def _quaternion(value: object) -> object:
    if not isinstance(value, list | tuple) or len(value) != 4:
        raise ValueError(f"a quaternion [qx, qy, qz, qw] belongs here, found {show(value)}")
    return value


def _empty_section(value: object) -> object:
    """Read `model:` with nothing behind it as an empty section."""
    return {} if value is None else value


Number = Annotated[float, Field(strict=True, allow_inf_nan=False)]
Positive = Annotated[float, Field(strict=True, allow_inf_nan=False, gt=0.0)]
NonNegative = Annotated[float, Field(strict=True, allow_inf_nan=False, ge=0.0)]
Count = Annotated[int, Field(strict=True)]
Switch = Annotated[bool, Field(strict=True)]
Vector = Annotated[
    tuple[Number, Number], BeforeValidator(_pair, json_schema_input_type=tuple[Number, Number])
]
Row = tuple[Number, Number, Number]
Place = Annotated[
    tuple[Number, ...],
    BeforeValidator(
        _place, json_schema_input_type=tuple[Number, Number] | tuple[Number, Number, Number]
    ),
]
Moment = Annotated[
    tuple[Number, ...],
    BeforeValidator(_moment, json_schema_input_type=Number | tuple[Number, Number, Number]),
]
Quaternion = Annotated[
    tuple[Number, ...],
    BeforeValidator(_quaternion, json_schema_input_type=tuple[Number, Number, Number, Number]),
]


class Section(BaseModel):
    """A frozen mapping of the file: unknown keys are errors, the docstring of a key is its help."""

    model_config = ConfigDict(frozen=True, extra="forbid", use_attribute_docstrings=True)
