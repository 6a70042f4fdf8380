"""Forces and moments on the fixtures: statics, derivatives, and what a fit makes of them."""

from dataclasses import replace

import numpy as np
import pytest

import dlo_casadi as dlo
from dlo_casadi.effects import CableData, SensorBias, Setup, StartSpring
from dlo_casadi.equilibrium.curve import NodeCurve, Observed
from dlo_casadi.equilibrium.limits import fixtures_of, sizes_of
from dlo_casadi.equilibrium.pose import HeldPose
from dlo_casadi.equilibrium.solve import solve_equilibrium
from dlo_casadi.equilibrium.spread import SolvedCable
from dlo_casadi.errors import ConfigError, MeasurementError
from dlo_casadi.estimation.fit import fit_model
from dlo_casadi.estimation.prediction import predict_poses
from dlo_casadi.estimation.variances import first_reading_noise, reading_noise_of
from dlo_casadi.model.assembly import Assembly, Inputs, Tangents
from dlo_casadi.model.cable_model import CableModel
from dlo_casadi.model.clips import HeldClip
from dlo_casadi.model.tolerances import Tolerances
from dlo_casadi.rod.ends import REACTIONS, reaction_rows
from dlo_casadi.sensing.measured_pose import MeasuredPose
from dlo_casadi.sensing.noise import NoiseModel, ReadingNoise

CABLE = CableData(0.8, 0.2, 0.012, 0.04)
IN_SPACE = replace(CABLE, torsional_stiffness=0.02)
TURNED = (0.1, -0.2, 0.3, np.sqrt(1 - 0.14))


def clamped(space: bool) -> tuple[CableModel, HeldPose]:
    if space:
        model = CableModel(IN_SPACE, 12, start="clamped", end="clamped", gravity=(0.0, 0.0, -9.81))
        pose = HeldPose((0.0, 0.0, 0.0), (0.5, 0.2, 0.1), None, None, (0.0, 0.0, 0.0, 1.0), TURNED)
        return model, pose
    return CableModel(CABLE, 12, start="clamped", end="clamped"), HeldPose(
        (0.0, 0.0), (0.5, 0.2), 0.3, -0.4
    )


def reactions(model: CableModel, pose: HeldPose) -> tuple[dict[str, np.ndarray], float, np.ndarray]:
    """By their names, energy [J], and nodes."""
    rest = np.full(model.chain.n_rests, 0.5)
    eq = solve_equilibrium(model, model.nominal, rest, pose)
    given = Inputs.of(model.nominal, rest, pose.vector[None])
    found = Assembly(model, eq.shapes, given).reactions()[0]
    return {name: found[at] for name, at in reaction_rows(model.node).items()}, eq.energy, eq.points


def moved(pose: HeldPose, model: CableModel, reaction: str, k: int, step: float) -> HeldPose:
    """The fixture moved along, or turned about, the k-th axis of the world."""
    side = reaction.split("_")[0]
    if reaction.endswith("force"):
        place = np.array(getattr(pose, side))
        place[k] += step
        return replace(pose, **{side: tuple(place)})
    if not model.in_space:
        return replace(pose, **{f"{side}_heading": getattr(pose, f"{side}_heading") + step})
    about = np.zeros(3)
    about[k] = step
    frame = np.array(getattr(pose, f"{side}_orientation"))
    own = -model.node.to_world(frame * [1, 1, 1, -1], -about)  # about the frame's own axes
    turned = model.node.moved(frame[None], own[None])[0]
    return replace(pose, **{f"{side}_orientation": tuple(turned)})


@pytest.mark.parametrize("space", [False, True])
def test_reactions_are_the_slope_of_the_energy(space):
    """-dV/d(place) is the force on a fixture, -dV/d(turn about the world's axis) the moment."""
    model, pose = clamped(space)
    known, _, _ = reactions(model, pose)
    step = 1e-4
    for name in REACTIONS:
        for k in range(len(known[name])):
            high, low = (reactions(model, moved(pose, model, name, k, s))[1] for s in (step, -step))
            # Central differences: step^2 times a third derivative of some 100 J / m^3 or less.
            assert known[name][k] == pytest.approx(-(high - low) / (2 * step), abs=2e-6), name


def about(arm: np.ndarray, force: np.ndarray) -> np.ndarray:
    """Moment (1,) or (3,) of a force."""
    if len(arm) == 3:
        return np.cross(arm, force)
    return np.array([arm[0] * force[1] - arm[1] * force[0]])


