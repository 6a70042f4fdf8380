"""What noise, fixtures and parameters let expect of a pose's distances, against drawn repeats."""

from dataclasses import replace

import numpy as np
import pytest

from dlo_casadi.effects import CableData
from dlo_casadi.equilibrium.pose import HeldPose
from dlo_casadi.estimation.fit import fit_model
from dlo_casadi.estimation.prediction import predict_poses, uncertainty_of
from dlo_casadi.model.cable_model import CableModel
from dlo_casadi.model.tolerances import Tolerances
from dlo_casadi.sensing.measured_pose import MeasuredPose
from dlo_casadi.session.stages import fit_stage

STD, DRAWN = 4e-4, 60
CABLE = CableData(0.8, 0.05, 0.008, 0.02)
LOOM = replace(CABLE, torsional_stiffness=0.015)
S = np.linspace(0.03, 0.97, 40) * CABLE.length
PLANE = CableModel(CABLE, 12, n_rest=0)
SPACE = CableModel(LOOM, 8, start="clamped", n_rest=0, gravity=(0.0, 0.0, -9.81))
TOLERANCES = Tolerances(end=6e-4, rotation=1e-5)


def poses_of(model):
    """Three, the cable well below the chord, so that it moves along itself, too."""
    if not model.in_space:
        return [
            HeldPose((0.0, 0.0), end, name=str(end)) for end in ((0.4, 0.1), (0.5, 0.0), (0.3, 0.3))
        ]
    held = {"start_orientation": (0.0, 0.0, 0.0, 1.0)}
    ends = ((0.4, 0.1, 0.1), (0.5, -0.1, 0.0), (0.3, 0.2, 0.2))
    return [HeldPose((0.0, 0.0, 0.0), end, **held, name=str(end)) for end in ends]


def repeats(model, p, poses, scatter, marked, rng, near=None):
    """Measured poses whose ends are off by a scatter (d,) [m] each, near known equilibria."""
    ends = [pose.end + scatter * rng.normal(size=len(scatter)) for pose in poses]
    there = [replace(pose, end=tuple(end)) for pose, end in zip(poses, ends, strict=True)]
    found = predict_poses(model, p, np.zeros(model.chain.n_rests), there, near)
    s = S if marked else None
    return [
        MeasuredPose.of_points(
            pose, x.curve.at(S) + STD * rng.normal(size=(len(S), x.curve.d)), s=s
        )
        for pose, x in zip(poses, found, strict=True)
    ]


@pytest.mark.parametrize(
    ("model", "marked"),
    [
        pytest.param(PLANE, False, id="plane-lines"),
        pytest.param(PLANE, True, id="plane-markers", marks=pytest.mark.long),
        pytest.param(SPACE, False, id="space-lines", marks=pytest.mark.long),
        pytest.param(SPACE, True, id="space-markers"),
    ],
)
def test_expected_distances_are_those_of_drawn_hangings(model, marked):
    """Mean square ratio 1: of lines across the cable, of markers along it, too."""
    rng, poses = np.random.default_rng(0), poses_of(model)
    d = len(poses[0].start)
    true = np.full(d, TOLERANCES.end)
    fit = fit_model(model, repeats(model, model.nominal, poses, true, marked, rng), TOLERANCES, STD)
    stage = fit_stage("batch", fit, fit.problem.history, {})
    expected = np.array([stage.shapes[pose.name].expected for pose in poses])
    assert fit.expected_error == pytest.approx(np.sqrt(np.mean(expected**2)), rel=0.01)
    scatter = np.array([uncertainty_of(fit).scatter[f"end_{axis}"] for axis in "xyz"[:d]])
    predicted = predict_poses(model, fit.p, fit.rest, poses)
    curves, near = zip(*((x.curve, x.equilibrium.x) for x in predicted), strict=True)
    ratio = []
    for score in rng.normal(size=DRAWN):  # no end holds a twist, so that EI alone acts
        p = fit.p.copy()
        p[0] += score * fit.std("bending_stiffness")
        drawn = repeats(model, p, poses, scatter, marked, rng, near)
        distances = [item.distances(curve) for item, curve in zip(drawn, curves, strict=True)]
        ratio.append(np.mean((np.array(distances) / expected) ** 2))
    # Three standard errors of their mean, and a hundredth for what is not linear.
    assert np.mean(ratio) == pytest.approx(1.0, abs=3 * np.std(ratio) / np.sqrt(DRAWN) + 0.01)
    assert np.std(ratio) / np.sqrt(DRAWN) < 0.03
