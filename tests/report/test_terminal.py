"""What the terminal says, word for word where it matters."""

from dataclasses import replace
from io import StringIO

import numpy as np
import pytest
from rich.console import Console
from small_sessions import context
from test_figures import EFFECT, LOAD
from test_page import MOTION, PROPOSAL

from dlo_casadi.cable.estimate import Estimate
from dlo_casadi.diagnosis.found import Ranked
from dlo_casadi.diagnosis.structure import LARGEST_SCORE, Structure
from dlo_casadi.report.findings import RESIDUAL, separation_text
from dlo_casadi.report.page_pictures import pictures
from dlo_casadi.report.sections import print_summary, report_dict
from dlo_casadi.report.tables import describe, stage_rows, unidentified
from dlo_casadi.report.terminal import plain_table
from dlo_casadi.report.words import finding_of
from dlo_casadi.session.pose_shape import BranchShape
from dlo_casadi.session.run import judged
from dlo_casadi.session.sentences import said_of
from dlo_casadi.show.text import plus_minus


def said(outcome):
    """The summary as text, spaces collapsed."""
    console = Console(width=120, record=True, quiet=False, file=open("/dev/null", "w"))  # noqa: SIM115
    with console.file:
        print_summary(console, outcome)
        return " ".join(console.export_text().split())


def with_stiffness(outcome, interval):
    estimate = Estimate(17.0, 30.0, "N m^2", interval, identifiable=False)
    batch = replace(outcome.stage("batch"), parameters={"bending_stiffness": estimate})
    return replace(outcome, stages=(*outcome.stages[:-1], batch))


def test_a_summary_tells_units_what_was_fixed_and_the_noise(outcome):
    text = said(outcome)

    assert "9 fit poses, 3 held out, 2400 points" in text
    assert "(estimated)" in text
    assert "N m^2" in text
    assert "length 0.55 m fixed" in text
    assert "mass 0.2 kg fixed" in text
    assert "gravity (0, -9.81) m/s^2 fixed" in text
    assert "of its tolerance 0.0005 m" in text
    assert "initial guess" in text
    assert "declared model, fitted" in text
    assert "noise alone (estimated)" in text
    assert "warning: stage algorithm1" not in text
    assert "Verdict: not diagnosed. Nothing was looked for" in text
    assert "without imports and writing; of it or beside it IPOPT" in text
    assert "total" in text


@pytest.mark.parametrize(
    ("interval", "words"),
    [
        ((4.1, None), "EI >= 4.1 N m^2, not identifiable from these shapes."),
        ((None, 0.02), "EI <= 0.02 N m^2, not identifiable from these shapes."),
        ((0.1, 4.0), "EI: 0.1 to 4 N m^2, not identifiable from these shapes."),
        ((None, None), "EI: unknown, not identifiable from these shapes."),
    ],
)
def test_no_number_is_given_for_what_the_shapes_do_not_tell(outcome, interval, words):
    text = said(with_stiffness(outcome, interval))

    assert words in text
    assert " 17" not in text.split("Distance of the measured points")[0].split("points;")[1]


def test_without_gravity_a_reading_is_asked_for_and_no_weight(outcome):
    experiment = outcome.config.experiment.changed(gravity=(0.0, 0.0))
    unknown = with_stiffness(outcome, (None, None))
    assert "hang a known weight" in said(unknown)
    text = said(replace(unknown, config=outcome.config.changed(experiment=experiment)))
    assert "Try: end_force or start_force of a pose: without gravity" in text
    assert "hang a known weight" not in text


def test_a_parameter_on_its_bound_says_so(outcome):
    estimate = Estimate(0.0, 0.1, "kg", at_bound=True)

    assert describe(estimate)[2] == "at a bound"


