"""Whether the residual is noise, and what limits a prediction: slow modes, repeats, nuisances."""

from dataclasses import dataclass
from itertools import combinations_with_replacement

import numpy as np
from scipy.linalg import block_diag
from scipy.sparse.csgraph import connected_components
from scipy.special import ndtri

from dlo_casadi.arrays import FloatArray
from dlo_casadi.diagnosis.gram import sidak, survival
from dlo_casadi.estimation.prediction import noise_distance
from dlo_casadi.estimation.repeats import enough_poses, repeatability
from dlo_casadi.estimation.result import Fit
from dlo_casadi.estimation.variances import pose_scatter_of
from dlo_casadi.sensing.noise import SLOW_MODES, smooth_modes
from dlo_casadi.thresholds import (
    ALIKE,
    COLLINEAR,
    KEPT_VARIANCE,
    LEAST_NOISE_DEGREES,
    UNSEEN,
)

# Smallest tail probability of a test: smaller ones carry no more information.
_TAIL = 1e-12
LARGEST_SCORE = -float(ndtri(_TAIL))


@dataclass(frozen=True)
class Structure:
    """Tests for structure in the residual of a fit.

    Parameters
    ----------
    statistic, dof, p_value : float
        Energy of the residual in slow modes along the arcs, over what the noise explains, with
        the fit's own directions taken into account. It follows chi-square, or F if the noise has
        been estimated.
    chi2_per_dof : float
        Chi-square per degree of freedom of all points.
    runs_z : float
        Runs test along the arcs, as a normal score; negative = fewer, longer runs of equal sign
        than for independent points. Taken of whitened residuals of points, per component.
    order_z, span_z : float
        Rank correlations of the poses' slow energy with their order and with their span, as
        normal scores of at most LARGEST_SCORE.
    position_z : float
        Score test of a displacement quadratic in the measured place, the same in all poses (a
        lens, a board out of its plane, a scale); as a normal score of at most LARGEST_SCORE.
    per_pose : dict
        Slow energy per degree of freedom by pose name.
    p_systematic : float or None
        For a cable that does not repeat: probability that alike poses share that much if each
        repeat has something random of its own and nothing else is missing.
    """

    statistic: float
    dof: int
    p_value: float
    chi2_per_dof: float
    runs_z: float
    order_z: float
    span_z: float
    position_z: float
    per_pose: dict[str, float]
    p_systematic: float | None = None

    @property
    def p_noise(self) -> float:
        """Probability of the residual if it is noise and what differs at random from pose to pose.

        That of the less likely of the tests made, corrected for their number (Sidak).
        """
        made = [p for p in (self.p_value, self.p_systematic) if p is not None]
        return sidak(min(made), len(made))


def noise_degrees(fit: Fit) -> float:
    """Degrees of freedom with which the noise of slow modes is known; inf if it is declared."""
    return max(LEAST_NOISE_DEGREES, min(fit.noise.slow_dof, fit.problem.priors.pose_scatter.dof))


def screening_degrees(fit: Fit) -> float:
    """Degrees of freedom for a fit whose slow modes were kept out of the noise estimate.

    The noise of slow modes is extrapolated from that of fast ones. Each correlation length of cable
    is counted as one degree, which is too many. An effect found with them therefore has to pass a
    second test, under the noise that is left once it is in the model.
    """
    rest_dof = fit.problem.priors.pose_scatter.dof
    if fit.noise.known:
        return noise_degrees(fit)
    if fit.noise.share == 0:
        return float(min(fit.problem.n_residuals, max(LEAST_NOISE_DEGREES, rest_dof)))
    stretches = fit.model.cable.length / (np.sqrt(2 * np.pi) * fit.noise.length)
    return float(max(LEAST_NOISE_DEGREES, min(len(fit.problem.used) * stretches, rest_dof)))


def structure_of(fit: Fit, noise_dof: float) -> Structure:
    """Test the residual of a fit for what noise with these degrees of freedom cannot explain."""
    problem, lin, mixed, model = fit.problem, fit.linearization, fit.mixed, fit.model
    bases = []
    for k, (item, s) in enumerate(zip(problem.fit_poses, fit.point.projections, strict=True)):
        modes = smooth_modes(s, model.cable.length, SLOW_MODES, not model.end.place)
        bases.append(np.linalg.qr(problem.whitening[k] @ item.slow_rows(modes))[0])
    ends = np.cumsum([len(basis) for basis in bases])[:-1]
    score = mixed.score(np.split(block_diag(*bases), ends))
    statistic, _, dof = score.gain(KEPT_VARIANCE)
    p_value = survival(statistic, max(dof, 1), noise_dof)
    energies = np.array([_energy(fit, k, basis) for k, basis in enumerate(bases)])
    items = problem.fit_poses
    pairs = zip(items, lin.residuals, strict=True)
    series = [one for item, e in pairs for one in item.along(e)]
    names, spans = [x.pose.name for x in items], np.array([x.pose.span for x in items])
    return Structure(
        statistic,
        dof,
        p_value,
        fit.chi2_per_dof,
        _runs(series),
        _rank_score(energies, np.arange(len(energies), dtype=float)),
        _rank_score(energies, spans),
        _position_score(fit, noise_dof),
        dict(zip(names, energies.tolist(), strict=True)),
        pose_scatter_of(fit, fit.noise).p_systematic if problem.priors.pose_scatter.std else None,
    )


