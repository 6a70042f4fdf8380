"""Contact with obstacles against closed forms, balance of forces, and differences."""

from dataclasses import replace

import numpy as np
import pytest
from cables.ipopt import Ipopt

from dlo_casadi.cable.held import among
from dlo_casadi.config import load_config
from dlo_casadi.diagnosis.candidates import candidates_of
from dlo_casadi.diagnosis.refits import scored_by_refit
from dlo_casadi.effects import CableData, ContactPlane, ObstacleOffset
from dlo_casadi.equilibrium.batch import SOFT_DEPTH, BatchEquilibrium
from dlo_casadi.equilibrium.by_ipopt import by_ipopt
from dlo_casadi.equilibrium.pose import HeldPose
from dlo_casadi.equilibrium.sides import beside_bars
from dlo_casadi.equilibrium.solve import solve_equilibrium
from dlo_casadi.errors import ConfigError, EquilibriumError
from dlo_casadi.estimation.fit import fit_model
from dlo_casadi.estimation.prediction import predict_poses
from dlo_casadi.estimation.start import begin
from dlo_casadi.model.assembly import Assembly, Inputs
from dlo_casadi.model.cable_model import CableModel
from dlo_casadi.model.contact import forces_on_other_mesh
from dlo_casadi.model.tolerances import Tolerances
from dlo_casadi.rod.obstacles import Capsule, Plane
from dlo_casadi.sensing.measured_pose import MeasuredPose
from dlo_casadi.sensing.noise import NoiseModel

LENGTH, WEIGHT, EI, RADIUS = 1.0, 1.0, 0.02, 0.003  # m, N, N m^2, m
CABLE = CableData(LENGTH, WEIGHT / 9.81, 2 * RADIUS, EI)
LOOM = replace(CABLE, torsional_stiffness=0.015)
TABLE = Plane((0.0, -0.15), (0.0, 1.0), "table")
BARS = {"left": (0.12, -0.22), "right": (0.4, -0.3)}
IN_SPACE = (
    Plane((0.0, 0.0, -0.2), (0.1, 0.0, 0.995), "ramp"),
    Capsule((0.21, -0.3, -0.19), (0.25, 0.3, -0.17), 0.03, "bar"),
)
HELD_IN_SPACE = HeldPose(
    (0.0, 0.0, 0.0), (0.7, 0.1, 0.0), start_orientation=(0, 0, 0, 1.0), end_orientation=(0, 0, 0, 1)
)


def solved(cable, pose, *obstacles, n=20, x_init=None, **held):
    down = (0.0,) * (len(pose.start) - 1) + (-9.81,)
    model = CableModel(cable, n, n_rest=0, gravity=down, obstacles=obstacles, **held)
    rest = np.zeros(model.chain.n_rests)
    return model, solve_equilibrium(model, model.nominal, rest, pose, x_init=x_init)


@pytest.fixture(scope="module")
def loom():
    """A cable in space that hangs over a bar and lies on a ramp."""
    return solved(LOOM, HELD_IN_SPACE, *IN_SPACE, start="clamped", end="clamped")


def test_what_touches_is_that_of_the_shapes_as_they_are(loom):
    """Also for some of the poses; a batch sees when its shapes have been changed in place."""
    model, found = loom
    shapes = found.shapes.subset([0, 0, 0])
    poses = np.tile(HELD_IN_SPACE.vector, (3, 1))
    given = Inputs.of(model.nominal, np.zeros(model.chain.n_rests), poses)
    shapes.lam[:, :3] += [[0.0], [0.3], [0.6]]  # which turn the normals of the bar
    batch = BatchEquilibrium(model, [HELD_IN_SPACE] * 3)
    inputs = shapes, model.nominal, np.zeros(model.chain.n_rests)
    all_poses = batch.at(*inputs).touching
    two = batch.at(*inputs).subset([2, 0]).touching
    np.testing.assert_array_equal(two.normal, all_poses.normal[[2, 0]])
    assert not np.array_equal(*two.normal)
    assert batch.at(*inputs).subset(np.zeros(0, dtype=int)).touching.gap.shape[0] == 0
    shapes.lam[0, 0] += 0.3
    again = batch.at(*inputs).touching
    fresh = Assembly(model, shapes, given, SOFT_DEPTH).touching
    for name in ("border", "gap", "normal", "active"):
        np.testing.assert_array_equal(getattr(again, name), getattr(fresh, name))


