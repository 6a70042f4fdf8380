"""Compare what was read with what is declared: the list of questions, and those about shapes.

A question compares the session with hypotheses on what the user may have meant. Questions about
units, frames and the order of files are in `ends`, those about directions in `clamps`, those about
readings in `readings`. This file has two more that quick fits of a few poses decide: exchanged
ends, and gravity.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from itertools import product
from typing import NamedTuple

import numpy as np

from dlo_casadi.arrays import FloatArray
from dlo_casadi.config import Config, Pose
from dlo_casadi.errors import MeasurementError, counted
from dlo_casadi.model.cable_model import BENDING_STIFFNESS
from dlo_casadi.session.clamps import wrong_directions
from dlo_casadi.session.clips import wrong_clips
from dlo_casadi.session.coarse_fit import POSES, Coarse, coarse_fit
from dlo_casadi.session.ends import ENDS, POINTS
from dlo_casadi.session.hypotheses import (
    Hypothesis,
    ReadSession,
    Suspicion,
    clamp_axes,
    exchanges,
    listed,
    named,
    shown_pull,
)
from dlo_casadi.session.outcome import PoseInput
from dlo_casadi.session.readings import wrong_readings, wrong_without_shapes
from dlo_casadi.thresholds import (
    BEYOND_EFFECTS,
    EVIDENCE_APART,
    FITS,
    HEADING_OFF,
    MUCH_BETTER,
    NEIGHBOURS_ALIKE,
    UNEXPLAINED,
)

NEVERTHELESS = (
    "If all this is as it should be: `estimation: {plausibility: false}` fits nevertheless, in "
    'Python estimation={"plausibility": False}.'
)
# Poses that decide whether ends are exchanged: two of them show a misfit of a twentieth of L. Poses
# that decide on gravity: in 60 simulated sessions in space five named a wrong one in 28, eight in
# 25, both doubted the right one in 5 or 6; five take 0.63 of the time.
_FEW, _HANGING = 2, 5
# Gravity on Earth [m/s^2].
EARTH = 9.81
# What is exchanged -> the pose's keys.
_EXCHANGED = {
    "start and end exchanged": ("",),
    "start and end exchanged, and their directions": ("", "_heading", "_orientation"),
}


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
    found: tuple[Suspicion, ...] = ()
    if not session.lines.names:
        alone = [item.name for item in inputs if item.unseen]
        return wrong_without_shapes(config, alone) if alone else found
    for questions in QUESTIONS:
        for alternatives in questions:
            found += next(filter(None, (ask(session) for ask in alternatives)), ())
        if any(item.certain for item in found):
            break
        session = session.without(*(item.pose for item in found))
    return found


# ---- comparisons ---------------------------------------------------------------------------------


class Comparison(NamedTuple):
    """The declared session and the hypothesis `what` that explains its shapes best, both fitted.

    `length` [m]: of the cable.
    """

    what: str
    own: Coarse
    other: Coarse
    length: float

    @property
    def told(self) -> str:
        """Describe the residuals of both."""
        left = f"the lines are {self.own.rms:.3g} m RMS from the fitted shapes, but"
        if self.own.fit is None:
            left = "no equilibria were found near the lines, but they are within"
        return f"{left} {self.other.rms:.3g} m with {self.what}"

    @property
    def better(self) -> bool:
        """Whether the declaration leaves more than noise, and the hypothesis clearly less.

        If the declaration has no fit, the hypothesis must determine a weight: a fit of few points
        may fail by chance.
        """
        if self.own.fit is None and not self.other.weight:
            return False
        own, other = self.own.rms, self.other.rms
        return own > UNEXPLAINED * self.length and other < MUCH_BETTER * own

    @property
    def certain(self) -> bool:
        """Whether no missing effect could be meant instead.

        The hypothesis is clearly better and explains shapes that are farther off than effects
        leave them; or it is the opposite gravity, only it shows a weight, and noise alone is left.
        """
        own, other = self.own.rms / self.length, self.other.rms / self.length
        if other >= UNEXPLAINED:
            return False
        if self.better and own > BEYOND_EFFECTS:
            return True
        noise_alone = self.other.correlation < NEIGHBOURS_ALIKE
        return self.shows_weight and self.upside_down and noise_alone

    @property
    def upside_down(self) -> bool:
        """Whether the hypothesis is the opposite gravity.

        Gravity across the declared one may be that of a cable that is curved at rest.
        """
        if self.own.fit is None or self.other.fit is None:
            return False
        return np.allclose(self.own.fit.model.gravity, -np.array(self.other.fit.model.gravity))

    @property
    def shows_weight(self) -> bool:
        """Whether only the hypothesis determines a weight, explains the shapes, and fits better.

        If gravity points the wrong way, the best fit is a cable too stiff to show any weight.
        """
        own, other = self.own, self.other
        if other.fit is None or not other.weight or own.weight:
            return False
        # Difference in log likelihood of two models with equally many unknowns.
        evidence = other.fit.problem.n_residuals * np.log(own.rms / other.rms)
        return bool(other.rms < BEYOND_EFFECTS * self.length and evidence > EVIDENCE_APART)


def compare(
    session: ReadSession, hypotheses: Sequence[Hypothesis[ReadSession]], most: int = POSES
) -> Comparison | None:
    """Fit the declared session, then hypotheses until one explains everything; return the best.

    At most `most` poses are used. None if there is no hypothesis, or if the declared session
    explains its shapes and weight.
    """
    length = session.config.cable.length
    own = coarse_fit(session, most) if hypotheses else None
    if own is None or (own.weight and own.rms <= UNEXPLAINED * length):
        return None
    tried = []
    for way in hypotheses:
        tried.append(Comparison(way.said, own, coarse_fit(way.meant, most), length))
        if tried[-1].certain:
            break
    return min(tried, key=lambda found: found.other.rms)


# ---- exchanged ends -----------------------------------------------------------------------------


def ends_exchanged(session: ReadSession) -> tuple[Suspicion, ...]:
    """Whether lines that leave both clamps backwards fit with start and end exchanged.

    Sparse points do not show the directions at clamps; the vectors from clamp to first point do.
    """
    boundary = session.config.experiment.boundary
    if not (len(session.read) and boundary.start.direction and boundary.end.direction):
        return ()
    own = _off(session)
    if own < np.pi / 2:
        return ()
    meant = [Hypothesis(what, _exchanged(session, keys)) for what, keys in _EXCHANGED.items()]
    found = compare(session, [item for item in meant if _off(item.meant) < HEADING_OFF], _FEW)
    if found is None or not found.better:
        return ()
    text = (
        f"the lines leave their clamps {np.degrees(own):.0f} degrees (median) off the declared "
        f"directions; {found.told}. Try: start where the cable begins, and headings or x axes "
        "along the cable from start to end, at both clamps."
    )
    return (Suspicion(text, found.certain),)


def _exchanged(session: ReadSession, keys: Sequence[str]) -> ReadSession:
    """The session with start and end exchanged: lines then begin where they ended."""
    pairs = [(f"start{key}", f"end{key}") for key in keys]
    both = [*pairs, *((b, a) for a, b in pairs)]
    poses = tuple(
        pose.changed(**{a: getattr(pose, b) for a, b in both})
        for pose in session.config.experiment.poses
    )
    read = (x if x.s is not None else replace(x, points=x.points[::-1]) for x in session.read)
    return replace(session, read=tuple(read)).with_experiment(poses=poses)


def _off(session: ReadSession) -> float:
    """Median angle [rad] between a clamp's axis and the vector to the point nearest to it."""
    cosines = []
    for item, (side, first, sign) in product(session.read, (("start", 0, 1), ("end", -1, -1))):
        pose = session.declared[item.name]
        way = sign * (item.points[first] - getattr(pose, side))
        axes = clamp_axes(pose, side)
        assert axes is not None
        cosines.append(float(way @ axes[:, 0]) / max(float(np.linalg.norm(way)), 1e-300))
    return float(np.arccos(np.clip(np.median(cosines), -1.0, 1.0)))


