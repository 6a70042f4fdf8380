"""A calibrated camera that stands somewhere in front of the board: space to pixels and back."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import ArrayLike

from dlo_casadi.vision.view import Array, Camera, View


@dataclass(frozen=True)
class Viewpoint:
    """Where the camera of one photograph stands.

    A point p of the board frame (x right, y up, z out of the board) is at

        q = R p + t

    in the camera's frame (x right, y down, z ahead), and is seen at the pixel distort(q_xy / q_z).

    Parameters
    ----------
    camera : Camera
        Intrinsic matrix and lens.
    rotation : (3, 3)
        R, from the board's axes to the camera's.
    translation : (3,) [m]
        t, the board's origin in the camera's frame.
    shape : (height, width) [px]
        Size of the photograph.
    covariance : (6, 6) [rad, m]
        Of a small rotation w and a shift d of the board in the camera's frame, q -> q + w x q + d,
        from the scatter of the corners.
    reprojection_error : scalar [px]
        Root mean square over the corners of the markers.
    markers : (n, 4, 2) [px]
        Corners of the markers that were used.
    numbers : tuple of int
        Their numbers.
    messages : tuple of str
        Which markers were not used, and why.
    """

    camera: Camera
    rotation: Array
    translation: Array
    shape: tuple[int, int]
    covariance: Array
    reprojection_error: float
    markers: Array
    numbers: tuple[int, ...]
    messages: tuple[str, ...] = ()

    @property
    def center(self) -> Array:
        """Where the camera stands (3,) [m] in the board frame, C = -R^T t."""
        return -self.rotation.T @ self.translation

    def in_camera(self, points: ArrayLike) -> Array:
        """Points (K, 3) [m] of the board frame in the camera's frame."""
        return np.asarray(points, float).reshape(-1, 3) @ self.rotation.T + self.translation

    def to_pixels(self, points: ArrayLike) -> Array:
        """Pixels (K, 2) [px] at which points (K, 3) [m] are seen."""
        return self.project(points)[0]

    def project(self, points: ArrayLike) -> tuple[Array, Array]:
        """Pixels (K, 2) [px] of points (K, 3) [m], and d(pixel)/d(point) (K, 2, 3) [px/m]."""
        at = self.in_camera(points)
        if not len(at):
            return np.zeros((0, 2)), np.zeros((0, 2, 3))
        still = np.zeros(3)
        pixels, slopes = cv2.projectPoints(
            at, still, still, self.camera.matrix, self.camera.distortion
        )
        by_shift = np.asarray(slopes[:, 3:6], float).reshape(-1, 2, 3)
        return np.asarray(pixels, float).reshape(-1, 2), by_shift @ self.rotation

    def rays(self, pixels: ArrayLike) -> Array:
        """Undistorted rays (K, 2), q_xy / q_z, of pixels (K, 2) [px]."""
        return self.camera.undistort(np.asarray(pixels, float).reshape(-1, 2))

    def flattened(self, points: ArrayLike, distance: float) -> Array:
        """Places (K, 2) [m] in the plane of `facing` at which points (K, 3) [m] are seen."""
        at = self.in_camera(points)
        return np.asarray(at[:, :2] / at[:, 2:] * distance * [1.0, -1.0])

    def facing(self, distance: float) -> View:
        """View of the plane q_z = `distance` [m]: the undistorted photograph in metres, y up."""
        homography = np.diag([1.0, -1.0, distance])
        return View(
            homography,
            self.shape,
            self.camera,
            self.reprojection_error,
            self.markers,
            self.numbers,
        )
