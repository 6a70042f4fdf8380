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

from dlo_casadi.arrays import FloatArray, IntArray
from dlo_casadi.codegen.compiler import compile_library
from dlo_casadi.codegen.generate import Solver
from dlo_casadi.codegen.moving import MovingCase, alone
from dlo_casadi.codegen.obstacles import Obstacles
from dlo_casadi.codegen.stepper import CompiledStepper
from dlo_casadi.effects import EFFECTS, IN_MOTION, Effect, Load, Setup
from dlo_casadi.errors import DloError
from dlo_casadi.model.cable_model import CableModel
from dlo_casadi.motion.sensitivities import Columns, Numbers, Stepping, Steps
from dlo_casadi.motion.state import Fixtures
from dlo_casadi.motion.steps import Moving
from dlo_casadi.motion.system import MovingCable

# Libraries that are kept.
_MOST = 32
# Effects for which a search in motion looks.
_SEARCHED: dict[str, type[Effect]] = IN_MOTION | {
    name: kind
    for name, kind in EFFECTS.items()
    if issubclass(kind, Load) and kind.masses is not Load.masses
}
# Without much optimisation: a library is used for some ten thousand steps.
_FLAGS = ("-O1",)


class CompiledSteps:
    """What `Steps` does, by compiled C; `records` has the layouts of its structures."""

    def __init__(self, cable: MovingCable, library: ctypes.CDLL, known: IntArray) -> None:
        """`cable`: widened, see `widened`; `known`: where its model's parameters stand."""
        self.records, self._known = CompiledStepper(cable, library), known
        self._table = np.array(MovingCase(cable.model, cable.p, cable.rest, inline=False).table)
        # The last derivatives and changes, and what they are in C.
        self._slopes: tuple[Columns | None, NDArray[Any]] = (None, np.zeros(0))
        self._numbers: tuple[Numbers | None, Any, Any] = (None, None, None)

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
        c = self.records
        slopes = self._slopes[1] if self._slopes[0] is columns else _slopes_of(c, columns)
        if self._numbers[0] is not numbers:
            self._numbers = (numbers, _given(c, numbers), self._of_model(numbers))
        _, given, of_model = self._numbers
        out = np.zeros(len(slopes), c.slope)
        states = (c.numbers_of(fixtures), c.recorded(before), c.recorded(after, dt))
        moved = (len(slopes), given, of_model, slopes, out)
        status = c.call("dlo_slopes_of", self._table, *states, *moved)
        if status != "ok":
            raise DloError(f"no derivatives of a step in time ({status})")
        found = _columns(out)
        self._slopes = (found, out)
        return found

    def _of_model(self, numbers: Numbers) -> FloatArray:
        """Changes (q, ...) of parameters, then of the rest strains of each segment."""
        count = numbers.p.shape[1]
        p = np.zeros((count, len(self.records.cable.p)))
        p[:, self._known] = numbers.p.T
        return np.hstack([p, np.moveaxis(numbers.rest, -1, 0).reshape(count, -1)])


def _slopes_of(c: CompiledStepper, columns: Columns) -> NDArray[Any]:
    """Derivatives as dlo_motion_slope."""
    b = c.cable.b
    slopes = np.zeros(columns.turn.shape[2], c.slope)
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
    return slopes


def _given(c: CompiledStepper, numbers: Numbers) -> NDArray[Any]:
    """Changes of fixtures as dlo_fixtures_slope."""
    count = numbers.p.shape[1]
    given = np.zeros(count, c.given)
    given["turn"] = numbers.turns.T.reshape(count, 2, c.cable.b)
    parts = (numbers.places, numbers.velocities, numbers.accelerations)
    for name, part in zip(("place", "velocity", "acceleration"), parts, strict=True):
        given[name] = np.moveaxis(part, -1, 0)
    return given


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


def fastest_steps(cable: MovingCable) -> Stepping:
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
    cable, known = widened(cable)
    model = replace(cable.model, n_rest=0, priors={})
    key = (model, cable.springs_on.tobytes(), flags)
    if key not in _libraries:
        if len(_libraries) == _MOST:
            del _libraries[next(iter(_libraries))]
        _libraries[key] = _library(cable, flags)
    library = _libraries[key]
    if isinstance(library, DloError):
        raise library
    return CompiledSteps(cable, library, known)


def widened(cable: MovingCable) -> tuple[MovingCable, IntArray]:
    """The cable with all effects of motion and a weight, and where its parameters stand there.

    Effects that it has not vanish, and all stand in one order: a search that adds one after the
    other compiles one library.
    """
    model = cable.model
    setup = Setup(model.cable, model.start, model.end, model.gravity, moves=True)
    own = {effect.label: effect for effect in model.effects if effect.label in _SEARCHED}
    others = tuple(effect for effect in model.effects if effect.label not in _SEARCHED)
    moving = tuple(
        own.get(name) or kind.made_for(setup)
        for name, kind in _SEARCHED.items()
        if name in own or kind.applies(setup)
    )
    wide = replace(model, effects=(*others, *moving))
    values = dict(zip(wide.names, wide.nominal, strict=True))
    values |= dict(zip(model.names, cable.p, strict=True))
    p = np.array([values[name] for name in wide.names])
    known = np.array([wide.names.index(name) for name in model.names])
    return MovingCable(wide, p, cable.rest, cable.still), known


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
