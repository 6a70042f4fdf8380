"""Candidates tried at the measured shapes, for when the declared model's equilibria mislead.

The fit starts with a relaxed balance of forces, which needs no equilibrium, see
`estimation.relaxation`. The imbalance shows which effects are missing: with each likely subset of
candidates the fit starts again at the measured shapes and continues until the balance is nearly
strict; what is left then measures how well they fit.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from dlo_casadi.diagnosis.gram import Screened
from dlo_casadi.estimation.fit import EXPLAINED, FIRST_STD
from dlo_casadi.estimation.measured_shapes import measured_shapes
from dlo_casadi.estimation.problem import Priors, Problem
from dlo_casadi.estimation.relaxation import SOFTNESS, Relaxation
from dlo_casadi.estimation.result import Fit
from dlo_casadi.estimation.start import (
    SearchSettings,
    begin,
    fit_from,
    loosely_relaxed,
    relaxed,
    retry_outlying_poses,
    with_springs_in_place,
)
from dlo_casadi.estimation.unknowns import Values
from dlo_casadi.model.cable_model import END_ROLL, CableModel
from dlo_casadi.runtime.work import accounted_as
from dlo_casadi.sensing.noise import NoiseModel

# Softness [rad] at which candidates may be scored; largest sum of squares per residual at which
# relaxed shapes still count as the measured ones.
SCORED, MEASURED = (1e-1, 3e-2, 1e-2), 2.0
# Softness [rad] through which candidates are relaxed before they are compared; largest objective of
# a candidate relative to the least one where that is noise: differences are then twice those of log
# likelihoods, a tenth of hundreds is beyond doubt. A soft balance is less informative for a
# contact, but hidden tables left least in five sessions, and in eight 1.2 to 1.9 times what shapes
# leave that need not balance; in three sessions without a table, a contact left 5 to 22 times the
# least.
COMPARED, NEAR_NOISE = SOFTNESS[:4], 1.1
# Sum of squares per residual that most poses leave, above which no pose is tried again: not a pose,
# but the candidate is wrong. In a session in space seven of thirteen such starts gained by a second
# trial of outlying poses, but none came below 20 times the noise, and it took half of the time.
WRONG = 10.0
# Trial bending stiffnesses for a contact, in weights times length squared: from cables that their
# weight hardly bends down to chains.
STIFFNESSES_OF_CONTACT = (1e-1, 1e-2, 1e-3)
# Two such trials whose log stiffnesses differ by less are at the same minimum: in six sessions in
# space they differed by 0.08 at most, or by 0.5 and more.
SAME_STIFFNESS = 0.1


@accounted_as("relaxed model")
def from_data(base: Fit) -> tuple[Fit, float]:
    """Relax an incomplete base at the measured shapes; the result is no equilibrium.

    The noise is the base's if known, else it follows from the shapes. The mesh is that of a search,
    or finer if it cannot follow very accurate points. Parameters start at nominal values, since
    those of the base are distorted by what it lacks. The softness [rad] is the least of SCORED at
    which the shapes are still the measured ones.
    """
    model = base.model
    mesh = max(SearchSettings.of(model).mesh, model.coarse.n)
    near, softness = _from_data_on(base, min(mesh, model.n))
    followed = near.point.data < near.problem.n_residuals
    if base.noise.source == "misfit" and near.noise.source == "declared" and not followed:
        return _from_data_on(base, 3 * mesh // 2)
    return near, softness


def _from_data_on(base: Fit, mesh: int) -> tuple[Fit, float]:
    """As `from_data`, on a given mesh."""
    alone = replace(NoiseModel(FIRST_STD), readings=base.noise.readings)
    model = base.model.with_mesh(mesh)
    known: NoiseModel = base.noise.before or (base.noise if base.noise.known else alone)
    problem = replace(_beside(base, model), noise=known, weights=None)
    unknowns = problem.unknowns
    # Shapes then start as those of the first fit do, and are found again.
    unknowns = replace(unknowns, fixed=np.where(unknowns.free, model.nominal, unknowns.fixed))
    start = unknowns.pack(unknowns.fixed, np.zeros(model.n_coefficients))
    problem, values = begin(replace(problem, unknowns=unknowns), start)
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
    """The problem of another model, with a base's noise and with priors without any scatter."""
    return replace(base.problem_in(model), priors=priors_without_scatter(base, model))


