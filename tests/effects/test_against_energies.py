"""Every effect against what a rod in NumPy makes of its formula: energies, images, rest shapes.

The rod is a chain of helices, integrated by the exponential map and Gauss's rule; of the package
it knows the equilibrium's nodes alone. Closed forms and a boundary value problem check what
depends on the kind of element.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
import pytest
from scipy.integrate import solve_bvp
from scipy.spatial.transform import Rotation
from sections import principal

from dlo_casadi.effects import (
    EFFECTS,
    NUISANCES,
    BendingAnisotropy,
    BendingSoftening,
    CableData,
    Setup,
    StiffnessGradient,
    UnknownPull,
)
from dlo_casadi.equilibrium.pose import HeldPose
from dlo_casadi.equilibrium.solve import solve_equilibrium
from dlo_casadi.model.assembly import Assembly, Inputs, Shapes
from dlo_casadi.model.cable_model import CableModel
from dlo_casadi.rod.ends import REACTIONS

EI, GJ, LENGTH, MASS, N = 0.05, 0.03, 0.8, 0.2, 8  # N m^2, N m^2, m, kg, elements
FLAT = CableData(length=LENGTH, mass=MASS, diameter=0.01, bending_stiffness=EI)
CABLES = {"plane": FLAT, "space": replace(FLAT, torsional_stiffness=GJ)}
GRAVITY = {"plane": (0.5, -9.7), "space": (0.3, 0.5, -9.7)}
POSES = {
    "plane": HeldPose((0.1, 0.05), (0.6, -0.05), 0.6, -0.5, camera_center=(0.3, -0.4, 1.5)),
    "space": HeldPose(
        (0.1, 0.05, -0.2),
        (0.6, 0.0, -0.1),
        start_orientation=tuple(Rotation.from_rotvec([0.1, -0.2, 0.4]).as_quat()),
        end_orientation=tuple(Rotation.from_rotvec([0.3, 0.2, -0.1]).as_quat()),
    ),
}
# Twist and curvatures at rest [1/m].
REST = {"plane": np.array([0.0, 0.0, -0.9]), "space": np.array([0.0, 0.6, -0.9])}
ALL = {**EFFECTS, **NUISANCES, UnknownPull.name: UnknownPull}
# Of |k|: a thousandth of a turn per length [1/m].
ROUNDING = 1e-3 * 2 * np.pi / LENGTH
GAUSS, WEIGHTS = ((np.polynomial.legendre.leggauss(6)[i] + 1 - i) / 2 for i in (0, 1))


def flat(vector) -> np.ndarray:
    """A vector of the plane in space."""
    return np.concatenate([vector, np.zeros(3 - len(vector))])


# ---- a rod in NumPy ----------------------------------------------------------------------------


@dataclass(frozen=True)
class Rod:
    """Helices from a start and its frame, of strains (n, 3) [1/m] and axial strains (n,)."""

    start: np.ndarray
    frame: Rotation
    strains: np.ndarray
    axial: np.ndarray
    h: float

    def __post_init__(self) -> None:
        frames, places = [self.frame], [self.start]
        for strain in self.strains:
            places.append(places[-1] + self._way(len(places) - 1, frames[-1], 1.0))
            frames.append(frames[-1] * Rotation.from_rotvec(self.h * strain))
        object.__setattr__(self, "frames", frames)
        object.__setattr__(self, "places", np.array(places))

    def _way(self, i: int, frame: Rotation, u: float) -> np.ndarray:
        turns = Rotation.from_rotvec(u * self.h * GAUSS[:, None] * self.strains[i])
        return u * self.h * (1 + self.axial[i]) * WEIGHTS @ (frame * turns).as_matrix()[..., 0]

    def at(self, s: float) -> np.ndarray:
        """Place (3,) [m] at a length of the unstretched cable."""
        i = min(int(s / self.h), len(self.strains) - 1)
        return self.places[i] + self._way(i, self.frames[i], s / self.h - i)

    def mean(self) -> np.ndarray:
        """Mean place (3,) [m] of the cable."""
        inside = [[self.at((i + u) * self.h) for u in GAUSS] for i in range(len(self.strains))]
        return np.einsum("k,ikd->d", WEIGHTS, np.array(inside)) / len(self.strains)


def isotropic(bend: np.ndarray, twist: float, s: float) -> float:
    return (EI * bend @ bend + GJ * twist**2) / 2


@dataclass(frozen=True)
class Physics:
    """What a rod's energy is made of, and where it is held."""

    gravity: np.ndarray
    end: np.ndarray
    clamps: tuple[Rotation, Rotation]
    rest: np.ndarray
    boundary: str = "clamped"
    length: float = LENGTH
    mass: float = MASS
    density: Callable = isotropic  # (bend (2,), twist, s) -> N
    force_per_length: np.ndarray | float = 0.0
    extra: Callable = lambda rod: 0.0  # rod -> J
    compliance: float = 0.0
    giving: tuple[float, float] | None = None
    planar: bool = False

    def energy(self, rod: Rod) -> float:
        """Energy [J] of bending, twist, tension, weight and what else there is."""
        total, s = 0.0, (np.arange(len(rod.strains)) + 0.5) * rod.h
        for place, strain, axial in zip(s, rod.strains - self.rest, rod.axial, strict=True):
            total += rod.h * self.density(strain[1:], strain[0], place)
            total += rod.h * axial**2 / (2 * self.compliance) if self.compliance else 0.0
        load = self.mass * self.gravity + self.length * self.force_per_length
        total -= load @ rod.mean()
        if self.giving:
            total += sum(
                self._turn(rod, k) @ self._turn(rod, k) / (2 * c) for k, c in enumerate(self.giving)
            )
        return total + self.extra(rod)

    def _turn(self, rod: Rod, k: int) -> np.ndarray:
        """2 tan(angle / 2) about the axis; in a plane, the angle."""
        turn = (self.clamps[k].inv() * rod.frames[-k]).as_rotvec()
        size = np.linalg.norm(turn)
        return turn if self.planar else turn * 2 * np.tan(size / 2) / max(size, 1e-300)

    def gaps(self, rod: Rod) -> np.ndarray:
        """End place [m], then both clamps [rad]: zero where they hold."""
        gaps = [rod.places[-1] - self.end]
        if self.boundary == "clamped" and not self.giving:
            gaps += [(self.clamps[k].inv() * rod.frames[-k]).as_rotvec() for k in (0, 1)]
        return np.concatenate(gaps)