def test_a_heavy_beam_laid_on_a_table_lifts_off_where_beam_theory_says():
    """EI w'''' = -q, w = w' = w'' = 0 at lift-off: H = q l^4 / (72 EI), held by 2/3 q l."""
    height = 0.004  # slopes of 1 %
    lift = (72 * EI * height / WEIGHT) ** 0.25
    table = Plane((0.0, -height - RADIUS), (0.0, 1.0), "table")
    # It lifts off half-way between two nodes.
    model = CableModel(CABLE, 38, start="clamped", end="free", n_rest=0, obstacles=(table,))
    assert abs(38 * lift % 1 - 0.5) < 0.05
    pose = HeldPose((0.0, 0.0), start_heading=0.0)
    found = solve_equilibrium(model, model.nominal, np.zeros(model.chain.n_rests), pose)
    (contact,) = found.contacts
    assert contact.obstacle == "table"
    assert contact.start == pytest.approx(lift, rel=3e-3)
    assert contact.end == pytest.approx(LENGTH, rel=3e-3)
    assert -found.start_force[1] == pytest.approx(2 / 3 * WEIGHT * lift, rel=1e-3)
    assert contact.force + found.start_force == pytest.approx([0.0, -WEIGHT], abs=1e-9)


def test_a_cable_touches_down_and_lifts_off_alike():
    """Between pins at one height; both contact points lie between nodes."""
    soft = replace(CABLE, bending_stiffness=1e-3)
    _, found = solved(soft, HeldPose((0.0, 0.0), (0.88, 0.0)), TABLE, n=36)
    (contact,) = found.contacts
    assert contact.end - contact.start > 0.2 * LENGTH
    assert contact.start + contact.end == pytest.approx(LENGTH, abs=1e-6)
    assert abs(36 * contact.start / LENGTH % 1 - 0.5) < 0.45


def test_tension_over_a_cylinder_follows_from_the_height():
    """T + M^2 / (2 EI) - w y is the same everywhere, without friction on the cylinder, too."""
    radius, pose = 0.1, HeldPose((-0.2, -0.25), (0.22, -0.15))
    cylinder = Capsule((0.0, 0.0), (0.0, 0.0), radius, "cylinder")
    over = np.linspace(0.23 + 2.03, 0.23 - 2.03, 81)[:, None]  # an arc between the ends
    soft = replace(CABLE, bending_stiffness=2e-3)
    _, found = solved(soft, pose, cylinder, n=80, x_init=over)
    ahead = np.concatenate([np.cos(found.x), np.sin(found.x)], axis=1)
    ends = found.end_force @ ahead[-1], -found.start_force @ ahead[0]
    from_center = np.linalg.norm(found.points, axis=1)
    assert from_center.min() == pytest.approx(radius + RADIUS, abs=1e-6)
    (contact,) = found.contacts
    on_all = contact.force + found.start_force + found.end_force
    assert on_all == pytest.approx([0.0, -WEIGHT], abs=1e-9)
    across = 1e-3 * np.linalg.norm(contact.force)
    assert ends[0] - ends[1] == pytest.approx(-WEIGHT / LENGTH * 0.1, abs=across)


