"""Quick fits of a session as it is declared, and as it may have been meant."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import product
from typing import NamedTuple

import numpy as np

from dlo_casadi.arrays import FloatArray
from dlo_casadi.config import Pose
from dlo_casadi.config.values import EARTH
from dlo_casadi.model.cable_model import BENDING_STIFFNESS
from dlo_casadi.session.axes import clamp_axes, exchanges, listed
from dlo_casadi.session.coarse_fit import Coarse, coarse_fit
from dlo_casadi.session.pull import shown_pull
from dlo_casadi.session.read_session import ReadSession
from dlo_casadi.thresholds import (
    BEYOND_EFFECTS,
    EVIDENCE_APART,
    FITS,
    HEADING_OFF,
    MUCH_BETTER,
    NEIGHBOURS_ALIKE,
    UNEXPLAINED,
)


@dataclass(frozen=True)
class FittedSession:
    """A session, and a quick fit of at most `most` of its poses, made where it is asked for."""

    session: ReadSession
    most: int

    @cached_property
    def coarse(self) -> Coarse:
        """The quick fit."""
        return coarse_fit(self.session, self.most)

    @property
    def tells(self) -> bool:
        """Whether there are more numbers than unknowns; otherwise some rest shape always fits."""
        fit = self.coarse.fit
        return fit is None or fit.problem.n_residuals > fit.problem.unknowns.size

    @cached_property
    def pull(self) -> FloatArray | None:
        """Direction in which the lines seem to be pulled, see `shown_pull`."""
        return shown_pull(self.session)

    @property
    def gravity(self) -> FloatArray:
        """As declared (d,) [m/s^2]."""
        return np.array(self.session.config.experiment.gravity)

    @property
    def gravity_listed(self) -> str:
        """Its components in words."""
        return listed(self.gravity + 0.0, "g")

    @property
    def off_clamps(self) -> float:
        """Median angle [rad] between a clamp's axis and the vector to the point nearest to it."""
        cosines, session = [], self.session
        for item, (side, first, sign) in product(session.read, (("start", 0, 1), ("end", -1, -1))):
            pose = session.declared[item.name]
            way = sign * (item.points[first] - getattr(pose, side))
            axes = clamp_axes(pose, side)
            assert axes is not None
            cosines.append(float(way @ axes[:, 0]) / max(float(np.linalg.norm(way)), 1e-300))
        return float(np.arccos(np.clip(np.median(cosines), -1.0, 1.0)))

    @property
    def off_clamps_degrees(self) -> float:
        """The same in degrees."""
        return float(np.degrees(self.off_clamps))

    @property
    def weightless(self) -> str:
        """What the quick fit says of the weight, where it shows none."""
        fit = self.coarse.fit
        if fit is None or self.coarse.weight:
            return ""
        least = fit.value(BENDING_STIFFNESS)
        return f"the lines show no weight, as if bending_stiffness were {least:.2g} N m^2 or more; "

    @property
    def upright(self) -> str:
        """Gravity along the last axis, in words."""
        d = len(self.gravity)
        return f"{[*np.zeros(d - 1).tolist(), -9.81]} with {'xyz'[d - 1]} up"

    def pulled_along(self, way: FloatArray) -> bool:
        """Whether the lines seem to be pulled along a direction (d,), or show no pull."""
        return self.pull is None or _angle(self.pull, way) < HEADING_OFF

    # ---- as it may have been meant ----

    def with_ends_exchanged(self, keys: Sequence[str]) -> "FittedSession | None":
        """Start and end exchanged in all poses, so that lines begin where they ended.

        `keys`: what else of their names, such as _heading. None where lines would not leave the
        clamps along their axes.
        """
        session, pairs = self.session, [(f"start{key}", f"end{key}") for key in keys]
        both = [*pairs, *((b, a) for a, b in pairs)]
        poses = tuple(
            pose.changed(**{a: getattr(pose, b) for a, b in both})
            for pose in session.config.experiment.poses
        )
        read = (x if x.s is not None else replace(x, points=x.points[::-1]) for x in session.read)
        meant = replace(session, read=tuple(read)).with_experiment(poses=poses)
        fitted = FittedSession(meant, self.most)
        return fitted if fitted.off_clamps < HEADING_OFF else None

    def under(self, axes: FloatArray) -> "FittedSession | None":
        """Gravity along other axes (d, d); that of Earth if none is declared.

        None if these axes do not change it, or others do alike, or if the lines show another pull.
        """
        gravity, d = self.gravity, len(self.gravity)
        if len(axes) != d:
            return None
        tried = [gravity] if gravity.any() else []
        gravity = gravity if gravity.any() else EARTH * np.eye(d)[-1]
        for other in exchanges(d):
            if np.array_equal(other, axes):
                break
            tried.append(gravity @ other)
        way = gravity @ axes
        if any(np.allclose(way, other) for other in tried) or not self.pulled_along(way):
            return None
        meant = self.session.with_experiment(gravity=tuple(way.tolist()))
        return FittedSession(meant, self.most)

    def about_start(self, axes: FloatArray) -> "FittedSession | None":
        """Points with exchanged or mirrored axes (d, d) about the start of each pose.

        None if an end or a clamp would move, or if the lines show another pull. Between pins, and
        without gravity, rotating the points equals rotating gravity.
        """
        session, gravity = self.session, self.gravity
        directed = session.config.experiment.boundary.directed
        if len(axes) != len(gravity) or not gravity.any() or not directed:
            return None
        length = session.config.cable.length
        kept = (_kept_by_turning(session.declared[item.name], length) for item in session.read)
        if not self.pulled_along(gravity @ axes) or any(
            np.abs(held @ axes.T - held).max() >= FITS for held in kept
        ):
            return None
        starts = [np.array(session.declared[item.name].start) for item in session.read]
        read = tuple(
            replace(item, points=(item.points - start) @ axes.T + start)
            for item, start in zip(session.read, starts, strict=True)
        )
        return FittedSession(replace(session, read=read), self.most)


