"""Cables that are let go: our simulation beside MuJoCo and PyElastica, from the same shape.

    python scripts/check_swings.py [--time 3] [--links 80]

Three cables, in the plane and in space, are clamped at their start; the other end is pulled aside
and let go. Beside MuJoCo they have the damping of the material, 0.02 s; beside PyElastica viscous
drag, which is what its damper does. Lines with the largest distance of the tip's ways, and times.

Exit code 1 if the ways are more than 1 % of the length apart, unless theirs come nearer by 2.5
times with twice as many links: PyElastica's undamped waves need more than 80.
"""

from __future__ import annotations

import sys
from dataclasses import replace
from time import perf_counter
from typing import Any

import mujoco as mj
import numpy as np
from harness import options

import dlo_casadi as dlo
from dlo_casadi.arrays import FloatArray
from dlo_casadi.export import mujoco, pyelastica
from dlo_casadi.export.rod import Rod
from dlo_casadi.rod.supports import SupportKind

RATE, STEP = 100.0, 5e-4  # instants that are compared [1/s], MuJoCo's step [s]
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


def in_mujoco(rod: Rod, t: FloatArray) -> FloatArray:
    """Tip (T, 3) [m] of the chain."""
    rod = replace(rod, damping_time=0.02)
    model = mj.MjModel.from_xml_string(mujoco.write(rod, []))
    model.dof_armature *= (STEP / model.opt.timestep) ** 2
    model.opt.timestep = STEP
    data = mj.MjData(model)
    mj.mj_resetDataKeyframe(model, data, 0)
    last, every, found = model.body(f"cable_{len(rod.masses) - 1}").id, round(1 / RATE / STEP), []
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


def main() -> int:
    """The exit code."""
    parser = options(__doc__)
    parser.add_argument("--links", type=int, default=80, help="of the chains (80)")
    parser.add_argument("--time", type=float, default=3.0, help="seconds")
    chosen, good = parser.parse_args(), True
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
