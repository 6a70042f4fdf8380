"""Poses that arrive: a folder into which files are written, or a table that grows."""

from __future__ import annotations

import csv
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol

from dlo_casadi.config import Pose
from dlo_casadi.config.document import Document
from dlo_casadi.errors import DloError
from dlo_casadi.io.tables import table_of_lines
from dlo_casadi.rod.node import Node

# Files of poses; others are not looked at.
_ENDINGS = (".json", ".yaml", ".yml")
# Column of the table that tells poses apart, and that of arc lengths.
_NAME, _PLACE = "pose", "s_m"


@dataclass(frozen=True)
class Arrival:
    """One pose that has arrived, or why there is none."""

    name: str
    pose: Pose | None
    problem: str = ""


class Arrivals(Protocol):
    """A source of poses."""

    def new(self, *, last: bool) -> Iterator[Arrival]:
        """Poses that have arrived; with `last` also those that may still be written."""

    def state(self) -> dict[str, Any]:
        """Plain data: what has been read, up to the last pose that was taken from `new`."""


@dataclass(eq=False)
class FolderArrivals:
    """A file for each pose in a folder: JSON or YAML with the keys of a pose in a session.

    Files are taken in the order of their names. One that cannot be read, and any YAML, whose half
    may be a whole, is left until it has stayed the same from one look to the next.

    Parameters
    ----------
    folder : Path
    shared : mapping
        Keys that all poses share.
    done : set of str
        Names of files that have been taken.
    """

    folder: Path
    shared: Mapping[str, Any]
    done: set[str] = field(default_factory=set)
    _seen: dict[str, tuple[int, int]] = field(default_factory=dict)

    def new(self, *, last: bool) -> Iterator[Arrival]:
        """See `Arrivals`."""
        try:
            names = {x.name for x in self.folder.iterdir() if x.suffix.lower() in _ENDINGS}
        except OSError as error:
            raise DloError(f"{self.folder}: {error.strerror}.\n  Try: a folder of poses") from None
        names = {name for name in names if not name.startswith(".")}
        self.done &= names  # a file that was removed may come again
        for name in sorted(names - self.done):
            found = self._read(name, last=last)
            if found is not None:
                self.done.add(name)
                self._seen.pop(name, None)
                yield found

    def _read(self, name: str, *, last: bool) -> Arrival | None:
        """The pose of a file; None if it may still be written."""
        path = self.folder / name
        try:
            stat = path.stat()
        except OSError:
            return None  # it is gone
        size = stat.st_size, stat.st_mtime_ns
        same = self._seen.get(name) == size or last
        self._seen[name] = size
        if path.suffix.lower() != ".json" and not same:
            return None
        try:
            data = Document.read(path).data
            if not isinstance(data, dict):
                raise DloError("keys of a pose belong here: start, end, points, at, ...")
            return Arrival(path.stem, Pose(**{**self.shared, "name": path.stem, **data}))
        except (DloError, TypeError) as error:
            text = error.message if isinstance(error, DloError) else str(error)
            return Arrival(path.stem, None, text) if same else None

    def state(self) -> dict[str, Any]:
        """See `Arrivals`."""
        return {"done": sorted(self.done)}


