"""The recorded motions: where the last marker was and where the model has it, and the error."""

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from dlo_casadi.arrays import FloatArray
from dlo_casadi.report import canvas
from dlo_casadi.session.in_motion import MotionShown
from dlo_casadi.session.outcome import Outcome
from dlo_casadi.show import style

# Height of a motion's row [inch].
_ROW = 1.5


def motion_figure(outcome: Outcome) -> Figure | None:
    """Distance of the last marker from its mean place, and the error of all markers, over time."""
    stages = [stage.motion for stage in outcome.stages if stage.motion]
    if not stages:
        return None
    last, before = stages[-1], stages[0] if len(stages) > 1 else None
    size = canvas.WIDTH, len(last.shown) * _ROW + 0.8
    with style.styled(size) as drawing:
        axes = drawing.subplots(len(last.shown), 2, sharex=True, squeeze=False)
        noise = 1e3 * last.noise * np.sqrt(last.shown[0].compared)
        for k, (item, (left, right)) in enumerate(zip(last.shown, axes, strict=True)):
            _draw_path(left, item)
            if before is not None:
                right.plot(item.t, _error(before.shown[k]), color=style.HELD_OUT, lw=1)
            right.plot(item.t, _error(item), color=style.BLUE, lw=1)
            right.axhline(noise, color="#C8C8C8", lw=1)
            right.set_ylim(bottom=0)
        axes[0, 1].set_title("RMS distance [mm]", loc="left", fontsize=9)
        for one in axes[-1]:
            one.set_xlabel("time [s]")
    return drawing


def _draw_path(axes: Axes, item: MotionShown) -> None:
    """The last marker along the direction in which it moves most [mm]."""
    seen = item.measured[:, -1]
    aside, middle = _aside(seen), np.nanmean(seen, axis=0)
    axes.plot(item.t, 1e3 * (seen - middle) @ aside, ".", ms=2, color="#9AA5AF")
    axes.plot(item.t, 1e3 * (item.predicted[:, -1] - middle) @ aside, color=style.BLUE, lw=1)
    held_out = " (held out)" if item.role == "held_out" else ""
    axes.set_title(f"{item.name}{held_out} [mm]", loc="left", fontsize=9)


def _error(item: MotionShown) -> FloatArray:
    """Root mean square distance (T,) [mm] of the markers at each time."""
    return np.asarray(1e3 * np.sqrt(np.nanmean(item.distances**2, axis=1)))


def _aside(places: FloatArray) -> FloatArray:
    """Direction (d,) in which places (T, d) vary most."""
    known = places[np.isfinite(places).all(axis=1)]
    _, vectors = np.linalg.eigh(np.cov(known.T))
    return np.asarray(vectors[:, -1])
