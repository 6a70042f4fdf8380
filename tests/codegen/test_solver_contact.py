"""Contact in the generated C solver: beside Python, its derivatives, paths, what it refuses."""

from dataclasses import replace
from functools import cache

import casadi as ca
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from solvers import QUICK, STRICT, moved

from dlo_casadi.codegen import generate
from dlo_casadi.codegen.compiled import CompiledSolver, compile_library
from dlo_casadi.effects import CableData, ContactPlane, ObstacleOffset
from dlo_casadi.equilibrium.pose import HeldPose
from dlo_casadi.equilibrium.solve import solve_equilibrium
from dlo_casadi.errors import DloError
from dlo_casadi.model.cable_model import CableModel
from dlo_casadi.model.clips import HeldClip
from dlo_casadi.rod import obstacles as rod

TABLE = {2: rod.Plane((0.0, -0.19), (0.0, 1.0)), 3: rod.Plane((0.0, 0.0, -0.19), (0.0, 0.0, 1.0))}
# Under the middle of the cable.
ROUND = {
    "disc": rod.Capsule((0.4, -0.26), (0.4, -0.26), 0.08),
    "ball": rod.Capsule((0.4, 0.05, -0.26), (0.4, 0.05, -0.26), 0.08),
    "bar": rod.Capsule((0.4, -0.2, -0.26), (0.4, 0.3, -0.26), 0.08),
}


def cable(d: int, end: str = "clamped", n: int = 12) -> CableModel:
    """A heavy cable, in the plane or in space."""
    twist = {"torsional_stiffness": 0.02} if d == 3 else {}
    data = CableData(1.0, 0.2, 0.012, 0.03, **twist)
    gravity = (*[0.0] * (d - 1), -9.81)
    return CableModel(data, n, start="clamped", end=end, gravity=gravity, n_rest=0)


def pose_of(model: CableModel, *, drop: float = 0.05) -> HeldPose:
    """Ends 0.85 m apart."""
    if model.end == "free":
        end = None
    else:
        end = (0.85, drop) if model.node.dimension == 2 else (0.85, 0.1, drop)
    if model.node.dimension == 2:
        return HeldPose((0.0, 0.0), end, start_heading=0.1, end_heading=-0.05)
    frame = (0.02, -0.05, 0.03, 0.998)
    size = float(np.linalg.norm(frame))
    turned = tuple(x / size for x in frame)
    return HeldPose((0.0,) * 3, end, start_orientation=turned, end_orientation=(0.0, 0.0, 0.0, 1.0))


def compiled(model: CableModel, *flags: str, obstacles: int = 2) -> CompiledSolver:
    rest = np.zeros(model.chain.n_rests)
    return CompiledSolver(model, model.nominal, rest, flags=flags or QUICK, obstacles=obstacles)


@pytest.fixture(scope="module", params=[2, 3], ids=["plane", "space"])
def own(request) -> tuple[CableModel, CompiledSolver]:
    """A cable that touches its table, and its solver."""
    model = cable(request.param)
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("CC", "cc")  # its warnings are those of GCC
        return model, compiled(replace(model, obstacles=(TABLE[request.param],)), *STRICT)


@cache
def at_nodes(d: int, end: str = "clamped") -> CompiledSolver:
    """A solver whose contacts are at nodes alone, as Python's are."""
    return compiled(replace(cable(d, end), obstacles=(TABLE[d],)), *QUICK, "-DBETWEEN=0")


@pytest.mark.parametrize(
    ("what", "d", "end"),
    [
        ("table", 2, "clamped"),
        ("table", 3, "free"),
        pytest.param("table", 3, "clamped", marks=pytest.mark.long),
        ("ball", 3, "clamped"),
    ],
)
def test_nodes_alone_touch_as_in_python(what, d, end):
    surface = TABLE[d] if what == "table" else ROUND[what]
    model = replace(cable(d, end), obstacles=(surface,))
    found = at_nodes(d, end).solve(pose_of(model), obstacles=model.obstacles)
    eq = solve_equilibrium(model, model.nominal, np.zeros(model.chain.n_rests), pose_of(model))
    assert eq.contacts, "the cable touches"
    scale = model.cable.mass * 9.81
    assert found.energy == pytest.approx(eq.energy, abs=1e-10 * scale)
    assert found.points == pytest.approx(eq.points[: model.n + 1], abs=1e-6)
    forces = sum(contact.force for contact in eq.contacts)
    assert found.obstacle_forces[0] == pytest.approx(forces, abs=1e-5 * scale)
    assert found.start_force == pytest.approx(eq.start_force, abs=1e-5 * scale)


