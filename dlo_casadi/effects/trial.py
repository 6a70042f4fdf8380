"""Trial of an effect's methods, each called once as a model calls it, before any fit does."""

import difflib
import inspect
import traceback
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, fields, is_dataclass, replace
from typing import Any

import casadi as ca
import numpy as np

from dlo_casadi.effects.acting import MassAt, PointForceAt, SpringAt
from dlo_casadi.effects.cable import CableData, Parameter, Setup
from dlo_casadi.effects.damping import Damping
from dlo_casadi.effects.effect import (
    BoundaryEffect,
    ContactEffect,
    Effect,
    EndConditions,
    Kinematics,
    Load,
    MeasurementEffect,
    SectionLaw,
    StateEffect,
    Viewpoint,
)
from dlo_casadi.errors import DloError, counted
from dlo_casadi.rod.element import Cell
from dlo_casadi.rod.ends import ClipConditions, reaction_rows
from dlo_casadi.rod.node import Frame, Heading, Node
from dlo_casadi.rod.obstacles import Capsule, Plane
from dlo_casadi.rod.supports import SupportKind

# Step from the value at which an effect vanishes to another trial value, in scales.
_STEP = 0.3
# Strains of a trial [1/m]: those of a bent cable, and of one that is as at rest, where roots of
# squares have no derivative.
_BENDS = (1.3, 0.0)


class Mistake(Exception):  # noqa: N818  (what a message says, raised where it is found)
    """What is wrong with a class of an effect, and what to try."""


class _Params(dict[str, ca.SX]):
    """Symbols of the parameters, which say what there is if a law asks for another one."""

    def __missing__(self, name: str) -> ca.SX:
        raise Mistake(
            f"it has no parameter {name!r}, it has {', '.join(self)}.\n"
            f"  Try: {_nearest(name, self) or 'a Parameter of that name'}"
        )


def _nearest(word: str, known: Iterable[str]) -> str:
    near = difflib.get_close_matches(word, list(known), 1, cutoff=0.5)
    return repr(near[0]) if near else ""


@dataclass(frozen=True)
class _Law:
    """A method, its arguments, and how its result is taken apart: what, value, its shape."""

    method: str
    arguments: tuple[Any, ...]
    parts: Callable[[Any], Iterator[tuple[str, Any, tuple[int, int]]]]


