"""The bilevel batch problem as one NLP, solved by IPOPT.

    min   1/2 sum_j |R_j z(phi_j) - b_j|^2 + 1/2 sum_j |deviation_j / std|^2
          + 1/2 (theta - mean)^T P (theta - mean)
    over  theta (parameters and rest curvature, shared), and of every pose its headings phi_j,
          multipliers lam_j, deviations and, where a state is carried, rest curvature
    s.t.  grad_(phi, lam) Lagrangian(phi_j, lam_j; theta) = 0           (balance and end conditions)
          rest_(j+1) = next_rest(phi_j, rest_j)                         (only with a state)

The measured points enter through R_j, the triangular factor of whitening x normals x Hermite
interpolation: |R_j z - b_j|^2 equals the sum of squares over all points up to a constant. Feet
and normals are brought up to date between solves, until they stand still; at a foot the normal
distance is stationary in s, so that the fixed point is that of the consistent problem.

It has the same minimum as `gauss_newton`, by another route: nothing is eliminated, and the
Hessian is exact.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from dlo_casadi.errors import EstimationError
from dlo_casadi.estimation.gauss_newton import BatchProblem, Point
from dlo_casadi.estimation.observation import NodeCurve, normal_rows
from dlo_casadi.estimation.sweep import Shapes
from dlo_casadi.model import DEVIATIONS, CableModel

FloatArray = NDArray[np.floating]

# Feet that move less than this share of the noise between solves have settled.
FEET_TOLERANCE = 1e-3


@dataclass(frozen=True)
class BatchSolution:
    """Minimum of the batch NLP.

    Parameters
    ----------
    point : Point
    solves, iterations : int
        IPOPT runs (feet updates) and their iterations in all.
    residual : float
        Largest violation of a constraint in scaled units at the end.
    """

    point: Point
    solves: int
    iterations: int
    residual: float


def solve_batch(problem: BatchProblem, start: Point, max_solves: int = 4) -> BatchSolution:
    """Solve the batch NLP by IPOPT from a point near its minimum.

    Parameters
    ----------
    problem : BatchProblem
    start : Point
        For example of `fit_model`.

    Raises
    ------
    EstimationError
        If IPOPT does not converge.
    """
    nlp = _BatchNlp(problem)
    point, iterations, solves = start, 0, 0
    while True:
        rows, targets = zip(*_compressed(problem, point), strict=True)
        vector, stats, residual = nlp.solve(point, rows, targets)
        iterations += int(stats["iter_count"])
        solves += 1
        if not stats["success"]:
            raise EstimationError(
                f"the batch problem of {len(problem.used)} poses was not solved (IPOPT: "
                f"{stats['return_status']} after {stats['iter_count']} iterations).\n"
                "  Try: more poses, or estimation.robust: true if some points are far off."
            )
        theta, shapes = nlp.unpack(vector, point.shapes)
        moved = problem.evaluate(theta, shapes, point.feet)
        shift = max(
            float(np.abs(new - old).max()) for new, old in zip(moved.feet, point.feet, strict=True)
        )
        point = moved
        if shift < FEET_TOLERANCE * problem.noise.std or solves == max_solves:
            return BatchSolution(point, solves, iterations, residual)


def _compressed(problem: BatchProblem, point: Point) -> list[tuple[FloatArray, FloatArray]]:
    """Triangular factor (nz, nz) and target (nz,) of each fitted pose's points."""
    curves = problem.curves(point.theta, point.shapes)
    out = []
    for j, s in zip(problem.used, point.feet, strict=True):
        curve: NodeCurve = curves[j]
        normals = curve.normals(s)
        white = problem.whitening(j, s)
        rows = white @ normal_rows(curve, s, normals)
        target = white @ (problem.measured[j].points * normals).sum(axis=1)
        size = rows.shape[1]
        triangle = np.linalg.qr(np.column_stack([rows, target]), mode="r")
        padded = np.zeros((size, size + 1))
        keep = min(size, len(triangle))
        padded[:keep] = triangle[:keep]
        out.append((padded[:, :size], padded[:, size]))
    return out


