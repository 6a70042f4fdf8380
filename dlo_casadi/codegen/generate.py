"""Write the C solver of a model: fill the templates."""

from __future__ import annotations

import hashlib
import json
import re
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path
from types import ModuleType

import numpy as np
from numpy.typing import NDArray

from dlo_casadi import __version__
from dlo_casadi.codegen import plane, space
from dlo_casadi.codegen.kernels import Kernels, c_number, size_of_code, table_to_c, text_of
from dlo_casadi.codegen.prefix import check_prefix
from dlo_casadi.codegen.records import n_columns
from dlo_casadi.effects import MeasurementEffect, StateEffect
from dlo_casadi.errors import DloError, counted
from dlo_casadi.io.files import FolderDraft, is_marked, refuse_foreign, write_file
from dlo_casadi.model.cable_model import CableModel
from dlo_casadi.model.lagrangian import lagrangian_of

FloatArray = NDArray[np.floating]

# The way of a path from pose to pose is parted into so many at most, as in the templates.
FINEST = 4096
# By which a generated file is known, in all templates.
MARK = "written by dlo-casadi"


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


def _template(name: str) -> str:
    return (files("dlo_casadi.codegen") / "templates" / name).read_text(encoding="utf-8")


def _values(model: CableModel, prefix: str, digest: str) -> dict[str, str]:
    """What the templates' marks stand for, of any cable."""
    clamped = {side: int(getattr(model, side) == "clamped") for side in ("start", "end")}
    names = [effect.name for effect in model.effects]
    return {
        "PREFIX": prefix,
        "FILE": f"{prefix}_solver",
        "TITLE": comment(model.cable.name),
        "VERSION": __version__,
        "MODEL": f"{counted(model.n, model.element)}, start {model.start}, end {model.end}, "
        + "effects: "
        + (comment(", ".join(names)) or "none"),
        "HASH": digest,
        "DIMENSION": str(model.node.dimension),
        "COORDINATES": str(model.node.coordinates),
        "AXES": str(model.node.increment),
        "COLUMNS": str(n_columns(model)),
        "N": str(model.n),
        "NODES": str(model.chain.n_nodes),
        "NODES_ARE": model.chain.kind.nodes_are,
        "START_CLAMPED": str(clamped["start"]),
        "END_CLAMPED": str(clamped["end"]),
        "END_FREE": str(int(model.end == "free")),
        "RADIUS": c_number(model.cable.diameter / 2),
        "ELASTIC": str(int(model.yields)),
        "STRETCHES": str(int(model.extensible)),
        "SMOOTH": str(int(model.chain.kind.smooth)),
    }


def _own(model: CableModel) -> ModuleType:
    """What differs between plane and space."""
    return space if model.in_space else plane


def table_of(model: CableModel, p: FloatArray, rest: FloatArray) -> list[float]:
    """The table of another cable of the kind of a solver generated with `inline=False`."""
    own = _own(model)
    return _table(own, model, p, rest, own.meshes_of(model, p, rest, inline=False))


def _table(
    own: ModuleType,
    model: CableModel,
    p: FloatArray,
    rest: FloatArray,
    meshes: dict[str, Kernels],
) -> list[float]:
    """Numbers of the kernels of all meshes, then the others."""
    rows = [number for kernels in meshes.values() for number in kernels.table]
    return [*rows, *own.numbers_of(model, p, rest)]


def comment(text: str) -> str:
    """Any text as a part of a comment in C: one line of ASCII that cannot end it.

    What is no printable ASCII stands as its escape, a backslash as two. A space parts the signs
    that begin or end a comment, and those that begin a trigraph: `??/` is a backslash, and one
    at the end of a line continues it. To be followed by something else on its line.
    """
    line = text.encode("unicode_escape").decode()
    return re.sub(r"(?<=/)(?=\*)|(?<=\*)(?=/)|(?<=\?)(?=\?)", " ", line)


def marked(text: str, values: dict[str, str]) -> str:
    """Replace those @MARKS@ that have a value; CMake's own stay."""
    return re.sub(r"@([A-Z_]+)@", lambda match: values.get(match.group(1), match.group(0)), text)


def fill(text: str, values: dict[str, str], prefix: str) -> str:
    """Replace @MARKS@ and give public names their prefix."""
    text = re.sub(r"\bdlo_(?!casadi)", f"{prefix}_", text)
    text = re.sub(r"\bDLO_", f"{prefix.upper()}_", text)
    return marked(text, values)


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
    rest : (n_rests,) [1/m]
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
    if len(p) != len(model.parameters) or len(rest) != model.chain.n_rests:
        raise DloError(
            f"p has {len(p)} and rest {len(rest)} entries; the model has "
            f"{len(model.parameters)} parameters and {model.chain.n_rests} rest curvatures"
        )
    if model.shape_dependent_loads:
        loads = " and ".join(model.shape_dependent_loads)
        raise DloError(
            f"no solver can be generated for a cable with {loads}: the force depends on the shape, "
            "and the generated solver knows dead loads only.\n"
            "  Try: dlo predict, or dlo_casadi.predict, which know it."
        )
    digest = solver_hash(model, p, rest)
    own, kind = _own(model), "space" if model.in_space else "plane"
    meshes = own.meshes_of(model, p, rest, inline)
    numbers = _table(own, model, p, rest, meshes)
    kernels, loops, kernel_numbers = text_of(meshes)
    values = {
        **_values(model, prefix, digest),
        **own.values(model, p, meshes),
        "LENGTH": c_number(float(lagrangian_of(model).held(p, 0, 0)[1])),
        "SPINS": str(int(model.may_spin and not rest.any())),
        "TABLE": table_to_c(numbers),
        "EXTRA": str(kernel_numbers),
        "CODE": str(size_of_code(meshes.values(), numbers)),
        "KERNELS": kernels,
        "LOOPS": loops,
    }
    values["TRY_STEPS"] = str(own.TRY_STEPS)
    values["PATH_STEPS"] = str(int(values["STEPS"]) + own.TRY_STEPS * (2 * FINEST + 13))
    texts = {**own.TEXTS, "POSE_TYPE": _template(f"{kind}_pose.h.in").rstrip()}
    parts = (
        *("common", kind, "newton", f"{kind}_descent", f"{kind}_guesses", f"{kind}_shape"),
        *("shape", "clearance", "interface"),
    )
    source = "".join(_template(f"{name}.c.in") for name in parts)
    names = {
        f"{prefix}_solver.h": "solver.h.in",
        f"{prefix}_solver.hpp": "solver.hpp.in",
        "CMakeLists.txt": "CMakeLists.txt.in",
        f"{prefix}_solver.pc.in": "solver.pc.in",
        "example.c": "example.c.in",
    }
    found = {name: _template(template) for name, template in names.items()}
    found[f"{prefix}_solver.c"] = source
    filled = {name: fill(marked(text, texts), values, prefix) for name, text in found.items()}
    return Solver(prefix, digest, filled, int(values["WORKSPACE"]))
