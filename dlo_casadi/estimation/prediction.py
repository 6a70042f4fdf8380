"""Shapes predicted from the end conditions alone, and their distance from what was measured."""

from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import groupby

import numpy as np

from dlo_casadi.arrays import FloatArray
from dlo_casadi.equilibrium.curve import NodeCurve, Observed, curves_of
from dlo_casadi.equilibrium.equilibrium import (
    NEARBY,
    Equilibrium,
    stacked,
    with_equilibrium,
)
from dlo_casadi.equilibrium.measured_line import line_nodes
from dlo_casadi.equilibrium.pose import HeldPose, PoseBranch
from dlo_casadi.equilibrium.solve import (
    all_equilibria,
    continued,
    solve_after,
    solve_equilibria,
    ways_of,
    ways_round,
)
from dlo_casadi.equilibrium.spread import SolvedCable, Uncertainty
from dlo_casadi.errors import EquilibriumError
from dlo_casadi.estimation.problem import Problem
from dlo_casadi.estimation.repeats import enough_poses, repeat_std
from dlo_casadi.estimation.result import Fit
from dlo_casadi.estimation.unknowns import Values
from dlo_casadi.model.assembly import Assembly, Inputs, Shapes
from dlo_casadi.model.cable_model import END_ROLL, FREE_LENGTH, CableModel
from dlo_casadi.sensing.measured_pose import MeasuredPose

# Further values of `turns` that may choose the equilibrium in which a pose was measured.
WHOLE_TURNS = (1.0, -1.0)


@dataclass(frozen=True, eq=False)
class Prediction(SolvedCable):
    """One pose predicted without its measurement; `rest` is the rest curvature before the pose.

    Parameters
    ----------
    seen : Observed
        Predicted measurements of the camera and the sensors.
    """

    seen: Observed

    @cached_property
    def curve(self) -> NodeCurve:
        """As the camera would see it."""
        return self.seen.curve


@dataclass(frozen=True)
class MeasuredBranch:
    """The equilibrium in which a pose was measured, where a different one is predicted.

    Parameters
    ----------
    prediction : Prediction
        Solved from the measured shape: not a prediction, but what the prediction would be if
        the branch were known.
    branch : "ccw", "cw", "previous" or None
        Branch that the pose must name so that this equilibrium is predicted; None if none does.
    turns : 0.5, -0.5, 1, -1 or None
        The same for a cable in space that is twisted the other way round, see `HeldPose`.
    other_side : bool
        Whether it is the other side, see `CableModel.tipped_by`, and the pose names no side.
    """

    prediction: Prediction
    branch: PoseBranch | None
    turns: float | None = None
    other_side: bool = False


def predict_each(
    model: CableModel,
    p: FloatArray,
    rest: FloatArray,
    poses: Sequence[HeldPose],
    starts: Sequence[FloatArray | None] | None = None,
) -> list[Prediction | None]:
    """Predict poses, each as if it were the first one; see `predict_poses`."""
    solved = solve_equilibria(model, p, rest, poses, starts)
    kept = [j for j, eq in enumerate(solved) if isinstance(eq, Equilibrium)]
    found = [eq for eq in solved if isinstance(eq, Equilibrium)]
    seen = dict(zip(kept, _seen(model, p, rest, [poses[j] for j in kept], found), strict=True))
    return [seen.get(j) for j in range(len(poses))]


def predict_every(
    model: CableModel, p: FloatArray, rest: FloatArray, poses: Sequence[HeldPose]
) -> list[list[Prediction]]:
    """All stable equilibria of each pose, see `all_equilibria`.

    If a pose leaves its mark on the next one, or continues the one before, only that which
    `predict_poses` returns.
    """
    if model.has_state or any(pose.branch == "previous" for pose in poses):
        return [[one] if one else [] for one in predict_poses(model, p, rest, poses)]
    found = all_equilibria(model, p, rest, poses)
    of = [j for j, equilibria in enumerate(found) for _ in equilibria]
    seen = _seen(model, p, rest, [poses[j] for j in of], [eq for each in found for eq in each])
    return [[one for k, one in zip(of, seen, strict=True) if k == j] for j in range(len(poses))]


def predict_poses(
    model: CableModel,
    p: FloatArray,
    rest: FloatArray,
    poses: Sequence[HeldPose],
    starts: Sequence[FloatArray | None] | None = None,
) -> list[Prediction | None]:
    """Predict poses in the order in which they are taken; None where there is no equilibrium.

    Of several equilibria the stable one of lowest energy is chosen, unless the pose names a branch
    or continues the last pose before it that has an equilibrium.

    Parameters
    ----------
    p : (n_parameters,)
    rest : (n_rests,) [1/m]
        Before the first pose.
    starts : sequence of (n_nodes, coordinates) or None, optional
        Nodes from which a pose is solved instead, whichever branch that leads to.
    """
    given = list(starts or [None] * len(poses))
    alone = [
        j
        for j, (pose, start) in enumerate(zip(poses, given, strict=True))
        if not model.has_state and (pose.branch != "previous" or start is not None)
    ]
    apart = predict_each(model, p, rest, [poses[j] for j in alone], [given[j] for j in alone])
    known = dict(zip(alone, apart, strict=True))
    out: list[Prediction | None] = []
    last: tuple[HeldPose, FloatArray] | None = None
    for j, (pose, start) in enumerate(zip(poses, given, strict=True)):
        if j in known:
            found = known[j]
        elif start is None:
            found = None
            with suppress(EquilibriumError):
                eq = solve_after(model, p, rest, pose, last)
                (found,) = _seen(model, p, rest, [pose], [eq])
        else:
            (found,) = predict_each(model, p, rest, [pose], [start])
        out.append(found)
        if found is None:
            continue
        last = pose, found.equilibrium.x
        if model.has_state:
            rest = found.assembly.state_after()[0][0]
    return out


