"""A small session of each kind, drawn from the toolkit's own model, with its truth."""

from __future__ import annotations

import sys
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from dlo_casadi.config import dump_yaml, load_config
from dlo_casadi.effects import MeasurementEffect
from dlo_casadi.equilibrium.pose import HeldPose
from dlo_casadi.errors import EquilibriumError
from dlo_casadi.estimation.prediction import Prediction, predict_poses
from dlo_casadi.io.points import write_points
from dlo_casadi.model.cable_model import CableModel
from dlo_casadi.sensing.measured_pose import MeasuredPose
from dlo_casadi.session.fitting import declared_model
from matrix.cells import POSES, Cell

# Pictures are drawn as the tests of the camera do.
sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "tests" / "vision"))
import drawing
import scene

FloatArray = NDArray[np.floating]
Document = dict[str, Any]

LENGTH, MASS, DIAMETER = 0.5, 0.05, 0.01  # m, kg, m
STD, FORCE_STD, MOMENT_STD = 3e-4, 0.01, 1e-3  # m, N, N m
TOLERANCE = 2e-4  # m, of an end: as declared by default
ENDS = ("start", "end")
# Where the start is held: in sight of the drawn cameras.
START = {"plane": (0.0, 0.0), "space": (-0.2, 0.1, 0.15)}
# Draws of a session: of nine poses some have two ways to fall.
TRIES = 30
# In nine poses one is held out.
HELD_OUT = 5
# Waves of the rest curvature along the cable, and the turns of each: a cable that is bowed at rest
# may be rolled about its own axis against its rest curvature and hang nearly as before.
WAVES, TURNS = 3, {"straight": 0.0, "bowed": 0.03, "curved": 0.1}
# Standard deviation of a pixel's brightness, of 255: each picture has noise of its own.
GRAIN = 1.0
# From where each pose in space is photographed.
PLACES = ("left", "right")


@dataclass(frozen=True)
class Size:
    """How large sessions are.

    Parameters
    ----------
    points : int
        Of a line; a third of them are markers.
    truth : int
        Elements of the model from which they are drawn.
    n : int or None
        Elements of the declared model; chosen from the data if None.
    """

    points: int
    truth: int
    n: int | None


# A small session is drawn on the mesh on which it is fitted: what a coarser one misses of a finer
# one looks like a missing effect.
FULL, SMALL = Size(60, 40, None), Size(24, 8, 8)


@dataclass(frozen=True)
class Session:
    """A session on disk, and what is true of it."""

    path: Path
    document: Document
    stiffness: float


def draw_session(cell: Cell, size: Size, generator: np.random.Generator, folder: Path) -> Session:
    """Draw a cable, poses, fixtures within tolerances and noise; write configuration and files.

    All is drawn anew until every pose has one stable shape to which it falls.

    Raises
    ------
    EquilibriumError
        If that is never so.
    """
    for _ in range(TRIES):
        share = float(np.exp(generator.uniform(*np.log([0.03, 0.3]))))
        stiffness = MASS * 9.81 * LENGTH**2 * share
        document = declared(cell, size, stiffness, generator)
        path = folder / "session.yaml"
        path.write_text(dump_yaml(document), encoding="utf-8")
        for pose in document["experiment"]["poses"]:
            for name in pose.get("files") or [pose["file"]]:
                (folder / name).touch()
        config = load_config(path)
        model = declared_model(config).model.with_mesh(size.truth)
        poses = [pose.held for pose in config.experiment.poses]
        shapes = true_shapes(model, cell, stiffness, poses, generator)
        if shapes is None:
            continue
        for pose, held, shape in zip(document["experiment"]["poses"], poses, shapes, strict=True):
            write_seen(cell, size, folder, pose, shape, generator)
            if cell.readings == "read":
                pose |= read_off(pose, held, shape, generator)
        path.write_text(dump_yaml(document), encoding="utf-8")
        return Session(path, document, stiffness)
    raise EquilibriumError(f"no stable shapes of all poses in {TRIES} draws of the cable")


