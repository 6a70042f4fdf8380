"""Random sessions of which the truth is known: cables, poses, noise, and what is not declared.

Simulated by this toolkit's own model on a fine mesh, so that nothing can be missing but what is
hidden. Sizes run from hardly to plainly visible; the declared stiffness is up to ten times off.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

import dlo_casadi as dlo
from dlo_casadi.effects import EFFECTS, CableData, ContactPlane
from dlo_casadi.equilibrium.pose import HeldPose
from dlo_casadi.estimation.prediction import Prediction, predict_poses
from dlo_casadi.model.cable_model import CableModel
from dlo_casadi.model.pose_scatter import PoseScatter, effect_of, modes_in
from dlo_casadi.sensing.noise import NoiseModel

Draw = Callable[..., float]
Values = dict[str, float]

# Largest factor of the true stiffness to the declared one, either way.
DECLARED_OFF = 10.0
POSES = 14
# Lines: points, noise of one coordinate [m], share of it that is correlated along the cable, its
# correlation length [m]. Markers: their number and noise [m].
LINE = (150, 1e-3, 0.5, 0.03)
MARKERS = (12, 3e-4)
# Noise of readings [N], [N m].
FORCE_STD, MOMENT_STD = 0.01, 0.001
ELEMENTS = {2: 40, 3: 24}
# Most that half the size of the elements may move a pose [m, RMS], a tenth of the markers' noise;
# times that they are halved for it: a cable in space that softens may need 96.
FINE, HALVED = 0.1 * MARKERS[1], 2
# Number of elements of cables on a table, times those: nodes touch it, and where a cable touches in
# one point its middle moves as far as that node is from the lowest place. Six poses of a set were
# up to 3.1 mm from their shapes on 320 elements with 40, and up to 0.4 mm with 160.
FINER_ON_TABLES = 4
# Sizes of what differs from pose to pose, by length [m]: each moves the cable by several times the
# noise.
RANDOM_SIZES = {
    "rest_curvature": lambda length: 0.15 / length,
    "pin_moment": lambda length: 0.3 / length,
    "clamp_angle": lambda length: 0.05,
    "clamp_rotation": lambda length: 0.05,
    "end_offset": lambda length: 0.008 * length,
    "length_error": lambda length: 0.008 * length,
}

# Effects that may be hidden at a size that moves the cable by far more than the noise; length of a
# stiff section, as a share of the cable's.
STRONG, SECTION = ("bending_softening", "stiff_section"), 0.12

# Ends that show what differs from pose to pose in the plane. Between two clamps a smooth rest
# curvature of that size moves a cable by 0.1 mm: its mean and slope do not bend a beam there.
SHOWN_BY = {"rest_curvature": "pinned", "pin_moment": "pinned", "clamp_angle": "clamped"}


def _sizes(
    name: str,
    cable: CableData,
    typical: float,
    generator: np.random.Generator,
    *,
    strong: bool = False,
) -> Values:
    """Parameters of an effect, drawn; `typical` [1/m] is the cable's curvature."""
    length, weight = cable.length, 9.81 * cable.mass
    axes = cable.axes

    def signed(low: float, high: float) -> float:
        return float(generator.choice([-1.0, 1.0]) * generator.uniform(low, high))

    def spread(low: float, high: float) -> float:
        return float(np.exp(generator.uniform(np.log(low), np.log(high))))

    place = generator.uniform(0.25, 0.75) * length
    force = weight * generator.uniform(0.1, 0.8)
    way = generator.standard_normal(len(axes))
    way *= force / np.linalg.norm(way)
    anchor = [0.4 * length, signed(0.15, 0.4) * length, signed(0.15, 0.4) * length]
    return {
        "lumped_mass": lambda: {"mass": spread(0.02, 0.6) * cable.mass, "position": place},
        "point_force": lambda: (
            {"position": place} | {f"f{axis}": float(x) for axis, x in zip(axes, way, strict=True)}
        ),
        "tether": lambda: (
            {"stiffness": spread(1.0, 15.0), "position": place}
            | {f"anchor_{axis}": x for axis, x in zip(axes, anchor, strict=False)}
        ),
        "gravity_tilt": lambda: (
            {"angle": signed(0.03, 0.15)}
            if len(axes) == 2
            else {"angle_x": signed(0.02, 0.1), "angle_y": signed(0.02, 0.1)}
        ),
        "mass_error": lambda: {"factor": 1 + signed(0.05, 0.4)},
        "stiffness_gradient": lambda: {"slope": signed(0.1, 0.6)},
        "bending_softening": lambda: {
            "softness": 1 / (generator.uniform(0.5, 1.0 if strong else 2.0) * typical)
        },
        "stiff_section": lambda: {
            "start": place - SECTION / 2 * length,
            "end": place + SECTION / 2 * length,
            "factor": spread(3.0, 8.0),
        },
        "bending_anisotropy": lambda: {"ratio": spread(1.3, 4.0), "angle": signed(0.0, 1.4)},
        "axial_stretch": lambda: {"compliance": spread(0.003, 0.03) / weight},
        "length_error": lambda: {"length_difference": signed(0.004, 0.02) * length},
        "clamp_angle": lambda: {
            "start_heading_error": signed(0.03, 0.2),
            "end_heading_error": signed(0.0, 0.05),
        },
        "clamp_rotation": lambda: {"start_y": signed(0.03, 0.2), "start_z": signed(0.03, 0.2)},
        "rest_curvature_drift": lambda: {"rate": generator.uniform(0.05, 0.3)},
        "camera_frame": lambda: (
            {f"rotation_{axis}": signed(0.005, 0.03) for axis in "xyz"}
            | {f"translation_{axis}": signed(0.001, 0.005) for axis in "xyz"}
        ),
    }[name]()


