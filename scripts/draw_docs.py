"""Draw the pictures of the documentation: python scripts/draw_docs.py (three minutes)."""

import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

import dlo_casadi as dlo
from dlo_casadi.cable.picture import draw_shape
from dlo_casadi.effects import CableData
from dlo_casadi.equilibrium.curve import NodeCurve
from dlo_casadi.equilibrium.pose import HeldPose
from dlo_casadi.equilibrium.solve import solve_equilibrium
from dlo_casadi.model.assembly import Assembly, Inputs
from dlo_casadi.model.cable_model import CableModel
from dlo_casadi.model.clips import HeldClip
from dlo_casadi.session.measure import draw_steps

ROOT = Path(__file__).parents[1]
PICTURES = ROOT / "docs/pages/pictures"
TITLES = {
    "1_workplane": "1 the board's plane, within reach of the cable",
    "2_contrast": "2 what stands out in the colour of the cable",
    "3_strands": "3 strands, chained from start to end",
    "4_centerline": "4 the line: blue measured, red hidden",
}


def draw_camera_steps() -> None:
    """The four pictures of `dlo check --show` for a photograph with a card before the cable."""
    session = dlo.Session.load(ROOT / "tests/data/bench/orange/session.yaml")
    pose = session.experiment.poses[1]
    pictures = draw_steps(session, pose)
    drawing = Figure(figsize=(9, 6.4), layout="constrained")
    for axes, (name, title) in zip(drawing.subplots(2, 2).ravel(), TITLES.items(), strict=True):
        axes.imshow(pictures[f"{pose.name}_{name}"][..., ::-1])
        axes.set_title(title, fontsize=10)
        axes.set_axis_off()
    drawing.savefig(PICTURES / "camera_steps.jpg", dpi=110, pil_kwargs={"quality": 82})


def draw_examples() -> None:
    """Run the examples, which draw results/<name>.png."""
    for script in sorted((ROOT / "scripts/examples").glob("*.py")):
        subprocess.run([sys.executable, script], cwd=ROOT, check=True)
        picture = ROOT / "results" / f"{script.stem}.png"
        if picture.exists():
            shutil.copy(picture, PICTURES)


def draw_clips() -> None:
    """A cable that a pinned clip, a saddle and an eyelet hold between its ends."""
    clips = (
        HeldClip("pinned", (0.2, 0.06), 0.28, name="pinned"),
        HeldClip("clamped", (0.42, 0.1), 0.56, heading=-0.5, name="clamped"),
        HeldClip("eyelet", (0.62, 0.0), name="eyelet"),
    )
    kinds = tuple(clip.kind for clip in clips)
    model = CableModel(CableData(1.0, 0.06, 0.005, 0.01), n=40, n_rest=0, clips=kinds)
    pose = HeldPose((0.0, 0.0), (0.8, 0.05), clips=clips)
    eq = solve_equilibrium(model, model.nominal, np.zeros(40), pose)
    given = Inputs.of(model.nominal, np.zeros(40), pose.vector[None])
    curve = NodeCurve.of(1.0, Assembly(model, eq.shapes, given).curve()[0])
    held = zip(clips, eq.clips, strict=True)
    drawing = draw_shape(
        curve.at(np.linspace(0.0, 1.0, 201)),
        {"start": eq.start_force, "end": eq.end_force},
        clips={clip.name: (np.array(clip.place), load.force) for clip, load in held},
        band=None,
        other=None,
        title="three clips between two pins",
        remark=f"smallest bend radius {1e3 * eq.min_bend_radius:.0f} mm",
        alarming=False,
    )
    drawing.savefig(PICTURES / "clips.png", dpi=80)


def main() -> None:
    """Draw all of them."""
    PICTURES.mkdir(exist_ok=True)
    draw_clips()
    draw_camera_steps()
    draw_examples()
    result = dlo.fit(ROOT / "configs/cable.yaml")
    result.plot().savefig(PICTURES / "poses.png", dpi=100)
    result.cable.solve(end=(0.3, -0.1)).plot().savefig(PICTURES / "shape.png", dpi=80)
    print(result)


if __name__ == "__main__":
    main()
