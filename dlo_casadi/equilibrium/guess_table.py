"""Numbers of first guesses, and their table by spans: Python and the generated C read them."""

from itertools import product
from typing import NamedTuple

import numpy as np

# Angles [rad] below which some first guesses are left out, see `guesses`, because they seldom lead
# to the lowest equilibrium. None is lost in 300 random problems with a clamp at the end or both.
FAR, CURVED = 1.5, 1.0
# First guess of a cable that slides through its end: its length over the chord, less one. Where it
# is much longer its weight pulls ever more through the end.
SLACK = 0.05
# Largest joint angle of a first guess [rad]: 0.9 of the bound of an equilibrium.
LARGEST_BEND = 0.9 * np.pi / 2
# A roll within this distance [rad] of half a turn is tried both ways round: the rolls of arcs to
# four sides differ by that much, by 1.2 rad in a pose whose lowest equilibrium is the other way.
HALF_TURN = 1.0
# Rounding error allowed in comparing twists [turns]: two may be equally near to half a turn.
TIE = 1e-6
# Coefficients of half_angle^2 / (1 - ratio) in powers of 1 - ratio: least squares, 2e-4 rad error.
HALF_ANGLE = (
    *(5.9998487866413575, 1.818549938733748, 0.45541329964829563, 3.159529741805951),
    *(-9.268767992481754, 17.431184753381647, -15.583929636428092, 5.856747675543661),
)
# Chord over arc length below which both ends count as at one place, so that its direction does not
# matter: over a short chord ahead of a clamp the arc leaves against the clamp, and no guess of a
# weightless cable led to the circle.
ONE_POINT = 1e-2
# Maximum number of combinations of sides of the spans in a plane.
MOST_SIDES = 16
# Shares of the slack between two fixed arc lengths that the first of two spans gets; the first one
# stands for even shares.
SLACKS = (0.5, 0.15, 0.85)
# Half angle [rad] of an arc below which its sides are not distinguished.
TAUT = 0.3
# Some of these numbers by their names in C.
NUMBERS = {
    "FAR": FAR,
    "CURVED": CURVED,
    "LARGEST_BEND": LARGEST_BEND,
    "HALF_TURN": HALF_TURN,
    "TIE": TIE,
    "TAUT": TAUT,
    "ONE_POINT": ONE_POINT,
    "FED_SLACK": SLACK,
}


class GuessRow(NamedTuple):
    """A first guess: arcs from one holder to the next.

    Parameters
    ----------
    sides : (spans,)
        Of each arc: in a plane 0 along gravity and 1 against it; in space quarter turns from
        gravity about the chord.
    slack : int
        Index into SLACKS.
    rolled : bool
        In space: whether a roll of nearly half a turn at the end goes the other way round.
    """

    sides: tuple[int, ...]
    slack: int = 0
    rolled: bool = False


def guess_table(spans: int, in_space: bool, slides: bool) -> tuple[GuessRow, ...]:
    """First guesses of a cable of so many spans, in the order in which they are tried.

    In a plane all combinations of sides, or if there are more than MOST_SIDES those that differ in
    one span. In space all spans are on the same side. `slides`: whether there are eyelets, whose
    arc lengths the slack determines.
    """
    if in_space:
        alike = [GuessRow((quarter,) * spans) for quarter in range(4)]
        rolled = [row._replace(rolled=True) for row in alike]
        other = [alike[0]._replace(slack=k) for k in range(1, len(SLACKS)) if slides]
        return (*alike, *rolled, *other)
    single = [tuple(int(i == k) for i in range(spans)) for k in range(spans)]
    sides = [(0,) * spans, (1,) * spans, *single]
    if 2**spans <= MOST_SIDES:
        sides = list(product(range(2), repeat=spans))
    slacks = range(len(SLACKS) if slides else 1)
    return tuple(GuessRow(row, slack) for slack in slacks for row in sides)
