"""A slot between two frames, differentiated in stages: fewer operations than in one go.

The Lagrangian of a slot is the same however the slot and the forces on it are turned together. So
it is written in the frame R in its middle, by the rotation vector phi from node to node and the
forces c = R^T F; CasADi differentiates it there by phi, the inner unknowns and c, and the chain
rule to the nodes is in closed form. With increments alpha, beta of both nodes about the axes of R,

    sigma = (alpha + beta) / 2,   epsilon = beta - alpha,
    R -> R exp(mu),               phi -> phi + psi,
    mu  = sigma - z x epsilon / 2 + O(2),    psi = K epsilon + O(2),

z = tan(|phi| / 4) n, K = kappa (1 - n n^T) + n n^T, kappa = (|phi| / 2) / sin(|phi| / 2), n along
phi. Outputs are by increments about the world's axes.

References
----------
Second-order terms: composition of unit quaternions to second order, e.g. Murray, Li and Sastry, A
Mathematical Introduction to Robotic Manipulation, 1994.
"""

from __future__ import annotations

from dataclasses import dataclass

import casadi as ca

from dlo_casadi.model import CableModel
from dlo_casadi.rod.helix import inverse_of
from dlo_casadi.rod.node import conjugate, quaternion_product

# Keeps a quotient of two squares of an angle at a straight element finite.
_TINY = 1e-30


@dataclass(frozen=True)
class SlotNumbers:
    """Arguments of `CableModel.slot_in_frame` that are no unknowns."""

    p: ca.SX
    rest: ca.SX
    place: ca.SX
    deviation: ca.SX
    shares: ca.SX


@dataclass(frozen=True)
class _Kinematics:
    """What moves with the nodes of a slot, and how.

    `phi` (3,) [rad]; `turn` (3, 3): R; `z` (3,); `stretch` (3, 3): K; `along`: 1 / |phi|^2;
    `second`: a, b, of the second order of psi, see `_second_order`.
    """

    phi: ca.SX
    turn: ca.SX
    z: ca.SX
    stretch: ca.SX
    along: ca.SX
    second: tuple[ca.SX, ca.SX]


def _kinematics(model: CableModel, x: ca.SX) -> _Kinematics:
    first, last = x[:4], x[4:]
    local = model.chain.kind.local(first, last)
    phi = local[4:]
    *vector, w = quaternion_product(conjugate(ca.vertsplit(first)), ca.vertsplit(last))
    v, square = ca.vertcat(*vector), ca.sumsqr(phi)
    kappa = (ca.dot(phi, v) + 2 * _TINY) / (2 * (ca.sumsqr(v) + _TINY))
    along = 1 / (square + _TINY)
    k = (1 - kappa) * along
    stretch = kappa * ca.SX.eye(3) + k * (phi @ phi.T)
    a = (4 * kappa**2 * k - 1 / (1 + w)) / (8 * kappa)
    b = (1 / (1 + w) + 4 * w * kappa**2 * k) / (4 * kappa)
    return _Kinematics(phi, _rotation(local[:4]), v / (1 + w), stretch, along, (a, b))


def _rotation(q: ca.SX) -> ca.SX:
    """Matrix (3, 3) of a unit quaternion."""
    x, y, z, w = ca.vertsplit(q)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    return ca.vertcat(*(ca.horzcat(*row) for row in rows))


def slot_in_space(model: CableModel, x: ca.SX, lam: ca.SX, numbers: SlotNumbers) -> list[ca.SX]:
    """A slot's Lagrangian and its derivatives by increments about the world's axes.

    Parameters
    ----------
    x : (8,)
        Frames of both nodes.
    lam : (3,) [N]
        Force on the end's holder; also where that is free, for its derivative is the advance.

    Returns
    -------
    list
        Value; by lam: advance (3,) [m]; phi (3,) [rad]; slopes (3,) by the first, last node;
        Hessian by first-first, first-last, last-last, first-lam, last-lam, lam-lam: rows one after
        another (9,), of symmetric blocks the upper triangle column by column (6,).
    """
    moved = _kinematics(model, x)
    turn = moved.turn
    forces = model.slot_forces(numbers.p, numbers.place, numbers.deviation)
    spread = len(model.chain.kind.rule[0])
    pulled = ca.repmat(lam, 1, spread) - forces[:, :spread]
    body = turn.T @ ca.horzcat(pulled, -forces[:, spread:])
    value, by_phi, by_force, blocks = _in_frame(model, moved.phi, body, numbers)
    advance = ca.sum2(by_force[:, :spread])
    to_lam = ca.repmat(ca.SX.eye(3), spread, 1)
    to_lam = ca.vertcat(to_lam, ca.SX(3 * (body.shape[1] - spread), 3))
    pairs = list(zip(ca.horzsplit(by_force), ca.horzsplit(body), strict=True))
    # A turn mu of the frame turns the forces by -mu: c + c x mu + (c x mu) x mu / 2.
    by_mu = sum((ca.cross(a, c) for a, c in pairs), start=ca.SX.zeros(3))
    form = sum((a @ c.T for a, c in pairs), start=ca.SX.zeros(3, 3))
    mu_mu = (form + form.T) / 2 - ca.trace(form) * ca.SX.eye(3)
    turned = ca.vertcat(*(ca.skew(c) for c in ca.horzsplit(body)))
    mu_mu += turned.T @ blocks.force_force @ turned
    mu_phi = turned.T @ blocks.force_phi
    force_lam = blocks.force_force @ to_lam
    mu_lam = ca.skew(advance) + turned.T @ force_lam
    mu_inner = turned.T @ blocks.force_inner
    lam_phi, lam_inner = to_lam.T @ blocks.force_phi, to_lam.T @ blocks.force_inner
    lam_lam = to_lam.T @ force_lam
    # The inner unknowns follow.
    if blocks.inner_inner.numel():
        inverse = blocks.inverse
        rows = [mu_inner, blocks.phi_inner, lam_inner]
        solved = [inverse @ row.T for row in rows]
        mu_mu -= mu_inner @ solved[0]
        mu_phi -= mu_inner @ solved[1]
        mu_lam -= mu_inner @ solved[2]
        lam_phi -= lam_inner @ solved[1]
        lam_lam -= lam_inner @ solved[2]
        phi_phi = blocks.phi_phi - blocks.phi_inner @ solved[1]
    else:
        phi_phi = blocks.phi_phi
    return _at_nodes(
        moved,
        value,
        advance,
        (by_mu, by_phi),
        (mu_mu, mu_phi, phi_phi),
        (mu_lam, lam_phi, lam_lam),
    )


