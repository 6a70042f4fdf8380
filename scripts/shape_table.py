"""Shapes in many poses: python scripts/shape_table.py results/cable ..., or `dlo shape-table`."""

import sys

from dlo_casadi.cli import main

if __name__ == "__main__":
    sys.exit(main(["shape-table", *sys.argv[1:]]))
