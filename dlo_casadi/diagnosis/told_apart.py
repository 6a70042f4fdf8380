"""Effects that still shapes leave tied, told apart by recordings of the moving cable.

A weight and a dead force pull alike at rest; a weight swings slower. Each rival is fitted with the
recordings in the place of what was found. With half the sums of squares F of the still poses alone
and F_m of all, each at its minimum, the log evidence of the still poses, ln Z, becomes

    ln Z_m = ln Z - (F_m - F) / c

up to how much better the recordings know the parameters, which is nearly the same for rivals. c is
the best one's chi-square per degree of freedom, at least 1: what all lack tells nothing.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass

from dlo_casadi.diagnosis.candidates import Candidate, candidates, setup_of
from dlo_casadi.diagnosis.found import AddedEffect, likelier_by, rivals_of
from dlo_casadi.diagnosis.refits import load_instead
from dlo_casadi.effects import Load, PointLoad
from dlo_casadi.errors import EstimationError
from dlo_casadi.estimation.descent import descend
from dlo_casadi.estimation.motion_fit import MotionFit, fit_motions, rejoined
from dlo_casadi.estimation.result import Fit
from dlo_casadi.sensing.measured_motion import MeasuredMotion

# A candidate, its fits of the still poses and of all, and its log evidence of the former.
_Moved = tuple[Candidate, Fit, MotionFit, float]


@dataclass(frozen=True)
class Hypothesis:
    """One of several effects in the place of one that was found.

    Parameters
    ----------
    fit : Fit
        Of the still poses.
    still, moving : float
        Log evidence without and with the recordings, less that of what was found.
    """

    candidate: Candidate
    fit: Fit
    still: float
    moving: float


def among_rivals(
    fit: Fit,
    item: AddedEffect,
    motions: Sequence[MeasuredMotion],
    damping_time: float | None = None,
) -> list[Hypothesis]:
    """What was found in still shapes and its rivals, the likeliest first; empty without rivals.

    A rival with which no recording can be followed is left out. `fit`: of the still poses, with
    what was found. `damping_time` [s]: a first guess.
    """
    fits = [(item.candidate, fit)]
    for rival in rivals_of(fit, item).values():
        fits.append((rival.candidate, descend(rival.fit.weighed_as(fit))))
    if len(fits) == 1:
        return []
    moved: list[_Moved] = []
    for candidate, still in fits:
        try:
            found = fit_motions(still, motions, damping_time=damping_time)
        except EstimationError:
            if still is fit:
                return []
            continue
        ahead = likelier_by(fit, still) if still is not fit else 0.0
        moved.append((candidate, still, found, ahead))
    return _compared(moved)


def among_dead_loads(after: MotionFit, item: Candidate) -> list[Hypothesis]:
    """A weight that recordings have shown, and dead loads in its place; empty for other effects.

    Log evidence of the still poses is then that of their minima, as all of these have the same
    parameters but for a direction.
    """
    fits = [(item, after)]
    if not isinstance(item.effect, PointLoad) or type(item.effect).masses is Load.masses:
        return []
    without = item.remove_from(after.fit.model, after.fit.model)
    for other in candidates(without, setup_of(without)):
        effect = other.effect
        if isinstance(effect, PointLoad) and effect.dead and type(effect).masses is Load.masses:
            values = load_instead(after.fit, item, other)
            with suppress(EstimationError):
                fits.append((other, rejoined(after, other.add_to(without), values)))
    moved: list[_Moved] = []
    for candidate, found in fits:
        still = descend(Fit(found.still, found.still.evaluate(found.fit.point)))
        first = moved[0][1] if moved else still
        ahead = first.point.objective - still.point.objective
        moved.append((candidate, still, found, ahead))
    return _compared(moved)


def _compared(moved: Sequence[_Moved]) -> list[Hypothesis]:
    """Hypotheses, the likeliest first; the first of `moved` is what was found."""
    scale = max(1.0, min(found.chi2_per_dof for _, _, found, _ in moved))
    costs = [found.objective - still.point.objective for _, still, found, _ in moved]
    told = [
        Hypothesis(candidate, still, ahead, ahead - (cost - costs[0]) / scale)
        for (candidate, still, _, ahead), cost in zip(moved, costs, strict=True)
    ]
    return sorted(told, key=lambda x: -x.moving)
