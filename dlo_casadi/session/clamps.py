"""Find mistakes about clamps: their declared directions."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from dlo_casadi.arrays import FloatArray
from dlo_casadi.config import Pose
from dlo_casadi.errors import counted
from dlo_casadi.session.hypotheses import (
    Hypothesis,
    ReadSession,
    Suspicion,
    axes_of,
    likeliest,
    listed,
)
from dlo_casadi.session.outcome import PoseInput
from dlo_casadi.thresholds import (
    FITS,
    HEADING_NEAR,
    HEADING_OFF,
    NEARLY_ALL,
)

# A full turn [rad] with room for rounding; a declared heading beyond it needs a line that turns.
_TURN = 6.3
# Shares of the length: pieces whose direction is taken, and the part of the line used at an end.
_STEP, _PART = 0.02, 0.1
# Largest turn between two pieces of a line [rad]; beyond it the sense of rotation is unknown.
_TELLING = np.pi / 2


def _turned(*vector: float) -> Callable[[Any], FloatArray]:
    return lambda q: (Rotation.from_quat(q) * Rotation.from_rotvec(vector)).as_quat()


# What the user may have meant -> the value that a declared number then has.
_MEANT: Mapping[str, Mapping[str, Callable[[Any], Any]]] = {
    "heading": {
        "in degrees?": np.radians,
        "headings point along the cable from its start to its end:": lambda angle: angle - np.pi,
        "counter-clockwise is positive:": lambda angle: -angle,
    },
    "orientation": {
        "w last, [qx, qy, qz, qw]; here w seems to stand first:": lambda q: np.roll(q, -1),
        "x along the cable from start to end, at both clamps; here it points backwards, or start "
        "and end are exchanged:": _turned(0.0, 0.0, np.pi),
        "the clamp's frame in the world; here it seems to be the world's in the clamp, turn the "
        "signs of qx, qy, qz round:": lambda q: np.multiply(q, [-1, -1, -1, 1]),
        "x along the cable; here the clamp's z axis does:": _turned(0.0, -np.pi / 2, 0.0),
        "x along the cable; here the clamp's -z axis does:": _turned(0.0, np.pi / 2, 0.0),
        "x along the cable; here the clamp's y axis does:": _turned(0.0, 0.0, np.pi / 2),
        "x along the cable; here the clamp's -y axis does:": _turned(0.0, 0.0, -np.pi / 2),
    },
}
_RULE = {
    "heading": "headings in radians, counter-clockwise from x, along the cable",
    "orientation": "unit quaternions [qx, qy, qz, qw], x along the cable; start and end exchanged",
}


# ---- directions ---------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Shown:
    """A declared clamp value, and the directions (n, d) that the line beside it allows.

    `turned` [rad]: heading of the line's last piece with all full turns, where turns are counted.
    """

    name: str
    key: str
    value: Any
    ways: FloatArray
    turned: float | None

    @property
    def kind(self) -> str:
        """What is declared: heading or orientation."""
        return self.key.split("_")[1]

    def off(self, value: Any) -> float:
        """Angle [rad] between a value of the key and the direction of the line."""
        angle = float(np.arccos(np.clip(self.ways @ axes_of(value)[:, 0], -1.0, 1.0)).min())
        return angle if self.turned is None else max(angle, abs(value - self.turned) - np.pi)

    @property
    def wrong(self) -> bool:
        return self.off(self.value) > HEADING_OFF

    def __str__(self) -> str:
        way = self.ways[(self.ways @ axes_of(self.value)[:, 0]).argmax()]
        values, along = listed(self.value, ".3g"), f"({listed(way, '.2g')})"
        if np.ndim(self.value) == 0:
            values += " rad"
            angle = np.arctan2(way[1], way[0]) if self.turned is None else self.turned
            along = f"{angle:.3g} rad"
        off = np.degrees(self.off(self.value))
        side = self.key.split("_")[0]
        return f"its {self.key} is {values}, the line {side}s at {along}, {off:.0f} degrees off it"


def wrong_directions(session: ReadSession) -> tuple[Suspicion, ...]:
    """Headings and orientations that the lines contradict, in single poses or in most of them."""
    found: list[Suspicion] = []
    common: list[_Shown] = []
    for side in ("start", "end"):
        shown = list(_shown(session, side))
        wrong = [item for item in shown if item.wrong]
        if wrong and (2 * len(wrong) > len(shown) or (len(wrong) > 1 and _meant(shown))):
            common += shown
            continue
        found += [Suspicion.of_pose(item.name, f"{item}{_try([item])}") for item in wrong]
    if common:
        wrong = [item for item in common if item.wrong]
        keys = list(dict.fromkeys(item.key for item in common))
        text = (
            f"{' and '.join(keys)} contradict{'s' * (len(keys) == 1)} {len(wrong)} of "
            f"{counted(len(common), 'line')}. {wrong[0].name}: {wrong[0]}{_try(common)}"
        )
        # A frame is certainly wrong only where another reading of its value explains the lines.
        certain = wrong[0].kind == "heading" or bool(_meant(common))
        found.insert(0, Suspicion(text, certain))
    return tuple(found)


def _meant(shown: Sequence[_Shown]) -> str:
    """What the declared values may have meant, if one meaning explains nearly all of them."""
    found = likeliest(
        (Hypothesis(*item) for item in _MEANT[shown[0].kind].items()),
        lambda meant: np.quantile([item.off(meant(item.value)) for item in shown], NEARLY_ALL),
        HEADING_NEAR,
        near=1.0,
    )
    return "" if found is None else found[0].said


def _try(shown: Sequence[_Shown]) -> str:
    """What to try, taken from the first pose that is wrong."""
    item = next(item for item in shown if item.wrong)
    best = _meant(shown) or _meant([item])
    if not best:
        return f". Try: {_RULE[item.kind]}."
    return f". Try: {best} then {listed(_MEANT[item.kind][best](item.value), '.4g')}."


def _shown(session: ReadSession, side: str) -> Iterator[_Shown]:
    """Directions of the lines at the clamps of one side, where the lines determine them."""
    cable, experiment = session.config.cable, session.config.experiment
    if not getattr(experiment.boundary, side).direction:
        return
    weight = cable.prior_mass * float(np.linalg.norm(experiment.gravity))
    layer = np.sqrt(cable.prior_bending_stiffness / max(weight, 1e-12))
    # The weight bends the cable by 1 / layer beside a clamp: a quarter radian within half a layer.
    reach = min(layer / 2, _PART * cable.length)
    for item in session.read:
        pose = session.declared[item.name]
        for key in (f"{side}_heading", f"{side}_orientation"):
            value = getattr(pose, key)
            ways = [] if value is None else _ways(pose, item, side, cable.length, reach)
            if len(ways):
                # Behind a pinned start no turns are counted: full turns mean nothing there.
                turns = experiment.boundary.start.direction and key == "end_heading"
                far = turns and abs(value) > _TURN
                turned = _turned_to(pose, item.points, cable.length) if far else None
                yield _Shown(item.name, key, value, np.asarray(ways), turned)


def _ways(
    pose: Pose, item: PoseInput, side: str, length: float, reach: float
) -> Sequence[FloatArray]:
    """Directions (d,) that a line may have at its clamp, from start to end.

    Empty where the line begins too far from the fixture, or where its first piece (between
    sparse points) ends farther than `reach` [m] from it. Markers begin at the fixture, whose place
    is inexact, so that the second piece is used as well.
    """
    sign, place = (1 if side == "start" else -1), np.array(getattr(pose, side))
    inward = item.points[::sign]
    if item.s is not None:
        inward = np.vstack([place, inward])
    before = float(np.linalg.norm(inward[0] - place))
    pieces = _pieces(inward, _STEP * length)
    if before > FITS * length or not len(pieces):
        return []
    size = np.linalg.norm(pieces, axis=1)
    s = np.cumsum(size) - size / 2
    # The chord of a loop is short: pieces are a share of the cable's length instead.
    if before + size[0] * max(1.0, length / (s[0] + s[-1])) > reach:
        return []
    tangents = sign * pieces / size[:, None]
    near = s < max(_PART * length, s[min(2, len(s) - 1)] + 1e-12)
    fitted = np.polyfit(s[near] + before, tangents[near], min(1, near.sum() - 1))
    ways = [*tangents[near][:2], fitted[-1], fitted[-1] + s[0] * fitted[0]]
    return [way / np.linalg.norm(way) for way in ways]


def _turned_to(pose: Pose, points: FloatArray, length: float) -> float | None:
    """Heading [rad] at the end of a line, full turns included; None if it is unknown."""
    assert pose.start_heading is not None
    pieces = _pieces(points, _STEP * length)
    heading = np.unwrap(np.arctan2(pieces[:, 1], pieces[:, 0]))
    if np.abs(np.diff(heading)).max(initial=0.0) > _TELLING:
        return None
    turns = round((pose.start_heading - heading[0]) / (2 * np.pi))
    return float(heading[-1] + 2 * np.pi * turns)


def _pieces(points: FloatArray, step: float) -> FloatArray:
    """Steps (n, d) between points at least `step` [m] apart: shorter ones show noise."""
    kept = [0]
    for k in range(1, len(points)):
        if np.linalg.norm(points[k] - points[kept[-1]]) >= step:
            kept.append(k)
    return np.asarray(np.diff(points[kept], axis=0))
