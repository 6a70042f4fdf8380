"""A shape as the middle of motions: its modes, and the state of the cable at rest in it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from matplotlib.figure import Figure

from dlo_casadi.arrays import FloatArray
from dlo_casadi.cable.estimate import EstimatedCable
from dlo_casadi.cable.moving_picture import draw_modes
from dlo_casadi.effects import MeasurementEffect
from dlo_casadi.equilibrium.equilibrium import Equilibrium
from dlo_casadi.equilibrium.pose import HeldPose
from dlo_casadi.errors import DloError
from dlo_casadi.motion.modes import damped_modes, displacements
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
    """

    frequencies: FloatArray
    damping_ratios: FloatArray
    shapes: FloatArray
    points: FloatArray

    def plot(self) -> Figure:
        """Draw the modes about the shape."""
        both = zip(self.frequencies.tolist(), self.damping_ratios.tolist(), strict=True)
        names = [f"{f:.3g} Hz, damping ratio {zeta:.2g}" for f, zeta in both]
        return draw_modes(self.points, self.shapes, names, "modes")

    def __repr__(self) -> str:
        rows = zip(self.frequencies.tolist(), self.damping_ratios.tolist(), strict=True)
        return "\n".join(f"{f:10.4g} Hz  damping ratio {zeta:.3g}" for f, zeta in rows)


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
        moving = moving_cable(self.cable).about(self.equilibrium.x)
        fixtures = moving.fixtures(self.pose.vector)
        state = moving.at_rest(self.equilibrium, fixtures)
        found = damped_modes(moving, state, fixtures, int(count))
        s = np.linspace(0.0, self.cable.length, POINTS)
        points, moved = displacements(moving, state, found.vectors, s)
        return Modes(found.rates / (2 * np.pi), found.damping_ratios, moved, points)

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


def moving_cable(cable: EstimatedCable) -> MovingCable:
    """The cable in motion, without effects of the camera."""
    model, p = cable.model.without_kind(MeasurementEffect, cable.p)
    return MovingCable(model, p, cable.rest)
