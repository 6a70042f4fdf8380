"""Draw one shape: the cable, its forces on fixtures, and obstacles as lines."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from dlo_casadi.arrays import FloatArray
from dlo_casadi.rod.obstacles import Obstacle, Plane
from dlo_casadi.show import style

# Shares of a shape's extent: longest arrow, distance of a number from its arrow's tip, and the
# smallest half width of a band that is visible beside the line.
_LONGEST, _NUMBER, _VISIBLE = 0.25, 0.1, 0.008


def draw_shape(
    points: FloatArray,
    forces: Mapping[str, FloatArray],
    *,
    clips: Mapping[str, tuple[FloatArray, FloatArray]],
    band: FloatArray | None,
    other: FloatArray | None,
    obstacles: Sequence[FloatArray] = (),
    touching: Sequence[tuple[FloatArray, FloatArray]] = (),
    title: str,
    remark: str,
    alarming: bool,
) -> Figure:
    """Draw a shape (K, d) [m] with the forces (d,) [N] on its ends "start" and "end".

    `clips`: positions (d,) [m] of clips and the forces on them, by name. `band` (K,) [m]: half
    widths about a shape in a plane. `other` (K, d) [m]: the shape on the other side. `obstacles`:
    lines (n, d) [m] that show them. `touching`: pieces (n, d) [m] of the cable that touch one, n
    odd, and the forces on it.
    """
    ends = {"start": (points[0], "s"), "end": (points[-1], "o")}
    drawn: list[tuple[str | None, FloatArray, str, FloatArray]]
    drawn = [(name, *ends[name], force) for name, force in forces.items()]
    drawn += [(name, place, "D", force) for name, (place, force) in clips.items()]
    drawn += [(None, stretch[len(stretch) // 2], "", force) for stretch, force in touching]
    largest = max(float(np.linalg.norm(force)) for *_, force in drawn)
    extent = float(np.ptp(points, axis=0).max())
    reach = _LONGEST * extent / max(largest, 1e-12)
    with style.styled((7.0, 6.0)) as drawing:
        axes: Any = drawing.add_subplot(projection="3d" if points.shape[1] == 3 else None)
        if band is not None:
            outline = style.band_outline(points, band)
            label = "90 % of repeats" if band.max() > _VISIBLE * extent else None
            axes.fill(*outline.T, color=style.BLUE, alpha=0.15, lw=0, label=label)
        for lines, look, label in (
            (obstacles, style.OBSTACLE, "obstacle"),
            ([stretch for stretch, _ in touching], style.CONTACT, "in contact"),
        ):
            for k, line in enumerate(lines):
                axes.plot(*line.T, **look, label=None if k else label)
        axes.plot(*points.T, color=style.BLUE, lw=2.5, label="cable")
        if other is not None:
            axes.plot(*other.T, "--", color=style.BLUE, lw=1.5, label="on the other side")
        for side, at, marker, force in drawn:
            axes.plot(*at[:, None], marker, color=style.BLACK, ms=7, label=side)
            size = float(np.linalg.norm(force))
            if size <= 1e-3 * largest or largest == 0:
                continue
            axes.plot(*style.arrow(at, reach * force).T, color=style.VERMILLION, lw=1.8)
            tip, along = at + reach * force, _NUMBER * extent * force / size
            paper = {"facecolor": "white", "edgecolor": "none", "alpha": 0.8, "pad": 0.5}
            number = axes.text(
                *(tip + along), f"{size:.3g} N", ha="center", va="center", bbox=paper
            )
            number.set_color(style.VERMILLION)
            axes.plot(
                *(tip + 2 * along)[:, None], alpha=0
            )  # a text does not affect the axes' limits
        axes.set_aspect("equal", adjustable="datalim")
        axes.margins(0.12)
        axes.set(**{f"{axis}label": f"{axis} [m]" for axis in "xyz"[: points.shape[1]]})
        held = "fixtures and obstacles" if touching else "the fixtures"
        axes.plot([], [], color=style.VERMILLION, label=f"force on {held}")
        few = other is None and len(clips) < 2 and not obstacles
        drawing.legend(loc="outside lower center", ncols=5 if few else 3)
        axes.set_title(remark, color=style.VERMILLION if alarming else style.GREY)
        drawing.suptitle(title, fontsize=12)
    return drawing


# Points per circle; hatching strokes on the inner side of a planar surface; lines of the net on a
# surface in space, in each direction.
_CIRCLE, _STROKES, _NET = 33, 24, 7
# Distance by which surfaces extend beyond the cable, and length of a stroke, in cable lengths.
_BEYOND, _STROKE = 0.06, 0.025

# Half the smallest drawn length of a contact, so that a point is visible.
_SEEN = 0.006


def touching(start: float, end: float, length: float) -> FloatArray:
    """Arc lengths (21,) [m] of the line that shows a contact from `start` to `end` [m]."""
    middle, half = (start + end) / 2, (end - start) / 2
    s = middle + max(half, _SEEN * length) * np.linspace(-1.0, 1.0, 21)
    return np.clip(s, 0.0, length)


def outlines(obstacle: Obstacle, points: FloatArray, length: float) -> list[FloatArray]:
    """Lines (K, d) [m] that show an obstacle near points (n, d) [m] of a cable of a length [m].

    Of a plane, and of a long bar, only the part near the cable is drawn.
    """
    if isinstance(obstacle, Plane):
        return _plane(obstacle, points, length)
    a, axis = np.array(obstacle.a), np.subtract(obstacle.b, obstacle.a)
    size = float(np.linalg.norm(axis))
    if len(a) == 2:
        along = axis / size if size else np.array([1.0, 0.0])
        half = np.linspace(-np.pi / 2, np.pi / 2, _CIRCLE)
        caps = [
            _arc(end, sign * along, sign * _turned(along), obstacle.radius, half)
            for end, sign in ((obstacle.b, 1), (obstacle.a, -1))
        ]
        return [np.concatenate([*caps, caps[0][:1]])]
    along = axis / size if size else np.eye(3)[2]
    aside = np.eye(3)[np.abs(along).argmin()]
    aside = np.cross(along, aside) / np.linalg.norm(np.cross(along, aside))
    across = aside, np.cross(along, aside)
    low, high = _extent(points - a, along, length)
    ends = [a + np.clip(x, 0.0, size) * along for x in (low, high)]
    round_, half = np.linspace(0, 2 * np.pi, _CIRCLE), np.linspace(-np.pi / 2, np.pi / 2, _CIRCLE)
    lines = [_arc(end, *across, obstacle.radius, round_) for end in ends]
    for x in (*across, *(-one for one in across)):
        lines.append(np.stack([end + obstacle.radius * x for end in ends]))
    for end, sign, shown in ((ends[1], 1, high > size), (ends[0], -1, low < 0)):
        if shown:
            lines += [_arc(end, sign * along, x, obstacle.radius, half) for x in across]
    return lines


def _plane(plane: Plane, points: FloatArray, length: float) -> list[FloatArray]:
    """The part of a plane near points: a hatched line, or a net in space."""
    normal, foot = np.array(plane.normal), np.array(plane.point)
    if len(normal) == 2:
        along = _turned(normal)
        low, high = _extent(points - foot, along, length)
        at = foot + np.linspace(low, high, _STROKES)[:, None] * along
        inside = at - _STROKE * length * (normal + along)
        return [np.stack([at, inside, at], axis=1).reshape(-1, 2)]
    level = np.cross(np.eye(3)[np.abs(normal).argmin()], normal)
    axes = level / np.linalg.norm(level), np.cross(normal, level / np.linalg.norm(level))
    ranges = [np.linspace(*_extent(points - foot, axis, length), _NET) for axis in axes]
    lines = []
    for k in (0, 1):
        for x in ranges[k]:
            ends = ranges[1 - k][[0, -1], None] * axes[1 - k]
            lines.append(foot + x * axes[k] + ends)
    return lines


def _extent(points: FloatArray, axis: FloatArray, length: float) -> tuple[float, float]:
    """Range [m] along an axis of points (n, d), with a margin."""
    along, more = points @ axis, _BEYOND * length
    return float(along.min()) - more, float(along.max()) + more


def _turned(x: FloatArray) -> FloatArray:
    """Rotate a vector (2,) by a quarter turn."""
    return np.array([-x[1], x[0]])


def _arc(
    center: FloatArray | tuple[float, ...],
    x: FloatArray,
    y: FloatArray,
    radius: float,
    angles: FloatArray,
) -> FloatArray:
    """Points (k, d) of a circle at angles (k,) from the unit vector x toward y."""
    return np.array(center) + radius * (np.outer(np.cos(angles), x) + np.outer(np.sin(angles), y))
