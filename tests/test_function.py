"""Equilibria inside other CasADi problems: values, derivatives, and what has no equilibrium."""

from functools import cache, partial

import casadi as ca
import numpy as np
import pytest

import dlo_casadi as dlo
from dlo_casadi.effects import (
    AxialStretch,
    BendingSoftening,
    CableData,
    ClampAngle,
    ClampRotation,
    ImageScale,
    LumpedMass,
    RestCurvatureDrift,
)
from dlo_casadi.equilibrium.equilibrium import NEARBY
from dlo_casadi.equilibrium.implicit import pose_of
from dlo_casadi.equilibrium.solve import solve_equilibrium
from dlo_casadi.equilibrium.symbolic import CasadiCable
from dlo_casadi.errors import DloError, EquilibriumError
from dlo_casadi.model.cable_model import CableModel

# As dlo_pose: start, end [m], headings [rad]; or start, end, quaternions of any length, turns.
PLANE = np.array([0.01, 0.02, 0.5, 0.1, 0.3, -0.4])
SPACE = np.array([0.01, 0.02, 0.03, 0.5, 0.1, 0.05, 0.1, 0.0, 0.1, 1.1, 0.1, 0.2, 0.0, 0.9, 0.0])
POSES = {False: PLANE, True: SPACE}
BOTH = pytest.mark.parametrize("in_space", [False, True], ids=["plane", "space"])


@cache
def cable(in_space: bool, plain: bool = False):
    """Model, parameters and rest strains of a cable with one effect of each kind."""
    turned = ClampRotation() if in_space else ClampAngle()
    effects = (BendingSoftening(), AxialStretch(), LumpedMass(), turned)
    model = CableModel(
        CableData(0.8, 0.05, 0.005, 0.01, torsional_stiffness=0.008 if in_space else None),
        n=6 if in_space else 10,
        start="clamped",
        end="clamped",
        gravity=(0.0, 0.0, -9.81) if in_space else (0.0, -9.81),
        effects=() if plain else (*effects, ImageScale(), RestCurvatureDrift()),
        n_rest=0,
    )
    p = np.array([q.nominal + (0.0 if q.log else 0.5 * q.scale) for q in model.parameters])
    rest = np.zeros((len(model.node.strains), model.chain.n_cells))
    rest[-1] = 0.7
    return model, p, rest.ravel()


def called(function, at):
    return np.array(function(at)).ravel()


def along(function, at, direction, step):
    """Derivative by a difference of fourth order."""
    near, far = (
        function(at + k * direction) - function(at - k * direction) for k in (step, 2 * step)
    )
    return (8 * near - far) / (12 * step)


@BOTH
def test_values_and_both_derivatives_with_an_effect_of_each_kind(in_space):
    (model, p, rest), pose = cable(in_space), POSES[in_space]
    function = CasadiCable(model, p, rest).function(parameters=True)
    found = dict(zip(function.name_out(), map(np.array, function(pose, p)), strict=True))
    known = solve_equilibrium(model, p, rest, pose_of(model, pose))
    assert found["status"] == 0
    np.testing.assert_allclose(found["points"].T, known.points, atol=1e-12)
    np.testing.assert_allclose(found["end_force"].ravel(), known.end_force, atol=1e-12)
    np.testing.assert_allclose(found["end_moment"].ravel(), known.moments[1], atol=1e-12)
    assert found["energy"] == pytest.approx(known.energy, abs=1e-12)
    assert found["min_bend_radius"] == pytest.approx(known.min_bend_radius, rel=1e-12)
    assert 1 / found["curvature"].max() == pytest.approx(known.min_bend_radius, rel=1e-12)

    both, count = np.concatenate([pose, p]), len(pose)
    u, rng = ca.MX.sym("u", len(both)), np.random.default_rng(0)
    outs = ca.veccat(*function(u[:count], u[count:])[:-1])
    hessian, gradient = ca.hessian(ca.dot(rng.normal(size=outs.numel()), outs), u)
    way = rng.normal(size=len(both)) * np.maximum(np.abs(both), 0.01)
    calls = [outs, ca.jtimes(outs, u, ca.DM(way)), gradient, hessian @ way]
    value, slope, first, second = (partial(called, ca.Function("call", [u], [e])) for e in calls)
    for exact, differenced in ((slope, value), (second, first)):
        expected = along(differenced, both, way, 1e-3)
        np.testing.assert_allclose(exact(both), expected, atol=1e-8 * np.abs(expected).max())


@BOTH
def test_what_has_no_equilibrium_is_nan_with_its_derivatives_and_raises_nothing(in_space):
    model, p, rest = cable(in_space, plain=True)
    function = CasadiCable(model, p, rest).function()
    slopes = function.jacobian()
    far, lost = POSES[in_space].copy(), POSES[in_space].copy()
    far[model.node.dimension], lost[0] = 2.0, np.nan
    for pose, status in ((far, 1), (lost, 3)):
        *outs, found = function(pose)
        assert found == status
        assert all(np.isnan(np.array(out)).all() for out in outs)
        *by_pose, of_status = slopes(pose, *function(pose))
        assert all(np.isnan(np.array(part)).all() for part in by_pose)
        assert not np.array(of_status).any()


