"""Many sessions: one row each in a table, and a page that shows the odd ones first."""

from dlo_casadi.fleet.discover import Session, find_sessions
from dlo_casadi.fleet.one import Options
from dlo_casadi.fleet.run import FleetResult, fit_fleet

__all__ = ["FleetResult", "Options", "Session", "find_sessions", "fit_fleet"]
