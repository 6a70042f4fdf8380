"""Planar solvers with obstacles: independent of the stack's content, and complete for two pins."""

import shutil
from dataclasses import replace

import numpy as np
import pytest

from dlo_casadi.codegen import CompiledSolver, Plane, compiled
from dlo_casadi.effects import CableData
from dlo_casadi.equilibrium.pose import HeldPose
from dlo_casadi.model.cable_model import CableModel

pytestmark = pytest.mark.skipif(shutil.which("cc") is None, reason="no C compiler (cc)")

TABLE = Plane((0.0, -0.2), (0.0, 1.0))
POSE = HeldPose((0.0, 0.0), (0.7, 0.0), branch="ccw")


def solver_on(content: int, monkeypatch) -> CompiledSolver:
    """A solver between two pins, whose functions find these bytes on their stack."""
    filled = f"solver_t w; memset(&w, {content}, sizeof w);"

    def generate(*arguments, **options):
        source = compiled_generate(*arguments, **options)
        texts = {
            name: f"#include <string.h>\n{text}".replace("solver_t w;", filled)
            if name.endswith(".c")
            else text
            for name, text in source.files.items()
        }
        return replace(source, files=texts)

    compiled_generate = compiled.generate
    monkeypatch.setattr(compiled, "generate", generate)
    model = CableModel(CableData(1.0, 0.2, 0.012, 0.03), 8, "arc", n_rest=0)
    strict = ("-O0", "-Wall", "-Wextra", "-Wpedantic", "-Werror")
    rest = np.zeros(model.chain.n_rests)
    solver = CompiledSolver(model, model.nominal, rest, flags=strict, obstacles=1)
    monkeypatch.undo()
    return solver


def test_results_do_not_depend_on_the_content_of_the_stack(monkeypatch):
    """Bytes 0x7f: a huge number as a double, positive as an integer."""
    moved, results = replace(POSE, end=(0.7, 0.001)), []
    for content in (0, 0x7F):
        solver = solver_on(content, monkeypatch)
        lying = solver.solve(POSE, obstacles=[TABLE])
        assert lying.obstacle_forces.any()
        path = solver.path([POSE, moved], obstacles=[TABLE]).shapes
        step = solver.step(lying, moved, steps=8, obstacles=[TABLE])
        slope = solver.sensitivity(lying, POSE, obstacles=[TABLE])
        assert [shape.status for shape in (step, *path)] == ["ok"] * 3
        results.append([vars(one) for one in (lying, step, *path, slope)])
    np.testing.assert_equal(*results)
