"""C text of the kernels: one function per shape of slot, a table of numbers for each."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import casadi as ca
import numpy as np

from dlo_casadi.codegen.program import UNARY, Program, c_number, on_symbols
from dlo_casadi.codegen.split import Slot

# Numbers that differ by less come from differences of the same mesh.
_ROUNDING = 1e-14
_HEAD = """\
/* {n} of {total} slots, e.g. slot {first}; derivatives of {size} terms. */
static double kernel_{k}(point_t *q, int j{row})
{{
    const double *const x = q->x + j;
"""


@dataclass(frozen=True)
class Kernel:
    """L_j as a function of symbols, for all slots of one key.

    Parameters
    ----------
    x : (2,), lam : (2,), numbers : (k,)
    value : scalar
    """

    x: ca.SX
    lam: ca.SX
    numbers: ca.SX
    value: ca.SX


def kernel_of(key: str, n_numbers: int) -> Kernel:
    """Rebuild L_j of a slot from its key, with symbols for the numbers."""
    x, lam = ca.SX.sym("x", 2), ca.SX.sym("lam", 2)
    numbers = ca.SX.sym("c", n_numbers)
    used = 0
    total = ca.SX(0)

    def take() -> ca.SX:
        nonlocal used
        used += 1
        return numbers[used - 1]

    for term in key.split("|") if key else []:
        multipliers, text = term.split(":")
        factor = ca.SX(0)
        for k in map(int, multipliers.split(",")):
            factor += take() * (lam[k] if k >= 0 else 1)
        stack: list[ca.SX] = []
        for token in text.split(" "):
            if token in ("a", "b"):
                stack.append(x[token == "b"])
            elif token in ("u", "v"):
                stack.append(lam[token == "v"])
            elif token == "#":
                stack.append(take())
            else:
                op = int(token[1:])
                n = 1 if op in UNARY else 2
                operands = stack[-n:]
                del stack[-n:]
                stack.append(on_symbols(op, operands))
        total += factor * stack.pop()
    return Kernel(x, lam, numbers, total)


@dataclass(frozen=True)
class Group:
    """Slots that share one kernel.

    Parameters
    ----------
    key : str
    members : tuple of int
        Slots, ascending.
    columns : tuple of int
        Which of a slot's numbers form the row of the table; equal columns are stored once.
    source : tuple of (str, float)
        Of each number: ("column", which) or ("value", number).
    """

    key: str
    members: tuple[int, ...]
    columns: tuple[int, ...]
    source: tuple[tuple[str, float], ...]

    @classmethod
    def of(cls, key: str, members: Sequence[int], slots: Sequence[Slot], inline: bool) -> Group:
        """Sort a key's numbers into those that are the same everywhere and columns."""
        table = np.array([slots[j].numbers for j in members])
        columns: list[int] = []
        source: list[tuple[str, float]] = []
        seen: dict[bytes, int] = {}
        for i in range(table.shape[1]):
            column = table[:, i].tobytes()
            if inline and np.allclose(table[:, i], table[0, i], rtol=_ROUNDING, atol=0.0):
                source.append(("value", float(table[0, i])))
                continue
            if column not in seen:
                seen[column] = len(columns)
                columns.append(i)
            source.append(("column", float(seen[column])))
        return cls(key, tuple(members), tuple(columns), tuple(source))

    def rows(self, slots: Sequence[Slot]) -> list[list[float]]:
        """Rows of the table, one per member."""
        return [[slots[j].numbers[i] for i in self.columns] for j in self.members]

    @cached_property
    def runs(self) -> list[tuple[int, int, int]]:
        """Contiguous members: (first slot, one past the last, row of the first)."""
        out: list[tuple[int, int, int]] = []
        for row, j in enumerate(self.members):
            if out and out[-1][1] == j:
                out[-1] = (out[-1][0], j + 1, out[-1][2])
            else:
                out.append((j, j + 1, row))
        return out


def _function(group: Group) -> ca.Function:
    """(x, lam, columns) -> L_j, its gradient (4,) and Hessian (4, 4) by (x_j, x_j+1, lam)."""
    kernel = kernel_of(group.key, len(group.source))
    columns = ca.SX.sym("c", len(group.columns))
    numbers = [columns[int(v)] if kind == "column" else ca.SX(v) for kind, v in group.source]
    (value,) = ca.substitute([kernel.value], [kernel.numbers], [ca.vertcat(*numbers)])
    unknowns = ca.vertcat(kernel.x, kernel.lam)
    hessian, gradient = ca.hessian(value, unknowns)
    outputs = ca.cse([value, gradient, ca.triu(hessian)])
    return ca.Function("kernel", [kernel.x, kernel.lam, columns], outputs)


def _assignments(
    names: dict[tuple[int, int], str], function: ca.Function, elastic: bool
) -> list[str]:
    """Statements that add a kernel's derivatives to the point."""
    gradient, hessian = function.sparsity_out(1), function.sparsity_out(2)
    found: dict[tuple[str | int, ...], str] = {}
    for (which, element), text in names.items():
        if which == 1:
            found["g", gradient.row()[element]] = text
        elif which == 2:
            found["h", hessian.row()[element], hessian.get_col()[element]] = text
    targets: list[tuple[str, tuple[str | int, ...]]] = [
        ("q->gradient[j] +=", ("g", 0)),
        ("q->gradient[j + 1] =", ("g", 1)),
        ("q->diagonal[j] +=", ("h", 0, 0)),
        ("q->diagonal[j + 1] =", ("h", 1, 1)),
        ("q->off[j] =", ("h", 0, 1)),
        ("q->jx[j] +=", ("h", 0, 2)),
        ("q->jy[j] +=", ("h", 0, 3)),
        ("q->jx[j + 1] =", ("h", 1, 2)),
        ("q->jy[j + 1] =", ("h", 1, 3)),
        ("q->bx[j] =", ("h", 1, 2)),
        ("q->by[j] =", ("h", 1, 3)),
        ("q->ax[j] =", ("g", 2)),
        ("q->ay[j] =", ("g", 3)),
    ]
    if elastic:
        targets += [
            ("q->kx[j] =", ("h", 2, 2)),
            ("q->kxy[j] =", ("h", 2, 3)),
            ("q->ky[j] =", ("h", 3, 3)),
        ]
    lines = []
    for target, place in targets:
        if found.get(place, "0.0") != "0.0":
            lines.append(f"    {target} {found[place]};")
        elif target.endswith(" ="):
            lines.append(f"    {target} 0.0;")
    return lines


def groups_of(slots: Sequence[Slot], inline: bool = True) -> list[Group]:
    """Slots by shape, in order of first appearance."""
    members: dict[str, list[int]] = {}
    for j, slot in enumerate(slots):
        members.setdefault(slot.key, []).append(j)
    return [Group.of(key, found, slots, inline) for key, found in members.items()]


def table_of(groups: Sequence[Group], slots: Sequence[Slot]) -> list[float]:
    """All tables behind one another: what kernels read as `table`."""
    return [number for group in groups for row in group.rows(slots) for number in row]


def kernels_to_c(groups: Sequence[Group], n_slots: int, elastic: bool) -> tuple[str, str]:
    """Kernel functions, and the loops that call them for all slots."""
    functions, loops, offset = [], [], 0
    for k, group in enumerate(groups):
        function = _function(group)
        program = Program.of(function)
        width = len(group.columns)
        inputs = {(0, i): f"x[{i}]" for i in range(2)}
        inputs |= {(1, i): f"q->lam[{i}]" for i in range(2)}
        inputs |= {(2, i): f"row[{i}]" for i in range(width)}
        lines, names = program.to_c(inputs, "    ")
        body = "\n".join([*lines, *_assignments(names, function, elastic)])
        head = _HEAD.format(
            k=k,
            n=len(group.members),
            total=n_slots,
            first=group.members[0],
            size=group.key.count("|") + 1 if group.key else 0,
            row=", const double *row" if width else "",
        )
        if not re.search(r"(?<![\w>])x\[", body):
            head = head[: head.index("    const double *const x")]
        value = names.get((0, 0), "0.0")
        functions.append(f"{head}{body}\n    return {value};\n}}\n")
        for first, last, row in group.runs:
            place = offset + row * width
            argument = f", table + {place} + (j - {first}) * {width}" if width else ""
            text = (
                f"    for (j = {first}; j < {last}; ++j)\n"
                f"        total += kernel_{k}(q, j{argument});"
            )
            loops.append((first, text))
        offset += width * len(group.members)
    # Ascending: a slot sets what it shares with the next one, which adds to it.
    return "\n".join(functions), "\n".join(text for _, text in sorted(loops))


def table_to_c(numbers: Sequence[float]) -> str:
    """Initialiser of the table; one zero where there is nothing to store."""
    texts = [c_number(number) for number in numbers] or ["0.0"]
    rows = [", ".join(texts[i : i + 4]) for i in range(0, len(texts), 4)]
    return ",\n    ".join(rows)
