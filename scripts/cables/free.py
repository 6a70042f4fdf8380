"""Random cables and poses through one compiled solver whose numbers come from a table."""

from __future__ import annotations

import ctypes
import shutil
import tempfile
import weakref
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from time import perf_counter

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from cables.ipopt import Ipopt
from dlo_casadi.codegen.compiler import compile_library, workspace_of
from dlo_casadi.codegen.generate import generate, table_of
from dlo_casadi.codegen.shapes import pose_table, records_of
from dlo_casadi.effects import CableData
from dlo_casadi.equilibrium.by_ipopt import by_ipopt
from dlo_casadi.equilibrium.equilibrium import JOINT_BOUND
from dlo_casadi.equilibrium.guesses import guesses, limited
from dlo_casadi.equilibrium.pose import HeldPose
from dlo_casadi.model.assembly import Assembly, Inputs, Shapes
from dlo_casadi.model.cable_model import CableModel
from dlo_casadi.rod.supports import STARTS, SupportKind

FloatArray = NDArray[np.floating]

# Every kind of start with every kind of end, ends that are held first.
BOUNDARIES = (
    *((start, end) for end in STARTS for start in STARTS),
    *((start, SupportKind.FREE) for start in STARTS),
)

# The public functions read the solver's own table; this one is given another.
_WITH_TABLE = """
void dlo_batch_with(const double *table, const dlo_pose *poses, size_t count, dlo_branch branch,
                    const dlo_shape *warm, dlo_shape *shapes, dlo_status *statuses, double *work,
                    size_t work_size);
void dlo_batch_with(const double *table, const dlo_pose *poses, size_t count, dlo_branch branch,
                    const dlo_shape *warm, dlo_shape *shapes, dlo_status *statuses, double *work,
                    size_t work_size)
{
    size_t i;
    for (i = 0; i < count; ++i)
        statuses[i] = solve_one(table, poses + i, branch, warm ? warm + i : 0, shapes + i, work,
                                work_size);
}
"""


@dataclass(frozen=True)
class Problem:
    """One random cable with its ends (m, 2) and the headings (m, 2) of its clamps."""

    model: CableModel
    rest: FloatArray
    ends: FloatArray
    headings: FloatArray

    @property
    def p(self) -> FloatArray:
        """The cable's parameters."""
        return self.model.nominal

    @property
    def table(self) -> FloatArray:
        """All poses as the C solver takes them."""
        poses = np.zeros((len(self.ends), 6))
        poses[:, 2:4], poses[:, 4:] = self.ends, self.headings
        return poses

    def pose(self, i: int) -> HeldPose:
        """One pose for the Python solver."""
        end, (first, last), model = self.ends[i], self.headings[i], self.model
        return HeldPose(
            (0.0, 0.0),
            None if model.end == "free" else (float(end[0]), float(end[1])),
            float(first) if model.start == "clamped" else None,
            float(last) if model.end == "clamped" else None,
        )


@dataclass(frozen=True)
class SpaceProblem:
    """One random cable in space between two clamps."""

    model: CableModel
    p: FloatArray
    rest: FloatArray
    poses: tuple[HeldPose, ...]

    @property
    def table(self) -> FloatArray:
        """All poses as the C solver takes them."""
        return pose_table(self.model, self.poses)[0]


@lru_cache
def _unit_cable(n: int, element: str) -> CableModel:
    """A cable of 1 m in space: cables that differ in their stiffness share its functions."""
    cable = CableData(1.0, 0.1, 0.01, 1.0, torsional_stiffness=1.0)
    return CableModel(cable, n, element, "clamped", "clamped", (0.0, 0.0, -9.81))  # type: ignore[arg-type]


