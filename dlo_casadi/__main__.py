"""`python -m dlo_casadi` is the command `dlo`."""

import sys

from dlo_casadi.cli import main

if __name__ == "__main__":
    sys.exit(main())
