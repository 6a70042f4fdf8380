"""Fit a cable: python scripts/fit.py configs/cable.yaml, the same as `dlo fit`."""

import sys

from dlo_casadi.cli import main

if __name__ == "__main__":
    sys.exit(main(["fit", *sys.argv[1:]]))
