"""The generated solver of a cable in space: shapes, statuses, derivatives, paths and bytes."""

import ctypes
import re
import shutil
import subprocess
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from benchmarks import memory
from scipy.spatial.transform import Rotation
from solvers import QUICK, STRICT, WARNINGS, all_zero, moved

import dlo_casadi as dlo
from dlo_casadi.codegen import STATUSES, CompiledSolver, generate
from dlo_casadi.codegen.cases import case_of
from dlo_casadi.codegen.compiler import compile_library, workspace_of
from dlo_casadi.codegen.obstacles import Obstacles
from dlo_casadi.effects import AxialStretch, BendingSoftening, CableData, LumpedMass, PointForce
from dlo_casadi.equilibrium.guesses import guessed_frames
from dlo_casadi.equilibrium.pose import HeldPose
from dlo_casadi.equilibrium.solve import solve_equilibrium
from dlo_casadi.errors import EquilibriumError
from dlo_casadi.model.cable_model import CableModel

pytestmark = pytest.mark.skipif(shutil.which("cc") is None, reason="no C compiler (cc)")

CABLE = CableData(0.6, 0.03, 0.004, 0.015, torsional_stiffness=0.011)
EFFECTS = {
    "axial_stretch": [1e-3],
    "point_force": [0.1, 0.05, -0.2, 0.25],
    "lumped_mass": [0.02, 0.4],
}


def problem(element="quadratic", n=12, start="clamped", end="clamped", effects=(), curved=1.0):
    """A cable, curved at rest."""
    model = CableModel(
        CABLE, n, element, start, end, gravity=(0.0, 0.0, -9.81), effects=tuple(effects)
    )
    p = model.nominal.copy()
    own = [value for effect in effects for value in EFFECTS[effect.name]]
    p[len(p) - len(own) :] = own
    rest = model.rest_basis @ np.random.default_rng(0).normal(size=model.n_coefficients)
    return model, p, 0.7 * curved * rest


def poses(count, rng, bend=0.4, roll=1.5):
    """Clamps turned against the chord and rolled, at random."""
    found = []
    for _ in range(count):
        first = Rotation.random(random_state=int(rng.integers(1 << 30)))
        turn = Rotation.from_rotvec(bend * rng.normal(size=3))
        rolled = Rotation.from_rotvec([rng.uniform(-roll, roll), 0.0, 0.0])
        reach = CABLE.length * rng.uniform(0.5, 0.9)
        start = rng.normal(size=3)
        aim = Rotation.from_rotvec(bend * rng.normal(size=3))
        end = start + reach * (first * aim).apply([1.0, 0.0, 0.0])
        found.append(
            HeldPose(
                tuple(start),
                tuple(end),
                start_orientation=tuple(first.as_quat()),
                end_orientation=tuple((first * turn * rolled).as_quat()),
            )
        )
    return found


@pytest.fixture(scope="module")
def solver():
    return CompiledSolver(*problem(), flags=QUICK)


TWO, FORCE = (AxialStretch(), LumpedMass()), (PointForce(),)


@pytest.mark.parametrize(
    ("element", "effects"),
    [
        pytest.param("quadratic", (), marks=pytest.mark.long),
        ("quadratic", TWO),
        pytest.param("arc", TWO, marks=pytest.mark.long),
        pytest.param("arc", FORCE, marks=pytest.mark.long),
    ],
    ids=["quadratic", "quadratic-two", "arc-two", "arc-force"],
)
def test_shape_force_moment_energy_and_radius_are_those_of_python(element, effects):
    model, p, rest = problem(element, effects=effects, n=9)
    compiled = CompiledSolver(model, p, rest, flags=QUICK)
    for pose in poses(3, np.random.default_rng(0)):
        expected = solve_equilibrium(model, p, rest, pose)
        shape = compiled.solve(pose)
        assert np.abs(shape.points - expected.points).max() < 1e-8
        assert shape.energy == pytest.approx(expected.energy, rel=1e-8)
        assert shape.end_force == pytest.approx(expected.end_force, abs=1e-7)
        assert shape.start_force == pytest.approx(expected.start_force, abs=1e-7)
        np.testing.assert_allclose(shape.moments, expected.moments, atol=1e-8)
        assert shape.min_bend_radius == pytest.approx(expected.min_bend_radius, rel=1e-6)
        assert abs(shape.max_twist) == pytest.approx(np.abs(expected.twist).max(), rel=1e-6)


