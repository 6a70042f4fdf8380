"""The declared model of a configuration, its fit, and the simpler fits beside it."""

import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from typing import NamedTuple

import numpy as np

from dlo_casadi.arrays import FloatArray
from dlo_casadi.config import Config, EstimationOptions, declared_setup, wrong_effects
from dlo_casadi.diagnosis.candidates import setup_of
from dlo_casadi.effects import EFFECTS, NUISANCES, UNKNOWN_MASS
from dlo_casadi.errors import ConfigError, EstimationError
from dlo_casadi.estimation.batch import solve_batch
from dlo_casadi.estimation.descent import CONVERGED, descend, least_decrease
from dlo_casadi.estimation.fit import (
    EXPLAINED,
    fine_enough,
    fit_model,
    fit_to_misfit,
    mesh_error,
    refine_mesh,
)
from dlo_casadi.estimation.prediction import predicted_shapes
from dlo_casadi.estimation.problem import Point
from dlo_casadi.estimation.result import Fit
from dlo_casadi.estimation.stiffness import StiffnessFit, fit_stiffness
from dlo_casadi.estimation.variances import first_reading_noise, refine
from dlo_casadi.model.cable_model import BENDING_STIFFNESS, END_ROLL, CableModel, Tolerances
from dlo_casadi.paper.algorithm1 import Algorithm1Result, applies, run_algorithm1
from dlo_casadi.sensing.measured_pose import MeasuredPose
from dlo_casadi.session.outcome import SIMPLER, Stage
from dlo_casadi.session.stages import algorithm1_stage, initial_stage, stiffness_stage

# Elements of the declared model's mesh; refined from the data.
MESH = 40
# Stiffness and shapes are searched for on this mesh; in space, where an element takes 17
# times the operations, on half of it.
FIRST_MESH = 20
REST_COEFFICIENTS = 13
# Markers that are nearer to each other than this share of the cable are at one place.
SAME_PLACE = 0.02
# Share of the objective by which IPOPT's minimum may lie higher and be the same: it stops once the
# points' places along the cable move by a thousandth of the noise. 1.5e-7 is the most of ten fits.
SAME_MINIMUM = 1e-6
# Huber's constant: points beyond it count with their distance instead of its square.
HUBER = 1.5


@dataclass(frozen=True)
class Declared:
    """The declared model and what of it is estimated.

    Parameters
    ----------
    model : CableModel
        Nominal values, priors of the nuisances within their tolerances.
    start : (n_parameters,)
        Parameters at their declared values.
    free : list of str
        Parameters that do not keep them.
    """

    model: CableModel
    start: FloatArray
    free: list[str]
    tolerances: Tolerances


def nuisances(
    model: CableModel,
    tolerances: Tolerances,
    pixel: float | None = None,
    readings: tuple[str, ...] = (),
) -> CableModel:
    """Return the model with what is known of its effects before any shape as nuisances.

    What lies within a declared tolerance gets a Gaussian prior with the tolerance as standard
    deviation; photographs with pixels of the size `pixel` [m] also a bias of edges, `readings` one
    of their sensors.
    """
    setup = setup_of(model, tolerances=asdict(tolerances), pixel=pixel, readings=readings)
    present = {effect.label for effect in model.effects}
    kinds = [x for x in (*EFFECTS.values(), *NUISANCES.values()) if x.applies(setup)]
    for effect in (effect for kind in kinds for effect in kind.each_for(setup)):
        if effect.label in present:
            continue
        priors = {f"{effect.label}.{name}": std for name, std in effect.prior(setup).items()}
        model = model.with_effect(effect, priors) if priors else model
    return model


