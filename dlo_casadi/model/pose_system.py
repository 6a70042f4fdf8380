"""The equations of a pose for users' problems: block-banded derivatives by construction.

Forces on nodes, conditions and steps along the cable are sums over segments, see `summed`. A
segment depends on its two nodes and on the multipliers, so both derivatives are banded, with a
border.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import casadi as ca
import numpy as np

from dlo_casadi.arrays import FloatArray, IntArray
from dlo_casadi.model.cable_model import VIEWPOINT_SIZE, CableModel
from dlo_casadi.model.functions import Functions, functions_of
from dlo_casadi.model.lagrangian import MODELS
from dlo_casadi.model.summed import Element, Elements, summed
from dlo_casadi.model.whole_pose import Laid, PoseSymbols
from dlo_casadi.rod.chain import with_cells_beyond
from dlo_casadi.rod.ends import EndConditions

# Arguments that may vary, in the order in which they are stacked; the others are constant.
ALWAYS, NUMBERS = ("x", "lam", "pose"), ("p", "rest")


@dataclass(frozen=True)
class PoseRows:
    """Expressions of a pose: `balance` (increment, n_nodes) [N m], `conditions` (n_border,).

    `steps` (dimension, n) [m]: from each element boundary to the next; `ratios` (1, n): true over
    declared length of each element; `strains` (strains, n_cells) [1/m]; `energy` [J], that of
    the Lagrangian, which is equal if the conditions hold.
    """

    balance: Any
    conditions: Any
    steps: Any
    ratios: Any
    strains: Any
    energy: Any


def pose_rows(model: CableModel, s: PoseSymbols) -> PoseRows:
    """The equations at symbols (MX) of a cable without clips; deviations are zero."""
    b, count, layout = model.node.increment, model.chain.n_nodes, model.chain.layout
    varying = tuple(name for name in NUMBERS if not getattr(s, name).is_constant())
    call = _caller(model, s, varying)
    rows: Any = call("slopes")
    balance, own, by_segment = ca.vertsplit(
        rows, np.cumsum([0, b * count, model.n_border, model.n_border * model.chain.n_segments])
    )
    each: Any = ca.reshape(by_segment, model.n_border, -1)
    advancing, rigid = layout.advancing.tolist(), bool(model.end_pull) and not model.extensible
    if rigid:
        steps = each[model.end_pull, advancing]
        ends = s.pose[: EndConditions.size(model.node)]
        _, length = functions_of(model).terms.true_ends_and_length(s.p, ends, 0)
        ratios = ca.repmat(length / model.cable.length, 1, len(advancing))
    else:
        d = model.node.dimension
        curve = ca.reshape(call("curve"), d + 1, -1)[:, advancing]
        steps, ratios = curve[:d, :], curve[d:, :]
    if model.slides:
        places = Laid.of(model).places(model, s)
        ratios = ratios * ((places[-1] - places[0]) / model.chain.length)
    strains = ca.reshape(call("strains"), -1, model.chain.n_segments)[:, layout.bends.tolist()]
    conditions = own + ca.sum2(each)
    energy = call("energy")
    return PoseRows(ca.reshape(balance, b, count), conditions, steps, ratios, strains, energy)


def _caller(model: CableModel, s: PoseSymbols, varying: tuple[str, ...]) -> Callable[[str], Any]:
    """Name -> the rows of that name; numbers that are constant are part of the function."""
    known = [
        np.array(ca.evalf(getattr(s, name))).ravel() if name not in varying else np.zeros(0)
        for name in NUMBERS
    ]
    given = [getattr(s, name) for name in (*ALWAYS, *varying)]
    key = (model, varying, *(part.tobytes() for part in known))
    return lambda name: _system(name, *key)(*given)


@lru_cache(maxsize=MODELS)
def _system(
    name: str, model: CableModel, varying: tuple[str, ...], p: bytes, rest: bytes
) -> ca.Function:
    """A sum over segments, and ends, as a function of x, lam, pose and what varies."""
    sizes = {
        "x": model.chain.n_nodes * model.node.coordinates,
        "lam": model.n_border,
        "pose": model.n_pose,
        "p": len(model.names),
        "rest": model.chain.n_rests,
    }
    sizes = {key: size for key, size in sizes.items() if key in (*ALWAYS, *varying)}
    known = {"p": np.frombuffer(p), "rest": np.frombuffer(rest)}
    parts = _Parts(model, sizes, {k: x for k, x in known.items() if k not in varying})
    return summed(name, sizes, getattr(parts, name)())


class _Parts:
    """Elements of the sums: `sizes` of the arguments, and `known` numbers."""

    def __init__(
        self, model: CableModel, sizes: dict[str, int], known: dict[str, FloatArray]
    ) -> None:
        self.model, self.sizes, self.known = model, sizes, known
        self.b, self._edges = model.node.increment, np.cumsum([0, *sizes.values()]).tolist()

    def slopes(self) -> list[Elements]:
        """Forces on nodes, conditions of the ends, and what each segment adds to them."""
        model, b, k = self.model, self.b, self.model.n_border
        count, nodes = model.chain.n_segments, model.chain.n_nodes
        own, conditions = np.arange(count), b * nodes + np.arange(k)
        # A segment after the last node is possible; what it does to a next node is left out.
        both = b * np.stack([own, own + 1], axis=1)[..., None] + np.arange(b)
        both = np.where(both < b * nodes, both, -1).reshape((count, 2 * b))
        each = conditions + k * (1 + own[:, None])
        rows = b * nodes + k * (1 + count)
        ends = np.concatenate([np.arange(b), b * (nodes - 1) + np.arange(b), conditions])
        return [
            self._of_segments("segment_slope", _picked(np.hstack([both, each]), rows).T),
            self._of_ends(_picked(ends, rows).T),
        ]

    def energy(self) -> list[Elements]:
        """Energy [J] of segments and ends, and the work of the multipliers."""
        each = ca.DM.ones(1, self.model.chain.n_segments)
        return [
            self._of_segments("segment_shape", ca.sparsify(each), 1),
            self._of_ends(ca.DM.ones(1, 1), "end_shape", 1),
        ]

    def curve(self) -> list[Elements]:
        """Steps [m] and length ratios of the segments."""
        rows = self.model.node.dimension + 1
        return [
            self._of_segments("segment_curve", _every(rows * self.model.chain.n_segments), rows)
        ]

    def strains(self) -> list[Elements]:
        """Mean strains [1/m] of the segments' cells."""
        rows = len(self.model.node.strains) * self.model.chain.n_segments
        return [self._of_segments("segment_strain", _every(rows))]

    def _of_segments(self, name: str, adds: ca.DM, rows: int | None = None) -> Elements:
        chain, c = self.model.chain, self.model.node.coordinates
        own = np.arange(chain.n_segments)
        after = np.minimum(own + 1, chain.n_nodes - 1)
        nodes = (c * np.stack([own, after], axis=1)[..., None] + np.arange(c)).reshape((-1, 2 * c))
        inside = chain.rest_inside(np.eye(chain.n_rests)).reshape((-1, chain.n_rests))
        takes = {
            "x": _picked(nodes, self.sizes["x"]),
            "lam": self._shared("lam", len(own)),
            "p": self._shared("p", len(own)),
            "rest": ca.sparsify(ca.DM(inside)),
            "pose": self._shared("pose", len(own)),
        }
        places, cells = chain.layout.segments.T, 0
        known = self.known.copy()
        if self.model.slides:
            u = chain.places / chain.length
            places = np.array([u[:-1], u[1:], places[5]])
            every = with_cells_beyond(inside.reshape((len(own), -1, chain.n_rests)))
            every = every.reshape((-1, chain.n_rests))
            takes["rest"] = ca.sparsify(ca.DM(np.tile(every, (len(own), 1))))
            cells = len(own)
            if "rest" in known:
                known["rest"] = every @ known["rest"]
        elif "rest" in known:
            known["rest"] = (inside @ known["rest"]).reshape((len(own), -1)).T
        known["place"] = places
        element = _element(functions_of(self.model), name, tuple(self.sizes), rows, cells)
        return self._elements(element, takes, known, adds, len(own))

    def _of_ends(self, adds: ca.DM, name: str = "end_slope", rows: int | None = None) -> Elements:
        c, size = self.model.node.coordinates, self.sizes["x"]
        takes = {name: self._shared(name, 1) for name in ("lam", "p", "pose")}
        takes["x"] = _picked(np.r_[:c, size - c : size], size)
        element = _element(functions_of(self.model), name, tuple(self.sizes), rows)
        return self._elements(element, takes, self.known, adds, 1)

    def _shared(self, name: str, count: int) -> ca.DM:
        """An argument that all of them have."""
        size = self.sizes.get(name, 0)
        return _picked(np.tile(np.arange(size), count), size)

    def _elements(
        self,
        element: tuple[Element, tuple[str, ...], tuple[str, ...]],
        takes: dict[str, ca.DM],
        known: dict[str, FloatArray],
        adds: ca.DM,
        count: int,
    ) -> Elements:
        """Elements from their arguments by name; first those that vary."""
        function, varying, fixed = element
        columns, begun = [], dict(zip(self.sizes, self._edges, strict=False))
        for name in varying:
            before, after = begun[name], self._edges[-1] - begun[name] - self.sizes[name]
            rows = takes[name].shape[0]
            own = ca.horzcat(ca.DM(rows, before), takes[name], ca.DM(rows, after))
            columns.append(ca.vertsplit(own, rows // count))
        by_element = ca.vertcat(*(part for each in zip(*columns, strict=True) for part in each))
        numbers = [
            np.broadcast_to(known[x].reshape((len(known[x]), -1)), (len(known[x]), count))
            for x in fixed
        ]
        stacked = np.vstack([np.zeros((0, count)), *numbers])
        return Elements(function, by_element, ca.DM(stacked), adds)


def _picked(rows: IntArray, size: int) -> ca.DM:
    """Matrix (rows, size) that picks entries; an index of -1 picks none."""
    rows = rows.ravel()
    kept = np.flatnonzero(rows >= 0)
    ones = np.ones(len(kept))
    return ca.DM.triplet(kept.tolist(), rows[kept].tolist(), ones, len(rows), size)


def _every(size: int) -> ca.DM:
    return ca.DM.eye(size)


def _between_ends(functions: Functions, name: str, cells: int) -> ca.Function:
    """A function of a segment of which `place` has the shares of the cable that its ends are at.

    Ends that slide have their arc lengths in the border, see `Slides` for the gradient by these, or
    a pose tells the length between them. The rest strains are those of all `cells` and of one
    before and one after them: of these it has those of the cell in which it is laid, `laid_for`.
    """
    model, base = functions.model, functions.compact(name)
    x, lam, p, rest, _, deviation = (
        ca.SX.sym("given", *base.size_in(i)) for i in range(base.n_in())
    )
    pose, every = ca.SX.sym("pose", model.n_pose), ca.SX.sym("rest", rest.numel(), cells + 2)
    row, length = ca.SX.sym("place", 3), model.cable.length
    u, mesh, ends = row[:2], row[2], {0: ca.SX(0.0), 1: ca.SX(length)}
    ends |= {k: lam[own] for k, own in model.sliding.items()}
    if model.fed_by_length:
        free = pose[EndConditions.size(model.node) + VIEWPOINT_SIZE]
        ends[1 if model.end.slides else 0] = free if model.end.slides else length - free
    low, high = (
        (ca.floor(ends[k] / mesh) + 0.5) * mesh if slides else ends[k]
        for k, slides in enumerate(model.loose)
    )
    middle = low + (high - low) * (u[0] + u[1]) / 2
    cell = ca.fmin(ca.fmax(ca.floor(middle / mesh), -1), cells)
    chosen = every @ (ca.SX(np.arange(-1.0, cells + 1)) == cell)
    places = [ends[0] + share * (ends[1] - ends[0]) for share in (u[0], u[1])]
    arguments = [x, lam, p, chosen, ca.vertcat(*places, mesh, cell * mesh), deviation]
    outputs: list[ca.SX] = base.call(arguments)
    if name == "segment_slope" and model.sliding:
        (edges,) = functions.compact("edge_slope").call(arguments)
        for k, own in model.sliding.items():
            moved = u if k else 1 - u
            outputs[0][2 * model.node.increment + own] += ca.dot(moved, edges)
    return ca.Function(name, [x, lam, p, ca.vec(every), row, pose, deviation], outputs)


@lru_cache(maxsize=4 * MODELS)
def _element(
    functions: Functions, name: str, varying: tuple[str, ...], rows: int | None, cells: int = 0
) -> tuple[Element, tuple[str, ...], tuple[str, ...]]:
    """A function of `Functions` as an `Element`: what varies, and the rest of its arguments.

    `rows`: number of rows that count; all by default. `cells`: of a cable that slides through ends.
    Deviations are zero.
    """
    of_segment = name.startswith("segment")
    function = functions.compact(name) if of_segment else getattr(functions, name)
    names = ("x", "lam", "p", *(("rest", "place") if of_segment else ("pose",)))
    if cells:
        function, names = _between_ends(functions, name, cells), (*names, "pose")
    own = tuple(key for key in names if key in varying)
    fixed = tuple(key for key in names if key not in varying)
    symbols = {key: ca.SX.sym(key, function.numel_in(i)) for i, key in enumerate(names)}
    values: Any = ca.vertcat(*map(ca.vec, function.call([*symbols.values(), ca.SX(0)])))
    given = [ca.vertcat(ca.SX(0, 1), *(symbols[key] for key in keys)) for keys in (own, fixed)]
    return Element(ca.Function(name, given, [values[:rows]])), own, fixed
