"""Causes that act on the cable as an added effect does, and that were not tried."""

from __future__ import annotations

from collections.abc import Collection

import numpy as np

from dlo_casadi.diagnosis.candidates import Candidate
from dlo_casadi.estimation.result import Fit

# A load so near to a held end (share of the length) bends the cable beyond it as an error of the
# fixture does: shapes show what is transmitted, not how it is applied (Saint-Venant).
NEAR_END = 0.1
# What a fixture can do, by how it is modelled.
FIXTURES = {"pinned": ("start_spring", "end_spring"), "clamped": ("clamp_angle", "clamp_angle")}


def untried_equivalents(fit: Fit, effect: Candidate, tried: Collection[str]) -> tuple[str, ...]:
    """Names of effects that an added one may stand for, those left out that were tried.

    A constant force along gravity is a weight; a local effect at a fixture may be the fixture's.

    Parameters
    ----------
    fit : Fit
        With the effect.
    effect : Candidate
    tried : names
        What the data have decided on already.
    """
    found = []
    if effect.name == "point_force" and _along_gravity(fit, effect.effect.label):
        found.append("lumped_mass")
    place = _place(fit, effect.effect.label)
    if place is not None:
        model = fit.model
        if place < NEAR_END and model.start in FIXTURES:
            found.append(FIXTURES[model.start][0])
        if place > 1 - NEAR_END and model.end in FIXTURES:
            found.append(FIXTURES[model.end][1])
    return tuple(name for name in found if name not in tried)


def _along_gravity(fit: Fit, label: str) -> bool:
    """Whether the force across gravity lies within two of its standard deviations."""
    down = np.array(fit.model.gravity) / max(float(np.linalg.norm(fit.model.gravity)), 1e-12)
    names = [f"{label}.f{axis}" for axis in fit.model.node.axes]
    force, std = (np.array([get(name) for name in names]) for get in (fit.value, fit.std))
    along = float(force @ down)
    across, noise = force - along * down, np.sqrt(std**2 @ (1 - down**2))
    return bool(along > 0 and np.linalg.norm(across) < 2 * noise)


def _place(fit: Fit, label: str) -> float | None:
    """Place of a local effect as a share of the length; None if it acts everywhere."""
    names = [f"{label}.{key}" for key in ("position", "start", "end")]
    places = [fit.value(name) for name in names if name in fit.model.names]
    return float(np.mean(places)) / fit.model.cable.length if places else None
