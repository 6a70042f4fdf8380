"""Measured lines beside their declared ends, and the same, had they been declared otherwise."""

from dataclasses import dataclass, replace
from typing import Self

import numpy as np
from scipy.spatial.transform import Rotation

from dlo_casadi.arrays import BoolArray, FloatArray
from dlo_casadi.session.axes import NEAR_AXES, exchanges, listed, named
from dlo_casadi.thresholds import NEARLY_ALL

# A line shorter than this share of the cable's length may show only a part of it.
_PART = 0.9
# Lines to which axes and an origin may be fitted: to fewer some of them always fit.
SEVERAL = 3
# Iterations of fitting a frame and then choosing which end of each line is the start.
_FITS_OF_FRAME = 4


@dataclass(frozen=True)
class Lines:
    """Measured lines beside their declared ends.

    Parameters
    ----------
    names : tuple of str
        Of m poses.
    declared : (m, 2, d) [m]
        Start and end fixture of each pose; NaN for a free end.
    measured : (m, 2, d) [m]
        The two ends of each measured line, in any order unless it is known.
    lengths : (m,) [m]
        Length of each measured line from point to point; of markers scaled up to the whole cable.
    length : float [m]
        Length of the cable.
    gaps : (m, 2) [m]
        Expected arc lengths between the fixtures and the ends of the measured line: for markers and
        for lines with sparse points; otherwise zero. Infinite from markers to an end that slides.
    known : (m,) of bool
        Whether the start of the line is known, as it is for markers.
    how : str
        How the ends were moved from where they were measured, in words.
    """

    names: tuple[str, ...]
    declared: FloatArray
    measured: FloatArray
    lengths: FloatArray
    length: float
    gaps: FloatArray
    known: BoolArray
    how: str = ""

    def misfit(self, measured: FloatArray, declared: FloatArray) -> FloatArray:
        """RMS distance of both ends from the fixtures over the length, for the better order.

        The expected gaps are subtracted.
        Shapes (m, ..., 2, 2) and (..., 2, 2) -> (m, ...).
        """
        gaps = self.gaps.reshape((len(self.gaps), *(1,) * (measured.ndim - 3), 2))
        ways = [
            np.maximum(np.linalg.norm(ends - declared, axis=-1) - gaps, 0.0)
            for ends in (measured, measured[..., ::-1, :])
        ]
        given, turned = (np.sqrt(np.nanmean(way**2, axis=-1)) for way in ways)
        known = self.known.reshape((-1, *(1,) * (given.ndim - 1)))
        return np.where(known, given, np.minimum(given, turned)) / self.length

    def short(self, i: int) -> str:
        """What to try if the line could show a part of the cable only; empty if it could not."""
        if self.known[i] or self.lengths[i] > _PART * self.length:
            return ""
        return (
            f" It is {self.lengths[i]:.3g} m long, the cable {self.length:.3g} m: if it shows a "
            "part of the cable alone, give the arc lengths of its points (`at`, s_m in a CSV)."
        )

    @property
    def overall(self) -> float:
        """Misfit of all poses, see `overall`."""
        return overall(self.misfit(self.measured, self.declared))

    @property
    def off(self) -> float:
        """The same as a distance [m]."""
        return self.overall * self.length

    @property
    def typical(self) -> float:
        """Median length [m] of the lines."""
        return float(np.median(self.lengths))

    @property
    def spans(self) -> FloatArray:
        """Distances (2, m) [m] of the declared ends of each pose, and of the ends of its line."""
        ends = np.stack([self.declared, self.measured])
        return np.asarray(np.linalg.norm(ends[:, :, 1] - ends[:, :, 0], axis=2))

    @property
    def typical_spans(self) -> FloatArray:
        """Medians (2,) [m] of `spans`."""
        return np.asarray(np.median(self.spans, axis=1))

    def of(self, kept: BoolArray) -> Self:
        """Lines of those poses (m,) alone."""
        names = tuple(name for name, own in zip(self.names, kept, strict=True) if own)
        arrays = ("declared", "measured", "lengths", "gaps", "known")
        return replace(self, names=names, **{name: getattr(self, name)[kept] for name in arrays})

    # ---- as they may have been meant ----

    def scaled(self, points: float = 1.0, length: float = 1.0, ends: float = 1.0) -> Self:
        """Points, the cable's length, and declared ends, each times a factor."""
        return replace(
            self,
            measured=self.measured * points,
            lengths=self.lengths * points,
            length=self.length * length,
            declared=self.declared * ends,
        )

    def reversed(self) -> Self:
        """Lines that begin at their other end."""
        return replace(self, measured=self.measured[:, ::-1], gaps=self.gaps[:, ::-1])

    def from_origin(self) -> Self:
        """Points measured from another origin, at which their ends fit best."""
        shift = self._shift(self.measured)
        return replace(self, measured=self.measured - shift, how=listed(shift, ".4g"))

    def in_axes(self, axes: FloatArray, *, moved: bool) -> Self | None:
        """Points read with exchanged axes (d, d), and from another origin if `moved`.

        None with other axes and origin for fewer than three lines: some of them would always fit.
        """
        if len(axes) != self.declared.shape[2] or (moved and len(self.names) < SEVERAL):
            return None
        measured, how = self.measured @ axes.T, named(axes)
        if moved:
            shift = self._shift(measured)
            measured, how = measured - shift, f"{how} and moved by ({listed(-shift, '.4g')}) m"
        return replace(self, measured=measured, how=how)

    def in_best_frame(self, axes: FloatArray) -> Self | None:
        """Points in the frame that fits best, from a first rotation (d, d).

        Declared = rotation measured + translation, by least squares (Kabsch 1976). Its handedness
        is that of the first rotation; the middle of both ends does not depend on the line's order.
        """
        d, turn, hand = self.declared.shape[2], axes, np.sign(np.linalg.det(axes))
        if len(axes) != d:
            return None
        centers = self.declared.mean(axis=1) - self.measured.mean(axis=1) @ turn.T
        shift = np.median(centers, axis=0)
        for _ in range(_FITS_OF_FRAME):
            moved = self.measured @ turn.T + shift
            given, other = (
                np.linalg.norm(ends - self.declared, axis=(1, 2))
                for ends in (moved, moved[:, ::-1])
            )
            swapped = ~self.known & (other < given)
            source = np.where(swapped[:, None, None], self.measured[:, ::-1], self.measured)
            source, goal = source.reshape(-1, d), self.declared.reshape(-1, d)
            centres = source.mean(axis=0), goal.mean(axis=0)
            u, _, v = np.linalg.svd((goal - centres[1]).T @ (source - centres[0]))
            turn = u @ np.diag([*np.ones(d - 1), hand * np.sign(np.linalg.det(u @ v))]) @ v
            shift = centres[1] - turn @ centres[0]
        return replace(self, measured=self.measured @ turn.T + shift, how=_described(turn, shift))

    def _shift(self, measured: FloatArray) -> FloatArray:
        """Best translation (d,) [m], taken at the middle of both ends.

        With a free end it is taken at the start, assumed to be the line's first point.
        """
        away = measured.mean(axis=1) - self.declared.mean(axis=1)
        away = np.where(np.isfinite(away), away, (measured - self.declared)[:, 0])
        return np.asarray(np.median(away, axis=0))


