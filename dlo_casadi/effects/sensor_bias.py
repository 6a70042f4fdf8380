"""Sensors on the fixtures that do not show zero without a load."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Self

import casadi as ca

from dlo_casadi.effects.cable import CableData, Parameter, Setup
from dlo_casadi.effects.effect import MeasurementEffect, Params
from dlo_casadi.rod.ends import REACTIONS, clip_force

_KINDS = {"N": "force", "N m": "moment"}


@dataclass(frozen=True)
class SensorBias(MeasurementEffect):
    """A constant offset (tare) of what sensors of force and moment on fixtures show.

        measured = true + bias

    in world axes, the same in all poses: a nuisance of all wrench measurements, with the prior
    tolerances.force_bias and moment_bias, and never a finding of a diagnosis.

    Parameters
    ----------
    start_force, start_moment, end_force, end_moment : bool
        Which of them are measured. Each has its components in world axes, start_force_x [N] and so
        on; a moment in a plane is one number [N m]. They vanish at 0.
    clips : tuple of int
        Clips on which the force is measured, 1 of the first one: clip_1_force_x [N] and so on.
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
        """Names of what is measured."""
        ends = [name for name in REACTIONS if getattr(self, name)]
        return [*ends, *map(clip_force, self.clips)]

    def parameters(self, cable: CableData) -> tuple[Parameter, ...]:
        """Declare the components of what is measured."""
        force = 0.01 * 9.81 * cable.mass
        turns = ("_x", "_y", "_z") if len(cable.axes) == 3 else ("",)
        components = {"force": tuple(f"_{axis}" for axis in cable.axes), "moment": turns}
        found = []
        for name in self._measured:
            kind = name.split("_")[-1]
            unit, scale = ("N", force) if kind == "force" else ("N m", force * cable.length)
            found += [Parameter(name + x, unit, scale=scale) for x in components[kind]]
        return tuple(found)

    @classmethod
    def applies(cls, setup: Setup) -> bool:
        """Where forces or moments are measured."""
        return super().applies(setup) and bool(setup.readings)

    @classmethod
    def made_for(cls, setup: Setup) -> Self:
        """Set which components are measured."""
        ends: dict[str, Any] = {name: name in setup.readings for name in REACTIONS}
        numbers = range(1, len(setup.clips) + 1)
        return cls(**ends, clips=tuple(k for k in numbers if clip_force(k) in setup.readings))

    def prior(self, setup: Setup) -> dict[str, float]:
        """The tolerances force_bias and moment_bias."""
        known = {unit: setup.tolerances.get(f"{kind}_bias") for unit, kind in _KINDS.items()}
        stds = {q.name: known[q.unit] for q in self.parameters(setup.cable)}
        return {name: std for name, std in stds.items() if std is not None}

    def feel(self, reactions: Mapping[str, ca.SX], params: Params) -> dict[str, ca.SX]:
        """Add the bias."""
        return {
            name: value + ca.vertcat(*(params[key] for key in params if key.startswith(name)))
            if name in self._measured
            else value
            for name, value in reactions.items()
        }
