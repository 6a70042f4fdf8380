"""Time and error of the generated solver in space, over fourteen poses of a clamped cable."""

from __future__ import annotations

import ctypes
import shutil
import tempfile
from collections.abc import Sequence
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np
from cables.free import SpaceProblem
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from benchmarks.speed import FLAGS, HERE, summary
from dlo_casadi.codegen import CompiledSolver, generate
from dlo_casadi.codegen.compiler import compile_library, workspace_of
from dlo_casadi.codegen.shapes import pose_table, records_of
from dlo_casadi.effects import BendingSoftening, CableData
from dlo_casadi.equilibrium.pose import HeldPose
from dlo_casadi.model.cable_model import CableModel
from dlo_casadi.model.clips import HeldClip
from dlo_casadi.rod.supports import SupportKind

FloatArray = NDArray[np.floating]
# Elements of the mesh against which errors are measured: of fourth order, 1e-6 m and less.
FINE = 96
# The cable and the ends of the rendered session of markers in space; places [m], quaternions.
CABLE = CableData(0.6, 0.03, 0.004, 0.015, torsional_stiffness=0.011)
START = (0.4, -0.2, 0.3), (-0.480585, -0.087156, -0.095296, 0.867387)
ENDS = [
    ((0.74719, -0.43401, 0.40592), (0.382257, 0.048187, -0.181262, 0.904821)),
    ((0.70445, -0.24877, 0.28533), (-0.019251, -0.013436, 0.001364, 0.999723)),
    ((0.68366, -0.1154, 0.18282), (0.007981, 0.170074, 0.022079, 0.985152)),
    ((0.66228, -0.34145, 0.11238), (0.56894, 0.314861, -0.314834, 0.691411)),
    ((0.57354, 0.16749, 0.39342), (-0.144429, -0.233479, 0.671014, 0.688744)),
    ((0.61731, -0.65095, 0.23888), (-0.333233, 0.225503, -0.627699, 0.666407)),
    ((0.85449, -0.10142, 0.41625), (-0.47761, -0.028848, 0.466896, 0.743683)),
    ((0.54607, 0.11478, 0.19418), (-0.494563, 0.239912, 0.622616, 0.556956)),
    ((0.79658, -0.35028, 0.08085), (0.357292, 0.470428, -0.161182, 0.790607)),
    ((0.65576, -0.07941, 0.52353), (0.473641, -0.379694, 0.009338, 0.794613)),
    ((0.70951, -0.51979, 0.37982), (0.323647, -0.404163, -0.116912, 0.847489)),
    ((0.72862, -0.28813, -0.00225), (-0.22966, 0.426855, -0.139879, 0.863415)),
    ((0.56559, 0.05501, 0.42854), (-0.11798, -0.166167, 0.3749, 0.904389)),
    ((0.65141, -0.47903, 0.11108), (0.205104, 0.106403, -0.376811, 0.897009)),
]
GUESSES = 8  # most first guesses of a pose
SOFTNESS = 0.1  # of a softening cable [m]: half the moment at a bend of 10/m


def problem(n: int, element: str, bent: float = 1.0) -> SpaceProblem:
    """The cable on any mesh; `bent` times its rest curvature."""
    fine = CableModel(CABLE, FINE, "quadratic", "clamped", "clamped", (0.0, 0.0, -9.81))
    middle = fine.chain.cells.mean(axis=1) / CABLE.length
    bump = bent * np.exp(-(((middle - 0.5) / 0.4) ** 2)) / CABLE.length
    curved = np.concatenate([0.0 * bump, bump, 0.5 * bump])
    coefficients = np.linalg.lstsq(fine.rest_basis, curved, rcond=None)[0]
    model = fine.with_mesh(n, element)
    rest = model.rest_basis @ coefficients
    start, first = START
    poses = tuple(
        HeldPose(start, end, start_orientation=first, end_orientation=last) for end, last in ENDS
    )
    return SpaceProblem(model, model.nominal, rest, poses)


