"""The folder of results: either complete or untouched."""

import json
import os
from concurrent.futures import Executor
from functools import partial
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from dlo_casadi.config import Config
from dlo_casadi.errors import DloError, OutputError
from dlo_casadi.io.files import FolderDraft, is_marked, make_folder, refuse_foreign, write_file
from dlo_casadi.io.points import write_points, write_table
from dlo_casadi.report.documents import parameters_text
from dlo_casadi.report.figures import figures_of, write_figures
from dlo_casadi.report.figures_poses import draw_poses, write_overlays
from dlo_casadi.report.page import GENERATOR, failure_page, report_page
from dlo_casadi.report.sections import report_text
from dlo_casadi.runtime.executors import InProcess
from dlo_casadi.runtime.parallel import begin
from dlo_casadi.session.outcome import Outcome

# Files that a run writes; no other file in the folder is ever touched.
OWNED = ("report.json", "report.html", "parameters.yaml", "centerlines", "figures")
# Files that a failed run writes and the next successful one removes.
FAILURE = "failed.html"


class ResultsFolder(FolderDraft):
    """The folder of the results: opened before the work starts, filled at its end.

        with ResultsFolder("results/cable", config) as folder:   # raises if it cannot be written
            outcome = run_session(config)
            folder.write(outcome)

    Everything is written to a hidden draft first and moved into place when complete, so that a
    failed or interrupted run leaves earlier results unchanged. A run that fails with a DloError
    leaves `failed.html` beside them: what went wrong, pose by pose.

    Parameters
    ----------
    path : str or Path
        The folder; created if it does not exist.
    config : Config, optional
        The configuration of the run; without it a failure leaves no page.

    Raises
    ------
    OutputError
        If the folder cannot be written, or holds files of the same names from another source.
    """

    def __init__(self, path: str | Path, config: Config | None = None) -> None:
        super().__init__(path)
        self.config = config

    @property
    def of_another(self) -> str | None:
        """Path of another configuration whose results the folder holds; else None."""
        earlier, own = _report(self.path).get("config_path"), self.config and self.config.path
        other = earlier and own and os.path.realpath(earlier) != os.path.realpath(own)
        return earlier if other else None

    def __enter__(self) -> Self:
        taken = [name for name in OWNED if os.path.lexists(self.path / name)]
        if _report(self.path):
            taken = []
        if not is_marked(self.path / FAILURE, GENERATOR):
            taken.append(FAILURE)
        refuse_foreign(self.path, taken)
        return super().__enter__()

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        super().__exit__(kind, error, trace)
        if isinstance(error, DloError) and self.config is not None:
            try:
                page = failure_page(self.config, error, error.poses)
                with FolderDraft(self.path) as draft:
                    write_file(draft.folder / FAILURE, page)
                    draft.put_in_place()
            except OutputError:
                return  # the user must see the original error
            except Exception as other:  # a fault of the page, which must not hide it either
                error.add_note(f"Without {FAILURE}, which cannot be made: {other}")
                return
            error.add_note(f"Pose by pose: {self.path / FAILURE}")

    def write(self, outcome: Outcome, executor: Executor | None = None) -> Path:
        """Write all results, then replace the previous ones.

        If a page or a figure cannot be drawn, the numbers are put in place before the error is
        raised. `executor`: draws one part in parallel; by default this process does all the work.
        """
        write_numbers(self.folder, outcome)
        failed = None
        try:
            draw(self.folder, outcome, executor or InProcess())
        except OutputError:
            raise
        except Exception as error:
            failed = error
        self.put_in_place((*OWNED, FAILURE))
        if failed is not None:
            failed.add_note(f"All but the drawings is in {self.path}.")
            raise failed
        return self.path


def write_numbers(folder: Path, outcome: Outcome) -> None:
    """Write all numerical results of a run into an empty folder."""
    write_file(folder / "report.json", report_text(outcome))
    write_file(folder / "parameters.yaml", parameters_text(outcome))
    lines = folder / "centerlines"
    make_folder(lines)
    taken = {pose.name for pose in outcome.poses}
    for pose in outcome.poses:
        if len(pose.points):
            write_points(lines / f"{pose.name}.csv", pose.points, pose.s)
        for k, view in enumerate(pose.views, 1):
            which = view.name.removeprefix(pose.name).lstrip("-_. ") or str(k)
            name = f"{pose.name}_{which}"
            while name in taken:  # by p-a.png beside p_a.png, or by a pose called p_a
                name += f"_{k}"
            taken.add(name)
            write_table(lines / f"{name}.csv", ["u_px", "v_px"], view.seen.pixels)


def draw(folder: Path, outcome: Outcome, executor: Executor) -> None:
    """Write the page and the figures beside the numbers."""
    figures = folder / "figures"
    make_folder(figures)
    other_half = begin(executor, draw_summary, folder, outcome)
    failed: list[Exception] = []
    for half in (partial(draw_each, figures, outcome), other_half):
        try:
            half()
        except Exception as error:  # the other half is still writing to the folder
            failed.append(error)
    if failed:
        raise next((error for error in failed if isinstance(error, OutputError)), failed[0])


def draw_each(figures: Path, outcome: Outcome) -> None:
    """Draw the figures of single poses: half of the work."""
    draw_poses(figures, outcome)
    write_overlays(figures / "overlays", outcome)


def draw_summary(folder: Path, outcome: Outcome) -> None:
    """Write the page and the other figures: the other half."""
    drawn = figures_of(outcome)
    write_file(folder / "report.html", report_page(outcome, drawn))
    write_figures(folder / "figures", drawn)


def _report(folder: Path) -> dict[str, Any]:
    """The report of an earlier run in a folder; empty if there is none of this program."""
    try:
        report = json.loads((folder / "report.json").read_text(encoding="utf-8"))
        return report if str(report["schema"]).startswith("dlo-report/") else {}
    except (OSError, ValueError, KeyError, TypeError):
        return {}
