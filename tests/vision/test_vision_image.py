"""Files that are, and are not, whole images."""

from pathlib import Path

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
