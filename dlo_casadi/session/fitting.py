"""Fit the declared model of a configuration, and simpler models for comparison."""

import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from typing import NamedTuple

import numpy as np

from dlo_casadi.arrays import FloatArray
from dlo_casadi.config import (
    Config,
    EstimationOptions,
    declared_effects,
    declared_setup,
    wrong_effects,
)
from dlo_casadi.diagnosis.candidates import setup_of
from dlo_casadi.diagnosis.structure import noise_degrees, structure_of
from dlo_casadi.effects import EFFECTS, NUISANCES, UNKNOWN_MASS
from dlo_casadi.equilibrium.equilibrium import NEARBY
from dlo_casadi.errors import ConfigError, EstimationError
from dlo_casadi.estimation.batch import solve_batch
from dlo_casadi.estimation.descent import CONVERGED, MISFIT_GAIN, descend, least_decrease
from dlo_casadi.estimation.fit import (
    explains,
    fine_enough,
    fit_model,
    fit_to_misfit,
    refine_mesh,
)
from dlo_casadi.estimation.prediction import predicted_shapes
from dlo_casadi.estimation.result import Fit
from dlo_casadi.estimation.stiffness import StiffnessFit, fit_stiffness
from dlo_casadi.estimation.unknowns import Point
from dlo_casadi.estimation.variances import first_reading_noise, refine
from dlo_casadi.model.cable_model import BENDING_STIFFNESS, END_ROLL, CableModel
from dlo_casadi.model.tolerances import Tolerances
from dlo_casadi.paper.algorithm1 import Algorithm1Result, applies, run_algorithm1
from dlo_casadi.sensing.measured_pose import MeasuredPose
from dlo_casadi.session.outcome import SIMPLER, Stage
from dlo_casadi.session.stages import algorithm1_stage, initial_stage, stiffness_stage

# Elements of the declared model's first mesh; the data then decide on its refinement.
MESH = 40
# Mesh on which stiffness and shapes are searched for. In space an element takes 17 times the
# operations, so half as many are used.
FIRST_MESH = 20
# Of the rest curvature, whatever is measured: its roughness, which the data tell, holds what few
# markers do not show. With as many as there are places of markers, clean heavy cables with three of
# them had a force or a stiff section named in their place (check_heavy.py).
REST_COEFFICIENTS = 13
# Share of the objective by which IPOPT's minimum may be higher and still count as the same: IPOPT
# stops once arc lengths move by a thousandth of the noise. Largest of ten fits: 1.5e-7.
SAME_MINIMUM = 1e-6


