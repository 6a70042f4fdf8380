"""A cable that is estimated while it swings."""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np
import pytest
from scipy.optimize import least_squares

import dlo_casadi as dlo
from dlo_casadi.cable.tracked import known_of, with_known
from dlo_casadi.equilibrium.pose import HeldPose
from dlo_casadi.errors import MotionError
from dlo_casadi.estimation.motion_fit import MESH_ERROR
from dlo_casadi.estimation.motion_told import REPEATED
from dlo_casadi.motion.path import FixturePath
from dlo_casadi.tracking.tracker import Tracker

STD, S, LENGTH = 4e-4, np.linspace(0.05, 0.6, 8), 0.6
NAMES, VALUES, SIZES = ("bending_stiffness", "damping_time"), (0.009, 0.03), (4.5e-4, 6e-3)
T = np.arange(0.0, 1.3, 0.01)


def rope(stiffness: float = VALUES[0], damping: float = VALUES[1], n: int = 12) -> dlo.FittedCable:
    data = dlo.Cable(length=LENGTH, mass=0.06, diameter=0.008, bending_stiffness=stiffness)
    held = {"gravity": (0, -9.81), "boundary": ("clamped", "free")}
    return dlo.known_cable(data, **held, model={"n": n, "effects": []}).with_damping(damping)


def tracked(cable: dlo.FittedCable, **options: Any) -> Tracker:
    """A cable whose stiffness and damping are uncertain."""
    known = known_of(cable).with_unknowns(cable.model, {}, dict(zip(NAMES, SIZES, strict=True)))
    return with_known(cable, known).tracker(STD, **options)


def carried(t: np.ndarray) -> np.ndarray:
    """Places of a clamp that is carried aside by 0.2 m in 0.4 s."""
    share = np.clip((t - 0.05) / 0.4, 0.0, 1.0)
    x = 0.2 * share**3 * (10 - 15 * share + 6 * share**2)
    return np.stack([x, 0 * x], axis=1)


def held(t: float, points: np.ndarray | None = None) -> dlo.Pose:
    (start,) = carried(np.array([t]))
    at = None if points is None else S
    return dlo.Pose(start=tuple(start), start_heading=-0.8, points=points, at=at)


def swung(cable: dlo.FittedCable, t: np.ndarray = T) -> np.ndarray:
    motion = cable.simulate(t, start=carried(t), start_heading=-0.8, tolerance=1e-6)
    return np.asarray(motion.way.points(t, S))


@cache
def seen() -> tuple[np.ndarray, np.ndarray]:
    """Points of a true cable, on a finer mesh, and as they are measured."""
    points = swung(rope(0.0094, 0.026, 24))
    return points, points + STD * np.random.default_rng(0).normal(size=points.shape)


@cache
def followed() -> tuple[Tracker, list[dlo.Update], list[np.ndarray]]:
    """A tracker after a swing, what it was told, and errors of predictions in their std."""
    tracker, updates, off = tracked(rope()), [], []
    for k in range(0, 81, 2):
        updates.append(tracker.advance(float(T[k]), held(float(T[k]), seen()[1][k])))
        if k >= 40 and k % 10 == 0:
            later = T[k + 2 : k + 41 : 2]
            ahead = tracker.ahead(later, [held(float(t)) for t in later], at=S)
            off.append((seen()[0][k + 2 : k + 41 : 2] - ahead.points) / ahead.std)
    return tracker, updates, off


def test_it_equals_the_fit_of_the_whole_motion() -> None:
    """Nonlinear least squares by SciPy of `simulate`, with the prior and differences alone."""
    std = float(np.hypot(STD, MESH_ERROR * LENGTH))
    # The stiffness is Gaussian in its logarithm. In motion both are others than at rest.
    own = np.array([SIZES[0] / VALUES[0], SIZES[1]])
    loose = np.array([REPEATED["bending_stiffness"], REPEATED["damping_time"] * VALUES[1]])
    prior = np.hypot(own, loose)

    def residual(z: np.ndarray) -> np.ndarray:
        log, damping = prior * z
        points = swung(rope(VALUES[0] * np.exp(log), VALUES[1] + damping), T[:81])
        return np.concatenate([((points - seen()[1][:81])[::2] / std).ravel(), z])

    best = least_squares(residual, np.full(2, 0.5), diff_step=0.02, max_nfev=5)
    share = own**2 / prior**2
    mean = share * prior * best.x
    variance = own**2 * (1 - share)
    variance += (share * prior) ** 2 * np.diag(np.linalg.inv(best.jac.T @ best.jac))
    stiffness = VALUES[0] * np.exp(mean[0])
    values, scale = (stiffness, VALUES[1] + mean[1]), (stiffness, 1.0)
    for name, value, size in zip(NAMES, values, scale * np.sqrt(variance), strict=True):
        found = followed()[0].params[name]
        assert abs(found.value - value) < 0.1 * size
        assert found.std == pytest.approx(size, rel=0.05)


