"""The model's segments as C functions, made of the same expressions as used elsewhere."""

import re
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from enum import Enum, auto
from functools import cached_property, partial
from itertools import pairwise
from typing import Any

import casadi as ca
import numpy as np

from dlo_casadi.arrays import FloatArray
from dlo_casadi.codegen.c_text import ends_text, helpers_of, statements
from dlo_casadi.codegen.feeding import load_beyond, load_text, with_rows_beyond
from dlo_casadi.effects import Effect
from dlo_casadi.model.cable_model import CableModel
from dlo_casadi.model.framed import SegmentNumbers, in_frame
from dlo_casadi.model.functions import functions_of
from dlo_casadi.model.lagrangian import lagrangian_of
from dlo_casadi.rod.ends import EndConditions
from dlo_casadi.rod.in_frame import SegmentDerivatives
from dlo_casadi.rod.supports import SupportKind

# Bytes of machine code per operation of a function.
PER_OPERATION = 11.5
# Largest difference at which two numbers count as equal: rounding of the mesh.
_ROUNDING = 1e-14


@dataclass(frozen=True)
class Kernel:
    """Segments first <= j < last of one kind, which differ only in a row of numbers each.

    `members`: (first, last); `rows` (last - first, k): the numbers of each segment; `derive`: makes
    the function. `moved`: of segments beside nodes that are moved along the cable; the pose has
    their rows, see `row_of` in C.
    """

    members: tuple[int, int]
    rows: FloatArray
    derive: Callable[[], ca.Function]
    moved: bool = False

    @cached_property
    def function(self) -> ca.Function:
        """(x, lam, row (k,), p) -> value and derivatives."""
        return self.derive()

    def loop(self, name: str, table_at: int) -> str:
        """C statement that calls it for all its segments; their rows begin at `table_at`."""
        (first, last), width = self.members, self.rows.shape[1]
        row = f"table + {table_at} + (j - {first}) * {width}" if width else "table"
        row, of = ("row_of(w, j)", "MOVED") if self.moved else (row, "SEGMENTS")
        state = self.function.numel_in(0) // 2
        return f"""\
    FOR_{of}({first}, {last})
        {name}(x + {state} * j, FORCE, {row}, table,
        {" " * len(name)} segment + SEGMENT * j);"""

    def alone(self, name: str) -> str:
        """C statement that calls it for segment j alone."""
        return f"    {name}(x + {self.function.numel_in(0) // 2} * j, lam, row, table, out);"

    def text(self, name: str) -> str:
        """The function in C."""
        first, last = self.members
        targets = [f"out[{i}] =" for i in range(self.function.nnz_out(0))]
        head = f"static void {name}("
        return f"""\
/* Segments {first} to {last - 1}. */
{head}const double *x, const double *lam, const double *row,
{" " * len(head)}const double *table, double *RESTRICT out)
{{
{statements(self.function, ("x", "lam", "row", "table"), targets)}
    (void)x, (void)lam, (void)row, (void)table;
}}
"""


@dataclass(frozen=True)
class Kernels:
    """The mechanics of a model in the generated solver.

    `segments` are in the order of the cable. `ends` is the energy of the holders, if any, as a
    function of the first and last node. `shared` (n_parameters,) or (0,) are the parameters in the
    table, before the segments' rows. `even` (n, k): rows of all segments between even nodes, from
    which those between moved ones are made. `holder` is a segment with a tether inside, at a share
    of its length that follows its row; `edges` the derivatives of one by where its ends are; `load`
    the force of all distributed loads beyond an arc length.
    """

    segments: tuple[Kernel, ...]
    ends: ca.Function | None
    shared: FloatArray
    even: FloatArray
    holder: Kernel | None = None
    edges: Kernel | None = None
    load: ca.Function | None = None

    @property
    def all(self) -> list[Kernel]:
        """Kernels of segments, then those of some alone."""
        return [*self.segments, *(one for one in (self.holder, self.edges) if one is not None)]

    @property
    def table(self) -> list[float]:
        """Numbers that the kernels read: shared ones, then the rows of all segments."""
        rows = [kernel.rows.ravel() for kernel in self.segments]
        return [float(number) for number in np.concatenate([self.shared, *rows, self.even.ravel()])]

    @property
    def operations(self) -> int:
        """Floating-point operations of all kernels."""
        return sum(len(kernel.rows) * kernel.function.n_nodes() for kernel in self.segments)

    @property
    def code_size(self) -> int:
        """Approximate size of their machine code in bytes."""
        return round(PER_OPERATION * sum(kernel.function.n_nodes() for kernel in self.all))


