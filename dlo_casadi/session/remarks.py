"""Warnings to the user."""

from collections.abc import Iterator, Mapping, Sequence

import numpy as np

from dlo_casadi.arrays import FloatArray
from dlo_casadi.config import SkippedPose
from dlo_casadi.diagnosis.selection import HiddenWeight
from dlo_casadi.diagnosis.structure import alike, limiting_spread
from dlo_casadi.equilibrium.pose import SIGNS
from dlo_casadi.errors import counted
from dlo_casadi.estimation.fit import allowed_mesh_error
from dlo_casadi.estimation.prediction import noise_distance
from dlo_casadi.estimation.result import Fit
from dlo_casadi.model.pose_scatter import PoseScatter
from dlo_casadi.session.outcome import SIMPLER, PoseInput, Stage
from dlo_casadi.session.outliers import LEAST_POINTS, Outliers, outliers_of
from dlo_casadi.session.pose_shape import BranchShape, PoseShape
from dlo_casadi.thresholds import BEYOND_TOLERANCE, DIFFERENT, FAR_OFF, FIXTURES, UNSEEN

CUT_OFF = (
    "the diagnosis has met the bound on its work before everything was tried, as where several "
    "things are missing that hide each other: the verdict is about what was found until then. Try: "
    "declare what is known of the setup under model.effects or experiment.tolerances; "
    "diagnosis.exclude for effects that cannot be"
)


def reading_warnings(inputs: Sequence[PoseInput], skipped: Sequence[SkippedPose]) -> list[str]:
    """Remarks of the camera step pose by pose, and poses that were not read at all.

    `skipped`: poses that the configuration leaves out; poses among the inputs have their own text.
    """
    shown = {item.name for item in inputs}
    lines = [
        f"{pose.name} is left out: {pose.reason}" for pose in skipped if pose.name not in shown
    ]
    lines += [f"{item.name} is left out: {item.problem}" for item in inputs if item.problem]
    lines += _noticed(inputs)
    missing = held_out_missing(inputs, skipped)
    if missing:
        declared = len({item.name for item in inputs if item.role == "held_out"} | set(missing))
        lines.append(
            f"held out and in no error, because there is no measured line: {', '.join(missing)}, "
            f"{len(missing)} of {counted(declared, 'held-out pose')}"
        )
    return lines


def _noticed(inputs: Sequence[PoseInput]) -> list[str]:
    """Messages of poses and photographs; equal ones once, with all names."""
    names: dict[str, list[str]] = {}
    for item in inputs:
        views = {view.name for view in item.views}
        for message in item.messages:
            name, _, text = message.partition(": ")
            name, text = (name, text) if name in views else (item.name, message)
            names.setdefault(text, []).append(name)
    return [f"{', '.join(own)}: {text}" for text, own in names.items()]


def held_out_missing(
    inputs: Sequence[PoseInput], skipped: Sequence[SkippedPose]
) -> tuple[str, ...]:
    """Names of held-out poses that have no measured line to be compared with."""
    read = {item.name for item in inputs if item.readable}
    roles = {item.name: item.role for item in skipped} | {item.name: item.role for item in inputs}
    return tuple(name for name, role in roles.items() if role == "held_out" and name not in read)


def branch_warnings(stages: Sequence[Stage]) -> list[str]:
    """Poses measured in another stable equilibrium than the predicted one.

    Only the last stage counts: earlier models lacked something. The verdict reports held-out poses
    on the other side.
    """
    stage = stages[-1]
    if stage.name not in ("batch", "closed"):
        return []
    others = {
        name: shape
        for name, shape in stage.other_branch.items()
        if not (side := stage.shapes[name].either_side) or side.other.chosen_by != shape.chosen_by
    }
    lines = []
    for group in _by_choice(others):
        predicted = max(stage.shapes[name].rmse or 0.0 for name in group)
        measured = max(shape.rmse for shape in group.values())
        lines.append(
            f"stage {stage.name}: {', '.join(group)}: measured in another equilibrium than "
            f"predicted, {_energy(group)}: the predicted one is up to {1e3 * predicted:.3g} mm "
            f"off, the measured one {1e3 * measured:.3g} mm; {_cure(group)}"
        )
        if undecided := [name for name in group if stage.shapes[name].undecided]:
            lines[-1] += (
                ". Fit, fixtures and scatter from pose to pose leave open which of the two is "
                f"lower in {', '.join(undecided)}"
            )
    return lines + [
        f"stage {stage.name}: {', '.join(group)}: the cable hangs on another side than "
        f"predicted, {_energy(group)}; fit poses are compared where they hang, and a "
        f"prediction of the same ends needs `{next(iter(group.values())).chosen_by}`"
        for group in _by_choice(stage.measured_side)
    ]


