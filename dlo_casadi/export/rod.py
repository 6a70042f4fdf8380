"""A fitted cable in one pose as a chain of rigid segments: all data that a simulator needs.

Segments of equal length h are joined at the nodes between them. A joint represents the cable within
h / 2 of it: its stiffness is EI / h and GJ / h, its rest rotation exp(h kappa_0). A clamp holds a
segment centred at the cable's end, so that half of it is inside the clamp. Shapes then converge
with second order in h.
"""

from dataclasses import dataclass, replace
from typing import Literal, Self

import casadi as ca
import numpy as np
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation

from dlo_casadi.arrays import FloatArray, unit
from dlo_casadi.effects import (
    BoundaryEffect,
    Damping,
    Effect,
    Kinematics,
    Load,
    SectionLaw,
    StateEffect,
)
from dlo_casadi.equilibrium.curve import NodeCurve
from dlo_casadi.equilibrium.pose import HeldPose
from dlo_casadi.equilibrium.spread import SolvedCable
from dlo_casadi.export.common import printable
from dlo_casadi.export.driven import Driven
from dlo_casadi.model.cable_model import DAMPING_TIME, CableModel
from dlo_casadi.model.clipped import rolled_with
from dlo_casadi.model.lagrangian import Lagrangian, lagrangian_of
from dlo_casadi.rod.element import Cell
from dlo_casadi.rod.node import Node
from dlo_casadi.rod.supports import SupportKind

# Features beyond a straight uniform round cable with its weight; targets support some of them.
Feature = Literal[
    "rest shape",
    "anisotropy",
    "stiffness along the cable",
    "lumped mass",
    "stretch",
    "softening",
    "load across gravity",
    "point force",
    "spring",
    "spring at an end",
    "compliance of a clamp",
    "change of the rest shape",
    "clips",
    "obstacles",
    "free roll of an end",
    "feeding through an end",
    "damping beside the cable's own",
]
# GJ / EI of a cable that was measured in a plane: that of a solid round rod.
ROUND = 1 / 1.3
# Default mesh: largest turn of a joint in the pose [rad], and limits of the number of segments.
TURN, SEGMENTS = 0.1, (40, 200)
# Maximum number of steps in which the segments are turned until they reach the end.
_CLOSING = 200


@dataclass(frozen=True)
class Fixture:
    """The support of an end: as declared, and the true end of the cable, world axes.

    Places (3,) [m]; frames with x along the cable. `rolls`: whether the cable may roll in it, so
    that the frame of its end has the roll of this pose.
    """

    kind: SupportKind
    place: FloatArray
    frame: Rotation
    cable_place: FloatArray
    cable_frame: Rotation
    rolls: bool = False

    @property
    def offset(self) -> tuple[FloatArray, Rotation]:
        """Place and frame of the cable's end in the fixture's frame."""
        back = self.frame.inv()
        return back.apply(self.cable_place - self.place), back * self.cable_frame


