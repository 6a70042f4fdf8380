"""Shapes of many poses as unknowns of a user's own CasADi problem."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from dlo_casadi.arrays import FloatArray
from dlo_casadi.equilibrium.curve import interpolant
from dlo_casadi.equilibrium.equilibrium import Equilibrium
from dlo_casadi.equilibrium.equilibrium import continued as continued_to
from dlo_casadi.equilibrium.implicit import pose_of, pose_size, symbols_of
from dlo_casadi.equilibrium.numbers import CableNumbers
from dlo_casadi.equilibrium.pose import Branch, HeldPose, pose_branch, pose_numbers
from dlo_casadi.equilibrium.solve import continued, solve_equilibrium
from dlo_casadi.errors import DloError, counted
from dlo_casadi.model.cable_model import CableModel
from dlo_casadi.model.clipped import Clipped
from dlo_casadi.model.functions import functions_of
from dlo_casadi.model.pose_system import PoseRows, pose_rows
from dlo_casadi.model.whole_pose import PoseSymbols, end_arguments
from dlo_casadi.rod.node import STRAIGHT, Frame


@dataclass(frozen=True, eq=False)
class TranscribedShape:
    """A pose's shape in a user's problem: expressions that hold where its equations do.

    Parameters
    ----------
    points : (d, k) [m]
        Evenly spaced along the cable, from start to end.
    start_force, end_force : (d,) [N]
        Of the cable on whatever holds its ends.
    start_moment, end_moment : (1,) or (3,) [N m]
        Of the cable on what holds its ends, about the world's axes.
    energy : scalar [J]
    curvature : (n_cells + 2,) [1/m]
        As of `function`.
    x, multipliers : (coordinates, n_nodes), (n_border,)
        Unknowns, as of `equations`.
    nodes : (d, n + 1) [m]
        Unknowns, too: places of the element boundaries.
    """

    points: Any  # CasADi's MX
    start_force: Any
    end_force: Any
    start_moment: Any
    end_moment: Any
    energy: Any
    curvature: Any
    x: Any
    multipliers: Any
    nodes: Any


def transcribed(
    numbers: CableNumbers,
    opti: ca.Opti,
    poses: Sequence[ArrayLike] | ca.MX,
    *,
    branch: Branch | None,
    points: int | None,
    reach: float,
) -> tuple[TranscribedShape, ...]:
    """As `CasadiCable.transcribe`."""
    model = numbers.model
    columns = _columns(model, poses)
    if not isinstance(poses, ca.MX | ca.DM) and len(poses):
        branch = pose_branch(poses[0], branch)
    firsts = _first_shapes(numbers, [_first_value(opti, pose) for pose in columns], branch)
    found = []
    for pose, first in zip(columns, firsts, strict=True):
        x = opti.variable(*first.x.T.shape)
        multipliers = opti.variable(model.n_border)
        nodes = opti.variable(model.node.dimension, model.n + 1)
        opti.set_initial(x, first.x.T)
        opti.set_initial(multipliers, first.multipliers)
        opti.set_initial(nodes, first.points.T)
        unit = model.node.normalised(x)
        symbols = symbols_of(model, unit, multipliers, pose, numbers.p, numbers.rest)
        rows, start = pose_rows(model, symbols), pose[: model.node.dimension]
        equations = [rows.balance, rows.conditions, model.node.excess(x)]
        equations += [nodes[:, 0] - start, nodes[:, 1:] - nodes[:, :-1] - rows.steps]
        for each in equations:
            if each.numel():
                opti.subject_to(ca.vec(each) == 0)
        if model.end.place and not (model.slides or pose.is_constant()):
            chord = pose[model.node.dimension : 2 * model.node.dimension] - start
            opti.subject_to(ca.sumsqr(chord) <= (reach * model.cable.length) ** 2)
        own = outputs_of(model, symbols, rows, nodes, points)
        found.append(TranscribedShape(**own, x=x, multipliers=multipliers, nodes=nodes))
    return tuple(found)


def _columns(model: CableModel, poses: Sequence[ArrayLike] | ca.MX) -> list[Any]:
    """Poses as columns (MX), from a sequence of vectors or from a matrix with one a column."""
    given: Any = poses
    listed = ca.horzsplit(given) if isinstance(poses, ca.MX | ca.DM) else list(given)
    columns, size = [], pose_size(model)
    for k, pose in enumerate(listed):
        try:
            own = pose_numbers(pose)
            column = ca.vec(ca.MX(own if isinstance(own, ca.MX) else ca.DM(own)))
        except (TypeError, ValueError, NotImplementedError):
            raise DloError(f"pose {k + 1}: numbers or MX belong here, found {pose!r}") from None
        if column.numel() != size:
            raise DloError(
                f"pose {k + 1}: {counted(size, 'number')} as in dlo_pose of the C header, found "
                f"{column.numel()}\n  Try: a list of poses, or a matrix with one pose a column."
            )
        columns.append(column)
    return columns


def _first_value(opti: ca.Opti, pose: Any) -> FloatArray:
    """A pose at the first values of the problem's variables, and its parameters' values."""
    try:
        return np.array(opti.debug.value(pose, opti.initial()), dtype=float).ravel()
    except RuntimeError as error:
        reason = str(error).strip().splitlines()[-1]
        raise DloError(
            f"poses: they have no first value ({reason})\n"
            "  Try: opti.set_initial and opti.set_value before transcribe."
        ) from None


def _first_shapes(
    numbers: CableNumbers, firsts: Sequence[FloatArray], branch: Branch | None
) -> list[Equilibrium]:
    """Shapes of the first values: the first pose's own, and each other one's continued from it."""
    p, rest = (np.array(ca.evalf(x)).ravel() for x in (numbers.p, numbers.rest))
    found: list[Equilibrium] = []
    before: HeldPose | None = None
    for k, values in enumerate(firsts):
        pose = pose_of(numbers.model, values, branch)
        pose = replace(pose, name=f"pose {k + 1}")
        if before is None:
            found.append(solve_equilibrium(numbers.model, p, rest, pose))
        else:
            found.append(continued(numbers.model, p, rest, pose, before, found[-1].x))
        before = pose
    return found


def outputs_of(
    model: CableModel, s: PoseSymbols, rows: PoseRows, nodes: Any, count: int | None
) -> dict[str, Any]:
    """Quantities of a shape for users, by name; `nodes` (d, n + 1) [m].

    `count`: number of points along the cable; the nodes themselves for None.
    """
    _, forces, moments = functions_of(model).end_shape(*end_arguments(model, s))
    x = ca.reshape(s.x, model.node.coordinates, -1)
    bent = _curvature(model)(rows.strains)
    return {
        "points": nodes if count is None else points_along(model, x, nodes, rows.ratios, count),
        "start_force": forces[:, 0],
        "end_force": forces[:, 1],
        "start_moment": moments[:, 0],
        "end_moment": moments[:, 1],
        "energy": rows.energy,
        "curvature": bent,
    }


def points_along(model: CableModel, x: Any, nodes: Any, ratios: Any, count: int) -> Any:
    """Points (d, count) [m], evenly spaced from start to end, as of `NodeCurve`.

    A point depends on the two boundaries beside it and on the directions there. `x` (coordinates,
    n_nodes), `nodes` (d, n + 1) [m], `ratios` (1, n).
    """
    chain, n, d = model.chain, model.n, model.node.dimension
    u = np.linspace(0.0, n, count)
    element = np.minimum(u.astype(int), n - 1)
    weights = np.vander(u - element, 4, increasing=True) @ interpolant(smooth=chain.kind.smooth)
    own, places = np.zeros((4, n + 1, count)), np.arange(count)
    for k, weight in enumerate(weights.T):
        own[k, element + k % 2, places] = weight
    found = nodes @ ca.sparsify(ca.DM(own[0] + own[1]))
    if not chain.kind.smooth:
        return found
    # The nodes of smooth elements are their boundaries.
    ahead = _tangents(model, x)
    rates = ca.horzcat(ratios[0], (ratios[:, :-1] + ratios[:, 1:]) / 2, ratios[-1])
    slopes = chain.h * ahead * ca.repmat(rates, d, 1)
    return found + slopes @ ca.sparsify(ca.DM(own[2] + own[3]))


def _tangents(model: CableModel, x: Any) -> Any:
    """Unit tangents (d, n_nodes) of nodes, row by row."""
    if model.node is not Frame:
        return model.node.tangent(x)
    a, b, c, w = ca.vertsplit(x)
    return ca.vertcat(1 - 2 * (b * b + c * c), 2 * (a * b + w * c), 2 * (a * c - w * b))


@lru_cache
def _curvature(model: CableModel) -> ca.Function:
    """(strains) -> curvatures (n_cells + 2,) of cells and both ends, see `curvatures_along`."""
    cells, weights = continued_to(Clipped.none(model.chain, 1))
    to_ends = np.zeros((cells.shape[1], model.chain.n_cells))
    np.add.at(to_ends, (np.arange(len(to_ends))[:, None], cells[0]), weights[0])
    strains = ca.SX.sym("strains", len(model.node.strains), model.chain.n_cells)
    in_cells = model.node.bend(strains[-len(model.node.curvatures) :, :]).T
    start, end = ca.vertsplit(ca.mtimes(ca.sparsify(ca.DM(to_ends)), in_cells))
    signed = ca.vertcat(start, in_cells, end)
    return ca.Function("curvature", [strains], [ca.sqrt(signed**2 + STRAIGHT**2)])
