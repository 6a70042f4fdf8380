"""Which pose to photograph next: the one that separates rival explanations best."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from dlo_casadi.equilibrium.curve import NodeCurve, Observed
from dlo_casadi.equilibrium.pose import Pose
from dlo_casadi.estimation.prediction import Prediction, predict_each
from dlo_casadi.estimation.result import Fit
from dlo_casadi.rod.ends import reaction_rows
from dlo_casadi.thresholds import APART

FloatArray = NDArray[np.floating]

# End poses that are tried, drawn within the reach that the session has explored.
TRIED = 30
SEED = 0


@dataclass(frozen=True)
class NextReading:
    """The force or moment on a fixture by which rivals differ most in a pose.

    Parameters
    ----------
    name : str
        Of `ends.REACTIONS`.
    difference : float [N] or [N m]
        Size of the difference of the two predictions.
    separation : float
        The same in standard deviations of one reading, that of a bias of the sensor included.
    times : int or None
        How often it has to be read to tell them apart; None if the bias hides the difference.
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
        The same in standard deviations of one measurement, its noise and the correlation along
        the cable included: sqrt(d^T C^-1 d) with the differences d between the predictions, as
        the sensors see them, at the places of the points that the nearest pose has. What a new
        fit of either rival could adapt to is not taken off.
    reading : NextReading
        What a sensor at a fixture would tell there.
    separates : tuple of str
        Names of the rivals.
    """

    end: tuple[float, ...]
    difference: float
    separation: float
    reading: NextReading
    separates: tuple[str, ...] = ()


def next_pose(first: Fit, second: Fit) -> NextPose | None:
    """Reachable end pose at which two fits predict the most different shapes.

    The candidates are spread over the box of the ends that were used, a tenth wider, within
    97 % of the cable's length from the start; None for a free end.
    """
    poses = [item.pose for item in first.problem.history]
    if first.model.end == "free":
        return None
    ends = np.array([pose.end for pose in poses])
    low, high = ends.min(axis=0), ends.max(axis=0)
    margin = 0.1 * np.maximum(high - low, 0.1 * first.model.cable.length)
    generator = np.random.default_rng(SEED)
    places = np.linspace(0.0, first.model.cable.length, 101)
    tried: list[Pose] = []
    for _ in range(TRIED):
        end = generator.uniform(low - margin, high + margin)
        nearest = poses[int(((ends - end) ** 2).sum(axis=1).argmin())]
        reach = float(np.linalg.norm(end - np.array(nearest.start)))
        if 0.03 < reach / first.model.cable.length < 0.97:
            tried.append(replace(nearest, end=tuple(map(float, end)), name="next"))
    rivals = [predict_each(fit.model, fit.p, _rest_now(fit), tried) for fit in (first, second)]
    best: tuple[float, Pose, Prediction, Prediction] | None = None
    for pose, one, other in zip(tried, *rivals, strict=True):
        if one is None or other is None:
            continue
        gap = one.curve.at(places) - other.curve.at(places)
        difference = float(np.sqrt((gap**2).sum(axis=1).mean()))
        # Beyond a tenth of the length the rivals sit on different branches: no clean test.
        if difference > 0.1 * first.model.cable.length:
            continue
        if best is None or difference > best[0]:
            best = (difference, pose, one, other)
    if best is None:
        return None
    difference, pose, one, other = best
    end = np.array(pose.end)
    place = tuple(round(float(x), 4) for x in end)
    separation = _separation(first, end, (one.curve, other.curve))
    return NextPose(place, difference, separation, next_reading(first, one.seen, other.seen))


def next_reading(fit: Fit, one: Observed, other: Observed) -> NextReading:
    """Which reading tells two predictions of a pose apart best."""
    tolerances, noise = fit.problem.priors.tolerances, fit.noise.readings
    found = []
    for name, at in reaction_rows(fit.model.node).items():
        moment = name.endswith("moment")
        std = noise.moment if moment else noise.force
        known = [fit.std(own) for own in fit.model.names if f".{name}" in own]
        bias = max(known, default=tolerances.moment_bias if moment else tolerances.force_bias)
        difference = float(np.linalg.norm(one.readings[at] - other.readings[at]))
        left = (difference / APART) ** 2 - bias**2
        times = int(np.ceil(std**2 / left)) if left > 0 else None
        found.append(NextReading(name, difference, difference / float(np.hypot(std, bias)), times))
    return max(found, key=lambda item: item.separation)


def _separation(fit: Fit, end: FloatArray, curves: tuple[NodeCurve, NodeCurve]) -> float:
    """Difference of two curves in standard deviations of one line, measured as that nearest."""
    problem = fit.problem
    ends = np.array([problem.measured[j].pose.end for j in problem.used])
    k = int(((ends - end) ** 2).sum(axis=1).argmin())
    s, item = fit.point.projections[k], problem.measured[problem.used[k]]
    gap = item.components(curves[0], s, (curves[0].at(s) - curves[1].at(s))[..., None])
    return float(np.linalg.norm(item.whitening(fit.noise, s) @ gap))


def _rest_now(fit: Fit) -> FloatArray:
    """Rest curvature after the session's last pose."""
    if not fit.model.has_state:
        return fit.rest
    return fit.problem.equilibria.rest_after_last(fit.point.shapes, fit.p, fit.rest)
