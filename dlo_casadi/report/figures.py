"""Figures of a run: errors, residuals, rest curvature, candidates, the board.

The figures of a run are drawn once: the page embeds them, and each is also written to a file.
"""

import textwrap
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.ticker import FixedLocator, NullLocator, StrMethodFormatter

from dlo_casadi.estimation.stiffness import LEAST_POINTS, law_of, measured_moment_curve
from dlo_casadi.report import canvas, words
from dlo_casadi.report.figures_motion import motion_figure
from dlo_casadi.report.figures_poses import limits_figure
from dlo_casadi.report.scene import Mark, Scene, next_marks, pull_marks, scene_of
from dlo_casadi.report.words import NOISE_ALONE, compared, directions
from dlo_casadi.session.outcome import Outcome, PoseInput, Stage
from dlo_casadi.show import style
from dlo_casadi.show.text import millimetres
from dlo_casadi.thresholds import NORMAL_95

# Colour of a candidate that was not refitted.
_UNTRIED = "#C8C8C8"
# Colour of the band that contains 95 % of the noise.
_BAND = "#E8EEF3"
# Background of a number that may lie on a line.
_PAPER = {"facecolor": "white", "edgecolor": "none", "pad": 1.0}
# Errors beyond these limits are drawn at the edge of an axis [mm].
_LEAST_MM, _MOST_MM = 1e-9, 1e9
# Number of points beyond which a line looks the same.
_POINTS = 600
_DPI = 200


def figures_of(outcome: Outcome) -> dict[str, Figure]:
    """Figures of errors, residuals, parameters and findings by name; empty ones are left out."""
    last, end = outcome.stages[-1], outcome.config.experiment.boundary.end
    with_shapes = any(stage.shapes for stage in outcome.stages)
    with_points = outcome.measurement.points > 0
    wanted: list[tuple[str, object, Callable[[Outcome], Figure | None]]] = [
        ("errors", with_points, errors_figure),
        ("pose_errors", with_points and with_shapes, pose_errors_figure),
        ("residuals", with_points and with_shapes, residuals_figure),
        ("rest_curvature", with_shapes, rest_curvature_figure),
        ("readings", outcome.measurement.readings and last.shapes, readings_figure),
        ("candidates", outcome.candidates, candidates_figure),
        ("unexplained", outcome.unexplained, unexplained_figure),
        ("next_pose", outcome.next_pose, next_pose_figure),
        ("moment", not end.place, moment_figure),
        ("limits", outcome.limits, limits_figure),
        ("motion", last.motion, motion_figure),
    ]
    drawn = {name: draw(outcome) for name, needed, draw in wanted if needed}
    return {name: drawing for name, drawing in drawn.items() if drawing is not None}


def write_figures(folder: Path, drawn: Mapping[str, Figure]) -> None:
    """Write figures by their names into a folder."""
    for name, drawing in drawn.items():
        style.save_figure(folder / f"{name}.png", drawing, _DPI)


# ---- errors ------------------------------------------------------------------------------------


_KINDS = {
    "fit": ("o", style.BLUE),
    "cross-validated": ("D", style.BLUE),
    "held out": ("s", style.HELD_OUT),
}


def errors_figure(outcome: Outcome) -> Figure:
    """Errors of all stages as points on a logarithmic axis, with the error due to noise alone."""
    validated = words.cross_validated(outcome)
    floor = outcome.measurement.noise_distance
    assert floor is not None  # drawn only where there are points
    shown = ["fit", *["cross-validated"] * bool(validated)]
    shown += ["held out"] * bool(outcome.measurement.poses_held_out)
    rows: list[tuple[float, str, float | None]] = []
    middles = []
    for k, stage in enumerate(outcome.stages):
        values = (stage.rmse_fit, validated.get(stage.name), stage.rmse_held_out)
        known = dict(zip(_KINDS, values, strict=True))
        own = [kind for kind in shown if kind != "cross-validated" or known[kind] is not None]
        places = [-(len(rows) + i + 0.8 * k) for i in range(len(own))]
        rows += [(y, kind, known[kind]) for y, kind in zip(places, own, strict=True)]
        middles.append(np.mean(places))
    height = 1.6 + 0.2 * len(rows) + 0.2 * len(outcome.stages)
    with canvas.chart(outcome, "error of each stage", height) as (drawing, (axes,)):
        left, right = _error_axis(axes, [value for *_, value in rows], floor, 4.0)
        for y, kind, value in rows:
            if value is None or not np.isfinite(value):
                axes.text(1.1 * left, y, "no value", va="center", color=style.GREY, bbox=_PAPER)
                continue
            marker, color = _KINDS[kind]
            at = float(np.clip(1e3 * value, left, right))
            fill = "white" if kind == "cross-validated" else color
            axes.plot(at, y, marker, color=color, mfc=fill, ms=7)
            # The number goes to the right of the noise line, which would cross it otherwise.
            beside = max(at, 1e3 * floor) if at > 500 * floor else at
            axes.annotate(
                millimetres(value),
                (min(beside, right / 4), y),
                xytext=(7, 0),
                textcoords="offset points",
                va="center",
                bbox=_PAPER,
            )
        labels = [words.label_of(stage, outcome) for stage in outcome.stages]
        names = [textwrap.fill(label, 18, break_long_words=False) for label in labels]
        axes.set_yticks(middles, names)
        axes.set_ylim(rows[-1][0] - 0.7, 0.7)
        handles = [canvas.dot(kind, *_KINDS[kind]) for kind in shown]
        drawing.legend(handles=[*handles, _floor(floor)], loc="outside lower center", ncols=2)
    return drawing


