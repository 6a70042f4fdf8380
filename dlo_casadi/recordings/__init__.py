"""Recordings of laboratories to sessions: motion capture, ROS bags, point clouds."""

from dlo_casadi.recordings.clouds import CloudView
from dlo_casadi.recordings.read import FORMATS, read_recording
from dlo_casadi.recordings.recording import Cloud, Recording, Stream
from dlo_casadi.recordings.session import FREE, Imported, Wishes, make_session

__all__ = [
    "FORMATS",
    "FREE",
    "Cloud",
    "CloudView",
    "Imported",
    "Recording",
    "Stream",
    "Wishes",
    "make_session",
    "read_recording",
]
