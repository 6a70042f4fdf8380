"""Sessions from arrays: all that a configuration file can say, and its words for mistakes."""

import copy
import inspect
import pickle
import re
from dataclasses import fields, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import casadi as ca
import cv2
import numpy as np
import pytest

import dlo_casadi as dlo
from dlo_casadi.config import Config, dump_yaml, load_config, read_yaml
from dlo_casadi.config.template import config_schema
from dlo_casadi.report.page import configuration_text
from dlo_casadi.report.sections import report_dict
from dlo_casadi.report.writer import write_numbers

SCHEMA = config_schema()
KEYS = [field.name for field in fields(Config)]
BENCH = Path(__file__).parent / "data/bench/short_clean"
LINE = [[0.0, 0.0], [0.1, -0.1], [0.3, -0.1]]

# Every key of the schema, in a plane and in space, of lines and of photographs.
CABLE = {
    "name": "loom",
    "length": 0.5,
    "mass": 0.05,
    "diameter": 0.005,
    "rest_shape": "curved",
}
HELD = {
    "role": "fit",
    "start_force": [0.0, 1.0],
    "start_moment": 0.1,
    "end_force": [0.0, 1.0],
    "end_moment": 0.1,
}
OPTIONS = {
    "model": {
        "n": 20,
        "element": "arc",
        "effects": [
            {"name": "lumped_mass", "parameters": {"mass": {"value": 0.01, "fixed": True}}}
        ],
    },
    "estimation": {
        "algorithm1": False,
        "algorithm1_n": 5,
        "algorithm1_inner": "cobyla",
        "robust": True,
        "plausibility": False,
        "rest_curvature_coefficients": 5,
    },
    "diagnosis": {
        "enabled": False,
        "exclude": ["tether"],
        "significance": 0.01,
        "max_effects": 1,
    },
}
IN_PLANE = {
    "cable": CABLE | {"youngs_modulus": 1.0e8, "damping_time": 0.02},
    "experiment": {
        "gravity": [0.0, -9.81],
        "boundary": {"start": "clamped", "end": "clamped"},
        "measurement": {"kind": "centerlines", "std": 1e-3, "force_std": 0.1, "moment_std": 0.01},
        "tolerances": dict.fromkeys(
            (
                *("length", "end", "heading", "rotation", "roll", "scale", "camera_rotation"),
                *("camera_translation", "force_bias", "moment_bias", "clip", "slip", "obstacle"),
                "delay",
            ),
            0.001,
        ),
        "poses": [
            {
                "points": LINE,
                "at": [0.0, 0.15, 0.35],
                "name": "markers",
                "start": [0.0, 0.0],
                "end": [0.4, 0.0],
                "start_heading": 0.1,
                "end_heading": 0.2,
                "branch": "ccw",
                "clips": [
                    {
                        "name": "first",
                        "kind": "clamped",
                        "at": 0.2,
                        "place": [0.18, 0.01],
                        "heading": 0.0,
                        "clip_force": [0.1, -0.2],
                    }
                ],
                **HELD,
            },
        ],
    },
    **OPTIONS,
}
# Recordings: with all that rests as arrays, and with all that moves.
IN_PLANE["experiment"]["motions"] = [
    {
        "t": [0.0, 0.1, 0.2],
        "points": [[0.0, 0.0], [0.0, 0.01], [0.0, 0.02]],
        "at": [0.1, 0.1, 0.1],
        "name": "swing",
        "start": [0.0, 0.0],
        "end": [0.4, 0.0],
        "start_heading": 0.1,
        "end_heading": 0.2,
        "begins": "at_rest",
        "role": "held_out",
    },
    {
        "t": [0.0, 0.1],
        "points": [[0.0, 0.0], [0.0, 0.01]],
        "fixtures": {
            "t": [0.0, 0.5],
            "start": [[0.0, 0.0], [0.1, 0.0]],
            "end": [[0.4, 0.0], [0.5, 0.0]],
            "start_heading": [0.1, 0.1],
            "end_heading": [0.2, 0.2],
        },
    },
]
BOARD = {
    "dictionary": "DICT_4X4_50",
    "marker_size": 0.08,
    "standoff": 0.01,
    "marker_centers": {0: [0.0, 0.0], 1: [0.5, 0.0]},
}
CAMERA = {"matrix": [[900, 0, 320], [0, 900, 240], [0, 0, 1]], "distortion": [0.0] * 5}
FRAME = [0.0, 0.0, 0.0, 1.0]
IN_SPACE = {
    "limits": {"bend_radius": 0.05, "force": 8.0, "moment": 0.5, "twist": 6.0},
    "cable": CABLE | {"bending_stiffness": 0.01, "torsional_stiffness": 0.008},
    "experiment": {
        "gravity": [0.0, 0.0, -9.81],
        "boundary": {"start": "clamped", "end": "clamped"},
        "measurement": {"kind": "images", "camera": CAMERA, "board": BOARD},
        "poses": [
            {
                "files": ["a_1.jpg", "a_2.jpg"],
                "start": [0.0, 0.0, 0.0],
                "end": [0.4, 0.0, 0.0],
                "start_orientation": FRAME,
                "end_orientation": FRAME,
                "turns": 0.5,
                "clips": [
                    {
                        "kind": "clamped",
                        "at": 0.2,
                        "place": [0.18, 0.0, 0.0],
                        "orientation": FRAME,
                        "roll": "free",
                    }
                ],
            },
        ],
    },
}
BY_REFERENCE = {
    "cable": CABLE | {"bending_stiffness": 0.01},
    "experiment": {
        "gravity": [0.0, -9.81],
        "boundary": ["pinned", "free"],
        "measurement": {
            "kind": "images",
            "reference": {"pixels": [[10, 10], [500, 10]], "points": [[0.0, 0.0], [0.5, 0.0]]},
        },
        "obstacles": [
            {
                "name": "table",
                "kind": "plane",
                "point": [0.0, -0.3],
                "normal": [0.0, 1.0],
                "touch": "allowed",
            },
            {"kind": "sphere", "center": [0.2, -0.2], "radius": 0.02},
            {"kind": "capsule", "a": [0.3, -0.2], "b": [0.4, -0.2], "radius": 0.02},
        ],
        "poses": [{"file": "a.jpg", "start": [0.0, 0.0], "over": True}],
    },
    "limits": {"clearance": 0.01},
}
FED = {
    "cable": CABLE | {"bending_stiffness": 0.01, "rest_shape": "straight"},
    "experiment": {
        "gravity": [0.0, -9.81],
        "boundary": {"start": "slide", "end": "slide"},
        "measurement": {"kind": "centerlines"},
        "poses": [
            {
                "file": "fed.csv",
                "start": [0.0, 0.0],
                "end": [0.4, 0.0],
                "start_heading": 0.0,
                "end_heading": 0.1,
                "start_tension": 0.7,
                "end_tension": 0.8,
            }
        ],
    },
}
IN_SPACE["experiment"]["motions"] = [
    {
        "t": [0.0, 0.1],
        "points": [[0.0, 0.0, 0.0], [0.0, 0.01, 0.0]],
        "start_orientation": FRAME,
        "end_orientation": FRAME,
        "fixtures": {
            "t": [0.0, 0.5],
            "start_orientation": [FRAME, FRAME],
            "end_orientation": [FRAME, FRAME],
        },
    }
]
UNKNOWN = copy.deepcopy(FED)
UNKNOWN["experiment"]["boundary"] = {"start": "clamped", "end": "slide"}
for _key in ("start_tension", "end_tension"):
    del UNKNOWN["experiment"]["poses"][0][_key]
