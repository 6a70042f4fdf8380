"""One session: its configuration and measurements -> stages and findings -> one outcome."""

from dlo_casadi.session.outcome import Outcome
from dlo_casadi.session.run import Progress, run_session
