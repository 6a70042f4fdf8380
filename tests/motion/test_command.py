"""`dlo modes` and `dlo simulate`, and a cable with damping as a file."""

import json

import numpy as np
import pytest

import dlo_casadi as dlo
from dlo_casadi.cli import main


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    data = dlo.Cable(length=0.6, mass=0.06, diameter=0.008, bending_stiffness=0.009)
    model = {"n": 8}
    cable = dlo.known_cable(data, gravity=(0, -9.81), boundary=("clamped", "free"), model=model)
    folder = tmp_path_factory.mktemp("rope")
    cable.with_damping(0.02, air_drag=1.1).save(folder)
    rows = [f"{t:.3f},{0.1 * np.sin(3 * t):.6f},0,-1.2" for t in np.linspace(0, 0.5, 26)]
    header = "t_s,start_x_m,start_y_m,start_heading_rad"
    (folder / "ends.csv").write_text("\n".join([header, *rows, ""]))
    return folder


def test_a_saved_cable_keeps_its_damping(folder):
    cable = dlo.load(folder)
    assert cable.params["damping_time"].value == 0.02
    assert cable.params["air_drag.coefficient"].value == 1.1
    assert not cable.metadata.edited


def test_modes_are_told(folder, capsys):
    assert main(["modes", str(folder), "--start-heading", "-1.2", "--count", "2", "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    direct = dlo.load(folder).solve(start_heading=-1.2).modes(2)
    assert found["frequencies"] == pytest.approx(direct.frequencies)


def test_a_simulation_is_written(folder, capsys):
    picture, table = folder / "a.gif", folder / "motion.csv"
    words = ["simulate", str(folder), str(folder / "ends.csv"), "--output", str(table)]
    assert main([*words, "--animate", str(picture)]) == 0
    assert "largest force on its start" in capsys.readouterr().out
    assert picture.read_bytes()[:3] == b"GIF"
    assert table.read_text().startswith("t_s,s_m,x_m,y_m\n0,0,0,0\n")


def test_names_of_pictures_are_checked_first(folder, capsys):
    """Before the table of fixtures is read, or a shape is solved."""
    assert main(["simulate", str(folder), "nowhere.csv", "--animate", "a.mp4"]) == 2
    assert "a.mp4: moving pictures are GIF" in capsys.readouterr().err
    assert main(["modes", str(folder), "--end", "1", "1", "--animate", "a.gif"]) == 2
    assert "Try: a.svg" in capsys.readouterr().err


def test_unknown_columns_are_named(folder, capsys):
    (folder / "wrong.csv").write_text("t_s,start_z_m\n0,1\n1,1\n")
    assert main(["simulate", str(folder), str(folder / "wrong.csv")]) == 2
    assert "start_z_m" in capsys.readouterr().err


def test_a_motion_without_a_swing_is_planned(folder, capsys):
    way, start = folder / "way.csv", "start_heading=-1.2"
    words = ["move", str(folder), "--from", "start=0,0", start, "--to", "start=0.2,0", start]
    assert main([*words, "--duration", "1.1", "--output", str(way), "--json"]) == 0
    swings = json.loads(capsys.readouterr().out)["swings"]
    assert swings["planned"] < 0.01 * swings["minimum jerk"]
    assert way.read_text().startswith("t_s,start_x_m,start_y_m,start_heading_rad\n0,0,0,-1.2\n")
    assert main([*words, "--duration", "1.1", "--limits", "force=0.1"]) == 2
    assert "no motion keeps it" in capsys.readouterr().err
    assert main([*words[:3], "begin=0,0", *words[4:]]) == 2
    assert "nothing is held by 'begin'" in capsys.readouterr().err
