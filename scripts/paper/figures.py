"""Figures 3 to 5 of the paper, on the replica."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from numpy.typing import NDArray

from dlo_casadi.equilibrium.curve import NodeCurve
from dlo_casadi.show.style import BLACK, BLUE, GREEN, GREY, ORANGE, VERMILLION
from paper import published
from paper.content import Section, drawing
from paper.fits import ELEMENTS, FIRST, LABELS, Estimate, Method, pick
from paper.replica import PLACES, Replica

FloatArray = NDArray[np.floating]

COLORS: dict[Method, str] = {
    "guess": GREY,
    "loop": VERMILLION,
    "link": ORANGE,
    "arc": BLUE,
    "quadratic": GREEN,
}
MARKERS: dict[Method, str] = {"guess": "x", "loop": "s", "link": "v", "arc": "o", "quadratic": "D"}
# Deviations are drawn on an axis that is linear up to so many millimetres.
LINEAR_MM = 0.05


def deviation(truth: FloatArray, shape: FloatArray) -> FloatArray:
    """Normal distance (k,) [m] of true points from a shape, to the left of its direction."""
    curve = NodeCurve(published.LENGTH, shape, None)
    s = curve.nearest(truth)
    return ((truth - curve.at(s)) * curve.normals(s)[:, 0]).sum(axis=1)


def shapes(section: Section, replica: Replica, estimates: Sequence[Estimate]) -> None:
    """Figure 3: one pose for several n, with the deviations, which are too small to be seen."""
    pose = 0
    name = published.poses()[pose].name
    caption = (
        f"Figure 3 on the replica: the pose {name} m for several n. Below, how far the true "
        "shape lies from each, logarithmic beyond 0.05 mm."
    )
    methods: tuple[Method, ...] = ("guess", "loop", "arc")
    with drawing(section, f"figure-3-{replica.name}", caption, (11.0, 5.4)) as figure:
        axes = figure.subplots(2, len(published.MESHES), sharey="row")
        for column, n in enumerate(published.MESHES):
            top, bottom = axes[0, column], axes[1, column]
            top.plot(*replica.truth[pose].T, color=BLACK, lw=3, alpha=0.35, label="truth")
            for method in methods:
                shape = pick(estimates, replica.name, method, n).shapes[pose]
                if np.isnan(shape).any():
                    continue
                line = {"color": COLORS[method], "label": LABELS[method], "lw": 1.1}
                top.plot(*shape.T, **line)
                gap = 1e3 * deviation(replica.truth[pose], shape)
                bottom.plot(PLACES, gap, **line)
            top.set_aspect("equal")
            top.set_title(f"n = {n}")
            _millimetre_axis(bottom)
            bottom.set_xlabel("s [m]")
        axes[0, 0].set_ylabel("y [m]")
        axes[1, 0].set_ylabel("deviation [mm]")
        handles, labels = axes[0, 0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside upper center", ncols=len(labels))


def _millimetre_axis(axes: Axes) -> None:
    axes.set_yscale("symlog", linthresh=LINEAR_MM)
    axes.set_yticks([-10, -1, -0.1, 0, 0.1, 1, 10], ["−10", "−1", "−0.1", "0", "0.1", "1", "10"])
    axes.axhline(0, color=GREY, lw=0.6)


def accuracy(section: Section, replica: Replica, estimates: Sequence[Estimate]) -> None:
    """Figure 4a: error against n."""
    caption = (
        "Figure 4a on the replica: average RMSE of the predicted shapes over the twelve poses. "
        "The printed errors are of photographs and of shapes pulled towards them."
    )
    with drawing(section, f"figure-4-{replica.name}", caption, (6.6, 4.2)) as figure:
        axes = figure.subplots()
        printed = published.table(5)
        axes.loglog(
            [row["n"] for row in printed],
            [1e3 * row["rmse_m"] for row in printed],
            *("*--",),
            color=BLACK,
            label="printed",
        )
        for method in ("guess", "loop", *ELEMENTS):
            values = [
                1e3 * np.nanmean(pick(estimates, replica.name, method, n).errors[:, 0])
                for n in published.MESHES
            ]
            axes.loglog(
                published.MESHES,
                values,
                marker=MARKERS[method],
                color=COLORS[method],
                label=LABELS[method],
            )
        axes.axhline(1e3 * replica.std, color=GREY, ls=":", lw=1)
        axes.annotate("noise of one point", (5, 1.08e3 * replica.std), color=GREY, fontsize=8)
        axes.set_xticks(published.MESHES, [str(n) for n in published.MESHES])
        axes.set_xticks([], minor=True)
        axes.set_xlabel("elements n")
        axes.set_ylabel("average RMSE [mm]")
        figure.legend(loc="outside right upper")


def predictions(section: Section, replica: Replica, estimates: Sequence[Estimate]) -> None:
    """Figure 5: both held-out poses at n = 10."""
    caption = (
        "Figure 5 on the replica: the two poses that were not in the fit, n = 10. Below, how far "
        "the true shape lies from each prediction."
    )
    methods: tuple[Method, ...] = ("guess", "loop", "arc")
    with drawing(section, f"figure-5-{replica.name}", caption, (8.0, 5.4)) as figure:
        axes = figure.subplots(2, 2, sharey="row")
        for column, pose in enumerate(published.HELD_OUT):
            top, bottom = axes[:, column]
            top.plot(*replica.measured[pose].points.T, ".", color=GREY, ms=1.5, label="measured")
            top.plot(*replica.truth[pose].T, color=BLACK, lw=3, alpha=0.35, label="truth")
            for method in methods:
                shape = pick(estimates, replica.name, method, FIRST, held_out=True).shapes[pose]
                if np.isnan(shape).any():
                    continue
                line = {"color": COLORS[method], "label": LABELS[method], "lw": 1.1}
                top.plot(*shape.T, **line)
                bottom.plot(PLACES, 1e3 * deviation(replica.truth[pose], shape), **line)
            top.set_aspect("equal")
            top.set_title(f"{published.poses()[pose].name} m")
            _millimetre_axis(bottom)
            bottom.set_xlabel("s [m]")
        axes[0, 0].set_ylabel("y [m]")
        axes[1, 0].set_ylabel("deviation [mm]")
        handles, labels = axes[0, 0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside upper center", ncols=len(labels))
