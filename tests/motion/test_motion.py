"""A cable's way in time: equilibria rest, energy is kept or lost to damping, second order."""

from dataclasses import replace

import numpy as np
import pytest

from dlo_casadi.effects import AirDrag, CableData, LumpedMass, PinFriction, Tether
from dlo_casadi.equilibrium.pose import HeldPose
from dlo_casadi.equilibrium.solve import solve_equilibrium
from dlo_casadi.errors import DloError, MotionError
from dlo_casadi.model.cable_model import CableModel
from dlo_casadi.motion.modes import damped_modes
from dlo_casadi.motion.path import FixturePath
from dlo_casadi.motion.system import MovingCable
from dlo_casadi.motion.trajectory import way_of


def model_of(dimension, ends=("clamped", "free"), n=10, damping_time=None, effects=()):
    torsion = 0.006 if dimension == 3 else None
    data = CableData(0.6, 0.06, 0.008, 0.009, "cable", False, torsion, damping_time)
    gravity = (*(0.0,) * (dimension - 1), -9.81)
    return CableModel(data, n, start=ends[0], end=ends[1], gravity=gravity, effects=effects)


def pose_of(model):
    """Ends 0.4 m apart, or a free end; clamps along x."""
    d, held = model.node.dimension, {}
    if model.end.place:
        held["end"] = (0.4, 0.1, 0.05)[:d]
    for side, kind in (("start", model.start), ("end", model.end)):
        if kind.direction:
            name = "heading" if d == 2 else "orientation"
            held[f"{side}_{name}"] = 0.3 if d == 2 else (0.1, 0.0, 0.0, 0.995)
    return HeldPose(start=(0.0,) * d, **held)


def at_rest(model, values=()):
    """The cable at rest: system, state, path of resting fixtures."""
    values, pose = dict(values), pose_of(model)
    p = np.array([values.get(q.name, q.nominal) for q in model.parameters])
    rest = model.rest_basis @ np.full(model.n_coefficients, 0.5)
    cable = MovingCable(model, p, rest)
    eq = solve_equilibrium(model, p, rest, pose)
    return cable, cable.at_rest(eq, cable.fixtures(pose.vector)), FixturePath(pose, {})


def let_go(model, values=()):
    """The cable in the shape that gravity from aside gives it."""
    cable, _, path = at_rest(model, values)
    aside = (4.0, -9.81) if model.node.dimension == 2 else (3.0, 5.0, -9.81)
    _, found, _ = at_rest(replace(model, gravity=aside), values)
    state = cable.still_state(found.x, 0 * found.force, 0 * found.moment)
    return cable, cable.with_places(state, path.at(0.0, cable)), path


EVERYTHING = {
    "lumped_mass.mass": 0.01,
    "lumped_mass.position": 0.2,
    "tether.stiffness": 3.0,
    "tether.position": 0.35,
    "tether.anchor_y": 0.3,
    "air_drag.coefficient": 1.1,
    "pin_friction.moment": 1e-3,
}


@pytest.mark.parametrize("dimension", [2, 3])
@pytest.mark.parametrize(
    "ends", [("clamped", "free"), ("pinned", "pinned"), ("clamped", "clamped")]
)
def test_an_equilibrium_rests(dimension, ends):
    effects = (LumpedMass(), Tether(), AirDrag(), PinFriction())
    model = model_of(dimension, ends, damping_time=0.02, effects=effects)
    cable, state, path = at_rest(model, EVERYTHING)
    way = way_of(cable, state, path, (0.0, 0.5), dt=0.05)
    assert np.abs(way.states[-1].r - state.r).max() < 1e-11
    assert np.abs(way.states[-1].v).max() < 1e-10
    assert np.ptp(way.energy) < 1e-13


@pytest.mark.parametrize("dimension", [2, 3])
def test_steps_in_time_are_of_second_order(dimension):
    cable, state, path = let_go(model_of(dimension, damping_time=0.02))
    ends = [way_of(cable, state, path, (0.0, 0.4), dt=0.4 / count) for count in (40, 80, 160)]
    tips = np.array([way.points(np.array([0.4]), np.array([0.6]))[0, 0] for way in ends])
    gaps = np.linalg.norm(np.diff(tips, axis=0), axis=1)
    assert np.log2(gaps[0] / gaps[1]) > 1.8


@pytest.mark.parametrize("dimension", [2, 3])
def test_energy_is_kept_without_damping_and_lost_to_it_with(dimension):
    cable, state, path = let_go(model_of(dimension))
    way = way_of(cable, state, path, (0.0, 0.5), dt=0.0025)
    swing = way.energy[0] - at_rest_energy(cable, path)
    # A cable let go loses what its highest frequencies have of the jump in the first steps.
    assert np.ptp(way.energy[20:]) < 1e-3 * swing
    effects = (AirDrag(), LumpedMass())
    model = model_of(dimension, damping_time=0.02, effects=effects)
    cable, state, path = let_go(model, EVERYTHING)
    way = way_of(cable, state, path, (0.0, 0.5), dt=0.0025)
    lost = way.energy[20] - way.energy[-1]
    power = way.power[20:]
    assert np.sum(np.diff(way.t[20:]) * (power[1:] + power[:-1]) / 2) == pytest.approx(
        lost, rel=1e-3
    )


@pytest.mark.long
@pytest.mark.parametrize("dimension", [2, 3])
def test_energy_drifts_by_less_than_a_thousandth_in_a_hundred_periods(dimension):
    cable, state, path = at_rest(model_of(dimension))
    fixtures = path.at(0.0, cable)
    mode = damped_modes(cable, state, fixtures, 1)
    turned = cable.steps(mode.vectors[:, 0].real)[0]
    x = np.asarray(cable.model.node.moved(state.x, 0.2 * turned / np.abs(turned).max()))
    swung = cable.with_places(replace(state, x=x), fixtures)
    period = 2 * np.pi / mode.rates[0]
    way = way_of(cable, swung, path, (0.0, 100 * period), dt=period / 100)
    energy = way.energy[10:]
    assert np.ptp(energy) < 1e-3 * (energy[0] - at_rest_energy(cable, path))


def at_rest_energy(cable, path):
    """Energy [J] of the equilibrium."""
    eq = solve_equilibrium(cable.model, cable.p, cable.rest, path.pose)
    return eq.energy


def test_an_end_torn_out_of_reach_says_when():
    cable, state, _ = at_rest(model_of(2, ("pinned", "pinned")))
    times = np.linspace(0.0, 1.0, 11)
    ends = np.stack([0.4 + 0.5 * times, np.full(11, 0.1)], axis=1)
    path = FixturePath.of(pose_of(cable.model), times, {"end": ends})
    with pytest.raises(MotionError, match="reach") as error:
        way_of(cable, state, path, (0.0, 1.0))
    assert error.value.t == pytest.approx(0.38, abs=0.02)  # |(0.4 + t / 2, 0.1)| = 0.6


def test_what_cannot_move_is_refused():
    with pytest.raises(DloError, match="has an end that slides"):
        MovingCable(replace(model_of(2), end="slide"), np.zeros(1), np.zeros(10))
