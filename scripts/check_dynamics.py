"""The cable in motion against closed forms and recordings of another simulator with known truth.

    python scripts/check_dynamics.py [--data FOLDER] [--n 20] [--tolerance 3e-6] [--only NUMBER]

With --data: every recording of every session in FOLDER, from its true first state with true
parameters, which are read from the folder beside it that ends in `_truth`. Told are the largest
distance of the nodes from the true ones over the length, and processor time over recorded time.
Without: frequencies of a hanging chain, a sagging cable and a pendulum; beams, torsion, damping
ratios, energy and orders are in tests/motion.

Exit code 1 if a recording is off by more than 0.5 % of the length, or a closed form by more than
its limit.
"""

import sys
from collections.abc import Iterator
from pathlib import Path
from time import process_time
from typing import Any, NamedTuple

import numpy as np
import yaml
from harness import options, run
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline
from scipy.optimize import brentq
from scipy.special import jn_zeros

import dlo_casadi as dlo
from dlo_casadi.cable.fitted_cable import FittedCable
from dlo_casadi.cable.shape_in_motion import moving_cable
from dlo_casadi.cable.simulated import Motion
from dlo_casadi.motion.path import FixturePath
from dlo_casadi.motion.trajectory import TOLERANCE, Way

FloatArray = NDArray[np.floating]
# Largest distance over the length, in a recording.
ALLOWED = 5e-3
# Names of the truth files -> effects of motion.
DAMPING = {"air": "air_drag", "dynamic": "dynamic_stiffness", "pin": "pin_friction"}


class Recording(NamedTuple):
    """A recording of a session."""

    folder: Path
    number: int
    n: int
    tolerance: float


class Found(NamedTuple):
    """A quantity, its error, and what is allowed."""

    name: str
    error: float
    allowed: float
    remark: str = ""


# ---- recordings --------------------------------------------------------------------------------


def truth_of(folder: Path) -> tuple[dict[str, Any], Any]:
    """True parameters and shapes of a session."""
    beside = folder.parent.with_name(f"{folder.parent.name}_truth") / folder.name
    values = yaml.safe_load((beside / "truth.yaml").read_text())
    return values, np.load(beside / "truth_shapes.npz")


def true_cable(session: dict[str, Any], truth: dict[str, Any], n: int) -> FittedCable:
    """The cable with its true parameters."""
    data, experiment = session["cable"], session["experiment"]
    hidden = dict(truth["effects"])
    effects = []
    if "lump" in hidden:
        lump = {"mass": hidden["lump"][1], "position": truth["lump_position_m"]}
        effects.append({"name": "lumped_mass", "parameters": lump})
    stiffness = truth["bending_stiffness"]
    in_space = len(experiment["gravity"]) == 3
    cable = dlo.Cable(
        **{key: data[key] for key in ("length", "mass", "diameter")},
        bending_stiffness=stiffness,
        torsional_stiffness=stiffness / 1.3 if in_space else None,
    )
    found = dlo.known_cable(
        cable,
        gravity=experiment["gravity"],
        boundary=tuple(experiment["boundary"][side] for side in ("start", "end")),
        rest_curvature=None if in_space else truth["rest_curvature"],
        model={"n": n, "effects": effects},
    )
    # The simulator in space damps the rate of the curvature's vector in the world's axes.
    damping = {"turning_loss": 1.0} if in_space else {}
    damping |= {DAMPING[k]: x for k, x in hidden.items() if k in DAMPING}
    return found.with_damping(truth["damping_time"], **damping)


def fixtures_of(
    folder: Path, motion: dict[str, Any], delay: float, t: FloatArray
) -> dict[str, FloatArray]:
    """Arguments of `simulate` at times t (T,) [s]."""
    if "fixtures" not in motion:
        return {key: motion[key] for key in ("start", "start_heading") if key in motion}
    table = np.genfromtxt(folder / motion["fixtures"], delimiter=",", names=True)
    names, known = table.dtype.names or (), {}
    for side in ("start", "end"):
        columns = [name for name in names if name.startswith(f"{side}_") and name.endswith("_m")]
        if columns:
            rows = np.stack([table[name] for name in columns], axis=1)
            known[side] = CubicSpline(table["t_s"] - delay, rows)(t)
        if (name := f"{side}_heading_rad") in names:
            known[f"{side}_heading"] = CubicSpline(table["t_s"] - delay, table[name])(t)
    return known


