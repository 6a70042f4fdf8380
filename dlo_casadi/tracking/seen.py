"""What a measured pose tells of a cable: residuals in units of the noise, and their derivatives.

The unknowns theta = theta_0 + A z with z ~ N(0, I), A A^T = P, are those of the fit. A pose tells
y = c(theta) + B w + e in units of its noise e ~ N(0, I), with w ~ N(0, I) for what differs from
pose to pose (fixtures, scatter, see `Repeats`). With H = dc/dtheta A and the innovation r,

    S = H H^T + B B^T + I,   K = H^T S^-1,   z = K (r + H z),   P = A (I - K H) A^T

linearised anew at each z until it stays, with steps halved that lead uphill: the iterated Kalman
filter, for poses that change nothing
equal to the batch fit to first order.

References
----------
Bell and Cathey, IEEE Trans. Autom. Control 38 (1993).
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np
from scipy.linalg import cho_factor, cho_solve, solve_triangular
from scipy.special import chdtrc

from dlo_casadi.arrays import FloatArray
from dlo_casadi.codegen import CompiledShape, CompiledSolver
from dlo_casadi.config import Pose
from dlo_casadi.equilibrium.batch import BatchEquilibrium
from dlo_casadi.equilibrium.curve import Observed, ObservedChange
from dlo_casadi.equilibrium.pose import HeldPose
from dlo_casadi.equilibrium.solve import MOST_MOVED, MOST_TURNED, solve_equilibrium
from dlo_casadi.errors import DloError
from dlo_casadi.model.assembly import Shapes
from dlo_casadi.model.cable_model import CableModel
from dlo_casadi.rod.band import Vector
from dlo_casadi.rod.ends import reaction_rows
from dlo_casadi.rod.quantities import quantity_of
from dlo_casadi.sensing.noise import correlation
from dlo_casadi.tracking.known import Known

# Relinearisations of an update, and the step at which they end, in standard deviations after it: a
# smaller one is as good as linear.
_ITERATIONS, _SMALL = 15, 0.1
# Share of the noise of a line that is correlated, if any is; the rest keeps close points apart.
_SHARE = 0.99
# Largest last step [rad] of Newton's method: a thousandth of what any camera sees.
_EXACT = 1e-7
# Probability of a pose by chance below which it is refused.
OUTLIER = 1e-5


@dataclass(frozen=True)
class Noise:
    """Standard deviations of what is measured.

    Parameters
    ----------
    point : float [m]
        Of one coordinate of a point.
    force, moment : float or None [N, N m]
        Of one component of a reading; None if readings are not used.
    along : float [m]
        Distance along a line at which errors of its points are correlated by 1/e; 0 if they are
        independent. Markers are.
    """

    point: float
    force: float | None = None
    moment: float | None = None
    along: float = 0.0


@dataclass(frozen=True, eq=False)
class Measured:
    """What was measured in a pose, at known places of the cable.

    Parameters
    ----------
    points : (K, d) [m]
    s : (K,) [m]
        Their places along the cable.
    marked : bool
        Whether these were measured, too; else only distances across the cable count.
    readings, rows, std : (r,)
        Components of forces and moments, their rows in `Observed.readings`, and their noise.
    noise : Noise
    mixed : (K, K) or None
        L of the correlations L L^T of errors along a line.
    """

    points: FloatArray
    s: FloatArray
    marked: bool
    readings: FloatArray
    rows: list[int]
    std: FloatArray
    noise: Noise
    mixed: FloatArray | None = None

    @classmethod
    def of(cls, pose: Pose, model: CableModel, noise: Noise) -> Measured:
        """Measurements of a pose; points without arc lengths have no places yet."""
        d = model.node.dimension
        points = np.zeros((0, d)) if pose.points is None else np.asarray(pose.points, dtype=float)
        if points.shape[1] != d:
            raise DloError(f"points: ({d},) each belongs here, found {points.shape[1]} coordinates")
        known = reaction_rows(model.node, len(model.clips))
        values: list[float] = []
        rows: list[int] = []
        std: list[float] = []
        for name, found in pose.readings.items():
            size = getattr(noise, quantity_of(name).name)
            if size is None:
                continue
            values += [float(x) for x in np.atleast_1d(found)]
            rows += range(known[name].start, known[name].stop)
            std += [size] * (known[name].stop - known[name].start)
        if len(values) != len(rows):
            raise DloError(f"readings: {len(rows)} components belong here, found {len(values)}")
        s = np.zeros(len(points)) if pose.at is None else np.asarray(pose.at, dtype=float)
        readings = np.array(values), rows, np.array(std)
        return cls(points, s, pose.at is not None, *readings, noise)

    @property
    def size(self) -> int:
        """Number of measured numbers."""
        points, d = self.points.shape
        return points * (d if self.marked else d - 1) + len(self.rows)

    def on(self, seen: Observed) -> Measured:
        """The same with the places of its points on a curve, if they are not known."""
        if self.marked or not len(self.points):
            return self
        s, mixed = seen.curve.nearest(self.points), self.mixed
        if mixed is None and self.noise.along:
            apart = np.abs(s[:, None] - s) / self.noise.along
            alike = _SHARE * correlation("exponential", apart) + (1 - _SHARE) * np.eye(len(s))
            mixed = np.linalg.cholesky(alike)
        return replace(self, s=s, mixed=mixed)

    def _across(self, seen: Observed, moved: FloatArray) -> FloatArray:
        """Displacements (K, d, q), or of a line those across it (K, d - 1, q)."""
        if self.marked or not len(self.points):
            return moved
        return np.asarray(np.einsum("knd,kdq->knq", seen.curve.normals(self.s), moved))

    def _rows(self, seen: Observed, moved: FloatArray) -> FloatArray:
        """Displacements (K, d, q) as rows (., q) with independent errors of one."""
        rows = self._across(seen, moved) / self.noise.point
        if self.mixed is not None:
            flat = rows.reshape(len(rows), -1)
            rows = solve_triangular(self.mixed, flat, lower=True).reshape(rows.shape)
        return np.asarray(rows.reshape(-1, moved.shape[2]))

    def rms(self, seen: Observed) -> float:
        """Root mean square [m] of a coordinate's distance from its prediction."""
        gap = (self.points - seen.curve.at(self.s))[..., None]
        return float(np.sqrt(np.square(self._across(seen, gap)).mean())) if gap.size else 0.0

    def off(self, seen: Observed) -> FloatArray:
        """Measured minus predicted (R,), in units of the noise."""
        gap = (self.points - seen.curve.at(self.s))[..., None]
        felt = (self.readings - seen.readings[self.rows]) / self.std if self.rows else np.zeros(0)
        return np.concatenate([self._rows(seen, gap)[:, 0], felt])

    def along(self, seen: Observed, change: ObservedChange) -> FloatArray:
        """Derivatives (R, q) of what is predicted, in units of the noise."""
        rows = self._rows(seen, seen.curve.moved(self.s, change.curve))
        if not self.rows:
            return rows
        return np.vstack([rows, change.readings[self.rows] / self.std[:, None]])

    def alike(self, seen: Observed, std: float) -> FloatArray:
        """Derivatives (R, d) by shifts of all points alike, of this standard deviation [m]."""
        d = self.points.shape[1]
        shift = np.broadcast_to(std * np.eye(d), (len(self.points), d, d))
        return np.vstack([self._rows(seen, shift), np.zeros((len(self.rows), d))])


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
        L of S = L L^T.
    innovation : (R,)
        Measured minus predicted, whitened by L.
    rms : float [m]
        Root of the mean square of the points' distances from where they were predicted.
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


