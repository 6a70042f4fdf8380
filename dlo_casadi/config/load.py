"""Make checked configurations of YAML files and of arguments; checks across several sections."""

import difflib
import math
import os
import stat
from collections.abc import Iterator, Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from dlo_casadi.arrays import FloatArray
from dlo_casadi.config.document import BACKSLASH, Document
from dlo_casadi.config.effects import without_values, wrong_effects, wrong_limits
from dlo_casadi.config.frozen import plain
from dlo_casadi.config.noise import impossible_noise
from dlo_casadi.config.oddities import oddities
from dlo_casadi.config.problems import (
    Arguments,
    ConfigProblem,
    Place,
    Source,
    did_you_mean,
    keys_of,
    kind_of,
    show,
)
from dlo_casadi.config.sections import Config, Experiment, Pose, SkippedPose
from dlo_casadi.config.supports import (
    clip_problems,
    clips_differ,
    obstacle_problems,
    too_short,
    undetermined,
    unused_directions,
)
from dlo_casadi.config.values import AXES, REST_COEFFICIENTS, Range
from dlo_casadi.effects import EFFECTS, UNKNOWN_MASS, CableData
from dlo_casadi.errors import ConfigError
from dlo_casadi.rod.chain import RestCurvature
from dlo_casadi.rod.quantities import QUANTITIES
from dlo_casadi.rod.supports import ENDS, place_problem


def load_config(path: str | Path) -> Config:
    """Read and check a configuration.

    Parameters
    ----------
    path : str or Path
        The YAML file.

    Returns
    -------
    Config
        Frozen; the files of the poses are absolute paths.

    Raises
    ------
    ConfigError
        If the file cannot be used; the message lists every problem with its line. A pose that
        cannot be reached or has no file is left out and noted in `Config.skipped`; it is an error
        only if no pose to fit remains.
    """
    if not isinstance(path, str | os.PathLike):
        raise ConfigError(
            f"{path!r} is no configuration.\n"
            '  Try: the path of a YAML file, such as "configs/cable.yaml".'
        )
    source = Path(path)
    document = Document.read(source)
    if not isinstance(document.data, dict):
        found = kind_of(document.data)
        raise ConfigError(
            f"a mapping with cable: and experiment: belongs at the top, found {found}", file=source
        )
    if str(document.data.get("schema")).startswith("dlo-parameters"):
        text = "a fitted cable, no configuration.\n  Try: dlo_casadi.load(path), or dlo predict"
        raise ConfigError(text, file=source)
    return checked_config(document).noted(path=source.absolute())


def checked_config(source: Source) -> Config:
    """Check a configuration from a file or from arguments; raises ConfigError as `load_config`."""
    config = source.checked(Config)
    if problems := [
        *_contradictions(config.experiment, config.cable.length),
        *_weightless(config),
        *wrong_effects(config),
        *impossible_noise(config.experiment, config.cable.length),
        *_impossible_tolerances(config.experiment, config.cable.length),
        *obstacle_problems(
            config.experiment.obstacles,
            config.experiment.gravity,
            [pose.over for pose in config.experiment.poses],
        ),
        *wrong_limits(config),
    ]:
        raise source.error(problems)

    poses = config.experiment.poses
    unreachable = _unreachable(config)
    unused = unused_directions(config.experiment.boundary.start, config.experiment.boundary.end)
    reachable = tuple(pose.without(unused) for pose in poses if pose.name not in unreachable)
    absent = {pose.name: [_absent(path) for path in pose.paths] for pose in reachable if pose.paths}
    reasons = unreachable | {name: "; ".join(told) for name, told in absent.items() if all(told)}
    left = tuple(pose for pose in poses if pose.name not in reasons)
    n_fit = sum(pose.role == "fit" for pose in left)
    weightless = [*_weightless(config.changed(experiment={"poses": left}))]
    without = not poses and len(config.experiment.motions) > 0
    if (n_fit == 0 and not without) or weightless:
        lost = [
            ConfigProblem(("experiment", "poses", i), f"{_called(i, pose)}: {reasons[pose.name]}")
            for i, pose in enumerate(poses)
            if pose.role == "fit" and pose.name in reasons
        ]
        if n_fit == 0 and not without:
            raise source.error(lost, "no pose to fit is left")
        raise source.error([*lost, *weightless])
    warnings = [*oddities(config)]
    if n_fit == 1:
        warnings.append("only one pose to fit: what it tells cannot be checked on another one")
    skipped = [pose for pose in poses if pose.name in reasons]
    return config.changed(experiment={"poses": reachable}).noted(
        warnings=tuple(warnings),
        skipped=tuple(SkippedPose(pose.name, reasons[pose.name], pose.role) for pose in skipped),
    )


