"""A connector falls off a cable that a robot carries: which pose it was, and what was lost.

python scripts/examples/pick_and_place.py        draws results/pick_and_place.png
"""

from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

import dlo_casadi as dlo

STD, S = 4e-4, np.linspace(0.04, 0.56, 12)  # m: noise, and markers along the cable
DATA = {"length": 0.6, "mass": 0.06, "diameter": 0.008}
HELD = {"gravity": (0, -9.81), "boundary": ("clamped", "clamped")}
CONNECTOR, PLACE, LOST = 0.012, 0.35, 31  # kg, m, pose


def cable(connector: float) -> dlo.FittedCable:
    """The true cable, which only the simulated camera knows."""
    weight = {"name": "lumped_mass", "parameters": {"mass": connector, "position": PLACE}}
    data = dlo.Cable(**DATA, bending_stiffness=0.0095)
    return dlo.known_cable(data, **HELD, model={"n": 20, "effects": [weight]})


def seen(connector: float, t: float, rng: np.random.Generator) -> dlo.Pose:
    """Markers at a share t of the way of the gripper, which comes and goes."""
    turn = 2 * np.pi * t
    held = {"start": (0.0, 0.0), "end": (0.42 - 0.08 * np.cos(turn), 0.06 * np.sin(2 * turn))}
    held |= {"start_heading": -0.6, "end_heading": 0.6 + 0.3 * np.sin(turn)}
    points = cable(connector).solve(**held).curve.at(S)
    return dlo.Pose(points=points + STD * rng.normal(size=points.shape), at=S, **held)


def fitted(rng: np.random.Generator) -> dlo.FittedCable:
    """The cable as a session of eight poses at the bench knows it."""
    session = dlo.Session(
        dlo.Cable(**DATA, bending_stiffness=0.01, rest_shape="straight"),
        [seen(CONNECTOR, t, rng) for t in np.linspace(0.0, 0.9, 8)],
        **HELD,
        std=STD,
        model={"n": 20, "effects": [{"name": "lumped_mass"}]},
        diagnosis={"enabled": False},
    )
    return session.fit().cable


def main(picture: Path, count: int = 60, lost: int = LOST) -> dlo.FittedCable:
    """Carry the cable through `count` poses; return it as the tracker knows it then."""
    rng = np.random.default_rng(1)
    tracker = fitted(rng).tracker(STD)
    masses, away = [], []
    figure, (scene, below) = plt.subplots(2, 1, figsize=(8, 8), layout="constrained")
    for k in range(1, count + 1):
        pose = seen(CONNECTOR if k < lost else 0.0, k / 20, rng)
        update = tracker.update(pose)
        if update.change:
            print(f"pose {k}: {update.change}")
            below.plot(k, 0.0, "C3^", clip_on=False)
        mass = tracker.params["lumped_mass.mass"]
        masses.append((1e3 * mass.value, 2e3 * mass.std))
        away.append(1e3 * update.rms)
        if abs(k - lost) < 5:
            scene.plot(*np.transpose(pose.points), ".-", color="C0" if k < lost else "C3")
    known, poses = np.transpose(masses), np.arange(1, count + 1)
    below.fill_between(poses, known[0] - known[1], known[0] + known[1], alpha=0.3)
    below.plot(poses, known[0], label="connector [g], and two standard deviations")
    below.bar(poses, away, color="0.7", label="distance from the prediction [mm]")
    below.axvline(lost - 0.5, color="C3", ls="--", label="the connector falls off")
    scene.set(aspect="equal", xlabel="x [m]", ylabel="y [m]", title="Before (blue), after (red)")
    below.set(xlabel="pose", title="An alarm (triangle), and the cable after it")
    below.legend()
    figure.savefig(picture, dpi=90)
    return tracker.cable


if __name__ == "__main__":
    Path("results").mkdir(exist_ok=True)
    main(Path("results/pick_and_place.png"))
