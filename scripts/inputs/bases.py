"""Small right inputs, from which the wrong ones are made."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from dlo_casadi.config import dump_yaml, load_config, read_yaml
from dlo_casadi.estimation.prediction import predict_poses
from dlo_casadi.report.documents import parameters_text
from dlo_casadi.session import run_session
from dlo_casadi.session.fitting import declared_model
from dlo_casadi.session.measure import measured_poses, read_inputs

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


def obstructed_session(folder: Path, in_space: bool) -> Session:
    """A pose of a cable through clips and over obstacles, with limits; its shape as predicted."""

    def place(x: float, height: float) -> list[float]:
        return [x, 0.0, height] if in_space else [x, height]

    # Quarter turns about the y axis: out of the ground, and into it.
    up, down = ([0.0, 0.5**0.5 * sign, 0.0, 0.5**0.5] for sign in (-1.0, 1.0))
    directions = (
        ({"start_orientation": up, "end_orientation": down, "turns": 0}) if in_space else {}
    )
    pose = {
        "file": "pose_01.csv",
        "start": place(0.0, 0.0),
        "end": place(0.27, 0.02),
        **directions,
        "clips": [
            {"name": "first", "kind": "pinned", "at": 0.12, "place": place(0.07, 0.09)},
            {"kind": "eyelet", "place": place(0.2, 0.09)},
        ],
        "role": "fit",
    }
    kind = "clamped" if in_space else "pinned"
    plane = {"kind": "plane", "point": place(0.0, -0.05), "normal": place(0.0, 1.0)}
    bar = {"kind": "capsule", "a": place(0.3, 0.15), "b": place(0.4, 0.2), "radius": 0.01}
    document = {
        "cable": {
            "name": "obstructed",
            "length": 0.45,
            "mass": 0.03,
            "diameter": 0.005,
            "bending_stiffness": 0.01,
            **({"torsional_stiffness": 0.008} if in_space else {}),
        },
        "experiment": {
            "gravity": place(0.0, -9.81),
            "boundary": {"start": kind, "end": kind},
            "measurement": {"kind": "centerlines", "std": 3.0e-4},
            "tolerances": {"clip": 1e-3, "slip": 1e-3, "obstacle": 5e-4},
            "obstacles": [{"name": "table", **plane}, {"name": "bar", **bar}],
            "poses": [pose],
        },
        "model": {"n": _MESH},
        "estimation": {"plausibility": False},
        "diagnosis": {"enabled": False},
        "limits": {"bend_radius": 0.02, "force": 8.0},
    }
    header = "x_m,y_m,z_m" if in_space else "x_m,y_m"
    straight = np.array([place(x, 0.0) for x in (0.1, 0.2)])
    drawn = Session(document, {"pose_01.csv": _lines(header, straight)})
    config = load_config(drawn.write(folder))
    model, inputs = declared_model(config).model, read_inputs(config, lambda *_: None)
    held = [item.pose for item in measured_poses(config, inputs)]
    (shape,) = predict_poses(model, model.nominal, np.zeros(model.chain.n_rests), held)
    points = shape.curve.at(np.linspace(0.02, 0.43, 12))
    return Session(document, {"pose_01.csv": _lines(header, points)})


def _lines(header: str, points: np.ndarray) -> bytes:
    rows = (",".join(f"{x:.6f}" for x in point) for point in points)
    return ("\n".join([header, *rows]) + "\n").encode()


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
    obstructed = []
    for in_space in (False, True):
        place = folder / f"obstructed_{in_space}"
        place.mkdir()
        obstructed.append(obstructed_session(place, in_space))
    small = (
        centerline_session("short_clean", 2, effects=effects[:1]),
        centerline_session("overhang", 2, element="arc"),
    )
    parameters = []
    for k, session in enumerate(small):
        place = folder / str(k)
        place.mkdir()
        config = load_config(session.write(place))
        quick = config.estimation.changed(plausibility=False)
        outcome = run_session(config.changed(estimation=quick))
        (place / "parameters.yaml").write_text(parameters_text(outcome), encoding="utf-8")
        parameters.append(read_yaml(place / "parameters.yaml"))
    return Bases(
        (pinned, held, free, *obstructed),
        (photograph_session(False), photograph_session(True)),
        small,
        tuple(parameters),
    )
