"""What wrench measurements tell, on sessions simulated by this toolkit's own model.

    python scripts/check_readings.py [--count 4] [--tables clean mass loads clamps plane space]
        [--first 0] [--seed 0] [--jobs N] [--output FILE] [--figure power.png]

The cable and the poses of configs/cable.yaml, 0.3 mm of white noise, fixtures and sensors off by
draws from their tolerances; forces of 15 mN and moments of 1 mN m of noise. The tables, loads and
clamps also as a figure:

- clean: readings of the end's force on three poses, nothing hidden: false alarms of the diagnosis,
  and how often intervals of EI hold the truth;
- mass: the same with a mass that is not declared: errors of EI and mass, and coverage;
- loads: a lumped mass against point_force, by the number of poses with readings of the end's force:
  twice the log evidence of the right model over the wrong one;
- clamps: a pin with a stiff spring against a clamp at another angle, the same, with readings of
  force and moment at the start;
- plane, space: ten poses between clamps with readings of the end's force and moment alone, and no
  shape; a cable curved at rest, gripped at any roll, with a first guess of EI off by up to a factor
  of thirty; noise declared in every other set: how often intervals of EI and GJ hold the truth.

A dead weight is a dead force: no reading of forces tells a lumped mass from a point force along
gravity.
"""

from __future__ import annotations

import json
import os
import time
from dataclasses import replace
from functools import partial
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np
from harness import options, run
from scipy.spatial.transform import Rotation
from simulated import random_session

import dlo_casadi as dlo
from dlo_casadi.config import Config, load_config
from dlo_casadi.diagnosis.diagnose import diagnose
from dlo_casadi.effects import EFFECTS
from dlo_casadi.effects.mass_error import MASS_FACTOR
from dlo_casadi.errors import EstimationError
from dlo_casadi.estimation.constrained import profile_intervals
from dlo_casadi.estimation.fit import fine_enough
from dlo_casadi.runtime.parallel import generator_of
from dlo_casadi.sensing.measured_pose import MeasuredPose
from dlo_casadi.session.fitting import declared_model, fit_declared
from dlo_casadi.show.style import BLUE, GREY, VERMILLION, save_figure, styled

ROOT = Path(__file__).resolve().parent.parent
STD, FORCE_STD, MOMENT_STD = 3e-4, 0.015, 1e-3  # m, N, N m
TABLES = ("clean", "mass", "loads", "clamps", "plane", "space")
ALONE = {"plane": 2, "space": 3}  # tables of readings alone: number of dimensions
NUMBERS = (0, 1, 3, 6, 12)  # of poses with wrench measurements
MASS, POSITION = 0.03, 0.3  # kg, m: of the lumped mass
STIFFNESS, HEADING = 1500.0, 0.35  # N m/rad, rad: of the spring at the start
APART = 10.0  # of twice the log evidence, twice EVIDENCE_APART of the diagnosis
RIVALS = {"loads": "lumped_mass over point_force", "clamps": "start_spring over clamp_angle"}


def measured_with(config: Config, readings: tuple[str, ...], number: int) -> Config:
    """The configuration with wrench measurements declared in that many fit poses."""
    poses, left = [], number
    for pose in config.experiment.poses:
        given = {}
        if pose.role == "fit" and left:
            given = {name: (0.0,) * (1 if "moment" in name else 2) for name in readings}
            left -= 1
        poses.append(pose.changed(**given))
    measurement = config.experiment.measurement.changed(
        std=STD, force_std=FORCE_STD, moment_std=MOMENT_STD
    )
    update = {"poses": tuple(poses), "measurement": measurement}
    return config.changed(experiment=config.experiment.changed(**update))


