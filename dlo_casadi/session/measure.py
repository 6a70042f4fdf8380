"""Read what a configuration names, one pose at a time: its camera, photographs or centre-lines."""

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from dlo_casadi import vision
from dlo_casadi.config import Config, DeclaredCamera, Images, Pose
from dlo_casadi.errors import MeasurementError, counted
from dlo_casadi.io.points import MeasuredPoints, read_points
from dlo_casadi.runtime.progress import Step, nobody
from dlo_casadi.sensing.measured_pose import MeasuredPose
from dlo_casadi.sensing.pixels import ViewInput, pixel_std, pixels_of
from dlo_casadi.sensing.sensors import line_or_markers
from dlo_casadi.session.outcome import PoseInput

# Photographs read in parallel: on two cores this takes 0.66 of the serial time.
THREADS = 2
# Points per line used by fits, errors and pictures. More points of a photograph would repeat their
# neighbours' noise; other lines enter the fit as means of neighbours.
MOST_POINTS = 240
# Distance [m] within which a point repeats the number of a fixture: the digits of a printed file.
COPIED = 1e-6
# Least noise of a line's points, in pixels of its photograph, however little they scatter: what
# pictures of an independent renderer leave. See docs/pages/theory/noise.md.
LEAST_PIXELS = 0.02


def read_session(config: Config, step: Step = nobody) -> tuple[Config, tuple[PoseInput, ...]]:
    """Return the configuration with its camera, and all poses: `calibrated` and `read_inputs`."""
    config = calibrated(config, step)
    return config, read_inputs(config, step)


def read_inputs(config: Config, step: Step = nobody) -> tuple[PoseInput, ...]:
    """Read all poses; a pose that cannot be read keeps its name and the reason.

    Several are read at a time: OpenCV and NumPy release the interpreter for half of the work.
    """
    poses, inputs = config.experiment.poses, []
    threads = ThreadPoolExecutor(THREADS)
    try:
        found = threads.map(lambda pose: _read(config, pose), poses)
        for k, pose in enumerate(poses):
            step(f"read {pose.shown_by}", k, len(poses))
            inputs.append(next(found))
    finally:
        threads.shutdown(cancel_futures=True)
    step("read ", len(poses), len(poses))
    return tuple(inputs)


def _read(config: Config, pose: Pose) -> PoseInput:
    skipped = {item.name: item.reason for item in config.skipped}
    try:
        if pose.name in skipped:
            raise MeasurementError(skipped[pose.name])
        return _without_copies(config, pose, _reader(config, pose).read(config, pose))
    except MeasurementError as error:
        said = error.message.removeprefix(f"{pose.name}: ")  # a photograph may have the pose's name
        return PoseInput.unread(config, pose, said)


def _without_copies(config: Config, pose: Pose, read: PoseInput) -> PoseInput:
    """A pose with readings alone if its points only repeat its fixtures, which show no shape."""
    ends = np.array([place for place in (pose.start, pose.end) if place is not None])
    if not pose.readings or not len(read.points) or read.views:
        return read
    away = np.linalg.norm(read.points[:, None] - ends[None], axis=2).min(axis=1)
    if away.max() > COPIED:
        return read
    said = "its points are those of its fixtures and show no shape: it has readings alone"
    return replace(_read_nothing(config, pose), messages=(said,))


def measured_poses(config: Config, inputs: Sequence[PoseInput]) -> tuple[MeasuredPose, ...]:
    """Convert poses that were read to measurements with end conditions, for the fit.

    A pose that cannot be read keeps its end conditions, which the load history needs. Raises
    MeasurementError with all reasons if no fit pose could be read.
    """
    if not any(item.readable and item.role == "fit" for item in inputs):
        reasons = "\n".join(f"  {item.name}: {item.problem}" for item in inputs if item.problem)
        raise MeasurementError(f"no fit pose could be read:\n{reasons}")
    views = [view for item in inputs for view in item.views]
    std = pixel_std(views) if views else 0.0
    return tuple(
        _measured(pose, item, std, config)
        for pose, item in zip(config.experiment.poses, inputs, strict=True)
    )