# ---- effects as formulas -----------------------------------------------------------------------


def _pull(own: Physics, v: dict[str, float]) -> Physics:
    force = flat([v[f"f{axis}"] for axis in "xyz" if f"f{axis}" in v])
    return replace(own, extra=lambda rod: -force @ rod.at(v["position"]))


def _tethered(own: Physics, v: dict[str, float]) -> Physics:
    anchor = flat([v[f"anchor_{axis}"] for axis in "xyz" if f"anchor_{axis}" in v])
    k = v["stiffness"]
    return replace(own, extra=lambda rod: k * ((rod.at(v["position"]) - anchor) ** 2).sum() / 2)


def _blown(own: Physics, v: dict[str, float]) -> Physics:
    down = own.gravity / np.linalg.norm(own.gravity)
    across = np.eye(3)[:2] - np.outer(down[:2], down)
    across /= np.linalg.norm(across, axis=1)[:, None]
    x, y = v.get("force_per_length", v.get("force_per_length_x")), v.get("force_per_length_y", 0.0)
    return replace(own, force_per_length=x * across[0] + y * across[1])


def _tilted(own: Physics, v: dict[str, float]) -> Physics:
    turn = [v.get("angle_x", 0.0), v.get("angle_y", 0.0), v.get("angle", 0.0)]
    return replace(own, gravity=Rotation.from_rotvec(turn).apply(own.gravity))


def softened(k: float, softness: float) -> float:
    """Factor 2 int_0^1 t / (1 + t r) dt, r = |k| / c with |k| rounded."""
    r = softness * (np.hypot(k, ROUNDING) - ROUNDING)
    return 2 * (r - np.log1p(r)) / r**2


