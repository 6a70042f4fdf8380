"""What a session may have been meant as: hypotheses, and what they are compared by."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import permutations, product
from typing import Any, Generic, NamedTuple, Self, TypeVar

import numpy as np
from scipy.spatial.transform import Rotation

from dlo_casadi.arrays import BoolArray, FloatArray, IntArray, chord_lengths, unit
from dlo_casadi.config import Config, Pose
from dlo_casadi.session.measure import line_without_end
from dlo_casadi.session.outcome import PoseInput
from dlo_casadi.thresholds import (
    FITS,
    NEARLY_ALL,
    OUT_OF_STEP,
)

T = TypeVar("T")

# Usual words for axes in a plane that are exchanged: measured x, y read as.
_IN_A_PLANE = {
    "x, -y": "y pointing down instead of up",
    "-x, y": "x pointing left instead of right",
    "y, x": "x and y exchanged",
    "-x, -y": "the picture turned by 180 degrees",
    "y, -x": "the picture turned by 90 degrees counter-clockwise",
    "-y, x": "the picture turned by 90 degrees clockwise",
}
# Pieces of a dense line, whose points are averaged: second differences of closer ones are noise.
_PIECES = 16
# A line of less than this share of the cable's length may show a part of it alone.
_PART = 0.9
# Number of points between which the length of a line is measured: noise lengthens dense lines.
_SPARSE = 60


class Suspicion(NamedTuple):
    """What looks like a mistake, and what to do about it.

    It is certain where nothing else explains the whole session; of a single pose it tells the name.
    """

    message: str
    certain: bool
    pose: str = ""

    @classmethod
    def of_pose(cls, name: str, text: str) -> Self:
        """What looks like a mistake in a single pose."""
        return cls(f"{name}: {text}", False, name)


@dataclass(frozen=True)
class ReadSession:
    """A configuration and the poses of it that were read, each with points."""

    config: Config
    read: tuple[PoseInput, ...]

    @cached_property
    def declared(self) -> dict[str, Pose]:
        """Declared poses by their names."""
        return {pose.name: pose for pose in self.config.experiment.poses}

    @cached_property
    def lines(self) -> "Lines":
        """Measured lines beside their declared ends."""
        return lines_of(self.config, self.read)

    def with_experiment(self, **values: object) -> Self:
        """Return the session with other values in its configuration's `experiment`."""
        return replace(self, config=self.config.changed(experiment=values))


class Hypothesis(NamedTuple, Generic[T]):
    """One thing that a session may have been meant as.

    Parameters
    ----------
    said : str
        What is said of it; `{own}` and `{left}` in it are the misfits without and with it.
    meant : T
        What is compared if it is true.
    """

    said: str
    meant: T


def likeliest(
    hypotheses: Iterable[Hypothesis[T]],
    misfit: Callable[[T], float],
    enough: float,
    near: float = np.inf,
) -> tuple[Hypothesis[T], float] | None:
    """First hypothesis, in the order of likelihood, whose misfit is below `enough`.

    If `near` is given, the first one whose misfit is at most `near` times the least of all.
    """
    tried = ((item, misfit(item.meant)) for item in hypotheses)
    if near == np.inf:
        return next((found for found in tried if found[1] < enough), None)
    known = list(tried)
    bound = near * min(left for _, left in known) + 1e-9
    first = next(found for found in known if found[1] < bound)
    return first if first[1] < enough else None


# ---- axes ---------------------------------------------------------------------------------------


def exchanges(d: int) -> list[FloatArray]:
    """All ways to exchange and turn round the axes of d dimensions, none first."""
    return [
        np.diag(signs) @ np.eye(d)[list(order)]
        for order in permutations(range(d))
        for signs in product((1.0, -1.0), repeat=d)
    ]


def listed(values: Any, form: str = ".3f") -> str:
    """Numbers (n,), or one, in words."""
    return ", ".join(format(x, form) for x in np.atleast_1d(values))


def named(axes: FloatArray) -> str:
    """What can have happened to the points where axes are exchanged."""
    names = "xyz"[: len(axes)]
    signs = ("-" if row.min() < 0 else "" for row in axes)
    read = ", ".join(
        sign + names[int(np.abs(row).argmax())] for sign, row in zip(signs, axes, strict=True)
    )
    if read in _IN_A_PLANE:
        return _IN_A_PLANE[read]
    hand = ", mirrored (a left-handed frame)" if np.linalg.det(axes) < 0 else ""
    up = " (y up in one, z up in the other?)" if np.all(np.diag(axes[1:, ::-1])) else ""
    return f"the points read as {', '.join(names)} = {read}{hand}{up}"


def axes_of(value: float | Sequence[float]) -> FloatArray:
    """Axes (d, d) of a clamp in columns, x along the cable; of a heading [rad] or a quaternion."""
    if isinstance(value, float | int):
        c, s = np.cos(value), np.sin(value)
        return np.array([[c, -s], [s, c]])
    return np.asarray(Rotation.from_quat(value).as_matrix())


