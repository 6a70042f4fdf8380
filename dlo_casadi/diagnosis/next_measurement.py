"""The measurement that would separate two models which explain the same poses."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from dlo_casadi.arrays import FloatArray
from dlo_casadi.diagnosis.found import AddedEffect, rivals_of
from dlo_casadi.equilibrium.curve import Observed
from dlo_casadi.equilibrium.pose import HeldPose
from dlo_casadi.equilibrium.spread import Repeats
from dlo_casadi.estimation.prediction import Prediction, predict_each, uncertainty_of
from dlo_casadi.estimation.result import Fit
from dlo_casadi.rod.ends import reaction_rows
from dlo_casadi.rod.quantities import quantity_of
from dlo_casadi.thresholds import NOTABLE

# Number of trial poses that may separate two models: directions of the clamp, or end poses drawn
# within the region that the session has explored.
TRIED = 12
SEED = 0
# Largest number of repeats that is proposed.
MOST_REPEATS = 20


@dataclass(frozen=True)
class Telling:
    """The measurement that separates two models which explain the same poses.

    Parameters
    ----------
    pose : str
        Name of the measured pose in which a reading separates them best.
    reading : NextReading
        That reading.
    heading : float or None [rad]
        For a free tip in a plane: direction of the start clamp at which the shapes differ most.
    difference : float or None [m]
        That difference, RMS along the cable.
    """

    pose: str
    reading: NextReading
    heading: float | None = None
    difference: float | None = None


def telling(fit: Fit, other: Fit) -> Telling | None:
    """The measurement that separates two fits of the same poses; None without their shapes.

    The shapes are those on the measured branches, or predicted where none is found there.
    """
    poses = [item.pose for item in fit.problem.fit_poses]
    shapes = (_near(one, poses) for one in (fit, other))
    pairs = [(a, b) for a, b in zip(*shapes, strict=True) if a is not None and b is not None]
    if not pairs:
        return None
    readings = [next_reading(fit, a.seen, b.seen) for a, b in pairs]
    best = max(range(len(pairs)), key=lambda k: readings[k].separation)
    turned = (None, None) if fit.model.end.place else _pose_that_tells(fit, other)
    return Telling(pairs[best][0].pose.name, readings[best], *turned)


def _near(fit: Fit, poses: Sequence[HeldPose]) -> list[Prediction | None]:
    """Predictions of a fit's poses, from the fitted shapes where that leads to an equilibrium."""
    given, starts = (fit.model, fit.p, fit.rest_now), fit.point.shapes.x[fit.problem.used]
    found = predict_each(*given, poses, [*starts])
    lost = [k for k, one in enumerate(found) if one is None]
    again = predict_each(*given, [poses[k] for k in lost]) if lost else []
    for k, one in zip(lost, again, strict=True):
        found[k] = one
    return found


def _pose_that_tells(fit: Fit, other: Fit) -> tuple[float | None, float | None]:
    """Direction [rad] of the clamp at which two fits differ most, and that difference [m], RMS."""
    if fit.model.in_space or not fit.model.start.direction:
        return None, None
    base = fit.problem.fit_poses[0].pose
    places = np.linspace(0.0, fit.model.cable.length, 51)
    headings, differences = np.linspace(-np.pi, np.pi, TRIED, endpoint=False), []
    poses = [replace(base, start_heading=float(x), branch=None) for x in headings]
    shapes = (predict_each(one.model, one.p, one.rest_now, poses) for one in (fit, other))
    for pair in zip(*shapes, strict=True):
        curves = [
            item.curve.at(places)
            for item in pair
            # Near a clamp that points up the cable may fall to either side: not a clear test.
            if item is not None and item.equilibrium.other_side is None
        ]
        gap = curves[0] - curves[1] if len(curves) == 2 else np.full((1, 2), np.nan)
        differences.append(float(np.sqrt((gap**2).sum(axis=1).mean())))
    if np.isnan(differences).all():
        return None, None
    best = int(np.nanargmax(differences))
    return float(headings[best]), differences[best]


@dataclass(frozen=True)
class NextReading:
    """The force or moment on a fixture by which rivals differ most in a pose.

    Parameters
    ----------
    name : str
        Of `ends.REACTIONS`.
    difference : float [N or N m]
        Size of the difference of the two predictions.
    separation : float
        The same in standard deviations of one measurement, including the bias of the sensor.
    times : int or None
        Number of measurements that separate the rivals; None if the bias hides the difference.
    """

    name: str
    difference: float
    separation: float
    times: int | None


@dataclass(frozen=True)
class NextPose:
    """An end pose at which rivals predict different shapes.

    Parameters
    ----------
    end : (d,) [m]
    difference : float [m]
        RMS difference of the two predictions.
    separation : float
        The same in standard deviations of one measurement: sqrt(d^T (E / m + P)^-1 d), m = 1, for
        the differences d of the predicted measurements at the points of the nearest pose. E is the
        covariance of what differs from one measurement to the next: noise, fixtures and the cable's
        own scatter. P is that of the parameters of both fits, which new fits could change.
    times : int or None
        Number m of measurements that separate them by NOTABLE standard deviations; None if
        MOST_REPEATS do not.
    reading : NextReading
        Measurement of a sensor at a fixture that separates them best there.
    separates : tuple of str
        Names of the rivals.
    """

    end: tuple[float, ...]
    difference: float
    separation: float
    times: int | None
    reading: NextReading
    separates: tuple[str, ...] = ()


