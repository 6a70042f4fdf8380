"""Loads at one place as causes of an unexplained pull.

Where the declared model has gone far astray, no effect can be followed from its shapes. The pull
has found shapes that fit, and in every pose a force f_j at one place r_j of the cable; a load is
its cause if its own law gives these forces. All are linear in their parameters once the place is
known (a tether in k and k a: f = k a - k r), so that least squares tell where a refit starts.
"""

from __future__ import annotations

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from dlo_casadi.diagnosis.candidates import Candidate
from dlo_casadi.diagnosis.confirm import Confirmed
from dlo_casadi.diagnosis.pull import Pull
from dlo_casadi.diagnosis.screening import Screened
from dlo_casadi.effects import PointLoad
from dlo_casadi.errors import EstimationError
from dlo_casadi.estimation.descent import refit
from dlo_casadi.estimation.result import Fit

FloatArray = NDArray[np.floating]

# Gauss-Newton steps of one refit, from forces that a pose's own pull has blurred.
MOST_STEPS = 60


def start_from(pull: Pull, candidate: Candidate) -> dict[str, float]:
    """Qualified parameters of a load at one place that come closest to the forces of a pull."""
    fit, model = pull.fit, pull.fit.model
    effect = candidate.effect.linear()
    assert isinstance(effect, PointLoad)
    place = ca.SX.sym("r", len(model.gravity))
    names = [q.name for q in effect.parameters(model.cable) if q.name != "position"]
    linear = ca.SX.sym("linear", len(names))
    params = {name: linear[k] for k, name in enumerate(names)} | {"position": ca.SX(pull.position)}
    force = effect.force(place, ca.SX(ca.DM(model.gravity)), params)
    slopes = ca.Function("slopes", [place], [ca.jacobian(force, linear)])
    seen = fit.problem.observed(fit.point)
    places = [seen[j].curve.at(np.array([pull.position]))[0] for j in fit.problem.used]
    arms = np.concatenate([np.array(slopes(at)) for at in places])
    found = np.linalg.lstsq(arms, pull.force_per_pose.ravel(), rcond=None)[0]
    values = dict(zip(names, map(float, found), strict=True)) | {"position": pull.position}
    return candidate.of_linear(model.cable, values)


def refit_from(base: Fit, pull: Pull, screened: Screened) -> Confirmed | None:
    """Refit the base's model with a load in the place of the pull; None if none can be followed.

    Parameters
    ----------
    base : Fit
        Without either.
    """
    model = screened.candidate.add_to(base.model)
    values = pull.fit.values_in(model)
    for name, value in start_from(pull, screened.candidate).items():
        values[model.names.index(name)] = value
    try:
        fit = refit(pull.fit, model, values=values, steps=MOST_STEPS)
    except EstimationError:
        return None
    return Confirmed.of(screened, base, fit)
