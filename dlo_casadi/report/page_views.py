"""Pictures of the page of a cable in space: each photograph with what was seen and predicted."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from dlo_casadi.errors import counted
from dlo_casadi.report.canvas import Compared
from dlo_casadi.report.page_backgrounds import PHOTOGRAPHS, Background, photograph_of
from dlo_casadi.report.page_pictures import Line, Picture, svg
from dlo_casadi.sensing.pixels import ViewInput
from dlo_casadi.session.outcome import PoseInput
from dlo_casadi.vision import nearest_in_order

FloatArray = NDArray[np.floating]

_PER_POINT = 4  # of a predicted curve, between two of its points


def view_pictures(poses: Sequence[PoseInput], stages: Sequence[Compared] = ()) -> list[Picture]:
    """A picture of every usable photograph of poses in space, those of a pose side by side.

    Parameters
    ----------
    stages : sequence of Compared
        Whose predictions are projected into it.
    """
    shown = [(pose, view) for pose in poses for view in pose.views]
    return [_picture(pose, view, stages, PHOTOGRAPHS // len(shown)) for pose, view in shown]


def _picture(pose: PoseInput, view: ViewInput, stages: Sequence[Compared], budget: int) -> Picture:
    viewpoint, pixels = view.seen.viewpoint, view.seen.pixels
    lines, facts, drawn = [], [], [pixels]
    for kind, label, stage in stages:
        shape = stage.shapes.get(pose.name)
        if shape is None:
            continue
        fine = np.linspace(0, len(shape.curve) - 1, _PER_POINT * (len(shape.curve) - 1) + 1)
        at = np.arange(len(shape.curve))
        curve = viewpoint.to_pixels(
            np.column_stack([np.interp(fine, at, x) for x in shape.curve.T])
        )
        near = curve[_beside(pixels, curve)]
        drawn.append(curve)
        lines.append(Line(kind, svg(curve[::_PER_POINT], 1), svg(near, 2)))
        rms = float(np.sqrt(np.mean(np.sum((pixels - near) ** 2, axis=1))))
        facts.append((kind, label, f"{rms:.2g} px"))
    lines.append(Line("measured", svg(pixels, 2)))
    facts.append(("measured", "measured", counted(len(pixels), "pixel")))
    height, width = viewpoint.shape
    photograph = photograph_of(view.image, budget)
    whole = (-0.5, -0.5, float(width), float(height))
    behind = Background(whole, None, "" if photograph is None else photograph[0])
    first, last = (tuple(np.round(end, 1).tolist()) for end in drawn[-1][[0, -1]])
    return Picture(
        name=view.name,
        role=pose.role,
        alt=f"Photograph {view.name}, with the line that is seen in it"
        + (" and the predicted ones." if stages else "."),
        behind=behind,
        box=behind.about(drawn),
        lines=tuple(lines),
        start=first,
        end=last,
        facts=tuple(facts),
    )


def _beside(pixels: FloatArray, curve: FloatArray) -> NDArray[np.intp]:
    """Points (K,) of a projected curve (M, 2) [px] beside the pixels (K, 2), in order."""
    away = np.linalg.norm(pixels[:, None] - curve[None], axis=2)
    nearest = away.min(axis=1)
    found = nearest_in_order(away / (1.0 + np.median(nearest)))
    return np.where(found >= 0, found, away.argmin(axis=1))
