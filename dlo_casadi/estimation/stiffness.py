"""Simple estimates: the stiffness alone, and moment against curvature without any fit."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.integrate import cumulative_trapezoid
from scipy.interpolate import make_lsq_spline
from scipy.optimize import minimize_scalar

from dlo_casadi.arrays import FloatArray, chord_lengths
from dlo_casadi.equilibrium.batch import BatchEquilibrium
from dlo_casadi.equilibrium.curve import Observed
from dlo_casadi.equilibrium.equilibrium import stacked
from dlo_casadi.errors import EstimationError
from dlo_casadi.estimation.prediction import measured_elsewhere, predict_poses
from dlo_casadi.estimation.start import SearchSettings
from dlo_casadi.estimation.variances import first_reading_noise
from dlo_casadi.model.assembly import Shapes
from dlo_casadi.model.cable_model import CableModel
from dlo_casadi.model.functions import functions_of
from dlo_casadi.sensing.measured_pose import MeasuredPose
from dlo_casadi.sensing.noise import NoiseModel

# Steps per decade of the first search.
_PER_DECADE = 3
# Decades to both sides of the prior searched by readings alone: no shape starts a search nearby.
READ_DECADES = 3
LEAST_POINTS = 10
# Degree and maximum number of parts of the measured curve. Its curvature is a cubic spline of eight
# coefficients; of fewer if the curve has fewer than two points per coefficient.
DEGREE, MOST_PARTS = 5, 5
# Points of the integrals, and places of the result.
FINE = 1000
PLACES = 100


@dataclass(frozen=True)
class StiffnessFit:
    """Bending stiffness EI [N m^2] that predicts the fit poses best, and its log's std."""

    EI: float
    log_std: float


def fit_stiffness(model: CableModel, measured: Sequence[MeasuredPose]) -> StiffnessFit:
    """Least squares of the distances of all fit points over EI, the cable straight at rest.

    If no fit pose has points, of the errors of readings over their noise. The equilibria are
    followed from the prior stiffness along the decades, each on the branch of the prediction there,
    or on that on which the pose was measured.
    """
    used = [item for item in measured if item.readable and not item.held_out]
    seen = [item for item in used if item.has_points]
    alone, used = not seen, seen or used
    equilibria = BatchEquilibrium(model, [item.pose for item in used], wrenches=alone)
    rest = np.zeros(model.chain.n_rests)
    noise = replace(NoiseModel(1.0), readings=first_reading_noise(model))
    # Several squares for each marker, and for each point of a line in space.
    compared = [item.traced if item.has_line else item for item in used]
    n_squares = sum(int((item.on_points | alone).sum()) for item in compared)

    def off(item: MeasuredPose, seen: Observed) -> FloatArray:
        """Distances of points [m], or errors of readings over their noise."""
        return item.misread(seen, noise) if alone else item.distances(seen.curve)

    stiff, search = model.stiffness_indices, SearchSettings.of(model)
    decades = READ_DECADES if alone else search.decades

    def at(log_ei: float) -> FloatArray:
        # Torsional stiffness is changed by the same factor as bending stiffness.
        p = model.nominal.copy()
        p[stiff] *= np.exp(log_ei) / p[0]
        return p

    def follow(shapes: Shapes, from_log_ei: float, log_ei: float) -> tuple[Shapes, float]:
        # If bending dominates the weight, the shape stays the same and the forces grow with EI.
        grown = replace(shapes, lam=shapes.lam * np.exp(log_ei - from_log_ei))
        start = min(
            shapes,
            grown,
            key=lambda x: float(np.linalg.norm(equilibria.balance(x, at(log_ei), rest)[0].rows)),
        )
        moved, converged = equilibria.solve(start, at(log_ei), rest)
        if not converged.all() or not equilibria.stable(moved, at(log_ei), rest).all():
            cold = _cold(model, at(log_ei), rest, used) if search.predicts or alone else None
            if cold is None:
                return shapes, np.inf
            moved = cold
        total = sum(
            float((off(item, seen) ** 2).sum())
            for seen, item in zip(equilibria.seen(moved, at(log_ei), rest), used, strict=True)
        )
        return moved, total

    prior = float(np.log(model.cable.bending_stiffness))
    grid: dict[float, tuple[Shapes, float]] = {}
    first = _cold(model, at(prior), rest, used)
    if first is None:
        straight = np.tile(model.node.identity, (len(used), model.chain.n_nodes, 1))
        first = equilibria.start_shapes(straight)
    step = np.log(10) / _PER_DECADE
    for direction in (1, -1):
        shapes = first
        for k in range(decades * _PER_DECADE + 1):
            log_ei = prior + direction * k * step
            shapes, total = follow(shapes, log_ei - direction * min(k, 1) * step, log_ei)
            grid[log_ei] = (shapes, total)
    best = min(grid, key=lambda q: grid[q][1])
    if not np.isfinite(grid[best][1]):
        return StiffnessFit(float(np.exp(best)), float("inf"))
    # Some poses may have left their measured branch on the way.
    near = _cold(model, at(best), rest, used) or grid[best][0]

    # If a pose is lost, return a finite value worse than any other, so a parabola fits.
    lost = max(total for _, total in grid.values() if np.isfinite(total))

    def cost(log_ei: float) -> float:
        total = follow(near, best, log_ei)[1]
        return total if np.isfinite(total) else lost

    found = minimize_scalar(
        cost, bounds=(best - step, best + step), method="bounded", options={"xatol": 1e-3}
    )
    total, log_ei = min((float(found.fun), float(found.x)), (cost(best), best))
    width = 0.02
    bend = (cost(log_ei + width) - 2 * total + cost(log_ei - width)) / width**2
    variance = total / max(n_squares - 1, 1)
    log_std = float(np.sqrt(2 * variance / bend)) if bend > 0 else float("inf")
    return StiffnessFit(float(np.exp(log_ei)), log_std)


