"""Probabilities of violated limits against counted ones: twenty poses, 10,000 ends each, through C.

    python scripts/check_limits.py        fails where a probability is more than 2 points off

Uncertain are the ends, 3 mm in both directions: parameters are constants of the compiled solver.
Limits lie at random 0 to 2.5 standard deviations from the value. The solver is the generated C, on
arcs: none of the shapes comes from the code that is checked.
"""

import sys

import numpy as np

from dlo_casadi.cable.limits import limit_checks
from dlo_casadi.codegen import CompiledSolver
from dlo_casadi.config import Limits
from dlo_casadi.effects import CableData
from dlo_casadi.equilibrium.pose import HeldPose
from dlo_casadi.equilibrium.solve import solve_equilibrium
from dlo_casadi.equilibrium.spread import Uncertainty
from dlo_casadi.equilibrium.symbolic import CasadiCable
from dlo_casadi.model.cable_model import CableModel
from dlo_casadi.model.pose_scatter import PoseScatter

POSES, DRAWS, STD = 20, 10_000, 3e-3  # m


def main() -> int:
    """Print a row for each limit of each pose; the exit code."""
    model = CableModel(CableData(0.5, 0.05, 0.006, 1e-2), 20, "arc", n_rest=0)
    rest, random = np.zeros(model.chain.n_rests), np.random.default_rng(0)
    cable, solver = (
        CasadiCable(model, model.nominal, rest),
        CompiledSolver(model, model.nominal, rest),
    )
    known = Uncertainty((), np.zeros((0, 0)), {"end_x": STD, "end_y": STD}, PoseScatter())
    off = 0
    for _ in range(POSES):
        end = random.uniform((0.15, -0.25), (0.4, 0.25))
        pose = HeldPose((0.0, 0.0), tuple(map(float, end)))
        found = solve_equilibrium(model, model.nominal, rest, pose)
        none = np.zeros(model.n_coefficients)

        def check(limits, pose=pose, found=found, none=none):
            return limit_checks(cable, none, pose, found, known, Limits(**limits))

        first = check({"bend_radius": 0.05, "force": 1.0})
        steps = random.uniform(0.0, 2.5, 2) * (-1, 1)
        limits = {x.quantity: x.value + k * x.std for x, k in zip(first, steps, strict=True)}
        bend, force = check(limits)

        ends = end + STD * random.standard_normal((DRAWS, 2))
        poses = np.hstack([np.zeros((DRAWS, 2)), ends, np.zeros((DRAWS, 2))])
        shapes, status = solver.solve_many(poses)
        # The compiled solver has the mesh of the cable, the check a finer one.
        radii = bend.value / found.min_bend_radius * shapes["min_bend_radius"]
        pulls = np.linalg.norm([shapes["start_force"], shapes["end_force"]], axis=2).max(axis=0)
        for item, beyond in ((bend, radii < bend.limit), (force, pulls > force.limit)):
            share = float((beyond | (status != 0)).mean())
            wrong = abs(share - item.probability) > 0.02 + 3 * item.error
            off += wrong
            print(f"{item}\n    counted {100 * share:.1f} %{'  OFF' * wrong}")
    print(f"{off} of {2 * POSES} are off")
    return int(off > 0)


if __name__ == "__main__":
    sys.exit(main())
