"""Carry a connector 0.6 m on its cable, and push it into a socket as soon as it is there.

    python scripts/examples/carry_and_insert.py        draws results/carry_and_insert.png

The gripper holds the cable 0.25 m above the connector, whose opening points down. The socket is
1 mm wider than the connector: it goes in only if it does not swing. Time is that of the slowest
swing of the hanging connector; with the motion of least jerk it would have to wait.
"""

from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

import dlo_casadi as dlo

WAY, DEPTH, PLAY = 0.6, 0.03, 1e-3  # m
DOWN = -np.pi / 2  # rad


def cable() -> dlo.FittedCable:
    """0.25 m of cable with a connector of 35 g; `dlo.load("results/...")` gives a fitted one."""
    connector = {"name": "lumped_mass", "parameters": {"mass": 0.035, "position": 0.25}}
    data = dlo.Cable(length=0.25, mass=0.02, diameter=0.007, bending_stiffness=0.02)
    held = {"gravity": (0, -9.81), "boundary": ("clamped", "free")}
    known = dlo.known_cable(data, **held, model={"n": 12, "effects": [connector]})
    return known.with_damping(0.01, air_drag=1.1)


def main(path: Path) -> tuple[dlo.Move, dlo.Move]:
    """Both motions: carried, and inserted."""
    known = cable()
    rest = known.solve(start=(0, 0), start_heading=DOWN)
    period = float(1 / rest.modes(1).frequencies[0])
    there, inside = ({"start": (WAY, y), "start_heading": DOWN} for y in (0.0, -DEPTH))
    carried = known.move(rest, there, duration=period, limits={"speed": 3.0})
    inserted = known.move(there, inside, duration=0.3)
    t = np.linspace(0, period, 100)
    u = t / period
    least = WAY * u**3 * (10 - 15 * u + 6 * u**2)
    beyond = np.append(t, period + np.linspace(0.005, 0.5, 100))
    places = np.stack([np.append(least, np.full(100, WAY)), 0 * beyond], axis=1)
    jerk = known.simulate(beyond, start=places, start_heading=DOWN, begins=rest)

    figure, (scene, tips) = plt.subplots(1, 2, figsize=(11, 4.5), layout="constrained")
    for k in np.linspace(0, len(carried.motion.t) - 1, 24).astype(int):
        shade = plt.get_cmap("viridis_r")(carried.motion.t[k] / carried.motion.t[-1])
        scene.plot(*carried.motion.points[k].T, color=shade, lw=1)
        scene.plot(*carried.motion.points[k, -1], "s", color=shade, ms=4)
    scene.set(aspect="equal", xlabel="x [m]", ylabel="y [m]", title=f"carried in {period:.2f} s")
    both = (("planned", carried.motion), ("least jerk", jerk))
    for (name, motion), style in zip(both, ("C3", "k--"), strict=True):
        late = motion.t >= period
        off = 1e3 * (motion.points[late, -1, 0] - WAY)
        tips.plot(motion.t[late] - period, off, style, label=name)
    tips.axhspan(-1e3 * PLAY / 2, 1e3 * PLAY / 2, color="0.85", label="play of the socket")
    tips.set(xlabel="time after arrival [s]", title="the connector beside the socket [mm]")
    tips.set_yscale("symlog", linthresh=1)
    tips.legend()
    figure.savefig(path, dpi=120)
    return carried, inserted


if __name__ == "__main__":
    Path("results").mkdir(exist_ok=True)
    for found in main(Path("results/carry_and_insert.png")):
        print(found)