def _softening(own: Physics, v: dict[str, float]) -> Physics:
    def density(bend, twist, s):
        factor = softened(np.linalg.norm(bend), v["softness"])
        return (factor * EI * bend @ bend + GJ * twist**2) / 2

    return replace(own, density=density)


def _anisotropic(own: Physics, v: dict[str, float]) -> Physics:
    stiffness = EI * principal(v["ratio"], v["angle"])
    return replace(own, density=lambda b, twist, s: (b @ stiffness @ b + GJ * twist**2) / 2)


def _along(factor: Callable) -> Callable:
    """A law of the place, on bending and torsion."""

    def changed(own: Physics, v: dict[str, float]) -> Physics:
        return replace(own, density=lambda b, twist, s: factor(s, v) * isotropic(b, twist, s))

    return changed


def _stiffer(s: float, v: dict[str, float]) -> float:
    """Of the cell about s: compliances are averaged over what the section covers of it."""
    h, rounding = LENGTH / N, LENGTH / N / 4
    fine = s + h * (np.arange(4000) + 0.5) / 4000 - h / 2
    step = [(1 + x / np.hypot(x, rounding)) / 2 for x in (fine - v["start"], fine - v["end"])]
    return 1 / (1 + (step[0] - step[1]).mean() * (1 / v["factor"] - 1))


def _moved_end(own: Physics, v: dict[str, float]) -> Physics:
    return replace(own, end=own.end + flat([v[f"d{axis}"] for axis in "xyz" if f"d{axis}" in v]))


def _turned_clamps(own: Physics, v: dict[str, float]) -> Physics:
    turns = [
        [0.0, v.get(f"{side}_y", 0.0), v.get(f"{side}_z", v.get(f"{side}_heading_error"))]
        for side in ("start", "end")
    ]
    both = zip(own.clamps, turns, strict=True)
    return replace(own, clamps=tuple(clamp * Rotation.from_rotvec(turn) for clamp, turn in both))


def _spring(k: int) -> Callable:
    def sprung(own: Physics, v: dict[str, float]) -> Physics:
        relaxed = Rotation.from_rotvec([0.0, 0.0, v["heading"]])

        def extra(rod: Rod) -> float:
            turn = (relaxed.inv() * rod.frames[-k]).as_rotvec()
            return v["stiffness"] * turn @ turn / 2

        return replace(own, boundary="pinned", extra=extra)

    return sprung


MECHANICAL = {
    "lumped_mass": (
        {"mass": 0.05, "position": 0.33},
        lambda own, v: replace(
            own, extra=lambda rod: -v["mass"] * own.gravity @ rod.at(v["position"])
        ),
    ),
    "point_force": ({"fx": 0.3, "fy": -0.2, "fz": 0.4, "position": 0.52}, _pull),
    "unknown_pull": ({"fx": -0.3, "fy": 0.4, "fz": 0.2, "position": 0.27}, _pull),
    "tether": (
        {"stiffness": 6.0, "position": 0.42, "anchor_x": 0.3, "anchor_y": 0.4, "anchor_z": 0.2},
        _tethered,
    ),
    "side_load": (
        {"force_per_length": 0.5, "force_per_length_x": 0.5, "force_per_length_y": -0.3},
        _blown,
    ),
    "gravity_tilt": ({"angle": 0.3, "angle_x": 0.3, "angle_y": -0.2}, _tilted),
    "mass_error": ({"factor": 1.4}, lambda own, v: replace(own, mass=v["factor"] * own.mass)),
    "stiffness_gradient": (
        {"slope": 0.4},
        _along(lambda s, v: 1 + v["slope"] * (2 * s / LENGTH - 1)),
    ),
    "stiff_section": ({"start": 0.23, "end": 0.47, "factor": 3.0}, _along(_stiffer)),
    "bending_softening": ({"softness": 0.05}, _softening),
    "bending_anisotropy": ({"ratio": 3.0, "angle": 0.4}, _anisotropic),
    "axial_stretch": (
        {"compliance": 0.02},
        lambda own, v: replace(own, compliance=v["compliance"]),
    ),
    "length_error": (
        {"length_difference": 0.05},
        lambda own, v: replace(own, length=own.length + v["length_difference"]),
    ),
    "start_spring": ({"stiffness": 0.2, "heading": 0.9}, _spring(0)),
    "end_spring": ({"stiffness": 0.2, "heading": -0.4}, _spring(1)),
    "clamp_angle": (
        {"start_heading_error": 0.2, "end_heading_error": -0.3},
        _turned_clamps,
    ),
    "clamp_rotation": (
        {"start_y": 0.2, "start_z": -0.1, "end_y": 0.15, "end_z": 0.3},
        _turned_clamps,
    ),
    "clamp_compliance": (
        {"start": 0.3, "end": 0.5},
        lambda own, v: replace(own, giving=(v["start"], v["end"])),
    ),
    "end_offset": ({"dx": 0.02, "dy": -0.03, "dz": 0.01}, _moved_end),
}


