"""Where to hold the end next, so that the stiffness is known best: see results/next_pose.png.

A pose there shrinks the covariance C of the fitted parameters, to first order, to

    C' = C - C J^T (J C J^T + S)^-1 J C

with the shape's derivatives J across the cable, from `cable.function()`, and the covariance S of
its points: their noise, and how well the end will be held.
"""

from pathlib import Path

import casadi as ca
import numpy as np
from matplotlib.figure import Figure
from simulated_rod import CABLE, HELD, NOISE, QUICK, measured

import dlo_casadi as dlo

TAKEN = [(0.7, 0.0), (0.66, 0.2), (0.7, -0.1)]  # m, ends of the first poses
POINTS, END_STD = 30, 2e-4  # measured points of a pose; m


def fit(ends: list[tuple[float, float]], generator: np.random.Generator) -> dlo.Result:
    """Fit simulated poses of a cable that is straight at rest."""
    cable = dlo.Cable(**CABLE, bending_stiffness=0.03, rest_shape="straight")
    poses = [dlo.Pose((0, 0), end, points=measured(end, generator)) for end in ends]
    return dlo.Session(cable, poses, **HELD, **QUICK).fit(diagnosis=False)


def foreseen(cable: dlo.FittedCable, ends: np.ndarray) -> np.ndarray:
    """Standard deviation of EI [N m^2] after one more pose with each of the ends (m, 2)."""
    names, covariance = cable.covariance.names, cable.covariance.values
    values = [cable.params[name].value for name in names]
    end, by = ca.MX.sym("end", 2), ca.MX.sym("parameters", len(names))
    shape = cable.function(parameters=names)
    points = shape(pose=ca.vertcat(0, 0, end, 0, 0), parameters=by)["points"]
    jacobians = [ca.jacobian(ca.vec(points), x) for x in (by, end)]
    slopes = ca.Function("slopes", [end, by], [points.T, *jacobians])
    found = []
    for place in ends:
        r, *slope = map(np.array, slopes(place, values))
        t = np.gradient(r, axis=0)
        normal = t[:, ::-1] * [-1, 1] / np.linalg.norm(t, axis=1)[:, None]
        J, by_end = (np.einsum("ki,kiq->kq", normal, j.reshape(len(r), 2, -1)) for j in slope)
        # The ruler, which the function does not know, moves points away from the start.
        J[:, names.index("image_scale.factor")] = (normal * r).sum(axis=1)
        S = NOISE**2 * len(r) / POINTS * np.eye(len(r)) + END_STD**2 * by_end @ by_end.T
        JC = J @ covariance
        found.append(np.sqrt((covariance - JC.T @ np.linalg.solve(JC @ J.T + S, JC))[0, 0]))
    return np.array(found)  # NaN out of reach


def main(picture: Path, size: int = 20) -> tuple[float, float, float]:
    """Draw the map; fit with the best pose: EI's std before it, as foreseen, and as fitted."""
    generator = np.random.default_rng(0)
    cable = fit(TAKEN, generator).cable
    x, y = np.meshgrid(np.linspace(0.08, 0.78, size), np.linspace(-0.65, 0.4, size))
    ends = np.column_stack([x.ravel(), y.ravel()])
    std = foreseen(cable, ends)
    best = tuple(ends[np.nanargmin(std)])
    told = fit([*TAKEN, best], generator).params["bending_stiffness"].std
    figure = Figure(figsize=(5.4, 4.6), layout="constrained")
    axes, percent = figure.subplots(), 100 / cable.p[0]
    drawn = axes.pcolormesh(x, y, percent * std.reshape(x.shape), cmap="viridis_r")
    figure.colorbar(drawn, label="standard deviation of EI after a pose there [%]")
    for end in (*TAKEN, best):
        style = {"color": "C1", "lw": 2.5} if end is best else {"color": "0.4", "lw": 1}
        axes.plot(*cable.solve(end=end).points.T, **style)
    before = cable.params["bending_stiffness"].std
    title = f"EI known to {percent * before:.1f} %, then to {percent * told:.2f} %"
    axes.set(aspect="equal", xlabel="end x [m]", ylabel="end y [m]", title=title)
    figure.savefig(picture, dpi=110)
    return before, float(np.nanmin(std)), told


if __name__ == "__main__":
    Path("results").mkdir(exist_ok=True)
    print("std of EI before, foreseen, fitted:", main(Path("results/next_pose.png")))