@lru_cache(maxsize=2)
def reference(bent: float = 1.0) -> tuple[FloatArray, ...]:
    """Points of all poses on the fine mesh."""
    fine = problem(FINE, "quadratic", bent)
    solver = CompiledSolver(fine.model, fine.model.nominal, fine.rest)
    return tuple(solver.solve(pose).points for pose in fine.poses)


def moved(pose: HeldPose, rng: np.random.Generator) -> HeldPose:
    """The pose whose end is 1 mm and 0.5 degrees away."""
    by, about = (v / np.linalg.norm(v) for v in rng.normal(size=(2, 3)))
    turn = Rotation.from_rotvec(np.radians(0.5) * about)
    frame = turn * Rotation.from_quat(pose.frames[1])
    return replace(
        pose,
        end=tuple(np.array(pose.end) + 1e-3 * by),
        end_orientation=tuple(frame.as_quat()),
    )


class Timed:
    """The compiled solver of a problem, with a bare Newton method beside it and a clock.

    Each of the copies of the library is timed: where one lies in memory alone makes it up to twice
    as slow.
    """

    def __init__(self, own: SpaceProblem, copies: int = 1) -> None:
        self.own = own
        source = generate(own.model, own.p, own.rest)
        texts = dict(source.files)
        parts = [
            texts["dlo_solver.c"],
            *((HERE / name).read_text() for name in ("timing.c", "bare_newton_space.c")),
        ]
        texts["dlo_solver.c"] = "#define _POSIX_C_SOURCE 199309L\n" + "".join(parts)
        begin = perf_counter()
        with tempfile.TemporaryDirectory(prefix="dlo_space_") as folder:
            library = compile_library(replace(source, files=texts), Path(folder), FLAGS)
            self.compile_seconds = perf_counter() - begin
            paths = [shutil.copy(library, f"{library}.{k}") for k in range(copies)]
            self._copies = [ctypes.CDLL(path) for path in paths]
        self._c = self._copies[0]
        pointer, size, number = ctypes.c_void_p, ctypes.c_size_t, ctypes.c_int
        for one in self._copies:
            for clock in (one.dlo_time, one.dlo_time_bare):
                clock.argtypes = [pointer, number, pointer, size, pointer, pointer, pointer]
        self._c.dlo_bare.argtypes = [pointer, number, pointer, pointer, pointer]
        self._work = np.empty(workspace_of(self._c))

    def solve(
        self, pose: HeldPose, warm: NDArray[np.void] | None, repeats: int
    ) -> tuple[FloatArray, NDArray[np.void]]:
        """Seconds (copies * repeats,) of solves, and the shape."""
        return self._run("dlo_time", pose, 0, warm, repeats)

    def bare(self, pose: HeldPose, which: int, warm: NDArray[np.void] | None) -> NDArray[np.void]:
        """Shape to which the bare method leads; zeros if it leads nowhere."""
        out = np.zeros(1, records_of(self.own.model).shape)
        at, _ = pose_table(self.own.model, [pose])
        self._c.dlo_bare(
            *(at.ctypes.data, which, None if warm is None else warm.ctypes.data),
            *(out.ctypes.data, self._work.ctypes.data),
        )
        return out

    def time_bare(
        self, pose: HeldPose, which: int, warm: NDArray[np.void] | None, repeats: int
    ) -> float:
        """Its least seconds."""
        return float(self._run("dlo_time_bare", pose, which, warm, repeats)[0].min())

    def _run(
        self,
        clock: str,
        pose: HeldPose,
        which: int,
        warm: NDArray[np.void] | None,
        repeats: int,
    ) -> tuple[FloatArray, NDArray[np.void]]:
        taken = np.zeros((len(self._copies), repeats))
        out = np.zeros(1, records_of(self.own.model).shape)
        at, _ = pose_table(self.own.model, [pose])
        for one, seconds in zip(self._copies, taken, strict=True):
            for _ in range(2):  # the first round fills the caches
                getattr(one, clock)(
                    *(at.ctypes.data, which, None if warm is None else warm.ctypes.data, repeats),
                    *(seconds.ctypes.data, out.ctypes.data, self._work.ctypes.data),
                )
        return taken.ravel(), out


