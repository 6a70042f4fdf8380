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
from dlo_casadi.model.clips import placed_nodes
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


# Maximum number of runs while nodes follow eyelets, and by how many elements these slide at most in
# the last one.
MOST_RUNS, NARROW = 8, 0.25


class Ipopt:
    """min V(increments of the frames) s.t. end position and clamps, exact derivatives.

    Increments are about the frames of a first guess, which are parameters. A clamp's frame is a
    condition as the end position is; that no node is inside of an obstacle are inequalities.
    Stability is not checked, as by IPOPT it is not. In a plane the frames are headings.
    """

    def __init__(self, model: CableModel) -> None:
        self.model, node = model, model.node
        problem, self._count = potential(model), model.chain.n_nodes
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
        numbers = np.concatenate([p, rest, pose.vector, np.zeros(len(self.model.deviation_names))])
        for guess in guessed_frames(self.model, p, rest, pose) if guesses is None else guesses:
            begin = process_time()
            x, found, slid = guess, None, np.array(places)
            for _ in range(MOST_RUNS if len(slid) else 1):
                before = slid
                found, x, slid = self._solved(numbers, pose, x, before)
                if found is None or np.allclose(slid, before, atol=NARROW * self.model.chain.h):
                    break
            if found is not None:
                lam = np.array(found["lam_g"]).ravel()
                yield Found(float(found["f"]), x, lam, process_time() - begin)

    def _solved(
        self, numbers: FloatArray, pose: HeldPose, x: FloatArray, places: FloatArray
    ) -> tuple[dict[str, ca.DM] | None, FloatArray, FloatArray]:
        """One run with a node at each clip: results, nodes, and arc lengths [m] of the eyelets."""
        model, count, b = self.model, self._count, self.model.node.increment
        at = np.array([np.nan if clip.at is None else clip.at for clip in pose.clips], dtype=float)
        at[np.isnan(at)] = places
        held = np.concatenate([[0.0], at, [model.chain.length]])[None]
        nodes, along = (part[0] for part in placed_nodes(model.chain, held, held))
        moved = np.ravel(np.arange(count) == nodes[:, None], order="F")
        start, room = np.zeros(b * count + self._rest), np.full((2, b * count + self._rest), np.inf)
        eyelets = nodes[[clip.at is None for clip in pose.clips]]
        own = b * count + np.arange(len(places))
        start[own] = places
        room[0, own] = 0.8 * (along[eyelets] - along[eyelets - 1])
        room[1, own] = 0.8 * (along[eyelets + 1] - along[eyelets])
        given = np.concatenate([x.ravel(), numbers, moved])
        bounds = {"lbx": start - room[0], "ubx": start + room[1], "lbg": 0.0, "ubg": self._upper}
        out = self._solver(x0=start, p=given, **bounds)
        if not self._solver.stats()["success"]:
            return None, x, places
        ends = np.array(out["x"]).ravel()
        frames = model.node.moved(x, ends[: b * count].reshape(count, b))
        return out, frames, ends[own]
