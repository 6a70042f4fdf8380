"""A cable of which everything is known, beside closed forms; and it is what a fit returns."""

import copy
import json
import multiprocessing
import pickle
import re
import shutil
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.optimize import brentq
from scipy.special import fresnel
from scipy.stats import norm

import dlo_casadi as dlo
from dlo_casadi.cli import main
from dlo_casadi.config import dump_yaml
from dlo_casadi.effects import ClipSlip
from dlo_casadi.equilibrium.spread import Uncertainty
from dlo_casadi.export.rod import Rod
from dlo_casadi.model.pose_scatter import PoseScatter

ROPE = dlo.Cable(length=0.8, mass=0.05, diameter=0.005, bending_stiffness=0.01, name="rope")
WIRE = dlo.Cable(
    length=0.8, mass=0.05, diameter=0.005, bending_stiffness=0.01, torsional_stiffness=0.008
)
QUICK = ("-O0",)  # for the compiler
PINNED = {"gravity": (0, -9.81), "boundary": ("pinned", "pinned")}
FREE = {"gravity": (0, -9.81), "boundary": ("clamped", "free")}
WEIGHTLESS = {"gravity": (0, 0), "boundary": ("clamped", "free")}
IN_SPACE = {"gravity": (0, 0, -9.81), "boundary": ("clamped", "free")}
FORWARD = {"start_orientation": (0, 0, 0, 1)}


def effect(name, **parameters):
    return {"effects": [{"name": name, "parameters": parameters}]}


@pytest.fixture(scope="module")
def rope():
    return dlo.known_cable(ROPE, **PINNED, model={"n": 20})


def test_a_known_cable_held_straight_up_falls_to_either_side():
    """Nothing is uncertain, yet by symmetry neither side is the lower one."""
    cable = dlo.known_cable(ROPE, **FREE, model={"n": 20})
    shape = cable.solve(start_heading=np.pi / 2)
    mirrored = shape.other_side.points * (-1, 1)
    np.testing.assert_allclose(mirrored, shape.points, atol=1e-8)
    for side in (shape, shape.other_side):
        assert side.pose.branch == ("ccw" if side.equilibrium.turn > 0 else "cw")
    assert cable.solve(start_heading=np.pi / 2 + 1e-6).other_side is None


def test_a_limp_cable_hangs_in_a_catenary():
    """L = 2a sinh(s/2a), sag = a (cosh(s/2a) - 1), H = w a  [Irvine, Cable Structures, 1981]."""
    length, span, mass = 1.0, 0.6, 0.05
    a = brentq(lambda a: 2 * a * np.sinh(span / (2 * a)) - length, 0.05, 10.0)
    limp = dlo.Cable(length=length, mass=mass, diameter=0.004, bending_stiffness=1e-7)
    shape = dlo.known_cable(limp, **PINNED).solve(end=(span, 0.0))
    weight = mass * 9.81
    rel = 1e-7 / (weight / length * a**3)  # the cable's own stiffness, 1e-4
    assert -shape.points[50, 1] == pytest.approx(a * (np.cosh(span / (2 * a)) - 1), rel=rel)
    assert shape.end_force == pytest.approx([-weight / length * a, -weight / 2], rel=rel)


def test_a_stiff_cantilever_droops_by_its_weight_and_that_at_its_tip():
    """Droop w L^4 / (8 EI) + m g L^3 / (3 EI); the next term is the square of the slope smaller."""
    stiff = dlo.Cable(length=0.5, mass=0.02, diameter=0.004, bending_stiffness=2.0)
    tip = effect("lumped_mass", mass=0.01, position=0.5)
    bare, loaded = (dlo.known_cable(stiff, **FREE, model=model) for model in ({}, tip))
    own, more = 0.02 * 9.81 * 0.5**3 / (8 * 2.0), 0.01 * 9.81 * 0.5**3 / (3 * 2.0)
    droops = [-cable.solve(start_heading=0.0).points[-1, 1] for cable in (bare, loaded)]
    assert droops == pytest.approx([own, own + more], rel=1e-4)  # slope: 0.007


