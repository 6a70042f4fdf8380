"""Photographs: read from disk, whole or not at all; the steps of an extraction drawn."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from io import BytesIO
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray
from PIL import (
    BmpImagePlugin,
    ImageFile,
    JpegImagePlugin,
    PngImagePlugin,
    TiffImagePlugin,
    WebPImagePlugin,
)

from dlo_casadi.errors import VisionError, counted
from dlo_casadi.vision.camera import Array, View
from dlo_casadi.vision.chain import Workings
from dlo_casadi.vision.workplane import WorkPlane

_WHITE, _MUCH_WHITE = 250, 0.3  # grey level, and share of a picture that is overexposed
_BLURRED_PX = 2.0  # standard deviation of edges from which markers of some 30 px are not read

# Pictures with more pixels are not decoded. The camera step was measured to hold 15 bytes a pixel:
# 1.5 GB for this many, which show a board of 1 m at 0.1 mm a pixel.
MOST_PIXELS = 100_000_000

# They read the header alone, of files of their own format.
_HEADERS = (
    JpegImagePlugin.JpegImageFile,
    PngImagePlugin.PngImageFile,
    TiffImagePlugin.TiffImageFile,
    BmpImagePlugin.BmpImageFile,
    WebPImagePlugin.WebPImageFile,
)


def read_image(path: Path | str) -> NDArray[np.uint8]:
    """Read a photograph, turned upright as its EXIF tag asks.

    Parameters
    ----------
    path : Path or str
        A JPEG, PNG, TIFF, BMP or WebP file.

    Returns
    -------
    (H, W, 3) uint8
        Blue, green, red.

    Raises
    ------
    VisionError
        If the file is missing, not an image, cut short, or of more than `MOST_PIXELS`. OpenCV
        fills the missing part of a JPEG with grey and says nothing; Pillow tells.
    """
    path = Path(path)

    def refuse(message: str) -> VisionError:
        return VisionError(message, pose=path.name)

    try:
        data = path.read_bytes()
    except FileNotFoundError:
        raise refuse(
            f"no such image: {path}. Try: is the file name right, relative to the configuration?"
        ) from None
    except OSError as error:
        raise refuse(
            f"cannot read the image {path}: {error.strerror or error}. Try: is it a file that you "
            "are allowed to read?"
        ) from None
    if not data:
        raise refuse("the file is empty. Try: copy the photograph again.")
    picture = _opened(data)
    width, height = (0, 0) if picture is None else picture.size
    if width * height > MOST_PIXELS:
        raise refuse(
            f"the picture is {width} x {height} px, {width * height / 1e6:.0f} million pixels; at "
            f"most {MOST_PIXELS / 1e6:.0f} million are decoded. Try: make the picture smaller (and "
            "camera.matrix with it), or cut it to the board; is it the photograph?"
        )
    if picture is not None and not _is_whole(picture):
        raise refuse(
            f"the image is truncated: its {counted(len(data), 'byte')} hold a part of the picture. "
            "Try: copy the photograph again."
        )
    image = _decode(data) if width * height else None
    if image is None:
        raise refuse(
            f"the file is not an image that can be decoded ({counted(len(data), 'byte')}). "
            "Try: JPEG or PNG; is it the photograph, and copied whole?"
        )
    return image


def spoilt(image: NDArray[np.uint8]) -> str:
    """Sentence for a photograph (H, W, 3) that is overexposed or blurred; empty if it is neither.

    A step of the height h blurred by the standard deviation s is nowhere steeper than
    h / (s sqrt(2 pi)).
    """
    grey = cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
    white = float(np.mean(grey >= _WHITE))
    if white > _MUCH_WHITE:
        return f" The picture is overexposed: {100 * white:.0f} % of it are white; less light."
    if min(grey.shape) < 2:
        return ""
    step = float(np.subtract(*np.percentile(grey, [99.9, 0.1])))
    slope = np.hypot(*np.gradient(grey.astype(np.float32)))
    blur = step / (np.sqrt(2 * np.pi) * max(float(np.percentile(slope, 99.9)), 1e-3))
    if blur > _BLURRED_PX:
        return f" The picture is blurred: no edge is sharper than {blur:.0f} px."
    return ""


def _opened(data: bytes) -> ImageFile.ImageFile | None:
    """The picture of which only the header is read; None if it is no known image."""
    for header in _HEADERS:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of damaged tags that nobody needs
            try:
                return header(BytesIO(data))
            except (SyntaxError, OSError, ValueError):  # of another format, or damaged
                continue
    return None


def _is_whole(picture: ImageFile.ImageFile) -> bool:
    """Whether the file holds all of a picture; a JPEG is read at an eighth of its size."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            picture.draft(None, (1, 1))
            picture.load()
        except (SyntaxError, OSError, ValueError, EOFError):
            return False
    return True


def _decode(data: bytes) -> NDArray[np.uint8] | None:
    """Decode quietly; None when no decoder takes it."""
    try:
        image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)
    except cv2.error:
        return None
    return None if image is None else np.asarray(image, np.uint8)


Picture = NDArray[np.uint8]

# Blue, green, red.
_BLUE, _ORANGE, _RED = (178, 114, 0), (0, 159, 230), (0, 94, 213)
_GREEN, _GREY = (115, 158, 0), (150, 150, 150)
_SATURATED = 4.0  # contrast that is drawn white, over the cut


