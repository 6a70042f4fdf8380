"""A cable in motion in C: steps are those of Python, statuses and derivatives are what they say."""

import shutil
import subprocess
from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from solvers import QUICK, STRICT

from dlo_casadi.codegen import CompiledSolver
from dlo_casadi.codegen.compiler import compile_library
from dlo_casadi.codegen.generate import generate
from dlo_casadi.codegen.statuses import STATUSES
from dlo_casadi.effects import (
    AirDrag,
    CableData,
    LumpedMass,
    PinFriction,
    Tether,
    TurningLoss,
    ViscousDrag,
)
from dlo_casadi.effects.stiffness import DynamicStiffness
from dlo_casadi.equilibrium.pose import HeldPose
from dlo_casadi.equilibrium.solve import solve_equilibrium
from dlo_casadi.errors import DloError
from dlo_casadi.model.cable_model import CableModel
from dlo_casadi.motion import steps
from dlo_casadi.motion.modes import damped_modes
from dlo_casadi.motion.step_function import fixtures_vector, state_vector, step_function
from dlo_casadi.motion.steps import RHO, Moving, Scheme, Stepper, begun_by, first_step
from dlo_casadi.motion.system import MovingCable

pytestmark = pytest.mark.skipif(shutil.which("cc") is None, reason="no C compiler (cc)")

DT, SCHEME = 0.004, Scheme.of(RHO)
VALUES = {
    "lumped_mass.mass": 0.01,
    "lumped_mass.position": 0.2,
    "tether.stiffness": 3.0,
    "tether.position": 0.35,
    "tether.anchor_y": 0.3,
    "air_drag.coefficient": 1.1,
    "viscous_drag.rate": 0.02,
    "pin_friction.moment": 1e-3,
    "turning_loss.share": 0.5,
    "dynamic_stiffness.factor": 1.1,
}
CASES = [
    (2, "clamped", "free"),
    (2, "pinned", "pinned"),
    pytest.param((2, "clamped", "clamped"), marks=pytest.mark.long, id="2, clamped to clamped"),
    (3, "pinned", "pinned"),
    pytest.param((3, "clamped", "free"), marks=pytest.mark.long, id="3, clamped to free"),
    (3, "clamped", "swivel"),
]


def model_of(dimension, start, end, n=10):
    """A cable with everything that damps, a mass and a tether."""
    effects = [LumpedMass(), Tether(), AirDrag(), ViscousDrag()]
    effects += [PinFriction()] * ("pinned" in (start, end)) + [TurningLoss()] * (dimension == 3)
    data = CableData(0.6, 0.06, 0.008, 0.009, damping_time=0.02)
    if dimension == 3:
        data = replace(data, torsional_stiffness=0.006)
    gravity = (*(0.0,) * (dimension - 1), -9.81)
    return CableModel(data, n, start=start, end=end, gravity=gravity, effects=tuple(effects))


def values_of(model):
    return np.array([VALUES.get(q.name, q.nominal) for q in model.parameters])


def pose_of(model):
    d, held = model.node.dimension, {}
    if model.end.place:
        held["end"] = (0.4, 0.1, 0.05)[:d]
    for side, kind in (("start", model.start), ("end", model.end)):
        if kind.direction:
            name = "heading" if d == 2 else "orientation"
            held[f"{side}_{name}"] = 0.3 if d == 2 else (0.1, 0.0, 0.0, np.sqrt(0.99))
    return HeldPose(start=(0.0,) * d, **held)


class Swinging:
    """A cable at rest in Python and in C, and fixtures that are shaken."""

    def __init__(self, model):
        self.model = model
        p = values_of(model)
        rest = model.rest_basis @ np.full(model.n_coefficients, 0.5)
        self.solver = CompiledSolver(model, p, rest, flags=QUICK, motion=True)
        self.c, self.pose = self.solver.motion, pose_of(model)
        shape = self.solver.solve(self.pose)
        eq = solve_equilibrium(model, p, rest, self.pose)
        self.cable = self.c.cable.about(eq.x)
        self.state = self.cable.at_rest(eq, self.at(0.0))
        record = self.solver._record_of(type(shape), shape)
        self.motion, self.status = self.c.rest(self.at(0.0), record)

    def at(self, t):
        """Fixtures that are shaken aside by some centimetres, and turned."""
        w, model, pose = 7.0, self.model, self.pose.vector.copy()
        d, c = model.node.dimension, model.node.coordinates
        aside = np.zeros((2, d))
        aside[0, 0], aside[1, 1] = 0.015, 0.01
        pose[: 2 * d] += ((1 - np.cos(w * t)) * aside).ravel()
        turn = np.full(model.node.increment, 0.05 * (1 - np.cos(w * t)))
        pose[2 * d : 2 * d + c] = model.node.moved(pose[2 * d : 2 * d + c], turn)
        rates = w * np.sin(w * t) * aside, w**2 * np.cos(w * t) * aside
        return self.c.cable.fixtures(pose, *rates)