def test_frames_at_a_saddle_that_slipped_are_those_of_one_declared_there():
    cable = dlo.known_cable(WIRE, gravity=(0, 0, -9.81), boundary=("clamped", "clamped"))
    slipped = replace(cable, model=cable.model.with_effect(ClipSlip()), p=np.append(cable.p, 0.008))
    rolled = (np.sin(0.6), 0.0, 0.0, np.cos(0.6))
    saddle = {"kind": "clamped", "place": (0.3, 0.0, -0.05), "orientation": rolled}
    ends = {"end": (0.6, 0.0, 0.0), **FORWARD, "end_orientation": (0, 0, 0, 1)}
    own, other = (
        one.solve(**ends, clips=[{**saddle, "at": at}])
        for one, at in ((slipped, 0.4), (cable, 0.408))
    )
    assert own.points == pytest.approx(other.points, abs=1e-9)
    assert own.frames == pytest.approx(other.frames, abs=1e-7)
    exported, known = (Rod.of(one.held, 60).frames for one in (own, other))
    assert (exported.inv() * known).magnitude().max() < 1e-7


def test_two_masses_pull_like_two_forces_of_their_weights(tmp_path):
    """Effects of one name are numbered, in the generated solver and in parameters.yaml as well."""
    loads = ((0.01, 0.3), (0.02, 0.5))
    masses = [effect("lumped_mass", mass=m, position=at) for m, at in loads]
    forces = [effect("point_force", fx=0.0, fy=-9.81 * m, position=at) for m, at in loads]
    two, pulled = (
        dlo.known_cable(
            ROPE, **PINNED, model={"n": 20, "effects": [one["effects"][0] for one in each]}
        )
        for each in (masses, forces)
    )
    assert two.model.names[1:] == (
        *("lumped_mass.mass", "lumped_mass.position"),
        *("lumped_mass_2.mass", "lumped_mass_2.position"),
    )
    force = pulled.solve(end=(0.5, 0.1)).end_force
    (tmp_path / "parameters.yaml").write_text(dump_yaml(two.metadata.document))
    loaded = dlo.load(tmp_path)
    # 1e-9: tolerance of the solver.
    for cable in (two, loaded):
        assert cable.solve(end=(0.5, 0.1)).end_force == pytest.approx(force, rel=1e-9)
    row = [0.0, 0.0, 0.5, 0.1, 0.0, 0.0]
    shapes, _ = loaded.compile(flags=QUICK).solve_many(np.array([row]))
    assert shapes["end_force"][0] == pytest.approx(force, rel=1e-8)


def test_a_second_effect_that_a_cable_cannot_have_is_refused():
    error = effect("length_error", length_difference=0.01)["effects"]
    with pytest.raises(
        dlo.ConfigError, match=r"length_error: 2 such effects .* can have 1\. Try: "
    ):
        dlo.known_cable(ROPE, **PINNED, model={"effects": error * 2})
    same = effect("lumped_mass", mass=0.01, position=0.4)["effects"]
    assert len(dlo.known_cable(ROPE, **PINNED, model={"effects": same * 2}).model.effects) == 2


@pytest.mark.parametrize("count", [1, 2, 3, 9])
def test_a_free_cable_has_its_rest_curvature(count):
    """A circle; and of a curvature that grows with the arc length a clothoid."""
    s = np.linspace(0.0, 0.8, count)
    circle = dlo.known_cable(WIRE, **WEIGHTLESS, rest_curvature=np.full(count, 2.0))
    shape = circle.solve(start_heading=0.0)
    assert shape.points[-1] == pytest.approx([np.sin(1.6) / 2, (1 - np.cos(1.6)) / 2], abs=1e-6)
    assert shape.energy == pytest.approx(0.0, abs=1e-12)
    if count > 1:
        clothoid = dlo.known_cable(WIRE, **WEIGHTLESS, rest_curvature=5.0 * s)
        size = np.sqrt(np.pi / 5.0)
        exact = size * np.array(fresnel(0.8 / size))[::-1]
        assert clothoid.solve(start_heading=0.0).points[-1] == pytest.approx(exact, abs=1e-6)


