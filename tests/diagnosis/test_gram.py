"""The Gram matrix gives the gain of every subset, as least squares with its columns does."""

from itertools import combinations
from types import SimpleNamespace

import numpy as np
import pytest

from dlo_casadi.diagnosis.gram import Gram, Place
from dlo_casadi.linear_mixed import LinearMixed

ROWS, KNOWN = 60, 3
# Columns of each candidate at each of its scans.
WIDTHS = {Place("a", 0): 1, Place("b", 0): 2, Place("c", 0): 1, Place("c", 2): 1, Place("d", 0): 3}


def candidate(label, width):
    return SimpleNamespace(
        effect=SimpleNamespace(label=label),
        name=label,
        screened=tuple(f"{label}.{k}" for k in range(width)),
        scans=({}, {}, {}),
        alike=1,
        of_linear=lambda cable, values: values,
    )


@pytest.fixture(scope="module")
def case():
    """Residuals that lack two candidates: each alone gains little, as their columns are alike."""
    rng = np.random.default_rng(5)
    by_shared = rng.normal(size=(ROWS, KNOWN))
    columns = {x: rng.normal(size=(ROWS, width)) for x, width in WIDTHS.items()}
    columns[Place("a", 0)] += 3 * columns[Place("c", 2)]
    lacks = columns[Place("a", 0)] - 3.2 * columns[Place("c", 2)]
    return by_shared, columns, rng.normal(size=ROWS) - 2 * lacks[:, 0]


def gram_of(case, lower=-np.inf):
    by_shared, columns, residuals = case
    none, known = np.zeros((1, 0)), np.zeros((KNOWN, KNOWN))
    given = [np.zeros((ROWS, 0))], none, none[0], np.zeros(KNOWN), known
    mixed = LinearMixed([residuals], [by_shared], *given)
    ends = KNOWN + np.cumsum([0, *WIDTHS.values()])
    at = {x: [*range(*ends[i : i + 2])] for i, x in enumerate(WIDTHS)}
    listed = [candidate(*one) for one in {x.label: w for x, w in WIDTHS.items()}.items()]
    one = {"lower": lower, "upper": np.inf, "nominal": 0.0, "scale": 1.0}
    names = [name for item in listed for name in item.screened]
    parameters = [SimpleNamespace(name=name, **one) for name in names]
    model = SimpleNamespace(parameters=parameters, names=names, cable=None)
    fit = SimpleNamespace(problem=SimpleNamespace(unknowns=SimpleNamespace(names=range(KNOWN))))
    normal = mixed.beside([np.hstack(list(columns.values()))]).normal
    return Gram(fit, tuple(listed), SimpleNamespace(model=model), normal, at, np.inf)


def gain(case, places):
    """Fall of the sum of squares with the columns of these places, and their coefficients."""
    by_shared, columns, residuals = case
    squares = []
    for more in ([], [columns[x] for x in places]):
        rows = np.column_stack([by_shared, *more])
        step = np.linalg.lstsq(rows, -residuals, rcond=None)[0]
        squares.append(float(((residuals + rows @ step) ** 2).sum()))
    return squares[0] - squares[1], step[KNOWN:]


@pytest.mark.parametrize("size", [1, 2])
def test_the_best_subsets_are_those_of_least_squares(case, size):
    every = [x for x in combinations(WIDTHS, size) if len({y.label for y in x}) == size]
    best: dict[str, float] = {}
    for places in every:
        name = " ".join(x.label for x in places)
        best[name] = max(best.get(name, 0.0), gain(case, places)[0])
    found = gram_of(case).subsets(size, 4)
    names = [" ".join(sorted(x.candidate.name for x in subset)) for subset in found]
    assert names == sorted(best, key=lambda name: -best[name])[:4]


def test_each_of_a_subset_is_tested_beside_the_others(case):
    a, c = Place("a", 0), Place("c", 2)
    gram = gram_of(case)
    (pair,) = gram.subsets(2, 1)
    assert {x.candidate.name for x in pair} == {"a", "c"}
    both, steps = gain(case, [a, c])
    for item, other, step in zip(gram.tested([a, c]), (c, a), steps, strict=True):
        assert item.score == pytest.approx(both - gain(case, [other])[0], rel=1e-4)
        assert item.start[f"{item.candidate.name}.0"] == pytest.approx(step, rel=1e-4)
        assert item.score > 2 * next(
            x.score for x in gram.singles if x.candidate.name == item.candidate.name
        )


def test_a_parameter_does_not_pass_the_bound_at_which_its_effect_vanishes(case):
    """One of the pair would be negative: then it gains nothing, and the pair is no subset."""
    subsets = gram_of(case, lower=0.0).subsets(2, 10)
    assert subsets
    for subset in subsets:
        assert all(x >= 0 for item in subset for x in item.start.values())
        assert {(x.candidate.name, x.scan) for x in subset} != {("a", 0), ("c", 2)}
