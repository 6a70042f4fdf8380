"""Centre-lines as CSV: order, repeated points, and messages that name file and line."""

from pathlib import Path

import numpy as np
import pytest

from dlo_casadi.config import Centerlines, load_config
from dlo_casadi.errors import MeasurementError, OutputError
from dlo_casadi.io.points import read_points, write_points

ROOT = Path(__file__).parents[1]
START, END = (0.0, 0.0), (0.5, 0.1)
LINE = np.array([[0.0, 0.0], [0.2, -0.1], [0.35, -0.05], [0.5, 0.1]])


def csv(folder: Path, text: str) -> Path:
    path = folder / "pose.csv"
    path.write_text(text)
    return path


@pytest.mark.parametrize(
    "path",
    sorted([*ROOT.glob("configs/*.yaml"), *ROOT.glob("tests/data/bench/*/session.yaml")]),
    ids=lambda p: f"{p.parent.name}/{p.stem}",
)
def test_centerlines_of_the_repository(path):
    """Each starts within 3 % of the length from the start; noise makes it 5 % longer at most."""
    config = load_config(path)
    if not isinstance(config.experiment.measurement, Centerlines):
        pytest.skip("photographs")
    for pose in config.experiment.poses:
        read = read_points(pose.paths[0], pose.start, pose.end)
        points, before = read.points, 0.0 if read.s is None else read.s[0]
        assert points.shape[1] == len(pose.start)
        assert np.linalg.norm(points[0] - pose.start) < before + 0.03 * config.cable.length
        along = np.linalg.norm(np.diff(points, axis=0), axis=1).sum()
        assert 0.5 * config.cable.length < along < 1.05 * config.cable.length


def test_round_trip_is_exact(tmp_path):
    points = np.random.default_rng(0).normal(size=(50, 2))
    write_points(tmp_path / "a.csv", points)
    np.testing.assert_array_equal(read_points(tmp_path / "a.csv", points[0]).points, points)
    assert (tmp_path / "a.csv").read_text().startswith("x_m,y_m\n")
    assert [path.name for path in tmp_path.iterdir()] == ["a.csv"]


def test_a_reversed_file_is_put_right(tmp_path):
    write_points(tmp_path / "a.csv", LINE[::-1])
    np.testing.assert_array_equal(read_points(tmp_path / "a.csv", START, END).points, LINE)
    np.testing.assert_array_equal(read_points(tmp_path / "a.csv", START).points, LINE)


@pytest.mark.parametrize("reverse", [False, True])
def test_order_of_the_second_half_of_a_loop(tmp_path, reverse):
    """Its last point is nearer to the start fixture than its first one, but sits at the end."""
    angle = np.linspace(np.pi, 1.9 * np.pi, 20)
    half = np.column_stack((1 - np.cos(angle), -np.sin(angle)))
    write_points(tmp_path / "a.csv", half[::-1] if reverse else half)
    points = read_points(tmp_path / "a.csv", (0.0, 0.0), tuple(half[-1])).points
    np.testing.assert_array_equal(points, half)


def test_repeated_points_spaces_and_blank_lines(tmp_path):
    path = csv(
        tmp_path, "\ufeffx_m, y_m\r\n0,0\r\n 0 , 0\r\n1e-1,0.1\r\n0.1,0.1\r\n\r\n0.5,0.1\r\n"
    )
    points = read_points(path, START, END).points
    np.testing.assert_array_equal(points, [[0, 0], [0.1, 0.1], [0.5, 0.1]])


def test_markers_in_the_order_of_their_arc_lengths(tmp_path):
    path = csv(tmp_path, "s_m,x_m,y_m\n0.4,0.3,0.1\n0.1,0.1,0\n")
    read = read_points(path, START, END, 0.4)
    np.testing.assert_array_equal(read.s, [0.1, 0.4])
    np.testing.assert_array_equal(read.points, [[0.1, 0], [0.3, 0.1]])
    write_points(tmp_path / "b.csv", read.points, read.s)
    again = read_points(tmp_path / "b.csv", START)
    np.testing.assert_array_equal(
        np.column_stack([again.s, again.points]), [[0.1, 0.1, 0], [0.4, 0.3, 0.1]]
    )


