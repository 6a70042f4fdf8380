"""One pose as a whole, as CasADi expressions for IPOPT: the functions of segments, added up."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import casadi as ca
import numpy as np

from dlo_casadi.model.cable_model import CableModel
from dlo_casadi.model.functions import functions_of
from dlo_casadi.model.lagrangian import lagrangian_of


@dataclass(frozen=True)
class PoseSymbols:
    """What a pose's expressions depend on.

    `x` (n_nodes coordinates,), `lam` (n_border,), `p` (n_parameters,), `rest` (n_rests,) [1/m],
    `pose` (n_pose,), `deviation` (n_deviations,).
    """

    x: ca.SX
    lam: ca.SX
    p: ca.SX
    rest: ca.SX
    pose: ca.SX
    deviation: ca.SX

    @classmethod
    def of(cls, model: CableModel) -> PoseSymbols:
        """Fresh symbols."""
        chain = model.chain
        return cls(
            ca.SX.sym("x", chain.n_nodes * chain.kind.node.coordinates),
            ca.SX.sym("lam", model.n_border),
            ca.SX.sym("p", len(model.parameters)),
            ca.SX.sym("kappa_0", chain.n_rests),
            ca.SX.sym("pose", model.n_pose),
            ca.SX.sym("deviation", len(model.deviation_names)),
        )


@dataclass(frozen=True)
class Potential:
    """A minimisation over one pose: symbols (coordinates, parameters), energy [J], conditions.

    The parameters stack p, rest curvature of the cells, pose, deviation.
    """

    coordinates: ca.SX
    parameters: ca.SX
    energy: ca.SX
    conditions: ca.SX


def potential(model: CableModel) -> Potential:
    """The minimisation that IPOPT solves: min V(coordinates) s.t. conditions = 0.

    The coordinates are the nodes', the places of springs, the unknowns inside the segments, then
    those of clamps that give way: a clamp of the compliance c turns by sqrt(c) a and stores a^2/2.
    """
    s, chain = PoseSymbols.of(model), model.chain
    inner = ca.SX.sym("inner", model.n_inner, chain.n_segments)
    energy, gradient, _ = functions_of(model).at_ends(*_end_arguments(model, s))
    conditions = gradient[2 * chain.kind.node.increment :]
    for j, arguments in enumerate(_segment_arguments(model, s)):
        own, reached = functions_of(model).segment_potential(*arguments, inner[:, j])
        energy, conditions = energy + own, conditions + reached
    multipliers = np.flatnonzero(model.are_multipliers).tolist()
    places = np.flatnonzero(~model.are_multipliers).tolist()
    zero = ca.SX.zeros(len(multipliers))
    given_way = ca.SX.sym("given_way", len(lagrangian_of(model).compliant))
    if lagrangian_of(model).compliant:
        energy += ca.sumsqr(given_way) / 2
        conditions[lagrangian_of(model).compliant] -= (
            ca.sqrt(lagrangian_of(model).compliances(s.p)) * given_way
        )
    given = [energy, conditions[multipliers]]
    energy, conditions = ca.substitute(given, [s.lam[multipliers]], [zero])
    parameters = ca.vertcat(s.p, s.rest, s.pose, s.deviation)
    held = [s.lam[i] for i in places]
    coordinates = ca.vertcat(s.x, *held, *ca.vertsplit(ca.vec(inner)), given_way)
    return Potential(coordinates, parameters, energy, conditions)


def balance(model: CableModel, s: PoseSymbols) -> ca.SX:
    """Gradient of the Lagrangian by increments and multipliers: force balance, then conditions."""
    node, segments = model.chain.kind.node, model.chain.n_segments
    b, n = node.increment, model.chain.n_nodes
    rows = [ca.SX.zeros(b) for _ in range(max(n, segments + 1))]
    _, ends, _ = functions_of(model).at_ends(*_end_arguments(model, s))
    border = ends[2 * b :]
    for j, arguments in enumerate(_segment_arguments(model, s)):
        _, gradient, _ = functions_of(model).segment(*arguments)
        rows[j] += gradient[:b]
        rows[j + 1] += gradient[b : 2 * b]
        border += gradient[2 * b :]
    rows[0] += ends[:b]
    rows[n - 1] += ends[b : 2 * b]
    return ca.vertcat(*rows[:n], border)


def curve(model: CableModel, s: PoseSymbols) -> ca.SX:
    """Measured curve ((n + 1) d or 2 d,): place, and slope of smooth elements, node by node."""
    chain, layout = model.chain, model.chain.layout
    c, d = chain.kind.node.coordinates, chain.kind.node.dimension
    arguments = _segment_arguments(model, s)
    steps = [functions_of(model).segment_curve(*arguments[j]) for j in layout.advancing]
    rates = [step[d:] for step in steps]
    rates = [
        rates[0],
        *((a + b) / 2 for a, b in pairwise(rates)),
        rates[-1],
    ]
    point, rows = s.pose[:d], []
    for i, (first, last) in enumerate(layout.stations):
        both = ca.vertcat(s.x[first * c : (first + 1) * c], s.x[last * c : (last + 1) * c])
        rows.append(functions_of(model).station(point, rates[i], both, s.p, s.pose))
        if i < chain.n:
            point = point + steps[i][:d]
    return ca.vertcat(*rows)


def readings(model: CableModel, s: PoseSymbols) -> ca.SX:
    """What sensors on the fixtures show (n_reactions,) [N, N m], see `ends.REACTIONS`."""
    return functions_of(model).readings(*_end_arguments(model, s))


def rest_after(model: CableModel, s: PoseSymbols) -> ca.SX:
    """Rest curvature (n_rests,) [1/m] that the pose leaves behind."""
    arguments = _segment_arguments(model, s)
    rests: list[Any] = [
        functions_of(model).segment_state(*arguments[j])[0].T for j in model.chain.layout.bends
    ]
    return ca.vec(ca.vertcat(*rests))


def _end_arguments(model: CableModel, s: PoseSymbols) -> list[ca.SX]:
    c = model.chain.kind.node.coordinates
    both = ca.vertcat(s.x[:c], s.x[s.x.numel() - c :])
    return [both, s.lam, s.p, s.pose, s.deviation]


def _segment_arguments(model: CableModel, s: PoseSymbols) -> list[list[ca.SX]]:
    chain = model.chain
    c, last = chain.kind.node.coordinates, chain.n_nodes - 1
    cells, weights = chain.rest_stencils
    rows: list[list[Any]] = []
    for j in range(chain.n_segments):
        k = min(j + 1, last)
        both = ca.vertcat(s.x[j * c : (j + 1) * c], s.x[k * c : (k + 1) * c])
        axes = ca.vertsplit(s.rest, chain.n_cells)
        own = ca.vertcat(*(ca.DM(weights[j]) @ axis[cells[j].tolist()] for axis in axes))
        rows.append([both, s.lam, s.p, own, ca.DM(chain.layout.segments[j]), s.deviation])
    return rows
