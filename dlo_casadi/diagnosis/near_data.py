"""Fits of candidates that start at the measured shapes, for a base that misfits them.

The starts are those of `diagnosis.from_data`.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from concurrent.futures import Executor
from contextlib import suppress
from dataclasses import replace
from functools import partial

import numpy as np

from dlo_casadi.diagnosis.candidates import Candidate
from dlo_casadi.diagnosis.from_data import NEAR_NOISE, RelaxedStart, expected_left
from dlo_casadi.diagnosis.gram import (
    Screened,
    in_order,
    p_values_of,
    sidak,
    survival,
)
from dlo_casadi.diagnosis.refits import (
    Confirmed,
    Tried,
    at_noise,
    followed,
    loads_from_best,
)
from dlo_casadi.diagnosis.screening import RelaxedScreen, Screen
from dlo_casadi.errors import EstimationError
from dlo_casadi.estimation.descent import NEARLY, descend
from dlo_casadi.estimation.fit import EXPLAINED, explains, misfits
from dlo_casadi.estimation.relaxation import Relaxation
from dlo_casadi.estimation.result import Fit
from dlo_casadi.runtime.parallel import map_in_order
from dlo_casadi.runtime.work import UNBOUNDED, Bound, accounted_as
from dlo_casadi.thresholds import BEST, REFITTED

# Largest number of candidates found at once.
LARGEST = 3
# Ratio of what two starts leave, or of what one leaves to the noise, within which they are close.
# Starts close to the best one are fitted: in two sessions in space the hidden effect left 3105 and
# 8250, its only rival 8051, and all others 27800 and more. Candidates close to the noise are fitted
# before larger subsets are started.
CLOSE = 3.0

# Candidates that are started beside each of the best starts. In two sessions in space whose pairs
# ranked low at both points the missing one was the first, with 1.1 to 2.1 times the next's gain.
FURTHER = 2

NOT_NEAR = "does not come near the measured shapes"
LESS_NEAR = "comes less near the measured shapes than one that explains them"


def confirm_from_data(base: Fit, start: RelaxedStart) -> Confirmed | None:
    """Fit with a candidate added, from the relaxed base; None if it reaches no equilibrium.

    It keeps the base's weights if the candidate does not bring it to the noise of the points.
    """
    with suppress(EstimationError):
        fit = start.fit()
        if fit is not None and misfits(fit):
            fit = descend(fit.reweighed(base.noise, base.problem.priors), tolerance=NEARLY)
        if fit is not None and not misfits(fit):
            fit = at_noise(fit, start.problem.noise)
        return Confirmed.of(start.each[-1], base, fit, start.each[:-1])
    return None


def near_data(
    base: Fit,
    relaxed: tuple[Fit, float],
    executor: Executor,
    listed: Sequence[Candidate],
    *,
    largest: int = LARGEST,
    bound: Bound = UNBOUNDED,
) -> Tried:
    """Fits, started at the measured shapes, of the subsets of candidates that fit them best.

    In a misfit scores are useless alone, and a refit follows the declared model's error. The best
    single candidates by the Gram matrix at the relaxed fit are started; those near the best one are
    fitted if that comes near the noise. Until a fit explains the shapes, others follow: the best
    singles and pairs of this matrix and of that at the base, as effects that rank low at one point
    rank high at the other; then, size by size, the shapes are relaxed with each of the best starts,
    and the best candidates by the Gram matrix there join it, as what one effect hides shows once
    that one is there. If no fit explains the shapes, the best of the other starts are fitted at the
    end. A contact, which has no score, is fitted first if its start leaves least; if it explains
    the shapes, only single candidates are compared with it. Other contacts are fitted at the end,
    unless their starts leave far more than the best one. If the best subset does not explain the
    shapes, or only by a scatter, its end roll is searched again, then that of the next.

    Parameters
    ----------
    relaxed : (Fit, float)
        The relaxed base and its softness, see `from_data`.
    largest : int
        Largest number of candidates in a subset.
    bound : Bound
        Once it is met no larger subset and no other end roll is tried.
    """
    near, softness = relaxed
    gradual = [x for x in listed if x.effect.gradual]
    contacts = [Screened(x, 0.0, 1.0, dict(x.scans[0])) for x in listed if not x.effect.gradual]
    gram = RelaxedScreen(near, gradual, softness).gram(np.inf) if gradual else None
    begin = partial(RelaxedStart.of, near)
    first = gram.subsets(1, REFITTED) if gram else []
    begun = map_in_order(executor, begin, [*((x,) for x in contacts), *first])
    starts, noise = begun[len(contacts) :], expected_left(near)
    first_left = min((start.left for start in begun), default=np.inf)

    def touched(above: float, most: float) -> list[Confirmed]:
        """Fits of the contacts whose starts leave more than `above` and at most `most`."""
        near_enough = [start for start in begun[: len(contacts)] if above < start.left <= most]
        given = partial(confirm_contact, base), near_enough
        return [x for x in map_in_order(executor, *given) if x]

    touching = touched(-np.inf, first_left)
    explained = _any_explains(touching)
    least = first_left if explained else np.inf
    kept: list[RelaxedStart] = []
    tried: list[Confirmed] = []
    far: dict[str, str] = {x.candidate.name: NOT_NEAR for x in contacts}
    far |= {name: NOT_NEAR for start in starts for name in start.names}

    def stages() -> Iterator[list[tuple[Screened, ...]]]:
        """Subsets that are started one after the other."""
        yield []
        if gram is None or explained:
            return
        points = gram, Screen(base, gradual).gram(np.inf, executor)
        yield [x for point in points for k in (1, 2) for x in point.subsets(k, BEST)]
        for size in range(1, min(largest, LARGEST)):
            best = sorted((x for x in starts if len(x.each) == size), key=lambda x: x.left)
            further = partial(_further, listed=gradual, softness=softness)
            yield [x for each in map_in_order(executor, further, best[:BEST]) for x in each]

    def fit(*, last: bool) -> bool:
        """Fit the best starts, if they are near the noise or the last; whether one explains it."""
        close = _near_least([x for x in starts if x not in kept], EXPLAINED * noise, least)
        if close and (last or close[0].left < CLOSE * noise):
            rolls = not (explained or bound.met)
            fitted, found = confirmed(base, close[:REFITTED], rolls=rolls)
            kept.extend(fitted)
            tried.extend(found)
            far.update({x: LESS_NEAR for y in close[len(fitted) : REFITTED] for x in y.names})
        return _any_explains(tried)

    for subsets in stages():
        known = [start.names for start in starts]
        new = [x for x in _distinct(subsets) if _names(x) not in known]
        starts += map_in_order(executor, begin, new)
        if fit(last=False) or bound.met:
            break
    most = CLOSE * min((start.left for start in starts), default=np.inf)
    if not (_any_explains(tried) or (bound.met and tried)):
        found = fit(last=True) or explained
        touching += [] if found else touched(first_left, most)
    beside = [start for start in begun[: len(contacts)] if start.left <= most]
    far |= {name: LESS_NEAR for start in beside for name in start.names}
    screened = in_order([*(gram.singles if gram else ()), *contacts])
    tried = loads_from_best(base, screened, tried, executor)
    by_fit = {item.name: item.screened for item in touching}
    screened = in_order([by_fit.get(x.candidate.name, x) for x in screened])
    names = {x.candidate.name for item in tried for x in item.each}
    names = names.union(by_fit, *(start.names for start in kept))
    far = {name: why for name, why in far.items() if name not in names}
    p_values = p_values_of(screened)
    # Those that fit the shapes best, and loads started from the forces of one.
    subsets = [*(start.each for start in kept), *(item.each for item in tried)]
    for item in (x for subset in subsets for x in subset):
        single, name = sidak(item.p_value, len(screened)), item.candidate.name
        p_values[name] = min(single, p_values.get(name, 1.0))
    return Tried(screened, p_values, [*touching, *tried], far)


def _further(
    start: RelaxedStart, listed: Sequence[Candidate], softness: float
) -> list[tuple[Screened, ...]]:
    """A start's candidates with each of the best further ones at its shapes, relaxed again."""
    values = Relaxation(start.problem, softness).solve(start.values)
    near = Fit(start.problem, start.problem.evaluate(values))
    labels = {x.candidate.effect.label for x in start.each}
    others = [x for x in listed if x.effect.label not in labels]
    best = RelaxedScreen(near, others, softness).gram(np.inf).subsets(1, FURTHER)
    return [(*start.each, *each) for each in best]


