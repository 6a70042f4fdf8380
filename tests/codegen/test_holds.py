"""Clips and tethers of generated solvers in space, against Python's equilibria and differences."""

import shutil
import subprocess
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from dlo_casadi.codegen import CompiledSolver, generate
from dlo_casadi.effects import CableData, ClipOffset, ClipSlip, Tether
from dlo_casadi.equilibrium.pose import HeldPose
from dlo_casadi.equilibrium.solve import solve_equilibrium
from dlo_casadi.equilibrium.symbolic import CasadiCable
from dlo_casadi.errors import DloError
from dlo_casadi.model.cable_model import CableModel
from dlo_casadi.model.clips import HeldClip
from scripts.benchmarks import memory


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
TETHER = {
    "tether.stiffness": 40.0,
    "tether.position": 0.7,
    "tether.anchor_x": 0.5,
    "tether.anchor_y": 0.3,
    "tether.anchor_z": 0.2,
}


def loom(clips=2, effects=(), **held):
    held = {"start": "clamped", "end": "clamped", "n": 12, **held}
    kinds = ("pinned",) * clips
    gravity = (0.0, 0.0, -9.81)
    return CableModel(LOOM, n_rest=0, gravity=gravity, clips=kinds, effects=effects, **held)


def numbers(model, values):
    p = model.nominal.copy()
    for name, value in values.items():
        p[model.names.index(name)] = value
    return p, np.full(model.chain.n_rests, 0.3)


def compiled(model, values=()):
    p, rest = numbers(model, dict(values))
    return CompiledSolver(model, p, rest, flags=("-O0",)), p, rest


@pytest.fixture(scope="module")
def two():
    return compiled(loom())


def agree(shape, eq):
    assert shape.energy == pytest.approx(eq.energy, abs=1e-11)
    assert shape.start_force == pytest.approx(eq.start_force, abs=1e-9)
    assert shape.end_force == pytest.approx(eq.end_force, abs=1e-9)
    # A tether's force, where there is one, stands behind those of the clips.
    for own, load in zip(shape.clip_forces[: len(eq.clips)], eq.clips, strict=True):
        assert own == pytest.approx(load.force, abs=1e-9)


def test_two_clips(two):
    solver, p, rest = two
    shape = solver.solve(POSE)
    agree(shape, solve_equilibrium(solver.model, p, rest, POSE))
    # Arcs took 94: a coarse mesh of them has no shape that reaches from clip to clip.
    assert shape.iterations < 80


def test_slopes_by_clips_and_ends_are_differences(two):
    solver, *_ = two
    shape, step = solver.solve(POSE), 1e-5
    slope = solver.sensitivity(shape, POSE)

    def with_clip(k, clip):
        return replace(POSE, clips=(*CLIPS[:k], clip, *CLIPS[k + 1 :]))

    def by_end(axis, h):
        return replace(POSE, end=tuple(np.array(POSE.end) + h * np.eye(3)[axis]))

    def by_start(axis, h):
        return replace(POSE, start=tuple(h * np.eye(3)[axis]))

    def by_place(k, axis, h):
        return with_clip(k, replace(CLIPS[k], place=tuple(CLIPS[k].place + h * np.eye(3)[axis])))

    columns = {12: lambda h: with_clip(0, replace(CLIPS[0], at=CLIPS[0].at + h))}
    columns |= {16: lambda h: with_clip(1, replace(CLIPS[1], at=CLIPS[1].at + h))}
    columns |= {1: lambda h: by_start(1, h), 8: lambda h: by_end(2, h)}
    columns |= {13: lambda h: by_place(0, 0, h), 19: lambda h: by_place(1, 2, h)}
    for column, moved in columns.items():
        ahead, back = (solver.solve(moved(h), warm=shape) for h in (step, -step))
        for name in ("points", "end_force", "moments", "clip_forces", "min_bend_radius"):
            change = (np.array(getattr(ahead, name)) - getattr(back, name)) / (2 * step)
            own = getattr(slope, name)[..., column]
            assert own == pytest.approx(change, rel=1e-4, abs=2e-4), (column, name)
        work = {12: shape.clip_grip[0], 16: shape.clip_grip[1], 1: -shape.start_force[1]}
        work |= {8: -shape.end_force[2], 13: -shape.clip_forces[0][0]}
        work |= {19: -shape.clip_forces[1][2]}
        change = (ahead.energy - back.energy) / (2 * step)
        assert work[column] == pytest.approx(change, abs=1e-6)


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
        (
            HeldClip("pinned", (0.545, 0.1, 0.05), 0.67),
            "bad_argument",
        ),  # in the element of the second
        (HeldClip("pinned", (0.3, 0.3, -0.05), 0.36), "unreachable"),
        (HeldClip("pinned", (0.3, float("nan"), -0.05), 0.36), "not_finite"),
    ],
)
def test_clips_that_cannot_be(two, first, status):
    solver, *_ = two
    found = solver.solve(replace(POSE, clips=(first, CLIPS[1])), throw=False)
    assert found.status == status
    assert not found.points.any()


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


def test_a_tether_beside_a_clip_that_has_moved():
    model = loom(1, (Tether(), ClipOffset(), ClipSlip()))
    values = TETHER | {"clip_offset.dx": 0.01, "clip_slip.ds": 0.02}
    solver, p, rest = compiled(model, values)
    pose = replace(POSE, clips=CLIPS[:1])
    agree(solver.solve(pose), solve_equilibrium(model, p, rest, pose))


@pytest.mark.parametrize("stiffness", [0.0, pytest.param(40.0, marks=pytest.mark.long)])
def test_a_tether_to_a_cable_with_a_free_end(stiffness):
    model = loom(0, (Tether(),), end="free")
    solver, p, rest = compiled(model, TETHER | {"tether.stiffness": stiffness})
    pose = replace(POSE, end=None, end_orientation=None, clips=())
    agree(solver.solve(pose), solve_equilibrium(model, p, rest, pose))


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"clips": ("eyelet",)}, "pinned clips alone, and this cable has eyelet ones"),
        ({"end": "free"}, "not with a free end"),
    ],
)
def test_what_the_solver_cannot_hold(change, said):
    model = replace(loom(1), **change)
    with pytest.raises(DloError, match=said):
        generate(model, model.nominal, np.zeros(model.chain.n_rests))


@pytest.mark.long
def test_sanitizers_are_silent(tmp_path):
    model = loom(1, (Tether(),), n=6)
    generate(model, *numbers(model, TETHER)).write(tmp_path)
    shutil.copy(memory.HERE / "memory.c", tmp_path)
    flags = ("-O0", "-fsanitize=address,undefined", "-fno-sanitize-recover=all")
    assert memory.build_and_run(tmp_path, flags, [], 5, threads=2).startswith("silent")
