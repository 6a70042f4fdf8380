"""What a tracker tells: of a pose, and of a motion to come."""

from __future__ import annotations

from dataclasses import dataclass

from dlo_casadi.arrays import FloatArray
from dlo_casadi.errors import counted
from dlo_casadi.tracking.inquiry import Change


@dataclass(frozen=True, eq=False)
class Update:
    """What one pose told.

    Parameters
    ----------
    number : int
        Of the pose, the first is 1.
    innovation : (R,)
        Measured minus predicted before the pose was used, whitened: independent, of std 1.
    rms : float [m]
        Root of the mean square of the points' part of it, in metres.
    probability : float
        Of an innovation as large by chance.
    refused : bool
        Whether the pose was left out, because that is less than 1 in 100,000.
    change : Change or None
        If the cable is another one than before: an alarm, or news of its cause.
    iterations : int
    """

    number: int
    innovation: FloatArray
    rms: float
    probability: float
    refused: bool
    change: Change | None
    iterations: int

    def __repr__(self) -> str:
        if not self.innovation.size:
            return "nothing to compare with a prediction"
        text = f"{1e3 * self.rms:.3g} mm off the prediction, p = {self.probability:.2g}"
        text += ", refused" if self.refused else ""
        return text + (f", {self.change}" if self.change else "")


@dataclass(frozen=True, eq=False)
class Ahead:
    """A predicted motion.

    Parameters
    ----------
    t : (T,) [s]
    s : (K,) [m]
        Arc lengths.
    points, std : (T, K, d) [m]
        Places of the cable and their standard deviations: what is uncertain, and the error of the
        mesh; without the noise of a measurement.
    """

    t: FloatArray
    s: FloatArray
    points: FloatArray
    std: FloatArray

    def __repr__(self) -> str:
        times = f"{counted(len(self.t), 'instant')} from {self.t[0]:g} to {self.t[-1]:g} s"
        most = f"std up to {1e3 * self.std.max():.3g} mm"
        return f"{times}, {counted(len(self.s), 'place')} on the cable, {most}"
