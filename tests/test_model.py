"""CableModel: composition slot by slot, stretch by two routes, derivatives, messages."""

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest

from dlo_casadi.assembly import DEVIATIONS
from dlo_casadi.effects import (
    AxialStretch,
    Cable,
    GravityTilt,
    LengthError,
    LumpedMass,
    PointForce,
    RestCurvatureDrift,
    SideLoad,
    StiffnessGradient,
    StiffSection,
)
from dlo_casadi.equilibrium import Pose, solve_equilibrium
from dlo_casadi.errors import DloError
from dlo_casadi.model import CableModel

CABLE = Cable(length=1.2, mass=0.3, diameter=0.01, bending_stiffness=0.02)
WEIGHT = 9.81 * CABLE.mass  # N
STILL = np.zeros(len(DEVIATIONS))
ALL = pytest.mark.parametrize("element", ["quadratic", "arc", "link"])


def arguments(model: CableModel, p: np.ndarray, pose: Pose, scale: float = 0.4):
    """Headings, multipliers and rest curvature without any symmetry."""
    rng = np.random.default_rng(0)
    phi = rng.normal(scale=scale, size=model.chain.n_headings)
    lam = rng.normal(size=model.n_conditions)
    rest = rng.normal(size=model.chain.n_cells)
    return phi, lam, p, rest, pose.vector, STILL


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


def test_end_conditions_of_each_boundary():
    """An arc's nodal heading is held by a condition, a link's clamp by its half cell."""
    for element, names in (
        ("arc", ("end_position_x", "end_position_y", "start_heading", "end_heading")),
        ("link", ("end_position_x", "end_position_y")),
    ):
        clamped = CableModel(CABLE, n=4, element=element, start="clamped", end="clamped")
        assert clamped.condition_names == names
        assert clamped.n_conditions == len(names)
    free = CableModel(CABLE, n=4, start="clamped", end="free")
    assert free.condition_names == ("start_heading",)
    assert free.deviations == ("start_heading",)
    assert CableModel(CABLE, n=4).deviations == ("end_x", "end_y")


# The halves of a quadratic element have factors of their own: not for those.
@pytest.mark.parametrize("element", ["arc", "link"])
def test_section_laws_multiply(element):
    """A taper on top of a stiff section: each factor alone, times the other."""
    laws = (StiffnessGradient(), StiffSection())
    values = {0: [0.3], 1: [0.2, 0.7, 3.0]}
    pose = Pose((0.0, 0.0), (0.9, 0.1))

    def bending(effects, own) -> np.ndarray:
        """Second derivative of the weightless energy by headings and rest curvature."""
        model = CableModel(CABLE, 6, element, gravity=(0.0, 0.0), effects=effects)
        phi, lam, *others = arguments(model, np.array([0.02, *own]), pose)
        _, by_rest, _ = model.sensitivity(phi, 0 * lam, *others)
        return np.array(by_rest)

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
    exact = (CABLE.mass + 0.1) * gravity + [0.3, -0.4] + 0.25 * np.array([CABLE.length, 0.0])
    np.testing.assert_allclose(np.array(model.dead_load(p)).ravel(), exact, rtol=1e-13)


# ---- stretch -----------------------------------------------------------------------------------


@ALL
def test_condensed_stretch_equals_the_minimisation_over_axial_strains(element):
    """Two routes: IPOPT over headings and axial strains; the Lagrangian of headings alone."""
    model = CableModel(CABLE, n=6, element=element, effects=(AxialStretch(), LumpedMass()))
    p = np.array([0.02, 0.02, 0.4, 0.5])  # EA = 50 N: 3 % of strain
    rest = np.full(model.chain.n_cells, 0.8)
    pose = Pose((0.0, 0.0), (1.1, -0.2))
    found = solve_equilibrium(model, p, rest, pose)
    assert found.stable
    state = (found.phi, found.multipliers, p, rest, pose.vector, STILL)
    balance, _ = model.kkt(*state)
    # IPOPT's tol of 1e-11 on gradients of order one, scaled.
    assert np.abs(np.array(balance)).max() < 1e-7

    x, parameters, energy, conditions = model.potential
    solver = ca.nlpsol(
        "axial",
        "ipopt",
        {"x": x, "p": parameters, "f": energy, "g": conditions},
        {"print_time": False, "ipopt.print_level": 0, "ipopt.sb": "yes", "ipopt.tol": 1e-11},
    )
    x0 = np.concatenate([found.phi + 0.05, np.zeros(model.n_inner)])
    values = np.concatenate([p, rest, pose.vector, STILL])
    direct = solver(x0=x0, p=values, lbg=0, ubg=0)
    assert solver.stats()["success"]
    assert float(direct["f"]) == pytest.approx(found.energy, abs=1e-9)
    np.testing.assert_allclose(np.array(direct["lam_g"]).ravel(), found.lam, atol=1e-6)
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
    found = solve_equilibrium(model, np.array([0.02, compliance]), rest, Pose((0.1, 0.2)))
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
    pose = Pose((0.0, 0.0), (0.8, 0.1))
    stiff = solve_equilibrium(model, np.array([0.02, 0.0]), rest, pose)
    exact = solve_equilibrium(bare, np.array([0.02]), rest, pose)
    np.testing.assert_allclose(stiff.points, exact.points, atol=1e-8)  # IPOPT's tol


