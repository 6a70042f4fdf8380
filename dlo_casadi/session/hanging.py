"""Which way a cable in space is pulled, from its measured lines alone, without any shape solved.

Kirchhoff's rod under a dead load w per length, in units of its bending stiffness:

    M(s) = M_0 + F_0 x (r - r_0) - w x (s r - int r ds),    M across the tangent = t x t'

is linear in M_0 and F_0, which each pose has of its own, and w, which all share. Second differences
of the points give t x t'; rest curvature and noise are the residual, and the scatter of the poses
tells the covariance of w.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from dlo_casadi.session.plausibility import Suspicion
from dlo_casadi.thresholds import HEADING_NEAR, HEADING_OFF, PULLED

FloatArray = NDArray[np.floating]

# Pieces of a dense line, whose points are averaged: second differences of closer ones are noise.
_PIECES = 16
# A covariance from the scatter of fewer poses tells nothing.
_LEAST_POSES = 6


def pulled_elsewhere(
    lines: Sequence[tuple[FloatArray, FloatArray | None]], gravity: Sequence[float]
) -> tuple[Suspicion, ...]:
    """Whether the lines hang along another direction than gravity.

    Parameters
    ----------
    lines : sequence of (K, 3) [m] and (K,) [m] or None
        Points, and arc lengths where they are known.
    gravity : (3,) [m/s^2]
        As declared.
    """
    found = load_over_stiffness(lines)
    if found is None or not np.all(np.isfinite(found[0])):
        return ()
    load, covariance = found
    score = float(np.sqrt(max(float(load @ np.linalg.pinv(covariance) @ load), 0.0)))
    way = load / max(float(np.linalg.norm(load)), 1e-300)
    size = float(np.linalg.norm(gravity))
    cosine = float(way @ np.array(gravity)) / size if size else -1.0
    off = float(np.arccos(np.clip(cosine, -1.0, 1.0)))
    if score < PULLED or off < HEADING_OFF:
        return ()
    axis = int(np.abs(way).argmax())
    along = ("-" if way[axis] < 0 else "+") + "xyz"[axis]
    near = float(np.arccos(min(abs(float(way[axis])), 1.0)))
    told = ", ".join(f"{value:.2f}" for value in way)
    declared = ", ".join(f"{value:g}" for value in gravity)
    return (
        Suspicion(
            f"the lines hang along ({told}), {np.degrees(near):.0f} degrees from {along} and "
            f"{score:.0f} standard deviations from weightless, but gravity is ({declared}) m/s^2. "
            "Try: gravity in the frame of points and grippers, with its sign, such as "
            "[0.0, 0.0, -9.81] with z up and [0.0, -9.81, 0.0] with y up.",
            near < HEADING_NEAR and size > 0,
        ),
    )


def load_over_stiffness(
    lines: Sequence[tuple[FloatArray, FloatArray | None]],
) -> tuple[FloatArray, FloatArray] | None:
    """Load per length over bending stiffness (3,) [1/m^3] and its covariance; None of a few lines.

    Least squares without weights; the covariance is that of independent poses (White 1980).
    """
    parts = [part for points, s in lines for part in _equations(points, s)]
    if len(parts) < _LEAST_POSES:
        return None
    inverse = np.linalg.pinv(np.sum([a.T @ a for a, _ in parts], axis=0))
    load = inverse @ np.sum([a.T @ y for a, y in parts], axis=0)
    scores = np.array([a.T @ (y - a @ load) for a, y in parts])
    return load, inverse @ scores.T @ scores @ inverse


def _equations(points: FloatArray, s: FloatArray | None) -> list[tuple[FloatArray, FloatArray]]:
    """Equations (rows, 3) for w and their right-hand side, of one pose; none of a few points."""
    points, s = _sparse(points) if s is None else (points, s)
    if len(points) < 5:
        return []
    steps = np.diff(s)
    t = np.diff(points, axis=0) / steps[:, None]
    t /= np.maximum(np.linalg.norm(t, axis=1, keepdims=True), 1e-300)
    bend = np.cross(t[:-1], t[1:]) / ((steps[1:] + steps[:-1]) / 2)[:, None]
    middle = t[:-1] + t[1:]
    middle /= np.maximum(np.linalg.norm(middle, axis=1, keepdims=True), 1e-300)
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
    steps = np.linalg.norm(np.diff(points, axis=0), axis=1)
    s = np.concatenate([[0.0], np.cumsum(steps)])
    piece = np.minimum((s / max(s[-1], 1e-300) * _PIECES).astype(int), _PIECES - 1)
    kept = [piece == k for k in np.unique(piece)]
    return (
        np.array([points[mask].mean(axis=0) for mask in kept]),
        np.array([s[mask].mean() for mask in kept]),
    )
