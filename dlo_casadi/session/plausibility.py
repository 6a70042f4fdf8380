"""Compare what was read with what is declared: the list of questions, and what they refuse.

What users may have meant is a row each in `mistakes`; `questions` compares the rows. What is
compared: units, frames and the order of files in `ends`, directions in `clamps`, places in `clips`,
forces in `readings`, quick fits of the shapes in `shapes`.
"""

from collections.abc import Callable, Sequence

from dlo_casadi.config import Config
from dlo_casadi.errors import MeasurementError, counted
from dlo_casadi.session.clamps import wrong_directions
from dlo_casadi.session.clips import wrong_clips
from dlo_casadi.session.ends import ENDS, POINTS
from dlo_casadi.session.outcome import PoseInput
from dlo_casadi.session.questions import Suspicion
from dlo_casadi.session.read_session import ReadSession
from dlo_casadi.session.readings import wrong_readings, wrong_without_shapes
from dlo_casadi.session.shapes import ends_exchanged, hangs_elsewhere
from dlo_casadi.thresholds import FITTED_READINGS

NEVERTHELESS = (
    "If all this is as it should be: `estimation: {plausibility: false}` fits nevertheless, in "
    'Python estimation={"plausibility": False}.'
)


def without_implausible(
    config: Config, inputs: Sequence[PoseInput]
) -> tuple[tuple[PoseInput, ...], list[str]]:
    """Leave out single poses that contradict the configuration.

    With `estimation.plausibility` off, all poses stay.

    Returns
    -------
    inputs : tuple of PoseInput
        Poses left out have no points but a reason.
    odd : list of str
        Likely mistakes that stay in the session.

    Raises
    ------
    MeasurementError
        If the measured lines of the session, or of most of its poses, contradict the configuration
        beyond doubt.
    """
    found = find_suspicions(config, inputs)
    if not config.estimation.plausibility:
        return tuple(inputs), [item.message for item in found]
    if refused := contradictions(found, inputs):
        raise MeasurementError("\n".join([*refused, NEVERTHELESS]))
    bad = {item.pose: item.message for item in found if item.pose}
    kept = list(inputs)
    for k, item in enumerate(inputs):
        if item.name in bad:
            reason = bad[item.name].removeprefix(item.name).lstrip(": ")
            kept[k] = PoseInput.unread(config, item, reason)
    return tuple(kept), [item.message for item in found if not item.pose]


def contradictions(found: Sequence[Suspicion], inputs: Sequence[PoseInput]) -> list[str]:
    """Why a session is refused: what is certain, or doubts in most poses or in all to be fitted."""
    bad = {item.pose: item.message for item in found if item.pose}
    # Poses that could not be read may contradict the configuration, too.
    judged = bad.keys() | {item.name for item in inputs if len(item.points)}
    read = [item for item in inputs if len(item.points)]
    fit_left = [item for item in read if item.role == "fit" and item.name not in bad]
    refused = [item.message for item in found if item.certain]
    if not refused and bad and (2 * len(bad) > len(judged) or not fit_left):
        refused = [
            f"the configuration is contradicted by {len(bad)} of {counted(len(judged), 'pose')}:",
            *(f"  {message}" for message in bad.values()),
        ]
    return refused


def find_suspicions(config: Config, inputs: Sequence[PoseInput]) -> tuple[Suspicion, ...]:
    """Everything in a session that looks like a mistake, see `QUESTIONS`."""
    session = ReadSession(config, tuple(item for item in inputs if len(item.points)))
    alone, shown = [item.name for item in inputs if item.unseen], bool(session.lines.names)
    asked = len(alone) >= (FITTED_READINGS if shown else 1)
    found = wrong_without_shapes(config, alone) if asked else ()
    if not shown:
        return found
    for questions in QUESTIONS:
        for alternatives in questions:
            found += next(filter(None, (ask(session) for ask in alternatives)), ())
        if any(item.certain for item in found):
            break
        session = session.without(*(item.pose for item in found))
    return found


# Groups of functions from a session to suspicions. In a group of alternatives only the first that
# finds anything counts. A certain finding ends the search after its group; poses in doubt are left
# out of the next group.
Question = Callable[[ReadSession], tuple[Suspicion, ...]]
QUESTIONS: tuple[tuple[tuple[Question, ...], ...], ...] = (
    (ENDS,),
    (*((ask,) for ask in POINTS), (wrong_directions,), (wrong_clips,)),
    ((wrong_readings,), (ends_exchanged, hangs_elsewhere)),
)