@dataclass(frozen=True)
class Declared:
    """The declared model and which of its parameters are estimated.

    Parameters
    ----------
    model : CableModel
        With nominal values, and priors of the nuisance parameters within their tolerances.
    start : (n_parameters,)
        Parameters at their declared values.
    free : list of str
        Names of the parameters that are estimated.
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
    """Return the model with prior knowledge of its effects added as nuisance parameters.

    Each declared tolerance is the standard deviation of a Gaussian prior. Photographs with pixels
    of size `pixel` [m] add a bias of edges, `readings` add one of their sensors.
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
        Whether everything is exactly as declared: no nuisance parameters.

    Raises
    ------
    ConfigError
        If the configuration was changed after loading and names unknown effects.
    """
    if problems := wrong_effects(config, known=known):
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
        fed_by_length=experiment.fed_by_length,
    )
    if END_ROLL in model.names and not known:
        model = replace(model, priors={END_ROLL: experiment.tolerances.roll})
    declared = declared_effects(config, setup)
    for _, effect in declared:
        model = model.with_effect(effect)
    if config.cable.mass is None:
        model = model.with_effect(UNKNOWN_MASS())
    tolerances = Tolerances(**setup.tolerances)
    if not known:
        model = nuisances(model, tolerances, pixel, setup.readings)
    start, free = model.nominal.copy(), list(model.names)
    for item, effect in declared:
        for name, parameter in item.parameters.items():
            start[model.names.index(f"{effect.label}.{name}")] = parameter.value
            if parameter.fixed:
                free.remove(f"{effect.label}.{name}")
    return Declared(model, start, free, tolerances)


def straight(model: CableModel) -> CableModel:
    """Return the model without rest curvature and without effects."""
    return replace(model, cable=replace(model.cable, straight=True), effects=(), priors={})


def fit_declared(config: Config, declared: Declared, measured: Sequence[MeasuredPose]) -> Fit:
    """Fit the declared model on a mesh that is fine enough, or on the declared one.

    The mesh is refined first because a coarse mesh looks like a missing effect.
    """
    finest, first = config.model.n, first_mesh(declared.model)
    model = declared.model.with_mesh(min(finest or first, first))
    measurement = config.experiment.measurement

    def fitted(model: CableModel) -> Fit:
        fit = fit_model(
            model,
            measured,
            declared.tolerances,
            measurement.std,
            free=declared.free,
            values=declared.start,
            readings=first_reading_noise(model, measurement.force_std, measurement.moment_std),
        )
        return refine_mesh(fit, finest) if finest else fine_enough(fit, first)

    shown = any(item.has_points for item in measured)
    if shown and model.may_spin and not model.cable.straight:
        # A cable that may roll turns its rest curvature into the plane in which it is bent, however
        # small that is: shapes depend on its size, with a cusp at zero, where a fit goes astray.
        with suppress(EstimationError):
            fit = fitted(replace(model, cable=replace(model.cable, straight=True)))
            noise = structure_of(fit, noise_degrees(fit)).p_noise
            # What differs from pose to pose may be a rest curvature, turned another way in each.
            known = fit.noise.source != "misfit" and not fit.scatters
            if known and noise >= config.diagnosis.significance:
                return fit
    return fitted(model)


def first_mesh(model: CableModel) -> int:
    """Number of elements on which stiffnesses and shapes are searched for.

    Cables bend sharply at saddles and eyelets: for a cable in space with one of each, the true
    parameters leave twice the residual on 10 elements as on 20. Contact with an obstacle starts
    and ends at nodes.
    """
    more = sum(kind.direction or kind.slides for kind in model.clips) + 2 * bool(model.surfaces)
    return FIRST_MESH // len(model.node.curvatures) * (2 + more) // 2


class Minimum(NamedTuple):
    """Minimum of the batch NLP found by IPOPT, and its time [s].

    None where IPOPT fails, or ends where a pose has no stable equilibrium. In space it is not
    `searched` for: third derivatives of all elements would take IPOPT minutes per run.
    """

    point: Point | None = None
    seconds: float = 0.0
    searched: bool = True


def minimum_by_ipopt(fit: Fit) -> Minimum:
    """IPOPT's minimum, started at the Gauss-Newton fit; none in space or with supports between."""
    if fit.model.in_space or fit.model.clips or fit.model.surfaces:
        return Minimum(searched=False)
    began = time.perf_counter()
    try:
        found = solve_batch(fit.problem, fit.point)[0]
        stable = replace(fit, point=found).stable.all()  # IPOPT does not ask for it
        point = found if stable else fit.problem.balanced(found)
    except EstimationError:
        point = None
    return Minimum(point, time.perf_counter() - began)


def confirmed(fit: Fit, found: Minimum) -> Fit:
    """The fit, compared with IPOPT's minimum.

    IPOPT's minimum replaces the fit where it is lower by more than the descent's tolerance. Where
    both agree, the fit counts as converged; where IPOPT fails, it does not. In space, with clips,
    and where IPOPT ends higher, the fit stays as it is.

    A held-out pose has no points that would keep it in its equilibrium, and the next poses depend
    on it if the cable takes a set. Where IPOPT has moved such a pose to another equilibrium, its
    unknowns are used with the fit's equilibria: a drift between clamps had its EI 65 % off.
    """
    point, own = found.point, fit.point.objective
    if not found.searched:
        return fit
    if point is None:
        return replace(fit, converged=False)
    if _moves_others(fit, point):
        followed = fit.problem.balanced(replace(point, shapes=fit.point.shapes))
        point = None if followed is None else descend(Fit(fit.problem, followed)).point
        if point is None or _moves_others(fit, point):
            return fit
    if point.objective < own - least_decrease(fit.problem, fit.point):
        return Fit(fit.problem, point, converged=True)
    same = point.objective <= own + SAME_MINIMUM * abs(own)
    return replace(fit, converged=True) if same and not fit.converged else fit


def _moves_others(fit: Fit, point: Point) -> bool:
    """Whether a pose that is not fitted has another shape at a point than in a fit."""
    others = set(range(fit.problem.equilibria.m)) - set(fit.problem.used)
    own, x = fit.point.shapes.x, point.shapes.x
    return not all(fit.model.node.same(own[j], x[j], NEARBY) for j in others)


