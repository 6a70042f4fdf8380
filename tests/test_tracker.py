"""A cable that is estimated while it is handled."""

from __future__ import annotations

import shutil
from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import least_squares

import dlo_casadi as dlo
from dlo_casadi.cable.estimate import Covariance
from dlo_casadi.cable.tracked import known_of, with_known
from dlo_casadi.effects import EdgeBias
from dlo_casadi.tracking.inquiry import Change
from dlo_casadi.tracking.tracker import IN_A_ROW, WINDOW, Tracker

STD, S = 4e-4, np.linspace(0.1, 0.6, 8)
NAMES = ("bending_stiffness", "lumped_mass.mass")
SIZES = np.array([0.002, 0.004])


def rope(stiffness: float = 0.009, load: float = 0.01, more: float = 0.0) -> dlo.FittedCable:
    """A hanging cable with a weight, whose stiffness and weight are uncertain."""
    data = dlo.Cable(length=0.6, mass=0.06, diameter=0.008, bending_stiffness=stiffness)
    carried = [{"name": "lumped_mass", "parameters": {"mass": load, "position": 0.5}}]
    if more:
        carried.append({"name": "lumped_mass", "parameters": {"mass": more, "position": 0.25}})
    model = {"n": 8, "effects": carried}
    cable = dlo.known_cable(data, gravity=(0, -9.81), boundary=("clamped", "free"), model=model)
    covariance, old = np.diag(SIZES**2), cable.metadata
    uncertain = replace(old.uncertainty, names=NAMES, covariance=covariance)
    found = Covariance(NAMES, covariance)
    return replace(cable, metadata=replace(old, covariance=found, uncertainty=uncertain))


def pose(cable: dlo.FittedCable, heading: float, seed: int, *, markers: bool = True) -> dlo.Pose:
    """Points of a cable between its fixtures."""
    held = {"start": (0.0, 0.0), "start_heading": heading}
    s = S if markers else np.linspace(0.02, 0.58, 30)
    points = cable.solve(**held).curve.at(s)
    points = points + STD * np.random.default_rng(seed).normal(size=points.shape)
    return dlo.Pose(points=points, at=s if markers else None, **held)


HEADINGS = np.linspace(-1.2, 0.4, 8)


def followed(tracker: Tracker, cable: dlo.FittedCable, headings: np.ndarray = HEADINGS) -> None:
    for k, heading in enumerate(headings):
        tracker.update(pose(cable, float(heading), k))


def test_it_equals_the_fit_of_all_poses() -> None:
    """Values within 0.1 std, std within 5 % of nonlinear least squares in SciPy with the prior."""
    true, prior = rope(0.0105, 0.013), rope()
    tracker = prior.tracker(STD)
    followed(tracker, true)
    poses = [pose(true, float(heading), k) for k, heading in enumerate(HEADINGS)]

    def residual(z: np.ndarray) -> np.ndarray:
        # Stiffnesses are Gaussian in their logarithms, as in a fit.
        stiffness, load = 0.009 * np.exp(SIZES[0] / 0.009 * z[0]), 0.01 + SIZES[1] * z[1]
        cable = rope(stiffness, load)
        rows = [
            (x.points - cable.solve(start=x.start, start_heading=x.start_heading).curve.at(S)) / STD
            for x in poses
        ]
        return np.concatenate([np.ravel(rows), z])

    best = least_squares(residual, np.zeros(2), diff_step=1e-4)
    std = SIZES * np.sqrt(np.diag(np.linalg.inv(best.jac.T @ best.jac)))
    values = 0.009 * np.exp(SIZES[0] / 0.009 * best.x[0]), 0.01 + SIZES[1] * best.x[1]
    std[0] *= values[0] / 0.009
    for name, value, s in zip(NAMES, values, std, strict=True):
        found = tracker.params[name]
        assert abs(found.value - value) < 0.1 * s
        assert found.std == pytest.approx(s, rel=0.05)


def test_innovations_are_white() -> None:
    tracker, true = rope().tracker(STD), rope(0.0105, 0.013)
    updates = [tracker.update(pose(true, float(x), k)) for k, x in enumerate(HEADINGS)]
    whole = np.concatenate([one.innovation for one in updates])
    assert 0.8 < whole.std() < 1.2
    assert not any(one.refused or one.change for one in updates)


