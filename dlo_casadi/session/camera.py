"""The camera of a session from its own photographs of the board."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

from dlo_casadi import vision
from dlo_casadi.config import Camera, Config
from dlo_casadi.errors import MeasurementError, counted
from dlo_casadi.session.measure import board_of

# Relative standard deviation of the focal length from which on a session's own photographs tell
# no camera: a shape in space is off by as much along the view. Of rendered ones three from within
# ten degrees leave 0.7 to 6 %.
_UNKNOWN = 0.02


def needs_camera(config: Config) -> bool:
    """Whether photographs are to be measured that cannot be without a camera, and none is given.

    In a plane the board's own plane can; a standoff from it cannot.
    """
    measurement = config.experiment.measurement
    if measurement.kind != "images" or measurement.board is None or measurement.camera is not None:
        return False
    return config.experiment.in_space or measurement.board.standoff != 0.0


def calibrated(config: Config, step: Callable[[str, int, int], None]) -> Config:
    """Return the configuration with the camera that its photographs show, where it needs one.

    Parameters
    ----------
    step : callable
        Called with the photograph's name, how many are read and how many there are.

    Raises
    ------
    MeasurementError
        If they do not show it.
    """
    if not needs_camera(config):
        return config
    try:
        found = calibrate_session(config, step)
        if found.focal_uncertainty > _UNKNOWN:
            raise MeasurementError("; ".join(found.advice))
    except MeasurementError as error:
        why = "in space" if config.experiment.in_space else "with a standoff from the board"
        raise MeasurementError(
            f"measurement.camera is missing, photographs of a cable {why} need it, and they "
            f"do not show it themselves: {error.message}"
        ) from None
    matrix = tuple(tuple(row) for row in found.camera.matrix.tolist())
    camera = Camera.model_validate(
        {"matrix": matrix, "distortion": tuple(found.camera.distortion.tolist())}
    )
    experiment = config.experiment
    measurement = experiment.measurement.model_copy(update={"camera": camera})
    return replace(
        config,
        experiment=experiment.model_copy(update={"measurement": measurement}),
        warnings=(*config.warnings, f"no camera is declared: {summary(found)}", *found.advice),
    )


def calibrate_session(config: Config, step: Callable[[str, int, int], None]) -> vision.Calibration:
    """Calibrate the camera from all photographs of a session, see `vision.calibrate_camera`.

    Raises
    ------
    MeasurementError
        If the session has no photographs of a board, or too few that show it.
    """
    measurement = config.experiment.measurement
    if measurement.kind != "images" or measurement.board is None:
        raise MeasurementError(
            "a camera is calibrated from photographs of a board of markers, and this session has "
            "none. Try: measurement: {kind: images, board: ...}"
        )
    paths = {
        name: path
        for pose in config.experiment.poses
        for name, path in pose.photographs.items()
        if path.suffix.lower() != ".csv"
    }
    images = {}
    for k, (name, path) in enumerate(paths.items()):
        step(name, k, len(paths))
        try:
            images[name] = vision.read_image(path)
        except MeasurementError:  # told of once its pose is read
            continue
    found = vision.calibrate_camera(images, board_of(measurement))
    step("", len(paths), len(paths))
    return found


def summary(found: vision.Calibration) -> str:
    """One sentence on a calibration."""
    matrix, std = found.camera.matrix, found.matrix_std
    return (
        f"focal lengths {matrix[0, 0]:.1f} +- {std[0]:.1f} and {matrix[1, 1]:.1f} +- "
        f"{std[1]:.1f} px from {counted(len(found.errors), 'photograph')} of the session whose "
        f"directions lie within {found.spread:.0f} degrees, {found.reprojection_error:.2f} px RMS"
    )
