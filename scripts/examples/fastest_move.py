"""The fastest motion on which a cable never pulls its gripper by more than 2 N.

    python scripts/examples/fastest_move.py        draws results/fastest_move.png

A heavy cable hangs from a gripper that is carried 0.5 m sideways. Its weight is 1.2 N; what the
limit leaves is for acceleration. The motion of least jerk in the same time needs less, and leaves
the cable swinging.
"""

from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

import dlo_casadi as dlo

WAY, PULL = 0.5, 2.0  # m, N
DOWN = -np.pi / 2  # rad


def cable() -> dlo.FittedCable:
    """0.6 m with 0.2 kg/m; `dlo.load("results/...")` gives a fitted one."""
    data = dlo.Cable(length=0.6, mass=0.12, diameter=0.01, bending_stiffness=0.03)
    ends = ("clamped", "free")
    known = dlo.known_cable(data, gravity=(0, -9.81), boundary=ends, model={"n": 12})
    return known.with_damping(0.01, air_drag=1.1)


def main(path: Path) -> tuple[dlo.Move, float]:
    """The motion, and the largest pull [N] on that of least jerk; draws both."""
    known = cable()
    here, there = ({"start": (x, 0), "start_heading": DOWN} for x in (0, WAY))
    found = known.move(here, there, limits={"force": PULL})
    t = found.motion.t
    u = np.clip(t / found.duration, 0, 1)
    places = np.outer(u**3 * (10 - 15 * u + 6 * u**2), (WAY, 0))
    jerk = known.simulate(t, start=places, start_heading=DOWN)

    figure, axes = plt.subplots(1, 2, figsize=(11, 4), layout="constrained")
    for name, style, motion in (("fastest", "C3", found.motion), ("least jerk", "k--", jerk)):
        pulls = np.linalg.norm(motion.start_force, axis=1)
        off = 1e3 * (motion.points[:, -1, 0] - motion.points[:, 0, 0])
        for one, values in zip(axes, (pulls, off), strict=True):
            one.plot(t, values, style, label=name)
    for one, title in zip(
        axes, ("pull on the gripper [N]", "tip beside the gripper [mm]"), strict=True
    ):
        one.axvline(found.duration, color="0.8", zorder=0)
        one.set(xlabel=f"time [s], arrival after {found.duration:.3f} s", title=title)
        one.legend()
    axes[0].axhline(PULL, ls=":", color="0.4")
    figure.savefig(path, dpi=120)
    return found, float(np.linalg.norm(jerk.start_force, axis=1).max())


if __name__ == "__main__":
    Path("results").mkdir(exist_ok=True)
    move, other = main(Path("results/fastest_move.png"))
    print(move)
    print(f"least jerk in the same time pulls by {other:.2f} N")
