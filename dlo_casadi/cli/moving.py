"""`dlo modes`, `dlo simulate`: a fitted cable in motion."""

import argparse
from pathlib import Path
from typing import Any

import numpy as np

from dlo_casadi.cable.file import load
from dlo_casadi.cable.held import HELD
from dlo_casadi.cable.moving_table import read_fixtures
from dlo_casadi.cli.common import PARAMETERS, Page, command, figure, option
from dlo_casadi.cli.fitted import POSE

DAMPING = option(
    "--damping",
    nargs="+",
    metavar="NAME=VALUE",
    default=(),
    help="what only motion shows, if the fit does not know it: damping_time [s], air_drag, "
    "viscous_drag [N s/m^2], pin_friction [N m], dynamic_stiffness",
)


def _cable(chosen: argparse.Namespace) -> Any:
    """The cable, with the damping that is given."""
    from dlo_casadi.errors import DloError

    cable, values = load(chosen.parameters), {}
    for text in chosen.damping:
        name, _, value = text.partition("=")
        try:
            values[name] = float(value)
        except ValueError:
            raise DloError(f"--damping {text}: NAME=VALUE belongs here") from None
    return (
        cable.with_damping(values.pop("damping_time", None), **values) if chosen.damping else cable
    )


@command(
    PARAMETERS,
    *POSE,
    DAMPING,
    option("--count", type=int, default=6, metavar="N", help="number of modes (6)"),
    figure("draw them"),
)
def modes(chosen: argparse.Namespace) -> None:
    """Frequencies and damping ratios of small motions of a fitted cable about its shape.

    dlo modes results/cable --end 0.3 -0.1
    dlo modes results/cable --start-heading -1.2 --damping damping_time=0.02 --figure modes.png
    """
    from dlo_casadi.show.style import save_figure

    shape = _cable(chosen).solve(**{name: getattr(chosen, name) for name in HELD})
    found, page = shape.modes(chosen.count), Page(chosen)
    if chosen.figure is not None:
        save_figure(chosen.figure, found.plot())
    names = ("frequencies", "damping_ratios")
    page.data({name: getattr(found, name).tolist() for name in names})
    page.say(found)
    if chosen.figure is not None:
        page.say(f"Figure: {chosen.figure}")


@command(
    PARAMETERS,
    option("fixtures", type=Path, help="CSV: t_s and where the fixtures are: start_x_m, ..."),
    DAMPING,
    option("--output", type=Path, metavar="FILE", help="CSV of markers: t_s,s_m,x_m,y_m"),
    option(
        "--animate",
        type=Path,
        nargs="?",
        const=Path("motion.gif"),
        metavar="FILE",
        help="a moving picture (motion.gif)",
    ),
    figure("draw instants"),
    codes="2 is also a step in time without a solution",
)
def simulate(chosen: argparse.Namespace) -> None:
    """Simulate a fitted cable under moving fixtures, from rest.

    dlo simulate results/rope ends.csv --animate
    dlo simulate results/rope ends.csv --damping damping_time=0.02 --output motion.csv
    """
    from dlo_casadi.io.files import write_file
    from dlo_casadi.show.style import save_figure

    cable = _cable(chosen)
    t, rows = read_fixtures(cable.model.node, chosen.fixtures)
    motion, page = cable.simulate(t, **rows), Page(chosen)
    written = []
    if chosen.figure is not None:
        save_figure(chosen.figure, motion.plot())
        written.append(f"Figure: {chosen.figure}")
    if chosen.animate is not None:
        written.append(f"Moving picture: {motion.animate(chosen.animate)}")
    if chosen.output is not None:
        s = motion.s[::10]
        times, places = np.repeat(t, len(s)), np.tile(s, len(t))
        table = np.column_stack([times, places, motion.at(s).reshape((len(times), -1))])
        header = ",".join(["t_s", "s_m", *(f"{axis}_m" for axis in cable.model.node.axes)])
        lines = (",".join(f"{x:.6g}" for x in row) for row in table.tolist())
        write_file(chosen.output, "\n".join([header, *lines, ""]))
        written.append(f"Markers: {chosen.output}")
    forces = {side: getattr(motion, f"{side}_force") for side in ("start", "end")}
    largest = {side: float(np.linalg.norm(f, axis=1).max()) for side, f in forces.items()}
    page.data(
        {
            "t": t.tolist(),
            "points": motion.points.tolist(),
            **{f"{side}_force": force.tolist() for side, force in forces.items()},
            "energy": motion.energy.tolist(),
        }
    )
    page.say(f"{cable.name}: {t[0]:g} to {t[-1]:g} s in {len(motion.way.t) - 1} steps")
    for side, size in largest.items():
        page.say(f"  largest force on its {side}: {size:.4g} N")
    for line in written:
        page.say(line)
