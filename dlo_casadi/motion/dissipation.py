"""What one segment dissipates: internal damping, and effects that damp along the cable."""

from __future__ import annotations

from functools import cached_property

import casadi as ca
import numpy as np

from dlo_casadi.effects import Damping, SectionLaw
from dlo_casadi.model.cable_model import DAMPING_TIME
from dlo_casadi.motion.handles import hermite
from dlo_casadi.motion.inertia import InertSegment, Rows
from dlo_casadi.rod.element import Segment


class DampedSegment(InertSegment):
    """An `InertSegment` with Rayleigh's dissipation function; forces are its derivatives."""

    @cached_property
    def _drag(self) -> Rows:
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
        return Rows(turns @ force, by_place, turns @ by_rate @ z.by_place, none)

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
    def _viscous(self) -> Rows | None:
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
        return Rows(value, by_place, by_rate, ca.SX(self.moving, self.moving))

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
        whole = ca.diagcat(twists, bent * (1 - self._in_world), bent * (1 - self._in_world)) * mean
        coupled = half_gap * bent * (1 - self._in_world)
        first_bend, first_linear = self.b - count, self.b
        whole[first_bend : self.b, first_linear:] = coupled
        whole[first_linear:, first_bend : self.b] = coupled
        return self._damping_time * self.length * whole / self._dynamic

    @property
    def _damping_time(self) -> ca.SX:
        return self.p[self.model.names.index(DAMPING_TIME)]

    @cached_property
    def _in_world(self) -> ca.SX:
        """Share of the internal damping in the world's axes."""
        total = ca.SX(0)
        for effect, local in self.terms.effects_of(Damping):
            total += effect.of_turning(local)
        return total

    @cached_property
    def _viscous_in_world(self) -> Rows:
        """That share: of the rate of the curvature's vector t x dt/ds at two Gauss points."""
        d, h, section = self.d, self.length, self.terms.section
        z, rate = ca.SX.sym("z", 4 * d), ca.SX.sym("rate", 4 * d)
        first, slope, last, last_slope = ca.vertsplit(z, d)
        mean = 2 * ca.cross(slope, last_slope) / (h**2 + ca.dot(slope, last_slope)) / h
        bow = (slope + last_slope) / 2 - (last - first)
        linear = ca.cross(slope + last_slope, bow) * (np.sqrt(3) / h**3)
        stiffness = ca.trace(section.bending) / 2 * section.along(self._plain.cell)
        modulus = self._in_world * self._damping_time * stiffness * h / 2 / self._dynamic
        rows = ca.SX.zeros(4 * d)
        for vector in (mean - linear, mean + linear):
            by_z = ca.jacobian(vector, z)
            rows += modulus * by_z.T @ (by_z @ rate)
        outputs = [rows, ca.jacobian(rows, z), ca.jacobian(rows, rate)]
        found = ca.Function("in_world", [z, rate, self.p, self.place, self.deviation], outputs)
        known = self.handles
        force, by_z, by_rate = found(known.z, known.rate, self.p, self.place, self.deviation)
        turns = known.by_place.T
        by_place = by_z @ known.by_place + by_rate @ known.rate_by_place
        by_place = turns @ by_place + self._turned(force)
        none = ca.SX(self.moving, self.moving)
        return Rows(turns @ force, by_place, turns @ by_rate @ known.by_place, none)

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
