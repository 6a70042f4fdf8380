"""Limits of a shape: value, probability, where it is tight, and messages for bad input."""

import json
import re
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml
from scipy.stats import norm

import dlo_casadi as dlo
from dlo_casadi.cable.limits import LimitCheck, Resolved, _main_cause
from dlo_casadi.cli import main
from dlo_casadi.codegen import CompiledSolver
from dlo_casadi.config import Limits, dump_yaml, load_config, read_yaml
from dlo_casadi.effects import CableData, ClipSlip, ObstacleOffset
from dlo_casadi.equilibrium.limits import Exceedance, _counted, _crossing
from dlo_casadi.equilibrium.pose import HeldPose
from dlo_casadi.equilibrium.solve import solve_equilibrium
from dlo_casadi.equilibrium.spread import SolvedCable, Uncertainty, cause_of
from dlo_casadi.errors import ConfigError, DloError
from dlo_casadi.estimation.fit import fit_model
from dlo_casadi.model.cable_model import CableModel
from dlo_casadi.model.pose_scatter import PoseScatter
from dlo_casadi.report.documents import fit_dict, shared_fixtures
from dlo_casadi.session.fitting import declared_model
from dlo_casadi.session.measure import measured_poses, read_inputs

KNOWN = Uncertainty((), np.zeros((0, 0)), {}, PoseScatter())
BENCH = Path(__file__).parent / "data/bench/short_clean"
DOWN, UP = -np.pi / 2, np.pi / 2


def check(model, pose, uncertainty, **limits) -> dict[str, LimitCheck]:
    rest = np.zeros(model.chain.n_rests)
    shape, none = SolvedCable.of(model, model.nominal, rest, pose), np.zeros(model.n_coefficients)
    checks = Resolved(shape, none, Limits(**limits)).checks(uncertainty)
    return {item.quantity: item for item in checks}


def draws(*shape):
    return np.random.default_rng(0).standard_normal((20000, *shape))


@pytest.mark.parametrize(
    ("slopes", "bound", "exact"),
    [
        ([[0.6, 0.8]], 1.5, norm.sf(1.5)),
        ([[0.6, 0.8]], 6.0, norm.sf(6.0)),  # 1e-9: no draw is there
        ([[1.0, 0.0], [0.0, 1.0]], 1.5, 1 - norm.cdf(1.5) ** 2),  # two independent bends
        ([[1.0, 0.0], [0.99999999, 0.0]], 1.5, norm.sf(1.5)),  # the same one twice
        ([[1.0, 0.0], [-1.0, 0.0]], 1.5, 2 * norm.sf(1.5)),
        ([[0.0, 0.0]], 1.5, 0.0),
        ([[0.0, 0.0]], -1.5, 1.0),
    ],
)
def test_several_places_exceed_together_as_closed_forms_say(slopes, bound, exact):
    """Within three standard errors of 20,000 draws across the likeliest direction: 1 %."""
    slopes = np.array(slopes)
    found = _crossing(np.zeros(len(slopes)), slopes, bound, draws(2))
    assert found == pytest.approx(exact, rel=0.01)


def test_a_count_is_corrected_by_the_same_draws_to_first_order():
    """P(z + w > 1.5) with z known to first order and w not: errors are as told, and smaller."""
    estimates, told = [], []
    for seed in range(200):
        z, w = np.random.default_rng(seed).standard_normal((2, 500)) * [[1.0], [0.1]]
        chance, error = _counted(z + w > 1.5, z > 1.5, norm.sf(1.5))
        estimates.append(chance)
        told.append(error)
    exact = norm.sf(1.5 / np.hypot(1.0, 0.1))
    spread = np.std(estimates)
    assert np.mean(estimates) == pytest.approx(exact, abs=3 * spread / np.sqrt(200))
    assert np.mean(told) == pytest.approx(spread, rel=0.2)  # a fifth: four errors of 200 draws
    assert spread < 0.5 * np.sqrt(exact * (1 - exact) / 500)
    nothing = np.zeros(5, dtype=bool)
    assert _counted(nothing, nothing, 0.0) == (0.0, 0.0)
    assert _counted(~nothing, nothing, 0.0) == (1.0, 0.0)


