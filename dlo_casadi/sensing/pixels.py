"""A photograph of a cable in space as a sensor: pixels compared across the projected cable."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.linalg import solve_triangular

from dlo_casadi.arrays import FloatArray, chord_lengths, unit
from dlo_casadi.equilibrium.curve import NodeCurve, Observed, ObservedChange
from dlo_casadi.sensing.noise import NoiseModel
from dlo_casadi.sensing.sensors import Sensor
from dlo_casadi.vision import CameraPose, ImageCurve, compare_pixels, nearest_in_order

_TOLERANCE = 1e-5  # of the length: the residual's error is half the curvature times its square
# Distance from an end of the line within which pixels are left out, in std of the average along the
# cable. Pixels of 66 rendered photographs are 0.011 px RMS off the true curve; 0.03 px within 3 std
# of an end, 0.02 px within 4.
_REACH = 4.0
# Largest std of a pixel over the median one: if stretches share an outline it is 0.2 to 0.4 px.
_UNSURE = 2.0
# Largest displacement by the average along a bent line, in std of the pixel, see
# `bent_within_average`.
_BENT = 1.5
_SURE_PX = 2.0  # largest distance of a pixel from an approximate curve


@dataclass(frozen=True)
class ViewInput:
    """One of several photographs of a pose in space.

    Parameters
    ----------
    name : str
        File stem.
    seen : ImageCurve
        The line found in it.
    places : (K, 3) [m]
        Approximate places of its pixels in space; nan for pixels that do not belong to the cable.
    """

    name: str
    image: Path
    seen: ImageCurve
    places: FloatArray


@dataclass(frozen=True)
class Pixels(Sensor):
    """Pixels of one photograph, compared with the middle of the outline that a curve would have.

        d_k = c n_k . (u_k - m(r(s_k)))                                      [m]

    with the pixel u, the middle m of the projected outline, its normal n, and the size c of a pixel
    at the cable's distance. d is the distance across the line of sight, in the units of other
    sensors. The places s_k are nearest in the picture, where d is stationary in s.

    The camera's pose is known from the board's markers. Its error, a rotation and a shift, moves
    all pixels of a photograph together and is part of their covariance.

    Parameters
    ----------
    viewpoint : CameraPose
        Where the camera stands.
    pixels : (K, 2) [px]
        As photographed, from start to end.
    diameter : scalar [m]
        Of the cable.
    points : (K, 3) [m]
        Their approximate places.
    weight : (K,)
        Relative standard deviations.
    size : scalar [m/px]
        Of a pixel at the cable.
    by_camera : (K, 6) [m]
        Change of the residuals by one standard deviation of each error of the camera's pose.
    correlation_length : scalar [m]
        Length over which the average along the cable correlates the pixels' errors. The noise model
        describes other correlations, such as by light that changes along the cable.
    on_line : bool
        Whether the points are those of a measured line in space, not guessed.
    """

    viewpoint: CameraPose
    pixels: FloatArray
    diameter: float
    points: FloatArray
    weight: FloatArray
    size: float
    by_camera: FloatArray
    correlation_length: float = 0.0
    on_line: bool = False

    per_point = 1

    @property
    def together(self) -> FloatArray:
        """Change (K, 6) [m] of the residuals by one std of each error of the camera's pose."""
        return self.by_camera

    def located(self, seen: Observed, places: FloatArray) -> FloatArray:
        """Arc lengths (K,) [m] whose images are nearest to the pixels, near those given."""
        return self._nearest(seen.curve, places)

    def nearest(self, curve: NodeCurve) -> FloatArray:
        """Arc lengths (K,) [m] of the pixels on a curve that may be far off, by global search.

        The nearest in space; for a single photograph the nearest in the picture, in order along it.
        """
        if self.on_line:
            return self._nearest(curve, curve.nearest(self.points))
        seen = self.viewpoint.to_pixels(curve.at(curve.grid))
        away = np.linalg.norm(self.pixels[:, None] - seen[None], axis=2)
        found = nearest_in_order(away / (_SURE_PX + np.median(away.min(axis=1))))
        known = np.flatnonzero(found >= 0)
        guess = np.interp(np.arange(len(found)), known, curve.grid[found[known]])
        return self._nearest(curve, guess)

    def _nearest(self, curve: NodeCurve, guess: FloatArray) -> FloatArray:
        """Gauss-Newton steps on the distance in the picture, within [0, L]."""

        def step(s: FloatArray) -> FloatArray:
            position, tangent = curve.frame(s, 1)
            seen, slopes = self.viewpoint.project(position)
            along = np.einsum("kij,kj->ki", slopes, tangent)
            ahead = np.sum((self.pixels - seen) * along, axis=1)
            return np.asarray(ahead / np.maximum(np.sum(along**2, axis=1), 1e-12))

        return curve.followed(guess, step, _TOLERANCE)

    def _compared(self, curve: NodeCurve, places: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Residuals (K,) [m] and their derivatives (K, 3) by the curve's points."""
        position, tangent = curve.frame(places, 1)
        tangent = unit(tangent)
        away, by = compare_pixels(self.viewpoint, self.pixels, position, tangent, self.diameter)
        return self.size * away, self.size * by

    def components(self, curve: NodeCurve, places: FloatArray, moved: FloatArray) -> FloatArray:
        """Change (K, q) of the residual by displacements (K, 3, q) [m] of the measured points."""
        return np.asarray(-np.einsum("kd,kdq->kq", self._compared(curve, places)[1], moved))

    def residual(self, seen: Observed, places: FloatArray) -> FloatArray:
        """Measured minus model (K,) [m]."""
        return self._compared(seen.curve, places)[0]

    def linearized(
        self, seen: Observed, places: FloatArray, along: ObservedChange
    ) -> tuple[FloatArray, FloatArray]:
        """Residual (K,) [m] and its change (K, q) along directions."""
        away, by = self._compared(seen.curve, places)
        moved = seen.curve.moved(places, along.curve, along.knots)
        return away, np.einsum("kd,kdq->kq", by, moved)

    def whitening(self, noise: NoiseModel, places: FloatArray) -> FloatArray:
        """Matrix W (K, K) [1/m] with W cov W^T = 1, including errors of the camera's pose."""
        white = noise.whitening(places, self.weight, self.correlation_length)
        seen = white @ self.by_camera
        factor = np.linalg.cholesky(np.eye(len(seen)) + seen @ seen.T)
        return np.asarray(solve_triangular(factor, white, lower=True))


def pixel_std(views: Sequence[ViewInput]) -> float:
    """Median standard deviation [m] of the pixels of photographs, at the cable's distance."""
    return float(np.median(np.concatenate([view.seen.std * _size(view) for view in views])))


def pixels_of(view: ViewInput, std: float, on_line: bool = False) -> Pixels | None:
    """The sensor of a photograph; None if none of its pixels belongs to the cable.

    Errors of neighbouring pixels are correlated over the length of the average along the cable, so
    pixels are taken at that spacing. A pixel is left out if its average reaches beyond an end of
    the line, into the holder; if another part of the cable hides an edge; or if the line turns
    sharply within the average, as where the cable runs along its depth. `view`: with the line found
    in it. `std` [m]: standard deviation of a pixel of weight one.
    """
    curve = view.seen
    every = max(1, int(np.ceil(curve.correlation / curve.spacing)))
    along = chord_lengths(curve.pixels)
    sure = curve.whole & (curve.std < _UNSURE * np.median(curve.std))
    sure &= np.isfinite(view.places[:, 0])
    foreign = np.concatenate([[0.0], along[~sure], along[-1:]])
    away, reach = np.abs(along[:, None] - foreign).min(axis=1), _REACH * curve.correlation
    sure &= bent_within_average(curve) < _BENT * curve.std
    kept = np.flatnonzero((away > reach / np.sqrt(np.pi)) & sure)[::every]
    if len(kept) < 2:
        return None
    size, pixels, points = _size(view), curve.pixels[kept], view.places[kept]
    tangent = np.gradient(pixels, axis=0)
    normal = unit(np.column_stack([-tangent[:, 1], tangent[:, 0]]))
    viewpoint = curve.viewpoint
    by_shift = np.einsum("ki,kij->kj", normal, viewpoint.project(points)[1])
    by_shift = by_shift @ viewpoint.rotation.T
    by_turn = np.cross(viewpoint.in_camera(points), by_shift)
    error = np.linalg.cholesky(viewpoint.covariance)
    together = size * np.column_stack([by_turn, by_shift]) @ error
    weight = curve.std[kept] * size / std
    # Errors of a Gaussian average are correlated over sqrt(2) times its own length.
    correlation_length = np.sqrt(2.0 / np.pi) * curve.correlation * size
    return Pixels(
        viewpoint,
        pixels,
        curve.diameter,
        points,
        weight,
        size,
        together,
        correlation_length,
        on_line,
    )


def bent_within_average(curve: ImageCurve) -> FloatArray:
    """Displacement (K,) [px] of each pixel by the average along a bent line: k w^2 / 2.

    It is the distance from the middle of its neighbours, one std w of the average to either side,
    with k the curvature in the picture. Averages are taken about a curve that follows the line, so
    that about a fifth of it is left. A cable that runs along its depth turns sharply in a picture.
    In 66 photographs by two renderers RMS errors of pixels were 0.011 px where it is below 0.1 px,
    0.02 to 0.05 px at 0.2, 0.1 px at 0.5, 0.2 px beyond 1, at any angle to the line of sight.
    """
    along, half = chord_lengths(curve.pixels), curve.correlation / np.sqrt(np.pi)
    ahead, behind = (
        np.stack([np.interp(along + way, along, x) for x in curve.pixels.T], axis=1)
        for way in (half, -half)
    )
    return np.asarray(np.linalg.norm((ahead + behind) / 2 - curve.pixels, axis=1))


def _size(view: ViewInput) -> float:
    """Median size [m] of a pixel at the cable."""
    viewpoint = view.seen.viewpoint
    depth = viewpoint.in_camera(view.places)[:, 2]
    return float(np.nanmedian(depth)) / viewpoint.camera.focal
