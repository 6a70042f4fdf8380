"""Stories in the plane: a session whose truth is known, from its file to the generated C.

And each session's cable with its true values beside the rod that it was simulated by.
"""

import shutil

import numpy as np
import pytest
import yaml
from told import DATA, KEYS, TENTHS, Story, files_of, same

from dlo_casadi import Cable, known_cable

pytestmark = pytest.mark.skipif(shutil.which("cc") is None, reason="no C compiler (cc)")


def rest_of(name, length):
    """Curvature at rest of a story's cable, at places evenly spaced, as make.py has it."""
    s = np.linspace(0.0, 1.0, 41) * length
    waves = {"tip": 1.2 * np.cos(np.pi * s / length)}
    waves["grippers"] = np.array([1.0 + 0.0 * s, 0.8 * np.cos(np.pi * s / length)])
    return waves.get(name)


@pytest.mark.parametrize("name", ["weight", "tip", "grippers", "harness", "table"])
def test_with_true_values_the_model_is_the_rod(name):
    """Shape, forces, moments, clips and contact of a held-out pose; no fit, no noise."""
    session, truth = (yaml.safe_load(path.read_text()) for path in files_of(DATA / name))
    values, experiment = truth["parameters"], session["experiment"]
    stiffness = {k: values[k] for k in ("bending_stiffness", "torsional_stiffness") if k in values}
    declared = {k: session["cable"][k] for k in ("length", "mass", "diameter")} | stiffness
    model = {"n": 32 if name == "table" else 48}
    if name == "weight":
        load = {key: {"value": values[key]} for key in ("mass", "position")}
        model["effects"] = [{"name": "lumped_mass", "parameters": load}]
    else:
        declared["mass"] = values.get("mass", declared["mass"])
    cable = known_cable(
        Cable(**declared),
        gravity=experiment["gravity"],
        boundary=tuple(experiment["boundary"].values()),
        rest_curvature=rest_of(name, declared["length"]),
        model=model,
    )
    pose, true = list(truth["poses"].items())[-1]
    held = next(row for row in experiment["poses"] if row["file"].startswith(pose))
    held = {key: value for key, value in held.items() if key in (*KEYS, "clips")}
    if name == "harness":
        for key, k in (("dx", 0), ("dy", 1)):
            held["clips"][0]["place"][k] += values[key]
    if name == "table":
        held["obstacles"] = experiment["obstacles"]
        held["obstacles"][0]["point"][1] += values["offset"]
    shape = cable.solve(**held)
    assert shape.points[TENTHS] == pytest.approx(np.array(true["points"]), abs=1e-4)
    scale = 9.81 * declared["mass"]
    assert shape.start_force == pytest.approx(true["start_force"], abs=2e-3 * scale)
    assert shape.end_force == pytest.approx(true["end_force"], abs=2e-3 * scale)
    for found, exact in zip((shape.start_moment, shape.end_moment), true["moments"], strict=True):
        assert np.atleast_1d(found) == pytest.approx(exact, abs=1e-3 * scale * declared["length"])
    for k, clip in enumerate(shape.clips.values()):
        assert clip.at == pytest.approx(true["clip_at"][k], abs=1e-4)
        assert clip.force == pytest.approx(true["clip_forces"][k], abs=5e-3)
    for contact in shape.contacts:
        assert contact.start == pytest.approx(true["touches_from"], abs=4e-3)
        assert contact.force == pytest.approx(true["table_force"], abs=2e-3 * scale)
    assert bool(shape.contacts) == (name == "table")


def test_a_weight_between_two_pins_that_nobody_declared(tmp_path):
    """The weight is found, and told apart from nothing that is as likely."""
    story = Story.fitted("weight", tmp_path / "results")
    story.check(
        "effect_found", widest=0.32, mass="lumped_mass.mass", position="lumped_mass.position"
    )
    assert story.effects == ["lumped_mass"]
    (effect,) = story.report["effects"]
    assert "point_force" in effect["indistinguishable_from"]  # a dead weight is one
    assert effect["rmse_cross_validated_after"] < 0.7 * effect["rmse_cross_validated_before"]
    before = next(stage for stage in story.report["stages"] if stage["name"] == "batch")
    assert before["rmse_held_out"] > 1.5 * story.last["rmse_held_out"]
    for name, true in story.truth["poses"].items():
        found = story.predicted(name)
        assert np.allclose(found["force_on_start"], true["start_force"], atol=0.03)
        assert np.allclose(found["force_on_end"], true["end_force"], atol=0.03)
    same(story.in_c(name, tmp_path / "c"), found)