def test_in_space_a_rest_curvature_is_about_the_axes_y_and_z():
    weightless = IN_SPACE | {"gravity": (0, 0, 0)}
    arc = np.array([np.sin(1.6) / 2, (1 - np.cos(1.6)) / 2])
    for axes, end in (((0, 2.0), (*arc, 0)), ((2.0, 0), (arc[0], 0, -arc[1]))):
        cable = dlo.known_cable(WIRE, **weightless, rest_curvature=axes, model={"n": 20})
        assert cable.solve(**FORWARD).points[-1] == pytest.approx(end, abs=1e-5)
    # Growing with the arc length it is a clothoid: to the fourth order of the mesh.
    size, growing = np.sqrt(np.pi / 5.0), 5.0 * np.linspace(0.0, 0.8, 9)
    aside, ahead = size * np.array(fresnel(0.8 / size))
    still = np.zeros(9)
    for axes, end in (
        ((still, growing), (ahead, aside, 0)),
        ((growing, still), (ahead, 0, -aside)),
    ):
        cable = dlo.known_cable(WIRE, **weightless, rest_curvature=axes, model={"n": 20})
        assert cable.solve(**FORWARD).points[-1] == pytest.approx(end, abs=1e-6)


def test_it_is_what_a_fit_returns(rope, fewer_starts, tmp_path):
    """All that a fitted cable can, and the same when it is written and read."""
    assert type(rope) is dlo.FittedCable
    shape = rope.solve(end=(0.5, 0.1))
    pose = [0, 0, 0.5, 0.1, 0, 0]
    force = rope.function()(pose)[1].full().ravel()
    assert force == pytest.approx(shape.end_force, abs=1e-9)
    guess = rope.initial(pose)
    assert np.abs(rope.equations()(guess.x, guess.multipliers, pose)[0].full()).max() < 1e-9
    placed = rope.place(1, [{"end": (0.5, 0.1)}], ((0, -0.3), (0.5, 0.1)), {"bend_radius": 0.02})
    assert len(placed.clips) == 1
    rope.export("mujoco", tmp_path / "rope.xml", end=(0.5, 0.1))
    assert "known cable" in (tmp_path / "rope.xml").read_text()
    (tmp_path / "parameters.yaml").write_text(dump_yaml(rope.metadata.document))
    for same in (dlo.load(tmp_path), pickle.loads(pickle.dumps(rope))):
        assert not same.metadata.edited
        assert np.array_equal(same.solve(end=(0.5, 0.1)).points, shape.points)


@pytest.mark.skipif(shutil.which("cc") is None, reason="no C compiler (cc)")
def test_its_compiled_solver_finds_its_shape(rope):
    found = rope.compile(flags=QUICK).solve(dlo.Pose((0, 0), (0.5, 0.1)))
    assert found.end_force == pytest.approx(rope.solve(end=(0.5, 0.1)).end_force, rel=1e-6)


@pytest.mark.skipif(shutil.which("cc") is None, reason="no C compiler (cc)")
def test_a_compiled_solver_is_pickled_and_copied(rope):
    """The C is made again: to the last digit the same shapes, in another process as well."""
    solver, pose = rope.compile(flags=QUICK), dlo.Pose((0, 0), (0.5, 0.1))
    points = solver.solve(pose).points
    for other in (pickle.loads(pickle.dumps(solver)), copy.copy(solver)):
        assert np.array_equal(other.solve(pose).points, points)
        assert other.most_obstacles == solver.most_obstacles
    with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as executor:
        found = executor.submit(solver.solve, pose).result()
    assert np.array_equal(found.points, points)


def test_a_known_cable_is_saved_for_the_commands(rope, tmp_path, capsys):
    path = rope.save(tmp_path / "results/rope")
    assert path == tmp_path / "results/rope/parameters.yaml"
    end = ["--end", "0.5", "0.1", "--json"]
    assert main(["predict", str(path.parent), *end]) == 0
    points = json.loads(capsys.readouterr().out)["points"]
    assert np.array_equal(points, rope.solve((0.5, 0.1)).points)
    assert main(["generate-solver", str(path.parent), "--output", str(tmp_path / "c")]) == 0
    assert (tmp_path / "c/dlo_solver.c").exists()
    assert rope.save(str(tmp_path / "one.yaml")) == tmp_path / "one.yaml"
    assert dlo.load(tmp_path / "one.yaml").metadata.model_hash == rope.metadata.model_hash


