"""Cells of the tables that hold sessions against their truth."""

from __future__ import annotations

from dlo_casadi.session.outcome import Outcome


def stiffness_cell(outcome: Outcome, name: str, exact: float) -> tuple[str, bool]:
    """A stiffness with its interval, and whether the truth lies inside."""
    found = outcome.stages[-1].parameters[name]
    low, high = found.interval_95 or (None, None)
    inside = low is not None and high is not None and low <= exact <= high
    told = "unbounded" if low is None or high is None else f"{low:.4g} to {high:.4g}"
    return f"{found.value:.4g} ({told}; {exact:g})", inside
