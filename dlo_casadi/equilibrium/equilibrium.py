"""The equilibrium of a cable in one pose: its shape, forces, energy and stability."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from dlo_casadi.arrays import BoolArray, FloatArray, IntArray
from dlo_casadi.equilibrium.pose import SIGNS, Branch
from dlo_casadi.model.assembly import Assembly, Shapes
from dlo_casadi.model.clipped import Clipped
from dlo_casadi.model.clips import ClipLoad
from dlo_casadi.model.contact import Contact
from dlo_casadi.model.functions import functions_of
from dlo_casadi.rod.ends import reaction_rows

# Largest angle between neighbouring headings (Eq. 8; joints only) [rad].
JOINT_BOUND = np.pi / 2
# Largest violation of an end condition of an accepted equilibrium [lengths or rad].
END_TOLERANCE = 1e-8
# Largest imbalance of an accepted equilibrium, relative to the tangent matrix.
BALANCE = 1e-12
# Turn of the cable [rad] below which it is on either branch: rounding decides its sign.
NO_TURN = 1e-9
# Largest difference of two shapes that count as the same one [rad].
NEARBY = 0.05


@dataclass(frozen=True)
class Equilibrium:
    """Shape of the cable in one pose.

    Parameters
    ----------
    x : (n_nodes, coordinates)
        States of the nodes: of a planar cable, absolute headings [rad].
    points : (n + 1, dimension) [m]
        Nodes from start to end.
    energy : float [J]
    end_force : (dimension,) [N]
        Force of the cable on whatever holds its end; zero at a free end.
    start_force : (dimension,) [N]
        Force of the cable on whatever holds its start.
    moments : (2, increment) [N m]
        Of the cable on whatever holds it (start, end); zero at pins without springs. In space
        about the world's axes. In a plane (2,).
    multipliers : (n_border,)
        Of the end conditions, then unknowns of springs and clips: see `model.border_names`.
    bound_multipliers : (n_nodes - 1,) [N m]
        Of the joint bounds; zero where a joint bends freely.
    curvature : (axes n_cells,) [1/m]
        Mean curvature of each bending cell, in space about the axis y, then about z.
    twist : (n_cells,) [1/m]
        Mean twist of each cell; zero in a plane.
    min_bend_radius : float [m]
        Smallest radius of curvature along the cable, from the cells' mean curvatures, continued
        linearly to both ends and to all clips, see `continued`. Its error is of second order in the
        cell length.
    residual : float
        Largest violation of a condition of the border: of ends, clips and contacts [m or rad], of
        springs and eyelets also a force that does not balance [N].
    stable : bool
        Whether the energy has a strict minimum here under the end conditions.
    iterations : int
    other_side : Equilibrium or None
        The stable equilibrium of the same pose on its other side, see `CableModel.tipped_by`;
        None where there is none, and where the pose names its side.
    clips : tuple of ClipLoad
        What the cable does to its clips, in their order.
    contacts : tuple of Contact
        Where the cable touches obstacles, from its start to its end.
    fed : float [m]
        Length of the cable that was fed through ends that slide: free minus declared length.
    near : (number of eyelets,) [m]
        See `Shapes`.
    """

    x: FloatArray
    points: FloatArray
    energy: float
    end_force: FloatArray
    start_force: FloatArray
    moments: FloatArray
    multipliers: FloatArray
    bound_multipliers: FloatArray
    curvature: FloatArray
    twist: FloatArray
    min_bend_radius: float
    residual: float
    stable: bool
    iterations: int
    other_side: "Equilibrium | None" = None
    clips: tuple[ClipLoad, ...] = ()
    contacts: tuple[Contact, ...] = ()
    fed: float = 0.0
    near: FloatArray = field(default_factory=lambda: np.zeros(0))

    @property
    def shapes(self) -> Shapes:
        """Stacked unknowns of this one pose, with its ends as declared."""
        return stacked([self])

    @property
    def phi(self) -> FloatArray:
        """Absolute headings (n_nodes,) [rad] of a planar cable."""
        return self.x[:, 0]

    @property
    def turn(self) -> float:
        """Last minus first heading [rad], counter-clockwise positive."""
        return float(self.phi[-1] - self.phi[0])

    def has_branch(self, branch: Branch | None) -> bool:
        """Whether the cable turns as the branch says, or not at all; always for None."""
        return branch is None or SIGNS[branch] * self.turn > -NO_TURN


def stacked(equilibria: Sequence[Equilibrium]) -> Shapes:
    """Shapes of some equilibria of a model, with their ends as declared."""
    x, lam, near = zip(*((eq.x, eq.multipliers, eq.near) for eq in equilibria), strict=True)
    found = Shapes.declared(np.array(x), np.array(lam), len(equilibria[0].clips))
    return replace(found, near=np.array(near))


def with_equilibrium(shapes: Shapes, index: Any, eq: Equilibrium) -> Shapes:
    """Shapes with an equilibrium for one of the poses, its ends as declared."""
    still = np.zeros_like(shapes.deviation[:1])
    return shapes.replaced([index], replace(eq.shapes, deviation=still))


def places_along(clipped: Clipped) -> FloatArray:
    """Arc lengths (m, K) [m] of `curvatures_along`."""
    return np.concatenate([clipped.cells.mean(axis=2), clipped.kinks[0]], axis=1)


def curvatures_along(curvature: FloatArray, clipped: Clipped) -> FloatArray:
    """Sizes (m, K) [1/m] of curvatures (m, axes, n_cells) that are means over cells.

    First those of the cells, then those at `Clipped.kinks`, see `continued`.
    """
    known = curvature[:, 0] if curvature.shape[1] == 1 else np.linalg.norm(curvature, axis=1)
    cells, weights = continued(clipped)
    beside = known[np.arange(len(known))[:, None, None], cells]
    return np.abs(np.concatenate([known, (weights * beside).sum(axis=2)], axis=1))


def continued(clipped: Clipped) -> tuple[IntArray, FloatArray]:
    """Cells (m, K, 5) and weights by which their mean curvatures give those at `Clipped.kinks`.

    The curvature k at the place s inside a cell c is linear from the middles of the cells beside c
    to s. Its mean over c is known; with the pieces a_i of c on both sides of s, c's width w and the
    distances d_i from s to these middles,

        k = (K_c - sum_i A_i K_i) / (1 - sum_i A_i),    A_i = a_i^2 / (2 w d_i)

    At an end of a cell this is the line through the means of c and the cell before. Towards that
    end, half the line through the two cells beyond is blended in: k is smooth in s. There is no
    cell beyond an end or a clamped clip, where the curvature jumps.
    """
    (at, own), cells = clipped.kinks, clipped.cells
    nodes, count = clipped.clamped[:, None], cells.shape[1]
    first = np.where(nodes <= own[..., None], nodes, 0).max(axis=2, initial=0)[..., None]
    last = np.where(nodes > own[..., None], nodes, count).min(axis=2, initial=count)[..., None]
    index = own[..., None] + np.arange(-2, 3)
    exists, index = (index >= first) & (index < last), index.clip(0, count - 1)
    low, high = np.moveaxis(cells[np.arange(len(cells))[:, None, None], index], -1, 0)
    middle, width = (low + high) / 2, (high - low)[..., 2]
    x = ((at - low[..., 2]) / width).clip(0.0, 1.0)
    s = low[..., 2] + x * width
    inside, beyond = np.zeros(index.shape), np.zeros(index.shape)
    inside[..., 2] = 1.0
    for share, near, far in ((x, 1, 0), (1 - x, 3, 4)):
        away = np.where(exists[..., near], np.abs(s - middle[..., near]), np.inf)
        apart = np.where(exists[..., far], np.abs(middle[..., far] - middle[..., near]), np.inf)
        inside[..., near] = -(share**2) * width / (2 * away)
        u = np.maximum(1 - 2 * share, 0.0)
        half = np.where(exists[..., far], u * u * (3 - 2 * u) / 2, 0.0)
        ratio = np.where(exists[..., far], away, 0.0) / apart
        beyond[..., near] = half * (1 + ratio)
        beyond[..., far] = -half * ratio
    inside *= ((1 - beyond.sum(axis=2)) / inside.sum(axis=2))[..., None]
    return index, inside + beyond


def _fed(found: Assembly) -> FloatArray:
    """True length (m,) [m] without load that was fed through ends that slide."""
    clipped, m = found.clipped, len(found.shapes.x)
    if not found.model.slides or not m:
        return np.zeros(m)
    stretch = functions_of(found.model).stretch.map(m)(found.given.p.T)
    fed = clipped.held[:, -1] - clipped.held[:, 0] - found.model.chain.length
    return np.asarray(np.array(stretch)[0] * fed)


def equilibria_of(found: Assembly, *, stable: BoolArray, iterations: IntArray) -> list[Equilibrium]:
    """Equilibria of m shapes, whose joints bend freely; `stable` and `iterations` (m,)."""
    shapes, chain, node = found.shapes, found.model.chain, found.model.node
    total, force, _ = found.balance()
    energies = total - found.work(force)
    if found.touching:
        energies += found.touching.given_way
    residuals = np.abs(force.y[..., 0]).max(axis=1, initial=0.0)
    strains, points = found.strain(), found.nodes()
    on_fixtures, rows = found.reactions(), reaction_rows(node)
    curvatures = chain.curvatures(strains)
    sizes = curvatures_along(curvatures, found.clipped).max(axis=1)
    on_clips, contacts = found.clip_loads(), found.contacts()
    fed = _fed(found)
    out = []
    for j in range(len(shapes.x)):
        moments = [on_fixtures[j, rows[f"{side}_moment"]] for side in ("start", "end")]
        twisted = "twist" in node.strains
        out.append(
            Equilibrium(
                x=shapes.x[j],
                points=points[j],
                energy=float(energies[j]),
                end_force=on_fixtures[j, rows["end_force"]],
                start_force=on_fixtures[j, rows["start_force"]],
                moments=np.squeeze(np.array(moments)),
                multipliers=shapes.lam[j],
                bound_multipliers=np.zeros(chain.n_nodes - 1),
                curvature=curvatures[j].ravel(),
                twist=strains[j, : chain.n_cells] if twisted else np.zeros(chain.n_cells),
                min_bend_radius=1 / max(float(sizes[j]), 1e-300),
                residual=float(residuals[j]),
                stable=bool(stable[j]),
                iterations=int(iterations[j]),
                clips=on_clips[j],
                contacts=contacts[j],
                fed=float(fed[j]),
                near=found.clipped.near[j, [*found.model.sliding]],
            )
        )
    return out
