"""Write the C solver of a model: fill the templates."""

from __future__ import annotations

import hashlib
import json
import re
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from dlo_casadi import __version__
from dlo_casadi.codegen.kernels import Kernels, c_number, kernels_of, table_to_c
from dlo_casadi.codegen.prefix import check_prefix
from dlo_casadi.durable import FolderDraft, is_marked, refuse_foreign, write_file
from dlo_casadi.effects import MeasurementEffect, StateEffect
from dlo_casadi.equilibrium import resting_headings, total_dead_load
from dlo_casadi.errors import DloError
from dlo_casadi.model import CableModel

FloatArray = NDArray[np.floating]

# By which a generated file is known, in all templates.
MARK = "written by dlo-casadi"
# Doubles of a workspace per slot; as in the template.
_ARRAYS = 38


@dataclass(frozen=True)
class Solver:
    """Text of a generated solver.

    Parameters
    ----------
    prefix : str
        Of all public names and of the files.
    hash : str
        SHA-256 of all that decides the solver's numbers: see `solver_hash`.
    files : dict
        File name -> text.
    workspace : int
        Number of doubles of a workspace.
    """

    prefix: str
    hash: str
    files: dict[str, str]
    workspace: int

    def write(self, folder: Path | str) -> list[Path]:
        """Write all files into the folder, which is made if it is missing: all of them or none.

        Files of these names are replaced if they are generated ones, known by a mark in each;
        other files in the folder stay.

        Raises
        ------
        OutputError
            If the folder cannot be written, or holds files of these names from elsewhere.
        """
        folder = Path(folder)
        refuse_foreign(folder, [name for name in self.files if not is_marked(folder / name, MARK)])
        with FolderDraft(folder) as draft:
            for name, text in self.files.items():
                write_file(draft.folder / name, text)
            draft.put_in_place()
        return [folder / name for name in self.files]


def solver_hash(model: CableModel, p: FloatArray, rest: FloatArray) -> str:
    """SHA-256 of everything that decides the solver's numbers: DLO_MODEL_HASH in its header.

    Effects of the camera and of the history enter no solver, so they are left out. The hash in a
    parameters.yaml is another one: that of the whole fitted model.
    """
    left_out = [e for e in model.effects if isinstance(e, MeasurementEffect | StateEffect)]
    prefixes = tuple(f"{effect.label}." for effect in left_out)
    content = {
        "cable": [model.cable.length, model.cable.mass],
        "mesh": [model.n, model.element],
        "boundary": [model.start, model.end],
        "gravity": list(map(float, model.gravity)),
        "effects": [
            [type(effect).__name__, effect.label]
            for effect in model.effects
            if effect not in left_out
        ],
        "parameters": {
            name: float(value)
            for name, value in zip(model.names, p, strict=True)
            if not name.startswith(prefixes)
        },
        "rest": list(map(float, rest)),
    }
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()


def _extra(model: CableModel, p: FloatArray) -> list[float]:
    """Numbers of the cable that no kernel holds, in the order of the template's macros."""
    down = float(np.arctan2(model.gravity[1], model.gravity[0])) if any(model.gravity) else 0.0
    offsets, length = model.held(p, 0, 0)
    return [float(length), down, *total_dead_load(model, p), *np.array(offsets).ravel()[2:]]


def numbers_of(model: CableModel, p: FloatArray, rest: FloatArray, kernels: Kernels) -> list[float]:
    """The solver's table: numbers of the kernels, nodes, widths of the cells, rest, the others."""
    stretch = float(model.held(p, 0, 0)[1]) / model.cable.length
    return [
        *kernels.table,
        *(model.chain.places / model.cable.length),
        *(1 / (np.diff(model.chain.cells, axis=1).ravel() * stretch)),
        *resting_headings(model.chain, rest),
        *_extra(model, p),
    ]


