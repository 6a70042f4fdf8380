"""`dlo calibrate`: the camera of a session from its own photographs."""

from __future__ import annotations

from collections.abc import Sequence

from rich.console import Console

from dlo_casadi.cli.guard import OK
from dlo_casadi.cli.options import add_config, command, configuration, console, parsed, print_json
from dlo_casadi.cli.watch import Watch
from dlo_casadi.session.measure import calibrate_session, summary
from dlo_casadi.vision import Calibration

EXAMPLES = """\
dlo calibrate rope.yaml
dlo calibrate rope.yaml --json"""


def main(argv: Sequence[str]) -> int:
    """Run `dlo calibrate CONFIG [...]`."""
    parser = command(
        "calibrate",
        "Find matrix and lens of the camera from a session's own photographs of the board\n"
        "(Zhang's method), tell how well they are known and how to do better. Nothing is written.",
        EXAMPLES,
    )
    add_config(parser)
    chosen = parsed(parser, argv, "print JSON instead of text")

    config = configuration(chosen.config)
    with Watch(Console(stderr=True), chosen.quiet) as watch:
        found = calibrate_session(config, lambda name, k, m: watch.step(f"read {name}", k, m))
    if chosen.json:
        print_json(_plain(found))
        return OK
    page = console(quiet=chosen.quiet)
    matrix = [[round(x, 3) for x in row] for row in found.camera.matrix.tolist()]
    lens = [round(x, 6) for x in found.camera.distortion.tolist()]
    page.print(f"{summary(found)}. For the configuration:", soft_wrap=True, markup=False)
    page.print(
        f"    camera:\n      matrix: {matrix}\n      distortion: {lens}",
        soft_wrap=True,
        markup=False,
    )
    worst = sorted(found.errors, key=lambda name: -found.errors[name])[:3]
    told = ", ".join(f"{name} {found.errors[name]:.2f} px" for name in worst)
    page.print(f"largest errors: {told}", soft_wrap=True, markup=False)
    for text in (*found.problems.values(), *found.advice):
        page.print(f"[bold yellow]warning:[/] {text}", soft_wrap=True)
    return OK


def _plain(found: Calibration) -> dict[str, object]:
    return {
        "matrix": found.camera.matrix.tolist(),
        "distortion": found.camera.distortion.tolist(),
        "matrix_std": dict(zip(("fx", "fy", "cx", "cy"), found.matrix_std.tolist(), strict=True)),
        "reprojection_error_px": found.reprojection_error,
        "errors_px": dict(found.errors),
        "problems": dict(found.problems),
        "advice": list(found.advice),
    }
