"""Draw what each effect does to a cable, for the documentation: python scripts/draw_effects.py.

Docs show one picture per effect: three poses of a cable with it and without it, in a plane and in
space as far as it applies there. Effects are drawn larger than they are on a test stand.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from scipy.spatial.transform import Rotation

import dlo_casadi as dlo
from dlo_casadi.arrays import FloatArray
from dlo_casadi.effects import CableData, Setup
from dlo_casadi.equilibrium.pose import HeldPose
from dlo_casadi.estimation.prediction import predict_poses
from dlo_casadi.model.cable_model import CableModel
from dlo_casadi.model.clips import HeldClip
from dlo_casadi.report.canvas import WIDTH, line_of
from dlo_casadi.report.scene import seen
from dlo_casadi.rod.obstacles import Plane
from dlo_casadi.rod.supports import SupportKind
from dlo_casadi.show.style import BLACK, BLUE, GREY, styled

PICTURES = Path(__file__).parents[1] / "docs/pages/effects"
LENGTH, ELEMENTS = 0.8, 40
IN_PLANE = CableData(LENGTH, 0.1, 0.008, 0.02, straight=True)
IN_SPACE = CableData(LENGTH, 0.1, 0.008, 0.02, straight=True, torsional_stiffness=0.015)
# A camera [m] that does not stand before the middle of the cable, so that its rays are oblique.
CAMERA = (0.9, 0.3, 1.2)


@dataclass(frozen=True)
class Shown:
    """How an effect is drawn: its parameters in the plane, in space, and how the ends are held."""

    plane: Mapping[str, float] = field(default_factory=dict)
    space: Mapping[str, float] = field(default_factory=dict)
    clamped: bool = False
    history: bool = False  # the third pose is the first one again
    clip: SupportKind | None = None  # what holds the middle
    touching: bool = False  # the cable lies on a table
    level: bool = False  # all ends are at one height


# End of the pose that leaves a set [m], and the floor's depth below the cable [m].
TIGHT, FLOOR = (0.1, 0.06, 0.1), 0.1
# Height of the table [m].
TABLE = -0.17
SIDES = np.array([-1.0, 1.0])
STYLES = ({"color": GREY, "ls": "--", "lw": 1.4}, {"color": BLUE, "ls": "-", "lw": 2.2})


SHOWN = {
    "lumped_mass": Shown({"mass": 0.15, "position": 0.25}, {"mass": 0.15, "position": 0.25}),
    "point_force": Shown(
        {"fx": 0.4, "fy": 0.2, "position": 0.3}, {"fx": 0, "fy": 0.5, "fz": 0.5, "position": 0.3}
    ),
    "tether": Shown(
        {"stiffness": 4, "position": 0.4, "anchor_x": 0.6, "anchor_y": -0.5},
        {"stiffness": 4, "position": 0.4, "anchor_x": 0.6, "anchor_y": 0.3, "anchor_z": -0.5},
    ),
    "side_load": Shown(
        {"force_per_length": 0.6}, {"force_per_length_x": 0, "force_per_length_y": 0.6}
    ),
    "gravity_tilt": Shown({"angle": 0.5}, {"angle_x": 0.5, "angle_y": 0.0}),
    "mass_error": Shown({"factor": 5}, {"factor": 5}),
    "stiffness_gradient": Shown({"slope": 0.9}, {"slope": 0.9}),
    "stiff_section": Shown(
        {"start": 0.3, "end": 0.5, "factor": 20}, {"start": 0.3, "end": 0.5, "factor": 20}
    ),
    "bending_softening": Shown({"softness": 0.3}, {"softness": 0.3}),
    "bending_anisotropy": Shown({}, {"ratio": 0.1, "angle": 0.4}),
    "axial_stretch": Shown({"compliance": 0.08}, {"compliance": 0.08}),
    "length_error": Shown({"length_difference": 0.06}, {"length_difference": 0.06}),
    "start_spring": Shown({"stiffness": 0.15, "heading": -0.3}),
    "end_spring": Shown({"stiffness": 0.15, "heading": 0.3}),
    "clamp_angle": Shown({"start_heading_error": -0.5, "end_heading_error": 0.0}, clamped=True),
    "clamp_rotation": Shown({}, {"start_y": 0.4, "start_z": 0.4, "end_y": 0, "end_z": 0}),
    "clamp_compliance": Shown({"start": 6, "end": 0}, {"start": 6, "end": 0}, clamped=True),
    "end_offset": Shown({"dx": 0.06, "dy": -0.04}, {"dx": 0.06, "dy": 0.06, "dz": -0.04}),
    "clip_offset": Shown(
        {"dx": 0.04, "dy": 0.03}, {"dx": 0.04, "dy": 0.04, "dz": 0.03}, clip="pinned"
    ),
    "clip_slip": Shown({"ds": 0.04}, {"ds": 0.04}, clip="pinned"),
    "clip_angle": Shown({"heading_error": 0.4}, {"y": 0.4, "z": 0.4}, clip="clamped"),
    "obstacle_offset": Shown({}, {"offset": 0.06}, touching=True),
    "contact_plane": Shown({}, {"height": -0.17}, level=True),
    "rest_curvature_drift": Shown({"rate": 0.6}, {"rate": 0.6}, history=True),
    "plastic_set": Shown(
        {"yield_curvature": 3, "share": 0.9}, {"yield_curvature": 3, "share": 0.9}, history=True
    ),
    "image_scale": Shown({"factor": 1.08}, {"factor": 1.08}),
    "image_distortion": Shown({"coefficient": 0.6}),
    "standoff_error": Shown({"distance": 0.08}),
    "camera_frame": Shown({}, {"rotation_z": 0.1, "translation_z": 0.04}),
}


def poses_in_plane(clamped: bool) -> list[HeldPose]:
    """Three poses between pins, or clamps."""
    ends = ((0.62, 0.05), (0.3, 0.12), (0.45, -0.35))
    held = {"start_heading": 0.0, "end_heading": 0.0} if clamped else {}
    return [HeldPose((0.0, 0.0), end, camera_center=CAMERA, **held) for end in ends]


def poses_in_space() -> list[HeldPose]:
    """Three poses between clamps; the end clamp is turned about the vertical."""
    held = (((0.55, 0.1, 0.0), 40), ((0.25, 0.3, 0.1), 90), ((0.45, 0.15, -0.3), 60))
    return [
        HeldPose(
            (0.0, 0.0, 0.0),
            end,
            start_orientation=(0.0, 0.0, 0.0, 1.0),
            end_orientation=tuple(Rotation.from_euler("z", degrees, degrees=True).as_quat()),
        )
        for end, degrees in held
    ]


def middle_clip(pose: HeldPose, kind: SupportKind) -> HeldClip:
    """A clip that holds the middle of the cable below the middle of its ends, along the chord."""
    start, end = np.array(pose.start), np.array(pose.end)
    place = (start + end) / 2
    turn = Rotation.align_vectors([np.append(end - start, 0.0)[:3]], [[1.0, 0.0, 0.0]])[0]
    along = {"heading": turn.as_rotvec()[2]} if len(end) == 2 else {"orientation": turn.as_quat()}
    return HeldClip(kind, (*place[:-1], place[-1] - 0.1), LENGTH / 2, **along)


def shapes(name: str, values: Mapping[str, float], shown: Shown, spatial: bool) -> list[FloatArray]:
    """Points of each pose, as measured; without the effect where there are no values."""
    cable = IN_SPACE if spatial else IN_PLANE
    held = "clamped" if spatial or shown.clamped else "pinned"
    gravity = (0.0, 0.0, -9.81) if spatial else (0.0, -9.81)
    kinds: tuple[SupportKind, ...] = () if shown.clip is None else (shown.clip,)
    setup = Setup(cable, held, held, gravity, center=(0.4, -0.1), camera=True, clips=kinds)
    effects = (dlo.EFFECTS[name].made_for(setup),) if values else ()
    up = tuple(-g / 9.81 for g in gravity)
    tables = (Plane(tuple(TABLE * x for x in up), up),) if shown.touching else ()
    options = {"start": held, "end": held, "gravity": gravity, "effects": effects, "clips": kinds}
    options |= {"obstacles": tables}
    model = CableModel(cable, ELEMENTS, **options)
    p = model.nominal
    for key, value in values.items():
        p[model.names.index(f"{name}.{key}")] = value
    poses = poses_in_space() if spatial else poses_in_plane(shown.clamped)
    if shown.touching or shown.level:
        poses = [replace(pose, end=(*pose.end[:-1], 0.0)) for pose in poses]
    if shown.clip is not None:
        poses = [replace(pose, clips=(middle_clip(pose, shown.clip),)) for pose in poses]
    if shown.history:
        poses = [poses[0], replace(poses[1], end=TIGHT[: len(cable.axes)]), poses[0]]
    found = predict_poses(model, p, np.zeros(model.chain.n_rests), poses)
    s = np.linspace(0, LENGTH, 81)
    return [item.seen.curve.at(s) for item in found]


def draw(axes: Axes, *pair: FloatArray) -> FloatArray:
    """One pose without the effect and with it, in space with its shadow on the floor: its box."""
    drawn, floor = [], min(points[:, -1].min() for points in pair) - FLOOR
    for points, style in zip(pair, STYLES, strict=True):
        drawn.append(seen(points))
        if points.shape[1] == 3:
            drawn.append(seen(points * [1, 1, 0] + [0, 0, floor]))
            axes.plot(*drawn[-1].T, color="#C9D0D8", lw=1.2, ls=style["ls"])
        axes.plot(*seen(points).T, **style)
        axes.plot(*seen(points)[[0, -1]].T, ls="none", marker="o", ms=3, color=BLACK)
    every = np.concatenate(drawn)
    return np.array([every.min(axis=0), every.max(axis=0)])


def picture(name: str, shown: Shown) -> None:
    """Write the picture of one effect."""
    rows = [
        (values, spatial)
        for values, spatial in ((shown.plane, False), (shown.space, True))
        if values
    ]
    heights = [2.1 if spatial else 1.5 for _, spatial in rows]
    with styled((WIDTH, 0.35 + sum(heights))) as drawing:
        panels = drawing.subplots(len(rows), 3, squeeze=False, height_ratios=heights)
        for own, (values, spatial) in zip(panels, rows, strict=True):
            without, with_it = (shapes(name, v, shown, spatial) for v in ({}, values))
            drawn = [draw(*panel) for panel in zip(own, without, with_it, strict=True)]
            half = np.ptp(drawn, axis=1).max(axis=0) / 2 * 1.06
            for axes, box in zip(own, drawn, strict=True):
                middle = np.mean(box, axis=0)
                axes.set(xlim=middle[0] + half[0] * SIDES, ylim=middle[1] + half[1] * SIDES)
                axes.set_aspect("equal")
                axes.set_axis_off()
            own[0].set_title("in space" if spatial else "in a plane", loc="left", fontsize=9)
            if shown.history:
                for axes, title in zip(own[1:], ("then", "then the first pose again"), strict=True):
                    axes.set_title(title, fontsize=9)
        labels = ("without", f"with {name}")
        lines = [line_of(label, **style) for label, style in zip(labels, STYLES, strict=True)]
        drawing.legend(handles=lines, loc="outside lower center", ncols=2, fontsize=9)
        with mpl.rc_context({"svg.hashsalt": name}):  # equal drawings are equal files
            drawing.savefig(PICTURES / f"{name}.svg", metadata={"Date": None})


def main() -> None:
    """Draw all of them."""
    PICTURES.mkdir(exist_ok=True)
    for name in dlo.EFFECTS:
        picture(name, SHOWN[name])


if __name__ == "__main__":
    main()
