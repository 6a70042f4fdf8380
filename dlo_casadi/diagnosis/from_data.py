"""Candidates tried at the measured shapes, where the declared model's equilibria lead astray.

The fit begins with the balance of forces relaxed, which needs no equilibrium, see
`estimation.relaxation`. The imbalance tells which effect is missing: with each likely candidate the
fit begins at the measured shapes again, until the balance is nearly strict, and what is left then
tells how near the candidate comes. Where none comes near alone, each is tried beside a second one,
screened anew beside the first.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from dlo_casadi.diagnosis.candidates import Candidate, candidates_of
from dlo_casadi.diagnosis.screening import RelaxedScreen, Screened, in_order
from dlo_casadi.estimation.continuation import loosely_relaxed, relaxed, with_springs_in_place
from dlo_casadi.estimation.fit import FIRST_STD
from dlo_casadi.estimation.problem import Priors, Problem, Values
from dlo_casadi.estimation.relaxation import SOFTNESS, Relaxation
from dlo_casadi.estimation.result import Fit
from dlo_casadi.estimation.start import begin, fit_from, measured_shapes, retry_outlying_poses
from dlo_casadi.estimation.unknowns import SearchSettings, Unknowns
from dlo_casadi.model.cable_model import END_ROLL, CableModel
from dlo_casadi.runtime.parallel import map_in_order
from dlo_casadi.sensing.noise import NoiseModel
from dlo_casadi.thresholds import NEAR_LEADER, REFITTED

# Softness [rad] at which candidates may be scored; largest sum of squares per residual at which the
# relaxed shapes still count as the measured ones.
SCORED, MEASURED = (1e-1, 3e-2, 1e-2), 2.0
# Softness [rad] through which candidates are relaxed before they are compared, and what one may
# leave there of the objective, relative to the one that leaves least. In two sessions in space the
# hidden effect left 3105 and 8250, its only rival 8051, and all others 27800 and more. If the least
# is noise, differences are those of log likelihoods, twice: a tenth of hundreds is beyond doubt.
COMPARED, NEAR_LEAST, NEAR_NOISE = SOFTNESS[:4], 3.0, 1.1
# Largest sum of squares per residual at which a start counts as having reached the noise; of a
# strict balance, relative to that of shapes that need not balance.
REACHED = 1.5
# Candidates beside each of which a second one is tried, and number of second ones: of a drift and a
# force hidden together the drift left second least, and the force scored highest beside it.
FIRST, SECOND = 3, 3
# Bending stiffnesses from which a contact is tried, in weights times the length squared: from where
# a weight bends cables much on, down to chains.
STIFFNESSES_OF_CONTACT = (1e-1, 1e-2, 1e-3)


def from_data(base: Fit) -> tuple[Fit, float]:
    """A base that lacks something, relaxed at the measured shapes; no equilibrium.

    At its known noise, or that of the shapes alone, on the mesh of a search, or a finer one where
    points are better known than that can follow, and from nominal parameters: those of the base
    fit what it lacks. Its softness [rad] is the least of SCORED at which the shapes are still those
    measured.
    """
    model = base.model
    mesh = max(SearchSettings.of(model).mesh, model.coarse.n)
    near, softness = _from_data_on(base, min(mesh, model.n))
    followed = near.point.data < near.problem.n_residuals
    if base.noise.source == "misfit" and near.noise.source == "declared" and not followed:
        return _from_data_on(base, 3 * mesh // 2)
    return near, softness


def _from_data_on(base: Fit, mesh: int) -> tuple[Fit, float]:
    """As `from_data`, on a mesh."""
    alone = replace(NoiseModel(FIRST_STD), readings=base.noise.readings)
    model = base.model.with_mesh(mesh)
    known: NoiseModel = base.noise.before or (base.noise if base.noise.known else alone)
    problem = replace(_beside(base, model), noise=known, weights=None)
    p = np.where(problem.unknowns.free, model.nominal, problem.unknowns.fixed)
    start = problem.unknowns.pack(p, np.zeros(model.n_coefficients))
    problem, values = begin(problem, start)
    best = None
    for softness in SCORED:
        values = Relaxation(problem, softness).solve(values)
        near = Fit(problem, problem.evaluate(values))
        if best is not None and near.point.data > MEASURED * problem.n_residuals:
            break
        best = near, softness
    assert best is not None
    return best


def _beside(base: Fit, model: CableModel) -> Problem:
    """The problem of a model beside a base, at its noise and with priors that know no scatter."""
    unknowns = Unknowns(model, base.free_in(model), base.values_in(model))
    priors = Priors.of(base.problem.priors.tolerances, model)
    return replace(base.problem, unknowns=unknowns, priors=priors)


def screened_from_data(near: Fit, softness: float, listed: Sequence[Candidate]) -> list[Screened]:
    """Score tests in a relaxed model, best first.

    Of those without derivative where they vanish a soft balance tells less than a fit does: last,
    without a score.
    """
    gradual = [x for x in listed if x.effect.gradual]
    found = RelaxedScreen(near, gradual, softness).run(np.inf) if gradual else []
    others = (x for x in listed if not x.effect.gradual)
    return [*in_order(found), *(Screened(x, 0.0, 1.0, dict(x.scans[0])) for x in others)]


@dataclass(frozen=True)
class RelaxedStart:
    """A candidate beside a relaxed fit, its balance nearly strict: no equilibrium yet.

    Parameters
    ----------
    near : Fit
        Relaxed, without the candidate.
    begun, values : Values
        Before and after.
    left : float
        Twice the objective.
    beside : tuple of Screened
        Candidates that `near` has, too.
    """

    near: Fit
    screened: Screened
    problem: Problem
    begun: Values
    values: Values
    left: float
    beside: tuple[Screened, ...] = ()

    @classmethod
    def of(cls, near: Fit, screened: Screened, beside: tuple[Screened, ...] = ()) -> RelaxedStart:
        """From the measured shapes; of a contact also from some stiffnesses, what leaves least.

        The stiffer a cable the less a soft balance tells of what pushes it up: with a contact
        there is no way back from a stiffness that has run up a hundredfold.
        """
        known: list[dict[str, float]] = [{}]
        if not screened.candidate.effect.gradual:
            known += _stiffnesses(near.model)
        begun = [cls._followed(near, screened, beside, values) for values in known]
        return min(begun, key=lambda x: x.left)

    @classmethod
    def _followed(
        cls,
        near: Fit,
        screened: Screened,
        beside: tuple[Screened, ...],
        known: Mapping[str, float],
        *,
        rolls: bool = False,
    ) -> RelaxedStart:
        """From the measured shapes and what is known, the candidate not there yet.

        In parameters in which it is linear: an anchor is nowhere while its tether does not pull.
        Relaxed shapes and their parameters stand for what the model without it lacks.
        """
        candidate = screened.candidate
        scan = {k: v for k, v in screened.start.items() if k in candidate.scans[0]}
        others = {name: near.value(name) for x in beside for name in x.candidate.frees}
        values = {**others, **scan, **known}
        linear, begun = _as_measured(near, candidate.add_linear_to(near.model), values)
        # Where and which way it acts stays where its score is largest until it acts: before, a step
        # of these leads anywhere.
        fixed = np.isin(linear.unknowns.names, list(candidate.scans[0]))
        if rolls:
            linear, begun = begin(linear, begun.theta, fixed)
        reached = loosely_relaxed(linear, begun, fixed)
        reached = relaxed(linear, reached, COMPARED[1:-1])
        problem, reached = _in_own_parameters(near, candidate, linear, reached)
        reached = relaxed(problem, reached, COMPARED[-1:])
        reached = retry_outlying_poses(problem, begun, reached, COMPARED[-1])
        left = Relaxation(problem, COMPARED[-1]).objective(reached)
        return cls(near, screened, problem, begun, reached, left, beside)

    @property
    def names(self) -> set[str]:
        """Names of its candidates."""
        return {x.candidate.name for x in (*self.beside, self.screened)}

    def and_second(
        self, softness: float, center: tuple[float, float] | None, exclude: Sequence[str]
    ) -> list[RelaxedStart]:
        """Starts of the likely candidates beside this one, screened at a softness."""
        values = relaxed(self.problem, self.values, (softness,))
        near = Fit(self.problem, self.problem.evaluate(values))
        listed = candidates_of(near, center, exclude)
        likely = likeliest(screened_from_data(near, softness, listed))[:SECOND]
        return [RelaxedStart.of(near, x, (*self.beside, self.screened)) for x in likely]

    def fit(self) -> Fit | None:
        """The fit that it leads to; None if some pose has no equilibrium there."""
        left = SOFTNESS[len(COMPARED) :]
        return fit_from(self.problem, self.begun, left, followed=self.values)

    def rolled(self) -> RelaxedStart | None:
        """The same with the end rolled anew; None where lines tell how it is turned.

        The relaxed shapes without the candidate may be turned otherwise.
        """
        if END_ROLL not in self.problem.unknowns.names:
            return None
        return self._followed(self.near, self.screened, self.beside, {}, rolls=True)


def likeliest(screened: Sequence[Screened]) -> list[Screened]:
    """Candidates whose score at the measured shapes comes near the leading one."""
    scored = [x for x in screened if x.candidate.effect.gradual]
    return [x for x in scored if x.score >= NEAR_LEADER * scored[0].score][:REFITTED]


def nearest(
    near: Fit,
    softness: float,
    likely: Sequence[Screened],
    executor: Executor,
    center: tuple[float, float] | None = None,
    exclude: Sequence[str] = (),
    *,
    pairs: bool = True,
    least: float = np.inf,
) -> list[RelaxedStart]:
    """Starts that leave little more than the one that leaves least, nearest first.

    Of the candidates, beside another start that leaves `least`; where none of these comes to the
    noise that the relaxed shapes have, of two together if `pairs` may be added and REACHED times
    what they leave is less.
    """
    noise = REACHED * near.point.data
    alone = map_in_order(executor, partial(RelaxedStart.of, near), likely)
    begun = _near_least(alone, noise, least)
    if not pairs or not begun or begun[0].left < noise:
        return begun
    second = partial(RelaxedStart.and_second, softness=softness, center=center, exclude=exclude)
    both = [x for found in map_in_order(executor, second, begun[:FIRST]) for x in found]
    own = {frozenset(x.names): x for x in sorted(both, key=lambda x: -x.left)}
    kept = _near_least(own.values(), noise)
    return kept if kept and REACHED * kept[0].left < begun[0].left else begun


def _near_least(
    begun: Iterable[RelaxedStart], noise: float, least: float = np.inf
) -> list[RelaxedStart]:
    """Those that leave little more than the one that leaves least, nearest first."""
    ordered = sorted(begun, key=lambda x: x.left)
    least = min([least, *(x.left for x in ordered[:1])])
    most = least * (NEAR_NOISE if least < noise else NEAR_LEAST)
    return [start for start in ordered if start.left <= most]


def _as_measured(
    near: Fit, model: CableModel, known: Mapping[str, float]
) -> tuple[Problem, Values]:
    """A model at the measured shapes, with parameters that are known, others nominal.

    The shapes are rolled in their end clamps as the relaxed ones.
    """
    problem = _beside(near, model)
    names, free = model.names, problem.unknowns.free
    known = {**known, **({END_ROLL: near.value(END_ROLL)} if END_ROLL in names else {})}
    p = np.where(free, model.nominal, problem.unknowns.fixed)
    for name, value in known.items():
        k = names.index(name)
        p[k] = value if free[k] else p[k]
    theta = problem.unknowns.pack(p, np.zeros(model.n_coefficients))
    theta = problem.unknowns.off_bounds(theta)
    found = Values(theta, *measured_shapes(problem, known.get(END_ROLL, 0.0)))
    return problem, with_springs_in_place(problem, found)


def _stiffnesses(model: CableModel) -> list[dict[str, float]]:
    """Parameters by name for each of STIFFNESSES_OF_CONTACT, in their declared ratio."""
    typical = model.cable.mass * float(np.linalg.norm(model.gravity)) * model.cable.length**2
    own = model.nominal[model.stiffness_indices]
    names = [model.names[k] for k in model.stiffness_indices]
    return [
        dict(zip(names, (size * typical / own[0] * own).tolist(), strict=True))
        for size in STIFFNESSES_OF_CONTACT
    ]


def _in_own_parameters(
    near: Fit, candidate: Candidate, linear: Problem, values: Values
) -> tuple[Problem, Values]:
    """Relaxed values of parameters in which a candidate is linear, in its own parameters."""
    before, model = linear.unknowns.model, candidate.add_to(near.model)
    if before == model:
        return linear, values
    known = dict(zip(before.names, linear.unknowns.p(values.theta).tolist(), strict=True))
    prefix = f"{candidate.effect.label}."
    part = {name: value for name, value in known.items() if name.startswith(prefix)}
    known |= candidate.of_linear(model.cable, part)
    problem, rest = _beside(near, model), linear.unknowns.coefficients(values.theta)
    p = np.array([known[name] for name in model.names])
    return problem, replace(values, theta=problem.unknowns.pack(p, rest))
