"""Configurations: every file of the repository loads; every mistake is named, with its line."""

import math
from pathlib import Path

import numpy as np
import pytest
import yaml
from scipy.spatial.transform import Rotation

import dlo_casadi as dlo
from dlo_casadi.config import (
    Centerlines,
    Config,
    Images,
    declared_setup,
    dump_yaml,
    load_config,
    read_yaml,
)
from dlo_casadi.config.cable import DENSITY
from dlo_casadi.effects import EFFECTS, CableData
from dlo_casadi.errors import ConfigError, DloError, counted

ROOT = Path(__file__).parents[1]
CONFIGS = sorted(ROOT.glob("configs/*.yaml"))
SESSIONS = sorted(ROOT.glob("tests/data/bench/*/session.yaml"))

GOOD = """\
cable:
  name: test cable
  length: 0.8
  mass: 0.23
  diameter: 1.28e-2
  youngs_modulus: 4.55e8
experiment:
  gravity: [0, -9.81]
  boundary: {start: pinned, end: pinned}
  measurement: {kind: centerlines, std: 3e-4}
  poses:
    - {file: a.csv, start: [0, 0], end: [0.5, 0.1], role: fit}
    - {file: b.csv, start: [0, 0], end: [0.4, 0.1], role: fit}
    - {file: c.csv, start: [0, 0], end: [0.3, 0.1], role: held_out}
"""
YOUNG = "youngs_modulus: 4.55e8"
BOARD = (
    "board: {dictionary: DICT_4X4_50, marker_size: 0.08, standoff: 0.012, "
    "marker_centers: {0: [0, 0], 1: [1, 0]}}"
)
CAMERA = "camera: {matrix: [[900, 0, 600], [0, 900, 300], [0, 0, 1]]}"
# Every line holds ten of the line above.
LAUGHS = "l0: &l0 [x, x, x, x, x, x, x, x, x, x]\n" + "".join(
    f"l{k}: &l{k} [{', '.join([f'*l{k - 1}'] * 10)}]\n" for k in range(1, 9)
)
REFERENCE = "reference: {pixels: [[0, 0], [9, 0]], points: [[0, 0], [1, 0]]}"


def load(folder: Path, *changes: tuple[str, str], text: str = GOOD) -> Config:
    """Load the good configuration with some of its text replaced."""
    for old, new in changes:
        assert old in text
        text = text.replace(old, new)
    path = folder / "test.yaml"
    path.write_text(text)
    for name in ("a.csv", "b.csv", "c.csv", "a.jpg", "b.jpg", "c.jpg"):
        (folder / name).touch()
    return load_config(path)


def test_the_text_of_a_file_is_that_which_was_read(tmp_path):
    path = load(tmp_path).path
    path.write_text(GOOD, encoding="utf-16")
    assert load_config(path).text == GOOD


def load_images(folder: Path, *parts: str) -> Config:
    measurement = "{" + ", ".join(["kind: images", *parts]) + "}"
    return load(folder, ("{kind: centerlines, std: 3e-4}", measurement), (".csv", ".jpg"))


@pytest.mark.parametrize("path", CONFIGS + SESSIONS, ids=lambda p: f"{p.parent.name}/{p.stem}")
def test_files_of_the_repository_load_completely(path):
    config = load_config(path)
    assert not config.skipped
    assert config.measured_poses == config.experiment.poses
    assert len(config.warnings) == (len(config.experiment.poses) == 1)


def test_the_repository_holds_what_the_readme_promises():
    names = {"cable", "black_wire", "white_wire", "black_wire_photo", "glass_strip"}
    assert {path.stem for path in CONFIGS} == names | {"markers_in_space", "swing"}
    assert len(SESSIONS) == 17
    truths = {path.parent.name for path in ROOT.glob("tests/data/bench_truth/*/truth.yaml")}
    assert truths == {path.parent.name for path in SESSIONS} | {"connector"}


def test_the_default_configuration():
    config = load_config(ROOT / "configs/cable.yaml")
    measurement = config.experiment.measurement
    assert isinstance(measurement, Images)
    assert measurement.camera is not None
    assert measurement.board is not None
    assert config.name == "cable"
    assert config.cable.length == 0.8125
    assert config.cable.rest_shape == "curved"
    assert config.cable.prior_bending_stiffness == pytest.approx(
        4.55e8 * math.pi * 0.0128**4 / 64, rel=1e-12
    )
    assert config.experiment.gravity == (0.0, -9.81)
    assert measurement.std is None
    assert measurement.camera.matrix[0] == (915.0, 0.0, 641.3)
    assert measurement.board.marker_centers[2] == (1.14, -0.7)
    assert measurement.board.standoff == 0.012
    assert config.experiment.tolerances.length == 5.0e-4
    assert len(config.experiment.poses) == 18
    first = config.experiment.poses[0]
    assert first.file == ROOT / "configs/bench/connector/pose_01.jpg"
    assert (first.name, first.role, first.start, first.end) == (
        "pose_01",
        "fit",
        (0.0, 0.0),
        (0.508, 0.1016),
    )
    assert sum(pose.role == "held_out" for pose in config.experiment.poses) == 4


def test_clamped_and_free_ends():
    loop = load_config(ROOT / "configs/white_wire.yaml").experiment
    assert (loop.boundary.start, loop.boundary.end) == ("clamped", "clamped")
    assert loop.poses[0].end_heading == pytest.approx(-2 * math.pi, abs=1e-6)
    strip = load_config(ROOT / "configs/glass_strip.yaml")
    assert strip.experiment.boundary.end == "free"
    assert strip.experiment.poses[0].end is None
    assert strip.cable.prior_bending_stiffness == 5.0e-4


def test_every_way_to_write_a_number(tmp_path):
    for text in ("1e-3", "1.0e-3", "1.E-3", "+1e-03", "1.0e-03", "0.001", ".001"):
        config = load(tmp_path, ("std: 3e-4", f"std: {text}"))
        assert isinstance(config.experiment.measurement, Centerlines)
        assert config.experiment.measurement.std == 0.001, text
    assert load(tmp_path, ("0.23", "1.0e0")).cable.mass == 1.0
    assert load(tmp_path, ("0.23", "010")).cable.mass == 10.0  # not octal


