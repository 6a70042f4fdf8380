"""What moves cables along the supports through which they slide."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Self

from dlo_casadi.arrays import FloatArray, IntArray

# Indices (N,) of poses and of segments.
Ends = tuple[IntArray, IntArray]


@dataclass(frozen=True)
class Slides:
    """What moves m cables along the supports through which they slide.

    These are derivatives of the N segments whose ends then move along the cable.

    Parameters
    ----------
    at : (N,), (N,) int
        Indices of their poses and segments.
    rows : (u,) int
        Of the arc lengths at these supports in derivatives of segments.
    rates : (N, 2, u)
        Of the arc lengths of both ends of a segment with those.
    slope : (N, u) [N]
        Of the Lagrangian by those: summed over the segments the configurational force.
    mixed : (N, rows, u)
        Of the gradient of the segments.
    twice : (N, 2, 2)
        Of the Lagrangian by both ends of a segment.
    """

    at: Ends
    rows: IntArray
    rates: FloatArray
    slope: FloatArray
    mixed: FloatArray
    twice: FloatArray

    @classmethod
    def of(cls, at: Ends, rows: IntArray, rates: FloatArray, edges: Sequence[FloatArray]) -> Self:
        """From the outputs (N, ...) of `Functions.segment_by_edges`."""
        mixed, slope, twice = edges
        return cls(at, rows, rates, by_rates(rates, slope)[..., 0], mixed @ rates, twice)

    def add(self, gradient: FloatArray, bend: FloatArray) -> None:
        """Add their rows to gradients and Hessians of the segments (m, n_segments, rows, ...)."""
        (poses, segments), rows = self.at, self.rows
        each = poses[:, None], segments[:, None]
        gradient[(*each, rows, 0)] += self.slope
        bend[(*each, slice(None), rows)] += self.mixed.transpose(0, 2, 1)
        bend[(*each, rows)] += self.mixed.transpose(0, 2, 1)
        both = by_rates(self.rates, self.twice @ self.rates)
        bend[poses[:, None, None], segments[:, None, None], rows[:, None], rows] += both

    def add_along(self, change: FloatArray, turned: FloatArray, rate: FloatArray) -> None:
        """Add to the change of gradients (m, n_segments, rows, q) what moves both nodes.

        Rotations (m, n_segments, 2b, q) and arc lengths (m, n_segments, 2, q) of these.
        """
        own = self.mixed[:, : turned.shape[2]].transpose(0, 2, 1) @ turned[self.at]
        own = own + by_rates(self.rates, self.twice @ rate[self.at])
        poses, segments = self.at
        change[poses[:, None], segments[:, None], self.rows] += own


def by_rates(rates: FloatArray, by_ends: FloatArray) -> FloatArray:
    """Derivatives (N, u, ...) by what moves segments' ends, from those by the ends (N, 2, ...)."""
    return rates.transpose(0, 2, 1) @ by_ends
