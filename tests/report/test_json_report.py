"""report.json holds every key of its schema, and no number that JSON does not know."""

import json
import math
from dataclasses import replace

import numpy as np
import pytest
from small_sessions import context

from dlo_casadi.cable.estimate import Estimate
from dlo_casadi.equilibrium.spread import Tipping
from dlo_casadi.io.files import finite
from dlo_casadi.report.findings import verdict_lines
from dlo_casadi.report.sections import report_dict, report_text
from dlo_casadi.report.words import all_warnings
from dlo_casadi.session.outcome import RestCurvatureEstimate, Stage
from dlo_casadi.session.pose_shape import BranchShape, EitherSide

KEYS = {
    "schema": str,
    "config": str,
    "config_path": str,
    "versions": dict,
    "warnings": list,
    "timing_s": dict,
    "measurement": dict,
    "stages": list,
    "repeatability": dict,
    "discretization": dict,
    "effects": list,
    "candidates": list,
    "verdict": type(None),  # the diagnosis is switched off
    "either_side": dict,
    "unexplained": type(None),
    "next_pose": type(None),
    "next_motion": type(None),
    "structure": type(None),
    "if_hidden": dict,
    "limits": list,
    "motion_scores": dict,
    "modes": list,
}


def strict(text):
    """JSON without the extensions NaN and Infinity."""

    def refuse(constant):
        raise AssertionError(f"{constant} is not JSON")

    return json.loads(text, parse_constant=refuse)


def stage(name, value=math.nan, **changes):
    rest = RestCurvatureEstimate(np.array([0.0, 1.0]), np.array([1.0, math.nan]), np.zeros(2))
    estimate = Estimate(value, math.inf, "N m^2", (None, 3.0), False)
    full = Stage(name, 1e-3, math.inf, None, {"bending_stiffness": estimate}, rest, {})
    return replace(full, **changes)


def test_every_key_of_the_schema_is_there(outcome):
    report = strict(report_text(outcome))

    assert {key: type(value) for key, value in report.items()} == KEYS
    assert report["schema"] == "dlo-report/1"
    timed = {"vision", "algorithm1", "batch", "diagnosis", "motion", "total", "parts"}
    assert set(report["timing_s"]) == timed
    assert [set(part) for part in report["timing_s"]["parts"]] == [
        {"name", "calls", "steps", "seconds", "parts"} for _ in outcome.work.parts
    ]
    assert set(report["measurement"]) == {
        "kind",
        "poses_fit",
        "poses_held_out",
        "held_out_missing",
        "points",
        "std",
        "std_source",
        "correlation_length_m",
        "readings",
        "force_std",
        "moment_std",
    }
    assert set(report["discretization"]) == {"n", "element", "error_m"}
    names = ["initial", "stiffness_only", "algorithm1", "batch"]
    assert [entry["name"] for entry in report["stages"]] == names
    for entry in report["stages"]:
        assert set(entry) == {
            "name",
            "explains",
            "rmse_fit",
            "rmse_held_out",
            "force_rmse_fit",
            "force_rmse_held_out",
            "moment_rmse_fit",
            "moment_rmse_held_out",
            "readings",
            "clips",
            "contacts",
            "fed",
            "rmse_fit_measured_branch",
            "rmse_held_out_measured_branch",
            "other_branch",
            "measured_side",
            "held_out",
            "chi2_per_dof",
            "parameters",
        }
        stiffness = entry["parameters"]["bending_stiffness"]
        assert {"value", "std", "interval_95", "identifiable"} <= set(stiffness)
        assert set(entry["parameters"]["rest_curvature"]) == {"s", "value", "std"}


def test_the_numbers_are_those_of_the_outcome(outcome):
    report = strict(report_text(outcome))
    batch, found = report["stages"][-1], outcome.stage("batch")

    assert batch["rmse_held_out"] == found.rmse_held_out
    assert batch["parameters"]["bending_stiffness"]["value"] == outcome.fit.p[0]
    low, high = batch["parameters"]["bending_stiffness"]["interval_95"]
    assert low < outcome.fit.p[0] < high
    assert batch["parameters"]["rest_curvature"]["value"] == found.rest_curvature.value.tolist()


def test_a_pose_on_another_branch_is_there_with_both_errors(outcome):
    batch = outcome.stage("batch")
    name, shape = next(iter(batch.shapes.items()))
    shapes = batch.shapes | {name: replace(shape, measured_branch=BranchShape(1e-4, "cw"))}
    found = replace(outcome, stages=(*outcome.stages[:-1], replace(batch, shapes=shapes)))

    entry = report_dict(found)["stages"][-1]
    row = {"rmse": shape.rmse, "rmse_measured_branch": 1e-4, "branch": "cw", "turns": None}
    assert entry["other_branch"] == {name: row}
    assert entry["held_out"] == {"predicted": 3, "declared": 3, "missing": []}


