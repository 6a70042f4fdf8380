"""False alarms of the diagnosis on simulated sessions, and what it names of hidden effects.

    python scripts/check_false_alarms.py [--sets 300] [--first 0] [--seed 0] [--jobs N]
                                         [--output FILE]
                                         [--scatter | [--space]
                                         [--hidden | --random SOURCE | --table | --strong EFFECT]]

Each set takes the cable and the poses of a bench session, a new smooth rest curvature and
stiffness, fixtures, length and scale drawn from their tolerances, and noise that is partly
correlated along the cable. It is simulated on a fine mesh by this toolkit's own model, so that
nothing can be missing; the nominal rate of false alarms is 0.5 %. How often EI lies in its 95 %
interval is counted, too.

With --scatter the sets are heavy cables in a gripper with a free tip instead, seen at two to four
markers with 1.5 to 2.5 mm of noise, and every hanging has a smooth random rest curvature of its
own, of 0.1 to 0.3 1/m.

With --space they are random cables between two grippers in space, with --hidden cables in the plane
of which one or two effects are not declared, with both the same in space: see hidden_sets.py. With
--random SOURCE the poses differ in a rest curvature, moments of pins, ... of their own instead, and
it is counted how often that is named. With --table two poses to all touch a table that is not
declared; with --strong EFFECT that effect is hidden at a size far beyond the noise. Of hidden
effects those count that the data show: that make the declared model less likely by e^15 when both
are fitted from the truth. How often each is named, alone or among what cannot be told from it, is
counted, how often a wrong one is, and how often a stiffness lies in its interval where all that is
hidden shows and is named, over all and by how the ends are held and what is measured.
"""

from __future__ import annotations

import os
import time
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from functools import partial
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np
from harness import options, run
from hidden_sets import LINE, POSES, RANDOM_SIZES, STRONG, Simulated, about_axis, simulated
from simulated import random_session

import dlo_casadi as dlo
from dlo_casadi.config import declared_setup, load_config
from dlo_casadi.diagnosis.candidates import candidates, setup_of
from dlo_casadi.diagnosis.diagnose import diagnose
from dlo_casadi.effects import random_effects
from dlo_casadi.equilibrium.pose import HeldPose
from dlo_casadi.equilibrium.spread import tipping
from dlo_casadi.estimation.constrained import profile_intervals
from dlo_casadi.estimation.descent import descend, refit
from dlo_casadi.estimation.fit import SEARCH_MESH, fit_model
from dlo_casadi.estimation.prediction import predict_poses
from dlo_casadi.model.cable_model import CableModel
from dlo_casadi.model.pose_scatter import SMOOTHNESS, PoseScatter, modes_in
from dlo_casadi.runtime.parallel import generator_of
from dlo_casadi.sensing.measured_pose import MeasuredPose
from dlo_casadi.sensing.noise import NoiseModel
from dlo_casadi.session.fitting import declared_model, fit_declared
from dlo_casadi.session.measure import measured_poses, read_inputs
from dlo_casadi.session.stages import fit_stage

ROOT = Path(__file__).resolve().parent.parent
SESSIONS = ("short_clean", "held_headings", "weightless_fit", "thin")
# Logarithm of the likelihood ratio from which on the data show an effect.
SHOWN = 15.0
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
    experiment = config.experiment.changed(tolerances=config.experiment.tolerances.changed(**known))
    cable = config.cable.changed(**own)
    config = config.changed(cable=cable, experiment=experiment)
    model = declared_model(config).model.with_mesh(40)
    p = model.nominal.copy()
    p[0] = stiffness
    places = model.chain.cells.mean(axis=1) / length
    scatter = PoseScatter(generator.uniform(0.1, 0.3), generator.choice(SMOOTHNESS))
    modes, mean = modes_in(model), generator.normal(0.0, 0.8, 2)
    noise, offset = generator.uniform(1.5e-3, 2.5e-3), generator.normal(0.0, known["heading"])
    s = np.linspace(0.0, length, generator.integers(3, 6))[1:]
    headings = generator.permutation(np.linspace(-3.1, 0.3, generator.integers(20, 27)))
    measured = []
    for k, heading in enumerate(headings):
        each = modes @ (scatter.sizes(modes.shape[1]) * generator.standard_normal(modes.shape[1]))
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


