"""Report how an exported cable came to rest in its simulator: table, data and picture."""

from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from rich.table import Table

from dlo_casadi.errors import counted
from dlo_casadi.export.targets import Target
from dlo_casadi.io.files import finite
from dlo_casadi.report.terminal import plain_table
from dlo_casadi.session.round_trip import CASES, Distance, Relaxation
from dlo_casadi.show import style

# Number of poses that are drawn.
_DRAWN = 4
_COLORS = {"default": style.GREY, "first guess": style.ORANGE, "identified": style.BLUE}


def summary(rows: Sequence[Relaxation]) -> dict[str, Any]:
    """Root mean square and largest errors of each case over all poses, as plain data.

    Shapes relative to the length, forces [N]; None where a pose did not come to rest. Forces are
    compared with measured ones in poses that have a reading.
    """
    out: dict[str, Any] = {}
    for case in CASES:
        own = [row for row in rows if row.case == case]
        forces = [(row.force, row.predicted_force, row.measured_force) for row in own]
        out[case] = {
            "to_prediction": _over([row.to_prediction for row in own]),
            "to_measured": _over([row.to_measured for row in own]),
            "force_to_prediction": _rms([(a, b) for a, b, _ in forces]),
            "force_to_measured": _rms([(a, c) for a, _, c in forces if c is not None]),
            "problems": [f"{row.pose}: {row.problem}" for row in own if row.problem],
        }
    return finite(out)


def _over(distances: Sequence[Distance | None]) -> dict[str, float] | None:
    known = [item for item in distances if item is not None]
    if not known or len(known) < len(distances):
        return None
    rms = float(np.sqrt(np.mean([item.rms**2 for item in known])))
    return {"rms": rms, "largest": max(item.largest for item in known)}


def _rms(pairs: Sequence[tuple[Any, Any]]) -> float | None:
    if not pairs or any(a is None for a, _ in pairs):
        return None
    return float(np.sqrt(np.mean([np.sum(np.square(a - b)) for a, b in pairs])))


def round_trip_dict(rows: Sequence[Relaxation]) -> dict[str, Any]:
    """All relaxations and their `summary` as plain data."""
    kept = (
        *("pose", "case", "problem", "to_prediction", "to_measured"),
        *("force", "predicted_force", "measured_force"),
    )
    listed = [{key: found[key] for key in kept} for found in map(asdict, rows)]
    return finite({"summary": summary(rows), "poses": listed})


def round_trip_table(target: Target, rows: Sequence[Relaxation]) -> Table:
    """One line per case: differences of shapes and end forces from prediction and measurement."""
    numbers = ["from ours", "largest", "from measured", "largest", "force from ours", "measured"]
    poses = counted(len({row.pose for row in rows}), "pose")
    table = plain_table(
        f"At rest in {target.title}, {poses}: shapes in % of the length, RMS; end forces in N, RMS",
        ["stiffness"],
        numbers,
    )
    for case, found in summary(rows).items():
        cells = []
        for key in ("to_prediction", "to_measured"):
            shape = found[key]
            cells += [f"{100 * shape[k]:.3f}" if shape else "-" for k in ("rms", "largest")]
        for key in ("force_to_prediction", "force_to_measured"):
            cells.append("-" if found[key] is None else f"{found[key]:.3g}")
        table.add_row(case, *cells)
    return table


def draw_round_trip(title: str, target: Target, rows: Sequence[Relaxation]) -> Figure:
    """Draw measured points, our prediction and the shapes at rest of some poses."""
    names = list(dict.fromkeys(row.pose for row in rows))[:_DRAWN]
    spatial = rows[0].predicted.shape[1] == 3
    with style.styled((4.8 * len(names), 5.2)) as drawing:
        for k, name in enumerate(names):
            axes: Any = drawing.add_subplot(
                1, len(names), k + 1, projection="3d" if spatial else None
            )
            own = [row for row in rows if row.pose == name]
            label = {"label": "measured"} if k == 0 else {}
            axes.plot(*own[0].measured.T, ".", color=style.BLACK, ms=4, **label)
            for row in own:
                if len(row.points):
                    label = {"label": f"{target.title}, {row.case}"} if k == 0 else {}
                    axes.plot(*row.points.T, color=_COLORS[row.case], **label)
            label = {"label": "our prediction"} if k == 0 else {}
            axes.plot(*own[0].predicted.T, "--", color=style.VERMILLION, lw=1.0, **label)
            axes.set_aspect("equal", adjustable="datalim")
            axes.set(**{f"{axis}label": f"{axis} [m]" for axis in "xyz"[: 2 + spatial]})
            axes.set_title(name)
            if spatial:
                axes.set_box_aspect(None, zoom=0.85)  # the label of z lies outside the axes
        drawing.legend(loc="outside lower center", ncols=3)
        drawing.suptitle(title, fontsize=12)
    return drawing