def test_a_straight_cable_between_ball_joints_may_lie_in_any_direction():
    """It turns about itself freely: what holds that turn acts about its own axis, not about x."""
    data = {"length": 0.6, "mass": 0.03, "diameter": 0.004, "bending_stiffness": 0.015}
    rope = dlo.Cable(**data, torsional_stiffness=0.011)
    known = dlo.known_cable(rope, gravity=(0, 0, -9.81), boundary=("pinned", "pinned"))
    compiled = known.compile(flags=QUICK)
    for end in ((0.0, 0.4, 0.0), (0.0, 0.2, -0.4)):
        pose = dlo.Pose((0.0, 0.0, 0.0), end)
        shape = compiled.solve(pose)
        assert shape.energy == pytest.approx(known.solve(pose).energy, rel=1e-6)
        assert shape.iterations < 100


def test_a_section_law_inside_bowed_elements():
    model = CableModel(
        CABLE,
        6,
        "quadratic",
        "clamped",
        "clamped",
        gravity=(0, 0, -9.81),
        effects=(BendingSoftening(),),
    )
    p = model.nominal + np.eye(len(model.names))[-1] * 0.02
    rest = np.zeros(model.chain.n_rests)
    compiled = CompiledSolver(model, p, rest, flags=QUICK)
    for pose in poses(2, np.random.default_rng(1)):
        expected = solve_equilibrium(model, p, rest, pose)
        assert np.abs(compiled.solve(pose).points - expected.points).max() < 1e-8


@pytest.mark.parametrize(
    "ends", [("clamped", "free"), ("clamped", "pinned"), ("pinned", "clamped")]
)
def test_other_ends(ends):
    model, p, rest = problem(n=8, start=ends[0], end=ends[1])
    compiled = CompiledSolver(model, p, rest, flags=QUICK)
    for pose in poses(3, np.random.default_rng(2)):
        held = replace(pose, end=None) if ends[1] == "free" else pose
        expected = solve_equilibrium(model, p, rest, held)
        shape = compiled.solve(held)
        assert np.abs(shape.points - expected.points).max() < 1e-8
        assert shape.start_force == pytest.approx(expected.start_force, abs=1e-7)
        np.testing.assert_allclose(shape.moments, expected.moments, atol=1e-8)


def test_turns_twist_the_cable():
    model, p, rest = problem(n=20, curved=0.0)
    compiled = CompiledSolver(model, p, rest, flags=QUICK)
    straight = HeldPose(
        (0.0, 0.0, 0.0),
        (0.58, 0.0, 0.0),
        start_orientation=(0, 0, 0, 1),
        end_orientation=(0, 0, 0, 1),
    )
    for turns in (0.0, 1.0, -1.0):
        pose = replace(straight, turns=turns)
        shape, expected = compiled.solve(pose), solve_equilibrium(model, p, rest, pose)
        assert np.abs(shape.points - expected.points).max() < 1e-8
        assert shape.energy == pytest.approx(expected.energy, rel=1e-8)