def test_a_stiff_cantilever_bends_as_its_stiffness_lets_it():
    """At the clamp k = w L^2 / 2 EI, and EI is log-normal: P(k > c) has a closed form.

    Its tip sinks by 0.6 % of its length. The mesh changes the radius by less than 1 % on half the
    elements, so that a third of it, 0.3 %, is left.
    """
    model = CableModel(CableData(0.5, 0.1, 0.01, 5.0), 10, start="clamped", end="free", n_rest=0)
    straight = 0.1 * 9.81 * 0.5 / 2 / 5.0  # 1/m
    # To first order the last two are 12 % and 0.3 %; of a normal EI they would be 19 % and 7 %.
    for share, sigma in ((0.1, -1.0), (0.3, 1.0), (0.3, 2.0)):
        covariance = np.array([[(share * 5.0) ** 2]])
        known = Uncertainty(("bending_stiffness",), covariance, {}, PoseScatter())
        limit = 1 / (straight * np.exp(share * sigma))
        pose = HeldPose((0.0, 0.0), start_heading=0.0)
        item = check(model, pose, known, bend_radius=limit)["bend_radius"]
        assert item.value == pytest.approx(1 / straight, rel=4e-3)
        assert item.std == pytest.approx(share / straight, rel=6e-3)
        assert item.probability == pytest.approx(norm.sf(sigma), abs=0.015)
        assert 0 < item.error < np.sqrt(item.probability * (1 - item.probability) / item.draws)
        assert item.at == 0.0
        assert item.shares["parameters"] == pytest.approx(1.0)
        assert item.verdict == ("fail" if sigma < 0 else "risk")


def test_repeats_that_snap_to_the_other_side_violate_any_limit():
    """A soft cable leans back over its clamp; turned on, it falls to the other side at a fold."""
    length, weight = 0.8, 1.0
    data = CableData(length, weight * length / 9.81, 0.01, weight * length**3 / 15)
    model = CableModel(data, 8, "arc", start="clamped", end="free", n_rest=0)
    rest, upright, step = np.zeros(model.chain.n_rests), np.pi / 2, 0.2

    def at(heading: float, near: np.ndarray):
        x = near + (heading - near[0]) * (1 - model.chain.places[:, None] / length)
        pose = HeldPose((0.0, 0.0), start_heading=heading)
        return pose, solve_equilibrium(model, model.nominal, rest, pose, x_init=x)

    fold, (_, eq) = upright, at(upright, np.linspace(upright, -upright, 9)[:, None])
    while step > 1e-3:
        further = at(fold + step, eq.x)[1]
        if further.stable and further.turn < 0:
            fold, eq = fold + step, further
        else:
            step /= 2
    assert fold > upright + 0.1
    pose, found = at(fold - 0.05, eq.x)
    known = Uncertainty((), np.zeros((0, 0)), {"start_heading": 0.05}, PoseScatter())
    shape = SolvedCable(model, model.nominal, rest, pose, found)
    none = np.zeros(model.n_coefficients)
    (item,) = Resolved(shape, none, Limits(force=100 * weight)).checks(known)
    # Three standard errors of 2,000 draws, and the step of the search.
    assert item.probability == pytest.approx(norm.sf(1.0), abs=0.03)
    assert (item.lost / item.draws, item.verdict) == (item.probability, "risk")


