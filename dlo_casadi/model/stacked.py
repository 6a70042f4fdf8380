"""Unknowns, inputs and directions of many poses in arrays, and functions mapped over them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from threading import Lock
from typing import Any

import casadi as ca
import numpy as np

from dlo_casadi.arrays import FloatArray, IntArray
from dlo_casadi.model.cable_model import CableModel
from dlo_casadi.rod.band import BandMatrix
from dlo_casadi.rod.ends import deviation_names
from dlo_casadi.rod.node import Frame, Heading

_NODES = {node.coordinates: node for node in (Heading, Frame)}


@dataclass(frozen=True)
class Shapes:
    """Stacked unknowns of m poses.

    Parameters
    ----------
    x : (m, n_nodes, coordinates)
        States of the nodes: of a planar cable, headings [rad].
    lam : (m, n_border)
        Multipliers of the end conditions; places and multipliers of springs.
    deviation : (m, n_deviations)
        Unknowns that each pose has of its own, see `deviation_names`.
    near : (m, k) [m], optional
        For each eyelet the arc length that says which node is moved to it: the nearest one to that.
        NaN, or none at all, where that is the eyelet's own arc length.
    """

    x: FloatArray
    lam: FloatArray
    deviation: FloatArray
    near: FloatArray = field(default_factory=lambda: np.zeros((0, 0)))

    @classmethod
    def declared(cls, x: FloatArray, lam: FloatArray, clips: int = 0) -> Shapes:
        """Shapes without deviations, of a model with that number of clips and no random effect."""
        return cls(x, lam, np.zeros((len(x), len(deviation_names(_NODES[x.shape[-1]], clips)))))

    def in_order_of(self, model: CableModel, other: CableModel) -> Shapes:
        """Multipliers and deviations of a model's poses in another model's order.

        Those that only the other model has are zero.
        """
        lam = _by_name(self.lam, model.border_names, other.border_names)
        own = _by_name(self.deviation, model.deviation_names, other.deviation_names)
        return replace(self, lam=lam, deviation=own)

    def subset(self, index: Any) -> Shapes:
        """Shapes of some of the poses."""
        near = self.near[index] if self.near.size else self.near
        return Shapes(self.x[index], self.lam[index], self.deviation[index], near)

    def near_each(self, count: int) -> FloatArray:
        """`near` of that number of eyelets (m, count)."""
        if self.near.shape == (len(self.x), count):
            return self.near
        return np.full((len(self.x), count), np.nan)

    def replaced(self, index: Any, other: Shapes) -> Shapes:
        """Shapes with those of some of the poses from `other`, which has these poses alone."""
        x, lam, deviation = self.x.copy(), self.lam.copy(), self.deviation.copy()
        x[index], lam[index], deviation[index] = other.x, other.lam, other.deviation
        count = max(self.near.shape[1], other.near.shape[1])
        near = self.near_each(count).copy()
        near[index] = other.near_each(count)
        return Shapes(x, lam, deviation, near)


def _by_name(rows: FloatArray, names: Sequence[str], others: Sequence[str]) -> FloatArray:
    """Columns (m, k) of some names, in the order of others; zeros for new ones."""
    if names == others:
        return rows
    at = dict(zip(names, rows.T, strict=True))
    columns = [at.get(name, np.zeros(len(rows))) for name in others]
    return np.array(columns).reshape((-1, len(rows))).T


@dataclass(frozen=True)
class Inputs:
    """Inputs of the equilibria of m poses.

    `p` (m, n_parameters), `rest` (m, n_rests) [1/m], `poses` (m, n_pose) as declared.
    """

    p: FloatArray
    rest: FloatArray
    poses: FloatArray

    @classmethod
    def of(cls, p: FloatArray, rest: FloatArray, poses: FloatArray) -> Inputs:
        """Inputs from parameters and rest curvature of each pose, or the same for all."""
        p, rest = (np.broadcast_to(x, (len(poses), x.shape[-1])) for x in (p, rest))
        return cls(p, rest, poses)

    def subset(self, index: Any) -> Inputs:
        """Inputs of some of the poses."""
        return Inputs(self.p[index], self.rest[index], self.poses[index])


@dataclass(frozen=True)
class Tangents:
    """Derivatives of the shapes and inputs of m poses along q directions.

    `x` (m, n_nodes, b, q) increments of the nodes, `lam` (m, k, q), `p` (m, n_parameters, q),
    `rest` (m, n_rests, q), `deviation` (m, n_deviations, q). `tangent`: the tangent matrices with
    which the derivatives of the shapes were solved, if any.
    """

    x: FloatArray
    lam: FloatArray
    p: FloatArray
    rest: FloatArray
    deviation: FloatArray
    tangent: BandMatrix | None = None

    def numbers(self, columns: slice) -> Tangents:
        """Some of the directions, with the shapes held: those of p, rest and deviation."""
        p, rest, deviation = (x[..., columns] for x in (self.p, self.rest, self.deviation))
        x, lam = (np.zeros((*part.shape[:-1], p.shape[-1])) for part in (self.x, self.lam))
        return Tangents(x, lam, p, rest, deviation)


def repeated(rows: FloatArray, count: int) -> FloatArray:
    """Rows (m, k) of poses, repeated for `count` segments or stations (m, count, k)."""
    return rows[:, None].repeat(count, axis=1)


# Segments in a block. An instruction of a vectorised function takes 16 ns and 0.25 ns per segment,
# those that fill up a block included; one of CasADi's scalar interpreter 2 to 4 ns per segment.
BLOCK = 64
# Smallest calls that are vectorised: number of segments, and of instructions over all segments,
# which take the interpreter 0.1 ms. The conversion takes 5 us per instruction, which has paid after
# 1300 segments; a function that has been evaluated for 400 will usually be for many more: in seven
# simulated sessions all evaluations together took least with 400 to 700.
FEWEST, WORTH, OFTEN = 8, 3e4, 400


class Mapped:
    """A CasADi function of a segment (or node), mapped over the segments of poses.

    It reads and writes NumPy's memory, because conversion to CasADi's matrices takes several times
    as long as the evaluation. Once it has been evaluated often, large calls are `vectorised`, and
    small ones `simplified`: they give the same numbers, bit for bit, up to eight times as fast.
    Large calls of simplified functions would be a fifth faster still, but to simplify takes longer
    than that saves, unless the function is `repetitive`. Threads take turns, because they share the
    buffers.

    Parameters
    ----------
    function : ca.Function
        Of scalars (SX).
    repetitive : bool
        Whether about half of its operations are repeated ones.
    """

    def __init__(self, function: ca.Function, *, repetitive: bool = False) -> None:
        self.function, self._evaluated, self._simplified = function, 0, False
        self.compiled = False
        self._repetitive = repetitive
        self._lock = Lock()
        self._shapes = [
            (function.size2_out(i), function.size1_out(i)) for i in range(function.n_out())
        ]
        # By number of segments. Any, here and below: CasADi's stubs do not allow NumPy memory.
        self._buffers: dict[int, tuple[Any, Any]] = {}
        self._vectorised: tuple[Any, Any] | None = None

    def use(self, compiled: ca.Function) -> None:
        """Evaluate compiled C of the same function from now on."""
        with self._lock:
            self.function, self._buffers, self.compiled = compiled, {}, True

    def __call__(self, *arguments: FloatArray) -> list[FloatArray]:
        """Arguments (m, count, rows) -> outputs (m, count, rows, columns)."""
        m, count, _ = arguments[0].shape
        given = [block.reshape(m * count, block.shape[2]) for block in arguments]
        with self._lock:
            outputs = self._evaluate(m * count, given)
        shaped = zip(outputs, self._shapes, strict=True)
        return [out.reshape(m, count, *shape).transpose(0, 1, 3, 2) for out, shape in shaped]

    def _evaluate(self, number: int, given: Sequence[FloatArray]) -> list[FloatArray]:
        """As `_one_by_one`, in the fastest way for this number of segments."""
        if self.compiled:
            return self._one_by_one(given)
        self._evaluated += number
        often = self._evaluated > OFTEN
        if often and not self._simplified and (self._repetitive or not self._is_large(number)):
            self.function, self._buffers = simplified(self.function), {}
            self._simplified = True
        in_blocks = often and self._is_large(number)
        return self._in_blocks(given) if in_blocks else self._one_by_one(given)

    def _is_large(self, number: int) -> bool:
        """Whether calls for this number of segments are worth being `vectorised`."""
        operations = number * self.function.n_instructions()
        return number >= FEWEST and operations > WORTH and self._inlined

    @cached_property
    def _inlined(self) -> bool:
        """Whether the function calls no others, as one of a user's effect may: not `vectorised`."""
        return not self.function.find_functions(0)

    def _one_by_one(self, arguments: Sequence[FloatArray]) -> list[FloatArray]:
        """Arguments (segments, rows) -> outputs (segments, size)."""
        number = len(arguments[0])
        outputs: list[FloatArray] = [np.empty((number, a * b)) for a, b in self._shapes]
        if not number:
            return outputs
        if number not in self._buffers:
            self._buffers[number] = self.function.map(number).buffer()
        given = [np.ascontiguousarray(x, dtype=float) for x in arguments]
        _run(self._buffers[number], given, outputs)
        return outputs

    def _in_blocks(self, arguments: Sequence[FloatArray]) -> list[FloatArray]:
        """As `_one_by_one`; the last block is filled up with the last segment."""
        if self._vectorised is None:
            self._vectorised = vectorised(self.function, BLOCK).buffer()
        number = len(arguments[0])
        blocks = np.minimum(np.arange(-(-number // BLOCK) * BLOCK), number - 1).reshape(-1, BLOCK)
        given = [np.ascontiguousarray(x[blocks].transpose(0, 2, 1), dtype=float) for x in arguments]
        outputs: list[FloatArray] = [np.empty((len(blocks), a * b, BLOCK)) for a, b in self._shapes]
        for k in range(len(blocks)):
            _run(self._vectorised, [x[k] for x in given], [x[k] for x in outputs])
        # Contiguous, as one by one: sums over other strides are rounded otherwise.
        rows = [np.ascontiguousarray(x.transpose(0, 2, 1)) for x in outputs]
        return [x.reshape(blocks.size, -1)[:number] for x in rows]


def _run(function: tuple[Any, Any], arguments: Sequence[Any], outputs: Sequence[Any]) -> None:
    """Evaluate a buffered function on NumPy's memory."""
    buffer, run = function
    for i, given in enumerate(arguments):
        buffer.set_arg(i, memoryview(given))
    for i, out in enumerate(outputs):
        buffer.set_res(i, memoryview(out))
    run()


def simplified(function: ca.Function) -> ca.Function:
    """The same function, each common subexpression computed once: a fifth fewer instructions."""
    arguments = [ca.SX.sym("x", *function.size_in(i)) for i in range(function.n_in())]
    return ca.Function(function.name(), arguments, ca.cse(function.call(arguments)))


def vectorised(function: ca.Function, size: int) -> ca.Function:
    """The same instructions, each for `size` rows of arguments at once.

    CasADi interprets an SX function instruction by instruction. Here each instruction is one of an
    MX function and acts on vectors, so that the interpreter's time is shared.

    Parameters
    ----------
    function : ca.Function
        Of scalars (SX), with dense arguments and outputs.
    size : int
        Number of rows.

    Returns
    -------
    ca.Function
        Its arguments and outputs are (size, numel): row k holds those of the k-th evaluation.
    """
    arguments = [ca.MX.sym("x", size, function.numel_in(i)) for i in range(function.n_in())]
    columns = [ca.horzsplit(x) if x.numel() else [] for x in arguments]
    outputs = [[ca.MX()] * function.numel_out(i) for i in range(function.n_out())]
    work = [ca.MX()] * function.sz_w()
    for k in range(function.n_instructions()):
        op, i = function.instruction_id(k), function.instruction_input(k)
        o = function.instruction_output(k)
        if op == ca.OP_OUTPUT:
            outputs[o[0]][o[1]] = work[i[0]]
        elif op == ca.OP_INPUT:
            work[o[0]] = columns[i[0]][i[1]]
        elif op == ca.OP_CONST:
            work[o[0]] = ca.MX(function.instruction_constant(k))
        elif len(i) == 1:
            work[o[0]] = ca.MX.unary(op, work[i[0]])
        else:
            work[o[0]] = ca.MX.binary(op, work[i[0]], work[i[1]])
    zero = ca.MX.zeros(size)  # constants are scalar
    full = [[x + zero if x.is_scalar() else x for x in row] for row in outputs]
    joined = [ca.horzcat(ca.MX(size, 0), *row) for row in full]
    return ca.Function(function.name(), arguments, joined)


# Axes along which outputs of segment functions are derivatives by nodes and border.
_BORDER_AXES = {
    "segment": ((), (2,), (2, 3)),
    "segment_slope": ((2,),),
    "segment_sensitivity": ((2,),),
    "segment_curve_slopes": ((), (3,), ()),
    "segment_by_edges": ((2,), (), ()),
}


@dataclass(frozen=True)
class Beyond:
    """Forces of all that holds the cables beyond their segments act like one at a segment's end.

    Functions of a segment of a cable with clips depend on that one, in the rows of the first clip.

    Parameters
    ----------
    before : (m, n_segments, k)
        1 where a segment is before a clip, else 0.
    rows : (1 + k, dimension)
        Border rows of the forces on the end's holder (-1 for a free end) and on the clips.
    """

    before: FloatArray
    rows: IntArray

    @classmethod
    def of(cls, model: CableModel, before: FloatArray) -> Beyond:
        """Forces on the clips of a model."""
        end = model.end_pull or [-1] * model.node.dimension
        return cls(before, np.array([end, *model.pulls[model.n_springs :]]))

    def summed(self, lam: FloatArray) -> FloatArray:
        """Border (m, n_segments, n_lam) with the sum of all forces beyond as first clip's force."""
        own, (end, *clips) = lam.copy(), self.rows
        total = np.zeros(lam.shape[:2] + end.shape) if end[0] < 0 else lam[..., end]
        for k, rows in enumerate(clips):
            total = total + self.before[..., [k]] * lam[..., rows]
        own[..., clips[0]] = total
        return own

    def spread(self, name: str, outputs: Sequence[FloatArray], first: int) -> None:
        """Expand derivatives by that sum, from row `first` of an axis, to those by each force.

        `outputs` (m, n_segments, rows, columns) of the function of segments of that name.
        """
        for out, axes in zip(outputs, _BORDER_AXES.get(name, ((),) * len(outputs)), strict=True):
            for axis in axes:
                self._spread(out, axis, first)

    def _spread(self, out: FloatArray, axis: int, first: int) -> None:
        rows = np.moveaxis(out, axis, 0)
        end, *clips = first + self.rows
        total = rows[clips[0]].copy()
        shape = (*self.before.shape[:2], *(1,) * (out.ndim - 3))
        if self.rows[0, 0] >= 0:
            rows[end] = total
        for k, own in enumerate(clips):
            rows[own] = total * self.before[..., k].reshape(shape)
