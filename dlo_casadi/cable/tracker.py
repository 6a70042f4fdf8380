"""Estimate a cable while it is handled: one measured pose after the other.

The filter is that of `seen`. Whether the cable is still the same is asked of its innovations, by
what may have changed (`changes`), and by Page's test of their variance.

References
----------
Page, Biometrika 41 (1954); Lorden, Ann. Math. Statist. 42 (1971).
"""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from dlo_casadi.arrays import FloatArray
from dlo_casadi.cable.changes import Jumps, Probe
from dlo_casadi.cable.estimate import Covariance, Estimate, EstimatedCable, Estimates
from dlo_casadi.cable.inquiry import JUDGED, Change, Inquiry
from dlo_casadi.cable.saved import cable_document, parameters_hash
from dlo_casadi.cable.seen import Noise, Seen, Shaper, learned, with_covariance
from dlo_casadi.config import Pose
from dlo_casadi.errors import DloError
from dlo_casadi.io.files import finite

# So many poses in a row that are refused are a change.
IN_A_ROW = 3
# Clean poses between false alarms, on average at least; half of them are of each test.
BETWEEN_ALARMS = 1e4
# Variance of the whitened innovations that Page's test expects after a change.
_AFTER = 2.0
# Poses that are kept: a change is seen within them. Poses between two looks at what changed; a pose
# less likely than this is looked at once.
WINDOW, LOOK, _ODD = 30, 5, 0.01


# What the tests carry on from pose to pose.
_TESTS = ("_suspicion", "_since", "_refused")


@dataclass(frozen=True, eq=False)
class Update:
    """What one pose told.

    Parameters
    ----------
    number : int
        Of the pose, the first is 1.
    innovation : (R,)
        Measured minus predicted before the pose was used, whitened: independent, of std 1.
    rms : float [m]
        Root of the mean square of the points' part of it, in metres.
    probability : float
        Of an innovation as large by chance.
    refused : bool
        Whether the pose was left out, because that is less than 1 in 100,000.
    change : Change or None
        If the cable is another one than before: an alarm, or news of its cause.
    iterations : int
    """

    number: int
    innovation: FloatArray
    rms: float
    probability: float
    refused: bool
    change: Change | None
    iterations: int

    def __repr__(self) -> str:
        text = f"{1e3 * self.rms:.3g} mm off the prediction, p = {self.probability:.2g}"
        text += ", refused" if self.refused else ""
        return text + (f", {self.change}" if self.change else "")


