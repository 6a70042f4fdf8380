"""Modes as a picture that swings: SVG that plays by itself."""

from collections.abc import Sequence
from html import escape

import numpy as np

from dlo_casadi.arrays import FloatArray
from dlo_casadi.show.style import BLUE, GREY

# Pixels of a panel's larger side, displacement as a share of the shape's extent, instants of a
# period, points along a line, and lowest frequency [Hz] that is taken for a swing.
_SIZE, _SHOWN, _INSTANTS, _POINTS, _SLOWEST = 230, 0.12, 24, 41, 1e-3
# Margin around a panel, height of its title [pixels], and panels side by side.
_MARGIN, _TITLE, _ASIDE = 12, 24, 3


def swinging_modes(
    points: FloatArray, modes: FloatArray, frequencies: FloatArray, names: Sequence[str]
) -> str:
    """An SVG of modes (M, K, d) of a shape (K, d) [m], each swinging at its frequency (M,) [Hz].

    Without damping. In space as seen from the side: along the horizontal direction in which the
    shape and its modes extend most.
    """
    kept = np.linspace(0, len(points) - 1, _POINTS).round().astype(int)
    size = _SHOWN * float(np.ptp(points, axis=0).max())
    moved = size * modes[:, kept]
    shape, moved = _seen_flat(points[kept], moved)
    both = np.concatenate([shape + moved, shape - moved])
    low, high = both.reshape(-1, 2).min(axis=0), both.reshape(-1, 2).max(axis=0)
    scale = _SIZE / float((high - low).max())
    width, height = np.ceil((high - low) * scale).astype(int) + 2 * _MARGIN
    width, height = max(width, _SIZE), height + _TITLE
    left = (width - (high[0] - low[0]) * scale) / 2

    def pixels(x: FloatArray) -> FloatArray:
        return np.stack(
            [(x[..., 0] - low[0]) * scale + left, (high[1] - x[..., 1]) * scale + _TITLE + _MARGIN],
            axis=-1,
        )

    swing = np.cos(2 * np.pi * np.arange(_INSTANTS + 1) / _INSTANTS)
    panels = []
    for k, (mode, rate, name) in enumerate(zip(moved, frequencies.tolist(), names, strict=True)):
        lines = [_joined(pixels(shape + share * mode)) for share in swing]
        plays = (
            f'<animate attributeName="points" values="{";".join(lines)}" dur="{1 / rate:.4g}s" '
            'repeatCount="indefinite"/>'
            if rate > _SLOWEST
            else ""
        )
        panels.append(
            f'<g transform="translate({k % _ASIDE * width},{k // _ASIDE * height})">'
            f'<text x="{width / 2:.0f}" y="16" text-anchor="middle" font-size="12">'
            f"{escape(name)}</text>"
            f'<polyline fill="none" stroke="{GREY}" stroke-width="1" '
            f'points="{_joined(pixels(shape))}"/>'
            f'<polyline fill="none" stroke="{BLUE}" stroke-width="2.5" points="{lines[0]}">'
            f"{plays}</polyline></g>"
        )
    across, rows = min(len(panels), _ASIDE), -(-len(panels) // _ASIDE)
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {across * width} {rows * height}" '
        f'font-family="sans-serif" role="img" aria-label="{escape("; ".join(names))}">'
        f"{''.join(panels)}</svg>"
    )


def _joined(row: FloatArray) -> str:
    return " ".join(f"{x:.1f},{y:.1f}" for x, y in row.tolist())


def _seen_flat(points: FloatArray, moved: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Points (K, 2) and displacements (M, K, 2) from the side."""
    view = side_view(np.concatenate([points[None] + moved, points[None] - moved]))
    return points @ view, moved @ view


def side_view(points: FloatArray) -> FloatArray:
    """Matrix (d, 2) from points (..., d) to a picture of them; in a plane the unit matrix.

    In space across is the horizontal direction in which they extend most, and up is up.
    """
    view = np.eye(points.shape[-1])[:, -2:]
    if len(view) == 3:
        _, axes = np.linalg.eigh(np.cov(points[..., :2].reshape(-1, 2).T))
        view[:, 0] = [*axes[:, -1], 0.0]
    return view
