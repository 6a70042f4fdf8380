"""Predict a pose: python scripts/predict.py results/cable --end X Y, the same as `dlo predict`."""

import sys

from dlo_casadi.cli import main

if __name__ == "__main__":
    sys.exit(main(["predict", *sys.argv[1:]]))
