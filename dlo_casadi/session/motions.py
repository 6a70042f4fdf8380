"""Read the recordings of the moving cable that a configuration names, and check them."""

from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

from dlo_casadi.arrays import FloatArray
from dlo_casadi.config import Config, Motion
from dlo_casadi.errors import ConfigError, MeasurementError, counted
from dlo_casadi.io.motions import (
    FixtureTrack,
    MotionPoints,
    fixture_track,
    motion_points,
    read_fixtures,
)
from dlo_casadi.io.motions import read_motion as read_points
from dlo_casadi.rod.chain import ELEMENTS
from dlo_casadi.runtime.progress import Step, nobody
from dlo_casadi.sensing.measured_motion import MeasuredMotion
from dlo_casadi.session.moving_lines import (
    Place,
    check_gaps,
    check_lines,
    marks_of_lines,
    read_video,
    without_jumps,
)
from dlo_casadi.vision import VIDEO_ENDINGS

# Time [s] that fixtures may be recorded less than the points: they are taken to rest there. Clocks
# that started by hand differ by more, and are another zero, not a delay.
UNCOVERED = 0.2


def read_motions(config: Config, step: Step = nobody) -> tuple[MeasuredMotion, ...]:
    """Read all motions.

    Raises
    ------
    ConfigError
        If the session has a part that motion does not know.
    MeasurementError
        If one of them cannot be a recording of the declared cable; the message names the file, the
        line and what to try.
    """
    motions, found = config.experiment.motions, []
    if motions:
        check_known(config)
    for k, motion in enumerate(motions):
        step(f"read {motion.shown_by}", k, len(motions))
        try:
            found.append(read_motion(config, motion))
        except MeasurementError as error:
            named = error.pose or motion.shown_by
            raise MeasurementError(error.message.removeprefix(f"{named}: "), named) from None
    return tuple(found)


def check_known(config: Config) -> None:
    """Refuse what a moving cable cannot have yet."""
    experiment, what = config.experiment, ""
    if experiment.clips:
        what = "clips"
    elif experiment.obstacles:
        what = "obstacles"
    elif experiment.boundary.start.slides or experiment.boundary.end.slides:
        what = "an end that slides"
    elif not ELEMENTS[config.model.element].smooth:
        what = f"elements of the kind {config.model.element}"
    if what:
        text = f"experiment.motions: a session with {what} has no motions yet"
        raise ConfigError(f"{text}.\n  Try: a session of its own for the motions", config.path)


def read_motion(config: Config, motion: Motion, most: int | None = None) -> MeasuredMotion:
    """Read one motion; `most`: frames of a video, by default all. Raises as `read_motions` does."""
    track = _track(config, motion)
    resting = _resting(config, motion, track)
    place = partial(_place, track, resting)
    points, note = _points(config, motion, place, most)
    across = None
    if points.s is None:
        points, across = marks_of_lines(points, place, config.cable.length)
        if note:
            points, note = without_jumps(points, config.cable.length, note)
            if most is None:
                check_gaps(points, note)
        else:
            check_lines(points, config.cable.length)
    origin = points.t[0]
    points, track = replace(points, t=points.t - origin), replace(track, t=track.t - origin)
    if track.values:
        _check_covered(points, track, motion)
    assert points.s is not None
    read = MeasuredMotion(
        motion.name,
        points.t,
        points.points,
        points.s,
        track.t,
        track.values,
        resting,
        at_rest=motion.begins == "at_rest",
        held_out=motion.role == "held_out",
        across=across,
        note=note,
    )
    _check_reach(config, read)
    return read


def _place(
    track: FixtureTrack, resting: Mapping[str, FloatArray], side: str, times: FloatArray
) -> FloatArray | None:
    """Places (T, d) [m] of a fixture at times [s] of its clock; None if it holds no place."""
    if side in track.values:
        rows = track.values[side].T
        return np.stack([np.interp(times, track.t, row) for row in rows], axis=1)
    known = resting.get(side)
    return None if known is None else np.broadcast_to(known, (len(times), len(known)))


def _points(
    config: Config, motion: Motion, place: Place, most: int | None
) -> tuple[MotionPoints, str]:
    """The points, and what was left out of them."""
    length, dimension = config.cable.length, len(config.experiment.gravity)
    if motion.file is not None:
        file = _existing(motion.file)
        if file.suffix.lower() in VIDEO_ENDINGS:
            return read_video(config, file, place, most)
        return read_points(file, dimension, length), ""
    points = np.array(motion.points)
    if points.shape[1] != dimension:
        text = f"points have {points.shape[1]} coordinates, gravity has {dimension}"
        raise MeasurementError(f"{text}: a cable in a plane has two, in space three")
    s = None if motion.at is None else np.array(motion.at)
    return motion_points(np.array(motion.t), points, s, length), ""


