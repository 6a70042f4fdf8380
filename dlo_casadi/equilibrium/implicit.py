"""The equilibrium as a node of CasADi graphs, with exact derivatives of first and second order.

The search for an equilibrium is not a smooth operation, but the equilibrium is a smooth function
z(u) with g(z(u), u) = 0 of the numbers u of the pose. In the graph a node without derivatives
returns the equilibrium z_0 of the present u, followed by two steps of the chord method,

        z_(k+1) = z_k - K^-1 g(z_k, u),    K = dg/dz (z_0, u), treated as constant.

At the present u these steps change nothing. Their error at u + du is O(du^(k+1)), so two steps have
the exact first and second derivatives of z (implicit function theorem), however CasADi
differentiates them, and one matrix serves all orders. In space z are increments about the frames of
the equilibrium itself.

References
----------
Ortega and Rheinboldt, Iterative Solution of Nonlinear Equations, 1970, section 10.2 (chord method);
Griewank and Walther, Evaluating Derivatives, 2008, chapter 15 (implicit functions).
"""

from collections.abc import Sequence
from functools import cache, lru_cache
from typing import Any

import casadi as ca
import numpy as np

from dlo_casadi.arrays import FloatArray
from dlo_casadi.equilibrium.equilibrium import Equilibrium
from dlo_casadi.equilibrium.pose import Branch, HeldPose
from dlo_casadi.equilibrium.solve import solve_equilibrium
from dlo_casadi.equilibrium.spans import out_of_reach
from dlo_casadi.errors import EquilibriumError
from dlo_casadi.model.cable_model import VIEWPOINT_SIZE, CableModel
from dlo_casadi.model.pose_system import pose_rows
from dlo_casadi.model.whole_pose import PoseSymbols, tangent
from dlo_casadi.rod.ends import EndConditions

# Number of equilibria that a search caches: an optimiser asks for value, gradient, Hessian.
KEPT = 1024
SIDES = ("start", "end")


def pose_size(model: CableModel) -> int:
    """Size of dlo_pose in the C header: both ends, in space `turns`, tensions, then the clips."""
    frame = model.node.coordinates * model.clamped_between
    clips = (1 + model.node.dimension + frame) * len(model.clips)
    return EndConditions.size(model.node) + model.node.twists + sum(model.loose) + clips


def pose_of(model: CableModel, numbers: FloatArray, branch: Branch | None = None) -> HeldPose:
    """The pose with its numbers laid out as in dlo_pose; what is not held is left out."""
    d, c = model.node.dimension, model.node.coordinates
    sizes = np.cumsum([d, d, c, c, int(model.node.twists)])
    start, end, first, last, turns, beyond = np.split(numbers, sizes)
    held: dict[str, Any] = {}
    for side, frame in (("start", first), ("end", last)):
        if getattr(model, side).direction:
            held[f"{side}_{model.node.direction}"] = model.node.declared(frame)
    both = model.start.roll and model.end.roll
    fed = [f"{side}_tension" for side, own in zip(SIDES, model.loose, strict=True) if own]
    fed = ["free_length"] * len(fed) if model.fed_by_length else fed
    held |= {name: float(x) for name, x in zip(fed, beyond, strict=False)}
    return HeldPose(
        start=tuple(start.tolist()),
        end=tuple(end.tolist()) if model.end.place else None,
        turns=float(turns[0]) if model.node.twists and both else 0.0,
        branch=branch,
        **held,
    )


def symbols_of(
    model: CableModel, x: Any, multipliers: Any, pose: Any, p: Any, rest: Any
) -> PoseSymbols:
    """Arguments of the expressions of a pose; `pose` as in dlo_pose, quaternions of any length."""
    d, c = model.node.dimension, model.node.coordinates
    others = pose.numel() - 2 * (d + c) - int(model.node.twists)
    start, end, first, last, _, beyond = ca.vertsplit(
        pose, np.cumsum([0, d, d, c, c, int(model.node.twists), others]).tolist()
    )
    frames = []
    for held, frame in ((model.start, first), (model.end, last)):
        if not held.direction:
            frame = ca.MX(ca.DM(model.node.identity))
        frames.append(model.node.normalised(frame))
    end = end if model.end.place else ca.MX.zeros(d)
    full = ca.vertcat(start, end, *frames, ca.MX.zeros(VIEWPOINT_SIZE), beyond)
    still = ca.DM.zeros(len(model.deviation_names))
    return PoseSymbols(ca.vec(x), multipliers, p, rest, full, still)


def search_sizes(model: CableModel) -> list[tuple[int, int]]:
    """Sizes of the outputs of a search: x, multipliers, status, 1 or NaN."""
    x = (model.node.coordinates, model.chain.n_nodes)
    return [x, (len(_searched(model)), 1), (1, 1), (1, 1)]


def _searched(model: CableModel) -> list[int]:
    """Border rows that a search finds: multipliers, then arc lengths at ends that slide."""
    return [*np.flatnonzero(model.are_multipliers).tolist(), *model.sliding.values()]


