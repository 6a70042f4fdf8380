"""What a part of the reproduction hands on: tables, figures, claims and targets."""

from __future__ import annotations

import io
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any, Literal

import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure as Drawing
from numpy.typing import NDArray

from dlo_casadi.show.style import styled

Verdict = Literal["holds", "in part", "does not hold", "cannot be told"]


@dataclass
class Table:
    """Text in rows and columns; `groups` are (heading, number of columns) above the columns."""

    caption: str
    columns: list[str]
    rows: list[list[str]]
    note: str = ""
    groups: list[tuple[str, int]] = field(default_factory=list)


@dataclass
class Picture:
    """A drawing in the page: file name without ending, caption, SVG text."""

    name: str
    caption: str
    svg: str


@dataclass
class Section:
    """A heading with what belongs to it."""

    anchor: str
    title: str
    text: list[str] = field(default_factory=list)
    tables: list[Table] = field(default_factory=list)
    pictures: list[Picture] = field(default_factory=list)


@dataclass
class Claim:
    """Something that the paper says, and what was found here."""

    where: str
    says: str
    found: str
    verdict: Verdict


@dataclass
class Target:
    """A number that this toolkit must reach."""

    name: str
    limit: str
    value: str
    met: bool


@dataclass
class Part:
    """All that one part of the script has found; `data` are plain numbers for paper.json."""

    name: str
    sections: list[Section] = field(default_factory=list)
    claims: list[Claim] = field(default_factory=list)
    targets: list[Target] = field(default_factory=list)
    data: dict[str, Any] = field(default_factory=dict)
    seconds: float = 0.0


@contextmanager
def drawing(
    section: Section, name: str, caption: str, size: tuple[float, float]
) -> Iterator[Drawing]:
    """Open a figure of a size [inch] that is added to a section when it is drawn."""
    with styled(size) as figure:
        yield figure
        text = io.StringIO()
        # Equal drawings are equal files.
        with mpl.rc_context({"svg.hashsalt": name}):
            figure.savefig(text, format="svg", metadata={"Date": None})
    section.pictures.append(Picture(name, caption, text.getvalue()))


def rms(values: NDArray[np.floating]) -> float:
    """Root mean square."""
    return float(np.sqrt((values**2).mean()))


def number(value: float | None, digits: int = 2) -> str:
    """A number for a table; nothing if it was not computed."""
    if value is None:
        return ""
    return f"{value:.{digits}f}".replace("-", "−")


def mm(value: float | None, digits: int = 2) -> str:
    """A length [m] in millimetres."""
    return number(None if value is None else 1e3 * value, digits)


def duration(seconds: float | None) -> str:
    """A time in a unit that suits it."""
    if seconds is None:
        return ""
    for unit, scale in (("s", 1.0), ("ms", 1e-3), ("µs", 1e-6)):
        if seconds >= scale:
            return f"{seconds / scale:.3g} {unit}"
    return f"{1e9 * seconds:.3g} ns"
