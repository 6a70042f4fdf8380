"""What makes predictions from a fit uncertain."""

from __future__ import annotations

from dlo_casadi.equilibrium.spread import Uncertainty
from dlo_casadi.estimation.repeats import different_poses, hanging_std
from dlo_casadi.estimation.result import Fit
from dlo_casadi.thresholds import DIFFERENT


def uncertainty_of(fit: Fit) -> Uncertainty:
    """What a fit has found."""
    names, covariance = fit.named_covariance
    used = [fit.model.deviation_names[k] for k in fit.problem.equilibria.used_deviations]
    scatter = dict(zip(used, map(float, fit.problem.deviation_std), strict=True))
    return Uncertainty(names, covariance, scatter, fit.problem.rest_scatter, _hanging(fit))


def _hanging(fit: Fit) -> float:
    """How far hangings of a pose differ beyond the noise of their points, see `Uncertainty`.

    Fixtures that hold them differently are in it. Where many poses differ, the rest curvature of
    each hanging's own tells it.
    """
    length = fit.model.cable.length
    if different_poses(fit.problem.history, length) >= DIFFERENT:
        return 0.0
    noise = fit.noise.of_points
    return hanging_std(fit.problem.history, length, noise.beside_hangings)