@pytest.mark.parametrize("space", [False, True])
def test_reactions_and_weight_balance(space):
    """Forces add up to the weight, moments about the start to that of the weight and the end."""
    model, pose = clamped(space)
    known, _, points = reactions(model, pose)
    gravity = np.array(model.gravity)
    weight = CABLE.mass * gravity
    np.testing.assert_allclose(known["start_force"] + known["end_force"], weight, atol=1e-9)
    curve = NodeCurve(CABLE.length, points, None)
    middle = curve.at(np.linspace(0, CABLE.length, 801)).mean(axis=0)
    total = about(middle - pose.start, weight)
    others = known["start_moment"] + known["end_moment"]
    others = others + about(np.array(pose.end) - pose.start, known["end_force"])
    # The polyline through the nodes cuts bows of h^2 k / 8 = 1 mm of a cable of 2 N.
    np.testing.assert_allclose(others, total, atol=2e-3)


def test_a_spring_at_a_pin_holds_a_moment():
    """M = k (phi - heading), what the cable turns the fixture by; without a spring none."""
    model = CableModel(CABLE, 12, effects=(StartSpring(),))
    p = model.nominal.copy()
    p[[model.names.index(f"start_spring.{name}") for name in ("stiffness", "heading")]] = 0.05, 0.4
    rest, pose = np.zeros(model.chain.n_rests), HeldPose((0.0, 0.0), (0.6, 0.0))
    eq = solve_equilibrium(model, p, rest, pose)
    found = Assembly(model, eq.shapes, Inputs.of(p, rest, pose.vector[None])).reactions()[0]
    expected = np.array([0.05 * (eq.phi[0] - 0.4), 0.0])
    np.testing.assert_allclose(found[[2, 5]], expected, atol=1e-12)
    np.testing.assert_allclose(eq.moments, expected, atol=1e-12)
    held = SolvedCable(model, p, rest, pose, eq)
    assert [x.name for x in fixtures_of(held) if x.takes_moment] == ["start"]
    sizes = sizes_of(held.assembly, "moment")
    np.testing.assert_allclose(sizes, [np.abs(expected[:1])], atol=1e-12)


def clipped(space: bool) -> tuple[CableModel, HeldPose]:
    """The same through a saddle and an eyelet."""
    model, pose = clamped(space)
    at = np.array([[0.17, 0.05, 0.06], [0.35, 0.2, 0.07]])[:, : len(pose.start)]
    turn = {"orientation": (0.1, 0.0, 0.2, np.sqrt(0.95))} if space else {"heading": 0.5}
    clips = HeldClip("clamped", tuple(at[0]), 0.25, **turn), HeldClip("eyelet", tuple(at[1]))
    return replace(model, clips=("clamped", "eyelet")), replace(pose, clips=clips)


@pytest.mark.parametrize("held", [clamped, clipped])
@pytest.mark.parametrize("space", [False, True])
def test_derivatives_of_readings(space, held):
    """Along moved nodes, multipliers, parameters (bias among them) and deviations."""
    model, pose = held(space)
    names = tuple(reaction_rows(model.node, len(model.clips)))
    setup = Setup(model.cable, gravity=model.gravity, readings=names, clips=model.clips)
    model = model.with_effect(SensorBias.made_for(setup))
    rest = np.full(model.chain.n_rests, 0.5)
    shapes = solve_equilibrium(model, model.nominal, rest, pose).shapes
    given = Inputs.of(model.nominal, rest, pose.vector[None])
    rng = np.random.default_rng(0)
    nodes = (model.chain.n_nodes, model.node.increment)
    sizes = [nodes, (model.n_border,), (len(model.names),), (len(rest),)]
    sizes.append((len(model.deviation_names),))
    x, lam, p, r, deviation = (rng.normal(size=(1, *size, 1)) for size in sizes)
    p[:, 0] *= model.nominal[0]
    along = Tangents(x, lam, p, r, deviation)
    slope = Assembly(model, shapes, given).readings_along(along)[0, :, 0]

    def at(s: float) -> np.ndarray:
        there = replace(
            shapes,
            x=model.node.moved(shapes.x, s * x[..., 0]),
            lam=shapes.lam + s * lam[..., 0],
            deviation=shapes.deviation + s * deviation[..., 0],
        )
        others = replace(given, p=given.p + s * p[..., 0])
        return Assembly(model, there, others).readings()[0]

    # Central differences of numbers of order one: 1e-10 of curvature, 1e-16 / 1e-5 of rounding.
    np.testing.assert_allclose(slope, (at(1e-5) - at(-1e-5)) / 2e-5, atol=1e-8)