@dataclass(eq=False)
class Tracker:
    """A cable that is estimated while it is handled.

    Parameters
    ----------
    noise : Noise
        Of points and readings.
    forget : float
        Share of what is known that is kept from pose to pose: the covariance grows by its inverse.
    drift : mapping of str to float
        Standard deviation per pose of parameters that walk at random, by name.
    count : int
        Number of poses so far.
    change : Change or None
        The last change.
    """

    _cable: Any
    noise: Noise
    forget: float = 1.0
    drift: Mapping[str, float] = field(default_factory=dict)
    compiled: bool = False
    count: int = 0
    change: Change | None = None

    def __post_init__(self) -> None:
        self._shaper = Shaper(self.compiled)
        # The poses on which the tests look back, each with what was known before it.
        self._kept: deque[tuple[dict[str, Any], Pose]] = deque()
        self._begin()

    def _begin(self) -> None:
        """Forget the last poses, but not what they told."""
        self._window: deque[Seen] = deque(maxlen=WINDOW)
        self._jumps: Jumps | None = None
        self._unseen: list[Seen] = []  # by the last look
        self._suspicion, self._since, self._refused = 0.0, 0, 0
        self._inquiry: Inquiry | None = None

    @property
    def cable(self) -> Any:
        """The cable after the last pose: its parameters and their covariance; `save` keeps it."""
        return _documented(self._cable)

    @property
    def params(self) -> Estimates:
        """Parameters after the last pose."""
        return Estimates(self.cable.metadata.params)

    def update(self, pose: Pose) -> Update:
        """Learn from a pose: its fixtures, and what was measured of the cable.

        `Pose.points` (K, d) [m], with `Pose.at` (K,) [m] for markers, are used; without `at` the
        points are those of a line, anywhere along the cable, and their distances across it count.
        Readings of forces and moments are used if the tracker knows their noise. In a pose with
        nothing measured time passes.

        Raises
        ------
        DloError
            If the pose is none.
        EquilibriumError
            If the cable has no shape in the pose.
        """
        if not isinstance(pose, Pose):
            raise DloError(f"update: a Pose belongs here, found {pose!r}\n  Try: dlo.Pose(...)")
        self._kept.append((self._now(), pose))
        try:
            return self._updated(pose)
        except BaseException:
            self._kept.pop()
            raise

    def _updated(self, pose: Pose) -> Update:
        prior = self._faded(self._cable)
        after, seen = learned(prior, pose, self.noise, self.count + 1, self._shaper)
        self.count, self._cable = self.count + 1, after
        change = None if seen is None else self._judged(seen)
        most = WINDOW + (0 if self._inquiry is None else JUDGED[-1])
        while len(self._kept) > most:
            self._kept.popleft()
        if seen is None:
            return Update(self.count, np.zeros(0), 0.0, 1.0, False, None, 0)
        return Update(
            *(seen.number, seen.innovation, seen.rms, seen.probability, seen.refused, change),
            seen.iterations,
        )

    def _faded(self, cable: Any) -> Any:
        """The cable before a pose: what is known has faded, and has walked."""
        if self.forget == 1 and not self.drift:
            return cable
        known = cable.metadata.uncertainty
        walked = np.array([self.drift.get(name, 0.0) for name in known.names])
        return with_covariance(cable, known.covariance / self.forget + np.diag(walked**2))

    # ---- kept and resumed ------------------------------------------------------------------------

    def _now(self) -> dict[str, Any]:
        """What a pose changes."""
        names = ("_cable", "count", "change", "_suspicion", "_since", "_refused")
        return {name: getattr(self, name) for name in names}

    def state(self) -> dict[str, Any]:
        """Plain data from which `resume` goes on: the last poses, and the cable before them."""
        first = self._kept[0][0] if self._kept else self._now()
        change = first["change"]
        return finite(
            {
                "parameters": _documented(first["_cable"]).metadata.document,
                "tests": {name: first[name] for name in ("count", *_TESTS)},
                "change": None if change is None else asdict(change),
                "poses": [_plain(pose) for _, pose in self._kept],
            }
        )

    def resume(self, state: Mapping[str, Any], cable: Any) -> None:
        """Go on from a `state` of such a tracker; `cable`: that of its parameters."""
        self._cable, self.count = cable, state["tests"]["count"]
        self.change = None if state["change"] is None else Change(**state["change"])
        self._kept.clear()
        self._begin()
        for name in _TESTS:
            setattr(self, name, state["tests"][name])
        for pose in state["poses"]:
            self.update(Pose(**pose))

    # ---- is it still the same cable? -------------------------------------------------------------

    def _judged(self, seen: Seen) -> Change | None:
        """A change that this pose told of."""
        if self._window and self._window[-1].model.clips != seen.model.clips:
            self._begin()  # earlier poses say nothing of other clips
            self._kept = deque([self._kept[-1]])
        self._refused = self._refused + 1 if seen.refused else 0
        self._window.append(seen)
        if self._inquiry is not None and self._refused < IN_A_ROW:
            return None if seen.refused else self._followed(seen)
        if not seen.refused:
            self._unseen.append(seen)
        since = self._alarm(seen)
        return None if since is None else self._opened(since)

    def _alarm(self, seen: Seen) -> int | None:
        """First pose of a change, if one of the tests has found one."""
        if self._refused >= IN_A_ROW:
            return seen.number - self._refused + 1
        if self._refused:
            return None  # one pose that was seen wrong is no change
        since = self._varied(seen)
        if since is None and (seen.probability < _ODD or seen.number % LOOK == 0):
            since = self._looked()
        return since

    def _varied(self, seen: Seen) -> int | None:
        """Page's test of the innovations' variance."""
        r = seen.innovation
        gained = (r @ r) * (1 - 1 / _AFTER) - len(r) * np.log(_AFTER)
        if self._suspicion <= 0:
            self._since = seen.number
        self._suspicion = max(0.0, self._suspicion + gained / 2)
        return self._since if self._suspicion > np.log(2 * BETWEEN_ALARMS) else None

    def _looked(self) -> int | None:
        """Likelihood ratios of what may have changed, since each of the last poses."""
        if self._jumps is None:
            names = self._cable.metadata.uncertainty.names
            self._jumps = Jumps(Probe.quick(self._unseen[-1].model, names), WINDOW)
        jumps = self._jumps
        for one, columns in zip(self._unseen, jumps.probe.columns(self._unseen), strict=True):
            jumps.add(one, columns)
        self._unseen = []
        first = min(jumps.found(), key=lambda jump: jump.log_p)
        tests = WINDOW * len(jumps.probe.suspects)
        rare = first.log_p + np.log(2 * BETWEEN_ALARMS * tests) < 0
        return first.since if rare else None

    def _opened(self, since: int) -> Change:
        """An alarm: what changed is asked of the poses that are kept."""
        run = self.count - self._refused if self._refused >= IN_A_ROW else self.count
        poses = [one for one in self._window if not one.refused or one.number > run]
        cable = self._cable
        self._inquiry = Inquiry(
            poses, cable, self.noise, self._faded, self._shaper, since, self.count
        )
        return self._concluded(final=False)

    def _followed(self, seen: Seen) -> Change | None:
        """One more pose after an alarm whose cause is not sure."""
        inquiry = self._inquiry
        assert inquiry is not None
        inquiry.add(seen)
        after = self.count - inquiry.opened
        if after not in JUDGED:
            return None
        return self._concluded(final=after == JUDGED[-1])

    def _concluded(self, *, final: bool) -> Change:
        inquiry = self._inquiry
        assert inquiry is not None
        change, self._cable = inquiry.verdict(final=final)
        self.change = change
        self._begin()
        if change.decided:
            self._kept.clear()
        else:
            self._inquiry = inquiry
        return change


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
            Whether equilibria are first found by compiled C; it takes some seconds to compile.

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
        noise = Noise(float(std), force_std, moment_std, float(correlated))
        return Tracker(self, noise, float(forget), dict(drift or {}), compiled)