@pytest.mark.parametrize("stiffness", [0.0, -1.0])
def test_a_cable_without_stiffness_has_a_status(stiffness):
    model, p, rest = cable(False, plain=True)
    function = CasadiCable(model, p, rest).function(parameters=["bending_stiffness"])
    *outs, status = function(PLANE, stiffness)
    assert status == 2
    assert all(np.isnan(np.array(out)).all() for out in outs)


def test_turns_and_quaternions_that_cannot_be_have_a_status_wherever_the_end_is():
    model, p, rest = cable(True, plain=True)
    function = CasadiCable(model, p, rest).function()
    turned, none = POSES[True].copy(), POSES[True].copy()
    turned[-1] = np.inf
    none[3], none[6:10] = 5.0, 0.0
    assert [int(function(pose)[-1]) for pose in (turned, none)] == [3, 6]


def test_a_joint_at_its_bound_is_no_root_of_the_equations():
    model = CableModel(CableData(0.8, 0.05, 0.005, 1e-4), n=4, element="link", n_rest=0)
    function = CasadiCable(model, model.nominal, np.zeros(model.chain.n_rests)).function()
    pose = np.array([0.0, 0.0, 0.02, 0.0, 0.0, 0.0])
    found = solve_equilibrium(
        model, model.nominal, np.zeros(model.chain.n_rests), pose_of(model, pose)
    )
    assert found.stable
    assert found.bound_multipliers.any()
    assert function(pose)[-1] == 6
    assert np.isnan(np.array(function(pose)[0])).all()


def test_the_branch_asked_for():
    model = CableModel(CableData(0.8, 0.05, 0.005, 0.01), n=6, n_rest=0)
    rest, pose = np.zeros(model.chain.n_rests), np.array([0.0, 0.0, 0.5, 0.0, 0.0, 0.0])
    for branch, sign in (("ccw", -1), ("cw", 1)):
        function = CasadiCable(model, model.nominal, rest).function(branch=branch)
        points = np.array(function(pose)[0])
        assert sign * points[1, 3] > 0.1


@pytest.mark.parametrize("branch", ["ccw", "cw"])
def test_parallel_clamps_are_on_either_branch(branch):
    """Their headings fix the turn, 0 to rounding, of which no sign is asked."""
    held = {"start": "clamped", "end": "clamped"}
    model = CableModel(CableData(0.8, 0.05, 0.005, 0.01), n=6, n_rest=0, **held)
    rest, pose = np.zeros(model.chain.n_rests), np.array([0.0, 0.0, 0.5, 0.0, 0.0, 0.0])
    function = CasadiCable(model, model.nominal, rest).function(branch=branch)
    assert function(pose)[-1] == 0
    pose[-1] = {"ccw": -0.1, "cw": 0.1}[branch]
    assert function(pose)[-1] == 2


def test_a_cable_between_ball_joints_may_roll_and_has_derivatives_all_the_same():
    model = CableModel(
        CableData(0.8, 0.05, 0.005, 0.01, torsional_stiffness=0.008), n=6, gravity=(0.0, 0.0, -9.81)
    )
    function = CasadiCable(model, model.nominal, np.zeros(model.chain.n_rests)).function()
    u = ca.MX.sym("u", 15)
    energy = ca.Function("energy", [u], [*ca.hessian(function(u)[3], u), function(u)[1]])
    pose = np.concatenate([SPACE[:6], np.zeros(9)])  # orientations of pins are ignored
    hessian, gradient, force = map(np.array, energy(pose))
    np.testing.assert_allclose(gradient[3:6], -force, atol=1e-10)
    end = np.eye(15)[4]
    expected = along(lambda v: np.array(energy(v)[1]).ravel(), pose, end, 1e-3)
    np.testing.assert_allclose(hessian[:, 4], expected, atol=1e-7)


def test_mapped_and_optimised_beside_other_constraints():
    """Where the energy is lowest at a distance, the force on the end is along the chord."""
    model, p, _ = cable(False, plain=True)
    function = CasadiCable(model, p, np.zeros(model.chain.n_rests)).function()
    several = np.tile(PLANE, (3, 1)) + 0.01 * np.arange(3)[:, None]
    points = np.hstack([np.array(function(pose)[0]) for pose in several])
    np.testing.assert_array_equal(np.array(function.map(3)(several.T)[0]), points)

    problem = ca.Opti()
    end = problem.variable(2)
    pose = ca.vertcat(0, 0, end, -np.pi / 2, -np.pi / 2)
    problem.minimize(function(pose)[3])
    problem.subject_to(ca.sumsqr(end) == 0.6**2)
    problem.set_initial(end, [0.3, -0.4])
    problem.solver("ipopt", {"print_time": False}, {"print_level": 0, "sb": "yes"})
    there = problem.solve().value(end)
    force = np.array(function(np.concatenate([[0, 0], there, [-np.pi / 2] * 2]))[1]).ravel()
    assert np.linalg.norm(force) > 0.1
    assert force[0] * there[1] == pytest.approx(force[1] * there[0], abs=1e-7)


