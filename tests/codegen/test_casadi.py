"""The compiled solver in CasADi: value and Jacobian of `CasadiCable.function`, without Python."""

import shutil

import casadi as ca
import numpy as np
import pytest
from solvers import QUICK

from dlo_casadi.codegen import generate
from dlo_casadi.codegen.compiler import compile_library
from dlo_casadi.effects import AxialStretch, CableData, ClampCompliance, ClampRotation, Tether
from dlo_casadi.equilibrium.symbolic import CasadiCable
from dlo_casadi.errors import DloError
from dlo_casadi.model.cable_model import CableModel

pytestmark = pytest.mark.skipif(shutil.which("cc") is None, reason="no C compiler (cc)")

# As dlo_pose, neither end at the origin; quaternions of any length.
POSES = {
    "plane": np.array([0.1, 0.2, 0.5, 0.1, 0.3, -0.4]),
    "space": np.array([0.1, 0.2, 0, 0.5, 0.1, 0.1, 0.1, 0, 0, 1.2, 0.1, 0.2, 0, 0.9, 0]),
}


def cable(where, **options):
    """Model, parameters and rest strains."""
    flat = where == "plane"
    model = CableModel(
        CableData(0.8, 0.05, 0.005, 0.01, torsional_stiffness=None if flat else 0.008),
        n=6,
        element="arc",
        gravity=(0.0, -9.81) if flat else (0.0, 0.0, -9.81),
        n_rest=0,
        **options,
    )
    rest = np.zeros((len(model.node.strains), model.chain.n_cells))
    rest[-1] = 0.5
    return model, model.nominal + [0.0 if q.log else 0.5 * q.scale for q in model.parameters], rest


@pytest.mark.parametrize(
    ("where", "branch", "options"),
    [
        ("plane", None, {"start": "clamped", "end": "clamped", "effects": (ClampCompliance(),)}),
        ("plane", "cw", {}),
        ("space", None, {"start": "clamped", "end": "clamped", "effects": (ClampRotation(),)}),
        pytest.param(
            *("space", None, {"start": "clamped", "end": "swivel", "effects": (ClampRotation(),)}),
            marks=pytest.mark.long,
        ),
        ("space", None, {"start": "swivel", "end": "clamped", "effects": (ClampCompliance(),)}),
        ("space", None, {"start": "swivel", "end": "swivel"}),
    ],
    ids=[
        *("plane, clamps that give way", "plane, a branch", "space"),
        *("space, a swivel at the end", "space, a swivel that gives way", "space, swivels"),
    ],
)
def test_external_is_the_function_and_its_jacobian(tmp_path, where, branch, options):
    model, p, rest = cable(where, **options)
    library = compile_library(generate(model, p, rest.ravel(), "wire"), tmp_path, QUICK)
    name = f"wire_cable_{branch}" if branch else "wire_cable"
    external, pose = ca.external(name, str(library)), POSES[where]
    function = CasadiCable(model, p, rest.ravel()).function(branch=branch)
    names, common = function.name_out(), external.name_out()
    in_python = {"curvature", "start_force", "start_moment"}
    assert common == [name for name in names if name not in in_python]
    known = dict(zip(names, function(pose), strict=True))
    slopes = dict(zip(names, function.jacobian()(pose, *function(pose)), strict=True))
    found = external(pose)
    for name, value, slope in zip(common, found, external.jacobian()(pose, *found), strict=True):
        np.testing.assert_allclose(np.array(value), np.array(known[name]), atol=1e-9)
        expected = np.array(slopes[name])
        scale = max(float(np.abs(expected).max()), 1.0)
        np.testing.assert_allclose(np.array(slope), expected, atol=1e-8 * scale)
    again = ca.Function.deserialize(external.serialize())
    np.testing.assert_array_equal(np.array(again(pose)[0]), np.array(found[0]))

    far = pose.copy()
    far[model.node.dimension] = 2.0
    *outs, status = external(far)
    *slopes_far, of_status = external.jacobian()(far, *outs, status)
    assert status == 1
    assert all(np.isnan(np.array(out)).all() for out in (*outs, *slopes_far))
    assert not np.array(of_status).any()


