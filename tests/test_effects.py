"""The contract of every effect in EFFECTS, and the law of each."""

from dataclasses import replace
from functools import cache

import casadi as ca
import numpy as np
import pytest
from perturbed import any_rest, any_shapes, central, directions
from scipy.spatial.transform import Rotation

from dlo_casadi.effects import (
    EFFECTS,
    NUISANCES,
    BendingSoftening,
    CableData,
    ClampAngle,
    ClampCompliance,
    EdgeBias,
    Effect,
    GravityTilt,
    ImageScale,
    Kinematics,
    Load,
    LumpedMass,
    PlasticSet,
    PointForce,
    SectionLaw,
    Setup,
    SideLoad,
    StandoffError,
    StiffnessGradient,
    StiffSection,
    Tether,
    UnknownPull,
    Viewpoint,
    random_effects,
)
from dlo_casadi.effects.effect import Fitted
from dlo_casadi.equilibrium.pose import HeldPose
from dlo_casadi.equilibrium.solve import solve_equilibrium
from dlo_casadi.estimation.prediction import predict_poses
from dlo_casadi.model.assembly import Assembly, Inputs, Shapes
from dlo_casadi.model.cable_model import CableModel
from dlo_casadi.model.clips import HeldClip
from dlo_casadi.rod.chain import ELEMENTS, ELEMENTS_IN_SPACE
from dlo_casadi.rod.element import Cell
from dlo_casadi.rod.obstacles import Plane

CABLE = CableData(length=0.8, mass=0.2, diameter=0.01, bending_stiffness=0.05)
# Start, end [m], headings [rad]; a camera 2 m in front of (0.6, -0.4).
POSE = HeldPose((0.1, 0.05), (0.5, -0.1), 0.4, -0.2, camera_center=(0.6, -0.4, 2.0)).vector
IN_SPACE = replace(CABLE, torsional_stiffness=0.03)
POSE_IN_SPACE = HeldPose(
    (0.1, 0.05, -0.2),
    (0.5, -0.1, 0.1),
    start_orientation=(0.1, -0.2, 0.3, 0.9),
    end_orientation=(-0.3, 0.1, 0.2, 0.9),
).vector
GRAVITY = {"plane": (1.0, -9.7), "space": (1.0, 0.5, -9.7)}
KINDS = {"section", "kinematics", "load", "boundary", "measurement", "state", "contact"}
UNITS = {"", "kg", "m", "N", "N/m", "1/N", "1/m", "1/m^2", "rad", "N m/rad", "rad/(N m)"}
EVERY = pytest.mark.parametrize("name", sorted(EFFECTS))
ALL = pytest.mark.parametrize("element", ["quadratic", "arc", "link"])
WHERE = (*(("plane", e) for e in ELEMENTS), *(("space", e) for e in ELEMENTS_IN_SPACE))
CLIPPED = {"clip_offset", "clip_slip", "clip_angle"}
TOUCHING = {"obstacle_offset", "contact_plane"}
OPTIONS = {"contact_plane": {"level": 0.3}}
TABLES = {"plane": Plane((0.0, 0.3), (0.0, 1.0)), "space": Plane((0.0, 0.0, 0.3), (0.0, 0.0, 1.0))}
CLIPS = {
    "plane": HeldClip("pinned", (0.3, -0.1), 0.37),
    "space": HeldClip("pinned", (0.3, 0, 0), 0.37),
}
CASES = [
    (name, where, element)
    for where, element in WHERE
    for name, kind in sorted(EFFECTS.items())
    if {"plane": 2, "space": 3}[where] in kind.dimensions
    and not (name in CLIPPED | TOUCHING and element == "link")  # refused with clips and obstacles
]


@pytest.fixture(scope="module", params=CASES, ids="-".join)
def case(request) -> tuple[str, str, str]:
    """Each effect, wherever it applies: all tests of one follow each other, its model made once."""
    return request.param


@cache
def plain(name: str, where: str, element: str) -> CableModel:
    """Model without the effect, with the boundaries that it needs."""
    held = "pinned" if where == "plane" and not name.startswith("clamp_") else "clamped"
    cable = CABLE if where == "plane" else IN_SPACE
    clips = ("clamped" if name == "clip_angle" else "pinned",) if name in CLIPPED else ()
    obstacles = (TABLES[where],) if name in TOUCHING else ()
    between = {"clips": clips, "obstacles": obstacles}
    return CableModel(cable, 5, element, held, held, GRAVITY[where], **between)


