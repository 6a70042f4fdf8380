"""A new effect is one class and one line in EFFECTS: nothing else has to know of it."""

import json
import shutil
from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar, Self

import casadi as ca
import numpy as np
import pytest
import yaml

import dlo_casadi as dlo
from dlo_casadi.cable.file import load
from dlo_casadi.config import load_config
from dlo_casadi.effects import (
    EFFECTS,
    AxialStretch,
    CableData,
    Effect,
    Fitted,
    Kinematics,
    PointForce,
    PointLoad,
    Setup,
    SideLoad,
)
from dlo_casadi.effects.cable import Parameter
from dlo_casadi.effects.effect import Params, PointForceAt, SpringAt
from dlo_casadi.effects.registry import Registry
from dlo_casadi.equilibrium.pose import HeldPose
from dlo_casadi.equilibrium.solve import solve_equilibrium
from dlo_casadi.errors import ConfigError, DloError
from dlo_casadi.estimation.prediction import predict_poses
from dlo_casadi.model.cable_model import CableModel

NOISE = 3e-4
LIFT, PLACE = 0.4, 0.35  # N, m
ENDS = ((0.6, 0.0), (0.3, 0.1), (0.5, -0.3), (0.2, -0.2), (0.65, 0.2), (0.35, -0.45))


@dataclass(frozen=True)
class Balloon(PointLoad):
    """A balloon tied to the cable: a force against gravity."""

    name = "balloon"
    dimensions = (2,)
    inverses: ClassVar = {"lift": ("compliance", "1/N")}

    up: tuple[float, float] = (0.0, 1.0)

    def parameters(self, cable: CableData) -> tuple[Parameter, ...]:
        """Declare the lift, at most the cable's weight, and its place."""
        weight = 9.81 * cable.mass
        lift = Parameter("lift", "N", scale=0.1 * weight, lower=0.0, upper=weight)
        return (lift, self.position(cable))

    @classmethod
    def applies(cls, setup: Setup) -> bool:
        """Nothing floats without weight."""
        return any(setup.gravity)

    @classmethod
    def made_for(cls, setup: Setup) -> Self:
        """Upwards."""
        x, y = -np.array(setup.gravity) / max(np.linalg.norm(setup.gravity), 1e-12)
        return cls(up=(float(x), float(y)))

    def refusal(self, setup: Setup, values: Mapping[str, float]) -> str:
        """A balloon at the start lifts nothing."""
        return "" if values["position"] > 0 else "it is tied to a fixture. Try: position"

    def may_be(self, found: Fitted) -> bool:
        """Any dead force may be one."""
        return isinstance(found.effect, PointForce)

    def forces(self, gravity: ca.SX, params: Params) -> tuple[PointForceAt, ...]:
        """The lift."""
        return (PointForceAt(params["lift"] * ca.DM(self.up), params["position"]),)