@dataclass(eq=False)
class TableArrivals:
    """A table that grows: a row for each point, and a column `pose`.

    Columns: pose, x_m, y_m[, z_m]; s_m for markers; and, the same in all rows of a pose, where the
    ends are, start_x_m, end_x_m, start_heading_rad, ..., see `held.listed_poses`. Separated by
    commas, in UTF-8. A pose is whole once another one follows.

    Parameters
    ----------
    path : Path
    node : type of Node
    shared : mapping
        Keys that all poses share.
    offset, line : int
        Bytes and lines that have been taken.
    """

    path: Path
    node: type[Node]
    shared: Mapping[str, Any]
    offset: int = 0
    line: int = 0
    header: str = ""

    def new(self, *, last: bool) -> Iterator[Arrival]:
        """See `Arrivals`."""
        try:
            with self.path.open("rb") as file:
                first = file.readline()
                if not (self.header or last or first.endswith(b"\n")):
                    return  # its header is being written
                self._begin(first, file.tell())
                file.seek(self.offset)
                content = file.read()
        except OSError as error:
            raise DloError(f"{self.path}: {error.strerror}.\n  Try: a table of poses") from None
        lines = content.splitlines(keepends=True)
        if lines and not lines[-1].endswith(b"\n") and not last:
            lines.pop()  # it is being written
        group: list[tuple[int, str]] = []
        name, size = None, 0
        for k, raw in enumerate(lines, start=self.line + 1):
            text = raw.decode("utf-8", errors="replace").rstrip("\r\n")
            own = self._name(text) if text.strip() else name
            if name is not None and own != name:
                yield self._taken(name, group, size)
                group, size = [], 0
            name, size = own, size + len(raw)
            group.append((k, text))
        if name is not None and last:
            yield self._taken(name, group, size)

    def _begin(self, first: bytes, end: int) -> None:
        """Read the header."""
        if not self.header:
            self.header = first.decode("utf-8-sig", errors="replace").strip()
            names = self._cells(self.header)
            if _NAME not in names:
                found = f"found {', '.join(names)}" if self.header else "it is empty"
                raise DloError(
                    f"{self.path}: the column {_NAME} is missing, {found}.\n"
                    f"  Try: {_NAME},{_PLACE},{','.join(f'{a}_m' for a in self.node.axes)},end_x_m"
                )
        if not self.offset:
            self.offset, self.line = end, 1

    @staticmethod
    def _cells(text: str) -> list[str]:
        return [cell.strip() for cell in next(csv.reader([text]), [])]

    def _name(self, text: str) -> str:
        """The pose that a row is of; empty if the row has too few cells."""
        cells, at = self._cells(text), self._cells(self.header).index(_NAME)
        return cells[at] if at < len(cells) else ""

    def _taken(self, name: str, rows: list[tuple[int, str]], size: int) -> Arrival:
        self.offset += size
        self.line += len(rows)
        try:
            return Arrival(name, self._pose(name, rows))
        except (DloError, ValueError) as error:
            text = error.message if isinstance(error, DloError) else " ".join(map(str, error.args))
            return Arrival(name, None, text)

    def _pose(self, name: str, rows: list[tuple[int, str]]) -> Pose:
        node, sides = self.node, ("start", "end")
        places = [f"{axis}_m" for axis in node.axes]
        keys = {side: [f"{side}_{column}" for column in places] for side in sides}
        keys |= {f"{s}_{node.direction}": [f"{s}_{x}" for x in node.columns] for s in sides}

        def chosen(names: tuple[str, ...]) -> list[str]:
            """Columns that are numbers."""
            groups = [group for group in keys.values() if {*group} & {*names}]
            needed = [*places, *(column for group in groups for column in group)]
            if absent := [column for column in needed if column not in names]:
                raise ValueError(f"the column {absent[0]} is missing")
            return [*needed, *[_PLACE] * (_PLACE in names)]

        table = table_of_lines([(1, self.header), *rows], chosen, "a header and points")
        given: dict[str, Any] = {"name": name, **self.shared}
        for key, group in keys.items():
            if group[0] in table.columns:
                first = [float(table[column][0]) for column in group]
                if any((table[column] != x).any() for column, x in zip(group, first, strict=True)):
                    raise ValueError(f"{key} is not the same in all rows of the pose")
                given[key] = first if len(group) > 1 else first[0]
        given["points"] = [
            list(row) for row in zip(*(table[x].tolist() for x in places), strict=True)
        ]
        if _PLACE in table.columns:
            given["at"] = table[_PLACE].tolist()
        return Pose(**given)

    def state(self) -> dict[str, Any]:
        """See `Arrivals`."""
        return {"offset": self.offset, "line": self.line, "header": self.header}
