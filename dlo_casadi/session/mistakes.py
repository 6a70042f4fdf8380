"""What users declare otherwise than they mean, a row each: its words, and what was meant.

Rows of one table are alternatives, the likely ones first. What is compared, and how well a row must
explain it, says the `Question` that asks them: `ends`, `clamps`, `readings`, `shapes`.
"""

from collections.abc import Callable
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from dlo_casadi.arrays import FloatArray
from dlo_casadi.rod.quantities import QUANTITIES, Quantity
from dlo_casadi.session.axes import exchanges, named, read_as
from dlo_casadi.session.compared_clamps import Clamps
from dlo_casadi.session.compared_readings import ComparedReading, Readings
from dlo_casadi.session.compared_shapes import FittedSession
from dlo_casadi.session.lines import Lines
from dlo_casadi.session.questions import Mistake
from dlo_casadi.thresholds import CONTRADICTS, MUCH_BETTER

# All ways to exchange and mirror axes in a plane and in space, but for the identity.
AXES = tuple(axes for d in (2, 3) for axes in exchanges(d)[1:])

# ---- lengths and ends of lines ------------------------------------------------------------------

LENGTHS_IN = {"millimetres": 1.0e-3, "centimetres": 1.0e-2, "inches": 0.0254}


def _scaled(**factors: float) -> Callable[[Lines], Lines]:
    return lambda lines: lines.scaled(**factors)


UNITS_OF_LENGTHS: tuple[Mistake[Lines], ...] = tuple(
    row
    for unit, size in LENGTHS_IN.items()
    for row in (
        Mistake(
            "the measured lines are {was.typical:.4g} m long (median), the cable {was.length:.4g} "
            f"m: the points look like {unit}. Try: write them in metres, as the header x_m,y_m "
            "says.",
            _scaled(points=size),
        ),
        Mistake(
            "the measured lines are {was.typical:.4g} m long (median), cable.length is "
            f"{{was.length:.4g}} m: it looks like {unit}. Try: cable.length: "
            "{meant.length:.6g}, and all lengths in metres.",
            _scaled(length=size),
        ),
    )
)
_SPANS = (
    "the ends of the lines are {was.typical_spans[1]:.4g} m apart (median), start and end of their "
    "poses {was.typical_spans[0]:.4g} m: the factor of "
)
UNITS_OF_ENDS: tuple[Mistake[Lines], ...] = tuple(
    row
    for unit, size in LENGTHS_IN.items()
    for row in (
        Mistake(
            f"{_SPANS}{unit}. Try: points and cable.length in metres.",
            _scaled(points=size, length=size),
        ),
        Mistake(f"{_SPANS}{unit}. Try: start and end of all poses in metres.", _scaled(ends=size)),
    )
)
COUNTED: tuple[Mistake[Lines], ...] = (
    Mistake(
        "the markers are {was.off:.3g} m RMS from the declared start and end, but {meant.off:.3g} "
        "m once they are counted from the other end. Try: s_m from the start; or are start and end "
        "of the poses exchanged?",
        lambda lines: lines.reversed(),
    ),
)
_IN_FRAME = (
    "the lines do not end at start and end of their poses ({was.off:.3g} m RMS), but do "
    "({meant.off:.3g} m) with {meant.how}. Try: points, start, end, orientations and gravity in "
    "one frame, right-handed, in a plane x to the right and y up; in pictures rows count "
    "downwards; a camera's points by its calibration."
)


def _in_axes(axes: FloatArray, *, moved: bool) -> Callable[[Lines], Lines | None]:
    return lambda lines: lines.in_axes(axes, moved=moved)


def _near_axes(axes: FloatArray) -> Callable[[Lines], Lines | None]:
    return lambda lines: lines.in_best_frame(axes)


FRAMES: tuple[Mistake[Lines], ...] = (
    Mistake(
        "all lines lie ({meant.how}) m away from their start and end. Try: measure fixtures and "
        "lines from the same origin; subtract this from the points, or add it to start and end.",
        lambda lines: lines.from_origin(),
    ),
    *(Mistake(_IN_FRAME, _in_axes(axes, moved=moved)) for moved in (False, True) for axes in AXES),
)
FITTED_FRAMES: tuple[Mistake[Lines], ...] = tuple(
    Mistake(_IN_FRAME, _near_axes(axes), CONTRADICTS) for d in (2, 3) for axes in exchanges(d)
)

# ---- directions of clamps -----------------------------------------------------------------------


def _read(key: str, value: Callable[[Any], Any]) -> Callable[[Clamps], Clamps | None]:
    return lambda clamps: clamps.read(key, value)


def _turned(*vector: float) -> Callable[[Clamps], Clamps | None]:
    turn = Rotation.from_rotvec(vector)
    return _read("orientation", lambda q: (Rotation.from_quat(q) * turn).as_quat())


