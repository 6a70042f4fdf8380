"""report.html says what the outcome holds, escaped, in one file of a bounded size."""

import base64
import hashlib
import io
import re
import xml.etree.ElementTree as ET
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from small_sessions import BARE, context
from test_figures import CANDIDATES, EFFECT, LOAD, with_readings

from dlo_casadi.cable.estimate import Estimate
from dlo_casadi.diagnosis.next_measurement import NextPose, NextReading
from dlo_casadi.diagnosis.next_motion import NextMotion, Swing
from dlo_casadi.report import canvas, figures
from dlo_casadi.report.page import (
    breakable,
    configuration_text,
    report_page,
    units,
)
from dlo_casadi.report.page_pictures import PHOTOGRAPHS, photograph_of, pictures
from dlo_casadi.report.page_tables import (
    candidate_rows,
    meaning,
    parameter_rows,
    symmetric_interval,
)
from dlo_casadi.report.scene import beside
from dlo_casadi.report.tables import stage_rows
from dlo_casadi.show import style
from dlo_casadi.show.text import millimetres

HOSTILE = "<img src=x onerror=alert(1)></script>"
PROPOSAL = NextPose(
    end=(0.1, -0.2),
    difference=2.5e-3,
    separation=8.2,
    times=1,
    reading=NextReading("end_force", 0.3, 4.0, 2),
    separates=("lumped_mass", "point_force"),
)
MOTION = NextMotion(
    pose="pose_01",
    at=0.8,
    aside=0.2,
    duration=3.0,
    frequencies=(0.741, 2.32, 5.39),
    rivals={"point_force": Swing((0.77, 2.4, 5.5), 11.2), "tether": Swing((0.74, 2.33, 5.4), 1.1)},
    of="lumped_mass",
)


def diagnosed(outcome, **changes):
    """The outcome as if its diagnosis had added an effect: the last stage once more."""
    diagnosis = outcome.config.diagnosis.changed(enabled=True)
    closed = replace(outcome.stage("batch"), name="closed")
    found = {
        "config": outcome.config.changed(diagnosis=diagnosis),
        "stages": (*outcome.stages, closed),
        "effects": (EFFECT,),
        "candidates": CANDIDATES,
        "verdict": "effect_found",
        "next_pose": PROPOSAL,
    }
    return replace(outcome, **(found | changes))


# ---- what it says ------------------------------------------------------------------------------


def test_the_verdict_is_a_sentence(outcome):
    data = context("verdict", diagnosed(outcome))
    assert data["verdict_word"] == "Effect found"
    assert data["sentence"] == (
        "The declared model lacked lumped_mass; with it the residual is noise."
    )
    assert "These data cannot tell it from point_force." in data["details"]


def test_a_diagnosis_that_is_switched_off_is_no_verdict(outcome, page):
    assert outcome.verdict is None
    data = context("verdict", outcome)
    assert (data["verdict"], data["verdict_word"]) == ("off", "Not diagnosed")
    assert data["sentence"].startswith("Nothing was looked for")
    assert "What the declared model may lack" not in page
    far = {"verdict": "unexplained", "doubts": ("poses are predicted far off",)}
    doubted = context("verdict", replace(outcome, **far))
    assert (doubted["verdict"], doubted["verdict_word"]) == ("unexplained", "Unexplained")


def test_the_stages_have_their_errors_and_the_two_that_are_compared_their_marks(outcome):
    rows = stage_rows(diagnosed(outcome), "–")
    assert [row["mark"] for row in rows] == ["", "", "", "before", "after"]
    assert [row["validated"] for row in rows[-2:]] == ["0.5 mm", "0.1 mm"]
    batch = outcome.stage("batch")
    assert rows[-1]["fit"] == f"{1e3 * batch.rmse_fit:.3g} mm"
    assert rows[-1]["held_out"] == f"{1e3 * batch.rmse_held_out:.3g} mm"
    assert rows[-1]["chi2"] == f"{batch.chi2_per_dof:.3g}"
    assert rows[2] | {"note": ""} == {  # Algorithm 1 did not run
        "label": "Algorithm 1",
        "mark": "",
        "fit": "–",
        "validated": "–",
        "held_out": "–",
        "chi2": "–",
        "note": "",
    }


