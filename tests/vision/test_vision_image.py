"""Files that are, and are not, whole images."""

import resource
import struct
import warnings
import zlib
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import cv2
import numpy as np
import pytest

from dlo_casadi.errors import VisionError
from dlo_casadi.vision import read_image

PHOTO = Path(__file__).parents[2] / "configs/bench/connector/pose_01.jpg"


def test_a_photograph_is_read_in_colour():
    image = read_image(PHOTO)
    assert image.shape == (720, 1280, 3)
    assert image.dtype == np.uint8


@pytest.mark.parametrize("share", [0.05, 0.5, 0.9, 0.999])
def test_a_jpeg_cut_short_is_not_filled_with_grey(tmp_path, share):
    data = PHOTO.read_bytes()
    short = tmp_path / "short.jpg"
    short.write_bytes(data[: int(share * len(data))])
    with pytest.raises(VisionError, match=r"short\.jpg: the image is truncated"):
        read_image(short)


def test_bytes_after_the_end_of_a_jpeg_do_no_harm(tmp_path):
    longer = tmp_path / "longer.jpg"
    longer.write_bytes(PHOTO.read_bytes() + b"appended by a telephone")
    assert np.array_equal(read_image(longer), read_image(PHOTO))


def test_threads_that_read_photographs_leave_the_filters_of_warnings_alone():
    """Without one at a time, one of three such rounds left all warnings ignored."""
    before = list(warnings.filters)
    with ThreadPoolExecutor(4) as threads:
        list(threads.map(read_image, [PHOTO] * 40))
    assert warnings.filters == before


def test_missing_empty_and_foreign_files_are_named(tmp_path):
    with pytest.raises(VisionError, match="no such image"):
        read_image(tmp_path / "gone.jpg")
    (tmp_path / "empty.jpg").write_bytes(b"")
    with pytest.raises(VisionError, match=r"empty\.jpg: the file is empty"):
        read_image(tmp_path / "empty.jpg")
    (tmp_path / "text.jpg").write_text("x_m,y_m\n0,0\n")
    with pytest.raises(VisionError, match=r"text\.jpg: the file is not an image"):
        read_image(tmp_path / "text.jpg")
    with pytest.raises(VisionError, match="cannot read"):
        read_image(tmp_path)


def png(width, height):
    """A PNG that declares a size and holds next to nothing."""

    def chunk(kind, data):
        return (
            struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))
        )

    header = chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0))
    return b"\x89PNG\r\n\x1a\n" + header + chunk(b"IDAT", zlib.compress(b"0")) + chunk(b"IEND", b"")


JPEG_HEADER = b"\xff\xd8\xff\xc0" + struct.pack(">HBHHB", 17, 8, 32000, 32000, 3) + bytes(9)
BITMAP = b"BM" + struct.pack("<IIIIiiHHIIiiII", 54, 0, 54, 40, 32000, 32000, 1, 24, *[0] * 6)


@pytest.mark.parametrize(
    ("name", "data"),
    [("a.png", png(32000, 32000)), ("a.jpg", JPEG_HEADER + b"\xff\xd9"), ("a.bmp", BITMAP)],
)
def test_a_picture_of_absurd_size_is_refused_before_it_is_decoded(tmp_path, name, data):
    """3 GB decoded; the process may grow by a fiftieth of that."""
    (tmp_path / name).write_bytes(data)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    with pytest.raises(VisionError, match=rf"{name}: the picture is 32000 x 32000 px.* Try: make"):
        read_image(tmp_path / name)
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 60e3  # kB


@pytest.mark.parametrize("ending", [".jpg", ".png", ".tif", ".bmp", ".webp"])
def test_every_format_is_read_whole_or_refused_by_name(tmp_path, ending):
    picture = np.random.default_rng(0).integers(0, 255, (40, 60, 3)).astype(np.uint8)
    data = cv2.imencode(ending, picture)[1].tobytes()
    path = tmp_path / f"a{ending}"
    path.write_bytes(data)
    assert read_image(path).shape == (40, 60, 3)
    for end in (4, 12, 40, len(data) // 2):
        path.write_bytes(data[:end])
        with pytest.raises(VisionError, match=rf"a\{ending}: the "):
            read_image(path)


@pytest.mark.parametrize("data", [bytes(1000), b"\xff\xd8\xff\xd9", png(0, 0)])
def test_what_holds_no_picture_is_no_image(tmp_path, data):
    (tmp_path / "a.png").write_bytes(data)
    with pytest.raises(VisionError, match=r"a\.png: the file is not an image"):
        read_image(tmp_path / "a.png")


def test_a_picture_without_its_pixels_is_truncated(tmp_path):
    (tmp_path / "a.png").write_bytes(png(50, 50))
    with pytest.raises(VisionError, match=r"a\.png: the image is truncated"):
        read_image(tmp_path / "a.png")
