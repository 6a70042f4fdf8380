"""The report in words: numbers, names of stages, warnings, and what became of candidates."""

from typing import NamedTuple

from dlo_casadi.diagnosis.found import Ranked
from dlo_casadi.errors import counted
from dlo_casadi.session.outcome import (
    MeasurementSummary,
    Outcome,
    PoseInput,
    ReadingErrors,
    Stage,
    StageName,
)
from dlo_casadi.show.text import millimetres

# Name of the RMS distance caused by the noise of points alone, in tables and charts.
NOISE_ALONE = "noise alone"
# Name of a stage's errors when some poses were measured in another equilibrium.
ON_BRANCH = "on the measured branch"
# Order of candidates; the score alone does not show how good a refit is.
CANDIDATE_ORDER = "first those that were refitted, by log likelihood, the rest by score"


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
    return stage.label


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
            lines.append(f"{stage.label}: {stage.note or 'some poses could not be predicted'}")
    for key, estimate in outcome.stages[-1].parameters.items():
        if estimate.at_bound:
            value = f"{estimate.value:.4g} {estimate.unit}".strip()
            lines.append(f"{key} sits on a bound of what physics permits: {value}")
    return lines


def _measured_by(outcome: Outcome, role: str) -> tuple[bool, bool]:
    """Whether poses of a role were measured by points, and by readings alone."""
    found = [pose for pose in outcome.poses if pose.role == role and pose.readable]
    return any(not pose.unseen for pose in found), any(pose.unseen for pose in found)


def sentence(text: str) -> str:
    """A text that begins with a capital letter."""
    return text[:1].upper() + text[1:]


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
