"""Clips held against others: python scripts/check_clips.py [--count 200] [--fixtures FOLDER].

Random cables with one to four clips of all kinds, in the plane and in space: how many are solved
where IPOPT finds a minimum from starts of its own (in the plane), and whether any result is not a
minimum. One shape against scipy's solve_bvp with an interior point. With a folder of sessions, what
their fits say beside the truth next to it.
"""

import argparse
import time
from collections import Counter
from pathlib import Path

import numpy as np
from scipy.integrate import solve_bvp
from scipy.spatial.transform import Rotation

import dlo_casadi as dlo
from dlo_casadi.config import read_yaml
from dlo_casadi.effects import CableData
from dlo_casadi.equilibrium.curve import NodeCurve
from dlo_casadi.equilibrium.equilibrium import Equilibrium
from dlo_casadi.equilibrium.minima import by_ipopt
from dlo_casadi.equilibrium.pose import HeldPose
from dlo_casadi.equilibrium.solve import solve_equilibria
from dlo_casadi.model.assembly import Inputs, assembly_of
from dlo_casadi.model.cable_model import CableModel
from dlo_casadi.model.clips import HeldClip, node_places

ELEMENTS = 32
# Starts of IPOPT, and the largest distance of a clip from the free cable, as a share of the length.
STARTS, MOVED = 6, 0.04
# Largest chord of a span over its length.
ROOM = 0.97
KINDS = {False: ("pinned", "clamped", "eyelet"), True: ("pinned", "clamped", "swivel", "eyelet")}


def random_pose(
    rng: np.random.Generator, spatial: bool
) -> tuple[CableModel, HeldPose, list[np.ndarray]] | None:
    """A cable held by clips near places where it hung without them; in a plane starts of IPOPT."""
    mass, stiffness = 10 ** rng.uniform(-2, -0.3), 10 ** rng.uniform(-3, -1)
    twist = {"torsional_stiffness": stiffness / 1.3} if spatial else {}
    cable = CableData(1.0, mass, 0.008, stiffness, **twist)
    ends = {"start": "clamped", "end": "clamped"} if spatial or rng.random() < 0.5 else {}
    gravity = (0.0, 0.0, -9.81) if spatial else (0.0, -9.81)
    free = CableModel(cable, ELEMENTS, n_rest=0, gravity=gravity, **ends)
    d, turned = len(gravity), rng.normal(0, 0.4, (2, 3))
    reach = rng.uniform(0.4, 0.85) * np.eye(d)[0] + rng.normal(0, 0.15, d)
    held = {}
    if ends and spatial:
        both = (tuple(Rotation.from_rotvec(turn).as_quat()) for turn in turned)
        held = dict(zip(("start_orientation", "end_orientation"), both, strict=True))
    elif ends:
        held = {"start_heading": float(turned[0, 2]), "end_heading": float(turned[1, 2])}
    pose = HeldPose((0.0,) * d, tuple(reach.tolist()), **held)
    rest = np.zeros(free.chain.n_rests)
    (hung,) = solve_equilibria(free, free.nominal, rest, [pose])
    if not isinstance(hung, Equilibrium):
        return None
    given = Inputs.of(free.nominal, rest, pose.vector[None])
    curve = NodeCurve.of(1.0, assembly_of(free).curve(hung.shapes, given)[0])
    count = rng.integers(1, 5)
    at = (np.arange(1, count + 1) + rng.uniform(-0.25, 0.25, count)) / (count + 1)
    places = curve.at(at) + MOVED * rng.uniform(-1, 1, (count, d))
    holders = np.vstack([np.zeros(d), places, reach])
    spans = np.diff(np.concatenate([[0.0], at, [1.0]]))
    if np.any(np.linalg.norm(np.diff(holders, axis=0), axis=1) > ROOM * spans):
        return None
    frames = free.node.interpolated(at, free.chain.places, hung.x)
    turns = rng.normal(0, 0.2, (count, free.node.increment))
    clips = []
    for s, place, frame in zip(at, places, free.node.moved(frames, turns), strict=True):
        kind = str(rng.choice(KINDS[spatial]))
        clamp = kind in ("clamped", "swivel")
        direction = {"orientation": tuple(frame)} if spatial else {"heading": float(frame[0])}
        own = direction if clamp else {}
        clips.append(HeldClip(kind, tuple(place), None if kind == "eyelet" else float(s), **own))
    model = CableModel(
        cable, ELEMENTS, n_rest=0, gravity=gravity, clips=tuple(c.kind for c in clips), **ends
    )
    starts = [hung.x[:, 0] + rng.normal(0, 0.3, 4) @ waves() for _ in range(STARTS - 1)]
    held_pose = HeldPose(pose.start, pose.end, clips=tuple(clips), **held)
    return model, held_pose, [] if spatial else [hung.x[:, 0], *starts]


def waves() -> np.ndarray:
    """Smooth changes of the headings along the cable."""
    return np.sin(np.pi * np.outer(np.arange(1, 5), np.linspace(0, 1, ELEMENTS + 1)))


