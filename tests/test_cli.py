"""The commands: what they print, write and return."""

import io
import json
import os
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console

from dlo_casadi.cli import main
from dlo_casadi.cli.common import Watch, plain_numbers
from dlo_casadi.config import dump_yaml, read_yaml

ROOT = Path(__file__).parents[1]
SESSION = ROOT / "tests" / "data" / "bench" / "short_clean" / "session.yaml"


@pytest.fixture(scope="module")
def config(tmp_path_factory):
    """A session of five poses on a coarse mesh, one of them without its file."""
    data = read_yaml(SESSION)
    poses = data["experiment"]["poses"][:5]
    for pose in poses:
        pose["file"] = str(SESSION.parent / pose["file"])
    poses[4]["file"] = "lost.csv"
    data["experiment"]["poses"] = poses
    data["model"] = {"n": 12}
    path = tmp_path_factory.mktemp("config") / "rope.yaml"
    path.write_text(dump_yaml(data))
    return path


@pytest.fixture(scope="module")
def run(config, tmp_path_factory):
    """Folder and printed text of one run of the command as a user starts it."""
    folder = tmp_path_factory.mktemp("run")
    command = [
        sys.executable,
        str(ROOT / "scripts" / "fit.py"),
        str(config),
        "--no-diagnosis",
        "--jobs",
        "1",
    ]
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    return folder, done


def test_fit_writes_results_named_after_the_configuration(run):
    folder, _ = run
    report = json.loads((folder / "results" / "rope" / "report.json").read_text())

    assert report["config"] == "rope"
    assert report["measurement"]["poses_fit"] == 3
    assert report["measurement"]["poses_held_out"] == 1
    assert (folder / "results" / "rope" / "figures" / "poses.png").exists()
    assert [path.name for path in folder.iterdir()] == ["results"]


def test_fit_prints_tables_and_progress_apart(run):
    _, done = run
    text = " ".join(done.stdout.split())

    assert "3 fit poses, 1 held out" in text
    assert "bending_stiffness" in text
    assert "warning: lost" in text
    assert "without imports and writing; of it or beside it Algorithm 1" in text
    assert "Results: results/rope" in text
    assert "read the poses:" in done.stderr
    assert "write the results:" in done.stderr


def test_what_may_take_long_is_told_first(config, monkeypatch, capsys):
    many = config.with_name("many.yaml")
    many.write_text(config.read_text().replace("n: 12", "n: 300"))
    monkeypatch.setattr("dlo_casadi.session.run_session", lambda *_: 1 / 0)

    assert main(["fit", str(many), "--output", str(many.with_name("out")), "--jobs", "1"]) == 1
    assert "warning: model.n: 300 elements take minutes" in capsys.readouterr().err


def test_names_with_the_markup_of_the_terminal_are_shown_as_they_are():
    console = Console(force_terminal=True, record=True, file=io.StringIO())
    with Watch(console) as watch:
        watch.step("read [/b].csv", 0, 1)
        watch.warn(["[/b] is odd"])
    assert "warning: [/b] is odd" in console.export_text()


def test_predict_prints_what_the_file_says(run, capsys):
    folder, _ = run
    results = str(folder / "results" / "rope")
    figure = folder / "results" / "shape.png"

    assert main(["predict", results, "--end", "0.3", "-1e-1", "--figure", str(figure)]) == 0
    text = " ".join(capsys.readouterr().out.split())
    assert "end (0.3, -0.1) m" in text
    assert "smallest bend radius" in text
    assert "stable yes" in text
    assert figure.stat().st_size > 10_000


def test_predict_prints_json(run, capsys):
    folder, _ = run
    path = str(folder / "results" / "rope" / "parameters.yaml")

    assert main(["predict", path, "--end", "-0.2", "-.1", "--branch", "cw", "--json"]) == 0
    shape = json.loads(capsys.readouterr().out)
    assert shape["end"] == [-0.2, -0.1]
    assert np.array(shape["points"]).shape == (101, 2)
    weight = np.array(shape["force_on_start"]) + shape["force_on_end"]
    assert weight == pytest.approx([0.0, -0.2 * 9.81], abs=1e-6)


def test_predict_out_of_reach_is_bad_input(run, capsys):
    folder, _ = run

    assert main(["predict", str(folder / "results" / "rope"), "--end", "9", "0"]) == 2
    said = capsys.readouterr()
    assert "EquilibriumError" in said.err
    assert "9.0002 m from the start" in said.err
    assert "Traceback" not in said.err
    assert said.out == ""


def test_predict_names_the_kinds_of_figure(run, tmp_path, capsys):
    folder, _ = run
    arguments = [str(folder / "results" / "rope"), "--end", "0.3", "0", "--figure"]

    assert main(["predict", *arguments, str(tmp_path / "shape.gif")]) == 2
    assert "must end in .png, .pdf, .svg, .jpg" in capsys.readouterr().err
    assert main(["predict", *arguments, str(tmp_path / "no" / "shape.png")]) == 2
    assert f"there is no folder {tmp_path / 'no'}.\n  Try: mkdir" in capsys.readouterr().err


