"""Single points far off their neighbours on a measured line: gross errors of the measurement.

A point is compared with its neighbours' residuals, not with the fitted shape: the residual of a
model that lacks an effect is smooth along the line, so that none of its points is an outlier.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from dlo_casadi.arrays import BoolArray, FloatArray
from dlo_casadi.equilibrium.curve import NodeCurve, Observed
from dlo_casadi.errors import worded
from dlo_casadi.estimation.result import Fit
from dlo_casadi.io.points import MeasuredPoints
from dlo_casadi.sensing.sensors import line_or_markers
from dlo_casadi.session.outcome import PoseInput
from dlo_casadi.thresholds import BEYOND_CHANCE

# Number of neighbours with which a point is compared; smallest number of points of a line that is
# judged, twice a point with its neighbours. Seven simulated sessions that lack an effect have no
# outlier, with all their points and with 14 to 20 on a line.
NEIGHBOURS, LEAST_POINTS = 6, 14
# Standard deviation of a normal distribution over its median absolute deviation.
MAD = 1.4826
# Maximum number of outliers that a message names.
NAMED = 12


@dataclass(frozen=True)
class Outliers:
    """Outliers among the points of the fit poses.

    Parameters
    ----------
    poses : tuple of PoseInput
        All poses of the session, without the outliers.
    names : tuple of str
        Pose, number and arc length of each outlier.
    std : float [m]
        Robust standard deviation of points about the median of their neighbours.
    farthest : float [m]
        Largest distance of an outlier from that median.
    lines : int
        Number of lines with enough points to tell.
    """

    poses: tuple[PoseInput, ...]
    names: tuple[str, ...]
    std: float
    farthest: float
    lines: int

    def __str__(self) -> str:
        more = len(self.names) - NAMED
        return worded(
            "{count:# point} up to {farthest:mm.2g} off the neighbours on the line (usual: "
            "{usual:mm.2g}): {named}{more} (points are counted from the start)",
            count=len(self.names),
            farthest=self.farthest,
            usual=self.std,
            named=self.names[:NAMED],
            more=f" and {more} more" if more > 0 else "",
        )


class _Line(NamedTuple):
    """Points of a pose compared with its fitted curve."""

    pose: int
    points: MeasuredPoints
    s: FloatArray  # (K,) [m]
    residual: FloatArray  # (K, c) [m]
    weight: FloatArray  # (K, 1), relative standard deviations


def outliers_of(fit: Fit, poses: Sequence[PoseInput]) -> Outliers:
    """Points of the fit poses that are BEYOND_CHANCE standard deviations off their neighbours.

    `poses`: all poses of the fit, as measured. Photographs of a cable in space are not judged:
    their pixels are averages along the cable.

    References
    ----------
    Hampel's identifier with the larger of two standard deviations, of the neighbours and of all
    points: Davies and Gather, J. Am. Stat. Assoc. 88 (1993).
    """
    seen = fit.problem.observed(fit.point)
    lines = [
        _compared(k, points, weight, seen[j].curve)
        for k, j in zip(fit.problem.fitted, fit.problem.used, strict=True)
        for points, weight in _lines_of(poses[k])
        if len(points.points) >= LEAST_POINTS
    ]
    kept, std = _inliers([line.residual / line.weight for line in lines])
    found, names, farthest = list(poses), [], 0.0
    for line, own in zip(lines, kept, strict=True):
        pose = poses[line.pose]
        if line.points is pose.means:
            means = replace(pose.means, **_taken(pose.means, own))
            found[line.pose] = replace(found[line.pose], means=means)
        else:
            found[line.pose] = replace(found[line.pose], **_taken(pose, own))
        if pose.means is None or line.points is pose.means:
            before = np.cumsum(np.broadcast_to(line.points.count, len(own))) - line.points.count
            out = np.flatnonzero(~own)
            names += [f"{pose.name} point {1 + before[i]:.0f} at {line.s[i]:.3g} m" for i in out]
            off = np.linalg.norm(_beside(line.residual, own)[0][out], axis=1)
            farthest = max(farthest, float(off.max(initial=0.0)))
    return Outliers(tuple(found), tuple(names), std, farthest, len(lines))


def _lines_of(pose: PoseInput) -> list[tuple[MeasuredPoints, FloatArray | float]]:
    """The points that are shown and those that are fitted, with relative standard deviations."""
    if pose.views:
        return []
    weight = 1.0 if pose.weight is None else pose.weight
    lines = [(MeasuredPoints(pose.points, pose.s), weight)]
    return lines if pose.means is None else [*lines, (pose.means, pose.means.count**-0.5)]


def _compared(
    pose: int, points: MeasuredPoints, weight: FloatArray | float, curve: NodeCurve
) -> _Line:
    sensor = line_or_markers(points.points, s=points.s)
    s = sensor.nearest(curve)
    residual = sensor.residual(Observed(curve, np.zeros(0)), s).reshape((len(s), -1))
    return _Line(pose, points, s, residual, np.broadcast_to(weight, len(s))[:, None])


def _inliers(series: Sequence[FloatArray]) -> tuple[list[BoolArray], float]:
    """Which points (K,) of each series (K, c) are no outliers, and the std of all points.

    Repeated without the outliers found until there are no more: they hide those beside them.
    """
    kept = [np.ones(len(one), dtype=bool) for one in series]
    while series:
        beside = [_beside(one, own) for one, own in zip(series, kept, strict=True)]
        off = [np.abs(one) for one, _ in beside]
        std = MAD * float(
            np.median(
                np.concatenate([one[own].ravel() for one, own in zip(off, kept, strict=True)])
            )
        )
        least = [BEYOND_CHANCE * np.maximum(std, near) for _, near in beside]
        now = [
            own & (one <= limit).all(axis=1)
            for own, one, limit in zip(kept, off, least, strict=True)
        ]
        if all(np.array_equal(a, b) for a, b in zip(now, kept, strict=True)):
            return kept, std
        kept = now
    return kept, 0.0


def _beside(series: FloatArray, kept: BoolArray) -> tuple[FloatArray, FloatArray]:
    """Each point (K, c) minus the median of its neighbours, and their robust std (K, c).

    The std is large where a smooth series changes fast. Neighbours are among the points `kept`.
    """
    own = np.flatnonzero(kept)
    first = np.searchsorted(own, np.arange(len(series))) - NEIGHBOURS // 2
    first = np.clip(first, 0, max(len(own) - NEIGHBOURS - 1, 0))
    window = own[first[:, None] + np.arange(min(NEIGHBOURS + 1, len(own)))]
    near = np.where((window == np.arange(len(series))[:, None])[..., None], np.nan, series[window])
    middle = np.nanmedian(near, axis=1)
    spread = np.nanmedian(np.abs(near - middle[:, None]), axis=1)
    return series - middle, MAD * spread


def _taken(item: PoseInput | MeasuredPoints, kept: BoolArray) -> dict[str, Any]:
    """The points kept of a pose or of its means, and all that is given for each of them."""
    given = {key: getattr(item, key, None) for key in ("points", "s", "pixels", "weight", "count")}
    return {key: value[kept] for key, value in given.items() if value is not None}
