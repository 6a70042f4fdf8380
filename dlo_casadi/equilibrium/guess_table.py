"""The table of first guesses of a cable by spans: Python and the generated C read it."""

from itertools import product
from typing import NamedTuple

# Maximum number of combinations of sides of the spans in a plane.
MOST_SIDES = 16
# Shares of the slack between two fixed arc lengths that the first of two spans gets; the first one
# stands for even shares.
SLACKS = (0.5, 0.15, 0.85)
# Half angle [rad] of an arc below which its sides are not distinguished.
TAUT = 0.3


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
