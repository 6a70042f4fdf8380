"""A session whose poses have been read: what is declared, and what was measured."""

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Self

import numpy as np

from dlo_casadi.arrays import IntArray
from dlo_casadi.config import Config, Pose
from dlo_casadi.session.lines import Lines
from dlo_casadi.session.measure import line_without_end
from dlo_casadi.session.outcome import PoseInput
from dlo_casadi.thresholds import FITS

# Number of points used to measure a line's length: noise lengthens a line of many points.
_SPARSE = 60


@dataclass(frozen=True)
class ReadSession:
    """A configuration and those of its poses that were read with points."""

    config: Config
    read: tuple[PoseInput, ...]

    @cached_property
    def declared(self) -> dict[str, Pose]:
        """Declared poses by their names."""
        return {pose.name: pose for pose in self.config.experiment.poses}

    @cached_property
    def lines(self) -> "Lines":
        """Measured lines beside their declared ends.

        A photograph is searched for a line between its declared ends, and wrong ends may hide the
        line. Where several poses do not fit, lines are searched for again without their ends.
        """
        experiment, found = self.config.experiment, {item.name: item for item in self.read}
        lines = _lines(self.config, found)
        if experiment.boundary.end.place:
            fits = lines.misfit(lines.measured, lines.declared) < FITS
            sound = {name for name, ok in zip(lines.names, fits, strict=True) if ok}
            poses = [pose for pose in experiment.poses if pose.name not in sound]
            doubtful = [pose for pose in poses if pose.paths and pose.paths[0].is_file()]
            if len(doubtful) > 1:
                for pose in doubtful:
                    if (line := line_without_end(self.config, pose)) is not None:
                        found[pose.name] = PoseInput(pose.name, pose.role, line)
                lines = _lines(self.config, found)
        return lines

    def with_experiment(self, **values: object) -> Self:
        """Return the session with other values in its configuration's `experiment`."""
        return replace(self, config=self.config.changed(experiment=values))

    def without(self, *names: str) -> Self:
        """Return the session without the poses of these names."""
        return replace(self, read=tuple(item for item in self.read if item.name not in names))


def _lines(config: Config, read: dict[str, PoseInput]) -> Lines:
    """Ends and lengths of lines or markers, by the names of their poses."""
    length, d = config.cable.length, len(config.experiment.gravity)
    fed, whole, spans, gaps, lengths = (
        np.array(config.experiment.boundary.fed),
        np.array([0.0, length]),
        [],
        [],
        [],
    )
    poses = [pose for pose in config.experiment.poses if pose.name in read]
    items = [read[pose.name] for pose in poses]
    for item in items:
        own = item.points
        span = whole if item.s is None else item.s[[0, -1]]
        # Sparse points leave some of the cable unseen at either end. A dense line reaches its
        # fixture unless something hides it.
        steps = np.linalg.norm(np.diff(own, axis=0), axis=1)
        apart = float(np.median(steps)) if len(steps) else length
        far = apart > FITS * length and item.s is None
        beyond = np.where(fed & (item.s is not None), np.inf, np.abs(span - whole))
        gaps.append(beyond + (max(length - steps.sum(), 0.0) if far else 0.0))
        sparse = np.diff(own[spread(len(own), _SPARSE)], axis=0)
        lengths.append(np.linalg.norm(sparse, axis=1).sum())
        spans.append(span[1] - span[0] if span[1] > span[0] else np.inf)  # one marker has no length
    ends = [(pose.start, pose.end or (np.nan,) * d) for pose in poses]
    return Lines(
        tuple(pose.name for pose in poses),
        np.array(ends).reshape(-1, 2, d),
        np.array([item.points[[0, -1]] for item in items]).reshape(-1, 2, d),
        np.array(lengths) / (np.array(spans) / length),
        length,
        np.array(gaps).reshape(-1, 2),
        np.array([item.s is not None for item in items], dtype=bool),
    )


def spread(count: int, most: int) -> IntArray:
    """Indices of at most `most` of `count` items, evenly spaced, first and last included."""
    return np.linspace(0, count - 1, min(count, most)).round().astype(int)
