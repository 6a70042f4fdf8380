"""The compiled solver gives the shapes of equilibrium.py on every bench session."""

import shutil
from pathlib import Path

import numpy as np
import pytest
from solvers import QUICK

from dlo_casadi.codegen import CompiledSolver
from dlo_casadi.config import load_config, read_yaml
from dlo_casadi.effects import EFFECTS, ClampAngle
from dlo_casadi.equilibrium.solve import solve_equilibrium
from dlo_casadi.model.assembly import Assembly, Inputs
from dlo_casadi.session.fitting import declared_model

pytestmark = pytest.mark.skipif(shutil.which("cc") is None, reason="no C compiler (cc)")

DATA = Path(__file__).parents[1] / "data"
SESSIONS = sorted(path.parent.name for path in DATA.glob("bench/*/session.yaml"))
# Name and numbers in truth.yaml -> effect and its parameters.
TRUTH = {
    "lump": lambda place, mass: ("lumped_mass", (mass, place)),
    "length": lambda d: ("length_error", (d,)),
    "end_spring": lambda k, heading, *_: ("end_spring", (k, heading)),
    "creep": lambda rate: ("rest_curvature_drift", (rate,)),
    "softening": lambda c: ("bending_softening", (1 / c,)),
    "stiff_section": lambda *section: ("stiff_section", section),
    "extens": lambda stiffness: ("axial_stretch", (1 / stiffness,)),
    "taper": lambda slope: ("stiffness_gradient", (slope,)),
}


def session(name, n):
    """Model with the session's true effects, parameters, rest curvature, poses."""
    config = load_config(DATA / "bench" / name / "session.yaml")
    truth = read_yaml(DATA / "bench_truth" / name / "truth.yaml")
    model = declared_model(config).model.with_mesh(n)
    p = list(model.nominal)
    p[0] = truth["bending_stiffness"]
    for key, numbers in truth["effects"].items():
        values = np.atleast_1d(numbers)
        if key == "clamp_error":
            effect = ClampAngle(start=model.start == "clamped", end=model.end == "clamped")
            values = [
                v for v, s in zip(values, (model.start, model.end), strict=True) if s == "clamped"
            ]
        elif key in TRUTH:
            label, values = TRUTH[key](*values)
            effect = EFFECTS[label]()
        else:
            continue  # a cause outside the model, e.g. a tether
        if effect.label in {known.label for known in model.effects}:
            first = next(i for i, q in enumerate(model.names) if q.startswith(effect.label + "."))
            p[first : first + len(values)] = values
        else:
            model = model.with_effect(effect)
            p += list(values)
    s, kappa = (np.array(truth["rest_curvature"][k]) for k in ("s", "kappa"))
    rest = np.interp(model.chain.cells.mean(axis=1), s, kappa)
    return model, np.array(p), rest, [pose.held for pose in config.experiment.poses]


def sessions():
    """One with a state, clamps, a free end, several effects; test_agreement.py has all effects."""
    few = ("drift", "held_askew", "overhang", "two_effects")
    return [pytest.param(x, marks=[pytest.mark.long] * (x not in few)) for x in SESSIONS]


@pytest.mark.parametrize("name", sessions())
def test_session(name):
    model, p, rest, poses = session(name, n=12)
    solver = CompiledSolver(model, p, rest, flags=QUICK)
    for pose in poses[: 3 if model.has_state else 6]:
        expected = solve_equilibrium(model, p, rest, pose)
        shape = solver.solve(pose)
        assert np.abs(shape.points - expected.points).max() < 1e-8
        assert shape.min_bend_radius == pytest.approx(expected.min_bend_radius, rel=1e-6)
        if model.has_state:  # a drift enters with its latest state: compile anew
            given = Inputs.of(p, rest, pose.vector[None])
            rest = Assembly(model, expected.shapes, given).state_after()[0][0]
            solver = CompiledSolver(model, p, rest, flags=QUICK)
