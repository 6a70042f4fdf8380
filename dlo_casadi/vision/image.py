"""Read photographs, refusing incomplete ones, and draw the steps of an extraction."""

import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from io import BytesIO
from pathlib import Path
from threading import Lock

import cv2
import numpy as np
from PIL import Image, ImageFile

from dlo_casadi.arrays import FloatArray
from dlo_casadi.errors import VisionError, counted
from dlo_casadi.vision.camera import Picture
from dlo_casadi.vision.chain import Workings

# Blue, green, red.
_BLUE, _ORANGE, _RED = (178, 114, 0), (0, 159, 230), (0, 94, 213)
_GREEN, _GREY = (115, 158, 0), (150, 150, 150)
_SATURATED = 4.0  # contrast that is drawn white, relative to the cut
_WHITE, _MUCH_WHITE = 250, 0.3  # grey level; share of such pixels in an overexposed picture
# Grey level below which nearly all of a black picture is; a rendered board in light that fades is
# lost where 99 % of the picture are below 20.
_DARK = 40.0
_BLURRED_PX = 2.0  # std of blurred edges beyond which markers of some 30 px cannot be read

# Largest number of pixels of a picture. The camera step was measured to need 15 bytes per pixel:
# 1.5 GB for this number, which shows a board of 1 m at 0.1 mm per pixel.
MOST_PIXELS = 100_000_000
_FORMATS = ("JPEG", "PNG", "TIFF", "BMP", "WEBP")
_QUIET = Lock()


