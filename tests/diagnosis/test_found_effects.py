"""Effects that a simulated session hides, and what is said where their cause is not tried.

The sessions are simulated by this package's own model on a finer mesh, with 0.3 mm of noise.
"""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from dlo_casadi.diagnosis import crossval, refits, unknown_force
from dlo_casadi.diagnosis import diagnose as module
from dlo_casadi.diagnosis.candidates import candidates, setup_of
from dlo_casadi.diagnosis.crossval import cross_validate
from dlo_casadi.diagnosis.diagnose import diagnose
from dlo_casadi.diagnosis.gram import Screened
from dlo_casadi.diagnosis.refits import confirm, loads_from_best
from dlo_casadi.diagnosis.unknown_force import UnknownForce, estimate_unknown_force, start_from
from dlo_casadi.effects import EFFECTS, CableData
from dlo_casadi.equilibrium.pose import HeldPose
from dlo_casadi.estimation.fit import fit_model
from dlo_casadi.estimation.prediction import predict_poses
from dlo_casadi.model.cable_model import CableModel
from dlo_casadi.model.tolerances import Tolerances
from dlo_casadi.runtime.executors import InProcess
from dlo_casadi.sensing.measured_pose import MeasuredPose
from dlo_casadi.session.fitting import nuisances

CABLE = CableData(0.8, 0.2, 0.01, 0.1)
ENDS = ((0.6, 0.0), (0.3, 0.1), (0.5, -0.3), (0.2, -0.2), (0.65, 0.2), (0.35, -0.45), (0.5, 0.35))
NOISE = 3e-4
TETHER = (4.0, 0.45, 0.4, 0.3)  # N/m, m, m, m


@cache
def session(name: str, *values: float):
    """Fit of a plain model to a cable with one effect."""
    model = CableModel(CABLE, 40, effects=(EFFECTS[name](),), n_rest=5)
    rest = model.rest_basis @ np.array([0.5, 1.0, 1.5, 1.0, 0.0])
    poses = [HeldPose((0.0, 0.0), end) for end in ENDS]
    shapes = predict_poses(model, np.array([0.1, *values]), rest, poses)
    rng = np.random.default_rng(0)
    s = np.linspace(0.02, 0.98, 30) * CABLE.length
    measured = [
        MeasuredPose.of_points(pose, shape.curve.at(s) + rng.normal(scale=NOISE, size=(30, 2)))
        for pose, shape in zip(poses, shapes, strict=True)
    ]
    plain = nuisances(CableModel(CABLE, 10, n_rest=5), Tolerances())
    return fit_model(plain, measured, Tolerances(), NOISE)


def rivals_of(*names: str) -> tuple[str, ...]:
    """Effects to leave out, so that the search takes a second."""
    return tuple(name for name in EFFECTS if name not in names)


def named(diagnosis) -> set[str]:
    return {
        name
        for item in diagnosis.added
        for name in (item.candidate.name, *(rival.candidate.name for rival in item.rivals))
    }


def test_a_plastic_set_is_found_beside_a_drift():
    """Yield at 3 1/m, three tenths left: a drift predicts several times as badly."""
    fit = session("plastic_set", 3.0, 0.3)
    found = diagnose(fit, exclude=rivals_of("plastic_set", "rest_curvature_drift", "point_force"))
    assert found.verdict == "effect_found"
    assert named(found) == {"plastic_set"}
    # A cell of 80 mm has one mean bend, on one side of the yield: 14 %; with half of it 6 %.
    assert found.fit.value("plastic_set.yield_curvature") == pytest.approx(3.0, rel=0.2)
    assert found.fit.value("plastic_set.share") == pytest.approx(0.3, rel=0.2)


@pytest.mark.long
def test_a_drift_is_a_plastic_set_without_a_yield_curvature():
    """The smaller of the two is named; the larger cannot be told from it."""
    fit = session("rest_curvature_drift", 0.15)
    found = diagnose(fit, exclude=rivals_of("plastic_set", "rest_curvature_drift"))
    assert found.added[0].candidate.name == "rest_curvature_drift"
    assert named(found) == {"plastic_set", "rest_curvature_drift"}


@pytest.mark.long
def test_a_tether_is_found_and_is_no_point_force():
    fit = session("tether", *TETHER)
    found = diagnose(fit, exclude=rivals_of("tether", "point_force", "lumped_mass"))
    assert found.verdict == "effect_found"
    assert named(found) == {"tether"}
    for name, true in zip(("stiffness", "position", "anchor_x", "anchor_y"), TETHER, strict=True):
        key = f"tether.{name}"
        assert abs(found.fit.value(key) - true) < 3 * found.fit.std(key)


@pytest.mark.long
def test_wrong_causes_beside_an_unexplained_residual_are_withdrawn(monkeypatch):
    """A force and a stiff section stand for a tether in part; nothing predicts from them."""
    monkeypatch.setattr(module, "estimate_unknown_force", lambda *_: None)  # seconds, not needed
    fit = session("tether", *TETHER)
    found = diagnose(fit, exclude=rivals_of("point_force", "stiff_section"))
    assert found.verdict == "unexplained"
    assert found.added == ()
    assert found.validation.rmse == pytest.approx(found.validation_before.rmse)
    assert found.structure.p_value < 0.005
    assert {row.name for row in found.ranked} == {"point_force", "stiff_section"}
    assert all(row.rmse_cross_validated for row in found.ranked)  # all were refitted