def _by_choice(found: Mapping[str, BranchShape]) -> list[dict[str, BranchShape]]:
    """Groups of poses that one choice would put on the measured branch, all higher or all lower."""
    groups: dict[tuple[str | None, bool], dict[str, BranchShape]] = {}
    for name, shape in found.items():
        groups.setdefault((shape.chosen_by, shape.above < 0), {})[name] = shape
    return list(groups.values())


def _energy(group: Mapping[str, BranchShape]) -> str:
    """By how much the energy of measured equilibria is higher or lower than of the predicted."""
    most = max((shape.above for shape in group.values()), key=abs)
    which = f"{'up to ' if len(group) > 1 else ''}{abs(most):.2g} J"
    return f"with an energy {which} {'lower' if most < 0 else 'higher'}"


def _cure(group: Mapping[str, BranchShape]) -> str:
    chosen_by = next(iter(group.values())).chosen_by
    if chosen_by is None:
        return "no value of `branch` or `turns` chooses it: measure the pose again, or leave it out"
    return f"`{chosen_by}` chooses it"


def weight_warning(weight: HiddenWeight, expected: float) -> str:
    """Consequence of an undeclared weight, and the measurement that would reveal it.

    `expected` [m]: distance of a pose from its prediction if the model is complete.
    """
    low, high = weight.stiffness_95
    text = (
        f"an undeclared weight is not told from stiffness: up to {weight.mass:.2g} kg at "
        f"{weight.position:.2f} m would fit as well as none, and bending_stiffness may then be "
        f"{low:.3g} to {high:.3g} N m^2. To tell: weigh the cable with all that hangs on it, or "
        f"measure the force on the start, which differs by up to {weight.force:.2g} N"
    )
    if weight.heading is None or weight.difference is None:
        return text
    far = weight.difference > UNSEEN * expected
    return text + (
        f"{', or add a pose: with' if far else '. No pose would tell: even with'} start_heading "
        f"{weight.heading:.2f} the shapes differ by {1e3 * weight.difference:.2g} mm RMS, "
        f"and a pose is measured {1e3 * expected:.2g} mm from its prediction"
    )


def worse_than_simpler(stages: Sequence[Stage]) -> list[str]:
    """Simpler stages that come nearer to the fit poses than the last one, a fit.

    Only by more than chance: the RMS of K points has a relative uncertainty of 1/sqrt(2 K).
    """
    last = stages[-1]
    if last.rmse_fit is None:
        return []
    count = sum(len(shape.s) for shape in last.shapes.values())
    least = last.rmse_fit / (1 + 1 / np.sqrt(2 * max(count, 1)))
    return [
        f"stage {stage.name} comes nearer to the fit poses than stage {last.name}: "
        f"{1e3 * stage.rmse_fit:.4g} mm instead of {1e3 * last.rmse_fit:.4g} mm RMS"
        for stage in stages
        if stage.name in SIMPLER and stage.rmse_fit is not None and stage.rmse_fit < least
    ]


