"""Calibrations as ROS, OpenCV and Kalibr write them, and boards that are printed otherwise.

Each is read as what it means, or refused with the cause and what to do; and nothing is written.
"""

import json
import re

import cv2
import numpy as np
import pytest
from files import tree

from dlo_casadi.cli import main
from dlo_casadi.config import load_config
from dlo_casadi.errors import ConfigError, VisionError
from dlo_casadi.vision import Board, locate_board

MATRIX = ((915.0, 0.0, 641.5), (0.0, 914.0, 358.25), (0.0, 0.0, 1.0))
LENS = (-0.03, 0.01, 0.001, -0.002, 0.0)
FLAT = "[915.0, 0., 641.5, 0, 9.14e+02, 358.25, 0., 0., 1.]"
TERMS = "[-0.03, 0.01, 1.e-03, -0.002, 0.]"

ROS = f"""\
image_width: 1280
image_height: 720
camera_name: phone
camera_matrix:
  rows: 3
  cols: 3
  data: {FLAT}
distortion_model: plumb_bob
distortion_coefficients:
  rows: 1
  cols: 5
  data: {TERMS}
rectification_matrix: {{rows: 3, cols: 3, data: [1, 0, 0, 0, 1, 0, 0, 0, 1]}}
projection_matrix: {{rows: 3, cols: 4, data: [915, 0, 641, 0, 0, 914, 358, 0, 0, 0, 1, 0]}}
"""
OPENCV = f"""\
%YAML:1.0
---
calibration_time: "Mon 03 Mar 2025 10:11:12 CET"
nframes: 25
image_width: 1280
flags: 0
camera_matrix: !!opencv-matrix
   rows: 3
   cols: 3
   dt: d
   data: {FLAT}
distortion_coefficients: !!opencv-matrix
   rows: 5
   cols: 1
   dt: d
   data: {TERMS}
avg_reprojection_error: 2.3e-01
"""
XML = f"""\
<?xml version="1.0"?>
<opencv_storage>
<nframes>25</nframes>
<Camera_Matrix type_id="opencv-matrix"><rows>3</rows><cols>3</cols><dt>d</dt>
  <data>{re.sub(r"[][,]", " ", FLAT)}</data></Camera_Matrix>
<Distortion_Coefficients type_id="opencv-matrix"><rows>5</rows><cols>1</cols><dt>d</dt>
  <data>{re.sub(r"[][,]", " ", TERMS)}</data></Distortion_Coefficients>
</opencv_storage>
"""
KALIBR = """\
cam0:
  cam_overlaps: []
  camera_model: pinhole
  distortion_coeffs: [-0.03, 0.01, 0.001, -0.002]
  distortion_model: radtan
  intrinsics: [915.0, 914.0, 641.5, 358.25]
  resolution: [1280, 720]
  rostopic: /cam0/image_raw
"""
LISTS = [[list(row) for row in MATRIX], [list(LENS)]]

READ = {
    "a file of ROS": ROS,
    "a file of OpenCV": OPENCV,
    "its XML": XML,
    "a file of Kalibr": KALIBR,
    "nested lists, as NumPy has them": json.dumps({"mtx": LISTS[0], "dist": LISTS[1]}),
    "OpenCV's JSON": json.dumps(
        {
            "cameraMatrix": {
                "type_id": "opencv-matrix",
                "rows": 3,
                "cols": 3,
                "data": np.ravel(MATRIX).tolist(),
            },
            "distCoeffs": {"type_id": "opencv-matrix", "rows": 1, "cols": 5, "data": list(LENS)},
        }
    ),
    "four numbers of a depth camera": "{fx: 915, fy: 914, ppx: 641.5, ppy: 358.25, "
    f"model: Brown Conrady, coeffs: {TERMS}}}",
    "terms by their names": "{fx: 915, fy: 914, cx: 641.5, cy: 358.25, k1: -0.03, k2: 0.01, "
    "p1: 0.001, p2: -0.002}",
    "messages of ROS as they are printed": "header: {frame_id: cam}\nbinning_x: 0\n"
    f"distortion_model: plumb_bob\nD: {TERMS}\nK: {FLAT}\nR: []\n---\nD: {TERMS}\nK: {FLAT}\n---\n",
    "our own keys": f"{{matrix: {LISTS[0]}, distortion: {TERMS}}}",
    "a file that was saved on Windows": OPENCV.replace("\n", "\r\n"),
}

