"""Cables in space in the report: where they stand, what is beside them, how they are seen."""

import io
from dataclasses import replace

import numpy as np
import pytest
from matplotlib.image import imread
from rich.console import Console
from small_sessions import BARE
from test_figures import pull
from test_page import PROPOSAL, diagnosed

from dlo_casadi.report.figures import figures_of, write_figures
from dlo_casadi.report.figures_poses import draw_poses, outcome_figure
from dlo_casadi.report.page import report_page
from dlo_casadi.report.scene import VIEWS, Room, scenes_of, seen, upright
from dlo_casadi.report.sections import print_summary, report_dict
from dlo_casadi.session.fitting import confirmed, minimum_by_ipopt
from dlo_casadi.show.style import arrow


def in_room_pulled(outcome):
    """The outcome as if something had pulled the cable, and a next pose were known."""
    proposal, load = replace(PROPOSAL, end=(0.6, -0.2, 0.3)), pull((0, 0, 0.2), (0, 0.2, 0.2))
    return diagnosed(outcome, unexplained=load, verdict="unexplained", next_pose=proposal)


@pytest.mark.parametrize("length", [0.5, np.nextafter(0.5, 0.0), 0.7, 1.9, 5.0])
def test_squares_of_the_floor_are_a_round_fifth_of_the_cable(length):
    room = Room(np.eye(3), np.zeros(3), 1.0, 0.0, 1e3 * length, 1.0)
    round_sizes = [k * ten for ten in (10, 100, 1000) for k in (1, 2, 5)]
    fifth = 200 * length * (1 + 1e-9)
    assert room.square == max(size for size in round_sizes if size <= fifth)


def test_gravity_points_down_whichever_axis_it_has():
    for gravity in ([0, 0, -9.81], [0, -9.81, 0], [9.81, 0, 0], [3.0, -4.0, 5.0], [0, 0, 0]):
        axes = upright(gravity)
        assert axes @ axes.T == pytest.approx(np.eye(3), abs=1e-12)
        assert np.linalg.det(axes) == pytest.approx(1.0)
        size = np.linalg.norm(gravity)
        assert axes @ gravity == pytest.approx([0, 0, -size], abs=1e-12)


def test_views_show_what_they_say():
    """Front: x right, z up. Side, from +x: y right, z up. Above: x right, y up."""
    x, y, z = seen(np.eye(3), VIEWS[1])
    assert np.array([x, y, z]) == pytest.approx(np.array([[1, 0], [0, 0], [0, 1]]), abs=1e-12)
    assert seen(np.eye(3), VIEWS[2]) == pytest.approx(np.array([[0, 0], [1, 0], [0, 1]]), abs=1e-12)
    assert seen(np.eye(3), VIEWS[3]) == pytest.approx(np.array([[1, 0], [0, 1], [0, 0]]), abs=1e-12)


def test_an_arrow_ends_at_its_tip():
    line = arrow(np.array([1.0, 2.0, 3.0]), np.array([0.0, 0.0, -2.0]))
    assert line[1] == pytest.approx([1, 2, 1])
    assert np.isfinite(arrow(np.zeros(3), np.zeros(3))).all()


def test_rooms_hold_their_cables_from_wherever_they_are_seen(in_room):
    stage = in_room.stage("batch")
    standing, _ = scenes_of(in_room.config, in_room.poses, [stage])
    assert len({room.radius for room in standing}) == 1
    for room, pose in zip(standing, in_room.poses, strict=True):
        shape = stage.shapes[pose.name]
        curve = room.points(shape.curve)
        assert np.linalg.norm(curve, axis=1).max() < room.radius
        assert curve[:, 2].min() > room.floor
        tip = room.force(curve[-1], shape.forces[1]).points[1]
        assert np.linalg.norm(tip) <= room.radius
        for mark in room.ground():
            assert np.hypot(*mark.points[:, :2].T).max() < room.window[0] / 2


def test_the_forces_at_the_ends_carry_the_weight(in_room):
    """Their sum is the weight, which pulls down: m g."""
    cable, gravity = in_room.config.cable, in_room.config.experiment.gravity
    for shape in in_room.stage("batch").shapes.values():
        assert shape.forces.sum(axis=0) == pytest.approx(cable.mass * np.array(gravity), abs=1e-6)


def test_residuals_are_the_gap_across_the_cable(in_room):
    for shape in in_room.stage("batch").shapes.values():
        assert shape.residual.shape == (len(shape.s), 2)
        across, whole = (np.linalg.norm(x, axis=1) for x in (shape.residual, shape.gap))
        assert np.all(across <= whole + 1e-12)


def test_a_fit_in_space_is_as_converged_as_it_was(in_room):
    """IPOPT is not asked there, and what is sent to another process comes back as a copy."""
    for converged in (True, False):
        fit = replace(in_room.fit, converged=converged)
        assert confirmed(fit, minimum_by_ipopt(fit)) is fit


def test_every_figure_of_space_is_drawn(in_room, tmp_path):
    write_figures(tmp_path, figures_of(in_room_pulled(in_room)))
    draw_poses(tmp_path, in_room_pulled(in_room))
    names = {"poses", "residuals", "rest_curvature", "errors", "pose_errors", "candidates"}
    names |= {"unexplained", "next_pose"}
    assert {path.stem for path in tmp_path.iterdir()} == names
    for path in tmp_path.iterdir():
        assert imread(path)[..., :3].min() < 0.5
    assert outcome_figure(in_room).axes


def test_what_is_said_has_three_components(in_room):
    pulled = in_room_pulled(in_room)
    console = Console(width=200, record=True, file=io.StringIO())
    print_summary(console, pulled)
    text = console.export_text()
    for said in (text, report_page(pulled, BARE)):
        assert "(0, 0.1, 0.2) N" in said
        assert "(0.600, -0.200, 0.300) m" in said
        assert "(0, 0, -9.81) m/s" in said
        assert "torsional_" in said
    assert "GJ" in text
    rest = report_dict(pulled)["stages"][-1]["parameters"]["rest_curvature"]
    assert len(rest["k_y"]["value"]) == len(rest["k_z"]["std"]) == len(rest["s"])


def test_the_page_of_a_session_in_space_is_small(in_room):
    assert len(report_page(in_room).encode()) < 0.5e6