@cache
def with_effect(name: str, where: str, element: str) -> CableModel:
    return plain(name, where, element).with_effect(EFFECTS[name](**OPTIONS.get(name, {})))


def own_indices(model: CableModel) -> list[int]:
    """Where the parameters of effects stand."""
    return [i for i, name in enumerate(model.names) if "." in name]


def own_parameters(model: CableModel, values: str) -> np.ndarray:
    """Parameter vector with the effect's at "nominal" or well off it, within bounds."""
    rng = np.random.default_rng(0)
    p = model.nominal.copy()
    if values == "nominal":
        return p
    for i in own_indices(model):
        q = model.parameters[i]
        moved = q.nominal + q.scale * rng.uniform(0.3, 0.8)
        moved = moved if model.effects[-1].gradual else q.upper
        p[i] = np.clip(moved, q.lower, q.upper)
    return p


def posed(model: CableModel, p: np.ndarray, headings: str = "random") -> Assembly:
    """One pose, straight and unloaded or without any symmetry."""
    pose = POSE_IN_SPACE if model.in_space else POSE
    if model.clips:
        clip = CLIPS["space" if model.in_space else "plane"]
        pose = np.concatenate([pose, clip.vector(model.node)])
    scale = 0.0 if headings == "straight" else 1.0
    shapes = any_shapes(model, scale=1.5 * scale)
    given = Inputs.of(p, scale * any_rest(model)[0], pose[None])
    # Springs rest at the origin: their unknowns are those of no other model.
    lam = scale * shapes.lam * (np.arange(model.n_border) < len(model.condition_names))
    a = Assembly(model, Shapes.declared(shapes.x, lam, len(model.clips)), given)
    # The node at a saddle is in its frame, as in all shapes.
    return replace(a, shapes=replace(a.shapes, x=a.clipped.in_frames(shapes.x)))


def outputs(model: CableModel, p: np.ndarray, headings: str = "random") -> dict[str, np.ndarray]:
    """All that the other stages ask for, derivatives by all but the effect's own parameters."""
    a = posed(model, p, headings)
    total, slope, matrix = a.balance()
    along = directions(model, 1, "x", "lam", "p", "rest", "deviation")
    kept = ~along.p[0, own_indices(model)].any(axis=0)
    (curve, change), after = a.curve_along(along), a.state_after()
    return {
        "Lagrangian": total,
        "gradient": slope.rows,
        "Hessian": matrix.dense(),
        "gradient by all": a.balance_along(along).rows[..., kept],
        "curve": curve,
        "curve by all": change[..., kept],
        "rest after": after[0],
        "rest after by all": a.state_along(after, along)[..., kept],
    }


def number(expression) -> np.ndarray:
    return np.array(ca.evalf(ca.SX(expression))).squeeze()


# ---- contract ----------------------------------------------------------------------------------


@EVERY
def test_declaration(name):
    effect = EFFECTS[name]()
    assert isinstance(effect, Effect)
    assert (effect.name, effect.label) == (name, name)
    assert effect.kind in KINDS
    declared = effect.parameters(CABLE if 2 in effect.dimensions else IN_SPACE)
    assert declared
    assert effect.dimensions in ((2,), (3,), (2, 3))
    for q in declared:
        assert q.unit in UNITS, f"{q.name}: unit {q.unit!r}"
        assert np.isfinite(q.nominal)
        assert q.lower <= q.nominal <= q.upper
        assert q.nominal + q.scale <= q.upper or q.nominal - q.scale >= q.lower
    assert len({q.name for q in declared}) == len(declared)


