"""A fitted cable: its model, its parameters, and how well they are known."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from dlo_casadi.equilibrium.spread import Uncertainty
from dlo_casadi.model.cable_model import CableModel

FloatArray = NDArray[np.floating]


@dataclass(frozen=True)
class Metadata:
    """What a parameters.yaml tells beside the model.

    Parameters
    ----------
    path : Path
    names : tuple of str
        Fitted parameters, in the order of `covariance`.
    covariance : (N, N)
        In the products of the parameters' units.
    uncertainty : Uncertainty
        The same with what differs from pose to pose.
    std : dict
        Standard deviation of each parameter by name [SI]; 0 where it was not fitted.
    coefficients : (n_coefficients,) [1/m]
        Of the rest curvature before the first pose; in space about the axis y, then about z.
    fixtures : dict
        What all poses of the session share of `start` [m] and `start_heading`, `end_heading` [rad],
        in space `start_orientation`, `end_orientation`.
    identifiable : bool or None
        Whether the shapes determine the bending stiffness.
    interval_95 : (float or None, float or None) or None [N m^2]
        Of the bending stiffness; None in it = unbounded.
    model_hash : str
        As written; see `parameters_hash`.
    edited : bool
        Whether the model is no longer the one that was written.
    config : str
        Name of the configuration.
    versions : dict
    document : dict
        The whole file.
    """

    path: Path
    names: tuple[str, ...]
    covariance: FloatArray
    uncertainty: Uncertainty
    std: dict[str, float]
    coefficients: FloatArray
    fixtures: dict[str, Any]
    identifiable: bool | None
    interval_95: tuple[float | None, float | None] | None
    model_hash: str
    edited: bool
    config: str
    versions: dict[str, str]
    document: dict[str, Any]


class FittedCable(NamedTuple):
    """A fitted cable as parameters.yaml holds it: `model, p, rest, metadata = ...`.

    Parameters
    ----------
    model : CableModel
    p : (n_parameters,)
        In the order of `model.names` (SI).
    rest : (n_rests,) [1/m]
        Rest curvature that the next pose finds; in space the rest strains twist, k_y, k_z of all
        cells in turn.
    metadata : Metadata
    """

    model: CableModel
    p: FloatArray
    rest: FloatArray
    metadata: Metadata

    @property
    def std(self) -> dict[str, float]:
        """Standard deviations by name (SI)."""
        return self.metadata.std

    @property
    def document(self) -> dict[str, Any]:
        """The whole file."""
        return self.metadata.document
