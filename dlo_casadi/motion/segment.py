"""The equations of motion of one segment: statics, inertia and dissipation as CasADi expressions.

Every node has a rotation x_i and a place r_i, every segment a force f_e:

    L = sum_e [ L_e(x_e, x_(e+1), f_e) - f_e . (r_(e+1) - r_e) ] + L_ends

with the segments of statics, where all f_e are the multiplier of the end's place. A cable at rest
fulfils the same equations, and f_e is the part of the force in the cable that inertia and the end
add to dead loads. With the kinetic energy T and Rayleigh's function D of the rates of strain and of
the velocities,

    d/dt dT/dv - dT/dq + dD/dv + dL/dq = 0,    dL/df = 0

Velocities of nodes are body rates w, see `MovingSegment`.

References
----------
Bruels, Cardona, Arnold, Mech. Mach. Theory 48 (2012).
"""

from __future__ import annotations

from dataclasses import replace
from functools import cached_property, lru_cache
from typing import Any, NamedTuple

import casadi as ca
import numpy as np

from dlo_casadi.effects import Damping, Load, SectionLaw
from dlo_casadi.model.cable_model import DAMPING_TIME, CableModel
from dlo_casadi.model.functions import functions_of
from dlo_casadi.model.lagrangian import MODELS, lagrangian_of
from dlo_casadi.model.stacked import Mapped
from dlo_casadi.motion.handles import MASSES, Handles, TurningNode, hermite
from dlo_casadi.rod.element import Segment
from dlo_casadi.rod.supports import SupportKind

# Mass matrix of the section's turning about the axis: frequencies of a rod are then exact to fourth
# order in the mesh, as its stiffness is exact between nodes.
TURNING = np.array([[5, 1], [1, 5]]) / 12
# Polar moment of area of a solid round section over its area and the square of its diameter.
POLAR = 1 / 8


class _Rows(NamedTuple):
    """Rows of both nodes' turns and places, and derivatives by these, by rates, accelerations."""

    value: ca.SX
    by_place: ca.SX
    by_rate: ca.SX
    by_acceleration: ca.SX


def held_model(model: CableModel) -> CableModel:
    """The model whose segments feel a force at their end, in motion also that of a free end."""
    end = SupportKind.PINNED if model.end is SupportKind.FREE else model.end
    return replace(model.unmeshed, end=end)