@dataclass(frozen=True)
class _Blocks:
    """Second derivatives in the frame, by phi, the inner unknowns and the forces."""

    phi_phi: ca.SX
    phi_inner: ca.SX
    inner_inner: ca.SX
    inverse: ca.SX
    force_phi: ca.SX
    force_inner: ca.SX
    force_force: ca.SX


def _in_frame(
    model: CableModel, phi: ca.SX, body: ca.SX, numbers: SlotNumbers
) -> tuple[ca.SX, ca.SX, ca.SX, _Blocks]:
    """Value, slopes by phi and forces (3, m), second derivatives, at the inner equilibrium."""
    own, inner = ca.SX.sym("phi", 3), ca.SX.sym("inner", model.chain.kind.n_inner)
    forces = ca.SX.sym("force", *body.shape)
    local = ca.vertcat(ca.DM(model.node.identity), own)
    value = model.slot_in_frame(
        local,
        inner,
        -forces,
        numbers.p,
        numbers.rest,
        numbers.place,
        numbers.deviation,
        numbers.shares,
    )
    both, flat = ca.vertcat(own, inner), ca.vec(forces)
    slope, by_force = ca.gradient(value, both), ca.gradient(value, flat)
    bend, _ = ca.hessian(value, both)
    mixed = ca.jacobian(by_force, both)
    twice = ca.jacobian(by_force, flat)
    found = [value, slope, by_force, bend, mixed, twice]
    symbols = [own, inner, forces]
    _, slope, _, bend, _, _ = ca.substitute(found, symbols, [phi, ca.SX.zeros(inner.shape), body])
    inverse = inverse_of(bend[3:, 3:]) if inner.numel() else ca.SX(0, 0)
    there = [phi, -inverse @ slope[3:], body]
    value, slope, by_force, bend, mixed, twice = ca.substitute(found, symbols, there)
    blocks = _Blocks(
        bend[:3, :3], bend[:3, 3:], bend[3:, 3:], inverse, mixed[:, :3], mixed[:, 3:], twice
    )
    return value, slope[:3], ca.reshape(by_force, body.shape), blocks


def _at_nodes(
    moved: _Kinematics,
    value: ca.SX,
    advance: ca.SX,
    slopes: tuple[ca.SX, ca.SX],
    bends: tuple[ca.SX, ca.SX, ca.SX],
    by_lam: tuple[ca.SX, ca.SX, ca.SX],
) -> list[ca.SX]:
    """From the middle and phi to both nodes, all about the world's axes."""
    turn, k = moved.turn, moved.stretch
    (by_mu, by_phi), (mu_mu, mu_phi, phi_phi) = slopes, bends
    mu_lam, lam_phi, lam_lam = by_lam
    lever = -ca.skew(moved.z) / 2  # mu by epsilon
    by_epsilon = lever.T @ by_mu + k @ by_phi
    half = mu_mu @ lever
    ss, se = mu_mu, half + mu_phi @ k
    across = lever.T @ mu_phi @ k
    ee = lever.T @ half + across + across.T + k @ phi_phi @ k
    second_se, second_ee = _second_order(moved, by_mu, by_phi)
    se += second_se
    ee += second_ee
    lam_e = lam_phi @ k + mu_lam.T @ lever
    ss, se, ee = (turn @ block @ turn.T for block in (ss, se, ee))
    s_lam, e_lam = turn @ mu_lam @ turn.T, turn @ lam_e.T @ turn.T
    g_s, g_e = turn @ by_mu, turn @ by_epsilon
    mean, skew = ss / 4 + ee, (se + se.T) / 2
    return [
        value,
        turn @ advance,
        moved.phi,
        g_s / 2 - g_e,
        g_s / 2 + g_e,
        _triangle(mean - skew),
        _rows(ss / 4 - ee + (se - se.T) / 2),
        _triangle(mean + skew),
        _rows(s_lam / 2 - e_lam),
        _rows(s_lam / 2 + e_lam),
        _triangle(turn @ lam_lam @ turn.T),
    ]


def _rows(a: ca.SX) -> ca.SX:
    return ca.vec(a.T)


def _triangle(a: ca.SX) -> ca.SX:
    return ca.vertcat(*(a[: k + 1, k] for k in range(3)))


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