SESSION = """\
cable: {name: rope, length: 0.8, mass: 0.05, diameter: 0.005, bending_stiffness: 0.05}
experiment:
  gravity: [0.0, -9.81]
  boundary: {start: pinned, end: pinned}
  measurement:
    kind: images
    camera: CAMERA
    board:
      dictionary: DICT_4X4_50
      marker_size: 0.08
      marker_centers: {0: [0, 0], 1: [1, 0], 2: [0, -0.6], 3: [1, -0.6]}
  poses:
    - {file: a.jpg, start: [0, 0], end: [0.4, -0.1], role: fit}
    - {file: b.jpg, start: [0, 0], end: [0.5, -0.1], role: fit}
"""


def session(folder, camera):
    for name in ("a.jpg", "b.jpg"):
        (folder / name).write_bytes(b"")
    (folder / "rope.yaml").write_text(SESSION.replace("CAMERA", camera))
    return folder / "rope.yaml"


@pytest.mark.parametrize("name", READ)
def test_a_calibration_is_read_from_its_file(name, tmp_path):
    (tmp_path / "camera.yaml").write_text(READ[name])
    camera = load_config(session(tmp_path, "camera.yaml")).experiment.measurement.camera
    assert camera.matrix == MATRIX
    assert camera.distortion[:4] == LENS[:4]
    assert not any(camera.distortion[4:])


@pytest.mark.parametrize(
    "name", ["a file of ROS", "a file of Kalibr", "OpenCV's JSON", "our own keys"]
)
def test_a_calibration_is_read_where_it_is_pasted(name, tmp_path):
    text = READ[name].removeprefix("cam0:\n")
    pasted = text if "\n" not in text else "\n" + re.sub(r"(?m)^(?=.)", " " * 6, text)
    camera = load_config(session(tmp_path, pasted)).experiment.measurement.camera
    assert camera.matrix == MATRIX
    assert camera.distortion[:4] == LENS[:4]


def test_a_file_may_stand_below_its_key(tmp_path):
    (tmp_path / "camera.yaml").write_text(ROS)
    camera = load_config(session(tmp_path, "{file: camera.yaml}")).experiment.measurement.camera
    assert camera.matrix == MATRIX


