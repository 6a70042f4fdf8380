"""Fit of still shapes and of recorded motions together.

    min over theta, own_m of  F(theta) + 1/2 sum_m |e_m(theta, own_m) / std|^2 + |own_m / std_own|^2

with the objective F of the still poses, residuals e_m of the markers of motion m, and its own
unknowns own_m: deviations of its fixtures, and the coordinates of its first state. Each iteration
linearises the motions, eliminates their own unknowns, and tells the rest to the fit of the still
poses as rows of a linear Gaussian observation of theta (`Priors.told`), which is then descended as
always: its bounds, priors, intervals and tests hold for both.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from dlo_casadi.arrays import FloatArray
from dlo_casadi.effects import OF_CLOCKS, TOLERATED_IN_MOTION, Effect, Setup
from dlo_casadi.errors import EstimationError
from dlo_casadi.estimation.descent import descend, refit
from dlo_casadi.estimation.motion_start import (
    LONGEST_STEP,
    FittedMotion,
    begin,
    tried,
    unknowns_in_motion,
)
from dlo_casadi.estimation.motion_told import Told, repeated, rows_of, summed
from dlo_casadi.estimation.problem import Problem
from dlo_casadi.estimation.recording import Recording
from dlo_casadi.estimation.result import Fit
from dlo_casadi.estimation.unknowns import Unknowns, Values
from dlo_casadi.model.cable_model import CableModel
from dlo_casadi.runtime.work import accounted_as, spend
from dlo_casadi.sensing.measured_motion import MeasuredMotion

# First guess of an undeclared damping time [s].
FIRST_DAMPING_TIME = 0.02
# Ends of the stretches [s] that are fitted one after the other: a wrong damping or stiffness moves
# a prediction by the more the later it is.
STRETCHES = (0.3, 0.6, 1.2, np.inf)
# Shares of the objective below which a step's gain ends a stretch: the last one, and those before.
# With a thousand residuals the first is a tenth of what one standard deviation costs.
_CONVERGED, _NEARLY = 1e-4, 2e-2
# Most iterations in a stretch, and trials of a damped step.
_ITERATIONS, _TRIALS = 15, 8
# First and least damping, relative to the diagonals: undamped, amplitudes of high modes that few
# points show step out of the reach of the linearisation.
_FIRST, _LEAST = 1e-3, 1e-4
# How far a point of a moving cable is predicted wrongly by mesh and steps of time, in lengths: the
# std of photographs that are drawn without any fault is 4 um, that of their frames in motion 22 um.
MESH_ERROR = 1e-4
# Ratio of the noise from frame to frame to that of still poses from which on it counts.
_NOISIER = 1.2


@dataclass(frozen=True, eq=False)
class MotionFit:
    """Still poses and motions, fitted together.

    Parameters
    ----------
    fit : Fit
        The still poses, with what the motions tell among their priors.
    still : Problem
        The same without motions.
    motions : tuple of FittedMotion
        At the minimum, with derivatives.
    std : float [m]
        Noise of a marker's coordinate in motion.
    converged : bool
    """

    fit: Fit
    still: Problem
    motions: tuple[FittedMotion, ...]
    std: float
    converged: bool

    @property
    def until(self) -> float:
        """Time [s] up to which the motions are compared."""
        return self.motions[0].recording.until

    @cached_property
    def objective(self) -> float:
        """Half the sum of squares of all, priors included."""
        model = self.fit.model
        moving = sum(item.objective(self.std, model) for item in self.motions)
        return self.still.evaluate(self.fit.point).objective + moving

    @property
    def rmse(self) -> float:
        """Root mean square distance [m] of the fitted motions' points."""
        total = sum(float(x.seen.residual @ x.seen.residual) for x in self.motions)
        points = sum(len(x.seen.residual) / x.recording.measured.compared for x in self.motions)
        return float(np.sqrt(total / points))

    @property
    def chi2_per_dof(self) -> float:
        """Sum of squares of the motions' whitened residuals per degree of freedom."""
        count = sum(len(item.seen.residual) for item in self.motions)
        own = sum(len(item.own) for item in self.motions)
        total = sum(float(x.seen.residual @ x.seen.residual) for x in self.motions)
        return total / self.std**2 / max(count - own, 1)


def moving_model(
    model: CableModel, damping_time: float | None = None, delay: float | None = None
) -> CableModel:
    """The model with a damping time, and with what may differ in motion within tolerances.

    `damping_time` [s]: a first guess. `delay` [s]: tolerance of the fixtures' clock.
    """
    guess = model.cable.damping_time or damping_time or FIRST_DAMPING_TIME
    model = replace(model, cable=replace(model.cable, damping_time=guess))
    setup = Setup(model.cable, model.start, model.end, model.gravity, moves=True)
    tolerated = dict(TOLERATED_IN_MOTION) | ({OF_CLOCKS: delay} if delay else {})
    for kind, std in tolerated.items():
        model = _tolerating(model, kind.made_for(setup), std) if kind.applies(setup) else model
    return model


