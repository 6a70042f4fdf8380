"""Symbols of one segment in motion, and its kinetic energy."""

from __future__ import annotations

from dataclasses import replace
from functools import cached_property
from typing import Any, NamedTuple

import casadi as ca
import numpy as np

from dlo_casadi.effects import Load
from dlo_casadi.model.cable_model import CableModel
from dlo_casadi.model.functions import functions_of
from dlo_casadi.model.lagrangian import lagrangian_of
from dlo_casadi.motion.handles import MASSES, Handles, TurningNode, hermite
from dlo_casadi.rod.supports import SupportKind

# Mass matrix of the section's turning about the axis: frequencies of a rod are then exact to fourth
# order in the mesh, as its stiffness is exact between nodes.
TURNING = np.array([[5, 1], [1, 5]]) / 12
# Polar moment of area of a solid round section over its area and the square of its diameter.
POLAR = 1 / 8


class Rows(NamedTuple):
    """Rows of both nodes' turns and places, and derivatives by these, by rates, accelerations."""

    value: ca.SX
    by_place: ca.SX
    by_rate: ca.SX
    by_acceleration: ca.SX


def held_model(model: CableModel) -> CableModel:
    """The model whose segments feel a force at their end, in motion also that of a free end."""
    end = SupportKind.PINNED if model.end is SupportKind.FREE else model.end
    return replace(model.unmeshed, end=end)


class InertSegment:
    """Symbols of one segment of a model in motion, and its inertia.

    Attributes
    ----------
    x : (2 coordinates,)
        Both nodes.
    r, v, a : (2 dimension,) [m, m/s, m/s^2]
        Places of both nodes, velocities, accelerations.
    w, alpha : (2 increment,) [rad/s, rad/s^2]
        Body rates of both nodes, and their derivatives: x(t + dt) = moved(x, w dt + alpha dt^2/2).
    force : (dimension (1 + 2 n_springs),)
        f_e [N], then the place [m] and the pull [N] of each spring, if it is on this segment.
    on : (n_springs,)
        1 if the spring is on this segment, else 0.
    still : (2 strains,) [1/m]
        Mean strains of the shape at rest and their linear variation, for a stiffness against
        changes from it.
    """

    def __init__(self, model: CableModel) -> None:
        self.model = model
        self._held = held_model(model)
        self.functions, self.terms = functions_of(self._held), lagrangian_of(self._held)
        self.node, self.kind = model.node, model.chain.kind
        b, c, d = self.node.increment, self.node.coordinates, self.node.dimension
        self.b, self.d, self.moving = b, d, 2 * b + 2 * d
        self.x, self.w, self.alpha = ca.SX.sym("x", 2 * c), *self._both("w", "alpha", b)
        self.r, self.v, self.a = self._both("r", "v", "a", d)
        self.force = ca.SX.sym("force", d * (1 + 2 * model.n_springs))
        self.on = ca.SX.sym("on", model.n_springs)
        self.still = ca.SX.sym("still", 2 * len(self.node.strains))
        self.p, self.place = self.terms.p, self.terms.place
        self.rest, self.deviation = self.terms.rest_strains, self.terms.deviation
        self.length = self.terms.length * self.terms.stretch  # without tension [m]
        parts = (ca.vertsplit(x, x.numel() // 2) for x in (self.x, self.w, self.alpha))
        self.nodes = [TurningNode(self.node, *own) for own in zip(*parts, strict=True)]
        self.handles = Handles(self.nodes, self.length, self.r, self.v, self.a)

    @staticmethod
    def _both(*names_and_size: Any) -> list[ca.SX]:
        *names, size = names_and_size
        return [ca.SX.sym(name, 2 * size) for name in names]

    # ---- inertia -------------------------------------------------------------------------------

    @cached_property
    def mass_per_length(self) -> ca.SX:
        """Mass per declared length in the middle of the segment [kg/m]."""
        cable, middle = self.model.cable, self.place[0] + self.terms.length / 2
        total = ca.SX(cable.mass / cable.length)
        for effect, local in self.terms.effects_of(Load):
            total += effect.mass_per_length(middle, cable, local)
        return total

    @cached_property
    def masses(self) -> list[tuple[ca.SX, ca.SX]]:
        """Compact masses on this segment [kg], zero if they are elsewhere, and their shares."""
        found, start, length = [], self.place[0], self.terms.length
        last = start + (1 + 1e-6) * length > self.model.cable.length
        for effect, local in self.terms.effects_of(Load):
            for one in effect.masses(local):
                u = (one.position - start) / length
                here = ca.logic_and(u >= 0, ca.logic_or(u < 1, last))
                found.append((ca.if_else(here, one.mass, 0), ca.if_else(here, u, 0.5)))
        return found

    @cached_property
    def mass_matrix(self) -> ca.SX:
        """Of the handles (4, 4) [kg]."""
        total = self.mass_per_length * self.terms.length * ca.SX(ca.DM(MASSES))
        for mass, u in self.masses:
            total += mass * ca.mtimes(hermite(u), hermite(u).T)
        return total

    @cached_property
    def turning_matrix(self) -> ca.SX:
        """Moments of inertia (2, 2) [kg m^2] of the turning about the axis, at both nodes."""
        polar = POLAR * self.model.cable.diameter**2
        return self.mass_per_length * self.terms.length * polar * ca.SX(ca.DM(TURNING))

    @cached_property
    def kinetic_energy(self) -> ca.SX:
        """T [J]."""
        rates = ca.reshape(self.handles.rate, self.d, 4)
        total = ca.sum1(ca.sum2((rates @ self.mass_matrix) * rates)) / 2
        if self.node.twists:
            spin = self.w[:: self.b]
            total += ca.dot(spin, self.turning_matrix @ spin) / 2
        return total

    @cached_property
    def _inertia(self) -> Rows:
        """d/dt dT/dv - dT/dq of the mass along the segment."""
        z, mass = self.handles, ca.kron(self.mass_matrix, ca.SX.eye(self.d))
        pulled = mass @ z.acceleration
        carried = z.by_place.T @ mass
        by_place = carried @ z.acceleration_by_place + self._turned(pulled)
        by_rate = carried @ z.acceleration_by_rate
        return Rows(z.by_place.T @ pulled, by_place, by_rate, carried @ z.by_place)

    def _turned(self, force: ca.SX) -> ca.SX:
        """`Handles.turned_force` by all turns and places."""
        none = ca.SX(2 * self.d, 2 * self.d)
        return ca.diagcat(self.handles.turned_force(force), none)

    @cached_property
    def _spin(self) -> Rows:
        """The same of the section's turning about its axis: J alpha + w x J w."""
        w, alpha, b = self.w, self.alpha, self.b
        momentum = self.turning_matrix @ w[::b]
        change, rows = self.turning_matrix @ alpha[::b], []
        for k in (0, 1):
            _, y, z = ca.vertsplit(w[b * k : b * (k + 1)])
            rows += [change[k], z * momentum[k], -y * momentum[k]]
        return self._differentiated(ca.vertcat(*rows, ca.SX.zeros(2 * self.d)))

    def _differentiated(self, rows: ca.SX) -> Rows:
        """Rows that do not depend on places."""
        by_rate = ca.jacobian(rows, ca.vertcat(self.w, self.v))
        by_change = ca.jacobian(rows, ca.vertcat(self.alpha, self.a))
        return Rows(rows, ca.SX(self.moving, self.moving), by_rate, by_change)
