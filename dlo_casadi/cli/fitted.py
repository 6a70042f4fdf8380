"""`dlo predict`, `dlo limits`, `dlo shape-table`, `dlo generate-solver`: uses of a fitted cable."""

import argparse
from dataclasses import replace
from pathlib import Path
from typing import Any

from dlo_casadi.cable.file import load
from dlo_casadi.cable.fitted_cable import FittedCable, Shape
from dlo_casadi.cable.held import HELD, listed_poses
from dlo_casadi.cable.limits import LimitCheck
from dlo_casadi.cli.common import (
    PARAMETERS,
    SCHEDULER,
    Counter,
    Page,
    Watch,
    command,
    figure,
    jobs,
    one_of,
    option,
)
from dlo_casadi.codegen import generate
from dlo_casadi.codegen.shapes import pose_size
from dlo_casadi.config import read_yaml
from dlo_casadi.effects import ContactEffect
from dlo_casadi.errors import DloError, EquilibriumError
from dlo_casadi.fleet import shape_table as tables
from dlo_casadi.fleet.shape_table import COLUMNS, Grid, Plan, PoseList
from dlo_casadi.rod.chain import ELEMENTS
from dlo_casadi.rod.supports import CLIPS
from dlo_casadi.runtime.parallel import open_executor

BRANCH = option("--branch", choices=("ccw", "cw"), help="which way the cable turns")
MESH = (
    option("--elements", type=int, help="number of elements, instead of the fit's"),
    option(
        "--element",
        choices=ELEMENTS,
        help="instead of the fit's; arcs are several times faster than quadratic elements",
    ),
)
_LIMITS = "bend_radius, clearance [m], force [N], moment [N m], twist [1/m]; the session's without"
OBSTACLES = option(
    "--obstacles",
    type=Path,
    metavar="FILE",
    help="YAML: a list, as in an experiment; the session's are not used",
)
LIMITS = (
    option("--limits", nargs="*", metavar="NAME=VALUE", help=f"check limits: {_LIMITS}"),
    option(
        "--tolerances",
        nargs="+",
        metavar="NAME=VALUE",
        help="of other fixtures than the session's: end, length, clip, slip, obstacle [m], "
        "heading, rotation, roll [rad]",
    ),
)
POSE = (
    *(
        option(
            f"--{side}",
            nargs="+",
            type=float,
            metavar="X",
            help=f"where the {side} is held, X Y or in space X Y Z [m]{remark}",
        )
        for side, remark in (("end", "; not for a free end"), ("start", ""))
    ),
    option("--start-heading", type=float, metavar="R", help="clamped start [rad]"),
    option("--end-heading", type=float, metavar="R", help="clamped end [rad]"),
    *(
        option(
            f"--{side}-orientation",
            nargs=4,
            type=float,
            metavar=("QX", "QY", "QZ", "QW"),
            help=f"frame of the clamp at the {side} in space, x forward along the cable",
        )
        for side in ("start", "end")
    ),
    option("--turns", type=float, metavar="N", help="extra turns of twist in space"),
    option("--end-tension", type=float, metavar="N", help="tension beyond a sliding end [N]"),
    option("--start-tension", type=float, metavar="N", help="tension beyond a sliding start [N]"),
    option("--free-length", type=float, metavar="M", help="length between ends that slide [m]"),
    BRANCH,
)


CLIPS_OF_A_POSE = option(
    "--clips", type=Path, metavar="FILE", help="YAML: a list of clips, as in a pose"
)


