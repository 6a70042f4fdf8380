"""A recording of the moving cable, as the fit needs it."""

from collections.abc import Mapping
from dataclasses import dataclass

from dlo_casadi.arrays import FloatArray


@dataclass(frozen=True)
class MeasuredMotion:
    """Points of a moving cable, how its ends were held meanwhile, and how it began.

    Parameters
    ----------
    t : (T,) [s]
        Times from zero at the first instant.
    points : (T, K, d) [m]
        NaN where a marker was not seen; of lines, behind their last points.
    s : (K,) [m], optional
        Arc lengths of markers; without them the points of an instant are a line.
    fixtures_t : (F,) [s]
        Times of the fixtures' clock, from the same zero; empty if all rests.
    moving : dict
        By the names of a pose's fields, what moved: start, end (F, d) [m], start_heading,
        end_heading (F,) [rad], start_orientation, end_orientation (F, 4).
    resting : dict
        By the same names: what is held and rests.
    at_rest : bool
        Whether the cable hangs still at the first instant.
    """

    name: str
    t: FloatArray
    points: FloatArray
    s: FloatArray | None
    fixtures_t: FloatArray
    moving: Mapping[str, FloatArray]
    resting: Mapping[str, FloatArray]
    at_rest: bool
    held_out: bool