def test_a_sharp_bend_beside_a_clamp_is_resolved():
    """On 20 elements the radius is 24 % too large, that of the segments beside a clamp, too."""
    cable = CableData(0.5, 0.015, 0.003, 2e-5)
    pose = HeldPose((0.0, 0.0), (0.25, 0.1), start_heading=DOWN, end_heading=UP)

    def model(n):
        return CableModel(cable, n, start="clamped", end="clamped", n_rest=0)

    fine = solve_equilibrium(model(960), model(960).nominal, np.zeros(960), pose)
    coarse = solve_equilibrium(model(20), model(20).nominal, np.zeros(20), pose)
    item = check(model(20), pose, KNOWN, bend_radius=0.05)["bend_radius"]
    assert coarse.min_bend_radius > 1.2 * fine.min_bend_radius
    assert item.value == pytest.approx(fine.min_bend_radius, rel=0.005)
    assert (item.verdict, item.std, item.decided_by) == ("pass", 0.0, "nothing is uncertain")


def test_a_force_is_as_likely_beside_a_bend_that_a_finer_mesh_resolves():
    """Its value is that on the fit's mesh, from which the finer one differs by many deviations."""
    model = CableModel(CableData(0.5, 0.05, 0.006, 1e-2), 8, "arc", n_rest=0)
    known = Uncertainty((), np.zeros((0, 0)), {"end_x": 1e-5, "end_y": 1e-5}, PoseScatter())
    pose = HeldPose((0.0, 0.0), (0.32, 0.05))
    shape = solve_equilibrium(model, model.nominal, np.zeros(model.chain.n_rests), pose)
    size = np.linalg.norm([shape.start_force, shape.end_force], axis=1).max()
    std = check(model, pose, known, force=2 * size)["force"].std
    limit = size + std
    alone = check(model, pose, known, force=limit)["force"]
    beside = check(model, pose, known, force=limit, bend_radius=0.01)["force"]
    assert (alone.value, beside.value) == pytest.approx((size, size), rel=1e-12)
    assert beside.std == pytest.approx(std, rel=0.05)
    for item in (alone, beside):
        assert item.probability == pytest.approx(norm.sf(1.0), abs=0.02)
        assert item.verdict == "risk"


@pytest.mark.parametrize(
    ("cause", "size", "said"),
    [
        ("end_x", 2e-3, "2 mm at the end (75 %)"),
        ("start_rotation_y", 0.01, "0.01 rad of the start's orientation (75 %)"),
        ("end_roll", 0.1, "0.1 rad of roll (75 %)"),
        ("repeat", 0.0, "the cable's own scatter (75 %)"),
        ("parameters", 0.0, "the fitted parameters (75 %)"),
    ],
)
def test_the_largest_cause_is_told_with_its_size(cause, size, said):
    cable = CableData(0.5, 0.1, 0.01, 0.02, torsional_stiffness=0.015)
    held = {"start": "clamped", "end": "clamped", "gravity": (0.0, 0.0, -9.81)}
    model = CableModel(cable, 4, n_rest=0, **held)
    of = cause_of(model, cause)
    chance = Exceedance(1.0, 0.5, 0.0, 0, 0, {of: 0.75, "other": 0.25})
    names = {"scatter": {cause: size}, "added": {}}
    names |= {"scatter": {}, "added": {cause: size}} if cause == "end_roll" else {}
    known = replace(KNOWN, **names)
    assert _main_cause(model, known, chance) == said
    assert _main_cause(model, known, replace(chance, std=0.0)) == "nothing is uncertain"


def test_a_chance_is_told_as_far_as_it_is_known():
    model = CableModel(CableData(0.5, 0.1, 0.01, 5.0), 4, start="clamped", end="free", n_rest=0)
    known = Uncertainty(("bending_stiffness",), np.array([[0.25]]), {}, PoseScatter())
    item = check(model, HeldPose((0.0, 0.0), start_heading=0.0), known, force=1.0)["force"]
    for chance, said in ((4e-4, "< 0.1 %"), (0.051, "5.1 %"), (0.5, "50 %"), (0.9996, "> 99.9 %")):
        assert replace(item, probability=chance).chance == said