def _described(turn: FloatArray, shift: FloatArray) -> str:
    """Describe a frame: by its exchanged axes, or by how far it is rotated and moved."""
    d, moved = len(turn), f"moved by ({listed(shift, '.3g')}) m"
    near = min(exchanges(d), key=lambda axes: float(np.linalg.norm(turn - axes)))
    if np.linalg.norm(turn - near) < NEAR_AXES and not np.allclose(near, np.eye(d)):
        return f"{named(near)} and {moved}"
    hand = np.sign(np.linalg.det(turn))
    # A mirrored axis is mirrored before the rotation: y in a plane, all axes in space.
    mirror, whole = np.array([hand**d, hand, hand][:d]), np.eye(3)
    whole[:d, :d] = turn * mirror
    vector = Rotation.from_matrix(whole).as_rotvec()
    angle = float(np.linalg.norm(vector))
    return (
        f"the points {'mirrored, ' if hand < 0 else ''}turned by {np.degrees(angle):.3g} degrees "
        f"about ({listed(vector / max(angle, 1e-12), '.2g')}) and {moved}"
    )


def overall(misfit: FloatArray) -> float:
    """Root mean square over the poses without the worst fifth: one or two poses may be wrong."""
    kept = np.sort(misfit)[: max(1, int(np.ceil(NEARLY_ALL * len(misfit))))]
    return float(np.sqrt(np.mean(kept**2)))