def test_forces_balance_and_no_node_is_inside(loom):
    model, found = loom
    assert found.stable
    assert {contact.obstacle for contact in found.contacts} == {"ramp", "bar"}
    on_all = sum(c.force for c in found.contacts) + found.start_force + found.end_force
    assert on_all == pytest.approx([0.0, 0.0, -WEIGHT], abs=1e-6)
    for obstacle in IN_SPACE:
        assert obstacle.near(found.points[1:-1]).distance.min() > RADIUS - 1e-6 * LENGTH
    for contact in found.contacts:  # along the surface's normal, into the obstacle
        obstacle = next(one for one in IN_SPACE if one.name == contact.obstacle)
        place = found.points[round((contact.start + contact.end) / 2 / model.chain.h)]
        assert contact.force @ obstacle.near(place).normal < 0


def test_the_tangent_is_the_derivative_of_the_balance(loom):
    model, found = loom
    shapes = found.shapes
    given = Inputs.of(model.nominal, np.zeros(model.chain.n_rests), HELD_IN_SPACE.vector[None])
    dense = Assembly(model, shapes, given).balance()[2].dense()[0]
    nodes, step = 3 * model.chain.n_nodes, 1e-6
    touching = nodes + model.n_lam + np.flatnonzero(found.multipliers[model.n_lam :] > 0)
    for column in (3 * 3 + 1, 3 * 8 + 2, nodes + 1, touching[0], touching[-1]):
        rows = []
        for h in (step, -step):
            delta = h * np.eye(len(dense))[column]
            x = model.node.moved(shapes.x, delta[:nodes].reshape((*shapes.x.shape[:2], 3)))
            moved = replace(shapes, x=x, lam=shapes.lam + delta[nodes:])
            rows.append(Assembly(model, moved, given).imbalance().rows[0, :, 0])
        assert dense[:, column] == pytest.approx((rows[0] - rows[1]) / (2 * step), abs=2e-4)


def test_derivatives_of_a_shape_that_touches():
    """By EI, the roll of the end and the ramp's place, beside equilibria on either side."""
    own = {"start": "clamped", "end": "clamped", "effects": (ObstacleOffset(),)}
    model, found = solved(LOOM, HELD_IN_SPACE, IN_SPACE[0], **own)
    assert found.contacts
    p, rest, q = model.nominal, np.zeros(model.chain.n_rests), len(model.names)
    equilibria = BatchEquilibrium(model, [HELD_IN_SPACE])
    along = equilibria.directions(found.shapes, p, rest, np.eye(q), np.zeros((len(rest), q)))
    ((_, change),) = equilibria.observe(found.shapes, p, rest, along)
    for k, step in ((0, 1e-5), (2, 1e-4), (3, 1e-5)):
        ends = []
        for h in (step, -step):
            there, _ = equilibria.solve(found.shapes, p + h * np.eye(q)[k], rest)
            ends.append(equilibria.seen(there, p + h * np.eye(q)[k], rest)[0])
        by = (ends[0].curve.numbers - ends[1].curve.numbers) / (2 * step)
        assert change.curve[..., k] == pytest.approx(by, abs=2e-3 * np.abs(by).max())
        read = (ends[0].readings - ends[1].readings) / (2 * step)
        assert change.readings[:, k] == pytest.approx(read, abs=5e-3 * np.abs(read).max())


def test_an_obstacle_that_is_elsewhere():
    """An offset is the same as an obstacle declared there; of a bar it is a larger radius."""
    ramp, bar = IN_SPACE
    size = np.linalg.norm(ramp.normal)
    ramp = replace(ramp, normal=tuple(ramp.normal / size))
    up = tuple(x + 0.01 * n for x, n in zip(ramp.point, ramp.normal, strict=True))
    there = replace(ramp, point=up), replace(bar, radius=bar.radius - 0.004)
    held = {"start": "clamped", "end": "clamped"}
    _, same = solved(LOOM, HELD_IN_SPACE, *there, **held)
    effects = (ObstacleOffset(), ObstacleOffset(obstacle=1))
    model = CableModel(
        LOOM, 20, n_rest=0, gravity=(0, 0, -9.81), obstacles=(ramp, bar), effects=effects, **held
    )
    assert model.names[-2:] == ("obstacle_offset.offset", "obstacle_offset_2.offset")
    p = model.nominal + np.array([0, 0, 0, 0.01, -0.004])
    found = solve_equilibrium(model, p, np.zeros(model.chain.n_rests), HELD_IN_SPACE)
    assert found.energy == pytest.approx(same.energy, rel=1e-9)
    assert found.points == pytest.approx(same.points, abs=1e-8)
    too_high = replace(HELD_IN_SPACE, end=(0.7, 0.1, -0.268))
    with pytest.raises(EquilibriumError, match=r"end .* is 0\.00\d\d m inside ramp"):
        solve_equilibrium(model, p, np.zeros(model.chain.n_rests), too_high)


