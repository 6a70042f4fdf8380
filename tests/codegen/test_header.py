"""Texts of the generated header."""

import re

import numpy as np
import pytest

from dlo_casadi.codegen import generate
from dlo_casadi.effects import CableData
from dlo_casadi.model.cable_model import CableModel


@pytest.mark.parametrize("obstacles", [0, 1])
def test_the_header_of_a_planar_solver_names_its_columns(obstacles):
    """Four of the ends; the start's place in addition if the cable may touch obstacles."""
    model = CableModel(CableData(0.8, 0.2, 0.01, 0.05), 4, n_rest=0)
    source = generate(model, model.nominal, np.zeros(model.chain.n_rests), obstacles=obstacles)
    header = source.files["dlo_solver.h"].replace("\n * ", " ")
    assert f"#define DLO_COLUMNS {6 if obstacles else 4} " in header
    assert "in a solver with obstacles the last two are start x, start y [m]" in header
    assert re.search("Without obstacles, moving the start fixture by d", header)