@command(
    PARAMETERS,
    *POSE,
    CLIPS_OF_A_POSE,
    OBSTACLES,
    option(
        "--over",
        nargs="+",
        metavar="SIDE",
        help="over or under bars: true or false of all, or NAME=true ... of some",
    ),
    *LIMITS,
    figure("draw it"),
    codes="2 is also a pose without an equilibrium",
)
def predict(chosen: argparse.Namespace) -> None:
    """Predict the shape of a fitted cable from where its ends are held.

    dlo predict results/cable --end 0.3 -0.1
    dlo predict results/cable --end 0.3 -0.1 --figure shape.png
    dlo predict results/cable --start 0.1 0 --end 0.3 -0.1 --branch cw --json
    dlo predict results/wire --end -0.12 0 --start-heading 0 --end-heading -6.2832
    dlo predict results/loom --end 0.6 0.1 0.3 --end-orientation 0 0 0 1 --turns 1
    dlo predict results/cable --end 0.3 -0.1 --limits bend_radius=0.05 force=8 --tolerances end=2e-3
    """
    from dlo_casadi.report.terminal import limits_table, prediction_table
    from dlo_casadi.show.style import save_figure

    asked = {name: getattr(chosen, name) for name in HELD}
    asked |= {name: listed(chosen, name) for name in ("clips", "obstacles")}
    shape = load(chosen.parameters).solve(**asked, over=_sides(chosen.over))
    if chosen.figure is not None:
        save_figure(chosen.figure, shape.plot())
    # What a reader of the prediction should know about the file it came from.
    notes = []
    if shape.cable.metadata.edited:
        notes.append("note: the model in this file was changed after it had been fitted")
    if shape.cable.metadata.explains is False:
        notes.append(
            "note: the model does not explain the shapes it was fitted to (verdict: unexplained); "
            "the prediction may be farther off than its band"
        )
    if shape.cable.params["bending_stiffness"].identifiable is False:
        notes.append(
            "note: the shapes did not determine the bending stiffness; the shape is more certain "
            "than forces and energy"
        )
    if moved := _found_offsets(shape.cable):
        notes.append(
            f"note: the fit has {moved}; a prediction uses neither the session's obstacles nor "
            "these offsets. --obstacles stay where their file declares them"
        )
    page, found = Page(chosen), shape.as_dict()
    asked_for = (chosen.limits, chosen.tolerances) != (None, None)
    checks = _checked(shape, chosen) if asked_for else None
    if checks is not None:
        found["limits"] = [check.as_dict() for check in checks]
    page.data(found)
    page.print(prediction_table(shape, notes))
    if checks is not None:
        page.print(limits_table(shape.cable.name, checks))
    if chosen.figure is not None:
        page.say(f"Figure: {chosen.figure}")


def _found_offsets(cable: FittedCable) -> str:
    """Offsets of the session's obstacles beyond their tolerances, as text; empty without any."""
    model = cable.model
    effects = [x for x in model.effects if isinstance(x, ContactEffect)]
    names = [
        f"{effect.label}.{q.name}"
        for effect in effects
        if effect.surface(model.gravity) is None
        for q in effect.parameters(model.cable)
    ]
    found = [f"{name} {cable.params[name]}" for name in names if name not in model.priors]
    return " and ".join(found)


def listed(chosen: argparse.Namespace, name: str) -> list[Any]:
    """Clips or obstacles from the command's file; empty without a file."""
    path, kind = getattr(chosen, name), {"clips": CLIPS[0], "obstacles": "plane"}[name]
    found = [] if path is None else read_yaml(path)
    if not isinstance(found, list):
        raise DloError(f"{path}: a list of {name} belongs here: - {{kind: {kind}, ...}}")
    return found


def _sides(words: list[str] | None) -> bool | dict[str, bool] | None:
    """Sides of bars, from true or false alone, or from NAME=true ..."""
    if words is None:
        return None
    said = {"true": True, "false": False}
    if len(words) == 1 and words[0] in said:
        return said[words[0]]
    sides = {}
    for word in words:
        name, _, side = word.rpartition("=")
        if not name or side not in said:
            text = f"--over {word}: true, false or NAME=true belongs here, such as bar=true"
            raise DloError(text)
        sides[name] = said[side]
    return sides


def _checked(shape: Shape, chosen: argparse.Namespace) -> tuple[LimitCheck, ...]:
    """Check a shape against the limits of the command, or those of the session."""
    return shape.check(named("limits", chosen) or None, tolerances=named("tolerances", chosen))


