"""The contract of a node: it moves by increments; nothing else needs to know its coordinates."""

import casadi as ca
import numpy as np
import pytest

from dlo_casadi.equilibrium.pose import HeldPose
from dlo_casadi.rod.chain import ELEMENTS, ELEMENTS_IN_SPACE
from dlo_casadi.rod.node import NODES, Frame, Heading, Node

# Some node of each kind; all others are reached from there.
SOME: dict[type[Node], list[float]] = {Heading: [0.3], Frame: [0.1, -0.5, 0.7, 0.5]}
EVERY = pytest.mark.parametrize("kind", SOME, ids=lambda kind: kind.__name__)
ROUNDING = 1e-14  # a few operations on numbers of order one


def nodes(kind: type[Node], *shape: int) -> np.ndarray:
    """Nodes (*shape, coordinates) that lie less than half a turn apart."""
    rng = np.random.default_rng(0)
    way = rng.uniform(-0.8, 0.8, size=(*shape, kind.increment))
    return kind.moved(np.broadcast_to(SOME[kind], (*shape, kind.coordinates)), way)


def test_every_kind_of_node_is_known_here():
    every = (*ELEMENTS.values(), *ELEMENTS_IN_SPACE.values())
    assert {element.node for element in every} == set(NODES.values()) == set(SOME)


@EVERY
def test_moved_and_difference_are_inverse(kind):
    x, y = nodes(kind, 2, 7), nodes(kind, 2, 7)[::-1]
    np.testing.assert_allclose(kind.moved(x, kind.difference(x, y)), y, atol=ROUNDING)
    way = np.random.default_rng(1).uniform(-1.5, 1.5, size=(2, 7, kind.increment))
    np.testing.assert_allclose(kind.difference(x, kind.moved(x, way)), way, atol=ROUNDING)
    np.testing.assert_allclose(kind.difference(x, x), 0.0, atol=ROUNDING)


@EVERY
def test_expressions_move_as_arrays_do(kind):
    x = nodes(kind, 5)
    way = np.random.default_rng(2).uniform(-1.5, 1.5, size=(5, kind.increment))
    moved = [kind.moved(ca.SX(a), ca.SX(d)) for a, d in zip(x, way, strict=True)]
    moved = [np.array(ca.evalf(one)).ravel() for one in moved]
    np.testing.assert_allclose(moved, kind.moved(x, way), atol=ROUNDING)


@EVERY
def test_increments_reach_every_neighbour_and_the_tangent_stays_a_unit_vector(kind):
    """No increment is lost at delta = 0; the tangent turns across itself."""
    x, delta = ca.SX.sym("x", kind.coordinates), ca.SX.sym("delta", kind.increment)
    moved = kind.moved(x, delta)
    tangent = kind.tangent(moved)
    rows = [ca.jacobian(moved, delta), tangent, ca.jacobian(tangent, delta)]
    slopes = ca.Function("slopes", [x, delta], rows)
    for some in nodes(kind, 5):
        by_delta, t, turning = (np.array(block) for block in slopes(some, 0))
        assert np.linalg.matrix_rank(by_delta) == kind.increment
        assert t.shape == (kind.dimension, 1)
        assert np.linalg.norm(t) == pytest.approx(1.0, abs=ROUNDING)
        np.testing.assert_allclose(t.T @ turning, 0.0, atol=ROUNDING)
        assert np.abs(turning).max() > 0.5


@EVERY
def test_interpolation_hits_what_is_known_and_the_middle_in_between(kind):
    known, x = np.array([0.1, 0.4, 0.5]), nodes(kind, 2, 3)
    np.testing.assert_allclose(kind.interpolated(known, known, x), x, atol=ROUNDING)
    middle = kind.interpolated(np.array([0.25, 0.45]), known, x)
    halves = kind.difference(x[:, :-1], middle), kind.difference(middle, x[:, 1:])
    np.testing.assert_allclose(*halves, atol=ROUNDING)
    beyond = kind.interpolated(np.array([0.0, 0.9]), known, x)
    np.testing.assert_allclose(beyond, x[:, [0, -1]], atol=ROUNDING)


def test_headings_count_whole_turns():
    """A cable that turns once on its way has turned, whatever its tangent."""
    x, y = np.array([[0.2]]), np.array([[0.2 - 2 * np.pi]])
    np.testing.assert_allclose(Heading.difference(x, y), -2 * np.pi)
    np.testing.assert_allclose(Heading.tangent(ca.DM(np.pi / 2)), [[0.0], [1.0]], atol=ROUNDING)


