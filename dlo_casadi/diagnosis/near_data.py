"""Fits of candidates that start at the measured shapes, for a base that misfits them.

The starts are those of `diagnosis.from_data`.
"""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import Executor
from contextlib import suppress
from dataclasses import replace
from functools import partial

import numpy as np

from dlo_casadi.diagnosis.candidates import Listing
from dlo_casadi.diagnosis.from_data import (
    CLOSE,
    NEAR_LEAST,
    NEAR_NOISE,
    REACHED,
    SURELY_REACHED,
    RelaxedStart,
    likeliest,
    nearest,
    screened_from_data,
)
from dlo_casadi.diagnosis.refits import (
    MOST_STEPS,
    Confirmed,
    Tried,
    at_noise,
    followed,
    loads_from_best,
)
from dlo_casadi.diagnosis.screening import Screened, in_order, p_values_of, sidak, survival
from dlo_casadi.errors import EstimationError
from dlo_casadi.estimation.descent import NEARLY, descend
from dlo_casadi.estimation.fit import explains, misfits
from dlo_casadi.estimation.result import Fit
from dlo_casadi.runtime.parallel import map_in_order
from dlo_casadi.runtime.work import UNBOUNDED, Bound, accounted_as
from dlo_casadi.thresholds import REFITTED

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
        return Confirmed.of(start.screened, base, fit, start.beside)
    return None


def near_data(
    base: Fit,
    relaxed: tuple[Fit, float],
    executor: Executor,
    listing: Listing,
    *,
    pairs: bool,
    bound: Bound = UNBOUNDED,
) -> Tried:
    """Fits, started at the measured shapes, of the candidates or `pairs` that fit them best.

    In a misfit scores are useless, and a refit follows the declared model's error. Contacts are
    fitted first, unless their starts leave far more than the best one. If no likely candidate
    reaches the noise, all others are tried before any pair. If the best candidate does not explain
    the shapes, or only by a scatter, its end roll is searched again, then that of the next. If all
    fits misfit, too, pairs are tried even where a single candidate's start came close to the noise.
    `relaxed`: the relaxed base and its softness, see `from_data`. `bound`: once it is met no pair
    and no other end roll is tried.
    """
    near, softness = relaxed
    screened = screened_from_data(near, softness, listing(near))
    likely = likeliest(screened)
    contacts = [x for x in screened if not x.candidate.effect.gradual]
    first = [*contacts, *likely[:REFITTED]]
    begun = map_in_order(executor, partial(RelaxedStart.of, near), first)
    touches, singles = begun[: len(contacts)], begun[len(contacts) :]
    if not any(start.reached for start in begun):
        # So far off, scores mislead: that of a hidden stretch was 0.7 % of the highest one.
        names = {x.candidate.name for x in (*contacts, *likely)}
        others = [x for x in screened if x.candidate.name not in names]
        more = map_in_order(executor, partial(RelaxedStart.of, near), others)
        singles += [start for start in more if start.reached]
    most = NEAR_LEAST * min((start.left for start in begun), default=np.inf)
    touches = [start for start in touches if start.left <= most]
    touching = [x for x in map_in_order(executor, partial(confirm_contact, base), touches) if x]
    explained = any(explains(item.fit) for item in touching)
    least = min(start.left for start in touches) if explained else np.inf
    later = likely[REFITTED:]
    pairs = pairs and not explained
    kept: list[RelaxedStart] = []
    tried: list[Confirmed] = []
    far = dict.fromkeys((x.candidate.name for x in (*contacts, *likely[:REFITTED])), NOT_NEAR)
    for starts in nearest(
        near, softness, singles, later, executor, listing, pairs=pairs, least=least, bound=bound
    ):
        rolls = not (explained or bound.met)
        close, found = confirmed(base, starts[:REFITTED], executor, rolls=rolls)
        kept += close
        tried += found
        far |= {x.screened.candidate.name: LESS_NEAR for x in starts[len(close) : REFITTED]}
        if any(map(_is_last, tried)):
            break
    tried = loads_from_best(base, screened, tried, executor)
    fitted = {item.name: item.screened for item in touching}
    screened = in_order([fitted.get(x.candidate.name, x) for x in screened])
    names = {x.candidate.name for item in tried for x in item.each}.union(
        *(start.names for start in kept)
    )
    names |= fitted.keys()
    far = {name: why for name, why in far.items() if name not in names}
    p_values = p_values_of(screened)
    # Those that fit the shapes best, and loads started from the forces of one; of pairs the second.
    for item in (*(start.screened for start in kept), *(x.screened for x in tried)):
        single, name = sidak(item.p_value, len(screened)), item.candidate.name
        p_values[name] = min(single, p_values.get(name, 1.0))
    return Tried(screened, p_values, [*touching, *tried], far)


def _is_last(item: Confirmed) -> bool:
    """Whether the search ends with this fit of a single candidate or a pair.

    A second effect may be found beside a single one in the next step, unless its fit was lost on
    the way: one left 20 times the noise, its start twice; the hidden pair was found from the start.
    A pair that barely explains the shapes may be wrong: one left 1.46 times the noise, the hidden
    pair 1.18 times.
    """
    most = SURELY_REACHED if item.beside else CLOSE * REACHED
    return item.fit.noise.source != "misfit" and item.fit.chi2_per_dof < most


@accounted_as("fits from the shapes")
def confirmed(
    base: Fit, starts: Sequence[RelaxedStart], executor: Executor, *, rolls: bool
) -> tuple[list[RelaxedStart], list[Confirmed]]:
    """The starts that are fitted, best first, and their fits.

    If the first fit explains the shapes, others are fitted only if their starts leave less than
    REACHED times as much. Until one explains them, with `rolls` other end rolls are tried.
    """
    fitted: list[RelaxedStart] = []
    tried: list[Confirmed] = []
    for group in (starts[:1], starts[1:]):
        explained = any(explains(item.fit) for item in tried)
        close = [x for x in group if not explained or x.left < REACHED * starts[0].left]
        fitted += close
        found = map_in_order(executor, partial(confirm_from_data, base), close)
        for k, start in enumerate(close) if rolls and not explained else ():
            item = found[k] = confirm_rolled(base, start, found[k])
            if item is not None and explains(item.fit):
                break
        tried += filter(None, found)
    return fitted, tried


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
    item, screened = confirm_from_data(base, start), start.screened
    if item is None:
        return None
    try:
        same = item.fit.reweighed(base.noise, base.problem.priors)
    except EstimationError:  # a pose needs what is random in it: no gain can be computed
        return item
    fit = followed(same, same.model, {}, MOST_STEPS) or same
    gain = max(2 * (base.point.objective - fit.point.objective), 0.0)
    values = {name: item.fit.value(name) for name in screened.candidate.frees}
    p_value = survival(gain, len(values), np.inf)
    return replace(item, screened=Screened(screened.candidate, gain, p_value, values))
