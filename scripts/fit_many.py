"""Fit many cables: python scripts/fit_many.py FOLDER [--jobs N], the same as `dlo fit-many`."""

import sys

from dlo_casadi.cli import main

if __name__ == "__main__":
    sys.exit(main(["fit-many", *sys.argv[1:]]))
