"""Stages of a fit as results: parameters, predictions and errors of each."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from dlo_casadi.arrays import FloatArray
from dlo_casadi.cable.estimate import Estimate
from dlo_casadi.cable.limits import LimitCheck, Resolved
from dlo_casadi.config import Limits
from dlo_casadi.effects.mass_error import MASS_FACTOR
from dlo_casadi.equilibrium.equilibrium import Equilibrium
from dlo_casadi.equilibrium.pose import HeldPose
from dlo_casadi.equilibrium.sides import on_other_side
from dlo_casadi.equilibrium.spread import Repeats, Uncertainty, sides_of, spread_across
from dlo_casadi.estimation.constrained import EnergyGap, Interval
from dlo_casadi.estimation.prediction import (
    MeasuredBranch,
    Prediction,
    measured_branches,
    predict_other_side,
    predict_poses,
    rms_distance,
    uncertainty_of,
)
from dlo_casadi.estimation.result import Fit
from dlo_casadi.estimation.stiffness import StiffnessFit
from dlo_casadi.model.cable_model import BENDING_STIFFNESS, DAMPING_TIME, END_ROLL, CableModel
from dlo_casadi.model.clips import clip_rows
from dlo_casadi.model.contact import surfaces_at
from dlo_casadi.paper.algorithm1 import Algorithm1Result
from dlo_casadi.rod.ends import reaction_rows
from dlo_casadi.rod.node import Frame
from dlo_casadi.rod.quantities import quantity_of
from dlo_casadi.sensing.measured_pose import MeasuredPose
from dlo_casadi.session.outcome import MASS, ReadingErrors, RestCurvatureEstimate, Stage, StageName
from dlo_casadi.session.pose_shape import BranchShape, EitherSide, PoseShape
from dlo_casadi.thresholds import IDENTIFIABLE, NORMAL_95, UNSEEN

_CURVE_POINTS = 201
_REST_POINTS = 41


def pose_shape(
    prediction: Prediction,
    item: MeasuredPose,
    other: MeasuredBranch | None,
) -> PoseShape:
    """Combine one predicted pose with its measured points."""
    curve, eq = prediction.curve, prediction.equilibrium
    s: FloatArray = np.zeros(0)
    gap: FloatArray = np.zeros((0, curve.d))
    if item.has_line:
        s = item.traced.nearest(curve)
        gap = item.traced.points - curve.at(s)
    return PoseShape(
        curve.at(np.linspace(0.0, curve.length, _CURVE_POINTS)),
        _rmse(prediction, item),
        s,
        gap,
        _across(prediction, s, gap),
        eq.energy,
        eq.stable,
        np.stack([eq.start_force, eq.end_force]),
        None if other is None else _branch_shape(other, item, prediction),
        readings=item.readings_beside(prediction.seen),
        clips=tuple(clip_rows(item.pose.clips, eq.clips)),
        fed=eq.fed,
        contacts=tuple(contact.row for contact in eq.contacts),
    )


def _rmse(prediction: Prediction, item: MeasuredPose) -> float | None:
    """Root mean square distance [m] of a pose's points to a prediction; None without points."""
    if not item.has_points:
        return None
    return float(np.sqrt((item.distances(prediction.curve) ** 2).mean()))


def _branch_shape(found: MeasuredBranch, item: MeasuredPose, known: Prediction) -> BranchShape:
    """The equilibrium in which a pose was measured, beside the predicted one."""
    above = found.prediction.equilibrium.energy - known.equilibrium.energy
    return BranchShape(_rmse(found.prediction, item), found.branch, found.turns, above)


def _across(prediction: Prediction, s: FloatArray, gap: FloatArray) -> FloatArray:
    """Components of gaps (K, d) [m] at s (K,) [m] across the cable, see `PoseShape.residual`."""
    curve, start = prediction.curve, prediction.equilibrium.x[:1]
    if curve.d == 2:
        return np.asarray(np.einsum("knd,kd->kn", curve.normals(s), gap)[:, 0])
    normals = curve.normals(np.concatenate([[0.0], s]))
    y = Frame.to_world(start, np.array([[0.0, 1.0, 0.0]]))[0]
    toward, beside = normals[0] @ y
    turned = np.array([[toward, beside], [-beside, toward]]) / np.hypot(toward, beside)
    return np.asarray(np.einsum("ij,kjd,kd->ki", turned, normals[1:], gap))


