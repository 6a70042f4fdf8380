"""What the commands write: any name of a file, and disks that are full."""

import json
import os
import resource
import subprocess
import sys
from io import BytesIO, TextIOWrapper
from pathlib import Path

import pytest

from dlo_casadi.cli import main
from dlo_casadi.config import dump_yaml, load_config, read_yaml

BENCH = Path(__file__).parent / "data" / "bench" / "short_clean"
# A name that is no UTF-8: Latin-1, as old archives and cameras write it.
CAFE = os.fsdecode(b"caf\xe9")
READABLE = "caf\\udce9"


def write_session(folder):
    """Three poses of a bench session, in files of such names; return its YAML file."""
    data = read_yaml(BENCH / "session.yaml")
    poses = [pose for pose in data["experiment"]["poses"] if pose["role"] == "fit"][:3]
    for pose in poses:
        head, *lines = (BENCH / pose["file"]).read_text().splitlines()
        pose["file"] = f"{CAFE}_{pose['file']}"
        (folder / pose["file"]).write_text("\n".join([head, *lines[::6]]) + "\n")
    data["cable"]["name"] = "100$ \\frac{cable}$ */ ??/"
    data["experiment"]["poses"] = poses
    data["experiment"]["measurement"]["std"] = 3e-4
    data["model"] = {"n": 10}
    data["estimation"] = {"algorithm1": False, "rest_curvature_coefficients": 4}
    data["diagnosis"] = {"enabled": False}
    path = folder / f"{CAFE}.yaml"
    path.write_text(dump_yaml(data))
    return path


@pytest.fixture(scope="module")
def session(tmp_path_factory):
    return write_session(tmp_path_factory.mktemp(CAFE))


@pytest.fixture(scope="module")
def results(session):
    command = ["fit", str(session), "--output", str(session.parent / CAFE), "--quiet"]
    assert main([*command, "--jobs", "1"]) == 0
    return session.parent / CAFE


def test_results_of_files_of_any_name_are_utf_8(results, session):
    report = json.loads((results / "report.json").read_text())
    assert report["config"] == READABLE
    assert READABLE in (results / "report.html").read_text()
    assert read_yaml(results / "parameters.yaml")["schema"] == "dlo-parameters/1"
    lines = sorted((results / "centerlines").iterdir())
    assert [line.name for line in lines] == [
        f"{pose.name}.csv" for pose in load_config(session).experiment.poses
    ]
    assert all(READABLE in line.name for line in lines)
    assert (results / "figures" / "poses.png").stat().st_size > 0


def test_a_name_that_cannot_be_printed_is_escaped(session, monkeypatch, capsys):
    for arguments in ([session], [session, "--json"], [f"{session}x"]):
        stream = TextIOWrapper(BytesIO(), encoding="utf-8")  # as a terminal, strict
        monkeypatch.setattr(sys, "stdout", stream)
        code = main(["check", *map(str, arguments)])
        monkeypatch.undo()
        text = stream.buffer.getvalue().decode() + capsys.readouterr().err
        assert code == (2 if f"{session}x" in arguments else 0)
        assert READABLE in text.replace("\\\\", "\\")  # in JSON a backslash is two


def test_a_new_configuration_finds_the_files_of_any_name(tmp_path):
    names = [
        CAFE,
        "line\nbreak",
        "quote'\"",
        "back\\slash",
        "#: {x}",
        "\u202e",
        "\U0001f600",
        "1²2",
    ]
    for name in names:
        (tmp_path / f"{name}.csv").write_text("x_m,y_m\n0,0\n1,0\n")
    config = tmp_path / "it's.yaml"
    assert main(["new", str(config), "--centerlines", str(tmp_path), "--quiet"]) == 0
    data = read_yaml(config)
    assert data["cable"]["name"] == "it's"
    found = {pose["file"] for pose in data["experiment"]["poses"]}
    assert found == {f"{name}.csv" for name in names}


