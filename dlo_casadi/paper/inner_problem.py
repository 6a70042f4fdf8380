"""Eq. 13 of the paper: the shape of one pose between its energy and its measured points."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize

from dlo_casadi.effects import Cable
from dlo_casadi.equilibrium.equilibrium import JOINT_BOUND
from dlo_casadi.equilibrium.guesses import arc_headings
from dlo_casadi.equilibrium.ipopt import run_ipopt
from dlo_casadi.equilibrium.pose import Pose
from dlo_casadi.rod.chain import Chain
from dlo_casadi.sensing.measured_pose import MeasuredPose

FloatArray = NDArray[np.floating]
BoolArray = NDArray[np.bool_]

# Weight of the distances: beta = WEIGHT n [J/m^2]. The paper's c, chosen there by hand.
WEIGHT = 1e4
# Nearest points are frozen while IPOPT runs, then chosen again until they stay, at most so often.
ASSIGNMENTS = 20
# IPOPT takes up to 18 iterations for Eq. 13 on the same sessions; ten times that has gone astray.
IPOPT_ITERATIONS = 200
# COBYLA: first change of a joint angle [rad], last one, and number of evaluations.
COBYLA_STEP, COBYLA_TOLERANCE, COBYLA_EVALUATIONS = 0.1, 1e-6, 4000


@dataclass(frozen=True)
class Target:
    """Measured points of one pose, about its start.

    `points` (K, 2) [m]; `edges` (K,) marks points with a gap beside them; `end` (2,) [m].
    """

    points: FloatArray
    edges: BoolArray
    end: FloatArray

    @classmethod
    def of(cls, measured: MeasuredPose, gap: float) -> Target:
        """Take the points of a pose; what is missing over more than `gap` [m] is a gap."""
        start = np.array(measured.pose.start)
        points = measured.points - start
        end = np.array(measured.pose.end) - start
        line = np.concatenate([np.zeros((1, 2)), points, end[None]])
        wide = np.hypot(*np.diff(line, axis=0).T) > gap
        return cls(points, wide[:-1] | wide[1:], end)

    def nearest(self, nodes: FloatArray) -> tuple[NDArray[np.intp], BoolArray]:
        """Index of the nearest point of each node, and whether the node is in view.

        A node whose nearest point lies beside a gap is in the gap and is left out of r_p.
        """
        square = ((nodes[:, None, :] - self.points[None]) ** 2).sum(axis=-1)
        index = square.argmin(axis=1)
        return index, ~self.edges[index]

    def residual(self, nodes: FloatArray) -> float:
        """r_p of Eq. 9 [m^2]."""
        index, seen = self.nearest(nodes)
        return float(((nodes - self.points[index])[seen] ** 2).sum())


class InnerProblem:
    """Eq. 13: the shape of one pose that balances its energy against its measured points.

        min V(theta, alpha) + beta r_p(theta)   s.t.   r(L) = end,   |theta_i| <= pi/2 for i >= 2

    Parameters
    ----------
    cable : Cable
    gravity : (float, float) [m/s^2]
    n : int
        Number of links.
    c : float [J/m^2]
        beta = c n.
    """

    def __init__(self, cable: Cable, gravity: tuple[float, ...], n: int, c: float = WEIGHT) -> None:
        self.chain = Chain(cable.length, n, "link")
        self.weight = cable.mass / n * np.array(gravity)
        self.beta = c * n
        self._solver = self._build()

    def _build(self) -> ca.Function:
        """One solver for all poses and iterations: alpha, end and points are its parameters."""
        n, h = self.chain.n, self.chain.h
        phi = ca.SX.sym("phi", n)
        k_theta, theta_0 = ca.SX.sym("k_theta"), ca.SX.sym("theta_0", n - 1)
        end, points = ca.SX.sym("end", 2), ca.SX.sym("points", n - 1, 2)
        seen = ca.SX.sym("seen", n - 1)
        steps = h * ca.horzcat(ca.cos(phi), ca.sin(phi))
        nodes = ca.vertcat(ca.SX.zeros(1, 2), ca.cumsum(steps, 0))
        joints = phi[1:] - phi[:-1]
        bending = k_theta / 2 * ca.sumsqr(joints - theta_0)
        middles = (nodes[1:, :] + nodes[:-1, :]) / 2
        hanging = -ca.dot(ca.DM(self.weight), ca.sum1(middles).T)
        gaps = ca.sum2((nodes[1:n, :] - points) ** 2)
        parameters = ca.vertcat(k_theta, theta_0, end, seen, ca.vec(points))
        problem = {
            "x": phi,
            "p": parameters,
            "f": bending + hanging + self.beta * ca.dot(seen, gaps),
            "g": ca.vertcat(nodes[n, :].T - end, joints),
        }
        options: dict[str, Any] = {
            "print_time": False,
            "ipopt.print_level": 0,
            "ipopt.sb": "yes",
            "ipopt.tol": 1e-9,
            "ipopt.max_iter": IPOPT_ITERATIONS,
        }
        return ca.nlpsol("algorithm1", "ipopt", problem, options)

    def nodes(self, phi: FloatArray) -> FloatArray:
        """Nodes (n + 1, 2) [m] from the start, which is the origin."""
        steps = self.chain.h * np.stack([np.cos(phi), np.sin(phi)], axis=1)
        return np.concatenate([np.zeros((1, 2)), np.cumsum(steps, axis=0)])

    def objective(
        self, phi: FloatArray, k_theta: float, theta_0: FloatArray, target: Target
    ) -> float:
        """V + beta r_p with the nearest points of this very shape [J]."""
        nodes = self.nodes(phi)
        middles = (nodes[1:] + nodes[:-1]) / 2
        bending = k_theta / 2 * ((np.diff(phi) - theta_0) ** 2).sum()
        hanging = -(middles @ self.weight).sum()
        return float(bending + hanging + self.beta * target.residual(nodes[1:-1]))

    def first_guess(self, pose: Pose, target: Target) -> FloatArray:
        """Arc through both ends on the pose's branch, or nearer to the measured points."""
        sides = {"ccw": (1,), "cw": (-1,)}.get(pose.branch or "", (1, -1))
        arcs = [
            arc_headings(self.chain.places, self.chain.length, np.zeros(2), target.end, side)
            for side in sides
        ]
        return min(arcs, key=lambda phi: target.residual(self.nodes(phi)[1:-1]))

    def solve_ipopt(
        self, phi: FloatArray, k_theta: float, theta_0: FloatArray, target: Target
    ) -> tuple[FloatArray, bool]:
        """Minimise by IPOPT in absolute headings, the nearest points chosen again in between.

        Returns
        -------
        (n,) [rad], bool
            Headings and whether IPOPT converged.
        """
        n = self.chain.n
        bound = np.concatenate([np.zeros(2), np.full(n - 1, JOINT_BOUND)])
        chosen: tuple[NDArray[np.intp], BoolArray] | None = None
        for _ in range(ASSIGNMENTS):
            index, seen = target.nearest(self.nodes(phi)[1:-1])
            if chosen is not None and all(map(np.array_equal, chosen, (index, seen))):
                break
            chosen = (index, seen)
            nearest = target.points[index].T.ravel()
            p = np.concatenate([[k_theta], theta_0, target.end, seen, nearest])
            found, stats = run_ipopt(self._solver, x0=phi, p=p, lbg=-bound, ubg=bound)
            if not stats["success"]:
                return phi, False
            phi = np.array(found["x"]).ravel()
        return phi, True

    def solve_cobyla(
        self, phi: FloatArray, k_theta: float, theta_0: FloatArray, target: Target
    ) -> tuple[FloatArray, bool]:
        """Minimise by COBYLA in relative joint angles, as in the paper.

        Returns
        -------
        (n,) [rad], bool
            Headings and whether COBYLA converged.
        """

        def objective(theta: FloatArray) -> float:
            return self.objective(np.cumsum(theta), k_theta, theta_0, target)

        def end_gap(theta: FloatArray) -> FloatArray:
            return self.nodes(np.cumsum(theta))[-1] - target.end

        constraints: Any = [
            {"type": "ineq", "fun": end_gap},
            {"type": "ineq", "fun": lambda theta: -end_gap(theta)},
            {"type": "ineq", "fun": lambda theta: JOINT_BOUND - np.abs(theta[1:])},
        ]
        options: Any = {"rhobeg": COBYLA_STEP, "maxiter": COBYLA_EVALUATIONS, "catol": 1e-6}
        found = minimize(
            objective,
            np.concatenate([phi[:1], np.diff(phi)]).astype(np.float64),
            method="COBYLA",
            constraints=constraints,
            tol=COBYLA_TOLERANCE,
            options=options,
        )
        return np.cumsum(found.x), bool(found.success)
