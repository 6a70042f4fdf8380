"""`dlo check`, `dlo calibrate`: what a configuration and its files hold, without fitting."""

import argparse
from pathlib import Path

from rich.console import Console
from rich.markup import escape

from dlo_casadi.cli import BAD_INPUT, OK
from dlo_casadi.cli.common import CONFIG, Page, Watch, command, option
from dlo_casadi.config import Config
from dlo_casadi.errors import DloError, MeasurementError
from dlo_casadi.io.files import make_folder, write_file
from dlo_casadi.report.documents import check_dict
from dlo_casadi.report.motions import motion_check_table
from dlo_casadi.report.terminal import check_table
from dlo_casadi.session import measure
from dlo_casadi.session.checked_motions import check_motions
from dlo_casadi.session.plausibility import find_suspicions
from dlo_casadi.vision import encoded


@command(
    CONFIG,
    option(
        "--show",
        type=Path,
        metavar="DIR",
        help="write pictures of each photograph there: rectified work-plane, contrast, strands, "
        "and the line with its direction",
    ),
    codes="2 is also a mistake that was found",
)
def check(chosen: argparse.Namespace) -> int:
    """Check a configuration and its photographs or centre-lines in seconds, without fitting:
    what the camera finds in each pose, and whether units, axes, ends and files agree; of motions,
    whether they are quick and long enough, and whether clocks agree.

    dlo check configs/cable.yaml
    dlo check rope.yaml --show look/                 pictures of each step of the camera
    dlo check rope.yaml --json
    """
    with Watch(quiet=chosen.quiet) as watch:
        config, inputs = measure.read_session(chosen.config, watch.step)
        pictures = [] if chosen.show is None else _show(config, chosen.show, watch)
        watch.step("compare with what is declared", 0, 1)
        motions = check_motions(config)
        result = check_dict(config, inputs, find_suspicions(config, inputs), motions)
        watch.step("compare with what is declared", 1, 1)
    page, errors = Page(chosen), Console(stderr=True, highlight=False, quiet=chosen.json)
    page.data({**result, "pictures": [str(path) for path in pictures]})
    if inputs:
        page.print(check_table(config, result["poses"]))
    if motions:
        page.print(motion_check_table(motions))
    for row in result["poses"]:
        for advice in row["advice"]:
            page.say(f"{row['name']}: {advice}")
    for warning in result["warnings"]:
        page.warn(warning)
    for path in sorted({path.parent for path in pictures}):
        page.say(f"Pictures: {path}")
    for mistake in result["mistakes"]:
        errors.print(f"[bold red]mistake:[/] {escape(mistake)}", soft_wrap=True)
    if not result["ok"]:
        return BAD_INPUT
    page.say("Nothing contradicts the configuration.")
    return OK


def _show(config: Config, folder: Path, watch: Watch) -> list[Path]:
    """Write pictures of all steps in all poses; return the files."""
    if config.experiment.measurement.kind != "images":
        raise DloError("--show draws photographs; this configuration has centre-lines")
    poses = [pose for pose in config.measured_poses if any(path.is_file() for path in pose.paths)]
    written = []
    make_folder(folder)
    for k, pose in enumerate(poses):
        watch.step("draw the steps", k, len(poses))
        try:
            pictures = measure.draw_steps(config, pose)
        except MeasurementError:  # no photograph; the table reports it
            continue
        for name, picture in pictures.items():
            written.append(folder / f"{name}.jpg")
            write_file(written[-1], encoded(picture, ".jpg"))
    watch.step("draw the steps", len(poses), len(poses))
    return written


@command(
    CONFIG,
    json="print JSON instead of text",
)
def calibrate(chosen: argparse.Namespace) -> None:
    """Find matrix and lens of the camera from a session's own photographs of the board
    (Zhang's method), tell how well they are known and how to do better. Nothing is written.

    dlo calibrate rope.yaml
    dlo calibrate rope.yaml --json
    """
    with Watch(quiet=chosen.quiet) as watch:
        found = measure.calibrate_session(chosen.config, watch.step)
    page, names = Page(chosen), ("fx", "fy", "cx", "cy")
    matrix, lens = found.camera.matrix.tolist(), found.camera.distortion.tolist()
    page.data(
        {
            "matrix": matrix,
            "distortion": lens,
            "matrix_std": dict(zip(names, found.matrix_std.tolist(), strict=True)),
            "reprojection_error_px": found.reprojection_error,
            "errors_px": dict(found.errors),
            "problems": dict(found.problems),
            "advice": list(found.advice),
        }
    )
    page.say(f"{measure.summary(found)}. For the configuration:")
    page.say(f"    camera:\n      matrix: {[[round(x, 3) for x in row] for row in matrix]}")
    page.say(f"      distortion: {[round(x, 6) for x in lens]}")
    worst = sorted(found.errors, key=lambda name: -found.errors[name])[:3]
    told = ", ".join(f"{name} {found.errors[name]:.2f} px" for name in worst)
    page.say(f"largest errors: {told}")
    for text in (*found.problems.values(), *found.advice):
        page.warn(text)
