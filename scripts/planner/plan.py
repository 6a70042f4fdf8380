"""Plan a motion of the cable's held end with OMPL in C++ and draw it.

    python scripts/planner/plan.py --output DIR [--parameters results/<run>/parameters.yaml]

Generates the solver, builds cable_planner against it, plans, checks the path again from Python
and writes shapes.txt and plan.png. Without parameters a made-up cable of 0.9 m is used.
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

from dlo_casadi.codegen import generate
from dlo_casadi.effects import Cable
from dlo_casadi.errors import DloError
from dlo_casadi.model import CableModel

HERE = Path(__file__).parent


def example() -> tuple[CableModel, NDArray[np.floating], NDArray[np.floating]]:
    """A cable of 0.9 m, pinned at both ends, straight at rest."""
    cable = Cable(length=0.9, mass=0.12, diameter=0.01, bending_stiffness=0.08, name="example")
    model = CableModel(cable, n=24, element="arc", n_rest=0)
    return model, model.nominal, np.zeros(model.chain.n_cells)


def read_scene(path: Path) -> dict[str, list[list[float]]]:
    """Items of a scene file by kind."""
    scene: dict[str, list[list[float]]] = {}
    for line in path.read_text().splitlines():
        word, *numbers = line.split()
        scene.setdefault(word, []).append([float(number) for number in numbers])
    return scene


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


def clearance(shape: NDArray[np.floating], circles: list[list[float]]) -> float:
    """Smallest distance of a polyline (k, 2) from the circles' edges [m]."""
    least = np.inf
    for x, y, r in circles:
        a, d = shape[:-1], np.diff(shape, axis=0)
        u = np.clip((([x, y] - a) * d).sum(1) / (d * d).sum(1), 0.0, 1.0)
        least = min(least, float(np.hypot(*(a + u[:, None] * d - [x, y]).T).min()) - r)
    return least


def draw(shapes: NDArray[np.floating], scene: dict[str, list[list[float]]], path: Path) -> None:
    """The cable along its way, from light to dark."""
    figure, axes = plt.subplots(figsize=(6.4, 6.4), layout="constrained")
    for x, y, r in scene["circle"]:
        axes.add_patch(plt.Circle((x, y), r, color="0.75"))
    shown = np.linspace(0, len(shapes) - 1, 18).round().astype(int)
    for k, i in enumerate(shown):
        axes.plot(*shapes[i].T, color=plt.get_cmap("viridis")(1 - k / (len(shown) - 1)), lw=1.5)
    axes.plot(*shapes[:, -1].T, "k--", lw=1.0, label="way of the held end")
    axes.plot(*scene["start"][0], "ko", mfc="w", label="start")
    axes.plot(*scene["goal"][0], "k*", ms=12, label="goal")
    axes.set_aspect("equal")
    axes.set_xlabel("x [m]")
    axes.set_ylabel("y [m]")
    axes.legend()
    figure.savefig(path, dpi=150)
    plt.close(figure)


def plan(output: Path, parameters: Path | None, scene_file: Path, iterations: int) -> str:
    """Generate, build, plan, check, draw; what the planner said."""
    if parameters is None:
        model, p, rest = example()
    else:
        from dlo_casadi.report.parameters_file import load_parameters

        model, p, rest, _ = load_parameters(parameters)
    generate(model, p, rest).write(output / "solver")
    program = build(output / "solver", output / "build")
    run = subprocess.run(
        [str(program), str(scene_file), "ccw", str(iterations), "1"], capture_output=True, text=True
    )
    if run.returncode:
        raise DloError(f"the planner found no path: {run.stderr}")
    (output / "shapes.txt").write_text(run.stdout)
    rows = np.loadtxt(output / "shapes.txt")
    shapes, scene = rows[:, :-1].reshape(len(rows), -1, 2), read_scene(scene_file)
    least = min(clearance(shape, scene["circle"]) for shape in shapes)
    radius = float(rows[:, -1].min())
    if least < scene["clearance"][0][0] - 1e-5 or radius < scene["bend_radius"][0][0] - 1e-5:
        raise DloError(f"the path keeps {least:.4f} m clear and bends to {radius:.4f} m")
    draw(shapes, scene, output / "plan.png")
    return (
        f"{run.stderr.strip()}\n{len(shapes)} shapes, clearance {least:.4f} m, smallest bend "
        f"radius {radius:.4f} m\n{output / 'plan.png'}"
    )


def main() -> int:
    """Run the command."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--output", type=Path, required=True)
    parser.add_argument("--parameters", type=Path)
    parser.add_argument("--scene", type=Path, default=HERE / "scene.txt")
    parser.add_argument("--iterations", type=int, default=2000, help="of RRT*")
    chosen = parser.parse_args()
    try:
        print(plan(chosen.output, chosen.parameters, chosen.scene, chosen.iterations))
    except DloError as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
