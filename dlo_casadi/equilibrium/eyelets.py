"""Nodes follow the eyelets through which a cable slides."""

from dataclasses import replace

import numpy as np

from dlo_casadi.arrays import FloatArray, IntArray
from dlo_casadi.model.assembly import Assembly, Shapes
from dlo_casadi.model.clips import placed_nodes
from dlo_casadi.rod.chain import Chain

# Least distance [elements] of an eyelet from what is beside it.
CLOSEST = 1e-3
# Another node is moved to an eyelet if this makes the shorter segment beside it longer by more than
# this factor: an eyelet between two nodes does not change from one to the other and back.
LONGER = 2.0


def slid(before: Assembly, shapes: Shapes) -> Shapes:
    """Shapes whose eyelets slide along the cable in a step: they stay in order, nodes follow.

    `before`: the shapes before the step. Where other nodes are moved to the eyelets, headings and
    frames are interpolated; the error of the mesh changes there.
    """
    old, chain, lam = before.clipped, before.model.chain, shapes.lam.copy()
    eyelets, rows = [*before.model.sliding], [*before.model.sliding.values()]
    at = old.at.copy()
    at[:, eyelets] = lam[:, rows]
    lam[:, rows] = _in_order(at, eyelets, chain)[:, eyelets]
    nodes, places = placed_nodes(chain, old.near, at)
    near = old.near.copy()
    near[:, eyelets] = at[:, eyelets]
    others, elsewhere = placed_nodes(chain, near, at)
    poor = _shorter(places, nodes[:, eyelets]) * LONGER < _shorter(elsewhere, others[:, eyelets])
    changed = poor.any(axis=1)
    near[~changed] = old.near[~changed]
    x = shapes.x
    if changed.any():
        x, known = x.copy(), old.in_frames(x)
        for j in np.flatnonzero(changed):
            x[j] = chain.kind.node.interpolated(elsewhere[j], old.places[j], known[j])
    return replace(shapes, x=x, lam=lam, near=near[:, eyelets])


def _in_order(at: FloatArray, eyelets: list[int], chain: Chain) -> FloatArray:
    """Arc lengths (m, k) [m] of clips, those of the eyelets changed in place to be in order."""
    least, last = CLOSEST * chain.h, at.shape[1] - 1
    for k in eyelets:
        at[:, k] = np.maximum(at[:, k], least + (at[:, k - 1] if k else 0.0))
    for k in reversed(eyelets):
        at[:, k] = np.minimum(at[:, k], (at[:, k + 1] if k < last else chain.length) - least)
    return at


def _shorter(places: FloatArray, nodes: IntArray) -> FloatArray:
    """Length (m, k) [m] of the shorter segment beside each of some nodes (m, k)."""
    rows, widths = np.arange(len(places))[:, None], np.diff(places)
    return np.minimum(widths[rows, nodes - 1], widths[rows, nodes])