def simulate(config: Config, generator, hidden: dict[str, dict[str, float]], factor: float = 1.0):
    """Measured poses and the true EI; None where a pose has no stable equilibrium.

    Parameters
    ----------
    hidden : dict
        Parameters of effects by their names.
    factor : float
        True mass over that which the model starts from.
    """
    model = declared_model(config).model.with_mesh(40)
    cable = model.cable
    model = replace(model, cable=replace(cable, mass=factor * cable.mass))
    for name in hidden:
        if name not in [effect.name for effect in model.effects]:
            model = model.with_effect(EFFECTS[name]())
    stiffness = cable.mass * 9.81 * cable.length**2 * generator.uniform(0.1, 0.4)
    values = {f"{name}.{key}": x for name, own in hidden.items() for key, x in own.items()}
    found = random_session(config, model, stiffness, generator, 0.2, values)
    if found is None:
        return None
    measured = []
    for pose, seen in zip(config.experiment.poses, found, strict=True):
        own = pose.held
        s = np.linspace(0.01, 0.99, 60) * cable.length
        points = seen.curve.at(s) + STD * generator.standard_normal((len(s), 2))
        item = MeasuredPose.of_points(own, points, held_out=pose.role == "held_out")
        item = item.with_readings(pose.readings)
        read = {
            name: true
            + (MOMENT_STD if "moment" in name else FORCE_STD) * generator.standard_normal(len(true))
            for name, (_, true) in item.readings_beside(seen).items()
        }
        item = MeasuredPose.of_points(own, points, held_out=pose.role == "held_out")
        measured.append(item.with_readings(read))
    return measured, stiffness


def drawn(config: Config, generator, hidden=None, factor: float = 1.0):
    """The first simulated session in which all poses are stable."""
    while True:
        found = simulate(config, generator, hidden or {}, factor)
        if found is not None:
            return found


def load_bench() -> Config:
    """configs/cable.yaml with lines in place of photographs."""
    config = load_config(ROOT / "configs" / "cable.yaml")
    other = load_config(ROOT / "tests" / "data" / "bench" / "short_clean" / "session.yaml")
    experiment = config.experiment.changed(measurement=other.experiment.measurement)
    return config.changed(experiment=experiment)


def inside(interval, value: float) -> bool:
    """Whether an interval holds a value."""
    low, high = interval.low, interval.high
    return (low is None or low <= value) and (high is None or value <= high)


def clean(generator) -> dict:
    """Nothing hidden: what the diagnosis adds, and whether EI's interval holds the truth."""
    config = measured_with(load_bench(), ("end_force",), 3)
    measured, stiffness = drawn(config, generator)
    fit = fit_declared(config, declared_model(config), measured)
    diagnosis = diagnose(fit)
    after = fine_enough(diagnosis.fit, diagnosis.fit.model.n)
    interval = profile_intervals(after)["bending_stiffness"]
    return {
        "added": [item.candidate.name for item in diagnosis.added],
        "unexplained": diagnosis.unexplained,
        "inside": inside(interval, stiffness),
        "error": after.value("bending_stiffness") / stiffness - 1,
        "std": after.std("bending_stiffness") / stiffness,
    }


def mass(generator) -> dict:
    """A mass that is not declared."""
    config = load_bench()
    unknown = config.cable.changed(mass=None)
    config = measured_with(config.changed(cable=unknown), ("end_force",), 3)
    measured, stiffness = drawn(config, generator, factor=1.1)
    fit = fit_declared(config, declared_model(config), measured)
    found = profile_intervals(fit)
    return {
        "EI": fit.value("bending_stiffness") / stiffness - 1,
        "EI_inside": inside(found["bending_stiffness"], stiffness),
        "mass": fit.value(MASS_FACTOR) / 1.1 - 1,
        "mass_inside": inside(found[MASS_FACTOR], 1.1),
    }


def told(generator, hidden, wrong: str, readings, number: int, held: str, other: str) -> dict:
    """Twice the log evidence of the right model over the wrong one."""
    config = measured_with(load_bench(), readings, number)
    (right,) = hidden
    gains = {}
    for name, side in ((right, held), (wrong, other)):
        boundary = config.experiment.boundary.changed(start=side)
        poses = tuple(
            pose.changed(start_heading=0.0 if side == "clamped" else None)
            for pose in config.experiment.poses
        )
        update = {"boundary": boundary, "poses": poses}
        as_held = config.changed(
            experiment=config.experiment.changed(**update), model=config.model.changed(n=20)
        )
        if name == right:
            measured, _ = drawn(as_held, generator, hidden)
        items = [replace(item, pose=pose.held) for item, pose in zip(measured, poses, strict=True)]
        declared = declared_model(as_held)
        effect = EFFECTS[name]
        model = declared.model
        if name in [one.name for one in model.effects]:
            kept = {k: v for k, v in model.priors.items() if not k.startswith(f"{name}.")}
            model = replace(model, priors=kept)
        else:
            model = model.with_effect(effect())
        start = model.nominal.copy()
        for full, value in START.get(name, {}).items():
            start[model.names.index(full)] = value
        declared = replace(declared, model=model, start=start, free=list(model.names))
        try:
            fit = fit_declared(as_held, declared, items)
            gains[name] = 2 * fit.log_evidence
        except EstimationError:  # no shape of the model comes near the measured ones
            gains[name] = -1e9
    return {"number": number, "gain": gains[right] - gains[wrong]}


