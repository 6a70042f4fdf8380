"""The verdict and the findings beside it: tables of sentences."""

from collections.abc import Callable, Iterator
from typing import NamedTuple

import numpy as np

from dlo_casadi.cable.estimate import from_to
from dlo_casadi.diagnosis.if_hidden import wider
from dlo_casadi.diagnosis.next_measurement import MOST_REPEATS, NextPose, NextReading
from dlo_casadi.diagnosis.next_motion import NextMotion, Swing
from dlo_casadi.diagnosis.structure import LARGEST_SCORE
from dlo_casadi.errors import worded
from dlo_casadi.report.words import NOISE_ALONE, seen, sentence
from dlo_casadi.rod.quantities import quantity_of
from dlo_casadi.session.outcome import Outcome
from dlo_casadi.session.sentences import Sentence, Values, said_of
from dlo_casadi.show.text import millimetres, vector
from dlo_casadi.thresholds import NOTABLE, UNSEEN

# What the residual may depend on, by the name of its normal score.
DEPENDENCES = {
    "order_z": "the order of the poses",
    "span_z": "the distance of the ends",
    "position_z": "the place in {where}",
}


class Conclusion(NamedTuple):
    """The verdict in a word and a sentence."""

    word: str
    sentence: str


def verdict_lines(outcome: Outcome) -> list[str]:
    """Verdict and all findings of the diagnosis, in sentences."""
    verdict = f"Verdict: {'. '.join(conclusion_of(outcome))}"
    return [verdict, *(f"  {text}" for text in details(outcome))]


def details(outcome: Outcome) -> list[str]:
    """Findings beside the verdict."""
    return [*said_of(outcome, FINDINGS)]


def conclusion_of(outcome: Outcome) -> Conclusion:
    """Result of the diagnosis: the first of `CONCLUSIONS` that applies."""
    added = outcome.effects[-1:]
    word, says = next((word, says) for word, says, applies in CONCLUSIONS if applies(outcome))
    said = worded(
        says,
        doubt=sentence("".join(outcome.doubts[:1])),
        names=" and ".join(map(str, outcome.effects)),
        error=added[0].rmse_cross_validated_after if added else None,
        floor=outcome.measurement.noise_distance,
        seen=seen(outcome),
    )
    return Conclusion(word, said)


def _unexplained(outcome: Outcome) -> bool:
    return outcome.verdict == "unexplained"


def _fitted_alone(outcome: Outcome) -> bool:
    """Whether the residual is noise with added effects, but left-out poses are not predicted."""
    after = outcome.structure[1] if outcome.structure else None
    noise = after is not None and after.p_value >= outcome.config.diagnosis.significance
    return _unexplained(outcome) and bool(outcome.effects) and noise


