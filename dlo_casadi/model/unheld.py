"""Segments without clips inside: the forces beyond them act like one force at their end."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from dlo_casadi.arrays import FloatArray, IntArray
from dlo_casadi.model.clips import BESIDE, CLAMPS

# Axes along which outputs of segment functions are derivatives by nodes and border.
_BORDER_AXES = {
    "segment": ((), (2,), (2, 3)),
    "segment_slope": ((2,),),
    "segment_sensitivity": ((2,),),
    "segment_curve_slopes": ((), (3,), ()),
}


@dataclass(frozen=True)
class Unheld:
    """Segments with no clip inside; all forces beyond them act like one force at their end.

    Functions of a segment take several times as long with clips inside as without.

    Parameters
    ----------
    beyond : (m, n_segments, k)
        1 if a segment lies before a clip, else 0; arbitrary for segments with the clip inside.
    inside : (m, j)
        Segments that contain the j clips that hold no node.
    rows : (1 + k, dimension)
        Border rows of the forces on the end's holder (-1 for a free end) and on the clips.
    """

    beyond: FloatArray
    inside: IntArray
    rows: IntArray

    @classmethod
    def of(
        cls, table: FloatArray, kinds: Sequence[str], rows: list[list[int]], width: float | None
    ) -> "Unheld":
        """From rows of `Clipped.segments`; `width` [m] of the segments, if all have the same."""
        count = len(kinds)
        share = (table[..., -count:] - table[..., :1]) / (width or table[..., 1:2])
        nodes = [k for k, kind in enumerate(kinds) if kind not in CLAMPS]
        dimension = len(rows[-1])
        ends = rows if rows[0] else [[-1] * dimension, *rows[1:]]
        # A clip at a node counts in one segment only: derivatives by its arc length are one-sided.
        inside = np.maximum((share >= -BESIDE).sum(axis=1)[:, nodes] - 1, 0)
        return cls((share > 0.5).astype(float), inside, np.array(ends))

    def evaluated(
        self,
        name: str,
        mapped: Callable[[str, bool], Callable[..., list[FloatArray]]],
        arguments: Sequence[FloatArray],
        first: int,
    ) -> list[FloatArray]:
        """Outputs (m, n_segments, rows, columns) of a function of segments.

        `mapped` (name, unheld) -> the function. Its second argument is the border, whose rows start
        at `first` in outputs that have them.
        """
        both, lam, *others = arguments
        found = mapped(name, True)(both, self.summed(lam), *others)
        for out, axes in zip(found, _BORDER_AXES.get(name, ((),) * len(found)), strict=True):
            for axis in axes:
                self._spread(out, axis, first)
        if self.inside.size:
            here = np.arange(len(lam))[:, None], self.inside
            held = mapped(name, False)(*(one[here] for one in arguments))
            for out, one in zip(found, held, strict=True):
                out[here] = one
        return found

    def summed(self, lam: FloatArray) -> FloatArray:
        """Border (m, n_segments, n_lam) with the sum of all forces beyond as first clip's force."""
        own, (end, *clips) = lam.copy(), self.rows
        total = np.zeros(lam.shape[:2] + end.shape) if end[0] < 0 else lam[..., end]
        for k, rows in enumerate(clips):
            total = total + self.beyond[..., [k]] * lam[..., rows]
        own[..., clips[0]] = total
        return own

    def _spread(self, out: FloatArray, axis: int, first: int) -> None:
        """Expand derivatives by that sum, from row `first` of an axis, to those by each force."""
        rows = np.moveaxis(out, axis, 0)
        end, *clips = first + self.rows
        total = rows[clips[0]].copy()
        shape = (*self.beyond.shape[:2], *(1,) * (out.ndim - 3))
        if self.rows[0, 0] >= 0:
            rows[end] = total
        for k, own in enumerate(clips):
            rows[own] = total * self.beyond[..., k].reshape(shape)