def doubts_of(stages: Sequence[Stage], poses: Sequence[PoseInput], fit: Fit) -> tuple[str, ...]:
    """Reasons why the last stage's numbers are unreliable even if its residual looks like noise.

    Either its fit has not converged, or poses are predicted from their ends alone with more than
    UNSEEN times the error expected from noise, fixtures, parameters and the cable's scatter.
    Held-out poses on the other side (see `EitherSide`), and poses whose equilibrium only a history
    can name, are compared where they were measured; but if all poses were measured in another
    equilibrium and a simpler model comes nearer, nothing is predicted. A pose does not count if
    uncertain parameters, fixtures or scatter leave its lowest equilibrium undecided.
    """
    lines, stage = [], stages[-1]
    if fit.failed:
        lines.append(
            f"the fit of stage {stage.name} has not converged: its numbers are where it stopped, "
            "not a minimum. Try: a bending_stiffness nearer to the truth, more poses, or "
            "rest_shape: straight"
        )
    for role, said in (("fit", "fit poses"), ("held_out", "held-out poses")):
        errors = {
            pose.name: _errors(stage.shapes[pose.name])
            for pose in poses
            if pose.role == role and pose.name in _judged(stage) and len(pose.points)
        }
        if not errors:
            continue
        off, known = np.sqrt(np.mean(np.concatenate(list(errors.values()), axis=1), axis=1))
        if off <= UNSEEN * known:
            continue
        rms = {name: np.sqrt(both.mean(axis=1)) for name, both in errors.items()}
        bad = sorted((k for k in rms if rms[k][0] > UNSEEN * rms[k][1]), key=lambda k: -rms[k][0])
        worst, expected = rms[bad[0]]
        text = (
            f"{said} are predicted {1e3 * off:.3g} mm off, {1e3 * known:.3g} mm are what noise, "
            "fixtures, parameters and the cable's scatter let expect: "
            f"{', '.join(bad)}, at worst {1e3 * worst:.3g} mm instead of {1e3 * expected:.3g} mm"
        )
        elsewhere = {k: stage.other_branch[k] for k in bad if k in stage.other_branch}
        for name, other in elsewhere.items():
            text += (
                f". The predicted equilibrium in {name} is another one than the measured one, "
                f"to which the model comes within {1e3 * other.rmse:.3g} mm and "
                f"{_energy({name: other})}; {_cure({name: other})}"
            )
        lines.append(text)
    lines += _misread(stage, poses)
    return (*lines, *_nothing_predicted(stages))


def _misread(stage: Stage, poses: Sequence[PoseInput]) -> Iterator[str]:
    """Report poses with readings alone whose readings are farther off than all that is expected."""
    for role, said in (("fit", "fit poses"), ("held_out", "held-out poses")):
        off = {
            pose.name: stage.shapes[pose.name].misread
            for pose in poses
            if pose.role == role and pose.unseen and pose.name in stage.shapes
        }
        if not off or np.sqrt(np.mean(np.square([*off.values()]))) <= UNSEEN:
            continue
        worst = sorted((name for name in off if off[name] > UNSEEN), key=lambda name: -off[name])
        named = ", ".join(f"{name} {off[name]:.2g} times" for name in worst)
        yield (
            f"the readings of {said} are predicted farther off than noise, fixtures and parameters "
            f"let expect: {named}"
        )


def _nothing_predicted(stages: Sequence[Stage]) -> list[str]:
    """Report that all poses are in another equilibrium and that a simpler stage comes nearer."""
    stage = stages[-1]
    shown = {name for name, shape in stage.shapes.items() if shape.rmse is not None}
    simpler = [x for x in stages if x.name in SIMPLER and x.rmse_fit is not None]
    nearest = min(simpler, key=lambda x: x.rmse_fit or 0.0, default=None)
    if len(shown) < 2 or not shown <= _judged(stage) & set(stage.other_branch) or nearest is None:
        return []
    off, other = stage.rmse_fit or 0.0, nearest.rmse_fit or 0.0
    if off <= other:
        return []
    return [
        f"no pose is predicted from its ends: in all {len(shown)} the predicted equilibrium "
        f"is another one than the measured one, {1e3 * off:.3g} mm RMS off, and stage "
        f"{nearest.name} comes nearer, {1e3 * other:.3g} mm. Try: are start and end of the poses "
        "exchanged, or headings off by a turn?"
    ]


def far_off(stage: Stage, poses: Sequence[PoseInput], told: Sequence[str] = ()) -> list[str]:
    """Fit poses far more off their prediction than the others, which rule an RMS over all.

    Not those that a text of `told` names.
    """
    if stage.name not in ("batch", "closed"):
        return []
    rmse = {name: x.rmse for name, x in stage.shapes.items() if x.rmse is not None}
    usual = float(np.median([*rmse.values()])) if len(rmse) > 2 else np.inf
    fitted = [pose.name for pose in poses if pose.role == "fit"]
    bad = [name for name in fitted if rmse.get(name, 0.0) > FAR_OFF * usual]
    bad = [name for name in bad if not any(name in text for text in told)]
    if not bad:
        return []
    each = ", ".join(f"{name} {1e3 * rmse[name]:.3g} mm" for name in bad)
    return [
        f"predicted far more off their points than the other poses ({1e3 * usual:.2g} mm, median): "
        f"{each}; the error of the fit is mostly theirs. Try: look at their points and ends, at "
        "what the cable touched there, at `branch` or `turns`; or leave them out and fit again"
    ]


