"""How the fit goes about it: the declared model, the estimate, the diagnosis."""

from collections.abc import Mapping
from typing import Annotated, Literal

from pydantic import BeforeValidator, Field

from dlo_casadi.config.values import ConfigSection, Elements, Number, RestCoefficients, Switch
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
