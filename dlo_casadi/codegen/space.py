"""What the templates of a cable in space are filled with."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from dlo_casadi.codegen.kernels import Kernels, kernels_of
from dlo_casadi.errors import DloError
from dlo_casadi.model.cable_model import CableModel
from dlo_casadi.model.functions import functions_of
from dlo_casadi.model.lagrangian import lagrangian_of

FloatArray = NDArray[np.floating]

# Doubles of a workspace per node, and beside those eight coarse shapes; as in the template.
_NUMBERS, _COARSE_SHAPES = 4 + 4 + 4 + 3 + 6 + 9 + 9 + 58, 8
# Fewest arcs of the coarse mesh, and elements of the fine one in each of them. Of 3,000 random
# clamped problems with n = 12, 10 lead to a higher and 4 to a lower equilibrium than if all first
# guesses are followed on the fine mesh.
LEAST_COARSE, COARSENING = 6, 2.0
# Newton steps for a part of a path.
TRY_STEPS = 12
# Parts of the templates.
TEXTS = {
    "METHOD": """\
 * First guesses are followed on a coarse mesh; the shapes that they lead to are carried over.""",
    "WHERE": "in space",
    "ANGLES": """Vectors are in world axes, orientations are unit quaternions (x, y, z, w).""",
    "STATES_ARE": "material frames of the nodes, unit quaternions (x, y, z, w)",
    "COLUMNS_ARE": """\
start x, y, z [m], rotation of the start
 * about the world's axes x, y, z [rad], then the same six of the end.""",
    "START_FRAME": "start_orientation",
    "END_FRAME": "end_orientation",
    "BRANCH": """\
 *   branch     in   DLO_LOWEST: four to eight first guesses are followed, with a free end three,
 *                   and the stable equilibrium of lowest energy is taken.""",
    "SNAP": "snap-through, or a twist at which the cable loops",
    "POSE": """{0.0, 0.0, 0.0}, {0.6 * DLO_LENGTH, 0.1 * DLO_LENGTH, 0.1 * DLO_LENGTH},
                           {0.0, 0.0, 0.0, 1.0}, {0.0, 0.0, 0.0, 1.0}, 0.0""",
}


def coarse_elements(model: CableModel) -> int:
    """Arcs of the mesh on which first guesses are followed; 0 where that is the mesh itself."""
    count = min(model.n, max(LEAST_COARSE, round(model.n / COARSENING)))
    itself = count == model.n and model.element == "arc"
    return 0 if model.end == "free" or itself else count


def coarse_rest(model: CableModel, coarse: CableModel, rest: FloatArray) -> FloatArray:
    """Rest strains (n_rests,) of the coarse cells: means of those of the fine ones."""
    low, high = model.chain.cells.T
    shares = [
        np.clip(np.minimum(high, end) - np.maximum(low, start), 0.0, None) / (end - start)
        for start, end in coarse.chain.cells
    ]
    return np.concatenate(
        [np.array(shares) @ part for part in np.split(rest, len(model.node.strains))]
    )


def _clamps(model: CableModel, p: FloatArray) -> FloatArray:
    """Frames (8,) of the true clamps in the declared ones, and the end's offset ahead (3,)."""

    def held(ends: FloatArray) -> FloatArray:
        return np.array(lagrangian_of(model).held(p, ends, 0)[0]).ravel()

    still = np.concatenate([np.zeros(6), model.node.identity, model.node.identity])
    found = held(still)
    anywhere = np.random.default_rng(0).normal(size=(2, 4))
    anywhere /= np.linalg.norm(anywhere, axis=1)[:, None]
    expected = [
        (Rotation.from_quat(q) * Rotation.from_quat(turn)).as_quat()
        for q, turn in zip(anywhere, found[6:].reshape(2, 4), strict=True)
    ]
    turned = held(np.concatenate([np.zeros(6), anywhere.ravel()]))[6:].reshape(2, 4)
    if np.abs(np.abs((turned * expected).sum(axis=1)) - 1).max() > 1e-12:
        raise DloError(
            "no solver can be generated: an effect moves the clamps in another way than about "
            "their own axes\n  Try: dlo predict, or dlo_casadi.predict, which know it."
        )
    return found[3:]


def numbers_of(model: CableModel, p: FloatArray, rest: FloatArray) -> list[float]:
    """Numbers of the cable that no kernel holds, in the order of the template's macros."""
    length = float(lagrangian_of(model).held(p, 0, 0)[1])
    widths = np.diff(model.chain.cells, axis=1).ravel()
    bends = model.chain.curvatures(rest) * widths
    return [
        length,
        length / model.n,
        *model.gravity,
        *np.array(functions_of(model).dead_load(p)).ravel(),
        *_clamps(model, p),
        *bends.T.ravel(),
    ]


def meshes_of(
    model: CableModel, p: FloatArray, rest: FloatArray, inline: bool
) -> dict[str, Kernels]:
    """Kernels of the fine mesh and, where there is one, of the coarse mesh, by their names in C.

    Raises
    ------
    DloError
        If springs hold the ends, or clamps give way.
    """
    found = {"kernel": kernels_of(model, p, rest, inline)}
    if found["kernel"].ends is not None or lagrangian_of(model).compliant:
        raise DloError(
            "no solver can be generated for a cable in space whose ends are held by springs, or by "
            "clamps that give way\n"
            "  Try: dlo predict, or dlo_casadi.predict, which know them."
        )
    count = coarse_elements(model)
    if count:
        coarse = model.with_mesh(count, "arc")
        means = coarse_rest(model, coarse, rest)
        found["coarse_kernel"] = kernels_of(coarse, p, means, inline)
    return found


def _most_steps(model: CableModel) -> int:
    """Newton steps of a cold solve after a warm start in vain; the template checks the number.

    Each first guess is descended from on the coarse mesh, from its minimum on the fine mesh, and
    should all that be in vain, on the fine mesh from the start; a descent takes 80 steps.
    """
    guesses = 3 if model.end == "free" else 8
    return (1 + 3 * guesses) * 80


def values(model: CableModel, p: FloatArray, meshes: dict[str, Kernels]) -> dict[str, str]:
    """What the marks of the templates stand for."""
    count = coarse_elements(model)
    return {
        "WORKSPACE": str(_NUMBERS * (model.n + 2) + 4 * _COARSE_SHAPES * (count + 1)),
        "COARSE": str(count),
        "FIRST": "0",
        "GIVES_START": "0",
        "GIVES_END": "0",
        # Elimination and solution: about 500 operations a node.
        "OPERATIONS": str(meshes["kernel"].operations + 500 * (model.n + 1)),
        "STEPS": str(_most_steps(model)),
    }
