"""The camera from a session's own photographs of the board."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from dlo_casadi.errors import VisionError
from dlo_casadi.vision.board import (
    CORNERS_THAT_SHARE,
    LEAST_MARKERS,
    MAX_ERROR_PX,
    Board,
    detect_markers,
)
from dlo_casadi.vision.camera import Array, Camera

_LEAST_PHOTOGRAPHS = 3  # each gives two equations for the five numbers of the matrix
_GOOD_FOCAL = 0.005  # relative std of the focal length: 0.5 % of every length along the view
# Degrees between the most different directions, below which focal length and distance mix.
_TILTED = 20.0
# How well marker_centers are known [m], one coordinate, with a ruler. All photographs see the same
# error, so that what they leave does not show it: of drawn corners whose markers were off by this,
# three photographs from within 12 degrees were up to 5.7 % off where scatter alone told 2 %.
_PLACED = 1e-3
_APART = "30 to 90 degrees apart"  # directions that tell focal length from distance
_FILLED = 0.5  # share of the picture in which corners lie: beyond them the lens is extrapolated
# Numbers of a lens that are fitted: none, k1, k1 k2, k1 k2 p1 p2 k3.
_STRAIGHT = cv2.CALIB_ZERO_TANGENT_DIST | cv2.CALIB_FIX_K3
_LENSES = {
    0: _STRAIGHT | cv2.CALIB_FIX_K1 | cv2.CALIB_FIX_K2,
    1: _STRAIGHT | cv2.CALIB_FIX_K2,
    2: _STRAIGHT,
    5: 0,
}


@dataclass(frozen=True)
class Calibration:
    """A camera and how well it is known.

    Parameters
    ----------
    camera : Camera
        Matrix [px] and distortion k1, k2, p1, p2, k3.
    matrix_std : (4,) [px]
        Standard deviations of fx, fy, cx, cy.
    spread : scalar [degrees]
        Between the most different directions from which photographs were taken.
    reprojection_error : scalar [px]
        Root mean square over all corners.
    errors : dict of str to scalar [px]
        The same for each photograph that was used.
    problems : dict of str to str
        Photographs that were not used, and why.
    advice : tuple of str
        How to do better; empty where nothing is missing.
    """

    camera: Camera
    matrix_std: Array
    spread: float
    reprojection_error: float
    errors: Mapping[str, float]
    problems: Mapping[str, str]
    advice: tuple[str, ...]

    @property
    def focal_uncertainty(self) -> float:
        """Standard deviation of the focal lengths over themselves, the larger of both."""
        return _relative(self.camera.matrix, self.matrix_std)


def calibrate_camera(photographs: Mapping[str, NDArray[np.uint8]], board: Board) -> Calibration:
    """Find matrix and lens of the camera that took several photographs of the board.

    All poses, the matrix and the lens minimise the reprojection error of all corners, from the
    closed solution for a plane seen from several directions. Of four lenses (straight; k1; k1, k2;
    k1, k2, p1, p2, k3) the one of least

        N log(error^2) + k log(N)

    with k numbers and N independent corners is taken (Schwarz).

    Parameters
    ----------
    photographs : dict of str to (H, W, 3) uint8
        By their names, all taken with one camera at one focus and zoom.
    board : Board
        Markers; the standoff does not count.

    Raises
    ------
    VisionError
        If fewer than three photographs show three markers, or if they are of different sizes.

    References
    ----------
    Zhang, A flexible new technique for camera calibration, PAMI 2000, through OpenCV.
    """
    size = _common_size(photographs)
    problems: dict[str, str] = {}
    seen: dict[str, dict[int, Array]] = {}
    for name, image in photographs.items():
        try:
            markers, _ = detect_markers(image, board)
        except VisionError as error:
            problems[name] = f"{name}: {error.message}"
            continue
        if len(markers) < LEAST_MARKERS:
            problems[name] = (
                f"{name}: only the markers {sorted(markers)} are seen once; a photograph for the "
                f"calibration needs {LEAST_MARKERS}. Try: the whole board in the picture, sharp."
            )
        else:
            seen[name] = markers
    solved = _solve(seen, board, size, problems)
    misplaced = {
        name: {n: q for n, q in seen[name].items() if errors[n] < MAX_ERROR_PX}
        for name, errors in solved.errors.items()
    }
    if misplaced != seen:
        for name in seen:
            if len(misplaced[name]) < LEAST_MARKERS:
                del misplaced[name]
                problems[name] = (
                    f"{name}: its markers are more than {MAX_ERROR_PX:g} px off the places that "
                    "the other photographs give them. Try: marker_centers? was a marker moved?"
                )
        solved = _solve(misplaced, board, size, problems)
    rms = {
        n: float(np.sqrt(np.mean(np.square(list(e.values()))))) for n, e in solved.errors.items()
    }
    return Calibration(
        Camera(solved.matrix, solved.distortion),
        solved.std,
        solved.spread,
        solved.rms,
        rms,
        problems,
        tuple(_advice(solved, size)),
    )


@dataclass(frozen=True)
class _Solved:
    """A calibration of one lens, and the errors [px] of each marker in each photograph."""

    matrix: Array
    distortion: Array
    std: Array
    rms: float
    errors: dict[str, dict[int, float]]
    spread: float
    corners: Array


def _solve(
    seen: dict[str, dict[int, Array]],
    board: Board,
    size: tuple[int, int],
    problems: dict[str, str],
) -> _Solved:
    """Calibrate with each lens and keep the one that is worth its numbers."""
    if len(seen) < _LEAST_PHOTOGRAPHS:
        raise VisionError(
            f"a calibration needs {_LEAST_PHOTOGRAPHS} photographs with {LEAST_MARKERS} markers "
            f"each, and there are {len(seen)}. Try: more photographs of the board, from directions "
            f"{_APART}.\n" + "\n".join(f"  {problem}" for problem in problems.values())
        )
    places = [
        np.vstack([np.column_stack([board.corners(n), np.zeros(4)]) for n in markers])
        for markers in seen.values()
    ]
    pixels = [np.vstack(list(markers.values())) for markers in seen.values()]
    solid, flat = ([a.astype(np.float32) for a in arrays] for arrays in (places, pixels))
    count = 2 * sum(len(a) for a in pixels) / CORNERS_THAT_SHARE
    best: tuple[float, tuple] | None = None
    fitted = 0
    for numbers, flags in _LENSES.items():
        found = cv2.calibrateCamera(solid, flat, size, None, None, flags=flags)
        score = 2 * count * np.log(found[0]) + numbers * np.log(count)
        if best is None or score < best[0]:
            best, fitted = (score, found), numbers
    assert best is not None
    rms, matrix, lens, turns, shifts = best[1]
    slopes, displaced = [], []
    errors: dict[str, dict[int, float]] = {}
    for (name, markers), corners, turn, shift in zip(
        seen.items(), places, turns, shifts, strict=True
    ):
        projected, slope = cv2.projectPoints(corners, turn, shift, matrix, lens)
        slopes.append(slope[:, : 10 + fitted])
        # A marker that is elsewhere on the board moves its corners as the board itself would.
        moved = slope[:, 3:6] @ cv2.Rodrigues(turn)[0][:, :2]
        own = [
            np.kron(np.array(list(markers)) == n, np.ones(8))[:, None] * moved
            for n in board.marker_centers
        ]
        displaced.append(np.hstack(own))
        at = projected.reshape(-1, 4, 2)
        off = np.linalg.norm(at - np.array(list(markers.values())), axis=2)
        errors[name] = dict(zip(markers, np.sqrt(np.mean(off**2, axis=1)), strict=True))
    ahead = np.array([cv2.Rodrigues(turn)[0][2] for turn in turns])
    spread = float(np.degrees(np.arccos(np.clip((ahead @ ahead.T).min(), -1.0, 1.0))))
    return _Solved(
        np.asarray(matrix, float),
        np.asarray(lens, float).ravel()[:5],
        _matrix_std(slopes, displaced, float(rms)),
        float(rms),
        errors,
        spread,
        np.vstack(pixels),
    )


def _matrix_std(slopes: list[Array], displaced: list[Array], rms: float) -> Array:
    """Standard deviations (4,) [px] of the matrix, whatever place and lens.

    Of scattered corners, those of a marker counting as one, and of markers that are not quite where
    they are declared. OpenCV's drop what photographs from one direction do not tell, and call it
    known.

    Parameters
    ----------
    slopes : list of (2 K, 10 + k)
        Derivatives of the corners of one photograph by its place (6), the matrix (4), the lens.
    displaced : list of (2 K, 2 m)
        By the places of the m markers on the board [px/m].
    rms : scalar [px]
        Of the distances of the corners.
    """
    rows, moves = [], []
    for slope, moved in zip(slopes, displaced, strict=True):
        basis = np.linalg.qr(slope[:, :6])[0]
        rows.append(slope[:, 6:] - basis @ (basis.T @ slope[:, 6:]))
        moves.append(moved - basis @ (basis.T @ moved))
    stacked = np.vstack(rows)
    scale = np.maximum(np.linalg.norm(stacked, axis=0), 1e-12)
    left, sizes, ways = np.linalg.svd(stacked / scale, full_matrices=False)
    along = ways.T / np.maximum(sizes, 1e-12) / scale[:, None]
    unknowns = 6 * len(slopes) + stacked.shape[1]
    noise = rms * np.sqrt(len(stacked) / 2 / max(len(stacked) - unknowns, 1))
    by_corners = noise * np.sqrt(CORNERS_THAT_SHARE) * along
    by_markers = _PLACED * along @ (left.T @ np.vstack(moves))
    return np.asarray(np.linalg.norm(np.hstack([by_corners, by_markers]), axis=1))[:4]


def _common_size(photographs: Mapping[str, NDArray[np.uint8]]) -> tuple[int, int]:
    """Width and height [px] of all photographs."""
    sizes = {name: image.shape[1::-1] for name, image in photographs.items()}
    if len(set(sizes.values())) > 1:
        listed = list(sizes.values())
        usual = max(listed, key=listed.count)
        other = next(name for name, size in sizes.items() if size != usual)
        raise VisionError(
            f"{other} is {sizes[other][0]} x {sizes[other][1]} px, most photographs are "
            f"{usual[0]} x {usual[1]} px: they are not of one camera as it was set. Try: the "
            "original pictures, neither turned nor cut."
        )
    width, height = next(iter(sizes.values()), (0, 0))
    return int(width), int(height)


def _relative(matrix: Array, std: Array) -> float:
    """The larger standard deviation of both focal lengths, over them."""
    return float(max(std[0] / matrix[0, 0], std[1] / matrix[1, 1]))


def _advice(solved: _Solved, size: tuple[int, int]) -> list[str]:
    """Sentences on how to do better."""
    advice = []
    relative = _relative(solved.matrix, solved.std)
    if relative > _GOOD_FOCAL or solved.spread < _TILTED:
        advice.append(
            f"the focal length is known to {100 * relative:.1f} % only, from photographs whose "
            f"directions lie within {solved.spread:.0f} degrees: a longer focal length and a "
            "larger distance look alike. Try: photographs of the whole board from directions "
            f"{_APART}, or measurement.camera with the matrix of an earlier calibration"
        )
    hull = cv2.convexHull(solved.corners.astype(np.float32))
    filled = float(cv2.contourArea(hull)) / (size[0] * size[1])
    if filled < _FILLED:
        advice.append(
            f"markers were seen in {100 * filled:.0f} % of the picture only; beyond, the lens is a "
            "guess. Try: photographs with markers in the corners of the picture"
        )
    if solved.rms > 1.0:
        advice.append(
            f"corners are {solved.rms:.1f} px RMS off. Try: marker_size and marker_centers in "
            "metres? one focus and zoom for all? a flat board?"
        )
    return advice
