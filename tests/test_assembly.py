"""Poses put together from segments: derivatives, independence of poses, memory over n."""

import pickle
import tracemalloc
from dataclasses import replace

import numpy as np
import pytest
from perturbed import any_rest, any_shapes, central, directions

from dlo_casadi.effects import (
    AxialStretch,
    BendingSoftening,
    CableData,
    ClampAngle,
    EndOffset,
    EndSpring,
    GravityTilt,
    ImageDistortion,
    ImageScale,
    LengthError,
    LumpedMass,
    PointForce,
    RestCurvatureDrift,
    SideLoad,
    StiffSection,
    UnknownPull,
    random_effects,
)
from dlo_casadi.equilibrium.batch import BatchEquilibrium
from dlo_casadi.equilibrium.pose import HeldPose
from dlo_casadi.model.assembly import Assembly, Inputs
from dlo_casadi.model.cable_model import CableModel
from dlo_casadi.model.lagrangian import lagrangian_of
from dlo_casadi.rod.chain import ELEMENTS

CABLE = CableData(length=1.2, mass=0.3, diameter=0.01, bending_stiffness=0.02)
ENDS = np.array(
    [[0.1, 0.2, 0.9, 0.1, 0.2, -0.3], [0.0, 0.0, 0.5, -0.4, 0.0, 0.4], [-0.1, 0.3, 0.4, 0.4, 1, 1]]
)  # start, end [m], headings [rad] of three poses
M = len(ENDS)
ALL = pytest.mark.parametrize("element", ELEMENTS)
BOUNDARIES = pytest.mark.parametrize(
    "boundary", [("pinned", "pinned"), ("clamped", "clamped"), ("clamped", "free")]
)
LOADS = (LumpedMass(), PointForce(), SideLoad(), GravityTilt(), UnknownPull())
MOST = (
    *LOADS,
    *(AxialStretch(), LengthError(), StiffSection(), BendingSoftening(), RestCurvatureDrift()),
    *(ImageScale(), ImageDistortion()),
)
HOLDERS = {"pinned": (EndSpring(), EndOffset()), "clamped": (ClampAngle(),), "free": ()}
OWN_LENGTH = LengthError(label="length of a pose")
RANDOM_OF = {"pinned": (random_effects()["pin_moment"](label="moment of a pose"), OWN_LENGTH)}


def posed(element: str, boundary: tuple, effects=MOST, n=4, varied=True) -> Assembly:
    """Three poses of a model with most effects, at nothing special."""
    effects = (*effects, *HOLDERS[boundary[1]])
    random = RANDOM_OF.get(boundary[1], (OWN_LENGTH,)) if varied else ()
    model = CableModel(CABLE, n, element, *boundary, effects=effects, random=random)
    rng = np.random.default_rng(2)
    p = model.nominal + [
        0.3 * q.scale * (not q.log) * rng.uniform(0.2, 1) for q in model.parameters
    ]
    given = Inputs.of(p, any_rest(model, M), np.pad(ENDS, ((0, 0), (0, 3))))
    return Assembly(model, any_shapes(model, M), given)


def steps(model: CableModel, *names: str) -> np.ndarray:
    """Steps of central differences: 1e-5 of a parameter's scale, 1e-6 of all else."""
    count = directions(model, 1, *names).lam.shape[2]
    out = np.full(count, 1e-6)
    if "p" in names:
        at = directions(model, 1, *names).p[0].argmax(axis=1)
        out[at] = [1e-5 * (q.nominal if q.log else q.scale) for q in model.parameters]
    return out


def assert_close(exact: np.ndarray, approximate: np.ndarray, d: np.ndarray, size: float) -> None:
    """Central differences: 1e-10 of third derivatives, and rounding of values of this size."""
    tolerance = 1e-6 * np.maximum(np.abs(exact), 1.0) + 1e-15 * size / d
    gap = np.abs(exact - approximate)
    assert np.all(gap < tolerance), f"{(gap / tolerance).max():.2g} of the tolerance"


# ---- derivatives -------------------------------------------------------------------------------


@ALL
@BOUNDARIES
def test_gradient_and_hessian_of_the_lagrangian(element, boundary):
    a = posed(element, boundary)
    names = ("x", "lam")
    along, d = directions(a.model, M, *names), steps(a.model, *names)
    total, slope, matrix = a.balance()
    by_value = central(a, lambda b: b.balance()[0], along, d)
    assert_close(slope.rows[..., 0], by_value, d, np.abs(total).max())
    by_slope = central(a, lambda b: b.balance()[1].rows[..., 0], along, d)
    dense = matrix.dense()
    assert_close(dense, by_slope, d, np.abs(slope.rows).max())
    np.testing.assert_allclose(dense, np.swapaxes(dense, 1, 2), atol=1e-13)


@ALL
@BOUNDARIES
def test_gradient_by_what_the_equilibrium_depends_on(element, boundary):
    """By parameters, rest curvature and deviations."""
    a = posed(element, boundary)
    names = ("p", "rest", "deviation")
    along, d = directions(a.model, M, *names), steps(a.model, *names)
    exact = a.balance_along(along).rows
    slope = central(a, lambda b: b.balance()[1].rows[..., 0], along, d)
    assert_close(exact, slope, d, 10.0)


