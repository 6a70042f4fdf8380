"""Candidates: effects that may be missing, each a step from one model to a larger one."""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from dlo_casadi.effects import EFFECTS, Effect, Fitted, Load, Setup
from dlo_casadi.effects.cable import CableData, height_of
from dlo_casadi.estimation.fit import resting_height
from dlo_casadi.estimation.result import Fit
from dlo_casadi.model.cable_model import BENDING_STIFFNESS, CableModel
from dlo_casadi.thresholds import ALIKE


@dataclass(frozen=True)
class Candidate:
    """One effect that may be added to a model.

    Parameters
    ----------
    frees : tuple of str
        Qualified parameters that are estimated without a prior once the effect is added.
    screened : tuple of str
        Qualified parameters of `effect.linear()`; their derivatives, taken where the effect
        vanishes, are the candidate's signature.
    scans : tuple of dict
        Trial values of the parameters in which the effect is nonlinear (a place, a direction); it
        is screened at each of them.
    nuisance : bool
        True if the model already has the effect, held within its tolerance by a prior.
    alike : int
        Number of candidates of this name, such as one for each clip; only the best one counts.
    """

    effect: Effect
    frees: tuple[str, ...]
    screened: tuple[str, ...]
    scans: tuple[dict[str, float], ...]
    nuisance: bool
    alike: int = 1

    @property
    def name(self) -> str:
        """Name of the effect."""
        return self.effect.name

    def add_to(self, model: CableModel) -> CableModel:
        """Return the model with this effect, its parameters free of priors."""
        if self.nuisance:
            kept = {k: v for k, v in model.priors.items() if k not in self.frees}
            return replace(model, priors=kept)
        return model.with_effect(self.effect)

    def remove_from(self, model: CableModel, before: CableModel) -> CableModel:
        """Return the model without this effect; a nuisance gets the priors of `before` back."""
        if self.nuisance:
            held = {name: before.priors[name] for name in self.frees}
            return replace(model, priors={**model.priors, **held})
        return model.without_effect(self.effect.label)

    def add_linear_to(self, model: CableModel) -> CableModel:
        """Return the model with this effect, in the parameters used for screening."""
        return self.add_to(model) if self.nuisance else model.with_effect(self.effect.linear())

    def of_linear(self, cable: CableData, values: Mapping[str, float]) -> dict[str, float]:
        """Qualified parameters, within their bounds, from those used for screening."""
        prefix = f"{self.effect.label}."
        own = {name.removeprefix(prefix): value for name, value in values.items()}
        return of_linear(self.effect, cable, own)


def of_linear(effect: Effect, cable: CableData, values: Mapping[str, float]) -> dict[str, float]:
    """Qualified parameters of an effect, within their bounds, from those of its `linear` one."""
    own, each = effect.of_linear(cable, values), effect.parameters(cable)
    return {f"{effect.label}.{q.name}": float(np.clip(own[q.name], q.lower, q.upper)) for q in each}


def setup_of(model: CableModel, **seen: Any) -> Setup:
    """Setup of a model's cable, with other knowledge about its measurement."""
    curved = model.n_coefficients > 0
    seen |= {"clips": model.clips, "obstacles": len(model.obstacles)}
    return Setup(model.cable, model.start, model.end, model.gravity, curved, **seen)


def candidates(
    model: CableModel,
    setup: Setup,
    exclude: Sequence[str] = (),
    among: Mapping[str, type[Effect]] = EFFECTS,
) -> list[Candidate]:
    """List all effects that may be missing from a model.

    Parameters
    ----------
    model : CableModel
        Includes its nuisances. An effect that it has without a prior is no candidate any more.
    exclude : sequence of str
        Effects that the user excludes.
    among : mapping
        Kinds of effects by their names.
    """
    found = []
    kinds = [x for x in among.values() if x.name not in exclude and x.applies(setup)]
    for effect in (effect for kind in kinds for effect in kind.each_for(setup)):
        prefix = f"{effect.label}."
        frees = tuple(prefix + q.name for q in effect.parameters(model.cable))
        if any(other.label == effect.label for other in model.effects):
            if all(name in model.priors for name in frees):
                found.append(Candidate(effect, frees, frees, ({},), nuisance=True))
            continue
        scans = tuple(
            {prefix + key: value for key, value in scan.items()} for scan in effect.scans(setup)
        )
        tested = (prefix + q.name for q in effect.linear().parameters(model.cable))
        screened = tuple(name for name in tested if name not in scans[0])
        found.append(Candidate(effect, frees, screened, scans, nuisance=False))
    count = Counter(x.name for x in found)
    return [replace(x, alike=count[x.name]) for x in found]


def candidates_of(
    fit: Fit, center: tuple[float, float] | None, exclude: Sequence[str]
) -> list[Candidate]:
    """List all effects that may be missing from a fitted model; see `candidates`.

    `center` [m]: middle of the photographs in the board frame.
    """
    problem, shapes = fit.problem, fit.point.shapes
    setup = setup_of(
        fit.model,
        n_poses=len(problem.used),
        center=center,
        camera=any(item.pose.camera_center is not None for item in problem.history),
        readings=tuple({name for item in problem.history for name in item.reactions}),
        directions=(float(shapes.x[:, 0].mean()), float(shapes.x[:, -1].mean())),
        largest_bend=float(problem.equilibria.bends(shapes, fit.p, fit.rest).max()),
        level=float(height_of(problem.history[0].pose.start, fit.model.gravity)),
        resting=resting_height(problem),
    )
    return candidates(fit.model, setup, exclude)


def equivalents(
    fit: Fit, added: Candidate, tried: Collection[str], rivals: Sequence[Candidate] = ()
) -> tuple[str, ...]:
    """Names of other effects that may be the true cause of an added effect.

    These are effects that act alike, except those on which the data have decided. For a load on a
    cable with a free tip, which nothing lifts, a weight is always one of them; so is the stiffness
    if the fit cannot distinguish the load from it.

    Parameters
    ----------
    fit : Fit
        The fit with the effect.
    tried : names
        Effects on which the data have already decided.
    rivals : sequence of Candidate
        Candidates that the data cannot distinguish from it.
    """
    effect, cable, setup = added.effect, fit.model.cable, setup_of(fit.model)
    own = {q.name: f"{effect.label}.{q.name}" for q in effect.parameters(cable)}
    values = {name: fit.value(full) for name, full in own.items()}
    stds = {name: fit.std(full) for name, full in own.items()}
    found = Fitted(effect, setup, values, stds)
    names = [
        name
        for name, kind in EFFECTS.items()
        if name not in tried and kind.applies(setup) and kind.made_for(setup).may_be(found)
    ]
    loads = any(isinstance(item.effect, Load) for item in (added, *rivals))
    if not fit.model.end.place and loads:
        names += [
            name
            for name, kind in EFFECTS.items()
            if issubclass(kind, Load) and kind.carried and name not in (effect.name, *names)
        ]
        names += [BENDING_STIFFNESS] * _like_stiffness(fit, list(own.values()))
    return tuple(names)


def _like_stiffness(fit: Fit, parameters: Sequence[str]) -> bool:
    """Whether most of the uncertainty of EI would vanish if these parameters were known."""
    names, covariance = fit.problem.unknowns.names, fit.covariance
    if BENDING_STIFFNESS not in names:
        return False
    k = names.index(BENDING_STIFFNESS)
    columns = [names.index(name) for name in parameters if name in names]
    beside = covariance[k, columns]
    told = beside @ np.linalg.pinv(covariance[np.ix_(columns, columns)], hermitian=True) @ beside
    return bool(told > ALIKE**2 * covariance[k, k])
