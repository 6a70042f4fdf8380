"""Quality of the batch estimate: bias, spread against the Cramer-Rao bound, coverage.

Every set draws a cable, its fixtures and its noise from what the estimate assumes, in the paper's
twelve poses, and is simulated on twice as fine a mesh. As in scripts/check_false_alarms.py, the
fixtures, the length and the scale scatter by the declared tolerances, and a part of the noise is
correlated along the cable.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Executor
from dataclasses import dataclass, replace
from functools import cache, partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dlo_casadi.equilibrium.batch import BatchEquilibrium
from dlo_casadi.errors import DloError
from dlo_casadi.estimation.constrained import profile_interval
from dlo_casadi.estimation.fit import fit_model
from dlo_casadi.estimation.prediction import predict_poses
from dlo_casadi.estimation.problem import Priors, Problem
from dlo_casadi.estimation.result import Fit
from dlo_casadi.estimation.unknowns import Unknowns, Values
from dlo_casadi.estimation.variances import settle
from dlo_casadi.model.assembly import Shapes
from dlo_casadi.model.cable_model import CableModel
from dlo_casadi.model.tolerances import Tolerances
from dlo_casadi.rod.ends import deviation_names
from dlo_casadi.rod.node import Heading
from dlo_casadi.runtime.parallel import generator_of, map_as_completed
from dlo_casadi.sensing.measured_pose import MeasuredPose
from dlo_casadi.sensing.noise import NoiseModel
from dlo_casadi.session.fitting import nuisances
from dlo_casadi.session.stages import rest_curvature_of
from dlo_casadi.show.style import BLACK, BLUE
from dlo_casadi.thresholds import NORMAL_95
from paper import published
from paper.content import Part, Section, Table, Target, drawing, number, rms
from paper.fits import REST_COEFFICIENTS

FloatArray = NDArray[np.floating]

MESH, FINE_MESH = 20, 40
POINTS = 120
# EI over the weight's m g L^2, drawn between these; guessed in their geometric middle.
STIFFNESSES = (0.03, 0.6)
# No draw is bent tighter than three diameters: beyond that a cable in a plane would fold or cross
# itself, which the model does not know.
TIGHTEST = 0.04  # m
# Second differences of the scaled coefficients of the rest curvature, drawn between these; that
# of Table 3 has 0.04.
ROUGHNESSES = (0.02, 0.1)
TOLERANCES = Tolerances()
# Most RMSE over the bound, and between what the intervals must cover.
MOST_SPREAD, COVERAGE = 1.15, (0.93, 0.97)
WEIGHT = published.MASS * 9.81 * published.LENGTH**2


@cache
def model_on(n: int) -> CableModel:
    """The declared model with its nuisances, on a mesh."""
    guess = WEIGHT * float(np.sqrt(np.prod(STIFFNESSES)))
    return nuisances(CableModel(published.cable(guess), n=n, n_rest=REST_COEFFICIENTS), TOLERANCES)


@dataclass(frozen=True)
class Truth:
    """What a set was made of; `deviation` (m, len(deviation_names(Heading))) of the poses' ends."""

    p: FloatArray
    coefficients: FloatArray
    roughness: float
    deviation: FloatArray
    noise: NoiseModel


def draw(rng: np.random.Generator) -> Truth:
    """Draw a set from the prior."""
    model = model_on(FINE_MESH)
    p = model.nominal.copy()
    p[0] = WEIGHT * np.exp(rng.uniform(*np.log(STIFFNESSES)))
    for k, q in enumerate(model.parameters):
        if np.isfinite(q.prior_std) and not q.log:
            p[k] += q.prior_std * rng.standard_normal()
    roughness = float(np.exp(rng.uniform(*np.log(ROUGHNESSES))))
    rest_only = Unknowns(model, np.zeros(len(p), dtype=bool), p)
    factor = np.linalg.cholesky(rest_only.prior(roughness)[1])
    scaled = np.linalg.solve(factor.T, rng.standard_normal(len(factor)))
    deviation = np.zeros((len(published.poses()), len(deviation_names(Heading))))
    deviation[:, :2] = TOLERANCES.end * rng.standard_normal((len(deviation), 2))
    noise = NoiseModel(
        rng.uniform(1e-4, 4e-4), rng.uniform(0.0, 0.6), rng.uniform(0.02, 0.04), "gaussian"
    )
    return Truth(p, scaled * model.cable.curvature_scale, roughness, deviation, noise)


