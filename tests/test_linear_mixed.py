"""The algebra of Gaussian linear mixed models against one matrix of everything."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.linalg import block_diag
from scipy.stats import multivariate_normal

from dlo_casadi.linear_mixed import LinearMixed, eliminated, log_density

ROWS, OWN, SHARED, MORE = (9, 12, 7), 2, 3, 4


@pytest.fixture(scope="module")
def mixed() -> LinearMixed:
    rng = np.random.default_rng(0)
    residuals, shared, own = (
        [rng.normal(size=(n, *width)) for n in ROWS] for width in ((), (SHARED,), (OWN,))
    )
    root = rng.normal(size=(5, SHARED))
    return LinearMixed(
        residuals,
        shared,
        own,
        rng.normal(size=(len(ROWS), OWN)),
        np.array([0.5, 2.0]),
        rng.normal(size=SHARED),
        root.T @ root,
    )


@pytest.fixture(scope="module")
def columns():
    rng = np.random.default_rng(1)
    return [rng.normal(size=(n, MORE)) for n in ROWS]


def stacked(mixed: LinearMixed) -> tuple[np.ndarray, np.ndarray]:
    """Rows of all unknowns, the groups' own ones first, with those of the priors; the target."""
    std = np.tile(mixed.own_std, len(ROWS))
    root = np.linalg.cholesky(mixed.precision).T
    rows = [
        np.hstack([block_diag(*mixed.by_own), np.concatenate(mixed.by_shared)]),
        np.hstack([np.diag(1 / std), np.zeros((len(std), SHARED))]),
        np.hstack([np.zeros((SHARED, len(std))), root]),
    ]
    target = [*mixed.residuals, mixed.own.ravel() / std, root @ mixed.gap]
    return np.concatenate(rows), np.concatenate(target)


def test_unknowns_are_those_of_least_squares_with_their_covariance(mixed):
    rows, target = stacked(mixed)
    whole = np.linalg.inv(rows.T @ rows)
    found = -whole @ rows.T @ target
    normal, n = mixed.normal, len(ROWS) * OWN
    step = -np.linalg.solve(normal.hessian, normal.gradient)
    np.testing.assert_allclose(step, found[n:])
    np.testing.assert_allclose((-normal.own.arm @ np.append(step, 1.0)).ravel(), found[:n])
    each = mixed.covariances(np.linalg.inv(normal.hessian))
    for k in range(len(ROWS)):
        kept = [*range(k * OWN, (k + 1) * OWN), *range(n, n + SHARED)]
        np.testing.assert_allclose(each[k, :-1, :-1], whole[np.ix_(kept, kept)])
    leverages = ((rows @ whole) * rows).sum(axis=1)[: sum(ROWS)]
    np.testing.assert_allclose(np.concatenate(mixed.leverages(whole[n:, n:])), leverages)
    # The decrease that a full step promises is that of the sum of squares.
    least = target + rows @ found
    assert normal.promised() == pytest.approx((target @ target - least @ least) / 2, rel=1e-5)


def at_the_minimum(mixed: LinearMixed) -> LinearMixed:
    normal = mixed.normal
    step = -np.linalg.solve(normal.hessian, normal.gradient)
    own = -normal.own.arm @ np.append(step, 1.0)
    rows = zip(mixed.residuals, mixed.by_shared, mixed.by_own, own, strict=True)
    residuals = [e + x @ step + z @ u for e, x, z, u in rows]
    return replace(mixed, residuals=residuals, own=mixed.own + own, gap=mixed.gap + step)


def test_evidence_is_the_density_of_the_observations(mixed):
    """At the minimum; of e = X gap + Z own + noise, with gap and own as their priors say."""
    larger = at_the_minimum(replace(mixed, precision=100 * mixed.precision))
    z, x = block_diag(*mixed.by_own), np.concatenate(mixed.by_shared)
    std = np.tile(mixed.own_std, len(ROWS))
    prior = np.linalg.inv(larger.precision)
    covariance = np.eye(sum(ROWS)) + (z * std**2) @ z.T + x @ prior @ x.T
    mean = z @ mixed.own.ravel() + x @ mixed.gap
    exact = multivariate_normal(mean, covariance).logpdf(np.concatenate(mixed.residuals))
    constant = sum(ROWS) * np.log(2 * np.pi) / 2
    assert larger.log_evidence == pytest.approx(exact + constant)
    white, ways = mixed.residuals[0], mixed.by_own[0]
    exact = multivariate_normal(np.zeros(9), np.eye(9) + ways @ ways.T).logpdf(white)
    assert log_density(white, ways) == pytest.approx(exact + 9 * np.log(2 * np.pi) / 2)


def test_score_is_the_fall_of_the_sum_of_squares_with_the_columns(mixed, columns):
    rows, target = stacked(mixed)
    more = np.concatenate([*columns, np.zeros((len(target) - sum(ROWS), MORE))])
    sums = [np.linalg.lstsq(x, target, rcond=None)[1][0] for x in (rows, np.hstack([rows, more]))]
    gain, step, dof = mixed.score(columns).gain(1e-9)
    assert dof == MORE
    assert gain == pytest.approx(sums[0] - sums[1], rel=1e-4)
    expected = np.linalg.lstsq(np.hstack([rows, more]), -target, rcond=None)[0][-MORE:]
    np.testing.assert_allclose(step, expected, rtol=1e-3)
    # Units do not matter, and of one column alone it is the square of a normal score.
    other = mixed.score([x * [1.0, 1e4, 1e-4, 1.0] for x in columns])
    assert other.scaled.gain(1e-9)[0] == pytest.approx(gain, rel=1e-6)
    one = mixed.score(columns).among(np.array([0], dtype=int))
    assert one.gain(1e-9)[0] == pytest.approx(float(one.slope[0] ** 2 / one.information[0, 0]))


def test_without_a_group_the_others_alone_count(mixed):
    parts = {name: getattr(mixed, name)[1:] for name in ("residuals", "by_shared", "by_own", "own")}
    expected, found = replace(mixed, **parts).normal, mixed.without(0)
    np.testing.assert_allclose(found.hessian, expected.hessian)
    np.testing.assert_allclose(found.gradient, expected.gradient)


def test_the_order_in_which_unknowns_are_integrated_out_does_not_matter():
    root = np.random.default_rng(2).normal(size=(20, 6))
    products, precision = root.T @ root, np.diag([1.0, 2.0, 3.0])
    both = eliminated(products, precision)
    first = eliminated(products, precision[:1, :1])
    second = eliminated(first.left, precision[1:, 1:])
    np.testing.assert_allclose(second.left, both.left)
    assert first.logdet + second.logdet == pytest.approx(both.logdet)
