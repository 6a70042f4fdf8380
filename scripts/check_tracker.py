"""How well a cable is tracked: against fits of all poses, drifts, changes, false alarms, outliers.

    python scripts/check_tracker.py changes --runs 10 --dimension 2

Sessions are simulated by this package: 12 markers in each of the poses of a wandering gripper. What
each panel prints is described where it is made.
"""

from __future__ import annotations

import argparse
import time
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import cache
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation
from scipy.stats import kstest, norm

import dlo_casadi as dlo
from dlo_casadi.cable.tracked import known_of, with_known
from dlo_casadi.codegen.segments import compile_segments
from dlo_casadi.equilibrium.batch import BatchEquilibrium
from dlo_casadi.estimation.descent import descend
from dlo_casadi.linear_mixed import LinearMixed
from dlo_casadi.tracking.tracker import BETWEEN_ALARMS, LOOK, ODD, page_sum

LENGTH, STD = 0.6, 4e-4
S = np.linspace(0.04, 0.56, 12)
STIFFNESS, TORSION, LOAD = 0.009, 0.007, 0.01


@cache
def rope(d: int, effects: str = "weight", n: int = 20) -> dlo.FittedCable:
    """A cable between two clamps, exactly known."""
    torsion = {"torsional_stiffness": TORSION} if d == 3 else {}
    data = dlo.Cable(
        length=LENGTH, mass=0.06, diameter=0.008, bending_stiffness=STIFFNESS, **torsion
    )
    weight = {"name": "lumped_mass", "parameters": {"mass": LOAD, "position": 0.4}}
    model = {"n": n, "effects": [weight] if effects == "weight" else []}
    gravity = (*(0.0,) * (d - 1), -9.81)
    return dlo.known_cable(data, gravity=gravity, boundary=("clamped", "clamped"), model=model)


def uncertain(cable: dlo.FittedCable, std: dict[str, float]) -> dlo.FittedCable:
    """The cable with some of its parameters known to a standard deviation."""
    return with_known(cable, known_of(cable).with_unknowns(cable.model, {}, std))


def with_values(cable: dlo.FittedCable, values: dict[str, float]) -> dlo.FittedCable:
    """The cable with other values of its parameters."""
    p = cable.p.copy()
    for name, value in values.items():
        p[cable.model.names.index(name)] = value
    return replace(cable, p=p)


def with_effect(cable: dlo.FittedCable, name: str, values: dict[str, float]) -> dlo.FittedCable:
    """The cable with one more effect."""
    model = cable.model.with_effect(dlo.EFFECTS[name]())
    return with_known(cable, known_of(cable).with_unknowns(model, values, {}))


def wandering(d: int, rng: np.random.Generator) -> Iterator[dict[str, Any]]:
    """Fixtures of one pose after the other: the end wanders, as a gripper that works."""
    phase, rate = rng.uniform(0, 2 * np.pi, 5), rng.uniform(0.15, 0.35, 5)
    k = 0
    while True:
        u, v, w, a, b = np.sin(phase + rate * k)
        k += 1
        if d == 2:
            yield {
                "start": (0.0, 0.0),
                "end": (0.4 + 0.06 * u, 0.05 * v),
                "start_heading": -0.7 + 0.3 * a,
                "end_heading": 0.7 + 0.3 * b,
            }
            continue
        first = Rotation.from_euler("yz", [0.7, 0.2 * a]).as_quat()
        last = Rotation.from_euler("yzx", [-0.7, 0.2 * b, 0.3 * w]).as_quat()
        yield {
            "start": (0.0, 0.0, 0.0),
            "end": (0.4 + 0.06 * u, 0.05 * w, 0.05 * v),
            "start_orientation": first,
            "end_orientation": last,
        }


def seen(
    cable: dlo.FittedCable,
    held: dict[str, Any],
    rng: np.random.Generator,
    std: float = STD,
    shown: dict[str, Any] | None = None,
) -> dlo.Pose:
    """Markers of the cable between fixtures, which are `shown` otherwise than they are."""
    points = cable.solve(**held).curve.at(S)
    points = points + std * rng.normal(size=points.shape)
    return dlo.Pose(points=points, at=S, **(shown or held))


