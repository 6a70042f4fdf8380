"""One row per session, whatever happens on the way."""

import json
import multiprocessing
import os
import shutil
import signal
import subprocess
import sys
import time
from dataclasses import astuple
from itertools import product
from pathlib import Path

import pytest

pytest.importorskip("pyarrow", reason="tables need pyarrow: pip install 'dlo-casadi[table]'")

import pyarrow.parquet as pq
from tiny_sessions import QUICK, without_times, write_fleet

from dlo_casadi.cli import main
from dlo_casadi.errors import DloError, OutputError
from dlo_casadi.fleet.rows import (
    COLUMNS,
    empty_row,
    judge,
    last_error,
    overview_html,
    robust_z,
    row_of,
)
from dlo_casadi.fleet.run import Options, digest_of, find_sessions, fit_fleet
from dlo_casadi.io.files import only_run
from dlo_casadi.runtime.executors import InProcess
from dlo_casadi.runtime.parallel import open_executor

SCRIPT = Path(__file__).parents[2] / "scripts" / "fit_many.py"
KEYS = [
    "<b>broken/session.yaml",
    "shed_0/short_clean/session.yaml",
    "shed_0/thin/session.yaml",
    "shed_1/held_headings/session.yaml",
]


def rows_of(output):
    return without_times(pq.read_table(output / "table.parquet"))


def test_one_row_each_sorted_and_a_failure_is_a_row_with_its_message(expected):
    assert [row["session"] for row in expected] == KEYS
    broken, *others = expected
    assert broken["status"] == "failed"
    assert "lenght" in broken["message"]
    assert broken["bending_stiffness"] is None
    for row in others:
        assert row["status"] == "done"
        assert row["bending_stiffness"] > 0
        assert row["batch_rmse_fit"] < row["initial_rmse_fit"]
        assert row["poses_fit"] == 3
        assert [item["name"] for item in row["parameters"]] == ["bending_stiffness"]


@pytest.fixture(scope="module")
def with_reports(fleet, tmp_path_factory):
    """Folder of the results of one session, fitted by the command with a pattern."""
    output = tmp_path_factory.mktemp("with_reports")
    pattern = str(fleet / "shed_1" / "*" / "session.yaml")
    assert main(["fit-many", pattern, "--output", str(output), "--quiet"]) == 0
    return output


def test_numbers_are_those_of_the_report_and_results_are_linked(with_reports, expected):
    (row,) = rows_of(with_reports)
    assert row["session"] == "session.yaml"
    report = json.loads((with_reports / "sessions" / "session.yaml" / "report.json").read_text())
    last = report["stages"][-1]
    assert row["bending_stiffness"] == last["parameters"]["bending_stiffness"]["value"]
    assert row["bending_stiffness"] == expected[-1]["bending_stiffness"]
    assert row["batch_rmse_fit"] == last["rmse_fit"]
    assert 'href="sessions/session.yaml/report.' in (with_reports / "index.html").read_text()


def test_a_session_without_results_is_told_by_the_exit_code(tmp_path, capsys):
    (tmp_path / "cables").mkdir()
    (tmp_path / "cables/broken.yaml").write_text("cable: {lenght: 1.0}\nexperiment: {}\n")
    command = ["fit-many", str(tmp_path / "cables"), "--output", str(tmp_path / "out"), "--json"]
    for _ in range(2):  # fitted, then taken over
        assert main([*command, "--quiet"]) == 2
        (row,) = json.loads(capsys.readouterr().out)
        assert row["status"] == "failed"


def test_results_of_another_folder_are_not_replaced_in_silence(tmp_path, capsys):
    one, other = folders = [tmp_path / name / "cables" for name in "ab"]
    for folder in folders:
        folder.mkdir(parents=True)
        (folder / "broken.yaml").write_text("cable: {lenght: 1.0}\nexperiment: {}\n")
    for folder, warned in ((one, False), (one, False), (other, True), (other, False)):
        main(["fit-many", str(folder), "--output", str(tmp_path / "out")])
        said = f"out holds results of {one}, which this run replaces. Try: --output DIR"
        assert (said in capsys.readouterr().err) is warned


