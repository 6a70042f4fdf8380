"""What is known of a fitted cable beside its model."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from dlo_casadi.arrays import FloatArray
from dlo_casadi.cable.estimate import Covariance, Estimate
from dlo_casadi.equilibrium.spread import Uncertainty


@dataclass(frozen=True)
class Metadata:
    """Contents of a parameters.yaml beside the model.

    Parameters
    ----------
    path : Path or None
        The file, or the session's.
    params : dict of Estimate
        All parameters of the model by name.
    covariance : Covariance
    uncertainty : Uncertainty
        The same with the scatter from pose to pose.
    coefficients : (n_coefficients,) [1/m]
        Of the rest curvature before the first pose; in space about the axis y, then about z.
    fixtures : dict
        Those of `start` [m] and `start_heading`, `end_heading` [rad], in space `start_orientation`,
        `end_orientation`, that are the same in all poses of the session.
    explains : bool or None
        Whether the model explains the shapes it was fitted to; None where that was not judged.
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

    path: Path | None
    params: dict[str, Estimate]
    covariance: Covariance
    uncertainty: Uncertainty
    coefficients: FloatArray
    fixtures: dict[str, Any]
    explains: bool | None
    model_hash: str
    edited: bool
    config: str
    versions: dict[str, str]
    document: dict[str, Any]