@pytest.fixture(scope="module", params=CASES, ids=lambda x: f"{x[0]}, {x[1]} to {x[2]}")
def swinging(request):
    return Swinging(model_of(*request.param))


def test_the_cable_at_rest_is_that_of_python_and_stays(swinging):
    assert swinging.status == "ok"
    found = swinging.c.moving(swinging.motion).state
    for name in ("r", "force", "moment"):
        difference = getattr(found, name) - getattr(swinging.state, name)
        assert np.abs(difference).max(initial=0.0) < 1e-8, name
    np.testing.assert_allclose(swinging.motion["still"][0], swinging.cable.still, atol=1e-6)
    now, none = swinging.motion, np.zeros((2, swinging.cable.d))
    still = replace(swinging.at(0.0), velocities=none, accelerations=none)
    for _ in range(10):
        now, status = swinging.c.advance(now, still, 0.05)
        assert status == "ok"
    assert np.abs(now["r"] - swinging.motion["r"]).max() < 1e-9


def assert_steps_agree(swinging, monkeypatch):
    """To 1e-8 of places, where Python's steps end as exactly; forces as they change with places."""
    monkeypatch.setattr(steps, "LAST_STEP", 1e-10)
    stepper, state = Stepper(swinging.cable, SCHEME), swinging.state
    python = Moving(state, np.hstack([state.alpha, state.a]))
    c, worst = swinging.c.recorded(python), 0.0
    c["still"] = swinging.cable.still
    for k in range(100):
        fixtures = swinging.at((k + 1) * DT)
        python = stepper.step(python, fixtures, DT)
        c, status = swinging.c.advance(c, fixtures, DT)
        assert status == "ok"
        worst = max(worst, float(np.abs(c["r"] - python.state.r).max()))
        assert np.abs(c["r"][0, 0] - fixtures.places[0]).max() == 0.0
    assert worst < 1e-8
    rows = swinging.cable.segments("quantities", python.state)[3][..., 0]
    d = swinging.cable.d
    assert c["end_force"][0] == pytest.approx(
        -rows[-1, d:] if swinging.model.end.place else np.zeros(d), abs=1e-5
    )


def test_a_hundred_steps_are_those_of_python(swinging, monkeypatch):
    assert_steps_agree(swinging, monkeypatch)


def test_a_dynamic_stiffness_is_that_of_python(monkeypatch):
    """Of changes from the strains of the shape at rest, as the state carries them."""
    model = model_of(2, "clamped", "free")
    swinging = Swinging(replace(model, effects=(*model.effects, DynamicStiffness())))
    assert_steps_agree(swinging, monkeypatch)


def test_the_first_accelerations_are_those_of_python(swinging):
    """Of a cable at rest whose fixtures begin to move."""
    state, fixtures = swinging.state, swinging.at(DT)
    python = begun_by(state, first_step(swinging.cable, state, fixtures, DT))
    begun = swinging.c.recorded(Moving(state, python.own))
    begun["still"] = swinging.cable.still
    c, status = swinging.c.start(begun, fixtures, DT)
    assert status == "ok"
    np.testing.assert_allclose(c["mean"][0], python.own, rtol=1e-5, atol=1e-4)
    np.testing.assert_array_equal(c["x"], begun["x"])


