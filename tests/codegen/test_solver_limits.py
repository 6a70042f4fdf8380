"""Limits of the generated solver, against those of Python on the same shape and differences."""

import shutil
from dataclasses import replace

import numpy as np
import pytest
from scipy.interpolate import CubicHermiteSpline
from solvers import moved
from test_holds import (
    CLIPS,
    EYELET,
    FLAT_EYELET,
    FLAT_SADDLE,
    POSE,
    SADDLE,
    SWIVEL,
    compiled,
    flat,
    loom,
    moves_of,
    turned,
)

from dlo_casadi.codegen import QUANTITIES, STATUSES, Capsule, CompiledShape, Plane
from dlo_casadi.equilibrium.limits import places_of, sizes_of
from dlo_casadi.equilibrium.solve import solve_equilibrium
from dlo_casadi.equilibrium.spread import SolvedCable
from dlo_casadi.errors import DloError
from dlo_casadi.model.assembly import Assembly, Inputs
from dlo_casadi.model.clips import HeldClip

pytestmark = pytest.mark.skipif(shutil.which("cc") is None, reason="no C compiler (cc)")

LIMITS = {"bend_radius": 0.05, "force": 4.0, "moment": 0.2, "twist": 5.0, "clearance": 0.02}
# Of Python's sizes the bend radius is one over the curvature; a plane has no twist.
SIZES = {"bend_radius": "curvature", "force": "force", "moment": "moment", "twist": "twist"}


def in_space(*clips, **held):
    """A cable in space, and a pose of it."""
    pose = replace(POSE, clips=clips)
    return loom(tuple(clip.kind for clip in clips), **held), pose


CASES = {
    "plane": lambda: flat(),
    "links": lambda: flat(element="link"),
    "plane, bent most at an eyelet": lambda: flat(HeldClip("eyelet", (0.35, 0.35))),
    "plane, bent most at a pinned clip": lambda: flat(HeldClip("pinned", (0.35, 0.35), 0.59)),
    "plane, saddle and eyelet": lambda: flat(FLAT_SADDLE, FLAT_EYELET),
    "plane, saddle near the start": lambda: flat(
        replace(FLAT_SADDLE, at=0.17, place=(0.15, 0.045)), end="free"
    ),
    "space": lambda: in_space(),
    "space, pinned": lambda: in_space(*CLIPS),
    "space, saddle and pinned": lambda: in_space(SADDLE, CLIPS[1]),
    "space, swivel and eyelet": lambda: in_space(SWIVEL, EYELET),
}