def kinds(table: dict[str, tuple]) -> list:
    """Each effect of a table where it applies."""
    return [
        pytest.param(name, where, id=f"{name}-{where}")
        for name in table
        for where in CABLES
        if len(GRAVITY[where]) in ALL[name].dimensions
    ]


def modelled(name: str, where: str, values: dict[str, float], boundary: str = "clamped"):
    """A model with one effect, its parameters, rest strains, and the values that it knows."""
    cable, gravity = CABLES[where], GRAVITY[where]
    setup = Setup(cable, boundary, boundary, gravity, center=(0.2, -0.1), readings=REACTIONS)
    effect = ALL[name].made_for(setup)
    model = CableModel(cable, N, "arc", boundary, boundary, gravity, (effect,))
    p, known = model.nominal.copy(), {}
    for q in effect.parameters(cable):
        known[q.name] = values[q.name]
        p[model.names.index(f"{name}.{q.name}")] = values[q.name]
    return model, p, np.repeat(REST[where][-len(model.node.strains) :], N), known


def frames_of(x: np.ndarray) -> list[Rotation]:
    """Frames of nodes, headings or quaternions."""
    if x.shape[1] == 1:
        return [Rotation.from_rotvec([0.0, 0.0, heading]) for heading in x[:, 0]]
    return [Rotation.from_quat(q) for q in x]


def rod_of(x: np.ndarray, start, h: float) -> Rod:
    """A rod through nodes of a model."""
    frames = frames_of(x)
    turns = [(a.inv() * b).as_rotvec() for a, b in pairwise(frames)]
    return Rod(flat(start), frames[0], np.array(turns) / h, np.zeros(len(turns)), h)


def slopes(of: Callable, size: int, d: float = 1e-5) -> np.ndarray:
    """Central differences at 0 (size, ...)."""
    return np.array([(of(step) - of(-step)) / (2 * d) for step in d * np.eye(size)])


