"""Mistakes of readings, each made with forces of a cable in a plane or in space, and named."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import dlo_casadi as dlo
from dlo_casadi.config import load_config
from dlo_casadi.effects import CableData
from dlo_casadi.equilibrium.pose import HeldPose
from dlo_casadi.estimation.prediction import predict_poses
from dlo_casadi.model.cable_model import CableModel
from dlo_casadi.rod.ends import reaction_rows
from dlo_casadi.session.compared_readings import ComparedReading
from dlo_casadi.session.fitting import declared_model, straight
from dlo_casadi.session.measure import read_inputs
from dlo_casadi.session.plausibility import find_suspicions
from dlo_casadi.session.readings import misread

ROOT = Path(__file__).parents[2]
CABLE = CableData(0.8, 0.2, 0.012, 0.04)
ARM = np.array([0.05, -0.01, 0.02])


def across(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Cross product, in a plane one number."""
    return np.cross(a, b) if a.size == 3 else np.array([a[0] * b[1] - a[1] * b[0]])


@pytest.fixture(scope="module", params=[False, True], ids=["plane", "space"])
def read(request):
    """Forces, moments and clamps (6, d, d) of six poses."""
    rng = np.random.default_rng(0)
    space = request.param
    d = 3 if space else 2
    ends = np.column_stack([rng.uniform(0.3, 0.6, 6), rng.uniform(-0.3, 0.3, size=(6, d - 1))])
    if space:
        cable, gravity = replace(CABLE, torsional_stiffness=0.02), (0.0, 0.0, -9.81)
        frames = Rotation.from_rotvec(rng.normal(scale=0.6, size=(6, 3)))
        poses = [
            HeldPose(
                (0.0,) * 3, tuple(end), None, None, (0.0, 0.0, 0.0, 1.0), tuple(frame.as_quat())
            )
            for end, frame in zip(ends, frames, strict=True)
        ]
        axes = frames.as_matrix()
    else:
        cable, gravity, headings = CABLE, (0.0, -9.81), rng.normal(scale=0.8, size=6)
        poses = [
            HeldPose((0.0, 0.0), tuple(end), 0.0, heading)
            for end, heading in zip(ends, headings, strict=True)
        ]
        axes = np.array([[[np.cos(h), -np.sin(h)], [np.sin(h), np.cos(h)]] for h in headings])
    model = CableModel(cable, 8, start="clamped", end="clamped", gravity=gravity)
    found = predict_poses(model, model.nominal, np.zeros(model.chain.n_rests), poses)
    rows = reaction_rows(model.node)
    force, moment = (
        np.array([one.seen.readings[rows[name]] for one in found])
        for name in ("end_force", "end_moment")
    )
    return force, moment, axes


def said_of(
    read, force: np.ndarray, moment: np.ndarray, mass: float = 0.8, *, certain: bool = True
) -> list[str]:
    """What is said of readings whose true forces the shapes give at another mass."""
    model_force, model_moment, axes = read
    noise = np.random.default_rng(1).normal(scale=0.01, size=force.shape)
    shaken = force + noise * np.abs(force).max()
    needed = model_force / mass
    found = misread(
        [
            ComparedReading("end_force", shaken, needed, frames=axes),
            ComparedReading("end_moment", moment, model_moment / mass, needed, frames=axes),
        ]
    )
    return [item.message for item in found if item.certain is certain]


def in_frames(axes: np.ndarray, vectors: np.ndarray) -> np.ndarray:
    """Vectors (m, d) about the clamps' axes; a moment in a plane stays."""
    return vectors if vectors.shape[1] == 1 else np.einsum("mji,mj->mi", axes, vectors)


def test_the_convention_itself_is_no_mistake(read):
    force, moment, _ = read
    assert said_of(read, force, moment) == []
    assert said_of(read, force, moment, mass=2.0) == []


def test_forces_on_the_cable_in_place_of_the_fixture(read):
    force, moment, _ = read
    found = said_of(read, -force, -moment)
    assert len(found) == 2
    assert all("with the other sign" in text for text in found)


@pytest.mark.parametrize("sign", [1, -1])
def test_axes_of_the_sensor(read, sign):
    force, moment, axes = read
    found = said_of(read, sign * in_frames(axes, force), sign * in_frames(axes, moment))
    assert f"Try: {'world axes, R f' if sign > 0 else '-R f'}" in found[0]


