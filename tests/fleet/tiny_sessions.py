"""Sessions of three poses on a coarse mesh, half a second each; all files have the same names."""

from pathlib import Path

import yaml

from dlo_casadi.fleet.run import Options

QUICK = Options(diagnosis=False, reports=False)
BENCH = Path(__file__).parents[1] / "data" / "bench"
NAMES = ("short_clean", "held_headings", "thin")
POINTS = 6  # one of so many is kept


def write_session(folder, name="short_clean", length_factor=1.0):
    """Write a session of the first poses of a bench session; return its YAML file."""
    folder.mkdir(parents=True)
    document = yaml.safe_load((BENCH / name / "session.yaml").read_text())
    document["cable"]["length"] *= length_factor
    poses = [pose for pose in document["experiment"]["poses"] if pose["role"] == "fit"][:3]
    document["experiment"]["poses"] = poses
    document["experiment"]["measurement"]["std"] = 3e-4
    document["model"] = {"n": 10}
    document["estimation"] = {"algorithm1": False, "rest_curvature_coefficients": 4}
    document["diagnosis"] = {"enabled": False}
    for pose in poses:
        head, *lines = (BENCH / name / pose["file"]).read_text().splitlines()
        (folder / pose["file"]).write_text("\n".join([head, *lines[::POINTS]]) + "\n")
    path = folder / "session.yaml"
    path.write_text(yaml.safe_dump(document))
    return path


def write_fleet(folder):
    """Write three sessions that run and one that cannot; all configurations have one name."""
    for k, name in enumerate(NAMES):
        write_session(folder / f"shed_{k % 2}" / name, name)
    broken = folder / "<b>broken" / "session.yaml"
    broken.parent.mkdir()
    broken.write_text("cable: {name: broken, lenght: 1}\nexperiment: {}\n")


def without_times(table):
    """Rows of a table, columns of time aside."""
    kept = [name for name in table.column_names if not name.startswith("time_")]
    return table.select(kept).to_pylist()
