"""`dlo import`: a session from what a laboratory has recorded."""

import argparse
import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import fields
from pathlib import Path

from dlo_casadi.cli.common import Option, Page, Watch, command, option
from dlo_casadi.config import load_config
from dlo_casadi.config.template import schema_text, to_fill_in
from dlo_casadi.errors import ConfigError, DloError, MeasurementError, counted
from dlo_casadi.io.files import FolderDraft, write_file
from dlo_casadi.io.points import write_points
from dlo_casadi.recordings import (
    FORMATS,
    FREE,
    CloudView,
    Imported,
    Recording,
    Wishes,
    make_session,
    read_recording,
)
from dlo_casadi.session import measure
from dlo_casadi.session.plausibility import contradictions, find_suspicions

_NAME = "session.yaml"
_CABLE = {
    "length": "m, along the cable between its fixtures; measured in the recording when absent",
    "mass": "kg, of that length",
    "diameter": "m",
    "bending_stiffness": "N m^2, a first guess; from weight and length when absent",
}


def _vector(name: str, axes: str, text: str) -> Option:
    """An option of several numbers, one per axis."""
    kept = tuple(axes.split())
    many = "+" if kept[-1] == "..." else len(kept)
    shown = kept[0] if many == "+" else kept
    return option(name, type=float, nargs=many, default=(), metavar=shown, help=text)


@command(
    option(
        "file",
        type=Path,
        nargs="+",
        metavar="FILE",
        help=f"recording: {', '.join(filter(None, FORMATS))}, or the folder of a bag",
    ),
    option("--output", type=Path, required=True, metavar="DIR", help="folder of the session"),
    option("--start", default="start", metavar="NAME", help="body, or markers O,X,Y, at the start"),
    option("--end", default="end", metavar="NAME", help=f"the same at the end; or {FREE}"),
    _vector("--start-offset", "X Y Z", "m, where the cable leaves the start body, in its axes"),
    _vector("--end-offset", "X Y Z", "the same of the end body"),
    option("--cable", default="", metavar="TEXT", help="part of the names of its markers"),
    _vector("--at", "S ...", "m, arc lengths of the markers from the start"),
    option("--up", choices="xyz", help="axis that points up; as usual in the format when absent"),
    _vector("--camera", "X Y Z", "m, place of the camera that saw the clouds"),
    _vector("--color", "R G B", "of the cable in clouds, 0 to 255"),
    _vector("--box", "X Y Z X Y Z", "m, two corners between which the cable is in clouds"),
    option("--units", choices=("m", "cm", "mm"), help="of files that do not name theirs"),
    option("--hold", type=float, default=0.5, metavar="S", help="shortest pose; %(default)s s"),
    option("--held-out", type=int, default=4, metavar="N", help="one in N; default %(default)s"),
    option("--motions", type=int, default=0, metavar="N", help="write up to N moving stretches"),
    *(
        option(f"--{key.replace('_', '-')}", type=float, help=text, metavar="X")
        for key, text in _CABLE.items()
    ),
    json="print what was written as JSON",
)
def import_(chosen: argparse.Namespace) -> None:
    """Make a session of recordings: find the poses in which cable and grippers are still, align
    clocks, name markers by arc length, and check the result. Every assumption is a comment, and
    FILL_IN stands where only you know the value. Nothing is replaced.

    dlo import take.csv --output loom --mass 0.03 --diameter 0.004
    dlo import markers.c3d bag/ --output loom --start fixed --end flange
    dlo import cloud_*.ply robot.csv --output loom --color 230 110 20 --length 0.9 --diameter 0.007
    dlo import points.c3d --output loom --start left_o,left_x,left_y --end free
    """
    if os.path.lexists(chosen.output):
        raise DloError(f"{chosen.output} exists already, and nothing is replaced")
    known = {key: getattr(chosen, key) for key in _CABLE}
    wishes = Wishes(
        **{item.name: getattr(chosen, item.name) for item in fields(Wishes) if item.name in chosen},
        known={key: value for key, value in known.items() if value is not None},
    )
    view = CloudView(**{item.name: getattr(chosen, item.name) for item in fields(CloudView)})
    with Watch(quiet=chosen.quiet) as watch:
        watch.step("read", 0, 3)
        recording = read_recording(chosen.file, chosen.up, view)
        watch.step("find poses", 1, 3)
        with _assuming(recording):
            session = make_session(chosen.output.name, recording, wishes)
        with _assuming(recording), FolderDraft(chosen.output) as draft:
            _write(session, draft.folder)
            watch.step("compare with a cable", 2, 3)
            mistakes, doubts = _mistakes(session, draft.folder)
            if mistakes:
                told = ["nothing is written: the recording contradicts itself.", *mistakes]
                raise MeasurementError("\n".join([*told, *_advice(mistakes)]))
            draft.put_in_place()
        watch.step("compare with a cable", 3, 3)
    page, target = Page(chosen), chosen.output / _NAME
    page.data(
        {
            "file": str(target),
            "poses": len(session.poses),
            "remarks": session.remarks,
            "warnings": [*session.doubts, *doubts],
        }
    )
    for remark in (one for one in session.remarks if one not in session.doubts):
        page.say(remark)
    for doubt in (*session.doubts, *doubts, *_advice(doubts)):
        page.warn(doubt)
    left = to_fill_in(session.text())
    follow = f"dlo {'check' if left else 'fit'} {target}"
    filled = ", ".join(filter(None, [counted(len(session.poses), "pose"), left]))
    page.say(f"{target}: {filled}\nthen: {follow}")


@contextmanager
def _assuming(recording: Recording) -> Iterator[None]:
    """Tell what was assumed in reading with what it leads to: it may be wrong."""
    try:
        yield
    except MeasurementError as error:
        assumed = [text for text in recording.assumptions if text not in error.message]
        told = "\n".join([error.message, *[f"  Assumed: {text}." for text in assumed]])
        raise MeasurementError(told) from error


def _write(session: Imported, folder: Path) -> None:
    for name, (points, s) in session.points.items():
        write_points(folder / name, points, s)
    for name, text in session.tables.items():
        write_file(folder / name, text)
    write_file(folder / "schema.json", schema_text())
    write_file(folder / _NAME, session.text())


def _advice(texts: Sequence[str]) -> list[str]:
    """What to try if frames are in doubt."""
    if not any("one frame" in text for text in texts):
        return []
    return ["Try: --up, the axis that points up in the files; --start-offset, --end-offset."]


def _mistakes(session: Imported, folder: Path) -> tuple[list[str], list[str]]:
    """Contradictions in a written session, and doubts, with stand-ins for missing values."""
    text = session.text(session.stand_ins)
    if "FILL_IN" in text.split("experiment:")[1]:
        return [], []  # without fixtures there is nothing to compare
    stand_in = folder / "check.yaml"
    write_file(stand_in, text)
    try:
        config = load_config(stand_in)
        inputs = measure.read_inputs(config)
    except ConfigError as error:  # it cites a file that will not exist
        raise MeasurementError(f"nothing is written: {error.problem}") from None
    else:
        found = find_suspicions(config, inputs)
        return contradictions(found, inputs), [item.message for item in found]
    finally:
        stand_in.unlink()