def alone(generator, d: int, declared: bool) -> dict:
    """Ten poses between clamps with readings of the end alone: errors and intervals of EI, GJ."""
    length, mass, ends = 0.8, 0.05, ("clamped", "clamped")
    true = mass * 9.81 * length**2 * generator.uniform(0.05, 0.4)
    values = {"torsional_stiffness": true * generator.uniform(0.5, 0.9)} if d == 3 else {}
    guess = true * 10 ** generator.uniform(-1.5, 1.5)
    cable = dlo.Cable(length=length, mass=mass, diameter=0.006, bending_stiffness=guess)
    noise = {"force_std": FORCE_STD, "moment_std": MOMENT_STD} if declared else {}
    while True:
        poses = [_held_pose(generator, d, length) for _ in range(10)]
        gravity = (0.0,) * (d - 1) + (-9.81,)
        session = dlo.Session(cable, poses, gravity=gravity, boundary=ends, **noise)
        found = declared_model(session)
        model = found.model.with_mesh(40)
        seen = random_session(session, model, true, generator, 0.1, values, found.tolerances)
        if seen is not None:
            break
    measured = []
    for pose, one in zip(session.experiment.poses, seen, strict=True):
        item = MeasuredPose(pose.held).with_readings(pose.readings)
        read = {
            name: felt
            + (MOMENT_STD if "moment" in name else FORCE_STD) * generator.standard_normal(len(felt))
            for name, (_, felt) in item.readings_beside(one).items()
        }
        measured.append(MeasuredPose(pose.held).with_readings(read))
    fit = fit_declared(session, declared_model(session), measured)
    truth = {"bending_stiffness": true, **values}
    return {
        name: {
            "error": fit.value(name) / truth[name] - 1,
            "std": fit.std(name) / truth[name],
            "inside": inside(interval, truth[name]),
            "identifiable": interval.identifiable,
        }
        for name, interval in profile_intervals(fit).items()
    } | {"declared": declared, "chi2": fit.chi2_per_dof, "failed": fit.failed}


def _held_pose(generator, d: int, length: float) -> dlo.Pose:
    """Ends at random, their clamps within half a radian (std) of the chord; readings to fill in."""
    end = length * np.array([generator.uniform(0.35, 0.8), *generator.uniform(-0.3, 0.3, d - 1)])
    held = {}
    for side in ("start", "end"):
        if d == 2:
            held[f"{side}_heading"] = float(generator.normal(0, 0.5))
        else:
            turn = Rotation.from_rotvec(generator.normal(0, 0.5, 3))
            held[f"{side}_orientation"] = turn.as_quat()
    read = {"end_force": (1.0,) * d, "end_moment": 1.0 if d == 2 else (1.0,) * 3}
    return dlo.Pose((0.0,) * d, end, **held, **read)


# Starts of fits of effects that have no derivative by their place or heading at the nominal value.
START = {
    "lumped_mass": {"lumped_mass.mass": 0.02, "lumped_mass.position": POSITION},
    "point_force": {"point_force.fy": -0.2, "point_force.position": POSITION},
    "start_spring": {"start_spring.stiffness": STIFFNESS, "start_spring.heading": HEADING},
}


def loads(generator, number: int) -> dict:
    """A lumped mass."""
    lump = {"lumped_mass": {"mass": MASS, "position": POSITION}}
    return told(generator, lump, "point_force", ("end_force",), number, "pinned", "pinned")


def clamps(generator, number: int) -> dict:
    """A pin with a spring."""
    spring = {"start_spring": {"stiffness": STIFFNESS, "heading": HEADING}}
    reads = ("start_force", "start_moment")
    return told(generator, spring, "clamp_angle", reads, number, "pinned", "clamped")


def run_one(index: int, seed: int, tables: tuple[str, ...]) -> dict:
    """One set of each table; its random numbers depend on seed and index alone."""
    rows: dict = {}
    begin = time.perf_counter()
    for table, work in (("clean", clean), ("mass", mass)):
        if table in tables:
            rows[table] = work(generator_of(seed, index))
    for table, power in (("loads", loads), ("clamps", clamps)):
        if table in tables:  # the same cable for each number
            rows[table] = [power(generator_of(seed, index), number) for number in NUMBERS]
    for table, d in ALONE.items():
        if table in tables:
            rows[table] = alone(generator_of(seed, index), d, declared=index % 2 == 0)
    return rows | {"seconds": time.perf_counter() - begin}