# ---- gravity ------------------------------------------------------------------------------------


def hangs_elsewhere(session: ReadSession) -> tuple[Suspicion, ...]:
    """Whether the shapes fit only with gravity rotated, or with the points mirrored.

    Nothing is fitted where the lines seem to be pulled along gravity.
    """
    gravity = np.array(session.config.experiment.gravity)
    if not len(session.read):
        return ()
    pull = shown_pull(session)
    if pull is not None and gravity.any() and _angle(pull, gravity) < HEADING_OFF:
        return ()
    found = compare(session, list(_other_gravity(session, pull)), _HANGING)
    if found is None or not (found.better or found.shows_weight):
        return ()
    weightless = ""
    if found.own.fit is not None and not found.own.weight:
        least = found.own.fit.value(BENDING_STIFFNESS)
        weightless = (
            f"the lines show no weight, as if bending_stiffness were {least:.2g} N m^2 or more; "
        )
    up = f"{[*np.zeros(len(gravity) - 1).tolist(), -9.81]} with {'xyz'[len(gravity) - 1]} up"
    text = (
        f"the cable does not hang along gravity ({listed(gravity + 0.0, 'g')}) m/s^2: {weightless}"
        f"{found.told}. Try: points, start, end and gravity in one frame, such as gravity: {up}."
        + ("" if found.certain else " A strap that lifts the cable would look the same.")
    )
    return (Suspicion(text, found.certain),)