BOTH = pytest.mark.parametrize("kind", NODES.values(), ids=lambda kind: kind.__name__)


def some(kind: type[Node]) -> np.ndarray:
    """Nodes (5, coordinates), up to a radian from the world's axes."""
    way = np.random.default_rng(3).uniform(-1.0, 1.0, size=(5, kind.increment))
    return kind.moved(np.broadcast_to(kind.identity, (5, kind.coordinates)), way)


@BOTH
def test_nodes_of_any_length_become_nodes_again(kind):
    """A length that is part of no node, a quaternion's, is lost; an angle stays."""
    x, factor = some(kind), 3.0 if kind.coordinates > kind.increment else 1.0
    np.testing.assert_allclose(kind.normalised(factor * x), x, atol=ROUNDING)
    symbolic = np.array(kind.normalised(ca.DM(factor * x.T))).T
    np.testing.assert_allclose(symbolic, x, atol=ROUNDING)
    excess = kind.excess(factor * x)
    assert excess.shape == (5, kind.coordinates - kind.increment)
    np.testing.assert_allclose(excess, factor**2 - 1, atol=3 * factor**2 * ROUNDING)
    np.testing.assert_allclose(np.array(kind.excess(ca.DM(factor * x.T))).ravel(), excess.ravel())


@BOTH
def test_the_frame_of_a_node_has_its_tangent_as_x_and_turns_about_its_axes(kind):
    d, step = kind.dimension, 1e-6
    for x in some(kind):
        frame = kind.rotations(x)
        tangent = np.array(kind.tangent(ca.DM(x))).ravel()
        np.testing.assert_allclose(frame.apply([1.0, 0.0, 0.0])[:d], tangent, atol=ROUNDING)
        for k, axis in enumerate(kind.about):
            ahead = kind.rotations(kind.moved(x, step * np.eye(kind.increment)[k]))
            turned = (frame.inv() * ahead).as_rotvec() / step
            np.testing.assert_allclose(turned, np.eye(3)["xyz".index(axis)], atol=1e-9)


@BOTH
def test_a_pose_declares_clamps_as_the_node_says(kind):
    first, last = some(kind)[:2]
    held = {f"start_{kind.direction}": kind.declared(first)}
    held |= {f"end_{kind.direction}": kind.declared(last)}
    pose = HeldPose((0.0,) * kind.dimension, (0.5,) * kind.dimension, **held)
    assert pose.node is kind
    np.testing.assert_allclose(pose.frames, [first, last], atol=ROUNDING)
    assert ("turns" in pose.directions) is kind.twists
    assert len(kind.columns) == kind.coordinates
    assert len(kind.about) == len(kind.strains) == kind.increment


@BOTH
def test_bends_are_the_length_of_the_curvatures(kind):
    curvatures = np.random.default_rng(4).uniform(-2.0, 2.0, size=(len(kind.curvatures), 6))
    bend = np.abs(np.array(ca.DM(kind.bend(ca.DM(curvatures))))).ravel()
    np.testing.assert_allclose(bend, np.linalg.norm(curvatures, axis=0), atol=1e-12)


@BOTH
def test_a_shape_is_the_same_up_to_what_cannot_be_seen(kind):
    """Full turns of all headings; in space signs of quaternions, and a roll of the whole cable."""
    x, tolerance = some(kind), 0.05
    step = np.zeros((len(x), kind.increment))
    step[2, -1] = 1.1 * tolerance
    assert kind.same(x, x, tolerance)
    assert not kind.same(x, kind.moved(x, step), tolerance)
    assert kind.same(x, kind.moved(x, 0.8 * step), tolerance)
    if kind is Heading:
        assert kind.same(x, x - 4 * np.pi, tolerance)
        assert not kind.same(x, x - np.pi, tolerance)
    else:
        roll, bend = np.tile([0.7, 0.0, 0.0], (len(x), 1)), np.tile([0.0, 0.0, 0.7], (len(x), 1))
        assert kind.same(x, -kind.moved(x, roll), tolerance)
        assert not kind.same(x, kind.moved(x, bend), tolerance)


@BOTH
def test_the_turning_of_a_shape_is_its_bend_or_its_twist(kind):
    """In a plane headings differ by it; in space it is about the cable's axis."""
    steps = np.random.default_rng(5).uniform(-0.4, 0.4, size=(6, kind.increment))
    x = [np.array(kind.identity)]
    for step in steps:
        x.append(kind.moved(x[-1], step))
    both = np.array([x, x[::-1]])
    total = steps[:, 0].sum()
    np.testing.assert_allclose(kind.turning(both), [total, -total], atol=10 * ROUNDING)
