"""What was read, held against what is declared of it, before anything is fitted."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from dlo_casadi.config import Config
from dlo_casadi.errors import MeasurementError, counted
from dlo_casadi.rod.ends import reaction_rows
from dlo_casadi.session.coarse import coarse_fit, some, spread, tells_weight
from dlo_casadi.session.directions import wrong_directions
from dlo_casadi.session.exchanged_ends import ends_exchanged
from dlo_casadi.session.frames import clamp_axes
from dlo_casadi.session.hanging import hangs_elsewhere
from dlo_casadi.session.measure import line_without_end
from dlo_casadi.session.outcome import PoseInput
from dlo_casadi.session.plausibility import Lines, Suspicion, repeated, stretched, suspicions
from dlo_casadi.session.plausibility_of_readings import Compared, misread
from dlo_casadi.thresholds import FITS, OUT_OF_STEP

FloatArray = NDArray[np.floating]

NEVERTHELESS = (
    "If all this is as it should be: `estimation: {plausibility: false}` fits nevertheless."
)

# Points of a line between which its length is measured: noise makes a dense line longer.
_SPARSE = 60


def without_implausible(
    config: Config, inputs: Sequence[PoseInput]
) -> tuple[tuple[PoseInput, ...], list[str]]:
    """Leave out single poses that contradict the configuration.

    With the option `estimation.plausibility` off, all poses stay.

    Returns
    -------
    inputs : tuple of PoseInput
        Those left out have no points and say why.
    odd : list of str
        What looks like a mistake but stays.

    Raises
    ------
    MeasurementError
        If the measured lines of the session contradict the configuration beyond doubt, or if those
        of most poses do.
    """
    found = find_suspicions(config, inputs)
    if not config.estimation.plausibility:
        return tuple(inputs), [item.message for item in found]
    bad = {item.pose: item.message for item in found if item.pose}
    read = [item for item in inputs if len(item.points)]
    fit_left = [item for item in read if item.role == "fit" and item.name not in bad]
    refused = [item.message for item in found if item.certain]
    if not refused and bad and (2 * len(bad) > len(read) or not fit_left):
        refused = [
            f"the configuration is contradicted by {len(bad)} of {counted(len(read), 'pose')}:",
            *(f"  {message}" for message in bad.values()),
        ]
    if refused:
        raise MeasurementError("\n".join([*refused, NEVERTHELESS]))
    return tuple(
        PoseInput(
            item.name, item.role, np.zeros((0, 2)), problem=_reason(item.name, bad[item.name])
        )
        if item.name in bad
        else item
        for item in inputs
    ), [item.message for item in found if not item.pose]


def _reason(name: str, message: str) -> str:
    """What is said of a pose, without its name."""
    return message.removeprefix(name).lstrip(": ")


def find_suspicions(config: Config, inputs: Sequence[PoseInput]) -> tuple[Suspicion, ...]:
    """Everything in a session that looks like a mistake, by `plausibility`."""
    read = [item for item in inputs if len(item.points)]
    lines = lines_of(config, inputs)
    found = suspicions(lines)
    if not any(item.certain for item in found):
        doubtful = {item.pose for item in found}
        sound = [item for item in read if item.name not in doubtful]
        found += repeated([item.name for item in sound], [item.points for item in sound])
        marked = [(item.name, item.points, item.s) for item in sound if item.s is not None]
        found += stretched(marked, config.cable.length)
        found += wrong_directions(config, sound)
    if not any(item.certain for item in found):
        doubtful = {item.pose for item in found}
        sound = [item for item in read if item.name not in doubtful]
        found += _misread(config, sound)
        found += ends_exchanged(config, sound) or hangs_elsewhere(config, sound)
    return found


def _misread(config: Config, read: Sequence[PoseInput]) -> tuple[Suspicion, ...]:
    """Readings held against the forces that the shapes need, by a coarse fit of some poses."""
    declared = {pose.name: pose for pose in config.experiment.poses}
    fitted = [item for item in read if item.role == "fit" and not item.views]
    fitted = [item for item in fitted if declared[item.name].readings]
    shown = some(fitted)
    fit = coarse_fit(config, shown) if shown else None
    if fit is None:
        return ()
    seen = fit.problem.observed(fit.point.theta, fit.point.shapes)
    rows = reaction_rows(fit.model.node)
    compared = []
    for name, at in rows.items():
        side, kind = name.split("_")
        own = [k for k, item in enumerate(shown) if name in declared[item.name].readings]
        if not own:
            continue
        frames = None
        if getattr(fit.model, side) == "clamped":
            frames = np.array([clamp_axes(declared[shown[k].name], side) for k in own])
        forces = np.array([seen[k].readings[rows[f"{side}_force"]] for k in own])
        compared.append(
            Compared(
                name,
                np.array([declared[shown[k].name].readings[name] for k in own]),
                np.array([seen[k].readings[at] for k in own]),
                frames,
                forces if kind == "moment" else None,
            )
        )
    return misread(compared, sized=tells_weight(fit))


def lines_of(config: Config, inputs: Sequence[PoseInput]) -> Lines:
    """Measured lines beside their declared ends.

    A photograph is searched for a line between the declared ends, so that wrong ends may hide the
    line. Where several do not fit, the lines are searched for once more without their ends.
    """
    poses = config.experiment.poses
    points = {item.name: item.points for item in inputs if len(item.points)}
    known = {item.name: item.s for item in inputs if item.s is not None}
    lines = _lines(config, points, known)
    if config.experiment.boundary.end != "free":
        fits = lines.misfit(lines.measured, lines.declared) < OUT_OF_STEP
        sound = {name for name, ok in zip(lines.names, fits, strict=True) if ok}
        doubtful = [pose for pose in poses if pose.name not in sound and pose.paths[0].is_file()]
        if len(doubtful) > 1:
            again = {pose.name: line_without_end(config, pose) for pose in doubtful}
            points |= {name: line for name, line in again.items() if line is not None}
            lines = _lines(config, points, known)
    return lines


def _lines(config: Config, points: dict[str, FloatArray], known: dict[str, FloatArray]) -> Lines:
    """Ends and lengths of lines (K, d), some of them markers at known arc lengths (K,)."""
    length = config.cable.length
    poses = [pose for pose in config.experiment.poses if pose.name in points]
    d = len(config.experiment.gravity)
    unknown, whole = (np.nan,) * d, np.array([0.0, length])
    spans = np.array([known.get(pose.name, whole)[[0, -1]] for pose in poses]).reshape(-1, 2)
    measured = np.array(
        [
            np.linalg.norm(
                np.diff(points[p.name][spread(len(points[p.name]), _SPARSE)], axis=0), axis=1
            ).sum()
            for p in poses
        ]
    ).reshape(-1)
    unseen = [0.0 if pose.name in known else _unseen(points[pose.name], length) for pose in poses]
    # A single marker has no length.
    share = np.where(spans[:, 1] > spans[:, 0], np.diff(spans)[:, 0], np.inf) / length
    return Lines(
        tuple(pose.name for pose in poses),
        np.array([(pose.start, pose.end or unknown) for pose in poses]).reshape(-1, 2, d),
        np.array([points[pose.name][[0, -1]] for pose in poses]).reshape(-1, 2, d),
        measured / share,
        length,
        np.abs(spans - whole) + np.array(unseen).reshape(-1, 1),
        np.array([pose.name in known for pose in poses], dtype=bool),
    )


def _unseen(points: FloatArray, length: float) -> float:
    """Arc length [m] that points (K, 2) far apart leave to either side of them.

    Zero where they are closer: the line then goes on to its fixture, up to what hides it.
    """
    steps = np.linalg.norm(np.diff(points, axis=0), axis=1)
    apart = float(np.median(steps)) if len(steps) else length
    return max(length - float(steps.sum()), 0.0) if apart > FITS * length else 0.0
