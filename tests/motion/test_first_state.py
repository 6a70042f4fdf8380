"""The first state of a motion, near a measured shape that may be far from rest."""

from dataclasses import replace

import numpy as np
import pytest

from dlo_casadi.effects import CableData
from dlo_casadi.equilibrium.pose import HeldPose
from dlo_casadi.equilibrium.solve import solve_equilibrium
from dlo_casadi.model.cable_model import CableModel
from dlo_casadi.motion.beginning import Basis, begun, columns_of
from dlo_casadi.motion.sensitivities import Numbers
from dlo_casadi.motion.state import State
from dlo_casadi.motion.system import MovingCable
from dlo_casadi.rod.supports import SupportKind

PLANE = CableData(0.6, 0.06, 0.008, 0.009, damping_time=0.02)
SPACE = replace(PLANE, torsional_stiffness=0.007)
TURNED = (0.1, 0.2, 0.05, np.sqrt(1 - 0.0525))
COUNT = 6
CASES = {
    "plane, free": (PLANE, "free", {"start": (0.1, 0.6), "start_heading": -0.6}),
    "space, pinned": (
        SPACE,
        "pinned",
        {"start": (0.1, 0.2, 0.6), "end": (0.4, 0.4, 0.5), "start_orientation": TURNED},
    ),
}


def problem(name: str) -> tuple[MovingCable, HeldPose, State, State]:
    """A cable, how it is held, its state of rest, and one as if gravity acted aside."""
    cable, end, fields = CASES[name]
    gravity = (0.0, 0.0, -9.81) if cable is SPACE else (0.0, -9.81)
    kinds = SupportKind("clamped"), SupportKind(end)
    model = CableModel(cable, 8, start=kinds[0], end=kinds[1], gravity=gravity, n_rest=4)
    p, rest = model.nominal, np.zeros(model.chain.n_rests)
    held, moving = HeldPose(**fields), MovingCable(model, p, rest)
    fixtures = moving.fixtures(held.vector)
    still = moving.at_rest(solve_equilibrium(model, p, rest, held), fixtures)
    other = replace(model, gravity=(9.81, *(0.0 * x for x in gravity[1:])))
    x = solve_equilibrium(other, p, rest, held).x
    return moving, held, still, moving.with_places(replace(still, x=x), fixtures)


@pytest.mark.parametrize("name", CASES)
def test_first_states_are_differentiated(name: str) -> None:
    moving, held, still, aside = problem(name)
    fixtures, model = moving.fixtures(held.vector), moving.model
    basis = Basis.of(moving, still, fixtures, COUNT)
    basis = basis.near(moving, aside.x, fixtures)
    own = np.concatenate([0.01 * np.arange(COUNT), 0.3 * np.arange(COUNT)])
    state = begun(moving, basis.about, fixtures, basis, own)
    names = len(model.names)
    none = np.zeros((2, moving.d, names + 2 * COUNT))
    numbers = Numbers(
        np.pad(np.eye(names), ((0, 0), (0, 2 * COUNT))),
        np.zeros(
            (*model.chain.rest_inside(np.zeros((model.chain.n_rests, 1))).shape[:2], none.shape[2])
        ),
        np.zeros((2 * moving.b, none.shape[2])),
        none,
        none,
        none,
    )
    found = columns_of(moving, state, fixtures, basis, numbers, own)
    for k in range(names + 2 * COUNT):
        both = []
        size = 1e-5 * (abs(model.nominal[k]) if k < names else 1.0)
        for sign in (1, -1):
            p, first = model.nominal.copy(), own.copy()
            if k < names:
                p[k] += sign * size
            else:
                first[k - names] += sign * size
            both.append(begun(MovingCable(model, p, moving.rest), state, fixtures, basis, first))
        for key, own_of in (("place", "r"), ("rates", None)):
            one, other = (
                np.hstack([x.w, x.v]) if own_of is None else getattr(x, own_of) for x in both
            )
            change = (one - other) / (2 * size)
            gap = np.abs(getattr(found, key)[..., k] - change).max()
            assert gap < 1e-4 * max(np.abs(change).max(), 1e-3), (k, key)


def test_a_shape_far_from_rest_is_met() -> None:
    moving, held, still, aside = problem("plane, free")
    fixtures = moving.fixtures(held.vector)
    basis = Basis.of(moving, still, fixtures, COUNT)
    basis = basis.near(moving, aside.x, fixtures)
    state = begun(moving, basis.about, fixtures, basis, np.zeros(2 * COUNT))
    far = np.linalg.norm(aside.r[-1] - still.r[-1]) / moving.model.cable.length
    assert far > 0.9
    assert np.linalg.norm(state.r - aside.r, axis=1).max() < 0.02 * moving.model.cable.length
