"""Scalar programs: the instructions of a CasADi function as a graph, as symbols, as C."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from math import isfinite
from typing import Any

import casadi as ca

from dlo_casadi.errors import DloError

# Operation -> C expression of its operands.
_C_TEXT: dict[int, str] = {
    ca.OP_ADD: "{0} + {1}",
    ca.OP_SUB: "{0} - {1}",
    ca.OP_MUL: "{0} * {1}",
    ca.OP_DIV: "{0} / {1}",
    ca.OP_NEG: "-{0}",
    ca.OP_SQ: "{0} * {0}",
    ca.OP_TWICE: "2.0 * {0}",
    ca.OP_INV: "1.0 / {0}",
    ca.OP_SQRT: "sqrt({0})",
    ca.OP_SIN: "sin({0})",
    ca.OP_COS: "cos({0})",
    ca.OP_TAN: "tan({0})",
    ca.OP_ASIN: "asin({0})",
    ca.OP_ACOS: "acos({0})",
    ca.OP_ATAN: "atan({0})",
    ca.OP_SINH: "sinh({0})",
    ca.OP_COSH: "cosh({0})",
    ca.OP_TANH: "tanh({0})",
    ca.OP_EXP: "exp({0})",
    ca.OP_LOG: "log({0})",
    ca.OP_EXPM1: "expm1({0})",
    ca.OP_LOG1P: "log1p({0})",
    ca.OP_POW: "pow({0}, {1})",
    ca.OP_CONSTPOW: "pow({0}, {1})",
    ca.OP_ATAN2: "atan2({0}, {1})",
    ca.OP_HYPOT: "hypot({0}, {1})",
    ca.OP_FMIN: "fmin({0}, {1})",
    ca.OP_FMAX: "fmax({0}, {1})",
    ca.OP_FABS: "fabs({0})",
    ca.OP_COPYSIGN: "copysign({0}, {1})",
    ca.OP_SIGN: "({0} > 0.0 ? 1.0 : ({0} < 0.0 ? -1.0 : 0.0))",
    ca.OP_LT: "({0} < {1} ? 1.0 : 0.0)",
    ca.OP_LE: "({0} <= {1} ? 1.0 : 0.0)",
    ca.OP_EQ: "({0} == {1} ? 1.0 : 0.0)",
    ca.OP_NE: "({0} != {1} ? 1.0 : 0.0)",
    ca.OP_NOT: "({0} == 0.0 ? 1.0 : 0.0)",
    ca.OP_AND: "(({0} != 0.0 && {1} != 0.0) ? 1.0 : 0.0)",
    ca.OP_OR: "(({0} != 0.0 || {1} != 0.0) ? 1.0 : 0.0)",
    ca.OP_IF_ELSE_ZERO: "({0} != 0.0 ? {1} : 0.0)",
}

# Operation -> the same on symbols.
_ON_SYMBOLS: dict[int, Callable[..., Any]] = {
    ca.OP_ADD: lambda a, b: a + b,
    ca.OP_SUB: lambda a, b: a - b,
    ca.OP_MUL: lambda a, b: a * b,
    ca.OP_DIV: lambda a, b: a / b,
    ca.OP_NEG: lambda a: -a,
    ca.OP_SQ: lambda a: a * a,
    ca.OP_TWICE: lambda a: 2 * a,
    ca.OP_INV: lambda a: 1 / a,
    ca.OP_SQRT: ca.sqrt,
    ca.OP_SIN: ca.sin,
    ca.OP_COS: ca.cos,
    ca.OP_TAN: ca.tan,
    ca.OP_ASIN: ca.asin,
    ca.OP_ACOS: ca.acos,
    ca.OP_ATAN: ca.atan,
    ca.OP_SINH: ca.sinh,
    ca.OP_COSH: ca.cosh,
    ca.OP_TANH: ca.tanh,
    ca.OP_EXP: ca.exp,
    ca.OP_LOG: ca.log,
    ca.OP_EXPM1: ca.expm1,
    ca.OP_LOG1P: ca.log1p,
    ca.OP_POW: ca.power,
    ca.OP_CONSTPOW: ca.power,
    ca.OP_ATAN2: ca.atan2,
    ca.OP_HYPOT: ca.hypot,
    ca.OP_FMIN: ca.fmin,
    ca.OP_FMAX: ca.fmax,
    ca.OP_FABS: ca.fabs,
    ca.OP_COPYSIGN: ca.copysign,
    ca.OP_SIGN: ca.sign,
    ca.OP_LT: lambda a, b: a < b,
    ca.OP_LE: lambda a, b: a <= b,
    ca.OP_EQ: lambda a, b: a == b,
    ca.OP_NE: lambda a, b: a != b,
    ca.OP_NOT: ca.logic_not,
    ca.OP_AND: ca.logic_and,
    ca.OP_OR: ca.logic_or,
    ca.OP_IF_ELSE_ZERO: lambda a, b: ca.if_else(a, b, ca.SX(0)),
}
UNARY = {op for op, text in _C_TEXT.items() if "{1}" not in text}


def c_number(value: float) -> str:
    """Shortest C literal of a finite double that reads back to the same bits."""
    if not isfinite(value):
        raise DloError(f"the generated solver would contain the constant {value}")
    text = repr(float(value))
    return text if any(mark in text for mark in ".e") else text + ".0"


@dataclass(frozen=True)
class Node:
    """One value of a program: an operation on other nodes, a constant or an input.

    `op` is a CasADi operation; for OP_CONST `value` holds the number, for OP_INPUT
    `(which input, which element)` is in `args`.
    """

    op: int
    args: tuple[int, ...] = ()
    value: float = 0.0


@dataclass
class Program:
    """A directed graph of scalar operations in order of evaluation; equal nodes are shared.

    Parameters
    ----------
    nodes : list of Node
    outputs : dict
        (which output, which element) -> node.
    """

    nodes: list[Node] = field(default_factory=list)
    outputs: dict[tuple[int, int], int] = field(default_factory=dict)

    @classmethod
    def of(cls, function: ca.Function) -> Program:
        """Read the instructions of an SX function."""
        program = cls()
        known: dict[Node, int] = {}
        work: dict[int, int] = {}

        def add(node: Node) -> int:
            if node not in known:
                known[node] = len(program.nodes)
                program.nodes.append(node)
            return known[node]

        for k in range(function.n_instructions()):
            op = function.instruction_id(k)
            source, target = function.instruction_input(k), function.instruction_output(k)
            if op == ca.OP_OUTPUT:
                program.outputs[target[0], target[1]] = work[source[0]]
            elif op == ca.OP_CONST:
                work[target[0]] = add(Node(op, value=function.instruction_constant(k)))
            elif op == ca.OP_INPUT:
                work[target[0]] = add(Node(op, (source[0], source[1])))
            elif op == ca.OP_ASSIGN:
                work[target[0]] = work[source[0]]
            elif op in _C_TEXT:
                used = source[:1] if op in UNARY else source
                work[target[0]] = add(Node(op, tuple(work[i] for i in used)))
            else:
                raise DloError(f"CasADi's operation {op} has no C text in the generated solver")
        return program

    def operands(self, i: int) -> tuple[int, ...]:
        """Nodes that node i is computed from."""
        node = self.nodes[i]
        return () if node.op in (ca.OP_CONST, ca.OP_INPUT) else node.args

    def reached(self, roots: Sequence[int]) -> list[int]:
        """Nodes that the roots are computed from, themselves included, in order."""
        seen: set[int] = set()
        stack = list(roots)
        while stack:
            i = stack.pop()
            if i not in seen:
                seen.add(i)
                stack.extend(self.operands(i))
        return sorted(seen)

    def to_c(self, inputs: Mapping[tuple[int, int], str], indent: str) -> tuple[list[str], dict]:
        """C statements that compute all outputs.

        Parameters
        ----------
        inputs : dict
            (which input, which element) -> C expression.

        Returns
        -------
        list of str, dict
            The statements, and (which output, which element) -> C expression.
        """
        names: dict[int, str] = {}
        lines: list[str] = []
        for i in self.reached(list(self.outputs.values())):
            node = self.nodes[i]
            if node.op == ca.OP_CONST:
                number = c_number(node.value)
                names[i] = f"({number})" if number.startswith("-") else number
            elif node.op == ca.OP_INPUT:
                names[i] = inputs[node.args[0], node.args[1]]
            else:
                names[i] = f"t{len(lines)}"
                op, operands = node.op, [names[k] for k in node.args]
                divisor = self.nodes[node.args[-1]]
                if op == ca.OP_DIV and divisor.op == ca.OP_CONST and divisor.value != 0.0:
                    op, operands[1] = ca.OP_MUL, f"({c_number(1.0 / divisor.value)})"
                text = _C_TEXT[op].format(*operands)
                lines.append(f"{indent}const double {names[i]} = {text};")
        return lines, {place: names[i] for place, i in self.outputs.items()}


def on_symbols(op: int, operands: Sequence[ca.SX]) -> ca.SX:
    """Apply an operation to symbols."""
    return _ON_SYMBOLS[op](*operands)
