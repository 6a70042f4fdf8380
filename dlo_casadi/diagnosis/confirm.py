"""Confirmation: a candidate goes into the batch problem and everything is refitted."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import Executor
from dataclasses import dataclass
from functools import partial

import numpy as np

from dlo_casadi.diagnosis.candidates import Candidate
from dlo_casadi.diagnosis.crossval import CrossValidation, cross_validate
from dlo_casadi.diagnosis.from_data import Start, fit_from_data, origins_of, start_from_data
from dlo_casadi.diagnosis.screening import Screened, survival
from dlo_casadi.errors import EstimationError
from dlo_casadi.estimation.descent import refit
from dlo_casadi.estimation.result import Fit
from dlo_casadi.runtime.parallel import map_in_order

# Shares of the one-step estimate from which a refit is tried.
SHARES = (1.0, 0.5, 0.2, 0.05)
# Share of the gain that the score promises, from which on a refit that creeps is not tried again.
PROMISED = 0.5
# Starts whose objectives end so near to one another have led to one place, and smaller shares begin
# nearer to the base still. Reports of eighteen sessions were the same without that limit.
ONE_PLACE = 1.0
# Gauss-Newton steps of one refit.
MOST_STEPS = 25


@dataclass(frozen=True)
class Confirmed:
    """A candidate refitted with all parameters free.

    Parameters
    ----------
    screened : Screened
    fit : Fit
    validation : CrossValidation
    gain : float
        Decrease of twice the objective.
    bic : float
        Gain minus the price of the parameters, q log N; larger is better.
    """

    screened: Screened
    fit: Fit
    validation: CrossValidation
    gain: float
    bic: float

    @classmethod
    def of(cls, screened: Screened, base: Fit, fit: Fit) -> Confirmed:
        """Compare a fit with a candidate with the base, the fit without it."""
        gain = 2 * (base.point.objective - fit.point.objective)
        price = float(len(screened.candidate.frees) * np.log(max(base.problem.n_residuals, 2)))
        return cls(screened, fit, cross_validate(fit), gain, gain - price)

    @property
    def candidate(self) -> Candidate:
        """The candidate."""
        return self.screened.candidate


def confirm(base: Fit, screened: Screened) -> Confirmed | None:
    """Refit with a candidate added; None if no equilibria can be followed to it."""
    fit = refit_with(base, screened)
    return None if fit is None else Confirmed.of(screened, base, fit)


def screened_from_data(
    base: Fit, listed: Sequence[Candidate], executor: Executor
) -> list[tuple[Screened, Start]]:
    """Candidates of a base that is astray, started from the measured shapes, best first.

    The score is by how much twice the objective falls, at the noise of a search, below that of
    the model without a candidate, which starts from the measured shapes, too; where it cannot,
    nothing is listed.
    """
    cable, origins = base.model.cable, origins_of(base)
    without = start_from_data(base, origins, None)
    containing = [x for x in listed if any(x.contains(other, cable) for other in listed)]
    simple = [x for x in listed if x not in containing]
    found = map_in_order(executor, partial(start_from_data, base, origins), simple)
    begun = list(zip(simple, found, strict=True))
    for candidate in containing:
        inside = [(x, start) for x, start in begun if start and candidate.contains(x, cable)]
        smaller = min(inside, key=lambda pair: pair[1].guess.objective, default=None)
        begun.append((candidate, start_from_data(base, origins, candidate, smaller)))
    out = []
    for candidate, start in begun:
        if start is not None and without is not None:
            score = max(2 * (without.guess.objective - start.guess.objective), 0.0)
            p_value = survival(score, len(candidate.frees), np.inf)
            out.append((Screened(candidate, score, p_value, {}), start))
    return sorted(out, key=lambda pair: -pair[0].score)


def confirm_from_data(base: Fit, begun: tuple[Screened, Start]) -> Confirmed | None:
    """Fit with a candidate added, from where it was started; None if that is no equilibrium."""
    screened, start = begun
    try:
        fit = fit_from_data(base, start)
        return None if fit is None else Confirmed.of(screened, base, fit)
    except EstimationError:
        return None


def refit_with(base: Fit, screened: Screened) -> Fit | None:
    """Fit the model with a candidate added, from its one-step estimate."""
    model = screened.candidate.add_to(base.model)
    best: Fit | None = None
    for share in SHARES:
        values = base.values_in(model)
        for name, value in screened.start.items():
            i = model.names.index(name)
            scanned = name not in screened.candidate.screened
            values[i] = value if scanned else values[i] + share * (value - values[i])
        try:
            fit = refit(base, model, values=values, steps=MOST_STEPS)
        except EstimationError:
            continue
        same = best is not None and abs(fit.point.objective - best.point.objective) < ONE_PLACE
        if best is None or fit.point.objective < best.point.objective:
            best = fit
        if same:
            break
        gain = 2 * (base.point.objective - best.point.objective)
        if gain > 0 and (best.converged or gain > PROMISED * screened.score):
            break
    return best
