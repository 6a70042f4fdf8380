"""The text of parameters.yaml: a fitted cable, complete enough to compute with."""

import hashlib
from collections.abc import Sequence
from dataclasses import fields
from pathlib import Path
from typing import Any

from dlo_casadi.arrays import FloatArray
from dlo_casadi.config import Config, dump_yaml
from dlo_casadi.effects import Effect, known_effect
from dlo_casadi.equilibrium.fitted_cable import FittedCable
from dlo_casadi.errors import DloError
from dlo_casadi.estimation.result import Fit, uncertainty_of
from dlo_casadi.io.parameters import SCHEMA, metadata_of, parameters_hash
from dlo_casadi.model.cable_model import STIFFNESSES
from dlo_casadi.report.json_report import fields_of, finite
from dlo_casadi.session.outcome import Outcome


def parameters_text(outcome: Outcome) -> str:
    """The text of parameters.yaml: equal results, equal bytes."""
    head = (
        f"# {outcome.config.cable.name}: parameters fitted by dlo_casadi. SI units: m, kg, s, N, "
        "rad.\n# null: a bound or an end of an interval that does not exist. fitted: false: as "
        "declared.\n"
    )
    return head + dump_yaml(parameters_dict(outcome))


def parameters_of(outcome: Outcome) -> FittedCable:
    """The fitted cable of a run, as `load_parameters` would read it from the run's file."""
    fit, metadata = outcome.fit, metadata_of(parameters_dict(outcome), outcome.config.path)
    return FittedCable(fit.model, fit.p, final_rest(fit), metadata)


def parameters_dict(outcome: Outcome) -> dict[str, Any]:
    """Everything that parameters.yaml holds, as plain data."""
    config = outcome.config
    document = fit_dict(outcome.fit)
    for name in STIFFNESSES:
        stiffness = outcome.stages[-1].parameters.get(name)
        if stiffness is not None:
            document["parameters"][name] |= {
                "interval_95": finite(stiffness.interval_95),
                "identifiable": stiffness.identifiable,
            }
    if config.cable.youngs_modulus is not None:
        document["cable"]["youngs_modulus"] = config.cable.youngs_modulus
    document["fixtures"] = shared_fixtures(config)
    document["model_hash"] = parameters_hash(document)
    document["config"] = config.name
    document["config_hash"] = _file_hash(config.path)
    document["versions"] = dict(outcome.versions)
    return document


def fit_dict(fit: Fit) -> dict[str, Any]:
    """What a fit alone tells: the model, its parameters, covariance and state."""
    model = fit.model
    names, covariance = fit.named_covariance
    uncertainty = uncertainty_of(fit)
    document: dict[str, Any] = {
        "schema": SCHEMA,
        "cable": {
            **fields_of(model.cable, "name", "length", "mass", "diameter"),
            **fields_of(
                model.cable, "bending_stiffness", *["torsional_stiffness"] * model.in_space
            ),
            "rest_shape": "straight" if model.cable.straight else "curved",
        },
        "boundary": {"start": model.start, "end": model.end},
        "gravity": list(model.gravity),
        **fields_of(model, "element", "n", "n_rest"),
        "effects": [_effect_row(effect) for effect in model.effects],
        "parameters": {
            q.name: {
                "value": float(value),
                "std": fit.std(q.name),
                **fields_of(q, "unit", "lower", "upper"),
                "fitted": q.name in names,
                # Standard deviation of the prior of what is known within a tolerance.
                "tolerance": model.priors.get(q.name),
            }
            for q, value in zip(model.parameters, fit.p, strict=True)
        },
        "rest_curvature": {
            "coefficients": _by_name(fit.coefficients, model.node.curvatures),
            "unit": "1/m",
            "basis": "cubic B-splines on clamped uniform knots over [0, length]",
        },
        "state": {
            "rest_curvature": _by_name(final_rest(fit), model.node.strains),
            "unit": "1/m",
            "of": "cells, last pose done",
        },
        "covariance": {"names": list(names), "values": covariance},
        "scatter": {
            "fixtures": dict(uncertainty.scatter),
            "rest_curvature_std": uncertainty.rest_scatter.std,
            "rest_curvature_smoothness": uncertainty.rest_scatter.smoothness,
            "hanging": uncertainty.hanging,
        },
    }
    plain: dict[str, Any] = finite(document)
    return plain


def final_rest(fit: Fit) -> FloatArray:
    """Rest curvature (n_rests,) [1/m] that the session's last pose leaves behind."""
    if not fit.model.has_state:
        return fit.rest
    return fit.problem.equilibria.rest_after_last(fit.point.shapes, fit.p, fit.rest)


def _by_name(values: FloatArray, names: Sequence[str]) -> Any:
    """Curvatures as they are in a plane; in space components of the strain by their names."""
    if len(names) == 1:
        return values
    return dict(zip(names, values.reshape(len(names), -1), strict=True))


def _effect_row(effect: Effect) -> dict[str, Any]:
    """Name and label of an effect, and what else it was made with."""
    if known_effect(effect.name) is not type(effect):
        raise DloError(f"the effect {effect.name!r} cannot be written to parameters.yaml")
    options = (item.name for item in fields(effect) if item.name != "label")
    return fields_of(effect, "name", "label", *options)


def shared_fixtures(config: Config) -> dict[str, Any]:
    """What all poses share of their start and of the directions of clamps."""
    shared: dict[str, Any] = {}
    direction = "orientation" if config.experiment.in_space else "heading"
    for key in ("start", f"start_{direction}", f"end_{direction}"):
        values = {getattr(pose, key) for pose in config.experiment.poses}
        shared[key] = finite(values.pop()) if len(values) == 1 else None
    return shared


def _file_hash(path: Path) -> str | None:
    try:
        return hashlib.sha256(path.read_bytes()).hexdigest()
    except OSError:
        return None