def test_lines_tell_the_stiffness() -> None:
    tracker, true = rope().tracker(STD), rope(0.0105, 0.013)
    for k, heading in enumerate(HEADINGS):
        tracker.update(pose(true, float(heading), k, markers=False))
    found = tracker.params["bending_stiffness"]
    assert abs(found.value - 0.0105) < 3 * found.std
    assert found.std < 0.1 * SIZES[0]


def test_correlated_lines_tell_less() -> None:
    trackers = [rope().tracker(STD, correlated=size) for size in (0.0, 0.05)]
    held = {"start": (0.0, 0.0), "start_heading": -0.5}
    points = rope().solve(**held).curve.at(np.linspace(0.02, 0.58, 30))
    for tracker in trackers:
        assert not tracker.update(dlo.Pose(points=points, **held)).refused
    white, alike = (tracker.params["bending_stiffness"].std for tracker in trackers)
    assert 1.1 * white < alike < 4 * white


def test_a_force_without_a_shape_tells_the_weight() -> None:
    """The start carries the cable and its weight: 0.01 N of noise are 1 g, and 0.5 g in four."""
    true, trackers = rope(load=0.013), [rope().tracker(STD, force_std=x) for x in (0.01, None)]
    rng = np.random.default_rng(1)
    for k in range(4):
        held = {"start": (0.0, 0.0), "start_heading": float(HEADINGS[k])}
        force = true.solve(**held).start_force + 0.01 * rng.normal(size=2)
        for tracker in trackers:
            update = tracker.update(dlo.Pose(start_force=force, **held))
            assert not update.refused
    found, unused = (tracker.params["lumped_mass.mass"] for tracker in trackers)
    assert found.std == pytest.approx(0.01 / 9.81 / 2, rel=0.1)
    assert abs(found.value - 0.013) < 3 * found.std
    assert (unused.value, unused.std) == pytest.approx((0.01, 0.004))
    assert trackers[1].count == 4


def test_a_pose_seen_wrong_is_refused_and_three_are_a_change() -> None:
    true, tracker = rope(), rope().tracker(STD)
    followed(tracker, true)
    before = tracker.params["bending_stiffness"].value
    wrong = pose(true, -0.5, 40)
    seen = tracker.update(wrong.changed(points=np.asarray(wrong.points) + 0.01))
    assert seen.refused
    assert seen.change is None
    assert tracker.params["bending_stiffness"].value == before
    assert not tracker.update(pose(true, -0.5, 41)).refused
    fallen = rope(load=0.0)
    alarms = [tracker.update(pose(fallen, float(x), 50 + k)).change for k, x in enumerate(HEADINGS)]
    first, change = next((k, one) for k, one in enumerate(alarms) if one)
    assert first < IN_A_ROW
    assert change.since == len(HEADINGS) + 3
    assert change.cause == "lumped_mass"
    assert change.values["lumped_mass.mass"] == pytest.approx(
        -0.01, abs=5 * change.std["lumped_mass.mass"]
    )
    assert tracker.params["lumped_mass.mass"].value < 0.001


def test_refused_poses_before_an_alarm_are_of_the_change() -> None:
    """The third odd pose, of a cable that hangs straight down, is too near to be refused."""
    tracker, fallen = rope().tracker(STD), rope(load=0.0)
    followed(tracker, rope())
    seen = [tracker.update(pose(fallen, x, 70 + k)) for k, x in enumerate((-0.5, -0.3, -1.518))]
    assert [one.refused for one in seen] == [True, True, False]
    change = seen[-1].change
    assert change is not None
    assert (change.cause, change.since) == ("lumped_mass", len(HEADINGS) + 1)


def changed(tracker: Tracker, cable: dlo.FittedCable, count: int) -> Change:
    """The change that was found when the cable is another one from now on."""
    for k in range(count):
        change = tracker.update(pose(cable, float(HEADINGS[3 * k % 8]), 90 + k)).change
        if change and change.decided:
            return change
    raise AssertionError(tracker.change)


