"""How far the next hanging of a pose may lie from its prediction."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtri

from dlo_casadi.equilibrium.batch import BatchEquilibrium
from dlo_casadi.equilibrium.curve import NodeCurve
from dlo_casadi.equilibrium.equilibrium import Equilibrium
from dlo_casadi.equilibrium.pose import Pose
from dlo_casadi.model.cable_model import CableModel
from dlo_casadi.model.rest_curvature import MODES, RestScatter, modes_of

FloatArray = NDArray[np.floating]

# Share of the next hangings inside the band, and the standard deviations to its edges.
COVERED = 0.9
EDGE = -float(ndtri((1 - COVERED) / 2))


@dataclass(frozen=True)
class Uncertainty:
    """What makes a prediction uncertain.

    Parameters
    ----------
    names : tuple of str
        Fitted parameters and `rest_curvature[k]`.
    covariance : (N, N)
        Of these, in SI units.
    scatter : mapping of str to float
        Standard deviation of where each fixture is, pose by pose, by the deviation's name.
    rest_scatter : RestScatter
    hanging : float [m]
        Standard deviation of a coordinate, root mean square along the cable, of what differs
        between hangings of a pose that was taken again and again; 0 where none was.
    """

    names: tuple[str, ...]
    covariance: FloatArray
    scatter: Mapping[str, float]
    rest_scatter: RestScatter
    hanging: float = 0.0

    @property
    def root(self) -> FloatArray:
        """Matrix A (N, N) with A A^T = `covariance`, which may be singular."""
        std = np.sqrt(np.maximum(np.diag(self.covariance), 1e-300))
        values, vectors = np.linalg.eigh(self.covariance / np.outer(std, std))
        return std[:, None] * vectors * np.sqrt(np.maximum(values, 0.0))

    def unknowns_in(self, model: CableModel) -> tuple[FloatArray, FloatArray]:
        """What each of `names` moves: parameters (n_parameters, N) and rests (n_rests, N)."""
        size = len(self.names)
        by_p, by_rest = np.zeros((len(model.names), size)), np.zeros((model.chain.n_rests, size))
        for k, name in enumerate(self.names):
            if name in model.names:
                by_p[model.names.index(name), k] = 1.0
            else:
                coefficient = int(name.removeprefix("rest_curvature[").removesuffix("]"))
                by_rest[:, k] = model.rest_basis[:, coefficient]
        return by_p, by_rest

    def scatter_in(self, model: CableModel) -> FloatArray:
        """Standard deviations of a model's deviations; 0 of pulls, of which nothing is known."""
        scatter = np.array([self.scatter.get(name, 0.0) for name in model.deviations])
        return np.where(np.isfinite(scatter), scatter, 0.0)

    def rest_modes_in(self, model: CableModel) -> FloatArray:
        """Rest curvatures (n_rests, axes MODES) of a hanging's own, one standard deviation each."""
        modes = modes_in(model)
        return modes * np.tile(self.rest_scatter.sizes, modes.shape[1] // MODES)


def modes_in(model: CableModel) -> FloatArray:
    """Modes of a hanging's own rest curvature in a model's cells: (n_rests, axes MODES)."""
    axes = np.eye(len(model.node.strains))[:, -len(model.node.curvatures) :]
    return np.kron(axes, modes_of(model.chain.cells, model.cable.length))


def displacements(
    model: CableModel,
    p: FloatArray,
    rest: FloatArray,
    pose: Pose,
    found: Equilibrium,
    uncertainty: Uncertainty,
    s: FloatArray,
) -> tuple[NodeCurve, FloatArray]:
    """Curve of a pose, and displacements (K, d, q) [m] of its places s [m] in the next hanging.

    Independent ones, a standard deviation of each. First order: the fitted parameters' covariance,
    the fixtures' scatter and the rest curvature of each hanging's own, carried to the shape by the
    equilibrium; what repeats of one pose differ by, the same all along.
    """
    equilibria = BatchEquilibrium(model, [pose])
    shapes, size = found.shapes, len(uncertainty.names)
    by_p, by_rest = uncertainty.unknowns_in(model)
    along = equilibria.directions(shapes, p, rest, by_p, by_rest)
    seen = equilibria.observe(shapes, p, rest, along)
    curve = NodeCurve.of(model.cable.length, seen.z[0])
    way = curve.moved(s, seen.slopes[0])
    moved: list[FloatArray] = [
        way[..., :size] @ uncertainty.root,
        way[..., size:] * uncertainty.scatter_in(model),
        np.broadcast_to(uncertainty.hanging * np.eye(curve.d), (len(s), curve.d, curve.d)),
    ]
    if uncertainty.rest_scatter.std > 0:
        modes = uncertainty.rest_modes_in(model)
        hanging = equilibria.observe(shapes, p, rest, equilibria.by_rest(shapes, p, rest, modes))
        moved.append(curve.moved(s, hanging.slopes[0]))
    return curve, np.concatenate(moved, axis=2)


def spread_across(curve: NodeCurve, s: FloatArray, moved: FloatArray) -> FloatArray:
    """Standard deviation (K, d - 1) [m] across the cable of `displacements` at places s [m].

    The noise of a measurement comes on top.
    """
    return np.linalg.norm(np.einsum("knd,kdq->knq", curve.normals(s), moved), axis=2)
