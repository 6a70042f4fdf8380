"""A model's functions at the shapes of many poses: one of a segment, mapped over all segments."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Self

import numpy as np

from dlo_casadi.arrays import FloatArray, IntArray
from dlo_casadi.model.cable_model import FREE_LENGTH, VIEWPOINT_SIZE, CableModel
from dlo_casadi.model.clipped import Clipped
from dlo_casadi.model.clips import clip_size, laid_for
from dlo_casadi.model.contact import DEPTH, Touching, outwards
from dlo_casadi.model.functions import functions_of
from dlo_casadi.model.slides import Ends
from dlo_casadi.model.stacked import Beyond, Inputs, Mapped, Shapes, repeated
from dlo_casadi.rod.ends import EndConditions


@dataclass(frozen=True, eq=False)
class Evaluation:
    """A model's functions at the shapes of m poses.

    Parameters
    ----------
    depth : float
        Of the cable in obstacles, see `contact.DEPTH`.
    everywhere : bool
        Whether forces of obstacles act whatever the gaps.
    """

    model: CableModel
    shapes: Shapes
    given: Inputs
    depth: float = DEPTH
    everywhere: bool = False

    def subset(self, index: Any) -> Self:
        """Some of the poses, with what is known about their contacts."""
        found = replace(self, shapes=self.shapes.subset(index), given=self.given.subset(index))
        if touching := vars(self).get("touching"):
            vars(found)["touching"] = touching.subset(index)
        return found

    @cached_property
    def felt_everywhere(self) -> Self:
        """The same poses; forces of obstacles act whatever the gaps."""
        return replace(self, everywhere=True)

    @cached_property
    def clipped(self) -> Clipped:
        """Where the clips are on the cable."""
        model, given, x = self.model, self.given, self.shapes.x
        if not model.moves_nodes:
            return Clipped.none(model.chain, len(x))
        size, d = clip_size(model.node), model.node.dimension
        declared = given.poses[:, given.poses.shape[1] - model.clip_numbers :]
        declared = declared.reshape((len(x), len(model.clips), size))
        slips, turns = functions_of(model).clip_slopes
        near = np.pad(declared[..., -1], [(0, 0), (1, 1)])
        near[:, -1] = model.cable.length
        held = near + np.pad(given.p @ slips.T, [(0, 0), (1, 1)])
        if model.slides and model.fed_by_length:
            free = given.poses[:, EndConditions.size(model.node) + VIEWPOINT_SIZE]
            end, sign = self._fed_end
            near[:, end] += sign * (free - model.cable.length)
            held[:, end] = near[:, end] + sign * self.shapes.deviation[:, self._free_length]
            near[:, end] = laid_for(model.chain, near[:, [0, -1]])[:, end]
        if model.sliding:
            slides, rows = [*model.sliding], [*model.sliding.values()]
            held[:, slides], own = self.shapes.lam[:, rows], self.shapes.near_each(len(rows))
            near[:, slides] = np.where(np.isnan(own), held[:, slides], own)
            fed = np.zeros(near.shape, dtype=bool)
            fed[:, slides] = np.isnan(own)
            fed, ends = fed[:, [0, -1]], near[:, [0, -1]]
            near[:, [0, -1]] = np.where(fed, laid_for(model.chain, ends), ends)
        return Clipped.of(model, declared[..., d:-1], near, held, given.p @ turns, x)

    @property
    def _free_length(self) -> int:
        """Index of the deviation of the free length."""
        return self.model.deviation_names.index(FREE_LENGTH)

    @property
    def _fed_end(self) -> tuple[int, float]:
        """Index of the end that slides among the supports, and change of its arc length."""
        return (-1, 1.0) if self.model.end.slides else (0, -1.0)

    @cached_property
    def touching(self) -> Touching | None:
        """Which nodes touch obstacles; None without obstacles."""
        if not self.model.surfaces:
            return None
        d = self.model.node.dimension

        def advances(lam: FloatArray, rows: IntArray) -> FloatArray:
            return self.subset(rows)._call_segments("segment_curve", lam)[0][:, :, :d, 0]

        shifts = self.given.p @ outwards(self.model).T
        nodes = self.shapes.lam, self.given.poses[:, :d], shifts
        return Touching.of(self.model, *nodes, self.depth, self.everywhere, advances)

    # ---- calls ---------------------------------------------------------------------------------

    def _mapped(self, name: str) -> Mapped:
        return functions_of(self.model).mapped(name)

    def _call_segments(self, name: str, lam: FloatArray | None = None) -> list[FloatArray]:
        """Evaluate a function for all segments: outputs (m, n_segments, rows, columns).

        `lam` (m, n_segments, n_lam): forces; by default those of the shapes and contacts.
        """
        found = self._mapped(name)(*(self._arguments if lam is None else self._with_forces(lam)))
        if self.model.clips:
            self._beyond.spread(name, found, 2 * self.model.node.increment)
        return found

    def _call_some(self, at: Ends, name: str) -> list[FloatArray]:
        """Evaluate a function for some segments: outputs (N, rows, columns)."""
        found = self._mapped(name)(*(part[at][:, None] for part in self._arguments))
        if self.model.clips:
            own = Beyond(self._beyond.before[at][:, None], self._beyond.rows)
            own.spread(name, found, 2 * self.model.node.increment)
        return [out[:, 0] for out in found]

    @cached_property
    def _beyond(self) -> Beyond:
        return Beyond.of(self.model, self.clipped.before)

    @cached_property
    def _arguments(self) -> list[FloatArray]:
        """Arguments (m, n_segments, ...) of functions of segments, with the shapes' forces."""
        shapes, count = self.shapes, self.model.chain.n_segments
        return self._with_forces(
            self.touching.lam if self.touching else repeated(shapes.lam, count)
        )

    def _with_forces(self, lam: FloatArray) -> list[FloatArray]:
        """Arguments of functions of segments with forces lam (m, n_segments, n_lam)."""
        shapes, clipped, count = self.shapes, self.clipped, self.model.chain.n_segments
        p, deviation = (repeated(one, count) for one in (self.given.p, shapes.deviation))
        both, table = clipped.carried(self._both(shapes.x)), clipped.segments()
        own = self._beyond.summed(lam) if self.model.clips else lam
        return [both, own, p, self._rest_inside, table, deviation]

    @property
    def _rest_inside(self) -> FloatArray:
        """Rest strains inside (m, n_segments, 3 strains) of even segments."""
        return self.clipped.rest_inside(self.given.rest[..., None])[..., 0]

    def _both(self, nodes: FloatArray) -> FloatArray:
        """Rows (m, n_segments, 2 k, ...) of both nodes of segments, from (m, n_nodes, k, ...)."""
        count = self.model.chain.n_segments
        following = np.minimum(np.arange(count) + 1, self.model.chain.n_nodes - 1)
        return np.concatenate([nodes[:, :count], nodes[:, following]], axis=2)

    def _call_ends(self, name: str) -> list[FloatArray]:
        """Evaluate a function of both ends: outputs (m, rows, columns)."""
        shapes, given = self.shapes, self.given
        both = np.concatenate([shapes.x[:, :1], shapes.x[:, -1:]], axis=2)
        lam = shapes.lam[:, : self.model.n_lam]
        rows = (both[:, 0], lam, given.p, given.poses, shapes.deviation)
        return [out[:, 0] for out in self._mapped(name)(*(row[:, None] for row in rows))]
