"""Lines of a moving cable, from files and videos, are compared across."""

import sys
from pathlib import Path

import cv2
import numpy as np
import pytest

import dlo_casadi as dlo
from dlo_casadi.config import load_config
from dlo_casadi.io.motions import MotionPoints
from dlo_casadi.session.motions import read_motions
from dlo_casadi.session.moving_lines import MARKS, marks_of_lines

sys.path.insert(0, str(Path(__file__).parents[1] / "vision"))
import drawing

LENGTH, T = 0.4, np.arange(12) / 60
SESSION = """
cable: {name: rope, length: 0.4, mass: 0.04, diameter: 0.012, bending_stiffness: 0.009}
experiment:
  gravity: [0.0, -9.81]
  boundary: {start: clamped, end: free}
  measurement: {kind: images, reference: {pixels: [[100, 100], [300, 100]],
    points: [[0.0, 0.0], [0.4, 0.0]]}}
  poses:
  - {file: still.png, start: [0.2, -0.2], start_heading: -1.5}
  motions:
  - {file: swing.avi, start: [0.2, -0.2], start_heading: -1.2}
"""


def curve(t: float, s: np.ndarray, d: int = 2) -> np.ndarray:
    """Points of a cable of constant curvature that swings."""
    kappa = 2 * np.cos(8 * t)
    x = np.sin(kappa * s) / kappa
    y = (1 - np.cos(kappa * s)) / kappa
    return np.stack([0.2 + x, -0.2 - y, 0 * x][:d], axis=1)


def place(side: str, t: np.ndarray, d: int = 2) -> np.ndarray | None:
    return None if side == "end" else np.tile([0.2, -0.2, 0.0][:d], (len(t), 1))


@pytest.mark.parametrize(("d", "count"), [(2, 9), (2, 150), (3, 40)])
def test_marks_lie_on_their_lines(d: int, count: int) -> None:
    s = np.linspace(0.01, LENGTH, count)
    lines = MotionPoints(T, np.array([curve(t, s, d) for t in T]))
    lines.points[3] = np.nan
    marks, across = marks_of_lines(lines, lambda *x: place(*x, d), LENGTH)
    assert across.shape == (len(T), MARKS, d - 1, d)
    assert np.isnan(marks.points[3]).all()
    true = np.array([curve(t, marks.s, d) for t in T])
    off = (across @ (marks.points - true)[..., None])[..., 0]
    seen = np.isfinite(off[..., 0])
    assert seen.mean() > 0.85
    # A mean of ten points of 150 lies 2.4e-6 m inside of its arc, unless that is corrected.
    assert np.abs(off[seen]).max() < (1e-6 if count == 150 else 2e-5)


def test_a_hidden_stretch_is_not_compared() -> None:
    s = np.linspace(0.0, LENGTH, 80)
    s = s[(s < 0.15) | (s > 0.25)]
    marks, _ = marks_of_lines(MotionPoints(T, np.array([curve(t, s) for t in T])), place, LENGTH)
    hidden = np.isnan(marks.points[..., 0]).all(axis=0)
    assert set(np.flatnonzero(hidden)) <= set(np.flatnonzero((marks.s > 0.14) & (marks.s < 0.26)))
    assert hidden.sum() >= 4


def film(folder: Path, lost: tuple[int, ...] = (5,), rate: float = 60) -> None:
    """Twelve frames of a swing, some of them black."""
    shape = (380, 380)
    file = str(folder / "swing.avi")
    writer = cv2.VideoWriter(file, cv2.VideoWriter.fourcc(*"MJPG"), rate, shape[::-1])
    s = np.linspace(0.0, LENGTH, 300)
    cv2.imwrite(str(folder / "still.png"), drawing.draw(curve(0.0, s), shape=shape))
    for k, t in enumerate(T):
        picture = drawing.draw(curve(t, s), shape=shape)
        writer.write(0 * picture if k in lost else picture)
    writer.release()


def test_frames_of_a_video_are_read_as_photographs(tmp_path: Path) -> None:
    film(tmp_path)
    (tmp_path / "session.yaml").write_text(SESSION)
    config = load_config(tmp_path / "session.yaml")
    (motion,) = read_motions(config)
    assert motion.note == "11 of 12 frames read, 1 lost left out"
    np.testing.assert_allclose(motion.t, np.delete(T, 5), atol=2e-3)
    true = np.array([curve(t, motion.s) for t in motion.t])
    off = motion.deviations(true)
    assert np.nanmax(np.abs(off)) < 4e-4  # a fifth of a pixel
    assert np.isfinite(off).mean() > 0.85
    space = config.changed(experiment={"measurement": {"kind": "centerlines"}})
    with pytest.raises(dlo.MeasurementError, match="a video shows a cable before a board"):
        read_motions(space)
    (tmp_path / "swing.avi").write_bytes(b"RIFF....AVI ")
    with pytest.raises(dlo.MeasurementError, match="no frame that OpenCV can read"):
        read_motions(config)


def test_a_video_with_a_gap_is_refused(tmp_path: Path) -> None:
    film(tmp_path, lost=(3, 4, 5, 6, 7), rate=10)
    (tmp_path / "session.yaml").write_text(SESSION)
    config = load_config(tmp_path / "session.yaml")
    with pytest.raises(dlo.MeasurementError, match=r"from 0.20 to 0.80 s could be used.*5 lost"):
        read_motions(config)
