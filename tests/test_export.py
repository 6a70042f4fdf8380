"""Fitted cables as files of simulators, and back: what rests there is what we predict."""

import re
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from dlo_casadi.effects import EFFECTS, CableData
from dlo_casadi.equilibrium.pose import HeldPose
from dlo_casadi.equilibrium.solve import solve_equilibrium
from dlo_casadi.equilibrium.spread import SolvedCable
from dlo_casadi.errors import DloError, OutputError
from dlo_casadi.export.mujoco import principal
from dlo_casadi.export.rod import Rod
from dlo_casadi.export.targets import TARGETS, losses, samples_of, target_of, write_rods
from dlo_casadi.model.cable_model import CableModel
from dlo_casadi.model.clips import HeldClip
from dlo_casadi.rod.supports import SupportKind

SPACE = CableData(0.6, 0.03, 0.004, 0.015, "loom <&>", torsional_stiffness=0.011)
PLANE = CableData(0.8, 0.2, 0.012, 0.3, "rope")
MASS, PLACE, RATIO = 0.02, 0.25, 3.0
ON_TABLE = HeldPose((0.0, 0.0), (0.5, 0.1))
GUIDED = {"start_heading": -1.0, "end_heading": 1.1, "end_tension": 1.0}


def in_space(*effects, start="clamped", end="clamped", free_length=None, **values):
    """A curved cable between two clamps, far from straight."""
    model = CableModel(SPACE, 20, "quadratic", start, end, (0, 0, -9.81), n_rest=4)
    model = replace(model, fed_by_length=free_length is not None)
    for effect in effects:
        model = model.with_effect(EFFECTS[effect]())
    p = model.nominal.copy()
    for name, value in values.items():
        p[model.names.index(name.replace("__", "."))] = value
    rest = model.rest_basis @ np.array([0.5, 2.0, 1.0, 0.2, 0.3, 1.0, 0.8, 0.1])
    turned = tuple(Rotation.from_rotvec([0.6, -0.4, 0.7]).as_quat())
    pose = HeldPose(
        (0.1, 0.2, 0.3), (0.45, 0.3, 0.35), start_orientation=(0, 0, 0, 1), end_orientation=turned
    )
    return SolvedCable.of(model, p, rest, replace(pose, free_length=free_length))


def in_plane(start="pinned", end="pinned", **more):
    model = CableModel(PLANE, 20, "quadratic", start, end, n_rest=4)
    rest = model.rest_basis @ np.array([0.5, 2.0, 1.0, 0.2])
    pose = HeldPose((0.1, 0.2), (0.6, 0.1) if end != "free" else None, start_heading=0.3)
    pose = replace(pose, **more)
    return SolvedCable.of(model, model.nominal, rest, pose)


def off(held, rod, nodes):
    """Largest distance of nodes from our curve at the same arc length, over the length."""
    low, high = held.places[[0, -1]]
    length = high - low
    inside = (rod.s >= low) & (rod.s <= high + 1e-12 * length)
    ours = np.zeros((inside.sum(), 3))
    ours[:, : held.curve.d] = held.curve.along(length).at(rod.s[inside] - low)
    return np.linalg.norm(nodes[inside] - ours, axis=1).max() / length


CASES = {
    "space": lambda: in_space(),
    "mass": lambda: in_space("lumped_mass", lumped_mass__mass=MASS, lumped_mass__position=PLACE),
    "flat": lambda: in_space(
        "bending_anisotropy", bending_anisotropy__ratio=RATIO, bending_anisotropy__angle=0.4
    ),
    "swivel": lambda: in_space(end="swivel"),
    "swivels": lambda: in_space(start="swivel", end="swivel"),
    "plane": in_plane,
    "overhang": lambda: in_plane("clamped", "free"),
    "fed": lambda: in_plane("clamped", "slide", **GUIDED),
    "fed at the start": lambda: in_space(start="slide", free_length=0.7),
}


