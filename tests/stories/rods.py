"""An elastic rod by SciPy's collocation, which shares nothing with the package.

    r' = t,   n' = -w,   m' = n x t,   m = B (kappa - kappa_0)        [Antman, ch. 4 and 8]

n and m are the force and moment of what lies beyond s on what lies before. Spans between joints are
solved together, each on [0, 1], with its force at its start and its length as unknowns. Gravity
points along -y in the plane, along -z in space.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.integrate import solve_bvp
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation

GRAVITY = 9.81  # m/s^2


@dataclass(frozen=True)
class Held:
    """An end: where, and in what direction if it is clamped: heading [rad], or quaternion (4,)."""

    place: Sequence[float]
    direction: float | Sequence[float] | None = None


@dataclass(frozen=True)
class Lying:
    """An end that lies on a level table, nobody knows from which arc length on, in the plane."""

    height: float  # m, of the axis


@dataclass(frozen=True)
class Mass:
    """A weight [kg] where two spans meet."""

    mass: float


@dataclass(frozen=True)
class Pin:
    """A place where two spans meet; an eyelet `slides`: its arc length is unknown."""

    place: Sequence[float]
    slides: bool = False


@dataclass(frozen=True)
class Rod:
    """A rod of length [m], weight [N/m], EI and, in space, GJ [N m^2], and its rest curvature."""

    length: float
    weight: float
    bending: float
    torsion: float | None = None
    rest: Callable[[np.ndarray], np.ndarray] = field(default=lambda s: 0.0 * s)

    @property
    def dimension(self) -> int:
        """2 or 3."""
        return 2 if self.torsion is None else 3

    @property
    def width(self) -> int:
        """Numbers of a state: place, direction, moment (in space in the section's axes)."""
        return 4 if self.torsion is None else 10

    def upwards(self, length: float) -> np.ndarray:
        """Weight of a length, upwards [N]."""
        return self.weight * length * np.eye(self.dimension)[-1]

    def rates(self, s: np.ndarray, y: np.ndarray, n: np.ndarray) -> np.ndarray:
        """Derivatives (width, N) of states by arc length, under forces (d, N)."""
        if self.torsion is None:
            _, _, phi, moment = y
            cos, sin = np.cos(phi), np.sin(phi)
            return np.array(
                [cos, sin, moment / self.bending + self.rest(s), sin * n[0] - cos * n[1]]
            )
        turn, moment = Rotation.from_quat(y[3:7].T), y[7:].T
        strain = moment / [self.torsion, self.bending, self.bending]
        strain[:, 1:] += self.rest(s).T
        x, w = y[3:6].T, y[6:7].T
        ahead = np.tile([1.0, 0.0, 0.0], (len(s), 1))
        bent = np.cross(strain, moment) + np.cross(ahead, turn.inv().apply(n.T))
        axis, angle = w * strain + np.cross(x, strain), (x * strain).sum(axis=1, keepdims=True)
        return np.hstack([turn.apply(ahead), axis / 2, -angle / 2, -bent]).T

    def solve(
        self,
        start: Held,
        end: Held | Lying | None,
        joints: Sequence[Mass | Pin] = (),
        at: Sequence[float] = (),
        *,
        guess: Shape | None = None,
    ) -> Shape:
        """Shape between two ends, on a table, or with a free end.

        Parameters
        ----------
        joints, at : sequences
            What stands between spans, and at which arc lengths [m]; of eyelets a first guess.
        guess : Shape, optional
            One with as many spans; by default a single span that sags.
        """
        guess = guess or self._sagging(start, end)
        guess = guess if joints == () or len(guess.lengths) > 1 else guess.split(at)
        d, width, spans = self.dimension, self.width, len(joints) + 1

        def unpacked(p):
            return p[: spans * d].reshape(spans, d), p[spans * d :]

        def slopes(u, y, p):
            forces, lengths = unpacked(p)
            rows = []
            for k, begin in enumerate(np.cumsum(lengths) - lengths):
                n = forces[k][:, None] + self.upwards(1.0)[:, None] * lengths[k] * u
                state = y[k * width : (k + 1) * width]
                rows.append(lengths[k] * self.rates(begin + lengths[k] * u, state, n))
            return np.concatenate(rows)

        def gaps(a, b, p):
            (forces, lengths), d_phi = unpacked(p), 1 if d == 2 else 4
            first, last = a.reshape(spans, width), b.reshape(spans, width)
            before = forces + np.array([self.upwards(length) for length in lengths])
            out = [*(first[0, :d] - start.place)]
            clamped = start.direction is not None
            out += [*(first[0, d : d + d_phi] - start.direction)] if clamped else [first[0, 3]]
            known = np.diff([0.0, *at, self.length]) - lengths
            for k, joint in enumerate(joints):
                out += [*(first[k + 1] - last[k])]
                jump = forces[k + 1] - before[k]
                if isinstance(joint, Mass):
                    out += [*(jump - joint.mass * self.upwards(GRAVITY / self.weight))]
                    continue
                out += [*(last[k, :d] - joint.place)]
                if joint.slides:
                    known[k + 1] += known[k]  # the sum of both lengths
                    known[k] = jump @ [np.cos(last[k, 2]), np.sin(last[k, 2])]
            if isinstance(end, Lying):
                known[-1] = before[-1, 0]
                return np.array([*out, *known, *(last[-1] - [0.0, end.height, 0.0, 0.0])[1:]])
            return np.array([*out, *known, *self._ending(last[-1], end, before[-1])])

        p = np.concatenate([guess.forces.ravel(), guess.lengths])
        found = solve_bvp(slopes, gaps, U, guess.states(U), p, tol=1e-8, max_nodes=20_000)
        if not found.success:
            raise RuntimeError(found.message)
        return Shape(self, *reversed(unpacked(found.p)), found.sol)

    def _ending(self, state, end, force):
        d = self.dimension
        if end is None:
            return [*force, *state[3 if d == 2 else 7 :]]
        placed = [*(state[:d] - end.place)]
        if end.direction is None:
            return [*placed, state[3]]
        if d == 2:
            return [*placed, state[2] - end.direction]
        turn = Rotation.from_quat(end.direction).inv() * Rotation.from_quat(state[3:7])
        return [*placed, *turn.as_rotvec()]

    def led(self, start: Held, end: Held, steps: int = 8) -> Shape:
        """Shape in space between two clamps, led there from a nearly straight one."""
        length, shape = self.length, None
        turns = [Rotation.from_quat(side.direction).as_rotvec() for side in (start, end)]
        straight = np.array([0.97 * length, 0.0, 0.0])
        for share in np.linspace(0.0, 1.0, steps + 1):
            first, last = (Rotation.from_rotvec(share * turn).as_quat() for turn in turns)
            place = (
                start.place + (1 - share) * straight + share * np.subtract(end.place, start.place)
            )
            shape = self.solve(Held(start.place, first), Held(place, last), guess=shape)
        return shape

    def through(
        self, free: Shape, start: Held, end: Held, joints: Sequence[Pin], at: Sequence[float]
    ) -> Shape:
        """Shape through pins that are moved in four steps from where a free one passes."""
        shape, passed = free.split(at), free.at(at)
        for share in np.linspace(0.0, 1.0, 5):
            places = (1 - share) * passed + share * np.array([joint.place for joint in joints])
            moved = [replace(x, place=place) for x, place in zip(joints, places, strict=True)]
            shape = self.solve(start, end, moved, at, guess=shape)
        return shape

    def _sagging(self, start, end):
        """One span along the chord that turns by 2.4 rad, or from heading to heading."""
        length, here = self.length, np.array(start.place)
        place = getattr(end, "place", None)
        ahead = (length * np.eye(len(here))[0] if place is None else place - here)[:, None]
        if self.torsion is not None:
            turns = Rotation.from_quat([start.direction, end.direction])
            path = (turns[0].inv() * turns[1]).as_rotvec() * U[:, None]
            dip = Rotation.from_rotvec(np.outer(np.sin(2 * np.pi * U), [0.0, 0.6, 0.0]))
            q = (turns[0] * Rotation.from_rotvec(path) * dip).as_quat()
            states = [here[:, None] + ahead * U, q.T, np.zeros((3, len(U)))]
            path = CubicSpline(U, np.vstack(states), axis=1)
            return Shape(self, [length], [-self.upwards(length) / 2], path)
        if isinstance(end, Lying):
            length *= 0.5
            ahead = np.array([[length], [end.height - here[1]]])
        chord = np.arctan2(ahead[1, 0], ahead[0, 0])
        first = start.direction if start.direction is not None else chord - 1.2
        last = getattr(end, "direction", None)
        if last is None:
            last = 0.0 if isinstance(end, Lying) else -1.5 if end is None else chord + 1.2
        heading = first + (last - first) * U
        bend = self.bending * (last - first) / length + 0 * U
        states = np.vstack([here[:, None] + ahead * U, heading, bend])
        force = -self.upwards(length) / (2 if place is not None else 1)
        return Shape(self, [length], [force], CubicSpline(U, states, axis=1))


# Of first guesses.
U = np.linspace(0.0, 1.0, 41)


class Shape:
    """A solved rod: lengths [m] of its spans, forces (spans, d) [N] at their starts, states."""

    def __init__(self, rod: Rod, lengths, forces, states: Callable) -> None:
        self.rod, self.states = rod, states
        self.lengths, self.forces = np.array(lengths), np.array(forces)

    def state(self, s: float) -> np.ndarray:
        """Place, direction and moment at an arc length [m]; on a table, straight on."""
        begins = np.cumsum(self.lengths) - self.lengths
        k = max(int(np.searchsorted(begins, s, side="right")) - 1, 0)
        u, width = (s - begins[k]) / self.lengths[k], self.rod.width
        found = self.states(min(u, 1.0))[k * width : (k + 1) * width].copy()
        found[0] += max(u - 1.0, 0.0) * self.lengths[k]
        return found

    def at(self, s: Sequence[float]) -> np.ndarray:
        """Points (K, d) [m] at arc lengths [m]."""
        return np.array([self.state(x)[: self.rod.dimension] for x in s])

    def curvature(self, s: Sequence[float]) -> np.ndarray:
        """Curvature (K,) [1/m] in the plane."""
        bent = [self.state(x)[3] / self.rod.bending for x in s]
        return np.array(bent) + self.rod.rest(np.asarray(s))

    def split(self, at: Sequence[float]) -> Shape:
        """The same in spans that meet at arc lengths [m], as a first guess."""
        begins, lengths = np.array([0.0, *at]), np.diff([0.0, *at, self.rod.length])
        states = [
            np.array([self.state(x) for x in begin + length * U]).T
            for begin, length in zip(begins, lengths, strict=True)
        ]
        forces = [self.forces[0] + self.rod.upwards(begin) for begin in begins]
        return Shape(self.rod, lengths, forces, CubicSpline(U, np.vstack(states), axis=1))

    @property
    def start_force(self) -> np.ndarray:
        """Of the rod on its start [N]."""
        return self.forces[0]

    @property
    def end_force(self) -> np.ndarray:
        """Of the rod on its end [N]."""
        return -self.forces[-1] - self.rod.upwards(self.lengths[-1])

    @property
    def joint_forces(self) -> np.ndarray:
        """Of the rod on what stands between two spans (spans - 1, d) [N]."""
        carried = [self.rod.upwards(length) for length in self.lengths[:-1]]
        return np.diff(self.forces, axis=0) - carried

    @property
    def moments(self) -> np.ndarray:
        """Of the rod on its start and end [N m]: (2, 1), in space (2, 3) about the world's axes."""
        ends = np.array([self.state(0.0), self.states(1.0)[-self.rod.width :]])
        signs = np.array([[1.0], [-1.0]])
        if self.rod.torsion is None:
            return signs * ends[:, 3:]
        return signs * Rotation.from_quat(ends[:, 3:7]).apply(ends[:, 7:])
