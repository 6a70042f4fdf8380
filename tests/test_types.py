"""The public classes for editors and type checkers: types, signatures, help, completion."""

import inspect
import os
import subprocess
import sys
from pathlib import Path

import casadi as ca
import numpy as np
import pydantic
import pytest
from scipy.spatial.transform import Rotation

import dlo_casadi as dlo

ROOT = Path(__file__).parents[1]
SECTIONS = (dlo.Cable, dlo.Clip, dlo.Obstacle, dlo.Pose, dlo.Session)
ROPE = dlo.Cable(length=0.8, mass=0.05, diameter=0.005, bending_stiffness=0.01)
LINE = [[0.0, 0.0], [0.1, -0.1], [0.3, -0.1]]

SCRIPT = """
import casadi as ca
import numpy as np
from scipy.spatial.transform import Rotation

import dlo_casadi as dlo

rope = dlo.Cable(length=0.8, mass=0.05, diameter=0.005, bending_stiffness=0.01)
line = np.array([[0.0, 0.0], [0.1, -0.1], [0.3, -0.1]])
level = Rotation.identity()
saddle = dlo.Clip(kind="swivel", at=0.3, place=(0, 0.1, 0), orientation=level)
poses = [
    dlo.Pose((0, 0), [0.5, 0.1], points=line, role="held_out"),
    dlo.Pose(np.zeros(2), ca.DM([0.4, 0.0]), points=line.tolist(), at=[0.0, 0.1, 0.3]),
    dlo.Pose(
        (0, 0, 0),
        (0.5, 0, 0),
        start_orientation=level,
        end_orientation=(0, 0, 0, 1),
        clips=[saddle, {"kind": "eyelet", "place": [0.1, 0.2, 0.0]}],
        end_force=np.array([0.0, 0.0, 1.0]),
        end_moment=np.zeros(3),
    ),
    dlo.Pose((0, 0), file="a.csv", start_heading=0.1, end_moment=0.1, over={"bar": True}),
]
table = dlo.Obstacle(kind="plane", point=(0, -0.2), normal=np.array([0.0, 1.0]))
session = dlo.Session(
    rope,
    poses,
    gravity=(0, -9.81),
    boundary=("pinned", "pinned"),
    obstacles=[table, {"kind": "sphere", "center": [0, 0], "radius": 0.1}],
    std=3e-4,
    diagnosis={"enabled": False},
)
start: tuple[float, ...] = poses[0].start
end: tuple[float, ...] | None = poses[0].end
clip: dlo.Clip = poses[2].clips[0]
length: float = session.cable.length
result: dlo.Result = session.fit()
estimate: dlo.Estimate = result.params["bending_stiffness"]
shape: dlo.Shape = result.cable.solve(end=(0.3, -0.1))
known: dlo.FittedCable = dlo.known_cable(rope, gravity=line[0], boundary=("pinned", "pinned"))
"""
MISTAKES = {
    'dlo.Pose("a.csv", (0, 0))': 'Argument 1 to "Pose" has incompatible type "str"',
    'dlo.Pose((0, 0), (1, 0), role="test")': "expected \"Literal['fit', 'held_out']\"",
    "dlo.Pose((0, 0), (1, 0), hedding=0.1)": 'Unexpected keyword argument "hedding" for "Pose"',
    "dlo.Pose((0, 0)).start = (1.0, 0.0)": 'Property "start" defined in "Pose" is read-only',
    'dlo.Cable(length="1", mass=1, diameter=0.1)': '"length" to "Cable" has incompatible type',
    "dlo.Cable(length=1, mass=1)": 'Missing named argument "diameter" for "Cable"',
    'dlo.Clip(kind="glued", place=(0, 0))': 'Argument "kind" to "Clip" has incompatible type',
    "dlo.Obstacle(kind='plane', point=1.0)": 'Argument "point" to "Obstacle" has incompatible',
    "dlo.Session(rope, [], garvity=(0, 0))": 'Argument "garvity" to "Session" has incompatible',
}