def _names(each: Sequence[Screened]) -> set[str]:
    return {x.candidate.name for x in each}


def _distinct(subsets: Sequence[tuple[Screened, ...]]) -> list[tuple[Screened, ...]]:
    """The first of each set of candidates."""
    return list({frozenset(_names(x)): x for x in reversed(subsets)}.values())[::-1]


def _any_explains(tried: Sequence[Confirmed]) -> bool:
    return any(explains(item.fit) for item in tried)


def _near_least(
    begun: Sequence[RelaxedStart], noise: float, least: float = np.inf
) -> list[RelaxedStart]:
    """Starts whose objective is close to the least one, best first."""
    ordered = sorted(begun, key=lambda x: x.left)
    least = min([least, *(x.left for x in ordered[:1])])
    most = least * (NEAR_NOISE if least < noise else CLOSE)
    return [start for start in ordered if start.left <= most]


@accounted_as("fits from the shapes")
def confirmed(
    base: Fit, starts: Sequence[RelaxedStart], *, rolls: bool
) -> tuple[list[RelaxedStart], list[Confirmed]]:
    """The starts that are fitted, best first, and their fits.

    Once a fit explains the shapes, others are fitted only if their starts leave less than EXPLAINED
    times as much as the best. Until one does, with `rolls` other end rolls are tried.
    """
    fitted: list[RelaxedStart] = []
    found: list[Confirmed | None] = []

    def explained() -> bool:
        return any(item is not None and explains(item.fit) for item in found)

    for start in starts:
        if explained() and start.left >= EXPLAINED * starts[0].left:
            continue
        item = confirm_from_data(base, start)
        fitted.append(start)
        found.append(item if fitted[1:] or not rolls else confirm_rolled(base, start, item))
    for k in range(1, len(found)):
        if rolls and not explained():
            found[k] = confirm_rolled(base, fitted[k], found[k])
    return fitted, [item for item in found if item is not None]


