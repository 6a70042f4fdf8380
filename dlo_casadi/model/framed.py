"""The Lagrangian of a segment in space, as an energy in the frame of the segment's middle."""

from dataclasses import replace
from functools import lru_cache, partial
from typing import NamedTuple

import casadi as ca
import numpy as np

from dlo_casadi.model.lagrangian import MODELS, Lagrangian
from dlo_casadi.rod.element import Expansion
from dlo_casadi.rod.in_frame import SegmentInFrame


class SegmentNumbers(NamedTuple):
    """Arguments of a segment beside its nodes and multipliers."""

    p: ca.SX
    rest: ca.SX
    place: ca.SX
    deviation: ca.SX
    shares: ca.SX


def in_frame(
    terms: Lagrangian, x: ca.SX, multipliers: ca.SX, numbers: SegmentNumbers
) -> SegmentInFrame:
    """A segment in space, written in the frame in its middle.

    Parameters
    ----------
    terms : Lagrangian
        Of the segment's model.
    x : (8,)
        Frames of both nodes.
    multipliers : (3, 1 + n_springs + n_clips) [N]
        Force on the end's holder, then on springs and clips.
    """
    spread, dead, pulls = len(terms.kind.rule[0]), len(terms.dead_forces), len(terms.pulls)
    weights = np.zeros((spread + dead + pulls, multipliers.shape[1]))
    weights[:spread, 0] = -1.0
    weights[spread + dead :, 1:] = -np.eye(pulls)
    loads, of_segment = _forces(terms)(numbers.p, numbers.place, numbers.deviation), _energy(terms)
    law, middle = ca.SX.sym("law", *of_segment.size_in(3)), ca.DM(terms.node.identity)

    def energy(phi: ca.SX, inner: ca.SX, forces: ca.SX) -> ca.SX:
        return ca.SX(of_segment(ca.vertcat(middle, phi), inner, forces, law, *numbers)[0])

    def held(phi: ca.SX) -> ca.SX:
        return ca.SX(of_segment(ca.vertcat(middle, phi), 0, 0, 0, *numbers)[1])

    total = ca.SX(loads) + multipliers @ ca.DM(weights.T)
    return SegmentInFrame(terms.kind, energy, x, total, weights, (law, held))


@lru_cache(maxsize=MODELS)
def _forces(terms: Lagrangian) -> ca.Function:
    """(p, place, deviation) -> dead forces (dimension, m) [N] on a segment, see `_energy`."""
    forces = terms.forces_on(terms.segment(terms.stretch, terms.inner, ca.SX(0)))
    forces += [ca.SX.zeros(terms.node.dimension)] * len(terms.pulls)
    arguments = [terms.p, terms.place, terms.deviation]
    return ca.Function("segment_forces", arguments, [ca.horzcat(*forces)])


@lru_cache(maxsize=MODELS)
def _energy(terms: Lagrangian) -> ca.Function:
    """(local, inner, forces, law, *numbers) -> energy [J] of a segment, and values of `law`.

    Its minimum over the internal unknowns is that of `segment_by_share`. Forces are arguments,
    because the energy does not change if a segment and the forces on it are rotated together. The
    multipliers of the end's place, springs and clips are such forces, too. Laws of the section are
    expanded, see `Expansion`.
    """
    kind, h, inner = terms.kind, terms.length, terms.inner
    ratio, local = ca.SX.sym("ratio"), ca.SX.sym("local", terms.local.numel())
    segment = terms.segment(ratio, inner, inner**2, local)
    still, axes = ca.SX.zeros(inner.shape), len(terms.node.curvatures)
    bends = kind.bends(replace(segment, inner=still))
    squares = [ca.sumsqr(bend[-axes:]) for bend in bends]
    section = terms.section
    points = squares if terms.has_law_of_bend else []
    law = Expansion(section.of_bend, points, ca.vertcat(terms.p, terms.deviation))
    section = replace(section, expansion=law) if points else section
    elastic = partial(kind.elastic, section=section)
    count = len(terms.forces_on(segment)) + len(terms.pulls)
    forces = ca.SX.sym("force", terms.node.dimension, count)
    energy = elastic(segment) - terms.work_along(segment, ca.horzsplit(forces))
    tension = ca.substitute(-ca.gradient(energy, ratio) / h, inner, still)
    lagrangian = kind.expanded(segment, energy, elastic)
    lagrangian -= terms.axial_compliance * h * tension**2 / 2
    found = ca.substitute(lagrangian, ratio, terms.stretch)
    numbers = [terms.p, terms.rest_strains, terms.place, terms.deviation, terms.share_symbols]
    arguments = [local, inner, forces, law.symbols, *numbers]
    return ca.Function("segment_in_frame", arguments, [found, law.values])