def test_whole_cable_is_outside(own):
    model, solver = own
    shape = solver.solve(pose_of(model))
    gap = solver.clearance(shape, solver.obstacles)
    assert -1e-6 <= gap.distance < 1e-6, "touches, and is nowhere deeper"
    assert shape.contact_forces.min() == 0.0 < shape.contact_forces.max()
    weight = np.array([*[0.0] * (model.node.dimension - 1), -model.cable.mass * 9.81])
    held = shape.start_force + shape.end_force + shape.obstacle_forces.sum(axis=0)
    assert held == pytest.approx(weight, abs=1e-8)
    places = shape.contact_places[shape.contact_forces > 0]
    assert np.all((places > 0.2) & (places < 0.9))


def test_a_place_slides_to_where_the_cable_is_lowest(own):
    """Where it touches between nodes: nothing is deeper beside."""
    model, solver = own
    shape = solver.solve(pose_of(model))
    touched = np.flatnonzero(shape.contact_forces[0])
    between = touched[touched % 4 != 3]
    assert len(between), "it touches between its nodes"
    assert solver.clearance(shape, solver.obstacles).distance == pytest.approx(0.0, abs=1e-9)


@pytest.mark.parametrize("mass", [pytest.param(0.05, marks=pytest.mark.long), 0.5])
def test_cables_in_the_plane_land_on_tables(mass):
    """Also heavy ones, whose mesh is coarse: they slide until they lie."""
    model = replace(cable(2), cable=CableData(1.0, mass, 0.008, 0.01))
    solver, found = compiled(model), []
    for level in np.linspace(-0.25, -0.05, 21):
        for tilt in (-0.2, 0.0, 0.2):
            normal = (-np.sin(tilt), np.cos(tilt))
            plane = rod.Plane((0.0, float(level)), normal)
            pose = HeldPose((0.0, 0.0), (0.7, 0.02), start_heading=0.3, end_heading=-0.2)
            shape = solver.solve(pose, throw=False, obstacles=[plane])
            if shape.status != "no_room":
                found.append(shape.status)
                assert shape.contact_forces.min() >= 0.0
    assert len(found) > 40
    assert set(found) == {"ok"}


def test_no_obstacles_are_as_a_solver_without(own):
    model, solver = own
    found = solver.solve(pose_of(model), obstacles=())
    known = compiled(model, obstacles=0).solve(pose_of(model))
    assert found.energy == pytest.approx(known.energy, abs=1e-13)
    assert not found.contact_forces.any()


@pytest.mark.parametrize("where", ["nodes", "between"])
@pytest.mark.parametrize("what", ["table", "round"])
def test_derivatives_through_contacts(own, what, where):
    """Of forces, moments, points and the force on the obstacle, by central differences."""
    model, solver = own
    d = model.node.dimension
    name = "disc" if d == 2 else "ball"
    if where == "nodes":
        solver = at_nodes(d)
    listed = solver.obstacles
    if what == "round":
        listed = (ROUND[name],)
    pose = pose_of(model)
    shape = solver.solve(pose, obstacles=listed)
    assert shape.obstacle_forces.any()
    slope = solver.sensitivity(shape, pose, obstacles=listed)
    assert slope.degenerate == 0
    force = solver.limits(shape, {}, slope=slope)["force"]
    assert force.which == (0 if d == 3 else 1), "in space the start's, which the obstacle changes"
    step = 1e-5
    for column in range(slope.min_bend_radius.size):
        sides = [
            solver.step(shape, moved(pose, column, sign * step), steps=10, obstacles=listed)
            for sign in (1, -1)
        ]
        assert {side.status for side in sides} == {"ok"}
        loads = [solver.limits(side, {})["force"].value for side in sides]
        change = (loads[0] - loads[1]) / (2 * step)
        assert force.gradient[column] == pytest.approx(change, rel=1e-3, abs=2e-3)
        for key in ("points", "end_force", "moments", "obstacle_forces"):
            change = np.subtract(*(getattr(side, key) for side in sides)) / (2 * step)
            told = getattr(slope, key)[..., column]
            assert told == pytest.approx(change, rel=1e-3, abs=2e-3 * (1 + np.abs(change).max())), (
                key,
                column,
            )