@dataclass(frozen=True)
class _Model:
    """A model with its parameters; for a fit also their uncertainty, to give expected errors."""

    model: CableModel
    p: FloatArray
    rest: FloatArray
    fit: Fit | None = None

    @cached_property
    def uncertainty(self) -> Uncertainty | None:
        return uncertainty_of(self.fit) if self.fit else None

    @property
    def nodes(self) -> dict[str, FloatArray]:
        """Nodes of the fitted poses, by name."""
        if self.fit is None:
            return {}
        problem, x = self.fit.problem, self.fit.point.shapes.x
        return {problem.measured[j].pose.name: x[j] for j in problem.used}

    @property
    def noise(self) -> float:
        """Standard deviation [m] of a point about other repeats."""
        return self.fit.noise.of_points.beside_repeats if self.fit else 0.0

    def stage(
        self,
        name: StageName,
        measured: Sequence[MeasuredPose],
        parameters: dict[str, Estimate],
        rest_curvature: RestCurvatureEstimate,
        chi2_per_dof: float | None = None,
        note: str = "",
    ) -> Stage:
        """Predict all poses and compute their errors."""
        poses = [item.pose for item in measured]
        predictions = predict_poses(self.model, self.p, self.rest, poses)
        others = measured_branches(self.model, self.p, self.rest, measured, predictions, self.nodes)
        shapes: dict[str, PoseShape] = {}
        for j, (item, known, other) in enumerate(zip(measured, predictions, others, strict=True)):
            if known is None:
                continue
            side = None
            chosen = other is not None and (other.other_side or not item.has_points)
            if other is not None and chosen and not item.held_out:
                # A fit has used the side on which the cable of each pose hangs, or the equilibrium
                # that its readings show.
                side = _branch_shape(other, item, known)
                known, other = other.prediction, None
                predictions[j], others[j] = known, other
            shape = replace(pose_shape(known, item, other), measured_side=side)
            shapes[item.pose.name] = self._with_uncertainty(item, known, other, shape)
        lost = [item for item in measured if item.pose.name not in shapes]
        if lost:
            names = ", ".join(item.pose.name for item in lost)
            note = (note + f" No equilibrium for {names}.").strip()
        on_branch = [
            prediction if other is None else other.prediction
            for prediction, other in zip(predictions, others, strict=True)
        ]
        return Stage(
            name,
            rms_distance(predictions, measured, held_out=False),
            rms_distance(predictions, measured, held_out=True),
            chi2_per_dof,
            parameters,
            rest_curvature,
            shapes,
            note,
            rms_distance(on_branch, measured, held_out=False),
            rms_distance(on_branch, measured, held_out=True),
            tuple(item.pose.name for item in lost if item.held_out and item.readable),
            _reading_errors(measured, shapes, held_out=False),
            _reading_errors(measured, shapes, held_out=True),
            surfaces=surfaces_at(self.model, self.p),
        )

    def _with_uncertainty(
        self, item: MeasuredPose, known: Prediction, other: MeasuredBranch | None, shape: PoseShape
    ) -> PoseShape:
        """Add to a predicted pose its uncertainty and that of its next repeat."""
        if self.uncertainty is None:
            return shape
        places = np.linspace(0.0, known.curve.length, _CURVE_POINTS)
        repeats = Repeats(known, self.uncertainty)
        curve, moved = repeats.displacements(np.concatenate([places, shape.s]))
        expected: FloatArray = np.zeros(0)
        missed = expected
        if len(shape.s):
            line = item.traced

            def distances(moved: FloatArray) -> FloatArray:
                """Lengths (K,) [m] of displacements (K, d, q) in the sensor's directions."""
                rows = line.components(curve, shape.s, moved)[line.on_points]
                return np.asarray(np.sqrt(np.bincount(line.point_of, (rows**2).sum(axis=1))))

            missed = distances(shape.gap[..., None])
            expected = np.hypot(distances(moved[len(places) :]), self.noise * line.noise_distances)
        return replace(
            shape,
            either_side=self._either_side(item, known, other, repeats),
            undecided=other is not None and _undecided(repeats, other.prediction.equilibrium),
            spread=spread_across(curve, places, moved[: len(places)]).squeeze(),
            expected=expected,
            missed=missed,
            reading_std=self._reading_std(item, repeats),
        )

    def _reading_std(self, item: MeasuredPose, repeats: Repeats) -> dict[str, FloatArray]:
        """Expected standard deviations of the errors of a pose's readings, by name."""
        if not item.reactions or self.fit is None:
            return {}
        noise = self.fit.noise.readings
        rows = reaction_rows(self.model.node, len(item.pose.clips))
        std = repeats.reading_std
        return {
            name: np.hypot(std[rows[name]], noise.of(quantity_of(name))) for name in item.reactions
        }

    def _either_side(
        self,
        item: MeasuredPose,
        known: Prediction,
        measured: MeasuredBranch | None,
        repeats: Repeats,
    ) -> EitherSide | None:
        """A held-out pose on both sides, see `EitherSide`; None where there is only one."""
        if not (item.held_out and item.has_points):
            return None
        if measured is not None and measured.other_side:
            other: Prediction | None = measured.prediction
        else:
            other = predict_other_side(known)
        if other is None:
            return None
        pair = known.equilibrium, other.equilibrium
        if (
            measured is not None
            and not on_other_side(self.model, item.pose, pair[0].x, pair[1].x[None])[0]
        ):
            predicted = BranchShape(_rmse(known, item), None)
            return EitherSide(predicted, _branch_shape(measured, item, known), None)
        ways = sides_of(self.model, item.pose, *pair)
        shapes = [
            BranchShape(
                _rmse(one, item),
                way.branch,
                way.turns or None,
                one.equilibrium.energy - known.equilibrium.energy,
            )
            for one, way in zip((known, other), ways, strict=True)
        ]
        tipping = repeats.tipping(other.equilibrium)
        return EitherSide(shapes[0], shapes[1], tipping if tipping.angle < np.pi else None)