def kernel_texts(meshes: dict[str, Kernels]) -> dict[str, int | str]:
    """C text of the kernels of meshes by the mesh's name, as values of the templates' marks.

    LOOPS call the KERNELS for the segments, HELD the one for a segment that a tether holds, EDGES
    that for the ends of a segment; rows of segments between even nodes begin at EVEN in their
    table, of length EXTRA. With two meshes the second one is called if `w->coarse` is set.
    """
    functions: list[str] = []
    loops: list[str] = []
    alone: dict[str, list[str]] = {"held": [], "edges": []}
    even: list[str] = []
    at = 0
    for name, kernels in meshes.items():
        statements, at = [], at + len(kernels.shared)
        for k, kernel in enumerate(kernels.segments):
            functions.append(kernel.text(f"{name}_{k}"))
            statements.append(kernel.loop(f"{name}_{k}", at))
            at += kernel.rows.size
        for kind, one in (("held", kernels.holder), ("edges", kernels.edges)):
            if one is not None:
                functions.append(one.text(f"{name}_{kind}"))
                alone[kind].append(one.alone(f"{name}_{kind}"))
        if kernels.even.size:
            even.append(str(at))
            at += kernels.even.size
        loops.append("\n".join(statements))
    text, ends = "\n".join(functions), "\n".join(ends_text(x.ends) for x in meshes.values())
    load = load_text(meshes["kernel"].load)
    helpers = helpers_of(text + ends + load)
    return {
        "KERNELS": "\n".join([*helpers, text, load]),
        "LOOPS": _by_mesh(loops),
        "HELD": _by_mesh(alone["held"]),
        "EDGES": _by_mesh(alone["edges"]),
        "EVEN": f"w->coarse ? {even[1]} : {even[0]}" if len(even) > 1 else "".join(even) or "0",
        "ENDS": ends,
        "EXTRA": at,
    }


def _by_mesh(statements: list[str]) -> str:
    """Choose the statements of the mesh in use: the fine one, or the coarse one if there is one."""
    text, *coarse = statements or [""]
    for inside in coarse:
        inside = re.sub("^", "    ", inside, flags=re.MULTILINE)
        text = f"    if (w->coarse) {{\n{inside}\n        return;\n    }}\n{text}"
    return text


def size_of_code(meshes: Iterable[Kernels], numbers: Sequence[float]) -> int:
    """Approximate size of a compiled solver in bytes: code, kernels and table.

    Accurate to 8 % for 13 solvers in the plane and in space, with gcc 12 -O2 on x86-64.
    """
    return 25_000 + sum(kernels.code_size for kernels in meshes) + 8 * len(numbers)


class Moved(Enum):
    """Which nodes of a mesh are moved along the cable."""

    NONE = auto()
    SOME = auto()
    ALL = auto()


@dataclass(frozen=True)
class Holding:
    """How a cable is held between its ends.

    `moved`: nodes that are moved to clips; `slides`: whether the cable slides through one, or an
    end; `tether`: an effect that holds it inside a segment; `fed`: whether an end slides.
    """

    moved: Moved
    slides: bool
    tether: Effect | None
    fed: bool = False