def _cold(
    model: CableModel, p: FloatArray, rest: FloatArray, used: Sequence[MeasuredPose]
) -> Shapes | None:
    """Stable equilibria as measured or else predicted; None if one is missing."""
    predictions = predict_poses(model, p, rest, [item.pose for item in used])
    others = measured_elsewhere(model, p, rest, used, predictions)
    found = [other or known for known, other in zip(predictions, others, strict=True)]
    equilibria = [prediction.equilibrium for prediction in found if prediction]
    return stacked(equilibria) if len(equilibria) == len(found) else None


@dataclass(frozen=True)
class MomentCurve:
    """Bending moment [N m] and curvature >= 0 [1/m] at arc lengths s [m], all (K,)."""

    s: FloatArray
    curvature: FloatArray
    moment: FloatArray


def measured_moment_curve(
    points: FloatArray,
    length: float,
    weight: float,
    gravity: tuple[float, ...],
    s: FloatArray | None = None,
) -> MomentCurve:
    """Moment against curvature of a cable with a free end, without any law of its section.

        kappa(s) = |dt/ds|,   n = (dt/ds) / kappa,   a(s) = int_s^L (r(q) - r(s)) dq
        M(s) = (a . t) (f . n) - (a . n) (f . t),   f = w g / |g|

    M is the moment of the part beyond s, in the plane of the tangent t and the normal n in which
    the cable bends there. It is positive where the weight increases the bend. The curve r is a
    quintic spline from the first point to the last, fitted by least squares; the part beyond the
    last point is taken as straight.

    Parameters
    ----------
    points : (K, d) [m]
        From the clamp towards the free end, at least 10 points; d = 2 or 3.
    length : float [m]
    weight : float [N/m]
    gravity : (d,) [m/s^2]
        Only its direction is used.
    s : (K,) [m], optional
        Arc lengths of the points, if known; by default from the chords, which are scaled to add up
        to the whole cable.

    Raises
    ------
    EstimationError
        If there are too few points.

    References
    ----------
    The cantilever test as evaluated by Broberg et al., Composites Part B 260 (2023).
    """
    if len(points) < LEAST_POINTS:
        raise EstimationError(
            f"a moment curve needs at least {LEAST_POINTS} points, got {len(points)}"
        )
    if s is None:
        s = chord_lengths(points)
        s *= length / s[-1]  # chords of noisy points add up to more than the cable
    parts = min(MOST_PARTS, len(points) // 2 - DEGREE)
    order = np.argsort(s, kind="stable")
    s, points = s[order], points[order]
    # As many points between two knots everywhere, also beside a hidden stretch.
    edges = np.quantile(s, np.linspace(0.0, 1.0, max(parts, 1) + 1))
    spline = make_lsq_spline(s, points, np.pad(edges, DEGREE, mode="edge"), DEGREE)
    fine = np.linspace(s[0], s[-1], FINE)
    curve, velocity, acceleration = (spline(fine, k) for k in range(3))
    speed = np.linalg.norm(velocity, axis=1, keepdims=True)
    tangent = velocity / speed
    bend = acceleration - (acceleration * tangent).sum(axis=1, keepdims=True) * tangent
    bend /= speed**2
    curvature = np.linalg.norm(bend, axis=1)
    normal = bend / np.maximum(curvature, 1e-300)[:, None]
    force = weight * np.array(gravity) / np.linalg.norm(gravity)
    tip = length - s[-1]
    whole = cumulative_trapezoid(curve[::-1], fine, axis=0, initial=0)[::-1]
    whole += tip * (curve[-1] + tip / 2 * tangent[-1])
    beyond = whole - (length - fine)[:, None] * curve
    moment = (beyond * tangent).sum(axis=1) * (normal @ force)
    moment -= (beyond * normal).sum(axis=1) * (tangent @ force)
    kept = slice(None, None, FINE // PLACES)
    return MomentCurve(fine[kept], curvature[kept], moment[kept])


def law_of(model: CableModel, p: FloatArray, bend: FloatArray) -> FloatArray:
    """Moments (K,) [N m] of a model's section at bends (K,) [1/m].

    Laws that vary along the cable are evaluated at its middle.
    """
    return np.array([float(functions_of(model).section_moment(value, p)) for value in bend])
