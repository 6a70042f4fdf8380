"""A model's functions, evaluated for many poses at once and assembled into band matrices.

One CasADi function of a segment is mapped over the segments of a pose. Its blocks are summed to the
gradient of the Lagrangian, to its Hessian (block-tridiagonal, with the multipliers as border), and
to the derivatives of both and of the measured curve.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from copy import copy
from dataclasses import replace
from functools import cached_property, lru_cache
from typing import Any

import numpy as np

from dlo_casadi.arrays import FloatArray, IntArray
from dlo_casadi.model.cable_model import CableModel
from dlo_casadi.model.clips import ClipLoad, Clipped, clip_size, tangents
from dlo_casadi.model.contact import DEPTH, Contact, Touching, outwards
from dlo_casadi.model.functions import functions_of
from dlo_casadi.model.lagrangian import MODELS
from dlo_casadi.model.stacked import Inputs, Mapped, Shapes, Tangents, Unheld, repeated
from dlo_casadi.rod.band import BandMatrix, Vector
from dlo_casadi.rod.ends import reaction_rows

# Turn [rad] that counts as much as a slip of the whole length through an eyelet.
_TURN = 10.0
# Step of differences by slips of clips, relative to the length, and by turns [rad].
_STEP = 1e-6


class Assembly:
    """Evaluation of a model over poses."""

    def __init__(self, model: CableModel) -> None:
        self.model = model
        self.chain, self.node = model.chain, model.chain.kind.node
        self.n, self.b, self.k = self.chain.n_nodes, self.node.increment, model.n_border
        # Rows of the first node, of the last node, and of the border.
        self._parts = slice(0, self.b), slice(self.b, 2 * self.b), slice(2 * self.b, None)
        # Rows of a force at the end of the cable, in derivatives of a segment.
        self._pull = [2 * self.b + row for row in model.end_pull]
        self._segments, self.n_lam = self.chain.n_segments, model.n_lam
        self._next = np.minimum(np.arange(self._segments) + 1, self.n - 1)
        self.depth, self.everywhere, self._outwards = DEPTH, False, outwards(model)
        # The last result of `touching` and its poses: a Newton step asks three times about the same
        # shapes. Replaced as a whole: threads share the assembly of a model.
        self._touched: tuple[dict[bytes, int], Touching] | None = None

    def _changed(self, **values: Any) -> Assembly:
        other = copy(self)
        vars(other).update(values, _touched=None)
        return other

    def softened(self, depth: float) -> Assembly:
        """A copy with softer obstacles, see `contact.DEPTH`."""
        return self._changed(depth=depth)

    def felt_everywhere(self) -> Assembly:
        """A copy in which forces of obstacles act whatever the gaps."""
        return self._changed(everywhere=True)

    @cached_property
    def turn_per_slip(self) -> FloatArray:
        """Turn [rad/m] equivalent to a change of an eyelet's arc length; zero for others (k,)."""
        slide = np.isin(np.arange(self.k), list(self.model.sliding.values()))
        return slide * (_TURN / self.chain.length)

    def size(self, step: Vector) -> FloatArray:
        """Largest turn (m,) [rad] in a step of one column."""
        nodes = np.abs(step.x).max(axis=(1, 2, 3))
        slips = (np.abs(step.y[..., 0]) * self.turn_per_slip).max(axis=1, initial=0.0)
        return np.maximum(nodes, slips)

    # ---- calls ---------------------------------------------------------------------------------

    def _mapped(self, name: str, unheld: bool = False) -> Mapped:
        return functions_of(self.model, unheld).mapped(name)

    def _call_segments(
        self, name: str, shapes: Shapes, given: Inputs, touching: Touching | None = None
    ) -> list[FloatArray]:
        """Evaluate a function for all segments: outputs (m, n_segments, rows, columns)."""
        touching = touching or self.touching(shapes, given)
        lam = touching.lam if touching else repeated(shapes.lam, self._segments)
        return self._under(lam, name, shapes, given)

    def _under(self, lam: FloatArray, name: str, shapes: Shapes, given: Inputs) -> list[FloatArray]:
        """As `_call_segments`, under forces lam (m, n_segments, n_lam)."""
        count, clipped = self._segments, self.clipped(shapes, given)
        own = self.chain.rest_inside(given.rest[..., None])[..., 0]
        if name != "segment_state":  # a state is of the even cells
            own = clipped.rest(own[..., None])[..., 0]
        p, deviation = (repeated(one, count) for one in (given.p, shapes.deviation))
        both, table = clipped.carried(self._both(shapes.x)), clipped.segments()
        arguments = both, lam, p, own, table, deviation
        if not self.model.clips:
            return self._mapped(name)(*arguments)
        unheld = Unheld.of(self.model, table)
        return unheld.evaluated(name, self._mapped, arguments, 2 * self.b)

    def clipped(self, shapes: Shapes, given: Inputs) -> Clipped:
        """Where the clips are on the cable."""
        if not (kinds := self.model.clips):
            return Clipped.none(self.chain, len(shapes.x))
        declared = given.poses[:, given.poses.shape[1] - self.model.clip_numbers :]
        declared = declared.reshape((len(declared), len(kinds), clip_size(self.node)))
        slips, turns = functions_of(self.model).clip_slopes
        at = declared[..., -1] + given.p @ slips.T
        for k, row in self.model.sliding.items():
            at[:, k] = shapes.lam[:, row]
        return Clipped.of(self.chain, kinds, declared, at, given.p @ turns, shapes.x)

    def touching(self, shapes: Shapes, given: Inputs) -> Touching | None:
        """Which nodes touch obstacles; None without obstacles."""
        if not self.model.surfaces:
            return None
        d = self.node.dimension

        def advances(lam: FloatArray, rows: IntArray) -> FloatArray:
            some = shapes.subset(rows), given.subset(rows)
            return self._under(lam, "segment_curve", *some)[0][:, :, :d, 0]

        x = shapes.x.reshape((len(shapes.x), self.n * self.node.coordinates))
        every = x, shapes.lam, shapes.deviation, given.p, given.rest, given.poses
        poses, last = [row.tobytes() for row in np.concatenate(every, axis=1)], self._touched
        if last is None or not last[0].keys() >= set(poses):
            nodes = shapes.lam.copy(), given.poses[:, :d], given.p @ self._outwards.T
            found = Touching.of(self.model, *nodes, self.depth, self.everywhere, advances)
            self._touched = last = {pose: k for k, pose in enumerate(poses)}, found
        known, found = last
        return found.subset(np.array([known[pose] for pose in poses], dtype=int))

    def _both(self, nodes: FloatArray) -> FloatArray:
        """Rows (m, n_segments, 2 k, ...) of both nodes of segments, from (m, n_nodes, k, ...)."""
        return np.concatenate([nodes[:, : self._segments], nodes[:, self._next]], axis=2)

    def _call_ends(self, name: str, shapes: Shapes, given: Inputs) -> list[FloatArray]:
        """Evaluate a function of both ends: outputs (m, rows, columns)."""
        both = np.concatenate([shapes.x[:, :1], shapes.x[:, -1:]], axis=2)
        rows = (both[:, 0], shapes.lam[:, : self.n_lam], given.p, given.poses, shapes.deviation)
        return [out[:, 0] for out in self._mapped(name)(*(row[:, None] for row in rows))]

    def _at_nodes(
        self, first: FloatArray, last: FloatArray, start: FloatArray, end: FloatArray
    ) -> FloatArray:
        """Blocks of segments' nodes (m, n_segments, ...) and of the ends, summed at the nodes."""
        count = self._segments
        total = np.zeros((len(first), max(count + 1, self.n), *first.shape[2:]))
        total[:, :count] += first
        total[:, 1 : count + 1] += last
        total = total[:, : self.n]
        total[:, 0] += start
        total[:, -1] += end
        return total

    def _added(self, segments: FloatArray, ends: FloatArray) -> Vector:
        """Rows (2b + k, q) of the segments and the ends, summed at nodes and border."""
        first, last, border = self._parts
        x = self._at_nodes(
            segments[:, :, first], segments[:, :, last], ends[:, first], ends[:, last]
        )
        return Vector(x, segments[:, :, border].sum(axis=1) + ends[:, border])

    # ---- balance -------------------------------------------------------------------------------

    def balance(self, shapes: Shapes, given: Inputs) -> tuple[FloatArray, Vector, BandMatrix]:
        """Lagrangian (m,) [J], its gradient by increments and multipliers, and its Hessian."""
        touching = self.touching(shapes, given)
        value, gradient, bend = self._call_segments("segment", shapes, given, touching)
        end_value, end_gradient, end_bend = self._call_ends("at_ends", shapes, given)
        total = value[:, :, 0, 0].sum(axis=1) + end_value[:, 0, 0]
        matrix = self._held(self._band(bend, end_bend), given)
        force = self._added(gradient, end_gradient)
        clipped, stiffness = self.clipped(shapes, given), self._stiffness(given)
        clipped.hold(force, shapes.x, stiffness)
        clipped.hold_matrix(matrix, stiffness)
        if touching:
            total, force = touching.added(total, force, gradient[:, :, self._pull, 0])
            matrix = touching.matrix(matrix, bend)
        return total, force, matrix

    def _stiffness(self, given: Inputs) -> FloatArray:
        """Bending stiffness (m,) [N m] of an element."""
        return given.p[:, self.model.stiffness_indices[0]] / self.chain.h

    def clip_loads(self, shapes: Shapes, given: Inputs) -> list[tuple[ClipLoad, ...]]:
        """What the cables do to their clips, for each of m poses."""
        if not self.model.clips:
            return [()] * len(shapes.x)
        (gradient,) = self._call_segments("segment_slope", shapes, given)
        _, end_gradient, _ = self._call_ends("at_ends", shapes, given)
        by_turns = self._added(gradient, end_gradient).x[..., 0]
        forces = shapes.lam[:, self.model.pulls[self.model.n_springs :]]
        return self.clipped(shapes, given).loads(forces, by_turns)

    def _held(self, matrix: BandMatrix, given: Inputs) -> BandMatrix:
        """For cables free to roll about their axis, add a stiffness against roll of the first node.

        Such a cable, straight at rest, has the null vector (1, 0, 0) at every node. The stiffness
        changes inertia and Newton steps only along that vector, which may be removed from any step.
        """
        if not self.model.may_spin:
            return matrix
        straight = ~given.rest.any(axis=1)
        diagonal = matrix.diagonal.copy()
        diagonal[straight, 0, 0, 0] += matrix.scale[straight]
        return replace(matrix, diagonal=diagonal)

    def imbalance(self, shapes: Shapes, given: Inputs) -> Vector:
        """Gradient of the Lagrangian by increments and multipliers, without its Hessian."""
        touching = self.touching(shapes, given)
        (gradient,) = self._call_segments("segment_slope", shapes, given, touching)
        _, end_gradient, _ = self._call_ends("at_ends", shapes, given)
        force = self._added(gradient, end_gradient)
        self.clipped(shapes, given).hold(force, shapes.x, self._stiffness(given))
        if touching:
            _, force = touching.added(np.zeros(()), force, gradient[:, :, self._pull, 0])
        return force

    def _band(self, bend: FloatArray, ends: FloatArray) -> BandMatrix:
        first, last, border = self._parts
        own, at_ends = bend[:, :, last, last], ends[:, last, last]
        diagonal = self._at_nodes(bend[:, :, first, first], own, ends[:, first, first], at_ends)
        columns = self._added(bend[..., border], ends[..., border])
        upper = bend[:, : self.n - 1, first, last].copy()
        return BandMatrix(diagonal, upper, columns.x, columns.y)

    def energy(self, shapes: Shapes, given: Inputs) -> FloatArray:
        """Potential energy (m,) [J]: the Lagrangian without the work of the multipliers.

        Contacts store part of it, see `Touching.given_way`.
        """
        total, gradient, _ = self.balance(shapes, given)
        return total - self.work(shapes, gradient)

    def work(self, shapes: Shapes, gradient: Vector) -> FloatArray:
        """Work (m,) [J] of the multipliers in the Lagrangian, given its gradient."""
        pulls = shapes.lam * self.model.are_multipliers
        return np.asarray((pulls * gradient.y[:, :, 0]).sum(axis=1))

    def balance_slopes(self, shapes: Shapes, given: Inputs) -> tuple[FloatArray, FloatArray]:
        """Derivatives of the gradient by p, rest and deviation, of each segment and of the ends."""
        (segments,) = self._call_segments("segment_sensitivity", shapes, given)
        (ends,) = self._call_ends("end_sensitivity", shapes, given)
        return segments, ends

    def balance_along(
        self,
        shapes: Shapes,
        given: Inputs,
        along: Tangents,
        slopes: Sequence[FloatArray] | None = None,
    ) -> Vector:
        """Change of the gradient at fixed nodes and multipliers along directions.

        `slopes`: the `balance_slopes` if they are known.
        """
        segments, ends = slopes or self.balance_slopes(shapes, given)
        clipped = self.clipped(shapes, given)
        changed = self._by_numbers(segments, along, clipped)
        total = self._added(changed, ends @ np.concatenate([along.p, along.deviation], axis=1))
        if touching := self.touching(shapes, given):
            total = touching.along(total, changed[:, :, self._pull], self._outwards @ along.p)
        clipped.hold(total, shapes.x, np.zeros(len(shapes.x)))
        for rate, (more, less) in self._moved_clips(given, along.p):
            change = self.imbalance(shapes, more) - self.imbalance(shapes, less)
            total = total + Vector(change.x * rate[:, None, None], change.y * rate[:, None])
        return total

    def _by_numbers(
        self,
        blocks: FloatArray,
        along: Tangents,
        clipped: Clipped,
        total: FloatArray | float = 0.0,
    ) -> FloatArray:
        """Add the change along p, rest and deviation to a total, given segments' derivatives."""
        rest = clipped.rest(self.chain.rest_inside(along.rest))
        n_p, n_r = along.p.shape[1], along.p.shape[1] + rest.shape[2]
        total = total + blocks[..., :n_p] @ along.p[:, None]
        total += blocks[..., n_p:n_r] @ rest
        total += blocks[..., n_r:] @ along.deviation[:, None]
        return np.asarray(total)

    def _moved_clips(
        self, given: Inputs, p: FloatArray, *, turned: bool = True
    ) -> Iterator[tuple[FloatArray, tuple[Inputs, Inputs]]]:
        """Central differences by slips and turns of clips: rates (m, q), and both inputs.

        `p` (m, n_parameters, q): directions. Without `turned` those by slips alone.
        """
        slips, turns = functions_of(self.model).clip_slopes
        for k in np.flatnonzero(slips.any(axis=0) | (turned & turns.any(axis=(0, 2)))):
            step = _STEP * (self.chain.length if slips[:, k].any() else 1.0)
            unit = step * np.eye(given.p.shape[1])[k]
            both = (replace(given, p=given.p + unit), replace(given, p=given.p - unit))
            if p[:, k].any():
                yield p[:, k] / (2 * step), both

    # ---- the curve ------------------------------------------------------------------------------

    def _stations(self, advance: FloatArray, start: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Places (m, n + 1, d, ...) and rates (m, n + 1, rates, ...) at the element boundaries."""
        steps, d = advance[:, self.chain.layout.advancing], self.node.dimension
        places = np.concatenate([start[:, None], steps[:, :, :d]], axis=1).cumsum(axis=1)
        rates = steps[:, :, d:]
        mean = (rates[:, 1:] + rates[:, :-1]) / 2
        return places, np.concatenate([rates[:, :1], mean, rates[:, -1:]], axis=1)

    def nodes(self, shapes: Shapes, given: Inputs) -> FloatArray:
        """True places (m, n + 1, dimension) [m] of the element boundaries."""
        (advance,) = self._call_segments("segment_curve", shapes, given)
        start, clipped = given.poses[:, : self.node.dimension], self.clipped(shapes, given)
        places, rates = self._stations(advance[..., 0], start)
        if not clipped.clamps:
            return places
        moved = np.concatenate([places, rates[..., :1] * tangents(self.node, shapes.x)], axis=2)
        return clipped.evenly(moved[..., None])[:, :, : self.node.dimension, 0]

    def curve(self, shapes: Shapes, given: Inputs) -> FloatArray:
        """Measured places (m, n + 1, d), for smooth elements with dr/ds (m, n + 1, 2 d)."""
        (advance,) = self._call_segments("segment_curve", shapes, given)
        (rows,) = self._call_stations("station", advance, shapes, given)
        return self.clipped(shapes, given).evenly(rows)[..., 0]

    def _call_stations(
        self, name: str, advance: FloatArray, shapes: Shapes, given: Inputs
    ) -> list[FloatArray]:
        m, count = len(shapes.x), self.chain.n + 1
        start = given.poses[:, : self.node.dimension]
        places, rates = self._stations(advance[..., 0], start)
        nodes = self.clipped(shapes, given).in_frames(shapes.x)
        x = nodes[:, self.chain.layout.stations].reshape((m, count, -1))
        p, ends = repeated(given.p, count), repeated(given.poses, count)
        return self._mapped(name)(places, rates, x, p, ends)

    def curve_along(
        self, shapes: Shapes, given: Inputs, along: Tangents
    ) -> tuple[FloatArray, FloatArray]:
        """`curve`, and its change (m, n + 1, d or 2 d, q) along directions."""
        advance, by_moving, by_others = self._call_segments("segment_curve_slopes", shapes, given)
        rows, by_station, by_p = self._call_stations("station_slopes", advance, shapes, given)
        clipped, touching = self.clipped(shapes, given), self.touching(shapes, given)
        by_nodes, by_lam = np.split(by_moving, [2 * self.b], axis=-1)
        lam = touching.lam_along(along.lam) if touching else along.lam[:, None]
        x = clipped.free(along.x)  # frames of clips have moved in `_moved_clips`
        steps: FloatArray = by_nodes @ self._both(x) + by_lam @ lam
        steps = self._by_numbers(by_others, along, clipped, steps)
        start = np.zeros((len(steps), self.node.dimension, steps.shape[3]))
        places, rates = self._stations(steps, start)
        shape = (len(steps), self.chain.n + 1, 2 * self.b, steps.shape[3])
        own = x[:, self.chain.layout.stations].reshape(shape)
        moved = by_station @ np.concatenate([places, rates, own], axis=2)
        change = clipped.evenly(moved + by_p @ along.p[:, None])
        for rate, (more, less) in self._moved_clips(given, along.p):
            gap = self.curve(shapes, more) - self.curve(shapes, less)
            change = change + gap[..., None] * rate[:, None, None]
        return clipped.evenly(rows)[..., 0], np.asarray(change)

    def reactions(self, shapes: Shapes, given: Inputs, name: str = "reactions") -> FloatArray:
        """Forces and moments (m, n_reactions) of the cable on its fixtures, `reaction_rows`."""
        found = self._call_ends(name, shapes, given)[0][..., 0]
        touching = self.touching(shapes, given)
        return touching.held(found) if touching else found

    def readings(self, shapes: Shapes, given: Inputs) -> FloatArray:
        """`reactions` as the sensors measure them."""
        return self.reactions(shapes, given, "readings")

    def contacts(self, shapes: Shapes, given: Inputs) -> list[tuple[Contact, ...]]:
        """Where the cables touch obstacles, for each of m poses."""
        touching = self.touching(shapes, given)
        return touching.contacts() if touching else [()] * len(shapes.x)

    def readings_along(self, shapes: Shapes, given: Inputs, along: Tangents) -> FloatArray:
        """Change (m, n_reactions, q) of `readings` along directions."""
        by_ends, by_p, by_deviation = self._call_ends("reading_slopes", shapes, given)
        lam = along.lam[:, : self.n_lam]
        moved = np.concatenate([along.x[:, 0], along.x[:, -1], lam], axis=1)
        change = by_ends @ moved + by_p @ along.p + by_deviation @ along.deviation
        if touching := self.touching(shapes, given):
            pulled = touching.lam_along(along.lam)[:, 0] - along.lam[:, : self.n_lam]
            change[:, reaction_rows(self.node)["start_force"]] -= pulled[:, self.model.end_pull]
        return np.asarray(change)

    # ---- state and strain ------------------------------------------------------------------------

    def strain(self, shapes: Shapes, given: Inputs) -> FloatArray:
        """Mean strains (m, n_rests) [1/m] of the cells, one strain after the other."""
        (rows,) = self._call_segments("segment_strain", shapes, given)
        return self._stacked(rows[..., 0][:, self.chain.layout.bends])

    @staticmethod
    def _stacked(cells: FloatArray) -> FloatArray:
        """Values (m, n_cells, strains, ...) of cells as (m, n_rests, ...), strain after strain."""
        by_strain = np.moveaxis(cells, 2, 1)
        m, n_cells, strains, *columns = cells.shape
        return by_strain.reshape((m, n_cells * strains, *columns))

    def state_after(self, shapes: Shapes, given: Inputs) -> tuple[FloatArray, ...]:
        """Rest strains (m, n_rests) after the poses, and their derivatives.

        The derivatives (m, n_rests, ...) are by both nodes (2b), by the cell's own rest strains
        (strains), by p (n_parameters), and by the pose's deviation (n_deviations).
        """
        after, *by = self._cells_after(shapes, given)
        m, n_p = given.p.shape
        # Only saddles move the edges of cells.
        every = self.model.clamped_between * np.broadcast_to(np.eye(n_p), (m, n_p, n_p))
        for rate, pair in self._moved_clips(given, every, turned=False):
            more, less = (self._cells_after(shapes, one)[0] for one in pair)
            by[2] = by[2] + (more - less) * rate[:, None]
        return (after[..., 0], *by)

    def _cells_after(self, shapes: Shapes, given: Inputs) -> list[FloatArray]:
        """As `state_after`, with the derivatives by p at fixed edges of the cells."""
        found = self._call_segments("segment_state", shapes, given)
        return [self._stacked(part[:, self.chain.layout.bends]) for part in found]

    def rest_stays(self, slopes: tuple[FloatArray, ...]) -> bool:
        """Whether poses leave the rest curvature unchanged, to first order."""
        same = np.repeat(np.eye(len(self.node.strains)), self.chain.n_cells, axis=0)
        return bool(np.all(slopes[2] == same))

    def state_along(self, slopes: tuple[FloatArray, ...], along: Tangents) -> FloatArray:
        """Change (m, n_rests, q) of the rest strains after poses along directions."""
        _, by_x, by_rest, by_p, by_deviation = slopes
        strains = (1, len(self.node.strains), 1)
        both = np.tile(self._both(along.x)[:, self.chain.layout.bends], (*strains, 1))
        own = np.tile(np.stack(self.chain.by_strain(along.rest), axis=2), (*strains, 1))
        moved = (by_x[:, :, None] @ both + by_rest[:, :, None] @ own)[:, :, 0]
        return np.asarray(moved + by_p @ along.p + by_deviation @ along.deviation)


@lru_cache(maxsize=MODELS)
def assembly_of(model: CableModel) -> Assembly:
    """The assembly of a model, made once."""
    return Assembly(model)
