"""Plan the same motion from Python, with the PyPI package ompl and the compiled solver.

    pip install ompl
    python scripts/planner/plan_python.py --output DIR [--space | --clips]

Compiles the solver, plans with RRT*, writes plan_python.png.
"""

import argparse
import sys
from collections import Counter
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from plan import LIMITS, Scene, draw, example, obstacles_of, read_scene, scene_of, with_clips

from dlo_casadi.codegen import CompiledShape, CompiledSolver
from dlo_casadi.equilibrium.pose import HeldPose
from dlo_casadi.equilibrium.symbolic import CasadiCable
from dlo_casadi.model.clips import HeldClip

try:
    from ompl import base as ob
    from ompl import geometric as og
    from ompl import util as ou
except ModuleNotFoundError:
    sys.exit("error: planning from Python needs OMPL's package.\n  Try: pip install ompl")


class InPlane:
    """The gripper's place in the plane; the cable is pinned and turns counter-clockwise."""

    def __init__(self) -> None:
        self.space, self.solver = ob.RealVectorStateSpace(2), CompiledSolver(*example())

    def put(self, state: Any, numbers: list[float]) -> None:
        """Set a state."""
        state[0], state[1] = numbers

    def at(self, state: Any) -> HeldPose:
        """What the solver is asked for."""
        return HeldPose((0.0, 0.0), (state[0], state[1]), branch="ccw")


class InSpace:
    """The gripper's place and orientation, in SE(3); the cable is clamped."""

    def __init__(self, scene: Scene) -> None:
        cable = with_clips(CasadiCable(*example(in_space=True)), scene)
        self.space = ob.SE3StateSpace()
        self.solver = CompiledSolver(cable.model, cable.p, cable.rest)
        clips = scene.get("clip", [])
        self.clips = tuple(HeldClip("pinned", tuple(place), at) for at, *place in clips)
        self.held = tuple(scene["held"][0])

    def put(self, state: Any, numbers: list[float]) -> None:
        """Set a state."""
        state.setXYZ(*numbers[:3])
        turn, size = state.rotation(), np.linalg.norm(numbers[3:])
        turn.x, turn.y, turn.z, turn.w = (number / size for number in numbers[3:])

    def at(self, state: Any) -> HeldPose:
        """What the solver is asked for."""
        turn, place = state.rotation(), (state.getX(), state.getY(), state.getZ())
        last = (turn.x, turn.y, turn.z, turn.w)
        frames = {"start_orientation": self.held, "end_orientation": last}
        return HeldPose((0.0, 0.0, 0.0), place, clips=self.clips, **frames)


class Leader:
    """The cable in the scene: which states and motions of the gripper are allowed."""

    def __init__(self, gripper: InPlane | InSpace, scene: Scene) -> None:
        self.gripper, self.refused = gripper, Counter[str]()
        self.obstacles = obstacles_of(scene, gripper.solver.model.node.dimension)
        self.limits = {name: scene[name][0][0] for name in LIMITS if name in scene}

    def limit(self, shape: CompiledShape) -> str | None:
        """The limit that a shape does not keep."""
        if shape.status != "ok":
            return "no equilibrium"
        usages = self.gripper.solver.limits(shape, self.limits, self.obstacles)
        tightest = next(iter(usages))
        return tightest if usages[tightest].margin < 0 else None

    def place(self, state: Any) -> bool:
        """Whether the gripper may be in a state."""
        return self._judge(self.limit(self._shape(self.gripper.at(state))), "state")

    def lead(self, start: Any, end: Any) -> tuple[Any, ...]:
        """Shapes along a motion; none if it is not possible."""
        gripper, space = self.gripper, self.gripper.space
        count, state, way = 2 + int(space.distance(start, end) / 0.01), space.allocState(), []
        for u in np.linspace(0.0, 1.0, count):
            space.interpolate(start, end, u, state)
            way.append(gripper.at(state))
        path = gripper.solver.path(way)
        why = "snap" if path.first_jump is not None else None
        why = why or next(filter(None, map(self.limit, path.shapes)), None)
        if not why:
            # The shape that the motion leads to must be the one that the state stands for.
            own = self._shape(way[-1])
            far = np.abs(own.points - path.shapes[-1].points).max() > 1e-6
            why = "another shape" if far else None
        return path.shapes if self._judge(why, "motion") else ()

    def _shape(self, pose: HeldPose) -> CompiledShape:
        """Shape of the cable, whatever its status."""
        return self.gripper.solver.solve(pose, throw=False)

    def _judge(self, why: str | None, what: str) -> bool:
        if why:
            self.refused[f"{why} of a {what}"] += 1
        return not why


class Motions(ob.MotionValidator):
    """OMPL's question whether a motion is possible."""

    def __init__(self, space: ob.SpaceInformation, leader: Leader) -> None:
        super().__init__(space)
        self.leader = leader

    def checkMotion(self, start: ob.State, end: ob.State) -> bool:
        """Whether the cable can be led from one state to the other."""
        return bool(self.leader.lead(start, end))


def main() -> int:
    """Plan and draw."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--output", type=Path, required=True)
    where = parser.add_mutually_exclusive_group()
    where.add_argument("--space", action="store_true", help="the example in space")
    where.add_argument("--clips", action="store_true", help="in space, held by two clips")
    parser.add_argument("--scene", type=Path, help="otherwise that of the example")
    parser.add_argument("--seconds", type=float, default=10.0)
    chosen = parser.parse_args()
    chosen.output.mkdir(parents=True, exist_ok=True)
    in_space = chosen.space or chosen.clips
    scene = read_scene(chosen.scene or scene_of(in_space=in_space, clips=chosen.clips))
    gripper = InSpace(scene) if in_space else InPlane()
    leader = Leader(gripper, scene)
    ou.RNG.setSeed(1)

    bounds = ob.RealVectorBounds(len(scene["low"][0]))
    for k, (low, high) in enumerate(zip(scene["low"][0], scene["high"][0], strict=True)):
        bounds.setLow(k, low)
        bounds.setHigh(k, high)
    gripper.space.setBounds(bounds)
    information = ob.SpaceInformation(gripper.space)
    information.setStateValidityChecker(leader.place)
    motions = Motions(information, leader)
    information.setMotionValidator(motions)
    information.setup()
    problem = ob.ProblemDefinition(information)
    start, goal = gripper.space.allocState(), gripper.space.allocState()
    gripper.put(start, scene["start"][0])
    gripper.put(goal, scene["goal"][0])
    problem.setStartAndGoalStates(start, goal, 1e-3)
    planner = og.RRTstar(information)
    planner.setRange(0.4 if in_space else 0.15)
    planner.setProblemDefinition(problem)
    planner.setup()
    solved = planner.solve(chosen.seconds)
    for why, count in sorted(leader.refused.items()):
        print(f"turned down for {why}: {count}")
    if not problem.hasExactSolution():
        print(f"no path: {solved}", file=sys.stderr)
        return 1
    path = problem.getSolutionPath()
    shapes = []
    for a, b in pairwise(path.getStates()):
        led = leader.lead(a, b)
        if not led:
            print("the path is not valid", file=sys.stderr)
            return 1
        shapes += [shape.points for shape in led]
    draw(np.array(shapes), scene, chosen.output / "plan_python.png")
    length = f"{path.length():.3f} m{' + rad' if in_space else ''}"
    print(f"path of the gripper: {length}\n{chosen.output / 'plan_python.png'}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
