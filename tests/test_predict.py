"""Predictions from a file of fitted parameters: physics, defaults, messages."""

import json
import re
from dataclasses import replace
from io import BytesIO
from pathlib import Path

import numpy as np
import pytest
from matplotlib.text import Text
from scipy.optimize import brentq
from scipy.spatial.transform import Rotation

from dlo_casadi import predict
from dlo_casadi.cable.file import load
from dlo_casadi.cable.saved import parameters_hash
from dlo_casadi.cli import main
from dlo_casadi.config import dump_yaml, load_config, read_yaml
from dlo_casadi.errors import DloError, EquilibriumError
from dlo_casadi.estimation.fit import fit_model
from dlo_casadi.report.documents import fit_dict, shared_fixtures
from dlo_casadi.session.fitting import declared_model
from dlo_casadi.session.measure import measured_poses, read_inputs

BENCH = Path(__file__).parent / "data" / "bench"
ROOT = Path(__file__).parents[1]


def results(path, folder, n=20, damping_time=None):
    """A folder of results of a quick fit that holds parameters.yaml alone."""
    config = load_config(path)
    measured = measured_poses(config, read_inputs(config))
    declared = declared_model(config)
    model = declared.model.with_mesh(n)
    model = replace(model, cable=replace(model.cable, damping_time=damping_time))
    fit = fit_model(model, measured[:4], declared.tolerances, 3e-4)
    document = fit_dict(fit)
    document["fixtures"] = shared_fixtures(config)
    document["model_hash"] = parameters_hash(document)
    folder.mkdir(parents=True)
    (folder / "parameters.yaml").write_text(dump_yaml(document))
    return folder / "parameters.yaml"


@pytest.fixture(scope="module")
def pinned(tmp_path_factory):
    path = BENCH / "short_clean/session.yaml"
    return results(path, tmp_path_factory.mktemp("pinned") / "results" / "cable")


def test_a_cable_that_was_fitted_with_motions_is_read_back_and_moves(tmp_path):
    file = results(BENCH / "overhang/session.yaml", tmp_path / "rope", n=8, damping_time=0.02)
    cable = load(file.parent)
    assert cable.params["damping_time"].value > 0
    pose = {"start": (0.0, 0.0), "start_heading": 0.0}
    assert cable.simulate([0.0, 0.1], **pose).points.shape == (2, 101, 2)


@pytest.fixture(scope="module")
def overhang(tmp_path_factory):
    path = BENCH / "overhang/session.yaml"
    return results(path, tmp_path_factory.mktemp("free") / "results" / "cable")


@pytest.fixture(scope="module")
def loom(tmp_path_factory):
    path = ROOT / "configs/markers_in_space.yaml"
    return results(path, tmp_path_factory.mktemp("space") / "results" / "loom", n=8)


def test_the_cable_spans_from_start_to_end(pinned):
    shape = predict(pinned, end=(0.3, -0.1))
    points = shape.curve.at(np.linspace(0.0, shape.curve.length, 201))

    # The fitted end_offset is within its tolerance of 0.2 mm, a few of which are seen.
    assert points[0] == pytest.approx([0.0, 0.0], abs=1e-9)
    assert points[-1] == pytest.approx([0.3, -0.1], abs=1e-3)
    length = np.hypot(*np.diff(points, axis=0).T).sum()
    assert length == pytest.approx(0.55, abs=2e-3)  # length_error is within 0.5 mm, mesh of 20
    assert shape.stable


def test_reactions_carry_the_weight(pinned):
    shape = predict(pinned, end=(0.3, -0.1))

    assert shape.end_force + shape.start_force == pytest.approx([0.0, -0.2 * 9.81], abs=1e-9)


def test_the_reaction_is_the_slope_of_the_energy(pinned):
    """-lam = dV/d(end), by central differences of step h: error of order h^2."""
    h, end = 1e-4, np.array([0.3, -0.1])
    cable = load(pinned)
    slope = [
        (predict(cable, end + step).energy - predict(cable, end - step).energy) / (2 * h)
        for step in h * np.eye(2)
    ]
    assert -predict(cable, end).end_force == pytest.approx(slope, rel=1e-4)


