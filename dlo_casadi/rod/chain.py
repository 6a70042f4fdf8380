"""A cable cut into elements, and the basis of its rest curvature."""

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from scipy.interpolate import BSpline

from dlo_casadi.arrays import FloatArray, IntArray
from dlo_casadi.errors import DloError
from dlo_casadi.rod.element import Element, Layout
from dlo_casadi.rod.elements import Arc, Helix, Link, Quadratic, QuadraticHelix
from dlo_casadi.rod.node import Frame, Heading, Node

ELEMENTS: dict[str, Element] = {element.name: element for element in (Quadratic(), Arc(), Link())}
ELEMENTS_IN_SPACE: dict[str, Element] = {kind.name: kind for kind in (QuadraticHelix(), Helix())}
_BY_NODE = {Heading: ELEMENTS, Frame: ELEMENTS_IN_SPACE}
DEFAULT_ELEMENT = "quadratic"


@dataclass(frozen=True)
class Chain:
    """A cable cut into n equal elements.

    Parameters
    ----------
    length : float [m]
        Declared length along the cable.
    n : int
        Number of elements, >= 2.
    element : str
        A name of ELEMENTS, or of ELEMENTS_IN_SPACE.
    start_clamped, end_clamped : bool
    node : type of Node
        State of its nodes: `Heading` in a plane, `Frame` in space.
    """

    length: float
    n: int
    element: str = DEFAULT_ELEMENT
    start_clamped: bool = False
    end_clamped: bool = False
    node: type[Node] = Heading

    def __post_init__(self) -> None:
        if self.n < 2:
            raise DloError(f"a chain needs at least 2 elements, got n = {self.n}")
        known, where = tuple(_BY_NODE[self.node]), self.node.where
        if self.element not in known:
            raise DloError(f"element {self.element!r} is not known {where}; use one of {known}")

    @property
    def kind(self) -> Element:
        """The kind of its elements."""
        return _BY_NODE[self.node][self.element]

    @property
    def h(self) -> float:
        """Length of one element [m]."""
        return self.length / self.n

    @cached_property
    def layout(self) -> Layout:
        """Nodes, segments and stations."""
        return self.kind.layout(self.length, self.n, (self.start_clamped, self.end_clamped))

    @property
    def n_nodes(self) -> int:
        """Number of nodes."""
        return len(self.layout.nodes)

    @property
    def n_segments(self) -> int:
        """Number of segments: the nodes, or one less."""
        return len(self.layout.segments)

    @property
    def places(self) -> FloatArray:
        """Arc lengths (n_nodes,) [m] of the nodes."""
        return self.layout.nodes

    @property
    def cells(self) -> FloatArray:
        """Bending cells (n_cells, 2) [m]: where each discrete strain acts, from s0 to s1."""
        return self.layout.cells

    @property
    def n_cells(self) -> int:
        """Number of bending cells."""
        return len(self.cells)

    @property
    def n_rests(self) -> int:
        """Number of rest strains; they are ordered by component, then by cell."""
        return self.n_cells * len(self.kind.node.strains)

    @cached_property
    def rest_stencils(self) -> tuple[IntArray, FloatArray]:
        """Cells (n_segments, 3) and weights that determine the rest curvature inside a segment.

        The weights are (n_segments, 3, 3). From means m over a cell and its neighbours, |x| <= 1/2,

            kappa_0(x) = m_e + a x + c (x^2 - 1/12),
            a = (m_(e+1) - m_(e-1)) / 2,   c = (m_(e+1) - 2 m_e + m_(e-1)) / 2

        which is exact for parabolas on equal cells. The first and last cell use their neighbour's
        parabola. Weights are zero if a segment has no cell.
        """
        count = self.n_cells
        cells = np.zeros((self.n_segments, 3), dtype=np.intp)
        weights = np.zeros((self.n_segments, 3, 3))
        for e, j in enumerate(self.layout.bends):
            if count < 3:
                cells[j] = [e, 0, count - 1]
                weights[j, :2] = [[1.0, 0.0, 0.0], [0.0, -1.0, 1.0]]
                continue
            middle = min(max(e, 1), count - 2)
            cells[j] = [middle - 1, middle, middle + 1]
            weights[j, 0, e - middle + 1] = 1.0
            weights[j, 2] = [0.5, -1.0, 0.5]
            weights[j, 1] = [-0.5, 0.0, 0.5] + 2 * (e - middle) * weights[j, 2]
        return cells, weights

    def rest_inside(self, means: FloatArray) -> FloatArray:
        """Rest strains inside (..., n_segments, 3 strains, q), from means (..., n_rests, q)."""
        cells, weights = self.rest_stencils
        *rows, size, q = means.shape
        strains = size // self.n_cells
        by_strain = means.reshape((*rows, strains, self.n_cells, q))
        inside = np.moveaxis(weights @ by_strain[..., cells, :], -4, -3)
        return inside.reshape((*rows, self.n_segments, 3 * strains, q))

    def by_strain(self, means: FloatArray) -> list[FloatArray]:
        """Means (..., n_rests, q) split into parts (..., n_cells, q), one for each strain."""
        count = means.shape[-2] // len(self.kind.node.strains)
        return [means[..., k : k + count, :] for k in range(0, means.shape[-2], count)]

    def curvatures(self, means: FloatArray) -> FloatArray:
        """Curvatures (..., axes, n_cells) among strains (..., n_rests) of the cells."""
        node = self.kind.node
        by_strain = means.reshape((*means.shape[:-1], len(node.strains), self.n_cells))
        return by_strain[..., -len(node.curvatures) :, :]