class MovingSegment:
    """Symbols and functions of one segment of a model in motion.

    Derivatives by turns are those of statics, of functions of increments of both nodes.

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
        last = start + 1.5 * length > self.model.cable.length
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
    def _inertia(self) -> _Rows:
        """d/dt dT/dv - dT/dq of the mass along the segment."""
        z, mass = self.handles, ca.kron(self.mass_matrix, ca.SX.eye(self.d))
        pulled = mass @ z.acceleration
        carried = z.by_place.T @ mass
        by_place = carried @ z.acceleration_by_place + self._turned(pulled)
        by_rate = carried @ z.acceleration_by_rate
        return _Rows(z.by_place.T @ pulled, by_place, by_rate, carried @ z.by_place)

    def _turned(self, force: ca.SX) -> ca.SX:
        """`Handles.turned_force` by all turns and places."""
        none = ca.SX(2 * self.d, 2 * self.d)
        return ca.diagcat(self.handles.turned_force(force), none)

    @cached_property
    def _spin(self) -> _Rows:
        """The same of the section's turning about its axis: J alpha + w x J w."""
        w, alpha, b = self.w, self.alpha, self.b
        momentum = self.turning_matrix @ w[::b]
        change, rows = self.turning_matrix @ alpha[::b], []
        for k in (0, 1):
            _, y, z = ca.vertsplit(w[b * k : b * (k + 1)])
            rows += [change[k], z * momentum[k], -y * momentum[k]]
        return self._differentiated(ca.vertcat(*rows, ca.SX.zeros(2 * self.d)))

    def _differentiated(self, rows: ca.SX) -> _Rows:
        """Rows that do not depend on places."""
        by_rate = ca.jacobian(rows, ca.vertcat(self.w, self.v))
        by_change = ca.jacobian(rows, ca.vertcat(self.alpha, self.a))
        return _Rows(rows, ca.SX(self.moving, self.moving), by_rate, by_change)

    # ---- dissipation ---------------------------------------------------------------------------

    @cached_property
    def _drag(self) -> _Rows:
        """dD/dv of the effects that damp along the cable, by quadrature."""
        z, size = self.handles, 4 * self.d
        force, by_z, by_rate = ca.SX.zeros(size), ca.SX(size, size), ca.SX(size, size)
        for u, weight in zip(*self.kind.rule, strict=True):
            place, slope = (ca.kron(hermite(u, k).T, ca.SX.eye(self.d)) for k in (0, 1))
            rows, by_velocity, by_slope = self._drag_density(
                place @ z.rate, slope @ z.z, self.p, self.deviation
            )
            weight = weight * self.length
            force += weight * place.T @ rows
            by_z += weight * place.T @ by_slope @ slope
            by_rate += weight * place.T @ by_velocity @ place
        turns = z.by_place.T
        by_place = turns @ (by_z @ z.by_place + by_rate @ z.rate_by_place) + self._turned(force)
        none = ca.SX(self.moving, self.moving)
        return _Rows(turns @ force, by_place, turns @ by_rate @ z.by_place, none)

    @cached_property
    def _drag_density(self) -> ca.Function:
        """(velocity, slope, p, deviation) -> dD/dv per length, derivatives by both."""
        velocity, slope = ca.SX.sym("velocity", self.d), ca.SX.sym("slope", self.d)
        tangent = slope / ca.sqrt(ca.sumsqr(slope))
        total = ca.SX(0)
        for effect, local in self.terms.effects_of(Damping):
            total += effect.density(velocity, tangent, self.model.cable, local)
        rows = ca.gradient(total, velocity)
        outputs = [rows, ca.jacobian(rows, velocity), ca.jacobian(rows, slope)]
        return ca.Function("drag", [velocity, slope, self.p, self.deviation], outputs)

    @cached_property
    def _viscous(self) -> _Rows | None:
        """dD/dv of Kelvin-Voigt damping: tau times stiffness times rates of strain.

        Strains change linearly inside the segment, k = mean -+ linear at its two Gauss points. The
        mean rate is that of the nodes' turning, seen from both nodes; the linear variation of the
        bend is that of the Hermite polynomial, from the chord in the axes of both nodes:
        k' = -6 (R_0^T + R_1^T) (r_1 - r_0) / h^3 across the tangent.
        """
        if DAMPING_TIME not in self.model.names:
            return None
        b, d = self.b, self.d
        turn, chord = ca.SX.sym("turn", 2 * b), ca.SX.sym("chord", d)
        axes = [ca.SX.sym("axes", d, d) for _ in (0, 1)]
        size = sum(self.section_sizes)
        modulus = ca.SX.sym("modulus", size, size)
        turns = ca.vertsplit(turn, b)
        moved = [
            own @ (ca.SX.eye(d) + self._skew(one)) for own, one in zip(axes, turns, strict=True)
        ]
        rates = self._strain_rates(moved, chord)
        velocities = ca.vertcat(self.w, self.v)
        rows = rates.T @ (modulus @ (rates @ velocities))
        by = [ca.jacobian(rows, x) for x in (turn, chord)]
        by_place = ca.horzcat(by[0], -by[1], by[1])
        outputs = [rows, by_place, rates.T @ modulus @ rates]
        outputs = ca.substitute(outputs, [turn], [ca.SX.zeros(2 * b)])
        symbols = [*axes, chord, modulus, self.w, self.v]
        found = ca.Function("viscous", [*symbols, self.p, self.place], outputs)
        chord = self.r[d:] - self.r[:d]
        frames = [node.axes for node in self.nodes]
        given = [*frames, chord, self._viscosity, self.w, self.v, self.p, self.place]
        value, by_place, by_rate = found(*given)
        return _Rows(value, by_place, by_rate, ca.SX(self.moving, self.moving))

    def _skew(self, turn: ca.SX) -> ca.SX:
        """Matrix (dimension, dimension) of a small turn."""
        units = (ca.SX(ca.DM.eye(self.d)[:, k]) for k in range(self.d))
        return ca.horzcat(*(self.node.cross(turn, unit) for unit in units))

    @property
    def section_sizes(self) -> tuple[int, int]:
        """Number of mean rates of strain, and of linear variations."""
        return len(self.node.strains), len(self.node.curvatures)

    def _strain_rates(self, axes: list[ca.SX], chord: ca.SX) -> ca.SX:
        """Rates of mean strains and of the linear part of bends, by velocities."""
        b, d, h = self.b, self.d, self.length
        unit, across = ca.SX.eye(b), ca.DM([[0.0, 1.0]])
        seen = axes[0].T @ axes[1] if self.node.twists else unit
        if self.node.twists:
            across = ca.DM([[0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
        mean = ca.horzcat(-(unit + seen.T), unit + seen, ca.SX(b, 2 * d)) / (2 * h)
        turned, moved = [], ca.SX(d, d)
        for own in axes:
            seen_chord = own.T @ chord
            units = (ca.SX(ca.DM.eye(b)[:, k]) for k in range(b))
            turned.append(-ca.horzcat(*(self.node.cross(one, seen_chord) for one in units)))
            moved += own.T
        linear = across @ ca.horzcat(*turned, -moved, moved) * (-np.sqrt(3) / h**2)
        return ca.vertcat(mean, linear)

    @cached_property
    def _viscosity(self) -> ca.SX:
        """Stiffness against mean strains and linear bends, times damping time and length."""
        section, segment, count = self.terms.section, self._plain, len(self.node.curvatures)
        bend = (self.kind.strain(segment) - segment.rest[::3])[-count:]
        first, second = (section.along(half) for half in segment.cell.halves)
        bent = section.tangent(ca.sumsqr(bend)) * section.bending
        mean, half_gap = (first + second) / 2, (second - first) / 2
        twists = ca.SX.eye(self.b - count) * section.torsion
        tau = self.p[self.model.names.index(DAMPING_TIME)]
        whole = ca.diagcat(twists, bent, bent) * mean
        coupled = half_gap * bent
        first_bend, first_linear = self.b - count, self.b
        whole[first_bend : self.b, first_linear:] = coupled
        whole[first_linear:, first_bend : self.b] = coupled
        return tau * self.length * whole / self._dynamic

    @property
    def _plain(self) -> Segment:
        """The segment without its inner unknowns."""
        inner, parts = ca.SX.zeros(self.terms.inner.shape), self.x.numel() // 2
        local = self.kind.local(*ca.vertsplit(self.x, parts))
        return self.terms.segment(self.terms.stretch, inner, ca.SX(0), local)

    @cached_property
    def _dynamic(self) -> ca.SX:
        """Stiffness against changes from the shape at rest over that of still shapes."""
        factor = ca.SX(1)
        for effect, local in self.terms.effects_of(SectionLaw):
            factor *= effect.dynamic(local)
        return factor

    # ---- statics -------------------------------------------------------------------------------

    @cached_property
    def _statics(self) -> tuple[ca.SX, ca.SX, ca.SX]:
        """Lagrangian of the segment, gradient and Hessian by turns, places and forces."""
        b, d, held, first = self.b, self.d, self._held, self.moving
        size, parts = first + self.force.numel(), ca.vertsplit(self.force, d)
        lam, spread = ca.SX.zeros(held.n_lam), ca.SX(2 * b + held.n_lam, size)
        spread[: 2 * b, : 2 * b] = ca.SX.eye(2 * b)
        pulled = [(held.end_pull, 0, ca.SX(1))]
        pulled += [(rows, 2 + 2 * k, self.on[k]) for k, rows in enumerate(held.pulls)]
        for rows, part, share in pulled:
            lam[rows] = parts[part] * share
            at = first + d * part
            spread[[2 * b + row for row in rows], at : at + d] = ca.SX.eye(d) * share
        value, gradient, hessian = self.functions.compact("segment")(
            self.x, lam, self.p, self.rest, self.place, self.deviation
        )
        joined, unknowns = self._joined, ca.vertcat(self.r, self.force)
        by, own = ca.hessian(joined, unknowns)
        gradient, hessian = spread.T @ gradient, spread.T @ hessian @ spread
        gradient[2 * b :] += own
        hessian[2 * b :, 2 * b :] += by
        return value + joined, gradient, hessian

    @cached_property
    def _joined(self) -> ca.SX:
        """Lagrangian that joins places: -f . (r_1 - r_0), and springs."""
        first, last = ca.vertsplit(self.r, self.d)
        parts = ca.vertsplit(self.force, self.d)
        total = -ca.dot(parts[0], last - first)
        for k, spring in enumerate(self.terms.springs):
            place, pull = parts[1 + 2 * k], parts[2 + 2 * k]
            total += self.on[k] * (spring.energy(place) + ca.dot(pull, first - place))
        return total

    # ---- functions -----------------------------------------------------------------------------

    @property
    def arguments(self) -> list[ca.SX]:
        """Arguments of the functions below: state, rates, accelerations, then numbers."""
        own = [self.x, self.r, self.w, self.v, self.alpha, self.a, self.force]
        return [*own, self.p, self.rest, self.place, self.deviation, self.on, self.still]

    def _stiffened(self, expressions: list[ca.SX]) -> list[ca.SX]:
        """Expressions with the stiffness against changes from the shape at rest.

        M_rest + F B (k - k_rest) = F B (k - k_rest + (k_rest - k_0) / F) for the factor F.
        """
        factor = self._dynamic
        if factor.is_constant():
            return expressions
        count, rest, p = len(self.node.strains), ca.SX(self.rest), ca.SX(self.p)
        mean, linear = self.still[:count], self.still[count:]
        rest[::3] = mean + (rest[::3] - mean) / factor
        rest[1::3] = linear + (rest[1::3] - linear) / factor
        rest[2::3] = rest[2::3] / factor
        p[self.model.stiffness_indices] *= factor
        return ca.substitute(expressions, [self.rest, self.p], [rest, p])

    @cached_property
    def _dissipating(self) -> list[_Rows]:
        """Parts of the residual that take energy."""
        drag = [self._drag] if self.terms.effects_of(Damping) else []
        return drag if self._viscous is None else [*drag, self._viscous]

    @cached_property
    def _moving_rows(self) -> list[_Rows]:
        """All parts of the residual beside statics."""
        inertia = [self._inertia, self._spin] if self.node.twists else [self._inertia]
        return [*inertia, *self._dissipating]

    @cached_property
    def stretch(self) -> ca.Function:
        """(p) -> true length without load over the declared one."""
        return ca.Function("stretch", [self.p], [self.terms.stretch])

    @cached_property
    def curve(self) -> ca.Function:
        """(x, r, p, place) -> z (4 dimension,), derivative by both nodes' turns and places."""
        outputs = [ca.densify(x) for x in (self.handles.z, self.handles.by_place)]
        return ca.Function("curve", [self.x, self.r, self.p, self.place], outputs)

    @cached_property
    def motion(self) -> ca.Function:
        """(arguments, c (2,)) -> residual, K, and c_1 C + c_2 M, by turns, places and forces.

        K, C and M are its derivatives by positions, velocities and accelerations.
        """
        c, parts = ca.SX.sym("c", 2), self._moving_rows
        _, residual, stiffness = map(ca.SX, self._statics)
        damping, size = ca.SX(*stiffness.shape), self.moving
        rows = sum((part.value for part in parts), start=ca.SX.zeros(size))
        residual[:size] += rows
        stiffness[:size, :size] += sum(part.by_place for part in parts)
        if self.node.twists:  # from derivatives by turns about own axes to those by increments
            for k in (0, self.b):
                own = slice(k, k + self.b)
                stiffness[own, own] -= ca.skew(rows[own]) / 2
        for part in parts:
            damping[:size, :size] += c[0] * part.by_rate + c[1] * part.by_acceleration
        outputs = self._stiffened([residual, stiffness, damping])
        return ca.Function("motion", [*self.arguments, c], [ca.densify(x) for x in outputs])

    @cached_property
    def quantities(self) -> ca.Function:
        """(arguments) -> L_e [J], T [J], dissipated power [W], rows of both places [N]."""
        rates, size = ca.vertcat(self.w, self.v), 2 * self.b
        parts = self._moving_rows
        power = sum((ca.dot(x.value, rates) for x in self._dissipating), start=ca.SX(0))
        value, gradient, _ = self._statics
        rows = sum((part.value for part in parts), start=ca.SX.zeros(self.moving))
        held = rows[size:] + gradient[size : self.moving]
        outputs = self._stiffened([value, self.kinetic_energy, power, held])
        return ca.Function("quantities", self.arguments, [ca.densify(x) for x in outputs])

    @cached_property
    def _mapped(self) -> dict[str, Mapped]:
        return {}

    def mapped(self, name: str) -> Mapped:
        """The function of that name over many segments."""
        if name not in self._mapped:
            self._mapped[name] = Mapped(getattr(self, name))
        return self._mapped[name]


def moving_segment(model: CableModel) -> MovingSegment:
    """The functions of a model, made once for all its meshes."""
    return _moving_segment(model.unmeshed)


_moving_segment = lru_cache(maxsize=MODELS)(MovingSegment)
