"""Markers at so few places that an effect looks like a wavy rest curvature."""

import numpy as np
import pytest

from dlo_casadi.diagnosis.diagnose import diagnose
from dlo_casadi.diagnosis.from_pose_to_pose import as_line, few_places
from dlo_casadi.effects import CableData, ClampAngle
from dlo_casadi.equilibrium.pose import HeldPose
from dlo_casadi.estimation.fit import fit_model
from dlo_casadi.estimation.prediction import predict_poses
from dlo_casadi.estimation.variances import A_LINE, settle
from dlo_casadi.model.cable_model import CableModel
from dlo_casadi.model.pose_scatter import PoseScatter, modes_in
from dlo_casadi.model.tolerances import Tolerances
from dlo_casadi.sensing.measured_pose import MeasuredPose
from dlo_casadi.session.fitting import nuisances

CABLE = CableData(0.55, 0.45, 0.016, 0.07)
MODEL = CableModel(CABLE, 12, start="clamped", end="free", n_rest=13)
TOLERANCES = Tolerances(heading=0.02)
STD = 2e-3


def fitted(off: float = 0.0, wave: float = 0.0, places: int = 3):
    """Fit of a cable held by a gripper that is `off` [rad], with a wave in its rest curvature."""
    true = MODEL.with_effect(ClampAngle(start=True))
    p = dict(zip(true.names, true.nominal, strict=True))
    p["clamp_angle.start_heading_error"] = off
    s = np.linspace(0.0, 1.0, 13)
    rest = MODEL.rest_basis @ (-0.7 + 0.4 * s + wave * np.cos(2 * np.pi * s))
    rng, at = np.random.default_rng(2), np.linspace(0.0, CABLE.length, places + 1)[1:]
    poses = [HeldPose((0.0, 0.0), None, start_heading=x) for x in np.linspace(-2.4, -0.6, 10)]
    modes, scatter = modes_in(MODEL), PoseScatter(0.15)
    sizes, measured = scatter.sizes(modes.shape[1]), []
    for pose in poses:
        own = rest + modes @ (sizes * rng.standard_normal(len(sizes)))
        (shape,) = predict_poses(true, np.array([*p.values()]), own, [pose])
        points = shape.curve.at(at) + STD * rng.standard_normal((places, 2))
        measured.append(MeasuredPose.of_points(pose, points, s=at))
    return fit_model(nuisances(MODEL, TOLERANCES), measured, TOLERANCES, STD)


@pytest.mark.parametrize(("places", "few"), [(3, True), (4, True), (8, False)])
def test_markers_are_few_up_to_four_places(places, few):
    assert few_places(fitted(places=places)) == few


def test_a_rest_curvature_that_is_held_to_a_line_stays_one():
    fit = settle(as_line(fitted(wave=1.0)))
    assert fit.problem.priors.roughness_std == A_LINE
    bends = np.diff(fit.coefficients, 2)
    assert np.abs(bends).max() < 1e-4 * np.abs(fit.coefficients).max()


def test_a_wavy_rest_curvature_seen_at_three_places_is_no_effect():
    """Beside a line, which was all that few markers seemed to tell, a force was named."""
    assert diagnose(fitted(wave=1.0)).verdict == "complete"


@pytest.mark.parametrize(("off", "names"), [(0.2, ()), (0.3, ("clamp_angle",))])
def test_a_clamp_that_turned_is_tied_with_waves_of_the_rest_curvature(off, names):
    """The likelier of both is reported, and the other one is told."""
    found = diagnose(fitted(off=off))
    assert found.names == names
    if not names:
        assert found.as_likely == ("clamp_angle",)
        return
    assert "rest_curvature" in found.added[0].equivalents
    assert found.fit.value("clamp_angle.start_heading_error") == pytest.approx(off, abs=0.05)
