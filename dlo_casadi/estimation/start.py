"""A first point of the batch problem: shapes from the measured lines, then all at once."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from dlo_casadi.equilibrium import guesses
from dlo_casadi.estimation.gauss_newton import BatchProblem, Point
from dlo_casadi.estimation.observation import (
    MeasuredPose,
    NodeCurve,
    chord_places,
    line_headings,
    normal_rows,
)
from dlo_casadi.estimation.sweep import Sensitivities, Shapes, Sweep
from dlo_casadi.model import DEVIATIONS, CableModel

FloatArray = NDArray[np.floating]

_KINEMATIC_STEPS = 8


def measured_shapes(problem: BatchProblem) -> tuple[Shapes, list[FloatArray]]:
    """Shapes of all poses: along the measured line where there is one, guessed elsewhere.

    Gauss-Newton on the kinematics alone, all poses in step: distances of the points, with a
    small penalty on the second differences of the headings where no point holds them.

    Returns
    -------
    Shapes, list of (K_j,) [m]
        Shapes without multipliers, and arc lengths of the fitted poses' points.
    """
    model, used = problem.unknowns.model, problem.used
    chain = model.chain
    m = len(problem.measured)
    # Without forces an element does not know its bow.
    sweep = (
        problem.sweep
        if chain.element != "quadratic"
        else Sweep(model.with_mesh(chain.n, "arc"), problem.sweep.poses)
    )
    flat = np.zeros(chain.n_cells)
    phi = np.array([guesses(model, model.nominal, flat, item.pose)[0] for item in problem.measured])
    feet: list[FloatArray] = []
    for j in used:
        places = chord_places(problem.measured[j], chain.length)
        phi[j] = line_headings(problem.measured[j], chain, places)
        feet.append(places)
    shapes = Shapes(phi, np.zeros((m, model.n_conditions)), np.zeros((m, len(DEVIATIONS))))
    for iteration in range(_KINEMATIC_STEPS + 1):
        seen = sweep.observe(shapes, problem.unknowns.fixed, flat)
        for k, j in enumerate(used):
            curve = NodeCurve.of(chain, seen.z[j])
            if iteration > 1:
                feet[k] = curve.feet(problem.measured[j].points, feet[k])
            if iteration < _KINEMATIC_STEPS:
                slopes = seen.by_x[j][:, : chain.n_headings]
                phi[j] += _kinematic_step(
                    problem.measured[j], model, curve, slopes, phi[j], feet[k]
                )
    return shapes, feet


def _kinematic_step(
    item: MeasuredPose,
    model: CableModel,
    curve: NodeCurve,
    slopes: FloatArray,
    phi: FloatArray,
    s: FloatArray,
) -> FloatArray:
    """Step of the headings towards the measured points, at most half a radian."""
    chain = model.chain
    gap = item.points - curve.at(s)
    penalty = np.diff(np.eye(len(phi)), n=2, axis=0)
    # 3 mm of noise a point against bends that change by 0.3 turns per length from cell to cell.
    rough = penalty * 0.003 / (0.3 * model.cable.curvature_scale * chain.h)
    axes = [np.tile(axis, (len(s), 1)) for axis in ([1.0, 0.0], [0.0, 1.0])]
    system: list[FloatArray] = [*(normal_rows(curve, s, axis) @ slopes for axis in axes), rough]
    target: list[FloatArray] = [gap[:, 0], gap[:, 1], -rough @ phi]
    if item.pose.end is not None:
        system.append(10 * slopes[[chain.n, 2 * chain.n + 1]])
        target.append(10 * (np.array(item.pose.end) - curve.nodes[-1]))
    for held, index, heading in (
        (model.start == "clamped", 0, item.pose.start_heading),
        (model.end == "clamped", len(phi) - 1, item.pose.end_heading),
    ):
        if held and heading is not None:
            row = np.zeros((1, len(phi)))
            row[0, index] = 0.01
            system.append(row)
            target.append(np.array([0.01 * (heading - phi[index])]))
    stacked = np.concatenate(system)
    step = np.linalg.solve(stacked.T @ stacked, stacked.T @ np.concatenate(target))
    return step * min(1.0, 0.5 / max(float(np.abs(step).max()), 1e-12))


def all_at_once(
    problem: BatchProblem,
    shapes: Shapes,
    feet: list[FloatArray],
    theta: FloatArray,
    held: NDArray[np.bool_],
    iterations: int = 6,
) -> Point | None:
    """Gauss-Newton on shapes, multipliers and unknowns together, from inconsistent values.

    The force balance is linearised about the measured shapes and solved along with the fit, so
    that no equilibrium is needed before the parameters are about right.

    Parameters
    ----------
    held : (size,) bool
        Entries of theta that stay where they are.

    Returns
    -------
    Point or None
        An equilibrium near the measured shapes, or None if there is none.
    """
    unknowns, sweep = problem.unknowns, problem.sweep
    n_phi = sweep.n_phi
    lower, upper = unknowns.bounds
    moving = ~held
    columns = sweep.used_deviations
    own = np.diag(1 / problem.deviation_std**2 + 1e-12)
    for _ in range(iterations):
        p, rest = unknowns.p(theta), unknowns.rest(theta)
        slopes = unknowns.slopes(theta)
        try:
            sens = sweep.sensitivities(shapes, p, rest, slopes, unknowns.rest_slopes)
            force, matrix = sweep.kkt(shapes, p, rest)
            correction = -np.linalg.solve(matrix, force[:, :, None])[:, :, 0]
        except np.linalg.LinAlgError:
            return None
        point = problem.evaluate(theta, shapes, feet)
        ahead = _predicted(problem, point, correction, sens, slopes)
        gap = theta - problem.mean
        hessian, gradient = problem.precision.copy(), problem.precision @ gap
        inner = []
        for j, (e, a, b) in zip(problem.used, ahead, strict=True):
            block = b.T @ b + own
            cross, slope = b.T @ a, b.T @ e + own @ shapes.deviation[j, columns]
            solved = np.linalg.solve(block, np.column_stack([cross, slope]))
            hessian += a.T @ a - cross.T @ solved[:, :-1]
            gradient += a.T @ e - cross.T @ solved[:, -1]
            inner.append(solved)
        damped = hessian[np.ix_(moving, moving)]
        damped = damped + 1e-6 * np.diag(np.diag(damped))
        step = np.zeros_like(theta)
        step[moving] = -np.linalg.solve(damped, gradient[moving])
        step = np.clip(theta + np.clip(step, -3, 3), lower, upper) - theta
        deviation = shapes.deviation.copy()
        for j, solved in zip(problem.used, inner, strict=True):
            deviation[j, columns] -= solved[:, :-1] @ step + solved[:, -1]
        moved = (deviation - shapes.deviation)[:, :, None]
        change = correction + sens.theta @ step + (sens.deviation @ moved)[:, :, 0]
        size = float(np.abs(change[:, :n_phi]).max())
        damp = min(1.0, 0.7 / max(size, 1e-12))
        shapes = replace(
            shapes,
            phi=shapes.phi + damp * change[:, :n_phi],
            lam=shapes.lam + change[:, n_phi:],
            deviation=deviation,
        )
        theta = theta + step
        feet = point.feet
        if not np.all(np.isfinite(shapes.phi)):
            return None
    final, converged = sweep.solve(shapes, unknowns.p(theta), unknowns.rest(theta), 40)
    if not converged.all():
        return None
    return problem.evaluate(theta, final, feet)


def _predicted(
    problem: BatchProblem,
    point: Point,
    correction: FloatArray,
    sens: Sensitivities,
    slopes: FloatArray,
) -> list[tuple[FloatArray, FloatArray, FloatArray]]:
    """Whitened residuals after the correction, and their Jacobians by theta and deviations."""
    unknowns, sweep = problem.unknowns, problem.sweep
    p, rest = unknowns.p(point.theta), unknowns.rest(point.theta)
    seen = sweep.observe(point.shapes, p, rest)
    out: list[tuple[FloatArray, FloatArray, FloatArray]] = []
    for j, s in zip(problem.used, point.feet, strict=True):
        curve = NodeCurve.of(unknowns.model.chain, seen.z[j])
        normals = curve.normals(s)
        rows = normal_rows(curve, s, normals)
        d = ((problem.measured[j].points - curve.at(s)) * normals).sum(axis=1)
        d = d - rows @ (seen.by_x[j] @ correction[j])
        white = problem.whitening(j, s)
        theta_z = seen.by_theta(j, sens, slopes)
        deviation_z = seen.by_own(j, sens)[:, sweep.used_deviations]
        out.append((white @ d, -white @ (rows @ theta_z), -white @ (rows @ deviation_z)))
    return out
