"""Time and memory of the batch problem against poses and elements, each case in a process.

python -m paper.scale POSES ELEMENTS      (in scripts/): one case, as JSON
"""

from __future__ import annotations

import json
import os
import resource
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from time import perf_counter, process_time
from typing import Any

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np
from numpy.typing import NDArray

from dlo_casadi.codegen import CompiledSolver
from dlo_casadi.equilibrium.curve import NodeCurve
from dlo_casadi.equilibrium.pose import HeldPose
from dlo_casadi.estimation.batch import solve_batch
from dlo_casadi.estimation.fit import fit_model
from dlo_casadi.model.assembly import Assembly, Inputs, Shapes
from dlo_casadi.model.cable_model import CableModel
from dlo_casadi.model.tolerances import Tolerances
from dlo_casadi.sensing.measured_pose import MeasuredPose
from dlo_casadi.show.style import BLUE, GREEN, ORANGE
from paper import published
from paper.content import Part, Section, Table, Target, drawing
from paper.fits import REST_COEFFICIENTS
from paper.replica import REVEALING

FloatArray = NDArray[np.floating]

POSES, ELEMENTS = (12, 50, 200, 1000), (10, 20, 50)
# The middle of each series is what the other is measured at.
MIDDLE_ELEMENTS, MIDDLE_POSES = 20, 200
FINE_MESH, POINTS, STD = 40, 100, 3e-4
# Most that time and memory may differ from proportional growth, and the largest case.
MOST_OFF = 0.30
MOST_SECONDS, MOST_GIGABYTES = 60.0, 4.0


def simulated(poses: int) -> list[MeasuredPose]:
    """Poses with ends at random to the right of the start, on the fine mesh, white noise."""
    model = CableModel(published.cable(REVEALING), n=FINE_MESH)
    rest = published.RestShape(published.rest_angles()).on(model)
    solver = CompiledSolver(model, model.nominal, rest)
    rng = np.random.default_rng(0)
    out: list[MeasuredPose] = []
    while len(out) < poses:
        radius = published.LENGTH * np.sqrt(rng.uniform(0.2, 0.9))
        angle = rng.uniform(-0.45 * np.pi, 0.1 * np.pi)
        end = (float(radius * np.cos(angle)), float(radius * np.sin(angle)))
        pose = HeldPose((0.0, 0.0), end, branch="ccw", name=f"{len(out)}")
        shape = solver.solve(pose, throw=False)
        if shape.status != "ok":
            continue
        shapes = Shapes.declared(shape.x[None], shape.end_force[None])
        given = Inputs.of(model.nominal, rest, pose.vector[None])
        z = Assembly(model, shapes, given).curve()[0]
        s = np.linspace(0.01, 0.99, POINTS) * published.LENGTH
        points = NodeCurve.of(published.LENGTH, z).at(s) + STD * rng.standard_normal((POINTS, 2))
        out.append(MeasuredPose.of_points(pose, points))
    return out


def case(poses: int, n: int) -> dict[str, Any]:
    """Fit from prior knowledge to the minimum of the batch NLP; peak memory of the process."""
    measured = simulated(poses)
    before = peak()
    model = CableModel(published.cable(3 * REVEALING), n=n, n_rest=REST_COEFFICIENTS)
    wall, cpu = perf_counter(), process_time()
    fit = fit_model(model, measured, Tolerances())
    fitted = process_time()
    found, _ = solve_batch(fit.problem, fit.point)
    return {
        "poses": poses,
        "n": n,
        "seconds": perf_counter() - wall,
        "cpu_seconds": process_time() - cpu,
        "cpu_seconds_fit": fitted - cpu,
        "cpu_seconds_nlp": process_time() - fitted,
        "gigabytes": peak(),
        "gigabytes_before": before,
        "converged": fit.converged,
        "bending_stiffness": float(fit.problem.unknowns.p(found.theta)[0]),
    }


