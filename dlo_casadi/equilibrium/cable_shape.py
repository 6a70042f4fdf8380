"""The shape of a fitted cable in one pose."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dlo_casadi.effects import MeasurementEffect
from dlo_casadi.equilibrium.curve import NodeCurve
from dlo_casadi.equilibrium.equilibrium import Equilibrium
from dlo_casadi.equilibrium.fitted_cable import FittedCable
from dlo_casadi.equilibrium.pose import Pose
from dlo_casadi.equilibrium.solve import solve_equilibrium
from dlo_casadi.equilibrium.spread import EDGE, displacements, spread_across
from dlo_casadi.equilibrium.tipping import Tipping, sides_of, tipping_of
from dlo_casadi.errors import DloError, EquilibriumError, counted
from dlo_casadi.model.assembly import Inputs, assembly_of
from dlo_casadi.model.cable_model import CableModel

FloatArray = NDArray[np.floating]

# Arc lengths may miss the cable by so many of its lengths: rounding.
_ROUNDING = 1e-9


class CableCurve(NodeCurve):
    """A cable from its start at s = 0 to its end at s = L = `length` [m]."""

    def at(self, s: ArrayLike, derivative: int = 0) -> FloatArray:
        """Positions (K, d) [m] at arc lengths s (K,) [m] in [0, L], or derivatives by s.

        Raises
        ------
        DloError
            If an arc length lies outside the cable.
        """
        try:
            places = np.atleast_1d(np.asarray(s, dtype=float)).ravel()
        except (TypeError, ValueError):
            raise DloError(f"s: arc lengths [m] belong here, found {s!r}") from None
        slack = _ROUNDING * self.length
        outside = places[~((places >= -slack) & (places <= self.length + slack))]
        if len(outside):
            raise DloError(
                f"s = {outside[0]:g} m is not on the cable: {len(outside)} of "
                f"{counted(len(places), 'arc length')} lie outside 0 to {self.length:g} m.\n"
                "  Try: arc lengths in metres from the start."
            )
        return super().at(np.clip(places, 0.0, self.length), derivative)


@dataclass(frozen=True)
class CableShape:
    """A fitted cable in one pose.

    Parameters
    ----------
    cable : FittedCable
        The fitted cable.
    pose : Pose
        How its ends are held; where the cable may hang on either side, with the `turns` or the
        `branch` of this one.
    equilibrium : Equilibrium
        Nodes, reactions, energy and stability.
    curve : CableCurve
        The cable itself, at any arc length: `curve.at(s)`.
    seen : CableCurve
        The same as the session's camera would measure it.
    other_side : CableShape or None
        The same pose on the other side: between two clamps in space twisted the other way round,
        of a free end fallen to the other side. Only where the uncertain parameters and fixtures do
        not tell which side is the lower one, and the pose does not name its side.
    tipping : Tipping or None
        How near the clamp then is to where both are equally low.
    """

    cable: FittedCable
    pose: Pose
    equilibrium: Equilibrium
    curve: CableCurve
    seen: CableCurve
    other_side: CableShape | None = None
    tipping: Tipping | None = None

    def band(self, count: int = 101) -> FloatArray:
        """Half width (count,) [m] of the band across the cable that holds 90 % of next hangings.

        Uncertain parameters, scatter of the fixtures and how the cable repeats; first order.
        """
        model, p, rest, metadata = self.cable
        s = np.linspace(0.0, self.curve.length, count)
        known = metadata.uncertainty
        curve, moved = displacements(model, p, rest, self.pose, self.equilibrium, known, s)
        return np.asarray(EDGE * np.linalg.norm(spread_across(curve, s, moved), axis=1))

    def points(self, count: int = 101) -> FloatArray:
        """Points (count, d) [m] evenly spaced along the cable, from start to end.

        Raises
        ------
        DloError
            If fewer than two are asked for.
        """
        if not isinstance(count, int | np.integer) or count < 2:
            raise DloError(f"count: two points or more, from start to end, found {count!r}")
        return self.curve.at(np.linspace(0.0, self.curve.length, count))

    def as_dict(self, count: int = 101) -> dict[str, Any]:
        """Everything a program may want to know, as plain data in SI units."""
        eq, pose = self.equilibrium, self.pose
        directions: dict[str, Any] = {
            "start_heading": pose.start_heading,
            "end_heading": pose.end_heading,
        }
        if self.cable.model.in_space:
            directions = {
                "start_orientation": _listed(pose.start_orientation),
                "end_orientation": _listed(pose.end_orientation),
                "turns": pose.turns,
            }
        return {
            "cable": self.cable.model.cable.name,
            "model_hash": self.cable.metadata.model_hash,
            "length": self.cable.model.cable.length,
            "start": list(pose.start),
            "end": _listed(pose.end),
            **directions,
            "branch": pose.branch,
            "status": eq.status.name.lower(),
            "stable": eq.stable,
            "energy": eq.energy,
            "force_on_start": eq.lam_start.tolist(),
            "force_on_end": eq.lam.tolist(),
            "moment_on_start": eq.moments[0].tolist(),
            "moment_on_end": eq.moments[1].tolist(),
            "min_bend_radius": eq.min_bend_radius,
            "points": self.points(count).tolist(),
            "band_90": self.band(count).tolist(),
            "other_side": self._other_side(count),
        }

    def _other_side(self, count: int) -> dict[str, Any] | None:
        """The other side as plain data, with its greatest distance [m] from this one."""
        other, near = self.other_side, self.tipping
        if other is None or near is None:
            return None
        apart = np.linalg.norm(other.points(count) - self.points(count), axis=1)
        shape = other.as_dict(count)
        del shape["other_side"]
        return {
            "tipping": near.angle,
            "tipping_std": near.std,
            "greatest_distance": float(apart.max()),
            **shape,
        }


def _listed(values: tuple[float, ...] | None) -> list[float] | None:
    return None if values is None else list(values)


def shape_in(cable: FittedCable, pose: Pose) -> CableShape:
    """Solve a pose of a fitted cable; where it may hang on either side, for both.

    Raises
    ------
    EquilibriumError
        If the pose has no equilibrium, e.g. because the end is out of reach, or none is found on
        the branch.
    """
    model, p, rest, metadata = cable
    try:
        eq = solve_equilibrium(model, p, rest, pose)
    except EquilibriumError as error:
        # What the solver advises concerns a configuration; there is none here.
        happened = error.message.partition("\n  Try:")[0]
        other = "orientations, fewer turns" if model.in_space else "headings or branch"
        raise EquilibriumError(
            f"{happened}\n  Try: an end in metres, nearer to the start; other {other}.",
            p_des=error.p_des,
        ) from None

    def shape(pose: Pose, eq: Equilibrium) -> CableShape:
        true, seen = (curve(model, p, rest, pose, eq) for curve in (_true_curve, _curve))
        return CableShape(cable, pose, eq, true, seen)

    beyond = eq.other_side
    if beyond is None:
        return shape(pose, eq)
    near = tipping_of(model, p, rest, pose, eq, beyond, metadata.uncertainty)
    if not near.either:
        return shape(pose, eq)
    own, others = sides_of(model, pose, eq, beyond)
    return replace(shape(own, eq), other_side=shape(others, beyond), tipping=near)


def _curve(
    model: CableModel, p: FloatArray, rest: FloatArray, pose: Pose, eq: Equilibrium
) -> CableCurve:
    """The curve as the session's camera would measure it."""
    z = assembly_of(model).curve(eq.shapes, Inputs.of(p, rest, pose.vector[None]))[0]
    return CableCurve.of(model.cable.length, z)


def _true_curve(
    model: CableModel, p: FloatArray, rest: FloatArray, pose: Pose, eq: Equilibrium
) -> CableCurve:
    """The curve itself: the same model without what the camera adds."""
    seen = [effect for effect in model.effects if isinstance(effect, MeasurementEffect)]
    if not seen:
        return _curve(model, p, rest, pose, eq)
    true = replace(
        model, effects=tuple(effect for effect in model.effects if effect not in seen), priors={}
    )
    values = dict(zip(model.names, p, strict=True))
    return _curve(true, np.array([values[name] for name in true.names]), rest, pose, eq)