def test_trial_values_are_about_what_the_shapes_show():
    setup = Setup(CABLE, directions=(0.3, -0.7), largest_bend=5.0, level=0.2, resting=-0.3)
    trials = {name: kind.made_for(setup).scans(setup) for name, kind in EFFECTS.items()}
    for name, mean in (("start_spring", 0.3), ("end_spring", -0.7)):
        headings = [scan["heading"] for scan in trials[name]]
        assert mean in headings
        assert np.mean(headings) == pytest.approx(mean)
    yields = [scan["yield_curvature"] for scan in trials["plastic_set"]]
    assert 0.0 < min(yields) < 1.0 < 3.0 < max(yields) < 5.0
    # From the level of the first start to where shapes rest: the cable's axis lies a radius higher.
    (table,) = trials["contact_plane"]
    assert table["height"] == pytest.approx(-0.3 - 0.2 - CABLE.diameter / 2)
    (above,) = EFFECTS["contact_plane"](level=-0.4).scans(setup)
    assert above["height"] == 0.0
    stretches = [(scan["start"], scan["end"]) for scan in trials["stiff_section"]]
    assert all(0.0 <= start < end <= CABLE.length for start, end in stretches)
    for name in ("lumped_mass", "point_force", "tether", "stiff_section"):
        places = [EFFECTS[name]().place(scan) for scan in trials[name]]
        assert min(places) < 0.2 * CABLE.length < 0.8 * CABLE.length < max(places)
    # The middle of a section, unless the cable ends within it.
    for start, end in stretches:
        place = EFFECTS["stiff_section"]().place({"start": start, "end": end})
        assert place == pytest.approx((start + end) / 2)


@pytest.mark.parametrize("headings", ["straight", "random"])
@pytest.mark.parametrize("values", ["nominal", "off"])
def test_gradients_and_hessians_are_finite(case, headings, values):
    """No sqrt(0), atan2(0, 0) or 0/0 in the Lagrangian, its Hessian, or the derivatives by p."""
    model = with_effect(*case)
    p = own_parameters(model, values)
    a, own = posed(model, p, headings), directions(model, 1, "p")
    blocks = outputs(model, p, headings)
    blocks["gradient by p"] = a.balance_along(own).rows
    blocks["curve by p"] = a.curve_along(own)[1]
    for what, block in blocks.items():
        assert np.all(np.isfinite(block)), what


def test_no_effect_at_nominal_values(case):
    """Balance, Hessian, measured curve and state are those of the model without the effect."""
    model, bare = with_effect(*case), plain(*case)
    with_it, without = outputs(model, model.nominal), outputs(bare, bare.nominal)
    if model.n_border > bare.n_border:
        with_it["gradient"] = with_it["gradient"][:, : without["gradient"].shape[1]]
        with_it = {what: with_it[what] for what in ("Lagrangian", "gradient", "curve")}
    for what, block in with_it.items():
        # The rounding of a few dozen terms, of size up to 1e2 in the Hessian.
        np.testing.assert_allclose(block, without[what], rtol=1e-11, atol=1e-11, err_msg=what)


def test_every_effect_does_something(case):
    model, bare = with_effect(*case), plain(*case)
    with_it = outputs(model, own_parameters(model, "off"))
    without = outputs(bare, bare.nominal)
    missing = with_it["gradient"].shape[1] - without["gradient"].shape[1]
    without["gradient"] = np.pad(without["gradient"], ((0, 0), (0, missing), (0, 0)))
    felt = ("gradient", "curve", "rest after")
    assert max(np.abs(with_it[what] - without[what]).max() for what in felt) > 1e-4


def test_derivatives_by_parameters_against_finite_differences(case):
    """Of the balance, the measured curve and the state."""
    model = with_effect(*case)
    a, along = posed(model, own_parameters(model, "off")), directions(model, 1, "p")
    d = np.array([1e-5 * (q.nominal if q.log else q.scale) for q in model.parameters])
    after = a.state_after()
    for what, exact, function in (
        (
            "balance",
            a.balance_along(along).rows,
            lambda b: b.balance()[1].rows[..., 0],
        ),
        ("curve", a.curve_along(along)[1], lambda b: b.curve()),
        (
            "state",
            a.state_along(after, along),
            lambda b: b.state_after()[0],
        ),
    ):
        found = central(a, function, along, d)
        size = np.maximum(np.abs(exact).max(axis=tuple(range(exact.ndim - 1))), 1.0)
        # Central differences of 1e-5 scales: 1e-10 of the third derivative, and the
        # rounding of values of order ten over 2 d, d > 1e-8.
        assert np.all(np.abs(found - exact) < 1e-6 * size + 1e-14 / d), what


ELASTIC = [case for case in CASES if issubclass(EFFECTS[case[0]], SectionLaw | Kinematics)]


