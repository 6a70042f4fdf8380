"""One pose in one stage of a fit."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from scipy.special import chdtri

from dlo_casadi.arrays import BoolArray, Brief, FloatArray
from dlo_casadi.equilibrium.pose import PoseBranch
from dlo_casadi.equilibrium.spread import COVERED, Tipping


@dataclass(frozen=True, repr=False)
class BranchShape(Brief):
    """The stable equilibrium in which a pose was measured, where it is not the predicted one.

    Parameters
    ----------
    rmse : float or None [m]
        Root mean square distance of the measured points from it; None of readings alone.
    branch : "ccw", "cw", "previous" or None
        Value of `branch` with which it is predicted; None if there is none.
    turns : 0.5, -0.5, 1, -1 or None
        Value of `turns` with which it is predicted, see `HeldPose`.
    above : float [J]
        Its energy minus that of the predicted equilibrium.
    """

    rmse: float | None
    branch: PoseBranch | None
    turns: float | None = None
    above: float = 0.0

    @property
    def chosen_by(self) -> str | None:
        """The entry that a pose needs in its configuration for it to be predicted."""
        if self.turns:
            return f"turns: {self.turns:g}"
        return f"branch: {self.branch}" if self.branch else None


@dataclass(frozen=True, repr=False)
class EitherSide(Brief):
    """A pose on both sides on which its cable may hang, see `CableModel.tipped_by`.

    Parameters
    ----------
    predicted, other : BranchShape
        On the predicted side, and on the other one.
    tipping : Tipping or None
        Clamp angle from the pose at which both sides have equal energy; None where no angle has, to
        first order: `turns` may also distinguish arcs to different sides.
    """

    predicted: BranchShape
    other: BranchShape
    tipping: Tipping | None

    @property
    def told(self) -> bool:
        """Whether the pose was measured on the other side, or the lower side is uncertain."""
        near = self.tipping is not None and self.tipping.either
        return near or (self.other.rmse or 0.0) < (self.predicted.rmse or 0.0)


@dataclass(frozen=True, repr=False)
class PoseShape(Brief):
    """One pose in one stage.

    Parameters
    ----------
    curve : (M, d) [m]
        Shape predicted from the end conditions alone, as the camera would see it.
    rmse : float or None [m]
        Root mean square distance of the measured points from it; None without points.
    s : (K,) [m]
        Arc lengths of the measured points.
    gap : (K, d) [m]
        Measured minus predicted points.
    residual : (K,) or (K, 2) [m]
        Distance of the measured points across the prediction. In the plane: to its left. In
        space: along two normals that start as the axes y and z of the cable's frame and are
        carried along without twist.
    energy : float [J]
    forces : (2, d) [N]
        Force of the cable on what holds its start and its end.
    readings : mapping
        Forces [N] and moments [N m] that were measured on the fixtures, by name: measured values,
        and predicted ones as a sensor would show them.
    reading_std : mapping
        By the same names: standard deviation of the difference that noise, fixtures and parameters
        let expect; empty if it was not computed.
    spread : (M,) or (M, 2) or None [m]
        Standard deviation of the next repeat across the curve, like the residual; None if it was
        not computed.
    missed, expected : (K,) or None [m]
        Distance of each measured point from the prediction in the compared directions, and its
        RMS expected from noise and the scatter of a repeat; None if they were not computed.
    measured_branch : BranchShape or None
        Set where the pose was measured in another stable equilibrium than the predicted one.
    undecided : bool
        Whether that equilibrium may be the lowest one, given the uncertainty of parameters and
        fixtures and the cable's scatter.
    measured_side : BranchShape or None
        Set for a fit pose that is compared on the side where it was measured, not on the lower one.
    either_side : EitherSide or None
        Set for a held-out pose without a declared side that has two; None if it was not computed.
    clips : tuple of dict
        Forces and moments on its clips, see `clip_rows`.
    fed : float [m]
        Length that was fed through a sliding end: free minus declared length.
    contacts : tuple of dict
        Where it touches obstacles, see `Contact.row`.
    """

    curve: FloatArray
    rmse: float | None
    s: FloatArray
    gap: FloatArray
    residual: FloatArray
    energy: float
    stable: bool
    forces: FloatArray
    measured_branch: BranchShape | None = None
    undecided: bool = False
    measured_side: BranchShape | None = None
    either_side: EitherSide | None = None
    spread: FloatArray | None = None
    missed: FloatArray | None = None
    expected: FloatArray | None = None
    readings: Mapping[str, tuple[FloatArray, FloatArray]] = field(default_factory=dict)
    reading_std: Mapping[str, FloatArray] = field(default_factory=dict)
    clips: tuple[Mapping[str, Any], ...] = ()
    fed: float = 0.0
    contacts: tuple[Mapping[str, Any], ...] = ()

    @property
    def misread(self) -> float:
        """RMS error of the readings over what is expected; zero if there are none."""
        off = [
            (known - model) / std
            for name, std in self.reading_std.items()
            for known, model in [self.readings[name]]
        ]
        return float(np.sqrt(np.mean(np.concatenate(off) ** 2))) if off else 0.0

    def inside_band(self, length: float, noise: float) -> BoolArray:
        """Whether each measured point (K,) lies in its 90 % band, which includes noise."""
        assert self.spread is not None
        places = np.linspace(0.0, length, len(self.spread))
        spread = self.spread.reshape((len(places), -1))
        std = np.stack([np.interp(self.s, places, column) for column in spread.T], axis=1)
        score = (self.residual.reshape(std.shape) / np.hypot(std, noise)) ** 2
        return np.asarray(score.sum(axis=1) <= float(chdtri(std.shape[1], 1 - COVERED)))
