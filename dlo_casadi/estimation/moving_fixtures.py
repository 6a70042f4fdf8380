"""The fixtures of a recorded motion with their deviations and their clock's delay."""

from __future__ import annotations

import numpy as np

from dlo_casadi.arrays import FloatArray
from dlo_casadi.effects.clock_delay import CLOCK_DELAY
from dlo_casadi.motion import sensitivities
from dlo_casadi.motion.path import FixturePath
from dlo_casadi.motion.sensitivities import Numbers
from dlo_casadi.motion.state import Fixtures
from dlo_casadi.motion.system import MovingCable

# Derivatives of the end's place (d, n_own) and of the fixtures' turns (2 increment, n_own) by a
# recording's own unknowns.
Ways = tuple[FloatArray, FloatArray]


def _delay(cable: MovingCable) -> float:
    """What the fixtures' clock shows minus what the points' clock shows [s]."""
    names = cable.model.names
    return float(cable.p[names.index(CLOCK_DELAY)]) if CLOCK_DELAY in names else 0.0


class HeldFixtures:
    """Where fixtures are, with their deviations."""

    def __init__(self, path: FixturePath, ways: Ways, cable: MovingCable, own: FloatArray) -> None:
        self.cable, self.own, self._path, self._delay = cable, own, path, _delay(cable)
        place, turns = ways
        self._place, self._turns = place @ own, turns @ own
        self._resting: Fixtures | None = None
        self._known: dict[float, Fixtures] = {}

    def at(self, t: float) -> Fixtures:
        """The fixtures at a time of the points' clock."""
        if self._resting is not None:
            return self._resting
        found = self._known.get(t)
        if found is None:
            (found,) = self._many(np.array([t]))
        if not self._path.moving:
            self._resting = found
        return found

    def prepare(self, times: FloatArray, numbers: GivenNumbers | None) -> None:
        """Have fixtures ready at times, and their derivatives."""
        if self._path.moving:
            self._known = dict(zip(times.tolist(), self._many(times), strict=True))
        if numbers is not None:
            numbers.prepare(times)

    def _many(self, times: FloatArray) -> list[Fixtures]:
        node, (pose, rates) = self.cable.model.node, self._path.declared(times + self._delay)
        d, c, b = node.dimension, node.coordinates, node.increment
        pose[:, d : 2 * d] += self._place
        for k in (0, 1):
            at, turn = slice(2 * d + c * k, 2 * d + c * (k + 1)), self._turns[b * k : b * (k + 1)]
            if turn.any():
                pose[:, at] = node.moved(pose[:, at], np.tile(turn, (len(times), 1)))
        rows = zip(pose, self.cable.true_places(pose), rates, strict=True)
        return [Fixtures(one, places, *moving) for one, places, moving in rows]


class GivenNumbers:
    """Derivatives of what a motion is given, by theta and by its own unknowns."""

    def __init__(
        self,
        path: FixturePath,
        ways: Ways,
        cable: MovingCable,
        by_p: FloatArray,
        by_rest: FloatArray,
    ) -> None:
        """`by_p`, `by_rest`: derivatives of parameters and rest strains by theta."""
        place, turns = ways
        model, own = cable.model, place.shape[1]
        self._path, self.cable = path, cable
        self.p = np.pad(by_p, ((0, 0), (0, own)))
        rest = model.chain.rest_inside(by_rest)
        self.rest = np.pad(rest, ((0, 0), (0, 0), (0, own)))
        q, d = self.p.shape[1], cable.d
        self.turns = np.pad(turns, ((0, 0), (q - own, 0)))
        self.places = np.zeros((2, d, q))
        self.places[1, :, q - own :] = place
        pose = path.at(_delay(cable), cable).pose
        self.places += sensitivities.places_by_p(cable, pose) @ self.p
        names = model.names
        self.delay = self.p[names.index(CLOCK_DELAY)] if CLOCK_DELAY in names else None
        none = np.zeros_like(self.places)
        self._still = Numbers(self.p, self.rest, self.turns, self.places, none, none)
        self._known: dict[float, tuple[FloatArray, FloatArray]] = {}

    def prepare(self, times: FloatArray) -> None:
        """Have rates of the fixtures ready at times."""
        if self.delay is not None:
            self._known = dict(zip(times.tolist(), self._rates(times), strict=True))

    def _rates(self, times: FloatArray) -> list[tuple[FloatArray, FloatArray]]:
        """Rates of the places (3, 2, d), once to three times, and of turning (2 b,)."""
        path, at = self._path, times + _delay(self.cable)
        moved = np.stack([path.rates(at, order) for order in (1, 2, 3)], axis=1)
        return list(zip(moved, path.turning(at), strict=True))

    def at(self, t: float) -> Numbers:
        """The derivatives at a time."""
        if self.delay is None:
            return self._still
        rates, turning = self._known.get(t) or self._rates(np.array([t]))[0]
        moved = rates[..., None] * self.delay
        turns = self.turns + turning[:, None] * self.delay
        return Numbers(self.p, self.rest, turns, self.places + moved[0], moved[1], moved[2])
