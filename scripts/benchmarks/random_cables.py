"""Random cables and poses through one compiled solver whose numbers come from a table."""

from __future__ import annotations

import ctypes
import shutil
import tempfile
import weakref
from dataclasses import dataclass, replace
from pathlib import Path
from time import perf_counter

import numpy as np
from numpy.typing import NDArray

from dlo_casadi.codegen.compiled import CompiledSolver
from dlo_casadi.codegen.generate import generate, numbers_of
from dlo_casadi.codegen.kernels import groups_of
from dlo_casadi.codegen.library import compile_library
from dlo_casadi.codegen.split import Split
from dlo_casadi.effects import Cable
from dlo_casadi.equilibrium import JOINT_BOUND, Pose, is_stable, solve_equilibrium
from dlo_casadi.errors import EquilibriumError
from dlo_casadi.model import CableModel

FloatArray = NDArray[np.floating]

# The public functions read the solver's own table; this one is given another.
_WITH_TABLE = """
void dlo_batch_with(const double *table, const dlo_pose *poses, size_t count, dlo_branch branch,
                    dlo_shape *shapes, dlo_status *statuses, double *work, size_t work_size);
void dlo_batch_with(const double *table, const dlo_pose *poses, size_t count, dlo_branch branch,
                    dlo_shape *shapes, dlo_status *statuses, double *work, size_t work_size)
{
    size_t i;
    for (i = 0; i < count; ++i)
        statuses[i] = solve_one(table, poses + i, branch, 0, shapes + i, work, work_size);
}
"""


@dataclass(frozen=True)
class Problem:
    """One random cable with its ends (m, 2)."""

    model: CableModel
    rest: FloatArray
    ends: FloatArray


def random_problem(
    rng: np.random.Generator, poses: int, n: int = 20, element: str = "link"
) -> Problem:
    """A cable from the ranges of the specification, and ends uniform in its disc."""
    length = rng.uniform(0.3, 3.0)
    mass = length * np.exp(rng.uniform(np.log(0.02), np.log(1.0)))
    stiffness = np.exp(rng.uniform(np.log(0.002), np.log(100.0)))
    down = rng.uniform(-np.pi, np.pi)
    gravity = (float(9.81 * np.cos(down)), float(9.81 * np.sin(down)))
    cable = Cable(length, mass, 0.01, stiffness)
    model = CableModel(cable, n=n, element=element, gravity=gravity)  # type: ignore[arg-type]
    rest = model.rest_basis @ rng.normal(size=model.rest_basis.shape[1])
    turn = np.abs(rest * np.diff(model.chain.cells, axis=1).ravel()).sum()
    rest *= rng.uniform(0.0, 4 * np.pi) / turn
    radius = 0.995 * length * np.sqrt(rng.uniform(size=poses))
    angle = rng.uniform(-np.pi, np.pi, size=poses)
    return Problem(model, rest, radius[:, None] * np.stack([np.cos(angle), np.sin(angle)], 1))


class AnyCable:
    """The compiled solver of all cables of one kind: the mesh is compiled, numbers are not."""

    def __init__(self, problem: Problem, flags: tuple[str, ...] = ("-O2",)) -> None:
        model = problem.model
        source = generate(model, model.nominal, problem.rest, inline=False)
        texts = dict(source.files)
        texts["dlo_solver.c"] += _WITH_TABLE
        self._source = replace(source, files=texts)
        folder = Path(tempfile.mkdtemp(prefix="dlo_random_"))
        weakref.finalize(self, shutil.rmtree, folder, ignore_errors=True)
        self._c = ctypes.CDLL(str(compile_library(self._source, folder, flags)))
        pointer, size = ctypes.c_void_p, ctypes.c_size_t
        self._c.dlo_batch_with.argtypes = [
            *(pointer, pointer, size, ctypes.c_int, pointer, pointer, pointer, size)
        ]
        self._groups = groups_of(Split(model, model.nominal, problem.rest).slots, inline=False)
        self.record = CompiledSolver(model, model.nominal, problem.rest).record
        self._work = np.empty(source.workspace)

    def table(self, problem: Problem) -> FloatArray:
        """Numbers of a cable, laid out as the compiled code expects."""
        split = Split(problem.model, problem.model.nominal, problem.rest)
        own = groups_of(split.slots, inline=False)
        if [(g.key, g.members) for g in own] != [(g.key, g.members) for g in self._groups]:
            raise ValueError("the cable is of another kind than the compiled one")
        return np.array(numbers_of(split, self._groups))

    def solve(
        self, problem: Problem, branch: int = 0
    ) -> tuple[NDArray[np.void], NDArray[np.intc], float]:
        """Shapes, statuses and seconds of all poses of a problem."""
        table = self.table(problem)
        poses = np.zeros((len(problem.ends), 6))
        poses[:, 2:4] = problem.ends
        shapes = np.zeros(len(poses), self.record)
        statuses = np.zeros(len(poses), np.intc)
        begin = perf_counter()
        self._c.dlo_batch_with(
            *(table.ctypes.data, poses.ctypes.data, len(poses), branch, shapes.ctypes.data),
            *(statuses.ctypes.data, self._work.ctypes.data, self._work.size),
        )
        return shapes, statuses, perf_counter() - begin


def check(problem: Problem, shape: NDArray[np.void], end: FloatArray) -> tuple[bool, float]:
    """Whether a shape is a stable equilibrium by the Python model, and its end error [m].

    Joints at their bound count as conditions.
    """
    model = problem.model
    ends = np.array([0.0, 0.0, *end, 0.0, 0.0])
    phi, lam = shape["headings"], shape["lam"]
    arguments = (phi, lam, model.nominal, problem.rest, ends, np.zeros(6))
    force, matrix = (np.array(block) for block in model.kkt(*arguments))
    force, k, m = force.ravel(), len(phi), model.n_conditions
    active = np.flatnonzero(np.abs(np.diff(phi)) > JOINT_BOUND - 1e-7)
    error = float(np.hypot(*force[k : k + 2]))
    rows = np.zeros((len(active), k + m))
    rows[np.arange(len(active)), active] = -1.0
    rows[np.arange(len(active)), active + 1] = 1.0
    stacked = np.block([[matrix, rows.T], [rows, np.zeros((len(active), len(active)))]])
    # Moments at active joints balance what is left, and push inwards.
    scale = np.abs(matrix[:k, :k]).max()
    moments, *_ = np.linalg.lstsq(rows[:, :k].T, -force[:k], rcond=None)
    left = force[:k] + rows[:, :k].T @ moments
    balanced = np.abs(left).max() < 1e-7 * scale
    inwards = np.all(moments * np.sign(np.diff(phi)[active]) > -1e-7 * scale)
    stable = is_stable(stacked / scale, m + len(active))
    inside = np.abs(np.diff(phi)).max() < JOINT_BOUND + 1e-7
    return bool(balanced and inwards and stable and inside), error


def compare_with_ipopt(problem: Problem, shape: NDArray[np.void], end: FloatArray) -> str:
    """Our energy against IPOPT's: same, lower, higher or ipopt_failed."""
    try:
        other = solve_equilibrium(
            problem.model, problem.model.nominal, problem.rest, Pose((0.0, 0.0), tuple(end))
        )
    except EquilibriumError:
        return "ipopt_failed"
    if not other.stable:
        return "ipopt_failed"
    weight = problem.model.cable.mass * 9.81 * problem.model.cable.length
    slack = 1e-6 * (abs(other.energy) + weight)
    if abs(shape["energy"] - other.energy) <= slack:
        return "same"
    return "lower" if shape["energy"] < other.energy else "higher"