def _measured(pose: Pose, item: PoseInput, std: float, config: Config) -> MeasuredPose:
    """Convert a pose with its sensors; pixels of weight one have standard deviation `std` [m]."""
    held = replace(pose.held, camera_center=item.camera_center)
    held_out = pose.role == "held_out"
    if item.views:
        found = [pixels_of(view, std, len(item.points) > 0) for view in item.views]
        sensors = tuple(sensor for sensor in found if sensor is not None)
        seen = MeasuredPose(held, sensors, held_out, line_or_markers(item.points))
    elif item.means is not None:
        means = line_or_markers(item.means.points, s=item.means.s, count=item.means.count)
        seen = MeasuredPose(held, (means,), held_out, line_or_markers(item.points, s=item.s))
    else:
        seen = MeasuredPose.of_points(held, item.points, item.weight, held_out, item.s)
    if item.pixel is not None:
        seen = replace(seen, least=LEAST_PIXELS * item.pixel)
    if config.experiment.fed_by_length and held.free_length is None:
        seen = seen.fed_as_seen(config.cable.length, config.experiment.boundary.fed)
    return seen.with_readings(pose.readings) if item.readable else seen


def line_without_end(config: Config, pose: Pose) -> np.ndarray | None:
    """Line (K, 2) [m] in a photograph, searched for as if its end were free; None if there is none.

    It ends where the visible cable ends, whatever the configuration says.
    """
    if _reader(config, pose).read is not _read_image:
        return None
    try:
        image = vision.read_image(pose.paths[0])
        free = pose.changed(end=None)
        view = view_of(config, image)
        return vision.extract_centerline(image, view, _held(config, free)).points
    except MeasurementError:
        return None


def _read_nothing(config: Config, pose: Pose) -> PoseInput:
    return replace(PoseInput.unread(config, pose), unseen=True)


def _read_csv(config: Config, pose: Pose) -> PoseInput:
    held = config.cable.length, config.experiment.boundary.fed
    return _thinned(pose, read_points(pose.paths[0], pose.start, pose.end, *held))


def _read_points(config: Config, pose: Pose) -> PoseInput:
    s = None if pose.at is None else np.array(pose.at)
    found = MeasuredPoints(np.array(pose.points), s)
    held = config.cable.length, config.experiment.boundary.fed
    return _thinned(pose, found.in_order(pose.start, pose.end, *held))


def _thinned(pose: Pose, read: MeasuredPoints) -> PoseInput:
    """Reduce lines and markers to what a fit compares: means of neighbours where there are many."""
    kept = _kept(read.points)
    s = None if read.s is None else read.s[kept]
    means = read.means(MOST_POINTS) if len(read.points) > MOST_POINTS else None
    return PoseInput(pose.name, pose.role, read.points[kept], s=s, means=means)