def _seen(
    model: CableModel,
    p: FloatArray,
    rest: FloatArray,
    poses: Sequence[HeldPose],
    equilibria: Sequence[Equilibrium],
) -> list[Prediction]:
    """Equilibria of poses as camera and sensors would see them."""
    if not poses:
        return []
    given = Inputs.of(p, rest, np.array([pose.vector for pose in poses]))
    found = Assembly(model, stacked(equilibria), given)
    return [
        Prediction(model, p, rest, pose, eq, Observed(curve, shown))
        for pose, eq, curve, shown in zip(
            poses, equilibria, curves_of(found), found.readings(), strict=True
        )
    ]


def predicted_shapes(problem: Problem, values: Values) -> Shapes:
    """Shapes of a problem's poses as predicted from their ends alone.

    Where there is no prediction, or one on the other side (see `CableModel.tipped_by`), the shape
    of `values` is kept, held as declared. A prediction takes 3 ms in the plane.
    """
    shapes, p, rest = problem.state(values)
    model, history = problem.unknowns.model, [item.pose for item in problem.history]
    predictions = predict_poses(model, p, rest, history)
    known = [predictions[index] for index in problem.indices]
    elsewhere = [
        replace(one, equilibrium=replace(one.equilibrium, x=x))
        if one is not None
        and _tells_no_side(one)
        and not model.node.same(one.equilibrium.x, x, NEARBY)
        else None
        for one, x in zip(known, shapes.x, strict=True)
    ]
    told = _named_ways(elsewhere)
    for j, (one, way) in enumerate(zip(known, told, strict=True)):
        if one is not None and way is None:
            shapes = with_equilibrium(shapes, j, one.equilibrium)
    return replace(shapes, deviation=np.zeros_like(shapes.deviation))


def _tells_no_side(found: Prediction) -> bool:
    """Whether a cable has two sides, see `CableModel.tipped_by`, and the pose names none."""
    return found.model.tipped_by is not None and not (found.pose.branch or found.pose.turns)


def predict_other_side(known: Prediction) -> Prediction | None:
    """Prediction on the other side, see `Equilibrium`; None where there is none."""
    other = known.equilibrium.other_side
    if other is None:
        return None
    return _seen(known.model, known.p, known.rest, [known.pose], [other])[0]


def measured_elsewhere(
    model: CableModel,
    p: FloatArray,
    rest: FloatArray,
    measured: Sequence[MeasuredPose],
    predictions: Sequence[Prediction | None],
    fitted: Mapping[str, FloatArray] | None = None,
) -> list[Prediction | None]:
    """Stable equilibria in which poses were measured, where others are predicted; else None.

    Each pose is solved from its measured shape. The result counts if its headings differ from the
    prediction and it is nearer to the points, or without points to the readings. `fitted`: nodes
    (n_nodes, coordinates) of fitted poses, by name, as further starts: those of a fit that lacks
    something may be far off.
    """
    fits, lines = fitted or {}, [item.traced for item in measured]
    starts = [
        [*([fits[line.pose.name]] if line.pose.name in fits else []), *_along_line(model, p, line)]
        for line in lines
    ]
    if model.has_state:  # each start would leave its mark on the cable
        starts = [ways[:1] for ways in starts]
    of = [j for j, ways in enumerate(starts) for _ in ways]
    poses = [measured[j].pose for j in of]
    solved = predict_poses(model, p, rest, poses, [x for ways in starts for x in ways])
    out: list[Prediction | None] = []
    for j, (item, known) in enumerate(zip(measured, predictions, strict=True)):
        ways = [x for k, x in zip(of, solved, strict=True) if k == j and x is not None]
        stable = [x for x in ways if x.equilibrium.stable]
        if not (item.readable and known is not None and stable):
            out.append(None)
            continue
        found = stable[int(np.argmin([_square(x, item) for x in stable]))]
        same = model.node.same(known.equilibrium.x, found.equilibrium.x, NEARBY)
        out.append(None if same or _square(found, item) >= _square(known, item) else found)
    return out