def test_the_bend_radius_is_that_of_the_curve(pinned):
    shape = predict(pinned, end=(0.3, -0.1))
    s = np.linspace(0.0, shape.curve.length, 2001)
    x, y = shape.curve.at(s).T
    heading = np.unwrap(np.arctan2(np.gradient(y, s), np.gradient(x, s)))
    sharpest = np.abs(np.gradient(heading, s)[20:-20]).max()

    # Cells of 1/20 of the length have one curvature each: a tenth of a radius at most.
    assert shape.min_bend_radius == pytest.approx(1 / sharpest, rel=0.1)


def test_arc_lengths_beside_the_cable_are_refused(pinned):
    shape = predict(pinned, end=(0.3, -0.1))
    length = shape.curve.length

    ends = shape.curve.at([0.0, length * (1 + 1e-12)])  # beyond the end by rounding alone
    assert ends == pytest.approx(shape.points[[0, -1]], abs=1e-12)
    for wrong in ([-0.1, 2.0], [0.1, np.nan]):
        with pytest.raises(DloError, match=r"is not on the cable: . of 2 .* outside 0 to 0.55 m"):
            shape.curve.at(wrong)
    for strange in (3, -1):
        with pytest.raises(DloError, match=f"derivative: 0, 1 or 2 belongs here, found {strange}"):
            shape.curve.at([0.1], strange)


@pytest.mark.parametrize("end", [(0.3, -0.1), (0.02, -0.5), (0.5, 0.1)])
def test_the_numbers_at_the_arrows_lie_inside_the_axes(pinned, end):
    drawing = predict(pinned, end=end).plot()
    drawing.savefig(BytesIO())  # places everything
    (axes,) = drawing.axes
    numbers = [text for text in axes.texts if text.get_text().endswith(" N")]

    assert len(numbers) == 2
    inside = axes.get_window_extent()
    for text in numbers:
        box = Text.get_window_extent(text)
        assert inside.x0 < box.x0 < box.x1 < inside.x1
        assert inside.y0 < box.y0 < box.y1 < inside.y1


def test_frames_follow_the_curve(pinned, loom):
    """Right-handed and orthonormal; at the start in space the clamp's own, to errors of the fit."""
    for shape in (predict(pinned, end=(0.3, -0.1)), predict(loom, **IN_SPACE)):
        d = shape.points.shape[1]
        ahead = np.diff(shape.points, axis=0)
        ahead /= np.linalg.norm(ahead, axis=1, keepdims=True)
        middle = (shape.frames[1:] + shape.frames[:-1])[:, :, 0] / 2
        assert middle == pytest.approx(ahead, abs=1e-3)  # steps of up to 0.04 rad
        assert np.linalg.det(shape.frames) == pytest.approx(1.0)
        assert shape.frames.swapaxes(1, 2) @ shape.frames == pytest.approx(
            np.tile(np.eye(d), (101, 1, 1)), abs=1e-12
        )
    clamp = Rotation.from_quat(shape.pose.start_orientation).as_matrix()
    assert shape.frames[0] == pytest.approx(clamp, abs=0.02)


def test_branches_turn_the_way_they_are_named(pinned):
    turn = {}
    for branch in ("ccw", "cw"):
        phi = predict(pinned, (0.2, 0.0), branch=branch).equilibrium.phi
        turn[branch] = phi[-1] - phi[0]
    assert turn["ccw"] > 0 > turn["cw"]


def test_a_moved_start_moves_the_cable(pinned):
    here = predict(pinned, end=(0.3, -0.1)).points
    there = predict(pinned, start=(1.0, 2.0), end=(1.3, 1.9)).points

    assert there - here == pytest.approx(np.tile([1.0, 2.0], (101, 1)), abs=1e-6)


