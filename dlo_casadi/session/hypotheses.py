"""Hypotheses on what a session may have meant, and the misfits that compare them."""

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
from dlo_casadi.thresholds import FITS, NEARLY_ALL, OUT_OF_STEP

T = TypeVar("T")

# Usual descriptions of exchanged axes in a plane: measured (x, y) is read as the given pair.
_IN_A_PLANE = {
    "x, -y": "y pointing down instead of up",
    "-x, y": "x pointing left instead of right",
    "y, x": "x and y exchanged",
    "-x, -y": "the picture turned by 180 degrees",
    "y, -x": "the picture turned by 90 degrees counter-clockwise",
    "-y, x": "the picture turned by 90 degrees clockwise",
}
# Pieces of a dense line whose points are averaged: second differences of single points are noise.
_PIECES = 16
# A line shorter than this share of the cable's length may show only a part of it.
_PART = 0.9
# Number of points used to measure a line's length: noise lengthens a line of many points.
_SPARSE = 60
# Largest difference (Frobenius norm) of a rotation from exchanged axes that describe it: 0.3 rad.
NEAR_AXES = 0.3 * np.sqrt(2)


class Suspicion(NamedTuple):
    """A likely mistake and what to do about it.

    `certain`: nothing else explains the whole session. `pose`: its name, if it concerns only one.
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
            fits = lines.misfit(lines.measured, lines.declared) < OUT_OF_STEP
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


class Hypothesis(NamedTuple, Generic[T]):
    """One thing that the user may have meant.

    Parameters
    ----------
    said : str
        Its description, in which `{own}` and `{left}` stand for the misfits without and with it.
    meant : T
        What to compare under this hypothesis.
    certain : bool
        Whether no other cause, such as a missing effect, could explain the same.
    """

    said: str
    meant: T
    certain: bool = True


def likeliest(
    hypotheses: Iterable[Hypothesis[T]],
    misfit: Callable[[T], float],
    enough: float,
    near: float = np.inf,
) -> tuple[Hypothesis[T], float] | None:
    """First hypothesis, in the order of likelihood, whose misfit is below `enough`.

    With `near`: the first one whose misfit is at most `near` times the smallest of all.
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
    """All signed permutations of d axes, the identity first."""
    return [
        np.diag(signs) @ np.eye(d)[list(order)]
        for order in permutations(range(d))
        for signs in product((1.0, -1.0), repeat=d)
    ]


def listed(values: Any, form: str = ".3f") -> str:
    """Format one number, or numbers (n,), for a message."""
    return ", ".join(format(x, form) for x in np.atleast_1d(values))


def read_as(axes: FloatArray) -> str:
    """The components that are read as x, y, z if axes (d, d) are exchanged, such as y, -x."""
    signs = ("-" if row.min() < 0 else "" for row in axes)
    return ", ".join(
        sign + "xyz"[int(np.abs(row).argmax())] for sign, row in zip(signs, axes, strict=True)
    )


def named(axes: FloatArray) -> str:
    """Describe what may have happened to points whose axes are exchanged."""
    names, read = "xyz"[: len(axes)], read_as(axes)
    if read in _IN_A_PLANE:
        return _IN_A_PLANE[read]
    hand = ", mirrored (a left-handed frame)" if np.linalg.det(axes) < 0 else ""
    up = " (y up in one, z up in the other?)" if np.all(np.diag(axes[1:, ::-1])) else ""
    return f"the points read as {', '.join(names)} = {read}{hand}{up}"


def axes_of(value: float | Sequence[float]) -> FloatArray:
    """Axes (d, d) of a clamp in columns, x along the cable, from a heading [rad] or quaternion."""
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
        for lines with sparse points; otherwise zero.
    known : (m,) of bool
        Whether the start of the line is known, as it is for markers.
    """

    names: tuple[str, ...]
    declared: FloatArray
    measured: FloatArray
    lengths: FloatArray
    length: float
    gaps: FloatArray
    known: BoolArray

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

    def overall(self, measured: FloatArray) -> float:
        """Misfit of the ends (m, 2, d) [m] over all poses, see `overall`."""
        return overall(self.misfit(measured, self.declared))


def overall(misfit: FloatArray) -> float:
    """Root mean square over the poses without the worst fifth: one or two poses may be wrong."""
    kept = np.sort(misfit)[: max(1, int(np.ceil(NEARLY_ALL * len(misfit))))]
    return float(np.sqrt(np.mean(kept**2)))


def _lines(config: Config, read: dict[str, PoseInput]) -> Lines:
    """Ends and lengths of lines or markers, by the names of their poses."""
    length, d = config.cable.length, len(config.experiment.gravity)
    whole, spans, gaps, lengths = np.array([0.0, length]), [], [], []
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
        gaps.append(np.abs(span - whole) + (max(length - steps.sum(), 0.0) if far else 0.0))
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


# ---- weight -------------------------------------------------------------------------------------


def shown_pull(session: ReadSession) -> FloatArray | None:
    """Direction (d,) in which the lines seem to be pulled, without solving for any shape.

    Between pins a cable hangs from its chord; otherwise see `load_over_stiffness`. None where the
    lines have too few points.
    """
    boundary = session.config.experiment.boundary
    if boundary.start.turns and boundary.end.turns:
        pull = _off_the_chord(session)
    else:
        pull = load_over_stiffness([(item.points, item.s) for item in session.read])
    return pull if np.all(np.isfinite(pull)) and pull.any() else None


def _off_the_chord(session: ReadSession) -> FloatArray:
    """Mean offset (d,) of the points of all lines from their chords."""
    across, away = np.zeros((2, 1, 1))
    for item in session.read:
        pose = session.declared[item.name]
        start, end = np.array([pose.start, pose.end])
        chord = end - start
        along = chord / max(float(np.linalg.norm(chord)), 1e-300)
        own = np.eye(len(start)) - np.outer(along, along)
        across, away = across + own, away + own @ (item.points - start).mean(axis=0)[:, None]
    return np.asarray(np.linalg.pinv(across, rcond=FITS) @ away)[:, 0]


def load_over_stiffness(lines: Sequence[tuple[FloatArray, FloatArray | None]]) -> FloatArray:
    """Load per length over bending stiffness (d,) [1/m^3]; zero if there are too few points.

    Kirchhoff's rod under a dead load w per length, in units of its bending stiffness:

        M(s) = M_0 + F_0 x (r - r_0) - w x (s r - int r ds),    M across the tangent = t x t'

    is linear in M_0 and F_0, separate in each pose, and in w, shared by all. Second differences
    of the points give t x t'; rest curvature and noise are the residual.

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
    """Equations (rows, 3) for w and their right-hand side, of one pose; none for a few points."""
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
    # The part that a pose's own force and moment can explain says nothing about the load.
    basis = np.linalg.svd(own, full_matrices=False)[0]
    right = bend.reshape(-1)
    return [(shared - basis @ (basis.T @ shared), right - basis @ (basis.T @ right))]


def _cross(vectors: FloatArray) -> FloatArray:
    """Matrices (n, 3, 3) with A b = vector x b."""
    return np.asarray(np.cross(vectors[:, None, :], np.eye(3)).swapaxes(1, 2))


def _sparse(points: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Means of the points in each piece of a line, and their places along it."""
    s = chord_lengths(points)
    piece = np.minimum((s / max(s[-1], 1e-300) * _PIECES).astype(int), _PIECES - 1)
    kept = [piece == k for k in np.unique(piece)]
    return (
        np.array([points[mask].mean(axis=0) for mask in kept]),
        np.array([s[mask].mean() for mask in kept]),
    )
