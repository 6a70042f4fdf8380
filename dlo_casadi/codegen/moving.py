"""The equations of motion of a model as C functions, of the same expressions as in Python."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import casadi as ca
import numpy as np

from dlo_casadi import __version__
from dlo_casadi.arrays import FloatArray, IntArray
from dlo_casadi.codegen.c_text import c_number, helpers_of, marked, statements, table_to_c
from dlo_casadi.codegen.cases import template
from dlo_casadi.codegen.kernels import PER_OPERATION
from dlo_casadi.codegen.statuses import STATUS_TEXTS
from dlo_casadi.model.cable_model import CableModel
from dlo_casadi.model.functions import functions_of
from dlo_casadi.motion.segment import MovingSegment, moving_segment
from dlo_casadi.motion.steps import LAST_STEP, LONGEST, NEWTON_STEPS, SCHEME, SLOW
from dlo_casadi.motion.system import MovingCable
from dlo_casadi.rod.ends import EndConditions

# Arguments of the C functions of segments and of ends, in the order of `_segment` and `_ends`.
_OF_SEGMENT = ("x", "r", "w", "v", "alpha", "a", "force", "still", "row", "table")
_OF_ENDS = ("x", "w", "moment", "pose", "table")
_OF_PLACES = ("pose", "table")
# Bytes of the code of steps, derivatives and modes beside these functions.
_OWN = 25_000
_OF_MATRICES = ("STIFFNESS", "DAMPING", "MASS", "END_STIFFNESS", "END_DAMPING", "END_TURNS")
# A step of Newton's method in C leaves less than that of Python, where steps share a matrix.
_LAST = 1e-2 * LAST_STEP
# Derivatives of a step by fixtures and by the step before alone.
_BY_FIXTURES = """\
static const double NO_NUMBERS[1] = {0.0};
#define EVALUATE_BY_MODEL(s)
#define ADD_BY_MODEL(s, j, numbers, rows) (void)(numbers)
#define ADD_BY_MODEL_AT_ENDS(s, numbers, rows) (void)(numbers)"""


