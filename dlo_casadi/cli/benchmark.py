"""`dlo benchmark`: the C solver beside other solvers."""

from functools import partial

from dlo_casadi.cli.checkout import run_script

DESCRIPTION = "Time the C solver beside other solvers: runs scripts/benchmark.py of the checkout."

main = partial(run_script, "benchmark", DESCRIPTION, "benchmark.py")
