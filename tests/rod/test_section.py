"""Tests of the section's laws, expanded about the bends of a segment."""

import casadi as ca
import numpy as np
import pytest

from dlo_casadi.effects import BendingSoftening, CableData, StiffnessGradient
from dlo_casadi.model import framed
from dlo_casadi.model.cable_model import CableModel
from dlo_casadi.model.lagrangian import lagrangian_of
from dlo_casadi.rod.element import Expansion


def test_an_expanded_law_has_the_derivatives_of_the_law():
    """B = 1/(1 + a sqrt(q + c)), up to the fourth derivative by q, and each of these by a."""
    p, x = ca.SX.sym("p", 3), ca.SX.sym("x", 2)
    squares = [ca.sumsqr(x), x[0] ** 2 + 0.3]

    def law(q):
        return 1 / (1 + p[1] * ca.sqrt(q + 0.1))

    expansion, q = Expansion(law, squares, p), ca.SX.sym("q")
    numbers = np.array([5.0, 0.7, -2.0]), np.array([0.4, 0.9])
    for point, square in enumerate(squares):
        first, second = law(q), expansion.at(point, q)
        for _ in range(5):
            rows = [ca.vertcat(b, ca.gradient(b, p)) for b in (first, second)]
            rows = ca.substitute(rows, [expansion.symbols], [expansion.values])
            rows = ca.substitute(rows, [q], [square])
            exact, found = ca.Function("b", [p, x], list(rows))(*numbers)
            np.testing.assert_allclose(np.array(found), np.array(exact), rtol=1e-12, atol=1e-14)
            first, second = ca.gradient(first, q), ca.gradient(second, q)


@pytest.mark.parametrize(
    ("effects", "law"),
    [((), False), ((StiffnessGradient(),), False), ((BendingSoftening(),), True)],
)
def test_only_a_law_of_the_bend_is_expanded(effects, law):
    cable = CableData(1.0, 0.1, 0.008, 0.01, torsional_stiffness=0.008)
    held = {"start": "clamped", "end": "clamped", "gravity": (0.0, 0.0, -9.81)}
    terms = lagrangian_of(CableModel(cable, 4, "quadratic", effects=effects, **held))
    assert terms.has_law_of_bend == law
    assert bool(framed._energy(terms).numel_in(3)) == law


@pytest.mark.parametrize("parameters", [0, 1])
def test_laws_that_depend_on_few_parameters(parameters):
    p, q = ca.SX.sym("p", 2), ca.SX.sym("q")
    expansion = Expansion(lambda b: b + parameters * p[0], [q], p)
    assert expansion.symbols.shape == (6, 1 + parameters)
    (found,) = ca.substitute([expansion.at(0, q)], [expansion.symbols], [expansion.values])
    assert float(ca.Function("b", [q, p], [found])(0.5, [2.0, 9.0])) == 0.5 + 2 * parameters