# ---- what changed --------------------------------------------------------------------------------


@dataclass(frozen=True)
class Case:
    """A change: the cable before and after, clips of both, and the names that are right."""

    before: dlo.FittedCable
    after: dlo.FittedCable
    right: str
    clips: Callable[[dict[str, Any], bool], list[dict[str, Any]]] | None = None


def cases(d: int) -> dict[str, Case]:
    """Changes of the panel."""
    loaded, bare = rope(d), rope(d, "none")
    weight, tilt = "lumped_mass", "gravity_tilt"
    angle = {f"{tilt}.angle" if d == 2 else f"{tilt}.angle_x": np.radians(2)}

    def clip(held: dict[str, Any], slipped: bool) -> list[dict[str, Any]]:
        middle = bare.solve(**held).curve.at(0.3)[0]
        low = middle + np.array([0.0] * (d - 1) + [0.02])
        return [{"kind": "pinned", "at": 0.305 if slipped else 0.3, "place": low}]

    return {
        "weight off": Case(loaded, with_values(loaded, {"lumped_mass.mass": 0.0}), weight),
        "weight on": Case(
            bare,
            with_effect(bare, weight, {f"{weight}.mass": LOAD, f"{weight}.position": 0.25}),
            weight,
        ),
        "clip slip": Case(bare, bare, "clip_slip", clip),
        "softer": Case(
            bare, with_values(bare, {"bending_stiffness": 0.75 * STIFFNESS}), "bending_stiffness"
        ),
        "tilt": Case(bare, with_effect(bare, tilt, angle), tilt),
    }


def shift(case: Case, d: int, rng: np.random.Generator) -> float:
    """Root mean square over poses of the distance [m] of all markers that the change moves."""
    total, ways = 0.0, wandering(d, rng)
    for _ in range(8):
        held = next(ways)
        points = [
            cable.solve(**held, clips=case.clips(held, moved) if case.clips else ()).curve.at(S)
            for cable, moved in ((case.before, False), (case.after, True))
        ]
        total += float(np.square(points[1] - points[0]).sum()) / 8
    return float(np.sqrt(total))


def one_change(case: Case, d: int, size: float, seed: int) -> tuple[int | None, Any]:
    """Poses to the alarm after a change of `size` std a pose at the 31st pose, and the verdict."""
    rng = np.random.default_rng(seed)
    std = shift(case, d, np.random.default_rng(seed)) / size
    names = case.before.model.names
    known = {"bending_stiffness": 0.1 * STIFFNESS, "torsional_stiffness": 0.1 * TORSION}
    known |= {"lumped_mass.mass": 0.1 * LOAD}
    tracker = uncertain(case.before, {k: x for k, x in known.items() if k in names}).tracker(std)
    ways = wandering(d, rng)
    alarm = None
    for k in range(120):
        held, changed = next(ways), k >= 30
        cable = case.after if changed else case.before
        clips = {"clips": case.clips(held, changed)} if case.clips else {}
        shown = {**held, "clips": case.clips(held, False)} if case.clips else None
        update = tracker.update(seen(cable, {**held, **clips}, rng, std, shown))
        if update.change and not changed:
            return -1, update.change
        if update.change and alarm is None:
            alarm = k - 29
        if update.change and update.change.decided:
            return alarm, update.change
    return alarm, tracker.change