@dataclass(eq=False)
class Shaper:
    """Finds equilibria: near the last one, by compiled C, or anew.

    Parameters
    ----------
    compiled : bool
        Whether a cable is compiled; it is once for each number and kind of clips.
    """

    compiled: bool = False
    last: tuple[CableModel, HeldPose, Shapes] | None = None
    _solvers: dict[Any, tuple[CompiledSolver, CompiledShape | None]] = field(default_factory=dict)

    def found(self, batch: BatchEquilibrium, cable: Known, held: HeldPose, *, anew: bool) -> Shapes:
        """The equilibrium of a pose; not the one near the last if `anew`."""
        p, rest, model = cable.p, cable.rest, cable.model
        near = None if anew else self._near(model, held)
        start = self._by_c(batch, cable, held, near) if self.compiled else near
        if start is not None:
            shapes, converged = batch.solve(declared(batch, start), p, rest, tolerance=_EXACT)
            if converged.all() and batch.stable(shapes, p, rest).all():
                return shapes
        return declared(batch, solve_equilibrium(model, p, rest, held).shapes)

    def _near(self, model: CableModel, held: HeldPose) -> Shapes | None:
        """The last shape if the fixtures have hardly moved since."""
        if self.last is None or self.last[0].clips != model.clips or self.last[0].n != model.n:
            return None
        _, before, shapes = self.last
        same = replace(before, name=held.name, **_places(held)) == held
        if not same:
            return None
        gaps, d = np.abs(held.ends - before.ends), model.node.dimension
        turned = MOST_TURNED if d == 2 else MOST_TURNED / 2  # parts of a quaternion
        near = (
            gaps[: 2 * d].max() <= MOST_MOVED * model.cable.length and gaps[2 * d :].max() <= turned
        )
        return shapes if near else None

    def _by_c(
        self, batch: BatchEquilibrium, cable: Known, held: HeldPose, near: Shapes | None
    ) -> Shapes | None:
        """A shape by C, of the cable as it was when it was compiled."""
        key = cable.model.clips
        if key not in self._solvers:
            self._solvers[key] = CompiledSolver(cable.model, cable.p, cable.rest), None
        solver, before = self._solvers[key]
        found = solver.solve(held, warm=None if near is None else before, throw=False)
        if found.status != "ok":
            return near
        self._solvers[key] = solver, found
        shapes = batch.start_shapes(found.x[None])
        return shapes if near is None else replace(shapes, lam=near.lam)