def about_axis(values: Values, near: float = 0.0) -> Values:
    """The same stiffnesses about both axes, EI that about the axis nearer to an angle [rad]."""
    ratio, angle = (values.get(f"bending_anisotropy.{name}", 0.0) for name in ("ratio", "angle"))
    if not ratio or abs(np.remainder(angle - near + np.pi / 2, np.pi) - np.pi / 2) <= np.pi / 4:
        return values
    return values | {
        "bending_stiffness": values["bending_stiffness"] * ratio,
        "bending_anisotropy.ratio": 1 / ratio,
        "bending_anisotropy.angle": angle - np.copysign(np.pi / 2, angle),
    }


HIDDEN = {
    2: (
        "lumped_mass", "point_force", "tether", "gravity_tilt", "mass_error", "stiffness_gradient",
        "bending_softening", "axial_stretch", "length_error", "clamp_angle", "rest_curvature_drift",
    ),
    3: (
        "lumped_mass", "point_force", "tether", "gravity_tilt", "mass_error", "stiffness_gradient",
        "bending_softening", "bending_anisotropy", "length_error", "clamp_rotation",
        "rest_curvature_drift", "camera_frame",
    ),
}  # fmt: skip


@dataclass(frozen=True)
class Simulated:
    """A session and its truth.

    Parameters
    ----------
    session : Session
        As a user would declare it, without what is hidden.
    hidden : tuple of str
        Names of the effects that are not declared.
    values : dict
        True parameters by qualified name [SI].
    kind : str
        How both ends are held, and what is measured: "pinned, lines".
    """

    session: dlo.Session
    hidden: tuple[str, ...]
    values: Mapping[str, float]
    kind: str


def simulated(
    generator: np.random.Generator,
    dimension: int,
    count: int,
    random: str = "",
    table: bool = False,
    strong: str = "",
    size: int = POSES,
) -> Simulated:
    """A random session with `count` hidden effects, in the plane (2) or in space (3).

    `random`: what differs from pose to pose, see `PoseScatter`; nothing by default. `table`: two
    fitted poses to all that hang low enough touch a level plane. `strong`: one of STRONG that is
    hidden between two clamps. `size`: number of poses.
    """
    while True:
        found = _tried(generator, dimension, count, random, table, strong, size)
        if found is not None:
            return found


