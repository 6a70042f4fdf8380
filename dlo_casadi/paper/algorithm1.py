"""The paper's estimate: Eqs. 9 to 15 and Algorithm 1, the baseline to compare others with.

    repeat   theta_j = argmin V(theta, alpha) + beta r_p(theta)   for every pose j   (Eq. 13)
             alpha = argmin |q - q_hat(alpha)|^2                                     (Eq. 15)

with alpha = [k_theta, theta_0] and the chain of straight links. Corrections to the printed text:
the loop runs while alpha changes by more than the tolerance; theta_1 is a heading and has no bound;
every pose starts from the arc through its ends. Kept as printed: Eq. 9 measures each node from its
nearest point, and the balance of Eq. 14 neglects the reaction of the held end. The latter makes
k_theta diverge on many data; the result then says so.

References
----------
Quartaro, Moser, Cooper, Komendera, Front. Robot. AI 12:1565837 (2025).
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import Enum
from time import perf_counter
from typing import Any, Literal, Self

import casadi as ca
import numpy as np
from scipy.optimize import least_squares, minimize

from dlo_casadi.arrays import BoolArray, FloatArray, IntArray
from dlo_casadi.effects import CableData
from dlo_casadi.equilibrium.by_ipopt import ipopt, run_ipopt
from dlo_casadi.equilibrium.equilibrium import JOINT_BOUND
from dlo_casadi.equilibrium.guesses import arc_headings
from dlo_casadi.equilibrium.pose import HeldPose
from dlo_casadi.equilibrium.spans import out_of_reach
from dlo_casadi.errors import EstimationError, counted
from dlo_casadi.model.cable_model import CableModel
from dlo_casadi.rod.chain import Chain
from dlo_casadi.rod.node import Heading
from dlo_casadi.sensing.measured_pose import MeasuredPose

# Number of successive iterations without a change of alpha at convergence (the paper asks for
# several); largest change of ln(k_theta) and of theta_0 [rad] that counts as none.
UNCHANGED, TOLERANCE = 3, 1e-4
# Factor from its prior, up or down, above which k_theta has diverged.
RUNAWAY = 1e3
# k_theta has also diverged after this number of successive changes in one direction, if they exceed
# the factor GROWTH in total and the last one of ln(k_theta) exceeds LAST_STEP.
STEADY, GROWTH, LAST_STEP = 12, 3.0, 0.01
# Maximum number of iterations, four times STEADY. On rendered sessions the loop either converges
# after 5 iterations or diverges after 1; slow divergence is detected after STEADY.
ITERATIONS = 50
# Weight of the distances: beta = WEIGHT n [J/m^2]. It is the paper's c, chosen there by hand.
WEIGHT = 1e4
# Maximum number of updates of the nearest points, which are fixed during an IPOPT run.
ASSIGNMENTS = 20
# Maximum number of IPOPT iterations, ten times the 18 that Eq. 13 takes on the same sessions.
IPOPT_ITERATIONS = 200
# COBYLA: first and last change of a joint angle [rad], and maximum number of evaluations.
COBYLA_STEP, COBYLA_TOLERANCE, COBYLA_EVALUATIONS = 0.1, 1e-6, 4000


class Algorithm1Status(Enum):
    """Outcome of the loop, one sentence each."""

    CONVERGED = "the parameters no longer change"
    RUNAWAY = "k_theta runs away: without the end's reaction no finite stiffness balances Eq. 14"
    ITERATION_LIMIT = "the parameters still change"


@dataclass(frozen=True)
class Algorithm1Result:
    """Result of the paper's loop.

    Parameters
    ----------
    model : CableModel
        The chain of n links without effects.
    k_theta : float [N m/rad]
        Joint stiffness.
    theta_0 : (n - 1,) [rad]
        Rest angles of the interior joints.
    iterations : int
        Complete passes of the loop.
    message : str
        One or more sentences with numbers.
    history : (iterations + 1,) [N m/rad]
        k_theta of the prior and after each iteration.
    """

    model: CableModel
    k_theta: float
    theta_0: FloatArray
    iterations: int
    status: Algorithm1Status
    message: str
    history: FloatArray
    seconds: float

    @property
    def EI(self) -> float:
        """Bending stiffness k_theta h [N m^2]."""
        return self.k_theta * self.model.chain.h

    @property
    def p(self) -> FloatArray:
        """Parameter vector of `model`, for `solve_equilibrium`."""
        return np.array([self.EI])

    @property
    def rest(self) -> FloatArray:
        """Rest curvature theta_0 / h at the interior joints (n - 1,), the bending cells [1/m]."""
        return self.theta_0 / self.model.chain.h


@dataclass(frozen=True)
class Target:
    """Measured points of one pose, relative to its start.

    `points` (K, 2) [m]; `edges` (K,) marks points with a gap beside them; `end` (2,) [m].
    """

    points: FloatArray
    edges: BoolArray
    end: FloatArray

    @classmethod
    def of(cls, measured: MeasuredPose, gap: float) -> Self:
        """Take the points of a pose.

        Neighbours enclose a gap if they are farther apart than `gap` [m] and than twice the median
        distance of neighbours, so that a sparse line is not all gaps.
        """
        line = measured.pose.joined(measured.points) - np.array(measured.pose.start)
        steps = np.hypot(*np.diff(line, axis=0).T)
        wide = steps > max(gap, 2 * float(np.median(steps)))
        return cls(line[1:-1], wide[:-1] | wide[1:], line[-1])

    def nearest(self, nodes: FloatArray) -> tuple[IntArray, BoolArray]:
        """Index of the nearest point of each node, and whether the node is in view.

        A node whose nearest point is beside a gap lies in the gap and is left out of r_p.
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

    with beta = WEIGHT n.

    Parameters
    ----------
    gravity : (float, float) [m/s^2]
    n : int
        Number of links.
    """

    def __init__(self, cable: CableData, gravity: tuple[float, ...], n: int) -> None:
        self.chain = Chain(cable.length, n, "link")
        self.weight = cable.mass / n * np.array(gravity)
        self.beta = WEIGHT * n
        # One solver for all poses and iterations: alpha, end and points are its parameters.
        phi, k_theta = ca.SX.sym("phi", n), ca.SX.sym("k_theta")
        theta_0, seen = ca.SX.sym("theta_0", n - 1), ca.SX.sym("seen", n - 1)
        end, points = ca.SX.sym("end", 2), ca.SX.sym("points", n - 1, 2)
        steps = self.chain.h * ca.horzcat(ca.cos(phi), ca.sin(phi))
        nodes = ca.vertcat(ca.SX.zeros(1, 2), ca.cumsum(steps, 0))
        joints = phi[1:] - phi[:-1]
        bending = k_theta / 2 * ca.sumsqr(joints - theta_0)
        middles = (nodes[1:, :] + nodes[:-1, :]) / 2
        weight = -ca.dot(ca.DM(self.weight), ca.sum1(middles).T)
        gaps = ca.dot(seen, ca.sum2((nodes[1:n, :] - points) ** 2))
        problem = {
            "x": phi,
            "p": ca.vertcat(k_theta, theta_0, end, seen, ca.vec(points)),
            "f": bending + weight + self.beta * gaps,
            "g": ca.vertcat(nodes[n, :].T - end, joints),
        }
        self._solver = ipopt("algorithm1", problem, 1e-9, IPOPT_ITERATIONS)

    def nodes(self, phi: FloatArray) -> FloatArray:
        """Nodes (n + 1, 2) [m] from the start, which is the origin."""
        steps = self.chain.h * np.stack([np.cos(phi), np.sin(phi)], axis=1)
        return np.concatenate([np.zeros((1, 2)), np.cumsum(steps, axis=0)])

    def objective(
        self, phi: FloatArray, target: Target, k_theta: float, theta_0: FloatArray
    ) -> float:
        """V + beta r_p with the nearest points of this shape [J]."""
        nodes = self.nodes(phi)
        middles = (nodes[1:] + nodes[:-1]) / 2
        bending = k_theta / 2 * ((np.diff(phi) - theta_0) ** 2).sum()
        weight = -(middles @ self.weight).sum()
        return float(bending + weight + self.beta * target.residual(nodes[1:-1]))

    def first_guess(self, pose: HeldPose, target: Target) -> FloatArray:
        """Arc through both ends on the pose's branch; without one the arc nearer to the points."""
        sides = {"ccw": (1,), "cw": (-1,)}.get(pose.branch or "", (1, -1))
        places, length = self.chain.places, self.chain.length
        arcs = [arc_headings(places, length, target.end, side) for side in sides]
        return min(arcs, key=lambda phi: target.residual(self.nodes(phi)[1:-1]))

    def solve_ipopt(
        self, phi: FloatArray, target: Target, k_theta: float, theta_0: FloatArray
    ) -> tuple[FloatArray, bool]:
        """Minimise by IPOPT in absolute headings; nearest points are updated after each run.

        Returns headings (n,) [rad], and whether IPOPT converged.
        """
        bound = np.concatenate([np.zeros(2), np.full(self.chain.n - 1, JOINT_BOUND)])
        chosen: tuple[IntArray, BoolArray] | None = None
        for _ in range(ASSIGNMENTS):
            index, seen = target.nearest(self.nodes(phi)[1:-1])
            if chosen is not None and all(map(np.array_equal, chosen, (index, seen))):
                break
            chosen = (index, seen)
            points = target.points[index].T.ravel()
            p = np.concatenate([[k_theta], theta_0, target.end, seen, points])
            found, stats = run_ipopt(self._solver, x0=phi, p=p, lbg=-bound, ubg=bound)
            if not stats["success"]:
                return phi, False
            phi = np.array(found["x"]).ravel()
        return phi, True

    def solve_cobyla(
        self, phi: FloatArray, target: Target, k_theta: float, theta_0: FloatArray
    ) -> tuple[FloatArray, bool]:
        """Minimise by COBYLA in relative joint angles, as in the paper.

        Returns headings (n,) [rad], and whether COBYLA converged.
        """

        def objective(theta: FloatArray) -> float:
            return self.objective(np.cumsum(theta), target, k_theta, theta_0)

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