def declared_model(
    config: Config,
    center: tuple[float, float] | None = None,
    pixel: float | None = None,
    *,
    known: bool = False,
) -> Declared:
    """Build the declared model.

    Parameters
    ----------
    center : (float, float), optional [m]
        Middle of the photographs in the board frame.
    pixel : float, optional [m]
        Size of a pixel on the board, for photographs.
    known : bool
        Whether all is known to be as declared: without nuisances.

    Raises
    ------
    ConfigError
        If a configuration that was changed since it was loaded names effects that cannot be.
    """
    if problems := wrong_effects(config):
        raise ConfigError("; ".join(problem.message for problem in problems), config.path)
    setup = replace(declared_setup(config), center=center)
    experiment, options = config.experiment, config.model
    coefficients = config.estimation.rest_curvature_coefficients
    model = CableModel(
        cable=setup.cable,
        n=options.n or MESH,
        element=options.element,
        start=experiment.boundary.start,
        end=experiment.boundary.end,
        gravity=experiment.gravity,
        n_rest=REST_COEFFICIENTS if coefficients is None else coefficients,
        clips=experiment.clips,
        obstacles=experiment.surfaces,
    )
    if END_ROLL in model.names and not known:
        model = replace(model, priors={END_ROLL: experiment.tolerances.roll})
    for item in options.effects:
        model = model.with_effect(EFFECTS[item.name].made_for(setup))
    if config.cable.mass is None:
        model = model.with_effect(UNKNOWN_MASS())
    tolerances = Tolerances(**setup.tolerances)
    if not known:
        model = nuisances(model, tolerances, pixel, setup.readings)
    start, free = model.nominal.copy(), list(model.names)
    for item in options.effects:
        for name, parameter in item.parameters.items():
            start[model.names.index(f"{item.name}.{name}")] = parameter.value
            if parameter.fixed:
                free.remove(f"{item.name}.{name}")
    return Declared(model, start, free, tolerances)


def straight(model: CableModel) -> CableModel:
    """Return the model without rest curvature and without effects."""
    return replace(model, cable=replace(model.cable, straight=True), effects=(), priors={})


def fit_declared(
    config: Config, declared: Declared, measured: Sequence[MeasuredPose], n: int | None = None
) -> tuple[Fit, float]:
    """Fit the declared model on a mesh that is fine enough, and return the mesh's error [m].

    A mesh that is too coarse looks like a missing effect; it is refined first.
    """
    finest, first = config.model.n or n, first_mesh(declared.model)
    model = declared.model.with_mesh(min(finest or first, first))
    if config.estimation.rest_curvature_coefficients is None:
        model = replace(model, n_rest=min(model.n_rest, carried_coefficients(model, measured)))
    measurement = config.experiment.measurement
    fit = fit_model(
        model,
        measured,
        declared.tolerances,
        measurement.std,
        free=declared.free,
        values=declared.start,
        readings=first_reading_noise(model, measurement.force_std, measurement.moment_std),
    )
    if finest:
        fit = refine_mesh(fit, finest)
        return fit, mesh_error(fit)
    return fine_enough(fit, first)


def first_mesh(model: CableModel) -> int:
    """Number of elements on which stiffnesses and shapes are searched for.

    Cables bend sharply at saddles and eyelets: on 10 elements, of a cable in space through one of
    each, the true parameters leave twice what they leave on 20. A stretch that lies on an obstacle
    ends at nodes.
    """
    more = sum(kind != "pinned" for kind in model.clips) + 2 * bool(model.surfaces)
    return FIRST_MESH // len(model.node.curvatures) * (2 + more) // 2


def carried_coefficients(model: CableModel, measured: Sequence[MeasuredPose]) -> int:
    """Number of coefficients of the rest curvature that the measurements can carry.

    All poses share one rest curvature, so that each place with a marker tells one number across
    the cable; the heading of a clamp takes one of them, but for the first two: it is known within
    its tolerance. Lines show all places.
    """
    fitted = [item for item in measured if item.readable and not item.held_out]
    if not all(sensor.marked for item in fitted for sensor in item.sensors):
        return REST_COEFFICIENTS
    places = np.sort(np.concatenate([item.places(np.inf) for item in fitted]))
    count = 1 + int((np.diff(places) > SAME_PLACE * places[-1]).sum())
    # Of twenty simulated cables of two to four markers a constant left structure in two, both with
    # two markers; a straight line did not.
    return max(min(count, 2), count - (model.start, model.end).count("clamped"))


