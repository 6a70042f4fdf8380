"""`dlo check` and `dlo new` of recordings of the moving cable."""

import json
from pathlib import Path

import numpy as np
import pytest

from dlo_casadi.cli import main
from dlo_casadi.config import load_config
from dlo_casadi.session.checked_motions import check_motions

S = np.array([0.05, 0.3, 0.6])
SESSION = """
cable: {name: rope, length: 0.6, mass: 0.06, diameter: 0.008, bending_stiffness: 0.009}
experiment:
  gravity: [0.0, -9.81]
  boundary: {start: clamped, end: free}
  measurement: {kind: centerlines, std: 0.0004}
  poses:
  - {points: [[0.0, 0.0], [0.0, -0.3], [0.0, -0.6]], start: [0, 0], start_heading: -1.57}
  motions:
  - {file: swing.csv, fixtures: ends.csv, start_heading: -1.57, begins: at_rest}
"""


def carried(t: np.ndarray) -> np.ndarray:
    """A fixture that goes to and fro."""
    return 0.05 * np.sin(6 * np.clip(t - 0.3, 0, None)) ** 2


def session(folder: Path, *, rate: float = 100.0, duration: float = 2.0, late: float = 0.0) -> Path:
    """A session of one motion whose points follow the fixture `late` seconds later."""
    t = np.arange(0, duration, 1 / rate)
    rows = [(x, s, carried(x - late), -s) for x in t for s in S]
    np.savetxt(folder / "swing.csv", rows, delimiter=",", header="t_s,s_m,x_m,y_m", comments="")
    t = np.arange(0, duration + 0.01, 0.005)
    ends = np.stack([t, carried(t), 0 * t], axis=1)
    header = "t_s,start_x_m,start_y_m"
    np.savetxt(folder / "ends.csv", ends, delimiter=",", header=header, comments="")
    (folder / "session.yaml").write_text(SESSION)
    return folder / "session.yaml"


def test_what_a_motion_holds(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = session(tmp_path)
    assert main(["check", str(file), "--json"]) == 0
    (found,) = json.loads(capsys.readouterr().out)["motions"]
    assert (found["instants"], found["points"], found["problem"]) == (200, 3, None)
    assert found["rate"] == pytest.approx(100, rel=1e-6)
    assert found["seen"] == 1
    first, second, third = found["frequencies"]
    assert 0.7 < first < 1.3  # a rope of 0.6 m and some stiffness; a pendulum has 0.98
    assert 2.5 < second < third < 15
    assert not found["warnings"]


@pytest.mark.parametrize(
    ("how", "said"),
    [
        ({"rate": 12}, "12 pictures a second show the first one alone. Try: "),
        ({"duration": 0.7}, "are less than a period: damping hardly shows"),
        ({"late": 0.12}, "moves as the start does, but 0.12 s later: have both files the same"),
        ({"late": -0.12}, "moves as the start does, but 0.12 s earlier"),
    ],
)
def test_what_a_motion_will_not_show(tmp_path: Path, how: dict[str, float], said: str) -> None:
    (found,) = check_motions(load_config(session(tmp_path, **how)))
    (warning,) = found.warnings
    assert said in warning


def test_a_motion_that_cannot_be_read(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = session(tmp_path)
    text = (tmp_path / "swing.csv").read_text().splitlines()
    (tmp_path / "swing.csv").write_text("\n".join([*text[:40], "nan,0.05,0,0", *text[40:]]))
    assert main(["check", str(file)]) == 2
    said = capsys.readouterr()
    assert "mistake: swing: " in said.err
    assert "line 41" in said.err


def test_a_session_to_start_from(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    film = tmp_path / "films" / "swing.mp4"
    film.parent.mkdir()
    film.touch()
    for space in ([], ["--space"]):
        file = tmp_path / f"rope{len(space)}.yaml"
        assert main(["new", str(file), *space, "--motion", str(film)]) == 0
        assert ", 1 motion, 13 places to fill in" in capsys.readouterr().out
        assert "{file: films/swing.mp4, start: FILL_IN, " in file.read_text()
        assert main(["check", str(file)]) == 2
        assert "13 problems" in capsys.readouterr().err
    assert main(["new", str(tmp_path / "x.yaml"), "--motion", str(tmp_path / "no.csv")]) == 2
    assert "no.csv is no file" in capsys.readouterr().err
    assert not (tmp_path / "x.yaml").exists()