@pytest.mark.parametrize(("name", "where", "element"), ELASTIC)
def test_elastic_effects_do_not_feel_rigid_motion(name, where, element):
    """Board, gravity and cable turned together by 1.1 rad and moved: the same energy and shape."""
    model = with_effect(name, where, element)
    d, c = model.node.dimension, model.node.coordinates
    rotation = Rotation.from_rotvec(1.1 * np.array([0.0, 0.0, 1.0] if d == 2 else [0.6, 0.0, 0.8]))
    turn, shift = rotation.as_matrix()[:d, :d], np.array([0.3, -0.7, 0.2])[:d]

    def turned_nodes(x):
        if d == 2:
            return x + 1.1
        turned = rotation * Rotation.from_quat(x.reshape((-1, c)))
        return turned.as_quat().reshape(x.shape)

    gravity = tuple(float(g) for g in turn @ np.array(model.gravity))
    turned = replace(model, gravity=gravity)
    p = own_parameters(model, "off")
    a = posed(model, p)
    shapes, given = a.shapes, a.given
    start, end, frames, viewpoint = np.split(given.poses[0], [d, 2 * d, 2 * (d + c)])
    pose = np.concatenate(
        [turn @ start + shift, turn @ end + shift, turned_nodes(frames), viewpoint]
    )
    lam = shapes.lam.copy()  # multipliers of clamps are about the frames' own axes
    lam[:, :d] = lam[:, :d] @ turn.T
    there = Shapes.declared(turned_nodes(shapes.x), lam, len(model.clips))
    b = Assembly(turned, there, replace(given, poses=pose[None]))
    fall = -CABLE.mass * np.array(gravity) @ shift  # the weight has been moved, too
    # Rounding of a few dozen terms of order one.
    energy = b.energy() - fall
    np.testing.assert_allclose(energy, a.energy(), atol=1e-11)
    nodes = a.nodes() @ turn.T + shift
    np.testing.assert_allclose(b.nodes(), nodes, atol=1e-11)
    balance, new_balance = a.balance()[1], b.balance()[1]
    np.testing.assert_allclose(new_balance.x, balance.x, atol=1e-11)


# ---- loads -------------------------------------------------------------------------------------


def energies(effects: tuple[Effect, ...], p: list[float], gravity=(0.0, -9.81), element="arc"):
    """Energy [J] and nodes of a random shape that hangs on these loads alone."""
    model = CableModel(CABLE, n=5, element=element, effects=effects, gravity=gravity)
    where = posed(model, np.array([CABLE.bending_stiffness, *p]))
    return where.energy()[0], where.nodes()[0]


# At given headings loads move the bubbles of quadratic elements: not for those.
@pytest.mark.parametrize("element", ["arc", "link"])
def test_energy_of_loads(element):
    """A mass m at node 2 has -m g . r; a force -f . r; a side load -q int x ds."""
    s = 2 * CABLE.length / 5
    none, nodes = energies((), [], element=element)
    mass, _ = energies((LumpedMass(),), [0.3, s], element=element)
    assert mass - none == pytest.approx(0.3 * 9.81 * nodes[2, 1], abs=1e-12)
    force, _ = energies((PointForce(),), [0.4, -0.7, s], element=element)
    assert force - none == pytest.approx(-0.4 * nodes[2, 0] + 0.7 * nodes[2, 1], abs=1e-12)
    # A side load q acts like gravity q L / m along x.
    side, _ = energies((SideLoad(),), [0.6], element=element)
    wind = (0.6 * CABLE.length / CABLE.mass, -9.81)
    assert side == pytest.approx(energies((), [], wind, element)[0], abs=1e-12)


def test_loads_add_and_a_tilt_turns_every_weight():
    """Cable and lumped mass feel the turned gravity, a point force does not."""
    angle, s = 0.2, 0.3
    parts = (LumpedMass(), PointForce(), LumpedMass(label="clip"))
    values = [0.3, s, 0.5, 0.1, s, 0.05, 0.6]
    tilted, _ = energies((*parts, GravityTilt()), [*values, angle])
    first, _ = energies((GravityTilt(), *parts), [angle, *values])
    gravity = (9.81 * np.sin(angle), -9.81 * np.cos(angle))
    by_hand, _ = energies(parts, values, gravity)
    assert tilted == pytest.approx(by_hand, abs=1e-12)
    assert first == pytest.approx(tilted, abs=1e-12)
    none, _ = energies((), [])
    alone = [
        energies((part,), part_values)[0] - none
        for part, part_values in zip(parts, ([0.3, s], [0.5, 0.1, s], [0.05, 0.6]), strict=True)
    ]
    together, _ = energies(parts, values)
    assert together - none == pytest.approx(sum(alone), abs=1e-12)


