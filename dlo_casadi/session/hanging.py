"""Whether a cable hangs along gravity: what its lines show at a glance, and what fits confirm."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from dlo_casadi.config import Config, Pose
from dlo_casadi.model.cable_model import BENDING_STIFFNESS
from dlo_casadi.session.coarse import Hypothesis, compare, tells_weight
from dlo_casadi.session.frames import clamp_axes, exchanges, named
from dlo_casadi.session.outcome import PoseInput
from dlo_casadi.session.plausibility import Suspicion
from dlo_casadi.thresholds import FITS, HEADING_OFF

FloatArray = NDArray[np.floating]

# Pieces of a dense line, whose points are averaged: second differences of closer ones are noise.
_PIECES = 16


def hangs_elsewhere(config: Config, read: Sequence[PoseInput]) -> tuple[Suspicion, ...]:
    """Whether the shapes fit only with gravity turned, or the points mirrored.

    Where the lines seem to be pulled along gravity nothing is fitted.
    """
    gravity = np.array(config.experiment.gravity)
    if not (len(read) and gravity.any()):
        return ()
    pull = shown_pull(config, read)
    if pull is not None and _angle(pull, gravity) < HEADING_OFF:
        return ()
    found = compare(config, read, list(_otherwise(config, read, pull)))
    if found is None or not (found.better or found.shows_weight):
        return ()
    weightless = ""
    if found.own is not None and not tells_weight(found.own):
        least = found.own.value(BENDING_STIFFNESS)
        weightless = (
            f"the lines show no weight, as if bending_stiffness were {least:.2g} N m^2 or more; "
        )
    up = f"{[*np.zeros(len(gravity) - 1).tolist(), -9.81]} with {'xyz'[len(gravity) - 1]} up"
    return (
        Suspicion(
            f"the cable does not hang along gravity {_vector(gravity)} m/s^2: {weightless}"
            f"{found.told}. Try: points, start, end and gravity in one frame, such as gravity: "
            f"{up}."
            + ("" if found.certain else " A strap that lifts the cable would look the same."),
            found.certain,
        ),
    )


def _otherwise(
    config: Config, read: Sequence[PoseInput], pull: FloatArray | None
) -> Iterator[Hypothesis]:
    """Gravity along other axes, and points with exchanged or mirrored axes that keep their ends.

    Those alone along whose gravity the lines seem to be pulled; all if they show no pull.
    """
    gravity = np.array(config.experiment.gravity)
    tried = [gravity]
    frames = [
        axes for axes in exchanges(len(gravity)) if _angle(pull, gravity @ axes) < HEADING_OFF
    ]
    for way in (gravity @ axes for axes in frames):
        if not any(np.allclose(way, other) for other in tried):
            tried.append(way)
            experiment = config.experiment.model_copy(update={"gravity": tuple(way.tolist())})
            what = f"gravity {_vector(way)} m/s^2"
            yield Hypothesis(what, replace(config, experiment=experiment), read)
    boundary, length = config.experiment.boundary, config.cable.length
    if boundary.start == boundary.end == "pinned":
        return  # between pins it is the same to turn the points, and gravity
    poses = {pose.name: pose for pose in config.experiment.poses}
    kept = [_held(poses[item.name], length) for item in read]
    for axes in frames:
        if np.allclose(axes, np.eye(len(gravity))):
            continue
        if all(np.abs(held @ axes.T - held).max() < FITS for held in kept):
            starts = [np.array(poses[item.name].start) for item in read]
            inputs = [
                replace(item, points=(item.points - start) @ axes.T + start)
                for item, start in zip(read, starts, strict=True)
            ]
            yield Hypothesis(named(axes), config, inputs)


def _held(pose: Pose, length: float) -> FloatArray:
    """What turned points of a pose must keep (n, d): the end from the start, in lengths, clamps."""
    kept: list[FloatArray] = [np.zeros(len(pose.start))]
    if pose.end is not None:
        kept.append((np.array(pose.end) - pose.start) / length)
    axes = [clamp_axes(pose, side) for side in ("start", "end")]
    kept += [own[:, 0] for own in axes if own is not None]
    return np.array(kept)


def _vector(values: FloatArray) -> str:
    return f"({', '.join(f'{value + 0.0:g}' for value in values)})"


def _angle(pull: FloatArray | None, way: FloatArray) -> float:
    """Angle [rad] of a direction from the pull that lines show; zero where they show none."""
    if pull is None:
        return 0.0
    cosine = float(pull @ way) / float(np.linalg.norm(pull) * np.linalg.norm(way))
    return float(np.arccos(np.clip(cosine, -1.0, 1.0)))


# ---- at a glance --------------------------------------------------------------------------------


def shown_pull(config: Config, read: Sequence[PoseInput]) -> FloatArray | None:
    """Direction (d,) in which the lines seem to be pulled, without any shape solved.

    Between pins a cable hangs from its chord; elsewhere its moments tell, `load_over_stiffness`.
    None where they do not: of a few points.
    """
    boundary = config.experiment.boundary
    if boundary.start == boundary.end == "pinned":
        poses = {pose.name: pose for pose in config.experiment.poses}
        ends = [np.array([poses[item.name].start, poses[item.name].end]) for item in read]
        pull = _off_the_chord([item.points for item in read], ends)
    else:
        pull = load_over_stiffness([(item.points, item.s) for item in read])
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
