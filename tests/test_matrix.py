"""Sessions of every kind, drawn from the toolkit's own model, go all the way."""

from itertools import combinations

import pytest
from check_matrix import CELLS, Row, matching, run_cell, summary
from matrix.cells import admitted, covering, pairwise
from matrix.sessions import SMALL


def pairs(cells):
    """Every two levels, of different factors, that meet in some cells."""
    return {pair for cell in cells for pair in combinations(enumerate(cell), 2)}


def test_few_cells_hold_all_pairs_that_a_configuration_admits():
    assert pairs(pairwise()) == pairs(CELLS)
    assert len(pairwise()) < 40
    assert all(admitted(cell) for cell in CELLS)


def test_few_cells_hold_every_way_to_hold_a_cable_with_every_rest():
    def supports(cells):
        return {(cell.start, cell.end, cell.frame, cell.rest) for cell in cells}

    assert supports(pairwise()) == supports(CELLS)
    assert ("pinned", "pinned", "space", "bowed") in supports(pairwise())


def cells():
    """Those in which all pairs of levels meet; those that no level needs are long.

    Photographs have sessions of their own in tests/session and tests/stories. Cables in space
    between two ball joints, which take a minute, have scripts/check_ball_joints.py. Nine poses
    take nine times as long as one.
    """
    joints = ("pinned", "pinned", "space")
    quick = [
        cell
        for cell in pairwise()
        if cell.measured != "photographs"
        and "nine" not in cell
        and (cell.start, cell.end, cell.frame) != joints
    ]
    few = covering(quick, 1)
    for cell in pairwise():
        yield pytest.param(cell, id=cell.name, marks=[pytest.mark.long] * (cell not in few))


@pytest.mark.parametrize("cell", list(cells()))
def test_a_clean_session_goes_all_the_way(cell, tmp_path):
    """Check, fit, files, terminal, notebook, prediction, generated C; nothing hidden or found.

    An interval of 99 % misses one true stiffness of a hundred: with this seed none.
    """
    row = run_cell(cell, SMALL, 0, tmp_path)
    assert not row.traceback, row.traceback
    assert not row.halves
    assert not row.refused
    assert not row.accused, row.text()
    assert not row.unstable
    assert row.inside_99


def test_what_is_wrong_is_told(monkeypatch, tmp_path):
    """A row of each kind, and a run in which something raises."""
    rows = [
        Row("pinned-pinned-plane-lines-straight-read-one-once", "complete", seconds=1.0),
        Row("pinned-pinned-plane-lines-straight-read-one-again", "complete", seconds=1.1),
        Row("pinned-free-plane-lines-straight-read-one-once", "unexplained", seconds=4.0),
        Row("pinned-free-plane-lines-straight-read-one-again", refused="no", seconds=1.0),
        Row("clamped-free-plane-lines-curved-read-one-once", "complete", inside_99=False),
        Row("pinned-pinned-space-lines-bowed-read-one-once", "complete", unstable=["pose_01"]),
    ]
    told = "\n".join(summary(rows))
    assert "1 clean and refused\n  pinned-free-plane-lines-straight-read-one-again" in told
    assert "1 clean and accused\n  pinned-free-plane-lines-straight-read-one-once" in told
    assert "1 with EI outside of its 99 % interval\n  clamped-free" in told
    assert "1 with a pose whose equilibrium is not stable\n  pinned-pinned-space" in told
    assert "1 slower than 3 times the median of their kind\n  pinned-free" in told

    monkeypatch.setattr("check_matrix.dlo.fit", lambda path: 1 / 0)
    (cell,) = matching(CELLS, rows[0].name)
    assert "ZeroDivisionError" in run_cell(cell, SMALL, 0, tmp_path).traceback
