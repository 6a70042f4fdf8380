"""Find the board's ArUco markers, and the pose of the camera from them."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from itertools import combinations
from typing import Any

import cv2
import numpy as np
from scipy.optimize import minimize_scalar

from dlo_casadi.arrays import FloatArray
from dlo_casadi.errors import VisionError, counted
from dlo_casadi.vision.camera import Camera, CameraPose, Picture, View
from dlo_casadi.vision.image import spoilt
from dlo_casadi.vision.other_markers import find_markers, other_markers

MAX_ERROR_PX = 2.0  # largest error of a marker at its declared place
LEAST_MARKERS = 3  # fewest markers for a camera's pose: two define only a line
_LEAST_IN_PLANE = 2  # the same for a plane: with one marker a rendered cable was 13 mm off
CORNERS_THAT_SHARE = 4  # corners of a marker share an error (light, blur, print): they count as one
# Shift of the edges of black squares by gamma and blur [px]: 0.4 in sharp rendered pictures, 1 in
# blurred ones. It is bounded by the largest error of a marker; beyond, a square has another size.
_EDGE_SHIFT_PX = 0.5
_CORNER_PX = 0.1  # typical error of a corner beside it
_BEST_CORNER_PX = 0.05  # smallest error of a corner, from sampling and rounding to grey levels
_FEW = 8  # most markers of which exchanges are tried: 35 fits of the plane
_RESIZED = 20.0  # largest factor by which a picture may have been resized

# Mistakes in marker_centers: axes as written -> the board's axes, x right and y up.
_AXES = {
    "y pointing up": [[1, 0], [0, -1]],
    "x pointing right": [[-1, 0], [0, 1]],
    "x and y exchanged": [[0, 1], [1, 0]],
    "both turned by 90 degrees": [[0, 1], [-1, 0]],
    "both turned by -90 degrees": [[0, -1], [1, 0]],
    "both turned by 180 degrees": [[-1, 0], [0, -1]],
}


@dataclass(frozen=True)
class Board:
    """A flat board with ArUco markers, whose sides are parallel to the board's axes."""

    dictionary: str
    """Name of OpenCV's predefined dictionary, e.g. DICT_4X4_50."""
    marker_size: float
    """Side of the black square [m]."""
    standoff: float
    """Distance [m] of the cable's axis in front of the board, towards the camera."""
    marker_centers: Mapping[int, tuple[float, float] | FloatArray]
    """Centre (x, y) [m] of each marker in the board frame, by its number."""

    def corners(self, marker: int) -> FloatArray:
        """Corners (4, 2) [m] in the order in which ArUco reports them: clockwise from top left."""
        square = np.array([[-1, 1], [1, 1], [1, -1], [-1, -1]]) * (self.marker_size / 2)
        return np.asarray(self.marker_centers[marker], float) + square


def locate_board(image: Picture, board: Board, camera: Camera | None = None) -> View:
    """Find the board and return the view of the cable's plane.

    With a camera, the pose (R, t) of the board minimises the reprojection error of all corners
    of all its visible markers; the cable's plane z = standoff is then seen through

        H = [r_1, r_2, t + standoff r_3]

    Without one, H is the homography of the board's own plane to pixels. `image` (H, W, 3) uint8 is
    the photograph.

    Raises
    ------
    VisionError
        If fewer than two of the board's markers are seen, if those contradict their declared
        places, or if a standoff is given without a camera.
    """
    if camera is None and board.standoff != 0.0:
        raise VisionError(
            f"a standoff of {board.standoff:g} m needs a camera: without one only the board's own "
            "plane can be measured. Try: give camera.matrix, or standoff: 0."
        )
    fit, seen = _located(image, board, camera, _LEAST_IN_PLANE, "board")
    normal = np.cross(fit.plane[:, 0], fit.plane[:, 1])
    cable = fit.plane + board.standoff * np.outer(normal, [0.0, 0.0, 1.0])
    return View(homography=cable, camera=camera, **seen)


