"""What differs at random from pose to pose is named, sized, and does not pull the stiffness."""

from dataclasses import replace
from types import SimpleNamespace

import hidden_sets
import numpy as np
import pytest
from hidden_sets import simulated

from dlo_casadi.cable.file import metadata_of
from dlo_casadi.diagnosis.crossval import cross_validate
from dlo_casadi.diagnosis.diagnose import Search
from dlo_casadi.diagnosis.found import AddedEffect
from dlo_casadi.diagnosis.from_data import from_data
from dlo_casadi.diagnosis.from_pose_to_pose import (
    as_repeating,
    with_loose_poses,
)
from dlo_casadi.diagnosis.refits import Confirmed, confirm
from dlo_casadi.diagnosis.trials import Trials, judged
from dlo_casadi.effects import EFFECTS, CableData
from dlo_casadi.equilibrium.pose import HeldPose
from dlo_casadi.equilibrium.solve import solve_equilibrium
from dlo_casadi.equilibrium.spread import Repeats, SolvedCable, Uncertainty
from dlo_casadi.estimation.batch import solve_batch
from dlo_casadi.estimation.constrained import EnergyGap, profile_interval
from dlo_casadi.estimation.descent import descend
from dlo_casadi.estimation.repeats import enough_poses
from dlo_casadi.estimation.variances import settle
from dlo_casadi.model.cable_model import CableModel
from dlo_casadi.model.pose_scatter import REST_CURVATURE, PoseScatter, effect_of, sources_in
from dlo_casadi.report.documents import fit_dict
from dlo_casadi.runtime.executors import InProcess
from dlo_casadi.runtime.parallel import generator_of
from dlo_casadi.session.fitting import declared_model, fit_declared
from dlo_casadi.session.measure import measured_poses, read_inputs
from dlo_casadi.session.stages import fit_stage
from dlo_casadi.thresholds import DIFFERENT, EVIDENCE_APART, SIGNIFICANCE

PLANE = CableData(0.6, 0.04, 0.005, 0.01)
SPACE = CableData(0.6, 0.04, 0.005, 0.01, torsional_stiffness=0.008)
IN_SPACE = HeldPose((0, 0, 0), (0.4, 0.1, -0.05), (0, 0, 0.1, 1), (0.1, 0, 0, 1))
MODELS = {
    "pins": (CableModel(PLANE, 12), HeldPose((0, 0), (0.42, 0.1))),
    "clamps": (
        CableModel(PLANE, 12, start="clamped", end="clamped"),
        HeldPose((0, 0), (0.42, 0.1)),
    ),
    "space": (
        CableModel(SPACE, 12, start="clamped", end="clamped", gravity=(0, 0, -9.81)),
        IN_SPACE,
    ),
}


def test_what_may_differ():
    assert sources_in(MODELS["pins"][0]) == ["pin_moment", "length_error", "end_offset"]
    assert sources_in(MODELS["clamps"][0]) == ["length_error", "clamp_angle", "end_offset"]
    assert sources_in(MODELS["space"][0]) == ["length_error", "clamp_rotation", "end_offset"]


def changed(model, scatter, k, x):
    """Model, parameters and rest curvature with the k-th random component at x, in all poses."""
    effect, rest = effect_of(scatter.source, model), np.zeros(model.chain.n_rests)
    if effect is None:
        return model, model.nominal, rest + x * scatter.ways(model)[1][:, k]
    larger = model.with_effect(effect)
    p = larger.nominal.copy()
    p[len(model.names) + k] = x
    return larger, p, rest


@pytest.mark.parametrize("case", MODELS)
def test_displacements_are_those_of_shapes_solved_anew(case):
    model, pose = MODELS[case]
    rest, s = np.zeros(model.chain.n_rests), model.chain.places
    held = SolvedCable.of(model, model.nominal, rest, pose)
    eq = held.equilibrium
    for source in (REST_CURVATURE, *sources_in(model)):
        scatter = PoseScatter(1e-5, source=source)
        uncertainty = Uncertainty((), np.zeros((0, 0)), {}, scatter)
        found = Repeats(held, uncertainty).displacements(s)[1]
        found = found[:, :, len(model.deviations) :]
        sizes = scatter.sizes(found.shape[2] - len(pose.start))
        for k, size in enumerate(sizes):
            ahead, behind = (
                solve_equilibrium(*changed(model, scatter, k, x), pose, x_init=eq.x).points
                for x in (1e-5, -1e-5)
            )
            there = (ahead - behind) / 2e-5 * size
            assert found[:, :, k] == pytest.approx(there, rel=1e-4, abs=1e-7 * size)