def _undecided(repeats: Repeats, other: Equilibrium) -> bool:
    """Whether parameters, fixtures and scatter leave the equilibrium of a pose undecided."""
    held, uncertain = repeats.held, repeats.uncertainty
    std = np.sqrt(np.maximum(np.diag(uncertain.covariance), 1e-300))
    by_p, by_rest = uncertain.unknowns_in(held.model)
    along, correlation = (by_p * std, by_rest * std), uncertain.covariance / np.outer(std, std)
    gap = EnergyGap.between(held, other, along, correlation)
    return bool(gap.value < UNSEEN * np.hypot(gap.std, repeats.gap_std(other)))


def checked_limits(limits: Limits, fit: Fit, poses: Sequence[HeldPose]) -> tuple[LimitCheck, ...]:
    """Check the limits of all predicted poses, in their order; empty without limits."""
    if not limits.given:
        return ()
    found, known = predict_poses(fit.model, fit.p, fit.rest, poses), uncertainty_of(fit)
    return tuple(
        check
        for one in found
        if one is not None
        for check in Resolved(one, fit.coefficients, limits).checks(known)
    )


def _reading_errors(
    measured: Sequence[MeasuredPose], shapes: Mapping[str, PoseShape], held_out: bool
) -> ReadingErrors:
    """Errors of the readings of one role; none if one of its poses has no prediction."""
    names = [x.pose.name for x in measured if x.held_out is held_out and x.reactions]
    if not shapes.keys() >= set(names):
        return ReadingErrors()
    squares: dict[str, list[float]] = {}
    for name in names:
        for reading, (known, model) in shapes[name].readings.items():
            square = float(((known - model) ** 2).sum())
            squares.setdefault(quantity_of(reading).name, []).append(square)
    return ReadingErrors(**{name: float(np.sqrt(np.mean(x))) for name, x in squares.items()})


def _no_rest(model: CableModel) -> RestCurvatureEstimate:
    s = np.linspace(0.0, model.cable.length, _REST_POINTS)
    none = np.zeros((len(model.node.curvatures), len(s))).squeeze()
    return RestCurvatureEstimate(s, none, none)


def initial_stage(model: CableModel, measured: Sequence[MeasuredPose]) -> Stage:
    """Prior stiffness, straight at rest: the paper's alpha^0."""
    stiffness = {
        model.names[k]: Estimate(float(model.nominal[k]), 0.0, "N m^2")
        for k in model.stiffness_indices
    }
    straight = _Model(model, model.nominal, np.zeros(model.chain.n_rests))
    return straight.stage("initial", measured, stiffness, _no_rest(model))


def stiffness_stage(
    model: CableModel, measured: Sequence[MeasuredPose], found: StiffnessFit
) -> Stage:
    """Stiffness fitted, straight at rest."""
    p = model.nominal.copy()
    p[model.stiffness_indices] *= found.EI / p[0]
    half = NORMAL_95 * found.log_std
    known = bool(2 * half < np.log(IDENTIFIABLE))
    low, high = (float(found.EI * np.exp(x)) if known else None for x in (-half, half))
    spread = found.EI * min(found.log_std, 1e3)
    stiffness = Estimate(found.EI, spread, "N m^2", (low, high), known)
    straight = _Model(model, p, np.zeros(model.chain.n_rests))
    return straight.stage(
        "stiffness_only", measured, {BENDING_STIFFNESS: stiffness}, _no_rest(model)
    )


