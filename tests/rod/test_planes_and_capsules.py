"""Obstacles: distances by a search on their axis, derivatives by differences, sides of bars."""

import casadi as ca
import numpy as np
import pytest

from dlo_casadi.rod.obstacles import Capsule, Plane, bars_of

EVERY = pytest.mark.parametrize(
    "obstacle",
    [
        Plane((0.1, 0.2), (0.6, 0.8)),
        Plane((0.1, 0.2, -0.1), (0.6, 0.0, 0.8)),
        Capsule((0.1, 0.2), (0.1, 0.2), 0.3),
        Capsule((-0.4, 0.2), (0.5, -0.1), 0.3),
        Capsule((0.1, 0.2, -0.1), (0.1, 0.2, -0.1), 0.3),
        Capsule((-0.4, 0.2, -0.1), (0.5, -0.1, 0.3), 0.3),
    ],
    ids=["line", "plane", "disc", "stadium", "sphere", "capsule"],
)
DOWN = (0.0, 0.0, -9.81)


def places(obstacle) -> np.ndarray:
    """Places (40, d) [m] on all sides: also beyond both ends of an axis of 0.9 m."""
    dimension = len(obstacle.point if isinstance(obstacle, Plane) else obstacle.a)
    return np.random.default_rng(0).uniform(-1.5, 1.5, size=(40, dimension))


def distance(obstacle, place) -> float:
    """Distance [m] of a place from a surface."""
    if isinstance(obstacle, Plane):
        return float((place - obstacle.point) @ np.array(obstacle.normal))
    share = np.linspace(0.0, 1.0, 20001)[:, None]
    axis = np.array(obstacle.a) + share * np.subtract(obstacle.b, obstacle.a)
    return float(np.linalg.norm(place - axis, axis=1).min()) - obstacle.radius


@EVERY
def test_distances_normals_and_their_change(obstacle):
    x, d = places(obstacle), 1e-5
    near = obstacle.near(x)
    # A search in steps of 5e-5 m errs by their square over the distance.
    np.testing.assert_allclose(near.distance, [distance(obstacle, one) for one in x], atol=1e-7)
    np.testing.assert_allclose(obstacle.symbolic(ca.DM(x.T)).full()[0], near.distance, atol=1e-14)
    steps = d * np.eye(x.shape[1])
    ahead, back = ([obstacle.near(x + sign * step) for step in steps] for sign in (1, -1))
    pairs = list(zip(ahead, back, strict=True))
    slopes = np.stack([(a.distance - b.distance) / (2 * d) for a, b in pairs], axis=-1)
    np.testing.assert_allclose(near.normal, slopes, atol=1e-9)
    turned = np.stack([(a.normal - b.normal) / (2 * d) for a, b in pairs], axis=-1)
    hessian = near.bends @ np.swapaxes(near.bends, -1, -2)
    np.testing.assert_allclose(hessian, turned, atol=1e-7)


@EVERY
def test_an_obstacle_that_has_grown_is_nearer(obstacle):
    x = places(obstacle)
    grown = obstacle.grown(0.05).near(x)
    np.testing.assert_allclose(grown.distance, obstacle.near(x).distance - 0.05, atol=1e-14)
    np.testing.assert_array_equal(grown.normal, obstacle.near(x).normal)


@pytest.mark.parametrize(
    ("axis", "up"),
    [
        ((0.0, 0.4, 0.0), (0.0, 0.0, 1.0)),
        ((0.3, 0.0, 0.4), (-0.8, 0.0, 0.6)),
        # Steeper than a tenth across gravity: nothing passes over or under it.
        ((0.11, 0.0, 1.0), (-1.0, 0.0, 0.11)),
        ((0.09, 0.0, 1.0), None),
        ((0.0, 0.0, 0.4), None),
        ((0.0, 0.0, 0.0), None),
    ],
)
def test_the_upper_side_of_a_bar_is_across_it(axis, up):
    bar = Capsule((0.1, 0.2, 0.3), tuple(np.add((0.1, 0.2, 0.3), axis)), 0.02)
    found = bar.up(DOWN)
    assert (found is None) == (up is None)
    if up is not None:
        np.testing.assert_allclose(found, np.array(up) / np.linalg.norm(up), atol=1e-14)
    assert bar.up((0.0, 0.0, 0.0)) is None
    listed = bars_of([Plane((0.0,) * 3, (0.0, 0.0, 1.0)), bar], DOWN)
    assert [one for one, _ in listed] == ([] if up is None else [bar])