def test_innovations_are_white_and_predictions_within_their_std() -> None:
    _, updates, off = followed()
    whole = np.concatenate([one.innovation for one in updates])
    assert 0.9 < whole.std() < 1.1
    assert not any(one.refused for one in updates)
    assert [one.number for one in updates] == list(range(1, 42))
    assert 0.3 < np.sqrt(np.mean(np.square(off))) < 1.3


def test_a_cable_that_moves_already_is_caught() -> None:
    points, noisy = seen()
    tracker = tracked(rope())
    for k in range(50, 101, 2):
        update = tracker.advance(float(T[k]), held(float(T[k]), noisy[k]), begins="moving")
        assert update.innovation.size == (0 if k <= 66 else 16)
        assert not update.refused
    ahead = tracker.ahead(T[120], [held(float(T[120]))], at=S)
    off = (points[120] - ahead.points[0]) / ahead.std[0]
    assert np.sqrt(np.mean(np.square(off))) < 2
    assert ahead.std.max() < 4e-3


def test_a_point_that_is_seen_wrong_changes_nothing() -> None:
    tracker = tracked(rope())
    for k in range(0, 40, 4):
        tracker.advance(float(T[k]), held(float(T[k]), seen()[1][k]))
    before, wrong = tracker.params["bending_stiffness"], seen()[1][40].copy()
    wrong[3:6] += 0.03
    assert tracker.advance(0.4, held(0.4, wrong)).refused
    assert tracker.params["bending_stiffness"] == before


def test_a_cable_that_was_touched_is_caught_again() -> None:
    """As if it had moved on by 0.3 s within an instant."""
    tracker, refused = tracked(rope()), []
    for k in range(46, 100, 2):
        later = k + 30 * (k >= 80)
        pose = held(float(T[later]), seen()[1][later])
        update = tracker.advance(float(T[k]), pose, begins="moving")
        refused.append(update.refused)
        assert update.number == len(refused)
    assert np.flatnonzero(refused).tolist() == [17, 18, 19]
    ahead = tracker.ahead(0.99, at=S)
    assert np.abs(seen()[0][129] - ahead.points[0]).max() < 2e-3


def test_it_goes_on_at_rest_with_what_motion_told() -> None:
    tracker = tracked(rope())
    for k in range(0, 60, 4):
        tracker.advance(float(T[k]), held(float(T[k]), seen()[1][k]))
    told = tracker.params["bending_stiffness"].std
    assert told < 0.3 * SIZES[0]
    pose = held(2.0, rope(0.0094).solve(start=(0.2, 0.0), start_heading=-0.8).curve.at(S))
    assert not tracker.update(pose).refused
    assert tracker.params["bending_stiffness"].std < told
    with pytest.raises(dlo.DloError, match="no motion has begun"):
        tracker.ahead(3.0)
    tracker.advance(0.0, held(2.0))  # another motion


def test_what_is_known_fades_and_walks() -> None:
    tracker = tracked(rope(), forget=0.9, drift={"damping_time": 1e-3})
    for k in range(0, 20, 4):
        tracker.advance(float(T[k]), held(float(T[k])))
    faded = 0.9**-4
    assert tracker.params["bending_stiffness"].std == pytest.approx(SIZES[0] * np.sqrt(faded))
    walked = sum(1e-6 * 0.9**-k for k in range(4))
    size = np.sqrt(SIZES[1] ** 2 * faded + walked)
    assert tracker.params["damping_time"].std == pytest.approx(size)