def test_points_in_space(tmp_path):
    points = np.array([[0.0, 0.1, 0.2], [0.3, 0.1, 0.0]])
    write_points(tmp_path / "a.csv", points)
    read = read_points(tmp_path / "a.csv", (0.3, 0.0, 0.0))
    np.testing.assert_array_equal(read.points, points[::-1])
    with pytest.raises(MeasurementError, match=r"must be x_m,y_m .*found 'x_m,y_m,z_m'"):
        read_points(tmp_path / "a.csv", START)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("s_m,x_m,y_m\n0.1,0,0\n0.1,1,1\n", "s_m 0.1 m stands twice"),
        ("s_m,x_m,y_m\n0.1,0,0\n0.6,1,1\n", r"s_m 0.6 m is not between 0 and cable\.length 0.5 m"),
        ("s_m,x_m,y_m\n-0.1,0,0\n0.3,1,1\n", "s_m -0.1 m is not between 0"),
        ("s_m,x_m,y_m\n0.1,0,0\n0.3,1\n", "line 3: three numbers s,x,y belong here"),
        ("s_m,x_m,y_m\n0.1,0,0\n", "holds one point only"),
        ("", "pose.csv: is empty; a header x_m,y_m and points belong here"),
        ("x_m,y_m\n", "pose.csv: has a header but no points"),
        ("x_m,y_m\n0,0\n", "pose.csv: holds one point only"),
        ("x_m,y_m\n1,1\n1,1\n1,1\n", "pose.csv: holds one point only"),
        (
            "0,0\n1,1\n",
            r"line 1: the header must be x_m,y_m \(metres\), or s_m,x_m,y_m .*, found '0,0'",
        ),
        ("x_mm,y_mm\n0,0\n1,1\n", "line 1: the header must be x_m,y_m .*'x_mm,y_mm'"),
        ("y_m,x_m,y_m\n0,0,0\n1,1,1\n", "line 1: two columns are called y_m: leave one"),
        ("x_m,y_m\n0,0\nnan,1\n", "line 3: 'nan' is not a finite number; leave out"),
        ("x_m,y_m\n0,0\n\n0,inf\n", "line 4: 'inf' is not a finite number"),
        ("x_m,y_m\n0,0\n1,\n", "line 3: '' is not a number"),
        ("x_m,y_m\n0,0\n1,here\n", "line 3: 'here' is not a number"),
        ("x_m,y_m\n0,0\n0,5,1,2\n", "line 3: two numbers x,y belong here, found 4: '0,5,1,2'"),
        ("x_m,y_m\n0,0\n1\n", "line 3: two numbers x,y belong here, found 1"),
        ("x_m,y_m\n0,0\n1," + 200_000 * "1" + "\n", "line 3: '1+... is not a finite number"),
        ("x_m,y_m\n0,0\n1," + 9000 * "x" + "\n", r"line 3: 'x+\.\.\. is not a number of y_m; "),
        ("x_m,y_m\n" + 3_000_000 * "0.1,0.2", "is larger than 20000000 bytes; keep every tenth"),
        ("x_m,y_m\n0,0\n300,0\n508,101\n", r"531.2 m long: are the points in metres\?"),
    ],
)
def test_a_bad_file_is_named_with_its_line(tmp_path, text, message):
    with pytest.raises(MeasurementError, match=message) as caught:
        read_points(csv(tmp_path, text), START, END, 0.5)
    assert caught.value.pose == "pose.csv"


def test_a_file_that_cannot_be_read(tmp_path):
    with pytest.raises(MeasurementError, match=r"none.csv: cannot be read: No such file"):
        read_points(tmp_path / "none.csv", START)
    (tmp_path / "photo.csv").write_bytes(b"\xff\xd8\xff\xe0\0\x10JFIF\0")
    with pytest.raises(MeasurementError, match=r"photo.csv: is not a text file"):
        read_points(tmp_path / "photo.csv", START)


def test_writing_keeps_the_old_file_if_it_fails(tmp_path):
    path = tmp_path / "a.csv"
    write_points(path, LINE)
    with pytest.raises(MeasurementError, match=r"point 1 is .* not finite"):
        write_points(path, [[0, 0], [np.nan, 1]])
    with pytest.raises(MeasurementError, match=r"points of shape \(3,\)"):
        write_points(path, [1, 2, 3])
    np.testing.assert_array_equal(read_points(path, START).points, LINE)
    with pytest.raises(OutputError, match="cannot be written: there is no folder"):
        write_points(tmp_path / "none" / "a.csv", LINE)
    assert [file.name for file in tmp_path.iterdir()] == ["a.csv"]
