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

from functools import cached_property, lru_cache

import casadi as ca

from dlo_casadi.effects import Damping
from dlo_casadi.errors import DloError
from dlo_casadi.model.cable_model import CableModel
from dlo_casadi.model.lagrangian import MODELS
from dlo_casadi.model.stacked import Mapped
from dlo_casadi.motion.dissipation import DampedSegment
from dlo_casadi.motion.inertia import Rows
from dlo_casadi.rod.ends import EndConditions


class MovingSegment(DampedSegment):
    """Functions of one segment of a model in motion.

    Derivatives by turns are those of statics, of functions of increments of both nodes.
    """

    @cached_property
    def _pulled(self) -> tuple[ca.SX, ca.SX]:
        """Border of statics, and matrix from turns and border to turns, places and forces."""
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
        return lam, spread

    @cached_property
    def _statics(self) -> tuple[ca.SX, ca.SX, ca.SX]:
        """Lagrangian of the segment, gradient and Hessian by turns, places and forces."""
        b, (lam, spread) = self.b, self._pulled
        value, gradient, hessian = self.functions.compact("segment")(
            self.x, lam, self.p, self.rest, self.place, self.deviation
        )
        by, own = ca.hessian(self._joined, ca.vertcat(self.r, self.force))
        gradient, hessian = spread.T @ gradient, spread.T @ hessian @ spread
        gradient[2 * b :] += own
        hessian[2 * b :, 2 * b :] += by
        return value + self._joined, gradient, hessian

    @cached_property
    def _static_rows(self) -> ca.SX:
        """The gradient alone, in fewer operations."""
        b, (lam, spread) = self.b, self._pulled
        gradient = spread.T @ self.functions.compact("segment_slope")(
            self.x, lam, self.p, self.rest, self.place, self.deviation
        )
        gradient[2 * b :] += ca.gradient(self._joined, ca.vertcat(self.r, self.force))
        return gradient

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

    @property
    def stiffens(self) -> bool:
        """Whether the stiffness acts on changes from a shape at rest."""
        return not self._dynamic.is_constant()

    def stiffened(self, expressions: list[ca.SX]) -> list[ca.SX]:
        """Expressions with the stiffness against changes from the shape at rest.

        M_rest + F B (k - k_rest) = F B (k - k_rest + (k_rest - k_0) / F) for the factor F.
        """
        factor = self._dynamic
        if not self.stiffens:
            return expressions
        count, rest, p = len(self.node.strains), ca.SX(self.rest), ca.SX(self.p)
        mean, linear = self.still[:count], self.still[count:]
        rest[::3] = mean + (rest[::3] - mean) / factor
        rest[1::3] = linear + (rest[1::3] - linear) / factor
        rest[2::3] = rest[2::3] / factor
        p[self.model.stiffness_indices] *= factor
        return ca.substitute(expressions, [self.rest, self.p], [rest, p])

    @cached_property
    def _dissipating(self) -> list[Rows]:
        """Parts of the residual that take energy."""
        found = [self._drag] if self.terms.effects_of(Damping) else []
        if self._viscous is not None:
            found.append(self._viscous)
            if not self._in_world.is_zero():
                found.append(self._viscous_in_world)
        return found

    @cached_property
    def _moving_rows(self) -> list[Rows]:
        """All parts of the residual beside statics."""
        inertia = [self._inertia, self._spin] if self.node.twists else [self._inertia]
        return [*inertia, *self._dissipating]

    @cached_property
    def stretch(self) -> ca.Function:
        """(p) -> true length without load over the declared one."""
        return ca.Function("stretch", [self.p], [self.terms.stretch])

    @cached_property
    def true_places(self) -> ca.Function:
        """(p, ends) -> true places (2 dimension,) of the fixtures at declared ends."""
        p, ends = self.p, ca.SX.sym("ends", EndConditions.size(self.node))
        still = ca.SX.zeros(self.deviation.numel())
        true, _ = self.terms.true_ends_and_length.call([p, ends, still])
        return ca.Function("true_places", [p, ends], [ca.densify(true[: 2 * self.d])])

    @cached_property
    def curve(self) -> ca.Function:
        """(x, r, p, place) -> z (4 dimension,), derivatives by both nodes' turns, places; by p."""
        z = self.handles
        outputs = [ca.densify(x) for x in (z.z, z.by_place, ca.jacobian(z.z, self.p))]
        return ca.Function("curve", [self.x, self.r, self.p, self.place], outputs)

    @cached_property
    def matrices(self) -> tuple[ca.SX, ca.SX, ca.SX, ca.SX]:
        """Residual, K, C and M by turns, places and forces.

        K, C and M are its derivatives by positions, velocities and accelerations.
        """
        parts, size = self._moving_rows, self.moving
        _, residual, stiffness = map(ca.SX, self._statics)
        damping, mass = ca.SX(*stiffness.shape), ca.SX(*stiffness.shape)
        rows = sum((part.value for part in parts), start=ca.SX.zeros(size))
        residual[:size] += rows
        stiffness[:size, :size] += sum(part.by_place for part in parts)
        if self.node.twists:  # from derivatives by turns about own axes to those by increments
            for k in (0, self.b):
                own = slice(k, k + self.b)
                stiffness[own, own] -= ca.skew(rows[own]) / 2
        for part in parts:
            damping[:size, :size] += part.by_rate
            mass[:size, :size] += part.by_acceleration
        return residual, stiffness, damping, mass

    @cached_property
    def rows(self) -> ca.SX:
        """The residual alone, in fewer operations."""
        rows = ca.SX(self._static_rows)
        rows[: self.moving] += sum(part.value for part in self._moving_rows)
        return rows

    @cached_property
    def motion(self) -> ca.Function:
        """(arguments, c (2,)) -> residual, K, and c_1 C + c_2 M, see `matrices`."""
        c = ca.SX.sym("c", 2)
        residual, stiffness, damping, mass = self.matrices
        outputs = self.stiffened([residual, stiffness, c[0] * damping + c[1] * mass])
        return ca.Function("motion", [*self.arguments, c], [ca.densify(x) for x in outputs])

    @cached_property
    def linear(self) -> ca.Function:
        """(arguments) -> K, C, M, and derivatives of the residual by p and by rest strains."""
        residual, *matrices = self.stiffened(list(self.matrices))
        by = [ca.jacobian(residual, x) for x in (self.p, self.rest)]
        return ca.Function("linear", self.arguments, [ca.densify(x) for x in (*matrices, *by)])

    @cached_property
    def residual(self) -> ca.Function:
        """(arguments) -> residual, as of `motion`."""
        outputs = self.stiffened([self.rows])
        return ca.Function("residual", self.arguments, [ca.densify(x) for x in outputs])

    @cached_property
    def quantities(self) -> ca.Function:
        """(arguments) -> L_e [J], T [J], dissipated power [W], rows of both places [N]."""
        rates, size = ca.vertcat(self.w, self.v), 2 * self.b
        parts = self._moving_rows
        power = sum((ca.dot(x.value, rates) for x in self._dissipating), start=ca.SX(0))
        value, gradient, _ = self._statics
        rows = sum((part.value for part in parts), start=ca.SX.zeros(self.moving))
        held = rows[size:] + gradient[size : self.moving]
        outputs = self.stiffened([value, self.kinetic_energy, power, held])
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


def refuse_still(model: CableModel) -> None:
    """Raise an error where a model cannot move yet."""
    what = ""
    if model.surfaces:
        what = "obstacles: contact in motion is not known"
    elif model.slides:
        what = "an end that slides: a cable in motion is not fed"
    elif not model.chain.kind.smooth:
        what = f"elements of the kind {model.element!r}: try 'quadratic'"
    elif model.clips:
        what = (
            "clips: recorded motions, `motion_equations` and generated C know none; "
            "simulate(..., clips=...), shape.modes() and step(dt, about=shape) do"
        )
    if what:
        raise DloError(f"{model.cable.name!r} has {what}")
