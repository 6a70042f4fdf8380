"""Bench sessions on a coarse mesh, without the parts that take time."""

from dataclasses import replace
from pathlib import Path

from dlo_casadi.config import load_config

BENCH = Path(__file__).parents[1] / "data" / "bench"


def small(name):
    """Configuration of a quick run of a bench session."""
    config = load_config(BENCH / name / "session.yaml")
    return replace(
        config,
        model=config.model.model_copy(update={"n": 20}),
        estimation=config.estimation.model_copy(update={"algorithm1": False}),
        diagnosis=config.diagnosis.model_copy(update={"enabled": False}),
    )
