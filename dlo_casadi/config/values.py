"""Types of the values in a file: numbers, places, orientations, lists.

A value beyond its range is a typing error (a unit, an exponent) that cannot be computed with: it is
refused, and the message gives the range. A computable but unlikely value is a warning of
`load_config`.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Annotated, Any, Literal, NamedTuple, TypeAlias

import numpy as np
from pydantic import AfterValidator, BeforeValidator, Field
from pydantic_core import PydanticKnownError

from dlo_casadi.config.problems import ConfigProblem, Contradiction, show
from dlo_casadi.effects.cable import STIFFNESS_BOUNDS
from dlo_casadi.rod.supports import SupportKind


def one_of(kinds: Sequence[SupportKind]) -> BeforeValidator:
    """Annotation of a field: the word of one of these kinds of supports."""
    words = " or ".join(f"'{kind}'" for kind in kinds)
    words = words.replace(" or ", ", ", len(kinds) - 2)

    def known(value: object) -> SupportKind:
        if not isinstance(value, str) or value not in kinds:
            raise PydanticKnownError("literal_error", {"expected": words})
        return SupportKind(value)

    return BeforeValidator(known, json_schema_input_type=Literal[*map(str, kinds)])


class Range(NamedTuple):
    """Limits between which a value can lie."""

    least: float
    most: float
    unit: str

    def __contains__(self, value: object) -> bool:
        return isinstance(value, int | float) and self.least <= value <= self.most

    def __str__(self) -> str:
        return f"{self.least:g} to {self.most:g}{self.unit and ' '}{self.unit} is possible"

    def complaint(self, value: float) -> str:
        """Describe why a value is out of range; empty if it is inside."""
        return "" if value in self else f"{value:g}{self.unit and ' '}{self.unit}: {self}"


# Nothing shorter than a millimetre is held by two fixtures; a cable between two masts has 100 m.
LENGTH = Range(1.0e-3, 100.0, "m")
# Largest deviation of a quaternion's length from one: rounding to three digits.
_UNIT = 2.0e-3
# Carbon fibres have 5e-6 m; the upper limit is the cable's length.
_THINNEST = 1.0e-6
# A millimetre of the thinnest wire on sale (copper, 10 um): 9e3 pi (5e-6)^2 1e-3 = 7e-10 kg.
_LIGHTEST = 1.0e-10
# A metre of a submarine power cable has 100 kg.
_HEAVIEST, _HEAVIEST_PER_METRE = 1000.0, 100.0
# Polystyrene foam to osmium, the densest metal.
_DENSITIES = Range(15.0, 2.26e4, "kg/m^3")
# A strip declared with its thickness as diameter seems denser (0.9 mm, 0.25 m and 17 g: 1.1e5), a
# tube lighter. The upper limit still catches grams: 200 kg/m^3, less than any rope, become 2e5. The
# lower limit is air: a lighter cable does not hang.
_POSSIBLE_DENSITIES = Range(1.2, 2.0e5, "kg/m^3")
# Bounds of the fit itself: a carbon fibre has E pi d^4 / 64 = 2.3e11 pi (5e-6)^4 / 64 =
# 7e-12 N m^2, a steel bar of 0.5 m 6e8 N m^2.
STIFFNESS = Range(*STIFFNESS_BOUNDS, "N m^2")
# The largest centrifuges for soil models reach about 1e3 times the Earth's 9.81 m/s^2.
GRAVITY = Range(0.0, 1.0e4, "m/s^2")
# Only map frames have an origin farther away; at 1e3 m doubles resolve 1e-13 m.
COORDINATE = Range(-1.0e3, 1.0e3, "m")
# Beyond it rounding exceeds 1e-10 rad, and at 1e9 rad no equilibrium is found. As in the C solver.
HEADING = Range(-1.0e6, 1.0e6, "rad")
# Seconds since 1970, or since any other time: after 3e9 s doubles still resolve a microsecond.
TIME = Range(-1.0e10, 1.0e10, "s")
# The heaviest cable (100 kg/m, 100 m) weighs 1e5 N; tension adds to it. Moments: at a metre's arm.
FORCE, MOMENT = Range(-1.0e6, 1.0e6, "N"), Range(-1.0e6, 1.0e6, "N m")
# A joint needs two elements; 2000 elements on a metre have half a millimetre each, less than a
# cable is thick.
MESH = Range(2, 2000, "elements")
# Cubic splines need four coefficients. With 64, a line of 240 points has four between two knots;
# the covariance in a result grows with the square of their number.
REST_COEFFICIENTS = Range(0, 64, "coefficients")


def implausible_sizes(length: float, mass: float, diameter: float) -> list[ConfigProblem]:
    """Find impossible sizes [m] and masses [kg] of a cable: each alone, then their combination."""

    def density(diameter: float) -> float:
        """Mass over volume [kg/m^3] of a round cable: m / (pi d^2 / 4 L)."""
        return mass / (length * math.pi * diameter * diameter / 4)  # inf where ** would raise

    def meant(value: float, possible: bool) -> str:
        return f"did you mean {value:g}? " if possible else ""

    def in_metres() -> str:
        """Ask whether the diameter is in millimetres or centimetres, if that would be plausible."""
        sound = [d for d in (diameter / 1e3, diameter / 1e2) if density(d) in _DENSITIES]
        return f", did you mean {sound[0]:g}?" if sound else ""

    wrong: list[tuple[str, str]] = []
    if length not in LENGTH:
        hint = meant(length / 1e3, length / 1e3 in LENGTH)
        wrong.append(("length", f"{length:g} m: units are SI, {hint}{LENGTH}"))
    elif diameter > length:
        text = f"{diameter:g} m is larger than the length {length:g} m: units are SI{in_metres()}"
        wrong.append(("diameter", text))
    elif thin := Range(_THINNEST, length, "m").complaint(diameter):
        wrong.append(("diameter", thin))
    heaviest = min(_HEAVIEST, _HEAVIEST_PER_METRE * length)
    if mass > heaviest:
        hint = meant(mass / 1e3, mass / 1e3 <= heaviest)  # given in grams
        text = f"units are SI, {hint}at most {heaviest:g} kg is possible"
        wrong.append(("mass", f"{mass:g} kg for {length:g} m: {text}"))
    elif mass < _LIGHTEST:
        text = f"no cable is lighter than {_LIGHTEST:g} kg; to leave its weight out, write "
        wrong.append(("mass", f"{mass:g} kg: {text}gravity: [0, 0]"))
    apparent = math.nan if wrong else density(diameter)  # for possible sizes only
    if apparent > _POSSIBLE_DENSITIES.most:
        hint = meant(mass / 1e3, apparent / 1e3 in _DENSITIES)
        text = f"{mass:g} kg make it {apparent / 1e3:.3g} times as dense as water (osmium, the "
        text += f"densest metal: {_DENSITIES.most / 1e3:g}): units are SI, {hint}diameter and "
        wrong.append(("mass", f"{text}length in m?"))
    elif apparent < _POSSIBLE_DENSITIES.least:
        text = f"{diameter:g} m make {mass:g} kg lighter than air, {apparent:.2g} kg/m^3: units "
        wrong.append(("diameter", f"{text}are SI{in_metres()}, mass in kg?"))
    return [ConfigProblem((key,), text) for key, text in wrong]


def _implausible_quaternion(values: Sequence[float]) -> str:
    """Problem with an orientation (x, y, z, w); empty if its length is one."""
    size = math.hypot(*values)
    text = f"a unit quaternion [qx, qy, qz, qw] belongs here, its length is {size:.4g}"
    return "" if abs(size - 1) <= _UNIT else text


def no_file_name(name: str) -> str:
    """Why results cannot carry this name; empty if they can."""
    if name in (".", "..") or set(name) & set('/\\:*?"<>|\0') or name != name.strip():
        return (
            f"results are named after it: a file name without ending belongs here, found {name!r}"
        )
    return ""


class Axes(NamedTuple):
    """Words for a session in a plane or in space; `direction` is that of a clamp."""

    where: str
    gravity: str
    place: str
    direction: str
    unit: str


# Gravity on Earth [m/s^2].
EARTH = 9.81
# Keyed by the number of gravity's components.
_TURNED, _FRAME = "[rad], continuous along the cable", "[qx, qy, qz, qw]"
AXES = {
    2: Axes("a plane", "two numbers", "[x, y]", "heading", _TURNED),
    3: Axes("space", "three numbers", "[x, y, z]", "orientation", _FRAME),
}


# ---- types -------------------------------------------------------------------------------------


def checked(complaint: Callable[[Any], str | list[ConfigProblem]]) -> AfterValidator:
    """Refuse a value if the check finds something wrong with it or its keys."""

    def check(value: Any) -> Any:
        if wrong := complaint(value):
            raise ValueError(wrong) if isinstance(wrong, str) else Contradiction(*wrong)
        return value

    return AfterValidator(check)


def within(allowed: Range) -> AfterValidator:
    """Refuse a number, or the numbers of a list, outside a range."""

    def complaint(value: Any) -> str:
        numbers = value if isinstance(value, tuple) else (value,)
        return "; ".join(filter(None, map(allowed.complaint, numbers)))

    return checked(complaint)


def stacked(names: Sequence[str]) -> BeforeValidator:
    """Combine several components by name into one list, one component after another."""

    def check(value: Any) -> Any:
        if not isinstance(value, Mapping):
            return value
        if missing := [name for name in names if not isinstance(value.get(name), list | tuple)]:
            raise ValueError(f"{missing[0]} is missing")
        return [number for name in names for number in value[name]]

    return BeforeValidator(check)


def _listed(belongs: str, schema: Any, *counts: int) -> BeforeValidator:
    """A list with one of these numbers of items; editors get `schema`."""

    def check(value: object) -> object:
        if not isinstance(value, list | tuple) or len(value) not in counts:
            twice = isinstance(value, list | tuple) and len(value) in [2 * n for n in counts]
            whole = isinstance(value, list | tuple) and all(type(x) is int for x in value)
            hint = "; decimal commas? The decimal sign is a point" * (twice and whole)
            raise ValueError(f"{belongs}, found {show(value)}{hint}")
        return value

    return BeforeValidator(check, json_schema_input_type=schema)


def _table(words: str, *columns: int, of: Range = COORDINATE) -> BeforeValidator:
    """Numbers in rows of one of these lengths (or one plain row), as a frozen tuple."""

    def check(value: object) -> object:
        belongs = f"{words} belong here"
        try:
            array = np.asarray(value)
            # What is masked, or empty in a table, is None.
            if all(x is None or isinstance(x, float) or type(x) is int for x in array.flat):
                array = array.astype(float)
        # Rows of different lengths; an integer beyond all floats; symbols.
        except (ValueError, OverflowError, TypeError):
            array = np.zeros(0, object)
        if array.dtype.kind not in "fiu" or not array.size or not isinstance(value, list | tuple):
            file = ". Try: file, for the name of a file" if isinstance(value, str) else ""
            raise ValueError(f"{belongs}, found {show(value)}{file}")
        if array.ndim != 1 + bool(columns) or (columns and array.shape[1] not in columns):
            raise ValueError(f"{belongs}, found numbers of the shape {array.shape}")
        rows = array.reshape(len(array), -1)
        if len(wrong := np.flatnonzero(~np.isfinite(rows).all(axis=1))):
            raise ValueError(
                f"{show(rows[wrong[0]].tolist())} in place {wrong[0] + 1} is not finite; leave out "
                "the points that were not measured, gaps are allowed"
            )
        if len(far := rows[(rows < of.least) | (rows > of.most)]):
            raise ValueError(of.complaint(float(far[0])))
        numbers = array.astype(float).tolist()
        return tuple(map(tuple, numbers)) if columns else tuple(numbers)

    return BeforeValidator(
        check, json_schema_input_type=list[_Two | Row] if columns else list[float]
    )


Number = Annotated[float, Field(strict=True, allow_inf_nan=False)]
Heading = Annotated[Number, within(HEADING)]
Positive = Annotated[Number, Field(gt=0.0)]
NonNegative = Annotated[Number, Field(ge=0.0)]
Count = Annotated[int, Field(strict=True)]
Elements = Annotated[Count, Field(ge=MESH.least, le=MESH.most)]
RestCoefficients = Annotated[Count, Field(ge=REST_COEFFICIENTS.least, le=REST_COEFFICIENTS.most)]
Name = Annotated[str, Field(coerce_numbers_to_str=True)]
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
Gravity = Annotated[Direction, checked(lambda vector: GRAVITY.complaint(math.hypot(*vector)))]
Points = Annotated[
    tuple[tuple[float, ...], ...], _table("numbers [[x, y], ...], in space [[x, y, z], ...]", 2, 3)
]
ArcLengths = Annotated[tuple[float, ...], _table("arc lengths [s, ...]")]
Times = Annotated[tuple[float, ...], _table("times [t, ...]", of=TIME)]
Headings = Annotated[tuple[float, ...], _table("headings [phi, ...]", of=HEADING)]
Quaternions = Annotated[
    tuple[tuple[float, ...], ...], _table("quaternions [[qx, qy, qz, qw], ...]", 4)
]
Force = Annotated[Direction, within(FORCE)]
Moment = Annotated[
    tuple[Number, ...],
    _listed("one number belongs here, in space three [mx, my, mz]", Number | Row, 1, 3),
    BeforeValidator(lambda value: [value] if type(value) in (int, float) else value),
    within(MOMENT),
]
Quaternion = Annotated[
    tuple[Number, ...],
    _listed("a quaternion [qx, qy, qz, qw] belongs here", _Four, 4),
    checked(_implausible_quaternion),
]
