"""The mesh that is asked for is the mesh that is used, and the one that is warned of."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from dlo_casadi.config import load_config
from dlo_casadi.session import run_session

BENCH = Path(__file__).resolve().parents[1] / "data" / "bench"


def test_a_declared_mesh_is_kept_and_its_error_told():
    config = load_config(BENCH / "short_clean" / "session.yaml")
    coarse = config.model.model_copy(update={"n": 6})
    estimation = config.estimation.model_copy(update={"algorithm1": False})
    outcome = run_session(replace(config, model=coarse, estimation=estimation))
    assert outcome.discretization.n == 6
    (warning,) = [text for text in outcome.warnings if "mesh" in text]
    assert f"{1e3 * outcome.discretization.error:.3g} mm" in warning
    assert "the mesh of 6 elements" in warning
