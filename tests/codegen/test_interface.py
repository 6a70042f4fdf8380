"""Statuses, derivatives, paths and bytes of the generated solver."""

import re
import shutil
import subprocess
from dataclasses import replace

import numpy as np
import pytest
from solvers import QUICK, STRICT, all_zero

from dlo_casadi.codegen import STATUSES, CompiledSolver, generate, shapes
from dlo_casadi.effects import AxialStretch, BendingSoftening, CableData, EndOffset, ImageScale
from dlo_casadi.equilibrium.pose import HeldPose
from dlo_casadi.equilibrium.solve import solve_equilibrium
from dlo_casadi.errors import DloError, EquilibriumError
from dlo_casadi.model.cable_model import CableModel

pytestmark = pytest.mark.skipif(shutil.which("cc") is None, reason="no C compiler (cc)")

CABLE = CableData(length=0.8125, mass=0.23, diameter=0.0128, bending_stiffness=0.3)
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


def compiled(model, p, rest):
    """A solver that compiles quickly; tests/codegen/test_space.py has one of the default flags."""
    return CompiledSolver(model, p, rest, flags=QUICK)


@pytest.fixture(scope="module")
def links():
    return compiled(*cable())


@pytest.fixture(scope="module")
def straight():
    return compiled(*cable("arc", straight=True))


@pytest.fixture(scope="module")
def clamped():
    return compiled(*cable("arc", "clamped", "clamped", effects=(AxialStretch(),)))


def at(end, *, start=(0.0, 0.0), headings=(None, None), branch=None):
    return HeldPose(start, end, *headings, branch=branch)


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
    shape = links.solve(at(end), throw=False)
    assert shape.status == status
    assert all_zero(shape)
    with pytest.raises(EquilibriumError, match=status) as caught:
        links.solve(at(end))
    hint = {"not_finite": "finite numbers for start, end", "unreachable": "is the end in metres?"}
    assert hint[status] in caught.value.message


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"end": None}, "pose: the end of the cable is pinned: where is it"),
        ({"end": "ab"}, "pose: end must have 2 numbers, found 'ab'"),
        ({"end": ("a", "b")}, r"numbers belong in a pose, found .*\('a', 'b'\)"),
        ({"end": [(0.3, -0.1), (0.4, 0.1)]}, "end must have 2 numbers"),
        ({"start": (1, 2, 3)}, r"start must have 2 numbers, found \(1, 2, 3\)"),
        ({"branch": "left"}, "branch must be 'ccw', 'cw' or None, found 'left'"),
        ({"branch": ["cw"]}, "branch must be"),
    ],
)
def test_what_is_no_pose_is_refused(links, arguments, message):
    with pytest.raises(DloError, match=message):
        links.solve(at(**({"end": (0.3, -0.1)} | arguments)))


@pytest.mark.parametrize(
    ("headings", "name"), [((None, 0.1), "start_heading"), ((0.1, None), "end_heading")]
)
def test_a_clamp_without_a_direction_is_refused(clamped, headings, name):
    with pytest.raises(
        DloError, match=rf"holds the direction, give {name} \[rad\], continuous along the"
    ):
        clamped.solve(at((0.5, 0.1), headings=headings))


def test_a_place_is_no_pose_and_three_is_no_shape(links):
    with pytest.raises(DloError, match=r"a Pose belongs here, found \(0.3, -0.1\)\n  Try: dlo"):
        links.solve((0.3, -0.1))
    with pytest.raises(DloError, match=r"a Pose belongs here, found a CompiledShape\n"):
        links.step(at((0.3, -0.1)), links.solve(at((0.3, -0.1))))
    with pytest.raises(DloError, match="a CompiledShape of this solver belongs here, found 3"):
        links.solve(at((0.3, -0.1)), warm=3)
    with pytest.raises(DloError, match="a CompiledShape of this solver belongs here, found None"):
        links.step(None, at((0.3, -0.1)))


def test_many_poses_are_of_one_branch_or_rows_of_numbers(links):
    ends = [(0.3, -0.1), (0.4, 0.1)]
    way = [at(end, branch="cw") for end in ends]
    rows = np.array([pose.ends for pose in way])
    shapes, _ = links.solve_many(way)
    assert shapes.tobytes() == links.solve_many(rows, branch="cw")[0].tobytes()
    assert set(shapes["turn"]) == {-1}
    with pytest.raises(DloError, match="one branch belong in one call, found ccw, cw"):
        links.solve_many([*way, at((0.3, 0.1), branch="ccw")])
    with pytest.raises(DloError, match="'cw' is for poses in an array"):
        links.solve_many(way, branch="cw")
    with pytest.raises(DloError, match=r"an array \(m, 6\) as dlo_pose .* found \(2, 2\)"):
        links.solve_many(np.array(ends))
    for rows in (np.array([["a"] * 6]), np.array([[None] * 6]), np.zeros((1, 6), complex)):
        with pytest.raises(DloError, match=r"real numbers belong in the array, found (<U1|ob|com)"):
            links.solve_many(rows)


