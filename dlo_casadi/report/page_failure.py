"""failed.html: why a run has failed, with every photograph and what was found in it."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from dlo_casadi.config import Config
from dlo_casadi.errors import DloError
from dlo_casadi.io.files import write_file
from dlo_casadi.report.page import render
from dlo_casadi.report.page_data import configuration_text, sentence
from dlo_casadi.report.page_pictures import pictures_of_failure
from dlo_casadi.report.page_views import view_pictures
from dlo_casadi.session.outcome import PoseInput


def write_failure_page(
    path: Path, config: Config, error: DloError, poses: Sequence[PoseInput] = ()
) -> None:
    """Write the page of a run that has failed, whole or not at all.

    Parameters
    ----------
    path : Path
        The file.
    config : Config
        What was run.
    error : DloError
        How it ended.
    poses : sequence of PoseInput
        The poses as they were read; empty if it did not come to that.

    Raises
    ------
    OutputError
        If the file cannot be written.
    """
    write_file(path, failure_page(config, error, poses))


def failure_page(config: Config, error: DloError, poses: Sequence[PoseInput] = ()) -> str:
    """The text of failed.html."""
    known = {pose.name: pose for pose in poses}
    shown = [
        known.get(pose.name, PoseInput(pose.name, pose.role, np.zeros((0, 2))))
        for pose in config.experiment.poses
    ]
    heading, _, rest = error.message.partition("\n")
    return render(
        "failed.html",
        config.experiment.in_space,
        title=config.cable.name,
        config_name=config.name,
        kind=type(error).__name__,
        heading=sentence(heading),
        rest=rest,
        hints=hints([error.message, *(pose.problem for pose in shown)]),
        read=sum(pose.readable for pose in shown),
        reached=bool(poses),
        skipped=[item for item in config.skipped if item.name not in {x.name for x in shown}],
        photographed=config.experiment.measurement.kind == "images",
        pictures=pictures_of_failure(config, shown),
        photographs=view_pictures(shown),
        configuration=configuration_text(config),
    )


def hints(messages: Sequence[str]) -> list[str]:
    """What the messages say to try, each once."""
    found = [hint for text in messages for hint in re.findall(r"Try: (.+)", text)]
    return list(dict.fromkeys(hint[:1].upper() + hint[1:] for hint in found))
