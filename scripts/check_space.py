"""Sessions in space: verdict, effects, stiffnesses and errors beside the truth.

    python scripts/check_space.py SESSIONS TRUTH [NAME ...]

SESSIONS holds folders with a session.yaml, TRUTH folders of the same names with a truth.yaml:
`bending_stiffness`, `torsional_stiffness` [N m^2] and `effects` that are hidden, each with its
numbers. Exit code 1 if anything is not as it should be.

Where there is a truth_shapes.npz of points along the true cables: how far the predicted shapes, fit
and held out, are off them, and how far they would be with the true parameters and `rest` shape:
that much is due to the places in which the ends are declared, which no fit can mend.
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
from beside_truth import asked, stiffness_cell
from scipy.interpolate import CubicSpline
from scipy.spatial import cKDTree

from dlo_casadi.config import load_config
from dlo_casadi.effects import EFFECTS
from dlo_casadi.estimation.prediction import predict_poses
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
# Largest error of a right parameter, in standard deviations.
STDS = 3.0


def effects(outcome: Outcome, truth: dict[str, Any]) -> tuple[str, bool]:
    """The effect that was named, and whether it is the hidden one (or tied), of the right size."""
    named = [effect.name for effect in outcome.effects]
    tied = {other for effect in outcome.effects for other in effect.indistinguishable_from}
    right, text = len(named) == len(truth["effects"]), "+".join(named) or "-"
    for key, value in truth["effects"].items():
        label, meaning = HIDDEN[key]
        right = right and label in {*named, *tied}
        for effect in outcome.effects:
            for name, exact in meaning(value).items() if effect.name == label else ():
                own = effect.parameters[name]
                off = abs(own.value - exact)
                text += f" {name} {own.value:.4g} ({exact:g})"
                right = right and off <= STDS * own.std
    return text, right


def off_truth(outcome: Outcome, truth: dict[str, Any], folder: Path) -> str:
    """RMS distances [mm] from the true shapes: predicted, and with the true parameters."""
    if not (folder / "truth_shapes.npz").exists():
        return "-"
    shapes, stage = np.load(folder / "truth_shapes.npz"), outcome.stages[-1]
    own = {name: apart(shape.curve, shapes[name]) for name, shape in stage.shapes.items()}
    text = "{:.2f}, {:.2f}".format(*by_role(outcome, own))
    model = outcome.fit.model
    values = {k: truth[k] for k in ("bending_stiffness", "torsional_stiffness")}
    for key, value in truth["effects"].items():
        label, meaning = HIDDEN[key]
        if label not in [effect.label for effect in model.effects]:
            model = model.with_effect(EFFECTS[label]())
        values |= {f"{label}.{name}": exact for name, exact in meaning(value).items()}
    hidden = [HIDDEN[key][0] for key in truth["effects"]]
    needed = {name for name in model.names if name.split(".")[0] in hidden}
    if "rest" not in truth or needed - set(values):
        return text
    p = np.array([values.get(name, x) for name, x in zip(model.names, model.nominal, strict=True)])
    rest = np.concatenate(
        [
            CubicSpline(truth["rest"]["s"], truth["rest"][name])(model.chain.cells.mean(axis=1))
            for name in ("twist", "k_y", "k_z")
        ]
    )
    found = predict_poses(model, p, rest, [x.held for x in outcome.config.experiment.poses])
    s = np.linspace(0.0, model.cable.length, 201)
    ideal = {
        item.name: apart(one.curve.at(s), shapes[item.name])
        for item, one in zip(outcome.config.experiment.poses, found, strict=True)
        if one is not None
    }
    return text + " ({:.2f}, {:.2f})".format(*by_role(outcome, ideal))


def apart(curve: np.ndarray, points: np.ndarray) -> float:
    """Mean square distance [m^2] of points (K, 3) from a curve through (M, 3)."""
    dense = CubicSpline(np.linspace(0, 1, len(curve)), curve)(np.linspace(0, 1, 4001))
    return float(np.mean(cKDTree(dense).query(points)[0] ** 2))


def by_role(outcome: Outcome, squares: dict[str, float]) -> list[float]:
    """Root mean square [mm] over poses that were fitted, and over those held out."""
    return [
        1e3 * np.sqrt(np.mean([squares[x.name] for x in outcome.poses if x.role == role] or np.nan))
        for role in ("fit", "held_out")
    ]


def main() -> int:
    """Print the table; 1 if anything in it is not as it should be."""
    sessions, truths, names = asked(__doc__)
    print(
        "session | verdict | effects | EI [N m^2] | GJ [N m^2] | "
        "fit, held out, on the measured branch [mm] | "
        "off the truth (were all parameters true) [mm] | noise | s |"
    )
    good = True
    for name in names:
        began = time.process_time()
        outcome = run_session(load_config(sessions / name / "session.yaml"))
        spent = time.process_time() - began
        truth = yaml.safe_load((truths / name / "truth.yaml").read_text(encoding="utf-8"))
        named, right = effects(outcome, truth)
        bending, known = stiffness_cell(outcome, "bending_stiffness", truth["bending_stiffness"])
        torsion, torsion_right = stiffness_cell(
            outcome, "torsional_stiffness", truth["torsional_stiffness"]
        )
        verdict = "effect_found" if truth["effects"] else "complete"
        passed = outcome.verdict == verdict and right and known and torsion_right
        good, stage = good and passed, outcome.stages[-1]
        branch = stage.rmse_fit_measured_branch, stage.rmse_held_out_measured_branch
        errors_by_role = zip(branch, (stage.rmse_fit, stage.rmse_held_out), strict=True)
        errors = [1e3 * (x or y or np.nan) for x, y in errors_by_role]
        cells = [str(outcome.verdict), named, bending, torsion, "{:.2f}, {:.2f}".format(*errors)]
        cells.append(off_truth(outcome, truth, truths / name))
        noise = f"{1e3 * outcome.measurement.std:.2f}"
        print(name, *cells, noise, f"{spent:.0f}", "ok" if passed else "NOT", sep=" | ", flush=True)
    return 0 if good else 1


if __name__ == "__main__":
    sys.exit(main())
