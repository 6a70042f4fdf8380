"""Fits of cables that carry a state from pose to pose, and poses that are in no fit."""

from dataclasses import replace

import numpy as np
import pytest

from dlo_casadi.effects import CableData, RestCurvatureDrift
from dlo_casadi.equilibrium.equilibrium import NEARBY
from dlo_casadi.equilibrium.pose import HeldPose
from dlo_casadi.estimation.batch import solve_batch
from dlo_casadi.estimation.constrained import _predicted_next
from dlo_casadi.estimation.descent import descend
from dlo_casadi.estimation.fit import fit_model
from dlo_casadi.estimation.prediction import predict_poses
from dlo_casadi.model.cable_model import CableModel
from dlo_casadi.model.tolerances import Tolerances
from dlo_casadi.sensing.measured_pose import MeasuredPose
from dlo_casadi.session.fitting import Minimum, confirmed

CABLE = CableData(0.8, 0.08, 0.006, bending_stiffness=0.1)
HELD = {"start": "clamped", "end": "clamped", "gravity": (0.0, -9.81)}
MODEL = CableModel(CABLE, 12, "quadratic", n_rest=2, effects=(RestCurvatureDrift(),), **HELD)
TRUE = {"rest_curvature_drift.rate": 0.25}
NOISE, HELD_OUT, HANGING = 3e-4, 2, 4


def session() -> list[MeasuredPose]:
    """Eight poses of arches, one of which hangs, and one of which is held out."""
    p = np.array([TRUE.get(q.name, q.nominal) for q in MODEL.parameters])
    rng, poses = np.random.default_rng(4), []
    for _ in range(8):
        place = (rng.uniform(0.5, 0.7) * CABLE.length, rng.uniform(-0.1, 0.1))
        poses.append(HeldPose((0.0, 0.0), place, *rng.uniform(-0.4, 0.4, 2)))
    s, rest = np.linspace(0.02, 0.98, 14) * CABLE.length, MODEL.rest_basis @ np.array([0.5, -0.4])
    arches = predict_poses(MODEL, p, rest, poses)
    starts = [-one.equilibrium.x if k == HANGING else None for k, one in enumerate(arches)]
    return [
        MeasuredPose.of_points(
            pose,
            shape.curve.at(s) + rng.normal(scale=NOISE, size=(14, 2)),
            held_out=k == HELD_OUT,
            s=s,
        )
        for k, (pose, shape) in enumerate(
            zip(poses, predict_poses(MODEL, p, rest, poses, starts), strict=True)
        )
    ]


@pytest.fixture(scope="module")
def drifting():
    """Fit of a cable that drifts."""
    return fit_model(MODEL, session(), Tolerances(), NOISE)


def test_another_minimum_may_not_move_a_pose_that_no_point_holds(drifting):
    """It would change what the next poses start from, and pass for a better fit."""
    lower = replace(drifting.point, objective=drifting.point.objective - 5.0)
    assert confirmed(drifting, Minimum(lower)).point is lower

    x = lower.shapes.x.copy()
    x[HELD_OUT, 4:8] += 1.0
    elsewhere = replace(lower, shapes=replace(lower.shapes, x=x))
    assert confirmed(drifting, Minimum(elsewhere)) is drifting


def test_ipopt_does_not_move_the_ends_of_a_pose_that_is_held_out(drifting):
    """Without a prior they would move by centimetres, for whatever rest shape they leave behind."""
    fit = descend(drifting)
    point, _ = solve_batch(fit.problem, fit.point)
    own, found = fit.point.shapes.deviation[HELD_OUT], point.shapes.deviation[HELD_OUT]
    np.testing.assert_allclose(found, own, rtol=1e-12)
    assert point.objective == pytest.approx(fit.point.objective, abs=1e-2)


def test_a_pose_in_another_equilibrium_leads_no_later_one_astray(drifting):
    """Predicted from the ends alone, every later pose would start from a wrong state."""
    model, fitted = drifting.model, drifting.point.shapes.x
    alone = predict_poses(
        model, drifting.p, drifting.rest, [item.pose for item in drifting.problem.history]
    )
    after = _predicted_next(drifting)

    def same(found):
        pairs = zip(found, fitted, strict=True)
        return [model.node.same(one.equilibrium.x, x, NEARBY) for one, x in pairs]

    assert [k for k, near in enumerate(same(after)) if not near] == [HANGING]
    assert not all(same(alone)[HANGING + 1 :])
