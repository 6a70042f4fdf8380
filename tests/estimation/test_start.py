"""Where a fit begins: twists either way round, and poses that the balance alone leads astray."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from straight_segments import Ends, SegmentRod
from test_relaxation import HELD, NOISE, ROLL, problem_of

from dlo_casadi.effects import BendingAnisotropy, CableData, PointForce
from dlo_casadi.equilibrium.pose import HeldPose
from dlo_casadi.estimation.fit import fit_model
from dlo_casadi.estimation.measured_shapes import _along, measured_shapes
from dlo_casadi.estimation.prediction import predict_poses
from dlo_casadi.estimation.problem import Priors, Problem
from dlo_casadi.estimation.relaxation import SOFTNESS, Relaxation
from dlo_casadi.estimation.start import (
    _either_way,
    begin,
    fit_from,
    relaxed,
    retry_outlying_poses,
)
from dlo_casadi.estimation.unknowns import Unknowns, Values
from dlo_casadi.model.cable_model import END_ROLL, CableModel
from dlo_casadi.model.tolerances import Tolerances
from dlo_casadi.sensing.measured_pose import MeasuredPose
from dlo_casadi.sensing.noise import NoiseModel

OFF = 0.5


def test_twists_are_turned_the_way_that_fits():
    """Beside a roll that is off by 0.5 rad, that nearest to none of one pose is the wrong one."""
    problem, p = problem_of(marked=False)
    problem = replace(problem, noise=NoiseModel(3e-3))
    unknowns, model = problem.unknowns, problem.unknowns.model

    roll = ROLL + OFF
    theta = unknowns.pack(p, np.zeros(model.n_coefficients))
    theta[unknowns.names.index(END_ROLL)] = roll / 0.1
    values = Values(theta, *measured_shapes(problem, roll))
    problem, fixed = problem.weighed(values), np.ones(len(theta), dtype=bool)
    begun = _either_way(problem, Relaxation(problem, SOFTNESS[0]).solve(values, fixed))

    true = model.node.turning(measured_shapes(problem, ROLL)[0].x)
    before, after = (model.node.turning(x.shapes.x) for x in (values, begun))
    assert true[0] > 2.0
    assert before[0] < -2.0
    np.testing.assert_allclose(after, true + OFF, atol=0.2)


def test_measured_shapes_are_computed_once_for_all_loads():
    problem, _ = problem_of()
    model = problem.unknowns.model.with_effect(PointForce())
    unknowns = Unknowns(model, np.ones(len(model.names), dtype=bool), 2 * model.nominal)
    alone, hits = measured_shapes(problem, ROLL), _along.cache_info().hits
    loaded = measured_shapes(replace(problem, unknowns=unknowns), ROLL)
    assert _along.cache_info().hits == hits + 1
    np.testing.assert_array_equal(loaded[0].x, alone[0].x)
    loaded[0].x[:], loaded[1][0][:] = np.nan, np.nan
    again = measured_shapes(problem, ROLL)
    np.testing.assert_array_equal(again[0].x, alone[0].x)
    np.testing.assert_array_equal(again[1][0], alone[1][0])


def test_shapes_between_ball_joints_reach_the_line():
    """Nothing holds their roll; steps of 40 rad in it left 1.2 mm, noise leaves 0.4 mm."""
    cable = CableData(0.6, 0.04, 0.005, 0.01, torsional_stiffness=0.008)
    model, rng = CableModel(cable, 20, n_rest=3, gravity=(0, 0, -9.81)), np.random.default_rng(26)
    ends = rng.uniform([0.3, -0.1, -0.1], [0.45, 0.1, 0.1], (3, 3))
    poses, s = [HeldPose((0, 0, 0), tuple(end)) for end in ends], np.linspace(0.06, 0.54, 6)
    curves = [x.curve for x in predict_poses(model, model.nominal, np.zeros(60), poses)]
    measured = tuple(
        MeasuredPose.of_points(pose, curve.at(s) + rng.normal(scale=3e-4, size=(6, 3)))
        for pose, curve in zip(poses, curves, strict=True)
    )
    unknowns = Unknowns(model, np.ones(len(model.names), dtype=bool), model.nominal)
    problem = Problem(unknowns, measured, NoiseModel(3e-4), Priors.of(Tolerances(), model))
    seen = problem.equilibria.seen(measured_shapes(problem)[0], model.nominal, np.zeros(60))
    away = [item.distances(one.curve) for item, one in zip(measured, seen, strict=True)]
    assert np.sqrt(np.mean(np.square(away))) < 6e-4


def test_a_fit_between_ball_joints_ends_at_no_saddle():
    """Points of another rod, curved at rest about both axes, that nothing holds about its axis.

    Rolled against a rest curvature it comes as near to the points, with a stiffness that is 4 %
    too high: only the sign of the energy's curvature tells. No cable is predicted at a saddle.
    """
    length, mass, bending, u = 0.6, 0.04, 0.012, (np.arange(60) + 0.5) / 60
    curvature = np.array([0.05 + 1.1 * np.exp(-(((u - 0.5) / 0.3) ** 2)), np.full_like(u, 0.7)])
    rod = SegmentRod(length, np.array([0, 0, -9.81 * mass]), bending, 0.75 * bending, curvature)
    cable = CableData(length, mass, 0.004, 0.02, torsional_stiffness=0.0154)
    model, rng = CableModel(cable, 10, n_rest=6, gravity=(0, 0, -9.81)), np.random.default_rng(1)
    ends = [(0.04, -0.37, 0.12), (0.25, 0.0, 0.27), (0.38, -0.24, 0.11), (0.31, 0.12, -0.2)]
    ends += [(0.47, 0.04, -0.05), (0.15, -0.36, 0.2)]
    s, measured = np.linspace(0.05, 0.95, 12) * length, []
    for end in ends:
        nodes = rod.shape(Ends(np.zeros(3), np.array(end)), starts=2, gap=0.0)
        points = rod.points(nodes, s) + rng.normal(scale=3e-4, size=(12, 3))
        measured.append(MeasuredPose.of_points(HeldPose((0, 0, 0), end), points, s=s))
    fit = fit_model(model, measured, Tolerances(), 3e-4)
    assert fit.converged
    assert fit.stable.all()
    assert fit.chi2_per_dof < 1.2
    assert abs(fit.p[0] - bending) < 2 * fit.std("bending_stiffness")
    poses = [item.pose for item in measured]
    predicted = predict_poses(model, fit.p, fit.rest, poses)
    away = [item.distances(one.curve) for item, one in zip(measured, predicted, strict=True)]
    assert np.sqrt(np.mean(np.square(away))) < 1.2 * np.sqrt(3) * 3e-4


TRUE = {"bending_anisotropy.ratio": 1.9, "bending_anisotropy.angle": 0.3}


@pytest.fixture(scope="module")
def flat():
    """Six poses of a flat cable, the problem begun at its true parameters; these, theta held."""
    cable = CableData(1.0, 0.08, 0.007, bending_stiffness=0.018, torsional_stiffness=0.007)
    flat = CableModel(cable, 24, "quadratic", n_rest=2, effects=(BendingAnisotropy(),), **HELD)
    p = np.array([TRUE.get(x, y) for x, y in zip(flat.names, flat.nominal, strict=True)])
    coefficients, rng = np.array([1.0, 0.6, 0.3, -0.4]), np.random.default_rng(3)
    s, measured = np.linspace(0.02, 0.98, 15), []
    for _ in range(6):
        turned, way = (Rotation.from_rotvec(rng.uniform(-x, x, 3)) for x in (1.2, 0.6))
        end = tuple(way.apply([rng.uniform(0.5, 0.85), 0.0, 0.0]))
        pose = HeldPose((0.0, 0.0, 0.0), end, end_orientation=tuple(turned.as_quat()))
        (shape,) = predict_poses(flat, p, flat.rest_basis @ coefficients, [pose])
        points = shape.curve.at(s) + rng.normal(scale=NOISE, size=(len(s), 3))
        measured.append(MeasuredPose.of_points(pose, points))
    model = flat.with_mesh(8)
    unknowns = Unknowns(model, np.ones(len(p), dtype=bool), p)
    priors = Priors.of(Tolerances(), model)
    problem = Problem(unknowns, tuple(measured), NoiseModel(NOISE), priors)
    theta = unknowns.pack(p, coefficients)
    held = np.ones(len(theta), dtype=bool)
    return *begin(problem, theta, held), held


def test_a_pose_that_the_balance_alone_rolls_astray_is_taken_from_its_ends(flat):
    """Begun at the true parameters; without that, ratios between 1.5 and 1.9 were found."""
    problem, begun, held = flat
    followed = relaxed(problem, begun, SOFTNESS[1:], held)
    left = Relaxation(problem, SOFTNESS[-1]).objectives(followed)[0]
    n = problem.measured[0].n_residuals
    assert np.sum(left > 100 * n) == 1
    fit = fit_from(problem, begun, fixed=held)
    assert max(float(e @ e) for e in fit.point.residuals) < 2 * n
    assert fit.value("bending_anisotropy.ratio") == pytest.approx(1.9, rel=0.02)


def test_what_such_a_pose_tells_is_left_out_while_it_is_tried_from_other_shapes(flat):
    """With the parameters free it has drawn them away before."""
    problem, begun, _ = flat
    astray = relaxed(problem, begun, SOFTNESS[1:])
    ratio = problem.unknowns.names.index("bending_anisotropy.ratio")

    def error(values):
        return abs(problem.unknowns.p(values.theta)[ratio] - 1.9)

    found = retry_outlying_poses(problem, begun, astray, SOFTNESS[-1])
    assert error(astray) > 0.05
    assert error(found) < 0.02
    more = Relaxation(problem, SOFTNESS[-1])
    assert more.objective(found) < 0.1 * more.objective(astray)


def test_where_most_poses_lie_off_none_is_tried_from_other_shapes(flat):
    problem, begun, _ = flat
    values = replace(begun, shapes=replace(begun.shapes, lam=begun.shapes.lam + 1.0))
    assert retry_outlying_poses(problem, begun, values, SOFTNESS[-1]) is values


def test_where_no_pose_can_be_evaluated_none_is_tried_from_other_shapes(flat):
    problem, begun, _ = flat
    values = replace(begun, shapes=replace(begun.shapes, lam=np.nan * begun.shapes.lam))
    assert retry_outlying_poses(problem, begun, values, SOFTNESS[-1]) is values
