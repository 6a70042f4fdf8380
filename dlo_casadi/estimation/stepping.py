"""Steps of time between the instants of a motion, with derivatives where these are asked for."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from dlo_casadi.arrays import FloatArray
from dlo_casadi.errors import EstimationError
from dlo_casadi.estimation.moving_fixtures import GivenNumbers, HeldFixtures
from dlo_casadi.motion import sensitivities
from dlo_casadi.motion.sensitivities import Columns, Stepping, Tangent
from dlo_casadi.motion.state import State
from dlo_casadi.motion.steps import Moving, begun_by, first_step
from dlo_casadi.rod.node import Node

# Halvings of a step of time whose Newton's method fails.
_HALVINGS = 4


@dataclass(frozen=True, eq=False)
class Instant:
    """A cable at the end of a step.

    Parameters
    ----------
    moving : Moving
    columns : Columns or None
        Its derivatives.
    dt : float [s]
        Length of the last step.
    """

    moving: Moving
    columns: Columns | None
    dt: float

    def for_step(self, dt: float) -> Instant:
        """The same, to be continued by a step dt: means of accelerations are of another time."""
        factor, columns = dt / self.dt, self.columns
        if abs(factor - 1) < 1e-12:
            return self
        if columns is not None:
            known = columns.accelerations
            columns = replace(columns, own=known + factor * (columns.own - known))
        return Instant(self.moving.for_step(factor), columns, dt)

    def moved(self, node: type[Node], step: FloatArray) -> Instant:
        """The state after a step (q,) of what it is derived by, to first order."""
        c, now = self.columns, self.moving.state
        assert c is not None
        b = c.turn.shape[1]
        rates, changed = c.rates @ step, c.accelerations @ step
        state = State(
            np.asarray(node.moved(now.x, c.turn @ step)),
            now.r + c.place @ step,
            now.w + rates[:, :b],
            now.v + rates[:, b:],
            now.alpha + changed[:, :b],
            now.a + changed[:, b:],
            now.force + c.force @ step,
            now.moment + c.moment @ step,
        )
        return replace(self, moving=Moving(state, self.moving.own + c.own @ step))


def within(begin: float, end: float, longest: float) -> tuple[list[float], float]:
    """Ends [s] of even steps from one time to another, and their length."""
    count = int(np.ceil((end - begin) / longest - 1e-9))
    dt = (end - begin) / count
    return [begin + (k + 1) * dt for k in range(count)], dt


def started(
    held: HeldFixtures,
    first: State,
    columns: Columns | None,
    times: tuple[float, float],
    numbers: GivenNumbers | None,
) -> Instant:
    """A first state with its accelerations, which are those of a step between the times [s]."""
    begin, end = times
    dt, fixtures = end - begin, held.at(end)
    tried = first_step(held.cable, first, fixtures, dt)
    if tried is None:
        raise EstimationError("the first step of a motion was not found")
    now = begun_by(first, tried)
    if numbers is not None and columns is not None:
        tangent = Tangent(held.cable, tried.state, fixtures)
        columns = sensitivities.started(first, tried, columns, tangent, numbers.at(end), dt)
    return Instant(now, columns, dt)


def stepped(
    steps: Stepping,
    held: HeldFixtures,
    now: Instant,
    at: float,
    dt: float,
    numbers: GivenNumbers | None,
) -> Instant:
    """The state at a time [s], a step dt later, halved where Newton's method fails."""
    for halving in range(_HALVINGS + 1):
        parts, small = 2**halving, dt / 2**halving
        ahead = now.for_step(small)
        for k in range(parts):
            t = at - dt + (k + 1) * small
            fixtures = held.at(t)
            after, along = steps.step(ahead.moving, fixtures, small), ahead.columns
            if after is None:
                break
            if numbers is not None and along is not None:
                given = numbers.at(t)
                along = steps.derived(ahead.moving, after, along, fixtures, given, small)
            ahead = Instant(after, along, small)
        else:
            return ahead
    raise EstimationError(f"no step of time was found at {at:.3f} s")
