"""A relaxed balance along the measured shapes: any stiffness, roll and twist."""

from dataclasses import replace
from types import SimpleNamespace

import casadi as ca
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from dlo_casadi.effects import CableData, Tether
from dlo_casadi.effects.cable import Parameter
from dlo_casadi.effects.effect import Load, SpringAt
from dlo_casadi.equilibrium.pose import HeldPose
from dlo_casadi.estimation.measured_shapes import measured_shapes
from dlo_casadi.estimation.prediction import predict_poses
from dlo_casadi.estimation.problem import Priors, Problem
from dlo_casadi.estimation.relaxation import SOFTNESS, Relaxation
from dlo_casadi.estimation.start import begin, relaxed, with_springs_in_place
from dlo_casadi.estimation.unknowns import Unknowns, Values
from dlo_casadi.model.cable_model import END_ROLL, CableModel
from dlo_casadi.model.tolerances import Tolerances
from dlo_casadi.sensing.measured_pose import MeasuredPose
from dlo_casadi.sensing.noise import NoiseModel

CABLE = CableData(0.9, 0.1, 0.01, bending_stiffness=0.04, torsional_stiffness=0.03)
HELD = {"start": "clamped", "end": "clamped", "gravity": (0.0, 0.0, -9.81)}
ROLL, NOISE, TURNED = -2.3, 5e-4, (3.4, 2.2, 1.2, 0.1, -1.1, -2.1)


REST = (1.2, 0.5, 0.8, -0.3)
MODEL = CableModel(CABLE, 8, "quadratic", n_rest=2, **HELD)


def problem_of(marked: bool = True) -> tuple[Problem, np.ndarray]:
    """Poses of a rolled cable, twisted by up to more than half a turn, and its parameters."""
    p = MODEL.nominal.copy()
    p[MODEL.names.index(END_ROLL)] = ROLL
    rest = MODEL.rest_basis @ np.array(REST)
    rng = np.random.default_rng(1)
    s = np.linspace(0.02, 0.98, 12) * CABLE.length
    measured = []
    for turned in TURNED:
        end = Rotation.from_rotvec([0.0, *rng.uniform(-0.3, 0.3, 2)])
        end *= Rotation.from_rotvec([turned - ROLL, 0.0, 0.0])
        place = (rng.uniform(0.8, 0.9) * CABLE.length, *rng.uniform(-0.1, 0.1, 2))
        frames = {
            "start_orientation": (0.0, 0.0, 0.0, 1.0),
            "end_orientation": tuple(end.as_quat()),
        }
        pose = HeldPose((0.0, 0.0, 0.0), place, **frames)
        (shape,) = predict_poses(MODEL, p, rest, [pose])
        points = shape.curve.at(s) + rng.normal(scale=NOISE, size=(len(s), 3))
        measured.append(MeasuredPose.of_points(pose, points, s=s if marked else None))
    unknowns = Unknowns(MODEL, np.ones(len(p), dtype=bool), MODEL.nominal)
    priors = Priors.of(Tolerances(), MODEL)
    return Problem(unknowns, tuple(measured), NoiseModel(NOISE), priors), p


@pytest.fixture(scope="module")
def rolled():
    """A cable rolled by 2.3 rad, seen by markers."""
    return problem_of()


@pytest.mark.parametrize("factor", [0.05, 1.0, 20.0])
def test_stiffness_roll_and_twists_are_found_from_any_stiffness(rolled, factor):
    """Within their standard deviations, from a stiffness 20 times off and a roll of none."""
    problem, true = rolled
    values = MODEL.nominal.copy()
    values[MODEL.stiffness_indices] *= factor
    theta = problem.unknowns.pack(values, np.zeros(MODEL.n_coefficients))
    weighed, found = begin(problem, theta)
    p = problem.unknowns.p(relaxed(weighed, found, SOFTNESS[1:]).theta)

    assert p[0] == pytest.approx(true[0], rel=0.05)
    assert p[MODEL.names.index(END_ROLL)] == pytest.approx(ROLL, abs=0.1)
    twist = MODEL.node.turning(measured_shapes(problem, ROLL)[0].x)
    np.testing.assert_allclose(MODEL.node.turning(found.shapes.x), twist, atol=0.5)


@pytest.mark.parametrize("factor", [0.02, pytest.param(50.0, marks=pytest.mark.long)])
def test_a_spring_and_a_stiffness_far_off_are_found_together(factor):
    """The spring pulls with many times the weight; nothing is known but its place."""
    spring = Tether()
    pulled = CableModel(CABLE, 8, "quadratic", n_rest=0, effects=(spring,), **HELD)
    true = {"tether.stiffness": 9.0, "tether.position": 0.4, "tether.anchor_x": 0.35}
    true |= {"tether.anchor_y": -0.3, "tether.anchor_z": 0.15}
    p = np.array(
        [true.get(name, q.nominal) for name, q in zip(pulled.names, pulled.parameters, strict=True)]
    )
    rng, rest = np.random.default_rng(2), np.zeros(pulled.chain.n_rests)
    s, measured = np.linspace(0.02, 0.98, 12) * CABLE.length, []
    for _ in range(8):
        place = (rng.uniform(0.6, 0.8) * CABLE.length, *rng.uniform(-0.15, 0.15, 2))
        along = {f"{end}_orientation": (0.0, 0.0, 0.0, 1.0) for end in ("start", "end")}
        pose = HeldPose((0.0, 0.0, 0.0), place, **along)
        (shape,) = predict_poses(pulled, p, rest, [pose])
        points = shape.curve.at(s) + rng.normal(scale=NOISE, size=(len(s), 3))
        measured.append(MeasuredPose.of_points(pose, points, s=s))
    model = replace(pulled, effects=(spring.linear(),))
    start = model.nominal.copy()
    start[model.stiffness_indices] *= factor
    start[model.names.index("tether.position")] = 0.4
    unknowns = Unknowns(model, np.ones(len(start), dtype=bool), start)
    problem = Problem(unknowns, tuple(measured), NoiseModel(NOISE), Priors.of(Tolerances(), model))
    theta = unknowns.off_bounds(unknowns.pack(start, np.zeros(0)))
    still = np.array([name == "tether.position" for name in unknowns.names])
    weighed, found = begin(problem, theta, still)
    found = dict(
        zip(model.names, unknowns.p(relaxed(weighed, found, SOFTNESS[1:3]).theta), strict=True)
    )

    assert found["bending_stiffness"] == pytest.approx(CABLE.bending_stiffness, rel=0.1)
    assert found["tether.stiffness"] == pytest.approx(9.0, rel=0.1)
    assert found["tether.fx"] == pytest.approx(9.0 * 0.35, rel=0.1)


