"""Start and end exchanged in sessions of clamped cables that few points far apart show."""

import numpy as np
import pytest

from dlo_casadi.config import dump_yaml, load_config
from dlo_casadi.estimation.prediction import predict_poses
from dlo_casadi.io.points import write_points
from dlo_casadi.session.fitting import declared_model
from dlo_casadi.session.measure import read_inputs
from dlo_casadi.session.plausibility import find_suspicions

LENGTH, NOISE = 0.8, 3e-4  # m
SHOWN = np.array([0.3, 0.5, 0.7]) * LENGTH  # m, far from both clamps
# Ends [m], headings of start and end [rad].
POSES = [([0.6, 0.1], -0.8, 0.5), ([0.5, -0.1], -0.5, 0.9), ([0.64, 0.0], -0.9, 0.1)]
TURNED = {
    "start and end exchanged": ("",),
    "start and end exchanged, and their directions": ("", "_heading"),
}


@pytest.fixture
def session(tmp_path):
    """Configuration and three points of each pose, which nobody has arc lengths of."""
    poses = [
        {"file": f"pose_{k}.csv", "start": [0.0, 0.0], "end": end, "role": "fit"}
        | {"start_heading": begin, "end_heading": heading}
        for k, (end, begin, heading) in enumerate(POSES)
    ]
    data = {
        "cable": {"length": LENGTH, "mass": 0.06, "diameter": 0.005, "bending_stiffness": 0.03},
        "experiment": {
            "gravity": [0.0, -9.81],
            "boundary": {"start": "clamped", "end": "clamped"},
            "measurement": {"kind": "centerlines"},
            "poses": poses,
        },
    }
    for pose in poses:
        (tmp_path / pose["file"]).touch()
    path = tmp_path / "clamped.yaml"
    path.write_text(dump_yaml(data))
    config = load_config(path)
    model = declared_model(config).model.with_mesh(20)
    p = model.nominal.copy()
    p[0] = 0.02  # N m^2
    rest = np.full(model.chain.n_rests, 0.5)
    rng = np.random.default_rng(0)
    shapes = predict_poses(model, p, rest, [x.held for x in config.experiment.poses])
    for pose, shape in zip(poses, shapes, strict=True):
        points = shape.curve.at(SHOWN) + NOISE * rng.standard_normal((len(SHOWN), 2))
        write_points(tmp_path / pose["file"], points)
    return config


def exchanged(config, keys):
    """The configuration with values of start and end exchanged in every pose."""
    poses = []
    for pose in config.experiment.poses:
        pairs = [(f"start{key}", f"end{key}") for key in keys]
        update = {a: getattr(pose, b) for pair in pairs for a, b in (pair, pair[::-1])}
        poses.append(pose.changed(**update))
    return config.changed(experiment=config.experiment.changed(poses=tuple(poses)))


def suspected(config):
    return find_suspicions(config, read_inputs(config))


def test_few_points_of_a_right_session_are_no_mistake(session):
    assert suspected(session) == ()


@pytest.mark.parametrize("what", TURNED)
def test_exchanged_ends_are_named(session, what):
    (found,) = suspected(exchanged(session, TURNED[what]))
    assert found.certain
    assert f"m with {what}. Try: start where the cable begins" in found.message
