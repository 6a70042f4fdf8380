"""Effects that a diagnosis has added, as an outcome holds them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from dlo_casadi.diagnosis.diagnose import Diagnosis
from dlo_casadi.effects import Effect
from dlo_casadi.estimation.result import Fit


@dataclass(frozen=True)
class EffectParameter:
    """Value and standard deviation of an effect's parameter in its unit; None where unbounded."""

    value: float | None
    std: float | None
    unit: str


@dataclass(frozen=True)
class FoundEffect:
    """An effect that was added to the model. `effect["name"]` is `effect.name`, as in report.json.

    Parameters
    ----------
    name : str
    parameters : dict of EffectParameter
    p_value : float
        See `AddedEffect`.
    rmse_cross_validated_before, rmse_cross_validated_after : float or None [m]
        Without and with the effect; None where a pose that was left out is not predicted.
    indistinguishable_from : tuple of str
        Other effects that these data cannot tell it from.
    """

    name: str
    parameters: dict[str, EffectParameter]
    p_value: float | None
    rmse_cross_validated_before: float | None
    rmse_cross_validated_after: float | None
    indistinguishable_from: tuple[str, ...]

    def __getitem__(self, field: str) -> Any:
        return getattr(self, field)


def found_effects(diagnosis: Diagnosis) -> tuple[FoundEffect, ...]:
    """What was added, with the values of the last fit."""
    return tuple(
        FoundEffect(
            name=item.candidate.name,
            parameters=effect_parameters(diagnosis.after, item.candidate.effect),
            p_value=item.p_value,
            rmse_cross_validated_before=item.before.rmse if item.before.complete else None,
            rmse_cross_validated_after=item.after.rmse,
            indistinguishable_from=tuple(
                dict.fromkeys([*(rival.candidate.name for rival in item.rivals), *item.equivalents])
            ),
        )
        for item in diagnosis.added
    )


def effect_parameters(fit: Fit, effect: Effect) -> dict[str, EffectParameter]:
    """Parameters of an effect by their names.

    Those that vanish at infinity are estimated as their inverse; both are given.
    """
    rows: dict[str, EffectParameter] = {}
    for q in effect.parameters(fit.model.cable):
        full = f"{effect.label}.{q.name}"
        value, std = fit.value(full), fit.std(full)
        rows[q.name] = EffectParameter(value, std, q.unit)
        if q.name in effect.inverses:
            name, unit = effect.inverses[q.name]
            known = value > 0
            rows[name] = EffectParameter(
                1 / value if known else None, std / value**2 if known else None, unit
            )
    return rows
