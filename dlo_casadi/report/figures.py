"""Figures of a run: residuals, rest curvature, errors, candidates, the unexplained load."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.ticker import LogLocator, StrMethodFormatter

from dlo_casadi.estimation.moment import LEAST_POINTS, law_of, measured_moment_curve
from dlo_casadi.report.canvas import (
    BLACK,
    BLUE,
    GREEN,
    GREY,
    HELD_OUT,
    NOISE_ALONE,
    ORANGE,
    SKY,
    VERMILLION,
    before_after,
    figure,
    label_of,
    millimetres,
)
from dlo_casadi.report.figures_room import draw_marks, frame_room
from dlo_casadi.report.geometry import (
    directions,
    measured_line,
    residual_along,
    residual_range,
    rest_about,
)
from dlo_casadi.report.scene import pull_marks, scene_of
from dlo_casadi.report.text_findings import finding_of
from dlo_casadi.session.outcome import Outcome

# A candidate that was not refitted.
_UNTRIED = "#C8C8C8"
# Behind a number that may lie on a line.
_PAPER = {"facecolor": "white", "edgecolor": "none", "pad": 1.0}


def write_figures(folder: Path, outcome: Outcome) -> None:
    """Draw residuals, parameters and findings, as far as there are any, into a folder."""
    if any(stage.shapes for stage in outcome.stages):
        draw_residuals(folder / "residuals.png", outcome)
        draw_rest_curvature(folder / "rest_curvature.png", outcome)
    if outcome.measurement.readings and outcome.stages[-1].shapes:
        draw_readings(folder / "readings.png", outcome)
    draw_errors(folder / "errors.png", outcome)
    if outcome.candidates:
        draw_candidates(folder / "candidates.png", outcome)
    if outcome.unexplained is not None:
        draw_unexplained(folder / "unexplained.png", outcome)
    if outcome.config.experiment.boundary.end == "free":
        draw_moment(folder / "moment.png", outcome)


# ---- residuals ---------------------------------------------------------------------------------


def draw_residuals(path: Path, outcome: Outcome) -> None:
    """Normal distance of the measured points from the prediction along the arc, in noise units."""
    before, after = before_after(outcome)
    stages = [stage for stage in (before, after) if stage is not None]
    panels = [(stage, direction) for stage in stages for direction in directions(outcome)]
    with figure(path, (8.5, 0.9 + 2.7 * len(panels))) as drawing:
        grid = drawing.subplots(len(panels), 1, squeeze=False, sharex=True)
        for axes, (stage, direction) in zip(grid[:, 0], panels, strict=True):
            axes.axhspan(-2, 2, color="#EDEDED", zorder=0)
            axes.axhline(0, color=GREY, lw=0.8)
            for pose in outcome.poses:
                shape = stage.shapes.get(pose.name)
                if shape is None:
                    continue
                held_out = pose.role == "held_out"
                axes.plot(
                    shape.s,
                    residual_along(shape, direction) / outcome.measurement.std,
                    color=HELD_OUT if held_out else BLUE,
                    lw=1.1,
                    alpha=0.85 if held_out else 0.45,
                    zorder=3 if held_out else 2,
                )
            chi2 = stage.chi2_per_dof
            quality = "" if chi2 is None else f" (chi-square per degree of freedom {chi2:.3g})"
            along = direction and f", along {direction}"
            axes.set_title(label_of(stage, outcome) + along + quality, loc="left")
            axes.set_ylabel("distance / noise")
            axes.set_ylim(residual_range(stage, outcome.measurement.std))
        grid[-1, 0].set_xlabel("arc length from the start s [m]")
        grid[-1, 0].set_xlim(0, outcome.config.cable.length)
        handles = [Line2D([], [], color=BLUE, label="fit pose")]
        if outcome.measurement.poses_held_out:
            handles.append(Line2D([], [], color=HELD_OUT, label="held-out pose"))
        handles.append(_noise_band())
        drawing.legend(handles=handles, loc="outside lower center", ncols=3)
        drawing.suptitle(
            f"{outcome.config.cable.name}: measured minus predicted, noise std "
            f"{millimetres(outcome.measurement.std)} ({outcome.measurement.std_source})",
            fontsize=12,
        )


# ---- readings ----------------------------------------------------------------------------------


def _noise_band() -> Line2D:
    return Line2D([], [], color="#EDEDED", lw=8, label="95 % of the noise lies within")


def draw_readings(path: Path, outcome: Outcome) -> None:
    """Forces and moments on the fixtures, measured minus predicted, in units of their noise."""
    stage = outcome.stages[-1]
    names = sorted({name for shape in stage.shapes.values() for name in shape.readings})
    poses = [x for x in outcome.poses if x.name in stage.shapes and stage.shapes[x.name].readings]
    with figure(path, (8.5, 0.9 + 2.4 * len(names))) as drawing:
        grid = drawing.subplots(len(names), 1, squeeze=False, sharex=True)
        for axes, name in zip(grid[:, 0], names, strict=True):
            std, unit = outcome.measurement.std_of(name.split("_")[1])
            axes.axhspan(-2, 2, color="#EDEDED", zorder=0)
            axes.axhline(0, color=GREY, lw=0.8)
            for k, pose in enumerate(poses):
                if name not in stage.shapes[pose.name].readings:
                    continue
                known, model = stage.shapes[pose.name].readings[name]
                color = HELD_OUT if pose.role == "held_out" else BLUE
                apart = 0.2 * (np.arange(len(known)) - (len(known) - 1) / 2)
                axes.plot(k + apart, (known - model) / std, ".-", color=color, lw=0.6, ms=6)
            count = len(
                next(x.readings[name][0] for x in stage.shapes.values() if name in x.readings)
            )
            parts = f"{', '.join('xyz'[:count])} from left to right, " if count > 1 else ""
            axes.set_title(f"{name}: {parts}noise {std:.3g} {unit}", loc="left")
            axes.set_ylabel("residual / noise")
        ticks = [pose.name for pose in poses]
        grid[-1, 0].set_xticks(range(len(poses)), ticks, rotation=60, ha="right", fontsize=8)
        handles = [Line2D([], [], color=BLUE, marker="o", ls="none", label="fit pose")]
        if any(pose.role == "held_out" for pose in poses):
            handles.append(
                Line2D([], [], color=HELD_OUT, marker="o", ls="none", label="held-out pose")
            )
        handles.append(_noise_band())
        drawing.legend(handles=handles, loc="outside lower center", ncols=3)
        drawing.suptitle(
            f"{outcome.config.cable.name}: readings, measured minus predicted "
            f"({label_of(stage, outcome)})",
            fontsize=12,
        )


# ---- rest curvature ----------------------------------------------------------------------------


def draw_rest_curvature(path: Path, outcome: Outcome) -> None:
    """Rest curvature of the last stage with its band, and of the fit that it improves on."""
    before, after = before_after(outcome)
    shown = directions(outcome)
    with figure(path, (8.5, 3.8 + 2.4 * (len(shown) - 1))) as drawing:
        grid = drawing.subplots(len(shown), 1, squeeze=False, sharex=True)
        for axes, direction in zip(grid[:, 0], shown, strict=True):
            if before is not None and before.name == "batch":
                rest = rest_about(before, direction)
                axes.plot(rest.s, rest.value, "--", color=ORANGE, label=label_of(before, outcome))
            if after is not None:
                rest = rest_about(after, direction)
                band = np.stack([rest.value - 2 * rest.std, rest.value + 2 * rest.std])
                axes.plot(rest.s, rest.value, color=BLUE, label=label_of(after, outcome))
                axes.fill_between(rest.s, *band, color=BLUE, alpha=0.2, lw=0, label="its 95 % band")
            axes.axhline(0, color=GREY, lw=0.8)
            about = direction and f" k_{direction}"
            axes.set(
                xlim=(0, outcome.config.cable.length),
                ylabel=f"rest curvature{about} [1/m]",
            )
        grid[-1, 0].set_xlabel("arc length from the start s [m]")
        handles, labels = grid[0, 0].get_legend_handles_labels()
        drawing.legend(handles, labels, loc="outside lower center", ncols=3)
        straight = outcome.config.cable.rest_shape == "straight"
        note = "declared straight, not fitted" if straight else "shape without load"
        drawing.suptitle(f"{outcome.config.cable.name}: rest curvature ({note})", fontsize=12)


def draw_moment(path: Path, outcome: Outcome) -> None:
    """Bending moment against curvature of a cable with a free end, measured and fitted."""
    cable, gravity = outcome.config.cable, outcome.config.experiment.gravity
    weight = outcome.fit.mass / cable.length * float(np.linalg.norm(gravity))
    shown = [p for p in outcome.poses if p.role == "fit" and len(p.points) >= LEAST_POINTS]
    if not weight or not shown or cable.rest_shape != "straight":
        return  # the moment needs the weight, and the bend the shape without load
    with figure(path, (8.5, 4.5)) as drawing:
        axes = drawing.subplots()
        most = 0.0
        for pose in shown:
            found = measured_moment_curve(pose.points, cable.length, weight, gravity, pose.s)
            label = "from the centre-line alone" if pose is shown[0] else None
            axes.plot(found.curvature, 1e3 * found.moment, ".", color=BLUE, label=label)
            most = max(most, float(found.curvature.max()))
        grid = np.linspace(0.0, most, 200)
        law = law_of(outcome.fit.model, outcome.fit.p, grid)
        axes.plot(grid, 1e3 * law, color=VERMILLION, label="fitted law of the section")
        axes.set(xlabel="curvature [1/m]", ylabel="bending moment [N mm]", xlim=(0, None))
        drawing.legend(loc="outside lower center", ncols=2)
        drawing.suptitle(f"{cable.name}: moment against curvature", fontsize=12)


# ---- errors ------------------------------------------------------------------------------------


def draw_errors(path: Path, outcome: Outcome) -> None:
    """Errors of all stages as points on a logarithmic axis, with that of noise alone."""
    rows: list[tuple[str, str, float | None]] = []
    for stage in outcome.stages:
        label = label_of(stage, outcome)
        rows.append((label, "fit", stage.rmse_fit))
        if outcome.measurement.poses_held_out:
            rows.append((label, "held_out", stage.rmse_held_out))
    known = [value for *_, value in rows if value and np.isfinite(value)]
    floor = outcome.measurement.noise_distance
    left, right = min([*known, floor]) / 2, 3.5 * max([*known, floor])
    per_stage = 2 if outcome.measurement.poses_held_out else 1
    with figure(path, (8.5, 1.7 + 0.36 * len(rows))) as drawing:
        axes = drawing.subplots()
        for k, (_, role, value) in enumerate(rows):
            y = -(k + 0.8 * (k // per_stage))
            color = BLUE if role == "fit" else HELD_OUT
            if value is None or not np.isfinite(value):
                axes.text(1.1e3 * left, y, "no value", va="center", color=GREY)
                continue
            axes.plot(1e3 * value, y, "o" if role == "fit" else "s", color=color, ms=8)
            axes.text(
                # Beyond the line of the noise, not on it.
                1.08e3 * (floor if 0.5 * floor < value < floor else value),
                y,
                millimetres(value),
                va="center",
                fontsize=9,
                bbox=_PAPER,
            )
        axes.axvline(1e3 * floor, color=BLACK, ls="--", lw=1.2, zorder=1.5)
        middles = [
            -(k + 0.8 * (k // per_stage)) - (per_stage - 1) / 2
            for k in range(0, len(rows), per_stage)
        ]
        axes.set_yticks(middles, [rows[k][0] for k in range(0, len(rows), per_stage)])
        axes.set_xscale("log")
        axes.xaxis.set_minor_locator(LogLocator(subs=(2, 5)))
        for part in (axes.xaxis.set_major_formatter, axes.xaxis.set_minor_formatter):
            part(StrMethodFormatter("{x:g}"))
        axes.set_xlim(1e3 * left, 1e3 * right)
        axes.grid(visible=False, axis="y")
        axes.set_xlabel("distance of the measured points from the prediction, RMS [mm]")
        handles = [_dot("o", BLUE, "fit poses")]
        if per_stage == 2:
            handles.append(_dot("s", HELD_OUT, "held-out poses"))
        handles.append(
            Line2D([], [], color=BLACK, ls="--", label=f"{NOISE_ALONE} {millimetres(floor)}")
        )
        drawing.legend(handles=handles, loc="outside lower center", ncols=3)
        drawing.suptitle(f"{outcome.config.cable.name}: error of each stage", fontsize=12)


def _dot(marker: str, color: str, label: str) -> Line2D:
    return Line2D([], [], ls="none", ms=8, marker=marker, color=color, label=label)


# ---- diagnosis ---------------------------------------------------------------------------------


def draw_candidates(path: Path, outcome: Outcome) -> None:
    """Candidates for a missing effect: score, and cross-validated error where refitted."""
    added = {effect["name"] for effect in outcome.effects}
    tied = {name for effect in outcome.effects for name in effect["indistinguishable_from"]}
    rows = list(outcome.candidates)
    scores = [row["score"] or 0.0 for row in rows]
    with figure(path, (8.5, 1.9 + 0.36 * len(rows))) as drawing:
        axes = drawing.subplots()
        for k, (row, score) in enumerate(zip(rows, scores, strict=True)):
            tried = row["reason"] or row["rmse_cross_validated"] is not None
            lost = GREY if tried else _UNTRIED
            known = BLUE if row["name"] in added else lost
            color = ORANGE if row["name"] in tied else known
            axes.barh(-k, score, height=0.5, color=color)
            if color == GREY:
                axes.text(0, -k - 0.38, f" {finding_of(outcome, row)[1]}", va="center", fontsize=7)
            error = row["rmse_cross_validated"]
            text = f" {score:,.0f}" if score >= 100 else f" {score:.2g}"
            text += "" if error is None else f"   cross-validated {millimetres(error)}"
            axes.text(score, -k, text, va="center", fontsize=9)
        axes.set_yticks([-k for k in range(len(rows))], [row["name"] for row in rows])
        axes.set_xlim(0, 1.55 * max([*scores, 1e-9]))
        axes.set_ylim(0.5 - len(rows), 0.5)
        axes.grid(visible=False, axis="y")
        axes.xaxis.set_major_formatter(StrMethodFormatter("{x:,g}"))
        axes.set_xlabel("score: fall of chi-square that adding it promises")
        handles = [
            Patch(color=BLUE, label="added to the model"),
            Patch(color=ORANGE, label="cannot be told apart from it"),
            Patch(color=GREY, label="refitted, not added"),
            Patch(color=_UNTRIED, label="not refitted"),
        ]
        refitted = [bool(row["reason"]) or row["rmse_cross_validated"] is not None for row in rows]
        shown = [bool(added), bool(tied), sum(refitted) > len(added | tied), not all(refitted)]
        handles = [handle for handle, show in zip(handles, shown, strict=True) if show]
        drawing.legend(handles=handles, loc="outside lower center", ncols=2)
        title = "what the declared model may lack: refits, then by score"
        if outcome.verdict == "unexplained":
            title = "candidates tried; what is left is not explained by any"
        elif not outcome.effects:
            title = "candidates tried; the declared model needs none"
        drawing.suptitle(f"{outcome.config.cable.name}: {title}", fontsize=12)


def draw_unexplained(path: Path, outcome: Outcome) -> None:
    """Where the cable is pulled, and how, in each fit pose."""
    load = outcome.unexplained
    assert load is not None
    with figure(path, (8.5, 7.0)) as drawing:
        axes = drawing.subplots()
        if outcome.config.experiment.in_space:
            room, under = scene_of(outcome)
            draw_marks(axes, [*under, *pull_marks(outcome, room)])
            frame_room(axes, room)
        else:
            _draw_pull(axes, outcome, load)
        low, high = load["interval_95"]
        size = math.hypot(*load["force"])
        handles = [
            Line2D([], [], color=SKY, label="fit poses"),
            Line2D([], [], color=GREEN, lw=4, label=f"pulled at {low:.3f} to {high:.3f} m (95 %)"),
            Line2D([], [], color=VERMILLION, label=f"force, on average {size:.3g} N"),
        ]
        drawing.legend(handles=handles, loc="outside lower center", ncols=3)
        drawing.suptitle(
            f"{outcome.config.cable.name}: unexplained, pulled by something that is not in the "
            "model",
            fontsize=12,
        )


def _draw_pull(axes: Axes, outcome: Outcome, load: dict[str, Any]) -> None:
    names = load.get("poses") or [
        pose.name for pose in outcome.poses if pose.role == "fit" and len(pose.points)
    ]
    length = outcome.config.cable.length
    forces = np.array(load["force_per_pose"], dtype=float).reshape(-1, 2)
    reach = 0.25 * length / max(float(np.hypot(*forces.T).max(initial=0.0)), 1e-12)
    for name, force in zip(names, forces, strict=False):
        line = measured_line(outcome, name)
        if line is None:
            continue
        places, points = line
        axes.plot(*points.T, color=SKY, lw=1.2)
        pulled = np.linspace(load["interval_95"][0], load["interval_95"][1], 9)
        part = [np.interp(pulled, places, points[:, i]) for i in (0, 1)]
        axes.plot(*part, color=GREEN, lw=5, solid_capstyle="butt")
        root = [np.interp(load["position"], places, points[:, i]) for i in (0, 1)]
        tip = [root[i] + reach * force[i] for i in (0, 1)]
        arrow = {"arrowstyle": "-|>", "color": VERMILLION, "lw": 1.6}
        axes.annotate("", xy=(tip[0], tip[1]), xytext=(root[0], root[1]), arrowprops=arrow)
        axes.plot(*tip, alpha=0)  # an annotation does not count for the axes' limits
    axes.set_aspect("equal", adjustable="datalim")
    axes.set(xlabel="x [m]", ylabel="y [m]")