class _BatchNlp:
    """The NLP's expressions, built once; the points' factors are its parameters."""

    def __init__(self, problem: BatchProblem) -> None:
        self.problem = problem
        unknowns, model = problem.unknowns, problem.unknowns.model
        self.poses = list(range(problem.sweep.m)) if model.has_state else list(problem.used)
        self.n_phi, self.n_lam = model.chain.n_headings, model.n_conditions
        self.columns = problem.sweep.used_deviations
        n_dev, n_cells, n_z = len(self.columns), model.chain.n_cells, self._n_z(model)
        self.stride = self.n_phi + self.n_lam + n_dev + (n_cells if model.has_state else 0)
        # Multipliers and balance in units of a typical force: EI turns^2.
        self.force = model.cable.bending_stiffness * model.cable.curvature_scale**2

        theta = ca.SX.sym("theta", unknowns.size)
        own = ca.SX.sym("own", self.stride)
        ends = ca.SX.sym("ends", 6)
        p = unknowns.symbolic_p(theta)
        phi, lam, dev, rest = self._split(own, n_dev)
        deviation = ca.SX.zeros(len(DEVIATIONS))
        for k, column in enumerate(self.columns):
            deviation[column] = dev[k] * problem.deviation_std[k]
        if not model.has_state:
            rest = unknowns.symbolic_rest(theta)
        arguments = [phi, lam * self.force, p, rest, ends, deviation]
        kkt = model.balance(*arguments)
        scale = np.concatenate(
            [
                np.full(self.n_phi, 1 / (self.force * model.cable.length)),
                np.full(self.n_lam, 1 / model.cable.length),
            ]
        )
        self.pose = ca.Function(
            "pose",
            [own, theta, ends],
            [kkt * scale, model.shape(*arguments), model.next_rest(*arguments)[0], deviation],
        )
        x_theta = ca.MX.sym("theta", unknowns.size)
        x_own = ca.MX.sym("own", self.stride, len(self.poses))
        factor = ca.MX.sym("factor", n_z, n_z * len(problem.used))
        target = ca.MX.sym("target", n_z, len(problem.used))
        poses = self.pose.map(len(self.poses))
        fixed = ca.DM(np.array([problem.measured[j].pose.vector for j in self.poses]).T)
        balance, z, after, _ = poses(x_own, ca.repmat(x_theta, 1, len(self.poses)), fixed)
        gap = x_theta - ca.DM(problem.mean)
        objective = ca.bilin(ca.DM(problem.precision), gap, gap) / 2
        for k, j in enumerate(problem.used):
            column = self.poses.index(j)
            block = factor[:, k * n_z : (k + 1) * n_z]
            objective += ca.sumsqr(block @ z[:, column] - target[:, k]) / 2
            at = self.n_phi + self.n_lam
            objective += ca.sumsqr(x_own[at : at + n_dev, column]) / 2
        constraints = [ca.vec(balance)]
        if model.has_state:
            first = ca.MX(ca.DM(unknowns.rest_slopes)) @ x_theta
            begins = x_own[self.n_phi + self.n_lam + n_dev :, :]
            carried = ca.horzcat(first, after[:, :-1])
            constraints.append(ca.vec(begins - carried) / model.cable.curvature_scale)
        lower, upper = unknowns.bounds
        free = np.full(self.stride * len(self.poses), np.inf)
        self.lower, self.upper = np.concatenate([lower, -free]), np.concatenate([upper, free])
        self.solver = ca.nlpsol(
            "batch",
            "ipopt",
            {
                "x": ca.vertcat(x_theta, ca.vec(x_own)),
                "p": ca.vertcat(ca.vec(factor), ca.vec(target)),
                "f": objective,
                "g": ca.vertcat(*constraints),
            },
            {
                "print_time": False,
                "ipopt.print_level": 0,
                "ipopt.sb": "yes",
                "ipopt.tol": 1e-8,
                "ipopt.max_iter": 100,
                "ipopt.mu_init": 1e-6,
                "ipopt.bound_push": 1e-9,
                "ipopt.bound_frac": 1e-9,
                "ipopt.nlp_scaling_method": "none",
            },
        )

    @staticmethod
    def _n_z(model: CableModel) -> int:
        return int(model.shape.size1_out(0))

    def _split(self, own: ca.SX, n_dev: int) -> tuple[ca.SX, ca.SX, ca.SX, ca.SX]:
        a, b, c = self.n_phi, self.n_phi + self.n_lam, self.n_phi + self.n_lam + n_dev
        return own[:a], own[a:b], own[b:c], own[c:]

    def solve(
        self, point: Point, rows: tuple[FloatArray, ...], targets: tuple[FloatArray, ...]
    ) -> tuple[FloatArray, dict[str, Any], float]:
        """One IPOPT run with frozen feet."""
        problem = self.problem
        rests = problem.sweep.rests(
            point.shapes, problem.unknowns.p(point.theta), problem.unknowns.rest(point.theta)
        )
        own = []
        for j in self.poses:
            scaled = point.shapes.deviation[j, self.columns] / problem.deviation_std
            parts = [point.shapes.phi[j], point.shapes.lam[j] / self.force, scaled]
            if problem.unknowns.model.has_state:
                parts.append(rests[j])
            own.append(np.concatenate(parts))
        out = self.solver(
            x0=np.concatenate([point.theta, *own]),
            p=np.concatenate([np.concatenate([r.ravel(order="F") for r in rows]), *targets]),
            lbx=self.lower,
            ubx=self.upper,
            lbg=0.0,
            ubg=0.0,
        )
        residual = float(np.abs(np.array(out["g"])).max())
        return np.array(out["x"]).ravel(), self.solver.stats(), residual

    def unpack(self, vector: FloatArray, shapes: Shapes) -> tuple[FloatArray, Shapes]:
        """Unknowns and shapes of the solution."""
        size = self.problem.unknowns.size
        theta, own = vector[:size], vector[size:].reshape((len(self.poses), self.stride))
        phi, lam, deviation = shapes.phi.copy(), shapes.lam.copy(), shapes.deviation.copy()
        at = self.n_phi + self.n_lam
        for j, row in zip(self.poses, own, strict=True):
            phi[j], lam[j] = row[: self.n_phi], row[self.n_phi : at] * self.force
            scaled = row[at : at + len(self.columns)]
            deviation[j, self.columns] = scaled * self.problem.deviation_std
        return theta, Shapes(phi, lam, deviation)
