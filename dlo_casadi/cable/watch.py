"""Track a cable through poses that arrive, so that a process that is killed goes on where it was.

A folder of its own holds `state.json`, replaced as a whole after each pose, and `poses.jsonl`, a
line for each. A line is written before the state that counts it; what a killed process wrote beyond
its state is cut off by the next one.
"""

from __future__ import annotations

import json
import os
from collections.abc import Iterator, Mapping
from dataclasses import asdict
from functools import cached_property
from pathlib import Path
from typing import Any, BinaryIO

from dlo_casadi.cable.file import cable_of
from dlo_casadi.cable.fitted_cable import FittedCable
from dlo_casadi.cable.saved import FILE
from dlo_casadi.cable.tracked import known_of
from dlo_casadi.errors import DloError, OutputError
from dlo_casadi.io.files import finite, make_folder, write_file
from dlo_casadi.tracking.arrivals import Arrival, Arrivals, FolderArrivals, TableArrivals
from dlo_casadi.tracking.tracker import Tracker, Update

SCHEMA = "dlo-watch/1"
STATE, LINES = "state.json", "poses.jsonl"


class Watched:
    """A cable and its source of poses.

    Parameters
    ----------
    cable : FittedCable
    source : Path
        A folder of poses, or a table.
    into : Path
        Folder of the state.
    settings : mapping
        Arguments of `FittedCable.tracker`.
    again : bool
        Whether to begin anew, whatever is there.

    Raises
    ------
    DloError
        If there is no such source, or if the folder holds the state of another one.
    """

    def __init__(
        self,
        cable: FittedCable,
        source: Path,
        into: Path,
        settings: Mapping[str, Any],
        *,
        again: bool = False,
    ) -> None:
        self.into, self._settings = into, dict(settings)
        self.tracker: Tracker = cable.tracker(**self._settings)
        self._key = {
            "schema": SCHEMA,
            "source": str(source.absolute()),
            "model_hash": cable.metadata.model_hash,
            "settings": finite({k: x for k, x in self._settings.items() if k != "compiled"}),
        }
        known = None if again else self._known()
        self._length = 0
        self.source = _source(cable, source, {} if known is None else known["arrived"])
        make_folder(into)
        if known is not None:
            self._length = known["lines"]
            then = cable_of(known["tracker"]["parameters"])
            self.tracker.resume(known["tracker"], known_of(then))
        if (into / LINES).exists():
            self._lines.flush()  # lines that the state does not know go at once

    @cached_property
    def _lines(self) -> BinaryIO:
        """The file of lines, to go on after those that are known; made with the first one."""
        return _opened(self.into / LINES, self._length)

    def _known(self) -> dict[str, Any] | None:
        """The state of this source; None if there is none."""
        path = self.into / STATE
        try:
            known = json.loads(path.read_text("utf-8"))
        except FileNotFoundError:
            return None
        except (OSError, ValueError) as error:
            raise DloError(
                f"{path} cannot be read: {error}.\n  Try: --again, to begin anew"
            ) from None
        what = {
            "schema": "it is of another version",
            "source": "it is of {}",
            "model_hash": "the cable has been fitted anew since",
            "settings": "it was begun with {}",
        }
        for key, said in what.items():
            if not isinstance(known, dict) or known.get(key) != self._key[key]:
                found = known.get(key) if isinstance(known, dict) else known
                raise DloError(
                    f"{path} does not belong to this: {said.format(found)}.\n"
                    "  Try: --again, to begin anew; or --into another folder"
                )
        return dict(known)

    def arrived(self, *, last: bool) -> Iterator[dict[str, Any]]:
        """Lines about poses that have arrived; each is kept before it is returned."""
        for arrival in self.source.new(last=last):
            line = self._line(arrival)
            text = json.dumps(line, allow_nan=False) + "\n"
            self._lines.write(text.encode())
            self._lines.flush()
            os.fsync(self._lines.fileno())
            self._length += len(text.encode())
            state = self._key | {"lines": self._length, "arrived": self.source.state()}
            state["tracker"] = self.tracker.state()
            write_file(self.into / STATE, json.dumps(state, allow_nan=False))
            yield line

    def _line(self, arrival: Arrival) -> dict[str, Any]:
        line: dict[str, Any] = {"pose": arrival.name, "problem": arrival.problem or None}
        if arrival.pose is None:
            return line
        try:
            update = self.tracker.update(arrival.pose)
        except DloError as error:
            return line | {"problem": error.message}
        return dict(finite(line | _told(update, self.tracker)))

    def save(self) -> Path:
        """Write the cable as it is now; the folder can be used like one of results."""
        path = self.into / FILE
        write_file(path, json.dumps(self.tracker.cable.metadata.document))
        return path

    def close(self) -> None:
        """Close the lines."""
        if "_lines" in vars(self):
            self._lines.close()


def _opened(path: Path, length: int) -> BinaryIO:
    """The file of lines, to go on after so many bytes."""
    try:
        stream = path.open("ab")
        stream.truncate(length)
    except OSError as error:
        raise OutputError(f"{path} cannot be written: {error.strerror}", path) from None
    return stream


def _source(cable: FittedCable, source: Path, known: Mapping[str, Any]) -> Arrivals:
    shared = {key: x for key, x in cable.metadata.fixtures.items() if x is not None}
    shared.setdefault("start", (0.0,) * cable.model.node.dimension)
    if os.path.isdir(source):
        return FolderArrivals(source, shared, set(known.get("done", ())))
    if not os.path.isfile(source):
        raise DloError(f"{source}: no such folder or table of poses")
    return TableArrivals(source, cable.model.node, shared, **known)


def _told(update: Update, tracker: Tracker) -> dict[str, Any]:
    """What an update says to programs."""
    change = update.change
    return {
        "number": update.number,
        "rms": update.rms,
        "probability": update.probability,
        "refused": update.refused,
        "change": None if change is None else asdict(change),
        "parameters": {
            name: {"value": one.value, "std": one.std, "unit": one.unit}
            for name, one in tracker.params.items()
            if not one.fixed
        },
    }
