"""A rod in space against closed forms, the plane, turned worlds, and itself on finer meshes."""

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from scipy.linalg import null_space
from scipy.optimize import brentq
from scipy.spatial.transform import Rotation

from dlo_casadi.effects import EFFECTS, CableData, SectionLaw
from dlo_casadi.effects.cable import Parameter
from dlo_casadi.equilibrium.batch import BatchEquilibrium
from dlo_casadi.equilibrium.curve import across
from dlo_casadi.equilibrium.minima import at_saddles, descend
from dlo_casadi.equilibrium.pose import HeldPose
from dlo_casadi.equilibrium.solve import solve_equilibrium
from dlo_casadi.errors import DloError, EquilibriumError
from dlo_casadi.model.assembly import Assembly, Inputs, Shapes
from dlo_casadi.model.cable_model import CableModel
from dlo_casadi.model.functions import functions_of
from dlo_casadi.model.lagrangian import lagrangian_of
from dlo_casadi.rod.node import Frame
from dlo_casadi.rod.quaternions import same_sign

LENGTH, EI, GJ = 0.8, 0.02, 0.015
DOWN = (0.0, 0.0, -9.81)


def model(n=20, element="quadratic", gravity=DOWN, torsion=GJ, mass=0.12, end="clamped"):
    cable = CableData(LENGTH, mass, 0.006, EI, torsional_stiffness=torsion)
    return CableModel(cable, n=n, element=element, start="clamped", end=end, gravity=gravity)


def pose(end, start_turn=(0.0, 0.0, 0.0), end_turn=(0.0, 0.0, 0.0), turns=0.0, start=(0, 0, 0)):
    frames = [tuple(Rotation.from_rotvec(turn).as_quat()) for turn in (start_turn, end_turn)]
    return HeldPose(
        tuple(map(float, start)), tuple(map(float, end)), None, None, *frames, turns=turns
    )


OUT_OF_PLANE = pose((0.5, 0.1, 0.2), (0.3, -0.2, 0.4), (1.0, 0.3, -0.5))


def solved(m, place, rest=None):
    rest = np.zeros(m.chain.n_rests) if rest is None else rest
    return solve_equilibrium(m, m.nominal, rest, place)


def curved(m):
    """Rest curvatures that change along the cable, about both axes."""
    s = m.chain.cells.mean(axis=1) / LENGTH
    strains = np.zeros((len(m.node.strains), len(s)))
    strains[-2], strains[-1] = 2.0 + np.sin(3 * s), 1.5 * np.cos(2 * s)
    return strains.ravel()


