"""A shape as the middle of motions: its modes, and the state of the cable at rest in it."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from matplotlib.figure import Figure

from dlo_casadi.arrays import FloatArray
from dlo_casadi.cable.estimate import EstimatedCable
from dlo_casadi.cable.moving_picture import draw_modes
from dlo_casadi.effects import MeasurementEffect
from dlo_casadi.equilibrium.equilibrium import Equilibrium
from dlo_casadi.equilibrium.pose import HeldPose
from dlo_casadi.equilibrium.solve import solve_equilibrium
from dlo_casadi.errors import DloError
from dlo_casadi.motion.modes import DampedModes, damped_modes, displacements
from dlo_casadi.motion.state import State
from dlo_casadi.motion.step_function import fixtures_vector, state_vector
from dlo_casadi.motion.steps import still
from dlo_casadi.motion.system import MovingCable

# Number of points along a cable.
POINTS = 101


@dataclass(frozen=True, eq=False)
class Modes:
    """Small motions of a cable about a shape, the slowest first.

    Parameters
    ----------
    frequencies : (M,) [Hz]
        Natural ones w / (2 pi) of s^2 + 2 zeta w s + w^2 = 0 for exp(s t); those that are seen are
        sqrt(1 - zeta^2) times that. Zero for what does not come back, as the roll between pins.
    damping_ratios : (M,)
        zeta; above 1 a mode does not swing.
    shapes : (M, K, d)
        Displacements of the points of the shape; the largest is 1.
    points : (K, d) [m]
        The shape.
    frequency_std, damping_ratio_std : (M,)
        Standard deviations under the fit's covariance, to first order; zero for a known cable.
    """

    frequencies: FloatArray
    damping_ratios: FloatArray
    shapes: FloatArray
    points: FloatArray
    frequency_std: FloatArray
    damping_ratio_std: FloatArray

    def plot(self) -> Figure:
        """Draw the modes about the shape."""
        both = zip(self.frequencies.tolist(), self.damping_ratios.tolist(), strict=True)
        names = [f"{f:.3g} Hz, damping ratio {zeta:.2g}" for f, zeta in both]
        return draw_modes(self.points, self.shapes, names, "modes")

    def __repr__(self) -> str:
        known = self.frequencies, self.frequency_std, self.damping_ratios, self.damping_ratio_std
        lines = []
        for f, f_std, zeta, zeta_std in zip(*(x.tolist() for x in known), strict=True):
            off = (f" +- {f_std:.2g}", f" +- {zeta_std:.2g}") if f_std or zeta_std else ("", "")
            lines.append(f"{f:10.4g}{off[0]} Hz  damping ratio {zeta:.3g}{off[1]}")
        return "\n".join(lines)


class ShapeInMotion:
    """Of a shape what concerns motions about it."""

    cable: EstimatedCable
    pose: HeldPose
    equilibrium: Equilibrium

    def modes(self, count: int = 6) -> Modes:
        """Small motions about the shape, with the fixtures at rest.

        Raises
        ------
        DloError
            If the mesh has fewer modes, or if motion does not know a part of the cable.
        """
        if not isinstance(count, int | np.integer) or count < 1:
            raise DloError(f"modes: a number of modes belongs here, found {count!r}")
        moving, state, found = _modes(self.cable, self.pose, self.equilibrium, int(count))
        s = np.linspace(0.0, self.cable.length, POINTS)
        points, moved = displacements(moving, state, found.vectors, s)
        changes = [
            self._modes_of(p, rest, int(count)) - self._modes_of(-p, -rest, int(count))
            for p, rest in directions(self.cable)
        ]
        std = np.sqrt(np.sum(np.square(changes), axis=0)) if changes else np.zeros((2, count))
        return Modes(found.rates / (2 * np.pi), found.damping_ratios, moved, points, *std)

    def _modes_of(self, p: FloatArray, rest: FloatArray, count: int) -> FloatArray:
        """Frequencies and damping ratios (2, count) of the cable, changed by half of p and rest."""
        cable = replace(self.cable, p=self.cable.p + p / 2, rest=self.cable.rest + rest / 2)
        model, x = cable.model, self.equilibrium.x
        own = solve_equilibrium(model, cable.p, cable.rest, self.pose, x_init=x)
        _, _, found = _modes(cable, self.pose, own, count)
        return np.stack([found.rates / (2 * np.pi), found.damping_ratios])

    def at_rest(self) -> tuple[FloatArray, FloatArray]:
        """State (N,) and fixtures (K,) of `CableInMotion.step` of the cable at rest in this shape.

        Raises
        ------
        DloError
            If motion does not know a part of the cable.
        """
        moving = moving_cable(self.cable)
        fixtures = moving.fixtures(self.pose.vector)
        state = still(moving.at_rest(self.equilibrium, fixtures))
        return state_vector(state), fixtures_vector(moving, fixtures)


def _modes(
    cable: EstimatedCable, pose: HeldPose, equilibrium: Equilibrium, count: int
) -> tuple[MovingCable, State, DampedModes]:
    """The cable in motion about an equilibrium, its state there, and its modes."""
    moving = moving_cable(cable).about(equilibrium.x)
    fixtures = moving.fixtures(pose.vector)
    state = moving.at_rest(equilibrium, fixtures)
    return moving, state, damped_modes(moving, state, fixtures, count)


def directions(cable: EstimatedCable) -> list[tuple[FloatArray, FloatArray]]:
    """Changes of p and of the rest curvature by one std, along the covariance's principal axes."""
    known = cable.metadata.uncertainty
    both = (by @ known.root for by in known.unknowns_in(cable.model))
    return list(zip(*(x.T for x in both), strict=True))


def moving_cable(cable: EstimatedCable) -> MovingCable:
    """The cable in motion, without effects of the camera."""
    model, p = cable.model.without_kind(MeasurementEffect, cable.p)
    return MovingCable(model, p, cable.rest)