def locate_camera(image: Picture, board: Board, camera: Camera) -> CameraPose:
    """Find the board and return the pose of the camera.

    The pose (R, t) minimises the reprojection error of all corners of all visible markers. The
    board's standoff is not used; the rest is as in `locate_board`.

    Raises
    ------
    VisionError
        If fewer than three of the board's markers are seen where they are declared.
    """
    fit, seen = _located(image, board, camera, LEAST_MARKERS, "camera")
    one, other, shift = fit.plane.T
    rotation = np.column_stack([one, other, np.cross(one, other)])
    at = np.vstack([board.corners(n) for n in fit.found]) @ rotation[:, :2].T + shift
    # Corners of a marker share an error: 4 (J^T J)^-1 s^2 with the corners' scatter s^2 = sum /
    # (2 K - 7), J by the pose and the shift of edges. On rendered boards the error of poses is up
    # to five times that of sixteen independent corners.
    by_shift = camera.project(at)[1]
    edges = np.vstack([_outwards(quad) for quad in fit.found.values()])
    J = np.concatenate([np.cross(at[:, None, :], by_shift), by_shift, edges[..., None]], axis=2)
    J = J.reshape(-1, 7)
    scatter = max(fit.rms**2 * len(at) / (2 * len(at) - 7), _BEST_CORNER_PX**2)
    return CameraPose(
        camera=camera,
        rotation=rotation,
        translation=shift,
        covariance=np.linalg.inv(J.T @ J)[:6, :6] * scatter * CORNERS_THAT_SHARE,
        **seen,
    )


@dataclass(frozen=True)
class _Fit:
    """The board's plane, fitted to markers."""

    found: dict[int, FloatArray]  # corners (4, 2) [px] of each marker
    plane: FloatArray  # (3, 3), homography to pixels; with a camera [r_1, r_2, t]
    errors: FloatArray  # (n,) [px], RMS of each marker

    @property
    def rms(self) -> float:
        return float(np.sqrt(np.mean(np.square(self.errors))))


def _located(
    image: Picture, board: Board, camera: Camera | None, least: int, sought: str
) -> tuple[_Fit, dict[str, Any]]:
    """Fit of the markers that agree with their declared places, with the fields of a Photograph.

    `least`: number of markers that the place of what is `sought` needs.
    """
    seen, repeated = detect_markers(image, board)
    copies = [
        f"marker {n} is seen more than once and not used. Try: cover or remove the copy."
        for n in sorted(repeated)
    ]
    if len(seen) < least:
        raise VisionError(
            f"the {sought}'s place needs {counted(least, 'marker')} of the board, and "
            f"{'only ' if seen else ''}{sorted(seen)} of {sorted(board.marker_centers)} are seen. "
            "Try: a photograph with the whole board in it, sharp and not covered."
            + spoilt(image)
            + _instead(np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY), np.uint8), board)
            + "".join(f" The {copy}" for copy in copies)
        )
    height, width = image.shape[:2]
    fit = _fit(seen, board, camera)
    if camera is not None and (text := _other_picture(fit, board, camera, (width, height))):
        raise VisionError(text)
    while fit.errors.max() > MAX_ERROR_PX and len(fit.found) > len(seen) // 2 + 1:
        rests = [{n: q for n, q in fit.found.items() if n != left_out} for left_out in fit.found]
        fit = min((_fit(rest, board, camera) for rest in rests), key=lambda fit: fit.errors.max())
    if fit.rms > MAX_ERROR_PX:
        raise VisionError(
            f"the markers {sorted(fit.found)} are {fit.rms:.1f} px RMS off their declared places. "
            "Try: marker_centers and marker_size in metres? camera.matrix of this picture size? "
            f"The picture is {width} x {height} px.{_other_board(seen, board, camera)}"
        )
    if len(fit.found) < least:
        raise VisionError(
            f"the {sought}'s place needs {counted(least, 'marker')} of the board where they are "
            f"declared, and only {sorted(fit.found)} of {sorted(seen)} are. Try: marker_centers?"
        )
    used = f"{len(fit.found)} of {len(board.marker_centers)} are used"
    lost = sorted(set(board.marker_centers) - set(fit.found) - repeated)
    why = {n: "is not where it is declared" if n in seen else "is not found" for n in lost}
    return fit, {
        "shape": (height, width),
        "reprojection_error": fit.rms,
        "markers": np.array([fit.found[n] for n in sorted(fit.found)]),
        "numbers": tuple(sorted(fit.found)),
        "messages": (*copies, *(f"marker {n} {why[n]}; {used}" for n in lost)),
    }


def _fit(found: dict[int, FloatArray], board: Board, camera: Camera | None) -> _Fit:
    """Fit the board's plane to markers with the edges where they are without gamma and blur."""
    plane, off = _fit_plane(widened(found, board, camera), board, camera)
    return _Fit(found, plane, np.sqrt(np.sum(off**2, axis=1).reshape(-1, 4).mean(axis=1)))