def _tolerating(model: CableModel, effect: Effect, std: float) -> CableModel:
    """The model with an effect whose parameters have a prior, unless it has the effect."""
    if any(other.label == effect.label for other in model.effects):
        return model
    names = (f"{effect.label}.{q.name}" for q in effect.parameters(model.cable))
    return model.with_effect(effect, dict.fromkeys(names, std))


@accounted_as("motions")
def fit_motions(
    fit: Fit,
    measured: Sequence[MeasuredMotion],
    std: float | None = None,
    *,
    damping_time: float | None = None,
    until: float = np.inf,
) -> MotionFit:
    """Fit still poses and motions together, from a fit of the still poses.

    Parameters
    ----------
    std : float, optional [m]
        Noise of a marker's coordinate; by default that of the still poses, or from frame to frame
        where that is clearly more. MESH_ERROR is added.
    damping_time : float, optional [s]
        A first guess.
    until : float [s]
        Time up to which the motions are compared.

    Raises
    ------
    EstimationError
        If a motion has no first state near its points, or no step of time is found.
    """
    tolerances = fit.problem.priors.tolerances
    model = moving_model(fit.model, damping_time, tolerances.delay)
    fit = refit(fit, model)
    std = std or fit.noise.std
    # Still poses may be means of many frames.
    own = float(np.median([one.noise for one in measured if not one.held_out]))
    std = float(np.hypot(own if own > _NOISIER * std else std, MESH_ERROR * model.cable.length))
    begun = [
        begin(Recording(one, tolerances, LONGEST_STEP), fit.problem, fit.point.theta, std)
        for one in measured
        if not one.held_out
    ]
    return joined(fit, begun, std, until)


def rejoined(now: MotionFit, model: CableModel, values: Mapping[str, float]) -> MotionFit:
    """Another model fitted from a minimum; `values`: of its new parameters at the start.

    Raises
    ------
    EstimationError
        If still poses or motions are lost there.
    """
    extended = with_model(now, model, values)
    return joined(extended.fit, extended.motions, now.std, now.until)


def with_model(
    now: MotionFit, model: CableModel, values: Mapping[str, float], *, vanishes: bool = False
) -> MotionFit:
    """Another model at the values of a minimum, not fitted, with derivatives by its parameters.

    `vanishes`: whether what it has more vanishes there, so that it predicts the same.
    """
    fit, problem = now.fit, now.still
    known = {**dict(zip(fit.model.names, fit.p, strict=True)), **values}
    nominal = dict(zip(model.names, model.nominal, strict=True))
    p = np.array([known.get(name, nominal[name]) for name in model.names])
    held = set(fit.model.names) - set(problem.unknowns.names)
    free = np.array([name not in held for name in model.names])
    still = replace(problem, unknowns=Unknowns(model, free, p))
    theta = still.unknowns.pack(p, fit.coefficients)
    shapes = fit.point.shapes.in_order_of(fit.model, model)
    point = still.balanced(Values(theta, shapes, fit.point.projections))
    if point is None:
        raise EstimationError("a still pose is lost with another effect")
    extended = MotionFit(Fit(still, point), still, now.motions, now.std, converged=False)
    unknowns = unknowns_in_motion(still.unknowns)
    return _stretched(extended, unknowns, now.until, known=vanishes)


def joined(
    fit: Fit, motions: Sequence[FittedMotion], std: float, until: float = np.inf
) -> MotionFit:
    """The minimum of still poses and motions, from a fit and from recordings begun there.

    The motions are compared up to a time [s] that grows in STRETCHES from that of the recordings.
    """
    still = replace(fit.problem, priors=replace(fit.problem.priors, told=()))
    unknowns = unknowns_in_motion(still.unknowns)
    now = MotionFit(fit, still, tuple(motions), std, converged=False)
    longest = max(item.recording.measured.t[-1] for item in motions)
    later = [x for x in STRETCHES if now.until < x <= until and (x < longest or x == until)]
    for end in later or [now.until]:
        now = now if end == now.until else _stretched(now, unknowns, end)
        now = _descended(now, unknowns, last=end == (later or [now.until])[-1])
    return _told_to(now, unknowns)


def stretched(now: MotionFit, end: float) -> MotionFit:
    """The same unknowns compared up to another time [s]; EstimationError if a motion is lost."""
    return _stretched(now, unknowns_in_motion(now.fit.problem.unknowns), end)


