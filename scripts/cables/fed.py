"""Random cables that are fed through their end: the generated C beside Python.

Between a clamp and a slide, with and without a pinned clip; random directions and tensions of 0.3
to 3 N. Energies count as the same within 0.2 % (or of 10 mJ): where a clip stands between the ends
nodes may be laid for one element more or less, which changes the error of the mesh.
"""

from __future__ import annotations

import time
from collections import Counter
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from dlo_casadi.codegen.compiled import CompiledSolver
from dlo_casadi.effects import CableData
from dlo_casadi.equilibrium.pose import HeldPose
from dlo_casadi.equilibrium.solve import solve_equilibrium
from dlo_casadi.errors import EquilibriumError
from dlo_casadi.model.cable_model import CableModel
from dlo_casadi.model.clips import HeldClip

SAME, LEAST = 2e-3, 0.01  # share of the energy; energy [J]
SIZES = {"length": 1.0, "mass": 0.2, "diameter": 0.01, "bending_stiffness": 0.02, "straight": True}


def drawn(rng: np.random.Generator, d: int, clips: bool) -> HeldPose:
    """A pose with a random chord, directions about it and tension."""
    way = rng.standard_normal(d)
    end = rng.uniform(0.3, 0.8) * way / np.linalg.norm(way)
    held: dict[str, Any]
    if d == 2:
        angles = np.arctan2(end[1], end[0]) + rng.uniform(-1.0, 1.0, 2)
        held = {"start_heading": float(angles[0]), "end_heading": float(angles[1])}
    else:
        along, _ = Rotation.align_vectors([end], [[1.0, 0.0, 0.0]])
        turns = (Rotation.from_rotvec(rng.uniform(-0.8, 0.8, 3)) for _ in range(2))
        first, last = (tuple((along * turn).as_quat()) for turn in turns)
        held = {"start_orientation": first, "end_orientation": last}
    place = tuple(0.45 * end + 0.03 * rng.standard_normal(d))
    clip = HeldClip("pinned", place, 0.5 * float(np.linalg.norm(end)) + 0.03)
    tension = float(rng.uniform(0.3, 3.0))
    return HeldPose(
        (0.0,) * d, tuple(end), end_tension=tension, clips=(clip,) if clips else (), **held
    )


def check(case: tuple[str, bool], *, count: int, seed: int) -> str:
    """What both find of `count` poses, and the processor time of each."""
    where, clips = case
    d, rng, counts = 2 + (where == "space"), np.random.default_rng(seed), Counter[str]()
    cable = CableData(**SIZES, torsional_stiffness=0.015 if d == 3 else None)
    gravity, kinds = (0.0,) * (d - 1) + (-9.81,), ("pinned",) if clips else ()
    held = {"start": "clamped", "end": "slide", "clips": kinds, "gravity": gravity, "n_rest": 0}
    model = CableModel(cable, 12, **held)
    rest, seconds = np.zeros(model.chain.n_rests), np.zeros(2)
    solver = CompiledSolver(model, model.nominal, rest)
    for _ in range(count):
        pose, times = drawn(rng, d, clips), [time.process_time()]
        shape = solver.solve(pose, throw=False)
        times.append(time.process_time())
        energies = {"C": shape.energy} if shape.status == "ok" else {}
        try:
            eq = solve_equilibrium(model, model.nominal, rest, pose)
            energies |= {"Python": eq.energy} if eq.stable else {}
        except EquilibriumError:
            pass
        times.append(time.process_time())
        seconds += np.diff(times)
        if len(energies) < 2:
            counts["neither" if not energies else f"{next(iter(energies))} alone"] += 1
            continue
        gap = energies["C"] - energies["Python"]
        same = abs(gap) <= SAME * max(abs(energies["Python"]), LEAST)
        counts["the same" if same else "C higher" if gap > 0 else "C lower"] += 1
    told = ", ".join(f"{name} {number}" for name, number in counts.items())
    each = "C {:.2f} ms, Python {:.0f} ms a pose".format(*(1e3 * seconds / count))
    return f"{where}{', a clip' if clips else ''}: {told}; {each}"