@pytest.mark.skipif(shutil.which("cc") is None, reason="no C compiler (cc)")
def test_probability_is_the_share_of_shapes_that_the_compiled_solver_finds():
    """2,000 ends, 3 mm off in both directions: three standard errors are 3 %, first order 2 %."""
    model = CableModel(CableData(0.5, 0.05, 0.006, 1e-2), 20, n_rest=0)
    known = Uncertainty((), np.zeros((0, 0)), {"end_x": 3e-3, "end_y": 3e-3}, PoseScatter())
    pose = HeldPose((0.0, 0.0), (0.32, 0.05))
    rest = np.zeros(model.chain.n_rests)
    shape = solve_equilibrium(model, model.nominal, rest, pose)
    radius, force = 0.994 * shape.min_bend_radius, 1.01 * np.linalg.norm(shape.start_force)
    items = check(model, pose, known, bend_radius=radius, force=force)
    ends = np.array(pose.end) + 3e-3 * draws(2)[:2000]
    poses = np.hstack([np.zeros((2000, 2)), ends, np.zeros((2000, 2))])
    solver = CompiledSolver(model, model.nominal, rest, flags=("-O0",))
    shapes, status = solver.solve_many(poses)
    assert not status.any()
    # The compiled solver's mesh makes the radius larger by a constant factor.
    finer = items["bend_radius"].value / shape.min_bend_radius
    pull = np.linalg.norm([shapes["start_force"], shapes["end_force"]], axis=2).max(axis=0)
    bends = finer * shapes["min_bend_radius"]
    counted = {"bend_radius": (bends < radius).mean(), "force": (pull > force).mean()}
    for name, item in items.items():
        assert 0.05 < item.probability < 0.6
        assert item.probability == pytest.approx(counted[name], abs=0.04), item
        assert item.decided_by == "3 mm at the end (100 %)"
        assert item.holder == ("" if name == "bend_radius" else "start")


# ---- what a user writes -------------------------------------------------------------------------


@pytest.fixture(scope="module")
def fitted(tmp_path_factory):
    """A folder of results of a quick fit, and a list of poses."""
    folder = tmp_path_factory.mktemp("fitted")
    config = load_config(BENCH / "session.yaml")
    measured = measured_poses(config, read_inputs(config))
    declared = declared_model(config)
    fit = fit_model(declared.model.with_mesh(10), measured[:3], declared.tolerances, 3e-4)
    document = fit_dict(fit) | {"fixtures": shared_fixtures(config), "model_hash": "test"}
    (folder / "parameters.yaml").write_text(dump_yaml(document))
    (folder / "declared.yaml").write_text(dump_yaml(document | {"limits": {"force": 30.0}}))
    (folder / "poses.csv").write_text(
        "name,end_x_m,end_y_m\nnear, 0.3, -0.1\nfar, 0.9, 0.3\nhigh, 0.25, 0.2\n"
    )
    return folder


