"""Clips and eyelets between the ends, against closed forms, differences of the energy and IPOPT."""

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from perturbed import assert_derivatives
from scipy.optimize import brentq
from scipy.spatial.transform import Rotation
from scipy.special import ellipe, ellipk

from dlo_casadi.config import load_config
from dlo_casadi.config.supports import Clip
from dlo_casadi.effects import (
    AxialStretch,
    CableData,
    ClipAngle,
    ClipOffset,
    ClipSlip,
    LengthError,
    LumpedMass,
    RestCurvatureDrift,
)
from dlo_casadi.equilibrium.batch import BatchEquilibrium
from dlo_casadi.equilibrium.by_ipopt import by_ipopt
from dlo_casadi.equilibrium.curve import NodeCurve
from dlo_casadi.equilibrium.equilibrium import curvatures_along
from dlo_casadi.equilibrium.eyelets import slid
from dlo_casadi.equilibrium.guess_table import guess_table
from dlo_casadi.equilibrium.limits import places_of, sizes_of
from dlo_casadi.equilibrium.pose import HeldPose
from dlo_casadi.equilibrium.solve import solve_equilibrium
from dlo_casadi.equilibrium.spans import first_guesses
from dlo_casadi.equilibrium.spread import SolvedCable, tolerances_of
from dlo_casadi.errors import ConfigError, EquilibriumError
from dlo_casadi.model.assembly import Assembly, Inputs
from dlo_casadi.model.cable_model import CableModel
from dlo_casadi.model.clipped import Clipped
from dlo_casadi.model.clips import HeldClip
from dlo_casadi.model.lagrangian import lagrangian_of
from dlo_casadi.model.whole_pose import potential
from dlo_casadi.rod.chain import Chain
from dlo_casadi.rod.node import Frame
from dlo_casadi.rod.obstacles import Plane
from dlo_casadi.rod.supports import SupportKind

EYELET = SupportKind.EYELET

LENGTH, EI = 1.0, 0.02  # m, N m^2
CABLE = CableData(LENGTH, mass=0.2, diameter=0.01, bending_stiffness=EI)
LOOM = replace(CABLE, torsional_stiffness=0.015)


def solved(clips, to=(0.8, 0.1), n=40, cable=CABLE, **held):
    directions = {k: held.pop(k) for k in list(held) if "heading" in k or "orientation" in k}
    kinds = tuple(clip.kind for clip in clips)
    model = CableModel(cable, n=n, n_rest=0, clips=kinds, **held)
    start = (0.0,) * len(model.gravity)
    pose = HeldPose(start, to, clips=tuple(clips), **directions)
    return model, pose, solve_equilibrium(model, model.nominal, np.zeros(model.chain.n_rests), pose)


def clipped_at(at, n=10, frames=None, x=None):
    """Saddles at arc lengths `at` [m] of a cable of n elements."""
    model = CableModel(CABLE, n, n_rest=0, clips=("clamped",) * len(at))
    frames = np.zeros((1, len(at), 1)) if frames is None else frames
    x = np.zeros((1, n + 1, 1)) if x is None else x
    held = np.array([[0.0, *at, LENGTH]])
    return Clipped.of(model, frames, held, held, np.zeros((len(at), 1, 1)), x)


def test_a_beam_on_three_supports():
    """Clapeyron: M0 + 4 M1 + M2 = -w l^2 / 2 of equal spans l, with M2 = -w o^2 / 2."""
    span, over, stiff = 0.45, 0.1, replace(CABLE, bending_stiffness=200.0)
    supports = [HeldClip("eyelet", (span, 0.0)), HeldClip("eyelet", (2 * span, 0.0))]
    _, _, eq = solved(supports, None, cable=stiff, end="free")
    w = 9.81 * CABLE.mass / LENGTH
    middle = 1.25 * w * span - 0.75 * w * over**2 / span
    assert eq.stable
    assert eq.clips[0].force == pytest.approx([0.0, -middle], rel=2e-4, abs=1e-5)
    assert [load.at for load in eq.clips] == pytest.approx([span, 2 * span], abs=1e-5)


def test_the_sharpest_bend_over_a_support_is_measured_there():
    """M1 = w (l^2 - o^2) / 8; the curvature has a kink there. To the second order of the mesh."""
    span, over, stiff = 0.45, 0.1, replace(CABLE, bending_stiffness=200.0)
    radius = 8 * 200.0 * LENGTH / (9.81 * CABLE.mass * (span**2 - over**2))
    supports = [HeldClip("eyelet", (span, 0.0)), HeldClip("eyelet", (2 * span, 0.0))]
    errors = []
    for n in (20, 40):
        model, pose, eq = solved(supports, None, n, cable=stiff, end="free")
        held = SolvedCable(model, model.nominal, np.zeros(n), pose, eq)
        sizes = sizes_of(held.assembly, "curvature")[0]
        places, _ = places_of(held, "curvature")
        assert places[sizes.argmax()] == pytest.approx(eq.clips[0].at, abs=1e-12)
        assert 1 / sizes.max() == pytest.approx(eq.min_bend_radius, rel=1e-12)
        errors.append(abs(eq.min_bend_radius / radius - 1))
    assert errors[0] < 0.04
    assert errors[1] < errors[0] / 3.5


