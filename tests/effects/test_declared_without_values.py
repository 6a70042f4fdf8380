"""Effects declared by their name alone: fits start where they vanish, and stay finite."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from dlo_casadi.effects import EFFECTS, CableData, Setup, StateEffect
from dlo_casadi.equilibrium.pose import HeldPose
from dlo_casadi.estimation.fit import fit_model
from dlo_casadi.estimation.prediction import predict_poses
from dlo_casadi.model.cable_model import CableModel
from dlo_casadi.model.clips import HeldClip
from dlo_casadi.model.tolerances import Tolerances
from dlo_casadi.rod.ends import REACTIONS
from dlo_casadi.rod.obstacles import Plane
from dlo_casadi.sensing.measured_pose import MeasuredPose

LENGTH, NOISE, N = 0.6, 3e-4, 5
FLAT = CableData(length=LENGTH, mass=0.06, diameter=0.006, bending_stiffness=0.02, straight=True)
CABLES = {"plane": FLAT, "space": replace(FLAT, torsional_stiffness=0.012)}
GRAVITY = {"plane": (0.0, -9.81), "space": (0.0, 0.0, -9.81)}
# Far beyond what a cable of that kind has by mistake.
STRONG = {
    "lumped_mass": {"mass": 0.06, "position": 0.2},
    "point_force": {"fx": 0.4, "fy": 0.3, "fz": 0.3, "position": 0.35},
    "tether": {
        "stiffness": 400.0,
        "position": 0.3,
        "anchor_x": 0.25,
        "anchor_y": 0.15,
        "anchor_z": 0.15,
    },
    "side_load": {
        "force_per_length": 0.4,
        "force_per_length_x": 0.4,
        "force_per_length_y": -0.3,
    },
    "gravity_tilt": {"angle": 0.4, "angle_x": 0.4, "angle_y": -0.3},
    "mass_error": {"factor": 3.0},
    "stiffness_gradient": {"slope": 0.8},
    "stiff_section": {"start": 0.2, "end": 0.35, "factor": 20.0},
    "bending_softening": {"softness": 0.3},
    "bending_anisotropy": {"ratio": 8.0, "angle": 0.5},
    "axial_stretch": {"compliance": 0.1},
    "length_error": {"length_difference": 0.05},
    "start_spring": {"stiffness": 0.5, "heading": 1.0},
    "end_spring": {"stiffness": 0.5, "heading": -1.0},
    "clamp_angle": {"start_heading_error": 0.6, "end_heading_error": -0.6},
    "clamp_rotation": {"start_y": 0.5, "start_z": -0.3, "end_y": 0.3, "end_z": 0.4},
    "clamp_compliance": {"start": 3.0, "end": 5.0},
    "end_offset": {"dx": 0.04, "dy": -0.05, "dz": 0.03},
    "clip_offset": {"dx": 0.03, "dy": -0.02, "dz": 0.02},
    "clip_slip": {"ds": 0.03},
    "clip_angle": {"heading_error": 0.3, "y": 0.2, "z": -0.3},
    "obstacle_offset": {"offset": 0.03},
    "contact_plane": {"height": -0.1},
    "rest_curvature_drift": {"rate": 0.4},
    "plastic_set": {"yield_curvature": 2.0, "share": 0.6},
    "image_scale": {"factor": 1.1},
    "image_distortion": {"coefficient": 0.5},
    "standoff_error": {"distance": 0.1},
    "camera_frame": {
        "rotation_x": 0.3,
        "rotation_y": -0.2,
        "rotation_z": 0.3,
        "translation_x": 0.05,
        "translation_y": 0.03,
        "translation_z": -0.04,
    },
}


def poses_in(where: str, pinned: bool) -> list[HeldPose]:
    rng = np.random.default_rng(0)
    ends = np.array([0.4, 0.0, 0.0]) + rng.normal(scale=0.08, size=(3, 3))
    turns = rng.normal(scale=0.35, size=(3, 2, 3))
    if where == "plane":
        return [
            HeldPose(
                (0.0, 0.0),
                tuple(end[:2]),
                *(None if pinned else float(turn[2]) for turn in pair),
                camera_center=(0.2, 0.0, 1.2),
            )
            for end, pair in zip(ends[:2], turns, strict=False)
        ]
    frames = [[tuple(Rotation.from_rotvec(turn).as_quat()) for turn in pair] for pair in turns]
    return [
        HeldPose((0.0,) * 3, tuple(end), start_orientation=first, end_orientation=last)
        for end, (first, last) in zip(ends[:2], frames, strict=False)
    ]


def cases():
    """Effects on cables in the plane and in space that have them, and that have not.

    Long are those in space of effects that are in the plane, too, most of cables that have not,
    for all fits begin where effects vanish, and those that take more than a second.
    """
    slow = ("bending_anisotropy", "contact_plane", "obstacle_offset")
    for where, gravity in GRAVITY.items():
        for name, kind in EFFECTS.items():
            if len(gravity) not in kind.dimensions:
                continue
            again = (where == "space" and 2 in kind.dimensions) or name in slow
            few = where == "plane" and name in ("rest_curvature_drift", "start_spring")
            yield pytest.param(name, where, True, marks=[pytest.mark.long] * again)
            yield pytest.param(name, where, False, marks=[pytest.mark.long] * (not few))


@pytest.mark.parametrize(("name", "where", "has"), list(cases()))
def test_a_fit_stays_finite(name, where, has):
    """None of these fits is refused, and no number of theirs is infinite or NaN."""
    held = "pinned" if name.endswith("_spring") else "clamped"
    cable, gravity, poses = CABLES[where], GRAVITY[where], poses_in(where, held == "pinned")
    cable = replace(cable, straight=not issubclass(EFFECTS[name], StateEffect))
    setup = Setup(cable, held, held, gravity, center=(0.2, 0.0), camera=True, readings=REACTIONS)
    effect = EFFECTS[name].made_for(setup)
    clips = ("pinned",) if name.startswith("clip_") else ()
    if clips:
        middles = [tuple(np.array(pose.end) / 2) for pose in poses]
        held_at = [HeldClip("pinned", place, 0.45 * LENGTH) for place in middles]
        poses = [replace(pose, clips=(x,)) for pose, x in zip(poses, held_at, strict=True)]
    n = 2 * N if clips else N  # each span needs its own
    up = (0.0,) * (len(gravity) - 1) + (1.0,)
    table = (Plane(tuple(-0.1 * x for x in up), up),) if name == "obstacle_offset" else ()
    between = {"clips": clips, "obstacles": table}
    plain = CableModel(cable, n, "arc", held, held, gravity, n_rest=3, **between)
    model = plain.with_effect(effect)
    p = model.nominal.copy()
    if has:
        for q in effect.parameters(cable):
            p[model.names.index(f"{name}.{q.name}")] = STRONG[name][q.name]
    rest = model.rest_basis @ np.linspace(1.0, -1.0, model.n_coefficients)
    s, rng = np.linspace(0.05, 0.95, 12) * LENGTH, np.random.default_rng(0)
    measured = []
    for pose, shape in zip(poses, predict_poses(model, p, rest, poses), strict=True):
        points = shape.curve.at(s) + rng.normal(scale=NOISE, size=(12, len(gravity)))
        item = MeasuredPose.of_points(pose, points)
        if name == "mass_error":
            item = item.with_readings({"end_force": shape.equilibrium.end_force})
        measured.append(item)
    fit = fit_model(model, measured, Tolerances(), NOISE)
    for numbers in (fit.p, fit.rest, fit.point.objective, fit.point.shapes.lam, fit.covariance):
        assert np.all(np.isfinite(numbers))
    stds = [fit.std(q) for q in model.names]
    assert np.all(np.isfinite(stds))
    assert min(stds) > 0.0
    predict_poses(model, fit.p, fit.rest, poses)