def test_a_saved_cable_has_its_mesh(tmp_path):
    bent = dlo.known_cable(ROPE, **FREE, rest_curvature=[0.0, 1.0, 4.0, 2.0], model={"n": 10})
    fine = bent.with_mesh(30)
    again = dlo.load(fine.save(tmp_path))
    assert again.model == fine.model
    assert not again.metadata.edited
    assert again.rest == pytest.approx(fine.rest, abs=1e-12)
    assert again.metadata.model_hash != bent.metadata.model_hash


def test_a_cable_is_not_saved_over_what_is_not_one(rope, tmp_path):
    (tmp_path / "notes.yaml").write_text("mine: 1")
    with pytest.raises(dlo.DloError, match=r"holds notes.yaml from elsewhere, which would be re"):
        rope.save(tmp_path / "notes.yaml")
    assert (tmp_path / "notes.yaml").read_text() == "mine: 1"
    with pytest.raises(dlo.DloError, match=r"(?s)clips are of a pose, .*Try: cable.with_clips"):
        rope.with_clips(["pinned"]).save(tmp_path)
    with pytest.raises(dlo.DloError, match="a path belongs here, found 3"):
        rope.save(3)


def test_placing_and_lists_of_limits_tell_their_progress(rope, fewer_starts, tmp_path, capsys):
    told = []
    listener = SimpleNamespace(step=lambda *news: told.append(news))
    region = ((0, -0.3), (0.5, 0.1))
    rope.place(1, [{"end": (0.5, 0.1)}], region, {"bend_radius": 0.02}, progress=listener)
    names, done, totals = zip(*told, strict=True)
    assert set(names) == {"place the clips"}
    assert list(done) == sorted(set(done))
    assert done[0] == 0
    assert set(totals) == {done[-1]}
    rope.save(tmp_path)
    (tmp_path / "poses.csv").write_text("end_x_m,end_y_m\n0.5,0.1\n0.4,0.0\n")
    command = ["limits", str(tmp_path), str(tmp_path / "poses.csv"), "--limits", "bend_radius=0.02"]
    assert main(command) == 0
    assert "check the poses: " in capsys.readouterr().err


def test_another_mesh_has_the_same_rest_curvature():
    bent = dlo.known_cable(WIRE, **FREE, rest_curvature=[0.0, 1.0, 4.0, 2.0])
    meshes = (bent, bent.with_mesh(80), bent.with_mesh(element="arc"))
    ends = [one.solve(start_heading=0.0).points[-1] for one in meshes]
    assert ends[1] == pytest.approx(ends[0], abs=1e-5)
    assert ends[2] == pytest.approx(ends[0], abs=1e-3)


@pytest.mark.parametrize(
    ("cable", "held", "pose"), [(ROPE, PINNED, {"end": (0.5, 0.1)}), (WIRE, IN_SPACE, FORWARD)]
)
def test_nothing_about_it_is_uncertain(cable, held, pose):
    known = dlo.known_cable(cable, **held, rest_curvature=None, model={"n": 20})
    shape = known.solve(**pose)
    assert known.covariance.std == {}
    assert {x.std for x in known.params.values()} == {0.0}
    assert "  bending_stiffness: 0.01 N m^2, fixed" in repr(known)
    assert np.all(shape.band == 0.0)
    assert shape.other_side is None
    limits = {"bend_radius": shape.min_bend_radius / 2, "force": 0.1}
    kept, violated = shape.check(limits)
    assert (kept.std, kept.probability, kept.chance, kept.verdict) == (0.0, 0.0, "0 %", "pass")
    assert (violated.std, violated.probability, violated.verdict) == (0.0, 1.0, "fail")
    assert (violated.method, violated.chance) == ("exact", "100 %")
    assert str(kept).endswith("mm); nothing is uncertain")
    assert "±" not in str(kept) + kept.text(kept.value, kept.std)
    assert kept.as_dict()["shares"] == {}


def test_only_the_fixtures_are_uncertain_where_they_are_told(rope):
    shape = rope.solve(end=(0.5, 0.1))
    (check,) = shape.check({"force": 0.3}, tolerances={"end": 2e-3})
    moved = [rope.solve(end=(0.5 + dx, 0.1)).end_force for dx in (-1e-4, 1e-4)]
    lifted = [rope.solve(end=(0.5, 0.1 + dy)).end_force for dy in (-1e-4, 1e-4)]
    slopes = [np.diff(np.linalg.norm(two, axis=1))[0] / 2e-4 for two in (moved, lifted)]
    assert check.std == pytest.approx(2e-3 * np.hypot(*slopes), rel=1e-3)
    assert check.decided_by == "2 mm at the end (100 %)"


