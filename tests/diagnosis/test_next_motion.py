"""The let-go that separates models of the same still shapes."""

from types import SimpleNamespace

import numpy as np
import pytest

import dlo_casadi as dlo
from dlo_casadi.diagnosis import next_motion as next_motion_module
from dlo_casadi.diagnosis.next_motion import (
    ASIDE,
    DURATION,
    RATE,
    NextMotion,
    _modes_of,
    _variances,
    next_motion,
)
from dlo_casadi.effects import (
    CableData,
    Effect,
    ImageScale,
    LumpedMass,
    PointForce,
    RestCurvatureDrift,
)
from dlo_casadi.equilibrium.pose import HeldPose
from dlo_casadi.errors import EquilibriumError
from dlo_casadi.estimation.fit import fit_model
from dlo_casadi.estimation.motion_fit import fit_motions
from dlo_casadi.estimation.prediction import predict_poses
from dlo_casadi.estimation.result import Fit
from dlo_casadi.model.cable_model import CableModel
from dlo_casadi.model.tolerances import Tolerances
from dlo_casadi.sensing.measured_motion import MeasuredMotion
from dlo_casadi.sensing.measured_pose import MeasuredPose

LENGTH, MASS, PLACE, STD = 0.6, 0.012, 0.45, 4e-4
CABLE = CableData(LENGTH, 0.08, 0.008, 0.012, straight=True)
MODEL = CableModel(CABLE, 12, start="clamped", end="free", n_rest=0)


@pytest.fixture(scope="module")
def measured() -> list[MeasuredPose]:
    """Markers of a cable with a weight."""
    heavy, rng = MODEL.with_effect(LumpedMass()), np.random.default_rng(0)
    p = values_of(heavy, "lumped_mass.position", **{"lumped_mass.mass": MASS})
    poses = [HeldPose((0.0, 0.0), None, h, name=f"{h:g}") for h in (-2.4, -1.4, -0.8, 0.2)]
    s, rest = np.linspace(0.1, 1.0, 8) * LENGTH, np.zeros(MODEL.chain.n_rests)
    shapes = predict_poses(heavy, p, rest, poses)
    return [
        MeasuredPose.of_points(x, y.curve.at(s) + STD * rng.normal(size=(8, 2)), s=s)
        for x, y in zip(poses, shapes, strict=True)
    ]


def fitted(measured: list[MeasuredPose], effect: Effect) -> Fit:
    """The fit with a load at the right place."""
    model, place = MODEL.with_effect(effect), f"{effect.label}.position"
    free = [name for name in model.names if name != place]
    return fit_model(model, measured, Tolerances(), STD, free=free, values=values_of(model, place))


def values_of(model: CableModel, place: str, **known: float) -> np.ndarray:
    known |= {place: PLACE}
    return np.array([known.get(x, y) for x, y in zip(model.names, model.nominal, strict=True)])


def test_each_pose_starts_at_its_own_shape_where_others_leave_a_state(monkeypatch) -> None:
    """A problem with a state has the shapes of held-out poses, too."""
    model, known = MODEL.with_effect(RestCurvatureDrift()), {}
    x = np.arange(4.0)[:, None, None] * np.ones((4, MODEL.chain.n_nodes, 1))
    held = [HeldPose((0.0, 0.0), None, 0.1 * k, name=str(k)) for k in (1, 3)]
    problem = SimpleNamespace(used=[1, 3], fit_poses=[SimpleNamespace(pose=y) for y in held])
    given = {"model": model, "p": model.nominal, "rest_now": np.zeros(MODEL.chain.n_rests)}
    point = SimpleNamespace(shapes=SimpleNamespace(x=x))
    lost = [EquilibriumError("lost")] * 2
    monkeypatch.setattr(
        next_motion_module, "solve_equilibria", lambda *args: known.update(starts=args[-1]) or lost
    )
    _modes_of(SimpleNamespace(problem=problem, point=point, **given), [0, 1])
    assert [start[0, 0] for start in known["starts"]] == [1.0, 3.0]


def test_a_rate_is_known_as_well_as_linear_least_squares_knows_it() -> None:
    """A damped wave of unknown amplitude, phase, rate and damping in white noise."""
    w, zeta, size = 2 * np.pi * 6.0, 0.01, 0.05  # of many periods
    t = np.arange(0.0, DURATION, 1 / RATE)
    decay = np.exp(-zeta * w * t)
    x, y = decay * np.cos(w * t), decay * np.sin(w * t)
    by = np.stack([x, y, -size * t * x, -size * t * y], axis=1)
    variance = np.linalg.inv(by.T @ by)[3, 3]
    ((of_rate, of_shape),) = _variances(np.array([w]), np.array([zeta]), np.array([size]))
    assert of_rate == pytest.approx(variance, rel=0.02)
    # Another coordinate, in which the mode is not seen, has a share of its wave in phase.
    assert of_shape == pytest.approx(1 / (size**2 * x @ x), rel=0.02)