def test_a_softer_cable_is_named() -> None:
    tracker = rope().tracker(STD)
    followed(tracker, rope())
    change = changed(tracker, rope(0.007), 12)
    assert (change.cause, change.since) == ("bending_stiffness", len(HEADINGS) + 1)
    size = change.values["bending_stiffness"]
    assert size == pytest.approx(-0.002, abs=4 * change.std["bending_stiffness"])
    found = tracker.params["bending_stiffness"]
    assert abs(found.value - 0.007) < 4 * found.std


def test_a_weight_that_is_put_on_is_added_to_the_cable(tmp_path) -> None:
    tracker, heavier = rope().tracker(STD), rope(more=0.02)
    followed(tracker, rope())
    change = changed(tracker, heavier, 20)
    assert change.cause == "lumped_mass_2"
    assert change.since == len(HEADINGS) + 1
    tracker.cable.save(tmp_path / "rope")
    again = dlo.load(tmp_path / "rope")
    for name, value in (("mass", 0.02), ("position", 0.25)):
        found = again.params[f"lumped_mass_2.{name}"]
        assert abs(found.value - value) < 4 * found.std
    shape = again.solve(start=(0, 0), start_heading=-0.5)
    true = heavier.solve(start=(0, 0), start_heading=-0.5)
    assert np.abs(shape.points - true.points).max() < 2e-3
    assert not again.tracker(STD).update(pose(heavier, -0.9, 7)).refused


def test_what_nothing_explains_is_a_change_without_a_cause() -> None:
    tracker, rng = rope().tracker(STD), np.random.default_rng(1)
    followed(tracker, rope(), HEADINGS[:4])
    first = tracker.params["bending_stiffness"].std
    news = []
    for k in range(5):
        wrong = pose(rope(), float(HEADINGS[k]), k)
        points = np.asarray(wrong.points) + 0.03 * rng.normal(size=(8, 2))
        news.append(tracker.update(wrong.changed(points=points)).change)
    assert news[2] is not None
    assert news[2].cause is None
    assert "something unknown" in str(news[2])
    assert tracker.params["bending_stiffness"].std > first


def test_a_bounded_number_of_poses_is_kept() -> None:
    tracker = rope().tracker(STD)
    for k in range(WINDOW + 8):
        update = tracker.update(pose(rope(), float(HEADINGS[k % 8]), k))
        assert update.change is None
    assert len(tracker._window) == WINDOW
    assert len(tracker._jumps.since) <= WINDOW


def test_a_curved_cable_is_saved_as_it_is(tmp_path) -> None:
    data = dlo.Cable(length=0.6, mass=0.06, diameter=0.008, bending_stiffness=0.009)
    held = {"gravity": (0, -9.81), "boundary": ("clamped", "free")}
    cable = dlo.known_cable(data, **held, rest_curvature=[0.5, 1.0, 0.2, 0.0], model={"n": 8})
    names = ("bending_stiffness", "rest_curvature[1]")
    sizes = dict(zip(names, (0.002, 0.3), strict=True))
    cable = with_known(cable, known_of(cable).with_unknowns(cable.model, {}, sizes))
    tracker = cable.tracker(STD)
    true = replace(cable, rest=cable.rest * 1.2)
    followed(tracker, true, HEADINGS[:3])
    tracker.cable.save(tmp_path / "rope")
    again = dlo.load(tmp_path / "rope")
    shapes = [one.solve(start=(0, 0), start_heading=-0.5) for one in (tracker.cable, again)]
    assert np.abs(shapes[0].points - shapes[1].points).max() < 1e-9


def test_what_drifts_is_followed() -> None:
    tracker = rope().tracker(STD, drift={"bending_stiffness": 1e-4})
    inside = []
    for k in range(25):
        true = 0.009 * (1 - 0.01 * k)
        tracker.update(pose(rope(true), float(HEADINGS[k % 8]), k))
        found = tracker.params["bending_stiffness"]
        inside.append(abs(found.value - true) < 2.5 * found.std)
    assert np.mean(inside) > 0.9


def test_it_is_saved_and_goes_on(tmp_path) -> None:
    """A file keeps what was learned as it was linearised: later poses correct it no more."""
    true, tracker = rope(0.0105, 0.013), rope().tracker(STD)
    followed(tracker, true, HEADINGS[:4])
    tracker.cable.save(tmp_path / "rope")
    again = dlo.load(tmp_path / "rope").tracker(STD)
    for name in NAMES:
        assert again.params[name].value == pytest.approx(tracker.params[name].value, rel=1e-12)
        assert again.params[name].std == pytest.approx(tracker.params[name].std, rel=1e-9)
    followed(tracker, true, HEADINGS[4:])
    followed(again, true, HEADINGS[4:])
    for name in NAMES:
        found, other = again.params[name], tracker.params[name]
        assert abs(found.value - other.value) < 0.02 * other.std
        assert found.std == pytest.approx(other.std, rel=0.01)


