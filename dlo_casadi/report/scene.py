"""All poses of a session in one place: where the cable is pulled, where to hold it next."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dlo_casadi.report.arrows import arrow
from dlo_casadi.report.geometry import measured_line
from dlo_casadi.report.room import Mark, Room, common_room
from dlo_casadi.session.outcome import Outcome

FloatArray = NDArray[np.floating]

# Half the size of the cross that marks a place, as a share of the cable's length.
_CROSS = 0.05
# The longest arrow in a plane, as a share of the cable's length.
_LONGEST = 0.25
# Points of a measured line that are drawn, about.
_POINTS = 60


@dataclass(frozen=True)
class Board:
    """The plane of a cable, in which marks are placed as in a `Room`, in metres.

    Parameters
    ----------
    length : float [m]
        Of the cable.
    newton : float [m/N]
        How long a force is drawn.
    markers : (K, 5, 2) [m]
        Outlines of the squares printed on it.
    """

    length: float
    newton: float
    markers: FloatArray
    window: None = None  # as large as what is drawn

    def points(self, points: FloatArray) -> FloatArray:
        """Points (K, 2) [m], or one of them, as they are."""
        return points.reshape(-1, 2)

    def force(self, at: FloatArray, force: FloatArray) -> Mark:
        """A force (2,) [N] as an arrow from a place (2,) [m]."""
        return Mark("force", arrow(at, self.newton * force))

    def ground(self) -> list[Mark]:
        """The markers."""
        return [Mark("marker", outline) for outline in self.markers]


def scene_of(outcome: Outcome) -> tuple[Room | Board, list[Mark]]:
    """A place for all poses, with its ground and the measured lines."""
    load = outcome.unexplained
    pulls = np.zeros(0) if load is None else load.force_per_pose
    place: Room | Board
    if outcome.config.experiment.in_space:
        proposal = outcome.next_pose
        ends = [] if proposal is None else [np.array([proposal.end])]
        place = common_room(outcome.config, outcome.poses, ends, pulls.reshape(-1, 3))
    else:
        place = _board(outcome, pulls.reshape(-1, 2))
    measured = [pose.points for pose in outcome.poses if len(pose.points)]
    lines = [place.points(points[:: max(1, len(points) // _POINTS)]) for points in measured]
    return place, place.ground() + [Mark("taken", line) for line in lines]


def _board(outcome: Outcome, pulls: FloatArray) -> Board:
    length = outcome.config.cable.length
    largest = float(np.hypot(*pulls.T).max(initial=0.0))
    printed = getattr(outcome.config.experiment.measurement, "board", None)
    markers = np.zeros((0, 1, 2))
    if printed is not None:
        centers = np.array(list(printed.marker_centers.values()))
        square = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1], [-1, -1]]) / 2
        markers = centers[:, None] + printed.marker_size * square
    return Board(length, _LONGEST * length / max(largest, 1e-12), markers)


def pull_marks(outcome: Outcome, place: Room | Board) -> list[Mark]:
    """Where the cable is pulled (95 %), and the force in each fit pose."""
    load = outcome.unexplained
    assert load is not None
    marks = []
    for name, force in zip(load.poses, load.force_per_pose, strict=True):
        line = measured_line(outcome, name)
        if line is None:
            continue
        places, points = line
        pulled = np.array([*np.linspace(*load.interval, 9), load.position])
        part = place.points(np.column_stack([np.interp(pulled, places, x) for x in points.T]))
        marks += [Mark("pulled", part[:-1]), Mark("pull", place.force(part[-1], force).points)]
    return marks


def next_marks(outcome: Outcome, place: Room | Board) -> list[Mark]:
    """The ends of the poses that were taken, and the end to hold next."""
    assert outcome.next_pose is not None
    marks = []
    for pose in outcome.config.experiment.poses:
        for kind, held in (("start", pose.start), ("end", pose.end)):
            if held is not None:
                at = place.points(np.array(held))
                marks.append(
                    Mark(f"fixture {kind}", np.concatenate([at, at + 1e-3 * place.length]))
                )
    at = place.points(np.array(outcome.next_pose.end))
    size, axes = _CROSS * place.length, np.eye(at.shape[1])
    arms = size * np.concatenate([[sign * axis, 0 * axis] for axis in axes for sign in (1, -1)])
    return [
        *marks,
        Mark("next", at + arms),
        Mark("next-letter", at + 2 * size * axes[-1], "next end"),
    ]
