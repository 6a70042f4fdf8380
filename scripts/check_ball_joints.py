"""Clean sessions of cables in space whose rest shape and twist are hard to tell, from another rod.

    python scripts/check_ball_joints.py [--count 40] [--first 0] [--seed 0] [--jobs N]
        [--wires | --swivels | --slides] [--keep FOLDER] [--output FILE]

Each session is a cable between two ball joints, curved at rest about both axes by 0.2 to 1.5 over
its length: seven fitted poses and two held out, markers and lines in turn, 0.3 mm of white noise,
ends within 0.1 mm of where they are declared. Nothing holds its roll about its own axis, so that
the same shapes have equilibria that are saddles of the energy.

With --swivels one end or both hold the direction, too: the other one is a clamp.

With --slides a straight cable is fed through one of its ends, from pose to pose another length of
it; the other end is a clamp. In every third session the tension beyond the end is known, in the
others free lengths are estimated. Lines and markers in turn.

With --wires a session is a light wire twisted by 1 to 2 turns between two clamps that are known to
0.05 rad: three or four fitted poses, 11 to 16 points each with 3 mm of noise, 4 mm declared.

The rod is one of straight segments in IPOPT, see straight_segments.py. A row for each session:
verdict, poses whose equilibrium is not stable, EI with its interval, errors of fitted and held-out
poses on their measured branch, and the noise. The exit status is 1 if a session between ball joints
is not complete or has an unstable pose; of a wire, if a pose is unstable.
"""

from __future__ import annotations

import os
import sys
import tempfile
import time
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np
from harness import options, run
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from straight_segments import Ends, SegmentRod

import dlo_casadi as dlo
from dlo_casadi.config import dump_yaml
from dlo_casadi.io.points import write_points
from dlo_casadi.runtime.parallel import generator_of

FloatArray = NDArray[np.floating]

G = 9.81  # m/s^2
SIDES = ("start", "end")
STD, END_STD, FRAME_STD = 3e-4, 1e-4, 2e-3  # m, m, rad
SWIVELS = (("clamped", "swivel"), ("swivel", "clamped"), ("swivel", "swivel"))
# Share of the free length by which it is changed for the derivative of the energy.
LONGER = 2e-3
WIRE_STD, WIRE_DECLARED, CLAMP_STD = 3e-3, 4e-3, 0.03  # m, m, rad
# Segments of the rod: nodes of 60 lie within 0.02 mm of those of 240 (0.6 m, bent by 1.5 / m).
SEGMENTS = {False: 60, True: 80}
STARTS = 6
# Energy [EI / L] by which an equilibrium has to lie below all others that were found.
GAP = 0.05
TITLE = (
    f"{'session':9s} {'verdict':13s} {'unstable':8s} {'EI / true':>9s} {'95 % interval':>16s} "
    f"{'fit':>6s} {'held out':>8s} {'noise':>6s} mm {'s':>5s}"
)


@dataclass(frozen=True)
class Row:
    """What was found of one session; distances in metres."""

    name: str
    verdict: str
    unstable: int
    stiffness: float
    interval: tuple[float | None, float | None] | None
    fit: float | None
    held_out: float | None
    noise: float
    seconds: float

    @property
    def inside(self) -> bool:
        """Whether the interval of EI, over its truth, holds the truth."""
        low, high = self.interval or (np.inf, None)
        return (low is None or low <= 1) and (high is None or high >= 1)

    @property
    def text(self) -> str:
        """One line of the table."""
        ends = ["-" if x is None else f"{x:.3f}" for x in self.interval or (None, None)]
        errors = ["-" if x is None else f"{1e3 * x:.2f}" for x in (self.fit, self.held_out)]
        return (
            f"{self.name:9s} {self.verdict:13s} {self.unstable:8d} {self.stiffness:9.3f} "
            f"{' to '.join(ends):>16s} {errors[0]:>6s} {errors[1]:>8s} {1e3 * self.noise:6.2f}    "
            f"{self.seconds:5.0f}{'' if self.inside else '  EI outside'}"
        )


def between_ball_joints(index: int, generator: np.random.Generator, folder: Path) -> float:
    """Write a session of a curved cable between two ball joints; its EI."""
    return curved(("pinned", "pinned"), index, generator, folder)


