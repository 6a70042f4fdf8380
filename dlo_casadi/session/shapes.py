"""Find mistakes that quick fits of a few poses decide: exchanged ends, and gravity."""

from dataclasses import dataclass

import numpy as np

from dlo_casadi.session.compared_shapes import Comparison, FittedSession
from dlo_casadi.session.mistakes import EXCHANGED_ENDS, GRAVITY
from dlo_casadi.session.questions import Alternatives, Explanation, Suspicion
from dlo_casadi.session.read_session import ReadSession
from dlo_casadi.thresholds import UNEXPLAINED

# Poses that decide whether ends are exchanged: two of them show a misfit of a twentieth of L. Poses
# that decide on gravity: in 60 simulated sessions in space five named a wrong one in 28, eight in
# 25, both doubted the right one in 5 or 6; five take 0.63 of the time.
_FEW, _HANGING = 2, 5


def compared(found: Explanation[FittedSession]) -> Comparison:
    """The quick fits of what was declared and of what may be meant."""
    length = found.was.session.config.cable.length
    return Comparison(found.said(), found.was.coarse, found.meant.coarse, length)


@dataclass(frozen=True)
class _Fits(Alternatives[FittedSession]):
    """Whether quick fits leave more than noise [m], and clearly less of what may be meant.

    All rows are fitted, until one is certain. With `weight` those explain, too, that alone show it.
    """

    weight: bool = False

    def contradicted(self, thing: FittedSession, own: float) -> bool:
        left = own > UNEXPLAINED * thing.session.config.cable.length
        return thing.tells and (left or not thing.coarse.weight)

    def explains(self, found: Explanation[FittedSession]) -> bool:
        comparison = compared(found)
        return comparison.better or (self.weight and comparison.shows_weight)

    def conclusive(self, found: Explanation[FittedSession]) -> bool:
        return compared(found).certain

    def suspicion(self, found: Explanation[FittedSession]) -> Suspicion:
        comparison = compared(found)
        strap = " A strap that lifts the cable would look the same."
        doubt = strap * (self.weight and not comparison.certain)
        return Suspicion(
            self.words.format(was=found.was, told=comparison.told) + doubt, comparison.certain
        )


_ENDS = _Fits(
    EXCHANGED_ENDS,
    lambda fitted: fitted.coarse.rms,
    near=1.0,
    words="the lines leave their clamps {was.off_clamps_degrees:.0f} degrees (median) off the "
    "declared directions; {told}. Try: start where the cable begins, and headings or x axes along "
    "the cable from start to end, at both clamps.",
)
_GRAVITY = _Fits(
    GRAVITY,
    lambda fitted: fitted.coarse.rms,
    near=1.0,
    words="the cable does not hang along gravity ({was.gravity_listed}) m/s^2: {was.weightless}"
    "{told}. Try: points, start, end and gravity in one frame, such as gravity: {was.upright}.",
    weight=True,
)


def ends_exchanged(session: ReadSession) -> tuple[Suspicion, ...]:
    """Whether lines that leave both clamps backwards fit with start and end exchanged.

    Sparse points do not show the directions at clamps; the vectors from clamp to first point do.
    """
    boundary, thing = session.config.experiment.boundary, FittedSession(session, _FEW)
    directed = boundary.start.direction and boundary.end.direction
    if not (len(session.read) and directed and thing.off_clamps >= np.pi / 2):
        return ()
    return _ENDS.suspicions([thing] * any(row.meant(thing) for row in EXCHANGED_ENDS))


def hangs_elsewhere(session: ReadSession) -> tuple[Suspicion, ...]:
    """Whether the shapes fit only with gravity rotated, or with the points mirrored.

    Nothing is fitted where the lines seem to be pulled along gravity.
    """
    thing = FittedSession(session, _HANGING)
    if not len(session.read):
        return ()
    hangs = thing.pull is not None and thing.gravity.any() and thing.pulled_along(thing.gravity)
    return _GRAVITY.suspicions([thing] * (not hangs))
