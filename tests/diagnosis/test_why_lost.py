"""Every refit that is not chosen says why, with the number that has decided."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from dlo_casadi.diagnosis import found as findings
from dlo_casadi.diagnosis.crossval import CrossValidation
from dlo_casadi.diagnosis.found import Found, Ranked
from dlo_casadi.diagnosis.refits import Confirmed
from dlo_casadi.diagnosis.selection import choose, support

COUNTS = np.full(6, 40.0)
BASE = SimpleNamespace(log_evidence=100.0, model=SimpleNamespace(priors={}))
# What each pose gains of a gain in all.
SHARES = np.array([0.9, 1.1, 1.0, 0.95, 1.05, 1.0]) / 6


def validation(log_density):
    """Of poses left out, with so much log density in all."""
    return CrossValidation(COUNTS * 1e-6, COUNTS, 1e-3, densities=log_density * SHARES)


DECLARED = validation(90.0)


def refit(name, evidence, predictive):
    """A candidate refitted, with its gains in evidence and in predictive density."""
    screened = SimpleNamespace(candidate=SimpleNamespace(name=name, nuisance=False))
    fit = SimpleNamespace(log_evidence=BASE.log_evidence + evidence)
    told = validation(90.0 + predictive)
    return Confirmed(screened, fit, told, evidence)


def lost(poses, *args):
    """The same, where one step leads beyond the stability of some poses."""
    found = refit(*args)
    squares = found.validation.squares.copy()
    squares[poses] = np.inf
    return replace(found, validation=replace(found.validation, squares=squares))


TRIED = [
    refit("rival", 46.0, 52.0),
    refit("winner", 50.0, 55.0),
    refit("behind", 35.0, 60.0),
    refit("bent", 85.0, 20.0),
    refit("costly", -3.0, 5.0),
    refit("worse", 50.0, -40.0),
    replace(refit("unasked", -4.0, 0.0), validation=None),
    lost([2], "edge", 49.0, 55.0),
    lost([0, 1, 2, 3], "lost", 49.0, 55.0),
]


def test_each_reason_has_its_number():
    chosen, why = choose(TRIED, BASE, DECLARED, None)
    assert [item.candidate.name for item in chosen] == ["winner", "edge", "rival"]
    assert why == {
        "behind": "log likelihood 8.17 behind winner",
        "bent": "log likelihood 20 behind winner",
        "costly": "makes the data less likely than no effect: log likelihood 3 behind",
        "lost": "with it most poses that are left out cannot be predicted",
        "unasked": "makes the data less likely than no effect: log likelihood 4 behind",
        "worse": "makes the data less likely than no effect: log likelihood 40 behind",
    }


def test_both_candidates_of_a_pair_have_its_reason():
    """Unless it is in the best pair, or a rival of one of that pair's candidates."""

    def pair(first, second, *gains):
        return replace(refit(second, *gains), beside=(refit(first, *gains).screened,))

    tried = [pair("one", "two", 50.0, 50.0), pair("one", "other", 30.0, 30.0)]
    tried += [pair("other", "last", 20.0, 20.0), refit("last", -1.0, -1.0)]
    rivals = [pair("one", "rival", 49.0, 49.0), pair("apart", "both", 48.0, 48.0)]
    chosen, why = choose([*rivals, *tried], BASE, DECLARED, None)
    assert chosen == [tried[0], *rivals]
    assert why == {
        "apart": "log likelihood 2 behind one and two",
        "both": "log likelihood 2 behind one and two",
        "other": "log likelihood 20 behind one and two",
        "last": "log likelihood 30 behind one and two",
    }


@pytest.mark.parametrize(
    ("gains", "expected"),
    [((30.0, 60.0), 40.0), ((60.0, 30.0), 40.0), ((20.0, 20.0), 20.0), ((50.0, -4.0), -4.0)],
)
def test_an_effect_has_to_gain_by_both(gains, expected):
    assert support(refit("one", *gains), BASE, DECLARED) == pytest.approx(expected)


def test_hangings_that_are_no_better_by_more_than_chance():
    """Of six poses, one much better and five as before."""
    told = DECLARED.densities + np.array([50.0, 0.0, 0.0, 0.0, 0.0, 0.0])
    one = Confirmed(
        TRIED[0].screened,
        SimpleNamespace(log_evidence=150.0),
        CrossValidation(COUNTS, COUNTS, 1.0, densities=told),
        60.0,
    )
    assert choose([one], BASE, DECLARED, None) == ([one], {})
    chosen, why = choose([one], BASE, DECLARED, 0.005)
    assert chosen == []
    assert why["rival"].startswith("may predict left-out poses better by chance: p = 0.1")


def result(evidence, *added, unexplained=False):
    """Of a search among ten candidates."""
    model, noise = SimpleNamespace(n=10), SimpleNamespace(source="declared")
    fit = SimpleNamespace(log_evidence=evidence, model=model, noise=noise)
    effects = tuple(
        SimpleNamespace(name=name, candidate=SimpleNamespace(name=name), rival_candidates=[])
        for name in added
    )
    ranked = tuple(Ranked(f"c{k}", 1.0, 1.0, None) for k in range(10))
    return Found(fit, effects, ranked, None, None, unexplained, ())


@pytest.mark.parametrize(
    ("more", "margin", "better"), [(1.4, 0.0, False), (1.6, 0.0, True), (1.6, 0.2, False)]
)
def test_two_effects_have_to_be_likelier_by_the_number_of_pairs(more, margin, better):
    """Of ten candidates there are 45 pairs: log 45/10 = 1.50."""
    one, two = result(100.0, "c0"), result(100.0 + more, "c1", "c2")
    assert (one.or_better(two, margin) is one) is not better
    assert (two.or_better(one, -margin) is two) is better
    assert one.or_better(None) is one


def test_a_search_that_explains_the_data_is_better_than_one_that_does_not():
    lost, found = result(200.0, "c0", unexplained=True), result(100.0, "c1")
    assert found.or_better(lost) is found
    assert lost.or_better(found).fit is found.fit


@pytest.mark.parametrize(
    ("error", "p_noise", "source", "added", "unexplained"),
    [
        (1.9e-3, 0.1, "declared", True, False),
        (2.1e-3, 0.1, "declared", True, True),  # more than twice as far off as expected
        (2.1e-3, 0.1, "declared", False, False),  # of two poses neither foretells the other
        (1.9e-3, 1e-3, "declared", True, True),
        (1.9e-3, 0.1, "misfit", True, True),
    ],
)
def test_what_explains_the_data(error, p_noise, source, added, unexplained, monkeypatch):
    told = CrossValidation(np.full(2, error**2), np.ones(2), error, expected=1e-3)
    monkeypatch.setattr(findings, "cross_validate", lambda _: told)
    monkeypatch.setattr(findings, "structure_of", lambda *_: SimpleNamespace(p_noise=p_noise))
    monkeypatch.setattr(findings, "noise_degrees", lambda _: np.inf)
    noise, problem = SimpleNamespace(source=source), SimpleNamespace(used=[0, 1])
    fit = SimpleNamespace(expected_error=5e-4, noise=noise, problem=problem)
    effects = ["one"] * added
    assert Found.of(fit, effects, (), significance=0.005).unexplained is unexplained
