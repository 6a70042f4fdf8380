"""Steps in time: the generalised-alpha method on the nodes' rotations and places.

With body rates and velocities v, accelerations v' in balance at the end of each step, and the
method's own accelerations a,

    (1 - alpha_m) a_1 + alpha_m a_0 = (1 - alpha_f) v'_1 + alpha_f v'_0
    X = dt v_0 + dt^2 ((1/2 - beta) a_0 + beta a_1),   x_1 = moved(x_0, X)
    v_1 = v_0 + dt ((1 - gamma) a_0 + gamma a_1)

Second order, unconditionally stable in linear problems; the highest frequencies decay by `rho` in a
step. Places that fixtures hold follow them exactly; conditions on places and directions are those
of the end of the step, with forces as unknowns. An equilibrium of statics stays as it is.

References
----------
Chung and Hulbert, J. Appl. Mech. 60 (1993); Arnold and Bruels, Multibody Syst. Dyn. 18 (2007);
Bruels, Cardona and Arnold, Mech. Mach. Theory 48 (2012).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from dlo_casadi.arrays import FloatArray
from dlo_casadi.motion.state import Banded, Fixtures, State
from dlo_casadi.motion.system import MovingCable

# Factor by which the highest frequencies decay in a step.
RHO = 0.8
# Newton's steps in one step of time, and the size [rad, lengths] of the last one: what is left is
# a tenth of that at most.
NEWTON_STEPS, LAST_STEP = 12, 1e-7
# Ratio of two steps from which a kept matrix is made anew.
SLOW = 0.1
# Relative difference of two steps of time that share a matrix: of rounded times.
_SAME = 1e-9
# Longest step of Newton's method [rad]: farther, the Cayley map is no guide.
LONGEST = 1.0


@dataclass(frozen=True)
class Scheme:
    """Coefficients of the method."""

    alpha_m: float
    alpha_f: float
    beta: float
    gamma: float

    @classmethod
    def of(cls, rho: float) -> Scheme:
        """The method by the decay of the highest frequencies."""
        alpha_m, alpha_f = (2 * rho - 1) / (rho + 1), rho / (rho + 1)
        gamma = 0.5 + alpha_f - alpha_m
        return cls(alpha_m, alpha_f, (gamma + 0.5) ** 2 / 4, gamma)

    @property
    def error(self) -> float:
        """Error of the places of a step over dt^3 times the third derivative by time."""
        return abs((self.alpha_m - self.alpha_f) / 2 + self.beta - 1 / 6)

    def factors(self, dt: float) -> tuple[float, float]:
        """Derivatives of velocities and accelerations by X."""
        return self.gamma / (self.beta * dt), (1 - self.alpha_m) / (
            self.beta * dt**2 * (1 - self.alpha_f)
        )


SCHEME = Scheme.of(RHO)
# Backward Euler: velocities and accelerations of a step need no earlier accelerations.
FIRST = Scheme(0.0, 0.0, 1.0, 1.0)
# Step [s] in which only a jump changes velocities, and the change [lengths/s, rad/s] that is one.
_INSTANT, _JUMP = 1e-8, 1e-4


@dataclass(frozen=True, eq=False)
class Moving:
    """A state, and the accelerations of the method (n_nodes, increment + dimension)."""

    state: State
    own: FloatArray

    @property
    def rates(self) -> FloatArray:
        """W and v (n_nodes, increment + dimension)."""
        return np.hstack([self.state.w, self.state.v])

    @property
    def accelerations(self) -> FloatArray:
        """Alpha and a likewise."""
        return np.hstack([self.state.alpha, self.state.a])

    def for_step(self, factor: float) -> Moving:
        """Continued with a step `factor` times as long: `own` are of a time shifted by a share."""
        known = self.accelerations
        return Moving(self.state, known + factor * (self.own - known))


class Stepper:
    """Steps of one cable by one scheme; it keeps the last factorised matrix for the next step.

    Newton's method with a kept matrix needs residuals alone, a fraction of the work; the matrix is
    made anew where that converges slowly, and for another length of the step.
    """

    def __init__(self, cable: MovingCable, scheme: Scheme) -> None:
        self.cable, self.scheme = cable, scheme
        self._solver: Banded | None = None
        self._dt = 0.0

    def step(self, before: Moving, fixtures: Fixtures, dt: float) -> Moving | None:
        """The state dt later, where fixtures are as given; None if Newton's method fails."""
        trial = _Trial(self.cable, self.scheme, before, fixtures, dt)
        if abs(dt - self._dt) > _SAME * dt:
            self._solver, self._dt = None, dt
        found = self._solved(trial) if self._solver is not None else None
        if found is None:
            self._solver = None
            trial = _Trial(self.cable, self.scheme, before, fixtures, dt)
            found = self._solved(trial)
        return found

    def _solved(self, trial: _Trial) -> Moving | None:
        last, length = np.inf, self.cable.model.cable.length
        for _ in range(NEWTON_STEPS):
            if self._solver is None:
                residual, self._solver = trial.balance()
            else:
                residual = trial.residual()
            found = self._solver.solve(-residual)
            if self._solver.singular or not np.isfinite(found).all():
                self._solver = None
                return None
            size = trial.move(found, length)
            if size < LAST_STEP:
                return trial.state
            if size > SLOW * last:
                self._solver = None
            last = size
        self._solver = None
        return None


