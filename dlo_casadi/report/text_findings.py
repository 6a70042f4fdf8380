"""Errors, verdict, what is left and what it took, in words."""

from __future__ import annotations

import math

import numpy as np

from dlo_casadi.diagnosis.next_pose import NextPose, NextReading
from dlo_casadi.diagnosis.selection import Ranked
from dlo_casadi.diagnosis.structure import LARGEST_SCORE
from dlo_casadi.report.canvas import NOISE_ALONE, compared, label_of, millimetres
from dlo_casadi.report.text_parameters import plus_minus, vector
from dlo_casadi.session.findings import EffectParameter, FoundEffect
from dlo_casadi.session.outcome import Outcome, Stage, StageName
from dlo_casadi.session.pose_shape import BranchShape, EitherSide
from dlo_casadi.thresholds import APART, NOTABLE

# The errors of a stage, of which some poses were measured in another equilibrium.
ON_BRANCH = "on the measured branch"


def predicted_share(outcome: Outcome, stage: Stage) -> str:
    """How many of the held-out poses a stage has predicted, where it is not all of them."""
    held_out = outcome.held_out(stage)
    if not held_out.missing or not stage.shapes:
        return ""
    return f" ({held_out.predicted} of {held_out.declared})"


def branch_text(found: BranchShape) -> str:
    """Error of a pose in the equilibrium in which it was measured, and how to choose that one."""
    return f"{ON_BRANCH} {millimetres(found.rmse)} ({found.chosen_by or 'no branch chooses it'})"


def cross_validated(outcome: Outcome) -> dict[StageName, float | None]:
    """Cross-validated errors [m] of the stages for which the diagnosis has computed them."""
    if not outcome.effects:
        known = outcome.cross_validated
        return {} if known is None else {"batch": known}
    return {
        "batch": outcome.effects[0].rmse_cross_validated_before,
        "closed": outcome.effects[-1].rmse_cross_validated_after,
    }


def stage_rows(outcome: Outcome, nothing: str) -> list[dict[str, str]]:
    """Errors of the stages in words: fit, cross-validated, held out, chi-square.

    A stage of which poses were measured in another equilibrium has a second row.

    Parameters
    ----------
    nothing : str
        What stands where there is no number.
    """

    def row(label: str, note: str, fit: float | None, held_out: float | None) -> dict[str, str]:
        known = {"fit": fit, "held_out": held_out, "validated": None}
        cells = {k: nothing if x is None else millimetres(x) for k, x in known.items()}
        return {"label": label, "mark": "", "note": note, "chi2": nothing, **cells}

    marks = {stage.name: kind for kind, _, stage in compared(outcome)}
    validated = cross_validated(outcome)
    rows = []
    for stage in outcome.stages:
        own = row(label_of(stage, outcome), stage.note, stage.rmse_fit, stage.rmse_held_out)
        own["mark"] = marks.get(stage.name, "")
        own["held_out"] += predicted_share(outcome, stage)
        if (error := validated.get(stage.name)) is not None:
            own["validated"] = millimetres(error)
        if stage.chi2_per_dof is not None:
            own["chi2"] = f"{stage.chi2_per_dof:.3g}"
        rows.append(own)
        if stage.other_branch:
            note = f"poses in another equilibrium: {', '.join(stage.other_branch)}"
            errors = stage.rmse_fit_measured_branch, stage.rmse_held_out_measured_branch
            rows.append(row(ON_BRANCH, note, *errors))
    return rows


