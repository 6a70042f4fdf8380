"""False alarms of the diagnosis on simulated sessions, and what it names of hidden effects.

    python scripts/check_false_alarms.py [--sets 300] [--seed 0] [--jobs N] [--output FILE]
                                         [--scatter | --space | --hidden]

Each set takes the cable and the poses of a bench session, a new smooth rest curvature and
stiffness, fixtures, length and scale drawn from their tolerances, and noise that is partly
correlated along the cable. It is simulated on a fine mesh by this toolkit's own model, so that
nothing can be missing; the nominal rate of false alarms is 0.5 %. How often EI lies in its 95 %
interval is counted, too.

With --scatter the sets are heavy cables in a gripper with a free tip instead, seen at two to four
markers with 1.5 to 2.5 mm of noise, and every hanging has a smooth random rest curvature of its
own, of 0.1 to 0.3 1/m.

With --space they are random cables between two grippers in space, 40 points a line with white
noise; how often GJ lies in its interval is counted, too. With --hidden the same cables have one
effect each that is not declared, of a size that a bench has; how often it is named, alone or among
what cannot be told from it, is counted.
"""

from __future__ import annotations

import argparse
import json
import os
import time
from dataclasses import replace
from functools import partial
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np
from scipy.spatial.transform import Rotation
from simulated import random_session

from dlo_casadi.config import load_config
from dlo_casadi.diagnosis.diagnose import diagnose
from dlo_casadi.effects import EFFECTS
from dlo_casadi.equilibrium.pose import HeldPose
from dlo_casadi.equilibrium.spread import modes_in, tipping
from dlo_casadi.estimation.constrained import profile_intervals
from dlo_casadi.estimation.fit import SEARCH_MESH
from dlo_casadi.estimation.prediction import predict_poses
from dlo_casadi.io.files import write_file
from dlo_casadi.model.rest_curvature import SMOOTHNESS, RestScatter
from dlo_casadi.runtime.parallel import generator_of, map_as_completed, open_executor
from dlo_casadi.sensing.measured_pose import MeasuredPose
from dlo_casadi.sensing.noise import NoiseModel
from dlo_casadi.session.fitting import declared_model, fit_declared
from dlo_casadi.session.stages import fit_stage

ROOT = Path(__file__).resolve().parent.parent
SESSIONS = ("short_clean", "held_headings", "weightless_fit", "thin")
# Effects that are hidden in space, one after the other.
HIDDEN = (
    "lumped_mass",
    "tether",
    "stiffness_gradient",
    "bending_anisotropy",
    "clamp_rotation",
    "rest_curvature_drift",
    "camera_frame",
)
# Boundaries of the cables that do not repeat: a clamp, and a free tip.
HANGING = "overhang"
# Distance of the clamp [rad] from where both sides are equally low within which either is possible.
EITHER_SIDE = 0.2


def hanging(config, generator):
    """A session like `config` of a cable that does not repeat: configuration, poses, EI."""
    length, mass = generator.uniform(0.5, 0.65), generator.uniform(0.3, 0.45)
    stiffness = mass * 9.81 * length**2 * np.exp(generator.uniform(np.log(0.02), np.log(0.08)))
    prior = stiffness * np.exp(generator.uniform(-1.5, 1.5))
    own = {"length": length, "mass": mass, "bending_stiffness": prior, "youngs_modulus": None}
    own["rest_shape"] = "curved"
    known = {"length": 0.003, "heading": 0.02, "end": 0.002}
    experiment = config.experiment.model_copy(
        update={"tolerances": config.experiment.tolerances.model_copy(update=known)}
    )
    cable = config.cable.model_copy(update=own)
    config = config.model_copy(update={"cable": cable, "experiment": experiment})
    model = declared_model(config).model.with_mesh(40)
    p = model.nominal.copy()
    p[0] = stiffness
    places = model.chain.cells.mean(axis=1) / length
    scatter = RestScatter(generator.uniform(0.1, 0.3), generator.choice(SMOOTHNESS))
    modes, mean = modes_in(model), generator.normal(0.0, 0.8, 2)
    noise, offset = generator.uniform(1.5e-3, 2.5e-3), generator.normal(0.0, known["heading"])
    s = np.linspace(0.0, length, generator.integers(3, 6))[1:]
    headings = generator.permutation(np.linspace(-3.1, 0.3, generator.integers(20, 27)))
    measured = []
    for k, heading in enumerate(headings):
        each = modes @ (scatter.sizes * generator.standard_normal(modes.shape[1]))
        rest = mean[0] + mean[1] * (places - 0.5) + each
        held = HeldPose((0.0, 0.0), start_heading=float(heading), name=f"pose_{k:02d}")
        turned = replace(held, start_heading=float(heading + offset))
        found = predict_poses(model, p, rest, [turned])[0]
        if found is None:
            continue
        eq = found.equilibrium
        if eq.other_side is not None and tipping(model, eq, eq.other_side) < EITHER_SIDE:
            continue
        points = found.curve.at(s) + noise * generator.standard_normal((len(s), 2))
        measured.append(MeasuredPose.of_points(held, points, held_out=k % 6 == 5, s=s))
    return config, measured, stiffness


