"""The recordings of a session: fitted with the still poses, searched, predicted."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from dlo_casadi.arrays import Brief, FloatArray
from dlo_casadi.diagnosis.candidates import Candidate
from dlo_casadi.diagnosis.in_motion import AddedInMotion, InMotion, search_in_motion
from dlo_casadi.diagnosis.told_apart import among_dead_loads
from dlo_casadi.errors import EstimationError
from dlo_casadi.estimation.motion_fit import MotionFit, fit_motions, predicted, repeated_fit
from dlo_casadi.estimation.motion_start import FIRST_STRETCHES
from dlo_casadi.estimation.result import Fit
from dlo_casadi.model.cable_model import CableModel
from dlo_casadi.sensing.measured_motion import MeasuredMotion
from dlo_casadi.session.found_effects import FoundEffect, effect_parameters, with_motions
from dlo_casadi.session.measured_modes import MeasuredModes, measured_modes
from dlo_casadi.thresholds import SIGNIFICANCE


@dataclass(frozen=True, repr=False)
class MotionShown(Brief):
    """One motion, measured and predicted.

    Parameters
    ----------
    name, role : str
    t : (T,) [s]
    s : (K,) [m]
        Arc lengths of the points.
    measured, predicted : (T, K, d) [m]
        Points that were not seen are NaN.
    distances : (T, K) [m]
        Of measured and predicted points; across them where the points belong to lines.
    compared : int
        Numbers that are compared of each point.
    note : str
        What was left out of the recording.
    """

    name: str
    role: str
    t: FloatArray
    s: FloatArray
    measured: FloatArray
    predicted: FloatArray
    distances: FloatArray
    compared: int
    note: str = ""

    @property
    def rmse(self) -> float:
        """Root mean square distance [m]."""
        return float(np.sqrt(np.nanmean(self.distances**2)))


@dataclass(frozen=True)
class MotionStage:
    """Motions by one model.

    Parameters
    ----------
    rmse_fit, rmse_held_out : float or None [m]
        Over all points and times; None without motions of that role.
    chi2_per_dof : float
        Of the fitted motions.
    noise : float [m]
        Of a coordinate of a point.
    shown : tuple of MotionShown
    """

    rmse_fit: float
    rmse_held_out: float | None
    chi2_per_dof: float
    noise: float
    shown: tuple[MotionShown, ...]


@dataclass(frozen=True)
class MovingResult:
    """What the motions of a session tell.

    Parameters
    ----------
    fit : Fit
        Of still poses and motions together, with the effects that were found.
    stages : tuple of MotionStage
        Of the model before, and with the effects if some were found.
    effects : tuple of FoundEffect
    scores : dict
        Of each candidate, see `search_in_motion`.
    modes : MeasuredModes or None
    dropped : frozenset of str
        Labels of effects that still poses had shown and that these have made superfluous.
    """

    fit: Fit
    stages: tuple[MotionStage, ...]
    effects: tuple[FoundEffect, ...]
    scores: dict[str, float]
    modes: MeasuredModes | None
    dropped: frozenset[str]


def fit_moving(
    fit: Fit,
    motions: Sequence[MeasuredMotion],
    exclude: Sequence[str],
    step: Callable[[str, int, int], None],
    *,
    diagnosed: bool,
    significance: float = SIGNIFICANCE,
    damping_time: float | None = None,
    shown: Sequence[Candidate] = (),
    declared: CableModel | None = None,
) -> MovingResult:
    """Fit the motions of a session with its still poses, and search for what the model lacks.

    `damping_time` [s]: a first guess. `shown`: what still poses have shown beside `declared`.

    Raises
    ------
    EstimationError
        If the motions cannot be fitted.
    """
    step("fit the motions", 0, 1)
    until = FIRST_STRETCHES[-1] if diagnosed else np.inf
    before = fit_motions(fit, motions, damping_time=damping_time, until=until)
    step("fit the motions", 1, 1)
    found = (
        search_in_motion(before, exclude, step, significance, shown, declared)
        if diagnosed
        else InMotion(before, before, (), {})
    )
    fits = [found.before, found.after] if found.added else [found.after]
    both = repeated_fit(found.after)
    return MovingResult(
        both,
        tuple(_stage(one, motions) for one in fits),
        tuple(_found_effect(both, found.after, item) for item in found.added),
        found.scores,
        measured_modes(fit, both, motions),
        frozenset(item.effect.label for item in found.dropped),
    )


def _found_effect(fit: Fit, after: MotionFit, item: AddedInMotion) -> FoundEffect:
    """An effect that motions show, and what they tell it from."""
    effect = FoundEffect(
        name=item.candidate.name,
        label=item.candidate.effect.label,
        of=None,
        parameters=effect_parameters(fit, item.candidate.effect),
        p_value=item.p_value,
        rmse_cross_validated_before=item.before,
        rmse_cross_validated_after=item.after,
        indistinguishable_from=item.rivals,
    )
    told = among_dead_loads(after, item.candidate)
    own = [x for x in told if x.candidate is item.candidate]
    return with_motions(effect, own[0], told) if own else effect


def _stage(fit: MotionFit, motions: Sequence[MeasuredMotion]) -> MotionStage:
    fitted = {item.recording.measured.name: item.seen.points for item in fit.motions}
    shown = []
    for one in motions:
        points = fitted.get(one.name)
        if points is None:
            try:
                points = predicted(fit, one)
            except EstimationError:
                points = np.full_like(one.points, np.nan)
        whole = np.full_like(one.points, np.nan)
        whole[: len(points)] = points
        role = "held_out" if one.held_out else "fit"
        off = np.linalg.norm(one.deviations(whole), axis=2)
        seen = one.t, one.s, one.points, whole, off, one.compared
        shown.append(MotionShown(one.name, role, *seen, one.note))
    both = {role: [x.distances for x in shown if x.role == role] for role in ("fit", "held_out")}

    def rms(role: str) -> float | None:
        known = np.concatenate([np.zeros(0), *(x[np.isfinite(x)] for x in both[role])])
        return float(np.sqrt(np.mean(known**2))) if len(known) else None

    return MotionStage(rms("fit") or 0.0, rms("held_out"), fit.chi2_per_dof, fit.std, tuple(shown))
