"""Natural frequencies and damping of small motions about an equilibrium.

    (K + s C + s^2 M) q = 0

with the matrices of the equations of motion at rest, places and forces among the unknowns: the
motions are those on the null space of the constraints. The lowest modes without damping come from
subspace iteration with (K - sigma M)^-1 M, by one banded factorisation; each is then followed to
its damped one by Newton's method.

References
----------
Bathe, Finite Element Procedures, 1996; Tisseur and Meerbergen, SIAM Rev. 43 (2001).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import lapack
from scipy.sparse import dia_array

from dlo_casadi.arrays import ComplexArray, FloatArray
from dlo_casadi.errors import DloError
from dlo_casadi.motion.handles import between
from dlo_casadi.motion.state import Banded, Fixtures, State
from dlo_casadi.motion.system import MovingCable

# Damping ratio of a mode beyond which it is not followed: near 1 two real values meet.
_HEAVY = 0.9
# Vectors iterated beside those asked for, at least; iterations; squared sizes that count as zero.
_GUARDS, _ITERATIONS, _RANK = 8, 200, 1e-12
# Newton steps of a damped mode, and the relative change at which they end.
_STEPS, _CHANGE = 20, 1e-12


@dataclass(frozen=True, eq=False)
class Matrices:
    """K, C and M of a cable at rest as bands, see `Banded`."""

    stiffness: FloatArray
    damping: FloatArray
    mass: FloatArray
    width: int

    @classmethod
    def of(cls, cable: MovingCable, state: State, fixtures: Fixtures) -> Matrices:
        """Those of a state at rest."""
        viscous = cable.evaluated(state, fixtures, (1.0, 0.0))
        inert = cable.evaluated(state, fixtures, (0.0, 1.0))
        parts = (viscous.stiffness, viscous.damping, inert.damping)
        stiffness, damping, mass = map(viscous.band, parts)
        return cls(stiffness, damping, mass, cable.width)

    def sparse(self, band: FloatArray) -> dia_array:
        """A band as a sparse matrix."""
        size, width = band.shape[1], self.width
        return dia_array((band[width:], np.arange(width, -width - 1, -1)), shape=(size, size))


def lowest(matrices: Matrices, count: int, scale: float) -> tuple[FloatArray, FloatArray]:
    """Squares (count,) [1/s^2] of the lowest frequencies without damping, and modes (N, count).

    Subspace iteration. `scale` [1/s^2]: of the lowest square; its order of magnitude suffices.
    Squares are negative if the equilibrium is not stable, and zero if the cable is free to roll.

    Raises
    ------
    DloError
        If the mesh has fewer modes.
    """
    shift = -0.1 * scale
    factor = Banded(matrices.stiffness - shift * matrices.mass, matrices.width)
    stiffness, mass = (matrices.sparse(x) for x in (matrices.stiffness, matrices.mass))
    size = mass.shape[0]
    width = min(count + max(count, _GUARDS), size)
    q: FloatArray = np.random.default_rng(0).normal(size=(size, width))
    before = np.full(count, np.inf)
    for _ in range(_ITERATIONS):
        q = factor.solve(mass @ q)
        sizes, vectors = np.linalg.eigh(q.T @ (mass @ q))
        kept = sizes > _RANK * sizes[-1]
        q = q @ (vectors[:, kept] / np.sqrt(sizes[kept]))
        squares, vectors = np.linalg.eigh(q.T @ (stiffness @ q))
        q = q @ vectors
        if len(squares) < count:
            found = len(squares)
            raise DloError(f"{count} modes: this mesh has {found}.\n  Try: fewer, or a finer mesh")
        change = np.abs(squares[:count] - before).max()
        if change <= _CHANGE * max(np.abs(squares[:count]).max(), scale):
            break
        before = squares[:count]
    return squares[:count], q[:, :count]


@dataclass(frozen=True, eq=False)
class DampedModes:
    """Modes with damping: s^2 + 2 zeta w s + w^2 = 0.

    `rates` w (count,) [rad/s], `damping_ratios` zeta (count,), `vectors` (N, count).
    """

    rates: FloatArray
    damping_ratios: FloatArray
    vectors: ComplexArray


def damped(matrices: Matrices, square: float, mode: FloatArray) -> tuple[complex, ComplexArray]:
    """The damped mode that belongs to one without damping: s [1/s], and q (N,).

    With a damping ratio near 1 or above, s is that of the mode alone; see `DampedModes`.
    """
    damping, mass = matrices.sparse(matrices.damping), matrices.sparse(matrices.mass)
    own = float(mode @ (mass @ mode))
    loss = float(mode @ (damping @ mode)) / own
    root = np.sqrt(complex(loss**2 / 4 - square))
    s = complex(-loss / 2 + root)
    q: ComplexArray = mode.astype(complex)
    if loss == 0 or square <= 0 or loss / 2 > _HEAVY * np.sqrt(square):
        return s, q
    width = matrices.width
    weight = mass @ mode
    for _ in range(_STEPS):
        band = matrices.stiffness + s * matrices.damping + s**2 * matrices.mass
        lu, pivots, _ = lapack.zgbtrf(band, width, width)
        right = (damping @ q) + 2 * s * (mass @ q)
        found, _ = lapack.zgbtrs(lu, width, width, right[:, None], pivots)
        moved = found[:, 0]
        change = (weight @ q) / (weight @ moved)
        s, q = s - change, moved * (change if change else 1.0)
        q = q / np.abs(weight @ q) * own
        if abs(change) < _CHANGE * abs(s):
            break
    return s, q


def damped_modes(cable: MovingCable, state: State, fixtures: Fixtures, count: int) -> DampedModes:
    """The slowest modes about a state at rest."""
    matrices = Matrices.of(cable, state, fixtures)
    squares, modes = lowest(matrices, count, cable.slowest**2)
    rates, ratios, vectors = [], [], []
    for square, mode in zip(squares.tolist(), modes.T, strict=True):
        s, q = damped(matrices, square, mode)
        # Two real roots have the product w^2 and the mean -zeta w.
        real = s.imag == 0 and square > 0
        rate = np.sqrt(square) if real else abs(s)
        mean = -(s.real + square / s.real) / 2 if real and s.real else -s.real
        rates.append(rate)
        ratios.append(mean / rate if rate else 0.0)
        vectors.append(q)
    return DampedModes(np.array(rates), np.array(ratios) + 0.0, np.array(vectors).T)


def displacements(
    cable: MovingCable, state: State, modes: ComplexArray, s: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Points (K, d) [m] at declared arc lengths s (K,) [m], and displacements (count, K, d) there.

    Displacements are real, at the phase at which they are largest; their largest is 1.
    """
    places = cable.along
    e = np.clip(np.searchsorted(places, s, side="right") - 1, 0, len(places) - 2)
    share = (s - places[e]) / np.diff(places)[e]
    z, by_unknowns, _ = cable.handles(state)
    points, moved = between(z[e], share), []
    for mode in modes.T:
        real, imaginary = (cable.moved_handles(by_unknowns, x) for x in (mode.real, mode.imag))
        change = between(real[e], share) + 1j * between(imaginary[e], share)
        at = np.unravel_index(np.abs(change).argmax(), change.shape)
        moved.append((change / change[at]).real)
    return points, np.array(moved)
