"""A take: a cable led through the poses of a session, and held still in each. RENDERED, not real.

Between two poses markers and grippers move along smooth paths; after each move the cable swings
out. Every frame has white noise of its own. The grippers are recorded with a clock of their own.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from dlo_casadi.arrays import FloatArray
from dlo_casadi.config import load_config
from dlo_casadi.io.points import read_points

HOLD, MOVE, RATE, OFFSET = 1.6, 1.0, 100.0, 0.08  # s, s, 1/s, s
SWING, DAMPING = 0.01, 0.12  # m, s
NOISE, TURN_NOISE = 2.0e-4, 5.0e-4  # m, rad
Written = tuple[list[Path], list[str]]  # files, and options of `dlo import` that they take
Z_TO_Y_UP = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])


@dataclass(frozen=True)
class Take:
    """What was recorded every 1 / RATE seconds."""

    t: FloatArray  # (n,) [s], on the cable's clock
    markers: dict[str, FloatArray]  # (n, 3) [m]
    bodies: dict[str, FloatArray]  # (n, 7)
    offset: float = OFFSET  # [s], of the grippers' clock

    def y_up(self) -> Take:
        """The same in axes of which y points up."""
        q = Rotation.from_matrix(Z_TO_Y_UP).as_quat()
        bodies = {
            name: np.hstack([x[:, :3] @ Z_TO_Y_UP.T, _product(q, x[:, 3:])])
            for name, x in self.bodies.items()
        }
        markers = {name: x @ Z_TO_Y_UP.T for name, x in self.markers.items()}
        return replace(self, markers=markers, bodies=bodies)


def _product(p: FloatArray, q: FloatArray) -> FloatArray:
    """Quaternions (n, 4) of a rotation q, which may be nan, and then p."""
    vector = p[3] * q[:, :3] + q[:, 3:] * p[:3] + np.cross(p[:3], q[:, :3])
    return np.column_stack([vector, p[3] * q[:, 3] - q[:, :3] @ p[:3]])


def rendered(session: Path, seed: int = 0, poses: int | None = None) -> Take:
    """A take of a session in space with markers, z up. Names of markers are in no order."""
    random = np.random.default_rng(seed)
    config = load_config(session)
    poses = config.experiment.poses[:poses]
    points = np.array([read_points(x.paths[0], x.start, x.end).points for x in poses])
    period = HOLD + MOVE
    t = np.arange(0.0, len(poses) * period - MOVE + 0.5, 1.0 / RATE)
    phase = np.clip((t - HOLD) / period, 0, len(poses) - 1)
    share = np.clip((phase % 1.0) * period / MOVE, 0.0, 1.0)
    share = share**3 * (10 - 15 * share + 6 * share**2)
    at = np.where(t < HOLD, 0.0, np.floor(phase) + share)
    at = np.minimum(at, len(poses) - 1)
    since = (t - np.floor(t / period) * period)[:, None]
    swing = SWING * np.exp(-since / DAMPING) * np.sin(30 * since) * (t[:, None] > period)
    markers = {}
    for k, name in enumerate(random.permutation(points.shape[1])):
        path = np.column_stack([np.interp(at, range(len(poses)), x) for x in points[:, k].T])
        shape = np.sin(np.pi * (k + 1) / (points.shape[1] + 1))
        markers[f"m{name:02d}"] = path + swing * shape * [0.0, 0.6, 0.8]
    bodies = {}
    for side in ("start", "end"):
        places = np.array([getattr(x, side) for x in poses])
        turns = Rotation.from_quat([getattr(x, f"{side}_orientation") for x in poses])
        path = np.column_stack([np.interp(at, range(len(poses)), x) for x in places.T])
        bodies[side] = np.hstack([path, Slerp(range(len(poses)), turns)(at).as_quat()])
    markers = {k: x + NOISE * random.standard_normal(x.shape) for k, x in sorted(markers.items())}
    for name, x in bodies.items():
        shaken = Rotation.from_rotvec(TURN_NOISE * random.standard_normal((len(x), 3)))
        turned = (Rotation.from_quat(x[:, 3:]) * shaken).as_quat()
        bodies[name] = np.hstack(
            [x[:, :3] + 0.5 * NOISE * random.standard_normal((len(x), 3)), turned]
        )
    return Take(t, markers, bodies)


def write_motive(take: Take, folder: Path) -> Written:
    """Two files of Motive, y up, in millimetres: the cable's markers, and the grippers."""
    up = take.y_up()
    cable, grippers = folder / "cable.csv", folder / "grippers.csv"
    columns: list[tuple[str, str, str, str, FloatArray]] = []
    for name, x in up.markers.items():
        columns += [
            ("Marker", f"cable:{name}", "Position", a, 1e3 * x[:, k]) for k, a in enumerate("XYZ")
        ]
    cable.write_text(_motive(take.t, columns))
    columns = []
    for name, x in up.bodies.items():
        columns += [("Rigid Body", name, "Rotation", a, x[:, 3 + k]) for k, a in enumerate("XYZW")]
        columns += [("Rigid Body", name, "Position", a, 1e3 * x[:, k]) for k, a in enumerate("XYZ")]
        columns.append(("Rigid Body", name, "Mean Marker Error", "", 0.1 + 0.0 * take.t))
    grippers.write_text(_motive(take.t + take.offset, columns))
    return [cable, grippers], []


def _motive(t: FloatArray, columns: list[tuple[str, str, str, str, FloatArray]]) -> str:
    meta = (
        f"Format Version,1.23,Take Name,take,Capture Frame Rate,{RATE:.6f},Export Frame Rate,"
        f"{RATE:.6f},Total Exported Frames,{len(t)},Rotation Type,Quaternion,"
        "Length Units,Millimeters,Coordinate Space,Global"
    )
    kinds, names, quantities, axes, values = zip(*columns, strict=True)
    heads = [
        ["", "Type", *kinds],
        ["", "Name", *names],
        ["", "ID", *("0" for _ in names)],
        ["", "", *quantities],
        ["Frame", "Time (Seconds)", *axes],
    ]
    rows = [
        [str(k), f"{time:.6f}", *(f"{x:.6f}" if np.isfinite(x) else "" for x in row)]
        for k, (time, row) in enumerate(zip(t, np.array(values).T, strict=True))
    ]
    return "\n".join([meta, "", *(",".join(row) for row in [*heads, *rows])]) + "\n"


# Name of a format -> what writes a take in it.
WRITERS = {"motive": write_motive}
