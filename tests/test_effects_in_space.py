"""Effects in space, against the same cable in a plane, turned frames, and beams in closed form."""

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from sections import principal

from dlo_casadi.effects import (
    EFFECTS,
    BendingAnisotropy,
    CableData,
    CameraFrame,
    ClampCompliance,
    ClampRotation,
    EdgeBias,
    GravityTilt,
    MassError,
    PointForce,
    RestCurvatureDrift,
    Setup,
    SideLoad,
    Tether,
)
from dlo_casadi.equilibrium.pose import HeldPose
from dlo_casadi.equilibrium.solve import solve_equilibrium
from dlo_casadi.model.assembly import Assembly, Inputs, Shapes
from dlo_casadi.model.cable_model import CableModel
from dlo_casadi.model.clips import HeldClip
from dlo_casadi.rod.obstacles import Plane

FLAT = CableData(length=0.8, mass=0.2, diameter=0.01, bending_stiffness=0.05)
CABLE = replace(FLAT, torsional_stiffness=0.03)
GRAVITY = (0.3, 0.5, -9.7)
HELD = HeldPose(
    (0.1, 0.05, -0.2),
    (0.6, 0.0, -0.1),
    start_orientation=(0.05, -0.1, 0.2, 0.97),
    end_orientation=(-0.1, 0.1, 0.05, 0.98),
)


def solved(effects=(), values=(), pose=HELD, gravity=GRAVITY, cable=CABLE, **held):
    """Equilibrium of a cable that is straight at rest."""
    ends = {"start": "clamped", "end": "clamped", **held}
    model = CableModel(cable, 10, "arc", gravity=gravity, effects=tuple(effects), **ends)
    p = model.nominal.copy()
    p[len(p) - len(values) :] = values
    return solve_equilibrium(model, p, np.zeros(model.chain.n_rests), pose)


# ---- the plane is a special case ---------------------------------------------------------------

# Values in the plane, and what comes behind each parameter in space.
PLANAR = {
    "lumped_mass": {"mass": 0.05, "position": 0.3},
    "point_force": {"fx": 0.3, "fy": -0.2, "fz": 0.0, "position": 0.5},
    "tether": {"stiffness": 4.0, "position": 0.4, "anchor_x": 0.3, "anchor_y": 0.3, "anchor_z": 0},
    "side_load": {"force_per_length": 0.4, "force_per_length_x": 0.4, "force_per_length_z": 0.0},
    "gravity_tilt": {"angle": 0.2, "angle_x": 0.0, "angle_z": 0.2},
    "mass_error": {"factor": 1.3},
    "stiffness_gradient": {"slope": 0.4},
    "stiff_section": {"start": 0.2, "end": 0.35, "factor": 3.0},
    "bending_softening": {"softness": 0.1},
    "axial_stretch": {"compliance": 5e-3},
    "length_error": {"length_difference": 0.02},
    "end_offset": {"dx": 0.01, "dy": -0.02, "dz": 0.0},
    "clip_offset": {"dx": 0.01, "dy": -0.02, "dz": 0.0},
    "clip_slip": {"ds": 0.01},
    "clip_angle": {"heading_error": 0.05, "y": 0.0, "z": 2 * np.tan(0.025)},
    "obstacle_offset": {"offset": 0.01},
    "contact_plane": {"height": -0.12},
    "rest_curvature_drift": {"rate": 0.3},
    "plastic_set": {"yield_curvature": 2.0, "share": 0.3},
}


def test_every_effect_of_both_is_compared():
    both = {k for k, kind in EFFECTS.items() if kind.dimensions == (2, 3)}
    # A clamp that gives way turns by another angle in space, to third order: see below.
    assert set(PLANAR) == both - {"clamp_compliance"}


def in_space(model, flat):
    """Nodes and multipliers of a planar shape, as those of a model in space."""
    half, named = flat.x[:, 0] / 2, dict(zip(flat_names(model), flat.multipliers, strict=True))
    zero = np.zeros_like(half)
    x = np.stack([zero, zero, np.sin(half), np.cos(half)], axis=1)
    lam = np.array([[named.get(k, 0.0) for k in model.border_names]])
    return Shapes.declared(x[None], lam, len(model.clips))


