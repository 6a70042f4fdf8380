"""Photographs from disk: whole or not at all."""

from __future__ import annotations

import warnings
from io import BytesIO
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import BmpImagePlugin, JpegImagePlugin, PngImagePlugin, TiffImagePlugin, WebPImagePlugin

from dlo_casadi.errors import VisionError, counted

_WHITE, _MUCH_WHITE = 250, 0.3  # grey level, and share of a picture that is overexposed
_BLURRED_PX = 2.0  # standard deviation of edges from which markers of some 30 px are not read
_JPEG_START = b"\xff\xd8"
_PNG_START = b"\x89PNG\r\n\x1a\n"

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
        If the file is missing, not an image, cut short, or of more than `MOST_PIXELS`. Decoders
        fill the missing part of a JPEG with grey and say nothing; its end is therefore looked for
        here.
    """
    path = Path(path)
    try:
        data = path.read_bytes()
    except FileNotFoundError:
        raise VisionError(
            f"no such image: {path}. Try: is the file name right, relative to the configuration?",
            pose=path.name,
        ) from None
    except OSError as error:
        raise VisionError(
            f"cannot read the image {path}: {error.strerror or error}. Try: is it a file that you "
            "are allowed to read?",
            pose=path.name,
        ) from None
    if not data:
        raise VisionError("the file is empty. Try: copy the photograph again.", pose=path.name)
    if _is_truncated(data):
        raise VisionError(
            f"the image is truncated: it ends after {counted(len(data), 'byte')}, before its end "
            "marker. Try: copy the photograph again.",
            pose=path.name,
        )
    width, height = _declared_size(data)
    if width * height > MOST_PIXELS:
        raise VisionError(
            f"the picture is {width} x {height} px, {width * height / 1e6:.0f} million pixels; at "
            f"most {MOST_PIXELS / 1e6:.0f} million are decoded. Try: make the picture smaller (and "
            "camera.matrix with it), or cut it to the board; is it the photograph?",
            pose=path.name,
        )
    image = _decode(data) if width * height else None
    if image is None:
        raise VisionError(
            f"the file is not an image that can be decoded ({counted(len(data), 'byte')}). "
            "Try: JPEG or PNG; is it the photograph?",
            pose=path.name,
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


def _declared_size(data: bytes) -> tuple[int, int]:
    """Width and height [px] that the file's header declares; zeros if it is no known image."""
    for header in _HEADERS:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of damaged tags that nobody needs
            try:
                return header(BytesIO(data)).size
            except (SyntaxError, OSError, ValueError):  # of another format, or damaged
                continue
    return 0, 0


def _decode(data: bytes) -> NDArray[np.uint8] | None:
    """Decode quietly; None when no decoder takes it."""
    try:
        image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)
    except cv2.error:
        return None
    return None if image is None else np.asarray(image, np.uint8)


def _is_truncated(data: bytes) -> bool:
    """Whether a JPEG lacks its end-of-image marker or a PNG its last chunk."""
    if data.startswith(_JPEG_START):
        return not _jpeg_ends(data)
    if data.startswith(_PNG_START):
        return b"IEND" not in data[-64:] and b"IEND\xaeB`\x82" not in data
    return False


def _jpeg_ends(data: bytes) -> bool:
    """Walk the segments of a JPEG to its end-of-image marker.

    A search for the marker's two bytes alone would stop at the thumbnail in the header.
    """
    at = 2
    while True:
        at = data.find(b"\xff", at)
        if at < 0 or at + 1 >= len(data):
            return False
        marker = data[at + 1]
        if marker == 0xD9:
            return True
        if marker == 0xFF:  # a fill byte
            at += 1
        elif marker in (0x00, 0x01) or 0xD0 <= marker <= 0xD8:  # no length follows
            at += 2
        else:
            if at + 3 >= len(data):
                return False
            at += 2 + int.from_bytes(data[at + 2 : at + 4], "big")
