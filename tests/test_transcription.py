"""Shapes as unknowns of a user's problem: the same equilibria, sparse, as dense as asked."""

import casadi as ca
import numpy as np
import pytest

import dlo_casadi as dlo
from dlo_casadi.equilibrium.implicit import symbols_of
from dlo_casadi.errors import DloError, EquilibriumError
from dlo_casadi.model.pose_system import pose_rows
from dlo_casadi.model.whole_pose import balance

FORWARD = (0.0, 0.0, 0.0, 1.0)
QUIET = {"print_time": False}, {"print_level": 0, "sb": "yes"}
IN_SPACE = pytest.mark.parametrize("in_space", [False, True], ids=["plane", "space"])


def cable(in_space, n=6, **more):
    torsion = {"torsional_stiffness": 0.008} if in_space else {}
    sizes = {"length": 0.6, "mass": 0.06, "diameter": 0.008, "bending_stiffness": 0.01}
    gravity = (0, 0, -9.81) if in_space else (0, -9.81)
    known = {"gravity": gravity, "boundary": ("clamped", "clamped"), "model": {"n": n} | more}
    return dlo.known_cable(dlo.Cable(**sizes, **torsion), **known)


def pose_to(in_space, end):
    """Numbers of a pose, in space with the same frames at both ends."""
    end = [*end] if in_space else [*end, 0, 0]
    return [0] * (3 if in_space else 2) + end + ([*FORWARD, *FORWARD, 0] if in_space else [])


def solved(known, end):
    d = len(end)
    key, frame = ("orientation", FORWARD) if d == 3 else ("heading", 0.0)
    return known.solve(end, start=(0,) * d, **{f"start_{key}": frame, f"end_{key}": frame})


@pytest.mark.parametrize(
    ("in_space", "effect"), [(False, "axial_stretch"), (True, "tether")], ids=["plane", "space"]
)
def test_block_banded_derivatives_are_those_by_sweeps(in_space, effect):
    """Values, Jacobian and Hessian of the equations against CasADi's own, with all numbers."""
    d = 3 if in_space else 2
    tether = {"stiffness": 1.0, "position": 0.2} | {f"anchor_{a}": 0.1 for a in "xyz"[:d]}
    own = {"axial_stretch": {"compliance": 0.05}, "tether": tether}[effect]
    known = cable(in_space, 4, effects=[{"name": effect, "parameters": own}])
    model, rng = known.model, np.random.default_rng(0)
    pose = np.array(pose_to(in_space, [0.3, 0.1, 0.05][:d]), float)
    first = known.initial(pose)
    x, lam = ca.MX.sym("x", *first.x.shape), ca.MX.sym("lam", model.n_border)
    at, p = ca.MX.sym("pose", len(pose)), ca.MX.sym("p", len(model.names))
    rest = ca.MX.sym("rest", model.chain.n_rests)
    u = ca.veccat(x, lam, at, p, rest)
    symbols = symbols_of(model, model.node.normalised(x), lam, at, p, rest)
    rows = pose_rows(model, symbols)
    ours, theirs = ca.vertcat(ca.vec(rows.balance), rows.conditions), balance(model, symbols)
    numbers = [first.x, first.multipliers, pose, known.p, known.rest]
    numbers = [np.asarray(one) + 0.05 * rng.normal(size=np.shape(one)) for one in numbers[:3]] + [
        known.p,
        rng.normal(size=len(known.rest)),
    ]
    w = ca.DM(rng.normal(size=theirs.numel()))
    found = [
        ca.Function("f", [x, lam, at, p, rest], [e, ca.jacobian(e, u), ca.hessian(w.T @ e, u)[0]])
        for e in (ours, theirs)
    ]
    for one, other in zip(*(map(ca.DM, function(*numbers)) for function in found), strict=True):
        one, other = one.full(), other.full()
        np.testing.assert_allclose(one, other, atol=1e-11 * max(np.abs(other).max(), 1.0))


def test_the_hessian_of_the_equations_grows_with_the_nodes():
    """Entries are those of neighbouring nodes and of the border: 72 more for each node."""
    counts = []
    for count in (8, 9):
        system = cable(True, count).equations()
        x, lam, pose = system.mx_in()
        residual = system(x, lam, pose)[0]
        u = ca.veccat(x, lam, pose)
        hessian, _ = ca.hessian(ca.sum1(residual), u)
        counts.append(hessian.nnz())
    assert counts[1] - counts[0] == 4 * (4 + 2 * 4 + 2 * 3)


@IN_SPACE
def test_transcribed_shapes_are_those_of_solve(in_space):
    known, opti = cable(in_space), ca.Opti()
    ends = np.array([[0.3, 0.3, 0.3], [0.0, 0.05, 0.1], [0.0, 0.02, 0.05]])[: 3 if in_space else 2]
    end = opti.variable(*ends.shape)
    opti.set_initial(end, ends + 0.01)
    poses = [ca.vertcat(*pose_to(in_space, ca.vertsplit(end[:, k]))) for k in range(3)]
    shapes = known.transcribe(opti, poses, points=101)
    opti.minimize(ca.sumsqr(end - ends))
    opti.solver("ipopt", *QUIET)
    done = opti.solve()
    for k, shape in enumerate(shapes):
        expected = solved(known, tuple(ends[:, k]))
        for name in ("points", "start_force", "end_force", "start_moment", "end_moment", "energy"):
            value = np.array(done.value(getattr(shape, name))).T
            np.testing.assert_allclose(value, getattr(expected, name), atol=2e-7)
        assert 1 / done.value(shape.curvature).max() == pytest.approx(
            expected.min_bend_radius, rel=1e-6
        )


