"""Lines and markers of more points than a fit compares one by one."""

from dataclasses import replace

import numpy as np
import pytest

from dlo_casadi.config import dump_yaml, load_config
from dlo_casadi.effects import CableData
from dlo_casadi.equilibrium.pose import HeldPose
from dlo_casadi.estimation.constrained import profile_interval
from dlo_casadi.estimation.prediction import predict_poses
from dlo_casadi.io.points import MeasuredPoints, write_points
from dlo_casadi.model.cable_model import CableModel
from dlo_casadi.sensing.measured_pose import MeasuredPose
from dlo_casadi.sensing.noise import NoiseModel
from dlo_casadi.session.fitting import declared_model, fit_declared
from dlo_casadi.session.measure import LEAST_PIXELS, MOST_POINTS, measured_poses, read_inputs
from dlo_casadi.session.stages import fit_stage

STD, MANY = 3e-4, 2000
CABLE = {"length": 0.8, "mass": 0.05, "diameter": 0.008, "bending_stiffness": 0.02}
ENDS = ((0.5, 0.1), (0.6, -0.1), (0.4, 0.2))


def session(folder, count, marked, std):
    """Three poses of a cable that is stiffer than declared, and all that was measured of them."""
    model = CableModel(CableData(*CABLE.values()), 20)
    p, rest = model.nominal * 1.3, np.zeros(model.chain.n_rests)
    rng, poses, all_points = np.random.default_rng(0), [], []
    s = np.sort(rng.uniform(0.01, 0.99, count)) * model.cable.length
    found = predict_poses(model, p, rest, [HeldPose((0.0, 0.0), end) for end in ENDS])
    for k, (end, shape) in enumerate(zip(ENDS, found, strict=True)):
        points = shape.curve.at(s) + STD * rng.normal(size=(count, 2))
        write_points(folder / f"{k}.csv", points, s if marked else None)
        poses.append({"file": f"{k}.csv", "start": [0, 0], "end": list(end)})
        all_points.append((points, s if marked else None))
    measurement = {"kind": "centerlines"} | ({} if std is None else {"std": std})
    experiment = {
        "gravity": [0.0, -9.81],
        "boundary": {"start": "pinned", "end": "pinned"},
        "measurement": measurement,
        "poses": poses,
    }
    path = folder / "session.yaml"
    cable = {"name": "rope", "rest_shape": "straight", **CABLE}
    path.write_text(dump_yaml({"cable": cable, "experiment": experiment, "model": {"n": 20}}))
    return load_config(path), all_points


def fit_of(config, measured):
    return fit_declared(config, declared_model(config), measured)


@pytest.mark.parametrize("marked", [False, pytest.param(True, marks=pytest.mark.long)])
def test_many_points_tell_what_all_of_them_do(tmp_path, marked):
    """The standard deviation of EI is that of a fit of every point; errors are those of points."""
    config, all_points = session(tmp_path, MANY // 2, marked, STD)
    measured = measured_poses(config, read_inputs(config))
    assert max(len(item.points) for item in measured) <= MOST_POINTS
    fit = fit_of(config, measured)
    every = fit_of(
        config,
        [
            MeasuredPose.of_points(pose.held, points, s=s)
            for pose, (points, s) in zip(config.experiment.poses, all_points, strict=True)
        ],
    )
    name = "bending_stiffness"
    # Beside the factor for chi-square, which is known to 1 / sqrt(2 x 720) of it.
    stds = [x.std(name) / x.inflation for x in (fit, every)]
    assert stds[0] == pytest.approx(stds[1], rel=0.02)
    assert fit.value(name) == pytest.approx(every.value(name), abs=every.std(name) / 5)
    stage = fit_stage("batch", fit, measured, {})
    # A line is compared across, a marker in both directions; 200 points are known to 3 percent.
    assert stage.rmse_fit == pytest.approx(STD * (np.sqrt(2) if marked else 1.0), rel=0.1)


def test_an_interval_is_the_narrower_the_more_points(tmp_path):
    """Noise that is estimated as white has no floor: by sqrt(2000 / 240) = 2.9 of the points' part.

    What the ends' tolerances have in the interval stays. The interval gains less: beside the means
    of eight points a weak correlation would matter more, so that their noise is known with fewer
    degrees of freedom.
    """
    widths, stds = [], []
    for count in (MOST_POINTS, MANY):
        folder = tmp_path / str(count)
        folder.mkdir()
        config, _ = session(folder, count, True, None)
        fit = fit_of(config, measured_poses(config, read_inputs(config)))
        assert fit.noise.std == pytest.approx(STD, rel=0.1)  # of one point, not of a mean
        found = profile_interval(fit)
        assert found.low < 1.3 * CABLE["bending_stiffness"] < found.high
        widths.append(found.high - found.low)
        stds.append(fit.std("bending_stiffness"))
    assert 2.2 < stds[0] / stds[1] < 3.2
    assert 1.5 < widths[0] / widths[1] < stds[0] / stds[1]


def test_means_leave_gaps_alone_and_average_white_noise_only():
    """No mean lies between two stretches; what is correlated is as large in it as in a point."""
    x = np.concatenate([np.linspace(0.0, 0.3, 600), np.linspace(0.5, 0.8, 600)])
    found = MeasuredPoints(np.column_stack([x, x**2])).means(MOST_POINTS)
    assert found.count.sum() == len(x)
    assert not np.any((found.points[:, 0] > 0.301) & (found.points[:, 0] < 0.499))
    noise = NoiseModel(STD, 0.5, 0.1)
    place, one = np.array([0.2]), np.ones(1)
    many = noise.covariance(place, one, count=np.array([1e6]))
    assert many[0, 0] == pytest.approx(0.5 * STD**2, rel=1e-5)
    assert noise.covariance(place, one)[0, 0] == pytest.approx(STD**2)


def test_no_noise_is_estimated_below_what_the_pixels_of_a_photograph_leave(tmp_path):
    """Points that scatter by 0.3 mm, as if from photographs with pixels of 1 mm, or of 30 mm."""
    config, _ = session(tmp_path, 60, False, None)
    found = []
    for pixel in (1e-3, 30e-3):
        inputs = [replace(item, pixel=pixel) for item in read_inputs(config)]
        found.append(fit_of(config, measured_poses(config, inputs)).noise.std)
    assert found[0] == pytest.approx(STD, rel=0.2)
    assert found[1] == LEAST_PIXELS * 30e-3
