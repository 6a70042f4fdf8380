"""The report in words: numbers, names of stages, and all sentences."""

from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import numpy as np

from dlo_casadi.diagnosis.next_measurement import MOST_REPEATS, NextPose, NextReading
from dlo_casadi.diagnosis.selection import Ranked
from dlo_casadi.diagnosis.structure import LARGEST_SCORE
from dlo_casadi.errors import counted, worded
from dlo_casadi.rod.quantities import quantity_of
from dlo_casadi.session.outcome import (
    MeasurementSummary,
    Outcome,
    PoseInput,
    ReadingErrors,
    Stage,
    StageName,
)
from dlo_casadi.session.sentences import Sentence, Values, said_of
from dlo_casadi.show.text import millimetres, vector
from dlo_casadi.thresholds import NOTABLE

# Name of the RMS distance caused by the noise of points alone, in tables and charts.
NOISE_ALONE = "noise alone"
# Name of a stage's errors when some poses were measured in another equilibrium.
ON_BRANCH = "on the measured branch"
# Order of candidates; the score alone does not show how good a refit is.
CANDIDATE_ORDER = "first those that were refitted, by log likelihood, the rest by score"
STAGE_LABELS: dict[StageName, str] = {
    "initial": "initial guess",
    "stiffness_only": "stiffness alone",
    "algorithm1": "Algorithm 1",
    "batch": "declared model, fitted",
    "closed": "with added effects",
}
Found = Callable[[Outcome], Iterator[Values]]
# What the residual may depend on, by the name of its normal score.
DEPENDENCES = {
    "order_z": "the order of the poses",
    "span_z": "the distance of the ends",
    "position_z": "the place in {where}",
}


# ---- numbers -----------------------------------------------------------------------------------


def score_text(score: float) -> str:
    """A candidate's score with two significant digits, or as an integer; 0 below 0.01."""
    return f"{score:,.0f}" if score >= 100 or score < 0.01 else f"{score:.2g}"


def seen(outcome: Outcome) -> str:
    """What was measured: shapes, or readings alone."""
    return "shapes" if outcome.measurement.points else "readings"


def photographs_alone(outcome: Outcome) -> bool:
    """Whether poses are shown by the photographs that were measured: in a plane."""
    photographed = outcome.config.experiment.measurement.kind == "images"
    return photographed and not any(pose.views for pose in outcome.poses)


def counted_data(measurement: MeasurementSummary) -> str:
    """Number of points; without any, of readings."""
    if measurement.points:
        return counted(measurement.points, "point")
    return counted(measurement.readings, "reading")


def missing(pose: PoseInput) -> str:
    """Why a pose has no predicted shape to compare with."""
    return "no equilibrium" if pose.readable else "not read"


# ---- stages ------------------------------------------------------------------------------------


class ComparedStage(NamedTuple):
    """A stage in a comparison: "before" or "after", and its label."""

    kind: str
    label: str
    stage: Stage


def compared(outcome: Outcome) -> list[ComparedStage]:
    """The last stage with predictions as "after", and the one that it improves on as "before".

    If effects were added: the fitted declared model, and the model with the effects. Otherwise: the
    initial guess, and the fitted declared model.
    """
    with_shapes = [stage for stage in outcome.stages if stage.shapes]
    if not with_shapes:
        return []
    after = with_shapes[-1]
    name: StageName = "batch" if after.name == "closed" else "initial"
    before = [stage for stage in with_shapes[:-1] if stage.name == name]
    shown = [("before", stage) for stage in before[:1]] + [("after", after)]
    return [ComparedStage(kind, label_of(stage, outcome), stage) for kind, stage in shown]


def label_of(stage: Stage, outcome: Outcome) -> str:
    """Label of a stage."""
    if stage.name == "closed" and outcome.effects:
        return "with " + " and ".join(map(str, outcome.effects))
    return STAGE_LABELS[stage.name]


def directions(outcome: Outcome) -> tuple[str, ...]:
    """Names of the directions across a cable; in a plane the only one needs no name."""
    return ("y", "z") if outcome.config.experiment.in_space else ("",)