@dataclass(frozen=True, eq=False)
class Rod:
    """A cable in a pose as n segments of length `h` [m].

    Parameters
    ----------
    node : type[Node]
        Kind of the model's nodes. With headings the cable stayed in the plane z = 0, and nothing is
        known out of the plane.
    s : (n + 1,) [m]
        Arc lengths of the nodes from the declared start; nodes inside clamps lie beyond the ends.
    nodes : (n + 1, 3) [m]
    frames : (n,) rotations
        Material frames of the segments: x along the cable, y and z the section's axes.
    bending : (n - 1, 2, 2) [N m^2]
        Bending stiffness of each joint, about the material axes y and z.
    torsion : (n - 1,) [N m^2]
    rest : (n - 1, 3) [1/m]
        Twist and curvatures about y and z of each joint without load.
    masses : (n,) [kg]
    lumps : (m, 2)
        Mass [kg] and arc length [m] of compact masses.
    axial : float [N]
        EA; infinite if no stretch was found.
    radius : float [m]
    gravity : (3,) [m/s^2]
    start, end : Fixture
    features : dict
        Features beyond a straight uniform round cable: feature -> labels of the effects.
    damping_time : float, optional [s]
        Ratio of a joint's damping to its stiffness; None if it is not known.
    driven : Driven, optional
        How its fixtures move.
    """

    name: str
    node: type[Node]
    h: float
    s: FloatArray
    nodes: FloatArray
    frames: Rotation
    bending: FloatArray
    torsion: FloatArray
    rest: FloatArray
    masses: FloatArray
    lumps: FloatArray
    axial: float
    radius: float
    gravity: FloatArray
    start: Fixture
    end: Fixture
    features: dict[Feature, tuple[str, ...]]
    damping_time: float | None = None
    driven: Driven | None = None

    @classmethod
    def of(cls, held: SolvedCable, segments: int | None = None) -> Self:
        """Cut a cable into segments, by default as many as keep each joint's turn below `TURN`."""
        model, p, pose = held.model, held.p, held.pose
        low, high = held.places[[0, -1]].tolist()
        terms, length = lagrangian_of(model), high - low
        curve = held.curve.along(length)
        true, true_length = _numbers(terms, p, pose, terms.true_ends.vector, length * terms.stretch)
        if segments is None:
            sharpest = np.linalg.norm(curve.at(np.linspace(0, length, 400), 2), axis=1).max()
            segments = int(np.clip(np.ceil(sharpest * length / TURN), *SEGMENTS))
        clamped = [kind.direction for kind in (model.start, model.end)]
        h = length / (segments - sum(clamped) / 2)
        s = low + h * (np.arange(segments + 1) - clamped[0] / 2)
        fixtures = _fixtures(model, pose, true, curve, held.equilibrium.x)
        stretch = float(true_length) / length
        nodes, frames = _segments(held, fixtures, s, h * stretch)
        mass, gravity = _weights(terms, p, pose)
        bending, torsion = _stiffness(terms, p, pose, s, h)
        cover = np.clip(s, low, high)
        compliance = float(_numbers(terms, p, pose, terms.axial_compliance)[0])
        features = features_of(model, p, pose)
        if np.abs(held.rest).max(initial=0.0) > 0:
            features["rest shape"] = ()
        features |= {"clips": ()} if pose.clips else {}
        features |= {"obstacles": ()} if model.surfaces else {}
        features |= {"free roll of an end": ()} if any(x.rolls for x in fixtures) else {}
        features |= {"feeding through an end": ()} if model.slides else {}
        return cls(
            name=printable(model.cable.name),
            node=model.node,
            h=h * stretch,
            s=s,
            nodes=nodes,
            frames=frames,
            bending=bending,
            torsion=torsion,
            rest=_rest(model, held.rest, s[1:-1], h),
            masses=mass * np.diff(cover),
            lumps=_lumps(terms, p, pose, gravity),
            axial=1 / compliance if compliance > 0 else np.inf,
            radius=model.cable.diameter / 2,
            gravity=gravity,
            start=fixtures[0],
            end=fixtures[1],
            features=features,
            damping_time=dict(zip(model.names, p.tolist(), strict=True)).get(DAMPING_TIME),
        )

    def with_stiffness(self, bending: float, torsion: float) -> Self:
        """A straight cable of uniform stiffness [N m^2] in the same pose, as if unmeasured."""
        count = len(self.torsion)
        return replace(
            self,
            bending=np.tile(bending * np.eye(2), (count, 1, 1)),
            torsion=np.full(count, torsion),
            rest=np.zeros((count, 3)),
        )

    @property
    def mean_bending(self) -> FloatArray:
        """EI (n - 1,) [N m^2] of the joints: the mean over all bending axes of a section."""
        return np.trace(self.bending, axis1=1, axis2=2) / 2

    def inextensible(self, factor: float) -> float:
        """EA [N] as a multiple of weight and buckling load: the strain is about 1 / factor."""
        weight = (self.masses.sum() + self.lumps[:, 0].sum()) * np.linalg.norm(self.gravity)
        buckling = 4 * np.pi**2 * self.bending.max() / (self.h * len(self.masses)) ** 2
        return float(factor * (weight + buckling))

    def explicit(self, masses: FloatArray, stiff: float, courant: float) -> tuple[float, float]:
        """Time step [s] for an axial stiffness EA [N], and the inertia [kg m^2] of a link.

        The step is `courant` times the largest stable step of an explicit solver with inner nodes
        of these masses [kg]. The inertia is that of a link about its end, or larger, so that the
        step is also stable in bending, twist and shear.
        """
        largest = float(np.sqrt(masses[1:-1].min() * self.h / stiff))
        fastest = stiff * self.h
        fastest += 4 * max(float(self.bending.max()), float(self.torsion.max())) / self.h
        inertia = max(float(masses.mean()) * self.h**2 / 3, fastest * largest**2 / 4)
        return courant * largest, inertia

    def lumps_at(self, s: FloatArray) -> FloatArray:
        """Compact masses [kg] carried by points at arc lengths s: each by its two neighbours.

        Beyond the first or the last point that one carries all of it, up to h / 2 from its place.
        """
        out = np.zeros(len(s))
        for mass, place in zip(
            self.lumps[:, 0], np.clip(self.lumps[:, 1], s[0], s[-1]), strict=True
        ):
            k = int(np.clip(np.searchsorted(s, place) - 1, 0, len(s) - 2))
            share = (place - s[k]) / (s[k + 1] - s[k])
            out[[k, k + 1]] += mass * np.array([1 - share, share])
        return out

    @property
    def link_masses(self) -> FloatArray:
        """Masses (n,) [kg] of the links, including compact masses."""
        return self.masses + self.lumps_at((self.s[1:] + self.s[:-1]) / 2)

    @property
    def turns(self) -> Rotation:
        """Rotations (n - 1,) from each segment's frame to the next one's in the pose."""
        return self.frames[:-1].inv() * self.frames[1:]

    @property
    def rest_turns(self) -> Rotation:
        """The same without load."""
        return Rotation.from_rotvec(self.h * self.rest)

    @property
    def unloaded(self) -> tuple[FloatArray, Rotation]:
        """Nodes (n + 1, 3) [m] and frames (n,) without load, with the first link in its pose."""
        frames = [self.frames[0]]
        for turn in self.rest_turns:
            frames.append(frames[-1] * turn)
        rest = Rotation.concatenate(frames)
        steps = self.h * np.cumsum(rest.apply([1.0, 0.0, 0.0]), axis=0)
        return np.vstack([self.nodes[0], self.nodes[0] + steps]), rest


