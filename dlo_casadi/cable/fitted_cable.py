"""A fitted cable with the uncertainty of its parameters, and its shape in one pose."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Self

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import ArrayLike

from dlo_casadi.arrays import FloatArray
from dlo_casadi.cable.carried import CarriedCable
from dlo_casadi.cable.estimate import CableCurve
from dlo_casadi.cable.exported import ExportedCable
from dlo_casadi.cable.held import FED, among, posed, reaction_texts, side_texts
from dlo_casadi.cable.limits import Asked, LimitCheck, check_limits
from dlo_casadi.cable.picture import draw_shape, outlines, touching
from dlo_casadi.cable.placing import Aim, Placing, placed
from dlo_casadi.cable.shape_in_motion import POINTS, ShapeInMotion
from dlo_casadi.cable.tracked import TrackedCable
from dlo_casadi.config import Clip, Obstacle, Pose
from dlo_casadi.effects import MeasurementEffect
from dlo_casadi.equilibrium.equilibrium import Equilibrium
from dlo_casadi.equilibrium.pose import Branch, HeldPose
from dlo_casadi.equilibrium.spread import (
    EDGE,
    Repeats,
    SolvedCable,
    Tipping,
    sides_of,
    spread_across,
)
from dlo_casadi.errors import EquilibriumError
from dlo_casadi.model.clips import ClipLoad, clip_rows
from dlo_casadi.model.contact import Contact, surfaces_at
from dlo_casadi.runtime.progress import Progress
from dlo_casadi.show.text import bend_radius, html_table


@dataclass(frozen=True, eq=False, repr=False)
class FittedCable(CarriedCable, TrackedCable, ExportedCable):
    """A fitted cable: its model with the fitted values and their uncertainty.

    Made by `Result.cable`, by `dlo_casadi.load` from a folder of results, or without a fit by
    `dlo_casadi.known_cable`. Use its `function` and `equations` in your own CasADi problems.

    Parameters
    ----------
    model : CableModel
    p : (n_parameters,), in the order of `model.names` (SI)
    rest : (n_rests,) [1/m]
        Rest curvature before the next pose; in space twist of all cells, then k_y, then k_z.
    metadata : Metadata
    """

    def solve(
        self,
        end: ArrayLike | Pose | None = None,
        *,
        start: ArrayLike | None = None,
        start_heading: float | None = None,
        end_heading: float | None = None,
        start_orientation: ArrayLike | None = None,
        end_orientation: ArrayLike | None = None,
        turns: float = 0.0,
        branch: Branch | None = None,
        clips: Sequence[Clip | Mapping[str, Any]] = (),
        obstacles: Sequence[Obstacle | Mapping[str, Any]] = (),
        over: bool | Mapping[str, bool] | None = None,
        end_tension: float | None = None,
        start_tension: float | None = None,
        free_length: float | None = None,
    ) -> "Shape":
        """Predict the shape of the cable in a pose.

        Of several equilibria this is the stable one of lowest energy, unless `branch`, `turns` or
        `over` selects one. If it is uncertain which is lower, the other one is in `other_side`.

        Parameters
        ----------
        end : (d,) [m], or Pose
            Where the end is held, d = 2 or 3 in space; None for a free end. Or a whole pose.
        start : (d,) [m], optional
            Where the start is held; by default as in all poses of the session, or the origin.
        start_heading, end_heading : float [rad], optional
            Directions of clamped ends in a plane, continuous along the cable; by default as start.
        start_orientation, end_orientation : (4,), optional
            Frames of clamped ends in space: quaternions (x, y, z, w), x forward along the cable.
        turns : float
            In space: number of full turns to which the twist must be nearest, see `Pose`.
        branch : "ccw" or "cw", optional
            In a plane: direction in which the cable turns from start to end. Between two pins it
            selects the first stable equilibrium found, with a clamp the lowest one. A branch that
            contradicts the headings of two clamps is an error.
        clips : sequence of Clip or dict
            Supports between the ends, in order along the cable; none by default.
        obstacles : sequence of Obstacle or dict
            Obstacles that the cable may touch, see `Obstacle`; none by default.
        over : bool or mapping of str to bool, optional
            Whether the cable passes over or under the bars among the obstacles, see `Pose`.
        end_tension, start_tension, free_length : float [N], [N], [m], optional
            Of the cable beyond a sliding end or start; or its length between the ends.

        Raises
        ------
        EquilibriumError
            If the pose has no equilibrium, e.g. out of reach, or none on the branch or side.
        DloError
            If the ends are not held as the cable's boundary requires, or are not finite numbers.
        """
        asked: dict[str, Any] = {"start": start, "end": end, "turns": turns, "branch": branch}
        asked |= {"start_heading": start_heading, "end_heading": end_heading, "clips": clips}
        asked["over"] = over
        asked |= {"start_orientation": start_orientation, "end_orientation": end_orientation}
        asked |= zip(FED, (start_tension, end_tension, free_length), strict=True)
        held, pose = posed(self, asked)
        if obstacles or over is not None:
            held = replace(held, **among(held.model, held.p, obstacles, over))
        return held._solved(pose)

    def _solved(self, pose: HeldPose) -> "Shape":
        try:
            found = SolvedCable.of(self.model, self.p, self.rest, pose)
        except EquilibriumError as error:
            happened, _, advice = error.message.partition("\n  Try: ")
            turn = max(abs(x or 0.0) for x in (pose.start_heading, pose.end_heading))
            if "cable.length" in advice:
                advice = "an end in metres, nearer to the start."
            if turn > 2 * np.pi:
                advice += f" Headings in degrees? {turn:g} degrees are {np.radians(turn):.4g} rad."
            advice = advice.replace("(model.n)", f"(`with_mesh({2 * self.model.n})`)")
            raise EquilibriumError(f"{happened}\n  Try: {advice}", p_des=error.p_des) from None
        eq = found.equilibrium
        beyond, repeats = eq.other_side, Repeats(found, self.metadata.uncertainty)
        if beyond is None or not (near := repeats.tipping(beyond)).either:
            return self.shape_in(pose, eq)
        own, others = sides_of(self.model, pose, eq, beyond)
        other_side = self.shape_in(others, beyond)
        return replace(self.shape_in(own, eq), other_side=other_side, tipping=near)

    def place(
        self,
        count: int,
        poses: Sequence[Mapping[str, Any]],
        within: ArrayLike,
        limits: Asked = None,
        *,
        aim: Aim = "margin",
        progress: Progress | None = None,
    ) -> Placing:
        """Find arc lengths and places of pinned clips that keep limits in several poses.

        Maximizes the smallest margin of all limits in all poses, or minimizes the largest force on
        fixtures and clips within the limits. Shapes are the stable ones of lowest energy; the
        optimum is the best local one of several first guesses.

        Parameters
        ----------
        count : int
            Number of clips.
        poses : sequence of mapping
            End conditions in each pose, as keywords of `solve`: [{"end": (0.3, -0.1)}, ...].
        within : ((d,), (d,)) [m], two corners of the region for clips
            For a wall they share a coordinate.
        limits : Limits or mapping, optional
            As in `Shape.check`; by default the session's.
        aim : "margin" or "force"
            The quantity to optimize; "force" needs no limits.
        progress : Progress, optional, as of `Session.fit`

        Raises
        ------
        DloError
            If no clips in the region keep the limits, if an argument is meaningless for this cable,
            or if a span has no room.
        EquilibriumError
            If the cable has no shape in one of the poses without clips.
        """
        return placed(self, count, poses, within, limits, aim, progress)

    def shape_in(self, pose: HeldPose, eq: Equilibrium) -> "Shape":
        """The shape in an equilibrium."""
        return Shape(self, pose, eq)


@dataclass(frozen=True, eq=False)
class Shape(ShapeInMotion):
    """A fitted cable in one pose; a notebook shows a short table, `print` the same as text.

    Parameters
    ----------
    cable : FittedCable
    pose : HeldPose
        End conditions; with the `turns` or the `branch` of this shape if the cable may hang on
        either of two sides.
    equilibrium : Equilibrium
    other_side : Shape or None
        The same pose on the other side: fallen to the other side with a free end, or twisted the
        other way between two clamps. Set only if it is uncertain which side is lower.
    tipping : Tipping or None
        Set with `other_side`: angle of the clamp from where both have equal energy.
    """

    cable: FittedCable
    pose: HeldPose
    equilibrium: Equilibrium
    other_side: Self | None = None
    tipping: Tipping | None = None

    @cached_property
    def held(self) -> SolvedCable:
        """The state from which an export is made, without effects of the camera."""
        model, p = self.cable.model.without_kind(MeasurementEffect, self.cable.p)
        return replace(self._measured, model=model, p=p)

    @property
    def _measured(self) -> SolvedCable:
        """The state with the effects of the camera."""
        cable = self.cable
        return SolvedCable(cable.model, cable.p, cable.rest, self.pose, self.equilibrium)

    @cached_property
    def curve(self) -> CableCurve:
        """The true curve of the cable, at any arc length: `curve.at(s)`."""
        return self._along(self.held)

    @cached_property
    def seen(self) -> CableCurve:
        """The same curve as measured by the session's camera."""
        return self._along(self._measured)

    def _along(self, held: SolvedCable) -> CableCurve:
        curve = held.curve.along(self.free_length)
        return CableCurve(curve.length, curve.nodes, curve.slopes, curve.knots)

    @property
    def free_length(self) -> float:
        """Length [m] between the ends: the cable's, beside what was fed through ends that slide."""
        return self.cable.length + self.equilibrium.fed

    @property
    def s(self) -> FloatArray:
        """Arc lengths (101,) [m] of `points` and `frames`, evenly spaced from start to end."""
        return np.linspace(0.0, self.curve.length, POINTS)

    @cached_property
    def points(self) -> FloatArray:
        """Points (101, d) [m] along the cable, at `s`; elsewhere `curve.at`."""
        return self.curve.at(self.s)

    @cached_property
    def frames(self) -> FloatArray:
        """Material frames (101, d, d) at `s`, see `CableCurve.frames`."""
        places = self.held.places - self.held.places[0]
        return self.curve.frames(self.s, places * (self.s[-1] / places[-1]), self.equilibrium.x)

    @property
    def start_force(self) -> FloatArray:
        """Force (d,) [N] of the cable on whatever holds its start."""
        return self.equilibrium.start_force

    @property
    def end_force(self) -> FloatArray:
        """Force (d,) [N] of the cable on whatever holds its end; zero at a free end."""
        return self.equilibrium.end_force

    @property
    def start_moment(self) -> FloatArray:
        """Moment [N m] of the cable on whatever holds its start, about the world's axes (3,).

        In a plane one number (), counter-clockwise; zero at a pin without a spring.
        """
        return np.asarray(self.equilibrium.moments[0])

    @property
    def end_moment(self) -> FloatArray:
        """Moment [N m] of the cable on whatever holds its end, as `start_moment`."""
        return np.asarray(self.equilibrium.moments[1])

    @property
    def clips(self) -> dict[str, ClipLoad]:
        """Per clip, by name: arc length, and force and moment of the cable on it."""
        names = (clip.name for clip in self.pose.clips)
        return dict(zip(names, self.equilibrium.clips, strict=True))

    @property
    def contacts(self) -> tuple[Contact, ...]:
        """Contacts with obstacles from start to end, with the forces on them."""
        return self.equilibrium.contacts

    @property
    def energy(self) -> float:
        """Potential energy [J]."""
        return self.equilibrium.energy

    @property
    def min_bend_radius(self) -> float:
        """Smallest radius of curvature [m] along the cable."""
        return self.equilibrium.min_bend_radius

    @property
    def stable(self) -> bool:
        """Whether the equilibrium is stable: the energy has a strict minimum."""
        return self.equilibrium.stable

    @cached_property
    def band(self) -> FloatArray:
        """Half width (101,) [m] at `s` of the band across the cable with 90 % of new repeats.

        To first order in parameter errors, scatter of fixtures and scatter of repeats.
        """
        repeats, s = Repeats(self._measured, self.cable.metadata.uncertainty), self.s
        curve, moved = repeats.displacements(s)
        return np.asarray(EDGE * np.linalg.norm(spread_across(curve, s, moved), axis=1))

    def check(self, limits: Asked = None, *, tolerances: Asked = None) -> tuple[LimitCheck, ...]:
        """Check whether a new repeat of the pose keeps limits, by default the session's.

        `tolerances`: standard deviations of fixtures other than the session's, by key: `end`,
        `length`, `clip`, `slip`, `obstacle` [m], `heading`, `rotation`, `roll` [rad].

        Raises
        ------
        ConfigError, DloError
            If there is no limit, or if a limit or tolerance is meaningless for this cable.
        """
        return check_limits(self.cable, self.pose, self.equilibrium, limits, tolerances)

    def plot(self) -> Figure:
        """Draw the shape with the forces of the cable on its supports; in a plane also its band."""
        other, forces = self.other_side, {"start": self.start_force}
        state = "stable" if self.stable else "NOT stable"
        radius = bend_radius(self.min_bend_radius)
        if self.pose.end is not None:
            forces["end"] = self.end_force
        surfaces, length = surfaces_at(self.cable.model, self.cable.p), self.curve.length
        stretches = [touching(one.start, one.end, length) for one in self.contacts]
        return draw_shape(
            self.points,
            forces,
            obstacles=[line for one in surfaces for line in outlines(one, self.points, length)],
            touching=[
                (self.curve.at(s), one.force)
                for s, one in zip(stretches, self.contacts, strict=True)
            ],
            clips={k: (self.curve.at(np.array([x.at]))[0], x.force) for k, x in self.clips.items()},
            band=None if self.cable.model.in_space else self.band,
            other=None if other is None else other.points,
            title=f"{self.cable.name}: predicted shape",
            remark=f"energy {self.energy:.4g} J, smallest bend radius {radius}, {state}",
            alarming=not self.stable,
        )

    def rows(self) -> list[tuple[str, str]]:
        """Quantities of the shape, and their values as text."""
        rows = reaction_texts(self.cable.model, self.pose, self.equilibrium, self.points)
        rows.append(("energy", f"{self.energy:.6g} J"))
        rows.append(("smallest bend radius", bend_radius(self.min_bend_radius)))
        rows.append(("stable", "yes" if self.stable else "NO: the cable would not stay there"))
        other, near = self.other_side, self.tipping
        if other is not None and near is not None:
            rows += side_texts((self._side, other._side), other.energy, self._apart(other), near)
        return rows

    def __str__(self) -> str:
        lines = [f"  {name}: {value}" for name, value in self.rows()]
        return "\n".join([f"{self.cable.name}: predicted shape", *lines])

    __repr__ = __str__

    def _repr_html_(self) -> str:
        return html_table(f"{self.cable.name}: predicted shape", self.rows())

    def as_dict(self) -> dict[str, Any]:
        """All results as plain data in SI units."""
        pose = self.pose
        return {
            "cable": self.cable.name,
            "model_hash": self.cable.metadata.model_hash,
            "length": self.cable.length,
            "start": list(pose.start),
            "end": None if pose.end is None else list(pose.end),
            **pose.directions,
            "branch": pose.branch,
            "status": "stable" if self.equilibrium.stable else "unstable",
            "stable": self.stable,
            "energy": self.energy,
            "force_on_start": self.start_force.tolist(),
            "force_on_end": self.end_force.tolist(),
            "moment_on_start": self.start_moment.tolist(),
            "moment_on_end": self.end_moment.tolist(),
            "clips": clip_rows(pose.clips, self.equilibrium.clips),
            "contacts": [contact.row for contact in self.contacts],
            "min_bend_radius": self.min_bend_radius,
            "points": self.points.tolist(),
            "band_90": self.band.tolist(),
            "other_side": self._other_row,
        }

    @property
    def _other_row(self) -> dict[str, Any] | None:
        if (other := self.other_side) is None or (near := self.tipping) is None:
            return None
        apart, tipping = self._apart(other), {"tipping": near.angle, "tipping_std": near.std}
        return {**tipping, "greatest_distance": apart, **other.as_dict()}

    def _apart(self, other: "Shape") -> float:
        """Largest distance [m] of points at equal arc lengths."""
        return float(np.linalg.norm(other.points - self.points, axis=1).max())

    @property
    def _side(self) -> str:
        """Entry of a configuration that selects the side on which the cable hangs."""
        branch, turns = self.pose.branch, self.pose.turns
        return f"branch: {branch}" if branch else f"turns: {turns:g}"