def confirm_rolled(base: Fit, start: RelaxedStart, found: Confirmed | None) -> Confirmed | None:
    """The likelier of `found` and a fit from the start with the end roll searched again.

    The error of a wrong end roll may look like a scatter from pose to pose: if `found` explains the
    shapes by a scatter, but its start did not reach the noise, a roll that leaves less is tried.
    """
    explained = found is not None and explains(found.fit)
    if found is not None and explained and (start.reached or not found.fit.scatters):
        return found
    rolled = start.rolled()
    if rolled is None or (explained and NEAR_NOISE * rolled.left > start.left):
        return found
    other = confirm_from_data(base, rolled)
    both = [item for item in (found, other) if item is not None]
    return max(both, key=lambda item: (explains(item.fit), item.fit.log_evidence), default=None)


def confirm_contact(base: Fit, start: RelaxedStart) -> Confirmed | None:
    """`confirm_from_data` of an effect without derivative where it vanishes, scored by gain.

    For a contact, a soft balance is less informative than a fit. The gain is computed with the
    noise of the base, which may hide what the base lacks: it is at least this large.
    """
    item, (screened,) = confirm_from_data(base, start), start.each
    if item is None:
        return None
    try:
        same = item.fit.reweighed(base.noise, base.problem.priors)
    except EstimationError:  # a pose needs what is random in it: no gain can be computed
        return item
    fit = followed(same, same.model, {}) or same
    gain = max(2 * (base.point.objective - fit.point.objective), 0.0)
    values = {name: item.fit.value(name) for name in screened.candidate.frees}
    p_value = survival(gain, len(values), np.inf)
    return replace(item, screened=Screened(screened.candidate, gain, p_value, values))
