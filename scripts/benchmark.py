"""Benchmark of the generated C solver, of its peers and of many sessions.

    python scripts/benchmark.py --output DIR [--only PART ...]

Parts that need an extra which is not installed are left out, and named; one that is asked for by
--only without it is refused. Prints the compiler and its flags; saves benchmark.json and
figures. Everything runs on one machine in one run; medians and 99th percentiles are over all
solves, "best" is the median over the poses of each pose's fastest. Single solves are timed by what
they take of the processor.
"""

import argparse
import json
import sys
from collections.abc import Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import matplotlib as mpl

mpl.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
from benchmarks import (
    fleet,
    memory,
    peers,
    space_peers,
    space_speed,
    speed,
)
from cables import free
from cables.ipopt import Ipopt

from dlo_casadi.codegen import STATUSES
from dlo_casadi.io.files import make_folder, write_file
from dlo_casadi.rod.chain import ELEMENTS, ELEMENTS_IN_SPACE

PARTS = (
    *("speed", "growth", "throughput", "random", "starts", "ipopt", "memory", "peers", "fleet"),
    *("space", "space_random", "space_peers"),
)
# Part -> extra of the package that it needs, and the module imported from it.
EXTRAS = {"fleet": ("table,dask", ("pyarrow", "distributed"))}


def run_speed() -> dict[str, Any]:
    """All methods at n = 10, links, the paper's twelve poses."""
    out: dict[str, Any] = {
        "generated": speed.generated(10, "link", 1000),
        "bare_newton": speed.bare(10, 50),
        "sqpmethod_qrqp": speed.by_casadi(10, "sqp", 50),
        "ipopt": speed.by_casadi(10, "ipopt", 20),
        "cobyla": speed.by_cobyla(10),
    }
    ours = out["generated"]["median"]
    out["times_bare_newton"] = out["generated"]["best"] / out["bare_newton"]["best"]
    out["faster_than"] = {
        name: out[name]["median"] / ours for name in ("sqpmethod_qrqp", "ipopt", "cobyla")
    }
    return out


