"""CompiledSolver: the generated C solver, compiled and called from Python."""

from __future__ import annotations

import ctypes
import shutil
import tempfile
import weakref
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Generic, Literal, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dlo_casadi.codegen.generate import generate
from dlo_casadi.codegen.library import compile_library
from dlo_casadi.codegen.obstacles import Gap, HalfSpace, Obstacle
from dlo_casadi.codegen.poses import (
    branch_number,
    frame_poses,
    no_equilibrium,
    one_pose,
    pose_table,
)
from dlo_casadi.codegen.records import gap_record, obstacle_record, shape_record, slope_record
from dlo_casadi.codegen.shapes import (
    STATUSES,
    Shape,
    ShapePath,
    Slope,
    SpaceShape,
    SpaceSlope,
)
from dlo_casadi.equilibrium.pose import Pose
from dlo_casadi.errors import DloError, EquilibriumError, counted
from dlo_casadi.model.cable_model import CableModel

FloatArray = NDArray[np.floating]
Branch = Literal["ccw", "cw"]
S = TypeVar("S", bound=Shape | SpaceShape)


class _Compiled(Generic[S]):
    """The generated C of a model, compiled; see `CompiledSolver` and `CompiledSpaceSolver`."""

    _shape: type[S]
    _state: str  # name of what a shape is started from: headings or frames

    def __init__(
        self,
        model: CableModel,
        p: FloatArray,
        rest: FloatArray,
        *,
        flags: Sequence[str] = ("-O2",),
    ) -> None:
        self.model = model
        self.source = generate(model, p, rest)
        folder = Path(tempfile.mkdtemp(prefix="dlo_solver_"))
        weakref.finalize(self, shutil.rmtree, folder, ignore_errors=True)
        self._c = ctypes.CDLL(str(compile_library(self.source, folder, flags)))
        self.record, self._slope = shape_record(model), slope_record(model)
        self.workspace = self.source.workspace
        size, pointer, integer = ctypes.c_size_t, ctypes.c_void_p, ctypes.c_int
        tail: list[Any] = [pointer, size]
        self._c.dlo_solve.argtypes = [pointer, integer, pointer, pointer, *tail]
        self._c.dlo_step.argtypes = [pointer, pointer, integer, pointer, *tail]
        self._c.dlo_sensitivity.argtypes = [pointer, pointer, pointer, *tail]
        self._c.dlo_clearance.argtypes = [pointer, pointer, size, pointer, pointer]
        self._c.dlo_batch.argtypes = [pointer, size, integer, pointer, pointer, *tail]
        self._c.dlo_path.argtypes = [
            *(pointer, size, integer, pointer, pointer, pointer, pointer),
            *tail,
        ]

    def _read(self, record: Any, status: int) -> S:
        values = {name: record[name] for name in self.record.names or ()}
        scalars = {name: values[name].item() for name in values if values[name].ndim == 0}
        arrays = {name: values[name].copy() for name in values if values[name].ndim}
        return self._shape(**arrays, **scalars, status=STATUSES[status])

    def _warm(self, warm: S | None) -> tuple[Any, int | None]:
        """Record of a shape to start from, and its address."""
        if warm is None:
            return None, None
        record = np.zeros(1, self.record)
        nodes = record[self._state][0].shape
        if not isinstance(warm, self._shape) or np.shape(getattr(warm, self._state)) != nodes:
            count = f"with {nodes[0]} {self._state}"
            raise DloError(f"warm: a shape of this solver, {count}, belongs here")
        record[self._state], record["lam"] = getattr(warm, self._state), warm.lam
        return record, record.ctypes.data

    def _work(self) -> FloatArray:
        return np.empty(self.workspace)

    def _solved(self, pose: FloatArray, branch: object, warm: S | None, *, throw: bool) -> S:
        out = np.zeros(1, self.record)
        kept, address = self._warm(warm)
        work = self._work()
        status = self._c.dlo_solve(
            pose.ctypes.data,
            branch_number(branch),
            address,
            out.ctypes.data,
            work.ctypes.data,
            work.size,
        )
        del kept
        if status and throw:
            d = self.model.node.dimension
            start, end = pose[0, :d], pose[0, d : 2 * d]
            raise EquilibriumError(
                no_equilibrium(STATUSES[status], start, end, self.model.cable.length),
                p_des=tuple(map(float, end)),
            )
        return self._read(out[0], status)

    def _stepped(self, pose: FloatArray, start: S, steps: int) -> S:
        out = np.zeros(1, self.record)
        kept, address = self._warm(start)
        work = self._work()
        status = self._c.dlo_step(
            pose.ctypes.data, address, steps, out.ctypes.data, work.ctypes.data, work.size
        )
        del kept
        return self._read(out[0], status)

    def _batch(self, poses: FloatArray, branch: object) -> tuple[Any, NDArray[np.intc]]:
        out = np.zeros(len(poses), self.record)
        statuses = np.zeros(len(poses), np.intc)
        work = self._work()
        self._c.dlo_batch(
            poses.ctypes.data,
            len(poses),
            branch_number(branch),
            out.ctypes.data,
            statuses.ctypes.data,
            work.ctypes.data,
            work.size,
        )
        return out, statuses

    def _followed(self, poses: FloatArray, branch: object, warm: S | None) -> ShapePath[S]:
        out = np.zeros(len(poses), self.record)
        statuses = np.zeros(len(poses), np.intc)
        jump = ctypes.c_size_t(0)
        kept, address = self._warm(warm)
        work = self._work()
        self._c.dlo_path(
            poses.ctypes.data,
            len(poses),
            branch_number(branch),
            address,
            out.ctypes.data,
            statuses.ctypes.data,
            ctypes.addressof(jump),
            work.ctypes.data,
            work.size,
        )
        del kept
        shapes = tuple(self._read(record, int(k)) for record, k in zip(out, statuses, strict=True))
        return ShapePath(shapes, jump.value if jump.value < len(poses) else None)

    def clearance(
        self, shape: S, obstacles: Sequence[Obstacle], slope: Slope | SpaceSlope | None = None
    ) -> Gap:
        """Where the cable comes nearest to obstacles, and how far it is from them.

        Parameters
        ----------
        obstacles : sequence of Obstacle, at least one
        slope : as of `sensitivity`, optional
            For the gradient.

        Raises
        ------
        DloError
            If there is no obstacle, or a number is not finite.
        """
        record = np.zeros(1, self.record)
        record["points"], record[self._state] = shape.points, getattr(shape, self._state)
        given = np.zeros(len(obstacles), obstacle_record(self.model))
        for row, obstacle in zip(given, obstacles, strict=True):
            row["kind"], row["radius"] = isinstance(obstacle, HalfSpace), obstacle.radius
            row["a"], row["b"] = obstacle.ends
        along = np.zeros(1, self._slope)
        for name in self._slope.names or () if slope else ():
            along[name] = getattr(slope, name)
        out = np.zeros(1, gap_record(self.model))
        status = self._c.dlo_clearance(
            record.ctypes.data,
            given.ctypes.data,
            len(given),
            along.ctypes.data if slope else None,
            out.ctypes.data,
        )
        if status:
            count = counted(len(obstacles), "obstacle")
            raise DloError(f"no clearance ({STATUSES[status]}): {count} given")
        found = out[0]
        return Gap(
            float(found["distance"]),
            float(found["place"]),
            found["point"].copy(),
            found["normal"].copy(),
            found["gradient"].copy(),
            int(found["obstacle"]),
        )

    def _derived(self, shape: S, pose: FloatArray) -> Any:
        record, address = self._warm(shape)
        out = np.zeros(1, self._slope)
        work = self._work()
        status = self._c.dlo_sensitivity(
            pose.ctypes.data, address, out.ctypes.data, work.ctypes.data, work.size
        )
        del record
        if status:
            raise EquilibriumError(
                f"no derivatives ({STATUSES[status]}): is the shape a stable equilibrium of this "
                "pose?"
            )
        return out[0]