def check_random(count: int) -> None:
    """Count what is solved."""
    for spatial in (False, True):
        rng, found, began = np.random.default_rng(0), Counter(), time.process_time()
        while found["cables"] < count // 2:
            drawn = random_pose(rng, spatial)
            if drawn is None:
                continue
            model, pose, starts = drawn
            found["cables"] += 1
            rest = np.zeros(model.chain.n_rests)
            (eq,) = solve_equilibria(model, model.nominal, rest, [pose])
            solved = isinstance(eq, Equilibrium)
            found["solved"] += solved
            if not solved:
                found["no room"] += "of cable between" in eq.message
            elif not eq.stable:
                found["not a minimum"] += 1
            minima = [by_ipopt(model, model.nominal, rest, pose, phi) for phi in starts]
            minima = [own.energy for own in minima if own is not None and own.stable]
            if minima:
                found["by IPOPT"] += 1
                found["both"] += solved
                found["IPOPT lower"] += (
                    solved and min(minima) < eq.energy - 1e-9 * abs(eq.energy) - 1e-12
                )
        where = "in space" if spatial else "in a plane"
        print(f"{where}: {dict(found)}, {time.process_time() - began:.0f} s", flush=True)


def check_bvp() -> None:
    """A heavy elastica through one pinned clip, on two meshes."""
    stiffness, weight, at, place, end = 0.02, 0.2 * 9.81, 0.437, (0.33, 0.12), (0.7, 0.05)
    spans = np.array([at, 1 - at])

    def slopes(u, y, p):
        rows = []
        for k in (0, 1):
            _, _, phi, bend = y[4 * k : 4 * k + 4]
            nx, ny = p[2 * k], p[2 * k + 1] + weight * spans[k] * u
            cos, sin = np.cos(phi), np.sin(phi)
            rows += [cos, sin, bend, -(cos * ny - sin * nx) / stiffness]
        return np.array(rows) * np.repeat(spans, 4)[:, None]

    def conditions(a, b, p):
        return np.array(
            [
                *(a[0], a[1], a[3]),
                *(b[:2] - place),
                *(a[4:6] - place),
                *(a[6:8] - b[2:4]),
                *(b[4:6] - end),
                b[7],
            ]
        )

    for n in (40, 80, 160):
        model = CableModel(CableData(1.0, 0.2, 0.01, stiffness), n, n_rest=0, clips=("pinned",))
        pose = HeldPose((0.0, 0.0), end, clips=(HeldClip("pinned", place, at),))
        (eq,) = solve_equilibria(model, model.nominal, np.zeros(n), [pose])
        given = Inputs.of(model.nominal, np.zeros(n), pose.vector[None])
        curve = NodeCurve.of(1.0, assembly_of(model).curve(eq.shapes, given)[0])
        u, nodes = np.linspace(0, 1, 201), node_places(model.chain, pose.clips)
        guess = []
        for s in (at * u, at + (1 - at) * u):
            phi = np.interp(s, nodes, eq.phi)
            guess += [*curve.at(s).T, phi, np.gradient(phi, s)]
        first = eq.start_force
        pulls = [first, first + np.array([0.0, weight * at]) + eq.clips[0].force]
        found = solve_bvp(slopes, conditions, u, np.array(guess), np.ravel(pulls), tol=1e-10,
                          max_nodes=200000)  # fmt: skip
        there = np.hstack([found.sol(u)[:2], found.sol(u)[4:6]]).T
        apart = np.abs(np.vstack([curve.at(at * u), curve.at(at + (1 - at) * u)]) - there).max()
        print(f"solve_bvp ({found.message}), n = {n}: shapes differ by {apart:.1e} L", flush=True)


def check_fixtures(folder: Path) -> None:
    """What fits say, beside the truth."""
    for session in sorted(folder.glob("clip_*/session.yaml")):
        truth = read_yaml(
            folder.parent / f"{folder.name}_truth" / session.parent.name / "truth.yaml"
        )
        began, result = time.process_time(), dlo.fit(session)
        print(result)
        print({k: v for k, v in truth.items() if k != "poses"})
        shapes = list(result.stages[-1].shapes.values())
        apart = [
            abs(clip["at"] - s)
            for shape, pose in zip(shapes, truth["poses"], strict=False)
            for clip, s in zip(shape.clips, pose["clip_at"], strict=True)
        ]
        print(f"arc lengths off by at most {1e3 * max(apart):.2f} mm")
        print(f"{time.process_time() - began:.0f} s", flush=True)


def main() -> None:
    """Run the checks that are asked for."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--count", type=int, default=200, help="random cables")
    parser.add_argument("--fixtures", type=Path, help="folder of sessions, its truth beside it")
    chosen = parser.parse_args()
    check_bvp()
    check_random(chosen.count)
    if chosen.fixtures is not None:
        check_fixtures(chosen.fixtures)


if __name__ == "__main__":
    main()
