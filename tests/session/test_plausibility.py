"""Suspicions on synthetic ends, and none on any session of the repository."""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

import dlo_casadi as dlo
from dlo_casadi.config import load_config
from dlo_casadi.session.axes import exchanges, named
from dlo_casadi.session.ends import (
    out_of_step,
    repeated,
    shorter,
    single_poses,
    wrong_frame,
    wrong_units,
)
from dlo_casadi.session.lines import Lines
from dlo_casadi.session.measure import read_inputs
from dlo_casadi.session.plausibility import QUESTIONS, find_suspicions
from dlo_casadi.session.read_session import ReadSession

ROOT = Path(__file__).parents[2]
SESSIONS = [*ROOT.glob("tests/data/bench/*/session.yaml"), *ROOT.glob("configs/*.yaml")]
LENGTH = 0.8  # m
FRAMES = exchanges(2)[1:]


def asked(question, lines):
    """What a question to the ends of lines finds."""
    return question(SimpleNamespace(lines=lines))


def suspicions(lines):
    """What all questions to the ends find: the first that finds anything is the only one."""
    (alternatives,) = QUESTIONS[0]
    return next(filter(None, (asked(question, lines) for question in alternatives)), ())


def ordered(count):
    """That nobody knows where a line begins."""
    return np.zeros(count, dtype=bool)


def session(count=9, seed=0):
    """Lines that end 5 mm RMS from their fixtures, in either order."""
    rng = np.random.default_rng(seed)
    angle, reach = rng.uniform(-2.5, 0.5, count), rng.uniform(0.3, 0.7, count)
    ends = np.column_stack([reach * np.cos(angle), reach * np.sin(angle)])
    declared = np.stack([np.zeros((count, 2)), ends], axis=1)
    measured = declared + 5e-3 * rng.standard_normal((count, 2, 2)) / np.sqrt(2)
    measured[::2] = measured[::2, ::-1]
    lengths = LENGTH * (1 + 0.01 * rng.standard_normal(count))
    names = tuple(f"pose_{k}" for k in range(count))
    return Lines(names, declared, measured, lengths, LENGTH, np.zeros((count, 2)), ordered(count))


def markers(count=9):
    """First and last marker, at 0.3 and 1.0 of cables that hang from a gripper at the origin."""
    angle = np.linspace(-2.0, -1.1, count)
    way = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    measured = LENGTH * np.stack([0.29 * way, 0.95 * way], axis=1)
    declared = np.full((count, 2, 2), np.nan)
    declared[:, 0] = 0.0
    names = tuple(f"pose_{k}" for k in range(count))
    gaps = np.tile([0.3 * LENGTH, 0.0], (count, 1))
    return Lines(
        names, declared, measured, np.full(count, LENGTH * 0.66 / 0.7), LENGTH, gaps, ordered(count)
    )


def test_markers_need_not_be_where_the_cable_ends():
    lines = markers()
    assert suspicions(lines) == ()
    scaled = replace(lines, measured=1e3 * lines.measured, lengths=1e3 * lines.lengths)
    assert "the points look like millimetres" in asked(wrong_units, scaled)[0].message
    # No cable reaches farther than it is long.
    moved = lines.measured.copy()
    moved[4] += [0.0, -0.5 * LENGTH]
    (found,) = suspicions(replace(lines, measured=moved))
    assert found.pose == "pose_4"


@pytest.mark.parametrize("seed", range(20))
def test_a_sound_session_raises_no_suspicion(seed):
    assert suspicions(session(seed=seed)) == ()


@pytest.mark.parametrize(
    ("factor", "unit"), [(1e3, "millimetres"), (1e2, "centimetres"), (1 / 0.0254, "inches")]
)
def test_units_are_told_from_the_ratio_of_lengths(factor, unit):
    lines = session()
    points = replace(lines, measured=factor * lines.measured, lengths=factor * lines.lengths)
    assert f"the points look like {unit}" in asked(wrong_units, points)[0].message
    declared = replace(lines, length=factor * LENGTH)
    assert (
        f"it looks like {unit}. Try: cable.length: 0.8," in asked(wrong_units, declared)[0].message
    )
    ends = replace(lines, declared=lines.declared / factor)
    assert f"the factor of {unit}" in asked(wrong_units, ends)[0].message


def test_a_length_that_is_a_little_off_is_no_unit():
    lines = session()
    for factor in (0.5, 0.9, 1.1, 2.0, 10.0):
        assert asked(wrong_units, replace(lines, lengths=factor * lines.lengths)) == ()


@pytest.mark.parametrize("axes", FRAMES, ids=named)
@pytest.mark.parametrize("shift", [(0.0, 0.0), (1.3, 0.7)])
def test_every_frame_is_recognised(axes, shift):
    lines = session()
    turned = replace(lines, measured=lines.measured @ axes + shift)
    (found,) = suspicions(turned)
    assert found.certain
    assert f"with {named(axes)}" in found.message
    assert ("moved by (" in found.message) == any(shift)


def test_a_frame_a_little_off_is_a_doubt():
    lines = session()
    c, s = np.cos(0.15), np.sin(0.15)
    (found,) = asked(wrong_frame, replace(lines, measured=lines.measured @ [[c, s], [-s, c]]))
    assert not found.certain
    assert "with the points turned by 8." in found.message


