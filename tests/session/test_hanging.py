"""Gravity held against the lines of cables between ball joints in space, drawn from the model."""

from pathlib import Path

import numpy as np
import pytest

import dlo_casadi as dlo
from dlo_casadi.config import dump_yaml, load_config
from dlo_casadi.effects import CableData, LumpedMass
from dlo_casadi.equilibrium.pose import HeldPose
from dlo_casadi.estimation.prediction import predict_poses
from dlo_casadi.io.points import write_points
from dlo_casadi.model.cable_model import CableModel
from dlo_casadi.session import coarse_fit, compared_shapes, plausibility
from dlo_casadi.session.fitting import declared_model
from dlo_casadi.session.measure import read_inputs
from dlo_casadi.session.pull import load_over_stiffness, shown_pull
from dlo_casadi.session.read_session import ReadSession

CONFIGS = Path(__file__).parents[2] / "configs"
LENGTH, STIFFNESS, NOISE = 0.8, 0.02, 3e-4  # m, N m^2, m
# Ends: chords of nine tenths of the cable, in nearly one vertical plane.
ENDS = LENGTH * np.array(
    [[0.92, 0.003, 0.1], [0.85, -0.002, -0.32], [0.9, 0.0, 0.26], [0.94, 0.002, -0.1]]
)


