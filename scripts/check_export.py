"""Fitted cables at rest in simulators, beside our prediction and the measurement.

    python scripts/check_export.py RESULTS=SESSION.yaml ... [--poses 3] [--to mujoco pyelastica
        newton usd] [--segments N]

RESULTS are folders of `dlo fit`. Of each cable the first held-out poses are relaxed, and fit poses
if too few were held out, with the stiffness of the simulator's own example, with the declared first
guess and with the identified cable. Exit code 1 if a shape of the identified cable is more than 1 %
of the length from our prediction although the target carries all of it, or if it is not the nearest
of the three to what was measured.
"""

from __future__ import annotations

import os
import sys
import time
from functools import partial
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

from harness import options, run

import dlo_casadi as dlo
from dlo_casadi.config import load_config
from dlo_casadi.export.targets import TARGETS
from dlo_casadi.report.round_trip import summary
from dlo_casadi.session.round_trip import CASES, round_trip

# Largest distance from our prediction, as a share of the length.
ALLOWED = 0.01


def main() -> int:
    """Relax all cables and print one line for each."""
    parser = options(__doc__, jobs=True)
    parser.add_argument("cables", nargs="+", metavar="RESULTS=SESSION.yaml")
    parser.add_argument("--poses", type=int, default=3)
    parser.add_argument("--segments", type=int)
    parser.add_argument("--to", nargs="+", choices=[*TARGETS], default=[*TARGETS])
    chosen = parser.parse_args()
    print(
        "errors in % of the length: largest from our prediction; RMS from measured, of",
        *CASES,
        "; end force from ours, and of the identified cable from readings",
    )
    cases = [(text, name) for text in chosen.cables for name in chosen.to]
    work = partial(relaxed, poses=chosen.poses, segments=chosen.segments)
    return int(not all(good for _, good in run(work, cases, chosen, lambda *found: found[1][0])))


def relaxed(case: tuple[str, str], poses: int, segments: int | None) -> tuple[str, bool]:
    """Lines of a cable in a simulator, and whether it is as it should be."""
    folder, _, session = case[0].partition("=")
    target, begin = TARGETS[case[1]], time.process_time()
    given = dlo.load(folder), load_config(session), target, segments, lambda *_: None
    rows = list(round_trip(*given, poses=poses))
    found = summary(rows)
    lost = {feature for row in rows for feature in row.lost}
    ours = found["identified"]["to_prediction"]
    measured = [found[case]["to_measured"] for case in CASES]
    largest = 100 * ours["largest"] if ours else float("inf")
    shares = [100 * x["rms"] if x else float("inf") for x in measured]
    forces, read = (
        [found[case][f"force_to_{key}"] for case in CASES] for key in ("prediction", "measured")
    )
    good = shares[2] == min(shares) and (largest <= 100 * ALLOWED or bool(lost))
    cells = [
        f"{Path(folder).name:12s} {target.title:10s} {rows[0].links:4d} links, "
        f"{len(rows) // 3} poses   {largest:7.3f}   ",
        *(f"{share:8.3f}" for share in shares),
        "  force [N]",
        *("     -" if f is None else f"{f:6.3g}" for f in forces),
        *(f"from readings {f:.3g}" for f in read[-1:] if f is not None),
        f"  {time.process_time() - begin:5.1f} s",
        "" if good else "  NOT AS IT SHOULD BE",
        f"  not carried: {', '.join(lost)}" if lost else "",
    ]
    problems = [f"    {case}: {text}" for case in CASES for text in found[case]["problems"]]
    return "\n".join([" ".join(cells), *problems]), good


if __name__ == "__main__":
    sys.exit(main())