def test_what_is_random_is_a_deviation_of_each_pose():
    pins, clamps, space = (model for model, _ in MODELS.values())
    turns = [f"{side}_rotation_{axis}" for side in ("start", "end") for axis in "yz"]
    moments = [f"pin_moment_from_pose_to_pose.{side}" for side in ("start", "end")]
    length = ["length_error_from_pose_to_pose.length_difference"]
    for model, source, names, new in (
        (pins, "end_offset", ["end_x", "end_y"], []),
        (pins, "pin_moment", moments, moments),
        (clamps, "clamp_angle", ["start_heading", "end_heading"], []),
        (clamps, "length_error", length, length),
        (clamps, REST_CURVATURE, [], []),
        (space, "end_offset", ["end_x", "end_y", "end_z"], []),
        (space, "clamp_rotation", turns, []),
    ):
        scatter = PoseScatter(2.0, source=source)
        larger = scatter.within(model)
        assert [*scatter.deviations(model)] == names
        assert [*larger.deviation_names] == [*model.deviation_names, *new]
        assert [*larger.deviations] == [*model.deviations, *new]
        assert larger.names == model.names
        assert scatter.within(larger) == larger


def drawn(*choice):
    """A simulated session on its first mesh, which is fine enough here."""

    def on_first(model, *others):
        return model, hidden_sets._shapes(model, *others)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(hidden_sets, "_finely", on_first)
        return simulated(*choice)


@pytest.fixture(
    scope="module",
    params=["clamp_angle", pytest.param("length_error", marks=pytest.mark.long)],
)
def varied(request):
    """A session in the plane whose clamps turn, or lengths differ, with its declared fit."""
    found = drawn(generator_of(7, 1), 2, 0, request.param)
    measured = measured_poses(found.session, read_inputs(found.session))
    return found, fit_declared(found.session, declared_model(found.session), measured)


def test_evidence_of_random_unknowns_is_that_of_their_covariance(varied):
    """Unknowns of each pose, as if their covariance were added to that of the noise."""
    fit = varied[1]
    problem, lin = fit.problem, fit.linearization
    away, precision = fit.point.theta - problem.mean, problem.precision

    def expected(std):
        """Log likelihood with ends and theta integrated out, to first order about `fit`."""
        variances = problem.fixture_std**2 + (std * (problem.random_std > 0)) ** 2
        gradient, hessian, rest = precision @ away, precision.copy(), away @ precision @ away
        rows = zip(lin.residuals, lin.by_theta, lin.by_deviation, fit.own_deviations, strict=True)
        for e, a, b, own in rows:
            covariance, e = np.eye(len(e)) + (b * variances) @ b.T, e - b @ own
            solved = np.linalg.solve(covariance, np.column_stack([a, e]))
            hessian += a.T @ solved[:, :-1]
            gradient = gradient + a.T @ solved[:, -1]
            rest += e @ solved[:, -1] + np.linalg.slogdet(covariance)[1]
        rest += np.linalg.slogdet(hessian)[1] - gradient @ np.linalg.solve(hessian, gradient)
        return -rest / 2

    def found(std):
        scatter = replace(problem.priors.pose_scatter, std=std)
        return descend(fit.reweighed(priors=replace(problem.priors, pose_scatter=scatter)))

    std = problem.priors.pose_scatter.std
    for other in (0.8 * std, 1.25 * std):
        gain = found(other).log_evidence - found(std).log_evidence
        assert gain == pytest.approx(expected(other) - expected(std), abs=0.05)


def test_what_is_random_is_named_and_leaves_the_stiffness_alone(varied):
    found, fit = varied
    own = fit.problem.priors.pose_scatter
    assert own.std == pytest.approx(found.values[f"random.{own.source}"], rel=0.5)
    interval = profile_interval(fit)
    assert interval.low < found.values["bending_stiffness"] < interval.high


@pytest.fixture(scope="module")
def misfit():
    """A session in space whose clamps turn from pose to pose, and its declared fit: a misfit."""
    found = drawn(generator_of(3306, 6), 3, 0, "clamp_rotation")
    measured = measured_poses(found.session, read_inputs(found.session))
    return found, fit_declared(found.session, declared_model(found.session), measured)


@pytest.fixture(scope="module")
def shapes(misfit):
    """The misfit's model, relaxed at the measured shapes."""
    return from_data(misfit[1])[0]


@pytest.fixture(scope="module")
def near(misfit, shapes):
    """The same with clamps that turn at random, found from the measured shapes."""
    return with_loose_poses(misfit[1], shapes)


