"""Derivatives of a motion through its steps are those of differences."""

import shutil
from dataclasses import replace
from functools import partial

import numpy as np
import pytest

from dlo_casadi.codegen import fit_steps
from dlo_casadi.codegen.fit_steps import CompiledSteps, fastest_steps
from dlo_casadi.effects import AirDrag, CableData, PinFriction, ViscousDrag
from dlo_casadi.equilibrium.pose import HeldPose
from dlo_casadi.equilibrium.solve import solve_equilibrium
from dlo_casadi.model.cable_model import CableModel
from dlo_casadi.motion import sensitivities as derivatives
from dlo_casadi.motion import steps as steps_of_time
from dlo_casadi.motion.sensitivities import Columns, Numbers, Steps, Tangent
from dlo_casadi.motion.state import Fixtures
from dlo_casadi.motion.steps import Moving, begun_by, first_step
from dlo_casadi.motion.system import MovingCable
from dlo_casadi.rod.supports import SupportKind

DT, STEPS = 0.01, 6
PLANE = CableData(0.6, 0.06, 0.008, 0.009, damping_time=0.02)
SPACE = replace(PLANE, torsional_stiffness=0.007)
TURNED = (0.1, 0.2, 0.05, np.sqrt(1 - 0.0525))
CASES = {
    "plane, free": (PLANE, "clamped", "free", {"start": (0.1, 0.6), "start_heading": -0.6}),
    "plane, pinned": (PLANE, "pinned", "pinned", {"start": (0.1, 0.6), "end": (0.5, 0.5)}),
    "space, clamped": (
        SPACE,
        "clamped",
        "pinned",
        {"start": (0.1, 0.2, 0.6), "end": (0.4, 0.4, 0.5), "start_orientation": TURNED},
    ),
}


def model_of(cable: CableData, start: str, end: str) -> CableModel:
    """A coarse model with everything that damps."""
    drag = (AirDrag(), ViscousDrag(), *([PinFriction()] if start == "pinned" else []))
    kinds = SupportKind(start), SupportKind(end)
    gravity = (0.0, 0.0, -9.81) if cable is SPACE else (0.0, -9.81)
    return CableModel(
        cable, 6, start=kinds[0], end=kinds[1], gravity=gravity, effects=drag, n_rest=4
    )


def moved(at: Fixtures, t: float) -> Fixtures:
    """The start shaken aside by 2 cm, from rest."""
    w, shape, pose = 9.0, np.zeros_like(at.places), at.pose.copy()
    shape[0, 0] = 0.02
    pose[0] += (1 - np.cos(w * t)) * shape[0, 0]
    return replace(
        at,
        pose=pose,
        places=at.places + (1 - np.cos(w * t)) * shape,
        velocities=w * np.sin(w * t) * shape,
        accelerations=w**2 * np.cos(w * t) * shape,
    )


def run(
    model: CableModel,
    held: HeldPose,
    p: np.ndarray,
    rest: np.ndarray,
    *,
    columns: bool = False,
    steps: type[Steps] = Steps,
) -> tuple[Moving, Columns | None]:
    """The state after some steps, and its derivatives by p and the rest coefficients."""
    cable = MovingCable(model, p, rest)
    still = cable.fixtures(held.vector)
    state = cable.at_rest(solve_equilibrium(model, p, rest, held), still)
    tried = first_step(cable, state, moved(still, DT), DT)
    assert tried is not None
    now, along, numbers = begun_by(state, tried), None, numbers_of(cable)
    if columns:
        along = derivatives.at_rest(Tangent(cable, state, still), numbers)
        tangent = Tangent(cable, tried.state, moved(still, DT))
        along = derivatives.started(state, tried, along, tangent, numbers, DT)
    stepper = steps(cable)
    for k in range(1, STEPS + 1):
        fixtures = moved(still, k * DT)
        after = stepper.step(now, fixtures, DT)
        assert after is not None
        if along is not None:
            along = stepper.derived(now, after, along, fixtures, numbers, DT)
        now = after
    return now, along


