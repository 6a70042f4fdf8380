"""Sessions beside their truth: verdict, effects, stiffnesses and errors.

    python scripts/check_space.py SESSIONS TRUTH [NAME ...]
    python scripts/check_space.py --rough SESSIONS TRUTH [NAME ...]

SESSIONS holds folders with a session.yaml, TRUTH folders of the same names with a truth.yaml:
`bending_stiffness` [N m^2] and `effects` that are hidden, each with its numbers. Exit code 1 if
anything is not as it should be.

In space truth.yaml has `torsional_stiffness` [N m^2], too. Where there is a truth_shapes.npz of
points along the true cables: how far the predicted shapes, fit and held out, are off them, and how
far they would be with the true parameters and `rest` shape: that much is due to the places in which
the ends are declared, which no fit can mend. `rest`: `s` from 0 to the end, in metres or as a share
of the length; `k_y`, `k_z` and, unless it is zero, `twist` [1/m].

Rough sessions are those of cables in a plane that do not repeat. Their truth.yaml has
`marker_noise` [m] of a coordinate, and `repeat_rms_all_m`, how far two repeats of a pose differ at
the markers.
"""

from __future__ import annotations

import os
import sys
import time
from functools import partial
from pathlib import Path
from typing import Any

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np
import yaml
from harness import options, run
from scipy.interpolate import CubicSpline
from scipy.spatial import cKDTree

from dlo_casadi.config import load_config
from dlo_casadi.effects import EFFECTS
from dlo_casadi.estimation.prediction import predict_poses
from dlo_casadi.session import run_session
from dlo_casadi.session.outcome import Outcome

# Largest error of a right parameter, in standard deviations; of a clamp's angle [rad].
STDS, ANGLE = 3.0, 0.03
# Of rough sessions: largest error of held-out markers, over that of a mean shape with noise; and
# largest relative half width of the stiffness's interval.
ALLOWED, NARROW = 1.25, 0.3
# Name of a hidden effect in truth.yaml -> that of the program, true values of its parameters, and
# their largest error where it is not one in standard deviations.
HIDDEN: dict[str, tuple[str, Any, float | None]] = {
    "clamp_error": ("clamp_angle", lambda v: {"start_heading_error": v[0]}, ANGLE),
    "clamp_start": ("clamp_rotation", lambda v: {"start_y": v[1], "start_z": v[2]}, None),
    "creep": ("rest_curvature_drift", lambda v: {"rate": v}, None),
    "flat": ("bending_anisotropy", lambda v: {"ratio": v}, None),
    "frame": ("camera_frame", lambda v: {}, None),
    "lump": ("lumped_mass", lambda v: {"position": v[0], "mass": v[1]}, None),
    "mass": ("mass_error", lambda v: {"factor": v}, None),
    "softening": ("bending_softening", lambda v: {"softness": 1 / v}, np.inf),
    "taper": ("stiffness_gradient", lambda v: {"slope": v}, None),
    "tether": ("tether", lambda v: {"position": v[0], "stiffness": v[1]}, None),
}
TITLES = {
    False: "session | verdict | effects | EI [N m^2] | GJ [N m^2] | "
    "fit, held out, on the measured branch [mm] | "
    "off the truth (were all parameters true) [mm] | noise | s |",
    True: "session | verdict | effects | EI [N m^2] | held out [mm] | two repeats [mm] | "
    "noise [mm] | in 90 % band | s |",
}


def effects(outcome: Outcome, truth: dict[str, Any]) -> tuple[str, bool]:
    """The effect that was named, and whether it is the hidden one (or tied), of the right size."""
    named = [effect.name for effect in outcome.effects]
    tied = {other for effect in outcome.effects for other in effect.indistinguishable_from}
    right, text = len(named) == len(truth["effects"]), "+".join(named) or "-"
    for key, value in truth["effects"].items():
        label, meaning, allowed = HIDDEN[key]
        right = right and label in {*named, *tied}
        for effect in outcome.effects:
            for name, exact in meaning(value).items() if effect.name == label else ():
                own = effect.parameters[name]
                off = abs(own.value - exact)
                text += f" {name} {own.value:.4g} ({exact:g})"
                right = right and off <= (STDS * own.std if allowed is None else allowed)
    verdict = "effect_found" if truth["effects"] else "complete"
    return text, right and outcome.verdict == verdict


