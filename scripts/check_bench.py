"""Run whole sessions whose truth is known and set the results beside it.

    python scripts/check_bench.py [NAME ...] [--without-true-effect] [--output FILE] [--jobs N]

Only this script and the tests read the truth; the toolkit never does. The bench sessions are
rendered: an independent rod simulator and a camera renderer made them.
"""

from __future__ import annotations

import os
from dataclasses import replace
from functools import partial
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np
import yaml
from harness import options, run

from dlo_casadi.config import load_config
from dlo_casadi.estimation.prediction import predict_poses
from dlo_casadi.session import run_session
from dlo_casadi.session.outcome import Outcome

ROOT = Path(__file__).resolve().parent.parent
TRUTH = ROOT / "tests" / "data" / "bench_truth"
# Name of an effect in truth.yaml -> its name here, and its parameters by their names there.
NAMES = {
    "lump": ("lumped_mass", ("position", "mass")),
    "taper": ("stiffness_gradient", ("slope",)),
    "softening": ("bending_softening", ("curvature_scale",)),
    "length": ("length_error", ("length_difference",)),
    "creep": ("rest_curvature_drift", ("rate",)),
    "tether": ("tether", ("position", "stiffness", "anchor_x", "anchor_y")),
    "stiff_section": ("stiff_section", ("start", "end", "factor")),
    "extens": ("axial_stretch", ("axial_stiffness",)),
    "standoff": ("standoff_error", ("distance",)),
    "clamp_error": ("clamp_angle", ("start_heading_error", "end_heading_error")),
}


def config_of(name: str) -> Path:
    """Configuration of a bench session."""
    if name == "connector":
        return ROOT / "configs" / "cable.yaml"
    return ROOT / "tests" / "data" / "bench" / name / "session.yaml"


def true_effects(name: str) -> dict[str, dict[str, float]]:
    """Effects in a session, by their names here."""
    truth = yaml.safe_load((TRUTH / name / "truth.yaml").read_text())
    found: dict[str, dict[str, float]] = {}
    for key, value in truth["effects"].items():
        if key == "end_spring":
            k0, h0, k1, h1 = value
            if k0:
                found["start_spring"] = {"stiffness": k0, "heading": h0}
            if k1:
                found["end_spring"] = {"stiffness": k1, "heading": h1}
        else:
            effect, parameters = NAMES[key]
            values = value if isinstance(value, list) else [value]
            found[effect] = dict(zip(parameters, values, strict=True))
    return found


def compare(name: str, outcome: Outcome) -> dict:
    """Required and measured figures of one session."""
    truth = yaml.safe_load((TRUTH / name / "truth.yaml").read_text())
    batch, last = outcome.stage("batch"), outcome.stages[-1]
    assert batch is not None
    stiffness = last.parameters["bending_stiffness"]
    row = {
        "session": name,
        "verdict": outcome.verdict,
        "true": sorted(true_effects(name)),
        "found": [effect.name for effect in outcome.effects],
        "ties": {e.name: e.indistinguishable_from for e in outcome.effects},
        "EI_true": truth["bending_stiffness"],
        "EI": stiffness.value,
        "EI_interval_95": stiffness.interval_95,
        "EI_identifiable": stiffness.identifiable,
        "noise_mm": 1e3 * outcome.measurement.std,
        "held_out_batch_mm": _mm(batch.rmse_held_out),
        "held_out_mm": _mm(last.rmse_held_out),
        "held_out_over_noise": (last.rmse_held_out or np.nan) / outcome.measurement.std,
        "fixtures_mm": _fixtures(name, outcome),
        "chi2_per_dof": last.chi2_per_dof,
        "seconds": outcome.timing["total"],
        "diagnosis_seconds": outcome.timing["diagnosis"],
        "parameters": {},
    }
    for effect in outcome.effects:
        for key, true in true_effects(name).get(effect.name, {}).items():
            found = effect.parameters[key]
            row["parameters"][f"{effect.label}.{key}"] = {
                "true": true,
                "value": found.value,
                "std": found.std,
                "deviations": (found.value - true) / found.std,
                "relative": (found.value - true) / true if true else None,
            }
    if "tether" in truth["effects"] and outcome.unexplained:
        row["pull"] = _pull(name, truth["effects"]["tether"], outcome)
    return row


def _mm(value: float | None) -> float | None:
    return None if value is None else 1e3 * value


