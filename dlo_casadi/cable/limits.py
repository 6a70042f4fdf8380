"""Check a shape against limits: value, probability, tightest place, main cause of uncertainty."""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Literal, TypeVar

import numpy as np

from dlo_casadi.arrays import FloatArray
from dlo_casadi.cable.estimate import EstimatedCable
from dlo_casadi.config import DeclaredTolerances, Limits
from dlo_casadi.config.frozen import ConfigSection
from dlo_casadi.config.problems import keys_of
from dlo_casadi.equilibrium.equilibrium import Equilibrium
from dlo_casadi.equilibrium.limits import (
    Exceedance,
    Varied,
    places_of,
    resolved,
    sizes_in,
)
from dlo_casadi.equilibrium.pose import HeldPose
from dlo_casadi.equilibrium.spread import (
    SolvedCable,
    Uncertainty,
    cause_of,
    tolerances_of,
    with_tolerances,
)
from dlo_casadi.errors import DloError, counted
from dlo_casadi.model.cable_model import CableModel
from dlo_casadi.model.functions import functions_of
from dlo_casadi.show.text import STRAIGHT, millimetres
from dlo_casadi.thresholds import SAFE

Kind = TypeVar("Kind", bound=ConfigSection)
Verdict = Literal["pass", "risk", "fail"]
# Smallest probability that is printed as a number.
SHOWN = 1e-3
UNITS = {"bend_radius": "m", "force": "N", "moment": "N m", "twist": "1/m", "clearance": "m"}
# Quantities with a lower limit.
LEAST = ("bend_radius", "clearance")


@dataclass(frozen=True, eq=False)
class LimitUse:
    """Use of a limit by the predicted shape of one pose.

    Parameters
    ----------
    pose, quantity : str
    limit, value : float
        In the quantity's unit: the limit, and the value where the shape is tightest.
    at : float [m]
        Arc length from the start where the shape is tightest.
    holder : str
        The fixture (force or moment) or nearest obstacle (clearance) there; otherwise empty.
    s, used : (K,)
        Arc lengths [m], and the used share of the limit at each: 1 at the limit; for a clearance 2
        where the cable touches.
    """

    pose: str
    quantity: str
    limit: float
    value: float
    at: float
    holder: str
    s: FloatArray
    used: FloatArray

    @property
    def margin(self) -> float:
        """Remaining share of the limit where the shape is tightest; negative beyond it."""
        return float(1 - self.used.max())

    @property
    def where(self) -> str:
        """The fixture, or the arc length and the obstacle there."""
        if self.quantity in ("force", "moment"):
            return self.holder
        return f"s = {self.at:.3f} m{self.holder and f', {self.holder}'}"

    def text(self, *values: float) -> str:
        """A value of the quantity with its unit, and its standard deviation if there is one."""
        values = values if any(values[1:]) else values[:1]
        if self.quantity == "bend_radius" and values[0] > STRAIGHT:
            return "straight"
        unit = UNITS[self.quantity]
        unit, size = ("mm", 1e3) if unit == "m" else (unit, 1.0)
        forms = zip(values, (".4g", ".2g"), strict=False)
        return f"{' ± '.join(format(size * x, form) for x, form in forms)} {unit}"

    @property
    def label(self) -> str:
        """Description of the limited quantity."""
        return self.quantity.replace("_", " ")

    @property
    def bound(self) -> str:
        """The limit as text, with its direction."""
        return f"{'≥' if self.quantity in LEAST else '≤'} {self.text(self.limit)}"

    def __str__(self) -> str:
        return f"{self.label} {self.text(self.value)} at {self.where} of {self.pose} ({self.bound})"

    __repr__ = __str__


