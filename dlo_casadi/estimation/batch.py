"""The bilevel batch problem as one NLP, solved by IPOPT.

    min   1/2 sum_j |R_j z(phi_j) - b_j|^2 + 1/2 sum_j |deviation_j / std|^2
          + 1/2 (theta - mean)^T P (theta - mean)
    over  theta (parameters and rest curvature, shared), and of every pose its headings phi_j,
          multipliers lam_j, deviations and, where a state is carried, rest curvature
    s.t.  grad_(phi, lam) Lagrangian(phi_j, lam_j; theta) = 0           (balance and end conditions)
          rest_(j+1) = rest_after(x_j, rest_j)                         (only with a state)

The measurements enter through R_j, the triangular factor of the whitened residuals' Jacobian by z,
the numbers of the curve, of its ends where they slide, and of the wrench measurements (for lines:
whitening x normals x Hermite interpolation). |R_j z - b_j|^2 equals the sum of squares up to a
constant. Projections and normals are updated between solves until they no longer change. The normal
distance is stationary in s at a projection, so the fixed point solves the consistent problem.

This NLP has the same minimum as `descent.descend`, but it eliminates nothing and its Hessian is
exact.
"""

from typing import Any

import casadi as ca
import numpy as np

from dlo_casadi.arrays import FloatArray
from dlo_casadi.equilibrium.by_ipopt import run_ipopt
from dlo_casadi.equilibrium.curve import ObservedChange
from dlo_casadi.errors import EstimationError, counted
from dlo_casadi.estimation.problem import Problem
from dlo_casadi.estimation.unknowns import Point, Values
from dlo_casadi.model.assembly import Shapes
from dlo_casadi.model.cable_model import BENDING_STIFFNESS
from dlo_casadi.model.whole_pose import PoseSymbols, balance, curve, ends, readings, rest_after

# Projections that move less than this share of the noise between solves have converged.
SHIFT_TOLERANCE = 1e-3
# Largest number of solves, each with new projections.
MOST_SOLVES = 4


def solve_batch(problem: Problem, start: Point) -> tuple[Point, float]:
    """Solve the batch NLP by IPOPT from a point near its minimum.

    Parameters
    ----------
    start : Point
        For example the result of `fit_model`.

    Returns
    -------
    Point, float
        The minimum, and the largest violation of a constraint there in scaled units.

    Raises
    ------
    EstimationError
        If IPOPT does not converge.
    """
    nlp = _BatchNlp(problem, problem.unknowns.p(start.theta))
    point = start
    for _ in range(MOST_SOLVES):
        theta, shapes, residual = nlp.solve(point)
        moved = problem.evaluate(Values(theta, shapes, point.projections))
        shift = max(
            float(np.abs(new - old).max(initial=0.0))
            for new, old in zip(moved.projections, point.projections, strict=True)
        )
        point = moved
        if shift < SHIFT_TOLERANCE * problem.noise.std:
            break
    return point, residual


