"""Which way lines are pulled, seen without solving for any shape."""

from collections.abc import Sequence

import numpy as np

from dlo_casadi.arrays import FloatArray, chord_lengths, unit
from dlo_casadi.session.read_session import ReadSession
from dlo_casadi.thresholds import FITS

# Pieces of a dense line whose points are averaged: second differences of single points are noise.
_PIECES = 16


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
