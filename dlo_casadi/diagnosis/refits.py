"""From a candidate to a fit with it: where it starts, the refit, and how it compares.

A refit starts from the candidate's one-step estimate at the minimum without it. If the shapes there
are too far from the measured ones to follow any effect, there are two other starts.

One is an unknown force that fits the shapes: a force f_j in every pose at one place r_j of the
cable. A load is its cause if the load's own law gives these forces. Once the place is known, all
loads are linear in their parameters (a tether in k and k a: f = k a - k r), and least squares give
the start. The other start is at the measured shapes, see `diagnosis.near_data`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from concurrent.futures import Executor
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import partial

import casadi as ca
import numpy as np

from dlo_casadi.diagnosis.candidates import Candidate, of_linear
from dlo_casadi.diagnosis.crossval import CrossValidation, cross_validate
from dlo_casadi.diagnosis.from_data import (
    NEAR_NOISE,
    RelaxedStart,
    from_data,
    left_without,
    priors_without_scatter,
)
from dlo_casadi.diagnosis.gram import Gram, Screened, in_order, survival
from dlo_casadi.diagnosis.screening import Screen
from dlo_casadi.diagnosis.unknown_force import UnknownForce, places_in, start_from
from dlo_casadi.effects import PointLoad
from dlo_casadi.errors import EstimationError
from dlo_casadi.estimation.descent import NEARLY, descend, refit
from dlo_casadi.estimation.fit import explains, misfits
from dlo_casadi.estimation.result import Fit
from dlo_casadi.estimation.variances import refine
from dlo_casadi.model.cable_model import CableModel
from dlo_casadi.runtime.parallel import map_in_order
from dlo_casadi.sensing.noise import NoiseModel
from dlo_casadi.thresholds import EVIDENCE_APART

# Shares of the one-step estimate from which a refit is tried, in this order, until one gains.
SHARES = (1.0, 0.5, 0.2, 0.05)
# A refit is given up if its minimum is predicted above that of a known one by more than this (ten
# times the log likelihood by which a rival may fall short) and by more than the known minimum.
GIVEN_UP = 10 * EVIDENCE_APART


@dataclass(frozen=True)
class Confirmed:
    """A candidate refitted with all parameters free.

    Parameters
    ----------
    validation : CrossValidation or None
        Of left-out poses; None if it has no more evidence than its base, and so is refused anyway.
    gain : float
        Decrease of twice the objective.
    beside : tuple of Screened
        Other candidates that the fit has and its base lacks.
    settled : bool
        Whether its noise was estimated with the candidates in the model.
    """

    screened: Screened
    fit: Fit
    validation: CrossValidation | None
    gain: float
    beside: tuple[Screened, ...] = ()
    settled: bool = False

    @classmethod
    def of(
        cls, screened: Screened, base: Fit, fit: Fit | None, beside: tuple[Screened, ...] = ()
    ) -> Confirmed | None:
        """Compare the fit with a candidate, if there is one, with its base.

        A fit that explains its points but has not converged is continued: otherwise each fit
        without one of its poses would have to do that.
        """
        if fit is None:
            return None
        if explains(fit) and not fit.converged:
            fit = descend(fit, tolerance=NEARLY)
        gain = 2 * (base.point.objective - fit.point.objective)
        validation = cross_validate(fit) if fit.log_evidence > base.log_evidence else None
        return cls(screened, fit, validation, gain, beside)

    @property
    def candidate(self) -> Candidate:
        """The candidate."""
        return self.screened.candidate

    @property
    def each(self) -> tuple[Screened, ...]:
        """All candidates that the base lacks."""
        return (*self.beside, self.screened)

    @property
    def name(self) -> str:
        """Names of these candidates."""
        return " and ".join(x.candidate.name for x in self.each)

    def beside_others(self) -> list[Confirmed]:
        """One entry per candidate, each with the others beside it."""
        return [
            replace(self, screened=x, beside=tuple(y for y in self.each if y is not x))
            for x in self.each
        ]


@dataclass(frozen=True)
class Tried:
    """Candidates of one step of a search.

    Parameters
    ----------
    screened : list of Screened
        All candidates, best first.
    p_values : dict of float
        Of their scores as the best of all, by name.
    refits : list of Confirmed
        Of the likely ones.
    far : dict of str
        Why likely candidates were not fitted from the measured shapes, by name.
    """

    screened: list[Screened]
    p_values: dict[str, float]
    refits: list[Confirmed]
    far: dict[str, str] = field(default_factory=dict)


def scored(
    base: Fit,
    listed: Sequence[Candidate],
    noise_dof: float,
    significance: float,
    executor: Executor,
) -> tuple[list[Screened], Gram | None]:
    """Score tests of candidates, best first, and their Gram matrix; see `Screen.gram`.

    Contacts also start at the measured shapes if the base leaves more than noise, or if its noise
    is estimated and some score is significant. An estimated noise may hide a contact, but not from
    all other scores: in five sessions with a hidden table the least p-value was below 1e-15, and
    with the table found 0.12 or more.
    """
    gradual = [x for x in listed if x.effect.gradual]
    gram = Screen(base, gradual).gram(noise_dof, executor) if gradual else None
    found = gram.singles if gram else []
    significant = not found or found[0].p_value < significance
    lacks = base.beyond_noise or (significant and not base.noise.known)
    others = (x for x in listed if not x.effect.gradual)
    tested = (scored_by_refit(base, x, noise_dof, from_shapes=lacks) for x in others)
    return in_order([*found, *tested]), gram


def scored_by_refit(
    base: Fit, candidate: Candidate, noise_dof: float, *, from_shapes: bool
) -> Screened:
    """Test a candidate without derivative where it vanishes, by the gain of a refit.

    The refit starts from the base; with `from_shapes` also from the measured shapes, unless the
    contact leaves hardly less than the base in relaxed shapes (less than a tenth).
    """
    start = dict(candidate.scans[0])
    fits = [followed(base, candidate.add_to(base.model), start)]
    if from_shapes:
        near, _ = from_data(base)
        most = left_without(near) / NEAR_NOISE
        if near.point.data < most:  # a start hardly leaves less than shapes that need not balance
            asked = Screened(candidate, 0.0, 1.0, start)
            fits.append(refit_from_shapes(base, near, asked, most))
    best = min((x for x in fits if x), key=lambda x: x.point.objective, default=None)
    if best is None:
        return Screened(candidate, 0.0, 1.0, start)
    gain = max(2 * (base.point.objective - best.point.objective), 0.0)
    start = {name: best.value(name) for name in candidate.frees}
    return Screened(candidate, gain, survival(gain, len(start), noise_dof), start, fit=best)


def refit_from_shapes(base: Fit, near: Fit, screened: Screened, most: float = np.inf) -> Fit | None:
    """Fit with a candidate added, started at the measured shapes, with the base's weights.

    `near`: the base relaxed there, see `from_data`. None if a pose has no equilibrium, or if the
    start leaves `most` or more.
    """
    begun = RelaxedStart.of(near, (screened,))
    fit = begun.fit() if begun.left < most else None
    if fit is None:
        return None
    with suppress(EstimationError):
        same = fit.reweighed(base.noise, base.problem.priors)
        return followed(same, screened.candidate.add_to(base.model), {})
    return None


def confirm(
    base: Fit, screened: Screened, ceiling: float = np.inf, beside: Fit | None = None
) -> Confirmed | None:
    """Refit with a candidate added; None if its equilibria cannot be followed.

    `ceiling`: see `descend`. The refit also starts from the fit `beside` it, which has another
    effect in the candidate's place, with the candidate's one-step estimate and without: lacking
    any, the base's other effects may have moved, and its estimate may have the wrong sign.
    """
    found = screened.fit or refit_with(base, screened, ceiling=ceiling)
    if beside is not None:
        same = beside.weighed_as(base)
        model = screened.candidate.add_to(base.model)
        starts: tuple[Mapping[str, float], ...] = (screened.start, {})
        fits = [found, *(followed(same, model, values, ceiling) for values in starts)]
        found = min((x for x in fits if x), key=lambda x: x.point.objective, default=None)
    return Confirmed.of(screened, base, found)


def confirm_cause(base: Fit, force: UnknownForce, screened: Screened) -> Confirmed | None:
    """Refit the base's model with a load in place of the force; None if it cannot be followed.

    The base has neither of them.
    """
    forces = force.force_per_pose
    values = start_from(force.fit, force.position, forces, screened.candidate)
    fit = followed(force.fit, screened.candidate.add_to(base.model), values)
    if fit is not None and base.noise.before is not None and not misfits(fit):
        fit = at_noise(fit, base.noise.before)
    return Confirmed.of(screened, base, fit)


def ceiling_beside(fit: Fit) -> float:
    """Objective above which another refit of the same data cannot be a rival, see `descend`."""
    return fit.point.objective + max(GIVEN_UP, fit.point.objective)


def at_noise(fit: Fit, noise: NoiseModel) -> Fit:
    """A fit that meets its points, weighed by their noise instead of that of a misfit."""
    return refine(fit.reweighed(noise, priors_without_scatter(fit, fit.model)), first=True)


def followed(
    start: Fit,
    model: CableModel,
    values: Mapping[str, float],
    ceiling: float = np.inf,
) -> Fit | None:
    """Refit of a model with new parameters at these values; None without equilibria.

    New effects are first fitted in parameters without a curved valley, if that succeeds.
    """
    ways = [_in_linear(start, model, values, ceiling), (start, values)]
    for begun, given in ways if ways[0][0] is not start else ways[1:]:
        with suppress(EstimationError):
            return refit(begun, model, values=given, tolerance=NEARLY, ceiling=ceiling)
    return None


def _in_linear(
    start: Fit, model: CableModel, values: Mapping[str, float], ceiling: float
) -> tuple[Fit, Mapping[str, float]]:
    """A fit of new effects in parameters without a curved valley, and their own values there."""
    known, cable = {effect.label for effect in start.model.effects}, model.cable
    for effect in (x for x in model.effects if x.label not in known):
        prefix, each = f"{effect.label}.", effect.parameters(cable)
        given = effect.in_linear({q.name: values.get(prefix + q.name, q.nominal) for q in each})
        if given is None:
            continue
        # Of another label, so that no value of the effect itself is taken from this fit.
        linear = replace(effect.linear(), label=f"{effect.label}_linear")
        own = f"{linear.label}."
        other = replace(model, effects=tuple(linear if x is effect else x for x in model.effects))
        given = {**values, **{own + name: value for name, value in given.items()}}
        try:
            found = refit(start, other, values=given, tolerance=NEARLY, ceiling=ceiling)
        except EstimationError:
            continue
        names = (q.name for q in linear.parameters(cable))
        reached = {name: found.value(own + name) for name in names}
        start, values = found, {**values, **of_linear(effect, cable, reached)}
    return start, values


def refit_with(base: Fit, *each: Screened, ceiling: float = np.inf) -> Fit | None:
    """Fit the model with candidates added, from their one-step estimates."""
    model = base.model
    for x in each:
        model = x.candidate.add_to(model)
    begin = dict(zip(model.names, base.values_in(model), strict=True))
    linear = {name for x in each for name in x.candidate.screened}
    start = {name: value for x in each for name, value in x.start.items()}
    best: Fit | None = None
    for share in SHARES:
        values = {
            name: begin[name] + (share if name in linear else 1.0) * (value - begin[name])
            for name, value in start.items()
        }
        fit = followed(base, model, values, ceiling)
        if fit is not None and (best is None or fit.point.objective < best.point.objective):
            best = fit
        if best is not None and best.point.objective < base.point.objective:
            break
    return best


def confirm_subset(
    base: Fit, each: tuple[Screened, ...], ceiling: float = np.inf
) -> Confirmed | None:
    """Refit with several candidates added at once; None if its equilibria cannot be followed."""
    return Confirmed.of(each[-1], base, refit_with(base, *each, ceiling=ceiling), each[:-1])


def refit_without(fit: Fit, candidate: Candidate, declared: Fit) -> Fit | None:
    """Fit without a candidate; a nuisance is held as declared. None without equilibria.

    Without its set, the poses of a cable that has taken one are far from equilibrium, and the fit
    may end in other equilibria. The declared model has fewer effects: a fit that ends above it is
    not the minimum, and starts again from the declared model's fit. A descent to a minimum that
    leaves twice as much as with the candidate ends early (`ceiling_beside`): that the candidate is
    needed is then beyond doubt, and others that replace it have to do better than it does.
    """
    model, ceiling = candidate.remove_from(fit.model, declared.model), ceiling_beside(fit)
    found = followed(fit, model, {}, ceiling)
    nested = None
    with suppress(EstimationError):
        nested = declared.reweighed(fit.noise, fit.problem.priors)
    if nested and (found is None or found.point.objective > nested.point.objective):
        values = {name: fit.value(name) for name in fit.model.names}
        other = followed(nested, model, values, ceiling)
        both = [x for x in (found, other) if x is not None]
        found = min(both, key=lambda x: x.point.objective, default=None)
    return found


def loads_from_best(
    base: Fit,
    screened: Sequence[Screened],
    tried: Sequence[Confirmed],
    executor: Executor,
) -> list[Confirmed]:
    """Refits; if the likeliest adds a load at one place, other loads also start from its forces.

    `screened`: candidates, of which the loads are tried in place of that load. If a set of effects
    was fitted twice, the fit with the lower objective counts: with the likelier one, which may have
    another noise, the tether of a session in space was lost. From its own start a force was 2.0 mm
    from the left-out poses of a cable with a force, from those of a tether 1.0 mm.
    """
    best = max(tried, key=lambda item: item.fit.log_evidence, default=None)
    load = next((x for x in best.beside_others() if _is_load(x.screened)), None) if best else None
    if best is None or load is None:
        return list(tried)
    present = {x.candidate.effect.label for x in best.each}
    loads = [x for x in screened if _is_load(x) and x.candidate.effect.label not in present]
    again = map_in_order(executor, partial(_confirm_load, base, load), loads)
    found: dict[frozenset[str], Confirmed] = {}
    for item in filter(None, (*tried, *again)):
        names = frozenset(x.candidate.name for x in item.each)
        known = found.setdefault(names, item)
        if item.fit.point.objective < known.fit.point.objective:
            found[names] = item
    return [*found.values()]


def _is_load(screened: Screened) -> bool:
    return isinstance(screened.candidate.effect, PointLoad)


def load_instead(fit: Fit, own: Candidate, other: Candidate) -> dict[str, float]:
    """Parameters of a load with the place and the forces of a fit's own one."""
    model, effect = fit.model, own.effect
    assert isinstance(effect, PointLoad)
    known = {q.name: fit.value(f"{effect.label}.{q.name}") for q in effect.parameters(model.cable)}
    params = {name: ca.SX(value) for name, value in known.items()}
    gravity, position = ca.SX(ca.DM(model.gravity)), effect.place(known)
    at = ca.SX.sym("r", len(model.gravity))
    law = ca.Function("force", [at], [effect.force(at, gravity, params)])
    forces = np.array([np.array(law(place)).ravel() for place in places_in(fit, position)])
    return start_from(fit, position, forces, other)


def _confirm_load(base: Fit, best: Confirmed, screened: Screened) -> Confirmed | None:
    """Refit with a load in place of another one, from its place and forces."""
    values = load_instead(best.fit, best.candidate, screened.candidate)
    without = best.candidate.remove_from(best.fit.model, base.model)
    larger, ceiling = screened.candidate.add_to(without), ceiling_beside(best.fit)
    fit = followed(best.fit, larger, values, ceiling)
    with suppress(EstimationError):
        found = Confirmed.of(screened, base, fit, best.beside)
        if found and found.fit.log_evidence > best.fit.log_evidence - EVIDENCE_APART:
            # It explains as much as the load that was tested.
            p_value = min(screened.p_value, best.screened.p_value)
            found = replace(found, screened=replace(screened, p_value=p_value))
        return found
    return None
