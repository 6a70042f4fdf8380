"""First guess of the nodes of a cable along a measured line."""

import numpy as np

from dlo_casadi.arrays import FloatArray, unit
from dlo_casadi.equilibrium.guesses import frames_along
from dlo_casadi.equilibrium.pose import HeldPose
from dlo_casadi.model.cable_model import CableModel
from dlo_casadi.rod.node import Frame


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
