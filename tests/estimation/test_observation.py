"""Measured points against a curve, on a circle; the noise model against simulated noise."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.linalg import block_diag
from scipy.special import expit, logit

from dlo_casadi.equilibrium.curve import NodeCurve, Observed, ObservedChange
from dlo_casadi.equilibrium.pose import HeldPose
from dlo_casadi.sensing.measured_pose import MeasuredPose
from dlo_casadi.sensing.noise import NoiseModel, ReadingNoise, correlation, smooth_modes
from dlo_casadi.sensing.noise_estimate import (
    NoiseSample,
    Profile,
    _correlated,
    estimate_noise,
    restricted_deviance,
)
from dlo_casadi.sensing.sensors import Centerline

CURVATURE, LENGTH = 4.0, 0.9  # 1/m, m: turns by 3.6 rad
RADIUS = 1 / CURVATURE


def on_circle(s: np.ndarray, radius: float | np.ndarray = RADIUS) -> np.ndarray:
    """Points about a circle through the origin that starts along +x and turns left."""
    angle = CURVATURE * s
    return np.stack([radius * np.sin(angle), RADIUS - radius * np.cos(angle)], axis=1)


def circle(n: int, *, links: bool = False) -> NodeCurve:
    s = np.linspace(0.0, LENGTH, n + 1)
    slopes = np.stack([np.cos(CURVATURE * s), np.sin(CURVATURE * s)], axis=1)
    return NodeCurve(LENGTH, on_circle(s), None if links else slopes)


def hermite_error(n: int) -> float:
    """Bound h^4 k^3 / 384 of cubic Hermite interpolation of a circle [m]."""
    return (LENGTH / n) ** 4 * CURVATURE**3 / 384


# ---- the curve between its nodes ---------------------------------------------------------------


@pytest.mark.parametrize("n", [6, 12, 24])
def test_interpolation_stays_within_its_bound(n):
    s = np.linspace(0.0, LENGTH, 500)
    error = np.hypot(*(circle(n).at(s) - on_circle(s)).T).max()
    # Both coordinates together reach nearly the bound of the vector's fourth derivative.
    assert 0.8 * hermite_error(n) < error < 1.001 * hermite_error(n)


def test_links_are_chords():
    """The sagitta of a chord: h^2 k / 8."""
    n = 12
    s = (np.arange(n) + 0.5) * LENGTH / n
    gap = np.hypot(*(circle(n, links=True).at(s) - on_circle(s)).T)
    exact = RADIUS * (1 - np.cos(CURVATURE * LENGTH / n / 2))
    np.testing.assert_allclose(gap, exact, rtol=1e-10)


@pytest.mark.parametrize("links", [False, True])
def test_derivatives_against_finite_differences(links):
    curve, d = circle(5, links=links), 1e-6
    s = np.linspace(0.01, LENGTH - 0.01, 23)
    for order in (1, 2):
        central = (curve.at(s + d, order - 1) - curve.at(s - d, order - 1)) / (2 * d)
        # Rounding 1e-16 * 400 / d for second derivatives of cubics over elements of 0.18 m.
        np.testing.assert_allclose(curve.at(s, order), central, atol=1e-7)
    frame = curve.frame(s, 2)
    for order in (0, 1, 2):
        np.testing.assert_array_equal(frame[order], curve.at(s, order))


@pytest.mark.parametrize("links", [False, True])
def test_points_are_linear_in_the_nodes(links):
    """N . r(s) is a fixed row times the curve's numbers, node by node."""
    curve = circle(5, links=links)
    table = curve.nodes if links else np.hstack([curve.nodes, curve.slopes])
    again = NodeCurve.of(LENGTH, table)
    np.testing.assert_array_equal(again.nodes, curve.nodes)
    s = np.linspace(0.0, LENGTH, 31)
    normals = curve.normals(s)[:, 0]
    exact = (normals * curve.at(s)).sum(axis=1)
    line = Centerline(on_circle(s), np.ones(len(s)))
    each = ObservedChange(np.eye(table.size).reshape((*table.shape, -1)), np.zeros((0, table.size)))
    rows = -line.linearized(Observed(curve, np.zeros(0)), s, each)[1]
    np.testing.assert_allclose(rows @ table.ravel(), exact, atol=1e-14)


# ---- projections and normals --------------------------------------------------------------------