def main() -> None:
    """Simulate, fit, count."""
    count = 4, "number of sets"
    parser = options(__doc__, count=count, first=True, seed=0, jobs=True, output=True)
    parser.add_argument("--tables", nargs="+", choices=TABLES, default=TABLES)
    parser.add_argument("--figure", type=Path, help="of what is told apart (loads, clamps)")
    chosen = parser.parse_args()
    work = partial(run_one, seed=chosen.seed, tables=tuple(chosen.tables))
    cases = range(chosen.first, chosen.first + chosen.count)
    rows = run(work, cases, chosen, lambda case, row, seconds: json.dumps(row))
    print_tables(rows)
    if chosen.figure:
        draw(rows, chosen.figure)


def draw(rows: list[dict], path: Path) -> None:
    """Evidence against the number of wrench measurements: medians and quartiles of all sets."""
    with styled((6.4, 4.2)) as drawing:
        axes = drawing.subplots()
        for (table, label), color in zip(RIVALS.items(), (BLUE, VERMILLION), strict=True):
            if table in rows[0]:
                quartiles = np.percentile(gains_of(rows, table), (25, 50, 75), axis=0)
                axes.fill_between(NUMBERS, quartiles[0], quartiles[2], color=color, alpha=0.2)
                axes.plot(NUMBERS, quartiles[1], "o-", color=color, label=label)
        axes.axhline(APART, color=GREY, ls="--", label="told apart above")
        axes.set(
            xlabel="poses with readings",
            ylabel="twice the log evidence,\nright model over wrong one",
            xticks=NUMBERS,
            title=f"{len(rows)} simulated cables: median and quartiles",
        )
        axes.legend()
    save_figure(path, drawing)


def gains_of(rows: list[dict], table: str) -> np.ndarray:
    """Twice the log evidence (sets, numbers) of the right model over the wrong one."""
    return np.array([[own["gain"] for own in row[table]] for row in rows])


def print_tables(rows: list[dict]) -> None:
    """Summary of all sets."""
    found = [row["clean"] for row in rows if "clean" in row]
    if found:
        alarms = sum(bool(row["added"]) or row["unexplained"] for row in found)
        off = [abs(row["error"]) < 1.96 * row["std"] for row in found]
        print(
            f"clean: {alarms} false alarms of {len(found)}, EI inside its interval "
            f"{share(found, 'inside')}, within 1.96 standard deviations {sum(off)}"
        )
    known = [row["mass"] for row in rows if "mass" in row]
    for what in ("EI", "mass") if known else ():
        worst = max(abs(row[what]) for row in known)
        rms = float(np.sqrt(np.mean([row[what] ** 2 for row in known])))
        print(
            f"mass unknown: {what} off by {rms:.2%} RMS, {worst:.2%} at most, inside "
            f"{share(known, f'{what}_inside')}"
        )
    for table in ALONE:
        sets = [row[table] for row in rows if table in row]
        for name in ("bending_stiffness", "torsional_stiffness"):
            known = [one[name] for one in sets if name in one]
            if not known:
                continue
            scores = [one["error"] / one["std"] for one in known]
            print(
                f"readings alone, {table}: {name} inside {share(known, 'inside')} "
                f"({np.mean([one['inside'] for one in known]):.0%}), identifiable in "
                f"{share(known, 'identifiable')}, std {np.median([x['std'] for x in known]):.2%} "
                f"(median), error over std {np.sqrt(np.mean(np.square(scores))):.2f} RMS"
            )
    for table, what in RIVALS.items():
        if table not in rows[0]:
            continue
        print(f"{what}, poses with readings: share told apart (by {APART:g}), median")
        for k, number in enumerate(NUMBERS):
            gains = gains_of(rows, table)[:, k]
            told_apart = float(np.mean(gains > APART))
            print(f"  {number:3d}: {told_apart:.0%}, {np.median(gains):.1f}")


def share(rows: list[dict], key: str) -> str:
    """How many of some rows hold the truth."""
    return f"{sum(row[key] for row in rows)} of {len(rows)}"


if __name__ == "__main__":
    main()