def changes(d: int, runs: int, first: int) -> None:
    """Poses to the alarm and the cause, for changes of 1 to 10 std a pose.

    That is the root of the sum of the squares of all coordinates' shifts.
    """
    for name, case in cases(d).items():
        if ONLY and name not in ONLY:
            continue
        delays, causes, early = [], Counter(), 0
        right, named = 0, 0
        for k in range(runs):
            size = 10 ** (k / max(runs - 1, 1))
            delay, change = one_change(case, d, size, first + k)
            early += delay == -1
            if delay == -1 or change is None:
                causes["early" if delay == -1 else "not found"] += 1
                continue
            delays.append(delay)
            causes[change.cause] += 1
            right += str(change.cause).startswith(case.right)
            named += any(x.startswith(case.right) for x in (str(change.cause), *change.rivals))
            print(f"  {name} {size:.1f} std: after {delay}, {change}", flush=True)
        print(
            f"{d}D {name}: {len(delays)} of {runs} found, after {np.median(delays or [0]):g} poses "
            f"(median), right {right}, right or a rival {named}, too early {early}; {dict(causes)}"
        )


# ---- where nothing changes -----------------------------------------------------------------------


def at_once(cable: dlo.FittedCable, poses: list[dlo.Pose]) -> tuple[Any, np.ndarray]:
    """The cable after all poses, by Gauss and Newton's method for all at once, and its std."""
    before, known, model = known_of(cable), cable.metadata.uncertainty, cable.model
    held = [cable.solve(pose.changed(points=None, at=None)) for pose in poses]
    batch = BatchEquilibrium(known.pose_scatter.within(model), [one.pose for one in held])
    by_p, by_rest, by_deviation = known.ways_in(model)
    count, z = len(known.names), np.zeros(len(known.names))
    shapes = batch.start_shapes(np.array([one.equilibrium.x for one in held]))
    for _ in range(8):
        now = before.moved(by_p[:, :count] @ z, by_rest[:, :count] @ z)
        rise = np.where([q.log for q in model.parameters], now.p / np.where(cable.p, cable.p, 1), 1)
        shapes, _ = batch.solve(shapes, now.p, now.rest)
        ways = by_rest, rise[:, None] * by_p, by_deviation
        along = batch.by_rest(shapes, now.p, now.rest, *ways)
        rows = [
            (
                ((pose.points - told.curve.at(S)) / STD).ravel(),
                -told.curve.moved(S, change.curve, change.knots, marked=True).reshape(
                    len(S) * model.node.dimension, -1
                )
                / STD,
            )
            for pose, (told, change) in zip(
                poses, batch.observe(shapes, now.p, now.rest, along), strict=True
            )
        ]
        own = rows[0][1].shape[1] - count
        mixed = LinearMixed(
            [r for r, _ in rows],
            [columns[:, :count] for _, columns in rows],
            [columns[:, count:] for _, columns in rows],
            np.zeros((len(rows), own)),
            np.ones(own),
            z,
            np.eye(count),
        )
        z = z - np.linalg.solve(mixed.normal.hessian, mixed.normal.gradient)
    scale = [dict(zip(model.names, rise, strict=True)).get(name, 1.0) for name in known.names]
    root = np.array(scale)[:, None] * known.root
    variances = np.diag(root @ np.linalg.inv(mixed.normal.hessian) @ root.T)
    return now, np.sqrt(variances)