def _judged(stage: Stage) -> set[str]:
    """Poses whose errors count against the model: those whose equilibrium is decided."""
    known = (name for name, shape in stage.shapes.items() if shape.expected is not None)
    return {name for name in known if not stage.shapes[name].undecided}


def _errors(shape: PoseShape) -> FloatArray:
    """Squared distances (2, K) [m^2] of a pose from its prediction: measured, expected."""
    assert shape.expected is not None
    assert shape.missed is not None
    expected, there = shape.expected**2, shape.measured_branch
    if there is not None and (there.branch not in SIGNS or shape.either_side is not None):
        return np.stack([np.full_like(expected, there.rmse**2), expected])
    return np.stack([shape.missed**2, expected])


def left_out(outliers: Outliers) -> list[str]:
    """Points that `estimation.robust` has left out."""
    if not outliers.lines:
        return [
            f"estimation.robust: no line has the {LEAST_POINTS} points that it takes to tell "
            "outliers from an effect: all points are kept. Try: more points on each line"
        ]
    return [f"estimation.robust leaves out {outliers}"] if outliers.names else []


def fit_warnings(
    fit: Fit, error: float, declared: float | None = None, poses: Sequence[PoseInput] = ()
) -> list[str]:
    """Limits of what a fit can promise.

    `error` [m]: of its mesh. `declared` [m]: noise of the points. `poses`: as they were measured,
    those in which outliers are sought.
    """
    lines = []
    points, floor = fit.noise.of_points, noise_distance(fit.problem.history, fit.noise.std)
    if declared is not None and points.source == "estimated":
        cure = f"Try: std: {points.std:.2g}, or no std"
        if poses and (outliers := outliers_of(fit, poses)).names:
            cure = f"There are {outliers}. Try: estimation: {{robust: true}}"
        lines.append(
            f"the points scatter more about any shape that a cable could take than measurement.std "
            f"declares, {1e3 * declared:.2g} mm: their noise is estimated instead, "
            f"{1e3 * points.std:.2g} mm. {cure}"
        )
    spread = limiting_spread(fit)
    if spread is not None:
        lines.append(
            f"the same pose repeats only within {1e3 * spread:.2g} mm (each from the mean of the "
            f"others), {_beside(fit, floor)}: repeatability limits any prediction"
        )
    if fit.noise.source == "misfit":
        read = any(item.reactions for item in fit.problem.measured)
        lines.append(
            f"the model misses the points{' or readings' * read} by far more than their noise: the "
            f"fit weighs the points as if that were {1e3 * fit.noise.std:.2g} mm"
        )
    rest = fit.problem.priors.pose_scatter
    if rest.std > 0 and rest.shown:
        lines.append(
            "the cable does not come back to the same shape: two repeats of a pose would differ by "
            f"{1e3 * np.sqrt(2) * fit.repeat_error:.2g} mm RMS beyond the noise "
            f"({1e3 * np.sqrt(2) * floor:.2g} mm), as if each had {_own(rest, fit)}. "
            "A model predicts their mean"
        )
    elif rest.std > 0:
        lines.append(
            "poses have too few points to tell whether the cable comes back to the same shape: "
            f"intervals and bands include {_own(rest, fit)}"
        )
    if spread is not None or rest.std > 0:
        lines += [
            f"cannot be told apart in this session: {', '.join(group)}" for group in alike(fit)
        ]
    # Where ends differ at random beyond the tolerances, the line above has told by how much.
    random = fit.problem.random_std[fit.problem.fixture_std > 0].any()
    if len(fit.problem.used) > 1 and fit.fixture_error > FIXTURES * floor and not random:
        apart = float(np.hypot(fit.fixture_error, floor))
        lines.append(
            f"fixtures may vary from pose to pose by about {_scatter(fit)}, as far as tolerances "
            f"and data tell: a new pose is then measured {1e3 * apart:.2g} mm from its prediction, "
            f"however good the model ({1e3 * floor:.2g} mm by noise alone). Try: measure the ends "
            "in each pose, or smaller tolerances if they are known better"
        )
    lines += _beyond_tolerances(fit)
    if not fit.converged and not fit.failed:
        lines.append("the fit is slow: it stopped within a standard deviation of its minimum")
    unstable = [
        item.pose.name
        for item, ok in zip(fit.problem.measured, fit.stable, strict=True)
        if item.readable and not ok
    ]
    if unstable:
        lines.append(f"not a stable equilibrium at the fitted parameters: {', '.join(unstable)}")
    if not np.isfinite(error):
        lines.append(
            f"the fitted shapes cannot be followed to a mesh finer than "
            f"{counted(fit.model.n, 'element')}: some pose is close to losing its stability"
        )
    elif error > allowed_mesh_error(fit):
        lines.append(
            f"the mesh of {counted(fit.model.n, 'element')} is off by {1e3 * error:.3g} mm, "
            f"more than the {1e3 * allowed_mesh_error(fit):.2g} mm that noise or misfit hide: "
            "model.n larger?"
        )
    return lines


