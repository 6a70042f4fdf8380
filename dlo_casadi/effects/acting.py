"""What a load puts on single places of a cable: forces, springs, masses."""

from dataclasses import dataclass

import casadi as ca


@dataclass(frozen=True)
class PointForceAt:
    """A dead force (dimension,) [N] on the cable at the arc length `position` [m]."""

    force: ca.SX
    position: ca.SX


@dataclass(frozen=True)
class SpringAt:
    """A spring on the cable at the arc length `position` [m]; its place is y (dimension,) [m].

        V(y) = stiffness |y|^2 / 2 - force . y + constant               [J]

    with the stiffness k [N/m] and the force (dimension,) [N] at y = 0, which is k times the anchor.
    """

    stiffness: ca.SX
    force: ca.SX
    constant: ca.SX
    position: ca.SX

    def energy(self, place: ca.SX) -> ca.SX:
        """Energy [J] at a place."""
        return self.stiffness * ca.sumsqr(place) / 2 - ca.dot(self.force, place) + self.constant

    def on_cable(self, place: ca.SX) -> ca.SX:
        """Force (dimension,) [N] on the cable at a place: minus the gradient of the energy."""
        return self.force - self.stiffness * place


@dataclass(frozen=True)
class MassAt:
    """A compact mass [kg] on the cable at the arc length `position` [m]."""

    mass: ca.SX
    position: ca.SX