def batch(d: int, runs: int, first: int) -> None:
    """Sessions of 12 poses: tracked from the fit of the first 6, against all others at once.

    And, unless --at-once, against the fit of all 12: with the fixtures' scatter of the first fit,
    which a tracker keeps, and as it is, which estimates that anew.
    """
    torsion = {"torsional_stiffness": TORSION} if d == 3 else {}
    data = dlo.Cable(
        length=LENGTH,
        mass=0.06,
        diameter=0.008,
        rest_shape="straight",
        bending_stiffness=STIFFNESS,
        **torsion,
    )
    known: dict[str, Any] = {"gravity": (*(0.0,) * (d - 1), -9.81), "std": STD}
    known |= {"boundary": ("clamped", "clamped"), "diagnosis": {"enabled": False}}
    away: dict[str, list[float]] = {}
    wider: dict[str, list[float]] = {}
    for k in range(runs):
        rng = np.random.default_rng(first + k)
        stiffness = STIFFNESS * rng.uniform(0.7, 1.4)
        cable, ways = (
            with_values(rope(d, "none"), {"bending_stiffness": stiffness}),
            wandering(d, rng),
        )
        poses = [seen(cable, next(ways), rng) for _ in range(12)]
        first_fit, *whole = (
            dlo.Session(data, listed, **known, model={"n": 20}).fit()
            for listed in ([poses[:6]] if AT_ONCE else [poses[:6], poses])
        )
        half = first_fit.cable
        fits = {}
        for fit in (one.fit for one in whole):
            kept = replace(fit.problem.priors, scatter=first_fit.fit.problem.priors.scatter)
            fits = {"fit, scatter kept": descend(fit.reweighed(priors=kept)), "fit": fit}
        tracker = half.tracker(STD)
        for pose in poses[6:]:
            tracker.update(pose)
        once, std = at_once(half, poses[6:])
        values = dict(zip(once.model.names, once.p, strict=True))
        for name, size in zip(half.metadata.uncertainty.names, std, strict=True):
            found, told = tracker.params[name], {"at once": (values[name], size)}
            for key, fit in fits.items():
                names, covariance = fit.named_covariance
                variance = covariance[names.index(name), names.index(name)]
                told[key] = fit.p[fit.model.names.index(name)], float(np.sqrt(variance))
            for key, (value, other) in told.items():
                away.setdefault(key, []).append((found.value - value) / other)
                wider.setdefault(key, []).append(found.std / other - 1)
    for key in away:
        off, wide = np.abs(away[key]), np.abs(wider[key])
        print(
            f"{d}D, {key}: {len(off)} parameters of {runs} sessions: {np.mean(off < 0.1):.0%} "
            f"within 0.1 std (largest {off.max():.3f}), {np.mean(wide < 0.05):.0%} with std to 5 % "
            f"(median {100 * np.median(wide):.1f} %, largest {100 * wide.max():.1f} %)"
        )


def prior_of(cable: dlo.FittedCable, rng: np.random.Generator) -> dlo.FittedCable:
    """The cable as it may be known before: drawn from what is said of it."""
    std = {"bending_stiffness": 0.05 * STIFFNESS, "torsional_stiffness": 0.05 * TORSION}
    std |= {"lumped_mass.mass": 0.05 * LOAD}
    std = {name: x for name, x in std.items() if name in cable.model.names}
    values = dict(zip(cable.model.names, cable.p, strict=True))
    drawn = {name: values[name] + x * rng.normal() for name, x in std.items()}
    return uncertain(with_values(cable, drawn), std)


def ideal(stds: np.ndarray, before: float, rate: float, steps: np.ndarray) -> np.ndarray:
    """Probability, pose by pose, that the 95 % interval of an exact Kalman filter holds the truth.

    Its variance P grows by the square of `rate` before each pose, but the truth moves by `steps`:
    with the gain K, and r^2 of what a pose tells alone, its error has the mean m and variance v,

        m = (1 - K) (m - step),   v = (1 - K)^2 v + K^2 r^2,   K = 1 - P / (P_before + rate^2)
    """
    out, m, v, known = [], 0.0, before**2, before**2
    for std, step in zip(stds, steps, strict=True):
        ahead, known = known + rate**2, std**2
        gain = 1 - known / ahead
        m, v = (1 - gain) * (m - step), (1 - gain) ** 2 * v + gain * known
        out.append(np.diff(norm.cdf((np.array([-1.96, 1.96]) * std - m) / np.sqrt(v)))[0])
    return np.array(out)


