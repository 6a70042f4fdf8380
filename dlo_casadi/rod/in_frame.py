"""Derivatives of a segment between two frames, in stages, which takes fewer operations.

The Lagrangian of a segment does not change if the segment and the forces on it are rotated
together. It is therefore a function of the rotation vector phi from node to node and of the forces
c = R^T F in the frame R in its middle. CasADi differentiates this function by phi, c and the
internal unknowns. The internal unknowns are eliminated, and the chain rule to the nodes is in
closed form. With increments alpha, beta of both nodes about the axes of R,

    sigma = (alpha + beta) / 2,   epsilon = beta - alpha,
    R -> R exp(mu),               phi -> phi + psi,
    mu  = sigma - z x epsilon / 2 + O(2),    psi = K epsilon + O(2),

z = tan(|phi| / 4) n, K = kappa (1 - n n^T) + n n^T, kappa = (|phi| / 2) / sin(|phi| / 2), n along
phi.

References
----------
Second-order terms: composition of unit quaternions to second order, e.g. Murray, Li and Sastry, A
Mathematical Introduction to Robotic Manipulation, 1994.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import casadi as ca

from dlo_casadi.arrays import FloatArray
from dlo_casadi.rod.element import Element
from dlo_casadi.rod.elements import inverse_of
from dlo_casadi.rod.quaternions import conjugate, quaternion_product, traced

# (rotation vector phi (3,), internal unknowns, forces (3, m) [N]) -> energy of a segment [J].
Energy = Callable[[ca.SX, ca.SX, ca.SX], ca.SX]

# Keeps 0 / 0 of two squared angles finite if an element is straight.
_TINY = 1e-30


@dataclass(frozen=True)
class SegmentDerivatives:
    """A segment's Lagrangian and its derivatives by rotations of its nodes and by multipliers.

    Rotations are about the axes of the middle frame, or about those passed to `about`.
    Multipliers are q vectors (3,) in world axes, one after the other.

    Parameters
    ----------
    value : scalar [J]
    turn : (3, 3)
        From the axes of the middle frame to the world's.
    phi : (3,) [rad]
    slopes : tuple of (3,)
        First derivatives by the first node and by the last.
    by_lam : (3 q,)
    bends : tuple of (3, 3)
        Second derivatives: first-first, first-last, last-last.
    mixed : tuple of (3, 3 q)
        Second derivatives: first-lam, last-lam.
    lam_lam : (3 q, 3 q)
    """

    value: ca.SX
    turn: ca.SX
    phi: ca.SX
    slopes: tuple[ca.SX, ca.SX]
    by_lam: ca.SX
    bends: tuple[ca.SX, ca.SX, ca.SX]
    mixed: tuple[ca.SX, ca.SX]
    lam_lam: ca.SX

    def about(self, first: ca.SX, last: ca.SX) -> "SegmentDerivatives":
        """The same for rotations about other axes, given by matrices (3, 3) from these to those."""
        (g, h), (aa, ab, bb), (al, bl) = self.slopes, self.bends, self.mixed
        return replace(
            self,
            slopes=(first @ g, last @ h),
            bends=(first @ aa @ first.T, first @ ab @ last.T, last @ bb @ last.T),
            mixed=(first @ al, last @ bl),
        )

    @property
    def gradient(self) -> ca.SX:
        """By both nodes and the multipliers (6 + 3 q,)."""
        return ca.vertcat(*self.slopes, self.by_lam)

    @property
    def hessian(self) -> ca.SX:
        """By both nodes and the multipliers (6 + 3 q, 6 + 3 q)."""
        (aa, ab, bb), (al, bl) = self.bends, self.mixed
        return ca.vertcat(
            ca.horzcat(aa, ab, al), ca.horzcat(ab.T, bb, bl), ca.horzcat(al.T, bl.T, self.lam_lam)
        )


class SegmentInFrame:
    """A segment, written in the frame in its middle.

    Parameters
    ----------
    kind : Element
        A helix.
    energy : callable
        Its minimum over the internal unknowns is the segment's Lagrangian.
    x : (8,)
        Frames of both nodes.
    forces : (3, m) [N]
        Forces on the segment, in world axes.
    weights : (m, q)
        Derivatives of the forces by q multipliers (3,).
    held : (symbols, callable)
        Symbols in the energy that are held while it is differentiated; phi -> their values.
    """

    def __init__(
        self,
        kind: Element,
        energy: Energy,
        x: ca.SX,
        forces: ca.SX,
        weights: FloatArray,
        held: tuple[ca.SX, Callable[[ca.SX], ca.SX]],
    ) -> None:
        self._forces, self._moved = forces, _Kinematics(kind, x)
        self.node_turns = self._moved.node_turns
        self._body = self._moved.turn.T @ forces
        self._to_lam = ca.kron(ca.DM(weights), ca.DM.eye(3))
        self._to_world = ca.kron(ca.DM.eye(weights.shape[1]), self._moved.turn)
        phi, inner = ca.SX.sym("phi", 3), ca.SX.sym("inner", kind.n_inner)
        c = ca.SX.sym("force", *forces.shape)
        self._symbols = [phi, inner, c, held[0]]
        values = held[1](self._moved.phi)
        self._value = energy(phi, inner, c)
        self._by_frame = ca.gradient(self._value, ca.vertcat(phi, ca.vec(c)))
        self._by_inner = ca.gradient(self._value, inner)
        resisting = ca.jacobian(self._by_inner, inner)
        start = [self._moved.phi, ca.SX.zeros(inner.shape), self._body, values]
        torque, resisting = ca.substitute([self._by_inner, resisting], self._symbols, start)
        # The energy is quadratic in the internal unknowns: one Newton step gives the minimum.
        self._inverse = inverse_of(resisting) if inner.numel() else ca.SX(0, 0)
        self._there = [self._moved.phi, -self._inverse @ torque, self._body, values]

    def _at(self, expressions: list[ca.SX]) -> list[ca.SX]:
        """Insert the segment's rotation vector and forces, and the optimal internal unknowns."""
        return list(ca.substitute(expressions, self._symbols, self._there))

    def derivatives(self) -> SegmentDerivatives:
        """Value, gradient and Hessian, by rotations about the axes of the middle frame."""
        phi, inner, c, _ = self._symbols
        both = ca.vertcat(phi, inner)
        flat = ca.vec(c)
        slope, by_force = self._by_frame[:3], self._by_frame[3:]
        bend = ca.jacobian(ca.vertcat(slope, self._by_inner), both)
        mixed, twice = ca.jacobian(by_force, both), ca.jacobian(by_force, flat)
        value, slope, by_force, bend, mixed, twice = self._at(
            [self._value, slope, by_force, bend, mixed, twice]
        )
        body, to_lam, to_world = self._body, self._to_lam, self._to_world
        by_force = ca.reshape(by_force, body.shape)
        pairs = list(zip(ca.horzsplit(by_force), ca.horzsplit(body), strict=True))
        # A rotation mu of the frame turns the forces by -mu: c + c x mu + (c x mu) x mu / 2.
        by_mu = sum((ca.cross(a, b) for a, b in pairs), start=ca.SX.zeros(3))
        form = sum((a @ b.T for a, b in pairs), start=ca.SX.zeros(3, 3))
        turned = ca.vertcat(*(ca.skew(b) for b in ca.horzsplit(body)))
        force_phi, force_inner = mixed[:, :3], mixed[:, 3:]
        mu_mu = (form + form.T) / 2 - ca.trace(form) * ca.SX.eye(3) + turned.T @ twice @ turned
        mu_phi = turned.T @ force_phi
        force_lam = twice @ to_lam
        by_each = ca.vertsplit(to_lam.T @ ca.vec(by_force), 3) if to_lam.shape[1] else []
        mu_lam = ca.horzcat(ca.SX(3, 0), *(ca.skew(a) for a in by_each)) + turned.T @ force_lam
        lam_phi, lam_lam = to_lam.T @ force_phi, to_lam.T @ force_lam
        phi_phi = bend[:3, :3]
        if inner.numel():
            # The internal unknowns follow at their minimum.
            whole = [
                [mu_mu, mu_phi, mu_lam],
                [mu_phi.T, phi_phi, lam_phi.T],
                [mu_lam.T, lam_phi, lam_lam],
            ]
            follow = ca.vertcat(turned.T @ force_inner, bend[:3, 3:], to_lam.T @ force_inner)
            left = ca.blockcat(whole) - follow @ (self._inverse @ follow.T)
            edges = [0, 3, 6, left.shape[0]]
            whole = ca.blocksplit(left, edges, edges)
            (mu_mu, mu_phi, mu_lam), (_, phi_phi, _), (_, lam_phi, lam_lam) = whole
        lever, k = self._moved.lever, self._moved.stretch
        g_s, g_e = self._to_nodes(by_mu, slope)
        half = mu_mu @ lever
        se = half + mu_phi @ k
        across = lever.T @ mu_phi @ k
        ee = lever.T @ half + across + across.T + k @ phi_phi @ k
        second_se, second_ee = _second_order(self._moved, by_mu, slope)
        se, ee = se + second_se, ee + second_ee
        s_lam = mu_lam @ to_world.T
        e_lam = (lam_phi @ k + mu_lam.T @ lever).T @ to_world.T
        mean, skew = mu_mu / 4 + ee, (se + se.T) / 2
        return SegmentDerivatives(
            value,
            self._moved.turn,
            self._moved.phi,
            (g_s / 2 - g_e, g_s / 2 + g_e),
            to_world @ ca.vertcat(ca.SX(0, 1), *by_each),
            (mean - skew, mu_mu / 4 - ee + (se - se.T) / 2, mean + skew),
            (s_lam / 2 - e_lam, s_lam / 2 + e_lam),
            to_world @ lam_lam @ to_world.T,
        )

    def by_numbers(self, numbers: ca.SX) -> tuple[ca.SX, ca.SX, ca.SX]:
        """Derivatives by numbers (a,) of both slopes (3, a) each, and of by_lam (3 q, a).

        Rotations are about the axes of the middle frame.
        """
        _, inner, c, _ = self._symbols
        flat = ca.vec(c)
        turned = ca.kron(ca.DM.eye(c.shape[1]), self._moved.turn.T)
        moved = turned @ ca.jacobian(ca.vec(self._forces), numbers)
        rows = ca.vertcat(self._by_frame, self._by_inner)
        blocks = [ca.jacobian(rows, symbols) for symbols in (numbers, flat, inner)]
        direct, by_force, by_inner = self._at(blocks)
        change = direct + by_force @ moved
        outer = 3 + flat.numel()
        if inner.numel():
            change = change[:outer, :] - by_inner[:outer, :] @ self._inverse @ change[outer:, :]
        (slope,) = self._at([self._by_frame])
        body = self._body
        by_mu = ca.SX.zeros(3, numbers.numel())
        for j in range(c.shape[1]):
            own = slice(3 + 3 * j, 6 + 3 * j)
            by_mu += ca.skew(slope[own]) @ moved[3 * j : 3 * j + 3, :]
            by_mu -= ca.skew(body[:, j]) @ change[own, :]
        g_s, g_e = self._to_nodes(by_mu, change[:3, :])
        by_lam = self._to_world @ self._to_lam.T @ change[3:outer, :]
        return g_s / 2 - g_e, g_s / 2 + g_e, by_lam

    def _to_nodes(self, by_mu: ca.SX, by_phi: ca.SX) -> tuple[ca.SX, ca.SX]:
        """Derivatives by the mean and the difference of the nodes' rotations."""
        return by_mu, self._moved.lever.T @ by_mu + self._moved.stretch @ by_phi