UNKNOWN["experiment"]["poses"][0]["free_length"] = 0.5
FED["experiment"]["motions"] = [{"file": "swing.csv"}]
ALL = {
    "in a plane": IN_PLANE,
    "in space": IN_SPACE,
    "by a reference": BY_REFERENCE,
    "fed": FED,
    "fed without a tension": UNKNOWN,
}


def from_arguments(tree: dict[str, Any]) -> dlo.Session:
    """The session of a configuration, with arrays for lists of numbers."""

    def arrays(value: Any) -> Any:
        if isinstance(value, dict):
            return {key: arrays(item) for key, item in value.items()}
        numbers = isinstance(value, list) and np.asarray(value).dtype.kind in "fi"
        return np.array(value) if numbers else value

    tree = arrays(copy.deepcopy(tree))
    experiment = tree.pop("experiment")
    measurement = experiment.pop("measurement")
    del measurement["kind"]  # as the files are
    poses = [dlo.Pose(**row) for row in experiment.pop("poses")]
    return dlo.Session(dlo.Cable(**tree.pop("cable")), poses, **experiment, **measurement, **tree)


def leaves(data: Any, at: tuple[str, ...] = ()) -> set[tuple[str, ...]]:
    """Keys that lead to a value, indices left out."""
    if isinstance(data, dict) and not all(isinstance(key, int) for key in data):
        return {leaf for key, item in data.items() for leaf in leaves(item, (*at, str(key)))}
    if isinstance(data, list) and any(isinstance(item, dict) for item in data):
        return {leaf for item in data for leaf in leaves(item, at)}
    return {at}