def algorithm1_stage(
    result: Algorithm1Result | None,
    measured: Sequence[MeasuredPose],
    model: CableModel,
    note: str = "",
) -> Stage:
    """The paper's loop; empty where it does not apply."""
    if result is None:
        return Stage("algorithm1", None, None, None, {}, _no_rest(model), {}, note)
    h = model.cable.length / (len(result.theta_0) + 1)
    s = (np.arange(len(result.theta_0)) + 1) * h
    return _Model(result.model, result.p, result.rest).stage(
        "algorithm1",
        measured,
        {BENDING_STIFFNESS: Estimate(result.EI, 0.0, "N m^2")},
        RestCurvatureEstimate(s, np.asarray(result.theta_0) / h, np.zeros_like(s)),
        note=result.message,
    )


def fit_stage(
    name: StageName,
    fit: Fit,
    measured: Sequence[MeasuredPose],
    intervals: Mapping[str, Interval | None],
    reported: Sequence[str] = (),
) -> Stage:
    """Stage of a fit of the batch problem.

    `intervals`: of the stiffnesses and of the mass's factor, by name; None where none is reported.
    `reported`: qualified names of the parameters that are effects, not nuisances.
    """
    return _Model(fit.model, fit.p, fit.rest, fit).stage(
        name,
        measured,
        fitted_parameters(fit, intervals, reported),
        rest_curvature_of(fit),
        fit.chi2_of_points,
    )


def fitted_parameters(
    fit: Fit, intervals: Mapping[str, Interval | None], reported: Sequence[str] = ()
) -> dict[str, Estimate]:
    """Estimates of a fit's parameters; see `fit_stage`."""
    model = fit.model

    def estimate(name: str, unit: str, size: float = 1.0, **known: Any) -> Estimate:
        value, std, fixed = fit.value(name), fit.std(name), name not in fit.problem.unknowns.names
        bound = _at_bound(fit, name)
        return Estimate(size * value, size * std, unit, at_bound=bound, fixed=fixed, **known)

    parameters: dict[str, Estimate] = {}
    for full, interval in intervals.items():
        key, unit, size = full, "N m^2", 1.0
        if full == MASS_FACTOR:
            key, unit, size = MASS, "kg", model.cable.mass
        known: dict[str, Any] = {}
        if interval:
            ends = (None if x is None else size * x for x in (interval.low, interval.high))
            known = {"interval_95": tuple(ends), "identifiable": interval.identifiable}
        parameters[key] = estimate(full, unit, size, **known)
    roll = [END_ROLL] if END_ROLL in model.names else []
    if DAMPING_TIME in fit.problem.unknowns.names:
        value, spread = fit.value(DAMPING_TIME), NORMAL_95 * fit.std(DAMPING_TIME)
        around = (max(0.0, value - spread), value + spread)
        known = {"interval_95": around, "identifiable": fit.is_determined(DAMPING_TIME)}
        parameters[DAMPING_TIME] = estimate(DAMPING_TIME, "s", **known)
    for name in (*roll, *reported):
        unit = model.parameters[model.names.index(name)].unit
        parameters[name] = estimate(name, unit, identifiable=fit.is_determined(name))
    return parameters


def _at_bound(fit: Fit, name: str) -> bool:
    q, value = fit.model.parameters[fit.model.names.index(name)], fit.value(name)
    return bool(abs(min(value - q.lower, q.upper - value)) < 1e-9 * q.scale)


def rest_curvature_of(fit: Fit) -> RestCurvatureEstimate:
    """Rest curvature along the cable with its standard deviation.

    Without any points, which places the readings determine.
    """
    model, unknowns = fit.model, fit.problem.unknowns
    s = np.linspace(0.0, model.cable.length, _REST_POINTS)
    if unknowns.n_rest == 0:
        return _no_rest(model)
    axes = len(model.node.curvatures)
    basis = np.kron(np.eye(axes), model.rest.basis(s))
    tail = slice(unknowns.n_parameters, unknowns.size)
    scaled = basis * model.cable.curvature_scale
    variance = np.einsum("ik,kl,il->i", scaled, fit.marginal_covariance[tail, tail], scaled)
    std = np.sqrt(np.maximum(variance, 0))
    value = basis @ fit.coefficients
    values, stds = np.reshape([value, std], (2, axes, len(s))).squeeze()
    if any(item.has_points for item in fit.problem.fit_poses):
        return RestCurvatureEstimate(s, values, stds)
    own = np.linalg.pinv(fit.problem.precision[tail, tail], hermitian=True)
    before = np.einsum("ik,kl,il->i", scaled, own, scaled) * fit.inflation**2
    determined = np.reshape(2 * variance < before, (axes, len(s))).squeeze()
    return RestCurvatureEstimate(s, values, stds, determined)