def test_a_longer_cable_of_the_same_mass():
    """A length difference is the same as a cable declared longer."""
    longer = replace(CABLE, length=CABLE.length + 0.03)
    model = CableModel(CABLE, n=8, effects=(LengthError(),))
    direct = CableModel(longer, n=8)
    pose = Pose((0.0, 0.0), (0.9, 0.1), branch="ccw")
    rest = np.full(8, 0.6)
    one = solve_equilibrium(model, np.array([0.02, 0.03]), rest, pose)
    other = solve_equilibrium(direct, np.array([0.02]), rest, pose)
    np.testing.assert_allclose(one.points, other.points, atol=1e-8)  # IPOPT's tol
    assert one.energy == pytest.approx(other.energy, abs=1e-9)


# ---- derivatives -------------------------------------------------------------------------------


@ALL
@pytest.mark.parametrize("boundary", [("pinned", "pinned"), ("clamped", "clamped")])
def test_jacobians_of_the_balance_and_of_the_measured_curve(element, boundary):
    """By headings, multipliers, rest curvature and deviations, against central differences."""
    effects = (AxialStretch(), LumpedMass(), RestCurvatureDrift())
    model = CableModel(CABLE, 4, element, *boundary, effects=effects)
    p = np.array([0.02, 0.02, 0.1, 0.5, 0.2])
    pose = Pose((0.0, 0.0), (0.9, 0.1), start_heading=0.2, end_heading=-0.3)
    inputs = list(arguments(model, p, pose))
    _, matrix = model.kkt(*inputs)
    _, by_rest, by_deviation = model.sensitivity(*inputs)
    _, by_x, by_p, z_by_rest, z_by_deviation = model.observation(*inputs)
    _, next_by_phi, next_by_rest, _ = model.next_rest(*inputs)

    def central(name: str, which: int) -> np.ndarray:
        columns = []
        for step in 1e-6 * np.eye(len(inputs[which])):
            ahead, behind = list(inputs), list(inputs)
            ahead[which], behind[which] = inputs[which] + step, inputs[which] - step
            difference = getattr(model, name)(*ahead)[0] - getattr(model, name)(*behind)[0]
            columns.append(np.array(difference).ravel() / 2e-6)
        return np.array(columns).T

    by_unknowns = np.hstack([central("kkt", 0), central("kkt", 1)])
    z_by_unknowns = np.hstack([central("observation", 0), central("observation", 1)])
    # Central differences: third derivatives times 1e-12 / 6, rounding 1e-15 / 1e-6.
    for exact, approximate in (
        (matrix, by_unknowns),
        (by_rest, central("kkt", 3)),
        (by_deviation, central("kkt", 5)),
        (by_x, z_by_unknowns),
        (by_p, central("observation", 2)),
        (z_by_rest, central("observation", 3)),
        (z_by_deviation, central("observation", 5)),
        (next_by_phi, central("next_rest", 0)),
        (next_by_rest, central("next_rest", 3)),
    ):
        np.testing.assert_allclose(np.array(exact), approximate, rtol=1e-6, atol=1e-7)
    np.testing.assert_allclose(np.array(matrix), np.array(matrix).T, atol=1e-13)


def test_observation_of_arcs_and_links():
    """Columns x, y of the nodes, and for arcs dx/ds, dy/ds; `energy` gives the same nodes."""
    pose = Pose((0.1, 0.2), (0.9, 0.1))
    for element, columns in (("quadratic", 4), ("arc", 4), ("link", 2)):
        model = CableModel(CABLE, n=4, element=element)
        inputs = arguments(model, np.array([0.02]), pose)
        z = np.array(model.shape(*inputs)).reshape(columns, -1).T
        _, nodes = model.energy(*inputs)
        np.testing.assert_array_equal(z[:, :2], np.array(nodes))
        if columns == 4:
            phi = inputs[0]
            np.testing.assert_allclose(z[:, 2:], np.stack([np.cos(phi), np.sin(phi)], axis=1))