def space_problem(
    rng: np.random.Generator, poses: int, n: int = 20, element: str = "quadratic"
) -> SpaceProblem:
    """A cable of 1 m of any ratio of stiffness to weight between two clamps.

    EI over weight L^3 from 0.003 to 30, EI over GJ from 0.7 to 3, rest curvature up to half a turn;
    chords of any direction to gravity from 0.5 to 0.9 L, both ends turned by up to 60 degrees
    against the chord, the end rolled by up to 180 degrees and twisted by up to two turns more.
    """
    model = _unit_cable(n, element)
    weight = 9.81 * model.cable.mass
    stiffness = weight * np.exp(rng.uniform(np.log(0.003), np.log(30.0)))
    p = np.array([stiffness, stiffness / rng.uniform(0.7, 3.0), 0.0])
    rest = model.rest_basis @ rng.normal(size=model.n_coefficients)
    bends = np.linalg.norm(model.chain.curvatures(rest), axis=0) / n
    rest *= rng.uniform(0.0, np.pi) / bends.sum()
    found = []
    for _ in range(poses):
        chord = Rotation.random(random_state=rng)
        first, last = (chord * _tilted(rng) for _ in range(2))
        roll = Rotation.from_rotvec([rng.uniform(-np.pi, np.pi), 0.0, 0.0])
        end = rng.uniform(0.5, 0.9) * chord.apply([1.0, 0.0, 0.0])
        found.append(
            HeldPose(
                (0.0, 0.0, 0.0),
                tuple(end),
                start_orientation=tuple(first.as_quat()),
                end_orientation=tuple((last * roll).as_quat()),
                turns=float(rng.integers(-2, 3)),
            )
        )
    return SpaceProblem(model, p, rest, tuple(found))


def _tilted(rng: np.random.Generator) -> Rotation:
    """A turn by up to 60 degrees about an axis across x."""
    angle, about = rng.uniform(0.0, np.pi / 3), rng.uniform(0.0, 2 * np.pi)
    return Rotation.from_rotvec(angle * np.array([0.0, np.cos(about), np.sin(about)]))


def _is_minimum(
    problem: SpaceProblem, i: int, frames: FloatArray, lam: FloatArray
) -> tuple[bool, float]:
    """Whether frames and multipliers are a stable equilibrium of a pose, and the worst end error.

    The error is in m or rad; stability is that of all eigenvalues of the whole matrix.
    """
    model = problem.model
    given = Inputs.of(problem.p, problem.rest, problem.poses[i].vector[None])
    shapes = Shapes.declared(frames[None], lam[None])
    _, slope, matrix = Assembly(model, shapes, given).balance()
    scale = float(matrix.scale[0])
    balanced = np.abs(slope.x).max() < 1e-7 * scale
    stable = (np.linalg.eigvalsh(matrix.dense()[0] / scale) < 0).sum() == model.n_multipliers
    return bool(balanced and stable), float(np.abs(slope.y).max())


def check_in_space(problem: SpaceProblem, shape: NDArray[np.void], i: int) -> tuple[bool, float]:
    """Whether a shape is a stable equilibrium by the Python model, and its worst end error."""
    x = shape["x"]
    # The solver's moments are about the world's axes, multipliers about the nodes' own.
    moments = [
        Rotation.from_quat(frame).inv().apply(moment)
        for frame, moment in zip((x[0], x[-1]), shape["moments"], strict=True)
    ]
    return _is_minimum(problem, i, x, np.concatenate([shape["end_force"], *moments]))


def compare_in_space(problem: SpaceProblem, shape: NDArray[np.void], i: int, ipopt: Ipopt) -> str:
    """Our energy against that of IPOPT's lowest minimum: same, lower, higher or ipopt_failed.

    IPOPT also ends at saddles, also of the unknowns inside elements: those do not count.
    """
    minima = [
        found.energy
        for found in ipopt.solve(problem.p, problem.rest, problem.poses[i])
        if _is_minimum(problem, i, found.frames, found.multipliers)[0]
    ]
    if not minima:
        return "ipopt_failed"
    cable = problem.model.cable
    slack = 1e-6 * (problem.p[0] / cable.length + 9.81 * cable.mass * cable.length)
    if abs(shape["energy"] - min(minima)) <= slack:
        return "same"
    return "lower" if shape["energy"] < min(minima) else "higher"


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
    cable = CableData(1.0, 1.0 / 9.81, 0.01, stiffness / (weight * length**2))
    model = CableModel(cable, n=n, element=element)
    rest = model.rest_basis @ rng.normal(size=model.rest_basis.shape[1])
    turn = np.abs(rest * np.diff(model.chain.cells, axis=1).ravel()).sum()
    rest *= rng.uniform(0.0, 4 * np.pi) / turn
    radius = 0.995 * np.sqrt(rng.uniform(size=poses))
    angle = rng.uniform(-np.pi, np.pi, size=poses)
    ends = radius[:, None] * np.stack([np.cos(angle), np.sin(angle)], 1)
    return Problem(model, rest, ends, np.zeros((poses, 2)))