def test_text_and_data_of_a_shape_name_what_each_fixture_takes():
    """Of two clamps and a saddle: no two of them take the same."""
    clamps = {"gravity": (0, -9.81), "boundary": ("clamped", "clamped")}
    cable = dlo.known_cable(ROPE, **clamps, model={"n": 16})
    saddle = dlo.Clip(kind="clamped", at=0.3, place=(0.25, -0.05), heading=-0.3, name="saddle")
    held = {"start_heading": 0.2, "end_heading": 0.4, "clips": [saddle]}
    shape = cable.solve(end=(0.5, 0.02), **held)
    rows, data = dict(shape.rows()), shape.as_dict()
    loads = {"its start": shape.start_force, "its end": shape.end_force}
    loads["saddle"] = shape.clips["saddle"].force
    for name, force in loads.items():
        told = re.findall(r"-?\d[\d.]*(?:e-?\d+)?", rows[f"force of the cable on {name}"])
        assert np.array(told[:2], float) == pytest.approx(force, rel=1e-3, abs=1e-12)
    on_all = sum(loads.values())
    assert on_all == pytest.approx([0.0, -9.81 * ROPE.mass], abs=1e-6)
    moments = {"its start": shape.start_moment, "its end": shape.end_moment}
    moments["saddle"] = shape.clips["saddle"].moment
    for name, moment in moments.items():
        told = rows[f"moment of the cable on {name}"].removesuffix(" N m")
        assert float(told) == pytest.approx(float(moment), rel=1e-3)
    assert len({*map(float, moments.values())}) == 3
    for side in ("start", "end"):
        assert data[f"force_on_{side}"] == loads[f"its {side}"].tolist()
        assert data[f"moment_on_{side}"] == float(moments[f"its {side}"])
    assert data["clips"][0]["force"] == loads["saddle"].tolist()


def test_the_band_holds_nine_tenths_of_repeats(rope):
    """At both ends, where it is the fixtures' and the repeats' own standard deviation."""
    fixtures = {"end_x": 2e-3, "end_y": 2e-3}
    known = Uncertainty((), np.zeros((0, 0)), fixtures, PoseScatter(), repeat_std=1e-3)
    cable = replace(rope, metadata=replace(rope.metadata, uncertainty=known))
    stds = np.array([1e-3, np.hypot(1e-3, 2e-3)])
    band = cable.solve(end=(0.5, 0.1)).band
    np.testing.assert_allclose(band[[0, -1]], norm.ppf(0.95) * stds, rtol=1e-6)


def test_headings_in_degrees_are_doubted():
    cable = dlo.known_cable(ROPE, gravity=(0, -9.81), boundary=("clamped", "pinned"))
    with pytest.raises(dlo.EquilibriumError, match=r"degrees\? 90 degrees are 1\.571 rad"):
        cable.solve(end=(0.9, 0.0), start_heading=90)
    with pytest.raises(dlo.EquilibriumError, match=r"metres, nearer to the start\.$"):
        cable.solve(end=(0.9, 0.0), start_heading=1.5)


UNWEIGHED = dlo.Cable(length=0.8, mass=None, diameter=0.005, bending_stiffness=0.01)
STRAIGHT = dlo.Cable(
    length=0.8, mass=0.05, diameter=0.005, bending_stiffness=0.01, rest_shape="straight"
)


