"""A cable that is fed through its end: the direction is held, the free length follows."""

import json
from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from perturbed import assert_derivatives
from scipy.spatial.transform import Rotation

import dlo_casadi as dlo
from dlo_casadi.cli import main
from dlo_casadi.config import dump_yaml, load_config
from dlo_casadi.effects import CableData, LengthError, MassError, PointForce
from dlo_casadi.equilibrium.batch import BatchEquilibrium
from dlo_casadi.equilibrium.by_ipopt import by_ipopt
from dlo_casadi.equilibrium.implicit import SIDES
from dlo_casadi.equilibrium.pose import HeldPose
from dlo_casadi.equilibrium.solve import solve_equilibrium
from dlo_casadi.equilibrium.spread import SolvedCable
from dlo_casadi.equilibrium.symbolic import CasadiCable
from dlo_casadi.errors import ConfigError, DloError, EquilibriumError
from dlo_casadi.estimation.batch import solve_batch
from dlo_casadi.estimation.fit import fit_model
from dlo_casadi.io.points import write_points
from dlo_casadi.model.cable_model import CableModel
from dlo_casadi.model.clips import HeldClip
from dlo_casadi.model.tolerances import Tolerances
from dlo_casadi.rod.obstacles import Plane
from dlo_casadi.sensing.measured_pose import MeasuredPose
from dlo_casadi.sensing.sensors import Markers

LOOM = CableData(1.0, 0.2, 0.01, bending_stiffness=0.02, torsional_stiffness=0.015, straight=True)
FLAT = replace(LOOM, torsional_stiffness=None)


def turned(*vector):
    return tuple(Rotation.from_rotvec(vector).as_quat())


def case(space, tension, n=20, effects=()):
    """A cable that hangs from a clamp into a guide, and the direction of the guide."""
    held = {"n": n, "n_rest": 0, "start": "clamped", "end": "slide", "effects": effects}
    if not space:
        pose = HeldPose((0.0, 0.0), (0.6, 0.2), start_heading=-0.3, end_heading=0.1)
        along = np.array([np.cos(0.1), np.sin(0.1)])
        model = CableModel(FLAT, gravity=(0.0, -9.81), **held)
    else:
        frames = {"start_orientation": turned(0.0, -0.2, 0.3)}
        frames |= {"end_orientation": turned(0.3, 0.4, 0.9)}
        pose = HeldPose((0.0, 0.0, 0.0), (0.6, 0.2, 0.1), **frames)
        along = Rotation.from_quat(pose.end_orientation).apply([1.0, 0.0, 0.0])
        model = CableModel(LOOM, gravity=(0.0, 0.0, -9.81), **held)
    return model, replace(pose, end_tension=tension), along


def solved(model, pose):
    return solve_equilibrium(model, model.nominal, np.zeros(model.chain.n_rests), pose)


@pytest.mark.parametrize("space", [False, True])
def test_the_tension_beyond_the_guide_is_that_before_it_and_the_thrust_of_the_bend(space):
    """T = N + M^2 / (2 EI): Bigoni et al., Mechanics of Materials 80 (2015)."""
    errors = []
    for n in (10, 20):
        model, pose, along = case(space, 0.8, n)
        eq = solved(model, pose)
        assert eq.stable
        bend = np.linalg.norm(np.atleast_1d(eq.moments[1])) ** 2 / (2 * LOOM.bending_stiffness)
        assert bend > 0.01
        errors.append(abs(-eq.end_force @ along + bend - 0.8))
    assert errors[1] < 1e-4
    assert errors[1] < errors[0] / 8


@pytest.mark.parametrize("space", [False, True])
def test_it_is_a_cable_of_its_free_length(space):
    """The same shape as of a cable so long, of the same mass per length, that cannot slide.

    A force in between keeps its place on it.
    """
    model, pose, _ = case(space, 0.8, effects=(PointForce(),))
    p, rest = model.nominal.copy(), np.zeros(model.chain.n_rests)
    p[model.names.index("point_force.fy")] = -0.1
    p[model.names.index("point_force.position")] = 0.31  # m from the start, however long it is
    eq = solve_equilibrium(model, p, rest, pose)
    free = LOOM.length + eq.fed
    assert abs(eq.fed) > 0.2
    cable = replace(model.cable, length=free, mass=LOOM.mass * free / LOOM.length)
    held = replace(model, cable=cable, end="swivel")
    same = solve_equilibrium(held, p, rest, replace(pose, end_tension=None))
    np.testing.assert_allclose(eq.points, same.points, atol=1e-9)
    np.testing.assert_allclose(eq.end_force, same.end_force, atol=1e-8)
    np.testing.assert_allclose(eq.start_force, same.start_force, atol=1e-8)
    np.testing.assert_allclose(eq.moments, same.moments, atol=1e-9)