def kernels_of(
    model: CableModel,
    p: FloatArray,
    rest: FloatArray,
    inline: bool = True,
    held: Holding | None = None,
) -> Kernels:
    """Kernels of a model without clips and tethers; `inline` as in `generate`."""
    moved = Moved.NONE if held is None else held.moved
    places = model.chain.layout.segments
    own = np.column_stack([places[:, 0], model.chain.rest_inside(rest[:, None])[..., 0]])
    parameters = ca.SX(ca.DM(p)) if inline else ca.SX.sym("p", len(p))
    shared = np.zeros(0) if inline else np.asarray(p, float)
    rows = np.insert(own, 1, places[:, 1], axis=1)
    whole, none = (0, len(own)), own[:, :0]
    beside, width = list[Kernel](), rows.shape[1]
    holder = edges = None
    if held is not None and held.tether is not None:
        inside = partial(_held_inside, model, parameters, width, held)
        holder = Kernel(whole, none, inside)
    if held is not None and held.slides:
        edges = Kernel(whole, none, partial(_by_edges, model, parameters, width))
    if moved != Moved.NONE:
        beside = [Kernel(whole, none, partial(_from_row, model, parameters, width), moved=True)]
    even = none if held is None else rows
    load = None
    if held is not None and held.fed:
        even = with_rows_beyond(rows)
        load = load_beyond(model, parameters, _symbols(parameters))
    told = _ends(model, parameters), shared, even, holder, edges, load
    if moved == Moved.ALL:
        return Kernels(tuple(beside), *told)
    kinds = places[:, 1:] - [0, 1, 0, 0, 0] * places[:, :1]
    # A point force acts on a whole segment, on none of it, or from a place inside it.
    shares = np.array([np.array(lagrangian_of(model).shares(p, place)).ravel() for place in places])
    within = (shares > 0) & (shares < 1)
    alone = np.arange(len(own))[:, None] * within
    alike = (
        np.column_stack([kinds.round(14), shares * ~within, alone]) if inline else kinds.round(14)
    )
    first_ones = [0, *(np.flatnonzero(np.any(np.diff(alike, axis=0), axis=1)) + 1), len(own)]
    segments = tuple(
        _kernel(model, parameters, places[first], own[first:last], (first, last), inline)
        for first, last in pairwise(first_ones)
    )
    return Kernels((*segments, *beside), *told)


def _from_row(model: CableModel, p: ca.SX, width: int) -> ca.Function:
    """(x, lam, row, p) -> results of a segment whose numbers are in a row, see `_in_order`.

    `row` (width,) has the arc length of its start, its length [m] and rest strains.
    """
    row, (has_cell, mesh) = ca.SX.sym("row", width), model.chain.layout.segments[0, 4:]
    place = ca.vertcat(row[0], row[1], row[0], row[1], has_cell, mesh)
    still = ca.SX.zeros(len(model.deviation_names))
    shares = ca.SX(lagrangian_of(model).shares(p, place))
    return _plain(model, SegmentNumbers(p, row[2:], place, still, shares), row)


def _held_inside(model: CableModel, p: ca.SX, width: int, held: Holding) -> ca.Function:
    """As `_from_row`, of a segment that is held at a share of it, which follows its row.

    `lam` has the force beyond the segment, then that on what holds it. Derivatives by the latter
    follow the results: first ones, mixed ones with the first node, the last node and the force
    beyond, second ones.
    """
    assert held.tether is not None
    d, more = model.node.dimension, len(held.tether.parameters(model.cable))
    model = replace(model, effects=(*model.effects, held.tether))
    p, terms = ca.vertcat(p, ca.SX.zeros(more)), lagrangian_of(model)
    row, lam = ca.SX.sym("row", width + 1), ca.SX.sym("lam", 2 * d)
    x = ca.SX.sym("x", 2 * model.node.coordinates)
    has_cell, mesh = model.chain.layout.segments[0, 4:]
    length = ca.SX(mesh) if held.moved == Moved.NONE else row[1]
    place = ca.vertcat(row[0], length, row[0], length, has_cell, mesh)
    still, count = ca.SX.zeros(len(model.deviation_names)), model.n_springs
    shares = ca.SX(terms.shares(p, place))
    shares[-count:] = row[width]
    numbers = SegmentNumbers(p, row[2:width], place, still, shares)
    found = _derivatives(model, x, lam, numbers)
    beyond = replace(
        found,
        by_lam=found.by_lam[:d],
        mixed=(found.mixed[0][:, :d], found.mixed[1][:, :d]),
        lam_lam=found.lam_lam[:d, :d],
    )
    outputs = [*_in_order(beyond), found.by_lam[d : 2 * d]]
    outputs += [_rows(part[:, d : 2 * d]) for part in found.mixed]
    outputs += [_rows(found.lam_lam[:d, d : 2 * d])]
    outputs += [_triangle(found.lam_lam[d : 2 * d, d : 2 * d])]
    told = ca.cse([ca.densify(ca.vertcat(*outputs))])
    return ca.Function("kernel", [x, lam, row, _symbols(p[: p.numel() - more])], told)


