"""What recordings tell of effects that still shapes leave tied."""

from types import SimpleNamespace
from typing import Any

from dlo_casadi.diagnosis.candidates import Candidate
from dlo_casadi.diagnosis.told_apart import Hypothesis
from dlo_casadi.effects import LumpedMass
from dlo_casadi.effects.point_force import PointForce
from dlo_casadi.effects.tether import Tether
from dlo_casadi.session.found_effects import FoundEffect, with_motions

FOUND = FoundEffect(
    "lumped_mass", "lumped_mass", None, {}, 1e-9, 1e-3, 5e-4, ("point_force", "mass_error")
)


def hypothesis(effect: Any, still: float, moving: float) -> Hypothesis:
    fit: Any = SimpleNamespace()
    return Hypothesis(Candidate(effect, (), (), ({},), nuisance=False), fit, still, moving)


def test_a_rival_that_motions_reject_is_no_tie() -> None:
    told = [hypothesis(LumpedMass(), 0.0, 0.0), hypothesis(PointForce(), 0.5, -30.0)]
    found = with_motions(FOUND, told[0], told)
    assert found.told_apart == {"point_force": (-0.5, 30.0)}
    assert found.indistinguishable_from == ("mass_error",)


def test_what_motions_leave_tied_stays_tied() -> None:
    told = [
        hypothesis(LumpedMass(), 0.0, 0.0),
        hypothesis(PointForce(), 0.5, -3.0),
        hypothesis(Tether(), -2.0, -40.0),
    ]
    found = with_motions(FOUND, told[0], told)
    assert found.indistinguishable_from == ("point_force", "mass_error")
    assert set(found.told_apart) == {"point_force", "tether"}
