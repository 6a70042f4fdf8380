"""C3D files, which most motion capture systems write, read by ezc3d."""

from pathlib import Path
from struct import unpack_from

import numpy as np

from dlo_casadi.errors import MeasurementError, counted
from dlo_casadi.recordings.recording import Recording, Stream, factor, library

_AGAIN = "Try: export the file again, whole."


def read_c3d(path: Path) -> Recording:
    """Read the labelled points of a C3D file as markers; a gripper is three of them.

    POINT:Y_SCREEN tells the way up; without it that is z.

    Raises
    ------
    MeasurementError
        If the file is damaged, or holds no labelled points.

    References
    ----------
    The C3D file format, www.c3d.org: POINT:Y_SCREEN is the axis that points up on a screen.
    """
    ezc3d = library("ezc3d")
    try:
        content = ezc3d.c3d(str(path))
    except (OSError, RuntimeError, ValueError) as error:
        said = str(error).split(":")[0]
        raise MeasurementError(f"is no C3D file: {said}.\n  {_AGAIN}", pose=path.name) from None
    group = content["parameters"]["POINT"].items()
    point = {key: item["value"] for key, item in group if key != "__METADATA__"}
    places = content["data"]["points"][:3]
    first, last = unpack_from("<HH", path.read_bytes(), 6)  # ezc3d corrects what it gives
    declared = last - first + 1 if last < 65535 else 0
    if places.shape[2] < declared:
        raise MeasurementError(
            f"ends after {places.shape[2]} of {counted(declared, 'frame')}.\n  {_AGAIN}",
            pose=path.name,
        )
    labels = [label.strip() for label in point["LABELS"]]
    named = [k for k, label in enumerate(labels) if label and not label.startswith("*")]
    if not named or not places.size:
        raise MeasurementError(
            "holds no labelled points.\n  Try: label the markers before the export.",
            pose=path.name,
        )
    rate = float(np.ravel(point.get("RATE", [0.0]))[0])
    if rate <= 0.0:
        raise MeasurementError(f"POINT:RATE is {rate:g} Hz.\n  {_AGAIN}", pose=path.name)
    t = np.arange(places.shape[2]) / rate
    scale = factor("".join(point.get("UNITS", [])[:1]) or "mm", path.name)  # mm by the standard
    streams = [Stream(labels[k], "marker", t, scale * places[:, k].T, path.name) for k in named]
    screen = "".join(point.get("Y_SCREEN", [])).strip().lower()
    own = screen.lstrip("+") if screen.lstrip("+") in ("x", "y", "z") else "z"
    said = "as POINT:Y_SCREEN tells" if screen else "in most C3D files; POINT:Y_SCREEN is absent"
    return Recording(tuple(streams), up=own, up_by=said)
