"""How the ends of a cable are held: their positions and frames, as symbols of one pose."""

from dataclasses import dataclass, replace
from itertools import accumulate, pairwise
from typing import NamedTuple

import casadi as ca
import numpy as np

from dlo_casadi.rod.node import Node
from dlo_casadi.rod.quantities import quantity_of
from dlo_casadi.rod.quaternions import conjugate, quaternion_product, rotated
from dlo_casadi.rod.supports import SupportKind

# Forces and moments of the cable on the fixtures of its ends, in the order of `Assembly.reactions`.
REACTIONS = ("start_force", "start_moment", "end_force", "end_moment")


def clip_force(number: int) -> str:
    """Name of the force of the cable on a clip; `number` is 1 for the first clip from the start."""
    return f"clip_{number}_force"


def reaction_rows(node: type[Node], clips: int = 0) -> dict[str, slice]:
    """Slices of REACTIONS and of the forces on clips in the vector of `Assembly.reactions`.

    Forces (dimension,) [N], moments (increment,) [N m].
    """
    names = (*REACTIONS, *map(clip_force, range(1, clips + 1)))
    sizes = [len(quantity_of(name).components(node.axes)) for name in names]
    edges = pairwise(accumulate(sizes, initial=0))
    return {name: slice(*both) for name, both in zip(names, edges, strict=True)}


def deviation_names(node: type[Node], clips: int = 0) -> tuple[str, ...]:
    """Names of the unknowns that each pose of any model has of its own, in this order.

    These are deviations of the ends from declared values [m, rad], a force of unknown cause [N],
    that of the free length of a cable that slides through an end [m], and those of the clips [m].
    """
    axes, turns = node.axes, node.turns
    parts = [("end", axes), ("start", turns), ("end", turns), ("unknown_force", axes)]
    parts += [("free", ("length",))]
    parts += [(f"clip_{k}", axes) for k in range(clips)]
    return tuple(f"{what}_{name}" for what, names in parts for name in names)


def fed_ends(free: float, length: float, fed: tuple[bool, bool]) -> tuple[float, float]:
    """Arc lengths [m] of both ends on a cable of this length, `free` [m] of which is between them.

    `fed`: whether it is fed through its start, through its end; half the difference through each.
    """
    more = (free - length) / max(sum(fed), 1)
    return -more * fed[0], length + more * fed[1]


def held_turns(kind: SupportKind, node: type[Node], frame: ca.SX, x: ca.SX) -> ca.SX:
    """Turns [rad] from the frame of an end to its node x that a support of this kind holds at zero.

    Where the roll is free, those of the cable's direction: with the frame's x axis u in the axes of
    the node, u_z about its axis y and -u_y about z, whatever the roll.
    """
    turns = node.difference(frame, x)
    if node.twists and not kind.roll:
        axis = rotated(ca.vertcat(*conjugate(ca.vertsplit(x))), node.tangent(frame))
        turns = ca.vertcat(0, axis[2], -axis[1])
    held = np.flatnonzero(kind.rotations(node)).tolist()
    return ca.vertcat(ca.SX(0, 1), *(turns[k] for k in held))


class ClipConditions(NamedTuple):
    """Where and how a clip holds the cable: symbols of one pose.

    `place` (dimension,) [m]; `at` [m]: arc length; `turn` (increment,) [rad]: of a clamped clip
    from its declared frame, see `Node.moved`.
    """

    place: ca.SX
    at: ca.SX
    turn: ca.SX


@dataclass(frozen=True)
class EndConditions:
    """Where and how the ends are held: symbols of one pose.

    `start`, `end` (dimension,) [m]; `start_frame`, `end_frame` (coordinates,): the clamps in the
    form of a node, in a plane their headings [rad]. `node` is the kind of the nodes. `clips`: those
    between the ends.
    """

    start: ca.SX
    end: ca.SX
    start_frame: ca.SX
    end_frame: ca.SX
    node: type[Node]
    clips: tuple[ClipConditions, ...] = ()

    @staticmethod
    def size(node: type[Node]) -> int:
        """Size of `vector`."""
        return 2 * (node.dimension + node.coordinates)

    @classmethod
    def of(cls, values: ca.SX, node: type[Node]) -> "EndConditions":
        """Split a vector of start, end, start frame, end frame."""
        d, c = node.dimension, node.coordinates
        start, end, first, last = ca.vertsplit(values, [0, d, 2 * d, 2 * d + c, 2 * (d + c)])
        return cls(start, end, first, last, node)

    @property
    def vector(self) -> ca.SX:
        """Start, end, start frame, end frame in one vector."""
        return ca.vertcat(self.start, self.end, self.start_frame, self.end_frame)

    def rolled(self, angle: ca.SX) -> "EndConditions":
        """Return a copy whose end clamp in space is turned about its x axis [rad]."""
        roll = (ca.sin(angle / 2), ca.SX(0), ca.SX(0), ca.cos(angle / 2))
        rolled = quaternion_product(ca.vertsplit(self.end_frame), roll)
        return replace(self, end_frame=ca.vertcat(*rolled))

    def turned(self, start: ca.SX | None = None, end: ca.SX | None = None) -> "EndConditions":
        """Return a copy whose clamps are turned by increments about their own axes."""
        first, last = (
            frame if turn is None else self.node.moved(frame, turn)
            for frame, turn in ((self.start_frame, start), (self.end_frame, end))
        )
        return replace(self, start_frame=first, end_frame=last)
