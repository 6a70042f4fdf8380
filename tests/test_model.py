"""CableModel: composition kind by kind, loads, stretch by two routes, messages."""

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from perturbed import any_rest, any_shapes, directions

from dlo_casadi.effects import (
    AxialStretch,
    CableData,
    GravityTilt,
    LengthError,
    LumpedMass,
    PointForce,
    SideLoad,
    StiffnessGradient,
    StiffSection,
)
from dlo_casadi.equilibrium.pose import HeldPose
from dlo_casadi.equilibrium.solve import solve_equilibrium
from dlo_casadi.errors import DloError
from dlo_casadi.model.assembly import Assembly, Inputs, Shapes
from dlo_casadi.model.cable_model import CableModel
from dlo_casadi.model.functions import functions_of
from dlo_casadi.model.tolerances import Tolerances
from dlo_casadi.model.whole_pose import potential
from dlo_casadi.rod.ends import deviation_names
from dlo_casadi.rod.node import Heading

CABLE = CableData(length=1.2, mass=0.3, diameter=0.01, bending_stiffness=0.02)
WEIGHT = 9.81 * CABLE.mass  # N
STILL = np.zeros(len(deviation_names(Heading)))
ALL = pytest.mark.parametrize("element", ["quadratic", "arc", "link"])


def given(model: CableModel, p: np.ndarray, rest: np.ndarray) -> Inputs:
    return Inputs.of(p, rest, HeldPose((0.0, 0.0), (0.9, 0.1)).vector[None])


# ---- composition -------------------------------------------------------------------------------


def test_two_effects_of_one_label_are_an_error_that_names_them():
    with pytest.raises(DloError, match=r"both labelled 'lumped_mass'.*label='lumped_mass_2'"):
        CableModel(CABLE, effects=(LumpedMass(), LumpedMass()))
    with pytest.raises(DloError, match=r"both labelled 'clip'"):
        CableModel(CABLE, effects=(LumpedMass(label="clip"), PointForce(label="clip")))
    two = CableModel(CABLE, effects=(LumpedMass(), LumpedMass(label="clip")))
    assert two.names == (
        "bending_stiffness",
        "lumped_mass.mass",
        "lumped_mass.position",
        "clip.mass",
        "clip.position",
    )
    with pytest.raises(DloError, match="lumped_mass"):
        two.with_effect(LumpedMass())


def test_models_are_immutable():
    model = CableModel(CABLE)
    heavier = model.with_effect(LumpedMass(), priors={"lumped_mass.mass": 0.01})
    assert model.names == ("bending_stiffness",)
    assert heavier.parameters[1].prior_std == 0.01
    assert heavier.without_effect("lumped_mass") == model
    coarse = heavier.with_mesh(7, "link")
    assert (coarse.n, coarse.element, coarse.effects) == (7, "link", heavier.effects)
    assert heavier.n == 40


def test_deviations_have_the_tolerances_of_what_deviates():
    """Nothing is known of unknown forces."""
    known, none = Tolerances(end=1e-3, heading=2e-2, rotation=3e-3, clip=4e-3), np.inf
    clipped = CableModel(CABLE, clips=("pinned", "eyelet"))
    expected = [1e-3] * 2 + [2e-2] * 2 + [none] * 2 + [0.02 * clipped.cable.length] + [4e-3] * 4
    assert known.deviation(clipped).tolist() == expected
    assert len(clipped.deviation_names) == len(expected)
    loom = CableModel(replace(CABLE, torsional_stiffness=0.01), gravity=(0.0, 0.0, -9.81))
    free = 0.02 * loom.cable.length
    assert known.deviation(loom).tolist() == [1e-3] * 3 + [3e-3] * 6 + [none] * 3 + [free]


@ALL
def test_end_conditions_of_each_boundary(element):
    """A clamp holds the heading of a node: of links, of one of its own."""
    clamped = CableModel(CABLE, n=4, element=element, start="clamped", end="clamped")
    names = ("end_position_x", "end_position_y", "start_heading", "end_heading")
    assert clamped.condition_names == names
    assert len(clamped.condition_names) == 4
    free = CableModel(CABLE, n=4, element=element, start="clamped", end="free")
    assert free.condition_names == ("start_heading",)
    assert free.deviations == ("start_heading",)
    pinned = CableModel(CABLE, n=4, element=element)
    assert pinned.condition_names == ("end_position_x", "end_position_y")
    assert pinned.deviations == ("end_x", "end_y")


