"""Time per solve against n, over the paper's twelve poses."""

from __future__ import annotations

import ctypes
import shutil
import subprocess
import tempfile
from dataclasses import replace
from pathlib import Path
from threading import Thread
from time import perf_counter, process_time
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize

from dlo_casadi.codegen import CompiledSolver, generate
from dlo_casadi.codegen.compiler import compile_library, workspace_of
from dlo_casadi.effects import CableData
from dlo_casadi.equilibrium.guesses import arc_headings
from dlo_casadi.equilibrium.pose import HeldPose
from dlo_casadi.model.cable_model import CableModel
from dlo_casadi.model.whole_pose import potential

FloatArray = NDArray[np.floating]
HERE = Path(__file__).parent
# The paper's cable and its end poses on a grid of one inch (Table 4).
CABLE = CableData(length=0.8125, mass=0.23, diameter=0.0128, bending_stiffness=949.56 * 0.08125)
GRID = [
    (14, 10),
    (20, 0),
    (20, 4),
    (20, 10),
    (20, -4),
    (24, 0),
    (24, 4),
    (24, -4),
    (26, -10),
    (26, 8),
    (28, 0),
    (5, -31),
]
FLAGS = ("-O2",)
TARGET = 1e-6  # largest error of a node [m] of methods that are timed to an accuracy


def poses() -> FloatArray:
    """End positions (12, 2) [m]."""
    return 0.0254 * np.array(GRID, float)


def summary(seconds: list[float] | FloatArray) -> dict[str, float]:
    """Median and 99th percentile [s]."""
    return {
        "median": float(np.median(seconds)),
        "p99": float(np.percentile(seconds, 99)),
        "solves": len(seconds),
    }


def compiler() -> str:
    """First line of the compiler's version."""
    run = subprocess.run(["cc", "--version"], capture_output=True, text=True, check=True)
    return run.stdout.splitlines()[0]


def _library(text: str, name: str, folder: Path) -> ctypes.CDLL:
    source, library = folder / f"{name}.c", folder / f"{name}.so"
    source.write_text(text)
    command = ["cc", *FLAGS, "-fPIC", "-shared", source.name, "-o", library.name, "-lm"]
    subprocess.run(command, cwd=folder, check=True)
    return ctypes.CDLL(str(library))


def generated(n: int, element: str, repeats: int) -> dict[str, Any]:
    """The generated solver, cold, branch named."""
    model = CableModel(CABLE, n=n, element=element)  # type: ignore[arg-type]
    rest = np.zeros(model.chain.n_cells)
    source = generate(model, model.nominal, rest)
    texts = dict(source.files)
    head = "#define _POSIX_C_SOURCE 199309L\n"
    texts["dlo_solver.c"] = head + texts["dlo_solver.c"] + (HERE / "timing.c").read_text()
    folder = Path(tempfile.mkdtemp(prefix="dlo_speed_"))
    c = ctypes.CDLL(str(compile_library(replace(source, files=texts), folder, FLAGS)))
    pointer, size = ctypes.c_void_p, ctypes.c_size_t
    c.dlo_time.argtypes = [pointer, ctypes.c_int, pointer, size, pointer, pointer, pointer]
    work, shape = np.empty(workspace_of(c)), np.zeros(16 * (n + 8))
    everything = []
    for end in poses():
        pose = np.array([0.0, 0.0, *end, 0.0, 0.0])
        for keep in (False, True):
            seconds = np.zeros(repeats)
            c.dlo_time(
                *(pose.ctypes.data, 1, None, repeats, seconds.ctypes.data),
                *(shape.ctypes.data, work.ctypes.data),
            )
            if keep:
                everything.append(seconds)
    shutil.rmtree(folder)
    out = summary(np.concatenate(everything))
    # Other work on the machine cools the caches: the fastest tells what the code costs.
    out["best"] = float(np.median([seconds.min() for seconds in everything]))
    return out


def bare(n: int, repeats: int) -> dict[str, Any]:
    """The bare Newton method in C."""
    folder = Path(tempfile.mkdtemp(prefix="dlo_bare_"))
    c = _library((HERE / "bare_newton.c").read_text(), "bare", folder)
    real, pointer = ctypes.c_double, ctypes.c_void_p
    c.bare_newton_many.argtypes = [ctypes.c_size_t, ctypes.c_int, *([real] * 6), pointer, pointer]
    h = CABLE.length / n
    x, work = np.zeros(n), np.zeros(6 * n)
    everything, best = [], []
    for end in poses():
        seconds = []
        for _ in range(repeats):
            begin = process_time()
            c.bare_newton_many(
                *(1000, n, CABLE.bending_stiffness / h, 0.0, -9.81 * CABLE.mass / n, h),
                *(end[0], end[1], x.ctypes.data, work.ctypes.data),
            )
            seconds.append((process_time() - begin) / 1000)
        everything += seconds
        best.append(min(seconds))
    shutil.rmtree(folder)
    return summary(everything) | {"best": float(np.median(best))}


def _problem(model: CableModel) -> dict[str, ca.SX]:
    problem = potential(model)
    x = problem.coordinates
    g = ca.vertcat(problem.conditions, x[1:] - x[:-1])
    return {"x": x, "p": problem.parameters, "f": problem.energy, "g": g}