@dataclass(frozen=True)
class MovingCase:
    """A model's motion as text of the templates.

    Parameters
    ----------
    model : CableModel
    p : (n_parameters,)
    rest : (n_rests,) [1/m]
    inline : bool
        Whether parameters are written into the code; otherwise they are in the table, and
        derivatives by them and by rest strains are among the functions.
    """

    model: CableModel
    p: FloatArray
    rest: FloatArray
    inline: bool = True

    @cached_property
    def cable(self) -> MovingCable:
        """The same for Python."""
        return MovingCable(self.model, self.p, self.rest)

    @property
    def segment(self) -> MovingSegment:
        """Its expressions."""
        return moving_segment(self.model)

    # ---- numbers -------------------------------------------------------------------------------

    @cached_property
    def _rows(self) -> FloatArray:
        """Numbers of each segment: arc length of its start, rest strains, and which springs."""
        _, rest, place, _, on, _ = self.cable.numbers
        return np.column_stack([place[:, :1], rest, on])

    @cached_property
    def _varying(self) -> IntArray:
        """Columns of these rows that are no constants in the code."""
        if not self.inline:
            return np.arange(self._rows.shape[1])
        same = np.isclose(self._rows, self._rows[0], rtol=1e-14, atol=0.0).all(axis=0)
        return np.flatnonzero(~same)

    @property
    def table(self) -> list[float]:
        """Numbers that the functions read: parameters unless inline, then rows of segments."""
        shared = [] if self.inline else self.p.tolist()
        return [*shared, *self._rows[:, self._varying].ravel().tolist()]

    # ---- functions -----------------------------------------------------------------------------

    def _at_numbers(self, outputs: Sequence[ca.SX]) -> tuple[list[ca.SX], list[ca.SX]]:
        """Expressions of a segment by its row and the table, and these two."""
        of = self.segment
        row, table = ca.SX.sym("row", len(self._varying)), ca.SX.sym("table", len(self.table))
        whole = ca.SX(ca.DM(self._rows[0]))
        for k, column in enumerate(self._varying):
            whole[int(column)] = row[k]
        start, rest, on = ca.vertsplit(whole, [0, 1, 1 + of.rest.numel(), whole.numel()])
        first = self.model.chain.layout.segments[0]
        place = ca.vertcat(start, first[1], start + first[2] - first[0], *first[3:])
        symbols = [of.p, of.rest, of.place, of.deviation, of.on]
        p = ca.SX(ca.DM(self.p)) if self.inline else table[: len(self.p)]
        values = [p, rest, place, ca.SX.zeros(of.deviation.numel()), on]
        return ca.substitute(list(outputs), symbols, values), [row, table]

    def _of_segment(self, *outputs: ca.SX) -> tuple[ca.Function, list[ca.SX]]:
        """A function of `_OF_SEGMENT` -> entries that are not zero, and where they are."""
        of = self.segment
        found, numbers = self._at_numbers(list(outputs))
        found = [one if one.is_dense() else ca.sparsify(one) for one in found]
        arguments = [of.x, of.r, of.w, of.v, of.alpha, of.a, of.force, of.still, *numbers]
        return _stacked(arguments, found), found

    @cached_property
    def _ends(self) -> tuple[ca.Function, list[ca.SX]]:
        """(x, w, moment, pose, table) of both ends -> rows, K, C, and derivative by turns.

        The last one is by turns of what holds the directions, see `sensitivities.Numbers`.
        """
        model, cable, node = self.model, self.cable, self.model.node
        b, d, kept = cable.b, cable.d, cable.end_rows
        x, w = ca.SX.sym("x", 2 * node.coordinates), ca.SX.sym("w", 2 * b)
        moment, pose = ca.SX.sym("moment", cable.n_moments), self._pose
        table, lam = ca.SX.sym("table", len(self.table)), ca.SX.zeros(model.n_lam)
        for k, row in enumerate(cable.held_turns):
            lam[row] = moment[k]
        p = ca.SX(ca.DM(self.p)) if self.inline else table[: len(self.p)]
        rest = ca.SX.zeros(model.n_pose - pose.numel())
        deviation = ca.SX.zeros(len(model.deviation_names))
        arguments = [x, lam, p, ca.vertcat(pose, rest), deviation]
        of = functions_of(model)
        _, gradient, hessian = of.at_ends.call(arguments)
        (by,) = of.end_sensitivity.call(arguments)
        turned, rubbing = ca.SX.zeros(len(kept)), ca.SX(len(kept), len(kept))
        by_p = ca.SX(len(kept), len(self.p))
        if cable.rubs is not None:
            found = cable.rubs.call([w, p])
            turned[: 2 * b], rubbing[: 2 * b, : 2 * b], by_p[: 2 * b, :] = found
        stiffness = hessian[kept, kept]
        for k in (0, b) if node.twists else ():  # as in `MovingSegment.matrices`
            stiffness[k : k + b, k : k + b] -= ca.skew(turned[k : k + b]) / 2
        by_turns = by[kept, len(self.p) + d : len(self.p) + d + 2 * b]
        rows = gradient[kept] + turned
        parts = [stiffness, rubbing, by_turns]
        if not self.inline:
            parts.append(by[kept, : len(self.p)] + by_p)
        found = [ca.densify(rows), *map(ca.sparsify, parts)]
        return _stacked([x, w, moment, pose, table], found), found

    @cached_property
    def _places(self) -> ca.Function:
        """(pose, table) -> true places (2 dimension,) of the fixtures, dead loads (dimension,)."""
        pose, table = self._pose, ca.SX.sym("table", len(self.table))
        p = ca.SX(ca.DM(self.p)) if self.inline else table[: len(self.p)]
        (places,) = self.segment.true_places.call([p, pose])
        (load,) = functions_of(self.model).dead_load.call([p])
        return _stacked([pose, table], [places, ca.densify(load)])

    @cached_property
    def _pose(self) -> ca.SX:
        return ca.SX.sym("pose", EndConditions.size(self.model.node))

    # ---- text ----------------------------------------------------------------------------------

    @property
    def values(self) -> dict[str, int | str]:
        """Values that replace the templates' marks."""
        cable, of = self.cable, self.segment
        residual, *matrices = of.stiffened(list(of.matrices))
        whole, parts = self._of_segment(ca.densify(residual), *map(ca.sparsify, matrices))
        (residual,) = of.stiffened([of.rows])
        rows, _ = self._of_segment(ca.densify(residual))
        ends, of_ends = self._ends
        functions = [
            ("segment_rows", rows, _OF_SEGMENT),
            ("segment_matrices", whole, _OF_SEGMENT),
            ("end_matrices", ends, _OF_ENDS),
            ("true_places", self._places, _OF_PLACES),
        ]
        patterns = dict(zip(_OF_MATRICES, [*parts[1:], *of_ends[1:]], strict=False))
        by_model = {"NUMBERS_OF_MODEL": 0, "MODEL_ROWS": 1, "MODEL_ENTRIES": 1}
        if not self.inline:
            by = ca.jacobian(residual, ca.vertcat(of.p, of.rest))
            numbers, (by,) = self._of_segment(ca.sparsify(by))
            functions.append(("segment_by_model", numbers, _OF_SEGMENT))
            patterns |= {"BY_MODEL": by, "END_BY_MODEL": of_ends[-1]}
            by_model["NUMBERS_OF_MODEL"] = len(self.p) + of.rest.numel() * cable.n_segments
            by_model |= {"MODEL_ROWS": cable.n_segments, "MODEL_ENTRIES": max(by.nnz(), 1)}
        texts = [_text(*one) for one in functions]
        nodes, forces, moments, count = cable.places
        return by_model | {
            "MOTION_KERNELS": "\n".join(texts),
            "PATTERNS": "\n".join(_pattern(*one) for one in patterns.items()),
            "MOTION_CODE": round(PER_OPERATION * sum(f.n_nodes() for _, f, _ in functions)) + _OWN,
            "MOTION_TABLE": table_to_c(self.table if self.inline else []),
            "PARAMETERS": 0 if self.inline else len(self.p),
            "MOTION_ROW": len(self._varying),
            "UNKNOWNS": count,
            "WIDTH": cable.width,
            "PULLS": forces.shape[1],
            "MOMENTS": len(moments),
            "ENTRIES": whole.nnz_out(0),
            "END_ENTRIES": ends.nnz_out(0),
            "BY_MODEL": _BY_FIXTURES
            if self.inline
            else marked(template("motion_by_model.c.in"), {"RESTS": str(of.rest.numel())}),
            "STRAINS": len(self.model.node.strains),
            "NODE_AT": _table(nodes),
            "FORCE_AT": _table(forces),
            "MOMENT_AT": ", ".join(map(str, moments)) or "0",
            "STIFFENS": int(of.stiffens),
            "SLOWEST": c_number(cable.slowest if self.inline else 1.0),
            "NEWTON_STEPS": NEWTON_STEPS,
            "LAST_STEP": c_number(_LAST),
            "LONGEST": c_number(LONGEST),
            "SLOW": c_number(SLOW),
            "SCHEME": ", ".join(
                c_number(x) for x in (SCHEME.alpha_m, SCHEME.alpha_f, SCHEME.beta, SCHEME.gamma)
            ),
        }