@pytest.mark.parametrize("case", CASES)
def test_the_rod_lies_on_the_curve(case):
    """Chords of n links are off an arc by h^2 k / 8; the links have the cable's mass."""
    held = CASES[case]()
    rod = Rod.of(held, 40)

    assert off(held, rod, rod.nodes) < 1e-3
    assert np.linalg.norm(np.diff(rod.nodes, axis=0), axis=1) == pytest.approx(rod.h, rel=1e-6)
    assert rod.frames.apply([1.0, 0.0, 0.0]) == pytest.approx(np.diff(rod.nodes, axis=0) / rod.h)
    share = np.ptp(held.places) / held.model.cable.length
    assert (share != 1) == ("fed" in case)
    assert rod.masses.sum() == pytest.approx(share * held.model.cable.mass)


def test_what_effects_are_to_a_rod():
    rod = Rod.of(CASES["mass"](), 20)
    assert rod.lumps == pytest.approx(np.array([[MASS, PLACE]]))
    stiffness, axes = principal(Rod.of(CASES["flat"](), 20))
    assert stiffness == pytest.approx(np.tile([0.011, 0.015, 0.045], (19, 1)))
    assert np.abs(axes.as_matrix()[:, 2, 1] / axes.as_matrix()[:, 1, 1]) == pytest.approx(
        np.tan(0.4)
    )


def test_what_scales_a_rod():
    """A longer cable, a heavier one, one that stretches, one that is stiffer in a part."""
    plain = Rod.of(CASES["space"](), 20)
    assert plain.h * 19 == pytest.approx(0.6)  # half a link is in each clamp
    assert plain.axial == np.inf
    longer = Rod.of(in_space("length_error", length_error__length_difference=0.005), 20)
    assert longer.h * 19 == pytest.approx(0.605)
    heavier = Rod.of(in_space("mass_error", mass_error__factor=1.2), 20)
    assert heavier.masses == pytest.approx(1.2 * plain.masses)
    assert Rod.of(in_space("axial_stretch", axial_stretch__compliance=2e-3), 20).axial == 500.0
    values = {"stiff_section__start": 0.2, "stiff_section__end": 0.4, "stiff_section__factor": 3.0}
    part = Rod.of(in_space("stiff_section", **values), 20)
    inner, s = part.h / 2, part.s[1:-1]
    for joints, factor in (
        ((s > 0.2 + inner) & (s < 0.4 - inner), 3.0),
        ((s < 0.2 - inner) | (s > 0.4 + inner), 1.0),
    ):
        assert joints.sum() > 3
        assert part.mean_bending[joints] == pytest.approx(factor * 0.015, rel=0.04)  # soft edges
        assert part.torsion[joints] == pytest.approx(factor * 0.011, rel=0.04)


@pytest.mark.parametrize("case", ["space", "overhang"])
def test_the_default_mesh_turns_by_a_tenth_of_a_radian_at_most(case):
    rod = Rod.of(CASES[case]())
    most = rod.turns.magnitude().max()
    assert most < 0.1 * 1.02  # the curvature is sampled
    assert most > 0.09 or len(rod.masses) == 40


@pytest.mark.parametrize("place", [0.0, PLACE, 0.8])
def test_a_compact_mass_at_an_end_makes_no_link_lighter(place):
    """Shared by two neighbours, its moment is kept; within h / 2 of an end one link has all."""
    rod = replace(Rod.of(CASES["overhang"](), 40), lumps=np.array([[MASS, place]]))
    middles = (rod.s[1:] + rod.s[:-1]) / 2
    for points in (middles, rod.s):
        shares = rod.lumps_at(points)
        assert shares.min() >= 0
        assert shares.sum() == pytest.approx(MASS)
        assert shares @ points / MASS == pytest.approx(np.clip(place, points[0], points[-1]))
    assert (rod.link_masses >= rod.masses).all()


@pytest.mark.parametrize("case", CASES)
def test_mujoco_rests_where_we_predict(case):
    pytest.importorskip("mujoco", reason="the extra `peers` is not installed")
    held, target = CASES[case](), TARGETS["mujoco"]
    rod = Rod.of(held, 40)

    at_rest = target.settle(target.write(rod, ["a -- b"]), rod)

    assert off(held, rod, at_rest.nodes) < 1e-2
    force = solve_equilibrium(held.model, held.p, held.rest, held.pose).end_force
    force = np.pad(force, (0, 3 - len(force)))
    assert at_rest.end_force == pytest.approx(force, abs=0.01 * np.linalg.norm(force))