def _same(shape: NDArray[np.void], other: NDArray[np.void]) -> bool:
    return bool(np.abs(shape["points"] - other["points"]).max() < 1e-4 * CABLE.length)


def timed(n: int, element: str, repeats: int = 20) -> dict[str, Any]:
    """Seconds of cold and warm solves, and the largest node error of each pose [m].

    `times_bare_newton` is the median of the quotients of the fastest times: of a warm start; of
    that first guess from which the bare method needs the fewest steps to the same shape, over the
    `poses` where one leads there; and of all first guesses, without which nobody knows which of
    several equilibria is the lowest.
    """
    own = Timed(problem(n, element))
    rng = np.random.default_rng(1)
    errors, seconds = [], {"cold": [], "warm": []}
    quotients: dict[str, list[float]] = {"warm": [], "best_guess": [], "all_guesses": []}
    every = FINE // n if FINE % n == 0 else 0
    for pose, fine in zip(own.own.poses, reference(), strict=True):
        cold, shape = own.solve(pose, None, repeats)
        near = moved(pose, rng)
        warm, close = own.solve(near, shape, repeats)
        seconds["cold"].append(cold)
        seconds["warm"].append(warm)
        if every:
            gaps = np.linalg.norm(shape["points"][0] - fine[::every], axis=1)
            errors.append(float(gaps.max()))
        if _same(close, own.bare(near, 0, shape)):
            quotients["warm"].append(warm.min() / own.time_bare(near, 0, shape, repeats))
        bare = [own.time_bare(pose, k, None, repeats) for k in range(GUESSES)]
        quotients["all_guesses"].append(cold.min() / sum(bare))
        there = [k for k in range(GUESSES) if _same(shape, own.bare(pose, k, None))]
        if there:
            quotients["best_guess"].append(cold.min() / min(bare[k] for k in there))
    found: dict[str, Any] = {"compile_seconds": own.compile_seconds}
    for kind, rows in seconds.items():
        best = float(np.median([row.min() for row in rows]))
        found[kind] = {**summary(np.concatenate(rows)), "best": best}
        found[kind]["p99_over_median"] = found[kind]["p99"] / found[kind]["median"]
    found["times_bare_newton"] = {
        name: {"median": float(np.median(row)), "poses": len(row)} if row else None
        for name, row in quotients.items()
    }
    if errors:
        found["error"] = {"median": float(np.median(errors)), "largest": max(errors)}
    return found


