"""A rendered video of a cable that is pulled aside and let go: damping and EI from its frames.

    python scripts/check_video.py [--count 3] [--seed 1] [--duration 2] [--frames 60] [--blur 0.004]

Photographs of five shapes at rest and a video (MJPEG in AVI, 60 frames a second, each exposed for
1/250 s) of a board with four markers are drawn by the tests' own drawing, which shares nothing with
the vision. The motion is simulated with 40 elements, the fit uses fewer. Each session writes its
files to a temporary folder and is fitted like any other.

Exit code 1 if a damping is off by more than 10 % or 3 std, if EI lies outside of its interval, or
if the verdict is not `complete`: nothing is hidden.
"""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path
from time import process_time
from typing import Any, NamedTuple

import cv2
import numpy as np
from harness import options, run
from scipy.ndimage import gaussian_filter

import dlo_casadi as dlo
from dlo_casadi.arrays import FloatArray

sys.path.append(str(Path(__file__).parents[1] / "tests" / "vision"))
import drawing

drawing.SCALE, drawing.CORNER = 1100.0, np.array([400.5, 80.5])
SHAPE, SIDE, START = (800, 800), 0.06, (0.0, 0.0)
CENTERS = {0: (-0.3, 0.0), 1: (0.3, 0.0), 2: (-0.3, -0.58), 3: (0.3, -0.58)}
# Pictures that are averaged over an exposure; noise of a pixel, grey levels.
DRAWN, NOISE = 4, 2.0


class Case(NamedTuple):
    """A session."""

    seed: int
    duration: float
    rate: float
    exposure: float

    def __str__(self) -> str:
        return f"video {self.seed}"


class Row(NamedTuple):
    """Damping and EI over the truth, their std over the truth, and what was left out."""

    damping: float
    damping_std: float
    stiffness: float
    stiffness_std: float
    inside: bool
    found: tuple[str, ...]
    verdict: str
    held: float
    note: str
    seconds: float

    @property
    def right(self) -> bool:
        """Whether damping and EI are as they should be, and nothing is missing."""
        off, complete = abs(self.damping - 1), self.verdict == "complete"
        return self.inside and off < 0.1 and off < 3 * self.damping_std and complete


def board() -> FloatArray:
    """A grey board with its markers (H, W, 3)."""
    picture = np.full((*SHAPE, 3), (190.0, 185.0, 180.0))
    words = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)
    size = round(SIDE * drawing.SCALE)
    for number, center in CENTERS.items():
        marker = cv2.aruco.generateImageMarker(words, number, size)
        # Pixels are counted at their middles.
        u, v = np.round(drawing.to_pixels(center) - (size - 1) / 2).astype(int)
        margin = size // 6
        picture[v - margin : v + size + margin, u - margin : u + size + margin] = 235.0
        picture[v : v + size, u : u + size] = marker[..., None]
    return picture


def exposed(lines: FloatArray, width: float, random: np.random.Generator) -> FloatArray:
    """A picture of a cable that moves through lines (K, N, 2) while it is exposed."""
    behind, kept = board(), {"width_px": width * drawing.SCALE, "shape": SHAPE}
    plain = {"blur": 0.0, "noise": 0.0, "onto": behind, **kept}
    picture = np.mean([drawing.draw(line, **plain) for line in lines], axis=0)
    picture = gaussian_filter(picture, (0.7, 0.7, 0))
    noisy = picture + NOISE * random.standard_normal(picture.shape)
    return np.clip(np.round(noisy), 0, 255).astype(np.uint8)