def named(key: str, chosen: argparse.Namespace) -> dict[str, float]:
    """Numbers by name, from NAME=VALUE."""
    found = {}
    for word in getattr(chosen, key) or ():
        name, _, value = word.partition("=")
        try:
            found[name] = float(value)
        except ValueError:
            raise DloError(
                f"--{key} {word}: NAME=VALUE belongs here, such as "
                f"{'end=2e-3' if key == 'tolerances' else 'bend_radius=0.05'}"
            ) from None
    return found


@command(
    PARAMETERS,
    option("poses", type=Path, help="CSV with end_x_m, end_y_m, ...; in space also end_qx, ..."),
    OBSTACLES,
    *LIMITS,
)
def limits(chosen: argparse.Namespace) -> None:
    """Check whether a fitted cable keeps its limits in every pose of a list, and how sure that is.

    dlo limits results/cable poses.csv
    dlo limits results/cable poses.csv --limits bend_radius=0.05 force=8 --tolerances end=2e-3
    """
    from dlo_casadi.report.terminal import limits_table

    cable, obstacles = load(chosen.parameters), listed(chosen, "obstacles")
    checks: list[LimitCheck] = []
    lost: dict[str, str] = {}
    poses = listed_poses(cable.model, chosen.poses)
    with Watch(quiet=chosen.quiet) as watch:
        for k, (name, ends) in enumerate(poses.items(), start=1):
            try:
                shape = cable.solve(**ends, obstacles=obstacles)
            except EquilibriumError as error:
                lost[name] = error.message.partition("\n")[0]
            else:
                named = replace(shape, pose=replace(shape.pose, name=name))
                checks += _checked(named, chosen)
            watch.step("check the poses", k, len(poses))
    if not checks:
        name, problem = next(iter(lost.items()))
        raise EquilibriumError(f"no limit is checked, no pose has a shape: {name}: {problem}")
    page = Page(chosen)
    page.data({"limits": [check.as_dict() for check in checks], "without_shape": lost})
    page.print(limits_table(cable.name, checks))
    for name, problem in lost.items():
        page.warn(f"{name}: {problem}")


@command(
    PARAMETERS,
    one_of(
        option(
            "--grid",
            nargs=6,
            type=float,
            metavar=("X0", "X1", "NX", "Y0", "Y1", "NY"),
            help="end positions [m], x fastest",
        ),
        option(
            "--list", type=Path, metavar="FILE", help="CSV or Parquet with end_x_m, end_y_m, ..."
        ),
        required=True,
    ),
    option("--output", type=Path, required=True, metavar="FILE", help=".parquet"),
    option("--start", nargs=2, type=float, metavar=("X", "Y"), help="of all poses [m]"),
    option("--start-heading", type=float, metavar="R", help="of all poses [rad]"),
    option("--end-heading", type=float, metavar="R", help="of all poses [rad]"),
    BRANCH,
    *MESH,
    jobs(),
    SCHEDULER,
    option("--restart", action="store_true", help="replace what lies there"),
    json="print the counts as JSON",
)
def shape_table(chosen: argparse.Namespace) -> None:
    """Predict the shapes of a fitted cable over a grid or a list of end poses with the
    compiled solver. The same command goes on after an interruption. Poses without a shape
    say why in the column `status`.

    dlo shape-table results/cable --grid -0.8 0.8 200 -0.8 0.8 200 --output shapes.parquet
    dlo shape-table results/cable --list ends.csv --output shapes.parquet --jobs 4
    dlo shape-table results/wire --grid -0.2 0 50 0 0.1 50 --end-heading -6.28 --output wire.parquet
    """
    if chosen.output.suffix.lower() != ".parquet":
        raise DloError(
            f"--output {chosen.output}: the table is a Parquet file.\n"
            f"  Try: --output {chosen.output.with_suffix('.parquet')}"
        )
    cable = load(chosen.parameters)
    if pose_size(cable.model) != len(COLUMNS):
        what = "clips" if cable.model.clips else "an end that slides"
        where = "is in space" if cable.model.in_space else f"has {what}"
        raise DloError(
            f"{cable.model.cable.name!r} {where}: tables hold shapes in a plane, of two ends.\n"
            "  Try: dlo predict, or dlo generate-solver for many shapes"
        )
    cable = cable.with_mesh(chosen.elements, chosen.element)
    metadata = cable.metadata
    poses = _poses(cable, chosen)
    plan = Plan(cable.model, cable.p, cable.rest, chosen.branch, chosen.output.resolve())
    counter = Counter(quiet=chosen.quiet, noun="pose", size=plan.chunk, count=poses.count)
    with counter, open_executor(chosen.jobs, chosen.scheduler) as executor:
        counts = tables.shape_table(
            plan,
            poses,
            executor,
            metadata={"parameters_model_hash": metadata.model_hash, "config": metadata.config},
            restart=chosen.restart,
            progress=counter.show,
        )
    page = Page(chosen)
    page.data({"output": str(plan.output), "solver_hash": plan.digest, "poses": counts})
    said = ", ".join(f"{n} {status.replace('_', ' ')}" for status, n in counts.items())
    page.say(f"{plan.output}: {said or 'complete already'}")


