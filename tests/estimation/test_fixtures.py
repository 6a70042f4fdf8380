"""How far fixtures that are not quite where they are declared limit a prediction."""

from dataclasses import replace

import numpy as np
import pytest

from dlo_casadi.effects import CableData, LengthError
from dlo_casadi.effects.nuisances import SensorBias
from dlo_casadi.equilibrium.pose import HeldPose
from dlo_casadi.estimation.fit import fit_model
from dlo_casadi.estimation.prediction import predict_poses
from dlo_casadi.estimation.result import Fit
from dlo_casadi.estimation.variances import first_reading_noise
from dlo_casadi.model.cable_model import CableModel
from dlo_casadi.model.tolerances import Tolerances
from dlo_casadi.rod.ends import reaction_rows
from dlo_casadi.sensing.measured_pose import MeasuredPose
from dlo_casadi.session.fit_remarks import fit_warnings

NOISE = 5e-5
MODEL = CableModel(CableData(0.6, 0.06, 0.008, 0.05), 10, n_rest=5)
TRUTH, REST = np.array([0.05]), np.full(10, 0.8)


def moved_session(scatter: float, count: int = 24) -> tuple[Fit, float]:
    """Fit of half the poses, their ends moved at random [m]; RMS distance of the other half."""
    rng = np.random.default_rng(1)
    angles, reach = rng.uniform(-2.2, 0.2, count), rng.uniform(0.3, 0.5, count)
    ends = np.stack([reach * np.cos(angles), reach * np.sin(angles)], axis=1)
    declared = [HeldPose((0.0, 0.0), (float(x), float(y))) for x, y in ends]
    moved = ends + rng.normal(scale=scatter, size=(count, 2))
    true = [replace(p, end=(float(x), float(y))) for p, (x, y) in zip(declared, moved, strict=True)]
    s = np.linspace(0.02, 0.98, 60) * MODEL.cable.length
    measured = [
        MeasuredPose.of_points(pose, shape.curve.at(s) + rng.normal(scale=NOISE, size=(60, 2)))
        for pose, shape in zip(declared, predict_poses(MODEL, TRUTH, REST, true), strict=True)
    ]
    fit = fit_model(MODEL, measured[::2], Tolerances(end=5e-4), NOISE)
    others = predict_poses(fit.model, fit.p, fit.rest, declared[1::2])
    square = [
        (shape.curve.distances(item.points) ** 2).mean()
        for shape, item in zip(others, measured[1::2], strict=True)
    ]
    return fit, float(np.sqrt(np.mean(square)))


def by_moved_ends(fit: Fit) -> float:
    """RMS displacement [m] across the cable by its moved ends, from shapes solved anew."""
    squares, step = [], 1e-5
    for j, s in zip(fit.problem.used, fit.point.projections, strict=True):
        pose = fit.problem.measured[j].pose
        for way, std in zip(np.eye(2), fit.problem.fixture_std, strict=True):
            ends = [replace(pose, end=tuple(pose.end + x * way)) for x in (step, -step)]
            ahead, behind = (x.curve for x in predict_poses(fit.model, fit.p, fit.rest, ends))
            moved = (ahead.at(s) - behind.at(s)) / (2 * step) * std
            squares.append((ahead.normals(s)[:, 0] * moved).sum(axis=1) ** 2)
    return float(np.sqrt(2 * np.mean(squares)))  # of each point two, which add up


def test_the_error_of_poses_that_were_not_fitted_is_foretold():
    """Ends 0.2 mm off, noise 0.05 mm: what is measured is mostly the fixtures."""
    fit, seen = moved_session(2e-4)
    foretold = float(np.hypot(fit.fixture_error, NOISE))
    assert foretold > 1.5 * NOISE
    # The fit has moved the ends by some tenths of a millimetre, of a cable of 0.6 m.
    assert fit.fixture_error == pytest.approx(by_moved_ends(fit), rel=0.01)
    # Twelve ends and twelve others, two coordinates each: 14 % on either side.
    assert foretold == pytest.approx(seen, rel=0.4)
    (said,) = (line for line in fit_warnings(fit, 0.0) if "fixtures" in line)
    assert f"{1e3 * foretold:.2g} mm from its prediction" in said
    assert "mm at the end" in said


def test_fixtures_that_hold_the_ends_where_they_should_are_not_blamed():
    fit, seen = moved_session(1e-6)
    assert fit.fixture_error < NOISE / 2
    assert seen == pytest.approx(NOISE, rel=0.1)
    assert not any("fixtures" in line for line in fit_warnings(fit, 0.0))


def test_a_misfit_is_told_as_the_noise_that_the_fit_assumes():
    """The residual of all points may be that of one pose in another equilibrium."""
    fit, _ = moved_session(1e-6)
    noise = replace(fit.noise, source="misfit", before=fit.noise)
    fit = replace(fit, problem=replace(fit.problem, noise=noise))
    (said,) = (line for line in fit_warnings(fit, 0.0) if line.startswith("the model misses"))
    assert said.endswith(f"as if that were {1e3 * noise.std:.2g} mm")
    assert said.count(" mm") == 1


def test_a_bias_of_a_sensor_far_beyond_its_tolerance_is_told():
    """Forces that are read 0.5 N too large, with a tolerance of 0.02 N."""
    prior = {"sensor_bias.end_force_x": 0.02, "sensor_bias.end_force_y": 0.02}
    bias = SensorBias(start_force=False, start_moment=False, end_moment=False)
    model = MODEL.with_effect(bias, prior)
    poses = [HeldPose((0.0, 0.0), end) for end in ((0.4, 0.0), (0.3, -0.2), (0.35, 0.1))]
    shapes = predict_poses(model, np.array([0.05, 0.5, 0.0]), REST, poses)
    measured = [
        MeasuredPose.of_points(pose, shape.curve.nodes[1:-1]).with_readings(
            {"end_force": tuple(shape.seen.readings[reaction_rows(model.node)["end_force"]])}
        )
        for pose, shape in zip(poses, shapes, strict=True)
    ]
    known = first_reading_noise(model, force=0.01)
    said = fit_warnings(fit_model(model, measured, Tolerances(), NOISE, readings=known), 0.0)
    (line,) = (line for line in said if "times its tolerance" in line)
    assert line.startswith("sensor_bias.end_force_x is 0.")


@pytest.mark.parametrize(("longer", "told"), [(0.0, False), (8e-3, True)])
def test_a_declared_value_that_is_far_off_its_tolerance_is_told(longer, told):
    """A cable 8 mm longer than declared, with a tolerance of 0.5 mm."""
    model = MODEL.with_effect(LengthError(), {"length_error.length_difference": 5e-4})
    poses = [HeldPose((0.0, 0.0), end) for end in ((0.4, 0.0), (0.3, -0.2), (0.35, 0.1))]
    shapes = predict_poses(model, np.array([0.05, longer]), REST, poses)
    rng, s = np.random.default_rng(0), np.linspace(0.02, 0.98, 60) * (0.6 + longer)
    measured = [
        MeasuredPose.of_points(pose, shape.curve.at(s) + rng.normal(scale=NOISE, size=(60, 2)))
        for pose, shape in zip(poses, shapes, strict=True)
    ]
    said = fit_warnings(fit_model(model, measured, Tolerances(), NOISE), 0.0)
    off = [line for line in said if "times its tolerance of 0.0005 m" in line]
    assert bool(off) == told
    assert all(line.startswith("length_error.length_difference is 0.0") for line in off)