def declared(cell: Cell, size: Size, stiffness: float, generator: np.random.Generator) -> Document:
    """The configuration, with zeros where readings belong."""
    poses = [pose_of(cell, generator) for _ in range(POSES[cell.poses])]
    if cell.poses == "nine":
        poses[HELD_OUT]["role"] = "held_out"
    poses += [dict(poses[0])] * (cell.repeats == "again")
    for k, pose in enumerate(poses, 1):
        poses[k - 1] = pose | files_of(cell, f"pose_{k:02d}")
    measurement = measurement_of(cell)
    if cell.readings == "read":
        measurement |= {"force_std": FORCE_STD, "moment_std": MOMENT_STD}
    prior = stiffness * float(np.exp(generator.uniform(-0.7, 0.7)))
    gravity = [0.0, -9.81] if cell.frame == "plane" else [0.0, -9.81, 0.0]
    return {
        "cable": {
            "name": cell.name,
            "length": LENGTH,
            "mass": MASS,
            "diameter": DIAMETER,
            "bending_stiffness": prior,
            "rest_shape": "curved" if TURNS[cell.rest] else "straight",
        },
        "experiment": {
            "gravity": gravity,
            "boundary": {"start": cell.start, "end": cell.end},
            "measurement": measurement,
            "poses": poses,
        },
        "model": {} if size.n is None else {"n": size.n},
    }


def pose_of(cell: Cell, generator: np.random.Generator) -> Document:
    """Ends of one pose, and places for its readings."""
    start, span = np.array(START[cell.frame]), generator.uniform(0.55, 0.85) * LENGTH
    d, pose = len(start), {"start": start.tolist(), "role": "fit"}
    # Along the chord, and both clamps within some forty degrees of it.
    turns = [generator.uniform(-0.6, 0.6, 3) for _ in range(3)]
    if cell.frame == "plane":
        way = turns[0][0]
        direction = np.array([np.cos(way), np.sin(way)])
        held = {
            f"{side}_heading": float(way + turn[0])
            for side, turn in zip(ENDS, turns[1:], strict=True)
        }
    else:
        way = Rotation.from_rotvec(turns[0] * [0.5, 0.5, 1.0])
        direction = way.apply([1.0, 0.0, 0.0])
        held = {
            f"{side}_orientation": (way * Rotation.from_rotvec(turn)).as_quat().tolist()
            for side, turn in zip(ENDS, turns[1:], strict=True)
        }
    for key, value in held.items():
        if getattr(cell, key.split("_")[0]) == "clamped":
            pose[key] = value
    if cell.end != "free":
        pose["end"] = (start + span * direction).tolist()
    if cell.readings == "read":
        side = "start" if cell.end == "free" else "end"
        pose[f"{side}_force"] = [0.0] * d
        if getattr(cell, side) == "clamped":
            pose[f"{side}_moment"] = 0.0 if d == 2 else [0.0] * 3
    return pose


def files_of(cell: Cell, name: str) -> Document:
    """Names of the files of a pose."""
    if cell.measured != "photographs":
        return {"file": f"{name}.csv"}
    if cell.frame == "plane":
        return {"file": f"{name}.png"}
    return {"files": [f"{name}_{chr(97 + k)}.png" for k in range(len(PLACES))]}


def measurement_of(cell: Cell) -> Document:
    """How was measured; the noise of photographs is not known before."""
    if cell.measured != "photographs":
        return {"kind": "centerlines", "std": STD}
    if cell.frame == "plane":
        points = np.array([[0.0, 0.0], [0.4, 0.0]])
        pixels = drawing.to_pixels(points)
        return {
            "kind": "images",
            "reference": {"pixels": pixels.tolist(), "points": points.tolist()},
        }
    board, camera = scene.BOARD, scene.CAMERA
    return {
        "kind": "images",
        "camera": {
            "matrix": np.asarray(camera.matrix).tolist(),
            "distortion": np.asarray(camera.distortion).ravel().tolist(),
        },
        "board": {
            "dictionary": board.dictionary,
            "marker_size": board.marker_size,
            "marker_centers": {k: list(at) for k, at in board.marker_centers.items()},
        },
    }