def _poses(cable: FittedCable, chosen: argparse.Namespace) -> Grid | PoseList:
    """The poses; columns missing in a list come from the options or the session."""
    model, shared = cable.model, cable.metadata.fixtures
    x, y = chosen.start or shared.get("start") or (0.0, 0.0)
    fixed = {"start_x": float(x), "start_y": float(y)}
    unknown = []
    for side in ("start", "end"):
        held, name = getattr(model, side), f"{side}_heading"
        heading = getattr(chosen, name)
        if not held.direction:
            if heading is not None:
                raise DloError(f"--{side}-heading: the {side} of this cable is {held}")
            continue
        heading = shared.get(name) if heading is None else heading
        if heading is None:
            unknown.append(name)
        else:
            fixed[name] = float(heading)
    if chosen.grid is None:
        place = ("end_x_m", "end_y_m") if model.end.place else ()
        return PoseList(chosen.list, (*place, *(f"{name}_rad" for name in unknown)), fixed)
    if not model.end.place:
        raise DloError("--grid: the end of this cable is free, it has no place; use --list")
    if unknown:
        raise DloError(
            "--grid: this cable is clamped, and the session's poses do not share "
            f"{' and '.join(unknown)}.\n  Try: --start-heading, --end-heading [rad]"
        )
    x0, x1, nx, y0, y1, ny = chosen.grid
    return Grid((x0, x1, nx), (y0, y1, ny), fixed)


@command(
    PARAMETERS,
    option("--output", type=Path, required=True, help="folder for the C files"),
    option("--prefix", default="dlo", help="begins all public names (dlo)"),
    option(
        "--clips",
        nargs="+",
        default=(),
        choices=[str(kind) for kind in CLIPS],
        help="what holds it between",
    ),
    option(
        "--obstacles",
        type=int,
        default=0,
        metavar="N",
        help="maximum number of obstacles; they are given with each pose",
    ),
    option("--motion", action="store_true", help="also step the cable in time (dlo_advance)"),
    *MESH,
    json="print files and hash as JSON",
)
def generate_solver(chosen: argparse.Namespace) -> None:
    """Write the C solver of a fitted cable for planners to embed: <prefix>_solver.h,
    <prefix>_solver.c, <prefix>_solver.hpp for C++, CMakeLists.txt, <prefix>_solver.pc.in and
    example.c.

    dlo generate-solver results/cable/parameters.yaml --output solver
    dlo generate-solver results/cable --output solver --prefix rope --elements 40
    dlo generate-solver results/loom --output solver --clips pinned pinned
    dlo generate-solver results/cable --output solver --obstacles 3
    dlo generate-solver results/rope --output solver --motion
    """
    cable = load(chosen.parameters).with_mesh(chosen.elements, chosen.element)
    cable = cable.with_clips(chosen.clips)
    asked = {"obstacles": chosen.obstacles, "motion": chosen.motion}
    solver = generate(cable.model, cable.p, cable.rest, chosen.prefix, **asked)
    written = solver.write(chosen.output)
    page = Page(chosen)
    page.data({"files": [str(path) for path in written], "solver_hash": solver.hash})
    for text in (*written, f"solver hash {solver.hash}"):
        page.say(text)
