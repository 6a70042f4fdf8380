"""Numbers and sentences of the tables, against the outcome that they are of."""

import re
from dataclasses import replace

import numpy as np
import pytest
from test_figures import EFFECT, pull

from dlo_casadi.cable.estimate import Estimate
from dlo_casadi.diagnosis.next_measurement import MOST_REPEATS, NextReading
from dlo_casadi.diagnosis.structure import Structure
from dlo_casadi.estimation.result import Fit
from dlo_casadi.report.documents import check_dict
from dlo_casadi.report.findings import RESIDUAL, conclusion_of, details, reading_text
from dlo_casadi.report.tables import (
    footnotes,
    nuisance_rows,
    rest_rows,
    summary_text,
    timing_rows,
    work_rows,
)
from dlo_casadi.report.words import all_warnings
from dlo_casadi.rod.supports import SupportKind
from dlo_casadi.runtime.work import Part
from dlo_casadi.session.sentences import said_of

WEIGHT = 0.2 * 9.81  # N, of short_clean
NOISE = Structure(12.0, 9, 0.2, 1.3, -0.5, order_z=1.0, span_z=0.3, position_z=0.2, per_pose={})


def with_last(outcome, **changes):
    return replace(outcome, stages=(*outcome.stages[:-1], replace(outcome.stages[-1], **changes)))


def test_footnotes_tell_the_ratio_and_the_reading_that_would_tell_more(outcome):
    stage, text = outcome.stages[-1], " ".join(footnotes(outcome))
    stiffness = stage.parameters["bending_stiffness"].value
    ratio = float(re.search(r"EI over weight is (\S+) m\^2", text)[1])
    assert ratio == pytest.approx(stiffness / WEIGHT, rel=1e-3)
    told = re.search(r"of (\w+)_force in (\w+), about (\S+) N.* below (\S+) N", text).groups()
    sizes = {
        (side, name): np.linalg.norm(force)
        for name, shape in stage.shapes.items()
        for side, force in zip(("start", "end"), shape.forces, strict=True)
    }
    assert sizes[told[:2]] == max(sizes.values())
    assert float(told[2]) == pytest.approx(max(sizes.values()), rel=5e-3)
    assert float(told[3]) == pytest.approx(0.01 * max(sizes.values()), rel=5e-2)


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("mass", "The readings do not tell mass from EI"),
        ("torsional_stiffness", "GJ is not identifiable: only ends that both hold the roll"),
    ],
)
def test_what_cannot_be_told_apart_has_its_footnote(outcome, name, said):
    known = outcome.stages[-1].parameters
    for identifiable in (False, True):
        added = {name: Estimate(0.2, 0.1, "kg", identifiable=identifiable)}
        text = " ".join(footnotes(with_last(outcome, parameters=known | added)))
        assert (said in text) != identifiable


def test_a_nuisance_is_told_in_its_tolerances(outcome):
    rows = {name: (value, remark) for name, value, _, remark in nuisance_rows(outcome)}
    moved = outcome.fit.value("end_offset.dx") / 2e-4
    assert abs(moved) > 0.1
    value, remark = rows["end_offset.dx"]
    assert remark == f"{moved:+.1f} of its tolerance 0.0002 m"
    assert float(value.split()[0]) == pytest.approx(outcome.fit.value("end_offset.dx"), abs=6e-6)


def test_the_rest_curvature_has_its_range_and_its_mean_std(outcome):
    rest = outcome.stages[-1].rest_curvature
    ((_, value, _, remark),) = rest_rows(outcome)
    assert value == f"{rest.value.min():.3g} to {rest.value.max():.3g} 1/m"
    assert remark == f"std {np.mean(rest.std):.2g} 1/m on average"


def test_parts_of_the_time_add_up(outcome):
    spent = {"vision": 1.0, "algorithm1": 2.0, "batch": 4.0, "diagnosis": 8.0, "total": 20.0}
    work = Part(1, 50, 19.0, {"diagnosis": Part(1, 30, 8.0, {"fits": Part(4, 30, 7.0)})})
    told = replace(outcome, timing=spent, work=work)
    rows = {name: float(seconds) for name, seconds, _ in timing_rows(told)}
    remarks = {name: remark for name, _, remark in timing_rows(told)}
    assert (remarks["fits and predictions"], remarks["diagnosis"]) == ("20 steps", "30 steps")
    assert work_rows(told) == [
        ("diagnosis", "1", "30", "8.00"),
        ("  fits", "4", "30", "7.00"),
    ]
    assert rows == {
        "reading the lines": 1.0,
        "fits and predictions": 11.0,
        "diagnosis": 8.0,
        "total": 20.0,
    }