def drift(d: int, runs: int, first: int) -> None:
    """EI walks, or falls by 30 % over 200 poses: share of 95 % intervals that hold it, and alarms.

    Told is the rate of a random walk: the true one, where it walks. Where it falls steadily by x a
    pose, it is either that of a walk which goes as far in as many poses, and intervals are too
    wide; or that for which lag and noise have together the variance that the filter states: with r
    the std of EI from one pose, lag x r / rate and noise rate r / 2 give rate^3 = 2 x^2 r.
    """
    n, name = 200, "bending_stiffness"
    fall = np.full(n, -0.3 * STIFFNESS / n)
    fall[0] = 0.0
    far = 0.3 * STIFFNESS / np.sqrt(n)
    inside: dict[str, list[bool]] = {}
    exact: dict[str, list[float]] = {}
    alarms: Counter[str] = Counter()
    for k in range(runs):
        rng = np.random.default_rng(first + k)
        own = uncertain(rope(d, "none"), {name: 0.05 * STIFFNESS}).tracker(STD)
        own.update(seen(rope(d, "none"), next(wandering(d, rng)), rng))
        after = own.params[name]  # Gaussian in its logarithm
        alone = STIFFNESS * ((after.std / after.value) ** -2 - 0.05**-2) ** -0.5
        balanced = float(np.cbrt(2 * fall[1] ** 2 * alone))
        walk = 0.2 * far * np.random.default_rng((first + k, 1)).normal(size=n)  # of its own seed
        tried = {
            "walks at the rate": (0.2 * far, walk),
            "falls, rate of a walk as far": (far, fall),
            "falls, rate that balances lag and noise": (balanced, fall),
        }
        for said, (rate, steps) in tried.items():
            rng = np.random.default_rng(first + k)
            ways, cable = wandering(d, rng), rope(d, "none")
            tracker = prior_of(cable, rng).tracker(STD, drift={name: rate})
            stds = []
            for stiffness in STIFFNESS + np.cumsum(steps):
                now = with_values(cable, {name: stiffness})
                alarms[said] += tracker.update(seen(now, next(ways), rng)).change is not None
                found = tracker.params[name]
                stds.append(found.std)
                inside.setdefault(said, []).append(abs(found.value - stiffness) < 1.96 * found.std)
            chances = ideal(np.array(stds), 0.05 * STIFFNESS, rate, steps)
            exact.setdefault(said, []).append(float(chances.mean()))
    for said, held in inside.items():
        expected = 0.95 if said.startswith("walks") else np.mean(exact[said])
        print(
            f"{d}D, {said}: {runs} runs of {n} poses, {np.mean(held):.1%} inside, an exact Kalman "
            f"filter {expected:.1%}; alarms {alarms[said]}"
        )


def clean(d: int, runs: int, first: int) -> None:
    """Alarms in `runs` hundreds of clean poses: every 100 poses a tracker with a prior anew.

    And what the tests raise in 100,000 poses if innovations are exactly Gaussian and white, which
    the distribution of the poses' probabilities tells. Page's test is simulated. A look at what may
    have changed has a chance of at most 1 in 2 `BETWEEN_ALARMS`, by Bonferroni.
    """
    rng = np.random.default_rng(first)
    cable, ways, alarms, refused, low = rope(d), wandering(d, rng), 0, 0, []
    compile_segments(cable.model)  # the same numbers, sooner
    listed = [seen(cable, next(ways), rng, 0.0) for _ in range(100)]
    for _ in range(runs):
        tracker = prior_of(cable, rng).tracker(STD)
        for pose in listed:
            points = np.asarray(pose.points) + STD * rng.normal(size=(len(S), d))
            update = tracker.update(pose.changed(points=points))
            refused += update.refused
            low.append(update.probability)
            if update.change:
                alarms += 1
                print(f"  {update.change}", flush=True)
                break
    shares = ", ".join(f"{np.mean(np.array(low) < p):.4f} < {p:g}" for p in (0.05, 0.01, 0.001))
    print(
        f"{d}D: {len(low)} clean poses, {alarms} alarms, {refused} refused; probabilities: "
        f"{shares}; uniform by Kolmogorov and Smirnov: p = {kstest(low, 'uniform').pvalue:.2f}"
    )
    page, looks = page_alarms(len(S) * d, 1_000_000, rng) / 10, (1 / LOOK + ODD) / BETWEEN_ALARMS
    print(
        f"{d}D, exact Gaussians, in 100,000 poses: {page:.1f} alarms of Page's test, at most "
        f"{1e5 * looks / 2:.1f} of likelihood ratios"
    )


