"""Statuses of the C solver: one table for its header, its messages and Python."""

from typing import NamedTuple

from dlo_casadi.config import Pose
from dlo_casadi.equilibrium.pose import HeldPose


class Status(NamedTuple):
    """A status of the C solver: its word, its sentence, more of it for the header, and advice."""

    word: str
    sentence: str
    more: str = ""
    advice: str = ""


_STATUSES = (
    Status("ok", "stable equilibrium", "end condition and balance were checked"),
    Status(
        "unreachable",
        "the end is farther away than the cable is long",
        advice="is the end in metres?",
    ),
    Status(
        "iteration_limit",
        "no equilibrium found from any first guess",
        advice="warm: the shape of a pose nearby.",
    ),
    Status(
        "not_finite",
        "a number is not finite",
        "of the pose or the warm start, or on the way",
        "finite numbers for start, end and directions.",
    ),
    Status(
        "unstable",
        "only equilibria that are no minimum of the energy",
        advice="another branch, or a pose nearby.",
    ),
    Status("workspace_too_small", "the workspace is too small", "work_size < DLO_WORKSPACE_SIZE"),
    Status(
        "bad_argument",
        "a null pointer, an unknown branch, no equilibrium or clips out of order",
        "e.g. of a pose that has none, two clips in one element, a heading beyond 1e6 rad",
        "in space a pose without a branch, orientations that are not zero, clips in their order "
        "and not two in one element, a warm start whose status is ok.",
    ),
    Status(
        "other_branch",
        "only equilibria on the other branch",
        advice="the other branch, or none: the equilibria that were found turn the other way.",
    ),
    Status(
        "turns_shed",
        "the turns of twist are shed over a loop",
        advice="fewer turns, or the end farther from the start.",
    ),
    Status(
        "no_room",
        "a fixture is inside of an obstacle",
        advice="the obstacles' places: a fixture is inside of one.",
    ),
    Status(
        "no_step",
        "no step in time was found",
        "the ends are torn apart, or the step is too long",
        "a shorter step, or fixtures within the cable's reach that do not jump.",
    ),
)
# Words by the values of dlo_status.
STATUSES = tuple(status.word for status in _STATUSES)


def _enum() -> str:
    """The values of dlo_status for the header."""
    lines = [
        f"    DLO_{one.word.upper()} = {k}, /* {one.sentence}{one.more and '; '}{one.more} */"
        for k, one in enumerate(_STATUSES)
    ]
    return "\n".join([*lines[:-1], lines[-1].replace(", /*", " /*", 1)])


def _messages() -> str:
    """Cases of dlo_message."""
    return "\n".join(
        f'    case DLO_{one.word.upper()}: return "{one.sentence}";' for one in _STATUSES
    )


# Text parts of the templates, by mark.
STATUS_TEXTS = {"STATUSES": _enum(), "MESSAGES": _messages()}


def no_equilibrium(status: str, pose: Pose | HeldPose, length: float) -> str:
    """Message for a status other than ok."""
    places = (() if place is None else place for place in (pose.start, pose.end))
    start, end = (", ".join(f"{x:.4f}" for x in place) for place in places)
    hint = next(one.advice for one in _STATUSES if one.word == status)
    return (
        f"no equilibrium: {status} with the end {f'at ({end}) m' if end else 'free'}, the start at "
        f"({start}) m; the cable is {length:.4f} m long." + (f"\n  Try: {hint}" if hint else "")
    )