def let_go(cable: FittedCable, held: dict[str, FloatArray], points: Any) -> Motion:
    """The first instant of a cable that is let go in the shape of a curve, in a plane."""
    moving = moving_cable(cable)
    pose = cable.solve(**{key: x[0] if np.ndim(x) > 1 else x for key, x in held.items()}).pose
    s = moving.model.chain.places
    turned = np.unwrap(np.arctan2(*points(s, 1).T[::-1]))
    # The clamp holds the first heading, with its full turns.
    x = pose.frames[0] + turned[:, None] - turned[0]
    none = np.zeros((moving.n_segments, moving.d)), np.zeros(moving.n_moments)
    path = FixturePath(pose, {})
    fixtures = path.at(0.0, moving)
    state = moving.with_places(moving.still_state(x, *none), fixtures, points(s))
    return Motion(cable, np.zeros(1), Way(moving, path, np.zeros(1), (state,)))


def compared(case: Recording) -> tuple[float, float, float]:
    """Largest distance over the length, at the start and in all, and processor over real time."""
    session = yaml.safe_load((case.folder / "session.yaml").read_text())
    truth, shapes = truth_of(case.folder)
    motion = session["experiment"]["motions"][case.number - 1]
    true = shapes[f"motion_{case.number:02d}"]
    t, length = 0.04 * np.arange(len(true)), session["cable"]["length"]
    points = [CubicSpline(shapes["s"], row) for row in true]
    delay = truth["effects"].get("delay", 0.0)
    cable = true_cable(session, truth, case.n)
    begins = None
    if motion["begins"] == "moving":
        held = fixtures_of(case.folder, motion, delay, t[:1])
        begins = let_go(cable, held, points[0])
    fine = np.linspace(0.0, t[-1], 20 * len(t) - 19)
    known = fixtures_of(case.folder, motion, delay, fine)
    before = process_time()
    found = cable.simulate(fine, begins=begins, tolerance=case.tolerance, **known)
    seconds = process_time() - before
    s = np.linspace(0.0, length, 41)
    gaps = found.at(s)[::20] - np.stack([row(s) for row in points])
    sizes = np.linalg.norm(gaps, axis=2).max(axis=1) / length
    return float(sizes[0]), float(sizes.max()), seconds / float(t[-1])


def recordings(data: Path, n: int, tolerance: float) -> Iterator[Recording]:
    """All recordings of all sessions in a folder."""
    for folder in sorted(x.parent for x in data.glob("*/session.yaml")):
        session = yaml.safe_load((folder / "session.yaml").read_text())
        for k in range(len(session["experiment"]["motions"])):
            yield Recording(folder, k + 1, n, tolerance)


# ---- closed forms ------------------------------------------------------------------------------


def limp(
    length: float, boundary: tuple[str, str], n: int, mass: float = 0.1, stiffness: float = 1e-7
) -> FittedCable:
    """A cable that hardly resists bending."""
    cable = dlo.Cable(length=length, mass=mass, diameter=0.002, bending_stiffness=stiffness)
    return dlo.known_cable(cable, gravity=(0.0, -9.81), boundary=boundary, model={"n": n})


def hanging_chain(n: int) -> Found:
    """w_k = j_k / 2 sqrt(g / L), with the zeros j_k of the Bessel function J_0."""
    shape = limp(1.0, ("pinned", "free"), n).solve(start=(0.0, 0.0))
    found = 2 * np.pi * shape.modes(3).frequencies
    exact = jn_zeros(0, 3) / 2 * np.sqrt(9.81)
    return Found(f"hanging chain, n = {n}", float(np.abs(found / exact - 1).max()), 1e-3)


