"""What is declared as fixed stays so when an effect is added or dropped."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.linalg import block_diag
from scipy.stats import chi2

from dlo_casadi.diagnosis import refits
from dlo_casadi.diagnosis.candidates import candidates, setup_of
from dlo_casadi.diagnosis.crossval import cross_validate
from dlo_casadi.diagnosis.diagnose import NEAR, SHAPES, Search
from dlo_casadi.diagnosis.found import AddedEffect
from dlo_casadi.diagnosis.gram import sidak
from dlo_casadi.diagnosis.refits import Confirmed, refit_with, refit_without
from dlo_casadi.diagnosis.screening import Screen, _Moving
from dlo_casadi.diagnosis.selection import p_of_evidence
from dlo_casadi.diagnosis.trials import Trials, judged
from dlo_casadi.diagnosis.unknown_force import _Search
from dlo_casadi.effects import (
    EFFECTS,
    CableData,
    ClipOffset,
    LengthError,
    LumpedMass,
    PointForce,
    Tether,
    UnknownPull,
)
from dlo_casadi.equilibrium.pose import HeldPose
from dlo_casadi.errors import EstimationError
from dlo_casadi.estimation.descent import refit
from dlo_casadi.estimation.fit import fit_model, refine_mesh
from dlo_casadi.estimation.prediction import predict_poses
from dlo_casadi.estimation.problem import Priors
from dlo_casadi.model.cable_model import CableModel
from dlo_casadi.model.clips import HeldClip
from dlo_casadi.model.tolerances import Tolerances
from dlo_casadi.runtime.executors import InProcess
from dlo_casadi.sensing.measured_pose import MeasuredPose
from dlo_casadi.thresholds import SIGNIFICANCE

NOISE = 3e-4
PLAIN = CableModel(CableData(0.5, 0.03, 0.006, 0.01), 12, n_rest=5)
DECLARED = PLAIN.with_effect(LumpedMass())
FIXED = {"lumped_mass.mass": 5e-3, "lumped_mass.position": 0.2}  # kg, m; nominal: 0 and L / 4


def taper_of(model):
    """The candidate whose section changes along the cable."""
    return next(c for c in candidates(model, setup_of(model)) if c.name == "stiffness_gradient")


@pytest.fixture(scope="module")
def base():
    """A cable that tapers and carries a known weight, fitted without the taper."""
    truth = taper_of(PLAIN).add_to(DECLARED)
    p = np.array([0.01, *FIXED.values(), 0.4])
    poses = [HeldPose((0.0, 0.0), (x, y)) for x, y in ((0.3, 0.0), (0.2, -0.2), (0.35, 0.1))]
    rng = np.random.default_rng(0)
    s = np.linspace(0.02, 0.98, 40) * PLAIN.cable.length
    measured = [
        MeasuredPose.of_points(
            shape_pose, shape.curve.at(s) + rng.normal(scale=NOISE, size=(40, 2))
        )
        for shape_pose, shape in zip(
            poses, predict_poses(truth, p, np.zeros(truth.chain.n_cells), poses), strict=True
        )
    ]
    values = DECLARED.nominal.copy()
    values[1:] = list(FIXED.values())
    return fit_model(
        DECLARED, measured, Tolerances(), NOISE, free=["bending_stiffness"], values=values
    )


def kept(fit):
    return {name: fit.value(name) for name in FIXED if name in fit.model.names}


def test_a_fixed_effect_stays_when_another_is_added_and_dropped(base):
    taper = taper_of(base.model)
    (screened,) = Screen(base, [taper]).run(np.inf)

    larger = refit_with(base, screened)

    assert kept(larger) == FIXED
    assert set(larger.problem.unknowns.names[:2]) == {
        "bending_stiffness",
        "stiffness_gradient.slope",
    }
    slope, std = (f("stiffness_gradient.slope") for f in (larger.value, larger.std))
    assert abs(slope - 0.4) < 3 * std
    smaller = refit_without(larger, taper, base)
    assert kept(smaller) == FIXED
    assert "lumped_mass.mass" not in smaller.problem.unknowns.names


def test_the_likeliest_refit_starts_at_the_measured_shapes_too_if_it_leaves_more_than_noise(base):
    (screened,) = Screen(base, [taper_of(base.model)]).run(np.inf)
    larger = refit_with(base, screened)
    stuck = refit(base, larger.model, steps=1, values={"stiffness_gradient.slope": -0.5})
    trials = Trials(base, None, (), SIGNIFICANCE, InProcess())
    assert stuck.beyond_noise
    assert not larger.beyond_noise

    (found,) = trials._at_shapes([Confirmed.of(screened, base, stuck)])
    assert found.fit.point.objective == pytest.approx(larger.point.objective, rel=1e-3)
    assert kept(found.fit) == FIXED
    assert trials.refitted == {"stiffness_gradient": found}
    known = [Confirmed.of(screened, base, larger)]
    assert trials._at_shapes(known) == known


def test_poses_are_left_out_only_where_a_refit_gains_evidence(base):
    (screened,) = Screen(base, [taper_of(base.model)]).run(np.inf)
    larger = refit_with(base, screened)
    assert Confirmed.of(screened, base, larger).validation is not None
    assert Confirmed.of(screened, larger, base).validation is None


def test_a_score_is_the_gain_of_least_squares_with_the_candidate(base):
    """To first order: what residuals and priors leave without it, less what they leave with it."""
    taper = taper_of(base.model)
    (found,) = Screen(base, [taper]).run(np.inf)
    moving = _Moving.of(base, [taper])
    problem, point = moving.problem, moving.at({})
    lin = problem.linearize(point)
    std, columns = problem.deviation_std, problem.equilibria.used_deviations
    sizes, vectors = np.linalg.eigh(problem.precision)
    root = np.sqrt(np.maximum(sizes, 0.0))[:, None] * vectors.T
    jacobian = np.hstack([np.concatenate(lin.by_theta), block_diag(*lin.by_deviation)])
    rows = np.vstack([jacobian, block_diag(root, *[np.diag(1 / std)] * 3)])
    own = point.shapes.deviation[:, columns] / std
    target = np.concatenate([*lin.residuals, root @ (point.theta - problem.mean), *own])
    k = problem.unknowns.names.index("stiffness_gradient.slope")
    without, beside = (
        np.linalg.lstsq(some, target, rcond=None)[1][0] for some in (np.delete(rows, k, 1), rows)
    )
    assert found.score == pytest.approx(without - beside, rel=1e-3)


def test_the_one_step_estimate_of_a_nuisance_is_the_minimum_without_its_prior():
    """The cable is 2 mm longer than declared, four tolerances of which the prior takes a part."""
    name = "length_error.length_difference"
    model = PLAIN.with_effect(LengthError(), {name: 5e-4})
    poses = [HeldPose((0.0, 0.0), (x, y)) for x, y in ((0.3, 0.0), (0.2, -0.2), (0.35, 0.1))]
    p, s = model.nominal.copy(), np.linspace(0.02, 0.98, 40) * PLAIN.cable.length
    p[model.names.index(name)] = 2e-3
    shapes = predict_poses(model, p, np.zeros(model.chain.n_cells), poses)
    measured = [
        MeasuredPose.of_points(pose, shape.curve.at(s))
        for pose, shape in zip(poses, shapes, strict=True)
    ]
    fit = fit_model(model, measured, Tolerances(), NOISE)
    assert fit.value(name) > 0.5e-3
    length = next(c for c in candidates(model, setup_of(model)) if c.name == "length_error")
    (screened,) = Screen(fit, [length]).run(np.inf)
    assert screened.start[name] == pytest.approx(refit_with(fit, screened).value(name), rel=0.05)


def test_the_best_of_several_clips_is_corrected_for_their_number(base):
    """Of five clips without an error, 23 % of the best had p < 0.05."""
    clipped = replace(PLAIN, clips=("pinned", "eyelet", "pinned"))
    alike = {c.effect.label: c.alike for c in candidates(clipped, setup_of(clipped))}
    assert [alike[x] for x in ("clip_offset_3", "clip_slip_3", "gravity_tilt")] == [3, 2, 1]
    tilt = next(c for c in candidates(base.model, setup_of(base.model)) if c.name == "gravity_tilt")
    (one,) = Screen(base, [tilt]).run(np.inf)
    (best,) = Screen(base, [replace(tilt, alike=5)]).run(np.inf)
    assert best.p_value == sidak(one.p_value, 5)


def test_a_fixed_effect_stays_on_another_mesh_and_beside_an_unknown_pull(base):
    assert kept(refine_mesh(base, 16)) == FIXED
    search = _Search(base, base.model.with_effect(UnknownPull()), "unknown_pull.position")
    unknowns = search.held_at(0.5).unknowns
    found = SimpleNamespace(
        model=unknowns.model, value=lambda name: unknowns.fixed[unknowns.model.names.index(name)]
    )
    assert kept(found) == FIXED
    assert not unknowns.free[1:3].any()


def test_an_unknown_force_has_its_prior_beside_clips(base):
    clipped = replace(PLAIN, clips=("pinned",))
    problem = replace(
        base.problem,
        unknowns=replace(base.problem.unknowns, model=clipped),
        priors=Priors.of(Tolerances(), clipped.with_effect(UnknownPull())),
    )
    model = clipped.with_effect(UnknownPull())
    search = _Search(SimpleNamespace(problem=problem), model, "unknown_pull.position")
    std = search._problem(base.problem.unknowns).priors.scatter
    stds = dict(zip(model.deviation_names, std, strict=True))
    assert np.isfinite(std).all()
    assert stds["unknown_force_x"] == stds["unknown_force_y"] > 0.1  # of its weight of 0.3 N
    assert stds["clip_0_x"] == Tolerances().clip


def test_a_fit_that_loses_its_poses_starts_again_from_the_declared_model(base, monkeypatch):
    """If it ends above that model, which is nested in it."""
    (screened,) = Screen(base, [taper_of(base.model)]).run(np.inf)
    larger, followed, lost = refit_with(base, screened), refits.followed, []

    def first_lost(start, *others, **options):
        found = followed(start, *others, **options)
        if not lost:
            lost.append(found)
            found = replace(found, point=replace(found.point, objective=1e9))
        return found

    monkeypatch.setattr(refits, "followed", first_lost)
    smaller = refit_without(larger, taper_of(base.model), base)
    assert smaller.point.objective == pytest.approx(lost[0].point.objective, rel=1e-6)


def test_a_refit_beside_another_effect_has_the_weights_of_its_base(base, monkeypatch):
    (screened,) = Screen(base, [taper_of(base.model)]).run(np.inf)
    larger = refit_with(base, screened)
    beside = larger.reweighed(replace(base.noise, std=3 * NOISE))
    monkeypatch.setattr(refits, "refit_with", lambda *_, **__: None)  # the base loses its poses
    assert refits.confirm(base, screened) is None
    found = refits.confirm(base, screened, beside=beside)
    assert found.fit.problem.weights is base.problem.weights
    assert found.gain == pytest.approx(
        2 * (base.point.objective - larger.point.objective), rel=1e-6
    )


def test_the_offset_of_another_clip_replaces_a_first_one():
    """As the diagnosis may choose it for want of what it finds later."""
    held = (HeldClip("pinned", (0.25, 0.02), 0.3), HeldClip("pinned", (0.5, 0.0), 0.6))
    model = CableModel(CableData(0.9, 0.06, 0.006, 0.02), 18, n_rest=0, clips=("pinned", "pinned"))
    moved, rng, measured = model.with_effect(ClipOffset(clip=1)), np.random.default_rng(0), []
    s, values = np.linspace(0.02, 0.88, 40), {"clip_offset_2.dx": 4e-3, "clip_offset_2.dy": -6e-3}
    p = np.array([values.get(name, x) for name, x in zip(moved.names, moved.nominal, strict=True)])
    for end in ((0.75, 0.1), (0.7, -0.15), (0.8, 0.0)):
        pose = HeldPose((0.0, 0.0), end, clips=held)
        (seen,) = predict_poses(moved, p, np.zeros(18), [pose])
        points = seen.curve.at(s) + rng.normal(scale=NOISE, size=(40, 2))
        measured.append(MeasuredPose.of_points(pose, points, s=s))
    base = fit_model(model, measured, Tolerances(), NOISE)
    first, _ = (c for c in candidates(model, setup_of(model)) if c.name == "clip_offset")
    wrong = refits.confirm(base, *Screen(base, [first]).run(np.inf))
    effect = AddedEffect(first, 1e-9, cross_validate(base), wrong.validation, ())
    among = [name for name in EFFECTS if name != "clip_offset"]
    trials = Trials(base, None, among, SIGNIFICANCE, InProcess())
    own, before = replace(wrong, settled=True), cross_validate(base)
    better, (effect,) = judged(trials, own, base, before, effect)
    assert effect.candidate.effect == ClipOffset(clip=1)
    assert not effect.rivals
    assert better.value("clip_offset_2.dy") == pytest.approx(-6e-3, abs=3e-4)
    own = replace(own, fit=better, screened=replace(own.screened, candidate=effect.candidate))
    own = replace(own, validation=cross_validate(better))
    assert judged(trials, own, base, before, effect) == (better, [effect])


@pytest.mark.parametrize(
    ("ahead", "frees", "sets", "significant"),
    [(5.0, ["abc"], 18, False), (25.0, ["abc"], 18, True), (12.0, ["abc", "d"], 153, False)],
)
def test_effects_have_to_explain_more_than_what_is_in_their_place(ahead, frees, sets, significant):
    """Three parameters of one of 18 candidates: a chi-square of 19 is one in 200 by chance.

    A pair is one of 153, and all its parameters count.
    """
    scatter = SimpleNamespace(dof=np.inf)
    known = SimpleNamespace(slow_dof=np.inf)
    problem = SimpleNamespace(priors=SimpleNamespace(pose_scatter=scatter))
    fits = [SimpleNamespace(log_evidence=x, noise=known, problem=problem) for x in (ahead, 0.0)]
    each = [SimpleNamespace(candidate=SimpleNamespace(frees=x, alike=1)) for x in frees]
    p_value = p_of_evidence(SimpleNamespace(each=each), *fits, 18)
    dof = sum(map(len, frees))
    assert p_value == pytest.approx(sidak(chi2.sf(2 * ahead, dof), sets), rel=1e-6)
    assert (p_value < SIGNIFICANCE) is significant


def test_a_search_that_fails_leaves_it_to_that_from_the_measured_shapes(base, monkeypatch):
    search = Search(Trials(base, None, (), SIGNIFICANCE, InProcess()), 4, lambda *_: None)
    asked = []

    def run(own):
        asked.append(own.trials.from_shapes)
        if not own.trials.from_shapes:
            raise EstimationError("lost")
        return "found"

    monkeypatch.setattr(Search, "run", run)
    assert search.best((*NEAR, SHAPES)) == ("found", None)
    assert asked == [False, True]
    with pytest.raises(EstimationError, match="lost"):
        search.best(NEAR)


def test_a_dead_force_is_handed_on_to_a_tether_whose_anchor_would_be_too_far():
    """Its linear fit ends at a stiffness of zero; stiffness and anchor have to stay a pair."""
    cable = CableData(0.6, 0.08, 0.008, 0.012, straight=True)
    model = CableModel(cable, 12, start="clamped", end="free", n_rest=0)
    pulled = model.with_effect(PointForce())
    known = {"point_force.position": 0.4, "point_force.fx": 0.05, "point_force.fy": 0.1}
    p = np.array([known.get(x, y) for x, y in zip(pulled.names, pulled.nominal, strict=True)])
    poses = [HeldPose((0.0, 0.0), None, h, name=f"{h:g}") for h in (-2.4, -1.4, -0.8)]
    s = np.linspace(0.06, 0.6, 8)
    measured = [
        MeasuredPose.of_points(x, y.curve.at(s), s=s)
        for x, y in zip(poses, predict_poses(pulled, p, np.zeros(12), poses), strict=True)
    ]
    base = fit_model(model, measured, Tolerances(), 4e-4)
    larger = model.with_effect(Tether())
    given = {"tether.position": 0.4, "tether.stiffness": 0.1, "tether.anchor_x": 0.5}
    begun, values = refits._in_linear(base, larger, given, np.inf)
    assert not {"tether.stiffness", "tether.anchor_x"} & {*begun.model.names}
    assert begun.value("tether_linear.stiffness") < values["tether.stiffness"]
    for axis in "xy":
        force = values["tether.stiffness"] * values[f"tether.anchor_{axis}"]
        assert force == pytest.approx(begun.value(f"tether_linear.f{axis}"))
    fit = refits.followed(base, larger, given)
    assert fit.point.objective < begun.point.objective + 1.0