def priors_without_scatter(base: Fit, model: CableModel) -> Priors:
    """Priors of a model as if nothing differed at random; a single pose's ends do not differ."""
    known = base.problem.priors
    priors = Priors.of(known.tolerances, model)
    return replace(priors, scatter=known.scatter) if len(base.problem.used) == 1 else priors


def expected_left(near: Fit) -> float:
    """Twice the objective that a relaxed fit's shapes should leave if its model lacks nothing."""
    left = near.point.data
    # Very soft shapes leave less than a known noise.
    return max(left, near.problem.n_residuals) if near.problem.noise.known else left


def left_without(near: Fit) -> float:
    """Twice the objective of a relaxed fit, without a candidate, in a nearly strict balance."""
    values = relaxed(near.problem, near.point, COMPARED[1:])
    return Relaxation(near.problem, COMPARED[-1]).objective(values)


@dataclass(frozen=True)
class RelaxedStart:
    """Candidates added to a relaxed fit, with a nearly strict balance: no equilibrium yet.

    Parameters
    ----------
    near : Fit
        The relaxed fit without the candidates.
    each : tuple of Screened
        The candidates.
    begun, values : Values
        Values before and after the relaxation.
    left : float
        Twice the objective; infinite while the balance is still soft.
    stuck : bool
        Whether no step changed its unknowns as the balance hardened.
    """

    near: Fit
    each: tuple[Screened, ...]
    problem: Problem
    begun: Values
    values: Values
    left: float = np.inf
    stuck: bool = False

    @classmethod
    def of(cls, near: Fit, each: tuple[Screened, ...]) -> RelaxedStart:
        """Best start from the measured shapes; for a contact also from several stiffnesses.

        The stiffer a cable, the less a soft balance shows what pushes it up: with a contact, a
        stiffness that has grown a hundredfold never returns. Trials that reach the same minimum are
        followed once. If no step lowers the objective as the balance hardens, the candidates are
        also tried at the next places: the objective has a kink where a stiff section ends at a node
        of the mesh, and any step of its ends upsets the balance.
        """
        gradual = all(x.candidate.effect.gradual for x in each)
        known = [{}] if gradual else [{}, *_stiffnesses(near)]
        apart: list[RelaxedStart] = []
        for values in known:
            loose = cls._loose(near, each, values)
            if not any(loose._like(other) for other in apart):
                apart.append(loose)
        begun = [x._strict() for x in apart]
        if gradual and begun[0].stuck:
            begun += [cls._loose(near, other, {})._strict() for other in _at_next_places(each)]
        return min(begun, key=lambda x: x.left)._retried()

    @classmethod
    def _loose(
        cls,
        near: Fit,
        each: tuple[Screened, ...],
        known: Mapping[str, float],
        *,
        rolls: bool = False,
    ) -> RelaxedStart:
        """Relax from the measured shapes and known values, with the candidates initially absent.

        Uses the parameters in which a candidate is linear: a tether without force has no anchor.
        The relaxed shapes and parameters of `near` are distorted by what that model lacks. The
        balance is still soft.
        """
        scans = {k: v for x in each for k, v in x.start.items() if k in x.candidate.scans[0]}
        model = near.model
        for x in each:
            model = x.candidate.add_linear_to(model)
        linear, begun = _as_measured(near, model, {**scans, **known})
        # Keep place and direction of an effect where its score is largest until it acts: before, a
        # step in them leads anywhere.
        fixed = np.isin(linear.unknowns.names, list(scans))
        if rolls:
            linear, begun = begin(linear, begun.theta, fixed)
        return cls(near, each, linear, begun, loosely_relaxed(linear, begun, fixed))

    def _like(self, other: RelaxedStart) -> bool:
        """Whether both have nearly the same stiffnesses, so that they lead to the same minimum."""
        stiff = self.problem.unknowns.model.stiffness_indices
        own, its = (x.problem.unknowns.p(x.values.theta)[stiff] for x in (self, other))
        return bool(np.abs(np.log(own / its)).max() < SAME_STIFFNESS)

    def _strict(self) -> RelaxedStart:
        """Follow a loosely relaxed start to a nearly strict balance, in its own parameters."""
        reached = relaxed(self.problem, self.values, COMPARED[1:-1])
        stuck = np.array_equal(reached.theta, self.values.theta)
        problem, reached = _in_own_parameters(self.near, self.each, self.problem, reached)
        found = self._at(problem, relaxed(problem, reached, COMPARED[-1:]))
        return replace(found, stuck=stuck)

    def _retried(self) -> RelaxedStart:
        """The start with other shapes tried for outlying poses."""
        tried = (self.problem, self.begun, self.values, COMPARED[-1])
        return self._at(self.problem, retry_outlying_poses(*tried, typical=WRONG))

    def _at(self, problem: Problem, values: Values) -> RelaxedStart:
        """The start at other values, in a nearly strict balance."""
        left = Relaxation(problem, COMPARED[-1]).objective(values)
        return replace(self, problem=problem, values=values, left=left)

    @property
    def reached(self) -> bool:
        """Whether it leaves no more than the noise that the relaxed shapes of `near` show."""
        return self.left < EXPLAINED * expected_left(self.near)

    @property
    def names(self) -> set[str]:
        """Names of its candidates."""
        return {x.candidate.name for x in self.each}

    def fit(self) -> Fit | None:
        """Fit reached from this start; None if some pose has no equilibrium there."""
        left = SOFTNESS[len(COMPARED) :]
        return fit_from(self.problem, self.begun, left, followed=self.values)

    def rolled(self) -> RelaxedStart | None:
        """The same start with the end roll searched again; None if the lines determine it.

        The roll of the relaxed shapes without the candidate may be wrong.
        """
        if END_ROLL not in self.problem.unknowns.names:
            return None
        loose = self._loose(self.near, self.each, {}, rolls=True)
        return loose._strict()._retried()


