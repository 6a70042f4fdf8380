"""Clips that do not hold the cable quite where, or quite as, they are declared."""

from dataclasses import dataclass, replace
from typing import ClassVar, Self

import casadi as ca

from dlo_casadi.effects.cable import CableData, Parameter, Setup
from dlo_casadi.effects.effect import BoundaryEffect, EndConditions, Params, vector
from dlo_casadi.rod.ends import ClipConditions


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

    def moved(self, clip: ClipConditions, params: Params) -> ClipConditions:
        """Its clip, from the declared one."""
        raise NotImplementedError

    def conditions(self, ends: EndConditions, params: Params) -> EndConditions:
        """Move its clip."""
        clips = [
            self.moved(clip, params) if k == self.clip else clip
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

    def moved(self, clip: ClipConditions, params: Params) -> ClipConditions:
        """Move its place."""
        return clip._replace(place=clip.place + vector(params, "d"))


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
        return [k for k, kind in enumerate(setup.clips) if not kind.slides]

    def parameters(self, cable: CableData) -> tuple[Parameter, ...]:
        """Declare the slip."""
        return Parameter.symmetric(["ds"], "m", 0.005 * cable.length, 0.1 * cable.length)

    def moved(self, clip: ClipConditions, params: Params) -> ClipConditions:
        """Move it along the cable."""
        return clip._replace(at=clip.at + params["ds"])


@dataclass(frozen=True)
class ClipAngle(_OfOneClip):
    """True minus declared direction of one clamped clip, the same in all poses.

    In a plane heading' = heading + heading_error. In space R' = R exp(0, y, z), to second order,
    about the clip's own axes across the cable.

    Parameters
    ----------
    heading_error : scalar [rad]
        Counter-clockwise; in a plane alone. Vanishes at 0.
    y, z : scalar [rad]
        In space alone. Vanish at 0.
    """

    name = "clip_angle"
    tolerances: ClassVar = {"heading_error": "heading", "y": "rotation", "z": "rotation"}

    @classmethod
    def numbers(cls, setup: Setup) -> list[int]:
        """The clamped ones, also those in which the cable may roll."""
        return [k for k, kind in enumerate(setup.clips) if kind.direction]

    def parameters(self, cable: CableData) -> tuple[Parameter, ...]:
        """Declare the errors."""
        names = ("heading_error",) if len(cable.axes) == 2 else ("y", "z")
        return Parameter.symmetric(names, "rad", 0.05, 0.9)

    def moved(self, clip: ClipConditions, params: Params) -> ClipConditions:
        """Turn its frame."""
        if "heading_error" in params:
            return clip._replace(turn=clip.turn + params["heading_error"])
        return clip._replace(turn=clip.turn + ca.vertcat(0, params["y"], params["z"]))