@pytest.mark.parametrize("d", [2, 3])
def test_a_contact_that_is_about_to_begin_is_told(d):
    """A table a nanometre below the lowest node: there derivatives have two sides."""
    solver = at_nodes(d)
    pose = pose_of(solver.model)
    free = solver.solve(pose, obstacles=())
    lowest = free.points[:, -1].min() - solver.model.cable.diameter / 2
    for gap, count in ((1e-9, 1), (1e-4, 0)):
        table = [replace(TABLE[d], point=(*[0.0] * (d - 1), lowest - gap))]
        slope = solver.sensitivity(solver.solve(pose, obstacles=table), pose, obstacles=table)
        assert slope.degenerate == count


def test_a_path_touches_down_and_lifts_off(own):
    model, solver = own
    drops = np.concatenate([np.linspace(0.2, 0.04, 20), np.linspace(0.04, 0.2, 20)])
    pose = pose_of(model)
    poses = [replace(pose, end=(*pose.end[:-1], float(drop))) for drop in drops]
    path = solver.path(poses)
    assert path.first_jump is None
    forces = np.array([-shape.obstacle_forces[0][-1] for shape in path.shapes])
    assert forces[0] == forces[-1] == 0.0 < forces[20]
    for shape in path.shapes:
        assert solver.clearance(shape, solver.obstacles).distance >= -1e-6
    energies = [shape.energy for shape in path.shapes]
    assert energies == pytest.approx(energies[::-1], abs=1e-6), "the same way back"


def test_refusals(own):
    model, solver = own
    d = model.node.dimension
    low = replace(pose_of(model), start=(*[0.0] * (d - 1), -0.1899))
    assert solver.solve(low, throw=False).status == "no_room"
    low = replace(pose_of(model), end=(0.85, *[0.1] * (d - 2), -0.1899))
    assert solver.solve(low, throw=False).status == "no_room"
    flat = rod.Plane((0.0,) * d, (0.0,) * d)
    with pytest.raises(DloError, match="the normal of a plane must not be zero"):
        solver.solve(pose_of(model), throw=False, obstacles=[flat])
    with pytest.raises(DloError, match="3 obstacles, the solver knows at most 2"):
        solver.solve(pose_of(model), obstacles=solver.obstacles * 3)
    with pytest.raises(DloError, match="0 to 1000"):
        generate(model, model.nominal, np.zeros(model.chain.n_rests), obstacles=-1)


def test_obstacles_of_the_model_with_what_a_fit_moved():
    model = replace(cable(3), obstacles=(TABLE[3],))
    model = model.with_effect(ObstacleOffset()).with_effect(ContactPlane())
    p = model.nominal.copy()
    p[model.names.index("obstacle_offset.offset")] = 0.01
    p[model.names.index("contact_plane.height")] = -0.3
    solver = CompiledSolver(model, p, np.zeros(model.chain.n_rests), flags=QUICK)
    assert [x.point[2] for x in solver.obstacles] == pytest.approx([-0.18, -0.3])
    shape = solver.solve(pose_of(model))
    assert shape.points[:, 2].min() == pytest.approx(-0.18 + 0.006, abs=2e-3)
    assert shape.obstacle_forces[0, 2] < 0.0 == shape.obstacle_forces[1, 2]


def test_casadi_knows_the_obstacles_of_the_model(own, tmp_path):
    model, solver = own
    d = model.node.dimension
    touching = replace(model, obstacles=(TABLE[d],))
    source = generate(touching, model.nominal, np.zeros(model.chain.n_rests))
    external = ca.external("dlo_cable", str(compile_library(source, tmp_path, QUICK)))
    pose = pose_of(model)
    numbers = np.array([*pose.ends, *([0.0] if d == 3 else [])])
    shape = solver.solve(pose)
    assert float(external(numbers)[3]) == pytest.approx(shape.energy, abs=1e-12)
    x = ca.MX.sym("x", len(numbers))
    jacobian = ca.Function("j", [x], [ca.jacobian(external(x)[1], x)])
    slope = solver.sensitivity(shape, pose)
    first = -d if d == 2 else 0  # the start moves against the table: columns of its place
    told = np.array(jacobian(numbers))[:, :d]
    assert told == pytest.approx(slope.end_force[:, first : first + d or None], rel=1e-9)