def test_an_end_out_of_reach_is_told_with_numbers(pinned):
    message = (
        # The fitted end_offset moves the end by some tenths of a millimetre.
        r"the end \(0.9000, 0.0000\) m is 0\.(?:899|900)\d m from the start, "
        r"the cable is 0\.5\d\d\d m long"
    )
    with pytest.raises(EquilibriumError, match=message) as caught:
        predict(pinned, end=(0.9, 0.0))
    assert caught.value.p_des == (0.9, 0.0)
    said = caught.value.message
    assert said.startswith("short_clean: no equilibrium")
    assert said.endswith("Try: an end in metres, nearer to the start.")


def test_what_a_fit_has_found_of_the_fixtures_is_told(pinned):
    shape = predict(pinned, end=(0.3, -0.1))
    x, y = shape.points[-1]
    assert (x, y) != (0.3, -0.1)  # the fitted end_offset
    assert f"end of the cable: ({x:.5f}, {y:.5f}) m: fixture errors of the fit" in str(shape)


@pytest.mark.parametrize("tolerance", [None, 5e-4])
def test_a_found_offset_of_an_obstacle_is_told_to_be_unused(pinned, tmp_path, capsys, tolerance):
    """Not one within its tolerance, which every session with obstacles has."""
    document = read_yaml(pinned)
    document["effects"].append({"name": "obstacle_offset", "label": "obstacle_offset"})
    row = {"value": 0.004, "std": 4e-5, "unit": "m", "fitted": True, "tolerance": tolerance}
    document["parameters"]["obstacle_offset.offset"] = row
    (tmp_path / "parameters.yaml").write_text(dump_yaml(document))
    assert main(["predict", str(tmp_path), "--end", "0.3", "-0.1"]) == 0
    text = " ".join(capsys.readouterr().out.split())
    said = "the fit has obstacle_offset.offset 0.004000 ± 0.000040 m; a prediction uses neither"
    assert (said in text) is (tolerance is None)


def test_folders_of_results_are_suggested_not_configurations(pinned, tmp_path):
    results = pinned.parents[1]
    with pytest.raises(DloError, match=re.escape(f"of results.\n  Try: {results / 'cable'}")):
        predict(results / "cabel", end=(0.3, -0.1))
    with pytest.raises(DloError, match=re.escape(f"Try: {results / 'cable'}")):
        predict(results.parent / "nowhere", end=(0.3, -0.1))
    bare = tmp_path / "alone" / "bare"
    bare.mkdir(parents=True)
    with pytest.raises(DloError, match=r"no parameters\.yaml in this folder\.\n  Try: the res"):
        predict(bare, end=(0.3, -0.1))


PLANE = {"kind": "plane", "point": (0.0, -0.2), "normal": (0.0, 1.0)}


@pytest.mark.parametrize(
    ("held", "message"),
    [
        ({"obstacles": [PLANE | {"kind": "plan"}]}, r"obstacles\[0\]\.kind: allowed are 'plane'"),
        ({"obstacles": [PLANE, PLANE | {"pont": 1}]}, r"'pont' in obstacles\[1\]; .*'point'"),
        ({"obstacles": PLANE}, "obstacles: a list belongs here, found a mapping"),
        ({"clips": {"kind": "eyelet"}}, "clips: a list belongs here, found a mapping"),
        (
            {"obstacles": [PLANE | {"point": (0.0, 0.1)}]},
            r"inside obstacle_1\.\n  Try: the obstacle's place, or its normal\.",
        ),
        (
            {"clips": [{"kind": "pinned", "at": 0.1, "place": (0.2, 0.0)}]},
            r"clip_1 are 0\.2000 m apart.*\n  Try: places and arc lengths in metres",
        ),
    ],
)
def test_what_is_wrong_between_the_ends_is_named(pinned, held, message):
    with pytest.raises(DloError, match=message):
        predict(pinned, end=(0.3, -0.1), **held)


def test_a_free_end_hangs(overhang):
    shape = predict(overhang, start_heading=0.0)

    assert shape.end_force == pytest.approx([0.0, 0.0])
    assert shape.start_force == pytest.approx([0.0, -0.02 * 9.81], abs=1e-9)
    assert shape.points[-1, 1] < 0