@pytest.mark.parametrize(
    "in_space", [False, pytest.param(True, marks=pytest.mark.long)], ids=["plane", "space"]
)
def test_equations_lead_an_optimiser_to_the_same_equilibrium(in_space):
    (model, p, rest), pose = cable(in_space), POSES[in_space]
    system = CasadiCable(model, p, rest).equations()
    x, multipliers = CasadiCable(model, p, rest).initial(pose)
    there = dict(zip(system.name_out(), system(x, multipliers, pose), strict=True))
    assert float(ca.norm_inf(there["residual"])) < 1e-12
    moved = pose + 0.03 * np.eye(len(pose))[model.node.dimension]
    u = ca.MX.sym("u", x.size + len(multipliers))
    found = system(ca.reshape(u[: x.size], *x.shape), u[x.size :], moved)
    problem = {"x": u, "g": found[0]}
    quiet = {"print_time": False, "ipopt.print_level": 0, "ipopt.sb": "yes", "ipopt.tol": 1e-12}
    solved = ca.nlpsol("solver", "ipopt", problem, quiet)(
        x0=np.concatenate([x.ravel("F"), multipliers]), lbg=0, ubg=0
    )
    told = ca.Function("told", [u], found)(solved["x"])
    expected = CasadiCable(model, p, rest).function()(moved)[:-1]
    for value, known in zip(told[-len(expected) :], expected, strict=True):
        np.testing.assert_allclose(np.array(value), np.array(known), atol=1e-9)
    assert model.node.same(np.array(solved["x"][: x.size]).reshape(x.T.shape), x.T, NEARBY * 4)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"parameters": ["tension"]}, "no parameter 'tension'; there are bending_stiffness"),
        ({"branch": "up"}, "branch must be 'ccw', 'cw'"),
    ],
)
def test_what_is_unknown_is_refused(options, words):
    with pytest.raises(DloError, match=words):
        CasadiCable(*cable(False, plain=True)).function(**options)


def test_a_first_guess_of_an_unknown_branch_is_refused():
    with pytest.raises(DloError, match="branch must be 'ccw', 'cw'"):
        CasadiCable(*cable(False, plain=True)).initial(PLANE, branch="up")


@pytest.mark.parametrize(
    ("at", "value", "words"),
    [
        (slice(10, 14), 0.0, "a quaternion of the pose is zero: end_orientation"),
        (slice(10, 11), np.nan, r"not finite: end_orientation \[nan, "),
        (slice(14, 15), np.nan, "not finite: turns nan"),
    ],
)
def test_a_meaningless_number_of_a_pose_is_named(at, value, words):
    pose = np.array(SPACE, dtype=float)
    pose[at] = value
    with pytest.raises(EquilibriumError, match=words):
        CasadiCable(*cable(True, plain=True)).initial(pose)


def test_a_pose_of_another_size_is_refused():
    with pytest.raises(DloError, match="pose: 6 numbers as in dlo_pose of the C header, found 15"):
        CasadiCable(*cable(False, plain=True)).initial(SPACE)


@pytest.mark.parametrize("position", [pytest.param(0.3, marks=pytest.mark.long), 0.4, 0.405])
@pytest.mark.parametrize(
    ("name", "gravity"), [("lumped_mass", (0, -9.81)), ("tether", (0, 0, -9.81))]
)
def test_the_derivative_by_a_place_on_the_edge_of_an_element_is_exact(name, gravity, position):
    """Of 16 elements of 50 mm all but 0.405 m are edges."""
    d = len(gravity)
    rope = dlo.Cable(
        length=0.8,
        mass=0.05,
        diameter=0.005,
        bending_stiffness=0.01,
        torsional_stiffness=0.006 if d == 3 else None,
    )
    anchor = {f"anchor_{axis}": 0.2 for axis in "xyz"[:d]}
    values = {"mass": 0.02} if name == "lumped_mass" else {"stiffness": 1.0} | anchor
    effect = {"name": name, "parameters": values | {"position": position}}
    held = {"gravity": gravity, "boundary": ("clamped", "clamped")}
    cable = dlo.known_cable(rope, **held, model={"n": 16, "effects": [effect]})
    F = cable.function(parameters=[f"{name}.position"])
    plane, space = (
        [0, 0, 0.5, 0.1, 0.3, -0.2],
        [0, 0, 0, 0.5, 0.1, 0.1, 0, 0, 0, 1, 0, 0.1, 0.2, 0.97, 0],
    )
    pose, theta = np.array(plane if d == 2 else space, float), ca.MX.sym("theta")
    slope = ca.Function("slope", [theta], [ca.jacobian(F(pose, theta)[1], theta)])

    def force(at):
        return np.array(F(pose, at)[1]).ravel()

    step = 1e-5
    expected = (force(position + step) - force(position - step)) / (2 * step)
    # The force is smooth; its second derivative jumps at the edge, by a share of the step.
    assert np.array(slope(position)).ravel() == pytest.approx(expected, rel=2e-3, abs=1e-4)
