"""Plan a motion of the gripper that holds a cable's end with OMPL in C++, and draw it.

    python scripts/planner/plan.py --output DIR [--space | --clips] [--parameters PARAMETERS.yaml]

Generates the solver, builds cable_planner against it, plans, measures the clearance again and
writes shapes.txt and plan.png. Without parameters a made-up cable of 0.9 m is used, pinned in the
plane or, with --space, clamped in space, where the gripper moves in SE(3); with --clips two clips
hold it there, too, and the gripper threads its end through a window.
"""

import argparse
import subprocess
import sys
from pathlib import Path

import matplotlib as mpl

mpl.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline

from dlo_casadi.codegen import Capsule, Plane, generate
from dlo_casadi.effects import CableData
from dlo_casadi.equilibrium.symbolic import CasadiCable
from dlo_casadi.errors import DloError
from dlo_casadi.model.cable_model import CableModel

HERE = Path(__file__).parent
FloatArray = NDArray[np.floating]
Scene = dict[str, list[list[float]]]
# Of what a scene limits: column behind the points of a shape, and whether that is a lower bound.
LIMITS = {
    "bend_radius": (0, True),
    "force": (1, False),
    "moment": (2, False),
    "twist": (3, False),
    "clearance": (4, True),
}
UNITS = {"bend_radius": "m", "force": "N", "moment": "N m", "twist": "1/m", "clearance": "m"}


def example(*, in_space: bool = False) -> tuple[CableModel, FloatArray, FloatArray]:
    """A cable of 0.9 m, straight at rest: pinned at both ends, in space clamped."""
    if in_space:
        cable = CableData(0.9, 0.12, 0.01, 0.08, name="example", torsional_stiffness=0.06)
        model = CableModel(
            cable, 16, "quadratic", "clamped", "clamped", (0.0, 0.0, -9.81), n_rest=0
        )
    else:
        cable = CableData(0.9, 0.12, 0.01, 0.08, name="example")
        model = CableModel(cable, n=24, element="arc", n_rest=0)
    return model, model.nominal, np.zeros(model.chain.n_rests)


def scene_of(*, in_space: bool, clips: bool) -> Path:
    """The scene that comes with the example."""
    return HERE / f"scene{'_with_clips' if clips else '_in_space' if in_space else ''}.txt"


def with_clips(cable: CasadiCable, scene: Scene) -> CasadiCable:
    """The cable in the clips of a scene, all pinned."""
    return cable.with_clips(["pinned"] * len(scene.get("clip", [])))


def read_scene(path: Path) -> Scene:
    """Items of a scene file by kind."""
    scene: Scene = {}
    for line in path.read_text().splitlines():
        word, *numbers = line.split()
        scene.setdefault(word, []).append([float(number) for number in numbers])
    return scene


def obstacles_of(scene: Scene, dimension: int) -> list[Capsule | Plane]:
    """Capsules and half-spaces of a scene."""
    d = dimension
    capsules = [Capsule(tuple(o[:d]), tuple(o[d : 2 * d]), o[-1]) for o in scene.get("capsule", [])]
    halves = [
        Plane(tuple(o[:d]), tuple((np.array(o[d:]) / np.linalg.norm(o[d:])).tolist()))
        for o in scene.get("half_space", [])
    ]
    return [*capsules, *halves]


def build(solver: Path, folder: Path) -> Path:
    """Configure and compile the planner; the executable."""
    for command in (
        ["cmake", "-S", str(HERE), "-B", str(folder), f"-DSOLVER={solver.resolve()}"],
        ["cmake", "--build", str(folder)],
    ):
        run = subprocess.run(command, capture_output=True, text=True)
        if run.returncode:
            raise DloError(f"{' '.join(command)} failed:\n{run.stdout[-1500:]}{run.stderr[-1500:]}")
    return folder / "cable_planner"


def _dense(points: FloatArray) -> FloatArray:
    """Many points of a spline through the nodes of a cable."""
    spline = CubicSpline(np.linspace(0, 1, len(points)), points)
    return np.asarray(spline(np.linspace(0, 1, 20 * len(points))))


def clearance(points: FloatArray, radius: float, scene: Scene) -> float:
    """Smallest distance of a cable's surface from obstacles [m]: of a spline through its nodes."""
    places, known = _dense(points), obstacles_of(scene, points.shape[1])
    return min((float(one.near(places).distance.min()) - radius for one in known), default=np.inf)


def _tube(axes: plt.Axes, obstacle: Capsule) -> None:
    """A capsule in space."""
    a, b = np.array(obstacle.a), np.array(obstacle.b)
    along = b - a
    size = np.linalg.norm(along)
    ahead = along / size if size else np.array([0.0, 0.0, 1.0])
    side = np.cross(ahead, np.eye(3)[np.abs(ahead).argmin()])
    side /= np.linalg.norm(side)
    other = np.cross(ahead, side)
    tilt, about = np.meshgrid(np.linspace(-np.pi / 2, np.pi / 2, 16), np.linspace(0, 2 * np.pi, 24))
    shell = (
        np.sin(tilt)[..., None] * ahead
        + (np.cos(tilt) * np.cos(about))[..., None] * side
        + (np.cos(tilt) * np.sin(about))[..., None] * other
    )
    middle = np.where((tilt < 0)[..., None], a, b)
    axes.plot_surface(
        *np.moveaxis(middle + obstacle.radius * shell, -1, 0), color="0.75", alpha=0.5
    )


