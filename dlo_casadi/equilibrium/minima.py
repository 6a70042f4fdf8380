"""Minima of the energy from distant starts: Newton's method on many poses at once.

Each step of Newton's method on many poses or first guesses solves

    [ A + tau I   B ] [ dx   ]     [ dL/dx   ]
    [ B^T         C ] [ dlam ] = - [ dL/dlam ]

tau is the least value found for which the matrix has as many negative eigenvalues as there are
multipliers. Then dx lowers the energy along the end conditions, and a shape that converges with
tau = 0 is a strict minimum under them.

References
----------
Inertia-corrected Newton steps: Nocedal and Wright, Numerical Optimization, 2006, section 18.
"""

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from dlo_casadi.arrays import BoolArray, FloatArray, IntArray
from dlo_casadi.equilibrium.equilibrium import END_TOLERANCE
from dlo_casadi.equilibrium.eyelets import slid
from dlo_casadi.model.assembly import Assembly, Shapes
from dlo_casadi.model.cable_model import CableModel
from dlo_casadi.model.contact import DEPTH, gap_per_force
from dlo_casadi.rod.band import NEUTRAL, BandFactor, BandMatrix, Vector
from dlo_casadi.rod.obstacles import bars_of

# Turn [rad] that counts as much as a slip of the whole length through an eyelet.
_TURN = 10.0
# Longest step of a node [rad].
LONGEST_STEP = 0.5
# Longest step at convergence [rad].
TOLERANCE = 1e-10
# Shift tau relative to the largest entry of the diagonal: first value, factors of growth and
# shrinkage, and smallest value before it becomes zero.
FIRST_SHIFT, GROWTH, SHRINKAGE, LEAST_SHIFT = 1e-4, 8.0, 4.0, 1e-7
# Growth of the Hessian since the first guess above which multipliers count as diverging: the
# cable's stiffness is then below rounding. Four of 336 descents of very soft cables with a tether
# returned from beyond 1e6.
RUNAWAY = 1e16
# Depths of a cable in soft obstacles, see `contact.DEPTH`, solved in turn before obstacles become
# hard. A given start skips the first KEEPING_SIDE of them, so that it stays on its side, and one
# more if the pose names the side (without that, 16 elements in space found it in none of three
# poses). Maximum number of steps at each depth.
SOFT, KEEPING_SIDE, STEPS_WHILE_SOFT = (1.0, 0.1, 1e-2, 1e-3, 1e-4), 2, 20
# Number of times that the change from one depth to the next is halved if contacts alternate. They
# no longer alternate beyond the depth by which the cable bends between two nodes.
HALVINGS = 4
# Contacts that alternate give steps of equal size. A step longer than SAME_SIZE times the last one
# is shortened to the share SHORTER. Its rest comes back as the next step, so that SAME_SIZE must
# exceed a half.
SHORTER, SAME_SIZE = 0.5, 0.75
# Maximum number of halvings of a step that carries a cable through a bar.
SHORTENED = 6
# Depth [lengths] of a node in hard obstacles above which there is no room for the cable.
NO_ROOM = 1e-6
# Number of inverse iterations for the direction in which the energy falls: stiff ones vanish in the
# first, and of the others any mixture in which the energy falls will do.
MIXED = 8


class Minima(NamedTuple):
    """Results of the descents.

    Parameters
    ----------
    balanced : (m,) bool
        Whether the forces balance.
    converged : (m,) bool
        Whether the shape is also a strict minimum; a neutral one is not.
    energy : (m,) [J]
    iterations : (m,) int
    """

    shapes: Shapes
    balanced: BoolArray
    converged: BoolArray
    energy: FloatArray
    iterations: IntArray


def turn_per_slip(model: CableModel) -> FloatArray:
    """Turn [rad/m] equivalent to a slip through an eyelet or an end; zero for others (k,)."""
    slide = np.isin(np.arange(model.n_border), [*model.sliding.values()])
    return slide * (_TURN / model.chain.length)


def violation(model: CableModel, gaps: FloatArray) -> FloatArray:
    """Largest violation (m,) of the conditions of ends, clips and contacts.

    Distances are relative to the length, angles in rad. `gaps` (m, n_border, 1): of the border's
    conditions. Where these depend on each other, a Newton step leaves what they contradict: it may
    be short although an end is not where it is held.
    """
    kinds = np.array([*model.border_kinds.values()])
    unit = np.where(kinds == "distance", 1 / model.chain.length, kinds == "angle")
    return np.abs(gaps[..., 0] * unit).max(axis=1, initial=0.0)


def size_of(model: CableModel, step: Vector) -> FloatArray:
    """Largest turn (m,) [rad] in a step of one column."""
    nodes = np.abs(step.x).max(axis=(1, 2, 3))
    slips = (np.abs(step.y[..., 0]) * turn_per_slip(model)).max(axis=1, initial=0.0)
    return np.maximum(nodes, slips)


