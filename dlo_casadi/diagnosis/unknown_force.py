"""A missing load without an assumed cause: where and how the cable is pulled, and by what load."""

from concurrent.futures import Executor
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial

import casadi as ca
import numpy as np

from dlo_casadi.arrays import FloatArray
from dlo_casadi.diagnosis.candidates import Candidate
from dlo_casadi.effects import PointLoad, UnknownPull
from dlo_casadi.errors import EstimationError
from dlo_casadi.estimation.descent import descend, refit
from dlo_casadi.estimation.problem import Problem
from dlo_casadi.estimation.relaxation import SOFTNESS, Relaxation
from dlo_casadi.estimation.result import Fit
from dlo_casadi.estimation.start import SearchSettings, begin, fit_from, relaxed
from dlo_casadi.estimation.unknowns import Unknowns, Values
from dlo_casadi.model.cable_model import CableModel
from dlo_casadi.runtime.parallel import map_in_order
from dlo_casadi.runtime.work import accounted_as
from dlo_casadi.thresholds import BEST, NORMAL_95

PLACES = tuple(float(share) for share in np.linspace(0.1, 0.9, 9))


@dataclass(frozen=True)
class UnknownForce:
    """A force per pose at one place of the cable.

    Parameters
    ----------
    force_per_pose : (m_fit, d) [N]
        Force in each fit pose, in the board frame.
    position : float [m]
    interval : (float, float) [m]
        95 %.
    poses : tuple of str
        Names of the fit poses.
    """

    force_per_pose: FloatArray
    position: float
    interval: tuple[float, float]
    fit: Fit
    poses: tuple[str, ...] = ()

    @property
    def force(self) -> FloatArray:
        """Mean force (d,) [N] over the poses."""
        return np.asarray(self.force_per_pose.mean(axis=0))


@accounted_as("unknown force")
def estimate_unknown_force(base: Fit, executor: Executor) -> UnknownForce | None:
    """Estimate an unexplained load as one force per pose at one place; None if none fits.

    The fit without the load may be too far off to start from. Places along the cable are therefore
    tried from the measured shapes on a coarse mesh; the best are refitted with the place free, and
    the best of those on the base's mesh. `base`: fit without the load. `executor`: runs the trial
    places, a second or two each.
    """
    effect = UnknownPull()
    model = base.model.with_effect(effect)
    coarse = min(SearchSettings.of(model).mesh, model.n)
    search = _Search(base, model.with_mesh(coarse), f"{effect.label}.position")
    length, name = model.cable.length, search.position
    best: Fit | None = None
    for fit in search.run(executor):
        with suppress(EstimationError):
            best = refit(fit, model)
            break
    if best is None:
        return None
    columns = _columns(model)
    mean = [best.value(f"{effect.label}.f{axis}") for axis in model.node.axes]
    forces = best.point.shapes.deviation[np.ix_(best.problem.used, columns)] + mean
    position = best.value(name)
    half = NORMAL_95 * max(best.std(name), 1e-4 * length)
    interval = (float(max(0.0, position - half)), float(min(length, position + half)))
    names = tuple(item.pose.name for item in best.problem.fit_poses)
    return UnknownForce(forces, position, interval, best, names)


def _columns(model: CableModel) -> list[int]:
    """Places of the force's components among the deviations of a pose."""
    return [model.deviation_names.index(axis) for axis in UnknownPull().per_pose(model.cable)]


@dataclass(frozen=True)
class _Search:
    """Fits with the load on a coarse mesh, from places along the cable.

    The base lacks the load; `position` is the name of the parameter that holds its place.
    """

    base: Fit
    model: CableModel
    position: str

    def run(self, executor: Executor) -> list[Fit]:
        """Fits from the most promising places, the best first."""
        problem = self.held_at(PLACES[len(PLACES) // 2])
        theta = problem.unknowns.pack(problem.unknowns.fixed, np.zeros(self.model.n_coefficients))
        _, begun = begin(problem, theta)
        starts = map_in_order(executor, partial(self.relaxed_at, begun), PLACES)
        likely = sorted(starts, key=lambda start: start[0])
        fits = map_in_order(executor, self.fit_from, [start[1:] for start in likely[:BEST]])
        return sorted((fit for fit in fits if fit), key=lambda fit: fit.point.objective)

    def relaxed_at(self, begun: Values, share: float) -> tuple[float, float, Values]:
        """Relaxed fit with the load at a share of the length: objective, that share, values."""
        problem = self.held_at(share)
        values = relaxed(problem, begun, SOFTNESS[:3])
        return Relaxation(problem, SOFTNESS[2]).objective(values), share, values

    def fit_from(self, start: tuple[float, Values]) -> Fit | None:
        """Fit with the load held at a share of the length, then with its place free."""
        share, values = start
        held = fit_from(self.held_at(share), values, SOFTNESS[2:])
        if held is None:
            return None
        moving = self._problem(Unknowns(self.model, self.base.free_in(self.model), held.p))
        theta = moving.unknowns.pack(held.p, held.coefficients)
        return descend(Fit(moving, replace(held.point, theta=theta)))

    def held_at(self, share: float) -> Problem:
        """Problem with the load at a share of the length, all else nominal or kept fixed."""
        free = self.base.free_in(self.model)
        values = np.where(free, self.model.nominal, self.base.values_in(self.model))
        place = self.model.names.index(self.position)
        values[place], free[place] = share * self.model.cable.length, False
        return self._problem(Unknowns(self.model, free, values))

    def _problem(self, unknowns: Unknowns) -> Problem:
        """Problem with the base's scatter of ends; the weight is the std of a force about its mean.

        Shapes determine the ratio of forces to stiffness; only the weight determines their size. If
        the weight hardly shows, a force of a hundred times the weight would fit as well. A force
        along a taut cable hardly shows either: it should then be like that of the other poses.
        """
        problem, model = self.base.problem, self.model
        scatter, cable = problem.priors.scatter.copy(), model.cable
        bending = cable.bending_stiffness / cable.length**2
        scatter[_columns(model)] = max(model.weight, bending)
        return replace(problem, unknowns=unknowns, priors=replace(problem.priors, scatter=scatter))


def start_from(
    fit: Fit, position: float, forces: FloatArray, candidate: Candidate
) -> dict[str, float]:
    """Qualified parameters of a load at one place that reproduce given forces best.

    `forces` (fitted poses, dimension) [N], at the arc length `position` [m] of the fit's shapes.
    """
    model, effect = fit.model, candidate.effect.linear()
    assert isinstance(effect, PointLoad)
    place = ca.SX.sym("r", len(model.gravity))
    names = [q.name for q in effect.parameters(model.cable) if q.name != "position"]
    linear = ca.SX.sym("linear", len(names))
    params = {name: linear[k] for k, name in enumerate(names)} | {"position": ca.SX(position)}
    law = effect.force(place, ca.SX(ca.DM(model.gravity)), params)
    slopes = ca.Function("slopes", [place], [ca.jacobian(law, linear)])
    arms = np.concatenate([np.array(slopes(at)) for at in places_in(fit, position)])
    found = np.linalg.lstsq(arms, forces.ravel(), rcond=None)[0]
    values = dict(zip(names, map(float, found), strict=True)) | {"position": position}
    return candidate.of_linear(model.cable, values)


def places_in(fit: Fit, position: float) -> FloatArray:
    """Where (fitted poses, dimension) [m] an arc length [m] is in the fitted shapes."""
    seen = fit.problem.observed(fit.point)
    at = np.array([position])
    return np.array([seen[j].curve.at(at)[0] for j in fit.problem.used])