@pytest.mark.parametrize(
    "load",
    [
        effect("point_force", fx=0.0, fy=-2.0, position=0.4),
        effect("lumped_mass", mass=0.2, position=0.4),
        effect("side_load", force_per_length=2.0),
    ],
)
def test_a_known_load_may_be_many_times_the_weight(tmp_path, load):
    """The forces at both pins carry it; and it is what its file holds."""
    known = dlo.known_cable(ROPE, **PINNED, model=load | {"n": 20})
    shape = known.solve(end=(0.6, 0.0))
    values = load["effects"][0]["parameters"]
    added = np.array([values.get("force_per_length", 0.0) * ROPE.length, values.get("fy", 0.0)])
    added[1] -= 9.81 * (ROPE.mass + values.get("mass", 0.0))
    assert shape.end_force + shape.start_force == pytest.approx(added, abs=1e-6)
    (tmp_path / "parameters.yaml").write_text(dump_yaml(known.metadata.document))
    again = dlo.load(tmp_path).solve(end=(0.6, 0.0))
    assert again.points == pytest.approx(shape.points, abs=1e-9)
    repeats = shape.check({"force": 10.0}, tolerances={"end": 1e-3})
    assert repeats[0].std > 0


@pytest.mark.parametrize(
    ("cable", "wrong", "message"),
    [
        (ROPE, {"boundary": None}, "'boundary' is missing in the arguments: How the two ends"),
        (ROPE, {"gravity": None}, "'gravity' is missing in the arguments"),
        (
            ROPE,
            {"boundary": ("pinned", "hinged")},
            "boundary: allowed are 'pinned', 'clamped', 'swivel'",
        ),
        (ROPE, {"boundary": ("pinned", "free", "x")}, "[start, end] belongs here, such as"),
        (ROPE, {"boundary": "pinned"}, "[start, end] belongs here, such as [pinned, clamped]"),
        (
            ROPE,
            {"gravity": (0, 0, -9.81)},
            "needs: of a solid round rod EI / 1.3 = 0.00769",
        ),
        (
            WIRE,
            {"gravity": (0, 0, -9.81), "boundary": ("pinned", "free")},
            "turn freely about the direction of gravity",
        ),
        (WIRE, IN_SPACE | {"model": {"element": "link"}}, "link is of a cable in a plane. Try: qu"),
        (UNWEIGHED, {}, "cable.mass is not given, and no fit tells it. Try: the mass"),
        (3, {}, "cable: a mapping of keys and values belongs here, found 3. Try: dlo.Cable(...)"),
        (ROPE, {"model": {"effects": ["lumped_mas"]}}, "did you mean 'lumped_mass'?"),
        (ROPE, {"model": effect("lumped_mass", mass=0.1)}, "lumped_mass needs position [m]: no"),
        (
            ROPE,
            {"model": {"effects": [{"name": "lumped_mass", "mass": 0.1}]}},
            "unknown key 'mass' in model.effects[0]; it belongs into parameters: {mass: ...}",
        ),
        (ROPE, {"model": {"effects": ["plastic_set"]}}, "Try: rest_curvature as it is now"),
        (
            ROPE,
            {"model": effect("lumped_mass", mass=0.1, position=3.0)},
            "lumped_mass.position: 3 m: 0 to 0.8 m is possible",
        ),
        (ROPE, {"effects": []}, 'it belongs into model={"effects": ...}'),
        (ROPE, {"gravty": 1}, "unknown key 'gravty' in the arguments; did you mean 'gravity'?"),
        (ROPE, {"poses": []}, "unknown key 'poses' in the arguments; known here: boundary, cable"),
        (ROPE, {"diagnosis": {}}, "unknown key 'diagnosis' in the arguments; known here: bound"),
        (ROPE, {"limits": {"twist": 1.0}}, "does not twist. Try: leave it out"),
        (ROPE, {"rest_curvature": "round"}, "one number or (K,) [1/m], K <= 64, belong here"),
        (ROPE, {"rest_curvature": [[1.0, 2.0]]}, "rest_curvature: one number or (K,) [1/m], K <="),
        (ROPE, {"rest_curvature": [1.0, np.nan]}, "belong here, found [1.0, nan]"),
        (ROPE, {"rest_curvature": ["1", "2"]}, "one number or (K,) [1/m], K <= 64, belong here"),
        (ROPE, {"rest_curvature": True}, "one number or (K,) [1/m], K <= 64, belong here"),
        (ROPE, {"rest_curvature": []}, "rest_curvature: one number or (K,) [1/m], K <= 64"),
        (ROPE, {"rest_curvature": np.ones(65)}, "rest_curvature: one number or (K,) [1/m], K <="),
        (ROPE, {"rest_curvature": 400.0}, "400 1/m bends it more sharply than it is thick"),
        (
            WIRE,
            {"gravity": (0, 0, -9.81), "rest_curvature": (300.0, 300.0)},
            "424.264 1/m bends it more sharply",
        ),
        (STRAIGHT, {"rest_curvature": 1.0}, "rest_curvature: the cable is declared straight"),
        (
            WIRE,
            {"gravity": (0, 0, -9.81), "rest_curvature": 1.0},
            "rest_curvature: (2,) or (2, K) numbers [1/m]",
        ),
    ],
)
def test_what_cannot_be_says_what_to_try(cable, wrong, message):
    with pytest.raises(dlo.ConfigError) as refused:
        dlo.known_cable(cable, **PINNED | wrong)
    assert message in str(refused.value)


