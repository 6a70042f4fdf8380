"""The board's ArUco markers: where the camera stands."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from dlo_casadi.errors import VisionError
from dlo_casadi.vision.camera import Array, Camera, View, Viewpoint
from dlo_casadi.vision.image import spoilt

MAX_ERROR_PX = 2.0  # a marker worse than this is not where the configuration says
LEAST_MARKERS = 3  # for the pose of a camera: fewer span no more than a line of the board
_BEST_CORNER_PX = 0.05  # least error of a corner, from sampling and rounding to grey levels
# Largest factor by which a picture is taken to have been made smaller or larger.
_RESIZED = 20.0
CORNERS_THAT_SHARE = 4  # corners that share light, blur and print: those of a marker count as one


@dataclass(frozen=True)
class Board:
    """A flat board with ArUco markers, whose sides are parallel to the board's axes.

    Parameters
    ----------
    dictionary : str
        Name of OpenCV's predefined dictionary, e.g. DICT_4X4_50.
    marker_size : scalar [m]
        Side of the black square.
    standoff : scalar [m]
        Distance of the cable's axis in front of the board, towards the camera.
    marker_centers : dict of int to (x, y) [m]
        Centre of each marker in the board frame, by its number.
    """

    dictionary: str
    marker_size: float
    standoff: float
    marker_centers: Mapping[int, tuple[float, float]]

    def corners(self, marker: int) -> Array:
        """Corners (4, 2) [m] in the order in which ArUco reports them: clockwise from top left."""
        half = self.marker_size / 2
        square = np.array([[-half, half], [half, half], [half, -half], [-half, -half]])
        return np.asarray(self.marker_centers[marker], float) + square


def locate_board(image: NDArray[np.uint8], board: Board, camera: Camera | None = None) -> View:
    """Find the board and return the view of the cable's plane.

    With a camera, the pose (R, t) of the board minimises the reprojection error of all corners
    of all its visible markers; the cable's plane z = standoff is then seen through

        H = [r_1, r_2, t + standoff r_3]

    Without one, H is the homography of the board's own plane to pixels.

    Parameters
    ----------
    image : (H, W, 3) uint8
        The photograph.
    board : Board
        Markers and standoff.
    camera : Camera, optional
        Intrinsic matrix and distortion.

    Raises
    ------
    VisionError
        If no marker of the board is found, if the markers found contradict their declared
        places, or if a standoff is asked for without a camera.
    """
    if camera is None and board.standoff != 0.0:
        raise VisionError(
            f"a standoff of {board.standoff:g} m needs a camera: without one only the board's own "
            "plane can be measured. Try: give camera.matrix, or standoff: 0."
        )
    seen, repeated = detect_markers(image, board)
    fit = _agreeing(seen, image.shape, board, camera)
    normal = np.cross(fit.plane[:, 0], fit.plane[:, 1])
    return View(
        fit.plane + board.standoff * np.outer(normal, [0.0, 0.0, 1.0]),
        (image.shape[0], image.shape[1]),
        camera,
        fit.rms,
        np.array(list(fit.found.values())),
        tuple(sorted(fit.found)),
        _unused(board, seen, repeated, fit),
    )


def locate_camera(image: NDArray[np.uint8], board: Board, camera: Camera) -> Viewpoint:
    """Find the board and return where the camera stands before it.

    The pose (R, t) minimises the reprojection error of all corners of all visible markers.

    Parameters
    ----------
    image : (H, W, 3) uint8
        The photograph.
    board : Board
        Markers; the standoff does not count.
    camera : Camera
        Intrinsic matrix and distortion.

    Raises
    ------
    VisionError
        If fewer than three of the board's markers are seen where they are declared.
    """
    seen, repeated = detect_markers(image, board)
    if len(seen) < LEAST_MARKERS:
        raise VisionError(
            f"the camera's place needs {LEAST_MARKERS} markers of the board, and "
            f"{'only ' if seen else ''}{sorted(seen)} of {sorted(board.marker_centers)} are seen. "
            "Try: a photograph with the whole board in it, sharp and not covered."
            + spoilt(image)
            + "".join(f" The {_copied(n)}" for n in sorted(repeated))
        )
    fit = _agreeing(seen, image.shape, board, camera)
    found, plane = fit.found, fit.plane
    if len(found) < LEAST_MARKERS:
        raise VisionError(
            f"the camera's place needs {LEAST_MARKERS} markers of the board where they are "
            f"declared, and only {sorted(found)} of {sorted(seen)} are. Try: marker_centers?"
        )
    rotation = np.column_stack([plane[:, :2], np.cross(plane[:, 0], plane[:, 1])])
    corners = np.vstack([board.corners(n) for n in found])
    return Viewpoint(
        camera,
        rotation,
        plane[:, 2],
        (image.shape[0], image.shape[1]),
        _pose_covariance(corners @ rotation[:, :2].T + plane[:, 2], fit.rms, camera),
        fit.rms,
        np.array(list(found.values())),
        tuple(sorted(found)),
        _unused(board, seen, repeated, fit),
    )


@dataclass(frozen=True)
class _Fit:
    """The board's plane as markers show it."""

    found: dict[int, Array]  # corners (4, 2) [px] of each marker
    plane: Array  # (3, 3), homography to pixels; with a camera [r_1, r_2, t]
    errors: dict[int, float]  # [px], RMS of each marker

    @property
    def rms(self) -> float:
        return float(np.sqrt(np.mean(np.square(list(self.errors.values())))))

    @property
    def worst(self) -> float:
        return max(self.errors.values())