def widened(
    found: dict[int, FloatArray], board: Board, camera: Camera | None
) -> dict[int, FloatArray]:
    """Corners of markers, moved outwards by the shift e [px] of all edges in this picture.

    Light and blur make black squares smaller, which would tilt the plane. With the errors
    r(e) = r_0 + e d of the corners after the fit of the plane, nearly linear, and the standard
    deviations s of e and c of corners, of which those of a marker count as one,

        e = -(r_0 . d) / (d . d + 4 c^2 / s^2)
    """

    def moved(shift: float) -> tuple[dict[int, FloatArray], FloatArray]:
        outer = {n: quad + shift * _outwards(quad) for n, quad in found.items()}
        return outer, _fit_plane(outer, board, camera)[1]

    as_seen = moved(0.0)
    slope = moved(1.0)[1] - as_seen[1]
    known = CORNERS_THAT_SHARE * (_CORNER_PX / _EDGE_SHIFT_PX) ** 2
    shift = -float(np.sum(as_seen[1] * slope) / (np.sum(slope**2) + known))
    other = moved(float(np.clip(shift, -MAX_ERROR_PX, MAX_ERROR_PX)))
    # Of two poses from few corners the other one may follow; its errors are then larger.
    return min(as_seen, other, key=lambda trial: float(np.sum(trial[1] ** 2)))[0]


def _outwards(quad: FloatArray) -> FloatArray:
    """Steps (4, 2) of the corners of a square that move all its sides outwards by 1."""
    along = np.roll(quad, -1, axis=0) - quad
    normal = np.column_stack([along[:, 1], -along[:, 0]])
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    before = np.roll(normal, 1, axis=0)
    return np.asarray((normal + before) / (1 + np.sum(normal * before, axis=1, keepdims=True)))


def _fit_plane(
    found: dict[int, FloatArray], board: Board, camera: Camera | None
) -> tuple[FloatArray, FloatArray]:
    """Board's plane, the better of the two poses that fit, and errors of corners (4 n, 2) [px]."""
    pixels = np.vstack(list(found.values()))
    points = np.vstack([board.corners(marker) for marker in found])
    if camera is None:
        plane, _ = cv2.findHomography(points, pixels)
        return plane, View(homography=plane, shape=(1, 1)).to_pixels(points) - pixels
    solid = np.column_stack([points, np.zeros(len(points))])
    lens = camera.matrix, camera.distortion
    _, *poses, _ = cv2.solvePnPGeneric(solid, pixels, *lens, flags=cv2.SOLVEPNP_IPPE)
    trials = []
    for rotation, shift in zip(*poses, strict=True):
        pose = cv2.solvePnPRefineLM(solid, pixels, *lens, rotation.copy(), shift.copy())
        trials.append((*pose, cv2.projectPoints(solid, *pose, *lens)[0][:, 0] - pixels))
    if not trials:
        raise VisionError("the pose of the board cannot be solved from its markers.")
    rotation, shift, off = min(trials, key=lambda trial: np.sum(trial[2] ** 2))
    return np.column_stack([cv2.Rodrigues(rotation)[0][:, :2], shift.ravel()]), off


def _other_picture(fit: _Fit, board: Board, camera: Camera, shape: tuple[int, int]) -> str:
    """Sentence on a camera matrix of another picture size or a rotated picture; empty if it fits.

    A principal point is near the middle of the picture from which it was estimated. Markers that
    are within the shift of their edges may be nearer by chance with another matrix.
    """
    if fit.rms < _EDGE_SHIFT_PX:
        return ""
    width, height = shape
    (fx, _, cx), (_, fy, cy), _ = camera.matrix
    turn = "turn it back, as the pictures that it was calibrated with; was its EXIF tag lost?"
    turned = {
        "turned by 90 degrees": (fy, fx, cy, height - 1 - cx),
        "turned by -90 degrees": (fy, fx, width - 1 - cy, cx),
        "turned by 180 degrees": (fx, fy, width - 1 - cx, height - 1 - cy),
    }

    def error(numbers: tuple[float, float, float, float]) -> float:
        """RMS [px] of the markers with other fx, fy, cx, cy."""
        a, b, u, v = numbers
        matrix = np.array([[a, 0, u], [0, b, v], [0, 0, 1]])
        return _fit(fit.found, board, Camera(matrix, camera.distortion)).rms

    def resized(factor: float) -> float:
        return error((fx / factor, fy / factor, cx / factor, cy / factor))

    off, how = min((error(numbers), how) for how, numbers in turned.items())
    cure = turn
    size = float(np.sqrt(4 * abs(cx * cy) / (width * height)))
    if 1 / _RESIZED < size < _RESIZED and resized(size) < min(off, fit.rms / 2):
        size, off = _least(resized, size, 1.1)
        how = f"divided by {size:.3g}"
        cure = (
            f"pictures of the size that it was calibrated with, or fx, fy, cx, cy over {size:.3g}."
        )
    if max(off, _BEST_CORNER_PX) > fit.rms / 2:
        return ""
    return (
        f"camera.matrix, with its principal point at ({cx:g}, {cy:g}) px, is not that of this "
        f"picture of {width} x {height} px: the markers are {fit.rms:.2g} px RMS off their "
        f"declared places, but {off:.2g} px with the matrix {how}. Try: {cure}"
    )


