"""Declared directions of clamps held against those of the measured lines there."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from dlo_casadi.config import Config, Pose
from dlo_casadi.errors import counted
from dlo_casadi.session.frames import axes_of
from dlo_casadi.session.outcome import PoseInput
from dlo_casadi.session.plausibility import Suspicion
from dlo_casadi.thresholds import FITS, HEADING_NEAR, HEADING_OFF, NEARLY_ALL

FloatArray = NDArray[np.floating]

# A full turn [rad], as somebody may round it; beyond it the line itself must turn so far.
_TURN = 6.3
# Of the length: pieces of which the direction is taken, and the part at an end that is used.
_STEP, _PART = 0.02, 0.1
# Between two pieces a line must turn by less, or nobody knows which way round [rad].
_TELLING = np.pi / 2


def _turned(*vector: float) -> Callable[[Any], FloatArray]:
    return lambda q: (Rotation.from_quat(q) * Rotation.from_rotvec(vector)).as_quat()


# What a declared value may have been meant as -> the value that it then is.
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


@dataclass(frozen=True)
class _Shown:
    """A clamp's declared value, and the directions (n, d) that the line beside it may have.

    `turned` [rad] is the heading of the line's last piece with all its turns, where it counts.
    """

    name: str
    key: str
    value: Any
    ways: FloatArray
    turned: float | None

    def off(self, value: Any) -> float:
        """Angle [rad] of a value of the key from what the line shows."""
        angle = float(np.arccos(np.clip(self.ways @ axes_of(value)[:, 0], -1.0, 1.0)).min())
        return angle if self.turned is None else max(angle, abs(value - self.turned) - np.pi)

    def __str__(self) -> str:
        way = self.ways[(self.ways @ axes_of(self.value)[:, 0]).argmax()]
        values = ", ".join(f"{x:.3g}" for x in np.atleast_1d(self.value))
        along = f"({', '.join(f'{x:.2g}' for x in way)})"
        if np.ndim(self.value) == 0:
            values += " rad"
            angle = np.arctan2(way[1], way[0]) if self.turned is None else self.turned
            along = f"{angle:.3g} rad"
        off = np.degrees(self.off(self.value))
        side = self.key.split("_")[0]
        return f"its {self.key} is {values}, the line {side}s at {along}, {off:.0f} degrees off it"


def wrong_directions(config: Config, read: Sequence[PoseInput]) -> tuple[Suspicion, ...]:
    """Headings and orientations that the lines contradict: of single poses, or of most of them."""
    found: list[Suspicion] = []
    common: list[_Shown] = []
    for side in ("start", "end"):
        shown = _shown(config, read, side)
        wrong = [item for item in shown if item.off(item.value) > HEADING_OFF]
        if wrong and (2 * len(wrong) > len(shown) or (len(wrong) > 1 and _meant(shown))):
            common += shown
            continue
        found += [Suspicion.of_pose(item.name, f"{item}{_try([item])}") for item in wrong]
    if common:
        wrong = [item for item in common if item.off(item.value) > HEADING_OFF]
        keys = list(dict.fromkeys(item.key for item in common))
        text = (
            f"{' and '.join(keys)} contradict{'s' * (len(keys) == 1)} {len(wrong)} of "
            f"{counted(len(common), 'line')}. {wrong[0].name}: {wrong[0]}{_try(common)}"
        )
        # A frame is certainly wrong only where another reading of it explains the lines.
        certain = np.ndim(wrong[0].value) == 0 or bool(_meant(common))
        found.insert(0, Suspicion(text, certain))
    return tuple(found)


def _meant(shown: Sequence[_Shown]) -> str:
    """What values may have been meant as, if that explains nearly all of them."""
    meant = _MEANT[shown[0].key.split("_")[1]]
    off = {
        text: np.quantile([item.off(value(item.value)) for item in shown], NEARLY_ALL)
        for text, value in meant.items()
    }
    best = min(off, key=lambda text: float(off[text]))
    return best if off[best] < HEADING_NEAR else ""


def _try(shown: Sequence[_Shown]) -> str:
    """What to try, in the first pose that is wrong."""
    item = next(item for item in shown if item.off(item.value) > HEADING_OFF)
    kind = item.key.split("_")[1]
    best = _meant(shown) or _meant([item])
    if not best:
        return f". Try: {_RULE[kind]}."
    value = ", ".join(f"{x:.4g}" for x in np.atleast_1d(_MEANT[kind][best](item.value)))
    return f". Try: {best} then {value}."


def _shown(config: Config, read: Sequence[PoseInput], side: str) -> list[_Shown]:
    """What the lines show at the clamps of one side, where they show it."""
    cable, experiment = config.cable, config.experiment
    if getattr(experiment.boundary, side) != "clamped":
        return []
    weight = cable.prior_mass * float(np.linalg.norm(experiment.gravity))
    layer = np.sqrt(cable.prior_bending_stiffness / max(weight, 1e-12))
    # The weight bends it by 1 / layer beside a clamp: within half of that by a quarter of a radian.
    reach = min(layer / 2, _PART * cable.length)
    poses = {pose.name: pose for pose in experiment.poses}
    shown = []
    for item in read:
        pose = poses[item.name]
        for key in (f"{side}_heading", f"{side}_orientation"):
            value = getattr(pose, key)
            ways = [] if value is None else _ways(pose, item, side, cable.length, reach)
            if len(ways):
                end = key == "end_heading" and abs(value) > _TURN
                turned = _turned_to(pose, item.points, cable.length) if end else None
                shown.append(_Shown(item.name, key, value, np.asarray(ways), turned))
    return shown


def _ways(
    pose: Pose, item: PoseInput, side: str, length: float, reach: float
) -> Sequence[FloatArray]:
    """Directions (d,) that a line may have at its clamp, from start to end.

    None where it begins too far from the fixture to tell, or its first piece, between points far
    apart, ends farther than `reach` [m] from it. Markers begin at the fixture, which may be a
    little elsewhere: the second piece counts, too.
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
    # Of a loop the chord is short: pieces share the cable's length.
    if before + size[0] * max(1.0, length / (s[0] + s[-1])) > reach:
        return []
    tangents = sign * pieces / size[:, None]
    near = s < max(_PART * length, s[min(2, len(s) - 1)] + 1e-12)
    fitted = np.polyfit(s[near] + before, tangents[near], min(1, near.sum() - 1))
    ways = [*tangents[near][:2], fitted[-1], fitted[-1] + s[0] * fitted[0]]
    return [way / np.linalg.norm(way) for way in ways]


def _turned_to(pose: Pose, points: FloatArray, length: float) -> float | None:
    """Heading [rad] at the end of a line, with as many turns as it makes, if its points tell."""
    pieces = _pieces(points, _STEP * length)
    heading = np.unwrap(np.arctan2(pieces[:, 1], pieces[:, 0]))
    if np.abs(np.diff(heading)).max(initial=0.0) > _TELLING:
        return None
    begin = heading[0] if pose.start_heading is None else pose.start_heading
    turns = round((begin - heading[0]) / (2 * np.pi))
    return float(heading[-1] + 2 * np.pi * turns)


def _pieces(points: FloatArray, step: float) -> FloatArray:
    """Steps (n, d) between points at least `step` [m] apart: noise turns shorter ones."""
    kept = [0]
    for k in range(1, len(points)):
        if np.linalg.norm(points[k] - points[kept[-1]]) >= step:
            kept.append(k)
    return np.asarray(np.diff(points[kept], axis=0))
