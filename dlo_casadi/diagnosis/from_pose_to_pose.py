"""Fits in which something differs at random from pose to pose, or nothing does."""

from contextlib import suppress
from dataclasses import replace

import numpy as np

from dlo_casadi.diagnosis.from_data import COMPARED, REACHED, expected_left
from dlo_casadi.diagnosis.refits import at_noise
from dlo_casadi.diagnosis.selection import Found, likelier_by
from dlo_casadi.errors import EstimationError
from dlo_casadi.estimation.continuation import relaxed
from dlo_casadi.estimation.descent import descend
from dlo_casadi.estimation.fit import explains, fine_enough
from dlo_casadi.estimation.relaxation import SOFTNESS, Relaxation
from dlo_casadi.estimation.repeats import different_poses
from dlo_casadi.estimation.result import Fit
from dlo_casadi.estimation.start import fit_from
from dlo_casadi.estimation.variances import pose_scatter_of, refine
from dlo_casadi.model.cable_model import Tolerances
from dlo_casadi.model.pose_scatter import PoseScatter
from dlo_casadi.thresholds import DIFFERENT, EVIDENCE_APART

# Standard deviations of loose ends: of the place, as a share of the length, and of a clamp's
# direction [rad]. A judgement: a setup in which they differ more is a broken one.
LOOSE_PLACE, LOOSE_TURN = 0.02, 0.1


def as_repeating(fit: Fit) -> Fit:
    """Refit as if nothing differed at random from pose to pose, with the noise as it is."""
    return descend(fit.reweighed(priors=replace(fit.problem.priors, pose_scatter=PoseScatter())))


def with_moved_ends(near: Fit, finest: int | None = None) -> Fit | None:
    """Fit, started at relaxed shapes, in which the ends of each pose are displaced at random.

    None if no such fit meets the points. Random ends hardly imitate a missing effect: in eight of
    nine sessions in space in which clamps turn or the end moves at random, loose ends left at most
    1.02 times the noise; in twelve with one or two hidden effects 1.2 to 140 times.

    Parameters
    ----------
    near : Fit
        See `from_data`.
    finest : int, optional
        Maximum number of elements to which the mesh may be refined; by default it is kept.
    """
    problem, model = near.problem, near.model
    if different_poses(problem.history, model) < DIFFERENT:
        return None
    sizes = Tolerances(
        end=LOOSE_PLACE * model.cable.length, heading=LOOSE_TURN, rotation=LOOSE_TURN
    )
    wide = np.maximum(problem.priors.scatter, sizes.deviation(model))
    loose = replace(problem, priors=replace(problem.priors, scatter=wide))
    values = relaxed(loose, near.point, COMPARED)
    if Relaxation(loose, COMPARED[-1]).objective(values) > REACHED * expected_left(near):
        return None
    with suppress(EstimationError):
        begun = fit_from(loose, near.point, SOFTNESS[len(COMPARED) :], followed=values)
        found = None if begun is None else at_noise(begun, problem.noise)
        if found is not None and found.problem.random_std.any():
            found = fine_enough(found, found.model.n, finest=finest)[0] if finest else found
            return found if explains(found) else None
    return None


def at_random(fit: Fit) -> Fit | None:
    """Refit of a misfit with a random effect from pose to pose, if that explains it; else None."""
    if different_poses(fit.problem.history, fit.model) < DIFFERENT:
        return None
    known = fit.noise.before or fit.noise
    found = pose_scatter_of(fit.reweighed(known), known).scatter
    if not found.std:
        return None
    with suppress(EstimationError):
        priors = replace(fit.problem.priors, pose_scatter=found)
        near = refine(fit.reweighed(known, priors), first=True)
        return near if explains(near) else None
    return None


def at_random_instead(misfit: Fit, found: Found, finest: int | None = None) -> Fit | None:
    """Refit of a misfit with a random effect, if that explains it as well as found effects do.

    Effects found in a misfit were never tested against the scatter that they leave: the mean over
    12 poses of a scatter of 8 mm was taken for an offset. From this fit on they are. `finest`: as
    in `with_moved_ends`.
    """
    near = at_random(misfit) if found.unexplained or found.fit.scatters else None
    if near is None:
        return None
    if finest:
        n = max(near.model.n, min(found.fit.model.n, finest))
        near = fine_enough(near, n, finest=finest)[0]
    likelier = found.unexplained or likelier_by(found.fit, near) > -EVIDENCE_APART
    return near if likelier and explains(near) else None
