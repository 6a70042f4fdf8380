"""What a camera sees of a round cable: the middle of its outline, and pixels compared with it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from dlo_casadi.vision.view import Array, Viewpoint


@dataclass(frozen=True)
class Outline:
    """The projected outline of a cable at points of its axis.

    Parameters
    ----------
    pixels : (K, 2) [px]
        Middle between the two edges, across the projected axis.
    normals : (K, 2)
        Unit vectors across the projected axis.
    slopes : (K, 2, 3) [px/m]
        d(pixel)/d(point) in the board frame, that of the axis: the middle follows it to a part in
        1e-4.
    """

    pixels: Array
    normals: Array
    slopes: Array


def project_outline(
    viewpoint: Viewpoint, points: ArrayLike, tangents: ArrayLike, diameter: float
) -> Outline:
    """Project a cable.

    Parameters
    ----------
    viewpoint : Viewpoint
        Where the camera stands.
    points, tangents : (K, 3) [m], [-]
        Of its axis, in the board frame; unit tangents.
    diameter : scalar [m]
        Of the cable.

    The two planes through the camera that touch a straight cylinder of radius r about the axis
    through p (in the camera's frame) along t are at +-a from the plane of the axis, with sin a =
    r / d, d the distance of the camera from the axis. With e the unit vector from the camera to
    the axis, square to it, and b = t x e they cut the normalised picture at

        s = +-r / p_z / (B cos a -+ g sin a),  B = |b_xy|,  g = e_xy . b_xy / B

    across the axis. The middle between both is off the projected axis by r g sin a / p_z /
    (B^2 cos^2 a - g^2 sin^2 a): nothing in the middle of the picture, some r^2 f / (2 d^2) in its
    corners; with f = 1080 px 0.002 px for a cable of 7 mm at 1.7 m, 0.08 px for 12 mm at 0.5 m.

    A bent cable is the envelope of spheres along its axis. Its outline has the projected axis in
    the middle while that bends less than the outline is wide: where a bend is seen from its side as
    a cusp, and where another stretch shares the outline, the middle is somewhere else.
    """
    p = viewpoint.in_camera(points)
    t = np.asarray(tangents, float).reshape(-1, 3) @ viewpoint.rotation.T
    pixels, slopes = viewpoint.project(points)
    from_axis = p - np.sum(p * t, axis=1, keepdims=True) * t
    d = np.maximum(np.linalg.norm(from_axis, axis=1), diameter)
    e = from_axis / d[:, None]
    b = np.cross(t, e)
    B = np.maximum(np.linalg.norm(b[:, :2], axis=1), 1e-9)
    g = np.sum(e[:, :2] * b[:, :2], axis=1) / B
    radius, sin = 0.5 * diameter, 0.5 * diameter / d
    # A cable seen on end shows its section, whose middle is the axis to a radius.
    squares = np.maximum(B**2 * (1.0 - sin**2) - (g * sin) ** 2, sin**2)
    off = np.clip(radius * g * sin / squares, -radius, radius) / p[:, 2]
    across = b[:, :2] / B[:, None]
    # d(pixel)/d(ray) = p_z d(pixel)/d(p_xy), and a step along the ray's plane moves no depth
    by_ray = p[:, 2, None, None] * (slopes @ viewpoint.rotation.T)[:, :, :2]
    step = np.einsum("kij,kj->ki", by_ray, across)
    along = np.einsum("kij,kj->ki", slopes, np.asarray(tangents, float).reshape(-1, 3))
    along /= np.maximum(np.linalg.norm(along, axis=1, keepdims=True), 1e-12)
    return Outline(
        pixels + off[:, None] * step,
        np.column_stack([-along[:, 1], along[:, 0]]),
        slopes,
    )


def compare_pixels(
    viewpoint: Viewpoint,
    pixels: ArrayLike,
    points: ArrayLike,
    tangents: ArrayLike,
    diameter: float,
) -> tuple[Array, Array]:
    """Pixels measured minus those of a curve, across it.

    Parameters
    ----------
    viewpoint : Viewpoint
        Where the camera stands.
    pixels : (K, 2) [px]
        Measured middles of the outline, as photographed.
    points, tangents : (K, 3) [m], [-]
        Of the curve, at the nearest place to each pixel in the picture: there the distance does
        not change to first order with the place.
    diameter : scalar [m]
        Of the cable.

    Returns
    -------
    Distances (K,) [px], and their slopes d(distance)/d(point) (K, 3) [px/m].
    """
    seen = project_outline(viewpoint, points, tangents, diameter)
    distance = np.sum((np.asarray(pixels, float) - seen.pixels) * seen.normals, axis=1)
    return distance, -np.einsum("ki,kij->kj", seen.normals, seen.slopes)
