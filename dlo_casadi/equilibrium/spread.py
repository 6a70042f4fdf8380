"""A predicted shape and its uncertainty: the spread of new repeats, and the side they take."""

from __future__ import annotations

import re
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Self

import numpy as np
from scipy.special import ndtri

from dlo_casadi.arrays import FloatArray
from dlo_casadi.effects import EFFECTS, Effect, MeasurementEffect, Setup
from dlo_casadi.equilibrium.batch import BatchEquilibrium
from dlo_casadi.equilibrium.curve import NodeCurve, curves_of
from dlo_casadi.equilibrium.equilibrium import Equilibrium
from dlo_casadi.equilibrium.pose import HeldPose
from dlo_casadi.equilibrium.solve import solve_equilibrium, ways_of
from dlo_casadi.model.assembly import Assembly, Inputs, Shapes, Tangents
from dlo_casadi.model.cable_model import END_ROLL, CableModel
from dlo_casadi.model.pose_scatter import PoseScatter
from dlo_casadi.thresholds import NORMAL_95

# Share of new repeats inside the band, and its half width in standard deviations.
COVERED = 0.9
EDGE = -float(ndtri((1 - COVERED) / 2))
# Angle [rad] from where two sides are equally low that rounding of their energies alone may make.
_ROUNDING = 1e-9
# Step of finite differences of energies, as a share of a standard deviation.
_SHARE = 1e-3


@dataclass(frozen=True, eq=False)
class SolvedCable:
    """A cable in an equilibrium of one pose.

    Parameters
    ----------
    model, p, rest, pose
        As in `solve_equilibrium`.
    equilibrium : Equilibrium
    """

    model: CableModel
    p: FloatArray
    rest: FloatArray
    pose: HeldPose
    equilibrium: Equilibrium

    @classmethod
    def of(cls, model: CableModel, p: FloatArray, rest: FloatArray, pose: HeldPose) -> Self:
        """The cable in its predicted shape."""
        return cls(model, p, rest, pose, solve_equilibrium(model, p, rest, pose))

    @cached_property
    def assembly(self) -> Assembly:
        """The assembly of this pose alone."""
        given = Inputs.of(self.p, self.rest, self.pose.vector[None])
        return Assembly(self.model, self.equilibrium.shapes, given)

    @cached_property
    def curve(self) -> NodeCurve:
        """The curve by declared arc length; the true one if the model has no camera's effects."""
        return curves_of(self.assembly)[0]

    @property
    def places(self) -> FloatArray:
        """Arc lengths (n_nodes,) [m] of the model's nodes; some are moved to the clips."""
        return self.assembly.clipped.places[0]