def test_a_longer_or_shorter_cable_has_a_higher_energy():
    """E(length) + T length + weight beyond the guide, of cables that cannot slide, is least."""
    model, pose, _ = case(False, 0.8)
    eq = solved(model, pose)

    def energy(fed):
        share = 1 + fed / LOOM.length
        cable = replace(FLAT, length=share * LOOM.length, mass=share * LOOM.mass)
        held = replace(model, cable=cable, end="clamped")
        above = LOOM.mass / LOOM.length * 9.81 * pose.end[1]
        return solved(held, replace(pose, end_tension=None)).energy + fed * (0.8 - above)

    here, step = energy(eq.fed), 1e-3
    assert eq.energy == pytest.approx(here, abs=1e-9)
    lower, upper = energy(eq.fed - step), energy(eq.fed + step)
    assert min(lower, upper) > here
    assert abs(upper - lower) < 0.05 * (lower + upper - 2 * here)


def test_ipopt_finds_the_same_minimum():
    model, pose, _ = case(False, 0.8)
    eq, rest = solved(model, pose), np.zeros(model.chain.n_rests)
    other = by_ipopt(
        model, model.nominal, rest, pose, eq.phi + 0.1 * np.sin(3 * model.chain.places)
    )
    assert other is not None
    assert other.energy == pytest.approx(eq.energy, abs=1e-10)
    assert other.fed == pytest.approx(eq.fed, abs=1e-9)


def test_a_slack_cable_runs_through_the_guide():
    """Where its weight exceeds what holds it there is no equilibrium."""
    model, pose, _ = case(False, 0.1)
    with pytest.raises(EquilibriumError, match="no equilibrium found"):
        solved(model, replace(pose, start_heading=-1.0, end_heading=1.2))


@pytest.mark.parametrize("space", [False, True])
def test_derivatives_by_parameters(space):
    effects = (MassError(), LengthError(), PointForce())
    model, pose, _ = case(space, 0.8, 12, effects)
    p = model.nominal.copy()
    p[model.names.index("mass_error.factor")] = 1.1
    p[model.names.index("length_error.length_difference")] = 0.01
    p[model.names.index("point_force.fx")] = 0.05
    p[model.names.index("point_force.position")] = 0.43
    columns = [model.names.index(name) for name in ("bending_stiffness", "mass_error.factor")]
    columns += [model.names.index("point_force.fx"), model.names.index("point_force.position")]
    assert_derivatives(model, pose, p, np.zeros(model.chain.n_rests), columns)