class CompiledSolver(_Compiled[Shape]):
    """Equilibria by compiled C: thousands of poses a second.

    Parameters
    ----------
    model : CableModel
    p : (n_parameters,)
        In the order of `model.names`, SI units.
    rest : (n_cells,) [1/m]
        Rest curvature of the bending cells: `model.rest_basis @ coefficients`.
    flags : sequence of str
        Of the compiler.

    Raises
    ------
    DloError
        If there is no C compiler.

    Examples
    --------
    >>> solver = CompiledSolver(model, p, rest)  # doctest: +SKIP
    >>> solver.solve(end=(0.5, 0.1)).points  # doctest: +SKIP
    """

    _shape, _state = Shape, "headings"

    def solve(
        self,
        end: ArrayLike = (0.0, 0.0),
        *,
        start: ArrayLike = (0.0, 0.0),
        headings: ArrayLike = (0.0, 0.0),
        branch: Branch | None = None,
        warm: Shape | None = None,
        throw: bool = True,
    ) -> Shape:
        """Shape of the cable in one pose.

        Parameters
        ----------
        end, start : (2,) [m]
        headings : (2,) [rad]
            Of clamped start and end; not used at pins.
        branch : "ccw" or "cw", optional
            Which way the cable turns; otherwise the stable equilibrium of lowest energy. If none
            is found to turn so, the status is "other_branch".
        warm : Shape, optional
            Where to start from.
        throw : bool
            Whether to raise if there is no equilibrium; otherwise see the shape's `status`.

        Raises
        ------
        EquilibriumError
            If there is no stable equilibrium and `throw` is true.
        DloError
            If end, start, headings, branch or warm cannot be used.
        """
        pose = one_pose(end, start, headings)
        return self._solved(pose, branch, warm, throw=throw)

    def step(
        self,
        shape: Shape,
        end: ArrayLike = (0.0, 0.0),
        *,
        start: ArrayLike = (0.0, 0.0),
        headings: ArrayLike = (0.0, 0.0),
        steps: int = 4,
    ) -> Shape:
        """Shape in a pose close by, in at most so many Newton steps; see its `status`."""
        return self._stepped(one_pose(end, start, headings), shape, steps)

    def solve_many(
        self,
        ends: ArrayLike,
        *,
        start: ArrayLike = (0.0, 0.0),
        headings: ArrayLike = (0.0, 0.0),
        branch: Branch | None = None,
    ) -> tuple[Any, NDArray[np.intc]]:
        """Shapes of many independent poses.

        Parameters
        ----------
        ends : (m, 2) [m]
        start, headings : (2,) or (m, 2)

        Returns
        -------
        structured array (m,), (m,)
            Records with the fields of Shape, and statuses (index into STATUSES).

        Raises
        ------
        DloError
            If ends, start and headings do not belong together, or there is no such branch.
        """
        return self._batch(pose_table(ends, start, headings), branch)

    def path(
        self,
        ends: ArrayLike,
        *,
        start: ArrayLike = (0.0, 0.0),
        headings: ArrayLike = (0.0, 0.0),
        branch: Branch | None = None,
        warm: Shape | None = None,
    ) -> ShapePath[Shape]:
        """Shapes along a path, each followed continuously from the one before.

        Parameters
        ----------
        ends : (m, 2) [m]
        start, headings : (2,) or (m, 2)
        branch : "ccw" or "cw", optional
            Of the first pose.
        warm : Shape, optional
            For the first pose.

        Raises
        ------
        DloError
            As in `solve_many`.
        """
        return self._followed(pose_table(ends, start, headings), branch, warm)

    def sensitivity(
        self,
        shape: Shape,
        end: ArrayLike = (0.0, 0.0),
        *,
        start: ArrayLike = (0.0, 0.0),
        headings: ArrayLike = (0.0, 0.0),
    ) -> Slope:
        """Derivatives of a shape by the pose it was solved for.

        Raises
        ------
        EquilibriumError
            If the shape is no stable equilibrium of this pose.
        """
        pose = one_pose(end, start, headings)
        found = self._derived(shape, pose)
        return Slope(**{name: found[name] for name in self._slope.names or ()})