def ball_beside(shape):
    """A ball near the cable, and a plane below it."""
    d = shape.points.shape[1]
    middle = tuple(shape.points[len(shape.points) // 2] + 0.1)
    down = tuple(np.eye(d)[-1])
    return [Capsule(middle, middle, 0.03), Plane(tuple(-0.6 * np.array(down)), down)]


@pytest.mark.parametrize(
    "case",
    [
        pytest.param(x, marks=pytest.mark.long) if x in ("space", "space, pinned") else x
        for x in CASES
    ],
)
def test_values_and_places_are_those_of_python(case):
    model, pose = CASES[case]()
    solver, p, rest = compiled(model)
    shape, found = solver.solve(pose), solve_equilibrium(model, p, rest, pose)
    usages = solver.limits(shape, {name: LIMITS[name] for name in SIZES})
    given = Inputs.of(p, rest, pose.vector[None])
    for name, size in SIZES.items():
        own, limit = usages[name], LIMITS[name]
        if name == "twist" and not model.in_space:
            assert own.value == 0.0
            continue
        sizes = sizes_of(Assembly(model, found.shapes, given), size)[0]
        places, holders = places_of(SolvedCable(model, p, rest, pose, found), size)
        tight = int(sizes.argmax())
        expected = 1 / sizes[tight] if name == "bend_radius" else sizes[tight]
        assert own.value == pytest.approx(expected, rel=1e-9), name
        assert own.at == pytest.approx(places[tight], abs=1e-9), name
        if name == "bend_radius" and "bent most" in case:
            assert own.at == pytest.approx(found.clips[0].at, abs=1e-9)
        used = limit * sizes[tight] if name == "bend_radius" else sizes[tight] / limit
        assert own.margin == pytest.approx(1 - used, rel=1e-8), name
        if name in ("force", "moment"):
            names = ["start", "end", *(clip.name for clip in pose.clips)]
            assert names[own.which] == holders[tight]
    assert (usages["clearance"].value, usages["clearance"].margin) == (np.inf, 1.0)
    first, *_ = usages
    assert usages[first].margin == min(item.margin for item in usages.values())


@pytest.mark.parametrize("case", ["plane", "plane, saddle and eyelet"])
def test_a_clearance_is_that_of_dlo_clearance(case):
    """Its place, too, of nodes that a saddle moves along the cable."""
    model, pose = CASES[case]()
    solver, *_ = compiled(model)
    shape = solver.solve(pose)
    slope, obstacles = solver.sensitivity(shape, pose), ball_beside(shape)
    gap = solver.clearance(shape, obstacles, slope)
    own = solver.limits(shape, {"clearance": 0.02}, obstacles, slope)["clearance"]
    assert (own.value, own.which) == (gap.distance, gap.obstacle)
    assert own.at == gap.place * model.cable.length
    s = model.cable.length * (shape.places if pose.clips else np.linspace(0.0, 1.0, model.n + 1))
    tangents = np.column_stack([np.cos(shape.x), np.sin(shape.x)])
    there = CubicHermiteSpline(s, shape.points, tangents)(own.at)
    surface = obstacles[gap.obstacle].near(there[None]).distance[0]
    assert surface - model.cable.diameter / 2 == pytest.approx(gap.distance, abs=1e-9)
    assert own.margin == pytest.approx(gap.distance / 0.02 - 1)
    assert np.array_equal(own.gradient, gap.gradient)
    without = solver.limits(shape, {"clearance": 0.02}, obstacles)
    assert all(np.isnan(usage.gradient).all() for usage in without.values())


@pytest.mark.parametrize(
    "case",
    [
        "plane, saddle and eyelet",
        "plane, bent most at an eyelet",
        "plane, bent most at a pinned clip",
        "space, saddle and pinned",
        "space, swivel and eyelet",
    ],
)
def test_gradients_are_differences(case):
    """Central differences of 1e-5 m, whose error is about 1e-7 of the second derivative."""
    model, pose = CASES[case]()
    solver, *_ = compiled(model)
    shape, step = solver.solve(pose), 1e-5
    obstacles = ball_beside(shape)
    usages = solver.limits(shape, LIMITS, obstacles, solver.sensitivity(shape, pose))
    for column, move, _ in moves_of(model, pose):
        ahead, back = (
            solver.limits(solver.solve(move(h), warm=shape), LIMITS, obstacles)
            for h in (step, -step)
        )
        for name in QUANTITIES:
            change = (ahead[name].value - back[name].value) / (2 * step)
            own = usages[name].gradient[column]
            assert own == pytest.approx(change, rel=1e-6, abs=2e-6), (column, name)


def test_a_twist_backwards_counts_by_its_size():
    model, pose = CASES["space, swivel and eyelet"]()
    pose = replace(pose, end_orientation=turned(-1.5, -0.2, 0.1))
    solver, *_ = compiled(model)
    shape, step = solver.solve(pose), 1e-5
    own = solver.limits(shape, {}, slope=solver.sensitivity(shape, pose))["twist"]
    assert own.value == -shape.max_twist > 0.0
    for column in (9, 10, 11):  # turns of the end
        ahead, back = (solver.solve(moved(pose, column, h), warm=shape) for h in (step, -step))
        change = (back.max_twist - ahead.max_twist) / (2 * step)
        assert own.gradient[column] == pytest.approx(change, rel=1e-6, abs=2e-6), column


def test_limits_that_cannot_be_checked():
    model, pose = flat()
    solver, *_ = compiled(model)
    shape = solver.solve(pose)
    none = solver.solve(replace(pose, end=(3.0, 0.0)), throw=False)
    with pytest.raises(DloError, match=r"no limit 'bend'\s+Try: bend_radius"):
        solver.limits(shape, {"bend": 0.1})
    with pytest.raises(DloError, match="must be positive and finite, found force -1"):
        solver.limits(shape, {"force": -1.0})
    with pytest.raises(DloError, match="a limit of the clearance, and no obstacle"):
        solver.limits(shape, {"clearance": 0.01})
    with pytest.raises(DloError, match="the shape is 'unreachable'"):
        solver.limits(none, {})
    with pytest.raises(DloError, match="not_finite"):
        solver.limits(shape, LIMITS, [Capsule((0.0, 0.0), (0.0, 0.0), np.nan)])
    assert all(item.margin == 1.0 for item in solver.limits(shape, {}).values())
    # What Python refuses beforehand C refuses, too.
    out, tightest = np.ones((5, solver._records.usage.itemsize // 8)), np.ones(1, np.intc)
    for wrong, status in ((-1.0, "bad_argument"), (np.nan, "not_finite"), (np.inf, "not_finite")):
        given = (
            solver._record_of(CompiledShape, shape),
            np.full(5, wrong),
            None,
            0,
            None,
            out,
            tightest,
        )
        assert STATUSES[solver._call("dlo_limits", *given)] == status
        assert not out.any()
        assert not tightest.any()
