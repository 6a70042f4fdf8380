"""Limits for a cable, and the probability that a new repeat of a pose exceeds them.

A least bend radius sets the limit of the curvature [1/m], which is one over it. A probability is
computed to first order if newly solved shapes agree with it; otherwise it is counted among them.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.special import ndtr

from dlo_casadi.arrays import BoolArray, FloatArray
from dlo_casadi.equilibrium.batch import REACH, BatchEquilibrium
from dlo_casadi.equilibrium.equilibrium import curvatures_along, places_along
from dlo_casadi.equilibrium.solve import solve_equilibrium
from dlo_casadi.equilibrium.spread import Repeats, SolvedCable
from dlo_casadi.model.assembly import Assembly, Inputs, Shapes
from dlo_casadi.model.clips import tangents
from dlo_casadi.model.contact import outwards
from dlo_casadi.model.functions import functions_of
from dlo_casadi.rod.ends import reaction_rows
from dlo_casadi.thresholds import RESOLVED, SAFE

# Number of draws that are solved to check the first order; number if it does not suffice; number
# of draws of the linearised shapes, which cost next to nothing; number of shapes solved at a time.
PAIRED, DRAWN, LINEAR, CHUNK = 600, 2000, 4000, 500
# First-order probabilities between which solved draws decide whether a limit is kept.
IN_DOUBT = SAFE / 10, 2 * SAFE
# Largest step [rad] of a node at which a draw counts as solved: its size need not be exact.
_TOLERANCE = 1e-6
# Step of finite differences along a derivative of the shape, in standard deviations.
_STEP = 1e-3
# Largest number of elements on which a bend is resolved.
FINEST = 640


class Fixture(NamedTuple):
    """What holds the cable: its name, its arc length [m], and whether it takes a moment."""

    name: str
    at: float
    takes_moment: bool


def fixtures_of(held: SolvedCable) -> list[Fixture]:
    """All that holds a cable in a pose: the held ends, then the clips."""
    model = held.model
    ends = (("start", 0.0, model.start), ("end", model.cable.length, model.end))
    turned = functions_of(model).moment_ends
    on_ends = [Fixture(name, at, name in turned) for name, at, kind in ends if kind.place]
    clips = zip(held.pose.clips, held.equilibrium.clips, strict=True)
    return [*on_ends, *(Fixture(x.name, load.at, x.kind.direction) for x, load in clips)]


def places_of(held: SolvedCable, quantity: str) -> tuple[FloatArray, list[str]]:
    """Arc lengths (K,) [m] at which a quantity has values, and the names of what is there.

    The names are those of fixtures; for a clearance, those of the nearest obstacles.
    """
    if quantity in ("force", "moment"):
        own = [item for item in fixtures_of(held) if quantity == "force" or item.takes_moment]
        return np.array([item.at for item in own]), [item.name for item in own]
    there = held.assembly
    if quantity == "clearance":
        names, deep = _depths(there)
        nodes, every = there.clipped.places[0], np.arange(deep.shape[2]) / 4
        along = np.interp(every, np.arange(len(nodes)), nodes)
        return along, [names[k] for k in deep[:, 0].argmax(axis=0)]
    bends = quantity == "curvature"
    places = places_along(there.clipped)[0] if bends else there.clipped.cells[0].mean(axis=1)
    return places, [""] * len(places)


def sizes_of(found: Assembly, quantity: str) -> FloatArray:
    """Sizes (m, K) of a quantity at `places_of`, in repeats of a pose.

    Curvature, twist [1/m]; force [N] and moment [N m] on fixtures; minus the clearance [m].
    """
    if quantity == "clearance":
        _, deep = _depths(found)
        return np.asarray(deep.max(axis=0))
    model, chain, rows = found.model, found.model.chain, reaction_rows(found.model.node)
    if quantity in ("curvature", "twist"):
        strain = found.strain()
        if quantity == "twist":
            return np.abs(strain[:, : chain.n_cells])  # the first strain in space
        return curvatures_along(chain.curvatures(strain), found.clipped)
    reactions, loads = found.reactions(), found.clip_loads()
    held = tuple(side for side in ("start", "end") if getattr(model, side).place)
    ends = held if quantity == "force" else functions_of(model).moment_ends
    each = [reactions[:, rows[f"{side}_{quantity}"]] for side in ends]
    each += [
        np.array([np.atleast_1d(getattr(load[k], quantity)) for load in loads])
        for k, kind in enumerate(model.clips)
        if quantity == "force" or kind.direction
    ]
    return np.stack([np.linalg.norm(one, axis=1) for one in each], axis=1)


def sizes_in(held: SolvedCable, quantity: str) -> FloatArray:
    """Sizes (K,) of a quantity in one shape, see `sizes_of`."""
    return sizes_of(held.assembly, quantity)[0]


def _depths(found: Assembly) -> tuple[list[str], FloatArray]:
    """Obstacles to be avoided, and the depth (n, m, K) [m] of cables in each; outside negative."""
    model, along = found.model, _along(found)
    offsets = found.given.p @ outwards(model).T
    known = [(k, one) for k, one in enumerate(model.obstacles) if not one.touch]
    deep = [offsets[:, [k]] - one.near(along).distance for k, one in known]
    return [one.name for _, one in known], np.array(deep) + model.cable.diameter / 2


def _along(found: Assembly) -> FloatArray:
    """Places (m, K, d) [m] along cables, four per element, interpolated from their nodes."""
    model, points, x = found.model, found.nodes(), found.shapes.x
    size, ways = np.diff(found.clipped.places)[..., None, None], tangents(model.node, x)
    u = np.arange(4)[:, None] / 4
    start, end = points[..., :-1, None, :], points[..., 1:, None, :]
    out, into = size * ways[..., :-1, None, :], size * ways[..., 1:, None, :]
    bulge = u * (1 - u) * ((1 - u) * (out - (end - start)) - u * (into - (end - start)))
    inner = start + u * (end - start) + bulge
    flat = inner.reshape((*points.shape[:-2], -1, points.shape[-1]))
    return np.concatenate([flat, points[..., -1:, :]], axis=-2)


@dataclass(frozen=True, eq=False)
class Exceedance:
    """How likely a quantity exceeds its bound.

    Parameters
    ----------
    std : float
        Standard deviation of the greatest size, to first order.
    probability, error : float
        Probability that a size exceeds its bound, given the parameters' covariance, the fixtures
        and the cable's own scatter; standard error of that, 0 if it is of first order.
    draws : int
        Number of shapes among which it was counted; 0 if it is of first order.
    lost : int
        Number of these shapes that lose stability near the predicted one: the cable snaps. They
        count as exceeding.
    shares : mapping of str to float
        Shares of the variance by cause, see `Uncertainty.causes_in`; the largest first. Empty if
        nothing is uncertain.
    """

    std: float
    probability: float
    error: float
    draws: int
    lost: int
    shares: Mapping[str, float]


class Varied(Repeats):
    """Repeats of a cable's pose, and how likely they exceed limits."""

    def exceedances(self, bounds: Mapping[str, float]) -> dict[str, Exceedance]:
        """Probability that each quantity of `sizes_of` exceeds its bound, and the size's std.

        The sizes g_k(z) depend on standard normal z: the fitted unknowns, the fixtures, the rest
        curvature of a repeat. To first order g(z) = g + J z. This is taken at all places together,
        because any one of several equal bends may become the sharpest:

            P = E[Phi(t_low) + Phi(-t_high)]    (line sampling)

        over z across the direction of the likeliest place; on its line, g stays within the bound
        between t_low and t_high. Newly solved draws show whether this suffices. It does not if
        their probability differs by more than `thresholds.SAFE`, two standard errors
        included, or if the verdict depends on it. The probability is then counted among more solved
        draws and corrected by the first-order result of the same draws (`_counted`).

        References
        ----------
        Koutsourelakis, Pradlwarter, Schueller, Probab. Eng. Mech. 19 (2004): line sampling.
        Glasserman, Monte Carlo Methods in Financial Engineering, 2003, 4.1: control variates.
        """
        names = tuple(bounds)
        causes = self.uncertainty.causes_in(self.held.model)
        sizes, slopes = self.linear(names)
        if not any(map(np.any, self.ways)):
            sure = {x: float((sizes[x] > bounds[x]).any()) for x in names}
            return {x: Exceedance(0.0, sure[x], 0.0, 0, 0, {}) for x in names}
        z = np.random.default_rng(0).standard_normal((LINEAR, len(causes)))
        solved, lost = self._solved(z[:PAIRED], names)
        likely = {x: _crossing(sizes[x], slopes[x], bounds[x], z) for x in names}
        softer: dict[str, FloatArray] = dict.fromkeys(names, np.zeros(1))
        if self.held.model.surfaces:
            # Draws use softer obstacles: allow for how far the predicted shape then sinks in.
            (same, _) = self._solved(0 * z[:1], names)
            softer = {x: same[x] - sizes[x] for x in names}
        anew = {x: _beyond(solved[x] - softer[x], bounds[x]) | lost for x in names}
        linear = {x: _beyond(sizes[x] + z[:DRAWN] @ slopes[x].T, bounds[x]) for x in names}
        enough = {
            x: not IN_DOUBT[0] < likely[x] < IN_DOUBT[1] and _agree(anew[x], linear[x][:PAIRED])
            for x in names
        }
        if not all(enough.values()):
            more, also = self._solved(z[PAIRED:DRAWN], names)
            lost = np.concatenate([lost, also])
            beyond = {x: _beyond(more[x] - softer[x], bounds[x]) | also for x in names}
            anew = {x: np.concatenate([anew[x], beyond[x]]) for x in names}
        out = {}
        for name in names:
            found: tuple[float, float, int, int] = (likely[name], 0.0, 0, 0)
            if not enough[name]:
                counted = _counted(anew[name], linear[name], likely[name])
                found = *counted, len(lost), int(lost.sum())
            parts = slopes[name][sizes[name].argmax()] ** 2
            total = float(parts.sum())
            shares = {
                cause: float(parts[[x == cause for x in causes]].sum()) / max(total, 1e-300)
                for cause in dict.fromkeys(causes)
            }
            largest_first = dict(sorted(shares.items(), key=lambda item: -item[1]))
            out[name] = Exceedance(float(np.sqrt(total)), *found, largest_first)
        return out

    def linear(self, names: tuple[str, ...]) -> tuple[dict[str, FloatArray], dict[str, FloatArray]]:
        """Sizes (K,) and their derivatives (K, q) by the ways in which a repeat may differ."""
        count = len(self.uncertainty.causes_in(self.held.model))
        z = _STEP * np.vstack([np.eye(count), -np.eye(count), np.zeros((1, count))])
        near = Assembly(self.larger, self._near(z), self._given(z))
        found = {name: sizes_of(near, name) for name in names}
        slopes = {name: x[:count] - x[count : 2 * count] for name, x in found.items()}
        sizes = {name: x[-1] for name, x in found.items()}
        return sizes, {name: np.asarray(x.T / (2 * _STEP)) for name, x in slopes.items()}

    def _given(self, z: FloatArray) -> Inputs:
        """Inputs of repeats z (m, q); stiffnesses are log-normal, all values within bounds."""
        (by_p, by_rest, _), held = self.ways, self.held
        own, parameters, steps = held.p, held.model.parameters, z @ by_p.T
        log = np.array([q.log for q in parameters])
        p = own + np.where(log, 0.0, steps)
        p[:, log] = own[log] * np.exp(steps[:, log] / own[log])
        # A declared value may be outside of the bounds of an estimation.
        lower = np.minimum(own, [q.lower for q in parameters])
        p = np.clip(p, lower, np.maximum(own, [q.upper for q in parameters]))
        poses = np.broadcast_to(held.pose.vector, (len(z), held.model.n_pose))
        return Inputs.of(p, held.rest + z @ by_rest.T, poses)

    def _near(self, z: FloatArray) -> Shapes:
        """Shapes of repeats z (m, q) to first order."""
        shapes, along = self.held.equilibrium.shapes, self.along
        start = np.repeat(shapes.x, len(z), axis=0)
        x = self.held.model.node.moved(start, np.einsum("nbq,mq->mnb", along.x[0], z))
        near = np.repeat(shapes.near, len(z), axis=0)
        return Shapes(x, shapes.lam + z @ along.lam[0].T, z @ along.deviation[0].T, near)

    def _solved(
        self, z: FloatArray, names: tuple[str, ...]
    ) -> tuple[dict[str, FloatArray], BoolArray]:
        """Sizes (m, K) of repeats z (m, q), newly solved, and which repeats (m,) are lost."""
        guesses, given = self._near(z), self._given(z)
        parts: dict[str, list[FloatArray]] = {name: [] for name in names}
        lost = []
        for begin in range(0, len(z), CHUNK):
            some = slice(begin, begin + CHUNK)
            own, start = given.subset(some), guesses.subset(some)
            batch = BatchEquilibrium(self.larger, [self.held.pose] * len(start.x))
            shapes, converged = batch.solve_or_descend(start, own.p, own.rest, tolerance=_TOLERANCE)
            # A descent may end in a shape far away, to which the cable snaps.
            way = np.abs(self.held.model.node.difference(start.x, shapes.x)).max(axis=(1, 2))
            near = converged & (way <= REACH)
            lost.append(~(near & batch.stable(shapes, own.p, own.rest)))
            solved = Assembly(self.larger, shapes, own)
            for name in names:
                parts[name].append(sizes_of(solved, name))
        return {name: np.concatenate(x) for name, x in parts.items()}, np.concatenate(lost)


