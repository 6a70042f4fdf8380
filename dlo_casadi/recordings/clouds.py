"""Point clouds: their files (PLY, PCD and NPY), and the line of the cable in them."""

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.lib.recfunctions import unstructured_to_structured

from dlo_casadi import vision
from dlo_casadi.arrays import FloatArray
from dlo_casadi.errors import MeasurementError, counted
from dlo_casadi.recordings.fixtures import Gripper
from dlo_casadi.recordings.recording import LARGEST, METRES, Cloud, Recording, Wishes, require
from dlo_casadi.recordings.stills import Still

_AGAIN = "Try: save it again, whole, as binary or text."
# m, distance of two cameras beyond which their clouds are not moved to the axis along one line of
# sight: two on opposite sides put the line of a cable of 7 mm 2.8 mm beside it.
_ASIDE = 0.05
_PLY = {"char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4"}
_PLY |= {"float": "f4", "double": "f8", "int8": "i1", "uint8": "u1", "int16": "i2"}
_PLY |= {"uint16": "u2", "int32": "i4", "uint32": "u4", "float32": "f4", "float64": "f8"}


@dataclass(frozen=True)
class CloudView:
    """How clouds were seen, and which of their points belong to the cable."""

    camera: Sequence[float] = ()
    """Place of the camera [m], in the frame of the file, or the root of a bag's TF."""
    color: Sequence[float] = ()
    """Colour of the cable: red, green, blue, 0 to 255; all points when empty."""
    box: Sequence[float] = ()
    """x, y, z of two corners [m] between which the cable is; everywhere when empty."""
    units: str | None = None
    """Unit of lengths, m, cm or mm, of files that do not name it: bags (markers and clouds), files
    of clouds, C3D without POINT:UNITS; of others only if all files name theirs."""

    def __post_init__(self) -> None:
        """Check the values; DloError names the option."""
        near = all(abs(x) <= LARGEST for x in self.camera)  # False for nan
        require(near, "camera", self.camera, f"three numbers in metres, up to {LARGEST:g} m")
        shown = all(0.0 <= x <= 255.0 for x in self.color)
        require(shown, "color", self.color, "red, green and blue from 0 to 255")
        require(bool(np.isfinite(self.box).all()), "box", self.box, "six numbers in metres")

    def of_all(self, clouds: Sequence[Cloud]) -> tuple[Cloud, ...]:
        """Keep only the points of the cable; clouds without any are left out.

        Raises MeasurementError if no points are left in any cloud, or if they have no colour.
        """
        found = tuple(kept for kept in map(self._of, clouds) if len(kept.points))
        if clouds and not found:
            points = counted(sum(len(cloud.points) for cloud in clouds), "point")
            raise MeasurementError(
                f"none of its {points} is finite, inside --box and of --color.\n"
                "  Try: other corners or another colour; --units."
            )
        return found

    def _of(self, cloud: Cloud) -> Cloud:
        points = cloud.points
        kept = np.isfinite(points).all(axis=1)
        if self.color:
            if cloud.colors is None:
                raise MeasurementError(
                    "its points have no colour.\n  Try: --box instead of --color"
                )
            kept &= vision.of_color(cloud.colors, self.color)
        if self.box:
            corners = np.sort(np.reshape(self.box, (2, 3)), axis=0)
            kept &= ((points >= corners[0]) & (points <= corners[1])).all(axis=1)
        camera = np.array(self.camera) if self.camera else cloud.camera
        return replace(cloud, points=points[kept], colors=None, camera=camera)


def read_cloud(path: Path, unit: str | None = None) -> Recording:
    """Read a cloud: PLY or PCD (text or binary), or NPY, an array (K, 3), or (K, 6) with colours.

    Its points, and the camera's place in a PCD file, are in `unit`, by default metres. Raises
    MeasurementError if it holds fewer points than it says, or none.
    """
    scale = METRES[unit or "m"]
    cloud = {".ply": _ply, ".pcd": _pcd, ".npy": _npy}[path.suffix.lower()](path)
    if not len(cloud.points):
        raise MeasurementError(f"holds no points.\n  {_AGAIN}")
    camera = None if cloud.camera is None else scale * cloud.camera
    cloud = replace(cloud, points=scale * cloud.points, camera=camera)
    assumed = f"{path.suffix} files are taken to be in {unit or 'm'}"
    told = (assumed if unit else f"{assumed}, which they do not name; or --units",)
    return Recording((), (cloud,), told, up_by=f"as in most {path.suffix} files")


def cloud_of(table: Any) -> Cloud:
    """Cloud of a structured array: x, y, z; red, green, blue or packed `rgb` or `rgba`, if any."""
    names = table.dtype.names
    if not {"x", "y", "z"} <= set(names):
        raise MeasurementError(
            f"its points have the fields {', '.join(names)}.\n  Try: an export with x, y and z."
        )
    points = np.column_stack([table[axis].astype(float) for axis in "xyz"])
    colors = None
    if {"red", "green", "blue"} <= set(names):
        colors = np.column_stack([table[name].astype(float) for name in ("red", "green", "blue")])
    elif both := {"rgb", "rgba"} & set(names):
        packed = table[both.pop()]
        packed = packed.astype("f4" if packed.dtype.kind == "f" else "u4").view("u4")
        colors = np.column_stack([(packed >> shift) & 255 for shift in (16, 8, 0)]).astype(float)
    return Cloud(points, colors)


def _npy(path: Path) -> Cloud:
    array = np.load(path, allow_pickle=False)
    if array.shape[-1:] not in ((3,), (6,)):
        raise MeasurementError(
            f"is an array {array.shape}.\n  Try: (K, 3), or (K, 6) with red, green and blue."
        )
    array = array.reshape(-1, array.shape[-1]).astype(float)
    return Cloud(array[:, :3], array[:, 3:] if array.shape[1] == 6 else None)


