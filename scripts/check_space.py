"""Sessions in space: verdict, effects, stiffnesses and errors beside the truth.

    python scripts/check_space.py SESSIONS TRUTH [NAME ...]

SESSIONS holds folders with a session.yaml, TRUTH folders of the same names with a truth.yaml:
`bending_stiffness`, `torsional_stiffness` [N m^2] and `effects` that are hidden, each with its
numbers. Exit code 1 if anything is not as it should be.
"""

from __future__ import annotations

import os
import sys
import time
from pathlib import Path
from typing import Any

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np
import yaml
from beside_truth import stiffness_cell

from dlo_casadi.config import load_config
from dlo_casadi.session import run_session
from dlo_casadi.session.outcome import Outcome

# Name of a hidden effect in truth.yaml -> that of the program, and true values of its parameters.
HIDDEN: dict[str, tuple[str, Any]] = {
    "clamp_start": ("clamp_rotation", lambda v: {"start_y": v[1], "start_z": v[2]}),
    "creep": ("rest_curvature_drift", lambda v: {"rate": v}),
    "flat": ("bending_anisotropy", lambda v: {"ratio": v}),
    "frame": ("camera_frame", lambda v: {}),
    "lump": ("lumped_mass", lambda v: {"position": v[0], "mass": v[1]}),
    "mass": ("mass_error", lambda v: {"factor": v}),
    "taper": ("stiffness_gradient", lambda v: {"slope": v}),
    "tether": ("tether", lambda v: {"position": v[0], "stiffness": v[1]}),
}
# Parameters are right within so many standard deviations and that share.
STDS, SHARE = 3.0, 0.25


def effects(outcome: Outcome, truth: dict[str, Any]) -> tuple[str, bool]:
    """What was named, and whether it is what was hidden, or tied with it, and as large."""
    named = [effect["name"] for effect in outcome.effects]
    tied = {other for effect in outcome.effects for other in effect["indistinguishable_from"]}
    right, text = len(named) == len(truth["effects"]), "+".join(named) or "-"
    for key, value in truth["effects"].items():
        label, meaning = HIDDEN[key]
        right = right and label in {*named, *tied}
        for effect in outcome.effects:
            for name, exact in meaning(value).items() if effect["name"] == label else ():
                own = effect["parameters"][name]
                off = abs(own["value"] - exact)
                text += f" {name} {own['value']:.4g} ({exact:g})"
                right = right and (off <= STDS * own["std"] or off <= SHARE * abs(exact))
    return text, right


def main() -> int:
    """Print the table; 1 if anything in it is not as it should be."""
    sessions, truths = Path(sys.argv[1]), Path(sys.argv[2])
    names = sys.argv[3:] or sorted(path.parent.name for path in sessions.glob("*/session.yaml"))
    print(
        "session | verdict | effects | EI [N m^2] | GJ [N m^2] | fit, held out [mm] | noise | s |"
    )
    good = True
    for name in names:
        began = time.process_time()
        outcome = run_session(load_config(sessions / name / "session.yaml"))
        spent = time.process_time() - began
        truth = yaml.safe_load((truths / name / "truth.yaml").read_text(encoding="utf-8"))
        named, right = effects(outcome, truth)
        bending, known = stiffness_cell(outcome, "bending_stiffness", truth["bending_stiffness"])
        torsion, told = stiffness_cell(outcome, "torsional_stiffness", truth["torsional_stiffness"])
        verdict = "effect_found" if truth["effects"] else "complete"
        passed = outcome.verdict == verdict and right and known and told
        good, stage = good and passed, outcome.stages[-1]
        errors = [1e3 * (x or np.nan) for x in (stage.rmse_fit, stage.rmse_held_out)]
        cells = [str(outcome.verdict), named, bending, torsion, "{:.2f}, {:.2f}".format(*errors)]
        noise = f"{1e3 * outcome.measurement.std:.2f}"
        print(name, *cells, noise, f"{spent:.0f}", "ok" if passed else "NOT", sep=" | ", flush=True)
    return 0 if good else 1


if __name__ == "__main__":
    sys.exit(main())