def test_a_list_of_poses_is_checked_and_lost_ones_are_named(fitted, capsys):
    poses = str(fitted / "poses.csv")
    assert main(["limits", str(fitted / "declared.yaml"), poses, "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert [(x["pose"], x["quantity"]) for x in found["limits"]] == [
        ("near", "force"),
        ("high", "force"),
    ]
    assert found["limits"][0]["limit"] == 30.0
    assert "far" in found["without_shape"]
    keys = {"pose", "quantity", "limit", "value", "std", "probability", "at", "verdict"}
    assert keys < found["limits"][0].keys()


def test_other_fixtures_make_a_shape_less_certain(fitted, capsys):
    end = ["predict", str(fitted), "--end", "0.3", "-0.1", "--json", "--limits", "bend_radius=0.1"]
    stds = []
    for more in ([], ["--tolerances", "end=5e-3"]):
        assert main([*end, *more]) == 0
        (row,) = json.loads(capsys.readouterr().out)["limits"]
        stds.append(row["std"])
    assert stds[1] > 1.5 * stds[0]
    assert row["decided_by"].startswith("5 mm at the end")


def test_a_prediction_over_or_under_a_bar(fitted, tmp_path, capsys):
    (tmp_path / "bar.yaml").write_text(
        "- {name: bar, kind: sphere, center: [0.15, -0.2], radius: 0.02}"
    )
    words = ["predict", str(fitted), "--end", "0.3", "-0.1", "--json"]
    words += ["--obstacles", str(tmp_path / "bar.yaml"), "--over"]
    heights = {}
    for side in ("true", "false", "bar=true"):
        assert main([*words, side]) == 0
        points = np.array(json.loads(capsys.readouterr().out)["points"])
        heights[side] = np.interp(0.15, points[:, 0], points[:, 1])
    assert heights["true"] == heights["bar=true"] > -0.18 > -0.22 > heights["false"]
    for side, said in (("maybe", "NAME=true"), ("rod=true", "no obstacle is called 'rod'")):
        assert main([*words, side]) == 2
        assert said in capsys.readouterr().err
    assert main([*words[:5], "--over", "true"]) == 2
    assert "there is none here" in capsys.readouterr().err


def test_the_clearance_from_what_the_cable_shall_not_touch(fitted, tmp_path, capsys):
    """On the table it may lie; from the hot plate it keeps a distance, with a probability."""
    from dlo_casadi import load

    (tmp_path / "around.yaml").write_text(
        "- {name: table, kind: plane, point: [0, -0.245], normal: [0, 1], touch: allowed}\n"
        "- {name: plate, kind: sphere, center: [0.15, -0.15], radius: 0.02}\n"
    )
    cable, end = load(fitted), (0.3, -0.1)
    around = read_yaml(tmp_path / "around.yaml")
    shape = cable.solve(end, obstacles=around)
    assert {one.obstacle for one in shape.contacts} == {"table"}
    there = np.linalg.norm(
        shape.curve.at(np.linspace(0, shape.curve.length, 4001)) - [0.15, -0.15], axis=1
    )
    least = there.min() - 0.02 - shape.cable.model.cable.diameter / 2
    for limit, verdict in ((0.5 * least, "pass"), (least, "risk"), (2 * least, "fail")):
        (check,) = shape.check({"clearance": limit})
        assert check.value == pytest.approx(least, abs=2e-4)
        assert check.at == pytest.approx(shape.curve.length * there.argmin() / 4000, abs=0.02)
        assert check.holder == "plate"
        if limit != least:
            assert check.verdict == verdict
            assert check.used.max() == pytest.approx(2 - check.value / limit)
    near = {"clearance": check.value + check.std}
    (check,) = shape.check(near)
    assert check.probability == pytest.approx(0.841, abs=0.05)
    (tmp_path / "poses.csv").write_text("end_x_m,end_y_m\n0.3,-0.1\n")
    words = ["limits", str(fitted), str(tmp_path / "poses.csv"), "--json"]
    words += ["--obstacles", str(tmp_path / "around.yaml"), "--limits", f"clearance={least / 2}"]
    assert main(words) == 0
    (row,) = json.loads(capsys.readouterr().out)["limits"]
    assert (row["quantity"], row["verdict"], row["holder"]) == ("clearance", "pass", "plate")


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--limits", "bend_radius=-0.1"], "larger than 0"),
        (["--limits", "bend_radius=50"], "did you mean 0.05?"),
        (["--limits", "bend=0.1"], "known here: bend_radius"),
        (["--limits", "force=nan"], "finite number"),
        (["--limits", "force=eight"], "NAME=VALUE"),
        (["--limits", "moment=0.1"], "no end is clamped"),
        (["--limits", "twist=3"], "does not twist"),
        (["--limits", "clearance=0.01"], "no obstacle that the cable is not meant to touch"),
        (["--limits"], "no limit is given"),
        (["--limits", "force=9", "--tolerances", "end=2"], "such as 0.002"),
        (["--limits", "force=9", "--tolerances", "heading=0.1"], "Try: end, length"),
    ],
)
def test_what_cannot_be_checked_says_what_to_try(fitted, capsys, words, said):
    assert main(["limits", str(fitted), str(fitted / "poses.csv"), *words]) == 2
    assert said in capsys.readouterr().err