@ALL
@BOUNDARIES
def test_measured_curve_by_all_it_depends_on(element, boundary):
    a = posed(element, boundary)
    names = ("x", "lam", "p", "rest", "deviation")
    along, d = directions(a.model, M, *names), steps(a.model, *names)
    curves, change = a.curve_along(along)
    np.testing.assert_allclose(curves, a.curve(), atol=1e-14)  # rounding
    assert curves.shape == (M, a.model.chain.n + 1, 4 if a.model.chain.kind.smooth else 2)
    assert_close(change, central(a, lambda b: b.curve(), along, d), d, 10.0)


@ALL
@BOUNDARIES
def test_state_by_all_it_depends_on(element, boundary):
    a = posed(element, boundary)
    names = ("x", "p", "rest", "deviation")
    along, d = directions(a.model, M, *names), steps(a.model, *names)
    after = a.state_after()
    exact = a.state_along(after, along)
    approximate = central(a, lambda b: b.state_after()[0], along, d)
    assert_close(exact, approximate, d, 10.0)


@ALL
def test_energy_is_the_lagrangian_less_the_work_of_its_multipliers(element):
    """Where nothing inside moves with them it does not depend on the multipliers."""
    a = posed(element, ("clamped", "clamped"), LOADS)
    total, slope, _ = a.balance()
    energy = a.energy()
    work = (a.shapes.lam * slope.y[..., 0]).sum(axis=1)
    np.testing.assert_allclose(energy + work, total, rtol=1e-12)
    if not a.model.n_inner:
        others = replace(a, shapes=replace(a.shapes, lam=3 * a.shapes.lam - 1))
        np.testing.assert_allclose(others.energy(), energy, rtol=1e-12)


# ---- shape -------------------------------------------------------------------------------------


@ALL
def test_the_curve_without_measurement_effects_is_the_cable(element):
    """Places of the nodes; for smooth elements the direction there, as long as the stretch."""
    a = posed(element, ("pinned", "pinned"), (LengthError(),), varied=False)
    z = a.curve()
    np.testing.assert_allclose(z[..., :2], a.nodes(), atol=1e-14)
    np.testing.assert_array_equal(z[:, 0, :2], ENDS[:, :2])
    if a.model.chain.kind.smooth:
        stretch = (
            float(lagrangian_of(a.model).true_ends_and_length(a.given.p[0], 0, 0)[1]) / CABLE.length
        )
        x = a.shapes.x[..., 0]
        exact = stretch * np.stack([np.cos(x), np.sin(x)], axis=-1)
        np.testing.assert_allclose(z[..., 2:], exact, atol=1e-14)


@ALL
def test_the_end_is_held_where_the_multipliers_say(element):
    """Gradient by the first two multipliers: where the cable ends, less where it should."""
    a = posed(element, ("clamped", "pinned"))
    gap = a.balance()[1].y[:, :2, 0]
    held = [
        np.array(lagrangian_of(a.model).true_ends_and_length(p, ends, own)[0]).ravel()[2:4]
        for p, ends, own in zip(a.given.p, ENDS, a.shapes.deviation, strict=True)
    ]
    exact = a.nodes()[:, -1] - held
    np.testing.assert_allclose(gap, exact, atol=1e-13)  # rounding of a dozen sums


@ALL
def test_poses_do_not_touch_each_other(element):
    """All poses at once are each pose alone."""
    a = posed(element, ("clamped", "clamped"))
    together = a.balance()
    for j in range(M):
        alone = a.subset([j]).balance()
        assert alone[0][0] == together[0][j]
        np.testing.assert_array_equal(alone[1].rows[0], together[1].rows[j])
        np.testing.assert_array_equal(alone[2].dense()[0], together[2].dense()[j])
        one = a.subset([j]).curve()
        np.testing.assert_array_equal(one[0], a.curve()[j])


def test_another_process_gets_the_same_numbers():
    a = posed("quadratic", ("pinned", "pinned"))
    again = pickle.loads(pickle.dumps(a))
    np.testing.assert_array_equal(again.balance()[0], a.balance()[0])


# ---- size --------------------------------------------------------------------------------------


def most_memory(n: int) -> int:
    """Largest memory [bytes] that NumPy holds during a linearisation of three poses."""
    tracemalloc.start()
    model = CableModel(CABLE, n, effects=(LumpedMass(), RestCurvatureDrift()))
    equilibria = BatchEquilibrium(model, [HeldPose((0.0, 0.0), (0.5, 0.1 * j)) for j in range(M)])
    s = model.chain.places / CABLE.length
    shapes = equilibria.start_shapes(np.broadcast_to((1 - 2 * s)[:, None], (M, len(s), 1)))
    rest = np.full(model.chain.n_cells, 0.5)
    p = np.array([0.02, 0.01, 0.3, 0.1])
    slopes, rest_slopes = np.eye(4, 13), np.hstack([np.zeros((n, 4)), model.rest_basis])
    along = equilibria.directions(shapes, p, rest, slopes, rest_slopes)
    equilibria.observe(shapes, p, rest, along)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    return peak


def test_memory_grows_with_the_nodes_and_not_with_their_square():
    """Eight times the nodes: at most eight times the memory; a dense matrix would ask for 64."""
    assert most_memory(640) < 8 * most_memory(80)