def descend(start: Assembly, max_iterations: int = 80) -> Minima:
    """Minimise the energy of each of m shapes under its end conditions.

    `start`: first guesses and the inputs of each of them; their deviations are kept.
    """
    model, shapes = start.model, start.shapes
    m, wanted, turns = len(shapes.x), model.n_multipliers, turn_per_slip(model)
    now = shapes
    balanced, iterations = np.zeros(m, dtype=bool), np.full(m, max_iterations)
    shift, first, last = np.zeros(m), np.full(m, np.inf), np.full(m, np.inf)
    active = np.arange(m)
    here = start.subset(active)
    for iteration in range(max_iterations):
        _, force, matrix = here.balance()
        if not iteration:
            first = RUNAWAY * matrix.scale
        bounded = np.flatnonzero(matrix.scale <= first[active])
        if len(bounded) < len(active):
            active, here = active[bounded], here.subset(bounded)
            force = Vector(force.x[bounded], force.y[bounded])
            matrix = matrix.subset(bounded)
        if not len(active):
            break
        factor, shift[active] = _convex(matrix, wanted, shift[active], turns)
        step = factor.solve(Vector(-force.x, -force.y))
        size = size_of(model, step)
        taken, length = damped(model, step, size, last[active])
        last[active] = size
        here = _on_their_sides(here, taken, length)
        now = now.replaced(active, here.shapes)
        # A shift makes steps small even if forces do not balance.
        done = size * (1 + shift[active] / matrix.scale) < TOLERANCE
        balanced[active[done]] = True  # the end conditions are checked below
        iterations[active[done]] = iteration + 1
        left = np.flatnonzero(~done & np.isfinite(size))
        active, here = active[left], here.subset(left)
        if not len(active):
            break
    end = replace(start, shapes=now)
    total, force, matrix = end.balance()
    with np.errstate(invalid="ignore"):
        energy = total - end.work(force)
    balanced &= violation(model, force.y) <= END_TOLERANCE
    there = np.flatnonzero(balanced)
    converged = np.zeros(m, dtype=bool)
    converged[there] = matrix.subset(there).negative() == wanted
    pressed = now.lam[:, model.n_lam :].max(axis=1, initial=0.0)
    possible = end.clipped.in_order
    possible &= pressed * gap_per_force(model, DEPTH) < NO_ROOM * model.chain.length
    balanced, converged = balanced & possible, converged & possible
    return Minima(now, balanced, converged, energy, iterations)


def descend_to_contact(
    start: Assembly, skipped: int | IntArray, max_iterations: int = 80
) -> Minima:
    """As `descend`; each shape skips the first `skipped` (m,) of the depths SOFT."""
    if not start.model.surfaces:
        return descend(start, max_iterations)
    shapes = start.shapes
    depths = [depth for depth in SOFT if depth > start.depth]
    for k, depth in enumerate(depths):
        rows = np.flatnonzero(np.broadcast_to(skipped, len(shapes.x)) <= k)
        if len(rows):
            soft = replace(start, shapes=shapes, depth=depth).subset(rows)
            shapes = shapes.replaced(rows, descend(soft, STEPS_WHILE_SOFT).shapes)
    return _hardened(replace(start, shapes=shapes), depths[-1], max_iterations, HALVINGS)


def at_saddles(here: Assembly, among: BoolArray) -> BoolArray:
    """Whether, of m shapes, the energy falls in some direction from each of those `among` them.

    `among` (m,): shapes that balance.
    """
    falling, wanted = among.copy(), here.model.n_multipliers
    if among.any():
        matrix = here.subset(np.flatnonzero(among)).balance()[2]
        falling[among] = matrix.negative(below=-NEUTRAL) > wanted
    return falling


def kept_by(start: Assembly, found: Minima) -> BoolArray:
    """Whether a cable stays in each of m shapes found from a start, be it a neutral one."""
    there = replace(start, shapes=found.shapes)
    return found.balanced & ~at_saddles(there, found.balanced)


def leave_saddles(start: Assembly, max_iterations: int = 80) -> Minima:
    """Shapes below saddles: of both sides of the direction in which the energy falls, the lower.

    They have `converged` also if they are neutral. `start`: balanced shapes of which each is a
    saddle.
    """
    model, (_, force, matrix) = start.model, start.balance()
    m, still = len(start.shapes.x), Vector(0 * force.x, 0 * force.y)
    factor, _ = _convex(matrix, model.n_multipliers, np.zeros(m), turn_per_slip(model))
    step = replace(still, x=still.x + np.random.default_rng(0).standard_normal(still.x.shape[1:]))
    for _ in range(MIXED):
        way = factor.solve(replace(still, x=step.x)).x
        step = replace(still, x=way / np.abs(way).max(axis=(1, 2, 3), keepdims=True))
    size = np.full(2 * m, 1 / LONGEST_STEP)
    both = Vector(*(np.concatenate([part, -part]) for part in (step.x, step.y)))
    sides = stepped(start.subset(np.tile(np.arange(m), 2)), both, size)
    found = descend_to_contact(sides, KEEPING_SIDE, max_iterations)
    found = found._replace(converged=kept_by(sides, found))
    energy = np.where(found.converged, found.energy, np.inf).reshape(2, m)
    lower = np.arange(m) + m * (energy[1] < energy[0])
    return Minima(found.shapes.subset(lower), *(part[lower] for part in found[1:]))