def test_fit_reports_bad_input_without_a_traceback(tmp_path, capsys):
    bad = tmp_path / "bad.yaml"
    bad.write_text(SESSION.read_text().replace("length: 0.55", "length: -0.55"))

    assert main(["fit", str(bad), "--output", str(tmp_path / "out")]) == 2
    said = capsys.readouterr()
    assert "ConfigError" in said.err
    assert "bad.yaml, line 1" in said.err
    assert "Traceback" not in said.err
    assert not (tmp_path / "out").exists()


def test_fit_reports_a_missing_configuration(tmp_path, capsys):
    assert main(["fit", str(tmp_path / "cable.yaml")]) == 2
    assert "no such file" in capsys.readouterr().err


def test_a_folder_for_a_configuration_names_those_in_it(tmp_path, capsys):
    (tmp_path / "rope.yaml").touch()
    assert main(["fit", str(tmp_path)]) == 2
    said = capsys.readouterr().err
    assert f"a folder is no configuration.\n  Try: {tmp_path / 'rope.yaml'}; all in it" in said


def test_fit_checks_the_output_before_it_works(config, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr("dlo_casadi.session.run_session", lambda *_: pytest.fail("started"))
    (tmp_path / "file").touch()

    command = ["fit", str(config), "--output", str(tmp_path / "file"), "--jobs", "1", "--quiet"]
    assert main(command) == 2
    assert "cannot be written: it is a file" in capsys.readouterr().err


def test_an_interrupted_fit_keeps_the_earlier_results(config, tmp_path, capsys, monkeypatch):
    def interrupted(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr("dlo_casadi.session.run_session", interrupted)
    (tmp_path / "report.json").write_text('{"schema": "dlo-report/1"}')

    assert main(["fit", str(config), "--output", str(tmp_path)]) == 130
    assert capsys.readouterr().err.strip() == "interrupted; earlier results are as they were"
    assert [path.name for path in tmp_path.iterdir()] == ["report.json"]


@pytest.mark.parametrize(
    ("number", "begun"),
    [
        (signal.SIGINT, "read the poses"),
        pytest.param(signal.SIGTERM, "read the poses", marks=pytest.mark.long),
        pytest.param(signal.SIGINT, "fit the declared model", marks=pytest.mark.long),
    ],
)
def test_a_signal_interrupts_a_running_fit(config, tmp_path, number, begun):
    """Also while another process is just being started."""
    (tmp_path / "report.json").write_text('{"schema": "dlo-report/1"}')
    command = [sys.executable, "-u", str(ROOT / "scripts" / "fit.py"), str(config)]
    command += ["--output", str(tmp_path), "--jobs", "2"]
    with subprocess.Popen(
        command, stderr=subprocess.PIPE, text=True, start_new_session=True
    ) as running:
        while not running.stderr.readline().startswith(begun):
            assert running.poll() is None
        os.killpg(running.pid, number)  # as a terminal does
        said = running.stderr.read()
        assert running.wait(timeout=60) == 130

    assert "Traceback" not in said
    assert said.strip().splitlines()[-1] == "interrupted; earlier results are as they were"
    assert [path.name for path in tmp_path.iterdir()] == ["report.json"]


def test_an_interrupt_that_python_swallows_ends_the_run_without_a_traceback(
    config, tmp_path, capsys, monkeypatch
):
    """Python prints and forgets what is raised in a finaliser or in a weak reference's callback."""

    class Finalised:
        def __del__(self):
            signal.raise_signal(signal.SIGINT)

    def swallowed(_, progress, executor):
        Finalised()
        progress.step("read the poses", 0, 1)

    monkeypatch.setattr("dlo_casadi.session.run_session", swallowed)

    assert main(["fit", str(config), "--output", str(tmp_path / "out"), "--jobs", "1"]) == 130
    assert capsys.readouterr().err.strip() == "interrupted; earlier results are as they were"


def test_a_bug_is_told_apart_from_bad_input(config, tmp_path, capsys, monkeypatch):
    def broken(*_):
        raise ZeroDivisionError("oops")

    monkeypatch.setattr("dlo_casadi.session.run_session", broken)

    assert main(["fit", str(config), "--output", str(tmp_path / "out"), "--jobs", "1"]) == 1
    error = capsys.readouterr().err
    assert "ZeroDivisionError: oops" in error
    assert "This is a bug. Please report it" in error
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("jobs", ["0", "-1", "two"])
def test_a_number_of_processes_that_cannot_be_is_refused_at_once(config, tmp_path, capsys, jobs):
    with pytest.raises(SystemExit) as caught:
        main(["fit", str(config), "--output", str(tmp_path / "out"), "--jobs", jobs])
    assert caught.value.code == 2
    assert f"{jobs}: a number of processes, 1 or more" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_unknown_arguments_are_bad_input(capsys):
    with pytest.raises(SystemExit) as caught:
        main(["fit", "configs/cable.yaml", "--outptu", "x"])
    assert caught.value.code == 2
    assert "unrecognized arguments: --outptu x" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("text", "number"),
    [("-1e-1", "-0.1"), ("-5.", "-5"), ("-.5", "-0.5"), ("-2E3", "-2000"), ("--end", "--end")],
)
def test_negative_numbers_are_no_options(text, number):
    assert plain_numbers([text]) == [number]
