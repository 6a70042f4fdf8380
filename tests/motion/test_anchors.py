"""Clips of a cable in motion, against statics and the frequencies of continuous beams."""

import json

import numpy as np
import pytest
from scipy.optimize import brentq

import dlo_casadi as dlo
from dlo_casadi.cli import main
from dlo_casadi.effects import AxialStretch, CableData
from dlo_casadi.equilibrium.pose import HeldPose
from dlo_casadi.equilibrium.solve import solve_equilibrium
from dlo_casadi.model.cable_model import CableModel
from dlo_casadi.model.clips import HeldClip
from dlo_casadi.motion.modes import damped_modes
from dlo_casadi.motion.modes_at_rest import moving_cable

LENGTH, MASS, STIFFNESS = 1.0, 0.1, 0.02
T = np.linspace(0.0, 0.5, 26)


def rope(d, ends=("clamped", "pinned"), n=20):
    own = {"torsional_stiffness": 0.015} if d == 3 else {}
    own |= {"length": LENGTH, "mass": MASS, "diameter": 0.006, "bending_stiffness": STIFFNESS}
    gravity = (0.0,) * (d - 1) + (-9.81,)
    return dlo.known_cable(dlo.Cable(**own), gravity=gravity, boundary=ends, model={"n": n})


def held(d):
    start = {"start_heading": 0.3} if d == 2 else {"start_orientation": (0.0, 0.0, 0.0, 1.0)}
    return {"end": (0.8,) + (0.1,) * (d - 1), **start}


def clip(d, kind):
    found = {"kind": kind, "place": (0.35,) + (0.05,) * (d - 1), "at": 0.43}
    if kind != "pinned":
        found |= {"heading": 0.2} if d == 2 else {"orientation": (0.0, 0.0, 0.1, 0.995)}
    return found


CASES = [(2, "pinned"), (2, "clamped"), (3, "pinned"), (3, "clamped"), (3, "swivel")]


@pytest.mark.parametrize(("d", "kind"), CASES)
def test_an_equilibrium_stays_where_it_is(d, kind):
    cable, one = rope(d), clip(d, kind)
    shape = cable.solve(**held(d), clips=[one])
    motion = cable.simulate(T, **held(d), clips=[one])
    assert motion.points == pytest.approx(motion.points[[0] * len(T)], abs=1e-10)
    (force,) = motion.clip_forces.values()
    assert force[0] == pytest.approx(shape.clips["clip_1"].force, abs=1e-9)
    assert motion.end_force[0] == pytest.approx(shape.end_force, abs=1e-9)
    assert motion.at([one["at"]])[:, 0] == pytest.approx(np.array([one["place"]] * len(T)))


@pytest.mark.parametrize("n", [20, 21])
def test_frequencies_of_a_beam_on_three_supports(n):
    """Of two equal spans l: sin x = 0 and tan x = tanh x, in turn; w = x^2 sqrt(EI / (m l^3))."""
    data = CableData(LENGTH, MASS, 0.006, STIFFNESS, "beam", straight=True)
    model = CableModel(
        data, n, start="pinned", end="pinned", gravity=(0.0, 0.0), effects=(AxialStretch(),),
        clips=("pinned",),
    )  # fmt: skip
    p = np.array(
        [{"axial_stretch.compliance": 1e-7}.get(q.name, q.nominal) for q in model.parameters]
    )
    middle = HeldClip("pinned", (LENGTH / 2, 0.0), LENGTH / 2)
    pose, rest = HeldPose((0.0, 0.0), (LENGTH, 0.0), clips=(middle,)), np.zeros(model.chain.n_rests)
    eq = solve_equilibrium(model, p, rest, pose)
    cable = moving_cable(model, p, rest, (eq, pose))
    fixtures = cable.fixtures(pose.vector)
    found = damped_modes(cable, cable.at_rest(eq, fixtures), fixtures, 4).rates
    both = [brentq(lambda x: np.tan(x) - np.tanh(x), *near) for near in ((3.8, 4.0), (7.0, 7.1))]
    x = np.array([np.pi, both[0], 2 * np.pi, both[1]])
    exact = x**2 * np.sqrt(STIFFNESS / (MASS / 2 * (LENGTH / 2) ** 3))
    np.testing.assert_allclose(found, exact, rtol=1e-3)