@pytest.mark.parametrize("at", [0.45, 0.46])
def test_the_bend_at_a_clip_is_smooth_in_its_arc_length(at):
    """Where its node has its even place, and where it is moved."""

    def bend(s):
        model, pose, eq = solved([HeldClip("pinned", (0.4, 0.0), s)], (0.75, 0.0), 20)
        held = SolvedCable(model, model.nominal, np.zeros(20), pose, eq)
        assert places_of(held, "curvature")[0][21] == s
        return sizes_of(held.assembly, "curvature")[0, 21]

    step = 1e-5
    before, here, after = (bend(at + k * step) for k in (-1, 0, 1))
    assert (after - here) / (here - before) == pytest.approx(1.0, abs=0.01)


def test_an_elastica_pinned_at_mid_span_converges_to_two_half_waves():
    """Each half is pinned at both ends: F = EI (2 K / l)^2 with the chord l (2 E / K - 1)."""
    half, chord = LENGTH / 2, 0.4
    m = brentq(lambda m: 2 * ellipe(m) / ellipk(m) - 1 - chord / half, 1e-6, 0.9)
    force = EI * (2 * ellipk(m) / half) ** 2
    errors = []
    for n in (20, 40):
        clip = HeldClip("pinned", (chord, 0.0), 0.5)
        _, _, eq = solved([clip], (2 * chord, 0.0), n, gravity=(0.0, 0.0))
        assert np.abs(eq.clips[0].force).max() < 1e-9
        errors.append(abs(np.linalg.norm(eq.end_force) / force - 1))
    assert errors[1] < 1e-4
    assert np.log2(errors[0] / errors[1]) > 1.9


def test_equal_tension_on_both_sides_of_an_eyelet():
    """T + EI k^2 / 2 - w y is the same all along a heavy elastica, and through an eyelet, too."""
    drops = []
    for n in (20, 40):
        _, _, eq = solved([HeldClip("eyelet", (0.42, 0.12))], (0.7, 0.25), n)
        first, last = (np.array([np.cos(phi), np.sin(phi)]) for phi in eq.phi[[0, -1]])
        drops.append(-eq.end_force @ last - eq.start_force @ first)  # T at the end minus the start
    assert eq.stable
    error = np.abs(np.array(drops) - 0.2 * 9.81 * 0.25)
    assert error[1] < 2e-3
    assert np.log2(error[0] / error[1]) > 1.8


def test_a_rod_clamped_in_three_places_is_two_rods():
    middle, end = (0.4, 0.1), (0.75, -0.05)
    clip = HeldClip("clamped", middle, 0.5, heading=0.3)
    clamps = {"start": "clamped", "end": "clamped"}
    _, _, whole = solved([clip], end, 20, start_heading=0.5, end_heading=-0.4, **clamps)
    half = replace(CABLE, length=0.5, mass=0.1)
    _, _, first = solved([], middle, 10, half, start_heading=0.5, end_heading=0.3, **clamps)
    rest = tuple(np.subtract(end, middle))
    _, _, last = solved([], rest, 10, half, start_heading=0.3, end_heading=-0.4, **clamps)
    raised = -9.81 * 0.1 * -middle[1]  # the second rod starts at the clip
    assert whole.energy == pytest.approx(first.energy + last.energy + raised, rel=1e-9)
    (load,) = whole.clips
    assert load.force == pytest.approx(first.end_force + last.start_force, rel=1e-9)
    moment = np.ravel(first.moments)[1] + np.ravel(last.moments)[0]
    # The curvature at both ends and on both sides of the clip is that at the ends of the two rods.
    clipped = Clipped.none(Chain(0.5, 10), 1)
    bends = [curvatures_along(one.curvature[None, None], clipped)[0, -2:] for one in (first, last)]
    between = clipped_at((0.5,), 20, np.array([[clip.frame]]), whole.x[None])
    found = curvatures_along(whole.curvature[None, None], between)[0, -4:]
    np.testing.assert_allclose(found, np.concatenate(bends), rtol=1e-6)
    assert len(set(np.round(found, 3))) == 4
    assert np.shape(load.moment) == ()
    assert load.moment == pytest.approx(moment, rel=1e-9)


def turned(*vector):
    return tuple(Rotation.from_rotvec(vector).as_quat())


IN_SPACE = (
    HeldClip("swivel", (0.3, 0.1, -0.05), 0.36, orientation=turned(0.2, 0.1, 0.4)),
    HeldClip("eyelet", (0.6, 0.1, 0.05)),
)