def main() -> None:
    """Simulate, diagnose, count."""
    parser = options(__doc__, first=True, seed=0, jobs=True, scheduler=True, output=True)
    parser.add_argument("--sets", type=int, default=300)
    kinds = parser.add_mutually_exclusive_group()
    kinds.add_argument("--scatter", action="store_true", help="of cables that do not repeat")
    kinds.add_argument("--plane", action="store_true", help="of random cables in the plane")
    kinds.add_argument("--space", action="store_true", help="of random cables in space")
    parser.add_argument("--hidden", action="store_true", help="one or two effects hidden in each")
    parser.add_argument("--random", default="", choices=RANDOM_SIZES, help="of each pose's own")
    parser.add_argument("--table", action="store_true", help="on a table that is not declared")
    parser.add_argument("--strong", default="", choices=STRONG, help="hidden, and large")
    parser.add_argument("--poses", type=int, default=POSES, help="of each session")
    parser.add_argument("--each", action="store_true", help="print every set, not only odd ones")
    args = parser.parse_args()
    kind, dimension = random_effects().get(args.random), 3 if args.space else 2
    if kind is not None and dimension not in kind.dimensions:
        where = "in space" if args.space else "in a plane"
        parser.error(f"--random {args.random} is not of cables {where}")
    sets = range(args.first, args.first + args.sets)
    if args.plane or args.space or args.hidden or args.random or args.table or args.strong:
        asked = {"space": args.space, "hide": args.hidden, "random": args.random}
        asked |= {"table": args.table, "strong": args.strong, "poses": args.poses}
        work = partial(run_random, seed=args.seed, **asked)
        run(work, sets, args, partial(odd_set, every=args.each), summary=summary)
    else:
        work = partial(run_one, seed=args.seed, scatter=args.scatter)
        run(work, sets, args, wrong_set, summary=alarms_in)


def wrong_set(number: int, row: dict, _: float) -> str:
    """A set in which something false was found."""
    return "" if row["right"] else f"  set {number}: {row}"


def odd_set(number: int, row: dict, _: float, every: bool = False) -> str:
    """A random set in which anything is not as it should be, or `every` one."""
    odd = every or row["missed"] or row["wrong"] or not all(row["inside"].values()) or row["worse"]
    return f"  set {number}: {row}" if odd else ""


def alarms_in(rows: list[dict]) -> str:
    """False alarms of some sets, in a line."""
    alarms = sum(bool(row["added"]) and not row["right"] for row in rows)
    unexplained = sum(row["verdict"] == "unexplained" for row in rows)
    inside = np.mean([row["inside"] for row in rows])
    band = np.mean(np.concatenate([row["in_band"] for row in rows]))
    fit, diagnosis = (
        np.median([row[f"{name}_seconds"] for row in rows]) for name in ("fit", "diagnosis")
    )
    return (
        f"{len(rows)} sets: {alarms} with a wrong effect, {unexplained} unexplained, "
        f"EI in its interval in {100 * inside:.1f} %, "
        f"{100 * band:.1f} % of points left out in their band; "
        f"median {fit:.1f} s for the fit, {diagnosis:.1f} s for the diagnosis"
    )


