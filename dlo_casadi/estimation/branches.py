"""The equilibrium in which a pose was measured, as a measurement of the parameters.

Without a branch that it names a pose is in the stable equilibrium of lowest energy; so a model says
that predicts it. The shapes alone may leave open which one that is: a stiff cable in a single pose
fits as well with a rest curvature that would bring it to the other side.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from dlo_casadi.equilibrium.equilibrium import Equilibrium
from dlo_casadi.equilibrium.pose import Pose
from dlo_casadi.errors import EstimationError
from dlo_casadi.estimation.prediction import measured_elsewhere, predict_poses
from dlo_casadi.estimation.result import Fit
from dlo_casadi.estimation.variances import SETTLED_MODES, refine
from dlo_casadi.model.assembly import Inputs, Shapes, assembly_of
from dlo_casadi.model.cable_model import CableModel
from dlo_casadi.thresholds import BIC_APART

FloatArray = NDArray[np.floating]

# How far a measured equilibrium is to lie below the predicted one, in standard deviations of their
# gap, and how closely that is held. Of nine simulated sessions of one pose eight predicted another
# equilibrium than was measured: all eight came there in one round; chi-square rose by 2.5 at most.
BELOW, KEPT = 0.2, 0.03
ROUNDS = 4
# Steps of numerical derivatives of the energy, in units of the directions: it is a polynomial of
# second degree in stiffnesses and rest curvatures, so that central differences are exact.
_STEP = 1e-4


@dataclass(frozen=True)
class EnergyGap:
    """Energy of one equilibrium of a pose above another one.

    Parameters
    ----------
    value : float [J]
    slope : (q,) [J]
        Along q directions of the parameters, less what grows with the bending stiffness: of a
        stiffness that is hardly known it says nothing about the sign.
    std : float [J]
        Standard deviation of the value, the smaller one of with and without that part.
    """

    value: float
    slope: FloatArray
    std: float

    @classmethod
    def between(
        cls,
        model: CableModel,
        pose: Pose,
        pair: tuple[Equilibrium, Equilibrium],
        given: tuple[FloatArray, FloatArray],
        along: tuple[FloatArray, FloatArray],
        covariance: FloatArray,
    ) -> EnergyGap:
        """Gap of the first of two equilibria above the second.

        Parameters
        ----------
        given : (n_parameters,), (n_rests,)
            Parameters and rest curvature at which they are equilibria.
        along : (n_parameters, q), (n_rests, q)
            Directions of both.
        covariance : (q, q)
            Along these.
        """
        value = pair[0].energy - pair[1].energy
        first, second = (_slope(model, pose, eq, given, along) for eq in pair)
        whole = first - second
        slope = whole - value * along[0][0] / given[0][0]
        variances = [max(float(way @ covariance @ way), 0.0) for way in (whole, slope)]
        return cls(value, slope, float(np.sqrt(min(variances))))


def _slope(
    model: CableModel,
    pose: Pose,
    eq: Equilibrium,
    given: tuple[FloatArray, FloatArray],
    along: tuple[FloatArray, FloatArray],
) -> FloatArray:
    """Derivative (q,) of an equilibrium's energy: that of the Lagrangian at a fixed shape."""
    steps = [np.concatenate([_STEP * ways.T, -_STEP * ways.T]) for ways in along]
    p, rest = (base + step for base, step in zip(given, steps, strict=True))
    m, q = len(p), len(p) // 2
    shapes = Shapes.declared(np.repeat(eq.x[None], m, 0), np.repeat(eq.multipliers[None], m, 0))
    total = assembly_of(model).balance(shapes, Inputs(p, rest, np.repeat(pose.vector[None], m, 0)))[
        0
    ]
    return np.asarray((total[:q] - total[q:]) / (2 * _STEP))


def as_measured(fit: Fit) -> Fit:
    """A fit, or one that predicts its poses in the equilibria in which they were measured.

    The unknowns are fitted once more as far as needed for these to be the lowest ones; their
    covariance stays that of the shapes. Where the evidence is very strong against it, the fit stays
    as it is: something is missing.
    """
    found = fit
    for _ in range(ROUNDS):
        gaps = _gaps(found)
        if not gaps:
            break
        try:
            found = _refitted(found, gaps)
        except EstimationError:
            return fit
    lost = fit.log_evidence - found.log_evidence
    return found if lost < BIC_APART / 2 and not _gaps(found) else fit


def _gaps(fit: Fit) -> list[EnergyGap]:
    """By the unknowns: energy of each fitted pose as measured above another one, predicted."""
    problem, model, unknowns = fit.problem, fit.model, fit.problem.unknowns
    poses = [item.pose for item in problem.history]
    predictions = predict_poses(model, fit.p, fit.rest, poses)
    own = [predictions[k] for k in problem.indices]
    nodes = {problem.measured[j].pose.name: fit.point.shapes.x[j] for j in problem.used}
    others = measured_elsewhere(model, fit.p, fit.rest, problem.measured, own, nodes)
    along = unknowns.slopes(fit.point.theta), unknowns.rest_slopes
    gaps = []
    for j in problem.used:
        there, known = others[j], own[j]
        if there is not None and known is not None:
            pair = there.equilibrium, known.equilibrium
            pose = problem.measured[j].pose
            given = fit.p, known.rest
            gaps.append(EnergyGap.between(model, pose, pair, given, along, fit.covariance))
    return gaps


def _refitted(fit: Fit, gaps: Sequence[EnergyGap]) -> Fit:
    """The fit where it is told that all gaps are below zero, to first order."""
    problem, told = fit.problem, []
    for gap in gaps:
        row = gap.slope / (KEPT * gap.std)
        aim = -BELOW * gap.std - gap.value
        told.append((row, float(row @ fit.point.theta) + aim / (KEPT * gap.std)))
    knowing = refine(
        fit.reweighed(priors=replace(problem.priors, told=tuple(told))),
        rounds=2,
        modes=SETTLED_MODES,
    )
    plain = knowing.reweighed(priors=replace(knowing.problem.priors, told=()))
    return replace(plain, converged=True)