def _least(error: Callable[[float], float], about: float, factor: float) -> tuple[float, float]:
    """Positive number of least error, within a factor of `about`, and that error."""
    ends = np.log(about) + np.array([-1.0, 1.0]) * np.log(factor)
    best = minimize_scalar(lambda z: error(np.exp(z)), bounds=ends, options={"xatol": 1e-3})
    return float(np.exp(best.x)), float(best.fun)


def _other_board(found: dict[int, FloatArray], board: Board, camera: Camera | None) -> str:
    """Sentence on other axes, places or sizes of markers that would fit, if there are any."""

    def fits(**changes: Any) -> bool:
        trial = replace(board, **changes)
        return len(found) > 1 and _fit(found, trial, camera).errors.max() < MAX_ERROR_PX

    places = board.marker_centers
    for what, axes in _AXES.items():
        if fits(marker_centers={n: np.array(axes) @ np.array(places[n], float) for n in found}):
            return f" With {what} in marker_centers they fit."
    numbers = sorted(places)
    swaps = [{a: b, b: a} for a, b in combinations(numbers, 2) if a in found or b in found]
    cycles = [
        dict(zip(numbers, numbers[k:] + numbers[:k], strict=True)) for k in range(1, len(numbers))
    ]
    if len(numbers) > _FEW:
        swaps, cycles = [], []
    for moved in swaps + cycles:
        if fits(marker_centers={n: places[moved.get(n, n)] for n in found}):
            text = ", ".join(f"{n} at the place of {m}" for n, m in moved.items())
            return f" With {text} in marker_centers they fit."

    def off(size: float) -> float:
        return float(np.sum(_fit_plane(found, replace(board, marker_size=size), camera)[1] ** 2))

    size, _ = _least(off, board.marker_size, 5.0)
    return f" With a marker_size of about {size:.2g} m they fit." if fits(marker_size=size) else ""


def detect_markers(image: Picture, board: Board) -> tuple[dict[int, FloatArray], set[int]]:
    """Corners (4, 2) [px] of the board's markers, and numbers of markers seen more than once."""
    number = getattr(cv2.aruco, board.dictionary, None)
    if not board.dictionary.startswith("DICT_") or number is None:
        known = ", ".join(sorted(n for n in dir(cv2.aruco) if n.startswith("DICT_"))[:6])
        raise VisionError(f"unknown ArUco dictionary {board.dictionary!r}. Try: {known}, ...")
    grey = np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY), np.uint8)
    found = find_markers(grey, board.dictionary)
    ours = {n: quads for n, quads in found.items() if n in board.marker_centers}
    if not ours:
        other = f"only markers {sorted(found)}" if found else "no marker at all"
        raise VisionError(
            f"board not found: {other} of {board.dictionary} in the picture, but the board has "
            f"{sorted(board.marker_centers)}. Try: the right dictionary; markers flat, in focus, "
            f"inside the picture, with a white margin (mean brightness {grey.mean():.0f} of 255)."
            f"{spoilt(image)}{_instead(grey, board)}"
        )
    single = {n: _refine(grey, quads[0]) for n, quads in ours.items() if len(quads) == 1}
    return single, set(ours) - set(single)


def _instead(grey: Picture, board: Board) -> str:
    """Sentence on what a picture shows in place of the board's markers; empty if nothing is."""
    mirrored = find_markers(np.ascontiguousarray(grey[:, ::-1]), board.dictionary)
    if flipped := sorted({*mirrored} & {*board.marker_centers}):
        return f" The picture is mirrored: in its mirror image there are {flipped}."
    return other_markers(grey, board.dictionary, board.marker_centers)


def _refine(grey: Picture, quad: FloatArray) -> FloatArray:
    """Corners of a black square on white as the intersections of its four straight sides.

    Corner detectors look for saddles; on the L of a blurred square they are biased inwards by
    about 0.2 px. A side is the median place at which the brightness steps from black to white.
    """
    corners = np.array(quad, float)
    for _ in range(2):
        sides = [_side(grey, corners[i], corners[(i + 1) % 4]) for i in range(4)]
        for i in range(4):
            (a, along), (b, other) = sides[i - 1], sides[i]
            corners[i] = a + np.linalg.solve(np.column_stack([along, -other]), b - a)[0] * along
    jump = np.linalg.norm(corners - quad, axis=1).max()
    size = np.linalg.norm(quad - np.roll(quad, 1, axis=0), axis=1).min()
    return corners if jump < 0.1 * size else np.asarray(quad, float)


def _side(grey: Picture, a: FloatArray, b: FloatArray) -> tuple[FloatArray, FloatArray]:
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
