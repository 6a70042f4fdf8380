"""An alarm is looked into: which change explains the poses, and the cable after it."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import numpy as np
from scipy.stats import chi2

from dlo_casadi.errors import EquilibriumError
from dlo_casadi.thresholds import EVIDENCE_APART, NEAR_END
from dlo_casadi.tracking.changes import Jump, Jumps, Probe
from dlo_casadi.tracking.known import Known
from dlo_casadi.tracking.measured import Noise
from dlo_casadi.tracking.seen import OUTLIER, Seen, learned
from dlo_casadi.tracking.shaper import Shaper

# Poses after an alarm at which its cause is judged again while others explain it as well.
JUDGED = (1, 2, 4, 8, 16, 32)
# Difference of twice the log evidence beyond which a cause is no rival.
_APART = 2 * EVIDENCE_APART
# Suspects that are fitted to the poses, and the share of the score by which derivatives at places
# some way apart may err.
_REFITTED, _ERROR = 6, 0.4
# Width of the priors of a jump, in its standard deviations to first order.
_WIDE = 10.0
# Their least width, as a share of the jump: derivatives err by less.
_BENT = 0.3
# Factor on the covariance of a cable that has changed in a way that nothing explains.
_FORGOTTEN = 100.0


@dataclass(frozen=True)
class Change:
    """What changed.

    Parameters
    ----------
    since : int
        Number of the first pose of the change, the likeliest one; the tracker's first pose is 1.
    cause : str or None
        An effect's label, such as "lumped_mass", or a parameter; None if nothing that is known
        explains the poses.
    values, std : dict of str to float
        Size of the change by parameter, in its unit: the value of an effect that is new, the
        difference of a value that was there before.
    rivals : tuple of str
        Other causes that explain the poses as well.
    decided : bool
        Whether no more poses are waited for.
    """

    since: int
    cause: str | None
    values: dict[str, float]
    std: dict[str, float]
    rivals: tuple[str, ...] = ()
    decided: bool = True

    def __str__(self) -> str:
        said = self.cause or "something unknown"
        if self.values:
            sizes = (f"{k} {x:+.3g} (std {self.std[k]:.2g})" for k, x in self.values.items())
            said += f": {', '.join(sizes)}"
        if self.rivals:
            said += f"; or {', '.join(self.rivals)}"
        return f"changed since pose {self.since}: {said}" + ("" if self.decided else "; not sure")


@dataclass(frozen=True, eq=False)
class Replayed:
    """The poses of a change, learned again with it.

    Parameters
    ----------
    cable : Known
        After the last pose.
    seen : list of Seen
    before : float
        Logarithm of the likelihood of the poses before the change.
    """

    jump: Jump
    cable: Known
    seen: list[Seen]
    before: float

    @property
    def evidence(self) -> float:
        """Logarithm of the likelihood of all poses of the inquiry."""
        return self.before + sum(one.log_likelihood for one in self.seen)

    @property
    def probability(self) -> float:
        """Of innovations as large by chance."""
        total = sum(float(one.innovation @ one.innovation) for one in self.seen)
        return float(chi2.sf(total, sum(len(one.innovation) for one in self.seen)))

    @property
    def gone(self) -> bool:
        """Whether what has moved along the cable is where it does nothing: it rather fell off."""
        if not self.jump.suspect.place:
            return False
        (name,), model = self.jump.suspect.names, self.cable.model
        share = self.cable.p[model.names.index(name)] / model.cable.length
        return bool(not NEAR_END <= share <= 1 - NEAR_END)


@dataclass(eq=False)
class Inquiry:
    """Poses around an alarm, seen by a filter that knows nothing of the change.

    Parameters
    ----------
    poses : list of Seen
    cable : Known
        That filter's, after the last pose.
    faded : callable
        The cable before the next pose: what is known has faded, and has walked.
    """

    poses: list[Seen]
    cable: Known
    noise: Noise
    faded: Callable[[Known], Known]
    shaper: Shaper
    since: int
    opened: int
    _jumps: list[Jumps] = field(default_factory=list)
    _lines: dict[tuple[str, int], Replayed | None] = field(default_factory=dict)

    def __post_init__(self) -> None:
        last = self.poses[-1]
        unknown = last.prior.uncertainty.names
        for probe in Probe.every(last.model, unknown):
            jumps = Jumps(probe, len(self.poses) + JUDGED[-1])
            for seen, columns in zip(self.poses, probe.columns(self.poses), strict=True):
                jumps.add(seen, columns)
            self._jumps.append(jumps)

    def add(self, seen: Seen) -> None:
        """One more pose, as the tracker has seen it."""
        last = self.poses[-1]
        shaper = Shaper.after(last.model, last.held, last.shapes)
        after, own = learned(
            self.faded(self.cable), seen.pose, seen.held, self.noise, seen.number, shaper
        )
        assert own is not None
        self.cable = after
        self.poses.append(own)
        for jumps in self._jumps:
            jumps.add(own, jumps.probe.columns([own])[0])

    def verdict(self, *, final: bool) -> tuple[Change, Known]:
        """What changed, and the cable after it."""
        ranked = self._ranked()
        top = ranked[0]
        least = top.worth - max(_APART, _ERROR * top.score)
        near = [jump for jump in ranked if jump.worth > least][:_REFITTED]
        lines = [line for jump in near if (line := self._line(jump)) and not line.gone]
        price = 2 * float(np.log(_WIDE))
        valued = [(2 * x.evidence, price * x.jump.suspect.size, x.jump) for x in lines]
        valued.sort(key=lambda one: -one[0])
        # A rival with more unknowns is out only if it explains less, whatever its price.
        tied = [
            jump
            for value, price, jump in valued
            if value + max(price - valued[0][1], 0.0) > valued[0][0] - _APART
        ]
        if not tied or tied[0].worth <= 0:
            return self._unknown(final)
        first = tied[0]
        if first.suspect.load:
            # A force at a place can do all that a weight does: the simplest load.
            loads = [one for one in tied if one.suspect.load]
            first = min(loads, key=lambda one: one.suspect.size)
            more = [one for one in loads if one.suspect.size > first.suspect.size]
            tied = [one for one in tied if one not in more]
        line = self._line(first)
        if line is None or line.probability < OUTLIER:
            return self._unknown(final)
        rivals = tuple(one.suspect.cause for one in tied if one is not first)
        cause, decided = first.suspect.cause, final or not rivals
        change = Change(first.since, cause, *self._sizes(line), rivals, decided)
        return change, line.cable

    def _ranked(self) -> list[Jump]:
        """The best jump of each cause, best first."""
        best: dict[str, Jump] = {}
        for jump in (jump for jumps in self._jumps for jump in jumps.found()):
            known = best.get(jump.suspect.cause)
            if known is None or jump.worth > known.worth:
                best[jump.suspect.cause] = jump
        return sorted(best.values(), key=lambda jump: -jump.worth)

    def _line(self, jump: Jump) -> Replayed | None:
        """The poses since a change, learned with it; earlier ones are not learned again."""
        key = jump.suspect.cause, jump.since
        if key not in self._lines:
            self._lines[key] = self._replayed(jump)
            return self._lines[key]
        line = self._lines[key]
        if line is not None:
            done = line.seen[-1].number
            line = self._going_on(line, [x for x in self.poses if x.number > done])
            self._lines[key] = line
        return line

    def _unknown(self, final: bool) -> tuple[Change, Known]:
        """Nothing explains it: the cable with much of what was known forgotten."""
        covariance = self.cable.uncertainty.covariance
        wide = self.cable.with_covariance(_FORGOTTEN * covariance)
        return Change(self.since, None, {}, {}, (), final), wide

    def _sizes(self, found: Replayed) -> tuple[dict[str, float], dict[str, float]]:
        """Size of the change and its standard deviation."""
        after, start = found.cable, self._before(found.jump)
        stds, olds = after.stds, start.stds
        values, std = {}, {}
        for name in _names(found.jump):
            old = start.value(name, start) if name in start.model.names else 0.0
            values[name] = after.value(name, start) - old
            std[name] = float(np.hypot(stds[name], olds.get(name, 0.0)))
        return values, std

    def _before(self, jump: Jump) -> Known:
        """What was known before the change."""
        return next(seen for seen in self.poses if seen.number == jump.since).prior

    def _replayed(self, jump: Jump) -> Replayed | None:
        """The poses since a change, learned with it; twice, the second time about what it found."""
        start, poses = self._before(jump), [x for x in self.poses if x.number >= jump.since]
        before = sum(x.log_likelihood for x in self.poses if x.number < jump.since)
        step, model, candidate = dict(jump.step), start.model, jump.suspect.candidate
        width = {k: max(_WIDE * x, _BENT * abs(step[k])) for k, x in jump.std.items()}
        first = _jumped(start, step)
        if candidate is not None:
            model = candidate.add_to(model)
            first = candidate.of_linear(model.cable, {**jump.suspect.scan, **step})
            sizes = {q.name: q.scale for q in model.parameters}
            width = {name: max(width.get(name, 0.0), sizes[name]) for name in candidate.frees}
        found: Replayed | None = None
        for _ in range(2):
            cable = start.with_unknowns(model, first, width)
            now = self._going_on(Replayed(jump, cable, [], before), poses)
            if now is None:
                break
            found = now
            first = {name: found.cable.value(name, start) for name in width}
            stds = found.cable.stds
            width = {name: _WIDE * stds[name] for name in width}
        return found

    def _going_on(self, line: Replayed, poses: list[Seen]) -> Replayed | None:
        """The same with further poses; None if there is no shape in one of them."""
        cable, seen = line.cable, [*line.seen]
        try:
            for one in poses:
                prior = self.faded(cable) if seen else cable
                shaper = Shaper()
                if seen:
                    shaper.keep(seen[-1].model, seen[-1].held, seen[-1].shapes)
                cable, told = learned(prior, one.pose, one.held, self.noise, one.number, shaper)
                assert told is not None
                seen.append(told)
        except EquilibriumError:
            return None
        return Replayed(line.jump, cable, seen, line.before)


def _names(jump: Jump) -> tuple[str, ...]:
    candidate = jump.suspect.candidate
    return jump.suspect.names if candidate is None else candidate.frees


def _jumped(cable: Known, step: Mapping[str, float]) -> dict[str, float]:
    """Values after a jump; of rest coefficients the jump itself."""
    known = dict(zip(cable.model.names, cable.p, strict=True))
    return {name: known.get(name, 0.0) + x for name, x in step.items()}