@pytest.fixture(scope="module")
def curved(tmp_path_factory):
    """Configuration and lines of a cable that is an arc of 2 m^-1 at rest."""
    folder = tmp_path_factory.mktemp("curved")
    names = [f"pose_{k}.csv" for k in range(len(ENDS))]
    for name in names:
        (folder / name).touch()
    data = {
        "cable": {"length": LENGTH, "mass": 0.06, "diameter": 0.005, "bending_stiffness": 0.03},
        "experiment": {
            "gravity": [0.0, 0.0, -9.81],
            "boundary": {"start": "pinned", "end": "pinned"},
            "measurement": {"kind": "centerlines"},
            "poses": [
                {"file": name, "start": [0.0, 0.0, 0.0], "end": end.tolist(), "role": "fit"}
                for name, end in zip(names, ENDS, strict=True)
            ],
        },
    }
    path = folder / "curved.yaml"
    path.write_text(dump_yaml(data))
    config = load_config(path)
    model = declared_model(config).model.with_mesh(20)
    p = model.nominal.copy()
    p[0] = STIFFNESS
    rest = np.zeros(model.chain.n_rests)
    rest[len(rest) // 3 : 2 * len(rest) // 3] = 2.0
    rng = np.random.default_rng(0)
    poses = [pose.held for pose in config.experiment.poses]
    for name, shape in zip(names, predict_poses(model, p, rest, poses), strict=True):
        points = shape.curve.at(np.linspace(0.01, 0.99, 40) * LENGTH)
        write_points(folder / name, points + NOISE * rng.standard_normal(points.shape))
    return config, read_inputs(config)


def under(config, gravity):
    return config.changed(experiment=config.experiment.changed(gravity=tuple(gravity)))


def test_a_curved_cable_between_ball_joints_is_no_mistake(curved, monkeypatch):
    """Its moments seem to show another load, which they are far from; nothing needs a fit."""
    load = load_over_stiffness([(item.points, item.s) for item in curved[1]])
    assert load[2] > 0.5 * np.linalg.norm(load), "upwards: rest curvature is taken for weight"
    assert shown_pull(ReadSession(*curved))[2] < 0
    monkeypatch.setattr(coarse_fit, "fit_model", None)
    assert plausibility.find_suspicions(*curved) == ()


@pytest.mark.parametrize(
    "gravity", [(0.0, 0.0, 9.81), pytest.param((0.0, -9.81, 0.0), marks=pytest.mark.long)]
)
def test_gravity_along_another_axis_is_named_of_two_poses(curved, gravity):
    config, inputs = curved
    (found,) = plausibility.find_suspicions(under(config, gravity), inputs[:2])
    declared = "(0, 0, 9.81)" if gravity[2] else "(0, -9.81, 0)"
    assert f"does not hang along gravity {declared} m/s^2" in found.message
    assert "m with gravity (0, 0, -9.81) m/s^2" in found.message


def test_lines_that_hang_although_gravity_is_zero():
    cable, pins = dlo.Cable(length=0.8, mass=0.05, diameter=0.006, bending_stiffness=0.01), "pinned"
    true = dlo.known_cable(cable, gravity=(0, -9.81), boundary=(pins, pins), model={"n": 20})
    ends = ((0.6, 0.0), (0.4, -0.1), (0.5, 0.2), (0.3, 0.1))
    poses = [dlo.Pose((0, 0), end, points=true.solve(end=end).points[2:-2]) for end in ends]
    session = dlo.Session(cable, poses, gravity=(0, 0), boundary=(pins, pins))
    (found,) = plausibility.find_suspicions(session, read_inputs(session))
    assert "does not hang along gravity (0, 0) m/s^2" in found.message
    assert "m with gravity (0, -9.81) m/s^2" in found.message


def test_what_is_seen_at_a_glance_refuses_nothing_that_a_fit_explains(curved, monkeypatch):
    """Were the pull that lines show upwards, the fit under the declared gravity would tell."""
    monkeypatch.setattr(compared_shapes, "shown_pull", lambda _: np.array([0, 0, 1.0]))
    assert plausibility.find_suspicions(*curved) == ()


def test_a_strap_or_a_stiff_cable_is_doubted_but_not_refused():
    """Only a misfit that no missing effect leaves refuses a session."""

    def left(rms):
        """A fit that leaves so much [m], or none, which counts as 50 mm of a metre."""
        return compared_shapes.Coarse(rms, rms or 0.05, False)

    def comparison(what, own, other):
        return compared_shapes.Comparison(what, left(own), left(other), 1.0)

    found = [
        comparison("", *both)
        for both in ((0.008, 0.001), (0.02, 0.001), (0.02, 0.015), (0.0015, 0.0003))
    ]
    assert [item.better for item in found] == [True, True, False, False]
    assert [item.certain for item in found] == [False, True, False, False]
    assert found[0].told.startswith("the lines are 0.008 m RMS from the fitted shapes")
    assert comparison("y down", None, 0.001).told == (
        "no equilibria were found near the lines, but they are within 0.001 m with y down"
    )


@pytest.mark.long
def test_a_loop_of_which_only_the_ends_were_measured_is_no_mistake(tmp_path):
    """No fit starts from a chord that has no loop; that a mirrored one does shows no weight."""
    (tmp_path / "ends.csv").write_text("x_m,y_m\n0,0\n-0.125466,0.002561\n")
    pose = {"file": "ends.csv", "start": [0.0, 0.0], "end": [-0.12, 0.0], "role": "fit"}
    data = {
        "cable": {
            "length": 1.5,
            "mass": 0.04077,
            "diameter": 0.0039,
            "bending_stiffness": 2.6e-3,
        },
        "experiment": {
            "gravity": [0.0, -9.81],
            "boundary": {"start": "clamped", "end": "clamped"},
            "measurement": {"kind": "centerlines", "std": 1e-3},
            "poses": [{**pose, "start_heading": 0.0, "end_heading": -6.283185}],
        },
    }
    (tmp_path / "loop.yaml").write_text(dump_yaml(data))
    config = load_config(tmp_path / "loop.yaml")
    assert plausibility.find_suspicions(config, read_inputs(config)) == ()


@pytest.mark.long
def test_gravity_upwards_is_named_of_a_wire_that_does_not_repeat():
    """Its trials differ by a hundredth of its length, whichever way gravity points."""
    config = load_config(CONFIGS / "black_wire.yaml")
    inputs = read_inputs(config)
    (found,) = plausibility.find_suspicions(under(config, (0.0, 9.81)), inputs)
    assert "the lines show no weight" in found.message
    assert not found.certain


def test_a_cable_hangs_along_gravity_with_the_weight_that_is_declared():
    """A connector of six times the cable's mass, in four poses between clamps."""
    cable = {"length": 0.8, "mass": 0.05, "diameter": 0.006, "bending_stiffness": 0.05}
    model = CableModel(CableData(**cable), 20, start="clamped", end="clamped")
    model, parameters = model.with_effect(LumpedMass()), {"mass": 0.3, "position": 0.3}
    p = model.nominal.copy()
    p[[model.names.index(f"lumped_mass.{name}") for name in parameters]] = [*parameters.values()]
    held = (((0.5, 0.1), 0.3), ((0.6, -0.1), -0.2), ((0.45, 0.0), 0.5), ((0.4, 0.1), 0.2))
    poses = [HeldPose((0.0, 0.0), end, 0.0, heading) for end, heading in held]
    shapes = predict_poses(model, p, np.zeros(model.chain.n_rests), poses)
    fixed = {name: {"value": value, "fixed": True} for name, value in parameters.items()}
    config = dlo.Session(
        dlo.Cable(**cable),
        [
            dlo.Pose(
                x.start,
                x.end,
                start_heading=0.0,
                end_heading=x.end_heading,
                points=found.curve.at(np.linspace(0.02, 0.78, 60)),
            )
            for x, found in zip(poses, shapes, strict=True)
        ],
        gravity=(0, -9.81),
        boundary=("clamped", "clamped"),
        model={"effects": [{"name": "lumped_mass", "parameters": fixed}]},
    )
    assert plausibility.find_suspicions(config, read_inputs(config)) == ()
