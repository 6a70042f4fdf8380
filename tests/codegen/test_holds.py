"""Clips and tethers of generated solvers, against Python's equilibria and differences."""

import shutil
import subprocess
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from benchmarks import memory
from scipy.spatial.transform import Rotation
from solvers import QUICK, moved

from dlo_casadi.codegen import CompiledSolver, generate
from dlo_casadi.effects import (
    AxialStretch,
    CableData,
    ClampCompliance,
    ClipAngle,
    ClipOffset,
    ClipSlip,
    Tether,
)
from dlo_casadi.equilibrium.pose import HeldPose
from dlo_casadi.equilibrium.solve import solve_equilibrium
from dlo_casadi.equilibrium.symbolic import CasadiCable
from dlo_casadi.errors import DloError
from dlo_casadi.model.cable_model import CableModel
from dlo_casadi.model.clips import HeldClip


def turned(*vector):
    return tuple(Rotation.from_rotvec(vector).as_quat())


LOOM = CableData(1.0, 0.2, 0.01, bending_stiffness=0.02, torsional_stiffness=0.015)
CLIPS = (
    HeldClip("pinned", (0.3, 0.1, -0.05), 0.36),
    HeldClip("pinned", (0.55, 0.1, 0.05), 0.68),
)
POSE = HeldPose(
    (0.0, 0.0, 0.0),
    (0.7, 0.2, 0.1),
    start_orientation=turned(0, 0.2, 0.1),
    end_orientation=turned(0.3, -0.2, 0.1),
    clips=CLIPS,
)
SADDLE = HeldClip("clamped", CLIPS[0].place, 0.36, orientation=turned(0.3, 0.2, 0.1))
SWIVEL = replace(SADDLE, kind="swivel")
EYELET = HeldClip("eyelet", CLIPS[1].place)
NEARBY = HeldClip("eyelet", (0.33, 0.12, 0.01))  # in the same element of a coarse mesh as CLIPS[0]
# In a plane.
FLAT = CableData(1.0, 0.2, 0.01, bending_stiffness=0.02)
FLAT_CLIPS = (HeldClip("pinned", (0.3, 0.1), 0.36), HeldClip("pinned", (0.55, 0.1), 0.68))
FLAT_SADDLE = HeldClip("clamped", (0.3, 0.1), 0.36, heading=0.3)
FLAT_EYELET = HeldClip("eyelet", (0.55, 0.1))
TETHER = {
    "tether.stiffness": 40.0,
    "tether.position": 0.7,
    "tether.anchor_x": 0.5,
    "tether.anchor_y": 0.3,
    "tether.anchor_z": 0.2,
}


def loom(clips=2, effects=(), **held):
    held = {"start": "clamped", "end": "clamped", "n": 12, **held}
    kinds = ("pinned",) * clips if isinstance(clips, int) else clips
    gravity = (0.0, 0.0, -9.81)
    return CableModel(LOOM, n_rest=0, gravity=gravity, clips=kinds, effects=effects, **held)


def flat(*clips, effects=(), **held):
    """A cable in a plane, and a pose of it."""
    held = {"start": "clamped", "end": "clamped", "n": 12, **held}
    kinds = tuple(clip.kind for clip in clips)
    pose = HeldPose(
        (0.0, 0.0),
        None if held["end"] == "free" else (0.7, 0.2),
        start_heading=0.2 if held["start"] == "clamped" else None,
        end_heading=-0.3 if held["end"] == "clamped" else None,
        clips=clips,
    )
    return CableModel(FLAT, n_rest=0, clips=kinds, effects=effects, **held), pose


def numbers(model, values):
    p = model.nominal.copy()
    for name, value in values.items():
        p[model.names.index(name)] = value
    return p, np.full(model.chain.n_rests, 0.3)


@cache
def solver_of(model, values):
    p, rest = numbers(model, dict(values))
    return CompiledSolver(model, p, rest, flags=QUICK), p, rest


def compiled(model, values=()):
    return solver_of(model, tuple(dict(values).items()))


@pytest.fixture(scope="module")
def two():
    return compiled(loom())


