"""Modes of a cable about its shape in a pose, and what the uncertainty of a fit makes of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Self

import numpy as np

from dlo_casadi.arrays import FloatArray
from dlo_casadi.effects import MeasurementEffect
from dlo_casadi.equilibrium.equilibrium import Equilibrium, equilibria_of
from dlo_casadi.equilibrium.minima import descend, kept_by
from dlo_casadi.equilibrium.pose import HeldPose
from dlo_casadi.equilibrium.spans import nothing_found
from dlo_casadi.equilibrium.spread import Uncertainty
from dlo_casadi.errors import DloError
from dlo_casadi.model.assembly import Assembly
from dlo_casadi.model.cable_model import CableModel
from dlo_casadi.model.stacked import Inputs
from dlo_casadi.motion.anchors import Anchors
from dlo_casadi.motion.modes import DampedModes, damped_modes, displacements
from dlo_casadi.motion.state import State
from dlo_casadi.motion.system import MovingCable


def moving_cable(
    model: CableModel,
    p: FloatArray,
    rest: FloatArray,
    shape: tuple[Equilibrium, HeldPose] | None = None,
) -> MovingCable:
    """The cable in motion, without effects of the camera; clips hold it as in a shape at rest.

    Raises
    ------
    DloError
        If motion does not know a part of the cable, or if a cable with clips has no shape.
    """
    model, p = model.without_kind(MeasurementEffect, p)
    if not model.clips or shape is None:
        return MovingCable(model, p, rest)
    if model.sliding:
        raise DloError(
            f"{model.cable.name!r} slides through an eyelet: in motion a clip holds the cable at "
            "one arc length.\n  Try: pinned, clamped or swivel."
        )
    anchors = Anchors.of(model, p, rest, *shape)
    return MovingCable(replace(model, clips=()), p, rest, anchors=anchors)


@dataclass(frozen=True, eq=False)
class ModesAtRest:
    """Small motions of a cable about its shape at rest in a pose, the slowest first.

    Parameters
    ----------
    model : CableModel
    p : (n_parameters,)
    rest : (n_rests,) [1/m]
    equilibrium : Equilibrium
    pose : HeldPose
    count : int
        Number of modes.
    """

    model: CableModel
    p: FloatArray
    rest: FloatArray
    equilibrium: Equilibrium
    pose: HeldPose
    count: int

    @cached_property
    def state(self) -> tuple[MovingCable, State, DampedModes]:
        """The cable about its shape, its state there, and its modes.

        Raises
        ------
        DloError
            If the mesh has fewer modes, or if motion does not know a part of the cable.
        """
        shape = self.equilibrium, self.pose
        moving = moving_cable(self.model, self.p, self.rest, shape).about(self.equilibrium.x)
        fixtures = moving.fixtures(self.pose.vector)
        state = moving.at_rest(self.equilibrium, fixtures)
        return moving, state, damped_modes(moving, state, fixtures, self.count)

    def numbers(self) -> FloatArray:
        """Frequencies w / (2 pi) [Hz] and damping ratios (2, count); raises as `state` does."""
        _, _, found = self.state
        return np.stack([found.rates / (2 * np.pi), found.damping_ratios])

    def std(self, known: Uncertainty) -> FloatArray:
        """Standard deviations (2, count) of `numbers` under a fit's covariance, to first order."""
        ways = directions(self.model, known)
        total = np.zeros((2, self.count))
        both = (self.moved([(h * p, h * rest) for p, rest in ways]) for h in (0.5, -0.5))
        for ahead, behind in zip(*both, strict=True):
            total += (ahead.numbers() - behind.numbers()) ** 2
        return np.sqrt(total)

    def displacements(self, s: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Points (K, d) [m] at arc lengths s (K,) [m], and the modes' displacements (count, K, d).

        The largest displacement of each mode is 1.
        """
        moving, state, found = self.state
        return displacements(moving, state, found.vectors, s)

    def moved(self, ways: Sequence[tuple[FloatArray, FloatArray]]) -> list[Self]:
        """Those of the cable with changed parameters and rest strains, in the same pose.

        `ways`: changes of p (n_parameters,) and of the rest strains (n_rests,) [1/m].

        Raises
        ------
        EquilibriumError
            If the cable does not stay in an equilibrium near its shape.
        """
        if not ways:
            return []
        model, pose = self.model, self.pose
        p, rest = (
            np.array([own + x for x in each])
            for own, each in zip((self.p, self.rest), zip(*ways, strict=True), strict=True)
        )
        shapes = self.equilibrium.shapes.subset(np.zeros(len(ways), dtype=int))
        start = Assembly(model, shapes, Inputs(p, rest, np.tile(pose.vector, (len(ways), 1))))
        found = descend(start)
        if not kept_by(start, found).all():
            raise nothing_found(model, pose, "a nearby shape")
        each = equilibria_of(
            replace(start, shapes=found.shapes),
            stable=found.converged,
            iterations=found.iterations,
        )
        return [replace(self, p=p[k], rest=rest[k], equilibrium=one) for k, one in enumerate(each)]


def directions(model: CableModel, known: Uncertainty) -> list[tuple[FloatArray, FloatArray]]:
    """Changes of p and of the rest strains by one std, along the covariance's principal axes."""
    both = (by @ known.root for by in known.unknowns_in(model))
    return list(zip(*(x.T for x in both), strict=True))