def stiffness_cell(outcome: Outcome, name: str, exact: float) -> tuple[str, bool]:
    """A stiffness with its interval, and whether the truth lies inside.

    The interval needs both ends, except that of GJ where an end of the cable may roll.
    """
    found, model = outcome.stages[-1].parameters[name], outcome.fit.model
    low, high = found.interval_95 or (None, None)
    needed = name == "bending_stiffness" or (model.start.roll and model.end.roll)
    bounded = low is not None and high is not None
    inside = (bounded or not needed) and (low or 0.0) <= exact <= (high or np.inf)
    told = "unbounded" if low is None or high is None else f"{low:.4g} to {high:.4g}"
    return f"{found.value:.4g} ({told}; {exact:g})", inside


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
        label, meaning, _ = HIDDEN[key]
        if label not in [effect.label for effect in model.effects]:
            model = model.with_effect(EFFECTS[label]())
        values |= {f"{label}.{name}": exact for name, exact in meaning(value).items()}
    hidden = [HIDDEN[key][0] for key in truth["effects"]]
    needed = {name for name in model.names if name.split(".")[0] in hidden}
    if "rest" not in truth or needed - set(values):
        return text
    p = np.array([values.get(name, x) for name, x in zip(model.names, model.nominal, strict=True)])
    known = np.array(truth["rest"]["s"])
    places = model.chain.cells.mean(axis=1) * known[-1] / model.cable.length
    rest = np.concatenate(
        [
            CubicSpline(known, truth["rest"].get(name, 0 * known))(places)
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


def cells_in_space(outcome: Outcome, truth: dict[str, Any], folder: Path) -> tuple[list[str], bool]:
    """Cells behind the verdict, and whether all of them are as they should be."""
    named, right = effects(outcome, truth)
    stiffnesses = [
        stiffness_cell(outcome, name, truth[name])
        for name in ("bending_stiffness", "torsional_stiffness")
    ]
    stage = outcome.stages[-1]
    branch = stage.rmse_fit_measured_branch, stage.rmse_held_out_measured_branch
    errors_by_role = zip(branch, (stage.rmse_fit, stage.rmse_held_out), strict=True)
    errors = [1e3 * (x or y or np.nan) for x, y in errors_by_role]
    cells = [named, *(text for text, _ in stiffnesses), "{:.2f}, {:.2f}".format(*errors)]
    cells += [off_truth(outcome, truth, folder), f"{1e3 * outcome.measurement.std:.2f}"]
    return cells, right and all(inside for _, inside in stiffnesses)


def cells_of_rough(outcome: Outcome, truth: dict[str, Any]) -> tuple[list[str], bool]:
    """Cells behind the verdict, and whether all of them are as they should be."""
    named, right = effects(outcome, truth)
    stage = outcome.stages[-1]
    bending, inside = stiffness_cell(outcome, "bending_stiffness", truth["bending_stiffness"])
    stiffness = stage.parameters["bending_stiffness"]
    low, high = stiffness.interval_95 or (None, None)
    known = low is not None and high is not None
    narrow = known and (high - low) / 2 < NARROW * stiffness.value
    floor = np.hypot(truth["repeat_rms_all_m"] / np.sqrt(2), np.sqrt(2) * truth["marker_noise"])
    held_out = stage.rmse_held_out
    error = held_out is not None and held_out <= ALLOWED * floor
    simple = outcome.stage("stiffness_only")
    worse = simple is not None and (stage.rmse_fit or np.inf) > (simple.rmse_fit or np.inf)
    spread = outcome.repeatability.expected_spread
    cells = [
        named,
        bending,
        f"{1e3 * (held_out or np.nan):.2f} (<= {1e3 * ALLOWED * floor:.2f})",
        f"{1e3 * spread:.1f} ({1e3 * truth['repeat_rms_all_m']:.1f})",
        f"{outcome.measurement.std * 1e3:.2f} ({1e3 * truth['marker_noise']:.2f})",
        f"{100 * (outcome.inside_band or np.nan):.0f} %",
    ]
    return cells, bool(right and inside and narrow and error and not worse)


def main() -> int:
    """Print the table; 1 if anything in it is not as it should be."""
    parser = options(__doc__, jobs=True)
    parser.add_argument("sessions", type=Path, help="folders with a session.yaml")
    parser.add_argument("truths", type=Path, help="folders of the same names with a truth.yaml")
    parser.add_argument("names", nargs="*", help="sessions; all by default")
    parser.add_argument("--rough", action="store_true", help="of cables that do not repeat")
    given = parser.parse_args()
    found = sorted(path.parent.name for path in given.sessions.glob("*/session.yaml"))
    if lost := set(given.names) - set(found) or ({"session.yaml"} if not found else set()):
        parser.error(f"no {', '.join(sorted(lost))} in {given.sessions}")
    print(TITLES[given.rough])
    work = partial(judged, sessions=given.sessions, truths=given.truths, rough=given.rough)
    rows = run(work, given.names or found, given, lambda name, row, _: " | ".join(row[0]))
    if shares := [share for _, _, share in rows if share is not None and given.rough]:
        print(f"held-out points inside their bands: {100 * np.mean(shares):.0f} %")
    return 0 if all(passed for _, passed, _ in rows) else 1


def judged(
    name: str, sessions: Path, truths: Path, rough: bool
) -> tuple[list[str], bool, float | None]:
    """Cells of a session, whether it is as it should be, and what lies in its bands."""
    began = time.process_time()
    outcome = run_session(load_config(sessions / name / "session.yaml"))
    spent = time.process_time() - began
    truth = yaml.safe_load((truths / name / "truth.yaml").read_text(encoding="utf-8"))
    if rough:
        cells, passed = cells_of_rough(outcome, truth)
    else:
        cells, passed = cells_in_space(outcome, truth, truths / name)
    cells = [name, str(outcome.verdict), *cells, f"{spent:.0f}", "ok" if passed else "NOT"]
    return cells, passed, outcome.inside_band


if __name__ == "__main__":
    sys.exit(main())