def test_loads_on_clips_are_minus_the_derivatives_of_the_energy():
    space = {
        "gravity": (0.0, 0.0, -9.81),
        "start": "clamped",
        "end": "clamped",
        "start_orientation": turned(0, 0.2, 0.1),
        "end_orientation": turned(0.3, -0.2, 0.1),
    }
    model, pose, eq = solved(IN_SPACE, (0.7, 0.2, 0.1), 20, LOOM, **space)
    rest, step = np.zeros(model.chain.n_rests), 1e-5
    assert eq.stable
    assert eq.residual < 1e-12

    def slope(k, changed):
        energies = []
        for h in (step, -step):
            clips = [*IN_SPACE[:k], changed(IN_SPACE[k], h), *IN_SPACE[k + 1 :]]
            there = replace(pose, clips=tuple(clips))
            energies.append(
                solve_equilibrium(model, model.nominal, rest, there, x_init=eq.x).energy
            )
        return (energies[0] - energies[1]) / (2 * step)

    for k in (0, 1):
        for axis in np.eye(3):
            moved = slope(k, lambda c, h, axis=axis: replace(c, place=tuple(c.place + h * axis)))
            assert axis @ eq.clips[k].force == pytest.approx(-moved, abs=2e-6)

    def twisted(clip, h, axis):
        turn = Rotation.from_rotvec(h * axis) * Rotation.from_quat(clip.orientation)
        return replace(clip, orientation=tuple(turn.as_quat()))

    for axis in np.eye(3):
        by_turn = slope(0, lambda c, h, axis=axis: twisted(c, h, axis))
        assert axis @ eq.clips[0].moment == pytest.approx(-by_turn, abs=2e-6)
    along = Rotation.from_quat(IN_SPACE[0].orientation).apply([1.0, 0.0, 0.0])
    assert eq.clips[0].moment @ along == pytest.approx(0.0, abs=1e-9)  # a swivel holds no twist


@pytest.mark.parametrize("second", ["pinned", "eyelet"])
def test_ipopt_finds_the_same_minimum(second):
    clips = (
        HeldClip("clamped", (0.31, 0.05), 0.36, heading=0.3),
        HeldClip(second, (0.57, -0.02), 0.7 if second == "pinned" else None),
    )
    model, pose, eq = solved(clips, (0.75, 0.1), 20)
    rest = np.zeros(model.chain.n_rests)
    found = [
        by_ipopt(model, model.nominal, rest, pose, x[:, 0])
        for x, _ in first_guesses(model, model.nominal, rest, pose)
    ]
    energies = [own.energy for own in found if own is not None and own.stable]
    assert eq.stable
    assert eq.energy == pytest.approx(min(energies), rel=1e-9)


def test_ipopt_gives_up_where_a_guess_is_at_an_eyelet_beyond_the_next_clip():
    clips = (HeldClip("eyelet", (0.6, 0.0)), HeldClip("pinned", (0.3, 0.0), 0.4))
    model = CableModel(CABLE, 20, n_rest=0, clips=tuple(clip.kind for clip in clips))
    pose = HeldPose((0.0, 0.0), (0.8, 0.0), clips=clips)
    straight, rest = np.zeros(model.chain.n_nodes), np.zeros(model.chain.n_rests)
    assert by_ipopt(model, model.nominal, rest, pose, straight) is None


def test_ipopts_statement_in_space_has_the_same_energy_and_conditions():
    """Through a swivel, whose frame rolls with the cable, and an eyelet."""
    model, pose, eq = solved(
        IN_SPACE, (0.7, 0.2, 0.1), 20, LOOM, gravity=(0.0, 0.0, -9.81), start="clamped",
        start_orientation=turned(0, 0.2, 0.1),
    )  # fmt: skip
    given = Inputs.of(model.nominal, np.zeros(model.chain.n_rests), pose.vector[None])
    nodes = Assembly(model, eq.shapes, given).clipped.nodes[0]
    problem = potential(model)
    held, lam = model.are_multipliers, ca.DM(eq.multipliers)
    total = problem.energy + ca.dot(lam[np.flatnonzero(held).tolist()], problem.conditions)
    inner = problem.coordinates[eq.x.size + (~held).sum() :]
    outputs = [total, ca.gradient(total, inner), ca.hessian(total, inner)[0]]
    stated = ca.Function("stated", [problem.coordinates, problem.parameters], outputs)
    x = np.concatenate([eq.x.ravel(), eq.multipliers[~held], np.zeros(inner.numel())])
    rest, still = np.zeros(model.chain.n_rests), np.zeros(len(model.deviation_names))
    moved = np.ravel(np.arange(model.chain.n_nodes) == nodes[:, None], order="F")
    given = np.concatenate([model.nominal, rest, pose.vector, still, moved])
    value, slope, bend = (np.array(block) for block in stated(x, given))
    least = value - slope.T @ np.linalg.solve(bend, slope) / 2
    assert least.item() == pytest.approx(eq.energy, rel=1e-9)


