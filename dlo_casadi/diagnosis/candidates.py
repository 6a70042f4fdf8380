"""Candidates: effects that may be missing, each a step from one model to a larger one."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from dlo_casadi.effects import EFFECTS, ClampAngle, Effect, ImageDistortion, StateEffect
from dlo_casadi.model import CableModel

FloatArray = NDArray[np.floating]

# Places along the cable at which local effects are tried, as shares of its length.
PLACES = np.linspace(0.06, 0.94, 23)
# Lengths of stiff sections that are tried, as shares of the cable's length.
SECTIONS = (0.08, 0.2)
# Yield curvatures that are tried, as shares of the largest bend.
YIELDS = (0.15, 0.3, 0.45, 0.6, 0.75)
# Directions in which a pin may hold the cable, relative to the mean heading there [rad].
SPRING_HEADINGS = (-1.2, -0.6, 0.0, 0.6, 1.2)


@dataclass(frozen=True)
class Candidate:
    """One effect that may be added to a model.

    Parameters
    ----------
    effect : Effect
    frees : tuple of str
        Qualified parameters that are estimated without a prior once it is added.
    screened : tuple of str
        Qualified parameters of `effect.linear()` whose derivatives where the effect vanishes are
        the candidate's signature.
    scans : tuple of dict
        Values of the parameters by which the effect enters nonlinearly (a place, a direction),
        at each of which it is screened.
    nuisance : bool
        True if the model has it already, held within its tolerance by a prior.
    """

    effect: Effect
    frees: tuple[str, ...]
    screened: tuple[str, ...]
    scans: tuple[dict[str, float], ...]
    nuisance: bool

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


def candidates(
    model: CableModel,
    center: tuple[float, float] | None,
    n_poses: int,
    exclude: Sequence[str] = (),
    directions: tuple[float, float] = (0.0, 0.0),
    camera: bool = False,
    largest_bend: float | None = None,
) -> list[Candidate]:
    """List all effects that may be missing in a model.

    Parameters
    ----------
    model : CableModel
        With its nuisances; an effect that it has without a prior is no candidate any more, but a
        second lumped mass is.
    center : (float, float) or None [m]
        Middle of the photographs; None if there are none.
    n_poses : int
        That are fitted. What a pose leaves behind, and how a force changes with the shape, takes
        two to be seen: in one, a tether is a point force.
    exclude : sequence of str
        Effects that the user does not want to be tried.
    directions : (float, float) [rad]
        Mean headings at start and end.
    camera : bool
        Whether it is known from where the photographs were taken.
    largest_bend : float, optional [1/m]
        Of all poses, curvature minus rest curvature; a turn per length by default.
    """
    bend = model.cable.curvature_scale if largest_bend is None else largest_bend
    found = []
    for name in EFFECTS:
        if name in exclude or not _applies(name, model, center, n_poses, camera):
            continue
        effect = _make(name, model, center)
        present = any(other.label == effect.label for other in model.effects)
        prefix = f"{effect.label}."
        frees = tuple(prefix + q.name for q in effect.parameters(model.cable))
        if present:
            held = all(name in model.priors for name in frees)
            if held:
                found.append(Candidate(effect, frees, frees, ({},), nuisance=True))
            continue
        scans = tuple(
            {prefix + key: value for key, value in scan.items()}
            for scan in _scans(name, model, directions, bend)
        )
        tested = (prefix + q.name for q in effect.linear().parameters(model.cable))
        screened = tuple(name for name in tested if name not in scans[0])
        found.append(Candidate(effect, frees, screened, scans, nuisance=False))
    return found


def _applies(
    name: str, model: CableModel, center: tuple[float, float] | None, n_poses: int, camera: bool
) -> bool:
    """Whether an effect makes sense for these boundaries and this camera."""
    if name == "image_distortion":
        return center is not None
    if name == "standoff_error":
        return camera
    if name == "clamp_angle":
        return "clamped" in (model.start, model.end)
    if name == "start_spring":
        return model.start == "pinned"
    if name == "end_spring":
        return model.end == "pinned"
    if name == "end_offset":
        return model.end != "free"
    if name == "tether":
        return n_poses > 1
    if issubclass(EFFECTS[name], StateEffect):
        return n_poses > 1 and model.n_coefficients > 0
    return True


def _make(name: str, model: CableModel, center: tuple[float, float] | None) -> Effect:
    if name == "clamp_angle":
        return ClampAngle(start=model.start == "clamped", end=model.end == "clamped")
    if name == "image_distortion":
        return ImageDistortion(center=center or (0.0, 0.0))
    return EFFECTS[name]()


def _scans(
    name: str, model: CableModel, directions: tuple[float, float], bend: float
) -> list[dict[str, float]]:
    """Values of the nonlinear parameters at which the effect is screened."""
    length = model.cable.length
    if name in ("lumped_mass", "point_force", "tether"):
        return [{"position": float(share * length)} for share in PLACES]
    if name == "stiff_section":
        return [
            {
                "start": float(max(share - width / 2, 0.0) * length),
                "end": float(min(share + width / 2, 1.0) * length),
            }
            for width in SECTIONS
            for share in PLACES
        ]
    if name in ("start_spring", "end_spring"):
        middle = directions[0 if name == "start_spring" else 1]
        return [{"heading": middle + turn} for turn in SPRING_HEADINGS]
    if name == "plastic_set":
        return [{"yield_curvature": share * bend} for share in YIELDS]
    return [{}]
