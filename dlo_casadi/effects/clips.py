"""Clips that are not quite where, or do not hold the cable quite where, they are declared."""

from dataclasses import dataclass, replace
from typing import ClassVar, Self

import casadi as ca

from dlo_casadi.effects.cable import CableData, Parameter, Setup
from dlo_casadi.effects.effect import BoundaryEffect, EndConditions, Params, vector


@dataclass(frozen=True)
class _OfOneClip(BoundaryEffect):
    """An effect of one clip, the same in all poses; `clip` is its index, 0 for the first."""

    index = "clip"
    clip: int = 0

    @classmethod
    def numbers(cls, setup: Setup) -> list[int]:
        """Indices of the clips that may have it."""
        return list(range(len(setup.clips)))

    @classmethod
    def impossible(cls, setup: Setup) -> str:
        """It needs such a clip."""
        if cls.numbers(setup):
            return super().impossible(setup)
        listed = ", ".join(setup.clips) or "none"
        return f"it is of a clip, and the poses have {listed}. Try: clips of the poses"

    @classmethod
    def made_for(cls, setup: Setup) -> Self:
        """The effect of the first clip that may have it."""
        return cls(clip=next(iter(cls.numbers(setup)), 0))

    @classmethod
    def each_for(cls, setup: Setup) -> tuple[Self, ...]:
        """One for each clip that may have it."""
        return tuple(cls(clip=k) for k in cls.numbers(setup))

    def moved(self, place: ca.SX, at: ca.SX, params: Params) -> tuple[ca.SX, ca.SX]:
        """Place (dimension,) and arc length of its clip, from the declared ones."""
        raise NotImplementedError

    def conditions(self, ends: EndConditions, params: Params) -> EndConditions:
        """Move its clip."""
        clips = [
            self.moved(*clip, params) if k == self.clip else clip
            for k, clip in enumerate(ends.clips)
        ]
        return replace(ends, clips=tuple(clips))


@dataclass(frozen=True)
class ClipOffset(_OfOneClip):
    """True minus declared place of one clip, the same in all poses.

        place' = place + (dx, dy (, dz))

    Parameters
    ----------
    dx, dy, dz : scalar [m]
        Vanish at 0; dz in space alone.
    """

    name = "clip_offset"
    tolerances: ClassVar = {"dx": "clip", "dy": "clip", "dz": "clip"}

    def parameters(self, cable: CableData) -> tuple[Parameter, ...]:
        """Declare the offset."""
        names = (f"d{axis}" for axis in cable.axes)
        return Parameter.symmetric(names, "m", 0.002 * cable.length, 0.1 * cable.length)

    def moved(self, place: ca.SX, at: ca.SX, params: Params) -> tuple[ca.SX, ca.SX]:
        """Move its place."""
        return place + vector(params, "d"), at


@dataclass(frozen=True)
class ClipSlip(_OfOneClip):
    """True minus declared arc length at which one clip holds the cable, the same in all poses.

        at' = at + ds

    Parameters
    ----------
    ds : scalar [m]
        Vanishes at 0.
    """

    name = "clip_slip"
    tolerances: ClassVar = {"ds": "slip"}

    @classmethod
    def numbers(cls, setup: Setup) -> list[int]:
        """All but eyelets, through which the cable slides anyway."""
        return [k for k, kind in enumerate(setup.clips) if kind != "eyelet"]

    def parameters(self, cable: CableData) -> tuple[Parameter, ...]:
        """Declare the slip."""
        return Parameter.symmetric(["ds"], "m", 0.005 * cable.length, 0.1 * cable.length)

    def moved(self, place: ca.SX, at: ca.SX, params: Params) -> tuple[ca.SX, ca.SX]:
        """Move it along the cable."""
        return place, at + params["ds"]
