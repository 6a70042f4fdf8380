"""Scripts in scripts/examples: what they claim, in less time than they take themselves."""

import importlib.util
from pathlib import Path

import casadi as ca
import numpy as np
import pytest

from dlo_casadi.codegen import generate
from dlo_casadi.codegen.compiler import compile_library
from dlo_casadi.effects import EFFECTS

EXAMPLES = Path(__file__).parents[1] / "scripts" / "examples"


def example(name):
    """An example as a module."""
    spec = importlib.util.spec_from_file_location(name, EXAMPLES / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_examples_are_short():
    long = [f.name for f in EXAMPLES.glob("*.py") if len(f.read_text().splitlines()) >= 80]
    assert long == []


def test_the_end_is_held_best_from_any_side_and_against_other_places():
    script = example("hold_the_end")
    shape, (low, high) = script.cable().function(), np.array([script.LOW, script.HIGH])
    ends, pulls, counts = zip(
        *(script.best_end(shape, first) for first in ([0.05, 0.01], [0.28, 0.18])), strict=True
    )
    np.testing.assert_allclose(*ends, atol=1e-5)
    assert max(counts) <= 40
    for x, y in np.random.default_rng(0).uniform(low, high, (6, 2)):
        found = shape(pose=[0, 0, x, y, script.DOWN, script.UP])
        if float(found["min_bend_radius"]) >= script.RADIUS:
            assert float(ca.norm_2(found["end_force"])) > pulls[0]
    at = shape(pose=[0, 0, *ends[0], script.DOWN, script.UP])
    assert float(at["min_bend_radius"]) == pytest.approx(script.RADIUS, rel=1e-4)


def test_the_cable_is_carried_past_the_ball(monkeypatch):
    """Three poses instead of fifteen, on eight elements: as clear of the ball as was asked."""
    script = example("carry_past")
    monkeypatch.setattr(script, "STEPS", 3)
    known = script.cable(8)
    ends, shapes, stats = script.carried(known)
    assert stats["success"]
    assert ends[2, 1] > script.STARTS[2] + 0.02  # straight on, the cable would touch
    room = script.RADIUS + known.model.cable.diameter / 2 + script.CLEAR
    for end, points in zip(ends.T, shapes, strict=True):
        assert np.linalg.norm(points.T - script.CENTER, axis=1).min() > room - 1e-6
        np.testing.assert_allclose(points[:, -1], end, atol=1e-7)


def test_the_end_is_led_past_the_obstacles_with_less_pull_than_on_the_shortest_way():
    """Five poses instead of twenty, from the same first guess."""
    script = example("lead_the_end")
    known = script.cable()
    best = script.easiest(known, 5)
    assert np.abs(best["residual"]).max() < 1e-6
    shape = known.function(branch="ccw")
    planned = [shape([0, 0, x, y, 0, 0])[1] for x, y in zip(script.X, script.Y, strict=True)]
    assert best["pulls"].max() <= max(float(ca.norm_2(force)) for force in planned)
    for end, points in zip(best["ends"].T, np.split(best["points"], 5, axis=1), strict=True):
        np.testing.assert_allclose(np.array(shape([0, 0, *end, 0, 0])[0]), points, atol=1e-6)
        for *center, radius in script.DISCS:
            gaps = np.linalg.norm(points.T - center, axis=1) - radius
            assert gaps.min() - known.model.cable.diameter / 2 >= script.GAP - 1e-6


def test_the_end_is_moved_below_the_limit_by_rockit_and_the_generated_c(tmp_path):
    pytest.importorskip("rockit")
    script = example("move_the_end")
    known = script.cable()
    library = compile_library(generate(known.model, known.p, known.rest), tmp_path, ("-O1",))
    compiled = ca.external("dlo_cable_ccw", str(library))
    t, ends, pulls = script.quickest(compiled, script.LIMIT, "limited-memory")
    shape, straight = known.function(branch="ccw"), np.subtract(script.GOAL, script.START)
    told = [float(ca.norm_2(shape([0, 0, *end, 0, 0])[1])) for end in ends]
    np.testing.assert_allclose(pulls, told, atol=1e-8)
    assert pulls.max() == pytest.approx(script.LIMIT, abs=1e-6)
    # Full push to the middle and back takes 2 sqrt(d / a) along the straight way, where it pulls.
    assert t[-1] > 1.01 * 2 * np.sqrt(np.linalg.norm(straight) / script.FASTEST)


@pytest.fixture
def simulated(monkeypatch):
    """Scripts beside an example can be imported."""
    monkeypatch.syspath_prepend(EXAMPLES)


def test_points_of_a_new_pose_lie_in_the_band(simulated, tmp_path):
    script = example("fit_arrays")
    result = script.main(tmp_path / "picture.png")
    low, high = result.params["bending_stiffness"].interval_95
    assert low < example("simulated_rod").EI < high
    assert high - low < 0.1 * low
    assert (tmp_path / "picture.png").stat().st_size > 10_000


def test_what_the_next_pose_tells_is_foreseen(simulated, tmp_path):
    before, foreseen, fitted = example("next_pose").main(tmp_path / "picture.png", size=5)
    assert fitted < 0.2 * before
    assert foreseen == pytest.approx(fitted, rel=0.1)


def test_an_effect_of_ones_own_is_found(simulated, tmp_path, monkeypatch):
    script = example("own_effect")
    monkeypatch.setitem(EFFECTS, "balloon", script.Balloon)  # and taken back
    monkeypatch.setattr(script, "ENDS", script.ENDS[:4])  # quicker, and so are few candidates
    others = [name for name in EFFECTS if name not in ("balloon", "point_force")]
    monkeypatch.setitem(script.QUICK, "diagnosis", {"exclude": others})
    (effect,) = script.main(tmp_path / "picture.png").effects
    assert effect.name == "balloon"
    for name, true in (("lift", script.LIFT), ("position", script.PLACE)):
        assert abs(effect.parameters[name].value - true) < 3 * effect.parameters[name].std


def test_clips_of_a_door_keep_limits_at_openings_between_those_they_were_placed_for(
    simulated, fewer_starts, tmp_path, monkeypatch
):
    script = example("place_clips")
    monkeypatch.setattr(script, "OPENINGS", np.array([-0.3, 0.6, 1.5]))  # quicker
    placing = script.main(tmp_path / "picture.png")
    assert placing.margin > 0.1
    cable = script.fitted()
    for pose in script.opened(np.array([0.1, 1.0])):
        for check in cable.solve(**pose, clips=placing.clips).check(script.LIMITS):
            assert check.verdict == "pass"
    assert (tmp_path / "picture.png").stat().st_size > 10_000


def test_the_cable_rests_on_the_table_but_not_on_the_hot_plate():
    script = example("rest_on_the_table")
    found = script.moved(script.cable(), np.linspace(-0.3, 0.3, 5))
    assert all(shape.obstacle_forces[0, 2] < 0.0 for shape, _, _ in found)
    assert [allowed for _, _, allowed in found] == [True] * 4 + [False]


@pytest.mark.long
def test_a_connector_that_falls_off_is_missed(tmp_path):
    cable = example("pick_and_place").main(tmp_path / "picture.png", count=18, lost=9)
    mass = cable.params["lumped_mass.mass"]
    assert mass.value < 0.004
    assert mass.value < 3 * mass.std
    assert (tmp_path / "picture.png").stat().st_size > 10_000
