"""What changed, and since when: likelihood ratios of jumps in the innovations of a filter.

A parameter that jumps by b at a pose moves the innovations of that pose and of all later ones by
G b, less what the filter has already taken for its own unknowns: with the columns D of the
parameter, H of the unknowns, and the gain K, all whitened,

    G_t = D_t - H_t F_t,   F_(t+1) = F_t + K_t G_t,   F = 0 at the first pose of the change

    u = sum G_t^T r_t,   I = sum G_t^T G_t,   T = u^T I^-1 u,   b = I^-1 u

T is twice the log likelihood ratio; without a change it is chi-square. Candidates are those of the
diagnosis that come from one pose to the next, and what the model already has.

References
----------
Willsky and Jones, IEEE Trans. Autom. Control 21 (1976); Lai, J. R. Stat. Soc. B 57 (1995): bounded
windows; Schwarz, Ann. Stat. 6 (1978).
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import reduce
from typing import Any

import numpy as np
from scipy.linalg import solve_triangular
from scipy.special import chdtrc

from dlo_casadi.arrays import BoolArray, FloatArray
from dlo_casadi.diagnosis.candidates import Candidate, candidates, setup_of
from dlo_casadi.effects import EFFECTS, Effect, Load, PointLoad
from dlo_casadi.equilibrium.batch import BatchEquilibrium
from dlo_casadi.linear_mixed import Score
from dlo_casadi.model.assembly import Shapes
from dlo_casadi.model.cable_model import STIFFNESSES, CableModel
from dlo_casadi.thresholds import COLLINEAR, SCANS_APART
from dlo_casadi.tracking.known import coefficient
from dlo_casadi.tracking.seen import Seen
from dlo_casadi.tracking.shaper import declared

# Places of a new weight, of those that the diagnosis tries, that are looked at every few poses.
_WEIGHTS = (2, 8, 14, 20)


@dataclass(frozen=True)
class Suspect:
    """One thing that may have changed.

    Parameters
    ----------
    cause : str
        An effect's label, or a parameter.
    names : tuple of str
        Parameters, and `rest_curvature[k]`, whose jump is a column.
    candidate : Candidate or None
        The effect, if the model has none.
    scan : mapping
        Values of its other parameters.
    load : bool
        Whether it is a load at one place.
    place : bool
        Whether it is the place of something that the model has.
    """

    cause: str
    names: tuple[str, ...]
    candidate: Candidate | None = None
    scan: Mapping[str, float] = field(default_factory=dict)
    load: bool = False
    place: bool = False

    @property
    def size(self) -> int:
        """Number of unknowns of the change."""
        return len(self.names) + len(self.scan)


@dataclass(frozen=True)
class Jump:
    """A suspect, and the change that explains the most.

    Parameters
    ----------
    since : int
        Number of the first pose of the change.
    score : float
        T.
    price : float
        What as many unknowns gain by chance in as many poses (Schwarz).
    log_p : float
        Logarithm of the probability of T by chance, at this pose, of this suspect.
    step, std : dict of str to float
        Size of the jump, and its standard deviation.
    """

    suspect: Suspect
    since: int
    score: float
    price: float
    log_p: float
    step: dict[str, float]
    std: dict[str, float]

    @property
    def worth(self) -> float:
        """What it explains, less its price: twice a difference of log evidence."""
        return self.score - self.price


def own_suspects(model: CableModel, unknown: Sequence[str]) -> Iterator[Suspect]:
    """Suspects that a model has: its stiffnesses, rest curvature, and effects."""
    for name in STIFFNESSES:
        if name in model.names:
            yield Suspect(name, (name,))
    bent = tuple(name for name in unknown if name.startswith("rest_curvature["))
    if bent:
        yield Suspect("rest_curvature", bent)
    for effect in model.effects:
        if effect.name not in EFFECTS or effect.lasts:
            continue
        moved = {key for scan in effect.scans(setup_of(model)) for key in scan}
        own = [q.name for q in effect.parameters(model.cable)]
        load, prefix = isinstance(effect, PointLoad), f"{effect.label}."
        if size := tuple(prefix + name for name in own if name not in moved):
            yield Suspect(effect.label, size, load=load)
        for name in (prefix + name for name in own if name in moved):
            yield Suspect(name, (name,), load=load, place=True)


def new_candidates(model: CableModel) -> list[Candidate]:
    """Effects that a model lacks and that may come; a second one of those that it has."""
    listed = candidates(model, setup_of(model))
    found = [one for one in listed if not one.nuisance and _comes(one.effect)]
    for effect in model.effects:
        if not (effect.repeatable and _comes(effect)):
            continue
        known = {one.label for one in model.effects}
        several = type(effect).several(setup_of(model), len(known) + 1)
        new = next((one for one in several if one.label not in known), None)
        if new is not None and new.label not in {one.effect.label for one in found}:
            found.append(_candidate(model, new))
    return found


def _comes(effect: Effect) -> bool:
    """Whether it may come from one pose to the next; a spring would bring unknowns of the shape."""
    springs = isinstance(effect, Load) and effect.n_springs
    return effect.gradual and not (effect.lasts or springs)


def _candidate(model: CableModel, effect: Effect) -> Candidate:
    """A candidate of an effect that is not listed."""
    prefix, setup = f"{effect.label}.", setup_of(model)
    scans = tuple({prefix + k: x for k, x in one.items()} for one in effect.scans(setup))
    frees = tuple(prefix + q.name for q in effect.parameters(model.cable))
    tested = (prefix + q.name for q in effect.linear().parameters(model.cable))
    screened = tuple(name for name in tested if name not in scans[0])
    return Candidate(effect, frees, screened, scans, nuisance=False)


@dataclass(frozen=True)
class Probe:
    """A cable's model with suspects, each at one place.

    Parameters
    ----------
    model : CableModel
        With the effects that the cable lacks.
    values : mapping
        Of their parameters.
    suspects : list of Suspect
    unknown : tuple of str
        Unknowns of the filter.
    """

    model: CableModel
    values: Mapping[str, float]
    suspects: list[Suspect]
    unknown: tuple[str, ...]

    @classmethod
    def quick(cls, model: CableModel, unknown: tuple[str, ...]) -> Probe:
        """All suspects that have one place, and weights at some."""
        listed = [one for one in new_candidates(model) if len(one.scans) == 1]
        listed += cls._weights(model)
        return cls._of(model, unknown, [(one, one.scans[0]) for one in listed], own=True)

    @staticmethod
    def _weights(model: CableModel) -> list[Candidate]:
        kinds = [x for x in EFFECTS.values() if issubclass(x, Load) and x.carried]
        setup, out = setup_of(model), []
        for kind in (kind for kind in kinds if kind.applies(setup)):
            taken = {one.label for one in model.effects}
            listed = kind.several(setup, len(_WEIGHTS) + len(taken))
            free = [_candidate(model, x) for x in listed if x.label not in taken]
            out += [
                replace(one, scans=(one.scans[k],)) for one, k in zip(free, _WEIGHTS, strict=False)
            ]
        return out

    @classmethod
    def every(cls, model: CableModel, unknown: tuple[str, ...]) -> list[Probe]:
        """All suspects, each at every other place of the diagnosis."""
        listed = new_candidates(model)
        out = []
        for k in range(0, max((len(one.scans) for one in listed), default=1), SCANS_APART):
            chosen = [(one, one.scans[k]) for one in listed if k < len(one.scans)]
            out.append(cls._of(model, unknown, chosen, own=k == 0))
        return out

    @classmethod
    def _of(
        cls,
        model: CableModel,
        unknown: tuple[str, ...],
        chosen: Sequence[tuple[Candidate, Mapping[str, float]]],
        *,
        own: bool,
    ) -> Probe:
        effects = [candidate.effect.linear() for candidate, _ in chosen]
        larger = reduce(CableModel.with_effect, effects, model)
        values = {name: x for _, scan in chosen for name, x in scan.items()}
        suspects = [*own_suspects(model, unknown)] if own else []
        suspects += [
            Suspect(c.effect.label, c.screened, c, scan, isinstance(c.effect, PointLoad))
            for c, scan in chosen
        ]
        return cls(larger, values, suspects, unknown)

    def columns(self, poses: Sequence[Seen]) -> list[FloatArray]:
        """Derivatives (R, n + q) of each pose by the unknowns, then by the suspects' parameters."""
        names = [*self.unknown, *(name for one in self.suspects for name in one.names)]
        by_p, by_rest = _directions(self.model, names)
        batch = BatchEquilibrium(self.model, [one.held for one in poses])
        known = [dict(zip(one.prior.model.names, one.prior.p, strict=True)) for one in poses]
        p = np.array(
            [
                [own.get(q.name, self.values.get(q.name, q.nominal)) for q in self.model.parameters]
                for own in known
            ]
        )
        rest = np.array([one.prior.rest for one in poses])
        parts = zip(*((x.x, x.lam, x.near) for x in (one.shapes for one in poses)), strict=True)
        x, lam, near = (np.concatenate(part) for part in parts)
        still = np.zeros((len(poses), len(self.model.deviation_names)))
        shapes = declared(batch, Shapes(x, lam, still, near))
        along = batch.by_rest(shapes, p, rest, by_rest, by_p)
        seen = batch.observe(shapes, p, rest, along)
        return [one.measured.along(*pair) for one, pair in zip(poses, seen, strict=True)]


