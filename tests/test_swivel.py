"""Ends that hold the place and the direction of a cable, but not its roll."""

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from scipy.optimize import minimize_scalar
from scipy.spatial.transform import Rotation

import dlo_casadi as dlo
from dlo_casadi.effects import CableData, ClampRotation
from dlo_casadi.equilibrium.pose import HeldPose
from dlo_casadi.equilibrium.solve import solve_equilibrium
from dlo_casadi.equilibrium.spread import SolvedCable
from dlo_casadi.equilibrium.symbolic import CasadiCable
from dlo_casadi.model.cable_model import CableModel
from dlo_casadi.model.whole_pose import potential

LOOM = CableData(1.0, 0.2, 0.01, bending_stiffness=0.02, torsional_stiffness=0.015)
FLAT = replace(LOOM, torsional_stiffness=None)
DOWN = (0.0, 0.0, -9.81)
END_TURNS = ["end_rotation_y", "end_rotation_z"]


def turned(*vector):
    return tuple(Rotation.from_rotvec(vector).as_quat())


POSE = HeldPose(
    (0.0, 0.0, 0.0),
    (0.6, 0.2, 0.1),
    start_orientation=turned(0.4, 0.2, 0.3),
    end_orientation=turned(0.5, -0.4, 0.1),
)


def solved(start, end, bent=1.0, n=16, pose=POSE):
    """A cable whose rest curvature about y is `bent`."""
    model = CableModel(LOOM, n=n, n_rest=0, gravity=DOWN, start=start, end=end)
    rest = np.repeat([0.0, bent, 0.0], model.chain.n_cells)
    return model, rest, solve_equilibrium(model, model.nominal, rest, pose)


def rolled(side, angle):
    name = f"{side}_orientation"
    own = Rotation.from_quat(getattr(POSE, name)) * Rotation.from_rotvec([angle, 0.0, 0.0])
    return replace(POSE, **{name: tuple(own.as_quat())})


@pytest.mark.parametrize("side", ["start", "end"])
def test_the_roll_of_a_swivel_is_that_of_least_energy(side):
    """No other roll of a clamp there has less; at it there is no moment about the axis."""
    kinds = {"start": "clamped", "end": "clamped", side: "swivel"}
    _, _, eq = solved(**kinds)
    k = ("start", "end").index(side)
    axis = Rotation.from_quat(getattr(POSE, f"{side}_orientation")).apply([1.0, 0.0, 0.0])
    assert Rotation.from_quat(eq.x[-k]).apply([1.0, 0.0, 0.0]) == pytest.approx(axis, abs=1e-10)
    assert eq.moments[k] @ axis == pytest.approx(0.0, abs=1e-10)
    assert np.linalg.norm(eq.moments[k]) > 0.01

    def energy(angle):
        return solved("clamped", "clamped", pose=rolled(side, angle))[2].energy

    angles = np.linspace(-np.pi, np.pi, 9)
    middle = angles[np.argmin([energy(angle) for angle in angles])]
    least = minimize_scalar(energy, bounds=(middle - 0.8, middle + 0.8), method="bounded")
    assert eq.energy == pytest.approx(least.fun, abs=1e-8)
    assert eq.energy < energy(0.0) - 1e-5