def summary(rows: list[dict]) -> str:
    """What was found in some sets, in a line."""
    shown = sum(len(row["shown"]) for row in rows)
    named = shown - sum(len(row["missed"]) for row in rows)
    wrong = sum(bool(row["wrong"]) for row in rows)
    # An effect that the data do not show may move a stiffness, and nothing can tell.
    known = [row for row in rows if len(row["shown"]) == len(row["hidden"])]
    right = [row for row in known if not (row["missed"] or row["wrong"] or row["refused"])]
    seconds = [row["cpu_seconds"] for row in rows]
    said = [f"{len(rows)} sets"]
    if shown:
        said.append(f"{named} of {shown} effects that the data show named or tied")
    if any("random" in row for row in rows):
        own = sum("random" in row and not row["missed"] for row in rows)
        said.append(f"what differs from pose to pose named or tied in {own}")
    said.append(f"{wrong} sets with a wrong effect")
    said.append(f"{sum(row['worse'] for row in rows)} with a batch fit worse than a simpler one")
    for name in ("bending_stiffness", "torsional_stiffness"):
        inside = [row["inside"][name] for row in right if name in row["inside"]]
        if inside:
            said.append(f"{name} in its interval in {100 * np.mean(inside):.1f} %")
        for kind in sorted({row["kind"] for row in right}):
            of_kind = [row["inside"] for row in right if row["kind"] == kind]
            own = [found[name] for found in of_kind if name in found]
            if own:
                said.append(f"({kind}: {sum(own)} of {len(own)})")
    named = [len(row["hidden"]) - len(row.get("named", [])) for row in rows]
    for name in ("bending_stiffness", "torsional_stiffness"):
        for what, kept in (("hidden and not named", True), ("nothing is", False)):
            asked = [row for row, left in zip(rows, named, strict=True) if (left > 0) is kept]
            asked = [row for row in asked if name in row["if_hidden"] and not row["wrong"]]
            if asked:
                plain = np.mean([row["inside"][name] for row in asked])
                inside, wider = zip(*(row["if_hidden"][name] for row in asked), strict=True)
                said.append(
                    f"where {what}: {name} in its interval in {100 * plain:.0f} %, if hidden in "
                    f"{100 * np.mean(inside):.0f} % of {len(asked)}, {np.median(wider):.1f} x wide"
                )
    said.append(
        f"processor time median {np.median(seconds):.0f} s, 95 % {np.quantile(seconds, 0.95):.0f} s"
    )
    return ", ".join(said)


def run_random(
    index: int,
    seed: int,
    space: bool,
    hide: bool,
    random: str = "",
    table: bool = False,
    strong: str = "",
    poses: int = POSES,
) -> dict:
    """Simulate and fit one random session, and say what was found of its truth."""
    generator = generator_of(seed, index)
    count = 1 + index % 2 if hide else 0
    found = simulated(generator, 3 if space else 2, count, random, table, strong, poses)
    begin = time.process_time()
    row = {"hidden": found.hidden, "refused": "", "wrong": [], "inside": {}, "worse": False}
    row |= {"if_hidden": {}, "kind": found.kind}
    try:
        result = found.session.fit()
    except dlo.DloError as error:
        row["refused"] = error.message.splitlines()[0]
        result = None
    row["cpu_seconds"] = time.process_time() - begin
    row["shown"] = shown_by(found)
    row["missed"] = []
    if result is None:
        row["missed"] = [*row["shown"], *([random] if random else [])]
        return row
    own = result.fit.problem.priors.pose_scatter
    if random:
        row["random"] = [one.source for one in (own, *own.rivals) if one.std]
        row["missed"] = [] if random in row["random"] else [random]
        sizes = [one.std for one in (own, *own.rivals) if one.source == random]
        row["std_over_true"] = float(sum(sizes) / found.values[f"random.{random}"])
    named = [{item.name, *item.indistinguishable_from} for item in result.effects]
    row["verdict"], row["steps"] = result.verdict, result.work.steps
    row["scatter"] = (own.source, own.std) if own.std else ()
    row["held_out"] = result.stages[-1].rmse_held_out_measured_branch
    row["named"] = [sorted(names) for names in named]
    row["missed"] += [name for name in row["shown"] if not any(name in names for names in named)]
    row["wrong"] = [sorted(names) for names in named if not names & set(found.hidden)]
    last, errors = result.stages[-1], {}
    angle = last.parameters.get("bending_anisotropy.angle")
    true = about_axis(found.values, angle.value) if angle else found.values
    for name in ("bending_stiffness", "torsional_stiffness"):
        own = last.parameters.get(name)
        if own is not None:
            row.setdefault("over_true", {})[name] = float(own.value / true[name])
        if own is not None and last.explains:
            row["inside"][name] = within(own.interval_95, true[name])
            wide = own.interval_95_if_hidden
            row["if_hidden"][name] = within(wide, true[name]), width_over(wide, own.interval_95)
    for stage in result.stages:
        errors[stage.name] = stage.rmse_fit_measured_branch
    simpler = [x for name in ("initial", "stiffness_only") if (x := errors.get(name)) is not None]
    own = errors.get("batch")
    row["worse"] = own is None or (bool(simpler) and own > 1.001 * min(simpler))
    return row


