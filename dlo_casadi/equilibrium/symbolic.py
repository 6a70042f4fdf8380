"""A cable with fixed parameter values as CasADi functions, for the user's own problems."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from numbers import Real
from typing import Any, NamedTuple, Self

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from dlo_casadi.arrays import FloatArray
from dlo_casadi.equilibrium.implicit import (
    Numbers,
    border_of,
    chord,
    detached,
    pose_of,
    pose_size,
    search_of,
    search_sizes,
    symbols_of,
)
from dlo_casadi.equilibrium.numbers import CableNumbers, numbers_of
from dlo_casadi.equilibrium.pose import Branch, pose_branch, pose_numbers
from dlo_casadi.equilibrium.solve import solve_equilibrium
from dlo_casadi.equilibrium.transcription import TranscribedShape, outputs_of, transcribed
from dlo_casadi.errors import DloError, counted
from dlo_casadi.model.cable_model import CableModel
from dlo_casadi.model.pose_system import pose_rows
from dlo_casadi.model.whole_pose import PoseSymbols
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
        points: int | None = None,
    ) -> ca.Function:
        """The shape as a differentiable function of the pose, for the user's own CasADi problems.

        (pose[, parameters]) -> (points, end_force, end_moment, energy, min_bend_radius, curvature,
        start_force, start_moment, status), with exact first and second derivatives: for `ca.Opti`
        with IPOPT, `.map(n)`, any graph. The result is the stable equilibrium of lowest energy,
        which may jump from one pose to the next, unless `branch` or the pose's turns name one.

        Parameters
        ----------
        parameters : bool, str or sequence of str
            Whether the model's parameters, or those of them with these names, are a second input
            `parameters` (SI), in the order of `model.names` or of the names, in place of the fitted
            values. Further names: "mass" [kg]; "length" [m], at the same mass; "rest_curvature"
            [1/m], all coefficients of its spline, in space first about axis y, then about z, or one
            of them, "rest_curvature[0]". A cable that is straight at rest has one coefficient an
            axis, of a constant curvature.
        branch : "ccw" or "cw", optional
            In a plane, which way the cable turns from start to end. Between two clamps their
            headings fix the turn but not the equilibrium: the lowest one may jump.
        search : casadi.Function, optional
            Function that finds equilibria in place of Python: `casadi.external("dlo_equilibrium",
            library)`, or `dlo_equilibrium_ccw`, `_cw`, of this cable's generated C, compiled into a
            shared library. A pose then takes about 1 ms instead of 30 (20 elements, both ends
            clamped), the function can be serialised, and CasADi can write it and its derivatives as
            C (`Function.generate`).
        points : int, optional
            Number of points, evenly spaced from start to end, as `Shape.points`; by default the
            element boundaries, between which a bent cable is not straight: an element of length h
            and curvature k bulges by k h^2 / 8.

        Returns
        -------
        casadi.Function
            pose : as `Pose.vector`, and dlo_pose in the C header. In a plane (6,): start x, y, end
            x, y [m], start heading, end heading [rad]. In space (15,): start, end [m], their
            quaternions (x, y, z, w) of any length but zero, turns. What the boundary does not hold
            is ignored. Then the tension [N] beyond each end that slides.

            points : (d, n + 1) or (d, points) [m], from start to end.
            end_force, start_force : (d,) [N] of the cable on whatever holds its end, its start.
            end_moment, start_moment : (1,) or (3,) [N m], likewise, world axes.
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
            If a parameter or the branch is unknown, if there are fewer than two points, or if
            `search` has other sizes or is given with parameters or a branch, which it already has.
            The function itself raises nothing.

        Notes
        -----
        Derivatives are those of the implicit function theorem, see `implicit`. Without `search` the
        function calls Python, cannot be serialised, and keeps what it needs until the process ends.
        """
        _check_count(points)
        known, inputs = self._inputs(parameters)
        model, p, rest = known.model, known.p, known.rest
        pose, numbers = inputs["pose"], Numbers(p, rest)
        if search is None:
            self._check_branch(branch)
            found = detached(search_of(model, branch))(pose, p, rest)
        else:
            self._check_search(search, with_others=bool(parameters or branch))
            found = detached(search)(pose)
        x, multipliers, status, there = found
        multipliers = border_of(model, numbers)(x, multipliers, pose, *numbers.given)
        x, multipliers, step = chord(model, numbers)(x, multipliers, pose, *numbers.given)
        there = ca.if_else(step < FARTHEST, there, np.nan)
        status = ca.if_else(ca.logic_or(step < FARTHEST, status != 0), status, 6)
        symbols = symbols_of(model, x, multipliers, pose, p, rest)
        outputs = {name: there * out for name, out in _outputs(model, symbols, points).items()}
        return _function("cable", inputs, outputs | {"status": status})

    def equations(
        self, *, parameters: bool | str | Sequence[str] = False, points: int | None = None
    ) -> ca.Function:
        """The equations of an equilibrium, to transcribe many poses in one problem of the user's.

        (x, multipliers, pose[, parameters]) -> (residual, balance, conditions, lengths, points,
        ...): as many equations as unknowns. Every stationary point of the energy is a root, stable
        or not. `initial` gives a first guess. The unknowns need no bounds.

        Parameters
        ----------
        parameters, points
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
            points, end_force, end_moment, energy, min_bend_radius, curvature, start_force,
            start_moment : as of `function`, true where the residual is zero.

        Raises
        ------
        DloError
            If a parameter is unknown, or if there are fewer than two points.

        Notes
        -----
        The Hessian of a weighted sum of the residual is block-banded: neighbouring nodes, and a
        border of the multipliers and the pose. That of a function of `points` is dense, because a
        point depends on all nodes before it; `transcribe` makes the places unknowns instead.

        Between ball joints in space a cable that is straight at rest may roll about its axis: the
        equations are then singular.
        """
        _check_count(points)
        known, inputs = self._inputs(parameters)
        model, node, pose = known.model, known.model.node, inputs["pose"]
        x = ca.MX.sym("x", node.coordinates, model.chain.n_nodes)
        multipliers = ca.MX.sym("multipliers", model.n_border)
        unit, lengths = node.normalised(x), node.excess(x)
        symbols = symbols_of(model, unit, multipliers, pose, known.p, known.rest)
        rows = pose_rows(model, symbols)
        outputs = {
            "residual": ca.vertcat(ca.vec(rows.balance), rows.conditions, lengths),
            "balance": rows.balance,
            "conditions": rows.conditions,
            "lengths": lengths,
        }
        inputs = {"x": x, "multipliers": multipliers, **inputs}
        return _function("equations", inputs, outputs | _outputs(model, symbols, points))

    def transcribe(
        self,
        opti: ca.Opti,
        poses: Sequence[ArrayLike] | ca.MX,
        *,
        points: int | None = None,
        branch: Branch | None = None,
        reach: float = 0.95,
    ) -> tuple[TranscribedShape, ...]:
        """Add the shapes of many poses to a problem: unknowns, first values and equations.

        The places of the element boundaries are unknowns, too: all second derivatives couple only
        neighbours along the cable, also those of bounds on points.

        Parameters
        ----------
        opti : casadi.Opti
        poses : sequence of Pose, (6,) or (15,), or (6 or 15, K)
            In the order of the motion: poses, or vectors as of `function`, which may be expressions
            of the problem's variables and parameters; these have first values before. One matrix of
            CasADi has a pose in each column.
        points : int, optional
            Number of points of each shape, evenly spaced along the cable; by default the element
            boundaries.
        branch : "ccw" or "cw", optional
            In a plane, which way the cable turns in the first pose; by default its own.
        reach : float
            Where a pose is no number, its ends are at most this share of the length apart: nearly
            straight cables pull without bound, and IPOPT stalls there.

        Returns
        -------
        tuple of TranscribedShape
            Expressions of each pose: points, forces and moments on both ends, energy, curvature.

        Raises
        ------
        EquilibriumError
            If a pose has no equilibrium at the first values.
        DloError
            If a pose has another size or no first value, or if an argument is meaningless.

        Notes
        -----
        First values are equilibria: the first pose's own, and of each other pose the one that
        follows from the pose before when the ends are moved. See also `equations`.
        """
        _check_count(points)
        self._check_branch(branch)
        if not (isinstance(reach, Real) and 0 < reach < 1):
            raise DloError(f"reach: a share of the length between 0 and 1, found {reach!r}")
        numbers, _ = self._inputs(parameters=False)
        options = {"branch": branch, "points": points, "reach": float(reach)}
        return transcribed(numbers, opti, poses, **options)

    def initial(self, pose: ArrayLike, *, branch: Branch | None = None) -> PoseUnknowns:
        """Unknowns `x`, `multipliers` of `equations` at the stable equilibrium of a pose.

        Parameters
        ----------
        pose : Pose, (6,) or (15,)
            A pose, or its numbers as of `function`.
        branch : "ccw" or "cw", optional
            In a plane, which way the cable turns from start to end; by default the pose's own.

        Raises
        ------
        EquilibriumError
            If the pose has no equilibrium.
        DloError
            If the pose has the wrong number of entries, or if the branch is unknown.
        """
        branch = pose_branch(pose, branch)
        try:
            numbers = np.asarray(pose_numbers(pose), float).ravel()
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

    def _inputs(
        self, parameters: bool | str | Sequence[str]
    ) -> tuple[CableNumbers, dict[str, Any]]:
        """The cable's numbers, and symbols of the pose and of the parameters asked for."""
        model = self.model
        wrong = ["clips"] * bool(model.clips) + ["obstacles"] * bool(model.surfaces)
        if wrong:
            said = " and ".join(wrong)
            raise DloError(f"a function of the pose has no {said} yet.\n  Try: solve(...).")
        numbers = numbers_of(model, self.p, self.rest, parameters)
        inputs: dict[str, Any] = {"pose": ca.MX.sym("pose", pose_size(model))}
        if numbers.argument is not None:
            inputs["parameters"] = numbers.argument
        return numbers, inputs


def _check_count(points: int | None) -> None:
    whole = isinstance(points, int | np.integer) and not isinstance(points, bool)
    if points is not None and not (whole and points > 1):
        raise DloError(f"points: a whole number of at least 2, or None, found {points!r}")


# ---- expressions ---------------------------------------------------------------------------------


def _function(name: str, inputs: dict[str, Any], outputs: dict[str, Any]) -> ca.Function:
    return ca.Function(
        name, [*inputs.values()], [*outputs.values()], [*inputs], [*outputs], {"cse": True}
    )


def _outputs(model: CableModel, symbols: PoseSymbols, count: int | None) -> dict[str, Any]:
    """Output quantities of a shape for users, by name."""
    rows, every = pose_rows(model, symbols), np.triu(np.ones((model.n + 1, model.n + 1)))
    steps = ca.horzcat(symbols.pose[: model.node.dimension], rows.steps)
    found = outputs_of(model, symbols, rows, steps @ ca.sparsify(ca.DM(every)), count)
    order = ("points", "end_force", "end_moment", "energy")
    out = {name: found[name] for name in order}
    out["min_bend_radius"] = 1 / ca.mmax(found["curvature"])
    return out | {name: found[name] for name in ("curvature", "start_force", "start_moment")}
