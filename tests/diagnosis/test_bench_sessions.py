"""Whole sessions against the truth that an independent simulator put into them.

Declared models of the others: tests/session/test_truth.py; scripts/check_bench.py does all.
"""

from __future__ import annotations

import numpy as np
import pytest


def stage(report, name):
    return next(item for item in report["stages"] if item["name"] == name)


def effect(report, name):
    return next(item for item in report["effects"] if item["name"] == name)


@pytest.mark.parametrize(
    "name", ["short_clean", pytest.param("weightless_fit", marks=pytest.mark.long)]
)
def test_a_complete_model_gets_no_effect(report, name):
    found = report(name)
    assert found["verdict"] == "complete"
    assert found["effects"] == []


def test_clean_session_stiffness_and_prediction(report, truth):
    found = report("short_clean")
    batch = stage(found, "batch")
    stiffness = batch["parameters"]["bending_stiffness"]
    low, high = stiffness["interval_95"]
    assert low < truth("short_clean")["bending_stiffness"] < high
    assert stiffness["identifiable"] is True
    assert batch["rmse_held_out"] <= 1.3 * found["measurement"]["std"]
    assert batch["rmse_held_out"] < 0.2 * stage(found, "algorithm1")["rmse_held_out"]


@pytest.mark.long
def test_a_stiffness_that_gravity_cannot_show_is_called_so(report):
    """77 N m^2 moves the cable by hundredths of a millimetre, at 0.3 mm of noise."""
    batch = stage(report("weightless_fit"), "batch")
    assert batch["parameters"]["bending_stiffness"]["identifiable"] is False
    assert batch["rmse_held_out"] <= 0.4e-3


@pytest.mark.parametrize(
    ("session", "name", "parameter", "true"),
    [
        pytest.param(
            "overhang", "bending_softening", "curvature_scale", 6.0, marks=pytest.mark.long
        ),
        pytest.param("connector", "lumped_mass", "mass", 0.07, marks=pytest.mark.long),
        pytest.param("connector", "lumped_mass", "position", 0.52, marks=pytest.mark.long),
    ],
)
def test_an_undeclared_effect_is_found_and_the_error_falls(report, session, name, parameter, true):
    found = report(session)
    assert found["verdict"] == "effect_found"
    assert found["effects"][0]["name"] == name
    estimate = effect(found, name)["parameters"][parameter]
    assert abs(estimate["value"] - true) <= 3 * estimate["std"]
    assert estimate["value"] == pytest.approx(true, rel=0.25)
    row = effect(found, name)
    assert row["rmse_cross_validated_after"] < row["rmse_cross_validated_before"]
    before, after = stage(found, "batch"), stage(found, "closed")
    assert after["rmse_fit"] < before["rmse_fit"]
    limit = 1.3 if found["measurement"]["kind"] == "images" else 1.15
    assert after["rmse_held_out"] <= limit * found["measurement"]["std"]


@pytest.mark.long
def test_a_model_that_lacks_an_effect_is_told_without_intervals(report):
    batch = stage(report("overhang"), "batch")
    stiffness = batch["parameters"]["bending_stiffness"]
    assert batch["explains"] is False
    assert stiffness["value"] > 0
    assert stiffness["interval_95"] is None


@pytest.mark.long
def test_every_stage_is_in_the_report_of_photographs(report):
    found = report("connector")
    names = [item["name"] for item in found["stages"]]
    assert names == ["initial", "stiffness_only", "algorithm1", "batch", "closed"]
    assert found["measurement"]["std_source"] == "estimated"
    timed = found["timing_s"]
    assert all(np.isfinite(value) for key, value in timed.items() if key != "parts")
    assert {"declared model", "diagnosis"} <= {part["name"] for part in timed["parts"]}
