"""`dlo watch`: poses that arrive, broken files, and processes that are killed."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from test_tracker import HEADINGS, STD, pose, rope

import dlo_casadi as dlo
from dlo_casadi.cli import main


@pytest.fixture
def results(tmp_path) -> Path:
    """A cable that is uncertain, saved."""
    return rope().tracker(STD).cable.save(tmp_path / "results").parent


def write(folder: Path, k: int, one: dlo.Pose) -> None:
    folder.mkdir(exist_ok=True)
    data = {"points": np.asarray(one.points).tolist(), "at": list(one.at), "start": [0, 0]}
    data["start_heading"] = one.start_heading
    (folder / f"pose_{k:02d}.json").write_text(json.dumps(data))


def poses(count: int, load: float = 0.01) -> list[dlo.Pose]:
    return [pose(rope(load=load), float(HEADINGS[k % 8]), k) for k in range(count)]


def lines_of(results: Path) -> list[dict]:
    return [json.loads(x) for x in (results / "watch/poses.jsonl").read_text().splitlines()]


def watch(results: Path, source: Path, *options: str) -> int:
    return main(["watch", str(results), str(source), "--std", str(STD), "--once", *options])


def test_a_folder_is_tracked_as_by_the_tracker(results, tmp_path, capsys) -> None:
    listed, tracker = poses(5), rope().tracker(STD)
    for k, one in enumerate(listed):
        write(tmp_path / "poses", k, one)
        tracker.update(one)
    assert watch(results, tmp_path / "poses", "--json") == 0
    printed = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    assert [one["pose"] for one in printed] == [f"pose_{k:02d}" for k in range(5)]
    found = printed[-1]["parameters"]["bending_stiffness"]
    known = tracker.params["bending_stiffness"]
    assert (found["value"], found["std"]) == pytest.approx((known.value, known.std), rel=1e-9)
    assert watch(results, tmp_path / "poses") == 0
    assert "going on after 5 poses" in capsys.readouterr().out
    assert len(lines_of(results)) == 5
    assert "as it was fitted" in (results / "watch/watch.html").read_text()
    again = dlo.load(results / "watch").params["bending_stiffness"]
    assert again.value == pytest.approx(known.value, rel=1e-9)


def test_broken_files_are_named_and_skipped(results, tmp_path, capsys) -> None:
    folder, (one, two) = tmp_path / "poses", poses(2)
    write(folder, 1, one)
    write(folder, 4, two)
    (folder / "pose_02.json").write_text('{"points": [[0.1, 0')
    (folder / "pose_03.json").write_text('{"point": [[0.1, 0.2]]}')
    (folder / ".draft.json").write_text("{")
    assert watch(results, folder) == 0
    out = capsys.readouterr().out
    assert "pose_02: skipped: " in out
    assert "pose_03: skipped: " in out
    assert "point" in out.split("pose_03")[1]
    assert [line["number"] for line in lines_of(results) if not line["problem"]] == [1, 2]


def test_a_table_that_grows(results, tmp_path, capsys) -> None:
    source, listed = tmp_path / "poses.csv", poses(4)
    rows = ["pose,s_m,x_m,y_m,start_x_m,start_y_m,start_heading_rad"]
    for k, one in enumerate(listed):
        for s, (x, y) in zip(one.at, np.asarray(one.points), strict=True):
            rows.append(f"p{k},{s},{x},{y},0,0,{one.start_heading}")
    source.write_text("\n".join([*rows[:17], "p1,x,0,0,0,0,0"]) + "\n")
    assert watch(results, source) == 0
    assert "p1: skipped: " in capsys.readouterr().out
    source.write_text("\n".join([*rows[:17], "p1,x,0,0,0,0,0", *rows[17:]]) + "\n")
    assert watch(results, source) == 0
    assert [line["pose"] for line in lines_of(results)] == ["p0", "p1", "p2", "p3"]
    tracker = rope().tracker(STD)
    for k in (0, 2, 3):
        tracker.update(listed[k])
    found = dlo.load(results / "watch").params["lumped_mass.mass"].value
    assert found == pytest.approx(tracker.params["lumped_mass.mass"].value, rel=1e-9)


def test_a_table_without_poses_leaves_nothing(results, tmp_path, capsys) -> None:
    for text, said in (("", "it is empty"), ("s_m,x_m,y_m\n0.1,0,0\n", "found s_m, x_m, y_m")):
        (tmp_path / "poses.csv").write_text(text)
        assert watch(results, tmp_path / "poses.csv") == 2
        assert f"the column pose is missing, {said}" in capsys.readouterr().err
        assert not (results / "watch/poses.jsonl").exists()


def test_other_sources_and_unknown_noise_are_refused(results, tmp_path, capsys) -> None:
    write(tmp_path / "poses", 0, poses(1)[0])
    assert main(["watch", str(results), str(tmp_path / "poses"), "--once"]) == 2
    assert "--std" in capsys.readouterr().err
    assert watch(results, tmp_path / "nowhere") == 2
    assert "nowhere" in capsys.readouterr().err
    assert watch(results, tmp_path / "poses") == 0
    (tmp_path / "others").mkdir()
    assert watch(results, tmp_path / "others") == 2
    assert "does not belong to this" in capsys.readouterr().err
    assert watch(results, tmp_path / "others", "--again") == 0


def test_a_change_is_told_once_and_resumed(results, tmp_path) -> None:
    """In two halves as in one: the weight falls off in the second."""
    listed = [*poses(8), *poses(6, load=0.0)]
    folder = tmp_path / "poses"
    for k, one in enumerate(listed):
        write(folder, k, one)
        if k in (6, 9):
            assert watch(results, folder) == 0
    assert watch(results, folder) == 0
    halves = lines_of(results)
    assert watch(results, folder, "--into", str(tmp_path / "whole")) == 0
    text = (tmp_path / "whole/poses.jsonl").read_text()
    whole = [json.loads(line) for line in text.splitlines()]
    for one, other in zip(halves, whole, strict=True):
        assert one["pose"] == other["pose"]
        assert bool(one["change"]) == bool(other["change"])
        assert one["rms"] == pytest.approx(other["rms"], rel=1e-6)
    assert any(one["change"] for one in whole)
    assert "it has changed" in (tmp_path / "whole/watch.html").read_text()


@pytest.mark.skipif(os.name == "nt", reason="there is no kill -9")
def test_a_killed_process_goes_on_where_it_was(results, tmp_path) -> None:
    folder = tmp_path / "poses"
    for k, one in enumerate(poses(9)):
        write(folder, k, one)
    program = "import sys; from dlo_casadi.cli import main; main(sys.argv[1:])"
    command = [sys.executable, "-c", program, "watch", str(results), str(folder)]
    running = subprocess.Popen([*command, "--std", str(STD)], stdout=subprocess.DEVNULL)
    log = results / "watch/poses.jsonl"
    until = time.monotonic() + 60
    while time.monotonic() < until and (not log.exists() or log.read_bytes().count(b"\n") < 4):
        time.sleep(0.005)
    running.send_signal(signal.SIGKILL)
    running.wait()
    with log.open("ab") as stream:
        stream.write(b'{"pose": "half')  # the line that was being written
    write(folder, 9, poses(10)[9])
    assert watch(results, folder) == 0
    assert [line["pose"] for line in lines_of(results)] == [f"pose_{k:02d}" for k in range(10)]
    tracker = rope().tracker(STD)
    for one in poses(10):
        tracker.update(one)
    found = dlo.load(results / "watch").params["bending_stiffness"].value
    assert found == pytest.approx(tracker.params["bending_stiffness"].value, rel=1e-6)