def test_options_and_declared_effects(tmp_path):
    options = """\
model:
  n: 40
  element: link
  effects:
    - image_scale
    - name: lumped_mass
      parameters: {mass: 2e-2, position: {value: 0.5, fixed: true}}
estimation: {algorithm1_inner: cobyla, rest_curvature_coefficients: 9}
diagnosis:
"""
    config = load(tmp_path, text=GOOD + options)
    assert (config.model.n, config.model.element) == (40, "link")
    assert [effect.name for effect in config.model.effects] == ["image_scale", "lumped_mass"]
    mass = config.model.effects[1].parameters["mass"]
    position = config.model.effects[1].parameters["position"]
    assert (mass.value, mass.fixed, position.value, position.fixed) == (0.02, False, 0.5, True)
    assert config.estimation.algorithm1_inner == "cobyla"
    assert config.estimation.algorithm1_n == 10
    assert config.diagnosis.enabled
    assert load(tmp_path).model.n is None


def test_a_configuration_cannot_be_changed(tmp_path):
    config = load(tmp_path)
    with pytest.raises(DloError, match="length of a Cable cannot be set"):
        config.cable.length = 1.0
    with pytest.raises(DloError, match="path of a Config cannot be set"):
        config.path = Path()


@pytest.mark.parametrize(
    ("old", "new", "line", "message"),
    [
        # keys
        ("length: 0.8", "lenght: 0.8", 3, "unknown key 'lenght' in cable; did you mean 'length'?"),
        ("  length: 0.8\n", "", 1, r"'length' is missing in cable: .* \[m\]"),
        ("  gravity: [0, -9.81]\n", "", 7, "'gravity' is missing in experiment: .* in space$"),
        ("experiment:", "experiment:\n  limits: {}", 8, "it belongs into the top of the file"),
        ("cable:", "kable:", 1, "unknown key 'kable' in the top .* did you mean 'cable'?"),
        ("  mass", "  gravity: 0\n  mass", 4, "'gravity' in cable; it belongs into experiment"),
        ("  mass", "  colour: red\n  mass", 4, "'colour' in cable; known here: .*diameter, length"),
        ("  mass", "  length: 1\n  mass", 4, "key 'length' occurs twice, first in line 3"),
        ("role: held_out", "clips: [{plase: 1}]", 14, r"'plase' in pose 3 .*mean 'place'"),
        ("role: held_out", "rol: fit", 14, r"unknown key 'rol' in pose 3 \(c.csv\);.*'role'"),
        ("std: 3e-4", "board: {}", 10, "'board' in experiment.measurement; .*kind: images"),
        # numbers
        ("0.8\n", "long\n", 3, "cable.length: a number belongs here, found 'long'"),
        ("0.8\n", "'0.8'\n", 3, "write it without quotes"),
        ("0.8\n", "0,8\n", 3, "the decimal sign is a point: 0.8"),
        ("0.8\n", "0.8 m\n", 3, "found '0.8 m'; write the number alone, in SI units$"),
        ("0.8\n", "1.2.3\n", 3, "found '1.2.3'$"),
        ("0.8\n", "\n", 3, "cable.length: a number belongs here, found nothing"),
        ("0.8\n", "true\n", 3, "cable.length: a number belongs here, found true"),
        ("0.8\n", ".nan\n", 3, "cable.length: a finite number belongs here"),
        ("0.8\n", ".inf\n", 3, "cable.length: a finite number belongs here"),
        ("0.8\n", "-0.8\n", 3, "cable.length: must be larger than 0, found -0.8"),
        ("mass: 0.23", "mass: 0", 4, "cable.mass: must be larger than 0, found 0"),
        ("1.28e-2", "-0.1", 5, "cable.diameter: must be larger than 0, found -0.1"),
        ("[0.5, 0.1]", "[0.5]", 12, r"pose 1 \(a.csv\).end: two numbers \[x, y\] belong here"),
        ("[0.5, 0.1]", "[0.5, x]", 12, r"pose 1 \(a.csv\).end\[1\]: a number belongs here"),
        ("[0, -9.81]", "-9.81", 8, "gravity: two numbers"),
        ("[0, -9.81]", "[0, 0, -9.81]", 12, r"start: \[x, y, z\] belongs here \(three numbers"),
        # units
        ("length: 0.8", "length: 812.5", 3, "812.5 m: units are SI, did you mean 0.8125?"),
        ("mass: 0.23", "mass: 230", 4, "230 kg for 0.8 m: units are SI, did you mean 0.23?"),
        (
            "1.28e-2",
            "1.0e-4",
            4,
            "times as dense as water .osmium.*: units are SI, diameter and length in m?",
        ),
        ("mass: 0.23", "mass: 30", 4, "291 times as dense as water.*did you mean 0.03?"),
        ("1.28e-2", "12.8", 5, "12.8 m is larger than the length 0.8 m.* did you mean 0.0128?"),
        ("1.28e-2", "1.28", 5, "1.28 m is larger than the length 0.8 m.* did you mean 0.0128?"),
        ("1.28e-2", "0.7", 5, "0.7 m make 0.23 kg lighter than air.* did you mean 0.007?"),
        # words
        ("held_out", "test", 14, "role: allowed are 'fit' or 'held_out', found 'test'"),
        (
            "start: pinned",
            "start: free",
            9,
            "'pinned', 'clamped', 'swivel' or 'slide', .*only the end can be free",
        ),
        (
            "end: pinned",
            "end: glued",
            9,
            "'pinned', 'clamped', 'swivel', 'slide' or 'free', found 'glued'",
        ),
        ("kind: centerlines", "kind: photos", 10, "kind must be images or centerlines, .*'photos'"),
        ("kind: centerlines, ", "", 10, "kind must be images or centerlines, found nothing"),
        # stiffness
        ("  youngs_modulus: 4.55e8\n", "", 1, "youngs_modulus .* or bending_stiffness .* neither"),
        ("  gravity", "  tolerances: {end: 0}\n  gravity", 8, "known exactly write a small one"),
        # poses
        ("b.csv", "a.csv", 13, r"pose 2 \(a.csv\): pose 1 is called 'a' too"),
        ("a.csv", "a.jpg", 12, "a photograph is not a CSV; measurement kind: images?"),
        ("file: a.csv, ", "", 12, "pose 1: 'file' is missing"),
        ("a.csv, ", "a.csv, at: [0.1], ", 12, "1 arc length for 0 points.*of a CSV .* column s_m"),
        ("role: fit", "role: held_out", 11, "no pose has role: fit"),
    ],
)
def test_a_mistake_is_named_with_its_line(tmp_path, old, new, line, message):
    with pytest.raises(ConfigError, match=message) as caught:
        load(tmp_path, (old, new))
    text = str(caught.value)
    assert f"test.yaml, line {line}: " in text or f"\n  line {line}: " in text