def test_a_mirrored_frame_that_is_turned_is_told_by_its_angle():
    """Of a picture with y downwards, taken askew."""
    lines = session()
    c, s = np.cos(0.6), np.sin(0.6)
    measured = lines.measured @ np.array([[c, s], [-s, c]]) * [1, -1]
    (found,) = suspicions(replace(lines, measured=measured))
    assert found.certain
    assert "with the points mirrored, turned by 3" in found.message
    angle = float(found.message.split("turned by ")[1].split(" degrees")[0])
    assert angle == pytest.approx(np.degrees(0.6), abs=1.0)  # ends are 5 mm off


def test_another_origin_is_recognised():
    lines = session()
    (found,) = suspicions(replace(lines, measured=lines.measured + np.array([0.3, -0.2])))
    assert found.certain
    assert found.message.startswith("all lines lie (0.3")


def test_two_wrong_poses_do_not_hide_a_wrong_frame():
    lines = session(12)
    measured = lines.measured * [1, -1]
    measured[:2] += 0.4
    (found,) = asked(wrong_frame, replace(lines, measured=measured))
    assert "y pointing down" in found.message


@pytest.mark.parametrize("order", [np.roll(np.arange(9), -1), [1, 0, *range(2, 9)]])
def test_files_of_other_poses_are_named(order):
    lines = session()
    (found,) = asked(out_of_step, replace(lines, measured=lines.measured[order]))
    assert found.certain
    assert "pose_0 shows the ends of pose_1" in found.message


def test_one_wrong_end_is_odd_but_not_certain():
    lines = session()
    declared = lines.declared.copy()
    declared[3, 1] += 0.2
    (found,) = suspicions(replace(lines, declared=declared))
    assert not found.certain
    assert found.message.startswith("pose_3: its line runs from")


def test_a_line_of_a_part_of_the_cable_needs_arc_lengths():
    lines = session()
    measured, lengths = lines.measured.copy(), lines.lengths.copy()
    measured[3, 1] += 0.5 * (measured[3, 0] - measured[3, 1]) + 0.1
    for share, told in ((0.6, True), (1.0, False)):
        lengths[3] = share * lines.length
        (found,) = suspicions(replace(lines, measured=measured, lengths=lengths))
        assert found.pose == "pose_3"
        assert ("give the arc lengths of its points (`at`" in found.message) == told


def test_start_and_end_exchanged_in_one_pose():
    lines = session()
    declared = lines.declared.copy()
    declared[5] = declared[5, ::-1]
    (found,) = asked(single_poses, replace(lines, declared=declared))
    assert found.message.startswith("pose_5: its end (0, 0) m is where the other poses")


def test_free_ends_are_judged_by_their_start():
    lines = session()
    declared = lines.declared.copy()
    declared[:, 1] = np.nan
    free = replace(lines, declared=declared, measured=lines.declared)
    assert suspicions(free) == ()
    (found,) = suspicions(replace(free, measured=lines.declared + np.array([0.0, 0.3])))
    assert "all lines lie (0, 0.3)" in found.message


def test_the_same_points_twice():
    points = np.random.default_rng(0).standard_normal((3, 5, 2))

    def found_in(*points):
        named = zip("abc", points, strict=True)
        read = [SimpleNamespace(name=name, points=own) for name, own in named]
        return repeated(SimpleNamespace(read=read))

    assert found_in(*points) == ()
    (found,) = found_in(points[0], points[1], points[0])
    assert found.message.startswith("c holds exactly the points of a")


def label(path):
    return path.parent.name if path.stem == "session" else path.stem


@pytest.mark.parametrize("path", SESSIONS, ids=label)
def test_no_session_of_the_repository_looks_like_a_mistake(path):
    """Photographs: a few poses of each session, since reading takes time."""
    config = load_config(path)
    if config.experiment.measurement.kind == "images":
        poses = config.experiment.poses[::6]
        config = config.changed(experiment=config.experiment.changed(poses=poses))
    assert find_suspicions(config, read_inputs(config)) == ()


HANGING = dlo.Cable(length=0.8, mass=0.06, diameter=0.006, bending_stiffness=0.02)
HELD = {"gravity": (0, -9.81), "boundary": ("pinned", "pinned")}
# Arc lengths of 30 points [m]; the same, but none between 0.12 and 0.4 m.
DENSE = np.linspace(0.01, 0.79, 30)
GAP = DENSE[(DENSE < 0.12) | (DENSE > 0.4)]


@pytest.fixture(scope="module")
def hanging():
    """A cable between pins."""
    return dlo.known_cable(HANGING, **HELD, model={"n": 20})


def declared_as(cable, length, s):
    """The session of a cable of 0.8 m that is declared with another length."""
    rng = np.random.default_rng(3)
    ends = ((0.6, 0.0), (0.3, 0.1), (0.5, -0.3), (0.4, 0.25))
    poses = [
        dlo.Pose((0, 0), end, points=points + rng.normal(0, 3e-4, points.shape))
        for end in ends
        for points in (cable.solve(end=end).curve.at(s),)
    ]
    config = dlo.Session(HANGING.changed(length=length), poses, **HELD)
    return ReadSession(config, tuple(read_inputs(config)))


@pytest.mark.parametrize(
    ("length", "s", "said"),
    [
        (0.9, DENSE, True),
        (0.8, DENSE, False),
        (0.83, DENSE, False),
        (0.7, DENSE, False),
        (0.9, GAP, False),
        (0.9, DENSE[::8], False),
    ],
)
def test_lines_that_are_too_short_for_the_cable_say_so(hanging, length, s, said):
    """Unless a gap, few points or noise could hide the difference."""
    found = shorter(declared_as(hanging, length, s))
    assert bool(found) == said
    if said:
        (one,) = found
        assert "the cable is 0.8 m long (median of 4 poses)" in one.message
        assert "cable.length is 0.9 m" in one.message
        assert not one.certain
