"""Depth clouds, rendered from shapes that are known, come back as the lines of the cable."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from recorded.clouds import CABLE, HIDDEN, WALL, depth_cloud, write_pcd, write_ply
from recorded.takes import HOLD, MOVE, led, write_grippers, write_mcap
from scipy.interpolate import CubicSpline
from scipy.spatial import cKDTree

from dlo_casadi.cli import main
from dlo_casadi.config import load_config
from dlo_casadi.errors import MeasurementError, VisionError
from dlo_casadi.io.points import read_points
from dlo_casadi.recordings import CloudView, Recording, Stream, Wishes, make_session, read_recording
from dlo_casadi.recordings.clouds import cloud_of
from dlo_casadi.recordings.fixtures import Gripper, along_cable
from dlo_casadi.recordings.recording import Cloud
from dlo_casadi.vision import KnownCable, line_in_cloud, of_color

DATA = Path(__file__).parent / "data"
PLACE, UP = np.array([0.25, -0.1, 1.3]), np.array([0.0, 1.0, 0.0])
CONFIG = load_config(DATA / "space" / "space_photos" / "session.yaml")
POSES = CONFIG.experiment.poses[:2]
KNOWN = ("--length", "0.9", "--diameter", "0.007", "--mass", "0.09")
CAMERA, COLOR = ("--camera", *map(str, PLACE)), ("--color", *map(str, CABLE))
SHAPES = np.load(DATA / "space_truth" / "space_photos" / "truth_shapes.npz")


@pytest.fixture(scope="module")
def clouds():
    random = np.random.default_rng(0)
    radius = 0.5 * CONFIG.cable.diameter
    seen = [depth_cloud(SHAPES[x.name], radius, PLACE, UP, random) for x in POSES]
    few = [(colors != WALL).any(axis=1) | (np.arange(len(colors)) % 99 == 0) for _, colors in seen]
    return [(points[kept], colors[kept]) for (points, colors), kept in zip(seen, few, strict=True)]


@pytest.fixture(scope="module")
def take():
    return led(POSES, np.zeros((len(POSES), 0, 3)), rate=25.0)


def errors(points, name):
    """Vectors [m] from the nearest points of the true line."""
    fine = CubicSpline(np.linspace(0, 1, 101), SHAPES[name])(np.linspace(0, 1, 9001))
    return points - fine[cKDTree(fine).query(points)[1]]


def test_the_line_is_on_the_axis_and_leaves_out_what_is_hidden(clouds):
    """2 mm of noise, 30 % hidden; without the camera the visible half is pi r / 4 before it."""
    (points, colors), pose = clouds[0], POSES[0]
    seen = points[of_color(colors, CABLE)]
    cable = KnownCable(pose.start, pose.end, CONFIG.cable.diameter, CONFIG.cable.length)
    sight = (PLACE - SHAPES[pose.name].mean(axis=0)) / 1.2

    line, messages = line_in_cloud(seen, cable, PLACE)
    off = errors(line, pose.name)
    assert np.sqrt((off**2).sum(axis=1).mean()) < 0.5e-3
    assert abs((off @ sight).mean()) < 0.15e-3
    assert len(line) * 0.01 == pytest.approx((1 - HIDDEN) * CONFIG.cable.length, abs=0.04)
    assert "hidden" in messages[0]

    bare, messages = line_in_cloud(seen, cable, None)
    before = np.pi / 8 * CONFIG.cable.diameter
    assert (errors(bare, pose.name) @ sight).mean() == pytest.approx(before, rel=0.2)
    assert "before the axis" in messages[-1]


def write(kind, clouds, take, folder):
    """Files of a recording with clouds, and the options that they take."""
    if kind == "mcap":
        times = [0.5 * HOLD + k * (HOLD + MOVE) for k in range(len(clouds))]
        seen = tuple((t, *cloud) for t, cloud in zip(times, clouds, strict=True))
        bag = replace(take, clouds=seen, camera=tuple(PLACE), offset=0.0)
        files, _ = write_mcap(bag, folder)
        return files, [*COLOR, "--up", "y", "--end", "flange"]
    write_grippers(take, folder / "grippers.csv")
    for k, (points, colors) in enumerate(clouds):
        cable = of_color(colors, CABLE)
        if kind == "ply":
            write_ply(folder / f"{k}.ply", points, colors)
        elif kind == "pcd":
            write_pcd(folder / f"{k}.pcd", points[cable], colors[cable], PLACE)
        else:
            np.save(folder / f"{k}.npy", 1e3 * points[cable])
    files = [*sorted(folder.glob(f"*.{kind}")), folder / "grippers.csv"]
    options = {"ply": (*CAMERA, *COLOR), "pcd": COLOR, "npy": (*CAMERA, "--units", "mm")}
    return files, [*options[kind], "--up", "y"]


def imported(files, output, options):
    known = ["--output", str(output), "--quiet", *KNOWN]
    return main(["import", *map(str, files), *options, *known])


@pytest.mark.parametrize("kind", ["ply", "pcd", "npy", "mcap"])
def test_clouds_come_back_as_lines(kind, clouds, take, tmp_path):
    files, options = write(kind, clouds, take, tmp_path)
    assert imported(files, tmp_path / "loom", options) == 0
    poses = load_config(tmp_path / "loom" / "session.yaml").experiment.poses
    for pose, true in zip(poses, POSES, strict=True):
        line = read_points(pose.paths[0], pose.start, pose.end).points
        y_up = line[:, [0, 2, 1]] * [1.0, 1.0, -1.0]
        assert np.sqrt((errors(y_up, true.name) ** 2).sum(axis=1).mean()) < 0.5e-3


@pytest.mark.parametrize(
    ("how", "said"),
    [
        ("truncated", "ends after"),
        ("empty", "has no header"),
        ("nan", "finite"),
        ("another colour", "--color"),
        ("one too few", "1 cloud without a time for 2 poses"),
        ("another frame", "clouds and grippers in one frame"),
        ("no grippers", "grippers"),
    ],
)
def test_broken_clouds_are_told_and_nothing_is_written(how, said, clouds, take, tmp_path, capsys):
    files, options = write("ply", clouds, take, tmp_path)
    if how == "truncated":
        files[0].write_bytes(files[0].read_bytes()[:100_000])
    if how == "empty":
        files[0].write_bytes(b"")
    if how == "nan":
        write_ply(files[0], np.nan * clouds[0][0], clouds[0][1])
    if how == "another colour":
        options = [*CAMERA, "--color", "0", "255", "0"]
    if how == "one too few":
        files = files[1:]
    if how == "another frame":
        write_ply(files[0], clouds[0][0] + [5.0, 0.0, 0.0], clouds[0][1])
    if how == "no grippers":
        files = files[:2]
    before = sorted(tmp_path.iterdir())
    assert imported(files, tmp_path / "loom", options) == 2
    told = capsys.readouterr().err
    assert said in told
    assert "Try: " in told
    assert "Traceback" not in told
    assert sorted(tmp_path.iterdir()) == before


def test_files_of_few_points_that_are_broken(clouds, take, tmp_path, capsys):
    """PCD and NPY: a message with a remedy for each, and nothing written."""
    for kind, how, said in (
        ("pcd", "truncated", "ends after"),
        ("pcd", "empty", "cannot be read as a .pcd recording"),
        ("pcd", "nan", "finite"),
        ("pcd", "no z", "the fields x, y, h, rgb"),
        ("npy", "truncated", "cannot be read as a .npy recording"),
        ("npy", "empty", "cannot be read as a .npy recording"),
        ("npy", "nan", "finite"),
        ("npy", "four columns", "Try: (K, 3), or (K, 6)"),
        ("npy", "no points", "holds no points"),
        ("npy", "y and z exchanged", "one frame"),
    ):
        folder = tmp_path / f"{kind} {how}"
        folder.mkdir()
        files, options = write(kind, clouds, take, folder)
        whole, file = files[0].read_bytes(), files[0]
        points = np.load(file) if kind == "npy" else np.zeros((3, 3))
        if how in ("truncated", "empty"):
            file.write_bytes(whole[: len(whole) // 2] if how == "truncated" else b"")
        elif how == "no z":
            file.write_bytes(whole.replace(b"FIELDS x y z", b"FIELDS x y h", 1))
        elif kind == "pcd":
            write_pcd(file, np.nan * points, np.zeros((3, 3)), PLACE)
        elif how == "y and z exchanged":
            for each in files[:2]:
                np.save(each, np.load(each)[:, [0, 2, 1]])
        else:
            broken = {
                "nan": np.nan * points,
                "four columns": points[:, [0, 1, 2, 2]],
                "no points": points[:0],
            }
            np.save(file, broken[how])
        before = sorted(folder.iterdir())
        assert imported(files, folder / "loom", options) == 2, (kind, how)
        told = capsys.readouterr().err
        assert said in told, (kind, how, told)
        assert "Try: " in told, (kind, how)
        assert "Traceback" not in told
        assert sorted(folder.iterdir()) == before


THREE = np.array([[0.1, 0.2, 0.3], [0.4, 0.5, 0.6], [0.7, 0.8, 0.9]])
RED = [230.0, 110.0, 20.0]


def padded_pcd(path, style):
    """A file as PCL writes a struct: padding between the fields, of any length."""
    fields = [("x", "<f4"), ("_", "u1"), ("y", "<f4"), ("z", "<f4"), ("_", "u1"), ("rgb", "<u4")]
    counts = (1, 4, 1, 1, 8, 1)
    kind = [
        (f"{k}", form, (n,)) for k, ((_, form), n) in enumerate(zip(fields, counts, strict=True))
    ]
    table = np.ones(3, kind)
    for k, column in zip("023", THREE.T, strict=True):
        table[k] = column[:, None]
    table["5"] = RED @ np.array([65536, 256, 1])
    head = [
        f"FIELDS {' '.join(name for name, _ in fields)}",
        f"SIZE {' '.join(form[-1] for _, form in fields)}",
        f"TYPE {' '.join(form[-2].upper() for _, form in fields)}",
        f"COUNT {' '.join(map(str, counts))}",
        "VIEWPOINT 100 200 300 1 0 0 0",
        f"POINTS 3\nDATA {style}\n",
    ]
    rows = [" ".join(str(x) for value in row for x in np.ravel(value)) for row in table.tolist()]
    body = table.tobytes() if style == "binary" else "\n".join(rows).encode()
    path.write_bytes("\n".join(head).encode() + body)


@pytest.mark.parametrize("style", ["ascii", "binary"])
def test_padding_between_the_fields_of_a_pcd_file_is_skipped(style, tmp_path):
    padded_pcd(tmp_path / "a.pcd", style)
    (cloud,) = read_recording([tmp_path / "a.pcd"], view=CloudView(color=RED)).clouds
    assert cloud.points == pytest.approx(THREE)


def test_units_scale_the_camera_of_a_file_and_not_the_one_given_in_metres(tmp_path):
    padded_pcd(tmp_path / "a.pcd", "binary")
    (own,) = read_recording([tmp_path / "a.pcd"], view=CloudView(units="mm")).clouds
    assert own.points == pytest.approx(1e-3 * THREE)
    assert own.camera == pytest.approx([0.1, 0.2, 0.3])
    given = CloudView(units="mm", camera=(1.0, 2.0, 3.0))
    assert read_recording([tmp_path / "a.pcd"], view=given).clouds[0].camera.tolist() == [1, 2, 3]


def test_colours_of_an_array_choose_its_points(tmp_path):
    grey = [90.0, 90.0, 90.0]
    np.save(tmp_path / "a.npy", np.hstack([THREE, [RED, grey, RED]]))
    (found,) = read_recording([tmp_path / "a.npy"], view=CloudView(color=RED)).clouds
    assert found.points == pytest.approx(THREE[[0, 2]])


PLY = ["ply", "format ascii 1.0", "element vertex 1", *(f"property float {a}" for a in "xyz")]


def test_lines_of_a_ply_file_may_end_as_on_windows(tmp_path):
    (tmp_path / "a.ply").write_bytes("\r\n".join([*PLY, "end_header", "1 2 3", ""]).encode())
    assert read_recording([tmp_path / "a.ply"]).clouds[0].points.tolist() == [[1, 2, 3]]


@pytest.mark.parametrize("missing", ["format", "element", "property float z"])
def test_a_ply_file_that_lacks_a_line_of_its_header(missing, tmp_path):
    lines = [line for line in PLY if not line.startswith(missing)]
    (tmp_path / "a.ply").write_text("\n".join([*lines, "end_header\n1 2 3\n"]))
    with pytest.raises(MeasurementError, match=r"^a\.ply: [^:]+.*\n  Try: "):
        read_recording([tmp_path / "a.ply"])


@pytest.mark.parametrize(("length", "diameter"), [(0.9, 0.007), (2.0, 0.02)])
def test_a_cloud_of_too_few_points(length, diameter):
    """Fewer than five per centimetre give no mean: of 150 points at most one centimetre did."""
    random = np.random.default_rng(0)
    points = np.zeros((150, 3))
    points[:, 0] = np.linspace(0.0, length, 150)
    points[:, 1:] = 0.1 * diameter * random.standard_normal((150, 2))
    cable = KnownCable(np.zeros(3), np.array([length, 0.0, 0.0]), diameter, length)
    with pytest.raises(VisionError, match=r"have the 5 points per cm .* Try: "):
        line_in_cloud(points, cable, None)


def test_clouds_from_two_sides_are_not_moved_along_one_line_of_sight(clouds, take):
    """The second camera sees the cable's other side: its clouds are left out, which is said."""
    streams = [Stream(name, "body", take.t, x) for name, x in take.bodies.items()]
    seen, random = [], np.random.default_rng(1)
    for k, (points, colors) in enumerate(clouds):
        middle = SHAPES[POSES[k].name].mean(axis=0)
        other, painted = depth_cloud(SHAPES[POSES[k].name], 0.0035, 2 * middle - PLACE, UP, random)
        t = k * (HOLD + MOVE) + 0.5 * HOLD
        seen.append(Cloud(points[of_color(colors, CABLE)], None, PLACE, t))
        seen.append(Cloud(other[of_color(painted, CABLE)], None, 2 * middle - PLACE, t))
    known = {"length": 0.9, "diameter": 0.007}
    session = make_session("loom", Recording((*streams,), (*seen,)), Wishes(known=known))
    sight = (PLACE - SHAPES[POSES[0].name].mean(axis=0)) / 1.2
    off = errors(session.points["pose_01.csv"][0], POSES[0].name)
    assert abs((off @ sight).mean()) < 0.15e-3
    assert "1 cloud from another place of the camera left out" in session.poses[0]["remark"]


