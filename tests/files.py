"""What is in a folder."""

from pathlib import Path


def tree(folder: Path) -> dict[str, bytes | None]:
    """Relative path -> content of every file, None of a folder; hidden ones included."""
    return {
        str(path.relative_to(folder)): path.read_bytes() if path.is_file() else None
        for path in sorted(folder.rglob("*"))
    }