@pytest.mark.parametrize(("element", "order"), [("arc", 1.9), ("quadratic", 3.8)])
def test_order_of_the_elements(element, order):
    # Clamps at an angle, gravity, a straight cable at rest: a rest shape has its own mean.
    fine = solved(model(96), OUT_OF_PLANE).points
    errors = [
        np.linalg.norm(solved(model(n, element), OUT_OF_PLANE).points - fine[:: 96 // n], axis=1)
        for n in (12, 24)
    ]
    assert np.log2(errors[0].max() / errors[1].max()) >= order


@pytest.mark.parametrize("element", ["arc", "quadratic"])
def test_a_turned_world_gives_the_same_shape(element):
    turn = Rotation.from_rotvec([0.7, -1.1, 0.4])
    here = model(10, element)
    there = model(10, element, gravity=tuple(turn.apply(DOWN)))
    frames = [
        tuple((turn * Rotation.from_quat(q)).as_quat())
        for q in (OUT_OF_PLANE.start_orientation, OUT_OF_PLANE.end_orientation)
    ]
    turned = HeldPose(
        OUT_OF_PLANE.start, tuple(turn.apply(OUT_OF_PLANE.end)), None, None, frames[0], frames[1]
    )
    mine, other = solved(here, OUT_OF_PLANE, curved(here)), solved(there, turned, curved(there))
    np.testing.assert_allclose(other.points, turn.apply(mine.points), atol=1e-9)
    np.testing.assert_allclose(other.end_force, turn.apply(mine.end_force), atol=1e-9)
    np.testing.assert_allclose(other.moments, turn.apply(mine.moments), atol=1e-9)
    assert other.energy == pytest.approx(mine.energy, abs=1e-11)


def test_a_planar_load_gives_the_numbers_of_the_plane():
    plane = CableModel(
        CableData(LENGTH, 0.12, 0.006, EI), n=16, element="arc", start="clamped", end="clamped"
    )
    flat = solve_equilibrium(
        plane,
        plane.nominal,
        np.zeros(plane.chain.n_rests),
        HeldPose((0.0, 0.0), (0.5, 0.1), -0.9, 1.2),
    )
    m = model(16, "arc", gravity=(0.0, -9.81, 0.0))
    found = solved(m, pose((0.5, 0.1, 0.0), (0.0, 0.0, -0.9), (0.0, 0.0, 1.2)))
    np.testing.assert_allclose(found.points[:, :2], flat.points, atol=1e-9)
    np.testing.assert_allclose(found.points[:, 2], 0.0, atol=1e-9)
    np.testing.assert_allclose(found.end_force[:2], flat.end_force, atol=1e-9)
    np.testing.assert_allclose(found.moments[:, 2], flat.moments, atol=1e-9)
    assert found.energy == pytest.approx(flat.energy, abs=1e-11)


def test_a_cable_that_may_leave_its_plane_falls_out_of_it():
    """An arch held in a plane is an equilibrium in space, too, but not the lowest."""
    plane = CableModel(
        CableData(LENGTH, 0.12, 0.006, EI), n=16, element="arc", start="clamped", end="clamped"
    )
    none = np.zeros(plane.chain.n_rests)
    flat = solve_equilibrium(
        plane, plane.nominal, none, HeldPose((0.0, 0.0), (0.5, 0.1), 0.4, -0.3)
    )
    m = model(16, "arc", gravity=(0.0, -9.81, 0.0))
    place = pose((0.5, 0.1, 0.0), (0.0, 0.0, 0.4), (0.0, 0.0, -0.3))
    frames = Rotation.from_rotvec(np.outer(flat.phi, [0.0, 0.0, 1.0])).as_quat()
    rest = np.zeros(m.chain.n_rests)
    held = solve_equilibrium(m, m.nominal, rest, place, x_init=same_sign(frames))
    np.testing.assert_allclose(held.points[:, :2], flat.points, atol=1e-9)
    assert held.energy == pytest.approx(flat.energy, abs=1e-11)
    fallen = solved(m, place)
    assert fallen.energy < flat.energy
    assert np.abs(fallen.points[:, 2]).max() > 0.1


def test_a_helix_under_moments_alone():
    """Without forces the moment is constant in space: with EI = GJ the strain in the cable."""
    twist, bend = 3.0, 4.0
    steps = [Rotation.from_rotvec(s * np.array([twist, bend, 0.0])) for s in (0.0, LENGTH)]
    s = np.linspace(0.0, LENGTH, 20001)
    tangents = Rotation.from_rotvec(np.outer(s, [twist, bend, 0.0])).apply([1.0, 0.0, 0.0])
    end = np.trapezoid(tangents, s, axis=0)
    m = model(10, "arc", gravity=(0.0, 0.0, 0.0), torsion=EI)
    place = HeldPose((0.0, 0.0, 0.0), tuple(end), None, None, *(tuple(q.as_quat()) for q in steps))
    found = solved(m, place)
    np.testing.assert_allclose(found.curvature.reshape((2, -1))[0], bend, rtol=1e-6)
    np.testing.assert_allclose(found.energy, EI / 2 * (twist**2 + bend**2) * LENGTH, rtol=1e-7)
    np.testing.assert_allclose(found.end_force, 0.0, atol=1e-7)
    # On the end clamp the cable acts with minus its moment.
    moment = steps[1].apply([EI * twist, EI * bend, 0.0])
    np.testing.assert_allclose(found.moments[1], -moment, atol=1e-6)


def least_second_variation(m, matrix):
    """Lowest eigenvalue under the end conditions, apart from the solver's elimination."""
    whole, size = matrix.dense()[0], 3 * m.chain.n_nodes
    allowed = null_space(whole[size:, :size])
    return np.linalg.eigvalsh(allowed.T @ whole[:size, :size] @ allowed)[0]


def test_the_twist_at_which_a_ring_leaves_its_plane():
    """Michell's ring: 2 pi sqrt(3) EI / GJ.

    The plane of the ring may turn about the tangent at the clamp, each section rolling back, which
    costs nothing.
    """
    m = model(40, gravity=(0.0, 0.0, 0.0))
    s = m.chain.places

    def lowest(twist):
        ring = Rotation.from_rotvec(np.outer(2 * np.pi * s / LENGTH, [0.0, 0.0, 1.0]))
        roll = Rotation.from_rotvec(np.outer(twist * s / LENGTH, [1.0, 0.0, 0.0]))
        x = same_sign((ring * roll).as_quat())
        place = HeldPose((0.0, 0.0, 0.0), (0.0, 0.0, 0.0), None, None, tuple(x[0]), tuple(x[-1]))
        lam = np.zeros((1, m.n_border))
        given = Inputs.of(m.nominal, np.zeros(m.chain.n_rests), place.vector[None])
        # The exact ring is an equilibrium, stable or not: Newton's method stays there.
        shapes = Shapes.declared(x[None], lam)
        for _ in range(6):
            _, force, matrix = Assembly(m, shapes, given).balance()
            step = matrix.factor().solve(type(force)(-force.x, -force.y))
            moved = m.node.moved(shapes.x, step.x[..., 0])
            shapes = Shapes(moved, shapes.lam + step.y[..., 0], shapes.deviation)
        _, force, matrix = Assembly(m, shapes, given).balance()
        assert np.abs(force.x).max() < 1e-9
        return least_second_variation(m, matrix)

    exact = 2 * np.pi * np.sqrt(3.0) * EI / GJ
    assert lowest(0.999 * exact) > 0
    assert lowest(1.001 * exact) < 0


def test_the_twist_at_which_a_straight_cable_between_clamps_buckles():
    """Greenhill's problem, clamped: without axial force M L / EI = 2 x, tan x = x.

    A displacement w = y + i z across satisfies w'''' = i (M / EI) w''', w = w' = 0 at both ends.
    Greenhill 1883; Timoshenko and Gere, Theory of Elastic Stability, 1961, chapter 2.
    """
    m = model(20, gravity=(0.0, 0.0, 0.0))

    def lowest(twist):
        rolls = np.outer(twist * m.chain.places / LENGTH, [1.0, 0.0, 0.0])
        x = same_sign(Rotation.from_rotvec(rolls).as_quat())
        place = HeldPose((0.0, 0.0, 0.0), (LENGTH, 0.0, 0.0), None, None, tuple(x[0]), tuple(x[-1]))
        given = Inputs.of(m.nominal, np.zeros(m.chain.n_rests), place.vector[None])
        free = Shapes.declared(x[None], np.zeros((1, m.n_border)))
        _, force, matrix = Assembly(m, free, given).balance()
        # Of the axial force, which the straight cable leaves open, least squares takes none.
        rows = matrix.dense()[0][: force.x.size]
        lam = np.linalg.lstsq(rows[:, force.x.size :], -force.x.ravel(), rcond=None)[0]
        _, force, matrix = Assembly(m, Shapes.declared(x[None], lam[None]), given).balance()
        assert np.abs(force.x).max() < 1e-12
        return least_second_variation(m, matrix)

    exact = 2 * brentq(lambda x: np.sin(x) - x * np.cos(x), 4.0, 4.6) * EI / GJ
    assert lowest(0.999 * exact) > 0
    assert lowest(1.001 * exact) < 0


def test_a_cantilever_bends_out_of_its_plane_as_within():
    weightless = model(12, gravity=(0.0, 0.0, 0.0), end="free")
    within = model(12, gravity=(0.0, -0.5, 0.0), end="free")
    across = model(12, gravity=(0.0, 0.0, -0.5), end="free")
    held = HeldPose((0.0, 0.0, 0.0), None, start_orientation=(0.0, 0.0, 0.0, 1.0))
    straight, down, aside = (solved(m, held).points[-1] for m in (weightless, within, across))
    np.testing.assert_allclose(straight, [LENGTH, 0.0, 0.0], atol=1e-12)
    np.testing.assert_allclose(down[1], aside[2], atol=1e-12)
    # Small deflection: q L^4 / (8 EI); the second order shortens the lever by a few per mille.
    beam = -0.12 * 0.5 * LENGTH**3 / (8 * EI)
    assert down[1] == pytest.approx(beam, rel=0.05)


def test_turns_twist_the_cable_either_way_alike():
    m = model(16)
    energies = [solved(m, pose((0.7, 0.0, 0.0), turns=turns)).energy for turns in (-1, 0, 1)]
    assert energies[0] == pytest.approx(energies[2], rel=1e-6)
    assert energies[1] < energies[2]


def test_interpolated_frames_have_the_signs_of_their_neighbours():
    """Beyond a clip quaternions may have the other sign: of such neighbours the mean is far off."""
    angles, fine = np.linspace(0, 1, 5), np.linspace(0, 1, 17)
    known = Rotation.from_rotvec(np.outer(angles, [0.5, 1.0, -0.8])).as_quat()
    found = Frame.interpolated(fine, angles, known * np.array([1, 1, -1, -1, 1])[:, None])
    assert ((found[1:] * found[:-1]).sum(axis=1) > 0.9).all()
    turned = Rotation.from_rotvec(np.outer(fine, [0.5, 1.0, -0.8]))
    assert (Rotation.from_quat(found).inv() * turned).magnitude().max() < 1e-12


def test_derivatives_by_increments():
    m = model(4, end="free")
    rng = np.random.default_rng(3)
    x = same_sign(Rotation.from_rotvec(0.4 * rng.normal(size=(5, 3)).cumsum(axis=0)).as_quat())
    given = Inputs.of(m.nominal, curved(m), OUT_OF_PLANE.vector[None])
    shapes = Shapes.declared(x[None], rng.normal(size=(1, m.n_border)))
    _, force, matrix = Assembly(m, shapes, given).balance()
    d = 1e-5

    def moved(node, axis, sign):
        step = np.zeros((1, 5, 3))
        step[0, node, axis] = sign * d
        there = Shapes(m.node.moved(shapes.x, step), shapes.lam, shapes.deviation)
        return Assembly(m, there, given).balance()[0][0]

    for node in range(5):
        for axis in range(3):
            slope = (moved(node, axis, 1) - moved(node, axis, -1)) / (2 * d)
            assert slope == pytest.approx(force.x[0, node, axis, 0], abs=1e-7)
    np.testing.assert_allclose(Assembly(m, shapes, given).imbalance().rows, force.rows, atol=1e-12)
    dense = matrix.dense()[0]
    np.testing.assert_allclose(dense, dense.T, atol=1e-10)


def test_gravity_and_torsion_belong_together():
    with pytest.raises(DloError, match="gravity has 3 numbers"):
        CableModel(CableData(LENGTH, 0.1, 0.005, EI), gravity=DOWN)
    with pytest.raises(DloError, match="'link' is not known in space"):
        _ = model(element="link").chain


def test_an_end_out_of_reach_is_told_with_numbers():
    with pytest.raises(
        EquilibriumError, match=r"is 0\.9000 m from the start, the cable is 0\.8000"
    ):
        solved(model(), pose((0.9, 0.0, 0.0)))


def test_descents_from_far_away_are_minima():
    m = model(10, "arc")
    rng = np.random.default_rng(0)
    x = np.array(
        [
            same_sign(Rotation.from_rotvec(rng.normal(size=(11, 3)).cumsum(axis=0) / 3).as_quat())
            for _ in range(4)
        ]
    )
    given = Inputs.of(
        m.nominal, np.zeros(m.chain.n_rests), np.repeat(OUT_OF_PLANE.vector[None], 4, axis=0)
    )
    found = descend(Assembly(m, Shapes.declared(x, np.zeros((4, m.n_border))), given))
    assert found.converged.any()
    _, force, matrix = Assembly(m, found.shapes, given).balance()
    assert np.abs(force.x[found.converged]).max() < 1e-9
    assert np.all(matrix.negative()[found.converged] == m.n_multipliers)


class _StiffensPerPose(SectionLaw):
    """A law of the bend that depends on a number of each pose."""

    name = "stiffens_per_pose"

    def parameters(self, cable):
        return (Parameter("share", "m^2", scale=0.01),)

    def per_pose(self, cable):
        return ("unknown_force_x",)

    def of_bend(self, square, cable, params):
        return ca.exp((params["share"] + 0.1 * params["unknown_force_x"]) * square)


@pytest.mark.parametrize(
    ("element", "end", "more"),
    [
        ("arc", "free", ()),
        ("quadratic", "clamped", (_StiffensPerPose(),)),
        pytest.param("arc", "clamped", (_StiffensPerPose(),), marks=pytest.mark.long),
        pytest.param("quadratic", "free", (), marks=pytest.mark.long),
    ],
)
def test_a_segment_is_differentiated_as_by_casadi_in_one_go(element, end, more):
    """Loads, a spring to a fixed point, a stretching cable and softening sections at once."""
    effects = [EFFECTS[name]() for name in ("tether", "axial_stretch", "bending_softening")]
    effects += more
    cable = CableData(LENGTH, 0.12, 0.006, EI, torsional_stiffness=GJ)
    m = CableModel(cable, 12, element, "clamped", end, DOWN, (*effects, EFFECTS["point_force"]()))
    node = m.node
    x, lam, p = (
        ca.SX.sym(name, k) for name, k in (("x", 8), ("lam", m.n_border), ("p", len(m.names)))
    )
    rest, deviation, delta = (
        ca.SX.sym("rest", 9),
        ca.SX.sym("d", len(m.deviation_names)),
        ca.SX.sym("i", 6),
    )
    place = m.chain.layout.segments[4]
    nodes = ca.vertcat(node.moved(x[:4], delta[:3]), node.moved(x[4:], delta[3:]))
    value, advance = functions_of(m).segment_by_share(
        nodes, lam, p, rest, place, deviation, lagrangian_of(m).shares(p, place)
    )
    by = ca.vertcat(delta, lam)
    hessian, gradient = ca.hessian(value, by)
    others = ca.vertcat(p, rest, deviation)
    outputs = [value, gradient, hessian, ca.jacobian(gradient, others)]
    outputs += [ca.jacobian(advance, by), ca.jacobian(advance, others)]
    outputs = ca.substitute(outputs, [delta], [ca.SX.zeros(6)])
    plain = ca.Function("plain", [x, lam, p, rest, deviation], outputs)

    rng = np.random.default_rng(0)
    frames = Rotation.from_rotvec([[0.2, 1.0, -0.5], [0.5, 0.7, -0.3]]).as_quat().ravel()
    scales = np.array([q.nominal if q.log else q.scale for q in m.parameters])
    numbers = m.nominal + 0.1 * scales * rng.uniform(0.5, 1.0, len(scales))
    forces, own = rng.normal(size=m.n_border), rng.normal(size=9)
    moved = 0.01 * rng.normal(size=len(m.deviation_names))
    expected = plain(frames, forces, numbers, own, moved)
    arguments = (frames, forces, numbers, own, place, moved)
    slopes = functions_of(m).segment_curve_slopes(*arguments)
    found = [*functions_of(m).segment(*arguments), functions_of(m).segment_sensitivity(*arguments)]
    found += [slopes[1][:3, :], slopes[2][:3, :]]
    for one, other in zip(found, expected, strict=True):
        size = np.abs(np.array(other)).max()
        assert np.array(one) == pytest.approx(np.array(other), rel=1e-11, abs=1e-13 * size)


@pytest.mark.parametrize("element", ["arc", "quadratic"])
def test_a_straight_cable_between_ball_joints_is_stable_though_it_may_spin(element):
    """Its turn about itself costs nothing and moves nothing: the shape is that in a plane."""
    cable = CableData(LENGTH, 0.06, 0.008, EI, torsional_stiffness=GJ)
    model = CableModel(cable, 12, element, gravity=DOWN)
    pose = HeldPose((0.0, 0.0, 0.0), (0.5 * LENGTH, 0.1 * LENGTH, 0.05))
    found = solve_equilibrium(model, model.nominal, np.zeros(model.chain.n_rests), pose)
    planar = CableModel(replace(cable, torsional_stiffness=None), 12, element)
    level = np.hypot(*pose.end[:2])
    alike = solve_equilibrium(
        planar,
        planar.nominal,
        np.zeros(planar.chain.n_rests),
        HeldPose((0.0, 0.0), (level, pose.end[2])),
    )
    # Arcs are the same in both; the bubbles inside elements differ by the fifth order in h.
    close = 1e-10 if element == "arc" else 1e-3
    assert found.stable
    assert found.energy == pytest.approx(alike.energy, rel=close)
    flat = np.stack([found.points[:, :2] @ pose.end[:2] / level, found.points[:, 2]], axis=1)
    np.testing.assert_allclose(flat, alike.points, atol=close * LENGTH)


@pytest.mark.parametrize(
    ("held", "spins"),
    [
        ({}, True),
        ({"start": "clamped", "end": "free"}, False),
        ({"end": "clamped"}, False),
        ({"clips": ("pinned", "eyelet")}, True),
        ({"clips": ("swivel",)}, True),
        ({"clips": ("eyelet", "clamped")}, False),
        ({"effects": (EFFECTS["bending_softening"](),)}, True),
        ({"effects": (EFFECTS["bending_anisotropy"](),)}, False),
    ],
)
def test_what_keeps_a_cable_from_turning_about_itself(held, spins):
    cable = CableData(LENGTH, 0.06, 0.008, EI, torsional_stiffness=GJ)
    assert CableModel(cable, 12, gravity=DOWN, **held).may_spin is spins
    planar = replace(cable, torsional_stiffness=None)
    assert not CableModel(planar, 12).may_spin


def test_normals_are_carried_along_a_curve_without_twist():
    """By the smallest rotation from one tangent to the next; also where the first axis changes."""
    s = np.linspace(0.0, 6.0, 400)
    tangents = np.stack(
        [np.cos(s), np.sin(s) * np.cos(0.7 * s), np.sin(s) * np.sin(0.7 * s)], axis=1
    )
    normals = across(tangents)
    frames = np.concatenate([tangents[:, None], normals], axis=1)
    np.testing.assert_allclose(
        frames @ np.swapaxes(frames, 1, 2), np.eye(3)[None] + 0 * frames, atol=1e-12
    )
    axes = np.cross(tangents[:-1], tangents[1:])
    angles = np.arccos((tangents[:-1] * tangents[1:]).sum(axis=1))
    turns = Rotation.from_rotvec(axes * (angles / np.linalg.norm(axes, axis=1))[:, None])
    np.testing.assert_allclose(turns.apply(normals[:-1, 0]), normals[1:, 0], atol=1e-9)


def test_a_cable_bent_against_its_rest_shape_is_no_minimum():
    """Between ball joints it would turn about itself, to the side to which it is bent at rest."""
    cable = CableData(LENGTH, 1e-6, 0.008, EI, torsional_stiffness=GJ)
    model = CableModel(cable, 12, "arc", gravity=DOWN)
    pose = HeldPose((0.0, 0.0, 0.0), (0.7 * LENGTH, 0.0, 0.0))
    rest = np.zeros(model.chain.n_rests)
    rest[model.chain.n_cells : 2 * model.chain.n_cells] = 2.0
    found = solve_equilibrium(model, model.nominal, rest, pose)
    against = Shapes.declared(found.x[None], found.multipliers[None])
    assert found.stable
    assert list(BatchEquilibrium(model, [pose]).stable(against, model.nominal, rest)) == [True]
    weak = -1e-3 * rest
    shapes, solved = BatchEquilibrium(model, [pose]).solve(against, model.nominal, weak)
    assert solved.all()
    assert list(BatchEquilibrium(model, [pose]).stable(shapes, model.nominal, weak)) == [False]


def rolled_against_its_rest_shape(effects):
    """A model, two of its poses, the first one at a saddle, as a start, and lower equilibria."""
    cable = CableData(LENGTH, 0.06, 0.008, EI, torsional_stiffness=GJ)
    hung = CableModel(cable, 12, gravity=DOWN, effects=effects)
    poses = [HeldPose((0.0, 0.0, 0.0), end) for end in ((0.56, 0.0, 0.0), (0.5, 0.2, 0.1))]
    rest = np.zeros(hung.chain.n_rests)
    rest[hung.chain.n_cells : 2 * hung.chain.n_cells] = 0.5
    lower = [solve_equilibrium(hung, hung.nominal, rest, pose) for pose in poses]
    x, lam = (np.array([getattr(eq, key) for eq in lower]) for key in ("x", "multipliers"))
    rolled = (Rotation.from_quat(x[0]) * Rotation.from_rotvec([np.pi, 0.0, 0.0])).as_quat()
    x[0] = same_sign(rolled)
    batch = BatchEquilibrium(hung, poses)
    return hung, batch, (Shapes.declared(x, lam), hung.nominal, rest), lower


@pytest.mark.parametrize("effects", [(), (EFFECTS["rest_curvature_drift"](),)])
def test_no_pose_of_a_fit_stays_at_a_saddle(effects):
    """Rolled against its rest shape it turns about itself; a state carries that to later poses."""
    hung, batch, start, lower = rolled_against_its_rest_shape(effects)
    rest = start[2]
    saddles, converged = batch.solve(*start)
    assert converged.all()
    assert list(batch.stable(saddles, hung.nominal, rest)) == [False, True]
    found, converged = batch.solve_or_descend(*start)
    assert converged.all()
    assert batch.stable(found, hung.nominal, rest).all()
    there = batch.at(found, hung.nominal, rest).energy()
    np.testing.assert_allclose(there, [eq.energy for eq in lower], rtol=1e-9)


def test_a_saddle_is_left_for_a_shape_that_may_swing():
    """Without weight the lower shape, whose rest curvature fits, swings about the chord freely."""
    cable = CableData(LENGTH, 0.06, 0.008, EI, torsional_stiffness=GJ)
    floating = CableModel(cable, 12, gravity=(0.0, 0.0, 0.0))
    held = [HeldPose((0.0, 0.0, 0.0), end) for end in ((0.5, 0.0, 0.1), (0.4, 0.1, 0.0))]
    rest = np.zeros(floating.chain.n_rests)
    rest[floating.chain.n_cells : 2 * floating.chain.n_cells] = 1.0
    lower = [solve_equilibrium(floating, floating.nominal, rest, pose) for pose in held]
    x, lam = (np.array([getattr(eq, key) for eq in lower]) for key in ("x", "multipliers"))
    about = Rotation.from_rotvec([np.pi, 0.0, 0.0])
    against = np.array([same_sign((Rotation.from_quat(one) * about).as_quat()) for one in x])
    batch = BatchEquilibrium(floating, held)
    start = Shapes.declared(against, lam), floating.nominal, rest
    saddles, converged = batch.solve(*start)
    assert converged.all()
    assert at_saddles(batch.at(saddles, *start[1:]), converged).all()
    found, converged = batch.solve_or_descend(*start)
    assert converged.all()
    there = batch.at(found, floating.nominal, rest)
    assert not at_saddles(there, converged).any()
    np.testing.assert_allclose(there.energy(), [eq.energy for eq in lower], rtol=1e-9)


@pytest.mark.parametrize("effects", [(), (EFFECTS["rest_curvature_drift"](),)])
def test_a_pose_that_cannot_leave_its_saddle_is_lost_alone(effects, monkeypatch):
    """Unless a state hands its shape on to later poses."""
    hung, batch, start, _ = rolled_against_its_rest_shape(effects)
    monkeypatch.setattr("dlo_casadi.equilibrium.batch.DOWNHILL", 1)
    assert list(batch.solve_or_descend(*start)[1]) == [False, not hung.has_state]


def test_a_swing_that_costs_nothing_is_no_saddle():
    """Without weight nothing holds the swing about the chord: the shape is kept, to the digit."""
    cable = CableData(LENGTH, 0.06, 0.008, EI, torsional_stiffness=GJ)
    floating = CableModel(cable, 12, gravity=(0.0, 0.0, 0.0))
    held, rest = HeldPose((0.0, 0.0, 0.0), (0.5, 0.0, 0.1)), np.zeros(floating.chain.n_rests)
    rest[floating.chain.n_cells : 2 * floating.chain.n_cells] = 1.0
    found = solve_equilibrium(floating, floating.nominal, rest, held)
    batch = BatchEquilibrium(floating, [held])
    start = Shapes.declared(found.x[None], found.multipliers[None]), floating.nominal, rest
    assert not batch.stable(*start).any()  # neutral
    kept, converged = batch.solve_or_descend(*start)
    assert converged.all()
    np.testing.assert_allclose(kept.x, start[0].x, atol=1e-7)


def test_a_planar_cable_leaves_the_second_mode_of_buckling():
    """Between two pins a straight weightless rod is at a saddle as an S, at a minimum as a C."""
    rod = CableModel(CableData(LENGTH, 0.06, 0.008, EI), 24, gravity=(0.0, 0.0))
    held, rest = HeldPose((0.0, 0.0), (0.7, 0.0)), np.zeros(rod.chain.n_rests)
    headings = 0.75 * np.cos(4 * np.pi * rod.chain.places / LENGTH / 2)
    found = solve_equilibrium(rod, rod.nominal, rest, held)
    batch = BatchEquilibrium(rod, [held])
    for side in (1, -1):
        start = batch.start_shapes(side * headings[None, :, None])
        force = -EI * (2 * np.pi / LENGTH) ** 2  # Euler's load of the second mode
        start = replace(start, lam=np.array([[force, 0.0]])), rod.nominal, rest
        saddle, converged = batch.solve(*start)
        assert converged.all()
        assert not batch.stable(saddle, rod.nominal, rest).any()
        lower, converged = batch.solve_or_descend(*start)
        assert converged.all()
        energy = batch.at(lower, rod.nominal, rest).energy()
        assert energy == pytest.approx([found.energy], rel=1e-6)


@pytest.mark.parametrize("effects", [(), (EFFECTS["rest_curvature_drift"](),)])
def test_a_lost_pose_is_minimised_also_if_the_cable_takes_a_set(effects):
    """With the rest curvature before each pose given, poses do not depend on each other."""
    flat = replace(model(10), n_rest=0, effects=effects)
    rest, held = np.zeros((1, flat.chain.n_rests)), pose((0.5, 0.0, 0.0))
    found = solve_equilibrium(flat, flat.nominal, rest[0], held)
    turned = np.zeros((1, len(flat.deviation_names)))
    turned[0, flat.deviation_names.index("end_rotation_y")] = -2.0
    batch = BatchEquilibrium(flat, [held])
    start = Shapes(found.x[None], found.multipliers[None], turned), flat.nominal, rest
    assert not batch.solve(*start)[1].any()
    assert batch.solve_or_descend(*start)[1].all()


def test_a_cable_twisted_by_a_quarter_turn_per_element_is_stable_among_many_poses():
    """Five turns on 20 elements: only joints in a plane have a bound."""
    taut, wound = model(torsion=0.2 * GJ), pose((0.999 * LENGTH, 0.0, 0.0), turns=5.0)
    rest = np.zeros(taut.chain.n_rests)
    found = solve_equilibrium(taut, taut.nominal, rest, wound)
    assert found.stable
    assert BatchEquilibrium(taut, [wound]).stable(found.shapes, taut.nominal, rest).all()