def test_half_a_turn_tells_which_way_a_clamp_is_rolled(solver):
    """Rolled by nearly half a turn; without a word the lower of both ways is taken."""
    model, p, rest = problem()
    (pose,) = poses(1, np.random.default_rng(4))
    half = replace(pose, end_orientation=pose.start_orientation).rolled(np.pi - 0.1)
    ways = {turns: replace(half, turns=turns) for turns in (-0.5, 0.0, 0.5)}
    shapes = {turns: solver.solve(way) for turns, way in ways.items()}
    found = {turns: solve_equilibrium(model, p, rest, way) for turns, way in ways.items()}
    for turns, eq in found.items():
        np.testing.assert_allclose(shapes[turns].points, eq.points, atol=1e-8)
        assert not turns or np.sign(eq.twist.mean()) == np.sign(turns)
    assert found[0.0].energy == pytest.approx(min(found[turns].energy for turns in (-0.5, 0.5)))


def test_turns_that_a_cable_sheds_are_told(solver):
    """Of the equilibria of a cable that loops none is taken for the one that was asked for."""
    (pose,) = poses(1, np.random.default_rng(6))
    far = replace(pose, turns=3.0)
    shape = solver.solve(far, throw=False)
    assert shape.status == "turns_shed"
    assert all_zero(shape)
    with pytest.raises(EquilibriumError, match=r"does not hold 3 turns of twist .* are left"):
        solve_equilibrium(*problem(), far)


def test_two_turns_are_not_lost_on_the_coarse_mesh(solver):
    """Its six elements would be twisted by more than 2 rad each, the way round hard to tell."""
    model, p, rest = problem()
    for pose, turns in zip(poses(4, np.random.default_rng(10)), (-2.0, 2.0) * 2, strict=True):
        twisted = replace(pose, turns=turns)
        shape, expected = solver.solve(twisted), solve_equilibrium(model, p, rest, twisted)
        assert shape.energy == pytest.approx(expected.energy, rel=1e-6)


@pytest.mark.parametrize(("n", "turns"), [(4, 0.0), (12, 0.0), (12, 2.0)])
def test_frames_are_those_of_the_points_however_the_shape_was_found(solver, n, turns):
    """Derivatives are those of a shape whose frames are in balance; without a coarse mesh, too."""
    compiled = solver if n == 12 else CompiledSolver(*problem(n=n), flags=QUICK)
    for pose in poses(6, np.random.default_rng(11)):
        twisted = replace(pose, turns=turns)
        shape = compiled.solve(twisted)
        assert compiled.solve(twisted, warm=shape).iterations == 1
        compiled.sensitivity(shape, twisted)


# The list is not public: seen from behind the solver's own text.
WINDOW = """
int dlo_guess(const dlo_pose *pose, int which, double *frames, double *work);
int dlo_guess(const dlo_pose *pose, int which, double *frames, double *work)
{
    solver_t w;
    lay_out(&w, TABLE, work);
    if (which >= GUESSES || take(&w, pose) != DLO_OK || !first_guess(&w, 0))
        return 0;
    if (first_guess(&w, which) <= 0)
        return 0;
    copy(frames, w.at.x, 4 * DLO_NODES);
    return 1;
}
"""


@pytest.mark.parametrize(
    ("ends", "gravity"),
    [
        *((ends, (3.0, -4.0, 1.0)) for ends in (("clamped", "clamped"), ("clamped", "pinned"))),
        *((ends, (3.0, -4.0, 1.0)) for ends in (("clamped", "free"), ("pinned", "clamped"))),
        *((ends, (0.0, 0.0, 0.0)) for ends in (("clamped", "clamped"), ("clamped", "free"))),
    ],
)
def test_first_guesses_are_those_of_python_number_for_number(tmp_path, ends, gravity):
    model = replace(problem("arc", 9, *ends)[0], gravity=gravity)
    p = model.nominal
    rest = np.random.default_rng(0).normal(size=model.chain.n_rests)
    source = generate(model, p, rest)
    texts = {**source.files, "dlo_solver.c": source.files["dlo_solver.c"] + WINDOW}
    library = ctypes.CDLL(str(compile_library(replace(source, files=texts), tmp_path, ("-O0",))))
    library.dlo_guess.argtypes = [ctypes.c_void_p, ctypes.c_int, ctypes.c_void_p, ctypes.c_void_p]
    work = np.empty(workspace_of(library))
    along = HeldPose(
        (0.0, 0.0, 0.0),
        (0.0, 0.0, -0.4),
        start_orientation=(0, 0, 0, 1),
        end_orientation=(0.8, 0, 0, 0.6),
        turns=2.0,
    )
    for pose in [*poses(5, np.random.default_rng(3)), along]:
        held = replace(pose, end=None) if ends[1] == "free" else pose
        at = np.array([*held.ends, held.turns])
        found = []
        for which in range(9):
            frames = np.zeros((model.n + 1, 4))
            if library.dlo_guess(at.ctypes.data, which, frames.ctypes.data, work.ctypes.data):
                found.append(frames)
        expected = guessed_frames(model, p, rest, held)
        assert len(found) == len(expected)
        for ours, theirs in zip(found, expected, strict=True):
            sign = np.sign((ours[0] * theirs[0]).sum())
            np.testing.assert_allclose(ours, sign * theirs, atol=1e-7)