def known_config(given: dict[str, Any], names: tuple[str, ...]) -> tuple[Config, FloatArray]:
    """Make a configuration without poses, and rest coefficients [1/m], for `known_cable`.

    Raises ConfigError if an argument is missing or impossible; the message lists every problem with
    its argument.
    """
    given = plain(given)
    rest = given.pop("rest_curvature", None)
    held = {key: given.pop(key) for key in ("gravity", "boundary") if key in given}
    nothing = {"measurement": {"kind": "centerlines"}, "poses": ()}
    source = Arguments(given | {"experiment": nothing | held}, names)
    if strange := sorted(given.keys() & keys_of(Config).keys() - {*names}):
        hint = did_you_mean(strange[0], names)
        raise source.error([ConfigProblem((), f"unknown key {strange[0]!r} in {source.top}{hint}")])
    config = source.checked(Config)
    ends, cable, in_space = config.experiment.boundary, config.cable, config.experiment.in_space
    needed = (
        ("mass", "the mass of its length [kg]; without gravity any"),
        (
            "torsional_stiffness",
            "GJ [N m^2], which a cable in space (three numbers of gravity) needs: of a solid round "
            f"rod EI / 1.3 = {cable.prior_torsional_stiffness:.3g}",
        ),
    )[: 1 + in_space]
    problems = [
        *undetermined(ends.start, ends.end, in_space),
        *(
            ConfigProblem((), f"cable.{key} is not given, and no fit tells it. Try: {meant}")
            for key, meant in needed
            if getattr(cable, key) is None
        ),
        *(wrong_effects(config, known=True) or without_values(config)),
        *wrong_limits(config),
    ]
    values = np.zeros((1 + in_space, 0)) if rest is None else _curvatures(rest, 1 + in_space)
    text = ""
    if values is None:
        form = "(2,) or (2, K) numbers" if in_space else "one number or (K,)"
        text = f"{form} [1/m], K <= {REST_COEFFICIENTS.most}, belong here, found {show(rest)}"
    elif values.size and cable.rest_shape == "straight":
        text = "the cable is declared straight. Try: one of rest_curvature and rest_shape"
    elif (sharpest := np.linalg.norm(values, axis=0).max(initial=0.0)) * cable.diameter >= 2.0:
        text = f"{sharpest:g} 1/m bends it more sharply than it is thick: units are SI"
    problems += [ConfigProblem((), f"rest_curvature: {text}")] if text else []
    if problems or values is None:
        raise source.error(problems)
    count = values.shape[1]
    at = RestCurvature(cable.length, count).basis(np.linspace(0.0, cable.length, count))
    config = config.changed(estimation={"rest_curvature_coefficients": count})
    return config, np.linalg.solve(at, values.T).T.ravel()


def _curvatures(given: Any, axes: int) -> FloatArray | None:
    """A rest curvature as rows (axes, K) [1/m]; None if it is not one."""
    try:
        values = np.atleast_1d(np.array(given))
    except ValueError:  # rows of different lengths
        return None
    if values.dtype.kind not in "iuf":  # a text, or true
        return None
    values = values.astype(float)
    if values.ndim > axes or (axes == 2 and len(values) != 2) or not np.isfinite(values).all():
        return None
    rows = values.reshape(axes, -1)
    return rows if 0 < rows.shape[1] <= REST_COEFFICIENTS.most else None


