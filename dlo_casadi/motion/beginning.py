"""The first state of a recorded motion: a shape and velocities that the constraints allow.

    R(q) + h M (q - q_1) = sum_k eta_k F_k,   u = sum_k zeta_k dq/deta_k,
    F_k = (w_k^2 + h) M phi_k

with the balance R of statics, a shape q_1 along the first points, and the lowest modes phi_k at
rest. Springs in proportion to the masses, h, hold what moves slowly near the measured shape,
however far from rest that is; what moves fast is balanced, so that the noise of q_1 does not bend
it. Near rest the shape is q_0 + sum_k eta_k phi_k where q_1 is q_0, and the velocity
sum_k zeta_k phi_k. Without the springs there need be no shape: forces that balance a cable far from
rest may leave it unstable.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from dlo_casadi.arrays import FloatArray
from dlo_casadi.errors import EstimationError
from dlo_casadi.motion.modes import Matrices, lowest
from dlo_casadi.motion.sensitivities import Columns, Numbers, Tangent
from dlo_casadi.motion.state import Fixtures, State
from dlo_casadi.motion.steps import turns_of
from dlo_casadi.motion.system import Balance, MovingCable

# Newton's steps, and the size [rad, lengths] of the last one.
_STEPS, _LAST = 40, 1e-10
# Longest step of a node [rad].
_LONGEST = 0.5
# Springs h, over the square of the slowest frequency. Weight that pushes along a cable softens its
# slow modes by a few of these; with a hundred, a shape far from rest sags by a hundredth of L.
_HELD = 100.0
# Step of the differences of a shape's derivatives, in its coordinates.
_DIFFERENCE = 1e-5


@dataclass(frozen=True, eq=False)
class Basis:
    """What a first state is made of: a shape near the measured one, and forces that change it.

    Parameters
    ----------
    forces : (N, m)
        F_k of the m lowest modes at rest, scaled such that eta_k = 1 near rest moves the cable by
        its length, where the mode is largest.
    frequencies : (m,) [rad/s]
        w_k.
    about : State
        q_1, along the first points; the shape at rest until `near` is called.
    springs : float [1/s^2]
        h.
    """

    forces: FloatArray
    frequencies: FloatArray
    about: State
    springs: float

    @classmethod
    def of(cls, cable: MovingCable, rest: State, fixtures: Fixtures, count: int) -> Basis:
        """Those of the lowest modes about a state of rest, which is q_1; see `near`."""
        matrices = Matrices.of(cable, rest, fixtures)
        length, scale = cable.model.cable.length, cable.slowest**2
        squares, modes = lowest(matrices, count, scale)
        _, places, _, _ = cable.steps(modes)
        sizes = np.linalg.norm(places, axis=1).max(axis=0)
        modes = modes * (length / np.maximum(sizes, 1e-12))
        squares = np.maximum(squares, 1e-3 * scale)
        springs = _HELD * scale
        forces = matrices.sparse(matrices.mass) @ modes * (squares + springs)
        return cls(forces, np.sqrt(squares), rest, springs)

    def near(self, cable: MovingCable, x: FloatArray, fixtures: Fixtures) -> Basis:
        """The same about a shape with frames x (n_nodes, coordinates)."""
        return replace(self, about=cable.with_places(replace(self.about, x=x), fixtures))

    def held(self, cable: MovingCable, state: State) -> tuple[State, FloatArray]:
        """A still state with the accelerations h (q - q_1), as whose inertia the springs act.

        Also the blocks of turns of their derivatives, see `Balance.stepped`.
        """
        turned = np.asarray(cable.model.node.difference(self.about.x, state.x))
        alpha, a = self.springs * turned, self.springs * (state.r - self.about.r)
        return replace(state, alpha=alpha, a=a), turns_of(turned)


def begun(
    cable: MovingCable, near: State, fixtures: Fixtures, basis: Basis, first: FloatArray
) -> State:
    """The first state of its coordinates (2 m,): eta gives the shape, zeta [1/s] the velocity.

    `near`: a state from which Newton's method for the shape begins.

    Raises
    ------
    EstimationError
        If no shape balances these forces near the one given.
    """
    eta, zeta = np.split(first, 2)
    state = _shape(cable, near, fixtures, basis, eta)
    pulled, turns = basis.held(cable, state)
    balance = cable.evaluated(pulled, fixtures, (0.0, basis.springs))
    factor = _pushed(balance, basis.forces @ eta).stepped(turns)
    w, v, _, _ = cable.steps(factor.solve(basis.forces @ zeta))
    for k, node in cable.held:
        v[node] = fixtures.velocities[k]
    return replace(state, w=w, v=v)


def _shape(
    cable: MovingCable, near: State, fixtures: Fixtures, basis: Basis, eta: FloatArray
) -> State:
    """The shape of coordinates eta (m,), at rest."""
    none, still = np.zeros_like(near.w), np.zeros_like(near.v)
    state = replace(near, w=none, v=still, alpha=none, a=still, r=near.r.copy())
    for k, node in cable.held:
        state.r[node] = fixtures.places[k]
    length, node_type = cable.model.cable.length, cable.model.node
    for _ in range(_STEPS):
        pulled, turns = basis.held(cable, state)
        balance = cable.evaluated(pulled, fixtures, (0.0, basis.springs))
        found = balance.stepped(turns).solve(basis.forces @ eta - balance.residual)
        turned, shifted, forces, moments = cable.steps(found)
        size = max(float(np.abs(turned).max()), float(np.abs(shifted).max()) / length)
        if not np.isfinite(size):
            break
        share = min(1.0, _LONGEST / size) if size else 1.0
        state = replace(
            state,
            x=np.asarray(node_type.moved(state.x, share * turned)),
            r=state.r + share * shifted,
            force=state.force + share * forces,
            moment=state.moment + share * moments,
        )
        if size < _LAST:
            return state
    raise EstimationError("no first state of a motion was found near its first instant")


def columns_of(
    cable: MovingCable,
    state: State,
    fixtures: Fixtures,
    basis: Basis,
    numbers: Numbers,
    first: FloatArray,
) -> Columns:
    """Derivatives of `begun` at `first` by `numbers`, then by eta and zeta.

    Those of the velocity, the derivative of the shape along zeta, are central differences of those
    of two shapes.
    """
    eta, zeta = np.split(first, 2)
    step = _DIFFERENCE / max(float(np.abs(zeta).max()), 1e-12)
    columns = _columns_of_shape(cable, state, fixtures, basis, numbers, eta)
    turn, place, _, _ = columns
    rates = np.zeros((cable.n_nodes, cable.b + cable.d, turn.shape[2]))
    if zeta.any():
        both = []
        for sign in (1, -1):
            along = eta + sign * step * zeta
            shape = _shape(cable, state, fixtures, basis, along)
            both.append(_columns_of_shape(cable, shape, fixtures, basis, numbers, along))
        (one, first_place, _, _), (other, last_place, _, _) = both
        change = np.concatenate([one - other, first_place - last_place], axis=1)
        rates = change / (2 * step)
        if cable.b > 1:  # turns about axes that turn: d w = d/dt turn + w x turn
            rates[:, : cable.b] += np.cross(state.w[..., None], turn, axis=1)
    count = len(eta)
    shapes = slice(turn.shape[2] - 2 * count, turn.shape[2] - count)
    rates[..., -count:] = np.concatenate([turn[..., shapes], place[..., shapes]], axis=1)
    for k, node in cable.held:
        rates[node, cable.b :] = numbers.velocities[k]
    none = np.zeros_like(rates)
    return Columns(turn, place, rates, none, none, *columns[2:])


def _columns_of_shape(
    cable: MovingCable,
    state: State,
    fixtures: Fixtures,
    basis: Basis,
    numbers: Numbers,
    eta: FloatArray,
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Derivatives of `_shape`: of turns, places, forces and moments."""
    pulled, turns = basis.held(cable, replace(state, w=0 * state.w, v=0 * state.v))
    tangent = Tangent(cable, pulled, fixtures)
    b, count = cable.b, basis.forces.shape[1]
    q = numbers.p.shape[1] - 2 * count
    none = np.zeros((cable.n_nodes, b + cable.d, q + 2 * count))
    position = none.copy()
    for k, node in cable.held:
        position[node, b:] = numbers.places[k]
    right = tangent.right((position, none, basis.springs * position), numbers)
    right[:, q : q + count] -= basis.forces
    springs = basis.springs * tangent.mass[0], basis.springs * tangent.mass[1]
    balance = Balance(cable, right[:, 0], right[:, :0], tangent.stiffness, springs)
    factor = _pushed(balance, basis.forces @ eta).stepped(turns)
    turn, place, force, moment = cable.steps(factor.solve(-right))
    for k, node in cable.held:
        place[node] = numbers.places[k]
    return turn, place, force, moment


def _pushed(balance: Balance, forces: FloatArray) -> Balance:
    """The balance of a shape that forces (N,) hold, with derivatives by turns about own axes.

    K is by increments: it lacks what the sum of all moments would add, which is zero otherwise.
    """
    cable, (of_segment, at_ends) = balance.cable, balance.stiffness
    b = cable.b
    if b == 1:
        return balance
    moments = cable.steps(forces)[0]
    blocks, of_segment = np.cross(np.eye(b), moments[:, None]) / 2, of_segment.copy()
    of_segment[:, :b, :b] += blocks[:-1]
    of_segment[-1, b : 2 * b, b : 2 * b] += blocks[-1]
    return replace(balance, stiffness=(of_segment, at_ends))
