"""`dlo export`: a fitted cable as the file of a simulator."""

import argparse
from pathlib import Path
from typing import Any

from dlo_casadi.cable.exported import given_motion
from dlo_casadi.cable.fitted_cable import FittedCable
from dlo_casadi.cable.held import HELD
from dlo_casadi.cli.common import PARAMETERS, Page, Watch, command, figure, option
from dlo_casadi.cli.fitted import POSE
from dlo_casadi.cli.moving import DAMPING, damped
from dlo_casadi.errors import DloError
from dlo_casadi.export.rod import Rod
from dlo_casadi.export.targets import TARGETS, check_counts, losses, require, step_of, target_of

# `--check` without a session.
_NEAR = Path()
_SAMPLES = "further cables drawn from the fit's covariance"
_MOTION = "how the fixtures move: a table as of `dlo move` and `dlo simulate` (MuJoCo)"
_SEGMENTS = "number of links; by default as many as the bends need"


@command(
    PARAMETERS,
    option("--to", required=True, metavar="SIMULATOR", help=f"one of {', '.join(TARGETS)}"),
    option("--output", type=Path, metavar="FILE", help="by default named after the session"),
    option("--samples", type=int, default=0, metavar="N", help=_SAMPLES),
    option("--seed", type=int, default=0, metavar="N", help="random seed of --samples (0)"),
    option("--motion", type=Path, metavar="CSV", help=_MOTION),
    DAMPING,
    option("--segments", type=int, metavar="N", help=_SEGMENTS),
    option(
        "--check",
        type=Path,
        nargs="?",
        const=_NEAR,
        metavar="SESSION",
        help="relax it in the simulator in every held-out pose; SESSION is found if it is near",
    ),
    figure("draw the check"),
    *POSE,
    json="print files, losses and errors as JSON",
)
def export(chosen: argparse.Namespace) -> None:
    """Write a fitted cable for a simulator: rest shape, stiffness and weight, in the pose that it
    starts in, by default the session's first with its clips and obstacles. The file's head says
    which number stands where.

    dlo export results/cable --to mujoco                        cable.xml
    dlo export results/cable --to mujoco --end 0.3 -0.1 --output rope.xml
    dlo export results/cable --to mujoco --samples 50           cable_001.xml, ... beside it
    dlo export results/cable --to usd                           cable.usda: a curve with its physics
    dlo export results/cable --to pyelastica --check            is it the cable that was measured?
    dlo export results/cable --to mujoco --check cable.yaml --figure check.png
    dlo export results/cable --to mujoco --motion way.csv --check      does it swing as simulated?
    """
    from dlo_casadi.report.round_trip import draw_round_trip, round_trip_dict, round_trip_table
    from dlo_casadi.session.round_trip import (
        comparable,
        motion_round_trip,
        round_trip,
        session_of,
    )
    from dlo_casadi.show.style import save_figure

    target, cable = target_of(chosen.to), damped(chosen)
    check_counts(chosen.segments, chosen.samples, chosen.seed)
    moves = {} if chosen.motion is None else {"motion": chosen.motion}
    if chosen.figure is not None and (chosen.check is None or moves):
        raise DloError("--figure draws the check of poses.\n  Try: with --check, without --motion")
    if moves and chosen.check not in (None, _NEAR):
        raise DloError(f"--check {chosen.check}: a motion has no poses.\n  Try: --check alone")
    config = None
    if chosen.check is not None:
        require(target)
    if chosen.check is not None and not moves:
        config = session_of(cable, None if chosen.check == _NEAR else chosen.check)
        comparable(config, target)
    held = _given(chosen) if moves else _held(cable, chosen)
    first = given_motion(cable, chosen.motion, step_of(target), held).first if moves else held
    path = chosen.output or Path(f"{cable.metadata.config}{target.suffix}")
    shape = cable.solve(**first)
    files = cable.export(
        chosen.to,
        path,
        segments=chosen.segments,
        samples=chosen.samples,
        seed=chosen.seed,
        **moves,
        **held,
    )
    rod = Rod.of(shape.held, chosen.segments)
    lost = losses(shape.held, target, rod)
    page = Page(chosen)
    for feature, cost in lost.items():
        page.warn(f"{target.title} cannot represent {feature}: {cost}")
    others = f" and {len(files) - 1} more, seed {chosen.seed}" if chosen.samples else ""
    page.say(f"{path}{others}: {len(rod.masses)} links")
    told = {"files": [str(file) for file in files], "links": len(rod.masses), "not_carried": lost}
    if moves and chosen.check is not None:
        with Watch(quiet=chosen.quiet):
            apart = motion_round_trip(cable, target, path, chosen.motion, chosen.segments, held)
        told["check"] = {"rms": apart.rms, "largest": apart.largest}
        page.say(
            f"{target.title} from our simulation: {100 * apart.rms:.3g} % of the length RMS, "
            f"{100 * apart.largest:.3g} % at most"
        )
    if config is not None:
        with Watch(quiet=chosen.quiet) as watch:
            rows = list(round_trip(cable, config, target, chosen.segments, watch.step))
        told["check"] = round_trip_dict(rows)
        page.print(round_trip_table(target, rows))
        for problem in (row for row in rows if row.problem):
            page.warn(f"{problem.pose}, {problem.case}: {problem.problem}")
        page.say(f"default: {target.default_of}")
        if chosen.figure is not None:
            save_figure(chosen.figure, draw_round_trip(cable.name, target, rows))
            page.say(f"Figure: {chosen.figure}")
    page.data(told)


def _given(chosen: argparse.Namespace) -> dict[str, Any]:
    """End conditions from the options."""
    held = {name: getattr(chosen, name) for name in HELD}
    return {name: value for name, value in held.items() if value is not None}


def _held(cable: FittedCable, chosen: argparse.Namespace) -> dict[str, Any]:
    """End conditions: from the options, or those of the session's first pose."""
    from dlo_casadi.session.round_trip import session_of

    if held := _given(chosen):
        return held
    try:
        given = session_of(cable, None if chosen.check in (None, _NEAR) else chosen.check)
    except DloError as error:
        if not cable.model.end.place:
            return held
        reason = error.message.partition("\n")[0]
        axes = " ".join(cable.model.node.axes).upper()
        raise DloError(
            f"--end is not given, and no session tells where its first pose was held: {reason}\n"
            f"  Try: --end {axes}"
        ) from None
    first, ends = given.experiment.poses[0], ("start", "end")
    turning = tuple(f"{side}_" for side in ends if not getattr(cable.model, side).direction)
    held = {name: getattr(first, name) for name in HELD if not name.startswith(turning)}
    held |= {"clips": first.clips, "over": first.over, "obstacles": given.experiment.obstacles}
    return held | {"branch": first.branch if first.branch != "previous" else None}