class Minimum(NamedTuple):
    """Minimum of the batch NLP as IPOPT has found it, and its time [s].

    None where it fails; it is not `searched` for in space, where third derivatives of all elements
    would cost IPOPT minutes a run.
    """

    point: Point | None = None
    seconds: float = 0.0
    searched: bool = True


def minimum_by_ipopt(fit: Fit) -> Minimum:
    """Minimum of the batch NLP, from the Gauss-Newton fit's; none in space or held in between."""
    if fit.model.in_space or fit.model.clips or fit.model.surfaces:
        return Minimum(searched=False)
    began = time.perf_counter()
    try:
        point = solve_batch(fit.problem, fit.point)[0]
    except EstimationError:
        point = None
    return Minimum(point, time.perf_counter() - began)


def confirmed(fit: Fit, found: Minimum) -> Fit:
    """The fit, compared with IPOPT's minimum.

    Where that is lower by more than what a descent stops at, it is the fit's. Where it is the same,
    the fit has converged; where IPOPT has failed, it has not. In space, with clips, and where IPOPT
    ends higher, the fit stays as it is.
    """
    point, own = found.point, fit.point.objective
    if not found.searched:
        return fit
    if point is None:
        return replace(fit, converged=False)
    if point.objective < own - least_decrease(fit.problem, fit.point):
        return Fit(fit.problem, point, converged=True)
    same = point.objective <= own + SAME_MINIMUM * abs(own)
    return replace(fit, converged=True) if same and not fit.converged else fit


def reweighted(fit: Fit) -> tuple[MeasuredPose, ...]:
    """All poses of a fit, in those fitted outlying points weigh less (Huber's weights)."""
    out = list(fit.problem.history)
    for k, d in zip(fit.problem.fitted, fit.linearization.raw, strict=True):
        item = out[k]
        square = np.bincount(item.point_of, d[item.on_points] ** 2) / np.bincount(item.point_of)
        score = np.sqrt(square) / (fit.noise.std * item.relative_white)
        grown = np.sqrt(np.maximum(1.0, score / HUBER))
        out[k] = item.weighing(item.relative_std * grown)
    return tuple(out)


@dataclass(frozen=True)
class SimplerFits:
    """Simpler fits of the same cable, straight at rest, without its effects.

    Parameters
    ----------
    model : CableModel
        On the mesh that the stiffness was searched on.
    alone : StiffnessFit
        The stiffness alone.
    loop : Algorithm1Result, optional
        Of the paper's loop.
    missing : str
        Why the loop did not run.
    seconds : float [s]
        That it took.
    """

    model: CableModel
    alone: StiffnessFit
    loop: Algorithm1Result | None
    missing: str
    seconds: float

    def stages(self, measured: Sequence[MeasuredPose], n: int) -> list[Stage]:
        """Prior, stiffness alone and the paper's loop as stages on a mesh of n elements."""
        model = self.model.with_mesh(n)
        return [
            initial_stage(model, measured),
            stiffness_stage(model, measured, self.alone),
            algorithm1_stage(self.loop, measured, model, self.missing),
        ]


def simpler_fits(
    options: EstimationOptions, declared: CableModel, measured: Sequence[MeasuredPose], n: int
) -> tuple[SimplerFits, list[Stage]]:
    """The simpler fits, and their stages on a mesh of n elements."""
    # A single number of a simplified model: a coarse mesh suffices.
    model = straight(declared).with_mesh(min(n, first_mesh(declared)))
    alone = fit_stiffness(model, measured)
    missing, loop, seconds = _not_applicable(options, declared, measured), None, 0.0
    if not missing:
        began = time.perf_counter()
        loop = run_algorithm1(
            declared.cable,
            [item for item in measured if item.readable and not item.held_out],
            declared.gravity,
            n=options.algorithm1_n,
            inner=options.algorithm1_inner,
        )
        seconds = time.perf_counter() - began
    found = SimplerFits(model, alone, loop, missing, seconds)
    return found, found.stages(measured, n)