FISHEYE = r"of a fisheye lens, which is not supported. Try: rectify the photographs first"
REFUSED = {
    "Kalibr's equidistant lens": (KALIBR.replace("radtan", "equidistant"), FISHEYE),
    "a fisheye lens of ROS": (ROS.replace("plumb_bob", "fisheye"), FISHEYE),
    "OpenCV's fisheye model": (OPENCV.replace("flags: 0", "fisheye_model: 1"), FISHEYE),
    "an omnidirectional camera": (KALIBR.replace("pinhole", "omni"), FISHEYE),
    "an unknown lens": (ROS.replace("plumb_bob", "poly9"), "'poly9' is not known. Try: plumb_bob"),
    "two cameras": (KALIBR + KALIBR.replace("cam0", "cam1"), "holds 2 cameras .cam0, cam1.. Try: "),
    "a stereo pair": (f"M1: {FLAT}\nM2: {FLAT}\n", r"holds 2 cameras \(M1, M2\). Try: a file with"),
    "no matrix": (
        "camera: phone\n",
        "holds no camera matrix; its keys are camera. Try: camera_mat",
    ),
    "no lens": (f"camera_matrix: {FLAT}\n", r"holds no distortion; .*Try: `distortion: \[\]`"),
    "broken XML": (XML.replace("</opencv_storage>", ""), "not valid XML .line 9.. Try: "),
    "broken YAML": ("a: [1, 2\nb: 3\n", "not valid YAML"),
    "a picture": ("\xff\xd8\xff", "a mapping with a camera matrix belongs there, found text"),
    "six terms": (ROS.replace("0.]\nrect", "0., 1]\nrect"), "found 6 numbers; OpenCV knows 4, 5"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_a_calibration_is_refused_with_cause_and_remedy(name, tmp_path, capsys):
    content, said = REFUSED[name]
    (tmp_path / "camera.yaml").write_text(content)
    file = session(tmp_path, "camera.yaml")
    before = tree(tmp_path)
    assert main(["check", str(file)]) == 2
    told = " ".join(capsys.readouterr().err.split())
    assert re.search(f"line 7: experiment.measurement.camera.*{said}", told)
    assert "did you mean" not in told
    assert tree(tmp_path) == before


def test_a_fisheye_lens_is_never_taken_for_a_distortion(tmp_path):
    own = READ["our own keys"].replace("}", ", distortion_model: fisheye}")
    with pytest.raises(ConfigError, match=f"line 7: .*{FISHEYE}") as told:
        load_config(session(tmp_path, own))
    assert "did you mean" not in told.value.message


def test_a_calibration_that_is_missing_says_what_belongs_there(tmp_path):
    with pytest.raises(
        ConfigError, match=r"camera_info\.yaml: cannot be read: No such file.* Try: "
    ):
        load_config(session(tmp_path, "camera_info.yaml"))


# ---- boards --------------------------------------------------------------------------------------

BOARD = Board(
    "DICT_4X4_50", 0.09, 0.0, {0: (0.0, 0.0), 1: (1.0, 0.0), 2: (0.0, -0.5), 3: (1.0, -0.5)}
)


def photograph(dictionary, numbers=(0, 1, 2, 3), inverted=False, light=1.0):
    """Markers of 90 px at the places of `BOARD`, with its centre of marker 0 at (100, 100) px."""
    picture = np.full((720, 1280), 200.0)
    markers = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, dictionary))
    for number, (x, y) in zip(numbers, BOARD.marker_centers.values(), strict=True):
        u, v = round(100 + 1000 * x) - 45, round(100 - 1000 * y) - 45
        marker = cv2.aruco.generateImageMarker(markers, number, 90)
        picture[v - 20 : v + 110, u - 20 : u + 110] = 0 if inverted else 200
        picture[v : v + 90, u : u + 90] = 0.78 * (255 - marker if inverted else marker)
    noise = np.random.default_rng(0).normal(0.0, 1.0, picture.shape)
    grey = np.clip(light * cv2.GaussianBlur(picture, (0, 0), 1.0) + noise, 0, 255)
    return np.repeat(grey.astype(np.uint8)[..., None], 3, axis=2)


def test_the_board_itself_is_found():
    assert locate_board(photograph("DICT_4X4_50"), BOARD).numbers == (0, 1, 2, 3)


@pytest.mark.parametrize(
    ("picture", "said"),
    [
        (
            ("DICT_5X5_100",),
            r"shows markers \[0, 1, 2, 3\] of DICT_5X5_50\. Try: board.dictionary: D",
        ),
        (("DICT_6X6_250", (0, 1, 2, 60)), r"markers \[0, 1, 2\] of DICT_6X6_50\. Try: board.dict"),
        (
            ("DICT_APRILTAG_36h11",),
            r"of DICT_APRILTAG_36h11\. Try: board.dictionary: DICT_APRILTAG",
        ),
        (("DICT_7X7_1000", (10, 11, 12, 13)), r"shows markers \[10, 11, 12, 13\] of DICT_7X7_50"),
        (
            ("DICT_4X4_50", (0, 1, 2, 3), True),
            "of DICT_4X4_50, white on black. Try: print them black on white, or invert the colours",
        ),
        (
            ("DICT_5X5_50", (0, 1, 2, 3), True),
            "of DICT_5X5_50, white on black. Try: board.dictionary: DICT_5X5_50; print them black",
        ),
        (("DICT_4X4_50", (0, 1, 2, 3), False, 0.04), "nearly black: 99 % of it are at most 1"),
    ],
    ids=["5x5", "another number", "AprilTag", "other numbers", "inverted", "both", "black"],
)
def test_what_a_picture_shows_in_place_of_the_board_is_named(picture, said):
    with pytest.raises(VisionError, match=said):
        locate_board(photograph(*picture), BOARD)


def test_a_picture_without_markers_suggests_none():
    with pytest.raises(VisionError, match="no marker at all") as told:
        locate_board(np.full((480, 640, 3), 90, np.uint8), BOARD)
    assert "shows markers" not in told.value.message
