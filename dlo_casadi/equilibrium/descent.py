"""Minima of the energy from far away: Newton's method on many poses or first guesses at once.

Each step solves

    [ A + tau I   B ] [ dx   ]     [ dL/dx   ]
    [ B^T         C ] [ dlam ] = - [ dL/dlam ]

with the least tau found for which the matrix has as many negative eigenvalues as there are
multipliers: dx then lowers the energy along the end conditions, and a converged shape of tau = 0
is a strict minimum under them.

References
----------
Inertia-corrected Newton steps: Nocedal and Wright, Numerical Optimization, 2006, section 18.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from dlo_casadi.model.assembly import Assembly, Inputs, Shapes
from dlo_casadi.rod.band import BandFactor, BandMatrix, Vector

FloatArray = NDArray[np.floating]
BoolArray = NDArray[np.bool_]

# Longest step of a node [rad].
LONGEST_STEP = 0.5
# A step below this has converged [rad].
TOLERANCE = 1e-10
# First shift of the diagonal over its largest entry, how fast it grows and shrinks, and below
# what it is dropped.
FIRST_SHIFT, GROWTH, SHRINKAGE, LEAST_SHIFT = 1e-4, 8.0, 4.0, 1e-7
# A tangent matrix larger than the first guess's by this factor is made of multipliers that run
# away: nothing of the cable's own stiffness is left in double precision. Four of 336 descents of
# very soft cables with a tether came back from beyond 1e6.
RUNAWAY = 1e16


@dataclass(frozen=True)
class Minima:
    """Where the descents have led.

    Parameters
    ----------
    shapes : Shapes
    balanced : (m,) bool
        Whether the forces balance.
    converged : (m,) bool
        Whether the shape is a strict minimum, too; a neutral one is none.
    energy : (m,) [J]
    iterations : (m,) int
    """

    shapes: Shapes
    balanced: BoolArray
    converged: BoolArray
    energy: FloatArray
    iterations: NDArray[np.intp]


def descend(assembly: Assembly, shapes: Shapes, given: Inputs, max_iterations: int = 80) -> Minima:
    """Minimise the energy of each of m shapes under its end conditions.

    Parameters
    ----------
    shapes : Shapes
        First guesses; deviations are kept.
    given : Inputs
        What each of them depends on.
    """
    m = len(shapes.x)
    node, wanted = assembly.node, assembly.model.n_multipliers
    now = Shapes(shapes.x.copy(), shapes.lam.copy(), shapes.deviation)
    balanced, iterations = np.zeros(m, dtype=bool), np.full(m, max_iterations)
    shift, first = np.zeros(m), np.full(m, np.inf)
    active = np.arange(m)
    for iteration in range(max_iterations):
        here = now.subset(active)
        _, force, matrix = assembly.balance(here, given.subset(active))
        if not iteration:
            first = RUNAWAY * matrix.scale
        bounded = np.flatnonzero(matrix.scale <= first[active])
        if len(bounded) < len(active):
            active, here = active[bounded], here.subset(bounded)
            force = Vector(force.x[bounded], force.y[bounded])
            matrix = matrix.subset(bounded)
        if not len(active):
            break
        factor, shift[active] = _convex(matrix, wanted, shift[active])
        step = factor.solve(Vector(-force.x, -force.y))
        size = np.abs(step.x).max(axis=(1, 2, 3))
        share = np.minimum(1.0, LONGEST_STEP / np.maximum(size, 1e-300))
        now.x[active] = node.moved(here.x, share[:, None, None] * step.x[..., 0])
        now.lam[active] = here.lam + share[:, None] * step.y[..., 0]
        # A shift makes steps small where forces do not balance, too.
        done = size * (1 + shift[active] / matrix.scale) < TOLERANCE
        balanced[active[done]] = True
        iterations[active[done]] = iteration + 1
        active = active[~done & np.isfinite(size)]
        if not len(active):
            break
    total, force, matrix = assembly.balance(now, given)
    with np.errstate(invalid="ignore"):
        energy = total - assembly.work(now, force)
    there = np.flatnonzero(balanced)
    converged = np.zeros(m, dtype=bool)
    converged[there] = matrix.subset(there).negative() == wanted
    return Minima(now, balanced, converged, energy, iterations)


def _convex(matrix: BandMatrix, wanted: int, before: FloatArray) -> tuple[BandFactor, FloatArray]:
    """Elimination of the matrices shifted until their inertia is a minimum's, and the shifts.

    No shift exceeds what makes the nodes' part positive definite: where the inertia is wrong
    still, the conditions are the cause.
    """
    scale, most = matrix.scale, matrix.row_sum
    shift = np.where(before > LEAST_SHIFT * scale, before / SHRINKAGE, 0.0)
    unit = np.eye(matrix.diagonal.shape[2])

    def shifted(index: NDArray[np.intp]) -> BandFactor:
        part = matrix.subset(index)
        diagonal = part.diagonal + shift[index, None, None, None] * unit
        return replace(part, diagonal=diagonal).factor()

    everyone = np.arange(len(scale))
    factor = shifted(everyone)
    wrong = np.flatnonzero(factor.negative != wanted)
    if not len(wrong):
        return factor, shift
    while len(wrong):
        larger = np.maximum(GROWTH * shift[wrong], FIRST_SHIFT * scale[wrong])
        shift[wrong] = np.minimum(larger, most[wrong])
        wrong = wrong[(shifted(wrong).negative != wanted) & (larger < most[wrong])]
    return shifted(everyone), shift