def _other_gravity(
    session: ReadSession, pull: FloatArray | None
) -> Iterator[Hypothesis[ReadSession]]:
    """Hypotheses: gravity along other axes; points with exchanged or mirrored axes, ends kept.

    Only those whose gravity agrees with the pull on the lines; all if the lines show no pull.
    """
    experiment, length = session.config.experiment, session.config.cable.length
    gravity = np.array(experiment.gravity)
    weightless = not gravity.any()
    if weightless:
        gravity = EARTH * np.eye(len(gravity))[-1]
    frames = [
        axes for axes in exchanges(len(gravity)) if _angle(pull, gravity @ axes) < HEADING_OFF
    ]
    tried = [] if weightless else [gravity]
    for way in (gravity @ axes for axes in frames):
        if not any(np.allclose(way, other) for other in tried):
            tried.append(way)
            meant = session.with_experiment(gravity=tuple(way.tolist()))
            yield Hypothesis(f"gravity ({listed(way + 0.0, 'g')}) m/s^2", meant)
    if weightless or not experiment.boundary.directed:
        return  # between pins, rotating the points equals rotating gravity
    kept = [_kept_by_turning(session.declared[item.name], length) for item in session.read]
    for axes in frames:
        if np.allclose(axes, np.eye(len(gravity))):
            continue
        if all(np.abs(held @ axes.T - held).max() < FITS for held in kept):
            starts = [np.array(session.declared[item.name].start) for item in session.read]
            read = tuple(
                replace(item, points=(item.points - start) @ axes.T + start)
                for item, start in zip(session.read, starts, strict=True)
            )
            yield Hypothesis(named(axes), replace(session, read=read))


def _kept_by_turning(pose: Pose, length: float) -> FloatArray:
    """Vectors (n, d) that a rotation of a pose must keep: end minus start [lengths], and clamps."""
    kept: list[FloatArray] = [np.zeros(len(pose.start))]
    if pose.end is not None:
        kept.append((np.array(pose.end) - pose.start) / length)
    axes = [clamp_axes(pose, side) for side in ("start", "end")]
    kept += [own[:, 0] for own in axes if own is not None]
    return np.array(kept)


def _angle(pull: FloatArray | None, way: FloatArray) -> float:
    """Angle [rad] between a direction and the pull that lines show; zero if they show none."""
    if pull is None:
        return 0.0
    cosine = float(pull @ way) / float(np.linalg.norm(pull) * np.linalg.norm(way))
    return float(np.arccos(np.clip(cosine, -1.0, 1.0)))


# Groups of functions from a session to suspicions. In a group of alternatives only the first that
# finds anything counts. A certain finding ends the search after its group; poses in doubt are left
# out of the next group.
Question = Callable[[ReadSession], tuple[Suspicion, ...]]
QUESTIONS: tuple[tuple[tuple[Question, ...], ...], ...] = (
    (ENDS,),
    (*((ask,) for ask in POINTS), (wrong_directions,), (wrong_clips,)),
    ((wrong_readings,), (ends_exchanged, hangs_elsewhere)),
)
