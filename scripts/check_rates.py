"""What a recording of a rope that is let go tells, by its rate, its markers and its length.

    python scripts/check_rates.py [--seed 1] [--jobs N]

A rope of 0.6 m is clamped at its start; its tip is pulled to PULLED, 0.35 m aside, and let go. Four
shapes at rest are measured, too. All are simulated on a mesh twice as fine as that of the fit. Each
line is one recording; exit code 1 if damping or EI is more than three standard deviations off.
"""

from __future__ import annotations

import sys
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from harness import options, run

import dlo_casadi as dlo

LENGTH, STIFFNESS, DAMPING, STD, PULLED = 0.6, 0.009, 0.03, 5e-4, (0.35, -0.4)
KNOWN: dict[str, Any] = {"gravity": (0.0, -9.81), "boundary": ("clamped", "free")}
HELD: dict[str, Any] = {"start": (0.0, 0.0), "start_heading": -1.2}


class Recording(NamedTuple):
    """Pictures a second, number of markers, and seconds."""

    rate: float
    markers: int
    seconds: float

    def __str__(self) -> str:
        return f"{self.rate:g} | {self.markers} | {self.seconds:g}"


RECORDINGS = [
    *(Recording(rate, 6, 2.0) for rate in (30, 60, 100, 240)),
    *(Recording(100, markers, 2.0) for markers in (2, 12)),
    *(Recording(100, 6, seconds) for seconds in (1.0, 5.0)),
]


class Row(NamedTuple):
    """Damping [s] and EI [N m^2] with their standard deviations."""

    damping: float
    damping_std: float
    stiffness: float
    stiffness_std: float


def work(recording: Recording, seed: int) -> Row:
    """Simulate and fit one recording."""
    random, own = np.random.default_rng(seed), {"length": LENGTH, "mass": 0.06, "diameter": 0.008}
    true = dlo.Cable(**own, bending_stiffness=STIFFNESS)
    cable = dlo.known_cable(true, **KNOWN, model={"n": 40}).with_damping(DAMPING)
    tied = dlo.known_cable(true, gravity=KNOWN["gravity"], boundary=("clamped", "pinned"))
    s = np.linspace(0.0, LENGTH, recording.markers + 1)[1:]

    def noisy(points: np.ndarray) -> np.ndarray:
        return points + STD * random.normal(size=points.shape)

    poses = []
    for angle in (-1.9, -1.4, -0.9, -0.4):
        held = {**HELD, "start_heading": angle}
        poses.append(dlo.Pose(points=noisy(cable.solve(**held).curve.at(s)), at=s, **held))
    aside = tied.solve(**HELD, end=PULLED)
    t = np.arange(0.0, recording.seconds, 1 / recording.rate)
    points = noisy(cable.simulate(t, begins=aside, **HELD).at(s))
    session = dlo.Session(
        dlo.Cable(**own, bending_stiffness=1.2 * STIFFNESS),
        poses,
        motions=[dlo.Motion(t=t, points=points, at=s, **HELD)],
        std=STD,
        diagnosis={"enabled": False},
        **KNOWN,
    )
    found = session.fit()
    damping, stiffness = (found.params[x] for x in ("damping_time", "bending_stiffness"))
    return Row(damping.value, damping.std or 0.0, stiffness.value, stiffness.std or 0.0)


def line(recording: Recording, row: Row, seconds: float) -> str:
    """One line of the table."""
    return (
        f"| {recording} | {row.damping:.4f} s | {100 * row.damping_std / DAMPING:.1f} % | "
        f"{row.stiffness:.5f} | {100 * row.stiffness_std / STIFFNESS:.2f} % | ({seconds:.0f} s)"
    )


def main() -> int:
    """Fit the recordings; the exit code."""
    chosen = options(__doc__, seed=1, jobs=True).parse_args()
    print("| pictures/s | markers | seconds | tau | std of tau | EI [N m^2] | std of EI |")
    rows = run(partial(work, seed=chosen.seed), RECORDINGS, chosen, line)
    off = [
        abs(value - true) > 3 * std
        for row in rows
        for value, std, true in (
            (row.damping, row.damping_std, DAMPING),
            (row.stiffness, row.stiffness_std, STIFFNESS),
        )
    ]
    return int(any(off))


if __name__ == "__main__":
    sys.exit(main())