@dataclass(frozen=True)
class Uncertainty:
    """Causes of uncertainty in a prediction.

    Parameters
    ----------
    names : tuple of str
        Fitted parameters and `rest_curvature[k]`.
    covariance : (N, N)
        Covariance of these, in SI units.
    scatter : mapping of str to float
        Standard deviation of the fixtures from pose to pose, by the deviation's name.
    repeat_std : float [m]
        Standard deviation of a coordinate between repeats of one pose, root mean square along the
        cable; 0 where no pose was repeated.
    added : mapping of str to float
        Standard deviations of parameters in addition to the covariance, by name: if the cable is
        installed again, its length and roll between the fixtures change.
    """

    names: tuple[str, ...]
    covariance: FloatArray
    scatter: Mapping[str, float]
    pose_scatter: PoseScatter
    repeat_std: float = 0.0
    added: Mapping[str, float] = field(default_factory=dict)

    @property
    def root(self) -> FloatArray:
        """Matrix A (N, N) with A A^T = `covariance`, which may be singular."""
        std = np.sqrt(np.maximum(np.diag(self.covariance), 1e-300))
        values, vectors = np.linalg.eigh(self.covariance / np.outer(std, std))
        return std[:, None] * vectors * np.sqrt(np.maximum(values, 0.0))

    def unknowns_in(self, model: CableModel) -> tuple[FloatArray, FloatArray]:
        """Derivatives of parameters (n_parameters, N) and rests (n_rests, N) by `names`."""
        size = len(self.names)
        by_p, by_rest = np.zeros((len(model.names), size)), np.zeros((model.chain.n_rests, size))
        for k, name in enumerate(self.names):
            if name in model.names:
                by_p[model.names.index(name), k] = 1.0
            else:
                coefficient = int(name.removeprefix("rest_curvature[").removesuffix("]"))
                by_rest[:, k] = model.rest_basis[:, coefficient]
        return by_p, by_rest

    def ways_in(self, model: CableModel) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Independent directions in which a new repeat of a pose may differ, one std each.

        Changes of the parameters (n_parameters, q), the rest strains (n_rests, q) and the
        deviations (n_deviations, q) of `pose_scatter.within(model)`, without unknown forces.
        Causes: the fitted unknowns, the fixtures, each repeat's own random quantity, and what is
        `added`.
        """
        own, modes = self.pose_scatter.ways(model)
        sizes = self.pose_scatter.sizes(modes.shape[1])
        counts = [len(self.names), len(model.deviations), len(sizes), len(self.added)]
        fit, fixtures, repeat, new = np.split(np.arange(sum(counts)), np.cumsum(counts)[:-1])
        heights = len(model.names), len(modes), len(own)
        by_p, by_rest, by_deviation = (np.zeros((rows, sum(counts))) for rows in heights)
        by_p[:, fit], by_rest[:, fit] = (by @ self.root for by in self.unknowns_in(model))
        scatter = np.array([self.scatter.get(name, 0.0) for name in model.deviations])
        used = [model.deviation_names.index(name) for name in model.deviations]
        by_deviation[used, fixtures] = np.where(np.isfinite(scatter), scatter, 0.0)
        by_rest[:, repeat], by_deviation[:, repeat] = modes * sizes, own * sizes
        by_p[[model.names.index(name) for name in self.added], new] = [*self.added.values()]
        return by_p, by_rest, by_deviation

    def causes_in(self, model: CableModel) -> tuple[str, ...]:
        """Cause of each direction of `ways_in`.

        It is "parameters" for the fit, "end" for the end fixture's place, a clamp's direction such
        as "end_heading" or "end_rotation", "repeat", or the name of an added parameter.
        """
        fixtures = (cause_of(model, name) for name in model.deviations)
        repeat = ["repeat"] * self.pose_scatter.ways(model)[0].shape[1]
        return (*["parameters"] * len(self.names), *fixtures, *repeat, *self.added)

    def installed(self, model: CableModel, tolerances: Mapping[str, float]) -> Self:
        """The same cable between other fixtures, with these standard deviations by `tolerances_of`.

        Deviations of the ends replace the scatter of the session's fixtures. Those of parameters
        are added to the parameters' uncertainty. Names unknown to the model are ignored.
        """
        scatter, added = dict(self.scatter), dict(self.added)
        for name, std in tolerances.items():
            for varied in tolerances_of(model).get(name, ()):
                (scatter if varied in model.deviations else added)[varied] = std
        return replace(self, scatter=scatter, added=added)


def cause_of(model: CableModel, deviation: str) -> str:
    """Name of a deviation without the axis along or about which it deviates."""
    return re.sub(f"_({'|'.join(model.node.axes)})$", "", deviation)


def tolerances_of(model: CableModel) -> dict[str, tuple[str, ...]]:
    """Deviations or parameters of a model that each tolerance covers, by the tolerance's name."""
    deviations, setup = _of_deviations(model), _setup(model)
    named = [*deviations]
    for effect in model.effects:
        if not isinstance(effect, MeasurementEffect) and _acts(effect, setup):
            carried = _carried_beside(effect, deviations)
            own = ((tolerance, f"{effect.label}.{name}") for name, tolerance in carried.items())
            named += [(tolerance, name) for tolerance, name in own if name in model.names]
    named += [("roll", END_ROLL)] * (END_ROLL in model.names)
    return {key: tuple(x for name, x in named if name == key) for key, _ in named}


