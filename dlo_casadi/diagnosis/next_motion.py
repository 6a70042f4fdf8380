"""The motion that would separate two models which explain the same still poses.

Pulled aside and let go, a cable swings in its modes. Two models of the same shapes predict other
frequencies: of modes k with the differences d_k = log(w_k / w'_k) they are

    sqrt(d^T (E + P)^-1 d)

standard deviations apart. P is what the rival's parameters leave open, and what may differ in
motion within tolerances (TOLERATED_IN_MOTION). E is diagonal: a mode of amplitude a, seen in N
coordinates of a std sigma at times t, tells its rate with the variance

    var(w) = 2 sigma^2 / (a^2 N sum_t g (t - m)^2),   g = exp(-2 zeta w t),   m = sum g t / sum g

whatever its phase, amplitude and damping are. That is the bound of Cramer and Rao.

References
----------
Rife and Boorstyn, IEEE Trans. Inf. Theory 20 (1974); Yao and Pandit, IEEE Trans. Signal Process. 43
(1995).
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass

import numpy as np

from dlo_casadi.arrays import FloatArray
from dlo_casadi.diagnosis.selection import AddedEffect, rivals_of
from dlo_casadi.effects import MeasurementEffect
from dlo_casadi.equilibrium.pose import HeldPose
from dlo_casadi.equilibrium.solve import solve_equilibrium
from dlo_casadi.errors import DloError
from dlo_casadi.estimation.motion_fit import MESH_ERROR, moving_model
from dlo_casadi.estimation.prediction import uncertainty_of
from dlo_casadi.estimation.result import Fit
from dlo_casadi.motion.modes_at_rest import ModesAtRest, directions
from dlo_casadi.sensing.sensors import Markers

# How far a cable is pulled aside, in lengths: with a free end, and between two held ends.
ASIDE, ASIDE_HELD = 0.25, 0.05
# Duration [s] and rate [1/s] of the recording; points along the cable where lines were measured.
DURATION, RATE, POINTS = 3.0, 100.0, 10
# Share of the slowest rate of a cable below which nothing holds a mode.
FREE = 0.05
# Modes that are compared, and poses that are tried at most.
MODES, TRIED = 3, 12


@dataclass(frozen=True)
class Swing:
    """How a rival would swing.

    Parameters
    ----------
    frequencies : (MODES,) [Hz]
    separation : float
        Difference of its first modes in standard deviations. Half its square is the log evidence
        that the motion is expected to give.
    """

    frequencies: tuple[float, ...]
    separation: float


@dataclass(frozen=True)
class NextMotion:
    """A motion in which models of the same still shapes swing differently.

    Parameters
    ----------
    pose : str
        Name of the measured pose whose ends hold the cable.
    at : float [m]
        Arc length at which it is pulled aside and let go.
    aside : float [m]
        How far.
    duration : float [s]
        Of the recording, at RATE.
    frequencies : (MODES,) [Hz]
        Of the model.
    rivals : dict of Swing
        By their names.
    of : str
        What the rivals would stand for; empty for the model as it is.
    """

    pose: str
    at: float
    aside: float
    duration: float
    frequencies: tuple[float, ...]
    rivals: Mapping[str, Swing]
    of: str = ""


def separating_motion(fit: Fit, added: Sequence[AddedEffect]) -> NextMotion | None:
    """The let-go that separates one of a fit's added effects from its rivals."""
    for item in added:
        rivals = {name: one.fit for name, one in rivals_of(fit, item).items()}
        if found := next_motion(fit, rivals, item.name):
            return found
    return None


def next_motion(fit: Fit, others: Mapping[str, Fit], of: str = "") -> NextMotion | None:
    """The let-go that separates a fit from rivals, in the measured pose in which it does best.

    Rivals whose motion is not known are left out: those with other effects of the camera. None
    without any, and where motion does not know a part of the cable, such as obstacles.
    """
    rivals = {name: one for name, one in others.items() if not _seen_otherwise(fit, one)}
    poses = [item.pose for item in fit.problem.fit_poses if item.has_points]
    if not poses or not rivals:
        return None
    picked = np.unique(np.linspace(0, len(poses) - 1, TRIED).round().astype(int))
    tried = []
    for pose in (poses[k] for k in picked):
        with suppress(DloError):
            own = _modes_of(fit, pose)
            each = {name: _modes_of(one, pose) for name, one in rivals.items()}
            gaps = [np.abs(_gap(own, one)).max() for one in each.values()]
            tried.append((min(gaps), own, each))
    # A cable may lose its shape within what is known of its parameters.
    for _, own, each in sorted(tried, key=lambda x: -x[0]):
        with suppress(DloError):
            return _compared(fit, rivals, own, each, of)
    return None