def pose_errors_figure(outcome: Outcome) -> Figure:
    """Error of every pose, before and after; the page can highlight one row."""
    floor = outcome.measurement.noise_distance
    assert floor is not None  # drawn only where there are points
    looks = {"before": ("^", style.ORANGE), "after": ("o", style.BLUE)}
    stages = [(stage, label, *looks[kind]) for kind, label, stage in compared(outcome)]
    height = 1.6 + 0.2 * len(stages) + 0.22 * max(3, len(outcome.poses))
    with canvas.chart(outcome, "error of each pose", height) as (drawing, (axes,)):
        found = [[stage.shapes.get(x.name) for stage, *_ in stages] for x in outcome.poses]
        errors = [[None if shape is None else shape.rmse for shape in own] for own in found]
        left, right = _error_axis(axes, (x for own in errors for x in own), floor, 1.6)
        for k, (pose, own) in enumerate(zip(outcome.poses, errors, strict=True)):
            at = np.clip([np.nan if x is None else 1e3 * x for x in own], left, right)
            axes.plot(at, [-k] * len(at), color=style.GREY, lw=1.2, zorder=1)
            said = []
            if all(x is None for x in own):
                text = axes.text(1.1 * left, -k, words.missing(pose), va="center", bbox=_PAPER)
                text.set_color(style.GREY)
            for x, error, (_, label, marker, color) in zip(at, own, stages, strict=True):
                fill = "white" if pose.role == "held_out" else color
                axes.plot(x, -k, marker, color=color, mfc=fill, mew=1.5, ms=6)
                said.append(f"{label} {millimetres(error)}")
            row = axes.axhspan(-k - 0.5, 0.5 - k, alpha=0.0, zorder=10)
            row.set(gid=f"choose-{k}", label="; ".join([_name(pose), *said]))
        every = (pose.name for pose in outcome.poses)
        names = [name if len(name) <= 18 else f"{name[:17]}…" for name in every]
        axes.set_yticks(range(0, -len(names), -1), names)
        axes.set_ylim(0.6 - len(outcome.poses), 0.6)
        handles = [*(canvas.dot(*look) for _, *look in stages), _floor(floor)]
        if any(pose.role == "held_out" for pose in outcome.poses):
            handles.append(canvas.dot("hollow: held out", "o", style.GREY, fill="white"))
        drawing.legend(handles=handles, loc="outside lower center", ncols=1)
    return drawing


