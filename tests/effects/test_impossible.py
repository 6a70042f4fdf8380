"""Declared effects that a setup cannot have are refused; those that it only hides are not."""

import re
from dataclasses import replace

import casadi as ca
import numpy as np
import pytest

import dlo_casadi as dlo
from dlo_casadi.effects import EFFECTS, CableData, Setup, SideLoad, random_effects
from dlo_casadi.equilibrium.pose import HeldPose
from dlo_casadi.equilibrium.solve import solve_equilibrium
from dlo_casadi.model.cable_model import CableModel

CABLE = CableData(0.8, 0.2, 0.012, 0.3)
# A setup with everything that an effect in a plane may need.
FULL = Setup(
    CABLE,
    "pinned",
    "pinned",
    center=(0.2, 0.1),
    pixel=1e-4,
    camera=True,
    clips=("pinned", "clamped"),
    obstacles=1,
    n_poses=2,
    readings=("end_force",),
)


@pytest.mark.parametrize(
    ("name", "lacking", "said"),
    [
        ("contact_plane", {"gravity": (0.0, 0.0)}, "Try: experiment.gravity, or experiment.obst"),
        ("start_spring", {"start": "clamped"}, "the start is clamped. Try: .* clamp_compliance"),
        ("end_spring", {"end": "free"}, "the end is free. Try: experiment.boundary"),
        ("end_offset", {"end": "free"}, "the end is free. Try: experiment.boundary"),
        ("clip_offset", {"clips": ()}, "the poses have none. Try: clips of the poses"),
        ("clip_slip", {"clips": ("eyelet",)}, "the poses have eyelet. Try: clips of the poses"),
        ("clip_angle", {"clips": ("pinned",)}, "the poses have pinned. Try: clips of the poses"),
        ("obstacle_offset", {"obstacles": 0}, "none is declared. Try: experiment.obstacles"),
        ("image_distortion", {"center": None}, "there are no photographs. Try: measurement.kind"),
        ("standoff_error", {"camera": False}, "none is declared. Try: measurement.camera"),
        ("clamp_angle", {}, "no end is clamped. Try: experiment.boundary"),
    ],
)
def test_what_a_setup_lacks_is_named_with_a_way_out(name, lacking, said):
    kind, setup = EFFECTS[name], replace(FULL, **lacking)
    refused = kind.made_for(setup).refusal(setup, {})
    assert re.search(said, refused), refused
    assert not kind.applies(setup)
    if lacking:
        assert kind.made_for(FULL).refusal(FULL, {}) == ""


@pytest.mark.parametrize("name", ["tether", "mass_error", "rest_curvature_drift"])
def test_effects_that_are_only_invisible_may_be_declared(name):
    setup = Setup(CABLE, "pinned", "pinned")
    assert not EFFECTS[name].applies(setup)
    assert EFFECTS[name]().refusal(setup, {}) == ""


SPACE = replace(CABLE, torsional_stiffness=0.2)
ROUND = {"gravity": (0.0, 0.0, -9.81), "curved": False}


@pytest.mark.parametrize(
    ("name", "hidden", "shown"),
    [
        ("tether", {"n_poses": 1}, {"n_poses": 2}),
        ("rest_curvature_drift", {"n_poses": 1}, {"n_poses": 2}),
        ("plastic_set", {"n_poses": 2, "curved": False}, {"n_poses": 2, "curved": True}),
        ("mass_error", {"readings": ()}, {"readings": ("end_force",)}),
        ("bending_anisotropy", ROUND, ROUND | {"curved": True}),
        ("bending_anisotropy", ROUND, ROUND | {"start": "clamped"}),
        ("pin_moment", {"start": "clamped", "end": "free"}, {"start": "clamped"}),
    ],
)
def test_effects_apply_where_measurements_show_them(name, hidden, shown):
    kind = (EFFECTS | random_effects())[name]
    for changed, applies in ((hidden, False), (shown, True)):
        cable = SPACE if len(changed.get("gravity", ())) == 3 else CABLE
        assert kind.applies(Setup(cable, **changed)) is applies


def test_a_table_needs_gravity():
    """Its normal would not be a number."""
    effects = [{"name": "contact_plane", "parameters": {"height": -0.1}}]
    with pytest.raises(dlo.ConfigError, match="without gravity no plane is level"):
        dlo.known_cable(
            dlo.Cable(length=0.8, mass=0.2, diameter=0.012, bending_stiffness=0.3),
            gravity=(0, 0),
            boundary=("pinned", "pinned"),
            model={"effects": effects},
        )


def loaded(angle: float, load: float) -> np.ndarray:
    """Points of a cable with a side load, turned back by the angle by which gravity is turned."""
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    gravity = tuple(turn @ [0.0, -9.81]) if angle else (0.0, -9.81)
    model = CableModel(CABLE, 8, gravity=gravity, effects=(SideLoad(),), n_rest=0)
    p = np.append(model.nominal[:-1], load)
    pose = HeldPose((0.0, 0.0), tuple(turn @ [0.5, 0.1]))
    return solve_equilibrium(model, p, np.zeros(model.chain.n_rests), pose).points @ turn


def test_a_side_load_turns_with_gravity():
    along = SideLoad().resultant(
        ca.SX(0), ca.SX([0, -9.81]), CABLE, {"force_per_length": ca.SX(0.7)}
    )
    assert np.array_equal(np.array(ca.DM(along)).ravel(), [0.7 * 0.8, 0.0]), "+x to the last bit"
    for gravity in (np.zeros(2), [0.0, -9.81]):
        found = SideLoad().resultant(
            ca.SX(0), ca.SX(gravity), CABLE, {"force_per_length": ca.SX(1)}
        )
        assert np.array(ca.DM(found)).ravel() == pytest.approx([0.8, 0.0])
    assert loaded(0.9, 0.5) == pytest.approx(loaded(0.0, 0.5), abs=1e-7)