def _by_edges(model: CableModel, p: ca.SX, width: int) -> ca.Function:
    """(x, lam, row, p) -> derivatives of a segment's Lagrangian by the arc lengths of its ends.

    `row` has these, then the row of the even segment of which it has the rest strains. For each end
    [N]: of the Lagrangian, of its gradient by the first node, the last node, and the force beyond;
    then the second ones, 00, 01, 11.
    """
    model = replace(model, clips=(SupportKind.PINNED,))
    row, lam = ca.SX.sym("row", 2 + width), ca.SX.sym("lam", model.node.dimension)
    x, ends = ca.SX.sym("x", 2 * model.node.coordinates), row[:2]
    place = ca.vertcat(ends, model.chain.layout.segments[0, 5], row[2])
    still = ca.SX.zeros(len(model.deviation_names))
    shares = ca.SX(lagrangian_of(model).shares(p, place))
    numbers = SegmentNumbers(p, row[4:], place, still, shares)
    found = _derivatives(model, x, lam, numbers)
    if model.node.increment > 1:
        first, last, by_lam = in_frame(lagrangian_of(model), x, lam, numbers).by_numbers(ends)
        mixed = ca.vertcat(found.turn @ first, found.turn @ last, by_lam)
    else:
        mixed = ca.jacobian(ca.vertcat(*found.slopes, found.by_lam), ends)
    slope = ca.gradient(found.value, ends)
    twice = ca.jacobian(slope, ends)
    outputs = [slope[0], mixed[:, 0], slope[1], mixed[:, 1], _triangle(twice)]
    told = ca.cse([ca.densify(ca.vertcat(*outputs))])
    return ca.Function("kernel", [x, lam, row, _symbols(p)], told)


def _kernel(
    model: CableModel,
    p: ca.SX,
    first: FloatArray,
    own: FloatArray,
    members: tuple[int, int],
    inline: bool,
) -> Kernel:
    alike = np.isclose(own, own[0], rtol=_ROUNDING, atol=0.0).all(axis=0) & inline
    row = ca.SX.sym("row", int(np.sum(~alike)))
    values = [ca.SX(number) for number in own[0]]
    for i, k in enumerate(np.flatnonzero(~alike)):
        values[k] = row[i]
    start = values[0]
    # The cell's start counts from the segment's start: otherwise segments would not be of one kind.
    place = ca.vertcat(start, first[1], start + (first[2] - first[0]), *first[3:])
    numbers = SegmentNumbers(
        p,
        ca.vertcat(*values[1:]),
        place,
        ca.SX.zeros(len(model.deviation_names)),
        lagrangian_of(model).shares(p, ca.DM(first) if inline else place),
    )
    return Kernel(members, own[:, ~alike], partial(_plain, model, numbers, row))


def _plain(model: CableModel, numbers: SegmentNumbers, row: ca.SX) -> ca.Function:
    """(x, lam, row, p) -> a segment's Lagrangian and its derivatives in one vector."""
    x, lam = ca.SX.sym("x", 2 * model.node.coordinates), ca.SX.sym("lam", model.node.dimension)
    found = _in_order(_derivatives(model, x, lam, numbers))
    arguments = [x, lam, row, _symbols(numbers.p)]
    return ca.Function("kernel", arguments, ca.cse([ca.densify(ca.vertcat(*found))]))


