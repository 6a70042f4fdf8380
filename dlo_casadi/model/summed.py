"""Sums of many equal functions of a few unknowns each, with sparse derivatives of both orders.

    G(u) = sum_k B_k f(A_k u)

A_k picks what an element depends on, B_k adds its values up. CasADi differentiates the one SX
function f; the matrices place its derivatives:

    dG/du = sum_k B_k f' A_k,     d^2(w . G)/du^2 = sum_k A_k^T (w_k . f)'' A_k,   w_k = B_k^T w

CasADi alone finds them by one sweep for each colour of the sparsity, which takes three times as
long at 24 elements, and more in larger problems. Graphs that contain such a sum get its derivatives
by the chain rule from these.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import casadi as ca

from dlo_casadi.model.stacked import simplified


@dataclass(frozen=True, eq=False)
class Element:
    """An SX function (z (a,), fixed) -> (values (c,)), with its derivatives by z."""

    function: ca.Function

    @cached_property
    def _symbols(self) -> tuple[list[ca.SX], ca.SX, ca.SX]:
        """Its arguments, its values, and weights of these."""
        arguments = [ca.SX.sym("z", self.function.numel_in(i)) for i in range(2)]
        values = ca.SX(self.function(*arguments))
        return arguments, values, ca.SX.sym("w", values.numel())

    @cached_property
    def slope(self) -> tuple[ca.Function, ca.Sparsity]:
        """(z, fixed) -> nonzeros of its Jacobian, and their sparsity (c, a)."""
        arguments, values, _ = self._symbols
        found = ca.jacobian(values, arguments[0])
        return simplified(ca.Function("slope", arguments, [found.nz[:]])), found.sparsity()

    @cached_property
    def gradient(self) -> ca.Function:
        """(z, fixed, w) -> gradient (a,) of w . f."""
        arguments, values, w = self._symbols
        found = ca.gradient(ca.dot(w, values), arguments[0])
        return simplified(ca.Function("gradient", [*arguments, w], [ca.densify(found)]))

    @cached_property
    def bend(self) -> tuple[ca.Function, ca.Sparsity]:
        """(z, fixed, w) -> nonzeros of the Hessian of w . f, and of the Jacobian.

        Also the sparsity (a, a) of the former. Not `simplified`: in space that takes 1 to 3 s and
        leaves out 4 % to 28 % of the operations, which pays after some 300 Hessians of 40 elements.
        """
        arguments, values, w = self._symbols
        found, _ = ca.hessian(ca.dot(w, values), arguments[0])
        outputs = [found.nz[:], ca.jacobian(values, arguments[0]).nz[:]]
        return ca.Function("bend", [*arguments, w], outputs), found.sparsity()


@dataclass(frozen=True, eq=False)
class Elements:
    """Equal elements.

    `takes` (count a, size of u) and `adds` (rows of G, count c) stack A_k and B_k; `fixed`
    (numbers, count).
    """

    element: Element
    takes: ca.DM
    fixed: ca.DM
    adds: ca.DM

    @property
    def _count(self) -> int:
        return int(self.fixed.shape[1])

    def _given(self, u: Any) -> list[Any]:
        return [ca.reshape(self.takes @ u, -1, self._count), self.fixed]

    def _weights(self, w: Any) -> Any:
        return ca.reshape(self.adds.T @ w, -1, self._count)

    def values(self, u: Any) -> Any:
        """Their part of G (rows,)."""
        return self.adds @ ca.vec(self.element.function.map(self._count)(*self._given(u)))

    def slope(self, u: Any) -> Any:
        """Their part of the Jacobian (rows, size of u)."""
        return self._slope(self.element.slope[0].map(self._count)(*self._given(u)))

    def _slope(self, nonzeros: Any) -> Any:
        return self.adds @ self._placed(nonzeros, self.element.slope[1]) @ self.takes

    def gradient(self, u: Any, w: Any) -> Any:
        """Their part of the gradient of w . G (size of u,)."""
        found = self.element.gradient.map(self._count)(*self._given(u), self._weights(w))
        return self.takes.T @ ca.vec(found)

    def bend(self, u: Any, w: Any) -> tuple[Any, Any]:
        """Their parts of the Hessian of w . G (size of u, size of u), and of the Jacobian."""
        function, sparsity = self.element.bend
        bends, slopes = function.map(self._count)(*self._given(u), self._weights(w))
        return self.takes.T @ self._placed(bends, sparsity) @ self.takes, self._slope(slopes)

    def _placed(self, nonzeros: Any, sparsity: ca.Sparsity) -> Any:
        """Block-diagonal matrix of the elements' nonzeros, one column each."""
        return ca.MX(ca.diagcat(*[sparsity] * self._count), ca.vec(nonzeros))


def summed(name: str, sizes: dict[str, int], parts: Sequence[Elements]) -> ca.Function:
    """The sum as a function of arguments of these sizes, which are stacked to u."""
    rows = parts[0].adds.shape[0]
    arguments: list[Any] = [ca.MX.sym(key, size) for key, size in sizes.items()]
    u, seed, out = ca.vertcat(*arguments), ca.MX.sym("seed", rows), ca.MX.sym("out", rows)
    edges = [0]
    for size in sizes.values():
        edges.append(edges[-1] + size)
    values, gradient = (
        _total(part.values(u) for part in parts),
        _total(part.gradient(u, seed) for part in parts),
    )
    by_each = ca.horzsplit(_total(part.slope(u) for part in parts), edges)
    bends, slopes = (
        _total(each) for each in zip(*(part.bend(u, seed) for part in parts), strict=True)
    )
    gradients, backwards = [ca.MX.sym("gradient", size) for size in sizes.values()], []
    blocks, columns = ca.blocksplit(bends, edges, edges), ca.horzsplit(slopes, edges)
    for row, own in zip(blocks, columns, strict=True):
        backwards += [*row, ca.MX(own.shape[1], rows), own.T]
    # CasADi takes derivatives by these functions only, not by sweeps.
    given: dict[str, Any] = {"enable_forward": False, "enable_reverse": False}
    twice = ca.Function(f"jac_adj1_{name}", [*arguments, out, seed, *gradients], backwards)
    back = ca.Function(
        f"adj1_{name}",
        [*arguments, out, seed],
        ca.vertsplit(gradient, edges),
        {"custom_jacobian": twice, **given},
    )
    once = ca.Function(f"jac_{name}", [*arguments, out], by_each)
    options: dict[str, Any] = {
        "custom_jacobian": once,
        "enable_forward": False,
        "cache": {back.name(): back},
    }
    return ca.Function(name, arguments, [values], [*sizes], ["rows"], options)


def _total(parts: Iterable[Any]) -> Any:
    first, *others = parts
    return sum(others, start=first)