def simulate(config, generator):
    """Measured poses of a cable with nothing hidden, and its EI."""
    declared = declared_model(config)
    model = declared.model.with_mesh(40)
    cable = config.cable
    weight = cable.mass / cable.length * 9.81
    stiffness = weight * cable.length**3 * np.exp(generator.uniform(np.log(0.03), np.log(0.6)))
    found = random_session(config, model, stiffness, generator, 0.3)
    if found is None:
        return None
    std, share = generator.uniform(1e-4, 4e-4), generator.uniform(0.0, 0.6)
    noise = NoiseModel(std, share, generator.uniform(0.02, 0.04), "gaussian")
    measured = []
    for pose, seen in zip(config.experiment.poses, found, strict=True):
        s = np.sort(generator.uniform(0.01, 0.99, 200)) * cable.length
        factor = np.linalg.cholesky(noise.covariance(s, np.ones(len(s))))
        points = seen.curve.at(s) + factor @ generator.standard_normal((len(s), 2))
        own = pose.held
        measured.append(MeasuredPose.of_points(own, points, held_out=pose.role == "held_out"))
    return measured, stiffness


def spatial(config, generator, hidden=None):
    """A cable in space, with nothing or one effect hidden: configuration, poses, EI, GJ."""
    length, mass = generator.uniform(0.5, 1.0), generator.uniform(0.03, 0.12)
    bending = mass * 9.81 * length**2 * np.exp(generator.uniform(np.log(0.03), np.log(0.3)))
    torsion = bending * generator.uniform(0.5, 0.9)
    prior = bending * np.exp(generator.uniform(-0.7, 0.7))
    own = {"length": length, "mass": mass, "bending_stiffness": prior, "torsional_stiffness": None}
    config = config.model_copy(update={"cable": config.cable.model_copy(update=own)})
    model = declared_model(config).model.with_mesh(24)
    p = model.nominal.copy()
    for k, q in enumerate(model.parameters):
        if np.isfinite(q.prior_std) and not q.log:
            p[k] += q.prior_std * generator.standard_normal()
    p[:2] = bending, torsion
    places = model.chain.cells.mean(axis=1) / length
    waves = np.cos(np.pi * np.arange(3)[:, None] * places)
    bends = generator.normal(0.0, 0.1, (2, 3)) @ waves * 2 * np.pi / length
    rest = np.concatenate([np.zeros(len(places)), *bends])
    start = Rotation.from_rotvec(generator.uniform(-0.6, 0.6, 3))
    s, std = np.linspace(0.02, 0.98, 40) * length, generator.uniform(2e-4, 1e-3)
    if hidden is not None:
        model, p = with_hidden(model, p, hidden, start, generator)
    measured, poses = [], []
    while len(measured) < 10:
        way = start * Rotation.from_rotvec(generator.uniform(-0.5, 0.5, 3))
        end = way.apply([generator.uniform(0.55, 0.85) * length, 0.0, 0.0])
        turned = start * Rotation.from_rotvec(generator.uniform(-0.7, 0.7, 3))
        held = HeldPose(
            (0.0, 0.0, 0.0),
            tuple(end),
            start_orientation=tuple(start.as_quat()),
            end_orientation=tuple(turned.as_quat()),
            name=f"pose_{len(measured):02d}",
        )
        slip = turned * Rotation.from_rotvec(2e-3 * generator.standard_normal(3))
        moved = tuple(end + 1e-4 * generator.standard_normal(3))
        true = replace(held, end=moved, end_orientation=tuple(slip.as_quat()))
        # With a state each pose depends on those before it.
        found = predict_poses(model, p, rest, [*poses, true])[-1]
        if found is None or not found.equilibrium.stable:
            continue
        poses += [true] if model.has_state else []
        points = found.curve.at(s) + std * generator.standard_normal((len(s), 3))
        out = len(measured) % 5 == 4
        measured.append(MeasuredPose.of_points(held, points, held_out=out))
    return config, measured, bending, torsion


