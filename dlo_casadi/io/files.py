"""Atomic writing of files and folders: complete or unchanged, even after a power cut.

The whole package writes through this module, so that every failure is the same: the earlier file is
unchanged, no draft is left, and the error names the place, the system's reason and a remedy.
What is written as JSON goes through `finite`.
"""

import errno
import math
import os
import secrets
import shutil
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, BinaryIO, Self

import numpy as np
from filelock import FileLock, Timeout

from dlo_casadi.errors import OutputError, well_formed

# Prefix of the names of all drafts.
_DRAFT = ".dlo-draft-"
# Name of the file by which a run locks its folder.
LOCK = ".lock"


def finite(value: Any) -> Any:
    """Copy with Python numbers, None for values that are not finite, and `well_formed` text."""
    if isinstance(value, dict):
        return {finite(str(key)): finite(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [finite(item) for item in value]
    if isinstance(value, np.ndarray | np.generic):
        return finite(value.tolist())
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, str):
        return well_formed(value)
    return value


def write_file(
    path: Path,
    content: str | bytes | Callable[[BinaryIO], object],
    draft: Path | None = None,
) -> None:
    """Fill a hidden draft beside the file, make it durable, rename it into place.

    Parameters
    ----------
    path : Path
        The target; a link is followed.
    content : str, bytes or callable
        Text is written as UTF-8, `well_formed`; a callable fills the open draft.
    draft : Path, optional
        Another place for the draft, on the same file system; a draft left by a killed process is
        then overwritten by the next one.

    Raises
    ------
    OutputError
        If the file cannot be written.
    """
    target = Path(os.path.realpath(path))
    draft = draft or _draft_in(target.parent)
    if isinstance(content, str):
        content = well_formed(content).encode()
    with _explained(path):
        try:
            with draft.open("wb") as stream:
                if callable(content):
                    content(stream)
                else:
                    stream.write(content)
                stream.flush()
                os.fsync(stream.fileno())
            os.replace(draft, target)
        finally:
            draft.unlink(missing_ok=True)
    if _DRAFT not in str(target.parent):  # folders of drafts are made durable together at the end
        _sync_folder(target.parent)


class FolderDraft:
    """A hidden folder to fill, whose entries then replace those of a folder.

        with FolderDraft(path) as draft:  # raises if the folder cannot be written
            write_file(draft.folder / "a.txt", "...")
            draft.put_in_place()

    The folder and its parents are created if needed; `folder` is the hidden one to fill. Until
    `put_in_place` nothing changes, and if that fails, earlier entries are restored. Entries with
    other names are never touched.

    Raises
    ------
    OutputError
        If the folder cannot be written.
    """

    def __init__(self, path: str | Path) -> None:
        self.path = Path(os.path.realpath(path))
        # On the folder's file system, so that moving is renaming.
        beside = self.path if os.path.isdir(self.path) else self.path.parent
        self._hidden = _draft_in(beside)
        self.folder, self._previous = self._hidden / "complete", self._hidden / "previous"
        self._made: list[Path] = []

    def __enter__(self) -> Self:
        if os.path.isfile(self.path):
            raise OutputError(
                f"the folder {self.path} cannot be written: it is a file.\n"
                "  Try: another folder, or move the file away.",
                self.path,
            )
        try:
            with _explained(self.path):
                with suppress(FileNotFoundError):
                    self.path.stat()  # a name that no folder can have
                for parent in [p for p in self.path.parents if not os.path.exists(p)][::-1]:
                    try:
                        parent.mkdir()
                    except FileExistsError:  # another run has made it meanwhile
                        continue
                    self._made.insert(0, parent)
                self.folder.mkdir(parents=True)
        except BaseException:
            self._remove()
            raise
        return self

    def __exit__(self, kind: Any, error: BaseException | None, trace: Any) -> None:
        self._remove()
        if isinstance(error, OutputError):  # the user does not know about drafts
            error.retold(str(self.folder), str(self.path))
        if error is not None and self._previous.exists():
            error.add_note(f"What was in {self.path} before is in part in {self._previous}.")

    def put_in_place(self, obsolete: Iterable[str] = ()) -> None:
        """Move the draft's entries into the folder; on any failure restore the earlier ones.

        Entries named in `obsolete` are removed even if the draft does not replace them.
        """
        for folder, _, files in os.walk(self.folder):
            for name in files:
                if name.startswith(_DRAFT):  # left by a killed process
                    Path(folder, name).unlink()
            _sync_folder(Path(folder))
        with _explained(self.path):
            if os.path.exists(self.path):
                self._swap(sorted({*obsolete, *os.listdir(self.folder)}))
            else:
                os.replace(self.folder, self.path)
        self._made.clear()
        _sync_folder(self.path)
        _sync_folder(self.path.parent)

    def _swap(self, names: Sequence[str]) -> None:
        self._previous.mkdir()
        moved: list[tuple[Path, Path]] = []
        try:
            for name in names:
                for origin, goal in (
                    (self.path / name, self._previous / name),
                    (self.folder / name, self.path / name),
                ):
                    if os.path.lexists(origin):
                        moved.append((origin, goal))
                        os.replace(origin, goal)
        except BaseException:
            for origin, goal in reversed(moved):
                if os.path.lexists(goal):
                    os.replace(goal, origin)
            raise
        shutil.rmtree(self._previous, ignore_errors=True)

    def _remove(self) -> None:
        """Remove the draft, and parents that were created only for it.

        Earlier entries that could not be restored stay in the draft.
        """
        shutil.rmtree(self.folder, ignore_errors=True)
        for folder in (self._previous, self._hidden, *self._made):
            with suppress(OSError):  # missing, or not empty
                folder.rmdir()


def is_marked(path: Path, mark: str) -> bool:
    """Whether a file contains the text that marks it as ours; true if there is no file."""
    try:
        return not os.path.lexists(path) or mark.encode() in path.read_bytes()
    except OSError:
        return False


def refuse_foreign(folder: Path, taken: Sequence[str]) -> None:
    """Raise OutputError if a folder has entries named in `taken`: they are not ours to replace."""
    if taken:
        raise OutputError(
            f"{folder} holds {', '.join(taken)} from elsewhere, which would be replaced.\n"
            "  Try: another folder, or move them away.",
            folder,
        )


def make_folder(path: Path) -> None:
    """Make a folder and its parents if they do not exist, or raise OutputError."""
    with _explained(path):
        path.mkdir(parents=True, exist_ok=True)


@contextmanager
def only_run(folder: Path) -> Iterator[None]:
    """Lock a folder for one run; the system releases it when the process ends in any way.

    Raises OutputError if another run holds it, or it cannot be written.
    """
    make_folder(folder)
    with _explained(folder):
        try:
            held = FileLock(folder / LOCK, timeout=0).acquire()
        except Timeout:
            raise OutputError(
                f"another run is writing to {folder}; wait for its end", folder
            ) from None
    with held:
        yield


def _draft_in(folder: Path) -> Path:
    """Place of a draft; its name is independent of the file's, which may have maximal length."""
    return folder / f"{_DRAFT}{secrets.token_hex(8)}"


@contextmanager
def _explained(path: Path) -> Iterator[None]:
    """Say what cannot be written, why, and what to try."""
    try:
        yield
    except OSError as error:
        why = error.strerror or str(error)
        cure = "another place, or check its permissions and the free space"
        if error.errno == errno.ENOENT and not path.parent.exists():
            why, cure = f"there is no folder {path.parent}", f"mkdir -p {path.parent}"
        text = f"{path} cannot be written: {why}.\n  Try: {cure}."
        raise OutputError(text, path) from None


def _sync_folder(folder: Path) -> None:
    """Make renamings durable if the file system can; the files' contents already are."""
    with suppress(OSError):
        number = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(number)
        finally:
            os.close(number)
