"""`dlo reproduce`: the comparison with the paper."""

from functools import partial

from dlo_casadi.cli.checkout import run_script

DESCRIPTION = (
    "Compare with the paper of Quartaro et al.; runs scripts/reproduce_paper.py of a checkout."
)

main = partial(run_script, "reproduce", DESCRIPTION, "reproduce_paper.py")
