"""Figures are drawn for what an outcome holds, and show what they should."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from matplotlib.image import imread

from dlo_casadi.cable.estimate import Estimate
from dlo_casadi.cable.picture import draw_shape
from dlo_casadi.diagnosis.found import Ranked
from dlo_casadi.diagnosis.unknown_force import UnknownForce
from dlo_casadi.report import figures, figures_poses
from dlo_casadi.report.figures_poses import write_overlays
from dlo_casadi.report.scene import beside
from dlo_casadi.report.words import compared
from dlo_casadi.session.found_effects import FoundEffect
from dlo_casadi.session.outcome import PoseInput
from dlo_casadi.show.style import save_figure

PHOTO = Path(__file__).parents[2] / "configs" / "bench" / "connector" / "pose_03.jpg"
CANDIDATES = tuple(
    Ranked(*row)
    for row in (
        ("lumped_mass", 700.0, 0.0, 1e-4),
        ("point_force", 690.0, 0.0, 1.1e-4),
        ("end_offset", 0.0, 1.0, None),
    )
)
EFFECT = FoundEffect(
    name="lumped_mass",
    label="lumped_mass",
    of=None,
    parameters={"mass": Estimate(0.05, 0.002, "kg")},
    p_value=1e-9,
    rmse_cross_validated_before=5e-4,
    rmse_cross_validated_after=1e-4,
    indistinguishable_from=("point_force",),
)


def pull(*forces):
    """A load of so much in the first poses."""
    poses = tuple(f"pose_{k:02d}" for k in range(1, 1 + len(forces)))
    return UnknownForce(np.array(forces), 0.3, (0.28, 0.32), None, poses)


LOAD = pull((0.0, 1.0), (0.0, 1.0))


@pytest.fixture
def closed(outcome):
    """The outcome with an effect added: its last stage once more, closer to the points."""
    batch = outcome.stage("batch")
    stage = replace(batch, name="closed")
    return replace(
        outcome,
        stages=(*outcome.stages, stage),
        effects=(EFFECT,),
        candidates=CANDIDATES,
        verdict="effect_found",
    )


def drawn(path):
    """Size of a picture, and the share of its pixels that are not paper."""
    image = imread(path)[..., :3]
    if image.dtype == np.uint8:
        image = image / 255
    return image.shape[:2], float((image.min(axis=2) < 0.9).mean())


def test_an_outcome_without_effects(written):
    folder = written[0] / "figures"
    names = {path.name for path in folder.iterdir()}
    assert names == {
        "poses.png",
        "residuals.png",
        "rest_curvature.png",
        "errors.png",
        "pose_errors.png",
    }
    for path in folder.iterdir():
        (height, width), ink = drawn(path)
        assert min(height, width) >= 500, path.name
        assert ink > 0.01, path.name


def test_candidates_and_the_unexplained_load_are_drawn(closed, tmp_path):
    unexplained = replace(closed, verdict="unexplained", unexplained=LOAD)
    shown = figures.figures_of(unexplained)
    figures.write_figures(tmp_path, {k: shown[k] for k in ("candidates", "unexplained")})

    assert drawn(tmp_path / "candidates.png")[1] > 0.02
    assert drawn(tmp_path / "unexplained.png")[1] > 0.01


def test_what_is_compared(outcome, closed):
    assert [(kind, stage.name) for kind, _, stage in compared(outcome)] == [
        ("before", "initial"),
        ("after", "batch"),
    ]
    before, after = compared(closed)
    assert (before.stage.name, after.stage.name) == ("batch", "closed")
    assert after.label == "with lumped_mass"


def test_nothing_is_drawn_of_what_is_missing(outcome, tmp_path):
    """A pose that could not be read, and stages without a prediction."""
    lost = replace(outcome.poses[0], points=np.zeros((0, 2)), problem="no cable")
    empty = replace(outcome.stages[0], rmse_fit=None, rmse_held_out=None, shapes={})
    half = replace(outcome, poses=(lost, *outcome.poses[1:3]), stages=(empty, *outcome.stages[1:]))
    figures_poses.draw_poses(tmp_path, half)
    shown = figures.figures_of(half)
    figures.write_figures(tmp_path, shown)

    assert (tmp_path / "poses.png").exists()
    gids = {line.get_gid() for axes in shown["residuals"].axes for line in axes.lines}
    assert {gid for gid in gids if gid} == {f"residual-after-{k}" for k in range(3)}
    assert "no value" in {text.get_text() for text in shown["errors"].axes[0].texts}


def test_poses_without_a_shape_are_told(outcome):
    def legend(shown):
        return {text.get_text() for text in figures.residuals_figure(shown).legends[0].get_texts()}

    held_out = {pose.name for pose in outcome.poses if pose.role == "held_out"}
    stages = tuple(
        replace(stage, shapes={k: v for k, v in stage.shapes.items() if k not in held_out})
        for stage in outcome.stages
    )
    without = replace(outcome, stages=stages)
    assert held_out
    assert legend(outcome) - legend(without) == {"held-out pose"}
    (axes,) = figures.pose_errors_figure(without).axes
    assert [text.get_text() for text in axes.texts] == ["no equilibrium"] * len(held_out)


def test_squares_in_space_have_a_size(in_room):
    assert "; squares of 100 mm" in figures_poses.outcome_figure(in_room).get_suptitle()


def test_stages_without_any_prediction_have_no_residuals(outcome, tmp_path):
    none = tuple(replace(stage, shapes={}) for stage in outcome.stages)
    figures.write_figures(tmp_path, figures.figures_of(replace(outcome, stages=none)))
    figures_poses.draw_poses(tmp_path, replace(outcome, stages=none))

    assert {path.name for path in tmp_path.iterdir()} == {"poses.png", "errors.png"}


def test_many_poses_take_several_pages(outcome, tmp_path, monkeypatch):
    monkeypatch.setattr(figures_poses, "_POSES_A_PAGE", 8)
    figures_poses.draw_poses(tmp_path, outcome)

    assert sorted(path.name for path in tmp_path.iterdir()) == ["poses_1.png", "poses_2.png"]


@pytest.mark.parametrize(
    ("count", "grid"), [(1, (1, 1)), (4, (1, 4)), (6, (2, 3)), (12, (3, 4)), (18, (3, 6))]
)
def test_poses_fill_a_grid(count, grid):
    assert figures_poses._arranged(count) == grid


def test_magnified_deviations_are_multiples_of_the_true_ones(outcome):
    """Of a curve magnified k times, the points are k times as far away as of the curve."""
    pose = outcome.poses[0]
    shape = outcome.stage("initial").shapes[pose.name]

    distance = [np.hypot(*(pose.points - beside(pose, shape, k)).T) for k in (5, 10)]
    assert distance[1] == pytest.approx(2 * distance[0])
    # Normals of 201 drawn points: exact to a thousandth.
    assert distance[0] == pytest.approx(5 * np.abs(shape.residual), rel=1e-3)


def test_lines_are_drawn_over_the_part_of_a_photograph_with_the_cable(outcome, tmp_path):
    """The picture of a line along known pixels is cut out about them."""
    pixels = np.stack([np.linspace(430, 700, 50), np.full(50, 200.0)], axis=1)

    def to_pixels(points):
        return np.asarray(points) * [500.0, 0.0] + [430.0, 200.0]

    photographed = PoseInput("pose_01", "fit", outcome.poses[0].points, PHOTO, pixels, to_pixels)
    shown = replace(outcome, poses=(photographed,))
    write_overlays(tmp_path / "overlays", shown)

    (height, width), _ = drawn(tmp_path / "overlays" / "pose_01.jpg")
    assert width <= 1200
    assert height < 0.5 * width  # a flat line: a flat window, not the whole photograph
    before = imread(PHOTO)
    assert before.shape[0] > 0.5 * before.shape[1]


def test_a_photograph_that_is_gone_is_left_out(outcome, tmp_path):
    gone = replace(outcome.poses[0], image=tmp_path / "gone.jpg", to_pixels=lambda x: x)
    write_overlays(tmp_path / "overlays", replace(outcome, poses=(gone,)))

    assert list((tmp_path / "overlays").iterdir()) == []


@pytest.mark.parametrize("end", [None, (0.4, -0.1)])
def test_a_prediction_is_drawn(tmp_path, end):
    points = np.stack([np.linspace(0, 0.4, 21), -0.25 * np.linspace(0, 1, 21)], axis=1)
    force = np.array([0.0, -1.0])
    drawing = draw_shape(
        points,
        {"start": force} | ({"end": 0 * force} if end else {}),
        clips={"middle": (points[10], force)} if end else {},
        band=np.linspace(0.0, 0.01, 21),
        other=-points if end else None,
        title="rope: predicted shape",
        remark="energy 1 J",
        alarming=end is not None,
    )
    save_figure(tmp_path / "shape.png", drawing)

    assert drawn(tmp_path / "shape.png")[1] > 0.005


def test_a_prediction_is_drawn_with_the_table_that_it_touches(tmp_path):
    points = np.stack([np.linspace(0, 0.4, 21), np.zeros(21)], axis=1)
    drawing = draw_shape(
        points,
        {"start": np.array([0.0, 0.5])},
        clips={},
        band=None,
        other=None,
        obstacles=[points - [0.0, 0.003]],
        touching=[(points[6:15], np.array([0.0, -1.0]))],
        title="rope: predicted shape",
        remark="energy 1 J",
        alarming=False,
    )
    save_figure(tmp_path / "shape.png", drawing)

    (legend,) = drawing.legends
    said = {text.get_text() for text in legend.get_texts()}
    assert {"obstacle", "in contact", "force on fixtures and obstacles"} <= said
    assert "1 N" in {text.get_text() for text in drawing.axes[0].texts}


def with_readings(outcome):
    """The same with readings in three poses."""
    stage = outcome.stages[-1]
    names = list(stage.shapes)[:3]
    read = {
        "end_force": (np.array([0.1, -1.0]), np.array([0.12, -0.9])),
        "end_moment": (np.ones(1),) * 2,
    }
    shapes = {k: replace(v, readings=read if k in names else {}) for k, v in stage.shapes.items()}
    measurement = replace(outcome.measurement, readings=6, force_std=0.02, moment_std=0.01)
    stages = (*outcome.stages[:-1], replace(stage, shapes=shapes))
    return replace(outcome, stages=stages, measurement=measurement)


@pytest.mark.parametrize(
    ("count", "size"),
    [
        (1, 1.0),
        (8, 0.1),
        (21, 1.0),
        *(pytest.param(*x, marks=pytest.mark.long) for x in ((1, 0.1), (8, 1.0), (21, 0.1))),
    ],
)
def test_all_names_lie_on_the_page(outcome, tmp_path, monkeypatch, count, size):
    pages = []
    monkeypatch.setattr(
        figures_poses.style, "save_figure", lambda path, drawing: pages.append(drawing)
    )
    pose = replace(outcome.poses[0], points=size * outcome.poses[0].points)
    shape = outcome.stages[-1].shapes[pose.name]
    shapes = {pose.name: replace(shape, curve=size * shape.curve)}
    stages = tuple(replace(stage, shapes=shapes) for stage in outcome.stages)
    figures_poses.draw_poses(tmp_path, replace(outcome, poses=(pose,) * count, stages=stages))
    assert len(pages) == -(-count // 20)
    for page in pages:
        texts = [one for x in page.axes for one in (x.title, x.xaxis.label, x.yaxis.label)]
        texts = [page._suptitle, *(text for text in texts if text.get_text())]
        assert {"x [m]", "y [m]"} < {text.get_text() for text in texts}
        page.canvas.draw()
        wide, high = page.get_size_inches() * page.dpi
        for text in texts:
            box = text.get_window_extent()
            inside = min(box.x0, box.y0) >= 0 and box.x1 <= wide and box.y1 <= high
            assert inside, (text.get_text(), box)


def test_readings_are_drawn_beside_predicted_ones(outcome, tmp_path):
    """Residuals over their noise, and arrows of one scale at the ends."""
    shown = with_readings(outcome)
    figures.write_figures(tmp_path, {"readings": figures.readings_figure(shown)})
    figures_poses.draw_poses(tmp_path, shown)
    assert imread(tmp_path / "readings.png").shape[2] == 4
    assert (tmp_path / "poses.png").is_file()