def test_derivatives_of_steps_are_those_of_differences(swinging):
    """By the end's or the start's place, through 5 steps; relative to the largest one."""
    model, d = swinging.model, swinging.cable.d
    side, sizes = int(model.end.place), (3e-7, 3e-4)  # m, rad
    given = np.zeros(2, swinging.c.given)
    given["place"][0, side, 0] = 1.0  # aside, and turning the start
    given["turn"][1, 0, 0] = 1.0
    columns = np.zeros(2, swinging.c.slope)
    moved = [swinging.motion.copy() for _ in range(4)]
    now = swinging.motion
    for k in range(5):
        t = (k + 1) * DT
        fixtures, before = swinging.at(t), now
        now, status = swinging.c.advance(before, fixtures, DT)
        assert status == "ok"
        columns, status = swinging.c.slopes(before, now, fixtures, given, columns)
        assert status == "ok"
        for m, sign in enumerate((1, -1, 1, -1)):
            pose = fixtures.pose.copy()
            if m < 2:
                pose[side * d] += sign * sizes[0]
            else:
                own = slice(2 * d, 2 * d + model.node.coordinates)
                turn = sign * sizes[1] * np.eye(model.node.increment)[0]
                pose[own] = model.node.moved(pose[own], turn)
            other = replace(fixtures, pose=pose)
            moved[m], status = swinging.c.advance(moved[m], other, DT)
            assert status == "ok"
    for name in ("r", "v", "a", "start_force", "end_force"):
        for q in range(2):
            expected = (moved[2 * q][name] - moved[2 * q + 1][name])[0] / (2 * sizes[q])
            scale = max(np.abs(expected).max(), 1e-3)
            assert np.abs(columns[name][q] - expected).max() < 1e-5 * scale, (name, q)


def test_modes_are_those_of_python(swinging):
    """Of the cable at rest in C: frequencies to 1e-8, damping ratios to 1e-7."""
    fixtures, c = swinging.at(0.0), swinging.c
    (frequencies, ratios), status = c.modes(fixtures, swinging.motion, 4)
    assert status == "ok"
    cable = swinging.cable
    expected = damped_modes(cable, c.moving(swinging.motion).state, fixtures, 4)
    known = expected.rates / (2 * np.pi)
    swings = known > 1e-3 * known.max()  # not the roll of a cable that is free to roll
    assert np.array_equal(frequencies > 1e-3 * known.max(), swings)
    np.testing.assert_allclose(frequencies[swings], known[swings], rtol=1e-8)
    np.testing.assert_allclose(
        ratios[swings], expected.damping_ratios[swings], rtol=1e-6, atol=1e-7
    )
    assert c.modes(fixtures, swinging.motion, 7)[1] == "bad_argument"


def test_what_cannot_be_is_told(swinging):
    c, fixtures = swinging.c, swinging.at(0.0)
    assert c.advance(swinging.motion, fixtures, 0.0)[1] == "bad_argument"
    assert c.advance(swinging.motion, fixtures, -0.1)[1] == "bad_argument"
    assert c.advance(np.zeros(1, c.record), fixtures, DT)[1] == "bad_argument"
    broken = swinging.motion.copy()
    broken["v"][0, 1] = np.nan
    found, status = c.advance(broken, fixtures, DT)
    assert status == "not_finite"
    assert not found.tobytes().strip(b"\0")
    odd = replace(fixtures, velocities=np.full_like(fixtures.velocities, np.inf))
    assert c.advance(swinging.motion, odd, DT)[1] == "not_finite"
    size, c._work = c._work, c._work[:-1]
    assert c.advance(swinging.motion, fixtures, DT)[1] == "workspace_too_small"
    c._work = size
    if swinging.model.end.place:
        pose = fixtures.pose.copy()
        pose[swinging.cable.d] += 5.0
        found, status = c.advance(swinging.motion, replace(fixtures, pose=pose), DT)
        assert status == "no_step"
        assert not found["r"].any()


@pytest.mark.parametrize("dimension", [2, pytest.param(3, marks=pytest.mark.long)])
def test_no_compiler_warns(dimension, tmp_path):
    model = model_of(dimension, "pinned", "pinned", n=3)
    p = values_of(model)
    solver = generate(model, p, np.zeros(model.chain.n_rests), motion=True, inline=dimension == 2)
    compile_library(solver, tmp_path, STRICT)


def test_what_motion_does_not_know_is_refused():
    model = replace(model_of(2, "pinned", "pinned"), clips=("pinned",))
    p = values_of(model)
    with pytest.raises(DloError, match="clips: recorded motions"):
        generate(model, p, np.zeros(model.chain.n_rests), motion=True)
    bare = replace(model, clips=())
    with pytest.raises(DloError, match="contact in motion is not known"):
        generate(bare, p, np.zeros(bare.chain.n_rests), motion=True, obstacles=1)