def peak() -> float:
    """Largest resident memory of this process so far [GB]."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6


def run(tell: Callable[[str], None]) -> Part:
    """All cases, one after the other."""
    rows = []
    for poses in POSES:
        for n in ELEMENTS:
            rows.append(in_process(poses, n))
            tell(json.dumps(rows[-1]))
    part = Part("scale", data={"cases": rows})
    section = Section(
        "scale",
        "Many poses, many elements",
        [
            "The batch problem as a user has it: fit_model from prior knowledge (guess three "
            "times too stiff, noise estimated), then the batch NLP by IPOPT; quadratic elements, "
            f"{POINTS} points a pose, poses drawn at random, EI = {REVEALING:.3f} N m². One "
            "process per case; memory is its peak, with Python and its libraries; time is of the "
            "processor, because the machine was shared.",
        ],
    )
    part.sections = [section]
    section.tables.append(
        Table(
            "Time and memory",
            [
                "poses",
                "n",
                "processor [s]",
                "of which NLP [s]",
                "elapsed [s]",
                "peak [GB]",
                "before",
            ],
            [
                [
                    str(row["poses"]),
                    str(row["n"]),
                    f"{row['cpu_seconds']:.1f}",
                    f"{row['cpu_seconds_nlp']:.1f}",
                    f"{row['seconds']:.1f}",
                    f"{row['gigabytes']:.2f}",
                    f"{row['gigabytes_before']:.2f}",
                ]
                for row in rows
            ],
        )
    )
    growth = growths(rows)
    part.data["growth"] = growth
    section.tables.append(
        Table(
            "Growth: exponent b of cost ~ size^b between the two largest sizes, start-up taken off",
            ["", "poses, n = 20", "n, 200 poses"],
            [
                [name, *(f"{growth[f'{key}_{axis}']:.2f}" for axis in ("poses", "n"))]
                for name, key in (("time", "time"), ("memory", "memory"))
            ],
        )
    )
    _draw(section, rows)
    part.targets = _targets(rows, growth)
    return part


def in_process(poses: int, n: int) -> dict[str, Any]:
    """One case in a process of its own."""
    command = [sys.executable, "-m", "paper.scale", str(poses), str(n)]
    folder = Path(__file__).resolve().parent.parent
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
    if done.returncode:
        raise RuntimeError(f"{poses} poses, n = {n}: {done.stderr.strip().splitlines()[-1]}")
    return dict(json.loads(done.stdout))


def growths(rows: list[dict[str, Any]]) -> dict[str, float]:
    """Exponents by poses and by n of time and of memory beyond what was there before."""

    def cost(key: str, poses: int, n: int) -> float:
        row = next(row for row in rows if (row["poses"], row["n"]) == (poses, n))
        if key == "time":
            return float(row["cpu_seconds"])
        return float(row["gigabytes"] - row["gigabytes_before"])

    out = {}
    for key in ("time", "memory"):
        few, many = POSES[-2:]
        ratio = cost(key, many, MIDDLE_ELEMENTS) / cost(key, few, MIDDLE_ELEMENTS)
        out[f"{key}_poses"] = float(np.log(ratio) / np.log(many / few))
        coarse, fine = ELEMENTS[-2:]
        ratio = cost(key, MIDDLE_POSES, fine) / cost(key, MIDDLE_POSES, coarse)
        out[f"{key}_n"] = float(np.log(ratio) / np.log(fine / coarse))
    return out


def _targets(rows: list[dict[str, Any]], growth: dict[str, float]) -> list[Target]:
    out = []
    for key, name in (("time", "Time"), ("memory", "Memory")):
        for axis, sizes in (("poses", POSES[-2:]), ("n", ELEMENTS[-2:])):
            off = (sizes[1] / sizes[0]) ** (growth[f"{key}_{axis}"] - 1) - 1
            word = "poses" if axis == "poses" else "elements"
            out.append(
                Target(
                    f"{name} against proportional growth from {sizes[0]} to {sizes[1]} {word}",
                    f"at most {100 * MOST_OFF:.0f} % more",
                    f"{100 * off:+.0f} %".replace("-", "−"),
                    off <= MOST_OFF,
                )
            )
    largest = next(row for row in rows if (row["poses"], row["n"]) == (1000, 20))
    out += [
        Target(
            "Time of 1000 poses, n = 20",
            f"at most {MOST_SECONDS:.0f} s",
            f"{largest['cpu_seconds']:.1f} s of the processor, {largest['seconds']:.1f} s elapsed",
            largest["cpu_seconds"] <= MOST_SECONDS,
        ),
        Target(
            "Memory of 1000 poses, n = 20",
            f"at most {MOST_GIGABYTES:.0f} GB",
            f"{largest['gigabytes']:.2f} GB",
            largest["gigabytes"] <= MOST_GIGABYTES,
        ),
    ]
    return out


def _draw(section: Section, rows: list[dict[str, Any]]) -> None:
    caption = "Time and memory against the number of poses; dashed: proportional to the largest."
    with drawing(section, "scale", caption, (8.6, 3.6)) as figure:
        for axes, key, label in zip(
            figure.subplots(1, 2),
            ("cpu_seconds", "gigabytes"),
            ("processor time [s]", "peak memory [GB]"),
            strict=True,
        ):
            for n, color in zip(ELEMENTS, (ORANGE, BLUE, GREEN), strict=True):
                values = [row[key] for row in rows if row["n"] == n]
                axes.loglog(POSES, values, "o-", color=color, label=f"n = {n}")
                if key == "cpu_seconds":
                    straight = values[-1] * np.array(POSES) / POSES[-1]
                    axes.loglog(POSES, straight, "--", color=color, lw=0.8)
            axes.set_xticks(POSES, [str(m) for m in POSES])
            axes.set_xticks([], minor=True)
            axes.set_xlabel("poses")
            axes.set_ylabel(label)
        figure.axes[0].legend()


if __name__ == "__main__":
    print(json.dumps(case(int(sys.argv[1]), int(sys.argv[2]))))
