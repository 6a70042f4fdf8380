"""Files that are there as a whole or not at all, even after a power cut."""

from __future__ import annotations

import fcntl
import os
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO

from dlo_casadi.errors import DloError


def write_durably(path: Path, fill: Callable[[BinaryIO], object]) -> None:
    """Fill a hidden draft beside the file, make it durable, rename it into place.

    Raises
    ------
    DloError
        If the file cannot be written.
    """
    try:
        number, name = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.", suffix=".draft")
        draft = Path(name)
        try:
            with os.fdopen(number, "wb") as stream:
                fill(stream)
                stream.flush()
                os.fsync(stream.fileno())
            os.chmod(draft, 0o644)  # a draft is its owner's alone
            os.replace(draft, path)
        finally:
            draft.unlink(missing_ok=True)
        _sync_folder(path.parent)
    except OSError as error:
        raise DloError(f"{path} cannot be written: {error.strerror or error}") from None


def _sync_folder(folder: Path) -> None:
    """Make a renaming durable."""
    number = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(number)
    finally:
        os.close(number)


@contextmanager
def only_run(folder: Path) -> Iterator[None]:
    """Hold a folder for one run; the system lets go of it when the process ends, however.

    Raises
    ------
    DloError
        If another run holds it, or it cannot be written.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        stream = (folder / ".lock").open("w")
    except OSError as error:
        raise DloError(
            f"the folder {folder} cannot be written: {error.strerror or error}"
        ) from None
    with stream:
        try:
            fcntl.flock(stream, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            raise DloError(f"another run is writing to {folder}; wait for its end") from None
        yield
