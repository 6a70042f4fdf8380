"""Estimate a cable while it is handled: one measured pose after the other.

The unknowns theta = theta_0 + A z with z ~ N(0, I), A A^T = P, are those of the fit. A pose tells
y = c(theta) + B w + e: its points, with w ~ N(0, I) for what differs from pose to pose (fixtures,
scatter, see `Repeats`) and white noise e of std sigma. With H = dc/dtheta A and the innovation r,

    S = H H^T + B B^T + sigma^2 I,   K = H^T S^-1,   z = K (r + H z),   P = A (I - K H) A^T

linearised anew at each z until it stays: the iterated Kalman filter, for poses that change nothing
equal to the batch fit to first order.

References
----------
Bell and Cathey, IEEE Trans. Autom. Control 38 (1993); Page, Biometrika 41 (1954); Lorden, Ann.
Math. Statist. 42 (1971).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.linalg import cho_factor, cho_solve, solve_triangular
from scipy.stats import chi2

from dlo_casadi.arrays import FloatArray
from dlo_casadi.cable.estimate import Covariance, EstimatedCable, Estimates
from dlo_casadi.cable.saved import parameters_hash
from dlo_casadi.config import Pose
from dlo_casadi.equilibrium.spread import Repeats
from dlo_casadi.errors import DloError

# Relinearisations of an update, and the change of z at which they end.
_ITERATIONS, _CHANGE = 8, 1e-3
# Probability of a pose by chance below which it is refused; so many in a row are a change.
OUTLIER, IN_A_ROW = 1e-5, 3
# Clean poses between false alarms, on average at least: Page's test with the threshold ln of it.
BETWEEN_ALARMS = 1e4
# Variance of the whitened innovations that the test expects after a change.
_AFTER = 2.0


@dataclass(frozen=True, eq=False)
class Update:
    """What one pose told.

    Parameters
    ----------
    innovation : (R,)
        Measured minus predicted points before the pose was used, whitened: independent, of std 1.
    rms : float [m]
        Root of the mean square of the same in metres.
    probability : float
        Of an innovation as large by chance.
    refused : bool
        Whether the pose was left out, because that is less than 1 in 100,000.
    changed_since : int or None
        If the cable is another one than before: number of the pose from which on, the first is 1.
    iterations : int
    """

    innovation: FloatArray
    rms: float
    probability: float
    refused: bool
    changed_since: int | None
    iterations: int

    def __repr__(self) -> str:
        text = f"{1e3 * self.rms:.3g} mm off the prediction, p = {self.probability:.2g}"
        text += ", refused" if self.refused else ""
        return text + (f", changed since pose {self.changed_since}" if self.changed_since else "")


@dataclass(eq=False)
class Tracker:
    """A cable that is estimated while it is handled.

    Parameters
    ----------
    cable : EstimatedCable
        With its parameters and their covariance after the last pose; `save` keeps it.
    std : float [m]
        Of the noise of one coordinate of a point.
    forget : float
        Share of what is known that is kept from pose to pose: the covariance grows by its inverse.
    drift : mapping of str to float
        Standard deviation per pose of parameters that walk at random, by name.
    count : int
        Number of poses so far.
    """

    cable: Any
    std: float
    forget: float = 1.0
    drift: Mapping[str, float] | None = None
    count: int = 0
    _suspicion: float = 0.0
    _since: int = 0
    _refused: int = 0

    @property
    def params(self) -> Estimates:
        """Parameters after the last pose."""
        return Estimates(self.cable.metadata.params)

    def update(self, pose: Pose) -> Update:
        """Learn from a pose: its fixtures and the points measured on the cable.

        `Pose.points` (K, d) [m], with `Pose.at` (K,) [m] for markers, are used; without `at` the
        points are anywhere along the cable, and their distances across it count. In a pose without
        points time passes, nothing else.

        Raises
        ------
        DloError
            If the pose is none.
        EquilibriumError
            If the cable has no shape in the pose.
        """
        if not isinstance(pose, Pose):
            raise DloError(f"update: a Pose belongs here, found {pose!r}\n  Try: dlo.Pose(...)")
        prior = self._with_time()
        self.count += 1
        if pose.points is None:
            self.cable = prior
            return Update(np.zeros(0), 0.0, 1.0, False, None, 0)
        z, first = np.zeros(len(prior.covariance.names)), np.zeros(0)
        for iteration in range(1, _ITERATIONS + 1):
            residual, by_z, by_own = _seen(_moved(prior, z), prior, pose)
            spread = by_z @ by_z.T + by_own @ by_own.T + self.std**2 * np.eye(len(residual))
            factor = cho_factor(spread, lower=True)
            if iteration == 1:
                first = solve_triangular(factor[0], residual, lower=True)
                rms = float(np.sqrt((residual**2).mean()))
                probability = float(chi2.sf(first @ first, len(first)))
                since = self._changed(first, probability)
                if probability < OUTLIER:
                    self.cable = prior
                    return Update(first, rms, probability, True, since, iteration)
            gain = cho_solve(factor, by_z).T
            before, z = z, gain @ (residual + by_z @ z)
            if np.abs(z - before).max(initial=0.0) < _CHANGE:
                break
        left = np.eye(len(z)) - gain @ by_z
        root = prior.metadata.uncertainty.root
        covariance = root @ ((left + left.T) / 2) @ root.T
        self.cable = _known(_moved(prior, z), covariance)
        return Update(first, rms, probability, False, since, iteration)

    def _with_time(self) -> Any:
        """The cable before a pose: what is known has faded, and has walked."""
        names, values = self.cable.covariance.names, self.cable.covariance.values
        walked = np.array([(self.drift or {}).get(name, 0.0) for name in names])
        return _known(self.cable, values / self.forget + np.diag(walked**2))

    def _changed(self, innovation: FloatArray, probability: float) -> int | None:
        """Page's test of the innovations' variance; the first pose of a change."""
        self._refused = self._refused + 1 if probability < OUTLIER else 0
        if self._refused >= IN_A_ROW:
            return self.count - self._refused + 1
        if self._refused:
            return None  # one pose that was seen wrong is no change
        gained = (innovation @ innovation) * (1 - 1 / _AFTER) - len(innovation) * np.log(_AFTER)
        if self._suspicion <= 0:
            self._since = self.count
        self._suspicion = max(0.0, self._suspicion + gained / 2)
        return self._since if self._suspicion > np.log(BETWEEN_ALARMS) else None


class TrackedCable(EstimatedCable):
    """A fitted cable that is tracked."""

    if TYPE_CHECKING:

        def solve(self, *pose: Any, **held: Any) -> Any:
            """See `FittedCable.solve`."""

    def tracker(
        self,
        std: float,
        *,
        forget: float = 1.0,
        drift: Mapping[str, float] | None = None,
    ) -> Tracker:
        """Estimate the cable further, one pose after the other.

        Parameters
        ----------
        std : float [m]
            Standard deviation of one coordinate of a measured point.
        forget : float
            Share of what is known that is kept from pose to pose, at most 1.
        drift : mapping of str to float, optional
            Standard deviation per pose of parameters that change slowly: {"bending_stiffness":
            1e-4}.

        Raises
        ------
        DloError
            If a value is impossible, if there is no such parameter, or if nothing is uncertain.
        """
        if isinstance(std, bool) or not isinstance(std, int | float) or not 0 < std < np.inf:
            raise DloError(f"std: the noise of a coordinate [m] belongs here, found {std!r}")
        if not isinstance(forget, int | float) or not 0.5 <= forget <= 1:
            raise DloError(f"forget: 0.5 to 1 belongs here, found {forget!r}")
        names = self.covariance.names
        if self.model.has_state:
            raise DloError("tracker: a rest shape that changes from pose to pose is not tracked")
        if not names:
            raise DloError(
                "tracker: all parameters of this cable are exact.\n  Try: a fitted cable"
            )
        for name, value in (drift or {}).items():
            if name not in names:
                raise DloError(f"drift: {name!r} is not estimated.\n  Try: {', '.join(names)}")
            if not 0 <= float(value) < np.inf:
                raise DloError(f"drift: {name}: a standard deviation, found {value!r}")
        return Tracker(self, float(std), float(forget), dict(drift or {}))


def _seen(cable: Any, prior: Any, pose: Pose) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Measured minus predicted points (R,), derivatives by z and by what differs in each pose."""
    shape = cable.solve(_held(pose))
    repeats = Repeats(shape._measured, prior.metadata.uncertainty)
    points = np.asarray(pose.points, dtype=float)
    if pose.at is not None:
        s = np.asarray(pose.at, dtype=float)
        curve, moved = repeats.displacements(s)
        residual = points - curve.at(s)
    else:
        fine = np.linspace(0.0, cable.length, 1001)
        curve = repeats.held.curve
        apart = np.linalg.norm(points[:, None] - curve.at(fine)[None], axis=2)
        s = fine[apart.argmin(axis=1)]
        curve, moved = repeats.displacements(s)
        across = curve.normals(s)
        residual = np.einsum("knd,kd->kn", across, points - curve.at(s))
        moved = np.einsum("knd,kdq->knq", across, moved)
    rows, count = moved.reshape((residual.size, -1)), len(prior.covariance.names)
    return residual.ravel(), rows[:, :count], rows[:, count:]