def test_in_one_pose_a_tether_is_a_point_force():
    model = CableModel(CABLE, 10)
    one, two = ({c.name for c in candidates(model, setup_of(model, n_poses=n))} for n in (1, 2))
    assert two - one == {"tether", "plastic_set", "rest_curvature_drift"}


def test_the_forces_of_a_pull_tell_a_tethers_stiffness_and_anchor():
    """Forces k (a - r_j) at the places r_j of the poses' own shapes, by least squares."""
    fit = session("tether", *TETHER)
    stiffness, position, *anchor = TETHER
    seen = fit.problem.observed(fit.point)
    places = [seen[j].curve.at(np.array([position]))[0] for j in fit.problem.used]
    pull = UnknownForce(stiffness * (anchor - np.array(places)), position, (0.4, 0.5), fit)
    listed = {c.name: c for c in candidates(fit.model, setup_of(fit.model, n_poses=len(ENDS)))}
    given = pull.fit, pull.position, pull.force_per_pose
    start = start_from(*given, listed["tether"])
    names = ("stiffness", "position", "anchor_x", "anchor_y")
    assert [start[f"tether.{name}"] for name in names] == pytest.approx(TETHER, rel=1e-9)
    # A weight has no force across gravity: what comes closest along it.
    mass = start_from(*given, listed["lumped_mass"])["lumped_mass.mass"]
    assert mass == pytest.approx(max(0.0, -pull.force_per_pose[:, 1].mean() / 9.81))


def test_a_force_is_found_without_its_cause(monkeypatch):
    """Where it pulls, and how hard in each pose."""
    monkeypatch.setattr(unknown_force, "PLACES", (0.2, 0.4, 0.6))
    cable, force, position = replace(CABLE, straight=True), (0.5, 0.8), 0.3
    true = CableModel(cable, 10, effects=(EFFECTS["point_force"](),))
    poses = [HeldPose((0.0, 0.0), end, name=f"{end}") for end in ENDS[:3]]
    p, rest = np.array([0.1, *force, position]), np.zeros(true.chain.n_rests)
    rng, s = np.random.default_rng(0), np.linspace(0.02, 0.98, 30) * cable.length
    measured = [
        MeasuredPose.of_points(pose, shape.curve.at(s) + rng.normal(scale=NOISE / 10, size=(30, 2)))
        for pose, shape in zip(poses, predict_poses(true, p, rest, poses), strict=True)
    ]
    base = fit_model(CableModel(cable, 10), measured, Tolerances(), NOISE / 10)
    found = estimate_unknown_force(base, InProcess())
    assert found.interval[0] < position < found.interval[1] < found.interval[0] + 0.02
    assert found.force_per_pose == pytest.approx(np.tile(force, (3, 1)), abs=0.05)
    assert found.poses == tuple(pose.name for pose in poses)


def test_a_load_starts_from_the_place_and_forces_of_a_likelier_one(monkeypatch):
    """A force that its own start has led astray, or nowhere: half of its misfit is gone."""
    base = session("tether", *TETHER)
    listed = {c.name: c for c in candidates(base.model, setup_of(base.model, n_poses=len(ENDS)))}

    def started(name, **values):
        start = {f"{name}.{key}": value for key, value in values.items()}
        return Screened(listed[name], 1.0, 0.0, start)

    names = ("stiffness", "position", "anchor_x", "anchor_y")
    screened = [
        started("point_force", fx=0.5, fy=0.5, position=0.4),
        started("tether", **dict(zip(names, TETHER, strict=True))),
        started("stiffness_gradient", slope=0.1),
    ]
    force, tether, gradient = tried = [confirm(base, x) for x in screened]
    # It cannot compete with the tether, so by default it is given up.
    assert loads_from_best(base, screened, tried, InProcess()) == tried
    monkeypatch.setattr(refits, "GIVEN_UP", np.inf)
    found, *same = loads_from_best(base, screened, tried, InProcess())
    assert same == [tether, gradient]
    assert found.name == "point_force"
    assert found.fit.point.objective < force.fit.point.objective - 1000
    *_, nowhere = loads_from_best(base, screened, [tether, gradient], InProcess())
    assert nowhere.fit.point.objective == found.fit.point.objective
    # It stays beside the other effect of a pair, whose data are as sure of it as of the tether.
    pair = replace(tether, beside=(gradient.screened,))
    other = loads_from_best(base, screened, [pair], InProcess())[1]
    assert other.name == "stiffness_gradient and point_force"
    # A load that the pair already has is not added once more.
    loads = replace(tether, beside=(screened[0],))
    assert len(loads_from_best(base, screened, [loads], InProcess())) == 1
    # The likeliest is no load.
    assert loads_from_best(base, screened[2:], tried[2:], InProcess()) == [gradient]


def test_left_out_poses_that_no_fit_predicts_count_to_first_order(monkeypatch):
    """Where a load's unknowns are a product, stiffness and anchor."""
    base = session("tether", *TETHER)
    listed = {c.name: c for c in candidates(base.model, setup_of(base.model, n_poses=len(ENDS)))}
    start = dict(zip(listed["tether"].frees, TETHER, strict=True))
    fit = confirm(base, Screened(listed["tether"], 1.0, 0.0, start)).fit
    whole = cross_validate(fit)
    assert whole.complete
    monkeypatch.setattr(crossval, "_predicted", lambda fit, thetas: dict.fromkeys(thetas))
    lost = cross_validate(fit)
    assert lost.densities == pytest.approx(whole.densities, abs=1.0)
    assert lost.error == np.inf
