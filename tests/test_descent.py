"""Descents stay finite, and forces balance where they say so."""

import numpy as np
import pytest

from dlo_casadi.effects import CableData, Tether
from dlo_casadi.equilibrium.minima import _convex, descend
from dlo_casadi.equilibrium.pose import HeldPose
from dlo_casadi.model.assembly import Assembly, Inputs, Shapes
from dlo_casadi.model.cable_model import CableModel
from dlo_casadi.rod.band import BandMatrix


def test_shifts_end_where_the_nodes_part_is_definite():
    """A corner of the wrong sign gives an inertia that no shift makes right."""
    rng = np.random.default_rng(0)
    diagonal, upper = rng.normal(size=(4, 6, 3, 3)), rng.normal(size=(4, 5, 3, 3))
    diagonal += np.swapaxes(diagonal, -1, -2)
    matrix = BandMatrix(diagonal, upper, rng.normal(size=(4, 6, 3, 1)), np.full((4, 1, 1), 1e9))
    nodes = BandMatrix(diagonal, upper, np.zeros((4, 6, 3, 0)), np.zeros((4, 0, 0)))
    least = -np.linalg.eigvalsh(nodes.dense())[:, 0]
    shift = np.zeros(4)
    for _ in range(60):
        _, shift = _convex(matrix, 1, shift, np.zeros(0))
    assert np.all(shift >= least)
    assert np.all(shift <= matrix.row_sum)
    # 18 rows of 9 numbers of order one.
    assert shift.max() < 30.0


@pytest.mark.parametrize("element", ["arc", "quadratic"])
@pytest.mark.parametrize("stiffness", [1.0, 400.0])
def test_a_soft_cable_on_a_strong_tether_is_brought_to_rest(element, stiffness):
    """From random first guesses; its springs outweigh its own stiffness a millionfold."""
    cable = CableData(length=0.6, mass=0.06, diameter=0.006, bending_stiffness=2e-5)
    model = CableModel(cable, 10, element, "clamped", "clamped", effects=(Tether(),))
    p = np.array([2e-5, stiffness, 0.3, 0.25, 0.15])
    x = np.random.default_rng(0).normal(scale=0.5, size=(12, 11, 1)).cumsum(axis=1)
    shapes = Shapes.declared(x, np.zeros((12, model.n_border)))
    given = Inputs.of(
        p, np.zeros(10), np.repeat(HeldPose((0.0, 0.0), (0.4, 0.1)).vector[None], 12, 0)
    )

    found = descend(Assembly(model, shapes, given))

    force = Assembly(model, found.shapes, given).imbalance()
    assert np.abs(force.x[found.balanced]).max() < 1e-8
    assert found.converged.sum() >= 11
