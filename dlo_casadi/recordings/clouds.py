"""Read files of point clouds: PLY, PCD and NPY."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from dlo_casadi import vision
from dlo_casadi.arrays import FloatArray
from dlo_casadi.errors import MeasurementError, counted
from dlo_casadi.recordings.recording import METRES, Cloud, Recording

_AGAIN = "Try: save it again, whole, as binary or text."
_PLY = {"char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4"}
_PLY |= {"float": "f4", "double": "f8", "int8": "i1", "uint8": "u1", "int16": "i2"}
_PLY |= {"uint16": "u2", "int32": "i4", "uint32": "u4", "float32": "f4", "float64": "f8"}


@dataclass(frozen=True)
class CloudView:
    """How clouds were seen, and which of their points belong to the cable."""

    camera: Sequence[float] = ()
    """Place of the camera [m], in the frame of the file."""
    color: Sequence[float] = ()
    """Colour of the cable: red, green, blue, 0 to 255; all points when empty."""
    box: Sequence[float] = ()
    """x, y, z of two corners [m] between which the cable is; everywhere when empty."""
    units: str = "m"
    """Unit of the files, which do not contain it."""

    def of(self, cloud: Cloud) -> Cloud:
        """Keep only the points of the cable.

        Raises MeasurementError if no points are left, or if they have no colour.
        """
        points = cloud.points * METRES[self.units]
        kept = np.isfinite(points).all(axis=1)
        if self.color:
            if cloud.colors is None:
                raise MeasurementError(
                    "its points have no colour.\n  Try: --box instead of --color", pose=cloud.name
                )
            kept &= vision.of_color(cloud.colors, self.color)
        if self.box:
            corners = np.sort(np.reshape(self.box, (2, 3)), axis=0)
            kept &= ((points >= corners[0]) & (points <= corners[1])).all(axis=1)
        if not kept.any():
            raise MeasurementError(
                f"none of its {counted(len(points), 'point')} is finite, and in --box and of "
                "--color.\n  Try: other corners or another colour; --units.",
                pose=cloud.name,
            )
        camera = np.array(self.camera) if self.camera else cloud.camera
        return replace(cloud, points=points[kept], colors=None, camera=camera)


def read_cloud(path: Path) -> Recording:
    """Read a cloud: PLY or PCD (text or binary), or NPY, an array (K, 3), or (K, 6) with colours.

    Raises MeasurementError if the file is damaged.
    """
    reader = {".ply": _ply, ".pcd": _pcd, ".npy": _npy}[path.suffix.lower()]
    try:
        cloud = reader(path)
    except MeasurementError:
        raise
    except (OSError, ValueError, KeyError, IndexError, TypeError, EOFError) as error:
        raise MeasurementError(
            f"is no {path.suffix[1:].upper()} file of points: {error}.\n  {_AGAIN}", pose=path.name
        ) from None
    if not len(cloud.points):
        raise MeasurementError(f"holds no points.\n  {_AGAIN}", pose=path.name)
    return Recording(clouds=(cloud,), up_by=f"as in most {path.suffix} files")


def _npy(path: Path) -> Cloud:
    array = np.load(path, allow_pickle=False)
    array = array.reshape(-1, array.shape[-1]).astype(float)
    if array.shape[1] not in (3, 6):
        raise ValueError(f"an array (K, 3) or (K, 6) belongs there, found {array.shape}")
    return Cloud(path.name, array[:, :3], array[:, 3:] if array.shape[1] == 6 else None)


def _ply(path: Path) -> Cloud:
    head, mark, body = path.read_bytes().partition(b"end_header\n")
    lines = head.decode("ascii", "replace").split("\n")
    if not mark or lines[0].strip() != "ply":
        raise ValueError("it has no header")
    style = next(line.split()[1] for line in lines if line.startswith("format"))
    first = next(k for k, line in enumerate(lines) if line.startswith("element"))
    if lines[first].split()[1] != "vertex":
        raise ValueError("its first element is not vertex")
    count, fields = int(lines[first].split()[2]), []
    for line in lines[first + 1 :]:
        if line.startswith("element"):
            break
        if line.startswith("property"):
            _, kind, name = line.split()
            fields.append((name, _PLY[kind]))
    return _cloud(path, fields, body, count, style)


def _pcd(path: Path) -> Cloud:
    content, head, at = path.read_bytes(), {}, 0
    while "DATA" not in head:
        end = content.index(b"\n", at)
        key, *values = content[at:end].decode("ascii", "replace").split() or ["#"]
        head[key], at = values, end + 1
    style = head["DATA"][0]
    if style == "binary_compressed":
        raise ValueError("it is compressed; save it as binary")
    kinds = [f"{kind.lower()}{size}" for kind, size in zip(head["TYPE"], head["SIZE"], strict=True)]
    fields = list(zip(head["FIELDS"], kinds, strict=True))
    style = "ascii" if style == "ascii" else "binary_little_endian"
    cloud = _cloud(path, fields, content[at:], int(head["POINTS"][0]), style)
    seen_from = np.array([float(x) for x in head.get("VIEWPOINT", [])][:3])
    return replace(cloud, camera=seen_from if seen_from.any() else None)


def _cloud(path: Path, fields: list[tuple[str, str]], body: bytes, count: int, style: str) -> Cloud:
    """Points and colours of a table, stored as text or binary."""
    names = [name for name, _ in fields]
    if style == "ascii":
        lines = [line.split()[: len(names)] for line in body.decode().splitlines()[:count]]
        rows = [line for line in lines if len(line) == len(names)]
        held = len(rows)
        columns = zip(fields, np.array(rows, float).reshape(held, -1).T, strict=False)
        table = {name: column.astype(kind) for (name, kind), column in columns}
    else:
        order = ">" if style == "binary_big_endian" else "<"
        kind = np.dtype([(name, order + form) for name, form in fields])
        held = len(body) // kind.itemsize
        data: Any = np.frombuffer(body, kind, min(count, held))
        table = {name: data[name] for name in names}
    if held < count:
        raise MeasurementError(
            f"ends after {held} of {counted(count, 'point')}.\n  {_AGAIN}", pose=path.name
        )
    points = np.column_stack([table[axis].astype(float) for axis in "xyz"])
    return Cloud(path.name, points, _colors(table))


def _colors(table: dict[str, Any]) -> FloatArray | None:
    """Red, green and blue from separate columns, or from PCL's packed `rgb`."""
    if {"red", "green", "blue"} <= table.keys():
        return np.column_stack([table[name].astype(float) for name in ("red", "green", "blue")])
    if "rgb" not in table:
        return None
    packed = table["rgb"].astype("f4" if table["rgb"].dtype.kind == "f" else "u4").view("u4")
    return np.column_stack([(packed >> shift) & 255 for shift in (16, 8, 0)]).astype(float)