def flat_names(model):
    """Names of what a planar model has, as the same model in space calls them."""
    absent = ("_z", "rotation_x", "rotation_y")
    return [k for k in model.border_names if k.endswith("rotation_z") or not k.endswith(absent)]


@pytest.mark.parametrize("name", PLANAR)
def test_a_cable_that_stays_in_its_plane_is_the_planar_one(name):
    """Its shapes are equilibria in space, of the same energy, curve and state."""
    gravity, headings, rest = (0.0, -9.7), (0.6, -0.5), -1.5
    models, ps, rests = [], [], []
    for cable, g in ((FLAT, gravity), (CABLE, (*gravity, 0.0))):
        effect = EFFECTS[name].made_for(Setup(cable, "clamped", "clamped", g))
        table = Plane((0.0, -0.12, 0.0)[: len(g)], (0.0, 1.0, 0.0)[: len(g)])
        kind = "clamped" if name == "clip_angle" else "pinned"
        between = {"clips": (kind,), "obstacles": (table,) * (name == "obstacle_offset")}
        model = CableModel(cable, 10, "arc", "clamped", "clamped", g, (effect,), **between)
        p = model.nominal.copy()
        for q in effect.parameters(cable):
            p[model.names.index(f"{name}.{q.name}")] = PLANAR[name][q.name]
        models.append(model)
        ps.append(p)
        rests.append(np.repeat([rest] if len(g) == 2 else [0.0, 0.0, rest], model.chain.n_cells))
    along = 0.1, tuple(Rotation.from_rotvec([0, 0, 0.1]).as_quat())
    clips = [
        HeldClip(kind, (0.2, 0.0), 0.22, heading=along[0]),
        HeldClip(kind, (0.2, 0.0, 0.0), 0.22, orientation=along[1]),
    ]
    pose = HeldPose((0.0, 0.0), (0.5, -0.1), *headings, clips=(clips[0],))
    first, last = (tuple(Rotation.from_rotvec([0, 0, a]).as_quat()) for a in headings)
    same = HeldPose(
        (0.0, 0.0, 0.0),
        (0.5, -0.1, 0.0),
        start_orientation=first,
        end_orientation=last,
        clips=(clips[1],),
    )
    flat = solve_equilibrium(models[0], ps[0], rests[0], pose)
    shapes = [flat.shapes, in_space(models[1], flat)]
    given = [
        Inputs.of(*of) for of in zip(ps, rests, (pose.vector[None], same.vector[None]), strict=True)
    ]
    planar, spatial = (
        (a.energy(), a.curve(), a.state_after()[0], a.balance()[1].rows)
        for a in map(Assembly, models, shapes, given)
    )
    n = models[0].chain.n_cells
    # Rounding of a few dozen terms; forces and moments as far as the planar shape balances.
    np.testing.assert_allclose(spatial[0], planar[0], atol=1e-12)
    np.testing.assert_allclose(spatial[1][..., [0, 1, 3, 4]], planar[1], atol=1e-12)
    np.testing.assert_allclose(spatial[1][..., [2, 5]], 0.0, atol=1e-12)
    np.testing.assert_allclose(spatial[2][:, 2 * n :], planar[2], atol=1e-11)
    np.testing.assert_allclose(spatial[2][:, : 2 * n], 0.0, atol=1e-12)
    assert np.abs(spatial[3]).max() < np.abs(planar[3]).max() + 1e-10