@pytest.mark.parametrize(
    ("space", "known"),
    [
        pytest.param(False, True, marks=pytest.mark.long),
        (False, False),
        pytest.param(True, True, marks=pytest.mark.long),
    ],
)
def test_a_session_whose_free_lengths_differ(space, known):
    """Lines of 0.3 mm noise; lengths between the ends differ by a third from pose to pose.

    Tensions are `known`, or free lengths are estimated.
    """
    model, pose, _ = case(space, 0.0, 40)
    rng, d, poses, rest = np.random.default_rng(0), 2 + space, [], np.zeros(model.chain.n_rests)
    fed = []
    while len(poses) < 5:
        end = np.array(pose.end) * rng.uniform(0.9, 1.25) + rng.uniform(-0.05, 0.05, d)
        tension = float(rng.uniform(0.8, 2.0))
        own = replace(pose, end=tuple(end), end_tension=tension)
        held = SolvedCable.of(model, model.nominal, rest, own)
        fed.append(held.equilibrium.fed)
        points = held.curve.at(np.linspace(0.02, 0.98, 50)) + 3e-4 * rng.standard_normal((50, d))
        kept = {name: x for name, x in own.directions.items() if name != "turns"}
        role = "held_out" if len(poses) == 2 else "fit"
        kept |= {"end_tension": tension} if known else {}
        one = dlo.Pose(own.start, own.end, points=points, role=role, **kept)
        poses.append(one)
    assert np.ptp(fed) > 0.05
    cable = dlo.Cable(
        length=1.0, mass=0.2, diameter=0.01, bending_stiffness=0.03, rest_shape="straight"
    )
    session = dlo.Session(
        cable,
        poses,
        gravity=model.gravity,
        boundary=("clamped", "slide"),
        std=3e-4,
        model={"n": 20},
    )
    result = session.fit()
    assert result.verdict == "complete"
    low, high = result.params["bending_stiffness"].interval_95
    assert low < 0.02 < high
    assert result.stages[-1].rmse_held_out < 1e-3
    held = poses[0].held
    fixed = {"start": held.start, **held.directions}
    beyond = {"end_tension": held.end_tension} if known else {"free_length": 1.0 + fed[0]}
    shape = result.cable.solve(held.end, **fixed, **beyond)
    for k, one in enumerate(result.stages[-1].shapes.values()):
        assert one.fed == pytest.approx(fed[k], abs=2e-3)
    assert shape.free_length == pytest.approx(1.0 + fed[0], abs=2e-3)
    assert shape.s[-1] == shape.free_length
    steps = np.linalg.norm(np.diff(shape.points, axis=0), axis=1)
    assert steps.sum() == pytest.approx(shape.free_length, rel=1e-3)


def reversed_case(model, pose, rest):
    """The same cable from its other end, in space turned by half a turn about its axes z."""

    def turn(direction):
        if not isinstance(direction, tuple):
            return None if direction is None else direction + np.pi
        half = Rotation.from_rotvec([0.0, 0.0, np.pi])
        return tuple((Rotation.from_quat(direction) * half).as_quat())

    key = "orientation" if model.in_space else "heading"
    directions = {
        f"start_{key}": turn(getattr(pose, f"end_{key}")),
        f"end_{key}": turn(getattr(pose, f"start_{key}")),
    }
    clips = tuple(
        replace(clip, at=clip.at and LOOM.length - clip.at, **{key: turn(getattr(clip, key))})
        for clip in pose.clips[::-1]
    )
    back = HeldPose(pose.end, pose.start, start_tension=pose.end_tension, clips=clips, **directions)
    signs = (1.0, 1.0, -1.0) if model.in_space else (-1.0,)
    parts = np.split(rest, len(signs))
    other = np.concatenate([sign * part[::-1] for sign, part in zip(signs, parts, strict=True)])
    return replace(model, start="slide", end="clamped", clips=model.clips[::-1]), back, other


def held_between(space, kinds, obstacles=(), n=20):
    """The case with clips of these kinds, a rest curvature and obstacles."""
    model, pose, _ = case(space, 0.8, n)
    places, at = [(0.25, -0.02, 0.05), (0.45, 0.05, 0.05)], (0.3, 0.5)
    direction = {"orientation": (0.0, 0.0, 0.0, 1.0)} if space else {"heading": 0.05}
    clips = tuple(
        HeldClip(
            kind,
            place[: 2 + space],
            None if kind == "eyelet" else s,
            **(direction if kind == "clamped" else {}),
        )
        for kind, place, s in zip(kinds, places, at, strict=False)
    )
    model = replace(model, clips=kinds, obstacles=obstacles)
    middles = model.chain.cells.mean(axis=1)
    bent = 2.0 * np.sin(3 * middles)
    rest = np.concatenate([0 * bent, bent, bent / 2]) if space else bent
    return model, replace(pose, clips=clips), rest


@pytest.mark.parametrize("space", [False, True])
@pytest.mark.parametrize("kinds", [(), ("pinned",), ("clamped", "eyelet")])
def test_a_start_that_slides_is_an_end_that_slides_of_the_reversed_cable(space, kinds):
    held = held_between(space, kinds)
    back = reversed_case(*held)
    one, other = (
        solve_equilibrium(model, model.nominal, rest, pose) for model, pose, rest in (held, back)
    )
    assert one.stable
    assert other.energy == pytest.approx(one.energy, abs=1e-12)
    assert other.fed == pytest.approx(one.fed, abs=1e-10)
    np.testing.assert_allclose(other.points[::-1], one.points, atol=1e-9)
    np.testing.assert_allclose(other.start_force, one.end_force, atol=1e-9)
    np.testing.assert_allclose(other.end_force, one.start_force, atol=1e-9)
    for load, own in zip(other.clips[::-1], one.clips, strict=True):
        assert LOOM.length - load.at == pytest.approx(own.at, abs=1e-9)
        np.testing.assert_allclose(load.force, own.force, atol=1e-8)


