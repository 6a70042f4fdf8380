"""`python -m dlo_casadi` is the command `dlo`."""

from dlo_casadi.cli import main

if __name__ == "__main__":
    raise SystemExit(main())