def between_swivels(index: int, generator: np.random.Generator, folder: Path) -> float:
    """Write a session of a curved cable of which a swivel holds one end, or both; its EI."""
    return curved(SWIVELS[index % len(SWIVELS)], index, generator, folder)


def curved(
    held: tuple[str, str], index: int, generator: np.random.Generator, folder: Path
) -> float:
    """Write a session of a cable that is curved at rest, held so; its EI."""
    length, mass = generator.uniform(0.4, 0.8), generator.uniform(0.03, 0.06)
    spread = np.exp(generator.uniform(*np.log([0.04, 0.3])))
    bending = mass * G * length**2 * spread
    u = (np.arange(SEGMENTS[False]) + 0.5) / SEGMENTS[False]
    kinds = np.array([np.ones_like(u), np.exp(-(((u - 0.5) / 0.3) ** 2)), 1.6 * u, 1.6 * (1 - u)])
    sizes = (
        np.exp(generator.uniform(*np.log([0.2, 1.5]), 2)) * generator.choice([-1, 1], 2) / length
    )
    rest = sizes[:, None] * kinds[generator.integers(0, len(kinds), 2)]
    rod = SegmentRod(
        length,
        np.array([0, 0, -mass * G]),
        bending,
        bending * generator.uniform(0.55, 0.85),
        rest,
        clamped="pinned" not in held,
        rolls=(held[0] == "swivel", held[1] == "swivel"),
    )
    start, poses = generator.uniform(-0.2, 0.3, 3).round(3), []
    while len(poses) < 9:
        way = generator.standard_normal(3) * [1.0, 1.0, 0.7]
        chord = generator.uniform(0.55, 0.9) * length * way / np.linalg.norm(way)
        end = (start + chord).round(5)
        true = Ends(start, end + END_STD * generator.standard_normal(3))
        frames: list[Rotation] = []
        if rod.clamped:
            along, _ = Rotation.align_vectors([chord], [[1.0, 0.0, 0.0]])
            turns = generator.uniform(-1.0, 1.0, (2, 3)) * [3.0, 0.6, 0.6]
            frames = [along * Rotation.from_rotvec(turn) for turn in turns]
            off = FRAME_STD * generator.standard_normal((2, 3))
            true = replace(
                true,
                frames=tuple(
                    (frame * Rotation.from_rotvec(one)).as_quat()
                    for frame, one in zip(frames, off, strict=True)
                ),
            )
        nodes = rod.shape(true, STARTS, GAP)
        if nodes is None:
            continue
        marked = index % 2 == 0
        s = np.linspace(0.05, 0.95, 12 if marked else 60) * length
        points = rod.points(nodes, s) + STD * generator.standard_normal((len(s), 3))
        name = f"p{len(poses)}.csv"
        write_points(folder / name, points, s if marked else None)
        role = "held_out" if len(poses) in (3, 7) else "fit"
        poses.append({"file": name, "start": start.tolist(), "end": end.tolist(), "role": role})
        declared_frames = zip(SIDES, frames, strict=bool(frames))
        poses[-1] |= {f"{k}_orientation": f.as_quat().tolist() for k, f in declared_frames}
    declared = bending * float(np.exp(generator.uniform(-0.7, 0.7)))
    cable = {"length": length, "mass": mass, "diameter": 0.004, "bending_stiffness": declared}
    write(folder, cable, held, STD, poses)
    return bending


