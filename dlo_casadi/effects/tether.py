"""A spring from the cable to a fixed point."""

import math
from collections.abc import Mapping

import casadi as ca

from dlo_casadi.effects.acting import SpringAt
from dlo_casadi.effects.cable import CableData, Parameter, Setup
from dlo_casadi.effects.effect import Effect, Params, PointLoad, vector

# Largest distance of an anchor from the board's origin, in lengths of the cable: its force then
# changes by a tenth in direction and size if the cable moves by its own length.
FARTHEST = 10.0


class Tether(PointLoad):
    """A spring of no length from one place of the cable to a fixed point: a strap, a rubber band.

        V = k |r(s) - a|^2 / 2                                        [J]

    It is no dead load: its force k (a - r(s)) depends on the shape.

    Parameters
    ----------
    stiffness : scalar k [N/m], >= 0
        Vanishes at 0; estimated up to a thousand of the cable's weights on Earth per length.
    position : scalar [m], in [0, L]
        Arc length s from the start fixture. r(s) is once differentiable in s.
    anchor_x, anchor_y, anchor_z : scalar [m]
        The fixed point a in the board frame, anchor_z in space alone; estimated up to
        ten lengths of the cable from its origin.
    """

    name = "tether"
    n_springs = 1

    def parameters(self, cable: CableData) -> tuple[Parameter, ...]:
        """Declare stiffness, place and anchor."""
        names, length = (f"anchor_{axis}" for axis in cable.axes), cable.length
        anchor = Parameter.symmetric(names, "m", 0.1 * length, FARTHEST * length, math.inf)
        return (_stiffness(cable), self.position(cable), *anchor)

    @classmethod
    def applies(cls, setup: Setup) -> bool:
        """True with several poses; in a single pose it is a point force."""
        return super().applies(setup) and setup.n_poses > 1

    def springs(self, params: Params) -> tuple[SpringAt, ...]:
        """The spring."""
        k, anchor = params["stiffness"], vector(params, "anchor_")
        return (SpringAt(k, k * anchor, k * ca.sumsqr(anchor) / 2, params["position"]),)

    def linear(self) -> Effect:
        """Return the same spring by its stiffness and its force at the origin."""
        return _LinearTether(label=self.label)

    def of_linear(self, cable: CableData, values: Mapping[str, float]) -> dict[str, float]:
        """Stiffness, place and anchor a = f / k; k is increased if a would lie too far away."""
        force = {axis: values[f"f{axis}"] for axis in cable.axes}
        least = math.hypot(*force.values()) / (FARTHEST * cable.length)
        stiffness = max(values["stiffness"], least)
        anchor = {f"anchor_{axis}": f / stiffness if f else 0.0 for axis, f in force.items()}
        return {"stiffness": stiffness, "position": values["position"], **anchor}

    def in_linear(self, values: Mapping[str, float]) -> dict[str, float]:
        """Stiffness, place and force f = k a.

        Tethers of the same force f0 at r have a = r + f0 / k, a curve; f = f0 + k r is a line.
        """
        k = values["stiffness"]
        forces = {name[-1]: k * a for name, a in values.items() if name.startswith("anchor_")}
        own = {f"f{axis}": force for axis, force in forces.items()}
        return {"stiffness": k, "position": values["position"], **own}


class _LinearTether(PointLoad):
    """The same spring in parameters in which its energy is linear: V = k |r(s)|^2 / 2 - f . r(s).

    With f = k a it differs from the tether's energy by a constant. At k = 0 the anchor has no
    effect, and f is a dead force.
    """

    name = "linear_tether"
    n_springs = 1

    def parameters(self, cable: CableData) -> tuple[Parameter, ...]:
        """Declare stiffness, place and the force on the place when it is at the origin."""
        names = (f"f{axis}" for axis in cable.axes)
        force = Parameter.symmetric(names, "N", 0.1 * 9.81 * cable.mass)
        return (_stiffness(cable), self.position(cable), *force)

    def springs(self, params: Params) -> tuple[SpringAt, ...]:
        """The spring, its energy up to a constant."""
        spring = SpringAt(params["stiffness"], vector(params, "f"), ca.SX(0), params["position"])
        return (spring,)


def _stiffness(cable: CableData) -> Parameter:
    scale = 9.81 * cable.mass / cable.length
    return Parameter("stiffness", "N/m", 0.0, scale, 0.0, 1e3 * scale, possible=(0.0, math.inf))
