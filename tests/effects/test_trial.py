"""Mistakes in an effect of one's own: told where it is registered, with the method that fails."""

import math
import time
from typing import ClassVar

import casadi as ca
import pytest

import dlo_casadi as dlo
from dlo_casadi.effects import (
    BoundaryEffect,
    Load,
    MeasurementEffect,
    Parameter,
    SectionLaw,
    StateEffect,
)


class Wavy(SectionLaw):
    """A section whose stiffness varies along the cable."""

    name = "wavy"
    declared: ClassVar = (Parameter("amplitude", "1", scale=0.1, lower=-0.9, upper=0.9),)

    def along(self, cell, cable, params):
        return 1 + params["amplitude"] * ca.sin(10 * cell.middle / cable.length)


class Frost(Load):
    """Ice of the same weight everywhere."""

    name = "frost"
    declared: ClassVar = (Parameter("weight", "N/m", scale=0.1),)

    def resultant(self, s, gravity, cable, params):
        return params["weight"] * (cable.length - s) * gravity / 9.81


def own(base, **methods):
    """A class of that base with other methods."""
    declared = getattr(base, "declared", ()) or (Parameter("x", "1"),)
    return type("Own", (base,), {"name": "own", "declared": declared, **methods})


def section(value):
    return own(Wavy, along=lambda self, cell, cable, params: value(cell, cable, params))


def bend(value):
    return own(Wavy, of_bend=lambda self, square, cable, params: value(square, params))


MISTAKES = {
    "an attribute that a cell lacks": (
        section(lambda cell, cable, params: cell.center),
        "its along fails in line .*cell.center.*Cell has no 'center', it has .*middle",
    ),
    "an attribute of the cable": (
        section(lambda cell, cable, params: cable.lenght),
        r"CableData has no 'lenght', it has .*Try: 'length'",
    ),
    "another parameter": (
        section(lambda cell, cable, params: params["amplitud"]),
        "its along fails .*it has no parameter 'amplitud', it has amplitude.*Try: 'amplitude'",
    ),
    "a missing argument": (
        own(Wavy, along=lambda self, cell, params: cell.middle),
        r"its along takes \(cell, params\), and is called with \(cell, cable, params\).*"
        r"Try: def along\(self, cell, cable, params\)",
    ),
    "a column for a number": (
        section(lambda cell, cable, params: ca.vertcat(1, cell.middle)),
        r"its along has the shape \(2, 1\), and one number belongs there",
    ),
    "nothing": (section(lambda *_: None), "its along returns NoneType: a casadi.SX or a number"),
    "a matrix symbol of MX": (
        section(lambda *_: ca.MX.sym("x")),
        "its along returns MX: a casadi.SX or a number belongs there",
    ),
    "a symbol of its own": (
        section(lambda *_: ca.SX.sym("x")),
        "its along contains the symbol 'x', which is none of its arguments",
    ),
    "a kink in a straight cable": (
        bend(lambda square, params: 1 + params["amplitude"] * ca.sqrt(square)),
        r"the derivative of its of_bend is not finite .*\(square = 0\).*Try: ca.sqrt\(x\*\*2",
    ),
    "functions of math": (
        section(lambda cell, cable, params: math.sin(cell.middle)),
        "the value of its along is not finite at amplitude = 0.*Try: ca.sin and the like",
    ),
    "a choice of Python": (
        section(lambda cell, cable, params: 2 if cell.middle > 0.5 else 1),
        "its along fails .*Cannot compute the truth value.*Try: functions of casadi .*if_else",
    ),
    "a number for a force": (
        own(Frost, resultant=lambda self, s, gravity, cable, params: params["weight"] * s),
        r"its resultant has the shape \(1, 1\), and the shape \(2, 1\) belongs there",
    ),
    "a logarithm of nothing": (
        own(Frost, resultant=lambda self, s, gravity, cable, p: gravity * ca.log(p["weight"])),
        "the value of its resultant is not finite at weight = 0",
    ),
    "the direction of no gravity": (
        own(
            Frost,
            resultant=lambda self, s, gravity, cable, p: p["weight"] * gravity / ca.norm_2(gravity),
        ),
        "the value of its resultant is not finite .*, without gravity: gravity itself, not its",
    ),
    "a plane of its own": (
        own(
            MeasurementEffect,
            observe=lambda self, point, frame, viewpoint, params: point + ca.DM([0, 1]),
        ),
        "its observe fails .*Dimension mismatch",
    ),
    "a vector for the ends": (
        own(BoundaryEffect, conditions=lambda self, ends, params: ends.end),
        "its conditions returns SX: EndConditions belong there.*Try: dataclasses.replace",
    ),
    "one number for two clamps": (
        own(BoundaryEffect, compliance=lambda self, params: params["x"]),
        "its compliance returns SX: two belong there",
    ),
    "a reading that is not there": (
        own(MeasurementEffect, feel=lambda self, reactions, params: {"end_force": ca.SX(2, 1)}),
        "its feel must return all readings that it is given, by their names: start_force",
    ),
    "a state without its cable": (
        own(StateEffect, next_rest=lambda self, rest, strain, params: rest),
        r"its next_rest takes \(rest, strain, params\), and is called with \(rest, strain, cable",
    ),
    "scans of a parameter that is not there": (
        own(Wavy, scans=lambda self, setup: ({"reach": 1.0},)),
        "its scans name 'reach', and it has amplitude",
    ),
    "a scale of nothing": (
        own(Wavy, parameters=lambda self, cable: (Parameter("amplitude", scale=0.0),)),
        "its parameters fails .*: parameter amplitude: scale 0.0 must be positive",
    ),
    "a setup that lacks it": (
        own(Wavy, applies=classmethod(lambda cls, setup: setup.gravty)),
        "its applies fails .*Setup has no 'gravty', .*Try: 'gravity'",
    ),
}


@pytest.fixture
def effects(monkeypatch):
    """The registry of this process, whose new entries are taken back."""
    before = dict(dlo.EFFECTS)
    yield dlo.EFFECTS
    for name in [name for name in dlo.EFFECTS if name not in before]:
        del dlo.EFFECTS[name]


@pytest.mark.parametrize("case", MISTAKES)
def test_a_mistake_is_told_before_any_fit(case, effects):
    kind, said = MISTAKES[case]
    started = time.process_time()
    with pytest.raises(dlo.DloError, match=f"(?s)^Own cannot be an effect: .*{said}"):
        effects["own"] = kind
    assert time.process_time() - started < 2.0  # a fit took 18 s to fail
    assert "own" not in effects


@pytest.mark.parametrize("kind", [Wavy, Frost])
def test_what_is_right_is_registered_and_may_be_replaced(kind, effects):
    effects[kind.name] = kind
    again = type(kind.__name__, (kind,), {"name": kind.name})  # a cell of a notebook, run again
    effects[kind.name] = again
    assert effects[kind.name] is again


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("lumped_mass", "lumped_mass is an effect of the package.*Try: another name"),
        ("tether_2", "tether is an effect of the package"),  # the name of a second tether
        ("my effect", "its name is 'my effect'.*Try: letters, digits and underscores"),
    ],
)
def test_a_name_that_cannot_be_used_is_refused(name, said, effects):
    before = effects.get(name)
    with pytest.raises(dlo.DloError, match=f"(?s){said}"):
        effects[name] = type("Own", (Wavy,), {"name": name})
    assert effects.get(name) is before
