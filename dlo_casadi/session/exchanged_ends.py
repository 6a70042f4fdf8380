"""Start and end exchanged, where points far apart do not show the directions at the clamps."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import product

import numpy as np

from dlo_casadi.config import Config
from dlo_casadi.session.coarse import Hypothesis, compare
from dlo_casadi.session.frames import clamp_axes
from dlo_casadi.session.outcome import PoseInput
from dlo_casadi.session.plausibility import Suspicion
from dlo_casadi.thresholds import HEADING_OFF

# Poses that are fitted: a misfit of a twentieth of the length shows in two.
_POSES = 2
# What is exchanged -> the keys of a pose.
_EXCHANGED = {
    "start and end exchanged": ("",),
    "start and end exchanged, and their directions": ("", "_heading", "_orientation"),
}


def ends_exchanged(config: Config, read: Sequence[PoseInput]) -> tuple[Suspicion, ...]:
    """Whether lines that leave both clamps backwards fit with start and end exchanged."""
    boundary = config.experiment.boundary
    if not (len(read) and boundary.start == boundary.end == "clamped"):
        return ()
    own = _off(config, read)
    if own < np.pi / 2:
        return ()
    hypotheses = [_exchanged(config, read, what) for what in _EXCHANGED]
    hypotheses = [item for item in hypotheses if _off(item.config, item.inputs) < HEADING_OFF]
    found = compare(config, read, hypotheses, _POSES)
    if found is None or not found.better:
        return ()
    return (
        Suspicion(
            f"the lines leave their clamps {np.degrees(own):.0f} degrees (median) off the declared "
            f"directions; {found.told}. Try: start where the cable begins, and headings or x axes "
            "along the cable from start to end, at both clamps.",
            found.certain,
        ),
    )


def _exchanged(config: Config, read: Sequence[PoseInput], what: str) -> Hypothesis:
    """The session with start and end exchanged; lines then begin where they ended."""
    poses = []
    for pose in config.experiment.poses:
        pairs = [(f"start{key}", f"end{key}") for key in _EXCHANGED[what]]
        update = {a: getattr(pose, b) for pair in pairs for a, b in (pair, pair[::-1])}
        poses.append(pose.model_copy(update=update))
    experiment = config.experiment.model_copy(update={"poses": tuple(poses)})
    inputs = [
        item if item.s is not None else replace(item, points=item.points[::-1]) for item in read
    ]
    return Hypothesis(what, replace(config, experiment=experiment), inputs)


def _off(config: Config, read: Sequence[PoseInput]) -> float:
    """Median angle [rad] of clamps from the way to the points nearest to them."""
    poses = {pose.name: pose for pose in config.experiment.poses}
    cosines = []
    for item, side in product(read, ("start", "end")):
        pose = poses[item.name]
        first, sign = (0, 1.0) if side == "start" else (-1, -1.0)
        way = sign * (item.points[first] - getattr(pose, side))
        axes = clamp_axes(pose, side)
        assert axes is not None
        cosines.append(float(way @ axes[:, 0]) / max(float(np.linalg.norm(way)), 1e-300))
    return float(np.arccos(np.clip(np.median(cosines), -1.0, 1.0)))
