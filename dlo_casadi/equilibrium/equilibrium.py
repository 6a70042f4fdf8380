"""The equilibrium of a cable in one pose: its shape, forces, energy and stability."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from dlo_casadi.arrays import BoolArray, FloatArray, IntArray
from dlo_casadi.equilibrium.pose import SIGNS, Branch
from dlo_casadi.model.assembly import Inputs, Shapes, assembly_of
from dlo_casadi.model.cable_model import CableModel
from dlo_casadi.model.clips import ClipLoad
from dlo_casadi.model.contact import Contact
from dlo_casadi.rod.ends import reaction_rows

# Largest angle between neighbouring headings (Eq. 8; joints only) [rad].
JOINT_BOUND = np.pi / 2
# Largest violation of an end condition [m or rad] of an accepted equilibrium.
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
        linearly to both ends and to clamped clips. Its error is of second order in the cell length.
    residual : float
        Largest violation of an end condition [m or rad].
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

    @property
    def shapes(self) -> Shapes:
        """Stacked unknowns of this one pose, with its ends as declared."""
        return Shapes.declared(self.x[None], self.multipliers[None], len(self.clips))

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


def places_along(cells: FloatArray, clamped: Sequence[int] = ()) -> FloatArray:
    """Arc lengths (K,) [m] of `curvatures_along` of cells (n_cells, 2) [m]."""
    own = [cells[stretch] for stretch in _stretches(len(cells), clamped)]
    return np.concatenate([[x[0, 0], *x.mean(axis=1), x[-1, 1]] for x in own])


def curvatures_along(
    curvature: FloatArray, cells: FloatArray, clamped: Sequence[int] = ()
) -> FloatArray:
    """Sizes (..., K) [1/m] of curvatures (..., axes n_cells) that are means over cells.

    They are continued linearly to both ends of each stretch, see `Equilibrium.min_bend_radius`; the
    curvature jumps at clamped clips. `cells` (..., n_cells, 2) [m]. `clamped`: indices of the cells
    that start at clamped clips.
    """
    widths = np.diff(cells, axis=-1)[..., 0]
    inner = curvature.reshape((*curvature.shape[:-1], -1, widths.shape[-1]))
    known = inner[..., 0, :] if inner.shape[-2] == 1 else np.linalg.norm(inner, axis=-2)
    parts = []
    for stretch in _stretches(widths.shape[-1], clamped):
        own, width = known[..., stretch], widths[..., stretch]
        ends = []
        for outer, beside in ((0, 1), (-1, -2)) if own.shape[-1] > 1 else ((0, 0), (-1, -1)):
            share = width[..., [outer]] / (width[..., [outer]] + width[..., [beside]])
            ends.append(own[..., [outer]] + share * (own[..., [outer]] - own[..., [beside]]))
        parts += [ends[0], own, ends[1]]
    return np.abs(np.concatenate(parts, axis=-1))


def _stretches(n_cells: int, clamped: Sequence[int]) -> list[slice]:
    """Cells between clamped clips."""
    return [slice(*both) for both in pairwise((0, *clamped, n_cells))]


def equilibria_of(
    model: CableModel,
    shapes: Shapes,
    given: Inputs,
    *,
    stable: BoolArray,
    iterations: IntArray,
    bound_multipliers: FloatArray | None = None,
) -> list[Equilibrium]:
    """Equilibria of m shapes.

    Parameters
    ----------
    stable : (m,) bool
    iterations : (m,) int
    bound_multipliers : (m, n_nodes - 1) [N m], optional
        Zero if they are not given.
    """
    assembly, chain, node = assembly_of(model), model.chain, model.node
    total, force, _ = assembly.balance(shapes, given)
    energies = total - assembly.work(shapes, force)
    if touching := assembly.touching(shapes, given):
        energies += touching.given_way
    residuals = np.abs(force.y[..., 0]).max(axis=1, initial=0.0)
    strains = assembly.strain(shapes, given)
    on_fixtures, rows = assembly.reactions(shapes, given), reaction_rows(node)
    points = assembly.nodes(shapes, given)
    clipped = assembly.clipped(shapes, given)
    on_clips, contacts = assembly.clip_loads(shapes, given), assembly.contacts(shapes, given)
    if bound_multipliers is None:
        bound_multipliers = np.zeros((len(shapes.x), chain.n_nodes - 1))
    out = []
    for j in range(len(shapes.x)):
        curvature = chain.curvatures(strains[j]).ravel()
        sizes = curvatures_along(curvature, clipped.cells[j], clipped.clamped_nodes(j))
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
                bound_multipliers=bound_multipliers[j],
                curvature=curvature,
                twist=strains[j, : chain.n_cells] if twisted else np.zeros(chain.n_cells),
                min_bend_radius=1 / max(float(sizes.max()), 1e-300),
                residual=float(residuals[j]),
                stable=bool(stable[j]),
                iterations=int(iterations[j]),
                clips=on_clips[j],
                contacts=contacts[j],
            )
        )
    return out
