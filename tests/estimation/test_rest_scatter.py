"""Cables that do not repeat: the restricted likelihood by two routes, and what it finds."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.optimize import minimize
from scipy.stats import chi2

from dlo_casadi.errors import EstimationError
from dlo_casadi.estimation.scatter_likelihood import (
    ScatterLikelihood,
    ScatterSample,
    Variances,
    estimate_pose_scatter,
)
from dlo_casadi.model.pose_scatter import MODES, REST_CURVATURE, PoseScatter, modes_of
from dlo_casadi.sensing.noise_estimate import Deviance

M, ROWS = 9, 6


def session(std: float, systematic: float = 0.0, seed: int = 0, rows: int = ROWS):
    """Poses in a row with random sensitivities: samples, distances of their shapes."""
    rng = np.random.default_rng(seed)
    sizes = PoseScatter(1.0, 0.5).sizes(MODES)
    place = np.linspace(0.0, 1.0, M)
    distances = np.abs(place[:, None] - place[None])
    common = rng.normal(size=(3, MODES))
    waves = np.stack([np.sin(2 * place), np.cos(2 * place), place], axis=1)
    samples = []
    for j in range(M):
        rest, own = rng.normal(scale=30.0, size=(rows, MODES)), rng.normal(size=(rows, 1))
        shared = rng.normal(size=(rows, 2))
        c = sizes * (std * rng.normal(size=MODES) + systematic * (waves[j] @ common))
        e = rng.normal(size=rows) + rest @ c + own @ rng.normal(size=1) + shared @ [3.0, -2.0]
        samples.append(ScatterSample(e, rest, own, shared))
    return samples, distances


@pytest.mark.parametrize("systematic", [0.0, 0.2])
def test_deviance_against_the_full_covariance(systematic):
    """Woodbury, pose by pose, and the textbook form with all rows in one matrix."""
    samples, distances = session(0.1)
    # Repeats of a pose share what they determine, which couples them whatever the scatter.
    samples[1] = replace(samples[1], shared=samples[0].shared)
    noise, std, smoothness, range_ = 1.3, 0.15, 0.25, 0.3
    likelihood = ScatterLikelihood(samples, distances)
    found = likelihood.deviance(noise, std, systematic, smoothness, range_)
    sizes = PoseScatter(1.0, smoothness).sizes(MODES)
    alike = np.exp(-((distances / range_) ** 2) / 2)
    rest = np.zeros((M * ROWS, M * MODES))
    own = np.zeros((M * ROWS, M))
    for j, x in enumerate(samples):
        rows = slice(j * ROWS, (j + 1) * ROWS)
        rest[rows, j * MODES : (j + 1) * MODES] = x.random * sizes
        own[rows, j] = x.own[:, 0]
    between = np.kron(std**2 * np.eye(M) + systematic**2 * alike, np.eye(MODES))
    covariance = noise**2 * np.eye(M * ROWS) + rest @ between @ rest.T + own @ own.T
    x = np.concatenate([s.shared for s in samples])
    x = np.linalg.svd(x / np.abs(x).max(axis=0), full_matrices=False)[0]
    e = np.concatenate([s.e for s in samples])
    weight = np.linalg.inv(covariance)
    information = x.T @ weight @ x
    projected = weight - weight @ x @ np.linalg.solve(information, x.T @ weight)
    exact = np.linalg.slogdet(covariance)[1] + np.linalg.slogdet(information)[1]
    exact += e @ projected @ e
    assert found.value == pytest.approx(exact, rel=1e-6)
    # Average information: y^T P V_s P V_s P y, with V_s the derivative by log std.
    moved = 2 * std**2 * rest @ rest.T @ projected @ e
    assert found.information == pytest.approx(moved @ projected @ moved, rel=1e-6)


@pytest.mark.parametrize("systematic", [0.0, 0.2])
def test_gradient_of_the_deviance_against_differences(systematic):
    likelihood = ScatterLikelihood(*session(0.1))

    def at(logs: np.ndarray) -> Deviance:
        return likelihood.deviance(*np.array([1.3, 0.15, systematic]) * np.exp(logs), 0.25, 0.3)

    step = 1e-5
    slopes = [(at(way).value - at(-way).value) / (2 * step) for way in step * np.eye(3)]
    np.testing.assert_allclose(at(np.zeros(3)).gradient, slopes, rtol=1e-6, atol=1e-6)


def test_a_scatter_is_no_larger_than_that_of_cables():
    """What fits that are lost leave is error, not scatter: it was 1.1 1/m on 0.6 m."""
    samples, distances = session(1.1)
    free, most = (ScatterLikelihood(samples, distances, most=most) for most in (np.inf, 0.5))
    assert estimate_pose_scatter(free).scatter.std > 0.5
    bounded = estimate_pose_scatter(most).scatter
    assert bounded.std == pytest.approx(0.5, rel=1e-6)
    small = ScatterLikelihood(*session(0.1), most=0.5)
    own = estimate_pose_scatter(ScatterLikelihood(*session(0.1)))
    assert estimate_pose_scatter(small).scatter.std == pytest.approx(own.scatter.std, rel=1e-3)


def test_a_single_pose_has_no_systematic_part():
    samples, distances = session(0.1, rows=30)
    alone = ScatterLikelihood(samples[:1], distances[:1, :1]).deviance(1.3, 0.15, 0.2, 0.25, 0.3)
    assert alone.gradient[2] == 0.0
    assert alone.gradient[1] != 0.0


def test_sizes_are_those_of_a_search_without_derivatives():
    """Nelder and Mead's, from the same start, far below what a likelihood tells."""
    for systematic in (0.0, 0.5):
        samples, distances = session(0.2, systematic, seed=1)
        likelihood = ScatterLikelihood(samples, distances)
        found = likelihood.best(0.5, 0.3)
        at = np.log([found.noise, found.std, found.systematic])

        def deviance(q: np.ndarray, likelihood: ScatterLikelihood = likelihood) -> float:
            return likelihood.deviance(*np.exp(q), 0.5, 0.3).value

        options = {"xatol": 1e-4, "fatol": 1e-4}
        least = minimize(deviance, at + 0.3, method="Nelder-Mead", options=options)
        assert found.deviance == pytest.approx(least.fun, abs=0.02)


