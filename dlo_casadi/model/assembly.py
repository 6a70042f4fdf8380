"""A model's functions, evaluated for many poses at once and assembled into band matrices.

Blocks of the segments are summed to the gradient of the Lagrangian, to its Hessian (block-
tridiagonal, with the multipliers as border), and to the derivatives of both and of the measured
curve.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import cached_property

import numpy as np

from dlo_casadi.arrays import FloatArray, IntArray
from dlo_casadi.model.clipped import NONE, by_axes
from dlo_casadi.model.clips import ClipLoad
from dlo_casadi.model.contact import Contact
from dlo_casadi.model.evaluation import Evaluation
from dlo_casadi.model.functions import functions_of
from dlo_casadi.model.slides import Ends, Slides, by_rates
from dlo_casadi.model.stacked import Inputs, Shapes, Tangents, repeated
from dlo_casadi.rod.band import BandMatrix, Vector
from dlo_casadi.rod.ends import reaction_rows

__all__ = ["Assembly", "Inputs", "Shapes", "Tangents"]


class Assembly(Evaluation):
    """A model's functions at the shapes of m poses, assembled."""

    @cached_property
    def _sliding(self) -> tuple[Ends, IntArray, FloatArray]:
        """Segments, rows and rates of `Slides`."""
        slides, b = self.model.sliding, self.model.node.increment
        ways = np.eye(len(self.model.clips) + 2)[:, [*slides]]
        rates = self._of_ends(np.broadcast_to(ways, (len(self.shapes.x), *ways.shape)))
        at = _somewhere(rates)
        return at, 2 * b + np.array([*slides.values()], dtype=np.intp), rates[at]

    @cached_property
    def _slides(self) -> Slides | None:
        """What moves the cables along the supports through which they slide."""
        if not self.model.sliding:
            return None
        at, rows, rates = self._sliding
        return Slides.of(at, rows, rates, self._call_some(at, "segment_by_edges"))

    def _of_ends(self, rate: FloatArray) -> FloatArray:
        """Changes (m, n_segments, 2, q) of segments' ends with supports (m, k + 2, q) [m]."""
        moved = self.clipped.at_nodes(rate)
        return np.stack([moved[:, :-1], moved[:, 1:]], axis=2)

    def _at_nodes(
        self, first: FloatArray, last: FloatArray, start: FloatArray, end: FloatArray
    ) -> FloatArray:
        """Blocks of segments' nodes (m, n_segments, ...) and of the ends, summed at the nodes."""
        count, n = self.model.chain.n_segments, self.model.chain.n_nodes
        total = np.zeros((len(first), max(count + 1, n), *first.shape[2:]))
        total[:, :count] += first
        total[:, 1 : count + 1] += last
        total = total[:, :n]
        total[:, 0] += start
        total[:, -1] += end
        return total

    @property
    def _parts(self) -> tuple[slice, slice, slice]:
        """Rows of the first node, of the last node, and of the border."""
        b = self.model.node.increment
        return slice(0, b), slice(b, 2 * b), slice(2 * b, None)

    def _added(self, segments: FloatArray, ends: FloatArray) -> Vector:
        """Rows (2b + k, q) of the segments and the ends, summed at nodes and border."""
        first, last, border = self._parts
        x = self._at_nodes(
            segments[:, :, first], segments[:, :, last], ends[:, first], ends[:, last]
        )
        return Vector(x, segments[:, :, border].sum(axis=1) + ends[:, border])

    # ---- balance -------------------------------------------------------------------------------

    def balance(self) -> tuple[FloatArray, Vector, BandMatrix]:
        """Lagrangian (m,) [J], its gradient by increments and multipliers, and its Hessian."""
        value, gradient, bend = self._call_segments("segment")
        if self._slides:
            self._slides.add(gradient, bend)
        end_value, end_gradient, end_bend = self._call_ends("at_ends")
        total = value[:, :, 0, 0].sum(axis=1) + end_value[:, 0, 0]
        matrix = self._held(self._band(bend, end_bend))
        force = self._added(gradient, end_gradient)
        self._hold(force)
        if self.touching:
            total, force = self.touching.added(total, force, gradient)
            matrix = self.touching.matrix(matrix, bend)
        self.clipped.hold_matrix(matrix, self._stiffness.ravel())
        return total, force, matrix

    def _hold(self, force: Vector) -> None:
        """Hold nodes at clamped clips in the clips' frames."""
        if self.clipped.clamps:
            self.clipped.hold(force, self._stiffness * self.clipped.gaps(self.shapes.x))

    @property
    def _stiffness(self) -> FloatArray:
        """Bending stiffness (m, 1, 1, 1) [N m] of an element."""
        own = self.given.p[:, self.model.stiffness_indices[0]] / self.model.chain.h
        return np.asarray(own[:, None, None, None])

    def clip_loads(self) -> list[tuple[ClipLoad, ...]]:
        """What the cables do to their clips, for each of m poses."""
        if not self.model.clips:
            return [()] * len(self.shapes.x)
        forces = self.shapes.lam[:, self.model.pulls[self.model.n_springs :]]
        return self.clipped.loads(forces, self._slope()[1].x[..., 0])

    def _slope(self) -> tuple[FloatArray, Vector]:
        """Gradients of the segments, and their sum with those of the ends, without contacts."""
        (gradient,) = self._call_segments("segment_slope")
        self._add_sliding(gradient, "edge_slope")
        _, end_gradient, _ = self._call_ends("at_ends")
        return gradient, self._added(gradient, end_gradient)

    def _held(self, matrix: BandMatrix) -> BandMatrix:
        """For cables free to roll about their axis, add a stiffness against roll of the first node.

        Such a cable, straight at rest, has the null vector (1, 0, 0) at every node. The stiffness
        changes inertia and Newton steps only along that vector, which may be removed from any step.
        """
        if not self.model.may_spin:
            return matrix
        straight = ~self.given.rest.any(axis=1)
        diagonal = matrix.diagonal.copy()
        diagonal[straight, 0, 0, 0] += matrix.scale[straight]
        return replace(matrix, diagonal=diagonal)

    def imbalance(self) -> Vector:
        """Gradient of the Lagrangian by increments and multipliers, without its Hessian."""
        gradient, force = self._slope()
        self._hold(force)
        if self.touching:
            _, force = self.touching.added(np.zeros(()), force, gradient)
        return force

    def _band(self, bend: FloatArray, ends: FloatArray) -> BandMatrix:
        first, last, border = self._parts
        own, at_ends = bend[:, :, last, last], ends[:, last, last]
        diagonal = self._at_nodes(bend[:, :, first, first], own, ends[:, first, first], at_ends)
        columns = self._added(bend[..., border], ends[..., border])
        upper = bend[:, : self.model.chain.n_nodes - 1, first, last].copy()
        return BandMatrix(diagonal, upper, columns.x, columns.y)

    def energy(self) -> FloatArray:
        """Potential energy (m,) [J]: the Lagrangian without the work of the multipliers.

        Contacts store part of it, see `Touching.given_way`.
        """
        total, gradient, _ = self.balance()
        return total - self.work(gradient)

    def work(self, gradient: Vector) -> FloatArray:
        """Work (m,) [J] of the multipliers in the Lagrangian, given its gradient."""
        pulls = self.shapes.lam * self.model.are_multipliers
        return np.asarray((pulls * gradient.y[:, :, 0]).sum(axis=1))

    def balance_slopes(self) -> tuple[FloatArray, FloatArray]:
        """Derivatives of the gradient by p, rest and deviation, of each segment and of the ends."""
        (segments,) = self._call_segments("segment_sensitivity")
        self._add_sliding(segments, "edge_sensitivity")
        (ends,) = self._call_ends("end_sensitivity")
        return segments, ends

    def _add_sliding(self, gradient: FloatArray, name: str) -> None:
        """Add, to gradients (m, n_segments, rows, q), those by what slides.

        `name`: of the derivatives by the ends of a segment.
        """
        if not self.model.sliding:
            return
        at, rows, rates = self._sliding
        (own,) = self._call_some(at, name)
        gradient[at[0][:, None], at[1][:, None], rows] += by_rates(rates, own)

    def balance_along(self, along: Tangents, slopes: Sequence[FloatArray] | None = None) -> Vector:
        """Change of the gradient at fixed nodes and multipliers along directions.

        `slopes`: the `balance_slopes` if they are known.
        """
        segments, ends = slopes or self.balance_slopes()
        rate = self._slips(along.p, along.deviation)
        changed = self._by_numbers(segments, along) + self._by_slips("segment_by_edges", rate)
        at_ends = ends @ np.concatenate([along.p, along.deviation], axis=1)
        turned = self._by_turns(along.p)
        still: FloatArray | None = None
        if turned.any():
            _, gradient, bend = self._call_segments("segment")
            changed += bend[..., : 2 * self.model.node.increment] @ self._both(turned)
            still = by_axes(self._added(gradient, np.zeros_like(at_ends[..., :1])).x, turned)
        if self._slides:
            shape = len(rate), self.model.chain.n_nodes, self.model.node.increment, rate.shape[2]
            nodes = self._both(np.broadcast_to(turned, shape))
            self._slides.add_along(changed, nodes, self._of_ends(rate))
        total = self._added(changed, at_ends)
        if still is not None:
            total = replace(total, x=total.x + still)
        if self.touching:
            total = self.touching.along(total, changed, along.p)
        self.clipped.hold(total, -self._stiffness * turned)
        return total

    def _by_numbers(
        self, blocks: FloatArray, along: Tangents, total: FloatArray | float = 0.0
    ) -> FloatArray:
        """Add the change along p, rest and deviation to a total, given segments' derivatives."""
        n_p, n_r = along.p.shape[1], blocks.shape[-1] - along.deviation.shape[1]
        total = total + blocks[..., :n_p] @ along.p[:, None]
        if along.rest.any():
            total += blocks[..., n_p:n_r] @ self.clipped.rest_inside(along.rest)
        total += blocks[..., n_r:] @ along.deviation[:, None]
        return np.asarray(total)

    def _by_slips(self, name: str, rate: FloatArray) -> FloatArray:
        """Change (m, n_segments, rows, q) of segments because their clips move along the cable.

        `name`: of derivatives by the ends of a segment; `rate` (m, k, q) [m] of the clips.
        """
        if not rate.any():
            return NONE
        ends = self._of_ends(rate)
        at = _somewhere(ends)
        blocks, *_ = self._call_some(at, name)
        total = np.zeros((*ends.shape[:2], blocks.shape[1], rate.shape[2]))
        total[at] = blocks @ ends[at]
        return total

    def _slips(
        self, p: FloatArray, deviation: FloatArray | None = None, lam: FloatArray | None = None
    ) -> FloatArray:
        """Change (m, k + 2, q) [m] of the supports' arc lengths along directions of these."""
        if not self.model.moves_nodes:
            return np.zeros((len(p), 2, p.shape[2]))
        slips = functions_of(self.model).clip_slopes[0] @ p
        rate = np.pad(slips, [(0, 0), (1, 1), (0, 0)])
        if deviation is not None and self.model.slides and self.model.fed_by_length:
            end, sign = self._fed_end
            rate[:, end] += sign * deviation[:, self._free_length]
        if lam is not None:
            rate[:, [*self.model.sliding]] += lam[:, [*self.model.sliding.values()]]
        return rate

    def _slips_of(self, along: Tangents) -> FloatArray:
        return self._slips(along.p, along.deviation, along.lam)

    def _by_turns(self, p: FloatArray) -> FloatArray:
        """Rotations (m, n_nodes, increment, q) of the nodes that clips hold, likewise."""
        if not self.model.clips:
            return NONE
        turns = functions_of(self.model).clip_slopes[1]
        return self.clipped.turned(np.einsum("kpb,mpq->mkbq", turns, p))

    # ---- the curve ------------------------------------------------------------------------------

    def _stations(self, advance: FloatArray, start: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Places (m, n + 1, d, ...) and rates (m, n + 1, rates, ...) at the element boundaries."""
        steps, d = advance[:, self.model.chain.layout.advancing], self.model.node.dimension
        places = np.concatenate([start[:, None], steps[:, :, :d]], axis=1).cumsum(axis=1)
        rates = steps[:, :, d:]
        mean = (rates[:, 1:] + rates[:, :-1]) / 2
        return places, np.concatenate([rates[:, :1], mean, rates[:, -1:]], axis=1)

    def nodes(self) -> FloatArray:
        """True places (m, n + 1, dimension) [m] of the element boundaries."""
        (advance,) = self._call_segments("segment_curve")
        return self._stations(advance[..., 0], self.given.poses[:, : self.model.node.dimension])[0]

    def curve(self) -> FloatArray:
        """Measured places (m, n + 1, d), for smooth elements with dr/ds (m, n + 1, 2 d)."""
        (advance,) = self._call_segments("segment_curve")
        (rows,) = self._call_stations("station", advance)
        return rows[..., 0]

    def knots_along(self, along: Tangents) -> FloatArray:
        """Change (m, n + 1, q) [m] of the arc lengths of the nodes along directions."""
        return self.clipped.at_nodes(self._slips_of(along))

    def _call_stations(self, name: str, advance: FloatArray) -> list[FloatArray]:
        model, (m, count) = self.model, (len(advance), self.model.chain.n + 1)
        start = self.given.poses[:, : model.node.dimension]
        places, rates = self._stations(advance[..., 0], start)
        nodes = self.clipped.in_frames(self.shapes.x)
        x = nodes[:, model.chain.layout.stations].reshape((m, count, -1))
        p, ends = repeated(self.given.p, count), repeated(self.given.poses, count)
        return self._mapped(name)(places, rates, x, p, ends)

    def curve_along(self, along: Tangents) -> tuple[FloatArray, FloatArray]:
        """`curve`, and its change (m, n + 1, d or 2 d, q) along directions."""
        advance, by_moving, by_others = self._call_segments("segment_curve_slopes")
        rows, by_station, by_p = self._call_stations("station_slopes", advance)
        model, both = self.model, 2 * self.model.node.increment
        by_nodes, by_lam = np.split(by_moving, [both], axis=-1)
        lam = self.touching.lam_along(along.lam) if self.touching else along.lam[:, None]
        x = self.clipped.free(along.x) + self._by_turns(along.p)
        steps: FloatArray = by_nodes @ self._both(x) + by_lam @ lam
        steps = self._by_numbers(by_others, along, steps)
        steps += self._by_slips("curve_by_edges", self._slips_of(along))
        start = np.zeros((len(steps), model.node.dimension, steps.shape[3]))
        places, rates = self._stations(steps, start)
        shape = (len(steps), model.chain.n + 1, both, steps.shape[3])
        own = x[:, model.chain.layout.stations].reshape(shape)
        moved = by_station @ np.concatenate([places, rates, own], axis=2)
        return rows[..., 0], np.asarray(moved + by_p @ along.p[:, None])

    def reactions(self, name: str = "reactions") -> FloatArray:
        """Forces and moments (m, n_reactions) of the cable on its fixtures, `reaction_rows`."""
        found = self._call_ends(name)[0][..., 0]
        return self.touching.held(found) if self.touching else found

    def readings(self) -> FloatArray:
        """`reactions` as the sensors measure them."""
        return self.reactions("readings")

    def contacts(self) -> list[tuple[Contact, ...]]:
        """Where the cables touch obstacles, for each of m poses."""
        if not self.touching:
            return [()] * len(self.shapes.x)
        return self.touching.contacts(self.clipped.places)

    def readings_along(self, along: Tangents) -> FloatArray:
        """Change (m, n_reactions, q) of `readings` along directions."""
        by_ends, by_p, by_deviation = self._call_ends("reading_slopes")
        model, lam = self.model, along.lam[:, : self.model.n_lam]
        moved = np.concatenate([along.x[:, 0], along.x[:, -1], lam], axis=1)
        change = by_ends @ moved + by_p @ along.p + by_deviation @ along.deviation
        if self.touching:
            pulled = self.touching.lam_along(along.lam)[:, 0] - lam
            change[:, reaction_rows(model.node)["start_force"]] -= pulled[:, model.end_pull]
        return np.asarray(change)

    # ---- state and strain ------------------------------------------------------------------------

    def strain(self) -> FloatArray:
        """Mean strains (m, n_rests) [1/m] of the cells, one strain after the other."""
        (rows,) = self._call_segments("segment_strain")
        return self._stacked(rows[..., 0])

    def _stacked(self, segments: FloatArray) -> FloatArray:
        """Values of the segments' cells as (m, n_rests, ...), strain after strain."""
        by_strain = np.moveaxis(segments[:, self.model.chain.layout.bends], 2, 1)
        m, strains, n_cells, *columns = by_strain.shape
        return by_strain.reshape((m, strains * n_cells, *columns))

    def state_after(self) -> tuple[FloatArray, ...]:
        """Rest strains (m, n_rests) after the poses, and their derivatives.

        The derivatives (m, n_rests, ...) are by both nodes (2b), by the cell's own rest strains
        (strains), by p (n_parameters), and by the pose's deviation (n_deviations).
        """
        after, *by = (self._stacked(part) for part in self._call_segments("segment_state"))
        m, n_p = self.given.p.shape
        if self.model.moves_nodes:
            every = np.broadcast_to(np.eye(n_p), (m, n_p, n_p))
            slipped = self._by_slips("state_by_edges", self._slips(every))
            by[2] = by[2] + (self._stacked(slipped) if slipped.any() else 0.0)
        return (after[..., 0], *by)

    def rest_stays(self, slopes: tuple[FloatArray, ...]) -> bool:
        """Whether poses leave the rest curvature unchanged, to first order."""
        same = np.repeat(np.eye(len(self.model.node.strains)), self.model.chain.n_cells, axis=0)
        return bool(np.all(slopes[2] == same))

    def state_along(self, slopes: tuple[FloatArray, ...], along: Tangents) -> FloatArray:
        """Change (m, n_rests, q) of the rest strains after poses along directions."""
        _, by_x, by_rest, by_p, by_deviation = slopes
        chain, strains = self.model.chain, (1, len(self.model.node.strains), 1)
        both = np.tile(self._both(along.x)[:, chain.layout.bends], (*strains, 1))
        own = np.tile(np.stack(chain.by_strain(along.rest), axis=2), (*strains, 1))
        moved = (by_x[:, :, None] @ both + by_rest[:, :, None] @ own)[:, :, 0]
        if self.model.sliding:
            slid = self._by_slips("state_by_edges", self._slips(0 * along.p, None, along.lam))
            moved += self._stacked(slid) if slid.any() else 0.0
        return np.asarray(moved + by_p @ along.p + by_deviation @ along.deviation)


def _somewhere(rates: FloatArray) -> Ends:
    """Indices of the segments whose ends move in some way, of rates (m, n_segments, 2, q)."""
    poses, segments = np.nonzero(rates.any(axis=(2, 3)))
    return poses, segments
