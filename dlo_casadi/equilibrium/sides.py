"""Sides on which a cable may hang or pass; minimising its energy does not change the side.

A cable passes each bar on one of two sides. If a cable without obstacles comes near a bar, first
guesses are moved to either side. A pose may name the side.
"""

from collections.abc import Mapping
from itertools import product

import numpy as np
from scipy.spatial.transform import Rotation

from dlo_casadi.arrays import BoolArray, FloatArray, unit
from dlo_casadi.equilibrium.guesses import smallest_turn
from dlo_casadi.equilibrium.pose import HeldPose
from dlo_casadi.model.cable_model import CableModel
from dlo_casadi.model.clips import tangents
from dlo_casadi.rod.node import Frame
from dlo_casadi.rod.obstacles import Capsule, Plane, bars_of

# Distance [lengths] between bar and cable without obstacles above which only one side is tried.
NEAR_BAR = 0.1
# Maximum number of bars, the nearest ones, whose sides are tried in all combinations.
MOST_BARS = 3


def named_sides(model: CableModel, pose: HeldPose) -> list[tuple[Capsule, FloatArray, bool]]:
    """Bars whose side a pose names: each with `Capsule.up`, and whether it is passed over."""
    found = []
    for bar, up in bars_of(model.surfaces, model.gravity):
        over = pose.over if not isinstance(pose.over, Mapping) else pose.over.get(bar.name)
        if over is not None:
            found.append((bar, up, over))
    return found


def on_named_sides(model: CableModel, pose: HeldPose, points: FloatArray) -> BoolArray:
    """Whether cables through points (m, n, d) [m] pass all bars on the sides named by a pose."""
    kept = np.ones(len(points), dtype=bool)
    for bar, up, over in named_sides(model, pose):
        above, below = bar.passed(up, points)
        kept &= above if over else below
    return kept


def beside_bars(model: CableModel, x: FloatArray, points: FloatArray) -> list[FloatArray]:
    """Nodes x (n_nodes, coordinates), and the same moved to each combination of sides of bars.

    Places beside a bar are moved across the cable by a Gaussian of the arc length, as wide as the
    bar; the nodes turn with the line through them. `points` (n_nodes, dimension) [m]: places of the
    nodes x.
    """
    s, ahead, found = model.chain.places, tangents(model.node, x), []
    for bar in model.surfaces:
        if not isinstance(bar, Capsule):
            continue
        near = bar.near(points)
        i = int(near.distance[1:-1].argmin()) + 1
        away = near.normal[i] - near.normal[i] @ ahead[i] * ahead[i]
        size = float(np.linalg.norm(away))
        if near.distance[i] > NEAR_BAR * model.chain.length or size < 1e-3:
            continue
        clear = bar.radius + model.cable.diameter / 2
        wide = max(clear, 2 * model.chain.h)
        bump = np.exp(-(((s - s[i]) / wide) ** 2) / 2)[:, None] * away / size
        here = size * (near.distance[i] + bar.radius)
        found.append((near.distance[i], [(side * clear - here) * bump for side in (1, -1)]))
    nearest = sorted(found, key=lambda pair: float(pair[0]))[:MOST_BARS]
    ways = product(*(pushes for _, pushes in nearest)) if nearest else ()
    return [x, *(_turned(model, x, points, points + sum(way)) for way in ways)]


def on_other_side(
    model: CableModel, pose: HeldPose, x: FloatArray, others: FloatArray
) -> BoolArray:
    """Whether other shapes (m, n_nodes, coordinates) hang on the other side of a shape.

    With a free end, they turn the other way. Between two clamps, where twists differ by full turns,
    their twist differs by more than half a turn. False if the pose names its side or has no two.
    """
    turn, turns = float(model.node.turning(x)), model.node.turning(others)
    least = 0.0 if pose.end is None else np.pi
    apart = (turns * turn < 0) & (np.abs(turns - turn) > least)
    return np.asarray(apart & (model.tipped_by is not None and not pose.turns and not pose.branch))


def touchdowns(model: CableModel, points: FloatArray) -> list[FloatArray]:
    """Places (d,) [m] where a cable may touch planes: above the deepest of points (n, d)."""
    found = []
    for plane in model.surfaces:
        if isinstance(plane, Plane):
            gaps = plane.near(points).distance - model.cable.diameter / 2
            deepest = int(gaps.argmin())
            if gaps[deepest] < 0:
                found.append(points[deepest] - gaps[deepest] * np.array(plane.normal))
    return found


def _turned(model: CableModel, x: FloatArray, old: FloatArray, new: FloatArray) -> FloatArray:
    """Nodes x rotated like the line through their places; both ends are kept."""
    before, after = (np.gradient(points, axis=0) for points in (old, new))
    out = x.copy()
    if model.node is Frame:
        turned = smallest_turn(unit(before), unit(after)) * Rotation.from_quat(x)
        out[1:-1] = turned.as_quat()[1:-1]
    else:
        across = before[:, 0] * after[:, 1] - before[:, 1] * after[:, 0]
        out[1:-1, 0] += np.arctan2(across, (before * after).sum(axis=1))[1:-1]
    return out