def test_an_added_effect_is_told_with_its_clip(outcome):
    """Of two clips the second: its label and its name stand in words, tables and report.json."""
    slips = replace(EFFECT, name="clip_slip", label="clip_slip_2", of="hook")
    closed = replace(outcome.stage("batch"), name="closed")
    found = replace(
        outcome,
        stages=(*outcome.stages, closed),
        effects=(replace(slips, indistinguishable_from=("end_offset",)),),
        candidates=tuple(Ranked(name, 1.0, 0.1, None) for name in ("clip_slip", "end_offset")),
        verdict="effect_found",
    )
    text = said(found)

    assert "lacked clip_slip_2 of hook; with it the" in text
    assert "clip_slip_2 of hook: mass" in text
    assert "with clip_slip_2 of hook" in text
    assert [finding_of(found, row)[1] for row in found.candidates] == [
        "added to the model: clip_slip_2 of hook",
        "cannot be told apart from clip_slip_2 of hook",
    ]
    (row,) = report_dict(found)["effects"]
    assert (row["name"], row["label"], row["of"]) == ("clip_slip", "clip_slip_2", "hook")


def test_an_added_effect_is_told_with_its_rivals(outcome):
    closed = replace(outcome.stage("batch"), name="closed")
    config = outcome.config.changed(diagnosis=outcome.config.diagnosis.changed(enabled=True))
    text = said(
        replace(
            outcome,
            config=config,
            stages=(*outcome.stages, closed),
            effects=(EFFECT,),
            verdict="effect_found",
            next_pose=PROPOSAL,
            next_motion=MOTION,
        )
    )

    assert "Verdict: effect found. The declared model lacked lumped_mass; with it the" in text
    assert "A reading of end_force there differs by 0.3 N" in text
    assert "4 standard deviations of one reading: read it 2 times." in text
    assert "lumped_mass: mass 0.0500 ± 0.0020 kg (p = 1e-09)" in text
    assert "These data cannot tell it from point_force." in text
    assert (
        "hold the end at (0.100, -0.200) m; they differ there by 2.5 mm RMS, 8.2 standard" in text
    )
    assert "one measurement suffices" in text
    assert (
        "To tell lumped_mass by a motion: hold the ends as in pose_01, pull the cable aside by "
        "0.2 m at 0.8 m from the start, and let it swing; it swings at 0.741, 2.32, 5.39 Hz and "
        "differs in 3 s from point_force by 11 standard deviations (0.77, 2.4, 5.5 Hz)." in text
    ), "a tether would not be told apart"
    assert "cross-validated" in text
    assert "with lumped_mass" in text


@pytest.mark.parametrize(
    ("times", "words"),
    [
        (1, "one measurement suffices."),
        (4, "measure it 4 times."),
        (None, "even 20 measurements would not tell them apart: they differ there by 2.5 mm"),
    ],
)
def test_a_proposal_says_how_often_to_measure(times, words):
    proposal = replace(PROPOSAL, times=times)

    assert words in separation_text(proposal)


def test_poses_on_another_branch_have_a_row_and_a_fact(outcome):
    batch = outcome.stage("batch")
    name, shape = next(iter(batch.shapes.items()))
    other = BranchShape(2.5e-4, "cw")
    shapes = batch.shapes | {name: replace(shape, measured_branch=other)}
    stage = replace(batch, shapes=shapes, rmse_fit=0.243, rmse_fit_measured_branch=2.6e-4)
    found = replace(outcome, stages=(*outcome.stages[:-1], stage))

    text = said(found)
    assert "243 mm" in text
    assert "on the measured branch 0.26 mm" in text
    assert "on the measured branch" not in said(outcome)
    (row,) = [row for row in stage_rows(found, "–") if row["label"] == "on the measured branch"]
    assert row["fit"] == "0.26 mm"
    assert name in row["note"]
    facts = {picture.name: picture.facts for picture in pictures(found)}[name]
    assert facts[-2][1:] == ("with branch: cw", "0.25 mm")


def test_an_unexplained_residual_tells_where_the_cable_is_pulled(outcome):
    config = outcome.config.changed(diagnosis=outcome.config.diagnosis.changed(enabled=True))
    text = said(replace(outcome, config=config, verdict="unexplained", unexplained=LOAD))

    assert "Verdict: unexplained. The residual is not noise." in text
    assert (
        "as if pulled by (0, 1) N on average at 0.300 m (0.280 to 0.320 m) from the start" in text
    )


