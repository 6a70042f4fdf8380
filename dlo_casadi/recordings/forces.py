"""Forces on the fixtures of a recording: which sensor is at which fixture, and means in poses."""

from collections.abc import Mapping, Sequence

from scipy.spatial.transform import Rotation

from dlo_casadi.arrays import FloatArray
from dlo_casadi.errors import MeasurementError
from dlo_casadi.recordings.recording import Recording, Stream
from dlo_casadi.recordings.stills import Still

Holders = Mapping[str, Sequence[str]]  # fixture -> names of its body, or of its three markers


def readings_of(
    recording: Recording, stills: Sequence[Still], holders: Holders
) -> tuple[list[dict[str, FloatArray]], list[str]]:
    """Forces (3,) [N] and moments (3,) [N m] of each pose in the world's axes, and remarks.

    The keys are those of a pose in a configuration. A sensor of no fixture, or in unknown axes, is
    left out with a remark. Raises MeasurementError if it is not clear which fixture one belongs to.
    """
    found: list[dict[str, FloatArray]] = [{} for _ in stills]
    sensors: dict[str, str] = {}  # of each side
    remarks, bodies = [], recording.of("body")
    for name, stream in recording.of("wrench").items():
        side = _side(stream, holders)
        if side is None or (stream.frame and stream.frame not in bodies):
            why = (
                "no fixture has the name of its frame or topic. Try: --start, --end with its frame"
            )
            if side is not None:
                why = "no TF and no body has its frame. Try: record /tf and /tf_static, too"
            remarks.append(f"force sensor {name} (frame {stream.frame!r}) is left out: {why}")
            continue
        if side in sensors:
            raise MeasurementError(
                f"two force sensors are at the {side}: {sensors[side]} and {name}.\n  Try: a "
                "recording with one of them; for a bag `ros2 bag convert` selects topics."
            )
        sensors[side] = name
        for still, row in zip(stills, found, strict=True):
            wrench = still.values.get(("wrench", name))
            body = still.values.get(("body", stream.frame))
            if wrench is not None and (body is not None or not stream.frame):
                turn = Rotation.from_quat([0.0, 0.0, 0.0, 1.0] if body is None else body[3:])
                row[f"{side}_force"] = turn.apply(wrench[:3])
                row[f"{side}_moment"] = turn.apply(wrench[3:])
        if not any(f"{side}_force" in row for row in found):
            remarks.append(
                f"force sensor {name} (frame {stream.frame!r}) is left out: nothing of it was seen "
                "in any pose. Try: a recording in which it shares the clock of markers or grippers"
            )
            continue
        remarks.append(
            f"{side}_force, {side}_moment: means of {name}, in axes of "
            f"{stream.frame or 'the world'}; taken as those of the cable on its fixture, about its "
            "place, with the gripper's weight taken off"
        )
    return found, remarks


def _side(sensor: Stream, holders: Holders) -> str | None:
    """The fixture, start or end, that a force sensor's frame or topic is called after, if any."""
    for names in ([sensor.frame], [sensor.name, *sensor.name.split("/")]):
        sides = [side for side, parts in holders.items() if {*parts} & {*names}]
        if len(sides) == 1:
            return sides[0]
    if sides:
        raise MeasurementError(
            f"the force sensor {sensor.name} (frame {sensor.frame!r}) is called after both of the "
            "fixtures.\n  Try: --start or --end with its frame."
        )
    return None