def test_the_hessian_of_a_bound_on_points_is_banded():
    known, opti = cable(True, 16), ca.Opti()
    (shape,) = known.transcribe(opti, [pose_to(True, [0.3, 0.1, 0.0])], points=65)
    distance = ca.sum1((shape.points - ca.DM([0.1, 0.0, -0.3])) ** 2)
    hessian, _ = ca.hessian(ca.sum2(distance), opti.x)
    assert hessian.nnz() < 0.2 * hessian.numel()


def test_ends_stay_within_reach():
    known, opti = cable(True), ca.Opti()
    end = opti.variable(3)
    opti.set_initial(end, [0.3, 0.0, 0.0])
    known.transcribe(opti, [ca.vertcat(*pose_to(True, ca.vertsplit(end)))], reach=0.8)
    opti.minimize(-end[0])
    opti.solver("ipopt", *QUIET)
    assert np.linalg.norm(opti.solve().value(end)) == pytest.approx(0.8 * 0.6, abs=1e-6)


@pytest.mark.parametrize(
    ("poses", "options", "words"),
    [
        ([[0.0] * 6], {}, "pose 1: 15 numbers as in dlo_pose of the C header, found 6"),
        (["there"], {}, "pose 1: numbers or MX belong here, found 'there'"),
        ([[0.0] * 15], {"points": 1}, "points: a whole number of at least 2, or None, found 1"),
        ([[0.0] * 15], {"reach": 1.5}, "reach: a share of the length between 0 and 1, found 1.5"),
        ([[0.0] * 15], {"branch": "up"}, "branch must be 'ccw', 'cw'"),
        ([ca.MX.sym("elsewhere", 15)], {}, "they have no first value"),
    ],
)
def test_what_is_meaningless_is_refused(poses, options, words):
    with pytest.raises(DloError, match=words):
        cable(True).transcribe(ca.Opti(), poses, **options)


def test_a_first_value_without_a_shape_is_named():
    poses = [pose_to(True, [0.3, 0.0, 0.0]), pose_to(True, [0.9, 0.0, 0.0])]
    with pytest.raises(EquilibriumError, match=r"the end \(0.9000, .* the cable is 0.6000 m long"):
        cable(True).transcribe(ca.Opti(), poses)


@IN_SPACE
def test_points_of_a_function_are_those_of_its_shape(in_space):
    known, end = cable(in_space), (0.3, 0.1, 0.05)[: 3 if in_space else 2]
    function = known.function(points=101)
    found = dict(zip(function.name_out(), function(pose_to(in_space, end)), strict=True))
    expected = solved(known, end)
    np.testing.assert_allclose(np.array(found["points"]).T, expected.points, atol=1e-12)
    for name in ("start_force", "start_moment"):
        np.testing.assert_allclose(
            np.array(found[name]).squeeze(), getattr(expected, name), atol=1e-12
        )


@pytest.mark.parametrize(
    "in_space", [False, pytest.param(True, marks=pytest.mark.long)], ids=["plane", "space"]
)
def test_derivatives_by_mass_length_and_rest_curvature(in_space):
    """Against known cables of another mass, length and constant rest curvature."""
    known, pose = cable(in_space), pose_to(in_space, [0.3, 0.1, 0.05][: 3 if in_space else 2])
    function = known.function(parameters=["length", "mass", "rest_curvature"])
    axes = 2 if in_space else 1
    values = np.array([0.6, 0.06, *[0.0] * axes])
    theta = ca.MX.sym("theta", len(values))
    energy = function(pose, theta)[3]
    slope = ca.Function("slope", [theta], [ca.gradient(energy, theta)])
    found = np.array(slope(values)).ravel()
    assert float(function(pose, values)[3]) == pytest.approx(float(known.function()(pose)[3]))
    for k, step in enumerate([1e-5, 1e-5, *[1e-3] * axes]):
        both = []
        for side in (step, -step):
            length, mass, *rest = values + side * np.eye(len(values))[k]
            torsion = {"torsional_stiffness": 0.008} if in_space else {}
            sizes = {"length": length, "mass": mass, "diameter": 0.008}
            other = dlo.known_cable(
                dlo.Cable(**sizes, bending_stiffness=0.01, **torsion),
                gravity=(0, 0, -9.81) if in_space else (0, -9.81),
                boundary=("clamped", "clamped"),
                rest_curvature=rest if in_space else rest[0],
                model={"n": 6},
            )
            both.append(float(other.function()(pose)[3]))
        assert found[k] == pytest.approx((both[0] - both[1]) / (2 * step), rel=1e-4, abs=1e-8)


def test_a_parameter_that_nothing_has_is_named():
    with pytest.raises(DloError, match=r"no parameter 'rest_curvature\[7\]'; there are .*mass"):
        cable(False).function(parameters=["rest_curvature[7]"])