@pytest.mark.parametrize("space", [False, True])
def test_clips_and_a_rest_curvature_keep_their_places_on_a_cable_that_is_fed(space):
    """The same shape as of a cable so long, of the same rest curvature, that cannot slide."""
    errors = []
    for n in (20, 40):
        model, pose, rest = held_between(space, ("pinned",), n=n)
        eq = solve_equilibrium(model, model.nominal, rest, pose)
        free = LOOM.length + eq.fed
        cable = replace(model.cable, length=free, mass=LOOM.mass * free / LOOM.length)
        held = replace(model, cable=cable, end="swivel")
        bent = 2.0 * np.sin(3 * held.chain.cells.mean(axis=1))
        own = np.concatenate([0 * bent, bent, bent / 2]) if space else bent
        same = solve_equilibrium(held, model.nominal, own, replace(pose, end_tension=None))
        errors.append(np.abs(eq.points[[0, -1]] - same.points[[0, -1]]).max())
        errors.append(np.abs(eq.end_force - same.end_force).max())
        errors.append(np.abs(eq.clips[0].force - same.clips[0].force).max())
    assert max(errors[::3]) < 1e-8
    assert max(errors[4:]) < 2e-3
    assert max(errors[4:]) < max(errors[1:3]) / 2.5


@pytest.mark.parametrize("space", [False, True])
def test_a_fed_cable_lies_on_a_table(space):
    """All that touches is outside, and the table and both fixtures carry the weight."""
    up = (0.0, 0.0, 1.0) if space else (0.0, 1.0)
    table = Plane(tuple(-0.05 * np.array(up)), up, "table")
    model, pose, _ = case(space, 0.45, 40)
    model, pose = replace(model, obstacles=(table,)), replace(pose, end=(*pose.end[:-1], 0.0))
    turn = {"end_orientation": turned(0.0, -0.2, 0.3)} if space else {"end_heading": 0.3}
    flat = {"start_orientation": turned(0.0, 0.4, 0.0)} if space else {"start_heading": -0.4}
    pose = replace(pose, **turn, **flat)
    eq = solved(model, pose)
    assert eq.stable
    assert eq.contacts
    assert eq.points[:, -1].min() > -0.05 + LOOM.diameter / 2 - 1e-6
    weight = 9.81 * LOOM.mass * (LOOM.length + eq.fed) / LOOM.length
    carried = sum(contact.force for contact in eq.contacts) + eq.start_force + eq.end_force
    assert carried[-1] == pytest.approx(-weight, rel=1e-6)


@pytest.mark.parametrize("space", [False, True])
@pytest.mark.parametrize("kinds", [("pinned",), ("clamped", "eyelet")])
def test_derivatives_between_clips(space, kinds):
    model, pose, rest = held_between(space, kinds, n=12)
    model = replace(model, effects=(MassError(), LengthError()))
    p = model.nominal.copy()
    p[model.names.index("length_error.length_difference")] = 0.01
    columns = [model.names.index(name) for name in ("bending_stiffness", "mass_error.factor")]
    assert_derivatives(model, pose, p, rest, columns)