def assert_agree(shape, eq):
    """Energies to some N times the distance at which the solver stops, of about 1e-11 m."""
    assert shape.energy == pytest.approx(eq.energy, abs=1e-10)
    assert shape.start_force == pytest.approx(eq.start_force, abs=1e-9)
    assert shape.end_force == pytest.approx(eq.end_force, abs=1e-9)
    # A tether's force, where there is one, stands behind those of the clips.
    for own, load in zip(shape.clip_forces[: len(eq.clips)], eq.clips, strict=True):
        assert own == pytest.approx(load.force, abs=1e-9)
    for own, load in zip(shape.clip_moments, eq.clips, strict=False):
        assert own == pytest.approx(np.ravel(load.moment), abs=1e-9)
    at = [load.at for load in eq.clips]
    assert shape.clip_at[: len(at)] == pytest.approx(at, abs=1e-9)


def test_two_clips(two):
    solver, p, rest = two
    shape = solver.solve(POSE)
    assert_agree(shape, solve_equilibrium(solver.model, p, rest, POSE))


def test_two_pinned_clips_in_a_plane():
    model, pose = flat(*FLAT_CLIPS)
    solver, p, rest = compiled(model)
    assert_agree(solver.solve(pose), solve_equilibrium(model, p, rest, pose))


@pytest.mark.parametrize(
    "held",
    [
        pytest.param({}, marks=pytest.mark.long),
        {"start": "pinned", "end": "pinned"},
        {"end": "free"},
    ],
)
def test_clips_in_a_plane(held):
    """One of each kind: a saddle, an eyelet, a pinned one."""
    eyelet = HeldClip("eyelet", (0.42, 0.12))
    model, pose = flat(FLAT_SADDLE, eyelet, FLAT_CLIPS[1], **held)
    solver, p, rest = compiled(model)
    assert_agree(solver.solve(pose), solve_equilibrium(model, p, rest, pose))


@pytest.fixture(scope="module")
def with_saddle():
    model = CableModel(
        CableData(0.8, 0.05, 0.005, 0.01), 20, start="clamped", end="clamped", clips=("clamped",)
    )
    return compiled(model)


def test_stretches_between_saddles_are_the_lowest_one_by_one(with_saddle):
    """From guesses of the whole cable one stretch was found in the other of its two shapes."""
    solver, p, rest = with_saddle
    saddle = HeldClip("clamped", (0.2315, -0.1665), 0.4, heading=-0.4994)
    held = {"start_heading": -0.0807, "end_heading": -0.3785}
    pose = HeldPose((0.0, 0.0), (0.577, -0.1951), clips=(saddle,), **held)
    assert_agree(solver.solve(pose), solve_equilibrium(solver.model, p, rest, pose))


def test_a_cable_in_a_plane_that_stretches():
    model, pose = flat(FLAT_SADDLE, FLAT_CLIPS[1], effects=(AxialStretch(),))
    solver, p, rest = compiled(model, {"axial_stretch.compliance": 2e-3})
    assert_agree(solver.solve(pose), solve_equilibrium(model, p, rest, pose))


@pytest.mark.parametrize(
    ("clips", "held"),
    [
        ((SADDLE, CLIPS[1]), {"start": "pinned"}),
        ((SWIVEL,), {"end": "free"}),
        pytest.param((CLIPS[0], EYELET), {"end": "pinned"}, marks=pytest.mark.long),
        ((SADDLE, EYELET), {}),
        pytest.param((CLIPS[0], NEARBY), {"end": "pinned"}, marks=pytest.mark.long),
        ((HeldClip("eyelet", CLIPS[0].place), NEARBY), {}),
    ],
)
def test_saddles_and_eyelets_in_space(clips, held):
    model = loom(tuple(clip.kind for clip in clips), **held)
    pose = replace(POSE, clips=clips)
    if "start" in held:
        pose = replace(pose, start_orientation=None)
    if "end" in held:
        free = held["end"] == "free"
        pose = replace(pose, end_orientation=None, end=None if free else pose.end)
    solver, p, rest = compiled(model)
    assert_agree(solver.solve(pose), solve_equilibrium(model, p, rest, pose))


