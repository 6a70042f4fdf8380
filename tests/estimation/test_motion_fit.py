"""Recorded motions are fitted with still shapes, and tell what these cannot."""

from dataclasses import replace

import numpy as np
import pytest

from dlo_casadi.diagnosis.candidates import Candidate
from dlo_casadi.diagnosis.in_motion import _needed, in_motion_only, search_in_motion
from dlo_casadi.effects import AirDrag, CableData
from dlo_casadi.effects.stiffness import DynamicStiffness, StiffnessGradient
from dlo_casadi.equilibrium.batch import BatchEquilibrium
from dlo_casadi.equilibrium.pose import HeldPose
from dlo_casadi.equilibrium.solve import solve_equilibrium
from dlo_casadi.estimation.fit import fit_model
from dlo_casadi.estimation.motion_fit import (
    MotionFit,
    fit_motions,
    predicted,
    rejoined,
    repeated_fit,
)
from dlo_casadi.estimation.recording import held_by
from dlo_casadi.estimation.result import Fit
from dlo_casadi.model.cable_model import CableModel
from dlo_casadi.model.tolerances import Tolerances
from dlo_casadi.motion.modes_at_rest import ModesAtRest
from dlo_casadi.motion.path import FixturePath
from dlo_casadi.motion.system import MovingCable
from dlo_casadi.motion.trajectory import way_of
from dlo_casadi.rod.supports import SupportKind
from dlo_casadi.sensing.measured_motion import MeasuredMotion
from dlo_casadi.sensing.measured_pose import MeasuredPose
from dlo_casadi.session.measured_modes import measured_modes

TRUE = CableData(0.6, 0.06, 0.02, 0.009, straight=True, damping_time=0.03)
DECLARED = replace(TRUE, bending_stiffness=0.011, damping_time=None)
STD, START = 2e-4, (0.0, 0.0)
S, T = np.linspace(0.1, 0.6, 6), np.arange(0.0, 0.61, 0.02)


def model_of(cable: CableData, n: int, effects: tuple = ()) -> CableModel:
    ends = SupportKind("clamped"), SupportKind("free")
    return CableModel(cable, n, start=ends[0], end=ends[1], effects=effects, n_rest=0)


def noise(k: int, shape: tuple[int, ...]) -> np.ndarray:
    return STD * np.random.default_rng(k).normal(size=shape)


def values_of(model: CableModel, **known: float) -> np.ndarray:
    nominal = zip(model.names, model.nominal, strict=True)
    return np.array([known.get(name.split(".")[-1], value) for name, value in nominal])


def still(k: int, heading: float, slope: float = 0.0) -> MeasuredPose:
    """Markers of a shape at rest."""
    model = model_of(TRUE, 24, (StiffnessGradient(),))
    pose = HeldPose(start=START, start_heading=heading)
    p, rest = values_of(model, slope=slope), np.zeros(model.chain.n_rests)
    eq = solve_equilibrium(model, p, rest, pose)
    seen = BatchEquilibrium(model, [pose], wrenches=False).seen(eq.shapes, p, rest)
    points = seen[0].curve.at(S) + noise(k, (len(S), 2))
    return MeasuredPose.of_points(pose, points, s=S)


def motion(
    name: str,
    k: int,
    *,
    drag: float = 0.0,
    stiffer: float = 1.0,
    slope: float = 0.0,
    held_out: bool = False,
) -> MeasuredMotion:
    """Markers of a cable whose clamp is carried aside in a third of a second."""
    model = model_of(TRUE, 16, (AirDrag(), DynamicStiffness(), StiffnessGradient()))
    p = values_of(model, coefficient=drag, factor=stiffer, slope=slope)
    cable = MovingCable(model, p, np.zeros(model.chain.n_rests))
    t = np.arange(0.0, 0.7, 0.01)
    share = np.clip((t - 0.05) / 0.3, 0.0, 1.0)
    x = 0.15 * (-1) ** k * share**3 * (10 - 15 * share + 6 * share**2)
    start = np.stack([x, 0 * x], axis=1)
    pose = HeldPose(start=START, start_heading=-0.8)
    path = FixturePath.of(pose, t, {"start": start})
    eq = solve_equilibrium(model, p, cable.rest, pose)
    cable = cable.about(eq.x)
    way = way_of(cable, cable.at_rest(eq, path.at(0.0, cable)), path, (0.0, float(T[-1])), 1e-6)
    points = way.points(T, S) + noise(10 + k, (len(T), len(S), 2))
    points[3, 1] = np.nan
    resting = {"start_heading": np.array(-0.8)}
    return MeasuredMotion(
        name, T, points, S, t, {"start": start}, resting, at_rest=True, held_out=held_out
    )


HEADINGS = (-0.2, -0.7, -1.2, 0.3)


