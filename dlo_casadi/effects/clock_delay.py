"""The clock of the fixtures does not show what the clock of the points shows."""

import casadi as ca

from dlo_casadi.effects.cable import Parameter, Setup
from dlo_casadi.effects.effect import MeasurementEffect, Params, Viewpoint

CLOCK_DELAY = "clock_delay.delay"


class ClockDelay(MeasurementEffect):
    """Recordings of moving fixtures and of the cable's points have clocks of their own.

        fixtures at the time t of the points = recorded fixtures at t + delay

    Still shapes do not know it.

    Parameters
    ----------
    delay : scalar [s]
        What the fixtures' clock shows minus what the points' clock shows. Vanishes at 0.
    """

    name = "clock_delay"
    declared = (Parameter("delay", "s", scale=0.01, lower=-0.5, upper=0.5),)

    @classmethod
    def applies(cls, setup: Setup) -> bool:
        """True if there are recordings of the moving cable."""
        return super().applies(setup) and setup.moves

    def observe(self, point: ca.SX, frame: ca.SX, viewpoint: Viewpoint, params: Params) -> ca.SX:
        """Points are where they are seen: what is late is the fixtures."""
        return point
