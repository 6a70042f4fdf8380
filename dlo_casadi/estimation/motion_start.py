"""The start of a recorded motion in a fit: a first state near its points, then its own unknowns."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from dlo_casadi.arrays import FloatArray
from dlo_casadi.errors import EstimationError
from dlo_casadi.estimation.measured_shapes import measured_shapes
from dlo_casadi.estimation.problem import Problem
from dlo_casadi.estimation.recording import MODES, Recording, Seen, rest_state
from dlo_casadi.estimation.unknowns import Unknowns
from dlo_casadi.model.cable_model import CableModel
from dlo_casadi.model.tolerances import Tolerances
from dlo_casadi.motion.beginning import Basis
from dlo_casadi.motion.state import State
from dlo_casadi.motion.system import MovingCable
from dlo_casadi.runtime.work import spend
from dlo_casadi.sensing.measured_motion import MeasuredMotion
from dlo_casadi.sensing.measured_pose import MeasuredPose

# Elements of the mesh in motion: with 12, the third frequency of a cantilever is 1e-4 off.
MESH = 12
# Longest step of time [s], and number of them in a period of the first mode: with 100, what they
# miss (9 um RMS) looked like a weight of 0.2 % of the cable's in a video without any fault.
LONGEST_STEP, IN_A_PERIOD = 1e-2, 200
# Ends of the stretches [s] over which first states are sought.
FIRST_STRETCHES = (0.0, 0.15)
# Share of the objective that a step must gain for another one.
_NEARLY = 2e-2
# Share of the slowest frequency of a cable below which nothing holds a mode.
_FREE = 0.05
# Steps of the search for a first state, and trials of a damped step.
_STEPS, _TRIALS = 12, 8


@dataclass(frozen=True, eq=False)
class FittedMotion:
    """A recording at its own unknowns (n_own,), and what the model predicts."""

    recording: Recording
    own: FloatArray
    seen: Seen

    def objective(self, std: float, model: CableModel) -> float:
        """Half the sum of squares, its own priors included."""
        own = self.own / self.recording.own_std(model)
        return float(self.seen.residual @ self.seen.residual) / std**2 / 2 + float(own @ own) / 2


def unknowns_in_motion(unknowns: Unknowns) -> Unknowns:
    """The same unknowns on the mesh of motion."""
    return replace(unknowns, model=unknowns.model.with_mesh(MESH))


def begin(recording: Recording, problem: Problem, theta: FloatArray, std: float) -> FittedMotion:
    """A recording with its own unknowns fitted at the unknowns theta of still poses."""
    unknowns = unknowns_in_motion(problem.unknowns)
    model, measured = unknowns.model, recording.measured
    cable = MovingCable(model, unknowns.p(theta), unknowns.rest(theta))
    near: State | None = None
    own: FloatArray = np.zeros(len(recording.own_std(model)))
    fixtures = recording.fixtures(cable, 0.0, own)
    rest = rest_state(cable, fixtures, None)
    basis = Basis.of(cable, rest, fixtures, MODES)
    period = 2 * np.pi / float(basis.frequencies[0])
    dt = min(LONGEST_STEP, period / IN_A_PERIOD)
    recording = replace(recording, dt=dt, period=period, rest=rest)
    ends = [*FIRST_STRETCHES[1:]]
    if not measured.at_rest:
        basis = basis.near(cable, _frames(recording, problem, unknowns), fixtures)
        recording, near, ends = replace(recording, basis=basis), basis.about, [*FIRST_STRETCHES]
        own = np.zeros(len(recording.own_std(model)))
    found = None
    for end in ends:
        found = settled(replace(recording, until=end), unknowns, theta, own, near, std)
        own, near = found.own, found.seen.first
    assert found is not None
    return found


def frequencies_at_first(model: CableModel, measured: MeasuredMotion, count: int) -> FloatArray:
    """Lowest frequencies [Hz] of a model at rest between the first fixtures of a recording.

    Modes that nothing holds, such as a roll about ball joints, are left out. Raises EstimationError
    if there is no rest.
    """
    model = model.with_mesh(MESH)
    cable = MovingCable(model, model.nominal, np.zeros(model.chain.n_rests))
    recording = Recording(measured, Tolerances(), LONGEST_STEP)
    fixtures = recording.fixtures(cable, 0.0, np.zeros(len(recording.own_std(model))))
    rest = rest_state(cable, fixtures, None)
    found = Basis.of(cable, rest, fixtures, count + 1).frequencies
    return np.asarray(found[found > _FREE * cable.slowest][:count] / (2 * np.pi))


def _frames(recording: Recording, known: Problem, unknowns: Unknowns) -> FloatArray:
    """Frames (n_nodes, coordinates) along the points of the first instant."""
    measured = recording.measured
    held = recording.path.pose
    seen = np.isfinite(measured.points[0, :, 0])
    pose = MeasuredPose.of_points(held, measured.points[0][seen], s=measured.s[seen])
    problem = Problem(unknowns, (pose,), known.noise, known.priors)
    return np.asarray(measured_shapes(problem)[0].x[0])


def settled(
    recording: Recording,
    unknowns: Unknowns,
    theta: FloatArray,
    own: FloatArray,
    near: State | None,
    std: float,
) -> FittedMotion:
    """The recording's own unknowns that fit best at given theta: Levenberg-Marquardt."""
    model, damping = unknowns.model, 1e-6
    prior = 1 / recording.own_std(model) ** 2
    now = FittedMotion(
        recording, own, recording.evaluate(unknowns, theta, own, near, derivatives=True)
    )
    for _ in range(_STEPS):
        spend()
        by, residual = now.seen.by_own / std, now.seen.residual / std
        hessian, gradient = by.T @ by + np.diag(prior), by.T @ residual + prior * now.own
        objective, trial = now.objective(std, model), None
        for _ in range(_TRIALS):
            step = -np.linalg.solve(hessian + damping * np.diag(np.diag(hessian)), gradient)
            trial = tried(now, unknowns, theta, now.own + step)
            if trial is not None and trial.objective(std, model) < objective:
                break
            damping, trial = max(10 * damping, 1e-4), None
        if trial is None:
            break
        damping /= 10
        gain = objective - trial.objective(std, model)
        now = trial
        if gain < _NEARLY * objective:
            break
    return now


def tried(
    now: FittedMotion, unknowns: Unknowns, theta: FloatArray, own: FloatArray
) -> FittedMotion | None:
    """The recording at other unknowns; None if the motion is lost there."""
    try:
        seen = now.recording.evaluate(unknowns, theta, own, now.seen.first, derivatives=True)
    except EstimationError:
        return None
    return FittedMotion(now.recording, own, seen)
