"""Depth clouds of a cable whose shape is known, by casting rays. RENDERED, not real."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from scipy.interpolate import CubicSpline

from dlo_casadi.arrays import FloatArray

CABLE, WALL, CLOTH = (230, 110, 20), (150, 150, 150), (40, 60, 140)  # red, green, blue
NOISE, HIDDEN = 2.0e-3, 0.3  # m, of a depth; share of the cable behind cloths
FOCAL, SHAPE = 900.0, (720, 1280)  # px


def camera_frame(place: FloatArray, target: FloatArray, up: FloatArray) -> FloatArray:
    """Rows: right, down and forward of a camera that looks at a target."""
    forward = (target - place) / np.linalg.norm(target - place)
    right = np.cross(forward, up)
    right /= np.linalg.norm(right)
    return np.array([right, np.cross(forward, right), forward])


def depth_cloud(
    line: FloatArray,
    radius: float,
    place: FloatArray,
    up: FloatArray,
    random: np.random.Generator,
) -> tuple[FloatArray, FloatArray]:
    """Points (K, 3) [m] and colours of what a depth camera sees: a tube, cloths, a wall behind.

    A ray through a pixel meets the tube where its distance from the nearest piece of the axis is
    the radius: a cylinder for each short piece. Depths have white noise; two cloths lie on the
    cable and hide their share of it.
    """
    frame = camera_frame(place, line.mean(axis=0), up)
    s = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(line, axis=0), axis=1))])
    curve = CubicSpline(s, (line - place) @ frame.T)
    at = np.arange(0.0, s[-1], 0.5 * radius)
    axis, tangent = curve(at), curve(at, 1)
    depth = np.full(SHAPE, np.inf)
    hidden = np.zeros(SHAPE, bool)
    width = HIDDEN * s[-1] / 2.0
    first, second = np.sort(random.uniform(0.1, 0.9, 2) * (s[-1] - 2.2 * width))
    starts = (first, second + 1.1 * width)
    center = np.array([SHAPE[1], SHAPE[0]]) / 2.0
    for c, along, place_on in zip(
        axis, tangent / np.linalg.norm(tangent, axis=1)[:, None], at, strict=True
    ):
        u, v = FOCAL * c[:2] / c[2] + center
        reach = int(np.ceil(2.0 * FOCAL * radius / c[2])) + 1
        columns = np.arange(max(int(u) - reach, 0), min(int(u) + reach + 1, SHAPE[1]))
        rows = np.arange(max(int(v) - reach, 0), min(int(v) + reach + 1, SHAPE[0]))
        x, y = np.meshgrid((columns - center[0]) / FOCAL, (rows - center[1]) / FOCAL)
        rays = np.stack([x, y, np.ones_like(x)], axis=-1)
        across = rays - (rays @ along)[..., None] * along
        off = c - (c @ along) * along
        a, b = (across**2).sum(axis=-1), across @ off
        root = b**2 - a * (off @ off - radius**2)
        found = (b - np.sqrt(np.maximum(root, 0.0))) / a
        met = (root > 0) & (np.abs((rays * found[..., None] - c) @ along) < 0.4 * radius)
        window = np.ix_(rows, columns)
        nearer = met & (found < depth[window])
        depth[window] = np.where(nearer, found, depth[window])
        behind = any(begin <= place_on <= begin + width for begin in starts)
        hidden[window] = np.where(nearer, behind, hidden[window])
    wall = float(axis[:, 2].max()) + 0.3
    seen = np.isfinite(depth)
    colors = np.where(seen[..., None], np.where(hidden[..., None], CLOTH, CABLE), WALL)
    depth = np.where(seen, depth - np.where(hidden, 0.02, 0.0), wall)
    depth = depth + NOISE * random.standard_normal(depth.shape)
    rows, columns = np.indices(SHAPE)
    rays = np.stack([(columns - center[0]) / FOCAL, (rows - center[1]) / FOCAL, 0 * rows + 1.0], -1)
    points = (rays * depth[..., None]).reshape(-1, 3) @ frame + place
    return points, colors.reshape(-1, 3).astype(float)


def write_ply(path: Path, points: FloatArray, colors: FloatArray) -> None:
    """Binary PLY with colours."""
    kind = [(axis, "<f4") for axis in "xyz"] + [(c, "u1") for c in ("red", "green", "blue")]
    table = np.zeros(len(points), kind)
    for k, name in enumerate(("x", "y", "z")):
        table[name] = points[:, k]
    for k, name in enumerate(("red", "green", "blue")):
        table[name] = colors[:, k]
    types = [*(f"float {a}" for a in "xyz"), *(f"uchar {c}" for c in ("red", "green", "blue"))]
    head = ["ply", "format binary_little_endian 1.0", f"element vertex {len(points)}"]
    head += [*(f"property {text}" for text in types), "end_header"]
    path.write_bytes("\n".join(head).encode() + b"\n" + table.tobytes())


def write_pcd(path: Path, points: FloatArray, colors: FloatArray, place: FloatArray) -> None:
    """Text PCD with PCL's packed colours and the camera as VIEWPOINT."""
    packed = colors.astype(np.uint32) @ np.array([65536, 256, 1], np.uint32)
    head = ["VERSION 0.7", "FIELDS x y z rgb", "SIZE 4 4 4 4", "TYPE F F F U", "COUNT 1 1 1 1"]
    head += [f"WIDTH {len(points)}", "HEIGHT 1"]
    head += [
        f"VIEWPOINT {' '.join(map(str, place))} 1 0 0 0",
        f"POINTS {len(points)}",
        "DATA ascii",
    ]
    rows = [f"{x:.5f} {y:.5f} {z:.5f} {c}" for (x, y, z), c in zip(points, packed, strict=True)]
    path.write_text("\n".join([*head, *rows]) + "\n")
