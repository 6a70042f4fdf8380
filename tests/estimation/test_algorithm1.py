"""The paper's loop: its equations one by one, its two minimisers, and how it ends."""

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from dlo_casadi.config import load_config
from dlo_casadi.effects import CableData
from dlo_casadi.equilibrium.curve import NodeCurve
from dlo_casadi.equilibrium.pose import HeldPose
from dlo_casadi.equilibrium.solve import solve_equilibria, solve_equilibrium
from dlo_casadi.errors import EstimationError
from dlo_casadi.io.points import read_points
from dlo_casadi.model.cable_model import CableModel
from dlo_casadi.paper import algorithm1
from dlo_casadi.paper.algorithm1 import (
    Algorithm1Status,
    InnerProblem,
    Target,
    _runs_away,
    applies,
    best_parameters,
    expected_angles,
    gravity_slopes,
    run_algorithm1,
)
from dlo_casadi.rod.obstacles import Plane
from dlo_casadi.sensing.measured_pose import MeasuredPose

BENCH = Path(__file__).parents[1] / "data" / "bench"
GRAVITY = (0.0, -9.81)  # m/s^2
CABLE = CableData(length=0.8125, mass=0.23, diameter=0.0128, bending_stiffness=0.5)
ENDS = [(0.61, 0.0), (0.51, 0.1), (0.41, -0.3), (0.66, 0.2)]  # m


def session(name: str) -> tuple[CableData, list[MeasuredPose]]:
    """Cable and poses of a bench session with CSV centre-lines."""
    config = load_config(BENCH / name / "session.yaml")
    data = config.cable
    cable = CableData(data.length, data.mass, data.diameter, data.prior_bending_stiffness, name)
    poses = [
        MeasuredPose.of_points(
            HeldPose(item.start, item.end, branch=item.branch, name=item.name),
            read_points(item.paths[0], item.start, item.end).points,
            held_out=item.role == "held_out",
        )
        for item in config.experiment.poses
    ]
    return cable, poses


@cache
def fine_rod(cable: CableData) -> CableModel:
    return CableModel(cable, n=160, n_rest=4)


def measured(
    stiffness: float,
    ends: list[tuple[float, float]],
    kappa_0: float = 1.5,
    noise: float = 3e-4,
    cable: CableData = CABLE,
) -> list[MeasuredPose]:
    """Points of a fine rod of constant rest curvature [1/m], with white noise [m]."""
    rng = np.random.default_rng(0)
    model = fine_rod(cable)
    rest = np.full(160, kappa_0)
    poses = [
        HeldPose((0.0, 0.0), end, branch="ccw", name=f"pose {k}") for k, end in enumerate(ends)
    ]
    found = solve_equilibria(model, np.array([stiffness]), rest, poses)
    return [
        MeasuredPose.of_points(pose, eq.points[2:-1] + rng.normal(scale=noise, size=(158, 2)))
        for pose, eq in zip(poses, found, strict=True)
    ]


def rmse(result, poses: list[MeasuredPose]) -> float:
    """Distance of the measured points from the shapes predicted from the ends alone [m]."""
    distances = []
    for item in poses:
        shape = solve_equilibrium(result.model, result.p, result.rest, item.pose)
        curve = NodeCurve(result.model.cable.length, shape.points, None)
        distances.append(curve.distances(item.points))
    return float(np.sqrt(np.mean(np.concatenate(distances) ** 2)))


# ---- the equations -----------------------------------------------------------------------------


def test_expected_angle_of_two_links_by_hand():
    """Links at headings a and a + b: y_2 = h sin a + h/2 sin(a + b), dy_2/db = h/2 cos(a + b)."""
    h, m_link, k_theta, theta_0 = 0.4, 0.1, 0.7, 0.2
    a, b = -0.3, 0.8
    by_hand = theta_0 - m_link * 9.81 / k_theta * h / 2 * np.cos(a + b)
    slopes = gravity_slopes(np.array([a, a + b]), m_link * np.array(GRAVITY), h)
    # Both are the same few products: rounding only.
    assert expected_angles(k_theta, np.array([theta_0]), slopes[1:]) == pytest.approx(
        [by_hand], abs=1e-14
    )