def pendulum(n: int) -> Found:
    """A bob of a hundred times the cable's mass: w = sqrt(g / L) with corrections of 1 / 600."""
    cable = dlo.Cable(length=1.0, mass=1e-3, diameter=0.002, bending_stiffness=1e-7)
    bob = {"name": "lumped_mass", "parameters": {"mass": 0.1, "position": 1.0}}
    model = {"n": n, "effects": [bob]}
    hung = dlo.known_cable(cable, gravity=(0, -9.81), boundary=("pinned", "free"), model=model)
    found = 2 * np.pi * float(hung.solve(start=(0.0, 0.0)).modes(1).frequencies[0])
    # Rayleigh's quotient of the straight cable.
    ratio = 0.01
    exact = np.sqrt(9.81 * (1 + ratio / 2) / (1 + ratio / 3))
    return Found(f"pendulum with a bob, n = {n}", abs(found / exact - 1), 1e-3)


def sagging(n: int) -> list[Found]:
    """Irvine's cable: in its plane 2 pi, 4 pi and tan(x) = x, out of it those of a string.

    Over l sqrt(m / H), for an inextensible cable of little sag  [Irvine, 1981]; here 0.6 % of the
    span, the theory's own error is 8 sag^2 / span^2 = 3e-4. Out of its plane it is a string, here
    with a bending stiffness: w^2 = k^2 (H + k^2 EI) / m, k = pi / l and 2 pi / l.
    """
    span, weight = 0.9999, 0.1 * 9.81
    tension = brentq(lambda h: 2 * h / weight * np.sinh(weight * span / 2 / h) - 1.0, 0.1, 1e3)
    unit = np.sqrt(tension / 0.1) / span
    symmetric = 2 * brentq(lambda x: np.tan(x) - x, 4.4, 4.6)
    inside = unit * np.array([2 * np.pi, symmetric, 4 * np.pi])
    flat = limp(1.0, ("pinned", "pinned"), n).solve(end=(span, 0.0))
    found = 2 * np.pi * flat.modes(3).frequencies
    own = Found(f"sagging cable, n = {n}", float(np.abs(found / inside - 1).max()), 1e-3)
    stiffness = 1e-2
    torsion = {"bending_stiffness": stiffness, "torsional_stiffness": stiffness}
    cable = dlo.Cable(length=1.0, mass=0.1, diameter=0.002, **torsion)
    known = {"gravity": (0.0, 0.0, -9.81), "boundary": ("pinned",) * 2, "model": {"n": n}}
    shape = dlo.known_cable(cable, **known).solve(end=(span, 0.0, 0.0))
    tension, every = -float(shape.end_force[0]), 2 * np.pi * shape.modes(10).frequencies
    k = np.array([1, 2]) * np.pi / span
    across = k * np.sqrt(tension / 0.1 * (1 + k**2 * stiffness / tension))
    off = float(np.abs(every[:, None] / across - 1).min(axis=0).max())
    return [own, Found(f"out of its plane, n = {n}", off, 1e-3)]


def closed_forms(n: int) -> Iterator[Found]:
    """All of them on a mesh."""
    yield hanging_chain(n)
    yield pendulum(n)
    yield from sagging(n)


def main() -> int:
    """Compare, and tell."""
    parser = options(__doc__, only="number of the case", jobs=True)
    parser.add_argument("--data", type=Path, help="folder of sessions with motions")
    parser.add_argument("--n", type=int, default=20, help="number of elements")
    parser.add_argument("--tolerance", type=float, default=TOLERANCE, help="of a step in time")
    chosen = parser.parse_args()
    if chosen.data is None:
        wrong = 0
        for one in closed_forms(chosen.n):
            print(f"{one.name}: off by {one.error:.2e} (allowed {one.allowed:.0e}) {one.remark}")
            wrong += one.error > one.allowed
        return int(wrong > 0)
    cases = list(recordings(chosen.data, chosen.n, chosen.tolerance))
    cases = cases if chosen.only is None else [cases[chosen.only]]

    def line(case: Recording, row: tuple[float, float, float], _: float) -> str:
        first, most, ratio = row
        name = f"{case.folder.name} {case.number}"
        off = f"{100 * first:.3f} % at first, {100 * most:.3f} % at most"
        return f"{name}: {off}, {ratio:.2f} s of processor a second"

    rows = run(compared, cases, chosen, line)
    return int(max(most for _, most, _ in rows) > ALLOWED)


if __name__ == "__main__":
    sys.exit(main())
