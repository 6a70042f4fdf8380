"""Turn recordings of laboratories into sessions: motion capture, ROS bags, point clouds."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

from dlo_casadi.errors import MeasurementError
from dlo_casadi.recordings.bags import read_bag
from dlo_casadi.recordings.clouds import CloudView, read_cloud
from dlo_casadi.recordings.mocap import read_c3d, read_mocap_csv
from dlo_casadi.recordings.recording import Cloud, Recording, Stream, together
from dlo_casadi.recordings.session import FREE, Imported, Wishes, make_session

WHOLE = CloudView()  # all points of clouds, in metres

# File extension -> reader.
FORMATS: dict[str, Callable[[Path], Recording]] = {
    ".csv": read_mocap_csv,
    ".c3d": read_c3d,
    ".mcap": read_bag,
    ".db3": read_bag,
    ".bag": read_bag,
    ".ply": read_cloud,
    ".pcd": read_cloud,
    ".npy": read_cloud,
    "": read_bag,  # a folder with metadata.yaml
}


def read_recording(
    paths: Sequence[Path], up: str | None = None, view: CloudView = WHOLE
) -> Recording:
    """Read the files of one recording.

    Parameters
    ----------
    paths : sequence of Path
        Files of the `FORMATS`; each has its own clock.
    up : "x", "y", "z" or None
        The axis that points up; by default the usual one of each format.
    view : CloudView
        How clouds were seen, in the axes of their files.

    Raises
    ------
    MeasurementError
        If one of them cannot be read.
    """
    found = []
    for path in paths:
        reader = FORMATS.get("" if path.is_dir() else path.suffix.lower())
        if reader is None:
            raise MeasurementError(
                f"files of this kind are not read.\n  Try: {', '.join(filter(None, FORMATS))}",
                pose=path.name,
            )
        if not path.exists():
            raise MeasurementError("there is no such file", pose=str(path))
        read = reader(path)
        clouds = tuple(view.of(cloud) for cloud in read.clouds)
        found.append(replace(read, clouds=clouds).with_z_up(up))
    return together(found)
