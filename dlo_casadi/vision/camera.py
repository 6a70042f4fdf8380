"""Cameras: map pixels to the cable's plane and back, and project a round cable in space."""

from dataclasses import dataclass, field, fields, replace

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

from dlo_casadi.arrays import FloatArray, unit
from dlo_casadi.errors import VisionError

Picture = NDArray[np.uint8]

# Stopping rule of OpenCV's fixed-point inversion of a lens. Its five default steps leave 0.6 px
# if a lens moves the corners by 60 px; 1e-10 px takes thirty steps there, ten for 10 px.
_UNDISTORTED = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 100, 1e-10)


@dataclass(frozen=True)
class Camera:
    """A pinhole camera with a lens, both as OpenCV defines them."""

    matrix: FloatArray
    """(3, 3) [px]: [[fx, 0, cx], [0, fy, cy], [0, 0, 1]]."""
    distortion: FloatArray
    """k1, k2, p1, p2[, k3[, k4, k5, k6[, s1, s2, s3, s4[, tau_x, tau_y]]]], or none: radial and
    tangential, rational, thin prism, tilted sensor."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "matrix", np.asarray(self.matrix, float).reshape(3, 3))
        object.__setattr__(self, "distortion", np.asarray(self.distortion, float).ravel())

    @property
    def focal(self) -> float:
        """Focal length [px], the mean of both axes."""
        return float(0.5 * (self.matrix[0, 0] + self.matrix[1, 1]))

    def project(self, points: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Pixels (K, 2) of points (K, 3) [m] in the camera's frame, d(pixel)/d(point) (K, 2, 3)."""
        if not len(points):
            return np.zeros((0, 2)), np.zeros((0, 2, 3))
        still = np.zeros(3)
        pixels, slopes = cv2.projectPoints(points, still, still, self.matrix, self.distortion)
        return pixels[:, 0], slopes[:, 3:6].reshape(-1, 2, 3)

    def distort(self, rays: FloatArray) -> FloatArray:
        """Pixels (K, 2) at which undistorted normalised rays (K, 2) are seen."""
        return self.project(np.column_stack([rays, np.ones(len(rays))]))[0]

    def undistort(self, pixels: FloatArray) -> FloatArray:
        """Undistorted normalised rays (K, 2) of pixels (K, 2): the inverse of `distort`."""
        if not len(pixels):
            return pixels
        rays = cv2.undistortPoints(pixels, self.matrix, self.distortion, criteria=_UNDISTORTED)
        return np.asarray(rays, float).reshape(-1, 2)


@dataclass(frozen=True, kw_only=True)
class Photograph:
    """A picture's camera, and the board as seen in it."""

    shape: tuple[int, int]
    """Height and width [px]."""
    camera: Camera | None = None
    """Its matrix and lens."""
    reprojection_error: float = 0.0
    """Root mean square [px] over the corners of the markers; 0 for two reference points."""
    markers: FloatArray = field(default_factory=lambda: np.zeros((0, 4, 2)))
    """Corners (n, 4, 2) [px] of the markers that were used, by their numbers."""
    numbers: tuple[int, ...] = ()
    """These numbers, the smallest one first."""
    messages: tuple[str, ...] = ()
    """Which markers were not used, and why."""


@dataclass(frozen=True, kw_only=True)
class View(Photograph):
    """Map between the pixels of one photograph and the plane of the cable.

    A plane point (x, y) and the ray through its pixel satisfy, up to the factor w,

        w [a, b, 1]^T = H [x, y, 1]^T

    where (a, b) is the undistorted ray in normalised camera coordinates when a camera is known,
    and the pixel (u, v) itself when not.
    """

    homography: FloatArray
    """H (3, 3): board frame [m] to rays [-], or to pixels [px] without a camera."""

    def to_board(self, pixels: ArrayLike) -> FloatArray:
        """Points of the cable's plane [m] seen at pixels (K, 2) [px]; shape (K, 2)."""
        seen = np.asarray(pixels, float).reshape(-1, 2)
        rays = seen if self.camera is None else self.camera.undistort(seen)
        return _apply(np.linalg.inv(self.homography), rays)

    def to_pixels(self, points: ArrayLike) -> FloatArray:
        """Pixels (K, 2) [px] at which points (K, 2) [m] of the cable's plane are seen."""
        rays = _apply(self.homography, np.asarray(points, float).reshape(-1, 2))
        return rays if self.camera is None else self.camera.distort(rays)

    @property
    def camera_center(self) -> FloatArray | None:
        """Centre of the camera (3,) [m]; None if it is not known.

        x, y in the board frame, z in front of the cable's plane: C = -R^T t with
        H = [r_1, r_2, t] of a calibrated camera.
        """
        if self.camera is None:
            return None
        one, other, shift = self.homography.T
        return -np.stack([one, other, np.cross(one, other)]) @ shift

    @property
    def scale(self) -> float:
        """Pixels per metre near the middle of the picture."""
        height, width = self.shape
        middle = np.array([(width - 1) / 2, (height - 1) / 2])
        x, y = self.to_board(middle + np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])).T
        area = abs(x @ np.roll(y, -1) - y @ np.roll(x, -1)) / 2
        return float(np.sqrt(4.0 / area))


