"""A known cable in motion from Python: shapes let go, moving fixtures, modes, messages."""

import numpy as np
import pytest

import dlo_casadi as dlo


@pytest.fixture(scope="module")
def cable():
    data = dlo.Cable(length=0.6, mass=0.06, diameter=0.008, bending_stiffness=0.009)
    boundary, model = ("clamped", "free"), {"n": 10}
    found = dlo.known_cable(data, gravity=(0, -9.81), boundary=boundary, model=model)
    return found.with_damping(0.02, air_drag=1.1)


@pytest.fixture(scope="module")
def pulled():
    """The same cable, pulled aside at its tip."""
    data = dlo.Cable(length=0.6, mass=0.06, diameter=0.008, bending_stiffness=0.009)
    pull = {"name": "point_force", "parameters": {"fx": 0.2, "fy": 0.0, "position": 0.6}}
    boundary, model = ("clamped", "free"), {"n": 12, "effects": [pull]}
    return dlo.known_cable(data, gravity=(0, -9.81), boundary=boundary, model=model)


T = np.linspace(0.0, 1.0, 21)


def test_a_shape_let_go_begins_there_and_loses_energy(cable, pulled):
    aside = pulled.solve(start_heading=-1.2)
    motion = cable.simulate(T, start_heading=-1.2, begins=aside)
    assert motion.points.shape == (21, 101, 2)
    assert motion.points[0] == pytest.approx(aside.points, abs=2e-4)
    assert np.all(np.diff(motion.energy) < 1e-9)
    lowest = cable.solve(start_heading=-1.2).energy
    assert lowest < motion.energy[-1] < motion.energy[0] - 0.2 * (motion.energy[0] - lowest)


def test_a_shape_that_another_clamp_holds_cannot_begin(cable):
    aside = cable.solve(start_heading=-0.2)
    with pytest.raises(dlo.DloError, match="turned by 1 rad"):
        cable.simulate(T, start_heading=-1.2, begins=aside)


def test_forces_at_rest_are_those_of_the_shape(cable):
    shape = cable.solve(start_heading=-1.2)
    motion = cable.simulate([0.0, 0.1], start_heading=-1.2)
    assert motion.start_force == pytest.approx(np.stack([shape.start_force] * 2), abs=1e-9)
    assert motion.end_force == pytest.approx(np.zeros((2, 2)), abs=1e-9)


def test_a_carried_cable_follows_its_fixture(cable):
    start = np.stack([0.1 * np.sin(3 * T), 0 * T], axis=1)
    motion = cable.simulate(T, start=start, start_heading=np.full(21, -1.2))
    assert motion.at(0.0)[:, 0] == pytest.approx(start, abs=1e-6)


def test_modes_have_their_damping(cable):
    modes = cable.solve(start_heading=-np.pi / 2).modes(3)
    assert modes.shapes.shape == (3, 101, 2)
    assert np.all(np.diff(modes.frequencies) > 0)
    # Gravity stiffens without damping: below tau w / 2.
    assert np.all(modes.damping_ratios < 0.02 * np.pi * modes.frequencies)
    assert np.abs(modes.shapes).max(axis=(1, 2)) == pytest.approx(np.ones(3))


@pytest.mark.parametrize(
    ("asked", "message"),
    [
        ({"t": [0.0]}, "two times"),
        ({"t": [0.0, 1.0], "start": np.zeros((3, 2))}, "each of 2 times"),
        ({"t": [0.0, 1.0], "start_heading": np.nan}, "finite"),
        ({"t": [0.0, 1.0], "end": (0.1, 0.1)}, "free"),
    ],
)
def test_wrong_arguments_are_named(cable, asked, message):
    with pytest.raises(dlo.DloError, match=message):
        cable.simulate(**{"start_heading": -1.2, **asked})


def test_unknown_damping_is_named(cable):
    with pytest.raises(dlo.DloError, match="viscous_drag"):
        cable.with_damping(water=1.0)


@pytest.mark.parametrize("dimension", [2, 3])
def test_equations_hold_at_every_step(dimension):
    torsion = {} if dimension == 2 else {"torsional_stiffness": 0.007}
    data = dlo.Cable(length=0.6, mass=0.06, diameter=0.008, bending_stiffness=0.009, **torsion)
    gravity, ends = (*(0.0,) * (dimension - 1), -9.81), ("clamped", "pinned")
    bob = {"name": "lumped_mass", "parameters": {"mass": 0.01, "position": 0.25}}
    tied = {"stiffness": 3.0, "position": 0.4, **dict.fromkeys(("anchor_x", "anchor_y"), 0.2)}
    tied |= {"anchor_z": 0.1} if dimension == 3 else {}
    model = {"n": 10, "effects": [bob, {"name": "tether", "parameters": tied}]}
    cable = dlo.known_cable(data, gravity=gravity, boundary=ends, model=model)
    cable = cable.with_damping(0.02, air_drag=1.0, pin_friction=1e-3)
    t = np.linspace(0.0, 0.3, 7)
    end = np.tile((0.4, 0.1, 0.05)[:dimension], (7, 1))
    end[:, 0] += 0.05 * np.sin(4 * t) ** 2
    held = {"start_heading": 0.2} if dimension == 2 else {"start_orientation": (0, 0, 0, 1)}
    motion = cable.simulate(t, end=end, **held)
    equations, path = cable.motion_equations(), motion.way.path
    for k in (len(motion.way.t) // 2, -1):
        fixtures = path.at(motion.way.t[k], motion.way.cable).pose[: equations.numel_in(4)]
        residual = equations(**motion.unknowns[k], fixtures=fixtures)["residual"]
        assert np.abs(np.array(residual)).max() < 1e-6


def test_what_is_no_shape_cannot_be_let_go(cable):
    with pytest.raises(dlo.DloError, match="begins: a shape or a motion"):
        cable.simulate([0.0, 0.1], start=(0, 0), start_heading=0.0, begins="x")