def test_what_keeps_a_fit_from_holding_stands_in_the_verdicts_place(outcome):
    doubt = "fit poses are predicted 50 mm off, 0.6 mm are what noise lets expect"
    found = replace(outcome, verdict="unexplained", doubts=(doubt,))
    assert f"Verdict: unexplained. F{doubt[1:]}." in said(found)
    assert report_dict(found)["warnings"][0] == doubt
    assert context("verdict", found)["sentence"] == f"F{doubt[1:]}."
    assert context("verdict", found)["verdict_word"] == "Unexplained"

    fit, problem = outcome.fit, outcome.fit.problem
    assert not replace(fit, converged=False).failed  # it is at its minimum
    off = fit.point.theta + 0.5 * np.eye(problem.unknowns.size)[0]  # ln EI
    point = problem.balanced(replace(fit.point, theta=off))
    stopped = replace(found, fit=replace(fit, point=point, converged=False))
    # One word in all places, also where nothing was diagnosed.
    assert "Verdict: unexplained. Fit poses" in said(stopped)
    undiagnosed = replace(stopped, verdict=None, doubts=())
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("dlo_casadi.session.remarks.doubts_of", lambda *_: (doubt,))
        again = judged(undiagnosed)
    assert report_dict(again)["verdict"] == "unexplained"
    assert context("verdict", again)["verdict_word"] == "Unexplained"
    assert "Verdict: unexplained. Fit poses" in said(again)


def test_a_score_where_its_test_ends_is_a_bound_and_a_plane_is_no_picture(outcome):
    before = Structure(
        statistic=90.0,
        dof=9,
        p_value=0.0,
        chi2_per_dof=10.0,
        runs_z=-9.0,
        order_z=4.0,
        span_z=-LARGEST_SCORE,
        position_z=LARGEST_SCORE,
        per_pose={},
    )
    found = replace(outcome, verdict="unexplained", structure=(before, before))
    photographs = replace(outcome.measurement, kind="images")

    (line,) = said_of(found, [RESIDUAL])
    assert "changes its sign along the cable less often than noise (z = -9.0), and depends" in line
    assert "the order of the poses (z = +4.0)" in line
    assert "the distance of the ends (z < -7)" in line
    assert "the place in the plane (z > 7)" in line
    (line,) = said_of(replace(found, measurement=photographs), [RESIDUAL])
    assert "the place in the picture (z > 7)" in line
    experiment = found.config.experiment.changed(gravity=(0.0, 0.0, -9.81))
    in_space = found.config.changed(experiment=experiment)
    (line,) = said_of(replace(found, config=in_space), [RESIDUAL])
    assert "the place in space (z > 7)" in line


@pytest.mark.parametrize(
    ("value", "std", "text"),
    [
        (0.46867, 0.0368, "0.469 ± 0.037"),
        (1.0002555, 0.00025794, "1.00026 ± 0.00026"),
        (-9.8e-05, 0.000146, "-0.00010 ± 0.00015"),
        (0.3, 0.0, "0.3"),
        (1234.5, 56.0, "1234 ± 56"),
        (1e-9, 2e-10, "1e-09 ± 2e-10"),
        (5.0, 1e5, "5 ± 1e+05"),
        (2.314e-5, 2.3e-7, "2.314e-05 ± 2.3e-07"),
        (123456.0, 2000.0, "1.235e+05 ± 2e+03"),
        (0.0, 3e-12, "0 ± 3e-12"),
        (0.25, np.inf, "0.25"),
        (np.nan, 1e-9, "nan"),
    ],
)
def test_digits_follow_the_standard_deviation(value, std, text):
    assert plus_minus(value, std) == text


def test_an_unbounded_parameter_has_no_number():
    assert unidentified(Estimate(1.0, 1.0, "m")) == "unknown"


def test_brackets_in_a_name_are_no_markup():
    console = Console(width=120, record=True, file=StringIO())
    table = plain_table("loom [/v2]: limits", ["pose"])
    table.add_row("take [a]", style="red")
    console.print(table)
    text = " ".join(console.export_text().split())
    assert "loom [/v2]: limits" in text
    assert "take [a]" in text
