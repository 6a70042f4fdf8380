"""How near a clamp is to the angle at which a cable hangs as low on either side."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dlo_casadi.equilibrium.equilibrium import Equilibrium, tipping, tipping_lever
from dlo_casadi.equilibrium.pose import Pose
from dlo_casadi.equilibrium.solve import ways_of
from dlo_casadi.equilibrium.spread import Uncertainty
from dlo_casadi.model.assembly import Inputs, Shapes, assembly_of
from dlo_casadi.model.cable_model import CableModel
from dlo_casadi.thresholds import EITHER

FloatArray = NDArray[np.floating]

# Share of a standard deviation over which energies are differentiated.
_SHARE = 1e-3


@dataclass(frozen=True)
class Tipping:
    """How near a clamp is to the angle at which a cable hangs as low on its other side.

    Parameters
    ----------
    angle, std : float [rad]
        How far the clamp is from there, and how well that is known.
    """

    angle: float
    std: float

    @property
    def either(self) -> bool:
        """Whether nobody knows which side is the lower one."""
        return self.angle < EITHER * self.std


def tipping_of(
    model: CableModel,
    p: FloatArray,
    rest: FloatArray,
    pose: Pose,
    eq: Equilibrium,
    other: Equilibrium,
    uncertainty: Uncertainty,
) -> Tipping:
    """How near a pose is to the other of two equilibria on either side.

    First order, from all that makes a prediction uncertain: the slope of an equilibrium's energy
    by anything is that of the Lagrangian at fixed nodes and multipliers.
    """
    roots = uncertainty.root
    by_p, by_rest = (by @ roots for by in uncertainty.unknowns_in(model))
    scatter = uncertainty.scatter_in(model)
    own = uncertainty.rest_modes_in(model)
    used = [model.deviation_names.index(name) for name in model.deviations]
    by_deviation = np.zeros((len(model.deviation_names), len(scatter)))
    by_deviation[used, np.arange(len(scatter))] = scatter
    n, m = roots.shape[1], len(scatter)
    count = n + m + own.shape[1]
    steps = [np.zeros((count, size)) for size in (len(p), len(rest), len(by_deviation))]
    steps[0][:n], steps[1][:n] = by_p.T, by_rest.T
    steps[2][n : n + m], steps[1][n + m :] = by_deviation.T, own.T
    ways = [_SHARE * np.concatenate([step, -step]) for step in steps]
    given = Inputs.of(p + ways[0], rest + ways[1], np.tile(pose.vector, (2 * count, 1)))
    slopes = []
    for found in (eq, other):
        x = np.broadcast_to(found.x, (2 * count, *found.x.shape))
        lam = np.broadcast_to(found.multipliers, (2 * count, len(found.multipliers)))
        value = assembly_of(model).balance(Shapes(x, lam, ways[2]), given)[0]
        slopes.append((value[:count] - value[count:]) / (2 * _SHARE))
    std = float(np.linalg.norm(slopes[1] - slopes[0]))
    return Tipping(tipping(model, eq, other), std / tipping_lever(model, eq, other))


def sides_of(model: CableModel, pose: Pose, *pair: Equilibrium) -> list[Pose]:
    """A pose that tells the side of each of two equilibria on either side."""
    ways = ways_of(model, pose)
    turned = [float(model.node.turning(eq.x)) for eq in pair]
    return ways if turned[0] > turned[1] else ways[::-1]
