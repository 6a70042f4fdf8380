"""Estimated parameters, their uncertainty, and other contents of a fitted cable's file."""

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from dlo_casadi.arrays import FloatArray
from dlo_casadi.config import Limits
from dlo_casadi.equilibrium.spread import Uncertainty
from dlo_casadi.errors import DloError, counted
from dlo_casadi.show.text import plus_minus

Value = TypeVar("Value")


class Named(dict[str, Value]):
    """Values by name; for an unknown name a DloError lists the known ones."""

    def __missing__(self, name: str) -> Value:
        raise DloError(f"nothing is called {name!r}; there are {', '.join(self)}")


@dataclass(frozen=True)
class Estimate:
    """One parameter.

    Parameters
    ----------
    value, std : float
        In `unit`; std is 0 if the parameter was not estimated. Infinite if the value is the inverse
        of a parameter at zero.
    unit : str
    interval_95 : (float or None, float or None), optional
        Profile-likelihood interval; None for an unbounded side; absent if not computed.
    identifiable : bool, optional
        False if the interval is unbounded or spans more than a factor of ten. Without an interval:
        False if the measurements constrain it less than its bounds, whose width std then is.
    at_bound : bool
        Whether the value sits on a physical bound.
    fixed : bool
        Whether the parameter was kept at its value.
    """

    value: float
    std: float
    unit: str
    interval_95: tuple[float | None, float | None] | None = None
    identifiable: bool | None = None
    at_bound: bool = False
    fixed: bool = False

    def __str__(self) -> str:
        text = "unbounded" if math.isinf(self.value) else plus_minus(self.value, self.std)
        text = f"{text} {self.unit}".strip()
        if self.interval_95 is not None:
            low, high = ("unbounded" if x is None else f"{x:.4g}" for x in self.interval_95)
            text += f" (95 %: {low} to {high})"
        remarks = {
            "fixed": self.fixed,
            "at a bound": self.at_bound,
            "not identifiable": self.identifiable is False,
        }
        return ", ".join([text, *(remark for remark, holds in remarks.items() if holds)])

    def __repr__(self) -> str:
        return f"<Estimate {self}>"


@dataclass(frozen=True, eq=False)
class Covariance:
    """Covariance of estimates, by name: `covariance["bending_stiffness", "end_roll"]`.

    Parameters
    ----------
    names : (N,) tuple of str
        Fitted parameters, and `rest_curvature[k]` [1/m], its spline coefficients.
    values : (N, N)
        In products of the parameters' units.
    """

    names: tuple[str, ...]
    values: FloatArray

    def __getitem__(self, pair: tuple[str, str]) -> float:
        if not isinstance(pair, tuple) or len(pair) != 2:
            raise DloError(
                f"a covariance is of two names, found {pair!r}\n"
                "  Try: covariance[name, name] is the variance, `std` has its root."
            )
        if unknown := [name for name in pair if name not in self.names]:
            fitted = ", ".join(self.names) or "none"
            raise DloError(f"{unknown[0]!r} was not fitted; fitted are {fitted}")
        i, j = map(self.names.index, pair)
        return float(self.values[i, j])

    def __repr__(self) -> str:
        known = (f"  {name}: std {std:.3g}" for name, std in self.std.items())
        return "\n".join([f"<Covariance of {counted(len(self.names), 'estimate')}>", *known])

    @property
    def std(self) -> dict[str, float]:
        """Standard deviations by name."""
        roots = np.sqrt(np.maximum(np.diag(self.values), 0.0))
        return dict(zip(self.names, roots.tolist(), strict=True))

    @property
    def correlation(self) -> FloatArray:
        """Correlations (N, N); zero for exactly known values."""
        std = np.array(list(self.std.values()))
        scale = np.outer(std, std)
        return np.divide(self.values, scale, out=np.zeros_like(scale), where=scale > 0)


@dataclass(frozen=True)
class Metadata:
    """Contents of a parameters.yaml besides the model.

    Parameters
    ----------
    path : Path or None
        The file, or the session's.
    params : dict of Estimate
        All parameters of the model by name.
    covariance : Covariance
    uncertainty : Uncertainty
        The covariance together with the scatter from pose to pose.
    coefficients : (n_coefficients,) [1/m]
        Of the rest curvature before the first pose; in space first about axis y, then about z.
    fixtures : dict
        Those of `start` [m], `start_heading` and `end_heading` [rad], in space `start_orientation`
        and `end_orientation`, that are the same in all poses of the session.
    limits : Limits
        Limits declared in the session.
    explains : bool or None
        Whether the model explains the shapes it was fitted to; None where that was not judged.
    model_hash : str
        Hash in the file; see `parameters_hash`.
    edited : bool
        Whether the model has changed since the file was written.
    config : str
        Name of the configuration.
    document : dict
        The whole file.
    """

    path: Path | None
    params: dict[str, Estimate]
    covariance: Covariance
    uncertainty: Uncertainty
    coefficients: FloatArray
    fixtures: dict[str, Any]
    limits: Limits
    explains: bool | None
    model_hash: str
    edited: bool
    config: str
    document: dict[str, Any]