class Trial:
    """An effect in one setup, with symbols for everything that its laws are given."""

    def __init__(self, kind: type[Effect], setup: Setup) -> None:
        self.kind, self.setup, self.cable = kind, setup, setup.cable
        self.node: type[Node] = Heading if len(setup.gravity) == 2 else Frame
        # Geometry: symbol and trial value of each.
        self.given: list[tuple[ca.SX, np.ndarray]] = []
        self.effect: Effect = _called(kind, "made_for", setup)
        self.parameters: tuple[Parameter, ...] = _called(self.effect, "parameters", self.cable)
        _check_tuple("parameters", self.parameters, Parameter)

    def run(self) -> None:
        """Raise a Mistake at the first method that fails or returns something strange."""
        effect, names = self.effect, [q.name for q in self.parameters]
        nominal = {q.name: q.nominal for q in self.parameters}
        others = _called(effect, "per_pose", self.cable)
        params = _Params({name: ca.SX.sym(name) for name in (*names, *others)})
        values = [{**nominal, **dict.fromkeys(others, 0.0)}]
        values.append(values[0] | {q.name: _beside(q) for q in self.parameters})
        for scan in _called(effect, "scans", self.setup):
            if strange := [name for name in scan if name not in names]:
                raise Mistake(
                    f"its scans name {strange[0]!r}, and it has {', '.join(names)}.\n"
                    "  Try: a Parameter of that name"
                )
        _called(effect, "prior", self.setup)
        _called(effect, "refusal", self.setup, nominal)
        _called(effect, "place", nominal)
        for law in self._laws(params):
            result = _called(effect, law.method, *law.arguments)
            for what, value, shape in law.parts(result):
                self._check(law.method, what, value, shape, params, values)

    # ---- what the methods are given ------------------------------------------------------------

    def _symbol(self, name: str, values: Any) -> ca.SX:
        column = np.atleast_1d(np.array(values, dtype=float))
        symbol = ca.SX.sym(name, len(column))
        self.given.append((symbol, column))
        return symbol

    def _laws(self, params: _Params) -> Iterator[_Law]:
        d, cable, effect, sym = self.node.dimension, self.cable, self.effect, self._symbol
        gravity = ca.SX(ca.DM(self.setup.gravity))  # numbers, as in a model
        places = (np.linspace(0.0, 0.1, d), np.linspace(0.5, 0.2, d) * cable.length)
        if isinstance(effect, SectionLaw):
            cell = Cell(sym("low", 0.4), sym("width", 0.05), 0.05)
            yield _Law("along", (cell, cable, params), _number)
            square = sym("square", _BENDS[0])
            yield _Law("of_bend", (square, cable, params), _number)
            yield _Law("tangent", (square, cable, params), _number)
            if d == 3:
                stiff = cable.bending_stiffness * ca.SX.eye(2)
                yield _Law("bending", (stiff, params), _shaped(2, 2))
            yield _Law("dynamic", (params,), _number)
        if isinstance(effect, Kinematics):
            yield _Law("stretch", (cable, params), _number)
            yield _Law("compliance", (params,), _number)
        if isinstance(effect, Load):
            yield _Law("gravity", (gravity, params), _shaped(d))
            yield _Law("resultant", (sym("s", 0.4), gravity, cable, params), _force(d))
            yield _Law("forces", (gravity, params), _items(PointForceAt, {"force": d}))
            springs = _items(SpringAt, {"force": d}, effect.n_springs)
            yield _Law("springs", (params,), springs)
            yield _Law("masses", (params,), _items(MassAt, {}))
            yield _Law("mass_per_length", (sym("s", 0.4), cable, params), _number)
        if isinstance(effect, Damping):
            velocity, tangent = sym("velocity", np.zeros(d)), sym("tangent", np.eye(d)[0])
            yield _Law("density", (velocity, tangent, cable, params), _number)
            yield _Law("of_turning", (params,), _number)
            turning = sym("turning", np.zeros(self.node.increment))
            yield _Law("at_pin", (turning, params), _number)
        if isinstance(effect, BoundaryEffect):
            frames = (self.node.identity, self.node.identity)
            first, last = (sym(name, x) for name, x in zip(("first", "last"), frames, strict=True))
            clips = tuple(
                ClipConditions(
                    sym("place", places[1] / 2), sym("at", 0.5), ca.SX.zeros(self.node.increment)
                )
                for _ in self.setup.clips
            )
            start, end = (sym(name, x) for name, x in zip(("start", "end"), places, strict=True))
            ends = EndConditions(start, end, first, last, self.node, clips)
            yield _Law("conditions", (ends, params), _ends(ends))
            yield _Law("energy", (first, last, params), _number)
            yield _Law("compliance", (params,), _two_numbers)
        if isinstance(effect, ContactEffect):
            yield _Law("surface", (self.setup.gravity,), _obstacle)
        if isinstance(effect, MeasurementEffect):
            point, frame = sym("point", places[1]), sym("frame", self.node.identity)
            viewpoint = Viewpoint(ca.SX.zeros(d), sym("camera", (0.2, 0.1)), sym("nearness", 1.0))
            if self.setup.camera or d == 2:
                yield _Law("observe", (point, frame, viewpoint, params), _shaped(d))
            rows = reaction_rows(self.node, len(self.setup.clips))
            felt = {name: sym(name, np.ones(at.stop - at.start)) for name, at in rows.items()}
            yield _Law("feel", (felt, params), _felt(felt))
        if isinstance(effect, StateEffect):
            count = len(self.node.strains)
            rest, strain = sym("rest", np.full(count, 0.5)), sym("strain", np.full(count, 2.0))
            yield _Law("next_rest", (rest, strain, cable, params), _shaped(count))

    # ---- what they return ----------------------------------------------------------------------

    def _check(
        self,
        method: str,
        what: str,
        value: Any,
        shape: tuple[int, int],
        params: _Params,
        values: list[dict[str, float]],
    ) -> None:
        """Raise a Mistake if a value has another shape, a symbol of its own, or is not finite."""
        belongs = "one number" if shape == (1, 1) else f"the shape {shape}"
        where = f"its {method}" + f", {what}," * bool(what)
        if isinstance(value, ca.MX) or not isinstance(
            value, ca.SX | ca.DM | float | int | np.ndarray
        ):
            raise Mistake(
                f"{where} returns {type(value).__name__}: a casadi.SX or a number belongs there.\n"
                "  Try: an expression of its arguments"
            )
        out = ca.SX(value)
        if out.shape != shape:
            raise Mistake(f"{where} has the shape {out.shape}, and {belongs} belongs there.")
        arguments = [symbol for symbol, _ in self.given] + list(params.values())
        known = {str(one) for one in ca.symvar(ca.veccat(*arguments))}
        if own := [str(one) for one in ca.symvar(out) if str(one) not in known]:
            raise Mistake(
                f"{where} contains the symbol {own[0]!r}, which is none of its arguments."
            )
        geometry = ca.veccat(*(symbol for symbol, _ in self.given))
        numbers = ca.veccat(*params.values())
        slope = ca.jacobian(out, ca.vertcat(geometry, numbers))
        second = ca.jacobian(ca.jacobian(out, geometry), geometry)
        names = ("value", "derivative", "second derivative")
        evaluated = ca.Function("trial", [geometry, numbers], [out, slope, second])
        for number in values:
            for bend in _BENDS if method in ("of_bend", "tangent") else _BENDS[:1]:
                at = [[bend] if str(s[0]) == "square" else x.tolist() for s, x in self.given]
                flat = [x for column in at for x in column]
                found = evaluated(flat, list(number.values()))
                for name, result in zip(names[: 3 - (method == "tangent")], found, strict=False):
                    if not np.isfinite(result.full()).all():
                        self._refuse(where, name, number, bend)

    def _refuse(self, where: str, name: str, values: Mapping[str, float], bend: float) -> None:
        place = ", ".join(f"{key} = {x:g}" for key, x in values.items())
        straight = " of a cable as at rest (square = 0)" if bend == 0.0 else ""
        meant = (
            "ca.sin and the like, not those of math; a nominal value at which it is finite"
            if name == "value"
            else "ca.sqrt(x**2 + width**2) in place of roots and absolute values of x"
        )
        raise Mistake(
            f"the {name} of {where.rstrip(',')} is not finite at {place}{straight}.\n  Try: {meant}"
        )


