"""Small right inputs, from which the wrong ones are made."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from dlo_casadi.config import dump_yaml, load_config, read_yaml
from dlo_casadi.report.documents import parameters_text
from dlo_casadi.session import run_session

BENCH = Path(__file__).resolve().parents[2] / "tests" / "data" / "bench"
CONFIG = "session.yaml"
# One point of so many is kept of a centre-line.
_THINNED = 12
# Elements: what is looked for is a message, not a shape.
_MESH = 6


@dataclass(frozen=True)
class Session:
    """A configuration as plain data, and the files that it names."""

    document: dict[str, Any]
    files: dict[str, bytes]

    def write(self, folder: Path) -> Path:
        """Write all files; return the configuration's."""
        for name, content in self.files.items():
            (folder / name).write_bytes(content)
        path = folder / CONFIG
        path.write_text(dump_yaml(self.document), encoding="utf-8")
        return path


def centerline_session(name: str, poses: int, **model: Any) -> Session:
    """The first poses of a bench session with CSV centre-lines, every option written out."""
    document = read_yaml(BENCH / name / CONFIG)
    experiment = document["experiment"]
    chosen = [pose for pose in experiment["poses"] if pose["role"] == "fit"][:poses]
    experiment["poses"] = chosen
    experiment["measurement"]["std"] = 3.0e-4
    experiment["tolerances"] = {"length": 5e-4, "end": 2e-4, "heading": 1e-2, "scale": 3e-4}
    document["model"] = {"n": _MESH, "element": "quadratic", **model}
    document["estimation"] = {
        "algorithm1": False,
        "algorithm1_n": 4,
        "algorithm1_inner": "ipopt",
        "robust": False,
        "plausibility": True,
        "rest_curvature_coefficients": 4,
    }
    document["diagnosis"] = {
        "enabled": False,
        "exclude": ["point_force"],
        "significance": 0.005,
        "max_effects": 1,
    }
    files = {}
    for pose in chosen:
        head, *lines = (BENCH / name / pose["file"]).read_text().splitlines()
        files[pose["file"]] = ("\n".join([head, *lines[::_THINNED]]) + "\n").encode()
    return Session(document, files)


def photograph_session(with_board: bool) -> Session:
    """One drawn photograph of a cable of 0.5 m, with a board or two known points."""
    pixels_per_metre, (width, height) = 400.0, (320, 240)
    origin = np.array([60.0, 80.0])  # px, of the start
    s = np.linspace(0.0, 1.0, 60)
    line = np.column_stack([0.4 * s, -0.14 * 4 * s * (1 - s)])  # m; 0.5 m long
    drawn = origin + line * [pixels_per_metre, -pixels_per_metre]
    picture = np.full((height, width, 3), 235, np.uint8)
    cv2.polylines(picture, [drawn.round().astype(np.int32)], False, (30, 30, 30), 5, cv2.LINE_AA)
    measurement: dict[str, Any] = {"kind": "images", "std": 3.0e-4}
    if with_board:
        dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)
        corners = [(6, 6), (274, 6), (274, 194), (6, 194)]
        size = 40
        centers = {}
        for k, (u, v) in enumerate(corners):
            marker = cv2.aruco.generateImageMarker(dictionary, k, size)
            picture[v : v + size, u : u + size] = marker[..., None]
            middle = np.array([u, v]) + (size - 1) / 2
            centers[k] = ((middle - origin) / [pixels_per_metre, -pixels_per_metre]).tolist()
        measurement["board"] = {
            "dictionary": "DICT_4X4_50",
            "marker_size": size / pixels_per_metre,
            "standoff": 0.0,
            "marker_centers": centers,
        }
        measurement["camera"] = {
            "matrix": [[400.0, 0.0, 160.0], [0.0, 400.0, 120.0], [0.0, 0.0, 1.0]],
            "distortion": [0.0, 0.0, 0.0, 0.0, 0.0],
        }
    else:
        measurement["reference"] = {
            "pixels": drawn[[0, -1]].tolist(),
            "points": line[[0, -1]].tolist(),
        }
    length = float(np.linalg.norm(np.diff(line, axis=0), axis=1).sum())
    document = {
        "cable": {
            "name": "drawn",
            "length": length,
            "mass": 0.1,
            "diameter": 5 / pixels_per_metre,
            "bending_stiffness": 0.05,
        },
        "experiment": {
            "gravity": [0.0, -9.81],
            "boundary": {"start": "pinned", "end": "pinned"},
            "measurement": measurement,
            "poses": [
                {"file": "pose_01.png", "start": [0.0, 0.0], "end": line[-1].tolist()},
            ],
        },
    }
    return Session(document, {"pose_01.png": cv2.imencode(".png", picture)[1].tobytes()})


@dataclass(frozen=True)
class Bases:
    """All that is changed: sessions to check, small ones to fit, fitted cables to predict with."""

    sessions: tuple[Session, ...]
    photographs: tuple[Session, ...]
    small: tuple[Session, ...]
    parameters: tuple[dict[str, Any], ...]


def make_bases(folder: Path) -> Bases:
    """Make them; the fits take some seconds."""
    effects = [
        {"name": "lumped_mass", "parameters": {"mass": 0.02, "position": 0.2}},
        {"name": "image_distortion", "parameters": {"coefficient": {"value": 0.0, "fixed": True}}},
    ]
    pinned = centerline_session("short_clean", 3, effects=effects)
    held = centerline_session("held_headings", 3, effects=["stiff_section"])
    free = centerline_session("overhang", 2, effects=["end_spring", "rest_curvature_drift"])
    small = (
        centerline_session("short_clean", 2, effects=effects[:1]),
        centerline_session("overhang", 2, element="arc"),
    )
    parameters = []
    for k, session in enumerate(small):
        place = folder / str(k)
        place.mkdir()
        config = load_config(session.write(place))
        quick = config.estimation.model_copy(update={"plausibility": False})
        outcome = run_session(config.model_copy(update={"estimation": quick}))
        (place / "parameters.yaml").write_text(parameters_text(outcome), encoding="utf-8")
        parameters.append(read_yaml(place / "parameters.yaml"))
    return Bases(
        (pinned, held, free),
        (photograph_session(False), photograph_session(True)),
        small,
        tuple(parameters),
    )
