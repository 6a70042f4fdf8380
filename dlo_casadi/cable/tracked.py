"""A fitted cable that is tracked: its parameters pose by pose."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np

from dlo_casadi.cable.estimate import Covariance, Estimate, EstimatedCable
from dlo_casadi.cable.held import HELD, held_pose
from dlo_casadi.cable.saved import cable_document, parameters_hash
from dlo_casadi.config import Pose
from dlo_casadi.equilibrium.pose import HeldPose
from dlo_casadi.errors import DloError
from dlo_casadi.model.cable_model import CableModel
from dlo_casadi.tracking.known import Known
from dlo_casadi.tracking.measured import Noise
from dlo_casadi.tracking.tracker import Tracker

Cable = TypeVar("Cable", bound=EstimatedCable)


class TrackedCable(EstimatedCable):
    """A fitted cable that is tracked."""

    if TYPE_CHECKING:

        def solve(self, *pose: Any, **held: Any) -> Any:
            """See `FittedCable.solve`."""

    def tracker(
        self,
        std: float,
        *,
        force_std: float | None = None,
        moment_std: float | None = None,
        correlated: float = 0.0,
        forget: float = 1.0,
        drift: Mapping[str, float] | None = None,
        compiled: bool = False,
    ) -> Tracker:
        """Estimate the cable further, one pose after the other.

        Parameters
        ----------
        std : float [m]
            Standard deviation of one coordinate of a measured point.
        force_std, moment_std : float [N, N m], optional
            Of one component of a reading; without them readings are not used.
        correlated : float [m]
            Distance along a line at which errors of its points are correlated by 1/e: the report's
            `correlation_length_m`. Points with arc lengths have independent errors.
        forget : float
            Share of what is known that is kept from pose to pose, at most 1.
        drift : mapping of str to float, optional
            Standard deviation per pose of parameters that change slowly: {"bending_stiffness":
            1e-4}.
        compiled : bool
            Whether equilibria and their derivatives are found by compiled C; it takes some seconds
            to compile, in space up to a minute.

        Raises
        ------
        DloError
            If a value is impossible, if there is no such parameter, if nothing is uncertain, or if
            there is no C compiler.
        """
        _checked("std", std, "the noise of a coordinate [m]")
        for name, size in (("force_std", force_std), ("moment_std", moment_std)):
            if size is not None:
                _checked(name, size, "the noise of a component [N, N m]")
        if correlated:
            _checked("correlated", correlated, "a distance along the cable [m]")
        if not isinstance(forget, int | float) or not 0.5 <= forget <= 1:
            raise DloError(f"forget: 0.5 to 1 belongs here, found {forget!r}")
        if self.model.has_state:
            raise DloError("tracker: a rest shape that changes from pose to pose is not tracked")
        known = known_of(self)
        names = known.uncertainty.names
        if not names:
            raise DloError(
                "tracker: all parameters of this cable are exact.\n  Try: a fitted cable"
            )
        for name, value in (drift or {}).items():
            if name not in names:
                raise DloError(f"drift: {name!r} is not estimated.\n  Try: {', '.join(names)}")
            if not 0 <= float(value) < np.inf:
                raise DloError(f"drift: {name}: a standard deviation, found {value!r}")
        noise = Noise(float(std), force_std, moment_std, float(correlated))
        chosen = noise, float(forget), dict(drift or {}), compiled
        return Tracker(known, partial(_held, self), partial(with_known, self), *chosen)


def known_of(cable: EstimatedCable) -> Known:
    """Values of a cable and their uncertainty, without effects of photographs."""
    own = Known(cable.model, cable.p, cable.rest, cable.metadata.uncertainty)
    return own.without_photographs()


def with_known(cable: Cable, known: Known) -> Cable:
    """The cable with other values, in its parameters and its document, too."""
    old, model, own = cable.metadata, known.model, known.uncertainty
    found = Covariance(own.names, own.covariance)
    params = {
        q.name: Estimate(
            float(value), found.std.get(q.name, 0.0), q.unit, fixed=q.name not in own.names
        )
        for q, value in zip(model.parameters, known.p, strict=True)
    }
    coefficients = np.linalg.lstsq(model.rest_basis, known.rest, rcond=None)[0]
    new = cable_document(model, known.p, coefficients, known.rest, own)
    document = {**old.document, **new}
    document["cable"] = {**old.document["cable"], **new["cable"]}
    document["model_hash"] = parameters_hash(document)
    metadata = replace(
        old,
        params=params,
        covariance=found,
        uncertainty=own,
        coefficients=coefficients,
        document=document,
        model_hash=document["model_hash"],
    )
    return replace(cable, model=model, p=known.p, rest=known.rest, metadata=metadata)


def _held(cable: EstimatedCable, model: CableModel, pose: Pose) -> HeldPose:
    """How a pose holds a cable of this model, checked."""
    asked = {name: getattr(pose, name) for name in (*HELD, "clips")}
    return held_pose(model, cable.metadata.fixtures, asked)


def _checked(name: str, value: object, meant: str) -> None:
    """Raise a DloError if a value is no positive number."""
    if isinstance(value, bool) or not isinstance(value, int | float) or not 0 < value < np.inf:
        raise DloError(f"{name}: {meant} belongs here, found {value!r}")
