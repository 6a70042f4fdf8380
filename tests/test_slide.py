"""A cable that is fed through its end: the direction is held, the free length follows."""

from dataclasses import replace

import numpy as np
import pytest
from perturbed import assert_derivatives
from scipy.spatial.transform import Rotation

import dlo_casadi as dlo
from dlo_casadi.codegen import generate
from dlo_casadi.config import load_config
from dlo_casadi.effects import CableData, LengthError, MassError, PointForce
from dlo_casadi.equilibrium.by_ipopt import by_ipopt
from dlo_casadi.equilibrium.pose import HeldPose
from dlo_casadi.equilibrium.solve import solve_equilibrium
from dlo_casadi.equilibrium.spread import SolvedCable
from dlo_casadi.errors import ConfigError, DloError, EquilibriumError
from dlo_casadi.export.rod import Rod
from dlo_casadi.model.cable_model import CableModel

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


@pytest.mark.parametrize("space", [False, True])
def test_a_session_whose_free_lengths_differ(space):
    """Lines of 0.3 mm noise; lengths between the ends differ by a third from pose to pose."""
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
        one = dlo.Pose(own.start, own.end, points=points, role=role, end_tension=tension, **kept)
        poses.append(one)
    assert np.ptp(fed) > 0.05
    cable = dlo.Cable(
        length=1.0, mass=0.2, diameter=0.01, bending_stiffness=0.03, rest_shape="straight"
    )
    session = dlo.Session(
        cable, poses, gravity=model.gravity, boundary=("clamped", "slide"), std=3e-4
    )
    result = session.fit()
    assert result.verdict == "complete"
    low, high = result.params["bending_stiffness"].interval_95
    assert low < 0.02 < high
    assert result.stages[-1].rmse_held_out < 1e-3
    shape = result.cable.solve(poses[0])
    assert shape.free_length == pytest.approx(1.0 + fed[0], abs=2e-3)
    assert shape.s[-1] == shape.free_length
    steps = np.linalg.norm(np.diff(shape.points, axis=0), axis=1)
    assert steps.sum() == pytest.approx(shape.free_length, rel=1e-3)


def test_what_a_sliding_end_has_not_yet():
    model, pose, _ = case(False, 0.8)
    with pytest.raises(EquilibriumError, match="end_tension None"):
        solved(model, replace(pose, end_tension=None))
    with pytest.raises(DloError, match="no clips, obstacles or links"):
        replace(model, clips=("pinned",))
    rest = np.zeros(model.chain.n_rests)
    with pytest.raises(DloError, match="slides through its end yet"):
        generate(model, model.nominal, rest, "wire")
    with pytest.raises(DloError, match="cannot be exported yet"):
        Rod.of(SolvedCable.of(model, model.nominal, rest, pose))


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
        (", end_tension: 0.8", "", "a slide end has an end_tension"),
        ("end_heading: 0.9, ", "", "a slide end needs an end_heading"),
        ("end_tension: 0.8", "at: [0.1, 0.4, 0.7]", "slides through its end has no at"),
        (", rest_shape: straight", "", "rest_shape: straight"),
        ("end: slide", "end: slipping", "slide"),
    ],
)
def test_sessions_that_cannot_be(tmp_path, old, new, said):
    path = tmp_path / "session.yaml"
    path.write_text(SESSION)
    assert load_config(path).experiment.boundary.end.slides
    path.write_text(SESSION.replace(old, new))
    with pytest.raises(ConfigError, match=said):
        load_config(path)
