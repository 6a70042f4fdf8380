"""Statuses, derivatives, paths and bytes of the generated solver."""

import re
import shutil
import subprocess

import numpy as np
import pytest

from dlo_casadi.codegen import STATUSES, CompiledSolver, generate, library
from dlo_casadi.effects import AxialStretch, BendingSoftening, Cable, EndOffset, ImageScale
from dlo_casadi.equilibrium.pose import Pose
from dlo_casadi.equilibrium.solve import solve_equilibrium
from dlo_casadi.errors import DloError, EquilibriumError
from dlo_casadi.model.cable_model import CableModel

pytestmark = pytest.mark.skipif(shutil.which("cc") is None, reason="no C compiler (cc)")

CABLE = Cable(length=0.8125, mass=0.23, diameter=0.0128, bending_stiffness=0.3)
STRICT = ["-std=c99", "-O2", "-Wall", "-Wextra", "-Wpedantic", "-Wconversion", "-Wshadow"]
KINDS = [
    ("link", "pinned", "pinned"),
    ("arc", "pinned", "pinned"),
    ("link", "clamped", "clamped"),
    ("arc", "clamped", "pinned"),
    ("arc", "clamped", "free"),
    ("link", "pinned", "clamped"),
]


def cable(element="link", start="pinned", end="pinned", n=10, effects=(), straight=False):
    model = CableModel(CABLE, n=n, element=element, start=start, end=end, effects=effects)
    p = model.nominal.copy()
    p[1:] += 1e-3
    rng = np.random.default_rng(0)
    rest = model.rest_basis @ (rng.normal(size=model.rest_basis.shape[1]) * (not straight))
    return model, p, rest


@pytest.fixture(scope="module")
def links():
    return CompiledSolver(*cable())


@pytest.fixture(scope="module")
def clamped():
    return CompiledSolver(*cable("arc", "clamped", "clamped", effects=(AxialStretch(),)))


def all_zero(shape):
    values = [v for name, v in vars(shape).items() if name != "status"]
    return not any(np.any(value) for value in values)


@pytest.mark.parametrize(
    ("end", "status"),
    [
        ((np.nan, 0.1), "not_finite"),
        ((0.1, np.inf), "not_finite"),
        ((0.9, 0.1), "unreachable"),
        ((0.8125, 0.0), "unreachable"),
    ],
)
def test_wrong_ends_give_a_status_and_zeros(links, end, status):
    shape = links.solve(end, throw=False)
    assert shape.status == status
    assert all_zero(shape)
    with pytest.raises(EquilibriumError, match=status) as caught:
        links.solve(end)
    hint = {"not_finite": "finite numbers for end", "unreachable": "is the end in metres?"}
    assert hint[status] in caught.value.message


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"end": "ab"}, "end: numbers belong here, found 'ab'"),
        ({"end": [(0.3, -0.1), (0.4, 0.1)]}, r"found the shape \(2, 2\). Try: solve_many"),
        ({"start": (1, 2, 3)}, r"start: two numbers belong here, found the shape \(3,\)"),
        ({"branch": "left"}, "branch must be 'ccw', 'cw' or None, found 'left'"),
        ({"branch": ["cw"]}, "branch must be"),
        ({"warm": 3}, "warm: a shape of this solver, with 10 headings"),
    ],
)
def test_what_is_no_pose_is_refused(links, arguments, message):
    with pytest.raises(DloError, match=message):
        links.solve(**({"end": (0.3, -0.1)} | arguments))


def test_headings_must_be_as_many_as_ends(links):
    with pytest.raises(DloError, match=r"shape \(2,\) or, as the ends, \(3, 2\); found \(2, 2\)"):
        links.solve_many([(0.1, 0.2)] * 3, headings=[(0, 0)] * 2)


def test_not_finite_clamps_and_warm_starts(clamped):
    assert clamped.solve((0.5, 0.1), headings=(np.nan, 0.0), throw=False).status == "not_finite"
    good = clamped.solve((0.5, 0.1), headings=(0.7, -0.6))
    good.headings[3] = np.nan
    again = clamped.solve((0.5, 0.1), headings=(0.7, -0.6), warm=good, throw=False)
    assert again.status == "not_finite"
    assert all_zero(again)