def test_a_held_out_pose_on_either_side_stands_beside_the_verdict(outcome):
    batch = outcome.stage("batch")
    sides = BranchShape(0.054, None, 0.5), BranchShape(0.0031, None, -0.5)
    either = EitherSide(*sides, Tipping(0.03, 0.02))
    usual = EitherSide(sides[1], sides[0], Tipping(0.3, 0.02))  # known to be the lower one
    arcs = EitherSide(
        BranchShape(0.02, None), sides[1], None
    )  # no roll leads from one to the other
    names = [pose.name for pose in outcome.poses if pose.role == "held_out"][:3]
    shapes = {
        name: replace(batch.shapes[name], either_side=found)
        for name, found in zip(names, (either, usual, arcs), strict=True)
    }
    found = replace(batch, shapes=batch.shapes | shapes)
    found = replace(outcome, stages=(*outcome.stages[:-1], found))

    row = {
        "predicted": {"rmse": 0.054, "branch": None, "turns": 0.5, "above": 0.0},
        "other": {"rmse": 0.0031, "branch": None, "turns": -0.5, "above": 0.0},
        "tipping": {"angle": 0.03, "std": 0.02},
    }
    assert report_dict(found)["either_side"][names[0]] == row
    assert list(report_dict(found)["either_side"]) == [names[0], names[2]]
    assert report_dict(outcome)["either_side"] == {}
    text = (
        f"{names[0]} (held out): its clamp is 0.03 rad (known to 0.02 rad) from the angle at which "
        "both ways to hang are equally low; `turns: 0.5` (predicted) 54 mm off, `turns: -0.5` "
        "3.1 mm off."
    )
    said = verdict_lines(found)
    other = f"{names[2]} (held out): `turns: 0` (predicted) 20 mm off, `turns: -0.5` 3.1 mm off."
    assert [line.strip() for line in said if "held out" in line] == [text, other]
    assert text in context("verdict", found)["details"]
    assert not any("turns" in line for line in all_warnings(found))


def test_a_baseline_that_did_not_run_is_null_without_a_warning(outcome):
    report = report_dict(outcome)
    algorithm1 = report["stages"][2]

    assert algorithm1["rmse_fit"] is None
    assert algorithm1["rmse_held_out"] is None
    assert algorithm1["parameters"]["bending_stiffness"]["value"] is None
    assert algorithm1["parameters"]["rest_curvature"] == {"s": [], "value": [], "std": []}
    assert not any("algorithm1" in said for said in report["warnings"])


def test_the_closed_stage_is_there_only_with_an_effect(outcome):
    closed = replace(outcome, stages=(*outcome.stages, stage("closed")))

    assert report_dict(closed)["stages"][-1]["name"] == "closed"
    assert report_dict(outcome)["stages"][-1]["name"] == "batch"


def test_nan_and_infinity_become_null(outcome):
    report = strict(report_text(replace(outcome, stages=(stage("batch"),))))
    batch = report["stages"][-1]

    assert batch["rmse_held_out"] is None
    assert batch["parameters"]["bending_stiffness"]["value"] is None
    assert batch["parameters"]["bending_stiffness"]["std"] is None
    assert batch["parameters"]["bending_stiffness"]["interval_95"] == [None, 3.0]
    assert batch["parameters"]["rest_curvature"]["value"] == [1.0, None]


@pytest.mark.parametrize(
    ("value", "plain"),
    [
        (np.float64(2.5), 2.5),
        (np.float64("nan"), None),
        (np.int64(3), 3),
        (np.bool_(True), True),
        (np.array([[1.0, np.inf]]), [[1.0, None]]),
        ((1, "a", None), [1, "a", None]),
    ],
)
def test_numpy_becomes_plain(value, plain):
    assert finite(value) == plain
    assert type(finite(value)) is type(plain)


def test_a_parameter_on_its_bound_is_a_warning(outcome):
    estimate = Estimate(0.0, 0.1, "kg", at_bound=True)
    last = replace(outcome.stage("batch"), parameters={"lumped_mass.mass": estimate})

    lines = all_warnings(replace(outcome, stages=(*outcome.stages[:-1], last)))
    assert "lumped_mass.mass sits on a bound of what physics permits: 0 kg" in lines
