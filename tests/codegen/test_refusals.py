"""Likely slips in calls of the generated solver: messages and statuses say what is wrong."""

import shutil
from dataclasses import replace

import numpy as np
import pytest

from dlo_casadi.codegen import CompiledSolver, Plane, generate
from dlo_casadi.codegen.generate import solver_hash
from dlo_casadi.codegen.shapes import pose_table
from dlo_casadi.effects import CableData
from dlo_casadi.equilibrium.pose import HeldPose
from dlo_casadi.errors import DloError, EquilibriumError
from dlo_casadi.model.cable_model import CableModel
from dlo_casadi.model.clips import HeldClip

pytestmark = pytest.mark.skipif(shutil.which("cc") is None, reason="no C compiler (cc)")

CABLE = CableData(0.8, 0.2, 0.01, 0.05)
TABLE = Plane((0.0, -0.6), (0.0, 1.0))
FLAT = Plane((0.0, -0.6), (0.0, 0.0))
CLIP = HeldClip("pinned", (0.25, -0.1), 0.4)
POSE = HeldPose((0.0, 0.0), (0.5, 0.1), clips=(CLIP,))


@pytest.fixture(scope="module")
def model():
    return CableModel(CABLE, 6, clips=("pinned",), n_rest=0)


@pytest.fixture(scope="module")
def solver(model):
    return CompiledSolver(
        model, model.nominal, np.zeros(model.chain.n_rests), flags=("-O0",), obstacles=1
    )


@pytest.fixture(scope="module")
def failed(solver):
    """The empty shape of a pose out of reach."""
    shape = solver.solve(replace(POSE, end=(0.9, 0.0)), throw=False)
    assert shape.status == "unreachable"
    return shape


def test_a_failed_shape_has_no_clearance_and_no_limits(solver, failed):
    for ask in (solver.clearance, lambda shape, given: solver.limits(shape, {}, given)):
        with pytest.raises(DloError, match=r"bad_argument.* 'unreachable'.*\n  Try: a shape whose"):
            ask(failed, [TABLE])


def test_directions_of_clamps_and_saddles_are_needed_in_space():
    cable, held = replace(CABLE, torsional_stiffness=0.04), {"start": "clamped", "end": "clamped"}
    model = CableModel(cable, 6, gravity=(0.0, 0.0, -9.81), clips=("clamped",), **held)
    ahead = (0.0, 0.0, 0.0, 1.0)
    saddle = HeldClip("clamped", (0.3, 0.0, -0.1), 0.4, orientation=ahead)
    pose = HeldPose((0.0,) * 3, (0.5, 0.0, 0.1), clips=(saddle,), start_orientation=ahead)
    with pytest.raises(DloError, match=r"holds the direction, give end_orientation \[qx"):
        pose_table(model, [pose])
    pose = replace(pose, end_orientation=ahead)
    assert np.isfinite(pose_table(model, [pose])[0]).all()
    pose = replace(pose, clips=(replace(saddle, orientation=None),))
    with pytest.raises(DloError, match=r"holds the direction, give the orientation of clip 1 \[qx"):
        pose_table(model, [pose])


def test_a_failed_shape_is_no_start(solver, failed):
    assert solver.solve(POSE, warm=failed, throw=False).status == "bad_argument"
    assert solver.step(failed, POSE).status == "bad_argument"
    path = solver.path([POSE, POSE], warm=failed)
    assert [shape.status for shape in path.shapes] == ["bad_argument", "ok"]
    assert path.first_jump == 0
    with pytest.raises(EquilibriumError, match="bad_argument"):
        solver.sensitivity(failed, POSE)
    with pytest.raises(EquilibriumError, match="a warm start whose status is ok"):
        solver.solve(POSE, warm=failed)


@pytest.mark.parametrize(
    ("call", "said"),
    [
        (lambda s, x: s.solve_many(POSE), r"a list of poses .*\n  Try: \[pose\]"),
        (lambda s, x: s.path(POSE), r"a list of poses .*\n  Try: \[pose\]"),
        (lambda s, x: s.solve(POSE, obstacles=TABLE), r"obstacles is a list, .*Plane"),
        (lambda s, x: s.clearance(x, TABLE), r"obstacles is a list, .*Plane"),
        (lambda s, x: s.solve(POSE, obstacles=[FLAT]), "a plane must not be zero, found Plane"),
        (
            lambda s, x: s.step(x, POSE, steps=2**32 + 4),
            "steps: a whole number .* found 4294967300",
        ),
        (lambda s, x: s.limits(x, {"force": "3"}), "positive and finite, found force '3'"),
        (lambda s, x: s.limits(x, {"force": np.inf}), "positive and finite, found force inf"),
    ],
)
def test_slips_in_calls(solver, call, said):
    with pytest.raises(DloError, match=said):
        call(solver, solver.solve(POSE))


def test_a_clip_in_space_on_a_cable_in_a_plane(solver):
    deep = replace(POSE, clips=(replace(CLIP, place=(0.25, -0.1, 0.0)),))
    with pytest.raises(DloError, match="the place of clip 1 must have 2 numbers"):
        solver.solve(deep)


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"prefix": 3}, "the prefix 3 is not a C identifier"),
        ({"obstacles": True}, "a whole number, 0 to 1000, found True"),
    ],
)
def test_slips_in_generate(model, options, said):
    with pytest.raises(DloError, match=said):
        generate(model, model.nominal, np.zeros(model.chain.n_rests), **options)


def test_the_hash_covers_the_diameter(model):
    thick = replace(model, cable=replace(CABLE, diameter=0.02))
    rest = np.zeros(model.chain.n_rests)
    assert len({solver_hash(one, model.nominal, rest) for one in (model, thick)}) == 2


def test_shapes_and_slopes_of_another_solver(model, solver):
    rest = np.zeros(model.chain.n_rests)
    bare = CompiledSolver(replace(model, clips=()), model.nominal, rest, flags=("-O0",))
    pose = replace(POSE, clips=())
    shape, own = bare.solve(pose), solver.solve(POSE)
    with pytest.raises(DloError, match=r"a CompiledShape of this solver .* clip_forces has the"):
        solver.solve(POSE, warm=shape)
    with pytest.raises(
        DloError, match=r"a Slope of this solver .* points has the shape \(7, 2, 9\)"
    ):
        solver.clearance(own, [TABLE], bare.sensitivity(shape, pose))
    with pytest.raises(DloError, match="a Slope of this solver belongs here, found CompiledShape"):
        solver.clearance(own, [TABLE], own)


def test_a_pose_of_arrays_out_of_reach(solver):
    far = replace(POSE, start=np.zeros(2), end=np.array([0.9, 0.0]))
    with pytest.raises(EquilibriumError, match=r"unreachable with the end at \(0.9000, 0.0000\) m"):
        solver.solve(far)