@pytest.mark.long
@pytest.mark.parametrize("target", ["newton", "usd"])
@pytest.mark.parametrize("case", ["space", "mass", "plane", "overhang"])
def test_newton_rests_where_we_predict(case, target):
    """From a Python file, and from USD by Newton's own importer."""
    for package in TARGETS[target].packages:
        pytest.importorskip(package, reason="the extra `newton` is not installed")
    held = CASES[case]()
    rod = Rod.of(held, 40)

    at_rest = TARGETS[target].settle(TARGETS[target].write(rod, ["a -- b"]), rod)

    assert off(held, rod, at_rest.nodes) < 1e-2


def test_a_usd_file_is_valid_and_holds_the_rod():
    """As usd-core reads it; turns of the frames that normals span are those without load."""
    pxr = pytest.importorskip("pxr", reason="usd-core is not installed")
    from pxr import Sdf, Usd, UsdGeom, UsdValidation

    assert pxr
    rod = Rod.of(CASES["flat"](), 12)
    layer = Sdf.Layer.CreateAnonymous(".usda")
    assert layer.ImportFromString(TARGETS["usd"].write(rod, ['"quoted"']))
    stage = Usd.Stage.Open(layer)
    validators = UsdValidation.ValidationRegistry().GetOrLoadAllValidators()
    assert not UsdValidation.ValidationContext(validators).Validate(stage)

    curve = UsdGeom.BasisCurves.Get(stage, "/World/cable")
    assert np.array(curve.GetPointsAttr().Get()) == pytest.approx(rod.nodes, abs=1e-6)
    read = lambda name: np.array(curve.GetPrim().GetAttribute(f"physics:{name}").Get())  # noqa: E731
    assert read("masses").sum() == pytest.approx(rod.masses.sum(), rel=1e-6)
    x = np.diff(read("restShapePoints"), axis=0) / rod.h
    z = read("restNormals")[:-1]
    frames = Rotation.from_matrix(np.stack([x, np.cross(z, x), z], axis=2))
    turns = (frames[:-1].inv() * frames[1:]).as_rotvec()
    assert turns == pytest.approx(rod.h * rod.rest, abs=1e-5)
    material = stage.GetPrimAtPath("/World/material").GetAttribute
    bending = material("physics:curvesBendStiffness").Get()
    assert bending == pytest.approx((1 + RATIO) / 2 * 0.015, rel=1e-6)
    for side, fixture in (("start", rod.start), ("end", rod.end)):
        attached = stage.GetPrimAtPath(f"/World/hold_{side}").GetAttribute
        to_world = UsdGeom.Xformable.Get(stage, f"/World/{side}").ComputeLocalToWorldTransform(0)
        held = [to_world.Transform(tuple(map(float, p))) for p in attached("physics:coords1").Get()]
        assert np.array(held[0]) == pytest.approx(fixture.cable_place, abs=1e-6)
        ways = fixture.cable_frame.inv().apply(np.diff(held, axis=0)) / rod.h
        assert ways == pytest.approx(np.array([[5, 0, 0], [-5, 0, 5]]), abs=1e-4)  # x, then z


def test_one_bending_stiffness_costs_what_it_moves():
    """Of a flat cable Newton has the mean of both: it is told how far that moves the shape."""
    held = CASES["flat"]()
    found = losses(held, TARGETS["newton"], Rod.of(held, 10))

    mean = in_space()
    p = mean.p.copy()
    p[mean.model.names.index("bending_stiffness")] = (1 + RATIO) / 2 * 0.015
    mean = SolvedCable.of(mean.model, p, mean.rest, mean.pose)
    s = np.linspace(0, 0.6, 101)
    moved = 100 * np.linalg.norm(held.curve.at(s) - mean.curve.at(s), axis=1).max() / 0.6
    assert list(found) == ["anisotropy"]
    share = re.search(r"moves by up to ([\d.]+) %", found["anisotropy"])
    assert float(share[1]) == pytest.approx(moved, rel=0.05)


