"""Draw figures without a screen: common parts, and how one becomes a file or part of a page."""

import io
import re
import textwrap
import xml.etree.ElementTree as ET
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from typing import Any

import matplotlib as mpl
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from dlo_casadi.report.scene import Mark, Room, Scene, seen
from dlo_casadi.session.outcome import Outcome
from dlo_casadi.show import style

# Stages that every figure compares.
STAGE_LINES: dict[str, dict[str, Any]] = {
    "before": {"color": style.ORANGE, "ls": "--"},
    "after": {"color": style.BLUE, "ls": "-"},
}
# A fixture is a line too short to be seen, with a marker at its first point.
_FIXTURE: dict[str, Any] = {"color": style.BLACK, "markevery": [0]}
_PAPER = {"fc": "white", "ec": "none", "alpha": 0.8, "pad": 0.5}
_LETTER: dict[str, Any] = {"ha": "center", "va": "center", "bbox": _PAPER}
# Style of each kind of mark in a scene.
STYLES: dict[str, dict[str, Any]] = {
    "grid": {"color": "#E3E3E3", "lw": 0.6},
    "shadow": {"color": "#9AA5B1", "lw": 1.0},
    "plumb": {"color": "#9AA5B1", "lw": 0.8, "ls": ":"},
    "world": {"color": style.GREY, "lw": 0.9},
    "weight": {"color": style.GREY, "lw": 0.9},
    "force": {"color": style.FORCE, "lw": 1.2},
    "force-read": {"color": style.BLACK, "lw": 1.0, "ls": ":"},
    "taken": {"color": "#9AA5B1", "lw": 1.2},
    "pulled": {"color": style.BLUE, "lw": 5, "solid_capstyle": "butt"},
    "pull": {"color": style.VERMILLION, "lw": 1.6},
    "next": {"color": style.VERMILLION, "lw": 2.2},
    "next-letter": _LETTER | {"color": style.VERMILLION, "fontsize": 10},
    "letter": _LETTER | {"color": style.GREY, "fontsize": 7},
    "marker": {"color": "#C9D0D8", "lw": 1.0},
    "obstacle": style.OBSTACLE,
    "contact": style.CONTACT,
    "axis-x": {"color": "#D0103A", "lw": 1.2},
    "axis-y": {"color": "#00805A", "lw": 1.2},
    "axis-z": {"color": "#3A3AD6", "lw": 1.2},
    "fixture start": _FIXTURE | {"marker": "s", "ms": 3},
    "fixture end": _FIXTURE | {"marker": "o", "ms": 3},
    "fixture clip": _FIXTURE | {"marker": "D", "mfc": "white", "ms": 5},
}

# Width [inch] of a chart: its text is as large as a footnote even on a phone.
WIDTH = 4.8
_SVG = "http://www.w3.org/2000/svg"


def inline_svg(drawing: Figure, name: str) -> str:
    """Return a figure as a part of a page on which several figures stand.

    An artist's gid becomes the id of its group, and its label the browser's tooltip. All other ids
    start with the `name` of the chart.
    """
    text = io.StringIO()
    with mpl.rc_context(style.STYLE | {"svg.fonttype": "none", "svg.hashsalt": name}):
        style.lay_out(drawing, 72)
        drawing.savefig(text, format="svg", metadata={"Date": None})
    root = ET.fromstring(text.getvalue())
    for unwanted in root[:2]:  # metadata, and a style sheet that would change the whole page
        root.remove(unwanted)
    root.attrib = {"viewBox": root.attrib["viewBox"]}
    told = {item.get_gid(): str(item.get_label()) for item in drawing.findobj() if item.get_gid()}
    defined = {node.get("id") for part in root.iter(f"{{{_SVG}}}defs") for node in part.iter()}
    for node in root.iter():
        if node.get("id") in told:
            title = ET.Element(f"{{{_SVG}}}title")
            title.text = told[node.get("id")]
            node.insert(0, title)
        elif node.get("id") not in defined:
            node.attrib.pop("id", None)
        if "d" in node.attrib:
            node.set("d", re.sub(r"(\.\d\d)\d+", r"\1", node.attrib["d"]))
    ET.register_namespace("", _SVG)
    ET.register_namespace("xlink", "http://www.w3.org/1999/xlink")
    return ET.tostring(root, encoding="unicode")


@contextmanager
def chart(
    outcome: Outcome, said: str, height: float, panels: int = 1, width: float = WIDTH
) -> Iterator[tuple[Figure, list[Axes]]]:
    """Open a figure of a run with panels below one another and a headline no wider than it."""
    with style.styled((width, height)) as drawing:
        yield drawing, list(drawing.subplots(panels, 1, squeeze=False, sharex=True)[:, 0])
        text, letters = f"{outcome.config.cable.name}: {said}", int(12 * width)
        drawing.suptitle(textwrap.fill(text, letters, break_on_hyphens=False), fontsize=11)


def line_of(label: str, **style: Any) -> Line2D:
    """Make a line for a legend."""
    return Line2D([], [], label=label, **style)


def dot(label: str, marker: str, color: str, fill: str = "") -> Line2D:
    """Make a marker for a legend."""
    fill = fill or ("white" if marker == "D" else color)
    return line_of(label, ls="none", ms=7, marker=marker, color=color, mfc=fill)


def draw_marks(axes: Axes, marks: Iterable[Mark]) -> None:
    """Draw the marks of a room seen from a corner, or of a board."""
    for mark in marks:
        points = seen(mark.points)
        if mark.label:
            axes.text(points[0, 0], points[0, 1], mark.label, **STYLES[mark.kind])
        elif mark.kind in STYLES:
            axes.plot(*points.T, **STYLES[mark.kind])


def frame(axes: Axes, scene: Scene) -> None:
    """Show the whole room without ticks (the floor's squares give the scale), or the board."""
    if not isinstance(scene, Room):
        axes.set_aspect("equal", adjustable="datalim")
        axes.set(xlabel="x [m]", ylabel="y [m]")
        return
    width, height = scene.window / 2
    axes.set(xlim=(-width, width), ylim=(-height, height), xticks=[], yticks=[])
    axes.grid(visible=False)
    axes.spines[:].set_visible(False)
    axes.set_aspect("equal")
