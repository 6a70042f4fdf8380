"""An effect far from small is reached from the measured shapes, whatever the cable without it."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from dlo_casadi.diagnosis.candidates import candidates, setup_of
from dlo_casadi.diagnosis.from_data import RelaxedStart, from_data
from dlo_casadi.diagnosis.gram import Screened
from dlo_casadi.effects import BendingSoftening, CableData
from dlo_casadi.equilibrium.pose import HeldPose
from dlo_casadi.estimation.fit import FIRST_STD
from dlo_casadi.estimation.prediction import predict_poses
from dlo_casadi.estimation.problem import Priors, Problem
from dlo_casadi.estimation.result import Fit
from dlo_casadi.estimation.start import begin
from dlo_casadi.estimation.unknowns import Unknowns
from dlo_casadi.model.cable_model import CableModel
from dlo_casadi.model.tolerances import Tolerances
from dlo_casadi.sensing.measured_pose import MeasuredPose
from dlo_casadi.sensing.noise import NoiseModel

HELD = {"start": "clamped", "end": "clamped", "gravity": (0.0, 0.0, -9.81)}
STIFFNESS, SOFTNESS = 0.0128, 0.25


def test_a_strong_softening_is_reached_from_the_shapes():
    true = CableData(1.0, 0.06, 0.006, bending_stiffness=STIFFNESS, torsional_stiffness=0.011)
    soft = CableModel(true, 16, "quadratic", n_rest=0, effects=(BendingSoftening(),), **HELD)
    p = soft.nominal.copy()
    p[soft.names.index("bending_softening.softness")] = SOFTNESS
    rng, s = np.random.default_rng(3), np.linspace(0.04, 0.96, 12)
    measured = []
    for _ in range(6):
        frames = [Rotation.from_rotvec(rng.uniform(-0.7, 0.7, 3)).as_quat() for _ in range(2)]
        way = Rotation.from_rotvec(rng.uniform(-0.6, 0.6, 3))
        end = tuple(way.apply([rng.uniform(0.5, 0.8), 0.0, 0.0]))
        turned = dict(
            zip(("start_orientation", "end_orientation"), map(tuple, frames), strict=True)
        )
        pose = HeldPose((0.0, 0.0, 0.0), end, **turned)
        (shape,) = predict_poses(soft, p, np.zeros(soft.chain.n_rests), [pose])
        points = shape.curve.at(s) + rng.normal(scale=FIRST_STD, size=(len(s), 3))
        measured.append(MeasuredPose.of_points(pose, points))
    plain = CableModel(true, 10, "quadratic", n_rest=0, **HELD)
    unknowns = Unknowns(plain, np.ones(len(plain.names), dtype=bool), plain.nominal)
    noise = NoiseModel(FIRST_STD, source="declared")
    problem = Problem(unknowns, tuple(measured), noise, Priors.of(Tolerances(), plain))
    problem, values = begin(problem, unknowns.pack(plain.nominal, np.zeros(0)))
    misfit = replace(noise.doubted(7e-3), source="misfit", before=noise)
    near, _ = from_data(Fit(replace(problem, noise=misfit), problem.evaluate(values)))
    listed = candidates(near.model, setup_of(near.model, n_poses=6))
    softening = next(x for x in listed if x.name == "bending_softening")

    start = RelaxedStart.of(near, (Screened(softening, 0.0, 1.0, dict(softening.scans[0])),))
    found = start.problem.unknowns.p(start.values.theta)
    names = start.problem.unknowns.model.names
    # The mesh of a search leaves a part of it.
    assert start.left < 2 * start.problem.n_residuals
    assert found[names.index("bending_stiffness")] == pytest.approx(STIFFNESS, rel=0.1)
    assert found[names.index("bending_softening.softness")] == pytest.approx(SOFTNESS, rel=0.1)
