"""A session: what is declared and measured -> stages and findings -> one outcome."""

from dlo_casadi.session.outcome import Outcome
from dlo_casadi.session.run import Progress, run_session