def alone(case: MovingCase) -> str:
    """C text of the steps of a cable alone, with a table of numbers for each call."""
    model, node = case.model, case.model.node
    texts = {
        "MOTION": template("motion.h.in"),
        "STEPS": template("motion.c.in") + template("motion_slopes.c.in"),
    }
    values = case.values | STATUS_TEXTS
    values |= {
        "VERSION": __version__,
        "DIMENSION": node.dimension,
        "COORDINATES": node.coordinates,
        "AXES": node.increment,
        "N": case.cable.n_segments,
        "LENGTH": c_number(model.cable.length),
        "END_FREE": int(not model.end.place),
        "START_CLAMPED": int(model.start.direction),
        "END_CLAMPED": int(model.end.direction),
        "STATES_ARE": "headings [rad], in space unit quaternions",
        "HELPERS": "\n".join(helpers_of(str(values["MOTION_KERNELS"]))),
    }
    text = marked(template("motion_alone.c.in"), texts)
    return marked(text, {mark: str(value) for mark, value in values.items()})


def _stacked(arguments: list[ca.SX], parts: Sequence[ca.SX]) -> ca.Function:
    """A function with one output: the entries of all parts that are not zero."""
    entries: list[Any] = [entry for part in parts for entry in part.nonzeros()]
    found = ca.cse([ca.vertcat(*entries)])
    return ca.Function("kernel", arguments, found)


def _text(name: str, function: ca.Function, inputs: Sequence[str]) -> str:
    """The function in C."""
    targets = [f"out[{i}] =" for i in range(function.nnz_out(0))]
    head = f"static void {name}("
    given = ", ".join(f"const double *{one}" for one in inputs)
    used = ", ".join(f"(void){one}" for one in inputs)
    return f"""\
{head}{given}, double *RESTRICT out)
{{
{statements(function, inputs, targets)}
    {used};
}}
"""


def _pattern(name: str, part: ca.SX) -> str:
    """Rows and columns of the entries of a matrix, one byte each; their number."""
    rows, columns = part.sparsity().get_triplet()
    pairs = ", ".join(f"{{{i}, {k}}}" for i, k in zip(rows, columns, strict=True)) or "{0, 0}"
    return (
        f"enum {{ {name}_COUNT = {len(rows)} }};\n"
        f"static const unsigned char {name}_AT[][2] = {{{pairs}}};"
    )


def _table(rows: IntArray) -> str:
    """Rows of whole numbers as an initialiser."""
    return ",\n    ".join("{" + ", ".join(map(str, row)) + "}" for row in rows.tolist())
