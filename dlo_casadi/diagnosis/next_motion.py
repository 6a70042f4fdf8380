"""The motion that would separate two models which explain the same still poses.

Pulled aside and let go, a cable swings in its modes. Two models of the same shapes predict other
frequencies and shapes of modes. With the differences d of log(w_k), and of the unit vectors u_k of
the modes' displacements in all measured coordinates, they are

    sqrt(d^T (E + P)^-1 d)

standard deviations apart. P is what the rival's parameters leave open, and what may differ in
motion within tolerances (TOLERATED_IN_MOTION). E is diagonal: a mode of amplitude a, a vector of
all coordinates, which have a std sigma, seen at times t, tells its rate and its shape with

    var(w) = 2 sigma^2 / (|a|^2 sum_t g (t - m)^2),   g = exp(-2 zeta w t),   m = sum g t / sum g
    var(u) = 2 sigma^2 / (|a|^2 sum_t g)              of each component across u

whatever its phase, amplitude and damping are. That is the bound of Cramer and Rao. Of a shape only
what differs from all modes counts whose beat with it lasts longer than the recording.

References
----------
Rife and Boorstyn, IEEE Trans. Inf. Theory 20 (1974); Yao and Pandit, IEEE Trans. Signal Process. 43
(1995).
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Self

import numpy as np

from dlo_casadi.arrays import FloatArray
from dlo_casadi.diagnosis.found import AddedEffect, rivals_of
from dlo_casadi.effects import MeasurementEffect
from dlo_casadi.equilibrium.solve import solve_equilibria
from dlo_casadi.errors import DloError, EquilibriumError
from dlo_casadi.estimation.motion_fit import MESH_ERROR, moving_model
from dlo_casadi.estimation.prediction import uncertainty_of
from dlo_casadi.estimation.result import Fit
from dlo_casadi.motion.modes import displacements
from dlo_casadi.motion.modes_at_rest import ModesAtRest, directions
from dlo_casadi.sensing.sensors import Markers

# How far a cable is pulled aside, in lengths: with a free end, and between two held ends.
ASIDE, ASIDE_HELD = 0.25, 0.05
# Duration [s] and rate [1/s] of the recording; points along the cable where lines were measured.
DURATION, RATE, POINTS = 3.0, 100.0, 10
# Share of the slowest rate of a cable below which nothing holds a mode.
FREE = 0.05
# Modes that are compared, and poses that are tried at most: more hardly separate rivals better.
MODES, TRIED = 3, 4


@dataclass(frozen=True)
class Swing:
    """How a rival would swing.

    Parameters
    ----------
    frequencies : (MODES,) [Hz]
    separation : float
        Difference of its first modes, rates and shapes, in standard deviations. Half its square is
        the log evidence that the motion is expected to give, to first order.
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
    """The let-go that separates a fit from rivals, in one of TRIED measured poses.

    Rivals whose motion is not known are left out: those with other effects of the camera. None
    without any, and where motion does not know a part of the cable, such as obstacles.
    """
    rivals = {name: one for name, one in others.items() if not _seen_otherwise(fit, one)}
    measured = [j for j, item in enumerate(fit.problem.fit_poses) if item.has_points]
    if not measured or not rivals:
        return None
    picked = np.unique(np.linspace(0, len(measured) - 1, TRIED).round().astype(int))
    of_each = [_modes_of(one, [measured[k] for k in picked]) for one in (fit, *rivals.values())]
    tried = []
    for modes in zip(*of_each, strict=True):
        with suppress(DloError):
            own, *others_here = map(_held, modes)
            hertz = own.numbers()[0]
            gaps = [np.abs(np.log(hertz / one.numbers()[0])).max() for one in others_here]
            tried.append((min(gaps), own, dict(zip(rivals, others_here, strict=True))))
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


def _modes_of(fit: Fit, of: Sequence[int]) -> list[ModesAtRest | EquilibriumError]:
    """Modes of a fit's cable about its shapes in some of its poses, without random differences."""
    model = moving_model(fit.model)
    known = dict(zip(fit.model.names, fit.p.tolist(), strict=True))
    nominal = dict(zip(model.names, model.nominal.tolist(), strict=True))
    p = np.array([known.get(name, nominal[name]) for name in model.names])
    poses = [fit.problem.fit_poses[j].pose for j in of]
    shapes = fit.point.shapes.x[fit.problem.used][of]
    found = solve_equilibria(model, p, fit.rest_now, poses, list(shapes))
    return [
        one
        if isinstance(one, EquilibriumError)
        else ModesAtRest(model, p, fit.rest_now, one, pose, MODES)
        for one, pose in zip(found, poses, strict=True)
    ]


def _held(modes: ModesAtRest | EquilibriumError) -> ModesAtRest:
    """The modes, if there is a shape and if something holds each of them."""
    if isinstance(modes, EquilibriumError):
        raise modes
    cable, _, own = modes.state
    if own.rates.min() < FREE * cable.slowest:
        raise DloError("a mode that nothing holds, such as a roll about ball joints, has no rate")
    return modes


