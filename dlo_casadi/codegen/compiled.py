"""CompiledSolver: the generated C solver, compiled and called from Python."""

from __future__ import annotations

import ctypes
import shutil
import tempfile
import weakref
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dlo_casadi.codegen.generate import generate
from dlo_casadi.codegen.library import compile_library
from dlo_casadi.codegen.poses import branch_number, no_equilibrium, one_pose, pose_table
from dlo_casadi.codegen.shapes import STATUSES, Path2D, Shape, Slope
from dlo_casadi.errors import DloError, EquilibriumError
from dlo_casadi.model import CableModel

FloatArray = NDArray[np.floating]
Branch = Literal["ccw", "cw"]


def shape_record(model: CableModel) -> np.dtype[Any]:
    """Layout of the C solver's dlo_shape."""
    n, k = model.n, model.chain.n_nodes
    return np.dtype(
        {
            "names": [
                *("points", "headings", "lam_start", "lam", "moments", "energy"),
                *("min_bend_radius", "end_error", "imbalance", "iterations", "turn"),
            ],
            "formats": [
                *((float, (n + 1, 2)), (float, k), (float, 2), (float, 2), (float, 2)),
                *(float, float, float, float, np.intc, np.intc),
            ],
        },
        align=True,
    )


class CompiledSolver:
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
        n, k = model.n, model.chain.n_nodes
        self.record = shape_record(model)
        self._pose = np.dtype((float, 6))
        self._slope = np.dtype(
            [("points", float, (n + 1, 2, 4)), ("headings", float, (k, 4)), ("lam", float, (2, 4))]
        )
        self.workspace = self.source.workspace
        size, pointer, integer = ctypes.c_size_t, ctypes.c_void_p, ctypes.c_int
        tail: list[Any] = [pointer, size]
        self._c.dlo_solve.argtypes = [pointer, integer, pointer, pointer, *tail]
        self._c.dlo_sensitivity.argtypes = [pointer, pointer, pointer, *tail]
        self._c.dlo_batch.argtypes = [pointer, size, integer, pointer, pointer, *tail]
        self._c.dlo_path.argtypes = [
            *(pointer, size, integer, pointer, pointer, pointer, pointer),
            *tail,
        ]

    def _read(self, record: Any, status: int) -> Shape:
        values = {name: record[name] for name in self.record.names or ()}
        scalars = {name: values[name].item() for name in values if values[name].ndim == 0}
        arrays = {name: values[name].copy() for name in values if values[name].ndim}
        return Shape(**arrays, **scalars, status=STATUSES[status])

    def _warm(self, warm: Shape | None) -> tuple[Any, int | None]:
        """Record of a shape to start from, and its address."""
        if warm is None:
            return None, None
        count = self.model.chain.n_nodes
        if not isinstance(warm, Shape) or np.shape(warm.headings) != (count,):
            raise DloError(f"warm: a shape of this solver, with {count} headings, belongs here")
        record = np.zeros(1, self.record)
        record["headings"], record["lam"] = warm.headings, warm.lam
        return record, record.ctypes.data

    def _work(self) -> FloatArray:
        return np.empty(self.workspace)

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
            raise EquilibriumError(
                no_equilibrium(STATUSES[status], pose[0], self.model.cable.length),
                p_des=(float(pose[0, 2]), float(pose[0, 3])),
            )
        return self._read(out[0], status)

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
        poses = pose_table(ends, start, headings)
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

    def path(
        self,
        ends: ArrayLike,
        *,
        start: ArrayLike = (0.0, 0.0),
        headings: ArrayLike = (0.0, 0.0),
        branch: Branch | None = None,
        warm: Shape | None = None,
    ) -> Path2D:
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
        poses = pose_table(ends, start, headings)
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
        return Path2D(shapes, jump.value if jump.value < len(poses) else None)

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
        return Slope(out[0]["points"], out[0]["headings"], out[0]["lam"])
