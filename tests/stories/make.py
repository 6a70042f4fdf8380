"""Writes the sessions of the stories and their truths: python tests/stories/make.py [NAME ...].

SIMULATED: rods of rods.py with noise, seeds as here. A truth.yaml holds the rod's parameters and,
for the held-out poses, exact points at tenths of the length, forces and moments.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import yaml
from rods import GRAVITY, Held, Lying, Mass, Pin, Rod
from scipy.spatial.transform import Rotation

from dlo_casadi.effects import EFFECTS

FOLDER = Path(__file__).parent / "data"
NOISE = 3e-4  # m
TENTHS = np.linspace(0.0, 1.0, 11)
SIDES = ("start", "end")


def numbers(values, digits=6):
    """Rounded numbers as YAML takes them."""
    return np.round(np.asarray(values, float), digits).tolist()


def exact(shape, **more):
    """What is true of a shape that is held out."""
    told = {"points": shape.at(TENTHS * shape.rod.length), "moments": shape.moments}
    told |= {"start_force": shape.start_force, "end_force": shape.end_force, **more}
    return {key: numbers(value, 7) for key, value in told.items()}


class Writer:
    """One session while it is written, pose by pose."""

    def __init__(self, name, seed, cable, experiment, options, *, count, markers=False) -> None:
        self.name, self.random = name, np.random.default_rng(seed)
        self.cable, self.experiment, self.options = cable, experiment, options
        self.count, self.markers = count, markers
        self.poses, self.truth = [], {}

    def add(self, shape, held, role="fit", **true):
        """Measure a shape; keys of its pose."""
        name, length = f"pose_{len(self.poses) + 1:02d}", shape.rod.length
        free = self.experiment["boundary"]["end"] == "free"
        s = np.linspace(0.03, 1.0 if free else 0.97, self.count) * length
        points = shape.at(s) + self.random.normal(scale=NOISE, size=(len(s), shape.rod.dimension))
        columns = [*"xyz"[: points.shape[1]]]
        if self.markers:
            points, columns = np.column_stack([s, points]), ["s", *columns]
        rows = [",".join(f"{column}_m" for column in columns)]
        rows += [",".join(f"{x:.5f}" for x in row) for row in points]
        folder = FOLDER / self.name
        folder.mkdir(parents=True, exist_ok=True)
        (folder / f"{name}.csv").write_text("\n".join(rows) + "\n")
        self.poses.append({"file": f"{name}.csv", **held, "role": role})
        if role == "held_out":
            self.truth[name] = exact(shape, **true)

    def reading(self, values, std):
        """A reading with its noise."""
        return numbers(values + self.random.normal(scale=std, size=np.shape(values)))

    def write(self, **truth):
        """The configuration, and what is true."""
        experiment = self.experiment | {"poses": self.poses}
        session = {"cable": {"name": self.name, **self.cable}, "experiment": experiment}
        for file, content in {
            "session": session | self.options,
            "truth": {"parameters": truth, "poses": self.truth},
        }.items():
            text = yaml.safe_dump(content, sort_keys=False, default_flow_style=None, width=100)
            (FOLDER / self.name / f"{file}.yaml").write_text(text)


def lines(boundary, gravity=(0.0, -GRAVITY), **more):
    """An experiment whose measurements are files."""
    held = {"gravity": list(gravity), "boundary": dict(zip(SIDES, boundary, strict=True))}
    return {**held, "measurement": {"kind": "centerlines", "std": NOISE}, **more}


def quick(n, *among):
    """Options of a fit that takes seconds: few elements, few candidates to try."""
    options = {"model": {"n": n}, "estimation": {"algorithm1": False}}
    return options | {"diagnosis": {"exclude": sorted({*EFFECTS} - {*among})}}


# Candidates of every complete cable.
COMMON = ("length_error", "lumped_mass", "rest_curvature_drift", "stiffness_gradient")
# Of the cables in the plane [m].
ENDS = (
    *((0.5, 0.1), (0.62, -0.05), (0.4, -0.2), (0.55, 0.25)),
    *((0.3, -0.35), (0.66, 0.12), (0.45, 0.0), (0.58, -0.2)),
)


def weight():
    """A cable between two pins that carries something nobody declared."""
    mass, place, length = 0.015, 0.31, 0.8
    rod = Rod(length, 0.06 * GRAVITY / length, 0.02)
    cable = {"length": length, "mass": 0.06, "diameter": 0.006, "bending_stiffness": 0.05}
    cable["rest_shape"] = "straight"
    options = quick(12, "lumped_mass", "point_force", "gravity_tilt")
    session = Writer("weight", 1, cable, lines(("pinned", "pinned")), options, count=25)
    for k, end in enumerate(ENDS):
        shape = rod.solve(Held((0.0, 0.0)), Held(end), [Mass(mass)], [place])
        held = {"start": [0.0, 0.0], "end": list(end)}
        session.add(shape, held, "held_out" if k in (2, 6) else "fit")
    session.write(bending_stiffness=rod.bending, mass=mass, position=place)


def tip():
    """A cable clamped at one end, of unknown mass, on a sensor of force and moment."""
    mass, length, std = 0.047, 0.5, (0.005, 0.0005)

    def rest(s):
        return 1.2 * np.cos(np.pi * s / length)

    rod = Rod(length, mass * GRAVITY / length, 0.011, rest=rest)
    cable = {"length": length, "mass": None, "diameter": 0.005, "bending_stiffness": 0.03}
    experiment = lines(("clamped", "free"))
    experiment["measurement"] |= {"force_std": std[0], "moment_std": std[1]}
    options = quick(12, *COMMON, "gravity_tilt", "image_scale", "point_force")
    session = Writer("tip", 7, cable, experiment, options, count=12, markers=True)
    for k, heading in enumerate((0.0, 0.8, -0.5, 1.4, 0.4)):
        shape = rod.solve(Held((0.1, 0.2), heading), None)
        held = {"start": [0.1, 0.2], "start_heading": heading}
        held["start_force"] = session.reading(shape.start_force, std[0])
        held["start_moment"] = session.reading(shape.moments[0, 0], std[1])
        session.add(shape, held, "held_out" if k == 4 else "fit")
    session.write(bending_stiffness=rod.bending, mass=mass)


def grippers():
    """A cable between two grippers in space, with markers and a wrench sensor at its end."""
    length, std, start = 0.6, (0.01, 0.001), np.array([0.2, -0.1, 0.3])

    def rest(s):
        return np.array([1.0 + 0.0 * s, 0.8 * np.cos(np.pi * s / length)])

    rod = Rod(length, 0.03 * GRAVITY / length, 0.015, 0.011, rest=rest)
    cable = {"length": length, "mass": 0.03, "diameter": 0.004, "bending_stiffness": 0.025}
    experiment = lines(("clamped", "clamped"), (0.0, 0.0, -GRAVITY))
    experiment["measurement"] |= {"force_std": std[0], "moment_std": std[1]}
    options = quick(14, *COMMON, "bending_anisotropy", "clamp_rotation")
    session = Writer("grippers", 3, cable, experiment, options, count=10, markers=True)
    for k, roll in enumerate((-1.6, 0.0, 1.4, 0.5, -0.8, 0.9)):
        turns = session.random.uniform(-0.5, 0.5, (2, 3))
        turns[1, 0] += roll
        first, last = Rotation.from_rotvec(turns).as_quat()
        end = start + session.random.uniform([0.38, -0.12, -0.12], [0.5, 0.12, 0.12])
        shape = rod.led(Held(start, first), Held(end, last))
        held = {"start": numbers(start), "start_orientation": numbers(first)}
        held |= {"end": numbers(end), "end_orientation": numbers(last)}
        held["end_force"] = session.reading(shape.end_force, std[0])
        held["end_moment"] = session.reading(shape.moments[1], std[1])
        session.add(shape, held, "held_out" if k == 3 else "fit")
    session.write(bending_stiffness=rod.bending, torsional_stiffness=rod.torsion)


def harness():
    """A cable through a pinned clip that stands elsewhere than declared, and an eyelet."""
    length, at, off = 0.8, [0.28, 0.54], (0.003, 0.004)
    rod = Rod(length, 0.06 * GRAVITY / length, 0.02)
    cable = {"length": length, "mass": 0.06, "diameter": 0.006, "bending_stiffness": 0.01}
    cable["rest_shape"] = "straight"
    options = quick(16, "clip_offset", "clip_slip", "end_offset")
    session = Writer("harness", 4, cable, lines(("pinned", "pinned")), options, count=25)
    for k, end in enumerate(((0.5, 0.1), (0.6, -0.05), (0.55, 0.0), (0.45, 0.05), (0.62, 0.1))):
        free = rod.solve(Held((0.0, 0.0)), Held(end))
        places = np.round(free.at(at) + session.random.uniform(-0.002, 0.002, (2, 2)), 4)
        joints = [Pin(tuple(places[0] + off)), Pin(tuple(places[1]), slides=True)]
        shape = rod.through(free, Held((0.0, 0.0)), Held(end), joints, at)
        clips = [
            {"name": "post", "kind": "pinned", "at": at[0], "place": numbers(places[0])},
            {"name": "ring", "kind": "eyelet", "place": numbers(places[1])},
        ]
        held = {"start": [0.0, 0.0], "end": list(end), "clips": clips}
        true = {"clip_at": np.cumsum(shape.lengths)[:2], "clip_forces": shape.joint_forces}
        session.add(shape, held, "held_out" if k == 1 else "fit", **true)
    session.write(bending_stiffness=rod.bending, dx=off[0], dy=off[1])


def table():
    """A cable clamped above a table, which lies higher than declared, with a free end on it."""
    length, diameter, level, off = 1.0, 0.006, -0.2, 0.004
    rod = Rod(length, 0.06 * GRAVITY / length, 0.005)
    cable = {"length": length, "mass": 0.06, "diameter": diameter, "bending_stiffness": 0.002}
    cable["rest_shape"] = "straight"
    desk = {"name": "desk", "kind": "plane", "point": [0.0, level], "normal": [0.0, 1.0]}
    experiment = lines(("clamped", "free"), obstacles=[desk])
    options = quick(12, "obstacle_offset", "clamp_angle", "gravity_tilt")
    session = Writer("table", 5, cable, experiment, options, count=16, markers=True)
    for k, (height, heading) in enumerate(
        ((0.09, -0.3), (0.11, 0.0), (0.16, -0.9), (0.13, -0.6), (0.1, -0.2))
    ):
        start = (0.0, round(level + height, 4))
        shape = rod.solve(Held(start, heading), Lying(level + off + diameter / 2))
        held = {"start": list(start), "start_heading": heading}
        pressed = rod.weight * length + shape.start_force[1]
        true = {"touches_from": shape.lengths[0], "table_force": [0.0, -pressed]}
        true["end_force"] = [0.0, 0.0]  # not where it touches first
        session.add(shape, held, "held_out" if k == 3 else "fit", **true)
    session.write(bending_stiffness=rod.bending, offset=off)


def fleet():
    """Two cables of one kind, of which one creeps: each pose bends its shape at rest."""
    length, s = 0.6, np.linspace(0.0, 0.6, 241)
    for name, stiffness, rate in (("soft", 0.006, {}), ("creeping", 0.01, {"rate": 0.25})):
        cable = {"length": length, "mass": 0.03, "diameter": 0.005, "bending_stiffness": 0.01}
        options = quick(12, "plastic_set", "rest_curvature_drift", "clamp_angle", "gravity_tilt")
        experiment = lines(("clamped", "clamped"))
        session = Writer(f"fleet/{name}", 6, cable, experiment, options, count=20)
        rest = 0.5 * np.sin(np.pi * s / length)
        for k, end in enumerate(ENDS[:7]):
            end = tuple(np.round(0.7 * np.array(end), 3).tolist())

            def bent(x, now=rest):
                return np.interp(x, s, now)

            rod = Rod(length, 0.03 * GRAVITY / length, stiffness, rest=bent)
            turn = float(np.arctan2(end[1], end[0]))
            headings = round(turn - 0.9, 3), round(turn + 1.0, 3)
            shape = rod.solve(Held((0.0, 0.0), headings[0]), Held(end, headings[1]))
            held = {"start": [0.0, 0.0], "end": list(end)}
            held |= {f"{side}_heading": x for side, x in zip(SIDES, headings, strict=True)}
            session.add(shape, held, "held_out" if k == 4 else "fit")
            rest = rest + rate.get("rate", 0.0) * (shape.curvature(s) - rest)
        session.write(bending_stiffness=stiffness, **rate)


if __name__ == "__main__":
    for make in (weight, tip, grippers, harness, table, fleet):
        if make.__name__ in sys.argv[1:] or not sys.argv[1:]:
            make()