@ALL
def test_reactions_carry_the_weight_and_the_force_of_a_tether(element):
    model = CableModel(CABLE, n=20, element=element, effects=(Tether(),))
    anchor = np.array([0.3, 0.4])
    p = np.array([0.05, 5.0, 0.4, *anchor])
    found = solve_equilibrium(
        model, p, np.zeros(model.chain.n_cells), HeldPose((0.1, 0.0), (0.6, 0.1))
    )
    loads = 5.0 * (anchor - found.points[10]) - [0.0, 9.81 * CABLE.mass]
    # Bubbles enter the spring's energy to second order: error k L b^4, with b of 0.01 rad.
    np.testing.assert_allclose(found.end_force + found.start_force, loads, atol=1e-6)


@ALL
def test_a_tether_to_its_clamp_buckles_a_cable_at_eulers_load(element):
    """A force k L at the tip, always towards the clamp: pi^2 EI / L^2  [Timoshenko and Gere]."""
    model = CableModel(CABLE, 20, element, "clamped", "free", (0.0, 0.0), (Tether(),))
    pose = HeldPose((0.0, 0.0), start_heading=0.0)
    critical = np.pi**2 * 0.05 / CABLE.length**3
    straight = np.zeros(model.chain.n_nodes)
    for share, stable in ((0.98, True), (1.02, False)):  # links: (pi / 20)^2 / 12 = 0.2 % off
        p = np.array([0.05, share * critical, CABLE.length, 0.0, 0.0])
        rest = np.zeros(model.chain.n_cells)
        assert solve_equilibrium(model, p, rest, pose, x_init=straight[:, None]).stable is stable


def test_a_soft_tether_to_a_far_anchor_is_a_point_force():
    """Between its own parameters and those of its score test: f = k a, a within reach."""
    effect, force = Tether(), {"fx": -0.6, "fy": 0.8, "position": 0.3}
    far = effect.of_linear(CABLE, {"stiffness": 0.0, **force})
    assert np.hypot(far["anchor_x"], far["anchor_y"]) == pytest.approx(10 * CABLE.length)
    near = effect.of_linear(CABLE, {"stiffness": 2.0, **force})
    assert (near["anchor_x"], near["anchor_y"]) == pytest.approx((-0.3, 0.4))
    assert effect.in_linear(near) == pytest.approx({"stiffness": 2.0, **force})
    pose = HeldPose((0.0, 0.0), (0.5, 0.1))

    def nodes(effect, values):
        model = CableModel(CABLE, n=10, effects=(effect,))
        p = np.array([0.05, *(values[q.name] for q in effect.parameters(CABLE))])
        return solve_equilibrium(model, p, np.zeros(10), pose).points

    moved = nodes(PointForce(), force)
    none = nodes(PointForce(), {**force, "fx": 0.0, "fy": 0.0})
    # The cable is within L of the origin, the anchor 10 L away.
    gap = np.abs(nodes(effect, far) - moved).max()
    assert gap < 0.1 * np.abs(moved - none).max()
    np.testing.assert_allclose(
        nodes(effect.linear(), {"stiffness": 0.0, **force}), moved, atol=1e-9
    )


@pytest.mark.parametrize("cable", [CABLE, IN_SPACE], ids=["plane", "space"])
@pytest.mark.parametrize("name", sorted(k for k, kind in EFFECTS.items() if issubclass(kind, Load)))
def test_nothing_hangs_beyond_the_end(name, cable):
    """The resultant of a spread load beyond s falls to zero at the end."""
    effect, s = EFFECTS[name](), ca.SX.sym("s")
    params = {q.name: ca.SX(q.nominal + 0.5 * q.scale) for q in effect.parameters(cable)}
    gravity = ca.SX(ca.DM([1.0, -9.0, 2.0][: len(cable.axes)]))
    force = effect.resultant(s, gravity, cable, params)
    at_end = ca.substitute(ca.SX(force), s, CABLE.length)
    np.testing.assert_allclose(number(at_end), 0.0, atol=1e-14)


@pytest.mark.parametrize("element", ["arc", "link"])
def test_an_unknown_pull_is_another_force_in_every_pose(element):
    """The mean over the poses and the pose's own deviation, together a point force."""
    model = CableModel(CABLE, n=5, element=element, effects=(UnknownPull(),))
    a = posed(model, np.array([0.05, 0.3, 0.1, 0.48]))
    a.shapes.deviation[0, 4:6] = [0.1, -0.8]
    found = a.energy()[0]
    direct, _ = energies((PointForce(),), [0.4, -0.7, 0.48], element=element)
    assert found == pytest.approx(direct, abs=1e-12)