IMAGE_ENDINGS = (".jpg", ".jpeg", ".png", ".bmp", ".tif", ".tiff", ".webp")
_RELATIVE = "files are found relative to the YAML, from Python relative to the working directory"


def any_photographs(poses: object) -> bool:
    """Whether any file of the poses has a picture's name; a pose is a `Pose` or a mapping."""
    paths: list[object] = []
    for pose in poses if isinstance(poses, list | tuple) else ():
        given = vars(pose) if isinstance(pose, Pose) else pose if isinstance(pose, Mapping) else {}
        several = given.get("files")
        paths += [given.get("file"), *(several if isinstance(several, list | tuple) else ())]
    return any(Path(str(path)).suffix.lower() in IMAGE_ENDINGS for path in paths)


# Names of results add up to forty characters to a pose's name; file systems allow 255 bytes.
_LONGEST_NAME = 200

# Interferometers resolve a nanometre over a metre.
_FINEST_TOLERANCE = 1.0e-9

# A start heading needs at most one full turn [rad]; an end heading is continuous along the cable,
# which may turn several times.
_LARGEST_HEADINGS = {"start": 6.3, "end": 25.0}


def _called(index: int, pose: Pose) -> str:
    return f"pose {index + 1} ({pose.shown_by})"


def _contradictions(experiment: Experiment, length: float) -> Iterator[ConfigProblem]:
    """Find poses that contradict boundary, measurement, the cable's length [m], or each other."""
    measurement, held, poses = experiment.measurement, experiment.boundary, experiment.poses
    if experiment.in_space and measurement.kind == "images" and measurement.board is None:
        text = "photographs of a cable in space need a board of markers; a reference is of a plane"
        yield ConfigProblem(("experiment", "measurement"), text)
    yield from undetermined(held.start, held.end, experiment.in_space)
    if differ := clips_differ([pose.held for pose in poses]):
        yield ConfigProblem(("experiment", "poses"), differ)
    names = [pose.name for pose in poses]
    for i, pose in enumerate(poses):
        at: Place = ("experiment", "poses", i)
        wrong = [*_file_problems(experiment, pose), *_end_problems(experiment, pose)]
        if (first := names.index(pose.name)) < i:
            text = "results are named after the file without its ending, give each its own"
            wrong.append((f"pose {first + 1} is called {pose.name!r} too; {text}", None))
        if pose.branch == "previous" and i == 0:
            text = "branch: previous needs a pose before this one; use ccw or cw"
            wrong.append((text, "branch"))
        for text in filter(None, (place_problem(s, length, held.fed) for s in pose.at or ())):
            wrong.append((f"at {text}: arc length from the start, in metres?", "at"))
            break
        for message, key in wrong:
            yield ConfigProblem((*at, key) if key else at, f"{_called(i, pose)}: {message}")
        for message, k in clip_problems(pose.clips, length, len(experiment.gravity)):
            yield ConfigProblem((*at, "clips", k), f"{_called(i, pose)}: {message}")
    without = not poses and experiment.motions
    if not without and not any(pose.role == "fit" for pose in poses):
        text = "no pose has role: fit, there is nothing to fit to"
        yield ConfigProblem(("experiment", "poses"), text)