def test_a_mistake_in_a_value_that_overrides_a_merged_one_has_its_own_line(tmp_path):
    poses = "    - &first {file: a.csv, start: [0, 0], end: [0.5, 0.1]}\n"
    poses += "    - <<: *first\n      file: b.csv\n      end: 3\n"
    with pytest.raises(ConfigError, match=r"line 15: pose 2 \(b.csv\).end: two numbers"):
        load(tmp_path, text=GOOD.split("    - ")[0] + poses)


def test_both_stiffnesses(tmp_path):
    with pytest.raises(ConfigError, match=r"line 7: .*found both"):
        load(tmp_path, ("4.55e8\n", "4.55e8\n  bending_stiffness: 1\n"))


def test_all_mistakes_are_listed_at_once(tmp_path):
    with pytest.raises(ConfigError, match="3 problems") as caught:
        load(tmp_path, ("lengt", "lenk"), ("0.23", "heavy"), ("3e-4", "-1"))
    lines = str(caught.value).splitlines()[1:]
    assert [line.split(":")[0] for line in lines] == ["  line 3", "  line 4", "  line 10"]


def test_a_long_list_of_mistakes_is_cut(tmp_path):
    poses = "".join(f"    - {{file: {i}.csv, start: [0, 0], end: [x, 0]}}\n" for i in range(20))
    with pytest.raises(ConfigError, match=r"20 problems(.*\n)+.* and 8 more"):
        load(tmp_path, text=GOOD.split("    - ")[0] + poses)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "the file is empty"),
        ("# nothing\n", "the file is empty"),
        ("- 1\n- 2\n", "belongs at the top, found a list"),
        ("hello\n", "belongs at the top, found text"),
        ("cable:\nexperiment:\n", "cable: a mapping of keys and values belongs here"),
        ("cable: {a: [\n", "line 2: not valid YAML"),
        ("cable:\n\tlength: 1\n", r"line 2: not valid YAML: .*indent with spaces"),
        ("a: 1\n---\nb: 2\n", "not valid YAML: but found another document"),
        ("a: !!python/object:os.system 1\n", "line 1: not valid YAML: could not determine"),
        ("a: 1\nb: &b [{c: *b}]\n", "line 2: .*it contains itself"),
        ("a:\n- 1" + 5000 * "0", "line 2: .*'1000.* cannot be read as int. Try: a number of"),
        (
            "a: !!float abc",
            "line 1: .*'abc' cannot be read as float.*without a tag such as !!float",
        ),
        ("a: !!timestamp x", "line 1: .*'x' cannot be read as timestamp"),
        ("a: !!timestamp 2024-99-99", "line 1: .*cannot be read as timestamp"),
        ("a: !!bool maybe", "line 1: .*'maybe' cannot be read as bool"),
        ("a:\n  - " + 40 * "[" + 40 * "]", "line 2: lists and mappings more than 30 levels deep"),
        (5000 * "[" + 5000 * "]", "lists and mappings more than 30 levels deep"),
        ('a: "\\0"', r"line 1: '\\x00' holds '\\x00', which is no text"),
        ('a: "x\\ud800"', r"line 1: .* holds '\\ud800', which is no text"),
        ("a: [" + 300_000 * "0,", "larger than 500000 bytes"),
        (LAUGHS, r"line 6: 1.11e\+06 values, once its aliases .* written out; at most"),
    ],
)
def test_a_file_that_is_no_mapping(tmp_path, text, message):
    with pytest.raises(ConfigError, match=message):
        load(tmp_path, text=text)


def test_a_file_that_cannot_be_read(tmp_path):
    load(tmp_path)
    with pytest.raises(ConfigError, match=r"tset.yaml: no such file; did you mean 'test.yaml'\?"):
        load_config(tmp_path / "tset.yaml")
    with pytest.raises(ConfigError, match="cannot be read"):
        load_config(tmp_path)
    (tmp_path / "photo.yaml").write_bytes(b"\xff\xd8\xff\xe0\x00\x10JFIF")
    with pytest.raises(ConfigError, match="not a YAML text file"):
        load_config(tmp_path / "photo.yaml")


@pytest.mark.parametrize(
    ("options", "line", "message"),
    [
        ("model: {effects: [wind]}", 15, "model.effects: no effect is called 'wind'; known here: "),
        ("model:\n  effects:\n    - lumped_mas", 17, "'lumped_mas'; did you mean 'lumped_mass'?"),
        (
            "model:\n  effects:\n    - name: lumped_mass\n      parameters: {masss: 0.1}",
            18,
            "lumped_mass has no parameter 'masss'; did you mean 'mass'?",
        ),
        (
            "model:\n  effects:\n    - length_error\n    - lumped_mass\n    - length_error",
            19,
            "length_error: 2 such effects declared, and this cable can have 1. Try: without this",
        ),
        (
            "model:\n  effects:\n    - lumped_mass\n    - lumped_mass",
            18,
            "lumped_mass: declared twice with the same values, from which a fit cannot tell them",
        ),
        (
            "diagnosis:\n  exclude: [point_farce]",
            16,
            "diagnosis.exclude: no effect is called 'point_farce'; did you mean 'point_force'?",
        ),
    ],
)
def test_unknown_and_repeated_effects_are_named_with_their_line(tmp_path, options, line, message):
    with pytest.raises(ConfigError) as caught:
        load(tmp_path, text=GOOD + options + "\n")
    assert caught.value.line == line
    assert message in str(caught.value)


