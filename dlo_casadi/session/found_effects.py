"""Effects that a diagnosis has added, with their values in its last fit."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

from dlo_casadi.cable.estimate import Estimate
from dlo_casadi.diagnosis.diagnose import Diagnosis
from dlo_casadi.diagnosis.told_apart import Hypothesis
from dlo_casadi.effects import Effect
from dlo_casadi.estimation.result import Fit
from dlo_casadi.thresholds import EVIDENCE_APART


@dataclass(frozen=True)
class FoundEffect:
    """An effect that was added to the model.

    Parameters
    ----------
    name : str
    label : str
        Prefix of its parameters' names in the model, see `Effect`.
    of : str or None
        Name of its clip or obstacle, if it is of one; that of the first fitted pose.
    parameters : dict of Estimate
    p_value : float or None
        See `AddedEffect`.
    rmse_cross_validated_before, rmse_cross_validated_after : float or None [m]
        Without and with the effect; None where a left-out pose is not predicted.
    indistinguishable_from : tuple of str
        Other effects that fit these data equally well.
    told_apart : dict of (float, float)
        By the names of rivals among the still shapes: log evidence by which this effect is ahead of
        them without and with the recordings of the moving cable.
    """

    name: str
    label: str
    of: str | None
    parameters: dict[str, Estimate]
    p_value: float | None
    rmse_cross_validated_before: float | None
    rmse_cross_validated_after: float | None
    indistinguishable_from: tuple[str, ...]
    told_apart: Mapping[str, tuple[float, float]] = field(default_factory=dict)

    def __str__(self) -> str:
        return f"{self.label} of {self.of}" if self.of else self.label


def found_effects(diagnosis: Diagnosis) -> tuple[FoundEffect, ...]:
    """Added effects with their values in the last fit."""
    return tuple(
        FoundEffect(
            name=item.candidate.name,
            label=item.candidate.effect.label,
            of=_support(diagnosis.fit, item.candidate.effect),
            parameters=effect_parameters(diagnosis.fit, item.candidate.effect),
            p_value=item.p_value,
            rmse_cross_validated_before=item.before.rmse if item.before.complete else None,
            rmse_cross_validated_after=item.after.rmse,
            indistinguishable_from=tuple(
                dict.fromkeys([*(rival.candidate.name for rival in item.rivals), *item.equivalents])
            ),
        )
        for item in diagnosis.added
    )


def with_motions(effect: FoundEffect, best: Hypothesis, told: Sequence[Hypothesis]) -> FoundEffect:
    """The effect of a hypothesis in the place of one that was found, and what it is told from."""
    name, own = best.candidate.name, best.candidate.effect
    ahead = {
        x.candidate.name: (best.still - x.still, best.moving - x.moving)
        for x in told
        if x.candidate.name != name
    }
    ties = [x for x, (_, moving) in ahead.items() if moving < EVIDENCE_APART]
    others = [x for x in effect.indistinguishable_from if x not in (*ahead, name)]
    effect = replace(effect, indistinguishable_from=(*ties, *others), told_apart=ahead)
    if name == effect.name:
        return effect
    parameters = effect_parameters(best.fit, own)
    return replace(effect, name=name, label=own.label, of=None, parameters=parameters)


def _support(fit: Fit, effect: Effect) -> str | None:
    """Name of the clip or obstacle that an effect is of; None if it is of none."""
    first = fit.problem.measured[fit.problem.used[0]].pose
    known = {"clip": first.clips, "obstacle": fit.model.obstacles}.get(effect.index)
    return known[getattr(effect, effect.index)].name if known else None


def effect_parameters(fit: Fit, effect: Effect) -> dict[str, Estimate]:
    """Parameters of an effect by their names.

    Parameters that vanish at infinity are estimated as their inverse; both are returned.
    """
    rows: dict[str, Estimate] = {}
    for q in effect.parameters(fit.model.cable):
        full = f"{effect.label}.{q.name}"
        value, std = fit.value(full), fit.std(full)
        rows[q.name] = Estimate(value, std, q.unit, fixed=not std)
        if q.name in effect.inverses:
            name, unit = effect.inverses[q.name]
            inverse = (1 / value, std / value**2) if value > 0 else (math.inf, math.inf)
            rows[name] = Estimate(*inverse, unit, fixed=not std)
    return rows