@pytest.mark.parametrize(
    ("changed", "status"),
    [
        ({"end": (np.nan, 0.0, 0.0)}, "not_finite"),
        ({"start": (0.0, np.inf, 0.0)}, "not_finite"),
        ({"turns": np.nan}, "not_finite"),
        ({"end": (9.0, 0.0, 0.0)}, "unreachable"),
        ({"end_orientation": (0.0, 0.0, 0.0, 0.0)}, "bad_argument"),
    ],
)
def test_wrong_poses_give_a_status_and_zeros(solver, changed, status):
    (pose,) = poses(1, np.random.default_rng(0))
    shape = solver.solve(replace(pose, **changed), throw=False)
    assert shape.status == status
    assert all_zero(shape)
    with pytest.raises(EquilibriumError, match=status):
        solver.solve(replace(pose, **changed))


def test_a_failure_leaves_no_stale_number_in_a_batch(solver):
    good, other = poses(2, np.random.default_rng(0))
    shapes, statuses = solver.solve_many([good, replace(other, end=(9.0, 0.0, 0.0)), good])
    assert [STATUSES[k] for k in statuses] == ["ok", "unreachable", "ok"]
    assert not any(np.any(shapes[1][name]) for name in shapes.dtype.names)
    assert shapes[0].tobytes() == shapes[2].tobytes()


def test_a_warm_start_of_a_neighbour_needs_few_steps_and_leads_to_the_same_shape(solver):
    for pose in poses(5, np.random.default_rng(4)):
        shape = solver.solve(pose)
        near = replace(pose, end=tuple(np.array(pose.end) + 5e-4))
        cold, warm = solver.solve(near), solver.solve(near, warm=shape)
        assert warm.iterations <= 5
        np.testing.assert_allclose(warm.points, cold.points, atol=1e-9)
    assert solver.solve(pose, warm=solver.solve(pose)).iterations == 1


def test_a_step_stays_on_its_branch_within_its_bound_on_the_work(solver):
    for pose in poses(5, np.random.default_rng(9)):
        shape = solver.solve(pose)
        near = replace(pose, end=tuple(np.array(pose.end) + 5e-4))
        stepped = solver.step(shape, near, steps=5)
        assert stepped.status == "ok"
        np.testing.assert_allclose(stepped.points, solver.solve(near).points, atol=1e-9)
        for steps in (0, 1):
            short = solver.step(shape, near, steps=steps)
            assert short.status == ("iteration_limit" if steps else "bad_argument")
            assert all_zero(short)
        far = solver.step(shape, replace(pose, end=pose.start), steps=100)
        assert far.status == "iteration_limit"


