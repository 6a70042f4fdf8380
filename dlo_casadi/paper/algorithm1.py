"""The paper's estimate: Eqs. 9 to 15 and Algorithm 1, the baseline to compare others with.

    repeat   theta_j = argmin V(theta, alpha) + beta r_p(theta)   for every pose j   (Eq. 13)
             alpha = argmin |q - q_hat(alpha)|^2                                     (Eq. 15)

with alpha = [k_theta, theta_0] and the chain of straight links. Corrected against the printed
text: the loop runs while alpha changes by more than the tolerance; theta_1 is a heading and has
no bound; every pose starts from the arc through its ends. Kept: each node is drawn to its nearest
measured point (Eq. 9), and the balance of Eq. 14 leaves out the reaction of the held end. The
latter makes k_theta grow without end on many data; the result then says so.

References
----------
Quartaro, Moser, Cooper, Komendera, Front. Robot. AI 12:1565837 (2025).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import Enum
from time import perf_counter
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from dlo_casadi.effects import Cable
from dlo_casadi.equilibrium.solve import check_pose
from dlo_casadi.errors import EquilibriumError, EstimationError, counted
from dlo_casadi.model.cable_model import CableModel
from dlo_casadi.paper.inner_problem import WEIGHT, InnerProblem, Target
from dlo_casadi.sensing.measured_pose import MeasuredPose

FloatArray = NDArray[np.floating]
BoolArray = NDArray[np.bool_]
Inner = Literal["ipopt", "cobyla"]

# Iterations in a row in which alpha must not change: the paper asks for several.
CALM = 3
# k_theta beyond this factor of its prior, either way, has run away.
RUNAWAY = 1e3
# So is one that has changed the same way so many times in a row, by more than the factor GROWTH
# in all, and still does so by more than LAST_STEP.
STEADY = 12
GROWTH = 3.0
LAST_STEP = 0.01
# On rendered sessions the loop converges after 5 iterations or runs away after 1; one that creeps
# is told after STEADY. Four times that: what still changes then does so without an end.
ITERATIONS = 50


class Algorithm1Status(Enum):
    """Outcome of the loop, one sentence each."""

    CONVERGED = "the parameters no longer change"
    RUNAWAY = "k_theta runs away: without the end's reaction no finite stiffness balances Eq. 14"
    ITERATION_LIMIT = "the parameters still change"


@dataclass(frozen=True)
class Algorithm1Result:
    """What the paper's loop has found.

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
    status : Algorithm1Status
    message : str
        One or more sentences with numbers.
    history : (iterations + 1,) [N m/rad]
        k_theta from the prior on.
    seconds : float
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
    def kappa_0(self) -> FloatArray:
        """Rest curvature theta_0 / h at the interior joints (n - 1,) [1/m]."""
        return self.theta_0 / self.model.chain.h

    @property
    def p(self) -> FloatArray:
        """Parameter vector of `model`, for `solve_equilibrium`."""
        return np.array([self.EI])

    @property
    def rest(self) -> FloatArray:
        """Rest curvature of the model's bending cells (n - 1,) [1/m]."""
        return self.kappa_0


def applies(model: CableModel) -> bool:
    """Whether the paper's method knows such a cable: in a plane, pinned at both ends."""
    return not model.in_space and model.start == model.end == "pinned"


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

    Parameters
    ----------
    slopes : (..., n - 1) [J/rad]
        `gravity_slopes` at the interior joints.
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
    identity = np.tile(np.eye(joints), (m, 1))

    def residual(x: FloatArray) -> FloatArray:
        return (angles - expected_angles(x[0] * k_theta, x[1:], slopes)).ravel()

    def jacobian(x: FloatArray) -> FloatArray:
        by_stiffness = -slopes.ravel() / (x[0] ** 2 * k_theta)
        return np.column_stack([by_stiffness, -identity])

    lower = np.concatenate([[1e-9], np.full(joints, -np.inf)])
    found = least_squares(
        residual,
        np.concatenate([[1.0], theta_0]),
        jac=jacobian,
        bounds=(lower, np.inf),
        method="trf",
    )
    return float(found.x[0] * k_theta), found.x[1:]