def test_not_finite_clamps_and_warm_starts(clamped):
    assert clamped.solve(at((0.5, 0.1), headings=(np.nan, 0.0)), throw=False).status == "not_finite"
    pose = at((0.5, 0.1), headings=(0.7, -0.6))
    good = clamped.solve(pose)
    good.x[3] = np.nan
    again = clamped.solve(pose, warm=good, throw=False)
    assert again.status == "not_finite"
    assert all_zero(again)


def test_small_workspace_and_wrong_branch(links, monkeypatch):
    monkeypatch.setattr(links, "workspace", links.workspace - 1)
    shape = links.solve(at((0.5, 0.1)), throw=False)
    assert shape.status == "workspace_too_small"
    assert all_zero(shape)
    monkeypatch.undo()
    monkeypatch.setitem(shapes._BRANCHES, "ccw", 7)
    assert links.solve(at((0.5, 0.1), branch="ccw"), throw=False).status == "bad_argument"


def test_a_failure_leaves_no_stale_number_in_a_batch(links):
    shapes, statuses = links.solve_many(
        list(map(at, [(0.5, 0.1), (np.nan, 0.0), (2.0, 0.0), (0.5, 0.1)]))
    )
    assert [STATUSES[k] for k in statuses] == ["ok", "not_finite", "unreachable", "ok"]
    assert not any(np.any(shapes[i][name]) for i in (1, 2) for name in shapes.dtype.names)
    assert shapes[0].tobytes() == shapes[3].tobytes()


def test_batches_and_paths_return_the_first_status_that_is_not_ok(links):
    """As the header promises to callers in C, and C++ throws it."""
    good = at((0.5, 0.1))
    for poses, status in (
        ([good, good], "ok"),
        ([good, at((2.0, 0.0)), at((np.nan, 0.0)), good], "unreachable"),
        ([at((np.nan, 0.0)), at((2.0, 0.0))], "not_finite"),
    ):
        table, branch = shapes.pose_table(links.model, poses)
        out = np.zeros(len(table), shapes.records_of(links.model).shape)
        told, jump = np.zeros(len(table), np.intc), np.zeros(1, np.uintp)
        given = (table, len(table), branch)
        assert STATUSES[links._call("dlo_batch", *given, out, told)] == status
        assert STATUSES[links._call("dlo_path", *given, None, out, told, jump)] == status


def test_both_ends_at_one_place_is_a_loop(links):
    for branch in ("ccw", "cw"):
        loop = links.solve(at((0.0, 0.0), branch=branch))
        assert np.abs(loop.points[-1]).max() < 1e-9
    weightless = CableModel(CABLE, n=16, gravity=(0.0, 0.0))
    shape = compiled(weightless, weightless.nominal, np.zeros(16)).solve(at((0.0, 0.0)))
    assert np.abs(shape.points[-1]).max() < 1e-9


def test_almost_taut(links):
    for ratio in (0.99, 0.999, 0.99999):
        shape = links.solve(at((ratio * CABLE.length, 0.0)))
        assert 0.0 < shape.end_error < 1e-9
        assert 0.0 < shape.imbalance < 1e-6


def test_branches_bow_either_way(straight):
    left = straight.solve(at((0.5, 0.0), branch="ccw"))
    right = straight.solve(at((0.5, 0.0), branch="cw"))
    assert (left.turn, right.turn) == (1, -1)
    assert straight.solve(at((0.5, 0.0))).energy == min(left.energy, right.energy)


def test_a_branch_without_an_equilibrium_is_a_status():
    """A limp cable hangs, and does not stand up: nothing is returned in place of what was named."""
    model = CableModel(CableData(0.8, 0.2, 0.01, 0.005), n=12)
    solver = compiled(model, model.nominal, np.zeros(model.chain.n_cells))
    hung = solver.solve(at((0.5, 0.0)))
    assert hung.turn == 1
    for warm in (None, hung):
        shape = solver.solve(at((0.5, 0.0), branch="cw"), warm=warm, throw=False)
        assert shape.status == "other_branch"
        assert all_zero(shape)
        assert solver.solve(at((0.5, 0.0), branch="ccw"), warm=warm).turn == 1
    with pytest.raises(EquilibriumError, match=r"other_branch with the end.*\n  Try: the other"):
        solver.solve(at((0.5, 0.0), branch="cw"))
    path = solver.path([at(end, branch="cw") for end in ((0.5, 0.0), (0.5, 0.1))])
    assert [shape.status for shape in path.shapes] == ["other_branch"] * 2


