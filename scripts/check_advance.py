"""Steps in time in C: random motions, speed, and growth with the mesh.

    python scripts/check_advance.py [--count 1000] [--only NUMBER] [--where plane space]
    python scripts/check_advance.py --speed

Random cables (stiffness, damping, drag, rest shape) between random kinds of ends, in the plane and
in space, whose fixtures both move and turn for 2 s: how many motions end, with which status, how
far ends are from their fixtures, and whether a number is not finite. A step without a solution is
halved, up to five times, and the motion ends where that does not help. With --speed: time a step
and node for n = 10 to 200, and of n = 20 in space real time over processor time at steps whose way
is within 0.5 % of the length of that of steps of 0.5 ms.

Exit code 1 if a number is not finite, an end is off by more than 1e-8 lengths, the growth is above
1.3, or n = 20 in space is slower than 20 times real time.
"""

import sys
from collections import Counter
from collections.abc import Sequence
from time import process_time
from typing import Any, NamedTuple

import numpy as np
from harness import options, run
from numpy.typing import NDArray

from dlo_casadi.codegen.fit_steps import CompiledSteps, compiled_steps
from dlo_casadi.effects import AirDrag, CableData, PinFriction, TurningLoss
from dlo_casadi.equilibrium.pose import HeldPose
from dlo_casadi.equilibrium.solve import solve_equilibrium
from dlo_casadi.errors import EquilibriumError
from dlo_casadi.model.cable_model import CableModel
from dlo_casadi.motion.state import Fixtures, State
from dlo_casadi.motion.steps import Moving
from dlo_casadi.motion.system import MovingCable

FloatArray = NDArray[np.floating]
ENDS = [
    ("clamped", "free"),
    ("pinned", "pinned"),
    ("clamped", "pinned"),
    ("clamped", "clamped"),
    ("pinned", "free"),
]
SECONDS, DT, N = 2.0, 0.005, 12
# Largest distance of an end from its fixture, in lengths; growth of the time a step and node; real
# time over processor time; distance of the tip, in lengths.
OFF, GROWTH, FASTER, NEAR = 1e-8, 1.3, 20.0, 5e-3
HALVINGS = 5


class Case(NamedTuple):
    """A random motion."""

    number: int
    where: str
    seed: int


class Row(NamedTuple):
    """What became of it; `apart`: of the ends where it ended too early, in lengths."""

    status: str
    until: float
    off: float
    finite: bool
    halved: int
    apart: float = 0.0


def model_of(where: str, ends: tuple[str, str], n: int = N) -> CableModel:
    """A cable of 1 m with everything that damps."""
    spatial = where == "space"
    cable = CableData(1.0, 0.1, 0.008, 0.02, "rope", damping_time=0.02)
    effects: list[Any] = [AirDrag()]
    if "pinned" in ends:
        effects.append(PinFriction())
    if spatial:
        cable = CableData(1.0, 0.1, 0.008, 0.02, "rope", False, 0.015, 0.02)
        effects.append(TurningLoss())
    gravity = (*(0.0,) * (1 + spatial), -9.81)
    kinds = {"start": ends[0], "end": ends[1]}
    return CableModel(cable, n, gravity=gravity, effects=tuple(effects), **kinds)


def drawn(rng: np.random.Generator, model: CableModel) -> MovingCable:
    """The model with random parameters."""
    values = {
        "bending_stiffness": 10 ** rng.uniform(-3, -0.5),
        "torsional_stiffness": 10 ** rng.uniform(-3, -0.5),
        "damping_time": 10 ** rng.uniform(-3, -1),
        "air_drag.coefficient": rng.uniform(0, 2),
        "pin_friction.moment": rng.choice([0.0, 1e-3]),
        "turning_loss.share": rng.choice([0.0, 1.0]),
    }
    p = np.array([values.get(q.name, q.nominal) for q in model.parameters])
    rest = model.rest_basis @ rng.normal(0.0, 1.0, model.n_coefficients)
    return MovingCable(model, p, rest)