def _agreeing(
    seen: dict[int, Array], shape: tuple[int, ...], board: Board, camera: Camera | None
) -> _Fit:
    """Fit of the markers that agree with their declared places."""
    if not seen:
        raise VisionError(
            "every marker of the board is seen more than once. Try: cover or remove the copies."
        )
    fit = _fit(seen, board, camera)
    if camera is not None and (text := _other_picture(fit, board, camera, shape)):
        raise VisionError(text)
    while fit.worst > MAX_ERROR_PX and len(fit.found) > len(seen) // 2 + 1:
        rests = [{n: q for n, q in fit.found.items() if n != left_out} for left_out in fit.found]
        fit = min((_fit(rest, board, camera) for rest in rests), key=lambda trial: trial.worst)
    if fit.rms > MAX_ERROR_PX:
        raise VisionError(
            f"the markers {sorted(fit.found)} are {fit.rms:.1f} px RMS off their declared places. "
            "Try: marker_centers and marker_size in metres? camera.matrix of this picture size? "
            f"The picture is {shape[1]} x {shape[0]} px."
            f"{_other_axes(seen, board, camera)}"
        )
    return fit


def _copied(n: int) -> str:
    return f"marker {n} is seen more than once and not used. Try: cover or remove the copy."


def _unused(board: Board, seen: dict[int, Array], repeated: set[int], fit: _Fit) -> tuple[str, ...]:
    """Sentences on the markers of the board that were not used."""
    used = f"{len(fit.found)} of {len(board.marker_centers)} are used"
    lost = sorted(set(board.marker_centers) - set(fit.found) - repeated)
    why = {n: "is not where it is declared" if n in seen else "is not found" for n in lost}
    return (*map(_copied, sorted(repeated)), *(f"marker {n} {why[n]}; {used}" for n in lost))


def _pose_covariance(at: Array, rms: float, camera: Camera) -> Array:
    """Covariance (6, 6) [rad, m] of a pose from corners (K, 3) [m] in the camera's frame.

    4 (J^T J)^-1 s^2 with the corners' own scatter s^2 = sum / (2 K - 6): corners of a marker err
    together. On rendered boards poses are off by up to five times what sixteen independent
    corners would leave.
    """
    by_shift = camera.project(at)[1]
    by_turn = np.cross(at[:, None, :], by_shift)
    J = np.concatenate([by_turn, by_shift], axis=2).reshape(-1, 6)
    free = 2 * len(at) - 6
    scatter = max(rms**2 * len(at) / free, _BEST_CORNER_PX**2)
    return np.asarray(np.linalg.inv(J.T @ J) * scatter * CORNERS_THAT_SHARE)