class _Kinematics:
    """Quantities that depend on the nodes of a segment, and their derivatives.

    `phi` (3,) [rad]; `turn` (3, 3): R; `node_turns`: from it to the nodes' axes; `z` (3,);
    `stretch` (3, 3): K; `along`: 1 / |phi|^2; `second`: a and b in the second-order term of psi,
    see `_second_order`; `lever` (3, 3): derivative of mu by epsilon.
    """

    def __init__(self, kind: Element, x: ca.SX) -> None:
        first, last = x[:4], x[4:]
        local, back = kind.local(first, last), conjugate(ca.vertsplit(first))
        middle, phi = local[:4], local[4:]
        *vector, w = quaternion_product(back, ca.vertsplit(last))
        v, square = ca.vertcat(*vector), ca.sumsqr(phi)
        kappa = (ca.dot(phi, v) + 2 * _TINY) / (2 * (ca.sumsqr(v) + _TINY))
        self.along = 1 / (square + _TINY)
        k = (1 - kappa) * self.along
        self.stretch = kappa * ca.SX.eye(3) + k * (phi @ phi.T)
        a = (4 * kappa**2 * k - 1 / (1 + w)) / (8 * kappa)
        b = (1 / (1 + w) + 4 * w * kappa**2 * k) / (4 * kappa)
        self.second = a, b
        ahead = _rotation(ca.vertcat(*quaternion_product(back, ca.vertsplit(middle))))
        self.phi, self.turn, self.node_turns = phi, _rotation(middle), (ahead, ahead.T)
        self.z = v / (1 + w)
        self.lever = -ca.skew(self.z) / 2


