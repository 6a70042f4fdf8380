"""Traced expressions are those of the function itself."""

import casadi as ca
import numpy as np
import pytest

from dlo_casadi.rod import elements, in_frame, node
from dlo_casadi.rod.elements import Helix
from dlo_casadi.rod.node import Frame
from dlo_casadi.rod.quaternions import rotated, rotation, traced


def random(*sizes):
    """Numbers of which every square root and series of these functions is real."""
    rng = np.random.default_rng(3)
    return [rng.uniform(-0.5, 0.5, size=size) for size in sizes]


@pytest.mark.parametrize(
    ("function", "sizes"),
    [
        (rotated, (4, 3)),
        (rotation, (3,)),
        (node._frame_moved, (4, 3)),
        (node._frame_difference, (4, 4)),
        (elements._between, (4, 4)),
        (elements._turned, (3, 1)),
        (elements._bowed, (7, 3, 1, 1, 1, 1)),
        (elements.inverse_of, ((3, 3),)),
        (in_frame._rotation, (4,)),
    ],
    ids=lambda x: getattr(x, "__name__", None),
)
def test_values_and_number_of_operations_are_the_same(function, sizes):
    found = []
    for one in (function, function.__wrapped__):
        symbols = [ca.SX.sym("x", *np.atleast_1d(size).tolist()) for size in sizes]
        found.append(ca.Function("f", symbols, [one(*symbols)]))
    assert found[0].n_instructions() == found[1].n_instructions()
    values = [np.array(one(*random(*sizes))) for one in found]
    assert np.isfinite(values[0]).all()
    np.testing.assert_array_equal(*values)


def test_a_function_is_traced_once_for_each_size_of_its_arguments():
    calls = []

    @traced
    def scaled(x, factor):
        calls.append(x.shape)
        return factor * x

    x, y = ca.SX.sym("x", 2), ca.SX.sym("y", 2)
    assert ca.is_equal(scaled(x, 2.0), 2.0 * x, 3)
    assert ca.is_equal(scaled(y, 0.0), ca.SX.zeros(2), 3)
    assert ca.is_equal(scaled(ca.vertcat(x, y), 2), 2 * ca.vertcat(x, y), 3)
    assert ca.is_equal(scaled(x, ca.DM(2)), 2.0 * x, 3)
    assert calls == [(2, 1), (4, 1)]


def test_expressions_of_users_are_not_traced():
    """In MX the operations themselves stand, not calls of functions."""
    x, y = ca.MX.sym("x", 4), ca.MX.sym("y", 4)
    gap = ca.Function("gap", [x, y], [Frame.difference(x, y)])
    assert not gap.find_functions()
    first, last = (one / np.linalg.norm(one) for one in random(4, 4))
    expected = np.array(ca.evalf(Frame.difference(ca.SX(first), ca.SX(last)))).ravel()
    np.testing.assert_allclose(np.array(gap(first, last)).ravel(), expected, rtol=1e-14)
    np.testing.assert_allclose(Frame.difference(first, last), expected, rtol=1e-12)


def test_the_frame_in_the_middle_is_half_a_rotation_away():
    half = np.array([0.2, -0.4, 0.3])
    identity = ca.SX(Frame.identity)
    local = np.array(ca.evalf(Helix().local(identity, rotation(ca.SX(2 * half))))).ravel()
    np.testing.assert_allclose(local[:4], np.array(ca.evalf(rotation(ca.SX(half)))).ravel(), 1e-12)
    np.testing.assert_allclose(local[4:], 2 * half, rtol=1e-12)