@pytest.mark.parametrize("end", ["free", "clamped"])
def test_clamps_that_give_way_turn_by_the_moment_on_them(end):
    """The gap g = 2 tan(angle / 2) in space, where the moment is g (1 + |g|^2 / 4) / compliance."""
    light, found = replace(FLAT, mass=2e-3), []
    for cable, g in ((light, (0.0, -9.7)), (replace(light, torsional_stiffness=0.03), GRAVITY)):
        effect = ClampCompliance.made_for(Setup(cable, "clamped", end, g))
        g = (0.0, -9.7, 0.0) if len(g) == 3 else g
        model = CableModel(cable, 10, "arc", "clamped", end, g, (effect,))
        p = model.nominal.copy()
        p[-len(effect.sides) :] = [0.02, 0.01][: len(effect.sides)]
        far = None if end == "free" else (0.6, 0.0, 0.0)[: len(g)]
        turned = tuple(Rotation.from_rotvec([0, 0, 0.3]).as_quat())
        flat = {"start_heading": 0.3, "end_heading": 0.0 if far else None}
        frames = {"start_orientation": turned, "end_orientation": (0.0, 0.0, 0.0, 1.0)}
        pose = HeldPose((0.0, 0.0, 0.0)[: len(g)], far, **(flat if len(g) == 2 else frames))
        eq = solve_equilibrium(model, p, np.zeros(model.chain.n_rests), pose)
        sides = (0, -1)[: len(effect.sides)]
        gave = np.array([model.node.difference(pose.frames[k], eq.x[k]) for k in sides])
        work = gave * (1 + (gave**2).sum(axis=1, keepdims=True) / 4 * model.in_space)
        moments = np.atleast_2d(eq.moments.reshape((2, -1)))[list(sides)]
        np.testing.assert_allclose(work, moments * p[-len(sides) :, None], rtol=1e-9, atol=1e-12)
        assert 1e-4 < np.abs(gave).max() < 0.01
        found.append(eq)
    planar, spatial = found
    np.testing.assert_allclose(spatial.points[:, :2], planar.points, atol=1e-6)


# ---- turned frames -----------------------------------------------------------------------------


@pytest.mark.parametrize(("gravity", "axes"), [(GRAVITY, "xy"), ((0.3, -9.7, 0.5), "xz")])
@pytest.mark.parametrize(("kind", "name"), [(GravityTilt, "angle"), (SideLoad, "force_per_length")])
def test_components_across_gravity_are_named_after_the_axes_it_is_least_along(
    kind, name, gravity, axes
):
    effect = kind.made_for(Setup(CABLE, gravity=gravity))
    assert [q.name for q in effect.parameters(CABLE)] == [f"{name}_{axis}" for axis in axes]


def test_without_weight_a_side_load_is_along_the_worlds_axes():
    effect, s = SideLoad(), ca.SX(0.2)
    names = [q.name for q in effect.parameters(CABLE)]
    params = dict(zip(names, (ca.SX(0.5), ca.SX(-0.3)), strict=True))
    force = ca.evalf(effect.resultant(s, ca.SX.zeros(3), CABLE, params))
    np.testing.assert_allclose(np.array(force)[:, 0], [0.3, -0.18, 0.0], rtol=1e-14)


@pytest.mark.parametrize("roll", [0.0, 0.7])
def test_clamps_are_turned_about_their_own_axes(roll):
    """As if the poses had been declared so, whatever the cable's roll in its clamp."""
    errors = (0.3, -0.2, 0.1, 0.4)
    turned = [
        Rotation.from_quat(declared) * Rotation.from_rotvec([0.0, y, z])
        for declared, (y, z) in (
            (HELD.start_orientation, errors[:2]),
            (HELD.end_orientation, errors[2:]),
        )
    ]
    first, last = (tuple(map(float, turn.as_quat())) for turn in turned)
    found = solved((ClampRotation(),), (roll, *errors))
    moved = replace(HELD, start_orientation=first, end_orientation=last)
    np.testing.assert_allclose(found.points, solved((), (roll,), moved).points, atol=1e-8)
    start = Rotation.from_quat(found.x[0]).as_matrix()
    np.testing.assert_allclose(start, turned[0].as_matrix(), atol=1e-8)
    along = Rotation.from_quat(found.x[-1]).as_matrix()[:, 0]
    np.testing.assert_allclose(along, turned[1].as_matrix()[:, 0], atol=1e-8)