def _checked(name: str, value: object, meant: str) -> None:
    """Raise a DloError if a value is no positive number."""
    if isinstance(value, bool) or not isinstance(value, int | float) or not 0 < value < np.inf:
        raise DloError(f"{name}: {meant} belongs here, found {value!r}")


def _plain(pose: Pose) -> dict[str, Any]:
    """Arguments of a pose."""
    return {key: x for key, x in asdict(pose).items() if x not in (None, (), "")}


def _documented(cable: Any) -> Any:
    """The cable with its values in its parameters and its document."""
    old, model, known = cable.metadata, cable.model, cable.metadata.uncertainty
    found = Covariance(known.names, known.covariance)
    params = {
        q.name: Estimate(
            float(value), found.std.get(q.name, 0.0), q.unit, fixed=q.name not in known.names
        )
        for q, value in zip(model.parameters, cable.p, strict=True)
    }
    coefficients = np.linalg.lstsq(model.rest_basis, cable.rest, rcond=None)[0]
    document = {**old.document, **cable_document(model, cable.p, coefficients, cable.rest, known)}
    document["cable"] = {**old.document["cable"], **document["cable"]}
    document["model_hash"] = parameters_hash(document)
    metadata = replace(
        old,
        params=params,
        covariance=found,
        coefficients=coefficients,
        document=document,
        model_hash=document["model_hash"],
    )
    return replace(cable, metadata=metadata)