def test_an_offset_of_the_session_does_not_move_other_obstacles():
    """A fitted cable among obstacles that are handed over: they are where they are declared."""
    moved = CableModel(LOOM, 20, n_rest=0, gravity=(0, 0, -9.81), effects=(ObstacleOffset(),))
    p = moved.nominal + np.eye(len(moved.names))[-1] * 0.01
    found = among(moved, p, [{"kind": "plane", "point": [0, 0, -0.2], "normal": [0, 0, 1]}])
    plain = CableModel(LOOM, 20, n_rest=0, gravity=(0, 0, -9.81), obstacles=found["model"].surfaces)
    rest, pose = np.zeros(plain.chain.n_rests), HeldPose((0.0, 0.0, 0.0), (0.7, 0.1, 0.0))
    one = solve_equilibrium(found["model"], found["p"], rest, pose)
    other = solve_equilibrium(plain, plain.nominal, rest, pose)
    assert one.contacts
    assert one.energy == pytest.approx(other.energy, rel=1e-12)
    assert found["p"][:-1] == pytest.approx(p[:-1], abs=0.0)


def test_a_fit_finds_where_the_table_is():
    """From shapes without noise; the table is 3 mm higher than declared, EI larger by half."""
    table = Plane((0.0, -0.12), (0.0, 1.0), "table")
    held = {"start": "clamped", "end": "clamped", "n_rest": 0}
    cable = replace(CABLE, bending_stiffness=2e-3)
    model = CableModel(cable, 20, obstacles=(table,), effects=(ObstacleOffset(),), **held)
    poses = [HeldPose((0.0, 0.0), (x, 0.02), -1.0, 1.1) for x in (0.45, 0.55, 0.65)]
    true = model.nominal * [1.5, 1.0] + [0.0, 0.003]
    places = np.linspace(0.02, 0.98, 40)
    shown = predict_poses(model, true, np.zeros(model.chain.n_rests), poses)
    assert all(one.equilibrium.contacts for one in shown)
    measured = [
        MeasuredPose.of_points(pose, one.curve.at(places))
        for pose, one in zip(poses, shown, strict=True)
    ]
    fit = fit_model(model, measured, Tolerances(), 1e-4)
    # A point force of half the weight sinks in by 5e-5 lengths in a fit.
    assert fit.p == pytest.approx(true, rel=2e-3, abs=5e-5)
    # The relaxed start, from a stiffness more than three times too large.
    stiff = fit.problem.unknowns.pack(model.nominal * [5.0, 1.0], np.zeros(0))
    loose = replace(fit.problem, noise=NoiseModel(1e-3, source="declared"), weights=())
    problem, begun = begin(loose, stiff)
    assert problem.unknowns.p(begun.theta) == pytest.approx(true, rel=0.02, abs=1e-4)


