"""An effect that was added is dropped again once a later one has made it superfluous."""

import numpy as np
import pytest

from dlo_casadi.diagnosis.candidates import candidates, setup_of
from dlo_casadi.diagnosis.crossval import cross_validate
from dlo_casadi.diagnosis.found import AddedEffect
from dlo_casadi.diagnosis.gram import sidak, survival
from dlo_casadi.diagnosis.trials import Trials, pruned
from dlo_casadi.effects import EFFECTS, CableData, ContactPlane
from dlo_casadi.equilibrium.pose import HeldPose
from dlo_casadi.estimation.fit import fit_model
from dlo_casadi.estimation.prediction import predict_poses
from dlo_casadi.model.cable_model import CableModel
from dlo_casadi.model.tolerances import Tolerances
from dlo_casadi.runtime.executors import InProcess
from dlo_casadi.sensing.measured_pose import MeasuredPose
from dlo_casadi.session.fitting import nuisances

NOISE, CENTER, SIGNIFICANCE = 3e-4, (0.25, 0.0), 0.01
PLAIN = CableModel(CableData(0.5, 0.03, 0.006, 0.01, straight=True), 12)
ENDS = ((0.3, 0.0), (0.2, -0.2), (0.35, 0.1), (0.4, -0.1))
# All but a few: what is kept beside these needs no others.
OTHERS = tuple(
    {*EFFECTS} - {"image_distortion", "stiffness_gradient", "length_error", "gravity_tilt"}
)


def found(coefficient: float):
    """A photographed taper with a little distortion, and the fit with both effects."""
    listed = candidates(PLAIN, setup_of(PLAIN, center=CENTER))
    distortion, taper = (
        next(c for c in listed if c.name == name)
        for name in ("image_distortion", "stiffness_gradient")
    )
    model = taper.add_to(distortion.add_to(PLAIN))
    p = np.array([0.01, coefficient, 0.4])
    poses = [HeldPose((0.0, 0.0), end) for end in ENDS]
    s = np.linspace(0.02, 0.98, 40) * PLAIN.cable.length
    rng = np.random.default_rng(0)
    measured = [
        MeasuredPose.of_points(pose, shape.curve.at(s) + rng.normal(scale=NOISE, size=(40, 2)))
        for pose, shape in zip(
            poses, predict_poses(model, p, np.zeros(model.chain.n_cells), poses), strict=True
        )
    ]
    fit = fit_model(model, measured, Tolerances(), NOISE)
    told = cross_validate(fit)
    return fit, [AddedEffect(c, 1e-3, told, told, ()) for c in (distortion, taper)]


# Of 0.0065 per m^2 the fit finds 2.8 standard deviations: one in 200 as a single test, but one in
# 15 as the best of 14.
@pytest.mark.parametrize(
    ("coefficient", "kept"), [pytest.param(0.0065, False, marks=pytest.mark.long), (0.02, True)]
)
def test_an_effect_stays_only_while_it_is_significant_among_all_candidates(coefficient, kept):
    fit, added = found(coefficient)
    trials = Trials(fit, CENTER, OTHERS if kept else (), SIGNIFICANCE, InProcess())

    smaller, left = pruned(trials, fit, added)

    names = ["image_distortion"] * kept + ["stiffness_gradient"]
    assert [item.candidate.name for item in left] == names
    assert [effect.name for effect in smaller.model.effects] == names


@pytest.mark.parametrize(("slope", "left"), [(0.0, []), (0.008, ["stiffness_gradient"])])
def test_an_effect_of_fewer_parameters_takes_the_place_of_one_that_is_not_significant(slope, left):
    """A taper gains 21: p = 5e-6 with its one parameter, 3e-5 with the two of a section."""
    listed, rng = {c.name: c for c in candidates(PLAIN, setup_of(PLAIN))}, np.random.default_rng(0)
    taper, section = listed["stiffness_gradient"], listed["stiff_section"]
    model, s = taper.add_to(PLAIN), np.linspace(0.02, 0.98, 40) * PLAIN.cable.length
    poses = [HeldPose((0.0, 0.0), end) for end in ENDS]
    shapes = predict_poses(model, np.array([0.01, slope]), np.zeros(model.chain.n_cells), poses)
    measured = [
        MeasuredPose.of_points(pose, shape.curve.at(s) + rng.normal(scale=NOISE, size=(40, 2)))
        for pose, shape in zip(poses, shapes, strict=True)
    ]
    declared = fit_model(PLAIN, measured, Tolerances(), NOISE)
    fit = fit_model(section.add_to(PLAIN), measured, Tolerances(), NOISE)
    both = cross_validate(declared), cross_validate(fit)
    others = [name for name in listed if name not in {"stiffness_gradient", "stiff_section"}]
    trials = Trials(declared, None, others, 1e-5, InProcess(), from_shapes=True)

    found, kept = pruned(trials, fit, [AddedEffect(section, 1e-9, *both, ())])

    assert [item.name for item in kept] == left
    assert [effect.name for effect in found.model.effects] == left