# ---- section laws ------------------------------------------------------------------------------

CELLS = [Cell(ca.SX(low), ca.SX(0.2), 0.2) for low in (0.0, 0.2, 0.4, 0.6)]  # m


def factors(effect: SectionLaw, values: dict[str, float]) -> np.ndarray:
    """Factors of the law in each of the four cells."""
    params = {key: ca.SX(value) for key, value in values.items()}
    return np.array([number(effect.along(cell, CABLE, params)) for cell in CELLS])


def test_taper_in_each_cell():
    """EI (1 + a (2 s/L - 1)) averages to its value in the middle: s/L = 1/8, 3/8, 5/8, 7/8."""
    np.testing.assert_allclose(
        factors(StiffnessGradient(), {"slope": 0.4}), [0.7, 0.9, 1.1, 1.3], rtol=1e-13
    )


def test_stiff_section_averages_compliances():
    """Four times as stiff over halves of cells 1 and 3 and all of cell 2: 1 / (1/2 + 1/8), 4."""
    found = factors(StiffSection(), {"start": 0.3, "end": 0.7, "factor": 4.0})
    covered = (1 - 1 / found) / (1 - 1 / 4.0)
    # The edges are rounded over r = a quarter of a cell: half a cell d away from an edge,
    # (sqrt(d^2 + r^2) - d) / 2 = 3 % of a cell is still on the wrong side of the cell's border.
    np.testing.assert_allclose(covered, [0.0, 0.5, 1.0, 0.5], atol=0.06)
    # What one cell loses its neighbours gain; far away 0.5 % of a cell falls off the cable.
    assert covered.sum() == pytest.approx(2.0, abs=0.05)
    np.testing.assert_allclose(
        factors(StiffSection(), {"start": 0.3, "end": 0.3, "factor": 4.0}), 1.0, atol=1e-15
    )


def test_moment_of_a_softening_section():
    """M = EI k / (1 + |k| c'), c' the softness, from the energy by central differences."""
    softness, d = 0.2, 1e-5
    k = np.array([-6.0, -1.0, 0.5, 8.0])

    def law(what: str, bend: np.ndarray) -> np.ndarray:
        of = getattr(BendingSoftening(), what)
        return number(of(ca.SX(ca.DM(bend**2)), CABLE, {"softness": ca.SX(softness)}))

    def energy(bend):
        return bend**2 / 2 * law("of_bend", bend)

    moment = (energy(k + d) - energy(k - d)) / (2 * d)
    # |k| is rounded by 1e-3 of a turn per length (0.008 1/m), which the softness turns into a
    # share of 0.2 * 0.008 = 1.6e-3.
    np.testing.assert_allclose(moment, k / (1 + np.abs(k) * softness), rtol=2e-3)
    assert np.all(np.diff(moment) > 0)
    slope = 1 / (1 + np.abs(k) * softness) ** 2  # dM/dk over EI
    np.testing.assert_allclose(law("tangent", k), slope, rtol=4e-3)


def test_the_tangent_of_a_law_that_tells_none():
    """W = EI k^2 (1 + k^2) / 2 has d^2W/dk^2 = EI (1 + 6 k^2)."""

    class Hardening(SectionLaw):
        name = "hardening"

        def of_bend(self, square, cable, params):
            return 1 + square

    k = np.array([0.0, 0.5, -2.0])
    found = [number(Hardening().tangent(ca.SX(x**2), CABLE, {})) for x in k]
    np.testing.assert_allclose(found, 1 + 6 * k**2, rtol=1e-14)


# ---- boundaries, measurement, state ------------------------------------------------------------