@pytest.fixture(scope="module")
def known():
    """The line in EFFECTS."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(EFFECTS, Balloon.name, Balloon)
        yield


def write(folder, *, effects=(), tried=(Balloon.name,)):
    """Write a session of a straight cable with a balloon."""
    cable = {"name": "light", "length": 0.8, "mass": 0.2, "diameter": 0.01}
    model = CableModel(CableData(0.8, 0.2, 0.01, 0.1), 40, effects=(Balloon(),), n_rest=0)
    poses = [HeldPose((0.0, 0.0), end) for end in ENDS]
    rest = np.zeros(model.chain.n_cells)
    shapes = predict_poses(model, np.array([0.1, LIFT, PLACE]), rest, poses)
    rng, s = np.random.default_rng(0), np.linspace(0.02, 0.98, 30) * 0.8
    listed = []
    for k, (end, shape) in enumerate(zip(ENDS, shapes, strict=True)):
        points = shape.curve.at(s) + rng.normal(scale=NOISE, size=(30, 2))
        file = f"pose_{k}.csv"
        np.savetxt(folder / file, points, "%.6f", ",", header="x_m,y_m", comments="")
        role = "held_out" if k == 0 else "fit"
        listed.append({"file": file, "start": [0.0, 0.0], "end": list(end), "role": role})
    document = {
        "cable": {**cable, "bending_stiffness": 0.3, "rest_shape": "straight"},
        "experiment": {
            "gravity": [0.0, -9.81],
            "boundary": {"start": "pinned", "end": "pinned"},
            "measurement": {"kind": "centerlines", "std": NOISE},
            "poses": listed,
        },
        "model": {"n": 12, "effects": list(effects)},
        "estimation": {"algorithm1": False},
        "diagnosis": {"exclude": [name for name in EFFECTS if name not in tried]},
    }
    path = folder / "session.yaml"
    path.write_text(yaml.safe_dump(document))
    return path


@pytest.fixture(scope="module")
def result(known, tmp_path_factory):
    return dlo.fit(write(tmp_path_factory.mktemp("found")))


def test_the_diagnosis_finds_it(result):
    assert result.verdict == "effect_found"
    (row,) = result.effects
    assert row.name == "balloon"
    for name, true in (("lift", LIFT), ("position", PLACE)):
        assert abs(row.parameters[name].value - true) < 3 * row.parameters[name].std
    lift, compliance = row.parameters["lift"], row.parameters["compliance"]
    assert compliance.value == 1 / lift.value
    assert compliance.std == pytest.approx(lift.std / lift.value**2)


def test_the_results_tell_of_it(result, tmp_path):
    result.write(tmp_path / "results")
    report = json.loads((tmp_path / "results" / "report.json").read_text())
    assert [effect["name"] for effect in report["effects"]] == ["balloon"]
    assert report["stages"][-1]["parameters"]["balloon.lift"]["value"] > 0
    assert "A balloon tied to the cable" in (tmp_path / "results" / "report.html").read_text()
    assert "The declared model lacked balloon" in str(result)
    cable = load(tmp_path / "results")
    assert cable.model.effects == result.fit.model.effects
    assert cable.p[cable.model.names.index("balloon.lift")] == result.fit.value("balloon.lift")


@pytest.mark.skipif(shutil.which("cc") is None, reason="no C compiler (cc)")
def test_the_generated_solver_knows_it(result):
    cable = result.cable
    solver = cable.compile(flags=("-O0",))  # compiles quickly
    for end in ENDS:
        pose = HeldPose((0.0, 0.0), end)
        expected = solve_equilibrium(cable.model, cable.p, cable.rest, pose)
        assert solver.solve(pose).points == pytest.approx(expected.points, abs=1e-8)


def test_it_stands_behind_what_acts_like_it(known, tmp_path):
    result = dlo.fit(write(tmp_path, tried=(PointForce.name,)))
    assert "balloon" in result.effects[0].indistinguishable_from


def test_it_can_be_declared(known, tmp_path):
    guess = {"name": "balloon", "parameters": {"lift": 0.3, "position": 0.3}}
    result = dlo.fit(write(tmp_path, effects=[guess]), diagnosis=False)
    lift = result.stages[-1].parameters["balloon.lift"]
    assert abs(lift.value - LIFT) < 3 * lift.std
    guess["parameters"]["position"] = 0.0
    with pytest.raises(ConfigError, match=r"balloon: it is tied to a fixture\. Try: position"):
        load_config(write(tmp_path, effects=[guess]))


def test_what_an_effect_does_not_declare_has_a_default():
    setup = Setup(CableData(0.8, 0.2, 0.01, 0.1), tolerances={"length": 1e-3})

    class Plain(Effect):
        name = "plain"

        def parameters(self, cable: CableData) -> tuple[Parameter, ...]:
            return (Parameter("size"),)

    effect = Plain.made_for(setup)
    assert Plain.applies(setup)
    assert effect.refusal(setup, {"size": 1.0}) == ""
    assert effect.prior(setup) == {}
    assert effect.scans(setup) == ({},)
    assert effect.place({"size": 1.0}) is None
    assert not effect.may_be(Fitted(effect, setup, {"size": 1.0}, {"size": 0.1}))


class Plumb(PointLoad):
    """A weight of which only the parameters are written."""

    name = "plumb"

    def parameters(self, cable: CableData) -> tuple[Parameter, ...]:
        """Declare the mass and its place."""
        return (Parameter("mass", "kg"), self.position(cable))


class NoTuple(Plumb):
    name = "no_tuple"

    def forces(self, gravity, params):
        return PointForceAt(params["mass"] * gravity, params["position"])


class NoParameters(NoTuple):
    name = "no_parameters"

    def parameters(self, cable):
        return Parameter("mass", "kg")


class NoPlace(Plumb):
    name = "no_place"

    def parameters(self, cable):
        return (Parameter("mass", "kg"),)

    def forces(self, gravity, params):
        return (PointForceAt(params["mass"] * gravity, params["position"]),)


class Uncounted(Plumb):
    name = "uncounted"

    def springs(self, params):
        return (SpringAt(params["mass"], ca.SX.zeros(2), ca.SX(0), params["position"]),)


@pytest.mark.parametrize(
    ("name", "kind", "said"),
    [
        ("uncounted", Uncounted, "its springs returns 1 spring, and n_springs is 0.*n_springs = 1"),
        ("no_place", NoPlace, "NoPlace .* its scans name 'position', and it has mass"),
        ("plumb", Plumb, "Plumb cannot be an effect: it has no law and would do nothing.*springs"),
        ("no_tuple", NoTuple, "NoTuple .* its forces must return a tuple of PointForceAt, found"),
        ("no_parameters", NoParameters, "its parameters must return a tuple of Parameter, found"),
        ("other", Balloon, "Balloon .* its name is 'balloon', not 'other'"),
        ("plain", type("Plain", (), {}), "Plain .* no class that derives from a kind of effect"),
        ("balloon", Balloon(), "it is no class that derives from a kind"),
        ("bare", type("Bare", (PointLoad,), {"name": "bare"}), "Bare .* declares no parameters"),
    ],
)
def test_a_mistake_in_an_effect_is_told_when_it_is_registered(name, kind, said):
    with pytest.raises(DloError, match=f"(?s){said}"):
        EFFECTS[name] = kind
    assert EFFECTS.get(name) is not kind


def test_a_compliance_of_ones_own_stretches_the_cable():
    class Rubber(Kinematics):
        name = "rubber"
        declared = (Parameter("softness", "1/N", lower=0.0),)

        def compliance(self, params):
            return params["softness"]

    cable, pose = CableData(0.8, 0.2, 0.01, 0.1), HeldPose((0.0, 0.0), (0.5, 0.1))
    p, rest = np.array([0.1, 0.05]), np.zeros(12)
    own, known = (
        solve_equilibrium(CableModel(cable, 12, n_rest=0, effects=(one,)), p, rest, pose)
        for one in (Rubber(), AxialStretch())
    )
    assert own.points == pytest.approx(known.points, abs=1e-12)


@pytest.mark.long
def test_an_effect_of_ones_own_may_differ_at_random_from_pose_to_pose(monkeypatch):
    class Draught(SideLoad):
        name = "draught"
        at_random = "a draught of its own"

    monkeypatch.setitem(EFFECTS, "draught", Draught)
    model = CableModel(CableData(0.8, 0.06, 0.006, 0.02), 40, effects=(Draught(),), n_rest=0)
    rng, s, std, listed = np.random.default_rng(3), np.linspace(0.02, 0.98, 25) * 0.8, 0.05, []
    for end in ENDS:
        p, held = np.array([0.03, rng.normal(scale=std)]), HeldPose((0.0, 0.0), end)
        (shape,) = predict_poses(model, p, np.zeros(model.chain.n_rests), [held])
        points = shape.curve.at(s) + rng.normal(scale=NOISE, size=(25, 2))
        listed.append(dlo.Pose((0.0, 0.0), end, points=points))
    cable = dlo.Cable(length=0.8, mass=0.06, diameter=0.006, bending_stiffness=0.02)
    session = dlo.Session(cable, listed, gravity=(0.0, -9.81), boundary=("pinned", "pinned"))
    scatter = session.fit(diagnosis=False).fit.problem.priors.pose_scatter
    assert scatter.words == "a draught of its own"
    assert 0.5 < scatter.std / std < 2.0


def test_the_registry_accepts_the_effects_of_the_package():
    accepted = Registry()
    for name, kind in EFFECTS.items():
        accepted[name] = kind
    assert accepted == EFFECTS


def test_a_file_with_an_effect_that_is_not_registered_says_so(known, tmp_path):
    cable = dlo.Cable(length=0.8, mass=0.2, diameter=0.01, bending_stiffness=0.3)
    declared = {"name": "balloon", "parameters": {"lift": LIFT, "position": PLACE}}
    held = {"gravity": (0, -9.81), "boundary": ("pinned", "pinned")}
    document = dlo.known_cable(cable, **held, model={"effects": [declared]}).metadata.document
    (tmp_path / "parameters.yaml").write_text(yaml.safe_dump(document))
    assert load(tmp_path).model.effects == (Balloon(),)
    with pytest.MonkeyPatch.context() as patch:
        patch.delitem(EFFECTS, "balloon")
        said = (
            r"no effect is called 'balloon' in this process.*dlo\.EFFECTS\['balloon'\] = its class"
        )
        with pytest.raises(ConfigError, match=f"(?s){said}"):
            load(tmp_path)