def _directions(model: CableModel, names: Sequence[str]) -> tuple[FloatArray, FloatArray]:
    """Derivatives of parameters and rests by names, as `Uncertainty.unknowns_in`."""
    by_p, by_rest = (
        np.zeros((len(model.names), len(names))),
        np.zeros((model.chain.n_rests, len(names))),
    )
    for k, name in enumerate(names):
        if name in model.names:
            by_p[model.names.index(name), k] = 1.0
        else:
            by_rest[:, k] = model.rest_basis[:, coefficient(name)]
    return by_p, by_rest


@dataclass(eq=False)
class Jumps:
    """Likelihood ratios of jumps at each of the last poses.

    Parameters
    ----------
    probe : Probe
    most : int
        Number of the poses at which a change may have begun.
    """

    probe: Probe
    most: int
    since: list[int] = field(default_factory=list)
    _sums: dict[str, Any] = field(default_factory=dict)

    def add(self, seen: Seen, columns: FloatArray) -> None:
        """A pose that is the next one, with its columns; one that was refused taught nothing."""
        n = len(self.probe.unknown)
        white = solve_triangular(seen.factor, columns, lower=True)
        h, d = white[:, :n], white[:, n:]
        q = d.shape[1]
        new = {
            "taken": np.zeros((1, n, q)),
            "information": np.zeros((1, q, q)),
            "slope": np.zeros((1, q)),
            "square": np.zeros((1, q)),
            "poses": np.zeros(1),
        }
        if self._sums:
            new = {k: np.concatenate([self._sums[k], x])[-self.most :] for k, x in new.items()}
        self.since = [*self.since, seen.number][-self.most :]
        g = d - h @ new["taken"]
        new["information"] += g.swapaxes(1, 2) @ g
        new["slope"] += g.swapaxes(1, 2) @ seen.innovation
        new["square"] += (d**2).sum(axis=0)
        new["poses"] += 1
        if not seen.refused:
            gain = seen.prior.uncertainty.covariance @ h.T
            new["taken"] += gain @ g
        self._sums = new

    def found(self) -> list[Jump]:
        """Each suspect at the pose that explains the most, best first."""
        if not self.since:
            return []
        out, first = [], 0
        bounds = {q.name: q for q in self.probe.model.parameters}
        for one in self.probe.suspects:
            own = slice(first, first + len(one.names))
            first = own.stop
            vanish = np.array(
                [
                    one.candidate is not None and bounds[name].lower == bounds[name].nominal
                    for name in one.names
                ]
            )
            k = self._likeliest(own)
            score, step, std = self._tried(k, own, vanish)
            price = one.size * float(np.log(self._sums["poses"][k]))
            with np.errstate(divide="ignore"):
                log_p = float(np.log(chdtrc(len(one.names), score)))
            steps, stds = (dict(zip(one.names, x.tolist(), strict=True)) for x in (step, std))
            out.append(Jump(one, self.since[k], score, price, log_p, steps, stds))
        return sorted(out, key=lambda jump: -jump.worth)

    def _likeliest(self, own: slice) -> int:
        """Index of the pose since which a jump explains the most."""
        size = np.sqrt(np.maximum(self._sums["square"][:, own], 1e-300))
        information = self._sums["information"][:, own, own] / (size[:, :, None] * size[:, None])
        slope = self._sums["slope"][:, own] / size
        known = information + COLLINEAR * np.eye(slope.shape[1])
        step = np.linalg.solve(known, slope[..., None])[..., 0]
        return int((slope * step).sum(axis=1).argmax())

    def _tried(self, k: int, own: slice, vanish: BoolArray) -> tuple[float, FloatArray, FloatArray]:
        """Score, step and its standard deviations of a suspect since the k-th pose."""
        slope, information = self._sums["slope"][k, own], self._sums["information"][k, own, own]
        size = np.sqrt(np.maximum(self._sums["square"][k, own], 1e-300))
        scaled = Score(slope, information, size).scaled
        score, step, dof = scaled.gain(COLLINEAR)
        if (vanish & (step < 0)).any() or not dof:
            return 0.0, np.zeros_like(step), np.full_like(step, np.inf)
        values, vectors = np.linalg.eigh(scaled.information)
        values = np.maximum(values, COLLINEAR)
        std = np.sqrt(np.maximum((vectors**2 / values).sum(axis=1), 0.0))
        return score, step / size, std / size
