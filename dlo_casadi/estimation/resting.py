"""Where cables rest on a plane whose height is not known: what their shapes have in common."""

import numpy as np

from dlo_casadi.arrays import FloatArray
from dlo_casadi.effects import Setup
from dlo_casadi.effects.setup import height_of
from dlo_casadi.estimation.problem import Problem
from dlo_casadi.estimation.start import measured_shapes
from dlo_casadi.thresholds import RESTING_APART, RESTING_NOISE


def resting_height(problem: Problem) -> float | None:
    """The lowest height [m] that measured shapes of several poses share, if there is one.

    What lies on a table is at the same height in all poses, and nothing is below it. Fixtures are
    where they are held.
    """
    model = problem.unknowns.model
    if not (any(model.gravity) and model.chain.kind.smooth):
        return None
    length, rest = model.cable.length, np.zeros(model.chain.n_rests)
    places, (shapes, _) = np.linspace(0.0, length, 201), measured_shapes(problem)
    seen = problem.equilibria.seen(shapes, problem.unknowns.fixed, rest)
    heights = height_of([seen[j].curve.at(places) for j in problem.used], model.gravity)
    lowest, inside = heights.min(axis=1), heights.argmin(axis=1)
    hanging = lowest[(inside > 0) & (inside < len(places) - 1)]
    least, most = (share * length for share in RESTING_APART)
    apart = np.clip(RESTING_NOISE * problem.noise.of_points.std, least, most)
    shared = hanging[hanging < lowest.min() + apart]
    return float(shared.mean()) if len(shared) > 1 else None


def on_planes(problem: Problem, theta: FloatArray) -> FloatArray:
    """Theta (size,) whose effects without derivative where they vanish begin where shapes rest."""
    unknowns = problem.unknowns
    model, p = unknowns.model, unknowns.p(theta)
    asked = [x for x in model.effects if not x.gradual]
    found = resting_height(problem) if asked else None
    if found is None:
        return theta
    for effect in asked:
        (start,) = effect.scans(Setup(model.cable, gravity=model.gravity, resting=found))
        for q in effect.parameters(model.cable):
            k = model.names.index(f"{effect.label}.{q.name}")
            if unknowns.fixed[k] == q.nominal:
                p[k] = start[q.name]
    return unknowns.pack(p, unknowns.coefficients(theta))