class _BatchNlp:
    """The NLP's expressions, built once; the residuals' factors are its parameters.

    First and second derivatives of one pose are generated once and mapped over the poses; the
    NLP's derivatives are assembled from these blocks. Differentiating the assembled NLP instead
    would cost as many sweeps as a pose has unknowns.
    """

    def __init__(self, problem: Problem, p: FloatArray) -> None:
        self.problem = problem
        unknowns, model = problem.unknowns, problem.equilibria.model
        self.m = problem.equilibria.m
        self.n_x, self.n_lam = model.chain.n_nodes, model.n_border
        self.columns = problem.equilibria.used_deviations
        self.n_rest = model.chain.n_rests if model.has_state else 0
        first = self.n_x + self.n_lam
        self.own = slice(first, first + len(self.columns))  # a pose's deviations
        self.stride = self.own.stop + self.n_rest
        # Multipliers and balance in units of a typical force: EI turns^2.
        self.force = float(p[model.names.index(BENDING_STIFFNESS)]) * model.cable.curvature_scale**2
        self._differentiate()
        # Quantities that the residuals depend on: the measured curve's and the wrenches'. A pose's
        # compressed residuals have as many rows, or fewer.
        self.n_z = self.value.size1_out(1)
        self.n_rows = min(max(item.n_residuals for item in problem.fit_poses), self.n_z)
        lower, upper = unknowns.bounds
        free = np.full(self.stride * self.m, np.inf)
        self.lower, self.upper = np.concatenate([lower, -free]), np.concatenate([upper, free])
        # As in `descend`, deviations of poses that are not fitted stay: no prior of them counts.
        held = np.zeros((self.m, self.stride), dtype=bool)
        held[~np.isin(range(self.m), problem.used), self.own] = True
        self.held = np.concatenate([np.zeros(unknowns.size, dtype=bool), held.ravel()])
        self._assemble()

    def _differentiate(self) -> None:
        """Values, Jacobians and Hessian of one pose by its own unknowns and theta."""
        problem = self.problem
        unknowns, model = problem.unknowns, problem.equilibria.model
        theta = ca.SX.sym("theta", unknowns.size)
        own = ca.SX.sym("own", self.stride)
        pose = ca.SX.sym("pose", model.n_pose)
        x, lam, dev, rest = self._split(own)
        deviation = ca.SX.zeros(len(model.deviation_names))
        for k, column in enumerate(self.columns):
            deviation[column] = dev[k] * problem.deviation_std[k]
        if not model.has_state:
            rest = ca.DM(unknowns.rest_slopes) @ theta
        p = unknowns.symbolic_p(theta)
        symbols = PoseSymbols(x, lam * self.force, p, rest, pose, deviation)
        per_force = np.repeat([1 / self.force, 1.0], [self.n_x, self.n_lam])
        scale = per_force / model.cable.length
        imbalance = balance(model, symbols) * scale
        felt = readings(model, symbols) if problem.equilibria.wrenches else ca.SX(0, 1)
        z = ca.vertcat(curve(model, symbols), ends(model, symbols), felt)
        after = ca.SX.zeros(0)
        if model.has_state:
            after = rest_after(model, symbols) / model.cable.curvature_scale
        both = ca.vertcat(own, theta)
        given = [own, theta, pose]
        self.value = ca.Function("value", given, [imbalance, z, after])
        blocks = [ca.densify(ca.jacobian(block, both)) for block in (imbalance, z, after)]
        self.slope = ca.Function("slope", given, blocks)
        weights = [ca.SX.sym("w", block.numel()) for block in (imbalance, z, after)]
        weighted = ca.dot(ca.vertcat(*weights), ca.vertcat(imbalance, z, after))
        bend = ca.densify(ca.hessian(weighted, both)[0])
        self.bend = ca.Function("bend", [*given, *weights], [bend])

    def _assemble(self) -> None:
        """NLP, gradient, Jacobian and Hessian from the poses' blocks."""
        problem, m = self.problem, self.m
        size, n_z, n_rows = problem.unknowns.size, self.n_z, self.n_rows
        x = ca.MX.sym("x", size + self.stride * m)
        factor = ca.MX.sym("factor", n_rows, n_z * len(problem.used))
        target = ca.MX.sym("target", n_rows, len(problem.used))
        p = ca.vertcat(ca.vec(factor), ca.vec(target))
        theta, own = x[:size], ca.reshape(x[size:], self.stride, m)
        thetas = ca.repmat(theta, 1, m)
        fixed = ca.DM(np.array([item.pose.vector for item in problem.measured]).T)
        balance, z, after = self.value.map(m)(own, thetas, fixed)
        slopes = self.slope.map(m)(own, thetas, fixed)
        width = self.stride + size
        gap = theta - ca.DM(problem.mean)
        precision = ca.DM(problem.precision)
        pick = ca.DM.zeros(self.stride)
        pick[self.own] = 1.0

        objective = ca.bilin(precision, gap, gap) / 2
        by_theta, by_own = precision @ gap, [ca.MX.zeros(self.stride) for _ in range(m)]
        factors, jacobians = ca.horzsplit(factor, n_z), ca.horzsplit(slopes[1], width)
        pulls = [ca.MX.zeros(n_z) for _ in range(m)]
        squares = [ca.MX.zeros(width, width) for _ in range(m)]
        for k, c in enumerate(problem.used):
            block, jacobian = factors[k], jacobians[c]
            residual = block @ z[:, c] - target[:, k]
            deviation = pick * own[:, c]
            objective += ca.sumsqr(residual) / 2 + ca.sumsqr(deviation) / 2
            pulls[c] = block.T @ residual
            gradient = jacobian.T @ pulls[c]
            by_own[c] = gradient[: self.stride] + deviation
            by_theta += gradient[self.stride :]
            whitened = block @ jacobian
            squares[c] = whitened.T @ whitened
            squares[c] += ca.diag(ca.vertcat(pick, ca.DM.zeros(size)))
        carried, by_carried = self._carry(theta, own, after, slopes[2])
        g = ca.vertcat(ca.vec(balance), carried)
        jac_g = ca.vertcat(self._blocks(slopes[0]), by_carried)

        lam_f, lam_g = ca.MX.sym("lam_f"), ca.MX.sym("lam_g", g.numel())
        n_balance = self.n_x + self.n_lam
        of_balance = ca.reshape(lam_g[: n_balance * m], n_balance, m)
        # Row block j + 1 of the carried constraints subtracts what pose j leaves behind.
        later = ca.reshape(lam_g[n_balance * m :], self.n_rest, m)[:, 1:]
        of_after = ca.horzcat(-later, ca.MX.zeros(self.n_rest, 1))
        bends = self.bend.map(m)(
            own, thetas, fixed, of_balance, lam_f * ca.horzcat(*pulls), of_after
        )
        corner, side, diagonal = lam_f * precision, [], []
        for bend, square in zip(ca.horzsplit(bends, width), squares, strict=True):
            whole = bend + lam_f * square
            diagonal.append(whole[: self.stride, : self.stride])
            side.append(whole[self.stride :, : self.stride])
            corner += whole[self.stride :, self.stride :]
        below = ca.MX(self.stride * m, size)
        hessian = ca.blockcat([[corner, ca.horzcat(*side)], [below, ca.diagcat(*diagonal)]])
        self.solver = ca.nlpsol(
            "batch",
            "ipopt",
            {"x": x, "p": p, "f": objective, "g": g},
            {
                "print_time": False,
                # Multipliers of p are not needed; building the gradient for them takes minutes.
                "no_nlp_grad": True,
                "calc_lam_p": False,
                "grad_f": ca.Function("grad_f", [x, p], [objective, ca.vertcat(by_theta, *by_own)]),
                "jac_g": ca.Function("jac_g", [x, p], [g, jac_g]),
                "hess_lag": ca.Function("hess_lag", [x, p, lam_f, lam_g], [ca.triu(hessian)]),
                "ipopt.print_level": 0,
                "ipopt.sb": "yes",
                "ipopt.tol": 1e-8,
                "ipopt.max_iter": 100,
                "ipopt.mu_init": 1e-6,
                "ipopt.bound_push": 1e-9,
                "ipopt.bound_frac": 1e-9,
                # IPOPT widens bounds by 1e-8; its result must lie within the original ones.
                "ipopt.honor_original_bounds": "yes",
                "ipopt.nlp_scaling_method": "none",
            },
        )

    def _blocks(self, slopes: ca.MX) -> ca.MX:
        """Jacobian of a function of each pose: theta's columns, then the poses' on the diagonal."""
        parts = ca.horzsplit(slopes, self.stride + self.problem.unknowns.size)
        thetas = ca.vertcat(*(part[:, self.stride :] for part in parts))
        owns = ca.diagcat(*(part[:, : self.stride] for part in parts))
        return ca.horzcat(thetas, owns)

    def _carry(self, theta: ca.MX, own: ca.MX, after: ca.MX, slopes: ca.MX) -> tuple[ca.MX, ca.MX]:
        """Rest curvature that each pose finds minus that left by the pose before; its Jacobian.

        Both have no rows if the model carries no state.
        """
        m, unknowns = self.m, self.problem.unknowns
        scale = unknowns.model.cable.curvature_scale
        first = ca.DM(unknowns.rest_slopes)[: self.n_rest, :] / scale
        begins = own[self.stride - self.n_rest :, :] / scale
        gap = ca.vec(begins - ca.horzcat(first @ theta, after[:, :-1]))
        select = ca.DM.zeros(self.n_rest, self.stride)
        select[:, self.stride - self.n_rest :] = ca.DM.eye(self.n_rest) / scale
        left = self._blocks(slopes)
        n, size = self.n_rest, unknowns.size
        shifted = ca.vertcat(ca.MX(n, left.shape[1]), left[: n * (m - 1), :])
        start = ca.vertcat(ca.MX(first), ca.MX(n * (m - 1), size))
        direct = ca.horzcat(-start, ca.MX(ca.diagcat(*([select] * m))))
        return gap, direct - shifted

    def _split(self, own: Any) -> tuple[Any, Any, Any, Any]:
        """Headings, multipliers, deviations and rest curvature among a pose's unknowns."""
        a, b, c = self.n_x, self.own.start, self.own.stop
        return own[:a], own[a:b], own[b:c], own[c:]

    def _compressed(self, point: Point) -> list[FloatArray]:
        """Triangular factor and target (n_rows, n_z + 1) of each fitted pose's residuals."""
        problem = self.problem
        out: list[FloatArray] = []
        unit, seen = np.eye(self.n_z), problem.observed(point)
        for j, s, white in zip(problem.used, point.projections, problem.whitening, strict=True):
            curve, readings, knots = seen[j].curve.numbers, seen[j].readings, seen[j].curve.knots
            held = np.zeros(0) if knots is None else knots[[0, -1]]
            by_curve, by_ends, by_readings = np.split(unit, [curve.size, curve.size + held.size])
            by_curve = by_curve.reshape((*curve.shape, self.n_z))
            # Nodes of a cable without clips are even between its ends.
            u = np.linspace(0.0, 1.0, len(curve))[:, None]
            laid = (1 - u) * by_ends[:1] + u * by_ends[1:] if held.size else None
            each = ObservedChange(by_curve, by_readings, laid)
            residual, change = problem.measured[j].linearized(seen[j], s, each)
            rows = -white @ change
            target = white @ residual + rows @ np.concatenate([curve.ravel(), held, readings])
            triangle = np.linalg.qr(np.column_stack([rows, target]), mode="r")
            padded = np.zeros((self.n_rows, self.n_z + 1))
            keep = min(self.n_rows, len(triangle))
            padded[:keep] = triangle[:keep]
            out.append(padded)
        return out

    def solve(self, point: Point) -> tuple[FloatArray, Shapes, float]:
        """Unknowns, shapes and largest violation after one IPOPT run with frozen projections."""
        problem, shapes = self.problem, point.shapes
        own = shapes.deviation[:, self.columns] / problem.deviation_std
        parts = [shapes.x[..., 0], shapes.lam / self.force, own]
        if problem.equilibria.model.has_state:
            parts.append(problem.equilibria.rests(*problem.state(point)))
        x0 = np.concatenate([point.theta, np.concatenate(parts, axis=1).ravel()])
        factors = self._compressed(point)
        p = [part[:, :-1].ravel(order="F") for part in factors] + [part[:, -1] for part in factors]
        out, stats = run_ipopt(
            self.solver,
            x0=x0,
            p=np.concatenate(p),
            lbx=np.where(self.held, x0, self.lower),
            ubx=np.where(self.held, x0, self.upper),
            lbg=0.0,
            ubg=0.0,
        )
        if not stats["success"]:
            raise EstimationError(
                f"the batch problem of {counted(len(problem.used), 'pose')} was not solved (IPOPT: "
                f"{stats['return_status']} after "
                f"{counted(int(stats['iter_count']), 'iteration')}).\n"
                "  Try: more poses, or estimation.robust: true if some points are far off."
            )
        residual = float(np.abs(np.array(out["g"])).max())
        theta, found = np.split(np.array(out["x"]).ravel(), [problem.unknowns.size])
        headings, forces, scaled, _ = self._split(found.reshape((-1, self.stride)).T)
        deviation = shapes.deviation.copy()
        deviation[:, self.columns] = scaled.T * problem.deviation_std
        shapes = Shapes(np.array(headings.T)[..., None], forces.T * self.force, deviation)
        return theta, shapes, residual