def test_small_workspace_and_wrong_branch(links, monkeypatch):
    monkeypatch.setattr(links, "workspace", links.workspace - 1)
    shape = links.solve((0.5, 0.1), throw=False)
    assert shape.status == "workspace_too_small"
    assert all_zero(shape)
    monkeypatch.undo()
    monkeypatch.setattr("dlo_casadi.codegen.compiled.branch_number", lambda branch: 7)
    assert links.solve((0.5, 0.1), throw=False).status == "bad_argument"


def test_a_failure_leaves_no_stale_number_in_a_batch(links):
    shapes, statuses = links.solve_many([(0.5, 0.1), (np.nan, 0.0), (2.0, 0.0), (0.5, 0.1)])
    assert [STATUSES[k] for k in statuses] == ["ok", "not_finite", "unreachable", "ok"]
    assert not any(np.any(shapes[i][name]) for i in (1, 2) for name in shapes.dtype.names)
    assert shapes[0].tobytes() == shapes[3].tobytes()


def test_both_ends_at_one_place_is_a_loop(links):
    for branch in ("ccw", "cw"):
        loop = links.solve((0.0, 0.0), branch=branch)
        assert np.abs(loop.points[-1]).max() < 1e-9
    weightless = CableModel(CABLE, n=16, gravity=(0.0, 0.0))
    shape = CompiledSolver(weightless, weightless.nominal, np.zeros(16)).solve((0.0, 0.0))
    assert np.abs(shape.points[-1]).max() < 1e-9


def test_almost_taut(links):
    for ratio in (0.99, 0.999, 0.99999):
        shape = links.solve((ratio * CABLE.length, 0.0))
        assert shape.end_error < 1e-9


def test_branches_bow_either_way():
    solver = CompiledSolver(*cable("arc", straight=True))
    left = solver.solve((0.5, 0.0), branch="ccw")
    right = solver.solve((0.5, 0.0), branch="cw")
    assert (left.turn, right.turn) == (1, -1)
    assert solver.solve((0.5, 0.0)).energy == min(left.energy, right.energy)


def test_a_branch_without_an_equilibrium_is_a_status():
    """A limp cable hangs, and does not stand up: nothing is returned in place of what was named."""
    model = CableModel(Cable(0.8, 0.2, 0.01, 0.005), n=12)
    solver = CompiledSolver(model, model.nominal, np.zeros(model.chain.n_cells))
    hung = solver.solve((0.5, 0.0))
    assert hung.turn == 1
    for warm in (None, hung):
        shape = solver.solve((0.5, 0.0), branch="cw", warm=warm, throw=False)
        assert shape.status == "other_branch"
        assert all_zero(shape)
        assert solver.solve((0.5, 0.0), branch="ccw", warm=warm).turn == 1
    with pytest.raises(EquilibriumError, match=r"other_branch with the end.*\n  Try: the other"):
        solver.solve((0.5, 0.0), branch="cw")
    path = solver.path([(0.5, 0.0), (0.5, 0.1)], branch="cw")
    assert [shape.status for shape in path.shapes] == ["other_branch"] * 2


def test_a_warm_start_of_the_other_branch_is_not_followed():
    solver = CompiledSolver(*cable("arc", straight=True))
    left = solver.solve((0.5, 0.0), branch="ccw")
    right = solver.solve((0.5, 0.0), branch="cw", warm=left)
    assert right.turn == -1


def test_a_clamped_loop_turns_once_clockwise():
    model, p, rest = cable("arc", "clamped", "clamped", n=40, straight=True)
    shape = CompiledSolver(model, p, rest).solve((0.2, 0.0), headings=(0.0, -2 * np.pi))
    assert shape.headings[-1] == pytest.approx(-2 * np.pi, abs=1e-9)
    assert shape.end_error < 1e-9


