"""Declared directions of clamps beside those of the lines, and as they may have been meant."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from dlo_casadi.arrays import FloatArray
from dlo_casadi.config import Pose
from dlo_casadi.session.axes import axes_of, listed
from dlo_casadi.session.outcome import PoseInput
from dlo_casadi.session.read_session import ReadSession
from dlo_casadi.thresholds import FITS, HEADING_OFF

# A full turn [rad] with room for rounding; a declared heading beyond it needs a line that turns.
_TURN = 6.3
# Shares of the length: pieces whose direction is taken, and the part of the line used at an end.
_STEP, _PART = 0.02, 0.1
# Largest turn between two pieces of a line [rad]; beyond it the sense of rotation is unknown.
_TELLING = np.pi / 2


@dataclass(frozen=True)
class ShownDirection:
    """A declared clamp value, and the directions (n, d) that the line beside it allows.

    `turned` [rad]: heading of the line's last piece with all full turns, where turns are counted.
    """

    name: str
    key: str
    value: Any
    ways: FloatArray
    turned: float | None

    @property
    def off(self) -> float:
        """Angle [rad] between the value and the direction of the line."""
        angle = float(np.arccos(np.clip(self.ways @ axes_of(self.value)[:, 0], -1.0, 1.0)).min())
        return angle if self.turned is None else max(angle, abs(self.value - self.turned) - np.pi)

    @property
    def wrong(self) -> bool:
        """Whether the line contradicts the value."""
        return self.off > HEADING_OFF

    def __str__(self) -> str:
        way = self.ways[(self.ways @ axes_of(self.value)[:, 0]).argmax()]
        values, along = listed(self.value, ".3g"), f"({listed(way, '.2g')})"
        if np.ndim(self.value) == 0:
            values += " rad"
            angle = np.arctan2(way[1], way[0]) if self.turned is None else self.turned
            along = f"{angle:.3g} rad"
        side = self.key.split("_")[0]
        return (
            f"its {self.key} is {values}, the line {side}s at {along}, {np.degrees(self.off):.0f} "
            "degrees off it"
        )


@dataclass(frozen=True)
class Clamps:
    """Values of clamps of one kind, beside lines that show their directions."""

    shown: tuple[ShownDirection, ...]

    @property
    def kind(self) -> str:
        """What is declared: heading or orientation."""
        return self.shown[0].key.split("_")[1]

    @property
    def wrong(self) -> tuple[ShownDirection, ...]:
        """Those that their lines contradict."""
        return tuple(item for item in self.shown if item.wrong)

    def read(self, kind: str, value: Callable[[Any], Any]) -> "Clamps | None":
        """The same, if a function of the declared values was meant; None for another kind."""
        if self.kind != kind:
            return None
        return Clamps(tuple(replace(item, value=value(item.value)) for item in self.shown))


# ---- directions of lines ------------------------------------------------------------------------


def shown_directions(session: ReadSession, side: str) -> Iterator[ShownDirection]:
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
                yield ShownDirection(item.name, key, value, np.asarray(ways), turned)


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
