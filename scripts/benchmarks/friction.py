"""What friction would change: python scripts/benchmarks/friction.py [--friction 0.3] [--height 80].

A cable leaves a clamp over a table, level, and lies on the table with its free end. Without
friction there is one shape. With Coulomb's friction the table may hold the cable along the surface
with up to the share mu of the normal force, wherever the cable lies: which of a band of equilibria
it is in depends on how it came there. IPOPT finds both ends of the band on our own energy:

    min, max x_tip  s.t.  dV/dq = J^T f,  g_i >= 0,  n_i >= 0,  n_i g_i <= eps,  |t_i| <= mu n_i

with the gaps g of the nodes, the normal forces n and the friction t; eps falls in steps. Forces of
all nodes are free within their cones, so that no history is assumed. Beside each end of the band
stands the bending stiffness that a fit without friction would read off that shape.
"""

from __future__ import annotations

import argparse
import time

import casadi as ca
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize_scalar

from dlo_casadi.effects import CableData
from dlo_casadi.equilibrium.pose import HeldPose
from dlo_casadi.equilibrium.solve import solve_equilibrium
from dlo_casadi.model.cable_model import CableModel
from dlo_casadi.model.whole_pose import potential
from dlo_casadi.rod.obstacles import Plane

FloatArray = NDArray[np.floating]

CABLE = CableData(0.8, 0.06, 0.006, 0.004)
ELEMENTS = 40
# Complementarity n g [N m], in steps from what IPOPT starts with to what is left.
SLACK = (1e-4, 1e-5, 1e-6, 1e-7, 1e-8)


class Band:
    """Equilibria with friction of a cable on a table that is `height` [m] below its clamp."""

    def __init__(self, height: float) -> None:
        table = Plane((0.0, -height), (0.0, 1.0), "table")
        ends = {"start": "clamped", "end": "free"}
        self.model = CableModel(CABLE, ELEMENTS, n_rest=0, obstacles=(table,), **ends)
        self.pose = HeldPose((0.0, 0.0), start_heading=0.0)
        rest = np.zeros(self.model.chain.n_rests)
        self.found = solve_equilibrium(self.model, self.model.nominal, rest, self.pose)
        self._rest = rest
        problem, model = potential(self.model), self.model
        deviation = np.zeros(len(model.deviation_names))
        self._given = np.concatenate([model.nominal, rest, self.pose.vector, deviation])
        places = ca.cumsum(problem.by_segment[model.end_pull, :], 1)
        gaps = places[1, :].T + height - CABLE.diameter / 2
        rows = np.flatnonzero(model.are_multipliers[: model.n_lam])
        held = problem.conditions[np.flatnonzero(~np.isin(rows, model.no_pull)).tolist()]
        x, count = problem.coordinates, gaps.numel()
        lam, normal, along = (
            ca.SX.sym(name, size)
            for name, size in (("lam", held.numel()), ("normal", count), ("along", count))
        )
        friction, slack = ca.SX.sym("friction"), ca.SX.sym("slack")
        work = ca.dot(normal, gaps) + ca.dot(along, places[0, :].T)
        balance = ca.gradient(problem.energy + ca.dot(lam, held) - work, x)
        cones = ca.vertcat(friction * normal - along, friction * normal + along)
        self._limits = [balance.numel() + held.numel(), 4 * count]
        self._sizes = [x.numel(), lam.numel(), count, count]
        self._solver = ca.nlpsol(
            "band",
            "ipopt",
            {
                "x": ca.vertcat(x, lam, normal, along),
                "p": ca.vertcat(problem.parameters, friction, slack, side := ca.SX.sym("side")),
                "f": side * places[0, -1],
                "g": ca.vertcat(balance, held, gaps, slack - normal * gaps, cones),
            },
            {
                "print_time": False,
                "ipopt.print_level": 0,
                "ipopt.sb": "yes",
                "ipopt.tol": 1e-9,
                "ipopt.max_iter": 1000,
            },
        )
        self._places = ca.Function("places", [x, problem.parameters], [places])

    def edge(self, friction: float, side: int) -> tuple[FloatArray, float]:
        """Nodes (n, 2) [m] but the first, and the force along the table on the cable [N].

        `side`: +1 for the least x of the tip, -1 for the greatest.
        """
        count = self._sizes[2]
        normal = np.clip(self.found.multipliers[-count:], 0.0, None)
        start = np.zeros(sum(self._sizes))
        start[: self.model.chain.n_nodes] = self.found.phi
        start[sum(self._sizes[:2]) : sum(self._sizes[:3])] = normal
        lowest = np.zeros(start.size) - np.inf
        lowest[sum(self._sizes[:2]) : sum(self._sizes[:3])] = 0.0
        upper = np.concatenate([np.zeros(self._limits[0]), np.full(self._limits[1], np.inf)])
        for slack in SLACK:
            given = np.concatenate([self._given, [friction, slack, side]])
            out = self._solver(x0=start, p=given, lbx=lowest, lbg=0.0, ubg=upper)
            start = np.array(out["x"]).ravel()
            if not self._solver.stats()["success"]:
                status = self._solver.stats()["return_status"]
                raise SystemExit(f"IPOPT ends with {status} at a slack of {slack:g} N m")
        places = np.array(self._places(start[: self._sizes[0]], self._given)).T
        return places, float(start[-count:].sum())

    def stiffness(self, places: FloatArray) -> float:
        """Bending stiffness [N m^2] with which the shape without friction is nearest to nodes."""

        def apart(log: float) -> float:
            p = np.exp(log) * self.model.nominal  # the stiffness alone
            found = solve_equilibrium(self.model, p, self._rest, self.pose, x_init=self.found.x)
            return float(((found.points[1:] - places) ** 2).sum())

        best = minimize_scalar(apart, bounds=(-1.5, 1.5), method="bounded")
        return float(np.exp(best.x)) * CABLE.bending_stiffness


def main() -> None:
    """Print the band."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--friction", type=float, nargs="+", default=[0.0, 0.1, 0.3, 0.5])
    parser.add_argument("--height", type=float, default=80.0, help="of the clamp [mm]")
    chosen = parser.parse_args()
    band = Band(chosen.height / 1e3)
    tip, lift = band.found.points[-1, 0], band.found.contacts[0].start
    print(f"without friction: tip at {1e3 * tip:.1f} mm, lifts off at {1e3 * lift:.0f} mm")
    for friction in chosen.friction:
        began = time.process_time()
        edges = [band.edge(friction, side) for side in (1, -1)]
        apart = max(np.linalg.norm(edges[0][0] - edges[1][0], axis=1))
        print(
            f"mu = {friction:g}: tip {1e3 * (edges[0][0][-1, 0] - tip):+.2f} to "
            f"{1e3 * (edges[1][0][-1, 0] - tip):+.2f} mm, the cable up to "
            f"{1e3 * apart:.1f} mm apart; held along the table by {edges[0][1]:+.3f} to "
            f"{edges[1][1]:+.3f} N; EI without friction "
            f"{band.stiffness(edges[0][0]):.5f} to {band.stiffness(edges[1][0]):.5f} N m^2 "
            f"(true: {CABLE.bending_stiffness:g}); {time.process_time() - began:.0f} s",
            flush=True,
        )


if __name__ == "__main__":
    main()