class CompiledSpaceSolver(_Compiled[SpaceShape]):
    """Equilibria in space by compiled C.

    Parameters, flags and errors are those of `CompiledSolver`; poses are `pose.Pose`, whose
    branch is not used.

    Examples
    --------
    >>> solver = CompiledSpaceSolver(model, p, rest)  # doctest: +SKIP
    >>> solver.solve(pose).points  # doctest: +SKIP
    """

    _shape, _state = SpaceShape, "frames"

    def solve(
        self, pose: Pose, *, warm: SpaceShape | None = None, throw: bool = True
    ) -> SpaceShape:
        """Shape of the cable in one pose.

        Raises
        ------
        EquilibriumError
            If there is no stable equilibrium and `throw` is true.
        DloError
            If the warm start is no shape of this solver.
        """
        return self._solved(frame_poses([pose]), None, warm, throw=throw)

    def step(self, shape: SpaceShape, pose: Pose, *, steps: int = 4) -> SpaceShape:
        """Shape in a pose close by, in at most so many Newton steps; see its `status`."""
        return self._stepped(frame_poses([pose]), shape, steps)

    def solve_many(self, poses: Sequence[Pose]) -> tuple[Any, NDArray[np.intc]]:
        """Records with the fields of SpaceShape, and statuses (index into STATUSES)."""
        return self._batch(frame_poses(poses), None)

    def path(
        self, poses: Sequence[Pose], *, warm: SpaceShape | None = None
    ) -> ShapePath[SpaceShape]:
        """Shapes along a path, each followed continuously from the one before."""
        return self._followed(frame_poses(poses), None, warm)

    def sensitivity(self, shape: SpaceShape, pose: Pose) -> SpaceSlope:
        """Derivatives of a shape by the pose it was solved for.

        Raises
        ------
        EquilibriumError
            If the shape is no stable equilibrium of this pose.
        """
        found = self._derived(shape, frame_poses([pose]))
        return SpaceSlope(**{name: found[name] for name in self._slope.names or ()})