def _fixtures(name: str, outcome: Outcome) -> float | None:
    """RMS distance [mm] between held-out shapes predicted from the declared and the true ends."""
    fit, shapes = outcome.fit, np.load(TRUTH / name / "truth_shapes.npz")
    poses = [item.pose for item in fit.problem.history]
    if any(pose.end is None for pose in poses):
        return None
    true = [replace(pose, end=tuple(map(float, shapes[pose.name][-1]))) for pose in poses]
    declared, moved = (predict_poses(fit.model, fit.p, fit.rest, ends) for ends in (poses, true))
    places = np.linspace(0.0, fit.model.cable.length, 200)
    square = [
        (one.curve.distances(other.curve.at(places)) ** 2).mean()
        for one, other, item in zip(declared, moved, fit.problem.history, strict=True)
        if item.held_out and one is not None and other is not None
    ]
    return 1e3 * float(np.sqrt(np.mean(square))) if square else None


def _pull(name: str, tether: list[float], outcome: Outcome) -> dict:
    """The tether's force in each fit pose against the estimate."""
    s, k, x, y = tether
    shapes = np.load(TRUTH / name / "truth_shapes.npz")
    length = outcome.config.cable.length
    load = outcome.unexplained
    assert load is not None
    true = []
    for pose in load.poses:
        curve = shapes[pose]
        places = np.linspace(0.0, length, len(curve))
        at = [np.interp(s, places, curve[:, i]) for i in (0, 1)]
        true.append([k * (x - at[0]), k * (y - at[1])])
    force = np.array(true)
    sizes = np.hypot(*load.force_per_pose.T) / np.hypot(*force.T)
    angles = np.arctan2(*load.force_per_pose.T[::-1]) - np.arctan2(force[:, 1], force[:, 0])
    angles = np.degrees(np.abs((angles + np.pi) % (2 * np.pi) - np.pi))
    return {
        "position": load.position,
        "position_true": s,
        "median_size_error": float(np.median(np.abs(sizes - 1))),
        "median_angle_deg": float(np.median(angles)),
    }


def main() -> None:
    """Run the sessions that are asked for."""
    parser = options(__doc__, jobs=True, scheduler=True, output=True)
    parser.add_argument("names", nargs="*", help="sessions; all by default")
    parser.add_argument(
        "--without-true-effect",
        action="store_true",
        help="take the true effects out of the library: what is named then?",
    )
    args = parser.parse_args()
    names = args.names or sorted(path.name for path in TRUTH.iterdir() if path.is_dir())
    run(partial(run_one, without_true_effect=args.without_true_effect), names, args, text_of)


def run_one(name: str, without_true_effect: bool) -> dict:
    """Run one session and compare."""
    config = load_config(config_of(name))
    if without_true_effect:
        hidden = tuple(true_effects(name))
        config = config.changed(diagnosis=config.diagnosis.changed(exclude=hidden))
    return compare(name, run_session(config))


def text_of(_: str, row: dict, seconds: float) -> str:
    """One session."""
    lines = [
        f"{row['session']:15s} {row['verdict']:12s} true {','.join(row['true']) or '-':24s} "
        f"found {','.join(row['found']) or '-'}  ties {row['ties']}"
    ]
    ends = row["EI_interval_95"] or ()  # none if the session is unexplained
    bounds = ", ".join(f"{x:.4g}" if x is not None else "-" for x in ends)
    lines.append(
        f"    EI {row['EI']:.4g} [{bounds}] true {row['EI_true']:.4g}   noise "
        f"{row['noise_mm']:.3f} mm  held out {row['held_out_batch_mm'] or np.nan:.3f} -> "
        f"{row['held_out_mm'] or np.nan:.3f} mm = {row['held_out_over_noise']:.2f} noise, of which "
        f"fixtures {row['fixtures_mm'] or np.nan:.3f} mm   "
        f"chi2/dof {row['chi2_per_dof']:.2f}   {seconds:.0f} s "
        f"(diagnosis {row['diagnosis_seconds']:.0f} s)"
    )
    for key, item in row["parameters"].items():
        relative = "" if item["relative"] is None else f"  {item['relative']:+.0%}"
        lines.append(
            f"    {key} {item['value']:.4g} +/- {item['std']:.2g}, true {item['true']:.4g}: "
            f"{item['deviations']:+.1f} std{relative}"
        )
    if "pull" in row:
        lines.append(f"    pull {row['pull']}")
    return "\n".join(lines)


if __name__ == "__main__":
    main()
