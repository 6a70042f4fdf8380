"""Limits of a motion: at rest in its poses, and along its way."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from dlo_casadi.arrays import FloatArray
from dlo_casadi.cable.simulated import Motion
from dlo_casadi.errors import DloError
from dlo_casadi.planning.course import Course
from dlo_casadi.planning.predicted import curvatures, held_moments
from dlo_casadi.planning.problem import CLEAR, FIXTURES


def require_rest(
    cable: Any, name: str, shape: Any, limits: Mapping[str, float], obstacles: Sequence[Any]
) -> None:
    """Raise an error if the cable at rest in the pose of that name does not keep a limit."""
    forces = [float(np.linalg.norm(x)) for x in (shape.start_force, shape.end_force)]
    found = {"force": max(forces), "bend_radius": shape.min_bend_radius}
    radius = cable.model.cable.diameter / 2
    near = [float(x.near(shape.points).distance.min()) - radius for x in obstacles]
    found |= {"clearance": min(near)} if near else {}
    for limit, value in found.items():
        least = limit != "force"
        if limit in limits and (value < limits[limit] if least else value > limits[limit]):
            raise DloError(
                f"move: at rest in the pose {name!r} the cable's {limit} is {value:.4g}, "
                f"{'less' if least else 'more'} than the limit of {limits[limit]:g}: no motion "
                "keeps it.\n  Try: another pose, or another limit"
            )


def used_along(
    course: Course,
    theta: FloatArray,
    motion: Motion,
    limits: Mapping[str, float],
    obstacles: Sequence[Any],
) -> dict[str, float]:
    """Largest used share of each limit.

    Fixtures, forces and clearances every millisecond; moments and curvatures at the ends of the
    simulation's steps.
    """
    t, way, length = np.arange(0.0, motion.t[-1], 1e-3), motion.way, motion.cable.length
    used: dict[str, float] = {}
    for name, (turns, order) in FIXTURES.items():
        if name in limits:
            rows = course.values(theta, t, order)
            sizes = [
                float(np.linalg.norm(rows[:, own], axis=1).max())
                for part, own in zip(course.parts, course.columns, strict=True)
                if part.turns == turns
            ]
            used[name] = max(sizes, default=0.0) / limits[name]
    if "force" in limits:
        sizes = [float(np.linalg.norm(way.at(t, x), axis=1).max()) for x in way.forces]
        used["force"] = max(sizes) / limits["force"]
    if "moment" in limits:
        held = np.array([held_moments(way.cable, x.moment) for x in way.states])
        used["moment"] = float(np.linalg.norm(held, axis=2).max()) / limits["moment"]
    if "bend_radius" in limits:
        bent = np.array([curvatures(way.cable, x)[0] for x in way.states])
        used["bend_radius"] = float(np.linalg.norm(bent, axis=2).max()) * limits["bend_radius"]
    if "clearance" in limits:
        points, radius = way.points(t, motion.s), motion.cable.model.cable.diameter / 2
        gap = min(float(x.near(points).distance.min()) for x in obstacles) - radius
        # As in the plan: 1 at the limit, and one more for each twentieth of the length.
        used["clearance"] = 1 + (limits["clearance"] - gap) / (CLEAR * length)
    return used