def test_clamps_that_turn_in_a_misfit_are_found_from_the_shapes(misfit, near):
    """To first order about the misfit no random effect explained this session."""
    found, fit = misfit
    assert fit.noise.source == "misfit"
    own = near.problem.priors.pose_scatter
    assert own.source == "clamp_rotation"
    assert own.std == pytest.approx(found.values["random.clamp_rotation"], rel=0.2)
    assert near.chi2_per_dof == pytest.approx(1.0, abs=0.15)
    interval = profile_interval(near)
    assert interval.low < found.values["bending_stiffness"] < interval.high
    few = replace(near.problem, history=near.problem.history[: DIFFERENT - 1])
    assert enough_poses(fit.problem.history, fit.model)
    assert not enough_poses(few.history, near.model)


@pytest.fixture(scope="module")
def rubbed():
    """A session in the plane with friction at its pins, fitted from the shapes."""
    found = drawn(generator_of(3306, 20), 2, 0, "pin_moment")
    measured = measured_poses(found.session, read_inputs(found.session))
    fit = fit_declared(found.session, declared_model(found.session), measured)
    return found, with_loose_poses(fit, from_data(fit)[0])


def test_moments_of_pins_are_found_from_the_shapes(rubbed):
    found, fit = rubbed
    own = fit.problem.priors.pose_scatter
    assert own.source == "pin_moment"
    assert own.std == pytest.approx(found.values["random.pin_moment"], rel=0.3)
    interval = profile_interval(fit)
    assert interval.low < found.values["bending_stiffness"] < interval.high


def test_ipopt_finds_the_same_minimum_with_moments_as_unknowns(rubbed):
    fit = descend(rubbed[1])
    point, residual = solve_batch(fit.problem, fit.point)
    assert residual < 1e-7
    assert point.objective == pytest.approx(fit.point.objective, rel=1e-5)
    gap = point.shapes.deviation[:, -2:] - fit.point.shapes.deviation[:, -2:]
    assert np.abs(gap).max() < 1e-3 * fit.problem.priors.pose_scatter.std


def test_without_moments_of_its_own_each_pose_is_in_another_equilibrium(rubbed):
    fit = rubbed[1]
    priors = replace(fit.problem.priors, pose_scatter=PoseScatter())
    problem, point = replace(fit.problem, priors=priors).taken_over(fit.point, fit.problem)
    assert problem.equilibria.model == fit.model
    assert point.shapes.deviation.shape[1] == fit.point.shapes.deviation.shape[1] - 2
    assert np.abs(point.shapes.x - fit.point.shapes.x).max() > 0.01
    force = problem.equilibria.at(*problem.state(point)).imbalance()
    assert np.abs(force.rows).max() < 1e-6 * fit.model.force_scale
    back, again = fit.problem.taken_over(point, problem)
    assert not again.shapes.deviation[:, -2:].any()
    assert back.equilibria.model == fit.problem.equilibria.model


def test_moments_of_pins_are_written_in_newton_metres_and_read_back(rubbed):
    fit = rubbed[1]
    own, document = fit.problem.priors.pose_scatter, fit_dict(fit)
    written = document["scatter"]["from_pose_to_pose"]
    assert written == {"source": "pin_moment", "std": pytest.approx(own.std * fit.p[0])}
    assert own.size(fit.model, fit.p[0]) == (written["std"], "N m")
    read = metadata_of(document | {"model_hash": ""}, None).uncertainty.pose_scatter
    assert (read.source, read.std) == (own.source, pytest.approx(own.std))


def test_a_kept_mesh_is_that_of_the_misfit(misfit, shapes, near):
    fit = misfit[1]
    finer = SimpleNamespace(model=fit.model.with_mesh(near.model.n + 2))
    assert with_loose_poses(finer, shapes).model.n == near.model.n + 2


def test_simulated_shapes_do_not_depend_on_the_mesh_that_the_simulation_starts_with(monkeypatch):
    points = []
    for elements in (10, 40):
        monkeypatch.setitem(hidden_sets.ELEMENTS, 2, elements)
        session = simulated(generator_of(3301, 0), 2, 0, "rest_curvature").session
        measured = measured_poses(session, read_inputs(session))
        points.append(np.concatenate([item.points for item in measured]))
    gap = np.linalg.norm(points[1] - points[0], axis=1)
    assert np.sqrt((gap**2).mean()) < hidden_sets.FINE


def searched(seed, index, count, random="", among=()):
    """A simulated session and the search in its declared fit, among these effects or all."""
    found = drawn(generator_of(seed, index), 2, count, random)
    measured = measured_poses(found.session, read_inputs(found.session))
    fit = fit_declared(found.session, declared_model(found.session), measured)
    exclude = [name for name in EFFECTS if among and name not in among]
    return found, Search(Trials(fit, None, exclude, SIGNIFICANCE, InProcess()), 4, lambda *_: None)


