"""A compact mass carried by the cable."""

from math import inf

import casadi as ca
import numpy as np

from dlo_casadi.effects.acting import MassAt, PointForceAt
from dlo_casadi.effects.cable import CableData, Parameter
from dlo_casadi.effects.effect import Fitted, Params, PointLoad
from dlo_casadi.thresholds import NORMAL_95


class LumpedMass(PointLoad):
    """A compact mass on the cable: a connector, a clip, a sensor.

        V = -m g . r(s)                                               [J]

    Its size and moment of inertia are neglected, which is accurate if it is shorter than L / 10.

    Parameters
    ----------
    mass : scalar [kg], >= 0
        Vanishes at 0; estimated up to three times the cable's mass.
    position : scalar [m], in [0, L]
        Arc length s from the start fixture. r(s) is once differentiable in s.

    References
    ----------
    Point load on an elastica, e.g. Frisch-Fay, Flexible Bars, 1962.
    """

    name = "lumped_mass"
    carried = True

    def parameters(self, cable: CableData) -> tuple[Parameter, ...]:
        """Declare mass and position."""
        scale, most = 0.1 * cable.mass, 3 * cable.mass
        mass = Parameter("mass", "kg", 0.0, scale, 0.0, most, possible=(0.0, inf))
        return mass, self.position(cable)

    def forces(self, gravity: ca.SX, params: Params) -> tuple[PointForceAt, ...]:
        """Weight of the mass."""
        return (PointForceAt(params["mass"] * gravity, params["position"]),)

    def masses(self, params: Params) -> tuple[MassAt, ...]:
        """The mass itself."""
        return (MassAt(params["mass"], params["position"]),)

    def may_be(self, found: Fitted) -> bool:
        """A dead force may be a weight if it is along gravity, within two standard deviations."""
        effect, gravity = found.effect, np.array(found.setup.gravity)
        if not isinstance(effect, PointLoad) or not effect.dead:
            return False
        down = gravity / max(float(np.linalg.norm(gravity)), 1e-12)
        place, field = ca.SX.zeros(len(down)), ca.SX(ca.DM(gravity))
        force, moved = found.propagated(lambda params: effect.force(place, field, params))
        across = np.eye(len(down)) - np.outer(down, down)
        limit = NORMAL_95 * np.linalg.norm(across @ moved)
        return bool(force @ down > 0 and np.linalg.norm(across @ force) < limit)