def with_hidden(model, p, name, start, generator):
    """The model with one effect more, and its parameters."""
    cable, sign = model.cable, generator.choice([-1.0, 1.0], 6)
    some, turn = generator.uniform(0.6, 1.2, 6) * sign, generator.uniform(-1.2, 1.2)
    anchor = start.apply([0.35, 0.3 * some[0], 0.3 * some[1]]) * cable.length
    weight = cable.mass * 9.81
    place = generator.uniform(0.3, 0.7) * cable.length
    values = {
        "lumped_mass": {"mass": 0.25 * cable.mass * abs(some[0]), "position": place},
        "tether": {
            "stiffness": 3.0 * weight / cable.length * abs(some[2]),
            "position": place,
            **{f"anchor_{axis}": x for axis, x in zip("xyz", anchor, strict=True)},
        },
        "stiffness_gradient": {"slope": 0.4 * some[0]},
        "bending_anisotropy": {"ratio": 1.7 * abs(some[0]) ** 0.5, "angle": turn},
        "clamp_rotation": {"start_y": 0.08 * some[0], "start_z": 0.08 * some[1]},
        "rest_curvature_drift": {"rate": 0.15 * abs(some[0])},
        "camera_frame": {
            **{f"rotation_{axis}": 0.025 * x for axis, x in zip("xyz", some[:3], strict=True)},
            **{f"translation_{axis}": 0.004 * x for axis, x in zip("xyz", some[3:], strict=True)},
        },
    }[name]
    larger = model
    if not any(effect.label == name for effect in model.effects):
        larger = model.with_effect(EFFECTS[name]())
    found = larger.nominal.copy()
    for own, value in zip(model.names, p, strict=True):
        found[larger.names.index(own)] = value
    for key, value in values.items():
        found[larger.names.index(f"{name}.{key}")] = value
    return larger, found


