"""Which way a cable in a plane hangs: its shapes beside those under gravity turned or mirrored."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from dlo_casadi.config import Config
from dlo_casadi.estimation.prediction import Prediction, predict_poses
from dlo_casadi.model.cable_model import BENDING_STIFFNESS, CableModel
from dlo_casadi.sensing.measured_pose import MeasuredPose
from dlo_casadi.session.coarse import MESH, coarse_fit, posed, some, tells_weight
from dlo_casadi.session.declared import declared_model, straight
from dlo_casadi.session.outcome import PoseInput
from dlo_casadi.session.plausibility import Suspicion
from dlo_casadi.thresholds import BIC_APART, CONTRADICTS, MUCH_BETTER

# Poses whose shapes are predicted, and of a fit.
_PREDICTED, _FITTED = 8, 16
# Of the length: no other explanation is looked for once one comes so near.
_CLEAR = 0.02
# Over the declared one.
_STIFFNESSES = sorted(10.0 ** np.arange(-2.0, 2.1, 0.5), key=lambda factor: abs(np.log(factor)))


def hangs_elsewhere(config: Config, read: Sequence[PoseInput]) -> tuple[Suspicion, ...]:
    """Whether the shapes fit only with gravity turned, or the points mirrored.

    Shapes of a straight cable of the declared stiffness, and of others up to a hundred times as
    soft or stiff, are predicted with gravity as declared and turned by quarters, and laid beside
    the points; and beside the points mirrored at the height of the start. Clamps may give a stiff
    cable its shape whichever way gravity points: a fit then tells, see `upside_down`.
    """
    shown = some(read, _PREDICTED)
    if not (shown and any(config.experiment.gravity)):
        return ()
    measured = posed(config, shown)
    model = straight(declared_model(config).model).with_mesh(MESH)
    x, y = model.gravity
    length = config.cable.length
    own, hanging = np.inf, {}
    for factor in _STIFFNESSES:
        hanging[factor] = _predicted(model, factor, measured)
        own = min(own, _distance(hanging[factor], measured))
        if own < CONTRADICTS * length:
            reversed_ = replace(model, gravity=(-x, -y))
            stiff = _predicted(reversed_, max(_STIFFNESSES), measured)
            either = _distance(stiff, measured) < CONTRADICTS * length
            return upside_down(config, read) if either else ()
    if not np.isfinite(own):
        return ()  # nothing can be predicted of these poses
    mirrored = posed(config, [_mirrored(config, item) for item in shown])
    turned = {
        f"gravity ({way[0] + 0.0:g}, {way[1] + 0.0:g}) m/s^2": replace(model, gravity=way)
        for way in ((-x, -y), (y, -x), (-y, x))
    }
    what, rms = "", np.inf
    for factor in _STIFFNESSES:
        distances = {
            "y pointing up in the points, which now points down": _distance(
                hanging[factor], mirrored
            )
        }
        for said, other in turned.items():
            distances[said] = _distance(_predicted(other, factor, measured), measured)
        said = min(distances, key=lambda name: distances[name])
        if distances[said] < rms:
            what, rms = said, distances[said]
        if rms < _CLEAR * length:
            break
    if rms > MUCH_BETTER * own:
        return ()
    return (
        Suspicion(
            f"the cable does not hang along gravity ({x:g}, {y:g}) m/s^2: its shapes are "
            f"{own:.3g} m RMS from those of any stiffness, but {rms:.3g} m with {what}. Try: "
            "points, start, end and gravity in one frame, x to the right and y up, gravity: "
            "[0.0, -9.81].",
            True,
        ),
    )


def upside_down(config: Config, read: Sequence[PoseInput]) -> tuple[Suspicion, ...]:
    """Whether a fit tells a weight only with gravity turned round, and comes nearer with it.

    Under gravity against the weight the best fit is a cable too stiff to show any.
    """
    shown = some(read, _FITTED)
    x, y = config.experiment.gravity
    own = coarse_fit(config, shown, (x, y))
    if own is None or tells_weight(own):
        return ()
    other = coarse_fit(config, shown, (-x, -y))
    if other is None or not tells_weight(other):
        return ()
    if 2 * (other.log_evidence - own.log_evidence) < BIC_APART:
        return ()
    return (
        Suspicion(
            f"with gravity ({x:g}, {y:g}) m/s^2 the shapes show no weight, as if bending_stiffness "
            f"were {own.value(BENDING_STIFFNESS):.2g} N m^2 or more; with gravity ({-x + 0.0:g}, "
            f"{-y + 0.0:g}) m/s^2 they do, and tell {other.value(BENDING_STIFFNESS):.2g} N m^2. "
            "Try: gravity in the frame of points, start and end, with its sign: [0.0, -9.81] with "
            "y up. A strap that lifts the cable would look the same.",
            False,
        ),
    )


def _mirrored(config: Config, item: PoseInput) -> PoseInput:
    """A pose with its points mirrored at the height of its start."""
    start = next(pose.start for pose in config.experiment.poses if pose.name == item.name)
    return replace(item, points=item.points * [1.0, -1.0] + [0.0, 2 * start[1]])


def _predicted(
    model: CableModel, factor: float, measured: Sequence[MeasuredPose]
) -> list[Prediction | None]:
    """Shapes of a cable without rest curvature, so many times as stiff as declared."""
    p = model.nominal.copy()
    p[0] *= factor
    return predict_poses(model, p, np.zeros(model.chain.n_rests), [x.pose for x in measured])


def _distance(predictions: Sequence[Prediction | None], measured: Sequence[MeasuredPose]) -> float:
    """RMS distance [m] of the points from shapes; infinite without one."""
    gaps = [
        np.inf if prediction is None else item.distances(prediction.curve)
        for prediction, item in zip(predictions, measured, strict=True)
    ]
    return float(np.sqrt(np.mean(np.concatenate([np.atleast_1d(gap) for gap in gaps]) ** 2)))
