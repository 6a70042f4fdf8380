"""Place clips: find arc lengths and positions that keep limits over several poses of the ends.

A minimax problem: z are the arc lengths and places of the clips, u_r(z) the used share of its limit
at one arc length of one pose,

    min_z max_r u_r(z)    s.t.   low <= place <= high,   |chord of a span| <= ROOM x its cable

or the largest force is minimized subject to u_r(z) <= 1. Each step solves the linear program of the
first-order model within a trust region, and is accepted if the newly solved shapes confirm it.

References
----------
Madsen, IMA J. Appl. Math. 16 (1975): minimax solutions by linear programs in a trust region.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import ArrayLike
from scipy.optimize import linprog, minimize

from dlo_casadi.arrays import FloatArray
from dlo_casadi.cable.estimate import EstimatedCable
from dlo_casadi.cable.held import FED, HELD, held_pose
from dlo_casadi.cable.limits import Asked, LimitUse, Resolved, asked_limits, bounds_of
from dlo_casadi.config import Clip, Limits
from dlo_casadi.effects import ALONG_CABLE
from dlo_casadi.equilibrium.limits import Varied, fixtures_of, sizes_in
from dlo_casadi.equilibrium.pose import HeldPose
from dlo_casadi.equilibrium.solve import solve_equilibria
from dlo_casadi.equilibrium.spread import SolvedCable, Uncertainty
from dlo_casadi.errors import DloError, EquilibriumError, counted
from dlo_casadi.model.clips import HeldClip
from dlo_casadi.model.pose_scatter import PoseScatter
from dlo_casadi.rod.supports import SupportKind
from dlo_casadi.runtime.progress import Progress, Step, nobody
from dlo_casadi.show.text import vector

Aim = Literal["margin", "force"]
Sizes = Mapping[str, FloatArray]
# Largest chord of a span relative to its cable: beyond it 1 mm changes the pull of a span of 0.25 m
# by a sixth or more. First guesses use a smaller ratio if possible.
ROOM, ROOMY = 0.95, (0.8, 0.9, 0.95)
# First, largest and last radius of the trust region, in lengths of the cable.
FIRST, LARGEST, LAST = 0.05, 0.2, 1e-4
# Number of first guesses, and of steps from each.
GUESSES, TRIED = 16, 6
# Number of the best guesses that continue, and their maximum number of steps.
STARTS, STEPS = 3, 60
# Maximum number of rounds, after each of which bends are resolved.
ROUNDS = 4
# Scatter of first guesses [lengths].
SCATTER = 0.05
# Weight of a share beyond a limit relative to the minimized force.
PENALTY = 10.0
# Rounds end when the resolved use of bends changes by less than this relative amount.
SETTLED = 5e-3
# Name of the work in its progress.
WORK = "place the clips"
_TRY = "within=((0.1, 0.0), (0.3, 0.2)) [m]: two opposite corners"


@dataclass(frozen=True, eq=False)
class Placing:
    """Pinned clips, and the use of limits by the cable between them.

    Parameters
    ----------
    clips : tuple of Clip
        In the form that `FittedCable.solve` takes.
    uses : tuple of LimitUse
        For each limit in each pose; empty without limits.
    force : float [N]
        Largest force of the cable on any of its fixtures and clips, over all poses.
    at : str
        Fixture and pose of that force.
    """

    clips: tuple[Clip, ...]
    uses: tuple[LimitUse, ...]
    force: float
    at: str

    @property
    def binding(self) -> LimitUse | None:
        """The most used limit, with its pose and place; None without limits."""
        return min(self.uses, key=lambda use: use.margin, default=None)

    @property
    def margin(self) -> float:
        """Remaining share of the most used limit: 1 = nothing used, < 0 = violated."""
        return 1.0 if self.binding is None else self.binding.margin

    def __str__(self) -> str:
        lines = [f"{counted(len(self.clips), 'pinned clip')}, margin {self.margin:.1%}"]
        for clip in self.clips:
            lines.append(f"  {clip.name}: at {clip.at:.4f} m, {vector(clip.place, '.4f', 'm')}")
        if self.binding is not None:
            lines.append(f"  binds: {self.binding}")
        return "\n".join([*lines, f"  greatest force: {self.force:.4g} N on the {self.at}"])

    __repr__ = __str__


def placed(
    cable: EstimatedCable,
    count: int,
    poses: Sequence[Mapping[str, Any]],
    within: ArrayLike,
    limits: Asked,
    aim: Aim,
    progress: Progress | None = None,
) -> Placing:
    """See `FittedCable.place`."""
    if aim not in get_args(Aim):
        raise DloError(f"aim: one of {', '.join(get_args(Aim))} belongs here, found {aim!r}")
    if isinstance(count, bool) or not isinstance(count, int | np.integer) or count < 1:
        raise DloError(f"count: a number of clips, 1 or more, belongs here, found {count!r}")
    listed = poses if isinstance(poses, list | tuple) else ()
    if not listed or not all(isinstance(pose, Mapping) for pose in listed):
        belongs = "poses: [{'end': (0.3, -0.1)}, ...] belongs here, as `solve` takes them"
        raise DloError(f"{belongs}, found {poses!r}")
    if strange := [key for pose in poses for key in pose if key not in HELD]:
        text = f"poses: {strange[0]!r} is not about the ends of a pose without clips"
        raise DloError(f"{text}.\n  Try: {', '.join(HELD)}")
    try:
        region = np.array(within, dtype=float)
    except (TypeError, ValueError):
        region = np.full(1, np.nan)
    d = cable.model.node.dimension
    if region.shape != (2, d) or not np.isfinite(region).all():
        raise DloError(
            f"within: two corners of a region belong here, found {within!r}.\n  Try: {_TRY}"
        )
    known = cable.metadata
    default: dict[str, Any] = {"turns": 0.0, "branch": None, "clips": []}
    default |= dict.fromkeys(FED)
    held = tuple(
        replace(held_pose(cable.model, known.fixtures, default | dict(pose)), name=f"pose_{k}")
        for k, pose in enumerate(poses, start=1)
    )
    between, asked = cable.with_clips([SupportKind.PINNED] * int(count)), Limits()
    if aim == "margin" or limits is not None or known.limits.given:
        asked = asked_limits(between, limits)
    box = np.sort(region, axis=0) / cable.model.cable.length
    step = nobody if progress is None else progress.step
    return _Search(between, held, box, asked, aim, step).best()


@dataclass(frozen=True)
class _Trial:
    """The lowest shapes of all poses with the clips at z.

    `sizes`: of each pose by name; `aims` (R,) are minimized, `others` (S,) kept below 1.
    """

    z: FloatArray
    shapes: tuple[Resolved, ...]
    sizes: tuple[Sizes, ...]
    aims: FloatArray
    others: FloatArray

    @property
    def merit(self) -> float:
        return float(self.aims.max() + PENALTY * max(self.others.max(initial=0.0) - 1, 0.0))


@dataclass(frozen=True, eq=False)
class _Search:
    """Search for z (count (1 + d),) in cable lengths: arc length and place of each clip.

    `poses`: without clips; `region` (2, d): in cable lengths.
    """

    cable: EstimatedCable
    poses: tuple[HeldPose, ...]
    region: FloatArray
    limits: Limits
    aim: Aim
    step: Step = nobody

    @cached_property
    def count(self) -> int:
        return len(self.cable.model.clips)

    @cached_property
    def length(self) -> float:
        """Length of the cable [m]."""
        return self.cable.model.cable.length

    @cached_property
    def slipping(self) -> EstimatedCable:
        """The cable with each clip's slip as a parameter: derivatives by it are those by `at`."""
        model, p = self.cable.model, self.cable.p
        for k in range(self.count):
            if (slip := ALONG_CABLE(clip=k)).label not in [
                effect.label for effect in model.effects
            ]:
                model, p = model.with_effect(slip), np.append(p, 0.0)
        return replace(self.cable, model=model, p=p)

    @cached_property
    def clip_moves(self) -> Uncertainty:
        """Slips and moves of clips by 1 m, as uncertain quantities."""
        slips = tuple(f"{ALONG_CABLE(clip=k).label}.ds" for k in range(self.count))
        moves = [
            f"clip_{k}_{axis}" for k in range(self.count) for axis in self.cable.model.node.axes
        ]
        return Uncertainty(slips, np.eye(len(slips)), dict.fromkeys(moves, 1.0), PoseScatter())

    @cached_property
    def columns(self) -> list[int]:
        """Columns of the derivatives by `clip_moves`, in the order of z."""
        causes = self.clip_moves.causes_in(self.slipping.model)
        moves = [np.flatnonzero([x == f"clip_{k}" for x in causes]) for k in range(self.count)]
        return [int(column) for k, own in enumerate(moves) for column in (k, *own)]

    @cached_property
    def bounds(self) -> FloatArray:
        """Lower and upper bounds of z (2, count (1 + d))."""
        least, (low, high) = 1 / self.cable.model.n, self.region
        return np.tile([[least, *low], [1 - least, *high]], self.count)

    def held(self, z: FloatArray) -> list[HeldPose]:
        """The poses with the clips added."""
        rows = self.length * z.reshape((self.count, -1))
        clips = tuple(
            HeldClip(SupportKind.PINNED, tuple(row[1:].tolist()), float(row[0]), name=f"clip_{k}")
            for k, row in enumerate(rows, start=1)
        )
        return [replace(pose, clips=clips) for pose in self.poses]

    def spare(self, z: FloatArray, room: float = ROOM) -> tuple[FloatArray, FloatArray]:
        """Cable beyond the chords of spans (poses spans,), in cable lengths; derivatives by z."""
        d, count = self.region.shape[1], self.count
        rows, found = z.reshape((count, 1 + d)), []
        for pose in self.poses:
            ends = [[0.0, *np.array(pose.start) / self.length]]
            last = [] if pose.end is None else [[1.0, *np.array(pose.end) / self.length]]
            steps = np.diff(np.array([*ends, *rows, *last]), axis=0)
            for k, step in enumerate(steps):
                chord, slope = np.linalg.norm(step[1:]), np.zeros((count + 2, 1 + d))
                slope[k + 1] = [room, *-step[1:] / max(chord, 1e-12)]
                slope[k] = -slope[k + 1]
                found.append((room * step[0] - chord, slope[1:-1].ravel()))
        spare, slopes = (np.array(part) for part in zip(*found, strict=True))
        return spare, slopes

    def solved_at(self, z: FloatArray, scales: FloatArray) -> _Trial:
        """The lowest shapes at z; raises EquilibriumError if there are none."""
        known, poses, shapes = self.slipping, self.held(z), []
        found = solve_equilibria(known.model, known.p, known.rest, poses)
        for pose, eq in zip(poses, found, strict=True):
            if isinstance(eq, EquilibriumError):
                raise eq
            shape = SolvedCable(known.model, known.p, known.rest, pose, eq)
            shapes.append(Resolved(shape, known.metadata.coefficients, self.limits))
        names = (*self.bounded, "force")
        sizes = tuple({x: sizes_in(one.held, x) for x in names} for one in shapes)
        return _Trial(z, tuple(shapes), sizes, *self._split(sizes, scales))

    @cached_property
    def bounded(self) -> dict[str, float]:
        """Upper bounds of sizes by their names."""
        return bounds_of(self.limits)

    def _split(self, sizes: Sequence[Sizes], scales: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Minimized and bounded quantities, from sizes or from their derivatives, in each pose.

        `scales` (poses, limits): resolved sizes relative to those on the fit's mesh.
        """
        shares = [
            one[name] * scale / bound
            for one, row in zip(sizes, scales, strict=True)
            for scale, (name, bound) in zip(row, self.bounded.items(), strict=True)
        ]
        forces = np.concatenate([one["force"] for one in sizes]) / self.cable.model.force_scale
        bounded = np.concatenate([forces[:0], *shares])
        return (bounded, forces[:0]) if self.aim == "margin" else (forces, bounded)

    def slopes(self, now: _Trial, scales: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Derivatives (R, size of z), (S, size of z) of `aims` and `others`."""
        names, sizes = (*self.bounded, "force"), []
        for one in now.shapes:
            by_moves = Varied(one.held, self.clip_moves).linear(tuple(dict.fromkeys(names)))[1]
            sizes.append({k: self.length * x[:, self.columns] for k, x in by_moves.items()})
        return self._split(sizes, scales)

    def best(self) -> Placing:
        """The best result of all first guesses; raises an error if none keeps the limits."""
        scales, lost = np.ones((len(self.poses), len(self.bounded))), EquilibriumError("")
        trials: list[_Trial] = []
        guesses = self._guesses()
        parts = len(guesses) + STARTS
        for k, z in enumerate(guesses):
            self.step(WORK, k, parts)
            try:
                trials.append(self._descended(self.solved_at(z, scales), scales, TRIED))
            except EquilibriumError as error:
                lost = error
        clips = counted(self.count, "pinned clip")
        if not trials:
            happened = lost.message.partition("\n  Try:")[0]
            what = f"no shapes were found with {clips} in the region: {happened}"
            raise DloError(f"{what}\n  Try: fewer clips, another region, ends nearer to the start.")
        firsts = sorted(trials, key=lambda one: one.merit)[:STARTS]
        found = []
        for k, one in enumerate(firsts, start=len(guesses)):
            self.step(WORK, k, parts)
            found.append(self._improved(one, scales))
        self.step(WORK, parts, parts)
        best = min(found, key=self._order)
        if best.margin < 0:
            raise DloError(
                f"no places of {clips} were found that keep the limits in "
                f"{counted(len(self.poses), 'pose')}. The best found: {best}\n"
                "  Try: a larger region, more clips, other ends."
            )
        return best

    def _guesses(self) -> list[FloatArray]:
        """First guesses: points of the cable without clips, moved until each span has room."""
        bare = self.cable.with_clips(())
        curves = [SolvedCable.of(bare.model, bare.p, bare.rest, pose).curve for pose in self.poses]
        rng, guesses, most = np.random.default_rng(0), [], -np.inf
        for _ in range(GUESSES):
            at = np.arange(1, self.count + 1) + rng.uniform(-0.3, 0.3, self.count)
            at /= self.count + 1
            places = np.mean([curve.at(at * self.length) for curve in curves], axis=0)
            places = places / self.length + rng.normal(0.0, SCATTER, places.shape)
            first = np.column_stack([at, places]).ravel().clip(*self.bounds)
            for room in ROOMY:
                z = self._with_room(first, room)
                spare = float(self.spare(z, room)[0].min())
                if spare > -LAST:
                    guesses.append(z)
                    break
            most = max(most, spare)
        if not guesses:
            raise DloError(
                f"no room for {counted(self.count, 'clip')} in the region: a span is longer than "
                f"{ROOM:.0%} of its cable, by {-1e3 * most * self.length:.3g} mm in the best of "
                f"{GUESSES} tries.\n  Try: a region nearer to the ends, fewer clips."
            )
        return guesses

    def _with_room(self, first: FloatArray, room: float) -> FloatArray:
        """The z nearest to a first guess at which no span is longer than `room` times its cable.

        The set of such z is convex.
        """
        spans = {
            "type": "ineq",
            "fun": lambda z: self.spare(z, room)[0],
            "jac": lambda z: self.spare(z, room)[1],
        }
        found = minimize(  # type: ignore[call-overload]
            lambda z: (((z - first) ** 2).sum(), 2 * (z - first)),
            first,
            jac=True,
            bounds=self.bounds.T,
            constraints=spans,
            method="SLSQP",
        )
        return np.clip(found.x, *self.bounds)

    def _improved(self, now: _Trial, scales: FloatArray) -> Placing:
        """The placing reached from a first guess; rounds end when its bends are resolved."""
        found: list[Placing] = []
        for _ in range(ROUNDS):
            now, before = self._descended(now, scales, STEPS), scales
            uses = [one.uses for one in now.shapes]
            found.append(self._placing_of(now, [use for row in uses for use in row]))
            used = np.array([[use.used.max() for use in row] for row in uses])
            own = [[x[name].max() / y for name, y in self.bounded.items()] for x in now.sizes]
            scales = used / np.array(own)
            if np.allclose(before, scales, rtol=SETTLED):
                break
            aims, others = self._split(now.sizes, scales)
            now = replace(now, aims=aims, others=others)
        return min(found, key=self._order)

    def _order(self, one: Placing) -> tuple[float, float]:
        """Sorting key of placings, the best first."""
        over = 0.0 if self.aim == "force" else np.inf
        return -min(one.margin, over), one.force

    def _descended(self, now: _Trial, scales: FloatArray, steps: int) -> _Trial:
        """State after `steps` steps, or when the trust region has shrunk to nothing."""
        radius, slopes = FIRST, self.slopes(now, scales)
        for _ in range(steps):
            step, foreseen = self._step(now, slopes, radius)
            if radius < LAST or now.merit - foreseen < LAST:
                break
            try:
                new = self.solved_at(now.z + step, scales)
            except EquilibriumError:
                radius /= 4
                continue
            share = (now.merit - new.merit) / (now.merit - foreseen)
            if share > 0.75:
                radius = min(2 * radius, LARGEST)
            elif share < 0.25:
                radius /= 2
            if share > 0.1:
                now = new
                slopes = self.slopes(now, scales)
        return now

    def _step(
        self, now: _Trial, slopes: tuple[FloatArray, FloatArray], radius: float
    ) -> tuple[FloatArray, float]:
        """Best step of the first-order model within a radius, and the merit that it predicts.

        Variables: the step, the greatest aim, and the greatest violation.
        """
        size = len(now.z)
        spare, by_z = self.spare(now.z)
        parts = (
            (slopes[0], (-1.0, 0.0), -now.aims),
            (slopes[1], (0.0, -1.0), 1 - now.others),
            (-by_z, (0.0, 0.0), spare),
        )
        rows = np.vstack([np.column_stack([a, np.tile(x, (len(a), 1))]) for a, x, _ in parts])
        right = np.concatenate([b for *_, b in parts])
        low, high = (self.bounds - now.z).clip(-radius, radius)
        limits = [*zip(low, high, strict=True), (None, None), (0.0, None)]
        found = linprog([*np.zeros(size), 1.0, PENALTY], rows, right, bounds=limits)
        if found.x is None or found.fun is None:
            return np.zeros(size), now.merit
        return found.x[:size], float(found.fun)

    def _placing_of(self, now: _Trial, uses: Sequence[LimitUse]) -> Placing:
        """Convert a result to a placing in a configuration's terms."""
        worst = []
        for one, sizes in zip(now.shapes, now.sizes, strict=True):
            named = zip(sizes["force"], fixtures_of(one.held), strict=True)
            worst += [(float(x), f"{holder.name} in {one.held.pose.name}") for x, holder in named]
        held = now.shapes[0].held.pose.clips
        clips = (Clip(name=x.name, kind=SupportKind.PINNED, at=x.at, place=x.place) for x in held)
        return Placing(tuple(clips), tuple(uses), *max(worst))
