"""What a user should be warned of."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from dlo_casadi.config import SkippedPose
from dlo_casadi.diagnosis.repeatability import alike, limiting_spread
from dlo_casadi.estimation.result import Fit
from dlo_casadi.session.fitting import allowed_mesh_error
from dlo_casadi.session.outcome import PoseInput, Stage
from dlo_casadi.thresholds import EITHER, FIXTURES, MESH_SHARE


def reading_warnings(inputs: Sequence[PoseInput], skipped: Sequence[SkippedPose]) -> list[str]:
    """What the camera step noticed, pose by pose, and which poses were not read at all.

    Parameters
    ----------
    skipped : sequence of SkippedPose
        What the configuration leaves out; poses that are among the inputs say so themselves.
    """
    shown = {item.name for item in inputs}
    lines = [
        f"{pose.name} is left out: {pose.reason}" for pose in skipped if pose.name not in shown
    ]
    for item in inputs:
        if item.problem:
            lines.append(f"{item.name} is left out: {item.problem}")
        lines += [f"{item.name}: {text}" for text in item.messages]
    missing = held_out_missing(inputs, skipped)
    if missing:
        declared = len({item.name for item in inputs if item.role == "held_out"} | set(missing))
        lines.append(
            f"held out and in no error, because there is no measured line: {', '.join(missing)}, "
            f"{len(missing)} of {declared} held-out poses"
        )
    return lines


def held_out_missing(
    inputs: Sequence[PoseInput], skipped: Sequence[SkippedPose]
) -> tuple[str, ...]:
    """Names of held-out poses that have no measured line to be compared with."""
    read = {item.name for item in inputs if item.readable}
    roles = {item.name: item.role for item in skipped} | {item.name: item.role for item in inputs}
    return tuple(name for name, role in roles.items() if role == "held_out" and name not in read)


def branch_warnings(stages: Sequence[Stage]) -> list[str]:
    """Poses predicted in another stable equilibrium than the measured one, or that may be."""
    lines = []
    for stage in stages:
        if stage.name not in ("batch", "closed"):
            continue
        for branch in dict.fromkeys(shape.branch for shape in stage.other_branch.values()):
            found = {k: shape for k, shape in stage.other_branch.items() if shape.branch == branch}
            predicted = max(stage.shapes[name].rmse or 0.0 for name in found)
            measured = max(shape.rmse for shape in found.values())
            cure = (
                "no `branch` of these poses would choose it"
                if branch is None
                else f"`branch: {branch}` in these poses chooses it"
            )
            lines.append(
                f"stage {stage.name}: {', '.join(found)}: the equilibrium of lowest energy, which "
                f"is predicted, is not the one that was measured: up to {1e3 * predicted:.3g} mm "
                f"off, on the measured branch {1e3 * measured:.3g} mm; {cure}"
            )
    for stage in stages[-1:]:
        either = [
            name
            for name, shape in stage.shapes.items()
            if shape.tipping is not None and shape.tipping < EITHER
        ]
        if either:
            nearest = min(stage.shapes[name].tipping or 0.0 for name in either)
            lines.append(
                f"stage {stage.name}: {', '.join(either)}: the cable may fall to either side. Both "
                "are stable, and the one of lower energy is predicted; with the clamp turned by "
                f"{nearest:.2g} rad it would be the other. `branch: ccw`, `cw` or `previous` (as "
                "in the pose before it) says which"
            )
    return lines


def fit_warnings(fit: Fit, error: float) -> list[str]:
    """What a fit cannot promise; `error` is that of its mesh [m]."""
    lines = []
    spread = limiting_spread(fit)
    if spread is not None:
        lines.append(
            f"the same pose repeats only within {1e3 * spread:.2g} mm (each from the mean of the "
            f"others), {_beside(fit)}: repeatability limits any prediction"
        )
    rest = fit.problem.rest_scatter
    if rest.std > 0:
        lines.append(
            "the cable does not come back to the same shape: two hangings of a pose differ by "
            f"{1e3 * np.sqrt(2) * fit.hanging_error:.2g} mm RMS, as if each had a rest curvature "
            f"of its own of {rest.std:.2g} 1/m; the noise is {1e3 * fit.noise.std:.2g} mm. A "
            "model predicts their mean"
        )
    if spread is not None or rest.std > 0:
        lines += [
            f"cannot be told apart in this session: {', '.join(group)}" for group in alike(fit)
        ]
    if len(fit.problem.used) > 1 and fit.fixture_error > FIXTURES * fit.noise.std:
        apart = float(np.hypot(fit.fixture_error, fit.noise.std))
        lines.append(
            f"the fixtures are not quite where they are declared, {_scatter(fit)} in each pose: a "
            f"pose that is not fitted is measured {1e3 * apart:.2g} mm from its prediction, "
            f"however good the model (the noise is {1e3 * fit.noise.std:.2g} mm); ends measured "
            "pose by pose would help"
        )
    if not fit.converged:
        lines.append("the batch fit stopped before it had converged")
    unstable = [
        item.pose.name
        for item, ok in zip(fit.problem.measured, fit.stable, strict=True)
        if item.readable and not ok
    ]
    if unstable:
        lines.append(f"not a stable equilibrium at the fitted parameters: {', '.join(unstable)}")
    if not np.isfinite(error):
        lines.append(
            f"the fitted shapes cannot be followed to a mesh finer than {fit.model.n} elements: "
            "some pose is close to losing its stability"
        )
    elif error > allowed_mesh_error(fit):
        lines.append(
            f"the mesh of {fit.model.n} elements is off by {1e3 * error:.3g} mm, more than "
            f"{MESH_SHARE:.0%} of the noise: model.n larger?"
        )
    return lines


def _beside(fit: Fit) -> str:
    """What the noise is to the repeats of a pose."""
    std, length = 1e3 * fit.noise.std, 1e3 * fit.noise.length
    if fit.noise.source == "repeats":
        return f"which counts as noise of {std:.2g} mm, correlated over {length:.2g} mm of cable"
    return f"the noise is {std:.2g} mm, and intervals from this session are too narrow"


def _scatter(fit: Fit) -> str:
    """How far the poses' fixtures are from their declared places, one standard deviation."""
    scatter = dict(zip(fit.model.deviation_names, fit.problem.scatter, strict=True))
    # All components of a position, or of a turn, share one scatter.
    place, turn = fit.model.node.axes[0], fit.model.node.turns[0]
    parts = {
        f"end_{place}": f"{1e3 * scatter[f'end_{place}']:.2g} mm at the end",
        f"start_{turn}": f"{scatter[f'start_{turn}']:.2g} rad at the start clamp",
        f"end_{turn}": f"{scatter[f'end_{turn}']:.2g} rad at the end clamp",
    }
    return ", ".join(parts[axis] for axis in fit.model.deviations if axis in parts)