def test_a_bug_names_a_log_only_where_there_is_one(fleet, tmp_path, monkeypatch):
    monkeypatch.setattr("dlo_casadi.fleet.run.load_config", lambda _: 1 / 0)
    (row, *_) = fit_fleet(find_sessions(fleet)[1], tmp_path, InProcess(), QUICK)
    assert row["message"] == "a bug: ZeroDivisionError: division by zero"


@pytest.mark.long
def test_a_killed_worker_of_the_pool_changes_nothing(fleet, expected, tmp_path):
    killed = []

    def kill_one(tally):
        if not killed:
            killed.append(multiprocessing.active_children()[0].pid)
            os.kill(killed[0], signal.SIGKILL)

    sessions = find_sessions(fleet)[1]
    (tmp_path / "logs").mkdir()
    with open_executor(jobs=2, logs=tmp_path / "logs") as executor:
        fit_fleet(sessions, tmp_path, executor, QUICK, progress=kill_one)
    assert rows_of(tmp_path) == expected
    assert len(list((tmp_path / "logs").glob("worker-*.log"))) > 2, "no worker was replaced"


def test_a_killed_run_goes_on_and_repeats_nothing(fleet, expected, tmp_path):
    command = [sys.executable, str(SCRIPT), str(fleet), "--quiet"]
    command += ["--output", str(tmp_path), "--jobs", "2", "--no-diagnosis", "--no-reports"]
    finished = tmp_path / "rows"
    deadline = time.monotonic() + 120
    with subprocess.Popen(command) as run:
        try:
            while len(list(finished.glob("*.json"))) < 2 and run.poll() is None:
                assert time.monotonic() < deadline, "no two rows within two minutes"
                time.sleep(0.01)
        finally:
            run.kill()
    before = {path.name: path.stat().st_mtime_ns for path in finished.glob("*.json")}
    assert 2 <= len(before) <= 4

    told = []
    fit_fleet(
        find_sessions(fleet)[1],
        tmp_path,
        InProcess(),
        QUICK,
        begin=lambda taken_over, left: told.append((taken_over, left)),
    )
    after = {path.name: path.stat().st_mtime_ns for path in finished.glob("*.json")}
    # A worker may have finished one more row before it noticed that its parent was gone.
    assert len(before) <= told[0][0]
    assert sum(told[0]) == len(KEYS)
    assert before.items() <= after.items()
    assert len(after) == len(KEYS)
    assert rows_of(tmp_path) == expected


def test_only_what_has_changed_is_fitted_again(tmp_path):
    source, output = tmp_path / "cables", tmp_path / "out"
    write_fleet(source)
    for name in ("shed_0", "<b>broken"):
        shutil.rmtree(source / name)
    shutil.copytree(source / "shed_1", source / "copy")
    told = []

    def fit(**options):
        fit_fleet(
            find_sessions(source)[1],
            output,
            InProcess(),
            QUICK,
            begin=lambda taken_over, left: told.append((taken_over, left)),
            **options,
        )
        return rows_of(output)

    first = fit()
    assert first[0] | {"session": ""} == first[1] | {"session": ""}, "equal data, equal rows"
    assert fit() == first
    data = sorted((source / "copy").rglob("*.csv"))[0]
    data.write_text("\n".join(data.read_text().splitlines()[:-1]) + "\n")
    second = fit()
    assert told == [(0, 2), (2, 0), (1, 1)]
    assert second[1] == first[1]
    assert second[0]["points"] == first[0]["points"] - 1


def test_two_runs_do_not_write_to_one_folder(fleet, tmp_path):
    sessions = find_sessions(fleet)[1]
    with only_run(tmp_path), pytest.raises(DloError, match="another run is writing"):
        fit_fleet(sessions, tmp_path, InProcess(), QUICK)