def draw(shapes: FloatArray, scene: Scene, path: Path) -> None:
    """The cable along its way, from light to dark."""
    d = shapes.shape[-1]
    figure = plt.figure(figsize=(6.4, 6.4), layout="constrained")
    axes = figure.add_subplot(projection="3d" if d == 3 else None)
    for obstacle in obstacles_of(scene, d):
        if isinstance(obstacle, Capsule) and d == 3:
            _tube(axes, obstacle)
        elif isinstance(obstacle, Capsule):
            line = np.array([obstacle.a, obstacle.b]).T
            axes.add_patch(plt.Circle(obstacle.a, obstacle.radius, color="0.75"))
            axes.add_patch(plt.Circle(obstacle.b, obstacle.radius, color="0.75"))
            axes.plot(*line, color="0.75")
    shown = np.linspace(0, len(shapes) - 1, 18).round().astype(int)
    for k, i in enumerate(shown):
        axes.plot(
            *_dense(shapes[i]).T, color=plt.get_cmap("viridis")(1 - k / (len(shown) - 1)), lw=1.5
        )
    for _, *place in scene.get("clip", []):
        axes.plot(*([x] for x in place), "rs", ms=5)
    axes.plot(*shapes[:, -1].T, "k--", lw=1.0, label="way of the gripper")
    axes.plot(*([x] for x in scene["start"][0][:d]), "ko", mfc="w", label="start")
    axes.plot(*([x] for x in scene["goal"][0][:d]), "k*", ms=12, label="goal")
    axes.set_aspect("equal")
    for name in "xyz"[:d]:
        getattr(axes, f"set_{name}label")(f"{name} [m]")
    figure.legend(loc="outside lower center", ncols=3)
    figure.savefig(path, dpi=150)
    plt.close(figure)


def tightest(rows: FloatArray, scene: Scene) -> str:
    """How near the path comes to each limit of the scene."""
    found = []
    for name, (column, lower) in LIMITS.items():
        if name in scene:
            worst = rows[:, column].min() if lower else rows[:, column].max()
            found.append(f"{name} {worst:.4f} {UNITS[name]} (limit {scene[name][0][0]:g})")
    return ", ".join(found)


def plan(
    output: Path, parameters: Path | None, *, in_space: bool, scene_file: Path, tries: int
) -> str:
    """Generate, build, plan, check, draw; what the planner said."""
    if parameters is None:
        bare = CasadiCable(*example(in_space=in_space))
    else:
        from dlo_casadi.cable.file import load

        bare = load(parameters)
    scene = read_scene(scene_file)
    cable = with_clips(bare, scene)
    model = cable.model
    generate(model, cable.p, cable.rest).write(output / "solver")
    program = build(output / "solver", output / "build")
    branch = "lowest" if model.in_space else "ccw"
    command = [str(program), str(scene_file), branch, str(tries), "1"]
    run = subprocess.run(command, capture_output=True, text=True)
    if run.returncode:
        raise DloError(
            f"the planner found no path: {run.stderr.strip()}\n"
            f"  Try: start, goal and limits in {scene_file} that this cable can take, or --scene"
        )
    (output / "shapes.txt").write_text(run.stdout)
    rows = np.loadtxt(output / "shapes.txt")
    points, numbers = rows[:, : -len(LIMITS)], rows[:, -len(LIMITS) :]
    shapes = points.reshape(len(rows), model.n + 1, -1)
    radius = model.cable.diameter / 2
    least = min(clearance(shape, radius, scene) for shape in shapes)
    # The spline is not the solver's cubic: they differ by less than a millimetre.
    if least < scene["clearance"][0][0] - 1e-3:
        raise DloError(f"the path keeps only {least:.4f} m clear")
    draw(shapes, scene, output / "plan.png")
    return (
        f"{run.stderr.strip()}\n{len(shapes)} shapes, nearest to its limits: "
        f"{tightest(numbers, scene)}\n{output / 'plan.png'}"
    )


def main() -> int:
    """Run the command."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--output", type=Path, required=True)
    where = parser.add_mutually_exclusive_group()
    where.add_argument("--space", action="store_true", help="the example in space")
    where.add_argument("--clips", action="store_true", help="in space, held by two clips")
    parser.add_argument("--parameters", type=Path)
    parser.add_argument("--scene", type=Path, help="otherwise that of the example")
    parser.add_argument("--iterations", type=int, default=2000, help="of RRT*")
    chosen = parser.parse_args()
    try:
        said = plan(
            chosen.output,
            chosen.parameters,
            in_space=chosen.space or chosen.clips,
            scene_file=chosen.scene or scene_of(in_space=chosen.space, clips=chosen.clips),
            tries=chosen.iterations,
        )
    except DloError as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    print(said)
    return 0


if __name__ == "__main__":
    sys.exit(main())
