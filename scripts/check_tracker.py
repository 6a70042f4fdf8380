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

import dlo_casadi as dlo
from dlo_casadi.cable.estimate import Covariance
from dlo_casadi.cable.seen import with_unknowns

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
    known = with_unknowns(cable, cable.model, {}, std)
    found = known.metadata.uncertainty
    covariance = Covariance(found.names, found.covariance)
    return replace(known, metadata=replace(known.metadata, covariance=covariance))


def with_values(cable: dlo.FittedCable, values: dict[str, float]) -> dlo.FittedCable:
    """The cable with other values of its parameters."""
    p = cable.p.copy()
    for name, value in values.items():
        p[cable.model.names.index(name)] = value
    return replace(cable, p=p)


def with_effect(cable: dlo.FittedCable, name: str, values: dict[str, float]) -> dlo.FittedCable:
    """The cable with one more effect."""
    model = cable.model.with_effect(dlo.EFFECTS[name]())
    return with_values(with_unknowns(cable, model, {}, {}), values)


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
        delays, causes, tied, early, since = [], Counter(), 0, 0, []
        for k in range(runs):
            size = 10 ** (k / max(runs - 1, 1))
            delay, change = one_change(case, d, size, first + k)
            early += delay == -1
            if delay == -1 or change is None:
                causes["early" if delay == -1 else "not found"] += 1
                continue
            delays.append(delay)
            since.append(change.since - 31)
            causes[change.cause] += 1
            tied += bool(change.rivals)
            print(f"  {name} {size:.1f} std: after {delay}, {change}", flush=True)
        right = sum(x for k, x in causes.items() if k and k.startswith(case.right))
        print(
            f"{d}D {name}: {len(delays)} of {runs} found, after {np.median(delays or [0]):g} poses "
            f"(median), right {right}, with rivals {tied}, too early {early}; {dict(causes)}"
        )


# ---- speed ---------------------------------------------------------------------------------------


def speed(d: int, runs: int, first: int) -> None:
    """Processor time of an update: `runs` poses of a wandering gripper, 12 markers, n = 20."""
    rng = np.random.default_rng(first)
    cable, ways = rope(d), wandering(d, rng)
    poses = [seen(cable, next(ways), rng) for _ in range(runs)]
    for compiled in (False, True):
        known = {"bending_stiffness": 1e-3, "lumped_mass.mass": 1e-3}
        known |= {"torsional_stiffness": 1e-3} if d == 3 else {}
        tracker, times = uncertain(cable, known).tracker(STD, compiled=compiled), []
        for pose in poses:
            begun = time.process_time()
            tracker.update(pose)
            times.append(1e3 * (time.process_time() - begun))
        steady = times[40:]  # before, functions are prepared for many evaluations
        print(
            f"{d}D, {'C' if compiled else 'Python'}: median {np.median(steady):.1f} ms, "
            f"99 % {np.quantile(steady, 0.99):.1f} ms; the first update {times[0]:.0f} ms"
        )


PANELS = {"changes": changes, "speed": speed}


def main() -> None:
    """Run one panel."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("panel", choices=PANELS)
    parser.add_argument("--dimension", type=int, default=2, choices=(2, 3))
    parser.add_argument("--runs", type=int, default=5)
    parser.add_argument("--first", type=int, default=0, help="seed of the first run")
    chosen = parser.parse_args()
    begun = time.process_time()
    PANELS[chosen.panel](chosen.dimension, chosen.runs, chosen.first)
    print(f"{time.process_time() - begun:.0f} s")


if __name__ == "__main__":
    main()