@pytest.fixture(scope="module")
def stills() -> list[MeasuredPose]:
    return [still(k, heading) for k, heading in enumerate(HEADINGS)]


@pytest.fixture(scope="module")
def at_rest(stills: list[MeasuredPose]) -> Fit:
    return fit_model(model_of(DECLARED, 20), stills, Tolerances(), STD)


def fitted(at_rest: Fit, **hidden: float) -> MotionFit:
    return fit_motions(at_rest, [motion("carry", 0, **hidden), motion("back", 1, **hidden)])


@pytest.fixture(scope="module")
def moving(at_rest: Fit) -> MotionFit:
    return fitted(at_rest)


def test_damping_is_found_and_motions_are_predicted(moving: MotionFit) -> None:
    found = moving
    fit = found.fit
    assert found.converged
    assert 0.85 < found.chi2_per_dof < 1.15
    assert abs(fit.value("damping_time") - 0.03) < 3 * fit.std("damping_time")
    assert fit.std("damping_time") < 0.002
    assert abs(fit.value("bending_stiffness") - 0.009) < 3 * fit.std("bending_stiffness")
    ahead = predicted(found, motion("ahead", 2, held_out=True))
    left = ahead - motion("ahead", 2).points
    assert np.sqrt(np.nanmean((left**2).sum(axis=2))) < 1.2 * np.sqrt(2) * STD
    assert not search_in_motion(found).added


def test_still_shapes_predict_frequencies_that_the_motions_meet(
    at_rest: Fit, moving: MotionFit
) -> None:
    own = motion("carry", 0)
    modes = measured_modes(at_rest, repeated_fit(moving), [own])
    model, pose = model_of(TRUE, 24), held_by(own.held_at(-1))
    p, rest = model.nominal, np.zeros(model.chain.n_rests)
    eq = solve_equilibrium(model, p, rest, pose)
    frequencies, ratios = ModesAtRest(model, p, rest, eq, pose, 3).numbers()
    mesh = 1e-3 * frequencies  # of 20 elements
    assert (np.abs(modes.predicted - frequencies) < 3 * modes.predicted_std + mesh).all()
    assert (np.abs(modes.frequencies - frequencies) < 3 * modes.frequency_std + mesh).all()
    assert (np.abs(modes.damping_ratios - ratios) < 3 * modes.damping_ratio_std).all()
    assert modes.as_rows()[0]["of"] == "carry"


@pytest.mark.long
def test_drag_of_air_is_found(at_rest: Fit) -> None:
    before = fitted(at_rest, drag=3.0)
    found = search_in_motion(before)
    assert [item.candidate.name for item in found.added][:1] == ["air_drag"]
    drag = found.after.fit
    assert (
        abs(drag.value("air_drag.coefficient") - 3.0) < 3 * drag.std("air_drag.coefficient") + 0.1
    )
    assert found.after.rmse < before.rmse


def test_what_a_tolerance_hides_is_found_without_a_misfit(at_rest: Fit) -> None:
    before = fitted(at_rest, stiffer=1.13)
    assert before.chi2_per_dof < 1.15
    found = search_in_motion(before)
    (effect,) = found.added
    assert effect.candidate.name == "dynamic_stiffness"
    assert effect.p_value < 1e-6
    factor = found.after.fit
    std = factor.std("dynamic_stiffness.factor")
    assert abs(factor.value("dynamic_stiffness.factor") - 1.13) < 3 * std


@pytest.mark.parametrize(("slope", "dropped"), [(0.0, ["stiffness_gradient"]), (0.3, [])])
def test_what_still_poses_showed_is_judged_again(slope: float, dropped: list[str]) -> None:
    taper, poses = StiffnessGradient(), [still(k, x, slope) for k, x in enumerate(HEADINGS)]
    names = (("stiffness_gradient.slope",), ("stiffness_gradient.slope",))
    before = fit_model(model_of(DECLARED, 20, (taper,)), poses, Tolerances(), STD)
    shown = Candidate(taper, *names, (), nuisance=False)
    found = search_in_motion(fitted(before, stiffer=1.13, slope=slope), shown=[shown])
    assert [item.candidate.name for item in found.added] == ["dynamic_stiffness"]
    assert [item.name for item in found.dropped] == dropped
    assert (taper.label in {x.label for x in found.after.fit.model.effects}) is not dropped


def test_a_tolerance_that_is_dropped_has_its_prior_again(moving: MotionFit) -> None:
    """Whether motion or still poses had freed it: the model of the motions knows both."""
    model = moving.fit.model
    (stiffness,) = (x for x in in_motion_only(model) if x.name == "dynamic_stiffness")
    freed = rejoined(moving, stiffness.add_to(model), {})
    assert "dynamic_stiffness.factor" not in freed.fit.model.priors
    now, dropped = _needed(freed, [stiffness], model, 0.005)
    assert dropped == [stiffness]
    assert now.fit.model.priors == model.priors