@dataclass(frozen=True)
class SimplerFits:
    """Simpler fits of the same cable: straight at rest and without effects.

    Parameters
    ----------
    model : CableModel
        On the mesh on which the stiffness was searched for.
    alone : StiffnessFit
        Fit of the stiffness only.
    loop : Algorithm1Result, optional
        Result of the paper's loop.
    missing : str
        Why the loop did not run.
    seconds : float [s]
        Duration.
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
) -> SimplerFits:
    """The simpler fits, on a mesh of at most n elements."""
    # One number of a simplified model: a coarse mesh suffices.
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
    return SimplerFits(model, alone, loop, missing, seconds)


def _not_applicable(
    options: EstimationOptions, model: CableModel, measured: Sequence[MeasuredPose]
) -> str:
    """Why the paper's loop cannot run; empty if it can."""
    if not options.algorithm1:
        return "switched off"
    if not applies(model):
        return "the paper's loop needs a plane and two pinned ends, without clips or obstacles"
    used = [item for item in measured if item.readable and not item.held_out]
    if not all(item.has_points for item in used):
        return "the paper's loop needs lines along the cable, not readings alone"
    sensors = [sensor for item in measured for sensor in item.sensors]
    if any(sensor.marked and sensor.per_point for sensor in sensors):
        return "the paper's loop needs lines along the cable, not single markers"
    return ""


def not_worse(fit: Fit, stages: Sequence[Stage]) -> Fit:
    """Return the fit, or a better one that starts from a simpler fit.

    A simpler fit is used as a start where its objective is smaller, where it predicts the fit poses
    better, or where the fit has not converged. `stages`: simpler ones first, the fit's own last.
    """
    *others, own = stages
    best = fit
    for stage in others:
        if stage.name in SIMPLER:
            better = not fit.converged or _off(stage) < _off(own)
            # A descent that seems to end above twice the objective will not end below it.
            for found in _from_simpler(fit, stage, better, 2 * fit.point.objective)[1:]:
                if found.point.objective <= fit.point.objective - CONVERGED:
                    found = found if fit.noise.source == "misfit" else refine(found)
                    best = max(best, found, key=lambda item: item.log_evidence)
    return best


def nearest_to_poses(
    fit: Fit, stages: Sequence[Stage], staged: Callable[[Fit], Stage], *, diagnosed: bool
) -> tuple[Fit, Stage]:
    """Return a fit and its stage; if the model is incomplete, the fit nearest to the fit poses.

    A fit that trusts each point to its noise distorts ends and rest shape to make up for a missing
    effect, and may predict worse than a straight cable. It is then repeated with a noise that
    includes the misfit, from itself and from each simpler fit; the best prediction wins. At an edge
    of stability all may predict worse: then the declared model at the simpler fit itself does.
    `stages`: as in `not_worse`. `staged`: makes the stage of a fit. `diagnosed`: a diagnosis
    follows, after which a complete model is reported whatever is nearest here.
    """
    *others, own = stages
    simpler = [stage for stage in others if stage.name in SIMPLER]
    least = min(map(_off, simpler), default=np.inf)
    if explains(fit):
        if not fit.problem.priors.pose_scatter.std:
            return fit, own
        # By more than chance, where the whole residual may be scatter from pose to pose.
        least *= 1.0 if diagnosed else 1 + 1 / np.sqrt(2 * len(fit.problem.used))
    if _off(own) <= least:
        return fit, own
    found, first = [], fit
    if fit.noise.source != "misfit":
        try:
            first = fit_to_misfit(fit)
        except EstimationError:  # a pose has no equilibrium without what is random in each
            return fit, own
        found = [first]
    found += [other for stage in simpler for other in _from_simpler(first, stage, True)]
    return min([(fit, own), *((x, staged(x)) for x in found)], key=lambda pair: _off(pair[1]))


def _off(stage: Stage) -> float:
    """Error [m] of the fit poses, each compared on the branch on which it was measured."""
    error = stage.rmse_fit_measured_branch
    return np.inf if error is None else error


def _from_simpler(fit: Fit, simpler: Stage, better: bool, ceiling: float = np.inf) -> list[Fit]:
    """A straight cable with a stage's stiffness, and the fit that starts there.

    Empty if some pose has no equilibrium with it. Unless that cable is `better`, its objective must
    be below the fit's. `ceiling`: see `descend`.
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
        return []
    found = [Fit(problem, point)]
    share = MISFIT_GAIN if fit.noise.source == "misfit" else 0.0
    with suppress(EstimationError):  # at a fold of its equilibria
        found.append(descend(found[0], ceiling=ceiling, share=share))
    return found
