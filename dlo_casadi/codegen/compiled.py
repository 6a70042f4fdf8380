"""CompiledSolver: the generated C solver, compiled and called from Python."""

import ctypes
import shutil
import tempfile
import weakref
from collections.abc import Mapping, Sequence
from functools import partial
from numbers import Real
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dlo_casadi.arrays import FloatArray
from dlo_casadi.codegen.compiler import compile_library, workspace_of
from dlo_casadi.codegen.generate import generate
from dlo_casadi.codegen.obstacles import row_of
from dlo_casadi.codegen.shapes import (
    QUANTITIES,
    AnyObstacle,
    AnyPose,
    CompiledShape,
    Gap,
    ShapePath,
    Slope,
    Usage,
    pose_table,
    records_of,
    surfaces_of,
)
from dlo_casadi.codegen.statuses import STATUSES, no_equilibrium
from dlo_casadi.codegen.stepper import CompiledStepper
from dlo_casadi.equilibrium.pose import Branch
from dlo_casadi.errors import DloError, EquilibriumError, counted
from dlo_casadi.model.cable_model import CableModel
from dlo_casadi.motion.system import MovingCable
from dlo_casadi.rod.obstacles import Obstacle, Plane

# Poses, or rows of numbers in the layout of dlo_pose in the C header.
Poses = Sequence[AnyPose] | FloatArray

# Value that the C solver gives where nothing bends, or where there is no obstacle.
_NOTHING = 1e300
# Argument types of the header's functions: a pointer, an int, a count (size_t).
_TYPES = {"p": ctypes.c_void_p, "i": ctypes.c_int, "n": ctypes.c_size_t}
_ARGUMENTS = {
    "dlo_solve": "pipppn",
    "dlo_step": "ppippn",
    "dlo_sensitivity": "ppppn",
    "dlo_clearance": "ppnpp",
    "dlo_limits": "pppnppp",
    "dlo_batch": "pnipppn",
    "dlo_path": "pnipppppn",
}
# Index of the argument before which obstacles are inserted, if the solver supports any.
_AMONG = {"dlo_solve": 1, "dlo_step": 1, "dlo_sensitivity": 1, "dlo_batch": 2, "dlo_path": 2}


