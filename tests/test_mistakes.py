"""The commonest mistakes at a test stand: each is named, with what to do about it."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from dlo_casadi.cli import main
from dlo_casadi.config import dump_yaml, read_yaml
from dlo_casadi.io.points import read_points, write_points

ROOT = Path(__file__).parents[1]
BENCH = ROOT / "tests/data/bench"
Data = dict[str, Any]


class Session:
    """Part of a session of the repository in a folder of its own, to make mistakes in."""

    def __init__(self, folder: Path, source: Path, count: int) -> None:
        self.folder = folder
        self.data: Data = read_yaml(source)
        self.poses = self.data["experiment"]["poses"] = self.data["experiment"]["poses"][:count]
        for pose in self.poses:
            file = source.parent / pose["file"]
            pose["file"] = file.name
            if file.suffix == ".csv":
                points = read_points(file, pose["start"], pose.get("end")).points
                write_points(folder / file.name, points)
            else:
                (folder / file.name).write_bytes(file.read_bytes())

    def points(self, change: Callable[[np.ndarray], np.ndarray]) -> None:
        """Change the points of all centre-lines."""
        for pose in self.poses:
            points = read_points(self.folder / pose["file"], (0, 0)).points
            write_points(self.folder / pose["file"], change(points))

    def image(self, change: Callable[[np.ndarray], np.ndarray]) -> None:
        """Change all photographs."""
        for pose in self.poses:
            picture = cv2.imread(str(self.folder / pose["file"]))
            pose["file"] = Path(pose["file"]).stem + ".bmp"
            cv2.imwrite(str(self.folder / pose["file"]), change(picture))

    def files(self, order: Callable[[list[str]], list[str]]) -> None:
        """Change which file belongs to which pose."""
        names = order([pose["file"] for pose in self.poses])
        for pose, name in zip(self.poses, names, strict=True):
            pose["file"] = name

    def check(self) -> int:
        path = self.folder / "rope.yaml"
        path.write_text(dump_yaml(self.data))
        return main(["check", str(path), "--quiet"])


def lines(folder: Path, name: str = "short_clean", count: int = 6) -> Session:
    return Session(folder, BENCH / name / "session.yaml", count)


def photographs(folder: Path, count: int = 1) -> Session:
    return Session(folder, BENCH / "orange/session.yaml", count)


def misspelt_key(folder: Path) -> Session:
    session = lines(folder)
    session.data["cable"]["lenght"] = session.data["cable"].pop("length")
    return session


def missing_file(folder: Path) -> Session:
    session = lines(folder)
    session.poses[2]["file"] = "pose_3.csv"
    return session


def no_cable(folder: Path) -> Session:
    """The board alone: the median of photographs in which the cable lies elsewhere each time."""
    session = photographs(folder, 5)
    pictures = [cv2.imread(str(folder / pose["file"])) for pose in session.poses]
    board = np.median(pictures, axis=0).astype(np.uint8)
    session.poses[:] = session.poses[:1]
    session.image(lambda _: board)
    return session


def no_markers(folder: Path) -> Session:
    session = photographs(folder)
    session.image(lambda picture: np.full_like(picture, 90))
    return session


def one_marker_covered(folder: Path) -> Session:
    session = photographs(folder)

    def covered(picture: np.ndarray) -> np.ndarray:
        picture[540:720, 800:1000] = 70
        return picture

    session.image(covered)
    return session


def mirrored_photograph(folder: Path) -> Session:
    session = photographs(folder)
    session.image(lambda picture: picture[:, ::-1])
    return session


def markers_with_y_down(folder: Path) -> Session:
    session = photographs(folder)
    centers = session.data["experiment"]["measurement"]["board"]["marker_centers"]
    for number, (x, y) in centers.items():
        centers[number] = [x, -y]
    return session


def end_too_far(folder: Path) -> Session:
    session = lines(folder)
    session.poses[1]["end"] = [0.6, 0.1]
    return session


def length_in_millimetres(folder: Path) -> Session:
    session = lines(folder)
    session.data["cable"]["length"] *= 1e3
    return session


def length_of_a_short_cable_in_millimetres(folder: Path) -> Session:
    session = lines(folder)
    session.points(lambda points: 0.1 * points)
    for pose in session.poses:
        pose["end"] = [0.1 * x for x in pose["end"]]
    session.data["cable"] |= {"length": 55.0, "diameter": 0.002}
    return session


def ends_in_millimetres(folder: Path) -> Session:
    session = lines(folder)
    for pose in session.poses:
        pose["end"] = [1e3 * x for x in pose["end"]]
    return session


def points_in_millimetres(folder: Path) -> Session:
    session = lines(folder)
    session.points(lambda points: 1e3 * points)
    return session


def points_in_centimetres(folder: Path) -> Session:
    session = lines(folder)
    session.points(lambda points: 1e2 * points)
    return session


def mass_in_grams(folder: Path) -> Session:
    session = lines(folder)
    session.data["cable"]["mass"] *= 1e3
    return session


def points_with_y_down(folder: Path) -> Session:
    session = lines(folder)
    session.points(lambda points: points * [1, -1])
    return session


def points_with_rows_of_a_picture(folder: Path) -> Session:
    session = lines(folder)
    session.points(lambda points: [0.4, 0.9] + points * [1, -1])
    return session


def points_with_y_down_between_ends_of_one_height(folder: Path) -> Session:
    session = Session(folder, ROOT / "configs/white_wire.yaml", 1)
    session.points(lambda points: points * [1, -1])
    return session


def gravity_with_y_down(folder: Path) -> Session:
    session = lines(folder, count=3)
    session.data["experiment"]["gravity"] = [0.0, 9.81]
    return session


def gravity_upwards_on_a_clamped_loop(folder: Path) -> Session:
    session = Session(folder, ROOT / "configs/white_wire.yaml", 2)
    session.data["experiment"]["gravity"] = [0.0, 9.81]
    return session


def board_hung_on_its_side(folder: Path) -> Session:
    session = lines(folder, count=3)
    session.points(lambda points: points @ [[0, 1], [-1, 0]])
    for pose in session.poses:
        x, y = pose["end"]
        pose["end"] = [-y, x]
    return session


def x_and_y_exchanged(folder: Path) -> Session:
    session = lines(folder)
    session.points(lambda points: points[:, ::-1])
    return session


def points_turned_by_90_degrees(folder: Path) -> Session:
    session = lines(folder)
    session.points(lambda points: points @ [[0, 1], [-1, 0]])
    return session


def points_turned_by_180_degrees(folder: Path) -> Session:
    session = lines(folder)
    session.points(lambda points: -points)
    return session


def another_origin(folder: Path) -> Session:
    session = lines(folder)
    session.points(lambda points: points + np.array([0.25, 0.5]))
    return session


def with_reference(folder: Path, change: Callable[[np.ndarray], np.ndarray]) -> Session:
    session = Session(folder, ROOT / "configs/black_wire_photo.yaml", 1)
    session.image(change)
    return session


def photograph_turned_by_180_degrees(folder: Path) -> Session:
    return with_reference(folder, lambda picture: np.rot90(picture, 2))


def photograph_turned_by_90_degrees(folder: Path) -> Session:
    return with_reference(folder, np.rot90)


def a_smaller_photograph(folder: Path) -> Session:
    return with_reference(folder, lambda picture: picture[::2, ::2])


def a_photograph_of_half_the_size(folder: Path) -> Session:
    session = photographs(folder)
    session.image(lambda picture: picture[::2, ::2])
    return session


def a_photograph_of_a_board_turned_by_90_degrees(folder: Path) -> Session:
    session = photographs(folder)
    session.image(np.rot90)
    return session


def files_one_further(folder: Path) -> Session:
    session = lines(folder)
    session.files(lambda names: names[1:] + names[:1])
    return session


def two_files_exchanged(folder: Path) -> Session:
    session = lines(folder)
    session.files(lambda names: [names[0], names[3], names[2], names[1], *names[4:]])
    return session


def photographs_one_further(folder: Path) -> Session:
    session = photographs(folder, 3)
    session.files(lambda names: names[1:] + names[:1])
    return session


def start_and_end_exchanged(folder: Path) -> Session:
    session = lines(folder)
    pose = session.poses[4]
    pose["start"], pose["end"] = pose["end"], pose["start"]
    return session


def text_in_a_file(text: str) -> Callable[[Path], Session]:
    def session(folder: Path) -> Session:
        made = lines(folder)
        (folder / made.poses[1]["file"]).write_text(text)
        return made

    return session


def the_same_file_twice(folder: Path) -> Session:
    session = lines(folder)
    session.poses[3]["file"] = session.poses[1]["file"]
    return session


def a_copied_file(folder: Path) -> Session:
    session = lines(folder)
    first, copy = session.poses[1], session.poses[3]
    (folder / copy["file"]).write_text((folder / first["file"]).read_text())
    copy["end"] = first["end"]
    return session


# The mistake, and what its message says of the mistake and of the remedy.
MISTAKES: list[tuple[Callable[[Path], Session], list[str]]] = [
    (misspelt_key, ["line 1", "unknown key 'lenght' in cable", "did you mean 'length'?"]),
    (missing_file, ["pose_3.csv does not exist", "did you mean pose_03.csv?"]),
    (no_cable, ["no cable found", "is the cable in the picture"]),
    (no_markers, ["board not found: no marker at all", "the right dictionary; markers flat"]),
    (mirrored_photograph, ["board not found", "The picture is mirrored"]),
    (markers_with_y_down, ["off their declared places", "With y pointing up in marker_centers"]),
    (end_too_far, ["is 0.6083 m from the start; the cable is 0.55 m long", "in metres?"]),
    (length_in_millimetres, ["length: 550 m: units are SI, did you mean 0.55?"]),
    (length_of_a_short_cable_in_millimetres, ["looks like millimetres", "cable.length: 0.055"]),
    (ends_in_millimetres, ["no pose to fit is left", "Did you mean (0.433, 0.0073)?"]),
    (points_in_millimetres, ["are the points in metres?", "divide them by 1000"]),
    (points_in_centimetres, ["look like centimetres", "write them in metres"]),
    (mass_in_grams, ["mass: 200 kg for 0.55 m: units are SI, did you mean 0.2?"]),
    (points_with_y_down, ["but do", "with y pointing down", "x to the right and y up"]),
    (points_with_rows_of_a_picture, ["with y pointing down", "rows count downwards"]),
    (points_with_y_down_between_ends_of_one_height, ["with y pointing down instead of up"]),
    (gravity_with_y_down, ["does not hang along gravity (0, 9.81)", "with gravity (0, -9.81)"]),
    pytest.param(
        gravity_upwards_on_a_clamped_loop,
        ["does not hang along gravity (0, 9.81)", "with gravity (0, -9.81)"],
        marks=pytest.mark.long,
    ),
    (board_hung_on_its_side, ["does not hang along gravity", "with gravity (9.81, 0)"]),
    (x_and_y_exchanged, ["with x and y exchanged", "in one frame"]),
    (points_turned_by_90_degrees, ["turned by 90 degrees counter-clockwise", "in one frame"]),
    (points_turned_by_180_degrees, ["turned by 180 degrees", "in one frame"]),
    (another_origin, ["all lines lie (0.2", "from the same origin"]),
    (photograph_turned_by_180_degrees, ["once the photograph is turned by 180 degrees"]),
    (a_smaller_photograph, ["outside of the picture", "made smaller since"]),
    (
        a_photograph_of_half_the_size,
        ["(641.3, 358.1) px, is not that of this picture of 640 x 360 px", "cx, cy over 2."],
    ),
    (a_photograph_of_a_board_turned_by_90_degrees, ["of 720 x 1280 px", "turned by 90 degrees"]),
    (files_one_further, ["pose_02 shows the ends of pose_03", "1 further", "in step"]),
    (two_files_exchanged, ["2 of 6 files", "pose_04 shows the ends of pose_02", "in step"]),
    (photographs_one_further, ["pose_02 shows the ends of pose_03", "in step"]),
    (start_and_end_exchanged, ["pose_05: its end (0, 0) m", "are start and end exchanged?"]),
    (text_in_a_file("x_m,y_m\n0,0\n0.1,nan\n"), ["line 3: 'nan' is not a finite number", "gaps"]),
    (text_in_a_file("x_m,y_m\n0,0\n"), ["holds one point only; a pose takes two"]),
    (text_in_a_file("x,y\n0,0\n1,0\n"), ["the header must be x_m,y_m (metres)"]),
    (the_same_file_twice, ["is called 'pose_02' too", "give each its own"]),
    (a_copied_file, ["pose_04 holds exactly the points of pose_02", "under two names?"]),
]


# A photograph that is turned the other way is read twice more.
LONG = pytest.param(
    photograph_turned_by_90_degrees,
    ["is turned by 90 degrees clockwise"],
    marks=pytest.mark.long,
)


@pytest.mark.parametrize(
    ("mistake", "said"), [*MISTAKES, LONG], ids=lambda item: getattr(item, "__name__", "")
)
def test_a_mistake_is_named_with_its_remedy(mistake, said, tmp_path, capsys):
    assert mistake(tmp_path).check() == 2
    text = capsys.readouterr().err
    for part in said:
        assert part in text, text
    assert "Traceback" not in text


def test_the_fit_refuses_what_contradicts_it_and_can_be_overruled(tmp_path, capsys):
    session = points_with_y_down(tmp_path)
    assert session.check() == 2
    capsys.readouterr()
    config = tmp_path / "rope.yaml"

    command = ["fit", str(config), "--quiet", "--jobs", "1", "--output", str(tmp_path / "out")]
    assert main(command) == 2
    said = capsys.readouterr().err
    assert "with y pointing down" in said
    assert "`estimation: {plausibility: false}` fits nevertheless" in said


def test_a_lost_marker_is_told_but_no_mistake(tmp_path, capsys):
    session = one_marker_covered(tmp_path)
    config = tmp_path / "rope.yaml"
    config.write_text(dump_yaml(session.data))

    assert main(["check", str(config)]) == 0
    out = " ".join(capsys.readouterr().out.split())
    assert "not found; 3 of 4 are used" in out
