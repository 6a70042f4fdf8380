"""What a report says of recorded motions."""

from collections.abc import Sequence
from typing import Any

from markupsafe import Markup
from rich.table import Table

from dlo_casadi.errors import worded
from dlo_casadi.report.moving_picture import moving_picture
from dlo_casadi.report.terminal import plain_table
from dlo_casadi.session.checked_motions import CheckedMotion
from dlo_casadi.session.in_motion import MotionStage
from dlo_casadi.session.measured_modes import MeasuredModes
from dlo_casadi.session.outcome import Outcome
from dlo_casadi.show.swinging import swinging_modes
from dlo_casadi.show.text import millimetres, plus_minus

_SAID = "Fitted motions are met to {fit:mm}{held_out}; noise alone leaves {noise:mm}."
_BEFORE = " Without {names} it was {fit:mm}."


def stages_of(outcome: Outcome) -> list[MotionStage]:
    """The motions by the model before, and with what was found."""
    return [stage.motion for stage in outcome.stages if stage.motion]


def context_of(outcome: Outcome) -> dict[str, Any]:
    """Data of the section on the page."""
    stages = stages_of(outcome)
    before = stages[0] if len(stages) > 1 else None
    rows = [
        {
            "name": item.name,
            "role": item.role.replace("_", " "),
            "rms": millimetres(item.rmse),
            "before": millimetres(before.shown[k].rmse) if before else "",
        }
        for k, item in enumerate(stages[-1].shown)
    ]
    return {
        "motion_rows": rows,
        "motion_before": before,
        "motion_sentence": sentence_of(outcome),
        "motion_picture": moving_picture(stages[-1].shown),
        "modes": outcome.modes,
        "mode_rows": mode_rows(outcome.modes),
        "mode_picture": mode_picture(outcome.modes),
    }


def mode_rows(modes: MeasuredModes | None) -> list[list[str]]:
    """Frequencies as fitted and as predicted, and damping ratios, of each mode."""
    if modes is None:
        return []
    pairs = zip(
        (modes.frequencies, modes.predicted, modes.damping_ratios),
        (modes.frequency_std, modes.predicted_std, modes.damping_ratio_std),
        strict=True,
    )
    columns = [list(map(plus_minus, x.tolist(), std.tolist())) for x, std in pairs]
    return [list(row) for row in zip(*columns, strict=True)]


def mode_picture(modes: MeasuredModes | None) -> Markup | None:
    """The swinging modes."""
    if modes is None:
        return None
    names = [f"{rate:.3g} Hz" for rate in modes.frequencies.tolist()]
    # Numbers and escaped text.
    return Markup(swinging_modes(modes.points, modes.shapes, modes.frequencies, names))


def mode_table(outcome: Outcome) -> Table:
    """Modes at the end of a recording, on the terminal."""
    assert outcome.modes is not None
    title = f"Modes about the shape at rest at the end of {outcome.modes.motion}"
    columns = ["in motion [Hz]", "from still shapes alone [Hz]", "damping ratio"]
    table = plain_table(title, ["mode"], columns)
    for k, row in enumerate(mode_rows(outcome.modes)):
        table.add_row(str(k + 1), *row)
    return table


def sentence_of(outcome: Outcome) -> str:
    """How well motions are met, and how well they were before."""
    *before, last = stages_of(outcome)
    held = last.rmse_held_out
    said = worded(
        _SAID,
        fit=last.rmse_fit,
        held_out=worded(", held-out ones to {held:mm}", held=held) if held is not None else "",
        noise=last.noise * last.shown[0].compared ** 0.5,
    )
    if before:
        names = " and ".join(map(str, outcome.effects))
        said += worded(_BEFORE, names=names, fit=before[0].rmse_fit)
    return " ".join([said, *(f"{item.name}: {item.note}." for item in last.shown if item.note)])


def motion_table(outcome: Outcome) -> Table:
    """Motions, their roles and errors, on the terminal."""
    found = context_of(outcome)
    columns = ["role", *(["before"] if found["motion_before"] else []), "RMS"]
    table = plain_table("Distance of the markers in motion, RMS", ["motion"], columns)
    for row in found["motion_rows"]:
        cells = [row["role"], *([row["before"]] if found["motion_before"] else []), row["rms"]]
        table.add_row(row["name"], *cells)
    return table


def motion_check_table(checked: Sequence[CheckedMotion]) -> Table:
    """One line for each motion of `dlo check`."""
    columns = ["role", "duration [s]", "pictures/s", "points", "seen", "declared cable [Hz]"]
    table = plain_table("Recordings of the moving cable", ["motion"], columns)
    for one in checked:
        told = (one.duration, one.rate)
        cells = ["-" if x is None else f"{x:.3g}" for x in told]
        cells.append("-" if one.points is None else str(one.points))
        cells.append("-" if one.seen is None else f"{100 * one.seen:.0f} %")
        cells.append(", ".join(f"{x:.2g}" for x in one.frequencies) or "-")
        style = "red" if one.problem else ""
        table.add_row(one.name, one.role.replace("_", " "), *cells, style=style)
    return table
