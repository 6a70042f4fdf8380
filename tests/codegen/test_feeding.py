"""A cable that is fed through an end: in C as in Python, with its derivatives."""

import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import casadi as ca
import numpy as np
import pytest
from solvers import QUICK, STRICT

import dlo_casadi as dlo
from dlo_casadi.codegen import generate
from dlo_casadi.codegen.compiled import CompiledSolver
from dlo_casadi.codegen.compiler import compile_library
from dlo_casadi.codegen.shapes import pose_table
from dlo_casadi.effects import AxialStretch, LengthError, MassError, Tether
from dlo_casadi.equilibrium.solve import solve_equilibrium
from dlo_casadi.equilibrium.symbolic import CasadiCable
from dlo_casadi.errors import DloError
from dlo_casadi.rod.obstacles import Plane

sys.path.append(str(Path(__file__).parents[1]))

from test_slide import case, held_between, reversed_case

pytestmark = pytest.mark.skipif(shutil.which("cc") is None, reason="no C compiler (cc)")

SPACES = pytest.mark.parametrize(
    "space", [False, pytest.param(True, marks=pytest.mark.long)], ids=["plane", "space"]
)
N = 8
EFFECTS = {
    "mass_error.factor": 1.1,
    "length_error.length_difference": 0.01,
    "axial_stretch.compliance": 1e-3,
}


def fed(space, kinds=(), side="end", by_length=False):
    """Model, parameters, rest strains and pose; without clips straight, with effects."""
    if kinds:
        model, pose, rest = held_between(space, kinds, n=N)
    else:
        model, pose, _ = case(space, 0.8, N, (MassError(), LengthError(), AxialStretch()))
        rest = np.zeros(model.chain.n_rests)
    if side == "start":
        model, pose, rest = reversed_case(model, pose, rest)
    if by_length:
        model = replace(model, fed_by_length=True)
        pose = replace(pose, start_tension=None, end_tension=None, free_length=0.73)
    p = model.nominal.copy()
    for name, value in EFFECTS.items():
        if name in model.names:
            p[model.names.index(name)] = value
    return model, p, rest, pose


CASES = {
    "plane": (False, (), "end"),
    "plane, start": (False, ("eyelet", "pinned"), "start"),
    "plane, clips": (False, ("clamped", "eyelet"), "end"),
    "plane, length": (False, (), "start", True),
    "space": (True, (), "start"),
    "space, clips": (True, ("clamped", "eyelet"), "end"),
    "space, length": (True, ("pinned",), "end", True),
}


@pytest.fixture(scope="module", params=CASES.values(), ids=CASES)
def in_c(request):
    """Model, parameters, rest, pose, and the compiled solver of a case."""
    model, p, rest, pose = fed(*request.param)
    return model, p, rest, pose, CompiledSolver(model, p, rest, flags=QUICK)


def test_the_shape_is_that_of_python(in_c):
    model, p, rest, pose, solver = in_c
    shape, eq = solver.solve(pose), solve_equilibrium(model, p, rest, pose)
    assert shape.energy == pytest.approx(eq.energy, abs=1e-9)
    assert shape.fed == pytest.approx(eq.fed, abs=1e-9)
    assert shape.min_bend_radius == pytest.approx(eq.min_bend_radius, rel=1e-8)
    np.testing.assert_allclose(shape.end_force, eq.end_force, atol=1e-8)
    np.testing.assert_allclose(shape.start_force, eq.start_force, atol=1e-8)
    np.testing.assert_allclose(np.squeeze(shape.moments), eq.moments, atol=1e-8)
    if not model.clips:
        np.testing.assert_allclose(shape.points, eq.points, atol=1e-9)
    for k, load in enumerate(eq.clips):
        assert shape.clip_at[k] == pytest.approx(load.at, abs=1e-9)
        np.testing.assert_allclose(shape.clip_forces[k], load.force, atol=1e-8)


def test_a_shape_to_start_from_is_kept(in_c):
    _, _, _, pose, solver = in_c
    shape = solver.solve(pose)
    for again in (solver.solve(pose, warm=shape), solver.step(shape, pose)):
        assert again.iterations <= 1
        np.testing.assert_allclose(again.points, shape.points, atol=1e-12)


def test_slopes_are_differences(in_c):
    model, _, _, pose, solver = in_c
    d, keys = model.node.dimension, [f"{side}_tension" for side in ("start", "end")]
    if model.fed_by_length:
        keys = ["free_length"]
    shape = solver.solve(pose)
    slope = solver.sensitivity(shape, pose)
    clips = 1 + d + model.node.increment * model.clamped_between
    first = (4 if d == 2 else 12) + clips * len(model.clips)
    moved = {
        first + k: [replace(pose, **{key: getattr(pose, key) + h}) for h in (-1e-5, 1e-5)]
        for k, key in enumerate(key for key in keys if getattr(pose, key) is not None)
    }
    place = np.array(pose.end)
    ends = [tuple(place + h * np.eye(d)[1]) for h in (-1e-5, 1e-5)]
    moved[(0 if d == 2 else 6) + 1] = [replace(pose, end=end) for end in ends]
    for column, both in moved.items():
        before, after = (solver.solve(one, warm=shape) for one in both)
        for name in ("points", "fed", "places", "end_force", "start_force", "moments"):
            change = (np.array(getattr(after, name)) - np.array(getattr(before, name))) / 2e-5
            found = np.array(getattr(slope, name))[..., column]
            atol = 1e-6 * max(np.abs(change).max(), 1)
            np.testing.assert_allclose(found, change, atol=atol, err_msg=name)
        if column >= first:
            energy = (after.energy - before.energy) / 2e-5
            assert slope.energy_by_feed[column - first] == pytest.approx(energy, rel=1e-6)