def with_tolerances(model: CableModel, names: Collection[str]) -> CableModel:
    """Return the model with all effects that carry tolerances of these names, added at zero.

    Those of measurements matter to no shape.
    """
    deviations, setup = _of_deviations(model), _setup(model)
    present = {effect.label for effect in model.effects}
    for kind in EFFECTS.values():
        if issubclass(kind, MeasurementEffect) or kind.impossible(setup):
            continue
        for effect in kind.each_for(setup):
            carried = {*_carried_beside(effect, deviations).values()}
            if carried & {*names} and effect.label not in present:
                model = model.with_effect(effect)
    return model


def _setup(model: CableModel) -> Setup:
    held = model.start, model.end, model.gravity
    return Setup(model.cable, *held, clips=model.clips, obstacles=len(model.obstacles))


def _acts(effect: Effect, setup: Setup) -> bool:
    """Whether the clip or obstacle that an effect is of is there, and of a kind that has it."""
    own = effect.index
    return not own or getattr(effect, own) in {getattr(x, own) for x in effect.each_for(setup)}


def _of_deviations(model: CableModel) -> list[tuple[str, str]]:
    """The tolerance that each deviation of a pose covers, and the deviation."""
    places = {"end": "end"} | {f"clip_{k}": "clip" for k in range(len(model.clips))}
    turned = model.node.tolerance
    return [(places.get(cause_of(model, name), turned), name) for name in model.deviations]


def _carried_beside(effect: Effect, deviations: Sequence[tuple[str, str]]) -> dict[str, str]:
    """Tolerances of an effect's parameters that no deviation covers.

    Deviations are of the places of ends and clips, and of the directions of ends alone.
    """
    covered = {(tolerance, tolerance == "clip") for tolerance, _ in deviations}
    of_clip = effect.index == "clip"
    return {k: x for k, x in effect.tolerances.items() if (x, of_clip) not in covered}