def moves_of(model, pose):
    """Columns of the slope, poses moved along them, and the work of a unit in a shape."""
    d, turns = model.node.dimension, model.node.increment
    ends, width = (12, 6) if model.in_space else (4, 0), 1 + d + turns * model.clamped_between
    first, end = ends
    for k, clip in enumerate(pose.clips):
        column = first + width * k

        def of_clip(k=k, **change):
            clips = [*pose.clips]
            clips[k] = replace(clips[k], **change)
            return replace(pose, clips=tuple(clips))

        if clip.kind != "eyelet":
            yield column, lambda h, m=of_clip, s=clip.at: m(at=s + h), None
        for axis in range(d):
            unit = np.eye(d)[axis]
            move = lambda h, m=of_clip, x=clip.place, e=unit: m(place=tuple(x + h * e))  # noqa: E731
            yield column + 1 + axis, move, lambda shape, k=k, i=axis: -shape.clip_forces[k][i]
        for axis in range(turns if clip.frame is not None else 0):
            work = lambda shape, k=k, i=axis: -np.atleast_1d(shape.clip_moments[k])[i]  # noqa: E731
            if not model.in_space:
                move = lambda h, m=of_clip, x=clip.heading: m(heading=x + h)  # noqa: E731
            else:
                own, unit = Rotation.from_quat(clip.orientation), np.eye(3)[axis]
                move = lambda h, m=of_clip, q=own, e=unit: m(  # noqa: E731
                    orientation=tuple((Rotation.from_rotvec(h * e) * q).as_quat())
                )
            yield column + 1 + d + axis, move, work
    for axis in range(d):
        unit = np.eye(d)[axis]
        move = lambda h, e=unit: replace(pose, end=tuple(pose.end + h * e))  # noqa: E731
        yield end + axis, move, lambda shape, i=axis: -shape.end_force[i]
    if model.in_space:
        move = lambda h: replace(pose, start=(0.0, h, 0.0))  # noqa: E731
        yield 1, move, lambda shape: -shape.start_force[1]


@pytest.mark.parametrize("case", ["pinned", "in a plane", "in space"])
def test_slopes_by_clips_and_ends_are_differences(two, case):
    """Central differences of 1e-5 m, whose error is about 1e-7 of the second derivative."""
    if case == "pinned":
        solver, pose = two[0], POSE
    else:
        model, pose = flat(FLAT_SADDLE, FLAT_EYELET)
        if case == "in space":
            model, pose = loom(("swivel", "eyelet")), replace(POSE, clips=(SWIVEL, EYELET))
        solver, p, rest = compiled(model)
        assert_agree(solver.solve(pose), solve_equilibrium(model, p, rest, pose))
    shape, step = solver.solve(pose), 1e-5
    slope = solver.sensitivity(shape, pose)
    names = ["points", "end_force", "moments", "clip_forces", "clip_at", "min_bend_radius"]
    names += ["clip_moments", "places"] if case != "pinned" else []
    for column, move, work in moves_of(solver.model, pose):
        ahead, back = (solver.solve(move(h), warm=shape) for h in (step, -step))
        for name in names:
            change = (np.array(getattr(ahead, name)) - getattr(back, name)) / (2 * step)
            own = getattr(slope, name)[..., column]
            assert own == pytest.approx(change, rel=1e-6, abs=1e-6), (column, name)
        if work is None:
            clip = (column - (12 if solver.model.in_space else 4)) // (4 if case == "pinned" else 7)
            own = slope.energy_by_at[clip if solver.model.in_space else 0]
        else:
            own = work(shape)
        change = (ahead.energy - back.energy) / (2 * step)
        assert own == pytest.approx(change, abs=1e-6), column


def test_joints_at_their_bounds_beside_a_saddle(with_saddle):
    """A stretch turns by more than its joints may: they press, and the saddle does not give way."""
    solver, p, rest = with_saddle
    saddle = HeldClip("clamped", (0.1, 0.11), 0.25, heading=-1.3)
    pose = HeldPose((0.0, 0.0), (0.5, 0.1), start_heading=-1.0, end_heading=0.3, clips=(saddle,))
    shape, step = solver.solve(pose), 1e-6
    x = np.ravel(shape.x)
    assert abs(x[6] - x[5]) == pytest.approx(np.pi / 2, abs=1e-9)  # node 6 is the saddle's
    eq = solve_equilibrium(solver.model, p, rest, pose)
    assert shape.energy == pytest.approx(eq.energy, rel=1e-8)
    assert x == pytest.approx(np.ravel(eq.x), abs=1e-7)
    slope = solver.sensitivity(shape, pose)
    for column, move, _ in moves_of(solver.model, pose):
        ahead, back = (solver.solve(move(h), warm=shape) for h in (step, -step))
        for name in ("points", "end_force", "clip_forces", "clip_moments"):
            change = (np.array(getattr(ahead, name)) - getattr(back, name)) / (2 * step)
            size = max(np.abs(change).max(), 1.0)
            own = getattr(slope, name)[..., column]
            assert own == pytest.approx(change, abs=1e-5 * size), (column, name)