@pytest.mark.parametrize(
    ("longer", "kept"), [pytest.param(0.0, False, marks=pytest.mark.long), (0.02, True)]
)
def test_a_nuisance_is_held_within_its_tolerance_again_where_it_is_needless(longer, kept):
    held = nuisances(PLAIN, Tolerances())
    listed = candidates(held, setup_of(held))
    length, taper = (
        next(c for c in listed if c.name == name) for name in ("length_error", "stiffness_gradient")
    )
    model = taper.add_to(length.add_to(held))
    assert set(length.frees) == set(held.priors) - set(model.priors)
    true = {"stiffness_gradient.slope": 0.4, "length_error.length_difference": longer}
    p = np.array([true.get(x, y) for x, y in zip(model.names, model.nominal, strict=True)])
    poses, rng = [HeldPose((0.0, 0.0), end) for end in ENDS], np.random.default_rng(0)
    s = np.linspace(0.02, 0.98, 40) * PLAIN.cable.length
    shapes = predict_poses(model, p, np.zeros(model.chain.n_cells), poses)
    measured = [
        MeasuredPose.of_points(pose, shape.curve.at(s) + rng.normal(scale=NOISE, size=(40, 2)))
        for pose, shape in zip(poses, shapes, strict=True)
    ]
    fit = fit_model(model, measured, Tolerances(), NOISE)
    told = cross_validate(fit)
    added = [AddedEffect(c, 1e-3, told, told, ()) for c in (length, taper)]
    declared = fit_model(held, measured, Tolerances(), NOISE)
    trials = Trials(declared, CENTER, OTHERS if kept else (), SIGNIFICANCE, InProcess())

    smaller, left = pruned(trials, fit, added)

    names = ["length_error"] * kept + ["stiffness_gradient"]
    assert [item.candidate.name for item in left] == names
    assert (smaller.model.priors == held.priors) is not kept


@pytest.mark.long
def test_an_effect_that_stands_for_the_error_of_the_mesh_is_dropped_on_a_finer_one():
    """On a table 20 elements are 5 mm off, which a section of another stiffness makes up for."""
    cable = CableData(0.8, 0.08, 0.006, 0.02, straight=True)
    fine = CableModel(cable, 80, n_rest=0, effects=(ContactPlane(),))
    p, s = fine.nominal.copy(), np.linspace(0.02, 0.98, 12) * cable.length
    p[fine.names.index("contact_plane.height")] = -0.25
    poses = [HeldPose((0.0, 0.0), end) for end in ((0.5, 0.1), (0.55, -0.05), (0.45, 0.05))]
    shapes = predict_poses(fine, p, np.zeros(fine.chain.n_cells), poses)
    rng = np.random.default_rng(0)
    points = [shape.curve.at(s) + rng.normal(scale=NOISE, size=(12, 2)) for shape in shapes]
    each = zip(poses, points, strict=True)
    measured = [MeasuredPose.of_points(pose, some, s=s) for pose, some in each]
    model = fine.with_mesh(20)
    section = next(c for c in candidates(model, setup_of(model)) if c.name == "stiff_section")
    fit = fit_model(section.add_to(model), measured, Tolerances(), NOISE)
    before = cross_validate(fit_model(model, measured, Tolerances(), NOISE))
    added = [AddedEffect(section, 1e-3, before, cross_validate(fit), ())]
    for finest, kept in ((None, True), (80, False)):
        trials = Trials(fit, None, (), SIGNIFICANCE, InProcess(), finest)

        smaller, left = pruned(trials, fit, added)

        assert len(left) == kept
        assert (smaller.model.n == 20) == kept


def test_significance_of_two_parameters_and_of_the_best_of_many_tests():
    """exp(-T / 2), with a noise of k degrees of freedom (1 + T / k)^(-k / 2); 1 - (1 - p)^n."""
    assert survival(7.0, 2, np.inf) == pytest.approx(np.exp(-3.5))
    assert survival(7.0, 2, 10.0) == pytest.approx(1.7**-5)
    assert sidak(0.2, 3) == pytest.approx(1 - 0.8**3)
    assert sidak(1e-15, 14) == pytest.approx(1.4e-14)


@pytest.mark.parametrize("noise_degrees", [np.inf, 1000.0])
def test_a_gain_that_rounding_makes_negative_shows_nothing(noise_degrees):
    assert survival(-1e-9, 1, noise_degrees) == pytest.approx(1.0)