@dataclass(frozen=True)
class _Shown:
    """How modes differ from those of a fit, at arc lengths s (K,) [m].

    Parameters
    ----------
    alike : tuple of (K d, q)
        Of each mode, unit shapes of the fit's modes that are not told from it.
    first : (MODES, K d)
        The fit's unit shapes, which decide the signs.
    """

    s: FloatArray
    alike: tuple[FloatArray, ...]
    first: FloatArray

    @classmethod
    def beside(cls, own: ModesAtRest, s: FloatArray) -> Self:
        """Beside a fit's modes."""
        rates, shapes = _rates_and_shapes(replace(own, count=2 * MODES), s)
        beats = np.abs(rates[:MODES, None] - rates) * DURATION < 2 * np.pi
        alike = tuple(np.linalg.qr(shapes[near].T)[0] for near in beats)
        return cls(s, alike, shapes[:MODES])

    def of(self, modes: ModesAtRest) -> FloatArray:
        """Logarithms (MODES,) of the rates, then what differs of the shapes (MODES K d,)."""
        rates, shapes = _rates_and_shapes(modes, self.s)
        signed = shapes * np.where((shapes * self.first).sum(axis=1) < 0, -1.0, 1.0)[:, None]
        across = [u - q @ (q.T @ u) for u, q in zip(signed, self.alike, strict=True)]
        return np.concatenate([np.log(rates), *across])


def _rates_and_shapes(modes: ModesAtRest, s: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Rates (count,) [rad/s] and unit shapes (count, K d) of modes at arc lengths."""
    cable, state, found = modes.state
    shapes = displacements(cable, state, found.vectors, s)[1].reshape(modes.count, -1)
    return found.rates, shapes / np.linalg.norm(shapes, axis=1, keepdims=True)


def _compared(
    fit: Fit,
    others: Mapping[str, Fit],
    own: ModesAtRest,
    each: Mapping[str, ModesAtRest],
    of: str,
) -> NextMotion:
    """How far the modes of rivals are apart from a fit's in one pose."""
    length, model, (hertz, ratios) = fit.model.cable.length, own.model, own.numbers()
    aside, seen = length * (ASIDE_HELD if model.end.place else ASIDE), _places(fit)
    # Of a shape that is pulled at one place.
    amplitudes = aside * (hertz[0] / hertz) ** 2
    sizes = amplitudes * np.linalg.norm(own.displacements(seen)[1], axis=(1, 2))
    std, rates = float(np.hypot(fit.noise.std, MESH_ERROR * length)), 2 * np.pi * hertz
    of_rates, of_shapes = std**2 * np.transpose([*_variances(rates, ratios, sizes)])
    shown, count = _Shown.beside(own, seen), len(seen) * model.node.dimension
    variances = np.concatenate([of_rates / rates**2, np.repeat(of_shapes, count)])
    swings = {}
    for name, rival in each.items():
        gap = shown.of(own) - shown.of(rival)
        covariance = np.diag(variances) + _left_open(others[name], rival, shown)
        square = gap @ np.linalg.solve(covariance, gap)
        swings[name] = Swing(tuple(rival.numbers()[0].tolist()), float(np.sqrt(square)))
    s = np.linspace(0.0, length, 101)
    shapes = np.linalg.norm(own.displacements(s)[1], axis=2)
    at = float(s[int(shapes[0].argmax())])
    return NextMotion(own.pose.name, at, aside, DURATION, tuple(hertz.tolist()), swings, of)


def _places(fit: Fit) -> FloatArray:
    """Arc lengths (K,) [m] of the points that are compared."""
    sensor = next(item for item in fit.problem.fit_poses if item.has_points).sensors[0]
    if isinstance(sensor, Markers):
        return sensor.s
    return (np.arange(POINTS) + 0.5) / POINTS * fit.model.cable.length


def _variances(
    rates: FloatArray, ratios: FloatArray, sizes: FloatArray
) -> Iterator[tuple[float, float]]:
    """Variances of each rate [rad/s] and of its shape, of noise 1, from the modes' amplitudes."""
    t = np.arange(0.0, DURATION, 1 / RATE)
    for rate, ratio, size in zip(rates, ratios, sizes, strict=True):
        g = np.exp(-2 * ratio * rate * t)
        spread = g @ (t - g @ t / g.sum()) ** 2
        yield 2 / (size**2 * spread), 2 / (size**2 * g.sum())


def _left_open(fit: Fit, modes: ModesAtRest, shown: _Shown) -> FloatArray:
    """Covariance of what is shown of a fit's modes."""
    ways = directions(modes.model, uncertainty_of(fit))
    for name, std in modes.model.priors.items():
        if name not in fit.model.names:  # tolerated in motion
            p = np.zeros(len(modes.p))
            p[modes.model.names.index(name)] = std
            ways.append((p, np.zeros(len(modes.rest))))
    known = shown.of(modes)
    moved = [shown.of(one) - known for one in modes.moved(ways)]
    return np.transpose(moved) @ np.array(moved)
