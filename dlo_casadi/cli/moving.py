"""`dlo modes`, `dlo simulate`, `dlo move`: a fitted cable in motion."""

import argparse
from pathlib import Path
from typing import Any

import numpy as np

from dlo_casadi.cable.file import load
from dlo_casadi.cable.held import HELD
from dlo_casadi.cable.moving_table import read_fixtures
from dlo_casadi.cli.common import PARAMETERS, Page, Watch, command, figure, option
from dlo_casadi.cli.fitted import CLIPS_OF_A_POSE, OBSTACLES, POSE, listed, named

DAMPING = option(
    "--damping",
    nargs="+",
    metavar="NAME=VALUE",
    default=(),
    help="what only motion shows, if the fit does not know it: damping_time [s], air_drag, "
    "viscous_drag [N s/m^2], pin_friction [N m], dynamic_stiffness",
)


_WHERE = (
    "start=0,0 end=0.3,0.1 start_heading=-1.2 ..., in space start_orientation=QX,QY,QZ,QW; "
    "numbers [m, rad] with commas"
)


def _held(words: list[str]) -> dict[str, Any]:
    """Keywords of `solve` from NAME=NUMBERS."""
    from dlo_casadi.errors import DloError

    found: dict[str, Any] = {}
    for word in words:
        name, _, text = word.partition("=")
        try:
            values = [float(x) for x in text.split(",")]
        except ValueError:
            values = []
        if name not in HELD:
            raise DloError(f"{word}: nothing is held by {name!r}.\n  Try: {_WHERE}")
        if not values:
            raise DloError(f"{word}: NAME=NUMBERS belongs here.\n  Try: {_WHERE}")
        found[name] = values[0] if len(values) == 1 else tuple(values)
    return found


def damped(chosen: argparse.Namespace) -> Any:
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
    CLIPS_OF_A_POSE,
    DAMPING,
    option("--count", type=int, default=6, metavar="N", help="number of modes (6)"),
    option("--animate", type=Path, metavar="FILE", help="a moving picture of them: modes.svg"),
    figure("draw them"),
)
def modes(chosen: argparse.Namespace) -> None:
    """Frequencies and damping ratios of small motions of a fitted cable about its shape.

    dlo modes results/cable --end 0.3 -0.1
    dlo modes results/cable --start-heading -1.2 --damping damping_time=0.02 --figure modes.png
    """
    from dlo_casadi.cable.shape_in_motion import svg_file
    from dlo_casadi.show.style import save_figure

    if chosen.animate is not None:
        svg_file(chosen.animate)  # before anything is computed
    asked = {name: getattr(chosen, name) for name in HELD}
    shape = damped(chosen).solve(**asked, clips=listed(chosen, "clips"))
    found, page = shape.modes(chosen.count), Page(chosen)
    if chosen.figure is not None:
        save_figure(chosen.figure, found.plot())
    names = ("frequencies", "frequency_std", "damping_ratios", "damping_ratio_std")
    page.data({name: getattr(found, name).tolist() for name in names})
    page.say(found)
    if chosen.animate is not None:
        page.say(f"Moving picture: {found.animate(chosen.animate)}")
    if chosen.figure is not None:
        page.say(f"Figure: {chosen.figure}")


@command(
    PARAMETERS,
    option("fixtures", type=Path, help="CSV: t_s and where the fixtures are: start_x_m, ..."),
    CLIPS_OF_A_POSE,
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
    from dlo_casadi.cable.simulated import gif_file
    from dlo_casadi.io.files import write_file
    from dlo_casadi.show.style import save_figure

    if chosen.animate is not None:
        gif_file(chosen.animate)  # before anything is computed
    cable = damped(chosen)
    t, rows = read_fixtures(cable.model.node, chosen.fixtures)
    motion, page = cable.simulate(t, **rows, clips=listed(chosen, "clips")), Page(chosen)
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
    page.data(
        {
            "t": t.tolist(),
            "points": motion.points.tolist(),
            "start_force": motion.start_force.tolist(),
            "end_force": motion.end_force.tolist(),
            "clip_forces": {name: force.tolist() for name, force in motion.clip_forces.items()},
            "energy": motion.energy.tolist(),
        }
    )
    page.say(motion)
    for line in written:
        page.say(line)


@command(
    PARAMETERS,
    option("--from", nargs="+", required=True, dest="before", metavar="NAME=X", help=_WHERE),
    option("--to", nargs="+", required=True, dest="after", metavar="NAME=X", help="likewise"),
    option("--duration", type=float, metavar="T", help="[s]; by default the shortest"),
    option(
        "--limits",
        nargs="+",
        metavar="NAME=VALUE",
        help="speed [m/s], acceleration [m/s^2], jerk [m/s^3], turn_speed [rad/s], "
        "turn_acceleration [rad/s^2], force [N], moment [N m], bend_radius [m], clearance [m], "
        "swing [m]",
    ),
    OBSTACLES,
    option("--robust", action="store_true", help="least swing under the fit's covariance"),
    DAMPING,
    option("--output", type=Path, metavar="FILE", help="table for the robot: .csv or .json"),
    option("--rate", type=float, default=250.0, metavar="HZ", help="rows a second (250)"),
    option("--animate", type=Path, metavar="FILE", help="a moving picture (.gif)"),
    figure("draw it beside the swing of other motions"),
    codes="2 is also a motion that limits do not allow",
)
def move(chosen: argparse.Namespace) -> None:
    """Plan a motion of the fixtures after which a fitted cable is at rest.

    dlo move results/rope --from start=0,0 start_heading=-1 --to start=0.3,0 start_heading=-1
    dlo move results/rope --from end=0.3,0 --to end=0.4,0.1 --duration 1.2 --output way.csv
    dlo move results/rope --from end=0.3,0 --to end=0.4,0.1 --limits speed=0.5 force=2
    """
    from dlo_casadi.cable.move_checks import table_file
    from dlo_casadi.cable.simulated import gif_file
    from dlo_casadi.errors import DloError
    from dlo_casadi.show.style import save_figure

    if not 1.0 <= chosen.rate <= 1e4:
        raise DloError(f"--rate {chosen.rate:g}: 1 to 10000 rows a second")
    if chosen.output is not None:
        table_file(chosen.output)  # before anything is planned
    if chosen.animate is not None:
        gif_file(chosen.animate)
    with Watch(quiet=chosen.quiet) as watch:
        found = damped(chosen).move(
            _held(chosen.before),
            _held(chosen.after),
            duration=chosen.duration,
            limits=named("limits", chosen),
            obstacles=listed(chosen, "obstacles"),
            robust=chosen.robust,
            progress=watch,
        )
    page = Page(chosen)
    page.data(found.as_dict())
    page.say(found)
    if chosen.output is not None:
        page.say(f"Table: {found.save(chosen.output, rate=chosen.rate)}")
    if chosen.animate is not None:
        page.say(f"Moving picture: {found.animate(chosen.animate)}")
    if chosen.figure is not None:
        save_figure(chosen.figure, found.plot())
        page.say(f"Figure: {chosen.figure}")