def try_out(kind: type[Effect]) -> None:
    """Raise a Mistake if an effect fails in a setup to which it applies, in a plane or in space."""
    for d in kind.dimensions:
        for setup in _setups(d):
            try:
                if _called(kind, "applies", setup):
                    Trial(kind, setup).run()
            except Mistake as mistake:
                said = ", in space; or dimensions = (2,), if it is of a plane alone"
                said *= d == 3 and 2 in kind.dimensions
                if not any(setup.gravity):
                    said = ", without gravity: gravity itself, not its direction; or `impossible`"
                raise Mistake(f"{mistake}{said}") from None


def _setups(d: int) -> Iterator[Setup]:
    """Setups of several kinds in a plane (2) or in space (3)."""
    cable = CableData(1.0, 1.0, 0.01, 1.0, torsional_stiffness=None if d == 2 else 1.0)
    plain = Setup(cable, gravity=(*(0.0,) * (d - 1), -9.81))
    rows = reaction_rows(Heading if d == 2 else Frame, 2)
    seen = replace(
        plain,
        n_poses=3,
        center=(0.1, 0.1) if d == 2 else None,
        pixel=1e-3,
        camera=True,
        readings=tuple(rows),
        largest_bend=2.0,
        clips=(SupportKind.CLAMPED, SupportKind.EYELET),
        obstacles=1,
        resting=-0.5,
    )
    yield plain
    yield replace(plain, gravity=(0.0,) * d)
    yield seen
    yield replace(seen, start=SupportKind.CLAMPED, end=SupportKind.CLAMPED)
    yield replace(seen, start=SupportKind.CLAMPED, end=SupportKind.FREE)


def _beside(q: Parameter) -> float:
    """Another value that a fit may try: a step above the nominal one, or below it."""
    low, high = q.range
    up = q.nominal + _STEP * q.scale
    return up if up <= high else max(q.nominal - _STEP * q.scale, low)


def _called(owner: Effect | type[Effect], name: str, *arguments: Any) -> Any:
    """Result of a method of an effect or its class; raises a Mistake that says where it failed."""
    method = getattr(owner, name)
    kind = owner if isinstance(owner, type) else type(owner)
    try:
        inspect.signature(method).bind(*arguments)
    except TypeError:
        declared = next(
            vars(base)[name]
            for base in kind.__mro__
            if name in vars(base) and base.__module__.startswith("dlo_casadi.")
        )
        plain = declared.__func__ if isinstance(declared, classmethod) else declared
        first, *given = inspect.signature(plain).parameters
        found = ", ".join(inspect.signature(method).parameters)
        raise Mistake(
            f"its {name} takes ({found}), and is called with ({', '.join(given)}).\n"
            f"  Try: def {name}({', '.join((first, *given))})"
        ) from None
    try:
        return method(*arguments)
    except Exception as error:
        raise Mistake(f"its {name} fails{_line(error, method)}: {_reason(error)}") from None


