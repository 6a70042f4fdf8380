"""Band matrices against dense linear algebra: products, solutions, inertia."""

import numpy as np
import pytest

from dlo_casadi.rod.band import BandMatrix, Vector

POSES, COLUMNS = 3, 4
SIZES = pytest.mark.parametrize("n", [1, 2, 3, 4, 5, 8, 21, 64])
BLOCKS = pytest.mark.parametrize("b", [1, 3])
EPS = np.finfo(float).eps


def symmetric(blocks: np.ndarray) -> np.ndarray:
    return blocks + np.swapaxes(blocks, -1, -2)


def indefinite(n: int, b: int, k: int) -> BandMatrix:
    """Matrices without any sign, a corner included."""
    rng = np.random.default_rng(n)
    return BandMatrix(
        symmetric(rng.normal(size=(POSES, n, b, b))),
        rng.normal(size=(POSES, n - 1, b, b)),
        rng.normal(size=(POSES, n, b, k)),
        symmetric(rng.normal(size=(POSES, k, k))),
    )


def floating(n: int, b: int, k: int) -> BandMatrix:
    """Springs between neighbours: all may move together (b ways), but for k >= b conditions."""
    rng = np.random.default_rng(n)
    spring = rng.normal(size=(b, b))
    spring = spring @ spring.T + np.eye(b)
    ends = np.r_[1.0, np.full(n - 2, 2.0), 1.0] if n > 1 else np.zeros(1)
    diagonal = np.broadcast_to(ends[:, None, None] * spring, (POSES, n, b, b)).copy()
    upper = np.broadcast_to(-spring, (POSES, n - 1, b, b)).copy()
    return BandMatrix(diagonal, upper, rng.normal(size=(POSES, n, b, k)), np.zeros((POSES, k, k)))


def vector_of(rows: np.ndarray, n: int, b: int) -> Vector:
    """From rows (m, n b + k, q): those of the nodes, then those of the border."""
    m, _, q = rows.shape
    return Vector(rows[:, : n * b].reshape((m, n, b, q)), rows[:, n * b :])


def right_side(matrix: BandMatrix) -> np.ndarray:
    rows = matrix.dense().shape[1]
    return np.random.default_rng(1).normal(size=(POSES, rows, COLUMNS))


def negatives(matrix: BandMatrix) -> np.ndarray:
    return (np.linalg.eigvalsh(matrix.dense()) < 0).sum(axis=1)


def assert_solves(matrix: BandMatrix) -> None:
    """As LAPACK does: an error of the condition number times rounding, a few dozen times."""
    dense, f = matrix.dense(), right_side(matrix)
    _, n, b, _ = matrix.diagonal.shape
    found = matrix.factor().solve(vector_of(f, n, b)).rows
    exact = np.linalg.solve(dense, f)
    tolerance = 30 * EPS * np.linalg.cond(dense) * np.abs(exact).max(axis=(1, 2))
    assert np.all(np.abs(found - exact).max(axis=(1, 2)) < tolerance)


@SIZES
@BLOCKS
def test_the_dense_matrix_is_the_same_map(n, b):
    """Two routes to a product; symmetric."""
    matrix = indefinite(n, b, 2)
    dense, f = matrix.dense(), right_side(matrix)
    np.testing.assert_array_equal(dense, np.swapaxes(dense, 1, 2))
    vector = vector_of(f, n, b)
    np.testing.assert_array_equal(vector.rows, f)
    # Rounding of at most 3 b + 2 products of normal numbers.
    np.testing.assert_allclose(matrix.apply(vector).rows, dense @ f, atol=1e-13)


@SIZES
@BLOCKS
@pytest.mark.parametrize("k", [0, 2])
def test_solution_and_inertia(n, b, k):
    matrix = indefinite(n, b, k)
    assert_solves(matrix)
    np.testing.assert_array_equal(matrix.negative(), negatives(matrix))


