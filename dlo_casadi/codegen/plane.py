"""What the templates of a cable in a plane are filled with."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from dlo_casadi.codegen.kernels import (
    Kernels,
    c_number,
    kernels_of,
    size_of_code,
    table_to_c,
)
from dlo_casadi.equilibrium.guesses import resting_headings
from dlo_casadi.model.cable_model import CableModel
from dlo_casadi.model.functions import functions_of
from dlo_casadi.model.lagrangian import lagrangian_of

FloatArray = NDArray[np.floating]

# Doubles of a workspace per slot; as in the template.
_ARRAYS = 38
# Newton steps for a part of a path; the template checks the number.
TRY_STEPS = 13
# Parts of the templates.
TEXTS = {
    "WHERE": "in a plane",
    "ANGLES": """Angles are headings against the x axis of the board frame,
 * counter-clockwise positive, continuous along the cable (a full clockwise turn ends at -2 pi).""",
    "COLUMNS": "4",
    "NODES": "\n#define DLO_N_HEADINGS @N_HEADINGS@ /* @HEADINGS_ARE@ */",
    "START_FRAME": "start_heading",
    "END_FRAME": "end_heading",
    "BRANCH": """\
 *   branch     in   which equilibrium. Between two pins DLO_LOWEST costs two solves, or five for
 *                   a cable that is curved at rest; a named branch costs one, for it takes the
 *                   first equilibrium that turns as asked for. With a clamp two to four solves are
 *                   made, with a free end three, and the lowest that turns so is taken. Where
 *                   none is found to turn so the status is DLO_OTHER_BRANCH.""",
    "SNAP": "snap-through",
    "POSE": "{0.0, 0.0}, {0.6 * DLO_LENGTH, 0.1 * DLO_LENGTH}, 0.5, -0.5",
}


def _extra(model: CableModel, p: FloatArray) -> list[float]:
    """Numbers of the cable that no kernel holds, in the order of the template's macros."""
    down = float(np.arctan2(model.gravity[1], model.gravity[0])) if any(model.gravity) else 0.0
    offsets, length = lagrangian_of(model).held(p, 0, 0)
    compliance = clamp_compliances(model, p)
    hold = [1 / c if c > 0 else 0.0 for c in compliance]
    dead_load, turns = (
        np.array(functions_of(model).dead_load(p)).ravel(),
        np.array(offsets).ravel()[2:],
    )
    return [float(length), down, *dead_load, *turns, *hold]


def clamp_compliances(model: CableModel, p: FloatArray) -> list[float]:
    """Turn of the start and end clamp per moment on it [rad/(N m)]."""
    found = zip(
        lagrangian_of(model).compliant,
        np.array(lagrangian_of(model).compliances(p)).ravel(),
        strict=True,
    )
    named = {model.condition_names[k]: float(c) for k, c in found}
    return [named.get(f"{side}_heading", 0.0) for side in ("start", "end")]


def numbers_of(model: CableModel, p: FloatArray, rest: FloatArray, kernels: Kernels) -> list[float]:
    """The solver's table: numbers of the kernels, nodes, widths of the cells, rest, the others."""
    stretch = float(lagrangian_of(model).held(p, 0, 0)[1]) / model.cable.length
    return [
        *kernels.table,
        *(model.chain.places / model.cable.length),
        *(1 / (np.diff(model.chain.cells, axis=1).ravel() * stretch)),
        *resting_headings(model.chain, rest),
        *_extra(model, p),
    ]


def _most_steps(model: CableModel) -> int:
    """Newton steps of a cold solve after a warm start in vain; the template checks the number.

    Each first guess is descended from freely, then led by springs in 15 stages; a descent takes 100
    steps, and 6 more off saddles.
    """
    guesses = 5 if (model.start, model.end) == ("pinned", "pinned") else 4
    return (1 + 16 * guesses) * (100 + 6)


def values(model: CableModel, p: FloatArray, rest: FloatArray, inline: bool) -> dict[str, str]:
    """What the marks of the templates stand for."""
    kernels = kernels_of(model, p, rest, inline)
    functions, loops = kernels.to_c(model.yields)
    chain, rows = model.chain, len(kernels.table)
    count, gives = chain.n_nodes, [c > 0 for c in clamp_compliances(model, p)]
    numbers = numbers_of(model, p, rest, kernels)
    return {
        "N_HEADINGS": str(count),
        "HEADINGS_ARE": chain.kind.nodes_are,
        "LENGTH": c_number(float(lagrangian_of(model).held(p, 0, 0)[1])),
        "WORKSPACE": str(_ARRAYS * (count + 1)),
        "ELEMENTS": str(chain.n_slots),
        "FIRST": str(chain.layout.advancing[0]),
        "LOW": str(int(model.start == "clamped" and not gives[0])),
        "HIGH": str(count - int(model.end == "clamped" and not gives[1])),
        "GIVES_START": str(int(gives[0])),
        "GIVES_END": str(int(gives[1])),
        "SMOOTH": str(int(chain.kind.smooth)),
        "STRETCHES": str(int(model.extensible)),
        "TABLE": table_to_c(numbers),
        "PLACES": str(rows),
        "WIDTHS": str(rows + count),
        "RESTING": str(rows + 2 * count - 1),
        "EXTRA": str(rows + 3 * count - 1),
        # Elimination and solution: about 30 operations a node; the trial point is evaluated, too.
        "OPERATIONS": str(2 * kernels.operations + 30 * count),
        "STEPS": str(_most_steps(model)),
        "CODE": str(size_of_code([kernels], numbers)),
        "KERNELS": functions,
        "LOOPS": loops,
    }
