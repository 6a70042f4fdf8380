"""Turn recordings of laboratories into sessions: motion capture, ROS bags, point clouds."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TypeVar

from dlo_casadi.errors import DloError, MeasurementError
from dlo_casadi.recordings.bags import read_bag
from dlo_casadi.recordings.clouds import CloudView, read_cloud
from dlo_casadi.recordings.mocap import read_c3d, read_mocap_csv
from dlo_casadi.recordings.recording import FREE, METRES, Cloud, Recording, Stream, Wishes, together
from dlo_casadi.recordings.session import Imported, make_session

Record = TypeVar("Record", Stream, Cloud)
WHOLE = CloudView()  # all points of clouds

# File extension -> reader.
FORMATS: dict[str, Callable[..., Recording]] = {
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
        How clouds were seen, in the axes of their files, or of the root of a bag's TF.

    Raises
    ------
    MeasurementError
        If one of them cannot be read, or if the view is asked of a recording without clouds. An
        exception that no reader expects is its `__cause__`.
    """
    names = [path.absolute().name for path in paths]
    labels = [
        name if names.count(name) == 1 else str(path)
        for path, name in zip(paths, names, strict=True)
    ]
    read = [_read(path, label, view.units) for path, label in zip(paths, labels, strict=True)]
    found = []
    for recording, label in zip(_in_units(read, labels, view.units), labels, strict=True):
        try:
            streams = tuple(_of_file(stream, label) for stream in recording.streams)
            clouds = tuple(_of_file(cloud, label) for cloud in view.of_all(recording.clouds))
        except MeasurementError as error:
            raise MeasurementError(error.message, pose=label) from error
        found.append(replace(recording, streams=streams, clouds=clouds).with_z_up(up))
    recording = together(found)
    asked = " and ".join(f"--{key}" for key in ("camera", "color", "box") if getattr(view, key))
    if asked and not recording.clouds:
        raise MeasurementError(f"{asked} tell of clouds, but this recording has none.")
    return recording


def _in_units(
    read: Sequence[Recording], labels: Sequence[str], asked: str | None
) -> list[Recording]:
    """The recordings in the unit that their user has asked for, where that is for them.

    It is for files that name none, which are in it already. If there are none, it overrules what
    the files name, since nobody asks for nothing; this is told.
    """
    if asked is None:
        return list(read)
    found = []
    for recording, label in zip(read, labels, strict=True):
        scale = METRES[asked] / METRES[recording.unit or asked]
        told = f"{label} is in {recording.unit}, as it names it: --units is for the other files"
        if scale != 1.0 and all(item.unit for item in read):
            recording = recording.scaled(scale)
            told = f"{label} is taken to be in {asked} (--units), though it names {recording.unit}"
        assumptions = (*recording.assumptions, *[told] * (scale != 1.0))
        found.append(replace(recording, assumptions=assumptions))
    return found


def _reader(path: Path) -> Callable[..., Recording] | None:
    return FORMATS.get("" if path.is_dir() else path.suffix.lower())


def _read(path: Path, label: str, unit: str | None) -> Recording:
    """What the reader of a file's format finds in it; errors begin with its `label`."""
    reader = _reader(path)
    if reader is None:
        kinds = ", ".join(filter(None, FORMATS))
        told = f"files of this kind are not read.\n  Try: {kinds}"
        raise MeasurementError(told, pose=label)
    if not path.exists():
        raise MeasurementError(f"there is no {path}.\n  Try: another name or folder.", pose=label)
    try:
        return reader(path, unit)
    except MeasurementError as error:
        raise MeasurementError(error.message, pose=label) from error
    except DloError:  # a library that is not installed
        raise
    except Exception as error:  # what readers of damaged files raise is not documented
        # Their own words are for those who program with them; they are the cause of this one.
        again = "export it again, whole" + "; `ros2 bag reindex`" * (reader is read_bag)
        raise MeasurementError(
            f"cannot be read as a {path.suffix or 'bag'} recording: it is damaged, cut short, or "
            f"of an unknown version.\n  Try: {again}.",
            pose=label,
        ) from error


def _of_file(record: Record, file: str) -> Record:
    """The same with the name of its file, and clocks that no other file has."""
    clock = f"{file} ({record.clock})" if record.clock else file
    return replace(record, file=file, clock=clock)
