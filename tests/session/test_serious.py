"""What questions a session itself is said beside its numbers, not only among the warnings."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np

import dlo_casadi as dlo
from dlo_casadi.report.tables import outcome_text
from dlo_casadi.session import plausibility
from dlo_casadi.session.measure import read_inputs
from dlo_casadi.session.outcome import Stage
from dlo_casadi.session.questions import Suspicion
from dlo_casadi.session.remarks import as_likely, far_off

PINS = ("pinned", "pinned")


def poses(count):
    """Poses of one weak cable between pins, as measured."""
    cable = dlo.Cable(length=0.8, mass=0.05, diameter=0.006, bending_stiffness=0.01)
    true = dlo.known_cable(cable, gravity=(0, -9.81), boundary=PINS, model={"n": 12})
    rng = np.random.default_rng(0)
    ends = [(0.6, 0.0), (0.5, 0.15), (0.4, -0.1), (0.55, -0.2), (0.45, 0.2)][:count]
    lines = [true.solve(end=end).points[1:-1] for end in ends]
    noisy = [line + rng.normal(0, 3e-4, line.shape) for line in lines]
    taken = [dlo.Pose((0, 0), end, points=x) for end, x in zip(ends, noisy, strict=True)]
    return cable, taken


def test_a_likely_mistake_is_told_before_the_fits_and_in_the_short_text(monkeypatch):
    """A doubt that refuses nothing stands beside the numbers of the fit that it questions."""
    cable, taken = poses(3)
    doubt = Suspicion("the cable does not hang along gravity (0, -9.81) m/s^2: ...", False)
    asked = ((lambda _: (doubt,),),)
    monkeypatch.setattr(plausibility, "QUESTIONS", (asked,))
    told = []
    progress = SimpleNamespace(step=lambda *_: None, warn=told.extend)
    session = dlo.Session(cable, taken, gravity=(0, -9.81), boundary=PINS, model={"n": 8})
    result = session.fit(diagnosis=False, progress=progress)
    assert told == [doubt.message]
    assert f"warning: {doubt.message}" in str(result)
    assert doubt.message in result.warnings
    assert f"warning: {doubt.message}" not in outcome_text(replace(result, serious=()))


def test_a_fit_pose_far_off_is_named():
    def stage(**rmse):
        shapes = {name: SimpleNamespace(rmse=error) for name, error in rmse.items()}
        return Stage("batch", 0.04, 9e-4, 1.0, {}, None, shapes)

    fitted = [SimpleNamespace(name=name, role="fit") for name in ("a", "b", "c")]
    fitted.append(SimpleNamespace(name="d", role="held_out"))
    found = stage(a=9e-4, b=0.09, c=8e-4, d=9e-4)
    (text,) = far_off(found, fitted)
    assert "b 90 mm" in text
    assert "0.9 mm, median" in text
    assert far_off(found, fitted, ["b: measured in another equilibrium"]) == []
    assert far_off(stage(a=9e-4, b=4e-3, c=8e-4, d=9e-4), fitted) == []
    assert far_off(stage(a=9e-4, b=8e-4, c=8e-4, d=0.09), fitted) == []  # a doubt tells of those


def test_gravity_upside_down_is_refused_of_eight_poses_as_of_five():
    """What is left under gravity as it was is noise: no tether explains that."""
    cable = dlo.Cable(length=0.8, mass=0.05, diameter=0.006, bending_stiffness=0.02)
    held, down = ("clamped", "pinned"), (0, -9.81)
    stiff = dlo.Cable(length=0.8, mass=0.05, diameter=0.006, bending_stiffness=0.01)
    true = dlo.known_cable(
        stiff, gravity=down, boundary=held, rest_curvature=[0.5, 1.0, 0.3], model={"n": 16}
    )
    rng, taken = np.random.default_rng(0), []
    for _ in range(8):
        end = 0.8 * np.array([rng.uniform(0.5, 0.8), rng.uniform(-0.2, 0.2)])
        heading = rng.normal(0, 0.3)
        line = true.solve(end=end, start_heading=heading).points[1:-1]
        noisy = line + rng.normal(0, 3e-4, line.shape)
        taken.append(dlo.Pose((0, 0), end, start_heading=heading, points=noisy))
    for count in (5, 8):
        session = dlo.Session(cable, taken[:count], gravity=(0, 9.81), boundary=held)
        found = plausibility.find_suspicions(session, read_inputs(session))
        (item,) = found
        assert "does not hang along gravity (0, 9.81) m/s^2" in item.message
        assert "with gravity (0, -9.81) m/s^2" in item.message
        assert item.certain, item.message


def test_effects_that_are_as_likely_as_none_are_told():
    assert not as_likely(())
    assert "clamp_angle would explain what was measured as well" in as_likely(("clamp_angle",))[0]
