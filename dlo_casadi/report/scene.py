"""All poses of a session in space in one room: where the cable is pulled, where to hold it next."""

from __future__ import annotations

import numpy as np

from dlo_casadi.report.geometry import measured_line
from dlo_casadi.report.room import Mark, Room, common_room
from dlo_casadi.session.outcome import Outcome

# Half the size of the cross that marks a place, as a share of the cable's length.
_CROSS = 0.05


def scene_of(outcome: Outcome) -> tuple[Room, list[Mark]]:
    """A room about all poses, with its ground and the measured lines."""
    load = outcome.unexplained
    forces = np.zeros((0, 3)) if load is None else np.array(load["force_per_pose"], dtype=float)
    proposal = outcome.next_pose
    places = [] if proposal is None else [np.array([proposal["end"]])]
    room = common_room(outcome.config, outcome.poses, places, forces.reshape(-1, 3))
    measured = [pose.points for pose in outcome.poses if len(pose.points)]
    return room, room.ground() + [Mark("taken", room.points(points)) for points in measured]


def pull_marks(outcome: Outcome, room: Room) -> list[Mark]:
    """Where the cable is pulled (95 %), and the force in each fit pose."""
    load = outcome.unexplained
    assert load is not None
    names = load.get("poses") or [
        pose.name for pose in outcome.poses if pose.role == "fit" and len(pose.points)
    ]
    marks = []
    for name, force in zip(names, np.array(load["force_per_pose"], dtype=float), strict=False):
        line = measured_line(outcome, name)
        if line is None:
            continue
        places, points = line
        low, high = load["interval_95"]
        pulled = np.array([*np.linspace(low, high, 9), load["position"]])
        part = room.points(np.column_stack([np.interp(pulled, places, x) for x in points.T]))
        marks += [Mark("pulled", part[:-1]), Mark("pull", room.force(part[-1], force).points)]
    return marks


def next_marks(outcome: Outcome, room: Room) -> list[Mark]:
    """The ends of the poses that were taken, and the end to hold next."""
    assert outcome.next_pose is not None
    marks = []
    for pose in outcome.config.experiment.poses:
        for kind, place in (("start", pose.start), ("end", pose.end)):
            if place is not None:
                at = room.points(np.array(place))
                marks.append(Mark(f"fixture {kind}", np.concatenate([at, at + 0.1])))
    at = room.points(np.array(outcome.next_pose["end"]))
    size = _CROSS * room.length
    arms = size * np.concatenate(
        [[sign * axis, 0 * axis] for axis in np.eye(3) for sign in (1, -1)]
    )
    return [
        *marks,
        Mark("next", at + arms),
        Mark("next-letter", at + np.array([0.0, 0.0, 2 * size]), "next end"),
    ]
