"""Exports of motion capture systems: CSV files and C3D files."""

import csv
from codecs import BOM_UTF16_BE, BOM_UTF16_LE
from collections.abc import Iterator, Sequence
from pathlib import Path
from struct import unpack_from

import numpy as np
from scipy.spatial.transform import Rotation

from dlo_casadi.arrays import FloatArray
from dlo_casadi.config.problems import show
from dlo_casadi.errors import MeasurementError, counted, library
from dlo_casadi.recordings.recording import Kind, Recording, Stream, checked_times, factor

# Sections of a Vicon file that hold positions; others (devices, model outputs) are skipped.
_SECTIONS: dict[str, Kind] = {"Trajectories": "marker", "Objects": "body", "Segments": "body"}
_KINDS: dict[str, Kind] = {"Marker": "marker", "Rigid Body": "body"}  # Types in Motive files
_RADIANS = dict.fromkeys(("deg", "degree", "degrees"), np.pi / 180.0)
_RADIANS |= dict.fromkeys(("rad", "radian", "radians"), 1.0)
_AGAIN = "Try: export it again, whole, as Motive (Tracking Data) or Vicon (ASCII) writes it."
Rows = list[list[str]]


def read_mocap_csv(path: Path) -> Recording:
    """Read a CSV file of Motive (format 1.2 or later) or of Vicon (Nexus, Tracker).

    Returns
    -------
    Recording
        Markers, and rigid bodies with their rotations: quaternions in Motive files, also rotation
        vectors in Vicon files. Unlabelled markers are left out. By default y points up in Motive
        and z in Vicon.

    Raises
    ------
    MeasurementError
        If the file is neither, is damaged, has other units, or times that do not increase.

    References
    ----------
    OptiTrack, "Data Export: CSV". Vicon Nexus, "ASCII file format"; its rotations of segments
    with three components are rotation vectors (angle-axis).
    """
    text, remarks = _text(path)
    rows = list(csv.reader(text.splitlines()))
    head = next((row for row in rows if row and row[0].strip()), [""])
    first = head[0].strip()
    if first == "Format Version":
        streams, own, program = list(_motive(rows, head)), "y", "Motive"
    elif first in (*_SECTIONS, "Devices", "Model Outputs", "Joints"):
        streams, own, program = list(_vicon(rows)), "z", "Vicon"
    else:
        found = f"it begins with {show(first)}" if first else "it is empty"
        raise MeasurementError(
            f"is no CSV file of Motive or Vicon: {found}; Format Version or Trajectories belongs "
            f"there.\n  {_AGAIN}"
        )
    if not streams:
        raise MeasurementError(
            "holds no labelled marker and no rigid body.\n  Try: label them before the export."
        )
    said = f"as {program} exports it"
    return Recording(tuple(streams), (), remarks, own, said).without_zeros()


def _text(path: Path) -> tuple[str, tuple[str, ...]]:
    """Text of a file in UTF-8, UTF-16 with a byte-order mark, or Latin-1, which is remarked on."""
    content = path.read_bytes()
    marked = content.startswith((BOM_UTF16_LE, BOM_UTF16_BE))
    try:
        return content.decode("utf-16" if marked else "utf-8-sig"), ()
    except UnicodeDecodeError as error:  # numbers and keywords are ASCII in all encodings
        line = content.count(b"\n", 0, error.start) + 1
        told = f"{path.name} is not UTF-8 (line {line}): its names are read as Latin-1"
        return content.decode("latin-1"), (told,)


def _motive(rows: Rows, settings: Sequence[str]) -> Iterator[Stream]:
    meta = dict(zip(settings[::2], settings[1::2], strict=False))
    heads = [k for k, row in enumerate(rows) if row[:1] == ["Frame"]]
    named = {row[1]: row for row in rows[: heads[0]] if len(row) > 2} if heads else {}
    if not heads or not {"Type", "Name"} <= named.keys():
        raise MeasurementError(f"has no rows Type, Name and Frame above its numbers.\n  {_AGAIN}")
    if meta.get("Coordinate Space", "Global") != "Global":
        raise MeasurementError(
            f"is in the space {meta['Coordinate Space']!r}.\n  Try: an export with Coordinate "
            "Space: Global"
        )
    head, quantities = heads[0], rows[heads[0] - 1]
    lines, table = _table(rows[head + 1 :], len(rows[head]), head + 2)
    said = meta.get("Total Exported Frames", "")
    if said.isdigit() and int(said) != len(table):
        raise MeasurementError(
            f"ends after {len(table)} of {counted(int(said), 'frame')}.\n  {_AGAIN}"
        )
    t = checked_times(table[:, 1], lines)
    scale = factor(meta.get("Length Units", "m"))
    columns: dict[tuple[str, str], dict[str, int]] = {}
    for c in range(2, len(rows[head])):
        columns.setdefault((named["Type"][c], named["Name"][c]), {})[
            f"{quantities[c]} {rows[head][c]}".strip()
        ] = c
    for (label, name), at in columns.items():
        places = [at.get(f"Position {axis}", -1) for axis in "XYZ"]
        if label not in _KINDS or min(places) < 0 or "Unlabeled" in name:
            continue
        values = scale * table[:, places]
        if label == "Rigid Body":
            turns = [at.get(f"Rotation {axis}", -1) for axis in "XYZW"]
            if min(turns) < 0:
                raise MeasurementError(
                    f"rotations of {name!r} are not quaternions ({meta.get('Rotation Type', '?')})."
                    "\n  Try: an export with Rotation Type: Quaternion"
                )
            values = np.hstack([values, table[:, turns]])
        yield Stream(name, _KINDS[label], t, values)