# Word, sentence, and where both apply.
CONCLUSIONS: tuple[tuple[str, str, Callable[[Outcome], object]], ...] = (
    ("unexplained", "{doubt}.", lambda x: x.doubts),
    ("not diagnosed", "Nothing was looked for in the residual.", lambda x: x.verdict is None),
    (
        "unexplained",
        "With {names} every pose is fitted, but one that is left out is predicted {error:mm} off "
        f"({NOISE_ALONE}: {{floor:mm}}).",
        _fitted_alone,
    ),
    (
        "unexplained",
        "The residual is not noise even with {names}.",
        lambda x: _unexplained(x) and x.effects,
    ),
    ("unexplained", "The residual is not noise.", _unexplained),
    (
        "effect found",
        "The declared model lacked {names}; with it the residual is noise.",
        lambda x: x.effects,
    ),
    ("complete", "The declared model explains the {seen} down to their noise.", lambda x: True),
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
            yield {"line": f"These data cannot tell it from {rivals}."}
        for name, (still, moving) in effect.told_apart.items():
            if name not in effect.indistinguishable_from:
                said = f"{still:.1f} without the motions, {moving:.0f} with them"
                yield {"line": f"It is told from {name}: log evidence {said}."}


def _hidden(outcome: Outcome) -> Iterator[Values]:
    """What one effect that the data do not exclude could do to each stiffness."""
    last = outcome.stages[-1].parameters
    for name, found in outcome.if_hidden.items():
        interval, known = last[name].interval_95_if_hidden, last[name].interval_95
        if interval is None or known is None or not wider(interval, known):
            continue
        tip, telling = found.telling, ""
        if tip is not None:
            telling = " " + reading_text(tip.reading, f"in {tip.pose}")
        if tip is not None and tip.heading is not None and tip.difference is not None:
            expected = outcome.fit.expected_error
            far = tip.difference > UNSEEN * expected
            other = "So would another pose" if far else "No other pose would tell"
            telling += worded(_TURNED, other=other, tip=tip, expected=expected)
        if found.motion is not None and (swings := told_by(found.motion)):
            telling += f" A motion would tell: {let_go_text(found.motion)}; {swings}."
        sizes = (f"{key} {x.value:.2g} {x.unit}".strip() for key, x in found.values.items())
        yield {
            "found": found,
            "sizes": ", ".join(sizes),
            "range": from_to(interval),
            "telling": telling,
        }


def _pulled(outcome: Outcome) -> Iterator[Values]:
    if (load := outcome.unexplained) is not None:
        yield {"load": load, "force": vector(load.force, ".3g", "N")}


def _lifted_tip(outcome: Outcome) -> Iterator[Values]:
    load, experiment = outcome.unexplained, outcome.config.experiment
    if load is not None and not experiment.boundary.end.place:
        yield from [{}] * bool(np.dot(load.force, experiment.gravity) < 0)


def _proposed(outcome: Outcome) -> Iterator[Values]:
    if (proposal := outcome.next_pose) is not None:
        yield {
            "rivals": " from ".join(proposal.separates),
            "end": vector(proposal.end, ".3f", "m"),
            "separation": separation_text(proposal),
            "reading": reading_text(proposal.reading),
        }


def _let_go(outcome: Outcome) -> Iterator[Values]:
    if (motion := outcome.next_motion) is not None and (swings := told_by(motion)):
        yield {"of": motion.of, "go": let_go_text(motion), "swings": swings}


_TIPPING = (
    "its clamp is {near.angle:.2g} rad (known to {near.std:.2g} rad) from the angle at which both "
    "ways to hang are equally low; "
)
_TURNED = (
    " {other}: with start_heading {tip.heading:.2f} the shapes differ by {tip.difference:mm} RMS, "
    "and a pose is measured {expected:mm} from its prediction."
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
        "A hidden {found.effect} would not show: with {sizes} {found.parameter} may be {range} "
        "N m^2.{telling}",
        _hidden,
    ),
    Sentence(
        "Without naming a cause: as if pulled by {force} on average at {load.position:.3f} m "
        "({load.interval[0]:.3f} to {load.interval[1]:.3f} m) from the start.",
        _pulled,
    ),
    Sentence(
        "Nothing lifts a cable with a free tip: a weight elsewhere (lumped_mass) or another "
        "stiffness may stand behind it.",
        _lifted_tip,
    ),
    Sentence("To tell {rivals}: hold the end at {end}; {separation}", _proposed),
    Sentence("{reading}", _proposed),
    Sentence("To tell {of} by a motion: {go}; {swings}.", _let_go),
)


def separation_text(proposal: NextPose) -> str:
    """Difference of rivals in a proposed pose, and how often it has to be measured."""
    apart = (
        f"they differ there by {millimetres(proposal.difference)} RMS, {proposal.separation:.2g} "
        "standard deviations of one measured line, its fixtures and what both fits leave open"
    )
    if proposal.times is None:
        return f"even {MOST_REPEATS} measurements would not tell them apart: {apart}."
    times = (
        "one measurement suffices" if proposal.times == 1 else f"measure it {proposal.times} times"
    )
    return f"{apart}: {times}."


def let_go_text(motion: NextMotion) -> str:
    """How a proposed motion is made."""
    return (
        f"hold the ends as in {motion.pose}, pull the cable aside by {motion.aside:.2g} m at "
        f"{motion.at:.3g} m from the start, and let it swing"
    )


def told_by(motion: NextMotion) -> str:
    """What a proposed motion tells apart: rivals by NOTABLE standard deviations or more."""

    def hertz(one: NextMotion | Swing) -> str:
        return ", ".join(f"{x:.3g}" for x in one.frequencies)

    told = [
        f"{name} by {one.separation:.2g} standard deviations ({hertz(one)} Hz)"
        for name, one in motion.rivals.items()
        if one.separation >= NOTABLE
    ]
    if not told:
        return ""
    own = f"it swings at {hertz(motion)} Hz and differs in {motion.duration:g} s from "
    return own + " and from ".join(told)


def reading_text(reading: NextReading, where: str = "there") -> str:
    """How a reading of force or moment in a pose would separate rivals."""
    unit, times = quantity_of(reading.name).unit, reading.times
    text = (
        f"A reading of {reading.name} {where} differs by {reading.difference:.2g} {unit}, "
        f"{reading.separation:.2g} standard deviations of one reading: "
    )
    if times is None or times > MOST_REPEATS:
        return text + "it would not tell them apart."
    return text + ("one suffices." if times == 1 else f"read it {times} times.")
