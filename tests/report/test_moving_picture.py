"""The moving picture of a recorded motion."""

import re

import numpy as np

from dlo_casadi.report.moving_picture import moving_picture
from dlo_casadi.session.in_motion import MotionShown

T = np.arange(0, 1, 0.02)


def shown(name: str, role: str, d: int = 2, *, lost: bool = False) -> MotionShown:
    """Three points that swing along x (or the diagonal of x and y), one not seen for a while."""
    x = 0.1 * np.sin(6 * T)[:, None] * [1.0, 2.0, 3.0]
    ways = [x, x, 0 * x - [1, 2, 3]] if d == 3 else [x, 0 * x - [1, 2, 3]]
    predicted = np.stack(ways, axis=-1)
    measured = predicted.copy()
    measured[10:20, 1] = np.nan
    if lost:
        predicted = np.full_like(predicted, np.nan)
    off = np.linalg.norm(predicted - measured, axis=2)
    return MotionShown(name, role, T, np.arange(3.0), measured, predicted, off, d)


def test_the_held_out_motion_moves_as_it_did() -> None:
    for d in (2, 3):
        picture = moving_picture([shown("a", "fit", d), shown("b<", "held_out", d)])
        assert picture is not None
        assert picture.title.startswith("b<, held out")
        assert 'aria-label="b&lt;, held out' in picture.svg
        (line,) = re.findall(r'attributeName="points" values="([^"]*)"', picture.svg)
        frames = [[p.split(",") for p in f.split()] for f in line.split(";")]
        path = np.array(frames, dtype=float)
        assert path.shape == (25, 3, 2)
        tips = re.findall(r'attributeName="cx" values="([^"]*)"', picture.svg)
        measured = np.array([row.split(";") for row in tips], dtype=float).T
        seen = measured > 0
        assert (~seen).sum(axis=0).tolist() == [0, 5, 0]
        np.testing.assert_allclose(measured[seen], path[..., 0][seen], atol=0.11)
        assert np.ptp(path[:, 2, 0]) > 2 * np.ptp(path[:, 0, 0])


def test_without_a_prediction_there_is_no_picture() -> None:
    assert moving_picture([shown("a", "held_out", lost=True)]) is None
    picture = moving_picture([shown("a", "held_out", lost=True), shown("b", "fit")])
    assert picture is not None
    assert picture.title.startswith("b: ")
