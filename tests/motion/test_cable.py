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
        ({"t": [0.0, 1.0], "tolerance": -1}, "tolerance: a number above zero"),
        ({"t": [0.0, 1.0], "tolerance": "small"}, "tolerance: a number above zero"),
    ],
)
def test_wrong_arguments_are_named(cable, asked, message):
    with pytest.raises(dlo.DloError, match=message):
        cable.simulate(**{"start_heading": -1.2, **asked})


def test_an_end_that_slides_does_not_move():
    data = dlo.Cable(length=0.6, mass=0.06, diameter=0.008, bending_stiffness=0.009)
    cable = dlo.known_cable(data, gravity=(0, -9.81), boundary=("clamped", "slide"))
    with pytest.raises(dlo.DloError, match="an end that slides: a cable in motion is not fed"):
        cable.simulate(T, start_heading=0.0, end=(0.5, 0.0), end_heading=0.0)


def test_unknown_damping_is_named(cable):
    with pytest.raises(dlo.DloError, match="viscous_drag"):
        cable.with_damping(water=1.0)
    with pytest.raises(dlo.DloError, match="damping_time: a number belongs here, found 'x'"):
        cable.with_damping("x")
    for again in ({"damping_time": 0.03}, {"air_drag": 1.2}):
        with pytest.raises(dlo.DloError, match="has it already"):
            cable.with_damping(**again)


def test_more_modes_than_a_mesh_has_are_refused(cable):
    with pytest.raises(dlo.DloError, match=r"9999 modes: this mesh has \d+"):
        cable.solve(start_heading=-1.2).modes(9999)


def test_steps_take_any_number_and_shapes_alone(cable):
    assert cable.step(np.float32(0.01)).name_out(0) == "next"
    with pytest.raises(dlo.DloError, match="about: a shape"):
        cable.step(0.01, about="rest")


def test_a_motion_is_told_in_a_few_lines_and_ends_where_the_cable_does(cable):
    motion = cable.simulate(T[:2], start_heading=-1.2)
    assert repr(motion).startswith("cable: 0 to 0.05 s in ")
    assert "largest force on its start: 0.5886 N" in repr(motion)
    assert len(repr(motion).splitlines()) == 3
    assert motion.at(0.6)[:, 0] == pytest.approx(motion.points[:, -1])
    for wrong in (0.7, [-0.01], np.nan, "tip", [[0.1]]):
        with pytest.raises(dlo.DloError, match=r"s: arc lengths of 0 to 0\.6 m"):
            motion.at(wrong)


@pytest.mark.parametrize("ends", [("clamped", "free"), ("pinned", "pinned")])
def test_a_place_that_is_off_by_rounding_begins_a_motion(ends):
    """Nothing moves: forces stay those at rest, whatever shape or motion begins."""
    data = dlo.Cable(length=0.6, mass=0.06, diameter=0.008, bending_stiffness=0.009)
    cable = dlo.known_cable(data, gravity=(0, -9.81), boundary=ends, model={"n": 10})
    cable = cable.with_damping(0.02)
    held = {"start_heading": -1.2} if ends[1] == "free" else {"end": (0.4, 0.1)}
    shape = cable.solve(**held)
    off = 1e-3 if ends[1] == "free" else 1e-7
    for begins in (shape, cable.simulate(T[:2], **held)):
        motion = cable.simulate(T[:3], start=(off, 0.0), **held, begins=begins)
        assert motion.points[-1] == pytest.approx(shape.points + np.array([off, 0]), abs=1e-6)
        if "start_heading" in held:
            cable.simulate(T[:2], start_heading=-1.19, begins=begins)
            continue
        with pytest.raises(dlo.DloError, match=r"0.001 mm off its fixtures.\n  Try: start=\(0.0, "):
            cable.simulate(T[:2], start=(1e-6, 0.0), **held, begins=begins)


def test_a_cable_that_is_torn_tells_how_far_its_ends_are_apart():
    data = dlo.Cable(length=0.6, mass=0.06, diameter=0.008, bending_stiffness=0.009)
    ends = ("pinned", "pinned")
    cable = dlo.known_cable(data, gravity=(0, -9.81), boundary=ends, model={"n": 8})
    end = np.stack([0.5 + 2 * T[:3], 0 * T[:3]], axis=1)
    with pytest.raises(
        dlo.DloError, match=r"start and end are 0\.\d+ m apart, with 0.6 m of cable"
    ):
        cable.simulate(T[:3], end=end)


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
