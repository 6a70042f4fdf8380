"""parameters.yaml: its name, schema and hash, and a cable that is written as one."""

import hashlib
import json
from collections.abc import Mapping
from os import PathLike
from pathlib import Path
from typing import Any

from dlo_casadi.config import dump_yaml
from dlo_casadi.errors import DloError
from dlo_casadi.io.files import is_marked, make_folder, refuse_foreign, write_file
from dlo_casadi.model.cable_model import CableModel

FILE = "parameters.yaml"
SCHEMA = "dlo-parameters/1"
# Keys on which a prediction depends, besides the values of the parameters.
_MODEL_KEYS = ("cable", "boundary", "gravity", "element", "n", "n_rest", "effects", "state")


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
