"""A recorded motion and its prediction as a moving picture: SVG that plays by itself."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from markupsafe import Markup, escape

from dlo_casadi.arrays import FloatArray
from dlo_casadi.session.in_motion import MotionShown
from dlo_casadi.show.swinging import side_view

# Frames a second, longest time [s] that is shown, and number of pixels of the larger side.
_FRAMES, _LONGEST, _SIZE = 25, 6.0, 420
# Margin around all points, as a share of the larger side.
_MARGIN = 0.06


@dataclass(frozen=True)
class MovingPicture:
    """What the page shows: a title, the SVG, and the time [s] that it takes."""

    title: str
    svg: Markup
    duration: float


def moving_picture(shown: Sequence[MotionShown]) -> MovingPicture | None:
    """The first held-out motion that was predicted, or else the first one; None if none was."""
    known = [one for one in shown if np.isfinite(one.predicted).all()]
    if not known:
        return None
    one = next((x for x in known if x.role == "held_out"), known[0])
    duration = min(float(one.t[-1]), _LONGEST)
    times = np.arange(0.0, duration, 1 / _FRAMES)
    nearest = np.abs(one.t[:, None] - times).argmin(axis=0)
    view = side_view(one.predicted)
    measured, predicted = one.measured @ view, one.predicted @ view
    points = np.concatenate([measured.reshape(-1, 2), predicted.reshape(-1, 2)])
    low, high = np.nanmin(points, axis=0), np.nanmax(points, axis=0)
    margin = _MARGIN * float((high - low).max())
    scale = _SIZE / (float((high - low).max()) + 2 * margin)
    width, height = np.ceil((high - low + 2 * margin) * scale).astype(int)

    def pixels(x: FloatArray) -> FloatArray:
        return np.stack([x[..., 0] - low[0] + margin, high[1] + margin - x[..., 1]], -1) * scale

    held_out = ", held out" if one.role == "held_out" else ""
    title = f"{one.name}{held_out}: measured (dots) and predicted (line), in real time"
    body = "".join(_parts(pixels(measured[nearest]), pixels(predicted[nearest]), duration))
    svg = (
        f'<svg viewBox="0 0 {width} {height}" role="img" aria-label="{escape(title)}">{body}</svg>'
    )
    return MovingPicture(title, Markup(svg), duration)  # numbers and escaped text


def _parts(measured: FloatArray, predicted: FloatArray, duration: float) -> Iterator[str]:
    """The line, then a dot for each point, hidden while it is not seen."""
    every = f'dur="{duration:.2f}s" repeatCount="indefinite" calcMode="discrete"'

    def joined(row: FloatArray) -> str:
        return " ".join(f"{x:.1f},{y:.1f}" for x, y in row)

    lines = [joined(row) for row in predicted]
    yield (
        f'<polyline fill="none" stroke="#0072B2" stroke-width="2.5" points="{lines[0]}">'
        f'<animate attributeName="points" values="{";".join(lines)}" {every}/></polyline>'
    )
    for k in range(measured.shape[1]):
        path = measured[:, k]
        seen = np.isfinite(path[:, 0])
        if not seen.any():
            continue
        # Where it was not seen it waits beyond the picture.
        path = np.where(seen[:, None], path, -100.0)
        animated = "".join(
            f'<animate attributeName="{name}" values="{";".join(f"{x:.1f}" for x in column)}" '
            f"{every}/>"
            for name, column in zip(("cx", "cy"), path.T, strict=True)
        )
        x, y = path[0]
        yield f'<circle cx="{x:.1f}" cy="{y:.1f}" r="3" fill="#5B6670">{animated}</circle>'
