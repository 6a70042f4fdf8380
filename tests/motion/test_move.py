"""Motions after which a cable is at rest."""

from __future__ import annotations

import json
import shutil
import subprocess
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

import dlo_casadi as dlo
from dlo_casadi.cable.move import Move
from dlo_casadi.cable.moving_table import read_fixtures
from dlo_casadi.cable.planner import Planner
from dlo_casadi.codegen import generate
from dlo_casadi.planning.course import Course
from dlo_casadi.planning.predicted import predicted
from dlo_casadi.rod.obstacles import Capsule
from dlo_casadi.runtime.progress import nobody

PERIOD = 1.08  # s, of the slowest mode


def rope(dimension: int = 2) -> dlo.FittedCable:
    """Hanging from a gripper."""
    twist = {"torsional_stiffness": 0.007} if dimension == 3 else {}
    data = dlo.Cable(length=0.6, mass=0.06, diameter=0.008, bending_stiffness=0.009, **twist)
    gravity = (0.0, 0.0, -9.81)[-dimension:]
    known = dlo.known_cable(data, gravity=gravity, boundary=("clamped", "free"), model={"n": 8})
    return known.with_damping(0.02, air_drag=1.1)


def held(x: float, turn: float = 0.0) -> dict[str, object]:
    return {"start": (x, 0.0), "start_heading": -1.2 + turn}


@cache
def carried() -> Move:
    return rope().move(held(0.0), held(0.3, 0.3), duration=PERIOD)


def test_the_cable_is_at_rest_on_arrival() -> None:
    """By another simulation of the saved table, beside least jerk and zero vibration."""
    move, cable = carried(), rope()
    assert move.swing < 0.01 * move.swings["minimum jerk"]
    assert move.swing < 0.5 * move.swings["zero vibration"]
    motion = cable.simulate(**move.table())
    assert np.allclose(motion.points[-1], move.rest, atol=1e-3)
    table = move.table()
    t = table.pop("t")
    rest = {name: np.append(x, x[-1:], axis=0) for name, x in table.items()}
    after = np.append(t, t[-1] + 0.5)
    motion = cable.simulate(after, **rest)
    assert np.linalg.norm(motion.points[-1] - move.rest, axis=1).max() < 2e-3
    speeds = np.diff(table["start"], axis=0) * 250
    assert np.allclose(speeds[[0, -1]], 0.0, atol=1e-3)


def test_derivatives_of_a_motion_are_exact() -> None:
    """Swing, forces, moments, curvatures and places in space against differences."""
    cable = rope(3)
    down = {"start_orientation": (0.0, np.sqrt(0.5), 0.0, np.sqrt(0.5))}
    tilted = {"start_orientation": (0.1, np.sqrt(0.5), 0.0, np.sqrt(0.49))}
    shapes = cable.solve(start=(0, 0, 0), **down), cable.solve(start=(0.2, 0.1, 0), **tilted)
    case = Planner(cable, *shapes, {}, (), False, nobody).nominal
    course = Course.between(shapes[0].pose, shapes[1].pose, 0.5)
    way = 1e-2 * np.random.default_rng(1).standard_normal(course.size)
    h, first = 1e-3, course.least_jerk
    before, now, after = (
        predicted(case, course, first + x * way, 0.05, 0.2, derivatives=True) for x in (-h, 0.0, h)
    )
    for name in ("swing", "force", "moment", "curvature", "places"):
        change = (getattr(after, name).value - getattr(before, name).value) / (2 * h)
        found = getattr(now, name).by @ way
        assert np.abs(found - change).max() < 1e-4 * np.abs(change).max(), name


def test_effort_of_least_jerk_is_one() -> None:
    """Against the closed form of the jerk of rest to rest, 720 D^2 / T^5: it ends less smoothly."""
    shapes = [rope().solve(**held(x)) for x in (0.0, 0.3)]
    course = Course.between(shapes[0].pose, shapes[1].pose, 2.0)
    hessian, linear, constant = course.effort
    theta = course.least_jerk
    assert np.isclose(theta @ hessian @ theta / 2 + linear @ theta + constant, 1.0)
    t = np.linspace(0, 2.0, 4001)
    jerk = course.values(theta, t, 3)[:, 0]
    least = 720 * 0.3**2 / 2.0**5
    assert least < np.trapezoid(jerk**2, t) < 1.3 * least


@pytest.mark.long
def test_limits_are_kept_along_the_way() -> None:
    bar = dlo.Obstacle(kind="sphere", center=(0.16, -0.69), radius=0.12)
    near = Capsule((0.16, -0.69), (0.16, -0.69), 0.12).near
    asked = {"speed": 0.45, "force": 0.62, "clearance": 0.01}
    move = rope().move(held(0.0), held(0.3), duration=1.4, limits=asked, obstacles=[bar])
    assert max(move.used.values()) < 1.001
    assert move.active
    points = move.motion.points
    assert near(points).distance.min() - 0.004 > 0.01 - 1e-4
    assert np.linalg.norm(move.motion.start_force, axis=1).max() < 0.62 * 1.001


@pytest.mark.long
def test_a_bound_of_the_swing_takes_a_longer_motion() -> None:
    cable, way = unsure(), (held(0.0), held(0.3))
    found = cable.move(*way, duration=1.3)
    with pytest.raises(dlo.DloError, match=r"swing may be .* limit of 0\.\d+ mm.*\n  Try: dur"):
        cable.move(*way, duration=1.3, limits={"swing": found.band[1] / 2})


