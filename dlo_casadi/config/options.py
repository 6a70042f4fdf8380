"""How the fit goes about it: the declared model, the estimate, the diagnosis; and limits."""

from collections.abc import Iterator, Mapping, Sequence
from typing import Annotated, Literal

from pydantic import BeforeValidator, Field

from dlo_casadi.config.problems import ConfigProblem
from dlo_casadi.config.values import (
    FORCE,
    LENGTH,
    MOMENT,
    ConfigSection,
    Elements,
    Number,
    Positive,
    Range,
    RestCoefficients,
    Switch,
    within,
)
from dlo_casadi.thresholds import SIGNIFICANCE

ElementName = Literal["quadratic", "arc", "link"]


class EffectParameter(ConfigSection):
    """The declared value of an effect's parameter: an initial guess, or kept when fixed."""

    value: Number
    """Value in the parameter's own unit."""
    fixed: Switch = False
    """Whether the value is kept; otherwise it is where the fit starts."""


_as_parameter = BeforeValidator(
    lambda value: value if isinstance(value, Mapping | EffectParameter) else {"value": value},
    json_schema_input_type=float | EffectParameter,
)


class DeclaredEffect(ConfigSection):
    """An effect that is part of the model from the start."""

    name: str
    """Name of the effect, such as lumped_mass."""
    parameters: dict[str, Annotated[EffectParameter, _as_parameter]] = Field(default={})
    """Initial guess of each parameter by its name; {value: ..., fixed: true} keeps a value."""


_as_effect = BeforeValidator(
    lambda value: {"name": value} if isinstance(value, str) else value,
    json_schema_input_type=str | DeclaredEffect,
)


class ModelOptions(ConfigSection):
    """The declared model."""

    n: Elements | None = None
    """Number of elements; chosen from the data when absent."""
    element: ElementName = "quadratic"
    """quadratic (curvature changes in an element: fourth order), arc (it is constant: second
    order, five times cheaper) or link (straight, as in the paper; in a plane only)."""
    effects: tuple[Annotated[DeclaredEffect, _as_effect], ...] = ()
    """Effects beside bending and weight."""


class EstimationOptions(ConfigSection):
    """How the parameters are estimated."""

    algorithm1: Switch = True
    """Whether the paper's loop runs as a baseline."""
    algorithm1_n: Annotated[int, Field(strict=True, ge=2, le=200)] = 10
    """Number of links in the paper's loop."""
    algorithm1_inner: Literal["ipopt", "cobyla"] = "ipopt"
    """Its inner minimisation: ipopt, or cobyla as in the paper (about 1 s a pose)."""
    robust: Switch = False
    """Whether outlying points weigh less."""
    plausibility: Switch = True
    """Whether contradictions of the configuration stop the fit, or leave out a single pose."""
    rest_curvature_coefficients: RestCoefficients | None = None
    """Number of coefficients of the rest curvature, 0 for a straight one; chosen from the data."""


class DiagnosisOptions(ConfigSection):
    """The search for missing effects."""

    enabled: Switch = True
    """Whether missing effects are searched for."""
    exclude: tuple[str, ...] = ()
    """Names of effects that are not tried."""
    significance: Annotated[float, Field(strict=True, gt=0.0, lt=1.0)] = SIGNIFICANCE
    """Largest p-value with which an effect is added."""
    max_effects: Annotated[int, Field(strict=True, ge=0)] = 4
    """Largest number of effects that are added."""


# Largest bend radius and clearance of a limit, in lengths of the cable. At a radius of three the
# whole cable turns by 20 degrees; a limit in millimetres would be hundreds of lengths.
_LARGEST = 3.0
# A full turn in a tenth of a millimetre.
_TWIST = Range(0.0, 1.0e5, "1/m")


class Limits(ConfigSection):
    """What the cable must keep."""

    bend_radius: Annotated[Positive, within(LENGTH._replace(least=1.0e-4))] | None = None
    """Least radius of curvature [m]."""
    force: Annotated[Positive, within(FORCE)] | None = None
    """Greatest force of the cable on each of its fixtures [N]."""
    moment: Annotated[Positive, within(MOMENT)] | None = None
    """Greatest moment of the cable on each clamp [N m]."""
    twist: Annotated[Positive, within(_TWIST)] | None = None
    """Greatest twist in space, the angle about the axis per length [1/m]."""
    clearance: Annotated[Positive, within(LENGTH._replace(least=1.0e-6))] | None = None
    """Least distance of the cable's surface from obstacles without touch: allowed [m]."""

    @property
    def given(self) -> dict[str, float]:
        """The limits that there are, by their names."""
        values = {name: getattr(self, name) for name in type(self).model_fields}
        return {name: value for name, value in values.items() if value is not None}

    def problems(
        self, held: Sequence[str], twists: bool, length: float, avoided: bool
    ) -> Iterator[ConfigProblem]:
        """Find limits that have no meaning for a cable.

        `held` are the kinds of its ends and clips, `length` [m] is the cable's; `twists`: whether
        it can, in space; `avoided`: whether there are obstacles that it is not meant to touch.
        """
        for name in ("bend_radius", "clearance"):
            value = self.given.get(name, 0.0)
            if value > _LARGEST * length:
                text = f"limits.{name}: {value:g} m for a cable of {length:g} m: units are SI"
                meant = value / 1e3
                hint = f", did you mean {meant:g}?" if meant < length else ""
                yield ConfigProblem((name,), f"{text}{hint}")
        if self.clearance is not None and not avoided:
            text = "limits.clearance: there is no obstacle that the cable is not meant to touch"
            hint = "obstacles (experiment: obstacles, --obstacles FILE) without touch: allowed"
            yield ConfigProblem(("clearance",), f"{text}. Try: {hint}")
        if self.twist is not None and not twists:
            text = "limits.twist: a cable in a plane (two numbers of gravity) does not twist"
            yield ConfigProblem(("twist",), f"{text}. Try: leave it out")
        if self.moment is not None and not {"clamped", "swivel"} & {*held}:
            text = f"limits.moment: no end is clamped ({', '.join(held)}), none takes a moment"
            yield ConfigProblem(("moment",), f"{text}. Try: leave it out")
