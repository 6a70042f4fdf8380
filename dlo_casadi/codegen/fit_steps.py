"""Steps in time for fits of motions, compiled once for all values of a model's parameters."""

from __future__ import annotations

import ctypes
import shutil
import tempfile
import weakref
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dlo_casadi.arrays import FloatArray
from dlo_casadi.codegen.cases import Obstacles
from dlo_casadi.codegen.compiler import compile_library
from dlo_casadi.codegen.generate import Solver
from dlo_casadi.codegen.moving import MovingCase, alone
from dlo_casadi.codegen.stepper import CompiledStepper
from dlo_casadi.errors import DloError
from dlo_casadi.model.cable_model import CableModel
from dlo_casadi.motion.sensitivities import Columns, Numbers, Steps
from dlo_casadi.motion.state import Fixtures
from dlo_casadi.motion.steps import Moving
from dlo_casadi.motion.system import MovingCable

# Libraries that are kept.
_MOST = 32
# Without much optimisation: a library is used for some ten thousand steps.
_FLAGS = ("-O1",)


class CompiledSteps:
    """What `Steps` does, by compiled C; `records` has the layouts of its structures."""

    def __init__(self, cable: MovingCable, library: ctypes.CDLL) -> None:
        self.records = CompiledStepper(cable, library)
        self._table = np.array(MovingCase(cable.model, cable.p, cable.rest, inline=False).table)
        self._numbers: tuple[Any, FloatArray] = (None, np.zeros(0))

    def step(self, before: Moving, fixtures: Fixtures, dt: float) -> Moving | None:
        """The state dt later; None if there is no step."""
        out, status = self.advance(self.records.recorded(before), fixtures, dt)
        return self.records.moving(out) if status == "ok" else None

    def advance(self, now: NDArray[Any], fixtures: Fixtures, dt: float) -> tuple[NDArray[Any], str]:
        """The same of a dlo_motion, and one of STATUSES."""
        out, given = np.zeros(1, self.records.record), self.records.numbers_of(fixtures)
        return out, self.records.call("dlo_advance_of", self._table, given, float(dt), now, out)

    def derived(
        self,
        before: Moving,
        after: Moving,
        columns: Columns,
        fixtures: Fixtures,
        numbers: Numbers,
        dt: float,
    ) -> Columns:
        """Derivatives after a step."""
        c, b = self.records, self.records.cable.b
        count = columns.turn.shape[2]
        slopes, given = np.zeros(count, c.slope), np.zeros(count, c.given)
        parts = {
            "turn": columns.turn,
            "r": columns.place,
            "w": columns.rates[:, :b],
            "v": columns.rates[:, b:],
            "alpha": columns.accelerations[:, :b],
            "a": columns.accelerations[:, b:],
            "mean": columns.own,
            "force": columns.force,
        }
        for name, part in parts.items():
            slopes[name] = np.moveaxis(part, -1, 0)
        slopes["moment"][:, :-1] = columns.moment.T
        given["turn"] = numbers.turns.T.reshape(count, 2, b)
        for name, part in (
            ("place", numbers.places),
            ("velocity", numbers.velocities),
            ("acceleration", numbers.accelerations),
        ):
            given[name] = np.moveaxis(part, -1, 0)
        out = np.zeros(count, c.slope)
        status = c.call(
            "dlo_slopes_of",
            self._table,
            c.numbers_of(fixtures),
            c.recorded(before),
            c.recorded(after, dt),
            count,
            given,
            self._of_model(numbers),
            slopes,
            out,
        )
        if status != "ok":
            raise DloError(f"no derivatives of a step in time ({status})")
        return _columns(out)

    def _of_model(self, numbers: Numbers) -> FloatArray:
        """Changes (q, ...) of parameters and of rest strains; the same from step to step."""
        known, rows = self._numbers
        if known is not numbers.p:
            rest = np.moveaxis(numbers.rest, -1, 0).reshape(numbers.p.shape[1], -1)
            rows = np.ascontiguousarray(np.hstack([numbers.p.T, rest]))
            self._numbers = (numbers.p, rows)
        return rows


def _columns(out: NDArray[Any]) -> Columns:
    def last(*names: str) -> FloatArray:
        return np.moveaxis(np.concatenate([out[name] for name in names], axis=-1), 0, -1)

    return Columns(
        last("turn"),
        last("r"),
        last("w", "v"),
        last("alpha", "a"),
        last("mean"),
        last("force"),
        np.ascontiguousarray(out["moment"][:, :-1].T),
    )


def fastest_steps(cable: MovingCable) -> Steps | CompiledSteps:
    """Compiled steps where there is a C compiler; else those of Python."""
    try:
        return compiled_steps(cable)
    except DloError:
        return Steps(cable)


def compiled_steps(cable: MovingCable, flags: tuple[str, ...] = _FLAGS) -> CompiledSteps:
    """Compiled steps; the library is kept for cables that differ in numbers alone.

    Raises
    ------
    DloError
        If there is no C compiler.
    """
    model = replace(cable.model, n_rest=0, priors={})
    key = (model, cable.springs_on.tobytes(), flags)
    if key not in _libraries:
        if len(_libraries) == _MOST:
            del _libraries[next(iter(_libraries))]
        _libraries[key] = _library(cable, flags)
    library = _libraries[key]
    if isinstance(library, DloError):
        raise library
    return CompiledSteps(cable, library)


# By model without what makes no difference, and by the segments that springs are on.
_libraries: dict[tuple[CableModel, bytes, tuple[str, ...]], ctypes.CDLL | DloError] = {}


def _library(cable: MovingCable, flags: tuple[str, ...]) -> ctypes.CDLL | DloError:
    """A compiled library, or why there is none."""
    text = alone(MovingCase(cable.model, cable.p, cable.rest, inline=False))
    folder = Path(tempfile.mkdtemp(prefix="dlo_steps_"))
    source = Solver("dlo", "", {"dlo_solver.c": text}, Obstacles())
    try:
        library = ctypes.CDLL(str(compile_library(source, folder, flags)))
    except DloError as error:
        shutil.rmtree(folder, ignore_errors=True)
        return error
    weakref.finalize(library, shutil.rmtree, folder, ignore_errors=True)
    return library