def verdict_lines(outcome: Outcome) -> list[str]:
    """What the diagnosis has led to, in sentences."""
    if outcome.doubts:
        head, *others = (f"{text[:1].upper()}{text[1:]}." for text in outcome.doubts)
        word = "the fit has failed" if outcome.fit.failed else "unexplained"
        lines = [f"Verdict: {word}. {head}", *(f"  {text}" for text in others)]
    elif outcome.verdict is not None:
        lines = [_verdict(outcome)]
    else:
        lines = ["Diagnosis: switched off; nothing was looked for in the residual."]
    lines += [_either_side(name, found) for name, found in outcome.either_side.items()]
    lines += structure_lines(outcome)
    for effect in outcome.effects:
        lines += _effect_lines(effect)
    load = outcome.unexplained
    if load is not None:
        force, (low, high) = load.force, load.interval
        lines.append(
            f"  Without naming a cause: pulled by {vector(force, '.3g', 'N')} on average "
            f"at {load.position:.3f} m ({low:.3f} to {high:.3f} m) from the start."
        )
        experiment = outcome.config.experiment
        if experiment.boundary.end == "free" and np.dot(force, experiment.gravity) < 0:
            lines.append(
                "  Nothing lifts a cable with a free tip: a weight elsewhere (lumped_mass) or "
                "another stiffness may stand behind it."
            )
    if outcome.next_pose is not None:
        lines.append(
            f"  To tell {' from '.join(outcome.next_pose.separates)}: hold the end at "
            f"{vector(outcome.next_pose.end, '.3f', 'm')}; {separation_text(outcome.next_pose)}"
        )
        lines.append(f"  {reading_text(outcome.next_pose.reading)}")
    return lines


def _either_side(name: str, found: EitherSide) -> str:
    """A held-out pose on both of its sides, and what chooses each."""
    predicted, other, near = found.predicted, found.other, found.tipping
    text = f"  {name} (held out): "
    if near is not None:
        text += (
            f"its clamp is {near.angle:.2g} rad (known to {near.std:.2g} rad) from the angle at "
            "which both ways to hang are equally low; "
        )
    return text + (
        f"`{predicted.chosen_by or 'turns: 0'}` (predicted) {millimetres(predicted.rmse)} off, "
        f"`{other.chosen_by}` {millimetres(other.rmse)} off."
    )


# Nobody measures a pose more often.
MOST_REPEATS = 20


def separation_text(proposal: NextPose) -> str:
    """How far rivals differ in a proposed pose, and how often it has to be measured."""
    z = proposal.separation
    text = (
        f"they differ there by {millimetres(proposal.difference)} RMS, {z:.2g} "
        "standard deviations of the noise of one whole line: "
    )
    repeats = math.ceil(min((APART / max(z, 1e-9)) ** 2, 1e9))
    if repeats <= 1:
        return text + "one measurement suffices."
    if repeats <= MOST_REPEATS:
        return text + f"measure it {repeats} times."
    return text + f"even {MOST_REPEATS} measurements would not tell them apart."


def reading_text(reading: NextReading) -> str:
    """What a reading of force or moment in the proposed pose would tell of rivals."""
    unit = "N m" if reading.name.endswith("moment") else "N"
    text = (
        f"A reading of {reading.name} there differs by {reading.difference:.2g} {unit}, "
        f"{reading.separation:.2g} standard deviations of one: "
    )
    times = reading.times
    if times is None or times > MOST_REPEATS:
        return text + "it would not tell them apart."
    return text + ("one suffices." if times == 1 else f"read it {times} times.")


# What the residual may depend on, by the key of its normal score.
DEPENDENCES = {
    "runs_z": "runs along the cable",
    "order_z": "the order of the poses",
    "span_z": "the distance of the ends",
    "position_z": "the place in the {plane}",
}


def structure_lines(outcome: Outcome) -> list[str]:
    """What the declared model's residual depends on, where it is not noise."""
    if outcome.structure is None or outcome.verdict == "complete":
        return []
    before, _ = outcome.structure
    plane = "picture" if outcome.measurement.kind == "images" else "plane"
    found = [
        f"{text.format(plane=plane)} ({_score(key, score)})"
        for key, text in DEPENDENCES.items()
        if abs(score := getattr(before, key)) > NOTABLE
    ]
    if not found:
        return []
    return [f"  The declared model's residual depends on {', '.join(found)}."]


def _score(key: str, value: float) -> str:
    """A normal score; where its test ends, only that it lies beyond."""
    if key != "runs_z" and abs(value) >= 0.999 * LARGEST_SCORE:
        return "z > 7" if value > 0 else "z < -7"
    return f"z = {value:+.1f}"