@pytest.mark.parametrize("d", [2, 3])
def test_energy_is_kept_and_the_step_in_casadi_rests(d):
    cable, one = rope(d), clip(d, "clamped")
    shape = cable.solve(**held(d), clips=[one])
    step = cable.step(0.01, about=shape)
    state, fixtures = shape.at_rest()
    assert step(state, fixtures)[0].full().ravel() == pytest.approx(state, abs=1e-8)
    pulled = cable.solve(**{**held(d), "end": (0.78,) + (0.05,) * (d - 1)}, clips=[one])
    free = rope(d, ("clamped", "free"))
    still = {key: x for key, x in held(d).items() if key != "end"}
    motion = free.simulate(T, **still, clips=[one], begins=pulled)
    assert motion.energy == pytest.approx(motion.energy[[0] * len(T)], rel=2e-3)
    assert np.ptp(motion.points[:, -1], axis=0).max() > 0.1
    # Before the clamped clip nothing moves.
    assert np.ptp(motion.at([0.2]), axis=0).max() < 1e-6


def test_a_clip_that_is_opened_lets_the_cable_go_on():
    cable, one = rope(2).with_damping(damping_time=0.02), clip(2, "pinned")
    first = cable.simulate(T, **held(2), clips=[one])
    after = cable.simulate(T, **held(2), begins=first)
    assert after.points[0] == pytest.approx(first.points[-1], abs=1e-9)
    assert np.ptp(after.at([one["at"]]), axis=0).max() > 0.05
    assert not after.clip_forces
    lower = cable.solve(**held(2)).points[50]
    assert after.points[-1, 50] == pytest.approx(lower, abs=0.02)


def test_what_clips_cannot_do_is_told():
    cable, one = rope(2), clip(2, "pinned")
    with pytest.raises(dlo.DloError, match="slides through an eyelet"):
        cable.simulate(T, **held(2), clips=[{"kind": "eyelet", "place": one["place"]}])
    motion = cable.simulate(T[:2], **held(2), clips=[one])
    with pytest.raises(dlo.DloError, match="with the clips that it has"):
        cable.simulate(T[:2], **held(2), clips=[{**one, "at": 0.5}], begins=motion)
    with pytest.raises(dlo.DloError, match="from clip_1"):
        cable.simulate(T[:2], **held(2), clips=[one], begins=cable.solve(**held(2)))
    with pytest.raises(dlo.DloError, match="knows no clips"):
        _ = motion.unknowns
    other = dlo.known_cable(
        dlo.Cable(length=1.2, mass=MASS, diameter=0.006, bending_stiffness=STIFFNESS),
        gravity=(0.0, -9.81), boundary=("clamped", "pinned"), model={"n": 20},
    )  # fmt: skip
    with pytest.raises(dlo.DloError, match=r"from 0 to 1\.2 m"):
        cable.simulate(T[:2], **held(2), begins=other.solve(**held(2)))
    links = dlo.known_cable(
        dlo.Cable(length=LENGTH, mass=MASS, diameter=0.006, bending_stiffness=STIFFNESS),
        gravity=(0.0, -9.81), boundary=("clamped", "pinned"), model={"n": 20, "element": "link"},
    )  # fmt: skip
    with pytest.raises(dlo.DloError, match="a shape of links"):
        cable.simulate(T[:2], **held(2), begins=links.solve(**held(2)))
    with pytest.raises(dlo.DloError, match="clips: recorded motions"):
        cable.with_clips(["pinned"]).motion_equations()


def test_the_commands_know_clips(tmp_path, capsys):
    folder = str(tmp_path)
    rope(2, ("clamped", "free")).with_damping(0.02).save(tmp_path)
    (tmp_path / "clips.yaml").write_text("- {kind: pinned, place: [0.1, -0.45], at: 0.5}\n")
    words = ["--clips", f"{folder}/clips.yaml", "--json"]
    slowest = []
    for more in (words, ["--json"]):
        assert main(["modes", folder, "--start-heading", "-1.2", *more]) == 0
        slowest.append(json.loads(capsys.readouterr().out)["frequencies"][0])
    assert slowest[0] > 1.2 * slowest[1]
    rows = [f"{t:.3f},{0.03 * np.sin(3 * t) ** 2:.6f},0,-1.2" for t in T]
    header = "t_s,start_x_m,start_y_m,start_heading_rad"
    (tmp_path / "slow.csv").write_text("\n".join([header, *rows, ""]))
    assert main(["simulate", folder, f"{folder}/slow.csv", *words]) == 0
    assert len(json.loads(capsys.readouterr().out)["clip_forces"]["clip_1"]) == len(T)
