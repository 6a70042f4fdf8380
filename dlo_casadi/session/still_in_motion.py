"""Shapes at rest out of recordings of the moving cable, for sessions without still poses."""

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from dlo_casadi.arrays import BoolArray, FloatArray
from dlo_casadi.config import Config, Pose
from dlo_casadi.errors import ConfigError
from dlo_casadi.sensing.measured_motion import MeasuredMotion

# Change [m, or quaternions and rad] of a fixture beyond which it moves.
_MOVED = 1e-4
# Time [s] for which a cable must hang still after it has moved; the scatter of its points over
# that of neighbouring instants up to which it does, and that scatter at least [lengths].
_STILL, _SCATTER, _LEAST = 0.3, 2.0, 1e-4


def with_still_poses(config: Config, motions: Sequence[MeasuredMotion]) -> Config:
    """A session without poses with those at which its recordings begin or end; else the same.

    A recording that begins at rest gives the mean of its points until its fixtures move; one whose
    last 0.3 s are still, the mean of these.

    Raises
    ------
    ConfigError
        If there are no poses, and no recording to fit is ever at rest.
    """
    if config.experiment.poses or not motions:
        return config
    poses = [pose for one in motions if not one.held_out for pose in _stills(config, one)]
    if not poses:
        raise ConfigError(
            "experiment.poses is empty, and no motion to fit begins or ends at rest: nothing tells "
            "the shape that the cable swings about.\n"
            "  Try: a pose of the cable at rest, held as in the motions; or recordings that go on "
            f"until {_STILL:g} s are still; or begins: at_rest, if the cable hung still at first",
            config.path,
        )
    return config.changed(experiment={"poses": tuple(poses)})


def _stills(config: Config, motion: MeasuredMotion) -> Iterator[Pose]:
    """Poses of the first and of the last instants of a recording."""
    t = motion.t
    before, after = _rests(motion, 0), _rests(motion, -1)
    if motion.at_rest:
        count = max(int(np.argmin(before)) if not before.all() else len(t), 1)
        if before.all():
            count = _steady(config, motion, before)
        yield _mean(motion, "begins", slice(0, count))
    last = after & (t >= t[-1] - _STILL)
    moves = not motion.at_rest or not before.all()
    if moves and t[-1] > _STILL and last.sum() == (t >= t[-1] - _STILL).sum():
        at = slice(int(np.flatnonzero(last)[0]), len(t))
        if _is_still(config, motion.points[at]):
            yield _mean(motion, "ends", at)


def _steady(config: Config, motion: MeasuredMotion, rests: BoolArray) -> int:
    """Number of first instants of a cable that nothing moves: all, if it stays where it hangs."""
    return len(rests) if _is_still(config, motion.points) else 1


def _is_still(config: Config, points: FloatArray) -> bool:
    """Whether points (T, K, d) scatter over time as neighbouring instants do."""
    seen = np.isfinite(points[..., 0]).sum(axis=0) > len(points) // 2
    if not seen.any() or len(points) < 4:
        return False
    kept = points[:, seen]
    noise = np.nanstd(np.diff(kept, axis=0)) / np.sqrt(2)
    least = max(_LEAST * config.cable.length, config.experiment.measurement.std or 0.0)
    return bool(np.nanstd(kept - np.nanmean(kept, axis=0)) < _SCATTER * max(noise, least))


def _rests(motion: MeasuredMotion, at: int) -> BoolArray:
    """Instants (T,) at which the fixtures are where they are at the first or the last one."""
    rests = np.ones(len(motion.t), dtype=bool)
    for rows in motion.moving.values():
        table = rows.reshape(len(rows), -1)
        moved = np.stack([np.interp(motion.t, motion.fixtures_t, row) for row in table.T], axis=1)
        rests &= np.abs(moved - moved[at]).max(axis=1) < _MOVED
    return rests


def _mean(motion: MeasuredMotion, word: str, at: slice) -> Pose:
    """The mean of some instants as a pose."""
    points = motion.points[at]
    seen = np.isfinite(points[..., 0]).any(axis=0)
    held: dict[str, Any] = {name: x.tolist() for name, x in motion.resting.items()}
    middle = motion.t[at].mean()
    for name, rows in motion.moving.items():
        k = int(np.argmin(np.abs(motion.fixtures_t - middle)))
        held[name] = rows[k].tolist()
    if motion.across is None:
        held["at"] = motion.s[seen].tolist()
    name = f"{motion.name}_{word}"
    return Pose(points=np.nanmean(points[:, seen], axis=0).tolist(), name=name, **held)