def applies(model: CableModel) -> bool:
    """Whether the paper's method applies: a cable in a plane, pinned at both ends, nothing else."""
    held = model.start.turns and model.end.turns and not (model.clips or model.surfaces)
    return model.node is Heading and held


def gravity_slopes(phi: FloatArray, weight: FloatArray, h: float) -> FloatArray:
    """Gradient of the links' weight energy by the joint angles (n,) [J/rad].

        -sum_i (m_link g) . d r_i / d theta_a,    r_i = middle of link i

    which is sum_i m_link g grad y_i of Eq. 7 for gravity along -y.

    Parameters
    ----------
    phi : (n,) [rad]
        Headings of the links.
    weight : (2,) [N]
        Weight of one link, m_link times gravity.
    h : float [m]
        Length of a link.
    """
    n = len(phi)
    lever = h * (n - 0.5 - np.arange(n))
    by_heading = -lever * (weight[1] * np.cos(phi) - weight[0] * np.sin(phi))
    return np.cumsum(by_heading[::-1])[::-1]


def expected_angles(k_theta: float, theta_0: FloatArray, slopes: FloatArray) -> FloatArray:
    """Interior joint angles (..., n - 1) [rad] expected by Eq. 14, without the end's reaction.

        theta_hat = theta_0 - (1 / k_theta) sum_i m_link g grad y_i(theta)

    `slopes` (..., n - 1) [J/rad]: `gravity_slopes` at the interior joints.
    """
    return theta_0 - slopes / k_theta