@pytest.mark.parametrize(
    ("element", "effects", "ends"),
    [
        ("quadratic", (AxialStretch(),), ("clamped", "clamped")),
        ("quadratic", (), ("clamped", "pinned")),
        ("arc", (), ("clamped", "clamped")),
        ("arc", (), ("clamped", "free")),
    ],
)
def test_sensitivities_are_central_differences(element, effects, ends):
    model, p, rest = problem(element, 8, *ends, effects=effects)
    compiled = CompiledSolver(model, p, rest, flags=QUICK)
    for pose in poses(2, np.random.default_rng(5)):
        held = replace(pose, end=None) if ends[1] == "free" else pose
        shape = compiled.solve(held)
        slope, step = compiled.sensitivity(shape, held), 1e-4
        there = [True] * 6 + [ends[1] != "free"] * 3 + [ends[1] == "clamped"] * 3
        for column in range(12):
            if not there[column]:
                assert not np.any(slope.points[..., column])
                continue
            # Central differences of fourth order.
            ahead = [
                compiled.solve(moved(held, column, k * step), warm=shape) for k in (1, -1, 2, -2)
            ]
            for name in ("points", "end_force", "moments", "min_bend_radius"):
                a, b, c, d = (getattr(one, name) for one in ahead)
                expected = (8 * (a - b) - (c - d)) / (12 * step)
                found = getattr(slope, name)
                size = max(np.abs(found).max(), 1e-12)
                assert np.abs(found[..., column] - expected).max() < 1e-6 * size, (name, column)


def test_wrench_is_the_slope_of_the_energy(solver):
    (pose,) = poses(1, np.random.default_rng(6))
    shape, step = solver.solve(pose), 1e-5
    expected = -np.concatenate(
        [shape.start_force, shape.moments[0], shape.end_force, shape.moments[1]]
    )
    for column in range(12):
        e = [solver.solve(moved(pose, column, s * step), warm=shape).energy for s in (1, -1)]
        assert (e[0] - e[1]) / (2 * step) == pytest.approx(expected[column], abs=1e-6)


def test_sensitivity_of_a_shape_of_another_pose_is_refused(solver):
    one, other = poses(2, np.random.default_rng(0))
    with pytest.raises(EquilibriumError, match="bad_argument"):
        solver.sensitivity(solver.solve(one), other)


def test_a_path_without_a_jump_agrees_with_single_poses(solver):
    (pose,) = poses(1, np.random.default_rng(7))
    way = [moved(pose, 8, 0.002 * k) for k in range(20)]
    path = solver.path(way)
    assert path.first_jump is None
    for one, shape in zip(way, path.shapes, strict=True):
        np.testing.assert_allclose(solver.solve(one).points, shape.points, atol=1e-8)


@pytest.mark.parametrize("n", [24, 32])
def test_a_path_finds_the_twist_at_which_the_cable_loops(n):
    """A bow that is twisted on snaps into a loop: at the same twist on either mesh."""
    compiled = CompiledSolver(*problem(n=n, curved=0.0), flags=QUICK)
    ahead = (0.0, 0.0, 0.0, 1.0)
    bow = HeldPose((0.0, 0.0, 0.0), (0.4, 0.0, 0.0), start_orientation=ahead, end_orientation=ahead)
    turns = 0.02 * np.arange(170)
    path = compiled.path([moved(bow, 9, 2 * np.pi * turn) for turn in turns])
    assert path.first_jump == 154
    shapes = path.shapes
    assert all(shape.status == "ok" for shape in shapes)
    move = [np.abs(b.points - a.points).max() for a, b in pairwise(shapes)]
    assert int(np.argmax(move)) + 1 == 154
    assert max(move[:150]) < 0.1 * max(move)
    assert shapes[154].energy < shapes[153].energy
    assert [np.sign(shape.max_twist) for shape in shapes[10:150]] == [1.0] * 140


def test_whole_turns_are_followed_too(solver):
    (pose,) = poses(1, np.random.default_rng(8))
    path = solver.path([pose, replace(pose, turns=1.0)])
    assert path.first_jump is None
    cold = solver.solve(replace(pose, turns=1.0), throw=False)
    assert path.shapes[1].max_twist > path.shapes[0].max_twist + 2.0
    assert cold.energy <= path.shapes[1].energy + 1e-12


