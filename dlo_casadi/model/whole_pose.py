"""CasADi expressions of a whole pose, for IPOPT: sums of the functions of segments."""

from dataclasses import dataclass

import casadi as ca
import numpy as np

from dlo_casadi.model.cable_model import CableModel
from dlo_casadi.model.functions import functions_of
from dlo_casadi.model.lagrangian import lagrangian_of


@dataclass(frozen=True)
class PoseSymbols:
    """Arguments of the expressions of a pose.

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
    def of(cls, model: CableModel) -> "PoseSymbols":
        """Fresh symbols."""
        sizes = {
            "x": model.chain.n_nodes * model.node.coordinates,
            "lam": model.n_border,
            "p": len(model.parameters),
            "rest": model.chain.n_rests,
            "pose": model.n_pose,
            "deviation": len(model.deviation_names),
        }
        return cls(**{name: ca.SX.sym(name, size) for name, size in sizes.items()})


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
    s, functions, lagrangian = PoseSymbols.of(model), functions_of(model), lagrangian_of(model)
    inner = ca.SX.sym("inner", model.n_inner, model.chain.n_segments)
    energy, gradient, _ = functions.at_ends(*_end_arguments(model, s))
    own, reached = functions.segment_potential(*_segment_arguments(model, s), inner)
    energy = sum(ca.horzsplit(own), start=energy)
    conditions = sum(ca.horzsplit(reached), start=gradient[2 * model.node.increment :])
    multipliers = np.flatnonzero(model.are_multipliers).tolist()
    places = np.flatnonzero(~model.are_multipliers).tolist()
    given_way = ca.SX.sym("given_way", len(lagrangian.compliant))
    if lagrangian.compliant:
        energy += ca.sumsqr(given_way) / 2
        conditions[lagrangian.compliant] -= ca.sqrt(lagrangian.compliances(s.p)) * given_way
    given, zero = [energy, conditions[multipliers]], ca.SX.zeros(len(multipliers))
    energy, conditions = ca.substitute(given, [s.lam[multipliers]], [zero])
    coordinates = ca.vertcat(s.x, *(s.lam[i] for i in places), ca.vec(inner), given_way)
    parameters = ca.vertcat(s.p, s.rest, s.pose, s.deviation)
    return Potential(coordinates, parameters, energy, conditions)


def balance(model: CableModel, s: PoseSymbols) -> ca.SX:
    """Gradient of the Lagrangian by increments and multipliers: force balance, then conditions."""
    b, functions = model.node.increment, functions_of(model)
    _, ends, _ = functions.at_ends(*_end_arguments(model, s))
    gradient = functions.segment_slope(*_segment_arguments(model, s))
    none = ca.SX.zeros(b)
    rows = ca.horzcat(none, gradient[b : 2 * b, :]) + ca.horzcat(gradient[:b, :], none)
    rows = rows[:, : model.chain.n_nodes]
    rows[:, 0] += ends[:b]
    rows[:, -1] += ends[b : 2 * b]
    return ca.vertcat(ca.vec(rows), sum(ca.horzsplit(gradient[2 * b :, :]), start=ends[2 * b :]))


def curve(model: CableModel, s: PoseSymbols) -> ca.SX:
    """Measured curve ((n + 1) d or 2 d,), by node: place, and dr/ds of smooth elements."""
    layout, d, functions = model.chain.layout, model.node.dimension, functions_of(model)
    steps = functions.segment_curve(*_segment_arguments(model, s))[:, layout.advancing.tolist()]
    points = ca.cumsum(ca.horzcat(s.pose[:d], steps[:d, :]), 1)
    rates = steps[d:, :]
    rates = ca.horzcat(rates[:, 0], (rates[:, :-1] + rates[:, 1:]) / 2, rates[:, -1])
    first, last = layout.stations.T.tolist()
    x = ca.reshape(s.x, model.node.coordinates, model.chain.n_nodes)
    both = ca.vertcat(x[:, first], x[:, last])
    return ca.vec(functions.station(points, rates, both, s.p, s.pose))


def readings(model: CableModel, s: PoseSymbols) -> ca.SX:
    """Wrench measurements (n_reactions,) [N, N m] of sensors, see `ends.REACTIONS`."""
    return functions_of(model).readings(*_end_arguments(model, s))


def rest_after(model: CableModel, s: PoseSymbols) -> ca.SX:
    """Rest curvature (n_rests,) [1/m] that the pose leaves behind."""
    after, *_ = functions_of(model).segment_state(*_segment_arguments(model, s))
    return ca.vec(after[:, model.chain.layout.bends.tolist()].T)


def _end_arguments(model: CableModel, s: PoseSymbols) -> list[ca.SX]:
    c = model.node.coordinates
    both = ca.vertcat(s.x[:c], s.x[s.x.numel() - c :])
    return [both, s.lam, s.p, s.pose, s.deviation]


def _segment_arguments(model: CableModel, s: PoseSymbols) -> list[ca.SX | ca.DM]:
    """A column for each segment, or a single column of what all segments share."""
    chain = model.chain
    x = ca.reshape(s.x, model.node.coordinates, chain.n_nodes)
    after = np.minimum(np.arange(chain.n_segments) + 1, chain.n_nodes - 1)
    both = ca.vertcat(x[:, : chain.n_segments], x[:, after.tolist()])
    inside = chain.rest_inside(np.eye(chain.n_rests)).reshape((-1, chain.n_rests))
    rest = ca.reshape(ca.sparsify(ca.DM(inside)) @ s.rest, -1, chain.n_segments)
    return [both, s.lam, s.p, rest, ca.DM(chain.layout.segments.T), s.deviation]