def test_a_script_is_checked_strictly(tmp_path, request):
    """Nothing is wrong in the first, each line of the second is: mypy as in a user's folder."""
    (tmp_path / "good.py").write_text(SCRIPT)
    made = "import dlo_casadi as dlo\nrope = dlo.Cable(length=1, mass=1, diameter=0.1)\n"
    (tmp_path / "wrong.py").write_text(made + "\n".join(MISTAKES))
    cache = request.config.cache.mkdir("mypy")  # 20 s, with it 5 s
    options = ["--strict", "--follow-imports=silent", "--ignore-missing-imports", "--config-file="]
    ran = subprocess.run(
        [sys.executable, "-m", "mypy", *options, f"--cache-dir={cache}", "good.py", "wrong.py"],
        env=os.environ | {"MYPYPATH": str(ROOT)},
        cwd=tmp_path,
        capture_output=True,
        text=True,
    )
    said = [line for line in ran.stdout.splitlines() if ": error: " in line]
    assert [line for line in said if not line.startswith("wrong.py:")] == [], ran.stderr
    for number, (code, error) in enumerate(MISTAKES.items(), start=3):
        assert any(f"wrong.py:{number}: error: " in x and error in x for x in said), (code, said)


@pytest.mark.parametrize("section", SECTIONS)
def test_a_constructor_has_a_short_signature_and_help(section):
    """Every argument is explained."""
    shown = str(inspect.signature(section))
    assert len(shown) < 1000
    assert "dlo_casadi" not in shown
    rows = [line.split(" :")[0] for line in inspect.getdoc(section).splitlines()]
    explained = {name.strip() for row in rows for name in row.split(",")}
    assert inspect.signature(section).parameters.keys() <= explained


def test_completion_shows_what_is_ours():
    session = dlo.Session(
        ROPE,
        [dlo.Pose((0, 0), (0.5, 0.1), points=LINE)],
        gravity=(0, -9.81),
        boundary=("pinned", "pinned"),
    )
    clip = dlo.Clip(kind="pinned", at=0.1, place=(0, 0))
    wall = dlo.Obstacle(kind="plane", point=(0, 0), normal=(0, 1))
    theirs = {name for name in dir(pydantic.BaseModel) if not name.startswith("__")}
    for one in (ROPE, clip, wall, session.experiment.poses[0], session, session.model):
        assert set(dir(one)) & theirs == set()


def test_arrays_matrices_and_rotations_are_numbers():
    turned = Rotation.from_euler("z", 90, degrees=True)
    pose = dlo.Pose(
        ca.DM([0, 0, 0.1]),
        np.array([0.5, 0, 0]),
        start_orientation=turned,
        end_orientation=np.array([0.0, 0, 0, 1]),
        clips=[dlo.Clip(kind="clamped", at=0.2, place=ca.DM([0, 0, 0]), orientation=turned)],
        points=ca.DM(np.eye(3)),
        at=ca.DM([0.0, 0.1, 0.2]),
    )
    assert pose.start == (0.0, 0.0, 0.1)
    assert pose.start_orientation == pytest.approx((0, 0, np.sqrt(0.5), np.sqrt(0.5)))
    assert pose.clips[0].orientation == pose.start_orientation
    assert pose.points[1] == (0.0, 1.0, 0.0)
    assert pose.at == (0.0, 0.1, 0.2)


def test_several_rotations_are_no_orientation():
    several = Rotation.random(2, rng=np.random.default_rng(0))
    with pytest.raises(dlo.ConfigError, match=r"start_orientation: a quaternion .* belongs here"):
        dlo.Pose((0, 0, 0), start_orientation=several)


def test_a_copy_with_a_word_of_nobody_is_refused():
    with pytest.raises(dlo.DloError, match=r"Cable has no 'lenght'; did you mean 'length'\?"):
        ROPE.changed(lenght=3.0)
