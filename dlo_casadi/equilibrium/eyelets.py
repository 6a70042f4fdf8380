"""Nodes follow the eyelets and ends through which a cable slides."""

from dataclasses import replace

import numpy as np

from dlo_casadi.arrays import FloatArray, IntArray
from dlo_casadi.model.assembly import Assembly, Shapes
from dlo_casadi.model.clips import laid_for, placed_nodes
from dlo_casadi.rod.chain import Chain

# Least distance [elements] of an eyelet from what is beside it; of an end that slides one element.
CLOSEST = 1e-3
# Another node is moved to an eyelet if this makes the shorter segment beside it longer by more than
# this factor: an eyelet between two nodes does not change from one to the other and back.
LONGER = 2.0
# Distance [elements] of an end from that for which nodes are laid, beyond which they are laid anew:
# a little more than the middle of an element may be away.
FED = 0.55


def slid(before: Assembly, shapes: Shapes) -> Shapes:
    """Shapes whose cables slide through supports in a step: these stay in order, nodes follow.

    `before`: the shapes before the step. Where other nodes are moved to the eyelets, headings and
    frames are interpolated; the error of the mesh changes there.
    """
    old, chain, lam = before.clipped, before.model.chain, shapes.lam.copy()
    slides, rows, loose = [*before.model.sliding], [*before.model.sliding.values()], old.loose
    held = old.held.copy()
    held[:, slides] = lam[:, rows]
    lam[:, rows] = _in_order(held, slides, chain)[:, slides]
    nodes, places = placed_nodes(chain, old.near, held, loose)
    near = old.near.copy()
    near[:, slides] = held[:, slides]
    ends = [k for k in slides if k in (0, held.shape[1] - 1)]
    fed = np.abs(near - old.near)[:, ends] > FED * chain.h
    if ends:
        near[:, ends] = laid_for(chain, near[:, [0, -1]])[:, [min(k, 1) for k in ends]]
    others, elsewhere = placed_nodes(chain, near, held, loose)
    eyelets = [k - 1 for k in slides if 0 < k < held.shape[1] - 1]
    poor = _shorter(places, nodes[:, eyelets]) * LONGER < _shorter(elsewhere, others[:, eyelets])
    changed = poor.any(axis=1) | fed.any(axis=1)
    near[~changed] = old.near[~changed]
    x = shapes.x
    if changed.any():
        x, known = x.copy(), old.in_frames(x)
        for j in np.flatnonzero(changed):
            ordered = np.all(np.diff(places[j]) > 0)
            now = places[j] if any(loose) and ordered else old.places[j]
            x[j] = chain.kind.node.interpolated(elsewhere[j], now, known[j])
    return replace(shapes, x=x, lam=lam, near=near[:, slides])


def _in_order(held: FloatArray, slides: list[int], chain: Chain) -> FloatArray:
    """Arc lengths (m, k + 2) [m] of supports, those that slide changed in place to be in order."""
    last = held.shape[1] - 1
    least = np.full(last, CLOSEST * chain.h)
    for k in {0, last} & {*slides}:
        least[min(k, last - 1)] = chain.h
    for k in slides:
        if k > 0:
            held[:, k] = np.maximum(held[:, k], held[:, k - 1] + least[k - 1])
    for k in reversed(slides):
        if k < last:
            held[:, k] = np.minimum(held[:, k], held[:, k + 1] - least[k])
    return held


def _shorter(places: FloatArray, nodes: IntArray) -> FloatArray:
    """Length (m, k) [m] of the shorter segment beside each of some nodes (m, k)."""
    rows, widths = np.arange(len(places))[:, None], np.diff(places)
    return np.minimum(widths[rows, nodes - 1], widths[rows, nodes])