def test_a_clamped_cable_of_unknown_mass_on_a_force_sensor(tmp_path):
    """Readings of force and moment weigh it; its free end has no fixture."""
    story = Story.fitted("tip", tmp_path / "results")
    story.check("complete", widest=0.08, mass="mass")
    assert not story.effects
    (name,) = story.truth["poses"]
    true = story.truth["poses"][name]
    assert set(story.last["readings"][name]) == {"start_force", "start_moment"}
    found = story.predicted(name)
    assert found["force_on_start"] == pytest.approx(true["start_force"], abs=0.01)
    assert found["moment_on_start"] == pytest.approx(true["moments"][0][0], abs=0.001)
    same(story.in_c(name, tmp_path / "c"), found)


def test_a_clip_that_stands_elsewhere_and_an_eyelet(tmp_path):
    """The clip's offset is found; the cable slides through the eyelet to the true arc length."""
    story = Story.fitted("harness", tmp_path / "results")
    story.check("effect_found", widest=1.1, dx="clip_offset.dx", dy="clip_offset.dy")
    assert story.effects == ["clip_offset"]
    assert story.report["effects"][0]["of"] == "post"
    (name,) = story.truth["poses"]
    true = story.truth["poses"][name]
    clips = tmp_path / "clips.yaml"
    clips.write_text(yaml.safe_dump(story.pose(name)["clips"]))
    found = story.predicted(name, "--clips", clips)
    for clip, at, force in zip(found["clips"], true["clip_at"], true["clip_forces"], strict=True):
        assert clip["at"] == pytest.approx(at, abs=1e-3)
        assert clip["force"] == pytest.approx(force, abs=0.1)
    in_c = story.in_c(name, tmp_path / "c", "--clips", "pinned", "eyelet")
    same(in_c, found)
    for k, clip in enumerate(found["clips"]):
        assert in_c["clip_at"][k] == pytest.approx(clip["at"], rel=1e-6)
        assert in_c["clip_forces"][k] == pytest.approx(clip["force"], rel=1e-5)


def test_a_table_that_is_higher_than_declared(tmp_path):
    """The cable lies on it from the true arc length on, and presses with the true force."""
    story = Story.fitted("table", tmp_path / "results")
    story.check("effect_found", widest=0.12, offset="obstacle_offset.offset")
    assert story.effects == ["obstacle_offset"]
    (name,) = story.truth["poses"]
    true = story.truth["poses"][name]
    (contact,) = story.last["contacts"][name]
    assert contact["from"] == pytest.approx(true["touches_from"], abs=1.3 / 16)  # nodes touch
    assert contact["force"] == pytest.approx(true["table_force"], abs=0.01)
    (desk,) = story.session["experiment"]["obstacles"]
    desk["point"][1] += story.last["parameters"]["obstacle_offset.offset"]["value"]
    file = tmp_path / "desk.yaml"
    file.write_text(yaml.safe_dump([desk]))
    found = story.predicted(name, "--obstacles", file)
    (contact,) = found["contacts"]
    assert contact["force"] == pytest.approx(true["table_force"], abs=0.01)
    behind = f"{{DLO_HALF_SPACE, {{0.0, {desk['point'][1]!r}}}, {{0.0, 1.0}}, 0.0}}"
    # As in Python, only nodes touch.
    among = {"obstacles": behind, "flag": "-DBETWEEN=0"}
    in_c = story.in_c(name, tmp_path / "c", "--obstacles", 1, **among)
    same(in_c, found)
    assert in_c["obstacle_force"] == pytest.approx(contact["force"], abs=1e-6)