def separating_pose(fit: Fit, added: Sequence[AddedEffect]) -> NextPose | None:
    """Pose that separates one of a fit's added effects from its closest rival."""
    for item in added:
        for name, rival in rivals_of(fit, item).items():
            found = next_pose(fit, rival.fit)
            return None if found is None else replace(found, separates=(item.candidate.name, name))
    return None


def next_pose(first: Fit, second: Fit) -> NextPose | None:
    """Reachable end pose at which two fits predict the most different shapes.

    The candidates are spread over the box of the ends used so far, a tenth wider, within 97 % of
    the cable's length from the start. None for a free end.
    """
    poses = [item.pose for item in first.problem.history]
    if not first.model.end.place:
        return None
    ends = np.array([pose.end for pose in poses])
    low, high = ends.min(axis=0), ends.max(axis=0)
    margin = 0.1 * np.maximum(high - low, 0.1 * first.model.cable.length)
    generator = np.random.default_rng(SEED)
    places = np.linspace(0.0, first.model.cable.length, 101)
    tried: list[HeldPose] = []
    for _ in range(TRIED):
        end = generator.uniform(low - margin, high + margin)
        nearest = poses[int(((ends - end) ** 2).sum(axis=1).argmin())]
        reach = float(np.linalg.norm(end - np.array(nearest.start)))
        if 0.03 < reach / first.model.cable.length < 0.97:
            tried.append(replace(nearest, end=tuple(map(float, end)), name="next"))
    rivals = [predict_each(fit.model, fit.p, fit.rest_now, tried) for fit in (first, second)]
    clear: list[tuple[float, Prediction, Prediction]] = []
    for one, other in zip(*rivals, strict=True):
        if one is None or other is None:
            continue
        gap = one.curve.at(places) - other.curve.at(places)
        difference = float(np.sqrt((gap**2).sum(axis=1).mean()))
        # Above a tenth of the length the rivals are on different branches: not a clear test.
        if difference <= 0.1 * first.model.cable.length:
            clear.append((difference, one, other))
    if not clear:
        return None
    difference, one, other = max(clear, key=lambda found: found[0])
    end = np.array(one.pose.end)
    place = tuple(round(float(x), 4) for x in end)
    # Seen like the fit pose whose end is nearest, at the arc lengths of its points.
    measured = first.problem.fit_poses
    away = np.array([item.pose.end for item in measured]) - end
    k = int((away**2).sum(axis=1).argmin())
    s, item = first.point.projections[k], measured[k]
    moved, again = _displaced(first, one, s)
    open_too, _ = _displaced(second, other, s)
    gap = one.curve.at(s) - other.curve.at(s)
    seen = item.whitening(first.noise, s) @ item.components(
        one.curve, s, np.concatenate([gap[..., None], again, moved, open_too], axis=2)
    )
    found = _separations(*np.split(seen, [1, 1 + again.shape[2]], axis=1))
    times = next((m for m, apart in enumerate(found, 1) if apart >= NOTABLE), None)
    reading = next_reading(first, one.seen, other.seen)
    return NextPose(place, difference, float(found[0]), times, reading)


def next_reading(fit: Fit, one: Observed, other: Observed) -> NextReading:
    """The wrench measurement that best separates two predictions of a pose."""
    tolerances, noise = fit.problem.priors.tolerances, fit.noise.readings
    found = []
    for name, at in reaction_rows(fit.model.node).items():
        quantity = quantity_of(name)
        std = noise.of(quantity)
        known = [fit.std(own) for own in fit.model.names if f".{name}" in own]
        bias = max(known, default=getattr(tolerances, quantity.bias_key))
        difference = float(np.linalg.norm(one.readings[at] - other.readings[at]))
        left = (difference / NOTABLE) ** 2 - bias**2
        times = int(np.ceil(std**2 / left)) if left > 0 else None
        found.append(NextReading(name, difference, difference / float(np.hypot(std, bias)), times))
    return max(found, key=lambda item: item.separation)


def _displaced(fit: Fit, found: Prediction, s: FloatArray) -> tuple[FloatArray, FloatArray]:
    """`displacements` (K, d, q) [m] by the fit's parameters, and those that each repeat draws."""
    known = uncertainty_of(fit)
    _, moved = Repeats(found, known).displacements(s)
    causes = known.causes_in(fit.model)
    kept = np.zeros(moved.shape[2], bool)
    kept[: len(causes)] = [cause == "parameters" for cause in causes]
    return moved[..., kept], moved[..., ~kept]


def _separations(difference: FloatArray, again: FloatArray, kept: FloatArray) -> FloatArray:
    """Difference of two predicted lines in standard deviations of the mean of 1 to MOST_REPEATS.

    All in white noise of one std: the difference (n, 1), independent changes of one std that each
    measurement draws again (n, q), and such that are the same in all of them (n, r).
    """
    drawn, fixed = np.eye(len(difference)) + again @ again.T, kept @ kept.T
    covariances = (drawn / m + fixed for m in range(1, MOST_REPEATS + 1))
    return np.sqrt(
        [float((difference.T @ np.linalg.solve(c, difference))[0, 0]) for c in covariances]
    )