def test_a_plane_that_is_not_declared():
    """The effect is a level plane; it is told by the height that shapes have in common."""
    cable = replace(CABLE, bending_stiffness=2e-3)
    held = {"start": "clamped", "end": "clamped"}
    plane = ContactPlane(level=0.05)
    model = CableModel(cable, 20, n_rest=0, effects=(plane,), **held)
    low, high = (np.array([2e-3, x]) for x in (-1.9, -0.17))
    poses = [HeldPose((0.0, 0.05), (x, 0.02), -1.0, 1.1) for x in (0.45, 0.55, 0.65)]
    places, rng = np.linspace(0.02, 0.98, 40), np.random.default_rng(0)
    fits = []
    for p in (high, low):
        shown = predict_poses(model, p, np.zeros(model.chain.n_rests), poses)
        assert any(one.equilibrium.contacts for one in shown) is (p is high)
        seen = [one.curve.at(places) for one in shown]
        points = [one + rng.normal(scale=3e-4, size=one.shape) for one in seen]
        measured = [MeasuredPose.of_points(*pair) for pair in zip(poses, points, strict=True)]
        fits.append(fit_model(model.without_effect("contact_plane"), measured, Tolerances(), 3e-4))
    table = Plane((0.0, -0.12), (0.0, 1.0), "table")
    _, same = solved(cable, poses[0], table, **held)
    found = solve_equilibrium(model, high, np.zeros(model.chain.n_rests), poses[0])
    assert found.energy == pytest.approx(same.energy, rel=1e-9)
    _, free = solved(cable, poses[0], **held)
    hanging = solve_equilibrium(model, low, np.zeros(model.chain.n_rests), poses[0])
    assert hanging.energy == pytest.approx(free.energy, rel=1e-9)
    touched, clean = (candidates_of(fit, None, ()) for fit in fits)
    assert "contact_plane" not in [item.name for item in clean]
    (candidate,) = (item for item in touched if item.name == "contact_plane")
    assert candidate.effect == plane
    scored = scored_by_refit(fits[0], candidate, np.inf, from_shapes=True)
    assert scored.p_value < 1e-9
    fit = scored.fit
    for name, true in (("contact_plane.height", -0.17), ("bending_stiffness", 2e-3)):
        assert fit.value(name) == pytest.approx(true, abs=3 * fit.std(name))
    assert fit.residual_rms < 4e-4 < fits[0].residual_rms
    # Declared without a height, it begins where the shapes rest.
    declared = fit_model(model, fits[0].problem.history, Tolerances(), 3e-4)
    assert declared.value("contact_plane.height") == pytest.approx(-0.17, abs=5e-4)


def test_the_lower_side_of_a_bar_and_ipopt_with_inequalities():
    """Guesses on either side of bars lead to the minima that IPOPT finds, the lowest is chosen."""
    left, right = (Capsule(c, c, 0.03, name) for name, c in BARS.items())
    pose = HeldPose((0.0, 0.0), (0.6, 0.05))
    model, found = solved(CABLE, pose, left, right, n=24)
    free = solved(CABLE, pose, n=24)[1].x
    energies, given = [], (model, model.nominal, np.zeros(model.chain.n_rests), pose)
    for x in [free, *beside_bars(model, free, found.points)]:
        minimum = by_ipopt(*given, x[:, 0])
        if minimum is not None and minimum.stable:
            energies.append(minimum.energy)
    assert max(energies) - min(energies) > 0.01 * WEIGHT * LENGTH  # the sides differ
    assert found.energy == pytest.approx(min(energies), abs=1e-8)


