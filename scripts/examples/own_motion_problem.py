"""Multiple shooting of one's own with `cable.step`: past a scanner, and at rest on arrival.

    python scripts/examples/own_motion_problem.py        draws results/own_motion_problem.png

A gripper carries a hanging rope 0.3 m. When half of the time has passed, the rope's tip shall be in
front of a scanner, ahead of the gripper's own way: a condition that `cable.move` does not know. The
states at the ends of all steps are unknowns, `cable.step` is their constraint.
"""

from pathlib import Path

import casadi as ca
import matplotlib.pyplot as plt
import numpy as np

import dlo_casadi as dlo

DT, COUNT, WAY, SCANNER, UNIT = 0.05, 24, 0.3, 0.2, 100.0  # s, steps, m, m, m/s^3


def cable() -> dlo.FittedCable:
    """0.6 m of rope; `dlo.load("results/...")` gives a fitted one."""
    data = dlo.Cable(length=0.6, mass=0.06, diameter=0.008, bending_stiffness=0.009)
    ends = ("clamped", "free")
    known = dlo.known_cable(data, gravity=(0, -9.81), boundary=ends, model={"n": 5})
    return known.with_damping(0.02, air_drag=1.1)


def carried(known: dlo.FittedCable) -> tuple[np.ndarray, np.ndarray, float, bool]:
    """Gripper (N,) [m], nodes (2, nodes, N) [m], swing on arrival [m], IPOPT's success."""
    first, fixtures = known.solve(start=(0, 0), start_heading=-np.pi / 2).at_rest()
    opti, step, size = ca.Opti(), known.step(DT), len(first) // (known.model.n + 1)
    state, control = opti.variable(len(first), COUNT), opti.variable(1, COUNT)
    jerk = UNIT * control

    def held(jerk: ca.MX) -> tuple[ca.MX, ca.MX]:
        """Fixtures at the ends of all steps, and place, speed and acceleration at the last."""
        a = DT * ca.cumsum(jerk, 1)
        v = DT * ca.cumsum(a, 1)
        x = DT * ca.cumsum(v, 1)
        rows = ca.repmat(ca.DM(fixtures), 1, COUNT)
        rows = ca.vertcat(x, rows[1:6, :], v, rows[7:10, :], a, rows[11:, :])
        return rows, ca.vertcat(x[-1], v[-1], a[-1])

    u = np.linspace(0, 1, COUNT)
    rows, arrival = held(jerk)
    after, _, _, places = step.map(COUNT)(ca.horzcat(ca.DM(first), state[:, :-1]), rows)
    opti.subject_to(after == state)  # each step begins where the one before ends
    opti.subject_to(arrival == ca.DM([WAY, 0, 0]))
    nodes = known.model.n + 1
    opti.subject_to(places[0, COUNT // 2 * nodes - 1] == SCANNER)
    last = ca.reshape(state[:, -1], size, -1)  # heading, place, rate, velocity, ...
    off, speed = (ca.sumsqr(x) / nodes for x in (last[1, :] - WAY, last[4:6, :]))
    opti.minimize((off + 0.03 * speed) / 0.01**2 + 1e-3 * ca.sumsqr(control))
    least = WAY / (DT * COUNT) ** 3 * (60 - 360 * u + 360 * u**2)
    opti.set_initial(control, least / UNIT)
    start = known.step(DT).mapaccum(COUNT)(ca.DM(first), ca.evalf(held(ca.DM(least).T)[0]))[0]
    opti.set_initial(state, start)
    quiet = {"print_level": 0, "sb": "yes", "max_iter": 200, "tol": 3e-4}
    quiet["hessian_approximation"] = "limited-memory"
    opti.solver("ipopt", {"print_time": False, "show_eval_warnings": False}, quiet)
    done = opti.solve_limited()
    found = done.value(places).reshape((2, COUNT, nodes)).transpose(0, 2, 1)
    return done.value(rows)[0], found, done.value(off) ** 0.5, done.stats()["success"]


if __name__ == "__main__":
    x, nodes, swing, success = carried(cable())
    print(f"{'found' if success else 'NOT FOUND'}: {1e3 * swing:.2f} mm from rest on arrival")
    figure, scene = plt.subplots(figsize=(5, 7), layout="constrained")
    for k in range(COUNT):
        scene.plot(*nodes[:, :, k], color=plt.get_cmap("viridis_r")(k / COUNT), lw=1)
    scene.plot(x, 0 * x, "k.", label="gripper")
    scene.axvline(SCANNER, color="r", ls=":", label="scanner, at half of the time")
    scene.plot(*nodes[:, -1, COUNT // 2 - 1], "r*", ms=12, label="the tip then")
    scene.set(aspect="equal", xlabel="x [m]", ylabel="y [m]")
    figure.legend(loc="outside lower center")
    Path("results").mkdir(exist_ok=True)
    figure.savefig("results/own_motion_problem.png", dpi=120)