def test_a_weight_swings_slower_than_a_force(measured: list[MeasuredPose]) -> None:
    weight, force = (fitted(measured, effect) for effect in (LumpedMass(), PointForce()))
    told = next_motion(weight, {"point_force": force}, "lumped_mass")
    assert told is not None
    rival = told.rivals["point_force"]
    assert told.of == "lumped_mass"
    assert told.pose in {item.pose.name for item in measured}
    assert told.at == pytest.approx(LENGTH)
    assert told.aside == pytest.approx(ASIDE * LENGTH)
    assert rival.frequencies[0] > 1.05 * told.frequencies[0]
    assert rival.separation > 6.3, "a log evidence of 20"


def let_go(told: NextMotion, pose: HeldPose) -> MeasuredMotion:
    """What a camera sees of the proposed motion, of the cable with the weight."""
    s, t = np.linspace(0.1, 1.0, 8) * LENGTH, np.arange(0.0, told.duration, 1 / RATE)
    weight = {"name": "lumped_mass", "parameters": {"mass": MASS, "position": PLACE}}
    own = dlo.Cable(length=LENGTH, mass=0.08, diameter=0.008, bending_stiffness=0.012)
    known = {"gravity": (0.0, -9.81), "model": {"n": 24, "effects": [weight]}}
    held = {"start": pose.start, "start_heading": pose.start_heading}
    free = dlo.known_cable(own, **known, boundary=("clamped", "free")).with_damping(0.02)
    tied = dlo.known_cable(own, **known, boundary=("clamped", "pinned"))
    # Across the cable, and back to the tip's distance from the clamp.
    tip, before = free.solve(**held).curve.at(np.array([told.at, told.at - 0.01]))
    ahead = (tip - before) / np.linalg.norm(tip - before)
    end = tip + told.aside * np.array([-ahead[1], ahead[0]])
    end *= 0.98 * np.linalg.norm(tip) / np.linalg.norm(end)
    points = free.simulate(t, begins=tied.solve(**held, end=end), **held).at(s)
    points += STD * np.random.default_rng(1).normal(size=points.shape)
    resting = {key: np.array(x) for key, x in held.items()}
    none = np.zeros(0)
    return MeasuredMotion("go", t, points, s, none, {}, resting, at_rest=False, held_out=False)


def test_the_motion_gives_the_evidence_that_is_promised(measured: list[MeasuredPose]) -> None:
    """Within twice the standard deviations: first order, and three modes of small motions."""
    fits = [fitted(measured, effect) for effect in (LumpedMass(), PointForce())]
    told = next_motion(fits[0], {"point_force": fits[1]})
    assert told is not None
    (pose,) = (item.pose for item in measured if item.pose.name == told.pose)
    go = let_go(told, pose)
    moved = [fit_motions(fit, [go], STD) for fit in fits]
    weight, force = (x.objective - y.point.objective for x, y in zip(moved, fits, strict=True))
    assert moved[0].chi2_per_dof < 1.1
    separation = np.sqrt(2 * (force - weight))
    assert told.rivals["point_force"].separation / 2 < separation
    assert separation < 2 * told.rivals["point_force"].separation


def test_what_swings_alike_is_not_apart(measured: list[MeasuredPose]) -> None:
    weight = fitted(measured, LumpedMass())
    told = next_motion(weight, {"itself": weight})
    assert told is not None
    assert told.rivals["itself"].separation == pytest.approx(0.0, abs=1e-6)


def test_a_cable_that_nothing_keeps_from_rolling_has_no_rates_to_compare() -> None:
    """Between ball joints in space."""
    cable = CableData(LENGTH, 0.08, 0.008, 0.012, straight=True, torsional_stiffness=0.01)
    model = CableModel(cable, 8, start="pinned", end="pinned", n_rest=0, gravity=(0, 0, -9.81))
    poses = [HeldPose((0.0, 0.0, 0.0), (x, 0.1, 0.0), name=f"{x:g}") for x in (0.4, 0.5)]
    shapes = predict_poses(model, model.nominal, np.zeros(model.chain.n_rests), poses)
    s = np.linspace(0.1, 0.9, 8) * LENGTH
    measured = [
        MeasuredPose.of_points(x, y.curve.at(s), s=s) for x, y in zip(poses, shapes, strict=True)
    ]
    fit = fit_model(model, measured, Tolerances(), STD, refined=False)
    assert next_motion(fit, {"itself": fit}) is None


def test_recordings_know_no_effect_of_the_camera(measured: list[MeasuredPose]) -> None:
    plain = fit_model(MODEL, measured, Tolerances(), STD)
    scaled = fit_model(MODEL.with_effect(ImageScale()), measured, Tolerances(), STD)
    assert next_motion(plain, {"image_scale": scaled}) is None
