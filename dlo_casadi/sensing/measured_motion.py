"""A recording of the moving cable, as the fit needs it."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from dlo_casadi.arrays import FloatArray


@dataclass(frozen=True)
class MeasuredMotion:
    """Points of a moving cable, how its ends were held meanwhile, and how it began.

    Parameters
    ----------
    t : (T,) [s]
        Times from zero at the first instant.
    points : (T, K, d) [m]
        NaN where a marker was not seen, or where a line ends before its arc length.
    s : (K,) [m]
        Arc lengths of the points.
    fixtures_t : (F,) [s]
        Times of the fixtures' clock, from the same zero; empty if all rests.
    moving : dict
        By the names of a pose's fields, what moved: start, end (F, d) [m], start_heading,
        end_heading (F,) [rad], start_orientation, end_orientation (F, 4).
    resting : dict
        By the same names: what is held and rests.
    at_rest : bool
        Whether the cable hangs still at the first instant.
    across : (T, K, d - 1, d), optional
        Of points of lines: unit vectors across the line, along which alone they are compared. Where
        a point lies along its line is told by the line's length, to second order indifferent.
    note : str
        What was left out of the recording, for the report.
    """

    name: str
    t: FloatArray
    points: FloatArray
    s: FloatArray
    fixtures_t: FloatArray
    moving: Mapping[str, FloatArray]
    resting: Mapping[str, FloatArray]
    at_rest: bool
    held_out: bool
    across: FloatArray | None = None
    note: str = ""

    def held_at(self, k: int) -> dict[str, FloatArray]:
        """By the names of a pose's fields, what is held in row k of the fixtures."""
        return {**self.resting, **{name: rows[k] for name, rows in self.moving.items()}}

    @property
    def compared(self) -> int:
        """Numbers that are compared of each point: all coordinates of markers, d - 1 of lines."""
        return self.points.shape[2] - (self.across is not None)

    @property
    def noise(self) -> float:
        """Noise [m] of a coordinate from frame to frame; 0 if the frames are too few to tell.

        The median absolute divided difference of seven neighbours, over the root of the sum of its
        squared weights: a motion of nine or more frames a period hardly touches it, at uneven times
        either; that of white noise is 0.6745 times its std.
        """
        count = len(self.t) - 6
        if count < 1:
            return 0.0
        t = np.stack([self.t[k : k + count] for k in range(7)], axis=1)
        apart = t[:, :, None] - t[:, None, :]
        apart[:, range(7), range(7)] = 1.0
        weights = 1 / (apart / np.abs(apart).max(axis=(1, 2), keepdims=True)).prod(axis=2)
        weights /= np.linalg.norm(weights, axis=1, keepdims=True)
        windows = np.stack([self.points[k : k + count] for k in range(7)], axis=1)
        sizes = np.abs(np.einsum("tk,tk...->t...", weights, windows))
        known = sizes[np.isfinite(sizes)]
        return float(np.median(known)) / 0.6745 if len(known) else 0.0

    def deviations(self, predicted: FloatArray) -> FloatArray:
        """Predicted minus measured points (T', K, compared) [m] of the first T' instants.

        `predicted`: (T', K, d), or columns of derivatives (T', K, d, q), of which nothing is
        subtracted.
        """
        count, moved = len(predicted), predicted.ndim == 4
        off = predicted if moved else (predicted - self.points[:count])[..., None]
        if self.across is not None:
            off = self.across[:count] @ off
        return off if moved else off[..., 0]
