"""`dlo check`: a configuration and its files, without fitting."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from rich.console import Console
from rich.markup import escape

from dlo_casadi.cli.guard import BAD_INPUT, OK
from dlo_casadi.cli.options import add_config, command, configuration, console, parsed, print_json
from dlo_casadi.cli.watch import Watch
from dlo_casadi.config import Config
from dlo_casadi.errors import DloError, MeasurementError
from dlo_casadi.io.files import make_folder, write_file
from dlo_casadi.report.json_report import check_dict
from dlo_casadi.report.terminal import check_table
from dlo_casadi.session.measure import calibrated, draw_steps, read_inputs
from dlo_casadi.session.plausibility import find_suspicions
from dlo_casadi.vision import encoded

EXAMPLES = """\
dlo check configs/cable.yaml
dlo check rope.yaml --show look/                 pictures of each step of the camera
dlo check rope.yaml --json"""


def main(argv: Sequence[str]) -> int:
    """Run `dlo check CONFIG [--show DIR] [...]`."""
    parser = command(
        "check",
        "Check a configuration and its photographs or centre-lines in seconds, without fitting:\n"
        "what the camera finds in each pose, and whether units, axes, ends and files agree.",
        EXAMPLES,
        "2 is also a mistake that was found",
    )
    add_config(parser)
    parser.add_argument(
        "--show",
        type=Path,
        metavar="DIR",
        help="write pictures of each photograph there: rectified work-plane, contrast, strands, "
        "and the line with its direction",
    )
    chosen = parsed(parser, argv)

    config = configuration(chosen.config)
    with Watch(Console(stderr=True), chosen.quiet) as watch:
        config = calibrated(
            config, lambda name, k, m: watch.step(f"calibrate {name}".strip(), k, m)
        )
        inputs = read_inputs(config, lambda name, k, m: watch.step(f"read {name}", k, m))
        pictures = [] if chosen.show is None else _show(config, chosen.show, watch)
        watch.step("compare with what is declared", 0, 1)
        result = check_dict(config, inputs, find_suspicions(config, inputs))
        watch.step("compare with what is declared", 1, 1)
    if chosen.json:
        print_json({**result, "pictures": [str(path) for path in pictures]})
        return OK if result["ok"] else BAD_INPUT
    page = console(quiet=chosen.quiet)
    page.print(check_table(config, result["poses"]))
    for row in result["poses"]:
        for advice in row["advice"]:
            page.print(f"{row['name']}: {advice}", soft_wrap=True, markup=False)
    for warning in result["warnings"]:
        page.print(f"[bold yellow]warning:[/] {escape(warning)}", soft_wrap=True)
    for path in sorted({path.parent for path in pictures}):
        page.print(f"Pictures: {path}", soft_wrap=True, markup=False)
    errors = Console(stderr=True, highlight=False, soft_wrap=True)
    for mistake in result["mistakes"]:
        errors.print(f"[bold red]mistake:[/] {escape(mistake)}")
    if result["ok"]:
        page.print("Nothing contradicts the configuration.")
        return OK
    return BAD_INPUT


def _show(config: Config, folder: Path, watch: Watch) -> list[Path]:
    """Write the steps' pictures of all poses; return the files."""
    if config.experiment.measurement.kind != "images":
        raise DloError("--show draws photographs; this configuration has centre-lines")
    poses = [pose for pose in config.measured_poses if any(path.is_file() for path in pose.paths)]
    written = []
    make_folder(folder)
    for k, pose in enumerate(poses):
        watch.step("draw the steps", k, len(poses))
        try:
            pictures = draw_steps(config, pose)
        except MeasurementError:  # no photograph; the table says so
            continue
        for name, picture in pictures.items():
            written.append(folder / f"{name}.jpg")
            write_file(written[-1], encoded(picture, ".jpg"))
    watch.step("draw the steps", len(poses), len(poses))
    return written
