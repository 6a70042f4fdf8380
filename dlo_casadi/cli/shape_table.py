"""`dlo shape-table`: shapes of a fitted cable in very many poses."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from rich.console import Console

from dlo_casadi.cli.counter import Counter
from dlo_casadi.cli.generate_solver import add_mesh, with_mesh
from dlo_casadi.cli.guard import OK
from dlo_casadi.cli.options import add_jobs, add_parameters, command, console, parsed, print_json
from dlo_casadi.cli.predict import plain_numbers
from dlo_casadi.equilibrium.fitted_cable import FittedCable
from dlo_casadi.errors import DloError
from dlo_casadi.fleet.rows import parquet_library
from dlo_casadi.fleet.shape_poses import Grid, PoseList
from dlo_casadi.fleet.shape_table import Plan, shape_table
from dlo_casadi.io.parameters import load_parameters
from dlo_casadi.model.cable_model import CableModel
from dlo_casadi.runtime.parallel import open_executor

EXAMPLES = """\
dlo shape-table results/cable --grid -0.8 0.8 200 -0.8 0.8 200 --output shapes.parquet
dlo shape-table results/cable --list ends.csv --output shapes.parquet --jobs 4
dlo shape-table results/wire --grid -0.2 0 50 0 0.1 50 --end-heading -6.28 --output wire.parquet"""


def main(argv: Sequence[str]) -> int:
    """Run `dlo shape-table PARAMETERS --grid|--list ... --output FILE [...]`."""
    parser = command(
        "shape-table",
        "Predict the shapes of a fitted cable over a grid or a list of end poses with the\n"
        "compiled solver. The same command goes on after an interruption. Poses without a shape\n"
        "say why in the column `status`.",
        EXAMPLES,
    )
    add_parameters(parser)
    which = parser.add_mutually_exclusive_group(required=True)
    which.add_argument(
        "--grid",
        nargs=6,
        type=float,
        metavar=("X0", "X1", "NX", "Y0", "Y1", "NY"),
        help="end positions [m], x fastest",
    )
    which.add_argument(
        "--list", type=Path, metavar="FILE", help="CSV or Parquet with end_x_m, end_y_m, ..."
    )
    parser.add_argument("--output", type=Path, required=True, metavar="FILE", help=".parquet")
    parser.add_argument("--start", nargs=2, type=float, metavar=("X", "Y"), help="of all poses [m]")
    parser.add_argument("--start-heading", type=float, metavar="R", help="of all poses [rad]")
    parser.add_argument("--end-heading", type=float, metavar="R", help="of all poses [rad]")
    parser.add_argument("--branch", choices=("ccw", "cw"), help="which way the cable turns")
    add_mesh(parser)
    add_jobs(parser)
    parser.add_argument("--scheduler", metavar="ADDRESS", help="of a Dask cluster, instead")
    parser.add_argument("--restart", action="store_true", help="replace what lies there")
    chosen = parsed(parser, plain_numbers(argv), "print the counts as JSON")

    if chosen.output.suffix.lower() != ".parquet":
        raise DloError(
            f"--output {chosen.output}: the table is a Parquet file.\n"
            f"  Try: --output {chosen.output.with_suffix('.parquet')}"
        )
    cable = load_parameters(chosen.parameters)
    if cable.model.in_space:
        raise DloError(
            f"{cable.model.cable.name!r} is in space: tables hold shapes in a plane.\n"
            "  Try: dlo predict, or dlo generate-solver for many shapes"
        )
    parquet_library()
    model, p, rest, metadata = with_mesh(cable, chosen)
    fixed, needed = _ends(cable, chosen.start, chosen.start_heading, chosen.end_heading)
    poses: Grid | PoseList
    if chosen.grid is not None:
        poses = _grid(model, chosen.grid, fixed, needed)
    else:
        poses = PoseList(chosen.list, tuple(needed), fixed)
    output = chosen.output.resolve()
    plan = Plan(model, p, rest, chosen.branch, output.with_name(f"{output.name}.parts"))
    with (
        Counter(Console(stderr=True), chosen.quiet, "pose", plan.chunk, poses.count) as counter,
        open_executor(chosen.jobs, chosen.scheduler) as executor,
    ):
        counts = shape_table(
            plan,
            poses,
            output,
            executor,
            metadata={"parameters_model_hash": metadata.model_hash, "config": metadata.config},
            restart=chosen.restart,
            progress=counter.show,
        )
    if chosen.json:
        print_json({"output": str(output), "solver_hash": plan.digest, "poses": counts})
    else:
        said = ", ".join(f"{n} {status.replace('_', ' ')}" for status, n in counts.items())
        console(chosen.quiet).print(f"{output}: {said or 'complete already'}", soft_wrap=True)
    return OK


def _ends(
    cable: FittedCable,
    start: Sequence[float] | None,
    start_heading: float | None,
    end_heading: float | None,
) -> tuple[dict[str, float], list[str]]:
    """What all poses share, and the columns that a list must have beside it."""
    model, shared = cable.model, cable.metadata.fixtures
    x, y = start if start is not None else shared.get("start") or (0.0, 0.0)
    fixed = {"start_x": float(x), "start_y": float(y)}
    needed = [] if model.end == "free" else ["end_x_m", "end_y_m"]
    for side, given in (("start", start_heading), ("end", end_heading)):
        held = getattr(model, side)
        if held != "clamped":
            if given is not None:
                raise DloError(f"--{side}-heading: the {side} of this cable is {held}")
            continue
        heading = given if given is not None else shared.get(f"{side}_heading")
        if heading is None:
            needed.append(f"{side}_heading_rad")
        else:
            fixed[f"{side}_heading"] = float(heading)
    return fixed, needed


def _grid(
    model: CableModel, numbers: Sequence[float], fixed: dict[str, float], needed: Sequence[str]
) -> Grid:
    """The grid, if all that it does not say is known."""
    if model.end == "free":
        raise DloError("--grid: the end of this cable is free, it has no place; use --list")
    headings = [name for name in needed if name.endswith("_rad")]
    if headings:
        raise DloError(
            "--grid: this cable is clamped, and the session's poses do not share "
            f"{' and '.join(name.removesuffix('_rad') for name in headings)}.\n"
            "  Try: --start-heading, --end-heading [rad]"
        )
    x0, x1, nx, y0, y1, ny = numbers
    for number in (nx, ny):
        if number != int(number):
            raise DloError(f"--grid: {number:g} is no number of places")
    return Grid((x0, x1, int(nx)), (y0, y1, int(ny)), fixed)
