"""What the steps of one extraction have seen."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from dlo_casadi.vision.trace import Trace
from dlo_casadi.vision.view import Array
from dlo_casadi.vision.workplane import WorkPlane


@dataclass
class Workings:
    """Filled by `extract_centerline`, as far as it comes.

    Parameters
    ----------
    plane : WorkPlane
        The rectified picture.
    candidate : (h, w) float32
        How much each of its pixels stands out in the colour of the cable.
    cut : float
        Level above which a pixel may be cable.
    lines : list of (K, 2) [m]
        All strands found at that level.
    chosen : tuple of (K, 2) [m]
        Those that make up the cable, from start to end.
    trace : Trace
        The cable's middle, profile by profile.
    """

    plane: WorkPlane | None = None
    candidate: NDArray[np.float32] | None = None
    cut: float = 0.0
    lines: list[Array] = field(default_factory=list)
    chosen: tuple[Array, ...] = ()
    trace: Trace | None = None