@pytest.mark.parametrize(
    ("old", "new", "line", "message"),
    [
        ("length: 0.8", "length: 1e-300", 3, "1e-300 m: units are SI, 0.001 to 100 m is possible"),
        ("length: 0.8", "length: 1e308", 3, "1e.308 m: units are SI, 0.001 to 100 m is possible"),
        ("mass: 0.23", "mass: 1e-300", 4, "no cable is lighter than 1e-10 kg; .*gravity: .0, 0"),
        (
            "mass: 0.23",
            "mass: 1e308",
            4,
            "1e.308 kg for 0.8 m: units are SI, at most 80 kg is possible",
        ),
        ("1.28e-2", "1e-300", 5, "1e-300 m: 1e-06 to 0.8 m is possible"),
        ("1.28e-2", "1e300", 5, "1e.300 m is larger than the length 0.8 m"),
        (YOUNG, "bending_stiffness: 1e-300", 6, "1e-300 N m.2: 1e-12 to 1e.09 N m.2 is possible"),
        (YOUNG, "bending_stiffness: 1e308", 6, "1e.308 N m.2: 1e-12 to 1e.09 N m.2 is possible"),
        (YOUNG, "youngs_modulus: 1e300", 6, "is possible for EI = E pi d.4 / 64"),
        ("-9.81", "-1e30", 8, "gravity: 1e.30 m/s.2: 0 to 10000 m/s.2 is possible"),
        ("3e-4", "1e-12", 10, "std: 1e-12 m: 1e-07 to 0.04 m is possible .*; without it"),
        ("3e-4", "1e30", 10, "std: 1e.30 m: 1e-07 to 0.04 m is possible"),
        ("[0, 0]", "[0, 1e308]", 12, "start: 1e.308 m: -1000 to 1000 m is possible"),
    ],
)
def test_a_value_that_nothing_has_is_refused_with_the_range(tmp_path, old, new, line, message):
    with pytest.raises(ConfigError, match=message) as caught:
        load(tmp_path, (old, new))
    text = str(caught.value)
    assert f"test.yaml, line {line}: " in text or f"\n  line {line}: " in text


@pytest.mark.parametrize("value", ["1e-30", "1e30"])
@pytest.mark.parametrize(
    ("key", "most"),
    [("length", "0.24 m"), ("end", "0.24 m"), ("heading", "0.9 rad"), ("scale", "0.3")],
)
def test_a_tolerance_lies_within_the_bounds_of_what_takes_it_up(tmp_path, key, value, most):
    """The bounds of length_error, end_offset, clamp_angle and image_scale for 0.8 m."""
    tolerances = f"  tolerances: {{{key}: {value}}}\n"
    message = rf"line 11: tolerances.{key}: {float(value):g}.*: 1e-09 to {most} is possible"
    with pytest.raises(ConfigError, match=message.replace("+", r"\+")):
        load(tmp_path, ("  poses:", tolerances + "  poses:"))


def test_a_tolerance_of_the_roll_is_in_radians(tmp_path):
    with pytest.raises(ConfigError, match=r"line 11: .*tolerances\.roll: 180 rad: 0 to 9 rad is"):
        load(tmp_path, ("  poses:", "  tolerances: {roll: 180}\n  poses:"))


@pytest.mark.parametrize(
    ("effect", "parameter", "message"),
    [
        ("lumped_mass", "mass: -1", "-1 kg: 0 to 23000 kg is possible"),
        ("lumped_mass", "mass: 1e6", "1e+06 kg: 0 to 23000 kg is possible"),
        ("lumped_mass", "mass: 1", "1 kg: a fit searches 0 to 0.69 kg only. Try: {value: 1, fixed"),
        ("lumped_mass", "position: 0.81", "0.81 m: 0 to 0.8 m is possible"),
        ("stiff_section", "factor: 0", "0: 0.02 to 100 is possible"),
    ],
)
def test_a_declared_effect_lies_within_its_own_bounds(tmp_path, effect, parameter, message):
    """Three times the cable's 0.23 kg, if it is estimated; its 0.8 m."""
    options = f"model:\n  effects:\n    - {{name: {effect}, parameters: {{{parameter}}}}}\n"
    with pytest.raises(ConfigError) as caught:
        load(tmp_path, text=GOOD + options)
    assert caught.value.line == 17
    assert f"{effect}.{parameter.split(':')[0]}: {message}" in str(caught.value)


def test_a_value_that_is_kept_may_be_more_than_a_fit_searches_for(tmp_path):
    effect = "{name: lumped_mass, parameters: {mass: {value: 1, fixed: true}}}"
    config = load(tmp_path, text=GOOD + f"model: {{effects: [{effect}]}}\n")
    assert config.model.effects[0].parameters["mass"].value == 1.0


def load_for_all(folder: Path, options: str, *, clamped: bool) -> Config:
    """Load a session in which every effect of pins, or of clamps, can act."""
    pin = "{kind: pinned, at: 0.4, place: [0.2, -0.1]}"
    saddle = "{kind: clamped, at: 0.6, place: [0.3, -0.05], heading: 0}"
    clamps = (
        ("{start: pinned, end: pinned}", "{start: clamped, end: clamped}"),
        ("start: [0, 0]", "start: [0, 0], start_heading: 0, end_heading: 0"),
    )
    return load(
        folder,
        *clamps * clamped,
        ("role:", f"clips: [{pin}, {saddle}], role:"),
        ("  poses:", "  obstacles:\n    - {kind: plane, point: [0, -1], normal: [0, 1]}\n  poses:"),
        ("{kind: centerlines, std: 3e-4}", f"{{kind: images, {CAMERA}, {BOARD}}}"),
        (".csv", ".jpg"),
        text=GOOD + options,
    )