_DEGREE = 3


@dataclass(frozen=True)
class RestCurvature:
    """kappa_0(s) = sum_k c_k B_k(s), clamped uniform B-splines on [0, L].

    They are cubic; with fewer than four coefficients a parabola, a line or a constant.

    Parameters
    ----------
    length : float [m]
    n_coefficients : int
        0 = straight at rest.
    """

    length: float
    n_coefficients: int

    @property
    def _spline(self) -> BSpline:
        degree = min(_DEGREE, self.n_coefficients - 1)
        inner = np.linspace(0.0, self.length, self.n_coefficients - degree + 1)
        knots = np.concatenate([[0.0] * degree, inner, [self.length] * degree])
        return BSpline(knots, np.eye(self.n_coefficients), degree)

    def basis(self, s: FloatArray) -> FloatArray:
        """Values (len(s), n_coefficients) of the basis functions at arc lengths s [m]."""
        if self.n_coefficients == 0:
            return np.zeros((len(s), 0))
        return self._spline(s)

    def cell_means(self, cells: FloatArray) -> FloatArray:
        """Means (n_cells, n_coefficients) of the basis functions over cells (n_cells, 2) [m].

        The mean, unlike the value in the middle, makes int (kappa - kappa_0)^2 ds exact up to a
        constant for a curve of constant curvature per cell.
        """
        if self.n_coefficients == 0:
            return np.zeros((len(cells), 0))
        primitive = self._spline.antiderivative()
        return (primitive(cells[:, 1]) - primitive(cells[:, 0])) / np.diff(cells, axis=1)

    @property
    def roughness(self) -> FloatArray:
        """Second differences (n_coefficients - 2, n_coefficients) of the coefficients."""
        return np.diff(np.eye(self.n_coefficients), n=2, axis=0)


def with_cells_beyond(inside: FloatArray) -> FloatArray:
    """Rest strains (..., n + 2, 3 strains, q) with those of a cell before and one after n cells.

    Before and after the declared length they stay as at its ends. `inside`: (..., n, 3 strains, q),
    see `Chain.rest_inside`.
    """
    beyond = []
    for k, side in ((0, -1), (-1, 1)):
        own = inside[..., [k], :, :]
        still, (mean, a, c) = np.zeros_like(own), (own[..., i::3, :] for i in range(3))
        still[..., ::3, :] = mean + side * a / 2 + c / 6
        beyond.append(still)
    return np.concatenate([beyond[0], inside, beyond[1]], axis=-3)


def moved_rest(inside: Any, x: Any, w: Any) -> tuple[Any, Any, Any]:
    """Rest strains inside an element of w times an even one's length, with its middle at x in that.

    m + a x + c (x^2 - 1/12) of the even element, |x| <= 1/2, is the same of y at x + w y.
    """
    mean, a, c = inside[0], inside[1], inside[2]
    return mean + a * x + c * (x * x + (w * w - 1) / 12), w * (a + 2 * c * x), c * w * w
