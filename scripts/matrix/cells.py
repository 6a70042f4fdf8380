"""Kinds of sessions: every combination, and few in which all pairs of levels meet."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations, product
from typing import NamedTuple


class Cell(NamedTuple):
    """One kind of session. A name is its levels, joined by dashes."""

    start: str
    end: str
    frame: str
    measured: str
    rest: str
    readings: str
    poses: str
    repeats: str

    @property
    def name(self) -> str:
        """Its levels."""
        return "-".join(self)


# In the order of the fields of a cell.
LEVELS = (
    ("pinned", "clamped"),
    ("pinned", "clamped", "free"),
    ("plane", "space"),
    ("lines", "markers", "photographs"),
    ("straight", "bowed", "curved"),
    ("unread", "read"),
    ("one", "two", "nine"),
    ("once", "again"),
)


def admitted(cell: Cell) -> bool:
    """Whether a configuration may say so: in space a ball joint and a free end hold no shape."""
    return (cell.start, cell.end, cell.frame) != ("pinned", "free", "space")


CELLS = tuple(cell for levels in product(*LEVELS) if admitted(cell := Cell(*levels)))


# Time of a run: by the number of its poses, for pictures that are drawn and read, in space.
POSES = {"one": 1, "two": 2, "nine": 9}
_PICTURES, _SPACE = 8, 2
# New sets of levels that a cell must have more than another to be worth that much more time.
_NEW_PER_TIME = 1 / 20


def cost(cell: Cell) -> float:
    """About how long a cell takes, in units of one pose of points in the plane."""
    pictures = _PICTURES if cell.measured == "photographs" else 1
    return POSES[cell.poses] * pictures * (_SPACE if cell.frame == "space" else 1)


def covering(
    cells: Sequence[Cell], levels: int, together: Sequence[Sequence[str]] = ()
) -> tuple[Cell, ...]:
    """Few of the cells in which every so many levels of different factors that meet in any meet.

    Greedily: each next one has the most that are new, less what its time counts for. `together`:
    names of factors of which all combinations are to occur, too.
    """

    def parts(cell: Cell) -> set[tuple[tuple[str, str], ...]]:
        own = {tuple((name, getattr(cell, name)) for name in names) for names in together}
        return own | set(combinations(zip(cell._fields, cell, strict=True), levels))

    sets = {cell: parts(cell) for cell in cells}
    missing = set().union(*sets.values())
    chosen: list[Cell] = []
    while missing:
        new = {cell: len(own & missing) for cell, own in sets.items() if own & missing}
        best = max(new, key=lambda cell: new[cell] - _NEW_PER_TIME * cost(cell))
        chosen.append(best)
        missing -= sets[best]
    return tuple(chosen)


def pairwise() -> tuple[Cell, ...]:
    """Few cells in which every two levels of different factors meet, and every support each rest.

    What holds a cable and its rest shape decide together which equilibria are stable: start, end
    and frame count as one factor there.
    """
    return covering(CELLS, 2, [("start", "end", "frame", "rest")])