def _beyond_tolerances(fit: Fit) -> Iterator[str]:
    """Declared values that the fit has moved by many of their tolerances."""
    hidden = tuple(f"{effect.label}." for effect in fit.model.effects if not effect.shown)
    for q in fit.model.parameters:
        tolerance = fit.model.priors.get(q.name)
        of_sensor = q.unit in ("N", "N m")  # its bias tells of wrong readings
        if tolerance is None or (q.name.startswith(hidden) and not of_sensor):
            continue
        moved = fit.value(q.name) - q.nominal
        if abs(moved) > BEYOND_TOLERANCE * tolerance:
            unit = f" {q.unit}".rstrip()
            yield (
                f"{q.name} is {moved:.3g}{unit} from its declared value, "
                f"{abs(moved) / tolerance:.0f} times its tolerance of {tolerance:g}{unit}: other "
                "parameters may be wrong, too. Try: measure it again, or declare a larger tolerance"
            )


def _own(scatter: PoseScatter, fit: Fit) -> str:
    """What differs from pose to pose, with its size, and what cannot be distinguished from it."""
    each = []
    for one in (scatter, *scatter.rivals):
        std, unit = one.size(fit.model, float(fit.p[0]))
        each.append(f"{one.words} of {std:.2g} {unit}")
    return " or ".join(each)


def _beside(fit: Fit, floor: float) -> str:
    """Compare the noise, which alone gives a distance `floor` [m], with the repeats of a pose."""
    std, length = 1e3 * fit.noise.std, 1e3 * fit.noise.length
    if fit.noise.source == "repeats":
        return (
            f"which counts as noise of {std:.2g} mm, correlated over {length:.2g} mm of cable, in "
            f"place of measurement.std. It would not with {DIFFERENT} poses or more that differ, "
            "or with a declared rest_curvature_drift if the cable takes a set"
        )
    return f"noise alone gives {1e3 * floor:.2g} mm, and intervals from this session are too narrow"


def _scatter(fit: Fit) -> str:
    """Standard deviation of the fixtures' places about the declared ones."""
    scatter = dict(zip(fit.model.deviation_names, fit.problem.priors.scatter, strict=True))
    # All components of a position, or of a rotation, share one scatter.
    place, turn = fit.model.node.axes[0], fit.model.node.turns[0]
    parts = {
        f"end_{place}": f"{1e3 * scatter[f'end_{place}']:.2g} mm at the end",
        f"start_{turn}": f"{scatter[f'start_{turn}']:.2g} rad at the start clamp",
        f"end_{turn}": f"{scatter[f'end_{turn}']:.2g} rad at the end clamp",
    }
    if fit.model.clips:
        parts[f"clip_0_{place}"] = f"{1e3 * scatter[f'clip_0_{place}']:.2g} mm at the clips"
    return ", ".join(parts[axis] for axis in fit.model.deviations if axis in parts)