def _at_next_places(each: tuple[Screened, ...]) -> list[tuple[Screened, ...]]:
    """Candidates with one of them at the scan before or after its own."""
    found = []
    for i, x in enumerate(each):
        for k in (x.scan - 1, x.scan + 1):
            if 0 <= k < len(x.candidate.scans):
                other = replace(x, start={**x.start, **x.candidate.scans[k]}, scan=k)
                found.append((*each[:i], other, *each[i + 1 :]))
    return found


def _as_measured(
    near: Fit, model: CableModel, known: Mapping[str, float]
) -> tuple[Problem, Values]:
    """A model at the measured shapes, with known parameters where given and others nominal.

    The shapes have the end roll of the relaxed ones.
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


def _stiffnesses(near: Fit) -> list[dict[str, float]]:
    """Stiffnesses by name for each of STIFFNESSES_OF_CONTACT, in their declared ratio.

    Empty if the stiffnesses are not estimated.
    """
    model = near.model
    if not near.problem.unknowns.free[model.stiffness_indices].any():
        return []
    typical = model.cable.mass * float(np.linalg.norm(model.gravity)) * model.cable.length**2
    own = model.nominal[model.stiffness_indices]
    names = [model.names[k] for k in model.stiffness_indices]
    return [
        dict(zip(names, (size * typical / own[0] * own).tolist(), strict=True))
        for size in STIFFNESSES_OF_CONTACT
    ]


def _in_own_parameters(
    near: Fit, each: Sequence[Screened], linear: Problem, values: Values
) -> tuple[Problem, Values]:
    """Convert relaxed values from the candidates' linear parameters to their own ones."""
    before, model = linear.unknowns.model, near.model
    for x in each:
        model = x.candidate.add_to(model)
    if before == model:
        return linear, values
    known = dict(zip(before.names, linear.unknowns.p(values.theta).tolist(), strict=True))
    for x in each:
        prefix = f"{x.candidate.effect.label}."
        part = {name: value for name, value in known.items() if name.startswith(prefix)}
        known |= x.candidate.of_linear(model.cable, part)
    problem, rest = _beside(near, model), linear.unknowns.coefficients(values.theta)
    p = np.array([known[name] for name in model.names])
    return problem, replace(values, theta=problem.unknowns.pack(p, rest))