# The halves of a quadratic element have factors of their own: not for those.
@pytest.mark.parametrize("element", ["arc", "link"])
def test_section_laws_multiply(element):
    """A taper on top of a stiff section: each factor alone, times the other."""
    laws = (StiffnessGradient(), StiffSection())
    values = {0: [0.3], 1: [0.2, 0.7, 3.0]}

    def bending(effects, own) -> np.ndarray:
        """Second derivative of the weightless energy by headings and rest curvature."""
        model = CableModel(CABLE, 6, element, gravity=(0.0, 0.0), effects=effects)
        shapes = replace(any_shapes(model), lam=np.zeros((1, model.n_border)))
        where = given(model, np.array([0.02, *own]), any_rest(model)[0])
        return Assembly(model, shapes, where).balance_along(directions(model, 1, "rest")).x

    plain = bending((), [])
    first, second = bending(laws[:1], values[0]), bending(laws[1:], values[1])
    both = bending(laws, values[0] + values[1])
    used = np.abs(plain) > 1e-12
    assert used.any()
    # Rounding.
    np.testing.assert_allclose(both[used] * plain[used], first[used] * second[used], rtol=1e-9)


@ALL
def test_dead_load_is_all_that_hangs_on_the_cable(element):
    effects = (LumpedMass(), PointForce(), SideLoad(), GravityTilt())
    model = CableModel(CABLE, n=5, element=element, effects=effects)
    p = np.array([0.02, 0.1, 0.5, 0.3, -0.4, 0.7, 0.25, 0.2])
    gravity = 9.81 * np.array([np.sin(0.2), -np.cos(0.2)])
    across = np.array([np.cos(0.2), np.sin(0.2)])
    exact = (CABLE.mass + 0.1) * gravity + [0.3, -0.4] + 0.25 * CABLE.length * across
    np.testing.assert_allclose(
        np.array(functions_of(model).dead_load(p)).ravel(), exact, rtol=1e-13
    )


@pytest.mark.parametrize("element", ["arc", "link"])
def test_weight_hangs_on_the_centre_of_gravity(element):
    """V = -m g . (1/L) int r ds, with r(s) from headings by fine sums; arcs bend no other way."""
    heavy, light = (CableModel(CABLE, 5, element, gravity=g) for g in ((2.0, -9.0), (0.0, 0.0)))
    chain = heavy.chain
    shapes, where = any_shapes(heavy), given(heavy, heavy.nominal, np.zeros(chain.n_cells))
    energy = [Assembly(m, shapes, where).energy()[0] for m in (heavy, light)]
    s = (np.arange(20000) + 0.5) * CABLE.length / 20000
    phi = shapes.x[0, :, 0]
    if element == "arc":
        heading = np.interp(s, chain.places, phi)
    else:
        heading = phi[(s / chain.h).astype(int)]
    step = CABLE.length / 20000 * np.stack([np.cos(heading), np.sin(heading)], axis=1)
    center = (np.cumsum(step, axis=0) - step / 2).mean(axis=0)
    exact = -CABLE.mass * np.array([2.0, -9.0]) @ center
    # The sums err by 1e-9; three Gauss points by (L/n) d^6 / 2e6 for turns of d < 0.9, times m g.
    assert energy[0] - energy[1] == pytest.approx(exact, abs=3e-7)


# ---- stretch -----------------------------------------------------------------------------------