def of_schema(part: dict[str, Any], at: tuple[str, ...] = ()) -> set[tuple[str, ...]]:
    """Keys that a schema allows."""
    if "$ref" in part:
        part = SCHEMA["$defs"][part["$ref"].rpartition("/")[2]]
    inner = [*part.get("anyOf", ()), *part.get("oneOf", ())]
    inner += [part["items"]] if isinstance(part.get("items"), dict) else []
    if "properties" in part:
        items = part["properties"].items()
        return {leaf for key, item in items for leaf in of_schema(item, (*at, key))}
    if isinstance(part.get("additionalProperties"), dict):  # parameters of an effect, by name
        found = of_schema(part["additionalProperties"], (*at, "*"))
        return found if found != {(*at, "*")} else {at}
    found = {leaf for item in inner for leaf in of_schema(item, at)} - {at}
    return found or {at}


def test_every_key_of_the_schema_is_tried_here():
    tried = {leaf for tree in ALL.values() for leaf in leaves(tree)}
    tried = {tuple("*" if x == "mass" and len(leaf) > 3 else x for x in leaf) for leaf in tried}
    assert of_schema(SCHEMA) <= tried


@pytest.mark.parametrize("name", ALL)
def test_arguments_make_what_a_file_makes(name, tmp_path):
    """Each key; files that are missing are told of in both, and only after all else was right."""
    for picture in ("a.jpg", "a_1.jpg", "a_2.jpg", "fed.csv"):
        (tmp_path / picture).touch()
    tree = copy.deepcopy(ALL[name])
    (pose,) = tree["experiment"]["poses"]
    for key in pose.keys() & {"file", "files"}:
        named = [str(tmp_path / x) for x in np.atleast_1d(pose[key])]
        pose[key] = named[0] if key == "file" else named
    for motion in tree["experiment"].get("motions", ()):
        motion |= {key: str(tmp_path / motion[key]) for key in motion.keys() & {"file"}}
    (tmp_path / "session.yaml").write_text(dump_yaml(tree))
    from_file, session = load_config(tmp_path / "session.yaml"), from_arguments(tree)
    for section in KEYS:
        assert getattr(session, section) == getattr(from_file, section)
    assert session.warnings == from_file.warnings

    (tmp_path / "again.yaml").write_text(session.text)
    again = load_config(tmp_path / "again.yaml")
    assert all(getattr(again, x) == getattr(session, x) for x in KEYS)
    assert pickle.loads(pickle.dumps(session)) == session


