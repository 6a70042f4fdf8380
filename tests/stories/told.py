"""What a story does with a session, always by the command `dlo`: fit, predict, compile the C."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
from contextlib import redirect_stdout
from functools import cached_property
from io import StringIO
from pathlib import Path

import numpy as np
import yaml

from dlo_casadi.cli import main

HERE = Path(__file__).parent
DATA = HERE / "data"
NOISE = 3e-4  # m, of a coordinate, in all stories
TENTHS = slice(None, None, 10)  # of the 101 points of a prediction
KEYS = ("start", "end", "start_heading", "end_heading", "start_orientation", "end_orientation")
WRITTEN = ("report.html", "report.json", "parameters.yaml", "centerlines", "figures")


def dlo(*words: object, code: int = 0) -> str:
    """What a command prints; its exit code must be as said."""
    said = StringIO()
    with redirect_stdout(said):
        assert main([str(word) for word in words]) == code, words
    return said.getvalue()


def files_of(folder: Path) -> tuple[Path, Path]:
    """Configuration and truth in a folder."""
    return folder / "session.yaml", folder / "truth.yaml"


class Story:
    """A session that was fitted, with what is true of it."""

    def __init__(self, session: Path, truth: Path, results: Path) -> None:
        self.results = results
        self.session, self.truth = (yaml.safe_load(path.read_text()) for path in (session, truth))

    @classmethod
    def fitted(cls, name: str, results: Path) -> Story:
        """Fit a session of the data."""
        session, truth = files_of(DATA / name)
        dlo("fit", session, "--output", results, "--jobs", 1, "--quiet")
        return cls(session, truth, results)

    @cached_property
    def report(self) -> dict:
        """The file report.json."""
        return json.loads((self.results / "report.json").read_text())

    @property
    def last(self) -> dict:
        """The last stage."""
        return self.report["stages"][-1]

    @property
    def effects(self) -> list[str]:
        """Names of what was found."""
        return [effect["name"] for effect in self.report["effects"]]

    def check(
        self,
        verdict: str,
        noise: float = NOISE,
        widest: float = 0.5,
        held_out: float = 1.5,
        **labels: str,
    ) -> None:
        """Verdict, files, intervals that hold the truth, errors of the size of the noise.

        `labels` are the parameters of the last stage by their names in truth.yaml. Without a
        profile the interval is three standard deviations. None is wider than `widest` of the truth:
        1.4 times what is found, so that a derivative that is wrong by a factor shows.
        `held_out` is the largest error of poses that are held out, over the noise.
        """
        assert self.report["schema"] == "dlo-report/1"
        assert self.report["verdict"] == verdict, self.report["structure"]
        assert all((self.results / name).exists() for name in WRITTEN)
        page = (self.results / "report.html").read_text()
        assert verdict.replace("_", " ") in page.lower()
        self._check_candidates()
        assert all(effect in page for effect in self.effects)
        stiffnesses = {x: x for x in ("bending_stiffness", "torsional_stiffness")}
        for key, label in (stiffnesses | labels).items():
            if key not in self.truth["parameters"]:
                continue
            found, true = self.last["parameters"][label], self.truth["parameters"][key]
            low, high = found["interval_95"] or (
                found["value"] + sign * 3 * found["std"] for sign in (-1, 1)
            )
            assert low < true < high, (label, found, true)
            assert high - low < widest * abs(true), f"{label} is hardly known: {found}"
        written = yaml.safe_load((self.results / "parameters.yaml").read_text())
        for label, row in written["parameters"].items():
            if label in self.last["parameters"]:
                assert row["value"] == self.last["parameters"][label]["value"]
        # A line's points are compared across it, markers in all directions.
        first = (self.results / "centerlines").glob("*.csv")
        columns = next(first).read_text().splitlines()[0].split(",")
        marked = len(columns) - len(self.session["experiment"]["gravity"])
        noise *= np.sqrt(len(columns) - 1) if marked else 1.0
        assert 0.6 * noise < self.last["rmse_fit"] < 1.2 * noise
        assert 0.5 * noise < self.last["rmse_held_out"] < held_out * noise
        assert self.report["repeatability"]["held_out_inside_90"] > 0.7

    def _check_candidates(self) -> None:
        """Every refit that is not chosen says why; some candidate is tried."""
        found, candidates = self.report["effects"], self.report["candidates"]
        chosen = {x for row in found for x in (row["name"], *row["indistinguishable_from"])}
        lost = {row["name"] for row in candidates if row["reason"]}
        refitted = {row["name"] for row in candidates if row["rmse_cross_validated"] is not None}
        assert candidates
        assert refitted <= chosen | lost
        assert not chosen & lost

    def line(self, name: str) -> np.ndarray:
        """Points (K, d) [m] of a pose's centre-line, as they were written."""
        return np.loadtxt(self.results / "centerlines" / f"{name}.csv", delimiter=",", skiprows=1)

    def pose(self, name: str) -> dict:
        """What the configuration says of a pose."""
        poses = self.session["experiment"]["poses"]
        return next(pose for pose in poses if pose["file"].startswith(name))

    def predicted(self, name: str, *options: object, within: float = 2 * NOISE) -> dict:
        """A pose by `dlo predict`, from the written results, its points near the exact ones."""
        words = []
        for key in KEYS:
            if key in self.pose(name):
                values = np.atleast_1d(self.pose(name)[key]).tolist()
                words += [f"--{key.replace('_', '-')}", *values]
        found = json.loads(dlo("predict", self.results, *words, *options, "--json", "--quiet"))
        assert found["status"] == "stable"
        points = np.array(self.truth["poses"][name]["points"])
        off = np.linalg.norm(found["points"][TENTHS] - points, axis=1)
        assert off.max() < within, f"{1e3 * off.max():.2f} mm off"
        return found

    def in_c(
        self, name: str, folder: Path, *options: object, obstacles: str = "", flag: str = "-O0"
    ) -> dict:
        """A pose by the generated C, which a C program of its own compiles and calls.

        Its derivative of the end's force, or of the last point, is that of two more solves.
        """
        dlo("generate-solver", self.results, "--output", folder, *options, "--quiet")
        held = self.pose(name)
        given = [
            f".{key} = {_braced(held[key])}"
            for key in KEYS
            if key in held and not (key == "end" and held[key] is None)
        ]
        if clips := held.get("clips"):
            rows = ", ".join(
                f"{{.at = {clip.get('at', 0.0)}, .place = {_braced(clip['place'])}}}"
                for clip in clips
            )
            given.append(f".clips = {{{rows}}}")
        shutil.copy(HERE / "main.c", folder)
        command = [
            os.environ.get("CC", "cc"),
            "-std=c99",
            "-O0",
            flag,
            "-Wall",
            "-Wextra",
            "-Werror",
        ]
        command += [f"-DPOSE={', '.join(given)}", f"-DAMONG={obstacles}"]
        command += ["main.c", "dlo_solver.c", "-lm", "-o", "main"]
        subprocess.run(command, cwd=folder, check=True)
        ran = subprocess.run(["./main"], cwd=folder, check=True, capture_output=True, text=True)
        found = json.loads(ran.stdout)
        for slope, quotient in zip(found["slope"], found["quotient"], strict=True):
            assert abs(slope - quotient) < 1e-4 * (1.0 + np.abs(found["slope"]).max())
        return found