@pytest.mark.parametrize("gravity", [GRAVITY, (3.0, -8.0)])
def test_slopes_of_the_weight_against_finite_differences(gravity):
    """Sum over the links of m_link g . (middle of the link), differentiated by each joint."""
    n, h, weight = 6, 0.1, 0.03 * np.array(gravity)
    theta = np.random.default_rng(0).normal(scale=0.5, size=n)

    def energy(theta):
        steps = h * np.exp(1j * np.cumsum(theta))
        middles = np.cumsum(steps) - steps / 2
        return -(weight[0] * middles.real + weight[1] * middles.imag).sum()

    by_difference = [(energy(theta + d) - energy(theta - d)) / 2e-6 for d in 1e-6 * np.eye(n)]
    # Central differences of step 1e-6: truncation 1e-12, rounding 1e-16 / 1e-6 = 1e-10.
    np.testing.assert_allclose(
        gravity_slopes(np.cumsum(theta), weight, h), by_difference, rtol=0, atol=1e-8
    )


def test_least_squares_equals_linear_regression_in_the_compliance():
    """Eq. 15 is linear in (1/k_theta, theta_0): theta = theta_0 - slopes / k_theta."""
    rng = np.random.default_rng(0)
    k_theta, theta_0 = 2.5, rng.normal(scale=0.2, size=5)
    slopes = rng.normal(scale=0.5, size=(8, 5))
    angles = theta_0 - slopes / k_theta + rng.normal(scale=0.01, size=slopes.shape)
    design = np.column_stack([-slopes.ravel(), np.tile(np.eye(5), (8, 1))])
    exact = np.linalg.lstsq(design, angles.ravel(), rcond=None)[0]
    found, found_0 = best_parameters(angles, slopes, 10.0, np.zeros(5))
    # The solver stops at relative changes of 1e-8; the second order makes far less of it.
    assert found == pytest.approx(1 / exact[0], rel=1e-6)
    np.testing.assert_allclose(found_0, exact[1:], atol=1e-7)


def test_distance_of_nodes_to_their_nearest_points():
    """r_p by hand: 0.01 m off two points of a line, and a node in a gap that does not count."""
    x = np.concatenate([np.linspace(0.01, 0.3, 30), np.linspace(0.6, 0.99, 40)])
    line = MeasuredPose.of_points(HeldPose((0.0, 0.0), (1.0, 0.0)), np.stack([x, 0 * x], axis=1))
    target = Target.of(line, gap=0.1)
    nodes = np.array([[0.2, 0.01], [0.42, 0.0], [0.8, -0.01]])
    np.testing.assert_array_equal(target.nearest(nodes)[1], [True, False, True])
    assert target.residual(nodes) == pytest.approx(2e-4, rel=1e-9)


def test_points_of_a_sparse_line_have_no_gaps_beside_them():
    """Spaced by more than half a link, none of ten points entered r_p."""
    x = np.delete(np.linspace(0.0, 1.0, 14)[1:-1], [6, 7])
    line = MeasuredPose.of_points(HeldPose((0.0, 0.0), (1.0, 0.0)), np.stack([x, 0 * x], axis=1))
    target = Target.of(line, gap=0.05)
    nodes = np.stack([np.linspace(0.1, 0.9, 9), np.zeros(9)], axis=1)
    seen = target.nearest(nodes)[1]
    np.testing.assert_array_equal(np.flatnonzero(~seen), [4, 5, 6])


def test_both_minimisers_reach_the_same_minimum():
    problem = InnerProblem(CABLE, GRAVITY, n=5)
    (item,) = measured(0.3, ENDS[1:2])
    target = Target.of(item, problem.chain.h / 2)
    guess = problem.first_guess(item.pose, target)
    arguments = (target, 2.0, np.zeros(4))
    smooth, converged = problem.solve_ipopt(guess, *arguments)
    linear, _ = problem.solve_cobyla(guess, *arguments)
    assert converged
    # COBYLA stops at steps of 1e-6 rad, on a valley floor where r_p jumps between points 5 mm
    # apart: 1e-3 rad, and a tenth of a percent of the objective.
    np.testing.assert_allclose(linear, smooth, atol=1e-3)
    assert problem.objective(linear, *arguments) == pytest.approx(
        problem.objective(smooth, *arguments), rel=1e-3
    )
    assert np.abs(problem.nodes(smooth)[-1] - target.end).max() < 1e-8  # IPOPT's tol is 1e-9


