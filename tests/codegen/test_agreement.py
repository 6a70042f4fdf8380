"""The compiled solver gives the shapes of equilibrium.py, with all effects of the cable."""

import shutil
from dataclasses import replace
from itertools import product

import numpy as np
import pytest
from solvers import QUICK

from dlo_casadi.codegen import CompiledSolver
from dlo_casadi.effects import EFFECTS, CableData, Load, MeasurementEffect
from dlo_casadi.equilibrium.pose import HeldPose
from dlo_casadi.equilibrium.solve import solve_equilibrium
from dlo_casadi.model.cable_model import CableModel

pytestmark = pytest.mark.skipif(shutil.which("cc") is None, reason="no C compiler (cc)")

CABLE = CableData(length=0.8125, mass=0.23, diameter=0.0128, bending_stiffness=0.3)
ENDS = [(0.5, 0.1), (0.3, -0.5), (0.7, 0.05)]
CLAMPS = (0.7, -0.6)
# Values of parameters at which each effect is felt.
VALUES = {
    "lumped_mass": (0.05, 0.3),
    "point_force": (0.3, -0.2, 0.5),
    "side_load": (0.4,),
    "gravity_tilt": (0.1,),
    "mass_error": (1.2,),
    "stiffness_gradient": (0.3,),
    "stiff_section": (0.3, 0.4, 3.0),
    "bending_softening": (0.05,),
    "axial_stretch": (1e-3,),
    "length_error": (0.004,),
    "start_spring": (0.1, 0.3),
    "end_spring": (0.1, -0.3),
    "clamp_angle": (0.1, -0.2),
    "clamp_compliance": (0.2, 0.05),
    "end_offset": (0.003, -0.002),
    "rest_curvature_drift": (0.1,),
    "plastic_set": (2.0, 0.1),
}
BOUNDARIES = [("pinned", "pinned"), ("clamped", "clamped"), ("clamped", "free")]
HALF_HELD = [("clamped", "pinned"), ("pinned", "clamped")]


def problem(names, element="arc", start="pinned", end="pinned", n=12):
    """A curved cable with these effects."""
    effects = tuple(EFFECTS[name]() for name in names)
    model = CableModel(CABLE, n=n, element=element, start=start, end=end, effects=effects)
    p = np.array([0.3, *(value for name in names for value in VALUES[name])])
    rest = model.rest_basis @ np.random.default_rng(0).normal(size=model.rest_basis.shape[1])
    return model, p, rest


def difference(names, element, start, end, n=12):
    """Largest distance of nodes of the compiled and the Python solution [m]."""
    model, p, rest = problem(names, element, start, end, n)
    solver = CompiledSolver(model, p, rest, flags=QUICK)
    worst = 0.0
    for place in ENDS:
        pose = HeldPose(
            (0.0, 0.0),
            None if end == "free" else place,
            CLAMPS[0] if start == "clamped" else None,
            CLAMPS[1] if end == "clamped" else None,
        )
        expected = solve_equilibrium(model, p, rest, pose)
        shape = solver.solve(pose)
        worst = max(worst, np.abs(shape.points - expected.points).max())
        assert shape.energy == pytest.approx(expected.energy, rel=1e-7)
        assert shape.end_force == pytest.approx(expected.end_force, rel=1e-6, abs=1e-6)
        assert shape.start_force == pytest.approx(expected.start_force, rel=1e-6, abs=1e-6)
        assert shape.min_bend_radius == pytest.approx(expected.min_bend_radius, rel=1e-5)
        if element == "arc":
            assert shape.moments[:, 0] == pytest.approx(expected.moments, rel=1e-6, abs=1e-6)
    return worst


def test_every_effect_of_the_cable_has_values():
    in_plane = {n: e for n, e in EFFECTS.items() if 2 in e.dimensions}
    of_the_cable = {n for n, e in in_plane.items() if not issubclass(e, MeasurementEffect)}
    held = {n for n, e in EFFECTS.items() if issubclass(e, Load) and e.n_springs}
    held |= {"clip_offset", "clip_slip", "clip_angle"}  # see test_holds.py
    assert set(VALUES) == of_the_cable - held - {"obstacle_offset", "contact_plane"}