def test_options_for_markers_are_refused_beside_clouds(take):
    streams = [Stream(name, "body", take.t, x) for name, x in take.bodies.items()]
    recording = Recording((*streams,), (Cloud(np.zeros((1, 3))),))
    with pytest.raises(MeasurementError, match=r"--cable and --at tell of markers, .*\n  Try: "):
        make_session("loom", recording, Wishes(cable="m", at=(0.1, 0.2)))


def test_packed_colours_may_have_an_opacity():
    """As PCL and depth cameras write them: the first byte is the opacity."""
    table = np.zeros(2, [("x", "f4"), ("y", "f4"), ("z", "f4"), ("rgba", "u4")])
    table["rgba"] = 0xFF102030
    assert cloud_of(table).colors == pytest.approx(np.tile([16.0, 32.0, 48.0], (2, 1)))


def test_a_cloud_of_a_whole_room_is_refused_before_memory_ends():
    x, y = np.meshgrid(np.arange(0.0, 2.0, 0.005), np.arange(0.0, 2.0, 0.005))
    wall = np.stack([x, y, np.ones_like(x)], axis=-1).reshape(-1, 3)
    cable = KnownCable(np.zeros(3), None, 0.007, 0.9)
    with pytest.raises(VisionError, match=r"160000 points fill \d+ cubes .* Try: --color or --box"):
        line_in_cloud(wall, cable, None)


def test_the_axis_of_a_gripper_is_not_that_of_the_nearest_points():
    """The line begins 3 mm beside the gripper, where the direction to it is across the cable."""
    line = np.column_stack([np.linspace(0.0, 0.9, 91), np.full(91, 0.003), np.zeros(91)])
    remarks: list[str] = []
    start = Gripper(np.zeros((1, 3)), np.eye(3)[None])
    end = Gripper(np.array([[0.9, 0.0, 0.0]]), np.eye(3)[None])
    for gripper in along_cable(start, end, [line], remarks)[:2]:
        assert gripper.frames[0, :, 0] == pytest.approx([1.0, 0.0, 0.0])
    assert "its x axis is taken along the cable (3 degrees off" in remarks[0]
