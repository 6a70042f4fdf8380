"""Stretches of a cable that share an outline in a photograph, told apart by the line in space."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import find_objects, label

from dlo_casadi.vision.curve import chord_length, fit_curve, normals
from dlo_casadi.vision.image_curve import ImageCurve, other_stretches
from dlo_casadi.vision.profiles import EdgeShape, find_edges, sample_profiles
from dlo_casadi.vision.space_curve import CurveFit, fit_curve_to_images
from dlo_casadi.vision.trace import FINE
from dlo_casadi.vision.view import Array


def measure_shared_outlines(
    fit: CurveFit, curves: list[ImageCurve], images: list[NDArray[np.uint8]]
) -> tuple[CurveFit, list[ImageCurve]]:
    """Measure the stretches that share an outline in a photograph, now that the rest is known.

    Whether they cross in it is what makes the line in space likelier; then once more with the
    sides of that line.
    """
    t = np.linspace(0.0, 1.0, 1001)
    points = fit.curve.position(t)
    shared = []
    for curve in curves:
        pixels = curve.viewpoint.to_pixels(points)
        beside = other_stretches(pixels, chord_length(pixels), curve.width)
        shared.append(bool(np.isfinite(beside).any()))
    if not any(shared):
        return fit, curves

    def measure(crossed: bool | None, guess: CurveFit) -> tuple[CurveFit, list[ImageCurve]]:
        points = guess.curve.position(t)
        seen, params = list(curves), list(guess.params)
        for v in np.flatnonzero(shared):
            seen[v], params[v] = see_beside(images[v], curves[v], points, t, fit.params[v], crossed)
        return fit_curve_to_images(seen, guess.curve, params), seen

    either = [measure(crossed, fit)[0] for crossed in (False, True)]
    return measure(None, min(either, key=lambda found: found.surprise))


def see_beside(
    image: NDArray[np.uint8],
    seen: ImageCurve,
    curve: Array,
    params: Array,
    params_seen: Array,
    crossed: bool | None = None,
) -> tuple[ImageCurve, Array]:
    """Measure the stretches that share an outline, given on which side each of them lies.

    An outline of width W holds two stretches of the width w, known from the rest of the line and
    the distance from the camera: their middles lie (W - w) / 2 beside its own, to either side.

    `curve` (M, 3) [m] is the line in space, closely spaced, with `params` (M,) increasing along it;
    `params_seen` (K,) are those of the pixels, nan where they do not belong to it. `crossed` tells
    whether two stretches change sides where their outline is narrowest, or keep the sides on which
    they lie where it is widest; None takes the sides of the curve.

    Returns
    -------
    What is seen, in the order of the curve, and the parameters of its pixels.
    """
    viewpoint, distance = seen.viewpoint, seen.distance
    view = viewpoint.facing(distance)
    pixel = 1.0 / view.scale
    at, flat = viewpoint.in_camera(curve), viewpoint.flattened(curve, distance)
    t = chord_length(flat)
    beside = other_stretches(flat, t, seen.width * pixel)
    hidden = np.isfinite(beside)
    depth = float(np.median(at[~hidden, 2])) if not hidden.all() else distance
    width = seen.width * pixel * depth / at[:, 2]
    usual = float(width.mean())
    keep = seen.whole & np.isfinite(params_seen)
    keep &= ~(np.interp(params_seen, params, hidden.astype(float)) > 0.5)
    pixels, std, places = [seen.pixels[keep]], [seen.std[keep]], [params_seen[keep]]
    bright = image.astype(np.float32)
    spacing = pixel * seen.spacing
    for (run,) in find_objects(label(hidden)[0]):
        if np.ptp(t[run]) < usual or len(t[run]) < 4:
            continue
        middle = flat[run] + 0.5 * beside[run, None] * normals(np.gradient(flat[run], axis=0))
        line = fit_curve(t[run], middle, np.ones(len(middle)), usual, 0.3 * usual)
        profiles = sample_profiles(bright, view, line, t[run], usual)
        smooth = profiles.average(profiles.inside, FINE * usual)
        both = EdgeShape(usual + float(np.abs(beside[run]).max()), seen.blur * pixel)
        found = find_edges(smooth, seen.direction, both)
        apart = np.maximum(found.width - width[run], 0.0)
        side = _sides(beside[run], apart, crossed)
        offset = (found.offset - 0.5 * side * apart)[:, None]
        points = line.position(t[run]) + offset * line.normal(t[run])
        good = profiles.inside & (np.abs(apart - np.abs(beside[run])) < 0.5 * usual)
        good &= np.diff(np.floor(t[run] / spacing), prepend=-1.0) > 0
        if not good.any():
            continue
        pixels.append(view.to_pixels(points[good]).reshape(-1, 2))
        # Both the outline and the rest of the line tell how far apart the two lie.
        doubt = 0.5 * float(np.sqrt(np.mean((apart - np.abs(beside[run]))[good] ** 2))) / pixel
        told = np.sqrt(np.median(seen.std) ** 2 + (0.5 * seen.width_std) ** 2 + doubt**2)
        std.append(np.full(int(good.sum()), told))
        places.append(params[run][good])
    along = np.concatenate(places)
    order = np.argsort(along, kind="stable")
    pixels_again, std_again = np.vstack(pixels)[order], np.concatenate(std)[order]
    whole = np.ones(len(order), bool)
    return replace(seen, pixels=pixels_again, std=std_again, whole=whole), along[order]


def _sides(beside: Array, apart: Array, crossed: bool | None) -> Array:
    """Side (K,) on which the other stretch lies: 1 to the left, -1 to the right."""
    if crossed is None:
        return np.sign(beside)
    widest_last = abs(beside[-1]) > abs(beside[0])
    side = np.full(len(beside), np.sign(beside[-1 if widest_last else 0]))
    if crossed:
        narrowest = int(np.argmin(apart))
        beyond = slice(None, narrowest) if widest_last else slice(narrowest, None)
        side[beyond] *= -1
    return side
