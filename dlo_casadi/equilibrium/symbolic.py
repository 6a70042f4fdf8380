"""A cable with fixed parameter values as CasADi functions, for the user's own problems."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any, NamedTuple, Self

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from dlo_casadi.arrays import FloatArray
from dlo_casadi.equilibrium.equilibrium import continued
from dlo_casadi.equilibrium.implicit import (
    border_of,
    chord,
    detached,
    pose_of,
    pose_size,
    search_of,
    search_sizes,
    symbols_of,
)
from dlo_casadi.equilibrium.pose import Branch
from dlo_casadi.equilibrium.solve import solve_equilibrium
from dlo_casadi.errors import DloError, counted
from dlo_casadi.model.cable_model import CableModel
from dlo_casadi.model.clips import Clipped
from dlo_casadi.model.whole_pose import PoseSymbols, balance, shape
from dlo_casadi.rod.node import STRAIGHT
from dlo_casadi.rod.supports import CLIPS, SupportKind

# Longest step of a node [rad] from a shape that counts as an equilibrium.
FARTHEST = 1e-6


class PoseUnknowns(NamedTuple):
    """Unknowns of the equations of one pose: `x` (coordinates, n_nodes), `multipliers`."""

    x: FloatArray
    multipliers: FloatArray


@dataclass(frozen=True, eq=False)
class CasadiCable:
    """A cable with fixed parameter values, for the user's own CasADi problems.

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

    def with_clips(self, clips: Sequence[SupportKind | str]) -> Self:
        """Return the same cable held by clips of these kinds, in the order along it.

        Raises
        ------
        DloError
            If they are no list of kinds: pinned, clamped, swivel, eyelet.
        """
        known = CLIPS
        listed = isinstance(clips, Sequence) and not isinstance(clips, str)
        if not listed or any(kind not in known for kind in clips):
            raise DloError(
                f"clips: a list of kinds belongs here, found {clips!r}\n"
                f"  Try: [{known[0]!r}]; kinds are {', '.join(known)}"
            )
        return replace(self, model=replace(self.model, clips=tuple(map(SupportKind, clips))))

    def function(
        self,
        *,
        parameters: bool | str | Sequence[str] = False,
        branch: Branch | None = None,
        search: ca.Function | None = None,
    ) -> ca.Function:
        """The shape as a differentiable function of the pose, for the user's own CasADi problems.

        (pose[, parameters]) -> (points, end_force, end_moment, energy, min_bend_radius, curvature,
        status), with exact first and second derivatives: for `ca.Opti` with IPOPT, `.map(n)`, any
        graph. The result is the stable equilibrium of lowest energy, which may jump from one pose
        to the next, unless `branch` or the pose's turns name one.

        Parameters
        ----------
        parameters : bool, str or sequence of str
            Whether the model's parameters, or those of them with these names, are a second input
            `parameters` (SI), in the order of `model.names` or of the names, in place of the fitted
            values.
        branch : "ccw" or "cw", optional
            In a plane, which way the cable turns from start to end. Between two clamps their
            headings fix the turn but not the equilibrium: the lowest one may jump.
        search : casadi.Function, optional
            Function that finds equilibria in place of Python: `casadi.external("dlo_equilibrium",
            library)`, or `dlo_equilibrium_ccw`, `_cw`, of this cable's generated C, compiled into a
            shared library. A pose then takes about 1 ms instead of 30 (20 elements, both ends
            clamped), the function can be serialised, and CasADi can write it and its derivatives as
            C (`Function.generate`).

        Returns
        -------
        casadi.Function
            pose : as dlo_pose in the C header. In a plane (6,): start x, y, end x, y [m], start
            heading, end heading [rad]. In space (15,): start, end [m], their quaternions (x, y, z,
            w) of any length but zero, turns. What the boundary does not hold is ignored.

            points : (d, n + 1) [m], element boundaries from start to end.
            end_force : (d,) [N] of the cable on whatever holds its end.
            end_moment : (1,) or (3,) [N m] of the cable on what holds its end, world axes.
            energy : [J]
            min_bend_radius : [m]. It has a kink where the tightest place jumps along the cable, and
            IPOPT stalls there: as a constraint, bound the curvature instead.
            curvature : (n_cells + 2,) [1/m], not negative: at the start, in the middle of each cell
            and at the end. `curvature <= 1 / radius` is `min_bend_radius >= radius`, and smooth.
            status : 0 for a stable equilibrium. Otherwise all other outputs and derivatives are
            NaN, and the status is the reason, a dlo_status of the C header: 1 out of reach, 2 none
            found, 3 a number is not finite, 4 none that is stable, 6 a quaternion is zero, a joint
            of links is at its bound, or `search` belongs to another cable.

        Raises
        ------
        DloError
            If a parameter or the branch is unknown, or if `search` has other sizes or is given with
            parameters or a branch, which it already has. The function itself raises nothing.

        Notes
        -----
        Derivatives are those of the implicit function theorem, see `implicit`. Without `search` the
        function calls Python, cannot be serialised, and keeps what it needs until the process ends.
        """
        inputs, p = self._inputs(parameters)
        pose = inputs["pose"]
        if search is None:
            self._check_branch(branch)
            found = detached(search_of(self.model, self.rest.tobytes(), branch))(pose, p)
        else:
            self._check_search(search, with_others=bool(parameters or branch))
            found = detached(search)(pose)
        x, multipliers, status, there = found
        multipliers = border_of(self.model, self.rest)(x, multipliers, pose, p)
        x, multipliers, step = chord(self.model, self.rest)(x, multipliers, pose, p)
        there = ca.if_else(step < FARTHEST, there, np.nan)
        status = ca.if_else(ca.logic_or(step < FARTHEST, status != 0), status, 6)
        symbols = symbols_of(self.model, self.rest, x, multipliers, pose, p)
        outputs = {name: there * out for name, out in _outputs(self.model, symbols).items()}
        return _function("cable", inputs, outputs | {"status": status})

    def equations(self, *, parameters: bool | str | Sequence[str] = False) -> ca.Function:
        """The equations of an equilibrium, to transcribe many poses in one problem of the user's.

        (x, multipliers, pose[, parameters]) -> (residual, balance, conditions, lengths, points,
        ...): as many equations as unknowns. Every stationary point of the energy is a root, stable
        or not. `initial` gives a first guess. The unknowns need no bounds.

        Parameters
        ----------
        parameters : bool, str or sequence of str
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
        unit, pose, lengths = node.normalised(x), inputs["pose"], node.excess(x)
        symbols = symbols_of(self.model, self.rest, unit, multipliers, pose, p)
        rows = balance(self.model, symbols)
        outputs = {
            "residual": ca.vertcat(rows, lengths),
            "balance": ca.reshape(rows[: rows.numel() - k], node.increment, -1),
            "conditions": rows[rows.numel() - k :],
            "lengths": lengths,
        }
        inputs = {"x": x, "multipliers": multipliers, **inputs}
        return _function("equations", inputs, outputs | _outputs(self.model, symbols))

    def initial(self, pose: ArrayLike, *, branch: Branch | None = None) -> PoseUnknowns:
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
            If the pose has the wrong number of entries, or if the branch is unknown.
        """
        try:
            numbers = np.asarray(pose, float).ravel()
        except (TypeError, ValueError):
            raise DloError(f"pose: numbers belong here, found {pose!r}") from None
        if len(numbers) != pose_size(self.model):
            size = counted(pose_size(self.model), "number")
            raise DloError(f"pose: {size} as in dlo_pose of the C header, found {len(numbers)}")
        self._check_branch(branch)
        held = pose_of(self.model, numbers, branch)
        found = solve_equilibrium(self.model, self.p, self.rest, held)
        return PoseUnknowns(found.x.T, found.multipliers)

    def _check_branch(self, branch: Branch | None) -> None:
        if not (branch is None or (isinstance(branch, str) and branch in self.model.node.branches)):
            raise DloError(f"branch must be 'ccw', 'cw' (in a plane) or None, found {branch!r}")

    def _check_search(self, search: ca.Function, *, with_others: bool) -> None:
        if not isinstance(search, ca.Function):
            raise DloError(f"search is a casadi.Function, found {search!r}")
        if with_others:
            raise DloError(
                "search is the generated C, which has its own parameters and branch: leave out "
                "`parameters` and `branch`\n  Try: dlo_equilibrium_ccw or _cw for a branch"
            )
        sizes = [search.size_in(i) for i in range(search.n_in())]
        sizes += [search.size_out(i) for i in range(search.n_out())]
        expected = [(pose_size(self.model), 1), *search_sizes(self.model)]
        if sizes != expected:
            raise DloError(
                f"search has inputs and outputs of the sizes {sizes}, this cable needs {expected}\n"
                '  Try: casadi.external("dlo_equilibrium", library) of this very cable.'
            )

    def _inputs(self, parameters: bool | str | Sequence[str]) -> tuple[dict[str, Any], Any]:
        """Symbols of the pose and of the parameters asked for, and all parameters."""
        known = self.model.names
        if wrong := ["clips"] * bool(self.model.clips) + ["obstacles"] * bool(self.model.surfaces):
            said = " and ".join(wrong)
            raise DloError(f"a function of the pose has no {said} yet.\n  Try: solve(...).")
        if not isinstance(parameters, bool | str | list | tuple):
            text = "True, False or names of parameters belong here, found"
            raise DloError(f"parameters: {text} {parameters!r}")
        asked = [parameters] if isinstance(parameters, str) else parameters
        names = known if asked is True else tuple(asked or ())
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


def _outputs(model: CableModel, symbols: PoseSymbols) -> dict[str, Any]:
    """Output quantities of a shape for users, by name."""
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
    """(strains) -> curvatures (n_cells + 2,) of cells and both ends, see `curvatures_along`."""
    cells, weights = continued(Clipped.none(model.chain, 1))
    to_ends = np.zeros((cells.shape[1], model.chain.n_cells))
    np.add.at(to_ends, (np.arange(len(to_ends))[:, None], cells[0]), weights[0])
    strains = ca.SX.sym("strains", len(model.node.strains), model.chain.n_cells)
    in_cells = model.node.bend(strains[-len(model.node.curvatures) :, :]).T
    start, end = ca.vertsplit(ca.mtimes(ca.sparsify(ca.DM(to_ends)), in_cells))
    signed = ca.vertcat(start, in_cells, end)
    return ca.Function("curvature", [strains], [ca.sqrt(signed**2 + STRAIGHT**2)])