def test_strong_correlations_of_what_is_shown_are_listed(outcome, monkeypatch):
    names, covariance = outcome.fit.named_covariance
    covariance = np.diag(np.diag(covariance))
    size = np.sqrt(np.diag(covariance))
    for other, correlation in (("end_offset.dx", -0.95), ("end_offset.dy", 0.85)):
        i, j = names.index("bending_stiffness"), names.index(other)
        covariance[i, j] = covariance[j, i] = correlation * size[i] * size[j]
    monkeypatch.setattr(Fit, "named_covariance", property(lambda _: (names, covariance)))
    listed = summary_text(outcome).split("Correlations beyond 0.9\n")[1].splitlines()
    assert listed == ["  end_offset.dx, bending_stiffness: -0.95"]


def test_a_stage_that_lost_poses_is_a_warning(outcome):
    assert not any("could not be predicted" in line for line in all_warnings(outcome))
    for error in ("rmse_fit", "rmse_held_out"):
        lost = all_warnings(with_last(outcome, **{error: None}))
        assert "declared model, fitted: some poses could not be predicted" in lost
    lost = all_warnings(with_last(outcome, rmse_fit=None, note="no root"))
    assert "declared model, fitted: no root" in lost


def test_nothing_lifts_a_free_tip(outcome):
    boundary = outcome.config.experiment.boundary.changed(end=SupportKind.FREE)
    free = outcome.config.changed(experiment={"boundary": {"end": SupportKind.FREE}})
    assert free.experiment.boundary == boundary
    for force, config, told in (
        ((0.0, 1.0), free, True),
        ((0.0, -1.0), free, False),
        ((0.0, 1.0), outcome.config, False),
    ):
        found = replace(outcome, config=config, unexplained=pull(force))
        assert any("Nothing lifts a cable with a free tip" in x for x in details(found)) == told


@pytest.mark.parametrize(
    ("times", "said"),
    [
        (1, "one suffices."),
        (MOST_REPEATS, f"read it {MOST_REPEATS} times."),
        (MOST_REPEATS + 1, "it would not tell them apart."),
        (None, "it would not tell them apart."),
    ],
)
def test_a_reading_says_how_often_it_is_read(times, said):
    assert reading_text(NextReading("end_moment", 0.3, 4.0, times)).endswith(said)


def test_a_fit_that_predicts_no_pose_that_is_left_out_is_no_misfit(outcome):
    found = replace(outcome, verdict="unexplained", effects=(EFFECT,), structure=(NOISE, NOISE))
    said = conclusion_of(found).sentence
    assert said.startswith("With lumped_mass every pose is fitted, but one that is left out is")
    assert "predicted 0.1 mm off" in said  # the cross-validated error of the effect
    worse = replace(NOISE, p_value=1e-9)
    said = conclusion_of(replace(found, structure=(NOISE, worse))).sentence
    assert said == "The residual is not noise even with lumped_mass."


def test_scores_of_noise_are_not_told(outcome):
    found = replace(outcome, verdict="unexplained", structure=(NOISE, NOISE))
    assert said_of(found, [RESIDUAL]) == []
    found = replace(found, structure=(replace(NOISE, runs_z=9.0), NOISE))
    (line,) = said_of(found, [RESIDUAL])
    assert line.strip() == (
        "The declared model's residual changes its sign along the cable more often than noise "
        "(z = +9.0)."
    )


def test_a_check_tells_lengths_and_the_larger_distance_from_a_fixture(outcome):
    declared = {pose.name: pose for pose in outcome.config.experiment.poses}
    rows = check_dict(outcome.config, outcome.poses, [])["poses"]
    for row, pose in zip(rows, outcome.poses, strict=True):
        held = declared[pose.name]
        length = np.linalg.norm(np.diff(pose.points, axis=0), axis=1).sum()
        assert row["length"] == pytest.approx(length)
        assert row["length_over_declared"] == pytest.approx(length / 0.55)
        away = np.linalg.norm(pose.points[[0, -1]] - [held.start, held.end], axis=1)
        assert row["largest_distance_from_fixture"] == pytest.approx(away.max())
        assert np.ptp(away) > 1e-6