@pytest.mark.long
def test_scatter_known_from_few_poses_does_not_pass_for_an_effect():
    """22 moments tell their variance as well as that: F of 18 degrees of freedom, no chi-square."""
    among = ("stiffness_gradient", "gravity_tilt", "lumped_mass")
    _, search = searched(3301, 6, 0, "pin_moment", among=among)
    assert search.declared.problem.priors.pose_scatter.source == "pin_moment"
    found = search.run()
    assert not found.added
    assert not found.unexplained
    without = search.beginning_with(declared=as_repeating(search.declared)).run()
    assert found.or_better(without, EVIDENCE_APART) is found


@pytest.mark.long
def test_a_drift_that_a_scatter_explains_as_well_is_found_without_it():
    """Beside its scatter a drift gained nothing; alone it is e^28 likelier than that scatter."""
    truth, search = searched(2061, 25, 2, among=("rest_curvature_drift",))
    assert search.declared.scatters
    found, _ = search.best()
    assert [item.name for item in found.added] == ["rest_curvature_drift"]
    assert not found.unexplained
    assert not found.fit.scatters
    assert found.fit.log_evidence > search.declared.log_evidence + 25
    interval = profile_interval(found.fit)
    assert interval.low < truth.values["bending_stiffness"] < interval.high


@pytest.mark.long
def test_two_effects_that_together_look_like_random_lengths_are_found():
    """Neither promises much alone: 0.25 of what the scatter gains."""
    _, search = searched(2811, 5, 2)
    assert search.declared.problem.priors.pose_scatter.source == "length_error"
    found, _ = search.best()
    assert [item.name for item in found.added] == ["axial_stretch", "rest_curvature_drift"]
    assert not found.unexplained
    assert not found.fit.scatters


@pytest.mark.long
def test_the_first_effect_is_judged_again_beside_the_second():
    """A tilt and a drift: alone, a force explained most; beside the drift the tilt is likelier."""
    among = ("rest_curvature_drift", "point_force", "gravity_tilt")
    _, search = searched(2061, 13, 2, among=among)
    base = as_repeating(search.declared)
    trials = replace(search.trials, declared=base)
    listed = {x.candidate.name: x for x in trials.first}
    drift = confirm(base, listed["rest_curvature_drift"]).fit
    beside = {x.candidate.name: x for x in trials.screened(drift)}
    fit = settle(confirm(drift, beside["point_force"]).fit)
    force = AddedEffect(
        listed["point_force"].candidate, 1e-9, cross_validate(base), cross_validate(fit), ()
    )
    before, after = cross_validate(drift), cross_validate(fit)
    own = Confirmed(listed["point_force"], fit, after, 0.0, settled=True)
    better, (found,) = judged(trials, own, drift, before, force)
    assert found.name == "gravity_tilt"
    assert better.log_evidence > fit.log_evidence
    assert "point_force" not in {x.name for x in better.model.effects}
    # Where no candidate may be added, what was known of rivals stays.
    alone = replace(trials, exclude=[*trials.exclude, *among])
    own = Confirmed(listed["gravity_tilt"], better, cross_validate(better), 0.0, settled=True)
    assert judged(alone, own, drift, before, found) == (better, [found])


@pytest.mark.long
def test_a_taper_is_judged_again_from_its_nominal_value():
    """Beside softening alone its slope seems to be -0.1: that had absorbed the true one of 0.35."""
    truth, search = searched(2811, 37, 2)
    assert truth.hidden == ("bending_softening", "stiffness_gradient")
    found, _ = search.best()
    assert {item.name for item in found.added} == set(truth.hidden)
    interval = profile_interval(found.fit)
    assert interval.low < truth.values["bending_stiffness"] < interval.high


@pytest.mark.long
def test_each_effect_of_a_pair_is_judged_again():
    """The fit of a drift alone is lost in this misfit, so the pair has a plastic set instead."""
    among = ("rest_curvature_drift", "plastic_set", "axial_stretch")
    truth, search = searched(2811, 135, 2, among=among)
    found, _ = search.best()
    assert {item.name for item in found.added} == set(truth.hidden)


@pytest.mark.long
def test_a_stretch_with_a_low_score_is_tried_before_pairs():
    """Declared 4.6 times too limp, the cable seems to have a stiff section and to be shorter."""
    among = ("axial_stretch", "stiff_section", "length_error", "bending_softening")
    truth, search = searched(2811, 174, 1, among=among)
    found, _ = search.best()
    assert [item.name for item in found.added] == ["axial_stretch"]
    name = "axial_stretch.compliance"
    assert abs(found.fit.value(name) - truth.values[name]) < 2 * found.fit.std(name)


