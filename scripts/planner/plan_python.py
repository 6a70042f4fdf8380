"""Plan the same motion from Python, with the PyPI package ompl and CompiledSolver.

    pip install ompl
    python scripts/planner/plan_python.py --output DIR

Compiles the solver, plans with RRT*, writes plan_python.png.
"""

import argparse
import sys
from itertools import pairwise
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from plan import HERE, clearance, draw, example, read_scene

from dlo_casadi.codegen import CompiledSolver
from dlo_casadi.codegen.shapes import Shape

try:
    from ompl import base as ob
    from ompl import geometric as og
    from ompl import util as ou
except ModuleNotFoundError:
    sys.exit("error: planning from Python needs OMPL's package.\n  Try: pip install ompl")


class Leader:
    """The cable in the scene: which places and motions of its held end are allowed."""

    def __init__(self, solver: CompiledSolver, scene: dict[str, list[list[float]]]) -> None:
        self.solver, self.scene = solver, scene
        self.radius, self.gap = scene["bend_radius"][0][0], scene["clearance"][0][0]

    def clear(self, shape: Shape) -> bool:
        """Whether a shape keeps clear and bends no tighter than allowed."""
        return (
            shape.status == "ok"
            and shape.min_bend_radius >= self.radius
            and clearance(shape.points, self.scene["circle"]) >= self.gap
        )

    def place(self, end: NDArray[np.floating]) -> bool:
        """Whether the held end may be there."""
        return self.clear(self.solver.solve(end, branch="ccw", throw=False))

    def lead(self, start: NDArray[np.floating], end: NDArray[np.floating]) -> tuple[Shape, ...]:
        """Shapes along a straight motion; none if it is not possible."""
        count = 2 + int(np.hypot(*(end - start)) / 0.01)
        path = self.solver.path(np.linspace(start, end, count), branch="ccw")
        own = self.solver.solve(end, branch="ccw", throw=False)
        if path.first_jump is not None or not all(self.clear(shape) for shape in path.shapes):
            return ()
        # The shape that the motion leads to must be the one that the place stands for.
        same = np.abs(own.points - path.shapes[-1].points).max() < 1e-6
        return path.shapes if same else ()


class Motions(ob.MotionValidator):
    """OMPL's question whether a motion is possible."""

    def __init__(self, space: ob.SpaceInformation, leader: Leader) -> None:
        super().__init__(space)
        self.leader = leader

    def checkMotion(self, start: ob.State, end: ob.State) -> bool:
        """Whether the cable can be led from one place to the other."""
        return bool(self.leader.lead(np.array(start[0:2]), np.array(end[0:2])))


def main() -> int:
    """Plan and draw."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--output", type=Path, required=True)
    parser.add_argument("--scene", type=Path, default=HERE / "scene.txt")
    parser.add_argument("--seconds", type=float, default=10.0)
    chosen = parser.parse_args()
    chosen.output.mkdir(parents=True, exist_ok=True)
    scene = read_scene(chosen.scene)
    leader = Leader(CompiledSolver(*example()), scene)
    ou.RNG.setSeed(1)

    space = ob.RealVectorStateSpace(2)
    bounds = ob.RealVectorBounds(2)
    for k in range(2):
        bounds.setLow(k, scene["box"][0][k])
        bounds.setHigh(k, scene["box"][0][k + 2])
    space.setBounds(bounds)
    information = ob.SpaceInformation(space)
    information.setStateValidityChecker(lambda state: leader.place(np.array(state[0:2])))
    motions = Motions(information, leader)
    information.setMotionValidator(motions)
    information.setup()
    problem = ob.ProblemDefinition(information)
    start, goal = space.allocState(), space.allocState()
    for k in range(2):
        start[k], goal[k] = scene["start"][0][k], scene["goal"][0][k]
    problem.setStartAndGoalStates(start, goal, 1e-3)
    planner = og.RRTstar(information)
    planner.setRange(0.15)
    planner.setProblemDefinition(problem)
    planner.setup()
    solved = planner.solve(chosen.seconds)
    if not problem.hasExactSolution():
        print(f"no path: {solved}", file=sys.stderr)
        return 1
    path = problem.getSolutionPath()
    places = [np.array(state[0:2]) for state in path.getStates()]
    shapes = []
    for a, b in pairwise(places):
        led = leader.lead(a, b)
        if not led:
            print("the path is not valid", file=sys.stderr)
            return 1
        shapes += [shape.points for shape in led]
    draw(np.array(shapes), scene, chosen.output / "plan_python.png")
    print(f"path of the held end: {path.length():.3f} m\n{chosen.output / 'plan_python.png'}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