def features_of(model: CableModel, p: FloatArray, pose: HeldPose) -> dict[Feature, tuple[str, ...]]:
    """Features of a model's effects, each with the labels of those that cause it."""
    terms = lagrangian_of(model)
    found: dict[Feature, tuple[str, ...]] = {}
    for effect, local in terms.effects_of(Effect):
        for feature in _features(effect, terms, local, p, pose):
            found[feature] = (*found.get(feature, ()), effect.label)
    return found


def _features(
    effect: Effect, terms: Lagrangian, local: dict[str, ca.SX], p: FloatArray, pose: HeldPose
) -> list[Feature]:
    """Features that an effect needs; every target supports places of the ends, and weights."""
    cable, found = terms.model.cable, list[Feature]()
    if isinstance(effect, SectionLaw):
        cell, square = Cell(ca.SX.sym("s"), ca.SX(1e-3), 1e-3), ca.SX.sym("square")
        if not effect.isotropic:
            found.append("anisotropy")
        if not effect.along(cell, cable, local).is_constant():
            found.append("stiffness along the cable")
        if not effect.of_bend(square, cable, local).is_constant():
            found.append("softening")
    elif isinstance(effect, Kinematics) and effect.extensible:
        found.append("stretch")
    elif isinstance(effect, Load):
        gravity = terms.felt_gravity
        total = effect.resultant(ca.SX(0), gravity, cable, local)
        load, down = _numbers(terms, p, pose, total + 0 * gravity, gravity)
        across = load - down * float(load @ down) / max(float(down @ down), 1e-12)
        if np.linalg.norm(across) > 1e-9 * np.linalg.norm(load):  # more than rounding
            found.append("load across gravity")
        if effect.forces(gravity, local):
            found.append("lumped mass" if effect.carried else "point force")
        if effect.n_springs:
            found.append("spring")
    elif isinstance(effect, BoundaryEffect):
        first, last = terms.moved
        if not ca.SX(effect.energy(first, last, local)).is_zero():
            found.append("spring at an end")
        if any(not ca.SX(c).is_zero() for c in effect.compliance(local)):
            found.append("compliance of a clamp")
    elif isinstance(effect, StateEffect):
        found.append("change of the rest shape")
    elif isinstance(effect, Damping):
        found.append("damping beside the cable's own")
    return found


