"""A shape as the middle of motions: its modes, and the state of the cable at rest in it."""

from __future__ import annotations

from dataclasses import dataclass
from os import PathLike
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from dlo_casadi.arrays import FloatArray
from dlo_casadi.cable.estimate import EstimatedCable
from dlo_casadi.cable.moving_picture import draw_modes
from dlo_casadi.equilibrium.equilibrium import Equilibrium
from dlo_casadi.equilibrium.pose import HeldPose
from dlo_casadi.errors import DloError
from dlo_casadi.io.files import write_file
from dlo_casadi.model.assembly import Assembly, Inputs
from dlo_casadi.motion import modes_at_rest
from dlo_casadi.motion.anchors import Anchors
from dlo_casadi.motion.modes_at_rest import ModesAtRest
from dlo_casadi.motion.step_function import fixtures_vector, state_vector
from dlo_casadi.motion.steps import still
from dlo_casadi.motion.system import MovingCable
from dlo_casadi.show.swinging import swinging_modes

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
        return draw_modes(self.points, self.shapes, self._names, "modes")

    def animate(self, path: str | PathLike[str]) -> Path:
        """Write the swinging modes, in real time and without their damping, as an SVG that plays.

        Raises
        ------
        DloError
            If the name of the file does not end in .svg, or if it cannot be written.
        """
        file = svg_file(path)
        picture = swinging_modes(self.points, self.shapes, self.frequencies, self._names)
        write_file(file, picture)
        return file

    @property
    def _names(self) -> list[str]:
        both = zip(self.frequencies.tolist(), self.damping_ratios.tolist(), strict=True)
        return [f"{f:.3g} Hz, damping ratio {zeta:.2g}" for f, zeta in both]

    def __repr__(self) -> str:
        known = self.frequencies, self.frequency_std, self.damping_ratios, self.damping_ratio_std
        lines = []
        for f, f_std, zeta, zeta_std in zip(*(x.tolist() for x in known), strict=True):
            off = (f" +- {f_std:.2g}", f" +- {zeta_std:.2g}") if f_std or zeta_std else ("", "")
            lines.append(f"{f:10.4g}{off[0]} Hz  damping ratio {zeta:.3g}{off[1]}")
        return "\n".join(lines)


def svg_file(path: str | PathLike[str]) -> Path:
    """The name of a moving picture of modes; raises DloError if it does not end in .svg."""
    file = Path(path)
    if file.suffix.lower() != ".svg":
        raise DloError(
            f"{file}: a moving picture of modes is an SVG.\n  Try: {file.with_suffix('.svg')}"
        )
    return file


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
        cable = self.cable
        found = ModesAtRest(
            cable.model, cable.p, cable.rest, self.equilibrium, self.pose, int(count)
        )
        frequencies, ratios = found.numbers()
        points, moved = found.displacements(np.linspace(0.0, cable.length, POINTS))
        std = found.std(cable.metadata.uncertainty)
        return Modes(frequencies, ratios, moved, points, *std)

    def at_rest(self) -> tuple[FloatArray, FloatArray]:
        """State (N,) and fixtures (K,) of `CableInMotion.step` of the cable at rest in this shape.

        Raises
        ------
        DloError
            If motion does not know a part of the cable.
        """
        moving = moving_cable(self.cable, (self.equilibrium, self.pose))
        fixtures = moving.fixtures(self.pose.vector)
        state = still(moving.at_rest(self.equilibrium, fixtures))
        return state_vector(state), fixtures_vector(moving, fixtures)


def nodes_of(shape: ShapeInMotion) -> tuple[FloatArray, FloatArray]:
    """Arc lengths (n_nodes,) and places (n_nodes, d) [m] of the nodes of a shape."""
    model, eq = shape.cable.model, shape.equilibrium
    given = Inputs.of(shape.cable.p, shape.cable.rest, shape.pose.vector[None])
    found = Assembly(model, eq.shapes, given)
    return found.clipped.places[0], found.nodes()[0]


def anchors_of(shape: ShapeInMotion) -> Anchors:
    """What clips hold of a shape, and where its nodes are."""
    cable = shape.cable
    return Anchors.of(cable.model, cable.p, cable.rest, shape.equilibrium, shape.pose)


def directions(cable: EstimatedCable) -> list[tuple[FloatArray, FloatArray]]:
    """Changes of p and of the rest curvature by one std, along the covariance's principal axes."""
    return modes_at_rest.directions(cable.model, cable.metadata.uncertainty)


def moving_cable(
    cable: EstimatedCable, shape: tuple[Equilibrium, HeldPose] | None = None
) -> MovingCable:
    """The cable in motion, see `modes_at_rest.moving_cable`."""
    return modes_at_rest.moving_cable(cable.model, cable.p, cable.rest, shape)
