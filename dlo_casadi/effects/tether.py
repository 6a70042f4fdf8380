"""A spring from the cable to a fixed point."""

from __future__ import annotations

from collections.abc import Mapping

import casadi as ca
import numpy as np

from dlo_casadi.effects.effect import Cable, Effect, Params, PointLoad, SpringAt
from dlo_casadi.effects.setup import Setup
from dlo_casadi.parameters import Parameter

# How far an anchor may lie from the board's origin, in lengths of the cable: the force of one
# that far changes by a tenth in direction and size where the cable moves by its own length.
FARTHEST = 10.0


class Tether(PointLoad):
    """A spring of no length from one place of the cable to a fixed point: a strap, a rubber band.

        V = k |r(s) - a|^2 / 2                                        [J]

    No dead load: its force k (a - r(s)) depends on the shape.

    Parameters
    ----------
    stiffness : scalar k [N/m], >= 0
        Vanishes at 0; at most a thousand of the cable's weights on Earth per length.
    position : scalar [m], in [0, L]
        Arc length s from the start fixture. r(s) is once differentiable in s.
    anchor_x, anchor_y : scalar [m]
        The fixed point a in the board frame, at most ten lengths of the cable from its origin.
    """

    name = "tether"
    n_springs = 1

    def parameters(self, cable: Cable) -> tuple[Parameter, ...]:
        """Declare stiffness, place and anchor."""
        reach = FARTHEST * cable.length
        return (
            _stiffness(cable),
            self.position(cable),
            *(
                Parameter(name, "m", scale=0.1 * cable.length, lower=-reach, upper=reach)
                for name in ("anchor_x", "anchor_y")
            ),
        )

    @classmethod
    def applies(cls, setup: Setup) -> bool:
        """In one pose it is a point force."""
        return setup.n_poses > 1

    def springs(self, params: Params) -> tuple[SpringAt, ...]:
        """The spring."""
        k, anchor = params["stiffness"], ca.vertcat(params["anchor_x"], params["anchor_y"])
        return (SpringAt(k, k * anchor, k * ca.sumsqr(anchor) / 2, params["position"]),)

    def linear(self) -> Effect:
        """Return the same spring by its stiffness and its force at the origin."""
        return _LinearTether(label=self.label)

    def of_linear(self, cable: Cable, values: Mapping[str, float]) -> dict[str, float]:
        """Stiffness, place and anchor a = f / k; k is raised where a would lie too far away."""
        force = np.array([values["fx"], values["fy"]])
        least = float(np.hypot(*force)) / (FARTHEST * cable.length)
        stiffness = max(values["stiffness"], least)
        anchor = force / stiffness if stiffness > 0 else np.zeros(2)
        return {
            "stiffness": stiffness,
            "position": values["position"],
            "anchor_x": float(anchor[0]),
            "anchor_y": float(anchor[1]),
        }


class _LinearTether(PointLoad):
    """A tether in the parameters that its energy is linear in: V = k |r(s)|^2 / 2 - f . r(s).

    With f = k a it differs from the tether's by a constant; at k = 0, where an anchor tells
    nothing, f is a dead force.
    """

    name = "linear_tether"
    n_springs = 1

    def parameters(self, cable: Cable) -> tuple[Parameter, ...]:
        """Declare stiffness, place and the force on the place when it is at the origin."""
        scale = 0.1 * 9.81 * cable.mass
        return (
            _stiffness(cable),
            self.position(cable),
            Parameter("fx", "N", scale=scale),
            Parameter("fy", "N", scale=scale),
        )

    def springs(self, params: Params) -> tuple[SpringAt, ...]:
        """The spring, its energy up to a constant."""
        force = ca.vertcat(params["fx"], params["fy"])
        return (SpringAt(params["stiffness"], force, ca.SX(0), params["position"]),)


def _stiffness(cable: Cable) -> Parameter:
    scale = 9.81 * cable.mass / cable.length
    return Parameter("stiffness", "N/m", scale=scale, lower=0.0, upper=1e3 * scale)