def per_element(n: int, element: str) -> float:
    """Median over the poses of the fastest cold solve, over n [s]."""
    own, repeats = Timed(problem(n, element)), max(3, 100 // n)
    fastest = [own.solve(pose, None, repeats)[0].min() for pose in own.own.poses]
    return float(np.median(fastest)) / n


def softening(n: int) -> dict[str, float]:
    """Median over the poses of the fastest cold solve [s]: the cable, and one that softens."""
    plain = problem(n, "quadratic")
    model = plain.model.with_effect(BendingSoftening())
    p = model.nominal.copy()
    p[model.names.index("bending_softening.softness")] = SOFTNESS
    found = {}
    for name, own in (("plain", plain), ("softening", replace(plain, model=model, p=p))):
        solver = Timed(own, copies=3)
        found[name] = float(np.median([solver.solve(x, None, 20)[0].min() for x in own.poses]))
    return found


def near(kinds: Sequence[str], n: int = 12) -> tuple[HeldPose, ...]:
    """The poses with clips evenly along the cable, 0.1 % of its length off its shape without."""
    plain, rng, length = problem(n, "quadratic"), np.random.default_rng(0), CABLE.length
    bare = CompiledSolver(plain.model, plain.model.nominal, plain.rest)
    nodes, poses = [round(n * (k + 1) / (len(kinds) + 1)) for k in range(len(kinds))], []
    for pose in plain.poses:
        shape, clips = bare.solve(pose), []
        for kind, node in zip(kinds, nodes, strict=True):
            off = rng.normal(size=3)
            place = shape.points[node] + 1e-3 * length * off / np.linalg.norm(off)
            frame = tuple(shape.x[node]) if SupportKind(kind).direction else None
            at = None if kind == "eyelet" else node * length / n
            clips.append(HeldClip(kind, tuple(place), at, orientation=frame))
        poses.append(replace(pose, clips=tuple(clips)))
    return tuple(poses)


def slack(kinds: Sequence[str], count: int = 100) -> tuple[HeldPose, ...]:
    """Random poses whose spans have chords of 55 to 95 % of their lengths."""
    rng, many, length = np.random.default_rng(7), len(kinds), CABLE.length
    poses = []
    for _ in range(count):
        at = (np.arange(1, many + 1) + rng.uniform(-0.3, 0.3, many)) / (many + 1) * length
        ways = _unit(rng.normal(size=3)) + 0.5 * rng.normal(size=(many + 1, 3))
        ways /= np.linalg.norm(ways, axis=1)[:, None]
        spans = np.diff([0.0, *at, length]) * rng.uniform(0.55, 0.95, many + 1)
        places = np.cumsum(spans[:, None] * ways, axis=0)
        clips = [
            HeldClip(
                kind,
                tuple(places[k]),
                None if kind == "eyelet" else float(at[k]),
                orientation=_facing(ways[k] + ways[k + 1], rng)
                if SupportKind(kind).direction
                else None,
            )
            for k, kind in enumerate(kinds)
        ]
        frames = {"start_orientation": _facing(ways[0], rng)}
        frames["end_orientation"] = _facing(ways[-1], rng)
        poses.append(HeldPose((0.0, 0.0, 0.0), tuple(places[-1]), clips=tuple(clips), **frames))
    return tuple(poses)


def _unit(v: FloatArray) -> FloatArray:
    return np.asarray(v / np.linalg.norm(v))


def _facing(way: FloatArray, rng: np.random.Generator) -> tuple[float, ...]:
    """A quaternion whose x axis points about that way, with any roll."""
    turn, _ = Rotation.align_vectors([_unit(way)], [[1.0, 0.0, 0.0]])
    rolled = turn * Rotation.from_rotvec([rng.uniform(-np.pi, np.pi), 0.0, 0.0])
    return tuple((Rotation.from_rotvec(0.3 * rng.normal(size=3)) * rolled).as_quat())


@lru_cache(maxsize=2)
def _held(kinds: tuple[str, ...]) -> Timed:
    """The solver of the cable in clips of these kinds."""
    plain = problem(12, "quadratic")
    return Timed(replace(plain, model=replace(plain.model, clips=kinds), poses=()), copies=3)


def clipped(kinds: tuple[str, ...], poses: Sequence[HeldPose], rounds: int = 2) -> dict[str, float]:
    """Processor time of solves over that of the same ends without clips, cold and warm.

    Of all poses together, and the median of theirs, of the fastest solves of both, which take
    turns. With Newton steps of cold ones, and the share that is solved.
    """
    rng, steps = np.random.default_rng(1), []
    seconds: dict[str, list[NDArray[np.floating]]] = {"cold": [], "warm": []}
    for pose in poses:
        close, fastest = moved(pose, rng), np.full((2, 2), np.inf)
        for _ in range(rounds):
            for k, (solver, clips) in enumerate(((_held(()), False), (_held(kinds), True))):
                here, there = (p if clips else replace(p, clips=()) for p in (pose, close))
                cold, shape = solver.solve(here, None, 2)
                warm = solver.solve(there, shape, 2)[0]
                fastest[:, k] = np.minimum(fastest[:, k], (cold.min(), warm.min()))
        if shape["min_bend_radius"][0] > 0:
            steps.append(int(shape["iterations"][0]))
            for row, own in zip(seconds.values(), fastest, strict=True):
                row.append(own)
    found = {}
    for name, rows in seconds.items():
        without, with_clips = np.transpose(rows)
        found[name] = float(with_clips.sum() / without.sum())
        found[f"{name}_median"] = float(np.median(with_clips / without))
    return found | {"steps": float(np.median(steps)), "solved": len(steps) / len(poses)}