def _tried(
    generator: np.random.Generator,
    dimension: int,
    count: int,
    random: str,
    table: bool,
    strong: str,
    size: int,
) -> Simulated | None:
    """As `simulated`; None where the poses have no stable equilibria."""
    length, mass = generator.uniform(0.5, 1.0), generator.uniform(0.03, 0.12)
    weight = 9.81 * mass
    bending = weight * length**2 * np.exp(generator.uniform(np.log(0.03), np.log(0.3)))
    torsion = bending * generator.uniform(0.5, 0.9)
    off = np.exp(generator.uniform(-1.0, 1.0) * np.log(DECLARED_OFF))
    cable = CableData(length, mass, 0.006, bending * off)
    if dimension == 3:
        cable = CableData(length, mass, 0.006, bending * off, torsional_stiffness=torsion * off)
    held = "clamped" if dimension == 3 or generator.random() < 0.5 else "pinned"
    if dimension == 2:
        held = "clamped" if strong else SHOWN_BY.get(random, held)
    chosen = [name for name in HIDDEN[dimension] if held == "clamped" or "clamp" not in name]
    hidden = tuple(str(x) for x in generator.choice(chosen, count, replace=False))
    hidden = (strong,) if strong else hidden
    gravity = (0.0, -9.81) if dimension == 2 else (0.0, 0.0, -9.81)
    elements = ELEMENTS[dimension] * (FINER_ON_TABLES if table else 1)
    model = CableModel(cable, elements, start=held, end=held, gravity=gravity)
    values = {"bending_stiffness": bending, "torsional_stiffness": torsion}
    for name in hidden:
        model = model.with_effect(EFFECTS[name]())
        sizes = _sizes(name, cable, 4.0 / length, generator, strong=bool(strong))
        values |= {f"{name}.{key}": value for key, value in sizes.items()}
    values = about_axis(values)
    p = model.nominal.copy()
    for k, name in enumerate(model.names):
        p[k] = values.get(name, p[k])
    ends = [_ends(generator, dimension, length, held, k) for k in range(size)]
    true = [_moved(generator, pose) for pose in ends]
    waves = generator.normal(0.0, 0.1, (len(model.node.curvatures), 3))
    scatter, draws = PoseScatter(), np.zeros((0, size))
    if random:
        std = RANDOM_SIZES[random](length) * generator.uniform(0.5, 1.5)
        scatter = PoseScatter(std, source=random)
        count = scatter.ways(model)[1].shape[1]
        draws = scatter.sizes(count)[:, None] * generator.standard_normal((count, size))
        values[f"random.{random}"] = std
    model, shapes = _finely(model, p, waves, true, scatter, draws)
    rest = rest_of(waves, model)
    if table and all(shapes):
        height = _table_under(generator, model, true, shapes)
        model = model.with_effect(ContactPlane())
        p, hidden = np.append(p, height), (*hidden, ContactPlane.name)
        values["contact_plane.height"] = height
        shapes = predict_poses(model, p, rest, true) if height < 0 else [None]
        # Some poses lie lower without a table than in the equilibrium that they have with it.
        resting = height + cable.diameter / 2 + 1e-3 * length
        if all(shapes) and (_lowest(shapes, length) < resting).sum() < 2:
            return None
    if any(shape is None or not shape.equilibrium.stable for shape in shapes):
        return None
    marked, read = generator.random() < 0.5, "mass_error" in hidden
    poses = []
    for k, (pose, shape) in enumerate(zip(ends, shapes, strict=True)):
        s, points = _measured(generator, shape, marked, length)
        readings = {}
        if read:
            force = shape.equilibrium.end_force
            readings["end_force"] = force + FORCE_STD * generator.standard_normal(dimension)
        known = {
            key: value for key, value in vars(pose).items() if key.endswith(("heading", "tation"))
        }
        role = "held_out" if _held_out(k) else "fit"
        at = {"at": s} if marked else {}
        poses.append(
            dlo.Pose(pose.start, pose.end, points=points, role=role, **at, **known, **readings)
        )
    session = dlo.Session(
        dlo.Cable(length=length, mass=mass, diameter=0.006, bending_stiffness=bending * off),
        poses,
        gravity=gravity,
        boundary=(held, held),
        std=MARKERS[1] if marked else None,
        force_std=FORCE_STD if read else None,
    )
    kind = f"{held}, {'markers' if marked else 'lines'}"
    return Simulated(session, hidden, values, kind)


def _finely(
    model: CableModel,
    p: NDArray[np.floating],
    waves: NDArray[np.floating],
    poses: Sequence[HeldPose],
    scatter: PoseScatter,
    draws: NDArray[np.floating],
) -> tuple[CableModel, list[Prediction | None]]:
    """The model on a mesh that is fine enough, and its shapes; without shapes if none is.

    `draws` (q, poses): what each pose has of its own along the directions of `scatter`.
    """
    shapes = _shapes(model, p, waves, poses, scatter, draws)
    s = np.linspace(0.0, model.cable.length, 201)
    for _ in range(HALVED + 1):
        finer = model.with_mesh(2 * model.n)
        others = _shapes(finer, p, waves, poses, scatter, draws)
        if not (all(shapes) and all(others)):
            break
        pairs = zip(shapes, others, strict=True)
        moved = (np.linalg.norm(a.curve.at(s) - b.curve.at(s), axis=1) for a, b in pairs)
        if max(np.sqrt((gap**2).mean()) for gap in moved) < FINE:
            return model, shapes
        model, shapes = finer, others
    return model, [None]


def _shapes(
    model: CableModel,
    p: NDArray[np.floating],
    waves: NDArray[np.floating],
    poses: Sequence[HeldPose],
    scatter: PoseScatter,
    draws: NDArray[np.floating],
) -> list[Prediction | None]:
    """Shapes of the poses on a model's mesh, each with what it has of its own."""
    rest = rest_of(waves, model)
    if not scatter.std:
        return predict_poses(model, p, rest, poses)
    effect = effect_of(scatter.source, model)
    if effect is not None:  # an effect of one pose is one of all poses of that session
        own, draws = model.with_effect(effect), draws.T
        return [
            predict_poses(own, np.append(p, draw), rest, [pose])[0]
            for draw, pose in zip(draws, poses, strict=True)
        ]
    modes = modes_in(model)
    return [
        predict_poses(model, p, rest + modes @ draw, [pose])[0]
        for draw, pose in zip(draws.T, poses, strict=True)
    ]