def _crossing(sizes: FloatArray, slopes: FloatArray, bound: float, z: FloatArray) -> float:
    """Probability that one of the sizes (K,) + slopes (K, q) z exceeds the bound, see `Varied`."""
    std = np.linalg.norm(slopes, axis=1)
    k = int(((bound - sizes) / np.maximum(std, 1e-300)).argmin())
    if not std[k] > 0:
        return float((sizes > bound).any())
    direction = slopes[k] / std[k]
    across = z - np.outer(z @ direction, direction)
    spare, rate = bound - sizes - across @ slopes.T, slopes @ direction
    with np.errstate(divide="ignore", invalid="ignore"):
        reached = spare / rate
    high = np.where(rate > 0, reached, np.inf).min(axis=1)
    low = np.where(rate < 0, reached, -np.inf).max(axis=1)
    nowhere = (low >= high) | ((rate == 0) & (spare < 0)).any(axis=1)
    return float(np.where(nowhere, 1.0, ndtr(low) + ndtr(-high)).mean())


def _beyond(sizes: FloatArray, bound: float) -> BoolArray:
    """Whether any size of each draw (m,) exceeds the bound."""
    return np.asarray((sizes > bound).any(axis=1))


def _agree(anew: BoolArray, linear: BoolArray) -> bool:
    """Whether solved draws confirm the first-order probability, within two standard errors."""
    apart = anew.astype(float) - linear
    error = float(np.sqrt((apart**2).mean() / len(apart)))
    return bool(abs(apart.mean()) + 2 * error <= SAFE)


