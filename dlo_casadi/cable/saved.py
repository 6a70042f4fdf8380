"""parameters.yaml: its name, schema and hash, and a cable that is written as one."""

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np

from dlo_casadi.arrays import FloatArray
from dlo_casadi.config import dump_yaml
from dlo_casadi.effects import Effect, known_effect
from dlo_casadi.equilibrium.spread import Uncertainty
from dlo_casadi.errors import DloError
from dlo_casadi.io.files import finite, is_marked, make_folder, refuse_foreign, write_file
from dlo_casadi.model.cable_model import DAMPING_TIME, STIFFNESSES, CableModel

FILE = "parameters.yaml"
SCHEMA = "dlo-parameters/1"
# Keys on which a prediction depends, besides the values of the parameters.
_MODEL_KEYS = ("cable", "boundary", "gravity", "element", "n", "n_rest", "effects", "state")
# Keys of the cable itself.
_OF_CABLE = ("name", "length", "mass", "diameter")


def parameters_hash(document: Mapping[str, Any]) -> str:
    """SHA-256 of everything that determines predictions, without bounds and standard deviations.

    The file has it as `model_hash`. A generated solver has a separate hash: `codegen.solver_hash`.
    """
    content = {key: document.get(key) for key in _MODEL_KEYS}
    content["values"] = {key: row["value"] for key, row in document["parameters"].items()}
    content["coefficients"] = document["rest_curvature"]["coefficients"]
    # 1 and 1.0 are the same model; keys that are not read may hold what JSON lacks, such as dates.
    plain = json.dumps(content, default=str, skipkeys=True)
    text = json.dumps(json.loads(plain, parse_int=float), sort_keys=True, separators=(",", ":"))
    return hashlib.sha256(text.encode()).hexdigest()


def write_parameters(
    document: Mapping[str, Any], model: CableModel, path: str | PathLike[str]
) -> Path:
    """See `FittedCable.save`; `document` is that of the cable, `model` may have another mesh."""
    if not isinstance(path, str | PathLike):
        raise DloError(f"path: a path belongs here, found {path!r}")
    if model.clips:
        raise DloError(
            "clips are of a pose, and no part of a saved cable.\n  Try: cable.with_clips(()).save"
            "(...), and clips where it is solved"
        )
    data = dict(document)
    if (data["n"], data["element"]) != (model.n, model.element):
        # The state is that of another mesh's cells; the coefficients say the same.
        data |= {"n": model.n, "element": model.element, "state": None}
        data["model_hash"] = parameters_hash(data)
    target = Path(path)
    target = target if target.suffix in (".yaml", ".yml") else target / FILE
    make_folder(target.parent)
    refuse_foreign(target.parent, [] if is_marked(target, SCHEMA) else [target.name])
    write_file(target, dump_yaml(data))
    return target


def cable_document(
    model: CableModel,
    p: FloatArray,
    coefficients: FloatArray,
    rest: FloatArray,
    uncertainty: Uncertainty,
) -> dict[str, Any]:
    """The model of a cable, its values and their uncertainty."""
    names, covariance = uncertainty.names, uncertainty.covariance
    stds = dict(zip(names, np.sqrt(np.maximum(np.diag(covariance), 0.0)).tolist(), strict=True))
    damped = [DAMPING_TIME] if model.cable.damping_time is not None else []
    stiff = STIFFNESSES[: 1 + model.in_space]
    document: dict[str, Any] = {
        "schema": SCHEMA,
        "cable": {
            **{name: getattr(model.cable, name) for name in (*_OF_CABLE, *stiff, *damped)},
            "rest_shape": "straight" if model.cable.straight else "curved",
        },
        "boundary": {"start": str(model.start), "end": str(model.end)},
        "gravity": list(model.gravity),
        **{name: getattr(model, name) for name in ("element", "n", "n_rest")},
        "effects": [_effect_row(effect) for effect in model.effects],
        "parameters": {
            q.name: {
                "value": float(value),
                "std": stds.get(q.name, 0.0),
                "unit": q.unit,
                **dict(zip(("lower", "upper"), q.bounds(estimated=q.name in names), strict=True)),
                "fitted": q.name in names,
                # Prior standard deviation of a nuisance parameter, from its tolerance.
                "tolerance": model.priors.get(q.name),
            }
            for q, value in zip(model.parameters, p, strict=True)
        },
        "rest_curvature": {
            "coefficients": _by_name(coefficients, model.node.curvatures),
            "unit": "1/m",
            "basis": "cubic B-splines on clamped uniform knots over [0, length]",
        },
        "state": {
            "rest_curvature": _by_name(rest, model.node.strains),
            "unit": "1/m",
            "of": "cells, last pose done",
        },
        "covariance": {"names": list(names), "values": covariance},
        "scatter": {
            "fixtures": dict(uncertainty.scatter),
            "rest_curvature_std": uncertainty.pose_scatter.rest_std,
            "rest_curvature_smoothness": uncertainty.pose_scatter.smoothness,
            "from_pose_to_pose": {
                "source": uncertainty.pose_scatter.source,
                "std": uncertainty.pose_scatter.size(model, float(p[0]))[0],
            },
            "hanging": uncertainty.repeat_std,
        },
    }
    return dict(finite(document))


def _by_name(values: FloatArray, names: Sequence[str]) -> Any:
    """Curvatures: in the plane as they are, in space by the names of the strain components."""
    if len(names) == 1:
        return values
    return dict(zip(names, values.reshape(len(names), -1), strict=True))


def _effect_row(effect: Effect) -> dict[str, Any]:
    """Name and label of an effect, and its other arguments."""
    if known_effect(effect.name) is not type(effect):
        raise DloError(f"the effect {effect.name!r} cannot be written to parameters.yaml")
    return {"name": effect.name, **asdict(effect)}