@cache
def beside_a_saddle():
    """Solver, pose, a disc beside the element behind the saddle, shapes without and with it."""
    saddle = HeldClip("clamped", (0.3, 0.1), 0.36, heading=0.3)
    pose = HeldPose((0.0, 0.0), (0.7, 0.2), start_heading=0.2, end_heading=-0.3, clips=(saddle,))
    held = {"start": "clamped", "end": "clamped", "clips": ("clamped",), "n_rest": 0}
    model = CableModel(CableData(1.0, 0.2, 0.01, 0.02), 12, **held)
    curved = np.full(model.chain.n_rests, 0.3)
    solver = CompiledSolver(model, model.nominal, curved, flags=QUICK, obstacles=1)
    free = solver.solve(pose, obstacles=[])
    before, after = free.points[4:6]
    along = (after - before) / np.linalg.norm(after - before)
    center = tuple((before + after) / 2 + 0.04 * np.array([-along[1], along[0]]))
    disc = [rod.Capsule(center, center, 0.04)]
    return solver, pose, disc, free, solver.solve(pose, warm=free, obstacles=disc)


def test_a_saddle_keeps_its_direction_where_the_cable_touches_beside_it():
    *_, free, shape = beside_a_saddle()
    touches = shape.contact_places[shape.contact_forces > 0.0]
    assert len(touches)
    assert np.all((touches > free.places[4]) & (touches < free.places[5]))
    assert free.places[4] == 0.36
    assert shape.x[4] == pytest.approx(0.3, abs=1e-12)
    assert shape.energy > free.energy


def test_a_clip_inside_of_an_obstacle_has_no_room():
    solver, pose, *_ = beside_a_saddle()
    around = [rod.Capsule(pose.clips[0].place, pose.clips[0].place, 0.02)]
    assert solver.solve(pose, obstacles=around, throw=False).status == "no_room"


def test_a_step_on_a_round_obstacle_starts_with_its_normals():
    solver, pose, disc, _, shape = beside_a_saddle()
    near = replace(pose, end=(0.7005, 0.2))
    stepped = solver.step(shape, near, obstacles=disc)
    assert stepped.status == "ok"
    solved = solver.solve(near, warm=shape, obstacles=disc)
    assert stepped.points == pytest.approx(solved.points, abs=1e-8)


def test_a_step_in_space_goes_on_until_a_contact_that_presses_hard_is_closed():
    ahead = tuple(Rotation.from_euler("ZYX", (0.2, -0.3, 0.1)).as_quat())
    saddle = HeldClip("clamped", (0.3, 0.05, 0.1), 0.36, orientation=ahead)
    turned = [tuple(Rotation.from_euler("ZY", own).as_quat()) for own in ((0, -0.2), (0.1, 0.3))]
    ends = {"start_orientation": turned[0], "end_orientation": turned[1]}
    pose = HeldPose((0.0, 0.0, 0.0), (0.7, 0.1, 0.2), clips=(saddle,), **ends)
    held = {"start": "clamped", "end": "clamped", "clips": ("clamped",), "n_rest": 0}
    cable = CableData(1.0, 0.2, 0.01, 0.02, torsional_stiffness=0.015)
    model = CableModel(cable, 24, gravity=(0.0, 0.0, -9.81), **held)
    curved = np.full(model.chain.n_rests, 0.3)
    solver = CompiledSolver(model, model.nominal, curved, flags=QUICK, obstacles=1)
    free = solver.solve(pose, obstacles=[])
    side, center = np.array([0.5, -0.866, 0.0]), np.array([0.315, 0.053, 0.1465])
    bar = [rod.Capsule(tuple(center - 0.2 * side), tuple(center + 0.2 * side), 0.038)]
    shape = solver.solve(pose, warm=free, obstacles=bar)
    assert shape.contact_forces.max() > 10.0
    for way in (0.0, 1e-6):
        near = replace(pose, end=(0.7 + way, 0.1, 0.2))
        assert solver.step(shape, near, obstacles=bar).status == "ok"