@dataclass(frozen=True)
class Repeats:
    """New repeats of a cable's pose, and every way in which they may differ.

    Parameters
    ----------
    held : SolvedCable
        The predicted shape.
    uncertainty : Uncertainty
    """

    held: SolvedCable
    uncertainty: Uncertainty

    @cached_property
    def ways(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """See `Uncertainty.ways_in`."""
        return self.uncertainty.ways_in(self.held.model)

    @cached_property
    def larger(self) -> CableModel:
        """The model with the deviations that each repeat has of its own."""
        return self.uncertainty.pose_scatter.within(self.held.model)

    @cached_property
    def _batch(self) -> BatchEquilibrium:
        return BatchEquilibrium(self.larger, [self.held.pose])

    @property
    def _shapes(self) -> Shapes:
        return replace(self.held.equilibrium.shapes, deviation=np.zeros((1, len(self.ways[2]))))

    @cached_property
    def along(self) -> Tangents:
        """Derivatives of the shape along the `ways`."""
        (by_p, by_rest, by_deviation), held = self.ways, self.held
        return self._batch.by_rest(self._shapes, held.p, held.rest, by_rest, by_p, by_deviation)

    def displacements(self, s: FloatArray) -> tuple[NodeCurve, FloatArray]:
        """Curve of the pose, and displacements (K, d, q) [m] of its places s [m] in a new repeat.

        The displacements are independent, of one standard deviation each. They are the covariance
        of the fitted parameters, the fixtures' scatter and each repeat's own random quantity,
        propagated through the equilibrium. The measured difference of repeats is added, equal at
        all places.
        """
        given = self._shapes, self.held.p, self.held.rest
        ((seen, change),) = self._batch.observe(*given, self.along)
        curve, d = seen.curve, seen.curve.d
        alike = np.broadcast_to(self.uncertainty.repeat_std * np.eye(d), (len(s), d, d))
        return curve, np.concatenate([curve.moved(s, change.curve, change.knots), alike], axis=2)

    @property
    def reading_std(self) -> FloatArray:
        """Standard deviation (n_reactions,) [N, N m] between new repeats of each reading.

        Without the noise of the sensors; in the order of `ends.reaction_rows`.
        """
        here = self._batch.at(self._shapes, self.held.p, self.held.rest)
        return np.asarray(np.linalg.norm(here.readings_along(self.along)[0], axis=1))

    def tipping(self, other: Equilibrium) -> Tipping:
        """Tipping of the pose, from the equilibrium on its other side.

        It is of first order in all uncertainties of a prediction: the derivative of an
        equilibrium's energy by any input is that of the Lagrangian at fixed nodes and multipliers.
        """
        std, pair = float(np.linalg.norm(self._gap_slopes(other))), (self.held.equilibrium, other)
        return Tipping(tipping(self.held.model, *pair), std / _lever(self.held.model, *pair))

    def gap_std(self, other: Equilibrium) -> float:
        """Standard deviation [J] between repeats of the energy difference to another equilibrium.

        Causes are the fixtures and each repeat's own random quantity; the parameters are exact.
        """
        slopes = self._gap_slopes(other)
        return float(np.linalg.norm(slopes[len(self.uncertainty.names) :]))

    def _gap_slopes(self, other: Equilibrium) -> FloatArray:
        """Changes (q,) [J] of the difference in energy along the `ways`."""
        held = replace(self.held, model=self.larger)
        beyond = energy_slope(replace(held, equilibrium=other), self.ways, _SHARE)
        return np.asarray(beyond - energy_slope(held, self.ways, _SHARE))


def spread_across(curve: NodeCurve, s: FloatArray, moved: FloatArray) -> FloatArray:
    """Standard deviation (K, d - 1) [m] across the cable at places s [m] that are `moved`.

    `moved`: see `Repeats.displacements`. The noise of a measurement is not included.
    """
    return np.linalg.norm(np.einsum("knd,kdq->knq", curve.normals(s), moved), axis=2)


# ---- on which side -------------------------------------------------------------------------------


def tipping(model: CableModel, eq: Equilibrium, other: Equilibrium) -> float:
    """Angle [rad] by which the clamp must turn to make two sides equally low, to first order.

    dV/d(angle) of a clamp is the moment on it.
    """
    return abs(other.energy - eq.energy) / _lever(model, eq, other)


def _lever(model: CableModel, eq: Equilibrium, other: Equilibrium) -> float:
    """Difference [N m] between the moments of two equilibria on the clamp that tips the cable."""
    assert model.tipped_by is not None
    k = model.border_names.index(model.tipped_by)
    return max(abs(float(other.multipliers[k] - eq.multipliers[k])), 1e-300)


@dataclass(frozen=True)
class Tipping:
    """Distance of a clamp from the angle at which both sides of a cable are equally low.

    Parameters
    ----------
    angle, std : float [rad]
        The difference of the clamp's angle from that one, and its standard deviation.
    """

    angle: float
    std: float

    @property
    def either(self) -> bool:
        """Whether it is uncertain which side is the lower one."""
        return self.angle < max(NORMAL_95 * self.std, _ROUNDING)


def energy_slope(held: SolvedCable, along: Sequence[FloatArray], step: float) -> FloatArray:
    """Derivative (q,) [J] of an equilibrium's energy along q directions.

    It is that of the Lagrangian at a fixed shape, by central differences.

    Parameters
    ----------
    along : sequence of (n_parameters, q), (n_rests, q) and, optionally, (n_deviations, q)
        Directions of the parameters, the rest strains, and the pose's deviations.
    step : float
        Step to both sides, as a share of a direction.
    """
    by_p, by_rest, *by_deviation = (step * np.hstack([by, -by]).T for by in along)
    m, q = len(by_p), len(by_p) // 2
    shapes = held.equilibrium.shapes.subset(np.zeros(m, dtype=np.intp))
    for moved in by_deviation:
        shapes = replace(shapes, deviation=moved)
    poses = np.tile(held.pose.vector, (m, 1))
    inputs = Inputs.of(held.p + by_p, held.rest + by_rest, poses)
    total = Assembly(held.model, shapes, inputs).balance()[0]
    return np.asarray((total[:q] - total[q:]) / (2 * step))


def sides_of(model: CableModel, pose: HeldPose, *pair: Equilibrium) -> list[HeldPose]:
    """Two copies of a pose; each names the side of one of the equilibria."""
    ways = ways_of(model, pose)
    turned = [float(model.node.turning(eq.x)) for eq in pair]
    return ways if turned[0] > turned[1] else ways[::-1]