def _along_line(model: CableModel, p: FloatArray, line: MeasuredPose) -> list[FloatArray | None]:
    """Nodes along a measured line; in space between two clamps, one for each way of twist."""
    if not line.has_points:
        return [None]
    pose = line.pose
    if END_ROLL in model.names:
        pose = pose.rolled(float(p[model.names.index(END_ROLL)]))
    told = pose.turns or model.has_state
    ways = ([] if told else ways_round(model, pose)) or [pose]
    places = line.places(model.cable.length, model.loose)
    return [line_nodes(line.points, way, model, places) for way in ways]


def measured_branches(
    model: CableModel,
    p: FloatArray,
    rest: FloatArray,
    measured: Sequence[MeasuredPose],
    predictions: Sequence[Prediction | None],
    fitted: Mapping[str, FloatArray] | None = None,
) -> list[MeasuredBranch | None]:
    """`measured_elsewhere`, with the branch that a pose has to name for that equilibrium."""
    others = measured_elsewhere(model, p, rest, measured, predictions, fitted)
    told = _named_ways(others)
    out: list[MeasuredBranch | None] = []
    last: tuple[HeldPose, FloatArray] | None = None
    for item, known, found, way in zip(measured, predictions, others, told, strict=True):
        branch = None
        if found is not None:
            branch = MeasuredBranch(found, None)
            if way is not None:
                named, side = None if way.turns else way.branch, _tells_no_side(found)
                branch = MeasuredBranch(found, named, way.turns or None, side)
            elif last is not None:
                with suppress(EquilibriumError):
                    eq = continued(model, p, found.rest, item.pose, *last)
                    if model.node.same(eq.x, found.equilibrium.x, NEARBY):
                        branch = MeasuredBranch(found, "previous")
        out.append(branch)
        there = found or known
        last = last if there is None else (item.pose, there.equilibrium.x)
    return out


def _square(prediction: Prediction, item: MeasuredPose) -> float:
    """Mean square distance [m^2] of measured points to a prediction.

    Without points sum of squares of the errors of readings [N^2], moments over the length.
    """
    if not item.has_points:
        length, pairs = prediction.model.cable.length, item.readings_beside(prediction.seen)
        return sum(
            float(((read - seen) ** 2).sum()) / (1.0 if "force" in name else length**2)
            for name, (read, seen) in pairs.items()
        )
    return float((item.distances(prediction.curve) ** 2).mean())


def _named_ways(others: Sequence[Prediction | None]) -> list[HeldPose | None]:
    """Poses with the branch or turns for which these equilibria are predicted, if any."""
    asked = [
        (j, found, way)
        for j, found in enumerate(others)
        if found is not None and not found.pose.turns
        for way in (
            *ways_of(found.model, found.pose),
            *ways_round(found.model, found.pose, WHOLE_TURNS),
        )
    ]
    out: list[HeldPose | None] = [None] * len(others)
    # All at once, except where a state gives each pose its own rest curvature.
    for _, group in groupby(asked, key=lambda one: one[1].model.has_state and one[0]):
        of = list(group)
        known = of[0][1]
        solved = solve_equilibria(known.model, known.p, known.rest, [way for *_, way in of])
        for (j, found, way), eq in zip(of, solved, strict=True):
            if out[j] is None and isinstance(eq, Equilibrium):
                same = found.model.node.same(eq.x, found.equilibrium.x, NEARBY)
                out[j] = way if same else None
    return out


def noise_distance(measured: Sequence[MeasuredPose], std: float) -> float:
    """RMS distance [m] of all measured points from the true curve, by noise of one coordinate.

    For white noise sqrt(d - 1) `std` [m] for a line, which is compared across its tangent, and
    sqrt(d) `std` for markers. Zero without points.
    """
    found = [item.noise_distances for item in measured if item.has_points]
    if not found:
        return 0.0
    return std * float(np.sqrt((np.concatenate(found) ** 2).mean()))


def rms_distance(
    predictions: Sequence[Prediction | None],
    measured: Sequence[MeasuredPose],
    held_out: bool,
) -> float | None:
    """Root mean square distance [m] of all measured points of one role to the predictions.

    None if there are no points of that role, or one of its poses could not be predicted.
    """
    squares = []
    for prediction, item in zip(predictions, measured, strict=True):
        if item.held_out is not held_out or not item.has_points:
            continue
        if prediction is None:
            return None
        squares.append(item.distances(prediction.curve) ** 2)
    return float(np.sqrt(np.concatenate(squares).mean())) if squares else None


def uncertainty_of(fit: Fit) -> Uncertainty:
    """Causes of uncertainty in predictions from a fit.

    The difference between repeats beyond the noise of their points includes that of the fixtures.
    If there are many different poses, what differs at random accounts for it instead.
    """
    names, covariance = fit.named_covariance
    own = fit.model.deviations  # random ones of the problem's poses follow these
    scatter = dict(zip(own, map(float, fit.problem.fixture_std[: len(own)]), strict=True))
    scatter.pop(FREE_LENGTH, None)  # a pose that is asked for tells it
    history, apart = fit.problem.history, 0.0
    if not enough_poses(history, fit.model):
        apart = repeat_std(history, fit.model, fit.noise.of_points.beside_repeats)
    return Uncertainty(names, covariance, scatter, fit.problem.priors.pose_scatter, apart)
