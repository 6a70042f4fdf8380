"""Every refit that is not chosen says why, with the number that has decided."""

from functools import partial
from types import SimpleNamespace

import numpy as np
import pytest

from dlo_casadi.diagnosis.crossval import CrossValidation
from dlo_casadi.diagnosis.refits import Confirmed
from dlo_casadi.diagnosis.selection import choose, improving, shortcoming, why_lost

COUNTS = np.full(6, 40.0)
# Squares of what is left out [m^2], pose by pose; the first is the declared model's.
DECLARED = CrossValidation(COUNTS * 4e-6, COUNTS, True)
DIFFERENT = np.array([0.9, 1.1, 1.0, 0.95, 1.05, 1.0])


def refit(name, error, bic, complete=True):
    """A candidate refitted, with the error [m] of what is left out."""
    screened = SimpleNamespace(candidate=SimpleNamespace(name=name, nuisance=False))
    validation = CrossValidation(COUNTS * error**2 * DIFFERENT, COUNTS, complete)
    return Confirmed(screened, None, validation, bic + 10.0, bic)


TRIED = [
    refit("winner", 1e-3, 100.0),
    refit("rival", 1e-3, 95.0),
    refit("behind", 1e-3, 70.0),
    refit("far", 1.5e-3, 120.0),
    refit("costly", 1e-3, -3.0),
    refit("worse", 3e-3, 50.0),
    refit("lost", 1e-3, 50.0, complete=False),
    None,
]


def test_each_reason_has_its_number():
    confirmed = improving(TRIED, DECLARED, None)
    chosen = choose(confirmed, 10.0)
    why = partial(shortcoming, validation=DECLARED, doubt=None)
    found = why_lost(TRIED, confirmed, [], chosen, why)
    assert found == {
        "behind": "BIC 30 behind winner",
        "far": "predicts what is left out worse: 1.5 mm instead of 1 mm with winner",
        "costly": "explains less than its parameters cost: BIC 3 behind no effect",
        "worse": "predicts what is left out worse: 3 mm instead of 2 mm",
        "lost": "with it a pose that is left out cannot be predicted",
    }


@pytest.mark.parametrize("index", [0, 2])
def test_a_misleading_one_is_told_so(index):
    one = TRIED[index]
    rest = [item for item in improving(TRIED, DECLARED, None) if item is not one]
    why = partial(shortcoming, validation=DECLARED, doubt=None)
    found = why_lost(TRIED, rest, [one], choose(rest, 10.0), why)
    assert found[one.candidate.name].startswith("misleads")


def test_hangings_that_are_no_better_by_more_than_chance():
    """Of six poses, one much better and five as before."""
    squares = COUNTS * 4e-6 * np.array([0.1, 1.0, 1.0, 1.0, 1.0, 1.0])
    one = Confirmed(TRIED[0].screened, None, CrossValidation(squares, COUNTS, True), 60.0, 50.0)
    said = shortcoming(one, DECLARED, 0.005)
    assert said.startswith("predicts what is left out no better than by chance: p = 0.1")
    assert improving([one], DECLARED, 0.005) == []