@pytest.mark.parametrize(("element", "start", "end"), KINDS)
@pytest.mark.parametrize("effects", [(), (AxialStretch(), BendingSoftening(), EndOffset())])
def test_sensitivities_are_central_differences(element, start, end, effects):
    solver = CompiledSolver(*cable(element, start, end, effects=effects))
    pose = np.array([0.5, 0.12, 0.7, -0.6])
    shape = solver.solve(pose[:2], headings=pose[2:])
    slope = solver.sensitivity(shape, pose[:2], headings=pose[2:])
    step = 1e-5
    for k in range(4):
        moved = []
        for sign in (1, -1):
            to = pose + sign * step * np.eye(4)[k]
            moved.append(solver.solve(to[:2], headings=to[2:], warm=shape))
        for name in ("points", "headings", "lam", "moments", "min_bend_radius"):
            expected = (getattr(moved[0], name) - getattr(moved[1], name)) / (2 * step)
            size = max(np.abs(getattr(slope, name)).max(), 1e-12)
            assert np.abs(getattr(slope, name)[..., k] - expected).max() < 1e-6 * size, (k, name)
        rise = (moved[0].energy - moved[1].energy) / (2 * step)
        if k >= 2:
            assert rise == pytest.approx(-shape.moments[k - 2], abs=1e-6)


@pytest.mark.parametrize("solver", ["links", "clamped"])
def test_a_step_stays_on_its_branch_within_its_bound_on_the_work(solver, request):
    solver = request.getfixturevalue(solver)
    held = {"headings": (0.7, -0.6)}
    shape = solver.solve((0.5, 0.1), **held)
    stepped = solver.step(shape, (0.503, 0.098), steps=5, **held)
    assert stepped.status == "ok"
    expected = solver.solve((0.503, 0.098), warm=shape, **held)
    np.testing.assert_allclose(stepped.points, expected.points, atol=1e-8)
    for steps, status in ((1, "iteration_limit"), (0, "bad_argument")):
        short = solver.step(shape, (0.503, 0.098), steps=steps, **held)
        assert short.status == status
        assert all_zero(short)


def test_sensitivity_of_a_shape_of_another_pose_is_refused(links):
    shape = links.solve((0.5, 0.1))
    with pytest.raises(EquilibriumError, match="bad_argument"):
        links.sensitivity(shape, (0.5, 0.11))


def test_minus_lam_is_the_slope_of_the_energy(links):
    shape, step = links.solve((0.5, 0.1)), 1e-5
    for k in range(2):
        e = [
            links.solve(np.array([0.5, 0.1]) + s * step * np.eye(2)[k], warm=shape).energy
            for s in (1, -1)
        ]
        assert (e[0] - e[1]) / (2 * step) == pytest.approx(-shape.lam[k], rel=1e-6)


def test_path_holds_its_branch_and_reports_the_snap():
    """A strip clamped at one end whose other clamp is turned snaps through at a fold."""
    model, p, rest = cable("arc", "clamped", "clamped", n=24, straight=True)
    solver = CompiledSolver(model, p, rest)
    turns = np.linspace(0.6, -2.5, 32)
    headings = np.stack([turns, -turns], axis=1)
    ends = np.tile([0.7, 0.0], (len(turns), 1))
    path = solver.path(ends, headings=headings)
    assert path.first_jump is not None
    assert all(shape.status == "ok" for shape in path.shapes)
    moves = [
        np.abs(b.points - a.points).max()
        for a, b in zip(path.shapes[:-1], path.shapes[1:], strict=True)
    ]
    # The jump is the largest move of the path, and the path moves evenly before it.
    assert int(np.argmax(moves)) + 1 == path.first_jump
    assert max(moves[: path.first_jump - 1]) < 0.3 * max(moves)


def test_path_without_a_snap_agrees_with_single_poses(links):
    ends = np.stack([np.linspace(0.6, 0.3, 20), np.linspace(0.0, 0.3, 20)], axis=1)
    path = links.path(ends, branch="cw")
    assert path.first_jump is None
    for end, shape in zip(ends, path.shapes, strict=True):
        single = links.solve(end, branch="cw")
        assert np.abs(single.points - shape.points).max() < 1e-9


def test_path_over_an_impossible_pose(links):
    path = links.path([(0.5, 0.1), (2.0, 0.0), (0.5, 0.1)], branch="cw")
    assert [shape.status for shape in path.shapes] == ["ok", "unreachable", "ok"]
    assert path.first_jump == 1
    assert all_zero(path.shapes[1])