def main() -> None:
    """Simulate, diagnose, count."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--sets", type=int, default=300)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--output", type=Path)
    kinds = parser.add_mutually_exclusive_group()
    kinds.add_argument("--scatter", action="store_true", help="of cables that do not repeat")
    kinds.add_argument("--space", action="store_true", help="of cables in space")
    kinds.add_argument("--hidden", action="store_true", help="in space, one effect hidden in each")
    parser.add_argument("--jobs", type=int, default=1, help="number of processes")
    parser.add_argument("--scheduler", help="address of a Dask scheduler, instead")
    args = parser.parse_args()
    rows: dict[int, dict] = {}
    seconds = []
    with open_executor(args.jobs, args.scheduler) as executor:
        kind = next((k for k in ("scatter", "space", "hidden") if getattr(args, k)), "plane")
        work = partial(run_one, seed=args.seed, kind=kind)
        for done in map_as_completed(executor, work, range(args.sets)):
            row = rows[done.index] = done.value
            seconds.append([row["fit_seconds"], row["diagnosis_seconds"]])
            if not row["right"]:
                print(f"  set {done.index}: {row}", flush=True)
            if len(rows) % 20 == 0 or len(rows) == args.sets:
                alarms = sum(bool(row["added"]) and not row["right"] for row in rows.values())
                unexplained = sum(row["verdict"] == "unexplained" for row in rows.values())
                both = [np.mean([row[k] for row in rows.values()]) for k in ("inside", "torsion")]
                band = np.mean(np.concatenate([row["in_band"] for row in rows.values()]))
                fit, diagnosis = np.median(seconds, axis=0)
                print(
                    f"{len(rows)} sets: {alarms} with a wrong effect, {unexplained} unexplained, "
                    f"EI in its interval in {100 * both[0]:.1f} %"
                    + (f", GJ in {100 * both[1]:.1f} %" if kind in ("space", "hidden") else "")
                    + f", {100 * band:.1f} % of points left out in their band; "
                    f"median {fit:.1f} s for the fit, {diagnosis:.1f} s for the diagnosis",
                    flush=True,
                )
                if args.output:
                    write_file(args.output, json.dumps([rows[k] for k in sorted(rows)]))


def run_one(index: int, seed: int, kind: str) -> dict:
    """Simulate one set, whose random numbers depend on seed and index alone, and diagnose it."""
    scatter, space = kind == "scatter", kind in ("space", "hidden")
    hidden = HIDDEN[index % len(HIDDEN)] if kind == "hidden" else None
    name = HANGING if scatter else SESSIONS[index % len(SESSIONS)]
    path = ROOT / "tests" / "data" / "bench" / name / "session.yaml"
    config = load_config(ROOT / "configs" / "markers_in_space.yaml" if space else path)
    plain = config.experiment.measurement.model_copy(update={"std": None})
    experiment = config.experiment.model_copy(update={"measurement": plain})
    config = config.model_copy(update={"experiment": experiment})
    generator = generator_of(seed, index)
    torsion = np.nan
    if scatter:
        config, measured, stiffness = hanging(config, generator)
    elif space:
        config, measured, stiffness, torsion = spatial(config, generator, hidden)
    else:
        found = None
        while found is None:
            found = simulate(config, generator)
        measured, stiffness = found
    begin = time.perf_counter()
    fit, _ = fit_declared(config, declared_model(config), measured)
    fitted = time.perf_counter()
    diagnosis = diagnose(fit, finest=SEARCH_MESH)
    intervals = profile_intervals(diagnosis.after)
    named = {item.candidate.name for item in diagnosis.added}
    tied = {name for item in diagnosis.added for name in item.equivalents}
    tied |= {rival.candidate.name for item in diagnosis.added for rival in item.rivals}
    explained = diagnosis.verdict != "unexplained"
    scores = {row.name: (row.score, row.p_value) for row in diagnosis.ranked}
    return {
        "hidden": hidden,
        "score, p": scores.get(hidden),
        "right": explained and (not named if hidden is None else hidden in named | tied),
        "session": config.cable.name,
        "verdict": diagnosis.verdict,
        "added": [item.candidate.name for item in diagnosis.added],
        "n": fit.model.n,
        "inside": within(intervals["bending_stiffness"], stiffness),
        "in_band": in_band(diagnosis.after, measured),
        "torsion": within(intervals.get("torsional_stiffness"), torsion),
        "fit_seconds": fitted - begin,
        "diagnosis_seconds": time.perf_counter() - fitted,
    }


def in_band(fit, measured) -> list[bool]:
    """Whether each left-out point lies in the 90 % band of its pose."""
    shapes, inside = fit_stage("batch", fit, measured, {}, ()).shapes, []
    for item in measured:
        shape = shapes.get(item.pose.name)
        if item.held_out and shape is not None:
            inside += list(shape.inside_band(fit.model.cable.length, fit.noise.of_points.std))
    return inside


def within(interval, true) -> bool:
    """Whether a stiffness lies in its interval, which may be unbounded."""
    if interval is None:
        return False
    low = -np.inf if interval.low is None else interval.low
    return bool(low <= true <= (np.inf if interval.high is None else interval.high))


if __name__ == "__main__":
    main()