def _kept_by_turning(pose: Pose, length: float) -> FloatArray:
    """Vectors (n, d) that a rotation of a pose must keep: end minus start [lengths], and clamps."""
    kept: list[FloatArray] = [np.zeros(len(pose.start))]
    if pose.end is not None:
        kept.append((np.array(pose.end) - pose.start) / length)
    axes = [clamp_axes(pose, side) for side in ("start", "end")]
    kept += [own[:, 0] for own in axes if own is not None]
    return np.array(kept)


def _angle(pull: FloatArray, way: FloatArray) -> float:
    """Angle [rad] between two directions."""
    cosine = float(pull @ way) / float(np.linalg.norm(pull) * np.linalg.norm(way))
    return float(np.arccos(np.clip(cosine, -1.0, 1.0)))


# ---- comparisons ---------------------------------------------------------------------------------


class Comparison(NamedTuple):
    """The declared session and the hypothesis `what` that explains its shapes best, both fitted.

    `length` [m]: of the cable.
    """

    what: str
    own: Coarse
    other: Coarse
    length: float

    @property
    def told(self) -> str:
        """Describe the residuals of both."""
        left = f"the lines are {self.own.rms:.3g} m RMS from the fitted shapes, but"
        if self.own.fit is None:
            left = "no equilibria were found near the lines, but they are within"
        return f"{left} {self.other.rms:.3g} m with {self.what}"

    @property
    def better(self) -> bool:
        """Whether the declaration leaves more than noise, and the hypothesis clearly less.

        If the declaration has no fit, the hypothesis must determine a weight: a fit of few points
        may fail by chance.
        """
        if self.own.fit is None and not self.other.weight:
            return False
        own, other = self.own.rms, self.other.rms
        return own > UNEXPLAINED * self.length and other < MUCH_BETTER * own

    @property
    def certain(self) -> bool:
        """Whether no missing effect could be meant instead.

        The hypothesis is clearly better and explains shapes that are farther off than effects
        leave them; or it is the opposite gravity, only it shows a weight, and noise alone is left.
        """
        own, other = self.own.rms / self.length, self.other.rms / self.length
        if other >= UNEXPLAINED:
            return False
        if self.better and own > BEYOND_EFFECTS:
            return True
        noise_alone = self.other.correlation < NEIGHBOURS_ALIKE
        return self.shows_weight and self.upside_down and noise_alone

    @property
    def upside_down(self) -> bool:
        """Whether the hypothesis is the opposite gravity.

        Gravity across the declared one may be that of a cable that is curved at rest.
        """
        if self.own.fit is None or self.other.fit is None:
            return False
        return np.allclose(self.own.fit.model.gravity, -np.array(self.other.fit.model.gravity))

    @property
    def shows_weight(self) -> bool:
        """Whether only the hypothesis determines a weight, explains the shapes, and fits better.

        If gravity points the wrong way, the best fit is a cable too stiff to show any weight.
        """
        own, other = self.own, self.other
        if other.fit is None or not other.weight or own.weight:
            return False
        # Difference in log likelihood of two models with equally many unknowns.
        evidence = other.fit.problem.n_residuals * np.log(own.rms / other.rms)
        return bool(other.rms < BEYOND_EFFECTS * self.length and evidence > EVIDENCE_APART)