def test_every_key_is_an_argument():
    arguments = set(inspect.signature(dlo.Session).parameters)
    keys = {
        *KEYS,
        *IN_PLANE["experiment"],
        *BY_REFERENCE["experiment"],
        *leaves(IN_PLANE["experiment"]["measurement"]),
    }
    keys |= {x[0] for x in leaves(IN_SPACE["experiment"]["measurement"])} | {"reference"}
    keys = {key if isinstance(key, str) else key[0] for key in keys}
    assert arguments == keys - {"experiment", "measurement", "kind"}


NAN = float("nan")
WRONG = {
    "nothing shows it": {"points": None},
    "points of one number": {"points": [0.0, 0.1]},
    "ragged points": {"points": [[0.0, 0.0], [0.1]]},
    "no points": {"points": []},
    "points of text": {"points": [["0", "1"], ["0", "2"]]},
    "points of five numbers": {"points": [[0.0] * 5] * 3},
    "points in space": {"points": [[0.0, 0.0, 0.0], [0.1, 0.0, 0.0]]},
    "a point that was not measured": {"points": [[0.0, 0.0], [NAN, 0.1]]},
    "points in millimetres": {"points": [[0.0, 0.0], [4000.0, 0.0]]},
    "arc lengths of other points": {"at": [0.1, 0.2]},
    "arc lengths that shrink": {"at": [0.35, 0.15, 0.0]},
    "an arc length twice": {"at": [0.0, 0.15, 0.15]},
    "an arc length beyond the cable": {"at": [0.0, 0.15, 0.6]},
    "one point": {"points": [[0.0, 0.0]]},
    "one word for both ends": {"boundary": "pinned"},
    "a place of three numbers": {"end": [0.4, 0.0, 0.1]},
    "an infinite place": {"end": [0.4, float("inf")]},
    "an end out of reach": {"end": [4.0, 0.0]},
    "a quaternion of two": {"start_orientation": [0.0, 1.0]},
    "an unknown role": {"role": "test"},
    "an unknown key": {"rol": "fit"},
    "a force of one number": {"end_force": [1.0]},
    "nothing to fit": {"role": "held_out"},
    "a name with a folder": {"name": "a/b"},
    "no length": {"length": 0.0},
    "a length in millimetres": {"length": 500.0},
    "text for a mass": {"mass": "50 g"},
    "a std of nothing": {"std": 0.0},
    "one number of gravity": {"gravity": 9.81},
    "an unknown boundary": {"boundary": ["pinned", "glued"]},
    "a heading that is missing": {"boundary": ["pinned", "clamped"]},
    "an unknown effect": {"model": {"effects": ["lumped"]}},
    "a tolerance of nothing": {"tolerances": {"length": 0.0}},
    "a number for a section": {"model": 3},
}


OF_SESSION = ("gravity", "boundary", "std", "model", "tolerances")


@pytest.mark.parametrize("case", WRONG)
def test_wrong_arguments_are_told_with_the_words_of_a_file(case, tmp_path):
    """Where it is differs: file and line here, the argument there."""
    cable = {"length": 0.5, "mass": 0.05, "diameter": 0.005, "bending_stiffness": 0.01}
    pose = {"points": LINE, "start": [0.0, 0.0], "end": [0.3, -0.1]}
    rest = {"gravity": [0.0, -9.81], "boundary": ["pinned", "pinned"]}
    for key, value in WRONG[case].items():
        part = cable if key in cable else rest if key in OF_SESSION else pose
        part[key] = value
    pose = {key: value for key, value in pose.items() if value is not None}
    options = {key: rest.pop(key) for key in ("model",) if key in rest}
    measurement = {"kind": "centerlines"} | ({"std": rest["std"]} if "std" in rest else {})
    experiment = {key: value for key, value in rest.items() if key != "std"}
    experiment |= {"measurement": measurement, "poses": [pose]}
    (tmp_path / "session.yaml").write_text(
        dump_yaml({"cable": cable, "experiment": experiment, **options})
    )
    with pytest.raises(dlo.ConfigError) as in_file:
        load_config(tmp_path / "session.yaml")
    with pytest.raises(dlo.ConfigError) as in_python:
        dlo.Session(dlo.Cable(**cable), [dlo.Pose(**pose)], **rest, **options)
    said = re.sub(r"(?m)^.*session.yaml(, line \d+)?: |line \d+: ", "", in_file.value.message)
    assert words_of(said) == words_of(in_python.value.message)


