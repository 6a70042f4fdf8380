"""A fitted cable without its shapes: values, their uncertainty, and its curve in a pose."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from os import PathLike
from pathlib import Path
from typing import Any, Self, TypeVar

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from dlo_casadi.arrays import FloatArray, unit
from dlo_casadi.cable.saved import write_parameters
from dlo_casadi.codegen import CompiledSolver
from dlo_casadi.config import Limits
from dlo_casadi.config.values import MESH
from dlo_casadi.equilibrium.curve import NodeCurve
from dlo_casadi.equilibrium.spread import Uncertainty
from dlo_casadi.equilibrium.symbolic import CasadiCable
from dlo_casadi.errors import DloError, counted
from dlo_casadi.rod.chain import ELEMENTS, ELEMENTS_IN_SPACE
from dlo_casadi.rod.node import Frame
from dlo_casadi.show.text import html_table, plus_minus

Value = TypeVar("Value")


def from_to(interval: tuple[float | None, float | None]) -> str:
    """An interval in words."""
    return " to ".join("unbounded" if x is None else f"{x:.4g}" for x in interval)


class Named(dict[str, Value]):
    """Values by name; for an unknown name a DloError lists the known ones."""

    def __missing__(self, name: str) -> Value:
        raise DloError(f"nothing is called {name!r}; there are {', '.join(self)}")


@dataclass(frozen=True)
class Estimate:
    """One parameter.

    Parameters
    ----------
    value, std : float
        In `unit`; std is 0 if the parameter was not estimated. Infinite if the value is the inverse
        of a parameter at zero.
    unit : str
    interval_95 : (float or None, float or None), optional
        Profile-likelihood interval; None for an unbounded side; absent if not computed.
    interval_95_if_hidden : (float or None, float or None), optional
        The same if one effect is hidden that the data do not exclude; `hidden` is its name.
    identifiable : bool, optional
        False if the interval is unbounded or spans more than a factor of ten. Without an interval:
        False if the measurements constrain it less than its bounds, whose width std then is.
    at_bound : bool
        Whether the value sits on a physical bound.
    fixed : bool
        Whether the parameter was kept at its value.
    """

    value: float
    std: float
    unit: str
    interval_95: tuple[float | None, float | None] | None = None
    identifiable: bool | None = None
    interval_95_if_hidden: tuple[float | None, float | None] | None = None
    hidden: str = ""
    at_bound: bool = False
    fixed: bool = False

    @property
    def stderr(self) -> float | None:
        """`std` by the name that lmfit uses; None if the parameter was not estimated."""
        return None if self.fixed else self.std

    def __str__(self) -> str:
        text = "unbounded" if math.isinf(self.value) else plus_minus(self.value, self.std)
        text = f"{text} {self.unit}".strip()
        if self.interval_95 is not None:
            text += f" (95 %: {from_to(self.interval_95)}"
            if self.interval_95_if_hidden is not None:
                text += f"; {from_to(self.interval_95_if_hidden)} if {self.hidden} is hidden"
            text += ")"
        remarks = {
            "fixed": self.fixed,
            "at a bound": self.at_bound,
            "not identifiable": self.identifiable is False,
        }
        return ", ".join([text, *(remark for remark, holds in remarks.items() if holds)])

    def __repr__(self) -> str:
        return f"<Estimate {self}>"


class Estimates(Named[Estimate]):
    """Parameters by name: a line each as text, a table in a notebook."""

    def __repr__(self) -> str:
        width = max(map(len, self), default=0)
        return "\n".join(f"{name:{width}}  {found}" for name, found in self.items())

    def _repr_html_(self) -> str:
        rows = [(name, *_cells(found)) for name, found in self.items()]
        return html_table("parameters", [("name", "value", "95 %", "remark"), *rows])


def _cells(one: Estimate) -> tuple[str, str, str]:
    """Value, interval and remark of an estimate, as its text has them."""
    known, _, remark = str(one).partition(", ")
    value, _, interval = known.partition(" (95 %: ")
    return value, interval.rstrip(")"), remark


@dataclass(frozen=True, eq=False)
class Covariance:
    """Covariance of estimates, by name: `covariance["bending_stiffness", "end_roll"]`.

    Parameters
    ----------
    names : (N,) tuple of str
        Fitted parameters, and `rest_curvature[k]` [1/m], its spline coefficients.
    values : (N, N)
        In products of the parameters' units.
    """

    names: tuple[str, ...]
    values: FloatArray

    def __getitem__(self, pair: tuple[str, str]) -> float:
        if not isinstance(pair, tuple) or len(pair) != 2:
            raise DloError(
                f"a covariance is of two names, found {pair!r}\n"
                "  Try: covariance[name, name] is the variance, `std` has its root."
            )
        if unknown := [name for name in pair if name not in self.names]:
            fitted = ", ".join(self.names) or "none"
            raise DloError(f"{unknown[0]!r} was not fitted; fitted are {fitted}")
        i, j = map(self.names.index, pair)
        return float(self.values[i, j])

    def __repr__(self) -> str:
        known = (f"  {name}: std {std:.3g}" for name, std in self.std.items())
        return "\n".join([f"<Covariance of {counted(len(self.names), 'estimate')}>", *known])

    @property
    def std(self) -> dict[str, float]:
        """Standard deviations by name."""
        roots = np.sqrt(np.maximum(np.diag(self.values), 0.0))
        return dict(zip(self.names, roots.tolist(), strict=True))

    @property
    def correlation(self) -> FloatArray:
        """Correlations (N, N); zero for exactly known values."""
        std = np.array(list(self.std.values()))
        scale = np.outer(std, std)
        return np.divide(self.values, scale, out=np.zeros_like(scale), where=scale > 0)


@dataclass(frozen=True)
class Metadata:
    """Contents of a parameters.yaml besides the model.

    Parameters
    ----------
    path : Path or None
        The file, or the session's.
    params : dict of Estimate
        All parameters of the model by name.
    covariance : Covariance
    uncertainty : Uncertainty
        The covariance together with the scatter from pose to pose.
    coefficients : (n_coefficients,) [1/m]
        Of the rest curvature before the first pose; in space first about axis y, then about z.
    fixtures : dict
        Those of `start` [m], `start_heading` and `end_heading` [rad], in space `start_orientation`
        and `end_orientation`, that are the same in all poses of the session.
    limits : Limits
        Limits declared in the session.
    explains : bool or None
        Whether the model explains the shapes it was fitted to; None where that was not judged.
    model_hash : str
        Hash in the file; see `saved.parameters_hash`.
    edited : bool
        Whether the model has changed since the file was written.
    config : str
        Name of the configuration.
    document : dict
        The whole file.
    """

    path: Path | None
    params: dict[str, Estimate]
    covariance: Covariance
    uncertainty: Uncertainty
    coefficients: FloatArray
    fixtures: dict[str, Any]
    limits: Limits
    explains: bool | None
    model_hash: str
    edited: bool
    config: str
    document: dict[str, Any]


@dataclass(frozen=True, eq=False)
class EstimatedCable(CasadiCable):
    """The model of a cable with its fitted values and their uncertainty.

    Parameters
    ----------
    metadata : Metadata
    """

    metadata: Metadata

    def __repr__(self) -> str:
        mesh = counted(self.model.n, f"{self.model.element} element")
        fitted = bool(self.covariance.names)
        hidden = tuple(f"{effect.label}." for effect in self.model.effects if not effect.shown)
        rows = (
            f"  {name}: {x}"
            for name, x in self.params.items()
            if not ((x.fixed and fitted) or name.startswith(hidden))
        )
        return "\n".join([f"<FittedCable {self.name!r}: {self.length:g} m, {mesh}>", *rows])

    @property
    def name(self) -> str:
        """Name of the cable."""
        return self.model.cable.name

    @property
    def params(self) -> Estimates:
        """All parameters of the model by name, with their estimates."""
        return Estimates(self.metadata.params)

    @property
    def covariance(self) -> Covariance:
        """Covariance of all fitted parameters by their names."""
        return self.metadata.covariance

    @property
    def length(self) -> float:
        """Length [m] as declared."""
        return self.model.cable.length

    def with_mesh(self, n: int | None = None, element: str | None = None) -> Self:
        """The same cable on another mesh.

        Raises
        ------
        DloError
            If there is no such mesh, or if the rest shape has changed from pose to pose: it is
            known on the fit's mesh only.
        """
        if n is None and element is None:
            return self
        if n is not None and (not isinstance(n, int | np.integer) or int(n) not in MESH):
            raise DloError(f"n: a whole number, {MESH}, found {n!r}")
        known = ELEMENTS_IN_SPACE if self.model.in_space else ELEMENTS
        if not (element is None or (isinstance(element, str) and element in known)):
            raise DloError(f"element: one of {', '.join(known)} belongs here, found {element!r}")
        if self.model.has_state:
            raise DloError(
                f"{self.name!r} has a rest shape that changed from pose to pose, which is known on "
                "the fit's elements alone: leave out the number and the kind of elements"
            )
        model = self.model.with_mesh(self.model.n if n is None else int(n), element)
        return replace(self, model=model, rest=model.rest_basis @ self.metadata.coefficients)

    def fed_by(self, what: str) -> Self:
        """The same cable whose poses tell tensions beyond ends that slide, or the length between.

        It matters to `compile` and to functions for CasADi, which take one of both as a number of
        the pose; `solve` takes either. A cable that was fitted to poses without tensions is fed by
        its free length, any other by tensions.

        Parameters
        ----------
        what : "tension" or "free_length"

        Raises
        ------
        DloError
            If no end slides, if both do and the length is asked for, or if `what` is neither.
        """
        model, name = self.model, self.model.cable.name
        if what not in ("tension", "free_length"):
            raise DloError(f"fed_by: 'tension' or 'free_length', found {what!r}")
        if not model.slides:
            held = f"its ends are {model.start} and {model.end}"
            raise DloError(f"{name!r} is not fed: {held}\n  Try: boundary=('clamped', 'slide')")
        return replace(self, model=replace(model, fed_by_length=what == "free_length"))

    def save(self, path: str | PathLike[str]) -> Path:
        """Write parameters.yaml, which `load` and the commands read; return its path.

        Parameters
        ----------
        path : str or Path
            A folder, which is made if need be, or the name of a file that ends in .yaml.

        Raises
        ------
        DloError
            If the cable has clips, which are of a pose, if the file cannot be written, or if
            another file of its name is there.
        """
        return write_parameters(self.metadata.document, self.model, path)

    def compile(
        self, *, flags: Sequence[str] = ("-O2",), obstacles: int = 0, motion: bool = False
    ) -> CompiledSolver:
        """The cable as C, compiled and loaded: thousands of shapes a second.

        Parameters
        ----------
        flags : sequence of str
            For the compiler.
        obstacles : int
            Maximum number of obstacles on which the cable may lie, see `CompiledSolver`.
        motion : bool
            Whether it also steps the cable in time, see `CompiledStepper`.

        Raises
        ------
        DloError
            If there is no C compiler, if it rejects the flags, or if motion does not know a part of
            the cable.
        """
        chosen: dict[str, Any] = {"flags": flags, "obstacles": obstacles, "motion": motion}
        return CompiledSolver(self.model, self.p, self.rest, **chosen)


# Rounding error allowed in arc lengths beyond the ends, relative to the length.
_ROUNDING = 1e-9


class CableCurve(NodeCurve):
    """A cable from its start at s = 0 to its end at s = L = `length` [m]."""

    def at(self, s: ArrayLike, derivative: int = 0) -> FloatArray:
        """Positions (K, d) [m] at arc lengths s (K,) [m] in [0, L], or derivatives by s.

        `derivative`: 0 for positions, 1 for the first derivative, 2 for the second.

        Raises
        ------
        DloError
            If an arc length is outside the cable, or if there is no such derivative.
        """
        if derivative not in (0, 1, 2):
            raise DloError(f"derivative: 0, 1 or 2 belongs here, found {derivative!r}")
        try:
            places = np.atleast_1d(np.asarray(s, dtype=float)).ravel()
        except (TypeError, ValueError):
            raise DloError(f"s: arc lengths [m] belong here, found {s!r}") from None
        slack = _ROUNDING * self.length
        outside = places[~((places >= -slack) & (places <= self.length + slack))]
        if len(outside):
            raise DloError(
                f"s = {outside[0]:g} m is not on the cable: {len(outside)} of "
                f"{counted(len(places), 'arc length')} outside 0 to {self.length:g} m.\n"
                "  Try: arc lengths in metres from the start."
            )
        return super().at(np.clip(places, 0.0, self.length), derivative)

    def frames(self, s: FloatArray, places: FloatArray, x: FloatArray) -> FloatArray:
        """Material frames (K, d, d) at s [m]: columns are the tangent and the section's axes.

        In a plane the second column is to the left. In space the roll about the tangent is
        interpolated between the nodes, whose states are `x` (N, coordinates) at `places` (N,) [m].
        """
        tangents = unit(self.at(s, 1))
        if self.d == 2:
            return np.stack([tangents, tangents[:, ::-1] * (-1.0, 1.0)], axis=2)
        y = Rotation.from_quat(Frame.interpolated(s, places, x)).apply([0.0, 1.0, 0.0])
        y = unit(y - (y * tangents).sum(axis=1, keepdims=True) * tangents)
        return np.stack([tangents, y, np.cross(tangents, y)], axis=2)
