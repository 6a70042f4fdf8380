"""A weight on a cable with a free tip, which shapes hardly tell from stiffness.

Of what only hangs, shapes show little more than the ratio of load and stiffness: a cable that
carries more hangs as one that is softer. The largest weight that fits as well as none, by its
profile likelihood, tells how far the stiffness may be off if there is one, and what would tell.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import chdtri

from dlo_casadi.diagnosis.candidates import Candidate, candidates, setup_of
from dlo_casadi.diagnosis.screening import Screen
from dlo_casadi.effects import Load
from dlo_casadi.errors import EstimationError
from dlo_casadi.estimation.descent import refit
from dlo_casadi.estimation.prediction import predict_poses
from dlo_casadi.estimation.profile import student_95
from dlo_casadi.estimation.result import Fit
from dlo_casadi.model.cable_model import BENDING_STIFFNESS
from dlo_casadi.runtime.executors import InProcess

# Weights that are tried in turn, over the cable's own: until one does not fit.
WEIGHTS = 0.05 * 1.6 ** np.arange(9)
# Directions of the clamp that are tried for a pose that would tell.
HEADINGS = 12
# Decrease of twice the objective that 95 % of true values are within.
PROFILE_95 = float(chdtri(1, 0.05))


@dataclass(frozen=True)
class HiddenWeight:
    """A weight that is not told from stiffness.

    Parameters
    ----------
    mass : float [kg]
        The largest of those tried that fits as well as none.
    position : float [m]
        Where on the cable it would make the stiffness most uncertain.
    stiffness_95 : (float, float) [N m^2]
        Interval of EI with no more than that weight, or none.
    force : float [N]
        That weight: a reading on the start fixture differs by it.
    heading : float or None [rad]
        Direction of the start clamp in a plane in which shapes with and without it differ most.
    difference : float or None [m]
        By how much there, RMS along the cable.
    """

    mass: float
    position: float
    stiffness_95: tuple[float, float]
    force: float
    heading: float | None
    difference: float | None


def hidden_weight(fit: Fit, exclude: Sequence[str] = ()) -> HiddenWeight | None:
    """The weight that a fit would not notice; None if it notices a twentieth of the cable's.

    Only of a free tip: with both ends held the pull between them tells the stiffness.
    """
    model = fit.model
    free = model.end == "free" and BENDING_STIFFNESS in fit.problem.unknowns.names
    if not free or not any(model.gravity):
        return None
    setup = setup_of(model, n_poses=len(fit.problem.used))
    listed = [
        item
        for item in candidates(model, setup, exclude)
        if isinstance(item.effect, Load) and item.effect.carried
    ]
    if not listed:
        return None  # it is in the model
    weight = listed[0]
    place = _place(fit, weight)
    fits = [fit, *_with_weights(fit, weight, place)]
    if len(fits) == 1:
        return None
    low, high = zip(*(_interval(one) for one in fits), strict=True)
    mass = fits[-1].value(weight.frees[0])
    force = mass * float(np.linalg.norm(model.gravity))
    told = _pose_that_tells(fit, fits[-1])
    return HiddenWeight(mass, place, (min(low), max(high)), force, *told)


def _place(fit: Fit, weight: Candidate) -> float:
    """Arc length [m] at which a weight makes the stiffness most uncertain."""
    _, position = weight.frees
    variances = []
    for normal in Screen(fit, [weight]).normals(InProcess()):
        hessian, names = normal.hessian, normal.names
        kept = [k for k, name in enumerate(names) if name != position]
        covariance = np.linalg.pinv(hessian[np.ix_(kept, kept)], hermitian=True)
        own = kept.index(names.index(BENDING_STIFFNESS))
        variances.append(float(covariance[own, own]))
    return weight.scans[int(np.argmax(variances))][position]


def _with_weights(fit: Fit, weight: Candidate, place: float) -> Iterator[Fit]:
    """Fits with heavier and heavier weights at a place, as long as they fit as well as none."""
    model, unknowns = weight.add_to(fit.model), fit.problem.unknowns
    free = unknowns.names[: unknowns.n_parameters]
    own = [model.names.index(name) for name in weight.frees]
    start, best = fit, fit.point.objective
    for share in WEIGHTS:
        values = start.values_in(model)
        values[own] = share * model.cable.mass, place
        try:
            start = refit(start, model, free=free, values=values)
        except EstimationError:
            return
        best = min(best, start.point.objective)
        if 2 * (start.point.objective - best) > PROFILE_95 * fit.inflation**2:
            return
        yield start


def _interval(fit: Fit) -> tuple[float, float]:
    value = fit.value(BENDING_STIFFNESS)
    half = student_95(fit, BENDING_STIFFNESS) * fit.std(BENDING_STIFFNESS) / value
    return float(value * np.exp(-half)), float(value * np.exp(half))


def _pose_that_tells(fit: Fit, other: Fit) -> tuple[float | None, float | None]:
    """Direction [rad] of the clamp in which two fits differ most, and by how much [m], RMS."""
    if fit.model.in_space or fit.model.start != "clamped":
        return None, None
    base = fit.problem.measured[fit.problem.used[0]].pose
    places = np.linspace(0.0, fit.model.cable.length, 51)
    headings, differences = np.linspace(-np.pi, np.pi, HEADINGS, endpoint=False), []
    for heading in headings:
        pose = replace(base, start_heading=float(heading), branch=None)
        pair = [predict_poses(one.model, one.p, one.rest, [pose])[0] for one in (fit, other)]
        curves = [
            item.curve.at(places)
            for item in pair
            # Near a clamp that points up the cable may fall to either side: no clean test.
            if item is not None and item.equilibrium.other_side is None
        ]
        gap = curves[0] - curves[1] if len(curves) == 2 else np.zeros((1, 2))
        differences.append(float(np.sqrt((gap**2).sum(axis=1).mean())))
    best = int(np.argmax(differences))
    return float(headings[best]), differences[best]