class _Trial:
    """The unknowns of one step: increments X of the nodes, forces and moments."""

    def __init__(
        self,
        cable: MovingCable,
        scheme: Scheme,
        before: Moving,
        fixtures: Fixtures,
        dt: float,
    ) -> None:
        self._cable, self._scheme, self._before = cable, scheme, before
        self._fixtures, self._dt, self._held = fixtures, dt, cable.held
        # As if the method's accelerations stayed the same.
        self._moved = dt * before.rates + dt**2 / 2 * before.own
        self._force, self._moment = before.state.force, before.state.moment

    @property
    def state(self) -> Moving:
        """The state with these unknowns."""
        scheme, before, dt, b = self._scheme, self._before, self._dt, self._cable.b
        # Accelerations and rates are affine in X.
        own = (self._moved / dt - before.rates) / dt - (0.5 - scheme.beta) * before.own
        own /= scheme.beta
        share = (1 - scheme.alpha_m) * own + scheme.alpha_m * before.own
        changed = (share - scheme.alpha_f * before.accelerations) / (1 - scheme.alpha_f)
        rates = before.rates + dt * ((1 - scheme.gamma) * before.own + scheme.gamma * own)
        start, fixtures = before.state, self._fixtures
        r, v, a = start.r + self._moved[:, b:], rates[:, b:], changed[:, b:]
        for k, node in self._held:
            r[node], v[node], a[node] = (
                x[k] for x in (fixtures.places, fixtures.velocities, fixtures.accelerations)
            )
            own[node, b:] = a[node]
        x = np.asarray(self._cable.model.node.moved(start.x, self._moved[:, :b]))
        w, alpha = rates[:, :b], changed[:, :b]
        return Moving(State(x, r, w, v, alpha, a, self._force, self._moment), own)

    def residual(self) -> FloatArray:
        """Residual of the balance at the end of the step."""
        return self._cable.residual(self.state.state, self._fixtures)

    def balance(self) -> tuple[FloatArray, Banded]:
        """The residual, and its derivative by the unknowns."""
        factors = self._scheme.factors(self._dt)
        balance = self._cable.evaluated(self.state.state, self._fixtures, factors)
        return balance.residual, balance.stepped(turns_of(self._moved[:, : self._cable.b]))

    def move(self, solution: FloatArray, length: float) -> float:
        """Add a step of Newton's method; return its size [rad, lengths]."""
        b, (turned, shifted, pulled, twisted) = self._cable.b, self._cable.steps(solution)
        size = max(float(np.abs(turned).max()), float(np.abs(shifted).max()) / length)
        share = min(1.0, LONGEST / size) if size else 1.0
        turns = _composed(self._moved[:, :b], share * turned)
        self._moved = np.hstack([turns, self._moved[:, b:] + share * shifted])
        self._force = self._force + share * pulled
        self._moment = self._moment + share * twisted
        return size


def _composed(x: FloatArray, turned: FloatArray) -> FloatArray:
    """The increment x followed by another one, both of the same nodes."""
    if x.shape[1] == 1:
        return x + turned
    total = x + turned + np.cross(x, turned) / 2
    return np.asarray(total / (1 - (x * turned).sum(axis=1, keepdims=True) / 4))


def turns_of(x: FloatArray) -> FloatArray:
    """Derivative (n_nodes, increment, increment) of `_composed` by the second increment at zero."""
    count, b = x.shape
    unit = np.broadcast_to(np.eye(b), (count, b, b))
    if b == 1:
        return unit
    around = np.cross(x[:, None, :], np.eye(3)[None]).transpose(0, 2, 1)
    return np.asarray(unit + around / 2 + x[:, :, None] * x[:, None, :] / 4)


def started(
    cable: MovingCable, state: State, now: Fixtures, later: Fixtures, dt: float
) -> Moving | None:
    """A state with its first forces and accelerations, which are means over a step dt.

    `now`, `later`: the fixtures before and after that step. Velocities that contradict those of the
    fixtures jump as in an impact.
    """
    # From where the cable is: a place that is off by rounding is no velocity.
    places = now.places.copy()
    for k, node in cable.held:
        places[k] = state.r[node]
    soon = replace(now, places=places + _INSTANT * now.velocities)
    first = Stepper(cable, FIRST)
    after = first.step(still(state), soon, _INSTANT)
    if after is None:
        return None
    turned, moved = after.state.w - state.w, after.state.v - state.v
    if max(np.abs(turned).max(), np.abs(moved).max() / cable.model.cable.length) > _JUMP:
        state = replace(state, w=after.state.w, v=after.state.v)
    after = first_step(cable, state, later, dt)
    return None if after is None else begun_by(state, after)


def first_step(cable: MovingCable, state: State, later: Fixtures, dt: float) -> Moving | None:
    """A step with constant accelerations, which need no earlier ones."""
    return Stepper(cable, FIRST).step(still(state), later, dt)


def begun_by(state: State, after: Moving) -> Moving:
    """A state with the accelerations and forces of its `first_step`."""
    now = after.state
    begun = replace(state, alpha=now.alpha, a=now.a, force=now.force, moment=now.moment)
    return Moving(begun, np.hstack([now.alpha, now.a]))


def turned_back(x: FloatArray, turns: FloatArray) -> FloatArray:
    """Turns (n_nodes, increment, q) about nodes, seen from these after increments x."""
    if x.shape[1] == 1:
        return turns
    quaternion = np.concatenate([x / 2, np.ones((len(x), 1))], axis=1)
    matrices = Rotation.from_quat(quaternion).as_matrix()
    return np.asarray(matrices.transpose(0, 2, 1) @ turns)


def still(state: State) -> Moving:
    """A state with no accelerations."""
    none = np.zeros_like(state.w), np.zeros_like(state.v)
    return Moving(replace(state, alpha=none[0], a=none[1]), np.hstack(none))