@pytest.mark.parametrize(
    ("bar", "ends"),
    [
        ((0.3, -0.3), ((0.0, 0.0), (0.6, 0.05))),
        pytest.param(
            (0.3, -0.05, -0.22), ((0.0, 0.0, 0.0), (0.7, 0.1, 0.0)), marks=pytest.mark.long
        ),
    ],
)
def test_a_pose_names_the_side_of_a_bar(bar, ends):
    """Either side is a stable shape with its nodes outside; IPOPT from there finds the same.

    In the plane the bar is named, in space all are meant.
    """
    half = np.array([0.05, 0.3, 0.02]) if len(bar) == 3 else np.zeros(2)
    bar = Capsule(tuple(bar - half), tuple(bar + half), 0.03, "bar")
    cable, n = (LOOM, 16) if len(half) == 3 else (CABLE, 48)
    energies, ipopt = {}, None
    for over in (None, True, False):
        named = {"bar": True} if over and len(half) == 2 else over
        model, found = solved(cable, HeldPose(*ends, over=named), bar, n=n)
        assert found.stable
        (above,), (below,) = bar.passed(bar.up(model.gravity), found.points[None])
        assert above != below
        assert over is None or above == over
        assert bar.near(found.points).distance.min() > RADIUS - 1e-6 * LENGTH
        energies[above] = found.energy
        if over is None:
            lowest = found.energy
            continue
        given = model.nominal, np.zeros(model.chain.n_rests), HeldPose(*ends)
        ipopt = ipopt or Ipopt(model)
        (one,) = ipopt.solve(*given, [found.x])
        assert one.energy == pytest.approx(found.energy, abs=1e-8)
    assert energies[True] > energies[False] + 1e-4
    assert lowest == pytest.approx(energies[False], abs=1e-12)


@pytest.mark.parametrize("height", [pytest.param(-0.05, marks=pytest.mark.long), -0.1])
def test_a_cable_pressed_on_a_table_has_the_energy_of_hard_contacts(height):
    """Forces of fifty weights: IPOPT with inequalities on the same energy."""
    cable = CableData(1.0, 0.1 / 9.81, 2 * RADIUS, 0.1)
    table = Plane((0.0, height - RADIUS), (0.0, 1.0), "table")
    pose = HeldPose((0.0, 0.0), (0.85, 0.0), start_heading=-1.0, end_heading=1.0)
    model, found = solved(cable, pose, table, n=24, start="clamped", end="clamped")
    assert len(found.contacts) == 2
    rest = np.zeros(model.chain.n_rests)
    (one,) = Ipopt(model).solve(model.nominal, rest, pose, [found.x])
    assert one.energy == pytest.approx(found.energy, abs=1e-10)


def test_a_free_end_hangs_over_a_bar():
    """Frictionless: from the clamp over the bar, all beyond hangs down on its other side."""
    bar = Capsule((0.3, 0.0), (0.3, 0.0), 0.03, "bar")
    soft, pose = replace(CABLE, bending_stiffness=2e-3), HeldPose((0.0, 0.0), start_heading=0.0)
    held = {"n": 48, "start": "clamped", "end": "free"}
    _, found = solved(soft, replace(pose, over=True), bar, **held)
    assert found.stable
    assert found.points[-1] == pytest.approx([0.34, -0.6], abs=0.05)
    assert not solved(soft, pose, bar, **held)[1].contacts  # it is lower beside the bar
    with pytest.raises(EquilibriumError, match="in which the cable passes under bar, its end free"):
        solved(soft, replace(pose, over=False), bar, **held)


def test_forces_on_another_mesh_have_the_same_sum_and_moment():
    """Of every obstacle by itself; only those that press count."""
    low = replace(TABLE, point=(0.0, -0.2))
    model = CableModel(CABLE, 20, n_rest=0, obstacles=(TABLE, low))
    other, s = model.with_mesh(60), np.arange(1, 20) / 20
    along = np.maximum(0.0, np.array([s * (1 - s), 0.25 - (2 * s - 1) ** 2]))  # N/m
    sizes = np.where(along > 0, along, -1.0) * model.chain.h
    lam = np.concatenate([np.zeros(model.n_lam), *sizes])[None]
    found = forces_on_other_mesh(lam, model, other).reshape(2, 59)
    places = np.arange(1, 60) / 60
    # Lines between the nodes of a parabola leave out its bend.
    np.testing.assert_allclose(found.sum(axis=1), model.chain.h * along.sum(axis=1), rtol=0.02)
    np.testing.assert_allclose(found @ places, found.sum(axis=1) / 2, rtol=1e-9)


