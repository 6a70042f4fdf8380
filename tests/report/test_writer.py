"""The folder of results is complete or untouched."""

import json
import os
import time

import numpy as np
import pytest
from files import tree
from small_sessions import BENCH

from dlo_casadi.errors import DloError, OutputError
from dlo_casadi.io.files import write_file
from dlo_casadi.io.points import read_points
from dlo_casadi.report import writer
from dlo_casadi.report.page import GENERATOR
from dlo_casadi.report.sections import report_text
from dlo_casadi.report.writer import OWNED, ResultsFolder
from dlo_casadi.runtime.parallel import open_executor


@pytest.fixture
def earlier(tmp_path):
    """Results of an earlier run, the page of one that failed, and a note of the user's."""
    folder = tmp_path / "results"
    (folder / "centerlines").mkdir(parents=True)
    (folder / "figures").mkdir()
    (folder / "report.json").write_text('{"schema": "dlo-report/1"}')
    (folder / "parameters.yaml").write_text("schema: dlo-parameters/1\n")
    (folder / "centerlines" / "old_pose.csv").write_text("x_m,y_m\n0,0\n1,0\n")
    (folder / "failed.html").write_text(f"<!DOCTYPE html>{GENERATOR}")
    (folder / "notes.txt").write_text("mine")
    return folder


def test_a_run_writes_its_files_and_nothing_else(outcome, quick, tmp_path):
    target = tmp_path / "new" / "results"
    with ResultsFolder(target) as folder:
        folder.write(outcome)

    assert {path.name for path in target.iterdir()} == set(OWNED)
    assert [path.name for path in target.parent.iterdir()] == ["results"]
    assert json.loads((target / "report.json").read_text())["schema"] == "dlo-report/1"
    assert len(list((target / "centerlines").iterdir())) == 12


def test_centre_lines_are_written_as_measured(outcome, quick, tmp_path):
    with ResultsFolder(tmp_path / "results") as folder:
        folder.write(outcome)
    written = read_points(tmp_path / "results" / "centerlines" / "pose_01.csv", (0.0, 0.0)).points
    given = read_points(BENCH / "short_clean" / "pose_01.csv", (0.0, 0.0)).points

    assert np.array_equal(written, given)


def test_earlier_results_are_replaced_and_other_files_kept(outcome, quick, earlier):
    with ResultsFolder(earlier) as folder:
        folder.write(outcome)

    assert not (earlier / "centerlines" / "old_pose.csv").exists()
    assert (earlier / "notes.txt").read_text() == "mine"
    assert {path.name for path in earlier.iterdir()} == {*OWNED, "notes.txt"}
    assert "versions" in json.loads((earlier / "report.json").read_text())


def test_results_of_another_configuration_are_known(earlier, outcome):
    config = outcome.config
    other = config.noted(path=config.path.with_name("other.yaml"))
    assert ResultsFolder(earlier, other).of_another is None
    (earlier / "report.json").write_text(report_text(outcome))

    assert ResultsFolder(earlier, config).of_another is None
    roundabout = config.noted(path=config.path.parent / "inner" / ".." / config.path.name)
    assert ResultsFolder(earlier, roundabout).of_another is None
    assert ResultsFolder(earlier, other).of_another == str(config.path)
    assert ResultsFolder(earlier / "empty", other).of_another is None


@pytest.mark.parametrize("error", [KeyboardInterrupt, ValueError])
def test_a_run_that_stops_before_writing_leaves_no_trace(earlier, error):
    before = tree(earlier)
    with pytest.raises(error), ResultsFolder(earlier):
        raise error

    assert tree(earlier) == before
    assert [path.name for path in earlier.parent.iterdir()] == ["results"]


@pytest.mark.parametrize(
    ("error", "step"), [(KeyboardInterrupt, "write_figures"), (ValueError, "parameters_text")]
)
def test_a_run_that_stops_while_writing_leaves_no_trace(
    outcome, quick, monkeypatch, earlier, error, step
):
    def stop(*_):
        raise error

    monkeypatch.setattr(writer, step, stop)
    before = tree(earlier)
    with pytest.raises(error), ResultsFolder(earlier) as folder:
        folder.write(outcome)

    assert tree(earlier) == before


