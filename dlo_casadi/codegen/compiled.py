"""CompiledSolver: the generated C solver, compiled and called from Python."""

from __future__ import annotations

import ctypes
import shutil
import tempfile
import weakref
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dlo_casadi.codegen.generate import generate
from dlo_casadi.codegen.library import compile_library
from dlo_casadi.codegen.obstacles import Gap, HalfSpace, Obstacle
from dlo_casadi.codegen.poses import no_equilibrium, pose_table
from dlo_casadi.codegen.records import gap_record, obstacle_record, shape_record, slope_record
from dlo_casadi.codegen.shapes import STATUSES, Shape, ShapePath, Slope
from dlo_casadi.equilibrium.pose import Branch, Pose
from dlo_casadi.errors import DloError, EquilibriumError, counted
from dlo_casadi.model.cable_model import CableModel

FloatArray = NDArray[np.floating]
# Poses, or rows of numbers laid out as dlo_pose in the C header.
Poses = Sequence[Pose] | FloatArray


class CompiledSolver:
    """Equilibria in the plane and in space by compiled C: thousands of poses a second.

    Parameters
    ----------
    model : CableModel
    p : (n_parameters,)
        In the order of `model.names`, SI units.
    rest : (n_rests,) [1/m]
        Rest strains of the cells: `model.rest_basis @ coefficients`.
    flags : sequence of str
        Of the compiler.

    Raises
    ------
    DloError
        If there is no C compiler.

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

    def solve(self, pose: Pose, *, warm: Shape | None = None, throw: bool = True) -> Shape:
        """Shape of the cable in one pose.

        Parameters
        ----------
        pose : Pose
            Its branch says which way a cable in a plane turns; without one the stable equilibrium
            of lowest energy is meant. If none is found to turn so, the status is "other_branch".
        warm : Shape, optional
            Where to start from.
        throw : bool
            Whether to raise if there is no equilibrium; otherwise see the shape's `status`.

        Raises
        ------
        EquilibriumError
            If there is no stable equilibrium and `throw` is true.
        DloError
            If pose or warm start do not fit the cable.
        """
        table, branch = pose_table(self.model, [pose])
        kept, out = self._record_of(warm), np.zeros(1, self.record)
        status = self._c.dlo_solve(_at(table), branch, _at(kept), _at(out), *self._work())
        if status and throw:
            raise EquilibriumError(
                no_equilibrium(STATUSES[status], pose, self.model.cable.length),
                p_des=None if pose.end is None else tuple(map(float, pose.end)),
            )
        return self._read(out[0], status)

    def step(self, shape: Shape, pose: Pose, *, steps: int = 4) -> Shape:
        """Shape in a pose close by, in at most so many Newton steps; see its `status`.

        Raises
        ------
        DloError
            If pose or shape do not fit the cable, or `steps` is no whole number.
        """
        if not isinstance(steps, int | np.integer):
            raise DloError(f"steps: a whole number of Newton steps belongs here, found {steps!r}")
        table, _ = pose_table(self.model, [pose])
        kept, out = self._record_of(shape), np.zeros(1, self.record)
        status = self._c.dlo_step(_at(table), _at(kept), steps, _at(out), *self._work())
        return self._read(out[0], status)

    def solve_many(
        self, poses: Poses, *, branch: Branch | None = None
    ) -> tuple[Any, NDArray[np.intc]]:
        """Shapes of many independent poses.

        Parameters
        ----------
        poses : sequence of Pose of one branch, or (m, k)
            Rows are laid out as dlo_pose in the C header: in a plane start x, y, end x, y [m],
            start heading, end heading [rad]; in space start, end [m], their quaternions, turns.
        branch : "ccw" or "cw", optional
            Of an array's rows.

        Returns
        -------
        structured array (m,), (m,)
            Records with the fields of Shape, and statuses (index into STATUSES).

        Raises
        ------
        DloError
            If the poses do not fit the cable or are of several branches.
        """
        table, number = pose_table(self.model, poses, branch)
        out, statuses = np.zeros(len(table), self.record), np.zeros(len(table), np.intc)
        self._c.dlo_batch(*(_at(table), len(table), number, _at(out), _at(statuses)), *self._work())
        return out, statuses

    def path(
        self, poses: Poses, *, branch: Branch | None = None, warm: Shape | None = None
    ) -> ShapePath:
        """Shapes along a path, each followed continuously from the one before.

        Parameters
        ----------
        poses, branch : as in `solve_many`
            The branch is that of the first pose.
        warm : Shape, optional
            For the first pose.

        Raises
        ------
        DloError
            As in `solve_many`.
        """
        table, number = pose_table(self.model, poses, branch)
        out, statuses = np.zeros(len(table), self.record), np.zeros(len(table), np.intc)
        kept, jump = self._record_of(warm), np.zeros(1, np.uintp)
        self._c.dlo_path(
            *(_at(table), len(table), number, _at(kept), _at(out), _at(statuses), _at(jump)),
            *self._work(),
        )
        shapes = tuple(self._read(record, int(k)) for record, k in zip(out, statuses, strict=True))
        return ShapePath(shapes, int(jump[0]) if jump[0] < len(table) else None)

    def sensitivity(self, shape: Shape, pose: Pose) -> Slope:
        """Derivatives of a shape by the pose it was solved for.

        Raises
        ------
        EquilibriumError
            If the shape is no stable equilibrium of this pose.
        """
        table, _ = pose_table(self.model, [pose])
        kept, out = self._record_of(shape), np.zeros(1, self._slope)
        status = self._c.dlo_sensitivity(_at(table), _at(kept), _at(out), *self._work())
        if status:
            raise EquilibriumError(
                f"no derivatives ({STATUSES[status]}): is the shape a stable equilibrium of this "
                "pose?"
            )
        return Slope(**{name: out[0][name] for name in out.dtype.names or ()})

    def clearance(
        self, shape: Shape, obstacles: Sequence[Obstacle], slope: Slope | None = None
    ) -> Gap:
        """Where the cable comes nearest to obstacles, and how far it is from them.

        Parameters
        ----------
        obstacles : sequence of Obstacle, at least one
        slope : Slope, optional
            For the gradient.

        Raises
        ------
        DloError
            If there is no obstacle or another object, or a number is not finite.
        """
        kept, given = self._record_of(shape), np.zeros(len(obstacles), obstacle_record(self.model))
        for row, obstacle in zip(given, obstacles, strict=True):
            if not isinstance(obstacle, Obstacle):
                raise DloError(f"a Capsule or a HalfSpace belongs here, found {obstacle!r}")
            if any(np.shape(place) != row["a"].shape for place in obstacle.ends):
                count = counted(self.model.node.dimension, "number")
                raise DloError(f"places of an obstacle must have {count}, found {obstacle!r}")
            row["kind"], row["radius"] = isinstance(obstacle, HalfSpace), obstacle.radius
            row["a"], row["b"] = obstacle.ends
        along = None if slope is None else _filled(self._slope, slope)
        out = np.zeros(1, gap_record(self.model))
        status = self._c.dlo_clearance(_at(kept), _at(given), len(given), _at(along), _at(out))
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

    def _record_of(self, shape: Shape | None) -> Any:
        if shape is None:
            return None
        nodes = self.record["x"].shape
        if not isinstance(shape, Shape) or np.shape(shape.x) != nodes:
            raise DloError(f"a shape of this solver, with x of the shape {nodes}, belongs here")
        return _filled(self.record, shape)

    def _read(self, record: Any, status: int) -> Shape:
        values = {name: record[name] for name in self.record.names or ()}
        scalars = {name: values[name].item() for name in values if values[name].ndim == 0}
        arrays = {name: values[name].copy() for name in values if values[name].ndim}
        return Shape(**arrays, **scalars, status=STATUSES[status])

    def _work(self) -> tuple[Any, int]:
        work = np.empty(self.workspace)
        return _at(work), work.size


def _filled(record: np.dtype[Any], values: Shape | Slope) -> Any:
    out = np.zeros(1, record)
    for name in record.names or ():
        out[name] = getattr(values, name)
    return out


def _at(array: Any) -> Any:
    """The array as an argument in C, which keeps it alive; a null pointer for None."""
    return None if array is None else array.ctypes.data_as(ctypes.c_void_p)
