"""One clean pose alone: complete, with wide intervals, and predicted as it was measured."""

import numpy as np
import pytest
import yaml

from dlo_casadi.config import load_config
from dlo_casadi.estimation.constrained import as_measured
from dlo_casadi.estimation.fit import fit_model
from dlo_casadi.estimation.prediction import measured_branches, predict_poses
from dlo_casadi.session import run_session
from dlo_casadi.session.fitting import declared_model
from dlo_casadi.session.measure import measured_poses, read_inputs

NOISE = 3e-4
# Boundary, length [m], mass [kg], EI [N m^2], waves of the rest curvature [turns], poses: the first
# one is fitted, the other held out. Each has two stable equilibria.
CASES = {
    "between pins": (
        ("pinned", "pinned"),
        (0.64, 0.075, 0.0252),
        (-0.0084, 0.0192, -0.096),
        [{"end": [0.395, 0.144]}, {"end": [0.349, 0.266]}],
    ),
    "from a clamp to a pin": (
        ("clamped", "pinned"),
        (0.756, 0.0833, 0.372),
        (0.082, -0.1105, -0.0244),
        [
            {"end": [0.384, 0.034], "start_heading": 0.495},
            {"end": [0.504, 0.258], "start_heading": 0.83},
        ],
    ),
    "from a clamp to a free tip": (
        ("clamped", "free"),
        (0.669, 0.376, 0.1363),
        (0.0623, -0.0901, -0.309),
        [{"start_heading": 1.206}, {"start_heading": -0.288}],
    ),
}


def session(folder, boundary, cable, waves, ends, seed):
    """A session of the toolkit's own model, nothing hidden."""
    length, mass, stiffness = cable
    poses = [
        {"file": f"pose_{k}.csv", "start": [0.0, 0.0], "role": role, **held}
        for k, (held, role) in enumerate(zip(ends, ("fit", "held_out"), strict=True))
    ]
    text = {
        "cable": {
            "name": "one pose",
            "length": length,
            "mass": mass,
            "diameter": 0.01,
            "bending_stiffness": 2 * stiffness,
            "rest_shape": "curved",
        },
        "experiment": {
            "gravity": [0.0, -9.81],
            "boundary": dict(zip(("start", "end"), boundary, strict=True)),
            "measurement": {"kind": "centerlines", "std": NOISE},
            "poses": poses,
        },
        "model": {"n": 20},
    }
    path = folder / "session.yaml"
    for pose in poses:
        (folder / pose["file"]).write_text("x_m,y_m\n0,0\n0.1,0\n")
    path.write_text(yaml.safe_dump(text))
    config = load_config(path)
    model = declared_model(config).model.with_mesh(40)
    p = model.nominal.copy()
    p[0] = stiffness
    places = model.chain.cells.mean(axis=1) / length
    cosines = np.cos(np.pi * np.arange(3)[:, None] * places)
    rest = 2 * np.pi / length * (waves @ cosines)
    found = predict_poses(model, p, rest, [pose.held for pose in config.experiment.poses])
    rng = np.random.default_rng(seed)
    s = np.linspace(0.02, 0.98, 150) * length
    for pose, prediction in zip(poses, found, strict=True):
        points = prediction.curve.at(s) + rng.normal(scale=NOISE, size=(150, 2))
        np.savetxt(folder / pose["file"], points, delimiter=",", header="x_m,y_m", comments="")
    return path


@pytest.mark.parametrize(
    "case",
    [
        pytest.param("between pins", marks=pytest.mark.long),
        pytest.param("from a clamp to a pin", marks=pytest.mark.long),
        "from a clamp to a free tip",
    ],
)
def test_a_clean_pose_is_complete_and_predicted_as_it_was_measured(case, tmp_path):
    """Its shape fits as well with a rest curvature that would bring it to the other side."""
    outcome = run_session(load_config(session(tmp_path, *CASES[case], seed=0)))
    stage = outcome.stages[-1]

    assert outcome.doubts == ()
    assert outcome.verdict == "complete"
    assert any("only one pose" in warning for warning in outcome.warnings)
    # 150 points: of their noise the root mean square is known to 1 / sqrt(300).
    assert stage.rmse_fit == pytest.approx(NOISE, rel=0.2)
    found, stiffness = stage.parameters["bending_stiffness"], CASES[case][1][2]
    low, high = found.interval_95
    assert not found.identifiable
    # With both ends held the shape alone tells no upper bound; with a free tip hardly.
    assert high is None or (case == "from a clamp to a free tip" and high > 3 * stiffness)
    assert low < stiffness < (high or np.inf)


def test_a_pose_that_is_predicted_elsewhere_is_fitted_again_until_it_is_not(tmp_path):
    """The shape hardly tells the rest curvature, and another one brings it where it was."""
    config = load_config(session(tmp_path, *CASES["from a clamp to a pin"], seed=0))
    declared = declared_model(config)
    measured = measured_poses(config, read_inputs(config))[:1]
    fit = fit_model(declared.model.with_mesh(20), measured, declared.tolerances, NOISE)
    elsewhere = []
    for one in (fit, as_measured(fit)):
        predicted = predict_poses(one.model, one.p, one.rest, [measured[0].pose])
        others = measured_branches(one.model, one.p, one.rest, measured, predicted)
        elsewhere.append(others != [None])
        assert one.chi2_per_dof < 1.3
    assert elsewhere == [True, False]
