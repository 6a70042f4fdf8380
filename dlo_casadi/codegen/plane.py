"""What the templates of a cable in a plane are filled with."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from dlo_casadi.codegen.kernels import Kernels, kernels_of
from dlo_casadi.equilibrium.guesses import resting_headings
from dlo_casadi.model.cable_model import CableModel
from dlo_casadi.model.functions import functions_of
from dlo_casadi.model.lagrangian import lagrangian_of

FloatArray = NDArray[np.floating]

# Doubles of a workspace per node, as in the template: arrays, the border, segments of two points.
_NUMBERS = 12 + 2 + 2 * 15
# Newton steps for a part of a path.
TRY_STEPS = 13
# Parts of the templates.
TEXTS = {
    "METHOD": """\
 * Steps are accepted by the exact penalty function V + nu |end error|, with a second-order
 * correction. A joint that reaches +-pi/2 is held there by an augmented Lagrangian.""",
    "WHERE": "in a plane",
    "ANGLES": """Angles are headings against the x axis of the board frame,
 * counter-clockwise positive, continuous along the cable (a full clockwise turn ends at -2 pi).""",
    "STATES_ARE": "headings of the nodes [rad]",
    "COLUMNS_ARE": """\
end x, end y [m], start heading,
 * end heading [rad]. Moving the start fixture by d has the effect of moving everything by d and
 * then the end by -d.""",
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


def numbers_of(model: CableModel, p: FloatArray, rest: FloatArray) -> list[float]:
    """Numbers of the cable that no kernel holds, in the order of the template's macros."""
    down = float(np.arctan2(model.gravity[1], model.gravity[0])) if any(model.gravity) else 0.0
    offsets, length = lagrangian_of(model).held(p, 0, 0)
    stretch = float(length) / model.cable.length
    return [
        float(length),
        down,
        *np.array(functions_of(model).dead_load(p)).ravel(),
        *np.array(offsets).ravel()[2:],
        *(1 / c if c > 0 else 0.0 for c in clamp_compliances(model, p)),
        *(model.chain.places / model.cable.length),
        *resting_headings(model.chain, rest),
        *(1 / (np.diff(model.chain.cells, axis=1).ravel() * stretch)),
    ]


def clamp_compliances(model: CableModel, p: FloatArray) -> list[float]:
    """Turn of the start and end clamp per moment on it [rad/(N m)]."""
    found = zip(
        lagrangian_of(model).compliant,
        np.array(lagrangian_of(model).compliances(p)).ravel(),
        strict=True,
    )
    named = {model.condition_names[k]: float(c) for k, c in found}
    return [named.get(f"{side}_heading", 0.0) for side in ("start", "end")]


def meshes_of(
    model: CableModel, p: FloatArray, rest: FloatArray, inline: bool
) -> dict[str, Kernels]:
    """Kernels of the mesh, by their name in C."""
    return {"kernel": kernels_of(model, p, rest, inline)}


def _most_steps(model: CableModel) -> int:
    """Newton steps of a cold solve after a warm start in vain; the template checks the number.

    Each first guess is descended from freely, then led by springs in 15 stages; a descent takes 100
    steps, and 6 more off saddles.
    """
    guesses = 5 if (model.start, model.end) == ("pinned", "pinned") else 4
    return (1 + 16 * guesses) * (100 + 6)


def values(model: CableModel, p: FloatArray, meshes: dict[str, Kernels]) -> dict[str, str]:
    """What the marks of the templates stand for."""
    kernels, chain = meshes["kernel"], model.chain
    count, gives = chain.n_nodes, [c > 0 for c in clamp_compliances(model, p)]
    return {
        "WORKSPACE": str(_NUMBERS * (count + 1)),
        "ELEMENTS": str(chain.n_segments),
        "FIRST": str(chain.layout.advancing[0]),
        "LOW": str(int(model.start == "clamped" and not gives[0])),
        "HIGH": str(count - int(model.end == "clamped" and not gives[1])),
        "GIVES_START": str(int(gives[0])),
        "GIVES_END": str(int(gives[1])),
        # Elimination and solution: about 30 operations a node; the trial point is evaluated, too.
        "OPERATIONS": str(2 * kernels.operations + 30 * count),
        "STEPS": str(_most_steps(model)),
        "HOLDERS": "" if kernels.ends is None else "    add_ends(q, w->table);",
    }