DIRECTIONS: tuple[Mistake[Clamps], ...] = (
    Mistake("in degrees?", _read("heading", np.radians)),
    Mistake(
        "headings point along the cable from its start to its end:",
        _read("heading", lambda angle: angle - np.pi),
    ),
    Mistake("counter-clockwise is positive:", _read("heading", lambda angle: -angle)),
    Mistake(
        "counter-clockwise from x; here headings seem to run clockwise from y, as a compass:",
        _read("heading", lambda angle: np.pi / 2 - angle),
    ),
    Mistake(
        "w last, [qx, qy, qz, qw]; here w seems to stand first:",
        _read("orientation", lambda q: np.roll(q, -1)),
    ),
    Mistake(
        "x along the cable from start to end, at both clamps; here it points backwards, or start "
        "and end are exchanged:",
        _turned(0.0, 0.0, np.pi),
    ),
    Mistake(
        "the clamp's frame in the world; here it seems to be the world's in the clamp, turn the "
        "signs of qx, qy, qz round:",
        _read("orientation", lambda q: np.multiply(q, [-1, -1, -1, 1])),
    ),
    Mistake("x along the cable; here the clamp's z axis does:", _turned(0.0, -np.pi / 2, 0.0)),
    Mistake("x along the cable; here the clamp's -z axis does:", _turned(0.0, np.pi / 2, 0.0)),
    Mistake("x along the cable; here the clamp's y axis does:", _turned(0.0, 0.0, np.pi / 2)),
    Mistake("x along the cable; here the clamp's -y axis does:", _turned(0.0, 0.0, -np.pi / 2)),
)

# ---- forces and moments -------------------------------------------------------------------------

_OTHER_SIGN = "with the other sign. Try: what the cable does to the fixture, not the fixture to it."
_IN_WORLD = "once turned from the clamp's axes into the world's"


def _in_unit(quantity: Quantity, size: float) -> Callable[[Readings], Readings | None]:
    return lambda readings: readings.scaled(1 / size) if readings.quantity is quantity else None


def _with_axes(axes: FloatArray) -> Callable[[ComparedReading], ComparedReading | None]:
    return lambda one: one.with_axes(axes)


# Of poses that nothing else shows: no size or frame is fitted.
READINGS_ALONE: tuple[Mistake[Readings], ...] = (
    Mistake(_OTHER_SIGN, lambda readings: readings.scaled(-1)),
    *(
        Mistake(f"once they are taken as {unit}. Try: divide by {size:g}.", _in_unit(own, size))
        for own in QUANTITIES
        for unit, size in own.others.items()
    ),
    Mistake(
        f"{_IN_WORLD}. Try: world axes, R f with the clamp's frame R.",
        lambda readings: readings.in_world(1),
    ),
    Mistake(
        f"{_IN_WORLD}, with the other sign. Try: -R f, with the clamp's frame R.",
        lambda readings: readings.in_world(-1),
    ),
)
READINGS: tuple[Mistake[ComparedReading], ...] = (
    Mistake(_OTHER_SIGN, lambda one: one.scaled(-1)),
    Mistake(
        f"{_IN_WORLD}. Try: world axes, R f with the clamp's frame R of each pose.",
        lambda one: one.in_world(1),
    ),
    Mistake(
        f"{_IN_WORLD}, with the other sign. Try: -R f, with the clamp's frame R.",
        lambda one: one.in_world(-1),
    ),
    Mistake(
        "once taken about a point {meant.how}, where the sensor may be. Try: moments about the "
        "fixture, M + (sensor - fixture) x F.",
        lambda one: one.about_elsewhere(),
    ),
    *(
        Mistake(
            f"once read as ({read_as(axes)}). Try: the axes of start and end.",
            _with_axes(axes),
            MUCH_BETTER,
        )
        for axes in AXES
        if not np.array_equal(axes, -np.eye(len(axes)))  # the other sign
    ),
    Mistake(
        "once all are turned by {meant.how} degrees. Try: the axes of start and end.",
        lambda one: one.turned(),
        MUCH_BETTER,
    ),
)

# ---- shapes -------------------------------------------------------------------------------------


def _exchanged(*keys: str) -> Callable[[FittedSession], FittedSession | None]:
    return lambda fitted: fitted.with_ends_exchanged(keys)


def _under(axes: FloatArray) -> Callable[[FittedSession], FittedSession | None]:
    return lambda fitted: fitted.under(axes)


def _about_start(axes: FloatArray) -> Callable[[FittedSession], FittedSession | None]:
    return lambda fitted: fitted.about_start(axes)


EXCHANGED_ENDS: tuple[Mistake[FittedSession], ...] = (
    Mistake("start and end exchanged", _exchanged("")),
    Mistake(
        "start and end exchanged, and their directions",
        _exchanged("", "_heading", "_orientation"),
    ),
)
GRAVITY: tuple[Mistake[FittedSession], ...] = (
    *(
        Mistake("gravity ({meant.gravity_listed}) m/s^2", _under(axes))
        for d in (2, 3)
        for axes in exchanges(d)
    ),
    *(Mistake(named(axes), _about_start(axes)) for axes in AXES),
)
