"""A cable that is tracked while it moves."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from dlo_casadi.arrays import FloatArray
from dlo_casadi.config import Pose
from dlo_casadi.equilibrium.pose import HeldPose
from dlo_casadi.errors import DloError
from dlo_casadi.estimation.motion_fit import MESH_ERROR
from dlo_casadi.model.cable_model import CableModel
from dlo_casadi.tracking.known import Known
from dlo_casadi.tracking.measured import Measured, Noise
from dlo_casadi.tracking.moving import FIRST_SEEN, InMotion, Sample, Seen
from dlo_casadi.tracking.seen import IN_A_ROW
from dlo_casadi.tracking.update import Ahead, Update


class TrackerInMotion:
    """What a `Tracker` does in motion."""

    _known: Known
    _held: Callable[[CableModel, Pose], HeldPose]
    noise: Noise
    forget: float
    drift: Mapping[str, float]
    compiled: bool

    _motion: InMotion | None
    _first: list[Sample]  # of a motion whose first state is not known yet
    _lost: list[Sample]  # the last instants, if they were refused
    _instants: int

    def _learn_in_motion(self, known: Known) -> None:
        raise NotImplementedError

    def _end_motion(self) -> None:
        """The cable is at rest."""
        self._motion, self._first, self._lost, self._instants = None, [], [], 0

    def advance(
        self, t: float, pose: Pose, *, begins: Literal["at_rest", "moving"] = "at_rest"
    ) -> Update:
        """Follow the cable in motion to a time, and learn from what is seen of it then.

        The state at the time, as a function of all that is uncertain (parameters, fixtures' errors
        and the first state), is corrected with them by an extended Kalman filter, see `InMotion`.
        What earlier instants told is kept in the covariance alone. Times may be uneven. `update`
        ends the motion: the cable is at rest in its pose, and goes on with what motion has told.
        Three refused instants in a row mean that the cable was touched: its state is sought anew,
        as that of a cable that moves already.

        Parameters
        ----------
        t : float [s]
            Later than the last one; of the first instant any time.
        pose : Pose
            Where the fixtures are at this time; between the times they move smoothly. Points are
            learned from as in `update`; without them time passes.
        begins : "at_rest" or "moving"
            How the cable is at the first instant. At rest it hangs in its equilibrium between the
            fixtures. Of one that moves, markers (`pose.at`) of the first 0.15 s are gathered before
            its first state is known; updates have no innovation until then.

        Returns
        -------
        Update
            `number` counts the instants; changes of the cable are not looked for.

        Raises
        ------
        MotionError
            If the ends are held out of reach, or if a step in time has no solution. What was known
            before stays as it was.
        DloError
            If the time is not later than the last one, if the pose is none or has readings, or if
            motion does not know a part of the cable.
        """
        if begins not in ("at_rest", "moving"):
            raise DloError(f"begins: 'at_rest' or 'moving' belongs here, found {begins!r}")
        sample = self._sample(t, pose, "advance")
        if self._motion is None:
            return self._begun(sample, at_rest=begins == "at_rest" and not self._first)
        walked = np.array([self.drift.get(x, 0.0) for x in self._known.uncertainty.names])
        now = self._motion.faded(self.forget, walked).ahead(sample.t, sample.pose)
        if not sample.measured.size:
            return self._moved(now, None)
        now, seen = now.learned(sample.measured)
        self._lost = [*self._lost, sample] if seen.refused else []
        told = self._moved(now, seen)
        if len(self._lost) == IN_A_ROW and all(one.measured.marked for one in self._lost):
            self._motion, self._first, self._lost = None, self._lost, []
        return told

    def ahead(
        self, t: ArrayLike, poses: Sequence[Pose] | None = None, at: ArrayLike | None = None
    ) -> Ahead:
        """Predict the cable in motion at later times.

        Parameters
        ----------
        t : float or (T,) [s]
            Later than that of the last `advance`, in order.
        poses : sequence of T Pose, optional
            Where the fixtures will be then. By default they stay where they are.
        at : (K,) [m], optional
            Arc lengths of the points; by default 21 along the cable.

        Raises
        ------
        MotionError
            As `advance` does.
        DloError
            If no motion has begun, if times, poses or arc lengths are impossible.
        """
        if self._motion is None:
            said = f"wait until {FIRST_SEEN:g} s are seen" if self._first else "advance(t, pose)"
            raise DloError(f"ahead: no motion has begun.\n  Try: {said}")
        length, last = self._known.model.cable.length, self._motion.rows[-1][1]
        times = _numbers("ahead", t)
        s = np.linspace(0.0, length, 21) if at is None else _numbers("at", at)
        if not ((s >= 0) & (s <= length)).all():
            raise DloError(
                f"at: arc lengths from 0 to {length:g} m belong here, found {s.tolist()}"
            )
        if poses is not None and len(poses) != len(times):
            raise DloError(f"ahead: a pose for each of {len(times)} times, found {len(poses)}")
        now, rows = self._motion, []
        for k, time in enumerate(times.tolist()):
            _check_later("ahead", time, now.t)
            held = last if poses is None else self._held(self._known.model, poses[k])
            now = now.ahead(time, held)
            told, change = now.observed()
            std = np.linalg.norm(told.curve.moved(s, change.curve), axis=2)
            rows.append((told.curve.at(s), np.hypot(std, MESH_ERROR * length)))
        points, stds = (np.stack(x) for x in zip(*rows, strict=True))
        return Ahead(times, s, points, stds)

    def _sample(self, t: float, pose: Pose, asked: str) -> Sample:
        """Fixtures and what was measured at a time, checked."""
        if not isinstance(pose, Pose):
            raise DloError(f"{asked}: a Pose belongs here, found {pose!r}\n  Try: dlo.Pose(...)")
        if pose.readings:
            known = ", ".join(pose.readings)
            raise DloError(f"{asked}: readings of a moving cable are not used, found {known}")
        before = self._first[-1].t if self._first else None
        _check_later(asked, t, before if self._motion is None else self._motion.t)
        held, model = self._held(self._known.model, pose), self._known.model
        return Sample(float(t), held, Measured.of(pose, model, self.noise))

    def _begun(self, sample: Sample, *, at_rest: bool) -> Update:
        """The first instants of a motion."""
        if not at_rest and not (sample.measured.marked and sample.measured.size):
            raise DloError(
                "advance: the first state of a moving cable is sought from markers.\n"
                f"  Try: Pose(points=..., at=...) in the first {FIRST_SEEN:g} s, or "
                "begins='at_rest'"
            )
        first = [*self._first, sample]
        if not at_rest and sample.t - first[0].t < FIRST_SEEN * (1 - 1e-9):
            self._first = first
            return self._moved(None, None)
        now = InMotion.begun(self._known, first, at_rest=at_rest, compiled=self.compiled)
        self._first = []
        return self._moved(now, None)

    def _moved(self, now: InMotion | None, seen: Seen | None) -> Update:
        """What an instant told."""
        self._motion, self._instants = now, self._instants + 1
        if now is not None:
            self._learn_in_motion(now.known)
        if seen is None:
            return Update(self._instants, np.zeros(0), 0.0, 1.0, False, None, 0)
        told = seen.innovation, seen.rms, seen.probability, seen.refused
        return Update(self._instants, *told, None, 1)


def _numbers(name: str, given: ArrayLike) -> FloatArray:
    """Numbers in a row."""
    try:
        return np.atleast_1d(np.asarray(given, dtype=float)).ravel()
    except (TypeError, ValueError):
        raise DloError(f"{name}: numbers belong here, found {given!r}") from None


def _check_later(asked: str, t: object, last: float | None) -> None:
    """Raise a DloError if a time is none or not later than the last one."""
    if isinstance(t, bool) or not isinstance(t, int | float) or not np.isfinite(t):
        raise DloError(f"{asked}: a time [s] belongs here, found {t!r}")
    if last is not None and not t > last:
        raise DloError(
            f"{asked}: {t:g} s is not later than {last:g} s, the time before.\n  Try: times in "
            "order; update(pose) ends a motion, and the next one begins at any time"
        )