def _file_problems(experiment: Experiment, pose: Pose) -> Iterator[tuple[str, str | None]]:
    """Problems with the files of a pose, each with its key."""
    if len(pose.name.encode()) > _LONGEST_NAME:
        yield f"results are named after the file, at most {_LONGEST_NAME} bytes long", None
    endings, kind = {path.suffix.lower() for path in pose.paths}, experiment.measurement.kind
    pictures = endings.intersection(IMAGE_ENDINGS)
    # In space one session may mix photographs, lines and markers.
    mixed = experiment.in_space and pose.file is not None
    if kind == "images" and ".csv" in endings and not mixed:
        yield "a CSV is not a photograph; measurement kind: centerlines?", None
    if kind == "centerlines" and pictures:
        yield "a photograph is not a CSV; measurement kind: images?", None
    if pose.points is not None:
        own = AXES[len(experiment.gravity)]
        if len(pose.points[0]) != len(experiment.gravity):
            yield f"points: [{own.place}, ...] belong here ({own.gravity} of gravity)", "points"
        if kind == "images" and not experiment.in_space:
            yield "points are not a photograph; measurement kind: centerlines?", "points"
    if len(pose.files) > 1 and not pictures and kind == "centerlines":
        yield "files are photographs of one pose; one CSV belongs here, as file", "files"
    elif len(pose.files) > 1 and not experiment.in_space:
        yield "several photographs are of a cable in space; gravity: two numbers", "files"


def _weightless(config: Config) -> Iterator[ConfigProblem]:
    """Reasons why an undeclared mass cannot be found."""
    experiment, at = config.experiment, ("cable", "mass")
    if config.cable.mass is not None:
        return
    if not any(experiment.gravity):
        yield ConfigProblem(at, "mass: null: without gravity nothing depends on it; declare any")
    elif not any(pose.readings for pose in experiment.poses if pose.role == "fit"):
        text = "mass: null: shapes determine only the ratio of stiffness to weight. Try: the mass "
        yield ConfigProblem(at, f"{text}in kg, or end_force of a fit pose")
    elif any(item.name == UNKNOWN_MASS.name for item in config.model.effects):
        text = f"mass: null: {UNKNOWN_MASS.name} corrects a declared mass"
        yield ConfigProblem(at, f"{text}: declare the mass, or leave the effect out")


def _end_problems(experiment: Experiment, pose: Pose) -> Iterator[tuple[str, str | None]]:
    """Problems with the ends of a pose, in the plane or in space, each with its key."""
    held, space, d = experiment.boundary, experiment.in_space, len(experiment.gravity)
    own, other = AXES[d], AXES[5 - d]
    numbers = f"{own.gravity} of gravity: the cable is in {own.where}"
    for key, most in _LARGEST_HEADINGS.items():
        place, how, heading = getattr(pose, key), getattr(held, key), f"{key}_heading"
        if place is not None and len(place) != d:
            yield f"{key}: {own.place} belongs here ({numbers})", key
        if getattr(pose, strange := f"{key}_{other.direction}") is not None:
            text = f"is for a cable in {other.where}; gravity has {own.gravity}"
            yield f"{strange} {text}. Try: {key}_{own.direction}", strange
        angle = getattr(pose, heading) or 0.0
        if how.direction and abs(angle) > most:
            yield f"{heading}: {angle:g} rad: in degrees? then {math.radians(angle):.4g}", heading
        for quantity in QUANTITIES:
            name, axes = f"{key}_{quantity.name}", "xyz"[:d]
            reading = getattr(pose, name)
            if reading is not None and len(reading) != len(quantity.components(axes)):
                yield f"{name}: {quantity.written(axes)} belongs here ({numbers})", name
        if how.direction and getattr(pose, f"{key}_{own.direction}") is None:
            one = "an" if key == "end" else "a"
            yield f"a {how} {key} needs {one} {key}_{own.direction} {own.unit}", None
    if held.end.place and pose.end is None:
        yield f"a {held.end} end needs its position: end: {own.place}", None
    if not held.end.place:
        for key in ("end", "end_heading", "end_orientation", "end_force", "end_moment"):
            if getattr(pose, key) is not None:
                others = ", ".join(kind for kind in ENDS if kind.place)
                yield f"a free end has no {key}. Try: boundary.end: one of {others}", None
    if pose.turns and not (space and held.start.roll and held.end.roll):
        yield "turns are of a cable in space that is clamped at both ends", "turns"
    for key, how in (("start", held.start), ("end", held.end)):
        needed = how.slides and not experiment.fed_by_length
        if needed != (getattr(pose, f"{key}_tension") is not None):
            article = ("an" if key == "end" else "a") if how.slides else "no"
            all_of = ", in all poses or in none" if how.slides else ""
            yield f"a {how} {key} has {article} {key}_tension [N]{all_of}", None
    if pose.free_length is not None and not experiment.fed_by_length:
        yield "free_length is of a cable that slides through an end, without a tension there", None
    if pose.branch in ("ccw", "cw") and space:
        yield f"branch: {pose.branch} is of a cable in a plane", "branch"