@pytest.mark.parametrize("space", [False, True])
def test_readings_of_clips_are_the_forces_on_them(space):
    model, pose = clipped(space)
    rest = np.full(model.chain.n_rests, 0.5)
    eq = solve_equilibrium(model, model.nominal, rest, pose)
    found = Assembly(
        model, eq.shapes, Inputs.of(model.nominal, rest, pose.vector[None])
    ).reactions()
    rows = reaction_rows(model.node, 2)
    for k, load in enumerate(eq.clips, start=1):
        np.testing.assert_array_equal(found[0, rows[f"clip_{k}_force"]], load.force)
        assert np.linalg.norm(load.force) > 0.1


def test_readings_are_residuals_beside_points():
    """In units of their noise; what is of points (modes, weights, projections) is theirs alone."""
    points = np.array([[0.1, 0.0], [0.3, 0.0], [0.5, 0.0]])
    readings = {"end_force": (1.0, 2.0), "start_moment": (0.3,)}
    item = MeasuredPose.of_points(HeldPose((0.0, 0.0)), points).with_readings(readings)
    assert item.reactions == ("end_force", "start_moment")
    assert list(item.kinds) == ["point"] * 3 + ["moment", "force", "force"]
    seen = Observed(NodeCurve(0.8, np.array([[0.0, 0.0], [0.8, 0.0]]), None), np.zeros(6))
    s = item.places(0.8)
    np.testing.assert_allclose(item.residual(seen, s), [0, 0, 0, 0.3, 1.0, 2.0], atol=1e-15)
    noise = NoiseModel(1e-3, readings=ReadingNoise(0.01, 0.02))
    white = np.diag(1 / np.array([1e-3, 1e-3, 1e-3, 0.02, 0.01, 0.01]))
    np.testing.assert_allclose(item.whitening(noise, s), white)
    np.testing.assert_allclose(item.misread(seen, noise), [0.015, 0.1, 0.2])
    assert item.slow_rows(np.ones((3, 2))).shape == (6, 5)
    assert [x.stop for _, _, x in item.slices] == [3]


def test_noise_and_bias_of_readings_are_estimated():
    """24 readings of 20 mN and 2 mN m, off by 30 mN, not declared; EI is absolute by them."""
    rng = np.random.default_rng(0)
    model = CableModel(CABLE, 10, start="clamped", end="clamped", n_rest=4)
    ends = rng.uniform([0.35, -0.3], [0.6, 0.3], size=(12, 2))
    headings = rng.uniform(-0.6, 0.6, size=(12, 2))
    poses = [
        HeldPose((0.0, 0.0), tuple(end), *turn) for end, turn in zip(ends, headings, strict=True)
    ]
    s = np.linspace(0.05, 0.75, 20)
    measured = []
    predicted = predict_poses(model, model.nominal, np.zeros(model.chain.n_rests), poses)
    for pose, known in zip(poses, predicted, strict=True):
        readings = {
            "end_force": known.seen.readings[3:5] + rng.normal(scale=0.02, size=2) + 0.03,
            "end_moment": known.seen.readings[5:6] + rng.normal(scale=0.002, size=1),
        }
        points = known.curve.at(s) + rng.normal(scale=3e-4, size=(20, 2))
        measured.append(MeasuredPose.of_points(pose, points, s=s).with_readings(readings))
    setup = Setup(CABLE, readings=("end_force", "end_moment"), tolerances={"force_bias": 0.05})
    bias = SensorBias.made_for(setup)
    fit = fit_model(
        model.with_effect(bias, {f"sensor_bias.{k}": v for k, v in bias.prior(setup).items()}),
        measured,
        Tolerances(),
        3e-4,
    )
    # A size from 24 numbers is known to 1/sqrt(48), from 12 to 1/sqrt(24): three of these.
    assert fit.noise.readings.force == pytest.approx(0.02, rel=0.43)
    assert fit.noise.readings.moment == pytest.approx(0.002, rel=0.61)
    # A first guess counts as one component, what the unknowns explain as none.
    kinds = np.concatenate([item.kinds for item in measured])
    raw, taken = np.concatenate(fit.linearization.raw), np.concatenate(fit.leverages)
    guess, own = first_reading_noise(fit.model, stiffness=fit.p[0]).force, kinds == "force"
    assert taken[own].sum() > 1
    known = (np.sum(raw[own] ** 2) + guess**2) / (np.sum(1 - taken[own]) + 1)
    assert reading_noise_of(fit).force == pytest.approx(np.sqrt(known), rel=1e-9)
    for axis in "xy":
        name = f"sensor_bias.end_force_{axis}"
        assert fit.value(name) == pytest.approx(0.03, abs=3 * fit.std(name))
    assert fit.value("bending_stiffness") == pytest.approx(
        0.04, abs=3 * fit.std("bending_stiffness")
    )


