"""Where a fit begins: twists of poses whose end clamp is rolled by nearly half a turn."""

from dataclasses import replace

import numpy as np
from test_relaxation import ROLL, problem_of

from dlo_casadi.estimation.problem import Values
from dlo_casadi.estimation.relaxation import SOFTNESS, Relaxation
from dlo_casadi.estimation.start import _either_way, measured_shapes
from dlo_casadi.model.cable_model import END_ROLL
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
    values = Values(theta, *measured_shapes(problem, roll))
    problem, fixed = problem.weighed(values), np.ones(len(theta), dtype=bool)
    begun = _either_way(problem, Relaxation(problem, SOFTNESS[0]).solve(values, fixed))

    true = model.node.turning(measured_shapes(problem, ROLL)[0].x)
    before, after = (model.node.turning(x.shapes.x) for x in (values, begun))
    assert true[0] > 2.0
    assert before[0] < -2.0
    np.testing.assert_allclose(after, true + OFF, atol=0.2)