@pytest.mark.parametrize("n", [2, 3, 8, 41])
@BLOCKS
def test_a_singular_inside_that_its_border_holds(n, b):
    """A floating chain with enough conditions: stable, one negative eigenvalue a condition."""
    k = min(3, n * b)
    matrix = floating(n, b, k)
    inside = np.linalg.eigvalsh(matrix.dense()[:, : n * b, : n * b])
    assert np.all(np.abs(inside[:, :b]) < 1e-13 * inside[:, -1:])
    assert_solves(matrix)
    np.testing.assert_array_equal(negatives(matrix), k)
    np.testing.assert_array_equal(matrix.negative(), k)


@pytest.mark.parametrize("n", [2, 5, 8, 41])
@BLOCKS
@pytest.mark.parametrize("k", [0, 1])
def test_a_floating_chain_that_nothing_holds_is_not_stable(n, b, k):
    """Moving as a whole costs nothing, and a condition on a difference does not see it."""
    matrix = floating(n, b, k)
    matrix.border[...] = 0.0
    matrix.border[:, 0], matrix.border[:, -1] = 1.0, -1.0
    np.testing.assert_array_equal(matrix.negative(), k + b)


@BLOCKS
@pytest.mark.parametrize("copied", [True, False])
def test_conditions_that_depend_on_each_other(b, copied):
    """A condition that is there twice, or sees nothing, is told; the others are met as without."""
    n, k = 6, 3
    matrix = floating(n, b, k + 1)
    alone = BandMatrix(
        matrix.diagonal, matrix.upper, matrix.border[..., :k].copy(), matrix.corner[:, :k, :k]
    )
    matrix.border[..., k] = matrix.border[..., 0] if copied else 0.0
    np.testing.assert_array_equal(matrix.negative(), -1)
    f = right_side(alone)
    twice = f[:, n * b] if copied else np.zeros((POSES, COLUMNS))
    found = matrix.factor().solve(vector_of(np.concatenate([f, twice[:, None]], axis=1), n, b))
    exact = np.linalg.solve(alone.dense(), f)
    # As in `assert_solves`, for a matrix of condition 1e3 at most; half of the digits are
    # refined away where the inside is singular, too.
    np.testing.assert_allclose(found.x, vector_of(exact, n, b).x, atol=1e-10)
    share = found.y[:, [k]] if copied else 0.0
    np.testing.assert_allclose(found.y[:, :1] + share, exact[:, [n * b]], atol=1e-9)
    assert copied or not found.y[:, k].any()


@BLOCKS
def test_more_conditions_in_the_border(b):
    n, matrix = 7, indefinite(7, b, 2)
    columns = np.random.default_rng(2).normal(size=(POSES, n, b, 3))
    more = matrix.with_border(columns)
    flat, zero = columns.reshape((POSES, n * b, 3)), np.zeros((POSES, 2, 3))
    side = np.concatenate([flat, zero], axis=1)
    whole = np.block([[matrix.dense(), side], [np.swapaxes(side, 1, 2), np.zeros((POSES, 3, 3))]])
    np.testing.assert_array_equal(more.dense(), whole)
    assert_solves(more)
    np.testing.assert_array_equal(more.negative(), negatives(more))


def test_poses_do_not_touch_each_other():
    """A subset is solved as it is among others, one pose of other units beside it."""
    matrix, f = indefinite(9, 1, 2), right_side(indefinite(9, 1, 2))
    alone = matrix.subset(np.array([1])).factor().solve(vector_of(f[[1]], 9, 1)).rows
    matrix.diagonal[0] *= 1e9
    matrix.upper[0] *= 1e9
    factor = matrix.factor()
    together = factor.solve(vector_of(f, 9, 1)).rows[[1]]
    picked = factor.subset(np.array([1])).solve(vector_of(f[[1]], 9, 1)).rows
    # Refinement may take one step more for the others' sake: rounding, times the condition.
    size = np.linalg.cond(matrix.dense()[1]) * np.abs(alone).max()
    for found in (together, picked):
        np.testing.assert_allclose(found, alone, atol=30 * EPS * size)
    np.testing.assert_array_equal(factor.subset(np.array([2, 1])).negative, factor.negative[[2, 1]])