def _derivatives(
    model: CableModel, x: ca.SX, lam: ca.SX, numbers: SegmentNumbers
) -> SegmentDerivatives:
    """Derivatives of a segment's Lagrangian; in space by rotations about the world's axes.

    x: states of both nodes. lam [N]: force beyond the segment, also for a free end, then that on
    what holds it inside.
    """
    terms = lagrangian_of(model)
    if model.node.increment > 1:
        none = ca.SX.zeros(3, 1 + len(terms.pulls) - lam.numel() // 3)
        forces = ca.horzcat(ca.reshape(lam, 3, lam.numel() // 3), none)
        found = in_frame(terms, x, forces, numbers).derivatives()
        return found.about(found.turn, found.turn)
    # At a free end lam is zero, but the derivative with respect to it is still the advance.
    free = not terms.end_pull
    multipliers = ca.SX.zeros(model.n_lam)
    for rows, own in zip((terms.end_pull, *terms.pulls), ca.vertsplit(lam, 2), strict=False):
        multipliers[rows] = own[: len(rows)]
    arguments = [x, multipliers, numbers.p, numbers.rest, numbers.place, numbers.deviation]
    both: Any = functions_of(model).segment_by_share(
        *arguments, numbers.shares
    )  # CasADi's stubs: one result
    value, advance = both
    if free:
        value += ca.dot(lam, advance)
    hessian, gradient = ca.hessian(value, ca.vertcat(x, lam))
    nodes, forces = hessian[:2, :2], hessian[:2, 2:]
    return SegmentDerivatives(
        value,
        turn=ca.SX(0, 0),
        phi=ca.SX(0, 1),
        slopes=(gradient[0], gradient[1]),
        by_lam=gradient[2:],
        bends=(nodes[0, 0], nodes[0, 1], nodes[1, 1]),
        mixed=(forces[0, :], forces[1, :]),
        lam_lam=hessian[2:, 2:],
    )


def _in_order(found: SegmentDerivatives) -> list[ca.SX]:
    """Derivatives of a segment in the order of the C text.

    Value; by lam: advance [m]; in space the rotation vector from node to node [rad]; gradient by
    the first, last node; Hessian by first-first, first-last, last-last, first-lam, last-lam,
    lam-lam: row by row; of symmetric blocks only the upper triangle, column by column.
    """
    (first, between, last), mixed = found.bends, found.mixed
    bends = [_triangle(first), _rows(between), _triangle(last)]
    borders = [*map(_rows, mixed), _triangle(found.lam_lam)]
    return [found.value, found.by_lam, found.phi, *found.slopes, *bends, *borders]


def _rows(a: ca.SX) -> ca.SX:
    return ca.vec(a.T)


def _triangle(a: ca.SX) -> ca.SX:
    return ca.vertcat(*(a[: k + 1, k] for k in range(a.shape[1])))


def _ends(model: CableModel, p: ca.SX) -> ca.Function | None:
    """Energy of the holders, without end conditions."""
    node = model.node
    x, lam = ca.SX.sym("x", 2 * node.coordinates), ca.SX.zeros(len(model.condition_names))
    pose = np.zeros(model.n_pose)
    pose[2 * node.dimension : EndConditions.size(node)] = 2 * node.identity
    value, _, _ = functions_of(model).at_ends(
        x, lam, p, pose, ca.DM.zeros(len(model.deviation_names))
    )
    if not ca.depends_on(value, x):
        return None
    hessian, gradient = ca.hessian(value, x)
    told = ca.densify(ca.vertcat(value, gradient, ca.diag(hessian)))
    return ca.Function("at_ends", [x, _symbols(p)], ca.cse([told]))


def _symbols(p: ca.SX) -> ca.SX:
    return p if p.is_valid_input() else ca.SX.zeros(0)