def _apply(homography: FloatArray, points: FloatArray) -> FloatArray:
    mapped = points @ homography[:, :2].T + homography[:, 2]
    return mapped[:, :2] / mapped[:, 2:]


def from_reference(pixels: ArrayLike, points: ArrayLike, shape: tuple[int, ...]) -> View:
    """View of a camera square to the cable's plane, from two known points in the picture.

    With z = x + i y on the board and q = u - i v in the picture (rows run down, y runs up),

        q = A z + B,   A = (q_2 - q_1) / (z_2 - z_1)

    Parameters
    ----------
    pixels : (2, 2) [px]
        Column u and row v of each point.
    points : (2, 2) [m]
        The same points in the board frame, x right, y up.
    shape : (height, width, ...) [px]
        Size of the photograph.

    Raises
    ------
    VisionError
        If the two points coincide, in the picture or on the board.
    """
    q = np.asarray(pixels, float) @ [1, -1j]
    z = np.asarray(points, float) @ [1, 1j]
    if abs(q[1] - q[0]) < 1.0 or abs(z[1] - z[0]) < 1e-6:
        raise VisionError(
            f"the two reference points are {abs(q[1] - q[0]):.3g} px and {abs(z[1] - z[0]):.3g} m "
            "apart: too close for a scale. Try: points far apart, in px and in m."
        )
    a = (q[1] - q[0]) / (z[1] - z[0])
    b = q[0] - a * z[0]
    homography = np.array([[a.real, -a.imag, b.real], [-a.imag, -a.real, -b.imag], [0, 0, 1]])
    return View(homography=homography, shape=(int(shape[0]), int(shape[1])))


@dataclass(frozen=True, kw_only=True)
class CameraPose(Photograph):
    """Pose of the camera of one photograph.

    A point p of the board frame (x right, y up, z out of the board) is at

        q = R p + t

    in the camera's frame (x right, y down, z ahead), and is seen at the pixel distort(q_xy / q_z).
    """

    camera: Camera
    rotation: FloatArray
    """R (3, 3), from the board's axes to the camera's."""
    translation: FloatArray
    """t (3,) [m], the board's origin in the camera's frame."""
    covariance: FloatArray
    """(6, 6) [rad, m], of a small rotation w and a shift d of the board in the camera's frame,
    q -> q + w x q + d, from the scatter of the corners."""

    @property
    def center(self) -> FloatArray:
        """Centre of the camera (3,) [m] in the board frame, C = -R^T t."""
        return -self.rotation.T @ self.translation

    def in_camera(self, points: ArrayLike) -> FloatArray:
        """Points (K, 3) [m] of the board frame in the camera's frame."""
        return np.asarray(points, float).reshape(-1, 3) @ self.rotation.T + self.translation

    def to_pixels(self, points: ArrayLike) -> FloatArray:
        """Pixels (K, 2) [px] at which points (K, 3) [m] are seen."""
        return self.project(points)[0]

    def project(self, points: ArrayLike) -> tuple[FloatArray, FloatArray]:
        """Pixels (K, 2) [px] of points (K, 3) [m], and d(pixel)/d(point) (K, 2, 3) [px/m]."""
        pixels, slopes = self.camera.project(self.in_camera(points))
        return pixels, slopes @ self.rotation

    def rays(self, pixels: ArrayLike) -> FloatArray:
        """Undistorted rays (K, 2), q_xy / q_z, of pixels (K, 2) [px]."""
        return self.camera.undistort(np.asarray(pixels, float).reshape(-1, 2))

    def moved(self, motion: FloatArray) -> "CameraPose":
        """Turn the board by the rotation vector w and shift it by d in the camera's frame."""
        turn = Rotation.from_rotvec(motion[:3]).as_matrix()
        shift = turn @ self.translation + motion[3:]
        return replace(self, rotation=turn @ self.rotation, translation=shift)

    def flattened(self, points: ArrayLike, distance: float) -> FloatArray:
        """Places (K, 2) [m] in the plane of `facing` at which points (K, 3) [m] are seen."""
        at = self.in_camera(points)
        return np.asarray(at[:, :2] / at[:, 2:] * distance * [1.0, -1.0])

    def facing(self, distance: float) -> View:
        """View of the plane q_z = `distance` [m]: the undistorted photograph in metres, y up."""
        shown = {item.name: getattr(self, item.name) for item in fields(Photograph)}
        return View(homography=np.diag([1.0, -1.0, distance]), **shown)