def _braced(values: float | list[float]) -> str:
    """Numbers as C initialises them."""
    if isinstance(values, list):
        return "{" + ", ".join(map(repr, values)) + "}"
    return repr(values)


def same(in_c: dict, predicted: dict, rel: float = 1e-6) -> None:
    """The generated C and Python's prediction: points of both meshes at the ends, forces, energy.

    Points inside are compared where a node of the solver is one of the 101 points.
    """
    points, every = np.array(predicted["points"]), np.array(in_c["points"])
    places = np.array(in_c["places"]) * 100
    shared = np.isclose(places, np.round(places), atol=1e-9)
    assert shared.sum() >= 3
    own = points[np.round(places[shared]).astype(int)]
    assert np.abs(every[shared] - own).max() < rel * predicted["length"]
    pairs = {"start_force": "force_on_start", "end_force": "force_on_end", "energy": "energy"}
    scale = np.abs(predicted["force_on_start"]).max()
    for key, name in pairs.items():
        assert np.allclose(in_c[key], predicted[name], rtol=rel, atol=rel * scale), key
    for k, side in enumerate(("start", "end")):
        moment = np.atleast_1d(predicted[f"moment_on_{side}"])
        assert np.allclose(in_c["moments"][k], moment, rtol=1e-5, atol=1e-6 * scale)
    assert np.isclose(in_c["min_bend_radius"], predicted["min_bend_radius"], rtol=0.02)