class _SearchCallback(ca.Callback):
    """(pose, p, rest) -> (x, multipliers, status, 1 or NaN)."""

    def __init__(self, model: CableModel, branch: Branch | None) -> None:
        super().__init__()
        self.model, self.branch = model, branch
        self._found = lru_cache(maxsize=KEPT)(self._find)
        self._sizes = search_sizes(model)
        self.construct("equilibrium")

    def get_n_in(self) -> int:
        return 3

    def get_n_out(self) -> int:
        return len(self._sizes)

    def get_sparsity_in(self, i: int) -> ca.Sparsity:
        sizes = (pose_size(self.model), len(self.model.names), self.model.chain.n_rests)
        return ca.Sparsity.dense(sizes[i], 1)

    def get_sparsity_out(self, i: int) -> ca.Sparsity:
        return ca.Sparsity.dense(*self._sizes[i])

    def eval(self, given: Sequence[ca.DM]) -> list[ca.DM]:
        return self._found(*(np.array(part).ravel().tobytes() for part in given))

    def _find(self, *given: bytes) -> list[ca.DM]:
        found = self._solved(*map(np.frombuffer, given))
        if isinstance(found, Equilibrium):
            multipliers = found.multipliers[_searched(self.model)]
            return [ca.DM(found.x.T), ca.DM(multipliers), ca.DM(0), ca.DM(1)]
        none = [ca.DM.nan(*size) for size in self._sizes]
        return [*none[:2], ca.DM(found), none[3]]

    def _solved(self, numbers: FloatArray, p: FloatArray, rest: FloatArray) -> Equilibrium | int:
        """The stable equilibrium of a pose, or the number of the reason that there is none."""
        model, pose = self.model, pose_of(self.model, numbers, self.branch)
        if not np.all(np.isfinite([*pose.vector, pose.turns, *p, *rest])):
            return 3
        if np.any(model.node.excess(np.array(pose.frames)) < -0.5):
            return 6
        if out_of_reach(model, p, pose) is not None:
            return 1
        try:
            found = solve_equilibrium(model, p, rest, pose)
        except EquilibriumError:
            return 2
        return found if found.stable else 4


@cache
def search_of(model: CableModel, branch: Branch | None) -> _SearchCallback:
    """Search node, kept until the process ends: graphs that contain it do not keep it alive."""
    return _SearchCallback(model, branch)


def detached(function: ca.Function) -> ca.Function:
    """The same function without derivatives."""
    given: list[Any] = function.mx_in()
    outs: list[Any] = function.mx_out()
    zeros = [ca.MX(out.numel(), one.numel()) for out in outs for one in given]
    options: dict[str, Any] = {
        "custom_jacobian": ca.Function(f"jac_{function.name()}", [*given, *outs], zeros),
        "enable_forward": False,
        "enable_reverse": False,
        "never_inline": True,
    }
    return ca.Function(function.name(), given, function.call(given), options)


class Numbers:
    """Parameters p and rest strains (MX) of a function: those that vary are its arguments.

    `given`: what varies, outside of the function. `inside`: both, as the function sees them.
    """

    def __init__(self, p: Any, rest: Any) -> None:
        both = {"p": p, "rest": rest}
        varying = {name: x for name, x in both.items() if not x.is_constant()}
        self.given: list[Any] = [*varying.values()]
        self.symbols: list[Any] = [ca.MX.sym(name, x.numel()) for name, x in varying.items()]
        self.inside = {**both, **dict(zip(varying, self.symbols, strict=True))}


def border_of(model: CableModel, numbers: Numbers) -> ca.Function:
    """(x, what a search finds of the border, pose, ...) -> (n_border,): places of springs put in.

    A spring's place y has the condition r(s) - y = 0: with y = 0 this is y. Without derivatives.
    """
    x = ca.MX.sym("x", model.node.coordinates, model.chain.n_nodes)
    known, pose = _searched(model), ca.MX.sym("pose", pose_size(model))
    found, border = ca.MX.sym("multipliers", len(known)), ca.MX.zeros(model.n_border)
    border[known] = found
    if model.n_springs:
        rows = pose_rows(model, symbols_of(model, x, border, pose, **numbers.inside)).conditions
        pulls = [row for rows_of_one in model.pulls[: model.n_springs] for row in rows_of_one]
        border[[row - model.node.dimension for row in pulls]] = rows[pulls]
    return detached(ca.Function("border", [x, found, pose, *numbers.symbols], [border]))


def chord(model: CableModel, numbers: Numbers) -> ca.Function:
    """(x, multipliers, pose, ...) -> (x, multipliers) after two chord steps, see the module.

    A further output is the longest step of a node [rad]: zero at an equilibrium.
    """
    node, count, k = model.node, model.chain.n_nodes, model.n_border
    x = ca.MX.sym("x", node.coordinates, count)
    lam, pose = ca.MX.sym("multipliers", k), ca.MX.sym("pose", pose_size(model))
    z, rest = ca.MX.sym("z", count * node.increment + k), numbers.inside["rest"]
    one, step = ca.SX.sym("one", node.coordinates), ca.SX.sym("step", node.increment)
    moved = ca.Function("moved", [one, step], [node.moved(one, step)])

    def after(z: Any) -> tuple[Any, Any]:
        steps, more = ca.vertsplit(z, [0, count * node.increment, z.numel()])
        return moved(x, ca.reshape(steps, node.increment, count)), lam + more

    rows = pose_rows(model, symbols_of(model, *after(z), pose, **numbers.inside))
    arguments: list[Any] = [x, lam, pose, *numbers.symbols]
    forces = ca.vertcat(ca.vec(rows.balance), rows.conditions)
    force = ca.Function("imbalance", [z, *arguments], [forces])
    matrix = tangent(model, symbols_of(model, x, lam, pose, **numbers.inside))
    if model.may_spin:
        # A cable that is straight at rest may roll about its axis: block this for the first node.
        matrix[0, 0] += ca.if_else(ca.sumsqr(rest) == 0, ca.mmax(ca.fabs(matrix)), 0)
    matrix = detached(ca.Function("tangent", arguments, [matrix]))(*arguments)
    # A singular matrix gives NaN, not an exception: `search` may find an equilibrium that swings.
    total = ca.MX.zeros(z.shape)
    for _ in range(2):
        total -= ca.solve(matrix, force(total, *arguments), "qr", {"eps": 0.0})
    longest = ca.mmax(ca.fabs(total[: count * node.increment]))
    return ca.Function("chord", arguments, [*after(total), longest])
