"""parameters.yaml: a fitted cable, complete enough to compute with (schema "dlo-parameters/1").

Prediction, code generation and comparisons of cables read nothing else. Its text is made in
`report.parameters_text`.
"""

from __future__ import annotations

import difflib
import hashlib
import json
import math
import os
from collections.abc import Mapping, Sequence
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dlo_casadi.config import (
    MESH,
    REST_COEFFICIENTS,
    Place,
    Range,
    implausible_gravity,
    implausible_sizes,
    read_document,
    show,
)
from dlo_casadi.effects import EFFECTS, NUISANCES, Cable, Effect, known_effect
from dlo_casadi.effects.cable import Parameter
from dlo_casadi.equilibrium.fitted_cable import FittedCable, Metadata
from dlo_casadi.equilibrium.spread import Uncertainty
from dlo_casadi.errors import ConfigError, DloError, counted
from dlo_casadi.model.cable_model import CableModel
from dlo_casadi.model.rest_curvature import RestScatter
from dlo_casadi.rod.chain import ELEMENTS
from dlo_casadi.rod.node import Frame

FloatArray = NDArray[np.floating]
FILE = "parameters.yaml"
SCHEMA = "dlo-parameters/1"
# What a prediction depends on beside the values of the parameters.
_MODEL_KEYS = ("cable", "boundary", "gravity", "element", "n", "n_rest", "effects", "state")
# A value at a bound may miss it by so much of the bound, or of the parameter's scale: rounding of
# value = nominal + scale x, or exp(x), some 1e-14; and what solvers leave of a bound.
_ROUNDING = 1e-9
# Folders of results that a message lists.
_LISTED = 5


class _DamagedError(DloError):
    """What is wrong in a file, and where."""

    def __init__(self, place: Place, message: str) -> None:
        super().__init__(f"{'.'.join(map(str, place))}{message}")
        self.place = place


def load_parameters(path: str | Path) -> FittedCable:
    """Read parameters.yaml and rebuild the model exactly.

    Parameters
    ----------
    path : str or Path
        The file, or the folder of results that holds it.

    Returns
    -------
    (model, p, rest, metadata)
        See `FittedCable`.

    Raises
    ------
    ConfigError
        If the file is no parameters.yaml of this schema, or if a value in it lies outside of its
        bounds; the message names the key.
    """
    source = Path(path)
    if os.path.isdir(source):
        source = source / FILE
        if not source.is_file():
            raise ConfigError(f"no {FILE} in this folder.{_results_near(source)}", source.parent)
    elif not os.path.exists(source):
        raise ConfigError(f"no such file or folder of results.{_results_near(source)}", source)
    file = read_document(source)
    document = file.data
    if not isinstance(document, dict) or document.get("schema") != SCHEMA:
        found = document.get("schema") if isinstance(document, dict) else type(document).__name__
        raise ConfigError(
            f"no fitted parameters: schema {SCHEMA!r} expected, {found!r} found.\n"
            "  Try: the parameters.yaml in the results folder of a fit.",
            source,
        )
    line = None
    try:
        return _rebuild(document, source)
    except _DamagedError as error:
        wrong, line = error.message, file.line(error.place)
    except DloError as error:
        wrong = error.message
    except KeyError as error:
        wrong = f"{error.args[0]} is missing"
    except (TypeError, ValueError, AttributeError, IndexError, OverflowError) as error:
        wrong = str(error)
    raise ConfigError(
        f"damaged parameters: {wrong}.\n  Try: the file as a fit has written it.", source, line
    )


def _results_near(path: Path) -> str:
    """What to try instead of a path: folders of results beside it, the nearest name first."""
    wanted = path.parent if path.suffix else path
    known = {
        folder.name: folder
        for base in (wanted.parent / "results", wanted.parent)
        for folder in sorted(base.glob("*"))
        if (folder / FILE).is_file()
    }
    names = difflib.get_close_matches(wanted.name, known, 1) or list(known)[:_LISTED]
    listed = ", ".join(str(known[name]) for name in names)
    return f"\n  Try: {listed}" if listed else "\n  Try: the results folder of a fit (dlo fit)."


