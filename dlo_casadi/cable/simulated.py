"""A simulated motion, and the state from which one begins."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from os import PathLike
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import ArrayLike
from scipy.interpolate import CubicSpline

from dlo_casadi.arrays import FloatArray
from dlo_casadi.cable.estimate import EstimatedCable
from dlo_casadi.cable.moving_picture import draw_motion, frame_times, moving_picture
from dlo_casadi.cable.shape_in_motion import POINTS, ShapeInMotion, anchors_of, nodes_of
from dlo_casadi.equilibrium.equilibrium import Equilibrium
from dlo_casadi.equilibrium.pose import HeldPose
from dlo_casadi.errors import DloError, counted
from dlo_casadi.io.files import write_file
from dlo_casadi.model.clipped import alike
from dlo_casadi.motion.equations import unknowns_of
from dlo_casadi.motion.state import Fixtures, State
from dlo_casadi.motion.system import MovingCable
from dlo_casadi.motion.trajectory import Way

# Distance [lengths] and angle [rad] between a shape and its fixtures from which it is another one.
_OFF, _ASKEW = 0.01, 0.1
# Distance [lengths] by which both ends of a shape may be nearer or farther apart than the fixtures:
# the first step makes up for it, and has no solution from about 1e-6 on.
_APART = 3e-7


@dataclass(frozen=True, eq=False, repr=False)
class Motion:
    """A cable in motion.

    Parameters
    ----------
    cable : EstimatedCable
    t : (T,) [s]
    way : Way
        The states at the ends of all steps.
    """

    cable: EstimatedCable
    t: FloatArray
    way: Way

    @property
    def s(self) -> FloatArray:
        """Arc lengths (101,) [m] of `points`, evenly spaced."""
        return np.linspace(0.0, self.cable.length, POINTS)

    @cached_property
    def points(self) -> FloatArray:
        """Points (T, 101, d) [m] along the cable, at `s`."""
        return self.at(self.s)

    def at(self, s: ArrayLike) -> FloatArray:
        """Points (T, K, d) [m] at arc lengths s (K,) [m].

        Raises
        ------
        DloError
            If these are no arc lengths on the cable.
        """
        length = self.cable.length
        try:
            places = np.atleast_1d(np.asarray(s, dtype=float))
        except (TypeError, ValueError):
            places = np.full(1, np.nan)
        if places.ndim != 1 or not (np.abs(places / length - 0.5) <= 0.5 + 1e-9).all():
            raise DloError(f"s: arc lengths of 0 to {length:g} m belong here, found {s!r}")
        return self.way.points(self.t, places)

    @cached_property
    def start_force(self) -> FloatArray:
        """Force (T, d) [N] of the cable on whatever holds its start."""
        return self.way.at(self.t, self.way.forces[0])

    @cached_property
    def end_force(self) -> FloatArray:
        """Force (T, d) [N] of the cable on whatever holds its end; zero at a free end."""
        return self.way.at(self.t, self.way.forces[1])

    @cached_property
    def clip_forces(self) -> dict[str, FloatArray]:
        """Forces (T, d) [N] of the cable on its clips, by their names."""
        found = self.way.at(self.t, self.way.clip_forces)
        names = (clip.name for clip in self.way.path.pose.clips)
        return dict(zip(names, np.moveaxis(found, 1, 0), strict=True))

    @cached_property
    def energy(self) -> FloatArray:
        """Kinetic and potential energy (T,) [J]."""
        return self.way.at(self.t, self.way.energy)

    def plot(self) -> Figure:
        """Draw instants of the motion."""
        title, free = f"{self.cable.name}: motion", not self.cable.model.end.place
        return draw_motion(self.points, self.t, title, self._clips, tip=free)

    @property
    def _clips(self) -> FloatArray:
        """Places (k, d) [m] of clips as declared."""
        return np.array([clip.place for clip in self.way.path.pose.clips])

    def animate(self, path: str | PathLike[str]) -> Path:
        """Write the motion in real time as a GIF; return its path.

        Raises
        ------
        DloError
            If the name does not end in .gif, or if the file cannot be written.
        """
        file = gif_file(path)
        times = frame_times(float(self.t[0]), float(self.t[-1]))
        points = self.way.points(times, self.s)
        write_file(file, moving_picture(points, times, f"{self.cable.name}: motion", self._clips))
        return file

    @property
    def unknowns(self) -> list[dict[str, FloatArray]]:
        """Arguments x, v, a and multipliers of `motion_equations` at the ends of all steps.

        Raises DloError if clips hold the cable, or did before: these equations know none.
        """
        if self.way.cable.anchors is not None:
            raise DloError(
                "unknowns: `motion_equations` knows no clips, and these nodes stand at clips.\n"
                "  Try: a motion without clips, or cable.step(dt, about=shape)."
            )
        both = zip(self.way.states, *self.way.forces, strict=True)
        return [unknowns_of(self.way.cable, state, (first, last)) for state, first, last in both]

    def __repr__(self) -> str:
        first, last, steps = self.t[0], self.t[-1], len(self.way.t) - 1
        lines = [f"{self.cable.name}: {first:g} to {last:g} s in {counted(steps, 'step')}"]
        ends = {"its start": self.start_force, "its end": self.end_force}
        for where, force in {**ends, **self.clip_forces}.items():
            largest = np.linalg.norm(force, axis=1).max()
            lines.append(f"  largest force on {where}: {largest:.4g} N")
        return "\n".join(lines)


def gif_file(path: str | PathLike[str]) -> Path:
    """The name of a moving picture; raises DloError if it does not end in .gif."""
    file = Path(path)
    if file.suffix.lower() != ".gif":
        raise DloError(f"{file}: moving pictures are GIF.\n  Try: {file.with_suffix('.gif')}")
    return file


def begun(
    cable: EstimatedCable,
    moving: MovingCable,
    pose: HeldPose,
    rest: Equilibrium,
    begins: ShapeInMotion | Motion | None,
) -> State:
    """The state from which a motion begins."""
    if isinstance(begins, Motion):
        state = begins.way.states[-1]
        _check_ends(moving, pose, "motion", state.r[[0, -1]], state.x)
        x, fixtures = _in_clamps(moving, pose, state.x), _around(moving, pose, state.r)
        if np.array_equal(x, state.x) and np.array_equal(fixtures.places[0], state.r[0]):
            return state
        return moving.with_places(replace(state, x=x), fixtures)
    if begins is None:
        return moving.at_rest(rest, moving.fixtures(pose.vector))
    if not isinstance(begins, ShapeInMotion):
        raise DloError(f"begins: a shape or a motion belongs here, found {begins!r}")
    x, places = begins.equilibrium.x, moving.along
    if x.shape[1] != moving.model.node.coordinates:
        raise DloError("begins: a shape in space cannot move in a plane, nor the reverse")
    if not begins.cable.model.chain.kind.smooth:
        raise DloError(
            "begins: a shape of links belongs to no motion.\n  Try: 'quadratic' elements"
        )
    known, points = nodes_of(begins)
    if not np.allclose(known[[0, -1]], [0.0, cable.length]):
        raise DloError(
            f"begins: the shape is of a cable from {known[0]:.4g} to {known[-1]:.4g} m, this one "
            f"is {cable.length:.4g} m long.\n  Try: the same length, without an end that slides."
        )
    nodes = moving.model.node.interpolated(places, known, x)
    if moving.anchors is not None:
        nodes = moving.anchors.held(nodes)
    near = CubicSpline(known, points)(places)
    _check_ends(moving, pose, "shape", begins.equilibrium.points[[0, -1]], nodes)
    _check_clips(moving, pose, near)
    force = np.zeros((moving.n_segments, moving.d * (1 + 2 * moving.model.n_springs)))
    nodes = _in_clamps(moving, pose, nodes)
    state = moving.still_state(nodes, force, np.zeros(moving.n_moments))
    return moving.with_places(state, _around(moving, pose, near), near)


def _around(moving: MovingCable, pose: HeldPose, near: FloatArray) -> Fixtures:
    """Fixtures that hold nodes where they are, but for a shift that brings them to the start.

    `near` (n_nodes, d) [m]. What fixtures are off by then is made up in the first step.
    """
    fixtures = moving.fixtures(pose.vector)
    places, shift = fixtures.places.copy(), fixtures.places[0] - near[0]
    for k, node in moving.held[1:]:
        places[k] = near[node] + shift
    return replace(fixtures, places=places)


def _in_clamps(moving: MovingCable, pose: HeldPose, x: FloatArray) -> FloatArray:
    """Nodes (n_nodes, coordinates) with the frames of the clamps at both ends."""
    x, model = x.copy(), moving.model
    for kind, k, frame in zip((model.start, model.end), (0, -1), pose.frames, strict=True):
        if kind.rotations(model.node).all():
            x[k] = alike(np.array([frame]), x[[k]])[0]
    return x


def on_the_mesh_of(begins: ShapeInMotion | Motion | None, cable: MovingCable) -> MovingCable:
    """The cable on the nodes from which it begins, if no clip needs others.

    Raises DloError if a motion is continued with other clips.
    """
    own, before = cable.anchors, None
    if isinstance(begins, Motion):
        before = begins.way.cable.anchors
        if own is not None and not (before is not None and own.like(before)):
            raise DloError(
                "begins: a motion is continued with the clips that it has, or without any.\n"
                "  Try: the same clips."
            )
    elif isinstance(begins, ShapeInMotion) and begins.cable.model.clips:
        before = anchors_of(begins)
    if own is not None or before is None or len(before.along) != cable.n_nodes:
        return cable
    return MovingCable(cable.model, cable.p, cable.rest, anchors=before.released())


def _check_clips(moving: MovingCable, pose: HeldPose, near: FloatArray) -> None:
    """Raise an error if clips hold the cable elsewhere than it is, at nodes `near` [m]."""
    if moving.anchors is None:
        return
    for clip, node in zip(pose.clips, moving.anchors.nodes, strict=True):
        off = float(np.linalg.norm(near[node] - clip.place))
        if off > _OFF * moving.model.cable.length:
            raise DloError(
                f"begins: at {moving.along[node]:.4g} m the shape is {1e3 * off:.3g} mm from "
                f"{clip.name}.\n  Try: its place, or a shape that it holds."
            )


def _check_ends(
    moving: MovingCable, pose: HeldPose, what: str, points: FloatArray, nodes: FloatArray
) -> None:
    """Raise an error if fixtures hold the cable elsewhere than what it begins with.

    `points` (2, d) [m] of its ends; `nodes` (n_nodes, coordinates).
    """
    model = moving.model
    sides = zip(("start", "end"), (model.start, model.end), (0, -1), pose.frames, strict=True)
    for side, kind, k, frame in sides:
        place, length = getattr(pose, side), model.cable.length
        if kind.place and (off := float(np.linalg.norm(points[k] - place))) > _OFF * length:
            raise DloError(
                f"begins: the {side} of the {what} is {1e3 * off:.3g} mm from its fixture.\n"
                f"  Try: {side}={tuple(np.round(points[k], 6).tolist())} at the first instant."
            )
        turn = model.node.difference(frame, nodes[k])[kind.rotations(model.node)]
        if np.abs(turn).max(initial=0.0) > _ASKEW:
            raise DloError(
                f"begins: the {what} leaves its clamp at the {side} turned by "
                f"{np.abs(turn).max():.3g} rad.\n  Try: the clamp's direction of the {what}, at "
                "the first instant."
            )
    if pose.end is not None:
        apart = np.subtract(pose.end, pose.start)
        if (off := float(np.linalg.norm(points[1] - points[0] - apart))) > _APART * length:
            start, end = (tuple(x.tolist()) for x in points)
            raise DloError(
                f"begins: from start to end the {what} is {1e3 * off:.3g} mm off its fixtures.\n"
                f"  Try: start={start}, end={end} at the first instant."
            )