@pytest.mark.parametrize("space", [False, True])
def test_a_free_length_that_is_given_needs_that_tension(space):
    """The shape is the same; its derivative by the length is that of other lengths."""
    model, pose, _ = case(space, 0.8)
    eq = solved(model, pose)
    told = replace(pose, end_tension=None, free_length=LOOM.length + eq.fed)
    by_length = replace(model, fed_by_length=True)
    same = solved(by_length, told)
    assert same.fed == pytest.approx(eq.fed, abs=1e-14)
    np.testing.assert_allclose(same.points, eq.points, atol=1e-12)
    np.testing.assert_allclose(same.end_force, eq.end_force, atol=1e-10)
    equilibria, rest = BatchEquilibrium(by_length, [told]), np.zeros(model.chain.n_rests)
    p, own = model.nominal, by_length.deviations.index("free_length")

    def fed(step):
        there, ok = equilibria.solve(moved(step), p, rest, tolerance=1e-13)
        assert ok.all()
        (seen,) = equilibria.seen(there, p, rest)
        return np.concatenate([seen.curve.numbers.ravel(), seen.readings])

    def moved(step):
        deviation = same.shapes.deviation.copy()
        deviation[0, by_length.deviation_names.index("free_length")] = 0.003 + step
        return replace(same.shapes, deviation=deviation)

    shapes, _ = equilibria.solve(moved(0.0), p, rest, tolerance=1e-13)
    along = equilibria.directions(shapes, p, rest, np.zeros((len(p), 0)), np.zeros((len(rest), 0)))
    ((_, change),) = equilibria.observe(shapes, p, rest, along)
    found = np.concatenate([change.curve[..., own].ravel(), change.readings[:, own]])
    h = 1e-5
    expected = (fed(-2 * h) - 8 * fed(-h) + 8 * fed(h) - fed(2 * h)) / (12 * h)
    np.testing.assert_allclose(found, expected, atol=1e-8 * np.abs(expected).max())


@pytest.mark.parametrize(("space", "side"), [(False, "end"), (True, "start")])
def test_the_shape_as_a_function_of_pose_and_tension(space, side):
    """The same equilibrium; first and second derivatives are those of other poses."""
    model, pose, _ = case(space, 0.8, 10)
    rest = np.zeros(model.chain.n_rests)
    if side == "start":
        model, pose, rest = reversed_case(model, pose, rest)
    eq = solve_equilibrium(model, model.nominal, rest, pose)
    function = CasadiCable(model, model.nominal, rest).function()
    at = pose.numbers
    points, end_force, _, energy, *_ = function(at)
    np.testing.assert_allclose(np.array(points).T, eq.points, atol=1e-12)
    np.testing.assert_allclose(np.array(end_force).ravel(), eq.end_force, atol=1e-10)
    assert float(energy) == pytest.approx(eq.energy, abs=1e-12)
    x = ca.MX.sym("x", len(at))
    points, _, _, energy, *_ = function(x)
    found = ca.vertcat(ca.vec(points), energy)
    first = ca.Function("first", [x], [found, ca.jacobian(found, x)])
    second, slope = ca.hessian(energy, x)
    second = ca.Function("second", [x], [slope, second])
    for k in (2 + space, len(at) - 1):  # the end's place x, and the tension
        step = 1e-4 * np.eye(len(at))[k]
        for exact in (first, second):
            far, near = (
                np.array(exact(at + h * step)[0]) - np.array(exact(at - h * step)[0])
                for h in (2, 1)
            )
            expected = (8 * near - far).ravel() / 12e-4
            derivative = np.array(exact(at)[1])[:, k]
            np.testing.assert_allclose(derivative, expected, atol=1e-8 * np.abs(expected).max())


@pytest.mark.parametrize(("space", "side"), [(False, "start"), (True, "end")])
def test_the_function_of_a_bent_cable_and_of_its_free_length(space, side):
    """By the tension and by the length; the rest curvature slides with the cable."""
    model, pose, rest = held_between(space, (), n=8)
    told = replace(pose, end_tension=None, free_length=0.72)
    for by_length, here in ((False, pose), (True, told)):
        own, at, bent = replace(model, fed_by_length=by_length), here, rest
        if side == "start":
            back, at, bent = reversed_case(model, here, rest)
            own = replace(back, fed_by_length=by_length)
            at = replace(at, free_length=here.free_length)
        eq = solve_equilibrium(own, own.nominal, bent, at)
        function, numbers = CasadiCable(own, own.nominal, bent).function(), at.numbers
        points, end_force, _, energy, *_ = function(numbers)
        np.testing.assert_allclose(np.array(points).T, eq.points, atol=1e-12)
        np.testing.assert_allclose(np.array(end_force).ravel(), eq.end_force, atol=1e-10)
        assert float(energy) == pytest.approx(eq.energy, abs=1e-12)
        u = ca.MX.sym("u", len(numbers))
        slope = ca.Function("slope", [u], [ca.gradient(function(u)[3], u)])(numbers)
        step = 1e-5 * np.eye(len(numbers))[-1]
        after, before = (float(function(numbers + h * step)[3]) for h in (1, -1))
        assert float(slope[-1]) == pytest.approx((after - before) / 2e-5, rel=1e-6)


