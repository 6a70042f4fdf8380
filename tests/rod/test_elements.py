"""Elements: where their nodes are, how the cable runs between them, and what bends.

Kinematics against the paper's SE(3) product, circles and integrals; no mechanics but the bubble's.
"""

import itertools

import casadi as ca
import numpy as np
import pytest

from dlo_casadi.errors import DloError
from dlo_casadi.rod.chain import ELEMENTS, Chain
from dlo_casadi.rod.element import Section, Segment

LENGTH = 0.8  # m
ROUNDING = 1e-14  # a dozen sums of numbers of order one
EVERY = pytest.mark.parametrize("element", ELEMENTS)
SMOOTH = pytest.mark.parametrize("element", [e for e, kind in ELEMENTS.items() if kind.smooth])
HELD = pytest.mark.parametrize("held", list(itertools.product([False, True], repeat=2)))


def number(expression) -> np.ndarray:
    return np.array(ca.evalf(ca.SX(expression))).squeeze()


def segments_of(chain: Chain, phi: np.ndarray, *, rest=None, stretch=1.0, bubble=0.0):
    """All segments of a chain of these headings (n_nodes,) and rest curvatures (n_cells,) [1/m]."""
    kind = chain.kind
    rest = np.zeros(chain.n_cells) if rest is None else rest
    inside = chain.rest_inside(rest[:, None])[..., 0]
    inner = ca.SX(ca.DM(np.full((kind.n_inner, 1), bubble)))
    after = np.minimum(np.arange(chain.n_segments) + 1, chain.n_nodes - 1)
    return [
        Segment(
            local=ca.SX([float(phi[j]), float(phi[after[j]])]),
            rest=ca.SX(ca.DM(inside[j])),
            place=ca.SX(ca.DM(chain.layout.segments[j])),
            stretch=ca.SX(stretch),
            ratio=ca.SX(stretch),
            inner=inner,
            square=inner**2,
        )
        for j in range(chain.n_segments)
    ]


def nodes(chain: Chain, phi: np.ndarray, **extra) -> np.ndarray:
    """Element boundaries (n + 1, 2) [m] from the start, which is the origin."""
    segments = segments_of(chain, phi, **extra)
    steps = [number(chain.kind.advance(segments[j])) for j in chain.layout.advancing]
    return np.concatenate([np.zeros((1, 2)), np.cumsum(steps, axis=0)])


def strains(chain: Chain, phi: np.ndarray, **extra) -> np.ndarray:
    segments = segments_of(chain, phi, **extra)
    return np.array([number(chain.kind.strain(segments[j])) for j in chain.layout.bends])


def wavy(chain: Chain) -> np.ndarray:
    """Headings without any symmetry [rad]."""
    return np.random.default_rng(0).normal(scale=0.4, size=chain.n_nodes).cumsum()


# ---- straight links ----------------------------------------------------------------------------


