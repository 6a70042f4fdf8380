"""CasADi expressions of a whole pose: sums of the functions of segments.

Symbols are SX for this package's own IPOPT problems and MX in functions for users' problems: an
expression of MX calls the functions of segments, so that graphs and their derivatives stay small.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np

from dlo_casadi.arrays import FloatArray
from dlo_casadi.model.cable_model import FREE_LENGTH, VIEWPOINT_SIZE, CableModel
from dlo_casadi.model.clipped import Clipped
from dlo_casadi.model.clips import clip_size
from dlo_casadi.model.functions import functions_of
from dlo_casadi.model.lagrangian import lagrangian_of
from dlo_casadi.rod.chain import with_cells_beyond
from dlo_casadi.rod.ends import EndConditions
from dlo_casadi.rod.quaternions import conjugate, quaternion_product


@dataclass(frozen=True)
class PoseSymbols:
    """Arguments of the expressions of a pose.

    `x` (n_nodes coordinates,), `lam` (n_lam,), `p` (n_parameters,), `rest` (n_rests,) [1/m],
    `pose` (n_pose,), `deviation` (n_deviations,).
    """

    x: Any  # CasADi's stubs: SX and MX have no common type
    lam: Any
    p: Any
    rest: Any
    pose: Any
    deviation: Any

    @classmethod
    def of(cls, model: CableModel) -> "PoseSymbols":
        """Fresh symbols."""
        sizes = {
            "x": model.chain.n_nodes * model.node.coordinates,
            "lam": model.n_lam,
            "p": len(model.parameters),
            "rest": model.chain.n_rests,
            "pose": model.n_pose,
            "deviation": len(model.deviation_names),
        }
        return cls(**{name: ca.SX.sym(name, size) for name, size in sizes.items()})


@dataclass(frozen=True)
class Potential:
    """A minimisation over one pose: symbols (coordinates, parameters), energy [J], conditions.

    The parameters stack p, rest curvature of the cells, pose, deviation, and `Laid`. `by_segment`
    (n_lam, n_segments): what each segment adds to the conditions; for the end's place its advance
    [m].
    """

    coordinates: ca.SX
    parameters: ca.SX
    energy: ca.SX
    conditions: ca.SX
    by_segment: ca.SX


@dataclass(frozen=True)
class Laid:
    """Where the nodes are on the cable.

    Parameters
    ----------
    moved : (k, n_nodes)
        1 where a node is moved to a clip, else 0.
    shares, others : (k + 2, n_nodes), (1, n_nodes)
        Arc lengths of the nodes are `others` [m] plus the shares of those of the supports.
    parameters : sequence
        Those of these that are symbols.
    """

    moved: Any
    shares: Any
    others: Any
    parameters: Sequence[ca.SX] = ()

    @classmethod
    def of(cls, model: CableModel) -> "Laid":
        """Symbols; numbers without clips."""
        count, k = model.chain.n_nodes, len(model.clips)
        moved = ca.SX.sym("moved", k, count)
        if model.slides and k:
            known = (moved, ca.SX.sym("shares", k + 2, count), ca.SX.sym("others", 1, count))
            return cls(*known, known)
        if model.slides:
            u = ca.DM(model.chain.places / model.chain.length).T
            return cls(moved, ca.vertcat(1 - u, u), ca.DM.zeros(1, count))
        still = ca.SX(1, count)
        others = (1 - ca.sum1(moved)) * ca.DM(model.chain.places).T
        return cls(moved, ca.vertcat(still, moved, still), others, (moved,))

    @staticmethod
    def numbers(model: CableModel, clipped: Clipped) -> FloatArray:
        """The `parameters` of one pose as numbers."""
        k, count = len(model.clips), model.chain.n_nodes
        found = [(np.arange(count) == clipped.nodes[0][:, None]).ravel(order="F").astype(float)]
        if model.slides and k:
            shares = clipped.at_nodes(np.eye(k + 2)[None])[0]
            found += [shares.ravel(order="C"), clipped.places[0] - shares @ clipped.held[0]]
        return np.concatenate(found)

    @staticmethod
    def ends(model: CableModel, s: "PoseSymbols") -> tuple[Any, Any]:
        """Arc lengths [m] of both ends, where no unknown of the border is one."""
        length = model.cable.length
        if not (model.slides and model.fed_by_length):
            return 0.0, length
        free = s.pose[EndConditions.size(model.node) + VIEWPOINT_SIZE]
        free = free + s.deviation[model.deviation_names.index(FREE_LENGTH)]
        return (0.0, free) if model.end.slides else (length - free, length)

    def places(self, model: CableModel, s: "PoseSymbols") -> Any:
        """Arc lengths (1, n_nodes) [m]."""
        at = ca.vertsplit(functions_of(model).true_clips(s.p, s.pose)[1])
        low, high = self.ends(model, s)
        held = [low, *at, high]
        for k, row in model.sliding.items():
            held[k] = s.lam[row]
        return self.others + ca.horzcat(*held) @ self.shares


def potential(model: CableModel) -> Potential:
    """The minimisation that IPOPT solves: min V(coordinates) s.t. conditions = 0.

    The coordinates are those of the nodes, places of springs and eyelets, unknowns inside segments,
    and those of compliant clamps: a clamp of the compliance c turns by sqrt(c) a and stores a^2/2.
    """
    s, functions, lagrangian = PoseSymbols.of(model), functions_of(model), lagrangian_of(model)
    inner = ca.SX.sym("inner", model.n_inner, model.chain.n_segments)
    energy, gradient, _ = functions.at_ends(*end_arguments(model, s))
    laid = Laid.of(model)
    moved = laid.moved
    segments = _segment_arguments(model, s, laid)
    own, reached = functions.compact("segment_potential")(*segments, inner)
    reached = _spread(model, reached, moved)
    energy = sum(ca.horzsplit(own), start=energy)
    conditions = sum(ca.horzsplit(reached), start=gradient[2 * model.node.increment :])
    multipliers = np.flatnonzero(model.are_multipliers[: model.n_lam]).tolist()
    places = np.flatnonzero(~model.are_multipliers).tolist()
    given_way = ca.SX.sym("given_way", len(lagrangian.compliant))
    if lagrangian.compliant:
        energy += ca.sumsqr(given_way) / 2
        conditions[lagrangian.compliant] -= ca.sqrt(lagrangian.compliances(s.p)) * given_way
    given, zero = [energy, conditions[multipliers], reached], ca.SX.zeros(len(multipliers))
    energy, conditions, reached = ca.substitute(given, [s.lam[multipliers]], [zero])
    for k, frame in _clip_frames(model, s, moved).items():
        # Nothing else depends on the coordinates of a node that a clip holds.
        energy += ca.sumsqr(_nodes(model, s) @ moved[k, :].T - frame) / 2
    coordinates = ca.vertcat(s.x, *(s.lam[i] for i in places), ca.vec(inner), given_way)
    parameters = ca.vertcat(s.p, s.rest, s.pose, s.deviation, *map(ca.vec, laid.parameters))
    return Potential(coordinates, parameters, energy, conditions, reached)


def balance(model: CableModel, s: PoseSymbols) -> Any:
    """Gradient of the Lagrangian by increments and multipliers: force balance, then conditions."""
    b, functions = model.node.increment, functions_of(model)
    ends = functions.end_slope(*end_arguments(model, s))
    arguments = _segment_arguments(model, s)
    gradient = functions.compact("segment_slope")(*arguments)
    if model.sliding:
        own, (before, after) = functions.compact("edge_slope")(*arguments), _slides(model)
        for k, row in enumerate(model.sliding.values()):
            gradient[2 * b + row, :] = own[0, :] * before[k, :] + own[1, :] * after[k, :]
    none = ca.DM.zeros(b)
    rows = ca.horzcat(none, gradient[b : 2 * b, :]) + ca.horzcat(gradient[:b, :], none)
    rows = rows[:, : model.chain.n_nodes]
    rows[:, 0] += ends[:b]
    rows[:, -1] += ends[b : 2 * b]
    return ca.vertcat(ca.vec(rows), sum(ca.horzsplit(gradient[2 * b :, :]), start=ends[2 * b :]))


def tangent(model: CableModel, s: PoseSymbols) -> Any:
    """Hessian of the Lagrangian by increments and multipliers: the derivative of `balance`."""
    b, count, functions = model.node.increment, model.chain.n_nodes, functions_of(model)
    arguments = _segment_arguments(model, s)
    *_, segments = functions.compact("segment")(*arguments)
    if model.sliding:
        segments = _with_slides(model, segments, functions.compact("segment_by_edges")(*arguments))
    *_, ends = functions.at_ends(*end_arguments(model, s))
    # Unknowns of each block: those of two nodes, and the border. A segment after the last node is
    # possible; its entries for a next node are left out.
    first = np.append(np.arange(model.chain.n_segments), 0)
    last = np.append(first[:-1] + 1, count - 1)
    border = b * (count + 1) + np.arange(model.n_border)
    nodes = (b * np.stack([first, last], axis=1)[..., None] + np.arange(b)).reshape(len(first), -1)
    own = np.hstack([nodes, np.tile(border, (len(first), 1))])
    size, kept = b * (count + 1) + model.n_border, [*range(b * count), *border.tolist()]
    places = (own[:, None] + size * own[..., None]).ravel()
    entries = np.arange(len(places))
    added = ca.DM.triplet(
        places.tolist(), entries.tolist(), np.ones(len(places)), size**2, len(places)
    )
    total = added @ ca.vec(ca.horzcat(segments, ends))
    return ca.reshape(total, size, size)[kept, kept]


def curve(model: CableModel, s: PoseSymbols) -> ca.SX:
    """Measured curve ((n + 1) d or 2 d,), by node: place, and dr/ds of smooth elements."""
    layout, d, functions = model.chain.layout, model.node.dimension, functions_of(model)
    advance = functions.compact("segment_curve")(*_segment_arguments(model, s))
    steps = advance[:, layout.advancing.tolist()]
    points = ca.cumsum(ca.horzcat(s.pose[:d], steps[:d, :]), 1)
    rates = steps[d:, :]
    rates = ca.horzcat(rates[:, 0], (rates[:, :-1] + rates[:, 1:]) / 2, rates[:, -1])
    first, last = layout.stations.T.tolist()
    x = ca.reshape(s.x, model.node.coordinates, model.chain.n_nodes)
    both = ca.vertcat(x[:, first], x[:, last])
    return ca.vec(functions.station(points, rates, both, s.p, s.pose))


def ends(model: CableModel, s: PoseSymbols) -> ca.SX:
    """Arc lengths (2,) [m] of both ends on a cable that is fed; none of others."""
    if not model.slides:
        return ca.SX(0, 1)
    known, last = Laid.ends(model, s), len(model.clips) + 1
    rows = (model.sliding.get(k) for k in (0, last))
    return ca.vertcat(*(own if k is None else s.lam[k] for own, k in zip(known, rows, strict=True)))


def readings(model: CableModel, s: PoseSymbols) -> ca.SX:
    """Wrench measurements (n_reactions,) [N, N m] of sensors, see `ends.reaction_rows`."""
    return functions_of(model).readings(*end_arguments(model, s))


def rest_after(model: CableModel, s: PoseSymbols) -> ca.SX:
    """Rest curvature (n_rests,) [1/m] that the pose leaves behind."""
    after, *_ = functions_of(model).segment_state(*_segment_arguments(model, s))
    return ca.vec(after[:, model.chain.layout.bends.tolist()].T)


def end_arguments(model: CableModel, s: PoseSymbols) -> list[Any]:
    """Arguments of the functions of both ends."""
    c = model.node.coordinates
    both = ca.vertcat(s.x[:c], s.x[s.x.numel() - c :])
    return [both, s.lam, s.p, s.pose, s.deviation]


def _nodes(model: CableModel, s: PoseSymbols) -> Any:
    """Coordinates of the nodes, one column each."""
    return ca.reshape(s.x, model.node.coordinates, model.chain.n_nodes)


def _clip_frames(model: CableModel, s: PoseSymbols, moved: ca.SX) -> dict[int, Any]:
    """Frames of clamped clips, from the pose; swivels take the roll of the nodes that they hold.

    As in `Clipped.of`. `moved` (k, n_nodes): see `Potential`.
    """
    size, c, count = clip_size(model.node), model.node.coordinates, len(model.clips)
    turns, frames = functions_of(model).true_clips(s.p, s.pose)[2], {}
    for k, kind in enumerate(model.clips):
        if not kind.direction:
            continue
        last = model.n_pose - size * (count - k) + size - 1
        frame = model.node.moved(s.pose[last - c : last], ca.SX(turns[:, k]))
        if not kind.roll:
            parts, own = ca.vertsplit(frame), ca.vertsplit(_nodes(model, s) @ moved[k, :].T)
            roll, _, _, rest = quaternion_product(conjugate(parts), own)
            length = ca.sqrt(roll**2 + rest**2)
            turn = (roll / length, ca.SX(0), ca.SX(0), rest / length)
            frame = ca.vertcat(*quaternion_product(parts, turn))
        frames[k] = frame
    return frames


def _spread(model: CableModel, reached: Any, moved: ca.SX) -> Any:
    """Conditions (n_lam, n_segments) of each force, given that of the one beyond: see `Beyond`."""
    if not model.clips:
        return reached
    pulls, found = model.pulls[model.n_springs :], ca.SX(reached)
    if model.end_pull:
        found[model.end_pull, :] = reached[pulls[0], :]
    for k, rows in enumerate(pulls):
        before = ca.cumsum(moved[k, ::-1], 1)[:, ::-1][:, 1:]
        found[rows, :] = reached[pulls[0], :] * ca.repmat(before, len(rows), 1)
    return found


def _slides(model: CableModel) -> tuple[ca.DM, ca.DM]:
    """Changes (u, n_segments) of both ends of segments with what slides, without clips."""
    rates = ca.DM(Laid.of(model).shares)[[*model.sliding], :]
    return rates[:, :-1], rates[:, 1:]


def _with_slides(model: CableModel, segments: Any, edges: Sequence[Any]) -> Any:
    """Hessians of segments side by side, with the rows of what slides: see `Slides`."""
    size, first = segments.shape[0], 2 * model.node.increment
    rows = [first + row for row in model.sliding.values()]
    chosen = ca.DM(np.eye(size)[:, rows])
    mixed, _, twice = edges
    each = zip(
        ca.horzsplit(segments, size),
        ca.horzsplit(mixed, 2),
        ca.horzsplit(twice, 2),
        *(ca.horzsplit(x) for x in _slides(model)),
        strict=True,
    )
    found = []
    for own, by_ends, both, before, after in each:
        rate = ca.horzcat(before, after).T @ chosen.T
        column = by_ends @ rate
        found.append(own + column + column.T + rate.T @ both @ rate)
    return ca.horzcat(*found)


def _resting(model: CableModel, s: PoseSymbols, places: Any) -> tuple[Any, Any]:
    """Rest strains of segments whose nodes are at `places`, and where their cells start [m].

    Without clips; as `Clipped.rest_inside`.
    """
    chain, known = model.chain, (0.0, model.chain.length)
    inside = chain.rest_inside(np.eye(chain.n_rests)).reshape((chain.n, -1, chain.n_rests))
    every = ca.DM(with_cells_beyond(inside).reshape((-1, chain.n_rests)))
    every = ca.reshape(ca.sparsify(every) @ s.rest, -1, chain.n + 2)
    low, high = (
        (ca.floor(end / chain.h) + 0.5) * chain.h if slides else ca.DM(at)
        for end, slides, at in zip((places[0], places[-1]), model.loose, known, strict=True)
    )
    middle = low + (high - low) * ca.DM((np.arange(chain.n) + 0.5) / chain.n).T
    cell = ca.fmin(ca.fmax(ca.floor(middle / chain.h), -1), chain.n)
    cells = ca.repmat(ca.DM(np.arange(-1, chain.n + 1)), 1, chain.n)
    return every @ (cells == ca.repmat(cell, chain.n + 2, 1)), cell * chain.h


def _segment_arguments(model: CableModel, s: PoseSymbols, laid: Laid | None = None) -> list[Any]:
    """One column for each segment, or a single column if all segments share it."""
    chain, x = model.chain, _nodes(model, s)
    inside = chain.rest_inside(np.eye(chain.n_rests)).reshape((-1, chain.n_rests))
    rest = ca.reshape(ca.sparsify(ca.DM(inside)) @ s.rest, -1, chain.n_segments)
    place: Any = ca.DM(chain.layout.segments.T)
    fed = model.slides and not model.clips
    if laid is None and fed:
        laid = Laid.of(model)
    if laid is not None and model.moves_nodes:
        places, moved = laid.places(model, s), laid.moved
        even = place[0, :]
        if fed:
            rest, even = _resting(model, s, places)
        place = ca.vertcat(places[:, :-1], places[:, 1:], place[5, :], even)
        for k, frame in _clip_frames(model, s, moved).items():
            x = x * (1 - ca.repmat(moved[k, :], x.shape[0], 1)) + frame @ moved[k, :]
    after = np.minimum(np.arange(chain.n_segments) + 1, chain.n_nodes - 1)
    both = ca.vertcat(x[:, : chain.n_segments], x[:, after.tolist()])
    return [both, s.lam, s.p, rest, place, s.deviation]