def test_an_unstressed_rod_keeps_its_rest_shape_in_mujoco():
    """Without weight, one end free: every joint is at its rest angle, the force is zero."""
    mj = pytest.importorskip("mujoco", reason="the extra `peers` is not installed")
    held = in_space()
    rod = Rod.of(held, 30)
    rod = replace(rod, gravity=np.zeros(3), end=replace(rod.end, kind=SupportKind.FREE))
    at_rest = TARGETS["mujoco"].settle(TARGETS["mujoco"].write(rod, []), rod)

    turns = [rod.frames[0]]
    for turn in rod.rest_turns:
        turns.append(turns[-1] * turn)
    ways = np.array([frame.apply([1.0, 0.0, 0.0]) for frame in turns])
    exact = np.vstack([rod.nodes[0], rod.nodes[0] + rod.h * np.cumsum(ways, axis=0)])
    assert at_rest.nodes == pytest.approx(exact, abs=1e-5), mj.__version__


@pytest.mark.parametrize("target", TARGETS)
def test_a_file_says_what_it_holds(target, tmp_path):
    held = CASES["mass"]()
    kind = TARGETS[target]
    (path,) = write_rods(kind, tmp_path / f"loom{kind.suffix}", [held], "of a test", 10, 0)
    text = path.read_text()

    assert f"written by dlo-casadi for {kind.title}" in text
    assert "EI 0.015 N m^2, GJ 0.011 N m^2, mass 0.05 kg" in text
    assert "compact mass of 0.02 kg at 0.25 m" in text
    assert re.search(r"Not represented:\n\W+nothing", text)


def told_and_moved(held, free, what):
    """How far the cable moves without what is lost [%]: as the losses tell, and computed here."""
    found = losses(held, TARGETS["mujoco"], Rod.of(held, 10))
    length = held.model.cable.length
    s = np.linspace(0, length, 101)
    moved = np.linalg.norm(held.curve.at(s) - free.curve.at(s), axis=1).max() / length
    share = re.search(r"moves by up to ([\d.]+) % of ", found[what])
    return float(share[1]), 100 * moved


def test_what_is_not_carried_is_named_with_its_size():
    held = in_space("tether", tether__stiffness=20.0, tether__position=0.3)
    told, moved = told_and_moved(held, in_space(), "spring")
    assert told == pytest.approx(moved, rel=0.05)  # two digits
    assert moved > 2
    found = losses(held, TARGETS["mujoco"], Rod.of(held, 10))
    assert list(found) == ["spring"]
    assert found["spring"].startswith("tether left out; ")


def test_a_table_that_a_fit_has_found_is_not_carried_either():
    model = CableModel(PLANE, 20, start="pinned", end="pinned", n_rest=0)
    free = SolvedCable.of(model, model.nominal, np.zeros(20), ON_TABLE)
    on_table = model.with_effect(EFFECTS["contact_plane"]())
    p = np.append(model.nominal, -0.15)
    held = SolvedCable.of(on_table, p, np.zeros(20), ON_TABLE)
    told, moved = told_and_moved(held, free, "obstacles")
    assert told == pytest.approx(moved, rel=0.05)  # two digits
    assert moved > 2


def test_what_is_fed_stays_as_in_the_pose():
    """The rest curvature beyond the declared length stays as at its ends, and a file says so."""
    held = CASES["fed at the start"]()
    rod, target = Rod.of(held, 40), TARGETS["mujoco"]
    beyond = rod.s[1:-1] < 0.0
    assert 2 < beyond.sum() < 20
    ends = np.tile([0.0, 0.5, 0.3], (beyond.sum() - 1, 1))
    assert rod.rest[beyond][:-1] == pytest.approx(ends, rel=1e-3)
    between = f"the {1e3 * np.ptp(held.places):.1f} mm between the ends of this shape stay"
    assert between in losses(held, target, rod)["feeding through an end"]


