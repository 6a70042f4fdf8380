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
    normal_rows,
)
from dlo_casadi.estimation.sweep import Shapes
from dlo_casadi.model import CableModel

FloatArray = NDArray[np.float64]


def headings_along(measured: MeasuredPose, model: CableModel) -> tuple[FloatArray, FloatArray]:
    """Headings of a smooth curve of the cable's length through the measured points.

    Gauss-Newton on the kinematics alone: distances to the points, with a small penalty on the
    second differences of the headings where there is no point to hold them.

    Returns
    -------
    (n_headings,) [rad], (K,) [m]
        Headings and arc lengths of the points' feet.
    """
    chain = model.chain
    places = chord_places(measured, chain.length)
    phi = _polyline_headings(measured, model, places)
    n_lam = model.n_conditions
    ends = measured.pose.vector
    p, rest = model.nominal, np.zeros(chain.n_cells)
    penalty = np.diff(np.eye(len(phi)), n=2, axis=0)
    # 3 mm of noise a point against bends that change by less than a turn per length and cell.
    rough = penalty * 0.003 / (model.cable.curvature_scale * chain.h * 3e-1)
    s = places
    for iteration in range(8):
        z, by_x, _, _ = (
            np.array(block)
            for block in model.observation(phi, np.zeros(n_lam), p, rest, ends, np.zeros(4))
        )
        curve = NodeCurve.of(chain, z[:, 0])
        if iteration > 1:
            s = curve.feet(measured.points, s)
        gap = measured.points - curve.at(s)
        x_rows = normal_rows(curve, s, np.tile([1.0, 0.0], (len(s), 1)))
        y_rows = normal_rows(curve, s, np.tile([0.0, 1.0], (len(s), 1)))
        slopes = by_x[:, : len(phi)]
        system = [x_rows @ slopes, y_rows @ slopes, rough]
        target = [gap[:, 0], gap[:, 1], -rough @ phi]
        if measured.pose.end is not None:
            last = [chain.n, 2 * chain.n + 1]
            system.append(10 * slopes[last])
            target.append(10 * (np.array(measured.pose.end) - curve.nodes[-1]))
        for held, index, heading in (
            (model.start == "clamped", 0, measured.pose.start_heading),
            (model.end == "clamped", len(phi) - 1, measured.pose.end_heading),
        ):
            if held and heading is not None:
                row = np.zeros((1, len(phi)))
                row[0, index] = 0.01
                system.append(row)
                target.append(np.array([0.01 * (heading - phi[index])]))
        step = np.linalg.lstsq(np.concatenate(system), np.concatenate(target), rcond=None)[0]
        phi = phi + step * min(1.0, 0.5 / max(float(np.abs(step).max()), 1e-12))
    return phi, curve.feet(measured.points, s)


def _polyline_headings(measured: MeasuredPose, model: CableModel, places: FloatArray) -> FloatArray:
    """Headings of chords of a few hundredths of the length, unwrapped along the cable."""
    chain = model.chain
    line = [np.array(measured.pose.start)[None], measured.points]
    s = [np.array([0.0]), places]
    if measured.pose.end is not None:
        line.append(np.array(measured.pose.end)[None])
        s.append(np.array([chain.length]))
    points, at = np.concatenate(line), np.maximum.accumulate(np.concatenate(s))
    grid = np.linspace(0.0, at[-1], 31)
    coarse = np.stack([np.interp(grid, at, points[:, i]) for i in (0, 1)], axis=1)
    chords = np.diff(coarse, axis=0)
    headings = np.unwrap(np.arctan2(chords[:, 1], chords[:, 0]))
    if measured.pose.start_heading is not None:
        turns = np.round((measured.pose.start_heading - headings[0]) / (2 * np.pi))
        headings = headings + 2 * np.pi * turns
    return np.interp(chain.heading_places, (grid[1:] + grid[:-1]) / 2, headings)


