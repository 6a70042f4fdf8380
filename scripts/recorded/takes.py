"""A take: a cable led through the poses of a session, and held still in each. RENDERED, not real.

Between two poses markers and grippers move along smooth paths; after each move the cable swings
out. Every frame has white noise of its own. The grippers are recorded with a clock of their own.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from dlo_casadi.arrays import FloatArray
from dlo_casadi.config import Pose, load_config
from dlo_casadi.io.points import read_points

HOLD, MOVE, OFFSET = 1.6, 1.0, 0.08  # s
SWING, DAMPING = 0.01, 0.12  # m, s
NOISE, TURN_NOISE = 2.0e-4, 5.0e-4  # m, rad
Written = tuple[list[Path], list[str]]  # files, and options of `dlo import` that they take
Z_TO_Y_UP = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])


@dataclass(frozen=True)
class Take:
    """What was recorded at a steady rate."""

    t: FloatArray  # (n,) [s], on the cable's clock
    markers: dict[str, FloatArray]  # (n, 3) [m]
    bodies: dict[str, FloatArray]  # (n, 7)
    offset: float = OFFSET  # [s], of the grippers' clock
    force: tuple[float, ...] = ()  # [N], in the end's axes; in bags
    clouds: tuple[tuple[float, FloatArray, FloatArray], ...] = ()  # t, points, colours; in bags
    camera: tuple[float, ...] = (0.0, 0.0, 0.0)  # [m], that saw them

    @property
    def rate(self) -> float:
        """Frames a second."""
        return 1.0 / float(self.t[1] - self.t[0])

    def early(self, x: FloatArray) -> FloatArray:
        """Rows of a recording that began `offset` before, and counts time from its start."""
        return np.concatenate([np.repeat(x[:1], round(self.offset * self.rate), axis=0), x])

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


def rendered(session: Path, seed: int = 0, poses: int | None = None, rate: float = 100.0) -> Take:
    """A take of a session in space with markers, z up. Names of markers are in no order."""
    held = load_config(session).experiment.poses[:poses]
    points = [read_points(pose.paths[0], pose.start, pose.end).points for pose in held]
    return led(held, np.array(points), seed, rate)


def led(poses: Sequence[Pose], points: FloatArray, seed: int = 0, rate: float = 100.0) -> Take:
    """A take that stops in each pose; points (P, K, 3) [m] of K markers in all of them."""
    random = np.random.default_rng(seed)
    period = HOLD + MOVE
    t = np.arange(0.0, len(poses) * period - MOVE + 0.5, 1.0 / rate)
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
    cable.write_text(_motive(take.t, take.rate, columns))
    write_grippers(up, grippers)
    return [cable, grippers], []


def write_grippers(take: Take, path: Path) -> None:
    """A file of Motive with the grippers alone, in the axes of the take."""
    columns: list[tuple[str, str, str, str, FloatArray]] = []
    for name, x in take.bodies.items():
        columns += [("Rigid Body", name, "Rotation", a, x[:, 3 + k]) for k, a in enumerate("XYZW")]
        columns += [("Rigid Body", name, "Position", a, 1e3 * x[:, k]) for k, a in enumerate("XYZ")]
        columns.append(("Rigid Body", name, "Mean Marker Error", "", 0.1 + 0.0 * take.t))
    path.write_text(_motive(take.t + take.offset, take.rate, columns))


def _motive(
    t: FloatArray, rate: float, columns: list[tuple[str, str, str, str, FloatArray]]
) -> str:
    meta = (
        f"Format Version,1.23,Take Name,take,Capture Frame Rate,{rate:.6f},Export Frame Rate,"
        f"{rate:.6f},Total Exported Frames,{len(t)},Rotation Type,Quaternion,"
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


def corners(take: Take) -> dict[str, FloatArray]:
    """Three markers on each gripper: its place, 5 cm along x, 5 cm along y."""
    found = {}
    for name, x in take.bodies.items():
        _, axis_x, axis_y = x[:, :3], *(_turned(x[:, 3:], k) for k in (0, 1))
        found[f"{name}_o"] = x[:, :3]
        found[f"{name}_x"], found[f"{name}_y"] = (x[:, :3] + 0.05 * a for a in (axis_x, axis_y))
    return found


def _turned(q: FloatArray, k: int) -> FloatArray:
    """Axis k of the frames (n, 4), which may be nan."""
    axis = np.zeros((len(q), 4))
    axis[:, k] = 1.0
    back = q * [-1.0, -1.0, -1.0, 1.0]
    return np.array(
        [_product(a, _product(b, c[None]))[0, :3] for a, b, c in zip(q, axis, back, strict=True)]
    )


CORNERS = ["--start", "start_o,start_x,start_y", "--end", "end_o,end_x,end_y"]


def write_vicon(take: Take, folder: Path) -> Written:
    """Two files of Vicon, z up, in millimetres: trajectories, and objects with rotation vectors."""
    cable, grippers = folder / "trajectories.csv", folder / "objects.csv"
    cable.write_text(
        _vicon("Trajectories", take.rate, {k: 1e3 * x for k, x in take.markers.items()})
    )
    bodies = {}
    for name, x in take.bodies.items():
        turns = np.full((len(x), 3), np.nan)
        if np.isfinite(x).all():
            turns = Rotation.from_quat(x[:, 3:]).as_rotvec()
        bodies[name] = take.early(np.hstack([turns, 1e3 * x[:, :3]]))
    grippers.write_text(_vicon("Objects", take.rate, bodies))
    return [cable, grippers], []


def _vicon(section: str, rate: float, items: dict[str, FloatArray]) -> str:
    body = section == "Objects"
    axes = ["RX", "RY", "RZ", "TX", "TY", "TZ"] if body else ["X", "Y", "Z"]
    units = ["rad"] * 3 * body + ["mm"] * 3
    names = [
        cell
        for name in items
        for cell in (f"global:{name}" if not body else name, *[""] * (len(axes) - 1))
    ]
    lines = [section, f"{rate:.0f}", ",".join(["", "", *names])]
    lines += [
        ",".join(["Frame", "Sub Frame", *axes * len(items)]),
        ",".join(["", "", *units * len(items)]),
    ]
    for k, row in enumerate(np.hstack([*items.values()]), start=1):
        lines.append(",".join([str(k), "0", *(f"{x:.6f}" if np.isfinite(x) else "" for x in row)]))
    return "\n".join(lines) + "\n\n"


def write_c3d(take: Take, folder: Path) -> Written:
    """Two C3D files written by ezc3d, y up, in mm: the cable, and three markers a gripper."""
    import ezc3d

    up = take.y_up()
    early = {name: take.early(x) for name, x in corners(up).items()}
    files = []
    for name, items in (("cable", up.markers), ("grippers", early)):
        content = ezc3d.c3d()
        content["parameters"]["POINT"]["RATE"]["value"] = [take.rate]
        content["parameters"]["POINT"]["UNITS"]["value"] = ["mm"]
        content["parameters"]["POINT"]["LABELS"]["value"] = list(items)
        content.add_parameter("POINT", "Y_SCREEN", ["+Y"])
        places = np.transpose(1e3 * np.array([*items.values()]), (2, 0, 1))
        content["data"]["points"] = np.concatenate([places, np.ones_like(places[:1])])
        files.append(folder / f"{name}.c3d")
        content.write(str(files[-1]))
    return files, CORNERS


def write_rosbag2(take: Take, folder: Path) -> Written:
    """A bag written by rosbags in SQLite: MarkerArray, TF of a robot, a wrench at its end."""
    return [_bag(take, folder / "take", "SQLITE3")], ["--end", "flange"]


def write_mcap(take: Take, folder: Path) -> Written:
    """A bag in MCAP, given as its file."""
    bag = _bag(take, folder / "take", "MCAP")
    return [next(bag.glob("*.mcap"))], ["--end", "flange"]


EPOCH = 1_700_000_000.0  # s
FLANGE = np.array([0.1, 0.05, 0.2])  # m, of the robot's hand from its base, in /tf_static


def _bag(take: Take, path: Path, plugin: str) -> Path:
    from rosbags.rosbag2 import StoragePlugin, Writer
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS2_HUMBLE)
    msg = {name.rsplit("/", 1)[-1]: kind for name, kind in store.types.items()}

    def header(t: float, frame: str) -> object:
        whole = int(t)
        stamp = store.types["builtin_interfaces/msg/Time"](whole, int((t - whole) * 1e9))
        return msg["Header"](stamp, frame)

    def pose(x: FloatArray) -> object:
        return msg["Pose"](msg["Point"](*x[:3]), msg["Quaternion"](*x[3:]))

    def transform(t: float, parent: str, child: str, x: FloatArray) -> object:
        moved = msg["Transform"](msg["Vector3"](*x[:3]), msg["Quaternion"](*x[3:]))
        return msg["TransformStamped"](header(t, parent), child, moved)

    still = np.array([0.0, 0.0, 0.0, 1.0])
    with Writer(path, version=9, storage_plugin=StoragePlugin[plugin]) as writer:

        def topic(name: str, kind: str) -> object:
            return writer.add_connection(name, kind, typestore=store)

        markers = topic("/mocap/markers", "visualization_msgs/msg/MarkerArray")
        start = topic("/start", "geometry_msgs/msg/PoseStamped")
        tf = topic("/tf", "tf2_msgs/msg/TFMessage")
        fixed = topic("/tf_static", "tf2_msgs/msg/TFMessage")
        force = topic("/wrench", "geometry_msgs/msg/WrenchStamped")

        def put(connection: object, t: float, message: object) -> None:
            raw = store.serialize_cdr(message, connection.msgtype)  # type: ignore[attr-defined]
            writer.write(connection, int(1e9 * t), raw)  # type: ignore[arg-type]

        base = transform(EPOCH, "world", "base", np.hstack([FLANGE, still]))
        put(fixed, EPOCH, msg["TFMessage"]([base]))
        seen = topic("/depth/points", "sensor_msgs/msg/PointCloud2")
        eye = transform(EPOCH, "world", "camera", np.hstack([take.camera, still]))
        put(fixed, EPOCH, msg["TFMessage"]([eye]))
        for t, points, colors in take.clouds:
            stamp = header(EPOCH + t, "camera")
            put(seen, EPOCH + t, _cloud(msg, stamp, points - take.camera, colors))
        for k, t in enumerate(EPOCH + take.t):
            late = t + take.offset
            array = [
                marker_message(msg, header(t, "world"), name, pose(np.hstack([x[k], still])))
                for name, x in take.markers.items()
            ]
            put(markers, t, msg["MarkerArray"](array))
            put(start, t, msg["PoseStamped"](header(late, "world"), pose(take.bodies["start"][k])))
            hand = take.bodies["end"][k] - np.hstack([FLANGE, 0.0 * still])
            put(tf, t, msg["TFMessage"]([transform(late, "base", "flange", hand)]))
            if take.force:
                wrench = msg["Wrench"](msg["Vector3"](*take.force), msg["Vector3"](0.0, 0.0, 0.0))
                put(force, t, msg["WrenchStamped"](header(late, "flange"), wrench))
    return path


def _cloud(msg: dict[str, type], header: object, points: FloatArray, colors: FloatArray) -> object:
    """A PointCloud2 with PCL's packed colours."""
    table = np.zeros(len(points), [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("rgb", "<u4")])
    for k, axis in enumerate("xyz"):
        table[axis] = points[:, k]
    table["rgb"] = colors.astype(np.uint32) @ np.array([65536, 256, 1], np.uint32)
    fields = [msg["PointField"](name, 4 * k, 7, 1) for k, name in enumerate(("x", "y", "z"))]
    fields.append(msg["PointField"]("rgb", 12, 6, 1))
    data, n = np.frombuffer(table.tobytes(), np.uint8), len(table)
    return msg["PointCloud2"](header, 1, n, fields, False, 16, 16 * n, data, True)


