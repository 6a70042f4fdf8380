"""What an added effect may stand for: causes not tried, or that no shape tells from it."""

from __future__ import annotations

from collections.abc import Collection, Sequence

import numpy as np

from dlo_casadi.diagnosis.candidates import Candidate, setup_of
from dlo_casadi.effects import EFFECTS, Fitted, Load
from dlo_casadi.estimation.result import Fit
from dlo_casadi.model.cable_model import BENDING_STIFFNESS
from dlo_casadi.thresholds import ALIKE


def equivalents(
    fit: Fit, added: Candidate, tried: Collection[str], rivals: Sequence[Candidate] = ()
) -> tuple[str, ...]:
    """Names of what an added effect may stand for.

    Effects that act as it does, but for those on which the data have decided. On a cable with a
    free tip, which nothing lifts, a weight beside any load; and the stiffness, where the fit
    cannot tell the load from it.

    Parameters
    ----------
    fit : Fit
        With the effect.
    added : Candidate
    tried : names
        What the data have decided on already.
    rivals : sequence of Candidate
        What they do not tell from it.
    """
    effect, cable, setup = added.effect, fit.model.cable, setup_of(fit.model)
    own = {q.name: f"{effect.label}.{q.name}" for q in effect.parameters(cable)}
    values = {name: fit.value(full) for name, full in own.items()}
    stds = {name: fit.std(full) for name, full in own.items()}
    found = Fitted(effect, setup, values, stds)
    names = [
        name
        for name, kind in EFFECTS.items()
        if name not in tried and kind.applies(setup) and kind.made_for(setup).may_be(found)
    ]
    loads = any(isinstance(item.effect, Load) for item in (added, *rivals))
    if fit.model.end == "free" and loads:
        names += [
            name
            for name, kind in EFFECTS.items()
            if issubclass(kind, Load) and kind.carried and name not in (effect.name, *names)
        ]
        names += [BENDING_STIFFNESS] * _like_stiffness(fit, list(own.values()))
    return tuple(names)


def _like_stiffness(fit: Fit, parameters: Sequence[str]) -> bool:
    """Whether these parameters, if they were known, would tell most of what EI is not known by."""
    names, covariance = fit.problem.unknowns.names, fit.covariance
    if BENDING_STIFFNESS not in names:
        return False
    k = names.index(BENDING_STIFFNESS)
    columns = [names.index(name) for name in parameters if name in names]
    beside = covariance[k, columns]
    told = beside @ np.linalg.pinv(covariance[np.ix_(columns, columns)], hermitian=True) @ beside
    return bool(told > ALIKE**2 * covariance[k, k])
