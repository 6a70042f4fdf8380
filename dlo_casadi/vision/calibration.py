"""Calibrate the camera from a session's own photographs of the board."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace

import cv2
import numpy as np
from scipy.linalg import block_diag

from dlo_casadi.arrays import FloatArray
from dlo_casadi.errors import VisionError, counted
from dlo_casadi.vision.board import (
    CORNERS_THAT_SHARE,
    LEAST_MARKERS,
    MAX_ERROR_PX,
    Board,
    detect_markers,
    widened,
)
from dlo_casadi.vision.camera import Camera, Picture

_LEAST_PHOTOGRAPHS = 3  # each gives two equations for the five numbers of the camera matrix
_ROUNDS = 3  # in which the shift of edges is found; each halves its error in the focal length
_GOOD_FOCAL = 0.005  # largest relative std of a good focal length: 0.5 % of lengths along the view
# Smallest angle [deg] between the most different views; below it focal length and distance mix.
_TILTED = 20.0
# Std of a coordinate of marker_centers [m], measured with a ruler. The error is the same in all
# photographs and invisible in the residuals: for drawn corners with markers off by this, three
# photographs within 12 degrees gave errors up to 5.7 %, where the scatter alone predicted 2 %.
_PLACED = 1e-3
_LONGEST = 100.0  # focal length over picture size beyond which it is none: half a degree is seen
_APART = "30 to 90 degrees apart"  # view angles that separate focal length from distance
_FILLED = 0.5  # smallest share of the picture with corners: beyond them the lens is extrapolated
# Lenses, by the coefficients that are fitted: none, k1, k1 k2, k1 k2 p1 p2 k3.
_STRAIGHT = cv2.CALIB_ZERO_TANGENT_DIST | cv2.CALIB_FIX_K3
_LENSES = {
    0: _STRAIGHT | cv2.CALIB_FIX_K1 | cv2.CALIB_FIX_K2,
    1: _STRAIGHT | cv2.CALIB_FIX_K2,
    2: _STRAIGHT,
    5: 0,
}


@dataclass(frozen=True)
class Calibration:
    """A camera and its uncertainty."""

    camera: Camera
    """Matrix [px] and distortion k1, k2, p1, p2, k3."""
    matrix_std: FloatArray
    """Standard deviations (4,) [px] of fx, fy, cx, cy."""
    spread: float
    """Degrees between the most different directions from which photographs were taken."""
    reprojection_error: float
    """Root mean square [px] over all corners."""
    errors: Mapping[str, float]
    """The same for each photograph that was used."""
    problems: Mapping[str, str]
    """Photographs that were not used, and why."""
    advice: tuple[str, ...]
    """How to do better; empty where nothing is missing."""

    @property
    def focal_uncertainty(self) -> float:
        """Relative standard deviation of the focal lengths, the larger of both."""
        return float(max(self.matrix_std[:2] / np.diag(self.camera.matrix)[:2]))


def calibrate_camera(photographs: Mapping[str, Picture], board: Board) -> Calibration:
    """Find matrix and lens of the camera that took several photographs of the board.

    All poses, the matrix and the lens minimise the reprojection error of all corners, from the
    closed-form solution for a plane seen from several directions; then again, with the edges of
    markers moved by the shift due to gamma and blur in each photograph. Of four lenses (straight;
    k1; k1, k2; k1, k2, p1, p2, k3) the one with the smallest

        N log(error^2) + k log(N)

    with k numbers and N independent corners is chosen (Schwarz).

    The photographs (H, W, 3) uint8, by name, are all taken with one camera at one focus and
    zoom. The board's standoff is ignored.

    Raises
    ------
    VisionError
        If fewer than three photographs show three markers, if they are of different sizes, or if
        all face the board alike.

    References
    ----------
    Zhang, A flexible new technique for camera calibration, PAMI 2000, through OpenCV.
    """
    sizes = {name: (image.shape[1], image.shape[0]) for name, image in photographs.items()}
    listed = list(sizes.values())
    size = max(listed, key=listed.count, default=(0, 0))
    for name, other in sizes.items():
        if other != size:
            raise VisionError(
                f"{name} is {other[0]} x {other[1]} px, most photographs are {size[0]} x {size[1]} "
                "px: they are not of one camera as it was set. Try: the original pictures, neither "
                "turned nor cut."
            )
    problems: dict[str, str] = {}
    seen: dict[str, dict[int, FloatArray]] = {}
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
    found, errors = _solve(seen, board, size, problems)
    placed = {
        name: {n: q for n, q in seen[name].items() if off[n] < MAX_ERROR_PX}
        for name, off in errors.items()
    }
    if placed != seen:
        for name in seen:
            if len(placed[name]) < LEAST_MARKERS:
                del placed[name]
                problems[name] = (
                    f"{name}: its markers are more than {MAX_ERROR_PX:g} px off the places that "
                    "the other photographs give them. Try: marker_centers? was a marker moved?"
                )
        found, _ = _solve(placed, board, size, problems)
    for _ in range(_ROUNDS):
        outer = {name: widened(quads, board, found.camera) for name, quads in placed.items()}
        found, _ = _solve(outer, board, size, problems)
    return found


def _solve(
    seen: dict[str, dict[int, FloatArray]],
    board: Board,
    size: tuple[int, int],
    problems: dict[str, str],
) -> tuple[Calibration, dict[str, dict[int, float]]]:
    """Calibrate with the lens of the least BIC; errors [px] of each marker by picture."""
    if len(seen) < _LEAST_PHOTOGRAPHS:
        raise VisionError(
            f"a calibration needs {_LEAST_PHOTOGRAPHS} photographs with {LEAST_MARKERS} markers "
            f"each, and there are {len(seen)}. Try: more photographs of the board, from directions "
            f"{_APART}.\n" + "\n".join(f"  {problem}" for problem in problems.values())
        )
    solid = [
        np.vstack([np.column_stack([board.corners(n), np.zeros(4)]) for n in markers])
        for markers in seen.values()
    ]
    pixels = [np.vstack(list(markers.values())) for markers in seen.values()]
    rounded, seen_at = ([a.astype(np.float32) for a in arrays] for arrays in (solid, pixels))
    count = 2 * sum(len(a) for a in pixels) / CORNERS_THAT_SHARE
    trials = []
    for numbers, flags in _LENSES.items():
        solved = cv2.calibrateCamera(rounded, seen_at, size, None, None, flags=flags)
        score = 2 * count * np.log(solved[0]) + numbers * np.log(count)
        trials.append((score, numbers, solved))
    _, fitted, (rms, matrix, lens, turns, shifts) = min(trials, key=lambda trial: trial[0])
    if not matrix[:2, :2].max() < _LONGEST * max(size):
        raise VisionError(
            f"the focal length cannot be found from these {counted(len(seen), 'photograph')}: all "
            "face the board alike, where a longer focal length and a larger distance look the same."
            f" Try: photographs of the whole board from directions {_APART}."
        )
    slopes, displaced = [], []
    errors: dict[str, dict[int, float]] = {}
    for (name, markers), corners, turn, shift in zip(
        seen.items(), solid, turns, shifts, strict=True
    ):
        projected, slope = cv2.projectPoints(corners, turn, shift, matrix, lens)
        slopes.append(slope[:, : 10 + fitted])
        # Moving a marker on the board moves its corners like moving the board would.
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
    found = Calibration(
        Camera(matrix, np.asarray(lens, float).ravel()[:5]),
        _matrix_std(slopes, displaced, float(rms)),
        spread,
        float(rms),
        {n: float(np.sqrt(np.mean(np.square(list(e.values()))))) for n, e in errors.items()},
        problems,
        (),
    )
    filled = float(cv2.contourArea(cv2.convexHull(np.vstack(seen_at)))) / (size[0] * size[1])
    return replace(found, advice=tuple(_advice(found, filled))), errors


def _matrix_std(slopes: list[FloatArray], displaced: list[FloatArray], rms: float) -> FloatArray:
    """Marginal standard deviations (4,) [px] of the matrix, over poses and lens.

    They include the scatter of corners, where the corners of a marker count as one, and errors of
    the declared markers. OpenCV's omit directions that photographs from one place do not determine.

    `slopes` (2 K, 10 + k) are derivatives of the corners of each photograph by its place (6), the
    matrix (4) and the lens, `displaced` (2 K, 2 m) by the places of the m markers on the board
    [px/m]; `rms` [px] is that of the distances of the corners.
    """
    places = 6 * len(slopes)
    own, shared = block_diag(*(s[:, :6] for s in slopes)), np.vstack([s[:, 6:] for s in slopes])
    A = np.hstack([own, shared])
    scale = np.maximum(np.linalg.norm(A, axis=0), 1e-12)
    matrix = slice(places, places + 4)
    along = np.linalg.pinv(A / scale, rcond=0.0)[matrix] / scale[matrix, None]
    noise = rms * np.sqrt(CORNERS_THAT_SHARE * len(A) / 2 / max(len(A) - A.shape[1], 1))
    by_both = np.hstack([noise * along, _PLACED * along @ np.vstack(displaced)])
    return np.asarray(np.linalg.norm(by_both, axis=1))


def _advice(found: Calibration, filled: float) -> Iterator[str]:
    """Advice on better photographs; corners cover the share `filled` of the picture."""
    if found.focal_uncertainty > _GOOD_FOCAL or found.spread < _TILTED:
        yield (
            f"the focal length is known to {100 * found.focal_uncertainty:.1f} % only, from "
            f"photographs whose directions lie within {found.spread:.0f} degrees: a longer focal "
            "length and a larger distance look alike. Try: photographs of the whole board from "
            f"directions {_APART}, or measurement.camera with the matrix of an earlier calibration"
        )
    if filled < _FILLED:
        yield (
            f"markers were seen in {100 * filled:.0f} % of the picture only; beyond, the lens is a "
            "guess. Try: photographs with markers in the corners of the picture"
        )
    if found.reprojection_error > 1.0:
        yield (
            f"corners are {found.reprojection_error:.1f} px RMS off. Try: marker_size and "
            "marker_centers in metres? one focus and zoom for all? a flat board?"
        )