def _track(config: Config, motion: Motion) -> FixtureTrack:
    given = motion.fixtures
    if given is None:
        return FixtureTrack(np.zeros(0), {})
    if isinstance(given, Path):
        return read_fixtures(_existing(given), len(config.experiment.gravity))
    values = {key: np.array(x) for key, x in given.declared.items() if key != "t"}
    for key, x in values.items():
        if len(x) != len(given.t):
            text = f"fixtures: {counted(len(given.t), 'time')}, but {len(x)} of {key}"
            raise MeasurementError(f"{text}: one for each time")
    return fixture_track(np.array(given.t), values)


def _existing(file: Path) -> Path:
    if not file.is_file():
        raise MeasurementError(
            f"{file} does not exist; files are found relative to the YAML, from Python relative to "
            "the working directory",
            pose=file.name,
        )
    return file


def _check_covered(points: MotionPoints, track: FixtureTrack, motion: Motion) -> None:
    """Refuse fixtures that were recorded at other times than the points."""
    early, late = track.t[0] - points.t[0], points.t[-1] - track.t[-1]
    if max(early, late) > UNCOVERED:
        text = (
            f"the fixtures were recorded from {track.t[0]:.3f} to {track.t[-1]:.3f} s after the "
            f"first point, the points until {points.t[-1]:.3f} s"
        )
        name = motion.fixtures.name if isinstance(motion.fixtures, Path) else "fixtures"
        raise MeasurementError(
            f"{text}.\n  Try: the same zero of both clocks; leave out points without fixtures",
            pose=name,
        )


def _resting(config: Config, motion: Motion, track: FixtureTrack) -> dict[str, FloatArray]:
    """What is held and rests, by the names of a pose's fields."""
    held, space = config.experiment.boundary, config.experiment.in_space
    moved = track.values
    resting: dict[str, FloatArray] = {}
    for side in ("start", "end"):
        kind = getattr(held, side)
        turned = f"{side}_{'orientation' if space else 'heading'}"
        for field, asked in ((side, kind.place), (turned, kind.direction)):
            declared = getattr(motion, field)
            if field in moved and not asked:
                raise MeasurementError(f"the fixtures move {field}, which a {kind} {side} has not")
            if declared is not None and field in moved:
                text = f"{field} rests by the session and moves by the fixtures"
                raise MeasurementError(f"{text}: one of them belongs here")
            if declared is None and asked and field not in moved:
                raise MeasurementError(
                    f"a {kind} {side} needs its {field}: in the motion where it rests, in the file "
                    "of the fixtures where it moves"
                )
            if declared is not None:
                if not asked:
                    raise MeasurementError(f"a {kind} {side} has no {field}")
                resting[field] = np.array(declared, dtype=float)
    return resting


def _check_reach(config: Config, read: MeasuredMotion) -> None:
    """Refuse ends, or markers, that are farther apart than the cable between them is long."""
    length, slack = config.cable.length, 3 * config.experiment.tolerances.end
    std = config.experiment.measurement.std or 0.0
    t, s = read.t, read.s
    place = partial(_place, FixtureTrack(read.fixtures_t, dict(read.moving)), read.resting)
    times = read.fixtures_t if read.moving else t
    first, last = place("start", times), place("end", times)
    if first is not None and last is not None:
        apart = np.linalg.norm(last - first, axis=1)
        k = int(apart.argmax())
        if apart[k] > length + slack:
            raise MeasurementError(
                f"at {times[k]:.3f} s the ends are {apart[k]:.4g} m apart; the cable is "
                f"{length:.4g} m long. Are the fixtures in metres?"
            )
    for side, along in (("start", s), ("end", length - s)):
        fixture = place(side, t)
        if fixture is None:
            continue
        beyond = np.linalg.norm(read.points - fixture[:, None], axis=2) - along
        beyond = np.where(np.isfinite(beyond), beyond, -np.inf)
        k, j = (int(i) for i in np.unravel_index(int(beyond.argmax()), beyond.shape))
        # A marker is some millimetres off its arc length, and a clock hundredths of a second.
        if beyond[k, j] > slack + 6 * std + 0.05 * length:
            raise MeasurementError(
                f"at {t[k]:.3f} s the marker at {s[j]:.4g} m is {beyond[k, j] + along[j]:.4g} m "
                f"from the {side}, but only {along[j]:.4g} m of cable lie between them.\n"
                f"  Try: check the {side}'s place or its file of fixtures, and the clocks"
            )