def test_clips_are_not_carried_either():
    """The loss is the distance between the shapes with and without the clip."""
    model = CableModel(PLANE, 20, start="pinned", end="pinned", n_rest=0)
    free = SolvedCable.of(model, model.nominal, np.zeros(20), ON_TABLE)
    clip = HeldClip("pinned", (0.3, -0.15), 0.4)
    held = SolvedCable.of(
        replace(model, clips=("pinned",)),
        model.nominal,
        np.zeros(20),
        replace(ON_TABLE, clips=(clip,)),
    )
    told, moved = told_and_moved(held, free, "clips")
    assert told == pytest.approx(moved, rel=0.05)  # two digits
    assert moved > 2


def test_samples_scatter_as_the_covariance_says():
    """EI and GJ, which move together, and a coefficient of the rest curvature."""
    held = CASES["space"]()
    names = ["bending_stiffness", "torsional_stiffness", "rest_curvature[1]"]
    std = np.array([0.1 * 0.015, 0.5 * 0.011, 0.2])
    together = np.array([[1.0, 0.9, 0.0], [0.9, 1.0, 0.0], [0.0, 0.0, 1.0]])
    covariance = std * together * std[:, None]
    basis = held.model.rest_basis
    coefficients = np.linalg.lstsq(basis, held.rest)[0]
    drawn = samples_of(held, coefficients, names, covariance, 30, 3)

    p = np.array([item.p for item in drawn])
    assert (p[:, :2] > 0).all()
    assert np.log(p[:, 0] / 0.015).std() == pytest.approx(0.1, rel=0.3)  # 30 of them: 13 %
    assert np.log(p[:, 1] / 0.011).std() == pytest.approx(0.5, rel=0.3)
    assert np.corrcoef(np.log(p[:, :2]).T)[0, 1] == pytest.approx(0.9, abs=0.1)
    off = np.array([np.linalg.lstsq(basis, item.rest)[0] - coefficients for item in drawn])
    assert off[:, 1].std() == pytest.approx(0.2, rel=0.3)
    assert np.delete(off, 1, axis=1) == pytest.approx(0.0, abs=1e-9)
    again = samples_of(held, coefficients, names, covariance, 2, 3)
    assert (again[1].rest == drawn[1].rest).all()
    assert (again[1].curve.nodes == drawn[1].curve.nodes).all()
    (other,) = samples_of(held, coefficients, names, covariance, 1, 4)
    assert other.p[0] not in p[:, 0]


def test_samples_stay_within_the_bounds_of_physics():
    """Of a mass 50 mm before the end, known to 0.2 m, a third would be beyond the cable."""
    held = in_space("lumped_mass", lumped_mass__mass=MASS, lumped_mass__position=0.55)
    coefficients = np.linalg.lstsq(held.model.rest_basis, held.rest)[0]
    drawn = samples_of(held, coefficients, ["lumped_mass.position"], np.array([[0.04]]), 8, 0)
    places = [item.p[held.model.names.index("lumped_mass.position")] for item in drawn]
    assert 0.0 <= min(places) < max(places) - 0.1
    assert max(places) <= 0.6


def test_only_exports_are_replaced(tmp_path):
    held, path = in_plane(), tmp_path / "rope.xml"
    write_rods(TARGETS["mujoco"], path, [held, held], "of a test", 10, 0)
    assert "sample 1 of 1, seed 0" in (tmp_path / "rope_001.xml").read_text()
    write_rods(TARGETS["mujoco"], path, [held], "of a test", 10, 0)
    path.write_text("mine")
    with pytest.raises(OutputError, match=r"rope\.xml is from elsewhere"):
        write_rods(TARGETS["mujoco"], path, [held], "of a test", 10, 0)
    assert path.read_text() == "mine"


def test_unknown_simulators_and_mjx_are_refused_with_a_way_out():
    with pytest.raises(DloError, match=r"'mujuco'; did you mean 'mujoco'\?\n  Try: mujoco, "):
        target_of("mujuco")
    with pytest.raises(DloError, match=r"MJX ignores bend and twist .*\n  Try: --to mujoco"):
        target_of("mjx")