def by_casadi(n: int, kind: str, repeats: int) -> dict[str, Any]:
    """IPOPT through CasADi, or CasADi's generated C of sqpmethod with qrqp."""
    model = CableModel(CABLE, n=n, element="link")
    quiet: dict[str, Any] = {"print_time": False}
    if kind == "ipopt":
        quiet |= {"ipopt.print_level": 0, "ipopt.sb": "yes"}
        solver = ca.nlpsol("s", "ipopt", _problem(model), quiet)
    else:
        quiet |= {
            "print_header": False,
            "print_iteration": False,
            "print_status": False,
            "qpsol": "qrqp",
            "qpsol_options": {"print_iter": False, "print_header": False, "print_info": False},
        }
        plain = ca.nlpsol("s", "sqpmethod", _problem(model), quiet)
        folder = Path(tempfile.mkdtemp(prefix="dlo_sqp_"))
        generator = ca.CodeGenerator("sqp.c")
        generator.add(plain)
        generator.generate(f"{folder}/")
        _library((folder / "sqp.c").read_text(), "sqp_lib", folder)
        solver = ca.external("s", str(folder / "sqp_lib.so"))
    many = solver.map(16)
    bounds = np.concatenate([np.zeros(2), np.full(n - 1, np.pi / 2)])
    reference = CompiledSolver(model, model.nominal, np.zeros(n - 1))
    seconds, errors = [], []
    for end in poses():
        start = arc_headings(model.chain.places, CABLE.length, end, 1)
        p = np.concatenate(
            [model.nominal, np.zeros(n - 1), HeldPose((0.0, 0.0), end).vector, np.zeros(6)]
        )
        good = reference.solve(HeldPose((0.0, 0.0), tuple(end), branch="ccw")).x[:, 0]
        # Sixteen at a time, so that no conversion of arguments is timed.
        tiled = {
            name: np.tile(value, (16, 1)).T
            for name, value in {"x0": start, "p": p, "lbg": -bounds, "ubg": bounds}.items()
        }
        for _ in range(repeats):
            begin = process_time()
            found = many(**tiled)
            seconds.append((process_time() - begin) / 16)
        errors.append(_error(np.array(found["x"])[:, 0], good, n))
    return summary(seconds) | {"reached_target": int((np.array(errors) < TARGET).sum())}


def _error(phi: FloatArray, good: FloatArray, n: int) -> float:
    """Largest distance of nodes [m]."""
    h = CABLE.length / n
    x = np.cumsum(h * (np.cos(phi) - np.cos(good)))
    y = np.cumsum(h * (np.sin(phi) - np.sin(good)))
    return float(np.hypot(x, y).max())


def by_cobyla(n: int) -> dict[str, Any]:
    """COBYLA in relative angles as in the paper, stopped when it is within the target."""
    model = CableModel(CABLE, n=n, element="link")
    h, weights = CABLE.length / n, CABLE.mass / n * 9.81
    reference = CompiledSolver(model, model.nominal, np.zeros(n - 1))
    seconds, reached = [], 0
    for end in poses()[:4]:
        good = reference.solve(HeldPose((0.0, 0.0), tuple(end), branch="ccw")).x[:, 0]
        start = arc_headings(model.chain.places, CABLE.length, end, 1)

        def energy(theta: FloatArray) -> float:
            phi = np.cumsum(theta)
            height = np.cumsum(h * np.sin(phi)) - h * np.sin(phi) / 2
            bend = 0.5 * CABLE.bending_stiffness / h * np.sum(theta[1:] ** 2)
            return float(bend + weights * height.sum())

        def gap(theta: FloatArray, end: FloatArray = end) -> FloatArray:
            phi = np.cumsum(theta)
            return np.array([h * np.cos(phi).sum() - end[0], h * np.sin(phi).sum() - end[1]])

        theta = np.concatenate([start[:1], np.diff(start)])
        begin = process_time()
        found = minimize(
            energy,
            theta,
            method="COBYLA",
            constraints=[
                {"type": "ineq", "fun": lambda t: gap(t) + 1e-8},
                {"type": "ineq", "fun": lambda t: 1e-8 - gap(t)},
            ],
            options={"maxiter": 200000, "tol": 1e-9, "rhobeg": 0.1},
        )
        seconds.append(process_time() - begin)
        reached += _error(np.cumsum(found.x), good, n) < TARGET
    return summary(seconds) | {"reached_target": reached, "poses": len(seconds)}


def throughput(n: int = 20, threads: int = 2, count: int = 120_000) -> dict[str, float]:
    """Poses a second of dlo_batch by threads of the caller, random ends in the disc."""
    model = CableModel(CABLE, n=n, element="link")
    solver = CompiledSolver(model, model.nominal, np.zeros(n - 1))
    rng = np.random.default_rng(0)
    radius = 0.995 * CABLE.length * np.sqrt(rng.uniform(size=count))
    angle = rng.uniform(-np.pi, np.pi, size=count)
    table = np.zeros((count, 6))  # as dlo_pose: start, end, headings
    table[:, 2:4] = radius[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    out: dict[str, float] = {}
    for branch in ("ccw", None):
        parts = np.array_split(table, threads)
        failed: list[int] = []

        def work(part: FloatArray, branch: Any = branch, failed: list[int] = failed) -> None:
            failed.append(int((solver.solve_many(part, branch=branch)[1] != 0).sum()))

        pool = [Thread(target=work, args=(part,)) for part in parts]
        begin = perf_counter()
        for thread in pool:
            thread.start()
        for thread in pool:
            thread.join()
        name = branch or "lowest"
        out[f"poses_per_second_{name}"] = count / (perf_counter() - begin)
        out[f"failed_{name}"] = sum(failed)
    return out
