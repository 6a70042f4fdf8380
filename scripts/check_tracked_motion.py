"""How well a cable is tracked while it swings: beside a fit of the whole motion, and ahead of it.

    python scripts/check_tracked_motion.py [--count 20] [--first 0] [--where plane space]
    python scripts/check_tracked_motion.py --session session.yaml

Each cable is drawn from a prior (EI to 5 %, damping to 20 %) and simulated on a mesh twice as fine
as that of the tracker: 8 markers, std 0.4 mm, 100 pictures a second for 2 s. Every second one is
carried by its clamp from rest, the others swing already. Nine times a prediction 0.5 s ahead is
compared with the true motion. Of the first --batch ones in each room, the parameters are compared
with the minimum of all pictures at once (Gauss and Newton, with the same prior). With --session,
its recordings that are held out, by the cable that the rest of the session gives; no truth is read:
predictions are compared with what was measured half a second later, whose noise is added.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from time import process_time
from typing import Any, NamedTuple

import numpy as np
from harness import options
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation

import dlo_casadi as dlo
from dlo_casadi.cable.tracked import known_of, with_known
from dlo_casadi.config import load_config
from dlo_casadi.errors import DloError
from dlo_casadi.estimation.motion_fit import MESH_ERROR
from dlo_casadi.estimation.motion_start import LONGEST_STEP, begin, unknowns_in_motion
from dlo_casadi.estimation.motion_told import REPEATED
from dlo_casadi.estimation.problem import Priors, Problem
from dlo_casadi.estimation.recording import Recording
from dlo_casadi.estimation.unknowns import Unknowns
from dlo_casadi.model.tolerances import Tolerances
from dlo_casadi.sensing.measured_motion import MeasuredMotion
from dlo_casadi.sensing.noise import NoiseModel
from dlo_casadi.session.motions import read_motion

LENGTH, STD, RATE, DURATION, AHEAD = 0.6, 4e-4, 100, 2.0, 0.5
S = np.linspace(0.05, LENGTH, 8)
STIFFNESS, TORSION, DAMPING = 0.009, 0.007, 0.03
PRIOR = {"bending_stiffness": 0.05 * STIFFNESS, "damping_time": 0.2 * DAMPING}
NORMAL = 1.96
# Errors of the simulation, far below std of predictions.
EXACT = 3e-7


def rope(d: int, stiffness: float, damping: float, n: int = 12) -> dlo.FittedCable:
    """A hanging cable, exactly known."""
    torsion = {"torsional_stiffness": TORSION} if d == 3 else {}
    data = dlo.Cable(
        length=LENGTH, mass=0.06, diameter=0.008, bending_stiffness=stiffness, **torsion
    )
    held: dict[str, Any] = {"gravity": (*(0.0,) * (d - 1), -9.81), "boundary": ("clamped", "free")}
    known = dlo.known_cable(data, **held, model={"n": n, "effects": []})
    return known.with_damping(damping)


class Swing(NamedTuple):
    """Times (T,), true and measured points (T, K, d), and the clamp (T, d), its direction."""

    t: np.ndarray
    true: np.ndarray
    seen: np.ndarray
    start: np.ndarray
    turned: dict[str, Any]
    values: dict[str, float]
    begins: str

    def pose(self, k: int, *, seen: bool = False) -> dlo.Pose:
        """The fixtures at an instant, and what was measured."""
        points = {"points": self.seen[k], "at": S} if seen else {}
        return dlo.Pose(start=tuple(self.start[k]), **self.turned, **points)


def swing(d: int, seed: int) -> Swing:
    """A random cable in motion."""
    rng = np.random.default_rng((seed, d))
    values = {
        "bending_stiffness": STIFFNESS * float(np.exp(0.05 * rng.normal())),
        "damping_time": DAMPING * float(np.exp(0.2 * rng.normal())),
    }
    cable = rope(d, *values.values(), n=24)
    down = rng.uniform(0.4, 1.2)
    turned: dict[str, Any] = {"start_heading": -down}
    if d == 3:
        turned = {"start_orientation": Rotation.from_euler("y", down).as_quat()}
    # Those that swing already are seen from a second on.
    count, late = int(RATE * (DURATION + AHEAD)) + 1, RATE * (seed % 2)
    t = np.arange(late + count) / RATE
    aside = rng.normal(size=d) * (*(1.0,) * (d - 1), 0.3)
    aside *= rng.uniform(0.1, 0.25) / np.linalg.norm(aside)
    share = np.clip((t - 0.05) / rng.uniform(0.3, 0.6), 0.0, 1.0)
    way = (share**3 * (10 - 15 * share + 6 * share**2))[:, None] * aside
    moving = cable.simulate(t, start=way, **turned, tolerance=EXACT)
    t, way, true = t[late:], way[late:], moving.way.points(t[late:], S)
    seen = true + STD * rng.normal(size=true.shape)
    return Swing(t - t[0], true, seen, way, turned, values, "moving" if late else "at_rest")


def follow(one: Swing, d: int) -> tuple[Any, dict[str, list[float]]]:
    """A tracker after the motion; predictions off in std, processor time, probabilities."""
    cable = rope(d, STIFFNESS, DAMPING)
    known = known_of(cable).with_unknowns(cable.model, {}, PRIOR)
    tracker = with_known(cable, known).tracker(STD, compiled=True)
    told: dict[str, list[float]] = {"off": [], "ms": [], "p": [], "std": []}
    for k in range(int(DURATION * RATE) + 1):
        begun = process_time()
        update = tracker.advance(float(one.t[k]), one.pose(k, seen=True), begins=one.begins)
        told["ms"].append(1e3 * (process_time() - begun))
        if update.innovation.size:
            told["p"].append(update.probability)
        if k >= 20 and k % 20 == 0:
            later = range(k + 2, k + 51, 2)
            poses = [one.pose(j) for j in later]
            ahead = tracker.ahead(one.t[list(later)], poses, at=S)
            told["off"] += ((one.true[k + 50] - ahead.points[-1]) / ahead.std[-1]).ravel().tolist()
            told["std"].append(float(ahead.std[-1].max()))
    return tracker, told


def at_once(one: Swing) -> dict[str, tuple[float, float]]:
    """The cable's values at rest from all pictures at once, and their std.

    By Gauss and Newton, from the same prior: of the values at rest, of how far those in motion are
    from them, and of the first state.
    """
    count, d = int(DURATION * RATE) + 1, one.true.shape[2]
    model = rope(d, STIFFNESS, DAMPING).model
    unknowns = Unknowns(model, np.array([x in PRIOR for x in model.names]), model.nominal)
    fixed = {
        "bending_stiffness": STIFFNESS,
        "torsional_stiffness": TORSION,
        "damping_time": DAMPING,
    }
    unknowns = replace(unknowns, fixed=np.array([fixed[x] for x in model.names]))
    start = unknowns.pack(unknowns.fixed, np.zeros(0))
    exact = Tolerances(end=1e-9, heading=1e-9, rotation=1e-9)
    rows = {"start": one.start[:count]} if np.ptp(one.start, axis=0).any() else {}
    resting = {x: np.asarray(y) for x, y in one.turned.items()}
    resting |= {} if rows else {"start": one.start[0]}
    given = one.t[:count], one.seen[:count], S, one.t[:count], rows, resting
    measured = MeasuredMotion("all", *given, at_rest=one.begins == "at_rest", held_out=False)
    std = float(np.hypot(STD, MESH_ERROR * LENGTH))
    problem = Problem(unknowns, (), NoiseModel(std), Priors.of(exact, model))
    found = begin(Recording(measured, exact, LONGEST_STEP), problem, start, std)
    recording, moving = replace(found.recording, until=np.inf), unknowns_in_motion(unknowns)
    names, slope = unknowns.names, unknowns.derivatives(start)
    values = np.array([fixed[x] for x in names])
    known = np.array([PRIOR[x] for x in names]) / slope
    loose = np.array([REPEATED[x] for x in names]) * values / slope
    prior = np.concatenate([known, loose, recording.own_std(moving.model)])
    n, z, near = len(names), np.zeros(len(prior)), found.seen.first
    z[2 * n :] = found.own / prior[2 * n :]
    for _ in range(6):
        x = prior * z
        seen = recording.evaluate(
            moving, start + x[:n] + x[n : 2 * n], x[2 * n :], near, derivatives=True
        )
        near, by = seen.first, np.hstack([seen.by_theta, seen.by_theta, seen.by_own]) * prior / std
        information = np.eye(len(z)) + by.T @ by
        z = z - np.linalg.solve(information, z + by.T @ seen.residual / std)
    theta = start + (prior * z)[:n]
    sizes = np.sqrt(np.diag(np.linalg.inv(information))) * prior
    told = unknowns.derivatives(theta)
    found_values = unknowns.p(theta)[unknowns.free]
    rows_of = zip(names, found_values.tolist(), (sizes[:n] * told).tolist(), strict=True)
    return {name: (value, size) for name, value, size in rows_of}


def pose_of(known: MeasuredMotion, k: int, **points: Any) -> dlo.Pose:
    """The fixtures at an instant of a recording."""
    held = dict(known.resting)
    for name, rows in known.moving.items():
        at = np.clip(known.t[k], known.fixtures_t[0], known.fixtures_t[-1])
        held[name] = CubicSpline(known.fixtures_t, rows, axis=0)(at)
    return dlo.Pose(**{name: x.tolist() for name, x in held.items()}, **points)


def recorded(session: Path) -> None:
    """Recordings that a session holds out, by the cable that the rest of it gives."""
    config = load_config(session)
    cable = dlo.fit(session).cable
    print(cable.params)
    for motion in (x for x in config.experiment.motions if x.role == "held_out"):
        known, off, low, ms = read_motion(config, motion), [], [], []
        noise = float(np.hypot(known.noise, MESH_ERROR * cable.length))
        tracker = cable.tracker(known.noise, compiled=True)
        begins = "at_rest" if known.at_rest else "moving"
        for k, t in enumerate(known.t.tolist()):
            seen = np.isfinite(known.points[k, :, 0])
            begun = process_time()
            pose = pose_of(known, k, points=known.points[k, seen], at=known.s[seen])
            update = tracker.advance(t, pose, begins=begins)
            ms.append(1e3 * (process_time() - begun))
            low += [update.probability] if update.innovation.size else []
            last = int(np.searchsorted(known.t, t + AHEAD - 1e-9))
            if update.innovation.size and k % 20 == 0 and last < len(known.t):
                later = [*range(k + 2, last, 2), last]
                ahead = tracker.ahead(
                    known.t[later], [pose_of(known, j) for j in later], at=known.s
                )
                gap = (known.points[last] - ahead.points[-1]) / np.hypot(ahead.std[-1], noise)
                off += gap[np.isfinite(gap[:, 0])].ravel().tolist()
        print(
            f"{motion.file}, {begins}: noise {1e3 * known.noise:.2g} mm, {len(known.t)} instants, "
            f"{np.mean(np.abs(off) < NORMAL):.1%} of {len(off)} inside {AHEAD} s ahead (root mean "
            f"square {np.sqrt(np.mean(np.square(off))):.2f} std); probabilities < 0.05: "
            f"{np.mean(np.array(low) < 0.05):.3f}; {np.median(ms):.1f} ms an instant"
        )
        print(tracker.params)


def main() -> None:
    """Follow random swings, or the recordings of a session."""
    parser = options(__doc__, count=(20, "swings in each room"), first=True, where=True)
    parser.add_argument("--batch", type=int, default=3, help="compared with all pictures at once")
    parser.add_argument("--session", type=Path, help="a session with recordings")
    chosen = parser.parse_args()
    if chosen.session:
        recorded(chosen.session)
        return
    for where in chosen.where:
        d = 2 if where == "plane" else 3
        total: dict[str, list[float]] = {"off": [], "ms": [], "p": [], "std": []}
        params: list[float] = []
        for k in range(chosen.first, chosen.first + chosen.count):
            one = swing(d, k)
            try:
                tracker, told = follow(one, d)
            except DloError as error:
                print(f"{where} {k}: {error}")
                continue
            inside = np.mean(np.abs(told["off"]) < NORMAL)
            away = {
                name: (tracker.params[name].value - x) / tracker.params[name].std
                for name, x in one.values.items()
            }
            params += away.values()
            print(
                f"{where} {k}, {one.begins}: {inside:.1%} of {AHEAD} s ahead inside, largest std "
                f"{1e3 * np.median(told['std']):.2g} mm; "
                + ", ".join(f"{name} {x:+.2f} std" for name, x in away.items()),
                flush=True,
            )
            for key, x in told.items():
                total[key] += x
            if k < chosen.first + chosen.batch:
                for name, (value, size) in at_once(one).items():
                    found = tracker.params[name]
                    print(
                        f"  {name}: {(found.value - value) / size:+.3f} std from all at once, std "
                        f"{100 * (found.std / size - 1):+.1f} %",
                        flush=True,
                    )
        print(
            f"{where}: {np.mean(np.abs(total['off']) < NORMAL):.1%} of {len(total['off'])} inside; "
            f"parameters {np.mean(np.abs(params) < NORMAL):.1%} inside of {len(params)}; "
            f"probabilities < 0.05: {np.mean(np.array(total['p']) < 0.05):.3f}; "
            f"{np.median(total['ms']):.1f} ms an instant, 99 % {np.quantile(total['ms'], 0.99):.1f}"
        )


if __name__ == "__main__":
    main()