def _numbers(
    terms: Lagrangian, p: FloatArray, pose: HeldPose, *expressions: ca.SX
) -> list[FloatArray]:
    """Evaluate expressions at the parameters and the pose, with all deviations zero."""
    of = ca.Function("numbers", [terms.p, terms.pose, terms.deviation], [*expressions])
    found = of.call([p, pose.vector, np.zeros(terms.deviation.numel())])
    return [np.array(value).squeeze() for value in found]


def _spatial(vector: FloatArray) -> FloatArray:
    """Embed vectors (..., 2 or 3) in space: a plane is z = 0."""
    out = np.zeros((*vector.shape[:-1], 3))
    out[..., : vector.shape[-1]] = vector
    return out


def _fixtures(
    model: CableModel, pose: HeldPose, true: FloatArray, curve: NodeCurve, x: FloatArray
) -> tuple[Fixture, Fixture]:
    """Both fixtures of a shape x; if an end has no direction, its frame is the world's."""
    d, c = model.node.dimension, model.node.coordinates
    edges = np.cumsum([d, d, c])
    parts = [np.split(ends, edges) for ends in (pose.ends, true)]
    out = []
    for k, kind in enumerate((model.start, model.end)):
        (place, frame), (cable_place, cable_frame) = (
            (_spatial(part[k]), model.node.rotations(part[2 + k])) for part in parts
        )
        if not kind.direction:
            frame = cable_frame = Rotation.identity()
        rolls = kind.direction and not kind.roll and model.node.twists
        if rolls:
            ends = cable_frame.as_quat()[None], x[-k][None]
            cable_frame = Rotation.from_quat(rolled_with(*ends)[0])
        if not kind.place:
            place = cable_place = _spatial(curve.at(np.array([curve.length])))[0]
        out.append(Fixture(kind, place, frame, cable_place, cable_frame, rolls))
    return out[0], out[1]


def _segments(
    cable: SolvedCable, fixtures: tuple[Fixture, Fixture], s: FloatArray, h: float
) -> tuple[FloatArray, Rotation]:
    """Nodes and frames of equal segments along the curve, closed between the fixtures."""
    start, end = fixtures
    model, (low, high) = cable.model, cable.places[[0, -1]]
    middles = np.clip((s[:-1] + s[1:]) / 2, low, high)
    frames = model.node.rotations(
        model.node.interpolated(middles, cable.places, cable.equilibrium.x)
    )
    curve = cable.curve.along(high - low)
    ways = np.diff(_spatial(curve.at(np.clip(s, low, high) - low)), axis=0)
    first, last = start.cable_place, end.cable_place
    held = [k for k, side in ((0, start), (-1, end)) if side.kind.direction]
    for k in held:
        ways[k] = (start, end)[k].cable_frame.apply([1.0, 0.0, 0.0])
    ways = unit(ways)
    if 0 in held:
        first = first - h / 2 * ways[0]
    if -1 in held:
        last = last + h / 2 * ways[-1]
    free = np.setdiff1d(np.arange(len(ways)), np.array(held, dtype=int) % len(ways))
    for _ in range(_CLOSING if end.kind.place else 0):
        gap = (last - first) / h - ways.sum(axis=0)
        ways[free] = unit(ways[free] + gap / len(free))
    nodes = np.vstack([first, first + h * np.cumsum(ways, axis=0)])
    # The smallest rotations that align the frames with the segments.
    before = frames.apply([1.0, 0.0, 0.0])
    axis = np.cross(before, ways)
    sine, cosine = np.linalg.norm(axis, axis=1), (before * ways).sum(axis=1)
    angle = np.arctan2(sine, cosine) / np.maximum(sine, 1e-300)
    turned = (Rotation.from_rotvec(axis * angle[:, None]) * frames).as_quat()
    for k in held:
        turned[k] = (start, end)[k].cable_frame.as_quat()
    return nodes, Rotation.from_quat(turned)