def held_problem(
    rng: np.random.Generator, start: SupportKind, end: SupportKind, poses: int, n: int = 16
) -> Problem:
    """A cable of 1 m of any ratio of stiffness to weight, held anywhere in any directions.

    EI over weight L^3 from 0.003 to 3, rest curvature up to half a turn, uniform for every other
    cable; chords from 0.2 to 0.95 L.
    """
    mass = 0.1
    stiffness = 9.81 * mass * np.exp(rng.uniform(np.log(0.003), np.log(3.0)))
    model = CableModel(CableData(1.0, mass, 0.01, stiffness), n=n, start=start, end=end)
    width = np.diff(model.chain.cells, axis=1).ravel()
    rest = model.rest_basis @ rng.normal(size=model.rest_basis.shape[1])
    rest *= rng.uniform(0.0, np.pi) / np.abs(rest * width).sum()
    if rng.uniform() < 0.5:
        rest = np.full(len(rest), rng.uniform(-np.pi, np.pi))
    radius, angle = rng.uniform(0.2, 0.95, size=poses), rng.uniform(-np.pi, np.pi, size=poses)
    ends = radius[:, None] * np.stack([np.cos(angle), np.sin(angle)], 1)
    return Problem(model, rest, ends, rng.uniform(-np.pi, np.pi, size=(poses, 2)))


def random_starts(rng: np.random.Generator, problem: Problem) -> FloatArray:
    """Smooth headings (m, n_nodes) between the clamps; free ones anywhere within a turn."""
    model = problem.model
    u, m = model.chain.places / model.chain.length, len(problem.ends)
    first, last = problem.headings.T
    if model.start != "clamped" and model.end != "clamped":
        first = rng.uniform(-np.pi, np.pi, size=m)
    if model.start != "clamped" and model.end == "clamped":
        first = last + rng.uniform(-2 * np.pi, 2 * np.pi, size=m)
    if model.end != "clamped":
        last = first + rng.uniform(-2 * np.pi, 2 * np.pi, size=m)
    waves = np.sin(np.pi * np.arange(1, 4)[:, None] * u)
    sizes = rng.normal(size=(m, 3)) * 1.5 / np.arange(1, 4)
    phi = first[:, None] + (last - first)[:, None] * u + sizes @ waves
    return np.array([limited(row) for row in phi])


class AnyCable:
    """The compiled solver of all cables of one kind: the mesh is compiled, numbers are not."""

    def __init__(self, problem: Problem | SpaceProblem, flags: tuple[str, ...] = ("-O2",)) -> None:
        model = problem.model
        source = generate(model, problem.p, problem.rest, inline=False)
        texts = dict(source.files)
        texts["dlo_solver.c"] += _WITH_TABLE
        self._source = replace(source, files=texts)
        folder = Path(tempfile.mkdtemp(prefix="dlo_random_"))
        weakref.finalize(self, shutil.rmtree, folder, ignore_errors=True)
        self._c = ctypes.CDLL(str(compile_library(self._source, folder, flags)))
        pointer, size = ctypes.c_void_p, ctypes.c_size_t
        self._c.dlo_batch_with.argtypes = [
            *(pointer, pointer, size, ctypes.c_int, pointer, pointer, pointer, pointer, size)
        ]
        self.record = records_of(model).shape
        self._work = np.empty(workspace_of(self._c))

    def table(self, problem: Problem | SpaceProblem) -> FloatArray:
        """Numbers of a cable, laid out as the compiled code expects."""
        return np.array(table_of(problem.model, problem.p, problem.rest))

    def solve(
        self,
        problem: Problem | SpaceProblem,
        branch: int = 0,
        starts: FloatArray | None = None,
    ) -> tuple[NDArray[np.void], NDArray[np.intc], float]:
        """Shapes, statuses and seconds of all poses of a problem, cold or from headings."""
        table, poses = self.table(problem), problem.table
        warm = np.zeros(len(poses), self.record)
        if starts is not None:
            warm["x"][..., 0] = starts
            warm["min_bend_radius"] = 1.0  # zero is that of a pose without a shape
        shapes = np.zeros(len(poses), self.record)
        statuses = np.zeros(len(poses), np.intc)
        begin = perf_counter()
        self._c.dlo_batch_with(
            *(table.ctypes.data, poses.ctypes.data, len(poses), branch),
            *(None if starts is None else warm.ctypes.data, shapes.ctypes.data),
            *(statuses.ctypes.data, self._work.ctypes.data, self._work.size),
        )
        return shapes, statuses, perf_counter() - begin