def test_all_that_is_missing_is_told_at_once():
    with pytest.raises(dlo.ConfigError, match=r"^3 problems\n(.*\n)*.*rest_curvature: \(2,\)"):
        dlo.known_cable(UNWEIGHED, **PINNED | {"gravity": (0, 0, -9.81)}, rest_curvature=1.0)


def test_what_needs_a_fit_says_so(rope, tmp_path):
    with pytest.raises(dlo.DloError, match="path: a file name belongs here, found 5"):
        rope.export("mujoco", 5, end=(0.5, 0.1))
    wire = dlo.known_cable(WIRE, **IN_SPACE)
    with pytest.raises(dlo.DloError, match="element: one of quadratic, arc belongs here"):
        wire.with_mesh(element="link")
    with pytest.raises(dlo.DloError, match="arc, link belongs here, found array"):
        rope.with_mesh(element=np.array(["arc", "link"]))
    with pytest.raises(dlo.DloError, match="'rope' is known exactly: all samples would be the sam"):
        rope.export("mujoco", tmp_path / "rope.xml", end=(0.5, 0.1), samples=2)
    with pytest.raises(dlo.DloError, match="'bending_stiffness' was not fitted; fitted are none"):
        _ = rope.covariance["bending_stiffness", "bending_stiffness"]
    with pytest.raises(dlo.DloError, match="no limit is given, and none was declared"):
        rope.solve(end=(0.5, 0.1)).check()


@pytest.mark.parametrize("clips", [["pinned", "eyelt"], "pinned", None])
def test_clips_are_a_list_of_kinds(rope, clips):
    with pytest.raises(dlo.DloError, match="clips: a list of kinds belongs here, found"):
        rope.with_clips(clips)


def test_two_clips_of_one_name_are_refused(rope):
    clips = [dlo.Clip(kind="pinned", name="a", at=s, place=(s, 0.0)) for s in (0.2, 0.4)]
    with pytest.raises(dlo.DloError, match="two clips are called a"):
        rope.solve(end=(0.5, 0.1), clips=clips)


def test_a_saddle_in_a_plane_takes_one_moment_as_a_clamp_does(rope):
    saddle = dlo.Clip(kind="clamped", at=0.4, place=(0.3, -0.1), heading=0.1)
    shape = rope.solve(end=(0.5, 0.1), clips=[saddle])
    moment = shape.clips["clip_1"].moment
    assert np.shape(moment) == np.shape(shape.end_moment) == ()
    assert shape.as_dict()["clips"][0]["moment"] == float(moment)
    assert f"moment of the cable on clip_1: {moment:.4g} N m\n" in str(shape)


def test_a_straight_cable_keeps_every_bend_radius():
    """Without gravity nothing bends it, and nothing pulls at its clamp: sizes of exactly 0."""
    shape = dlo.known_cable(ROPE, **WEIGHTLESS).solve(start_heading=0.0)
    tolerances = {"heading": 0.01}
    for stds in (None, tolerances):
        bend, force = shape.check({"bend_radius": 0.05, "force": 1.0}, tolerances=stds)
        assert (bend.verdict, bend.probability, force.verdict, force.value) == (
            "pass",
            0,
            "pass",
            0,
        )
        assert bend.std == 0 or stds
        assert "pass: bend radius straight at" in str(bend)
    assert "smallest bend radius: straight" in str(shape)
    assert "bend radius straight" in shape.plot().axes[0].get_title()


