"""Quick fits of a few poses, by which hypotheses on a session are compared."""

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from dlo_casadi.errors import EstimationError
from dlo_casadi.estimation.fit import fit_model
from dlo_casadi.estimation.result import Fit
from dlo_casadi.model.cable_model import BENDING_STIFFNESS
from dlo_casadi.model.tolerances import Tolerances
from dlo_casadi.sensing.measured_pose import MeasuredPose
from dlo_casadi.session.fitting import declared_model
from dlo_casadi.session.read_session import ReadSession, spread
from dlo_casadi.thresholds import CONTRADICTS, UNEXPLAINED

# Per comparison: poses; elements of the mesh, points of a line, rest curvature coefficients.
POSES = 8
MESH, _POINTS, _REST = 12, 24, 4
# Largest relative standard deviation at which stiffness over weight counts as known: wrong units,
# a factor of five or more, are then recognised.
_SIZED = 0.5


class Coarse(NamedTuple):
    """A quick fit of the declared cable, its effects kept, to a few poses.

    Parameters
    ----------
    fit : Fit or None
        None where no equilibria were found near the shapes.
    rms : float [m]
        RMS residual; without a fit the distance at which ends count as contradicting a pose.
    weight : bool
        Whether the shapes determine stiffness over weight, or there is no weight.
    sized : bool
        Whether they determine it: only then is the size of forces known.
    correlation : float
        Of the residuals of neighbouring points: near zero where only noise is left.
    """

    fit: Fit | None
    rms: float
    weight: bool
    sized: bool = False
    correlation: float = 1.0


def coarse_fit(session: ReadSession, most: int = POSES) -> Coarse:
    """Quick fit of at most `most` poses, evenly spaced, held-out ones included.

    Declared effects keep their declared values; one that changes from pose to pose is left out.
    """
    measured, length, experiment = [], session.config.cable.length, session.config.experiment
    for k in spread(len(session.read), most):
        item = session.read[k]
        kept = spread(len(item.points), _POINTS)
        s = None if item.s is None else item.s[kept]
        pose = session.declared[item.name].held
        seen = MeasuredPose.of_points(pose, item.points[kept], s=s)
        if experiment.fed_by_length and pose.free_length is None:
            seen = seen.fed_as_seen(length, experiment.boundary.fed)
        measured.append(seen)
    declared = declared_model(session.config, known=True)
    # A set depends on the poses between those that are fitted here.
    effects = tuple(x for x in declared.model.effects if x.kind != "state")
    model = replace(declared.model, effects=effects, priors={}, n=MESH, n_rest=_REST)
    given = dict(zip(declared.model.names, declared.start, strict=True))
    try:
        fit = fit_model(
            model,
            measured,
            Tolerances(),
            UNEXPLAINED * length,
            free=replace(model, effects=()).names,
            values=np.array([given[name] for name in model.names]),
            refined=False,
        )
    except EstimationError:
        return Coarse(None, CONTRADICTS * length, False)
    sized = bool(fit.std(BENDING_STIFFNESS) < _SIZED * fit.value(BENDING_STIFFNESS))
    weight = sized or not any(model.gravity)
    return Coarse(fit, fit.residual_rms, weight, sized, _correlation(fit))


def _correlation(fit: Fit) -> float:
    """Correlation of the residuals of neighbouring points on a line."""
    pairs, squares = 0.0, 0.0
    for item, residual in zip(fit.problem.fit_poses, fit.linearization.raw, strict=True):
        for series in item.along(residual):
            pairs += float(series[1:] @ series[:-1])
            squares += float(series[1:] @ series[1:] + series[:-1] @ series[:-1]) / 2
    return pairs / max(squares, 1e-300)
