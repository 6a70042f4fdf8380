"""Fit a cable: python scripts/fit.py configs/cable.yaml [--output DIR]."""

import os
import sys

for variable in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS"):
    os.environ.setdefault(variable, "1")  # the matrices are small: threads would only cost

from dlo_casadi.cli import main_fit  # noqa: E402

if __name__ == "__main__":
    sys.exit(main_fit())