def test_the_tangent_is_the_derivative_of_the_balance():
    model, pose, eq = solved(
        IN_SPACE, (0.7, 0.2, 0.1), 10, LOOM, gravity=(0.0, 0.0, -9.81), start="clamped",
        start_orientation=turned(0, 0.2, 0.1),
    )  # fmt: skip
    given = Inputs.of(model.nominal, np.zeros(model.chain.n_rests), pose.vector[None])
    dense = Assembly(model, eq.shapes, given).balance()[2].dense()[0]
    b, step = model.node.increment, 1e-6
    for column in (3, 3 * 4, 3 * 5 + 1, b * model.chain.n_nodes + 1, len(dense) - 1):
        rows = []
        for h in (step, -step):
            delta = np.zeros(len(dense))
            delta[column] = h
            nodes = delta[: b * model.chain.n_nodes].reshape((*eq.x[None].shape[:2], b))
            x = model.node.moved(eq.x[None], nodes)
            lam = eq.multipliers[None] + delta[b * model.chain.n_nodes :]
            moved = replace(eq.shapes, x=x, lam=lam)
            rows.append(Assembly(model, moved, given).imbalance().rows[0, :, 0])
        assert dense[:, column] == pytest.approx((rows[0] - rows[1]) / (2 * step), abs=1e-5)


def test_two_eyelets_with_one_element_between_them_act_on_each_other():
    """The element gets longer by one and shorter by the other: exact to second order."""
    rings = [HeldClip("eyelet", (0.42, 0.12)), HeldClip("eyelet", (0.5, 0.11))]
    model, pose, eq = solved(rings, (0.7, 0.25), 10)
    given = Inputs.of(model.nominal, np.zeros(10), pose.vector[None])
    here = Assembly(model, eq.shapes, given)
    assert np.diff(here.clipped.nodes[0]).tolist() == [1]
    dense, step = here.balance()[2].dense()[0], 1e-6
    for row in model.sliding.values():
        sides = []
        for h in (step, -step):
            lam = eq.multipliers[None].copy()
            lam[0, row] += h
            moved = replace(eq.shapes, lam=lam)
            sides.append(Assembly(model, moved, given).imbalance().rows[0, :, 0])
        column = dense[:, model.chain.n_nodes + row]
        assert column == pytest.approx((sides[0] - sides[1]) / (2 * step), abs=1e-6)


def test_nodes_follow_an_eyelet_and_do_not_turn_back():
    """Beyond two thirds of an element another node is moved; the cable stays where it is."""
    model, pose, eq = solved([HeldClip("eyelet", (0.42, 0.12))], (0.7, 0.25), 40)
    given, row = Inputs.of(model.nominal, np.zeros(40), pose.vector[None]), model.sliding[1]
    here = Assembly(model, eq.shapes, given)
    node, h = int(here.clipped.nodes[0, 0]), model.chain.h

    def at(s, before):
        lam = before.shapes.lam.copy()
        lam[0, row] = s * h
        return replace(before, shapes=slid(before, replace(before.shapes, lam=lam)))

    near = at(node + 0.6, at(node, here))
    far = at(node + 0.8, near)
    back = at(node + 0.4, far)
    chosen = [one.clipped.nodes[0, 0] for one in (near, far, back)]
    assert chosen == [node, node + 1, node + 1]
    assert at(node + 0.2, back).clipped.nodes[0, 0] == node
    at_end = at(50.0, here).clipped
    assert at_end.nodes[0, 0] == 39
    assert at_end.in_order.all()
    places = near.clipped.places[0], far.clipped.places[0]
    x = np.interp(places[1], places[0], near.shapes.x[0, :, 0])
    np.testing.assert_allclose(far.shapes.x[0, :, 0], x, atol=1e-12)


@pytest.mark.parametrize(
    ("clips", "said"),
    [
        ([HeldClip("pinned", (0.5, 0.3), 0.4, name="first")], "first are 0.5831 m apart"),
        ([HeldClip("eyelet", (0.5, 0.6))], "the start and the end are 1.3.* 1.0000 m of cable"),
        (
            [
                HeldClip("clamped", (0.3, 0.1), 0.4, heading=0.0),
                HeldClip("clamped", (0.31, 0.1), 0.411, heading=0.0),
            ],
            "nearer to each other than an element",
        ),
        ([HeldClip("eyelet", (0.0, 0.0), name="ring")], "the start and ring are at the same place"),
        (
            [HeldClip("pinned", (0.4, 0.1), 0.6, name="pin"), HeldClip("eyelet", (0.4, 0.1))],
            "pin and clip are at the same place",
        ),
    ],
)
def test_clips_that_leave_no_room(clips, said):
    with pytest.raises(EquilibriumError, match=said):
        solved(clips)


def test_saddles_with_no_node_between_them():
    """The coarse mesh has none: its 18 elements are longer than the 40 mm between them."""
    forward = Frame.identity
    saddles = [
        HeldClip("clamped", (x, 0.0, 0.0), s, orientation=forward)
        for x, s in ((0.405, 0.455), (0.4445, 0.495))
    ]
    held = {"gravity": (0.0, 0.0, -9.81), "start": "clamped", "end": "clamped"}
    held |= {"start_orientation": forward, "end_orientation": forward}
    _, _, eq = solved(saddles, (0.9, 0.0, 0.0), 60, LOOM, **held)
    assert eq.stable
    assert [load.at for load in eq.clips] == [0.455, 0.495]


