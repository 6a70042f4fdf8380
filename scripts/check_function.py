"""Values and derivatives of `CasadiCable.function` with every effect, in the plane and in space.

    python scripts/check_function.py [EFFECT ...]

For each effect, at values away from those at which it vanishes: the outputs against
`solve_equilibrium`, their Jacobian, and the Hessian of a random sum of them, against differences of
fourth order, by all numbers of the pose and by all parameters. Without names also: where to hold
the end of a cable in space so that it pulls least and bends no tighter than 50 mm, from ten starts,
against a grid of shapes; the way of least peak pull past obstacles, between its poses, too, against
the planner's; and the time of `casadi.external` beside that of the bare C. Exit code 1
above 1e-9, 1e-6, 1e-5, 40 iterations, or 1.3 times the bare C.
"""

import os
import sys
from collections.abc import Callable, Sequence
from ctypes import CDLL, c_size_t, c_void_p
from pathlib import Path
from tempfile import TemporaryDirectory
from time import perf_counter
from typing import Any

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import casadi as ca
import numpy as np
from examples import lead_the_end
from harness import options, run
from numpy.typing import NDArray

from dlo_casadi.codegen import Capsule, CompiledSolver, generate
from dlo_casadi.codegen.compiler import compile_library, workspace_of
from dlo_casadi.effects import EFFECTS, BoundaryEffect, CableData, Effect
from dlo_casadi.equilibrium.implicit import pose_of
from dlo_casadi.equilibrium.pose import HeldPose
from dlo_casadi.equilibrium.solve import solve_equilibrium
from dlo_casadi.equilibrium.symbolic import CasadiCable
from dlo_casadi.model.cable_model import CableModel

FloatArray = NDArray[np.floating]

GRAVITY, SQRT_HALF = (0.0, 0.0, -9.81), 0.5**0.5
# Largest error of values, and of first and second derivatives relative to the largest of them.
MOST = (1e-9, 1e-6, 1e-5)
POSES = {
    2: [0.01, 0.02, 0.5, 0.1, 0.3, -0.4],
    3: [0.01, 0.02, 0.03, 0.5, 0.1, 0.05, 0.1, 0.0, 0.1, 1.1, 0.1, 0.2, 0.0, 0.9, 0.0],
}


def model_of(effect: type[Effect] | None, dimension: int) -> tuple[CableModel, FloatArray]:
    """A cable with one effect, and its parameters."""
    cable = CableData(0.8, 0.05, 0.005, 0.01, torsional_stiffness=0.008 if dimension == 3 else None)
    held = effect is None or not issubclass(effect, BoundaryEffect) or "clamp" in effect.name
    model = CableModel(
        cable,
        n=10,
        start="clamped" if held else "pinned",
        end="clamped" if held else "pinned",
        gravity=(0.0, -9.81) if dimension == 2 else GRAVITY,
        effects=() if effect is None else (effect(),),
        n_rest=0,
    )
    away = [q.nominal + (0.5 * q.scale if q.scale and not q.log else 0.0) for q in model.parameters]
    return model, np.array(away)


def differences(function: Callable[[FloatArray], FloatArray], u: FloatArray) -> FloatArray:
    """Derivatives (rows, len(u)) by differences of fourth order."""
    columns = []
    for k, step in enumerate(1e-3 * np.maximum(np.abs(u), 0.01)):
        d = step * np.eye(len(u))[k]
        near, far = (function(u + j * d) - function(u - j * d) for j in (1, 2))
        columns.append((8 * near - far) / (12 * step))
    return np.stack(columns, axis=-1)


