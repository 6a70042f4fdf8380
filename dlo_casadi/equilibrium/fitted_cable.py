"""A fitted cable with the uncertainty of its parameters, and its shape in one pose."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple, Self

import numpy as np
from numpy.typing import ArrayLike

from dlo_casadi.arrays import FloatArray
from dlo_casadi.effects import MeasurementEffect
from dlo_casadi.equilibrium.curve import NodeCurve
from dlo_casadi.equilibrium.equilibrium import Equilibrium
from dlo_casadi.equilibrium.pose import HeldPose
from dlo_casadi.equilibrium.solve import solve_equilibrium
from dlo_casadi.equilibrium.spread import (
    EDGE,
    Tipping,
    Uncertainty,
    displacements,
    sides_of,
    spread_across,
    tipping_of,
)
from dlo_casadi.errors import DloError, EquilibriumError, counted
from dlo_casadi.model.assembly import Inputs, assembly_of
from dlo_casadi.model.cable_model import CableModel
from dlo_casadi.rod.node import Heading

# Rounding error allowed in arc lengths beyond the ends, as a share of the length.
_ROUNDING = 1e-9


@dataclass(frozen=True)
class Metadata:
    """Contents of a parameters.yaml beside the model.

    Parameters
    ----------
    path : Path
    names : tuple of str
        Fitted parameters, in the order of `covariance`.
    covariance : (N, N)
        In the products of the parameters' units.
    uncertainty : Uncertainty
        The same with the scatter from pose to pose.
    std : dict
        Standard deviation of each parameter by name [SI]; 0 where it was not fitted.
    coefficients : (n_coefficients,) [1/m]
        Of the rest curvature before the first pose; in space about the axis y, then about z.
    fixtures : dict
        Those of `start` [m] and `start_heading`, `end_heading` [rad], in space `start_orientation`,
        `end_orientation`, that are the same in all poses of the session.
    identifiable : bool or None
        Whether the shapes determine the bending stiffness.
    interval_95 : (float or None, float or None) or None [N m^2]
        Of the bending stiffness; None in it = unbounded.
    model_hash : str
        As written; see `parameters_hash`.
    edited : bool
        Whether the model is no longer the one that was written.
    config : str
        Name of the configuration.
    versions : dict
    document : dict
        The whole file.
    """

    path: Path
    names: tuple[str, ...]
    covariance: FloatArray
    uncertainty: Uncertainty
    std: dict[str, float]
    coefficients: FloatArray
    fixtures: dict[str, Any]
    identifiable: bool | None
    interval_95: tuple[float | None, float | None] | None
    model_hash: str
    edited: bool
    config: str
    versions: dict[str, str]
    document: dict[str, Any]


class FittedCable(NamedTuple):
    """A fitted cable as parameters.yaml holds it: `model, p, rest, metadata = ...`.

    Parameters
    ----------
    model : CableModel
    p : (n_parameters,)
        In the order of `model.names` (SI).
    rest : (n_rests,) [1/m]
        Rest curvature before the next pose; in space the rest strains: the twist of all cells,
        then k_y, then k_z.
    metadata : Metadata
    """

    model: CableModel
    p: FloatArray
    rest: FloatArray
    metadata: Metadata

    @property
    def std(self) -> dict[str, float]:
        """Standard deviations by name (SI)."""
        return self.metadata.std

    @property
    def document(self) -> dict[str, Any]:
        """The whole file."""
        return self.metadata.document


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
    pose : HeldPose
        How its ends are held; with the `turns` or the `branch` of this shape where the cable may
        hang on either of two sides.
    equilibrium : Equilibrium
        Nodes, reactions, energy and stability.
    curve : CableCurve
        The cable itself, at any arc length: `curve.at(s)`.
    seen : CableCurve
        The same curve as measured by the session's camera.
    other_side : CableShape or None
        The same pose on the other side: with a free end fallen to the other side, between two
        clamps in space twisted the other way round. None unless it is uncertain, by the parameters
        and fixtures, which side is the lower one, and the pose does not name its side.
    tipping : Tipping or None
        Then, the angle of the clamp from where both sides are equally low.
    """

    cable: FittedCable
    pose: HeldPose
    equilibrium: Equilibrium
    curve: CableCurve
    seen: CableCurve
    other_side: Self | None = None
    tipping: Tipping | None = None

    def band(self, count: int = 101) -> FloatArray:
        """Half width (count,) [m] of the band across the cable that holds 90 % of new repeats.

        First order in the parameters' errors, the fixtures' scatter and the scatter of repeats.
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
        return {
            "cable": self.cable.model.cable.name,
            "model_hash": self.cable.metadata.model_hash,
            "length": self.cable.model.cable.length,
            "start": list(pose.start),
            "end": None if pose.end is None else list(pose.end),
            **pose.directions,
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


def shape_in(cable: FittedCable, pose: HeldPose) -> CableShape:
    """Solve a pose of a fitted cable, for both sides where it may hang on either.

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
        # The solver's advice is about a configuration, and there is none here.
        happened = error.message.partition("\n  Try:")[0]
        other = "headings or branch" if pose.node is Heading else "orientations, fewer turns"
        raise EquilibriumError(
            f"{happened}\n  Try: an end in metres, nearer to the start; other {other}.",
            p_des=error.p_des,
        ) from None
    effects = tuple(x for x in model.effects if not isinstance(x, MeasurementEffect))
    # The true curve is that of the same model without the effects of the camera.
    plain = replace(model, effects=effects, priors={}) if effects != model.effects else model
    kept = [name in plain.names for name in model.names]

    def shape(pose: HeldPose, eq: Equilibrium) -> CableShape:
        given = [Inputs.of(known, rest, pose.vector[None]) for known in (p[kept], p)]
        true, seen = (
            CableCurve.of(model.cable.length, assembly_of(one).curve(eq.shapes, known)[0])
            for one, known in zip((plain, model), given, strict=True)
        )
        return CableShape(cable, pose, eq, true, seen)

    beyond = eq.other_side
    if beyond is None:
        return shape(pose, eq)
    near = tipping_of(model, p, rest, pose, eq, beyond, metadata.uncertainty)
    if not near.either:
        return shape(pose, eq)
    own, others = sides_of(model, pose, eq, beyond)
    return replace(shape(own, eq), other_side=shape(others, beyond), tipping=near)