def test_sides_of_a_harness_with_many_spans():
    """Two sides of each of 32 spans are 2^32 combinations, which are too many to list."""
    assert len(guess_table(32, in_space=False, slides=False)) == 2 + 32


def test_turns_of_the_end_are_those_beyond_the_last_saddle():
    """Four rolled saddles twist the cable by 1.7 turns, which the end's turns do not count."""

    def rolled(k):
        return tuple(Rotation.from_rotvec([k * np.radians(150), 0.0, 0.0]).as_quat())

    apart = 0.2 * LENGTH
    saddles = [
        HeldClip("clamped", (0.999 * apart * k, 0.0, 0.0), apart * k, orientation=rolled(k))
        for k in range(1, 5)
    ]
    model = CableModel(
        replace(LOOM, mass=0.02), 20, "quadratic", "clamped", "clamped", (0.0, 0.0, -9.81)
    )
    model = replace(model, n_rest=0, clips=("clamped",) * 4)
    held = {"start_orientation": rolled(0), "end_orientation": rolled(4), "turns": 1.0}
    pose = HeldPose((0.0, 0.0, 0.0), (0.999 * LENGTH, 0.0, 0.0), clips=tuple(saddles), **held)
    eq = solve_equilibrium(model, model.nominal, np.zeros(model.chain.n_rests), pose)
    turns = eq.twist.reshape(5, 4).mean(axis=1) * apart / (2 * np.pi)
    assert turns == pytest.approx([5 / 12] * 4 + [1.0], abs=5e-3)


@pytest.mark.parametrize("turns", [0.0, 1.0])
def test_fewer_turns_are_advised_where_there_are_turns(turns):
    """One element between two saddles takes up no slack."""
    forward = Frame.identity
    saddles = [
        HeldClip("clamped", (x, 0.0, 0.0), s, orientation=forward)
        for x, s in ((0.4, 0.45), (0.4498, 0.5))
    ]
    model = CableModel(
        LOOM, 20, "quadratic", "clamped", "clamped", (0.0, 0.0, -9.81), clips=("clamped",) * 2
    )
    frames = {"start_orientation": forward, "end_orientation": forward}
    pose = HeldPose((0.0, 0.0, 0.0), (0.9, 0.0, 0.0), clips=tuple(saddles), turns=turns, **frames)
    with pytest.raises(EquilibriumError, match="no equilibrium found") as caught:
        solve_equilibrium(model, model.nominal, np.zeros(model.chain.n_rests), pose)
    assert ("turns" in str(caught.value)) == bool(turns)


def test_a_clearance_beside_a_saddle_between_even_places():
    """The saddle moves a node by half an element, where the cable has another direction."""
    at, heights = 0.524, []
    for n in (20, 80):
        floor = Plane((0.0, -1.0), (0.0, 1.0))
        held = {"start": "clamped", "end": "clamped", "obstacles": (floor,)}
        held |= {"start_heading": 0.0, "end_heading": 0.0}
        saddle = HeldClip("clamped", (0.4, -0.15), at, heading=-0.8)
        model, pose, eq = solved([saddle], (0.7, 0.0), n, **held)
        given = Inputs.of(model.nominal, np.zeros((1, model.chain.n_rests)), pose.vector[None])
        held = SolvedCable(model, given.p[0], given.rest[0], pose, eq)
        heights.append((places_of(held, "clearance")[0], sizes_of(held.assembly, "clearance")[0]))
    (s, coarse), fine = heights
    np.testing.assert_allclose(coarse, np.interp(s, *fine), atol=2.5e-4)


def test_places_and_directions_on_a_curve_through_moved_nodes_are_exact_for_cubics():
    """Through nodes that saddles have moved either way, and not at all; and as they move on."""
    clipped, rng = clipped_at((0.17, 0.5, 0.74)), np.random.default_rng(0)
    assert clipped.places[0, [2, 5, 7]].tolist() == [0.17, 0.5, 0.74]
    curve = [np.polynomial.Polynomial(cubic) for cubic in rng.normal(size=(2, 4))]

    def rows(s):
        return np.stack([*(one(s) for one in curve), *(one.deriv()(s) for one in curve)], axis=1)

    knots, s = clipped.places[0], np.linspace(0.0, LENGTH, 33)
    found = NodeCurve.of(LENGTH, rows(knots), knots)
    np.testing.assert_allclose(np.hstack(found.frame(s, 1)), rows(s), atol=1e-13)
    # Knots that move along the same cubic change nothing.
    bends = np.stack([one.deriv(2)(knots) for one in curve], axis=1)
    along = np.hstack([rows(knots)[:, 2:], bends])
    rate = rng.normal(size=(len(knots), 1))
    still = found.moved(s, along[..., None] * rate[..., None], rate, marked=True)
    np.testing.assert_allclose(still, 0.0, atol=1e-11)


