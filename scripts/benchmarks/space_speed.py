"""Time and error of the generated solver in space, over fourteen poses of a clamped cable."""

from __future__ import annotations

import ctypes
import shutil
import tempfile
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from benchmarks.random_cables import SpaceProblem, space_problem
from benchmarks.speed import FLAGS, HERE, summary
from dlo_casadi.codegen import CompiledSpaceSolver, generate
from dlo_casadi.codegen.compiled import shape_record
from dlo_casadi.codegen.library import compile_library
from dlo_casadi.codegen.poses import frame_poses
from dlo_casadi.pose import Pose

FloatArray = NDArray[np.floating]
# Elements of the mesh against which errors are measured: of fourth order, 1e-6 m and less.
FINE = 96


def problem(n: int, element: str) -> SpaceProblem:
    """The same cable and poses on any mesh, curved at rest."""
    drawn = space_problem(np.random.default_rng(0), 14, FINE, "quadratic")
    model = drawn.model.with_mesh(n, element)
    coefficients = np.linalg.lstsq(drawn.model.rest_basis, drawn.rest, rcond=None)[0]
    return SpaceProblem(model, model.rest_basis @ coefficients, drawn.poses)


@lru_cache(maxsize=1)
def reference() -> tuple[FloatArray, ...]:
    """Points of all poses on the fine mesh."""
    fine = problem(FINE, "quadratic")
    solver = CompiledSpaceSolver(fine.model, fine.model.nominal, fine.rest)
    return tuple(solver.solve(pose).points for pose in fine.poses)


def moved(pose: Pose, rng: np.random.Generator) -> Pose:
    """The pose whose end is 1 mm and 0.5 degrees away."""
    by, about = (v / np.linalg.norm(v) for v in rng.normal(size=(2, 3)))
    turn = Rotation.from_rotvec(np.radians(0.5) * about)
    frame = turn * Rotation.from_quat(pose.frames[1])
    return replace(
        pose,
        end=tuple(np.array(pose.end) + 1e-3 * by),
        end_orientation=tuple(frame.as_quat()),
    )


def timed(n: int, element: str, repeats: int = 20) -> dict[str, Any]:
    """Seconds of cold and warm solves, and the largest node error of each pose [m]."""
    own = problem(n, element)
    source = generate(own.model, own.model.nominal, own.rest)
    texts = dict(source.files)
    head = "#define _POSIX_C_SOURCE 199309L\n"
    texts["dlo_solver.c"] = head + texts["dlo_solver.c"] + (HERE / "timing.c").read_text()
    folder = Path(tempfile.mkdtemp(prefix="dlo_space_"))
    begin = perf_counter()
    c = ctypes.CDLL(str(compile_library(replace(source, files=texts), folder, FLAGS)))
    compiled = perf_counter() - begin
    pointer, size = ctypes.c_void_p, ctypes.c_size_t
    c.dlo_time.argtypes = [pointer, ctypes.c_int, pointer, size, pointer, pointer, pointer]
    work, rng = np.empty(source.workspace), np.random.default_rng(1)
    shape = np.zeros((2, 1), shape_record(own.model))
    errors, seconds = [], {"cold": [], "warm": []}
    every = FINE // n if FINE % n == 0 else 0
    for pose, fine in zip(own.poses, reference(), strict=True):
        for kind, at, warm in (("cold", pose, None), ("warm", moved(pose, rng), shape[0])):
            taken = np.zeros(repeats)
            out = shape[0 if warm is None else 1]
            for _ in range(2):  # the first round fills the caches
                c.dlo_time(
                    *(frame_poses([at]).ctypes.data, 0),
                    *(None if warm is None else warm.ctypes.data, repeats),
                    *(taken.ctypes.data, out.ctypes.data, work.ctypes.data),
                )
            seconds[kind].append(taken)
        if every:
            gaps = np.linalg.norm(shape[0]["points"][0] - fine[::every], axis=1)
            errors.append(float(gaps.max()))
    shutil.rmtree(folder)
    found: dict[str, Any] = {"compile_seconds": compiled}
    for kind, rows in seconds.items():
        # The machine is shared: the fastest of each pose tells what the code costs.
        best = float(np.median([row.min() for row in rows]))
        found[kind] = {**summary(np.concatenate(rows)), "best": best}
    if errors:
        found["error"] = {"median": float(np.median(errors)), "largest": max(errors)}
    return found
