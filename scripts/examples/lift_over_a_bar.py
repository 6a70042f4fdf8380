"""Both ends of a cable carried past a bar, higher in the middle of the way.

    python scripts/examples/lift_over_a_bar.py        draws results/lift_over_a_bar.png

The cable hangs between two hands. On the straight way its sag would hit the bar. No way past the
bar is given: the clearance is a limit along the whole motion, and the cable is at rest on arrival.
"""

from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

import dlo_casadi as dlo

BAR, RADIUS, GAP = (0.85, -0.28), 0.03, 0.02  # m
WAY, SPAN = 0.9, 0.4  # m


def cable() -> dlo.FittedCable:
    """0.7 m between two clamps; `dlo.load("results/...")` gives a fitted one."""
    data = dlo.Cable(length=0.7, mass=0.08, diameter=0.008, bending_stiffness=0.012)
    ends = ("clamped", "clamped")
    known = dlo.known_cable(data, gravity=(0, -9.81), boundary=ends, model={"n": 12})
    return known.with_damping(0.02, air_drag=1.1)


def held(x: float) -> dict[str, object]:
    """Both hands, the start at x [m]."""
    return {"start": (x, 0), "end": (x + SPAN, 0), "start_heading": -0.8, "end_heading": 0.8}


def main(path: Path, duration: float = 1.2) -> dlo.Move:
    """The motion of the duration [s]; draws it."""
    bar = dlo.Obstacle(kind="sphere", center=BAR, radius=RADIUS, name="bar")
    known = cable()
    limits = {"clearance": GAP, "bend_radius": 0.03}
    found = known.move(held(0), held(WAY), duration=duration, limits=limits, obstacles=[bar])

    figure, (scene, gaps) = plt.subplots(1, 2, figsize=(11, 4), layout="constrained")
    motion = found.motion
    for k in np.linspace(0, len(motion.t) - 1, 16).astype(int):
        shade = plt.get_cmap("viridis_r")(motion.t[k] / motion.t[-1])
        scene.plot(*motion.points[k].T, color=shade, lw=1)
        scene.plot(*motion.points[k, [0, -1]].T, "o", color=shade, ms=3)
    scene.add_patch(plt.Circle(BAR, RADIUS, color="0.4"))
    scene.add_patch(plt.Circle(BAR, RADIUS + GAP, fill=False, ls="--", color="0.4"))
    scene.set(aspect="equal", xlabel="x [m]", ylabel="y [m]", title=f"carried in {duration:g} s")
    surface = np.linalg.norm(motion.points - BAR, axis=2).min(axis=1) - RADIUS
    gaps.plot(motion.t, 1e3 * (surface - known.model.cable.diameter / 2), "C3")
    gaps.axhline(1e3 * GAP, ls="--", color="0.4")
    gaps.set(xlabel="time [s]", title="clearance from the bar [mm]", ylim=(0, 120))
    figure.savefig(path, dpi=120)
    return found


if __name__ == "__main__":
    Path("results").mkdir(exist_ok=True)
    print(main(Path("results/lift_over_a_bar.png")))