def _reason(error: Exception) -> str:
    if isinstance(error, Mistake):
        return str(error)
    if isinstance(error, DloError):
        return error.message
    if isinstance(error, AttributeError) and error.obj is not None:
        known = _attributes(error.obj)
        return (
            f"{type(error.obj).__name__} has no {error.name!r}, it has {', '.join(known)}.\n"
            f"  Try: {_nearest(str(error.name), known) or 'one of these'}"
        )
    said = str(error).strip().splitlines()[-1:] or ["no message"]
    return (
        f"{type(error).__name__}: {said[0].rstrip('.')}.\n"
        "  Try: functions of casadi (ca.sin, ca.sqrt, ca.if_else) on what it is given"
    )


def _line(error: Exception, method: Any) -> str:
    """The line of the method's file that failed."""
    code = getattr(getattr(method, "__func__", method), "__code__", None)
    lines = traceback.extract_tb(error.__traceback__)
    own = [one for one in lines if code is not None and one.filename == code.co_filename]
    return f" in line {own[-1].lineno}, `{own[-1].line}`" if own and own[-1].line else ""


def _attributes(value: object) -> list[str]:
    """Public attributes of what a law is given."""
    if is_dataclass(value) or hasattr(value, "_fields"):
        listed = {field.name for field in fields(value)} if is_dataclass(value) else set()
        return sorted(listed | {name for name in dir(value) if not name.startswith("_")})
    return sorted(name for name in dir(value) if not name.startswith("_"))[:12]


def _check_tuple(method: str, found: object, item: type) -> None:
    if not isinstance(found, tuple) or not all(isinstance(one, item) for one in found):
        raise Mistake(
            f"its {method} must return a tuple of {item.__name__}, found {type(found).__name__}.\n"
            f"  Try: return ({item.__name__}(...),), with the comma"
        )


def _number(result: Any) -> Iterator[tuple[str, Any, tuple[int, int]]]:
    yield "", result, (1, 1)


def _shaped(rows: int, columns: int = 1) -> Callable[[Any], Iterator[Any]]:
    return lambda result: iter([("", result, (rows, columns))])


def _force(d: int) -> Callable[[Any], Iterator[Any]]:
    """A force, or zero for none."""
    return lambda result: iter([] if isinstance(result, float | int) else [("", result, (d, 1))])


def _items(
    item: type, sizes: Mapping[str, int], count: int | None = None
) -> Callable[[Any], Iterator[Any]]:
    """A tuple of items whose attributes have these sizes, all others 1."""

    def parts(result: Any) -> Iterator[Any]:
        method = {PointForceAt: "forces", SpringAt: "springs", MassAt: "masses"}[item]
        _check_tuple(method, result, item)
        if count is not None and len(result) != count:
            raise Mistake(
                f"its springs returns {counted(len(result), 'spring')}, and n_springs is {count}.\n"
                f"  Try: n_springs = {len(result)} in the class"
            )
        for one in result:
            for field in fields(one):
                yield field.name, getattr(one, field.name), (sizes.get(field.name, 1), 1)

    return parts


def _ends(given: EndConditions) -> Callable[[Any], Iterator[Any]]:
    def parts(result: Any) -> Iterator[Any]:
        if not isinstance(result, EndConditions) or len(result.clips) != len(given.clips):
            raise Mistake(
                f"its conditions returns {type(result).__name__}: EndConditions belong there.\n"
                "  Try: dataclasses.replace(ends, end=...)"
            )
        for name in ("start", "end", "start_frame", "end_frame"):
            yield name, getattr(result, name), getattr(given, name).shape

    return parts


def _two_numbers(result: Any) -> Iterator[Any]:
    if not isinstance(result, tuple) or len(result) != 2:
        raise Mistake(
            f"its compliance returns {type(result).__name__}: two belong there, of start and end.\n"
            "  Try: return 0.0, params[...]"
        )
    yield from ((name, x, (1, 1)) for name, x in zip(("start", "end"), result, strict=True))


def _obstacle(result: Any) -> Iterator[Any]:
    if result is not None and not isinstance(result, Plane | Capsule):
        raise Mistake(f"its surface returns {type(result).__name__}: a Plane or a Capsule belongs.")
    return iter(())


def _felt(given: Mapping[str, ca.SX]) -> Callable[[Any], Iterator[Any]]:
    def parts(result: Any) -> Iterator[Any]:
        if not isinstance(result, Mapping) or result.keys() != given.keys():
            raise Mistake(
                "its feel must return all readings that it is given, by their names: "
                f"{', '.join(given)}.\n  Try: felt = dict(reactions); ...; return felt"
            )
        yield from ((name, result[name], symbol.shape) for name, symbol in given.items())

    return parts