def _vicon(rows: Rows) -> Iterator[Stream]:
    starts = [k for k in range(len(rows)) if _opens_section(rows, k)]
    for k, stop in zip(starts, [*starts[1:], len(rows)], strict=True):
        kind = _SECTIONS.get(rows[k][0].strip())
        if kind is None:
            continue
        first, names, axes, units = rows[k + 1 : k + 5]
        rate = "".join(first[:1])
        if not (_is_number(rate) and 0.0 < float(rate) < np.inf):
            raise MeasurementError(
                f"line {k + 2}: the rate is {show(rate)} frames a second.\n  {_AGAIN}"
            )
        lines, table = _table(rows[k + 5 : stop], len(axes), k + 6)
        t = checked_times(table[:, 0] / float(rate), lines)
        heads = [c for c in range(2, len(names)) if names[c].strip()]
        for c, following in zip(heads, [*heads[1:], len(axes)], strict=True):
            at = {axes[i].strip(): i for i in range(c, following)}
            places = [at.get(a, at.get(f"T{a}", -1)) for a in "XYZ"]
            if min(places) < 0 or names[c].strip().startswith("*"):
                continue
            values = factor(units[places[0]]) * table[:, places]
            if kind == "body":
                turns = [at[f"R{a}"] for a in "XYZW" if f"R{a}" in at]
                values = np.hstack([values, _quaternions(table[:, turns], units[turns[0]])])
            yield Stream(names[c].strip(), kind, t, values)


def _opens_section(rows: Rows, k: int) -> bool:
    """Whether row k is the name of a section: it is the first one, or below a blank one.

    A blank row alone ends no section: frames may follow it.
    """
    name, below = ("".join(row[:1]).strip() for row in [*rows[k : k + 2], []][:2])
    named = name in _SECTIONS or (name and _is_number(below) and not _is_number(name))
    return bool(named) and not (k and any(map(str.strip, rows[k - 1])))


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


def _quaternions(turns: FloatArray, unit: str) -> FloatArray:
    """Quaternions (n, 4) from quaternions, or from rotation vectors (n, 3) in a unit of angle."""
    if turns.shape[1] == 4:
        return turns
    radians = factor(unit, "angle", _RADIANS)
    found = np.full((len(turns), 4), np.nan)
    seen = np.isfinite(turns).all(axis=1)
    found[seen] = Rotation.from_rotvec(turns[seen] * radians).as_quat()
    return found


def _table(rows: Sequence[list[str]], width: int, first: int) -> tuple[list[str], FloatArray]:
    """Lines in the file, and numbers (n, width), of rows that are not blank; nan in empty cells."""
    filled = [(f"line {k}", row) for k, row in enumerate(rows, first) if any(map(str.strip, row))]
    if not filled:
        raise MeasurementError(f"holds no frames.\n  {_AGAIN}")
    table = np.full((len(filled), width), np.nan)
    for numbers, (line, row) in zip(table, filled, strict=True):
        if len(row) < width:
            raise MeasurementError(
                f"{line} has {len(row)} of {counted(width, 'cell')}: the file is truncated.\n"
                f"  {_AGAIN}"
            )
        try:
            numbers[:] = [float(cell) if cell.strip() else np.nan for cell in row[:width]]
        except ValueError as error:
            raise MeasurementError(f"{line}: {error}.\n  {_AGAIN}") from None
    return [line for line, _ in filled], table


_WHOLE = "Try: export the file again, whole."


def read_c3d(path: Path) -> Recording:
    """Read the labelled points of a C3D file as markers; a gripper is three of them.

    POINT:Y_SCREEN names the axis that points up; without it that is z.

    Raises
    ------
    MeasurementError
        If the file is damaged, or holds no labelled points.

    References
    ----------
    The C3D file format, www.c3d.org: POINT:Y_SCREEN is the axis that points up on a screen.
    """
    ezc3d = library("ezc3d", "recordings", "reading this file")
    content = ezc3d.c3d(str(path))
    group = content["parameters"]["POINT"].items()
    point = {key: item["value"] for key, item in group if key != "__METADATA__"}
    places = content["data"]["points"][:3]
    first, last = unpack_from("<HH", path.read_bytes(), 6)  # ezc3d alters its numbers
    declared = last - first + 1 if last < 65535 else 0
    if places.shape[2] < declared:
        raise MeasurementError(
            f"ends after {places.shape[2]} of {counted(declared, 'frame')}.\n  {_WHOLE}"
        )
    labels = [label.strip() for label in point["LABELS"]]
    named = [k for k, label in enumerate(labels) if label and not label.startswith("*")]
    if not named or not places.size:
        raise MeasurementError(
            "holds no labelled points.\n  Try: label the markers before the export."
        )
    rate = float(np.ravel(point.get("RATE", [0.0]))[0])
    if not 0.0 < rate < np.inf:
        raise MeasurementError(f"POINT:RATE is {rate:g} Hz.\n  {_WHOLE}")
    t = np.arange(places.shape[2]) / rate
    scale = factor("".join(point.get("UNITS", [])[:1]) or "mm")  # mm by the standard
    streams = tuple(Stream(labels[k], "marker", t, scale * places[:, k].T) for k in named)
    screen = "".join(point.get("Y_SCREEN", [])).strip().lower()
    own, said = screen.lstrip("+"), "as POINT:Y_SCREEN tells"
    if own not in ("x", "y", "z"):
        own, said = "z", f"in most C3D files; POINT:Y_SCREEN is {screen.upper() or 'absent'}"
    return Recording(streams, up=own, up_by=said).without_zeros()