def test_points_beside_a_saddle_between_even_places():
    """The curvature jumps there; points between nodes converge with the fourth order, as others."""
    at, places = HeldClip("clamped", (0.42, -0.12), 0.524, heading=-0.3), []
    for n in (20, 40, 160):
        held = {"start": "clamped", "end": "clamped", "start_heading": 0.3, "end_heading": 0.2}
        model, pose, eq = solved([at], (0.8, 0.0), n, **held)
        shape = SolvedCable(model, model.nominal, np.zeros(n), pose, eq)
        places.append(shape.curve.at(np.linspace(0.0, LENGTH, 401)))
    errors = [np.abs(one - places[-1]).max() for one in places[:2]]
    assert errors[0] < 1e-4
    assert errors[1] < errors[0] / 12


def test_rest_curvature_between_moved_nodes_is_exact_for_parabolas():
    """kappa_0 = a + b s + c s^2: mean, slope and bend times the width, of the moved cells."""
    model, (a, b, c) = CableModel(CABLE, 10, n_rest=0, clips=("pinned",) * 2), (1.0, -4.0, 9.0)
    clipped = clipped_at((0.17, 0.74))

    def inside(cells):
        middle, width = cells.mean(axis=1), np.diff(cells, axis=1)[:, 0]
        mean = a + b * middle + c * (middle**2 + width**2 / 12)
        return np.stack([mean, (b + 2 * c * middle) * width, c * width**2], axis=1)

    terms = lagrangian_of(model)
    segment = terms.segment(ca.SX(1), terms.inner, ca.SX(0))
    rest = ca.Function("rest", [terms.rest_strains, terms.place], [segment.rest])
    even = model.chain.rest_inside(inside(model.chain.cells)[:, :1])
    found = rest(even.T if even.ndim == 2 else even[..., 0].T, clipped.segments()[0].T)
    np.testing.assert_allclose(np.array(found).T, inside(clipped.cells[0]), atol=1e-13)


@pytest.mark.parametrize(
    ("at", "ordered"),
    [((0.3, 0.6), True), ((0.6, 0.3), False), ((0.0, 0.5), False), ((0.5, 1.0), False)],
)
def test_clips_are_in_order_within_the_cable(at, ordered):
    assert clipped_at(at).in_order.tolist() == [ordered]


def test_a_pose_with_other_clips_than_the_model():
    model, pose, _ = solved([HeldClip("pinned", (0.4, 0.15), 0.47)])
    with pytest.raises(EquilibriumError, match="the pose has the clips none, the model pinned"):
        solve_equilibrium(model, model.nominal, np.zeros(40), replace(pose, clips=()))


@pytest.mark.parametrize("kind", ["pinned", "clamped"])
def test_effects_of_clips_and_their_derivatives(kind):
    """A moved clip is a clip elsewhere; the first derivatives are those of the moved equilibria."""
    heading = 0.3 if kind == "clamped" else None
    clips = (HeldClip(kind, (0.31, 0.05), 0.37, heading=heading), HeldClip("eyelet", (0.57, -0.02)))
    kinds = tuple(clip.kind for clip in clips)
    effects = (ClipOffset(clip=0), ClipOffset(clip=1), ClipSlip())
    model = CableModel(CABLE, n=20, n_rest=0, clips=kinds, effects=effects)
    assert model.names[2:4] == ("clip_offset.dy", "clip_offset_2.dx")
    pose, rest = HeldPose((0.0, 0.0), (0.75, 0.1), clips=clips), np.zeros(20)
    p = model.nominal + np.array([0.0, 0.003, -0.002, 0.004, 0.001, 0.002])
    eq = solve_equilibrium(model, p, rest, pose)
    moved = (
        replace(clips[0], place=(0.313, 0.048), at=0.372),
        replace(clips[1], place=(0.574, -0.019)),
    )
    declared = replace(model, effects=())
    elsewhere = replace(pose, clips=moved)
    same = solve_equilibrium(declared, model.nominal[:1], rest, elsewhere)
    assert eq.energy == pytest.approx(same.energy, rel=1e-12)
    assert_derivatives(model, pose, p, rest, range(1, 6))


@pytest.mark.parametrize("kind", ["plane", "clamped", "swivel"])
def test_a_turned_saddle_and_its_derivatives(kind):
    """It is a saddle declared so; the first derivatives are those of the turned equilibria."""
    if kind == "plane":
        clip, errors = HeldClip("clamped", (0.31, 0.05), 0.37, heading=0.3), np.array([0.05])
        held = {"cable": CABLE, "n": 20}
        pose = HeldPose((0.0, 0.0), (0.75, 0.1), clips=(clip,))
        moved = replace(clip, heading=0.35)
    else:
        clip, errors = replace(IN_SPACE[0], kind=kind), np.array([0.04, -0.03])
        held = {"cable": LOOM, "n": 16, "gravity": (0.0, 0.0, -9.81), "start": "clamped"}
        pose = HeldPose(
            (0.0, 0.0, 0.0), (0.7, 0.2, 0.1), clips=(clip,), start_orientation=turned(0, 0.2, 0.1)
        )
        own = Frame.moved(np.array(clip.orientation), np.array([0.0, *errors]))
        moved = replace(clip, orientation=tuple(own))
    model = CableModel(n_rest=0, clips=(clip.kind,), effects=(ClipAngle(),), **held)
    size, rest = len(model.names), np.zeros(model.chain.n_rests)
    first = size - len(errors)
    p = model.nominal + np.array([*np.zeros(first), *errors])
    eq = solve_equilibrium(model, p, rest, pose)
    declared, there = replace(model, effects=()), replace(pose, clips=(moved,))
    same = solve_equilibrium(declared, declared.nominal, rest, there)
    assert eq.energy == pytest.approx(same.energy, rel=1e-9)
    assert eq.clips[0].moment == pytest.approx(same.clips[0].moment, rel=1e-6, abs=1e-9)
    assert_derivatives(model, pose, p, rest, range(first, size))