def test_equal_input_gives_equal_bytes_and_code_does_not_grow_with_the_mesh():
    assert generate(*problem(n=8)).files == generate(*problem(n=8)).files
    sizes = []
    for n in (30, 90):
        text = generate(*problem(n=n)).files["dlo_solver.c"]
        sizes.append(text.count("\n") - text[text.index("TABLE[]") :].split("};")[0].count("\n"))
    assert abs(sizes[1] - sizes[0]) < 40  # numbers that happen to agree share a line


KINDS = [
    ("quadratic", ("clamped", "clamped")),
    ("arc", ("clamped", "free")),
    ("arc", ("pinned", "clamped")),
]


def build_and_run(folder, compiler, *files):
    """What an example prints that is built without a warning."""
    flags = ("-std=c99", *STRICT)
    for command in ([compiler, *flags, "example.c", *files, "-lm", "-o", "example"], ["./example"]):
        run = subprocess.run(command, cwd=folder, capture_output=True, text=True)
        assert run.returncode == 0, run.stderr
    return run.stdout


@pytest.fixture(scope="module")
def optimised(tmp_path_factory):
    """Folder of a solver with another prefix that is compiled with -O2 without a warning."""
    folder = tmp_path_factory.mktemp("optimised")
    generate(*problem(n=8, effects=(AxialStretch(),)), "harness").write(folder)
    command = ["cc", "-std=c99", "-O2", *WARNINGS, "-c", "harness_solver.c"]
    run = subprocess.run(command, cwd=folder, capture_output=True, text=True)
    assert run.returncode == 0, run.stderr
    return folder


def test_the_example_runs_with_another_prefix(optimised):
    assert "bend radius" in build_and_run(optimised, "cc", "harness_solver.o")


@pytest.mark.long
@pytest.mark.parametrize(("element", "ends"), KINDS)
def test_clang_compiles_without_a_warning(tmp_path, ends, element):
    if shutil.which("clang") is None:
        pytest.skip("clang is not installed")
    generate(*problem(element, 8, *ends), "harness").write(tmp_path)
    assert "bend radius" in build_and_run(tmp_path, "clang", "harness_solver.c")


@pytest.mark.parametrize("end", ["clamped", pytest.param("free", marks=pytest.mark.long)])
def test_sanitizers_and_threads_with_a_workspace_each_are_silent(tmp_path, end):
    """scripts/benchmark.py --only memory runs more, under valgrind, too."""
    generate(*problem("arc", 6, end=end)).write(tmp_path)
    shutil.copy(memory.HERE / "memory.c", tmp_path)
    flags = ("-O0", "-fsanitize=address,undefined", "-fno-sanitize-recover=all")
    assert memory.build_and_run(tmp_path, flags, [], 5, threads=8).startswith("silent")


def test_links_nothing_but_libm(optimised):
    output = {"cwd": optimised, "capture_output": True, "text": True}
    size = subprocess.run(["size", "harness_solver.o"], **output)
    told = re.search(r"CODE_SIZE (\d+)", (optimised / "harness_solver.h").read_text())
    assert int(size.stdout.splitlines()[1].split()[0]) == pytest.approx(int(told[1]), rel=0.15)
    names = subprocess.run(["nm", "harness_solver.o"], **output)
    needed = set(re.findall(r" U (\w+)", names.stdout))
    allowed = {"sin", "cos", "sincos", "sqrt", "atan2", "ceil", "fmin", "fmax"}
    allowed |= {"memset", "memcpy", "memmove"}
    assert needed - allowed <= {"__stack_chk_fail", "_GLOBAL_OFFSET_TABLE_"}
    assert not re.search(r" [DBCdb] ", names.stdout), "the library has changeable globals"


def test_the_coarse_mesh_is_never_finer_than_the_fine_one():
    found = [
        case_of(*problem(n=n), True, Obstacles()).coarse_elements for n in (2, 4, 12, 30, 1000)
    ]
    assert found == [2, 4, 6, 15, 500]
