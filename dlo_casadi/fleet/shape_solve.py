"""Shapes of one chunk of poses: what a worker does."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dlo_casadi.codegen.compiled import Branch, CompiledSolver
from dlo_casadi.codegen.generate import solver_hash
from dlo_casadi.errors import counted
from dlo_casadi.io.files import write_file
from dlo_casadi.model.cable_model import CableModel

FloatArray = NDArray[np.floating]

# A process holds the shapes of one chunk at a time, of so many bytes as the solver writes them.
CHUNK_BYTES = 12_000_000


@dataclass(frozen=True)
class Plan:
    """What is computed for each pose.

    Parameters
    ----------
    model : CableModel
    p : (n_parameters,)
    rest : (n_rests,) [1/m]
    branch : "ccw", "cw" or None
    parts : Path
        Folder of the finished chunks.
    """

    model: CableModel
    p: FloatArray
    rest: FloatArray
    branch: Branch | None
    parts: Path

    @property
    def digest(self) -> str:
        """SHA-256 of all that decides the shapes, as in the C header."""
        return solver_hash(self.model, self.p, self.rest)

    @property
    def chunk(self) -> int:
        """Poses of a chunk."""
        n, k = self.model.n, self.model.chain.n_nodes
        return max(1, CHUNK_BYTES // (8 * (2 * (n + 1) + k + 12)))

    def part(self, index: int) -> Path:
        """Where a finished chunk lies."""
        return self.parts / f"{index:08d}.npy"


@dataclass(frozen=True)
class Chunk:
    """Some of the poses.

    Parameters
    ----------
    index : int
    poses : (m, 6) [m, rad]
    """

    index: int
    poses: FloatArray

    def __repr__(self) -> str:
        return f"chunk {self.index} of {counted(len(self.poses), 'pose')}"


def part_type(n: int) -> np.dtype[Any]:
    """One pose with its shape: points in single precision, 0.1 um and better below a metre."""
    return np.dtype(
        [
            ("pose", "<f8", 6),
            ("status", "i1"),
            ("energy", "<f8"),
            ("start_force", "<f8", 2),
            ("end_force", "<f8", 2),
            ("moments", "<f8", 2),
            ("min_bend_radius", "<f8"),
            ("points", "<f4", (n + 1, 2)),
        ]
    )


def solve_chunk(plan: Plan, chunk: Chunk) -> int:
    """Solve a chunk, keep it durably and return how many poses have a shape."""
    solver = _solver(plan)
    poses = chunk.poses
    records, statuses = solver.solve_many(poses, branch=plan.branch)
    part = np.zeros(len(poses), part_type(plan.model.n))
    part["pose"], part["status"] = poses, statuses
    for name in ("energy", "start_force", "end_force", "moments", "min_bend_radius", "points"):
        part[name] = records[name].reshape(part[name].shape)
    write_file(plan.part(chunk.index), lambda stream: np.save(stream, part))
    return int((statuses == 0).sum())


_solvers: dict[str, CompiledSolver] = {}


def _solver(plan: Plan) -> CompiledSolver:
    """The solver of this process, compiled once."""
    digest = plan.digest
    if digest not in _solvers:
        _solvers.clear()
        _solvers[digest] = CompiledSolver(plan.model, plan.p, plan.rest)
    return _solvers[digest]
