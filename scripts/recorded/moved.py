"""A take of a cable that truly moves: simulated between grippers that go from pose to pose.

RENDERED, not real; every frame of markers and grippers has white noise of its own.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

import dlo_casadi as dlo
from dlo_casadi.arrays import FloatArray
from recorded.takes import NOISE, TURN_NOISE, Take

CABLE = {"length": 0.6, "mass": 0.04, "diameter": 0.006}
STIFFNESS, TORSION, DAMPING = 0.012, 0.009, 0.04
HOLD, MOVE, RATE = 2.5, 0.45, 100.0  # s, s, 1/s
ENDS = ((0.35, 0.0, 0.0), (0.3, 0.2, 0.05), (0.42, -0.1, 0.1), (0.3, -0.15, -0.1), (0.4, 0.1, 0.0))


def moved(seed: int = 0) -> Take:
    """A take of five poses, the start resting and the end carried, clamped level at both ends."""
    random, places = np.random.default_rng(seed), np.array(ENDS)
    period = HOLD + MOVE
    t = np.arange(0.0, len(places) * period, 1 / RATE)
    at = np.floor(t / period).astype(int)
    share = np.clip((t % period - HOLD) / MOVE, 0.0, 1.0)[:, None]
    share = share**3 * (10 - 15 * share + 6 * share**2)
    last = np.minimum(at + 1, len(places) - 1)
    end = (1 - share) * places[at] + share * places[last]
    level = (0.0, 0.0, 0.0, 1.0)
    cable = dlo.known_cable(
        dlo.Cable(**CABLE, bending_stiffness=STIFFNESS, torsional_stiffness=TORSION),
        gravity=(0.0, 0.0, -9.81),
        boundary=("clamped", "clamped"),
        model={"n": 24},
    ).with_damping(DAMPING)
    held = {"start_orientation": level, "end_orientation": level}
    motion = cable.simulate(t, start=(0.0, 0.0, 0.0), end=end, **held)
    s = np.linspace(0.05, 0.55, 9)
    markers = {
        f"m{k}": x + NOISE * random.standard_normal(x.shape)
        for k, x in enumerate(np.moveaxis(motion.at(s), 1, 0))
    }
    bodies = {"start": np.zeros_like(end), "end": end}
    return Take(t, markers, {name: _shaken(x, random) for name, x in bodies.items()})


def _shaken(places: FloatArray, random: np.random.Generator) -> FloatArray:
    """Poses (n, 7) of level grippers with noise."""
    turns = Rotation.from_rotvec(TURN_NOISE * random.standard_normal(places.shape)).as_quat()
    return np.hstack([places + 0.5 * NOISE * random.standard_normal(places.shape), turns])
