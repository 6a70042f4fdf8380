"""`dlo predict`: the shape of a fitted cable in a new pose."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from dlo_casadi.api import PredictedShape, predict
from dlo_casadi.cli.guard import OK
from dlo_casadi.cli.options import add_parameters, command, console, parsed, print_json
from dlo_casadi.errors import DloError
from dlo_casadi.report.canvas import save_figure
from dlo_casadi.report.figures_poses import prediction_figure
from dlo_casadi.report.terminal import prediction_table

DRAWN = (".png", ".pdf", ".svg", ".jpg")

EXAMPLES = """\
dlo predict results/cable --end 0.3 -0.1
dlo predict results/cable --end 0.3 -0.1 --figure shape.png
dlo predict results/cable --start 0.1 0 --end 0.3 -0.1 --branch cw --json
dlo predict results/wire --end -0.12 0 --start-heading 0 --end-heading -6.2832
dlo predict results/loom --end 0.6 0.1 0.3 --end-orientation 0 0 0 1 --turns 1"""


def main(argv: Sequence[str]) -> int:
    """Run `dlo predict PARAMETERS --end X Y [Z] [...]`."""
    parser = command(
        "predict",
        "Predict the shape of a fitted cable from where its ends are held.",
        EXAMPLES,
        "2 is also a pose without an equilibrium",
    )
    add_parameters(parser)
    for side, remark in (("end", "; not for a free end"), ("start", "")):
        parser.add_argument(
            f"--{side}",
            nargs="+",
            type=float,
            metavar="X",
            help=f"where the {side} is held, X Y or in space X Y Z [m]{remark}",
        )
    parser.add_argument("--start-heading", type=float, metavar="R", help="clamped start [rad]")
    parser.add_argument("--end-heading", type=float, metavar="R", help="clamped end [rad]")
    for side in ("start", "end"):
        parser.add_argument(
            f"--{side}-orientation",
            nargs=4,
            type=float,
            metavar=("QX", "QY", "QZ", "QW"),
            help=f"frame of the clamp at the {side} in space, x forward along the cable",
        )
    parser.add_argument(
        "--turns", type=float, default=0.0, metavar="N", help="extra turns of twist in space"
    )
    parser.add_argument("--branch", choices=("ccw", "cw"), help="which way the cable turns")
    parser.add_argument("--figure", type=Path, metavar="FILE", help=f"draw it: {', '.join(DRAWN)}")
    chosen = parsed(parser, plain_numbers(argv))

    figure = chosen.figure
    if figure is not None and figure.suffix.lower() not in DRAWN:
        raise DloError(f"--figure {figure}: the name must end in {', '.join(DRAWN)}")
    shape = predict(
        chosen.parameters,
        chosen.end,
        start=chosen.start,
        start_heading=chosen.start_heading,
        end_heading=chosen.end_heading,
        start_orientation=chosen.start_orientation,
        end_orientation=chosen.end_orientation,
        turns=chosen.turns,
        branch=chosen.branch,
    )
    if figure is not None:
        save_figure(figure, prediction_figure(shape))
    if chosen.json:
        print_json(shape.as_dict())
        return OK
    page = console(quiet=chosen.quiet)
    page.print(prediction_table(shape, _notes(shape)))
    if figure is not None:
        page.print(f"Figure: {figure}", soft_wrap=True)
    return OK


def _notes(shape: PredictedShape) -> list[str]:
    """What a reader of the prediction should know of the file it came from."""
    metadata, notes = shape.cable.metadata, []
    if metadata.edited:
        notes.append("note: the model in this file was changed after it had been fitted")
    if metadata.identifiable is False:
        notes.append(
            "note: the shapes did not determine the bending stiffness; the shape is more certain "
            "than forces and energy"
        )
    return notes


_NEGATIVE = re.compile(r"-(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?")


def plain_numbers(argv: Sequence[str]) -> list[str]:
    """Write -1e-2 as -0.01: argparse takes the former for an option."""
    return [
        np.format_float_positional(float(text), trim="0") if _NEGATIVE.fullmatch(text) else text
        for text in argv
    ]