def best_parameters(
    angles: FloatArray, slopes: FloatArray, k_theta: float, theta_0: FloatArray
) -> tuple[float, FloatArray]:
    """Minimise Eq. 15 by scipy's trust region reflective method.

    Parameters
    ----------
    angles, slopes : (m, n - 1)
        Interior joint angles [rad] and `gravity_slopes` [J/rad] of the m poses.
    k_theta, theta_0
        Where to start.

    Returns
    -------
    float, (n - 1,)
        k_theta, which is kept positive, and theta_0.
    """
    m, joints = angles.shape

    def residual(x: FloatArray) -> FloatArray:
        return (angles - expected_angles(x[0] * k_theta, x[1:], slopes)).ravel()

    def jacobian(x: FloatArray) -> FloatArray:
        by_stiffness = -slopes.ravel() / (x[0] ** 2 * k_theta)
        return np.column_stack([by_stiffness, -np.tile(np.eye(joints), (m, 1))])

    start, lower = np.append(1.0, theta_0), np.append(1e-9, np.full(joints, -np.inf))
    found = least_squares(residual, start, jac=jacobian, bounds=(lower, np.inf), method="trf")
    return float(found.x[0] * k_theta), found.x[1:]


def run_algorithm1(
    cable: CableData,
    poses: Sequence[MeasuredPose],
    gravity: tuple[float, ...],
    n: int = 10,
    inner: Literal["ipopt", "cobyla"] = "ipopt",
    max_iterations: int = ITERATIONS,
) -> Algorithm1Result:
    """Estimate k_theta and theta_0 by Algorithm 1 of the paper.

    Parameters
    ----------
    cable : CableData
        Its `bending_stiffness` gives the start of k_theta; theta_0 starts at zero.
    poses : sequence of MeasuredPose
        Those held out, unreadable or out of reach are not used.
    gravity : (float, float) [m/s^2]
    n : int
        Number of links.
    inner : "ipopt" or "cobyla"
        Minimiser of Eq. 13; COBYLA takes about a second a pose and iteration at n = 10.

    Returns
    -------
    Algorithm1Result
        Result of the last iteration, even if k_theta has diverged: see its `status`.

    Raises
    ------
    EstimationError
        If an end is clamped or free, or no pose can be used.
    """
    began = perf_counter()
    used = _usable(cable, poses, gravity, n)
    problem = InnerProblem(cable, gravity, n)
    solve = {"ipopt": problem.solve_ipopt, "cobyla": problem.solve_cobyla}[inner]
    targets = [Target.of(item, problem.chain.h / 2) for item in used]
    shapes = [problem.first_guess(x.pose, target) for x, target in zip(used, targets, strict=True)]
    k_theta = cable.bending_stiffness / problem.chain.h
    theta_0: FloatArray = np.zeros(n - 1)
    history = [k_theta]
    unchanged, failed = 0, 0
    status = Algorithm1Status.ITERATION_LIMIT
    while status is Algorithm1Status.ITERATION_LIMIT and len(history) <= max_iterations:
        solved = [solve(*one, k_theta, theta_0) for one in zip(shapes, targets, strict=True)]
        shapes = [phi for phi, _ in solved]
        failed = sum(not converged for _, converged in solved)
        angles = np.diff(shapes, axis=1)
        slopes = np.array([gravity_slopes(phi, problem.weight, problem.chain.h) for phi in shapes])
        last, last_0 = k_theta, theta_0
        k_theta, theta_0 = best_parameters(angles, slopes[:, 1:], k_theta, theta_0)
        history.append(k_theta)
        change = max(abs(np.log(k_theta / last)), float(np.abs(theta_0 - last_0).max()))
        unchanged = unchanged + 1 if change <= TOLERANCE else 0
        if _runs_away(history):
            status = Algorithm1Status.RUNAWAY
        elif unchanged >= UNCHANGED:
            status = Algorithm1Status.CONVERGED
    seconds = perf_counter() - began
    message = _message(status, history, seconds, failed, len(shapes))
    model = CableModel(replace(cable, straight=False), n, "link", gravity=gravity, n_rest=4)
    return Algorithm1Result(
        model, k_theta, theta_0, len(history) - 1, status, message, np.array(history), seconds
    )