def _other_picture(fit: _Fit, board: Board, camera: Camera, shape: tuple[int, ...]) -> str:
    """Sentence on a matrix of a picture of another size, or turned; empty if it fits as it is.

    A principal point is near the middle of the picture that it was found in.
    """
    height, width = shape[:2]
    (fx, _, cx), (_, fy, cy), _ = camera.matrix
    size = float(np.sqrt(4 * abs(cx * cy) / (width * height)))
    turn = "turn it back, as the pictures that it was calibrated with; was its EXIF tag lost?"
    others = [
        ("turned by 90 degrees", turn, (fy, fx, cy, height - 1 - cx)),
        ("turned by -90 degrees", turn, (fy, fx, width - 1 - cy, cx)),
        ("turned by 180 degrees", turn, (fx, fy, width - 1 - cx, height - 1 - cy)),
    ]
    if 1 / _RESIZED < size < _RESIZED:
        cure = (
            f"pictures of the size that it was calibrated with, or fx, fy, cx, cy over {size:.3g}."
        )
        scaled = (fx / size, fy / size, cx / size, cy / size)
        others.insert(0, (f"divided by {size:.3g}", cure, scaled))
    matrices = [np.array([[a, 0, u], [0, b, v], [0, 0, 1]]) for *_, (a, b, u, v) in others]
    errors = [_fit(fit.found, board, Camera(m, camera.distortion)).rms for m in matrices]
    how, cure, _ = others[int(np.argmin(errors))]
    if max(min(errors), _BEST_CORNER_PX) > fit.rms / 2:
        return ""
    return (
        f"camera.matrix, with its principal point at ({cx:g}, {cy:g}) px, is not that of this "
        f"picture of {width} x {height} px: the markers are {fit.rms:.2g} px RMS off their "
        f"declared places, but {min(errors):.2g} px with the matrix {how}. Try: {cure}"
    )


# Mistakes in marker_centers: what was written -> the board's axes, x right and y up.
_AXES = {
    "y pointing up": np.array([[1.0, 0.0], [0.0, -1.0]]),
    "x pointing right": np.array([[-1.0, 0.0], [0.0, 1.0]]),
    "x and y exchanged": np.array([[0.0, 1.0], [1.0, 0.0]]),
    "both turned by 90 degrees": np.array([[0.0, 1.0], [-1.0, 0.0]]),
    "both turned by -90 degrees": np.array([[0.0, -1.0], [1.0, 0.0]]),
    "both turned by 180 degrees": np.array([[-1.0, 0.0], [0.0, -1.0]]),
}


def _other_axes(found: dict[int, Array], board: Board, camera: Camera | None) -> str:
    """Sentence on the axes with which the declared places would fit, if some do."""
    for what, axes in _AXES.items():
        centers = {n: axes @ np.asarray(board.marker_centers[n], float) for n in found}
        fit = _fit(found, replace(board, marker_centers=centers), camera)
        if len(found) > 1 and fit.worst < MAX_ERROR_PX:
            return f" With {what} in marker_centers they fit."
    return ""


def detect_markers(image: NDArray[np.uint8], board: Board) -> tuple[dict[int, Array], set[int]]:
    """Corners (4, 2) [px] of the board's markers, and the numbers that are seen more than once."""
    number = getattr(cv2.aruco, board.dictionary, None)
    if not board.dictionary.startswith("DICT_") or number is None:
        known = ", ".join(sorted(n for n in dir(cv2.aruco) if n.startswith("DICT_"))[:6])
        raise VisionError(f"unknown ArUco dictionary {board.dictionary!r}. Try: {known}, ...")
    grey = cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
    detector = cv2.aruco.ArucoDetector(cv2.aruco.getPredefinedDictionary(number))
    found = _markers(detector, grey)
    ours = {n: quads for n, quads in found.items() if n in board.marker_centers}
    if not ours:
        other = f"only markers {sorted(found)}" if found else "no marker at all"
        raise VisionError(
            f"board not found: {other} of {board.dictionary} in the picture, but the board has "
            f"{sorted(board.marker_centers)}. Try: the right dictionary; markers flat, in focus, "
            f"inside the picture, with a white margin (mean brightness {grey.mean():.0f} of 255)."
            f"{spoilt(image)}{_mirrored(detector, grey, board)}"
        )
    single = {n: _refine(grey, quads[0]) for n, quads in ours.items() if len(quads) == 1}
    return single, set(ours) - set(single)


def _markers(detector: cv2.aruco.ArucoDetector, grey: NDArray[np.uint8]) -> dict[int, list[Array]]:
    """Corners (4, 2) [px] of all markers by their numbers, once for each time one is seen."""
    quads, numbers, _ = detector.detectMarkers(grey)
    found: dict[int, list[Array]] = {}
    for number, quad in zip([] if numbers is None else numbers.ravel(), quads, strict=True):
        found.setdefault(int(number), []).append(quad.reshape(4, 2))
    return found