def cross_validated(outcome: Outcome) -> dict[StageName, float | None]:
    """Cross-validated errors [m] of the stages for which the diagnosis has computed them."""
    if not outcome.effects:
        known = outcome.cross_validated
        return {} if known is None else {"batch": known}
    return {
        "batch": outcome.effects[0].rmse_cross_validated_before,
        "closed": outcome.effects[-1].rmse_cross_validated_after,
    }


def predicted_share(outcome: Outcome, stage: Stage) -> str:
    """Number of held-out poses that a stage has predicted, if that is not all of them."""
    held_out = outcome.held_out(stage)
    if not held_out.missing or not stage.shapes:
        return ""
    return f" ({held_out.predicted} of {held_out.declared})"


def mesh_text(outcome: Outcome) -> str:
    """Number of elements of the model, and the error due to this mesh."""
    model, error = outcome.fit.model, millimetres(outcome.mesh_error)
    return f"{counted(model.n, model.element)}, mesh error {error}"


def all_warnings(outcome: Outcome) -> list[str]:
    """Warnings of the run, reasons for missing numbers of stages, and parameters on a bound.

    Algorithm 1 is a baseline: where it does not apply, its row says so and no warning is given.
    """
    lines = list(outcome.warnings)
    for stage in outcome.stages:
        if stage.name == "algorithm1" and not stage.shapes:
            continue
        of_fit = stage.rmse_fit, stage.readings_fit
        of_held_out = stage.rmse_held_out, stage.readings_held_out
        missing = [
            (points and rmse is None) or (alone and readings == ReadingErrors())
            for (points, alone), (rmse, readings) in (
                (_measured_by(outcome, "fit"), of_fit),
                (_measured_by(outcome, "held_out"), of_held_out),
            )
        ]
        if any(missing):
            lines.append(f"stage {stage.name}: {stage.note or 'some poses could not be predicted'}")
    for key, estimate in outcome.stages[-1].parameters.items():
        if estimate.at_bound:
            value = f"{estimate.value:.4g} {estimate.unit}".strip()
            lines.append(f"{key} sits on a bound of what physics permits: {value}")
    return lines


def _measured_by(outcome: Outcome, role: str) -> tuple[bool, bool]:
    """Whether poses of a role were measured by points, and by readings alone."""
    found = [pose for pose in outcome.poses if pose.role == role and pose.readable]
    return any(not pose.unseen for pose in found), any(pose.unseen for pose in found)


# ---- findings ----------------------------------------------------------------------------------


class Conclusion(NamedTuple):
    """The verdict in a word and a sentence."""

    word: str
    sentence: str


def sentence(text: str) -> str:
    """A text that begins with a capital letter."""
    return text[:1].upper() + text[1:]


def verdict_lines(outcome: Outcome) -> list[str]:
    """Verdict and all findings of the diagnosis, in sentences."""
    return [f"Verdict: {'. '.join(conclusion_of(outcome))}", *details(outcome)]


def details(outcome: Outcome) -> list[str]:
    """Findings beside the verdict."""
    return [f"  {text}" for text in said_of(outcome, FINDINGS)]


def conclusion_of(outcome: Outcome) -> Conclusion:
    """Result of the diagnosis: the first of `CONCLUSIONS` that applies."""
    for word, row in CONCLUSIONS:
        for text in said_of(outcome, [row]):
            return Conclusion(word, text)
    raise AssertionError("the last conclusion always applies")


def _once(applies: Callable[[Outcome], object], **values: Callable[[Outcome], Any]) -> Found:
    """Values of a sentence that is said once, where it applies."""

    def found(outcome: Outcome) -> Iterator[Values]:
        if applies(outcome):
            yield {name: value(outcome) for name, value in values.items()}

    return found


def _doubt(outcome: Outcome) -> str:
    return sentence(outcome.doubts[0])


def _names(outcome: Outcome) -> str:
    return " and ".join(map(str, outcome.effects))


def _unexplained(outcome: Outcome) -> bool:
    return outcome.verdict == "unexplained"


