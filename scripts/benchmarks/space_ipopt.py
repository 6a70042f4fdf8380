"""IPOPT on a cable in space, from the documented first guesses."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from time import process_time

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from dlo_casadi.equilibrium.guesses import guessed_frames
from dlo_casadi.equilibrium.pose import HeldPose
from dlo_casadi.model.cable_model import CableModel
from dlo_casadi.model.whole_pose import potential

FloatArray = NDArray[np.floating]


@dataclass(frozen=True)
class Found:
    """Where IPOPT ends: energy [J], nodes' frames (n + 1, 4), multipliers (6 + 3,), seconds."""

    energy: float
    frames: FloatArray
    multipliers: FloatArray
    seconds: float


class Ipopt:
    """min V(increments of the frames) s.t. end position and clamps, exact derivatives.

    Increments are about the frames of a first guess, which are parameters. A clamp's frame is a
    condition as the end position is. Stability is not checked, as by IPOPT it is not. `clamped`:
    nodes that clamped clips hold, see `clips.clamped_nodes`.
    """

    def __init__(self, model: CableModel, clamped: tuple[int, ...] = ()) -> None:
        self.model, node = model, model.node
        problem, count = potential(model, clamped), model.n + 1
        frames, turns = ca.SX.sym("frames", 4 * count), ca.SX.sym("turns", 3 * count)
        inner = problem.coordinates[4 * count :]
        moved = [
            node.moved(frames[4 * i : 4 * i + 4], turns[3 * i : 3 * i + 3]) for i in range(count)
        ]
        energy, conditions = ca.substitute(
            [problem.energy, problem.conditions],
            [problem.coordinates],
            [ca.vertcat(*moved, inner)],
        )
        self._rest = inner.numel()
        self._solver = ca.nlpsol(
            "rod",
            "ipopt",
            {
                "x": ca.vertcat(turns, inner),
                "p": ca.vertcat(frames, problem.parameters),
                "f": energy,
                "g": conditions,
            },
            {
                "print_time": False,
                "ipopt.print_level": 0,
                "ipopt.sb": "yes",
                "ipopt.tol": 1e-9,
                "ipopt.max_iter": 300,
            },
        )

    def solve(
        self,
        p: FloatArray,
        rest: FloatArray,
        pose: HeldPose,
        guesses: Iterable[FloatArray] | None = None,
        places: Sequence[float] = (),
    ) -> Iterator[Found]:
        """Each first guess from which IPOPT converges; by default the documented ones.

        `places`: first guesses of the arc lengths [m] of eyelets.
        """
        model, count = self.model, self.model.n + 1
        deviation = np.zeros(len(model.deviation_names))
        for guess in guessed_frames(model, p, rest, pose) if guesses is None else guesses:
            given = np.concatenate([guess.ravel(), p, rest, pose.vector, deviation])
            start = np.zeros(3 * count + self._rest)
            start[3 * count : 3 * count + len(places)] = places
            begin = process_time()
            out = self._solver(x0=start, p=given, lbg=0.0, ubg=0.0)
            seconds = process_time() - begin
            if not self._solver.stats()["success"]:
                continue
            turns = np.array(out["x"]).ravel()[: 3 * count].reshape(count, 3)
            frames = model.node.moved(guess, turns)
            yield Found(float(out["f"]), frames, np.array(out["lam_g"]).ravel(), seconds)
