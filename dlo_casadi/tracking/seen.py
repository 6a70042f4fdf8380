"""A cable learns from one pose after the other.

The unknowns theta = theta_0 + A z with z ~ N(0, I), A A^T = P, are those of the fit. A pose tells
y = c(theta) + B w + e in units of its noise e ~ N(0, I), with w ~ N(0, I) for what differs from
pose to pose (fixtures, scatter, see `Repeats`). With H = dc/dtheta A, the residual r at z, and
N = B B^T + I,

    P = A (I + H^T N^-1 H)^-1 A^T,   z = (I + H^T N^-1 H)^-1 H^T N^-1 (r + H z)

linearised anew at each z until it stays, with steps halved that lead uphill: the iterated Kalman
filter. For poses that change nothing it equals the batch fit to first order; `smoothed` makes up
for the rest.

References
----------
Bell and Cathey, IEEE Trans. Autom. Control 38 (1993).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.linalg import solve_triangular
from scipy.special import chdtrc

from dlo_casadi.arrays import FloatArray
from dlo_casadi.config import Pose
from dlo_casadi.equilibrium.batch import BatchEquilibrium
from dlo_casadi.equilibrium.pose import HeldPose
from dlo_casadi.errors import EquilibriumError
from dlo_casadi.model.assembly import Shapes
from dlo_casadi.model.cable_model import CableModel
from dlo_casadi.tracking.known import Known
from dlo_casadi.tracking.measured import Measured, Noise
from dlo_casadi.tracking.shaper import Linear, Shaper

# Relinearisations of an update, and the step at which they end, in standard deviations after it: a
# smaller one is as good as linear.
_ITERATIONS, _SMALL = 15, 0.1
# Error of a linear prediction, in standard deviations of the noise, that is too small to matter.
_LINEAR = 0.005
# Probability of a pose by chance below which it is refused.
OUTLIER = 1e-5
# So many poses in a row that are refused are a change.
IN_A_ROW = 3


@dataclass(frozen=True, eq=False)
class Told:
    """What a pose tells of the unknowns, linearised: e = G (theta - theta_0) + N(0, I).

    Parameters
    ----------
    at : Known
        The cable at theta_0; stiffnesses count in logarithms.
    residual : (R,)
    columns : (R, n)
    turns : (k, n) [rad]
        Derivatives of the nodes.
    shapes : Shapes
    """

    at: Known
    residual: FloatArray
    columns: FloatArray
    turns: FloatArray
    shapes: Shapes

    @cached_property
    def information(self) -> FloatArray:
        """G^T G (n, n)."""
        return self.columns.T @ self.columns

    @cached_property
    def slope(self) -> FloatArray:
        """G^T (e + G theta_0) (n,)."""
        return self.columns.T @ self.residual + self.information @ self.at.unknowns


def errors(told: Sequence[Told], steps: FloatArray) -> FloatArray:
    """Second-order change of what each pose predicts, in units of the noise, roughly.

    It is the first-order one times how far nodes turn or stiffnesses change by the steps (m, n).
    """
    information = np.array([one.information for one in told])
    turns = np.array([one.turns for one in told])
    felt = np.maximum(np.einsum("mi,mij,mj->m", steps, information, steps), 0.0)
    rise = np.abs(steps * told[0].at.are_logs).max(axis=1)
    turned = np.abs(turns @ steps[..., None]).max(axis=(1, 2))
    return np.asarray(np.maximum(rise, turned) * np.sqrt(felt) / 2)


@dataclass(frozen=True, eq=False)
class Seen:
    """A pose as it was seen before it was used.

    Parameters
    ----------
    number : int
        Of the pose, the first is 1.
    pose : Pose
    prior : Known
        What was known of the cable.
    model, held : CableModel, HeldPose
        With the clips of the pose.
    shapes : Shapes
        The predicted equilibrium.
    measured : Measured
    factor : (R, R)
        L of S = H H^T + N = L L^T.
    innovation : (R,)
        Measured minus predicted, whitened by L.
    rms : float [m]
        Root of the mean square of the points' distances from where they were predicted.
    told : Told
        What it told where it was used.
    iterations : int
    """

    number: int
    pose: Pose
    prior: Known
    model: CableModel
    held: HeldPose
    shapes: Shapes
    measured: Measured
    factor: FloatArray
    innovation: FloatArray
    rms: float
    told: Told
    iterations: int = 0

    @cached_property
    def probability(self) -> float:
        """Of an innovation as large by chance."""
        return float(chdtrc(len(self.innovation), self.innovation @ self.innovation))

    @property
    def refused(self) -> bool:
        """Whether it was seen wrong."""
        return self.probability < OUTLIER

    @property
    def log_likelihood(self) -> float:
        """Of what was measured, up to a constant."""
        r = self.innovation
        return float(-(r @ r) / 2 - np.log(np.diag(self.factor)).sum())


def learned(
    prior: Known, pose: Pose, held: HeldPose, noise: Noise, number: int, shaper: Shaper
) -> tuple[Known, Seen | None]:
    """The cable after a pose, and how the pose was seen; None if nothing was measured.

    A pose that a shape near the last one does not explain is solved anew: cables snap.
    """
    own = prior.between(held)
    measured = Measured.of(pose, own.model, noise)
    if not measured.size:
        return prior, None
    after, seen = _learned(own, held, pose, measured, number, shaper, anew=False)
    if seen.refused and shaper.knows:
        again = _learned(own, held, pose, measured, number, shaper, anew=True)
        if again[1].probability > seen.probability:
            after, seen = again
    if seen.refused:
        return prior, seen
    shaper.keep(own.model, held, seen.shapes)
    return replace(after, model=prior.model), seen


def _learned(
    own: Known,
    held: HeldPose,
    pose: Pose,
    measured: Measured,
    number: int,
    shaper: Shaper,
    *,
    anew: bool,
) -> tuple[Known, Seen]:
    batch = _batch(own, held, measured)
    root, ways = own.root, shaper.ways(own)
    z: FloatArray = np.zeros(root.shape[1])
    seen: Seen | None = None
    start, least, best = shaper.start(batch, own, anew=anew), np.inf, z
    for iterations in range(1, _ITERATIONS + 1):  # noqa: B007
        now = own.at(ways, root @ z)
        told, spread, linear, measured = _told(batch, now, measured, shaper, ways, start)
        cost = float(z @ z + told.residual @ told.residual)
        if cost > least:  # the step was too long
            z, start = (z + best) / 2, linear.shapes
            continue
        least, best = cost, z
        columns = told.columns @ root
        if seen is None:
            seen = _seen(number, pose, own, held, measured, told, spread, columns, linear)
            if seen.refused:
                return own, seen
        information = np.eye(len(z)) + columns.T @ columns
        before, z = z, np.linalg.solve(information, columns.T @ (told.residual + columns @ z))
        step = z - before
        if (
            step @ information @ step < _SMALL**2
            or errors([told], (root @ step)[None])[0] < _LINEAR
        ):
            break
        start = linear.ahead(batch, root @ step)
    else:
        z = best
    assert seen is not None
    after = own.at(ways, root @ z)
    left = np.linalg.inv(np.linalg.cholesky(information)).T
    return after.with_root(root @ left), replace(seen, told=told, iterations=iterations)


def joined(base: Known, poses: Sequence[Seen], shaper: Shaper) -> Known:
    """The cable after poses, from what was known before them and what each of them told."""
    root = base.root
    total = sum(one.told.information for one in poses)
    slope = sum(one.told.slope for one in poses) - total @ base.unknowns
    information = np.eye(root.shape[1]) + root.T @ total @ root
    after = base.at(shaper.ways(base), root @ np.linalg.solve(information, root.T @ slope))
    return after.with_root(root @ np.linalg.inv(np.linalg.cholesky(information)).T)


def smoothed(
    base: Known, poses: Sequence[Seen], now: Known, shaper: Shaper
) -> tuple[Known, list[Seen]]:
    """The cable after poses, those linearised anew from whose place it has moved too far since.

    Where a parameter is hardly known, the first poses are seen with wrong derivatives; a filter
    would never mend that. As in incremental smoothing, a pose is linearised again only where it
    matters (Kaess et al., Int. J. Robot. Res. 31 (2012)).
    """
    poses = list(poses)
    for _ in range(_ITERATIONS):
        told = [one.told for one in poses]
        steps = now.unknowns - np.array([one.at.unknowns for one in told])
        far = np.flatnonzero(errors(told, steps) > _LINEAR)
        if not len(far):
            break
        try:
            for k in far:
                poses[k] = replace(poses[k], told=_again(poses[k], now, shaper))
        except EquilibriumError:
            break
        now = joined(base, poses, shaper)
    return now, poses


def _again(seen: Seen, now: Known, shaper: Shaper) -> Told:
    """What a pose tells, linearised at other values."""
    own = now.between(seen.held)
    batch = _batch(own, seen.held, seen.measured)
    return _told(batch, own, seen.measured, shaper, shaper.ways(own), seen.told.shapes)[0]


def _batch(own: Known, held: HeldPose, measured: Measured) -> BatchEquilibrium:
    model = own.uncertainty.pose_scatter.within(own.model)
    return BatchEquilibrium(model, [held], wrenches=bool(measured.rows))


def _told(
    batch: BatchEquilibrium,
    now: Known,
    measured: Measured,
    shaper: Shaper,
    ways: tuple[FloatArray, ...],
    start: Shapes | None,
) -> tuple[Told, FloatArray, Linear, Measured]:
    """What a pose tells, L of its noise N = L L^T, and where its points are."""
    count, scale = len(now.uncertainty.names), now.scale
    by_p = ways[0].copy()
    by_p[:, :count] *= scale
    linear = shaper.found(batch, now, (by_p, *ways[1:]), start)
    measured = measured.on(linear.told)
    residual, columns = measured.off(linear.told), measured.along(linear.told, linear.change)
    alike = measured.alike(linear.told, now.uncertainty.repeat_std)
    own = np.hstack([columns[:, count:], alike])
    spread = np.linalg.cholesky(own @ own.T + np.eye(len(residual)))
    white = solve_triangular(
        spread, np.column_stack([residual, columns[:, :count]]), lower=True, check_finite=False
    )
    turns = linear.along.x[0, ..., :count].reshape(-1, count)
    return Told(now, white[:, 0], white[:, 1:], turns, linear.shapes), spread, linear, measured


def _seen(
    number: int,
    pose: Pose,
    own: Known,
    held: HeldPose,
    measured: Measured,
    told: Told,
    spread: FloatArray,
    columns: FloatArray,
    linear: Linear,
) -> Seen:
    """A pose as it was predicted; `columns` by independent unknowns."""
    factor = np.linalg.cholesky(columns @ columns.T + np.eye(len(columns)))
    white = solve_triangular(factor, told.residual, lower=True)
    rms = measured.rms(linear.told)
    known = (number, pose, own, own.model, held, linear.shapes, measured)
    return Seen(*known, spread @ factor, white, rms, told)
