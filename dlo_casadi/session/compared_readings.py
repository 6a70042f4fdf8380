"""Readings of forces and moments beside those of a model, and as they may have been meant."""

from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Self

import numpy as np
from scipy.spatial.transform import Rotation

from dlo_casadi.arrays import FloatArray
from dlo_casadi.rod.quantities import Quantity, quantity_of
from dlo_casadi.session.axes import NEAR_AXES, exchanges, listed
from dlo_casadi.thresholds import FITTED_READINGS, MISREAD, UNSEEN


@dataclass(frozen=True)
class Reading:
    """One kind of reading on one side of the cable, of m poses.

    Parameters
    ----------
    name : str
        As in a configuration, such as end_force.
    measured : (m, c) [N] or [N m]
    frames : (m, d, d) or None
        Axes of the clamp in the world, as columns; None at a pin.
    """

    name: str
    measured: FloatArray
    frames: FloatArray | None = field(default=None, kw_only=True)

    def scaled(self, factor: float) -> Self:
        """Readings times a factor."""
        return replace(self, measured=factor * self.measured)

    def in_world(self, sign: int) -> Self | None:
        """Readings along the axes of their clamps, turned into the world's, with a sign.

        None for one number in a plane, or at a pin.
        """
        if self.frames is None or self.measured.shape[1] == 1:
            return None
        world = np.einsum("mij,mj->mi", self.frames, self.measured)
        return replace(self, measured=sign * world)


@dataclass(frozen=True)
class ReadAlone(Reading):
    """A reading of poses that nothing else shows.

    Parameters
    ----------
    felt : (k, m, c) [N] or [N m]
        That of a straight cable at k stiffnesses, in rising order.
    size : float [N] or [N m]
        Root mean square of the readings as they were declared.
    """

    felt: FloatArray
    size: float


@dataclass(frozen=True)
class Readings:
    """Readings of one kind, of poses that nothing else shows.

    `weightless`: there is no gravity, so that they are known up to a common factor.
    """

    parts: tuple[ReadAlone, ...]
    weightless: bool

    @property
    def quantity(self) -> Quantity:
        """What was read."""
        return quantity_of(self.parts[0].name)

    @property
    def said(self) -> str:
        """Their names in words."""
        return " and ".join(part.name for part in self.parts)

    @property
    def misfit(self) -> float:
        """Distance of readings from the nearest stiffness, relative to their size as declared."""
        y = np.concatenate([x.measured.ravel() / x.size for x in self.parts])
        path = np.concatenate([x.felt.reshape((len(x.felt), -1)) / x.size for x in self.parts], 1)
        if self.weightless:
            path = np.concatenate([np.zeros_like(path), 1e6 * path])
        steps = np.diff(path, axis=0)
        along = ((y - path[:-1]) * steps).sum(axis=1) / np.maximum((steps**2).sum(axis=1), 1e-300)
        near = path[:-1] + np.clip(along, 0.0, 1.0)[:, None] * steps
        return float(np.linalg.norm(y - near, axis=1).min() / max(np.linalg.norm(y), 1e-300))

    def scaled(self, factor: float) -> Self:
        """All readings times a factor."""
        return replace(self, parts=tuple(part.scaled(factor) for part in self.parts))

    def in_world(self, sign: int) -> Self | None:
        """All readings turned from their clamps' axes, see `Reading.in_world`; None if one is."""
        turned = [part.in_world(sign) for part in self.parts]
        known = tuple(part for part in turned if part is not None)
        return replace(self, parts=known) if len(known) == len(turned) else None