def test_equal_input_gives_equal_bytes_and_another_model_another_hash():
    one, two = generate(*cable()), generate(*cable())
    assert one.files == two.files
    model, p, rest = cable()
    other = generate(model, p * (1 + 1e-12), rest)
    assert other.hash != one.hash
    assert one.hash in one.files["dlo_solver.h"]
    assert not re.search(r"@[A-Z_]+@", one.files["dlo_solver.c"] + one.files["dlo_solver.h"])


def test_what_the_camera_adds_is_in_no_solver_and_not_in_its_hash():
    model, p, rest = cable()
    plain = generate(model, p, rest)
    seen = model.with_effect(ImageScale())
    same = generate(seen, np.append(p, 1.01), rest)
    assert same.hash == plain.hash
    assert same.files["dlo_solver.c"] == plain.files["dlo_solver.c"]
    held = model.with_effect(EndOffset())
    assert generate(held, np.append(p, [1e-3, 0.0]), rest).hash != plain.hash


@pytest.mark.parametrize("prefix", ["", "9lives", "a-b", "double", "class", "x y", "ä", "dlo_"])
def test_prefix_must_be_an_identifier(prefix):
    with pytest.raises(DloError, match="prefix"):
        generate(*cable(), prefix)


def test_code_does_not_grow_with_the_mesh():
    sizes = []
    for n in (10, 200):
        text = generate(*cable("arc", n=n)).files["dlo_solver.c"]
        sizes.append(text.count("\n") - text[text.index("TABLE[]") :].split("};")[0].count("\n"))
    assert abs(sizes[1] - sizes[0]) < 40  # another loop over slots, not another kernel per slot


@pytest.mark.parametrize("compiler", ["gcc", "clang"])
@pytest.mark.parametrize(("element", "start", "end"), KINDS)
def test_compiles_without_a_warning_and_with_another_prefix(
    tmp_path, compiler, element, start, end
):
    if shutil.which(compiler) is None:
        pytest.skip(f"{compiler} is not installed")
    effects = (AxialStretch(),) if start == "clamped" else ()
    generate(*cable(element, start, end, effects=effects), "harness").write(tmp_path)
    files = ["example.c", "harness_solver.c"]
    run = subprocess.run(
        [compiler, *STRICT, "-Werror", *files, "-lm", "-o", "example"],
        cwd=tmp_path,
        capture_output=True,
        text=True,
    )
    assert run.returncode == 0, run.stderr
    shown = subprocess.run(["./example"], cwd=tmp_path, capture_output=True, text=True)
    assert shown.returncode == 0, shown.stderr
    assert "bend radius" in shown.stdout


def test_links_nothing_but_libm(tmp_path):
    solver = generate(*cable("arc", "clamped", "clamped", effects=(BendingSoftening(),)))
    solver.write(tmp_path)
    subprocess.run(["cc", "-O2", "-c", "dlo_solver.c"], cwd=tmp_path, check=True)
    names = subprocess.run(["nm", "dlo_solver.o"], cwd=tmp_path, capture_output=True, text=True)
    needed = set(re.findall(r" U (\w+)", names.stdout))
    allowed = {"sin", "cos", "sincos", "sqrt", "atan2", "floor", "exp", "memset", "memcpy"}
    assert needed - allowed <= {"__stack_chk_fail", "_GLOBAL_OFFSET_TABLE_"}
    exported = set(re.findall(r" [TDBC] (\w+)", names.stdout))
    assert all(name.startswith("dlo_") for name in exported)
    assert not re.search(r" [DBCdb] ", names.stdout), "the library has changeable globals"


def test_no_compiler_is_an_error_that_says_so(monkeypatch):
    monkeypatch.setattr(library.shutil, "which", lambda name: None)
    with pytest.raises(DloError, match="no C compiler"):
        CompiledSolver(*cable())


def test_a_start_anywhere_moves_everything_with_it(links):
    model, p, rest = cable()
    start, end = np.array([0.3, -0.4]), (0.7, -0.1)
    expected = solve_equilibrium(model, p, rest, Pose(tuple(start), end))
    shape = links.solve(end, start=start)
    assert np.abs(shape.points - expected.points).max() < 1e-8
    assert shape.energy == pytest.approx(expected.energy, rel=1e-9)
    assert shape.points[0] == pytest.approx(start)
