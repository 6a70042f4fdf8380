"""The declared model of a configuration: cable, boundary, effects, and tolerances as nuisances."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from dlo_casadi.config import Config, unknown_effect
from dlo_casadi.effects import (
    EFFECTS,
    Cable,
    ClampAngle,
    EdgeBias,
    Effect,
    EndOffset,
    ImageDistortion,
    ImageScale,
    LengthError,
)
from dlo_casadi.errors import ConfigError
from dlo_casadi.estimation.gauss_newton import Tolerances
from dlo_casadi.model import CableModel

# Elements of the declared model's mesh; refined from the data.
MESH = 40
REST_COEFFICIENTS = 13
# Standard deviation of each harmonic of the edges' bias, in pixels.
EDGE_BIAS_PIXELS = 0.05


@dataclass(frozen=True)
class Declared:
    """The declared model and what of it is estimated.

    Parameters
    ----------
    model : CableModel
        Nominal values, priors of the nuisances within their tolerances.
    values : dict
        Starting values of declared effects' parameters by qualified name.
    fixed : tuple of str
        Parameters that keep their declared value.
    tolerances : Tolerances
    """

    model: CableModel
    values: dict[str, float]
    fixed: tuple[str, ...]
    tolerances: Tolerances

    def start_values(self) -> NDArray[np.floating]:
        """Parameter vector at the declared values."""
        p = self.model.nominal.copy()
        for name, value in self.values.items():
            p[self.model.names.index(name)] = value
        return p


def nuisances(model: CableModel, tolerances: Tolerances, pixel: float | None = None) -> CableModel:
    """Return the model with what lies within the declared tolerances as nuisances.

    Length, scale, position of the end fixture and directions of clamps get a Gaussian prior
    with the tolerance as standard deviation; photographs with pixels of the size `pixel` [m]
    also a bias of edges.
    """
    found: list[tuple[Effect, dict[str, float]]] = [
        (LengthError(), {"length_difference": tolerances.length}),
        (ImageScale(), {"factor": tolerances.scale}),
    ]
    if pixel is not None:
        bias = EdgeBias()
        names = [q.name for q in bias.parameters(model.cable)]
        found.append((bias, dict.fromkeys(names, EDGE_BIAS_PIXELS * pixel)))
    if model.end != "free":
        found.append((EndOffset(), {"dx": tolerances.end, "dy": tolerances.end}))
    sides = {"start": model.start == "clamped", "end": model.end == "clamped"}
    if any(sides.values()):
        priors = {
            f"{side}_heading_error": tolerances.heading for side, held in sides.items() if held
        }
        found.append((ClampAngle(start=sides["start"], end=sides["end"]), priors))
    present = {effect.label for effect in model.effects}
    for effect, priors in found:
        if effect.label not in present:
            model = model.with_effect(
                effect, {f"{effect.label}.{name}": std for name, std in priors.items()}
            )
    return model


def make_effect(name: str, model: CableModel, center: tuple[float, float] | None) -> Effect:
    """Return the effect of that name for this cable's boundaries and camera."""
    if name == "clamp_angle":
        return ClampAngle(start=model.start == "clamped", end=model.end == "clamped")
    if name == "image_distortion":
        return ImageDistortion(center=center or (0.0, 0.0))
    return EFFECTS[name]()


def declared_model(
    config: Config,
    center: tuple[float, float] | None = None,
    pixel: float | None = None,
) -> Declared:
    """Build the declared model.

    Parameters
    ----------
    center : (float, float), optional [m]
        Middle of the photographs in the board frame, for `image_distortion`.
    pixel : float, optional [m]
        Size of a pixel on the board, for photographs.

    Raises
    ------
    ConfigError
        If `model.effects` or `diagnosis.exclude` names something unknown.
    """
    experiment, options = config.experiment, config.model
    cable = Cable(
        length=config.cable.length,
        mass=config.cable.mass,
        diameter=config.cable.diameter,
        bending_stiffness=config.cable.prior_bending_stiffness,
        name=config.cable.name,
        straight=config.cable.rest_shape == "straight",
    )
    coefficients = config.estimation.rest_curvature_coefficients or REST_COEFFICIENTS
    model = CableModel(
        cable=cable,
        n=options.n or MESH,
        element=options.element,
        start=experiment.boundary.start,
        end=experiment.boundary.end,
        gravity=(float(experiment.gravity[0]), float(experiment.gravity[1])),
        n_rest=max(coefficients, 4),
    )
    values: dict[str, float] = {}
    fixed: list[str] = []
    for item in options.effects:
        _check_name(item.name, "model.effects", config)
        if item.name == "standoff_error" and not _camera(config):
            raise ConfigError(
                "model.effects: standoff_error is a shift along the rays of a calibrated camera, "
                "and none is declared. Try: measurement.camera, or image_scale",
                config.path,
            )
        effect = make_effect(item.name, model, center)
        model = model.with_effect(effect)
        known = [q.name for q in effect.parameters(cable)]
        for name, parameter in item.parameters.items():
            if name not in known:
                raise ConfigError(
                    f"model.effects: {item.name} has no parameter {name!r}; it has "
                    f"{', '.join(known)}",
                    config.path,
                )
            values[f"{item.name}.{name}"] = parameter.value
            if parameter.fixed:
                fixed.append(f"{item.name}.{name}")
    for name in config.diagnosis.exclude:
        _check_name(name, "diagnosis.exclude", config)
    declared = experiment.tolerances
    tolerances = Tolerances(declared.length, declared.end, declared.heading, declared.scale)
    return Declared(nuisances(model, tolerances, pixel), values, tuple(fixed), tolerances)


def _camera(config: Config) -> bool:
    """Whether it can be told from the photographs where the camera stood."""
    measurement = config.experiment.measurement
    if measurement.kind != "images" or measurement.board is None:
        return False
    return measurement.camera is not None


def _check_name(name: str, where: str, config: Config) -> None:
    if (wrong := unknown_effect(name)) is not None:
        raise ConfigError(f"{where}: {wrong}", config.path)


def straight(model: CableModel) -> CableModel:
    """Return the model without rest curvature and without effects."""
    return replace(model, cable=replace(model.cable, straight=True), effects=(), priors={})
