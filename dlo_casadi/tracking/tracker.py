"""Estimate a cable while it is handled: one measured pose after the other.

The filter is that of `seen`. Whether the cable is still the same is asked of its innovations, by
what may have changed (`changes`), and by Page's test of their variance.

References
----------
Page, Biometrika 41 (1954); Lorden, Ann. Math. Statist. 42 (1971).
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np

from dlo_casadi.config import Pose
from dlo_casadi.equilibrium.pose import HeldPose
from dlo_casadi.errors import DloError, counted
from dlo_casadi.io.files import finite
from dlo_casadi.model.cable_model import CableModel
from dlo_casadi.tracking.changes import Jumps, Probe
from dlo_casadi.tracking.inquiry import JUDGED, Change, Inquiry
from dlo_casadi.tracking.known import Known
from dlo_casadi.tracking.measured import Noise
from dlo_casadi.tracking.motion import TrackerInMotion
from dlo_casadi.tracking.seen import IN_A_ROW, Seen, joined, learned, smoothed
from dlo_casadi.tracking.shaper import Shaper
from dlo_casadi.tracking.update import Update

# Clean poses between false alarms, on average at least; half of them are of each test.
BETWEEN_ALARMS = 1e4
# Variance of the whitened innovations that Page's test expects after a change.
_AFTER = 2.0
# Poses that are kept: a change is seen within them. Poses between two looks at what changed; a pose
# less likely than this is looked at once.
WINDOW, LOOK, ODD = 30, 5, 0.01


# What the tests carry on from pose to pose.
_TESTS = ("_suspicion", "_since", "_refused")


@dataclass(eq=False)
class Tracker(TrackerInMotion):
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

    _known: Known
    _held: Callable[[CableModel, Pose], HeldPose]  # how a pose holds a cable of this model
    _as_cable: Callable[[Known], Any]  # with its parameters and its document
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
        self._go_on_from(self._known)
        self._end_motion()

    def __repr__(self) -> str:
        known = {n: s for n, s in self._known.stds.items() if n in self._known.model.names}
        values = (
            f"{n} {self._known.value(n, self._known):.4g} (std {s:.1g})" for n, s in known.items()
        )
        return f"tracker after {counted(self.count, 'pose')}: {', '.join(values)}"

    def _go_on_from(self, known: Known) -> None:
        """What is known before the next pose; what earlier ones told stays as it is."""
        self._known = self._base = known
        self._learned: list[Seen] = []

    def _learn_in_motion(self, known: Known) -> None:
        """What motion told is kept; the poses before it are not looked at again."""
        if self._kept:
            self._begin()
            self._kept.clear()
        self._go_on_from(known)

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
        return self._as_cable(self._known)

    @property
    def params(self) -> Any:
        """Parameters after the last pose."""
        return self.cable.params

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
        self._end_motion()
        self._kept.append((self._now(), pose))
        try:
            return self._updated(pose)
        except BaseException:
            self._kept.pop()
            raise

    def _updated(self, pose: Pose) -> Update:
        prior = self._faded(self._known)
        held, number = self._held(prior.model, pose), self.count + 1
        after, seen = learned(prior, pose, held, self.noise, number, self._shaper)
        if seen is not None and not seen.refused and self._steady:
            learned_from = [*self._learned, seen]
            after, self._learned = smoothed(self._base, learned_from, after, self._shaper)
        self.count, self._known = number, after
        change = None if seen is None else self._judged(seen)
        most = WINDOW + (0 if self._inquiry is None else JUDGED[-1])
        while len(self._kept) > most:
            first = self._kept.popleft()[0]["count"] + 1
            old = [one for one in self._learned if one.number == first]
            if old:
                self._base = joined(self._base, old, self._shaper)
                self._learned = self._learned[1:]
        if seen is None:
            return Update(self.count, np.zeros(0), 0.0, 1.0, False, None, 0)
        return Update(
            *(seen.number, seen.innovation, seen.rms, seen.probability, seen.refused, change),
            seen.iterations,
        )

    @property
    def _steady(self) -> bool:
        """Whether what a pose told is true of the cable for ever."""
        return self.forget == 1 and not self.drift

    def _faded(self, cable: Known) -> Known:
        """The cable before a pose: what is known has faded, and has walked."""
        if self._steady:
            return cable
        known = cable.uncertainty
        walked = np.array([self.drift.get(name, 0.0) for name in known.names])
        return cable.with_covariance(known.covariance / self.forget + np.diag(walked**2))

    # ---- kept and resumed ------------------------------------------------------------------------

    def _now(self) -> dict[str, Any]:
        """What a pose changes."""
        names = ("_known", "count", "change", "_suspicion", "_since", "_refused")
        return {name: getattr(self, name) for name in names}

    def state(self) -> dict[str, Any]:
        """Plain data from which `resume` goes on: the last poses, and the cable before them."""
        first = self._kept[0][0] if self._kept else self._now()
        change = first["change"]
        known = self._base if self._learned and self._inquiry is None else first["_known"]
        return finite(
            {
                "parameters": self._as_cable(known).metadata.document,
                "tests": {name: first[name] for name in ("count", *_TESTS)},
                "change": None if change is None else asdict(change),
                "poses": [_plain(pose) for _, pose in self._kept],
            }
        )

    def resume(self, state: Mapping[str, Any], known: Known) -> None:
        """Go on from a `state` of such a tracker; `known`: the cable of its parameters."""
        self.count = state["tests"]["count"]
        self._go_on_from(known)
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
            self._base, self._learned = self._kept[0][0]["_known"], self._learned[-1:]
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
        if since is None and (seen.probability < ODD or seen.number % LOOK == 0):
            since = self._looked()
        return since

    def _varied(self, seen: Seen) -> int | None:
        """Page's test of the innovations' variance."""
        if self._suspicion <= 0:
            self._since = seen.number
        r = seen.innovation
        self._suspicion = float(page_sum(self._suspicion, r @ r, len(r)))
        return self._since if self._suspicion > np.log(2 * BETWEEN_ALARMS) else None

    def _looked(self) -> int | None:
        """Likelihood ratios of what may have changed, since each of the last poses."""
        if self._jumps is None:
            names = self._known.uncertainty.names
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
        seen = [*self._window]
        # Odd poses in a row are of the change, the last one of which need not have been refused.
        accepted = [k for k, one in enumerate(seen[:-1]) if not one.refused]
        first = accepted[-1] + 1 if accepted else 0
        first = first if len(seen) - first >= IN_A_ROW else len(seen)
        poses = [one for k, one in enumerate(seen) if k >= first or not one.refused]
        self._inquiry = Inquiry(
            poses, self._known, self.noise, self._faded, self._shaper, since, self.count
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
        change, known = inquiry.verdict(final=final)
        self._go_on_from(known)
        self.change = change
        self._begin()
        if change.decided:
            self._kept.clear()
        else:
            self._inquiry = inquiry
        return change


def page_sum(before: Any, square: Any, size: int) -> Any:
    """Page's sum of the log likelihood ratio of a larger variance, after one more innovation.

    `square`: of `size` components; the sum is never negative.
    """
    gained = square * (1 - 1 / _AFTER) - size * np.log(_AFTER)
    return np.maximum(0.0, before + gained / 2)


def _plain(pose: Pose) -> dict[str, Any]:
    """Arguments of a pose."""
    return {key: x for key, x in asdict(pose).items() if x not in (None, (), "")}