def test_a_straight_cable_can_be_checked_from_the_command_line(tmp_path, capsys):
    known = dlo.known_cable(ROPE, **WEIGHTLESS, limits={"bend_radius": 0.05})
    (tmp_path / "parameters.yaml").write_text(dump_yaml(known.metadata.document))
    words = ["--start-heading", "0", "--tolerances", "heading=0.01", "--json"]
    assert main(["predict", str(tmp_path), *words]) == 0
    (row,) = json.loads(capsys.readouterr().out)["limits"]
    assert (row["verdict"], row["std"]) == ("pass", 0.0)


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ([], r"--end is not given, .* session rope\.yaml .* is not in .*\n  Try: --end X Y"),
        (["--segments", "2"], "segments: a whole number, 4 or more, found 2"),
        (["--end", "0.5", "0", "--samples", "-1"], "samples: a whole number, 0 or more, found -1"),
    ],
)
def test_an_export_without_its_session_tells_what_is_missing(
    tmp_path, monkeypatch, capsys, words, said
):
    """Wrong numbers are told first, except that the start needs an end."""
    monkeypatch.chdir(tmp_path.parent)
    (tmp_path / "parameters.yaml").write_text(
        dump_yaml(dlo.known_cable(ROPE, **PINNED).metadata.document)
    )
    assert main(["export", str(tmp_path), "--to", "mujoco", *words]) == 2
    told = capsys.readouterr().err
    assert re.search(said, told)
    folders = re.findall(r"[^ ,]+", told.partition("is not in")[2].partition(".\n")[0])
    assert len(set(folders)) == len(folders)


@pytest.mark.parametrize("words", [["--start-heading", "0"], []])
def test_an_export_starts_as_it_is_told_or_in_the_first_pose(tmp_path, monkeypatch, capsys, words):
    """A heading of 0 is one. A session's clips count; its headings of pinned ends only warn."""
    held = FREE if words else PINNED
    clip = {"kind": "pinned", "at": 0.4, "place": (0.3, -0.1)}
    line = [(0.0, 0.0), (0.3, -0.1), (0.5, 0.1)]
    pose = dlo.Pose((0, 0), None if words else (0.5, 0.1), start_heading=1.0, points=line)
    pose = pose.changed(clips=() if words else (dlo.Clip(**clip),))
    session = dlo.Session(ROPE, [pose], **held)
    monkeypatch.setattr("dlo_casadi.session.round_trip.session_of", lambda *_: session)
    document = dlo.known_cable(ROPE, **held).metadata.document
    (tmp_path / "parameters.yaml").write_text(dump_yaml(document))
    file = tmp_path / "rope.xml"
    words = [str(tmp_path), "--to", "mujoco", "--output", str(file), *words, "--json"]
    assert main(["export", *words]) == 0
    assert ("clips" in json.loads(capsys.readouterr().out)["not_carried"]) == (held is PINNED)
    if held is FREE:
        expected = tmp_path / "expected.xml"
        dlo.load(tmp_path).export("mujoco", expected, start_heading=0.0)
        assert file.read_text() == expected.read_text()


def test_declared_limits_are_checked():
    known = dlo.known_cable(ROPE, **PINNED, limits={"force": 0.3})
    (check,) = known.solve(end=(0.5, 0.1)).check()
    assert (check.quantity, check.limit, check.verdict) == ("force", 0.3, "pass")


def test_a_heading_of_which_rounding_leaves_nothing_is_refused():
    """In Python and in C alike; at 1e20 rad neighbouring doubles are 16384 rad apart."""
    cable = dlo.known_cable(ROPE, **FREE, model={"n": 8})
    rows = np.array([[0, 0, 0, 0, x, 0] for x in (1e6, 1.1e6, 1e20)])
    shapes, statuses = cable.compile(flags=QUICK).solve_many(rows)
    assert statuses.tolist() == [0, 6, 6]
    assert not shapes["energy"][1:].any()
    assert cable.solve(start_heading=1e6).stable
    with pytest.raises(
        dlo.DloError, match=r"start_heading: 1\.1e\+06 rad: .*1e\+06 rad is possible"
    ):
        cable.solve(start_heading=1.1e6)


def test_gravity_in_units_of_g_is_questioned():
    with pytest.warns(UserWarning, match=r"in units of g\? Try: \[0.0, -9.81\]"):
        dlo.known_cable(ROPE, **PINNED | {"gravity": (0, -1.0)})