def work(case: Case) -> Row:
    """One session."""
    random, begun = np.random.default_rng(case.seed), process_time()
    mass = random.uniform(0.03, 0.05)
    own = {"length": 0.5, "mass": mass, "diameter": random.uniform(0.006, 0.009)}
    stiffness = mass * 9.81 * 0.5**2 * 10 ** random.uniform(-1.3, -0.8)
    damping = random.uniform(0.015, 0.035)
    known: dict[str, Any] = {"gravity": (0.0, -9.81), "model": {"n": 40}}
    true = dlo.Cable(**own, bending_stiffness=stiffness)
    cable = dlo.known_cable(true, **known, boundary=("clamped", "free")).with_damping(damping)
    tied = dlo.known_cable(true, **known, boundary=("clamped", "pinned"))
    with tempfile.TemporaryDirectory() as name:
        folder, poses = Path(name), []
        for k, angle in enumerate((-1.9, -1.4, -1.1, -0.8, -2.2)):
            held: dict[str, Any] = {"start": START, "start_heading": angle}
            points = cable.solve(**held).curve.at(np.linspace(0.0, 0.5, 400))
            file = folder / f"pose_{k}.png"
            cv2.imwrite(str(file), exposed(points[None], own["diameter"], random))
            poses.append(dlo.Pose(file=file, **held))
        held = {"start": START, "start_heading": -1.5}
        aside = tied.solve(**held, end=(random.uniform(0.12, 0.2), -0.42))
        frames = np.arange(0.0, case.duration, 1 / case.rate)
        within = (np.arange(DRAWN) + 0.5) / DRAWN * case.exposure
        t = np.append(0.0, (frames[:, None] + within).ravel())
        moved = cable.simulate(t, begins=aside, **held).at(np.linspace(0.0, 0.5, 400))[1:]
        file = folder / "swing.avi"
        writer = cv2.VideoWriter(str(file), cv2.VideoWriter.fourcc(*"MJPG"), case.rate, SHAPE[::-1])
        for lines in moved.reshape(len(frames), DRAWN, -1, 2):
            writer.write(exposed(lines, own["diameter"], random))
        writer.release()
        shown = {"dictionary": "DICT_4X4_50", "marker_size": SIDE, "marker_centers": CENTERS}
        session = dlo.Session(
            dlo.Cable(**own, bending_stiffness=stiffness * random.uniform(0.7, 1.4)),
            poses,
            motions=[dlo.Motion(file=file, **held)],
            gravity=known["gravity"],
            boundary=("clamped", "free"),
            board=shown,
        )
        found = session.fit()
    values = [found.params[key] for key in ("damping_time", "bending_stiffness")]
    low, high = values[1].interval_95 or (None, None)
    told = [
        number / truth
        for item, truth in zip(values, (damping, stiffness), strict=True)
        for number in (item.value, item.std or np.nan)
    ]
    last = found.stages[-1].motion
    return Row(
        *told,
        (low or 0.0) <= stiffness <= (np.inf if high is None else high),
        tuple(effect.name for effect in found.effects),
        found.verdict or "",
        np.nan if last is None else last.rmse_fit,
        "" if last is None else last.shown[0].note,
        process_time() - begun,
    )


def line(case: Case, row: Row, seconds: float) -> str:
    """One line of the table."""
    return (
        f"{case}: damping {row.damping:.3f} +- {row.damping_std:.3f} of the truth, EI "
        f"{row.stiffness:.4f} +- {row.stiffness_std:.4f} ({'inside' if row.inside else 'OUTSIDE'}),"
        f" found {', '.join(row.found) or 'nothing'} ({row.verdict}), RMS "
        f"{1e3 * row.held:.3f} mm; {row.note}; "
        f"{row.seconds:.0f} s{'' if row.right else '  WRONG'}"
    )


def main() -> int:
    """Run the sessions; the exit code."""
    parser = options(__doc__, count=(3, "sessions"), seed=1, jobs=True, output=True)
    parser.add_argument("--duration", type=float, default=2.0, help="of the video [s]")
    parser.add_argument("--frames", type=float, default=60.0, help="frames a second")
    parser.add_argument("--blur", type=float, default=1 / 250, help="exposure [s]")
    chosen = parser.parse_args()
    seeds = range(chosen.seed, chosen.seed + chosen.count)
    cases = [Case(seed, chosen.duration, chosen.frames, chosen.blur) for seed in seeds]
    rows = run(work, cases, chosen, line)
    return int(not all(row.right for row in rows))


if __name__ == "__main__":
    sys.exit(main())