def errors(effect: type[Effect] | None, dimension: int) -> tuple[float, ...]:
    """Errors of values, first and second derivatives."""
    (model, p), pose = model_of(effect, dimension), np.array(POSES[dimension])
    rest = np.random.default_rng(1).normal(scale=0.5, size=model.chain.n_rests)
    rest[: -model.chain.n_cells * len(model.node.curvatures)] = 0.0
    function = CasadiCable(model, p, rest).function(parameters=True)
    eq = solve_equilibrium(model, p, rest, pose_of(model, pose))
    told = dict(zip(function.name_out(), map(np.array, function(pose, p)), strict=True))
    pairs = [
        (told["points"].T, eq.points),
        (told["end_force"].ravel(), eq.end_force),
        (told["end_moment"].ravel(), np.reshape(eq.moments, (2, -1))[1]),
        (told["energy"].item(), eq.energy),
        (told["min_bend_radius"].item(), eq.min_bend_radius),
    ]
    wrong = max(float(np.abs(found - known).max()) for found, known in pairs)
    u = ca.MX.sym("u", len(pose) + len(p))
    outs = ca.veccat(*function(u[: len(pose)], u[len(pose) :])[:-1])
    weights = np.random.default_rng(0).normal(size=outs.numel())
    hessian, gradient = ca.hessian(ca.dot(weights, outs), u)
    calls = [ca.Function("f", [u], [e]) for e in (outs, gradient, ca.jacobian(outs, u), hessian)]
    value, slope, jacobian, second = ((lambda v, f=f: np.array(f(v)).squeeze()) for f in calls)
    at, found = np.concatenate([pose, p]), [wrong]
    for exact, function_of in ((jacobian, value), (second, slope)):
        known = differences(function_of, at)
        found.append(float(np.abs(exact(at) - known).max() / np.abs(known).max()))
    return tuple(found)


def held_best(starts: int = 10) -> bool:
    """Example hold_the_end in space: whether all starts lead to one end, no worse than a grid's."""
    data = CableData(0.5, 0.015, 0.003, 2e-5, torsional_stiffness=1.5e-5)
    model = CableModel(data, n=20, start="clamped", end="clamped", gravity=GRAVITY, n_rest=0)
    cable = CasadiCable(model, model.nominal, np.zeros(model.chain.n_rests))
    low, high, radius = np.array([0.03, -0.1, 0.0]), np.array([0.3, 0.1, 0.1]), 0.05
    down, up = [0.0, SQRT_HALF, 0.0, SQRT_HALF], [0.1, -SQRT_HALF, 0.2, SQRT_HALF]
    shape, found = cable.function(), []
    for first in np.random.default_rng(0).uniform(low, high, (starts, 3)):
        problem = ca.Opti()
        end = problem.variable(3)
        there = shape(pose=ca.vertcat(0, 0, 0, end, down, up, 0))
        pull = ca.norm_2(there["end_force"])
        problem.minimize(pull)
        problem.subject_to(there["curvature"] <= 1 / radius)
        problem.subject_to(problem.bounded(low, end, high))
        problem.set_initial(end, first)
        problem.solver("ipopt", {"print_time": False}, {"print_level": 0, "sb": "yes"})
        begun = perf_counter()
        done = problem.solve()
        found.append([*done.value(end), done.value(pull), done.stats()["iter_count"]])
        numbers = ", ".join(f"{number:.6f}" for number in found[-1][:3])
        print(
            f"end ({numbers}) m, pull {found[-1][3]:.7f} N, {found[-1][4]:.0f} iterations, "
            f"{perf_counter() - begun:.1f} s",
            flush=True,
        )
    ends, pulls, counts = np.split(np.array(found), [3, 4], axis=1)
    grid = np.stack(np.meshgrid(*map(np.linspace, low, high, (28, 21, 11))), axis=-1).reshape(-1, 3)
    still = np.tile([*down, *up, 0.0], (len(grid), 1))
    solver = CompiledSolver(model, cable.p, cable.rest)
    shapes, statuses = solver.solve_many(np.hstack([np.zeros_like(grid), grid, still]))
    allowed = (statuses == 0) & (shapes["min_bend_radius"] >= radius)
    best = float(np.linalg.norm(shapes["end_force"][allowed], axis=1).min())
    print(f"lowest pull of {allowed.sum()} of {len(grid)} shapes of a grid: {best:.7f} N")
    same = np.ptp(ends, axis=0).max() < 1e-4 and np.ptp(pulls) < 1e-7
    return bool(same and counts.max() <= 40 and pulls.max() <= best)


