"""Fit arrays of points, and predict a new pose with its band: see results/fit_arrays.png."""

from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from simulated_rod import LENGTH, NOISE, QUICK, WEIGHT, measured

import dlo_casadi as dlo

ENDS = [(0.6, 0.0), (0.3, 0.1), (0.5, -0.3), (0.68, 0.2), (0.35, -0.45)]  # m
NEW = (0.25, -0.1)  # m


def main(picture: Path) -> dlo.Result:
    """Fit five poses, predict a sixth, and draw how far its points are from the prediction."""
    generator = np.random.default_rng(0)
    mass = WEIGHT * LENGTH / 9.81
    session = dlo.Session(
        dlo.Cable(length=LENGTH, mass=mass, diameter=0.006, bending_stiffness=0.1),
        [dlo.Pose((0, 0), end, points=measured(end, generator, curvature=2)) for end in ENDS],
        gravity=(0, -9.81),
        boundary=("pinned", "pinned"),
        std=NOISE,
        **QUICK,
    )
    result = session.fit(diagnosis=False)
    print(result)
    shape = result.cable.solve(end=NEW)
    points = measured(NEW, generator, curvature=2)
    draw(result, shape, points).savefig(picture, dpi=110)
    return result


def draw(result: dlo.Result, shape: dlo.Shape, points: np.ndarray) -> Figure:
    """Draw the shapes, and beside them the new pose's errors with the band that holds 90 %."""
    places = shape.curve.nearest(points)
    tangent, gap = shape.curve.at(places, 1), points - shape.curve.at(places)
    off = tangent[:, 0] * gap[:, 1] - tangent[:, 1] * gap[:, 0]

    figure = Figure(figsize=(5.4, 6.2), layout="constrained")
    above, below = figure.subplots(2, 1)
    for pose in result.poses:
        above.plot(*pose.points.T, ".", color="0.6", ms=3)
    above.plot(*shape.points.T, label="predicted")
    above.plot(*points.T, "k.", ms=4, label="measured, not fitted")
    above.set(aspect="equal", xlabel="x [m]", ylabel="y [m]", title="five fitted poses, a new one")
    above.legend(frameon=False, fontsize=8, loc="upper left")
    for half, label in (
        (np.hypot(shape.band, 1.645 * NOISE), "holds 90 % of new points"),
        (shape.band, "holds 90 % of new shapes"),
    ):
        below.fill_between(shape.s, -1e3 * half, 1e3 * half, alpha=0.25, lw=0, label=label)
    below.plot(places, 1e3 * off, "k.", label="measured minus predicted")
    below.set(xlabel="arc length [m]", ylabel="distance across the cable [mm]", ylim=(-1.2, 1.2))
    below.legend(frameon=False, fontsize=8, loc="upper right")
    return figure


if __name__ == "__main__":
    Path("results").mkdir(exist_ok=True)
    main(Path("results/fit_arrays.png"))
