"""The generated solver starts from the guesses of equilibrium.py, number for number."""

import ctypes
import shutil
from dataclasses import replace

import numpy as np
import pytest

from dlo_casadi.codegen import generate
from dlo_casadi.codegen.compiler import compile_library, workspace_of
from dlo_casadi.effects import CableData, ClampAngle, EndOffset, LengthError
from dlo_casadi.equilibrium.equilibrium import JOINT_BOUND
from dlo_casadi.equilibrium.guesses import guesses
from dlo_casadi.equilibrium.pose import HeldPose
from dlo_casadi.model.cable_model import CableModel

pytestmark = pytest.mark.skipif(shutil.which("cc") is None, reason="no C compiler (cc)")

# The list is not public: seen from behind the solver's own text.
WINDOW = """
int dlo_guess(const dlo_pose *pose, int which, double *headings, double *work);
int dlo_guess(const dlo_pose *pose, int which, double *headings, double *work)
{
    solver_t w;
    int i, there;
    lay_out(&w, TABLE, work);
    if (which >= GUESSES || take(&w, pose) != DLO_OK)
        return 0;
    there = first_guess(&w, which);
    for (i = 0; i < DLO_NODES; ++i)
        headings[i] = w.at.x[i];
    return there;
}
"""
BOUNDARIES = [
    *(("pinned", "pinned"), ("clamped", "pinned"), ("pinned", "clamped"), ("clamped", "clamped")),
    *(("pinned", "free"), ("clamped", "free")),
]


def by_c(model, p, rest, poses, folder):
    """First guesses of all poses from the generated text."""
    source = generate(model, p, rest)
    texts = dict(source.files)
    texts["dlo_solver.c"] += WINDOW
    library = ctypes.CDLL(str(compile_library(replace(source, files=texts), folder, ("-O0",))))
    pointer = ctypes.c_void_p
    library.dlo_guess.argtypes = [pointer, ctypes.c_int, pointer, pointer]
    work, found = np.empty(workspace_of(library)), []
    for pose in poses:
        at, found_here = pose.vector, []
        for which in range(5):
            phi = np.zeros(model.chain.n_nodes)
            if library.dlo_guess(at.ctypes.data, which, phi.ctypes.data, work.ctypes.data):
                found_here.append(phi)
        found.append(found_here)
    return found


@pytest.mark.parametrize("element", ["link", "arc"])
@pytest.mark.parametrize(("start", "end"), BOUNDARIES)
def test_both_lists_are_one(tmp_path, element, start, end):
    """Where the ends really are, of a cable as long as it really is."""
    effects = [LengthError("longer"), ClampAngle(start=start == "clamped", end=end == "clamped")]
    effects += [] if end == "free" else [EndOffset()]
    cable = CableData(0.8, 0.2, 0.01, 0.1)
    model = CableModel(cable, 12, element, start, end, effects=tuple(effects), gravity=(2.0, -9.0))
    p = model.nominal + np.array([0.0, *np.linspace(0.01, 0.03, len(model.names) - 1)])
    rng = np.random.default_rng(0)
    rest = np.full(model.chain.n_cells, 6.0) + rng.normal(size=model.chain.n_cells)
    poses = [
        HeldPose(
            (0.1, -0.1),
            None if end == "free" else tuple(0.5 * rng.uniform(-1, 1, size=2)),
            rng.uniform(-np.pi, np.pi) if start == "clamped" else None,
            rng.uniform(-np.pi, np.pi) if end == "clamped" else None,
        )
        for _ in range(6)
    ]
    for pose, theirs in zip(poses, by_c(model, p, rest, poses, tmp_path), strict=True):
        ours = guesses(model, p, rest, pose)
        assert len(ours) >= (3 if (start, end) == ("pinned", "pinned") or end == "free" else 2)
        np.testing.assert_allclose(ours, theirs, rtol=0, atol=1e-12)  # rounding
        assert np.abs(np.diff(ours[0])).max() < JOINT_BOUND


def test_clamps_hold_their_headings_and_the_far_way_is_a_turn_away():
    model = CableModel(CableData(0.8, 0.2, 0.01, 0.1), 40, start="clamped", end="pinned")
    pose = HeldPose((0.0, 0.0), (0.7, 0.0), start_heading=2.9)
    found = guesses(model, model.nominal, np.zeros(40), pose)
    assert len(found) == 4
    for phi in found:
        assert phi[0] == 2.9
    for near, far in zip(found[:2], found[2:], strict=True):
        assert abs(far[-1] - near[-1]) == pytest.approx(2 * np.pi)
