"""The sessions in a folder or of a pattern."""

import glob
import hashlib
import os
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from dlo_casadi import __version__
from dlo_casadi.config import read_yaml
from dlo_casadi.errors import DloError, well_formed

ENDINGS = (".yaml", ".yml")
# A line that makes a YAML file a configuration, even one with mistakes.
_SECTION = re.compile(rb"^(cable|experiment)\s*:", re.MULTILINE)


@dataclass(frozen=True, order=True)
class SessionFile:
    """One configuration of many.

    Parameters
    ----------
    key : str
        Its path below the common folder of all, with `/`: unique.
    path : Path
        The YAML file, absolute.
    """

    key: str
    path: Path


def find_sessions(where: str | Path) -> tuple[Path, tuple[SessionFile, ...]]:
    """Find all configurations in a folder and below, or of a pattern.

    In a folder a YAML file counts if it has a `cable:` or an `experiment:` and is no result of a
    fit; hidden folders are left out. All files that match a pattern count; `**` stands for any
    folders.

    Returns
    -------
    Path, tuple of SessionFile
        The common folder, and the sessions in the order of their keys.

    Raises
    ------
    DloError
        If there is none.
    """
    text = str(where)
    folder = Path(text)
    if os.path.isdir(folder):
        base = folder.resolve()
        found = []
        for inner, folders, names in os.walk(base):
            folders[:] = sorted(name for name in folders if not name.startswith("."))
            paths = [Path(inner, name) for name in names if name.lower().endswith(ENDINGS)]
            found += [path for path in paths if _is_session(path)]
    else:
        named = {Path(name).resolve() for name in glob.glob(text, recursive=True)}
        found = [path for path in named if path.is_file()]
        base = Path(os.path.commonpath([path.parent for path in found])) if found else folder
    if not found:
        raise DloError(
            f"no configuration in {text}: a YAML file with cable: and experiment: is looked for.\n"
            "  Try: a folder, or a pattern in quotes, such as 'cables/*/session.yaml'."
        )
    keys = [well_formed(path.relative_to(base).as_posix()) for path in found]
    sessions = sorted(map(SessionFile, keys, found))
    return base, tuple(sessions)


def _is_session(path: Path) -> bool:
    """Whether a YAML file is intended as a configuration."""
    try:
        content = path.read_bytes()
    except OSError:
        return True  # its row will say why
    return bool(_SECTION.search(content)) and not re.search(rb"^schema\s*:", content, re.MULTILINE)


def digest_of(session: SessionFile, options: tuple[Any, ...]) -> str:
    """SHA-256 of all that determines a session's results.

    The package's version, the options of the run, the configuration's bytes, and the name and
    bytes of each file that its poses name; an unreadable file enters as such.
    """
    digest = hashlib.sha256()

    def add(content: bytes) -> None:
        digest.update(len(content).to_bytes(8, "big"))
        digest.update(content)

    add(repr((__version__, options)).encode())
    try:
        poses = read_yaml(session.path)["experiment"]["poses"]
        named = [name for pose in poses for name in (pose.get("file"), *(pose.get("files") or ()))]
        names = [str(name) for name in named if name is not None]
    except (DloError, KeyError, TypeError, AttributeError):
        names = []  # a configuration that cannot be read
    add(_content(session.path))
    for name in names:
        add(well_formed(name).encode())
        add(_content(session.path.parent / name))
    return digest.hexdigest()


def _content(path: Path) -> bytes:
    """SHA-256 of a file's bytes; empty if it cannot be read."""
    try:
        with path.open("rb") as stream:
            return hashlib.file_digest(stream, "sha256").digest()
    except (OSError, ValueError):  # a name that no file can have is a ValueError
        return b""
