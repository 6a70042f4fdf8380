"""What may stand behind a key of a configuration: numbers, places, orientations."""

from __future__ import annotations

from typing import Annotated, Any, TypeAlias

from pydantic import AfterValidator, BaseModel, BeforeValidator, ConfigDict, Field

from dlo_casadi.config.limits import COORDINATE, FORCE, MOMENT, Range, implausible_quaternion
from dlo_casadi.config.problems import show


def optional(section: type[Section]) -> BeforeValidator:
    """Let a section be empty: `model:` with nothing behind it."""
    return BeforeValidator(
        lambda value: {} if value is None else value, json_schema_input_type=section | None
    )


def within(allowed: Range) -> AfterValidator:
    """Refuse a number, or the numbers of a list, that lie outside of a range."""

    def check(value: Any) -> Any:
        numbers = value if isinstance(value, tuple) else (value,)
        if wrong := [message for x in numbers if (message := allowed.complaint(x))]:
            raise ValueError("; ".join(wrong))
        return value

    return AfterValidator(check)


def _listed(belongs: str, schema: Any, *counts: int) -> BeforeValidator:
    """A list of one of these counts of numbers; the schema of editors tells it by its types."""

    def check(value: object) -> object:
        if not isinstance(value, list | tuple) or len(value) not in counts:
            raise ValueError(f"{belongs}, found {show(value)}")
        return value

    return BeforeValidator(check, json_schema_input_type=schema)


def _moment(value: object) -> object:
    if isinstance(value, list | tuple):
        if len(value) == 3:
            return value
    elif isinstance(value, int | float) and not isinstance(value, bool):
        return (value,)
    raise ValueError(f"one number belongs here, in space three [mx, my, mz], found {show(value)}")


def _unit(value: tuple[float, ...]) -> tuple[float, ...]:
    if wrong := implausible_quaternion(value):
        raise ValueError(wrong)
    return value


Number = Annotated[float, Field(strict=True, allow_inf_nan=False)]
Positive = Annotated[Number, Field(gt=0.0)]
NonNegative = Annotated[Number, Field(ge=0.0)]
Count = Annotated[int, Field(strict=True)]
Switch = Annotated[bool, Field(strict=True)]
_Two: TypeAlias = tuple[Number, Number]
Row: TypeAlias = tuple[Number, Number, Number]
_Four: TypeAlias = tuple[Number, Number, Number, Number]
Vector = Annotated[_Two, _listed("two numbers [x, y] belong here", _Two, 2)]
Direction = Annotated[
    tuple[Number, ...],
    _listed("two numbers [x, y] belong here, in space three [x, y, z]", _Two | Row, 2, 3),
]
Place = Annotated[Direction, within(COORDINATE)]
Force = Annotated[Direction, within(FORCE)]
Moment = Annotated[
    tuple[Number, ...],
    BeforeValidator(_moment, json_schema_input_type=Number | Row),
    within(MOMENT),
]
Quaternion = Annotated[
    tuple[Number, ...],
    _listed("a quaternion [qx, qy, qz, qw] belongs here", _Four, 4),
    AfterValidator(_unit),
]


class Section(BaseModel):
    """A frozen mapping of the file: unknown keys are errors, the docstring of a key is its help."""

    model_config = ConfigDict(frozen=True, extra="forbid", use_attribute_docstrings=True)