@pytest.mark.parametrize("name", [name for name, kind in EFFECTS.items() if 2 in kind.dimensions])
def test_no_parameter_of_an_effect_takes_any_number(tmp_path, name):
    for q in EFFECTS[name]().parameters(CableData(0.8, 0.23, 0.0128, 0.6)):
        options = f"model: {{effects: [{{name: {name}, parameters: {{{q.name}: 1e300}}}}]}}\n"
        with pytest.raises(ConfigError, match=rf"{name}.{q.name}: 1e\+300.* is possible"):
            load_for_all(tmp_path, options, clamped=not name.endswith("_spring"))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ("model: {n: 1}", "model.n: must not be smaller than 2, found 1; 2 to 2000 is possible"),
        ("model: {n: 3000}", "model.n: must not be larger than 2000, found 3000; 2 to 2000"),
        (
            "estimation: {rest_curvature_coefficients: 100000}",
            "must not be larger than 64, found 100000; 0 to 64 is possible",
        ),
    ],
)
def test_counts_have_a_range(tmp_path, options, message):
    with pytest.raises(ConfigError, match="line 15: .*" + message):
        load(tmp_path, text=GOOD + options)


@pytest.mark.parametrize(
    ("options", "warning"),
    [
        ("model: {n: 2}", "2 quadratic elements: so coarse that the mesh's own error can look"),
        ("model: {n: 12, element: link}", "12 link elements: so coarse"),
        ("model: {n: 2000}", "2000 elements take minutes and much memory"),
        ("estimation: {algorithm1_inner: cobyla, algorithm1_n: 200}", "COBYLA takes about 400 s"),
    ],
)
def test_what_is_unwise_is_a_warning_with_its_consequence(tmp_path, options, warning):
    assert any(warning in text for text in load(tmp_path, text=GOOD + options).warnings)


def test_names_that_no_file_system_takes(tmp_path):
    """255 bytes are the limit of a name; results add to the name of a pose."""
    with pytest.raises(ConfigError, match=r"line 12: pose 1 .*at most 200 bytes long"):
        load(tmp_path, ("a.csv", 5000 * "x" + ".csv"))
    config = load(tmp_path, ("a.csv", 60 * ("x" * 99 + "/") + "a.csv"))
    assert "cannot be read: File name too long" in config.skipped[0].reason
    for name, reason in (("a.csv/x.csv", "x.csv does not exist"), (".", "is no file; a photo")):
        config = load(tmp_path, ("file: a.csv", f"file: {name}"))
        assert reason in config.skipped[0].reason


def test_every_effect_can_be_declared(tmp_path):
    in_plane = [name for name, kind in EFFECTS.items() if 2 in kind.dimensions]
    for clamped, other in ((True, "_spring"), (False, "clamp_")):
        names = [name for name in in_plane if other not in name]
        options = f"model: {{effects: [{', '.join(names)}]}}\n"
        config = load_for_all(tmp_path, options, clamped=clamped)
        assert [item.name for item in config.model.effects] == names


@pytest.mark.parametrize(
    ("effect", "message"),
    [
        ("camera_frame", r"camera_frame: it is of cables in space, .* 2 numbers.* Try: without it"),
        ("clamp_angle", r"clamp_angle: it turns a clamp, .* Try: experiment\.boundary"),
        ("standoff_error", r"standoff_error: .* calibrated camera, .* Try: measurement\.camera"),
        (
            "{name: stiff_section, parameters: {start: 0.5, end: 0.3}}",
            r"stiff_section: it starts at 0\.5 m and ends at 0\.3 m .* Try: start smaller than end",
        ),
        # The other end is where it is without being declared, 0.36 m of 0.8 m.
        ("{name: stiff_section, parameters: {end: 0.3}}", r"starts at 0\.36 m and ends at 0\.3 m"),
    ],
)
def test_an_effect_that_cannot_act_as_declared_is_refused_by_name(tmp_path, effect, message):
    with pytest.raises(ConfigError, match=message) as caught:
        load(tmp_path, text=f"{GOOD}model:\n  effects:\n    - {effect}\n")
    assert caught.value.line == 17


def test_a_parameter_of_an_end_that_is_not_clamped_is_unknown(tmp_path):
    effect = "{name: clamp_angle, parameters: {start_heading_error: 0.1}}"
    with pytest.raises(ConfigError, match="no parameter 'start_heading_error'; did you mean 'end_"):
        load(
            tmp_path,
            ("end: pinned", "end: clamped"),
            ("start: [0, 0]", "start: [0, 0], end_heading: 0"),
            text=f"{GOOD}model: {{effects: [{effect}]}}\n",
        )


def test_headings_follow_the_boundary(tmp_path):
    with pytest.raises(ConfigError, match=r"pose 1 \(a.csv\): a clamped start needs a start_head"):
        load(tmp_path, ("start: pinned", "start: clamped"))
    with pytest.raises(ConfigError, match=r"pose 2 \(b.csv\): a clamped end needs an end_heading"):
        load(tmp_path, ("end: pinned", "end: clamped"))
    with pytest.raises(ConfigError, match=r"pose 3 \(c.csv\): a free end has no end.*, slide"):
        load(tmp_path, ("end: pinned", "end: free"))
    with pytest.raises(ConfigError, match=r"pose 2 \(b.csv\): a pinned end needs its position"):
        load(tmp_path, ("end: [0.4, 0.1], ", ""))
    unused = load(tmp_path, ("end: [0.4", "start_heading: 0.1, end: [0.4"))
    assert unused.warnings == ("start_heading is not used, the start is pinned: b",)
    assert all(x.start_heading is None for x in unused.experiment.poses)
    assert unused.experiment.poses[1].held.start_heading is None


def test_a_swivel_in_a_plane_is_said_to_be_a_clamp(tmp_path):
    headings = ("end: [0.", "end_heading: 0.1, end: [0.")
    (said,) = load(tmp_path, ("end: pinned", "end: swivel"), headings).warnings
    assert said.startswith("boundary.end: swivel: in a plane no cable rolls about its axis")
    assert "Try: end: clamped" in said


def test_a_ball_joint_and_a_free_end_hold_no_shape_in_space(tmp_path):
    """In a plane they do: there a cable cannot be turned about gravity."""
    free = [
        ("end: pinned", "end: free"),
        ("end: [0.5, 0.1], ", ""),
        ("end: [0.4, 0.1], ", ""),
        ("end: [0.3, 0.1], ", ""),
    ]
    assert load(tmp_path, *free).experiment.boundary.end == "free"
    space = [("[0, -9.81]", "[0, 0, -9.81]"), ("start: [0, 0]", "start: [0, 0, 0]")]
    with pytest.raises(ConfigError, match=r"can turn freely about.* Try: start: clamped"):
        load(tmp_path, *free, *space)