class Path:
    """Fixtures that sway and turn about a pose, from rest: sums of three sines."""

    def __init__(self, rng: np.random.Generator, cable: MovingCable, pose: HeldPose) -> None:
        d, b = cable.d, cable.b
        self.cable, self.pose = cable, pose.vector
        self.rates = rng.uniform(1.0, 12.0, 3)
        sizes = 10 ** rng.uniform(-2.5, -1, 3) / 3
        self.places = rng.normal(size=(3, 2, d)) * sizes[:, None, None]
        self.turns = 3 * rng.normal(size=(3, 2, b)) * sizes[:, None, None]

    def at(self, t: float) -> Fixtures:
        """The fixtures at a time [s]."""
        node, w = self.cable.model.node, self.rates
        d, c = node.dimension, node.coordinates
        moved = np.tensordot(1 - np.cos(w * t), self.places, 1)
        pose = self.pose.copy()
        pose[: 2 * d] += moved.ravel()
        turns = np.tensordot(1 - np.cos(w * t), self.turns, 1)
        for k in (0, 1):
            own = slice(2 * d + k * c, 2 * d + (k + 1) * c)
            pose[own] = node.moved(pose[own], turns[k])
        rates = np.tensordot(w * np.sin(w * t), self.places, 1)
        changed = np.tensordot(w**2 * np.cos(w * t), self.places, 1)
        return self.cable.fixtures(pose, rates, changed)


def random_pose(rng: np.random.Generator, model: CableModel) -> HeldPose:
    """Ends 0.3 to 0.8 lengths apart, directions about the chord."""
    d, held = model.node.dimension, {}
    if model.end.place:
        held["end"] = (rng.uniform(0.3, 0.8), *rng.normal(0, 0.1, d - 1).tolist())
    for side in ("start", "end"):
        if getattr(model, side).direction:
            turn = rng.normal(0, 0.4, model.node.increment)
            x = model.node.moved(np.array(model.node.identity, float), turn)
            held[f"{side}_{model.node.direction}"] = model.node.declared(x)
    return HeldPose(start=(0.0,) * d, **held)


def begun(cable: MovingCable, pose: HeldPose) -> tuple[Moving, State]:
    """The cable at rest."""
    eq = solve_equilibrium(cable.model, cable.p, cable.rest, pose)
    state = cable.at_rest(eq, cable.fixtures(pose.vector))
    return Moving(state, np.hstack([state.alpha, state.a])), state


def moved(steps: CompiledSteps, path: Path, first: Moving, dt: float, seconds: float) -> Row:
    """The random motion, in steps dt that are halved where they have no solution."""
    cable, now, t = path.cable, steps.records.recorded(first), 0.0
    off, halved, finite = 0.0, 0, True
    while t < seconds - 1e-9:
        status, ahead, parts = "no_step", now, 1
        for halving in range(HALVINGS + 1):
            parts, ahead = 2**halving, now
            for k in range(parts):
                fixtures = path.at(t + (k + 1) * dt / parts)
                ahead, status = steps.advance(ahead, fixtures, dt / parts)
                if status != "ok":
                    break
            if status == "ok":
                break
        if status != "ok":
            ends = np.diff(path.at(t + dt).places, axis=0)
            apart = float(np.linalg.norm(ends)) / cable.model.cable.length
            return Row(status, t, off, finite, halved, apart)
        halved += parts > 1
        now, t = ahead, t + dt
        numbers = np.concatenate([now[name].ravel() for name in steps.records.record.names or ()])
        finite = finite and bool(np.isfinite(numbers).all())
        for k, node in cable.held:
            distance = np.linalg.norm(now["r"][0, node] - fixtures.places[k])
            off = max(off, float(distance) / cable.model.cable.length)
    return Row("ok", t, off, finite, halved)