def test_first_guess_takes_the_measured_side():
    problem = InnerProblem(CABLE, GRAVITY, n=6)
    (item,) = measured(0.3, ENDS[:1])  # hangs below its chord: counter-clockwise
    anonymous = replace(item, pose=replace(item.pose, branch=None))
    target = Target.of(anonymous, problem.chain.h / 2)
    assert problem.first_guess(anonymous.pose, target)[-1] > 0
    other = replace(item.pose, branch="cw")
    assert problem.first_guess(other, target)[-1] < 0


# ---- the loop ----------------------------------------------------------------------------------


def test_runaway_is_reported_on_a_bench_session():
    """With noise and without the reaction of the end, no finite k_theta explains the shapes."""
    cable, poses = session("taper")
    result = run_algorithm1(cable, poses, GRAVITY)
    assert result.status is Algorithm1Status.RUNAWAY
    assert "runs away" in result.message
    assert f"{result.k_theta:.3g} N m/rad" in result.message
    assert result.k_theta > 1e3 * result.history[0]
    assert len(result.history) == result.iterations + 1
    # Its prediction runs all the same, some millimetres off; the noise is 0.3 mm.
    fit = [item for item in poses if not item.held_out]
    held = [item for item in poses if item.held_out]
    assert 1e-3 < rmse(result, fit) < 1e-2
    assert 1e-3 < rmse(result, held) < 1e-2


def test_stiff_session_predicts_better_than_its_prior():
    """Rest angles absorb a part of the rest curvature that the prior does not have."""
    cable, poses = session("weightless_fit")
    result = run_algorithm1(cable, poses, GRAVITY)
    prior = replace(result, k_theta=result.history[0], theta_0=np.zeros(9))
    held = [item for item in poses if item.held_out]
    assert result.theta_0.shape == (9,)
    assert np.all(result.theta_0 > 0)  # the truth bends counter-clockwise everywhere
    # Ten chords of a curve of 3 1/m are 0.4 to 1.1 mm off it, whatever the parameters.
    assert rmse(result, held) < 1.5e-3
    assert rmse(result, held) < 0.9 * rmse(prior, held)


@pytest.mark.long
def test_rest_angles_of_a_stiff_cable_near_its_rest_shape():
    """Where the ends barely load a stiff cable, the mean bend is the rest bend.

    The rest shape is an arc of radius 1/kappa_0; its own chord is 2/kappa_0 sin(kappa_0 L/2).
    """
    kappa_0 = 1.5
    chord = 2 / kappa_0 * np.sin(kappa_0 * CABLE.length / 2)
    ends = [
        (float((chord + d) * np.cos(a)), float((chord + d) * np.sin(a)))
        for a in (-0.6, 0.0, 0.5)
        for d in (-0.005, 0.005)
    ]
    stiff = replace(CABLE, bending_stiffness=77.0)
    result = run_algorithm1(stiff, measured(77.0, ends, kappa_0, cable=stiff), GRAVITY)
    # Noise of 0.3 mm on nodes 81 mm apart tilts a link by 5 mrad: 9 mrad a joint, over 6 poses
    # 3.7 mrad or 0.045 1/m, two of them for the largest of seven joints.
    np.testing.assert_allclose(result.rest[1:-1], kappa_0, atol=0.1)
    # Ten chords of this arc are L (kappa_0 h)^2 / 24 = 0.5 mm shorter than it; the chain hides
    # this length at its ends, whose joints bend by 0.12 1/m more even without noise.
    np.testing.assert_allclose(result.rest[[0, -1]], kappa_0, atol=0.25)


def test_loop_converges_in_several_calm_iterations():
    """A finite k_theta balances Eq. 14 here; without the reaction it need not be the true one."""
    cable, poses = session("short_clean")
    result = run_algorithm1(cable, poses, GRAVITY)
    assert result.status is Algorithm1Status.CONVERGED
    # Three successive changes within the tolerance of 1e-4.
    assert np.abs(np.diff(np.log(result.history[-4:]))).max() <= 1e-4


@pytest.mark.parametrize(
    ("step", "status", "iterations"),
    [(1e-3, Algorithm1Status.ITERATION_LIMIT, 5), (0.0, Algorithm1Status.CONVERGED, 3)],
)
def test_loop_goes_on_while_rest_angles_change(step, status, iterations, monkeypatch):
    """Though k_theta stays as it is; three calm iterations end it."""

    def found(angles, slopes, k_theta, theta_0):
        return k_theta, theta_0 + step

    monkeypatch.setattr(algorithm1, "best_parameters", found)
    x = np.linspace(0.02, 0.58, 40)
    points = np.column_stack([x, -0.25 * np.sin(np.pi * x / 0.6)])
    poses = [MeasuredPose.of_points(HeldPose((0.0, 0.0), (0.6, 0.0)), points)]
    result = run_algorithm1(CABLE, poses, GRAVITY, n=4, max_iterations=5)
    assert result.status is status
    assert result.iterations == iterations