def _counted(anew: BoolArray, linear: BoolArray, expected: float) -> tuple[float, float]:
    """Probability counted among newly solved draws (m,), and its standard error.

        P = mean(anew) + b (expected - mean(linear)),   b = cov(anew, linear) / var(linear)

    The same draws to first order serve as control variate, because their expectation is known.
    """
    a, c = anew - anew.mean(), linear - linear.mean()
    b = float(a @ c / max(c @ c, 1e-300))
    chance = float(anew.mean() + b * (expected - linear.mean()))
    return min(max(chance, 0.0), 1.0), float(np.linalg.norm(a - b * c) / len(a))


def resolved(held: SolvedCable, coefficients: FloatArray) -> list[SolvedCable]:
    """The same shape on finer meshes; the last mesh resolves its sharpest bend.

    Elements are halved until the least bend radius changes by less than `thresholds.RESOLVED`. On a
    coarse mesh the radius of the segments, like that of the curve, is too large: beside a clamp of
    a soft cable by tens of percent. `coefficients` (n_coefficients,) [1/m]: of the rest curvature.
    """
    model, found = held.model, held.equilibrium
    meshes, settled = [held], False
    while not settled and 2 * model.n <= FINEST:
        finer = model.with_mesh(2 * model.n)
        start = model.node.interpolated(finer.chain.places, model.chain.places, found.x)
        rest = finer.rest_basis @ coefficients
        better = solve_equilibrium(finer, held.p, rest, held.pose, x_init=start)
        settled = abs(better.min_bend_radius / found.min_bend_radius - 1) < RESOLVED
        model, found = finer, better
        meshes.append(SolvedCable(model, held.p, rest, held.pose, found))
    return meshes