def test_a_failed_fit_with_such_a_name_leaves_its_page(session, tmp_path, capsys):
    config = tmp_path / f"{CAFE}.yaml"
    data = read_yaml(session)
    for pose in data["experiment"]["poses"]:
        (tmp_path / pose["file"]).write_text("x_m,y_m\n0,0\n")
    config.write_text(dump_yaml(data))
    assert (
        main(["fit", str(config), "--output", str(tmp_path / "out"), "--quiet", "--jobs", "1"]) == 2
    )
    assert f"{READABLE}_pose_01" in (tmp_path / "out" / "failed.html").read_text()
    assert "Traceback" not in capsys.readouterr().err


def test_a_fleet_of_such_names_has_its_table(session, tmp_path):
    parquet = pytest.importorskip("pyarrow.parquet")
    (session.parent / f"{CAFE}_broken.yaml").write_text("cable: {}\n")
    output = tmp_path / "fleet"
    pattern = str(session.parent / "*.yaml")
    command = ["fit-many", pattern, "--no-diagnosis", "--quiet", "--output", str(output)]
    assert main(command) == 2  # the broken one
    rows = parquet.read_table(output / "table.parquet").to_pylist()
    assert {row["session"]: row["status"] for row in rows} == {
        f"{READABLE}.yaml": "done",
        f"{READABLE}_broken.yaml": "failed",
    }
    page = (output / "index.html").read_text()
    assert page.count("href=") == 1
    linked = output / "sessions" / f"{READABLE}.yaml" / "report.html"
    assert linked.is_file()


# ---- full disks --------------------------------------------------------------------------------

COMMANDS = {
    "new": "new {out}/rope.yaml",
    "figure": "predict {results} --end 0.3 -0.1 --figure {out}/shape.png",
    "solver": "generate-solver {results} --output {out}",
    "fit": "fit {session} --output {out}/new",
    "table": "shape-table {results} --grid -0.3 0.3 9 -0.3 0.3 9 --output {out}/a.parquet",
    "fleet": "fit-many {session} --no-diagnosis --output {out}",
}
# By which a table and a fleet are gone on with.
STATE = (
    ".lock",
    "identity.json",
    "a.parquet.parts",
    "logs",
    "rows",
    "sessions",
    "source.txt",
    f"{READABLE}.yaml",
)


@pytest.mark.parametrize("command", COMMANDS.values(), ids=COMMANDS)
def test_a_full_disk_is_told_and_leaves_what_was_there(command, results, session, tmp_path, capsys):
    """A limit to the size of a file is what the system grants without a disk of its own."""
    if "table" in command or "many" in command:
        pytest.importorskip("pyarrow")
    (tmp_path / "mine.txt").write_text("mine")
    words = command.format(out=tmp_path, results=results, session=session).split()
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (500, limits[1]))
    try:
        code = main(words)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    said = capsys.readouterr().err
    assert code == 2
    assert "cannot be written: File too large.\n  Try:" in said
    assert "Traceback" not in said
    assert "draft" not in said
    left = {path.name for path in tmp_path.rglob("*")}
    assert left - set(STATE) == {"mine.txt"}
    assert (tmp_path / "mine.txt").read_text() == "mine"


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no /dev/full")
@pytest.mark.parametrize("word", ["schema", "--version"])  # more than a buffer holds, and less
def test_output_that_cannot_be_printed_is_told(word):
    program = f"import sys; from dlo_casadi.cli import main; sys.exit(main([{word!r}]))"
    with open("/dev/full", "w") as full:
        run = subprocess.run([sys.executable, "-c", program], stdout=full, stderr=subprocess.PIPE)
    text = run.stderr.decode()
    assert text == "OutputError: the output cannot be written: No space left on device\n"
    assert run.returncode == 2


@pytest.mark.parametrize(
    "command",
    [
        "check {long}",
        "fit {session} --output {long}",
        "fit-many {long}",
        "predict {long} --end 0 0",
        "new {long}.yaml",
    ],
)
def test_a_name_longer_than_the_system_permits_is_told_at_once(
    command, session, tmp_path, capsys, monkeypatch
):
    monkeypatch.setattr("dlo_casadi.session.run_session", lambda *_: pytest.fail("started"))
    words = command.format(long=tmp_path / ("a" * 300), session=session).split()
    assert main(words) == 2
    assert "Traceback" not in capsys.readouterr().err