@dataclass(frozen=True)
class ComparedReading(Reading):
    """A reading beside what the shapes need.

    Parameters
    ----------
    model : (m, c) [N] or [N m]
        The values that the shapes need; known only up to the mass.
    forces : (m, d) or None [N]
        Only for moments: the model's forces on the same side.
    std : float [N] or [N m]
        Of one component: noise and a constant offset, as far as they are declared.
    uncertain : (m, c, q) or None
        Changes of `model` by one standard deviation of what the shapes leave uncertain.
    how : str
        How `measured` was changed, where numbers were fitted, in words.
    """

    model: FloatArray
    forces: FloatArray | None = None
    std: float = 0.0
    uncertain: FloatArray | None = None
    how: str = ""

    @property
    def noise(self) -> float:
        """Noise of the readings relative to their size."""
        size = np.sqrt(np.mean(self.measured**2))
        return self.std / max(float(size), 1e-300)

    @cached_property
    def _free(self) -> FloatArray:
        """Directions (m c, k), orthonormal, in which the shapes hardly determine the readings.

        Those that change them by more than MISREAD of the model's size, across the model itself,
        whose scale is always free. Their part along the model counts, too, if two standard
        deviations may turn its sign: a rest curvature between pins adds forces along the chord.
        """
        model = self.model.ravel()
        if self.uncertain is None or not model.any():
            return np.zeros((len(model), 0))
        along, size = model / np.linalg.norm(model), np.linalg.norm(model)
        ways = self.uncertain.reshape((len(model), -1))
        across = ways - np.outer(along, along @ ways)
        _, values, right = np.linalg.svd(across, full_matrices=False)
        free = right[values > MISREAD * size].T
        parts = along @ ways @ free
        turning = np.where(UNSEEN * np.abs(parts) > size, parts, 0.0)
        return np.linalg.qr(across @ free + np.outer(along, turning))[0]

    def judged(self, readings: FloatArray) -> FloatArray:
        """The part (m c, ...) of readings (m, c, ...) that the shapes determine up to a scale."""
        rows = readings.reshape((self.model.size, *readings.shape[2:]))
        return np.asarray(rows - self._free @ (self._free.T @ rows))

    @property
    def judgeable(self) -> bool:
        """Whether anything is left to judge: three numbers, more of model and readings than doubts.

        Readings that lie where the shapes hardly determine them fit with a scale of zero.
        """
        enough = self.model.size - self._free.shape[1] >= 3
        return enough and all(
            np.linalg.norm(self.judged(x)) > MISREAD * np.linalg.norm(x)
            for x in (self.model, self.measured)
        )

    @property
    def misfit(self) -> float:
        """Distance from the nearest multiple of the model, relative to the size of the readings."""
        rows, model = self.judged(self.measured), self.judged(self.model)
        along = max(float(rows @ model), 0.0) / max(float(np.linalg.norm(model)), 1e-300)
        left = max(float(rows @ rows) - along**2, 0.0)
        return float(np.sqrt(left) / max(float(np.linalg.norm(self.measured)), 1e-300))

    @property
    def scale(self) -> float:
        """Multiple of the model that is nearest to the readings."""
        rows, model = self.judged(self.measured), self.judged(self.model)
        return float(rows @ model / (model @ model))

    # ---- as they may have been meant ----

    def with_axes(self, axes: FloatArray) -> Self | None:
        """Readings along exchanged axes (d, d), if that explains them."""
        if len(axes) != self.measured.shape[1]:
            return None
        return self._if_fitting(self.measured @ axes.T)

    def turned(self) -> Self | None:
        """Readings in the world that fits best (Kabsch), if it has no exchanged axes.

        Right-handed.
        """
        size, whole = self.measured.shape[1], np.eye(3)
        if size == 1:
            return None
        u, _, v = np.linalg.svd(self.measured.T @ self.model)
        hand = np.diag([*np.ones(size - 1), np.sign(np.linalg.det(u @ v))])
        whole[:size, :size] = turn = (u @ hand @ v).T
        if min(np.linalg.norm(turn - axes) for axes in exchanges(size)[1:]) < NEAR_AXES:
            return None
        vector = Rotation.from_matrix(whole).as_rotvec()
        angle = np.degrees(np.linalg.norm(vector) if size > 2 else vector[2])
        return self._if_fitting(self.measured @ turn.T, f"{angle:.0f}")

    def about_elsewhere(self) -> Self | None:
        """Moments about a point fixed to the clamp, by least squares: M + (fixture - point) x F.

        Point and scale are found together: the equations are linear in both.
        """
        if self.forces is None:
            return None
        m, d = self.forces.shape
        frames = np.broadcast_to(np.eye(d), (m, d, d)) if self.frames is None else self.frames
        # Cross products; in a plane only the component normal to it.
        space = [np.pad(x, ((0, 0), (0, 3 - d))) for x in (*np.moveaxis(frames, 2, 0), self.forces)]
        numbers = self.model.shape[1]
        arms = np.stack([np.cross(axis, space[-1])[:, -numbers:] for axis in space[:d]], 2)
        columns = self.judged(np.concatenate([self.model[..., None], arms], axis=2))
        scale, *arm = np.linalg.lstsq(columns, self.judged(self.measured), rcond=None)[0]
        if scale <= 0:
            return None
        axes = "of the clamp" if self.frames is not None else "of gravity's frame"
        told = listed(-1e3 * np.array(arm) / scale, ".3g")
        how = f"({told}) mm from the fixture along the axes {axes}"
        return self._if_fitting(self.measured - arms @ np.array(arm), how)

    def _if_fitting(self, measured: FloatArray, how: str = "") -> Self | None:
        """Readings changed by fitted numbers, if they fit better than effects leave them.

        Forces of few poses are nearly parallel: a fitted rotation or lever arm explains any error.
        """
        fitted = replace(self, measured=measured, how=how)
        return fitted if len(measured) >= FITTED_READINGS and fitted.misfit < MISREAD else None
