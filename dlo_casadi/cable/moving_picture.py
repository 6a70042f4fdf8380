"""Pictures of a moving cable: instants in one drawing, and moving ones as GIF."""

from collections.abc import Mapping, Sequence
from io import BytesIO
from typing import Any

import numpy as np
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from matplotlib.ticker import NullFormatter, StrMethodFormatter
from PIL import Image

from dlo_casadi.arrays import FloatArray
from dlo_casadi.show import style

# Instants of a drawing; frames a second and smallest number of pixels across of a moving picture.
_INSTANTS, _FRAMES, _DPI = 9, 25, 80
# Displacement of a drawn mode as a share of the shape's extent.
_SHOWN = 0.12
# Swing [mm] at which bars begin to show.
_LEAST_MM = 1e-3


def draw_motion(
    points: FloatArray, t: FloatArray, title: str, clips: FloatArray, *, tip: bool
) -> Figure:
    """Draw instants of a motion (T, K, d) [m] from light to dark, and clips (k, d) [m].

    `tip`: and its way.
    """
    with style.styled((7.0, 6.0)) as drawing:
        axes = _axes(drawing, points)
        picked = np.unique(np.linspace(0, len(t) - 1, _INSTANTS).round().astype(int))
        for share, k in zip(np.linspace(0.15, 1.0, len(picked)), picked, strict=True):
            color = 1 - share * (1 - np.array(to_rgb(style.BLUE)))
            axes.plot(*points[k].T, color=color, lw=2.0)
        if tip:
            axes.plot(*points[:, -1].T, color=style.VERMILLION, lw=1.0, label="way of the tip")
        axes.plot(
            *points[picked[0], 0][:, None], "s", color=style.BLACK, ms=7, label="start at first"
        )
        if len(clips):
            axes.plot(*clips.T, "D", color=style.BLACK, ms=6, label="clips")
        axes.set_title(f"{len(picked)} instants, light to dark: {t[0]:.3g} to {t[-1]:.3g} s")
        drawing.legend(loc="outside lower center", ncols=3)
        drawing.suptitle(title, fontsize=12)
    return drawing


def draw_move(
    points: FloatArray, t: FloatArray, duration: float, swings: Mapping[str, float]
) -> Figure:
    """Draw a motion (T, K, d) [m] until it arrives, and swings [mm] by name as bars."""
    with style.styled((10.0, 5.0)) as drawing:
        axes = _axes(drawing, points, (1, 2, 1))
        picked = np.linspace(0, np.searchsorted(t, duration), _INSTANTS).round().astype(int)
        for share, k in zip(np.linspace(0.15, 1.0, len(picked)), picked, strict=True):
            axes.plot(*points[k].T, color=1 - share * (1 - np.array(to_rgb(style.BLUE))), lw=2.0)
        axes.set_title(f"{len(picked)} instants, light to dark, in {duration:.3g} s")
        bars = drawing.add_subplot(1, 2, 2)
        bars.barh(list(swings), np.maximum(list(swings.values()), _LEAST_MM), color=style.BLUE)
        bars.set(xscale="log", xlabel="swing after arrival [mm]")
        bars.xaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
        bars.xaxis.set_minor_formatter(NullFormatter())
        bars.invert_yaxis()
        for k, value in enumerate(swings.values()):
            bars.annotate(f" {value:.3g}", (max(value, _LEAST_MM), k), va="center")
        bars.margins(x=0.15)
    return drawing


def draw_modes(points: FloatArray, modes: FloatArray, names: Sequence[str], title: str) -> Figure:
    """Draw modes (M, K, d) of a shape (K, d) [m], each to both sides."""
    rows = -(-len(modes) // 3)
    size = _SHOWN * float(np.ptp(points, axis=0).max())
    with style.styled((9.0, 3.2 * rows + 0.6)) as drawing:
        for k, (mode, name) in enumerate(zip(modes, names, strict=True)):
            both = np.stack([points + size * mode, points - size * mode])
            axes = _axes(drawing, both, (rows, min(3, len(modes)), k + 1))
            for line in both:
                axes.plot(*line.T, color=style.BLUE, lw=1.4)
            axes.plot(*points.T, color=style.GREY, lw=1.0)
            axes.set_title(name)
        drawing.suptitle(title, fontsize=12)
    return drawing


def moving_picture(points: FloatArray, t: FloatArray, title: str, clips: FloatArray) -> bytes:
    """A motion (T, K, d) [m], evenly spaced in time, and clips (k, d) [m] as a GIF in real time."""
    frames = []
    with style.styled((5.5, 5.0)) as drawing:
        axes = _axes(drawing, points)
        (line,) = axes.plot(*points[0].T, color=style.BLUE, lw=2.5)
        axes.plot(*points[0, 0][:, None], alpha=0)
        if len(clips):
            axes.plot(*clips.T, "D", color=style.BLACK, ms=6)
        drawing.suptitle(title, fontsize=11)
        axes.set_title(f"{t[0]:.2f} s")
        style.lay_out(drawing, _DPI)
        for now, here in zip(t.tolist(), points, strict=True):
            line.set_data(*here.T[:2])
            if here.shape[1] == 3:
                line.set_3d_properties(here[:, 2])
            axes.set_title(f"{now:.2f} s")
            drawing.canvas.draw()
            canvas: Any = drawing.canvas
            frames.append(Image.fromarray(np.asarray(canvas.buffer_rgba())[..., :3]))
    stream, first = BytesIO(), frames[0]
    lasting = round(1000 * float(t[-1] - t[0]) / max(len(t) - 1, 1))
    options: dict[str, Any] = {"save_all": True, "append_images": frames[1:], "loop": 0}
    first.save(stream, format="GIF", duration=max(lasting, 20), **options)
    return stream.getvalue()


def frame_times(first: float, last: float) -> FloatArray:
    """Times [s] of the frames of a moving picture."""
    return np.linspace(first, last, max(2, round((last - first) * _FRAMES) + 1))


def _axes(drawing: Figure, points: FloatArray, place: tuple[int, int, int] = (1, 1, 1)) -> Any:
    """Axes of equal scale that hold all points (..., d)."""
    d = points.shape[-1]
    axes: Any = drawing.add_subplot(*place, projection="3d" if d == 3 else None)
    flat = points.reshape((-1, d))
    middle, half = (
        (flat.max(axis=0) + flat.min(axis=0)) / 2,
        0.55 * float(np.ptp(flat, axis=0).max()),
    )
    for k, axis in enumerate("xyz"[:d]):
        axes.set(
            **{f"{axis}lim": (middle[k] - half, middle[k] + half), f"{axis}label": f"{axis} [m]"}
        )
    axes.set_aspect("equal")
    return axes