def test_clamp_rotations_of_one_end_only():
    setup = Setup(CABLE, "clamped", "free", GRAVITY, tolerances={"rotation": 5e-3})
    effect = ClampRotation.made_for(setup)
    assert [q.name for q in effect.parameters(CABLE)] == ["start_y", "start_z"]
    assert effect.prior(setup) == {"start_y": 5e-3, "start_z": 5e-3}


def test_a_cameras_frame_is_known_within_its_tolerances():
    tolerances = {"camera_rotation": 2e-3, "camera_translation": 1e-3}
    prior = CameraFrame().prior(Setup(CABLE, gravity=GRAVITY, tolerances=tolerances))
    assert list(prior.values()) == 3 * [2e-3] + 3 * [1e-3]


# ---- loads and sections ------------------------------------------------------------------------


def test_a_mass_error_takes_a_reading():
    setup = Setup(CABLE, gravity=GRAVITY)
    assert not MassError.applies(setup)
    assert MassError.applies(replace(setup, readings=True))
    assert not MassError.applies(replace(setup, readings=True, gravity=(0.0, 0.0, 0.0)))
    assert MassError().refusal(setup, {"factor": 1.2}) == ""


def test_a_soft_tether_to_a_far_anchor_keeps_its_force():
    effect, force = Tether(), {"fx": -0.6, "fy": 0.8, "fz": 2.4, "position": 0.3}
    far = effect.of_linear(CABLE, {"stiffness": 0.0, **force})
    anchor = np.array([far[f"anchor_{axis}"] for axis in "xyz"])
    assert np.linalg.norm(anchor) == pytest.approx(10 * CABLE.length)
    np.testing.assert_allclose(far["stiffness"] * anchor, [-0.6, 0.8, 2.4], rtol=1e-14)
    nowhere = effect.of_linear(CABLE, dict.fromkeys((*force, "stiffness"), 0.0))
    assert (nowhere["stiffness"], nowhere["anchor_z"]) == (0.0, 0.0)


@pytest.mark.parametrize(("ratio", "angle"), [(3.0, 0.0), (3.0, 0.4), (0.3, -0.7), (1.0, 0.4)])
def test_a_cantilever_of_two_stiffnesses(ratio, angle):
    """Small tip loads: u = (L^3 / 3) B^-1 F, with M_y = -F_z (L - s), M_z = F_y (L - s)."""
    force = np.array([2e-5, -1e-5])  # y, z [N]: deflections of 1e-4 L
    pose = HeldPose((0.0, 0.0, 0.0), start_orientation=(0.0, 0.0, 0.0, 1.0))
    effects, values = (BendingAnisotropy(), PointForce()), (ratio, angle, 0.0, *force, CABLE.length)
    found = solved(effects, values, pose, (0.0, 0.0, 0.0), end="free")
    curvatures = np.linalg.inv(CABLE.bending_stiffness * principal(ratio, angle)) @ [
        -force[1],
        force[0],
    ]
    exact = CABLE.length**3 / 3 * np.array([curvatures[1], -curvatures[0]])
    # Ten elements of constant curvature: (1 / 10)^2 / 4 of it, and no more than the slope squared.
    np.testing.assert_allclose(found.points[-1, 1:], exact, rtol=0.004, atol=1e-8)


@pytest.mark.parametrize("ratio", [0.4, 0.9, 1.2, 5.0])
@pytest.mark.parametrize("angle", [-0.7, 0.0, 0.5])
def test_anisotropy_in_the_parameters_of_its_score_test(ratio, angle):
    """EI (1 + a, b; b, 1 - a) is the same matrix but for the mean, which EI takes up."""
    effect, own = BendingAnisotropy(), {"ratio": ratio, "angle": angle}
    matrix = ca.evalf(effect.bending(ca.SX.eye(2), {k: ca.SX(v) for k, v in own.items()}))
    np.testing.assert_allclose(np.array(matrix), principal(ratio, angle), atol=1e-15)
    mean = np.trace(principal(ratio, angle)) / 2
    scaled = principal(ratio, angle) / mean
    values = {"difference": scaled[0, 0] - 1, "coupling": scaled[0, 1]}
    linear = effect.linear()
    assert linear.label == effect.label
    found = ca.evalf(linear.bending(ca.SX.eye(2), {k: ca.SX(v) for k, v in values.items()}))
    np.testing.assert_allclose(np.array(found), scaled, atol=1e-14)
    assert effect.of_linear(CABLE, values) == pytest.approx(own, abs=1e-12)