def _unreachable(config: Config) -> dict[str, str]:
    """Find poses whose fixtures are farther apart than their cable is long, plus three tolerances.

    Between clips, these include how well the places of clips are known, and their arc lengths.
    """
    cable, experiment = config.cable, config.experiment
    tolerances, held = experiment.tolerances, experiment.boundary
    slides = held.start.slides or held.end.slides
    slack = 3.0 * math.hypot(tolerances.length, tolerances.end)
    at_clips = math.hypot(slack, 3.0 * tolerances.clip, 3.0 * tolerances.slip)
    reasons: dict[str, str] = {}
    for pose in experiment.poses:
        end = pose.end or pose.start
        distance = math.dist(pose.start, end)
        if distance > cable.length + slack and not slides:
            meant = ", ".join(f"{x / 1e3:g}" for x in end)
            hint = f" Did you mean ({meant})?" if 10 * cable.length < distance else ""
            reasons[pose.name] = (
                f"end ({', '.join(f'{x:g}' for x in end)}) m is {distance:.4g} m from the start; "
                f"the cable is {cable.length:.4g} m long. Are end and cable.length in metres?{hint}"
            )
        elif wrong := too_short(pose.held, held, cable.length, at_clips):
            reasons[pose.name] = wrong
    return reasons


def _absent(file: Path) -> str:
    """Why a file cannot be read, and what may have been meant; empty if it exists."""
    try:
        if stat.S_ISREG(file.stat().st_mode):
            return ""
        return f"{file} is no file; a photograph or a CSV belongs here"
    except (FileNotFoundError, NotADirectoryError):
        names = [path.name for path in file.parent.glob("*")]
        near = difflib.get_close_matches(file.name, names, 1, cutoff=0.8)
        meant = f"did you mean {near[0]}?" if near else _RELATIVE
        if any(ord(sign) < 32 for sign in str(file)):
            return f"{show(str(file))} does not exist. {BACKSLASH}"
        if "\\" in str(file):  # folders are separated by it on Windows alone, by / everywhere
            meant = f"write / between folders: {file.name.replace(chr(92), '/')}"
        return f"{file} does not exist; {meant}"
    except (OSError, ValueError) as error:  # a NUL in the name is a ValueError
        reason = getattr(error, "strerror", None) or error
        return f"{show(str(file))} cannot be read: {reason}"


def _impossible_tolerances(experiment: Experiment, length: float) -> Iterator[ConfigProblem]:
    """Find tolerances that are impossible for a cable of that length [m]."""
    # A tolerance must fit within its bounds; otherwise the bounds decide instead.
    torsional_stiffness = 1.0 if experiment.in_space else None
    cable = CableData(length, 1.0, 1.0, 1.0, torsional_stiffness=torsional_stiffness)
    declared = asdict(experiment.tolerances)
    taken_up = {
        kind.tolerances[q.name]: q
        for kind in EFFECTS.values()
        for q in kind().parameters(cable)
        if kind.tolerances.get(q.name) in declared
    }
    for key, q in taken_up.items():
        most = min(q.upper - q.nominal, q.nominal - q.lower)
        if wrong := Range(_FINEST_TOLERANCE, most, q.unit).complaint(declared[key]):
            yield ConfigProblem(("experiment", "tolerances", key), f"tolerances.{key}: {wrong}")