def fed(index: int, generator: np.random.Generator, folder: Path) -> float:
    """Write a session of a straight cable that is fed through one of its ends; its EI."""
    length, mass = generator.uniform(0.4, 0.8), generator.uniform(0.03, 0.06)
    bending = mass * G * length**2 * np.exp(generator.uniform(*np.log([0.04, 0.3])))
    torsion, known = bending * generator.uniform(0.55, 0.85), index % 3 == 0
    held = ("slide", "clamped") if index % 3 == 2 else ("clamped", "slide")
    rolls = held[0] == "slide", held[1] == "slide"
    start, poses = generator.uniform(-0.2, 0.3, 3).round(3), []
    while len(poses) < 9:
        free = length * generator.uniform(0.75, 1.25)
        way = generator.standard_normal(3) * [1.0, 1.0, 0.7]
        chord = generator.uniform(0.6, 0.93) * free * way / np.linalg.norm(way)
        end = (start + chord).round(5)
        along, _ = Rotation.align_vectors([chord], [[1.0, 0.0, 0.0]])
        turns = generator.uniform(-0.7, 0.7, (2, 3)) * [3.0, 1.0, 1.0]
        frames = [along * Rotation.from_rotvec(turn) for turn in turns]
        off = FRAME_STD * generator.standard_normal((2, 3))
        both = (f * Rotation.from_rotvec(e) for f, e in zip(frames, off, strict=True))
        ends = Ends(
            start,
            end + END_STD * generator.standard_normal(3),
            frames=tuple(one.as_quat() for one in both),
        )
        weight, still = np.array([0, 0, -mass * G]) / length, np.zeros((2, SEGMENTS[False]))
        rods = [
            SegmentRod(own, own * weight, bending, torsion, still, clamped=True, rolls=rolls)
            for own in (free, *((1 + LONGER) * free, (1 - LONGER) * free) * known)
        ]
        nodes = rods[0].shape(ends, STARTS, GAP)
        if nodes is None:
            continue
        pose: dict[str, Any] = {}
        if known:
            # Of the energies E(l): T = -dE/dl - the work of the weight that enters; least there.
            here, longer, shorter = (rod.energy(ends, STARTS) for rod in rods)
            tension = (shorter - longer) / (2 * LONGER * free) - weight @ chord
            if not (np.isfinite(tension) and shorter + longer - 2 * here > 0):
                continue
            pose["end_tension"] = float(tension)
        marked = index % 2 == 1
        s = np.linspace(0.03, 0.97, 12 if marked else 60) * free
        points = rods[0].points(nodes, s) + STD * generator.standard_normal((len(s), 3))
        name = f"p{len(poses)}.csv"
        s += (length - free) * (held[0] == "slide")  # as if it had not been fed
        write_points(folder / name, points, s if marked else None)
        pose |= {"file": name, "start": start.tolist(), "end": end.tolist()}
        pose |= {
            f"{k}_orientation": f.as_quat().tolist() for k, f in zip(SIDES, frames, strict=True)
        }
        poses.append(pose | {"role": "held_out" if len(poses) in (3, 7) else "fit"})
    declared = bending * float(np.exp(generator.uniform(-0.7, 0.7)))
    cable = {"length": length, "mass": mass, "diameter": 0.004, "bending_stiffness": declared}
    write(folder, cable | {"rest_shape": "straight"}, held, STD, poses)
    return bending


def twisted_wire(index: int, generator: np.random.Generator, folder: Path) -> float:
    """Write a session of a twisted wire between two clamps, known to 0.05 rad; its EI."""
    length, mass = generator.uniform(0.35, 0.5), generator.uniform(0.006, 0.012)
    bending = mass * G * length**2 * np.exp(generator.uniform(*np.log([0.04, 0.1])))
    u = (np.arange(SEGMENTS[True]) + 0.5) / SEGMENTS[True]
    rest = generator.normal(0.0, 0.3, (2, 2)) @ [np.ones_like(u), u - 0.5] / length
    rod = SegmentRod(
        length,
        np.array([0, 0, -mass * G]),
        bending,
        bending * generator.uniform(0.7, 1.1),
        rest,
        clamped=True,
    )
    poses: list[dict[str, Any]] = []
    count, off = 3 + index % 2, Rotation.from_rotvec(CLAMP_STD * generator.standard_normal((2, 3)))
    while len(poses) < count:
        turns = float(generator.choice([-1, 1]) * generator.choice([1.0, 1.5, 2.0]))
        way = Rotation.from_rotvec(generator.uniform(-0.5, 0.5, 3)).apply([1.0, 0.0, 0.0])
        end = (generator.uniform(0.65, 0.88) * length * way).round(4)
        last = Rotation.from_rotvec(generator.uniform(-0.6, 0.6, 3))
        half = turns % 1.0
        last = last * Rotation.from_rotvec([2 * np.pi * half, 0.0, 0.0])
        frames = Rotation.identity(), last
        true = tuple((frame * error).as_quat() for frame, error in zip(frames, off, strict=True))
        nodes = rod.shape(Ends(np.zeros(3), end, true, turns), STARTS, GAP)
        if nodes is None:
            continue
        s = np.linspace(0.08, 0.92, generator.integers(11, 17)) * length
        points = rod.points(nodes, s) + WIRE_STD * generator.standard_normal((len(s), 3))
        name = f"p{len(poses)}.csv"
        write_points(folder / name, points, None)
        pose: dict[str, Any] = {"file": name, "start": [0.0, 0.0, 0.0], "end": end.tolist()}
        pose |= {
            f"{k}_orientation": f.as_quat().tolist() for k, f in zip(SIDES, frames, strict=True)
        }
        poses.append(pose | {"turns": turns, "role": "fit"})
    declared = bending * float(np.exp(generator.uniform(-0.5, 0.5)))
    cable = {"length": length, "mass": mass, "diameter": 0.0035, "bending_stiffness": declared}
    write(folder, cable | {"rest_shape": "straight"}, ("clamped", "clamped"), WIRE_DECLARED, poses)
    return bending


