"""A fitted cable in motion: its way under moving fixtures."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from numbers import Real
from typing import Any, Self

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from dlo_casadi.arrays import FloatArray
from dlo_casadi.cable.estimate import Estimate, EstimatedCable
from dlo_casadi.cable.held import HELD, held_pose
from dlo_casadi.cable.move_checks import number
from dlo_casadi.cable.saved import parameters_hash
from dlo_casadi.cable.shape_in_motion import ShapeInMotion, moving_cable
from dlo_casadi.cable.simulated import Motion, begun, on_the_mesh_of
from dlo_casadi.config import Clip
from dlo_casadi.effects import IN_MOTION
from dlo_casadi.equilibrium.pose import HeldPose
from dlo_casadi.equilibrium.solve import solve_equilibrium
from dlo_casadi.errors import DloError
from dlo_casadi.model.cable_model import DAMPING_TIME, CableModel
from dlo_casadi.motion.equations import motion_equations
from dlo_casadi.motion.path import FixturePath
from dlo_casadi.motion.segment import refuse_still
from dlo_casadi.motion.step_function import step_function
from dlo_casadi.motion.trajectory import TOLERANCE, way_of


class CableInMotion(EstimatedCable):
    """A fitted cable that moves."""

    def with_damping(self, damping_time: float | None = None, **effects: float) -> Self:
        """The cable with known values of what only its motion shows.

        Parameters
        ----------
        damping_time : float [s], optional
            tau of M = EI (kappa - kappa_0 + tau dkappa/dt).
        **effects : float
            Effects of motion by name, each with its only parameter: `air_drag=1.1`.

        Raises
        ------
        DloError
            If there is no such effect, if the cable has it already, or if a value is impossible.
        """
        known = dict(zip(self.model.names, self.p.tolist(), strict=True))
        model, added = self.model, {}
        labels = [effect.label for effect in model.effects]
        for name, value in {DAMPING_TIME: damping_time, **effects}.items():
            if value is None:
                continue
            if isinstance(value, bool) or not isinstance(value, Real):
                raise DloError(f"{name}: a number belongs here, found {value!r}")
            if name in labels or name in known:
                raise DloError(f"{name}: {self.name!r} has it already")
        if damping_time is not None:
            model = replace(model, cable=replace(model.cable, damping_time=float(damping_time)))
            added[DAMPING_TIME] = damping_time
        for name, value in effects.items():
            if name not in IN_MOTION:
                raise DloError(f"{name!r} is no effect of motion.\n  Try: {', '.join(IN_MOTION)}")
            effect = IN_MOTION[name]()
            (own,) = effect.parameters(model.cable)
            model, added[f"{name}.{own.name}"] = model.with_effect(effect), value
        for q in model.parameters:
            low, high = q.bounds(estimated=False)
            if q.name in added and not low <= float(added[q.name]) <= high:
                raise DloError(f"{q.name} lies between {low:g} and {high:g}, found {added[q.name]}")
        values = known | added
        units = {q.name: q.unit for q in model.parameters}
        new = {k: Estimate(float(x), 0.0, units[k], fixed=True) for k, x in added.items()}
        known_so_far = self.metadata
        document = _with_rows(known_so_far.document, model, added)
        params = {**known_so_far.params, **new}
        metadata = replace(
            known_so_far,
            params=params,
            document=document,
            model_hash=document["model_hash"],
        )
        p = np.array([values[name] for name in model.names])
        return replace(self, model=model, p=p, metadata=metadata)

    def motion_equations(self) -> ca.Function:
        """The equations of motion, for collocation in a problem of one's own.

        (x, v, a, multipliers, fixtures) -> residual. `Motion.unknowns` gives values of the first
        four at the end of each step.

        Returns
        -------
        casadi.Function
            x : (1 + 2 or 4 + 3, n_nodes), each node's heading [rad] or quaternion (x, y, z, w), and
            its place [m].
            v : (1 + 2 or 3 + 3, n_nodes), rates of turning about the node's own axes [rad/s], and
            velocities [m/s]: x(t + dt) = moved(x, v dt + a dt^2 / 2) to second order.
            a : likewise, their derivatives by time.
            multipliers : of the segments, one after the other, the force f_e [N], and of each
            spring its place [m] and force [N], zero on other segments; moments [N m] of the
            directions that the ends hold; forces [N] of the cable on the fixtures of start and end.
            fixtures : start, end [m], headings or quaternions of both; zeros where nothing is held.

            residual : balance of the moments and forces at the nodes (as v), conditions of the
            segments and their springs, directions and places at the ends, in space squares of the
            quaternions' lengths less one.
        """
        return motion_equations(moving_cable(self))

    def step(self, dt: float, *, about: ShapeInMotion | None = None) -> ca.Function:
        """One step in time, for `mapaccum`, multiple shooting or a planner of one's own.

        (state, fixtures) -> next, end_force, start_force, places. The method is that of `simulate`:
        generalised alpha, of second order. Derivatives of any order are exact, by the implicit
        function theorem. `Shape.at_rest` gives a first state and fixtures. The function is also
        generated as C (`step.generate`).

        Parameters
        ----------
        dt : float [s]
        about : Shape, optional
            The shape at rest from which changes count, if the cable is stiffer in motion; clips
            hold the cable as in this shape.

        Returns
        -------
        casadi.Function
            state : (N,), of each node, one after the other, heading [rad] or quaternion
            (x, y, z, w), place [m], rates of turning about its own axes [rad/s] and velocity [m/s],
            their derivatives by time, and the method's own ones, which lag behind these.
            fixtures : (K,), at the end of the step: start, end [m], headings or quaternions of
            both, velocities of start and end [m/s], accelerations of both [m/s^2]; zeros where
            nothing is held.

            next : (N,), the state dt later. Where a step has no solution, all outputs are NaN.
            end_force, start_force : (d,) [N], of the cable on what holds it.
            places : (d, n_nodes) [m], of the nodes dt later.

        Raises
        ------
        DloError
            If dt is no time, or if motion does not know a part of the cable.
        """
        if isinstance(dt, bool) or not isinstance(dt, Real) or not 0 < float(dt) < np.inf:
            raise DloError(f"dt: a time [s] above zero belongs here, found {dt!r}")
        if about is not None:
            if not isinstance(about, ShapeInMotion):
                raise DloError(f"about: a shape of cable.solve belongs here, found {about!r}")
            held = self.with_clips([clip.kind for clip in about.pose.clips])
            moving = moving_cable(held, (about.equilibrium, about.pose))
            return step_function(moving.about(about.equilibrium.x), float(dt))
        moving = moving_cable(self)
        if moving.segment.stiffens:
            raise DloError(
                "step: the stiffness in motion acts on changes from a shape at rest.\n"
                "  Try: cable.step(dt, about=shape)"
            )
        return step_function(moving, float(dt))

    def simulate(
        self,
        t: ArrayLike,
        *,
        start: ArrayLike | None = None,
        end: ArrayLike | None = None,
        start_heading: ArrayLike | None = None,
        end_heading: ArrayLike | None = None,
        start_orientation: ArrayLike | None = None,
        end_orientation: ArrayLike | None = None,
        clips: Sequence[Clip | Mapping[str, Any]] = (),
        begins: ShapeInMotion | Motion | None = None,
        tolerance: float = TOLERANCE,
    ) -> Motion:
        """The motion of the cable under moving fixtures, from rest.

        Parameters
        ----------
        t : (T,) [s]
            Times at which the motion is wanted, in order; it begins at the first one. Steps between
            them are chosen by their error.
        start, end : (d,) or (T, d) [m]
            Places of the fixtures, smooth between the times; otherwise as in `solve`.
        start_heading, end_heading : float or (T,) [rad]
        start_orientation, end_orientation : (4,) or (T, 4)
        clips : sequence of Clip or dict
            Clips between the ends, at rest: pinned, clamped or swivel.
        begins : Shape or Motion, optional
            The shape from which the cable is let go, with no velocity: of this cable or of another
            one of the same length, held in any way. Or a motion that is continued from its last
            state, held by the same clips or by none. By default the equilibrium at the first
            instant.
        tolerance : float
            Largest error of the places in one step over the length.

        Raises
        ------
        MotionError
            If a step has no solution, e.g. if an end is torn out of reach; it says when.
        EquilibriumError
            If the cable has no shape at the first instant.
        DloError
            If times or fixtures are no such arrays, or if motion does not know a part of the cable.
        """
        times, tolerance = times_of(t), number("tolerance", tolerance)
        asked: dict[str, Any] = {"start": start, "end": end}
        asked |= {"start_heading": start_heading, "end_heading": end_heading}
        asked |= {"start_orientation": start_orientation, "end_orientation": end_orientation}
        refuse_still(self.with_clips(()).model)
        pose, path = fixture_path(self, times, {**asked, "clips": clips})
        held = self.with_clips([clip.kind for clip in pose.clips])
        rest = solve_equilibrium(held.model, held.p, held.rest, pose)
        cable = moving_cable(held, (rest, pose))
        own, cable = cable.along, on_the_mesh_of(begins, cable)
        cable = cable.about(cable.model.node.interpolated(cable.along, own, rest.x))
        state = begun(held, cable, pose, rest, begins)
        way = way_of(cable, state, path, (times[0], times[-1]), tolerance)
        return Motion(held, times, way)


def fixture_path(
    cable: EstimatedCable, times: FloatArray, asked: Mapping[str, Any]
) -> tuple[HeldPose, FixturePath]:
    """The pose at the first of the times (T,) [s], and the way of fixtures from there.

    `asked`: places and directions as in `CableInMotion.simulate`. Raises DloError if they are none.
    """
    asked = dict(asked)
    clips = asked.pop("clips", ())
    rows = {key: _rows(key, x, len(times)) for key, x in asked.items() if x is not None}
    first = {key: (x[0] if x.ndim > 1 else x) for key, x in rows.items()}
    given = {**dict.fromkeys(HELD), "clips": clips}
    numbers = {k: float(x[0]) if k.endswith("heading") else x for k, x in first.items()}
    pose = held_pose(cable.model, cable.metadata.fixtures, {**given, "turns": 0.0, **numbers})
    direction = cable.model.node.direction
    moving = {key.replace(direction, "frame"): x for key, x in rows.items() if x.ndim > 1}
    return pose, FixturePath.of(pose, times, moving)


def times_of(t: ArrayLike) -> FloatArray:
    """Times in order, at least two."""
    try:
        times = np.asarray(t, dtype=float).ravel()
    except (TypeError, ValueError):
        raise DloError(f"t: times [s] belong here, found {t!r}") from None
    if len(times) < 2 or not np.isfinite(times).all() or (np.diff(times) <= 0).any():
        raise DloError("t: two times [s] or more, each later than the one before, belong here")
    return times


def _with_rows(
    document: dict[str, Any], model: CableModel, added: Mapping[str, float]
) -> dict[str, Any]:
    """The document of a cable with further parameters, all known."""
    data = {**document, "parameters": dict(document["parameters"])}
    for q in model.parameters:
        if q.name in added:
            lower, upper = (x if np.isfinite(x) else None for x in q.bounds(estimated=False))
            row = {"value": float(added[q.name]), "std": 0.0, "unit": q.unit, "lower": lower}
            data["parameters"][q.name] = {**row, "upper": upper, "fitted": False}
    labels = {effect["label"] for effect in document["effects"]}
    own = [effect for effect in model.effects if effect.label not in labels]
    data["effects"] = [*document["effects"], *({"name": x.name, "label": x.label} for x in own)]
    if DAMPING_TIME in added:
        data["cable"] = {**document["cable"], DAMPING_TIME: float(added[DAMPING_TIME])}
    data["model_hash"] = parameters_hash(data)
    return data


def _rows(key: str, values: ArrayLike, count: int) -> FloatArray:
    """Values of a fixture, one row (k,) or a row for each time (T, k)."""
    try:
        rows = np.asarray(values, dtype=float)
    except (TypeError, ValueError):
        raise DloError(f"{key}: numbers belong here, found {values!r}") from None
    if key.endswith("heading"):
        rows = rows[..., None]
    if rows.ndim not in (1, 2) or (rows.ndim == 2 and len(rows) != count):
        raise DloError(
            f"{key}: one row, or one for each of {count} times belongs here, found the shape "
            f"{np.shape(values)}"
        )
    if not np.isfinite(rows).all():
        raise DloError(f"{key}: not all its numbers are finite")
    return rows
