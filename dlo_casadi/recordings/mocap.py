"""Exports of motion capture systems: CSV files and C3D files."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from struct import unpack_from

import numpy as np
from scipy.spatial.transform import Rotation

from dlo_casadi.arrays import FloatArray
from dlo_casadi.config.problems import show
from dlo_casadi.errors import MeasurementError, counted, library
from dlo_casadi.io.tables import BLANK, SEPARATORS, as_numbers, decoded, numbered_lines, split
from dlo_casadi.recordings.recording import (
    METRES,
    Kind,
    Recording,
    Stream,
    checked_times,
    factor,
    length_unit,
)

# Sections of a Vicon file that hold positions; others (devices, model outputs) are skipped.
_SECTIONS: dict[str, Kind] = {"Trajectories": "marker", "Objects": "body", "Segments": "body"}
_KINDS: dict[str, Kind] = {"Marker": "marker", "Rigid Body": "body"}  # Types in Motive files
_RADIANS = dict.fromkeys(("deg", "degree", "degrees"), np.pi / 180.0)
_RADIANS |= dict.fromkeys(("rad", "radian", "radians"), 1.0)
_AGAIN = "Try: export it again, whole, as Motive (Tracking Data) or Vicon (ASCII) writes it."
_HEAD = 12  # lines by which the separator of columns is told: all headers are shorter
Rows = list[list[str]]


def read_mocap_csv(path: Path, unit: str | None = None) -> Recording:
    """Read a CSV file of Motive (format 1.2 or later) or of Vicon (Nexus, Tracker).

    Returns
    -------
    Recording
        Markers, and rigid bodies with their rotations: quaternions in Motive files, also rotation
        vectors in Vicon files. Unlabelled markers are left out. By default y points up in Motive
        and z in Vicon. Lengths of a file that names no unit are in `unit`. Columns of anything
        else, such as a time code, are not parsed.

    Raises
    ------
    MeasurementError
        If the file is neither, is damaged, has other units, or times that do not increase.

    References
    ----------
    OptiTrack, "Data Export: CSV". Vicon Nexus, "ASCII file format"; its rotations of segments
    with three components are rotation vectors (angle-axis).
    """
    try:
        text, remarks = decoded(path.read_bytes(), path.name)
    except ValueError as error:
        raise MeasurementError(f"{error}.\n  {_AGAIN}") from None
    rows = _cells(text)
    head = next((row for row in rows if row and row[0]), [""])
    first = head[0]
    if first == "Format Version":
        read, own, program = _motive(rows, head, unit, path.name), "y", "Motive"
    elif first in (*_SECTIONS, "Devices", "Model Outputs", "Joints"):
        read, own, program = _vicon(rows, unit, path.name), "z", "Vicon"
    else:
        found = f"it begins with {show(first)}" if first else "it is empty"
        raise MeasurementError(
            f"is no CSV file of Motive or Vicon: {found}; Format Version or Trajectories belongs "
            f"there.\n  {_AGAIN}"
        )
    if not read.streams:
        raise MeasurementError(
            "holds no labelled marker and no rigid body.\n  Try: label them before the export."
        )
    told = tuple(dict.fromkeys((*remarks, *read.assumptions)))
    said = f"as {program} exports it"
    return replace(read, assumptions=told, up=own, up_by=said).without_zeros()


def _cells(text: str) -> Rows:
    """Cells of all lines, in the separator that gives most of them in the first lines."""
    lines = [line for _, line in numbered_lines(text)]
    some = [line for line in lines if line.strip()][:_HEAD]
    signs = [sign for sign in SEPARATORS if sign != BLANK]  # names hold blanks
    separator = max(signs, key=lambda sign: sum(len(split(line, sign)) for line in some))
    return [split(line, separator) for line in lines]


def _motive(rows: Rows, settings: Sequence[str], unit: str | None, file: str) -> Recording:
    meta = dict(zip(settings[::2], settings[1::2], strict=False))
    heads = [k for k, row in enumerate(rows) if row[:1] == ["Frame"]]
    named = {row[1]: row for row in rows[: heads[0]] if len(row) > 2} if heads else {}
    if not heads or not {"Type", "Name"} <= named.keys():
        raise MeasurementError(f"has no rows Type, Name and Frame above its numbers.\n  {_AGAIN}")
    for key in ("Type", "Name"):
        if len(named[key]) < len(rows[heads[0]]):
            raise MeasurementError(
                f"line {rows.index(named[key]) + 1} has {len(named[key])} of "
                f"{counted(len(rows[heads[0]]), 'cell')}.\n  {_AGAIN}"
            )
    if meta.get("Coordinate Space", "Global") != "Global":
        raise MeasurementError(
            f"is in the space {meta['Coordinate Space']!r}.\n  Try: an export with Coordinate "
            "Space: Global"
        )
    head, quantities = rows[heads[0]], rows[heads[0] - 1]
    body = _filled(rows[heads[0] + 1 :], len(head), heads[0] + 2)
    said = meta.get("Total Exported Frames", "")
    if said.isdigit() and int(said) != len(body):
        raise MeasurementError(
            f"ends after {len(body)} of {counted(int(said), 'frame')}.\n  {_AGAIN}"
        )
    clock = [c for c, name in enumerate(head) if name.lower().startswith("time (")]
    t = _numbers(body, clock[:1] or [0], head)[:, 0]
    if not clock:
        t = t / _rate_of(meta)
    checked_times(t, _places(body))
    own, assumptions = length_unit(meta.get("Length Units", ""), unit, "m", file)
    streams = []
    for (label, name), at in _assets(named, quantities, head):
        places = [at.get(f"Position {axis}", -1) for axis in "XYZ"]
        if label not in _KINDS or min(places) < 0 or "Unlabeled" in name:
            continue
        turns = [at.get(f"Rotation {axis}", -1) for axis in "XYZW"] * (label == "Rigid Body")
        if turns and min(turns) < 0:
            raise MeasurementError(
                f"rotations of {name!r} are not quaternions ({meta.get('Rotation Type', '?')})."
                "\n  Try: an export with Rotation Type: Quaternion"
            )
        values = _numbers(body, [*places, *turns], head)
        values[:, :3] *= METRES[own]
        streams.append(Stream(name, _KINDS[label], t, values))
    return Recording(tuple(streams), (), tuple(assumptions), unit="" if assumptions else own)


def _rate_of(meta: Mapping[str, str]) -> float:
    """Frames a second of an export of Motive."""
    rate = meta.get("Export Frame Rate", meta.get("Capture Frame Rate", "")).replace(",", ".")
    if not (_is_number(rate) and 0.0 < float(rate) < np.inf):
        raise MeasurementError(f"has no times, and {show(rate)} frames a second.\n  {_AGAIN}")
    return float(rate)


def _assets(
    named: Mapping[str, Sequence[str]], quantities: Sequence[str], head: Sequence[str]
) -> list[tuple[tuple[str, str], dict[str, int]]]:
    """Type and name of each asset, and the column of each of its quantities.

    One of the name of another is called after its parent, too, if the file tells it.
    """
    owners = (
        {named["ID"][c]: named["Name"][c] for c in range(2, len(head))} if "ID" in named else {}
    )
    found: dict[tuple[str, ...], dict[str, int]] = {}
    for c in range(2, len(head)):
        own = tuple(
            named[row][c] if row in named else "" for row in ("Type", "Name", "Parent", "ID")
        )
        quantity = f"{quantities[c]} {head[c]}".strip()
        while quantity in found.get(own, ()):  # another asset that nothing tells from this one
            own = (*own, "")
        found.setdefault(own, {})[quantity] = c
    names = [own[:2] for own in found]
    listed = []
    for (label, name, parent, *_), at in found.items():
        whose = owners.get(parent, parent)
        full = f"{whose}:{name}" if whose and names.count((label, name)) > 1 else name
        listed.append(((label, full), at))
    return listed


def _vicon(rows: Rows, unit: str | None, file: str) -> Recording:
    starts = [k for k in range(len(rows)) if _opens_section(rows, k)]
    streams: list[Stream] = []
    assumptions: list[str] = []
    units = set()
    for k, stop in zip(starts, [*starts[1:], len(rows)], strict=True):
        kind = _SECTIONS.get(rows[k][0])
        if kind is None:
            continue
        if len(rows) < k + 5:
            raise MeasurementError(f"ends above the numbers of {rows[k][0]}.\n  {_AGAIN}")
        first, names, axes, own_units = rows[k + 1 : k + 5]
        rate = "".join(first[:1]).replace(",", ".")
        if not (_is_number(rate) and 0.0 < float(rate) < np.inf):
            raise MeasurementError(
                f"line {k + 2}: the rate is {show(rate)} frames a second.\n  {_AGAIN}"
            )
        body = _filled(rows[k + 5 : stop], len(axes), k + 6)
        t = checked_times(_numbers(body, [0], axes)[:, 0] / float(rate), _places(body))
        heads = [c for c in range(2, len(names)) if names[c]]
        for c, following in zip(heads, [*heads[1:], len(axes)], strict=True):
            at = {axes[i]: i for i in range(c, following)}
            places = [at.get(a, at.get(f"T{a}", -1)) for a in "XYZ"]
            if min(places) < 0 or names[c].startswith("*"):
                continue
            named = own_units[places[0]] if places[0] < len(own_units) else ""
            own, told = length_unit(named, unit, "mm", file)
            assumptions += told
            units.add("" if told else own)
            turns = [at[f"R{a}"] for a in "XYZW" if f"R{a}" in at] if kind == "body" else []
            if kind == "body" and not turns:
                raise MeasurementError(
                    f"{names[c]} has no rotation.\n  Try: an export of objects with their rotations"
                )
            values = _numbers(body, [*places, *turns], axes)
            values[:, :3] *= METRES[own]
            if kind == "body":
                turned = _quaternions(values[:, 3:], own_units[turns[0]])
                values = np.hstack([values[:, :3], turned])
            streams.append(Stream(names[c], kind, t, values))
    of_all = units.pop() if len(units) == 1 else ""
    return Recording(tuple(streams), (), tuple(assumptions), unit=of_all)


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


def _filled(rows: Rows, width: int, first: int) -> list[tuple[int, list[str]]]:
    """Rows that are not blank, with their lines in the file; the first one is in line `first`."""
    filled = [(line, row) for line, row in enumerate(rows, first) if any(row)]
    if not filled:
        raise MeasurementError(f"holds no frames.\n  {_AGAIN}")
    for line, row in filled:
        if len(row) < width:
            raise MeasurementError(
                f"line {line} has {len(row)} of {counted(width, 'cell')}: the file is truncated.\n"
                f"  {_AGAIN}"
            )
    return filled


def _places(body: Sequence[tuple[int, list[str]]]) -> list[str]:
    return [f"line {line}" for line, _ in body]


def _numbers(
    body: Sequence[tuple[int, list[str]]], at: Sequence[int], names: Sequence[str]
) -> FloatArray:
    """Numbers (n, columns) of the columns `at` alone; nan in empty cells."""
    lines, rows = zip(*body, strict=True)
    try:
        return as_numbers(rows, at, lines, [names[c] for c in at], gaps=True)
    except ValueError as error:
        raise MeasurementError(f"{error}.\n  {_AGAIN}") from None


_MIPS = b"\x56"
_WHOLE = "Try: export the file again, whole."


def _check_c3d(raw: bytes) -> None:
    """Raise MeasurementError if this is no C3D file, or one with numbers that are not read.

    Its first byte is the block of 512 bytes in which parameters begin, the second one 0x50; the
    fourth byte of the parameters is the kind of processor.
    """
    if not raw:
        raise MeasurementError(f"is empty.\n  {_WHOLE}")
    if raw[1:2] != b"\x50":
        raise MeasurementError(f"is no C3D file: it begins with {show(raw[:4])}.\n  {_WHOLE}")
    at = 512 * (raw[0] - 1) + 3
    if raw[at : at + 1] == _MIPS:
        raise MeasurementError(
            "has the numbers of SGI (MIPS) computers, which are not read.\n  Try: save it with "
            "those of Intel in the program that has written it."
        )


def read_c3d(path: Path, unit: str | None = None) -> Recording:
    """Read the labelled points of a C3D file as markers; a gripper is three of them.

    POINT:Y_SCREEN names the axis that points up; without it that is z. POINT:UNITS names the unit
    of lengths; without it that is `unit`, by default mm.

    Raises
    ------
    MeasurementError
        If the file is damaged, or holds no labelled points.

    References
    ----------
    The C3D file format, www.c3d.org: POINT:Y_SCREEN is the axis that points up on a screen.
    """
    ezc3d = library("ezc3d", "recordings", "reading this file")
    raw = path.read_bytes()
    _check_c3d(raw)
    content = ezc3d.c3d(str(path))
    group = content["parameters"]["POINT"].items()
    point = {key: item["value"] for key, item in group if key != "__METADATA__"}
    places = content["data"]["points"][:3]
    first, last = unpack_from("<HH", raw, 6)  # ezc3d alters its numbers
    declared = last - first + 1 if last < 65535 else 0
    if places.shape[2] < declared:
        raise MeasurementError(
            f"ends after {places.shape[2]} of {counted(declared, 'frame')}.\n  {_WHOLE}"
        )
    listed = ["LABELS", *(f"LABELS{k}" for k in range(2, 9))]  # each holds 255 of them
    labels = [label.strip() for key in listed for label in point.get(key, [])]
    named = [k for k, label in enumerate(labels) if label and not label.startswith("*")]
    if not named or not places.size:
        raise MeasurementError(
            "holds no labelled points.\n  Try: label the markers before the export."
        )
    rate = float(np.ravel(point.get("RATE", [0.0]))[0])
    if not 0.0 < rate < np.inf:
        raise MeasurementError(f"POINT:RATE is {rate:g} Hz.\n  {_WHOLE}")
    t = np.arange(places.shape[2]) / rate
    in_file = "".join(point.get("UNITS", [])[:1])
    length, assumptions = length_unit(in_file, unit, "mm", path.name)
    scale = METRES[length]
    streams = tuple(Stream(labels[k], "marker", t, scale * places[:, k].T) for k in named)
    screen = "".join(point.get("Y_SCREEN", [])).strip().lower()
    own, said = screen.lstrip("+"), "as POINT:Y_SCREEN tells"
    if own not in ("x", "y", "z"):
        own, said = "z", f"in most C3D files; POINT:Y_SCREEN is {screen.upper() or 'absent'}"
    told = "" if assumptions else length
    return Recording(streams, (), tuple(assumptions), own, said, told).without_zeros()