def _kept(points: np.ndarray) -> slice:
    """Slice that picks at most `MOST_POINTS` points, evenly spaced."""
    return slice(None, None, max(1, -(-len(points) // MOST_POINTS)))


def _read_views(config: Config, pose: Pose) -> PoseInput:
    """Read photographs of a cable in space; messages name those that cannot be used."""
    images, problems = {}, []
    for name, path in pose.photographs.items():
        try:
            images[name] = vision.read_image(path)
        except MeasurementError as error:
            problems.append(error.message)
    views = vision.measure_views(images, *_equipment(config), _held(config, pose))
    problems += views.problems.values()
    if not views.curves:
        raise MeasurementError(" ".join([*problems, *views.messages]))
    points = np.zeros((0, 3)) if views.line is None else views.line.points
    numbers = [set(curve.viewpoint.numbers) for curve in views.curves.values()]
    return PoseInput(
        pose.name,
        pose.role,
        points[_kept(points)],
        confidence=min(curve.confidence for curve in views.curves.values()),
        messages=(*problems, *views.messages),
        markers=tuple(sorted(set.intersection(*numbers))),
        views=tuple(
            ViewInput(name, pose.photographs[name], curve, views.places[name])
            for name, curve in views.curves.items()
        ),
    )


def _read_image(config: Config, pose: Pose) -> PoseInput:
    image = vision.read_image(pose.paths[0])
    try:
        view = view_of(config, image)
        line = vision.extract_centerline(image, view, _held(config, pose))
    except MeasurementError as error:
        hint = _turned(config, pose, image)
        raise MeasurementError(f"{error.message}{hint}") from None
    kept = _kept(line.points)
    return PoseInput(
        pose.name,
        pose.role,
        line.points[kept],
        image=pose.paths[0],
        pixels=line.pixels[kept],
        to_pixels=view.to_pixels,
        center=tuple(view.to_board([[image.shape[1] / 2, image.shape[0] / 2]])[0]),
        camera_center=None if view.camera_center is None else tuple(view.camera_center),
        pixel=1.0 / view.scale,
        weight=(line.std / np.median(line.std))[kept],
        coverage=line.coverage,
        confidence=line.confidence,
        messages=(*line.messages, *view.messages),
        markers=view.numbers,
    )


def _held(config: Config, pose: Pose) -> vision.KnownCable:
    """What is known of the cable in a photograph."""
    return vision.KnownCable(pose.start, pose.end, config.cable.diameter, config.cable.length)


def draw_steps(config: Config, pose: Pose) -> dict[str, np.ndarray]:
    """Pictures (h, w, 3) of each step of the camera, up to the step that failed.

    Keys: name of the photograph, see `Pose.labelled`, and of the step. Raises VisionError if none
    of its photographs can be read.
    """
    look = _reader(config, pose).look
    if look is None:
        return {}
    cable = _held(config, pose)
    drawn: dict[str, np.ndarray] = {}
    unread = None
    for name, path in pose.labelled.items():
        try:
            image = vision.read_image(path)
        except MeasurementError as error:
            unread = error
            continue
        workings = vision.Workings()
        with suppress(MeasurementError):  # the pictures show how far it got; the table says why
            look(config, image, cable, workings)
        steps = vision.draw_steps(image, workings)
        drawn |= {f"{name}_{step}": shown for step, shown in steps.items()}
    if unread is not None and not drawn:
        raise unread
    return drawn


def _look_in_space(
    config: Config, image: np.ndarray, cable: vision.KnownCable, workings: vision.Workings
) -> None:
    viewpoint = vision.locate_camera(image, *_equipment(config))
    vision.see_cable(image, viewpoint, cable, workings)


def _look_on_board(
    config: Config, image: np.ndarray, cable: vision.KnownCable, workings: vision.Workings
) -> None:
    vision.extract_centerline(image, view_of(config, image), cable, workings)


@dataclass(frozen=True)
class Reader:
    """One way in which a pose was measured.

    Parameters
    ----------
    applies : callable
        Whether a pose of a configuration was measured so.
    read : callable
        What was measured.
    look : callable, optional
        Repeats what the camera does in a photograph, for the pictures of its steps.
    """

    applies: Callable[[Config, Pose], bool]
    read: Callable[[Config, Pose], PoseInput]
    look: Callable[[Config, np.ndarray, vision.KnownCable, vision.Workings], None] | None = None


# The first that applies reads a pose.
READERS = (
    Reader(lambda config, pose: not pose.shown, _read_nothing),
    Reader(lambda config, pose: pose.points is not None, _read_points),
    Reader(
        lambda config, pose: (
            config.experiment.measurement.kind != "images" or pose.paths[0].suffix.lower() == ".csv"
        ),
        _read_csv,
    ),
    Reader(lambda config, pose: config.experiment.in_space, _read_views, _look_in_space),
    Reader(lambda config, pose: True, _read_image, _look_on_board),
)


def _reader(config: Config, pose: Pose) -> Reader:
    return next(reader for reader in READERS if reader.applies(config, pose))


def _turned(config: Config, pose: Pose, image: np.ndarray) -> str:
    """Sentence for a photograph that becomes measurable once it is rotated.

    A board's markers show which way is up; two reference points do not.
    """
    measurement = config.experiment.measurement
    if measurement.kind != "images" or measurement.reference is None:
        return ""
    turns = {2: "180 degrees", 1: "90 degrees counter-clockwise", 3: "90 degrees clockwise"}
    for quarters, how in turns.items():
        turned = np.ascontiguousarray(np.rot90(image, quarters))
        try:
            vision.extract_centerline(turned, view_of(config, turned), _held(config, pose))
        except MeasurementError:
            continue
        return (
            f" The cable is found once the photograph is turned by {how}: turn it, or read the "
            "reference's pixels again."
        )
    return ""


def view_of(config: Config, image: np.ndarray) -> vision.View:
    """Map from the photograph's pixels to the cable's plane."""
    measurement = config.experiment.measurement
    assert measurement.kind == "images"
    if measurement.reference is None:
        camera = None if measurement.camera is None else _camera(measurement.camera)
        return vision.locate_board(image, board_of(measurement), camera)
    pixels, (height, width) = np.array(measurement.reference.pixels), image.shape[:2]
    for u, v in pixels:
        if not (0 <= u < width and 0 <= v < height):
            raise MeasurementError(
                f"the reference point ({u:g}, {v:g}) px lies outside of the picture of {width} x "
                f"{height} px. Try: was the picture turned by 90 degrees or made smaller since "
                "the pixels were read?"
            )
    return vision.from_reference(pixels, measurement.reference.points, image.shape)


def board_of(measurement: Images) -> vision.Board:
    """The board in the form that the camera step uses."""
    declared = measurement.board
    assert declared is not None
    return vision.Board(
        declared.dictionary, declared.marker_size, declared.standoff, declared.marker_centers
    )


def _camera(declared: DeclaredCamera) -> vision.Camera:
    return vision.Camera(np.array(declared.matrix), np.array(declared.distortion))


def _equipment(config: Config) -> tuple[vision.Board, vision.Camera]:
    """Board and camera for photographs of a cable in space; `calibrated` has found the camera."""
    measurement = config.experiment.measurement
    assert measurement.kind == "images"
    assert measurement.camera is not None
    return board_of(measurement), _camera(measurement.camera)


# Largest relative standard deviation of a focal length found from a session's own photographs:
# a shape in space is off by as much along the view. Three rendered photographs with views within
# ten degrees leave 0.7 to 6 %.
_UNKNOWN = 0.02


def needs_camera(config: Config) -> str:
    """Why photographs cannot be measured without a declared camera; empty if they can.

    In a plane the board's own plane gives the view; a standoff from it does not.
    """
    measurement = config.experiment.measurement
    if measurement.kind != "images" or measurement.board is None or measurement.camera is not None:
        return ""
    if config.experiment.in_space:
        return "in space"
    return "with a standoff from the board" if measurement.board.standoff else ""


def calibrated(config: Config, step: Step = nobody) -> Config:
    """Return the configuration with a camera calibrated from its photographs, where it needs one.

    Raises MeasurementError if they do not determine it.
    """
    why = needs_camera(config)
    if not why:
        return config
    try:
        found = calibrate_session(config, step)
    except MeasurementError as error:
        raise MeasurementError(
            f"measurement.camera is missing, photographs of a cable {why} need it, and they "
            f"do not show it themselves: {error.message}"
        ) from None
    matrix, distortion = found.camera.matrix.tolist(), found.camera.distortion.tolist()
    camera = DeclaredCamera(matrix=matrix, distortion=distortion)
    return config.changed(experiment={"measurement": {"camera": camera}}).noted(
        warnings=(*config.warnings, f"no camera is declared: {summary(found)}", *found.advice)
    )


def calibrate_session(config: Config, step: Step = nobody) -> vision.Calibration:
    """Calibrate the camera from all photographs of a session, see `vision.calibrate_camera`.

    Raises MeasurementError if the session has no photographs of a board, too few that show it, or
    if they leave the focal length unknown.
    """
    measurement = config.experiment.measurement
    if measurement.kind != "images" or measurement.board is None:
        raise MeasurementError(
            "a camera is calibrated from photographs of a board of markers, and this session has "
            "none. Try: measurement: {kind: images, board: ...}"
        )
    paths: dict[str, Path] = {}
    for pose in config.experiment.poses:
        for name, path in pose.labelled.items():
            if path.suffix.lower() != ".csv":
                paths[str(path) if name in paths else name] = path
    images = {}
    for k, (name, path) in enumerate(paths.items()):
        step(f"calibrate {name}", k, len(paths))
        try:
            images[name] = vision.read_image(path)
        except MeasurementError:  # reported when its pose is read
            continue
    found = vision.calibrate_camera(images, board_of(measurement))
    step("calibrate", len(paths), len(paths))
    if found.focal_uncertainty > _UNKNOWN:
        raise MeasurementError("; ".join(found.advice))
    return found


def summary(found: vision.Calibration) -> str:
    """Summarise a calibration in one sentence."""
    matrix, std = found.camera.matrix, found.matrix_std
    return (
        f"focal lengths {matrix[0, 0]:.1f} +- {std[0]:.1f} and {matrix[1, 1]:.1f} +- "
        f"{std[1]:.1f} px from {counted(len(found.errors), 'photograph')} of the session whose "
        f"directions lie within {found.spread:.0f} degrees, {found.reprojection_error:.2f} px RMS"
    )