def test_feet_and_normals_on_a_circle():
    """The foot of a point beside the circle is at its angle; normals point to the centre."""
    curve = circle(30)
    exact = np.linspace(0.05, LENGTH - 0.05, 40)
    offset = 0.02 * np.sin(37 * exact)  # to the left, where the centre is
    points = on_circle(exact, RADIUS - offset)
    rng = np.random.default_rng(0)
    s = curve.projections(points, exact + rng.uniform(-0.01, 0.01, 40))
    # The interpolant is off by 3e-7 m; a projection moves by that over 1 - offset / radius > 0.9,
    # times the curve's slope error h^3 k^3.
    np.testing.assert_allclose(s, exact, atol=2e-6)
    normals = curve.normals(s)[:, 0]
    center = np.array([0.0, RADIUS])
    np.testing.assert_allclose(normals, (center - on_circle(exact)) / RADIUS, atol=2e-5)
    distance = ((points - curve.at(s)) * normals).sum(axis=1)
    np.testing.assert_allclose(distance, offset, atol=hermite_error(30))


def test_nearest_place_on_a_curve_that_meets_itself():
    """A circle and a quarter: beside the overlap the nearer strand is found, without a guess."""
    n, turns = 60, 1.25
    length = turns * 2 * np.pi * RADIUS
    s = np.linspace(0.0, length, n + 1)
    growing = RADIUS * (1 + 0.2 * s / length)  # a spiral, so that the strands are apart
    spiral = np.stack([growing * np.sin(s / RADIUS), -growing * np.cos(s / RADIUS)], axis=1)
    curve = NodeCurve(length, spiral, None)
    places = np.array([0.1, 0.3, 1.2, length - 0.1])
    beside = curve.at(places) + 1e-3 * curve.normals(places)[:, 0]
    found = curve.nearest(beside)
    # A polyline: the foot of a point beside a chord is exact.
    np.testing.assert_allclose(found, places, atol=1e-8)
    np.testing.assert_allclose(curve.distances(beside), 1e-3, rtol=1e-6)


def test_feet_stay_on_the_curve():
    curve = circle(10)
    before, after = np.array([[-0.1, 0.0]]), on_circle(np.array([LENGTH])) - 0.05
    assert curve.projections(before, np.array([0.05])) == pytest.approx(0.0)
    assert 0.0 <= curve.nearest(after)[0] <= LENGTH


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_feet_stay_where_they_are_on_a_curve_that_is_not_finite(value):
    curve = replace(circle(10), nodes=np.full((11, 2), value))
    with np.errstate(invalid="ignore"):
        assert curve.projections(np.zeros((1, 2)), np.array([0.05])) == pytest.approx(0.05)


@pytest.mark.parametrize("gap", [False, True])
def test_first_places_along_the_chords(gap):
    """Dense noisy points of a circle: places within a hundredth of the length."""
    rng = np.random.default_rng(0)
    exact = np.linspace(0.01, LENGTH - 0.01, 200)
    if gap:
        exact = exact[(exact < 0.4) | (exact > 0.45)]
    points = on_circle(exact) + rng.normal(scale=3e-4, size=(len(exact), 2))
    (end,) = on_circle(np.array([LENGTH]))
    item = MeasuredPose.of_points(HeldPose((0.0, 0.0), (float(end[0]), float(end[1]))), points)
    places = item.places(LENGTH)
    assert np.all(np.diff(places) >= 0)
    # Noise of 0.3 mm lengthens chords of 18 mm by 2e-4 of themselves; the chord over a gap of
    # 50 mm is short by its k^2 / 24 = 0.2 %: 0.1 mm. Smoothing over 2 % rounds the ends.
    np.testing.assert_allclose(places, exact, atol=0.01 * LENGTH)


def test_a_pose_knows_whether_it_can_be_read():
    pose = HeldPose((0.0, 0.0))
    assert not MeasuredPose.of_points(pose, np.empty((0, 2))).readable
    item = MeasuredPose.of_points(pose, np.zeros((3, 2)))
    np.testing.assert_array_equal(item.relative_std, 1.0)
    weighted = MeasuredPose.of_points(pose, np.zeros((3, 2)), weight=np.array([1.0, 2.0, 3.0]))
    np.testing.assert_array_equal(weighted.relative_std, [1.0, 2.0, 3.0])


# ---- noise -------------------------------------------------------------------------------------