def _usable(
    cable: CableData, poses: Sequence[MeasuredPose], gravity: tuple[float, ...], n: int
) -> list[MeasuredPose]:
    """Fit poses that have points and are within reach."""
    model = CableModel(cable, n=n, element="link", gravity=gravity)
    used = []
    for item in poses:
        if item.held_out or not item.readable:
            continue
        pose = item.pose
        if pose.end is None or pose.start_heading is not None or pose.end_heading is not None:
            raise EstimationError(
                f"{pose.name}: the paper's method knows pinned ends only.\n"
                "  Try: estimation: {algorithm1: false}"
            )
        if out_of_reach(model, model.nominal, pose) is None:
            used.append(item)
    if not used:
        raise EstimationError("no pose to fit: every pose is held out, unread or out of reach.")
    return used


def _runs_away(history: list[float]) -> bool:
    """Whether k_theta is far from its prior or steadily moves away from it."""
    if abs(np.log(history[-1] / history[0])) > np.log(RUNAWAY):
        return True
    steps = np.diff(np.log(history[-STEADY - 1 :]))
    steady = len(steps) == STEADY and (np.all(steps > 0) or np.all(steps < 0))
    return bool(steady and abs(steps.sum()) > np.log(GROWTH) and abs(steps[-1]) > LAST_STEP)


def _message(
    status: Algorithm1Status, history: list[float], seconds: float, failed: int, n_poses: int
) -> str:
    text = (
        f"After {counted(len(history) - 1, 'iteration')} ({seconds:.1f} s) {status.value}; "
        f"k_theta went from {history[0]:.3g} to {history[-1]:.3g} N m/rad."
    )
    if failed:
        poses = counted(n_poses, "pose")
        text += f" The shapes of {failed} of {poses} did not converge in the last one."
    return text