def marker_message(msg: dict[str, type], header: object, name: str, pose: object) -> object:
    """A sphere of visualization_msgs."""
    fields = dict.fromkeys(msg["Marker"].__dataclass_fields__)
    for key in ("points", "colors", "uv_coordinates"):
        fields[key] = []
    stamp = type(header.stamp)(0, 0)  # type: ignore[attr-defined]
    color, scale = msg["ColorRGBA"](1.0, 1.0, 1.0, 1.0), msg["Vector3"](0.01, 0.01, 0.01)
    empty = np.zeros(0, np.uint8)
    fields |= {"header": header, "ns": name, "id": 0, "type": 2, "action": 0, "pose": pose}
    fields |= {
        "scale": scale,
        "color": color,
        "lifetime": msg["Duration"](0, 0),
        "frame_locked": False,
    }
    fields |= {
        "texture_resource": "",
        "text": "",
        "mesh_resource": "",
        "mesh_use_embedded_materials": False,
    }
    fields["texture"] = msg["CompressedImage"](msg["Header"](stamp, ""), "", empty)
    fields["mesh_file"] = msg["MeshFile"]("", empty)
    return msg["Marker"](**{key: value for key, value in fields.items() if key != "__msgtype__"})


# Name of a format -> what writes a take in it.
WRITERS = {
    "motive": write_motive,
    "vicon": write_vicon,
    "c3d": write_c3d,
    "rosbag2": write_rosbag2,
    "mcap": write_mcap,
}
