"""Predict a pose: python scripts/predict.py results/cable/parameters.yaml --end X Y."""

import os
import sys

for variable in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS"):
    os.environ.setdefault(variable, "1")  # the matrices are small: threads would only cost

from dlo_casadi.cli import main_predict  # noqa: E402

if __name__ == "__main__":
    sys.exit(main_predict())
