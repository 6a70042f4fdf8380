"""Write the C solver of a model by filling templates."""

import hashlib
import json
import re
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from dlo_casadi import __version__
from dlo_casadi.arrays import FloatArray
from dlo_casadi.codegen.c_text import c_number, helpers_of, marked, table_to_c
from dlo_casadi.codegen.cases import ITERATIONS, TRY_STEPS, Case, case_of, template
from dlo_casadi.codegen.kernels import kernel_texts, size_of_code
from dlo_casadi.codegen.moving import MovingCase
from dlo_casadi.codegen.obstacles import Obstacles
from dlo_casadi.codegen.shapes import records_of
from dlo_casadi.effects import ContactEffect, MeasurementEffect, StateEffect
from dlo_casadi.errors import DloError, counted
from dlo_casadi.io.files import FolderDraft, is_marked, refuse_foreign, write_file
from dlo_casadi.model.cable_model import CableModel
from dlo_casadi.model.contact import gap_per_force
from dlo_casadi.rod.supports import SupportKind

# Maximum number of steps between two poses of a path, as in the templates.
FINEST = 4096
# Freedoms that a support between the ends leaves to the cable, as in the templates.
# Text in all templates that identifies a generated file.
MARK = "written by dlo-casadi"
# Keywords of C99, C11 and C++, and names that every program defines.
_KEYWORDS = """
auto break case char const continue default do double else enum extern float for
goto if inline int long register restrict return short signed sizeof static struct
switch typedef union unsigned void volatile while bool catch class constexpr
decltype delete dynamic_cast explicit export false friend mutable namespace new
noexcept nullptr operator private protected public reinterpret_cast static_assert
static_cast template this thread_local throw true try typeid typename using virtual
wchar_t and or not xor asm alignas alignof main errno
"""


@dataclass(frozen=True)
class Solver:
    """Text of a generated solver.

    Parameters
    ----------
    prefix : str
        Prefix of all public names and of the files.
    hash : str
        SHA-256 of everything that determines the solver's numbers: see `solver_hash`.
    files : dict
        File name -> text.
    obstacles : Obstacles
        Maximum number of obstacles of a call, and those of the model.
    """

    prefix: str
    hash: str
    files: dict[str, str]
    obstacles: Obstacles

    def write(self, folder: Path | str) -> list[Path]:
        """Write all files into the folder, or none; the folder is made if it does not exist.

        Existing files of these names are replaced if they are marked as generated; other files in
        the folder stay.

        Raises
        ------
        OutputError
            If the folder cannot be written, or holds files of these names from another source.
        """
        folder = Path(folder)
        refuse_foreign(folder, [name for name in self.files if not is_marked(folder / name, MARK)])
        with FolderDraft(folder) as draft:
            for name, text in self.files.items():
                write_file(draft.folder / name, text)
            draft.put_in_place()
        return [folder / name for name in self.files]


