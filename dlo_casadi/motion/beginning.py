"""The first state of a recorded motion: a shape and velocities that the constraints allow.

    R(q) = sum_k eta_k F_k,   K u = sum_k zeta_k F_k,   F_k = w_k^2 M phi_k

with the balance R of statics, its derivative K at the shape q, and the lowest modes phi_k at rest.
Near rest the shape is q_0 + sum_k eta_k phi_k and the velocity sum_k zeta_k phi_k; far from it both
still fulfil all constraints.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.sparse import dia_array

from dlo_casadi.arrays import FloatArray
from dlo_casadi.errors import EstimationError
from dlo_casadi.motion.modes import Matrices, lowest
from dlo_casadi.motion.sensitivities import Columns, Numbers, Tangent, both_nodes
from dlo_casadi.motion.state import Banded, Fixtures, State
from dlo_casadi.motion.system import MovingCable

# Newton's steps, and the size [rad, lengths] of the last one.
_STEPS, _LAST = 40, 1e-10
# Longest step of a node [rad].
_LONGEST = 0.5
# Step of the differences of K u along directions.
_DIFFERENCE = 1e-5


@dataclass(frozen=True, eq=False)
class Basis:
    """Forces F_k that make first states.

    Parameters
    ----------
    forces : (N, m)
        Of modes scaled such that the largest displacement is the cable's length.
    frequencies : (m,) [rad/s]
    """

    forces: FloatArray
    frequencies: FloatArray

    @classmethod
    def of(cls, cable: MovingCable, rest: State, fixtures: Fixtures, count: int) -> Basis:
        """Those of the lowest modes about a state of rest."""
        matrices = Matrices.of(cable, rest, fixtures)
        length, scale = cable.model.cable.length, cable.slowest**2
        squares, modes = lowest(matrices, count, scale)
        _, places, _, _ = cable.steps(modes)
        sizes = np.linalg.norm(places, axis=1).max(axis=0)
        modes = modes * (length / np.maximum(sizes, 1e-12))
        squares = np.maximum(squares, 1e-3 * scale)
        return cls(matrices.sparse(matrices.mass) @ modes * squares, np.sqrt(squares))


def begun(
    cable: MovingCable, near: State, fixtures: Fixtures, basis: Basis, first: FloatArray
) -> State:
    """The state of coordinates (2 m,): eta, then zeta [1/s].

    Raises
    ------
    EstimationError
        If no shape balances these forces near the one given.
    """
    eta, zeta = np.split(first, 2)
    unit = np.broadcast_to(np.eye(cable.b), (cable.n_nodes, cable.b, cable.b))
    none, still = np.zeros_like(near.w), np.zeros_like(near.v)
    state = replace(near, w=none, v=still, alpha=none, a=still)
    for k, node in cable.held:
        state.r[node] = fixtures.places[k]
    length, node_type = cable.model.cable.length, cable.model.node
    for _ in range(_STEPS):
        balance = cable.evaluated(state, fixtures)
        solver = balance.stepped(unit)
        found = solver.solve(basis.forces @ eta - balance.residual)
        turned, shifted, pulled, twisted = cable.steps(found)
        size = max(float(np.abs(turned).max()), float(np.abs(shifted).max()) / length)
        if not np.isfinite(size):
            break
        share = min(1.0, _LONGEST / size) if size else 1.0
        state = replace(
            state,
            x=np.asarray(node_type.moved(state.x, share * turned)),
            r=state.r + share * shifted,
            force=state.force + share * pulled,
            moment=state.moment + share * twisted,
        )
        if size < _LAST:
            final = cable.evaluated(state, fixtures).stepped(unit)
            w, v, _, _ = cable.steps(final.solve(basis.forces @ zeta))
            for k, node in cable.held:
                v[node] = fixtures.velocities[k]
            return replace(state, w=w, v=v)
    raise EstimationError("no first state of a motion was found near its first instant")


def columns_of(
    cable: MovingCable,
    state: State,
    fixtures: Fixtures,
    basis: Basis,
    numbers: Numbers,
) -> Columns:
    """Derivatives of `begun` by `numbers`, then by eta and zeta."""
    tangent = Tangent(cable, state, fixtures)
    b, d, count = cable.b, cable.d, basis.forces.shape[1]
    q = numbers.p.shape[1] - 2 * count
    none = np.zeros((cable.n_nodes, b + d, q + 2 * count))
    position = none.copy()
    for k, node in cable.held:
        position[node, b:] = numbers.places[k]
    factor = Banded(cable.band(*tangent.stiffness), cable.width)
    found = factor.solve(-tangent.right((position, none, none), numbers))
    found[:, q : q + count] += factor.solve(basis.forces)
    turn, place, force, moment = cable.steps(found)
    for k, node in cable.held:
        place[node] = numbers.places[k]
    rates = none.copy()
    straight = factor.solve(basis.forces)
    w, v, _, _ = cable.steps(straight)
    rates[:, :, q + count :] = np.concatenate([w, v], axis=1)
    # K u is constant along the other columns: K du = -(dK) u.
    still = replace(state, w=0 * state.w, v=0 * state.v)
    change = _change_of_product(cable, still, (turn, place, force), numbers, state)
    w, v, _, _ = cable.steps(factor.solve(-change))
    rates += np.concatenate([w, v], axis=1)
    for k, node in cable.held:
        rates[node, b:] = numbers.velocities[k]
    return Columns(turn, place, rates, none, none, force, moment)


def _change_of_product(
    cable: MovingCable,
    still: State,
    columns: tuple[FloatArray, FloatArray, FloatArray],
    numbers: Numbers,
    moving: State,
) -> FloatArray:
    """Change (N, q) of K u along columns, by central differences of K."""
    turn, place, force = columns
    q, node = turn.shape[2], cable.model.node
    both = np.concatenate([moving.w, moving.v], axis=1)[..., None]
    own = both_nodes(cable, both)[..., 0]
    total = np.zeros((cable.n_segments, 2 * (cable.b + cable.d) + still.force.shape[1], q))
    rows: list[list[FloatArray]] = []
    for sign in (1, -1):
        for k in range(q):
            step = sign * _DIFFERENCE
            state = replace(
                still,
                x=np.asarray(node.moved(still.x, step * turn[..., k])),
                r=still.r + step * place[..., k],
                force=still.force + step * force[..., k],
            )
            arguments = cable.arguments(state)
            arguments[7] = arguments[7] + step * numbers.p[:, k]
            arguments[8] = arguments[8] + step * numbers.rest[:, :, k]
            rows.append(arguments)
    stacked = [np.stack(parts) for parts in zip(*rows, strict=True)]
    factors = np.zeros((2 * q, cable.n_segments, 2))
    _, stiffness, _ = cable.segment.mapped("motion")(*stacked, factors)
    first = own.shape[1]
    product = np.einsum("qsij,sj->qsi", stiffness[..., :first], own)
    total = (product[:q] - product[q:]).transpose(1, 2, 0) / (2 * _DIFFERENCE)
    return cable.gathered_columns(total, np.zeros((len(cable.end_rows), q)))


def near_shape(
    cable: MovingCable,
    fixtures: Fixtures,
    rest: State,
    basis: Basis,
    x: FloatArray,
    std: FloatArray,
) -> tuple[State, FloatArray]:
    """A state with frames x (n_nodes, coordinates), and eta (m,) whose forces nearly balance it.

    `std`: standard deviations (m,) of eta.
    """
    state = cable.with_places(replace(rest, x=x), fixtures)
    balance = cable.evaluated(state, fixtures)
    length, size, width = cable.model.cable.length, cable.size, cable.width
    band = balance.band(balance.stiffness)[width:]
    whole = dia_array((band, np.arange(width, -width - 1, -1)), shape=(size, size)).toarray()
    nodes, forces, moments, _ = cable.places
    of_forces = np.zeros(size + 1, dtype=bool)
    of_forces[forces.ravel()] = of_forces[moments] = True
    of_forces, count = of_forces[:size], int(of_forces[:size].sum())
    # Moments over the length beside forces; conditions of places and directions are no forces.
    rows = np.zeros(size + 1)
    rows[nodes[:, : cable.b].ravel()] = 1 / length
    rows[nodes[:, cable.b :].ravel()] = 1.0
    rows = rows[:size]
    columns = np.hstack([whole[:, of_forces], -basis.forces])
    weight = float(np.linalg.norm(cable.model.gravity)) * cable.model.cable.mass or 1.0
    damped = np.zeros((len(std), columns.shape[1]))
    damped[:, count:] = np.diag(1e-3 * weight / std)
    matrix = np.vstack([rows[:, None] * columns, damped])
    right = np.concatenate([-rows * balance.residual, np.zeros(len(std))])
    found = np.linalg.lstsq(matrix, right, rcond=None)[0]
    step = np.zeros(cable.size)
    step[of_forces] = found[:count]
    _, _, pulled, twisted = cable.steps(step)
    return (
        replace(state, force=state.force + pulled, moment=state.moment + twisted),
        found[count:],
    )