def shown_by(found: Simulated) -> list[str]:
    """Hidden effects without which the model is less likely by e^SHOWN, fitted from the truth."""
    if not found.hidden:
        return []
    session = found.session
    measured = measured_poses(session, read_inputs(session))
    declared, readings = declared_model(session), declared_setup(session).readings
    base = declared.model.with_mesh(SEARCH_MESH // (4 if declared.model.in_space else 2))
    known = {"n_poses": len(measured), "readings": readings, "resting": 0.0}

    def fitted_with(names: Sequence[str]) -> CableModel:
        model = base
        for name in names:
            listed = candidates(model, setup_of(model, **known))
            model = next(item for item in listed if item.name == name).add_to(model)
        return model

    model = fitted_with(found.hidden)
    values = np.array([found.values.get(q.name, q.nominal) for q in model.parameters])
    std = session.experiment.measurement.std
    noise = NoiseModel(*LINE[1:], "gaussian") if std is None else NoiseModel(std)
    try:
        truth = fit_model(model, measured, declared.tolerances, noise.std, values=values)
    except dlo.EstimationError:
        return []
    noise = replace(noise, readings=truth.noise.readings)
    truth = descend(truth.reweighed(noise))
    shown = []
    for name in found.hidden:
        smaller = fitted_with([other for other in found.hidden if other != name])
        try:
            without = refit(truth, smaller).point.objective
        except dlo.EstimationError:
            without = np.inf
        if without - truth.point.objective > SHOWN:
            # From the truth a fit may end in a minimum that is not the lowest without the effect.
            with suppress(dlo.EstimationError):
                anew = fit_model(smaller, measured, declared.tolerances, noise.std)
                without = min(
                    without, descend(anew.reweighed(noise, truth.problem.priors)).point.objective
                )
        if without - truth.point.objective > SHOWN:
            shown.append(name)
    return shown


def run_one(index: int, seed: int, scatter: bool) -> dict:
    """Simulate one set, whose random numbers depend on seed and index alone, and diagnose it."""
    name = HANGING if scatter else SESSIONS[index % len(SESSIONS)]
    config = load_config(ROOT / "tests" / "data" / "bench" / name / "session.yaml")
    plain = config.experiment.measurement.changed(std=None)
    experiment = config.experiment.changed(measurement=plain)
    config = config.changed(experiment=experiment)
    generator = generator_of(seed, index)
    if scatter:
        config, measured, stiffness = hanging(config, generator)
    else:
        found = None
        while found is None:
            found = simulate(config, generator)
        measured, stiffness = found
    begin = time.perf_counter()
    fit = fit_declared(config, declared_model(config), measured)
    fitted = time.perf_counter()
    diagnosis = diagnose(fit, finest=SEARCH_MESH)
    interval = profile_intervals(diagnosis.fit)["bending_stiffness"]
    return {
        "right": not diagnosis.added and diagnosis.verdict != "unexplained",
        "session": config.cable.name,
        "verdict": diagnosis.verdict,
        "added": [item.candidate.name for item in diagnosis.added],
        "n": fit.model.n,
        "inside": within((interval.low, interval.high), stiffness),
        "in_band": in_band(diagnosis.fit, measured),
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


def width_over(wide, interval) -> float:
    """Ratio of the logarithmic widths of two intervals; inf where one is unbounded."""
    ends = [*(wide or (None, None)), *(interval or (None, None))]
    if any(not x for x in ends):
        return np.inf
    return float(np.log(ends[1] / ends[0]) / np.log(ends[3] / ends[2]))


def within(interval, true) -> bool:
    """Whether a stiffness lies in its interval, whose ends are None where it is unbounded."""
    low, high = interval or (np.nan, np.nan)
    return bool((-np.inf if low is None else low) <= true <= (np.inf if high is None else high))


if __name__ == "__main__":
    main()
