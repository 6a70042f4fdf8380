"""Real wires, every repeat left out once: its prediction beside the difference of repeats.

    python scripts/check_wires.py [black_wire white_wire]

The wires were measured by Chen, Bretl and Pham (see configs/real/); each hangs in the same pose
five times. The floor is the mean of the other trials as predictor. Beside the errors: the share of
the points of the trial left out that lie in their 90 % band.
"""

from __future__ import annotations

import argparse
import os
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np

from dlo_casadi.config import load_config
from dlo_casadi.session import run_session
from dlo_casadi.session.measure import measured_poses, read_inputs

ROOT = Path(__file__).resolve().parent.parent
WIRES = ["white_wire", "black_wire"]


def floor(measured, k: int, length: float) -> float:
    """RMS distance of trial k from the mean of the others [m]."""
    grid = np.linspace(0.0, 1.0, 101) * length
    curves = []
    for item in measured:
        places = np.maximum.accumulate(item.places(length))
        curves.append(np.stack([np.interp(grid, places, item.points[:, i]) for i in (0, 1)], 1))
    mean = np.mean([curve for i, curve in enumerate(curves) if i != k], axis=0)
    gap = measured[k].points[:, None] - mean[None]
    return float(np.sqrt((gap**2).sum(-1).min(axis=1).mean()))


def main() -> None:
    """Leave each trial out, print the errors of the stages."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("names", nargs="*", help=", ".join(WIRES))
    names = parser.parse_args().names or WIRES
    if lost := set(names) - set(WIRES):
        parser.error(f"no {', '.join(sorted(lost))}: try {', '.join(WIRES)}")
    for name in names:
        config = load_config(ROOT / "configs" / f"{name}.yaml")
        measured = measured_poses(config, read_inputs(config))
        table, inside = [], []
        for k in range(len(measured)):
            poses = tuple(
                pose.changed(role="held_out" if i == k else "fit")
                for i, pose in enumerate(config.experiment.poses)
            )
            experiment = config.experiment.changed(poses=poses)
            outcome = run_session(config.changed(experiment=experiment))
            row = {"floor": floor(measured, k, config.cable.length)}
            for stage in outcome.stages:
                row[stage.name] = stage.rmse_held_out
            row.setdefault("closed", row["batch"])
            table.append(row)
            effects = ",".join(effect.name for effect in outcome.effects) or "-"
            cells = "  ".join(
                f"{key} {1e3 * value:6.2f}" for key, value in row.items() if value is not None
            )
            inside.append(100 * (outcome.inside_band or np.nan))
            band = f"{inside[-1]:.0f} % in their band"
            print(f"{name} trial {k} left out [mm]: {cells}  effects {effects}  {band}", flush=True)
        for key in ("floor", "stiffness_only", "batch", "closed"):
            values = [row[key] for row in table if row[key] is not None]
            print(f"{name} mean {key}: {1e3 * np.mean(values):.2f} mm", flush=True)
        print(
            f"{name}: {np.nanmean(inside):.0f} % of left-out points in their 90 % band", flush=True
        )


if __name__ == "__main__":
    main()
