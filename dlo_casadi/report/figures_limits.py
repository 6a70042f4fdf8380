"""The picture of limits: how much of each is used along the cable, pose by pose."""

import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.collections import LineCollection
from matplotlib.colors import LinearSegmentedColormap, Normalize
from matplotlib.figure import Figure

from dlo_casadi.cable.limits import LimitCheck
from dlo_casadi.report import canvas
from dlo_casadi.session.outcome import Outcome
from dlo_casadi.show import style

# Share of a limit -> colour: pale while there is room, dark red at and beyond the limit.
_USED = LinearSegmentedColormap.from_list(
    "used", [(0.0, "#E8EEF3"), (0.5, "#F2D9A0"), (0.8, "#E08A2B"), (1.0, style.VERMILLION)]
)
_COLORS = {"pass": style.GREEN, "risk": style.ORANGE, "fail": style.VERMILLION}


def limits_figure(outcome: Outcome) -> Figure:
    """A row for each limit of each pose: the cable from start to end, coloured by use."""
    checks = sorted(outcome.limits, key=lambda item: item.quantity)
    names = list(dict.fromkeys(item.quantity for item in checks))
    gaps = {item: k + names.index(item.quantity) for k, item in enumerate(checks)}
    height = 1.8 + 0.22 * (len(checks) + len(names))
    length = outcome.config.cable.length
    with canvas.chart(
        outcome, "how much of each limit is used, how likely it is violated", height
    ) as (drawing, (axes,)):
        for item, row in gaps.items():
            _draw_row(axes, item, -row, length)
        labels = [f"{item.label}  {item.pose}" for item in checks]
        axes.set_yticks([-row for row in gaps.values()], labels, fontsize=8)
        axes.set_ylim(-max(gaps.values()) - 0.7, 0.7)
        axes.set_xlim(-0.03 * length, 1.03 * length)
        axes.set_xlabel("from start to end [m]")
        axes.grid(visible=False)
        scale = ScalarMappable(Normalize(0.0, 1.0), _USED)
        bar = drawing.colorbar(scale, ax=axes, location="bottom", aspect=40, pad=0.02)
        bar.set_label("share of the limit", fontsize=8)
    return drawing


def _draw_row(axes: Axes, item: LimitCheck, y: float, length: float) -> None:
    """The cable of one pose as a bar, or its fixtures as dots; at the right the probability."""
    used = np.clip(item.used, 0.0, 1.0)
    if item.holder:
        axes.plot([0.0, length], [y, y], color="#E3E3E3", lw=1, zorder=1)
        axes.scatter(item.s, np.full(len(used), y), c=_USED(used), s=45, marker="s", zorder=2)
    else:
        ends = np.stack([item.s, np.full(len(used), y)], axis=1)
        parts = np.stack([ends[:-1], ends[1:]], axis=1)
        colors = _USED((used[:-1] + used[1:]) / 2)
        axes.add_collection(LineCollection(list(parts), colors=colors, lw=8, capstyle="butt"))
    axes.plot(item.at, y, "o", mfc="none", mec=style.BLACK, ms=9, mew=1.2, zorder=3)
    axes.annotate(
        item.chance,
        (1.0, y),
        xycoords=("axes fraction", "data"),
        xytext=(4, 0),
        textcoords="offset points",
        va="center",
        fontsize=8,
        color=_COLORS[item.verdict],
    )
