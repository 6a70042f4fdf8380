"""The centre-line of a cable in space as one photograph shows it, in pixels."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.ndimage import label
from scipy.spatial import cKDTree

from dlo_casadi.errors import VisionError
from dlo_casadi.vision.centerline import measure_line
from dlo_casadi.vision.curve import chord_length, fit_curve
from dlo_casadi.vision.ordering import Course
from dlo_casadi.vision.refine import EdgeShape, average, find_edges, sample_profiles
from dlo_casadi.vision.trace import FINE
from dlo_casadi.vision.view import Array
from dlo_casadi.vision.viewpoint import Viewpoint
from dlo_casadi.vision.workings import Workings

_NEAREST = 0.2  # m: no cable is photographed from nearer than that
_BESIDE = 1.6  # widths: stretches that lie nearer to each other share an edge
_APART = 2.0  # widths along the line: what is nearer is the same stretch
TIP = 4.0  # widths: a line that ends farther from a fixture is told of


@dataclass(frozen=True)
class Sight:
    """The centre-line in one photograph, ordered from start to end.

    Parameters
    ----------
    viewpoint : Viewpoint
        Where the camera stands.
    pixels : (K, 2) [px]
        Middle of the cable's outline, as photographed.
    std : (K,) [px]
        Standard deviation of each across the line.
    whole : (K,) bool
        Both edges are seen; where not, another stretch of the cable lies beside or behind, and
        the pixel is only somewhere in their common outline.
    width : scalar [px]
        Distance of the two edges, the median along the line.
    width_std : scalar [px]
        Its scatter along the line.
    diameter : scalar [m]
        Of the cable, as declared.
    distance : scalar [m]
        Depth at which the picture was searched: between the fixtures.
    correlation : scalar [px]
        Length along the line over which neighbours share their errors, the integral of the
        correlation: pixels are averaged along the cable by a Gaussian.
    confidence : scalar in 0..1
        Share of the line inside the picture that was measured soundly.
    messages : tuple of str
        What a user should know.
    direction, blur : (3,), scalar [px]
        Colours by which the cable stands out, and the blur of its edges.
    """

    viewpoint: Viewpoint
    pixels: Array
    std: Array
    whole: NDArray[np.bool_]
    width: float
    width_std: float
    diameter: float
    distance: float
    correlation: float
    confidence: float
    messages: tuple[str, ...]
    direction: Array
    blur: float

    @property
    def spacing(self) -> float:
        """Distance [px] of neighbouring pixels, the median."""
        return float(np.median(np.linalg.norm(np.diff(self.pixels, axis=0), axis=1)))

    @property
    def rays(self) -> Array:
        """Undistorted rays (K, 2) of the pixels."""
        return self.viewpoint.rays(self.pixels)


def see_cable(
    image: NDArray[np.uint8],
    viewpoint: Viewpoint,
    *,
    start: ArrayLike,
    end: ArrayLike | None,
    diameter: float,
    length: float,
    workings: Workings | None = None,
) -> Sight:
    """Find the cable in front of the board, order it from start to end, refine it to sub-pixel.

    The photograph is searched as the plane that faces the camera at the distance of the fixtures.

    Parameters
    ----------
    image : (H, W, 3) uint8
        The photograph, blue, green, red.
    viewpoint : Viewpoint
        Where the camera stands.
    start, end : (3,) [m]
        The fixtures in the board frame; `end` is None for a free end.
    diameter, length : scalar [m]
        Of the cable.
    workings : Workings, optional
        Is filled with what the steps have seen, also where one of them fails.

    Raises
    ------
    VisionError
        If no cable or more than one is found, or if it does not lead to the fixtures.
    """
    declared = [np.asarray(at, float) for at in (start, end) if at is not None]
    fixtures = viewpoint.in_camera(np.array(declared))
    if fixtures[:, 2].min() < _NEAREST:
        raise VisionError(
            f"a fixture would be {fixtures[:, 2].min():.2f} m before the camera. "
            "Try: start and end in metres and in the board frame, z out of the board?"
        )
    distance = float(fixtures[:, 2].mean())
    view = viewpoint.facing(distance)
    flat = viewpoint.flattened(declared, distance)
    last = None if end is None else flat[1]
    line = measure_line(
        image,
        view,
        flat[0],
        last,
        diameter,
        _course(fixtures, flat, distance, length, diameter),
        workings or Workings(),
    )
    trace = line.trace
    pixel = 1.0 / view.scale
    width = trace.shape.width
    beside = other_stretches(trace.points, trace.t, width)
    hidden = np.isfinite(beside) & trace.inside
    step = np.median(np.diff(trace.t[line.kept]))
    every = max(1, round(step / np.median(np.diff(trace.t))))
    shared = np.nonzero(hidden)[0][::every]
    kept = np.sort(np.concatenate([line.kept[~hidden[line.kept]], shared]))
    pixels = view.to_pixels(trace.points[kept])
    tips = [(np.linalg.norm(trace.points[kept[0]] - flat[0]), "start")]
    if last is not None:
        tips.append((np.linalg.norm(trace.points[kept[-1]] - last), "end"))
    return Sight(
        viewpoint,
        pixels,
        np.where(hidden[kept], 0.5 * width, trace.std[kept]) / pixel,
        ~hidden[kept],
        width / pixel,
        trace.width_std / pixel,
        diameter,
        distance,
        FINE * np.sqrt(np.pi) * diameter / pixel,
        line.confidence,
        (
            *line.messages,
            *(
                f"the line in the photograph ends {away / pixel:.0f} px from where the {name} is "
                "declared"
                for away, name in tips
                if away > TIP * width
            ),
        ),
        trace.direction,
        trace.shape.blur / pixel,
    )


def _course(
    fixtures: Array, flat: Array, distance: float, length: float, diameter: float
) -> Course:
    """How long the line may be in the facing plane.

    At least the way between the fixtures there, or some diameters. At most the cable where it is
    nearest: half of what is not needed to reach from one fixture to the other can lead ahead.
    """
    if len(fixtures) == 1:
        nearest = fixtures[0, 2] - length
        shortest = 0.0
    else:
        chord = float(np.linalg.norm(fixtures[1] - fixtures[0]))
        ahead = 0.5 * np.sqrt(max(length**2 - chord**2, 0.0))
        nearest = fixtures[:, 2].min() - 0.5 * ahead
        shortest = float(np.linalg.norm(flat[1] - flat[0]))
    longest = length * distance / max(nearest, 0.5 * distance)
    return Course(max(shortest, 10 * diameter), max(longest, length), in_space=True)


def other_stretches(points: Array, t: Array, width: float) -> Array:
    """Where another stretch of a line lies beside each of its points.

    Parameters
    ----------
    points : (K, 2)
        Along the line, closely spaced.
    t : (K,)
        Length up to each.
    width : scalar
        Of the line, in the units of the points.

    Returns
    -------
    (K,) signed distance to the nearest other stretch, positive to the left; nan where there is
    none that shares an edge.
    """
    tangent = np.gradient(points, axis=0)
    tangent /= np.maximum(np.linalg.norm(tangent, axis=1, keepdims=True), 1e-12)
    pairs = cKDTree(points).query_pairs(_BESIDE * width, output_type="ndarray")
    here, there = np.vstack([pairs, pairs[:, ::-1]]).T
    other = np.abs(t[there] - t[here]) > _APART * width
    here, there = here[other], there[other]
    across = points[there] - points[here]
    along = np.sum(across * tangent[here], axis=1)
    offset = across[:, 1] * tangent[here, 0] - across[:, 0] * tangent[here, 1]
    level = np.abs(along) < 1.5 * float(np.median(np.diff(t)))
    here, offset = here[level], offset[level]
    farthest_first = np.argsort(-np.abs(offset))
    beside = np.full(len(points), np.nan)
    beside[here[farthest_first]] = offset[farthest_first]
    return beside


def loops_either_way(sight: Sight) -> list[Sight]:
    """The sight as it was ordered, and with each loop of its line run through the other way.

    Where a line meets itself, one photograph tells little of whether its two stretches cross or
    turn back: the loop between them may be in either order.
    """
    apart = np.linalg.norm(sight.pixels[:, None] - sight.pixels[None], axis=2)
    t = chord_length(sight.pixels)
    meets = (apart < sight.width) & (t[None] - t[:, None] > _APART * sight.width)
    labels, count = label(meets, np.ones((3, 3)))
    ways = [sight]
    for where in range(1, count + 1):
        i, j = np.unravel_index(np.where(labels == where, apart, np.inf).argmin(), apart.shape)
        order = np.arange(len(t))
        order[i + 1 : j] = order[i + 1 : j][::-1]
        ways.append(
            replace(
                sight,
                pixels=sight.pixels[order],
                std=sight.std[order],
                whole=sight.whole[order],
            )
        )
    return ways


def see_beside(
    image: NDArray[np.uint8],
    sight: Sight,
    curve: Array,
    params: Array,
    params_seen: Array,
    crossed: bool | None = None,
) -> tuple[Sight, Array]:
    """Measure the stretches that share an outline, given on which side each of them lies.

    An outline of width W holds two stretches of the width w, known from the rest of the line and
    the distance from the camera: their middles lie (W - w) / 2 beside its own, to either side.

    Parameters
    ----------
    image : (H, W, 3) uint8
        The photograph.
    sight : Sight
        What was seen in it without knowing the line in space.
    curve : (M, 3) [m]
        The line in space, closely spaced.
    params : (M,)
        Increasing parameter along it.
    params_seen : (K,)
        Parameters of the pixels of the sight; nan for those that do not belong to it.
    crossed : bool, optional
        Whether two stretches change sides where their outline is narrowest, or keep the sides on
        which they lie where it is widest. The sides are those of the curve where this is not given.

    Returns
    -------
    The sight, in the order of the curve, and the parameters of its pixels.
    """
    viewpoint, distance = sight.viewpoint, sight.distance
    view = viewpoint.facing(distance)
    pixel = 1.0 / view.scale
    at, flat = viewpoint.in_camera(curve), viewpoint.flattened(curve, distance)
    t = chord_length(flat)
    beside = other_stretches(flat, t, sight.width * pixel)
    hidden = np.isfinite(beside)
    depth = float(np.median(at[~hidden, 2])) if not hidden.all() else distance
    width = sight.width * pixel * depth / at[:, 2]
    usual = float(width.mean())
    keep = sight.whole & np.isfinite(params_seen)
    keep &= ~(np.interp(params_seen, params, hidden.astype(float)) > 0.5)
    pixels, std, places = [sight.pixels[keep]], [sight.std[keep]], [params_seen[keep]]
    bright = image.astype(np.float32)
    spacing = pixel * sight.spacing
    for run in _runs(hidden):
        if t[run[-1]] - t[run[0]] < usual:
            continue
        tangent = np.gradient(flat[run], axis=0)
        tangent /= np.maximum(np.linalg.norm(tangent, axis=1, keepdims=True), 1e-12)
        normal = np.column_stack([-tangent[:, 1], tangent[:, 0]])
        middle = flat[run] + 0.5 * beside[run, None] * normal
        line = fit_curve(t[run], middle, np.ones(len(run)), usual, 0.3 * usual)
        profiles = sample_profiles(bright, view, line, t[run], usual)
        smooth = average(profiles, profiles.inside, FINE * usual)
        both = EdgeShape(usual + float(np.abs(beside[run]).max()), sight.blur * pixel)
        found = find_edges(smooth, sight.direction, both)
        apart = np.maximum(found.width - width[run], 0.0)
        side = _sides(beside[run], apart, crossed)
        points = line.position(t[run]) + (found.offset - 0.5 * side * apart)[:, None] * (
            line.normal(t[run])
        )
        good = profiles.inside & (np.abs(apart - np.abs(beside[run])) < 0.5 * usual)
        good &= np.diff(np.floor(t[run] / spacing), prepend=-1.0) > 0
        if not good.any():
            continue
        pixels.append(view.to_pixels(points[good]).reshape(-1, 2))
        # Both the outline and the rest of the line tell how far apart the two lie.
        doubt = 0.5 * float(np.sqrt(np.mean((apart - np.abs(beside[run]))[good] ** 2))) / pixel
        told = np.sqrt(np.median(sight.std) ** 2 + (0.5 * sight.width_std) ** 2 + doubt**2)
        std.append(np.full(int(good.sum()), told))
        places.append(params[run][good])
    order = np.argsort(np.concatenate(places), kind="stable")
    again = replace(
        sight,
        pixels=np.vstack(pixels)[order],
        std=np.concatenate(std)[order],
        whole=np.ones(len(order), bool),
    )
    return again, np.concatenate(places)[order]


def _sides(beside: Array, apart: Array, crossed: bool | None) -> Array:
    """Side (K,) on which the other stretch lies: 1 to the left, -1 to the right."""
    if crossed is None:
        return np.sign(beside)
    widest_last = abs(beside[-1]) > abs(beside[0])
    side = np.full(len(beside), np.sign(beside[-1 if widest_last else 0]))
    if crossed:
        narrowest = int(np.argmin(apart))
        beyond = slice(None, narrowest) if widest_last else slice(narrowest, None)
        side[beyond] *= -1
    return side


def _runs(flags: NDArray[np.bool_]) -> list[NDArray[np.intp]]:
    """Indices of each run of true flags."""
    at = np.nonzero(flags)[0]
    return [run for run in np.split(at, np.nonzero(np.diff(at) > 1)[0] + 1) if len(run) > 3]