def write(
    folder: Path,
    cable: dict[str, Any],
    held: tuple[str, str],
    std: float,
    poses: list[dict[str, Any]],
) -> None:
    """Write session.yaml."""
    experiment = {
        "gravity": [0.0, 0.0, -G],
        "boundary": dict(zip(SIDES, held, strict=True)),
        "measurement": {"kind": "centerlines", "std": std},
        "poses": poses,
    }
    document = {"cable": {"name": folder.name, **cable}, "experiment": experiment}
    (folder / "session.yaml").write_text(dump_yaml(document), encoding="utf-8")


DRAWS = {
    "balls": between_ball_joints,
    "swivels": between_swivels,
    "slides": fed,
    "wire": twisted_wire,
}


def fitted(index: int, seed: int, kind: str, keep: Path) -> Row:
    """Simulate and fit one session."""
    folder = keep / f"{kind}_{index:02d}"
    folder.mkdir(parents=True, exist_ok=True)
    true = DRAWS[kind](index, generator_of(seed, index), folder)
    began = time.process_time()
    result = dlo.fit(folder / "session.yaml")
    seconds, stage = time.process_time() - began, result.stages[-1]
    found = stage.parameters["bending_stiffness"]
    ends = found.interval_95 and tuple(None if x is None else x / true for x in found.interval_95)
    return Row(
        folder.name,
        str(result.verdict),
        int((~result.fit.stable).sum()),
        found.value / true,
        ends,
        stage.rmse_fit_measured_branch,
        stage.rmse_held_out,
        result.measurement.noise_distance,
        seconds,
    )


def main() -> int:
    """Print the table and its counts."""
    count = 40, "number of sessions"
    parser = options(__doc__, count=count, first=True, seed=0, jobs=True, output=True)
    parser.add_argument("--wires", dest="kind", action="store_const", const="wire")
    parser.add_argument("--swivels", dest="kind", action="store_const", const="swivels")
    parser.add_argument("--slides", dest="kind", action="store_const", const="slides")
    parser.set_defaults(kind="balls")
    parser.add_argument("--keep", type=Path, metavar="FOLDER", help="sessions stay there")
    chosen = parser.parse_args()
    print(TITLE, flush=True)
    with tempfile.TemporaryDirectory() as folder:
        work = partial(fitted, seed=chosen.seed, kind=chosen.kind, keep=chosen.keep or Path(folder))
        cases = range(chosen.first, chosen.first + chosen.count)
        rows = run(work, cases, chosen, lambda case, row, seconds: row.text)
    complete = sum(row.verdict == "complete" for row in rows)
    stable = sum(not row.unstable for row in rows)
    over = [row.held_out / row.noise for row in rows if row.held_out is not None]
    print(
        f"{len(rows)} sessions: {complete} complete, {stable} with all fit poses stable, EI inside "
        f"in {sum(row.inside for row in rows)}"
        + (f", held out {np.median(over):.2f} x noise, at most {max(over):.2f}" if over else "")
    )
    return int(stable < len(rows) or (chosen.kind != "wire" and complete < len(rows)))


if __name__ == "__main__":
    sys.exit(main())