def _fitted_alone(outcome: Outcome) -> bool:
    """Whether the residual is noise with added effects, but left-out poses are not predicted."""
    after = outcome.structure[1] if outcome.structure else None
    least = outcome.config.diagnosis.significance
    noise = after is not None and after.p_value >= least
    return _unexplained(outcome) and bool(outcome.effects) and noise


CONCLUSIONS: tuple[tuple[str, Sentence[Outcome]], ...] = (
    ("fit failed", Sentence("{doubt}.", _once(lambda x: x.doubts and x.fit.failed, doubt=_doubt))),
    ("unexplained", Sentence("{doubt}.", _once(lambda x: x.doubts, doubt=_doubt))),
    (
        "not diagnosed",
        Sentence("Nothing was looked for in the residual.", _once(lambda x: x.verdict is None)),
    ),
    (
        "unexplained",
        Sentence(
            "With {names} every pose is fitted, but one that is left out is predicted {error:mm} "
            f"off ({NOISE_ALONE}: {{floor:mm}}).",
            _once(
                _fitted_alone,
                names=_names,
                error=lambda x: x.effects[-1].rmse_cross_validated_after,
                floor=lambda x: x.measurement.noise_distance,
            ),
        ),
    ),
    (
        "unexplained",
        Sentence(
            "The residual is not noise even with {names}.",
            _once(lambda x: _unexplained(x) and x.effects, names=_names),
        ),
    ),
    ("unexplained", Sentence("The residual is not noise.", _once(_unexplained))),
    (
        "effect found",
        Sentence(
            "The declared model lacked {names}; with it the residual is noise.",
            _once(lambda x: x.effects, names=_names),
        ),
    ),
    (
        "complete",
        Sentence(
            "The declared model explains the {seen} down to their noise.",
            _once(lambda x: True, seen=seen),
        ),
    ),
)


def _other_doubts(outcome: Outcome) -> Iterator[Values]:
    yield from ({"doubt": sentence(text)} for text in outcome.doubts[1:])


def _either_side(outcome: Outcome) -> Iterator[Values]:
    for name, found in outcome.either_side.items():
        near = found.tipping
        tipping = "" if near is None else worded(_TIPPING, near=near)
        chosen = found.predicted.chosen_by or "turns: 0"
        yield vars(found) | {"name": name, "tipping": tipping, "chosen": chosen}


def _dependences(outcome: Outcome) -> Iterator[Values]:
    """Evidence that the declared model's residual is not noise."""
    if outcome.structure is None or outcome.verdict == "complete":
        return
    before, _ = outcome.structure
    where = "space" if outcome.config.experiment.in_space else "the plane"
    if outcome.measurement.kind == "images":
        where = "the picture"
    found = []
    for key, text in DEPENDENCES.items():
        z = getattr(before, key)
        score = f"z = {z:+.1f}"
        if abs(z) >= 0.999 * LARGEST_SCORE:  # beyond the resolution of its test
            score = "z > 7" if z > 0 else "z < -7"
        if abs(z) > NOTABLE:
            found.append(f"{text.format(where=where)} ({score})")
    said = [f"depends on {', '.join(found)}"] if found else []
    if abs(before.runs_z) > NOTABLE:
        often, z = "less" if before.runs_z < 0 else "more", before.runs_z
        said.insert(0, f"changes its sign along the cable {often} often than noise (z = {z:+.1f})")
    if said:
        yield {"what": ", and ".join(said)}


def _added(outcome: Outcome) -> Iterator[Values]:
    for effect in outcome.effects:
        values, chance = [f"{name} {found}" for name, found in effect.parameters.items()], ""
        if effect.p_value is not None:
            # It underflows: below the smallest double.
            chance = f" (p = {effect.p_value:.1g})" if effect.p_value > 0 else " (p < 1e-307)"
        yield {
            "line": worded(
                "{effect}: {values}{chance}", effect=effect, values=values, chance=chance
            )
        }
        if rivals := " or ".join(effect.indistinguishable_from):
            yield {"line": f"  These data cannot tell it from {rivals}."}


