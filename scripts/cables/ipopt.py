"""IPOPT on a cable, with obstacles as inequalities; by default from the documented guesses."""

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
from dlo_casadi.model.whole_pose import Potential, potential

FloatArray = NDArray[np.floating]


@dataclass(frozen=True)
class Found:
    """Where IPOPT ends: energy [J], nodes' frames (n + 1, 4), multipliers, seconds.

    The multipliers are those of the end and its clamps (6 + 3,), then, negative where nodes touch,
    those of all nodes inside beside each obstacle.
    """

    energy: float
    frames: FloatArray
    multipliers: FloatArray
    seconds: float


def _gaps(model: CableModel, problem: Potential) -> list[ca.SX]:
    """Distances [m] of the nodes inside from all obstacles, less the cable's radius."""
    d, first = model.node.dimension, len(model.names) + model.chain.n_rests
    start = problem.parameters[first : first + d]
    places = start + ca.cumsum(problem.by_segment[model.end_pull, :], 1)
    places = places[:, : model.n_contacts // max(len(model.obstacles), 1)]
    return [one.symbolic(places).T - model.cable.diameter / 2 for one in model.obstacles]


class Ipopt:
    """min V(increments of the frames) s.t. end position and clamps, exact derivatives.

    Increments are about the frames of a first guess, which are parameters. A clamp's frame is a
    condition as the end position is; that no node is inside of an obstacle are inequalities.
    Stability is not checked, as by IPOPT it is not. `clamped`: nodes that clamped clips hold, see
    `clips.held_nodes`. In a plane the frames are headings.
    """

    def __init__(self, model: CableModel, clamped: tuple[int, ...] = ()) -> None:
        self.model, node = model, model.node
        problem, self._count = potential(model, clamped), model.chain.n_nodes
        count, c, b = self._count, node.coordinates, node.increment
        frames, turns = ca.SX.sym("frames", c * count), ca.SX.sym("turns", b * count)
        inner = problem.coordinates[c * count :]
        moved = [
            node.moved(frames[c * i : c * i + c], turns[b * i : b * i + b]) for i in range(count)
        ]
        energy, conditions, gaps = ca.substitute(
            [problem.energy, problem.conditions, ca.vertcat(*_gaps(model, problem))],
            [problem.coordinates],
            [ca.vertcat(*moved, inner)],
        )
        self._upper = np.repeat([0.0, np.inf], [conditions.numel(), gaps.numel()])
        self._rest = inner.numel()
        self._solver = ca.nlpsol(
            "rod",
            "ipopt",
            {
                "x": ca.vertcat(turns, inner),
                "p": ca.vertcat(frames, problem.parameters),
                "f": energy,
                "g": ca.vertcat(conditions, gaps),
            },
            {
                "print_time": False,
                "ipopt.print_level": 0,
                "ipopt.sb": "yes",
                "ipopt.tol": 1e-11 if model.obstacles else 1e-9,
                "ipopt.bound_relax_factor": 0.0,
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
        model, count, b = self.model, self._count, self.model.node.increment
        deviation = np.zeros(len(model.deviation_names))
        for guess in guessed_frames(model, p, rest, pose) if guesses is None else guesses:
            given = np.concatenate([guess.ravel(), p, rest, pose.vector, deviation])
            start = np.zeros(b * count + self._rest)
            start[b * count : b * count + len(places)] = places
            begin = process_time()
            out = self._solver(x0=start, p=given, lbg=0.0, ubg=self._upper)
            seconds = process_time() - begin
            if not self._solver.stats()["success"]:
                continue
            turns = np.array(out["x"]).ravel()[: b * count].reshape(count, b)
            frames = model.node.moved(guess, turns)
            yield Found(float(out["f"]), frames, np.array(out["lam_g"]).ravel(), seconds)