def test_limits_that_no_pose_is_checked_against_are_no_success(fitted, tmp_path, capsys):
    (tmp_path / "list.csv").write_text("name,end_x_m,end_y_m\nfar,9,0\n")
    assert main(["limits", str(fitted), str(tmp_path / "list.csv"), "--limits", "force=9"]) == 2
    assert "no limit is checked, no pose has a shape: far: " in capsys.readouterr().err


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", "a header end_x_m,end_y_m and poses belong here"),
        ("end_x_m,end_y_m\n", "no poses"),
        ("x,y\n1,2\n", "unknown columns"),
        ("end_x_m,end_y_m,end_x_m\n0.3,0.1,0.5\n", "two columns are called end_x_m"),
        ("end_x_m\n0.3\n", "line 1: the column end_y_m is missing"),
        ("end_x_m,end_y_m\n0.3,high\n", "line 2: 'high' is not a number of end_y_m"),
        ("end_x_m,end_y_m\n0.3,0\n0.3,nan\n", "line 3: 'nan' is not a finite number"),
        ("end_x_m,end_y_m\n0,3,-0,1\n", "line 2: two numbers end_x,end_y belong here, found 4"),
        ("end_x_m,end_y_m\n0.3,-0.1\n0.3,-0,1\n", "line 3: two numbers end_x,end_y belong"),
        ("name,end_x_m,end_y_m\na,0.3,0\na,0.2,0\n", "line 3: an earlier pose is called 'a'"),
    ],
)
def test_a_list_that_cannot_be_read_is_named(fitted, tmp_path, capsys, text, said):
    (tmp_path / "list.csv").write_text(text)
    words = ["limits", str(fitted), str(tmp_path / "list.csv"), "--limits", "force=9"]
    assert main(words) == 2
    assert said in capsys.readouterr().err


def test_a_clip_is_a_fixture_like_the_ends(fitted):
    """An eyelet far below the chord is pulled harder than either end: it takes the weight."""
    from dlo_casadi import load

    clip = {"name": "eye", "kind": "eyelet", "place": [0.2, -0.1]}
    shape = load(fitted).solve((0.4, -0.05), clips=[clip])
    (item,) = shape.check({"force": 1.0})
    force = np.linalg.norm(shape.clips["eye"].force)
    assert (item.holder, item.verdict) == ("eye", "fail")
    assert (item.value, item.at) == pytest.approx((force, shape.clips["eye"].at))


def test_a_tolerance_of_clips_is_about_their_places_that_of_headings_is_not(fitted):
    from dlo_casadi import load

    clip = {"name": "hook", "kind": "pinned", "at": 0.25, "place": [0.2, -0.1]}
    shape = load(fitted).solve((0.4, -0.05), clips=[clip])
    (near,) = shape.check({"force": 1.0}, tolerances={"clip": 1e-5})
    (loose,) = shape.check({"force": 1.0}, tolerances={"clip": 0.01})
    assert loose.std > 1.5 * near.std
    assert loose.decided_by.startswith("10 mm at a clip")
    with pytest.raises(DloError, match="2 m for a cable of"):
        shape.check({"force": 1.0}, tolerances={"clip": 2.0})
    with pytest.raises(DloError, match="does not depend on it"):  # of pins and a pinned clip
        shape.check({"force": 1.0}, tolerances={"heading": 0.01})


ROPE = dlo.Cable(length=0.8, mass=0.05, diameter=0.005, bending_stiffness=0.01)
HOOKS = [
    {"kind": "pinned", "at": 0.25, "place": [0.2, -0.1]},
    {"kind": "pinned", "at": 0.5, "place": [0.4, -0.1]},
]
TABLE = {"kind": "plane", "point": [0, -0.15], "normal": [0, 1]}