def run_algorithm1(
    cable: Cable,
    poses: Sequence[MeasuredPose],
    gravity: tuple[float, ...],
    n: int = 10,
    inner: Inner = "ipopt",
    c: float = WEIGHT,
    tolerance: float = 1e-4,
    max_iterations: int = ITERATIONS,
) -> Algorithm1Result:
    """Estimate k_theta and theta_0 by Algorithm 1 of the paper.

    Parameters
    ----------
    cable : Cable
        Its `bending_stiffness` is where k_theta starts; theta_0 starts at zero.
    poses : sequence of MeasuredPose
        Those held out, unreadable or out of reach are not used.
    gravity : (float, float) [m/s^2]
    n : int
        Number of links.
    inner : "ipopt" or "cobyla"
        Minimiser of Eq. 13; COBYLA takes about a second a pose and iteration at n = 10.
    c : float [J/m^2]
        beta = c n weighs the distances against the energy.
    tolerance : float
        Largest change of ln(k_theta) and of theta_0 [rad] that counts as none.
    max_iterations : int

    Returns
    -------
    Algorithm1Result
        Of the last iteration. A k_theta that runs away is a result, too: see its `status`.

    Raises
    ------
    EstimationError
        If an end is clamped or free, or no pose can be used.
    """
    began = perf_counter()
    used = _usable(cable, poses, gravity, n)
    problem = InnerProblem(cable, gravity, n, c)
    solve = {"ipopt": problem.solve_ipopt, "cobyla": problem.solve_cobyla}[inner]
    targets = [Target.of(item, problem.chain.h / 2) for item in used]
    shapes = [
        problem.first_guess(item.pose, target) for item, target in zip(used, targets, strict=True)
    ]
    k_theta = cable.bending_stiffness / problem.chain.h
    theta_0: FloatArray = np.zeros(n - 1)
    history = [k_theta]
    calm, failed = 0, 0
    status: Algorithm1Status | None = None
    while status is None and len(history) <= max_iterations:
        solved, failed = [], 0
        for phi, target in zip(shapes, targets, strict=True):
            new, converged = solve(phi, k_theta, theta_0, target)
            failed += not converged
            solved.append(new)
        shapes = solved
        angles = np.diff(shapes, axis=1)
        slopes = np.array([gravity_slopes(phi, problem.weight, problem.chain.h) for phi in shapes])
        last, last_0 = k_theta, theta_0
        k_theta, theta_0 = best_parameters(angles, slopes[:, 1:], k_theta, theta_0)
        history.append(k_theta)
        change = max(abs(np.log(k_theta / last)), float(np.abs(theta_0 - last_0).max()))
        calm = calm + 1 if change <= tolerance else 0
        if _runs_away(history):
            status = Algorithm1Status.RUNAWAY
        elif calm >= CALM:
            status = Algorithm1Status.CONVERGED
    status = status or Algorithm1Status.ITERATION_LIMIT
    seconds = perf_counter() - began
    model = CableModel(
        replace(cable, straight=False), n=n, element="link", gravity=gravity, n_rest=4
    )
    return Algorithm1Result(
        model=model,
        k_theta=k_theta,
        theta_0=theta_0,
        iterations=len(history) - 1,
        status=status,
        message=_message(status, history, seconds, failed, len(shapes)),
        history=np.array(history),
        seconds=seconds,
    )


def _usable(
    cable: Cable, poses: Sequence[MeasuredPose], gravity: tuple[float, ...], n: int
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
        try:
            check_pose(model, model.nominal, pose)
        except EquilibriumError:
            continue
        used.append(item)
    if not used:
        raise EstimationError("no pose to fit: every pose is held out, unread or out of reach.")
    return used


def _runs_away(history: list[float]) -> bool:
    """Whether k_theta has left its prior far behind, or moves away from it steadily."""
    if abs(np.log(history[-1] / history[0])) > np.log(RUNAWAY):
        return True
    steps = np.diff(np.log(history[-STEADY - 1 :]))
    steady = len(steps) == STEADY and (np.all(steps > 0) or np.all(steps < 0))
    return bool(steady and abs(steps.sum()) > np.log(GROWTH) and abs(steps[-1]) > LAST_STEP)


def _message(
    status: Algorithm1Status, history: list[float], seconds: float, failed: int, n_poses: int
) -> str:
    """Say in words how the loop ended."""
    count = len(history) - 1
    text = (
        f"After {counted(count, 'iteration')} ({seconds:.1f} s) {status.value}; "
        f"k_theta went from {history[0]:.3g} to {history[-1]:.3g} N m/rad."
    )
    if failed:
        shapes = f"{failed} of {counted(n_poses, 'pose')}"
        text += f" The shapes of {shapes} did not converge in the last one."
    return text