def _rebuild(document: dict[str, Any], source: Path) -> FittedCable:
    declared, rows = document["cable"], document["parameters"]
    cable = Cable(
        length=_positive(declared, "cable", "length"),
        mass=_positive(declared, "cable", "mass"),
        diameter=_positive(declared, "cable", "diameter"),
        bending_stiffness=_positive(declared, "cable", "bending_stiffness"),
        name=str(declared["name"]),
        straight=declared["rest_shape"] == "straight",
    )
    for place, message in implausible_sizes(
        cable.length, cable.mass, cable.diameter, cable.bending_stiffness
    ):
        raise _DamagedError(("cable", *place), f": {message}")
    in_space = len(document["gravity"]) == 3
    if in_space:
        torsional = _positive(declared, "cable", "torsional_stiffness")
        cable = replace(cable, torsional_stiffness=torsional)
    gravity = tuple(_numbers(document["gravity"], 3 if in_space else 2, "gravity").tolist())
    for place, message in implausible_gravity(gravity):
        raise _DamagedError(place, f": {message}")
    boundary = document["boundary"]
    tolerances = {name: row.get("tolerance") for name, row in rows.items()}
    model = CableModel(
        cable=cable,
        n=_count(document, "n", MESH),
        element=_one_of(document["element"], tuple(ELEMENTS), "element"),
        start=_one_of(boundary["start"], ("pinned", "clamped"), "boundary", "start"),
        end=_one_of(boundary["end"], ("pinned", "clamped", "free"), "boundary", "end"),
        gravity=gravity,
        effects=tuple(_effect(row, k) for k, row in enumerate(document["effects"])),
        n_rest=_count(document, "n_rest", REST_COEFFICIENTS),
        priors={name: float(std) for name, std in tolerances.items() if std is not None},
    )
    if set(rows) != set(model.names):
        wrong = ", ".join(sorted(set(rows) ^ set(model.names)))
        raise DloError(f"parameters and effects do not belong together: {wrong}")
    values = [_within_bounds(q, rows[q.name]) for q in model.parameters]
    metadata = metadata_of(document, source)
    if len(metadata.coefficients) != model.n_coefficients:
        count = len(metadata.coefficients)
        found = f": {counted(model.n_coefficients, 'number')} belong here, found {count}"
        raise _DamagedError(("rest_curvature",), found)
    coefficients = [f"rest_curvature[{k}]" for k in range(model.n_coefficients)]
    for name in metadata.names:
        if name not in (*model.names, *coefficients):
            raise _DamagedError(("covariance", "names"), f": nothing is called {show(name)}")
    rest = _stacked(document["state"]["rest_curvature"], Frame.strains, "state")
    return FittedCable(
        model,
        _numbers(values, len(values), "parameters"),
        _numbers(rest, model.chain.n_rests, "state", "rest_curvature"),
        metadata,
    )


def metadata_of(document: dict[str, Any], source: Path) -> Metadata:
    """What a document tells beside the model."""
    rows = document["parameters"]
    names = tuple(document["covariance"]["names"])
    rows_of = np.array(document["covariance"]["values"], dtype=float)
    covariance = _numbers(rows_of.ravel(), len(names) ** 2, "covariance", "values")
    covariance = covariance.reshape(len(names), len(names))
    interval = rows["bending_stiffness"].get("interval_95")
    scatter = document.get("scatter") or {}
    rest_scatter = RestScatter(
        float(scatter.get("rest_curvature_std", 0.0)),
        float(scatter.get("rest_curvature_smoothness", RestScatter().smoothness)),
    )
    hanging = float(scatter.get("hanging", 0.0))
    fixtures = {name: float(std or 0.0) for name, std in scatter.get("fixtures", {}).items()}
    return Metadata(
        path=source,
        names=names,
        covariance=covariance,
        uncertainty=Uncertainty(names, covariance, fixtures, rest_scatter, hanging),
        std={name: float(row.get("std") or 0.0) for name, row in rows.items()},
        coefficients=_stacked(
            document["rest_curvature"]["coefficients"], Frame.curvatures, "rest_curvature"
        ),
        fixtures=dict(document.get("fixtures") or {}),
        identifiable=rows["bending_stiffness"].get("identifiable"),
        interval_95=None if interval is None else (interval[0], interval[1]),
        model_hash=str(document["model_hash"]),
        edited=parameters_hash(document) != document["model_hash"],
        config=str(document.get("config")),
        versions=dict(document.get("versions") or {}),
        document=document,
    )


def _stacked(values: Any, names: Sequence[str], where: str) -> FloatArray:
    """Numbers as they are in a plane; in space those of all components one after the other."""
    if isinstance(values, Mapping):
        values = [value for name in names for value in values[name]]
    return _numbers(values, len(values), where)