def through_a_clip(read=lambda force: force):
    """Five poses, in three the force on the clip with 10 mN of noise, off by 30 mN; no mass."""
    rng, s = np.random.default_rng(0), np.linspace(0.05, 0.75, 25)
    cable = CableData(0.8, 0.15, 0.01, 0.03)
    model = CableModel(cable, 20, n_rest=0, start="clamped", end="clamped", clips=("pinned",))
    poses = []
    for k in range(5):
        end, turn = rng.uniform([0.5, -0.15], [0.65, 0.15]), rng.uniform(-0.4, 0.4, 2)
        place = tuple(0.5 * end + rng.uniform([-0.03, -0.1], [0.03, -0.02]))
        pose = HeldPose((0, 0), tuple(end), *turn, clips=(HeldClip("pinned", place, 0.4),))
        (known,) = predict_poses(model, model.nominal, np.zeros(20), [pose])
        force = known.seen.readings[-2:] + 0.03 + rng.normal(0, 0.01, 2)
        clip = {"kind": "pinned", "at": 0.4, "place": place}
        clip |= {"clip_force": read(force.tolist())} if k < 3 else {}
        held = {"start_heading": turn[0], "end_heading": turn[1], "clips": [clip]}
        points = known.curve.at(s) + rng.normal(0, 3e-4, (25, 2))
        poses.append(dlo.Pose((0, 0), end, points=points, at=s, **held))
    prior = {"bending_stiffness": 0.3, "rest_shape": "straight"}
    return dlo.Session(
        dlo.Cable(length=0.8, mass=None, diameter=0.01, **prior),
        poses,
        gravity=(0, -9.81),
        boundary=("clamped", "clamped"),
        std=3e-4,
        force_std=0.01,
        tolerances={"force_bias": 0.05},
        model={"n": 20},
    )


def test_a_sensor_at_a_clip_makes_stiffness_absolute_where_the_mass_is_unknown(tmp_path):
    result = through_a_clip().fit(diagnosis=False)
    for name, true in (("bending_stiffness", 0.03), ("mass", 0.15)):
        found = result.params[name]
        assert found.value == pytest.approx(true, abs=3 * found.std)
        assert found.std < 0.05 * true
    bias = result.params["sensor_bias.clip_1_force_x"]
    assert (bias.value, bias.unit) == (pytest.approx(0.03, abs=3 * bias.std), "N")
    # Both components together; three readings give the size of noise to 1/sqrt(12) at best.
    stage = result.stages[-1]
    assert stage.readings_fit.force == pytest.approx(0.01 * np.sqrt(2), rel=0.6)
    read = [x.readings["clip_1_force"] for x in stage.shapes.values() if x.readings]
    off = [np.linalg.norm(known - predicted) for known, predicted in read]
    assert len(off) == 3
    assert stage.readings_fit.force == pytest.approx(np.sqrt(np.mean(np.square(off))))
    result.write(tmp_path)
    assert dlo.load(tmp_path).model.effects == result.cable.model.effects


def test_wrong_readings_of_clips_are_told():
    with pytest.raises(ConfigError, match="shapes determine only the ratio of"):
        through_a_clip(lambda force: None)
    with pytest.raises(ConfigError, match=r"clip_1: clip_force: \[fx, fy\] belongs here"):
        through_a_clip(lambda force: [*force, 0.0])
    with pytest.raises(MeasurementError, match=r"clip_1_force is .* with the other sign"):
        through_a_clip(lambda force: [-x for x in force]).fit()