@pytest.mark.parametrize("space", [False, True])
@pytest.mark.parametrize("kind", ["pinned", "clamped"])
def test_derivatives_by_arc_lengths_beside_all_else(kind, space):
    """A rest curvature, a stretch, a weight between clips, a table, a free end: all are felt."""
    floor = Plane((0.0, 0.0, -0.12)[-2 - space :], (0.0, 0.0, 1.0)[-2 - space :])
    clips = (IN_SPACE[0], HeldClip("pinned", (0.45, 0.12, 0.02), 0.54))
    if not space:
        clips = (HeldClip("clamped", (0.31, 0.05), 0.365, heading=0.3), *clips[1:])
        clips = (clips[0], replace(clips[1], place=(0.45, 0.02)))
    if kind == "pinned":
        clips = tuple(
            replace(clip, kind="pinned", orientation=None, heading=None) for clip in clips
        )
    cable = LOOM if space else CABLE
    gravity = (0.0, 0.0, -9.81) if space else (0.0, -9.81)
    effects = (AxialStretch(), LumpedMass(), ClipSlip(clip=0), ClipSlip(clip=1, label="other"))
    kinds = tuple(clip.kind for clip in clips)
    held = {"end": "free", "gravity": gravity, "obstacles": (floor,), "effects": effects}
    model = CableModel(cable, n=16, n_rest=4, clips=kinds, **held)
    p = model.nominal.copy()
    first = model.names.index("axial_stretch.compliance")
    p[first:] = [1e-3, 0.02, 0.41, 0.002, -0.003]
    pose = HeldPose((0.0,) * (2 + space), clips=clips)
    rest = model.rest_basis @ (0.3 * np.cos(np.arange(model.n_coefficients)))
    assert solve_equilibrium(model, p, rest, pose).contacts
    assert_derivatives(model, pose, p, rest, range(first + 3, first + 5))


SADDLE = HeldClip("clamped", (0.31, 0.05), 0.365, heading=0.3)  # 0.3 elements before a node
BENT = np.array([1.0, -2.0, 3.0, -2.0, 1.0])  # 1/m


def test_a_drift_of_zero_leaves_the_rest_curvature_at_a_saddle_between_nodes():
    model = CableModel(CABLE, 20, n_rest=5, clips=("clamped",), effects=(RestCurvatureDrift(),))
    pose, rest = HeldPose((0.0, 0.0), (0.75, 0.1), clips=(SADDLE,)), model.rest_basis @ BENT
    eq = solve_equilibrium(model, model.nominal, rest, pose)
    given = Inputs.of(model.nominal, rest, pose.vector[None])
    assert Assembly(model, eq.shapes, given).state_after()[0][0] == pytest.approx(rest, abs=1e-15)


def test_derivatives_of_what_a_pose_leaves_behind_at_a_saddle():
    """They are those of the state after moved equilibria; slips move the edges of its cells."""
    effects = (RestCurvatureDrift(), ClipSlip(), ClipAngle())
    model = CableModel(CABLE, 20, n_rest=5, clips=("clamped",), effects=effects)
    poses = [HeldPose((0.0, 0.0), end, clips=(SADDLE,)) for end in ((0.75, 0.1), (0.7, 0.15))]
    equilibria, size = BatchEquilibrium(model, poses), len(model.names)
    p, rest = np.array([*model.nominal[:1], 0.2, 0.003, 0.02]), model.rest_basis @ BENT
    first = solve_equilibrium(model, p, rest, poses[0])
    shapes, ok = equilibria.solve(first.shapes.subset([0, 0]), p, rest)
    assert ok.all()
    by_p, by_rest = np.eye(size, size + 5), np.hstack([np.zeros((20, size)), model.rest_basis])
    along = equilibria.directions(shapes, p, rest, by_p, by_rest)
    step = 1e-6
    for k in range(1, size + 5):
        both = []
        for h in (step, -step):
            varied = p + h * by_p[:, k], rest + h * by_rest[:, k]
            there, _ = equilibria.solve(shapes, *varied, tolerance=1e-12)
            both.append(equilibria.rests(there, *varied)[1])
        expected = (both[0] - both[1]) / (2 * step)
        assert along.rest[1, :, k] == pytest.approx(expected, rel=1e-5, abs=1e-4), k


