"""Where to clip a door's cable so that it pulls and bends least: see results/place_clips.png.

The cable is fitted to five measured poses, then laid from the frame of a door to its leaf. Clips
may be anywhere in a box; all openings of the door are one problem.
"""

from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from simulated_rod import CABLE, HELD, QUICK, measured

import dlo_casadi as dlo

ENDS = [(0.6, 0.0), (0.3, 0.1), (0.5, -0.3), (0.68, 0.2), (0.35, -0.45)]  # m
HINGE, LEVER, OPENINGS = (0.35, 0.05), 0.2, np.linspace(-0.3, 1.5, 4)  # m, m, rad
BOX = ((0.05, -0.3), (0.3, 0.2))  # m: two corners
LIMITS = {"bend_radius": 0.05, "force": 4.0}  # m, N


def fitted() -> dlo.FittedCable:
    """The cable as its measured poses tell it."""
    generator = np.random.default_rng(0)
    poses = [dlo.Pose((0, 0), end, points=measured(end, generator)) for end in ENDS]
    known = dlo.Cable(**CABLE, bending_stiffness=0.1, rest_shape="straight")
    return dlo.Session(known, poses, **HELD, **QUICK).fit(diagnosis=False).cable


def opened(angles: np.ndarray) -> list[dict[str, np.ndarray]]:
    """The cable's end on the leaf of the door, opened by these angles."""
    around = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    return [{"end": end} for end in HINGE + LEVER * around]


def main(picture: Path, count: int = 1) -> dlo.Placing:
    """Place the clips, and draw what they do."""
    cable, poses = fitted(), opened(OPENINGS)
    placing = cable.place(count, poses, BOX, LIMITS)
    print(placing)
    draw(cable, poses, placing).savefig(picture, dpi=110)
    return placing


def draw(cable: dlo.FittedCable, poses: list[dict], placing: dlo.Placing) -> Figure:
    """Draw the shapes with the clips, and the share of each limit that each pose uses."""
    figure = Figure(figsize=(5.4, 6.2), layout="constrained")
    above, below = figure.subplots(2, 1, height_ratios=(3, 1))
    low, high = np.array(BOX)
    above.add_patch(Rectangle(low, *(high - low), color="0.92"))
    above.text(*low, " clips may be here", color="0.5", va="bottom", fontsize=8)
    for k, pose in enumerate(poses):
        shape = cable.solve(**pose, clips=placing.clips)
        above.plot(*shape.points.T, color=f"C{k}", label=f"pose_{k + 1}")
    above.plot(*zip(*(clip.place for clip in placing.clips), strict=True), "kD", label="clips")
    above.plot(*HINGE, "k+", ms=12, label="hinge")
    above.set(aspect="equal", xlabel="x [m]", ylabel="y [m]", title=f"margin {placing.margin:.0%}")
    above.legend(frameon=False, fontsize=8)
    for row, quantity in enumerate(LIMITS):
        used = [1 - use.margin for use in placing.uses if use.quantity == quantity]
        bars = np.arange(len(used)) + 0.4 * row - 0.2
        below.bar(bars, used, 0.38, label=quantity.replace("_", " "))
    below.axhline(1.0, color="k", ls="--", lw=1)
    below.set(xticks=range(len(poses)), xlabel="pose", ylabel="share of limit", ylim=(0, 1.4))
    below.set_xticklabels([f"pose_{k + 1}" for k in range(len(poses))])
    below.legend(frameon=False, fontsize=8, ncols=2, loc="upper right")
    return figure


if __name__ == "__main__":
    Path("results").mkdir(exist_ok=True)
    main(Path("results/place_clips.png"), count=2)
