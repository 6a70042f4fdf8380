"""End conditions of one pose as declared."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, Literal, Self

import numpy as np

from dlo_casadi.arrays import FloatArray
from dlo_casadi.model.clips import HeldClip
from dlo_casadi.rod.node import Frame, Heading, Node
from dlo_casadi.rod.quaternions import quaternion_product
from dlo_casadi.rod.supports import SupportKind

Branch = Literal["ccw", "cw"]
# In a session, a pose may also continue the pose before it, see `solve.continued`.
PoseBranch = Branch | Literal["previous"]

# Sign of the turning from start to end on a branch.
SIGNS: dict[Branch, int] = {"ccw": 1, "cw": -1}


@dataclass(frozen=True)
class HeldPose:
    """End conditions of one pose as declared.

    Parameters
    ----------
    start, end : (dimension,) [m]
        `end` is None for a free end.
    start_heading, end_heading : float [rad] or None
        Directions of clamped ends in a plane, continuous along the cable.
    start_orientation, end_orientation : (4,) or None
        Frames of clamped ends in space: unit quaternions (x, y, z, w), x forward along the cable.
    turns : float
        In space, selects the twist about the cable's axis with which its end fits the clamp: the
        one nearest to this number of full turns; +-0.5 select either direction of half a turn. The
        twist is that beyond the last clamped clip, if one holds the cable's roll. For 0 and a clamp
        rolled by half a turn within 1 rad, the direction of lower energy is taken.
    branch : "ccw", "cw" or "previous", optional
        Which way the cable turns from start to end: the sign of `Equilibrium.turn`. "previous"
        is the equilibrium that follows from the pose before, see `solve.continued`.
    name : str
    camera_center : (float, float, float), optional [m]
        Position of the camera: x, y in the board frame, z in front of the cable's declared plane.
    clips : tuple of HeldClip
        What holds the cable between its ends, in the order along it.
    over : bool or mapping of str to bool, optional
        Whether the cable passes over or under bars, see `Capsule.passed`: for all, or by name.
    start_tension, end_tension : float [N], optional
        Of the cable beyond a sliding start or end, which pulls it out.
    free_length : float [m], optional
        Length between the ends of a cable that slides through one; instead of the tension there.
    """

    start: tuple[float, ...]
    end: tuple[float, ...] | None = None
    start_heading: float | None = None
    end_heading: float | None = None
    start_orientation: tuple[float, ...] | None = None
    end_orientation: tuple[float, ...] | None = None
    turns: float = 0.0
    branch: PoseBranch | None = None
    name: str = "pose"
    camera_center: tuple[float, float, float] | None = None
    clips: tuple[HeldClip, ...] = ()
    over: bool | Mapping[str, bool] | None = field(default=None, hash=False)
    end_tension: float | None = None
    start_tension: float | None = None
    free_length: float | None = None

    @property
    def node(self) -> type[Node]:
        """Kind of the nodes of a cable held in this way: headings in a plane, frames in space."""
        return Heading if len(self.start) == 2 else Frame

    @property
    def _direction_names(self) -> tuple[str, str]:
        return f"start_{self.node.direction}", f"end_{self.node.direction}"

    @property
    def directions(self) -> dict[str, Any]:
        """Directions of the ends, by their keys in a session file."""
        known = {name: getattr(self, name) for name in self._direction_names}
        known = {name: list(x) if isinstance(x, tuple) else x for name, x in known.items()}
        return {**known, "turns": self.turns} if self.node.twists else known

    @cached_property
    def ends(self) -> FloatArray:
        """Start, end [m], start frame, end frame: see `EndConditions.vector`."""
        end = self.end if self.end is not None else (0.0,) * len(self.start)
        return np.concatenate([self.start, end, *self.frames])

    @property
    def span(self) -> float:
        """Distance [m] of the end from the start; 0 for a free end."""
        return 0.0 if self.end is None else math.dist(self.start, self.end)

    @cached_property
    def frames(self) -> tuple[FloatArray, FloatArray]:
        """Frames (coordinates,) of both ends as nodes carry them: in a plane headings [rad]."""
        known = (getattr(self, name) or self.node.identity for name in self._direction_names)
        first, last = (self.node.normalised(np.atleast_1d(np.array(x, dtype=float))) for x in known)
        return first, last

    def moved(self, start: FloatArray, end: FloatArray, frames: Sequence[FloatArray]) -> Self:
        """The same pose with other ends; a free end stays free."""
        values = map(self.node.declared, frames)
        held: dict[str, Any] = dict(zip(self._direction_names, values, strict=True))
        end_place = None if self.end is None else tuple(end)
        return replace(self, start=tuple(start), end=end_place, **held)

    def on_the_way(self, before: HeldPose, share: float) -> Self:
        """The pose at a share of the way from `before`: ends, clips and frames move evenly."""

        def place(a: FloatArray, b: FloatArray) -> FloatArray:
            return np.asarray(a + share * (b - a))

        def frame(a: FloatArray, b: FloatArray) -> FloatArray:
            return self.node.interpolated(np.array([share]), np.arange(2.0), np.array([a, b]))[0]

        d, clips = 2 * self.node.dimension, []
        start, end = place(before.ends[:d], self.ends[:d]).reshape(2, -1)
        for one, own in zip(before.clips, self.clips, strict=True):
            held: dict[str, Any] = {"place": tuple(place(np.array(one.place), np.array(own.place)))}
            if one.at is not None and own.at is not None:
                held["at"] = one.at + share * (own.at - one.at)
            if one.frame is not None and own.frame is not None:
                held[self.node.direction] = self.node.declared(frame(one.frame, own.frame))
            clips.append(replace(own, **held))
        frames = [frame(*both) for both in zip(before.frames, self.frames, strict=True)]
        return replace(self.moved(start, end, frames), clips=tuple(clips))

    def joined(self, points: FloatArray) -> FloatArray:
        """Points (K, d) [m] along the cable, with its start before them and its held end after."""
        end = [] if self.end is None else [np.array(self.end)[None]]
        return np.concatenate([np.array(self.start)[None], points, *end])

    def rolled(self, angle: float) -> Self:
        """The pose with its end clamp, in space, turned about its x axis [rad]."""
        if self.end_orientation is None:
            return self
        roll = (np.sin(angle / 2), 0.0, 0.0, np.cos(angle / 2))
        turned = quaternion_product(self.end_orientation, roll)
        return replace(self, end_orientation=tuple(float(x) for x in turned))

    @property
    def numbers(self) -> FloatArray:
        """The numbers of dlo_pose in the C header, in their order; 0 or identity where not held.

        Start, end [m]; in a plane the headings of both [rad], in space their quaternions and the
        turns; tensions beyond ends that slide [N], or the free length [m]; then of each clip its
        arc length and place [m] and, if one holds a direction, frames.
        """
        turns = [self.turns] if self.node.twists else []
        held, clips = any(clip.kind.direction for clip in self.clips), []
        for clip in self.clips:
            frame = self.node.identity if clip.frame is None else clip.frame
            clips += [clip.at or 0.0, *clip.place, *(frame if held else ())]
        beyond = [x for x in (*self.tensions, self.free_length) if x is not None]
        return np.array([*self.ends, *turns, *beyond, *clips], dtype=float)

    @property
    def vector(self) -> FloatArray:
        """The model's argument `pose`: ends, camera (`effects.Viewpoint`), tensions, clips.

        The camera's centre (x, y, z) enters as (x, y, 1) / z: zeros if it is not known. Instead of
        tensions it may have the free length.
        """
        x, y, z = self.camera_center or (0.0, 0.0, np.inf)
        clips = (clip.vector(self.node) for clip in self.clips)
        camera = np.array([x, y, 1.0]) / z
        beyond = [x for x in (*self.tensions, self.free_length) if x is not None]
        return np.concatenate([self.ends, camera, beyond, *clips])

    def wrongly_fed(self, held: Sequence[SupportKind], *, by_length: bool) -> str:
        """What is missing or too much for ends `held` (start, end) so; empty if nothing is."""
        for side, kind, tension in zip(("start", "end"), held, self.tensions, strict=True):
            if (kind.slides and not by_length) != (tension is not None):
                is_it = f"is {tension:g} N" if tension is not None else "is missing"
                text = f"the {side} of the cable is {kind}, {side}_tension {is_it}"
                if not kind.slides or self.free_length is None:
                    return text
                return f"{text}, free_length {self.free_length:g} m: one determines the other"
        slides = any(kind.slides for kind in held)
        if (slides and by_length) != (self.free_length is not None):
            is_it = f"is {self.free_length:g} m" if self.free_length is not None else "is missing"
            return f"the ends of the cable are {held[0]} and {held[1]}, free_length {is_it}"
        return ""

    @property
    def tensions(self) -> tuple[float | None, float | None]:
        """Tensions [N] of the cable beyond both ends."""
        return self.start_tension, self.end_tension


def pose_numbers(pose: object) -> Any:
    """The numbers of a pose that has them, as a session's; anything else as it is."""
    if isinstance(pose, HeldPose):
        return pose.numbers
    vector = getattr(pose, "vector", None)
    return vector() if callable(vector) else pose


def pose_branch(pose: object, branch: Branch | None) -> Any:
    """The branch asked for, else that of the pose if it has one."""
    return getattr(pose, "branch", None) if branch is None else branch
