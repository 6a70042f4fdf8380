"""What one effect that is too small to show would do to a stiffness.

An interval holds the truth if the model lacks nothing. An effect may be missing that the data do
not exclude, and move the stiffness out of it. The interval of a stiffness if a candidate's
parameters are unknown, too, follows from the normal equations of the screening, see `widened`; the
widest one over all candidates at the places at which they were scored is reported.

References
----------
Leamer, Specification Searches (1978): bounds of an estimate over models that data do not exclude.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np

from dlo_casadi.diagnosis.gram import Gram
from dlo_casadi.diagnosis.next_measurement import Telling, telling
from dlo_casadi.diagnosis.next_motion import NextMotion, next_motion
from dlo_casadi.diagnosis.widened import Widened
from dlo_casadi.errors import EstimationError
from dlo_casadi.estimation.constrained import threshold
from dlo_casadi.estimation.descent import refit
from dlo_casadi.estimation.result import Fit
from dlo_casadi.model.cable_model import STIFFNESSES
from dlo_casadi.thresholds import ALIKE, NORMAL_95

# Largest factor by which the refit moves an end, of its logarithm; it was 1.5 in markers_in_space.
# Measured in 13 plane sessions: intervals 4.5 times as wide as `interval_95` (median), 3.0 without.
FARTHEST = 2.0
# Ratio of widths from which on it is said what a hidden effect would do to a stiffness.
WIDER = 1.2
Ends = tuple[float | None, float | None]


class Size(NamedTuple):
    """A parameter of an effect."""

    value: float
    unit: str


@dataclass(frozen=True)
class IfHidden:
    """A stiffness if one effect is hidden that the data do not exclude.

    Parameters
    ----------
    parameter : str
        Name of the stiffness.
    effect : str
    interval : (float or None, float or None) [N m^2]
        95 %, to first order about the fit; the end that is farther from the estimate is moved
        outwards as far as a refit there is likelier than to first order.
    values : dict
        Parameters of the effect, by their names [SI], at the end of the interval that is farther
        from the estimate: so large an effect is not excluded.
    telling : Telling or None
        The measurement that would exclude it; None if no equilibria are found there.
    rivals : (Fit, Fit) or None
        The fit, and that with the effect at the end of the interval.
    motion : NextMotion or None
        The motion that would exclude it, once it is asked for, see `with_motion`.
    """

    parameter: str
    effect: str
    interval: Ends
    values: Mapping[str, Size]
    telling: Telling | None
    rivals: tuple[Fit, Fit] | None = field(default=None, repr=False)
    motion: NextMotion | None = None

    def with_motion(self) -> IfHidden:
        """The same with the motion that would exclude it."""
        if self.rivals is None:
            return self
        fit, other = self.rivals
        return replace(self, motion=next_motion(fit, {self.effect: other}))


def wider(one: Ends, other: Ends) -> bool:
    """Whether an interval of a positive number is wider than another one by more than WIDER."""
    widths = [np.log(high / low) if low and high else np.inf for low, high in (one, other)]
    return bool(widths[0] > WIDER * widths[1])


def if_hidden(fit: Fit, gram: Gram) -> dict[str, IfHidden]:
    """What one effect could do to each estimated stiffness, by its name.

    `gram`: of the candidates beside the fit, or beside one of the same effects.
    """
    known = [name for name in STIFFNESSES if name in fit.problem.unknowns.names]
    return {name: _widest(fit, name, gram.widened(name)) for name in known}


def _widest(fit: Fit, name: str, rows: Sequence[Widened]) -> IfHidden:
    """The widest interval of a stiffness: of nearly as wide ones, that with fewest parameters."""
    spread = np.sqrt(threshold(fit, name)) / NORMAL_95
    ends = [row.ends(name, spread) for row in rows]
    width = [high - low for low, high in ends]
    wide = [i for i, each in enumerate(width) if each >= ALIKE * max(width)]
    best = min(wide, key=lambda i: (len(rows[i].candidate.screened), -width[i]))
    row, value = rows[best], fit.value(name)
    far = max(ends[best], key=abs)
    low, high = ends[best]
    other = _refitted(fit, row, name, far)
    if other is not None:
        rise = 2 * (other.point.objective - fit.point.objective) + row.gain
        more = np.sqrt(threshold(fit, name) / max(rise, 1e-9))
        # As the secant step of a profile: the root of its rise is nearly linear.
        far *= float(np.clip(more, 1.0, FARTHEST))
        low, high = min(low, far), max(high, far)
    low, high = (float(value * np.exp(end)) for end in (low, high))
    sizes = _sizes(fit, row, _linear(fit, row, name, far))
    told = (None, None) if other is None else (telling(fit, other), (fit, other))
    return IfHidden(name, row.candidate.name, (low, high), sizes, *told)


def _linear(fit: Fit, row: Widened, name: str, far: float) -> dict[str, float]:
    """Parameters of a candidate, as screened, where the log of a stiffness differs by `far`."""
    model = row.candidate.add_linear_to(fit.model)
    parameters = {q.name: q for q in model.parameters}
    values = dict(row.scan)
    for full, x in row.at(name, far).items():
        q = parameters[full]
        start = fit.value(full) if row.candidate.nuisance else q.nominal
        values[full] = float(np.clip(start + x * q.scale, q.lower, q.upper))
    return values


def _sizes(fit: Fit, row: Widened, linear: dict[str, float]) -> dict[str, Size]:
    """Parameters of a candidate by their names, from those as screened."""
    candidate, cable = row.candidate, fit.model.cable
    values = linear if candidate.nuisance else candidate.of_linear(cable, linear)
    prefix = f"{candidate.effect.label}."
    return {
        q.name: Size(values[prefix + q.name], q.unit) for q in candidate.effect.parameters(cable)
    }


def _refitted(fit: Fit, row: Widened, name: str, far: float) -> Fit | None:
    """The fit with a candidate where the log of a stiffness differs by `far`; None if lost."""
    candidate, unknowns = row.candidate, fit.problem.unknowns
    free = dict.fromkeys([*unknowns.names[: unknowns.n_parameters], *candidate.screened])
    fixed = _linear(fit, row, name, far) | {name: float(fit.value(name) * np.exp(far))}
    model = candidate.add_linear_to(fit.model)
    try:
        return refit(fit, model, free=[q for q in free if q != name], values=fixed)
    except EstimationError:
        return None