@pytest.mark.parametrize(
    ("tolerance", "around", "effects", "words", "near"),
    [
        ("slip", {"clips": HOOKS}, [ClipSlip(), ClipSlip(clip=1)], "5 mm along a clip", 0.01),
        pytest.param(
            "obstacle",
            {"obstacles": [TABLE]},
            [ObstacleOffset()],
            "5 mm of an obstacle's surface",
            0.2,
            marks=pytest.mark.long,
        ),
    ],
)
def test_a_known_cable_has_tolerances_of_its_clips_and_obstacles(
    tolerance, around, effects, words, near
):
    """The same numbers as with the effects declared at zero, and the slopes of solved shapes.

    Repeats rest on softer obstacles, which takes 18 % of the slope of this force.
    """
    held = {"gravity": (0, -9.81), "boundary": ("pinned", "pinned")}
    known = dlo.known_cable(ROPE, **held, model={"n": 16})
    shape, end = known.solve((0.6, 0.0), **around), (0.6, 0.0)
    model = shape.cable.model
    for effect in effects:
        model = model.with_effect(effect)
    p = np.append(shape.cable.p, np.zeros(len(effects)))
    declared = replace(shape, cable=replace(shape.cable, model=model, p=p))
    limits, tolerances = {"bend_radius": 0.05, "force": 1.0}, {tolerance: 5e-3}
    checks = shape.check(limits, tolerances=tolerances)
    for found, same in zip(checks, declared.check(limits, tolerances=tolerances), strict=True):
        assert found.as_dict() == same.as_dict()
    (sure,) = shape.check({"force": 1.0})
    force = checks[1]
    assert (force.value, sure.method) == (pytest.approx(sure.value, rel=1e-9), "exact")
    assert force.decided_by.startswith(words)
    slopes = []
    for k in range(len(effects)):
        forces = []
        for d in (-1e-4, 1e-4):
            clips = [x | {"at": x["at"] + d * (i == k)} for i, x in enumerate(HOOKS)]
            moved = {"clips": clips, "obstacles": [TABLE | {"point": [0, -0.15 + d]}]}
            other = known.solve(end, **{key: moved[key] for key in around})
            holders = {"start": other.start_force, "end": other.end_force}
            holders |= {name: load.force for name, load in other.clips.items()}
            forces.append(np.linalg.norm(holders[force.holder]))
        slopes.append((forces[1] - forces[0]) / 2e-4)
    assert force.std == pytest.approx(5e-3 * np.linalg.norm(slopes), rel=near)
    with pytest.raises(DloError, match="does not depend on it"):
        known.solve(end).check(limits, tolerances=tolerances)


def test_a_twist_is_that_of_a_mesh_that_resolves_it_with_and_without_a_bend():
    cable = dlo.known_cable(
        dlo.Cable(
            length=0.8,
            mass=0.05,
            diameter=0.005,
            bending_stiffness=1e-3,
            torsional_stiffness=8e-4,
        ),
        gravity=(0, 0, -9.81),
        boundary=("clamped", "clamped"),
        rest_curvature=[[2.0], [5.0]],
        model={"n": 10},
    )
    ends = {"start_orientation": (0, 0, 0, 1), "end_orientation": (0.5, 0.5, 0.5, 0.5)}
    shape = cable.solve(end=(0.5, 0.1, 0.0), **ends)
    (alone,), (_, both) = (
        shape.check({"twist": 8.5} | more) for more in ({}, {"bend_radius": 1e-3})
    )
    assert alone.value == both.value > 8.5


def test_a_known_cable_has_a_tolerance_of_its_length(fitted):
    held = {"gravity": (0, -9.81), "boundary": ("pinned", "pinned")}
    zero = {"name": "length_error", "parameters": {"length_difference": 0.0}}
    pair = [dlo.known_cable(ROPE, **held, model={"effects": list(x)}) for x in ((), (zero,))]
    checks = [
        x.solve((0.6, 0.0)).check({"force": 0.2487}, tolerances={"length": 0.01}) for x in pair
    ]
    assert checks[0][0].as_dict() == checks[1][0].as_dict()
    assert (checks[0][0].verdict, checks[0][0].decided_by) == ("risk", "10 mm of length (100 %)")
    # A fitted cable whose session had no clips.
    shape = dlo.load(fitted).solve((0.4, -0.05), clips=[HOOKS[0]])
    near, loose = (shape.check({"force": 1.0}, tolerances={"slip": x})[0] for x in (1e-5, 0.02))
    assert loose.std > 1.3 * near.std
    assert loose.decided_by.startswith("20 mm along a clip")


