"""Rough sessions, whose cables do not repeat: verdict, EI, errors and bands beside the truth.

    python scripts/check_rough.py SESSIONS TRUTH [NAME ...]

SESSIONS holds folders with a session.yaml, TRUTH folders of the same names with a truth.yaml:
`bending_stiffness` [N m^2], `marker_noise` [m] of a coordinate, `repeat_rms_all_m`, how far two
repeats of a pose differ at the markers, and `effects` that are hidden.
"""

from __future__ import annotations

import os
import sys
from typing import Any

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np
import yaml
from beside_truth import asked, stiffness_cell

from dlo_casadi.config import load_config
from dlo_casadi.session import run_session
from dlo_casadi.session.outcome import Outcome

# Largest error of held-out markers, over that of a mean shape with noise.
ALLOWED = 1.25
# Largest relative half width of the stiffness's interval, and error of a clamp's angle [rad].
NARROW, ANGLE = 0.3, 0.03
# Name of a hidden effect in truth.yaml -> that of the program, and its parameter's true value.
HIDDEN = {
    "clamp_error": ("clamp_angle", "start_heading_error", lambda value: value[0]),
    "softening": ("bending_softening", "softness", lambda value: 1 / value),
}


def found_effect(outcome: Outcome, truth: dict[str, Any]) -> tuple[str, bool]:
    """The effect that was named, and whether it is the hidden one, or tied with it."""
    named = [effect.name for effect in outcome.effects]
    text = "+".join(named) or "-"
    wanted = {HIDDEN[key][0] for key in truth["effects"]}
    tied = {other for effect in outcome.effects for other in effect.indistinguishable_from}
    right = wanted <= {*named, *tied} and len(named) == len(wanted)
    for key, value in truth["effects"].items():
        label, parameter, meaning = HIDDEN[key]
        for effect in outcome.effects:
            if effect.name == label and parameter in effect.parameters:
                gap = effect.parameters[parameter].value - meaning(value)
                text += f" ({gap:+.3f})"
                right = right and (key != "clamp_error" or abs(gap) < ANGLE)
    return text, right


def row(outcome: Outcome, truth: dict[str, Any]) -> tuple[list[str], bool]:
    """One line of the table, and whether all of it is as it should be."""
    stage, exact = outcome.stages[-1], truth["bending_stiffness"]
    stiffness = stage.parameters["bending_stiffness"]
    bending, inside = stiffness_cell(outcome, "bending_stiffness", exact)
    low, high = stiffness.interval_95 or (None, None)
    known = low is not None and high is not None
    narrow = known and (high - low) / 2 < NARROW * stiffness.value
    floor = np.hypot(truth["repeat_rms_all_m"] / np.sqrt(2), np.sqrt(2) * truth["marker_noise"])
    held_out = stage.rmse_held_out
    error = held_out is not None and held_out <= ALLOWED * floor
    named, right = found_effect(outcome, truth)
    verdict = "effect_found" if truth["effects"] else "complete"
    simple = outcome.stage("stiffness_only")
    worse = simple is not None and (stage.rmse_fit or np.inf) > (simple.rmse_fit or np.inf)
    passed = outcome.verdict == verdict and right and inside and narrow and error and not worse
    spread = outcome.repeatability.expected_spread
    cells = [
        str(outcome.verdict),
        named,
        bending,
        f"{1e3 * (held_out or np.nan):.2f} (<= {1e3 * ALLOWED * floor:.2f})",
        f"{1e3 * spread:.1f} ({1e3 * truth['repeat_rms_all_m']:.1f})",
        f"{outcome.measurement.std * 1e3:.2f} ({1e3 * truth['marker_noise']:.2f})",
        f"{100 * (outcome.inside_band or np.nan):.0f} %",
        "ok" if passed else "NOT",
    ]
    return cells, passed


def main() -> int:
    """Print the table; 1 if anything in it is not as it should be."""
    sessions, truths, names = asked(__doc__)
    print(
        "session | verdict | effect | EI [N m^2] | held out [mm] | two repeats [mm] | noise [mm] "
        "| in 90 % band |"
    )
    good, inside = True, []
    for name in names:
        outcome = run_session(load_config(sessions / name / "session.yaml"))
        truth = yaml.safe_load((truths / name / "truth.yaml").read_text(encoding="utf-8"))
        cells, passed = row(outcome, truth)
        good = good and passed
        inside.append(outcome.inside_band)
        print(name, *cells, sep=" | ", flush=True)
    shares = [share for share in inside if share is not None]
    print(f"held-out points inside their bands: {100 * np.mean(shares):.0f} %")
    return 0 if good else 1


if __name__ == "__main__":
    sys.exit(main())