def test_a_fed_cable_in_a_problem_of_ones_own():
    """The tension with which the middle is at a height: found again by solving."""
    model, pose, _ = case(False, 0.8, 10)
    rest, opti = np.zeros(model.chain.n_rests), ca.Opti()
    tension = opti.variable()
    opti.set_initial(tension, 1.2)
    numbers = ca.vertcat(ca.DM(pose.numbers[:-1]), tension)
    (shape,) = CasadiCable(model, model.nominal, rest).transcribe(opti, [numbers])
    eq = solved(model, pose)
    opti.subject_to(shape.points[1, 5] == eq.points[5, 1])
    opti.solver("ipopt", {"print_time": False, "ipopt.print_level": 0, "ipopt.sb": "yes"})
    assert float(opti.solve().value(tension)) == pytest.approx(0.8, abs=1e-7)


def test_what_a_sliding_end_has_not():
    model, pose, _ = case(False, 0.8)
    with pytest.raises(EquilibriumError, match="end_tension is missing"):
        solved(model, replace(pose, end_tension=None))
    with pytest.raises(EquilibriumError, match="free_length is missing"):
        solved(replace(model, fed_by_length=True), replace(pose, end_tension=None))
    by_length = replace(model, fed_by_length=True)
    for free, said in ((0.6, "the free length is 0.6000 m"), (60.0, "60 m, the cable is 1 m long")):
        with pytest.raises(EquilibriumError, match=said):
            solved(by_length, replace(pose, end_tension=None, free_length=free))
    with pytest.raises(EquilibriumError, match=r"end_tension -3 N.*\n.*more tension"):
        solved(model, replace(pose, end_tension=-3.0))
    with pytest.raises(DloError, match="through both ends"):
        replace(model, start="slide", fed_by_length=True)
    with pytest.raises(DloError, match="runs out or falls"):
        replace(model, start="slide", end="free")
    with pytest.raises(DloError, match="smooth element"):
        replace(model, element="link")


SESSION = """
cable: {length: 1.0, mass: 0.2, diameter: 0.01, bending_stiffness: 0.02, rest_shape: straight}
experiment:
  gravity: [0.0, -9.81]
  boundary: {start: clamped, end: slide}
  measurement: {kind: centerlines}
  poses:
    - {points: [[0, 0], [0.3, 0], [0.6, 0.2]], start: [0, 0], start_heading: 0.0,
       end: [0.6, 0.2], end_heading: 0.9, end_tension: 0.8}
"""


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("end: slide", "end: clamped", "a clamped end has no end_tension"),
        (", end_tension: 0.8", ", start_tension: 0.8", "a clamped start has no start_tension"),
        ("end_tension: 0.8", "end_tension: 0.8, free_length: 0.7", "without a tension there"),
        ("end_tension: 0.8", "end_tension: 0.8, start_tension: 1", "clamped start has no start_t"),
        ("start: clamped, end: slide", "start: slide, end: free", "runs out of it"),
        ("end_heading: 0.9, ", "", "a slide end needs an end_heading"),
        ("end_tension: 0.8", "at: [-0.1, 0.4, 0.7]", "at -0.1 m is not between 0 and"),
        ("end: slide", "end: slipping", "slide"),
    ],
)
def test_sessions_that_cannot_be(tmp_path, old, new, said):
    path = tmp_path / "session.yaml"
    path.write_text(SESSION)
    assert load_config(path).experiment.boundary.end.slides
    path.write_text(SESSION.replace("end: [0.6, 0.2]", "end: [1.6, 0.2]"))
    assert not load_config(path).skipped  # farther away than the cable is long
    path.write_text(SESSION.replace(old, new))
    with pytest.raises(ConfigError, match=said):
        load_config(path)