def test_a_path_is_followed_to_the_shape_there(in_c):
    _, _, _, pose, solver = in_c
    key = next(x for x in ("free_length", "start_tension", "end_tension") if getattr(pose, x))
    value = getattr(pose, key)
    poses = [replace(pose, **{key: share * value}) for share in (1.0, 1.05, 1.1, 1.15)]
    path = solver.path(poses)
    assert path.first_jump is None
    there = solver.solve(poses[-1])
    # Between clips nodes are laid by the way there, to the order of the mesh.
    assert path.shapes[-1].fed == pytest.approx(there.fed, abs=1e-8 if not pose.clips else 1e-3)


@SPACES
def test_the_function_and_its_jacobian_are_those_of_python(space, tmp_path):
    model, p, rest, pose = fed(space, side="end" if space else "start")
    library = str(compile_library(generate(model, p, rest, "wire"), tmp_path, QUICK))
    known, u = CasadiCable(model, p, rest), ca.MX.sym("u", len(pose.numbers))
    external = ca.external("wire_cable", library)(u)
    search = ca.external("wire_equilibrium", library)
    others = known.function()(u), known.function(search=search)(u)
    found = []
    for outs in (external, *others):
        every = ca.veccat(*outs[:4])
        value = ca.Function("value", [u], [every, ca.jacobian(every, u)])
        found.append([np.array(part) for part in value(pose.numbers)])
    for values in zip(*found, strict=True):
        for value in values[1:]:
            np.testing.assert_allclose(value, values[0], atol=1e-7 * np.abs(values[0]).max())


@SPACES
def test_it_lies_on_a_table_as_in_python(space):
    """As in Python nodes alone touch."""
    up = (0.0,) * (1 + space) + (1.0,)
    model, pose, _ = case(space, 0.45, 16)
    model = replace(model, obstacles=(Plane(tuple(-0.05 * np.array(up)), up, "table"),))
    if space:
        down, tilt = (0.0, 0.198669, 0.0, 0.980067), (0.0, -0.099833, 0.149438, 0.983713)
        pose = replace(pose, start_orientation=down, end_orientation=tilt)
    else:
        pose = replace(pose, start_heading=-0.4, end_heading=0.3)
    pose, rest = replace(pose, end=(*pose.end[:-1], 0.0)), np.zeros(model.chain.n_rests)
    flags = (*QUICK, "-DBETWEEN=0")
    shape = CompiledSolver(model, model.nominal, rest, flags=flags).solve(pose)
    eq = solve_equilibrium(model, model.nominal, rest, pose)
    assert eq.contacts
    assert shape.fed == pytest.approx(eq.fed, abs=1e-7)
    assert shape.energy == pytest.approx(eq.energy, abs=1e-7)
    np.testing.assert_allclose(shape.points, eq.points, atol=1e-7)


@SPACES
def test_the_compiler_does_not_warn_and_the_example_runs(space, tmp_path):
    model, p, rest, _ = fed(space, ("eyelet",))
    generate(model, p, rest, "wire").write(tmp_path)
    command = ["cc", "-std=c99", *STRICT, "example.c", "wire_solver.c", "-lm", "-o", "example"]
    run = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True)
    assert run.returncode == 0, run.stderr
    shown = subprocess.run(["./example"], cwd=tmp_path, capture_output=True, text=True)
    assert "bend radius" in shown.stdout, shown.stderr


def test_a_known_cable_is_fed_by_its_tension_or_by_its_length():
    sizes = {"length": 0.6, "mass": 0.06, "diameter": 0.008, "bending_stiffness": 0.009}
    ends = {"gravity": (0, -9.81), "boundary": ("clamped", "slide"), "model": {"n": N}}
    rope = dlo.known_cable(dlo.Cable(**sizes), **ends)
    held = {"start": (0, 0), "start_heading": 0.0, "end": (0.5, 0.0), "end_heading": 0.0}
    for what, told in (("tension", {"end_tension": 2.0}), ("free_length", {"free_length": 0.55})):
        shape, own = rope.solve(**held, **told), rope.fed_by(what)
        pose = dlo.Pose(**held, **told)
        assert own.compile(flags=QUICK).solve(pose).fed == pytest.approx(shape.free_length - 0.6)
        force = np.array(own.function()(pose.held.numbers)[1]).ravel()
        np.testing.assert_allclose(force, shape.end_force, atol=1e-8)
    assert not rope.model.fed_by_length
    with pytest.raises(DloError, match="fed_by: 'tension' or"):
        rope.fed_by("length")
    with pytest.raises(DloError, match="is not fed: its ends are clamped and pinned"):
        dlo.known_cable(dlo.Cable(**sizes), **ends | {"boundary": ("clamped", "pinned")}).fed_by(
            "tension"
        )


def test_what_cannot_be_has_a_message():
    model, p, rest, pose = fed(False)
    with pytest.raises(DloError, match="with a tether that slides through its end"):
        generate(model.with_effect(Tether()), np.append(p, [0.1, 0.2, 0.3, 0.3]), rest)
    with pytest.raises(DloError, match="end_tension is missing"):
        pose_table(model, [replace(pose, end_tension=None)])