def page_alarms(size: int, poses: int, rng: np.random.Generator) -> int:
    """Alarms of Page's test of the variance of innovations of this size, in many poses.

    A hundred series at a time; a series begins anew after an alarm, as a tracker does.
    """
    total, sums = 0, np.zeros(100)
    for _ in range(poses // len(sums)):
        sums = page_sum(sums, rng.chisquare(size, len(sums)), size)
        alarmed = sums > np.log(2 * BETWEEN_ALARMS)
        total += int(alarmed.sum())
        sums[alarmed] = 0.0
    return total


def outliers(d: int, runs: int, first: int) -> None:
    """One pose in twenty is seen wrong: distance of the parameters from those without it [std]."""
    away, missed = [], 0
    for k in range(runs):
        rng = np.random.default_rng(first + k)
        cable, ways = rope(d), wandering(d, rng)
        both = [prior_of(cable, np.random.default_rng(k)).tracker(STD) for _ in range(2)]
        for _ in range(60):
            pose = seen(cable, next(ways), rng)
            if rng.uniform() < 0.05:
                points = np.asarray(pose.points).copy()
                if rng.uniform() < 0.5:  # another strand
                    points += 0.02 * rng.normal(size=d)
                else:  # a hand
                    at = rng.integers(0, 8)
                    points[at : at + 4] += 0.03 * rng.normal(size=(4, d))
                missed += not both[0].update(pose.changed(points=points)).refused
                continue
            for tracker in both:
                tracker.update(pose)
        for name, one in both[1].params.items():
            if not one.fixed:
                away.append(abs(both[0].params[name].value - one.value) / one.std)
    print(f"{d}D: {runs} runs of 60 poses, largest distance {max(away):.2f} std, missed {missed}")


# ---- speed ---------------------------------------------------------------------------------------


def speed(d: int, runs: int, first: int) -> None:
    """Processor time of an update: `runs` poses of a wandering gripper, 12 markers, n = 20.

    After the first 40, in which functions are prepared for many evaluations.
    """
    rng = np.random.default_rng(first)
    cable, ways = rope(d), wandering(d, rng)
    poses = [seen(cable, next(ways), rng) for _ in range(40 + runs)]
    for compiled in (False, True):
        known = {"bending_stiffness": 1e-3, "lumped_mass.mass": 1e-3}
        known |= {"torsional_stiffness": 1e-3} if d == 3 else {}
        tracker, times = uncertain(cable, known).tracker(STD, compiled=compiled), []
        for pose in poses:
            begun = time.process_time()
            tracker.update(pose)
            times.append(1e3 * (time.process_time() - begun))
        steady = times[40:]
        print(
            f"{d}D, {'C' if compiled else 'Python'}: median {np.median(steady):.1f} ms, "
            f"99 % {np.quantile(steady, 0.99):.1f} ms; the first update {times[0]:.0f} ms"
        )


# Changes that are tried; all if it is empty. What sessions are compared with.
ONLY: list[str] = []
AT_ONCE: list[bool] = []
PANELS = {
    "batch": batch,
    "changes": changes,
    "clean": clean,
    "drift": drift,
    "outliers": outliers,
    "speed": speed,
}


def main() -> None:
    """Run one panel."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("panel", choices=PANELS)
    parser.add_argument("--dimension", type=int, default=2, choices=(2, 3))
    parser.add_argument("--runs", type=int, default=5)
    parser.add_argument("--seed", "--first", type=int, default=0, help="of the first run")
    parser.add_argument("--at-once", action="store_true", help="compare with no fit of all poses")
    parser.add_argument("--only", nargs="*", default=[], help="changes, such as 'weight off'")
    chosen = parser.parse_args()
    ONLY.extend(chosen.only)
    AT_ONCE.extend([True] * chosen.at_once)
    begun = time.process_time()
    PANELS[chosen.panel](chosen.dimension, chosen.runs, chosen.seed)
    print(f"{time.process_time() - begun:.0f} s")


if __name__ == "__main__":
    main()