@pytest.mark.parametrize(("name", "where"), kinds(MECHANICAL))
def test_an_equilibrium_is_stationary_in_the_rods_energy(name, where):
    """Under its end conditions, whose multipliers are the forces and moments on the fixtures."""
    values, changed = MECHANICAL[name]
    boundary = "pinned" if name.endswith("_spring") else "clamped"
    model, p, rest, known = modelled(name, where, values, boundary)
    pose, planar = POSES[where], where == "plane"
    clamps = tuple(frames_of(np.array(pose.frames)))
    gravity, end = flat(GRAVITY[where]), flat(pose.end)
    own = changed(Physics(gravity, end, clamps, REST[where], boundary, planar=planar), known)
    eq = solve_equilibrium(model, p, rest, pose)
    rod = rod_of(eq.x, pose.start, own.length / N)
    if own.compliance:
        # Tension: what hangs beyond, minus the force on the end's holder, along the cable.
        turns = [
            frame * Rotation.from_rotvec(rod.h * GAUSS[:, None] * strain)
            for frame, strain in zip(rod.frames, rod.strains, strict=False)
        ]
        tangents = np.array([turn.as_matrix()[..., 0] for turn in turns])
        beyond = 1 - (np.arange(N)[:, None] + GAUSS) / N
        force = beyond[..., None] * own.mass * own.gravity - flat(eq.end_force)
        tension = np.einsum("k,ikd,ikd->i", WEIGHTS, tangents, force)
        rod = replace(rod, axial=own.compliance * tension)
    # Elements turn by d = 0.7: the model's three Gauss points leave d^6 / 2e6 of way and work.
    assert eq.energy == pytest.approx(own.energy(rod), abs=1e-7)

    # Unknowns: a turn of the start, strains, and axial strains of a cable that stretches.
    free = np.tile([not planar, not planar, True], N + 1)
    count = int(free.sum()) + (N if own.compliance else 0)

    def moved(step: np.ndarray) -> Rod:
        turn = np.zeros(3 * (N + 1))
        turn[free] = step[: free.sum()]
        axial = rod.axial + (step[free.sum() :] if own.compliance else 0.0)
        frame = rod.frame * Rotation.from_rotvec(turn[:3])
        return replace(
            rod, frame=frame, strains=rod.strains + turn[3:].reshape((N, 3)), axial=axial
        )

    force = slopes(lambda step: own.energy(moved(step)), count)
    ways = slopes(lambda step: own.gaps(moved(step)), count)
    np.testing.assert_allclose(own.gaps(rod), 0.0, atol=2e-7)
    multipliers = np.linalg.lstsq(ways, -force, rcond=None)[0]
    np.testing.assert_allclose(force + ways @ multipliers, 0.0, atol=1e-6)
    d = model.node.dimension
    np.testing.assert_allclose(multipliers[:d], eq.end_force, atol=1e-5)
    if len(multipliers) > 3:
        moments = [own.clamps[k].apply(multipliers[3 + 3 * k : 6 + 3 * k]) for k in (0, 1)]
        used = slice(2, 3) if planar else slice(None)
        expected = np.array(moments)[:, used].reshape(eq.moments.shape)
        np.testing.assert_allclose(expected, eq.moments, atol=1e-6)


# ---- images, readings, and what a pose leaves behind -------------------------------------------


def _biased(rod: Rod, v: dict[str, float]) -> np.ndarray:
    """By the harmonics of the heading, along the normal; a node's heading."""
    heading = np.array([frame.as_rotvec()[2] for frame in rod.frames])
    offset = sum(
        v[f"a{k}"] * np.cos(k * heading) + v[f"b{k}"] * np.sin(k * heading) for k in range(1, 5)
    )
    normal = np.stack([-np.sin(heading), np.cos(heading), 0 * heading], axis=1)
    return rod.places + offset[:, None] * normal


def _distorted(rod: Rod, v: dict[str, float]) -> np.ndarray:
    arm = rod.places - [0.2, -0.1, 0.0]
    return rod.places + v["coefficient"] * (arm**2).sum(axis=1)[:, None] * arm


def _nearer(rod: Rod, v: dict[str, float]) -> np.ndarray:
    """Where the ray from the camera through a point, d in front of the plane, meets the plane."""
    camera = np.array(POSES["plane"].camera_center)
    ray = rod.places + np.array([0.0, 0.0, v["distance"]]) - camera
    return camera - ray * camera[2] / ray[:, 2:]


def _framed(rod: Rod, v: dict[str, float]) -> np.ndarray:
    turn, shift = ([v[f"{what}_{x}"] for x in "xyz"] for what in ("rotation", "translation"))
    return rod.start + Rotation.from_rotvec(turn).apply(rod.places - rod.start) + shift


IMAGES = {
    "image_scale": (
        {"factor": 1.1},
        lambda rod, v: rod.start + v["factor"] * (rod.places - rod.start),
    ),
    "image_distortion": ({"coefficient": 0.4}, _distorted),
    "standoff_error": ({"distance": 0.03}, _nearer),
    "edge_bias": (
        {f"{kind}{k}": 1e-3 * (k + 0.5 * (kind == "b")) for k in range(1, 5) for kind in "ab"},
        _biased,
    ),
    "camera_frame": (
        {
            **dict(zip(("rotation_x", "rotation_y", "rotation_z"), (0.3, -0.2, 0.4), strict=True)),
            "translation_x": 0.01,
            "translation_y": -0.02,
            "translation_z": 0.03,
        },
        _framed,
    ),
}