def test_pose_that_its_own_scatter_tips_over_says_nothing_of_the_model():
    session = drawn(generator_of(3301, 7), 2, 0, "rest_curvature").session
    measured = measured_poses(session, read_inputs(session))
    fit = fit_declared(session, declared_model(session), measured)
    shape = fit_stage("batch", fit, measured, {}, ()).shapes["pose_02"]
    assert shape.rmse > 0.1
    assert shape.measured_branch.rmse < 0.003
    assert shape.undecided


def test_gap_of_two_equilibria_moves_with_each_repeat_as_energies_solved_anew():
    model, pose = MODELS["pins"]
    rest = np.zeros(model.chain.n_rests)
    pair = [
        solve_equilibrium(model, model.nominal, rest, replace(pose, branch=branch))
        for branch in ("cw", "ccw")
    ]
    for source in (REST_CURVATURE, "pin_moment"):
        scatter = PoseScatter(1e-3, source=source)
        moved = []
        for k, size in enumerate(scatter.sizes(scatter.ways(model)[1].shape[1])):
            energies = [
                [
                    solve_equilibrium(*changed(model, scatter, k, x), pose, x_init=eq.x).energy
                    for x in (1e-3, -1e-3)
                ]
                for eq in pair
            ]
            (a, b), (c, d) = energies
            moved.append(size * (a - b - c + d) / 2e-3)
        uncertainty = Uncertainty((), np.zeros((0, 0)), {}, scatter)
        repeats = Repeats(SolvedCable(model, model.nominal, rest, pose, pair[0]), uncertainty)
        assert repeats.gap_std(pair[1]) == pytest.approx(np.linalg.norm(moved), rel=1e-4)


@pytest.mark.parametrize("bend", [0.0, 4.0])
def test_gap_of_two_equilibria_is_as_uncertain_as_energies_solved_anew(bend):
    """Along EI and coefficients; a gap in units of EI keeps its sign if EI alone is not known."""
    model, pose = CableModel(PLANE, 12, n_rest=2), MODELS["pins"][1]
    size, p, rest = 3, model.nominal, np.full(model.chain.n_rests, bend)
    by_p, by_rest = np.zeros((1, size)), np.zeros((model.chain.n_rests, size))
    by_p[0, 0], by_rest[:, 1:] = p[0], model.rest_basis
    pair = [
        solve_equilibrium(model, p, rest, replace(pose, branch=branch)) for branch in ("cw", "ccw")
    ]
    whole, without = [], []
    for way in 1e-4 * np.eye(size):
        gaps, stiff = [], []
        for there in (way, -way):
            given = p + by_p @ there, rest + by_rest @ there
            one, other = (solve_equilibrium(model, *given, pose, x_init=x.x).energy for x in pair)
            gaps.append(one - other)
            stiff.append((one - other) / given[0][0] * p[0])
        whole.append((gaps[0] - gaps[1]) / 2e-4)
        without.append((stiff[0] - stiff[1]) / 2e-4)
    covariance = np.diag([1.0, 0.1, 0.1]) ** 2
    held = SolvedCable(model, p, rest, pose, pair[1])
    found = EnergyGap.between(held, pair[0], (by_p, by_rest), covariance)
    assert found.value == pytest.approx(pair[0].energy - pair[1].energy)
    scale = np.abs(whole).max()
    np.testing.assert_allclose(found.slope, without, rtol=0, atol=1e-4 * scale)
    stds = [np.sqrt(np.array(x) @ covariance @ x) for x in (whole, without)]
    assert (stds[0] < stds[1]) == (bend == 0.0)
    assert found.std == pytest.approx(min(stds), rel=1e-3)


def test_density_of_a_pose_with_turned_clamps_is_that_of_its_own_turns(near):
    """The fit is right, so that densities as predicted are those to first order."""
    validation = cross_validate(near)
    for k, density in enumerate(validation.densities):
        ends, fixed = near.linearization.by_deviation[k], near.problem.deviation_std
        white = near.linearization.residuals[k] - ends @ near.own_deviations[k]
        covariance = np.eye(len(white)) + (ends * fixed**2) @ ends.T
        alone = -white @ np.linalg.solve(covariance, white) / 2
        alone -= np.linalg.slogdet(covariance)[1] / 2
        alone += np.linalg.slogdet(near.problem.whitening[k])[1]
        assert density == pytest.approx(alone, abs=5.0)