def _held(pose: Pose) -> Pose:
    """The pose without its measurements."""
    return pose.changed(points=None, at=None)


def _moved(cable: Any, z: FloatArray) -> Any:
    """The cable with its unknowns changed by A z, within their bounds."""
    uncertainty = cable.metadata.uncertainty
    by_p, by_rest = uncertainty.unknowns_in(cable.model)
    change = uncertainty.root @ z
    bounds = np.array([q.bounds(estimated=True) for q in cable.model.parameters])
    p = np.clip(cable.p + by_p @ change, bounds[:, 0], bounds[:, 1])
    return replace(cable, p=p, rest=cable.rest + by_rest @ change)


def _known(cable: Any, covariance: FloatArray) -> Any:
    """The cable with this covariance, and with its values in its parameters and its document."""
    old = cable.metadata
    names, values = old.covariance.names, dict(zip(cable.model.names, cable.p, strict=True))
    found = Covariance(names, covariance)
    params, rows = {}, {}
    for name, one in old.params.items():
        value, std = float(values[name]), float(found.std.get(name, 0.0))
        fitted = {"fixed": name not in names, "interval_95": None, "interval_95_if_hidden": None}
        params[name] = replace(one, value=value, std=std, **fitted)
        rows[name] = {**old.document["parameters"][name], "value": value, "std": std}
        rows[name] |= {"fitted": name in names, "interval_95": None, "interval_95_if_hidden": None}
    basis = cable.model.rest_basis
    coefficients = np.linalg.lstsq(basis, cable.rest, rcond=None)[0]
    document = {**old.document, "parameters": rows}
    document["covariance"] = {"names": list(names), "values": covariance.tolist()}
    document["rest_curvature"] = {
        **document["rest_curvature"],
        "coefficients": coefficients.tolist(),
    }
    document["model_hash"] = parameters_hash(document)
    metadata = replace(
        old,
        params=params,
        covariance=found,
        uncertainty=replace(old.uncertainty, covariance=covariance),
        coefficients=coefficients,
        document=document,
        model_hash=document["model_hash"],
    )
    return replace(cable, metadata=metadata)
