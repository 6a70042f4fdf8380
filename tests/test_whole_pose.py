"""A pose as one expression for IPOPT: the same numbers as the assembly of its segments."""

import casadi as ca
import numpy as np
import pytest
from perturbed import any_rest, any_shapes

from dlo_casadi.effects import (
    AxialStretch,
    CableData,
    ClampAngle,
    EdgeBias,
    EndSpring,
    ImageScale,
    LumpedMass,
    RestCurvatureDrift,
)
from dlo_casadi.model.assembly import Assembly, Inputs
from dlo_casadi.model.cable_model import CableModel
from dlo_casadi.model.whole_pose import PoseSymbols, balance, curve, potential, rest_after
from dlo_casadi.rod.chain import ELEMENTS

CABLE = CableData(length=1.2, mass=0.3, diameter=0.01, bending_stiffness=0.02)
# Start, end [m], headings [rad], no camera.
ENDS = np.array([0.1, 0.2, 0.9, 0.1, 0.2, -0.3, 0.0, 0.0, 0.0])
EFFECTS = (AxialStretch(), LumpedMass(), RestCurvatureDrift(), ImageScale(), EdgeBias())
ALL = pytest.mark.parametrize("element", ELEMENTS)
BOUNDARIES = pytest.mark.parametrize(
    "boundary", [("pinned", "pinned"), ("clamped", "clamped"), ("clamped", "free")]
)


def model_of(element: str, boundary: tuple[str, str]) -> tuple[CableModel, np.ndarray]:
    own = ClampAngle() if boundary[1] == "clamped" else EndSpring()
    model = CableModel(CABLE, 4, element, *boundary, effects=(*EFFECTS, own))
    bias = 0.01 * np.arange(1, 9)
    return model, np.array([0.02, 0.02, 0.1, 0.5, 0.2, 1.1, *bias, 0.3, 0.1])


@ALL
@BOUNDARIES
def test_expressions_are_what_the_assembly_says(element, boundary):
    model, p = model_of(element, boundary)
    s, shapes, rest = PoseSymbols.of(model), any_shapes(model), any_rest(model)[0]
    a = Assembly(model, shapes, Inputs.of(p, rest, ENDS[None]))
    arguments = [s.x, s.lam, s.p, s.rest, s.pose, s.deviation]
    expressions = [balance(model, s), curve(model, s), rest_after(model, s)]
    numbers = ca.Function("pose", arguments, expressions)(
        shapes.x.ravel(), shapes.lam[0], p, rest, ENDS, shapes.deviation[0]
    )
    exact = [a.balance()[1].rows, a.curve(), a.state_after()[0]]
    for found, expected in zip(numbers, exact, strict=True):
        # The same few dozen terms of order ten, added in another order.
        np.testing.assert_allclose(np.array(found).ravel(), expected.ravel(), atol=1e-13)


@pytest.mark.parametrize(
    ("element", "effect", "own"),
    [
        ("quadratic", LumpedMass(), [0.1, 0.5]),
        ("arc", AxialStretch(), [0.02]),
        ("link", AxialStretch(), [0.02]),
    ],
)
@pytest.mark.parametrize("held", ["pinned", "clamped"])
def test_minimum_over_what_is_inside_is_the_lagrangian(element, effect, own, held):
    """V + lam^T c is quadratic in bubbles or axial strains; its minimum is L, whatever the nodes.

    Under tension: only the Lagrangian keeps a compressed bubble stiff. Bubbles and strains one at
    a time: the Lagrangian leaves out their product.
    """
    model = CableModel(CABLE, 4, element, held, held, effects=(effect,))
    problem, p = potential(model), np.array([0.02, *own])
    shapes, rest = any_shapes(model, scale=0.05), any_rest(model)[0]
    shapes.lam[0, :2] = [-9.0, 0.0]  # N; the cable pulls its end back
    total = problem.energy + ca.dot(ca.DM(shapes.lam[0]), problem.conditions)
    inner = problem.coordinates[model.chain.n_nodes :]
    derivatives = ca.Function(
        "derivatives",
        [problem.coordinates, problem.parameters],
        [total, ca.gradient(total, inner), ca.hessian(total, inner)[0]],
    )
    x = np.concatenate([shapes.x.ravel(), np.zeros(inner.numel())])
    values = np.concatenate([p, rest, ENDS, shapes.deviation[0]])
    value, slope, bend = (np.array(block) for block in derivatives(x, values))
    assert np.all(np.linalg.eigvalsh(bend) > 0)
    least = value - slope.T @ np.linalg.solve(bend, slope) / 2
    exact = Assembly(model, shapes, Inputs.of(p, rest, ENDS[None])).balance()[0][0]
    assert least.item() == pytest.approx(exact, rel=1e-12)