def simulate(truth: Truth, rng: np.random.Generator) -> list[MeasuredPose] | None:
    """Measured lines; None if a pose has no stable equilibrium, or bends too tightly."""
    model = model_on(FINE_MESH)
    rest = model.rest_basis @ truth.coefficients
    found = predict_poses(model, truth.p, rest, published.poses())
    shapes = [
        item.equilibrium
        for item in found
        if item is not None
        and item.equilibrium.stable
        and item.equilibrium.min_bend_radius >= TIGHTEST
    ]
    if len(shapes) < len(found):
        return None
    stacked = Shapes(
        np.array([eq.x for eq in shapes]),
        np.array([eq.multipliers for eq in shapes]),
        truth.deviation,
    )
    equilibria = BatchEquilibrium(model, published.poses())
    moved, converged = equilibria.solve(stacked, truth.p, rest)
    if not converged.all():
        return None
    measured = []
    for pose, seen in zip(published.poses(), equilibria.seen(moved, truth.p, rest), strict=True):
        s = np.sort(rng.uniform(0.01, 0.99, POINTS)) * published.LENGTH
        factor = np.linalg.cholesky(truth.noise.covariance(s, np.ones(POINTS)))
        points = seen.curve.at(s) + factor @ rng.standard_normal((POINTS, 2))
        measured.append(MeasuredPose.of_points(pose, points))
    return measured


def bound(fit: Fit, truth: Truth) -> tuple[float, FloatArray]:
    """Cramer-Rao bound at the truth, noise and prior known: std of ln EI and of kappa_0(s) [1/m].

    The inverse of the information of the data plus that of the prior (van Trees).
    """
    unknowns = fit.problem.unknowns
    priors = replace(Priors.of(TOLERANCES, fit.model), roughness_std=truth.roughness)
    problem = Problem(unknowns, fit.problem.history, truth.noise, priors)
    theta = unknowns.pack(truth.p, truth.coefficients)
    start = Shapes(fit.point.shapes.x, fit.point.shapes.lam, truth.deviation)
    shapes, converged = problem.equilibria.solve(start, truth.p, unknowns.rest(theta))
    if not converged.all():
        raise DloError("the true parameters have no equilibria near the fitted ones")
    point = Values(theta, shapes, fit.point.projections)
    problem = problem.weighed(point)
    hessian = problem.mixed(point, problem.linearize(point)).normal.hessian
    covariance = np.linalg.inv(hessian)
    tail = slice(unknowns.n_parameters, unknowns.size)
    basis = fit.model.rest.basis(places()) * fit.model.cable.curvature_scale
    variance = np.einsum("ik,kl,il->i", basis, covariance[tail, tail], basis)
    return float(np.sqrt(covariance[0, 0])), np.sqrt(variance)


def places() -> FloatArray:
    """Where the rest curvature is compared [m]: those of a report."""
    return np.linspace(0.0, published.LENGTH, 41)


def run_one(index: int, seed: int) -> dict[str, Any]:
    """One set, whose random numbers depend on seed and index alone."""
    rng = generator_of(seed, index)
    measured = None
    while measured is None:
        truth = draw(rng)
        measured = simulate(truth, rng)
    # The guess is within a factor of five: one start is enough.
    fit = settle(fit_model(model_on(MESH), measured, TOLERANCES))
    interval = profile_interval(fit)
    rest = rest_curvature_of(fit)
    gap = rest.value - fit.model.rest.basis(places()) @ truth.coefficients
    bound_log, bound_rest = bound(fit, truth)
    true = truth.p[0]
    low, high = interval.low or 0.0, interval.high or np.inf
    return {
        "true_over_weight": true / WEIGHT,
        "log_error": float(np.log(fit.p[0] / true)),
        "log_bound": bound_log,
        "log_std": fit.std("bending_stiffness") / float(fit.p[0]),
        "covered": bool(low <= true <= high),
        "bounded": interval.low is not None and interval.high is not None,
        "rest_error": gap.tolist(),
        "rest_bound": bound_rest.tolist(),
        "rest_covered": (np.abs(gap) <= NORMAL_95 * rest.std).tolist(),
        "noise_std": fit.noise.std / truth.noise.std,
    }


