"""Many sessions and many poses: two processes against one, Dask, growth, a million shapes.

Whole commands are timed, their start included. Wall-clock times depend on what else the machine
does; the load average before and after is printed beside them.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from dlo_casadi.config import load_config
from dlo_casadi.fleet import parquet_library
from dlo_casadi.report.documents import parameters_text
from dlo_casadi.session import run_session

ROOT = Path(__file__).resolve().parents[2]
BENCH = ROOT / "tests" / "data" / "bench"
NAMES = ("short_clean", "held_headings", "thin")


def run() -> dict[str, Any]:
    """All parts, each in a folder of its own."""
    with tempfile.TemporaryDirectory(prefix="dlo_fleet_") as name:
        folder = Path(name)
        out: dict[str, Any] = {"load_before": os.getloadavg()}
        for part in (million, two_against_one, growth):
            out[part.__name__] = part(folder / part.__name__)
            print(part.__name__, out[part.__name__], flush=True)
        out["load_after"] = os.getloadavg()
    return out


def two_against_one(folder: Path, count: int = 24) -> dict[str, Any]:
    """The same sessions by one process, by two, and by two Dask workers on this machine."""
    write_sessions(folder / "cables", count, poses=6, every=4, n=12)
    tables = {}
    out: dict[str, Any] = {"sessions": count}
    for name, options in (("one", ["--jobs", "1"]), ("two", ["--jobs", "2"])):
        out[name], tables[name] = fit_many(folder, name, options)
    with Dask() as scheduler:
        out["dask"], tables["dask"] = fit_many(folder, "dask", ["--scheduler", scheduler])
    out["same_tables"] = tables["one"] == tables["two"] == tables["dask"]
    out["speedup"] = out["one"]["seconds"] / out["two"]["seconds"]
    out["speedup_of_the_chain"] = out["one"]["chain_seconds"] / out["two"]["chain_seconds"]
    out["dask_overhead"] = out["dask"]["seconds"] / out["two"]["seconds"] - 1
    return out


def growth(folder: Path, counts: Sequence[int] = (10, 30, 100, 300)) -> dict[str, Any]:
    """Cost of more and more small sessions, and how far it is from a straight line."""
    rows = []
    for count in counts:
        write_sessions(folder / f"{count}" / "cables", count, poses=3, every=6, n=10)
        rows.append(fit_many(folder / f"{count}", "out", ["--jobs", "2"])[0])
    out: dict[str, Any] = {"sessions": list(counts)}
    for what in ("seconds", "cpu_seconds"):
        cost = np.array([row[what] for row in rows])
        # Relative distances count: each size has the same weight.
        system = np.column_stack([np.ones(len(counts)), counts]) / cost[:, None]
        line, *_ = np.linalg.lstsq(system, np.ones(len(counts)), rcond=None)
        out[what] = cost.round(2).tolist()
        out[f"{what}_start_and_each"] = line.round(3).tolist()
        out[f"{what}_off_the_line"] = float(np.abs(1 / (system @ line) - 1).max())
    return out


def million(folder: Path, side: int = 1000) -> dict[str, Any]:
    """A million shapes of 20 arcs by two processes, with the memory of all of them."""
    folder.mkdir()
    config = load_config(write_sessions(folder / "cables", 1, poses=3, every=6, n=20)[0])
    (folder / "parameters.yaml").write_text(parameters_text(run_session(config)))
    reach = 0.98 * config.cable.length / np.sqrt(2)
    grid = [-reach, reach, side, -reach, reach, side]
    output = folder / "shapes.parquet"
    command = ["shape_table.py", str(folder), "--grid", *map(str, grid), "--elements", "20"]
    command += ["--element", "arc"]
    timed = measured([*command, "--output", str(output), "--jobs", "2"])
    _, pq = parquet_library()
    statuses = pq.read_table(output, columns=["status"])["status"].value_counts().to_pylist()
    size = output.stat().st_size / 1e6
    return {
        **timed,
        "poses": side * side,
        "statuses": {row["values"]: row["counts"] for row in statuses},
        "file_mb": round(size, 1),
    }


def write_sessions(folder: Path, count: int, poses: int, every: int, n: int) -> list[Path]:
    """Write centre-line sessions of a few poses; one of so many points is kept."""
    files = []
    for k in range(count):
        name = NAMES[k % len(NAMES)]
        document = yaml.safe_load((BENCH / name / "session.yaml").read_text())
        kept = document["experiment"]["poses"][:poses]
        document["experiment"]["poses"] = kept
        document["model"] = {"n": n}
        document["experiment"]["measurement"]["std"] = 3e-4
        document["estimation"] = {"algorithm1": False}
        document["diagnosis"] = {"enabled": False}
        own = folder / f"{k:04d}"
        own.mkdir(parents=True)
        for pose in kept:
            head, *lines = (BENCH / name / pose["file"]).read_text().splitlines()
            (own / pose["file"]).write_text("\n".join([head, *lines[k % every :: every]]) + "\n")
        files.append(own / "session.yaml")
        files[-1].write_text(yaml.safe_dump(document))
    return files


def fit_many(folder: Path, name: str, options: Sequence[str]) -> tuple[dict[str, float], Any]:
    """Time the command; return its cost and the rows, columns of time aside."""
    output = folder / name
    command = ["fit_many.py", str(folder / "cables"), "--output", str(output), "--no-reports"]
    cost = measured([*command, *options])
    _, pq = parquet_library()
    table = pq.read_table(output / "table.parquet")
    kept = [column for column in table.column_names if not column.startswith("time_")]
    return cost, table.select(kept).to_pylist()


def measured(command: Sequence[str]) -> dict[str, float]:
    """Run a script; wall-clock and processor times [s], peak memory of all its processes [MB].

    Memory is the proportional set size: pages that processes share are counted once. The chain
    is the processor time of the first process and of the busiest of its workers: with one core
    for each, about what the command would take, whatever else the machine does now.
    """
    begin = time.perf_counter()
    script, *arguments = command
    process = subprocess.Popen(
        [sys.executable, str(ROOT / "scripts" / script), *arguments, "--quiet"]
    )
    peak, over, workers = [0.0], threading.Event(), dict[int, float]()

    def watch() -> None:
        while not over.wait(0.1):
            below = children(process.pid)
            peak[0] = max(peak[0], sum(map(memory_of, [process.pid, *below])))
            workers.update({pid: max(processor_of(pid), workers.get(pid, 0.0)) for pid in below})

    thread = threading.Thread(target=watch)
    thread.start()
    _, status, usage = os.wait4(process.pid, 0)
    seconds = time.perf_counter() - begin
    over.set()
    thread.join()
    process.returncode = os.waitstatus_to_exitcode(status)
    if process.returncode:
        raise RuntimeError(f"{script} ended with {process.returncode}")
    total = usage.ru_utime + usage.ru_stime
    own = total - sum(workers.values())
    return {
        "seconds": round(seconds, 2),
        "cpu_seconds": round(total, 2),
        "chain_seconds": round(own + max(workers.values(), default=0.0), 2),
        "peak_mb": round(peak[0], 1),
    }


def processor_of(pid: int) -> float:
    """Processor time of a process [s]."""
    try:
        fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    except OSError:
        return 0.0
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def children(pid: int) -> list[int]:
    """Processes below a process."""
    try:
        text = Path(f"/proc/{pid}/task/{pid}/children").read_text()
    except OSError:
        return []
    below = [int(word) for word in text.split()]
    return below + [deeper for child in below for deeper in children(child)]


def memory_of(pid: int) -> float:
    """Proportional set size of a process [MB]."""
    try:
        for line in Path(f"/proc/{pid}/smaps_rollup").read_text().splitlines():
            if line.startswith("Pss:"):
                return int(line.split()[1]) / 1024
    except OSError:
        pass
    return 0.0


class Dask:
    """A scheduler and two workers on this machine, by Dask's own command."""

    def __enter__(self) -> str:
        self._folder = tempfile.TemporaryDirectory(prefix="dlo_dask_")
        self._file = Path(self._folder.name) / "scheduler.json"
        file = ["--scheduler-file", str(self._file)]
        scheduler = ["scheduler", "--host", "127.0.0.1", "--port", "0", "--no-dashboard", *file]
        worker = ["worker", "--nworkers", "2", "--nthreads", "1", "--no-dashboard", *file]
        self._processes = [self._start(scheduler), self._start(worker)]
        from distributed import Client

        deadline = time.monotonic() + 60
        while not self._file.exists() and time.monotonic() < deadline:
            time.sleep(0.1)
        with Client(scheduler_file=str(self._file)) as client:
            client.wait_for_workers(2, timeout=60)
            return str(client.scheduler.address)

    def _start(self, arguments: Sequence[str]) -> subprocess.Popen[bytes]:
        return subprocess.Popen(
            [sys.executable, "-m", "dask", *arguments],
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            cwd=self._folder.name,
        )

    def __exit__(self, *_: object) -> None:
        for process in reversed(self._processes):
            process.terminate()
            process.wait()
        self._folder.cleanup()