def test_degrees_of_freedom_of_a_variance_that_noise_does_not_hide():
    """All rows less two unknowns."""
    samples, distances = session(50.0, seed=2)
    found = ScatterLikelihood(samples, distances).best(0.12, None, guess=50.0)
    assert found.degrees == pytest.approx(M * ROWS - 2, rel=0.01)


def test_a_random_rest_curvature_is_found_beside_unknown_noise():
    """Nine poses of six numbers: within a third, on average over twenty sessions."""
    found = [
        estimate_pose_scatter(ScatterLikelihood(*session(0.2, seed=k, rows=12))) for k in range(20)
    ]
    assert np.mean([x.scatter.std for x in found]) == pytest.approx(0.2, rel=0.15)
    assert np.mean([x.noise for x in found]) == pytest.approx(1.0, rel=0.15)
    assert min(x.p_systematic for x in found) > 0.005 / 20


def test_a_cable_that_repeats_has_none():
    """A threshold of five percent for the best of three smoothnesses: three of twenty at most."""
    found = [
        estimate_pose_scatter(ScatterLikelihood(*session(0.0, seed=k))).scatter.std
        for k in range(20)
    ]
    assert np.count_nonzero(found) <= 3
    assert np.median(found) == 0


def test_what_poses_that_are_alike_have_in_common_is_not_random():
    """A function of the pose, as a missing effect leaves it."""
    for seed in range(5):
        samples, distances = session(0.0, 0.5, seed)
        found = estimate_pose_scatter(ScatterLikelihood(samples, distances))
        assert found.p_systematic < 1e-6
        assert found.scatter.std < 0.1


def test_significance_of_a_systematic_part_is_that_of_the_better_of_two_ranges():
    """A size that is bounded by zero has half of chi-square's probability, in each of them."""

    def best(smoothness, range_, std=True, **_):
        return Variances(1.0, 0.2 * std, 0.1, 100.0 - 4.0 * (range_ is not None), 10.0)

    deviance = SimpleNamespace(value=100.0)
    likelihood = SimpleNamespace(
        source=REST_CURVATURE, m=M, apart=1.0, best=best, deviance=lambda *_: deviance
    )
    found = estimate_pose_scatter(likelihood)
    assert found.p_systematic == pytest.approx(2 * chi2.sf(4.0, 1) / 2)


def test_modes_have_the_std_along_the_cable():
    """RMS over all repeats and places: the sum of the variances."""
    cells = np.stack([np.arange(400), np.arange(1, 401)], axis=1) * 0.002
    waves = modes_of(cells, 0.8)
    for smoothness in (0.5, 0.12):
        variance = (waves**2 @ PoseScatter(0.3, smoothness).sizes(MODES) ** 2).mean()
        assert variance == pytest.approx(0.09, rel=1e-4)  # means over cells instead of values


def test_a_covariance_that_cannot_be_factorised_is_told():
    """Sensitivities of 1e20, as of a fit that has run away, leave no covariance to factorise."""
    samples, distances = session(0.1)
    lost = [ScatterSample(x.e, 1e20 * x.random, x.own, x.shared) for x in samples]
    with pytest.raises(EstimationError, match="rounding leaves no"):
        ScatterLikelihood(lost, distances).best(0.5, None)