def _table_under(
    generator: np.random.Generator,
    model: CableModel,
    poses: Sequence[HeldPose],
    shapes: Sequence[Prediction],
) -> float:
    """Height [m] of a table that fitted poses touch and no fixture; 0 where that cannot be."""
    radius, up = model.cable.diameter / 2, len(model.gravity) - 1
    lowest = np.sort(_lowest(shapes, model.cable.length))
    most = min(min(pose.start[up], pose.end[up]) for pose in poses) - 0.02 * model.cable.length
    touching = int(np.searchsorted(lowest, most))
    if touching < 2:
        return 0.0
    k = int(generator.integers(2, touching + 1))
    above = min(lowest[k], most) if k < len(lowest) else most
    return float(lowest[k - 1] + generator.uniform(0.2, 0.8) * (above - lowest[k - 1]) - radius)


def _lowest(shapes: Sequence[Prediction], length: float) -> NDArray[np.floating]:
    """Height [m] of the lowest point of the middle line in each fitted pose."""
    s = np.linspace(0.0, length, 201)
    fitted = [shape for k, shape in enumerate(shapes) if not _held_out(k)]
    return np.array([shape.curve.at(s)[:, -1].min() for shape in fitted])


def _held_out(k: int) -> bool:
    """Whether the pose of this number is not fitted."""
    return k % 5 == 4


def rest_of(waves: NDArray[np.floating], model: CableModel) -> NDArray[np.floating]:
    """A smooth rest curvature [1/m], three waves (axes, 3) about each axis."""
    length, node, k = model.cable.length, model.node, np.arange(3)[:, None]
    cells = model.chain.cells / length
    # Means over the cells.
    cosines = np.cos(np.pi * k * cells.mean(axis=1)) * np.sinc(k * np.diff(cells)[:, 0] / 2)
    bends = waves @ cosines * 2 * np.pi / length
    twist = np.zeros((len(node.strains) - len(bends), len(cells)))
    return np.concatenate([*twist, *bends])


def _ends(
    generator: np.random.Generator, dimension: int, length: float, held: str, k: int
) -> HeldPose:
    """Ends of a pose as they are declared."""
    span, name = generator.uniform(0.55, 0.85) * length, f"pose_{k:02d}"
    if dimension == 2:
        way = generator.uniform(-0.7, 0.7)
        end = (span * np.cos(way), span * np.sin(way))
        if held == "pinned":
            return HeldPose((0.0, 0.0), end, name=name)
        first, last = generator.uniform(-0.6, 0.6, 2)
        return HeldPose((0.0, 0.0), end, start_heading=first, end_heading=last, name=name)
    way = Rotation.from_rotvec(generator.uniform(-0.5, 0.5, 3))
    first, last = (Rotation.from_rotvec(generator.uniform(-0.7, 0.7, 3)) for _ in range(2))
    return HeldPose(
        (0.0, 0.0, 0.0),
        tuple(way.apply([span, 0.0, 0.0])),
        start_orientation=tuple(first.as_quat()),
        end_orientation=tuple(last.as_quat()),
        name=name,
    )


def _moved(generator: np.random.Generator, pose: HeldPose) -> HeldPose:
    """The pose as it truly was: 0.1 mm and, of clamps, 2 mrad from what is declared."""
    frames = pose.frames
    turns = 2e-3 * generator.standard_normal((2, pose.node.increment))
    turned = [pose.node.moved(x[None], t[None])[0] for x, t in zip(frames, turns, strict=True)]
    end = np.array(pose.end) + 1e-4 * generator.standard_normal(len(pose.start))
    return pose.moved(np.array(pose.start), end, turned)


def _measured(
    generator: np.random.Generator, shape: object, marked: bool, length: float
) -> tuple[NDArray[np.floating], NDArray[np.floating]]:
    """Arc lengths [m] and points as a camera has them."""
    if marked:
        s = np.linspace(0.02, 0.98, MARKERS[0]) * length
        noise = MARKERS[1] * generator.standard_normal((len(s), len(shape.curve.nodes[0])))
        return s, shape.curve.at(s) + noise
    count, std, share, along = LINE
    s = np.linspace(0.01, 0.99, count) * length
    covariance = NoiseModel(std, share, along, "gaussian").covariance(s, np.ones(count))
    factor = np.linalg.cholesky(covariance)
    return s, shape.curve.at(s) + factor @ generator.standard_normal(
        (count, len(shape.curve.nodes[0]))
    )