IN_SPACE = {"end": (0.7, -0.3, 0.35), "end_orientation": (0.1, -0.1, 0.1, 0.98489)}


def test_a_cable_in_space_leaves_its_grippers_along_their_axes(loom):
    shape = predict(loom, **IN_SPACE)
    points = shape.points

    # Tolerances of 0.2 mm and 5 mrad, of which the fit takes up to two.
    assert points[0] == pytest.approx([0.4, -0.2, 0.3], abs=1e-9)
    assert points[-1] == pytest.approx(IN_SPACE["end"], abs=1e-3)
    ends = shape.curve.at([0.0, shape.curve.length], 1)
    frames = Rotation.from_quat([shape.pose.start_orientation, shape.pose.end_orientation])
    assert ends == pytest.approx(frames.apply([1.0, 0.0, 0.0]), abs=2e-2)
    eq = shape.equilibrium
    assert eq.end_force + eq.start_force == pytest.approx([0.0, 0.0, -0.03 * 9.81], abs=1e-9)
    said = str(shape)
    assert "end: (0.7, -0.3, 0.35) m" in said
    assert len(re.findall(r"moment of the cable on its \w+: \(.*, .*, .*\) N m", said)) == 2
    assert shape.plot().axes[0].name == "3d"


def test_the_reaction_in_space_is_the_slope_of_the_energy(loom):
    """-lam = dV/d(end), by central differences of step h: error of order h^2."""
    h, cable = 1e-4, load(loom)

    def energy(step):
        moved = np.add(IN_SPACE["end"], step)
        return predict(cable, **(IN_SPACE | {"end": moved})).energy

    slope = [(energy(step) - energy(-step)) / (2 * h) for step in h * np.eye(3)]
    assert -predict(cable, **IN_SPACE).end_force == pytest.approx(slope, rel=1e-4)


def test_turns_that_slip_off_over_a_loop_are_an_error(loom):
    with pytest.raises(
        EquilibriumError, match=r"does not hold 20 turns of twist .*loops until -0\.16"
    ):
        predict(loom, **IN_SPACE, turns=20)


def test_turns_twist_the_cable(loom):
    """White's theorem: a turn of the end is twist and writhe, and the cable has some of each."""
    twist = [predict(loom, **IN_SPACE, turns=turns).equilibrium.twist for turns in (-1, 0, 1)]
    total = [values.mean() * 0.6 for values in twist]
    assert total[0] < total[1] - 1 < total[1] + 1 < total[2]


@pytest.fixture(scope="module")
def evenly_rolled(loom):
    """Ends of the loom of which both ways round are equally low; rolled by so much more [rad]."""
    held = load(loom).metadata.fixtures
    frame = Rotation.from_quat(held["start_orientation"])
    end = held["start"] + frame.apply([0.45, 0.0, 0.0])

    def rolled(angle):
        turned = frame * Rotation.from_rotvec([angle, 0.0, 0.0])
        return {"end": tuple(end), "end_orientation": tuple(turned.as_quat())}

    def excess(angle):
        ways = [predict(loom, **rolled(angle), turns=turns) for turns in (0.5, -0.5)]
        return ways[0].energy - ways[1].energy

    even = brentq(excess, 2.4, 3.9, xtol=1e-5)
    return lambda more: rolled(even + more)


def test_near_half_a_turn_both_ways_round_are_predicted(loom, evenly_rolled):
    """By how much more the clamp is rolled is the angle; it is known no better than end_roll."""
    std = load(loom).params["end_roll"].std
    for more, turns in ((-0.5 * std, 0.5), (0.5 * std, -0.5)):
        ends = evenly_rolled(more)
        shape = predict(loom, **ends)
        assert (shape.pose.turns, shape.other_side.pose.turns) == (turns, -turns)
        assert shape.tipping.angle == pytest.approx(0.5 * std, abs=1e-4)
        assert std < shape.tipping.std
        for side in (shape, shape.other_side):
            told = predict(loom, **ends, turns=side.pose.turns)
            assert told.other_side is None
            assert side.points == pytest.approx(told.points, abs=1e-8)
        assert shape.energy < shape.other_side.energy
    for far in (-1.0, 1.0):
        assert predict(loom, **evenly_rolled(far)).other_side is None


