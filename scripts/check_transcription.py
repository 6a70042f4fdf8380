"""Time and sparsity of a cable's equations, and a way past a ball whose shapes are unknowns.

    python scripts/check_transcription.py [--elements N ...]

For each number of elements, in space: entries and time of the Hessian of the equations' weighted
sum; then examples/carry_past.py: fifteen poses, a ball and a limit of the bend, its time with all
that is built for it, and the clearance of its shapes on five times as many elements. Times are
processor times. Exit code 1 above 8 ms at 16 elements, above 30 s, or 0.5 mm less clear than asked.
"""

import argparse
import sys
from collections.abc import Callable, Sequence
from time import process_time

import casadi as ca
import numpy as np
from examples import carry_past

FINE = 60  # elements
MOST = {"hessian": 8e-3, "way": 30.0, "clearance": 0.5e-3}  # s at 16 elements, s, m


def fastest(run: Callable[[], object], times: int = 20) -> float:
    """Shortest processor time of a call [s]."""
    taken = []
    for _ in range(times):
        begun = process_time()
        run()
        taken.append(process_time() - begun)
    return min(taken)


def hessian_of(n: int) -> tuple[int, int, float]:
    """Entries of the Hessian, of how many, and its time [s]."""
    known = carry_past.cable(n)
    pose = [0, 0, 0, *carry_past.STARTS, *carry_past.FORWARD, *carry_past.FORWARD, 0]
    system, first = known.equations(), known.initial(pose)
    x, multipliers, at = system.mx_in()
    residual = system(x, multipliers, at)[0]
    weights = ca.MX.sym("weights", residual.numel())
    found, _ = ca.hessian(ca.dot(weights, residual), ca.veccat(x, multipliers, at))
    function = ca.Function("hessian", [x, multipliers, at, weights], [found])
    given = [first.x, first.multipliers, pose, np.ones(residual.numel())]
    return found.nnz(), found.numel(), fastest(lambda: function(*given))


def way_of(n: int) -> tuple[float, int, float]:
    """Time [s] and iterations of the example, and the smallest clearance of its shapes [m]."""
    begun = process_time()
    known = carry_past.cable(n)
    ends, _, stats = carry_past.carried(known)
    taken, fine = process_time() - begun, known.with_mesh(FINE)
    frames = dict.fromkeys(("start_orientation", "end_orientation"), carry_past.FORWARD)
    shapes = [fine.solve(end, start=(0.0, 0.0, 0.0), **frames) for end in ends.T]
    apart = [np.linalg.norm(shape.points - carry_past.CENTER, axis=1).min() for shape in shapes]
    room = carry_past.RADIUS + known.model.cable.diameter / 2
    return taken, int(str(stats["iter_count"])), float(min(apart) - room)


def main(argv: Sequence[str] | None = None) -> int:
    """Print a line for each number of elements."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--elements", type=int, nargs="*", default=[12, 16, 24])
    bad = False
    for n in parser.parse_args(argv).elements:
        entries, size, time = hessian_of(n)
        print(f"{n} elements: Hessian {entries} of {size} entries, {1e3 * time:.2f} ms", flush=True)
        bad |= n == 16 and time > MOST["hessian"]
        taken, count, clear = way_of(n)
        print(
            f"  a way of {carry_past.STEPS} poses: {taken:.1f} s, {count} iterations, "
            f"{1e3 * clear:.2f} mm clear",
            flush=True,
        )
        bad |= taken > MOST["way"] or clear < carry_past.CLEAR - MOST["clearance"]
    return int(bad)


if __name__ == "__main__":
    sys.exit(main())
