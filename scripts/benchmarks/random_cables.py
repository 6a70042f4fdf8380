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

from dlo_casadi.assembly import Given, Shapes
from dlo_casadi.codegen.compiled import CompiledSolver
from dlo_casadi.codegen.generate import generate, numbers_of
from dlo_casadi.codegen.kernels import kernels_of
from dlo_casadi.codegen.library import compile_library
from dlo_casadi.effects import Cable
from dlo_casadi.equilibrium import JOINT_BOUND, Pose, solve_equilibrium
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
    """A cable from the ranges of the specification, and ends uniform in its disc.

    Cables of 0.3 to 3 m, 0.02 to 1 kg/m and 0.002 to 100 N m^2, in units of their length and
    weight, gravity along -y: EI / (weight length^2) is all that tells them apart.
    """
    length = rng.uniform(0.3, 3.0)
    weight = 9.81 * length * np.exp(rng.uniform(np.log(0.02), np.log(1.0)))
    stiffness = np.exp(rng.uniform(np.log(0.002), np.log(100.0)))
    cable = Cable(1.0, 1.0 / 9.81, 0.01, stiffness / (weight * length**2))
    model = CableModel(cable, n=n, element=element)
    rest = model.rest_basis @ rng.normal(size=model.rest_basis.shape[1])
    turn = np.abs(rest * np.diff(model.chain.cells, axis=1).ravel()).sum()
    rest *= rng.uniform(0.0, 4 * np.pi) / turn
    radius = 0.995 * np.sqrt(rng.uniform(size=poses))
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
        self.record = CompiledSolver(model, model.nominal, problem.rest).record
        self._work = np.empty(source.workspace)

    def table(self, problem: Problem) -> FloatArray:
        """Numbers of a cable, laid out as the compiled code expects."""
        model = problem.model
        kernels = kernels_of(model, model.nominal, problem.rest, inline=False)
        return np.array(numbers_of(model, model.nominal, problem.rest, kernels))

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
    model, phi = problem.model, shape["headings"]
    given = Given.of(model.nominal, problem.rest, np.array([[0.0, 0.0, *end, 0.0, 0.0]]))
    shapes = Shapes(phi[None, :, None], shape["lam"][None], np.zeros((1, 6)))
    _, slope, matrix = model.assembly.balance(shapes, given)
    force = slope.x[0, :, 0, 0]
    active = np.flatnonzero(np.abs(np.diff(phi)) > JOINT_BOUND - 1e-7)
    error = float(np.hypot(*slope.y[0, :2, 0]))
    arms = np.zeros((len(phi), len(active)))
    arms[active, np.arange(len(active))] = -1.0
    arms[active + 1, np.arange(len(active))] = 1.0
    # Moments at active joints balance what is left, and push inwards.
    scale = float(matrix.scale[0])
    moments, *_ = np.linalg.lstsq(arms, -force, rcond=None)
    balanced = np.abs(force + arms @ moments).max() < 1e-7 * scale
    inwards = np.all(moments * np.sign(np.diff(phi)[active]) > -1e-7 * scale)
    # Independent of the solver's own elimination: all eigenvalues of the whole matrix.
    stacked = matrix.with_border(arms[None, :, None]).dense()[0]
    conditions = model.n_conditions + len(active)
    stable = (np.linalg.eigvalsh(stacked / scale) < 0).sum() == conditions
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