def _values(
    model: CableModel,
    p: FloatArray,
    rest: FloatArray,
    kernels: Kernels,
    prefix: str,
    digest: str,
) -> dict[str, str]:
    """What the templates' marks stand for."""
    functions, loops = kernels.to_c(model.yields)
    chain, rows = model.chain, len(kernels.table)
    clamped = {side: int(getattr(model, side) == "clamped") for side in ("start", "end")}
    names = [effect.name for effect in model.effects]
    count = chain.n_nodes
    return {
        "FILE": f"{prefix}_solver",
        "TITLE": comment(model.cable.name),
        "VERSION": __version__,
        "MODEL": f"{model.n} {model.element}s, start {model.start}, end {model.end}, effects: "
        + (comment(", ".join(names)) or "none"),
        "HASH": digest,
        "N": str(model.n),
        "N_HEADINGS": str(count),
        "HEADINGS_ARE": chain.kind.nodes_are,
        "LENGTH": c_number(float(model.held(p, 0, 0)[1])),
        "START_CLAMPED": str(clamped["start"]),
        "END_CLAMPED": str(clamped["end"]),
        "END_FREE": str(int(model.end == "free")),
        "WORKSPACE": str(_ARRAYS * (count + 1)),
        "ELEMENTS": str(chain.n_slots),
        "FIRST": str(chain.layout.advancing[0]),
        "LOW": str(clamped["start"]),
        "HIGH": str(count - clamped["end"]),
        "STRETCHES": str(int(model.extensible)),
        "ELASTIC": str(int(model.yields)),
        "TABLE": table_to_c(numbers_of(model, p, rest, kernels)),
        "PLACES": str(rows),
        "WIDTHS": str(rows + count),
        "RESTING": str(rows + 2 * count - 1),
        "EXTRA": str(rows + 3 * count - 1),
        "KERNELS": functions,
        "LOOPS": loops,
    }


def _template(name: str) -> str:
    return (files("dlo_casadi.codegen") / "templates" / name).read_text(encoding="utf-8")


def comment(text: str) -> str:
    """Any text as a part of a comment in C: one line of ASCII that cannot end it.

    What is no printable ASCII stands as its escape, a backslash as two. A space parts the signs
    that begin or end a comment, and those that begin a trigraph: `??/` is a backslash, and one
    at the end of a line continues it. To be followed by something else on its line.
    """
    line = text.encode("unicode_escape").decode()
    return re.sub(r"(?<=/)(?=\*)|(?<=\*)(?=/)|(?<=\?)(?=\?)", " ", line)


def fill(text: str, values: dict[str, str], prefix: str) -> str:
    """Replace @MARKS@ and give public names their prefix; CMake's own marks stay."""
    text = re.sub(r"\bdlo_(?!casadi)", f"{prefix}_", text)
    text = re.sub(r"\bDLO_", f"{prefix.upper()}_", text)
    return re.sub(r"@([A-Z_]+)@", lambda match: values.get(match.group(1), match.group(0)), text)


def generate(
    model: CableModel,
    p: FloatArray,
    rest: FloatArray,
    prefix: str = "dlo",
    *,
    inline: bool = True,
) -> Solver:
    """Generate the C solver of a model.

    Parameters
    ----------
    model : CableModel
        Effects of the camera do not enter: the solver gives the true shape.
    p : (n_parameters,)
        In the order of `model.names`, SI units.
    rest : (n_cells,) [1/m]
        Rest curvature of the bending cells; of a drifting cable the latest.
    prefix : str
        Begins all public names: `<prefix>_solve`.
    inline : bool
        Whether numbers that all elements share are written into the code; otherwise all numbers
        are in one table, and cables of one kind differ in it alone.

    Raises
    ------
    DloError
        If the prefix is not a C identifier or an effect cannot be generated.
    """
    check_prefix(prefix)
    p, rest = np.asarray(p, float).ravel(), np.asarray(rest, float).ravel()
    if len(p) != len(model.parameters) or len(rest) != model.chain.n_cells:
        raise DloError(
            f"p has {len(p)} and rest {len(rest)} entries; the model has "
            f"{len(model.parameters)} parameters and {model.chain.n_cells} cells"
        )
    if model.shape_dependent_loads:
        loads = " and ".join(model.shape_dependent_loads)
        raise DloError(
            f"no solver can be generated for a cable with {loads}: the force depends on the shape, "
            "and the generated solver knows dead loads only.\n"
            "  Try: dlo predict, or dlo_casadi.predict, which know it."
        )
    kernels = kernels_of(model, p, rest, inline)
    digest = solver_hash(model, p, rest)
    values = _values(model, p, rest, kernels, prefix, digest)
    source = "".join(_template(name) for name in ("solver.c.in", "guesses.c.in", "interface.c.in"))
    names = {
        f"{prefix}_solver.h": "solver.h.in",
        "CMakeLists.txt": "CMakeLists.txt.in",
        f"{prefix}_solver.pc.in": "solver.pc.in",
        "example.c": "example.c.in",
    }
    texts = {name: fill(_template(template), values, prefix) for name, template in names.items()}
    texts[f"{prefix}_solver.c"] = fill(source, values, prefix)
    return Solver(prefix, digest, texts, int(values["WORKSPACE"]))
