"""Kinematics: the paper's SE(3) product, straight links, arcs, and the basis of rest curvature."""

import itertools

import casadi as ca
import numpy as np
import pytest
from dlo_casadi.chain import Chain, Curve, se3_nodes

from dlo_casadi.errors import DloError
from dlo_casadi.rest import RestCurvature

LENGTH = 0.8  # m
START = (0.1, -0.2)  # m
ROUNDING = 1e-14  # a dozen sums of numbers of order one


def curve_of(chain: Chain, phi: np.ndarray, **extra) -> Curve:
    return chain.curve(ca.SX(ca.DM(phi)), ca.SX(ca.DM(START)), **extra)


def number(expression) -> np.ndarray:
    return np.array(ca.evalf(ca.SX(expression))).squeeze()


def wavy(chain: Chain) -> np.ndarray:
    """Headings without any symmetry [rad]."""
    return np.random.default_rng(0).normal(scale=0.4, size=chain.n_headings).cumsum()


# ---- straight links ----------------------------------------------------------------------------


@pytest.mark.parametrize("n", [2, 3, 7])
def test_se3_product_equals_the_recurrence_in_headings(n):
    """Two routes to Eq. 4."""
    chain = Chain(LENGTH, n, "link")
    theta = np.random.default_rng(n).uniform(-np.pi / 2, np.pi / 2, n)
    by_product = number(se3_nodes(ca.SX(ca.DM(theta)), LENGTH))
    by_headings = number(curve_of(chain, np.cumsum(theta)).nodes)
    np.testing.assert_allclose(by_headings - START, by_product, rtol=0, atol=ROUNDING)


def test_se3_product_of_three_links_by_hand():
    """Headings 0, 90 and 180 degrees: three sides of a square."""
    theta = ca.SX(ca.DM([0.0, np.pi / 2, np.pi / 2]))
    np.testing.assert_allclose(
        number(se3_nodes(theta, 3.0)), [[0, 0], [1, 0], [1, 1], [0, 1]], atol=ROUNDING
    )


def test_links_keep_their_length_and_direction():
    chain = Chain(LENGTH, 5, "link")
    phi = wavy(chain)
    steps = np.diff(number(curve_of(chain, phi).nodes), axis=0)
    exact = chain.h * np.stack([np.cos(phi), np.sin(phi)], axis=1)
    np.testing.assert_allclose(steps, exact, atol=ROUNDING)


# ---- arcs --------------------------------------------------------------------------------------


def test_arcs_of_constant_curvature_lie_on_a_circle():
    """With phi = a + k s:  r = r_0 + [sin(a + k s) - sin a, cos a - cos(a + k s)] / k."""
    chain, a, k = Chain(LENGTH, 12), 0.3, 5.0
    s = chain.heading_places
    curve = curve_of(chain, a + k * s)
    exact = np.stack([np.sin(a + k * s) - np.sin(a), np.cos(a) - np.cos(a + k * s)], axis=1) / k
    # Three Gauss points: h d^6 / 2e6 per element that turns by d, twelve elements.
    error = chain.n * chain.h * (k * chain.h) ** 6 / 2e6
    np.testing.assert_allclose(number(curve.nodes) - START, exact, rtol=0, atol=error)
    np.testing.assert_allclose(number(curve.strain), k, rtol=1e-12)


def test_arc_error_is_of_sixth_order_in_the_turning():
    """A half circle of diameter 2/k, ends 2/k apart; the error falls like the sixth power."""
    k = np.pi / LENGTH
    errors = []
    for n in (3, 6, 12):
        chain = Chain(LENGTH, n)
        nodes = number(curve_of(chain, k * chain.heading_places).nodes)
        errors.append(abs(np.hypot(*(nodes[-1] - nodes[0])) - 2 / k))
    order = np.log2(np.divide(errors[:-1], errors[1:]))
    assert np.all(order > 5.8), f"measured orders {order}"


# ---- both --------------------------------------------------------------------------------------


@pytest.mark.parametrize("element", ["quadratic", "arc", "link"])
@pytest.mark.parametrize("stretch", [1.0, 1.07])
def test_position_agrees_with_the_nodes(element, stretch):
    chain = Chain(LENGTH, 5, element)
    curve = curve_of(chain, wavy(chain), stretch=stretch)
    at = np.array([number(curve.position(i * chain.h)) for i in range(chain.n + 1)])
    np.testing.assert_allclose(at, number(curve.nodes), atol=ROUNDING)


@pytest.mark.parametrize("element", ["quadratic", "arc", "link"])
def test_position_moves_along_the_heading(element):
    """dr/ds = stretch (cos phi, sin phi), by central differences inside the elements."""
    chain, stretch, d = Chain(LENGTH, 5, element), 1.07, 1e-5
    phi = wavy(chain)
    curve = curve_of(chain, phi, stretch=stretch)
    for s in (np.arange(5) + 0.3) * chain.h:
        slope = (number(curve.position(s + d)) - number(curve.position(s - d))) / (2 * d)
        heading = phi[int(s / chain.h)]
        if chain.nodal:
            heading = np.interp(s, chain.heading_places, phi)
        # Central differences: d^2 k^2 / 6 < 1e-9 and rounding 1e-16 / d; an arc's three Gauss
        # points err by d_phi^6 / 2e6 where it turns by d_phi < 0.8.
        exact = stretch * np.array([np.cos(heading), np.sin(heading)])
        np.testing.assert_allclose(slope, exact, rtol=0, atol=1e-6)


