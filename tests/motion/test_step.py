"""One step in time as a CasADi function: the steps of `simulate`, with exact derivatives."""

from __future__ import annotations

from functools import cache

import casadi as ca
import numpy as np
import pytest

import dlo_casadi as dlo
from dlo_casadi.arrays import FloatArray
from dlo_casadi.cable.shape_in_motion import moving_cable
from dlo_casadi.motion.step_function import fixtures_vector
from dlo_casadi.motion.steps import RHO, Scheme, Stepper, still

DT = 0.01


@cache
def stepping(
    dimension: int, boundary: tuple[str, str]
) -> tuple[dlo.FittedCable, dlo.Shape, ca.Function]:
    """A cable, its first shape and its step."""
    twist = {"torsional_stiffness": 0.007} if dimension == 3 else {}
    rope = dlo.Cable(length=0.6, mass=0.06, diameter=0.008, bending_stiffness=0.009, **twist)
    gravity = (0.0, 0.0, -9.81)[-dimension:]
    cable = dlo.known_cable(rope, gravity=gravity, boundary=boundary, model={"n": 8})
    friction = {"pin_friction": 1e-4} if "pinned" in boundary else {}
    cable = cable.with_damping(0.02, air_drag=1.1, **friction)
    held: dict[str, object] = {"start": (0.0,) * dimension}
    if boundary[1] != "free":
        held["end"] = (0.45, 0.05, 0.02)[:dimension]
    for side, kind in zip(("start", "end"), boundary, strict=True):
        if kind == "clamped" and dimension == 2:
            held[f"{side}_heading"] = 0.2
        elif kind == "clamped":
            held[f"{side}_orientation"] = (0.0, 0.0, 0.0, 1.0)
    shape = cable.solve(**held)
    return cable, shape, cable.step(DT)


CASES = [(2, ("clamped", "free")), (2, ("pinned", "pinned")), (3, ("clamped", "clamped"))]


def path(fixtures: FloatArray, dimension: int, count: int) -> FloatArray:
    """Fixtures (K, count) whose start swings along x."""
    rows, t = np.tile(fixtures[:, None], (1, count)), DT * (1 + np.arange(count))
    first, rate = len(fixtures) - 4 * dimension, 6.0
    rows[0] += 0.05 * (1 - np.cos(rate * t))
    rows[first] = 0.05 * rate * np.sin(rate * t)
    rows[first + 2 * dimension] = 0.05 * rate**2 * np.cos(rate * t)
    return rows


@pytest.mark.parametrize(("dimension", "boundary"), CASES)
def test_the_step_is_that_of_the_simulation(dimension: int, boundary: tuple[str, str]) -> None:
    """Places after 30 steps; forces; a cable at rest stays at rest."""
    cable, shape, step = stepping(dimension, boundary)
    state, fixtures = shape.at_rest()
    same = step(state=state, fixtures=fixtures)
    assert np.abs(np.array(same["next"]).ravel() - state).max() < 1e-8
    assert np.allclose(np.array(same["end_force"]).ravel(), shape.end_force, atol=1e-8)
    rows = path(fixtures, dimension, 30)
    found = step.mapaccum(30)(state, rows)[3]
    moving = moving_cable(cable).about(shape.equilibrium.x)
    stepper, now = Stepper(moving, Scheme.of(RHO)), moving.fixtures(shape.pose.vector)
    after, size = still(moving.at_rest(shape.equilibrium, now)), len(fixtures) - 4 * dimension
    for k in range(30):
        pose = shape.pose.vector.copy()
        pose[:size] = rows[:size, k]
        rates = rows[size:, k].reshape((2, 2, dimension))
        held = moving.fixtures(pose, *rates)
        assert np.allclose(fixtures_vector(moving, held), rows[:, k])
        after = stepper.step(after, held, DT)
    assert np.abs(np.array(found)[:, -moving.n_nodes :].T - after.state.r).max() < 1e-7


@pytest.mark.parametrize(("dimension", "boundary"), CASES)
def test_derivatives_of_a_step_are_exact(dimension: int, boundary: tuple[str, str]) -> None:
    """First and second ones along a random direction, against differences."""
    _, shape, step = stepping(dimension, boundary)
    state, fixtures = shape.at_rest()
    random = np.random.default_rng(3)
    weights = random.normal(size=step.size1_out(0))
    ways = [1e-2 * random.normal(size=len(x)) for x in (state, fixtures)]
    share = ca.MX.sym("share")
    value = ca.dot(weights, step(state + share * ways[0], fixtures + share * ways[1])[0])
    hessian, gradient = ca.hessian(value, share)
    function = ca.Function("value", [share], [value, gradient, hessian])
    h = 2e-5
    before, now, after = (np.array(function(x)).ravel() for x in (-h, 0.0, h))
    assert np.isclose((after[0] - before[0]) / (2 * h), now[1], rtol=1e-6)
    assert np.isclose((after[1] - before[1]) / (2 * h), now[2], rtol=1e-5)


def test_many_steps_are_one_function() -> None:
    """Derivatives through `mapaccum` by the fixture's way, against differences."""
    _, shape, step = stepping(2, ("clamped", "free"))
    state, fixtures = shape.at_rest()
    rows, share = path(fixtures, 2, 20), ca.MX.sym("share")
    moved = ca.DM(fixtures) + share * (rows - fixtures[:, None])
    tip = step.mapaccum(20)(state, moved)[3][:, -1]
    function = ca.Function("tip", [share], [tip, ca.jacobian(tip, share)])
    before, now, after = (function(x) for x in (1 - 1e-4, 1.0, 1 + 1e-4))
    differences = np.array(after[0] - before[0]).ravel() / 2e-4
    assert np.allclose(np.array(now[1]).ravel(), differences, rtol=1e-6, atol=1e-9)


def test_a_step_of_no_time_is_an_error() -> None:
    cable, _, _ = stepping(2, ("clamped", "free"))
    with pytest.raises(dlo.DloError, match="dt: a time"):
        cable.step(0.0)
    with pytest.raises(dlo.DloError, match="about=shape"):
        cable.with_damping(dynamic_stiffness=1.3).step(DT)
