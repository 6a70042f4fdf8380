"""The folder of results: complete or untouched."""

from __future__ import annotations

import json
import os
import shutil
import tempfile
from pathlib import Path
from types import TracebackType

from dlo_casadi.config import Config
from dlo_casadi.errors import DloError
from dlo_casadi.measurements import write_centerline
from dlo_casadi.report.figures import write_figures
from dlo_casadi.report.json_report import report_text
from dlo_casadi.report.page import GENERATOR, report_page
from dlo_casadi.report.page_failure import write_failure_page
from dlo_casadi.report.parameters_file import parameters_text
from dlo_casadi.session.outcome import Outcome

# What a run writes; nothing else in the folder is ever touched.
OWNED = ("report.json", "report.html", "parameters.yaml", "centerlines", "figures")
# What a run that fails writes, and the next one that does not removes.
FAILURE = "failed.html"


class ResultsFolder:
    """Where the results go: opened before the work starts, filled at its end.

        with ResultsFolder("results/cable", config) as folder:   # raises if it cannot be written
            outcome = run_session(config)
            folder.write(outcome)

    Everything is written to a hidden draft first and moved into place only when complete, so
    that a run that fails or is interrupted leaves earlier results as they were. A run that fails
    with a DloError leaves `failed.html` beside them: what went wrong, pose by pose.

    Parameters
    ----------
    path : str or Path
        The folder; made if it does not exist.
    config : Config, optional
        What is run; without it a failure leaves no page.

    Raises
    ------
    DloError
        If the folder cannot be written, or holds files of the same names from elsewhere.
    """

    def __init__(self, path: str | Path, config: Config | None = None) -> None:
        self.path = Path(path).resolve()
        self.config = config
        self._made: list[Path] = []
        self._draft: Path | None = None

    def __enter__(self) -> ResultsFolder:
        _check_owner(self.path)
        try:
            self._make_parents()
            # On the file system of the results: moving is then a renaming.
            beside = self.path if self.path.is_dir() else self.path.parent
            self._draft = Path(tempfile.mkdtemp(dir=beside, prefix=f".{self.path.name}.draft."))
        except OSError as error:
            self._undo()
            raise self._cannot_write(error) from None
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._undo()
        if isinstance(error, DloError) and self.config is not None:
            page = self.path / FAILURE
            try:
                write_failure_page(page, self.config, error, error.poses)
            except OSError:
                return  # the error itself is what the user must see
            error.add_note(f"Pose by pose: {page}")

    def write(self, outcome: Outcome) -> Path:
        """Write all results, then put them in place of the previous ones.

        A page or a figure that cannot be drawn does not lose the numbers: they are put in place
        before the error goes on.
        """
        assert self._draft is not None, "use as a context: with ResultsFolder(path) as folder"
        complete = self._draft / "complete"
        try:
            complete.mkdir()
            write_numbers(complete, outcome)
            failed = None
            try:
                draw(complete, outcome)
            except OSError:
                raise
            except Exception as error:
                failed = error
            _swap(complete, self.path, self._draft / "previous")
        except OSError as error:
            raise self._cannot_write(error) from None
        self._made.clear()
        if failed is not None:
            failed.add_note(f"All but the drawings is in {self.path}.")
            raise failed
        return self.path

    def _make_parents(self) -> None:
        missing = [p for p in self.path.parents if not p.exists()]
        for parent in reversed(missing):
            parent.mkdir()
            self._made.insert(0, parent)

    def _undo(self) -> None:
        """Remove the draft, and parents that were made for nothing."""
        if self._draft is not None:
            shutil.rmtree(self._draft, ignore_errors=True)
            self._draft = None
        for parent in self._made:
            if any(parent.iterdir()):
                break
            parent.rmdir()
        self._made.clear()

    def _cannot_write(self, error: OSError) -> DloError:
        return DloError(
            f"the output folder {self.path} cannot be written: {error.strerror or error}"
            f"{'' if error.filename is None else f' ({error.filename})'}.\n"
            "  Try: another folder with --output, or check its permissions and the free space."
        )


def write_numbers(folder: Path, outcome: Outcome) -> None:
    """Write all results of a run that are numbers into an empty folder."""
    (folder / "report.json").write_text(report_text(outcome), encoding="utf-8")
    (folder / "parameters.yaml").write_text(parameters_text(outcome), encoding="utf-8")
    lines = folder / "centerlines"
    lines.mkdir()
    for pose in outcome.poses:
        if len(pose.points):
            write_centerline(lines / f"{pose.name}.csv", pose.points)


def draw(folder: Path, outcome: Outcome) -> None:
    """Write the page and the figures beside the numbers."""
    (folder / "report.html").write_text(report_page(outcome), encoding="utf-8")
    figures = folder / "figures"
    figures.mkdir()
    write_figures(figures, outcome)


def _check_owner(path: Path) -> None:
    """Refuse a folder in which files of our names are not ours."""
    if path.exists() and not path.is_dir():
        raise DloError(
            f"the output folder {path} cannot be written: it is a file.\n"
            "  Try: another folder with --output."
        )
    try:
        taken = [name for name in OWNED if (path / name).exists()]
        if _is_ours(path / "report.json"):
            taken = []
        if (path / FAILURE).exists() and GENERATOR not in (path / FAILURE).read_text("utf-8"):
            taken.append(FAILURE)
    except (OSError, UnicodeDecodeError):
        taken = []
    if taken:
        raise DloError(
            f"{path} holds {', '.join(taken)} that no earlier fit has written; they would be "
            "replaced.\n  Try: another folder with --output, or move them away."
        )


def _is_ours(report: Path) -> bool:
    try:
        schema = json.loads(report.read_text(encoding="utf-8"))["schema"]
    except (OSError, ValueError, KeyError, TypeError):
        return False
    return str(schema).startswith("dlo-report/")


def _swap(complete: Path, target: Path, previous: Path) -> None:
    """Move the complete results into place; on any failure put the previous ones back."""
    if not target.exists():
        os.replace(complete, target)
        return
    previous.mkdir()
    moved: list[tuple[Path, Path]] = []
    try:
        for name in (*OWNED, FAILURE):
            for origin, goal in (
                (target / name, previous / name),
                (complete / name, target / name),
            ):
                if origin.exists():
                    moved.append((origin, goal))
                    os.replace(origin, goal)
    except BaseException:
        for origin, goal in reversed(moved):
            if goal.exists():
                os.replace(goal, origin)
        raise