@traced
def _rotation(q: ca.SX) -> ca.SX:
    """Matrix (3, 3) of a unit quaternion."""
    x, y, z, w = ca.vertsplit(q)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    return ca.vertcat(*(ca.horzcat(*row) for row in rows))


def _second_order(moved: _Kinematics, by_mu: ca.SX, by_phi: ca.SX) -> tuple[ca.SX, ca.SX]:
    """Second derivatives of by_mu . mu + by_phi . psi by (sigma, epsilon), (epsilon, epsilon).

        mu_2  = (z.e) s / 4 + (z.e) e x z / 8 - (s.e) z / 4
        psi_2 = |phi| (a |e - (n.e) n|^2 n + b (n.e) (e - (n.e) n)) - K (s x e) / 2

    with s, e for sigma, epsilon.
    """
    phi, z = moved.phi, moved.z
    a, b = moved.second
    eye = ca.SX.eye(3)
    se = (by_mu @ z.T - ca.dot(by_mu, z) * eye) / 4
    se += ca.skew(moved.stretch @ by_phi) / 2
    lever = ca.cross(z, by_mu) / 8
    ee = z @ lever.T + lever @ z.T
    part = ca.dot(by_phi, phi)
    ee += 2 * a * part * eye + b * (phi @ by_phi.T + by_phi @ phi.T)
    ee -= 2 * (a + b) * part * moved.along * (phi @ phi.T)
    return se, ee
