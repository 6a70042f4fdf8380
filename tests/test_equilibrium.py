"""Equilibria against closed forms, an independent integrator and balances."""

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
import yaml
from scipy.integrate import solve_bvp
from scipy.optimize import brentq
from scipy.special import ellipe, ellipk

from dlo_casadi.config import load_config
from dlo_casadi.effects import (
    AxialStretch,
    CableData,
    EndOffset,
    EndSpring,
    LengthError,
    LumpedMass,
    PointForce,
    StiffnessGradient,
)
from dlo_casadi.equilibrium.batch import BatchEquilibrium
from dlo_casadi.equilibrium.by_ipopt import by_ipopt
from dlo_casadi.equilibrium.equilibrium import Equilibrium
from dlo_casadi.equilibrium.guesses import arc_half_angle, guesses
from dlo_casadi.equilibrium.pose import HeldPose
from dlo_casadi.equilibrium.solve import coarse_rest, continued, solve_equilibria, solve_equilibrium
from dlo_casadi.errors import EquilibriumError
from dlo_casadi.model.assembly import Assembly, Inputs, Shapes
from dlo_casadi.model.cable_model import CableModel

DATA = Path(__file__).parent / "data"
ALL = pytest.mark.parametrize("element", ["quadratic", "arc", "link"])
WEIGHTLESS = (0.0, 0.0)  # m/s^2
MESHES = (10, 20, 40)


def solve(model: CableModel, stiffness: float, pose: HeldPose, rest: float = 0.0, **extra):
    """Equilibrium of a cable of constant rest curvature [1/m] without effects."""
    return solve_equilibrium(
        model, np.array([stiffness]), np.full(model.chain.n_cells, rest), pose, **extra
    )


def orders(errors: list) -> np.ndarray:
    return np.log2(np.divide(errors[:-1], errors[1:]))


# ---- closed forms, and the order of both elements ----------------------------------------------


@ALL
def test_limp_cable_converges_to_the_catenary(element):
    """L = 2a sinh(s/2a), sag = a (cosh(s/2a) - 1), H = w a  [Irvine, Cable Structures, 1981]."""
    span, length, weight = 0.6, 1.0, 0.5  # m, m, N/m
    stiffness = 1e-8  # N m^2: changes sag and H by about EI / (w a^2 L) = 1e-7
    a = brentq(lambda a: 2 * a * np.sinh(span / (2 * a)) - length, 0.05, 10.0)
    exact = np.array([a * (np.cosh(span / (2 * a)) - 1), weight * a])  # sag [m], H [N]
    errors = []
    # Finer arcs and quadratic elements, of fourth order here, would show the effect of EI.
    for n in {"link": (16, 32, 64), "arc": (8, 16, 32), "quadratic": (8, 16)}[element]:
        model = CableModel(CableData(length, weight * length / 9.81, 0.005, stiffness), n, element)
        hung = solve(model, stiffness, HeldPose((0.0, 0.0), (span, 0.0), branch="ccw"))
        assert hung.stable
        found = np.array([-hung.points[:, 1].min(), -hung.end_force[0]])
        errors.append(np.linalg.norm(found - exact))
    # The end's pin is pulled inwards, and down by half of the weight (exact on any mesh).
    assert hung.end_force == pytest.approx([-exact[1], -weight * length / 2], rel=1e-3)
    assert np.all(orders(errors) > 1.9), f"measured orders {orders(errors)}"


def cantilever(stiffness: float, weight: float, length: float, heading: float):
    """Heavy rod clamped at its start: EI phi'' = w (L - s) cos phi, phi(0) given, phi'(L) = 0."""

    def slope(s, y):
        moment_slope = weight * (length - s) * np.cos(y[0])
        return np.array([y[1], moment_slope / stiffness, np.cos(y[0]), np.sin(y[0])])

    s = np.linspace(0.0, length, 101)
    guess = np.array([heading - s, -1 + 0 * s, s, -0.3 * s])
    found = solve_bvp(
        slope,
        lambda a, b: np.array([a[0] - heading, b[1], a[2], a[3]]),
        s,
        guess,
        tol=1e-10,
        max_nodes=10000,
    )
    assert found.success
    return found.sol


