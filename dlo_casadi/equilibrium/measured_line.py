"""First guesses of a cable along a measured line: its nodes, and its ends where it is fed."""

from typing import Any

import numpy as np
from scipy.interpolate import CubicSpline

from dlo_casadi.arrays import FloatArray, unit
from dlo_casadi.equilibrium.guesses import frames_along
from dlo_casadi.equilibrium.pose import HeldPose
from dlo_casadi.model.cable_model import CableModel
from dlo_casadi.model.clips import tangents
from dlo_casadi.rod.node import Frame
from dlo_casadi.rod.supports import SAME_PLACE

# Iterations of the length beyond the outer markers: each leaves less than a fifth of the error.
_STEPS = 12
# Places in the stretch beyond an outer marker between which its chords are summed.
_PIECES = 40


def line_nodes(
    points: FloatArray, pose: HeldPose, model: CableModel, places: FloatArray
) -> FloatArray:
    """Nodes (n_nodes, coordinates) along a measured line, from its chords.

    The chords are some hundredths of the length; `places` (K,) [m] are the points' arc lengths. In
    a plane headings are continuous along the cable, with the full turns of the first clamp. In
    space the rolls of clamped clips, and the roll of the end clamp nearest to `turns`, are spread
    evenly; where the roll is free there is no twist.
    """
    chain = model.chain
    last = [] if pose.end is None else [chain.length]
    at = np.maximum.accumulate(np.concatenate([[0.0], places, last]))
    grid = np.linspace(0.0, at[-1], 31)
    chords = np.diff([np.interp(grid, at, column) for column in pose.joined(points).T]).T
    middles = (grid[1:] + grid[:-1]) / 2
    if chain.kind.node is not Frame:
        headings = np.unwrap(np.arctan2(chords[:, 1], chords[:, 0]))
        first = pose.start_heading if chain.start_clamped else None
        heading, there = (pose.end_heading, -1) if first is None else (first, 0)
        if heading is not None:
            headings += 2 * np.pi * np.round((heading - headings[there]) / (2 * np.pi))
        return np.interp(chain.places, middles, headings)[:, None]
    tangents = unit(np.stack([np.interp(chain.places, middles, x) for x in chords.T], axis=1))
    clips = [(clip.at, clip.frame) for clip in pose.clips if clip.kind.roll]
    held = [
        (0.0, pose.start_orientation if model.start.roll else None),
        *((at, frame) for at, frame in clips if at is not None),
        (chain.length, pose.end_orientation if model.end.roll else None),
    ]
    return frames_along(chain.places, tangents, held, pose.turns)[0]


def marked_ends(
    points: FloatArray, s: FloatArray, pose: HeldPose, length: float, fed: tuple[bool, bool]
) -> tuple[float, float]:
    """Arc lengths [m] of both ends on a cable that is fed, from markers (K, d) [m] at s (K,) [m].

    A cubic spline through the markers and both ends, with the directions that are held, is as long
    beyond the outer markers as its parameter says. `fed`: through the start, through the end.
    """
    kept = np.array([fed[0], *[True] * len(s), fed[1]])
    kept[[0, -1]] |= np.array([s[0], length - s[-1]]) > SAME_PLACE
    along = tangents(pose.node, np.array(pose.frames))
    bent = np.zeros(points.shape[1])  # at a pin
    told = zip(pose.directions.values(), along, strict=False)
    held: Any = tuple((2, bent) if x is None else (1, t) for x, t in told)
    joined = pose.joined(points)
    steps = np.linalg.norm(np.diff(joined, axis=0), axis=1)
    at = np.array([s[0] - steps[0] if fed[0] else 0.0, *s, s[-1] + steps[-1] if fed[1] else length])
    for _ in range(_STEPS):
        curve = CubicSpline(at[kept], joined[kept], bc_type=held)
        for end, beside, way in ((0, 1, -1), (-1, -2, 1)):
            if fed[end]:
                stretch = curve(np.linspace(at[beside], at[end], _PIECES))
                size = np.linalg.norm(np.diff(stretch, axis=0), axis=1).sum()
                at[end] = at[beside] + way * size
    return float(at[0]), float(at[-1])