def marked_session(space, side, known, seed=0, count=5):
    """A session of markers on a cable fed through that end, and what was fed in each pose.

    Markers stand on what is between the ends in that pose, 12 % of it apart, give or take 9 %.
    """
    rng, d, poses, fed = np.random.default_rng(seed), 2 + space, [], []
    model, pose, _ = case(space, 0.8, 40)
    rest = np.zeros(model.chain.n_rests)
    while len(poses) < count:
        end = np.array(pose.end) * rng.uniform(0.9, 1.25) + rng.uniform(-0.05, 0.05, d)
        own = replace(pose, end=tuple(end), end_tension=float(rng.uniform(0.8, 2.0)))
        here = (model, own, rest) if side == "end" else reversed_case(model, own, rest)
        try:
            held = SolvedCable.of(here[0], here[0].nominal, here[2], here[1])
        except EquilibriumError:
            continue
        fed.append(held.equilibrium.fed)
        shares = 0.04 + 0.92 * (np.arange(8) + rng.uniform(0.1, 0.9, 8)) / 8
        low = 0.0 if side == "end" else -fed[-1]
        at = np.round(low + shares * (LOOM.length + fed[-1]), 4)
        places = (at - low) * LOOM.length / (LOOM.length + fed[-1])
        points = held.curve.at(places) + 3e-4 * rng.standard_normal((len(at), d))
        kept = {name: x for name, x in here[1].directions.items() if name != "turns"}
        kept |= {f"{side}_tension": own.end_tension} if known else {}
        role = "held_out" if len(poses) == 2 else "fit"
        one = dlo.Pose(here[1].start, here[1].end, points=points, at=at, role=role, **kept)
        poses.append(one)
    cable = dlo.Cable(
        length=1.0, mass=0.2, diameter=0.01, bending_stiffness=0.03, rest_shape="straight"
    )
    boundary = ("clamped", "slide") if side == "end" else ("slide", "clamped")
    held = {"gravity": model.gravity, "boundary": boundary, "std": 3e-4, "model": {"n": 20}}
    return dlo.Session(cable, poses, **held), fed


@pytest.mark.parametrize(("space", "side"), [(False, "end"), (True, "start")])
def test_markers_on_a_fed_cable(space, side):
    """They keep their places on the cable, whatever length of it is between its ends.

    In the plane tensions are known in one fit, in the other free lengths are unknowns; IPOPT finds
    the same minimum.
    """
    for known in (True, False)[space:]:
        session, fed = marked_session(space, side, known, count=4)
        ends = dict(zip(SIDES, ("clamped", "slide")[:: 1 if side == "end" else -1], strict=True))
        model = replace(case(space, 0.0, 12)[0], fed_by_length=not known, **ends)
        poses = [
            MeasuredPose.of_points(pose.held, np.array(pose.points), s=np.array(pose.at))
            for pose in session.experiment.poses
        ]
        if not known:
            poses = [item.fed_as_seen(1.0, model.loose) for item in poses]
        fit = fit_model(model, poses, Tolerances(), 3e-4)
        name = "bending_stiffness"
        assert abs(fit.value(name) - 0.02) < 3 * fit.std(name)
        ends = [seen.curve.knots[[0, -1]] for seen in fit.problem.observed(fit.point)]
        np.testing.assert_allclose(np.ptp(ends, axis=1) - 1.0, fed, atol=1e-3)
        if not space:
            solution, _ = solve_batch(fit.problem, fit.point)
            std = np.sqrt(np.diag(fit.covariance))
            np.testing.assert_array_less(np.abs(solution.theta - fit.point.theta), 0.05 * std)


@pytest.mark.long
@pytest.mark.parametrize("space", [False, True])
def test_intervals_of_cables_with_markers_that_are_fed(space):
    """Of ten sessions the true stiffness is outside its interval in one at most."""
    outside = []
    for seed in range(1, 11):
        session, _ = marked_session(space, SIDES[seed % 2], known=seed % 3 == 0, seed=seed)
        low, high = session.fit().params["bending_stiffness"].interval_95
        outside += [seed] * (not low < 0.02 < high)
    assert len(outside) < 2, outside