def test_from_python_limits_are_a_mapping(fitted):
    from dlo_casadi import load

    shape = load(fitted).solve((0.3, -0.1))
    with pytest.raises(DloError, match="a mapping belongs here"):
        shape.check(0.05)
    with pytest.raises(ConfigError, match="unknown key '1'"):
        shape.check({1: 2})
    with pytest.raises(ConfigError, match="bend"):
        shape.check({"bend": 0.05})
    assert [str(x).partition(":")[0] for x in shape.check({"force": 1e3})] == ["pass"]


# ---- limits of a session ------------------------------------------------------------------------


def test_a_session_checks_its_poses_and_shows_where_they_are_tight(tmp_path):
    from dlo_casadi import Session, load
    from dlo_casadi.report.sections import report_dict

    path = BENCH / "session.yaml"
    session = yaml.safe_load(path.read_text().replace("file: ", f"file: {path.parent}/"))
    session["experiment"]["poses"] = session["experiment"]["poses"][:4]
    session |= {"limits": {"bend_radius": 0.1}, "estimation": {"algorithm1": False}}
    session["model"] = session.get("model", {}) | {"n": 12}
    (tmp_path / "session.yaml").write_text(yaml.safe_dump(session))
    result = Session.load(tmp_path / "session.yaml").fit(diagnosis=False)
    rows = report_dict(result)["limits"]
    assert [row["pose"] for row in rows] == list(result.stages[-1].shapes)
    verdicts = [row["verdict"] for row in rows]
    assert verdicts == ["fail" if row["value"] < 0.1 else "pass" for row in rows]
    assert {*verdicts} == {"pass", "fail"}
    folder = result.write(tmp_path / "results")
    assert (folder / "figures" / "limits.png").stat().st_size > 10_000
    page = (folder / "report.html").read_text()
    assert 'id="chart-limits"' in page
    (check,) = load(folder).solve((0.3, -0.1)).check()  # as the session declared
    assert check.limit == 0.1


@pytest.mark.parametrize(
    ("limits", "said"),
    [
        ("{bend_radius: 50}", "did you mean 0.05?"),
        ("{moment: 1.0}", "no end is clamped"),
        ("{force: -1}", "larger than 0"),
        ("{clearance: 0.01}", "no obstacle that the cable is not meant to touch"),
        ("{bendradius: 0.05}", "bend_radius"),
    ],
)
def test_a_configuration_with_other_limits_is_refused(tmp_path, limits, said):
    path = BENCH / "session.yaml"
    text = path.read_text().replace("file: ", f"file: {path.parent}/")
    (tmp_path / "session.yaml").write_text(f"{text}\nlimits: {limits}\n")
    with pytest.raises(ConfigError, match=re.escape(said)):
        load_config(tmp_path / "session.yaml")


@pytest.mark.parametrize("stiffness", [0.0, 0.05])
def test_a_pin_with_a_spring_takes_a_moment(stiffness):
    rope = dlo.Cable(length=0.8, mass=0.05, diameter=0.005, bending_stiffness=0.01)
    spring = {"name": "start_spring", "parameters": {"stiffness": stiffness, "heading": 0.0}}
    cable = dlo.known_cable(
        rope, gravity=(0, -9.81), boundary=("pinned", "pinned"), model={"effects": [spring]}
    )
    shape = cable.solve(end=(0.6, 0.0))
    (check,) = shape.check({"moment": 1e-3})
    assert check.value == pytest.approx(abs(shape.start_moment))
    assert check.verdict == ("fail" if stiffness else "pass")
