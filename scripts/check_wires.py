"""Real wires, every repeat left out once: its prediction beside the difference of repeats.

    python scripts/check_wires.py [black_wire white_wire]

The wires were measured by Chen, Bretl and Pham (see configs/real/); each hangs in the same pose
five times. The floor is the mean of the other trials as predictor. Beside the errors: the share of
the points of the trial left out that lie in their 90 % band.
"""

from __future__ import annotations

import os
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np
from harness import options, run

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


def left_out(case: tuple[str, int]) -> tuple[dict[str, float | None], str, float]:
    """Errors [m] of the stages without one trial of a wire, effects, share in the band."""
    name, k = case
    config = load_config(ROOT / "configs" / f"{name}.yaml")
    measured = measured_poses(config, read_inputs(config))
    poses = tuple(
        pose.changed(role="held_out" if i == k else "fit")
        for i, pose in enumerate(config.experiment.poses)
    )
    experiment = config.experiment.changed(poses=poses)
    outcome = run_session(config.changed(experiment=experiment))
    row: dict[str, float | None] = {"floor": floor(measured, k, config.cable.length)}
    row |= {stage.name: stage.rmse_held_out for stage in outcome.stages}
    row.setdefault("closed", row["batch"])
    effects = ",".join(effect.name for effect in outcome.effects) or "-"
    return row, effects, 100 * (outcome.inside_band or np.nan)


def text_of(
    case: tuple[str, int], found: tuple[dict[str, float | None], str, float], _: float
) -> str:
    """A line of the table."""
    row, effects, inside = found
    cells = "  ".join(f"{key} {1e3 * x:6.2f}" for key, x in row.items() if x is not None)
    text = f"{case[0]} trial {case[1]} left out [mm]: {cells}  effects {effects}"
    return f"{text}  {inside:.0f} % in their band"


def main() -> None:
    """Leave each trial out, print the errors of the stages."""
    parser = options(__doc__, jobs=True)
    parser.add_argument("names", nargs="*", help=", ".join(WIRES))
    chosen = parser.parse_args()
    names = chosen.names or WIRES
    if lost := set(names) - set(WIRES):
        parser.error(f"no {', '.join(sorted(lost))}: try {', '.join(WIRES)}")
    for name in names:
        count = len(load_config(ROOT / "configs" / f"{name}.yaml").experiment.poses)
        found = run(left_out, [(name, k) for k in range(count)], chosen, text_of)
        for key in ("floor", "stiffness_only", "batch", "closed"):
            values = [x for row, *_ in found if (x := row[key]) is not None]
            print(f"{name} mean {key}: {1e3 * np.mean(values):.2f} mm", flush=True)
        inside = np.nanmean([share for *_, share in found])
        print(f"{name}: {inside:.0f} % of left-out points in their 90 % band", flush=True)


if __name__ == "__main__":
    main()
