"""Quick fits of a few poses on a coarse mesh: which of several declarations the shapes confirm."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from dlo_casadi.config import Config
from dlo_casadi.errors import EstimationError
from dlo_casadi.estimation.fit import fit_model
from dlo_casadi.estimation.result import Fit
from dlo_casadi.model.cable_model import BENDING_STIFFNESS, Tolerances
from dlo_casadi.sensing.measured_pose import MeasuredPose
from dlo_casadi.session.fitting import declared_model
from dlo_casadi.session.measure import conditions
from dlo_casadi.session.outcome import PoseInput
from dlo_casadi.thresholds import BEYOND_EFFECTS, BIC_APART, CONTRADICTS, MUCH_BETTER, UNEXPLAINED

# Poses of a comparison, points of a line, elements of the mesh, coefficients of the rest curvature.
_POSES, _POINTS, _MESH, _REST = 8, 24, 12, 4
_DECADES = (0, -1, 1)
# Stiffness over weight is known if its relative standard deviation is below this: units are told
# where forces are five times off.
_SIZED = 0.5


class Hypothesis(NamedTuple):
    """What a session may have been meant as: the configuration and the points that it then has."""

    what: str
    config: Config
    inputs: Sequence[PoseInput]


class Comparison(NamedTuple):
    """The declared session beside the hypothesis that explains its shapes best, both fitted.

    Parameters
    ----------
    what : str
        The hypothesis.
    own, other : Fit or None
        None where no stiffness gives equilibria near the shapes.
    length : float [m]
        Of the cable.
    """

    what: str
    own: Fit | None
    other: Fit | None
    length: float

    @property
    def misfits(self) -> tuple[float, float]:
        """RMS distances [m] that the declaration and the hypothesis leave.

        Without a fit as far as ends that contradict a pose.
        """
        pair = (self.own, self.other)
        left = [CONTRADICTS * self.length if fit is None else fit.residual_rms for fit in pair]
        return left[0], left[1]

    @property
    def told(self) -> str:
        """What both leave, in words."""
        own, other = self.misfits
        left = f"the lines are {own:.3g} m RMS from the shapes of any stiffness, but"
        if self.own is None:
            left = "no stiffness gives equilibria near the lines, but they are within"
        return f"{left} {other:.3g} m with {self.what}"

    @property
    def better(self) -> bool:
        """Whether the declaration leaves more than noise, and the hypothesis clearly less.

        Where the declaration has no fit the hypothesis has to show a weight: a fit of few points
        may fail, or not, by chance.
        """
        if self.own is None and not (self.other and tells_weight(self.other)):
            return False
        own, other = self.misfits
        return own > UNEXPLAINED * self.length and other < MUCH_BETTER * own

    @property
    def certain(self) -> bool:
        """Whether it is clearly better, and no effect that is missing explains it."""
        return self.better and self.misfits[0] > BEYOND_EFFECTS * self.length

    @property
    def shows_weight(self) -> bool:
        """Whether only the hypothesis shows a weight, and it explains the shapes, and better.

        Under gravity against the weight the best fit is a cable too stiff to show any.
        """
        if self.other is None or not tells_weight(self.other):
            return False
        if self.own is not None and tells_weight(self.own):
            return False
        own, other = self.misfits
        if other > BEYOND_EFFECTS * self.length:
            return False
        # Difference of the BIC of two models with the same unknowns.
        return bool(2 * self.other.problem.n_residuals * np.log(own / other) > BIC_APART)


def compare(
    config: Config,
    read: Sequence[PoseInput],
    hypotheses: Sequence[Hypothesis],
    most: int = _POSES,
) -> Comparison | None:
    """Fit the declared session, and each hypothesis until one explains all; the best one.

    Of so many poses at most.

    None where there is no hypothesis, or the declared session explains its shapes and weight.
    """
    if not (read and hypotheses):
        return None
    length = config.cable.length
    own = coarse_fit(config, some(read, most))
    if own is not None and tells_weight(own) and own.residual_rms <= UNEXPLAINED * length:
        return None
    best: Comparison | None = None
    for what, other, inputs in hypotheses:
        found = Comparison(what, own, coarse_fit(other, some(inputs, most)), length)
        if best is None or found.misfits < best.misfits:
            best = found
        if found.certain and found.misfits[1] < UNEXPLAINED * length:
            break
    return best


def some(read: Sequence[PoseInput], most: int = _POSES) -> Sequence[PoseInput]:
    """A few poses, evenly picked."""
    return [read[k] for k in spread(len(read), most)]


def spread(count: int, most: int) -> NDArray[np.intp]:
    """Indices of at most so many of `count`, evenly picked, both ends among them."""
    return np.linspace(0, count - 1, min(count, most)).round().astype(int)


def coarse_fit(config: Config, inputs: Sequence[PoseInput]) -> Fit | None:
    """Fit of the declared cable without effects; None if none is found.

    It takes all inputs, whatever their role.
    """
    declared = {pose.name: pose for pose in config.experiment.poses}
    measured = []
    for item in inputs:
        kept = spread(len(item.points), _POINTS)
        s = None if item.s is None else item.s[kept]
        pose = conditions(declared[item.name])
        measured.append(MeasuredPose.of_points(pose, item.points[kept], s=s))
    model = declared_model(config).model
    model = replace(model, effects=(), priors={}, n=_MESH, n_rest=_REST)
    noise = UNEXPLAINED * config.cable.length
    try:
        return fit_model(model, measured, Tolerances(), noise, decades=_DECADES)
    except EstimationError:
        return None


def tells_weight(fit: Fit) -> bool:
    """Whether the shapes tell stiffness over weight."""
    return bool(fit.std(BENDING_STIFFNESS) < _SIZED * fit.value(BENDING_STIFFNESS))
