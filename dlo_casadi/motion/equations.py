"""The equations of motion of the whole cable as one CasADi function, for a user's own problem."""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np

from dlo_casadi.arrays import FloatArray
from dlo_casadi.model.functions import functions_of
from dlo_casadi.motion.state import State
from dlo_casadi.motion.system import MovingCable
from dlo_casadi.rod.ends import EndConditions


def motion_equations(cable: MovingCable) -> ca.Function:
    """(x, v, a, multipliers, fixtures) -> residual, see `CableInMotion.motion_equations`."""
    model, segment, node = cable.model, cable.segment, cable.model.node
    b, c, d, count, n = cable.b, node.coordinates, cable.d, cable.n_segments, cable.n_nodes
    x, v, a = ca.MX.sym("x", c + d, n), ca.MX.sym("v", b + d, n), ca.MX.sym("a", b + d, n)
    size = d * (1 + 2 * model.n_springs)
    held = [0, n - 1] if model.end.place else [0]
    multipliers = ca.MX.sym("multipliers", size * count + cable.n_moments + d * len(held))
    fixtures = ca.MX.sym("fixtures", EndConditions.size(node))
    edges = [0, size * count, size * count + cable.n_moments, multipliers.numel()]
    force, moment, reactions = ca.vertsplit(multipliers, edges)

    def both(rows: ca.MX) -> ca.MX:
        return ca.vertcat(rows[:, :-1], rows[:, 1:])

    moving = [x[:c, :], x[c:, :], v[:b, :], v[b:, :], a[:b, :], a[b:, :]]
    numbers = [ca.DM(np.ascontiguousarray(rows.T)) for rows in cable.numbers]
    given: list[Any] = [*map(both, moving), ca.reshape(force, size, count), *numbers]
    (rows,) = segment.residual.map(count).call(given)
    turned = ca.horzcat(rows[:b, :], ca.MX(b, 1)) + ca.horzcat(ca.MX(b, 1), rows[b : 2 * b, :])
    first = 2 * b
    placed = ca.horzcat(rows[first : first + d, :], ca.MX(d, 1))
    placed += ca.horzcat(ca.MX(d, 1), rows[first + d : first + 2 * d, :])
    on = np.repeat(np.hstack([np.ones((count, 1)), np.repeat(cable.springs_on, 2, axis=1)]), d, 1)
    # Springs are unknowns of their own segments; elsewhere these are zero.
    off = ca.DM(np.ascontiguousarray((1 - on).T)) * ca.reshape(force, size, count)
    joined = rows[first + 2 * d :, :] * ca.DM(np.ascontiguousarray(on.T)) + off

    lam, kept = ca.MX.zeros(model.n_lam), cable.held_turns
    for k, row in enumerate(kept):
        lam[row] = moment[k]
    pose = ca.vertcat(fixtures, ca.MX.zeros(model.n_pose - fixtures.numel()))
    deviation = ca.DM.zeros(len(model.deviation_names))
    ends = ca.vertcat(x[:c, 0], x[:c, -1])
    at_ends = functions_of(model).end_slope(ends, lam, cable.p, pose, deviation)
    if cable.rubs is not None:
        rubbing = cable.rubs(ca.vertcat(v[:b, 0], v[:b, -1]), cable.p)[0]
    else:
        rubbing = ca.MX.zeros(2 * b)
    turned[:, 0] += at_ends[:b] + rubbing[:b]
    turned[:, -1] += at_ends[b : 2 * b] + rubbing[b:]
    placed[:, 0] -= functions_of(model).dead_load(cable.p)
    true, _ = segment.terms.true_ends_and_length(cable.p, fixtures, deviation)
    conditions = [at_ends[[2 * b + row for row in kept]]]
    for k, i in enumerate(held):
        placed[:, i] += reactions[k * d : (k + 1) * d]
        conditions.append(x[c:, i] - true[k * d : (k + 1) * d])
    residual = ca.veccat(ca.vertcat(turned, placed), joined, *conditions, node.excess(x[:c, :]))
    names = ["x", "v", "a", "multipliers", "fixtures"]
    arguments = [x, v, a, multipliers, fixtures]
    return ca.Function("motion_equations", arguments, [residual], names, ["residual"])


def unknowns_of(
    cable: MovingCable, state: State, forces: tuple[FloatArray, FloatArray]
) -> dict[str, FloatArray]:
    """Arguments x, v, a and multipliers of `motion_equations` in a state.

    `forces` (d,) [N]: of the cable on what holds its start, and its end.
    """
    held = forces if cable.model.end.place else forces[:1]
    return {
        "x": np.hstack([state.x, state.r]).T,
        "v": np.hstack([state.w, state.v]).T,
        "a": np.hstack([state.alpha, state.a]).T,
        "multipliers": np.concatenate([state.force.ravel(), state.moment, *held]),
    }