NOISES = [
    NoiseModel(3e-4),
    NoiseModel(3e-4, share=0.6, length=0.03, kernel="exponential"),
    NoiseModel(2e-4, share=0.8, length=0.05, kernel="gaussian"),
    NoiseModel(2e-4, share=0.5, length=0.05, kernel="matern"),
]


@pytest.mark.parametrize("noise", NOISES, ids=lambda noise: f"{noise.kernel}-{noise.share}")
def test_whitening_makes_the_covariance_one(noise):
    rng = np.random.default_rng(0)
    s, weight = np.sort(rng.uniform(0, LENGTH, 60)), rng.uniform(0.5, 3, 60)
    white = noise.whitening(s, weight)
    product = white @ noise.covariance(s, weight) @ white.T
    # White noise leaves out the 1e-9 that keeps the others' factor regular, whose condition
    # number is below 1e4.
    np.testing.assert_allclose(product, np.eye(60), atol=1e-8)


def test_doubted_noise_is_white_and_leaves_readings_their_weight():
    noise = NoiseModel(3e-4, share=0.6, length=0.03, readings=ReadingNoise(0.01, 0.02, True))
    found = noise.doubted(9e-4)
    assert (found.std, found.share) == (9e-4, 0.0)
    assert found.readings.force == pytest.approx(0.03)
    assert found.readings.moment == pytest.approx(0.06)
    kinds = np.array(["point", "force", "moment"])
    np.testing.assert_allclose(found.units(kinds), [1.0, 0.03, 0.015])
    np.testing.assert_allclose(noise.units(kinds), [1.0, 0.03, 0.015])
    assert noise.doubted(3e-4) is noise


@pytest.mark.parametrize("kernel", ["exponential", "matern", "gaussian"])
def test_correlation_falls_from_one(kernel):
    values = correlation(kernel, np.linspace(0.0, 6.0, 50))
    assert values[0] == 1.0
    assert np.all(np.diff(values) < 0)
    assert values[-1] < 3e-3


def simulated(
    noise: NoiseModel, poses: int = 14, points: int = 100, seed: int = 0
) -> list[NoiseSample]:
    """Noise of many poses on top of slow displacements that the curves may take."""
    rng = np.random.default_rng(seed)
    s, weight = np.linspace(0.01, LENGTH - 0.01, points), np.ones(points)
    factor = np.linalg.cholesky(noise.covariance(s, weight))
    own, shared = smooth_modes(s, LENGTH, 4, free_end=False), np.zeros((points, 0))
    samples = []
    for _ in range(poses):
        slow = own @ rng.normal(scale=5e-3, size=4)
        samples.append(NoiseSample(factor @ rng.normal(size=points) + slow, s, weight, own, shared))
    return samples


def test_restricted_likelihood_of_white_noise_is_unbiased():
    """Projecting out 4 of 20 directions must not make the noise look 10 % smaller."""
    samples = simulated(NoiseModel(3e-4), poses=200, points=20)
    samples = [
        NoiseSample(x.residuals, x.places, x.weight, x.own, np.zeros((20, 0))) for x in samples
    ]
    std = restricted_deviance(NoiseModel(1.0), samples).std
    # 200 * 16 degrees of freedom: one standard deviation is 1.25 %.
    assert std == pytest.approx(3e-4, rel=0.04)


def test_points_at_a_fixture_tell_nothing_of_slow_modes():
    """The projections of a fit that has run away: sines vanish there."""
    samples = simulated(NoiseModel(3e-4), poses=3, points=20)
    samples[1] = replace(samples[1], places=np.zeros(20))  # the middle pose
    found = estimate_noise(samples, LENGTH)
    assert 0 < found.slow_dof < 60
    assert np.isfinite(found.std)


def test_white_noise_is_recovered():
    found = estimate_noise(simulated(NoiseModel(3e-4)), LENGTH)
    # 14 * 76 degrees of freedom: 2.2 % is one standard deviation. A share that is not there may
    # be found where its length lies below the spacing of the points.
    assert found.std == pytest.approx(3e-4, rel=0.07)
    spacing = LENGTH / 80
    neighbours = found.covariance(np.array([0.0, spacing]), np.ones(2))[0, 1] / found.std**2
    assert neighbours < 0.1