@pytest.fixture(scope="module")
def two():
    """Where the other half is drawn: one more process."""
    with open_executor(2, here=True) as executor:
        yield executor


def broken(folder, outcome):
    raise ZeroDivisionError("no range")


def full(folder, outcome):
    time.sleep(0.3)
    raise OutputError("no space", folder)


def interrupted(folder, outcome):
    raise KeyboardInterrupt


@pytest.mark.parametrize(
    ("here", "there", "error", "kept"),
    [
        (broken, None, ZeroDivisionError, False),
        (None, broken, ZeroDivisionError, False),
        (broken, full, OutputError, True),
        (full, broken, OutputError, True),
    ],
)
def test_halves_that_fail(outcome, monkeypatch, earlier, two, here, there, error, kept):
    """In two processes: the numbers stay where they can, and what the user has to see is raised."""
    monkeypatch.setattr(writer, "draw_each", here or nothing)
    monkeypatch.setattr(writer, "draw_summary", there or nothing)
    before = tree(earlier)
    with pytest.raises(error), ResultsFolder(earlier) as folder:
        folder.write(outcome, two)
    assert (tree(earlier) == before) == kept
    assert not list(earlier.glob(".*"))


def test_a_half_that_is_interrupted(outcome, monkeypatch, earlier):
    """While the other half is at work in a process that ends before the folder does."""
    monkeypatch.setattr(writer, "draw_each", interrupted)
    monkeypatch.setattr(writer, "draw_summary", full)
    before = tree(earlier)
    with (
        pytest.raises(KeyboardInterrupt),
        ResultsFolder(earlier) as folder,
        open_executor(2, here=True) as executor,
    ):
        folder.write(outcome, executor)
    assert tree(earlier) == before
    assert not list(earlier.glob(".*"))


def nothing(folder, outcome):
    pass


def test_two_processes_draw_what_one_draws(outcome, written, two, tmp_path):
    with ResultsFolder(tmp_path / "two") as folder:
        folder.write(outcome, two)
    one, _ = written
    assert tree(one) == tree(tmp_path / "two")


def test_a_disk_that_is_full_leaves_the_earlier_results(outcome, monkeypatch, earlier):
    """Also where the numbers still had room: without their figures they replace nothing."""

    def full(*_):
        raise OSError(28, "No space left on device")

    def draw(folder, outcome, executor):
        monkeypatch.setattr(os, "fsync", full)
        write_file(folder / "report.html", "")

    monkeypatch.setattr(writer, "draw", draw)
    before = tree(earlier)
    with (
        pytest.raises(OutputError, match=r"cannot be written: No space left on device.\n  Try:"),
        ResultsFolder(earlier, outcome.config) as folder,
    ):
        folder.write(outcome)

    assert tree(earlier) == before


def test_a_file_in_the_way_is_reported_before_the_run(tmp_path):
    (tmp_path / "results").write_text("a file")
    with (
        pytest.raises(DloError, match=r"results cannot be written: it is a file.\n  Try: another"),
        ResultsFolder(tmp_path / "results"),
    ):
        pass


def test_files_of_the_same_names_from_elsewhere_are_not_replaced(tmp_path):
    (tmp_path / "centerlines").mkdir()
    (tmp_path / "centerlines" / "mine.csv").write_text("x_m,y_m\n")
    with (
        pytest.raises(DloError, match="holds centerlines from elsewhere, which would be replaced"),
        ResultsFolder(tmp_path),
    ):
        pass


def test_a_chart_that_cannot_be_drawn_does_not_lose_the_numbers(
    outcome, quick, earlier, monkeypatch
):
    def broken(outcome, drawn):
        raise ZeroDivisionError("no range")

    monkeypatch.setattr(writer, "report_page", broken)
    with pytest.raises(ZeroDivisionError) as caught, ResultsFolder(earlier) as folder:
        folder.write(outcome)

    assert caught.value.__notes__ == [f"All but the drawings is in {earlier}."]
    assert json.loads((earlier / "report.json").read_text())["stages"]
    assert "dlo-parameters/1" in (earlier / "parameters.yaml").read_text()
    assert not (earlier / "report.html").exists()
    assert not list(earlier.glob(".*"))
