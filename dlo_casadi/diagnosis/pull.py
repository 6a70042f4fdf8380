"""The missing load without a cause: where the cable is pulled, and how in each pose."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dlo_casadi.diagnosis.candidates import PLACES
from dlo_casadi.effects import UnknownPull
from dlo_casadi.errors import EstimationError
from dlo_casadi.estimation.fit import Fit, fit_model
from dlo_casadi.model import DEVIATIONS

FloatArray = NDArray[np.floating]

# Places kept from the scan for a full fit, and the rise of twice the objective that bounds the
# interval (95 % of chi-square with one degree of freedom).
TRIED = 3
RISE = 3.84


@dataclass(frozen=True)
class Pull:
    """A force per pose at one place of the cable.

    Parameters
    ----------
    force_per_pose : (m_fit, 2) [N]
        Of each fit pose, in the board frame.
    position : float [m]
    interval : (float, float) [m]
        95 %.
    gain : float
        Decrease of twice the objective against the fit without it.
    fit : Fit
    """

    force_per_pose: FloatArray
    position: float
    interval: tuple[float, float]
    gain: float
    fit: Fit


def estimate_pull(base: Fit) -> Pull | None:
    """Estimate an unexplained load as one force per pose at one place; None if none fits.

    The place is scanned with one Gauss-Newton step each, the best are refitted in full, and the
    place is refined with everything else.
    """
    effect = UnknownPull()
    model = base.model.with_effect(effect)
    name = f"{effect.label}.position"
    length = base.model.cable.length
    fixed = set(base.problem.unknowns.model.names) - set(
        np.array(base.model.names)[base.problem.unknowns.free]
    )
    free = [key for key in model.names if key not in fixed and key != name]
    fits: dict[float, Fit] = {}
    for share in PLACES:
        values = model.nominal.copy()
        values[model.names.index(name)] = share * length
        fit = _quick(base, model, values, free, steps=1)
        if fit is not None:
            fits[float(share * length)] = fit
    if not fits:
        return None
    leading = sorted(fits, key=lambda place: fits[place].point.objective)[:TRIED]
    best: Fit | None = None
    for place in leading:
        refined = _quick(fits[place], model, fits[place].p, [*free, name], steps=40)
        if refined is not None and (best is None or refined.point.objective < best.point.objective):
            best = refined
    if best is None:
        return None
    position = best.value(name)
    std = max(best.std(name), 1e-4 * length)
    columns = [DEVIATIONS.index(axis) for axis in effect.per_pose]
    forces = best.point.shapes.deviation[np.ix_(best.problem.used, columns)]
    half = np.sqrt(RISE) * std
    interval = (max(0.0, position - half), min(length, position + half))
    gain = 2 * (base.point.objective - best.point.objective)
    return Pull(forces, position, interval, gain, best)


def _quick(base: Fit, model, values: FloatArray, free: list[str], steps: int) -> Fit | None:  # type: ignore[no-untyped-def]
    """Fit with a limited number of steps; None where equilibria are lost."""
    try:
        return fit_model(
            model,
            base.problem.measured,
            base.problem.tolerances,
            free=free,
            values=values,
            start=base,
            max_iterations=steps,
        )
    except EstimationError:
        return None