def _ply(path: Path) -> Cloud:
    head, *body = re.split(rb"end_header\r?\n", path.read_bytes(), maxsplit=1)
    if not body or not head.startswith(b"ply"):
        raise MeasurementError(f"has no header.\n  {_AGAIN}")
    lines = [line.split() for line in head.decode("ascii", "replace").splitlines() if line.strip()]
    style = next(line[1] for line in lines if line[0] == "format")
    first, *others = (k for k, line in enumerate(lines) if line[0] == "element")
    if lines[first][1] != "vertex":
        raise MeasurementError(f"its first element is not vertex.\n  {_AGAIN}")
    lines = lines[first : min(others, default=None)]
    fields = [(line[-1], _PLY[line[1]], 1) for line in lines if line[0] == "property"]
    return cloud_of(_table(fields, body[0], int(lines[0][2]), style))


def _pcd(path: Path) -> Cloud:
    content, head, at = path.read_bytes(), {}, 0
    while "DATA" not in head:
        end = content.index(b"\n", at)
        key, *values = content[at:end].decode("ascii", "replace").split() or ["#"]
        head[key], at = values, end + 1
    style = head["DATA"][0]
    if style == "binary_compressed":
        raise MeasurementError("is compressed.\n  Try: save it as binary.")
    names = [f"_{k}" if name == "_" else name for k, name in enumerate(head["FIELDS"])]  # padding
    counts = map(int, head.get("COUNT", "1" * len(names)))
    kinds = [f"{kind.lower()}{size}" for kind, size in zip(head["TYPE"], head["SIZE"], strict=True)]
    fields = list(zip(names, kinds, counts, strict=True))
    style = "ascii" if style == "ascii" else "binary_little_endian"
    cloud = cloud_of(_table(fields, content[at:], int(head["POINTS"][0]), style))
    seen_from = np.array([float(x) for x in head.get("VIEWPOINT", [])][:3])
    return replace(cloud, camera=seen_from if seen_from.any() else None)


def _table(fields: Sequence[tuple[str, str, int]], body: bytes, count: int, style: str) -> Any:
    """Structured array of points; of each field the name, NumPy's type and how many values."""
    order = ">" if style == "binary_big_endian" else "<"
    kind = np.dtype([(name, order + form, (number,)) for name, form, number in fields])
    if style == "ascii":
        width = sum(number for *_, number in fields)
        lines = [line.split()[:width] for line in body.decode().splitlines()[:count]]
        rows = [line for line in lines if len(line) == width]
        table = unstructured_to_structured(np.array(rows, float).reshape(-1, width), kind)
    else:
        table = np.frombuffer(body, kind, min(count, len(body) // kind.itemsize))
    if len(table) < count:
        raise MeasurementError(f"ends after {len(table)} of {counted(count, 'point')}.\n  {_AGAIN}")
    return table


# ---- the cable in clouds -----------------------------------------------------------------------


def cloud_lines(
    recording: Recording,
    stills: Sequence[Still],
    start: Gripper | None,
    end: Gripper | None,
    wishes: Wishes,
    remarks: list[str],
) -> tuple[list[FloatArray], list[str]]:
    """Line of the cable (K, 3) [m] in each pose, from all its clouds, and remarks on it."""
    clouds = recording.clouds
    asked = " and ".join(f"--{key}" for key in ("cable", "at") if getattr(wishes, key))
    if asked:
        raise MeasurementError(
            f"{asked} tell of markers, but the cable is found in the clouds of this recording.\n"
            f"  Try: without {asked}; or without the clouds."
        )
    missing = [key for key in ("length", "diameter") if key not in wishes.known]
    if missing or start is None:
        raise MeasurementError(
            "a cable is found in a cloud by its size and its fixtures.\n  Try: "
            f"{', '.join(f'--{key}' for key in missing) or 'a recording of the grippers beside it'}"
        )
    timed = np.isfinite(clouds[0].t)
    if not timed and len(clouds) != len(stills):
        raise MeasurementError(
            f"{counted(len(clouds), 'cloud')} without a time for {counted(len(stills), 'pose')} of "
            "the grippers.\n  Try: one file for each pose, in their order; --hold"
        )
    if timed and clouds[0].clock not in {stream.clock for stream in recording.streams}:
        remarks.append("clouds: their times are taken as those of the grippers")
    lines: list[FloatArray] = []
    told = []
    for k, still in enumerate(stills):
        shown = [c for c in clouds if still.begin <= c.t <= still.end] if timed else [clouds[k]]
        if not shown:
            raise MeasurementError(
                f"no cloud was seen in pose {k + 1} ({still.span}).\n  Try: hold it longer; "
                "clouds and grippers with clocks that agree."
            )
        cable = vision.KnownCable(
            start.places[k],
            None if end is None else end.places[k],
            wishes.known["diameter"],
            wishes.known["length"],
        )
        camera = shown[0].camera
        kept = [c for c in shown if _away(c.camera, camera) < _ASIDE]
        line, messages = vision.line_in_cloud(np.vstack([c.points for c in kept]), cable, camera)
        if len(kept) < len(shown):
            others = counted(len(shown) - len(kept), "cloud")
            messages = (*messages, f"{others} from another place of the camera left out")
        lines.append(line)
        told.append("; ".join([still.told, *messages]))
    if camera is not None:
        remarks.append("clouds: points moved from the surface to the axis, along the line of sight")
    return lines, told


def _away(place: FloatArray | None, camera: FloatArray | None) -> float:
    """Distance [m] of a camera from another; without the other's place, no cloud is moved: 0."""
    if camera is None:
        return 0.0
    return np.inf if place is None else float(np.linalg.norm(place - camera))