def test_an_optimiser_needs_no_python(tmp_path):
    """The same optimum as of `CasadiCable.function`, with an approximate Hessian."""
    model, p, rest = cable("plane", start="clamped", end="clamped")
    library = compile_library(generate(model, p, rest.ravel()), tmp_path, QUICK)
    options = {"print_time": False, "ipopt.print_level": 0, "ipopt.sb": "yes"}
    ends = []
    for function, hessian in (
        (ca.external("dlo_cable", str(library)), "limited-memory"),
        (CasadiCable(model, p, rest.ravel()).function(), "exact"),
    ):
        end = ca.MX.sym("end", 2)
        energy = function(ca.vertcat(0, 0, end, 0.3, -0.4))[3]
        problem = {"x": end, "f": energy, "g": ca.sumsqr(end)}
        solver = ca.nlpsol(
            "solver", "ipopt", problem, options | {"ipopt.hessian_approximation": hessian}
        )
        ends.append(np.array(solver(x0=[0.3, -0.4], lbg=0.25, ubg=0.25)["x"]).ravel())
        assert solver.stats()["success"]
    np.testing.assert_allclose(*ends, atol=1e-6)


def test_the_search_in_c_knows_tethers(tmp_path):
    """Their forces come from C; in Python their places are those of the cable."""
    effects = (AxialStretch(), Tether(), Tether(label="tether_2"))
    model, p, rest = cable("plane", start="clamped", effects=effects)
    for name, value in {
        "tether.stiffness": 3.0,
        "tether.position": 0.3,
        "tether_2.stiffness": 0.0,
        "tether_2.position": 0.6,
    }.items():
        p[model.names.index(name)] = value
    library = compile_library(generate(model, p, rest.ravel()), tmp_path, QUICK)
    known, u = CasadiCable(model, p, rest.ravel()), ca.MX.sym("u", 6)
    found = []
    for search in (None, ca.external("dlo_equilibrium", str(library))):
        outs = ca.veccat(*known.function(search=search)(u))
        every = ca.Function("every", [u], [outs, ca.jacobian(outs, u)])
        found.append([np.array(value) for value in every(POSES["plane"])])
    for by_python, by_c in zip(*found, strict=True):
        np.testing.assert_allclose(by_c, by_python, atol=1e-8 * np.abs(by_python).max())


@pytest.fixture(scope="module")
def in_c(tmp_path_factory):
    """A cable in space, and the search for its equilibria in C."""
    model, p, rest = cable("space", start="clamped", end="clamped", effects=(ClampRotation(),))
    folder = tmp_path_factory.mktemp("solver")
    library = compile_library(generate(model, p, rest.ravel()), folder, QUICK)
    return CasadiCable(model, p, rest.ravel()), ca.external("dlo_equilibrium", str(library))


def test_with_the_search_in_c_the_function_is_serialised_and_has_both_derivatives(in_c):
    known, search = in_c
    function = known.function()
    compiled = ca.Function.deserialize(known.function(search=search).serialize())
    pose, u = POSES["space"], ca.MX.sym("u", 15)
    found = []
    for shape in (compiled, function):
        outs = ca.veccat(*shape(u))
        sums = ca.dot(np.random.default_rng(0).normal(size=outs.numel()), outs)
        hessian, gradient = ca.hessian(sums, u)
        found.append(ca.Function("all", [u], [outs, gradient, hessian])(pose))
    for by_c, by_python in zip(*found, strict=True):
        scale = float(ca.norm_inf(by_python))
        np.testing.assert_allclose(np.array(by_c), np.array(by_python), atol=1e-8 * scale)


def test_the_search_of_another_cable_gives_no_number(in_c):
    known, search = in_c
    softer = CasadiCable(known.model, 0.9 * known.p, known.rest).function(search=search)
    *outs, status = softer(POSES["space"])
    assert status == 6
    assert all(np.isnan(np.array(out)).all() for out in outs)
    finer = CasadiCable(known.model.with_mesh(8), known.p, np.zeros(24))
    for refused, options, words in (
        (finer, {}, "search has inputs and outputs of the sizes"),
        (known, {"parameters": True}, "leave out `parameters` and `branch`"),
    ):
        with pytest.raises(DloError, match=words):
            refused.function(search=search, **options)