@pytest.mark.parametrize(
    ("history", "away"),
    [
        ([1.0, 2e3], True),
        ([1.0, 0.4e-3], True),
        (list(1.2 ** np.arange(14)), True),  # twenty percent more in every iteration
        (list(1.2 ** -np.arange(14.0)), True),  # or less
        (list(4 - 3 * 0.3 ** np.arange(14)), False),  # rises to 4 and stays there
        ([1.0, 3.0, 2.0, 9.0], False),
    ],
)
def test_what_counts_as_running_away(history, away):
    assert _runs_away(history) is away


def test_limits_end_the_loop_with_a_message():
    cable, poses = session("short_clean")
    short = run_algorithm1(cable, poses, GRAVITY, max_iterations=2)
    assert short.status is Algorithm1Status.ITERATION_LIMIT
    assert short.iterations == 2
    assert "After 2 iterations" in short.message
    none = run_algorithm1(cable, poses, GRAVITY, max_iterations=0)
    assert none.status is Algorithm1Status.ITERATION_LIMIT
    assert none.iterations == 0
    # Nothing was found in no iteration: the prior.
    np.testing.assert_allclose(none.EI, cable.bending_stiffness, rtol=1e-12)
    np.testing.assert_array_equal(none.theta_0, 0)


def test_parameters_are_those_of_the_model():
    """k_theta = EI / h and theta_0 = kappa_0 h give the energy of Eq. 6 in `CableModel`."""
    result = run_algorithm1(CABLE, measured(0.3, ENDS), GRAVITY, n=6, max_iterations=1)
    problem = InnerProblem(CABLE, GRAVITY, 6)
    shape = solve_equilibrium(result.model, result.p, result.rest, HeldPose((0.0, 0.0), ENDS[0]))
    line = MeasuredPose.of_points(HeldPose((0.0, 0.0), ENDS[0]), shape.points[1:-1])
    by_paper = problem.objective(
        shape.phi, Target.of(line, gap=1.0), result.k_theta, result.theta_0
    )
    assert shape.energy == pytest.approx(by_paper, rel=1e-10)  # rounding of a few dozen terms


def test_held_out_and_unread_poses_are_not_used():
    poses = measured(0.3, ENDS)
    extra = [
        MeasuredPose.of_points(poses[0].pose, poses[0].points + 0.1, held_out=True),
        MeasuredPose.of_points(poses[1].pose, np.empty((0, 2))),
        MeasuredPose.of_points(HeldPose((0.0, 0.0), (2.0, 0.0)), poses[2].points),  # out of reach
    ]
    plain = run_algorithm1(CABLE, poses, GRAVITY, n=5, max_iterations=1)
    more = run_algorithm1(CABLE, [*poses, *extra], GRAVITY, n=5, max_iterations=1)
    np.testing.assert_array_equal(plain.theta_0, more.theta_0)
    with pytest.raises(EstimationError, match="no pose to fit"):
        run_algorithm1(CABLE, extra, GRAVITY)


def test_only_pins_are_known():
    assert applies(CableModel(CABLE))
    assert not applies(CableModel(CABLE, start="clamped"))
    assert not applies(CableModel(CABLE, end="free"))
    assert not applies(CableModel(CABLE, obstacles=(Plane((0.0, -0.3), (0.0, 1.0)),)))
    in_space = replace(CABLE, torsional_stiffness=CABLE.bending_stiffness)
    assert not applies(CableModel(in_space, gravity=(0.0, 0.0, -9.81)))
    clamped = MeasuredPose.of_points(
        HeldPose((0.0, 0.0), (0.5, 0.0), start_heading=0.0, name="p3"), np.eye(2)
    )
    with pytest.raises(EstimationError, match="p3: the paper's method knows pinned ends only"):
        run_algorithm1(CABLE, [clamped], GRAVITY)
    free = MeasuredPose.of_points(HeldPose((0.0, 0.0), name="p4"), np.eye(2))
    with pytest.raises(EstimationError, match="p4"):
        run_algorithm1(CABLE, [free], GRAVITY)