@pytest.mark.long
def test_advice_that_is_followed_helps() -> None:
    with pytest.raises(
        dlo.DloError, match=r"1\.08 s is too short for speed = 0\.2: .* 1\.5 s"
    ) as told:
        rope().move(held(0.0), held(0.3), duration=PERIOD, limits={"speed": 0.2})
    longer = float(str(told.value).partition("duration=")[2].partition(",")[0])
    rope().move(held(0.0), held(0.3), duration=longer, limits={"speed": 0.2})


def unsure() -> dlo.FittedCable:
    """The rope, whose stiffness is known to 3 %."""
    given = {"names": ("bending_stiffness",), "covariance": np.array([[9e-8]])}
    known = rope()
    uncertainty = replace(known.metadata.uncertainty, **given)
    return replace(known, metadata=replace(known.metadata, uncertainty=uncertainty))


def test_a_limit_of_the_swing_counts_what_is_unsure() -> None:
    found = unsure().move(held(0.0), held(0.3), duration=1.3, limits={"swing": 0.01})
    assert found.used["swing"] == pytest.approx(found.band[1] / 0.01)


def test_what_swings_nothing_is_planned() -> None:
    lift = {"start": (0.0, 0.1), "start_heading": -np.pi / 2}
    move = rope().move({**lift, "start": (0.0, 0.0)}, lift, duration=0.3)
    assert move.swing < 1e-5


def test_what_cannot_be_kept_is_told_with_numbers() -> None:
    with pytest.raises(dlo.DloError, match="both poses are the same"):
        rope().move(held(0.0), held(0.0), duration=1.0)
    with pytest.raises(dlo.DloError, match="is no limit of a motion"):
        rope().move(held(0.0), held(0.3), duration=1.0, limits={"sped": 1.0})
    with pytest.raises(dlo.DloError, match="no obstacles"):
        rope().move(held(0.0), held(0.3), duration=1.0, limits={"clearance": 0.01})
    with pytest.raises(dlo.DloError, match="known exactly"):
        rope().move(held(0.0), held(0.3), duration=1.0, robust=True)
    with pytest.raises(dlo.DloError, match=r"after: the start .* no heading"):
        rope().move(held(0.0), {"start": (0.3, 0.0)}, duration=1.0)
    with pytest.raises(dlo.DloError, match="928 periods"):
        rope().move(held(0.0), held(0.3), duration=1000.0)
    with pytest.raises(dlo.DloError, match="duration: a number above zero"):
        rope().move(held(0.0), held(0.3), duration=-1.0)


def test_meaningless_poses_are_told() -> None:
    other = dlo.known_cable(
        dlo.Cable(length=0.5, mass=0.06, diameter=0.008, bending_stiffness=0.009),
        gravity=(0.0, -9.81),
        boundary=("clamped", "free"),
    )
    ask = rope().move
    with pytest.raises(dlo.DloError, match="another cable"):
        ask(other.solve(**held(0.0)), held(0.3), duration=1.0)
    for wrong, text in (("here", "found 'here'"), ({"heading": 1.0}, "nothing is held by heading")):
        with pytest.raises(dlo.DloError, match=text):
            ask(wrong, held(0.3), duration=1.0)
    with pytest.raises(dlo.DloError, match="obstacles cannot stand in a pose"):
        ask(held(0.0) | {"obstacles": []}, held(0.3), duration=1.0)
    with pytest.raises(dlo.DloError, match=r"at rest in the pose 'before' .* force is 0\.5"):
        ask(held(0.0), held(0.3), limits={"force": 0.3})
    with pytest.raises(dlo.DloError, match="limits"):
        ask(held(0.0), held(0.3), limits=["speed"])


def test_tables_are_read_back(tmp_path: Path) -> None:
    move, cable = carried(), rope()
    t, rows = read_fixtures(cable.model.node, move.save(tmp_path / "way.csv"))
    table = move.table()
    assert np.allclose(t, table["t"])
    assert np.allclose(rows["start"], table["start"])
    assert np.allclose(rows["start_heading"], table["start_heading"])
    data = json.loads(move.save(tmp_path / "way.json").read_text())
    assert np.allclose(data["table"]["start"], table["start"])
    assert move.plot().axes
    with pytest.raises(dlo.DloError, match=r"\.csv"):
        move.save(tmp_path / "way.txt")


@pytest.mark.skipif(shutil.which("cc") is None, reason="no C compiler (cc)")
def test_a_gripper_of_c_tracks_the_table(tmp_path: Path) -> None:
    cable, move = rope(), carried()
    generate(cable.model, cable.p, cable.rest, motion=True).write(tmp_path)
    program = Path(__file__).parents[2] / "scripts/planner/track.c"
    command = ["cc", "-std=c99", "-Wall", "-Wextra", "-pedantic", "-Werror", f"-I{tmp_path}"]
    command += [str(program), str(tmp_path / "dlo_solver.c"), "-lm", "-o", str(tmp_path / "track")]
    subprocess.run(command, check=True, capture_output=True)
    tips = []
    for theta in (move.theta, move.course.least_jerk):
        table = replace(move, theta=theta).save(tmp_path / "way.csv")
        run = [str(tmp_path / "track"), str(table)]
        said = subprocess.run(run, check=True, capture_output=True, text=True).stdout
        tips.append(float(said.split()[1]))
    assert tips[0] < 1.0 < 50.0 < tips[1]  # mm