@ALL
def test_a_clamp_that_gives_way_is_one_turned_by_the_moment_on_it(element):
    """And what it stores is c M^2 / 2: the energy's slope by the heading is the moment on it."""
    held = {"n": 8, "element": element, "start": "clamped", "end": "clamped"}
    giving = CableModel(CABLE, effects=(ClampCompliance(),), **held)
    turned = CableModel(CABLE, effects=(ClampAngle(),), **held)
    rest, pose = np.zeros(giving.chain.n_cells), HeldPose((0.0, 0.0), (0.5, -0.1), 0.4, -0.2)
    compliance = np.array([0.6, 0.2])
    p = np.array([0.05, *compliance])
    found = solve_equilibrium(giving, p, rest, pose)
    turns = compliance * found.moments
    assert np.abs(turns).min() > 0.02
    same = solve_equilibrium(turned, np.array([0.05, *turns]), rest, pose)
    np.testing.assert_allclose(found.points, same.points, atol=1e-9)
    stored = (compliance * found.moments**2).sum() / 2
    assert found.energy == pytest.approx(same.energy + stored, abs=1e-10)
    d = 1e-4  # of the third derivative 1e-8 is left, and rounding over d
    ahead, back = (
        solve_equilibrium(giving, p, rest, replace(pose, start_heading=0.4 + step)).energy
        for step in (d, -d)
    )
    assert (back - ahead) / (2 * d) == pytest.approx(found.moments[0], rel=1e-6)


def test_moments_of_pins_turn_the_ends_counter_clockwise():
    """V = -EI (start phi(0) + end phi(L)) with the numbers of the pose."""
    model = CableModel(CABLE, 5, "arc", random=(random_effects()["pin_moment"](),))
    a = posed(model, model.nominal)
    own = np.zeros((1, len(model.deviation_names)))
    names = ["pin_moment.start", "pin_moment.end"]
    own[0, [model.deviation_names.index(name) for name in names]] = [0.7, -0.4]
    energies = [
        replace(a, shapes=replace(a.shapes, deviation=x)).energy()[0] for x in (own, 0 * own)
    ]
    work = CABLE.bending_stiffness * a.shapes.x[0, [0, -1], 0] @ [0.7, -0.4]
    assert energies[0] - energies[1] == pytest.approx(-work, abs=1e-13)


def test_biases_of_sensors_are_known_within_the_tolerances_of_forces_and_moments():
    tolerances = {"force_bias": 0.02, "moment_bias": 0.003}
    setup = Setup(CABLE, readings=("end_force", "end_moment"), tolerances=tolerances)
    prior = NUISANCES["sensor_bias"].made_for(setup).prior(setup)
    assert prior == {"end_force_x": 0.02, "end_force_y": 0.02, "end_moment": 0.003}


@pytest.mark.parametrize(
    ("force", "std", "weight"),
    [
        ((0.0, -0.3), 0.01, True),
        ((0.0, 0.3), 0.01, False),  # it lifts the cable
        ((0.015, -0.3), 0.01, True),  # along gravity within two standard deviations
        ((0.025, -0.3), 0.01, False),
        ((0.025, -0.3), 0.02, True),
    ],
)
def test_a_force_may_be_a_weight_if_it_is_along_gravity(force, std, weight):
    values = {"fx": force[0], "fy": force[1], "position": 0.4}
    stds = {"fx": std, "fy": 5.0, "position": 0.0}
    assert LumpedMass().may_be(Fitted(PointForce(), Setup(CABLE), values, stds)) is weight
    strap = values | {"stiffness": 1.0, "anchor_x": 0.0, "anchor_y": -1.0}
    assert not LumpedMass().may_be(Fitted(Tether(), Setup(CABLE), strap, stds))


@pytest.mark.parametrize(
    ("share", "beside"), [(0.09, "start"), (0.11, ""), (0.89, ""), (0.91, "end")]
)
def test_what_acts_beside_a_fixture_may_be_the_fixture(share, beside):
    values = {"fx": 0.1, "fy": 0.2, "position": share * CABLE.length}
    found = Fitted(PointForce(), Setup(CABLE), values, values)
    for side in ("start", "end"):
        assert found.near(side) is (side == beside)
        assert EFFECTS[f"{side}_spring"]().may_be(found) is (side == beside)
        only = ClampAngle(start=side == "start", end=side == "end")
        assert only.may_be(found) is (side == beside)
    everywhere = Fitted(SideLoad(), Setup(CABLE), {"force_per_length": 0.1}, {})
    assert not everywhere.near("start")


def test_clamp_angles_of_one_end_only():
    one = ClampAngle(start=False)
    assert [q.name for q in one.parameters(CABLE)] == ["end_heading_error"]
    model = CableModel(CABLE, n=4, start="pinned", end="clamped", effects=(one,))
    assert model.names == ("bending_stiffness", "clamp_angle.end_heading_error")


def seen_from(camera_center, start=(0.0, 0.0)) -> Viewpoint:
    vector = ca.SX(ca.DM(HeldPose(start, camera_center=camera_center).vector))
    return Viewpoint(vector[:2], vector[6:8], vector[8])