@pytest.mark.parametrize(
    ("unit", "of_force", "of_moment"),
    [
        ("grams-force", 101.97, 1.0),
        ("kilograms-force", 0.10197, 1.0),
        ("millinewtons", 1e3, 1.0),
        ("N mm", 1.0, 1e3),
        ("N cm", 1.0, 1e2),
        ("kgf cm", 1.0, 10.197),
    ],
)
def test_other_units(read, unit, of_force, of_moment):
    force, moment, _ = read
    found = said_of(read, of_force * force, of_moment * moment)
    assert any(f"in {unit}?" in text for text in found), found


@pytest.mark.parametrize("scale", [0.1, 50.0])
def test_a_moment_in_another_unit_where_shapes_leave_the_stiffness_open(read, scale):
    """Readings are then known up to a common factor; 0.1 N mm look like N cm without the forces."""
    force, moment, axes = read
    readings = [
        ComparedReading("end_force", scale * force, force, frames=axes),
        ComparedReading("end_moment", 1e3 * scale * moment, moment, force, frames=axes),
    ]
    (found,) = misread(readings, sized=False)
    assert "1e+03 times what shapes and end_force need: in N mm?" in found.message


def test_moments_beside_forces_in_another_unit_are_no_mistake(read):
    force, moment, _ = read
    assert said_of(read, 9 * force, 9 * moment) == []  # nine times the mass, not kgf cm
    (found,) = said_of(read, 101.97 * force, moment)
    assert "in grams-force?" in found
    assert said_of(read, 101.97 * force, moment, certain=False) == []


def test_moments_about_the_sensor(read):
    force, moment, axes = read
    arms = axes @ ARM[: force.shape[1]]
    about = np.array([across(-arm, own) for arm, own in zip(arms, force, strict=True)])
    (found,) = said_of(read, force, moment + about)
    numbers = found.split("about a point (")[1].split(")")[0].split(", ")
    # Least squares on exact moments: the scale is the only other unknown.
    np.testing.assert_allclose(
        np.array(numbers, dtype=float), 1e3 * ARM[: len(numbers)], atol=0.1, rtol=5e-3
    )


@pytest.mark.parametrize("degrees", [69, 12])
def test_axes_of_another_world(read, degrees):
    """A small turn may be due to a missing effect, and is only mentioned."""
    force, moment, _ = read
    d = force.shape[1]
    turn = Rotation.from_euler("z", degrees, degrees=True).as_matrix()[:d, :d]
    turned = force @ turn, moment if moment.shape[1] == 1 else moment @ turn
    found = said_of(read, *turned, certain=degrees > 17)
    assert f"turned by {degrees} degrees" in found[0].replace("-", "")
    assert degrees > 17 or said_of(read, *turned) == []


def test_exchanged_axes_are_named(read):
    force, moment, _ = read
    exchanged = force[:, [1, 0, 2][: force.shape[1]]]
    (found,) = said_of(read, exchanged, moment)
    assert f"once read as ({'y, x, z'[: 3 * force.shape[1] - 2]}). Try: the axes" in found


def test_readings_that_nothing_explains_are_doubted(read):
    """Of another fixture, say: a force that follows another law."""
    force, moment, _ = read
    other = force[:, :1] ** 2 * np.arange(1.0, 1 + force.shape[1]) + 1.0
    (found,) = said_of(read, other, moment, certain=False)
    assert found.startswith("end_force is")
    assert "no other way to read it is near" in found
    assert said_of(read, other, moment) == []


def test_readings_within_their_noise_are_not_doubted(read):
    force, _, axes = read
    std = 2 * np.abs(force).max()
    noise = np.random.default_rng(2).normal(scale=std, size=force.shape)
    one = ComparedReading("end_force", force + noise, force, frames=axes)
    assert misread([one])
    assert misread([replace(one, std=std)]) == ()
    assert misread([replace(one, measured=-force, std=std / 10)])  # the sign is still told


def test_a_session_whose_readings_have_the_other_sign():
    """Forces of a straight cable of the declared stiffness, a guess, are near enough to tell."""
    config = load_config(ROOT / "tests/data/bench/short_clean/session.yaml")
    inputs = read_inputs(config)
    model = straight(declared_model(config).model).with_mesh(10)
    declared = config.experiment.poses
    found = predict_poses(
        model, model.nominal, np.zeros(model.chain.n_rests), [x.held for x in declared]
    )
    poses = tuple(
        pose.changed(end_force=tuple(-one.equilibrium.end_force))
        for pose, one in zip(declared, found, strict=True)
    )
    experiment = config.experiment.changed(poses=poses)
    said = find_suspicions(config.changed(experiment=experiment), inputs)
    assert any("end_force" in x.message and "other sign" in x.message for x in said), said