def work(case: Case) -> Row:
    """One random motion."""
    rng = np.random.default_rng((case.seed, case.number))
    model = model_of(case.where, ENDS[case.number // 2 % len(ENDS)])
    while True:
        cable = drawn(rng, model)
        pose = random_pose(rng, model)
        try:
            first, _ = begun(cable, pose)
        except EquilibriumError:
            continue
        return moved(compiled_steps(cable, ("-O2",)), Path(rng, cable, pose), first, DT, SECONDS)


def summary(rows: Sequence[Row]) -> str:
    """What became of all so far."""
    counts = dict(Counter(row.status for row in rows))
    worst, halved = max(row.off for row in rows), sum(row.halved > 0 for row in rows)
    wrong = sum(not row.finite for row in rows)
    return (
        f"{len(rows)} motions: {counts}, {halved} with halved steps, {wrong} not finite, "
        f"ends off by {worst:.1e} L at most"
    )


# ---- speed -------------------------------------------------------------------------------------


def carried(where: str, n: int, dt: float) -> tuple[float, FloatArray]:
    """Processor time [s] a step, and the way of the middle, of a cable that is carried."""
    model = model_of(where, ("clamped", "clamped"), n)
    cable = MovingCable(model, model.nominal, np.zeros(model.chain.n_rests))
    rng = np.random.default_rng(1)
    pose = random_pose(rng, model)
    steps, path = compiled_steps(cable, ("-O2",)), Path(rng, cable, pose)
    first, _ = begun(cable, pose)
    now, count = steps.records.recorded(first), round(SECONDS / dt)
    fixtures, middle = [path.at((k + 1) * dt) for k in range(count)], []
    began = process_time()
    for one in fixtures:
        now, status = steps.advance(now, one, dt)
        if status != "ok":
            raise SystemExit(f"{where}, n = {n}: {status}")
        middle.append(now["r"][0, n // 2].copy())
    return (process_time() - began) / count, np.array(middle)


def speed() -> bool:
    """Tell how fast steps are; whether they are as fast as they must be."""
    fine = True
    for where in ("plane", "space"):
        times = {n: min(carried(where, n, DT)[0] for _ in range(3)) for n in (10, 20, 50, 100, 200)}
        each = {n: 1e6 * t / n for n, t in times.items()}
        grown = each[200] / each[20]
        fine = fine and grown <= GROWTH
        told = ", ".join(f"n = {n}: {1e6 * t:.0f}" for n, t in times.items())
        print(f"{where}: microseconds a step {told}; a node from n = 20 to 200 {grown:.2f}")
    _, exact = carried("space", 20, DT / 10)
    faster = []
    for k in (1, 2, 4):
        seconds, middle = carried("space", 20, k * DT)
        apart = float(np.linalg.norm(middle - exact[10 * k - 1 :: 10 * k], axis=1).max())
        faster += [k * DT / seconds] * (apart <= NEAR)
        told = f"{k * DT / seconds:.1f} x real time, {apart:.1e} L off"
        print(f"n = 20 in space, steps of {k * DT:g} s: {told}")
    fine = fine and max(faster, default=0.0) >= FASTER
    return fine


def main() -> int:
    """Exit code."""
    parser = options(
        __doc__,
        count=(1000, "motions"),
        first=True,
        seed=0,
        where=True,
        only="of a motion",
        jobs=True,
    )
    parser.add_argument("--speed", action="store_true", help="tell the speed alone")
    chosen = parser.parse_args()
    if chosen.speed:
        return 0 if speed() else 1
    numbers = range(chosen.first, chosen.first + chosen.count)
    cases = [Case(k, chosen.where[k % len(chosen.where)], chosen.seed) for k in numbers]
    if chosen.only is not None:
        cases = [case for case in cases if case.number == chosen.only]

    def line(case: Case, row: Row, seconds: float) -> str:
        return (
            ""
            if row.status == "ok"
            else f"{case.number}, {case.where}: {row} after {seconds:.1f} s"
        )

    rows = run(work, cases, chosen, line, summary=summary)
    right = all(row.finite and row.off <= OFF for row in rows)
    return 0 if right else 1


if __name__ == "__main__":
    sys.exit(main())
