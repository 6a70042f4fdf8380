"""Which values a cable, its fixtures and its measurement can have at all.

What lies beyond is a slip (a unit, an exponent) and cannot be computed with: it is refused with the
range that is allowed. What can be computed but is hardly meant is a warning of `load_config`.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import NamedTuple

from dlo_casadi.config.problems import Place, Problem
from dlo_casadi.effects.cable import STIFFNESS_BOUNDS
from dlo_casadi.errors import counted


class Range(NamedTuple):
    """From where to where a value can lie."""

    least: float
    most: float
    unit: str

    def __contains__(self, value: object) -> bool:
        return isinstance(value, int | float) and self.least <= value <= self.most

    def __str__(self) -> str:
        return f"{self.least:g} to {self.most:g}{self.unit and ' '}{self.unit} is possible"

    def complaint(self, value: float) -> str:
        """What is wrong with a value that lies outside; empty if it does not."""
        return "" if value in self else f"{value:g}{self.unit and ' '}{self.unit}: {self}"

    def problems(self, place: Place, value: float, hint: str = "") -> list[Problem]:
        """The same as a list of at most one problem of a place."""
        text = self.complaint(value)
        return [Problem(place, text + hint)] if text else []


# Nothing shorter than a millimetre is held in two fixtures; 100 m hang between two masts.
LENGTH = Range(1.0e-3, 100.0, "m")
# Rounding to three digits moves the length of a quaternion by so much at most.
_UNIT = 2.0e-3
# Carbon fibres have 5e-6 m; the upper limit is the length itself.
_THINNEST = 1.0e-6
# A millimetre of the thinnest wire on sale (copper, 10 um): 9e3 pi (5e-6)^2 1e-3 = 7e-10 kg.
_LIGHTEST = 1.0e-10
# A metre of a submarine power cable has 100 kg.
_HEAVIEST, _HEAVIEST_PER_METRE = 1000.0, 100.0
# From polystyrene foam to osmium, the densest metal.
_DENSITIES = Range(15.0, 2.26e4, "kg/m^3")
# A strip whose thickness is declared as its diameter seems denser (0.9 mm, 0.25 m and 17 g: 1.1e5),
# a tube lighter; but 200 kg/m^3, less than any rope, are 2e5 in grams, and what is lighter than air
# does not hang.
_POSSIBLE_DENSITIES = Range(1.2, 2.0e5, "kg/m^3")
# A carbon fibre has E pi d^4 / 64 = 2.3e11 pi (5e-6)^4 / 64 = 7e-12 N m^2, a steel bar of 0.5 m
# 6e8 N m^2: the bounds of the fit itself.
STIFFNESS = Range(*STIFFNESS_BOUNDS, "N m^2")
# The largest centrifuge for models of soil reaches some 1e3 times the Earth's 9.81 m/s^2.
GRAVITY = Range(0.0, 1.0e4, "m/s^2")
# A frame whose origin is farther away is that of a map; of 1e3 m, doubles resolve 1e-13 m.
COORDINATE = Range(-1.0e3, 1.0e3, "m")
# A fifth of the wavelength of green light, beyond any camera. Upwards: the cable's length.
FINEST_STD = 1.0e-7
# A nanometre over a metre is what interferometers resolve.
FINEST_TOLERANCE = 1.0e-9
# The heaviest cable (100 kg/m, 100 m) weighs 1e5 N; taut it pulls more. A moment: a metre's arm.
FORCE, MOMENT = Range(-1.0e6, 1.0e6, "N"), Range(-1.0e6, 1.0e6, "N m")
# A nanonewton is what atomic force microscopes resolve.
FORCE_STD, MOMENT_STD = FORCE._replace(least=1.0e-9), MOMENT._replace(least=1.0e-9)
# A camera's picture is less than 1e5 pixels wide, its focal length less than ten times that.
PIXELS = Range(-1.0e6, 1.0e6, "px")
FOCAL_LENGTH = Range(1.0, 1.0e6, "px")
# Terms of a wide lens that cancel one another reach hundreds; a million is a slip.
DISTORTION = Range(-1.0e6, 1.0e6, "")
# A marker of a tenth of a millimetre has no pixels; ten metres are the side of a house.
MARKER = Range(1.0e-4, 10.0, "m")
# Two elements have a joint between them; of a metre, 2000 are half a millimetre each, less than a
# cable is thick.
MESH = Range(2, 2000, "elements")
# Cubic splines need four coefficients. A line of 240 points has four between two knots of 64; the
# covariance that a result holds grows with their square.
REST_COEFFICIENTS = Range(0, 64, "coefficients")


def implausible_sizes(
    length: float, mass: float, diameter: float, stiffness: float | None = None
) -> list[Problem]:
    """Find sizes [m], [kg], [N m^2] of a cable that no cable has, by their key."""
    sizes = list(_implausible(length, mass, diameter))
    sizes = sizes or list(_implausible_density(length, mass, diameter))
    problems = [Problem((key,), text) for key, text in sizes]
    if stiffness is not None:
        problems += STIFFNESS.problems(("bending_stiffness",), stiffness)
    return problems


def _implausible(length: float, mass: float, diameter: float) -> Iterator[tuple[str, str]]:
    """Find sizes that are impossible one by one: the key, and what is wrong."""
    if length not in LENGTH:
        hint = _meant(length / 1e3, length / 1e3 in LENGTH)  # of millimetres
        yield "length", f"{length:g} m: units are SI, {hint}{LENGTH}"
    elif diameter > length:
        hint = _meant_diameter(length, mass, diameter)
        text = f"{diameter:g} m is larger than the length {length:g} m: units are SI{hint}"
        yield "diameter", text
    elif wrong := Range(_THINNEST, length, "m").complaint(diameter):
        yield "diameter", wrong
    heaviest = min(_HEAVIEST, _HEAVIEST_PER_METRE * length)
    if mass > heaviest:
        hint = _meant(mass / 1e3, mass / 1e3 <= heaviest)  # of grams
        possible = f"at most {heaviest:g} kg is possible"
        yield "mass", f"{mass:g} kg for {length:g} m: units are SI, {hint}{possible}"
    elif mass < _LIGHTEST:
        text = f"no cable is lighter than {_LIGHTEST:g} kg; to leave its weight out, write "
        yield "mass", f"{mass:g} kg: {text}gravity: [0, 0]"


def _implausible_density(length: float, mass: float, diameter: float) -> Iterator[tuple[str, str]]:
    """Find a mass [kg] that nothing of such a volume has."""
    apparent = _density(length, mass, diameter)
    if apparent > _POSSIBLE_DENSITIES.most:
        hint = _meant(mass / 1e3, apparent / 1e3 in _DENSITIES)
        yield (
            "mass",
            f"{mass:g} kg make it {apparent / 1e3:.3g} times as dense as water (osmium, the "
            f"densest metal: {_DENSITIES.most / 1e3:g}): units are SI, {hint}diameter and length "
            "in m?",
        )
    if apparent < _POSSIBLE_DENSITIES.least:
        yield (
            "diameter",
            f"{diameter:g} m make {mass:g} kg lighter than air, {apparent:.2g} kg/m^3: units are "
            f"SI{_meant_diameter(length, mass, diameter)}, mass in kg?",
        )


def _meant(value: float, possible: bool) -> str:
    """Question after a value of another unit, if it would be possible."""
    return f"did you mean {value:g}? " if possible else ""


def _density(length: float, mass: float, diameter: float) -> float:
    """Mass over volume [kg/m^3] of a round cable: m / (pi d^2 / 4 L)."""
    return mass / (length * math.pi * diameter * diameter / 4)  # inf where ** would raise


def _meant_diameter(length: float, mass: float, diameter: float) -> str:
    """Question after a diameter of millimetres or centimetres that would be sound in metres."""
    sound = (d for d in (diameter / 1e3, diameter / 1e2) if _density(length, mass, d) in _DENSITIES)
    meant = next(sound, None)
    return "" if meant is None else f", did you mean {meant:g}?"


def implausible_gravity(gravity: tuple[float, ...]) -> list[Problem]:
    """Find a gravity [m/s^2] that no laboratory has."""
    return GRAVITY.problems(("gravity",), math.hypot(*gravity))


def implausible_quaternion(values: Sequence[float]) -> str:
    """What is wrong with an orientation (x, y, z, w); empty if its length is one."""
    belongs = "a unit quaternion [qx, qy, qz, qw] belongs here"
    if len(values) != 4:
        return f"{belongs}, not {counted(len(values), 'number')}"
    size = math.hypot(*values)
    return "" if abs(size - 1) <= _UNIT else f"{belongs}, its length is {size:.4g}"