def test_a_matrix_that_is_no_stiffness_is_cut():
    """A step of the score test may leave no stiffness about one axis."""
    found = BendingAnisotropy().of_linear(CABLE, {"difference": -1.0, "coupling": 0.8})
    assert found["ratio"] == pytest.approx(100.0)
    assert abs(found["angle"]) < np.pi / 4


# ---- state -------------------------------------------------------------------------------------


@pytest.mark.parametrize(("element", "order"), [("arc", 2), ("quadratic", 4)])
def test_a_uniform_rest_twist_is_a_roll_of_the_end(element, order):
    """Of a cable that is straight at rest, by minus the whole twist, as the mesh is refined."""
    twist, gaps = 1.2, []  # 1/m, m
    for n in (10, 20):
        model = CableModel(CABLE, n, element, "clamped", "clamped", GRAVITY)
        rest = np.repeat([twist, 0.0, 0.0], model.chain.n_cells)
        found = solve_equilibrium(model, model.nominal, rest, HELD)
        rolled = model.nominal.copy()
        rolled[model.names.index("end_roll")] = -twist * CABLE.length
        by_hand = solve_equilibrium(model, rolled, 0 * rest, HELD)
        gaps.append(np.abs(found.points - by_hand.points).max())
    assert np.log2(gaps[0] / gaps[1]) > order - 0.1
    assert gaps[1] < 2e-3


def test_a_drift_takes_the_twist_along():
    rest, strain = (ca.SX(ca.DM(v)) for v in ([0.4, 1.0, -2.0], [2.4, 3.0, 2.0]))
    after = RestCurvatureDrift().next_rest(rest, strain, CABLE, {"rate": ca.SX(0.25)})
    np.testing.assert_allclose(np.array(ca.evalf(after))[:, 0], [0.9, 1.5, -1.0], rtol=1e-14)


# ---- where they apply --------------------------------------------------------------------------

ONLY = {
    "plane": {
        "clamp_angle",
        "end_spring",
        "image_distortion",
        "image_scale",
        "standoff_error",
        "start_spring",
    },
    "space": {"bending_anisotropy", "camera_frame", "clamp_rotation"},
}
FULL = {"curved": True, "n_poses": 3, "center": (0.0, 0.0), "camera": True, "readings": True}
FULL |= {"clips": ("pinned", "clamped"), "obstacles": 1}


def applied(where):
    cable, gravity = (FLAT, (0.0, -9.81)) if where == "plane" else (CABLE, GRAVITY)
    setups = [Setup(cable, end, end, gravity, **FULL) for end in ("pinned", "clamped")]
    return {k for k, kind in EFFECTS.items() if any(kind.applies(setup) for setup in setups)}


def test_where_effects_apply():
    assert applied("plane") == set(EFFECTS) - ONLY["space"]
    assert applied("space") == set(EFFECTS) - ONLY["plane"]


@pytest.mark.parametrize("where", ["plane", "space"])
def test_effects_of_the_other_kind_of_cable_are_refused(where):
    cable, gravity = (CABLE, GRAVITY) if where == "plane" else (FLAT, (0.0, -9.81))
    for name, kind in EFFECTS.items():
        held = "pinned" if name.endswith("_spring") else "clamped"
        setup = Setup(cable, held, held, gravity, **FULL)
        effect = kind.made_for(setup)
        nominal = {q.name: q.nominal for q in effect.parameters(cable)}
        refused = effect.refusal(setup, nominal)
        assert bool(refused) == (name in ONLY[where]), name
        if refused:
            assert f"{len(gravity)} numbers" in refused


def test_what_a_camera_sees_of_an_edge_is_of_a_plane():
    assert not EdgeBias.applies(Setup(CABLE, gravity=GRAVITY, pixel=1e-4))
    assert EdgeBias.applies(Setup(FLAT, pixel=1e-4))
