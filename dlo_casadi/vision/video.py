"""Frames of a video and their times."""

from collections.abc import Iterator
from pathlib import Path

import cv2

from dlo_casadi.errors import VisionError
from dlo_casadi.vision.camera import Picture

VIDEO_ENDINGS = (".mp4", ".mov", ".avi", ".mkv", ".m4v", ".webm")


def rate_of(path: Path) -> float:
    """Frames a second, as the file declares them."""
    return _told(path, cv2.CAP_PROP_FPS)


def count_of(path: Path) -> int:
    """Number of frames, as the file declares it."""
    return int(_told(path, cv2.CAP_PROP_FRAME_COUNT))


def _told(path: Path, what: int) -> float:
    video = cv2.VideoCapture(str(path))
    try:
        return float(video.get(what))
    finally:
        video.release()


def frames_of(path: Path) -> Iterator[tuple[float, Picture]]:
    """Time [s] and picture (H, W, 3) of each frame, one after the other.

    Times are those of the file, of which phones make use: their frames come at no even rate. A file
    without them is read at its number of frames a second.

    Raises
    ------
    VisionError
        If OpenCV reads no frame.
    """
    video = cv2.VideoCapture(str(path))
    try:
        rate, before, count = video.get(cv2.CAP_PROP_FPS), -1.0, 0
        while True:
            found, image = video.read()
            if not found:
                break
            t = video.get(cv2.CAP_PROP_POS_MSEC) / 1e3
            if t <= before:
                t = before + 1 / rate if rate > 0 else before + 1 / 30
            yield t, image
            before, count = t, count + 1
        if not count:
            raise VisionError(
                "holds no frame that OpenCV can read. Try: a video in MP4 or AVI, such as "
                "`ffmpeg -i FILE -c:v libx264 -crf 15 swing.mp4` makes it",
                pose=path.name,
            )
    finally:
        video.release()
