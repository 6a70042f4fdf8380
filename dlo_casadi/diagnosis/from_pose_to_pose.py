"""Fits in which something differs at random from pose to pose, or nothing does."""

from contextlib import suppress
from dataclasses import replace

import numpy as np

from dlo_casadi.diagnosis.from_data import COMPARED, NEAR_NOISE, expected_left
from dlo_casadi.errors import EstimationError
from dlo_casadi.estimation.descent import descend
from dlo_casadi.estimation.fit import explains, fine_enough, refine_mesh
from dlo_casadi.estimation.relaxation import SOFTNESS, Relaxation
from dlo_casadi.estimation.result import Fit
from dlo_casadi.estimation.start import fit_from, relaxed
from dlo_casadi.estimation.unknowns import Values
from dlo_casadi.estimation.variances import A_LINE, pose_scatter_of, refine
from dlo_casadi.model.pose_scatter import PoseScatter, sources_in
from dlo_casadi.runtime.work import accounted_as

# Standard deviations of what is loose in each pose: of a place or a length, as a share of the
# length; of a clamp's turns [rad]; of the curvature by a pin's moment, in 1 / length. A judgement:
# a setup in which they differ more is a broken one.
LOOSE_PLACE, LOOSE_TURN, LOOSE_BEND = 0.02, 0.1, 1.0
# Most places of few markers, and the share of the length within which two count as one: a clamp and
# four of them tell a cubic, which has two numbers more than a line.
FEW, MARKERS_APART = 4, 0.02


def as_repeating(fit: Fit) -> Fit:
    """Refit as if nothing differed at random from pose to pose, with the noise as it is."""
    return descend(fit.reweighed(priors=replace(fit.problem.priors, pose_scatter=PoseScatter())))


def as_line(fit: Fit) -> Fit:
    """Refit with a rest curvature that is held to a line along the cable."""
    priors = replace(fit.problem.priors, roughness_std=A_LINE)
    return descend(fit.reweighed(priors=priors))


def few_places(fit: Fit) -> bool:
    """Whether markers show shapes at so few places that an effect looks like a wavy rest shape.

    Of a rest curvature they then tell hardly more numbers beside a line than an effect has.
    """
    items = fit.problem.fit_poses
    if not fit.has_points or not all(x.marked for item in items for x in item.sensors):
        return False
    length = fit.model.cable.length
    places = np.sort(np.concatenate([item.places(length) for item in items]))
    return 1 + int((np.diff(places) > MARKERS_APART * length).sum()) <= FEW


@accounted_as("loose poses")
def with_loose_poses(misfit: Fit, near: Fit, finest: int | None = None) -> Fit | None:
    """Fit, started at relaxed shapes, in which something other than the shape at rest is random.

    Ends that turn or move, moments of pins, lengths: one of them is an unknown of each pose, with a
    wide prior. None if no such fit meets the points. Missing effects hardly look like turns or
    displacements: with both loose at once, eight of nine sessions in space in which one of them is
    random left at most 1.02 times the noise, twelve with hidden effects 1.2 to 140 times.

    Parameters
    ----------
    misfit : Fit
        Of the declared model.
    near : Fit
        The same model relaxed at the measured shapes, see `from_data`.
    finest : int, optional
        Maximum number of elements to which the mesh may be refined; by default the misfit's mesh.
    """
    problem, model = near.problem, near.model
    sizes = {
        "m": LOOSE_PLACE * model.cable.length,
        "rad": LOOSE_TURN,
        "1/m": LOOSE_BEND / model.cable.length,
    }
    least, begun = NEAR_NOISE * expected_left(near), None
    for scatter in (PoseScatter(1.0, source=source) for source in sources_in(model)):
        loose = replace(scatter, std=sizes[scatter.unit(model)])
        own = replace(problem, priors=replace(problem.priors, pose_scatter=loose))
        own, point = own.taken_over(near.point, problem)
        values: Values = point
        # The objective grows as the balance hardens: what exceeds the least one will not return.
        for soft in COMPARED:
            values = relaxed(own, values, (soft,))
            left = Relaxation(own, soft).objective(values)
            if left >= least:
                break
        else:
            least, begun = left, (own, point, values)
    if begun is None:
        return None
    with suppress(EstimationError):
        own, point, values = begun
        fit = fit_from(own, point, SOFTNESS[len(COMPARED) :], followed=values)
        found = None if fit is None else at_random(fit)
        if found is not None:
            n = misfit.model.n
            found = fine_enough(found, found.model.n, finest=finest) if finest else found
            found = found if finest or found.model.n == n else refine_mesh(found, n)
            if found.problem.random_std.any() and explains(found):
                return found
    return None


@accounted_as("random differences")
def at_random(fit: Fit, n: int = 0, finest: int | None = None) -> Fit | None:
    """Refit with the likeliest random effect from pose to pose; None if none explains the points.

    A misfit is fitted with the noise that it had before. `n`: number of elements at least, up to
    `finest`; by default those of the fit.
    """
    known = fit.noise.before or fit.noise
    found = pose_scatter_of(fit.reweighed(known), known).scatter
    if not found.std:
        return None
    with suppress(EstimationError):
        priors = replace(fit.problem.priors, pose_scatter=found)
        near = refine(fit.reweighed(known, priors), first=True)
        if not explains(near):
            return None
        if finest:
            near = fine_enough(near, max(near.model.n, min(n, finest)), finest=finest)
        return near if explains(near) else None
    return None