def run_growth() -> dict[str, Any]:
    """Time against n, of each method up to the largest n that it can take."""
    sizes = (10, 20, 50, 100, 200, 500, 1000)
    out: dict[str, Any] = {"n": sizes}
    for element in ELEMENTS:
        out[element] = [speed.generated(n, element, max(50, 2000 // n)) for n in sizes]
        per_element = np.array([row["best"] for row in out[element]]) / np.array(sizes)
        out[f"{element}_spread"] = float(per_element.max() / per_element.min())
    out["bare_newton"] = [speed.bare(n, 5) for n in sizes]
    for kind in ("sqp", "ipopt"):
        out[kind] = [speed.by_casadi(n, kind, 3) for n in sizes[:4]]
    return out


def run_random(cables: int, poses: int) -> dict[str, Any]:
    """Random cables and poses: statuses, end errors, stability by the Python model."""
    out: dict[str, Any] = {}
    for element in ELEMENTS:
        rng = np.random.default_rng(0)
        solver = free.AnyCable(free.random_problem(rng, 1, element=element))
        ok, wrong, worst, total, slowest = 0, 0, 0.0, 0.0, 0.0
        for _ in range(cables):
            problem = free.random_problem(rng, poses, element=element)
            shapes, statuses, seconds = solver.solve(problem)
            total, slowest = total + seconds, max(slowest, seconds / poses)
            for shape, status, end in zip(shapes, statuses, problem.ends, strict=True):
                if status:
                    continue
                ok += 1
                stable, error = free.check(problem, shape, end)
                wrong += not stable
                worst = max(worst, error)
        out[element] = {
            "problems": cables * poses,
            "ok_share": ok / (cables * poses),
            "ok_but_not_a_stable_equilibrium": wrong,
            "worst_end_error_m": worst,
            "mean_seconds": total / (cables * poses),
            "slowest_cable_mean_seconds": slowest,
        }
        print(element, out[element], flush=True)
    return out


def run_starts(problems: int) -> dict[str, Any]:
    """Random cables held in every way: how often 24 random starts find a lower equilibrium."""
    out: dict[str, Any] = {}
    for start, end in free.BOUNDARIES:
        count, _ = free.missed(np.random.default_rng(0), start, end, problems)
        out[f"{start}-{end}"] = {"problems": problems, "missed": count}
        print(out, flush=True)
    return out


def run_ipopt(problems: int) -> dict[str, Any]:
    """The lowest equilibrium found against that of IPOPT from the same first guesses."""
    rng = np.random.default_rng(1)
    solver = free.AnyCable(free.random_problem(rng, 5))
    counts: dict[str, int] = {}
    for _ in range(problems // 5):
        problem = free.random_problem(rng, 5)
        shapes, statuses, _ = solver.solve(problem)
        for shape, status, end in zip(shapes, statuses, problem.ends, strict=True):
            word = free.compare_with_ipopt(problem, shape, end) if not status else "failed"
            counts[word] = counts.get(word, 0) + 1
    compared = sum(n for word, n in counts.items() if word != "ipopt_failed")
    good = counts.get("same", 0) + counts.get("lower", 0)
    return {**counts, "same_or_lower_share": good / compared}


def run_space() -> dict[str, Any]:
    """Time and error in space: fine meshes against each other, cold and warm, and growth with n."""
    out: dict[str, Any] = {}
    for element, sizes in (("arc", (12, 24, 48, 96)), ("quadratic", (6, 12, 24, 48))):
        out[element] = {n: space_speed.timed(n, element) for n in sizes}
    rows = [(n, space_speed.per_element(n, "arc")) for n in (10, 20, 50, 100, 200, 500, 1000)]
    times = np.array([seconds for _, seconds in rows])
    line = np.exp(np.log(times).mean())
    out["growth"] = {
        "per_element": rows,
        "largest_over_smallest": times.max() / times.min(),
        "farthest_from_the_line": np.abs(times / line - 1).max(),
    }
    out["softening"] = {n: space_speed.softening(n) for n in (12, 24)}
    print("softening", out["softening"], flush=True)
    out["clips"] = {}
    for kinds in (
        *(("pinned",), ("eyelet",), ("pinned", "pinned")),
        *(("clamped", "pinned"), ("pinned", "eyelet"), ("clamped", "eyelet")),
    ):
        for where in (space_speed.near, space_speed.slack):
            row = space_speed.clipped(kinds, where(kinds))
            out["clips"][f"{' '.join(kinds)}, {where.__name__}"] = row
            print(kinds, where.__name__, row, flush=True)
    return out


def run_space_random(cables: int, poses: int, compared: int) -> dict[str, Any]:
    """Random clamped cables in space: statuses, checks by the Python model, IPOPT's energies."""
    out: dict[str, Any] = {}
    for element in ELEMENTS_IN_SPACE:
        rng = np.random.default_rng(0)
        solver = free.AnyCable(free.space_problem(rng, 1, 12, element))
        counts = {
            "ok": 0,
            "turns_shed": 0,
            "wrong": 0,
            "same": 0,
            "lower": 0,
            "higher": 0,
            "ipopt_failed": 0,
        }
        ipopt = Ipopt(free.space_problem(rng, 1, 12, element).model)
        worst, total = 0.0, 0.0
        for cable in range(cables):
            problem = free.space_problem(rng, poses, 12, element)
            shapes, statuses, seconds = solver.solve(problem)
            total += seconds
            for status in ("ok", "turns_shed"):
                counts[status] += int(np.count_nonzero(statuses == STATUSES.index(status)))
            for i in np.flatnonzero(statuses == 0)[: max(1, 2000 // cables)]:
                right, error = free.check_in_space(problem, shapes[i], i)
                counts["wrong"] += not right
                worst = max(worst, error)
            share = compared * (cable + 1) // cables - compared * cable // cables
            for i in np.flatnonzero(statuses == 0)[:share]:
                counts[free.compare_in_space(problem, shapes[i], i, ipopt)] += 1
        out[element] = {
            "problems": cables * poses,
            **counts,
            "worst_end_error": worst,
            "mean_seconds": total / (cables * poses),
        }
        print(element, out[element], flush=True)
    return out


def draw(growth: dict[str, Any], path: Path) -> None:
    """Time against n."""
    figure, axes = plt.subplots(figsize=(6.4, 4.2), layout="constrained")
    sizes = np.array(growth["n"])
    for name, label in (
        ("ipopt", "IPOPT"),
        ("sqp", "sqpmethod + qrqp, generated C"),
        ("arc", "generated solver, arcs"),
        ("quadratic", "generated solver, quadratic"),
        ("link", "generated solver, links"),
        ("bare_newton", "bare Newton, links"),
    ):
        rows = growth[name]
        median = 1e6 * np.array([row["median"] for row in rows])
        high = 1e6 * np.array([row["p99"] for row in rows])
        (line,) = axes.loglog(sizes[: len(rows)], median, "o-", label=label)
        axes.loglog(sizes[: len(rows)], high, ":", color=line.get_color())
    axes.set_xlabel("elements n")
    axes.set_ylabel("time per cold solve [µs]; dotted: 99th percentile")
    axes.legend()
    axes.grid(visible=True, which="both", alpha=0.3)
    figure.savefig(path, dpi=150)


def without_extra(parts: Sequence[str]) -> dict[str, str]:
    """Parts whose extra is not installed, and what to do about it."""
    return {
        part: f"{part} needs {' and '.join(modules)}. Try: pip install -e '.[{extra}]'"
        for part, (extra, modules) in EXTRAS.items()
        if part in parts and not all(find_spec(module) for module in modules)
    }


def main() -> int:
    """Run the parts, print and save."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--output", type=Path, default=Path("results/benchmark"))
    parser.add_argument("--only", nargs="+", choices=PARTS)
    parser.add_argument("--cables", type=int, default=1000, help="random cables, 100 poses each")
    parser.add_argument("--start-problems", type=int, default=400, help="of each boundary")
    parser.add_argument("--ipopt-problems", type=int, default=2000)
    chosen = parser.parse_args()
    missing = without_extra(chosen.only or PARTS)
    if missing and chosen.only:
        parser.error("; ".join(missing.values()))
    parts = [part for part in chosen.only or PARTS if part not in missing]
    for text in missing.values():
        print(f"left out: {text}", flush=True)
    make_folder(chosen.output)
    runs = {
        "speed": run_speed,
        "growth": run_growth,
        "throughput": speed.throughput,
        "random": lambda: run_random(chosen.cables, 100),
        "starts": lambda: run_starts(chosen.start_problems),
        "ipopt": lambda: run_ipopt(chosen.ipopt_problems),
        "memory": memory.run,
        "peers": peers.run,
        "fleet": fleet.run,
        "space": run_space,
        "space_random": lambda: run_space_random(chosen.cables, 100, chosen.ipopt_problems),
        "space_peers": space_peers.run,
    }
    result: dict[str, Any] = {"compiler": speed.compiler(), "flags": list(speed.FLAGS)}
    result["left_out"] = list(missing)
    print(json.dumps(result), flush=True)
    for part in parts:
        result[part] = runs[part]()
        print(part, json.dumps(result[part], indent=1), flush=True)
        if part == "growth":
            draw(result[part], chosen.output / "benchmark.png")
        if part == "space_peers":
            space_peers.draw(result[part]["rows"], chosen.output / "space_peers.png")
    write_file(chosen.output / "benchmark.json", json.dumps(result, indent=1) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
