"""The missing load without a cause: where the cable is pulled, and how in each pose."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from dlo_casadi.effects import UnknownPull
from dlo_casadi.errors import EstimationError
from dlo_casadi.estimation.fit import Fit, fit_model, starting_points
from dlo_casadi.estimation.gauss_newton import BatchProblem, Point
from dlo_casadi.estimation.unknowns import Unknowns
from dlo_casadi.model import DEVIATIONS, CableModel

FloatArray = NDArray[np.floating]

# Places kept from the scan for a full fit, and the rise of twice the objective that bounds the
# interval (95 % of chi-square with one degree of freedom).
TRIED = 3
PULL_PLACES = np.linspace(0.1, 0.9, 9)
COARSE = 20
# Standard deviation of a pull about the mean of the poses, in weights of the cable.
PULL_WEIGHTS = 1.0
# Gauss-Newton steps along the flat valley of stiffness against force.
MOST_STEPS = 150
RISE = 3.84


@dataclass(frozen=True)
class Pull:
    """A force per pose at one place of the cable.

    Parameters
    ----------
    force_per_pose : (m_fit, 2) [N]
        Of each fit pose, in the board frame.
    position : float [m]
    interval : (float, float) [m]
        95 %.
    gain : float
        Decrease of twice the objective against the fit without it.
    fit : Fit
    """

    force_per_pose: FloatArray
    position: float
    interval: tuple[float, float]
    gain: float
    fit: Fit


def estimate_pull(base: Fit) -> Pull | None:
    """Estimate an unexplained load as one force per pose at one place; None if none fits.

    The fit without it may have gone far astray, so that it is no place to start from: on a
    coarse mesh, stiffnesses over decades and places along the cable are searched anew, the best
    refitted with the place along with everything else, and the best of those on the base's mesh.
    """
    effect = UnknownPull()
    length = base.model.cable.length
    model = base.model.with_effect(effect)
    name = f"{effect.label}.position"
    unknowns = base.problem.unknowns
    held = {key for key, free in zip(base.model.names, unknowns.free, strict=True) if not free}
    free = [key for key in model.names if key not in held and key != name]
    coarse = _search(base, model.with_mesh(min(COARSE, base.model.n)), free, name)
    best: Fit | None = None
    for fit in coarse:
        try:
            best = fit_model(
                model,
                base.problem.history,
                base.problem.tolerances,
                free=[*free, name],
                values=fit.p,
                start=fit,
                max_iterations=MOST_STEPS,
            )
            break
        except EstimationError:
            continue
    if best is None:
        return None
    columns = [DEVIATIONS.index(axis) for axis in effect.per_pose]
    mean = [best.value(f"{effect.label}.{axis}") for axis in ("fx", "fy")]
    forces = best.point.shapes.deviation[np.ix_(best.problem.used, columns)] + mean
    position = best.value(name)
    half = np.sqrt(RISE) * max(best.std(name), 1e-4 * length)
    interval = (float(max(0.0, position - half)), float(min(length, position + half)))
    gain = 2 * (base.point.objective - best.point.objective)
    return Pull(forces, position, interval, gain, best)


def _search(base: Fit, model: CableModel, free: list[str], name: str) -> list[Fit]:
    """Fits on a coarse mesh from the most promising places, the best first."""
    problem = base.problem
    chosen = np.array([key in free for key in model.names])
    starts: list[tuple[BatchProblem, Point]] = []
    sweep = None
    for share in PULL_PLACES:
        values = base_values(base, model)
        values[model.names.index(name)] = share * model.cable.length
        unknowns = Unknowns(model, chosen, values, problem.unknowns.rest_free)
        trial = BatchProblem(
            unknowns,
            problem.history,
            problem.noise,
            problem.tolerances,
            problem.roughness_std,
            pull_scatter(base),
            sweep,
        )
        sweep = trial.sweep
        theta = unknowns.pack(values, np.zeros(model.rest.n_coefficients))
        points = starting_points(trial, theta)
        starts += [(trial, point) for point in points[:1]]
    starts = sorted(starts, key=lambda item: item[1].objective)[:TRIED]
    fits = []
    everything = chosen.copy()
    everything[model.names.index(name)] = True
    for trial, point in starts:
        trial.refresh(point.feet)
        held = Fit(trial, *trial.descend(point))
        unknowns = Unknowns(model, everything, held.p, problem.unknowns.rest_free)
        moving = BatchProblem(
            unknowns,
            problem.history,
            problem.noise,
            problem.tolerances,
            problem.roughness_std,
            trial.scatter,
            sweep,
        )
        moving.share_metric(trial)
        theta = unknowns.pack(held.p, held.coefficients)
        start = replace(held.point, theta=theta)
        fits.append(Fit(moving, *moving.descend(start, MOST_STEPS)))
    return sorted(fits, key=lambda fit: fit.point.objective)


def pull_scatter(base: Fit) -> FloatArray:
    """Scatter of ends as in the base, of a pull about its mean the cable's weight.

    Shapes tell the ratio of forces to stiffness and, by the weight, how large both are; where
    the weight hardly shows, a force of a hundred times the weight would fit as well. And a force
    along a taut cable hardly shows: there it should be like that of the other poses.
    """
    cable = base.model.cable
    weight = cable.mass * float(np.hypot(*base.model.gravity))
    scatter = base.problem.scatter.copy()
    scatter[4:] = PULL_WEIGHTS * max(weight, cable.bending_stiffness / cable.length**2)
    return scatter


def base_values(base: Fit, model: CableModel) -> FloatArray:
    """Nominal values, but what the base keeps fixed."""
    values = model.nominal.copy()
    for key, free in zip(base.model.names, base.problem.unknowns.free, strict=True):
        if not free:
            values[model.names.index(key)] = base.value(key)
    return values