def on_a_table(d: int, guess: float, read=lambda name, value: value):
    """Four poses of a curved cable without weight, and its readings; first guess of EI off."""
    rng, ends = np.random.default_rng(3), ("clamped", "clamped")
    sizes = {"length": 0.6, "mass": 0.03, "diameter": 0.005}
    true = dlo.known_cable(
        dlo.Cable(**sizes, bending_stiffness=0.01, torsional_stiffness=0.007),
        gravity=(0,) * d,
        boundary=ends,
        rest_curvature=rng.normal(0, 1.5, (2, 4) if d == 3 else 4),
        model={"n": 20},
    )
    poses = []
    for _ in range(4):
        held = {"end": 0.6 * np.array([rng.uniform(0.4, 0.8), *rng.uniform(-0.2, 0.2, d - 1)])}
        for side in ("start", "end"):
            if d == 2:
                held[f"{side}_heading"] = float(rng.normal(0, 0.5))
            else:
                turn = Rotation.from_rotvec(rng.normal(0, 0.3, 3))
                held[f"{side}_orientation"] = turn.as_quat()
        shape = true.solve(**held)
        points = shape.points[2:-2] + rng.normal(0, 3e-4, shape.points[2:-2].shape)
        felt = {name: read(name, getattr(shape, name)) for name in ("end_force", "end_moment")}
        poses.append(dlo.Pose((0,) * d, points=points, **held, **felt))
    cable = dlo.Cable(**sizes, bending_stiffness=0.01 * guess)
    session = dlo.Session(cable, poses, gravity=(0,) * d, boundary=ends)
    return find_suspicions(session, read_inputs(session))


@pytest.mark.parametrize(
    ("d", "guess"),
    [
        (2, 0.1),
        (2, 100.0),
        *(pytest.param(*x, marks=pytest.mark.long) for x in ((2, 5.0), (3, 10.0))),
    ],
)
def test_without_weight_the_first_guess_of_the_stiffness_sizes_no_reading(d, guess):
    assert on_a_table(d, guess) == ()


def test_without_weight_readings_are_judged_beside_each_other():
    """A factor between forces and moments, which no stiffness explains; either may be wrong."""
    (found,) = on_a_table(2, 5.0, lambda name, x: x * 0.10197 if name == "end_force" else x)
    assert "times what shapes and end_force need: in kgf cm?" in found.message
    assert "Or end_force in kilograms-force? Try: divide end_force by 0.10197." in found.message
    assert found.certain
    signs = on_a_table(2, 5.0, lambda _, x: -x)
    assert ["with the other sign" in item.message for item in signs] == [True, True]


def test_what_shapes_leave_uncertain_is_free():
    """A constant rest curvature adds a constant to moments between clamps without weight."""
    rng = np.random.default_rng(0)
    model, constant = rng.normal(size=(6, 1)), np.ones((6, 1))
    one = ComparedReading("end_moment", 3 * model + 2.0, model)
    assert misread([one], sized=False)
    assert misread([replace(one, uncertain=constant[..., None])], sized=False) == ()
    turned = replace(one, measured=-one.measured, uncertain=constant[..., None])
    assert "with the other sign" in misread([turned], sized=False)[0].message
    # A part along the model is free only if two standard deviations may turn its sign.
    across = rng.normal(size=(6, 1))
    across -= model * (across * model).sum() / (model**2).sum()
    across *= 0.7 * np.linalg.norm(model) / np.linalg.norm(across)
    turning = across + model
    read = replace(one, measured=model - 1.4 * turning, uncertain=turning[..., None])
    assert misread([read], sized=False) == ()
    beside = across + 0.3 * model
    read = replace(one, measured=0.1 * beside - model, uncertain=beside[..., None])
    assert "with the other sign" in misread([read], sized=False)[0].message
    # Nothing is judged of what the shapes leave open altogether.
    every = rng.normal(size=(6, 1, 9))
    assert misread([replace(one, uncertain=every)], sized=False) == ()
