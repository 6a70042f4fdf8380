"""Predict the shape of a fitted cable from where its ends are held."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, get_args

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import ArrayLike, NDArray

from dlo_casadi.config import implausible_quaternion
from dlo_casadi.effects import MeasurementEffect
from dlo_casadi.equilibrium.curve import NodeCurve
from dlo_casadi.equilibrium.equilibrium import Equilibrium
from dlo_casadi.equilibrium.pose import Branch, Pose
from dlo_casadi.equilibrium.solve import solve_equilibrium
from dlo_casadi.equilibrium.spread import EDGE, displacements, spread_across
from dlo_casadi.equilibrium.tipping import Tipping, tipping_of
from dlo_casadi.errors import DloError, EquilibriumError, counted
from dlo_casadi.estimation.prediction import sides_of
from dlo_casadi.io.parameters import Parameters, load_parameters
from dlo_casadi.model.assembly import Given, assembly_of
from dlo_casadi.model.cable_model import CableModel
from dlo_casadi.report.drawing import prediction_figure
from dlo_casadi.report.notebook import shape_html, shape_text

FloatArray = NDArray[np.floating]


# Arc lengths may miss the cable by so many of its lengths: rounding.
_ROUNDING = 1e-9


class CableCurve(NodeCurve):
    """A cable from its start at s = 0 to its end at s = L = `length` [m]."""

    def at(self, s: ArrayLike, derivative: int = 0) -> FloatArray:
        """Positions (K, d) [m] at arc lengths s (K,) [m] in [0, L], or derivatives by s.

        Raises
        ------
        DloError
            If an arc length lies outside the cable.
        """
        try:
            places = np.atleast_1d(np.asarray(s, dtype=float)).ravel()
        except (TypeError, ValueError):
            raise DloError(f"s: arc lengths [m] belong here, found {s!r}") from None
        slack = _ROUNDING * self.length
        outside = places[~((places >= -slack) & (places <= self.length + slack))]
        if len(outside):
            raise DloError(
                f"s = {outside[0]:g} m is not on the cable: {len(outside)} of "
                f"{counted(len(places), 'arc length')} lie outside 0 to {self.length:g} m.\n"
                "  Try: arc lengths in metres from the start."
            )
        return super().at(np.clip(places, 0.0, self.length), derivative)


@dataclass(frozen=True, repr=False)
class PredictedShape:
    """A fitted cable in one pose. In a notebook it is a short table; `print` gives text.

    Parameters
    ----------
    cable : Parameters
        The fitted cable.
    pose : Pose
        How its ends are held; where the cable may hang on either side, with the `turns` or the
        `branch` of this one.
    equilibrium : Equilibrium
        Nodes, reactions, energy and stability.
    curve : CableCurve
        The cable itself, at any arc length: `curve.at(s)`.
    seen : CableCurve
        The same as the session's camera would measure it.
    other_side : PredictedShape or None
        The same pose on the other side: between two clamps in space twisted the other way round,
        of a free end fallen to the other side. Only where the uncertain parameters and fixtures do
        not tell which side is the lower one, and the pose does not name its side.
    tipping : Tipping or None
        How near the clamp then is to where both are equally low.
    """

    cable: Parameters
    pose: Pose
    equilibrium: Equilibrium
    curve: CableCurve
    seen: CableCurve
    other_side: PredictedShape | None = None
    tipping: Tipping | None = None

    def band(self, count: int = 101) -> FloatArray:
        """Half width (count,) [m] of the band across the cable that holds 90 % of next hangings.

        Uncertain parameters, scatter of the fixtures and how the cable repeats; first order.
        """
        model, p, rest, metadata = self.cable
        s = np.linspace(0.0, self.curve.length, count)
        known = metadata.uncertainty
        curve, moved = displacements(model, p, rest, self.pose, self.equilibrium, known, s)
        return np.asarray(EDGE * np.linalg.norm(spread_across(curve, s, moved), axis=1))

    def points(self, count: int = 101) -> FloatArray:
        """Points (count, d) [m] evenly spaced along the cable, from start to end.

        Raises
        ------
        DloError
            If fewer than two are asked for.
        """
        if not isinstance(count, int | np.integer) or count < 2:
            raise DloError(f"count: two points or more, from start to end, found {count!r}")
        return self.curve.at(np.linspace(0.0, self.curve.length, count))

    def plot(self) -> Figure:
        """The shape with the forces of the cable on its fixtures."""
        return prediction_figure(self.as_dict())

    def __str__(self) -> str:
        return shape_text(self.as_dict())

    __repr__ = __str__

    def _repr_html_(self) -> str:
        return shape_html(self.as_dict())

    def as_dict(self, count: int = 101) -> dict[str, Any]:
        """Everything a program may want to know, as plain data in SI units."""
        eq, pose = self.equilibrium, self.pose
        directions: dict[str, Any] = {
            "start_heading": pose.start_heading,
            "end_heading": pose.end_heading,
        }
        if self.cable.model.in_space:
            directions = {
                "start_orientation": _listed(pose.start_orientation),
                "end_orientation": _listed(pose.end_orientation),
                "turns": pose.turns,
            }
        return {
            "cable": self.cable.model.cable.name,
            "model_hash": self.cable.metadata.model_hash,
            "length": self.cable.model.cable.length,
            "start": list(pose.start),
            "end": _listed(pose.end),
            **directions,
            "branch": pose.branch,
            "status": eq.status.name.lower(),
            "stable": eq.stable,
            "energy": eq.energy,
            "force_on_start": eq.lam_start.tolist(),
            "force_on_end": eq.lam.tolist(),
            "moment_on_start": eq.moments[0].tolist(),
            "moment_on_end": eq.moments[1].tolist(),
            "min_bend_radius": eq.min_bend_radius,
            "points": self.points(count).tolist(),
            "band_90": self.band(count).tolist(),
            "other_side": self._other_side(count),
        }

    def _other_side(self, count: int) -> dict[str, Any] | None:
        """The other side as plain data, with its greatest distance [m] from this one."""
        other, near = self.other_side, self.tipping
        if other is None or near is None:
            return None
        apart = np.linalg.norm(other.points(count) - self.points(count), axis=1)
        shape = other.as_dict(count)
        del shape["other_side"]
        return {
            "tipping": near.angle,
            "tipping_std": near.std,
            "greatest_distance": float(apart.max()),
            **shape,
        }


def _listed(values: tuple[float, ...] | None) -> list[float] | None:
    return None if values is None else list(values)


def predict(
    parameters: str | Path | Parameters,
    end: Sequence[float] | None = None,
    *,
    start: Sequence[float] | None = None,
    start_heading: float | None = None,
    end_heading: float | None = None,
    start_orientation: Sequence[float] | None = None,
    end_orientation: Sequence[float] | None = None,
    turns: float = 0.0,
    branch: Branch | None = None,
) -> PredictedShape:
    """Predict the shape of a fitted cable.

    Of several equilibria the stable one of lowest energy, unless `branch` or `turns` name one;
    where nobody knows which of two sides is the lower one, with the other one as `other_side`.

    Parameters
    ----------
    parameters : str, Path or Parameters
        A parameters.yaml, the folder of results that holds it, or what was read from it.
    end : (d,) [m]
        Where the end is held, d = 2 or 3 in space; None for a free end.
    start : (d,) [m], optional
        Where the start is held; where all poses of the session had it, or the origin, by default.
    start_heading, end_heading : float [rad], optional
        Directions of clamped ends in a plane, continuous along the cable; those that all poses of
        the session shared by default.
    start_orientation, end_orientation : (4,), optional
        Frames of clamped ends in space: unit quaternions (x, y, z, w), x forward along the cable;
        those that all poses of the session shared by default.
    turns : float
        In space, the twist nearest to so many full turns, see `Pose`. A cable may shed two of them
        over a loop; that is an error.
    branch : "ccw" or "cw", optional
        In a plane, which way the cable turns from start to end.

    Raises
    ------
    ConfigError
        If the file cannot be used.
    EquilibriumError
        If the pose has no equilibrium, e.g. because the end is out of reach, or none is found on
        the branch.
    DloError
        If the ends are not held as the cable's boundary asks, or are no finite numbers.
    """
    if not isinstance(parameters, str | os.PathLike | Parameters):
        raise DloError(
            f"parameters: {parameters!r} is no path.\n"
            "  Try: the parameters.yaml or the results folder of a fit."
        )
    cable = parameters if isinstance(parameters, Parameters) else load_parameters(parameters)
    pose = _pose(
        cable,
        end,
        start,
        {
            "start_heading": start_heading,
            "end_heading": end_heading,
            "start_orientation": start_orientation,
            "end_orientation": end_orientation,
        },
        turns,
        branch,
    )
    model, p, rest, metadata = cable
    try:
        eq = solve_equilibrium(model, p, rest, pose)
    except EquilibriumError as error:
        # What the solver advises concerns a configuration; there is none here.
        happened = error.message.partition("\n  Try:")[0]
        other = "orientations, fewer turns" if model.in_space else "headings or branch"
        raise EquilibriumError(
            f"{happened}\n  Try: an end in metres, nearer to the start; other {other}.",
            p_des=error.p_des,
        ) from None

    def shape(pose: Pose, eq: Equilibrium) -> PredictedShape:
        true, seen = (curve(model, p, rest, pose, eq) for curve in (_true_curve, _curve))
        return PredictedShape(cable, pose, eq, true, seen)

    beyond = eq.other_side
    if beyond is None:
        return shape(pose, eq)
    near = tipping_of(model, p, rest, pose, eq, beyond, metadata.uncertainty)
    if not near.either:
        return shape(pose, eq)
    own, others = sides_of(model, pose, eq, beyond)
    return replace(shape(own, eq), other_side=shape(others, beyond), tipping=near)


def _pose(
    cable: Parameters,
    end: Sequence[float] | None,
    start: Sequence[float] | None,
    directions: Mapping[str, Any],
    turns: float,
    branch: Branch | None,
) -> Pose:
    """End conditions, checked against the boundary; what is not given is as in the session."""
    model, shared = cable.model, cable.metadata.fixtures
    name, size = model.cable.name, model.node.dimension
    if branch is not None and branch not in get_args(Branch):
        raise DloError(f"branch must be 'ccw', 'cw' or None, found {branch!r}")
    if branch is not None and model.in_space:
        raise DloError(f"{name!r} is in space: a branch has no meaning")
    if model.end == "free" and end is not None:
        raise DloError(f"the end of {name!r} is free: it cannot be held at {end} m")
    if model.end != "free" and end is None:
        place = "X Y Z" if model.in_space else "X Y"
        raise DloError(
            f"the end of {name!r} is {model.end}: where is it?\n"
            f"  Try: --end {place} [m], in Python end."
        )
    turns = _number(turns, "turns", "full turns")
    if turns and not (model.in_space and model.start == model.end == "clamped"):
        raise DloError(f"{name!r} has no turns: it is not in space and clamped at both ends")
    if start is None:
        start = shared.get("start") or (0.0,) * size
    return Pose(
        start=_point(start, "start", size),
        end=None if end is None else _point(end, "end", size),
        turns=turns,
        branch=branch,
        name=name or "cable",
        **_held(cable, directions),
    )


def _held(cable: Parameters, given: Mapping[str, Any]) -> dict[str, Any]:
    """Directions of the clamps, by their key; none of pins."""
    model, shared = cable.model, cable.metadata.fixtures
    kind, other, unit = "heading", "orientation", " [rad]"
    where = ("a plane", "two numbers of gravity")
    if model.in_space:
        kind, other, unit = other, kind, " [qx, qy, qz, qw]"
        where = ("space", "three numbers of gravity")
    found: dict[str, Any] = {}
    for side, held in (("start", model.start), ("end", model.end)):
        key, value = f"{side}_{kind}", given[f"{side}_{kind}"]
        if given[f"{side}_{other}"] is not None:
            raise DloError(
                f"{side}_{other}: {model.cable.name!r} is in {where[0]} ({where[1]}).\n  Try: {key}"
                f"{unit}"
            )
        if held != "clamped" and value is not None:
            raise DloError(f"the {side} of {model.cable.name!r} is {held}: {key} has no meaning")
        if held != "clamped":
            continue
        value = shared.get(key) if value is None else value
        if value is None:
            raise DloError(
                f"the {side} of {model.cable.name!r} is clamped, and its {kind} differed "
                f"from pose to pose: give {key}{unit}"
            )
        found[key] = _orientation(value, key) if model.in_space else _number(value, key, "rad")
    return found


_WORDS = {2: "two finite numbers (x, y)", 3: "three finite numbers (x, y, z)"}


def _point(values: Sequence[float], what: str, size: int) -> tuple[float, ...]:
    point = _finite(values)
    if len(point) != size:
        raise DloError(f"{what}: {_WORDS[size]} in metres belong here, found {values!r}")
    return point


def _orientation(values: Sequence[float], what: str) -> tuple[float, ...]:
    quaternion = _finite(values)
    if not quaternion:
        raise DloError(
            f"{what}: four finite numbers [qx, qy, qz, qw] belong here, found {values!r}"
        )
    if wrong := implausible_quaternion(quaternion):
        raise DloError(f"{what}: {wrong}, found {values!r}")
    return quaternion


def _finite(values: Any) -> tuple[float, ...]:
    """Finite numbers, or nothing."""
    try:
        array = np.asarray(values, dtype=float)
    except (TypeError, ValueError):
        return ()
    return tuple(array.tolist()) if array.ndim == 1 and np.all(np.isfinite(array)) else ()


def _number(value: Any, what: str, unit: str) -> float:
    try:
        number = float(value)
    except (TypeError, ValueError):
        number = np.nan
    if not np.isfinite(number):
        raise DloError(f"{what}: a finite number [{unit}] belongs here, found {value!r}")
    return number


def _curve(
    model: CableModel, p: FloatArray, rest: FloatArray, pose: Pose, eq: Equilibrium
) -> CableCurve:
    """The curve as the session's camera would measure it."""
    z = assembly_of(model).curve(eq.shapes, Given.of(p, rest, pose.vector[None]))[0]
    return CableCurve.of(model.cable.length, z)


def _true_curve(
    model: CableModel, p: FloatArray, rest: FloatArray, pose: Pose, eq: Equilibrium
) -> CableCurve:
    """The curve itself: the same model without what the camera adds."""
    seen = [effect for effect in model.effects if isinstance(effect, MeasurementEffect)]
    if not seen:
        return _curve(model, p, rest, pose, eq)
    true = replace(
        model, effects=tuple(effect for effect in model.effects if effect not in seen), priors={}
    )
    values = dict(zip(model.names, p, strict=True))
    return _curve(true, np.array([values[name] for name in true.names]), rest, pose, eq)
