"""Where a gripper may put a cable's end: the cable may rest on the table, but not on the hot plate.

    python scripts/examples/rest_on_the_table.py     draws results/rest_on_the_table.png

The generated solver takes what the cable may touch with each call. The table is an obstacle of the
solver, which lays the cable on it; the plate is one of the clearance alone, which has to stay.
"""

from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

from dlo_casadi.codegen import Capsule, CompiledShape, CompiledSolver, Plane
from dlo_casadi.effects import CableData
from dlo_casadi.equilibrium.pose import HeldPose
from dlo_casadi.model.cable_model import CableModel

TABLE = Plane((0.0, 0.0, 0.0), (0.0, 0.0, 1.0))
PLATE = Capsule((0.45, 0.17, 0.0), (0.45, 0.29, 0.0), 0.04)  # m, its upper half above the table
GAP = 0.01  # m between the cable and the plate


def cable() -> CompiledSolver:
    """0.9 m of a heavy cable; of a fitted one `dlo_casadi.load(...).compile(obstacles=1)`."""
    data = CableData(0.9, 0.15, 0.008, 0.02, torsional_stiffness=0.01)
    ends = {"start": "clamped", "end": "clamped", "gravity": (0.0, 0.0, -9.81)}
    model = CableModel(data, 16, n_rest=0, **ends)
    return CompiledSolver(model, model.nominal, np.zeros(model.chain.n_rests), obstacles=1)


def pose(y: float) -> HeldPose:
    """Held 0.12 m above the table, the end at y [m]."""
    ahead = (0.0, 0.0, 0.0, 1.0)
    ends = {"start_orientation": ahead, "end_orientation": ahead}
    return HeldPose((0.0, 0.0, 0.12), (0.75, y, 0.12), **ends)


def moved(solver: CompiledSolver, ys: np.ndarray) -> list[tuple[CompiledShape, float, bool]]:
    """Shapes as the end moves, their distance from the plate [m], and whether they are allowed."""
    path, found = solver.path([pose(float(y)) for y in ys], obstacles=[TABLE]), []
    for shape in path.shapes:
        gap = solver.clearance(shape, [PLATE]).distance if shape.status == "ok" else -1.0
        found.append((shape, gap, gap >= GAP))
    return found


if __name__ == "__main__":
    ys = np.linspace(-0.3, 0.3, 25)
    found = moved(cable(), ys)
    figure, axes = plt.subplots(figsize=(6, 5), layout="constrained")
    for y, (shape, gap, allowed) in zip(ys, found, strict=True):
        load = -shape.obstacle_forces[0, 2]
        print(f"end at y = {y:+.3f} m: {load:.3f} N on the table, plate {1e3 * gap:+.0f} mm away")
        axes.plot(*shape.points[:, :2].T, "C0" if allowed else "C3", lw=1)
    axes.plot(*np.transpose([PLATE.a, PLATE.b])[:2], "0.7", lw=30, solid_capstyle="round", zorder=0)
    axes.set(xlabel="x [m]", ylabel="y [m]", title="from above; red: too near to the hot plate")
    axes.set_aspect("equal")
    Path("results").mkdir(exist_ok=True)
    figure.savefig("results/rest_on_the_table.png", dpi=150)