@pytest.mark.parametrize("kernel", ["exponential", "matern", "gaussian"])
def test_deviance_against_differences_and_as_it_is_written(kernel):
    """Two components a point, means of one to three, averaged along the cable."""
    rng = np.random.default_rng(0)
    samples = []
    for x in simulated(NoiseModel(3e-4, 0.5, 0.03), poses=3, points=30):
        own = np.repeat(x.own, 2, axis=0) * rng.normal(size=(60, 1))
        both = np.repeat(x.residuals, 2) + 1e-4 * rng.normal(size=60)
        count = rng.integers(1, 4, size=30).astype(float)
        shared = rng.normal(size=(60, 3))
        samples.append(NoiseSample(both, x.places, x.weight, own, shared, 0.01, count))

    def at(q: np.ndarray) -> Profile:
        unit = NoiseModel(1.0, float(expit(q[0])), float(np.exp(q[1])), kernel)
        return restricted_deviance(unit, samples)

    q, step = np.array([0.3, np.log(0.04)]), 1e-5
    ways = [(at(q + way), at(q - way)) for way in step * np.eye(2)]
    slopes = [(a.value - b.value) / (2 * step) for a, b in ways]
    np.testing.assert_allclose(at(q).gradient, slopes, rtol=1e-6)

    # The deviance as it is written, with all rows in one matrix, up to what no parameter changes.
    def written(q: np.ndarray) -> float:
        unit = NoiseModel(1.0, float(expit(q[0])), float(np.exp(q[1])), kernel)
        places = [(x.distance, x.correlation_length, x.count) for x in samples]
        covariance = block_diag(*(np.kron(unit.correlation(*x), np.eye(2)) for x in places))
        own = block_diag(*(x.own for x in samples))
        fixed = np.column_stack([np.concatenate([x.shared for x in samples]), own])
        y, weight = np.concatenate([x.residuals for x in samples]), np.linalg.inv(covariance)
        seen = fixed.T @ weight @ fixed
        p = weight - weight @ fixed @ np.linalg.solve(seen, fixed.T @ weight)
        logdet = np.linalg.slogdet(covariance)[1] + np.linalg.slogdet(seen)[1]
        return float(logdet + (len(y) - fixed.shape[1]) * np.log(y @ p @ y))

    other = np.array([-0.4, np.log(0.02)])
    assert at(q).value - at(other).value == pytest.approx(written(q) - written(other), rel=1e-5)


def test_directions_that_leave_a_photograph_alone_tell_nothing_of_its_noise():
    samples = simulated(NoiseModel(3e-4))
    twice = [replace(x, own=np.column_stack([x.own, 0 * x.own, x.own[:, :1]])) for x in samples]
    still = [replace(x, own=0 * x.own) for x in simulated(NoiseModel(3e-4), seed=1)]
    assert estimate_noise(twice, LENGTH).std == pytest.approx(
        estimate_noise(samples, LENGTH).std, rel=1e-6
    )
    assert np.isfinite(estimate_noise([*samples, *still], LENGTH).std)


@pytest.mark.parametrize(
    "truth",
    [
        pytest.param(x, id=x.kernel, marks=[pytest.mark.long] * (x.kernel == "gaussian"))
        for x in NOISES[1:]
    ],
)
def test_correlated_noise_is_recovered(truth):
    """Size and correlation over the distances that points and knots are apart, from 60 poses."""
    found = [estimate_noise(simulated(truth, poses=60, seed=k), LENGTH) for k in range(3)]
    # L / length * 60 = 1000 to 1800 independent stretches know the variance to 3 %, less what
    # four slow displacements a pose take of a correlation that is nearly as slow: 5 % of the
    # root, two of them. Correlations scatter by 0.03 to 0.04, three of them for the mean of three.
    assert [noise.std for noise in found] == pytest.approx([truth.std] * 3, rel=0.1)
    lags = np.array([0.0, 0.02, 0.04, 0.08])
    exact, *estimates = (x.covariance(lags, np.ones(4))[0] / x.std**2 for x in (truth, *found))
    np.testing.assert_allclose(np.mean(estimates, axis=0), exact, atol=0.065)
    if truth.kernel == "gaussian":  # smooth enough to be told from the others
        assert {noise.kernel for noise in found} == {"gaussian"}
        assert [noise.share for noise in found] == pytest.approx([truth.share] * 3, abs=0.06)
        assert [noise.length for noise in found] == pytest.approx([truth.length] * 3, rel=0.1)


def log_slow_variance(covariance: np.ndarray, s: np.ndarray) -> float:
    """Logarithm of the geometric mean of the variance of six slow modes."""
    modes = smooth_modes(s, LENGTH, 6, free_end=False)
    seen = np.linalg.solve(np.linalg.cholesky(covariance), modes)
    return -float(np.linalg.slogdet(seen.T @ seen)[1]) / 6


