"""Functions of segments over many poses: vectorised ones give the same numbers, bit for bit."""

import shutil
import sys
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import casadi as ca
import numpy as np
import pytest

from dlo_casadi.codegen.segments import compile_functions
from dlo_casadi.effects import BendingSoftening, CableData, PointForce, StiffSection
from dlo_casadi.model import stacked
from dlo_casadi.model.cable_model import CableModel
from dlo_casadi.model.functions import functions_of
from dlo_casadi.model.stacked import Mapped, vectorised
from dlo_casadi.rod.chain import ELEMENTS_IN_SPACE

CABLE = CableData(length=1.2, mass=0.3, diameter=0.01, bending_stiffness=0.02)
EFFECTS = PointForce(), StiffSection(), BendingSoftening()
NAMES = ("segment", "segment_sensitivity", "at_ends", "station_slopes")
OTHERS = (
    *("segment_slope", "segment_curve", "segment_curve_slopes", "end_slope", "end_sensitivity"),
    *("station", "reading_slopes"),
)


def arguments(function: ca.Function, m: int, count: int) -> list[np.ndarray]:
    rng = np.random.default_rng(0)
    return [rng.uniform(0.1, 1, (m, count, function.numel_in(i))) for i in range(function.n_in())]


@pytest.mark.parametrize(
    "name", [*NAMES, *(pytest.param(name, marks=pytest.mark.long) for name in OTHERS)]
)
@pytest.mark.parametrize(("torsion", "repetitive"), [(None, True), (0.015, False)])
@pytest.mark.parametrize("element", ELEMENTS_IN_SPACE)
def test_numbers_of_a_segment_do_not_depend_on_how_they_are_computed(
    element, torsion, repetitive, name, monkeypatch
):
    cable = replace(CABLE, torsional_stiffness=torsion)
    gravity = (0.0, -9.81) if torsion is None else (0.0, 0.0, -9.81)
    model = CableModel(cable, 6, element, effects=EFFECTS, gravity=gravity)
    function = getattr(functions_of(model), name)
    monkeypatch.setattr(stacked, "WORTH", 0)
    mapped = Mapped(function, repetitive=repetitive)
    given = arguments(function, 13, 6)  # 78 segments: two blocks
    first = mapped(*given)
    monkeypatch.setattr(stacked, "OFTEN", 0)
    after = mapped(*given)
    assert mapped._vectorised is not None
    assert mapped._simplified is repetitive
    assert [x.shape for x in mapped(*(x[:0] for x in given))] == [(0, *x.shape[1:]) for x in first]
    monkeypatch.setattr(stacked, "WORTH", np.inf)
    simpler = mapped(*given)
    assert mapped._simplified
    assert mapped.function.n_instructions() <= function.n_instructions()
    monkeypatch.setattr(stacked, "FEWEST", 0)
    monkeypatch.setattr(stacked, "WORTH", 0)
    few = mapped(*(block[:2] for block in given))
    assert [x.strides for x in few] == [x.strides for x in first]
    alone = [mapped(*(block[k : k + 1] for block in given)) for k in (0, 12)]
    for number, (one, other) in enumerate(zip(first, after, strict=True)):
        assert np.isfinite(one).all()
        np.testing.assert_array_equal(one, simpler[number])
        np.testing.assert_array_equal(one, other)
        assert one.strides == other.strides
        np.testing.assert_array_equal(one[[0, 12]], [x[number][0] for x in alone])


def test_a_vectorised_function_of_constants_and_selections():
    x, y = ca.SX.sym("x", 2), ca.SX.sym("y", 0)
    found = ca.vertcat(x[1], 3, ca.if_else(x[0] > 0, ca.sqrt(ca.fabs(x[1])), -x[0]))
    function = ca.Function("f", [x, y], [ca.densify(found), ca.SX(0, 1)])
    rows = np.array([[1.0, 4.0], [-1.0, 9.0], [0.0, -16.0]])
    values, nothing = vectorised(function, 3)(rows, np.zeros((3, 0)))
    np.testing.assert_array_equal(values, [[4, 3, 2], [9, 3, 1], [-16, 3, 0]])
    assert nothing.shape == (3, 0)


def test_a_function_that_calls_another_stays_scalar(monkeypatch):
    monkeypatch.setattr(stacked, "WORTH", 0)
    monkeypatch.setattr(stacked, "OFTEN", 0)
    x = ca.SX.sym("x", 2)
    called = ca.Function("called", [x], [ca.sumsqr(x)], {"never_inline": True})
    mapped = Mapped(ca.Function("f", [x], [ca.densify(2 * called(x))]))
    (given,) = arguments(mapped.function, 3, 10)
    (found,) = mapped(given)
    assert mapped._vectorised is None
    np.testing.assert_allclose(found[..., 0, 0], 2 * (given**2).sum(axis=2))


def test_threads_take_turns():
    """A function is shared by all threads of a process, and so are its buffers."""
    x = ca.SX.sym("x", 3)
    mapped = Mapped(ca.Function("segment", [x], [ca.sin(x), ca.sumsqr(x)]))
    given = [np.random.default_rng(k).uniform(size=(1, 40, 3)) for k in range(200)]
    interval = sys.getswitchinterval()
    sys.setswitchinterval(1e-5)
    try:
        with ThreadPoolExecutor(4) as pool:
            found = list(pool.map(mapped, given))
    finally:
        sys.setswitchinterval(interval)
    for one, (sines, squares) in zip(given, found, strict=True):
        np.testing.assert_allclose(sines[..., 0], np.sin(one), rtol=1e-14)
        np.testing.assert_allclose(squares[..., 0, 0], (one**2).sum(axis=2), rtol=1e-14)


@pytest.mark.skipif(shutil.which("cc") is None, reason="no C compiler (cc)")
def test_a_compiled_function_gives_the_same_numbers() -> None:
    x = ca.SX.sym("x", 2)
    functions = [ca.Function("f", [x], [ca.sin(x[0]) * x, x[1] ** 3]) for _ in range(2)]
    plain, compiled = map(Mapped, functions)
    compile_functions([compiled])
    assert compiled.compiled
    given = np.random.default_rng(0).normal(size=(3, 4, 2))
    for one, other in zip(plain(given), compiled(given), strict=True):
        assert np.array_equal(one, other)
    compile_functions([compiled])  # nothing is left to do