def check(problem: Problem, shape: NDArray[np.void], end: FloatArray) -> tuple[bool, float]:
    """Whether a shape is a stable equilibrium by the Python model, and its end error [m].

    Joints at their bound count as conditions.
    """
    model, phi = problem.model, shape["x"][:, 0]
    pose = HeldPose((0.0, 0.0), (float(end[0]), float(end[1])))
    given = Inputs.of(model.nominal, problem.rest, pose.vector[None])
    shapes = Shapes.declared(phi[None, :, None], shape["end_force"][None])
    _, slope, matrix = Assembly(model, shapes, given).balance()
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
    conditions = len(model.condition_names) + len(active)
    stable = (np.linalg.eigvalsh(stacked / scale) < 0).sum() == conditions
    inside = np.abs(np.diff(phi)).max() < JOINT_BOUND + 1e-7
    return bool(balanced and inwards and stable and inside), error


def compare_with_ipopt(problem: Problem, shape: NDArray[np.void], end: FloatArray) -> str:
    """Our energy against IPOPT's: same, lower, higher or ipopt_failed."""
    model, p, rest = problem.model, problem.model.nominal, problem.rest
    pose = HeldPose((0.0, 0.0), (float(end[0]), float(end[1])))
    found = [by_ipopt(model, p, rest, pose, phi) for phi in guesses(model, p, rest, pose)]
    stable = [eq for eq in found if eq is not None and eq.stable]
    if not stable:
        return "ipopt_failed"
    other = min(stable, key=lambda eq: eq.energy)
    weight = model.cable.mass * 9.81 * model.cable.length
    slack = 1e-6 * (abs(other.energy) + weight)
    if abs(shape["energy"] - other.energy) <= slack:
        return "same"
    return "lower" if shape["energy"] < other.energy else "higher"


def missed(
    rng: np.random.Generator, start: SupportKind, end: SupportKind, problems: int, starts: int = 24
) -> tuple[int, list[tuple[Problem, NDArray[np.void]]]]:
    """Of random problems held so, how many have a lower equilibrium than the one that is found.

    Lower by more than 1e-6 of EI / L + weight L, from so many random starts each.

    Returns
    -------
    int, list of (Problem, shape)
        Problems that were missed, no equilibrium included; all problems, of one pose each.
    """
    count, found = 0, []
    any_rest = held_problem(rng, start, end, 1)
    any_rest = replace(any_rest, rest=rng.normal(size=len(any_rest.rest)))
    solver = AnyCable(any_rest)
    for _ in range(problems):
        problem = held_problem(rng, start, end, 1)
        shapes, statuses, _ = solver.solve(problem)
        again = replace(
            problem,
            ends=problem.ends.repeat(starts, axis=0),
            headings=problem.headings.repeat(starts, axis=0),
        )
        others, failed, _ = solver.solve(again, starts=random_starts(rng, again))
        lowest = min(others["energy"][failed == 0], default=np.inf)
        cable = problem.model.cable
        scale = cable.bending_stiffness / cable.length + 9.81 * cable.mass * cable.length
        count += bool(statuses[0] or shapes["energy"][0] > lowest + 1e-6 * scale)
        found.append((problem, shapes[0]))
    return count, found
