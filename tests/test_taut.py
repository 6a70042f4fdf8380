"""Cables that hardly resist bending, between two pins: the catenary and small motions about it."""

import numpy as np
import pytest
from scipy.optimize import brentq

import dlo_casadi as dlo
from dlo_casadi.codegen import CompiledSolver
from dlo_casadi.equilibrium.pose import HeldPose

MASS, GRAVITY, SPAN = 0.1, 9.81, 0.999


def rope(d, n, stiffness):
    torsion = {"torsional_stiffness": stiffness} if d == 3 else {}
    cable = dlo.Cable(length=1.0, mass=MASS, diameter=0.002, bending_stiffness=stiffness, **torsion)
    gravity = (0.0,) * (d - 1) + (-GRAVITY,)
    return dlo.known_cable(cable, gravity=gravity, boundary=("pinned",) * 2, model={"n": n})


def end(d, span=SPAN):
    return (span,) + (0.0,) * (d - 1)


def catenary(span=SPAN):
    """Horizontal tension H [N] with 2 H / w sinh(w l / (2 H)) = 1 m."""
    weight = MASS * GRAVITY
    return brentq(
        lambda tension: 2 * tension / weight * np.sinh(weight * span / 2 / tension) - 1.0, 0.1, 1e3
    )


@pytest.mark.parametrize("d", [2, 3])
@pytest.mark.parametrize("stiffness", [1e-7, 1e-6, 1e-5, 1e-4])
def test_its_tension_is_that_of_a_catenary(d, stiffness):
    shape = rope(d, 20, stiffness).solve(end(d))
    assert shape.stable
    np.testing.assert_allclose(-shape.end_force[0], catenary(), rtol=3e-4)


@pytest.mark.parametrize("d", [2, 3])
def test_a_taut_cable_in_space_is_one_in_the_plane(d):
    """On a coarse mesh, too: tension straightens the insides of elements."""
    fine, coarse = (rope(d, n, 1e-3).solve(end(d)).end_force[0] for n in (80, 10))
    assert coarse == pytest.approx(fine, rel=2e-5)


@pytest.mark.parametrize("d", [2, 3])
def test_the_generated_solver_finds_no_shape_longer_than_the_cable(d):
    """In a plane it may find none: its guesses lead to elements that are bent too far."""
    cable = rope(d, 20, 3e-5)
    compiled = CompiledSolver(cable.model, cable.p, cable.rest, flags=("-O0",))
    found = compiled.solve(HeldPose((0.0,) * d, end(d)), throw=False)
    assert found.status == "ok" or (d == 2 and found.status == "iteration_limit")
    if found.status == "ok":
        assert found.energy == pytest.approx(cable.solve(end(d)).energy, rel=1e-7)


def test_small_motions_about_it():
    """Out of its plane k pi / l sqrt(H / m), in it 2 k pi and tan(x) = x  [Irvine, 1981].

    For an inextensible cable of little sag.
    """
    span = 0.9999
    unit = np.sqrt(catenary(span) / MASS) / span
    symmetric = 2 * brentq(lambda x: np.tan(x) - x, 4.4, 4.6)
    across = unit * np.pi * np.array([1.0, 2.0])
    inside = unit * np.array([2 * np.pi, symmetric, 4 * np.pi])
    shape = rope(3, 20, 1e-5).solve(end(3, span))
    found = 2 * np.pi * shape.modes(12).frequencies
    for exact in (*across, *inside):
        assert np.abs(found / exact - 1).min() < 1e-3
    found = 2 * np.pi * rope(2, 40, 1e-5).solve(end(2, span)).modes(3).frequencies
    np.testing.assert_allclose(found, inside, rtol=1e-3)
