"""Random cables that are held between their ends: by clips, by obstacles."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from dlo_casadi.effects import CableData
from dlo_casadi.equilibrium.curve import NodeCurve
from dlo_casadi.equilibrium.equilibrium import Equilibrium
from dlo_casadi.equilibrium.pose import HeldPose
from dlo_casadi.equilibrium.solve import solve_equilibria
from dlo_casadi.model.assembly import Assembly, Inputs
from dlo_casadi.model.cable_model import CableModel
from dlo_casadi.model.clips import HeldClip
from dlo_casadi.rod.obstacles import Capsule, Obstacle, Plane

FloatArray = NDArray[np.floating]
# Elements in the plane, and in space, of cables with clips, and with obstacles.
AT_CLIPS, AT_OBSTACLES = {False: 32, True: 16}, {False: 30, True: 24}
# Random starts of IPOPT.
STARTS_AT_CLIPS, STARTS_AT_OBSTACLES = 5, 4
# Largest distance of a clip from the free cable, as a share of the length.
MOVED = 0.04
# Largest chord of a span over its length.
ROOM = 0.97
KINDS = {False: ("pinned", "clamped", "eyelet"), True: ("pinned", "clamped", "swivel", "eyelet")}


@dataclass(frozen=True)
class Case:
    """A cable in a pose, nodes (n_nodes, coordinates) to start from, arc lengths of eyelets [m]."""

    number: int
    model: CableModel
    pose: HeldPose
    starts: list[FloatArray]
    slid: tuple[float, ...] = ()


Draw = Callable[[np.random.Generator, bool, int], Case | None]


def drawn(
    draw: Draw, count: int, spatial: bool, seed: int, only: int | None = None
) -> Iterator[Case]:
    """Cases 1 to `count`, or that number alone; each depends on those before it."""
    rng, number = np.random.default_rng(seed), 0
    while number < (count if only is None else only):
        case = draw(rng, spatial, number + 1)
        number += case is not None
        if case is not None and only in (None, number):
            yield case


def with_clips(rng: np.random.Generator, spatial: bool, number: int) -> Case | None:
    """A cable held by one to four clips near places where it hung without them.

    Starts are the nodes of the free cable, and turned at random along it.
    """
    mass, stiffness = 10 ** rng.uniform(-2, -0.3), 10 ** rng.uniform(-3, -1)
    twist = {"torsional_stiffness": stiffness / 1.3} if spatial else {}
    cable = CableData(1.0, mass, 0.008, stiffness, **twist)
    ends = {"start": "clamped", "end": "clamped"} if spatial or rng.random() < 0.5 else {}
    gravity = (0.0, 0.0, -9.81) if spatial else (0.0, -9.81)
    mesh = {"n": AT_CLIPS[spatial], "n_rest": 0, "gravity": gravity, **ends}
    free = CableModel(cable, **mesh)
    d, turned = len(gravity), rng.normal(0, 0.4, (2, 3))
    reach = rng.uniform(0.4, 0.85) * np.eye(d)[0] + rng.normal(0, 0.15, d)
    pose = HeldPose((0.0,) * d, tuple(reach.tolist()), **(directions(turned, d) if ends else {}))
    rest = np.zeros(free.chain.n_rests)
    (hung,) = solve_equilibria(free, free.nominal, rest, [pose])
    if not isinstance(hung, Equilibrium):
        return None
    given = Inputs.of(free.nominal, rest, pose.vector[None])
    curve = NodeCurve.of(1.0, Assembly(free, hung.shapes, given).curve()[0])
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
    model = CableModel(cable, clips=tuple(c.kind for c in clips), **mesh)
    waves = np.sin(np.pi * np.outer(np.linspace(0, 1, model.n + 1), np.arange(1, 5)))
    turns = 0.3 * waves @ rng.normal(size=(STARTS_AT_CLIPS, 4, free.node.increment))
    starts = [hung.x, *(free.node.moved(hung.x, turn) for turn in turns)]
    slid = tuple(float(s) for s, clip in zip(at, clips, strict=True) if clip.kind == "eyelet")
    return Case(number, model, replace(pose, clips=tuple(clips)), starts, slid)


def with_obstacles(rng: np.random.Generator, spatial: bool, number: int) -> Case | None:
    """A cable with one to three obstacles near where it hung without them.

    Starts are its nodes there, and turned at random. None where a fixture is too near to an
    obstacle.
    """
    mass, stiffness = 10 ** rng.uniform(-2, -0.3), 10 ** rng.uniform(-2.5, -1)
    twist = {"torsional_stiffness": 0.6 * stiffness} if spatial else {}
    cable, d = CableData(1.0, mass, 0.008, stiffness, **twist), 2 + spatial
    ends = {"start": "clamped", "end": "clamped"} if spatial or rng.random() < 0.5 else {}
    gravity = (*[0.0] * (d - 1), -9.81)
    free = CableModel(cable, AT_OBSTACLES[spatial], gravity=gravity, n_rest=0, **ends)
    reach, turns = [rng.uniform(0.5, 0.85), *rng.normal(0, 0.1, d - 1)], rng.normal(0, 0.35, (2, 3))
    held = directions(turns, d) if ends else {}
    pose = HeldPose((0.0,) * d, tuple(map(float, reach)), **held)
    (hung,) = solve_equilibria(free, free.nominal, np.zeros(free.chain.n_rests), [pose])
    if not isinstance(hung, Equilibrium):
        raise hung
    obstacles: list[Obstacle] = []
    lowest, highest = hung.points[:, -1].min(), min(0.0, reach[-1])
    for k in range(rng.integers(1, 4)):
        if k == 0 and rng.random() < 0.6:
            obstacles.append(table(rng, lowest, highest, d))
        else:  # discs, and stadiums, in a plane
            obstacles.append(bar(rng, hung.points, 0.0 if spatial else 0.5, f"bar {k}"))
    if any(one.near(np.array([pose.start, reach])).distance.min() < 0.004 for one in obstacles):
        return None
    waves = np.sin(np.pi * np.outer(free.chain.places, np.arange(1, 5)))
    turns = 0.5 * waves @ rng.normal(size=(STARTS_AT_OBSTACLES, 4, free.node.increment))
    starts = [hung.x, *(free.node.moved(hung.x, turn) for turn in turns)]
    return Case(number, replace(free, obstacles=tuple(obstacles)), pose, starts)


def directions(turns: FloatArray, dimension: int) -> dict[str, float | tuple[float, ...]]:
    """Directions of both clamps, turned (2, 3) [rad] against the x axis."""
    if dimension == 2:
        return {"start_heading": float(turns[0, 2]), "end_heading": float(turns[1, 2])}
    first, last = (tuple(map(float, x)) for x in Rotation.from_rotvec(turns).as_quat())
    return {"start_orientation": first, "end_orientation": last}


def table(rng: np.random.Generator, lowest: float, highest: float, d: int) -> Plane:
    """A table, a little askew, that lifts the lowest part of a cable."""
    level = lowest + rng.uniform(0.05, 0.7) * (highest - lowest) - 0.006
    normal = np.array([*rng.normal(0, 0.1, d - 1), 1.0])
    normal /= np.linalg.norm(normal)
    return Plane((*[0.0] * (d - 1), float(level)), tuple(normal.tolist()), "table")


def bar(rng: np.random.Generator, points: FloatArray, round_: float, name: str) -> Capsule:
    """A bar near where a cable hangs; with a probability `round_` a ball, or disc."""
    d = points.shape[1]
    place = points[rng.integers(len(points) // 5, 4 * len(points) // 5)]
    place = place + rng.normal(0, 0.03, d)
    half = Rotation.random(random_state=rng).apply([0.2 if d == 3 else 0.03, 0.0, 0.0])[:d]
    half *= round_ == 0.0 or rng.random() < round_
    a, b = (tuple((place + side * half).tolist()) for side in (-1, 1))
    return Capsule(a, b, float(rng.uniform(0.02, 0.06)), name)