def run(executor: Executor, sets: int, tell: Callable[[str], None], seed: int = 0) -> Part:
    """Simulate and fit so many sets; those that fail are counted."""
    rows: list[dict[str, Any]] = []
    failures: list[str] = []
    for done in map_as_completed(executor, partial(run_one, seed=seed), range(sets)):
        if done.error is None:
            rows.append({"set": done.index, **done.value})
        else:
            failures.append(f"set {done.index}: {done.error}")
        count = len(rows) + len(failures)
        if rows and (count % 20 == 0 or count == sets):
            tell(f"{count} of {sets}: {_summary(rows)}, {len(failures)} failed")
    rows.sort(key=lambda row: row["set"])
    part = Part("monte_carlo")
    part.data = {**_summary(rows), "sets": sets, "failures": failures, "rows": rows}
    part.sections = [_section(part.data, rows)]
    part.targets = _targets(part.data)
    return part


def _summary(rows: list[dict[str, Any]]) -> dict[str, float]:
    score = np.array([row["log_error"] / row["log_bound"] for row in rows])
    errors = np.array([row["rest_error"] for row in rows])
    rest = errors / np.array([row["rest_bound"] for row in rows])
    return {
        "stiffness_bias": float(score.mean()),
        "stiffness_spread": rms(score),
        "stiffness_coverage": float(np.mean([row["covered"] for row in rows])),
        "stiffness_bounded": float(np.mean([row["bounded"] for row in rows])),
        "rest_bias": float(rest.mean()),
        "rest_spread": rms(rest),
        "rest_coverage": float(np.mean([row["rest_covered"] for row in rows])),
    }


def _section(found: dict[str, Any], rows: list[dict[str, Any]]) -> Section:
    sets = len(rows)
    section = Section(
        "monte-carlo",
        "How good the batch estimate is",
        [
            f"{found['sets']} sets in the paper's twelve poses, {len(found['failures'])} of which "
            f"failed; fitted on {MESH} quadratic elements, simulated on {FINE_MESH}. EI between "
            f"{STIFFNESSES[0]} and {STIFFNESSES[1]} m g L², rest curvature, fixtures, length and "
            f"scale drawn from the prior, no bend tighter than {1e3 * TIGHTEST:.0f} mm, noise of "
            "0.1 to 0.4 mm of which up to 60 % are correlated over 20 to 40 mm. Noise, its "
            "correlation, roughness and scatter are estimated.",
            "The Cramér–Rao bound is that of someone who knows the noise and the prior. Bias and "
            "RMSE are in units of it; the EI's are those of ln EI, the rest curvature's those of "
            "41 places along the cable. Intervals: profile likelihood for EI, ±1.96 standard "
            f"deviations for the rest curvature. The coverage of {sets} sets is known to "
            f"±{100 * 1.96 * np.sqrt(0.95 * 0.05 / sets):.1f} %.",
        ],
    )
    section.tables.append(
        Table(
            "Batch estimate against the bound",
            ["", "bias / bound", "RMSE / bound", "coverage of 95 % intervals"],
            [
                [
                    title,
                    number(found[f"{name}_bias"], 3),
                    number(found[f"{name}_spread"], 3),
                    f"{100 * found[f'{name}_coverage']:.1f} %",
                ]
                for name, title in (("stiffness", "ln EI"), ("rest", "rest curvature"))
            ],
        )
    )
    caption = "Errors in units of the Cramér–Rao bound; the line is the standard normal density."
    with drawing(section, "monte-carlo", caption, (7.6, 3.2)) as figure:
        left, right = figure.subplots(1, 2)
        score = np.array([row["log_error"] / row["log_bound"] for row in rows])
        rest = np.array([row["rest_error"] for row in rows])
        rest = rest / np.array([row["rest_bound"] for row in rows])
        grid = np.linspace(-4, 4, 161)
        for axes, values, title in ((left, score, "ln EI"), (right, rest, "rest curvature")):
            axes.hist(values.ravel(), bins=np.linspace(-4, 4, 33), density=True, color=BLUE)
            axes.plot(grid, np.exp(-(grid**2) / 2) / np.sqrt(2 * np.pi), color=BLACK)
            axes.set_title(title)
            axes.set_xlabel("error / bound")
    return section


def _targets(found: dict[str, Any]) -> list[Target]:
    out = []
    for name, title in (("stiffness", "EI"), ("rest", "rest curvature")):
        spread, coverage = found[f"{name}_spread"], found[f"{name}_coverage"]
        out += [
            Target(
                f"RMSE of {title} over the Cramér–Rao bound",
                f"at most {MOST_SPREAD}",
                f"{spread:.3f}",
                spread <= MOST_SPREAD,
            ),
            Target(
                f"Coverage of the 95 % intervals of {title}",
                "93 to 97 %",
                f"{100 * coverage:.1f} %",
                COVERAGE[0] <= coverage <= COVERAGE[1],
            ),
        ]
    return out