def _hardened(start: Assembly, softer: float, max_iterations: int, halvings: int) -> Minima:
    """Minima from shapes that balanced in obstacles of a larger depth, `softer`.

    If this finds none because contacts change too much, the change of log depth is halved: an
    intermediate depth is solved first.
    """
    found = descend(start, max_iterations)
    lost = np.flatnonzero(~found.balanced)
    if not len(lost) or not halvings:
        return found
    between, few = float(np.sqrt(softer * start.depth)), (STEPS_WHILE_SOFT, halvings - 1)
    half = _hardened(replace(start.subset(lost), depth=between), softer, *few)
    lost, near = lost[half.balanced], half.shapes.subset(half.balanced)
    if len(lost):
        other = _hardened(replace(start.subset(lost), shapes=near), between, *few)
        for mine, theirs in zip(found[1:], other[1:], strict=True):
            mine[lost] = theirs
        found = found._replace(shapes=found.shapes.replaced(lost, other.shapes))
    return found


def _convex(
    matrix: BandMatrix, wanted: int, before: FloatArray, turns: FloatArray
) -> tuple[BandFactor, FloatArray]:
    """Factors of the matrices, shifted until their inertia is that of a minimum, and the shifts.

    `turns` (k,): see `turn_per_slip`. The largest shift makes the nodes' part positive
    definite: if the inertia is wrong even then, the conditions are the cause.
    """
    scale, most = matrix.scale, matrix.row_sum
    shift = np.where(before > LEAST_SHIFT * scale, before / SHRINKAGE, 0.0)
    unit = np.eye(matrix.diagonal.shape[2])

    def shifted(index: IntArray) -> BandFactor:
        part = matrix.subset(index)
        diagonal = part.diagonal + shift[index, None, None, None] * unit
        corner = part.corner
        if turns.any():
            spare = np.zeros(corner.shape[1] - len(turns))
            corner = corner + shift[index, None, None] * np.diag([*turns**2, *spare])
        return replace(part, diagonal=diagonal, corner=corner).factor()

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


def damped(
    model: CableModel, step: Vector, size: FloatArray, last: FloatArray
) -> tuple[Vector, FloatArray]:
    """Steps of one column and their sizes (m,), shortened if contacts alternate."""
    if not model.surfaces:
        return step, size
    share = np.where(size > SAME_SIZE * last, SHORTER, 1.0)
    return Vector(step.x * share[:, None, None, None], step.y * share[:, None, None]), size * share


def stepped(here: Assembly, step: Vector, size: FloatArray) -> Assembly:
    """Shapes after a step of one column, limited to LONGEST_STEP.

    `size` (m,) [rad] is the longest step of each shape, see `size_of`. Eyelets stay between what
    is beside them.
    """
    model, shapes = here.model, here.shapes
    share = np.minimum(1.0, LONGEST_STEP / np.maximum(size, 1e-300))
    x = model.node.moved(shapes.x, share[:, None, None] * step.x[..., 0])
    lam = shapes.lam + share[:, None] * step.y[..., 0]
    moved = replace(shapes, x=x, lam=lam)
    return replace(here, shapes=slid(here, moved) if model.sliding else moved)


def _on_their_sides(here: Assembly, step: Vector, size: FloatArray) -> Assembly:
    """As `stepped`, but a step that carries a cable through a bar is halved.

    Bars so soft that the cable sinks in by more than their radius under its weight are ignored.
    """
    model, size = here.model, np.maximum(size, LONGEST_STEP)
    depth = here.depth * model.chain.length
    bars = bars_of(model.surfaces, model.gravity)
    bars = [(bar, up) for bar, up in bars if depth < bar.radius]
    before = here.nodes() if bars else here.shapes.x
    for _ in range(SHORTENED):
        there = stepped(here, step, size)
        after = there.nodes() if bars else there.shapes.x
        sides = [np.array([bar.passed(up, y) for y in (before, after)]) for bar, up in bars]
        through = np.any([(x != y).all(axis=0) for x, y in sides], axis=0)
        if not through.any():
            break
        size = np.where(through, 2 * size, size)
    return there