def _seen_otherwise(fit: Fit, other: Fit) -> bool:
    """Whether two fits differ by an effect of the camera, which recordings do not know."""
    known = [{x.label: x for x in one.model.effects} for one in (fit, other)]
    apart = known[0].keys() ^ known[1].keys()
    return any(isinstance((known[0] | known[1])[label], MeasurementEffect) for label in apart)


def _modes_of(fit: Fit, pose: HeldPose) -> ModesAtRest:
    """Modes about the shape in a pose of a fit's cable in motion."""
    model = moving_model(fit.model)
    known = dict(zip(fit.model.names, fit.p.tolist(), strict=True))
    nominal = dict(zip(model.names, model.nominal.tolist(), strict=True))
    p = np.array([known.get(name, nominal[name]) for name in model.names])
    found = solve_equilibrium(model, p, fit.rest_now, pose)
    modes = ModesAtRest(model, p, fit.rest_now, found, pose, MODES)
    cable, _, own = modes.state()
    if own.rates.min() < FREE * cable.slowest:
        raise DloError("a mode that nothing holds, such as a roll about ball joints, has no rate")
    return modes


def _gap(own: ModesAtRest, rival: ModesAtRest) -> FloatArray:
    """Logarithms (MODES,) of the ratios of frequencies."""
    return np.log(own.numbers()[0] / rival.numbers()[0])


def _compared(
    fit: Fit,
    others: Mapping[str, Fit],
    own: ModesAtRest,
    each: Mapping[str, ModesAtRest],
    of: str,
) -> NextMotion:
    """How far the modes of rivals are apart from a fit's in one pose."""
    length, model, (hertz, ratios) = fit.model.cable.length, own.model, own.numbers()
    s = np.linspace(0.0, length, 101)
    shapes = np.linalg.norm(own.displacements(s)[1], axis=2)
    aside = length * (ASIDE_HELD if model.end.place else ASIDE)
    # Of a shape that is pulled at one place; of each mode, the mean square of a coordinate.
    sizes = aside * (hertz[0] / hertz) ** 2
    squares = sizes**2 * (shapes**2).mean(axis=1) / model.node.dimension
    std, rates = float(np.hypot(fit.noise.std, MESH_ERROR * length)), 2 * np.pi * hertz
    told = std**2 * np.array([*_variances(rates, ratios, squares, _count(fit))]) / rates**2
    swings = {}
    for name, rival in each.items():
        gap = _gap(own, rival)
        apart = gap @ np.linalg.solve(np.diag(told) + _left_open(others[name], rival), gap)
        swings[name] = Swing(tuple(rival.numbers()[0].tolist()), float(np.sqrt(apart)))
    at = float(s[int(shapes[0].argmax())])
    return NextMotion(own.pose.name, at, aside, DURATION, tuple(hertz.tolist()), swings, of)


def _count(fit: Fit) -> int:
    """Numbers that are compared at each time."""
    item = next(item for item in fit.problem.fit_poses if item.has_points)
    sensor, dimension = item.sensors[0], fit.model.node.dimension
    return (len(sensor.points) if isinstance(sensor, Markers) else POINTS) * dimension


def _variances(
    rates: FloatArray, ratios: FloatArray, squares: FloatArray, count: int
) -> Iterator[float]:
    """Variance of each rate [rad/s], of noise 1, from mean squares of the modes' amplitudes."""
    t = np.arange(0.0, DURATION, 1 / RATE)
    for rate, ratio, square in zip(rates, ratios, squares, strict=True):
        g = np.exp(-2 * ratio * rate * t)
        spread = g @ (t - g @ t / g.sum()) ** 2
        yield 2 / (square * count * spread)


def _left_open(fit: Fit, modes: ModesAtRest) -> FloatArray:
    """Covariance of the logarithms of a fit's rates."""
    ways = directions(modes.model, uncertainty_of(fit))
    for name, std in modes.model.priors.items():
        if name not in fit.model.names:  # tolerated in motion
            p = np.zeros(len(modes.p))
            p[modes.model.names.index(name)] = std
            ways.append((p, np.zeros(len(modes.rest))))
    known = modes.numbers()[0]
    moved = [np.log(modes.moved(p, rest)[0] / known) for p, rest in ways]
    return np.transpose(moved) @ np.array(moved)
