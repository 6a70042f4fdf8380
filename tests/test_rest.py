"""The basis of the rest curvature: its means over cells, and what coefficients mean."""

import itertools

import numpy as np

from dlo_casadi.equilibrium.curve import chord_places
from dlo_casadi.equilibrium.pose import HeldPose
from dlo_casadi.rod.chain import Chain, RestCurvature

LENGTH = 0.8  # m


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


def test_few_points_of_a_half_circle_are_as_far_along_it_as_their_chords():
    """Chords of a fifth are 2 % shorter than the cable: held at both ends, they are scaled."""
    s, radius = np.linspace(0.0, LENGTH, 6), LENGTH / np.pi
    places = radius * np.stack([1 - np.cos(s / radius), np.sin(s / radius)], axis=1)
    pose = HeldPose((0.0, 0.0), tuple(places[-1]))
    np.testing.assert_allclose(chord_places(places[1:-1], pose, LENGTH), s[1:-1], rtol=2e-3)
    free = chord_places(places[1:-1], HeldPose((0.0, 0.0)), LENGTH)
    chord = 2 * radius * np.sin(np.pi / 10)
    np.testing.assert_allclose(free, chord * np.arange(1, 5), rtol=2e-3)


def test_a_straight_cable_has_no_coefficients():
    rest = RestCurvature(LENGTH, 0)
    assert rest.cell_means(Chain(LENGTH, 3).cells).shape == (3, 0)
    assert rest.basis(np.zeros(2)).shape == (2, 0)
