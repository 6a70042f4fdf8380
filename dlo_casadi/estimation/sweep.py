"""Equilibria of many poses at once: one Newton method over the stacked poses.

All poses share the parameters; a drift carries the rest curvature from pose to pose. The
Newton step solves the poses' KKT systems as one batch and passes changes of the rest curvature
on in order.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from dlo_casadi.equilibrium import JOINT_BOUND, Pose, is_stable
from dlo_casadi.model import DEVIATIONS, CableModel

FloatArray = NDArray[np.floating]

# Newton's method in a sweep: longest step of a heading, and how far headings may move from where
# it started [rad].
LONGEST_STEP = 0.5
REACH = 1.5


@dataclass(frozen=True)
class Shapes:
    """Stacked unknowns of m poses.

    Parameters
    ----------
    phi : (m, n_headings) [rad]
    lam : (m, n_conditions)
    deviation : (m, len(DEVIATIONS))
        What is different in every pose, see `model.DEVIATIONS`.
    """

    phi: FloatArray
    lam: FloatArray
    deviation: FloatArray

    def subset(self, index: Sequence[int] | NDArray[np.intp]) -> Shapes:
        """Shapes of some of the poses."""
        return Shapes(self.phi[index], self.lam[index], self.deviation[index])


@dataclass(frozen=True)
class Sensitivities:
    """Derivatives of the stacked equilibria.

    `theta` (m, N, size) by the unknowns, `deviation` (m, N, len(DEVIATIONS)) by each pose's own
    deviation; N counts headings and multipliers. `rest` (m, n_cells, size) is that of the rest
    curvature which each pose finds.
    """

    theta: FloatArray
    deviation: FloatArray
    rest: FloatArray


@dataclass(frozen=True)
class Observations:
    """Measured curves `z` (m, nz) and their direct derivatives (m, nz, ...).

    `by_x` by headings and multipliers, `by_p`, `by_rest` by the rest curvature that the pose
    finds, `by_deviation`.
    """

    z: FloatArray
    by_x: FloatArray
    by_p: FloatArray
    by_rest: FloatArray
    by_deviation: FloatArray

    def by_theta(self, j: int, sens: Sensitivities, slopes: FloatArray) -> FloatArray:
        """Derivative (nz, size) of pose j by the unknowns, through its equilibrium."""
        return self.by_x[j] @ sens.theta[j] + self.by_p[j] @ slopes + self.by_rest[j] @ sens.rest[j]

    def by_own(self, j: int, sens: Sensitivities) -> FloatArray:
        """Derivative (nz, len(DEVIATIONS)) of pose j by its deviation."""
        return self.by_x[j] @ sens.deviation[j] + self.by_deviation[j]


class _OverPoses:
    """A CasADi function called pose by pose that reads and writes NumPy's memory, without copies.

    Converting between DM and NumPy costs several times the evaluation itself.
    """

    def __init__(self, function: ca.Function, m: int) -> None:
        # Any: CasADi's stubs do not know that a buffer takes NumPy's memory.
        self._buffer: Any
        self._buffer, self._run = function.buffer()
        self._inputs: list[Any] = [
            np.zeros((m, function.size1_in(i))) for i in range(function.n_in())
        ]
        self._rows = [[memoryview(row) for row in block] for block in self._inputs]
        self._shapes = [
            (function.size2_out(i), function.size1_out(i)) for i in range(function.n_out())
        ]

    def __call__(self, count: int, *arguments: FloatArray) -> list[FloatArray]:
        """Arguments (count, rows) or (rows,) for all alike -> outputs (count, rows, columns)."""
        for block, value in zip(self._inputs, arguments, strict=True):
            block[:count] = value
        outputs = [np.zeros((count, *shape)) for shape in self._shapes]
        for j in range(count):
            for i, rows in enumerate(self._rows):
                self._buffer.set_arg(i, rows[j])
            for i, out in enumerate(outputs):
                self._buffer.set_res(i, memoryview(out[j]))
            self._run()
        return [block.transpose(0, 2, 1) for block in outputs]


class Sweep:
    """A model evaluated over m poses at once.

    Parameters
    ----------
    model : CableModel
    poses : sequence of Pose
        In the order in which they were taken.
    """

    def __init__(self, model: CableModel, poses: Sequence[Pose]) -> None:
        self.model = model
        self.poses = tuple(poses)
        self.m = len(self.poses)
        self.n_phi = model.chain.n_headings
        self.n_unknowns = self.n_phi + model.n_conditions
        self._ends = np.array([pose.vector for pose in self.poses])
        self._functions: dict[str | tuple[str, ...], _OverPoses] = {}
        self.used_deviations = [DEVIATIONS.index(name) for name in model.deviations]

    def __getstate__(self) -> dict[str, Any]:
        """Without compiled functions: another process makes its own."""
        return {**self.__dict__, "_functions": {}}

    def _call(
        self,
        name: str,
        shapes: Shapes,
        p: FloatArray,
        rest: FloatArray,
        chosen: NDArray[np.intp] | None = None,
    ) -> list[FloatArray]:
        """Evaluate a function of the model, for all poses or those chosen: (m, rows, columns)."""
        if name not in self._functions:
            self._functions[name] = _OverPoses(getattr(self.model, name), self.m)
        ends = self._ends if chosen is None else self._ends[chosen]
        return self._functions[name](
            len(ends), shapes.phi, shapes.lam, p, rest, ends, shapes.deviation
        )

    def _after(self, j: int, shapes: Shapes, p: FloatArray, rest: FloatArray) -> list[FloatArray]:
        """Rest curvature after pose j and its derivatives by (phi, rest before, p)."""
        if "after" not in self._functions:
            self._functions["after"] = _OverPoses(self.model.next_rest, 1)
        arguments = (shapes.phi[j], shapes.lam[j], p, rest, self._ends[j], shapes.deviation[j])
        return [block[0] for block in self._functions["after"](1, *arguments)]

    def kkt(self, shapes: Shapes, p: FloatArray, rest: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Imbalance (m, N) and KKT matrices (m, N, N); `rest` is that before the first pose."""
        force, matrix = self._call("kkt", shapes, p, self.rests(shapes, p, rest))
        return force[:, :, 0], matrix

    def rests(self, shapes: Shapes, p: FloatArray, rest: FloatArray) -> FloatArray:
        """Rest curvature (m, n_cells) that each pose finds, from the first on.

        A `rest` that is given per pose already, (m, n_cells), is returned as it is.
        """
        if rest.ndim == 2:
            return rest
        if not self.model.has_state:
            return np.repeat(rest[None], self.m, axis=0)
        out = [rest]
        for j in range(self.m - 1):
            out.append(self._after(j, shapes, p, out[-1])[0][:, 0])
        return np.array(out)

    def rest_after_last(self, shapes: Shapes, p: FloatArray, rest: FloatArray) -> FloatArray:
        """Rest curvature (n_cells,) that the last pose leaves behind."""
        last = self.rests(shapes, p, rest)[-1]
        return self._after(self.m - 1, shapes, p, last)[0][:, 0]

    def bends(self, shapes: Shapes, p: FloatArray, rest: FloatArray) -> FloatArray:
        """Curvature minus the rest curvature that each pose finds (m, n_cells) [1/m]."""
        strain, rests = self.model.strain, self.rests(shapes, p, rest)
        given = zip(shapes.phi, self._ends, shapes.deviation, strict=True)
        return np.array([np.array(strain(*pose, p)).ravel() for pose in given]) - rests

    def _carry(
        self, shapes: Shapes, p: FloatArray, rests: FloatArray
    ) -> list[tuple[FloatArray, FloatArray, FloatArray]]:
        """Derivatives of each pose's rest curvature after it, by (phi, rest before, p)."""
        blocks = []
        for j in range(self.m):
            _, by_phi, by_rest, by_p = self._after(j, shapes, p, rests[j])
            blocks.append((by_phi, by_rest, by_p))
        return blocks

    def solve(
        self,
        shapes: Shapes,
        p: FloatArray,
        rest: FloatArray,
        max_iterations: int = 25,
        tolerance: float = 1e-10,
        reach: float = REACH,
    ) -> tuple[Shapes, NDArray[np.bool_]]:
        """Newton's method from nearby shapes, for each pose until it has converged or is lost.

        Parameters
        ----------
        shapes : Shapes
            Where to start; deviations are kept.
        p : (n_parameters,) or (m, n_parameters)
        rest : (n_cells,) or (m, n_cells) [1/m]
            Before the first pose, or of each pose.
        tolerance : float [rad]
            Largest step at convergence.
        reach : float [rad]
            A pose whose headings move farther is lost: it runs for another equilibrium, or none.

        Returns
        -------
        Shapes, (m,) bool
            The shapes, and which poses have converged; the others stay where they started. Where
            a state couples the poses, all have converged or none.
        """
        phi, lam = shapes.phi.copy(), shapes.lam.copy()
        converged = np.zeros(self.m, dtype=bool)
        coupled = self.model.has_state and rest.ndim == 1
        active, last = np.arange(self.m), np.full(self.m, np.inf)
        for _ in range(max_iterations):
            now = Shapes(phi[active], lam[active], shapes.deviation[active])
            rests = self.rests(replace(shapes, phi=phi, lam=lam), p, rest)[active]
            own = p if p.ndim == 1 else p[active]
            force, matrix = self._call("kkt", now, own, rests, active)
            finite = np.isfinite(matrix).all(axis=(1, 2))
            if not finite.all():
                matrix[~finite], force[~finite] = np.eye(matrix.shape[1]), np.nan
            try:
                step = -np.linalg.solve(matrix, force)[:, :, 0]
            except np.linalg.LinAlgError:
                break
            if coupled:
                step = self._pass_on(now, p, rests, matrix, step)
            size = np.abs(step[:, : self.n_phi]).max(axis=1)
            if coupled:
                size[:] = size.max()
            damp = np.minimum(1.0, LONGEST_STEP / np.maximum(size, 1e-300))
            phi[active] += damp[:, None] * step[:, : self.n_phi]
            lam[active] += damp[:, None] * step[:, self.n_phi :]
            done = _settled(size, last[active], tolerance)
            moved = np.abs(phi[active] - shapes.phi[active]).max(axis=1)
            lost = ~(moved <= reach)
            converged[active[done & ~lost]] = True
            last[active] = size
            if coupled and lost.any():
                break
            active = active[~(done | lost)]
            if not len(active):
                break
        phi[~converged], lam[~converged] = shapes.phi[~converged], shapes.lam[~converged]
        return replace(shapes, phi=phi, lam=lam), converged

    def _pass_on(
        self,
        shapes: Shapes,
        p: FloatArray,
        rests: FloatArray,
        matrix: FloatArray,
        step: FloatArray,
    ) -> FloatArray:
        """Newton step with the change of rest curvature handed from pose to pose."""
        _, by_rest, _ = self._call("sensitivity", shapes, p, rests)
        carry = self._carry(shapes, p, rests)
        change = np.zeros(rests.shape[1])
        out = step.copy()
        for j in range(self.m):
            if change.any():
                out[j] -= np.linalg.solve(matrix[j], by_rest[j] @ change)
            by_phi, by_before, _ = carry[j]
            change = by_phi @ out[j, : self.n_phi] + by_before @ change
        return out

    def sensitivities(
        self,
        shapes: Shapes,
        p: FloatArray,
        rest: FloatArray,
        slopes: FloatArray,
        rest_slopes: FloatArray,
    ) -> Sensitivities:
        """Derivatives of the equilibria by the implicit function theorem.

        Parameters
        ----------
        slopes : (n_parameters, size)
            dp/dtheta.
        rest_slopes : (n_cells, size)
            d rest / d theta before the first pose.
        """
        rests = self.rests(shapes, p, rest)
        _, matrix = self._call("kkt", shapes, p, rests)
        by_p, by_rest, by_deviation = self._call("sensitivity", shapes, p, rests)
        size = slopes.shape[1]
        direct = by_p @ slopes
        if not self.model.has_state:
            right = np.concatenate([direct + by_rest @ rest_slopes, by_deviation], axis=2)
            solved = -np.linalg.solve(matrix, right)
            same = np.broadcast_to(rest_slopes, (self.m, *rest_slopes.shape))
            return Sensitivities(solved[:, :, :size], solved[:, :, size:], same)
        solved = -np.linalg.solve(matrix, np.concatenate([direct, by_rest, by_deviation], axis=2))
        n_cells = rest_slopes.shape[0]
        carry = self._carry(shapes, p, rests)
        change = rest_slopes
        rows: list[FloatArray] = []
        found: list[FloatArray] = []
        for j in range(self.m):
            found.append(change)
            total = solved[j, :, :size] + solved[j, :, size : size + n_cells] @ change
            rows.append(total)
            by_phi, by_before, by_own = carry[j]
            change = by_phi @ total[: self.n_phi] + by_before @ change + by_own @ slopes
        return Sensitivities(np.array(rows), solved[:, :, size + n_cells :], np.array(found))

    def observe(self, shapes: Shapes, p: FloatArray, rest: FloatArray) -> Observations:
        """Measured curves and their derivatives."""
        rests = self.rests(shapes, p, rest)
        z, *slopes = self._call("observation", shapes, p, rests)
        return Observations(z[:, :, 0], *slopes)

    def reach(self, shapes: Shapes, p: FloatArray, rest: FloatArray) -> FloatArray:
        """Change of the measured curves by a change of the imbalance (m, nz, N): -dz/dx K^-1."""
        _, matrix = self.kkt(shapes, p, rest)
        by_x = self.observe(shapes, p, rest).by_x
        solved = np.linalg.solve(matrix.transpose(0, 2, 1), by_x.transpose(0, 2, 1))
        return np.asarray(-solved.transpose(0, 2, 1))

    def slopes_by(
        self, names: tuple[str, ...], shapes: Shapes, p: FloatArray, rest: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Direct derivatives of the imbalance (m, N, q) and of the measured curves (m, nz, q)."""
        if names not in self._functions:
            self._functions[names] = _OverPoses(self.model.slopes_by(names), self.m)
        rests = self.rests(shapes, p, rest)
        balance, z = self._functions[names](
            self.m, shapes.phi, shapes.lam, p, rests, self._ends, shapes.deviation
        )
        return balance, z

    def shapes_seen(self, shapes: Shapes, p: FloatArray, rest: FloatArray) -> FloatArray:
        """Observation vectors (m, nz) only."""
        return self._call("shape", shapes, p, self.rests(shapes, p, rest))[0][:, :, 0]

    def stable(self, shapes: Shapes, p: FloatArray, rest: FloatArray) -> NDArray[np.bool_]:
        """Whether each pose is a strict minimum of the energy under its end conditions."""
        _, matrix = self._call("kkt", shapes, p, self.rests(shapes, p, rest))
        bends = np.abs(np.diff(shapes.phi, axis=1)).max(axis=1)
        return np.array(
            [
                is_stable(k, self.model.n_conditions) and bend < JOINT_BOUND
                for k, bend in zip(matrix, bends, strict=True)
            ]
        )


def _settled(size: FloatArray, last: FloatArray, tolerance: float) -> NDArray[np.bool_]:
    """Whether Newton's method has converged with steps of this size after the last ones.

    Steps that shrink quadratically need no further one to show that it would be too small, and
    steps at rounding no longer shrink.
    """
    ahead = size * (size / last) ** 2
    quadratic = np.isfinite(last) & (size < 1e-4) & (ahead < tolerance / 100)
    return (size < tolerance) | quadratic | ((size < 1e-7) & (size > 0.5 * last))
