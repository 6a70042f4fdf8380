"""The declared model of a configuration: cable, boundary, effects, and tolerances as nuisances."""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace

import numpy as np
from numpy.typing import NDArray

from dlo_casadi.config import Config, declared_setup, wrong_effects
from dlo_casadi.diagnosis.candidates import setup_of
from dlo_casadi.effects import EFFECTS, NUISANCES, UNKNOWN_MASS
from dlo_casadi.errors import ConfigError
from dlo_casadi.model.cable_model import END_ROLL, CableModel, Tolerances

# Elements of the declared model's mesh; refined from the data.
MESH = 40
REST_COEFFICIENTS = 13


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


def nuisances(
    model: CableModel,
    tolerances: Tolerances,
    pixel: float | None = None,
    readings: tuple[str, ...] = (),
) -> CableModel:
    """Return the model with what is known of its effects before any shape as nuisances.

    What lies within a declared tolerance gets a Gaussian prior with the tolerance as standard
    deviation; photographs with pixels of the size `pixel` [m] also a bias of edges, `readings` one
    of their sensors.
    """
    setup = setup_of(model, tolerances=asdict(tolerances), pixel=pixel, readings=readings)
    present = {effect.label for effect in model.effects}
    for kind in (*EFFECTS.values(), *NUISANCES.values()):
        if kind.name in present or not kind.applies(setup):
            continue
        effect = kind.made_for(setup)
        priors = {f"{effect.label}.{name}": std for name, std in effect.prior(setup).items()}
        model = model.with_effect(effect, priors) if priors else model
    return model


def declared_model(
    config: Config,
    center: tuple[float, float] | None = None,
    pixel: float | None = None,
) -> Declared:
    """Build the declared model.

    Parameters
    ----------
    center : (float, float), optional [m]
        Middle of the photographs in the board frame.
    pixel : float, optional [m]
        Size of a pixel on the board, for photographs.

    Raises
    ------
    ConfigError
        If a configuration that was changed since it was loaded names effects that cannot be.
    """
    if problems := wrong_effects(config):
        raise ConfigError("; ".join(problem.message for problem in problems), config.path)
    setup = replace(declared_setup(config), center=center)
    experiment, options = config.experiment, config.model
    coefficients = config.estimation.rest_curvature_coefficients
    model = CableModel(
        cable=setup.cable,
        n=options.n or MESH,
        element=options.element,
        start=experiment.boundary.start,
        end=experiment.boundary.end,
        gravity=experiment.gravity,
        n_rest=REST_COEFFICIENTS if coefficients is None else coefficients,
    )
    if END_ROLL in model.names:
        model = replace(model, priors={END_ROLL: experiment.tolerances.roll})
    values: dict[str, float] = {}
    fixed: list[str] = []
    for item in options.effects:
        model = model.with_effect(EFFECTS[item.name].made_for(setup))
        for name, parameter in item.parameters.items():
            values[f"{item.name}.{name}"] = parameter.value
            if parameter.fixed:
                fixed.append(f"{item.name}.{name}")
    if config.cable.mass is None:
        model = model.with_effect(UNKNOWN_MASS())
    tolerances = Tolerances(**setup.tolerances)
    model = nuisances(model, tolerances, pixel, setup.readings)
    return Declared(model, values, tuple(fixed), tolerances)


def straight(model: CableModel) -> CableModel:
    """Return the model without rest curvature and without effects."""
    return replace(model, cable=replace(model.cable, straight=True), effects=(), priors={})
