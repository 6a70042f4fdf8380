"""Frequencies and damping ratios against closed forms."""

import numpy as np
import pytest
from scipy.optimize import brentq

from dlo_casadi.effects import AxialStretch, CableData, ViscousDrag
from dlo_casadi.equilibrium.pose import HeldPose
from dlo_casadi.equilibrium.solve import solve_equilibrium
from dlo_casadi.model.cable_model import CableModel
from dlo_casadi.motion.modes import damped_modes
from dlo_casadi.motion.system import MovingCable

LENGTH, MASS, STIFFNESS = 0.6, 0.06, 0.009
UNIT = np.sqrt(STIFFNESS / (MASS * LENGTH**3))  # rad/s

BEAMS = {
    ("clamped", "free"): (lambda x: np.cos(x) * np.cosh(x) + 1, (1.875, 4.694, 7.855)),
    ("pinned", "pinned"): (np.sin, (np.pi, 2 * np.pi, 3 * np.pi)),
    ("clamped", "clamped"): (lambda x: np.cos(x) * np.cosh(x) - 1, (4.730, 7.853, 10.996)),
}


def straight(ends, n, dimension, effects=(), damping_time=None, diameter=0.008, **values):
    """A straight cable without weight, held at its ends; both nearly inextensible."""
    torsion = STIFFNESS if dimension == 3 else None
    data = CableData(LENGTH, MASS, diameter, STIFFNESS, "beam", True, torsion, damping_time)
    kinds = (AxialStretch(), *effects)
    model = CableModel(
        data, n, start=ends[0], end=ends[1], gravity=(0.0,) * dimension, effects=kinds
    )
    values = {"axial_stretch.compliance": 1e-7, **values}
    p = np.array([values.get(q.name, q.nominal) for q in model.parameters])
    held = {"end": (LENGTH, *(0.0,) * (dimension - 1))} if ends[1] != "free" else {}
    direction = ("heading", 0.0) if dimension == 2 else ("orientation", (0.0, 0.0, 0.0, 1.0))
    for side, kind in zip(("start", "end"), ends, strict=True):
        if kind == "clamped":
            held[f"{side}_{direction[0]}"] = direction[1]
    pose = HeldPose(start=(0.0,) * dimension, **held)
    rest = np.zeros(model.chain.n_rests)
    eq = solve_equilibrium(model, p, rest, pose)
    cable = MovingCable(model, p, rest)
    fixtures = cable.fixtures(pose.vector)
    return cable, cable.at_rest(eq, fixtures), fixtures


def slowest(ends, n, dimension=2, count=3, **options):
    """The slowest modes."""
    return damped_modes(*straight(ends, n, dimension, **options), count)


@pytest.mark.parametrize("dimension", [2, 3])
@pytest.mark.parametrize("ends", BEAMS)
def test_frequencies_of_beams_are_of_fourth_order(ends, dimension):
    """Cos x cosh x = -+1 and sin x = 0 for w = x^2 sqrt(EI / (m L^3))  [Euler-Bernoulli]."""
    equation, near = BEAMS[ends]
    exact = np.array([brentq(equation, x - 0.1, x + 0.1) ** 2 * UNIT for x in near])
    errors = []
    for n in (10, 20):
        found = slowest(ends, n, dimension, count=3 if dimension == 2 else 7).rates
        errors.append([np.abs(found - x).min() / x for x in exact])
    order = np.log2(np.divide(*errors))
    assert np.all(errors[1] < np.array(1e-3))
    assert np.all(order > 3.8), f"measured orders {order}"


def test_torsion_of_a_clamped_rod_is_of_fourth_order():
    """Frequencies (k - 1/2) pi / L sqrt(GJ / (rho I_p)), rho I_p = m / L d^2 / 8."""
    exact = np.pi / 2 / LENGTH * np.sqrt(STIFFNESS / (MASS / LENGTH * 0.2**2 / 8))
    errors = []
    for n in (5, 10):
        found = slowest(("clamped", "free"), n, 3, count=6, diameter=0.2).rates
        errors.append(np.abs(found - exact).min() / exact)
    assert errors[1] < 1e-4
    assert np.log2(errors[0] / errors[1]) > 3.8


@pytest.mark.parametrize("dimension", [2, 3])
def test_internal_damping_is_in_proportion_to_the_frequency(dimension):
    """The ratio is tau w / 2 [Kelvin-Voigt]."""
    tau = 0.01
    found = slowest(("clamped", "free"), 20, dimension, damping_time=tau)
    assert found.damping_ratios == pytest.approx(tau * found.rates / 2, rel=1e-2)


def test_viscous_drag_is_in_inverse_proportion():
    """The ratio is c / (2 m w) for the mass m per length."""
    drag = {"effects": (ViscousDrag(),), "viscous_drag.rate": 0.1}
    found = slowest(("clamped", "free"), 20, **drag)
    exact = 0.1 / (2 * MASS / LENGTH * found.rates)
    assert found.damping_ratios == pytest.approx(exact, rel=1e-2)


def test_a_mode_that_creeps_back_keeps_its_frequency():
    """The ratio is tau w / 2 above 1, too."""
    tau = 1.0
    found = slowest(("clamped", "free"), 20, damping_time=tau)
    free = slowest(("clamped", "free"), 20)
    assert found.rates == pytest.approx(free.rates, rel=1e-6)
    assert found.damping_ratios == pytest.approx(tau * free.rates / 2, rel=1e-2)
    assert found.damping_ratios[1] > 1