def test_a_camera_at_infinity_sees_no_standoff():
    point = ca.SX(ca.DM([0.5, 0.2]))
    seen = StandoffError().observe(point, ca.SX(0), seen_from(None), {"distance": ca.SX(0.01)})
    np.testing.assert_array_equal(number(seen), [0.5, 0.2])


def test_over_the_start_fixture_a_standoff_error_is_a_scale():
    """By z / (z - d): the two cannot be told apart there."""
    point, start = ca.SX(ca.DM([0.5, 0.2])), (0.1, 0.05)
    viewpoint = seen_from((*start, 1.5), start)
    seen = StandoffError().observe(point, ca.SX(0), viewpoint, {"distance": ca.SX(0.02)})
    scaled = ImageScale().observe(point, ca.SX(0), viewpoint, {"factor": ca.SX(1.5 / 1.48)})
    np.testing.assert_allclose(number(seen), number(scaled), rtol=1e-14)


def test_a_scaled_line_is_scaled_between_its_nodes_too():
    """Its derivatives by the arc length as well as its places, from the start fixture."""
    bare = CableModel(CABLE, 5)
    model = bare.with_effect(ImageScale())
    seen, true = (
        posed(m, p).curve()[0]
        for m, p in ((model, np.append(bare.nominal, 1.1)), (bare, bare.nominal))
    )
    start = true[0, :2]
    np.testing.assert_allclose(seen[:, :2], start + 1.1 * (true[:, :2] - start), atol=1e-14)
    np.testing.assert_allclose(seen[:, 2:], 1.1 * true[:, 2:], atol=1e-14)


@pytest.mark.parametrize("element", ["arc", "quadratic"])
def test_the_line_that_a_map_by_direction_shows_converges(element):
    """Between nodes its slopes count, which turn as the cable does."""
    p = np.array([CABLE.bending_stiffness, *np.full(8, 2e-3)])
    s, lines = np.linspace(0.0, CABLE.length, 101), []
    for n in (10, 20, 40, 160):
        model = CableModel(CABLE, n, element, effects=(EdgeBias(),))
        held, rest = HeldPose((0.0, 0.0), (0.5 * CABLE.length, 0.1)), np.zeros(model.chain.n_rests)
        (found,) = predict_poses(model, p, rest, [held])
        lines.append(found.curve.at(s))
    gaps = [np.abs(line - lines[-1]).max() for line in lines[:-1]]
    assert np.all(np.log2(np.divide(gaps[:-1], gaps[1:])) > 1.9), gaps


@pytest.mark.parametrize("space", [False, True])
def test_a_plastic_set_is_what_a_bend_exceeds_the_yield_by(space):
    """In its direction, by its size; in space whatever the twist."""
    bend = np.array([-7.0, -3.0, -1.0, 0.0, 1.0, 3.0, 7.0])
    direction = np.array([0.0, 0.6, 0.8] if space else [1.0])
    twist = np.array([5.0, 0.0, 0.0] if space else [0.0])

    def left(limit):
        params = {"yield_curvature": ca.SX(limit), "share": ca.SX(0.25)}
        rest = ca.SX(ca.DM([0.1, 0.4, -0.7][: len(twist)]))
        laws = (
            PlasticSet().next_rest(rest, rest + ca.DM(k * direction + twist), CABLE, params)
            for k in bend
        )
        moved = np.array([number(law - rest) for law in laws]).reshape((len(bend), -1))
        along = moved @ direction
        np.testing.assert_allclose(moved, np.outer(along, direction), atol=1e-14)
        return along

    excess = np.sign(bend) * np.maximum(np.abs(bend) - 2.0, 0.0)
    # Kinks rounded over d = 0.01 turns per length: d^2 / (4 |x|) = 0.0015 1/m at x = 1 1/m from
    # either of them.
    np.testing.assert_allclose(left(2.0), 0.25 * excess, atol=2 * 0.0015)
    np.testing.assert_allclose(left(2.0), -left(2.0)[::-1], atol=1e-14)
    # Without a yield curvature it is a drift, exactly.
    np.testing.assert_allclose(left(0.0), 0.25 * bend, atol=1e-14)


def test_an_effect_without_its_segment_says_so():
    with pytest.raises(TypeError, match="Bare declares no parameters"):
        type("Bare", (Effect,), {"name": "bare"})().parameters(CABLE)
