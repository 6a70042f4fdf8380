"""Exports of simple cables: nothing is lost without a reason, and wrong numbers are refused."""

import ast
from xml.etree import ElementTree

import numpy as np
import pytest

import dlo_casadi as dlo
from dlo_casadi.effects import CableData, GravityTilt, MassError, SideLoad
from dlo_casadi.equilibrium.pose import HeldPose
from dlo_casadi.export.rod import features_of
from dlo_casadi.model.cable_model import CableModel

ROPE = {
    "name": "rope",
    "length": 0.8,
    "mass": 0.2,
    "diameter": 0.012,
    "bending_stiffness": 0.3,
}


def test_a_heavier_cable_has_no_load_across_gravity():
    """Whatever rounding leaves across a gravity that is turned."""
    cable = CableData(0.8, 0.2, 0.012, 0.3, torsional_stiffness=0.2)
    gravity = (0.0, 0.0, -9.81)
    model = CableModel(cable, 4, gravity=gravity, effects=(MassError(), GravityTilt()), n_rest=0)
    pose, p = HeldPose((0.0,) * 3, (0.5, 0.0, 0.0)), model.nominal.copy()
    for factor in np.linspace(0.5, 2.0, 20):
        p[model.names.index("mass_error.factor")] = factor
        p[model.names.index("gravity_tilt.angle_x")] = 0.1 * factor
        assert features_of(model, p, pose) == {}


def test_a_small_side_load_is_one_across_gravity():
    model = CableModel(CableData(0.8, 0.2, 0.012, 0.3), 4, effects=(SideLoad(),), n_rest=0)
    p = model.nominal.copy()
    p[-1] = 1e-6
    assert list(features_of(model, p, HeldPose((0.0, 0.0), (0.5, 0.0)))) == ["load across gravity"]


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"segments": 0}, "segments: a whole number, 4 or more, found 0\n  Try: segments=4"),
        ({"segments": -3}, "found -3"),
        ({"segments": 2}, "found 2"),
        ({"segments": 4.5}, "found 4.5"),
        ({"seed": -1}, "seed: a whole number, 0 or more, found -1"),
        ({"samples": -1}, "samples: a whole number, 0 or more, found -1"),
        ({"samples": True}, "samples: a whole number, 0 or more, found True"),
    ],
)
def test_numbers_that_are_too_small(options, said, tmp_path):
    rope = dlo.known_cable(ROPE, gravity=(0, -9.81), boundary={"start": "pinned", "end": "pinned"})
    with pytest.raises(dlo.DloError, match=said):
        rope.export("mujoco", tmp_path / "rope.xml", end=(0.5, 0.1), **options)


@pytest.mark.parametrize("target", ["mujoco", "pyelastica", "newton"])
def test_a_name_of_two_lines_breaks_no_file(target, tmp_path):
    known = ROPE | {"name": "rope\nb = 1 / 0\x07"}
    rope = dlo.known_cable(known, gravity=(0, -9.81), boundary={"start": "pinned", "end": "pinned"})
    (path,) = rope.export(target, tmp_path / "rope", end=(0.5, 0.1), segments=6)
    text = path.read_text()
    read = ElementTree.fromstring if target == "mujoco" else ast.parse
    read(text)  # raises unless it is well formed
    assert "rope b = 1 / 0" in text
    assert "\nb = " not in text