def test_a_pinned_clip_grips_by_the_force_along_the_cable():
    """It is the derivative of the energy by its arc length, but for the mesh."""
    errors = []
    for n in (12, 24):
        solver, *_ = compiled(loom(n=n))
        shape = solver.solve(POSE)
        slope = solver.sensitivity(shape, POSE)
        errors.append(np.abs(slope.energy_by_at / shape.clip_grip - 1).max())
    assert errors[1] < 2e-3
    assert errors[1] < errors[0] / 8


def test_a_path_moves_its_clips(two):
    solver, *_ = two
    ways = [
        replace(POSE, clips=(CLIPS[0], replace(CLIPS[1], at=0.68 + 0.01 * k, place=place)))
        for k, place in enumerate([(0.55, 0.1, 0.05), (0.56, 0.1, 0.06), (0.56, 0.12, 0.07)])
    ]
    path = solver.path(ways)
    assert path.first_jump is None
    for shape, pose in zip(path.shapes, ways, strict=True):
        assert shape.energy == pytest.approx(solver.solve(pose, warm=shape).energy, rel=1e-12)


@pytest.mark.parametrize(
    ("first", "status"),
    [
        (HeldClip("pinned", (0.3, 0.1, -0.05), 0.7), "bad_argument"),  # behind the second one
        (HeldClip("pinned", (0.3, 0.3, -0.05), 0.36), "unreachable"),
        (HeldClip("pinned", (0.3, float("nan"), -0.05), 0.36), "not_finite"),
    ],
)
def test_clips_that_cannot_be(two, first, status):
    solver, *_ = two
    found = solver.solve(replace(POSE, clips=(first, CLIPS[1])), throw=False)
    assert found.status == status
    assert not found.points.any()


def test_two_clips_in_one_element_have_a_node_each(two):
    solver, p, rest = two
    pose = replace(POSE, clips=(HeldClip("pinned", (0.545, 0.1, 0.05), 0.67), CLIPS[1]))
    assert_agree(solver.solve(pose), solve_equilibrium(solver.model, p, rest, pose))


@pytest.mark.parametrize("obstacles", [0, 1])
def test_a_saddle_at_the_first_node_has_no_equilibrium_as_in_python(obstacles):
    """Nothing turns between the clamped start and a saddle one element behind it."""
    model = CableModel(FLAT, 12, start="clamped", end="clamped", clips=("clamped",), n_rest=0)
    rest = np.zeros(model.chain.n_rests)
    ends = {"start_heading": 0.0, "end_heading": 0.0}
    clip = HeldClip("clamped", (0.06, 0.0), 0.083, heading=0.0)
    pose = HeldPose((0.0, 0.0), (0.7, 0.1), clips=(clip,), **ends)
    solver = CompiledSolver(model, model.nominal, rest, flags=QUICK, obstacles=obstacles)
    assert solver.solve(pose, throw=False).status == "iteration_limit"
    with pytest.raises(DloError, match="no equilibrium found"):
        solve_equilibrium(model, model.nominal, rest, pose)


def test_a_cable_with_clips_is_the_same_cable(two):
    solver, p, rest = two
    bare = CasadiCable(loom(0), p, rest)
    assert bare.with_clips(["pinned", "pinned"]).model == solver.model
    assert bare.with_clips(["pinned"]).with_clips([]).model == bare.model


def test_the_example_solves_a_pose_with_clips(two, tmp_path):
    two[0].source.write(tmp_path)
    flags = ["-std=c99", "-O0", "-Wall", "-Wextra", "-Werror", "-o", "example"]
    command = ["cc", *flags, "example.c", "dlo_solver.c", "-lm"]
    subprocess.run(command, cwd=tmp_path, check=True)
    run = subprocess.run(["./example"], cwd=tmp_path, capture_output=True, text=True)
    assert run.returncode == 0, run.stderr
    assert "bend radius" in run.stdout


