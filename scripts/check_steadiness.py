"""Whether results stay the same if declared values of a session change a little.

    python scripts/check_steadiness.py FOLDER [FOLDER ...] [--changes std,prior,mesh]
                                       [--poses N] [--jobs N] [--without-diagnosis]

FOLDERs hold a session.yaml each, or folders that do. Each session is fitted as it is, and again
with its std (the estimated one, where none is declared), tolerances, prior stiffness and mesh
three times as large and as small, and with single fit poses left out (N of them, evenly picked).
Verdict, effects and EI stand beside each other. A change counts as a flip if the verdict differs,
as a jump if ln EI moves by more than both 95 % intervals together, sqrt(a^2 + b^2), and as worse
if the last stage is farther from the fit poses than the stiffness alone. The exit status is 1 if
there is any. A session takes some twenty times as long as one fit.
"""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np
from harness import options, run

from dlo_casadi.config import Config, load_config
from dlo_casadi.errors import DloError
from dlo_casadi.session import run_session
from dlo_casadi.session.remarks import worse_than_simpler

FACTOR = 3.0
CHANGES = ("std", "tolerances", "prior", "mesh", "poses")


@dataclass(frozen=True)
class Row:
    """What one variant of a session gave: EI [N m^2] with its interval, or why there is none."""

    verdict: str
    effects: tuple[str, ...] = ()
    stiffness: tuple[float, float | None, float | None] = (np.nan, None, None)
    rmse_fit: float | None = None
    worse: bool = False
    std: float = np.nan
    n: int = 0
    problem: str = ""

    @property
    def half_width(self) -> float:
        """Width of the 95 % interval of ln EI; infinite if it is unbounded."""
        _, low, high = self.stiffness
        return np.inf if low is None or high is None else float(np.log(high / low)) / 2

    def against(self, base: Row) -> list[str]:
        """Differences from the unchanged session."""
        moved = abs(np.log(self.stiffness[0] / base.stiffness[0]))
        return [
            *["FLIP"] * (self.verdict != base.verdict),
            *["JUMP"] * (not moved <= np.hypot(self.half_width, base.half_width)),
            *["WORSE"] * self.worse,
        ]

    def text(self) -> str:
        """Cells of the table."""
        value, low, high = self.stiffness
        known = "unbounded" if low is None or high is None else f"{low:.4g} to {high:.4g}"
        rmse = "-" if self.rmse_fit is None else f"{1e3 * self.rmse_fit:.3g} mm"
        effects = "+".join(self.effects) or "-"
        return self.problem or f"{self.verdict} | {effects} | {value:.4g} ({known}) | {rmse}"


def variants(
    config: Config, base: Row, changes: list[str], poses: int
) -> Iterator[tuple[str, Config]]:
    """Changed configurations by what is changed."""
    experiment, measurement = config.experiment, config.experiment.measurement

    def changed(**parts: Any) -> Config:
        return config.changed(experiment=experiment.changed(**parts))

    for name, factor in (("x 3", FACTOR), ("/ 3", 1 / FACTOR)):
        if "std" in changes:
            std = {"std": factor * (measurement.std or base.std)}
            yield f"std {name}", changed(measurement=measurement.changed(**std))
        if "tolerances" in changes:
            scaled = {k: factor * v for k, v in vars(experiment.tolerances).items()}
            tolerances = experiment.tolerances.changed(**scaled)
            yield f"tolerances {name}", changed(tolerances=tolerances)
        if "prior" in changes:
            prior = factor * config.cable.prior_bending_stiffness
            cable = {"bending_stiffness": prior, "youngs_modulus": None}
            yield (
                f"prior EI {name}",
                config.changed(cable=config.cable.changed(**cable)),
            )
        if "mesh" in changes:
            n = max(2 * round(factor * base.n / 2), 4)
            yield (
                f"{n} elements",
                config.changed(model=config.model.changed(n=n)),
            )
    fitted = [k for k, pose in enumerate(experiment.poses) if pose.role == "fit"]
    if "poses" in changes and len(fitted) > 1:
        for k in fitted[:: -(-len(fitted) // poses)]:
            # It was held all the same, and has changed the rest curvature of later poses.
            out = list(experiment.poses)
            out[k] = out[k].changed(role="held_out")
            yield f"without {out[k].name}", changed(poses=tuple(out))


def fitted(config: Config) -> Row:
    """Fit one variant."""
    try:
        outcome = run_session(config)
    except DloError as error:
        return Row("refused", problem=str(error).splitlines()[0])
    stage = outcome.stages[-1]
    estimate = stage.parameters["bending_stiffness"]
    return Row(
        str(outcome.verdict),
        tuple(effect.name for effect in outcome.effects),
        (estimate.value, *(estimate.interval_95 or (None, None))),
        stage.rmse_fit,
        any(f"than stage {stage.name}" in text for text in worse_than_simpler(outcome.stages)),
        outcome.measurement.std,
        outcome.fit.model.n,
    )


def check(session: Path, changes: list[str], chosen: argparse.Namespace) -> int:
    """Print a session's table; how many variants are not as the session itself."""
    config = load_config(session)
    estimation = config.estimation.changed(algorithm1=False)
    diagnosis = config.diagnosis.changed(enabled=not chosen.without_diagnosis)
    config = config.changed(estimation=estimation, diagnosis=diagnosis)
    base = fitted(config)
    print(f"{session.parent.name} | as it is | {base.text()}", flush=True)

    def line(case: tuple[str, Config], row: Row, _: float) -> str:
        return " | ".join([session.parent.name, case[0], row.text(), *row.against(base)])

    rows = run(fitted_variant, variants(config, base, changes, chosen.poses), chosen, line)
    return sum(bool(row.against(base)) for row in rows)


def fitted_variant(case: tuple[str, Config]) -> Row:
    """Fit one variant, given with its name."""
    return fitted(case[1])


def main() -> int:
    """Print all tables; 1 if any variant is not as its session."""
    parser = options(__doc__, jobs=True)
    parser.add_argument("folders", type=Path, nargs="+")
    parser.add_argument("--changes", default=",".join(CHANGES), help="those to try")
    parser.add_argument("--poses", type=int, default=8, help="at most so many are left out in turn")
    parser.add_argument("--without-diagnosis", action="store_true", help="EI alone, much faster")
    args = parser.parse_args()
    changes = args.changes.split(",")
    if unknown := set(changes) - set(CHANGES):
        parser.error(f"no change {', '.join(sorted(unknown))}: try {', '.join(CHANGES)}")
    bad = sessions = 0
    for folder in args.folders:
        own = folder / "session.yaml"
        for session in [own] if own.is_file() else sorted(folder.glob("*/session.yaml")):
            bad += check(session, changes, args)
            sessions += 1
    print(f"{sessions} sessions: {bad} variants with another verdict, a jump of EI or a worse fit")
    return 1 if bad or not sessions else 0


if __name__ == "__main__":
    sys.exit(main())
