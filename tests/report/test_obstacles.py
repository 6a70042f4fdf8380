"""Obstacles and what touches them in the pictures of a report."""

from types import SimpleNamespace

import numpy as np
import pytest

from dlo_casadi.cable.picture import outlines
from dlo_casadi.report.scene import Plane as Board
from dlo_casadi.report.scene import contact_marks, obstacle_marks
from dlo_casadi.rod.obstacles import Capsule, Plane

LENGTH = 0.8
SHAPES = {
    "disc": Capsule((0.3, -0.1), (0.3, -0.1), 0.05),
    "stadium": Capsule((0.3, -0.1), (0.4, 0.0), 0.05),
    "sphere": Capsule((0.3, -0.1, 0.2), (0.3, -0.1, 0.2), 0.05),
    "bar": Capsule((0.3, -0.1, 0.2), (0.4, 0.1, 0.2), 0.05),
}


@pytest.mark.parametrize("name", SHAPES)
def test_outlines_lie_on_the_surface(name):
    shape = SHAPES[name]
    points = np.linspace(np.array(shape.a) - 0.3, np.array(shape.b) + 0.3, 20)
    lines = outlines(shape, points, LENGTH)
    assert np.abs(shape.near(np.concatenate(lines)).distance).max() < 1e-9
    for axis in np.eye(len(shape.a)):  # all around
        assert np.ptp(np.concatenate(lines) @ axis) > 1.9 * shape.radius


def test_of_a_long_bar_the_part_beside_the_cable_is_drawn():
    bar = Capsule((-5.0, 0.0, 0.0), (5.0, 0.0, 0.0), 0.05)
    points = np.linspace([0.1, 0.0, 0.1], [0.5, 0.0, 0.1], 5)
    x = np.concatenate(outlines(bar, points, LENGTH))[:, 0]
    assert [x.min(), x.max()] == pytest.approx([0.1 - 0.048, 0.5 + 0.048])


@pytest.mark.parametrize(
    ("normal", "point"), [((0.0, 1.0), (9.0, -0.2)), ((0, 0.6, 0.8), (0, 0, 0.1))]
)
def test_a_plane_is_drawn_below_the_cable(normal, point):
    """In space a net of lines on it, in the plane a line, hatched on the side without cable."""
    plane = Plane(point, normal)
    points = np.linspace(np.zeros(len(normal)), 0.6 * np.eye(len(normal))[0], 9)
    distance = plane.near(np.concatenate(outlines(plane, points, LENGTH))).distance
    assert distance.max() < 1e-9
    assert distance.min() == pytest.approx(-0.02 if len(normal) == 2 else 0.0, abs=1e-9)
    x = np.concatenate(outlines(plane, points, LENGTH))[:, 0]
    assert x.min() < 0.0 < 0.6 < x.max()


def test_stretches_in_contact_are_marked_with_their_force():
    curve = np.stack([np.linspace(0.0, LENGTH, 81), np.zeros(81)], axis=1)
    contacts = [
        {"obstacle": "table", "from": 0.2, "to": 0.5, "force": [0.0, -0.4]},
        {"obstacle": "bar", "from": 0.7, "to": 0.7, "force": [0.1, 0.0]},
    ]
    board, shape = Board(LENGTH, 0.5), SimpleNamespace(curve=curve, contacts=contacts)
    laid, table, touched, bar = contact_marks(board, shape, LENGTH)
    assert laid.kind == touched.kind == "contact"
    assert laid.points[[0, -1], 0] == pytest.approx([0.2, 0.5])
    assert 0.0 < np.ptp(touched.points[:, 0]) < 0.02  # a point is seen, too
    assert table.points[:2] == pytest.approx(np.array([[0.35, 0.0], [0.35, -0.2]]))
    assert bar.points[:2] == pytest.approx(np.array([[0.7, 0.0], [0.75, 0.0]]))
    (outline,) = obstacle_marks(board, [SHAPES["disc"]], curve, LENGTH)
    assert outline.kind == "obstacle"