def solver_hash(model: CableModel, p: FloatArray, rest: FloatArray) -> str:
    """SHA-256 of everything that determines the solver's numbers: DLO_MODEL_HASH in its header.

    Effects of the camera and of the history are not part of a solver and are left out. The hash in
    parameters.yaml differs: it covers the whole fitted model.
    """
    left_out = [e for e in model.effects if isinstance(e, MeasurementEffect | StateEffect)]
    prefixes = tuple(f"{effect.label}." for effect in left_out)
    content = {
        "cable": [model.cable.length, model.cable.mass, model.cable.diameter],
        "mesh": [model.n, model.element],
        "boundary": [model.start, model.end, *model.clips],
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
    if model.slides and model.fed_by_length:
        content["fed_by_length"] = True
    if model.surfaces:
        content["obstacles"] = [one.drawn for one in model.surfaces]
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()


def _values(case: Case, prefix: str, digest: str) -> dict[str, int | str]:
    model, node, kind = case.model, case.model.node, case.model.chain.kind
    effects = comment(", ".join(effect.label for effect in model.effects)) or "none"
    ends, among = f"start {model.start}, end {model.end}", case.obstacles.most
    held = [*model.clips, *[SupportKind.PINNED] * len(case.tethers)]
    table, values = case.table, case.values
    tries = TRY_STEPS * (2 if among else 1)
    most = tries + (ITERATIONS if among else 0)
    return (
        values
        | kernel_texts(case.meshes)
        | {
            "PREFIX": prefix,
            "FILE": f"{prefix}_solver",
            "TITLE": comment(model.cable.name),
            "VERSION": __version__,
            "MODEL": f"{counted(model.n, model.element)}, {ends}, effects: {effects}",
            "HASH": digest,
            "DIMENSION": node.dimension,
            "COORDINATES": node.coordinates,
            "AXES": node.increment,
            "COLUMNS": records_of(model, among).columns,
            "N": model.n,
            "NODES": model.chain.n_nodes,
            "NODES_ARE": kind.nodes_are,
            "START_CLAMPED": model.start.direction,
            "END_CLAMPED": model.end.direction,
            "END_FREE": not model.end.place,
            "GIVES_START": case.compliances[0] > 0,
            "GIVES_END": case.compliances[1] > 0,
            "LENGTH": c_number(case.length),
            "DECLARED_LENGTH": c_number(model.cable.length),
            "RADIUS": c_number(model.cable.diameter / 2),
            "ELASTIC": model.n_inner > 0,
            "STRETCHES": model.extensible,
            "SMOOTH": kind.smooth,
            **_rolls(case),
            "SPRUNG": case.meshes["kernel"].ends is not None,
            "TABLE": table_to_c(table),
            "CODE": size_of_code(case.meshes.values(), table),
            "ROW": 2 + 3 * len(node.strains),
            "HOLDS": case.holds,
            "CLIPS": len(model.clips),
            "CLIP_KINDS": ", ".join(model.clips),
            "CLAMPS": sum(kind.direction for kind in model.clips),
            "CLAMP_KINDS": ", ".join(str(kind.direction * (1 + (not kind.roll))) for kind in held)
            or "0",
            "EYELETS": len(case.eyelets),
            "EYELET_ROWS": ", ".join(str(row) for row in case.eyelet_rows) or "0",
            "EXAMPLE_CLIPS": case.example_clips,
            "OBSTACLES": among,
            "DECLARED": len(case.obstacles.declared),
            "PER_FORCE": c_number(gap_per_force(model, 1.0)),
            "TRY_STEPS": tries,
            "PATH_STEPS": int(values["STEPS"]) + most * (2 * FINEST + 13),
        }
    )


def _rolls(case: Case) -> dict[str, int | str]:
    """Where the cable may roll in clamps of its ends, and whether all of it may: it is held then.

    That is by the first rigid clamp there is, or else, SPINS, by a spring about the first node's
    tangent.
    """
    ends, twists = (case.model.start, case.model.end), case.model.node.twists
    swivels = [kind.direction and not kind.roll and twists for kind in ends]
    spins = case.model.may_spin and not case.rest.any()
    gives = [own and c > 0 for own, c in zip(swivels, case.compliances, strict=True)]
    rigid = [own and not soft for own, soft in zip(swivels, gives, strict=True)]
    rolls = [own and not (spins and k == rigid.index(True)) for k, own in enumerate(rigid)]
    return {
        "SPINS": spins and not any(rigid),
        "ROLLS_START": rolls[0],
        "ROLLS_END": rolls[1],
        "GIVES_AND_ROLLS_START": gives[0],
        "GIVES_AND_ROLLS_END": gives[1],
        "SWIVEL_START": swivels[0],
        "SWIVEL_END": swivels[1],
        "TURNS": all(kind.roll for kind in ends),
    }


def table_of(model: CableModel, p: FloatArray, rest: FloatArray) -> list[float]:
    """The table for another cable, for a solver of this kind generated with `inline=False`."""
    return case_of(model, p, rest, inline=False, obstacles=Obstacles()).table


def check_prefix(prefix: str) -> None:
    """Raise DloError unless the prefix is a valid beginning of C names."""
    if not isinstance(prefix, str) or not re.fullmatch(r"[A-Za-z]\w*", prefix, flags=re.ASCII):
        raise DloError(
            f"the prefix {prefix!r} is not a C identifier: use letters, digits and underscores, "
            "a letter first, e.g. --prefix harness"
        )
    if prefix in _KEYWORDS.split():
        raise DloError(f"the prefix {prefix!r} is a keyword of C or C++; choose another one")
    if prefix.endswith("_") or len(prefix) > 40:
        raise DloError(f"the prefix {prefix!r} must be short and must not end in an underscore")


def comment(text: str) -> str:
    """Turn any text into a part of a C comment: one line of ASCII that cannot end the comment.

    Characters other than printable ASCII become escapes, a backslash becomes two. Spaces separate
    the characters that begin or end a comment or a trigraph: `??/` is a backslash, which at the end
    of a line continues it. More text must follow on the same line.
    """
    line = text.encode("unicode_escape").decode()
    return re.sub(r"(?<=/)(?=\*)|(?<=\*)(?=/)|(?<=\?)(?=\?)", " ", line)


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
    obstacles: int = 0,
    motion: bool = False,
) -> Solver:
    """Generate the C solver of a model.

    Parameters
    ----------
    model : CableModel
        Effects of the camera are left out: the solver gives the true shape.
    p : (n_parameters,)
        In the order of `model.names`, SI units.
    rest : (n_rests,) [1/m]
        Rest curvature of the bending cells; for a drifting cable the latest one.
    prefix : str
        Prefix of all public names: `<prefix>_solve`.
    inline : bool
        Whether numbers shared by all elements are written into the code; otherwise all numbers are
        in one table, the only difference between cables of one kind.
    obstacles : int
        Maximum number of obstacles that the cable may touch, given with each call; at least those
        of the model.
    motion : bool
        Whether the solver also steps the cable in time.

    Raises
    ------
    DloError
        If the prefix is not a C identifier or makes one name of two, or an effect cannot be
        generated.
    """
    check_prefix(prefix)
    p, rest = np.asarray(p, float).ravel(), np.asarray(rest, float).ravel()
    if len(p) != len(model.parameters) or len(rest) != model.chain.n_rests:
        raise DloError(
            f"p has {len(p)} and rest {len(rest)} entries; the model has "
            f"{len(model.parameters)} parameters and {model.chain.n_rests} rest curvatures"
        )
    digest = solver_hash(model, p, rest)
    among = Obstacles.of(model, p, obstacles)
    bare, p = replace(model, obstacles=()).without_kind(ContactEffect, p)
    case = case_of(bare, p, rest, inline, among)
    # One at the end is in the last element.
    elements = [min(int(tether[0] * bare.n), bare.n - 1) for tether in case.tethers]
    if len({*elements}) < len(elements):
        raise DloError(
            f"two tethers are in one of the {counted(bare.n, 'element')}: no solver can be made\n"
            "  Try: a finer mesh, --n, or one tether in place of both"
        )
    if len(bare.clips) >= bare.n:
        raise DloError(
            f"{counted(len(bare.clips), 'clip')} on {counted(bare.n, 'element')}: a clip needs a "
            "node\n  Try: a finer mesh, --n"
        )
    if motion and among.most:
        raise DloError(
            "no solver for motion among obstacles: contact in motion is not known\n"
            "  Try: without obstacles, or a solver of its own for motion"
        )
    moving = MovingCase(bare, p, rest, inline).values if motion else {}
    numbers = _values(case, prefix, digest) | moving
    numbers["CODE"] = int(numbers["CODE"]) + int(moving.get("MOTION_CODE", 0))
    helpers = helpers_of(str(moving.get("MOTION_KERNELS", "")))
    missing = [text for text in helpers if text not in str(numbers["KERNELS"])]
    numbers["KERNELS"] = "\n".join([*missing, str(numbers["KERNELS"])])
    values = {
        mark: value if isinstance(value, str) else str(int(value))
        for mark, value in numbers.items()
    }
    node, guessed = f"node_{case.name}", f"guesses_{case.name}"
    first = ("common", "contact", "newton", node, "columns", "descent", "between", "landing")
    then = ("guesses", guessed, "pose", "find", "shape", "clearance", "limits", "interface")
    timed = ("motion", "motion_slopes", "motion_modes") if motion else ()
    found = {
        f"{prefix}_solver.h": template("solver.h.in"),
        f"{prefix}_solver.hpp": template("solver.hpp.in"),
        "CMakeLists.txt": template("CMakeLists.txt.in"),
        f"{prefix}_solver.pc.in": template("solver.pc.in"),
        "example.c": template("example.c.in"),
        f"{prefix}_solver.c": "".join(
            template(f"{name}.c.in")
            for name in (*first, *then, *timed, "casadi", *["casadi_motion"] * motion)
        ),
    }
    if motion:
        found["loop.c"] = template("loop.c.in")
    words = case.words | {"MOTION": marked(template("motion.h.in"), case.words) if motion else ""}
    found = {name: marked(text, words) for name, text in found.items()}
    names = set(re.findall(r"(?<!@)\b\w+\b(?!@)", "".join(found.values())))
    for name in sorted(names):
        renamed = fill(name, {}, prefix)
        if renamed != name and renamed in names:
            raise DloError(
                f"the prefix {prefix!r} would make {renamed} of {name}, a name that the solver has "
                "already; choose another one, e.g. --prefix harness"
            )
    filled = {name: fill(text, values, prefix) for name, text in found.items()}
    return Solver(prefix, digest, filled, among)
