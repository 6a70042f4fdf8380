"""What takes energy from a moving cable: air, a viscous medium, friction of a pin."""

from typing import ClassVar

import casadi as ca

from dlo_casadi.effects.cable import CableData, Parameter, Setup
from dlo_casadi.effects.effect import Effect, Params

# Density of air [kg/m^3].
AIR = 1.2
# Velocity [m/s] below which the drag of air becomes linear in it, and its second derivative finite.
_SLOW = 1e-4
# Rate [rad/s] below which the friction of a pin becomes linear in it.
_ROUNDED = 0.05


class Damping(Effect):
    """Kind `damping`: a dissipation function of the velocities; it has no effect at rest.

    Forces are minus its derivatives by velocities, moments minus those by rates of turning.
    """

    kind: ClassVar[str] = "damping"

    @classmethod
    def applies(cls, setup: Setup) -> bool:
        """True if there are recordings of the moving cable."""
        return super().applies(setup) and setup.moves

    def density(
        self, velocity: ca.SX, tangent: ca.SX, cable: CableData, params: Params
    ) -> ca.SX | float:
        """Dissipation function per length [W/m].

        Parameters
        ----------
        velocity : (dimension,) [m/s]
        tangent : (dimension,)
            Unit vector along the cable.
        """
        return 0.0

    def of_turning(self, params: Params) -> ca.SX | float:
        """Share of the internal damping that also opposes a turning of the bending plane."""
        return 0.0

    def at_pin(self, turning: ca.SX, params: Params) -> ca.SX | float:
        """Dissipation function [W] of the cable's rate of turning (increment,) [rad/s] at a pin."""
        return 0.0


class AirDrag(Damping):
    """The drag of air at rest, across the cable.

        force per length = -rho d C |v_n| v_n / 2,   rho = 1.2 kg/m^3

    with the diameter d and the velocity v_n across the cable.

    Parameters
    ----------
    coefficient : scalar C, >= 0
        Vanishes at 0; 1.0 to 1.2 of a round cable from 1 mm at 1 m/s on.

    References
    ----------
    Morison-type drag on cables, e.g. Sarpkaya, Wave Forces on Offshore Structures, 2010.
    """

    name = "air_drag"
    declared = (Parameter("coefficient", scale=1.0, lower=0.0, upper=100.0),)

    def density(self, velocity: ca.SX, tangent: ca.SX, cable: CableData, params: Params) -> ca.SX:
        """Rho d C |v_n|^3 / 6."""
        across = velocity - ca.dot(velocity, tangent) * tangent
        cube = ca.sqrt(ca.sumsqr(across) + _SLOW**2) ** 3
        return AIR * cable.diameter * params["coefficient"] * cube / 6


class ViscousDrag(Damping):
    """A drag in proportion to the velocity: a thick medium, or many small losses as one.

        force per length = -c v

    Parameters
    ----------
    rate : scalar c [N s/m^2], >= 0
        Vanishes at 0.
    """

    name = "viscous_drag"

    def parameters(self, cable: CableData) -> tuple[Parameter, ...]:
        """Declare the rate; the scale halves a velocity in a second and a half."""
        scale = 0.5 * cable.mass / cable.length
        return (Parameter("rate", "N s/m^2", scale=scale, lower=0.0, upper=1e4 * scale),)

    def density(self, velocity: ca.SX, tangent: ca.SX, cable: CableData, params: Params) -> ca.SX:
        """C |v|^2 / 2."""
        return params["rate"] * ca.sumsqr(velocity) / 2


class PinFriction(Damping):
    """A moment that a pinned start or end opposes to its turning.

        moment = -M w / sqrt(w^2 + w_0^2),   w_0 = 0.05 rad/s

    for the rate w of the cable's turning at the pin: dry friction, rounded below w_0.

    Parameters
    ----------
    moment : scalar M [N m], >= 0
        Of each pinned end; vanishes at 0.
    """

    name = "pin_friction"

    @classmethod
    def impossible(cls, setup: Setup) -> str:
        """It needs a pin."""
        if setup.start.turns or setup.end.turns:
            return super().impossible(setup)
        return "it is friction of a pin, and no end is pinned. Try: experiment.boundary"

    def parameters(self, cable: CableData) -> tuple[Parameter, ...]:
        """Declare the moment; its scale turns a straight cable by a tenth of a radian."""
        scale = 0.1 * cable.bending_stiffness / cable.length
        return (Parameter("moment", "N m", scale=scale, lower=0.0, upper=1e4 * scale),)

    def at_pin(self, turning: ca.SX, params: Params) -> ca.SX:
        """M (sqrt(w^2 + w_0^2) - w_0)."""
        return params["moment"] * (ca.sqrt(ca.sumsqr(turning) + _ROUNDED**2) - _ROUNDED)


class TurningLoss(Damping):
    """Internal damping that opposes a turning of the plane in which the cable is bent.

        D = (1 - share) D_section + share EI tau / 2 int |d/dt (t x dt/ds)|^2 ds

    With the share 0 the rates of strain are those that the section sees; a cable that turns as a
    whole loses nothing. With 1 they are those of the curvature's vector in the world's axes: a loop
    that turns about its chord is braked. Simulators of point masses, which know no section, often
    damp in this way. The rest curvature is not asked.

    Parameters
    ----------
    share : scalar, 0 to 1
        Vanishes at 0.
    """

    name = "turning_loss"
    dimensions = (3,)
    shown = False
    declared = (Parameter("share", scale=0.3, lower=0.0, upper=1.0),)

    def of_turning(self, params: Params) -> ca.SX:
        """The share."""
        return params["share"]