def test_poses_with_other_clips(two):
    with pytest.raises(DloError, match="the pose has the clips pinned, the solver pinned, pinned"):
        two[0].solve(replace(POSE, clips=CLIPS[:1]))


def test_two_tethers_in_one_element_are_refused():
    """Python solves such a cable; the solver's table has a row for one."""
    tethers = (Tether(), Tether(label="tether_2"))
    model = loom(0, tethers)
    values = TETHER | {name.replace("tether.", "tether_2."): x for name, x in TETHER.items()}
    at_end = values | {"tether.position": 0.999, "tether_2.position": 1.0}
    for own in (values, at_end):
        with pytest.raises(DloError, match=r"two tethers are in one of the .* elements"):
            compiled(model, own)


def test_a_saddle_that_is_turned():
    clip = HeldClip("clamped", (0.31, 0.05), 0.37, heading=0.3)
    model = CableModel(FLAT, 12, n_rest=0, clips=("clamped",), effects=(ClipAngle(),))
    solver, p, rest = compiled(model, {"clip_angle.heading_error": 0.2})
    pose = HeldPose((0.0, 0.0), (0.75, 0.1), clips=(clip,))
    assert_agree(solver.solve(pose), solve_equilibrium(model, p, rest, pose))


def test_a_saddle_and_a_swivel_in_space_that_are_turned():
    first = HeldClip("clamped", (0.3, 0.1, -0.05), 0.36, orientation=turned(0.2, 0.1, 0.4))
    second = replace(SWIVEL, place=CLIPS[1].place, at=0.68)
    effects = (ClipAngle(), ClipAngle(clip=1))
    model = loom(("clamped", "swivel"), effects, start="pinned", end="pinned")
    errors = {"y": 0.2, "z": -0.15}
    values = {f"{effect.label}.{key}": x for effect in effects for key, x in errors.items()}
    solver, p, rest = compiled(model, values)
    free = {"start_orientation": None, "end_orientation": None}
    pose = replace(POSE, clips=(first, second), **free)
    assert_agree(solver.solve(pose), solve_equilibrium(model, p, rest, pose))


@pytest.mark.parametrize("stiffness", [0.0, pytest.param(40.0, marks=pytest.mark.long)])
def test_a_tether_to_a_cable_with_a_free_end(stiffness):
    model = loom(0, (Tether(),), end="free")
    solver, p, rest = compiled(model, TETHER | {"tether.stiffness": stiffness})
    pose = replace(POSE, end=None, end_orientation=None, clips=())
    assert_agree(solver.solve(pose), solve_equilibrium(model, p, rest, pose))


MOVED = {"clip_offset.dx": 0.01, "clip_slip.ds": 0.02}


@pytest.mark.parametrize(
    ("ends", "clips", "effects", "more"),
    [
        pytest.param(("clamped", "clamped"), (), (), {}, marks=pytest.mark.long),
        (
            ("clamped", "clamped"),
            CLIPS[:1],
            (Tether(), ClipOffset(), ClipSlip()),
            TETHER | MOVED,
        ),
        (("clamped", "swivel"), (), (), {}),
        (("swivel", "swivel"), (), (), {}),
    ],
    ids=["alone", "with a tether beside a clip that has moved", "and a swivel", "two swivels"],
)
def test_clamps_in_space_that_give_way(ends, clips, effects, more):
    """Their moments are minus the energy's derivative by turns of the clamps."""
    held = {"start": ends[0], "end": ends[1]}
    model = replace(loom(len(clips), (ClampCompliance(), *effects)), **held)
    values = {"clamp_compliance.start": 8.0, "clamp_compliance.end": 0.5} | more
    solver, p, rest = compiled(model, values)
    pose = replace(POSE, clips=clips)
    shape = solver.solve(pose)
    assert_agree(shape, solve_equilibrium(model, p, rest, pose))
    slope, step = solver.sensitivity(shape, pose), 1e-5
    for side, column in (("start", 3), ("end", 9)):
        for axis in range(3):
            ways = [moved(pose, column + axis, h) for h in (step, -step)]
            ahead, back = (solver.solve(way, warm=shape) for way in ways)
            own = shape.moments[int(side == "end")][axis]
            assert -own == pytest.approx((ahead.energy - back.energy) / (2 * step), abs=1e-8)
            for name in ("points", "end_force", "moments"):
                change = (getattr(ahead, name) - getattr(back, name)) / (2 * step)
                found = getattr(slope, name)[..., column + axis]
                assert found == pytest.approx(change, abs=1e-7), (side, axis, name)


