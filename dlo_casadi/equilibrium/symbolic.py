"""Equilibria inside other people's CasADi problems: a differentiable function, and the equations.

The search for an equilibrium is no smooth operation, the equilibrium it finds is: z(u) with
g(z(u), u) = 0 for the numbers u of the pose. In the graph a node without derivatives returns the
equilibrium z_0 of the present u, and two steps of the chord method follow from there,

    z_(k+1) = z_k - K^-1 g(z_k, u),    K = dg/dz (z_0, u), taken for a constant.

At the present u they stay where they are. Their error at u + du is O(du^(k+1)), so that two steps
have the first and second derivatives of z exactly (implicit function theorem), whatever CasADi does
to differentiate them, and one matrix serves all orders. In space z are increments about the frames
of the equilibrium itself.

References
----------
Ortega and Rheinboldt, Iterative Solution of Nonlinear Equations, 1970, section 10.2 (chord method);
Griewank and Walther, Evaluating Derivatives, 2008, chapter 15 (implicit functions).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache, lru_cache
from typing import Any, NamedTuple

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from dlo_casadi.arrays import FloatArray
from dlo_casadi.equilibrium.equilibrium import Equilibrium
from dlo_casadi.equilibrium.pose import SIGNS, Branch, HeldPose
from dlo_casadi.equilibrium.solve import out_of_reach, solve_equilibrium
from dlo_casadi.errors import DloError, EquilibriumError, counted
from dlo_casadi.model.cable_model import CableModel
from dlo_casadi.model.whole_pose import PoseSymbols, balance, shape, tangent
from dlo_casadi.rod.ends import EndConditions

# Equilibria that a search keeps: an optimiser asks for value, gradient and Hessian of one pose.
KEPT = 1024
# Smallest curvature [1/m] that is told from none: the norm of two has no derivative at zero.
STRAIGHT = 1e-8


def pose_size(model: CableModel) -> int:
    """Size of dlo_pose in the C header: both ends and, in space, `turns`."""
    return EndConditions.size(model.node) + int(model.in_space)


def pose_of(model: CableModel, numbers: FloatArray, branch: Branch | None = None) -> HeldPose:
    """The pose whose numbers are laid out as dlo_pose; what is not held is left out."""
    d, c = model.node.dimension, model.node.coordinates
    start, end, first, last, turns = np.split(numbers, np.cumsum([d, d, c, c]))
    held: dict[str, Any] = {}
    for side, frame in (("start", first), ("end", last)):
        if getattr(model, side) != "clamped":
            continue
        if model.in_space:
            held[f"{side}_orientation"] = tuple(frame.tolist())
        else:
            held[f"{side}_heading"] = float(frame[0])
    both = model.start == model.end == "clamped"
    return HeldPose(
        start=tuple(start.tolist()),
        end=None if model.end == "free" else tuple(end.tolist()),
        turns=float(turns[0]) if model.in_space and both else 0.0,
        branch=branch,
        **held,
    )


class Unknowns(NamedTuple):
    """Unknowns of the equations of one pose: `x` (coordinates, n_nodes), `multipliers`."""

    x: FloatArray
    multipliers: FloatArray


@dataclass(frozen=True, eq=False)
class CasadiCable:
    """A cable whose parameters have values, for CasADi problems of one's own.

    Parameters
    ----------
    model : CableModel
    p : (n_parameters,)
        In the order of `model.names` (SI).
    rest : (n_rests,) [1/m]
        Rest strains of the cells: `model.rest_basis @ coefficients`.
    """

    model: CableModel
    p: FloatArray
    rest: FloatArray

    def function(
        self, *, parameters: bool | Sequence[str] = False, branch: Branch | None = None
    ) -> ca.Function:
        """The shape as a differentiable function of the pose, for CasADi problems of one's own.

        (pose[, parameters]) -> (points, end_force, end_moment, energy, min_bend_radius, curvature,
        status), with exact first and second derivatives: for `ca.Opti` with IPOPT, `.map(n)`, any
        graph. The result is the stable equilibrium of lowest energy, which may jump from one pose
        to the next, unless `branch` or the pose's turns name one.

        Parameters
        ----------
        parameters : bool or sequence of str
            Whether the model's parameters, or those of them with these names, are a second input
            `parameters` (SI), in the order of `model.names` or of the names, in place of the fitted
            values.
        branch : "ccw" or "cw", optional
            In a plane, which way the cable turns from start to end.

        Returns
        -------
        casadi.Function
            pose : as dlo_pose in the C header. In a plane (6,): start x, y, end x, y [m], start
            heading, end heading [rad]. In space (15,): start, end [m], their quaternions (x, y, z,
            w) of any length but zero, turns. What the boundary does not hold is ignored.

            points : (d, n + 1) [m], element boundaries from start to end.
            end_force : (d,) [N] of the cable on whatever holds its end.
            end_moment : (1,) or (3,) [N m] of the cable on its end clamp, world axes; zero at pins.
            energy : [J]
            min_bend_radius : [m]. Where the tightest place jumps along the cable, it has a kink at
            which IPOPT stalls: as a constraint, bound the curvature instead.
            curvature : (n_cells + 2,) [1/m], not negative: at the start, in the middle of each cell
            and at the end. `curvature <= 1 / radius` is `min_bend_radius >= radius`, and smooth.
            status : 0 for a stable equilibrium; otherwise all other outputs and their derivatives
            are NaN, and it is the reason, a dlo_status of the C header: 1 out of reach, 2 none
            found, 3 a number is not finite, 4 none that is stable.

        Raises
        ------
        DloError
            If a parameter or the branch is unknown. The function itself raises nothing.

        Notes
        -----
        Derivatives are those of the implicit function theorem, see the module. The
        search runs in Python, so that the function cannot be serialised and lives until the
        process ends; the generated C can, see `casadi.external` in its header.
        """
        if branch is not None and (self.model.in_space or branch not in SIGNS):
            raise DloError(f"branch must be 'ccw' or 'cw', in a plane, or None, found {branch!r}")
        inputs, p = self._inputs(parameters)
        pose = inputs["pose"]
        search = _search(self.model, self.rest.tobytes(), branch)
        x, multipliers, status, there = search(pose, p)
        x, multipliers = _chord(self.model, self.rest)(x, multipliers, pose, p)
        symbols = _symbols(self.model, self.rest, x, multipliers, pose, p)
        outputs = {name: there * out for name, out in _outputs(self.model, symbols).items()}
        return _function("cable", inputs, outputs | {"status": status})

    def equations(self, *, parameters: bool | Sequence[str] = False) -> ca.Function:
        """The equations of an equilibrium, to transcribe many poses in one problem of one's own.

        (x, multipliers, pose[, parameters]) -> (residual, balance, conditions, lengths, points,
        ...): as many equations as unknowns, every stationary point of the energy a root, stable or
        not. `initial` gives a first guess. The unknowns need no bounds.

        Parameters
        ----------
        parameters : bool or sequence of str
            As in `function`.

        Returns
        -------
        casadi.Function
            x : (1, n_nodes) headings [rad], in space (4, n_nodes) quaternions (x, y, z, w).
            multipliers : (n_border,), named by `model.border_names`: of the end conditions [N,
            N m]; of springs their places [m] and multipliers [N].
            pose : as in `function`.

            residual : (n_equations,), the next three in one column.
            balance : (1 or 3, n_nodes) [N m], of moments at the nodes.
            conditions : (n_border,), named as the multipliers: end position [m], clamps [rad].
            lengths : (n_nodes,) squares of the quaternions' lengths less one; (0,) in a plane.
            points, end_force, end_moment, energy, min_bend_radius, curvature : as of `function`,
            true where the residual is zero.

        Raises
        ------
        DloError
            If a parameter is unknown.

        Notes
        -----
        Between ball joints in space a cable that is straight at rest may roll about its axis: the
        equations are then singular.
        """
        (inputs, p), node, k = self._inputs(parameters), self.model.node, self.model.n_border
        x = ca.MX.sym("x", node.coordinates, self.model.chain.n_nodes)
        multipliers = ca.MX.sym("multipliers", k)
        unit, lengths = x, ca.MX(0, 1)
        if self.model.in_space:
            squares = ca.sum1(x**2)
            unit, lengths = x / ca.repmat(ca.sqrt(squares), node.coordinates, 1), squares.T - 1
        symbols = _symbols(self.model, self.rest, unit, multipliers, inputs["pose"], p)
        rows = balance(self.model, symbols)
        outputs = {
            "residual": ca.vertcat(rows, lengths),
            "balance": ca.reshape(rows[: rows.numel() - k], node.increment, -1),
            "conditions": rows[rows.numel() - k :],
            "lengths": lengths,
        }
        inputs = {"x": x, "multipliers": multipliers, **inputs}
        return _function("equations", inputs, outputs | _outputs(self.model, symbols))

    def initial(self, pose: ArrayLike, *, branch: Branch | None = None) -> Unknowns:
        """Unknowns `x`, `multipliers` of `equations` at the stable equilibrium of a pose.

        Parameters
        ----------
        pose : (6,) or (15,)
            As of `function`.
        branch : "ccw" or "cw", optional
            In a plane, which way the cable turns from start to end.

        Raises
        ------
        EquilibriumError
            If the pose has no equilibrium.
        DloError
            If it has another number of numbers.
        """
        numbers = np.asarray(pose, float).ravel()
        if len(numbers) != pose_size(self.model):
            size = counted(pose_size(self.model), "number")
            raise DloError(f"pose: {size} as in dlo_pose of the C header, found {len(numbers)}")
        held = pose_of(self.model, numbers, branch)
        found = solve_equilibrium(self.model, self.p, self.rest, held)
        return Unknowns(found.x.T, found.multipliers)

    def _inputs(self, parameters: bool | Sequence[str]) -> tuple[dict[str, Any], Any]:
        """Symbols of the pose and of the parameters asked for, and all parameters."""
        known = self.model.names
        names = known if parameters is True else tuple(parameters or ())
        for name in names:
            if name not in known:
                raise DloError(f"no parameter {name!r}; there are {', '.join(known)}")
        pose, own = ca.MX.sym("pose", pose_size(self.model)), ca.MX.sym("parameters", len(names))
        p = ca.MX(ca.DM(self.p))
        p[[known.index(name) for name in names]] = own
        return {"pose": pose} | ({"parameters": own} if names else {}), p


# ---- expressions ---------------------------------------------------------------------------------


def _function(name: str, inputs: dict[str, Any], outputs: dict[str, Any]) -> ca.Function:
    return ca.Function(
        name, [*inputs.values()], [*outputs.values()], [*inputs], [*outputs], {"cse": True}
    )


def _symbols(
    model: CableModel, rest: FloatArray, x: Any, multipliers: Any, pose: Any, p: Any
) -> PoseSymbols:
    """Arguments of the expressions of a pose; `pose` as dlo_pose, quaternions of any length."""
    d, c = model.node.dimension, model.node.coordinates
    start, end, first, last, _ = ca.vertsplit(
        pose, np.cumsum([0, d, d, c, c, pose.numel() - 2 * (d + c)]).tolist()
    )
    frames = []
    for held, frame in ((model.start, first), (model.end, last)):
        if held != "clamped":
            frame = ca.MX(ca.DM(model.node.identity))
        frames.append(frame / ca.norm_2(frame) if model.in_space else frame)
    end = end if model.end != "free" else ca.MX.zeros(d)
    camera = ca.MX.zeros(model.n_pose - EndConditions.size(model.node))
    full = ca.vertcat(start, end, *frames, camera)
    still = ca.DM.zeros(len(model.deviation_names))
    return PoseSymbols(ca.vec(x), multipliers, p, ca.DM(rest), full, still)


def _outputs(model: CableModel, symbols: PoseSymbols) -> dict[str, Any]:
    """What a user asks of a shape, by name."""
    found = shape(model, symbols)
    curvature = _curvature(model)(found.strains)
    return {
        "points": found.points,
        "end_force": found.forces[:, 1],
        "end_moment": found.moments[:, 1],
        "energy": found.energy,
        "min_bend_radius": 1 / ca.mmax(curvature),
        "curvature": curvature,
    }


@lru_cache
def _curvature(model: CableModel) -> ca.Function:
    """(strains) -> curvatures (n_cells + 2,) of cells and both ends, see `smallest_radius`."""
    widths = np.diff(model.chain.cells, axis=1).ravel()
    strains = ca.SX.sym("strains", len(model.node.strains), len(widths))
    bends = strains[-len(model.node.curvatures) :, :]
    in_cells = ca.sqrt(ca.sum1(bends**2) + STRAIGHT**2) if model.in_space else bends
    ends = []
    for outer, inner in ((0, 1), (-1, -2)) if len(widths) > 1 else ():
        share = widths[outer] / (widths[outer] + widths[inner])
        ends.append(in_cells[outer] + share * (in_cells[outer] - in_cells[inner]))
    signed = ca.vertcat(*ends[:1], in_cells.T, *ends[1:])
    return ca.Function("curvature", [strains], [ca.sqrt(signed**2 + STRAIGHT**2)])


# ---- the equilibrium as a node of a graph --------------------------------------------------------


class _Search(ca.Callback):
    """(pose, p) -> (x, multipliers, status, 1 or NaN): piecewise constant to CasADi."""

    def __init__(self, model: CableModel, rest: FloatArray, branch: Branch | None) -> None:
        super().__init__()
        self.model, self.rest, self.branch = model, rest, branch
        self._found = lru_cache(maxsize=KEPT)(self._find)
        self._sizes = (
            (model.node.coordinates, model.chain.n_nodes),
            (model.n_border, 1),
            (1, 1),
            (1, 1),
        )
        self.construct("equilibrium")

    def get_n_in(self) -> int:
        return 2

    def get_n_out(self) -> int:
        return len(self._sizes)

    def get_sparsity_in(self, i: int) -> ca.Sparsity:
        return ca.Sparsity.dense((pose_size(self.model), len(self.model.names))[i], 1)

    def get_sparsity_out(self, i: int) -> ca.Sparsity:
        return ca.Sparsity.dense(*self._sizes[i])

    def has_jacobian(self) -> bool:
        return True

    def get_jacobian(
        self, name: str, inputs: Sequence[str], outputs: Sequence[str], options: Any
    ) -> ca.Function:
        """Zeros without entries: derivatives are those of the steps that follow."""
        given = [ca.MX.sym(i, self.sparsity_in(k)) for k, i in enumerate(inputs[:2])]
        given += [ca.MX.sym(o, *size) for o, size in zip(inputs[2:], self._sizes, strict=True)]
        zeros = [ca.MX(n * m, self.size1_in(i)) for n, m in self._sizes for i in range(2)]
        return ca.Function(name, given, zeros, inputs, outputs, options)

    def eval(self, given: Sequence[ca.DM]) -> list[ca.DM]:
        pose, p = (np.array(part).ravel() for part in given)
        return self._found(pose.tobytes(), p.tobytes())

    def _find(self, pose: bytes, p: bytes) -> list[ca.DM]:
        numbers, known = np.frombuffer(pose), np.frombuffer(p)
        found = _solved(self.model, known, self.rest, numbers, self.branch)
        if isinstance(found, Equilibrium):
            return [ca.DM(found.x.T), ca.DM(found.multipliers), ca.DM(0), ca.DM(1)]
        none = [ca.DM.nan(*size) for size in self._sizes]
        return [*none[:2], ca.DM(found), none[3]]


def _solved(
    model: CableModel,
    p: FloatArray,
    rest: FloatArray,
    numbers: FloatArray,
    branch: Branch | None,
) -> Equilibrium | int:
    """The stable equilibrium of a pose, or the number of the reason why there is none."""
    pose = pose_of(model, numbers, branch)
    if not (np.all(np.isfinite(pose.vector)) and np.all(np.isfinite(p))):
        return 3
    if out_of_reach(model, p, pose) is not None:
        return 1
    try:
        found = solve_equilibrium(model, p, rest, pose)
    except EquilibriumError:
        return 2
    # A joint held at its bound is no root of the equations.
    return found if found.stable and not found.bound_multipliers.any() else 4


@cache
def _search(model: CableModel, rest: bytes, branch: Branch | None) -> _Search:
    """A node for the life of the process: graphs that contain it do not keep it alive."""
    return _Search(model, np.frombuffer(rest), branch)


def _chord(model: CableModel, rest: FloatArray) -> ca.Function:
    """(x, multipliers, pose, p) -> (x, multipliers) after two chord steps, see the module."""
    node, count, k = model.node, model.chain.n_nodes, model.n_border
    x = ca.MX.sym("x", node.coordinates, count)
    lam, pose = ca.MX.sym("multipliers", k), ca.MX.sym("pose", pose_size(model))
    p, z = ca.MX.sym("p", len(model.names)), ca.MX.sym("z", count * node.increment + k)
    one, step = ca.SX.sym("one", node.coordinates), ca.SX.sym("step", node.increment)
    moved = ca.Function("moved", [one, step], [node.moved(one, step)])

    def after(z: Any) -> tuple[Any, Any]:
        steps, more = ca.vertsplit(z, [0, count * node.increment, z.numel()])
        return moved(x, ca.reshape(steps, node.increment, count)), lam + more

    force = ca.Function(
        "imbalance",
        [z, x, lam, pose, p],
        [balance(model, _symbols(model, rest, *after(z), pose, p))],
    )
    matrix = tangent(model, _symbols(model, rest, x, lam, pose, p))
    if model.may_spin and not rest.any():
        # Such a cable may roll about its own axis: the first node is kept from it.
        matrix[0, 0] += ca.mmax(ca.fabs(matrix))
    arguments: list[Any] = [x, lam, pose, p]
    fixed: dict[str, Any] = {"is_diff_in": [False] * len(arguments), "never_inline": True}
    matrix = ca.Function("tangent", arguments, [matrix], fixed)(*arguments)
    total = ca.MX.zeros(z.shape)
    for _ in range(2):
        total -= ca.solve(matrix, force(total, *arguments), "qr")
    return ca.Function("chord", arguments, [*after(total)])
