"""A model's Lagrangian as a sum of terms of neighbouring headings.

In absolute headings the Lagrangian of a cable under dead loads is

    L(x, lam) = constant + sum_j L_j(x_j, x_(j+1), lam)

with x the headings (of a chain of links: clamp headings included). The split reads it off the
model's own expression: sums are opened, factors that are numbers or multipliers are moved into
coefficients, and what is left, the terms, goes to the first heading it depends on. Terms that
differ in numbers only share one kernel and bring their numbers as a row of a table: the size
of the code does not depend on the number of elements, and no effect is known by name.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from dlo_casadi.codegen.program import Program, on_symbols
from dlo_casadi.errors import DloError
from dlo_casadi.model import DEVIATIONS, CableModel

FloatArray = NDArray[np.floating]

# Inputs of the flattened Lagrangian, by position.
_X, _LAM, _REST, _START = range(4)
_NOWHERE = -1  # where terms of no heading are filed


@dataclass(frozen=True)
class Slot:
    """L_j(x_j, x_(j+1), lam) of one place j: a shape and its numbers.

    Parameters
    ----------
    key : str
        Terms with the numbers left out; slots of one key share a kernel.
    numbers : (k,)
        In the order in which the key names them.
    """

    key: str
    numbers: tuple[float, ...]


class Split:
    """A model with its parameters, cut into slots.

    Parameters
    ----------
    model : CableModel
    p : (n_parameters,)
        In the order of `model.names`, SI units.
    rest : (n_cells,) [1/m]
        Rest curvature of the bending cells.
    """

    def __init__(self, model: CableModel, p: FloatArray, rest: FloatArray) -> None:
        self.model = model
        self.p = np.asarray(p, float).ravel()
        self.rest = np.asarray(rest, float).ravel()
        if len(self.p) != len(model.parameters) or len(self.rest) != model.chain.n_cells:
            raise DloError(
                f"p has {len(self.p)} and rest {len(self.rest)} entries; the model has "
                f"{len(model.parameters)} parameters and {model.chain.n_cells} cells"
            )
        if model.shape_dependent_loads:
            names = " and ".join(model.shape_dependent_loads)
            raise DloError(
                f"no solver can be generated for a cable with {names}: the force depends on the "
                "shape, and the solver's elements know their neighbours only.\n"
                "  Try: dlo predict, or dlo_casadi.predict, which know it."
            )
        links = model.element == "link"
        self.first = int(links and model.start == "clamped")
        self.n_phi = model.chain.n_headings
        self.n_x = self.first + self.n_phi + int(links and model.end == "clamped")

    def _arguments(self, x: ca.SX, lam: ca.SX, rest: ca.SX, start: ca.SX) -> list[ca.SX | ca.DM]:
        """Arguments of the model's functions: parameters as numbers, clamps of links from x."""
        model = self.model
        phi = x[self.first : self.first + self.n_phi]
        position = ca.SX.zeros(0) if model.end == "free" else lam
        multipliers = ca.vertcat(position, ca.SX.zeros(2))[: model.n_conditions]
        declared = ca.vertcat(x[0], x[self.n_x - 1]) - ca.DM(self.offsets[4:])
        pose = ca.vertcat(start, ca.SX.zeros(2), declared, ca.SX.zeros(3))
        return [phi, multipliers, ca.DM(self.p), rest, pose, ca.DM.zeros(len(DEVIATIONS))]

    @cached_property
    def _program(self) -> Program:
        model = self.model
        x, lam = ca.SX.sym("x", self.n_x), ca.SX.sym("lam", 2)
        rest, start = ca.SX.sym("rest", model.chain.n_cells), ca.SX.sym("start", 2)
        lagrangian, curve = model._lagrangian
        whole = ca.Function("lagrangian", model._arguments, [lagrangian, curve.nodes[model.n, :]])
        value, end = whole(*self._arguments(x, lam, rest, start))
        if model.end == "free":
            # lam is zero there; its derivative is the way from element to element all the same.
            value += ca.dot(lam, end.T - start)
        return Program.of(ca.Function("flat", [x, lam, rest, start], [value]))

    @cached_property
    def _support(self) -> list[tuple[int, int]]:
        """First and last heading that each node depends on; (n_x, -1) for none."""
        out: list[tuple[int, int]] = []
        for i, node in enumerate(self._program.nodes):
            if node.op == ca.OP_INPUT and node.args[0] == _X:
                out.append((node.args[1], node.args[1]))
                continue
            parts = [out[k] for k in self._program.operands(i)]
            low = min((part[0] for part in parts), default=self.n_x)
            out.append((low, max((part[1] for part in parts), default=-1)))
        return out

    @cached_property
    def _known(self) -> list[float | None]:
        """Value of each node that depends on numbers and the rest curvature only, else None."""
        out: list[float | None] = []
        for i, node in enumerate(self._program.nodes):
            if node.op == ca.OP_CONST:
                out.append(node.value)
            elif node.op == ca.OP_INPUT:
                out.append(float(self.rest[node.args[1]]) if node.args[0] == _REST else None)
            else:
                parts = [out[k] for k in self._program.operands(i)]
                given = [ca.SX(part) for part in parts if part is not None]
                known = len(given) == len(parts)
                out.append(float(on_symbols(node.op, given)) if known else None)
        return out

    def _number(self, i: int) -> float | None:
        """Value of a node that depends on nothing, else None."""
        node = self._program.nodes[i]
        return node.value if node.op == ca.OP_CONST else None

    def _multiplier(self, i: int) -> int:
        node = self._program.nodes[i]
        return node.args[1] if node.op == ca.OP_INPUT and node.args[0] == _LAM else -1

    @cached_property
    def _terms(self) -> dict[int, dict[tuple[int, int], float]]:
        """Opened sum: slot -> {(term, multiplier): coefficient}."""
        program, slots = self._program, dict[int, dict[tuple[int, int], float]]()
        stack: list[tuple[float, int, int]] = [(1.0, -1, program.outputs[0, 0])]
        while stack:
            c, lam, i = stack.pop()
            node = program.nodes[i]
            if node.op in (ca.OP_ADD, ca.OP_SUB):
                stack += [(c if node.op == ca.OP_ADD else -c, lam, node.args[1])]
                stack += [(c, lam, node.args[0])]
            elif node.op == ca.OP_NEG:
                stack.append((-c, lam, node.args[0]))
            elif node.op == ca.OP_TWICE:
                stack.append((2 * c, lam, node.args[0]))
            elif node.op == ca.OP_DIV and self._number(node.args[1]) is not None:
                stack.append((c / (self._number(node.args[1]) or 1.0), lam, node.args[0]))
            elif node.op == ca.OP_MUL and (opened := self._open(c, lam, *node.args)):
                stack.append(opened)
            else:
                self._keep(slots, c, lam, i)
        return slots

    def _open(self, c: float, lam: int, a: int, b: int) -> tuple[float, int, int] | None:
        """Move a factor that is a number or a multiplier into the coefficient."""
        for one, other in ((a, b), (b, a)):
            number = self._number(one)
            if number is not None:
                return c * number, lam, other
            if lam < 0 and self._multiplier(one) >= 0:
                return c, self._multiplier(one), other
        return None

    def _keep(
        self, slots: dict[int, dict[tuple[int, int], float]], c: float, lam: int, i: int
    ) -> None:
        """File one term under the first heading it depends on."""
        low, high = self._support[i]
        if high - low > 1:
            raise DloError(
                "the energy couples headings that are not neighbours: an effect of this model "
                "cannot be generated"
            )
        terms = slots.setdefault(low if high >= 0 else _NOWHERE, {})
        terms[i, lam] = terms.get((i, lam), 0.0) + c

    @cached_property
    def constant(self) -> tuple[float, float, float]:
        """Energy that no heading changes: (value [J], slopes by the start's x and y [N])."""
        out = [0.0, 0.0, 0.0]
        for (i, lam), coefficient in self._terms.get(_NOWHERE, {}).items():
            node = self._program.nodes[i]
            if lam >= 0 or self._multiplier(i) >= 0:
                continue  # work of the held end, see the end condition in the solver
            if node.op == ca.OP_CONST:
                out[0] += coefficient * node.value
            elif node.op == ca.OP_INPUT and node.args[0] == _START:
                out[1 + node.args[1]] += coefficient
            else:
                raise DloError("the energy is not linear in the place of the start fixture")
        return out[0], out[1], out[2]

    @cached_property
    def offsets(self) -> FloatArray:
        """Held minus declared ends (6,): end and headings are where boundary effects put them."""
        ends = ca.SX.sym("ends", 6)
        where, _ = self.model.held(self.p, ends, 0)
        function = ca.Function("held", [ends], [where, ca.densify(ca.jacobian(where, ends))])
        offset, slope = function(0)
        if not np.array_equal(np.array(slope), np.eye(6)) or np.any(np.array(offset)[:2]):
            raise DloError("a boundary effect does more than shift the end or turn the clamps")
        return np.array(offset).ravel()

    @cached_property
    def inverse_widths(self) -> FloatArray:
        """Curvature per bend of each cell (n_x - 1,) [1/m]: kappa_j = w_j (x_(j+1) - x_j)."""
        model = self.model
        x = ca.SX.sym("x", self.n_x)
        phi, _, p, _, pose, deviation = self._arguments(
            x, ca.SX.zeros(2), ca.SX.zeros(model.chain.n_cells), ca.SX.zeros(2)
        )
        strain = model.strain(phi, pose, deviation, p)
        return np.array(ca.evalf(ca.jacobian(strain, x)[:, 1:])).diagonal().copy()

    @cached_property
    def length(self) -> float:
        """Length of the unloaded cable [m]."""
        return float(self.model.held(self.p, 0, 0)[1])

    @cached_property
    def slots(self) -> list[Slot]:
        """Slots 0 .. n_x - 1; the last one sees one heading only."""
        return [self._slot(j, self._terms.get(j, {})) for j in range(self.n_x)]

    def _slot(self, j: int, terms: dict[tuple[int, int], float]) -> Slot:
        by_node: dict[int, dict[int, float]] = {}
        for (i, lam), coefficient in terms.items():
            by_node.setdefault(i, {})[lam] = coefficient
        texts = []
        for i, factors in by_node.items():
            used = sorted(factors)
            numbers = [factors[lam] for lam in used]
            text = self._text(i, j, numbers)
            texts.append((f"{','.join(map(str, used))}:{text}", numbers))
        texts.sort(key=lambda pair: pair[0])  # stable: equal terms stay in the model's order
        return Slot("|".join(text for text, _ in texts), tuple(v for _, n in texts for v in n))

    def _text(self, i: int, j: int, numbers: list[float]) -> str:
        """Postfix text of a term; numbers are replaced by '#' and appended."""
        node = self._program.nodes[i]
        known = self._known[i]
        if known is not None:
            numbers.append(known)
            return "#"
        if node.op == ca.OP_INPUT:
            which, element = node.args
            if which == _X:
                return "b" if element > j else "a"
            if which == _LAM:
                return "uv"[element]
            raise DloError("the shape would depend on the place of the start fixture")
        return " ".join([*(self._text(k, j, numbers) for k in node.args), f"@{node.op}"])