def led_easily() -> bool:
    """Example lead_the_end between its poses, too, and scripts/planner's way, by the compiled C."""
    cable, begun = lead_the_end.cable(), perf_counter()
    best = lead_the_end.easiest(cable)
    print(f"{best['ends'].shape[1]} poses in one problem: {perf_counter() - begun:.1f} s")
    solver, peaks = CompiledSolver(cable.model, cable.p, cable.rest), []
    obstacles = [Capsule((x, y), (x, y), radius) for x, y, radius in lead_the_end.DISCS]
    for ends in (best["ends"], np.array([lead_the_end.X, lead_the_end.Y])):
        count = ends.shape[1]
        places = np.linspace(0, count - 1, 20 * (count - 1) + 1)
        way = np.array([np.interp(places, np.arange(count), row) for row in ends]).T
        path = solver.path([HeldPose((0, 0), tuple(end), branch="ccw") for end in way])
        if path.first_jump is not None:
            print(f"the path jumps at pose {path.first_jump}")
            return False
        gap = min(solver.clearance(shape, obstacles).distance for shape in path.shapes)
        peaks.append(max(float(np.linalg.norm(shape.end_force)) for shape in path.shapes))
        print(f"{len(way)} shapes: peak {peaks[-1]:.4f} N, {1e3 * gap:.2f} mm clear")
        if gap < 0.01:
            return False
    return bool(np.abs(best["residual"]).max() < 1e-6 and peaks[0] <= peaks[1])


def slowdown(dimension: int, calls: int = 3000) -> float:
    """Median time of a call by `casadi.external`, through buffers, over that of the bare C."""
    model, p = model_of(None, dimension)
    rest, pose = np.zeros(model.chain.n_rests), np.array(POSES[dimension])
    with TemporaryDirectory() as folder:
        library = compile_library(generate(model, p, rest), Path(folder))
        bare, workspace = CDLL(str(library)).dlo_solve, workspace_of(CDLL(str(library)))
        function = ca.external("dlo_cable", str(library))
    work, shape = np.zeros(workspace), np.zeros(100 * workspace)
    places = [c_void_p(array.ctypes.data) for array in (pose, shape, work)]
    buffer: Any
    buffer, run = function.buffer()
    buffer.set_arg(0, memoryview(pose))
    outs = [np.zeros(function.nnz_out(k)) for k in range(function.n_out())]
    for k, out in enumerate(outs):
        buffer.set_res(k, memoryview(out))
    times = []
    for _ in range(calls):
        begun = perf_counter()
        bare(places[0], 0, None, places[1], places[2], c_size_t(workspace))
        between = perf_counter()
        run()
        times.append((between - begun, perf_counter() - between))
    alone, inside = np.median(times, axis=0)
    print(f"{dimension}D: C {1e6 * alone:.1f} us, by casadi.external {1e6 * inside:.1f} us")
    return float(inside / alone)


def main(argv: Sequence[str] | None = None) -> int:
    """Print a line for each effect."""
    parser = options(__doc__, jobs=True)
    parser.add_argument("effects", nargs="*", help="names; all by default")
    chosen = parser.parse_args(argv)
    cases = [
        (name, dimension)
        for name in chosen.effects or ["none", *EFFECTS]
        for dimension in (EFFECTS[name].dimensions if name in EFFECTS else (2, 3))
    ]
    bad = any(map(wrong, run(errors_of, cases, chosen, text_of)))
    if not chosen.effects:
        bad |= not (held_best() and led_easily())
        bad |= max(map(slowdown, (2, 3))) > 1.3
    return int(bad)


def errors_of(case: tuple[str, int]) -> tuple[float, ...]:
    """Errors with an effect, by its name, in the plane or in space."""
    return errors(EFFECTS.get(case[0]), case[1])


def wrong(found: tuple[float, ...]) -> bool:
    """Whether an error is too large."""
    return any(not error < most for error, most in zip(found, MOST, strict=True))


def text_of(case: tuple[str, int], found: tuple[float, ...], _: float) -> str:
    """A line of the table."""
    texts = "  ".join(f"{error:.1e}" for error in found)
    where = {2: "plane", 3: "space"}[case[1]]
    return f"{case[0]:22s} {where}  {texts}{'  BAD' * wrong(found)}"


if __name__ == "__main__":
    sys.exit(main())