def numbers_of(cable: MovingCable) -> Numbers:
    """One column for each parameter, then for each rest coefficient."""
    n, model = len(cable.p), cable.model
    q = n + model.n_coefficients
    rest = model.chain.rest_inside(model.rest_basis)
    none = np.zeros((2, cable.d, q))
    return Numbers(
        np.eye(n, q),
        np.concatenate([np.zeros((*rest.shape[:2], n)), rest], axis=2),
        np.zeros((2 * cable.b, q)),
        none,
        none,
        none,
    )


def problem(name: str) -> tuple[CableModel, HeldPose, np.ndarray]:
    """A model with its parameters, and where it is held."""
    cable, start, end, fields = CASES[name]
    model = model_of(cable, start, end)
    p = np.array(model.nominal)
    for key, value in {"air_drag.coefficient": 1.0, "viscous_drag.rate": 0.02}.items():
        p[model.names.index(key)] = value
    if "pin_friction.moment" in model.names:
        p[model.names.index("pin_friction.moment")] = 1e-3
    return model, HeldPose(**fields), p


@pytest.mark.skipif(shutil.which("cc") is None, reason="no C compiler (cc)")
@pytest.mark.parametrize("name", CASES)
def test_compiled_steps_are_those_of_python(name: str, monkeypatch) -> None:
    monkeypatch.setattr(steps_of_time, "LAST_STEP", 1e-10)
    quick = partial(fit_steps.compiled_steps, flags=("-O0",))
    monkeypatch.setattr(fit_steps, "compiled_steps", quick)
    model, held, p = problem(name)
    rest = model.rest_basis @ np.full(model.n_coefficients, 0.5)
    (state, own), (other, compiled) = (
        run(model, held, p, rest, columns=True, steps=steps) for steps in (Steps, fastest_steps)
    )
    assert isinstance(fastest_steps(MovingCable(model, p, rest)), CompiledSteps)
    assert np.abs(state.state.r - other.state.r).max() < 1e-8
    for field in ("turn", "place", "rates", "force"):
        expected, found = getattr(own, field), getattr(compiled, field)
        scale = np.abs(expected).max(axis=(0, 1))  # forces change by 1 / dt^2 with places
        assert (np.abs(found - expected).max(axis=(0, 1)) <= 1e-5 * scale + 1e-9).all(), field


def test_without_a_compiler_python_steps(monkeypatch) -> None:
    monkeypatch.setattr(fit_steps, "_libraries", {})
    monkeypatch.setenv("CC", "no-such-compiler")
    model, _, p = problem("plane, free")
    assert isinstance(fastest_steps(MovingCable(model, p, np.zeros(6))), Steps)


@pytest.mark.parametrize("name", CASES)
def test_steps_are_differentiated(name: str) -> None:
    model, held, p = problem(name)
    coefficients = np.full(model.n_coefficients, 0.5)
    _, found = run(model, held, p, model.rest_basis @ coefficients, columns=True)
    assert found is not None
    # Steps end within 1e-9: differences over a thousandth are good to 1e-5.
    for k in range(len(p) + model.n_coefficients):
        both = []
        size = 1e-3 * (abs(p[k]) if k < len(p) else 1.0)
        for sign in (1, -1):
            q, c = p.copy(), coefficients.copy()
            if k < len(p):
                q[k] += sign * size
            else:
                c[k - len(p)] += sign * size
            both.append(run(model, held, q, model.rest_basis @ c)[0].state)
        change = (both[0].r - both[1].r) / (2 * size)
        assert np.abs(found.place[..., k] - change).max() < 1e-4 * max(np.abs(change).max(), 1e-4)
        turned = model.node.difference(both[1].x, both[0].x) / (2 * size)
        assert np.abs(found.turn[..., k] - turned).max() < 1e-4 * max(np.abs(turned).max(), 1e-3)
