"""Compare an exported cable relaxed in its simulator with our prediction and the measurement."""

import hashlib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.interpolate import CubicSpline

from dlo_casadi.arrays import FloatArray
from dlo_casadi.cable.exported import AnyMotion, given_motion
from dlo_casadi.cable.fitted_cable import FittedCable, Shape
from dlo_casadi.config import Config, Pose, load_config
from dlo_casadi.equilibrium.curve import NodeCurve
from dlo_casadi.errors import ConfigError, DloError, EquilibriumError, counted
from dlo_casadi.estimation.prediction import predict_poses
from dlo_casadi.export.rod import ROUND, Rod
from dlo_casadi.export.targets import Target, require, step_of
from dlo_casadi.sensing.measured_pose import MeasuredPose
from dlo_casadi.session.measure import Step, measured_poses, read_session

# Fits whose stiffness a simulator is given, in the order of tables.
CASES = ("default", "first guess", "identified")
# Number of chords of a relaxed shape that measured points are compared with.
_CHORDS = 400


@dataclass(frozen=True)
class Distance:
    """Root mean square and largest distance of two shapes, relative to the length."""

    rms: float
    largest: float

    @classmethod
    def of(cls, distances: FloatArray, length: float) -> "Distance":
        """Of distances [m]."""
        square = float(np.mean(np.square(distances)))
        return cls(np.sqrt(square) / length, float(np.max(distances)) / length)


@dataclass(frozen=True, eq=False)
class Relaxation:
    """One held-out pose in a simulator, with the stiffness of one of `CASES`.

    Parameters
    ----------
    pose, case : str
    to_prediction : Distance or None
        From our prediction with the identified cable, at equal arc lengths; None if the simulation
        did not come to rest, see `problem`.
    to_measured : Distance or None
        From the measured points, compared as in a fit.
    force, predicted_force : (d,) [N]
        Force of the cable on its end fixture, in the simulator and in our prediction.
    measured_force : (d,) [N] or None
    points, predicted, measured : (K, d) [m]
        Shapes to draw.
    lost : tuple of str
        Features of the identified cable that the target cannot represent.
    """

    pose: str
    case: str
    to_prediction: Distance | None
    to_measured: Distance | None
    force: FloatArray | None
    predicted_force: FloatArray
    measured_force: FloatArray | None
    points: FloatArray
    predicted: FloatArray
    measured: FloatArray
    links: int
    lost: tuple[str, ...]
    problem: str = ""


def session_of(cable: FittedCable, given: Path | None) -> Config:
    """The session that a cable was fitted to: as given, or found by name near its results and here.

    A session found by name must be the one that was fitted; a given one is taken as it is. Raises
    ConfigError if it cannot be found.
    """
    name, source = f"{cable.metadata.config}.yaml", cable.metadata.path
    places = [Path(), Path("configs"), *([] if source is None else source.resolve().parents[1:4])]
    found = [given] if given else [p / name for p in places if (p / name).is_file()]
    for path in found:
        fitted = cable.metadata.document.get("config_hash")
        if given or hashlib.sha256(path.read_bytes()).hexdigest() == fitted:
            return load_config(path)
    looked = ", ".join(dict.fromkeys(str(path.resolve()) for path in found or places))
    missing = f"is no longer as it was fitted: {looked}" if found else f"is not in {looked}"
    raise ConfigError(
        f"the session {name} that {cable.name!r} was fitted to {missing}.\n"
        "  Try: --check SESSION.yaml"
    )


def motion_round_trip(
    cable: FittedCable,
    target: Target,
    file: Path,
    motion: AnyMotion,
    segments: int | None,
    held: Mapping[str, Any],
) -> Distance:
    """How far the links of a written cable, whose fixtures move, are from our simulation.

    Raises DloError if the target is not installed; MotionError if the motion has no solution.
    """
    require(target)
    given = given_motion(cable, motion, step_of(target), held)
    shape, own = cable.solve(**given.first), cable.simulate(given.t, **given.held)
    rod = replace(Rod.of(shape.held, segments), driven=given.driven)
    assert target.follow is not None
    found = target.follow(file.read_text(), rod)[..., : cable.model.node.dimension]
    inside = (rod.s >= 0) & (rod.s <= cable.length)
    t = np.minimum(given.t[0] + given.driven.step * np.arange(len(found)), given.t[-1])
    apart = np.linalg.norm(found[:, inside] - own.way.points(t, rod.s[inside]), axis=2)
    return Distance.of(apart, cable.length)