def words_of(message: str) -> set[str]:
    """Lines of a message without the places that begin them."""
    label = r"(cable|experiment|measurement|pose 1( \(\w+\))?|the arguments|the top of the file)"
    lines = re.sub(
        rf" in {label}(\.\w+)*|{label}(\.\w+)*(\[\d\])?[.:]? ?", " ", message
    ).splitlines()
    return {" ".join(re.sub(r"^\s*[\w.]+(\[\d\])*: ", "", line).split()) for line in lines}


@pytest.mark.parametrize(
    ("poses", "message"),
    [
        (dlo.Pose((0, 0), (0.3, -0.1), points=LINE), "poses: a list belongs here, found one pose"),
        ([3], "pose 1: a mapping of keys and values belongs here, found 3"),
        (3, "poses: a list belongs here, found 3"),
        ([], "no pose has role: fit"),
        ([{"file": "a.jpg", "start": (0, 0), "end": (0.3, 0)}], "needs either a board or a refer"),
        ([dlo.Pose((0, 0), (0.3, 0), file="a\0.csv")], "cannot be read: embedded null byte"),
    ],
)
def test_poses_are_a_list_of_poses(poses, message):
    cable = dlo.Cable(length=0.5, mass=0.05, diameter=0.005, bending_stiffness=0.01)
    with pytest.raises(dlo.ConfigError, match=message):
        dlo.Session(cable, poses, gravity=(0, -9.81), boundary=("pinned", "pinned"))


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"gravity": None}, "'gravity' is missing"),
        ({"boundary": None}, "'boundary' is missing"),
        ({"force_sd": 0.1}, "unknown key 'force_sd' in the arguments; did you mean 'force_std'"),
        ({"plausibility": False}, 'it belongs into estimation={"plausibility": ...}'),
        ({"matrix": CAMERA["matrix"]}, 'it belongs into camera={"matrix": ...}'),
    ],
)
def test_unknown_and_missing_arguments_of_a_session(given, message):
    with pytest.raises(dlo.ConfigError, match=re.escape(message)):
        hung(**given)


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"progress": print}, "progress=.* has no method step"),
        ({"diagnosis": "no"}, "diagnosis is True, False or None, found 'no'"),
    ],
)
def test_wrong_arguments_of_a_fit(given, message):
    with pytest.raises(dlo.DloError, match=message):
        hung().fit(**given)


def test_a_session_does_not_change():
    with pytest.raises(dlo.DloError, match="std of a Session cannot be set"):
        hung().std = 3.0


def hung(**options: Any) -> dlo.Session:
    """A small session with other options."""
    cable = dlo.Cable(length=0.5, mass=0.05, diameter=0.005, bending_stiffness=0.01)
    held = {"gravity": (0.0, -9.81), "boundary": ("pinned", "pinned")}
    return dlo.Session(cable, [dlo.Pose((0, 0), (0.3, -0.1), points=LINE)], **held | options)


def test_a_third_argument_needs_its_name():
    with pytest.raises(dlo.ConfigError, match="3 arguments without a name: start and end alone"):
        dlo.Pose((0, 0), (0.3, -0.1), LINE)
    with pytest.raises(dlo.ConfigError, match="Cable: 2 arguments without a name: all need theirs"):
        dlo.Cable(0.8, 0.05)
    with pytest.raises(dlo.ConfigError, match="start is given twice"):
        dlo.Pose((0, 0), start=(0, 0))


