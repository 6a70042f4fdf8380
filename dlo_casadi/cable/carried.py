"""A fitted cable that is carried: motions of its fixtures after which it is at rest."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from dlo_casadi.cable.held import among
from dlo_casadi.cable.motion import CableInMotion
from dlo_casadi.cable.move import Move
from dlo_casadi.cable.move_checks import checked_limits, checked_pose, number
from dlo_casadi.cable.move_limits import require_rest
from dlo_casadi.cable.planner import Planner, Shape
from dlo_casadi.config import Obstacle
from dlo_casadi.errors import DloError, EquilibriumError
from dlo_casadi.planning.course import Course
from dlo_casadi.runtime.progress import Progress, nobody


class CarriedCable(CableInMotion):
    """A fitted cable that is carried."""

    if TYPE_CHECKING:

        def solve(self, *pose: Any, **held: Any) -> Any:
            """See `FittedCable.solve`."""

    def move(
        self,
        before: Shape | Mapping[str, Any],
        after: Shape | Mapping[str, Any],
        *,
        duration: float | None = None,
        limits: Mapping[str, float] | None = None,
        obstacles: Sequence[Obstacle | Mapping[str, Any]] = (),
        robust: bool = False,
        progress: Progress | None = None,
    ) -> Move:
        """A motion of the fixtures from one pose to another after which the cable is at rest.

        What differs between both poses moves, smooth to the third derivative. Its least effort is
        sought for which nothing swings on arrival: direct single shooting to IPOPT, from the motion
        of least jerk. The result is verified by a simulation on the cable's own mesh.

        Parameters
        ----------
        before, after : Shape or mapping
            Shapes of this cable, or keywords of `solve`: {"start": (0, 0), "start_heading": -1.2}.
        duration : float [s], optional
            By default the shortest one that keeps the limits and leaves a swing of a thousandth
            of the length at most, unless `swing` is among the limits.
        limits : mapping, optional
            Largest `speed` [m/s], `acceleration` [m/s^2] and `jerk` [m/s^3] of fixtures' places,
            `turn_speed` [rad/s] and `turn_acceleration` [rad/s^2] of its direction; `force` [N] and
            `moment` [N m] of the cable on each fixture; smallest `bend_radius` [m] and `clearance`
            [m] of the cable's surface from obstacles; along the whole way and a period beyond.
            `swing` [m]: what 95 % of the cables under the covariance shall stay below on arrival.
        obstacles : sequence of Obstacle or dict
            What the cable must not touch, as in `solve`.
        robust : bool
            Whether the mean square of the swing under the parameters' covariance is minimised,
            instead of the swing of the likeliest cable.
        progress : Progress, optional, as of `Session.fit`

        Raises
        ------
        DloError
            If no such motion keeps the limits, with what it would need and the shortest duration
            that was found to keep them; or for meaningless input.
        MotionError
            If the cable cannot follow, e.g. if an end is torn out of reach.
        EquilibriumError
            If the cable has no shape in one of the poses.
        """
        asked = checked_limits(limits, obstacles)
        shapes: list[Any] = []
        time = None if duration is None else number("duration", duration)
        for name, given in (("before", before), ("after", after)):
            pose = checked_pose(self, name, given)
            try:
                shapes.append(given if pose is None else self.solve(**pose))
            except EquilibriumError:
                raise
            except DloError as error:
                raise DloError(f"{name}: {error.message}") from None
        first, last = shapes
        if not Course.between(first.pose, last.pose, 1.0).parts:
            raise DloError("move: both poses are the same, nothing moves")
        surfaces = among(self.model, self.p, obstacles)["model"].obstacles if obstacles else ()
        if robust and not self.metadata.uncertainty.names:
            raise DloError("robust: this cable is known exactly, nothing of it is unsure")
        step = nobody if progress is None else progress.step
        planner = Planner(self, first, last, asked, tuple(surfaces), robust, step)
        for name, shape in (("before", first), ("after", last)):
            require_rest(self, name, shape, asked, surfaces)
        return planner.fastest() if time is None else planner.within(time)