def _not_applicable(
    options: EstimationOptions, model: CableModel, measured: Sequence[MeasuredPose]
) -> str:
    """Why the paper's loop does not run; empty if it does."""
    if not options.algorithm1:
        return "switched off"
    if not applies(model):
        return "the paper's loop needs a plane and two pinned ends"
    sensors = [sensor for item in measured for sensor in item.sensors]
    if any(sensor.marked and sensor.per_point for sensor in sensors):
        return "the paper's loop needs lines along the cable, not single markers"
    return ""


def not_worse(fit: Fit, stages: Sequence[Stage]) -> Fit:
    """A fit, or a better one that starts from a simpler one.

    A simpler fit is a start where its objective is smaller, where it predicts the fit poses better,
    or where the fit has not converged. `stages`: the simpler ones, and at last the fit's own.
    """
    *others, own = stages
    best = fit
    for stage in others:
        if stage.name in SIMPLER:
            better = not fit.converged or _off(stage) < _off(own)
            found = _from_simpler(fit, stage, better)
            if found is not None and found.point.objective <= fit.point.objective - CONVERGED:
                found = found if fit.noise.source == "misfit" else refine(found)
                best = max(best, found, key=lambda item: item.log_evidence)
    return best


def nearest_to_poses(
    fit: Fit, stages: Sequence[Stage], staged: Callable[[Fit], Stage]
) -> tuple[Fit, Stage]:
    """A fit and its stage; of one that lacks something the nearest to the fit poses, if need be.

    A fit that trusts each point to its noise bends ends and rest shape to whatever the model lacks,
    and may predict the poses worse than a straight cable. Then it is fitted to its misfit, too,
    from itself and from each simpler fit: what predicts the poses best is taken. `stages`: as in
    `not_worse`. `staged`: stage of a fit.
    """
    *others, own = stages
    simpler = [stage for stage in others if stage.name in SIMPLER]
    least = min(map(_off, simpler), default=np.inf)
    misfit, lacks = fit.noise.source == "misfit", fit.chi2_per_dof > EXPLAINED
    if not misfit and not lacks:
        if not fit.problem.priors.pose_scatter.std:
            return fit, own
        # By more than chance where all that is left may be what differs from pose to pose.
        least *= 1 + 1 / np.sqrt(2 * len(fit.problem.used))
    if _off(own) <= least:
        return fit, own
    first = fit if misfit else fit_to_misfit(fit)
    found = [None if misfit else first, *(_from_simpler(first, stage, True) for stage in simpler)]
    return min(
        [(fit, own), *((other, staged(other)) for other in found if other is not None)],
        key=lambda pair: _off(pair[1]),
    )


def _off(stage: Stage) -> float:
    """Error [m] of the fit poses, each on the branch where it was measured."""
    error = stage.rmse_fit_measured_branch
    return np.inf if error is None else error


def _from_simpler(fit: Fit, simpler: Stage, better: bool) -> Fit | None:
    """The fit that begins at a straight cable of a stage's stiffness; None if there is none.

    Unless that cable is `better` it has to begin below the fit.
    """
    problem, model = fit.problem, fit.model
    values = model.nominal.copy()
    values[model.stiffness_indices] *= simpler.parameters[BENDING_STIFFNESS].value / values[0]
    theta = problem.unknowns.pack(values, np.zeros(model.n_coefficients))
    start = replace(fit.point, theta=theta)
    point = problem.balanced(start)
    if point is None and better:
        point = problem.balanced(replace(start, shapes=predicted_shapes(problem, start)))
    if point is None or (not better and point.objective >= fit.point.objective):
        return None
    with suppress(EstimationError):  # at a fold of its equilibria
        return descend(Fit(problem, point))
    return None
