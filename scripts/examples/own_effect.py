"""An effect of one's own in twenty lines, found by the diagnosis: see results/own_effect.png."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from simulated_rod import CABLE, HELD, NOISE, QUICK, measured

import dlo_casadi as dlo
from dlo_casadi.effects import PointForceAt, PointLoad
from dlo_casadi.effects.cable import Parameter


@dataclass(frozen=True)
class Balloon(PointLoad):
    """A balloon tied to the cable: V = -lift up . r(position)  [J]."""

    name = "balloon"

    def parameters(self, cable):
        """Declare the lift, at most the cable's weight, and its place."""
        weight = 9.81 * cable.mass
        lift = Parameter("lift", "N", scale=0.1 * weight, lower=0.0, upper=weight)
        return lift, self.position(cable)

    def forces(self, gravity, params):
        """Pull against gravity."""
        up = -gravity / 9.81  # nothing floats without gravity
        return (PointForceAt(params["lift"] * up, params["position"]),)


ENDS = [(0.6, 0.0), (0.3, 0.1), (0.5, -0.3), (0.2, -0.2), (0.35, -0.45)]  # m
LIFT, PLACE = 0.15, 0.3  # N, m: the truth


def main(picture: Path) -> dlo.Result:
    """Fit poses of a cable with a balloon that nobody has declared."""
    dlo.EFFECTS[Balloon.name] = Balloon
    generator = np.random.default_rng(0)
    cable = dlo.Cable(**CABLE, bending_stiffness=0.03, rest_shape="straight")
    points = [measured(end, generator, lift=LIFT, place=PLACE) for end in ENDS]
    poses = [dlo.Pose((0, 0), end, points=p) for end, p in zip(ENDS, points, strict=True)]
    result = dlo.Session(cable, poses, **HELD, **QUICK).fit()
    print(result)
    draw(result).savefig(picture, dpi=110)
    return result


def draw(result: dlo.Result) -> Figure:
    """Draw the poses with the balloon as it was found, and how well other effects would do."""
    figure = Figure(figsize=(5.4, 6.2), layout="constrained")
    above, below = figure.subplots(2, 1)
    place = result.effects[0].parameters["position"].value
    for pose, end in zip(result.poses, ENDS, strict=True):
        shape = result.cable.solve(end=end)
        above.plot(*shape.points.T, color="C0", lw=1)
        above.plot(*pose.points.T, "k.", ms=3)
        x, y = shape.curve.at([place])[0]
        above.plot([x, x], [y, y + 0.08], color="C3", lw=0.8)
        above.plot(x, y + 0.1, "o", color="C3", ms=10)
    above.set(aspect="equal", xlabel="x [m]", ylabel="y [m]", title="the balloon as it was found")
    tried = [row for row in result.candidates if row.rmse_cross_validated is not None]
    names = [row.name for row in tried]
    below.barh(names, [1e3 * row.rmse_cross_validated for row in tried], color="C0")
    below.axvline(1e3 * NOISE, color="k", ls="--", label="noise")
    below.set(xlabel="error of poses that were left out [mm]", title="effects that were refitted")
    below.invert_yaxis()
    below.legend(frameon=False)
    return figure


if __name__ == "__main__":
    Path("results").mkdir(exist_ok=True)
    main(Path("results/own_effect.png"))
