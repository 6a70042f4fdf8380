"""Without gravity, with both ends at one place: a loop whose ends are where they are held."""

import numpy as np
import pytest
from scipy.optimize import brentq
from scipy.special import ellipe, ellipk

import dlo_casadi as dlo
from dlo_casadi.codegen import CompiledSolver
from dlo_casadi.equilibrium.pose import HeldPose
from dlo_casadi.equilibrium.solve import solve_equilibrium

EI, LENGTH, FORWARD = 0.01, 1.0, (0.0, 0.0, 0.0, 1.0)
ENDS = [("pinned", "pinned"), ("clamped", "pinned"), ("pinned", "clamped"), ("clamped", "clamped")]


def rope(d, ends):
    torsion = {"torsional_stiffness": 0.8 * EI} if d == 3 else {}
    sizes = {"length": LENGTH, "mass": 0.1, "diameter": 0.005, "bending_stiffness": EI}
    known = {"gravity": (0.0,) * d, "boundary": ends, "model": {"n": 16}}
    return dlo.known_cable(dlo.Cable(**sizes, **torsion), **known)


def held(d, ends, *, last=FORWARD, angle=0.0):
    key, first = ("orientation", FORWARD) if d == 3 else ("heading", 0.0)
    own = zip(("start", "end"), ends, (first, last if d == 3 else angle), strict=True)
    return {f"{side}_{key}": frame for side, kind, frame in own if kind == "clamped"}


def loop_energy():
    """Of a loop between two joints at one place: half an elastica with 2 E(m) = K(m)."""
    m = brentq(lambda m: 2 * ellipe(m) - ellipk(m), 0.5, 0.99)
    return 8 * EI / LENGTH * ellipk(m) ** 2 * (m - 0.5)


@pytest.mark.parametrize("ends", ENDS, ids="-".join)
@pytest.mark.parametrize("d", [2, 3], ids=["plane", "space"])
def test_a_weightless_loop_ends_where_it_is_held(d, ends):
    """Energies are those of the closed elastica, and of a circle between clamps.

    Nothing holds the loop in its plane: it is neutral in space, and not called stable.
    """
    cable, frames = rope(d, ends), held(d, ends, angle=2 * np.pi)
    both = ends == ("clamped", "clamped")
    energy = 2 * np.pi**2 * EI / LENGTH if both else loop_energy()
    shape = cable.solve((0.0,) * d, **frames)
    np.testing.assert_allclose(shape.points[-1], 0.0, atol=1e-9 * LENGTH)
    assert shape.energy == pytest.approx(energy, rel=2e-3)
    assert d == 2 or not shape.stable

    compiled = CompiledSolver(cable.model, cable.p, cable.rest, flags=("-O0",))
    found = compiled.solve(HeldPose((0.0,) * d, (0.0,) * d, **frames))
    np.testing.assert_allclose(found.points[-1], 0.0, atol=1e-9 * LENGTH)
    assert found.energy == pytest.approx(shape.energy, rel=1e-6)


@pytest.mark.parametrize("gap", [1e-9, 1e-6, 1e-3, -1e-3])
def test_a_loop_between_clamps_that_nearly_touch_is_a_circle(gap):
    """Also if the end is ahead of the start: then the loop closes by passing it."""
    shape = rope(3, ("clamped",) * 2).solve((gap, 0.0, 0.0), **held(3, ("clamped",) * 2))
    assert shape.energy == pytest.approx(2 * np.pi**2 * EI / LENGTH, rel=2e-3)


def test_clamps_that_face_each_other_hold_a_loop_too():
    cable = rope(3, ("clamped", "clamped"))
    shape = cable.solve((0.0, 0.0, 0.0), **held(3, ("clamped",) * 2, last=(0.0, 0.0, 1.0, 0.0)))
    np.testing.assert_allclose(shape.points[-1], 0.0, atol=1e-9)
    assert shape.energy >= loop_energy()


@pytest.mark.parametrize("ends", ENDS, ids="-".join)
def test_a_straight_cable_is_no_equilibrium_of_a_loop(ends):
    """A straight start has dependent conditions: Newton's steps vanish, and the end is 1 m away."""
    cable = rope(3, ends)
    straight = np.tile(FORWARD, (cable.model.chain.n_nodes, 1))
    pose = HeldPose((0.0, 0.0, 0.0), (0.0, 0.0, 0.0), **held(3, ends))
    with pytest.raises(dlo.EquilibriumError, match="no equilibrium found from a nearby shape"):
        solve_equilibrium(cable.model, cable.p, cable.rest, pose, x_init=straight)


@pytest.mark.parametrize("turns", [0, 1])
@pytest.mark.parametrize("ends", [ENDS[0], ENDS[-1]], ids="-".join)
def test_the_function_gives_nan_and_a_status(ends, turns):
    outputs = rope(3, ends).function()([0.0] * 6 + [*FORWARD, *FORWARD, turns])
    assert float(outputs[-1]) == 4
    assert np.isnan(np.array(outputs[0])).all()
