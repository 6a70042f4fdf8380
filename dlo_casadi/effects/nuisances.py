"""Systematic errors of sensors and of edges in pictures, estimated in every fit, never blamed."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, Self

import casadi as ca

from dlo_casadi.effects.cable import CableData, Parameter, Setup
from dlo_casadi.effects.effect import MeasurementEffect, Params, Viewpoint
from dlo_casadi.rod.ends import REACTIONS, clip_force
from dlo_casadi.rod.quantities import QUANTITIES, quantity_of


@dataclass(frozen=True)
class SensorBias(MeasurementEffect):
    """A constant offset (tare) of what sensors of force and moment on fixtures show.

        measured = true + bias

    in world axes, the same in all poses. It is a nuisance of all wrench measurements, with the
    prior tolerances.force_bias and moment_bias, and never a finding of a diagnosis.

    Parameters
    ----------
    start_force, start_moment, end_force, end_moment : bool
        Which of them are measured. Each has components in world axes, start_force_x [N] and so on;
        a moment in a plane is one number [N m]. They vanish at 0.
    clips : tuple of int
        Clips on which the force is measured, 1 for the first: clip_1_force_x [N] and so on.
    """

    name = "sensor_bias"
    shown = False

    start_force: bool = True
    start_moment: bool = True
    end_force: bool = True
    end_moment: bool = True
    clips: tuple[int, ...] = ()

    @property
    def _measured(self) -> list[str]:
        ends = [name for name in REACTIONS if getattr(self, name)]
        return [*ends, *map(clip_force, self.clips)]

    def parameters(self, cable: CableData) -> tuple[Parameter, ...]:
        """Declare the components of what is measured."""
        force = 0.01 * 9.81 * cable.mass
        return tuple(
            Parameter("_".join(filter(None, (name, axis))), own.unit, scale=scale)
            for name in self._measured
            for own in (quantity_of(name),)
            for scale in (own.scale(force, cable.length),)
            for axis in own.components(cable.axes)
        )

    @classmethod
    def applies(cls, setup: Setup) -> bool:
        """True if forces or moments are measured."""
        return super().applies(setup) and bool(setup.readings)

    @classmethod
    def made_for(cls, setup: Setup) -> Self:
        """Set which components are measured."""
        ends: dict[str, Any] = {name: name in setup.readings for name in REACTIONS}
        numbers = range(1, len(setup.clips) + 1)
        return cls(**ends, clips=tuple(k for k in numbers if clip_force(k) in setup.readings))

    def prior(self, setup: Setup) -> dict[str, float]:
        """The tolerances force_bias and moment_bias."""
        known = {own.unit: setup.tolerances.get(own.bias_key) for own in QUANTITIES}
        stds = {q.name: known[q.unit] for q in self.parameters(setup.cable)}
        return {name: std for name, std in stds.items() if std is not None}

    def feel(self, reactions: Mapping[str, ca.SX], params: Params) -> dict[str, ca.SX]:
        """Add the bias."""
        felt = dict(reactions)
        for name in self._measured:
            if name in felt:
                felt[name] += ca.vertcat(*(params[key] for key in params if key.startswith(name)))
        return felt


# Harmonics of the cable's direction: light from one side shifts the whole picture, which is the
# first; the grid of pixels has the fourth. Evidence from three rendered sessions of photographs:
# without any harmonic, all have a wrong EI (1 to 2 %, outside its interval) and one an effect that
# does not exist. With one, or up to the third, two of them are `unexplained`. With four all are
# correct, and six are no more accurate.
HARMONICS = range(1, 5)
# Standard deviation of each harmonic, in pixels.
PIXELS = 0.05


class EdgeBias(MeasurementEffect):
    """The middle between two edges is off by a share of a pixel that depends on their direction.

        measured = true + N(phi) sum_k (a_k cos k phi + b_k sin k phi)

    with the normal N to the left of the cable's direction phi. Causes are light from one side, the
    grid of pixels and the sharpening of a camera. It is a nuisance of every photograph, the same in
    all of them, and never a finding.

    Parameters
    ----------
    a1, b1, ..., a4, b4 : scalar [m]
        Vanish at 0.
    """

    name = "edge_bias"
    photographed: ClassVar = True
    dimensions = (2,)
    shown: ClassVar = False
    declared = tuple(Parameter(f"{x}{k}", "m", scale=1e-4) for k in HARMONICS for x in ("a", "b"))

    @classmethod
    def applies(cls, setup: Setup) -> bool:
        """True if there are photographs."""
        return super().applies(setup) and setup.pixel is not None

    def prior(self, setup: Setup) -> dict[str, float]:
        """A share of a pixel for each coefficient; no prior without pixels."""
        std = PIXELS * (setup.pixel or 0.0)
        return {q.name: std for q in self.parameters(setup.cable)} if std else {}

    def observe(self, point: ca.SX, frame: ca.SX, viewpoint: Viewpoint, params: Params) -> ca.SX:
        """Move the point along the cable's normal."""
        offset = ca.SX(0)
        for k in HARMONICS:
            offset += params[f"a{k}"] * ca.cos(k * frame) + params[f"b{k}"] * ca.sin(k * frame)
        return point + offset * ca.vertcat(-ca.sin(frame), ca.cos(frame))
