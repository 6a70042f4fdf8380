"""How far the next hanging of a pose may lie from its prediction."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtri

from dlo_casadi.equilibrium.batch import Sweep
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


def modes_in(model: CableModel) -> FloatArray:
    """The same as rest curvatures of a model's cells, axis by axis: (n_rests, axes MODES)."""
    axes = np.eye(len(model.node.strains))[:, -len(model.node.curvatures) :]
    return np.kron(axes, modes_of(model.chain.cells, model.cable.length))


def spread_across(
    model: CableModel,
    p: FloatArray,
    rest: FloatArray,
    pose: Pose,
    found: Equilibrium,
    uncertainty: Uncertainty,
    s: FloatArray,
) -> FloatArray:
    """Standard deviation (K, d - 1) [m] across the cable of the next hanging, at places s [m].

    First order: the fitted parameters' covariance, the fixtures' scatter and the rest curvature
    of each hanging's own, carried to the shape by the equilibrium; what repeats of one pose differ
    by, the same all along. The noise of a measurement comes on top.
    """
    sweep = Sweep(model, [pose])
    shapes, size = found.shapes, len(uncertainty.names)
    by_p, by_rest = np.zeros((len(p), size)), np.zeros((len(rest), size))
    for k, name in enumerate(uncertainty.names):
        if name in model.names:
            by_p[model.names.index(name), k] = 1.0
        else:
            coefficient = int(name.removeprefix("rest_curvature[").removesuffix("]"))
            by_rest[:, k] = model.rest_basis[:, coefficient]
    along = sweep.directions(shapes, p, rest, by_p, by_rest)
    seen = sweep.observe(shapes, p, rest, along)
    curve = NodeCurve.of(model.cable.length, seen.z[0])
    normals = curve.normals(s)

    def across(slopes: FloatArray) -> FloatArray:
        return np.einsum("knd,kdq->knq", normals, curve.moved(s, slopes))

    way = across(seen.slopes[0])
    fitted, own = way[..., :size], way[..., size:]
    variance = np.einsum("knq,qr,knr->kn", fitted, uncertainty.covariance, fitted)
    scatter = np.array([uncertainty.scatter.get(name, 0.0) for name in model.deviations])
    variance += ((own * np.where(np.isfinite(scatter), scatter, 0.0)) ** 2).sum(axis=2)
    if uncertainty.rest_scatter.std > 0:
        modes = modes_in(model)
        hanging = sweep.observe(shapes, p, rest, sweep.by_rest(shapes, p, rest, modes))
        sizes = np.tile(uncertainty.rest_scatter.sizes, modes.shape[1] // MODES)
        variance += ((across(hanging.slopes[0]) * sizes) ** 2).sum(axis=2)
    variance += uncertainty.hanging**2
    return np.sqrt(np.maximum(variance, 0.0))
