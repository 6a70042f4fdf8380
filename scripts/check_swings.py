"""Cables that are let go: our simulation beside MuJoCo and PyElastica, from the same shape.

    python scripts/check_swings.py [--time 3] [--links 80]
    python scripts/check_swings.py --speed

Three cables, in the plane and in space, are clamped at their start; the other end is pulled aside
and let go. Beside MuJoCo they have the damping of the material, 0.02 s; beside PyElastica viscous
drag, which is what its damper does. Lines with the largest distance of the tip's ways, and times.

With --speed: the least processor time in which each reaches 0.5 % of the length, over meshes and
steps. The reference is our own way on 60 elements with small steps. Undamped waves keep PyElastica
from it on any of its meshes: then the least distance is told.

Exit code 1 if the ways are more than 1 % of the length apart, unless theirs come nearer by 2.5
times with twice as many links: PyElastica's undamped waves need more than 80.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterable
from dataclasses import replace
from time import perf_counter, process_time
from typing import Any

import mujoco as mj
import numpy as np
from harness import options

import dlo_casadi as dlo
from dlo_casadi.arrays import FloatArray
from dlo_casadi.cable.fitted_cable import FittedCable
from dlo_casadi.cable.shape_in_motion import moving_cable
from dlo_casadi.codegen.fit_steps import compiled_steps
from dlo_casadi.errors import MotionError
from dlo_casadi.export import mujoco, pyelastica
from dlo_casadi.export.rod import Rod
from dlo_casadi.motion.steps import begun_by, first_step
from dlo_casadi.rod.supports import SupportKind

Timed = tuple[float, FloatArray]  # processor time [s], way of the tip (T, d) [m]
Made = Callable[[int], tuple[FittedCable, dlo.Shape, dict[str, Any]]]
RATE, STEP = 100.0, 5e-4  # instants that are compared [1/s], MuJoCo's step [s]
NEAR = 5e-3  # distance of the tips' ways over the length, at which times are compared
T = np.arange(301) / RATE  # instants of --speed [s]
DRAG = 3.0  # viscous, over the mass [1/s]


def cases() -> dict[str, tuple[dlo.Cable, int, dict[str, Any]]]:
    """Cable, dimension, and how it is held at first."""
    stiff = dlo.Cable(length=0.4, mass=0.02, diameter=0.004, bending_stiffness=0.01)
    rope = dlo.Cable(length=0.6, mass=0.06, diameter=0.008, bending_stiffness=0.009)
    twisted = {"bending_stiffness": 0.02, "torsional_stiffness": 0.015}
    hose = dlo.Cable(length=0.8, mass=0.12, diameter=0.01, **twisted)
    return {
        "rope": (rope, 2, {"start": (0, 0), "start_heading": -1.2, "end": (0.35, -0.4)}),
        "stiff": (stiff, 2, {"start": (0, 0), "start_heading": 0.0, "end": (0.34, 0.08)}),
        "hose": (
            hose,
            3,
            {
                "start": (0, 0, 0),
                "start_orientation": (0, 0.5, 0, 0.8660254),
                "end": (0.5, 0.25, -0.35),
            },
        ),
    }


def in_mujoco(rod: Rod, t: FloatArray, step: float = STEP) -> FloatArray:
    """Tip (T, 3) [m] of the chain."""
    rod = replace(rod, damping_time=0.02)
    model = mj.MjModel.from_xml_string(mujoco.write(rod, []))
    model.dof_armature *= (step / model.opt.timestep) ** 2
    model.opt.timestep = step
    data = mj.MjData(model)
    mj.mj_resetDataKeyframe(model, data, 0)
    last, every, found = model.body(f"cable_{len(rod.masses) - 1}").id, round(1 / RATE / step), []
    for k in range(len(t)):
        if k:
            mj.mj_step(model, data, nstep=every)
        mj.mj_forward(model, data)
        found.append(data.xpos[last] + rod.h * data.xmat[last].reshape(3, 3)[:, 0])
    return np.array(found)


def in_pyelastica(rod: Rod, t: FloatArray) -> FloatArray:
    """Tip (T, 3) [m] of the rod with viscous drag."""
    import elastica as ea

    text = pyelastica.write(rod, []).replace("DAMPING = 10.0", f"DAMPING = {DRAG}")
    made: dict[str, Any] = {}
    exec(compile(text, "export", "exec"), made)

    class Simulator(ea.BaseSystemCollection, ea.Constraints, ea.Forcing, ea.Damping):
        """PyElastica adds its features by inheritance."""

    simulator, cable = Simulator(), made["make_rod"]()
    made["hold"](simulator, cable)
    simulator.finalize()
    stepper, now, found = ea.PositionVerlet(), 0.0, []
    for instant in t:
        while now < instant - made["STEP"] / 2:
            now = stepper.step(simulator, now, made["STEP"])
        found.append(cable.position_collection[:, -1].copy())
    return np.array(found)


# ---- speed at equal error ----------------------------------------------------------------------


def in_c(cable: FittedCable, begins: dlo.Shape, held: dict[str, Any], steps: int) -> Timed:
    """Tip (T, d) [m] by compiled steps, so many between two instants; without the compilation.

    NaN where a step has no solution.
    """
    moving = moving_cable(cable)
    compiled = compiled_steps(moving, ("-O2",))
    own, dt = cable.simulate(T[:2], **held, begins=begins), 1 / RATE / steps
    fixtures = own.way.path.at(0.0, moving)
    first = first_step(moving, own.way.states[0], fixtures, dt)
    now = compiled.records.recorded(begun_by(own.way.states[0], first))
    found, began = [own.points[0, -1]], process_time()
    for _ in T[1:]:
        for _ in range(steps):
            now, status = compiled.advance(now, fixtures, dt)
            if status != "ok":
                return np.inf, np.full((len(T), moving.d), np.nan)
        found.append(now["r"][0, -1].copy())
    return process_time() - began, np.array(found)


def ours(
    data: dlo.Cable, known: dict[str, Any], held: dict[str, Any], damping: dict[str, float]
) -> Made:
    """Number of elements -> the cable, the shape from which it is let go, and its clamp."""
    still = {key: x for key, x in held.items() if key != "end"}

    def made(n: int) -> tuple[FittedCable, dlo.Shape, dict[str, Any]]:
        pulled, free = (
            dlo.known_cable(data, boundary=("clamped", end), **known | {"model": {"n": n}})
            for end in ("pinned", "free")
        )
        return free.with_damping(**damping), pulled.solve(**held), still

    return made


def least(
    name: str, runs: Iterable[tuple[str, Callable[[], Timed]]], exact: FloatArray, length: float
) -> float:
    """Least time [s] within NEAR, told with the mesh and step that need it."""
    best, nearest = (np.inf, "no mesh"), np.inf
    for told, run in runs:
        try:
            seconds, tip = run()
        except MotionError:  # too coarse a mesh, or too long a step
            continue
        gaps = np.linalg.norm(tip[:, : exact.shape[1]] - exact, axis=1)
        apart = float(gaps.max()) / length if np.isfinite(gaps).all() else np.inf
        nearest = min(nearest, apart)
        if apart <= NEAR:
            best = min(best, (min(seconds, run()[0]), told))
    print(f"  {name}: {best[0]:.3f} s with {best[1]}; nearest {100 * nearest:.2f} %", flush=True)
    return best[0]


def speed() -> bool:
    """Tell least times at equal error; whether ours are as short as they must be."""
    good = True
    for name, (data, d, held) in cases().items():
        known = {"gravity": (0.0, 0.0, -9.81)[-d:]}
        for other, damping in (("MuJoCo", {"damping_time": 0.02}), ("PyElastica", None)):
            drag = {"damping_time": 1e-6, "viscous_drag": DRAG * data.mass / data.length}
            made = ours(data, known, held, damping or drag)
            free, shape, still = made(60)
            exact = free.simulate(T, **still, begins=shape, tolerance=1e-7).points[:, -1]
            print(f"{name}, damped as {other} does it, {T[-1]:.0f} s within {100 * NEAR} %:")

            def python(n: int, tolerance: float, made: Made = made) -> Timed:
                free, shape, still = made(n)
                began = process_time()
                tip = free.simulate(T, **still, begins=shape, tolerance=tolerance).points[:, -1]
                return process_time() - began, tip

            def theirs(links: int, step: float, shape: dlo.Shape = shape) -> Timed:
                rod = Rod.of(shape.held, links)
                rod = replace(rod, end=replace(rod.end, kind=SupportKind.FREE))
                began = process_time()
                tip = in_mujoco(rod, T, step) if step else in_pyelastica(rod, T)
                return process_time() - began, tip

            meshes, steps = (4, 6, 8, 12, 20), (1, 2, 4, 8)
            compiled = [
                (
                    f"{n} elements, {1e3 / RATE / k} ms",
                    lambda n=n, k=k, made=made: in_c(*made(n), k),
                )
                for n in meshes
                for k in steps
            ]
            plain = [
                (f"{n} elements, tolerance {x:g}", lambda n=n, x=x: python(n, x))
                for n in (8, 12, 20)
                for x in (1e-4, 3e-5, 1e-5, 3e-6)
            ]
            if other == "MuJoCo":
                rows = [
                    (f"{n} links, {1e3 * x:g} ms", lambda n=n, x=x: theirs(n, x))
                    for n in (10, 20, 40)
                    for x in (5e-3, 2.5e-3, 1e-3, 5e-4)
                ]
            else:
                rows = [(f"{n} links", lambda n=n: theirs(n, 0.0)) for n in (20, 40, 80)]
            length = data.length
            own = least("ours in C", compiled, exact, length)
            least("ours in Python", plain, exact, length)
            peer = least(other, rows, exact, length)
            good &= own <= (0.5 if other == "MuJoCo" else 0.05) * peer
            print(f"  C takes {own / peer:.3f} of {other}'s time")
    return good


def main() -> int:
    """The exit code."""
    parser = options(__doc__)
    parser.add_argument("--links", type=int, default=80, help="of the chains (80)")
    parser.add_argument("--time", type=float, default=3.0, help="seconds")
    parser.add_argument("--speed", action="store_true", help="times at equal error")
    chosen, good = parser.parse_args(), True
    if chosen.speed:
        return int(not speed())
    t = np.arange(round(chosen.time * RATE) + 1) / RATE
    for name, (data, d, held) in cases().items():
        gravity = (0.0, 0.0, -9.81)[-d:]
        known = {"gravity": gravity, "model": {"n": 20}}
        pulled = dlo.known_cable(data, boundary=("clamped", "pinned"), **known)
        free = dlo.known_cable(data, boundary=("clamped", "free"), **known)
        shape = pulled.solve(**held)
        still = {key: x for key, x in held.items() if key != "end"}
        drag = DRAG * data.mass / data.length
        for other, simulated, damping, meshes in (
            ("MuJoCo", in_mujoco, {"damping_time": 0.02}, (chosen.links,)),
            (
                "PyElastica",
                in_pyelastica,
                {"damping_time": 1e-6, "viscous_drag": drag},
                (chosen.links // 2, chosen.links),
            ),
        ):
            begun = perf_counter()
            moving = free.with_damping(**damping)
            motion = moving.simulate(t, **still, begins=shape, tolerance=1e-6)
            ours, found = perf_counter() - begun, []
            for links in meshes:
                rod = Rod.of(shape.held, links)
                rod = replace(rod, end=replace(rod.end, kind=SupportKind.FREE))
                begun = perf_counter()
                tip = simulated(rod, t)[:, :d]
                theirs = perf_counter() - begun
                apart = np.linalg.norm(tip - motion.points[:, -1], axis=1) / data.length
                found.append(float(apart.max()))
                print(
                    f"{name} beside {other}, {links} links: tip {100 * found[-1]:.2f} % of the "
                    f"length apart at most; {ours:.1f} s and {theirs:.1f} s",
                    flush=True,
                )
            good &= found[-1] <= 0.01 or found[-1] < found[0] / 2.5
    return int(not good)


if __name__ == "__main__":
    sys.exit(main())