def _energy(fit: Fit, k: int, basis: FloatArray) -> float:
    """Energy of the k-th pose's residual in slow modes (R_k, q) over that of its noise."""
    free = float((basis * fit.mixed.taken(k, basis)).sum())
    return float(((basis.T @ fit.linearization.residuals[k]) ** 2).sum()) / max(free, 0.1)


def _position_score(fit: Fit, noise_dof: float) -> float:
    """Score test of a displacement field's terms of first and second degree: ten in the plane."""
    problem, columns = fit.problem, []
    observed = problem.observed(fit.point)
    d = observed[0].curve.d
    pairs = list(combinations_with_replacement(range(d), 2))
    for k, (j, s) in enumerate(zip(problem.used, fit.point.projections, strict=True)):
        item = problem.measured[j]
        x = item.points / fit.model.cable.length
        terms = np.column_stack([x, *(x[:, a] * x[:, b] for a, b in pairs)])
        moved = np.einsum("dc,kt->kdct", np.eye(d), terms).reshape((len(x), d, -1))
        columns.append(problem.whitening[k] @ item.components(observed[j].curve, s, moved))
    score, _, dof = fit.mixed.score(columns).scaled.gain(COLLINEAR)
    p_value = survival(score, max(dof, 1), noise_dof)
    return -float(ndtri(np.clip(p_value, _TAIL, 1 - _TAIL)))


def _runs(series: list[FloatArray]) -> float:
    """Wald and Wolfowitz's runs test over all series, as a normal score."""
    excess, variance = 0.0, 0.0
    for e in series:
        positive = e > 0
        n1, n2 = int(positive.sum()), int((~positive).sum())
        n = n1 + n2
        if min(n1, n2) < 2:
            continue
        mean = 1 + 2 * n1 * n2 / n
        excess += 1 + int((positive[1:] != positive[:-1]).sum()) - mean
        variance += (mean - 1) * (mean - 2) / (n - 1)
    return float(excess / np.sqrt(variance)) if variance > 0 else 0.0


def _rank_score(a: FloatArray, b: FloatArray) -> float:
    """Spearman's rank correlation as a normal score."""
    if len(a) < 4 or np.ptp(b) == 0:
        return 0.0
    rho = float(np.corrcoef(_ranks(a), _ranks(b))[0, 1])
    return float(np.clip(rho * np.sqrt(len(a) - 1), -LARGEST_SCORE, LARGEST_SCORE))


def _ranks(x: FloatArray) -> FloatArray:
    """Ranks from 1 on, of equal values their mean; importing scipy.stats for it takes 0.3 s."""
    _, of, counts = np.unique(x, return_inverse=True, return_counts=True)
    return (np.cumsum(counts) - (counts - 1) / 2)[of]


def limiting_spread(fit: Fit) -> float | None:
    """Difference between repeats [m] if it is what limits a prediction, else None."""
    if enough_poses(fit.problem.history, fit.model):
        return None
    spread = repeatability(fit.problem.history, fit.model)
    if spread is None or fit.noise.source == "repeats":
        return spread
    floor = noise_distance(fit.problem.history, fit.noise.std)
    return spread if spread > UNSEEN * floor else None


def alike(fit: Fit) -> list[tuple[str, ...]]:
    """Groups of nuisances (length, scale, fixture, clamps) whose effects are the same.

    Taken from the correlations of the estimates that the data alone would give.
    """
    names = fit.problem.unknowns.names
    held = [k for k, name in enumerate(names) if name in fit.model.priors]
    if not held:
        return []
    hessian: FloatArray = fit.normal.hessian.copy()
    hessian[np.ix_(held, held)] -= fit.problem.precision[np.ix_(held, held)]
    scale = np.sqrt(np.maximum(np.diag(hessian), 1e-300))
    scaled = hessian / np.outer(scale, scale) + 1e-6 * np.eye(len(scale))
    covariance = np.linalg.inv(scaled)[np.ix_(held, held)]
    deviation = np.sqrt(np.maximum(np.diag(covariance), 1e-300))
    correlation = np.abs(covariance / np.outer(deviation, deviation))
    count, of = connected_components(correlation > ALIKE, directed=False)
    groups = [np.flatnonzero(of == group) for group in range(count)]
    return [tuple(names[held[k]] for k in group) for group in groups if len(group) > 1]