def test_between_swivels_whose_axes_share_a_plane_the_cable_stays_in_it():
    """Whatever the rolls of the frames: two swivels twist nothing."""
    plane = CableModel(FLAT, n=32, n_rest=0, start="clamped", end="clamped")
    held = HeldPose((0.0, 0.0), (0.6, 0.2), start_heading=-0.6, end_heading=1.1)
    flat = solve_equilibrium(plane, plane.nominal, np.zeros(32), held)
    model = CableModel(LOOM, n=32, n_rest=0, gravity=(0, -9.81, 0), start="swivel", end="swivel")
    ways = [Rotation.from_rotvec([0.0, 0.0, angle]) for angle in (-0.6, 1.1)]
    rolls = [Rotation.from_rotvec([angle, 0.0, 0.0]) for angle in (2.0, -1.0)]
    first, last = (tuple((way * roll).as_quat()) for way, roll in zip(ways, rolls, strict=True))
    pose = HeldPose((0.0,) * 3, (0.6, 0.2, 0.0), start_orientation=first, end_orientation=last)
    eq = solve_equilibrium(model, model.nominal, np.zeros(model.chain.n_rests), pose)
    assert eq.points[:, 2] == pytest.approx(np.zeros(33), abs=1e-9)
    assert np.abs(eq.twist).max() < 1e-9
    # Elements of both kinds are of fourth order, and not the same.
    assert eq.points[:, :2] == pytest.approx(flat.points, abs=3e-6)
    assert eq.end_force[:2] == pytest.approx(flat.end_force, abs=2e-4)
    assert eq.moments[:, 2] == pytest.approx(flat.moments, abs=2e-5)


def test_in_a_plane_it_is_a_clamp():
    model = CableModel(FLAT, n=16, n_rest=0, start="swivel", end="clamped")
    pose = HeldPose((0.0, 0.0), (0.6, 0.2), start_heading=0.9, end_heading=-0.5)
    eq = solve_equilibrium(model, model.nominal, np.zeros(16), pose)
    clamped = replace(model, start="clamped")
    same = solve_equilibrium(clamped, model.nominal, np.zeros(16), pose)
    assert eq.energy == same.energy
    assert np.array_equal(eq.moments, same.moments)


def test_ipopts_statement_has_the_same_energy_and_conditions():
    model, rest, eq = solved("clamped", "swivel")
    problem, shapes = potential(model), eq.shapes
    assert [x for x in model.condition_names if "rotation" in x][3:] == END_TURNS
    inputs = np.concatenate([model.nominal, rest, POSE.vector, shapes.deviation[0]])
    given, count = (problem.coordinates, problem.parameters), eq.x.size
    lagrangian = problem.energy + problem.conditions.T @ ca.SX(ca.DM(eq.multipliers))
    bend, slope = ca.hessian(lagrangian, problem.coordinates)
    of = ca.Function("of", given, [problem.energy, problem.conditions, bend, slope])
    x = np.zeros(problem.coordinates.numel())
    x[:count] = eq.x.ravel()
    *_, bend, slope = (np.array(out) for out in of(x, inputs))
    # The energy is quadratic in the unknowns inside segments: one Newton step.
    x[count:] = -np.linalg.solve(bend[count:, count:], slope[count:]).ravel()
    energy, conditions, *_ = of(x, inputs)
    assert float(energy) == pytest.approx(eq.energy, abs=1e-9)
    assert np.abs(np.array(conditions)).max() < 1e-9


def test_derivatives_by_the_pose_and_by_errors_of_its_direction():
    effects = (ClampRotation(start=False),)
    held = {"start": "clamped", "end": "swivel", "gravity": DOWN, "effects": effects}
    model = CableModel(LOOM, n=8, n_rest=0, **held)
    rest = np.repeat([0.0, 1.0, 0.0], model.chain.n_cells)
    p = model.nominal + np.array([0.0] * (len(model.names) - 2) + [0.02, -0.03])
    of = CasadiCable(model, p, rest).function(parameters=["clamp_rotation.end_y"])
    pose, number, step = POSE.numbers, np.array([0.02]), 1e-5
    exact = of.jacobian()(pose, number, *of(pose, number))
    columns = {k: np.eye(len(pose))[k] for k in (3, 5, 11, 12, 13, 14)}
    for output in ("points", "end_force", "end_moment"):
        i = of.name_out().index(output)
        for k, unit in columns.items():
            ends = [np.array(of(pose + h * unit, number)[i]) for h in (step, -step)]
            change = (ends[0] - ends[1]).ravel(order="F") / (2 * step)
            assert np.array(exact[2 * i])[:, k] == pytest.approx(change, abs=1e-6), (output, k)
        ends = [np.array(of(pose, number + h)[i]) for h in (step, -step)]
        change = (ends[0] - ends[1]).ravel(order="F") / (2 * step)
        assert np.array(exact[2 * i + 1])[:, 0] == pytest.approx(change, abs=1e-6), output