def test_candidates_keep_their_rank_and_rivals_are_named(outcome):
    rows = candidate_rows(diagnosed(outcome))
    assert [row["name"] for row in rows] == [row.name for row in CANDIDATES]
    assert [row["said"] for row in rows] == [
        "added to the model",
        "cannot be told apart from lumped_mass",
        "not refitted",
    ]
    why = "predicts what is left out worse: 3 mm instead of 2 mm"
    again = tuple(replace(row, rmse_cross_validated=3e-3, reason=why) for row in CANDIDATES)
    assert candidate_rows(diagnosed(outcome, candidates=again))[2]["said"] == why
    assert why in report_page(diagnosed(outcome, candidates=again), BARE)
    assert rows[0]["share"] == 1.0
    assert rows[1]["share"] == pytest.approx(690 / 700)


def test_no_candidate_explains_what_is_unexplained(outcome):
    rows = candidate_rows(diagnosed(outcome, effects=(), verdict="unexplained"))
    assert {row["said"] for row in rows} == {
        "withdrawn: it leaves the residual unexplained",
        "not refitted",
    }


def test_an_effect_has_a_meaning_and_an_unknown_one_none():
    assert meaning("lumped_mass").startswith("A compact mass on the cable")
    assert "`" not in meaning("gravity_tilt")
    assert meaning("no such effect") == ""


def test_what_the_data_cannot_tell_has_no_value(outcome):
    unknown = Estimate(1.0, 9.0, "N m^2", (0.1, None), identifiable=False)
    bound = Estimate(0.0, 0.1, "kg", at_bound=True)
    known = Estimate(0.5, 0.01, "m")
    parameters = {"bending_stiffness": unknown, "lumped_mass.mass": bound, "x.position": known}
    last = replace(outcome.stage("batch"), parameters=parameters)
    rows = parameter_rows(replace(outcome, stages=(*outcome.stages[:-1], last)))

    assert [row["doubt"] for row in rows[:3]] == ["unknown", "bound", ""]
    assert (rows[0]["value"], rows[0]["interval"]) == (">= 0.1 N m^2", "")
    assert rows[2]["interval"] == "0.4804 to 0.5196 m"
    page = report_page(replace(outcome, stages=(*outcome.stages[:-1], last)), BARE)
    assert "the data cannot tell</span>" in page
    assert "at a bound</span>" in page


def test_a_fixed_parameter_has_no_interval():
    assert symmetric_interval(Estimate(0.5, 0.0, "m")) == ""


def test_a_configuration_that_has_gone_is_said_to_be(outcome, tmp_path):
    assert configuration_text(outcome.config) == outcome.config.path.read_text()
    text = configuration_text(outcome.config.noted(path=tmp_path / "gone.yaml"))
    assert text == "# gone.yaml cannot be read any more: No such file or directory"


def test_units_and_names_are_set_for_reading():
    assert units("0.3 N m^2 and 9.81 m/s^2") == "0.3\u00a0N\u00a0m² and 9.81 m/s²"
    assert units(">= 2 N") == "≥ 2 N"
    assert breakable("a_<b>.c") == "a_<wbr>&lt;b&gt;.<wbr>c"


# ---- one file ----------------------------------------------------------------------------------


def hostile(outcome):
    """The outcome as if cable, file and messages had been named to do harm."""
    name = HOSTILE.replace("/", "")
    cable = outcome.config.cable.changed(name=HOSTILE)
    first, *others = outcome.config.experiment.poses
    first = first.changed(file=first.file.with_name(f"{name}.csv"), name=name)
    experiment = outcome.config.experiment.changed(poses=(first, *others))
    stages = tuple(
        replace(stage, shapes={name: stage.shapes.get("pose_01"), **stage.shapes})
        for stage in outcome.stages
        if stage.shapes
    )
    poses = (replace(outcome.poses[0], name=name, messages=(HOSTILE,)), *outcome.poses[1:])
    config = outcome.config.changed(cable=cable, experiment=experiment)
    return replace(outcome, config=config, poses=poses, stages=stages, warnings=(HOSTILE,))


def test_names_and_messages_are_escaped(outcome):
    page = report_page(hostile(outcome))

    assert "<img" not in page
    assert page.count("</script>") == page.count("<script")
    assert page.count("&lt;img src=x onerror=alert(1)&gt;") >= 5