def bent(model: CableModel, where: str) -> tuple[Shapes, Rod]:
    """Any shape of a model, and a rod of that shape."""
    rng, pose = np.random.default_rng(0), POSES[where]
    strains = np.array([0.0, 0.0, 1.5]) + rng.normal(scale=2.0, size=(N, 3))
    if where == "plane":
        strains[:, :2] = 0.0
    first = frames_of(np.array(pose.frames))[0]
    rod = Rod(flat(pose.start), first, strains, np.zeros(N), LENGTH / N)
    x = np.array([frame.as_quat() for frame in rod.frames])
    if where == "plane":
        x = np.array([[frame.as_rotvec()[2]] for frame in rod.frames])
    elif (x[:-1] * x[1:]).sum(axis=1).min() < 0:
        x *= np.cumprod(np.sign(np.r_[1.0, (x[:-1] * x[1:]).sum(axis=1)]))[:, None]
    lam = rng.normal(size=(1, model.n_border))
    return Shapes.declared(x[None], lam), rod


@pytest.mark.parametrize(("name", "where"), kinds(IMAGES))
def test_what_is_measured_of_a_curve(name, where):
    values, image = IMAGES[name]
    model, p, rest, known = modelled(name, where, values)
    shapes, rod = bent(model, where)
    found = Assembly(model, shapes, Inputs.of(p, rest, POSES[where].vector[None])).curve()[0]
    d = model.node.dimension
    # Three Gauss points: elements turn by d = 0.5, d^6 / 2e6.
    np.testing.assert_allclose(found[:, :d], image(rod, known)[:, :d], atol=1e-7)


@pytest.mark.parametrize("where", CABLES)
def test_a_sensors_bias_is_added_to_what_it_reads(where):
    cable = CABLES[where]
    effect = NUISANCES["sensor_bias"]()
    names = [q.name for q in effect.parameters(cable)]
    values = dict(zip(names, np.linspace(-1.0, 1.0, len(names)), strict=True))
    model, p, rest, _ = modelled("sensor_bias", where, values)
    shapes, _ = bent(model, where)
    given = Inputs.of(p, rest, POSES[where].vector[None])
    a = Assembly(model, shapes, given)
    added = (a.readings() - a.reactions())[0]
    np.testing.assert_allclose(added, [values[name] for name in names], atol=1e-12)


def _set(bend: np.ndarray, v: dict[str, float]) -> np.ndarray:
    """What a bend exceeds the yield by, in its direction; the twist leaves nothing."""
    size = np.linalg.norm(bend[:, 1:], axis=1)[:, None]
    excess = v["share"] * np.maximum(size - v["yield_curvature"], 0.0) * bend / size
    return excess * [0.0, 1.0, 1.0]


STATES = {
    "rest_curvature_drift": ({"rate": 0.3}, lambda bend, v: v["rate"] * bend, 1e-9),
    # Kinks rounded over d = 0.08 1/m: share (d / 2) at the yield.
    "plastic_set": ({"yield_curvature": 2.0, "share": 0.3}, _set, 0.3 * 0.08 / 2),
}


@pytest.mark.parametrize(("name", "where"), kinds(STATES))
def test_the_rest_shape_that_a_pose_leaves_behind(name, where):
    values, moved, tolerance = STATES[name]
    model, p, rest, known = modelled(name, where, values)
    shapes, rod = bent(model, where)
    after = Assembly(model, shapes, Inputs.of(p, rest, POSES[where].vector[None])).state_after()[0]
    expected = REST[where] + moved(rod.strains - REST[where], known)
    used = expected.T[-len(model.node.strains) :].ravel()
    np.testing.assert_allclose(after[0], used, atol=tolerance)