def measured_shapes(problem: BatchProblem) -> tuple[Shapes, list[FloatArray]]:
    """Shapes of all poses: along the measured line where there is one, guessed elsewhere."""
    model = problem.unknowns.model
    phis, feet = [], []
    for j, item in enumerate(problem.measured):
        if j in problem.used:
            phi, s = headings_along(item, model)
            feet.append(s)
        else:
            phi = guesses(model, item.pose, np.zeros(model.chain.n_cells))[0]
        phis.append(phi)
    m = len(phis)
    shapes = Shapes(np.array(phis), np.zeros((m, model.n_conditions)), np.zeros((m, 4)))
    return shapes, feet


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
    for _ in range(iterations):
        p, rest = unknowns.p(theta), unknowns.rest(theta)
        slopes = unknowns.slopes(theta)
        try:
            sens = sweep.sensitivities(shapes, p, rest, slopes, unknowns.rest_slopes)
            correction = _newton_correction(problem, shapes, p, rest)
        except np.linalg.LinAlgError:
            return None
        point = problem.evaluate(theta, shapes, feet)
        ahead = _predicted(problem, point, correction, sens.theta, slopes)
        gap = theta - problem.mean
        hessian, gradient = problem.precision.copy(), problem.precision @ gap
        for e, a in ahead:
            hessian += a.T @ a
            gradient += a.T @ e
        damped = hessian[np.ix_(moving, moving)]
        damped = damped + 1e-6 * np.diag(np.diag(damped))
        step = np.zeros_like(theta)
        step[moving] = -np.linalg.solve(damped, gradient[moving])
        step = np.clip(theta + np.clip(step, -3, 3), lower, upper) - theta
        change = correction + sens.theta @ step
        size = float(np.abs(change[:, :n_phi]).max())
        damp = min(1.0, 0.7 / max(size, 1e-12))
        shapes = replace(
            shapes,
            phi=shapes.phi + damp * change[:, :n_phi],
            lam=shapes.lam + change[:, n_phi:],
        )
        theta = theta + step
        feet = point.feet
        if not np.all(np.isfinite(shapes.phi)):
            return None
    solved, converged = sweep.solve(shapes, unknowns.p(theta), unknowns.rest(theta), 40)
    if not converged or np.abs(solved.phi - shapes.phi).max() > 1.5:
        return None
    return problem.evaluate(theta, solved, feet)


def _newton_correction(
    problem: BatchProblem, shapes: Shapes, p: FloatArray, rest: FloatArray
) -> FloatArray:
    """Change of (phi, lam) that removes the imbalance to first order (m, N)."""
    sweep = problem.sweep
    rests = sweep.rests(shapes, p, rest)
    force, matrix = sweep._call("kkt", shapes, p, rests)
    return -np.linalg.solve(matrix, force)[:, :, 0]


def _predicted(
    problem: BatchProblem,
    point: Point,
    correction: FloatArray,
    by_theta: FloatArray,
    slopes: FloatArray,
) -> list[tuple[FloatArray, FloatArray]]:
    """Whitened residuals after the correction, and their Jacobian by theta."""
    unknowns, sweep = problem.unknowns, problem.sweep
    p, rest = unknowns.p(point.theta), unknowns.rest(point.theta)
    z, by_x, by_p, _ = sweep.observe(point.shapes, p, rest)
    out = []
    for j, s in zip(problem.used, point.feet, strict=True):
        curve = NodeCurve.of(unknowns.model.chain, z[j])
        normals = curve.normals(s)
        rows = normal_rows(curve, s, normals)
        d = ((problem.measured[j].points - curve.at(s)) * normals).sum(axis=1)
        d = d - rows @ (by_x[j] @ correction[j])
        white = problem.whitening(j, s)
        out.append((white @ d, -white @ (rows @ (by_x[j] @ by_theta[j] + by_p[j] @ slopes))))
    return out
