"""Find mistakes about clamps: their declared directions."""

import numpy as np

from dlo_casadi.errors import counted
from dlo_casadi.session.axes import listed
from dlo_casadi.session.compared_clamps import Clamps, ShownDirection, shown_directions
from dlo_casadi.session.mistakes import DIRECTIONS
from dlo_casadi.session.questions import Alternatives, Suspicion
from dlo_casadi.session.read_session import ReadSession
from dlo_casadi.thresholds import HEADING_OFF, NEARLY_ALL

_RULE = {
    "heading": "headings in radians, counter-clockwise from x, along the cable",
    "orientation": "unit quaternions [qx, qy, qz, qw], x along the cable; start and end exchanged",
}
# The misfit [rad] is the angle that nearly all clamps keep.
_MEANT = Alternatives(
    DIRECTIONS,
    lambda clamps: float(np.quantile([item.off for item in clamps.shown], NEARLY_ALL)),
    enough=HEADING_OFF / 2,
    near=1.0,
)


def wrong_directions(session: ReadSession) -> tuple[Suspicion, ...]:
    """Headings and orientations that the lines contradict, in single poses or in most of them."""
    found: list[Suspicion] = []
    common: tuple[ShownDirection, ...] = ()
    for side in ("start", "end"):
        clamps = Clamps(tuple(shown_directions(session, side)))
        wrong, count = clamps.wrong, len(clamps.shown)
        if wrong and (2 * len(wrong) > count or (len(wrong) > 1 and _MEANT.likeliest(clamps))):
            common += clamps.shown
            continue
        alone = ((item, _try(Clamps((item,)))) for item in wrong)
        found += [Suspicion.of_pose(item.name, f"{item}{cure}") for item, cure in alone]
    if common:
        both = Clamps(common)
        first, keys = both.wrong[0], list(dict.fromkeys(item.key for item in common))
        text = (
            f"{' and '.join(keys)} contradict{'s' * (len(keys) == 1)} {len(both.wrong)} of "
            f"{counted(len(common), 'line')}. {first.name}: {first}{_try(both)}"
        )
        # A frame is certainly wrong only where another reading of its value explains the lines.
        certain = both.kind == "heading" or _MEANT.likeliest(both) is not None
        found.insert(0, Suspicion(text, certain))
    return tuple(found)


def _try(clamps: Clamps) -> str:
    """What to try, taken from the first pose that is wrong."""
    found = _MEANT.likeliest(clamps) or _MEANT.likeliest(Clamps(clamps.wrong[:1]))
    if found is None:
        return f". Try: {_RULE[clamps.kind]}."
    meant = found.meant.shown[[x.wrong for x in found.was.shown].index(True)]
    return f". Try: {found.said()} then {listed(meant.value, '.4g')}."
