"""What figures and pictures draw is what the outcome holds."""

import re
from dataclasses import replace

import numpy as np
import pytest
from test_figures import LOAD, with_readings
from test_page import MOTION, PROPOSAL

from dlo_casadi.arrays import chord_lengths
from dlo_casadi.report import figures
from dlo_casadi.report.page_pictures import pictures
from dlo_casadi.report.scene import Plane, Room, next_marks, pull_marks, upright
from dlo_casadi.report.sections import report_dict
from dlo_casadi.report.tables import newtons
from dlo_casadi.session.outcome import ReadingErrors
from dlo_casadi.session.pose_shape import BranchShape


def test_a_panel_of_residuals_tells_the_rms_of_its_fit_poses(outcome):
    drawing = figures.residuals_figure(outcome)
    fitted = [pose.name for pose in outcome.poses if pose.role == "fit"]
    for axes, name in zip(drawing.axes, ("initial", "batch"), strict=True):
        shapes = outcome.stage(name).shapes
        residuals = np.concatenate([shapes[pose].residual for pose in fitted])
        size = np.sqrt(np.mean((residuals / outcome.measurement.std) ** 2))
        assert f"RMS\u00a0{size:.2g}" in axes.get_title(loc="left").replace("\n", " ")


def test_a_pose_in_another_equilibrium_does_not_set_the_range(outcome):
    batch = outcome.stage("batch")
    name, shape = next(iter(batch.shapes.items()))
    ranges = []
    for branch in (None, BranchShape(1e-4, "cw")):
        far = replace(shape, residual=1e3 * shape.residual, measured_branch=branch)
        stage = replace(batch, shapes=batch.shapes | {name: far})
        found = replace(outcome, stages=(*outcome.stages[:-1], stage))
        ranges.append(np.ptp(figures.residuals_figure(found).axes[-1].get_ylim()))
    assert ranges[0] > 50 * ranges[1]


def test_the_band_of_the_rest_curvature_holds_95_percent(outcome):
    rest = outcome.stages[-1].rest_curvature
    (axes,) = figures.rest_curvature_figure(outcome).axes
    (band,) = axes.collections
    heights = band.get_paths()[0].vertices[:, 1]
    spread = 1.959964 * rest.std
    assert heights.max() == pytest.approx((rest.value + spread).max(), rel=1e-5)
    assert heights.min() == pytest.approx((rest.value - spread).min(), rel=1e-5)


def test_readings_are_drawn_and_told_in_units_of_their_noise(outcome):
    """Measured (0.1, -1) N, predicted (0.12, -0.9) N, noise 0.02 N; moments agree."""
    shown = with_readings(outcome)
    force, moment = figures.readings_figure(shown).axes
    drawn = [line.get_ydata() for line in force.lines if len(line.get_ydata()) == 2]
    residuals = [y for y in drawn if np.any(y)]  # beside the line at zero
    assert len(residuals) == 3
    assert residuals[0] == pytest.approx([-1.0, -5.0])
    assert all(not np.any(line.get_ydata()) for line in moment.lines)
    facts = next(item.facts for item in pictures(shown) if item.over)
    assert ("force-read", "end force", "1 N, off by 0.1 N (5.1 std)") in facts


def test_a_pull_stands_where_it_acts_on_the_measured_line(outcome):
    pulled = replace(outcome, unexplained=LOAD)
    marks = [x for x in pull_marks(pulled, Plane(0.55, 0.1)) if x.kind == "pull"]
    poses = {pose.name: pose for pose in outcome.poses}
    ends = {pose.name: pose.end for pose in outcome.config.experiment.poses}
    for name, mark in zip(LOAD.poses, marks, strict=True):
        line = np.vstack([[0.0, 0.0], poses[name].points, ends[name]])
        along = chord_lengths(line)
        at = [np.interp(LOAD.position / 0.55 * along[-1], along, x) for x in line.T]
        assert mark.points[0] == pytest.approx(at)
        assert mark.points[1] == pytest.approx(at + np.array([0.0, 0.1]))


def test_the_next_end_is_marked_where_it_is(outcome):
    marks = next_marks(replace(outcome, next_pose=PROPOSAL), Plane(0.55, 0.1))
    (cross,) = (mark.points for mark in marks if mark.kind == "next")
    assert cross.mean(axis=0) == pytest.approx(PROPOSAL.end)


def test_a_room_turns_forces_and_frames_upright():
    """Gravity along x of the world points down; a clamp's x along y of the world."""
    gravity = np.array([9.81, 0.0, 0.0])
    room = Room(upright(gravity), np.zeros(3), 500.0, -300.0, 1000.0, newton=2.0)
    arrow = room.force(np.zeros(3), gravity).points
    assert arrow[1] - arrow[0] == pytest.approx([0.0, 0.0, -2.0 * 9.81], abs=1e-9)
    ahead, *_ = room.clamp(np.zeros(3), (0.0, 0.0, 0.5**0.5, 0.5**0.5))
    way = ahead.points[1] - ahead.points[0]
    assert way / np.linalg.norm(way) == pytest.approx(upright(gravity) @ [0.0, 1.0, 0.0])
    squares = [replace(room, length=length).square for length in (1000.0, 600.0, 300.0)]
    assert squares == pytest.approx([200.0, 100.0, 50.0])


def test_sizes_of_forces_stand_below_a_room(in_room):
    stage = in_room.stage("batch")
    for picture in pictures(in_room):
        (text,) = (text for _, name, text in picture.facts if name == "forces on start, end")
        sizes = [float(x) for x in re.findall(r"[\d.]+", text)]
        known = np.linalg.norm(stage.shapes[picture.name].forces, axis=1)
        assert sizes == pytest.approx(known, rel=5e-3)


def test_forces_come_before_moments():
    assert newtons(ReadingErrors(force=0.5, moment=0.02)) == "0.5 N, 0.02 N m"


def test_findings_of_a_diagnosis_are_in_the_report(outcome):
    found = replace(outcome, unexplained=LOAD, next_pose=PROPOSAL, next_motion=MOTION)
    report = report_dict(found)
    assert tuple(report["unexplained"]["interval_95"]) == LOAD.interval
    assert report["next_pose"]["expected_difference_m"] == PROPOSAL.difference
    assert report["next_pose"]["expected_difference_std"] == PROPOSAL.separation
    assert report["next_motion"]["aside_m"] == MOTION.aside
    rival = report["next_motion"]["rivals"]["point_force"]
    assert rival["expected_difference_std"] == MOTION.rivals["point_force"].separation
    assert report["repeatability"]["held_out_inside_90"] == outcome.inside_band