@dataclass(frozen=True, eq=False, repr=False)
class LimitCheck(LimitUse, Exceedance):
    """One quantity of one pose with its limit, and the probability that a new repeat violates it.

    Parameters
    ----------
    std : float
        Standard deviation of `value`, in its unit, to first order.
    probability, error : float
        Probability that a new repeat of the pose violates the limit; standard error if counted.
    draws, lost : int
        As of `Exceedance`.
    shares : mapping of str to float
        Parts of the variance by cause, the largest first; empty if nothing is uncertain.
    decided_by : str
        The largest cause with its size, as text.
    """

    decided_by: str

    @property
    def verdict(self) -> Verdict:
        """Fail if the value itself violates the limit; pass below a probability of 1 %."""
        if self.used.max() > 1:
            return "fail"
        return "pass" if self.probability < SAFE else "risk"

    @property
    def method(self) -> str:
        """How the probability was found."""
        if not self.shares:
            return "exact"
        return counted(self.draws, "draw") if self.draws else "first order"

    @property
    def chance(self) -> str:
        """The probability as text."""
        if not self.shares:
            return f"{100 * self.probability:.0f} %"
        if not SHOWN < self.probability < 1 - SHOWN:
            return "< 0.1 %" if self.probability < 0.5 else "> 99.9 %"
        return f"{100 * self.probability:.{1 if self.probability < 0.1 else 0}f} %"

    def __str__(self) -> str:
        if not self.shares:
            return f"{self.verdict}: {super().__str__()}; {self.decided_by}"
        return (
            f"{self.verdict}: {self.label} {self.text(self.value, self.std)} at {self.where} "
            f"({self.bound}), violated with {self.chance} ({self.method}); "
            f"most of the variance: {self.decided_by}"
        )

    __repr__ = __str__

    def as_dict(self) -> dict[str, Any]:
        """As plain data, in SI units."""
        names = ("pose", "quantity", "limit", "value", "std", "probability", "at", "verdict")
        more = ("error", "holder", "method", "draws", "lost", "decided_by")
        return {name: getattr(self, name) for name in (*names, *more)} | {
            "shares": dict(self.shares)
        }


# Forms of a session's section that a caller may give: itself, its keys and values, or nothing.
Asked = ConfigSection | Mapping[str, Any] | None
# Largest tolerance of a place or of the length, in lengths of the cable.
_LOOSE = 0.1
_TRY = "limits={'bend_radius': 0.05, 'force': 8.0}; of a command --limits bend_radius=0.05 force=8"


def asked_limits(cable: EstimatedCable, limits: Asked = None) -> Limits:
    """Limits given by the caller, or else the session's.

    Raises DloError if there are none, or if one is meaningless for this cable.
    """
    model, asked = cable.model, _given(Limits, limits, _TRY) or cable.metadata.limits
    if not asked.given:
        raise DloError(f"no limit is given, and none was declared.\n  Try: {_TRY}")
    held = (model.start, model.end, *model.clips)
    sprung = bool(functions_of(model).moment_ends)
    avoided = any(not x.touch for x in model.obstacles)
    if wrong := [*asked.problems(held, sprung, model.node.twists, model.cable.length, avoided)]:
        raise DloError(wrong[0].message.replace(". Try:", ".\n  Try:"))
    return asked


def check_limits(
    cable: EstimatedCable,
    pose: HeldPose,
    found: Equilibrium,
    limits: Asked = None,
    tolerances: Asked = None,
) -> tuple[LimitCheck, ...]:
    """Check a fitted cable's shape, see `Shape.check`.

    Effects that carry a given tolerance are added to the model at zero: the shape stays.
    """
    known, asked = cable.metadata, asked_limits(cable, limits)
    beside = _given(DeclaredTolerances, tolerances, "tolerances={'end': 2e-3} [m]")
    names = tolerances if isinstance(tolerances, Mapping) else beside.declared if beside else ()
    stds = {name: getattr(beside, name) for name in names}
    possible = tolerances_of(with_tolerances(cable.model, keys_of(DeclaredTolerances)))
    if strange := [name for name in stds if name not in possible]:
        text = f"tolerances.{strange[0]}: the shape of this cable does not depend on it"
        raise DloError(f"{text}.\n  Try: {', '.join(possible)}")
    length = cable.model.cable.length
    if large := [
        x
        for x in ("end", "length", "clip", "slip", "obstacle")
        if stds.get(x, 0.0) > _LOOSE * length
    ]:
        text = f"tolerances.{large[0]}: {stds[large[0]]:g} m for a cable of {length:g} m"
        raise DloError(f"{text}.\n  Try: metres, such as {stds[large[0]] / 1e3:g}")
    model = with_tolerances(cable.model, stds)
    added = model.nominal[len(cable.p) :]
    shape = SolvedCable(model, np.concatenate([cable.p, added]), cable.rest, pose, found)
    uncertainty = known.uncertainty.installed(model, stds)
    return Resolved(shape, known.coefficients, asked).checks(uncertainty)


def _given(kind: type[Kind], given: Asked, example: str) -> Kind | None:
    if given is None or isinstance(given, kind):
        return given
    if not isinstance(given, Mapping):
        raise DloError(f"a mapping belongs here, found {given!r}\n  Try: {example}")
    return kind(**{str(key): value for key, value in given.items()})


def bounds_of(limits: Limits) -> dict[str, float]:
    """Upper bounds of the sizes from `sizes_of`, by name.

    For a bend radius it bounds the curvature; the size of a clearance is its negative.
    """
    sizes = {"bend_radius": lambda y: 1 / y, "clearance": lambda y: -y}
    return {_size(x): sizes.get(x, float)(y) for x, y in limits.given.items()}


