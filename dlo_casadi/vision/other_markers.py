"""Markers that a picture shows beside those of the board that is declared."""

from collections.abc import Collection

import cv2
import numpy as np

from dlo_casadi.arrays import FloatArray
from dlo_casadi.vision.camera import Picture

_SIDE = 1600  # px, largest side of a picture in which others are looked for
# Fewest markers that are named: of 1000 codes, one or two of 4 x 4 cells are seen in any texture.
_LEAST, _LEAST_OTHERS = 2, 3


def find_markers(grey: Picture, dictionary: str) -> dict[int, list[FloatArray]]:
    """Corners (4, 2) [px] of all markers of a dictionary of OpenCV, by number; a list for each."""
    number = getattr(cv2.aruco, dictionary)
    detector = cv2.aruco.ArucoDetector(cv2.aruco.getPredefinedDictionary(number))
    quads, numbers, _ = detector.detectMarkers(grey)
    found: dict[int, list[FloatArray]] = {}
    for n, quad in zip([] if numbers is None else numbers.ravel(), quads, strict=True):
        found.setdefault(int(n), []).append(quad.reshape(4, 2))
    return found


def other_markers(grey: Picture, dictionary: str, board: Collection[int]) -> str:
    """Sentence on markers in a grey picture that may be the board's; empty without any.

    They are printed white on black, are of another dictionary than the declared one, or both.
    """
    scale = _SIDE / max(grey.shape)
    if scale < 1.0:
        size = (round(scale * grey.shape[1]), round(scale * grey.shape[0]))
        grey = np.asarray(cv2.resize(grey, size, interpolation=cv2.INTER_AREA), np.uint8)
    best: tuple[int, str] = (0, "")
    for inverted in (False, True):
        shown = 255 - grey if inverted else grey
        for name in dict.fromkeys([dictionary, *_families()]):
            if name == dictionary and not inverted:
                continue  # these are seen without help
            seen = sorted(find_markers(shown, name))
            ours = [n for n in seen if n in board]
            if len(ours) < _LEAST and (
                len(seen) < _LEAST_OTHERS or "4X4" in name or "16h5" in name
            ):
                continue
            rank = 2 * len(ours) + (len(ours) == 0)
            if rank > best[0]:
                best = rank, _told(ours or seen, name, dictionary, inverted)
            if len(ours) == len(board):
                return best[1]
    return best[1]


def _told(numbers: list[int], name: str, declared: str, inverted: bool) -> str:
    printed = ", white on black" * inverted
    if name == declared:
        told, remedy = f" The picture shows markers {numbers} of {name}{printed}.", ""
    else:
        name = _smallest(name, max(numbers))
        told = f" The picture shows markers {numbers} of {name}{printed}."
        remedy = f"board.dictionary: {name}"
    if inverted:
        invert = "print them black on white, or invert the colours of all photographs"
        remedy = f"{remedy}; {invert}" if remedy else invert
    return f"{told} Try: {remedy}."


def _dictionaries() -> list[str]:
    """OpenCV's names of all dictionaries, one for each: it spells some of them in two ways."""
    spelled = {getattr(cv2.aruco, x): x for x in sorted(dir(cv2.aruco)) if x.startswith("DICT_")}
    return [*spelled.values()]


def _families() -> list[str]:
    """Names of dictionaries that hold all others: the largest of each kind."""
    sizes: dict[str, tuple[int, str]] = {}
    for name in _dictionaries():
        kind, _, size = name.rpartition("_")
        kind, count = (kind, int(size)) if size.isdigit() else (name, 0)
        sizes[kind] = max(sizes.get(kind, (0, "")), (count, name))
    return [name for _, name in sizes.values()]


def _smallest(name: str, number: int) -> str:
    """The smallest dictionary of a kind that holds a marker's number."""
    kind, _, size = name.rpartition("_")
    if not size.isdigit():
        return name
    sizes = [int(x.rpartition("_")[2]) for x in _dictionaries() if x.startswith(f"{kind}_")]
    return f"{kind}_{min(count for count in sizes if count > number)}"