def _verdict(outcome: Outcome) -> str:
    names = " and ".join(effect.name for effect in outcome.effects)
    if outcome.verdict == "unexplained":
        after = outcome.structure[1] if outcome.structure else None
        if names and after and after.p_value >= outcome.config.diagnosis.significance:
            error = outcome.effects[-1].rmse_cross_validated_after
            return (
                f"Verdict: unexplained. With {names} every pose is fitted, but one that is left "
                f"out is predicted {millimetres(error)} off "
                f"({NOISE_ALONE}: {millimetres(outcome.measurement.noise_distance)})."
            )
        found = f" even with {names}" if names else ""
        return f"Verdict: unexplained. The residual is not noise{found}."
    if outcome.effects:
        return f"Verdict: the declared model lacked {names}; with it the residual is noise."
    return "Verdict: complete. The declared model explains the shapes down to their noise."


def _effect_lines(effect: FoundEffect) -> list[str]:
    values = ", ".join(_quantity(name, row) for name, row in effect.parameters.items())
    line = f"  {effect.name}: {values}"
    if effect.p_value is not None:
        # Below the smallest double it is zero.
        line += f" (p = {effect.p_value:.1g})" if effect.p_value > 0 else " (p < 1e-307)"
    lines = [line]
    rivals = effect.indistinguishable_from
    if rivals:
        lines.append(f"    These data cannot tell it from {' or '.join(rivals)}.")
    return lines


def _quantity(name: str, found: EffectParameter) -> str:
    if found.value is None:
        return f"{name} unbounded"
    return f"{name} {plus_minus(found.value, found.std or 0.0)} {found.unit}".strip()


# How candidates are ordered; the score alone does not tell how well a refit does.
CANDIDATE_ORDER = "first those that a refit confirms, by BIC, then other refits, the rest by score"


def finding_of(outcome: Outcome, row: Ranked) -> tuple[str, str]:
    """What a candidate has led to, and the sentence: added, tied, or neither (an empty word)."""
    for effect in outcome.effects:
        if row.name == effect.name:
            return "added", "added to the model"
        if row.name in effect.indistinguishable_from:
            return "tied", f"cannot be told apart from {effect.name}"
    if row.reason:
        return "", row.reason
    if row.rmse_cross_validated is None:
        return "", "not refitted"
    if outcome.verdict == "unexplained":
        return "", "withdrawn: it leaves the residual unexplained"
    return "", "withdrawn: not needed beside what was added later"


def p_value_note(outcome: Outcome) -> str:
    """What the p-values of candidates and of added effects are."""
    note = "p-value: score test in the declared model, corrected for the number of effects tried."
    if outcome.effects and outcome.measurement.std_source == "estimated":
        note += (
            " The p of an added effect is the larger of that before it was added and that under "
            "the noise left once it is in the model."
        )
    return note


def timing_rows(outcome: Outcome) -> list[tuple[str, str, str]]:
    """Part of the run, seconds and remark; the total comes last."""
    timing = outcome.timing
    read, search, total = timing["vision"], timing["diagnosis"], timing["total"]
    photographs = sum((pose.image is not None) + len(pose.views) for pose in outcome.poses)
    rows = [("centre-lines", read, "")]
    if photographs:
        remark = f"{read / photographs:.2f} s a photograph ({photographs})"
        rows = [("photographs to centre-lines", read, remark)]
    # In space neither IPOPT nor the paper's loop runs.
    within = {"Algorithm 1": timing["algorithm1"], "IPOPT": timing["batch"]}
    parts = ", ".join(f"{name} {seconds:.2f} s" for name, seconds in within.items() if seconds)
    rows.append(("fits and predictions", max(total - read - search, 0.0), ""))
    if search:
        rows.append(("diagnosis", search, ""))
    remark = "without imports and writing" + (f"; of it or beside it {parts}" if parts else "")
    rows.append(("total", total, remark))
    return [(name, f"{seconds:.2f}", remark) for name, seconds, remark in rows]
