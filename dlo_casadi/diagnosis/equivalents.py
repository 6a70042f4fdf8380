"""Causes that act on the cable as an added effect does, and that were not tried."""

from __future__ import annotations

from collections.abc import Collection

from dlo_casadi.diagnosis.candidates import Candidate, setup_of
from dlo_casadi.effects import EFFECTS, Fitted
from dlo_casadi.estimation.result import Fit


def untried_equivalents(fit: Fit, added: Candidate, tried: Collection[str]) -> tuple[str, ...]:
    """Names of effects that an added one may stand for, those left out that were tried.

    Parameters
    ----------
    fit : Fit
        With the effect.
    added : Candidate
    tried : names
        What the data have decided on already.
    """
    effect, cable, setup = added.effect, fit.model.cable, setup_of(fit.model)
    own = {q.name: f"{effect.label}.{q.name}" for q in effect.parameters(cable)}
    values = {name: fit.value(full) for name, full in own.items()}
    stds = {name: fit.std(full) for name, full in own.items()}
    found = Fitted(effect, setup, values, stds)
    return tuple(
        name
        for name, kind in EFFECTS.items()
        if name not in tried and kind.applies(setup) and kind.made_for(setup).may_be(found)
    )