def test_without_softness_left_the_shapes_are_equilibria(rolled):
    """Newton's method moves no node by more than a hundredth of a radian any more."""
    problem, true = rolled
    start = problem.unknowns.pack(true, np.zeros(MODEL.n_coefficients))
    weighed, found = begin(problem, start)
    found = relaxed(weighed, found)
    point = weighed.balanced(found)
    way = MODEL.node.difference(found.shapes.x, point.shapes.x)
    assert np.abs(way).max() < 0.01


def test_normal_equations_are_those_of_differences(rolled):
    """The gradient by the unknowns, everything of the poses' own at its minimum (Danskin)."""
    problem, true = rolled
    start = problem.unknowns.pack(true, np.zeros(MODEL.n_coefficients))
    weighed, values = begin(problem, start)
    fixed = np.ones(len(start), dtype=bool)
    relaxation = Relaxation(weighed, SOFTNESS[0])
    values = replace(values, theta=values.theta + 0.02)
    for _ in range(5):
        values = relaxation.solve(values, fixed, steps=40)
    gradient = relaxation.mixed(values).normal.gradient
    step, differences = 1e-4, []
    for k in range(len(start)):
        sides = []
        for sign in (1, -1):
            theta = values.theta.copy()
            theta[k] += sign * step
            sides.append(relaxation.objective(replace(values, theta=theta)) / 2)
        differences.append((sides[0] - sides[1]) / (2 * step))
    scale = np.abs(gradient).max()
    np.testing.assert_allclose(gradient / scale, np.array(differences) / scale, atol=0.02)


class Bungee(Load):
    """A spring from the middle of the cable to the origin: its place is no parameter."""

    name = "bungee"
    n_springs = 1
    declared = (Parameter("stiffness", "N/m", scale=1.0),)

    def springs(self, params):
        return (SpringAt(params["stiffness"], ca.SX.zeros(2), ca.SX(0), ca.SX(0.4)),)


def test_a_spring_hangs_at_the_place_that_its_effect_says():
    cable = CableData(0.8, 0.05, 0.006, 0.01)
    model = CableModel(cable, 8, n_rest=0, effects=(Bungee(),))
    poses = [HeldPose((0.0, 0.0), (0.5, 0.1 * k), name=f"{k}") for k in range(2)]
    still = np.zeros(model.chain.n_rests)
    s = np.linspace(0.0, 0.8, 17)
    measured = tuple(
        MeasuredPose.of_points(pose, shape.curve.at(s), s=s)
        for pose, shape in zip(
            poses, predict_poses(model, model.nominal, still, poses), strict=True
        )
    )
    unknowns = Unknowns(model, np.ones(1, dtype=bool), model.nominal)
    problem = Problem(unknowns, measured, NoiseModel(NOISE), Priors.of(Tolerances(), model))
    theta = unknowns.pack(model.nominal, np.zeros(0))
    values = with_springs_in_place(problem, Values(theta, *measured_shapes(problem)))
    place = [model.border_names.index(f"spring_0.place_{axis}") for axis in "xy"]
    for lam, seen in zip(values.shapes.lam, problem.observed(values), strict=True):
        np.testing.assert_allclose(lam[place], seen.curve.at(np.array([0.4]))[0], atol=1e-12)


class Creeping(Relaxation):
    """Steps with a damping below 10 are refused, others take one unknown down by a share."""

    def objective(self, values, seen=None):
        return float(values.theta[0])

    def _linearized(self, values):
        return None

    def _scaled(self, linearized, values):
        return linearized

    def _stepped(self, values, linearized, damping, fixed):
        self.problem.asked.append(damping)
        factor = 1 - self.problem.share if damping >= 10 else 2.0
        return replace(values, theta=values.theta * factor)


@pytest.mark.parametrize(
    ("share", "asked"), [(0.1, [1, 10, 10, 1, 10, 10, 1, 10]), (0.015, [1, 10])]
)
def test_a_damping_stays_after_a_refusal_and_a_creeping_fit_ends(share, asked):
    none = {"observed": lambda _: None, "located": lambda *_: None}
    problem = SimpleNamespace(asked=[], share=share, **none)
    Creeping(problem, 0.01).solve(Values(np.ones(1), None, []), steps=5)
    assert problem.asked == asked