def test_slow_errors_beside_smooth_ones_are_seen_in_dense_points():
    """An average along the cable makes noise smooth; the estimate must not tell of that alone."""
    parts = [
        NoiseModel(3e-5, 0.999, 0.015, "gaussian"),
        NoiseModel(2e-5, 0.999, 0.04, "gaussian"),
    ]
    s = np.linspace(0.01, LENGTH - 0.01, 160)
    true = log_slow_variance(sum(part.covariance(s, np.ones(160)) for part in parts), s)
    errors = []
    for seed in range(3):
        one, other = (simulated(part, 14, 160, seed + 10 * k) for k, part in enumerate(parts))
        both = [
            replace(a, residuals=a.residuals + b.residuals) for a, b in zip(one, other, strict=True)
        ]
        found = estimate_noise(both, LENGTH)
        errors.append(log_slow_variance(found.covariance(s, np.ones(160)), s) - true)
    # What is told, 2 / slow_dof, is a standard deviation of 0.16 to 0.2: two of them.
    assert np.abs(errors).max() < 0.35


def test_errors_that_end_within_a_stretch_do_not_average_out_over_its_points():
    """Averages over eight points: those far apart are independent, near ones share their errors."""
    s = np.linspace(0.01, LENGTH - 0.01, 200)
    average = np.convolve(np.ones(6), np.ones(3))
    rows = np.array([np.pad(average, (k, 199 - k)) for k in range(200)])
    true = log_slow_variance(rows @ rows.T + 1e-6 * np.eye(200), s)
    own, none = smooth_modes(s, LENGTH, 4, free_end=False), np.zeros((200, 0))
    for seed in range(5):
        drawn = np.random.default_rng(seed).normal(size=(5, 207))
        samples = [NoiseSample(rows @ one, s, np.ones(200), own, none) for one in drawn]
        found = estimate_noise(samples, LENGTH)
        error = log_slow_variance(found.covariance(s, np.ones(200)), s) - true
        # By its own account the standard deviation is 0.17 to 0.7.
        assert abs(error) < 2.5 * np.sqrt(2 / found.slow_dof)


def test_how_well_slow_modes_are_known_is_that_of_their_likelihood():
    """Of one kernel, by sums over a grid of shares and lengths, uniform in the share."""
    samples = simulated(NoiseModel(3e-4, 0.5, 0.03, "gaussian"), 12, 60)
    found = _correlated(samples, LENGTH, "gaussian")
    shares = expit(logit(found.noise.share) + np.linspace(-0.8, 0.8, 7))
    lengths = found.noise.length * np.exp(np.linspace(-0.4, 0.4, 7))
    logs, slow = [], []
    for share in shares:
        for length in lengths:
            unit = NoiseModel(1.0, float(share), float(length), "gaussian")
            there = restricted_deviance(unit, samples)
            noise = replace(unit, std=there.std)
            covariance = noise.covariance(samples[0].places, samples[0].weight)
            # On a grid of logits a density of the share is weighed by its derivative.
            logs.append(np.log(share * (1 - share)) - there.value / 2)
            slow.append(log_slow_variance(covariance, samples[0].places))
    weights = np.exp(np.array(logs) - max(logs))
    variance = np.cov(slow, aweights=weights, ddof=0)
    size = 2 / (12 * (60 - 4))  # of the noise itself, with 4 of 60 directions projected out
    assert found.spread() == pytest.approx(variance + size, rel=0.1)


def test_how_well_slow_modes_are_known_is_known():
    """Logarithm of the variance of slow modes: its spread over sessions, and that which is told."""
    truth = NoiseModel(3e-4, 0.5, 0.03, "gaussian")
    s, weight = np.linspace(0.01, LENGTH - 0.01, 80), np.ones(80)

    def log_variance(noise: NoiseModel) -> float:
        return log_slow_variance(noise.covariance(s, weight), s)

    found = [estimate_noise(simulated(truth, 6, 80, seed=k), LENGTH) for k in range(24)]
    errors = np.array([log_variance(noise) - log_variance(truth) for noise in found])
    told = np.array([2 / noise.slow_dof for noise in found])
    # 24 draws know their own mean square to a factor of 1.3, twice that is 1.7.
    assert 1 / 1.7 < np.mean(errors**2 / told) < 1.7