def test_every_effect_meets_its_formula():
    # These are compared in tests/test_clips.py and tests/test_contact.py.
    others = {"clip_offset", "clip_slip", "clip_angle", "obstacle_offset", "contact_plane"}
    assert {*MECHANICAL, *IMAGES, *STATES, "sensor_bias", *others} == set(ALL)


# ---- section laws, whatever the element --------------------------------------------------------

SOFTNESS = 0.03


@pytest.mark.parametrize("element", ["arc", "quadratic"])
@pytest.mark.parametrize("ratio", [1.0, 3.0])
def test_a_helix_of_a_softening_section(element, ratio):
    """Without loads a helix of strains (tau, k) is in balance: m = (GJ tau, M(k)) in its frame.

    m' + omega x m + e_x x n = 0 gives n = tau (GJ - M / k) omega for the curvature k about a
    principal axis; M = EI k / (1 + k / c) whatever the twist, and GJ whatever the bend.
    """
    twist, k, angle = 1.5, 3.0, 0.4
    direction = np.array([np.cos(angle), np.sin(angle)])
    omega = np.array([twist, *(k * direction)])
    n, h, start = 6, LENGTH / 6, Rotation.from_rotvec([0.2, -0.3, 0.1])
    rod = Rod(np.zeros(3), start, np.tile(omega, (n, 1)), np.zeros(n), h)
    effects, values = (BendingSoftening(), BendingAnisotropy()), [SOFTNESS, ratio, angle]
    model = CableModel(CABLES["space"], n, element, "clamped", "clamped", (0.0,) * 3, effects)
    p = model.nominal.copy()
    p[-len(values) :] = values
    first, last = (tuple(map(float, rod.frames[i].as_quat())) for i in (0, -1))
    pose = HeldPose(
        (0.0,) * 3, tuple(rod.places[-1]), start_orientation=first, end_orientation=last
    )
    x = np.array([frame.as_quat() for frame in rod.frames])
    eq = solve_equilibrium(model, p, np.zeros(model.chain.n_rests), pose, x_init=x)
    np.testing.assert_allclose(eq.points, rod.places, atol=1e-6)  # three Gauss points
    moment = EI * k / (1 + k * SOFTNESS)
    force = twist * (GJ - moment / k) * omega
    inside = np.array([GJ * twist, *(moment * direction)])
    # |k| rounded over d = 0.008: of the moment SOFTNESS d.
    rounding = SOFTNESS * 0.008 * moment
    np.testing.assert_allclose(eq.end_force, -rod.frames[-1].apply(force), atol=twist * rounding)
    np.testing.assert_allclose(eq.moments[1], -rod.frames[-1].apply(inside), atol=rounding)


def bend_of(moment: np.ndarray, stiffness: np.ndarray) -> np.ndarray:
    """Bend (2, K) of a softening section of that EI (K,) that resists with a moment (2, K).

    M = EI d(k^2 f / 2)/dk, by Newton's method from M = EI k / (1 + |k| / c).
    """
    over = moment / stiffness
    size = np.maximum(np.linalg.norm(over, axis=0), 1e-9)
    k = size / (1 - size * SOFTNESS)
    for _ in range(4):
        r = SOFTNESS * (np.hypot(k, ROUNDING) - ROUNDING)
        factor = softened(k, SOFTNESS)
        slope = (2 / (1 + r) - 2 * factor) / r
        found = k * factor + k**2 / 2 * slope * SOFTNESS * k / np.hypot(k, ROUNDING)
        k = k - (found - size) * (1 + r) ** 2
    return k * over / size