def test_hardly_known_parameters_are_learned_as_by_all_poses_at_once() -> None:
    """EI is known to a factor of e: a filter that never looks back is far off."""
    true = rope(0.018, 0.013)
    known = known_of(rope(0.006))
    wide = with_known(rope(0.006), known.with_covariance(np.diag([0.006, 0.02]) ** 2))
    several, backwards = (wide.tracker(STD) for _ in range(2))
    poses = [pose(true, float(x), k) for k, x in enumerate(HEADINGS[:5])]
    for one, other in zip(poses, poses[::-1], strict=True):
        several.update(one)
        backwards.update(other)
    for name in NAMES:
        found, other = several.params[name], backwards.params[name]
        assert abs(found.value - other.value) < 0.02 * other.std
        assert found.std == pytest.approx(other.std, rel=0.01)


@pytest.mark.skipif(shutil.which("cc") is None, reason="no C compiler (cc)")
def test_compiled_equilibria_are_the_same() -> None:
    true, trackers = rope(0.0105), [rope().tracker(STD, compiled=on) for on in (False, True)]
    for k in (0, 7, 3):  # far apart, so that none is found from the one before
        for tracker in trackers:
            tracker.update(pose(true, float(HEADINGS[k]), k))
    for name in NAMES:
        one, other = (tracker.params[name] for tracker in trackers)
        assert one.value == pytest.approx(other.value, rel=1e-7)
        assert one.std == pytest.approx(other.std, rel=1e-7)


def test_meaningless_arguments_are_told() -> None:
    with pytest.raises(dlo.DloError, match="std: the noise"):
        rope().tracker(0.0)
    with pytest.raises(dlo.DloError, match="forget"):
        rope().tracker(STD, forget=1.5)
    with pytest.raises(dlo.DloError, match="not estimated"):
        rope().tracker(STD, drift={"mass": 1.0})
    with pytest.raises(dlo.DloError, match="a Pose belongs here"):
        rope().tracker(STD).update("pose")
    data = dlo.Cable(length=0.6, mass=0.06, diameter=0.008, bending_stiffness=0.009)
    exact = dlo.known_cable(data, gravity=(0, -9.81), boundary=("clamped", "free"))
    with pytest.raises(dlo.DloError, match="exact"):
        exact.tracker(STD)


def test_what_photographs_do_to_points_is_not_expected_of_numbers() -> None:
    """A cable from photographs, whose edges are off by 1 mm, is seen where it is."""
    plain = rope()
    model = plain.model.with_effect(EdgeBias())
    p = np.append(plain.p, np.full(len(model.names) - len(plain.p), 1e-3))
    names, sizes = (*NAMES, "edge_bias.a1"), (*SIZES, 1e-3)
    old = plain.metadata
    uncertain = replace(old.uncertainty, names=names, covariance=np.diag(np.square(sizes)))
    cable = replace(plain, model=model, p=p, metadata=replace(old, uncertainty=uncertain))
    held = {"start": (0.0, 0.0), "start_heading": -0.4}
    points = cable.solve(**held).curve.at(S)
    tracker = cable.tracker(STD)
    found = tracker.update(dlo.Pose(points=points, at=S, **held))
    assert found.rms < 1e-7  # tolerance of equilibria
    assert tracker.cable.covariance.names == NAMES


def test_markers_beyond_the_cable_are_an_error_and_nothing_is_learned() -> None:
    tracker = rope().tracker(STD)
    wrong = dlo.Pose(
        points=[[0.1, 0.0], [0.5, -0.1]], at=[0.1, 0.9], start=(0, 0), start_heading=0.1
    )
    with pytest.raises(dlo.DloError, match=r"at: 0.9 m .*0.6 m"):
        tracker.update(wrong)
    assert repr(tracker).startswith("tracker after 0 poses: bending_stiffness 0.009 (std 0.002)")
