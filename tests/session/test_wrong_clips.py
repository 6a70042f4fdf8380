"""Mistakes about clips that measured lines give away."""

import numpy as np
import pytest
import yaml

from dlo_casadi.cli import main
from dlo_casadi.config import load_config
from dlo_casadi.session import plausibility
from dlo_casadi.session.clips import wrong_clips
from dlo_casadi.session.measure import read_inputs
from dlo_casadi.session.plausibility import find_suspicions

LENGTH = 1.0
S = np.linspace(0.0, LENGTH, 41)


def line(bend):
    """Points (41, 2) [m] of an S-shaped cable."""
    heading = bend * np.cos(2 * np.pi * S)
    steps = np.stack([np.cos(heading), np.sin(heading)], axis=1)
    middles = (steps[1:] + steps[:-1]) / 2 * np.diff(S)[:, None]
    return np.vstack([[0.0, 0.0], middles.cumsum(axis=0)])


BENDS = (1.0, 1.15, 1.3, 1.45)


@pytest.fixture
def without_fits(monkeypatch):
    """Leave out the questions after those about clips: they fit lines, and these do not balance."""
    (at,) = (k for k, asked in enumerate(plausibility.QUESTIONS) if (wrong_clips,) in asked)
    monkeypatch.setattr(plausibility, "QUESTIONS", plausibility.QUESTIONS[: at + 1])


def session(folder, change=lambda clips, k: clips):
    """Suspicions of a session whose clips are at 0.3 m and 0.7 m, changed."""
    poses = []
    for k, bend in enumerate(BENDS):
        points = line(bend)
        clips = [
            {"name": "first", "kind": "pinned", "at": 0.3, "place": points[12].tolist()},
            {
                "name": "saddle",
                "kind": "clamped",
                "at": 0.7,
                "place": points[28].tolist(),
                "heading": float(bend * np.cos(2 * np.pi * 0.7)),
            },
        ]
        rows = "\n".join(f"{x!r},{y!r}" for x, y in points[1:-1].tolist())
        (folder / f"pose_{k}.csv").write_text(f"x_m,y_m\n{rows}\n")
        end = points[-1].tolist()
        pose = {"file": f"pose_{k}.csv", "start": [0, 0], "end": end, "clips": change(clips, k)}
        poses.append(pose)
    text = f"""\
cable: {{name: loom, length: 1.0, mass: 0.05, diameter: 0.005, bending_stiffness: 0.01}}
experiment:
  gravity: [0, -9.81]
  boundary: {{start: pinned, end: pinned}}
  measurement: {{kind: centerlines, std: 3.0e-4}}
  poses: {poses}
"""
    (folder / "session.yaml").write_text(text)
    config = load_config(folder / "session.yaml")
    found = find_suspicions(config, read_inputs(config))
    return [item for item in found if "first" in item.message or "saddle" in item.message]


def changed(which, **values):
    return lambda clips, k: [{**c, **(values if i == which else {})} for i, c in enumerate(clips)]


def test_clips_as_they_are(tmp_path):
    assert session(tmp_path) == []


@pytest.mark.usefixtures("without_fits")
def test_places_in_another_frame(tmp_path):
    (found,) = session(tmp_path, changed(0, place=[0.1, -0.2]))
    assert found.certain
    assert "from the measured lines (median). Try: its places" in found.message


@pytest.mark.usefixtures("without_fits")
def test_one_place_that_is_off(tmp_path):
    other = changed(0, place=[0.2, 0.0])
    (found,) = session(tmp_path, lambda clips, k: other(clips, k) if k == 2 else clips)
    assert found.pose == "pose_2"
    assert "m from the measured line" in found.message


@pytest.mark.usefixtures("without_fits")
def test_an_arc_length_from_the_other_end(tmp_path):
    (found,) = session(tmp_path, changed(0, at=0.255))
    assert "m behind its arc length" in found.message


@pytest.mark.usefixtures("without_fits")
def test_a_pinned_clip_through_which_the_cable_slides(tmp_path):
    def slid(clips, k):
        place = line(BENDS[k])[12 + 2 * k].tolist()
        return changed(0, place=place)(clips, k)

    (found,) = session(tmp_path, slid)
    assert "kind: eyelet, if it slides" in found.message


@pytest.mark.usefixtures("without_fits")
def test_a_clamp_that_turns(tmp_path):
    (found,) = session(tmp_path, changed(1, heading=1.5))
    assert "kind: pinned if it turns" in found.message


@pytest.mark.usefixtures("without_fits")
def test_clips_in_another_order(tmp_path):
    def swapped(clips, k):
        places = (line(BENDS[k])[22].tolist(), line(BENDS[k])[18].tolist())
        names = ("first", "saddle")
        return [
            {"name": name, "kind": "eyelet", "place": place}
            for name, place in zip(names, places, strict=True)
        ]

    (found,) = session(tmp_path, swapped)
    assert "in the order saddle, first" in found.message


@pytest.mark.parametrize("more", [[], ["--space"]])
def test_a_new_configuration_with_clips(tmp_path, more):
    path = tmp_path / "loom.yaml"
    assert main(["new", str(path), "--clips", "pinned", "eyelet", "clamped", *more]) == 0
    clips = yaml.safe_load(path.read_text())["experiment"]["poses"][0]["clips"]
    assert [clip["kind"] for clip in clips] == ["pinned", "eyelet", "clamped"]
    direction = "orientation" if more else "heading"
    assert list(clips[2]) == ["kind", "at", "place", direction]