def _effect(row: Mapping[str, Any], k: int) -> Effect:
    name = row["name"]
    kind = known_effect(name)
    if kind is None:
        known = ", ".join((*EFFECTS, *NUISANCES))
        raise _DamagedError(("effects", k), f": no effect is called {name!r}; known: {known}")
    kinds = {item.name: item.default for item in fields(kind)}
    options: dict[str, Any] = {}
    for key, value in row.items():
        if key == "name":
            continue
        if key not in kinds:
            raise _DamagedError(("effects", k, key), f": {name} knows {', '.join(kinds)}")
        options[key] = tuple(value) if isinstance(value, list) else value
        if not _is_like(options[key], kinds[key]):
            raise _DamagedError(
                ("effects", k, key),
                f": something like {kinds[key]!r} belongs here, found {show(value)}",
            )
    return kind(**options)


def _is_like(value: Any, example: Any) -> bool:
    """Whether an effect's option is of the kind of its default; numbers are finite."""
    if isinstance(example, tuple):
        return (
            isinstance(value, tuple)
            and len(value) == len(example)
            and all(_is_like(*pair) for pair in zip(value, example, strict=True))
        )
    if isinstance(example, float):
        return _is_number(value) and math.isfinite(value)
    return isinstance(value, type(example))


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def _positive(section: Mapping[str, Any], where: str, key: str) -> float:
    value = section[key]
    if not _is_number(value) or not 0 < value < math.inf:
        raise _DamagedError((where, key), f" must be a positive number, found {show(value)}")
    return float(value)


def _count(document: Mapping[str, Any], key: str, allowed: Range) -> int:
    value = document[key]
    if not _is_number(value) or value not in allowed or value != int(value):
        raise _DamagedError((key,), f" must be a whole number, found {show(value)}: {allowed}")
    return int(value)


def _within_bounds(q: Parameter, row: Mapping[str, Any]) -> float:
    """Value of a parameter, within the bounds of the file and of the model."""
    value, place = row["value"], ("parameters", q.name, "value")
    if not _is_number(value) or not math.isfinite(value):
        raise _DamagedError(place, f" must be finite, found {show(value)}")
    lower = max(q.lower, -math.inf if row.get("lower") is None else float(row["lower"]))
    upper = min(q.upper, math.inf if row.get("upper") is None else float(row["upper"]))
    beyond = max(lower - value, value - upper)
    bound = lower if lower > value else upper
    if (q.log and value <= 0) or beyond > _ROUNDING * max(q.scale, abs(bound)):
        raise _DamagedError(
            place,
            f": {value:.12g} {q.unit} lies outside of its bounds [{lower:.12g}, {upper:.12g}]",
        )
    return float(value)


def _numbers(values: ArrayLike, size: int, *where: str) -> FloatArray:
    array = np.array(values, dtype=float)
    if array.shape != (size,):
        raise _DamagedError(where, f": {counted(size, 'number')} belong here, found {array.size}")
    if not np.all(np.isfinite(array)):
        raise _DamagedError(where, ": all numbers must be finite")
    return array


def _one_of(value: Any, allowed: tuple[str, ...], *where: str) -> Any:
    if value not in allowed:
        raise _DamagedError(where, f" must be {' or '.join(allowed)}, found {show(value)}")
    return value


def parameters_hash(document: Mapping[str, Any]) -> str:
    """SHA-256 of what determines predictions; bounds and standard deviations do not.

    It stands in the file as `model_hash`. A generated solver has its own: `codegen.solver_hash`.
    """
    content = {key: document[key] for key in _MODEL_KEYS}
    content["values"] = {key: row["value"] for key, row in document["parameters"].items()}
    content["coefficients"] = document["rest_curvature"]["coefficients"]
    text = json.dumps(_as_floats(content), sort_keys=True, separators=(",", ":"))
    return hashlib.sha256(text.encode()).hexdigest()


def _as_floats(data: Any) -> Any:
    """Every number as a float: 1 and 1.0 are the same model."""
    if isinstance(data, Mapping):
        return {str(key): _as_floats(value) for key, value in data.items()}
    if isinstance(data, list | tuple):
        return [_as_floats(value) for value in data]
    if isinstance(data, int) and not isinstance(data, bool):
        return float(data)
    return data