def read_image(path: Path | str) -> Picture:
    """Read a photograph, turned upright as its EXIF tag asks.

    A JPEG, PNG, TIFF, BMP or WebP file becomes (H, W, 3) uint8: blue, green, red.

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
    image = None
    if width * height:
        with suppress(cv2.error):
            image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)
    if image is None:
        raise refuse(
            f"the file is not an image that can be decoded ({counted(len(data), 'byte')}). "
            "Try: JPEG or PNG; is it the photograph, and copied whole?"
        )
    return np.asarray(image, np.uint8)


@contextmanager
def _without_warnings() -> Iterator[None]:
    """Ignore warnings about damaged tags, which are not used.

    One thread at a time: each restores the filters that it has found.
    """
    with _QUIET, warnings.catch_warnings():
        warnings.simplefilter("ignore")
        yield


def _opened(data: bytes) -> ImageFile.ImageFile | None:
    """The picture, only its header read; None if it is no known image."""
    Image.init()
    for name in _FORMATS:
        with _without_warnings(), suppress(SyntaxError, OSError, ValueError):
            return Image.OPEN[name][0](BytesIO(data), "")  # raises for files of other formats
    return None


def _is_whole(picture: ImageFile.ImageFile) -> bool:
    """Whether the file holds all of a picture; a JPEG is read at an eighth of its size."""
    with _without_warnings(), suppress(SyntaxError, OSError, ValueError, EOFError):
        picture.draft(None, (1, 1))
        picture.load()
        return True
    return False


def spoilt(image: Picture) -> str:
    """Sentence for a photograph (H, W, 3) that is black, overexposed or blurred; empty if not.

    A step of height h blurred by the standard deviation s has the largest slope
    h / (s sqrt(2 pi)).
    """
    grey = cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
    if (lightest := float(np.percentile(grey, 99.0))) < _DARK:
        return (
            f" The picture is nearly black: 99 % of it are at most {lightest:.0f} of 255; more "
            "light or a longer exposure."
        )
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


def draw_steps(image: Picture, workings: Workings) -> dict[str, Picture]:
    """Draw the steps of an extraction that were reached.

    `image` (H, W, 3) uint8 is the photograph. The workings are filled by `extract_centerline` or
    `see_cable`, up to the step that failed; where the board was not found they are empty, and only
    the photograph is drawn.

    Returns
    -------
    dict of (h, w, 3) uint8
        By the name of the step, in order: 1_workplane, 2_contrast, 3_strands, 4_centerline.
    """
    pictures: dict[str, Picture] = {}
    plane, candidate, cut = workings.plane, workings.candidate, workings.cut
    if plane is not None:
        # dimmed: markers, and what the cable cannot reach
        pictures["1_workplane"] = picture = plane.image.copy()
        picture[~plane.reachable] //= 3
        _mark_fixtures(picture, workings, plane.to_pixels, 0.5)
    if plane is not None and candidate is not None:
        # contrast in grey; orange above the cut and within reach
        grey = np.clip(candidate / max(_SATURATED * cut, 1e-6) * 255, 0, 255).astype(np.uint8)
        pictures["2_contrast"] = picture = np.repeat(grey[..., None], 3, axis=2)
        above = (candidate > cut) & plane.reachable
        picture[above] = (0.4 * picture[above] + 0.6 * np.array(_ORANGE)).astype(np.uint8)
        # all strands in grey, the chosen ones in blue, numbered from start to end
        pictures["3_strands"] = picture = (plane.image // 3 + 170).astype(np.uint8)
        for strand in workings.strands:
            _polyline(picture, plane.to_pixels(strand.points), _GREY, 2)
        for k, line in enumerate(workings.chosen):
            at = plane.to_pixels(line)
            _polyline(picture, at, _BLUE, 2)
            _text(picture, at[len(at) // 2], str(k + 1), _BLUE, 0.5)
    pictures["4_centerline"] = picture = image.copy()
    view, pixels, size = workings.view, workings.pixels, max(1.0, max(image.shape[:2]) / 1200)
    thick = max(1, round(1.5 * size))
    if view is not None:
        # markers green, sound stretches blue with arrows from start to end, unsound profiles red
        for marker in view.markers:
            _polyline(picture, np.vstack([marker, marker[:1]]), _GREEN, thick)
        for at in view.to_pixels(workings.unsound):
            cv2.circle(picture, _pixel(at), thick, _RED, -1, cv2.LINE_AA)
    if pixels is not None:
        for part in np.split(pixels, np.array(workings.gaps, dtype=int) + 1):
            _polyline(picture, part, _BLUE, thick)
        for k in np.linspace(0, len(pixels) - 1, 9)[1:-1].astype(int):
            ahead = pixels[min(k + 3, len(pixels) - 1)] - pixels[max(k - 3, 0)]
            step = 9 * size * ahead / max(float(np.linalg.norm(ahead)), 1e-9)
            ends = _pixel(pixels[k] - step), _pixel(pixels[k] + step)
            cv2.arrowedLine(picture, *ends, _ORANGE, max(2, round(2 * size)), cv2.LINE_AA, 0, 0.7)
    if view is not None:
        _mark_fixtures(picture, workings, view.to_pixels, 0.6 * size)
    return pictures


def encoded(picture: Picture, ending: str) -> bytes:
    """Content of a picture's file, in the format of its ending, such as ".jpg"."""
    return bytes(cv2.imencode(ending, picture)[1])


def _mark_fixtures(
    picture: Picture, workings: Workings, to_pixels: Callable[[FloatArray], FloatArray], size: float
) -> None:
    """The declared fixtures, as rings with their names."""
    assert workings.expected is not None
    for name, at in zip(("start", "end"), to_pixels(workings.expected.fixtures), strict=False):
        thick = max(1, round(3 * size))
        cv2.circle(picture, _pixel(at), round(12 * size), _RED, thick, cv2.LINE_AA)
        _text(picture, at + 16 * size, name, _RED, size)


def _text(
    picture: Picture, at: FloatArray, text: str, color: tuple[int, int, int], size: float
) -> None:
    font, thick = cv2.FONT_HERSHEY_SIMPLEX, max(1, round(2 * size))
    for shade, wide in (((255, 255, 255), 3 * thick), (color, thick)):
        cv2.putText(picture, text, _pixel(at), font, size, shade, wide, cv2.LINE_AA)


def _polyline(picture: Picture, at: FloatArray, color: tuple[int, int, int], thick: int) -> None:
    points = np.round(np.clip(at, -1e5, 1e5)).astype(np.int32)
    cv2.polylines(picture, [points], False, color, thick, cv2.LINE_AA)


def _pixel(at: FloatArray) -> tuple[int, int]:
    u, v = np.clip(at, -1e5, 1e5).round().astype(int)
    return int(u), int(v)