def clamp_axes(pose: Pose, side: str) -> FloatArray | None:
    """Axes (d, d) of a pose's clamp, see `axes_of`; None where there is none."""
    values = getattr(pose, f"{side}_heading"), getattr(pose, f"{side}_orientation")
    return next((axes_of(value) for value in values if value is not None), None)


# ---- lines --------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Lines:
    """Measured lines beside what is declared of them.

    Parameters
    ----------
    names : tuple of str
        Of the m poses.
    declared : (m, 2, d) [m]
        Start and end fixture of each pose; NaN for a free end.
    measured : (m, 2, d) [m]
        The two ends of each measured line, in any order unless it is known.
    lengths : (m,) [m]
        Along each measured line, from point to point; of markers so much longer as the cable is.
    length : float [m]
        Of the cable.
    gaps : (m, 2) [m]
        Arc lengths between the fixtures and the ends of what was measured, as far as that is to
        be expected: of markers, and of lines whose points are far apart; else zero.
    known : (m,) of bool
        Of which line it is known where it begins, as of markers.
    """

    names: tuple[str, ...]
    declared: FloatArray
    measured: FloatArray
    lengths: FloatArray
    length: float
    gaps: FloatArray
    known: BoolArray

    def misfit(self, measured: FloatArray, declared: FloatArray) -> FloatArray:
        """Distance of ends from fixtures over the length: the better order, RMS over both.

        Less the gaps that are to be expected.
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
        """What to try where a line could be one of a part of the cable; empty if it could not."""
        if self.known[i] or self.lengths[i] > _PART * self.length:
            return ""
        return (
            f" It is {self.lengths[i]:.3g} m long, the cable {self.length:.3g} m: if it shows a "
            "part of the cable alone, give the arc lengths of its points (`at`, s_m in a CSV)."
        )

    def overall(self, measured: FloatArray) -> float:
        """`overall` misfit of ends (m, 2, d) [m]."""
        return overall(self.misfit(measured, self.declared))


def overall(misfit: FloatArray) -> float:
    """Root mean square over the poses, the worst fifth left out: a pose or two may be wrong."""
    kept = np.sort(misfit)[: max(1, int(np.ceil(NEARLY_ALL * len(misfit))))]
    return float(np.sqrt(np.mean(kept**2)))


def lines_of(config: Config, read: Sequence[PoseInput]) -> Lines:
    """Measured lines beside their declared ends.

    A photograph is searched for a line between the declared ends, so that wrong ends may hide the
    line. Where several do not fit, the lines are searched for once more without their ends.
    """
    points = {item.name: item.points for item in read}
    known = {item.name: item.s for item in read if item.s is not None}
    lines = _lines(config, points, known)
    if config.experiment.boundary.end != "free":
        fits = lines.misfit(lines.measured, lines.declared) < OUT_OF_STEP
        sound = {name for name, ok in zip(lines.names, fits, strict=True) if ok}
        poses = [pose for pose in config.experiment.poses if pose.name not in sound]
        doubtful = [pose for pose in poses if pose.paths and pose.paths[0].is_file()]
        if len(doubtful) > 1:
            again = {pose.name: line_without_end(config, pose) for pose in doubtful}
            points |= {name: line for name, line in again.items() if line is not None}
            lines = _lines(config, points, known)
    return lines


def _lines(config: Config, points: dict[str, FloatArray], known: dict[str, FloatArray]) -> Lines:
    """Ends and lengths of lines (K, d), some of them markers at known arc lengths (K,)."""
    length, d = config.cable.length, len(config.experiment.gravity)
    whole, spans, gaps, lengths = np.array([0.0, length]), [], [], []
    poses = [pose for pose in config.experiment.poses if pose.name in points]
    for pose in poses:
        own, marked = points[pose.name], pose.name in known
        span = known[pose.name][[0, -1]] if marked else whole
        # A line of points far apart leaves some of the cable to either side of them; where they
        # are closer it goes on to its fixture, up to what hides it.
        steps = np.linalg.norm(np.diff(own, axis=0), axis=1)
        apart = float(np.median(steps)) if len(steps) else length
        far = apart > FITS * length and not marked
        gaps.append(np.abs(span - whole) + (max(length - steps.sum(), 0.0) if far else 0.0))
        sparse = np.diff(own[spread(len(own), _SPARSE)], axis=0)
        lengths.append(np.linalg.norm(sparse, axis=1).sum())
        spans.append(span[1] - span[0] if span[1] > span[0] else np.inf)  # one marker has no length
    ends = [(pose.start, pose.end or (np.nan,) * d) for pose in poses]
    return Lines(
        tuple(pose.name for pose in poses),
        np.array(ends).reshape(-1, 2, d),
        np.array([points[pose.name][[0, -1]] for pose in poses]).reshape(-1, 2, d),
        np.array(lengths) / (np.array(spans) / length),
        length,
        np.array(gaps).reshape(-1, 2),
        np.array([pose.name in known for pose in poses], dtype=bool),
    )


def spread(count: int, most: int) -> IntArray:
    """Indices of at most `most` of `count` items, evenly spaced, both ends included."""
    return np.linspace(0, count - 1, min(count, most)).round().astype(int)


# ---- weight -------------------------------------------------------------------------------------


def shown_pull(session: ReadSession) -> FloatArray | None:
    """Direction (d,) in which the lines seem to be pulled, without any shape solved.

    Between pins a cable hangs from its chord; elsewhere its moments tell, `load_over_stiffness`.
    None where they do not: of a few points.
    """
    boundary = session.config.experiment.boundary
    if boundary.start == boundary.end == "pinned":
        poses = [session.declared[item.name] for item in session.read]
        ends = [np.array([pose.start, pose.end]) for pose in poses]
        pull = _off_the_chord([item.points for item in session.read], ends)
    else:
        pull = load_over_stiffness([(item.points, item.s) for item in session.read])
    return pull if np.all(np.isfinite(pull)) and pull.any() else None


def _off_the_chord(lines: Sequence[FloatArray], chords: Sequence[FloatArray]) -> FloatArray:
    """Mean of the points (K, d) of all lines from their chords (2, d): what pulls across them."""
    across, away = np.zeros((2, 1, 1))
    for points, (start, end) in zip(lines, chords, strict=True):
        along = (end - start) / max(float(np.linalg.norm(end - start)), 1e-300)
        own = np.eye(len(start)) - np.outer(along, along)
        across, away = across + own, away + own @ (points - start).mean(axis=0)[:, None]
    return np.asarray(np.linalg.pinv(across, rcond=FITS) @ away)[:, 0]


def load_over_stiffness(lines: Sequence[tuple[FloatArray, FloatArray | None]]) -> FloatArray:
    """Load per length over bending stiffness (d,) [1/m^3]; zero of a few points.

    Kirchhoff's rod under a dead load w per length, in units of its bending stiffness:

        M(s) = M_0 + F_0 x (r - r_0) - w x (s r - int r ds),    M across the tangent = t x t'

    is linear in M_0 and F_0, which each pose has of its own, and w, which all share. Second
    differences of the points give t x t'; rest curvature and noise are the residual.

    Parameters
    ----------
    lines : sequence of (K, d) [m] and (K,) [m] or None
        Points, and arc lengths where they are known.
    """
    d = lines[0][0].shape[1]
    parts = [
        part for points, s in lines for part in _equations(np.pad(points, ((0, 0), (0, 3 - d))), s)
    ]
    sizes = np.sum([np.zeros((3, 3)), *(a.T @ a for a, _ in parts)], axis=0)
    right = np.sum([np.zeros(3), *(a.T @ y for a, y in parts)], axis=0)
    return np.asarray(np.linalg.pinv(sizes) @ right)[:d]


def _equations(points: FloatArray, s: FloatArray | None) -> list[tuple[FloatArray, FloatArray]]:
    """Equations (rows, 3) for w and their right-hand side, of one pose; none of a few points."""
    points, s = _sparse(points) if s is None else (points, s)
    if len(points) < 5:
        return []
    steps = np.diff(s)
    t = unit(np.diff(points, axis=0) / steps[:, None])
    bend = np.cross(t[:-1], t[1:]) / ((steps[1:] + steps[:-1]) / 2)[:, None]
    middle = unit(t[:-1] + t[1:])
    across = np.eye(3) - middle[:, :, None] * middle[:, None, :]
    r, s = points - points[0], s - s[0]
    swept = np.cumsum((r[1:] + r[:-1]) / 2 * steps[:, None], axis=0)[:-1]
    lever = s[1:-1, None] * r[1:-1] - swept
    own = np.concatenate([across, -across @ _cross(r[1:-1])], axis=2).reshape(-1, 6)
    shared = (across @ _cross(lever)).reshape(-1, 3)
    # What a pose's own force and moment can explain tells nothing of the load.
    basis = np.linalg.svd(own, full_matrices=False)[0]
    right = bend.reshape(-1)
    return [(shared - basis @ (basis.T @ shared), right - basis @ (basis.T @ right))]


def _cross(vectors: FloatArray) -> FloatArray:
    """Matrices (n, 3, 3) with A b = vector x b."""
    return np.asarray(np.cross(vectors[:, None, :], np.eye(3)).swapaxes(1, 2))


def _sparse(points: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Means of the points of pieces of a line, and their places along it."""
    s = chord_lengths(points)
    piece = np.minimum((s / max(s[-1], 1e-300) * _PIECES).astype(int), _PIECES - 1)
    kept = [piece == k for k in np.unique(piece)]
    return (
        np.array([points[mask].mean(axis=0) for mask in kept]),
        np.array([s[mask].mean() for mask in kept]),
    )