def test_values_of_numpy_are_numbers():
    cable = dlo.Cable(
        length=np.float32(0.5), mass=np.array(0.05), diameter=0.005, bending_stiffness=1
    )
    assert (type(cable.length), cable.mass) == (float, 0.05)
    assert dlo.Pose((0, 0), (0.3, -0.1), points=ca.DM(LINE)).points == tuple(map(tuple, LINE))
    pose = dlo.Pose(
        np.array([0, 0]), end=np.float32([0.25, 0]), points=np.array(LINE), turns=np.int64(1)
    )
    assert pose == dlo.Pose((0.0, 0.0), (0.25, 0.0), points=tuple(map(tuple, LINE)), turns=1)
    points = "((0.0, 0.0), (0.1, -0.1), (0.3, -0.1))"
    assert repr(pose).startswith(f"Pose(points={points}, start=(0.0, 0.0)")


def test_a_fit_from_arrays_is_that_of_the_file(tmp_path):
    """To the last digit: points are the file's, and so is all that is named after a pose."""
    tree = read_yaml(BENCH / "session.yaml")
    poses = tree["experiment"]["poses"][:3]
    options = {
        "model": {"n": 6},
        "estimation": {"algorithm1": False},
        "diagnosis": {"enabled": False},
    }
    known = [{**pose, "file": str(BENCH / pose["file"])} for pose in poses]
    experiment = tree["experiment"] | {"poses": known}
    (tmp_path / "session.yaml").write_text(dump_yaml(tree | options | {"experiment": experiment}))
    of_file = dlo.fit(tmp_path / "session.yaml")

    tables = [np.loadtxt(pose.pop("file"), delimiter=",", skiprows=1) for pose in known]
    declared = [dlo.Pose(**row, points=table) for row, table in zip(known, tables, strict=True)]
    del experiment["poses"], experiment["measurement"]
    result = dlo.Session(dlo.Cable(**tree["cable"]), declared, **experiment, **options).fit()

    reports = [report_dict(found) for found in (of_file, result)]
    assert [report.pop("config") for report in reports] == ["session", tree["cable"]["name"]]
    paths = [report.pop("config_path") for report in reports]
    assert paths == [str(tmp_path / "session.yaml"), None]
    for report in reports:
        del report["timing_s"]
    assert reports[0] == reports[1]

    write_numbers(tmp_path, result)
    measured = np.loadtxt(tmp_path / "centerlines/pose_01.csv", delimiter=",", skiprows=1)
    assert np.array_equal(measured, tables[0])
    x, y = tables[0][0]
    assert f"- [{x}, {y}]" in configuration_text(result.config)  # as the page shows it
    assert (
        dlo.load(tmp_path).params["bending_stiffness"] == result.cable.params["bending_stiffness"]
    )

    # Photographs p-a and p_a have a file each, and no file of another pose is replaced.
    first, second, *_ = result.poses
    pixels = {"pose_01-a": np.array([[1.0, 0.0]]), "pose_01_a": np.array([[2.0, 0.0]])}
    views = [SimpleNamespace(name=n, seen=SimpleNamespace(pixels=p)) for n, p in pixels.items()]
    poses = (replace(first, views=views), replace(second, name="pose_01_a"))
    write_numbers(tmp_path, replace(result, poses=poses))
    files = {
        file.stem: np.loadtxt(file, delimiter=",", skiprows=1, ndmin=2)[0, 0]
        for file in (tmp_path / "centerlines").glob("pose_01*")
    }
    expected = {"pose_01": tables[0][0, 0], "pose_01_a": tables[1][0, 0]}
    assert files == expected | {"pose_01_a_1": 1.0, "pose_01_a_2": 2.0}


def test_a_photograph_named_as_its_pose_is_named_once(tmp_path):
    file = tmp_path / "pose_01.png"
    cv2.imwrite(str(file), np.full((480, 640), 255, np.uint8))
    cable = dlo.Cable(length=0.5, mass=0.05, diameter=0.005, bending_stiffness=0.01)
    poses = [dlo.Pose((0, 0, 0), (0.4, 0, 0), file=file)]
    pinned, space = ("pinned", "pinned"), (0.0, 0.0, -9.81)
    session = dlo.Session(cable, poses, gravity=space, boundary=pinned, camera=CAMERA, board=BOARD)
    with pytest.raises(dlo.MeasurementError, match=r"\n  pose_01: (?!pose_01: )"):
        session.fit()
