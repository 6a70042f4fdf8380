"""Random cables in the poses of a configuration, for the scripts that count what is found."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from dlo_casadi.config import Config
from dlo_casadi.equilibrium.batch import BatchEquilibrium
from dlo_casadi.equilibrium.curve import Observed
from dlo_casadi.estimation.prediction import predict_poses
from dlo_casadi.model.assembly import Shapes
from dlo_casadi.model.cable_model import CableModel
from dlo_casadi.model.tolerances import Tolerances

# Waves of the rest curvature along the cable.
WAVES = 4


def random_session(
    config: Config,
    model: CableModel,
    stiffness: float,
    generator: np.random.Generator,
    curvature: float,
    hidden: Mapping[str, float] | None = None,
    tolerances: Tolerances | None = None,
) -> list[Observed] | None:
    """Measurements of each pose; None if one has no stable equilibrium.

    What a model has within tolerances, its rest curvature and the ends of each pose are drawn.

    Parameters
    ----------
    stiffness : float [N m^2]
    curvature : float [turns]
        Standard deviation of each wave of the rest curvature, over the length.
    hidden : mapping, optional
        Values of other parameters by their qualified names.
    tolerances : Tolerances, optional
        Those within which all fixtures are off, clamps included; by default only the ends are, by
        the configuration's tolerance.
    """
    p = model.nominal.copy()
    p[0] = stiffness
    for k, q in enumerate(model.parameters):
        if np.isfinite(q.prior_std) and not q.log:
            p[k] += q.prior_std * generator.standard_normal()
    for name, value in (hidden or {}).items():
        p[model.names.index(name)] = value
    length = model.cable.length
    places = model.chain.cells.mean(axis=1) / length
    waves: NDArray[np.floating] = np.cos(np.pi * np.arange(WAVES)[:, None] * places)
    node = model.node
    rest = np.concatenate(
        [
            generator.normal(0, curvature, WAVES) @ waves * 2 * np.pi / length
            if name in node.curvatures
            else np.zeros(len(places))
            for name in node.strains
        ]
    )
    poses = [pose.held for pose in config.experiment.poses]
    found = [item for item in predict_poses(model, p, rest, poses) if item is not None]
    if len(found) < len(poses) or not all(item.equilibrium.stable for item in found):
        return None
    deviation = np.zeros((len(poses), len(model.deviation_names)))
    if tolerances is None:
        off = generator.standard_normal((len(poses), 2))
        deviation[:, :2] = config.experiment.tolerances.end * off
    else:
        std = tolerances.deviation(model)
        used = np.isfinite(std) & np.isin(model.deviation_names, model.deviations)
        deviation[:, used] = std[used] * generator.standard_normal((len(poses), used.sum()))
    shapes = Shapes(
        np.array([item.equilibrium.x for item in found]),
        np.array([item.equilibrium.multipliers for item in found]),
        deviation,
    )
    equilibria = BatchEquilibrium(model, poses)
    shapes, converged = equilibria.solve(shapes, p, rest)
    return equilibria.seen(shapes, p, rest) if converged.all() else None