def _error_axis(
    axes: Axes, values: Iterable[float | None], floor: float, beyond: float
) -> tuple[float, float]:
    """Make x logarithmic for errors [m]; its range [mm] is finite and ends at `beyond` at most."""
    known = [
        min(max(1e3 * x, _LEAST_MM), _MOST_MM) for x in (*values, floor) if x and 0 < x < np.inf
    ]
    low, high = min(known, default=0.1) / 1.6, max(known, default=10.0) * beyond
    axes.set(xscale="log", xlim=(low, high), xlabel="RMS distance [mm]")
    decades = 10.0 ** np.arange(np.floor(np.log10(low)), np.ceil(np.log10(high)) + 1)
    apart = max(1, len(decades) // 5)
    steps = (1,) if high / low > 300 else (1, 3) if high / low > 30 else (1, 2, 5)
    ticks = [float(f"{step * tens:.0e}") for tens in decades[::apart] for step in steps]
    axes.xaxis.set_major_locator(FixedLocator(ticks))
    axes.xaxis.set_minor_locator(NullLocator())
    axes.xaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
    axes.grid(visible=False, axis="y")
    axes.axvline(1e3 * floor, color=style.BLACK, ls="--", lw=1.2, zorder=0.9)
    return low, high


def _floor(floor: float) -> Line2D:
    return canvas.line_of(f"{NOISE_ALONE} {millimetres(floor)}", color=style.BLACK, ls="--")


def _name(pose: PoseInput) -> str:
    return f"{pose.name} (held out)" if pose.role == "held_out" else pose.name


# ---- residuals ---------------------------------------------------------------------------------


def residuals_figure(outcome: Outcome) -> Figure:
    """Residual along the arc in noise units, before and after, one line per pose."""
    ways = list(enumerate(directions(outcome)))
    found = compared(outcome)
    panels = [(*item, *way) for item in found for way in ways]
    noise = outcome.measurement.std
    assert noise is not None  # drawn only where there are points
    said = f"residuals, noise std {millimetres(noise)} ({outcome.measurement.std_source})"
    with canvas.chart(outcome, said, 1.4 + 1.9 * len(panels), len(panels)) as (drawing, grid):
        for axes, (kind, label, stage, way, direction) in zip(grid, panels, strict=True):
            axes.axhspan(-NORMAL_95, NORMAL_95, color=_BAND, zorder=0)
            axes.axhline(0, color=style.GREY, lw=0.8)
            fitted = []
            for k, pose in enumerate(outcome.poses):
                shape = stage.shapes.get(pose.name)
                if shape is None:
                    continue
                held_out = pose.role == "held_out"
                residual = np.atleast_2d(shape.residual.T)[way] / noise
                fitted += [] if held_out else [residual]
                every = slice(None, None, -(-len(shape.s) // _POINTS) or 1)
                error = "" if shape.rmse is None else f", RMS distance {millimetres(shape.rmse)}"
                axes.plot(
                    shape.s[every],
                    residual[every],
                    color=style.HELD_OUT if held_out else style.BLUE,
                    ls="--" if held_out else "-",
                    lw=1.1,
                    alpha=0.85 if held_out else 0.45,
                    zorder=3 if held_out else 2,
                    gid=f"residual-{kind}-{k}{direction and f'-{direction}'}",
                    label=_name(pose) + error,
                )
            # Not the stage's own chi-square, which uses its own noise.
            size = float(np.sqrt(np.mean(np.concatenate(fitted) ** 2))) if fitted else np.nan
            quality = f", RMS\u00a0{size:.2g}" if np.isfinite(size) else ""
            title = f"{kind}: {label}{direction and f', along {direction}'}"
            axes.set_title(textwrap.fill(title + quality, 52), loc="left")
            axes.set_ylabel("residual [noise std]")
            axes.set_ylim(_residual_range(stage, noise))
        grid[-1].set_xlabel("arc length from the start s [m]")
        grid[-1].set_xlim(0, outcome.config.cable.length)
        drawn = [x for x in outcome.poses if any(x.name in y.stage.shapes for y in found)]
        _legend_of_poses(drawing, drawn)
    return drawing


def _residual_range(stage: Stage, noise: float) -> tuple[float, float]:
    """Range of the residuals drawn, in standard deviations `noise` [m].

    It contains 95 % of the noise and all residuals, except those of poses measured in another
    equilibrium than the predicted one, a hundred times larger, unless all poses are such.
    """
    shown = [shape for shape in stage.shapes.values() if len(shape.residual)]
    near = [shape for shape in shown if shape.measured_branch is None]
    values = np.concatenate([np.zeros(0), *(shape.residual.ravel() for shape in near or shown)])
    low, high = values.min(initial=-2.0 * noise) / noise, values.max(initial=2.0 * noise) / noise
    return low - 0.08 * (high - low), high + 0.08 * (high - low)


def _legend_of_poses(drawing: Figure, poses: Iterable[PoseInput], **drawn: Any) -> None:
    """Explain in a legend fit poses, held-out poses if there are any, and the band of noise."""
    handles = [canvas.line_of("fit pose", color=style.BLUE, **drawn)]
    if any(pose.role == "held_out" for pose in poses):
        handles.append(
            canvas.line_of("held-out pose", color=style.HELD_OUT, **({"ls": "--"} | drawn))
        )
    handles.append(canvas.line_of("95 % of the noise lies within", color=_BAND, lw=8))
    drawing.legend(handles=handles, loc="outside lower center", ncols=2)


def readings_figure(outcome: Outcome) -> Figure:
    """Forces and moments on the fixtures, measured minus predicted, in units of their noise."""
    stage = outcome.stages[-1]
    names = sorted({name for shape in stage.shapes.values() for name in shape.readings})
    poses = [x for x in outcome.poses if x.name in stage.shapes and stage.shapes[x.name].readings]
    said = f"readings, measured minus predicted ({words.label_of(stage, outcome)})"
    with canvas.chart(outcome, said, 0.9 + 2.4 * len(names), len(names), 8.5) as (drawing, grid):
        for axes, name in zip(grid, names, strict=True):
            std, unit = outcome.measurement.std_of(name)
            axes.axhspan(-NORMAL_95, NORMAL_95, color=_BAND, zorder=0)
            axes.axhline(0, color=style.GREY, lw=0.8)
            for k, pose in enumerate(poses):
                if name not in stage.shapes[pose.name].readings:
                    continue
                known, model = stage.shapes[pose.name].readings[name]
                color = style.HELD_OUT if pose.role == "held_out" else style.BLUE
                apart = 0.2 * (np.arange(len(known)) - (len(known) - 1) / 2)
                axes.plot(k + apart, (known - model) / std, ".-", color=color, lw=0.6, ms=6)
            parts = f"{', '.join('xyz'[: len(apart)])} from left to right, "
            parts = parts if len(apart) > 1 else ""
            axes.set_title(f"{name}: {parts}noise {std:.3g} {unit}", loc="left")
            axes.set_ylabel("residual / noise")
        ticks = [pose.name for pose in poses]
        grid[-1].set_xticks(range(len(poses)), ticks, rotation=60, ha="right", fontsize=8)
        _legend_of_poses(drawing, poses, marker="o", ls="none")
    return drawing


# ---- rest curvature ----------------------------------------------------------------------------


def rest_curvature_figure(outcome: Outcome) -> Figure:
    """Rest curvature of the last stage with its band, and that of the fit before it."""
    ways = directions(outcome)
    straight = outcome.config.cable.rest_shape == "straight"
    said = (
        f"rest curvature ({'declared straight, not fitted' if straight else 'shape without load'})"
    )
    shown = [x for x in compared(outcome) if x.kind == "after" or x.stage.name == "batch"]
    with canvas.chart(outcome, said, 1.9 + 1.9 * len(ways), len(ways)) as (drawing, grid):
        for k, (axes, direction) in enumerate(zip(grid, ways, strict=True)):
            for kind, label, stage in shown:
                rest = stage.rest_curvature
                value, std = np.atleast_2d(rest.value)[k], np.atleast_2d(rest.std)[k]
                axes.plot(rest.s, value, **canvas.STAGE_LINES[kind], label=label)
                if kind == "after":
                    low, high = value - NORMAL_95 * std, value + NORMAL_95 * std
                    band = axes.fill_between(rest.s, low, high, color=style.BLUE, alpha=0.2, lw=0)
                    band.set_label("its 95 % band")
            axes.axhline(0, color=style.GREY, lw=0.8)
            about = direction and f" k_{direction}"
            axes.set(xlim=(0, outcome.config.cable.length), ylabel=f"rest curvature{about} [1/m]")
        grid[-1].set_xlabel("arc length from the start s [m]")
        handles, _ = grid[0].get_legend_handles_labels()
        drawing.legend(handles=handles, loc="outside lower center", ncols=1)
    return drawing


def moment_figure(outcome: Outcome) -> Figure | None:
    """Bending moment over curvature of a cable with a free end, measured and fitted."""
    cable, gravity = outcome.config.cable, outcome.config.experiment.gravity
    weight = outcome.fit.mass / cable.length * float(np.linalg.norm(gravity))
    shown = [p for p in outcome.poses if p.role == "fit" and len(p.points) >= LEAST_POINTS]
    if not weight or not shown or cable.rest_shape != "straight":
        return None  # the moment needs the weight, the bending needs the shape without load
    with canvas.chart(outcome, "moment against curvature", 3.8) as (drawing, (axes,)):
        most = 0.0
        for pose in shown:
            found = measured_moment_curve(pose.points, cable.length, weight, gravity, pose.s)
            label = "from the centre-line alone" if pose is shown[0] else None
            axes.plot(found.curvature, 1e3 * found.moment, ".", color=style.BLUE, label=label)
            most = max(most, float(found.curvature.max()))
        grid = np.linspace(0.0, most, 200)
        law = law_of(outcome.fit.model, outcome.fit.p, grid)
        axes.plot(grid, 1e3 * law, color=style.VERMILLION, label="fitted law of the section")
        axes.set(xlabel="curvature [1/m]", ylabel="bending moment [N mm]", xlim=(0, None))
        drawing.legend(loc="outside lower center", ncols=1)
    return drawing


# ---- diagnosis ---------------------------------------------------------------------------------


def candidates_figure(outcome: Outcome) -> Figure:
    """Candidates for a missing effect: score, and cross-validated error where refitted."""
    rows = outcome.candidates
    said = "what the declared model may lack: refits, then by score"
    if outcome.verdict == "unexplained":
        said = "candidates tried; what is left is not explained by any"
    elif not outcome.effects:
        said = "candidates tried; the declared model needs none"
    looks = {
        "added": (style.BLUE, "added to the model"),
        "tied": (style.ORANGE, "cannot be told apart from it"),
        "refitted": (style.GREY, "refitted, not added"),
        "": (_UNTRIED, "not refitted"),
    }
    found = set()
    with canvas.chart(outcome, said, 1.9 + 0.36 * len(rows), width=8.5) as (drawing, (axes,)):
        for k, row in enumerate(rows):
            error = row.rmse_cross_validated
            status, said = words.finding_of(outcome, row)
            look = status or ("refitted" if row.reason or error is not None else "")
            found.add(look)
            axes.barh(-k, row.score, height=0.5, color=looks[look][0])
            if look == "refitted":
                axes.text(0, -k - 0.38, f" {said}", va="center", fontsize=7)
            text = f" {words.score_text(row.score)}"
            text += "" if error is None else f"   cross-validated {millimetres(error)}"
            axes.text(row.score, -k, text, va="center", fontsize=9)
        axes.set_yticks([-k for k in range(len(rows))], [row.name for row in rows])
        axes.set_xlim(0, 1.55 * max(1e-9, *(row.score for row in rows)))
        axes.set_ylim(0.5 - len(rows), 0.5)
        axes.grid(visible=False, axis="y")
        axes.xaxis.set_major_formatter(StrMethodFormatter("{x:,g}"))
        axes.set_xlabel("score: fall of chi-square that adding it promises")
        handles = [Patch(color=c, label=x) for look, (c, x) in looks.items() if look in found]
        drawing.legend(handles=handles, loc="outside lower center", ncols=2)
    return drawing


# ---- all poses in one scene --------------------------------------------------------------------


def unexplained_figure(outcome: Outcome) -> Figure:
    """Place and direction of the unexplained pull on the cable in each fit pose."""
    load = outcome.unexplained
    assert load is not None
    low, high = load.interval
    size = float(np.linalg.norm(load.force))
    handles = [
        canvas.line_of("measured", **canvas.STYLES["taken"]),
        canvas.line_of(f"pulled at {low:.3f} to {high:.3f} m (95 %)", **canvas.STYLES["pulled"]),
        canvas.line_of(f"force in each pose, on average {size:.3g} N", **canvas.STYLES["pull"]),
    ]
    said = "unexplained, pulled by something that is not in the model"
    return _scene_figure(outcome, pull_marks, handles, said)


def next_pose_figure(outcome: Outcome) -> Figure:
    """The end position proposed for the next pose, among those of poses already taken."""
    handles = [
        canvas.line_of("measured", **canvas.STYLES["taken"]),
        canvas.dot("next end", "P", style.VERMILLION),
        canvas.dot("starts", "s", style.BLACK),
        canvas.dot("ends", "o", style.BLACK),
    ]
    return _scene_figure(outcome, next_marks, handles, "which pose to measure next")


def _scene_figure(
    outcome: Outcome,
    marks: Callable[[Outcome, Scene], list[Mark]],
    handles: list[Line2D],
    said: str,
) -> Figure:
    with canvas.chart(outcome, said, 4.6) as (drawing, (axes,)):
        scene, under = scene_of(outcome)
        canvas.draw_marks(axes, [*under, *marks(outcome, scene)])
        canvas.frame(axes, scene)
        drawing.legend(handles=handles, loc="outside lower center", ncols=1 + len(handles) // 4)
    return drawing