def _places(held: HeldPose) -> dict[str, Any]:
    """What may differ between poses that are near each other."""
    turned = ("start_heading", "end_heading", "start_orientation", "end_orientation")
    return {name: getattr(held, name) for name in ("start", "end", *turned)}


def declared(batch: BatchEquilibrium, shapes: Shapes) -> Shapes:
    """Shapes with fixtures where they are declared, for a batch's model."""
    still = np.zeros((len(shapes.x), len(batch.model.deviation_names)))
    return replace(shapes, deviation=still)


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
    after, seen = _learned(prior, own, held, pose, measured, number, shaper, anew=False)
    if seen.refused and shaper.last is not None:
        again = _learned(prior, own, held, pose, measured, number, shaper, anew=True)
        if again[1].probability > seen.probability:
            after, seen = again
    if not seen.refused:
        shaper.last = own.model, held, seen.shapes
    return after, seen


def _learned(
    prior: Known,
    own: Known,
    held: HeldPose,
    pose: Pose,
    measured: Measured,
    number: int,
    shaper: Shaper,
    *,
    anew: bool,
) -> tuple[Known, Seen]:
    uncertainty = prior.uncertainty
    batch = BatchEquilibrium(
        uncertainty.pose_scatter.within(own.model), [held], wrenches=bool(measured.rows)
    )
    by_p, by_rest, by_deviation = uncertainty.ways_in(own.model)
    count = len(uncertainty.names)
    z, seen = np.zeros(count), None
    shapes, least, best = shaper.found(batch, own, held, anew=anew), np.inf, z
    for iterations in range(1, _ITERATIONS + 1):
        now = own.moved(by_p[:, :count] @ z, by_rest[:, :count] @ z)
        if iterations > 1:
            shapes, converged = batch.solve(shapes, now.p, now.rest, tolerance=_EXACT)
            if not converged.all():
                found = solve_equilibrium(own.model, now.p, now.rest, held)
                shapes = declared(batch, found.shapes)
        rate = own.rises(now.p, own.p)
        along = batch.by_rest(shapes, now.p, now.rest, by_rest, rate[:, None] * by_p, by_deviation)
        ((told, change),) = batch.observe(shapes, now.p, now.rest, along)
        measured = measured.on(told)
        residual, columns = measured.off(told), measured.along(told, change)
        by_z = columns[:, :count]
        by_own = np.hstack([columns[:, count:], measured.alike(told, uncertainty.repeat_std)])
        noise = by_own @ by_own.T + np.eye(len(residual))
        cost = float(z @ z + residual @ np.linalg.solve(noise, residual))
        if cost > least:  # the step was too long
            z = (z + best) / 2
            continue
        least, best, spread = cost, z, noise + by_z @ by_z.T
        factor = cho_factor(spread, lower=True)
        if seen is None:
            whole = np.tril(factor[0])
            white = solve_triangular(whole, residual, lower=True)
            known = (number, pose, prior, own.model, held, shapes, measured)
            seen = Seen(*known, whole, white, measured.rms(told))
            if seen.refused:
                break
        gain = cho_solve(factor, by_z).T
        before, z = z, gain @ (residual + by_z @ z)
        left = np.eye(count) - gain @ by_z
        step = z - before
        if step @ np.linalg.solve(left, step) < _SMALL**2:
            break
        ahead = along.x[..., :count] @ step, along.lam[..., :count] @ step
        shapes = batch.moved(shapes, Vector(ahead[0][..., None], ahead[1][..., None]))
    else:
        z = best
    assert seen is not None
    seen = replace(seen, iterations=iterations)
    if seen.refused:
        return prior, seen
    rates = dict(zip(own.model.names, rate, strict=True))
    root = (
        np.array([rates.get(name, 1.0) for name in uncertainty.names])[:, None] * uncertainty.root
    )
    covariance = root @ ((left + left.T) / 2) @ root.T
    after = prior.moved(by_p[:, :count] @ z, by_rest[:, :count] @ z)
    return after.with_covariance(covariance), seen