def test_the_command_tells_both_ways_round(loom, evenly_rolled, capsys):
    std = load(loom).params["end_roll"].std
    ends = evenly_rolled(-0.5 * std)
    numbers = {key: [str(x) for x in ends[key]] for key in ("end", "end_orientation")}
    asked = ["--end", *numbers["end"], "--end-orientation", *numbers["end_orientation"]]
    assert main(["predict", str(loom), *asked, "--json"]) == 0
    printed = json.loads(capsys.readouterr().out)
    other = printed["other_side"]
    assert (printed["turns"], other["turns"]) == (0.5, -0.5)
    assert printed["energy"] < other["energy"]
    apart = np.linalg.norm(np.subtract(printed["points"], other["points"]), axis=1).max()
    assert other["greatest_distance"] == pytest.approx(apart)
    assert main(["predict", str(loom), *asked]) == 0
    said = " ".join(capsys.readouterr().out.split())
    assert "this side `turns: 0.5`" in said
    assert f"`turns: -0.5`: {other['energy']:.6g} J, up to {1e3 * apart:.3g} mm away" in said
    assert main(["predict", str(loom), *asked, "--turns", "0.5", "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["other_side"] is None
    assert np.allclose(told["points"], printed["points"], rtol=0, atol=1e-8)
    shape = predict(loom, **ends)
    assert [line.get_label() for line in shape.plot().axes[0].lines][:2] == [
        "cable",
        "on the other side",
    ]


def test_the_command_takes_what_the_function_takes(loom, capsys):
    asked = ["--end", "0.7", "-0.3", "0.35", "--end-orientation", "0.1", "-1e-1", "0.1", "0.98489"]
    assert main(["predict", str(loom), *asked, "--turns", "1", "--json"]) == 0
    printed = json.loads(capsys.readouterr().out)
    assert printed == predict(loom, **IN_SPACE, turns=1).as_dict()
    assert printed["turns"] == 1.0
    assert "end_heading" not in printed
    assert main(["predict", str(loom), *asked]) == 0
    assert "moment of the cable on its end" in capsys.readouterr().out
    table = ["shape-table", str(loom), "--list", "ends.csv", "--output", "table.parquet"]
    assert main(table) == 2
    assert "is in space: tables hold shapes in a plane" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("file", "ends", "message"),
    [
        (
            "loom",
            IN_SPACE | {"end": (0.7, -0.3)},
            "end: [x, y, z] belongs here (three numbers of gravity), found (0.7, -0.3)",
        ),
        ("loom", IN_SPACE | {"end_heading": 0.0}, "is in space (three numbers of gravity)"),
        ("loom", IN_SPACE | {"branch": "cw"}, "is in space: a branch has no meaning"),
        (
            "loom",
            IN_SPACE | {"turns": float("inf")},
            "turns: a finite number belongs here, found inf",
        ),
        (
            "loom",
            IN_SPACE | {"end_orientation": (0.1, 0.1, 0.1, 0.5)},
            "end_orientation: a unit quaternion [qx, qy, qz, qw] belongs here, its length is 0.529",
        ),
        ("loom", {"end": (0.7, -0.3, 0.35)}, "give end_orientation [qx, qy, qz, qw]"),
        ("pinned", {"end": (0.3, 0.0), "turns": 1}, "has no turns: it is not in space"),
        (
            "overhang",
            {"start_orientation": (0, 0, 0, 1)},
            "is in a plane (two numbers of gravity).\n  Try: start_heading [rad]",
        ),
        ("pinned", {}, "the end of 'short_clean' is pinned: where is it?"),
        ("pinned", {"end": (0.3, float("nan"))}, "end[1]: a finite number belongs here, found nan"),
        ("pinned", {"end": (0.3, 0.1, 0.0)}, "end: [x, y] belongs here (two numbers of gravity)"),
        (
            "loom",
            IN_SPACE | {"end_orientation": (1, 0, 0)},
            "a quaternion [qx, qy, qz, qw] belongs here, found [1, 0, 0]",
        ),
        (
            "pinned",
            {"end": (0.3, 0), "start_heading": 1.0},
            "is pinned: start_heading has no meaning",
        ),
        (
            "pinned",
            {"end": "ab"},
            "end: two numbers [x, y] belong here, in space three [x, y, z], found 'ab'",
        ),
        ("pinned", {"end": (0.3, 0), "branch": "left"}, "branch must be 'ccw', 'cw' or None"),
        ("pinned", {"end": (0.3, 0), "branch": np.array(["ccw", "cw"])}, "None, found array"),
        (
            "overhang",
            {"start_heading": float("nan")},
            "start_heading: a finite number belongs here, found nan",
        ),
        ("overhang", {"end": (0.3, 0.0)}, "the end of 'overhang' is free: it cannot be held"),
        ("overhang", {}, "with no heading that all poses share: give start_heading [rad]"),
    ],
)
def test_ends_that_do_not_suit_the_cable(request, file, ends, message):
    with pytest.raises(DloError, match=re.escape(message)):
        predict(request.getfixturevalue(file), **ends)


def test_what_is_no_path_is_told():
    with pytest.raises(DloError, match=r"3 is no path.\n  Try: the parameters.yaml"):
        predict(3, end=(0.3, 0.0))


def test_the_configuration_of_the_readme_is_one(tmp_path):
    (block,) = re.findall(r"```yaml\n(.*?)```", (ROOT / "README.md").read_text(), re.DOTALL)
    (tmp_path / "config.yaml").write_text(block)
    for k in (1, 2, 3):
        (tmp_path / f"pose_0{k}.csv").write_text("x_m,y_m\n0,0\n0.1,0\n")

    config = load_config(tmp_path / "config.yaml")
    assert config.warnings == ()
    assert config.skipped == ()


def test_a_checked_export_rests_nearest_to_the_measured_cable(loom, tmp_path, capsys, monkeypatch):
    """Of the simulator's own stiffness, the first guess and the fitted one the last is the best."""
    pytest.importorskip("mujoco", reason="the extra `peers` is not installed")
    monkeypatch.chdir(tmp_path)
    session = str(ROOT / "configs/markers_in_space.yaml")
    code = main(
        [
            "export",
            str(loom),
            "--to",
            "mujoco",
            "--output",
            "loom.xml",
            "--segments",
            "24",
            "--check",
            session,
            "--figure",
            "check.png",
            "--json",
        ]
    )
    told = json.loads(capsys.readouterr().out)

    assert code == 0
    assert told["files"] == ["loom.xml"]
    assert (tmp_path / "check.png").stat().st_size > 10_000
    found = told["check"]["summary"]
    rms = [found[case]["to_measured"]["rms"] for case in ("default", "first guess", "identified")]
    assert rms[2] < 0.5 * rms[1] < rms[1] < rms[0]
    assert found["identified"]["to_prediction"]["largest"] < 0.01
    assert not any(case["problems"] for case in found.values())


def test_a_wrong_export_is_refused_before_anything_is_written(loom, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    held = ["--end", *map(str, IN_SPACE["end"]), "--end-orientation", "0.1", "-0.1", "0.1", "1"]
    for more, said in (
        (["--to", "mjx"], "MJX ignores bend and twist"),
        (["--to", "mujocco"], "did you mean 'mujoco'"),
        (["--to", "mujoco", "--figure", "a.png"], "--figure draws the check"),
        (["--to", "mujoco", "--check", "gone.yaml"], "gone.yaml"),
    ):
        assert main(["export", str(loom), *held, *more]) == 2
        assert said in capsys.readouterr().err
    assert not list(tmp_path.iterdir())