def draw_steps(
    image: Picture,
    view: View | None,
    workings: Workings,
    line: Array | None,
    start: ArrayLike,
    end: ArrayLike | None,
    gaps: Sequence[int] = (),
) -> dict[str, Picture]:
    """Draw the steps that were reached.

    Parameters
    ----------
    image : (H, W, 3) uint8
        The photograph, blue, green, red.
    view : View or None
        None where the board was not found; the photograph is then all there is to see.
    workings : Workings
        Filled by `extract_centerline` or `see_cable`, as far as it came.
    line : (K, 2) [px] or None
        What that has found, if anything.
    start, end : (2,) [m]
        The declared fixtures, in the plane of the view.
    gaps : sequence of int
        Indices of the pixels after which a stretch of the line is missing.

    Returns
    -------
    dict of (h, w, 3) uint8
        By the name of the step, in order: 1_workplane, 2_contrast, 3_strands, 4_centerline.
    """
    declared = {"start": start, "end": end}
    fixtures = {name: np.asarray(at, float) for name, at in declared.items() if at is not None}
    pictures: dict[str, Picture] = {}
    plane = workings.plane
    if plane is not None:
        pictures["1_workplane"] = _workplane(plane, fixtures)
    if plane is not None and workings.candidate is not None:
        pictures["2_contrast"] = _contrast(plane, workings.candidate, workings.cut)
        pictures["3_strands"] = _strands(plane, workings)
    pictures["4_centerline"] = image.copy()
    if view is not None:
        _draw_line(pictures["4_centerline"], view, workings, line, gaps)
        for name, at in fixtures.items():
            _mark(pictures["4_centerline"], view.to_pixels(at)[0], name, 0.6 * _size(image))
    return pictures


def encoded(picture: Picture, ending: str) -> bytes:
    """Content of a picture's file, in the format of its ending, such as ".jpg"."""
    return bytes(cv2.imencode(ending, picture)[1])


def _workplane(plane: WorkPlane, fixtures: dict[str, Array]) -> Picture:
    """The rectified picture; what the cable cannot reach, and the markers, are dimmed."""
    picture = plane.image.copy()
    picture[~plane.reachable] //= 3
    for name, at in fixtures.items():
        _mark(picture, plane.to_pixels(at), name, 0.5)
    return picture


def _contrast(plane: WorkPlane, candidate: NDArray[np.float32], cut: float) -> Picture:
    """Contrast in grey; what is above the cut, and within reach, in orange."""
    grey = np.clip(candidate / max(_SATURATED * cut, 1e-6) * 255, 0, 255).astype(np.uint8)
    picture = np.repeat(grey[..., None], 3, axis=2)
    above = (candidate > cut) & plane.reachable
    picture[above] = (0.4 * picture[above] + 0.6 * np.array(_ORANGE)).astype(np.uint8)
    return picture


def _strands(plane: WorkPlane, workings: Workings) -> Picture:
    """All strands in grey, the chosen ones in blue, numbered from start to end."""
    picture = (plane.image // 3 + 170).astype(np.uint8)
    for line in workings.lines:
        _polyline(picture, plane.to_pixels(line), _GREY, 2)
    for k, line in enumerate(workings.chosen):
        at = plane.to_pixels(line)
        _polyline(picture, at, _BLUE, 2)
        _text(picture, at[len(at) // 2], str(k + 1), _BLUE, 0.5)
    return picture


def _draw_line(
    picture: Picture, view: View, workings: Workings, line: Array | None, gaps: Sequence[int]
) -> None:
    """Markers green, sound stretches blue with arrows from start to end, unsound profiles red."""
    size = _size(picture)
    thick = max(1, round(1.5 * size))
    for marker in view.markers:
        _polyline(picture, np.vstack([marker, marker[:1]]), _GREEN, thick)
    for at in view.to_pixels(workings.unsound):
        cv2.circle(picture, _pixel(at), thick, _RED, -1, cv2.LINE_AA)
    if line is not None:
        for part in np.split(line, np.array(gaps, dtype=int) + 1):
            _polyline(picture, part, _BLUE, thick)
        _arrows(picture, line, size)


def _size(picture: Picture) -> float:
    """How large to draw: 1 in a picture of 1200 pixels."""
    return max(1.0, max(picture.shape[:2]) / 1200)


def _arrows(picture: Picture, pixels: Array, size: float) -> None:
    """Arrowheads along the line, every eighth of it."""
    for k in np.linspace(0, len(pixels) - 1, 9)[1:-1].astype(int):
        ahead = pixels[min(k + 3, len(pixels) - 1)] - pixels[max(k - 3, 0)]
        step = 9 * size * ahead / max(float(np.linalg.norm(ahead)), 1e-9)
        tail, tip = _pixel(pixels[k] - step), _pixel(pixels[k] + step)
        cv2.arrowedLine(picture, tail, tip, _ORANGE, max(2, round(2 * size)), cv2.LINE_AA, 0, 0.7)


def _mark(picture: Picture, at: Array, name: str, size: float) -> None:
    cv2.circle(picture, _pixel(at), round(12 * size), _RED, max(1, round(3 * size)), cv2.LINE_AA)
    _text(picture, at + 16 * size, name, _RED, size)


def _text(picture: Picture, at: Array, text: str, color: tuple[int, int, int], size: float) -> None:
    font, thick = cv2.FONT_HERSHEY_SIMPLEX, max(1, round(2 * size))
    cv2.putText(picture, text, _pixel(at), font, size, (255, 255, 255), 3 * thick, cv2.LINE_AA)
    cv2.putText(picture, text, _pixel(at), font, size, color, thick, cv2.LINE_AA)


def _polyline(picture: Picture, at: Array, color: tuple[int, int, int], thick: int) -> None:
    points = np.round(np.clip(at, -1e5, 1e5)).astype(np.int32)
    cv2.polylines(picture, [points], False, color, thick, cv2.LINE_AA)


def _pixel(at: Array) -> tuple[int, int]:
    u, v = np.clip(at, -1e5, 1e5).round().astype(int)
    return int(u), int(v)
