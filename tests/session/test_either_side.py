"""Cables in space with an end clamp rolled by nearly half a turn: twisted which way round."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import brentq
from scipy.spatial.transform import Rotation

import dlo_casadi as dlo
from dlo_casadi.config import dump_yaml
from dlo_casadi.effects import CableData
from dlo_casadi.equilibrium.pose import HeldPose
from dlo_casadi.equilibrium.solve import solve_equilibria, solve_equilibrium
from dlo_casadi.equilibrium.spread import Repeats, SolvedCable, Uncertainty, tipping
from dlo_casadi.estimation.prediction import predict_poses
from dlo_casadi.model.cable_model import CableModel
from dlo_casadi.model.pose_scatter import PoseScatter
from dlo_casadi.report.sections import report_dict
from dlo_casadi.session.pose_shape import BranchShape
from dlo_casadi.session.remarks import doubts_of

CABLE = CableData(0.9, 0.1, 0.01, bending_stiffness=0.04, torsional_stiffness=0.03, straight=True)
HELD = {"start": "clamped", "end": "clamped", "gravity": (0.0, 0.0, -9.81)}
# What is measured is drawn on the mesh of the fit.
MODEL = CableModel(CABLE, 8, "quadratic", **HELD)
P, REST = MODEL.nominal, np.zeros(MODEL.chain.n_rests)
AHEAD = (0.0, 0.0, 0.0, 1.0)
NOISE = 5e-4
# By name: roll of the end clamp [rad], the way round in which the cable hangs, and its role.
POSES = {
    "high": (3.0, -0.5, "fit"),
    "higher": (3.6, 0.5, "fit"),
    "low": (2.6, 0.5, "fit"),
    "a": (0.3, 0.0, "fit"),
    "b": (-1.2, 0.0, "fit"),
    "even": (None, 0.5, "held_out"),
    "usual": (2.5, 0.5, "held_out"),
    "other": (3.5, 0.5, "held_out"),
}
# Of the session that is fitted.
FITTED = ("high", "higher", "a", "even", "usual", "other")


def ways(pose):
    """Equilibria of a pose that is twisted either way round: counter-clockwise first."""
    return solve_equilibria(MODEL, P, REST, [replace(pose, turns=turns) for turns in (0.5, -0.5)])


def clamped(place, bend, roll):
    end = Rotation.from_rotvec([0.0, *bend]) * Rotation.from_rotvec([roll, 0.0, 0.0])
    return HeldPose((0.0,) * 3, tuple(place), None, None, AHEAD, tuple(end.as_quat()))


def evenly(place, bend):
    """Roll [rad] of the end clamp at which both ways round are equally low."""

    def excess(roll):
        first, second = ways(clamped(place, bend, roll))
        return first.energy - second.energy

    return brentq(excess, 2.6, 3.8, xtol=1e-3)


def drawn(poses):
    """Poses that do not tell their turns, and their markers (K, 3) [m] at arc lengths (K,) [m]."""
    rng, s = np.random.default_rng(0), np.linspace(0.02, 0.98, 12) * CABLE.length
    for name, (roll, turns, _) in poses.items():
        bend = rng.uniform(-0.3, 0.3, 2)
        place = rng.uniform([0.7, -0.1, -0.1], [0.8, 0.1, 0.1]) * CABLE.length
        pose = clamped(place, bend, evenly(place, bend) if roll is None else roll)
        (shape,) = predict_poses(MODEL, P, REST, [replace(pose, turns=turns)])
        points = shape.curve.at(s) + rng.normal(scale=NOISE, size=(len(s), 3))
        yield replace(pose, name=name), s, points


def session(folder):
    """A configuration of the poses, and the files of their markers."""
    rows = []
    for pose, s, points in drawn(POSES):
        if pose.name not in FITTED:
            continue
        table, header = np.column_stack([s, points]), "s_m,x_m,y_m,z_m"
        np.savetxt(folder / f"{pose.name}.csv", table, "%.7f", ",", header=header, comments="")
        rows.append(
            {
                "file": f"{pose.name}.csv",
                "start": [0, 0, 0],
                "start_orientation": list(AHEAD),
                "end": [float(x) for x in pose.end],
                "end_orientation": [float(x) for x in pose.end_orientation],
                "role": POSES[pose.name][2],
            }
        )
    cable = {"length": 0.9, "mass": 0.1, "diameter": 0.01, "bending_stiffness": 0.05}
    data = {
        "cable": {**cable, "rest_shape": "straight"},
        "experiment": {
            "gravity": [0, 0, -9.81],
            "boundary": {"start": "clamped", "end": "clamped"},
            "measurement": {"kind": "centerlines", "std": NOISE},
            "poses": rows,
        },
        "model": {"n": 8},
    }
    (folder / "session.yaml").write_text(dump_yaml(data))
    return folder / "session.yaml"


@pytest.fixture(scope="module")
def result(tmp_path_factory):
    return dlo.fit(session(tmp_path_factory.mktemp("session")), diagnosis=False)


def test_fit_poses_are_compared_the_way_round_in_which_they_hang(result):
    stage, report = result.stages[-1], report_dict(result)["stages"][-1]
    # Three coordinates of a marker, and fixtures that move it by about as much as the noise.
    assert stage.rmse_fit < 2 * np.sqrt(3) * NOISE
    assert stage.rmse_fit_measured_branch == stage.rmse_fit
    turned = {name: side["turns"] for name, side in report["measured_side"].items()}
    assert turned == {"high": -0.5, "higher": 0.5}
    said = [text for text in result.warnings if "is in another equilibrium" in text]
    assert [text.partition(": ")[2].partition(":")[0] for text in said] == ["high", "higher"]
    assert said[0].endswith("needs `turns: -0.5`")


def test_held_out_poses_are_told_as_a_choice_of_turns(result):
    stage, report = result.stages[-1], report_dict(result)
    assert stage.rmse_held_out > 0.05  # the lowest energy is predicted, whatever was measured
    assert stage.rmse_held_out_measured_branch < 2 * np.sqrt(3) * NOISE
    assert result.doubts == ()
    assert set(report["either_side"]) == {"even", "other"}  # and nothing of the usual one

    other, even = (report["either_side"][name] for name in ("other", "even"))
    assert (other["predicted"]["turns"], other["other"]["turns"]) == (-0.5, 0.5)
    assert other["predicted"]["rmse"] == stage.shapes["other"].rmse > 0.05
    assert other["other"]["rmse"] < 2 * np.sqrt(3) * NOISE
    near, far = even["tipping"], other["tipping"]
    assert near["angle"] < 2 * near["std"] < 0.1 < far["angle"]
    assert {even[side]["turns"] for side in ("predicted", "other")} == {0.5, -0.5}
    assert min(even[side]["rmse"] for side in ("predicted", "other")) < 2 * np.sqrt(3) * NOISE

    (line,) = [text for text in str(result).splitlines() if "other (held out)" in text]
    assert f"`turns: -0.5` (predicted) {1e3 * other['predicted']['rmse']:.3g} mm off" in line
    assert f"`turns: 0.5` {1e3 * other['other']['rmse']:.3g} mm off" in line
    assert not any("not the one that was measured" in text for text in result.warnings)


def test_an_error_that_neither_way_round_explains_is_a_doubt(result):
    stage = result.stages[-1]
    shape, far = stage.shapes["other"], BranchShape(0.07, None, 0.5)
    either = replace(shape.either_side, other=far)
    moved = replace(shape, measured_branch=far, either_side=either)
    stage = replace(stage, shapes=stage.shapes | {"other": moved})
    (doubt,) = doubts_of([stage], result.poses, result.fit)
    assert "held-out poses are predicted" in doubt
    assert "other, at worst 70 mm instead of" in doubt


EVEN = ((0.66, 0.05, -0.04), (0.1, -0.2))


@pytest.fixture(scope="module")
def even():
    return evenly(*EVEN)


@pytest.mark.parametrize("beyond", [-0.6, -0.05, 0.05, 0.3])
def test_both_ways_round_are_found_together(even, beyond):
    pose = clamped(*EVEN, even + beyond)
    lowest, turned = solve_equilibrium(MODEL, P, REST, pose), ways(pose)
    first, second = turned if beyond < 0 else turned[::-1]
    assert lowest.energy == pytest.approx(first.energy, rel=1e-9)
    assert lowest.other_side.energy == pytest.approx(second.energy, rel=1e-9)
    assert [eq.other_side for eq in turned] == [None, None]  # they are told
    # The moment on the clamp is the slope of the energy; `even` is found to 1e-3.
    angle = tipping(MODEL, lowest, lowest.other_side)
    assert angle == pytest.approx(abs(beyond), abs=1e-3 + 0.1 * beyond**2)


def test_how_well_the_angle_is_known_follows_from_what_is_uncertain(even):
    pose = clamped(*EVEN, even - 0.05)
    lowest = solve_equilibrium(MODEL, P, REST, pose)
    pair = lowest, lowest.other_side

    def near(variances=None, scatter=None):
        names = tuple(variances or {})
        covariance = np.diag([(variances or {})[name] for name in names])
        uncertainty = Uncertainty(names, covariance, scatter or {}, PoseScatter())
        return Repeats(SolvedCable(MODEL, P, REST, pose, pair[0]), uncertainty).tipping(pair[1])

    rolled = near({"end_roll": 0.03**2}, {"end_rotation_x": 0.04})
    assert rolled.std == pytest.approx(0.05, rel=1e-6)
    assert rolled.either
    assert not near({"end_roll": 0.01**2}).either
    # Of the stiffness, by equilibria at two of them.
    std, k = 2e-4, MODEL.names.index("bending_stiffness")
    moved = []
    for sign in (-1, 1):
        p = P.copy()
        p[k] += sign * std
        turned = [replace(pose, turns=turns) for turns in (0.5, -0.5)]
        first, second = solve_equilibria(MODEL, p, REST, turned)
        moved.append(first.energy - second.energy)
    angle = near()
    slope = abs(pair[0].energy - pair[1].energy) / angle.angle
    assert angle.std == 0
    expected = abs(moved[1] - moved[0]) / 2 / slope
    assert near({"bending_stiffness": std**2}).std == pytest.approx(expected, rel=1e-3)