def test_each_photograph_of_a_pose_decides_the_results(tmp_path):
    config = tmp_path / "session.yaml"
    config.write_text(
        "experiment: {poses: [{file: a.csv}, {files: [b.jpg, c.jpg]}, {role: fit}]}\n"
    )
    (session,) = find_sessions(config)[1].values()
    digests = {digest_of(session, ())}
    for name in ("a.csv", "b.jpg", "c.jpg"):
        (tmp_path / name).write_text("changed")
        digests.add(digest_of(session, ()))
    assert len(digests) == 4


def test_options_decide_the_results(tmp_path):
    (tmp_path / "session.yaml").write_text("experiment: {poses: []}\n")
    every = [astuple(Options(*item)) for item in product((True, False), repeat=2)]
    assert len({digest_of(tmp_path / "session.yaml", options) for options in every}) == 4


def test_failed_sessions_are_taken_over_unless_they_are_to_be_tried_again(tmp_path):
    (tmp_path / "broken.yaml").write_text("cable: {lenght: 1.0}\nexperiment: {}\n")
    sessions, told = find_sessions(tmp_path)[1], []
    for retry in (False, False, True):
        fit_fleet(
            sessions,
            tmp_path / "out",
            InProcess(),
            QUICK,
            retry_failed=retry,
            begin=lambda taken_over, left: told.append((taken_over, left)),
        )
    assert told == [(0, 1), (1, 0), (0, 1)]


def test_a_session_whose_results_cannot_be_written_is_lost_and_tried_again(tmp_path, monkeypatch):
    (tmp_path / "broken.yaml").write_text("cable: {lenght: 1.0}\nexperiment: {}\n")
    sessions, told = find_sessions(tmp_path)[1], []

    def full(*_):
        raise OutputError("no space", tmp_path)

    for status in ("lost", "failed"):
        with monkeypatch.context() as patched:
            if status == "lost":
                patched.setattr("dlo_casadi.fleet.run._fitted", full)
            (row,) = fit_fleet(
                sessions,
                tmp_path / "out",
                InProcess(),
                QUICK,
                begin=lambda taken_over, left: told.append((taken_over, left)),
            )
        assert row["status"] == status
        assert rows_of(tmp_path / "out")[0]["message"] == row["message"]
    assert told == [(0, 1), (0, 1)]


def test_results_and_hidden_folders_are_no_sessions(tmp_path):
    write_fleet(tmp_path / "cables")
    hidden = tmp_path / "cables" / ".old"
    hidden.mkdir()
    (hidden / "session.yaml").write_text("cable: {}\nexperiment: {}\n")
    (tmp_path / "cables" / "parameters.yaml").write_text("schema: dlo-parameters/1\ncable: {}\n")
    (tmp_path / "cables" / "notes.yaml").write_text("shed: north\n")
    base, sessions = find_sessions(tmp_path / "cables")
    assert list(sessions) == KEYS
    assert base == (tmp_path / "cables").resolve()
    with pytest.raises(DloError, match="no configuration in"):
        find_sessions(tmp_path / "nowhere")


def test_a_cable_in_space_has_columns_of_its_own(with_reports):
    """A planar report with what one in space has instead."""
    (plane,) = rows_of(with_reports)
    report = json.loads((with_reports / "sessions" / "session.yaml" / "report.json").read_text())
    found = report["stages"][-1]["parameters"]
    found["torsional_stiffness"] = {**found["bending_stiffness"], "value": 0.2, "std": 0.1}
    about = found["rest_curvature"]
    double = {key: [2 * value for value in about[key]] for key in ("value", "std")}
    found["rest_curvature"] = {"s": about["s"], "k_y": about, "k_z": double}
    report["unexplained"] = {"force": [1.0, 2.0, 3.0], "position": 0.1}

    row = row_of(plane["session"], "hash", "loom", report, 1.0)
    assert row.keys() == COLUMNS.keys()
    assert plane["torsional_stiffness"] is None
    assert (row["torsional_stiffness"], row["torsional_stiffness_std"]) == (0.2, 0.1)
    assert [row[f"unexplained_force_{axis}"] for axis in "xyz"] == [1.0, 2.0, 3.0]
    for name in ("rest_curvature", "rest_curvature_std"):
        assert row[name] == plane[name]
    assert plane["rest_curvature_z"] == []
    assert row["rest_curvature_z"] == double["value"]
    assert row["rest_curvature_z_std"] == double["std"]