def se3_nodes(theta: np.ndarray, length: float) -> np.ndarray:
    """Nodes (n + 1, 2) [m] of a chain of straight links by homogeneous transforms.

        T_i^0 = T_1^0(theta_1) prod_{a=2..i} T_a^(a-1)(theta_a)       (Quartaro et al. 2025, Eq. 4)

    theta_1 is the heading of link 1, the others are relative joint angles [rad].
    """
    h = length / len(theta)
    transform, found = np.eye(3), [np.zeros(2)]
    for i, angle in enumerate(theta):
        c, s = np.cos(angle), np.sin(angle)
        transform = transform @ [[c, -s, h if i else 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]
        found.append((transform @ [h, 0.0, 1.0])[:2])
    return np.array(found)


@pytest.mark.parametrize("n", [2, 3, 7])
def test_links_are_the_papers_se3_product(n):
    theta = np.random.default_rng(n).uniform(-np.pi / 2, np.pi / 2, n)
    by_headings = nodes(Chain(LENGTH, n, "link"), np.cumsum(theta))
    np.testing.assert_allclose(by_headings, se3_nodes(theta, LENGTH), rtol=0, atol=ROUNDING)


def test_three_links_by_hand():
    """Headings 0, 90 and 180 degrees: three sides of a square."""
    found = nodes(Chain(3.0, 3, "link"), np.array([0.0, np.pi / 2, np.pi]))
    np.testing.assert_allclose(found, [[0, 0], [1, 0], [1, 1], [0, 1]], atol=ROUNDING)


@HELD
def test_clamps_of_links_advance_nothing(held):
    """A clamp has a heading of its own; the links keep their length and direction."""
    chain = Chain(LENGTH, 5, "link", *held)
    assert chain.n_nodes == 5 + sum(held)
    phi = wavy(chain)
    own = phi[int(held[0]) :][:5]
    steps = np.diff(nodes(chain, phi), axis=0)
    exact = chain.h * np.stack([np.cos(own), np.sin(own)], axis=1)
    np.testing.assert_allclose(steps, exact, atol=ROUNDING)


# ---- arcs --------------------------------------------------------------------------------------


@SMOOTH
def test_constant_curvature_lies_on_a_circle(element):
    """With phi = a + k s:  r = [sin(a + k s) - sin a, cos a - cos(a + k s)] / k."""
    chain, a, k = Chain(LENGTH, 12, element), 0.3, 5.0
    s = chain.places
    exact = np.stack([np.sin(a + k * s) - np.sin(a), np.cos(a) - np.cos(a + k * s)], axis=1) / k
    # Three Gauss points: h d^6 / 2e6 per element that turns by d, twelve elements.
    error = LENGTH * (k * chain.h) ** 6 / 2e6
    np.testing.assert_allclose(nodes(chain, a + k * s), exact, rtol=0, atol=error)
    np.testing.assert_allclose(strains(chain, a + k * s), k, rtol=1e-12)


@SMOOTH
def test_quadrature_is_of_sixth_order_in_the_turning(element):
    """A half circle of diameter 2/k, ends 2/k apart; the error falls like the sixth power."""
    k = np.pi / LENGTH
    errors = []
    for n in (3, 6, 12):
        chain = Chain(LENGTH, n, element)
        end = nodes(chain, k * chain.places)[-1]
        errors.append(abs(np.hypot(*end) - 2 / k))
    order = np.log2(np.divide(errors[:-1], errors[1:]))
    assert np.all(order > 5.8), f"measured orders {order}"


@SMOOTH
def test_the_direction_follows_the_rest_shape_inside(element):
    """kappa_0 = a + b s + c s^2: at rest the heading is its integral, at every fraction."""
    a, b, c = 1.0, -4.0, 9.0  # 1/m, 1/m^2, 1/m^3

    def turned(s):
        return 0.2 + a * s + b * s**2 / 2 + c * s**3 / 3

    chain = Chain(LENGTH, 5, element)
    edges = chain.places
    means = np.diff(turned(edges)) / np.diff(edges)
    segments = segments_of(chain, turned(edges), rest=means)
    for j, u in itertools.product(range(5), (0.0, 0.25, 0.6, 1.0)):
        heading = turned(edges[j] + u * chain.h)
        exact = [np.cos(heading), np.sin(heading)]
        np.testing.assert_allclose(number(chain.kind.tangent(segments[j], u)), exact, atol=1e-13)
    # Bent and stretched as a whole it keeps that shape: nothing is left to bend.
    np.testing.assert_allclose(strains(chain, turned(edges)), means, rtol=1e-12)


# ---- all ---------------------------------------------------------------------------------------


@EVERY
@HELD
def test_a_layout_is_whole(element, held):
    """Segments advance along all of the cable in order, each from its node to the next."""
    chain = Chain(LENGTH, 5, element, *held)
    layout = chain.layout
    assert np.all(np.diff(layout.nodes) > 0)
    assert chain.n_segments in (chain.n_nodes - 1, chain.n_nodes)
    start, length = layout.segments[:, :2].T
    np.testing.assert_allclose(start + length, [*start[1:], LENGTH], atol=ROUNDING)
    assert start[0] == 0.0
    np.testing.assert_array_equal(layout.advancing, np.flatnonzero(length))
    assert len(layout.advancing) == chain.n
    # Bends stand between neighbouring nodes, or between the ends that a segment's nodes are.
    edges = np.stack([layout.nodes[layout.bends], layout.nodes[layout.bends + 1]], axis=1)
    np.testing.assert_allclose(layout.cells, edges, atol=ROUNDING)
    # Inside the cable, directions at the boundaries are those there, to the second order.
    where = layout.nodes[layout.stations].mean(axis=1)
    inner = slice(0, None) if chain.kind.smooth else slice(1, -1)
    boundaries = np.linspace(0.0, LENGTH, 6)
    np.testing.assert_allclose(where[inner], boundaries[inner], atol=ROUNDING)


def test_cells_cover_what_bends():
    """Arcs: all of it. Links: between the middles of links, and up to clamps."""
    for element, held, share in (
        ("arc", (True, True), 1.0),
        ("quadratic", (False, False), 1.0),
        ("link", (False, False), 0.75),
        ("link", (True, False), 0.875),
        ("link", (True, True), 1.0),
    ):
        width = np.diff(Chain(LENGTH, 4, element, *held).cells, axis=1).sum()
        assert width == pytest.approx(share * LENGTH)


@EVERY
@HELD
def test_curvature_of_a_stretched_circle(element, held):
    """Turning over true length in every cell, the half cells beside clamps included."""
    chain, k = Chain(LENGTH, 4, element, *held), 2.0
    found = strains(chain, k * chain.places, stretch=1.25)
    np.testing.assert_allclose(found, k / 1.25, rtol=1e-12)


@EVERY
@pytest.mark.parametrize("stretch", [1.0, 1.07])
def test_places_are_the_integral_of_the_tangent(element, stretch):
    """Up to all fractions of an element, by 20 Gauss points; a stretched cable moves by more."""
    chain = Chain(LENGTH, 5, element)
    kind, (x, w) = chain.kind, np.polynomial.legendre.leggauss(20)
    rest = np.random.default_rng(1).normal(size=chain.n_cells)
    segments = segments_of(chain, 0.5 * wavy(chain), rest=rest, stretch=stretch, bubble=0.05)
    for segment in segments[:5]:
        assert not number(kind.advance(segment, 0.0)).any()
        np.testing.assert_array_equal(
            number(kind.advance(segment, 1.0)), number(kind.advance(segment))
        )
        u = ca.SX.sym("u")
        tangent = ca.Function("tangent", [u], [kind.tangent(segment, u)])
        for u in (0.2, 0.5, 1.0):
            tangents = np.array([tangent(u * (z + 1) / 2) for z in x])[..., 0]
            exact = chain.h * u * (w / 2) @ tangents
            # Three Gauss points err by h f/ 2e6. Of the sixth power of u is the square of what
            # the rest shape's bend c < 3 1/m turns, c h u^3 / 3: h (c h / 3)^2 / 5600 < 1e-6.
            np.testing.assert_allclose(number(kind.advance(segment, u)), exact, rtol=0, atol=1e-6)
            if kind.n_inner == 0:
                sizes = np.hypot(*tangents.T)
                np.testing.assert_allclose(sizes, stretch, rtol=ROUNDING)


@SMOOTH
def test_smooth_elements_have_one_tangent_at_a_node(element):
    """Neither the bubble nor the rest shape's variation turns the ends of an element."""
    chain = Chain(LENGTH, 4, element)
    rest = np.random.default_rng(1).normal(scale=3.0, size=chain.n_cells)
    phi = wavy(chain)
    segments = segments_of(chain, phi, rest=rest, stretch=1.1, bubble=0.3)
    for j, segment in enumerate(segments):
        for u, heading in ((0.0, phi[j]), (1.0, phi[j + 1])):
            exact = 1.1 * np.array([np.cos(heading), np.sin(heading)])
            np.testing.assert_allclose(number(chain.kind.tangent(segment, u)), exact, atol=ROUNDING)


@EVERY
def test_the_plain_element_has_the_same_nodes_and_no_inner_unknowns(element):
    kind, plain = ELEMENTS[element], ELEMENTS[ELEMENTS[element].plain]
    assert plain.n_inner == 0
    assert (plain is kind) == (kind.n_inner == 0)
    one, other = (k.layout(LENGTH, 5, (True, False)) for k in (kind, plain))
    np.testing.assert_array_equal(one.nodes, other.nodes)
    chain = Chain(LENGTH, 5, element)
    phi, rest = wavy(chain), np.random.default_rng(1).normal(size=chain.n_cells)
    straight = nodes(chain, phi, rest=rest)
    np.testing.assert_array_equal(straight, nodes(Chain(LENGTH, 5, kind.plain), phi, rest=rest))


def test_a_chain_that_cannot_be():
    with pytest.raises(DloError, match="at least 2 elements, got n = 1"):
        Chain(LENGTH, 1)
    with pytest.raises(DloError, match="'beam' is not known in a plane; use one of"):
        Chain(LENGTH, 4, "beam")


# ---- rest curvature inside ---------------------------------------------------------------------


@pytest.mark.parametrize("n", [3, 4, 9])
def test_rest_curvature_inside_cells_of_a_parabola(n):
    """kappa_0 = a + b s + c s^2 by its means: mean, slope and bend times the width, everywhere."""
    chain, (a, b, c) = Chain(LENGTH, n, "arc"), (1.0, -4.0, 9.0)
    low, high = chain.cells.T
    middle, h = (low + high) / 2, chain.h
    means = a + b * middle + c * (middle**2 + h**2 / 12)
    exact = np.stack([means, (b + 2 * c * middle) * h, np.full(n, c * h**2)], axis=1)
    np.testing.assert_allclose(chain.rest_inside(means[:, None])[..., 0], exact, atol=1e-13)


def test_rest_curvature_inside_few_cells_and_beside_clamps():
    """Two cells tell a slope, one its mean; a segment without a cell has none."""
    two = Chain(LENGTH, 2, "arc").rest_inside(np.array([[1.0], [3.0]]))[..., 0]
    np.testing.assert_array_equal(two, [[1.0, 2.0, 0.0], [3.0, 2.0, 0.0]])
    one = Chain(LENGTH, 2, "link").rest_inside(np.array([[5.0]]))[..., 0]
    np.testing.assert_array_equal(one, [[5.0, 0.0, 0.0], [0.0, 0.0, 0.0]])
    means = np.arange(6.0)[:, None]
    clamped = Chain(LENGTH, 5, "link", True, True).rest_inside(means)[..., 0]
    np.testing.assert_array_equal(clamped[:, 0], [*np.arange(6.0), 0.0])
    # Many poses and directions at once.
    many = np.random.default_rng(0).normal(size=(3, 4, 2))
    chain = Chain(LENGTH, 4, "arc")
    each = [[chain.rest_inside(row[:, [k]])[..., 0] for k in (0, 1)] for row in many]
    np.testing.assert_array_equal(chain.rest_inside(many), np.moveaxis(each, 1, -1))


# ---- the bubble --------------------------------------------------------------------------------


@pytest.mark.parametrize("tension", [0.0, 2.0, 20.0, -0.2, -0.5, -20.0])
def test_the_bubble_minimises_the_energy_of_its_element(tension):
    """A load f across the chord and a tension N along it: the Lagrangian, minimised by hand.

    V = EI/2 int (dphi/ds)^2 ds - int (N, f) . t(u) ds. Under compression the bubble's stiffness
    is that of V down to nine tenths of the section's own, and above a quarter of it for any.
    """
    chain, stiffness, across = Chain(LENGTH, 2, "quadratic"), 0.05, 0.02
    kind = chain.kind
    bubble = ca.SX.sym("bubble")
    plain = segments_of(chain, np.zeros(3))[0]
    segment = Segment(**{**vars(plain), "inner": bubble, "square": bubble**2})

    def elastic(segment: Segment) -> ca.SX:
        return kind.elastic(segment, Section(ca.SX(stiffness), ca.SX(0)))

    lagrangian = elastic(segment) - ca.dot(ca.DM([tension, across]), kind.advance(segment))
    found = kind.condensed(segment, lagrangian, elastic)
    energy = ca.Function("energy", [bubble], [lagrangian])
    own = 16 / 3 * stiffness / chain.h  # int (4 (1 - 2u) / h)^2 h du
    geometric = tension * chain.h * 8 / 15  # int (4u (1 - u))^2 h du
    torque = across * chain.h * 2 / 3  # int 4u (1 - u) h du
    x = geometric / own
    if tension >= 0:
        exact = torque / (own + geometric)
        assert number(found.inner) == pytest.approx(exact, rel=1e-12)
        assert number(found.lagrangian) == pytest.approx(float(energy(exact)), abs=1e-15)
    else:
        stiff = torque / number(found.inner) / own
        assert 0.25 < stiff <= 1.0
        if x > -0.1:
            assert stiff == pytest.approx(1 + x, rel=1e-12)