@pytest.mark.parametrize("element", ["link", "arc", "quadratic"])
@pytest.mark.parametrize("end", ["free", "clamped"])
def test_clamps_that_give_way(element, end):
    """One clamp, or one of two; and the slopes by what is declared of the clamps."""
    effect = EFFECTS["clamp_compliance"](end=False)
    model = CableModel(CABLE, 10, element, "clamped", end, effects=(effect,))
    p, rest = np.array([0.3, 0.2]), np.zeros(model.chain.n_cells)
    solver = CompiledSolver(model, p, rest, flags=QUICK)
    last = CLAMPS[1] if end == "clamped" else None
    pose = HeldPose((0.0, 0.0), None if end == "free" else ENDS[0], CLAMPS[0], last)
    shape = solver.solve(pose)
    found = solve_equilibrium(model, p, rest, pose)
    assert shape.points == pytest.approx(found.points, abs=1e-8)
    assert shape.moments[:, 0] == pytest.approx(found.moments, abs=1e-6)
    assert shape.energy == pytest.approx(found.energy, rel=1e-7)
    slope, d = solver.sensitivity(shape, pose), 1e-5
    for k in (0, 1) if end == "clamped" else (0,):
        name = ("start_heading", "end_heading")[k]
        moved = [replace(pose, **{name: CLAMPS[k] + d * side}) for side in (1, -1)]
        ahead, back = map(solver.solve, moved)
        for name in ("points", "moments"):
            change = (getattr(ahead, name) - getattr(back, name)) / (2 * d)
            assert getattr(slope, name)[..., 2 + k] == pytest.approx(change, abs=1e-6)


def test_springs_of_pins():
    """M = k (phi - heading) at either end, and its slopes by the place of the end."""
    names = ("start_spring", "end_spring")
    model, p, rest = problem(names, n=10)
    solver, pose, d = CompiledSolver(model, p, rest, flags=QUICK), HeldPose((0, 0), ENDS[0]), 1e-5
    shape = solver.solve(pose)
    stiffnesses, relaxed = p[1::2], p[2::2]
    expected = stiffnesses * (shape.x[[0, -1], 0] - relaxed)
    assert shape.moments[:, 0] == pytest.approx(expected, abs=1e-9)
    slope = solver.sensitivity(shape, pose).moments[:, 0]
    for k in range(2):
        step = d * np.eye(2)[k]
        ahead, back = (solver.solve(replace(pose, end=ENDS[0] + w * step)) for w in (1, -1))
        change = (ahead.moments - back.moments)[:, 0] / (2 * d)
        assert slope[:, k] == pytest.approx(change, abs=1e-6)
    assert np.all(slope[:, 2:] == 0)


def kinds():
    """The default element with all ends; others with those that have most effects."""
    few = [("arc", "clamped", "clamped"), ("link", "pinned", "pinned")]
    for element, ends in product(("link", "arc", "quadratic"), BOUNDARIES):
        more = element != "quadratic" and (element, *ends) not in few
        yield pytest.param(element, *ends, marks=[pytest.mark.long] * more)


@pytest.mark.parametrize(("element", "start", "end"), list(kinds()))
def test_all_effects_together(element, start, end):
    of_ends = {"clamp_angle": "clamped", "clamp_compliance": "clamped"}
    of_ends |= {"start_spring": "pinned", "end_spring": "pinned"}
    names = [n for n in VALUES if of_ends.get(n) in (None, start if start == end else "")]
    assert difference(names, element, start, end, n=6) < 1e-8  # more take long to generate


@pytest.mark.parametrize(("start", "end"), HALF_HELD)
def test_one_clamp(start, end):
    assert difference(["lumped_mass"], "quadratic", start, end, n=10) < 1e-8