def _weights(terms: Lagrangian, p: FloatArray, pose: HeldPose) -> tuple[float, FloatArray]:
    """Mass per length [kg/m] equal to all loads along gravity, and gravity (3,) with its tilt."""
    cable = terms.model.cable
    total, gravity = _numbers(terms, p, pose, terms.resultant(0.0), terms.felt_gravity)
    square = float(gravity @ gravity)
    mass = float(total @ gravity) / square if square > 0 else cable.mass
    return mass / cable.length, _spatial(gravity)


def _lumps(terms: Lagrangian, p: FloatArray, pose: HeldPose, gravity: FloatArray) -> FloatArray:
    """Compact masses (m, 2): mass [kg], arc length [m]."""
    loads = [item for item in terms.effects_of(Load) if item[0].carried]
    forces = [f for effect, local in loads for f in effect.forces(terms.felt_gravity, local)]
    if not forces or not gravity.any():
        return np.zeros((0, 2))
    found = [_numbers(terms, p, pose, item.force, item.position) for item in forces]
    g = gravity[: terms.node.dimension]
    return np.array([[force @ g / (g @ g), place] for force, place in found])


def _stiffness(
    terms: Lagrangian, p: FloatArray, pose: HeldPose, s: FloatArray, h: float
) -> tuple[FloatArray, FloatArray]:
    """Bending (n - 1, 2, 2) and torsional (n - 1,) stiffness [N m^2] of the joints."""
    section, model = terms.section, terms.model
    cells = np.stack([s[1:-1] - h / 2, s[1:-1] + h / 2])
    along = [section.along(Cell(ca.SX(a), ca.SX(b - a), h)) for a, b in cells.T]
    factor, bending, torsion = _numbers(
        terms, p, pose, ca.vertcat(*along), section.bending, section.torsion
    )
    if not model.node.twists:
        bending, torsion = bending * np.eye(2), bending * ROUND
    return factor[:, None, None] * bending, factor * torsion


def _rest(model: CableModel, rest: FloatArray, s: FloatArray, h: float) -> FloatArray:
    """Rest strains (n - 1, 3) [1/m] of joints at s: means over the cable within h / 2 of each.

    Beyond the declared length, of a cable that is fed, they stay as at its ends.
    """
    chain, out = model.chain, np.zeros((len(s), 3))
    edges = np.append(chain.cells[:, 0], chain.cells[-1, 1])
    about = model.node.about
    for axis, means in zip(about, np.split(rest, len(about)), strict=True):
        turned = np.append(0.0, np.cumsum(means * np.diff(edges)))
        angle = CubicSpline(edges, turned)
        low, high = (_beyond(angle, s + side * h / 2) for side in (-1, 1))
        out[:, "xyz".index(axis)] = (high - low) / h
    return out


def _beyond(spline: CubicSpline, s: FloatArray) -> FloatArray:
    """Values of a spline, continued as a straight line beyond its ends."""
    inside = np.clip(s, *spline.x[[0, -1]])
    return np.asarray(spline(inside) + (s - inside) * spline(inside, 1))
