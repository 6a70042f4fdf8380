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
from dlo_casadi.estimation.problem import Problem
from dlo_casadi.estimation.recording import Recording
from dlo_casadi.estimation.result import Fit
from dlo_casadi.estimation.unknowns import Unknowns, Values
from dlo_casadi.model.cable_model import BENDING_STIFFNESS, DAMPING_TIME, CableModel
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
# How far parameters of motions repeat those of still poses, relative. Two independent discrete rods
# with the same parameters, of 40 elements, differ by 0.1 % in frequency: 0.5 % in EI where weight
# holds the cable, too. Without it motions claim EI to 0.02 %.
REPEATED = {BENDING_STIFFNESS: 5e-3, DAMPING_TIME: 1.5e-2}
# How far a point of a moving cable is predicted wrongly by mesh and steps of time, in lengths: the
# std of photographs that are drawn without any fault is 4 um, that of their frames in motion 22 um.
MESH_ERROR = 1e-4
# Ratio of the noise from frame to frame to that of still poses from which on it counts.
_NOISIER = 1.2
# Share of the largest eigenvalue of the scaled Hessian below which motions tell nothing.
_SHOWN = 1e-10


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
    moving = unknowns_in_motion(fit.problem.unknowns)
    begun = [
        begin(Recording(one, tolerances, LONGEST_STEP), fit, moving, std)
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


def with_model(now: MotionFit, model: CableModel, values: Mapping[str, float]) -> MotionFit:
    """Another model at the values of a minimum, not fitted, with derivatives by its parameters."""
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
    return _stretched(extended, unknowns_in_motion(still.unknowns), now.until)


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


def _stretched(now: MotionFit, unknowns: Unknowns, end: float) -> MotionFit:
    """The same unknowns compared with points up to another time."""
    moved = []
    for item in now.motions:
        recording = replace(item.recording, until=end)
        seen = recording.evaluate(
            unknowns, now.fit.point.theta, item.own, item.seen.first, derivatives=True
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


@dataclass(frozen=True)
class _Told:
    """What a motion tells of theta, its own unknowns eliminated: H, g, and how these follow."""

    hessian: FloatArray
    gradient: FloatArray
    block: FloatArray
    cross: FloatArray
    slope: FloatArray

    @classmethod
    def of(cls, item: FittedMotion, unknowns: Unknowns, std: float, damping: float = 0.0) -> _Told:
        prior = 1 / item.recording.own_std(unknowns.model) ** 2
        a, b, e = (x / std for x in (item.seen.by_theta, item.seen.by_own, item.seen.residual))
        block, cross = b.T @ b + np.diag(prior), b.T @ a
        block += damping * np.diag(np.diag(block))
        slope = b.T @ e + prior * item.own
        solved = np.linalg.solve(block, np.column_stack([cross, slope]))
        hessian, gradient = a.T @ a - cross.T @ solved[:, :-1], a.T @ e - cross.T @ solved[:, -1]
        return cls(hessian, gradient, block, cross, slope)

    def own_step(self, step: FloatArray) -> FloatArray:
        """Change of its own unknowns with a step of theta."""
        return -np.linalg.solve(self.block, self.cross @ step + self.slope)


_SUMMED = ("hessian", "gradient")


def told_by(now: MotionFit) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Hessian (size, size) and gradient (size,) of the motions, and the gradient's variance.

    Their own unknowns are eliminated.
    """
    unknowns = unknowns_in_motion(now.fit.problem.unknowns)
    told = [_Told.of(item, unknowns, now.std) for item in now.motions]
    pairs = zip(now.motions, told, strict=True)
    varied = sum(_varied(item, one, now.std) for item, one in pairs)
    hessian, gradient = (np.sum([getattr(x, key) for x in told], axis=0) for key in _SUMMED)
    return hessian, gradient, np.asarray(varied)


def _rows(
    told: Sequence[_Told],
    theta: FloatArray,
    damping: float,
    varied: FloatArray | None = None,
    repeated: FloatArray | None = None,
) -> tuple[tuple[FloatArray, float], ...]:
    """Rows of `Priors.told` whose square is that of the motions, linearised at theta.

    `varied`: variance of the gradient, where it is larger than the Hessian; see `_varied`.
    `repeated` (size,): standard deviations of theta from the still poses to the motions.
    """
    hessian = sum((x.hessian for x in told), np.zeros((len(theta), len(theta))))
    gradient = sum((x.gradient for x in told), np.zeros(len(theta)))
    scale = np.sqrt(np.maximum(np.diag(hessian), 1e-12))
    scaled = hessian / np.outer(scale, scale) + damping * np.eye(len(theta))
    values, vectors = np.linalg.eigh(scaled)
    kept = values > _SHOWN * values[-1]
    roots, vectors = np.sqrt(values[kept]), vectors[:, kept]
    rows = (roots[:, None] * vectors.T) * scale
    pulled = (vectors.T @ (gradient / scale)) / roots
    if varied is not None:
        arm = (vectors.T / scale) / roots[:, None]
        sizes, axes = np.linalg.eigh(arm @ varied @ arm.T)
        share = axes.T / np.sqrt(np.maximum(sizes, 1.0))[:, None]
        rows, pulled = share @ rows, share @ pulled
    if repeated is not None:
        loose = rows * repeated
        sizes, axes = np.linalg.eigh(np.eye(len(rows)) + loose @ loose.T)
        share = axes.T / np.sqrt(sizes)[:, None]
        rows, pulled = share @ rows, share @ pulled
    return tuple((row, float(row @ theta - pull)) for row, pull in zip(rows, pulled, strict=True))


def _repeated(unknowns: Unknowns, theta: FloatArray) -> FloatArray:
    """Standard deviations (size,) of theta from the still poses to the motions."""
    out, names = np.zeros(len(theta)), unknowns.names
    for name, std in REPEATED.items():
        if name in names:
            k = names.index(name)
            out[k] = std if name == BENDING_STIFFNESS else std * abs(theta[k])
    return out


def _stepped(now: MotionFit, unknowns: Unknowns, damping: float) -> MotionFit | None:
    """All unknowns after one step; None if some motion is lost there."""
    theta = now.fit.point.theta
    told = [_Told.of(item, unknowns, now.std, damping) for item in now.motions]
    priors = replace(now.still.priors, told=_rows(told, theta, damping))
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
    told = [_Told.of(item, unknowns, now.std) for item in now.motions]
    _, _, varied = told_by(now)
    theta, point = now.fit.point.theta, now.fit.point
    loose = _rows(told, theta, 0.0, varied, _repeated(unknowns, theta))
    rows = np.array([row for row, _ in loose])
    still = Fit(now.still, now.still.evaluate(point)).normal.gradient
    pulled = np.linalg.lstsq(rows.T, -still, rcond=None)[0]
    balanced = tuple(
        (row, float(row @ theta - pull)) for row, pull in zip(rows, pulled, strict=True)
    )
    problem = replace(now.fit.problem, priors=replace(now.still.priors, told=balanced))
    fit = Fit(problem, problem.evaluate(point), converged=now.fit.converged)
    return replace(now, fit=fit)


def repeated_fit(now: MotionFit) -> Fit:
    """The still poses with what the motions tell of them.

    Parameters of the motions may differ from those of the still poses, see REPEATED: the minimum
    over both is that of the motions, which are many; this one is between theirs and the poses' own.
    """
    unknowns = unknowns_in_motion(now.fit.problem.unknowns)
    told = [_Told.of(item, unknowns, now.std) for item in now.motions]
    theta = now.fit.point.theta
    rows = _rows(told, theta, 0.0, told_by(now)[2], _repeated(unknowns, theta))
    problem = replace(now.fit.problem, priors=replace(now.still.priors, told=rows))
    return descend(Fit(problem, problem.evaluate(now.fit.point)))


def _varied(item: FittedMotion, told: _Told, std: float) -> FloatArray:
    """Variance (size, size) of the gradient by theta, from the residuals themselves.

        J = sum_t s_t s_t' + sum_(l <= L) (1 - l / (L + 1)) sum_t (s_t s_(t+l)' + s_(t+l) s_t')

    s_t: the part of the gradient from time t. White noise gives the Hessian; what the model lacks
    lasts for a while and along the cable, and its parts add up. L is half a period of the first
    mode.

    References
    ----------
    Newey and West, Econometrica 55 (1987).
    """
    seen, times = item.seen, item.recording.times
    own = np.linalg.solve(told.block, told.cross)
    rows = (seen.by_theta - seen.by_own @ own) * (seen.residual / std**2)[:, None]
    mask = np.isfinite(item.recording.measured.points[: len(times), :, 0])
    dimension = len(rows) // int(mask.sum())
    at = np.repeat(np.repeat(np.arange(len(times)), mask.sum(axis=1)), dimension)
    scores = np.zeros((len(times), rows.shape[1]))
    np.add.at(scores, at, rows)
    lag = int(np.ceil(item.recording.period / 2 / np.median(np.diff(times))))
    total = scores.T @ scores
    for k in range(1, min(lag, len(times) - 1) + 1):
        both = scores[:-k].T @ scores[k:]
        total += (1 - k / (lag + 1)) * (both + both.T)
    return total


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
        found = begin(recording, fit, unknowns, now.std)
        recording, own, near = found.recording, found.own, found.seen.first
    whole = replace(recording, until=np.inf)
    return whole.evaluate(unknowns, theta, own, near).points
