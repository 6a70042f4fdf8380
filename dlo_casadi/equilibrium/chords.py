"""Polylines through measured points: lengths along them, and headings."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from dlo_casadi.equilibrium.initial_frames import into_clamps
from dlo_casadi.equilibrium.pose import Pose
from dlo_casadi.rod.chain import Chain

FloatArray = NDArray[np.floating]


def chord_places(points: FloatArray, pose: Pose, length: float) -> FloatArray:
    """First guess of the points' arc lengths (K,) [m]: running chord length, scaled to L.

    Chords across gaps are shorter than the cable; between two fixtures the whole is scaled.
    """
    line = [np.array(pose.start)[None], points]
    if pose.end is not None:
        line.append(np.array(pose.end)[None])
    polyline = np.concatenate(line)
    steps = np.linalg.norm(np.diff(polyline, axis=0), axis=1)
    # Noise lengthens a dense polyline: chords over several points are what counts.
    s = _denoised_length(polyline, steps)
    places = s[1 : len(points) + 1]
    if pose.end is not None:
        places = places * (length / s[-1])
    return np.clip(places, 0.0, length)


def line_nodes(points: FloatArray, pose: Pose, chain: Chain, places: FloatArray) -> FloatArray:
    """Nodes (n_nodes, coordinates) along a measured line, from its chords.

    Those of some hundredths of the length; `places` (K,) [m] are the points' arc lengths. In a
    plane headings are continuous along the cable; in space the clamps' roll is spread evenly.
    """
    line = [np.array(pose.start)[None], points]
    s = [np.array([0.0]), places]
    if pose.end is not None:
        line.append(np.array(pose.end)[None])
        s.append(np.array([chain.length]))
    polyline, at = np.concatenate(line), np.maximum.accumulate(np.concatenate(s))
    grid = np.linspace(0.0, at[-1], 31)
    coarse = np.stack([np.interp(grid, at, column) for column in polyline.T], axis=1)
    chords = np.diff(coarse, axis=0)
    middles = (grid[1:] + grid[:-1]) / 2
    if chain.in_space:
        tangents = np.stack([np.interp(chain.places, middles, x) for x in chords.T], axis=1)
        tangents /= np.maximum(np.linalg.norm(tangents, axis=1, keepdims=True), 1e-300)
        given = (pose.start_orientation, pose.end_orientation)
        held = (chain.start_clamped, chain.end_clamped)
        clamps = [
            Rotation.from_quat(frame) if clamped and frame is not None else None
            for clamped, frame in zip(held, given, strict=True)
        ]
        return into_clamps(
            chain.places / chain.length, tangents, (clamps[0], clamps[1]), pose.turns
        )
    headings = np.unwrap(np.arctan2(chords[:, 1], chords[:, 0]))
    if pose.start_heading is not None:
        turns = np.round((pose.start_heading - headings[0]) / (2 * np.pi))
        headings = headings + 2 * np.pi * turns
    return np.interp(chain.places, middles, headings)[:, None]


def _denoised_length(polyline: FloatArray, steps: FloatArray) -> FloatArray:
    """Cumulative length of the polyline smoothed over about 1/50 of itself."""
    total = steps.sum()
    s = np.concatenate([[0.0], np.cumsum(steps)])
    width = max(total / 50, 1e-12)
    knots = np.linspace(0.0, total, 51)
    kernel = np.exp(-0.5 * ((knots[:, None] - s[None]) / (0.5 * width)) ** 2)
    norm = kernel.sum(axis=1, keepdims=True)
    smooth = np.where(norm > 1e-9, kernel @ polyline / np.maximum(norm, 1e-9), np.nan)
    straight = np.stack([np.interp(knots, s, column) for column in polyline.T], axis=1)
    smooth = np.where(np.isfinite(smooth), smooth, straight)
    smooth[0], smooth[-1] = polyline[0], polyline[-1]
    arc = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(smooth, axis=0), axis=1))])
    return np.interp(s, knots, arc)