def comparable(config: Config, target: Target) -> None:
    """Raise DloError if a target is not installed, or if the session has clips or obstacles."""
    require(target)
    if config.experiment.clips or config.experiment.obstacles:
        raise DloError(
            f"{config.name} has clips or obstacles, and {target.title} would not: shapes cannot be "
            "compared.\n  Try: --check SESSION.yaml, with poses of the same cable without them"
        )


def round_trip(
    cable: FittedCable,
    config: Config,
    target: Target,
    segments: int | None,
    step: Step,
    poses: int | None = None,
) -> Iterator[Relaxation]:
    """Relax a cable in every held-out pose, or in every pose if none was held out.

    `poses` limits their number; fitted poses make up for too few held-out ones.
    Raises EquilibriumError if no pose can be predicted, and as `comparable` does.
    """
    comparable(config, target)
    config, inputs = read_session(config)
    measured = measured_poses(config, inputs)
    declared = config.experiment.poses
    predictions = predict_poses(cable.model, cable.p, cable.rest, [item.pose for item in measured])
    order = sorted(range(len(measured)), key=lambda j: not measured[j].held_out)
    held_out = sum(item.held_out for item in measured) or len(measured)
    chosen = [j for j in order if predictions[j] is not None][: poses or held_out]
    if not chosen:
        raise EquilibriumError(
            f"no pose of {config.name} ({counted(len(measured), 'pose')}) can be predicted with "
            f"{cable.name!r}.\n  Try: --check SESSION.yaml, with the session it was fitted to"
        )
    model = cable.model
    guess = (model.cable.bending_stiffness, model.cable.torsional_stiffness)
    for count, j in enumerate(chosen):
        found = predictions[j]
        assert found is not None
        shape = cable.shape_in(measured[j].pose, found.equilibrium)
        rod = Rod.of(shape.held, segments)
        given = {
            "default": rod.with_stiffness(*target.default_stiffness(rod.radius)),
            "first guess": rod.with_stiffness(guess[0], guess[1] or ROUND * guess[0]),
            "identified": rod,
        }
        for k, case in enumerate(CASES):
            step(f"{declared[j].name}, {case}", len(CASES) * count + k, len(CASES) * len(chosen))
            yield _relaxed(declared[j], case, shape, given[case], measured[j], target)
    step("relax", 1, 1)


def _relaxed(
    pose: Pose, case: str, shape: Shape, rod: Rod, measured: MeasuredPose, target: Target
) -> Relaxation:
    (low, high), d = shape.held.places[[0, -1]], shape.curve.d
    s, length = np.linspace(low, high, _CHORDS + 1), high - low
    ours, seen = (curve.at(np.minimum(s - low, length)) for curve in (shape.curve, shape.seen))
    reading = pose.readings.get("end_force")
    nothing = Relaxation(
        pose.name,
        case,
        None,
        None,
        None,
        predicted_force=shape.end_force,
        measured_force=None if reading is None else np.array(reading),
        points=np.zeros((0, d)),
        predicted=ours,
        measured=measured.points if measured.readable else np.zeros((0, d)),
        links=len(rod.masses),
        lost=tuple(target.dropped(rod)),
    )
    try:
        at_rest = target.settle(target.write(rod, []), rod)
    except EquilibriumError as error:
        return replace(nothing, problem=error.message.partition("\n")[0])
    points = CubicSpline(rod.s, at_rest.nodes)(s)[:, :d]
    curve = NodeCurve(length, points + seen - ours, None)
    inside = (rod.s >= low) & (rod.s <= high)
    gap = np.linalg.norm(points - ours, axis=1)
    out_of_plane = np.abs(at_rest.nodes[inside, d:]).max(initial=0.0)
    return replace(
        nothing,
        to_prediction=Distance.of(np.hypot(gap, out_of_plane), length),
        to_measured=Distance.of(measured.distances(curve), length) if measured.readable else None,
        force=at_rest.end_force[:d],
        points=points,
    )
