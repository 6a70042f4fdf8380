"""C text of the model's slots: CasADi prints the very functions that all else differentiates."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from itertools import pairwise
from math import isfinite
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from dlo_casadi.errors import DloError
from dlo_casadi.model.cable_model import CableModel
from dlo_casadi.model.functions import functions_of
from dlo_casadi.model.lagrangian import SlotNumbers, lagrangian_of
from dlo_casadi.rod.ends import EndConditions

FloatArray = NDArray[np.floating]

# Numbers that differ by less come from differences of the same mesh.
_ROUNDING = 1e-14
# Columns of a slot's own numbers: where it starts [m], and its rest curvature inside [1/m].
_OWN = 4
# What CasADi calls by names of its own; the others are those of libm.
_CALLS = {"casadi_sq": "square", "casadi_sign": "sign_of", "casadi_real": "double"}
_HELPERS = {
    "square": "static double square(double a) { return a * a; }\n",
    "sign_of": "static double sign_of(double a) { return a > 0.0 ? 1.0 : (a < 0.0 ? -1.0 : a); }\n",
}


def c_number(value: float) -> str:
    """Shortest C literal of a finite double that reads back to the same bits."""
    if not isfinite(value):
        raise DloError(f"the generated solver would contain the constant {value}")
    text = repr(float(value))
    return text if any(mark in text for mark in ".e") else text + ".0"


def table_to_c(numbers: Sequence[float]) -> str:
    """Initialiser of the table; one zero where there is nothing to store."""
    texts = [c_number(number) for number in numbers] or ["0.0"]
    rows = [", ".join(texts[i : i + 4]) for i in range(0, len(texts), 4)]
    return ",\n    ".join(rows)


@dataclass(frozen=True)
class Kernel:
    """Slots of one kind, which differ in numbers only.

    Parameters
    ----------
    members : (first, last) int
        Slots first <= j < last.
    rows : (last - first, k)
        Numbers that differ from slot to slot.
    derive : callable
        Makes the function.
    """

    members: tuple[int, int]
    rows: FloatArray
    derive: Callable[[], ca.Function]

    @cached_property
    def function(self) -> ca.Function:
        """(x, lam, row (k,), p) -> value and derivatives."""
        return self.derive()


@dataclass(frozen=True)
class Kernels:
    """All that the generated solver knows of a model's mechanics.

    Parameters
    ----------
    slots : tuple of Kernel
        In the order of the cable.
    ends : casadi.Function or None
        The holders' own energy by the first and last node; None where they have none.
    shared : (n_parameters,) or (0,)
        Parameters that stand in the table, ahead of the slots' rows.
    """

    slots: tuple[Kernel, ...]
    ends: ca.Function | None
    shared: FloatArray

    @property
    def table(self) -> list[float]:
        """What the kernels read: shared numbers, then the rows of all slots."""
        rows = [kernel.rows.ravel() for kernel in self.slots]
        return [float(number) for number in np.concatenate([self.shared, *rows])]

    @property
    def operations(self) -> int:
        """Floating-point operations of all kernels."""
        counts = (
            (last - first) * kernel.function.n_nodes()
            for kernel in self.slots
            for first, last in [kernel.members]
        )
        return sum(counts)

    @property
    def code_size(self) -> int:
        """Bytes of their machine code, about."""
        return round(11.5 * sum(kernel.function.n_nodes() for kernel in self.slots))

    def loops(self, call: str, table_at: int = 0) -> list[str]:
        """Statements that call all kernels, `table_at` after the start of the solver's table.

        `call` has the places {k}, the kernel's number, and {row}, its numbers.
        """
        found, offset = [], table_at + len(self.shared)
        for k, kernel in enumerate(self.slots):
            (first, last), width = kernel.members, kernel.rows.shape[1]
            row = f"table + {offset} + (j - {first}) * {width}" if width else "table"
            found.append(
                f"    for (j = {first}; j < {last}; ++j)\n        {call.format(k=k, row=row)};"
            )
            offset += kernel.rows.size
        return found

    def to_c(self, elastic: bool) -> tuple[str, str]:
        """Kernel functions of a planar cable, and the statements that call them for all slots."""
        functions = [_kernel_text(k, kernel, elastic) for k, kernel in enumerate(self.slots)]
        loops = self.loops("total += kernel_{k}(q, j, {row}, table)")
        if self.ends is not None:
            functions.append(_ends_text(self.ends))
            loops.append("    total += at_ends(q, table);")
        return with_helpers(functions), "\n".join(loops)


def size_of_code(meshes: Iterable[Kernels], numbers: Sequence[float]) -> int:
    """Bytes of a compiled solver, about: of its own code and kernels, and its table.

    Of 13 solvers in the plane and in space, with gcc 12 -O2 on x86-64, it is within 8 %.
    """
    return 25_000 + sum(kernels.code_size for kernels in meshes) + 8 * len(numbers)


def with_helpers(functions: Sequence[str]) -> str:
    """Text of functions, and ahead of it what they call."""
    text = "\n".join(functions)
    helpers = [helper for name, helper in _HELPERS.items() if f"{name}(" in text]
    return "\n".join([*helpers, text])


def kernels_of(model: CableModel, p: FloatArray, rest: FloatArray, inline: bool = True) -> Kernels:
    """Kernels of a model at given parameters.

    Parameters
    ----------
    inline : bool
        Whether numbers that all slots share are written into the code; otherwise parameters and
        rows are in the table, and cables of one kind differ in it alone.
    """
    places = model.chain.layout.slots
    own = np.column_stack([places[:, 0], model.chain.rest_inside(rest[:, None])[..., 0]])
    kinds = places[:, 1:] - [0, 1, 0, 0] * places[:, :1]
    parameters = ca.SX(ca.DM(p)) if inline else ca.SX.sym("p", len(p))
    # A force on a single place pulls at all of a slot, at nothing of it, or it stands in there.
    shares = np.array([np.array(lagrangian_of(model).shares(p, place)).ravel() for place in places])
    inside = (shares > 0) & (shares < 1)
    alone = np.arange(len(own))[:, None] * inside
    told = (
        np.column_stack([kinds.round(14), shares * ~inside, alone]) if inline else kinds.round(14)
    )
    edges = [0, *(np.flatnonzero(np.any(np.diff(told, axis=0), axis=1)) + 1), len(own)]
    slots = tuple(
        _kernel(model, parameters, places[first], own[first:last], (first, last), inline)
        for first, last in pairwise(edges)
    )
    shared = np.zeros(0) if inline else np.asarray(p, float)
    return Kernels(slots, _ends(model, parameters), shared)


def _kernel(
    model: CableModel,
    p: ca.SX,
    first: FloatArray,
    own: FloatArray,
    members: tuple[int, int],
    inline: bool,
) -> Kernel:
    varies = [
        not (inline and np.allclose(column, column[0], rtol=_ROUNDING, atol=0.0))
        for column in own.T
    ]
    row = ca.SX.sym("row", sum(varies))
    symbols = iter(ca.vertsplit(row)) if row.numel() else iter(())
    values = [
        next(symbols) if varied else ca.SX(float(column[0]))
        for varied, column in zip(varies, own.T, strict=True)
    ]
    start = values[0]
    # The cell's start is counted from the slot's, so that slots of one kind differ in that alone.
    place = ca.vertcat(start, first[1], start + (first[2] - first[0]), *first[3:])
    numbers = SlotNumbers(
        p,
        ca.vertcat(*values[1:]),
        place,
        ca.SX.zeros(len(model.deviation_names)),
        lagrangian_of(model).shares(p, ca.DM(first) if inline else place),
    )
    derivatives = _in_space if model.in_space else _in_plane
    return Kernel(members, own[:, varies], partial(derivatives, model, numbers, row))


def _in_plane(model: CableModel, numbers: SlotNumbers, row: ca.SX) -> ca.Function:
    """(x (2,), lam (2,), row, p) -> value, gradient (4,), upper triangle of the Hessian."""
    x, lam = ca.SX.sym("x", 2), ca.SX.sym("lam", 2)
    position = ca.SX.zeros(0) if model.end == "free" else lam
    multipliers = ca.vertcat(position, ca.SX.zeros(2))[: model.n_conditions]
    arguments = [x, multipliers, numbers.p, numbers.rest, numbers.place, numbers.deviation]
    both: Any = functions_of(model).slot_by_share(
        *arguments, numbers.shares
    )  # CasADi's stubs: one result
    value, advance = both
    if model.end == "free":
        # lam is zero there; its derivative is the way from slot to slot all the same.
        value += ca.dot(lam, advance)
    return _derivatives(value, [x, lam, row, _symbols(numbers.p)], ca.vertcat(x, lam))


def _in_space(model: CableModel, numbers: SlotNumbers, row: ca.SX) -> ca.Function:
    """(x (8,), lam (3,), row, p) -> what `_told_in_space` tells, in one vector."""
    x, lam = ca.SX.sym("x", 8), ca.SX.sym("lam", 3)
    outputs = ca.vertcat(*_told_in_space(model, x, lam, numbers))
    arguments = [x, lam, row, _symbols(numbers.p)]
    return ca.Function("kernel", arguments, ca.cse([ca.densify(outputs)]))


def _told_in_space(model: CableModel, x: ca.SX, lam: ca.SX, numbers: SlotNumbers) -> list[ca.SX]:
    """A slot's Lagrangian and its derivatives by increments about the world's axes.

    Parameters
    ----------
    x : (8,)
        Frames of both nodes.
    lam : (3,) [N]
        Force on the end's holder; also where that is free, for its derivative is the advance.

    Returns
    -------
    list
        Value; by lam: advance (3,) [m]; phi (3,) [rad]; slopes (3,) by the first, last node;
        Hessian by first-first, first-last, last-last, first-lam, last-lam, lam-lam: rows one after
        another (9,), of symmetric blocks the upper triangle column by column (6,).
    """
    found = lagrangian_of(model).in_frame(x, lam, numbers).derivatives()
    found = found.about(found.turn, found.turn)
    (first, between, last), (first_lam, last_lam) = found.bends, found.mixed
    return [
        found.value,
        found.by_lam,
        found.phi,
        *found.slopes,
        _triangle(first),
        _rows(between),
        _triangle(last),
        _rows(first_lam),
        _rows(last_lam),
        _triangle(found.lam_lam),
    ]


def _rows(a: ca.SX) -> ca.SX:
    return ca.vec(a.T)


def _triangle(a: ca.SX) -> ca.SX:
    return ca.vertcat(*(a[: k + 1, k] for k in range(3)))


def _ends(model: CableModel, p: ca.SX) -> ca.Function | None:
    """Energy of the holders, without end conditions."""
    node = model.node
    x, lam = ca.SX.sym("x", 2 * node.coordinates), ca.SX.zeros(model.n_conditions)
    pose = np.zeros(model.n_pose)
    pose[2 * node.dimension : EndConditions.size(node)] = 2 * node.identity
    value, _, _ = functions_of(model).at_ends(
        x, lam, p, pose, ca.DM.zeros(len(model.deviation_names))
    )
    if not ca.depends_on(value, x):
        return None
    return _derivatives(value, [x, _symbols(p)], x)


def _symbols(p: ca.SX) -> ca.SX:
    return p if p.is_valid_input() else ca.SX.zeros(0)


def _derivatives(value: ca.SX, arguments: list[ca.SX], by: ca.SX) -> ca.Function:
    hessian, gradient = ca.hessian(value, by)
    outputs = ca.cse([value, ca.sparsify(gradient), ca.triu(hessian)])
    return ca.Function("kernel", arguments, outputs)


# ---- text --------------------------------------------------------------------------------------

Targets = dict[tuple[int, int], str]

_BODY = re.compile(r"^static int casadi_f0\(.*?\{\n(.*?)^\}", re.MULTILINE | re.DOTALL)
_INPUT = re.compile(r"arg\[(\d+)\]\? arg\[\1\]\[(\d+)\] : 0")
_OUTPUT = re.compile(r"if \(res\[(\d+)\]!=0\) res\[\1\]\[(\d+)\]=(.*?);")


def statements(function: ca.Function, inputs: Sequence[str], targets: Targets) -> str:
    """What CasADi prints for a function, reading and writing our names.

    Parameters
    ----------
    inputs : sequence of str
        C array of each input.
    targets : dict
        (output, nonzero) -> the assignment's left side and operator.
    """
    generator = ca.CodeGenerator("kernel")
    generator.add(function)
    found = _BODY.search(generator.dump())
    if found is None:  # pragma: no cover: another version of CasADi prints in another way
        raise DloError("CasADi printed no function; try another version of CasADi")

    def output(match: re.Match[str]) -> str:
        target = targets.get((int(match[1]), int(match[2])))
        return f"{target} {match[3]};" if target else ""

    text = _INPUT.sub(lambda match: f"{inputs[int(match[1])]}[{match[2]}]", found[1])
    text = _OUTPUT.sub(output, text).replace("  return 0;\n", "")
    text = re.sub(
        r"casadi_\w+", lambda match: _CALLS.get(match[0], match[0][len("casadi_") :]), text
    )
    return "\n".join("  " + line for line in text.splitlines() if line.strip())


def _by_place(function: ca.Function, targets: dict[tuple, str]) -> Targets:
    """Of ("value",), ("g", row), ("h", row, column) -> text, those of nonzero outputs."""
    return {at: targets[place] for at, place in _places(function) if place in targets}


def _places(function: ca.Function) -> Iterator[tuple[tuple[int, int], tuple]]:
    """Where each nonzero of the outputs belongs."""
    yield (0, 0), ("value",)
    for i, row in enumerate(function.sparsity_out(1).row()):
        yield (1, i), ("g", row)
    hessian = function.sparsity_out(2)
    for i, place in enumerate(zip(hessian.row(), hessian.get_col(), strict=True)):
        yield (2, i), ("h", *place)


# Of the unknowns (x_j, x_(j+1), lam_x, lam_y): where a slot's derivatives are added or set.
_TARGETS: dict[tuple, tuple[str, ...]] = {
    ("g", 0): ("q->gradient[j] +=",),
    ("g", 1): ("q->gradient[j + 1] =",),
    ("h", 0, 0): ("q->diagonal[j] +=",),
    ("h", 1, 1): ("q->diagonal[j + 1] =",),
    ("h", 0, 1): ("q->off[j] =",),
    ("h", 0, 2): ("q->jx[j] +=",),
    ("h", 0, 3): ("q->jy[j] +=",),
    ("h", 1, 2): ("q->jx[j + 1] = q->bx[j] =",),
    ("h", 1, 3): ("q->jy[j + 1] = q->by[j] =",),
    ("g", 2): ("q->ax[j] =",),
    ("g", 3): ("q->ay[j] =",),
}
_ELASTIC: dict[tuple, tuple[str, ...]] = {
    ("h", 2, 2): ("q->kx[j] =",),
    ("h", 2, 3): ("q->kxy[j] =",),
    ("h", 3, 3): ("q->ky[j] =",),
}


def _kernel_text(k: int, kernel: Kernel, elastic: bool) -> str:
    targets = {place: text for place, (text,) in (_TARGETS | (_ELASTIC if elastic else {})).items()}
    there = {place for _, place in _places(kernel.function)}
    zeros = [
        f"    {text} 0.0;"
        for place, text in targets.items()
        if place not in there and not text.endswith("+=")
    ]
    targets["value",] = "value ="
    inputs = ("x", "q->lam", "row", "table")
    body = statements(kernel.function, inputs, _by_place(kernel.function, targets))
    first, last = kernel.members
    return "\n".join(
        [
            f"/* Slots {first} to {last - 1}. */",
            f"static double kernel_{k}(point_t *q, int j, const double *row, const double *table)",
            "{",
            "    const double *const x = q->x + j;",
            "    double value = 0.0;",
            body,
            *zeros,
            "    (void)x, (void)row, (void)table;",
            "    return value;",
            "}",
            "",
        ]
    )


def _ends_text(function: ca.Function) -> str:
    targets: dict[tuple, str] = {
        ("value",): "value =",
        ("g", 0): "q->gradient[0] +=",
        ("g", 1): "q->gradient[SLOTS - 1] +=",
        ("h", 0, 0): "q->diagonal[0] +=",
        ("h", 1, 1): "q->diagonal[SLOTS - 1] +=",
    }
    body = statements(function, ("x", "table"), _by_place(function, targets))
    return "\n".join(
        [
            "/* What holds the first and the last node beside their conditions. */",
            "static double at_ends(point_t *q, const double *table)",
            "{",
            "    const double x[2] = {q->x[0], q->x[SLOTS - 1]};",
            "    double value = 0.0;",
            body,
            "    (void)x, (void)table;",
            "    return value;",
            "}",
            "",
        ]
    )