def test_a_warm_start_of_the_other_branch_is_not_followed(straight):
    left = straight.solve(at((0.5, 0.0), branch="ccw"))
    right = straight.solve(at((0.5, 0.0), branch="cw"), warm=left)
    assert right.turn == -1


def test_parallel_clamps_are_on_either_branch(clamped):
    """Their headings fix the turn, 0 to rounding, of which no sign is asked."""
    shapes = [
        clamped.solve(at((0.5, 0.0), headings=(0.0, 0.0), branch=branch))
        for branch in (None, "ccw", "cw")
    ]
    assert [shape.turn for shape in shapes] == [0, 0, 0]
    against = at((0.5, 0.0), headings=(0.0, 0.1), branch="cw")
    assert clamped.solve(against, throw=False).status == "other_branch"


def test_a_clamped_loop_turns_once_clockwise():
    model, p, rest = cable("arc", "clamped", "clamped", n=40, straight=True)
    shape = compiled(model, p, rest).solve(at((0.2, 0.0), headings=(0.0, -2 * np.pi)))
    assert shape.x[-1] == pytest.approx(-2 * np.pi, abs=1e-9)
    assert shape.end_error < 1e-9


@pytest.mark.parametrize(
    ("element", "start", "end", "effects"),
    [
        *((*kind, (AxialStretch(), BendingSoftening(), EndOffset())) for kind in KINDS),
        *((*kind, ()) for kind in KINDS[:2]),
    ],
)
def test_sensitivities_are_central_differences(element, start, end, effects):
    solver = compiled(*cable(element, start, end, effects=effects))
    pose = np.array([0.5, 0.12, 0.7, -0.6])

    def posed(numbers):
        return at(tuple(numbers[:2]), headings=numbers[2:])

    shape = solver.solve(posed(pose))
    slope = solver.sensitivity(shape, posed(pose))
    step = 1e-5
    for k in range(4):
        moved = []
        for sign in (1, -1):
            to = pose + sign * step * np.eye(4)[k]
            moved.append(solver.solve(posed(to), warm=shape))
        names = {"points": "points", "x": "rotations", "end_force": "end_force"}
        names |= {"moments": "moments", "min_bend_radius": "min_bend_radius"}
        for name, derivative in names.items():
            expected = (getattr(moved[0], name) - getattr(moved[1], name)) / (2 * step)
            found = getattr(slope, derivative)
            size = max(np.abs(found).max(), 1e-12)
            assert np.abs(found[..., k] - expected).max() < 1e-6 * size, (k, name)
        rise = (moved[0].energy - moved[1].energy) / (2 * step)
        if k >= 2:
            assert rise == pytest.approx(-shape.moments[k - 2, 0], abs=1e-6)


def test_nodes_turn_on_from_the_largest_heading(clamped):
    pose = at((0.5, 0.1), headings=(1e6, 1e6 - 0.1))
    shape = clamped.solve(pose)
    assert shape.x.max() > 1e6
    assert clamped.step(shape, pose).energy == pytest.approx(shape.energy, abs=1e-9)
    assert np.isfinite(clamped.sensitivity(shape, pose).points).all()
    beyond = at((0.5, 0.1), headings=(1e6 + 1e-9, 1e6))
    assert clamped.solve(beyond, throw=False).status == "bad_argument"


@pytest.mark.parametrize("solver", ["links", "clamped"])
def test_a_step_stays_on_its_branch_within_its_bound_on_the_work(solver, request):
    solver = request.getfixturevalue(solver)
    near = at((0.503, 0.098), headings=(0.7, -0.6))
    shape = solver.solve(at((0.5, 0.1), headings=(0.7, -0.6)))
    stepped = solver.step(shape, near, steps=5)
    assert stepped.status == "ok"
    expected = solver.solve(near, warm=shape)
    np.testing.assert_allclose(stepped.points, expected.points, atol=1e-8)
    for steps, status in ((1, "iteration_limit"), (0, "bad_argument")):
        short = solver.step(shape, near, steps=steps)
        assert short.status == status
        assert all_zero(short)
    with pytest.raises(DloError, match=r"steps: a whole number .* found 1.5"):
        solver.step(shape, near, steps=1.5)


def test_sensitivity_of_a_shape_of_another_pose_is_refused(links):
    shape = links.solve(at((0.5, 0.1)))
    with pytest.raises(EquilibriumError, match="bad_argument"):
        links.sensitivity(shape, at((0.5, 0.11)))