def test_a_straight_cable_between_swivels_needs_no_rest_curvature_declared():
    """Fitted with a rest curvature, it took 14 times as long and ended at an unstable pose."""
    rng, poses, at = np.random.default_rng(1), [], np.linspace(0.0, 1.0, 12)
    model = CableModel(LOOM, n=20, n_rest=0, gravity=DOWN, start="swivel", end="swivel")
    rest = np.zeros(model.chain.n_rests)
    for _ in range(5):
        end = tuple(np.array([0.75, 0.0, 0.0]) + rng.uniform(-0.1, 0.1, 3))
        frames = [turned(*rng.uniform(-0.3, 0.3, 3)) for _ in range(2)]
        held = dict(zip(("start_orientation", "end_orientation"), frames, strict=True))
        own = SolvedCable.of(model, model.nominal, rest, HeldPose((0.0,) * 3, end, **held))
        points = own.curve.at(at) + 3e-4 * rng.standard_normal((len(at), 3))
        poses.append(dlo.Pose((0.0,) * 3, end, points=points, at=at, **held))
    cable = dlo.Cable(length=1.0, mass=0.2, diameter=0.01, bending_stiffness=0.03)
    quick = {"diagnosis": {"enabled": False}, "estimation": {"algorithm1": False}}
    session = dlo.Session(
        cable, poses, gravity=DOWN, boundary=("swivel", "swivel"), std=3e-4, **quick
    )
    result = session.fit()
    assert not result.doubts
    assert any("taken as straight at rest" in text for text in result.warnings)
    low, high = result.params["bending_stiffness"].interval_95
    assert low < 0.02 < high
    assert high - low < 0.002


@pytest.mark.long
@pytest.mark.parametrize("boundary", [("clamped", "swivel"), ("swivel", "swivel")])
def test_a_session_with_swivels(boundary):
    """Simulated on a fine mesh, 0.3 mm of noise; predictions ignore the declared rolls."""
    model = CableModel(LOOM, n=60, n_rest=4, gravity=DOWN, start=boundary[0], end=boundary[1])
    rng = np.random.default_rng(0)
    rest, poses = model.rest_basis @ rng.uniform(-1, 1, model.n_coefficients), []
    for k in range(6):
        way = rng.standard_normal(3)
        end = tuple(rng.uniform(0.55, 0.85) * way / np.linalg.norm(way))
        along, _ = Rotation.align_vectors([end], [[1.0, 0.0, 0.0]])
        turns = rng.uniform(-0.5, 0.5, (2, 3)) * [4.0, 1.0, 1.0]
        frames = [tuple((along * Rotation.from_rotvec(turn)).as_quat()) for turn in turns]
        held = dict(zip(("start_orientation", "end_orientation"), frames, strict=True))
        own = SolvedCable.of(model, model.nominal, rest, HeldPose((0.0,) * 3, end, **held))
        at = np.linspace(0.05, 0.95, 14)
        points = own.curve.at(at) + 3e-4 * rng.standard_normal((len(at), 3))
        role = "held_out" if k == 3 else "fit"
        poses.append(dlo.Pose((0.0,) * 3, end, points=points, at=at, role=role, **held))
    cable = dlo.Cable(length=1.0, mass=0.2, diameter=0.01, bending_stiffness=0.03)
    result = dlo.Session(cable, poses, gravity=DOWN, boundary=boundary, std=3e-4).fit()
    assert result.verdict == "complete"
    low, high = result.params["bending_stiffness"].interval_95
    assert low < 0.02 < high
    assert "end_roll" not in result.params
    assert result.stages[-1].rmse_held_out < 1.5e-3
