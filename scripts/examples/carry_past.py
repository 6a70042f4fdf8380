"""Carry a cable past a ball in space, held in both hands, bent nowhere tighter than it may be.

    python scripts/examples/carry_past.py [ELEMENTS]      draws results/carry_past.png

Fifteen poses are one problem: `cable.transcribe` adds their shapes. One hand stays where it is, the
other leads the end from one side to the other; hands do not turn.
"""

import sys
from pathlib import Path

import casadi as ca
import matplotlib.pyplot as plt
import numpy as np

import dlo_casadi as dlo

STEPS, POINTS_PER_ELEMENT = 15, 4
STARTS, GOAL = (0.36, -0.2, 0.0), (0.36, 0.2, 0.0)  # m, of the end
CENTER, RADIUS, CLEAR = (0.18, 0.0, -0.21), 0.05, 0.010  # m
TIGHTEST = 0.03  # m, bend radius
UNIT = 0.1  # m: the objective is then of order ten, and IPOPT's first barrier, 0.1, suits it
FORWARD = (0.0, 0.0, 0.0, 1.0)  # along x, as a quaternion


def cable(n: int = 12) -> dlo.FittedCable:
    """0.6 m between two clamps; `dlo.load("results/...")` gives a fitted one."""
    rope = dlo.Cable(
        length=0.6, mass=0.06, diameter=0.008, bending_stiffness=0.01, torsional_stiffness=0.008
    )
    known = {"gravity": (0.0, 0.0, -9.81), "boundary": ("clamped", "clamped")}
    return dlo.known_cable(rope, **known, model={"n": n})


def carried(known: dlo.FittedCable) -> tuple[np.ndarray, list[np.ndarray], dict[str, object]]:
    """Ends (3, STEPS) [m] of the shortest way, points of its shapes [m], and IPOPT's statistics."""
    opti, k = ca.Opti(), np.linspace(0.0, 1.0, STEPS)
    ends = opti.variable(3, STEPS)
    opti.set_initial(ends, np.outer(STARTS, 1 - k) + np.outer(GOAL, k))
    frames = ca.repmat(ca.DM([*FORWARD, *FORWARD, 0]), 1, STEPS)
    poses = ca.vertcat(ca.DM.zeros(3, STEPS), ends, frames)
    shapes = known.transcribe(opti, poses, points=POINTS_PER_ELEMENT * known.model.n + 1)
    room = RADIUS + known.model.cable.diameter / 2 + CLEAR
    for shape in shapes:
        opti.subject_to(room**2 <= ca.sum1((shape.points - ca.DM(CENTER)) ** 2).T)
        opti.subject_to(shape.curvature <= 1 / TIGHTEST)
    opti.subject_to([ends[:, 0] == ca.DM(STARTS), ends[:, -1] == ca.DM(GOAL)])
    opti.minimize(STEPS * ca.sumsqr(ca.diff(ends.T) / UNIT))
    opti.solver("ipopt", {"print_time": False}, {"print_level": 0, "sb": "yes"})
    done = opti.solve()
    return done.value(ends), [done.value(shape.points) for shape in shapes], done.stats()


if __name__ == "__main__":
    known = cable(*map(int, sys.argv[1:]))
    ends, points, _ = carried(known)
    figure, axes = plt.subplots(subplot_kw={"projection": "3d"})
    for j, line in enumerate(points):
        axes.plot(*line, color=plt.get_cmap("viridis")(j / STEPS))
    axes.plot(*ends, "C3.-", label="way of the end")
    u, v = np.meshgrid(np.linspace(0, 2 * np.pi, 25), np.linspace(0, np.pi, 13))
    ball = np.stack([np.cos(u) * np.sin(v), np.sin(u) * np.sin(v), np.cos(v)])
    axes.plot_surface(*(RADIUS * ball + np.reshape(CENTER, (3, 1, 1))), color="0.8", alpha=0.6)
    axes.set(xlabel="x [m]", ylabel="y [m]", zlabel="z [m]", aspect="equal")
    axes.legend()
    Path("results").mkdir(exist_ok=True)
    figure.savefig("results/carry_past.png", dpi=120)