def _size(quantity: str) -> str:
    return "curvature" if quantity == "bend_radius" else quantity


@dataclass(frozen=True)
class Resolved:
    """A shape on the meshes that limits need; the last of them resolves its sharpest bend.

    If a state has changed the rest curvature, that is known only on the fit's elements, and only
    these are used. `coefficients` (n_coefficients,) [1/m]: of the rest curvature. `limits`:
    meaningful for this cable, see `Limits.problems`.
    """

    held: SolvedCable
    coefficients: FloatArray
    limits: Limits

    @cached_property
    def meshes(self) -> list[SolvedCable]:
        """The shape on each mesh."""
        curved = self.limits.given.keys() & {"bend_radius", "twist"}
        if self.held.model.has_state or not curved:
            return [self.held]
        return resolved(self.held, self.coefficients)

    def on(self, quantity: str) -> SolvedCable:
        """The shape on the mesh on which a quantity is measured."""
        return self.meshes[-1 if quantity in ("bend_radius", "twist") else 0]

    @property
    def uses(self) -> tuple[LimitUse, ...]:
        """Use of each limit by the shape, in their order."""
        out, bounds = [], bounds_of(self.limits)
        for quantity, limit in self.limits.given.items():
            shape, name = self.on(quantity), _size(quantity)
            here, (places, holders) = sizes_in(shape, name), places_of(shape, name)
            tight = int(here.argmax())
            value, used = here[tight], here / bounds[name]
            if quantity == "bend_radius":
                value = 1 / max(value, 1e-300)
            elif quantity == "clearance":
                value, used = -value, 2 - used
            where, along = (float(places[tight]), holders[tight]), places.argsort(kind="stable")
            both = places[along], used[along]
            out.append(LimitUse(shape.pose.name, quantity, limit, float(value), *where, *both))
        return tuple(out)

    def checks(self, uncertainty: Uncertainty) -> tuple[LimitCheck, ...]:
        """Check the predicted shape, one limit after the other.

        Bend and twist are measured on a mesh that resolves the bend. Draws are solved there, too:
        how places compete for the sharpest bend depends on the mesh.
        """
        drawn = self.meshes[-1]
        # Ratio of a size on the mesh of the draws to its resolved value.
        ratio = {
            _size(x): sizes_in(drawn, _size(x)).max() / size if size else 1.0
            for x in self.limits.given
            if x != "clearance"  # a clearance hardly depends on the mesh
            for size in [sizes_in(self.on(x), _size(x)).max()]
        } | {"clearance": 1.0}
        bounds = {name: ratio[name] * bound for name, bound in bounds_of(self.limits).items()}
        likely, out = Varied(drawn, uncertainty).exceedances(bounds), []
        for use in self.uses:
            name = _size(use.quantity)
            chance, std = likely[name], float(likely[name].std / ratio[name])
            if use.quantity == "bend_radius":
                std = std * use.value * use.value  # infinite, or 0, of a straight cable
            cause = _main_cause(self.held.model, uncertainty, chance)
            known = vars(use) | vars(chance) | {"std": std}
            out.append(LimitCheck(**known, decided_by=cause))
        return tuple(out)


def _main_cause(model: CableModel, known: Uncertainty, chance: Exceedance) -> str:
    """The largest cause of uncertainty as text: "2 mm at the end (81 %)"."""
    if not chance.std > 0:
        return "nothing is uncertain"
    cause, share = next(iter(chance.shares.items()))
    own = [name for name in model.deviations if cause_of(model, name) == cause]
    size = max((known.scatter.get(name, 0.0) for name in own), default=known.added.get(cause, 0.0))
    tolerance = next((x for x, y in tolerances_of(model).items() if {cause, *own} & {*y}), "")
    said = {
        "end": f"{millimetres(size)} at the end",
        "length": f"{millimetres(size)} of length",
        "clip": f"{millimetres(size)} at a clip",
        "slip": f"{millimetres(size)} along a clip",
        "obstacle": f"{millimetres(size)} of an obstacle's surface",
        "roll": f"{size:.2g} rad of roll",
        "heading": f"{size:.2g} rad of the {cause.partition('_')[0]}'s heading",
        "rotation": f"{size:.2g} rad of the {cause.partition('_')[0]}'s orientation",
    }.get(tolerance, "the cable's own scatter" if cause == "repeat" else "the fitted parameters")
    return f"{said} ({100 * share:.0f} %)"