def elastica(where: str, slope: float) -> tuple[Callable, Callable]:
    """Stiffness along s over that in the middle, and d/ds of (place, quaternion, m, n).

    m in the frame, n in the world: m' + omega x m + e_x x n = 0, n' = - weight per length.
    """

    def tapered(s: np.ndarray) -> np.ndarray:
        return 1 + slope * (2 * s / LENGTH - 1)

    def derivatives(s: np.ndarray, y: np.ndarray) -> np.ndarray:
        frames, (v, w) = Rotation.from_quat(y[3:7].T), (y[3:6].T, y[6:7].T)
        moment, force = y[7:10].T, frames.inv().apply(y[10:].T)
        twist = y[7:8] / (GJ * tapered(s))
        bend = bend_of(y[8:10], EI * tapered(s))
        omega = np.concatenate([twist, bend]).T + REST[where]
        turned = -np.cross(omega, moment) - np.cross([1.0, 0.0, 0.0], force)
        # q' = q * (omega, 0) / 2.
        spun = np.column_stack([w * omega + np.cross(v, omega), -(v * omega).sum(axis=1)]) / 2
        weight = np.tile(-MASS / LENGTH * flat(GRAVITY[where]), (len(s), 1))
        return np.column_stack([frames.as_matrix()[..., 0], spun, turned, weight]).T

    return tapered, derivatives


def boundary_value(where: str, slope: float, near: Rod, bends: np.ndarray, force: np.ndarray):
    """Solution of the elastica's boundary value problem near a rod of these bends (n, 3)."""
    tapered, derivatives = elastica(where, slope)
    s = np.linspace(0.0, LENGTH, len(near.places))
    middle = (s[1:] + s[:-1]) / 2
    softer = 1 + SOFTNESS * np.linalg.norm(bends[:, 1:], axis=1)
    rows = tapered(middle) * np.array([GJ * bends[:, 0], *(EI * bends[:, 1:].T / softer)])
    quaternions = np.array([frame.as_quat() for frame in near.frames]).T
    flips = np.cumprod(np.sign(np.r_[1.0, (quaternions[:, :-1] * quaternions[:, 1:]).sum(axis=0)]))
    weight = np.outer(flat(GRAVITY[where]) * MASS, 1 - s / LENGTH)
    guess = np.concatenate(
        [
            near.places.T,
            quaternions * flips,
            [np.interp(s, middle, row) for row in rows],
            weight - force[:, None],
        ]
    )
    last = np.argmax(np.abs(guess[3:7, -1]))
    kept = [0, 1, 2, *(3 + k for k in range(4) if k != last)]

    def ends(a: np.ndarray, b: np.ndarray) -> np.ndarray:
        return np.concatenate([a[:7] - guess[:7, 0], (b[:7] - guess[:7, -1])[kept]])

    found = solve_bvp(derivatives, ends, s, guess, tol=1e-7, max_nodes=20_000)
    assert found.success, found.message
    return found


@pytest.mark.parametrize(
    ("where", "element", "slope", "order"),
    [
        ("plane", "link", 0.4, 1.9),
        ("plane", "arc", 0.4, 1.9),
        ("plane", "quadratic", 0.0, 3.5),
        ("space", "arc", 0.4, 1.9),
        ("space", "quadratic", 0.0, 3.5),
    ],
)
def test_a_softening_cable_converges_to_its_boundary_value_problem(where, element, slope, order):
    """Bending softens, torsion does not; a taper is of both."""
    pose, d, effects = POSES[where], len(GRAVITY[where]), (StiffnessGradient(), BendingSoftening())

    def solved(n: int, kind: str):
        model = CableModel(CABLES[where], n, kind, "clamped", "clamped", GRAVITY[where], effects)
        p = model.nominal.copy()
        p[-2:] = slope, SOFTNESS
        rest = np.repeat(REST[where][-len(model.node.strains) :], model.chain.n_cells)
        return solve_equilibrium(model, p, rest, pose)

    near = solved(32, "arc")
    rod = rod_of(near.x, pose.start, LENGTH / 32)
    exact = boundary_value(where, slope, rod, rod.strains - REST[where], flat(near.end_force))
    errors = []
    # Finer ones show the kink of |k| where the bend changes its sign: 3e-6 m.
    for n in (8, 16):
        eq = solved(n, element)
        at = exact.sol(np.linspace(0.0, LENGTH, n + 1))[:d]
        errors.append(np.abs(eq.points - at.T).max())
    assert np.log2(errors[0] / errors[1]) > order, errors
    np.testing.assert_allclose(eq.end_force, -exact.y[10 : 10 + d, -1], rtol=0.03, atol=0.01)