def test_a_session_of_markers_on_a_fed_cable_from_its_file_to_a_prediction(tmp_path):
    """YAML and CSV, `dlo fit`, report.json, and the free length that it tells in `dlo predict`."""
    session, fed = marked_session(False, "start", known=False, count=4)
    poses = []
    for k, pose in enumerate(session.experiment.poses):
        write_points(tmp_path / f"p{k}.csv", pose.points, pose.at)
        held = {name: list(np.atleast_1d(x)) for name, x in pose.held.directions.items()}
        held = {name: float(x[0]) for name, x in held.items()}
        held |= {"start": list(pose.start), "end": list(pose.end), "role": str(pose.role)}
        poses.append({"file": f"p{k}.csv", **held})
    assert min(pose.at[0] for pose in session.experiment.poses) > 0.1
    document = {
        "cable": {"length": 1.0, "mass": 0.2, "diameter": 0.01, "bending_stiffness": 0.03},
        "experiment": {
            "gravity": [0.0, -9.81],
            "boundary": {"start": "slide", "end": "clamped"},
            "measurement": {"kind": "centerlines", "std": 3e-4},
            "poses": poses,
        },
        "model": {"n": 12},
        "estimation": {"algorithm1": False},
        "diagnosis": {"enabled": False},
    }
    document["cable"]["rest_shape"] = "straight"
    path, results = tmp_path / "fed.yaml", tmp_path / "results"
    path.write_text(dump_yaml(document))
    assert main(["fit", str(path), "--output", str(results), "--jobs", "1"]) == 0
    report = json.loads((results / "report.json").read_text())
    low, high = report["stages"][-1]["parameters"]["bending_stiffness"]["interval_95"]
    assert low < 0.02 < high
    assert report["stages"][-1]["rmse_held_out"] < 2e-3
    cable, pose = dlo.load(results / "parameters.yaml"), session.experiment.poses[0]
    held = pose.held.directions
    shape = cable.solve(pose.end, start=pose.start, **held, free_length=1.0 + fed[0])
    s = np.array(pose.at) + fed[0]  # from where the cable comes out of the guide
    np.testing.assert_allclose(shape.curve.at(s), pose.points, atol=3e-3)


@pytest.mark.parametrize(("space", "side"), [(False, "end"), (True, "start"), (False, "start")])
@pytest.mark.parametrize("by_length", [False, True])
def test_derivatives_of_markers(space, side, by_length):
    """Residuals along parameters and each pose's free length, beside those of other equilibria."""
    model, pose, rest = held_between(space, ("pinned",), n=12)
    if side == "start":
        model, pose, rest = reversed_case(model, pose, rest)
    eq = solve_equilibrium(model, model.nominal, rest, pose)
    if by_length:
        told = {f"{side}_tension": None, "free_length": LOOM.length + eq.fed}
        model, pose = replace(model, fed_by_length=True), replace(pose, **told)
        eq = solve_equilibrium(model, model.nominal, rest, pose)
    equilibria, p = BatchEquilibrium(model, [pose]), model.nominal
    low, high = (-eq.fed, 1.0) if side == "start" else (0.0, 1.0 + eq.fed)
    s = low + (high - low) * np.array([0.1, 0.35, 0.62, 0.95])
    markers, n_own = Markers(np.zeros((4, 2 + space)), np.ones(4), s), len(model.deviations)
    slopes = np.zeros((len(p), 1))
    slopes[model.names.index("bending_stiffness")] = 1.0
    shapes, _ = equilibria.solve(eq.shapes, p, rest, tolerance=1e-13)

    def moved(k, step):
        deviation = shapes.deviation.copy()
        if k:
            deviation[0, equilibria.used_deviations[k - 1]] += step
        there = replace(shapes, deviation=deviation)
        own = p + (step * slopes[:, 0] if k == 0 else 0.0)
        there, ok = equilibria.solve(there, own, rest, tolerance=1e-13)
        assert ok.all()
        (seen,) = equilibria.seen(there, own, rest)
        return markers.residual(seen, markers.located(seen, s))

    along = equilibria.directions(shapes, p, rest, slopes, np.zeros((len(rest), 1)))
    ((seen, change),) = equilibria.observe(shapes, p, rest, along)
    places = markers.located(seen, s)
    np.testing.assert_allclose(places, model.cable.length * (s - low) / (high - low), atol=1e-12)
    _, found = markers.linearized(seen, places, change)
    h = 2e-5
    for k in range(1 + n_own):
        rows = [moved(k, step * h) for step in (-2, -1, 1, 2)]
        expected = (rows[0] - 8 * rows[1] + 8 * rows[2] - rows[3]) / (12 * h)
        scale = np.abs(expected).max()
        np.testing.assert_allclose(found[:, k], expected, atol=2e-8 * scale + 1e-12)