def _mirrored(detector: cv2.aruco.ArucoDetector, grey: NDArray[np.uint8], board: Board) -> str:
    """Sentence for a mirrored photograph."""
    flipped = _markers(detector, np.ascontiguousarray(grey[:, ::-1]))
    ours = sorted(set(flipped) & set(board.marker_centers))
    return f" The picture is mirrored: in its mirror image there are {ours}." if ours else ""


def _refine(grey: NDArray[np.uint8], quad: Array) -> Array:
    """Corners of a black square on white as the intersections of its four straight sides.

    Corner detectors look for saddles; on the L of a blurred square they are pulled inwards by
    about 0.2 px. A side is the median place at which the brightness steps from black to white.
    """
    corners = np.asarray(quad, float)
    for _ in range(2):
        lines = [_side(grey, corners[i], corners[(i + 1) % 4]) for i in range(4)]
        corners = np.array([_meet(lines[i - 1], lines[i]) for i in range(4)])
    jump = np.linalg.norm(corners - quad, axis=1).max()
    size = np.linalg.norm(quad - np.roll(quad, 1, axis=0), axis=1).min()
    return corners if jump < 0.1 * size else np.asarray(quad, float)


def _side(grey: NDArray[np.uint8], a: Array, b: Array) -> tuple[Array, Array]:
    """Line (point, direction) along the step from black (right of a -> b) to white (left)."""
    length = float(np.linalg.norm(b - a))
    along = (b - a) / length
    outwards = np.array([along[1], -along[0]])
    reach = max(length / 12, 1.5)  # half a cell of the pattern
    share = np.linspace(0.1, 0.9, max(12, int(2 * length)))
    offset = np.linspace(-reach, reach, 25)
    at = a + share[:, None, None] * (b - a) + offset[None, :, None] * outwards
    profile = cv2.remap(grey, at.astype(np.float32), None, cv2.INTER_LINEAR).astype(float)
    black, white = profile[:, :3].mean(), profile[:, -3:].mean()
    if white - black < 10.0:
        return a, along
    dark_share = np.clip((white - profile) / (white - black), -0.1, 1.1).mean(axis=1)
    edge = (2 * dark_share - 1) * reach
    keep = np.abs(edge - np.median(edge)) < 0.5
    slope, middle = np.polyfit(share[keep] - 0.5, edge[keep], 1)
    direction = along * length + outwards * slope
    return (a + b) / 2 + outwards * middle, direction / np.linalg.norm(direction)


def _meet(one: tuple[Array, Array], other: tuple[Array, Array]) -> Array:
    """Intersection of two lines (point, direction)."""
    steps = np.linalg.solve(np.column_stack([one[1], -other[1]]), other[0] - one[0])
    return one[0] + steps[0] * one[1]


def _fit(found: dict[int, Array], board: Board, camera: Camera | None) -> _Fit:
    """Fit the board's plane to markers."""
    pixels = np.vstack(list(found.values()))
    points = np.vstack([board.corners(marker) for marker in found])
    if camera is None:
        plane, _ = cv2.findHomography(points, pixels)
        projected = View(plane, (1, 1)).to_pixels(points)
    else:
        solid = np.column_stack([points, np.zeros(len(points))])
        rotation, shift, projected = _pose(solid, pixels, camera)
        plane = np.column_stack([cv2.Rodrigues(rotation)[0][:, :2], shift.ravel()])
    miss = np.sum((projected - pixels) ** 2, axis=1).reshape(-1, 4)
    return _Fit(found, plane, dict(zip(found, np.sqrt(miss.mean(axis=1)), strict=True)))


def _pose(solid: Array, pixels: Array, camera: Camera) -> tuple[Array, Array, Array]:
    """Pose of least reprojection error among the two that a plane allows, and its pixels."""
    lens = camera.matrix, camera.distortion
    _, rotations, shifts, _ = cv2.solvePnPGeneric(solid, pixels, *lens, flags=cv2.SOLVEPNP_IPPE)
    trials = []
    for rotation, shift in zip(rotations, shifts, strict=True):
        pose = cv2.solvePnPRefineLM(solid, pixels, *lens, rotation.copy(), shift.copy())
        trials.append((*pose, cv2.projectPoints(solid, *pose, *lens)[0][:, 0]))
    if not trials:
        raise VisionError("the pose of the board cannot be solved from its markers.")
    return min(trials, key=lambda trial: float(np.mean((trial[2] - pixels) ** 2)))
