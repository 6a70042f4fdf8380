"""A cable's way in time: steps chosen by their error, and what follows from the states."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise

import numpy as np

from dlo_casadi.arrays import FloatArray, IntArray
from dlo_casadi.errors import MotionError
from dlo_casadi.model.functions import functions_of
from dlo_casadi.motion.handles import between
from dlo_casadi.motion.path import FixturePath
from dlo_casadi.motion.state import Fixtures, State
from dlo_casadi.motion.steps import RHO, Moving, Scheme, Stepper, started
from dlo_casadi.motion.system import MovingCable

# Largest error of the places in one step, relative to the cable's length, unless asked otherwise.
TOLERANCE = 3e-6
# Shares of the time: of the first step, and of the shortest one that is tried.
_FIRST, _SHORTEST = 1e-3, 1e-9
# A step is changed by these factors at most, and kept between the inner ones.
_LEAST, _MOST, _KEPT = 0.2, 2.0, (0.8, 1.25)
# A step is repeated if its factor is smaller than this.
_REPEATED = 0.6
# Fraction of the tolerance that the next step aims at.
_SAFETY = 0.7


@dataclass(frozen=True, eq=False)
class Way:
    """States of a cable at the ends of all steps.

    Parameters
    ----------
    cable : MovingCable
    path : FixturePath
    t : (S,) [s]
    states : tuple of State
    """

    cable: MovingCable
    path: FixturePath
    t: FloatArray
    states: tuple[State, ...]

    def _stacked(self, name: str) -> FloatArray:
        return np.stack([getattr(state, name) for state in self.states])

    @cached_property
    def fixtures(self) -> list[Fixtures]:
        """The fixtures at these times."""
        return [self.path.at(t, self.cable) for t in self.t.tolist()]

    @cached_property
    def handles(self) -> tuple[FloatArray, FloatArray]:
        """Places and tangents (S, n_nodes, 2, d) of the nodes, dr/ds; their rates."""
        node, x, w = self.cable.model.node, self._stacked("x"), self._stacked("w")
        d, shape = node.dimension, (*x.shape[:2], node.dimension)
        frames = node.rotations(x.reshape((-1, x.shape[2])))
        spin = np.pad(w, [(0, 0), (0, 0), (3 - w.shape[2], 0)]).reshape((-1, 3))
        ahead = np.tile([1.0, 0.0, 0.0], (len(spin), 1))
        stretch = float(self.cable.segment.stretch(self.cable.p))
        along, turning = (
            stretch * frames.apply(one)[:, :d].reshape(shape)
            for one in (ahead, np.cross(spin, ahead))
        )
        return (
            np.stack([self._stacked("r"), along], axis=2),
            np.stack([self._stacked("v"), turning], axis=2),
        )

    def points(self, t: FloatArray, s: FloatArray) -> FloatArray:
        """Points (T, K, d) [m] at times t, by declared arc lengths s (K,) [m].

        Cubic in time between steps, as velocities are known at their ends; cubic along segments.
        """
        z, rates = self.handles
        k, u, dt = self._within(t)
        weights = [w[:, None, None, None] for w in _cubic(u)]
        first, slope, last, last_slope = z[k], rates[k], z[k + 1], rates[k + 1]
        h_t = dt[:, None, None, None]
        now = weights[0] * first + weights[1] * h_t * slope
        now = now + weights[2] * last + weights[3] * h_t * last_slope
        places = self.cable.along
        e = np.clip(np.searchsorted(places, s, side="right") - 1, 0, len(places) - 2)
        width = np.diff(places)[e]
        both = np.concatenate([now[:, e], now[:, e + 1]], axis=2)
        both[:, :, 1::2] *= width[:, None, None]
        return between(both, (s - places[e]) / width)

    def _within(self, t: FloatArray) -> tuple[IntArray, FloatArray, FloatArray]:
        """Steps of times, shares of them, and their lengths [s]."""
        k = np.clip(np.searchsorted(self.t, t, side="right") - 1, 0, len(self.t) - 2)
        dt = np.diff(self.t)[k]
        return k, (t - self.t[k]) / dt, dt

    def at(self, t: FloatArray, values: FloatArray) -> FloatArray:
        """Values (S, ...) of the steps, linear between them, at times t."""
        k, u, _ = self._within(t)
        share = u.reshape((-1, *(1,) * (values.ndim - 1)))
        return np.asarray((1 - share) * values[k] + share * values[k + 1])

    @cached_property
    def _quantities(self) -> list[FloatArray]:
        """`MovingSegment.quantities` of all steps (S, n_segments, rows)."""
        cable = self.cable
        rows = zip(*(cable.arguments(state) for state in self.states), strict=True)
        found = cable.segment.mapped("quantities")(*map(np.stack, rows))
        return [one[..., 0] for one in found]

    @cached_property
    def forces(self) -> tuple[FloatArray, FloatArray]:
        """Forces (S, d) [N] of the cable on what holds its start, and its end."""
        rows, d = self._quantities[3], self.cable.d
        load = np.array(functions_of(self.cable.model).dead_load(self.cable.p)).ravel()
        end = -rows[:, -1, d:] if self.cable.model.end.place else np.zeros((len(rows), d))
        return load - rows[:, 0, :d], end

    @cached_property
    def clip_forces(self) -> FloatArray:
        """Forces (S, k, d) [N] of the cable on its clips."""
        rows, d = self._quantities[3], self.cable.d
        nodes = np.array([node for _, node in self.cable.held[1:] if node < rows.shape[1]], int)
        return np.asarray(-(rows[:, nodes - 1, d:] + rows[:, nodes, :d]))

    @cached_property
    def energy(self) -> FloatArray:
        """Kinetic and potential energy (S,) [J]."""
        lagrangian, kinetic = (one[..., 0].sum(axis=1) for one in self._quantities[:2])
        both = zip(self.states, self.fixtures, strict=True)
        ends = [self.cable.energy_of_ends(state, fixtures) for state, fixtures in both]
        return np.asarray(lagrangian + kinetic + ends)

    @cached_property
    def power(self) -> FloatArray:
        """Power (S,) [W] that damping takes."""
        own = self._quantities[2][..., 0].sum(axis=1)
        return np.asarray(own + [self.cable.power_of_ends(state) for state in self.states])


def _cubic(u: FloatArray) -> FloatArray:
    """Weights of value and slope at both ends of a step of unit length, at shares u."""
    return np.array(
        [1 - 3 * u**2 + 2 * u**3, u - 2 * u**2 + u**3, 3 * u**2 - 2 * u**3, u**3 - u**2]
    )


def way_of(
    cable: MovingCable,
    state: State,
    path: FixturePath,
    t: tuple[float, float],
    tolerance: float = TOLERANCE,
    dt: float | None = None,
    rho: float = RHO,
) -> Way:
    """The way from a state at t[0] to t[1] [s].

    Parameters
    ----------
    tolerance : float
        Largest error of the places in a step over the cable's length.
    dt : float [s], optional
        Length of all steps, which are then not chosen by their error.
    rho : float
        See `steps.RHO`.

    Raises
    ------
    MotionError
        If a step has no solution, however short.
    """
    stepper, (now, until) = Stepper(cable, Scheme.of(rho)), t
    h = dt or _FIRST * (until - now)
    first = path.at(now, cable)
    while (begun := started(cable, state, first, path.at(now + h, cable), h)) is None:
        h = _halved(h, now, t, cable, path)
    moving, times, states, before = begun, [now], [begun.state], h
    while now < until * (1 - 1e-12):
        # The last two steps share what is left, so that none is tiny.
        left = until - now
        h = left if h > left * (1 - 1e-9) else min(h, max(left / 2, left - h))
        after = stepper.step(moving.for_step(h / before), path.at(now + h, cable), h)
        if after is None:
            h = _halved(h, now, t, cable, path)
            continue
        factor = 1.0 if dt else _factor(_error(stepper, moving, after, h), tolerance)
        if factor < _REPEATED and h > _SHORTEST * (until - t[0]):
            h *= factor
            continue
        before, now, moving = h, now + h, after
        times.append(now)
        states.append(moving.state)
        h = dt or h * factor
    return Way(cable, path, np.array(times), tuple(states))


def _error(stepper: Stepper, before: Moving, after: Moving, dt: float) -> float:
    """Error of the places in a step over the length: root of the mean square of the nodes."""
    change = stepper.scheme.error * dt**2 * (after.state.a - before.state.a)
    mean = float(np.sqrt((change**2).sum(axis=1).mean()))
    return mean / stepper.cable.model.cable.length


def _factor(error: float, tolerance: float) -> float:
    """Factor on the length of a step; 1 if it is about right."""
    found = (_SAFETY * tolerance / max(error, 1e-300)) ** (1 / 3)
    low, high = _KEPT
    return 1.0 if low < found < high else min(max(found, _LEAST), _MOST)


def _halved(
    dt: float, now: float, t: tuple[float, float], cable: MovingCable, path: FixturePath
) -> float:
    """Half a step, unless that is too short."""
    if dt > _SHORTEST * (t[1] - t[0]):
        return dt / 2
    fixtures = path.at(now, cable)
    fastest = np.linalg.norm(fixtures.velocities, axis=1)[[k for k, _ in cable.held]].max()
    raise MotionError(
        f"{cable.model.cable.name!r} at {now:.6g} s: no step in time has a solution, down to "
        f"{dt:.2g} s. {_tightest(cable, fixtures, path)}Fixtures move at up to {fastest:.3g} m/s."
        "\n  Try: fixtures that stay within the cable's reach, and that jump neither in place nor "
        f"in direction or speed; with large forces more elements (n = {cable.model.n}).",
        t=now,
    )


def _tightest(cable: MovingCable, fixtures: Fixtures, path: FixturePath) -> str:
    """A sentence about the span with the least cable beyond its chord; empty without spans."""
    names = ("start", "end", *(clip.name for clip in path.pose.clips))
    held = sorted(cable.held, key=lambda pair: pair[1])
    spans = []
    for (first, low), (last, high) in pairwise(held):
        chord = float(np.linalg.norm(fixtures.places[last] - fixtures.places[first]))
        length = float(cable.along[high] - cable.along[low])
        spans.append((chord / length, names[first], names[last], chord, length))
    if not spans:
        return ""
    _, first_name, last_name, chord, length = max(spans)
    return (
        f"Its {first_name} and {last_name} are {chord:.4g} m apart, with {length:.4g} m of cable "
        "between them. "
    )
