"""Doubts and warnings about poses and stages; those about a fit are in `fit_remarks`."""

from collections.abc import Iterator, Mapping, Sequence

import numpy as np

from dlo_casadi.arrays import FloatArray
from dlo_casadi.config import SkippedPose
from dlo_casadi.equilibrium.pose import SIGNS
from dlo_casadi.errors import worded
from dlo_casadi.estimation.fit import EXPLAINED
from dlo_casadi.estimation.result import Fit
from dlo_casadi.session.found_effects import FoundEffect
from dlo_casadi.session.outcome import SIMPLER, PoseInput, Stage
from dlo_casadi.session.outliers import LEAST_POINTS, Outliers
from dlo_casadi.session.pose_shape import BranchShape, PoseShape
from dlo_casadi.thresholds import BEYOND_CHANCE, UNSEEN

CUT_OFF = (
    "the diagnosis has met the bound on its work before everything was tried, as where several "
    "things are missing that hide each other: the verdict is about what was found until then. Try: "
    "declare what is known of the setup under model.effects or experiment.tolerances; "
    "diagnosis.exclude for effects that cannot be"
)
TAKEN_AS_STRAIGHT = (
    "the cable is taken as straight at rest: it may roll about its axis, and straight it explains "
    "these measurements down to their noise. The intervals leave out what a slight rest curvature "
    "would change. Try: an end that is clamped, if the rest shape matters"
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
            worded(
                "held out and in no error, because there is no measured line: {missing}, {count} "
                "of {declared:# held-out pose}",
                missing=missing,
                count=len(missing),
                declared=declared,
            )
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
        said = worded(
            "{stage}: {names}: measured in another equilibrium than predicted, {energy}: the "
            "predicted one is up to {predicted:mm} off, the measured one {measured:mm}; {cure}",
            stage=stage.label,
            names=[*group],
            energy=_energy(group),
            predicted=max(stage.shapes[name].rmse or 0.0 for name in group),
            measured=max(shape.rmse or 0.0 for shape in group.values()),
            cure=_cure(group),
        )
        if undecided := [name for name in group if stage.shapes[name].undecided]:
            said += worded(
                ". Fit, fixtures and scatter from pose to pose leave open which of the two is "
                "lower in {names}",
                names=undecided,
            )
        lines.append(said)
    return lines + [
        f"{stage.label}: {', '.join(group)}: the cable is in another equilibrium than "
        f"predicted, {_energy(group)}; fit poses are compared where they are, and "
        f"{_needed(group)}"
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


def _needed(group: Mapping[str, BranchShape]) -> str:
    chosen_by = next(iter(group.values())).chosen_by
    if chosen_by is None:
        return "no value of `branch` or `turns` predicts them there"
    return f"a prediction of the same ends needs `{chosen_by}`"


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
        worded(
            '"{near.label}" comes nearer to the fit poses than "{last.label}": '
            "{near.rmse_fit:mm.4g} instead of {last.rmse_fit:mm.4g} RMS",
            near=stage,
            last=last,
        )
        for stage in stages
        if stage.name in SIMPLER and stage.rmse_fit is not None and stage.rmse_fit < least
    ]


def as_likely(names: Sequence[str]) -> list[str]:
    """That effects explain what was measured as well as the complete model does."""
    if not names:
        return []
    return [
        f"{' and '.join(names)} would explain what was measured as well as waves of the rest "
        "curvature, or differences from pose to pose, do alone: the data do not tell them apart. "
        "Try: markers at more places, lines, more poses"
    ]


def not_in_motion(still: Sequence[FoundEffect], now: Sequence[FoundEffect]) -> list[str]:
    """Effects that still poses have shown and that the motions have replaced by others."""
    names = ", ".join(x.name for x in now)
    kept = {x.label for x in now}
    return [
        f"{x.name} would explain the still poses alone; the motions need {names} instead"
        for x in still
        if x.label not in kept
    ]


def motion_doubts(stage: Stage) -> tuple[str, ...]:
    """Why the last stage does not explain the recorded motions; empty if it does."""
    motion = stage.motion
    if motion is None or motion.chi2_per_dof <= EXPLAINED:
        return ()
    said = worded(
        "recorded motions are met to {fit:mm}, {times:.2g} times what their noise leaves: the "
        "model lacks something in motion. Try: the times of fixtures and points, begins: moving",
        fit=motion.rmse_fit,
        times=float(np.sqrt(motion.chi2_per_dof)),
    )
    return (said,)


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
            f"the fit ({stage.label}) has not converged: its numbers are where it stopped, "
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
        text = worded(
            "{said} are predicted {off:mm} off, {known:mm} are what noise, fixtures, parameters "
            "and the cable's scatter let expect: {bad}, at worst {worst:mm} instead of "
            "{expected:mm}",
            said=said,
            off=off,
            known=known,
            bad=bad,
            worst=worst,
            expected=expected,
        )
        elsewhere = {k: stage.other_branch[k] for k in bad if k in stage.other_branch}
        for name, other in elsewhere.items():
            text += worded(
                ". The predicted equilibrium in {name} is another one than the measured one, to "
                "which the model comes within {off:mm} and {energy}; {cure}",
                name=name,
                off=other.rmse,
                energy=_energy({name: other}),
                cure=_cure({name: other}),
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
    said = (
        "no pose is predicted from its ends: in all {count} the predicted equilibrium is another "
        'one than the measured one, {off:mm} RMS off, and "{nearest.label}" comes nearer, '
        "{other:mm}. Try: are start and end of the poses exchanged, or headings off by a turn?"
    )
    return [worded(said, count=len(shown), off=off, nearest=nearest, other=other)]


def far_off(stage: Stage, poses: Sequence[PoseInput], told: Sequence[str] = ()) -> list[str]:
    """Fit poses far more off their prediction than the others, which rule an RMS over all.

    Not those that a text of `told` names.
    """
    if stage.name not in ("batch", "closed"):
        return []
    rmse = {name: x.rmse for name, x in stage.shapes.items() if x.rmse is not None}
    usual = float(np.median([*rmse.values()])) if len(rmse) > 2 else np.inf
    fitted = [pose.name for pose in poses if pose.role == "fit"]
    bad = [name for name in fitted if rmse.get(name, 0.0) > BEYOND_CHANCE * usual]
    bad = [name for name in bad if not any(name in text for text in told)]
    if not bad:
        return []
    said = (
        "predicted far more off their points than the other poses ({usual:mm.2g}, median): {each}; "
        "the error of the fit is mostly theirs. Try: look at their points and ends, at what the "
        "cable touched there, at `branch` or `turns`; or leave them out and fit again"
    )
    each = [worded("{name} {off:mm}", name=name, off=rmse[name]) for name in bad]
    return [worded(said, usual=usual, each=each)]


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
        return np.stack([np.full_like(expected, (there.rmse or 0.0) ** 2), expected])
    return np.stack([shape.missed**2, expected])


def left_out(outliers: Outliers) -> list[str]:
    """Points that `estimation.robust` has left out."""
    if not outliers.lines:
        return [
            f"estimation.robust: no line has the {LEAST_POINTS} points that it takes to tell "
            "outliers from an effect: all points are kept. Try: more points on each line"
        ]
    return [f"estimation.robust leaves out {outliers}"] if outliers.names else []