def project_outline(
    viewpoint: CameraPose, points: ArrayLike, tangents: ArrayLike, diameter: float
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Project the outline of a round cable.

    Parameters
    ----------
    points, tangents : (K, 3) [m], [-]
        Of its axis, in the board frame; unit tangents.

    Returns
    -------
    Middles (K, 2) [px] between the two edges, unit vectors (K, 2) across the projected axis, and
    d(pixel)/d(point) (K, 2, 3) [px/m] in the board frame. The derivative is that of the axis, which
    the middle follows to one part in 1e4.

    The two planes through the camera that touch a straight cylinder of radius r about the axis
    through p (in the camera's frame) along t are at +-a from the plane of the axis, with sin a =
    r / d, d the distance of the camera from the axis. With e the unit vector from the camera to
    the axis, square to it, and b = t x e they cut the normalised picture at

        s = +-r / p_z / (B cos a -+ g sin a),  B = |b_xy|,  g = e_xy . b_xy / B

    across the axis. The middle between both is off the projected axis by r g sin a / p_z /
    (B^2 cos^2 a - g^2 sin^2 a): zero in the middle of the picture, about r^2 f / (2 d^2) in its
    corners; with f = 1080 px 0.002 px for a cable of 7 mm at 1.7 m, 0.08 px for 12 mm at 0.5 m.

    A bent cable is the envelope of spheres along its axis. The projected axis is in the middle of
    the outline if its radius exceeds the outline's width; not so where a bend seen from its side
    is a cusp, and where another part of the cable shares the outline.
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
    # A cable seen end-on shows its section; its middle is the axis to within a radius.
    squares = np.maximum(B**2 * (1.0 - sin**2) - (g * sin) ** 2, sin**2)
    off = np.clip(radius * g * sin / squares, -radius, radius) / p[:, 2]
    across = b[:, :2] / B[:, None]
    # d(pixel)/d(ray) = p_z d(pixel)/d(p_xy), and a step in the ray's plane changes no depth
    by_ray = p[:, 2, None, None] * (slopes @ viewpoint.rotation.T)[:, :, :2]
    step = np.einsum("kij,kj->ki", by_ray, across)
    along = unit(np.einsum("kij,kj->ki", slopes, np.asarray(tangents, float).reshape(-1, 3)))
    normals = np.column_stack([-along[:, 1], along[:, 0]])
    return pixels + off[:, None] * step, normals, slopes


def compare_pixels(
    viewpoint: CameraPose,
    pixels: ArrayLike,
    points: ArrayLike,
    tangents: ArrayLike,
    diameter: float,
) -> tuple[FloatArray, FloatArray]:
    """Pixels measured minus those of a curve, across it.

    Parameters
    ----------
    pixels : (K, 2) [px]
        Measured middles of the outline, as photographed.
    points, tangents : (K, 3) [m], [-]
        Of the curve, at the nearest place to each pixel in the picture, where the distance is
        stationary.

    Returns
    -------
    Distances (K,) [px], and d(distance)/d(point) (K, 3) [px/m].
    """
    middle, normals, slopes = project_outline(viewpoint, points, tangents, diameter)
    distance = np.sum((np.asarray(pixels, float) - middle) * normals, axis=1)
    return distance, -np.einsum("ki,kij->kj", normals, slopes)