@pytest.mark.parametrize("dimension", [2, pytest.param(3, marks=pytest.mark.long)])
def test_the_loop_of_the_example_runs_under_sanitizers(dimension, tmp_path):
    """A thousand steps with derivatives, whose forces are those of a swaying cable."""
    model = model_of(dimension, "clamped", "pinned", n=5)
    model = replace(model, effects=tuple(x for x in model.effects if x.label != "tether"))
    generate(model, values_of(model), np.zeros(model.chain.n_rests), motion=True).write(tmp_path)
    flags = (*QUICK, "-fsanitize=address,undefined", "-fno-sanitize-recover=all")
    command = ["cc", "-std=c99", *flags, "loop.c", "dlo_solver.c", "-lm", "-o", "loop"]
    subprocess.run(command, cwd=tmp_path, check=True, capture_output=True, text=True)
    run = subprocess.run([tmp_path / "loop"], capture_output=True, text=True, check=False)
    assert run.returncode == 0, run.stderr
    lines = run.stdout.splitlines()
    assert len(lines) == 6
    start = [float(line.split("start ")[1].split(" m")[0]) for line in lines[:5]]
    expected = [0.06 * (1 - np.cos(6.0 * t)) / 2 for t in (0.2, 0.4, 0.6, 0.8, 1.0)]
    assert start == pytest.approx(expected, abs=1e-4)


def along_unit_frames(model, state):
    """Projects changes of a state on those that keep the length of quaternions."""
    c, nodes = model.node.coordinates, state.reshape(model.chain.n_nodes, -1)
    projector = np.eye(state.size)
    for k, node in enumerate(nodes if c > 1 else []):
        q, at = node[:c], slice(k * nodes.shape[1], k * nodes.shape[1] + c)
        projector[at, at] -= np.outer(q, q) / (q @ q)
    return projector


@pytest.mark.parametrize("case", [(2, "pinned", "clamped"), (3, "clamped", "pinned")])
def test_the_step_in_casadi_is_that_of_python(case, tmp_path):
    """Value and Jacobian; both steps end within 1e-9, Python's Jacobian is that of its own end."""
    model = model_of(*case, n=6)
    model = replace(model, effects=tuple(x for x in model.effects if x.label != "tether"))
    p, rest = values_of(model), np.zeros(model.chain.n_rests)
    source = generate(model, p, rest, "rope", motion=True)
    library = compile_library(source, tmp_path, (*QUICK, f"-DROPE_STEP={DT}"))
    external, cable = ca.external("rope_moved", str(library)), MovingCable(model, p, rest)
    pose = pose_of(model)
    eq = solve_equilibrium(model, p, rest, pose)
    still = cable.fixtures(pose.vector)
    state = cable.at_rest(eq, still)
    state = state_vector(Moving(state, np.hstack([state.alpha, state.a])))
    rng, function = np.random.default_rng(0), step_function(cable, DT)
    both = external.jacobian(), function.jacobian()
    for _ in range(2):
        own = fixtures_vector(cable, still)
        own[: 2 * cable.d] += 1e-4 * rng.normal(size=2 * cable.d)
        found, expected = external(state, own), function(state, own)
        assert external.name_out() == [*function.name_out(), "status"]
        assert found[4] == 0
        for value, other in zip(found[:4], expected, strict=False):
            scale = max(float(np.abs(np.array(other)).max()), 1.0)
            np.testing.assert_allclose(np.array(value), np.array(other), atol=1e-6 * scale)
        slopes, known = both[0](state, own, *found), both[1](state, own, *expected)
        along = along_unit_frames(model, state)
        for k in range(8):
            slope, other = np.array(slopes[k]), np.array(known[k])
            if k < 2:
                other = along_unit_frames(model, np.array(found[0]).ravel()) @ other
            if k % 2 == 0:
                slope, other = slope @ along, other @ along
            scale = max(float(np.abs(other).max()), 1.0)
            np.testing.assert_allclose(slope, other, atol=1e-6 * scale)
        state = np.array(found[0]).ravel()
    own[cable.d] += 5.0
    *numbers, status = external(state, own)
    assert status == STATUSES.index("no_step")
    assert all(np.isnan(np.array(x)).all() for x in numbers)