def test_a_pose_out_of_reach_is_left_out(tmp_path):
    config = load(tmp_path, ("[0.5, 0.1]", "[0.5, 0.9]"))
    assert [pose.name for pose in config.experiment.poses] == ["b", "c"]
    (skipped,) = config.skipped
    assert skipped.name == "a"
    assert "end (0.5, 0.9) m is 1.03 m from the start; the cable is 0.8 m long" in skipped.reason
    assert any("only one pose to fit" in warning for warning in config.warnings)


def test_reach_allows_for_the_tolerances(tmp_path):
    """Three standard deviations of length and end: 3 hypot(0.5, 0.2) mm = 1.6 mm."""
    assert not load(tmp_path, ("[0.5, 0.1]", "[0.8015, 0]")).skipped
    assert load(tmp_path, ("[0.5, 0.1]", "[0.8017, 0]")).skipped


def test_reach_of_clips_allows_for_their_tolerances(tmp_path):
    """By default 3 hypot(0.5, 0.2, 0.2, 0.5) mm = 2.3 mm."""

    def held(place, tolerances=""):
        clip = f"clips: [{{kind: pinned, at: 0.4, place: [{place}, 0]}}], role:"
        return load(tmp_path, ("role:", clip), ("  poses:", f"{tolerances}  poses:"))

    assert not held(0.4022).skipped
    assert not held(0.414, "  tolerances: {slip: 5.0e-3}\n").skipped
    with pytest.raises(ConfigError, match=r"clip_1 are 0\.4024 m apart, with 0\.4 m of cable"):
        held(0.4024)


def test_no_pose_within_reach(tmp_path):
    with pytest.raises(ConfigError, match="no pose to fit is left") as caught:
        load(tmp_path, ("[0.5, 0.1]", "[508, 101]"), ("[0.4, 0.1]", "[0, 0.9]"))
    assert "line 12: pose 1 (a.csv): end (508, 101) m is 517.9 m from" in str(caught.value)
    assert "line 13: pose 2 (b.csv): end (0, 0.9) m is 0.9 m from the start" in str(caught.value)


def test_a_missing_file_keeps_its_place_in_the_history(tmp_path):
    config = load(tmp_path, ("b.csv", "bb.csv"))
    assert [pose.name for pose in config.experiment.poses] == ["a", "bb", "c"]
    assert [pose.name for pose in config.measured_poses] == ["a", "c"]
    (skipped,) = config.skipped
    assert skipped.name == "bb"
    assert "bb.csv does not exist; did you mean b.csv?" in skipped.reason


def test_no_file_at_all(tmp_path):
    with pytest.raises(ConfigError, match=r"pose 1 \(aa.csv\): .*aa.csv does not exist"):
        load(tmp_path, (".csv", ".csv"), ("a.csv", "aa.csv"), ("b.csv", "data/b.csv"))


def test_what_photographs_need(tmp_path):
    assert not load_images(tmp_path, CAMERA, BOARD).skipped
    assert not load_images(tmp_path, REFERENCE).skipped
    assert not load_images(tmp_path, BOARD).skipped
    with pytest.raises(ConfigError, match="either a board or a reference, found neither"):
        load_images(tmp_path, CAMERA)
    with pytest.raises(ConfigError, match="either a board or a reference, found both"):
        load_images(tmp_path, CAMERA, BOARD, REFERENCE)


IN_SPACE = (
    ("[0, -9.81]", "[0, -9.81, 0]"),
    ("start: [0, 0]", "start: [0, 0, 0.1]"),
    (".1], role", ".1, 0.2], role"),
    ("{kind: centerlines, std: 3e-4}", f"{{kind: images, {CAMERA}, {BOARD}}}"),
)


@pytest.mark.parametrize(
    ("files", "name"),
    [
        ("[pose_01_a.jpg, pose_01_b.jpg]", "pose_01"),
        ("[pose_1a.jpg]", "pose_1"),
        ("[IMG_12.jpg, IMG_13.jpg]", "IMG_12"),
        ("[left.jpg, low.jpg]", "left"),
    ],
)
def test_several_photographs_of_a_pose(tmp_path, files, name):
    """One that is there is enough; lines and markers may stand beside them."""
    (tmp_path / files.strip("[]").split(",")[0]).touch()
    config = load(tmp_path, *IN_SPACE, ("file: a.csv", f"files: {files}"))
    first, second, _ = config.experiment.poses
    assert (first.name, len(first.paths)) == (name, files.count(".jpg"))
    assert not config.skipped
    assert second.paths == (second.file,)


@pytest.mark.parametrize(
    ("new", "message"),
    [
        (
            "file: a.csv, files: [a.jpg]",
            r"pose 1 \(a.csv\): give file, files or points, found file and files",
        ),
        ("files: []", r"files: file names \[a.jpg, b.jpg\] belong here, found \[\]"),
        ("files: a.jpg", "belong here, found 'a.jpg'"),
        ("files: [a.jpg, 1/a.png]", "each photograph needs a name of its own, found a.jpg, a.png"),
        ("files: [x.jpg, y.jpg]", "x.jpg does not exist.*y.jpg does not exist"),
    ],
)
def test_mistakes_in_files(tmp_path, new, message):
    only = [("file: b.csv", "file: gone.csv")] if "x.jpg" in new else []
    with pytest.raises(ConfigError, match=message):
        load(tmp_path, *IN_SPACE, ("file: a.csv", new), *only)


def test_several_photographs_are_of_space(tmp_path):
    with pytest.raises(ConfigError, match="several photographs are of a cable in space"):
        load(tmp_path, ("file: a.csv", "files: [a.jpg, b.jpg]"))
    with pytest.raises(ConfigError, match="in space need a board of markers"):
        load(tmp_path, *IN_SPACE, (f"{CAMERA}, {BOARD}", REFERENCE))