@ALL
def test_heavy_cantilever_against_an_integrator(element):
    """Shape at the middle and at the end, bending moment at the clamp; w L^3 / EI = 20."""
    stiffness, weight, length, heading = 0.05, 2.0, 0.8, 0.3  # N m^2, N/m, m, rad
    exact = cantilever(stiffness, weight, length, heading)
    errors = []
    for n in MESHES:
        cable = CableData(length, weight * length / 9.81, 0.01, stiffness)
        model = CableModel(cable, n, element, start="clamped", end="free")
        bent = solve(model, stiffness, HeldPose((0.0, 0.0), start_heading=heading))
        assert bent.stable
        np.testing.assert_allclose(bent.end_force, 0.0)
        gaps = [np.hypot(*(bent.points[k] - exact(k * length / n)[2:])) for k in (n // 2, n)]
        if element != "link":  # the clamp's moment: force times lever of the weight
            lever = weight * np.trapezoid(exact(np.linspace(0, length, 4001))[2], dx=length / 4000)
            gaps.append(abs(abs(bent.moments[0]) - lever))
        errors.append(gaps)
    assert np.all(orders(errors) > 1.9), f"measured orders {orders(errors)}"


def elastica(slope: float, length: float, stiffness: float) -> tuple[float, float, float]:
    """Span [m], sag [m] and thrust [N] of a weightless strip that leaves its pins at `slope`.

    k = sin(slope/2), P = EI (2K/L)^2, span = L (2E/K - 1), sag = L k/K  [Love, 1927, art. 263].
    """
    m = np.sin(slope / 2) ** 2
    k, e = ellipk(m), ellipe(m)
    thrust = stiffness * (2 * k / length) ** 2
    return length * (2 * e / k - 1), length * np.sqrt(m) / k, thrust


@ALL
@pytest.mark.parametrize("slope", [0.3, 1.0, 2.0])  # rad; at 2.0 the pins are close together
def test_pinned_elastica(element, slope):
    length, stiffness = 1.0, 0.3
    span, sag, thrust = elastica(slope, length, stiffness)
    errors = []
    for n in MESHES:
        model = CableModel(CableData(length, 0.1, 0.01, stiffness), n, element, gravity=WEIGHTLESS)
        bent = solve(model, stiffness, HeldPose((0.0, 0.0), (span, 0.0), branch="ccw"))
        assert bent.stable
        assert bent.end_force[1] == pytest.approx(0.0, abs=1e-8)  # IPOPT's tol, times EI / L^2
        errors.append([abs(bent.end_force[0] - thrust), abs(-bent.points[n // 2, 1] - sag)])
    assert np.all(orders(errors) > 1.9), f"measured orders {orders(errors)}"


def test_rest_curvature_alone_is_a_circle():
    """Nothing loads the cable: arcs are exact, chords of links converge at second order."""
    length, stiffness, kappa = 0.8, 0.05, 3.0
    tip = np.array([np.sin(kappa * length), 1 - np.cos(kappa * length)]) / kappa
    errors: dict[str, list[float]] = {"arc": [], "link": []}
    for element, gaps in errors.items():
        for n in MESHES:
            model = CableModel(
                CableData(length, 0.1, 0.01, stiffness), n, element, "clamped", "free", WEIGHTLESS
            )
            bent = solve(model, stiffness, HeldPose((0.0, 0.0), start_heading=0.0), kappa)
            assert bent.energy == pytest.approx(0.0, abs=1e-12)
            assert bent.min_bend_radius == pytest.approx(1 / kappa, rel=1e-6)
            gaps.append(float(np.hypot(*(bent.points[-1] - tip))))
    # An arc's three Gauss points: n h d^6 / 2e6 with elements that turn by d = 0.24.
    assert max(errors["arc"]) < 1e-9
    assert np.all(orders(errors["link"]) > 1.9), f"measured orders {orders(errors['link'])}"


def test_end_moment_gives_constant_curvature():
    """M = k (heading - phi(L)) and kappa = M / EI:  kappa = k heading / (EI + k L)."""
    length, stiffness, spring, heading = 0.8, 0.05, 0.2, 1.5
    kappa = spring * heading / (stiffness + spring * length)
    cable = CableData(length, 0.1, 0.01, stiffness)
    model = CableModel(cable, 6, "arc", "clamped", "free", WEIGHTLESS, effects=(EndSpring(),))
    p = np.array([stiffness, spring, heading])
    bent = solve_equilibrium(model, p, np.zeros(6), HeldPose((0.0, 0.0), start_heading=0.0))
    np.testing.assert_allclose(bent.curvature, kappa, rtol=1e-9)
    moment = stiffness * kappa
    assert abs(bent.moments[0]) == pytest.approx(moment, rel=1e-9)


@pytest.mark.parametrize(("element", "pieces"), [("arc", 1), ("quadratic", 2)])
def test_an_end_moment_bends_a_taper_by_the_sum_of_its_compliances(element, pieces):
    """phi(L) = M int ds / EI(s), by the midpoint rule: once in each element, or in its halves.

    The integral itself is L / (2 a EI) log((1 + a) / (1 - a)), of second order in the mesh.
    """
    length, stiffness, spring, heading, slope, n = 0.8, 0.05, 0.2, 1.5, 0.6, 6
    s = (np.arange(pieces * n) + 0.5) * length / (pieces * n)
    compliance = (length / stiffness / (1 + slope * (2 * s / length - 1))).mean()
    exact = length / (2 * slope * stiffness) * np.log((1 + slope) / (1 - slope))
    assert compliance == pytest.approx(exact, rel=0.03 / pieces**2)
    effects = (StiffnessGradient(), EndSpring())
    cable = CableData(length, 0.1, 0.01, stiffness)
    model = CableModel(cable, n, element, "clamped", "free", WEIGHTLESS, effects=effects)
    p = np.array([stiffness, slope, spring, heading])
    bent = solve_equilibrium(model, p, np.zeros(n), HeldPose((0.0, 0.0), start_heading=0.0))
    turn = compliance * spring * heading / (1 + compliance * spring)
    assert bent.turn == pytest.approx(turn, rel=1e-9)
    assert bent.moments[0] == pytest.approx(spring * (heading - turn), rel=1e-9)


# ---- bench poses against a fine mesh -----------------------------------------------------------


@cache
def bench(name: str, n: int, element: str, poses: int = 99) -> list[np.ndarray]:
    """Nodes of a session's poses with its true stiffness and rest curvature, no effects."""
    config = load_config(DATA / "bench" / name / "session.yaml")
    truth = yaml.safe_load((DATA / "bench_truth" / name / "truth.yaml").read_text())
    data, stiffness = config.cable, truth["bending_stiffness"]
    cable = CableData(data.length, data.mass, data.diameter, stiffness)
    model = CableModel(cable, n, element, gravity=config.experiment.gravity)
    places, kappa = (np.array(truth["rest_curvature"][key]) for key in ("s", "kappa"))
    rest = []
    for low, high in model.chain.cells:
        s = np.linspace(low, high, 101)
        rest.append(np.trapezoid(np.interp(s, places, kappa), s) / (high - low))
    held = [
        HeldPose(item.start, item.end, branch="ccw", name=item.name)
        for item in config.experiment.poses[:poses]
    ]
    found = solve_equilibria(model, np.array([stiffness]), np.array(rest), held)
    assert all(isinstance(eq, Equilibrium) for eq in found)
    return [eq.points for eq in found]


def node_error(name: str, n: int, element: str) -> float:
    """Largest error of a node [m] over all poses, against 80 elements at the same arc lengths."""
    fine = bench(name, 80, "quadratic")
    pairs = zip(bench(name, n, element), fine, strict=True)
    return max(np.hypot(*(coarse - exact[:: 80 // n]).T).max() for coarse, exact in pairs)


@pytest.mark.parametrize(
    "name", [pytest.param("taper", marks=pytest.mark.long), "thin", "long", "clamped"]
)
def test_ten_elements_are_five_times_closer_than_ten_links(name):
    """Also where the rest curvature has features as short as an element."""
    bowed, link = node_error(name, 10, "quadratic"), node_error(name, 10, "link")
    assert bowed < link / 5, f"quadratic {bowed * 1e3:.3f} mm, link {link * 1e3:.3f} mm"


@pytest.mark.parametrize("name", [pytest.param("taper", marks=pytest.mark.long), "orange"])
def test_elements_converge_on_bench_poses(name):
    """Second order of arcs and links, arcs closer; about fourth of quadratic elements."""
    meshes = {"quadratic": (10, 20, 40), "arc": (10, 20, 40), "link": (10, 20, 40)}
    errors = {e: [node_error(name, n, e) for n in ns] for e, ns in meshes.items()}
    assert errors["arc"][0] < errors["link"][0] / 1.8
    for element, gaps in errors.items():
        measured = np.log2(gaps[0] / gaps[-1]) / 2
        least = 3.0 if element == "quadratic" else 1.9
        assert measured > least, f"{element}: mean order {measured:.2f}, errors {gaps}"


def test_stiff_cable_on_a_fine_mesh():
    """EI/h = 30000 N m: IPOPT stops at rounding, which is no failure."""
    fine, coarse = (bench("weightless_fit", n, "arc", poses=4) for n in (320, 80))
    # Second order: 0.3 mm at n = 10 leaves 0.005 mm at n = 80.
    for one, other in zip(fine, coarse, strict=True):
        np.testing.assert_allclose(one[::4], other, atol=1e-5)


# ---- balances ----------------------------------------------------------------------------------

HEAVY = CableData(length=0.8, mass=0.25, diameter=0.01, bending_stiffness=0.1)


def hold(element: str, start=(0.0, 0.0), end=(0.5, 0.1)) -> Equilibrium:
    effects = (LumpedMass(), PointForce())
    model = CableModel(HEAVY, 10, element, effects=effects)
    p = np.array([0.1, 0.05, 0.3, 0.2, 0.4, 0.55])
    rest = np.full(model.chain.n_cells, 0.7)
    return solve_equilibrium(model, p, rest, HeldPose(start, end, branch="ccw"))


@ALL
def test_reactions_are_slopes_of_the_energy(element):
    """-lam = dV/d(end), -lam_start = dV/d(start), by central differences of solved energies."""
    held, d = hold(element), 1e-4
    assert held.stable
    for axis in (0, 1):
        step = d * np.eye(2)[axis]
        ends = [hold(element, end=tuple(np.array([0.5, 0.1]) + x)).energy for x in (step, -step)]
        starts = [hold(element, start=tuple(x)).energy for x in (step, -step)]
        # Third derivatives of order EI / L^4 ~ 0.1 to 10 N/m^2 times d^2 / 6, and energies good
        # to 1e-10 J over 2 d.
        assert -(ends[0] - ends[1]) / (2 * d) == pytest.approx(held.end_force[axis], abs=2e-6)
        assert -(starts[0] - starts[1]) / (2 * d) == pytest.approx(held.start_force[axis], abs=2e-6)


@ALL
def test_weight_and_reactions_sum_to_zero(element):
    """The holders carry what hangs on the cable: its weight, the lump's, the point force."""
    held = hold(element)
    loads = np.array([0.2, 0.4 - 9.81 * (HEAVY.mass + 0.05)])
    np.testing.assert_allclose(held.end_force + held.start_force, loads, atol=1e-10)


@ALL
def test_moments_about_the_start_sum_to_zero(element):
    """Pins hold no moment: that of the weight is that of the end's reaction."""
    model = CableModel(HEAVY, 16, element)
    held = solve(model, 0.1, HeldPose((0.0, 0.0), (0.6, -0.1)), rest=0.7)
    middles = (held.points[1:] + held.points[:-1]) / 2
    center = middles.mean(axis=0)
    if element != "link":  # Simpson's rule between neighbouring nodes
        x = held.points[:, 0]
        center = np.array([(x[0] + x[-1] + 4 * x[1::2].sum() + 2 * x[2:-1:2].sum()) / 48, 0.0])
    weight_moment = -9.81 * HEAVY.mass * center[0]
    end_moment = held.points[-1, 0] * held.end_force[1] - held.points[-1, 1] * held.end_force[0]
    # Links: exact up to IPOPT's tol. Others: Simpson's rule over 16 elements, h^4 x''' L / 180.
    assert end_moment == pytest.approx(weight_moment, abs=1e-8 if element == "link" else 1e-4)


def test_a_turned_board_gives_a_turned_shape():
    """Gravity, ends and shape turn together."""
    angle = 0.9
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    model = CableModel(HEAVY, 12)
    gravity = turn @ np.array(model.gravity)
    turned = CableModel(HEAVY, 12, gravity=(float(gravity[0]), float(gravity[1])))
    end = turn @ np.array([0.5, 0.1])
    one = solve(model, 0.1, HeldPose((0.0, 0.0), (0.5, 0.1), branch="ccw"), 0.7)
    other = solve(
        turned, 0.1, HeldPose((0.0, 0.0), (float(end[0]), float(end[1])), branch="ccw"), 0.7
    )
    np.testing.assert_allclose(other.points, one.points @ turn.T, atol=1e-8)  # IPOPT's tol
    np.testing.assert_allclose(other.end_force, turn @ one.end_force, atol=1e-7)
    assert other.energy == pytest.approx(one.energy, abs=1e-9)


# ---- stability and branches --------------------------------------------------------------------


@pytest.mark.parametrize(("share", "stable"), [(0.97, True), (1.03, False)])
def test_straight_strut_about_the_euler_load(share, stable):
    """A strut that can shorten stays straight below P = pi^2 EI / L^2 and buckles above it.

    EA = 1000 times that load: shortening changes it by 0.1 %, twenty arcs by 0.2 %.
    """
    length, stiffness = 1.0, 0.2
    euler = np.pi**2 * stiffness / length**2
    model = CableModel(
        CableData(length, 0.1, 0.01, stiffness), 20, gravity=WEIGHTLESS, effects=(AxialStretch(),)
    )
    p = np.array([stiffness, 1 / (1000 * euler)])
    end = (length * (1 - share / 1000), 0.0)
    straight = solve_equilibrium(
        model, p, np.zeros(20), HeldPose((0.0, 0.0), end), x_init=np.zeros((21, 1))
    )
    np.testing.assert_allclose(straight.phi, 0.0, atol=1e-8)
    assert straight.end_force[0] == pytest.approx(share * euler, rel=1e-6)
    assert straight.stable is stable


@pytest.mark.parametrize("ratio", [0.0, 0.1, 0.5, 0.9, 0.99, 0.9999])
def test_the_arc_of_a_first_guess_has_the_length_of_the_cable(ratio):
    """sin(a) / a = chord / length; a chord longer than the cable has no arc."""
    exact = brentq(lambda a: np.sinc(a / np.pi) - ratio, 1e-9, 3.2)
    assert arc_half_angle(0.8 * ratio, 0.8) == pytest.approx(exact, abs=3e-4)
    assert arc_half_angle(0.81, 0.8) == 0.0


@ALL
@pytest.mark.parametrize("rest", [0.0, 2.0])
def test_a_shape_that_nothing_turns_back_is_not_stable(element, rest):
    """Without weight, a cable on one pin turns about it at no cost."""
    model = CableModel(HEAVY, 8, element, end="free", gravity=WEIGHTLESS)
    held = solve(model, 0.1, HeldPose((0.0, 0.0)), rest)
    assert not held.stable


def test_second_mode_is_flagged_and_avoided():
    """A strip bent to an S is in balance but not stable; on its own the solver bends it to a C."""
    model = CableModel(CableData(1.0, 0.1, 0.01, 0.3), 16, gravity=WEIGHTLESS)
    pose = HeldPose((0.0, 0.0), (0.8, 0.0))
    s = model.chain.places
    bent = 0.9 * np.cos(2 * np.pi * s)
    double = by_ipopt(model, np.array([0.3]), np.zeros(len(model.chain.cells)), pose, bent)
    assert double is not None
    assert not double.stable
    np.testing.assert_allclose(double.points[8], [0.4, 0.0], atol=1e-6)  # odd about its middle
    single = solve(model, 0.3, pose)
    assert single.stable
    # The second mode thrusts four times as hard as the first; both bend equally far, nearly.
    assert double.end_force[0] > 3.5 * single.end_force[0]
    assert double.energy > 3.5 * single.energy


def test_two_branches_of_a_stiff_curved_cable():
    """Bowed along its rest curvature or against it: both in balance, the first one lower."""
    model = CableModel(CableData(0.8, 0.05, 0.01, 2.0), 16)
    ends = {"start": (0.0, 0.0), "end": (0.6, 0.1)}
    along, against = (solve(model, 2.0, HeldPose(**ends, branch=b), 0.8) for b in ("ccw", "cw"))
    assert along.stable
    assert against.stable
    assert along.phi[-1] > along.phi[0]
    assert against.phi[-1] < against.phi[0]
    assert along.energy < against.energy
    free = solve(model, 2.0, HeldPose(**ends), 0.8)
    assert free.energy == pytest.approx(along.energy, abs=1e-9)  # the lower of the two


LIMP = CableData(0.8, 0.2, 0.01, 0.005)


@pytest.mark.parametrize(("kind", "headings"), [("pinned", (None, None)), ("clamped", (-1.0, 1.0))])
def test_a_branch_without_an_equilibrium_is_refused_and_the_other_named(kind, headings):
    """A limp cable hangs: it turns counter-clockwise, and does not stand up."""
    model = CableModel(LIMP, 12, start=kind, end=kind)
    ends = {"start": (0.0, 0.0), "end": (0.5, 0.0), "name": "pose_03"}
    pose = HeldPose(**ends, start_heading=headings[0], end_heading=headings[1])
    hung = solve(model, 0.005, pose)
    assert solve(model, 0.005, replace(pose, branch="ccw")).phi == pytest.approx(hung.phi)
    message = (
        r"pose_03: no stable equilibrium found on the branch cw .* with its end at \(0.5, 0.0\) m: "
        rf"the lowest one, of {hung.energy:.4g} J, turns by \+{hung.turn:.3g} rad .*\(branch ccw\)"
    )
    with pytest.raises(EquilibriumError, match=message):
        solve(model, 0.005, replace(pose, branch="cw"))


@pytest.mark.parametrize(("branch", "sign"), [("ccw", 1), ("cw", -1)])
def test_a_branch_beside_one_clamp_is_the_lowest_that_turns_so(branch, sign):
    """The pinned end may come round on either side; the cable itself takes the lower way."""
    model = CableModel(LIMP, 12, start="clamped", end="pinned")
    pose = HeldPose((0.0, 0.0), (0.5, 0.0), start_heading=-1.0)
    held = solve(model, 0.005, replace(pose, branch=branch))
    assert held.stable
    assert sign * held.turn > 0
    assert solve(model, 0.005, pose).energy <= held.energy


def test_the_other_way_around_a_clamp_is_found():
    """A limp cable between clamps: 0.157 J folded up to a joint's bound, half of that unfolded."""
    model = CableModel(CableData(1.0, 0.1, 0.005, 3e-3), 20, start="clamped", end="clamped")
    held = solve(model, 3e-3, HeldPose((0.0, 0.0), (-0.695, -0.071), -1.74, 1.17))
    assert held.stable
    assert not held.bound_multipliers.any()
    assert held.energy < 0.08


# ---- special poses -----------------------------------------------------------------------------


def test_clamped_loop_of_a_real_wire():
    """White electric wire: 1.5 m from clamp to clamp, turning once clockwise on its way."""
    stiffness = 1.2e-4
    model = CableModel(
        CableData(1.5, 0.0261, 0.0027, stiffness), 40, "arc", start="clamped", end="clamped"
    )
    pose = HeldPose((0.0, 0.0), (-0.12, 0.0), start_heading=0.0, end_heading=-2 * np.pi)
    loop = solve(model, stiffness, pose)
    assert loop.stable
    np.testing.assert_allclose(loop.phi[[0, -1]], [0.0, -2 * np.pi], atol=1e-8)
    np.testing.assert_allclose(loop.points[-1], pose.end, atol=1e-8)
    # It mirrors about the middle between the clamps, and hangs below them.
    mirrored = loop.points[::-1] * [-1, 1] + [-0.12, 0.0]
    np.testing.assert_allclose(loop.points, mirrored, atol=1e-6)
    assert -0.75 < loop.points[:, 1].min() < -0.5
    # Uniform rest curvature multiplies the fixed turning: it drops out of the shape.
    other = solve(model, stiffness, pose, rest=-3.0)
    np.testing.assert_allclose(other.points, loop.points, atol=1e-6)


@ALL
def test_both_ends_at_one_place(element):
    """A loop that hangs from one nail, symmetric about the vertical through it."""
    model = CableModel(CableData(0.8, 0.2, 0.01, 0.01), 20, element)
    loop = solve(model, 0.01, HeldPose((0.2, 0.1), (0.2, 0.1)))
    assert loop.stable
    np.testing.assert_allclose(loop.points[-1], [0.2, 0.1], atol=1e-8)
    np.testing.assert_allclose(
        loop.points, loop.points[::-1] * [-1, 1] + [0.4, 0.0], atol=1e-6
    )  # a tangent matrix of condition 1e3 times IPOPT's tol
    assert loop.points[:, 1].min() < 0.1 - 0.25


@ALL
def test_free_cable_hangs_straight_down(element):
    model = CableModel(HEAVY, 8, element, end="free")
    hung = solve(model, 0.1, HeldPose((0.3, 0.5)))
    assert hung.stable
    np.testing.assert_allclose(hung.points[:, 0], 0.3, atol=1e-8)
    np.testing.assert_allclose(hung.points[-1], [0.3, 0.5 - HEAVY.length], atol=1e-8)
    np.testing.assert_array_equal(hung.end_force, 0.0)
    np.testing.assert_allclose(hung.start_force, [0.0, -9.81 * HEAVY.mass], atol=1e-12)


def test_a_joint_at_its_bound_is_reported():
    """Five links whose rest shape folds up are stopped at a right angle, by a moment."""
    model = CableModel(HEAVY, 5, "link", "clamped", "free", WEIGHTLESS)
    folded = solve(model, 0.1, HeldPose((0.0, 0.0), start_heading=0.0), rest=2.5 * np.pi / 2 / 0.16)
    np.testing.assert_allclose(np.abs(np.diff(folded.phi)), np.pi / 2, atol=1e-6)
    assert np.all(np.abs(folded.bound_multipliers) > 0.1)
    relaxed = solve(model, 0.1, HeldPose((0.0, 0.0), start_heading=0.0), rest=1.0)
    np.testing.assert_allclose(relaxed.bound_multipliers, 0.0, atol=1e-6)


@pytest.mark.parametrize(("bend", "stable"), [(0.49 * np.pi, True), (0.51 * np.pi, False)])
def test_among_many_poses_no_joint_is_bent_beyond_its_bound(bend, stable):
    """At rest in that shape: a minimum of the energy, of which only the bound may think less."""
    model = CableModel(HEAVY, 5, "link", "clamped", "free", WEIGHTLESS)
    pose = HeldPose((0.0, 0.0), start_heading=0.0)
    x = bend * np.arange(model.chain.n_nodes)[:, None]
    rest = bend / np.diff(model.chain.cells, axis=1).ravel()
    shapes = Shapes.declared(x[None], np.zeros((1, model.n_border)))
    batch = BatchEquilibrium(model, [pose])
    assert np.abs(batch.at(shapes, model.nominal, rest).imbalance().rows).max() < 1e-14
    assert batch.stable(shapes, model.nominal, rest).tolist() == [stable]


def test_rest_strains_of_a_coarse_mesh_are_means_over_its_cells():
    model = CableModel(HEAVY, 24)
    coarse = model.with_mesh(10)
    rest = np.random.default_rng(0).normal(size=24)
    found, turned = coarse_rest(model, coarse, rest), np.append(0.0, np.cumsum(rest) / 24)
    edges = np.interp(np.linspace(0, 1, 11), np.linspace(0, 1, 25), turned)
    np.testing.assert_allclose(found, 10 * np.diff(edges), atol=1e-13)


@pytest.mark.parametrize(
    ("end", "headings"),
    [
        ((-0.770, 0.096), (-0.56, 0.21)),
        ((-0.543, 0.743), (-1.38, -0.38)),
    ],
)
def test_a_joint_at_its_bound_beside_others_that_bow(end, headings):
    """A limp cable that folds between its clamps balances, and ends where it is held."""
    model = CableModel(CableData(1.0, 0.1, 0.005, 3e-3), 20, start="clamped", end="clamped")
    pose = HeldPose((0.0, 0.0), end, *headings)
    held = solve_equilibrium(model, model.nominal, np.zeros(20), pose)
    assert held.stable
    np.testing.assert_allclose(held.points[-1], end, atol=1e-9)
    moments = held.bound_multipliers
    assert moments.any()
    given = Inputs.of(model.nominal, np.zeros(20), pose.vector[None])
    force = Assembly(model, held.shapes, given).balance()[1].x.ravel()
    turned = np.concatenate([[0.0], moments]) - np.concatenate([moments, [0.0]])
    np.testing.assert_allclose(force + turned, 0.0, atol=1e-10)


@pytest.mark.parametrize("element", ["arc", "quadratic"])
def test_the_smallest_radius_is_that_at_a_clamp(element):
    """A cantilever is bent most where it is held; to the second order of the mesh."""
    stiffness, weight, length, heading = 0.02, 0.2 * 9.81 / 0.8, 0.8, 0.3
    exact = 1 / abs(cantilever(stiffness, weight, length, heading)(0.0)[1])
    errors = []
    for n in (20, 40):
        model = CableModel(CableData(length, 0.2, 0.01, stiffness), n, element, "clamped", "free")
        held = solve(model, stiffness, HeldPose((0.0, 0.0), start_heading=heading))
        errors.append(abs(held.min_bend_radius / exact - 1))
    assert errors[0] < 0.03
    assert errors[1] < errors[0] / 3


# ---- messages ----------------------------------------------------------------------------------


def test_a_pose_that_is_not_finite_is_named():
    with pytest.raises(EquilibriumError, match=r"pose_08: .*not finite: end \(0.6, nan\)"):
        solve(CableModel(HEAVY, 8), 0.1, HeldPose((0.0, 0.0), (0.6, np.nan), name="pose_08"))


@pytest.mark.parametrize(
    ("x", "heading", "said"),
    [(600.0, 0.0, "the cable is 0.8000 m long"), (0.6, np.nan, "not finite: end_heading nan")],
)
def test_no_way_leads_to_a_pose_out_of_reach(x, heading, said):
    """An end in millimetres would be thousands of steps away."""
    model = CableModel(HEAVY, 8, start="clamped", end="clamped")
    here, there = (
        HeldPose((0.0, 0.0), (end, 0.0), start_heading=0.0, end_heading=turn)
        for end, turn in ((0.6, 0.0), (x, heading))
    )
    found = solve(model, 0.1, here)
    rest = np.zeros(model.chain.n_rests)
    with pytest.raises(EquilibriumError, match=said):
        continued(model, model.nominal, rest, there, here, found.x)


def test_a_held_end_that_a_pose_does_not_have_is_not_the_origin():
    with pytest.raises(EquilibriumError, match=r"the end of the cable is pinned, and the pose has"):
        solve(CableModel(HEAVY, 8), 0.1, HeldPose((0.0, 0.0)))


@pytest.mark.parametrize("label", ["", "wrong_label", "spool"])
def test_a_longer_cable_reaches_farther_whatever_its_effect_is_called(label):
    """Two length errors multiply; the end fixture is where it really is."""
    effects = (LengthError(label), LengthError("other"), EndOffset())
    model = CableModel(HEAVY, 8, effects=effects)
    p = np.array([0.1, 0.04, 0.02, -0.01, 0.0])  # 0.8 m (1 + 0.04 / 0.8) (1 + 0.02 / 0.8)
    held = solve_equilibrium(model, p, np.zeros(8), HeldPose((0.0, 0.0), (0.87, 0.0)))
    assert held.points[-1] == pytest.approx([0.86, 0.0], abs=1e-8)
    with pytest.raises(EquilibriumError, match=r"is 0.8620 m from the start.*is 0.8610 m long"):
        solve_equilibrium(model, p, np.zeros(8), HeldPose((0.0, 0.0), (0.872, 0.0)))


def test_unreachable_pose_is_named_with_numbers():
    model = CableModel(HEAVY, 8)
    pose = HeldPose((0.0, 0.0), (0.6, 0.6), name="pose_07")
    with pytest.raises(EquilibriumError, match=r"pose_07: no equilibrium") as caught:
        solve(model, 0.1, pose)
    assert "(0.6000, 0.6000) m is 0.8485 m from the start" in str(caught.value)
    assert "the cable is 0.8000 m long" in str(caught.value)
    assert "Try:" in str(caught.value)
    assert caught.value.pose == "pose_07"
    assert caught.value.p_des == (0.6, 0.6)


def test_poses_solved_together_are_those_solved_alone_and_ipopt_finds_nothing_lower():
    """One of them is out of reach, one names its branch."""
    model = CableModel(CableData(1.0, 0.1, 0.01, 0.02), 12, start="clamped", end="clamped")
    p, rest = model.nominal, np.full(model.chain.n_cells, 0.8)
    ends = [((0.6, 0.1), None), ((0.2, -0.5), None), ((1.1, 0.0), None), ((0.5, 0.3), "cw")]
    poses = [HeldPose((0.0, 0.0), end, 0.3, -0.4, branch=branch) for end, branch in ends]
    together = solve_equilibria(model, p, rest, poses)
    lost = together.pop(2)
    assert isinstance(lost, EquilibriumError)
    assert "1.1000 m from the start" in str(lost)
    for pose, eq in zip(poses[:2] + poses[3:], together, strict=True):
        assert isinstance(eq, Equilibrium)
        alone = solve_equilibrium(model, p, rest, pose)
        np.testing.assert_allclose(eq.x, alone.x, atol=1e-12)
        found = [by_ipopt(model, p, rest, pose, phi) for phi in guesses(model, p, rest, pose)]
        stable = [other for other in found if other is not None and other.stable]
        assert eq.energy <= min(other.energy for other in stable) + 1e-12
        held = by_ipopt(model, p, rest, pose, eq.phi)
        assert held is not None
        assert held.stable
        np.testing.assert_allclose(held.x, eq.x, atol=1e-9)


def test_ipopt_finds_an_equilibrium_where_no_guess_leads_to_one():
    """A coil of 2.5 mm radius, pulled straight."""
    model = CableModel(CableData(0.5, 0.02, 0.006, 0.002), 8, n_rest=0)
    pose = HeldPose((0.0, 0.0), (0.4999, 0.0))
    (eq,) = solve_equilibria(model, model.nominal, np.full(model.chain.n_rests, 400.0), [pose])
    assert isinstance(eq, Equilibrium)
    assert eq.stable