@ALL
def test_condensed_stretch_equals_the_minimisation_over_axial_strains(element):
    """Two routes: IPOPT over headings and axial strains; the Lagrangian of headings alone."""
    model = CableModel(CABLE, n=6, element=element, effects=(AxialStretch(), LumpedMass()))
    p = np.array([0.02, 0.02, 0.4, 0.5])  # EA = 50 N: 3 % of strain
    rest = np.full(model.chain.n_cells, 0.8)
    pose = HeldPose((0.0, 0.0), (1.1, -0.2))
    found = solve_equilibrium(model, p, rest, pose)
    assert found.stable
    where = Inputs.of(p, rest, pose.vector[None])
    shapes = Shapes.declared(found.x[None], found.multipliers[None])
    # Newton's last step leaves the rounding of terms of order one.
    assert np.abs(Assembly(model, shapes, where).balance()[1].rows).max() < 1e-11

    problem = potential(model)
    solver = ca.nlpsol(
        "axial",
        "ipopt",
        {
            "x": problem.coordinates,
            "p": problem.parameters,
            "f": problem.energy,
            "g": problem.conditions,
        },
        {"print_time": False, "ipopt.print_level": 0, "ipopt.sb": "yes", "ipopt.tol": 1e-11},
    )
    x0 = np.concatenate([found.phi + 0.05, np.zeros(model.n_inner * model.chain.n_segments)])
    values = np.concatenate([p, rest, pose.vector, STILL])
    direct = solver(x0=x0, p=values, lbg=0, ubg=0)
    assert solver.stats()["success"]
    assert float(direct["f"]) == pytest.approx(found.energy, abs=1e-9)
    np.testing.assert_allclose(np.array(direct["lam_g"]).ravel(), found.end_force, atol=1e-6)
    # The condensed curve carries the strains: it ends where the end is held.
    np.testing.assert_allclose(found.points[-1], pose.end, atol=1e-8)
    lengths = np.hypot(*np.diff(found.points, axis=0).T)
    assert lengths.sum() > CABLE.length  # chords of a stretched cable


@ALL
def test_stretch_of_a_hanging_cable(element):
    """A cable that hangs straight down gets longer by w L^2 / (2 EA)  [any statics text]."""
    model = CableModel(CABLE, n=5, element=element, end="free", effects=(AxialStretch(),))
    compliance = 0.01  # 1/EA [1/N]
    rest = np.zeros(model.chain.n_cells)
    found = solve_equilibrium(model, np.array([0.02, compliance]), rest, HeldPose((0.1, 0.2)))
    longer = CABLE.length + compliance * WEIGHT * CABLE.length / 2
    # The tension of every element is that in its middle: exact for a linear one.
    np.testing.assert_allclose(found.points[-1], [0.1, 0.2 - longer], atol=1e-8)
    # Energy: of the weight's stretched position, and half the work of the stretch.
    fall = WEIGHT * (0.2 - CABLE.length / 2)
    stored = compliance * WEIGHT**2 * CABLE.length / 6
    midpoint = stored * (1 - 1 / (4 * 5**2))  # int N^2 ds with N of each element's middle
    assert found.energy == pytest.approx(fall - midpoint, abs=1e-9)


@ALL
def test_a_stiff_axis_is_an_inextensible_cable(element):
    model = CableModel(CABLE, n=6, element=element, effects=(AxialStretch(),))
    bare = CableModel(CABLE, n=6, element=element)
    rest = np.full(model.chain.n_cells, 0.5)
    pose = HeldPose((0.0, 0.0), (0.8, 0.1))
    stiff = solve_equilibrium(model, np.array([0.02, 0.0]), rest, pose)
    exact = solve_equilibrium(bare, np.array([0.02]), rest, pose)
    np.testing.assert_allclose(stiff.points, exact.points, atol=1e-8)  # IPOPT's tol


def test_a_longer_cable_of_the_same_mass():
    """A length difference is the same as a cable declared longer."""
    longer = replace(CABLE, length=CABLE.length + 0.03)
    model = CableModel(CABLE, n=8, effects=(LengthError(),))
    direct = CableModel(longer, n=8)
    pose = HeldPose((0.0, 0.0), (0.9, 0.1), branch="ccw")
    rest = np.full(8, 0.6)
    one = solve_equilibrium(model, np.array([0.02, 0.03]), rest, pose)
    other = solve_equilibrium(direct, np.array([0.02]), rest, pose)
    np.testing.assert_allclose(one.points, other.points, atol=1e-8)  # IPOPT's tol
    assert one.energy == pytest.approx(other.energy, abs=1e-9)