def test_position_on_arcs_is_once_differentiable_at_a_node():
    chain, d = Chain(LENGTH, 4), 1e-6
    curve = curve_of(chain, 0.3 * wavy(chain))
    node = number(curve.position(chain.h))
    left = (node - number(curve.position(chain.h - d))) / d
    right = (number(curve.position(chain.h + d)) - node) / d
    # One-sided differences: half the curvature (below 2 1/m) times d, and rounding 1e-16 / d.
    np.testing.assert_allclose(left, right, rtol=0, atol=1e-5)


def test_heading_is_linear_between_the_places_where_it_is_known():
    for element in ("arc", "link"):
        chain = Chain(LENGTH, 4, element)
        phi = wavy(chain)
        curve = curve_of(chain, phi)
        for s in np.linspace(0.0, LENGTH, 23):
            exact = np.interp(s, chain.heading_places, phi)
            assert number(curve.heading(s)) == pytest.approx(exact, abs=1e-13)
        assert number(curve.start_direction) == phi[0]
        assert number(curve.end_direction) == phi[-1]


@pytest.mark.parametrize("element", ["quadratic", "arc", "link"])
def test_first_moment_against_integration(element):
    """The integral of r ds by Gauss-Legendre with 20 points in each element."""
    chain = Chain(LENGTH, 4, element)
    ratio = ca.SX(ca.DM([1.0, 1.05, 0.98, 1.1]))
    curve = curve_of(chain, 0.5 * wavy(chain), ratio=ratio)
    x, w = np.polynomial.legendre.leggauss(20)
    s = (np.arange(chain.n)[:, None] + (x + 1) / 2).ravel() * chain.h
    weight = np.tile(w * chain.h / 2, chain.n)
    place = ca.SX.sym("s")
    position = ca.Function("position", [place], [curve.position(place)])
    points = np.array(position(s[None])).T
    # Links are exact. Two integrals of arcs by three points differ by h^2 d^6 / 1e5 per element
    # that turns by d < 0.7.
    tolerance = ROUNDING if element == "link" else 1e-8
    np.testing.assert_allclose(number(curve.first_moment), weight @ points, atol=tolerance)


def test_node_slopes_are_the_derivative_of_position():
    chain = Chain(LENGTH, 4)
    phi = wavy(chain)
    curve = curve_of(chain, phi, stretch=1.1)
    exact = 1.1 * np.stack([np.cos(phi), np.sin(phi)], axis=1)
    np.testing.assert_allclose(number(curve.node_slopes), exact, atol=ROUNDING)


@pytest.mark.parametrize("element", ["quadratic", "arc", "link"])
@pytest.mark.parametrize(("start", "end"), [(False, False), (True, False), (True, True)])
def test_curvature_of_a_stretched_circle(element, start, end):
    """Turning over true length in every cell, the half cells beside clamps included."""
    chain, k = Chain(LENGTH, 4, element, start, end), 2.0
    phi = k * chain.heading_places
    extra = {"start_heading": 0.0, "end_heading": k * LENGTH}
    curve = curve_of(chain, phi, stretch=1.25, **extra)
    np.testing.assert_allclose(number(curve.strain), k / 1.25, rtol=1e-12)


def test_cells_cover_what_bends():
    """Arcs: all of it. Links: between the middles of links, and up to clamps."""
    width = {
        kind: np.diff(Chain(LENGTH, 4, element, *held).cells, axis=1).sum()
        for kind, element, held in (
            ("arc", "arc", (True, True)),
            ("pins", "link", (False, False)),
            ("one clamp", "link", (True, False)),
            ("clamps", "link", (True, True)),
        )
    }
    assert width["arc"] == pytest.approx(LENGTH)
    assert width["pins"] == pytest.approx(0.75 * LENGTH)
    assert width["one clamp"] == pytest.approx(0.875 * LENGTH)
    assert width["clamps"] == pytest.approx(LENGTH)


def test_a_chain_that_cannot_be():
    with pytest.raises(DloError, match="at least 2 elements, got n = 1"):
        Chain(LENGTH, 1)
    with pytest.raises(DloError, match="'beam' is not known; use one of"):
        Chain(LENGTH, 4, "beam")


# ---- rest curvature ----------------------------------------------------------------------------


def test_means_over_cells_are_integrals_of_the_basis():
    rest = RestCurvature(LENGTH, 7)
    cells = Chain(LENGTH, 5, "link").cells
    x, w = np.polynomial.legendre.leggauss(8)
    means = []
    for low, high in cells:
        # Knots divide the cell: integrate from knot to knot, where eight points are exact.
        inner = np.linspace(0.0, LENGTH, 5)
        edges = np.unique(np.r_[low, inner[(inner > low) & (inner < high)], high])
        total = 0.0
        for a, b in itertools.pairwise(edges):
            total = total + (b - a) / 2 * w @ rest.basis((a + b) / 2 + (b - a) / 2 * x)
        means.append(total / (high - low))
    np.testing.assert_allclose(rest.cell_means(cells), means, atol=1e-13)


def test_equal_coefficients_are_a_constant_curvature():
    rest = RestCurvature(LENGTH, 6)
    cells = Chain(LENGTH, 9).cells
    np.testing.assert_allclose(rest.cell_means(cells) @ np.full(6, 2.5), 2.5, rtol=1e-12)
    np.testing.assert_allclose(rest.basis(np.array([0.0, 0.3, LENGTH])).sum(axis=1), 1.0)
    # A parabola through the coefficients has constant second differences.
    np.testing.assert_allclose(rest.roughness @ np.arange(6.0) ** 2, 2.0)


def test_a_straight_cable_has_no_coefficients():
    rest = RestCurvature(LENGTH, 0)
    assert rest.cell_means(Chain(LENGTH, 3).cells).shape == (3, 0)
    assert rest.basis(np.zeros(2)).shape == (2, 0)