def fake(key, stiffness, error=1e-3, verdict="complete"):
    row = empty_row(key, "hash", "done", "", 1.0)
    return row | {
        "verdict": verdict,
        "bending_stiffness": stiffness,
        "batch_rmse_fit": error,
        "identifiable": True,
        "bending_stiffness_low_95": 0.9 * stiffness,
        "bending_stiffness_high_95": 1.1 * stiffness,
    }


def test_robust_z_of_a_normal_sample_is_its_distance_in_standard_deviations():
    # Nine quantiles of a normal distribution with standard deviation 2 about 5, and one outlier.
    quantiles = [-1.2816, -0.8416, -0.5244, -0.2533, 0.0, 0.2533, 0.5244, 0.8416, 1.2816]
    scores = robust_z([5 + 2 * q for q in quantiles] + [None])
    # The median absolute deviation of nine quantiles is 0.5244, of the distribution 0.6745.
    assert scores[:-1] == pytest.approx([0.6745 / 0.5244 * q for q in quantiles], abs=1e-9)
    assert scores[-1] is None
    assert robust_z([1.0, 2.0, 3.0, 4.0]) == [None] * 4


def test_the_odd_ones_come_first():
    rows = [fake(f"plain_{k}", 0.3 * 1.02**k) for k in range(7)]
    rows += [fake("stiff", 3.0), fake("pulled", 0.31, verdict="unexplained")]
    rows += [fake("poor", 0.3, error=0.1), empty_row("gone", "hash", "lost", "killed", 0.0)]
    judged = judge(rows)
    assert [item.row["session"] for item in judged[:2]] == ["gone", "pulled"]
    assert {item.row["session"] for item in judged[2:4]} == {"stiff", "poor"}
    reasons = {item.row["session"]: item.reasons for item in judged}
    assert reasons["stiff"] == ("stiffer",)
    assert reasons["poor"] == ("larger error",)
    assert all(not reasons[f"plain_{k}"] for k in range(7))


def test_the_error_of_held_out_poses_is_not_replaced_by_another():
    """One of them has no prediction with the effects that were found."""
    row = fake("one", 0.3) | {"batch_rmse_held_out": 2e-3, "poses_held_out": 2}
    assert last_error(row) == 2e-3
    closed = {"closed_chi2_per_dof": 1.0, "closed_rmse_fit": 1e-4}
    assert last_error(row | closed) is None
    assert last_error(row | closed | {"closed_rmse_held_out": 3e-3}) == 3e-3
    assert last_error(row | closed | {"poses_held_out": 0}) == 1e-4


def test_a_session_without_a_diagnosis_is_not_called_complete(tmp_path):
    page = overview_html([fake("plain", 0.3, verdict=None)], tmp_path)
    assert "<p>1 not diagnosed. 0 to look at first.</p>" in page
    assert '<td class="text">not diagnosed</td>' in page


def test_the_page_is_escaped_and_asks_for_nothing(tmp_path):
    row = fake("<script>alert(1)</script>", 0.3)
    failed = empty_row('a"b&c', "hash", "failed", "<img src=x onerror=y>", 0.0)
    page = overview_html([row, failed], tmp_path)
    assert "<script" not in page
    assert "<img" not in page
    assert "&lt;script&gt;" in page
    assert "http" not in page
    folder = tmp_path / "sessions" / row["session"]
    folder.mkdir(parents=True)
    (folder / "report.html").touch()
    page = overview_html([row], tmp_path)
    assert 'href="sessions/%3Cscript%3Ealert%281%29%3C/script%3E/report.html"' in page
    assert "href" not in overview_html([row], None), "results of an earlier run, with reports"