class CompiledSolver:
    """Equilibria in the plane and in space by compiled C: thousands of poses a second.

    Methods that find shapes take `obstacles`; without them the model's own apply. A pickle or copy
    holds what the C is made from: where it is unpickled, it is generated and compiled again, which
    needs a compiler there. Processes that are forked share the loaded library.

    Parameters
    ----------
    model : CableModel
    p : (n_parameters,)
        In the order of `model.names`, SI units.
    rest : (n_rests,) [1/m]
        Rest strains of the cells: `model.rest_basis @ coefficients`.
    flags : sequence of str
        For the compiler.
    obstacles : int
        Maximum number of obstacles that the cable may touch; at least those of the model.
    motion : bool
        Whether the solver also steps the cable in time: `motion` is then a `CompiledStepper`.

    Raises
    ------
    DloError
        If there is no C compiler, or if motion does not know a part of the cable.

    Examples
    --------
    >>> solver = CompiledSolver(model, p, rest)  # doctest: +SKIP
    >>> solver.solve(Pose((0.0, 0.0), (0.5, 0.1), branch="ccw")).points  # doctest: +SKIP
    """

    def __init__(
        self,
        model: CableModel,
        p: FloatArray,
        rest: FloatArray,
        *,
        flags: Sequence[str] = ("-O2",),
        obstacles: int = 0,
        motion: bool = False,
    ) -> None:
        self.model = model
        again = partial(CompiledSolver, flags=flags, obstacles=obstacles, motion=motion)
        self._remade = again, (model, p, rest)
        self.source = generate(model, p, rest, obstacles=obstacles, motion=motion)
        self.most_obstacles = self.source.obstacles.most
        self.obstacles = self.source.obstacles.declared
        folder = Path(tempfile.mkdtemp(prefix="dlo_solver_"))
        weakref.finalize(self, shutil.rmtree, folder, ignore_errors=True)
        self._c = ctypes.CDLL(str(compile_library(self.source, folder, flags)))
        for name, kinds in _ARGUMENTS.items():
            if self.most_obstacles and name in _AMONG:
                kinds = kinds[: _AMONG[name]] + "pn" + kinds[_AMONG[name] :]
            getattr(self._c, name).argtypes = [_TYPES[kind] for kind in kinds]
        self._records = records_of(model, self.most_obstacles)
        self.workspace = workspace_of(self._c)
        moving = MovingCable(model, p, rest) if motion else None
        self.motion = None if moving is None else CompiledStepper(moving, self._c)

    def __reduce__(self) -> tuple[Any, ...]:
        return self._remade

    def __repr__(self) -> str:
        model = self.model
        mesh = counted(model.n, f"{model.element} element")
        return f"<CompiledSolver {model.cable.name!r}: {model.cable.length:g} m, {mesh}>"

    def solve(
        self,
        pose: AnyPose,
        *,
        warm: CompiledShape | None = None,
        throw: bool = True,
        obstacles: Sequence[AnyObstacle] | None = None,
    ) -> CompiledShape:
        """Shape of the cable in one pose.

        Parameters
        ----------
        pose : Pose
            Its branch selects which way a cable in a plane turns; without one the result is the
            stable equilibrium of lowest energy. If none turns that way: status "other_branch".
        warm : CompiledShape, optional
            Start of the iteration.
        throw : bool
            Whether to raise if there is no equilibrium; otherwise see the shape's `status`.

        Raises
        ------
        EquilibriumError
            If there is no stable equilibrium and `throw` is true.
        DloError
            If pose or warm start do not fit this cable.
        """
        table, branch = pose_table(self.model, [pose])
        out = np.zeros(1, self._records.shape)
        kept = None if warm is None else self._record_of(CompiledShape, warm)
        status = self._call("dlo_solve", table, branch, kept, out, obstacles=obstacles)
        if status and throw:
            raise EquilibriumError(
                no_equilibrium(STATUSES[status], pose, self.model.cable.length),
                p_des=None if pose.end is None else tuple(map(float, pose.end)),
            )
        return _shape(out[0], status)

    def step(
        self,
        shape: CompiledShape,
        pose: AnyPose,
        *,
        steps: int = 4,
        obstacles: Sequence[AnyObstacle] | None = None,
    ) -> CompiledShape:
        """Shape in a nearby pose after at most `steps` Newton steps; check its `status`.

        Raises
        ------
        DloError
            If pose or shape do not fit this cable, or `steps` is not a whole number.
        """
        if not isinstance(steps, int | np.integer) or abs(steps) >= 2**31:
            raise DloError(f"steps: a whole number of Newton steps belongs here, found {steps!r}")
        table, _ = pose_table(self.model, [pose])
        out = np.zeros(1, self._records.shape)
        kept = self._record_of(CompiledShape, shape)
        status = self._call("dlo_step", table, kept, steps, out, obstacles=obstacles)
        return _shape(out[0], status)

    def solve_many(
        self,
        poses: Poses,
        *,
        branch: Branch | None = None,
        obstacles: Sequence[AnyObstacle] | None = None,
    ) -> tuple[Any, NDArray[np.intc]]:
        """Shapes of many independent poses.

        Parameters
        ----------
        poses : sequence of Pose of one branch, or (m, k)
            Rows are laid out as dlo_pose in the C header: in a plane start x, y, end x, y [m],
            start heading, end heading [rad]; in space start, end [m], their quaternions, turns.
        branch : "ccw" or "cw", optional
            For the rows of an array.

        Returns
        -------
        structured array (m,), (m,)
            Records with the fields of CompiledShape, and statuses (index into STATUSES).

        Raises
        ------
        DloError
            If the poses do not fit the cable or are of several branches.
        """
        table, number = pose_table(self.model, poses, branch)
        out, statuses = np.zeros(len(table), self._records.shape), np.zeros(len(table), np.intc)
        self._call("dlo_batch", table, len(table), number, out, statuses, obstacles=obstacles)
        return out, statuses

    def path(
        self,
        poses: Poses,
        *,
        branch: Branch | None = None,
        warm: CompiledShape | None = None,
        obstacles: Sequence[AnyObstacle] | None = None,
    ) -> ShapePath:
        """Shapes along a path, each one continued from the one before.

        Parameters
        ----------
        poses, branch : as in `solve_many`
            Only the first pose's branch counts.
        warm : CompiledShape, optional
            For the first pose.

        Raises
        ------
        DloError
            As in `solve_many`.
        """
        table, number = pose_table(self.model, poses, branch)
        out, statuses = np.zeros(len(table), self._records.shape), np.zeros(len(table), np.intc)
        kept = None if warm is None else self._record_of(CompiledShape, warm)
        jump = np.zeros(1, np.uintp)
        given = (table, len(table), number, kept, out, statuses, jump)
        self._call("dlo_path", *given, obstacles=obstacles)
        shapes = tuple(_shape(record, int(k)) for record, k in zip(out, statuses, strict=True))
        return ShapePath(shapes, int(jump[0]) if jump[0] < len(table) else None)

    def sensitivity(
        self,
        shape: CompiledShape,
        pose: AnyPose,
        *,
        obstacles: Sequence[AnyObstacle] | None = None,
    ) -> Slope:
        """Derivatives of a shape by the pose it was solved for.

        Raises
        ------
        EquilibriumError
            If the shape is not a stable equilibrium of this pose.
        """
        table, _ = pose_table(self.model, [pose])
        out = np.zeros(1, self._records.slope)
        kept = self._record_of(CompiledShape, shape)
        status = self._call("dlo_sensitivity", table, kept, out, obstacles=obstacles)
        if status:
            raise EquilibriumError(
                f"no derivatives ({STATUSES[status]}): is the shape a stable equilibrium of this "
                "pose?"
            )
        return Slope(**_values(out[0]))

    def clearance(
        self, shape: CompiledShape, obstacles: Sequence[AnyObstacle], slope: Slope | None = None
    ) -> Gap:
        """The place of the cable nearest to obstacles, and its distance from them.

        Parameters
        ----------
        obstacles : sequence of Obstacle, at least one
        slope : Slope, optional
            Needed for the gradient.

        Raises
        ------
        DloError
            If there is no obstacle or another object, a number is not finite, or the shape is empty
            because its pose has no equilibrium.
        """
        given = self._table_of(obstacles)
        along = None if slope is None else self._record_of(Slope, slope)
        kept, out = self._record_of(CompiledShape, shape), np.zeros(1, self._records.gap)
        status = self._call("dlo_clearance", kept, given, len(given), along, out)
        if status:
            count = counted(len(given), "obstacle")
            raise DloError(
                f"no clearance ({STATUSES[status]}): the shape is {shape.status!r}, {count} given\n"
                "  Try: a shape whose status is ok, one obstacle or more, finite numbers"
            )
        if slope is None:
            out["gradient"] = np.nan
        return Gap(**_values(out[0]))

    def limits(
        self,
        shape: CompiledShape,
        limits: Mapping[str, float],
        obstacles: Sequence[AnyObstacle] = (),
        slope: Slope | None = None,
    ) -> dict[str, Usage]:
        """Use of each limit by a shape, keyed by QUANTITIES, the tightest one first.

        Values refer to the solver's own mesh; `Shape.check` measures bends on a finer one.

        Parameters
        ----------
        limits : mapping of str to float
            For names in QUANTITIES; all are reported, also those without a limit.
        slope : Slope, optional
            Needed for the gradients.

        Raises
        ------
        DloError
            If a limit has an unknown name or is not a positive finite number, a clearance has no
            obstacles, the shape is empty, or a number is not finite.
        """
        if unknown := [name for name in limits if name not in QUANTITIES]:
            text = f"a shape has no limit {unknown[0]!r}"
            raise DloError(f"{text}\n  Try: {', '.join(QUANTITIES)}")
        for name, limit in limits.items():
            if not (isinstance(limit, Real) and 0 < limit < np.inf):
                raise DloError(
                    f"a limit must be positive and finite, found {name} {limit!r}\n"
                    f"  Try: a number; without {name} there is no limit"
                )
        if "clearance" in limits and not len(obstacles):
            raise DloError("a limit of the clearance, and no obstacle\n  Try: obstacles=[...]")
        bounds = np.array([limits.get(name, 0.0) for name in QUANTITIES], float)
        given = self._table_of(obstacles)
        along = None if slope is None else self._record_of(Slope, slope)
        kept = self._record_of(CompiledShape, shape)
        out, tightest = np.zeros(len(QUANTITIES), self._records.usage), np.zeros(1, np.intc)
        status = self._call("dlo_limits", kept, bounds, given, len(given), along, out, tightest)
        out["value"][out["value"] == _NOTHING] = np.inf
        if status:
            raise DloError(
                f"no limits ({STATUSES[status]}): the shape is {shape.status!r}\n"
                "  Try: a shape whose status is ok, and finite numbers"
            )
        if slope is None:
            out["gradient"] = np.nan
        found = {name: Usage(**_values(row)) for name, row in zip(QUANTITIES, out, strict=True)}
        first = QUANTITIES[tightest[0]]
        return {first: found[first]} | found

    def _table_of(self, obstacles: Sequence[AnyObstacle]) -> NDArray[Any]:
        """Obstacles in the layout of dlo_obstacle."""
        if not isinstance(obstacles, Sequence):
            raise DloError(f"obstacles is a list, found {obstacles!r}\n  Try: [obstacle]")
        d = self.model.node.dimension
        for obstacle in (obstacles := surfaces_of(self.model, obstacles)):
            if not isinstance(obstacle, Obstacle):
                raise DloError(
                    f"an Obstacle belongs here, found {obstacle!r}\n"
                    '  Try: dlo_casadi.Obstacle(kind="plane", point=..., normal=...)'
                )
            if any(np.shape(place) != (d,) for place in row_of(obstacle)[1:3]):
                raise DloError(
                    f"places of an obstacle must have {counted(d, 'number')}, found {obstacle!r}\n"
                    "  Try: as many as the cable's gravity has"
                )
            if isinstance(obstacle, Plane) and not np.any(obstacle.normal):
                raise DloError(f"the normal of a plane must not be zero, found {obstacle!r}")
        return np.array(list(map(row_of, obstacles)), self._records.obstacle)

    def _record_of(self, kind: type[CompiledShape | Slope], values: object) -> Any:
        """A record of the library, from a shape or a slope of this solver."""
        if not isinstance(values, kind):
            raise DloError(f"a {kind.__name__} of this solver belongs here, found {values!r}")
        out = np.zeros(1, self._records.slope if kind is Slope else self._records.shape)
        for name in out.dtype.names or ():
            value, own = getattr(values, name), out[name].shape[1:]
            if np.shape(value) != own:
                raise DloError(
                    f"a {kind.__name__} of this solver belongs here: its {name} has the shape "
                    f"{own}, found {np.shape(value)}"
                )
            out[name] = value
        return out

    def _call(
        self, name: str, *arguments: Any, obstacles: Sequence[AnyObstacle] | None = None
    ) -> int:
        """Call the library and return its status; functions that solve get a workspace."""
        work = np.empty(self.workspace)
        given = [*arguments, work, work.size][: len(_ARGUMENTS[name])]
        if name in _AMONG:
            among = self._table_of(self.obstacles if obstacles is None else obstacles)
            if len(among) > self.most_obstacles:
                raise DloError(
                    f"{counted(len(among), 'obstacle')}, the solver knows at most "
                    f"{self.most_obstacles}\n  Try: CompiledSolver(..., obstacles={len(among)})"
                )
            if self.most_obstacles:
                given[_AMONG[name] : _AMONG[name]] = [among, len(among)]
        places = (a.ctypes.data if isinstance(a, np.ndarray) else a for a in given)
        return getattr(self._c, name)(*places)


def _shape(record: Any, status: int) -> CompiledShape:
    return CompiledShape(**_values(record), status=STATUSES[status])


def _values(record: Any) -> dict[str, Any]:
    """Fields of a record of the library, by name."""
    values = {name: record[name] for name in record.dtype.names}
    return {name: v.copy() if v.ndim else v.item() for name, v in values.items()}