def _pulled(outcome: Outcome) -> Iterator[Values]:
    if (load := outcome.unexplained) is not None:
        yield {"load": load, "force": vector(load.force, ".3g", "N")}


def _lifted_tip(outcome: Outcome) -> bool:
    load, experiment = outcome.unexplained, outcome.config.experiment
    free = not experiment.boundary.end.place
    return load is not None and free and bool(np.dot(load.force, experiment.gravity) < 0)


def _proposed(outcome: Outcome) -> Iterator[Values]:
    if (proposal := outcome.next_pose) is not None:
        yield {
            "rivals": " from ".join(proposal.separates),
            "end": vector(proposal.end, ".3f", "m"),
            "separation": separation_text(proposal),
            "reading": reading_text(proposal.reading),
        }


_TIPPING = (
    "its clamp is {near.angle:.2g} rad (known to {near.std:.2g} rad) from the angle at which both "
    "ways to hang are equally low; "
)
RESIDUAL = Sentence("The declared model's residual {what}.", _dependences)
FINDINGS: tuple[Sentence[Outcome], ...] = (
    Sentence("{doubt}.", _other_doubts),
    Sentence(
        "{name} (held out): {tipping}`{chosen}` (predicted) {predicted.rmse:mm} off, "
        "`{other.chosen_by}` {other.rmse:mm} off.",
        _either_side,
    ),
    RESIDUAL,
    Sentence("{line}", _added),
    Sentence(
        "Without naming a cause: as if pulled by {force} on average at {load.position:.3f} m "
        "({load.interval[0]:.3f} to {load.interval[1]:.3f} m) from the start.",
        _pulled,
    ),
    Sentence(
        "Nothing lifts a cable with a free tip: a weight elsewhere (lumped_mass) or another "
        "stiffness may stand behind it.",
        _once(_lifted_tip),
    ),
    Sentence("To tell {rivals}: hold the end at {end}; {separation}", _proposed),
    Sentence("{reading}", _proposed),
)


def separation_text(proposal: NextPose) -> str:
    """Difference of rivals in a proposed pose, and how often it has to be measured."""
    text = (
        f"they differ there by {millimetres(proposal.difference)} RMS, {proposal.separation:.2g} "
        "standard deviations of one measured line, its fixtures and what both fits leave open: "
    )
    if proposal.times is None:
        return text + f"even {MOST_REPEATS} measurements would not tell them apart."
    return text + (
        "one measurement suffices."
        if proposal.times == 1
        else f"measure it {proposal.times} times."
    )


def reading_text(reading: NextReading) -> str:
    """How a reading of force or moment in the proposed pose would separate rivals."""
    unit, times = quantity_of(reading.name).unit, reading.times
    text = (
        f"A reading of {reading.name} there differs by {reading.difference:.2g} {unit}, "
        f"{reading.separation:.2g} standard deviations of one: "
    )
    if times is None or times > MOST_REPEATS:
        return text + "it would not tell them apart."
    return text + ("one suffices." if times == 1 else f"read it {times} times.")


def finding_of(outcome: Outcome, row: Ranked) -> tuple[str, str]:
    """Status of a candidate, "added", "tied" or empty, and a sentence on it."""
    if own := [str(effect) for effect in outcome.effects if effect.name == row.name]:
        return "added", "added to the model" + (own != [row.name]) * f": {' and '.join(own)}"
    for effect in outcome.effects:
        if row.name in effect.indistinguishable_from:
            return "tied", f"cannot be told apart from {effect}"
    if row.reason:
        return "", row.reason
    if row.rmse_cross_validated is None:
        return "", "not refitted" if outcome.measurement.points else "not needed"
    if outcome.verdict == "unexplained":
        return "", "withdrawn: it leaves the residual unexplained"
    return "", "withdrawn: not needed beside what was added later"


def p_value_note(outcome: Outcome) -> str:
    """Explain the p-values of candidates and of added effects."""
    note = "p-value: score test in the declared model, corrected for the number of effects tried."
    if outcome.effects and outcome.measurement.std_source == "estimated":
        note += (
            " The p of an added effect is the larger of that before it was added and that under "
            "the noise left once it is in the model."
        )
    return note