def test_which_side_of_a_bar_a_line_passes():
    bar = Capsule((0.0, -0.2, 0.0), (0.0, 0.2, 0.0), 0.02)
    up, x = bar.up((0.0, 0.0, -9.81)), np.linspace(-1.0, 1.0, 8)
    lines = [
        np.stack([x, 0 * x + y, z + 0 * x], axis=1) for y, z in ((0, 0.1), (0.1, -0.1), (0.3, 0.1))
    ]
    loop = np.array([[-1, 0, 0.1], [1, 0, 0.1], [1, 0, -0.1], [-1, 0, -0.1], [-1, 0, 0]])
    above, below = bar.passed(up, np.array([*lines, np.pad(loop, ((0, 3), (0, 0)), mode="edge")]))
    assert above.tolist() == [True, False, False, False]
    assert below.tolist() == [False, True, False, False]


def test_ipopt_lays_a_free_end_on_a_table():
    pose = HeldPose((0.0, 0.0), start_heading=0.0)
    model, found = solved(CABLE, pose, TABLE, n=24, start="clamped", end="free")
    straight = np.zeros(model.chain.n_nodes)
    minimum = by_ipopt(model, model.nominal, np.zeros(model.chain.n_rests), pose, straight)
    assert found.contacts
    assert minimum.contacts
    assert minimum.energy == pytest.approx(found.energy, abs=1e-10)


def test_a_fixture_inside_of_an_obstacle():
    with pytest.raises(
        EquilibriumError, match=r"end \(0.7000, -0.2000\) m is 0.0500 m inside table"
    ):
        solved(CABLE, HeldPose((0.0, 0.0), (0.7, -0.2)), TABLE)


SESSION = """\
cable: {name: laid, length: 0.8, mass: 0.05, diameter: 0.005, bending_stiffness: 0.01}
experiment:
  gravity: [0, -9.81]
  boundary: {start: pinned, end: pinned}
  measurement: {kind: centerlines, std: 3.0e-4}
  obstacles:
    - {name: table, kind: plane, point: [0, -0.1], normal: [0, 2]}
    - {kind: sphere, center: [0.3, -0.2], radius: 0.05}
  poses:
    - {file: a.csv, start: [0, 0], end: [0.6, 0.1], over: true}
"""


def test_a_session_with_obstacles(tmp_path):
    (tmp_path / "a.csv").touch()
    (tmp_path / "session.yaml").write_text(SESSION)
    experiment = load_config(tmp_path / "session.yaml").experiment
    table, ball = experiment.surfaces
    assert experiment.poses[0].held.over is True
    assert table == Plane((0.0, -0.1), (0.0, 1.0), "table")
    assert ball == Capsule((0.3, -0.2), (0.3, -0.2), 0.05, "obstacle_2")


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        (", normal: [0, 2]", "", "table: a plane needs normal"),
        ("normal: [0, 2]", "normal: [0, 0]", "table: the normal of a plane is not zero"),
        ("point: [0, -0.1]", "point: [0, 0, -0.1]", r"table: point: \[x, y\] belongs here"),
        ("kind: sphere", "kind: sphere, a: [0, 0]", "obstacle_2: a sphere has no a, it has center"),
        ("kind: sphere", "kind: sphere, name: table", "two obstacles are called table"),
        ("over: true", "over: 'false'", "over: "),
        ("over: true", "over: {tabel: true}", "did you mean 'table'"),
        ("over: true", "over: {table: true}", "over: table: with gravity a cable passes"),
        ("gravity: [0, -9.81]", "gravity: [0, 0]", "over: with gravity .*; there is none here"),
    ],
)
def test_obstacles_that_cannot_be_declared_so(tmp_path, old, new, said):
    (tmp_path / "a.csv").touch()
    (tmp_path / "session.yaml").write_text(SESSION.replace(old, new))
    with pytest.raises(ConfigError, match=said):
        load_config(tmp_path / "session.yaml")
