"""Write a C solver: python scripts/generate_solver.py PARAMETERS --output DIR, as `dlo` does."""

import sys

from dlo_casadi.cli import main

if __name__ == "__main__":
    sys.exit(main(["generate-solver", *sys.argv[1:]]))