def test_two_files_of_points_are_not_one_pose(tmp_path):
    with pytest.raises(ConfigError, match=r"\(a.csv, d.csv\): .*one CSV belongs here, as file"):
        load(tmp_path, *IN_SPACE[:3], ("file: a.csv", "files: [a.csv, d.csv]"))


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("DICT_4X4_50", "4X4_50", "no dictionary '4X4_50'; did you mean 'DICT_4X4_50'?"),
        ("1: [1, 0]", "50: [1, 0]", "DICT_4X4_50 has no marker 50: its ids end at 49"),
        ("1: [1, 0]", "1: [0.01, 0]", "markers 0 and 1 are 0.01 m apart, closer than their size"),
        ("1: [1, 0]", "1: [1e30, 0]", r"marker_centers.1: 1e\+30 m: -1000 to 1000 m is possible"),
        ("0.012", "1e30", r"standoff: 1e\+30 m: 0 to 1000 m is possible"),
        ("0.08", "1e-30", "marker_size: 1e-30 m: 0.0001 to 10 m is possible"),
        ("[[900, 0, 6", "[[900, 0, 1e3", r"matrix: 1e\+300 px: -1e\+06 to 1e\+06 px is possible"),
        ("[[900", "[[1e300", r"matrix: 1e\+300 px: 1 to 1e\+06 px is possible"),
        ("1]]}", "1]], distortion: [1e99, 0, 0, 0]}", r"distortion: 1e\+99: -1e\+06 to 1e\+06"),
        ("1: [1, 0]", "one: [1, 0]", "a whole number belongs here, found 'one'"),
        ("{0: [0, 0], 1: [1, 0]}", "{}", "marker_centers: at least 1 belongs here"),
        ("0.012", "-0.012", "standoff: must not be smaller than 0"),
        ("[[900, 0", "[[-900, 0", "positive fx and fy"),
        (", [0, 0, 1]]", "]", "camera.matrix has only 2 of its values"),
        ("[[900, 0,", "[[900, 3,", "camera.matrix: must read .*fx, 0, cx"),
        *(
            (
                "1]]}",
                f"1]], distortion: {[0.1] * n}}}",
                f"distortion: found {counted(n, 'number')}; OpenCV knows 4, 5",
            )
            for n in (1, 6, 13, 15)
        ),
    ],
)
def test_mistakes_in_board_and_camera(tmp_path, old, new, message):
    parts = f"{CAMERA}, {BOARD}"
    assert old in parts
    with pytest.raises(ConfigError, match=message):
        load_images(tmp_path, parts.replace(old, new))


def test_reference_points_are_two(tmp_path):
    with pytest.raises(ConfigError, match="points: the two points are the same"):
        load_images(tmp_path, REFERENCE.replace("[1, 0]", "[0, 0]"))
    with pytest.raises(ConfigError, match="pixels has only 1 of its values"):
        load_images(tmp_path, REFERENCE.replace(", [9, 0]", ""))


@pytest.mark.parametrize(
    ("old", "new", "warning"),
    [
        ("4.55e8", "455", "youngs_modulus 455 Pa is softer than any cable"),
        ("length: 0.8", "length: 81", "81 m long, but its ends are never more than 0.5"),
        ("-9.81", "-9810", "gravity is 9810 m/s"),
        (
            "-9.81",
            "-1",
            "gravity is 1 m/s^2, on Earth 9.81; a stiffness is found in proportion to ",
        ),
        ("-9.81", "-1", "in units of g? Try: [0.0, -9.81]"),
        ("-9.81", "-1.62", "gravity is 1.62 m/s^2, on Earth 9.81"),  # the Moon's
        ("3e-4", "0.02", "std 0.02 m is large"),
    ],
)
def test_what_looks_odd_is_a_warning(tmp_path, old, new, warning):
    config = load(tmp_path, (old, new))
    assert any(warning in text for text in config.warnings), config.warnings


@pytest.mark.parametrize(
    ("end", "degrees", "radians"), [("start", "-65", "-1.134"), ("end", "-360", "-6.283")]
)
def test_headings_in_degrees_are_a_mistake(tmp_path, end, degrees, radians):
    clamped = (f"{end}: pinned", f"{end}: clamped")
    text = rf"{end}_heading: {degrees} rad: in degrees\? then {radians}"
    with pytest.raises(ConfigError, match=rf"line 12: pose 1 \(a.csv\): {text}\n"):
        load(tmp_path, clamped, ("end: [0.", f"{end}_heading: {degrees}, end: [0."))


def test_headings_of_up_to_a_turn_and_of_coils_are_allowed(tmp_path):
    clamped = ("{start: pinned, end: pinned}", "{start: clamped, end: clamped}")
    headings = "start_heading: -6.283186, end_heading: -18.85, end: [0."
    poses = load(tmp_path, clamped, ("end: [0.", headings)).experiment.poses
    assert [(pose.start_heading, pose.end_heading) for pose in poses] == 3 * [(-6.283186, -18.85)]


def test_yaml_round_trip_keeps_every_digit_and_the_order(tmp_path):
    rng = np.random.default_rng(0)
    shared = [1.0, 2.0]
    data = {
        "zeta": 1 / 3,
        "alpha": rng.normal(size=5) * 10.0 ** rng.integers(-300, 300, size=5),
        "tiny": np.float64(1e-5),
        "count": np.int64(7),
        "flag": np.bool_(True),
        "none": None,
        "tuple": (1, 2.5, "three"),
        "twice": [shared, shared],
        "texts": ["1e-3", "012", "1:30", "2024-01-01", "yes", "null", "1.2.3", "", "Größe: µm"],
        "path": Path("a/b.csv"),
        "limits": [math.inf, -math.inf],
        "empty": [{}, []],
    }
    text = dump_yaml(data)
    path = tmp_path / "parameters.yaml"
    path.write_text(text, encoding="utf-8")
    back = read_yaml(path)
    assert list(back) == list(data)
    assert "*" not in text
    assert back["alpha"] == data["alpha"].tolist()
    assert back["tuple"] == [1, 2.5, "three"]
    assert back["path"] == "a/b.csv"
    for key in ("zeta", "tiny", "count", "flag", "none", "twice", "texts", "limits", "empty"):
        assert back[key] == data[key], key
    assert yaml.safe_load(text) == back, "plain YAML 1.1 readers see the same data"


def test_dump_refuses_what_is_no_data():
    with pytest.raises(TypeError, match="object cannot be written as YAML"):
        dump_yaml({"a": object()})