def test_the_page_may_load_nothing_and_run_its_own_scripts_alone(page):
    policy = re.search(r'Content-Security-Policy" content="([^"]*)"', page)[1]
    policy = policy.replace("&#39;", "'")
    assert policy.startswith("default-src 'none'; img-src data:;")
    scripts = re.findall(r"<script>(.*?)</script>", page, flags=re.DOTALL)
    assert len(scripts) == 1
    for script in scripts:
        digest = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
        assert f"'sha256-{digest}'" in policy


def test_eighteen_photographs_of_the_noisiest_kind_stay_within_five_megabytes(tmp_path):
    """A photograph that does not compress: white noise, 1920 px wide."""
    noise = np.random.default_rng(0).integers(0, 256, (1080, 1920, 3), dtype=np.uint8)
    Image.fromarray(noise).save(tmp_path / "noise.jpg", quality=90)
    uri, width, height = photograph_of(tmp_path / "noise.jpg", PHOTOGRAPHS // 18)

    assert (width, height) == (1920, 1080)
    charts, lines = 0.3e6, 18 * 20e3
    assert 18 * len(uri) + charts + lines < 5e6
    shown = Image.open(io.BytesIO(base64.b64decode(uri.partition(",")[2])))
    assert shown.width >= 320
    assert shown.width / shown.height == pytest.approx(16 / 9, rel=0.01)


def test_a_photograph_that_is_small_enough_keeps_its_size(photographed):
    uri, width, _ = photograph_of(photographed.poses[0].image, 300_000)
    shown = Image.open(io.BytesIO(base64.b64decode(uri.partition(",")[2])))
    assert shown.width == width == 1280


def test_a_photograph_that_has_gone_is_replaced_by_the_board(photographed, tmp_path):
    declared = photographed.config.experiment.poses
    poses = (declared[0].changed(file=tmp_path / "pose_01.jpg"), *declared[1:])
    experiment = photographed.config.experiment.changed(poses=poses)
    gone = replace(photographed, config=photographed.config.changed(experiment=experiment))
    first, second = pictures(gone)[:2]

    assert (first.behind.photograph, bool(first.behind.grid), len(first.lines)) == ("", True, 3)
    assert second.behind.photograph.startswith("data:image/jpeg;base64,")


# ---- pictures and charts -----------------------------------------------------------------------


def coordinates(text):
    return np.array([pair.split(",") for pair in text.split()], dtype=float)


def test_forces_that_were_read_stand_beside_the_predicted_ones(outcome, page):
    """Two arrows from the end, on one scale: the longest a fifth of the cable."""
    shown = with_readings(outcome)
    picture = next(item for item in pictures(shown) if item.over)
    model, read = picture.over
    assert (model.kind, read.kind) == ("force", "force-read")
    root, tip = coordinates(read.points)[:2]
    assert root == pytest.approx(picture.end, abs=0.1)
    newton = 200 * shown.config.cable.length / np.hypot(0.1, 1.0)  # mm/N
    assert tip - root == pytest.approx([0.1 * newton, newton], abs=0.1)  # y down
    assert any(name == "end force" for _, name, _ in picture.facts)
    assert "as read" in report_page(shown, BARE)
    assert "as read" not in page


def test_lines_lie_where_the_camera_sees_them(photographed):
    for picture, pose in zip(pictures(photographed), photographed.poses, strict=True):
        lines = {line.kind: line for line in picture.lines}
        assert set(lines) == {"measured", "before", "after"}
        # Written with two decimals; the camera step measured them at these pixels.
        assert coordinates(lines["measured"].points) == pytest.approx(pose.pixels, abs=0.02)
        stage = photographed.stage("batch")
        near = beside(pose, stage.shapes[pose.name])
        assert coordinates(lines["after"].near) == pytest.approx(pose.to_pixels(near), abs=0.006)


def test_the_part_that_is_shown_holds_the_cable_and_keeps_the_ratio(photographed):
    for picture, pose in zip(pictures(photographed), photographed.poses, strict=True):
        left, top, width, height = picture.box
        assert width / height == pytest.approx(1280 / 720, rel=1e-3)
        assert width <= picture.behind.whole[2]
        assert np.all(pose.pixels >= [left, top])
        assert np.all(pose.pixels <= [left + width, top + height])


def test_centre_lines_are_drawn_on_a_board_of_one_scale(outcome):
    drawn = pictures(outcome)
    assert {picture.behind.photograph for picture in drawn} == {""}
    assert len({picture.box for picture in drawn}) == 1
    measured = next(line for line in drawn[0].lines if line.kind == "measured")
    expected = 1e3 * outcome.poses[0].points * [1, -1]
    assert coordinates(measured.points) == pytest.approx(expected, abs=0.006)


def test_a_line_beside_the_points_lies_on_its_prediction(outcome):
    """Whatever noise the last stage has, and the stage that is drawn had."""
    noisier = replace(outcome.measurement, std=2 * outcome.measurement.std)
    for picture in pictures(replace(outcome, measurement=noisier)):
        before = next(line for line in picture.lines if line.kind == "before")
        near = coordinates(before.near)[10:-10]  # beyond its ends a line has no normal
        curve = coordinates(before.points)
        chord, gap = np.diff(curve, axis=0), near[:, None] - curve[:-1]
        share = np.clip((gap * chord).sum(axis=2) / (chord**2).sum(axis=1), 0, 1)
        away = np.linalg.norm(gap - share[..., None] * chord, axis=2).min(axis=1)
        # Points are written to 0.1 mm; the prior's deviations, drawn twice, are millimetres off.
        assert away.max() < 0.1


def test_a_pose_that_could_not_be_read_says_why(outcome):
    lost = replace(outcome.poses[0], points=np.zeros((0, 2)), problem="no cable found")
    page = report_page(replace(outcome, poses=(lost, *outcome.poses[1:])), BARE)
    assert "<strong>Not read.</strong> no cable found" in page
    assert "pose_01 (not read)" in page


@pytest.fixture(scope="module")
def full_page(outcome):
    return report_page(diagnosed(outcome, unexplained=LOAD, verdict="unexplained"))


def charts(page):
    """Names and texts of the charts of a page."""
    return dict(re.findall(r'class="chart" id="chart-(\w+)".*?(<svg.*?</svg>)', page, re.DOTALL))


def test_charts_are_there_for_what_the_outcome_holds(page, full_page):
    always = {"errors", "pose_errors", "residuals", "rest_curvature"}
    assert set(charts(page)) == always
    drawn = charts(full_page)
    assert set(drawn) == always | {"next_pose", "unexplained"}
    for name, text in drawn.items():
        ET.fromstring(text)
        assert "nan" not in text.lower(), name
        assert "<style" not in text, name  # it would hold for all of the page


def test_charts_side_by_side_share_no_name_and_are_reproducible(outcome, full_page):
    ids = [
        name for text in charts(full_page).values() for name in re.findall(r' id="([^"]*)"', text)
    ]
    assert len(ids) == len(set(ids)) > 2 * len(outcome.poses)
    for text in charts(full_page).values():
        used = re.findall(r'(?:href="|url\()#([^")]*)', text)
        assert set(used) <= set(re.findall(r' id="([^"]*)"', text))
    again = diagnosed(outcome, unexplained=LOAD, verdict="unexplained")
    assert report_page(again) == full_page


def test_a_chart_is_the_figure_of_the_file(outcome, page):
    """Drawn once: the residuals of each pose, in units of the noise."""
    drawing = figures.residuals_figure(outcome)
    lines = {line.get_gid(): line for axes in drawing.axes for line in axes.lines}
    for kind, name in (("before", "initial"), ("after", "batch")):
        for k, pose in enumerate(outcome.poses):
            shape = outcome.stage(name).shapes[pose.name]
            shown = lines[f"residual-{kind}-{k}"].get_ydata()
            assert shown == pytest.approx(shape.residual / outcome.measurement.std)
    alone = {**BARE, "residuals": drawing}
    assert charts(report_page(outcome, alone))["residuals"] == charts(page)["residuals"]


def test_a_long_line_is_drawn_with_fewer_points(outcome):
    name = outcome.poses[0].name
    batch = outcome.stage("batch")
    many = np.linspace(0.0, 0.3, 5000)
    long = replace(batch.shapes[name], s=many, residual=np.sin(1e3 * many))
    stage = replace(batch, shapes={name: long})
    drawing = figures.residuals_figure(replace(outcome, stages=(stage,)))
    (line,) = (x for x in drawing.axes[0].lines if x.get_gid() == "residual-after-0")
    assert 300 < len(line.get_xdata()) <= 600


def test_a_run_without_a_prediction_shows_what_was_measured(outcome):
    bare = replace(outcome, stages=tuple(replace(stage, shapes={}) for stage in outcome.stages))
    page = report_page(bare)

    assert set(charts(page)) == {"errors"}
    assert page.count('<polyline id="measured-') == 12
    assert 'id="residuals"' not in page
    assert "None" not in page.partition("<main")[2].partition("<script")[0]


def test_what_is_told_at_the_pointer(outcome, page):
    """Of every line and every row of a pose: its name and its error."""
    drawn = charts(page)
    stage, pose = outcome.stage("batch"), outcome.poses[0]
    titles = {}
    for name in ("residuals", "pose_errors"):
        for group in ET.fromstring(drawn[name]).iter("{http://www.w3.org/2000/svg}g"):
            if len(group) and group[0].tag.endswith("title"):
                titles[group.get("id")] = group[0].text
    count = len(outcome.poses)
    assert set(titles) == {
        f"{kind}-{k}"
        for kind in ("choose", "residual-before", "residual-after")
        for k in range(count)
    }
    error = millimetres(stage.shapes[pose.name].rmse)
    assert titles["residual-after-0"] == f"{pose.name}, RMS distance {error}"
    assert titles["choose-0"].startswith(f"{pose.name}; initial guess ")
    assert titles["choose-0"].endswith(f"; declared model, fitted {error}")
    k = next(k for k, pose in enumerate(outcome.poses) if pose.role == "held_out")
    assert titles[f"choose-{k}"].startswith(f"{outcome.poses[k].name} (held out); ")


def luminance(color):
    """Relative luminance of #rrggbb (WCAG 2)."""
    parts = [int(color[i : i + 2], 16) / 255 for i in (1, 3, 5)]
    linear = [c / 12.92 if c <= 0.04045 else ((c + 0.055) / 1.055) ** 2.4 for c in parts]
    return 0.2126 * linear[0] + 0.7152 * linear[1] + 0.0722 * linear[2]


def test_colours_have_a_contrast_of_four_and_a_half():
    """WCAG 2: (L1 + 0.05) / (L2 + 0.05) of the relative luminances."""
    sheet = (Path(canvas.__file__).parent / "templates" / "page.css").read_text()
    of_style = dict(re.findall(r"--([a-z]+): (#[0-9a-f]{6})", sheet))
    of_charts = [
        getattr(style, name)
        for name in ("BLACK", "GREY", "ORANGE", "BLUE", "GREEN", "VERMILLION", "HELD_OUT")
    ]
    on_paper = [of_style[k] for k in ("ink", "soft", "before", "after", "held", "next", "good")]
    pairs = [(color, of_style["paper"]) for color in of_charts + on_paper]
    pairs += [(of_style[name], of_style["ground"]) for name in ("ink", "soft", "after")]
    for color, ground in pairs:
        contrast = (luminance(ground) + 0.05) / (luminance(color) + 0.05)
        assert contrast >= 4.5, (color, ground, contrast)


@pytest.mark.parametrize("error", [np.inf, 0.0, 1e300, np.nan])
def test_charts_of_any_error_have_a_finite_range(outcome, error):
    stages = tuple(replace(stage, rmse_fit=error, shapes={}) for stage in outcome.stages)
    axes = figures.errors_figure(replace(outcome, stages=stages)).axes[0]
    low, high = axes.get_xlim()
    assert 0 < low < high < np.inf
    assert 0 < len(axes.get_xticks()) < 100
    for text in axes.texts:  # beside its point, within the axis
        x = text.get_position()[0] if text.get_text() == "no value" else text.xy[0]
        assert low <= x < high

    shapes = {
        pose.name: replace(outcome.stages[-1].shapes[pose.name], rmse=error)
        for pose in outcome.poses
    }
    last = replace(outcome.stages[-1], shapes=shapes)
    drawing = figures.pose_errors_figure(replace(outcome, stages=(last,)))
    low, high = drawing.axes[0].get_xlim()
    assert 0 < low < high < np.inf
    assert "nan" not in canvas.inline_svg(drawing, "pose_errors").replace("nan mm", "")