def test_an_equilibrium_that_is_no_minimum_has_no_derivatives():
    """An S of a weightless cable between pins: two bows, the second one turned half round."""

    def weightless(length, n):
        model = CableModel(replace(CABLE, length=length), n=n, element="link", gravity=(0.0, 0.0))
        return model, model.nominal, np.zeros(model.chain.n_rests)

    half = solve_equilibrium(*weightless(CABLE.length / 2, 5), at((0.25, 0.0), branch="ccw"))
    whole, pose = compiled(*weightless(CABLE.length, 10)), at((0.5, 0.0))
    bow = whole.solve(pose)
    assert whole.sensitivity(bow, pose).end_force.any()
    x = np.concatenate([half.x, half.x[::-1]])
    with pytest.raises(EquilibriumError, match="unstable"):
        whole.sensitivity(replace(bow, x=x, end_force=half.end_force), pose)


def test_minus_the_end_force_is_the_slope_of_the_energy(links):
    shape, step = links.solve(at((0.5, 0.1))), 1e-5
    for k in range(2):
        ends = [np.array([0.5, 0.1]) + s * step * np.eye(2)[k] for s in (1, -1)]
        e = [links.solve(at(tuple(end)), warm=shape).energy for end in ends]
        assert (e[0] - e[1]) / (2 * step) == pytest.approx(-shape.end_force[k], rel=1e-6)


def test_path_holds_its_branch_and_reports_the_snap():
    """A strip clamped at one end whose other clamp is turned snaps through at a fold."""
    model, p, rest = cable("arc", "clamped", "clamped", n=24, straight=True)
    solver = compiled(model, p, rest)
    turns = np.linspace(0.6, -2.5, 32)
    path = solver.path([at((0.7, 0.0), headings=(turn, -turn)) for turn in turns])
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
    way = [at(tuple(end), branch="cw") for end in ends]
    path = links.path(way)
    assert path.first_jump is None
    for pose, shape in zip(way, path.shapes, strict=True):
        single = links.solve(pose)
        assert np.abs(single.points - shape.points).max() < 1e-9


def test_path_over_an_impossible_pose(links):
    path = links.path([at(end, branch="cw") for end in ((0.5, 0.1), (2.0, 0.0), (0.5, 0.1))])
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


@pytest.mark.parametrize("prefix", ["clip", "start", "contact"])
def test_a_prefix_makes_no_name_that_the_code_has(prefix):
    with pytest.raises(
        DloError, match=rf"(?i)the prefix '{prefix}' would make {prefix}_\w+ of dlo_"
    ):
        generate(*cable(), prefix)


def test_code_does_not_grow_with_the_mesh():
    sizes = []
    for n in (10, 200):
        text = generate(*cable("arc", n=n)).files["dlo_solver.c"]
        sizes.append(text.count("\n") - text[text.index("TABLE[]") :].split("};")[0].count("\n"))
    assert (
        abs(sizes[1] - sizes[0]) < 40
    )  # another loop over segments, not another kernel per segment


@pytest.mark.parametrize(
    ("compiler", "element", "start", "end"),
    [("gcc", *KINDS[3]), *(pytest.param("clang", *kind, marks=pytest.mark.long) for kind in KINDS)],
)
def test_compiles_without_a_warning_and_with_another_prefix(
    tmp_path, compiler, element, start, end
):
    if shutil.which(compiler) is None:
        pytest.skip(f"{compiler} is not installed")
    effects = (AxialStretch(),) if start == "clamped" else ()
    generate(*cable(element, start, end, effects=effects), "harness").write(tmp_path)
    files = ["example.c", "harness_solver.c"]
    run = subprocess.run(
        [compiler, "-std=c99", *STRICT, *files, "-lm", "-o", "example"],
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
    assert all(name.startswith(("dlo_", "jac_dlo_")) for name in exported)
    assert not re.search(r" [DBCdb] ", names.stdout), "the library has changeable globals"


def test_no_compiler_is_an_error_that_says_so(monkeypatch):
    monkeypatch.delenv("CC", raising=False)
    monkeypatch.setattr(shutil, "which", lambda name: None)
    with pytest.raises(DloError, match=r"no C compiler found .looked for cc, gcc, clang"):
        CompiledSolver(*cable())


def test_the_compiler_that_CC_names_is_used_with_its_options(monkeypatch):
    monkeypatch.setenv("CC", "cc -O0 --no-such-option")
    with pytest.raises(DloError, match=r"cc could not compile the solver:\n.*no-such-option"):
        CompiledSolver(*cable())
    monkeypatch.setenv("CC", "no-such-compiler -O0")
    with pytest.raises(DloError, match=r"no C compiler found .CC is 'no-such-compiler -O0'"):
        CompiledSolver(*cable())


def test_a_start_anywhere_moves_everything_with_it(links):
    model, p, rest = cable()
    pose = HeldPose((0.3, -0.4), (0.7, -0.1))
    expected = solve_equilibrium(model, p, rest, pose)
    shape = links.solve(pose)
    assert np.abs(shape.points - expected.points).max() < 1e-8
    assert shape.energy == pytest.approx(expected.energy, rel=1e-9)
    assert shape.points[0] == pytest.approx(pose.start)