# ---- readings ------------------------------------------------------------------------------------


def read_at(folder: Path, readings: str, *changes: tuple[str, str]) -> Config:
    """The good configuration with readings at its second pose."""
    return load(folder, ("end: [0.4, 0.1]", f"end: [0.4, 0.1], {readings}"), *changes)


def test_readings_of_a_pose(tmp_path):
    config = read_at(tmp_path, "end_force: [1, -2], start_moment: 0.1")
    pose = config.experiment.poses[1]
    assert pose.readings == {"end_force": (1.0, -2.0), "start_moment": (0.1,)}
    assert set(declared_setup(config).readings) == {"end_force", "start_moment"}
    assert config.experiment.poses[0].readings == {}


def test_moments_about_directions_that_nothing_holds_are_questioned(tmp_path):
    """In a plane a pin has none; in space a swivel has none about the cable's axis."""
    (said,) = read_at(tmp_path, "end_moment: 0.2").warnings
    assert said.startswith("end_moment of b: 0.2 N m, but a pinned end lets the cable turn there")
    assert "Try: boundary.end: clamped" in said
    assert not read_at(tmp_path, "end_moment: 1e-4").warnings

    turned = Rotation.from_rotvec([0.0, 0.0, np.pi / 2])  # the cable ends along y
    held = {"start_orientation": turned, "end_orientation": turned}
    for moment, count in (((0.2, 0.0, 0.2), 0), ((0.0, 0.2, 0.0), 1)):
        points = [[0, 0, 0], [0.2, 0.1, 0], [0.5, 0.1, 0]]
        pose = dlo.Pose((0, 0, 0), points[-1], points=points, end_moment=moment, **held)
        cable = dlo.Cable(length=0.8, mass=0.05, diameter=0.005, bending_stiffness=0.01)
        swivels = {"gravity": (0, 0, -9.81), "boundary": ("swivel", "swivel")}
        found = [x for x in dlo.Session(cable, [pose], **swivels).warnings if "end_moment" in x]
        assert len(found) == count
        assert all("0.2 N m about the cable's axis, but a swivel end" in x for x in found)


@pytest.mark.parametrize(
    ("readings", "said"),
    [
        ("end_force: [1, -2, 3]", r"end_force: \[fx, fy\] belongs here"),
        ("end_moment: [1, 2, 3]", "end_moment: one number belongs here"),
        ("end_moment: [1, 2]", r"one number belongs here, in space three \[mx, my, mz\]"),
        ("end_force: [1.0e+7, 0]", "end_force: 1e"),
    ],
)
def test_readings_that_cannot_be(tmp_path, readings, said):
    with pytest.raises(ConfigError, match=said):
        read_at(tmp_path, readings)


def test_a_mass_that_is_not_declared_takes_a_reading(tmp_path):
    unknown = ("mass: 0.23", "mass: null")
    with pytest.raises(
        ConfigError, match=r"stiffness to weight. Try: the mass in kg, or end_force"
    ):
        load(tmp_path, unknown)
    config = read_at(tmp_path, "end_force: [1, -2]", unknown)
    solid = DENSITY * math.pi / 4 * config.cable.diameter**2 * config.cable.length
    assert config.cable.prior_mass == pytest.approx(solid)
    assert any("cable.mass is not declared" in text for text in config.warnings)
    with pytest.raises(ConfigError, match=r"5: cable.diameter: 0.5 m: a solid .* 3.5e\+02 kg"):
        read_at(tmp_path, "end_force: [1, -2]", unknown, ("1.28e-2", "0.5"))
    with pytest.raises(ConfigError, match=r": cable.length: 800000 m") as caught:
        read_at(tmp_path, "end_force: [1, -2]", unknown, ("length: 0.8", "length: 8.0e+5"))
    assert "kg" not in str(caught.value)
    with pytest.raises(ConfigError, match=r"or end_force of a fit pose\n.*bb.csv does not"):
        read_at(tmp_path, "end_force: [1, -2]", unknown, ("b.csv", "bb.csv"))
    with pytest.raises(ConfigError, match="without gravity nothing depends on it"):
        read_at(tmp_path, "end_force: [1, -2]", unknown, ("[0, -9.81]", "[0, 0]"))


@pytest.mark.parametrize(("std", "meant"), [("0.3", "0.0003"), ("0.05", "5e-05")])
def test_noise_in_millimetres_is_refused_at_once(tmp_path, std, meant):
    text = f"std: {std} m: 1e-07 to 0.04 m is possible for a cable of 0.8 m: units are SI, did you "
    with pytest.raises(ConfigError, match=rf"line 10: .*{text}mean {meant}\?"):
        load(tmp_path, ("3e-4", std))


def session_of_readings(d, **noise):
    """Three poses with forces of about 0.5 N and moments of about 5 mN m, as arguments."""
    cable = dlo.Cable(length=0.8, mass=0.05, diameter=0.006, bending_stiffness=0.01)
    points = np.linspace([0.0] * d, [0.5] + [0.0] * (d - 1), 4)
    read = {"end_force": (0.5, -0.4, 0.3)[:d], "end_moment": 0.005 if d == 2 else (0.005,) * 3}
    poses = [dlo.Pose((0,) * d, points[-1], points=points, **read) for _ in range(3)]
    pins = ("pinned", "pinned")
    return dlo.Session(cable, poses, gravity=(0,) * (d - 1) + (-9.81,), boundary=pins, **noise)


@pytest.mark.parametrize("d", [2, 3])
def test_noise_of_readings_beyond_the_readings_is_refused(d):
    """Noise adds to a reading: readings far below their noise contradict it."""
    session_of_readings(d, force_std=0.5, moment_std=0.005)
    text = r"force_std: 10 N, but the readings of a force are 0\.4\d? N RMS .* did you mean 0.01\?"
    with pytest.raises(ConfigError, match=text):
        session_of_readings(d, force_std=10.0)
    with pytest.raises(ConfigError, match="moment_std: 1 N m, but the readings of a moment are 0"):
        session_of_readings(d, moment_std=1.0)
    with pytest.raises(ConfigError, match=r"std: 0.3 m: .* did you mean 0.0003"):
        session_of_readings(d, std=0.3)
