"""Photographs from disk: whole or not at all."""

from __future__ import annotations

import warnings
from io import BytesIO
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import (
    BmpImagePlugin,
    ImageFile,
    JpegImagePlugin,
    PngImagePlugin,
    TiffImagePlugin,
    WebPImagePlugin,
)

from dlo_casadi.errors import VisionError, counted

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