def test_a_way_that_goes_on_row_by_row_has_no_jumps_of_velocity() -> None:
    pose, t = HeldPose(start=(0.0, 0.0), start_heading=-0.8), np.append(T[:20], T[20:60:4])
    rows = {"start": carried(t)}
    for k in range(4, len(t)):
        before, after = (
            FixturePath.of_last(pose, t[:j], {"start": rows["start"][:j]}) for j in (k, k + 1)
        )
        for path in (before, after):
            assert path.moving["start"](t[k - 1]) == pytest.approx(rows["start"][k - 1])
        here = t[k - 1 : k]
        assert before.rates(here, 1) == pytest.approx(after.rates(here, 1), abs=1e-12)
        true = np.gradient(carried(here + 1e-4 * np.arange(-1, 2)), 1e-4, axis=0)[1]
        assert np.abs(before.rates(here, 1)[0, 0] - true).max() < 0.05  # m/s, of 0.94


def test_space_is_as_the_plane() -> None:
    """The same swing in a vertical plane of space."""
    data = dlo.Cable(
        length=LENGTH, mass=0.06, diameter=0.008, bending_stiffness=0.009, torsional_stiffness=0.007
    )
    given = {"gravity": (0, 0, -9.81), "boundary": ("clamped", "free")}
    cable = dlo.known_cable(data, **given, model={"n": 12, "effects": []}).with_damping(0.03)
    own, flat = tracked(cable), tracked(rope())
    turned = (0.0, float(np.sin(0.4)), 0.0, float(np.cos(0.4)))  # down by 0.8 rad
    for k in range(0, 30, 6):
        t = float(T[k])
        here, points = carried(np.array([t]))[0], seen()[1][k]
        lifted = np.stack([points[:, 0], 0 * points[:, 0], points[:, 1]], axis=1)
        start = (here[0], 0.0, here[1])
        pose = dlo.Pose(start=start, start_orientation=turned, points=lifted, at=S)
        updates = own.advance(t, pose), flat.advance(t, held(t, points))
        assert not any(one.refused for one in updates)
    for name in NAMES:
        one, other = own.params[name], flat.params[name]
        assert abs(one.value - other.value) < 0.1 * other.std
        assert one.std == pytest.approx(other.std, rel=0.01)


def test_errors_tell_numbers_and_what_to_try() -> None:
    tracker = tracked(rope())
    tracker.advance(0.0, held(0.0))
    known = tracker.params["bending_stiffness"]
    with pytest.raises(dlo.DloError, match=r"-0\.1 s is not later than 0 s"):
        tracker.advance(-0.1, held(0.0))
    with pytest.raises(dlo.DloError, match="start_heading"):
        tracker.advance(0.1, dlo.Pose(start=(0, 0)))
    with pytest.raises(dlo.DloError, match="readings"):
        tracker.advance(0.1, dlo.Pose(start=(0, 0), start_heading=0.0, start_force=(0, 1)))
    with pytest.raises(dlo.DloError, match="1 times, found 2"):
        tracker.ahead(0.2, [held(0.2), held(0.3)])
    with pytest.raises(dlo.DloError, match=r"0 to 0\.6 m"):
        tracker.ahead(0.2, at=[0.7])
    with pytest.raises(dlo.DloError, match="numbers belong here"):
        tracker.ahead("soon")
    with pytest.raises(MotionError, match="Try: fixtures that stay"):
        tracker.advance(1e-3, dlo.Pose(start=(80.0, 0.0), start_heading=-0.8))
    assert tracker.params["bending_stiffness"] == known
    tracker.advance(0.02, held(0.02))
    with pytest.raises(dlo.DloError, match="from markers"):
        tracked(rope()).advance(0.0, held(0.0), begins="moving")


def test_ends_out_of_reach_are_refused() -> None:
    data = dlo.Cable(length=LENGTH, mass=0.06, diameter=0.008, bending_stiffness=0.009)
    given = {"gravity": (0, -9.81), "boundary": ("pinned", "pinned")}
    cable = dlo.known_cable(data, **given, model={"n": 8, "effects": []}).with_damping(0.03)
    tracker = tracked(cable)
    tracker.advance(0.0, dlo.Pose(start=(0, 0), end=(0.4, 0)))
    with pytest.raises(MotionError, match=r"held 0\.7 m apart; .* is 0\.6 m long"):
        tracker.advance(0.1, dlo.Pose(start=(0, 0), end=(0.7, 0)))
    with pytest.raises(dlo.DloError, match="where is it"):
        tracker.advance(0.1, dlo.Pose(start=(0, 0)))