def test_turns_of_the_end_are_those_beyond_the_last_saddle():
    """Four rolled saddles twist the cable by 1.7 turns, which the end's turns do not count."""
    model = replace(loom(0), clips=("clamped",) * 4, n=20)
    saddles = tuple(
        HeldClip(
            "clamped", (0.1998 * k, 0, 0), 0.2 * k, orientation=turned(k * np.radians(150), 0, 0)
        )
        for k in range(1, 5)
    )
    pose = replace(
        POSE,
        end=(0.999, 0.0, 0.0),
        start_orientation=turned(0, 0, 0),
        end_orientation=saddles[-1].orientation,
        clips=saddles,
        turns=1.0,
    )
    solver, p, rest = compiled(model)
    assert_agree(solver.solve(pose), solve_equilibrium(model, p, rest, pose))


@pytest.mark.parametrize(("element", "position"), [("quadratic", 0.02), ("arc", 0.7)])
def test_a_tether_in_a_plane(element, position):
    model, pose = flat(effects=(Tether(),), element=element)
    values = {name: x for name, x in TETHER.items() if not name.endswith("_z")}
    values["tether.position"] = position
    solver, p, rest = compiled(model, values)
    assert_agree(solver.solve(pose), solve_equilibrium(model, p, rest, pose))


def test_a_tether_to_links():
    model, _ = flat(effects=(Tether(),), element="link")
    with pytest.raises(DloError, match="a cable of links with a tether"):
        generate(model, model.nominal, np.zeros(model.chain.n_rests))


def test_a_path_turns_a_saddle():
    model, pose = flat(FLAT_SADDLE, FLAT_EYELET)
    solver, *_ = compiled(model)
    ways = [
        replace(pose, clips=(replace(FLAT_SADDLE, at=0.36 + 0.03 * k, heading=h), FLAT_EYELET))
        for k, h in enumerate([0.3, 0.2, 0.0])
    ]
    path = solver.path(ways)
    assert path.first_jump is None
    for shape, way in zip(path.shapes, ways, strict=True):
        assert shape.energy == pytest.approx(solver.solve(way, warm=shape).energy, rel=1e-12)


@pytest.mark.parametrize(
    ("clips", "status"),
    [
        ((FLAT_CLIPS[1], FLAT_CLIPS[0]), "bad_argument"),  # the wrong way round
        ((FLAT_CLIPS[0], replace(FLAT_CLIPS[1], place=(0.9, 0.4))), "unreachable"),
    ],
)
def test_clips_in_a_plane_that_cannot_be(clips, status):
    model, pose = flat(*FLAT_CLIPS)
    solver, *_ = compiled(model)
    assert solver.solve(replace(pose, clips=clips), throw=False).status == status


@pytest.mark.long
@pytest.mark.parametrize("case", ["tether", "in space", "in a plane", "among obstacles"])
def test_sanitizers_are_silent(tmp_path, case):
    model, values = loom(1, (Tether(),), n=6), TETHER
    if case == "among obstacles":
        model, values = loom(0, n=6), {}
    elif case != "tether":
        clips = (FLAT_EYELET, replace(FLAT_SADDLE, at=0.6))
        model = flat(*clips)[0] if case == "in a plane" else loom(("swivel", "eyelet"), n=6)
        values = {}
    obstacles = 2 if case == "among obstacles" else 0
    generate(model, *numbers(model, values), obstacles=obstacles).write(tmp_path)
    shutil.copy(memory.HERE / "memory.c", tmp_path)
    flags = ("-O0", "-fsanitize=address,undefined", "-fno-sanitize-recover=all")
    assert memory.build_and_run(tmp_path, flags, [], 5, threads=2).startswith("silent")