def test_the_tolerance_of_directions_is_of_saddles_too():
    """Also between pins, where nothing else has a direction."""
    model = CableModel(CABLE, n_rest=0, clips=("clamped", "pinned"), effects=(ClipAngle(),))
    assert tolerances_of(model)["heading"] == ("clip_angle.heading_error",)
    other = replace(model, clips=("pinned", "clamped"))
    assert "heading" not in tolerances_of(other)  # the first clip turns nothing any more


def test_an_offset_brings_a_clip_within_reach():
    clip = HeldClip("pinned", (0.4, 0.31), 0.5)  # 0.506 m from the start
    model = CableModel(CABLE, n=20, n_rest=0, clips=("pinned",), effects=(ClipOffset(),))
    pose, rest = HeldPose((0.0, 0.0), (0.7, 0.1), clips=(clip,)), np.zeros(20)
    with pytest.raises(EquilibriumError, match=r"clip are 0\.5061 m apart, with 0\.5000 m"):
        solve_equilibrium(model, model.nominal, rest, pose)
    eq = solve_equilibrium(model, model.nominal - np.array([0.0, 0.0, 0.02]), rest, pose)
    assert eq.stable
    # And so does a longer cable: 0.51 m of it.
    longer = replace(model, effects=(LengthError(),))
    assert solve_equilibrium(longer, longer.nominal + np.array([0.0, 0.02]), rest, pose).stable


def test_a_way_through_eyelets_that_is_too_long_is_told_as_such():
    """0.75 + 0.559 m by way of the eyelet, though the ends are 0.7 m apart."""
    with pytest.raises(
        EquilibriumError, match=r"are 1\.3090 m apart by way of the eyelets, with 1"
    ):
        solved([HeldClip("eyelet", (0.45, 0.6))], (0.7, 0.1))


SESSION = """\
cable: {name: harness, length: 0.8, mass: 0.05, diameter: 0.005, bending_stiffness: 0.01}
experiment:
  gravity: [0, -9.81]
  boundary: {start: pinned, end: pinned}
  measurement: {kind: centerlines, std: 3.0e-4}
  poses:
    - file: a.csv
      start: [0, 0]
      end: [0.6, 0.1]
      clips:
        - {name: first, kind: pinned, at: 0.3, place: [0.25, 0.05]}
        - {kind: eyelet, place: [0.45, 0.0]}
"""


def test_a_session_with_clips(tmp_path):
    (tmp_path / "a.csv").touch()
    (tmp_path / "session.yaml").write_text(SESSION)
    experiment = load_config(tmp_path / "session.yaml").experiment
    assert experiment.clips == ("pinned", "eyelet")
    assert [clip.name for clip in experiment.poses[0].held.clips] == ["first", "clip_2"]


def test_a_clamped_clip_whose_roll_is_free_is_a_swivel():
    held = {"at": 0.3, "place": (0.2, 0.1, 0.0), "orientation": (0.0, 0.0, 0.0, 1.0)}
    swivel = Clip(kind="swivel", **held).held(1)
    assert Clip(kind="clamped", roll="free", **held).held(1) == swivel
    assert swivel.kind == "swivel"


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("at: 0.3", "at: 0.9", "first: at 0.9 m is not between 0 and cable.length 0.8 m"),
        ("at: 0.3, ", "", "first: pinned clips have at"),
        ("kind: eyelet", "kind: eyelet, at: 0.5", "clip_2: eyelet clips have no at"),
        ("kind: eyelet", "kind: pinned, at: 0.2", "at 0.2 m follows 0.3 m: clips stand in the"),
        ("kind: pinned", "kind: clamped", "first: a clamped clip needs its heading"),
        ("kind: pinned", "kind: swivel, heading: 0.1", "first: swivel is of a cable in space"),
        ("place: [0.45, 0.0]", "place: [0.45, 0.0, 0]", r"clip_2: place: \[x, y\] belongs here"),
        ("kind: eyelet", "name: first, kind: eyelet", "two clips are called first"),
        ("place: [0.25, 0.05]", "place: [0.3, 0.2]", "first are 0.3606 m apart, with 0.3 m of"),
    ],
)
def test_clips_that_cannot_be_declared_so(tmp_path, old, new, said):
    (tmp_path / "a.csv").touch()
    (tmp_path / "session.yaml").write_text(SESSION.replace(old, new))
    with pytest.raises(ConfigError, match=said):
        load_config(tmp_path / "session.yaml")


def test_an_eyelet_before_a_free_end_is_within_reach(tmp_path):
    """0.3 m to the pin, then 0.5 m of cable of which 0.6 m would have to pass the eyelet."""
    (tmp_path / "a.csv").touch()
    free = SESSION.replace("end: pinned", "end: free").replace("      end: [0.6, 0.1]\n", "")
    (tmp_path / "session.yaml").write_text(free)
    assert not load_config(tmp_path / "session.yaml").skipped
    (tmp_path / "session.yaml").write_text(free.replace("[0.45, 0.0]", "[0.85, 0.05]"))
    with pytest.raises(ConfigError, match=r"first and clip_2 are 0\.6 m .*eyelets, with 0\.5 m"):
        load_config(tmp_path / "session.yaml")
