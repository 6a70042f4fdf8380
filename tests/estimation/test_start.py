"""Where a fit begins: twists of poses whose end clamp is rolled by nearly half a turn."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from test_relaxation import ROLL, problem_of

from dlo_casadi.estimation import start as starting_points
from dlo_casadi.estimation.start import Guess, measured_shapes, turned_either_way
from dlo_casadi.model.cable_model import END_ROLL, STIFFNESSES
from dlo_casadi.sensing.noise import NoiseModel

OFF = 0.5


def test_twists_are_turned_the_way_that_fits():
    """Beside a roll that is off by 0.5 rad, that nearest to none of one pose is the wrong one."""
    problem, p = problem_of(marked=False)
    problem = replace(problem, noise=NoiseModel(3e-3))
    unknowns, model = problem.unknowns, problem.unknowns.model

    roll = ROLL + OFF
    theta = unknowns.pack(p, np.zeros(model.n_coefficients))
    theta[unknowns.names.index(END_ROLL)] = roll / 0.1
    held = np.isin(unknowns.names, (*STIFFNESSES, END_ROLL))
    shapes, projections = measured_shapes(problem, roll)
    problem = problem.weighed(Guess(theta, shapes, projections))
    begun = turned_either_way(problem, Guess(theta, shapes, projections), held, roll)

    true = model.node.turning(measured_shapes(problem, ROLL)[0].x)
    before, after = (model.node.turning(x) for x in (shapes.x, begun.shapes.x))
    assert true[0] > 2.0
    assert before[0] < -2.0
    np.testing.assert_allclose(after, true + OFF, atol=0.2)


@pytest.mark.parametrize(
    ("objectives", "looked"),
    [
        ({-3: 9, -2: 8, -1: 7, 0: 1, 1: 3, 2: 4, 3: 5}, {-1, 0, 1}),
        ({-3: 9, -2: 8, -1: 7, 0: 5, 1: 3, 2: 4, 3: 5}, {-2, -1, 0, 1, 2}),
        ({-3: 3, -2: 1, -1: 9, 0: 8, 1: 7, 2: 6, 3: 5}, {-3, -2, -1, 0, 1, 2, 3}),  # a ridge
        ({-3: 3, -2: 1, -1: None, 0: None, 1: None, 2: 6, 3: 5}, {-3, -2, 2, 3}),  # singular
    ],
)
def test_decades_are_tried_until_the_best_lies_between_others(monkeypatch, objectives, looked):
    def look(problem, guess, held, iterations):
        objective = objectives[round(guess.theta[0] / np.log(10))]
        return None if objective is None else replace(guess, objective=objective)

    monkeypatch.setattr(starting_points, "all_at_once", look)
    problem = SimpleNamespace(unknowns=SimpleNamespace(names=STIFFNESSES[:1]))
    near, held = Guess(np.zeros(1), None, []), np.zeros(1, bool)

    def decades(whole):
        all_of_them = starting_points.DECADES
        found = starting_points._outwards(problem, near, held, all_of_them, whole=whole)
        return {round(guess.theta[0] / np.log(10)) for guess in found}

    assert decades(whole=False) == looked
    assert decades(whole=True) == {k for k, value in objectives.items() if value is not None}