def _stretched(now: MotionFit, unknowns: Unknowns, end: float, *, known: bool = False) -> MotionFit:
    """The same unknowns compared with points up to another time; `known`: up to the same."""
    moved = []
    for item in now.motions:
        recording = replace(item.recording, until=end)
        seen = recording.evaluate(
            unknowns,
            now.fit.point.theta,
            item.own,
            item.seen.first,
            derivatives=True,
            known=item.seen if known else None,
        )
        moved.append(FittedMotion(recording, item.own, seen))
    return replace(now, motions=tuple(moved))


def _descended(now: MotionFit, unknowns: Unknowns, *, last: bool) -> MotionFit:
    """Levenberg-Marquardt over all unknowns; `last`: until it has converged."""
    damping, enough = _FIRST, _CONVERGED if last else _NEARLY
    for _ in range(_ITERATIONS):
        spend()
        trial = None
        for _ in range(_TRIALS):
            trial = _stepped(now, unknowns, damping)
            if trial is not None and trial.objective < (1 + enough / 10) * now.objective:
                break
            damping, trial = 10 * damping, None
        if trial is None:
            break
        gain = now.objective - trial.objective
        now, damping = trial, max(damping / 10, _LEAST)
        if gain < enough * now.objective:
            return replace(now, converged=last)
    return now


def told_by(now: MotionFit) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Hessian (size, size) and gradient (size,) of the motions, and the gradient's variance.

    Their own unknowns are eliminated.
    """
    return summed(now.motions, unknowns_in_motion(now.fit.problem.unknowns), now.std)


def _stepped(now: MotionFit, unknowns: Unknowns, damping: float) -> MotionFit | None:
    """All unknowns after one step; None if some motion is lost there."""
    theta = now.fit.point.theta
    told = [Told.of(item, unknowns, now.std, damping) for item in now.motions]
    priors = replace(now.still.priors, told=rows_of(told, theta, damping))
    problem = replace(now.fit.problem, priors=priors)
    descended = descend(Fit(problem, problem.evaluate(now.fit.point)))
    step = descended.point.theta - theta
    moved = []
    for item, one in zip(now.motions, told, strict=True):
        trial = tried(item, unknowns, descended.point.theta, item.own + one.own_step(step))
        if trial is None:
            return None
        moved.append(trial)
    return MotionFit(descended, now.still, tuple(moved), now.std, converged=False)


def _told_to(now: MotionFit, unknowns: Unknowns) -> MotionFit:
    """The fit with what the motions tell, weighed by how their residuals vary together in time.

    The minimum stays that of the whole objective: rows and values of `Priors.told` balance the
    gradient of the still poses there.
    """
    theta, point = now.fit.point.theta, now.fit.point
    rows = np.array([row for row, _ in _loose_rows(now, unknowns)])
    still = Fit(now.still, now.still.evaluate(point)).normal.gradient
    pulled = np.linalg.lstsq(rows.T, -still, rcond=None)[0]
    balanced = tuple(
        (row, float(row @ theta - pull)) for row, pull in zip(rows, pulled, strict=True)
    )
    problem = replace(now.fit.problem, priors=replace(now.still.priors, told=balanced))
    fit = Fit(problem, problem.evaluate(point), converged=now.fit.converged)
    return replace(now, fit=fit)


def _loose_rows(now: MotionFit, unknowns: Unknowns) -> tuple[tuple[FloatArray, float], ...]:
    """What the motions tell, no more than they repeat the still poses, see `motion_told`."""
    told = [Told.of(item, unknowns, now.std) for item in now.motions]
    theta = now.fit.point.theta
    return rows_of(told, theta, 0.0, told_by(now)[2], repeated(unknowns, theta))


def repeated_fit(now: MotionFit) -> Fit:
    """The still poses with what the motions tell of them.

    Parameters of the motions may differ from those of the still poses, see REPEATED: the minimum
    over both is that of the motions, which are many; this one is between theirs and the poses' own.
    """
    unknowns = unknowns_in_motion(now.fit.problem.unknowns)
    rows = _loose_rows(now, unknowns)
    problem = replace(now.fit.problem, priors=replace(now.still.priors, told=rows))
    return descend(Fit(problem, problem.evaluate(now.fit.point)))


def predicted(now: MotionFit, measured: MeasuredMotion) -> FloatArray:
    """Points (T, K, d) [m] of a motion that was not fitted: open loop, from its first state.

    That is the state of rest, or the one that fits best to the first FIRST_STRETCHES[-1] seconds.
    """
    unknowns, fit = unknowns_in_motion(now.fit.problem.unknowns), now.fit
    recording = Recording(measured, fit.problem.priors.tolerances, LONGEST_STEP)
    theta, near = fit.point.theta, None
    if measured.at_rest:
        own: FloatArray = np.zeros(len(recording.own_std(unknowns.model)))
    else:
        found = begin(recording, fit.problem, theta, now.std)
        recording, own, near = found.recording, found.own, found.seen.first
    whole = replace(recording, until=np.inf)
    return whole.evaluate(unknowns, theta, own, near).points