def true_shapes(
    model: CableModel,
    cell: Cell,
    stiffness: float,
    poses: list[HeldPose],
    generator: np.random.Generator,
) -> list[Prediction] | None:
    """Shapes of a cable whose length, fixtures and sensors are off by draws from tolerances.

    None where a pose has no stable shape, or may fall to either side.
    """
    p = model.nominal.copy()
    camera = tuple(f"{e.label}." for e in model.effects if isinstance(e, MeasurementEffect))
    drawn = cell.measured == "photographs"  # a picture is drawn without errors of its camera
    for k, q in enumerate(model.parameters):
        if np.isfinite(q.prior_std) and not q.log and not (drawn and q.name.startswith(camera)):
            p[k] += q.prior_std * generator.standard_normal()
    p[0] = stiffness
    if "torsional_stiffness" in model.names:
        p[1] = stiffness * generator.uniform(0.6, 0.9)
    places = model.chain.cells.mean(axis=1) / LENGTH
    bends = model.chain.n_rests // len(places)  # twist, k_y and k_z in space
    waves = np.cos(np.pi * np.arange(WAVES)[:, None] * places) * 2 * np.pi / LENGTH
    rest = generator.standard_normal((bends, WAVES)) @ waves * TURNS[cell.rest]
    rest[: bends - 2] = 0.0
    true = [
        pose
        if pose.end is None
        else replace(
            pose, end=tuple(pose.end + TOLERANCE * generator.standard_normal(len(pose.end)))
        )
        for pose in poses
    ]
    found = predict_poses(model, p, rest.ravel(), true)
    sound = [
        x
        for x in found
        if x is not None and x.equilibrium.stable and x.equilibrium.other_side is None
    ]
    return sound if len(sound) == len(found) else None


def write_seen(
    cell: Cell,
    size: Size,
    folder: Path,
    pose: Document,
    shape: Prediction,
    generator: np.random.Generator,
) -> None:
    """Write what is measured of a pose."""
    if cell.measured == "photographs":
        dense = shape.curve.at(np.linspace(0.0, LENGTH, 2001))
        names = pose.get("files") or [pose["file"]]
        for name, place in zip(names, PLACES, strict=False):
            if cell.frame == "plane":
                picture = drawing.draw(dense, width_px=DIAMETER * drawing.SCALE)
            else:
                picture = scene.photograph(dense, place, diameter=DIAMETER)
            correlation_length = np.rint(GRAIN * generator.standard_normal(picture.shape))
            cv2.imwrite(
                str(folder / name), np.clip(picture + correlation_length, 0, 255).astype(np.uint8)
            )
        return
    marked = cell.measured == "markers"
    count = size.points // 3 if marked else size.points
    s = np.linspace(0.01, 0.99, count) * LENGTH
    points = shape.curve.at(s)
    points += STD * generator.standard_normal(points.shape)
    write_points(folder / pose["file"], points, s if marked else None)


def read_off(
    pose: Document, held: HeldPose, shape: Prediction, generator: np.random.Generator
) -> Document:
    """Readings of a pose, with their noise."""
    names = [key for key in pose if key.endswith(("_force", "_moment"))]
    item = MeasuredPose.of_points(held, shape.curve.at(np.linspace(0.0, LENGTH, 3)))
    item = item.with_readings({name: np.atleast_1d(pose[name]) for name in names})
    out = {}
    for name, (_, true) in item.readings_beside(shape.seen).items():
        std = FORCE_STD if name.endswith("_force") else MOMENT_STD
        read = true + std * generator.standard_normal(len(true))
        out[name] = read.tolist() if len(read) > 1 else float(read[0])
    return out
