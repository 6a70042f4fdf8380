"""Steps in time by compiled C, with the states of `dlo_casadi.motion`."""

from __future__ import annotations

import ctypes
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dlo_casadi.arrays import FloatArray
from dlo_casadi.codegen.statuses import STATUSES
from dlo_casadi.motion.state import Fixtures, State
from dlo_casadi.motion.steps import Moving
from dlo_casadi.motion.system import MovingCable
from dlo_casadi.rod.ends import EndConditions

# Fields of dlo_motion that are fields of a State.
_OF_STATE = ("x", "r", "w", "v", "alpha", "a")


class CompiledStepper:
    """The functions of motion of a compiled solver: dlo_rest, dlo_start, dlo_advance.

    Parameters
    ----------
    cable : MovingCable
    library : ctypes.CDLL
        A compiled solver, generated with `motion=True`.

    Attributes
    ----------
    record, slope, given : dtype
        Layouts of dlo_motion, dlo_motion_slope and dlo_fixtures_slope.
    """

    def __init__(self, cable: MovingCable, library: ctypes.CDLL) -> None:
        self.cable, self._c = cable, library
        nodes, n = cable.n_nodes, cable.n_segments
        b, c, d = cable.b, cable.model.node.coordinates, cable.d
        moving: dict[str, tuple[int, ...]] = {
            "r": (nodes, d),
            "w": (nodes, b),
            "v": (nodes, d),
            "alpha": (nodes, b),
            "a": (nodes, d),
            "mean": (nodes, b + d),
            "force": (n, d * (1 + 2 * cable.model.n_springs)),
            "moment": (cable.n_moments + 1,),
            "start_force": (d,),
            "end_force": (d,),
        }
        still: dict[str, tuple[int, ...]] = {"still": (n, cable.still.shape[1]), "dt": ()}
        rates: dict[str, tuple[int, ...]] = dict.fromkeys(
            ("place", "velocity", "acceleration"), (2, d)
        )
        self.record = _doubles({"x": (nodes, c)} | moving | still)
        self.slope = _doubles({"turn": (nodes, b)} | moving)
        self.given = _doubles({"turn": (2, b)} | rates)
        size = library.dlo_motion_workspace_size
        size.restype = ctypes.c_size_t
        self._work = np.empty(int(size()))

    # ---- records -------------------------------------------------------------------------------

    def recorded(self, moving: Moving, dt: float = 0.0) -> NDArray[Any]:
        """A state as a dlo_motion; `dt` [s]: step that led to it."""
        out = np.zeros(1, self.record)
        for name in (*_OF_STATE, "force"):
            out[name] = getattr(moving.state, name)
        out["mean"], out["still"] = moving.own, self.cable.still
        out["moment"][0, :-1], out["dt"] = moving.state.moment, dt
        return out

    def moving(self, record: NDArray[Any]) -> Moving:
        """A dlo_motion as a state."""
        (one,) = record
        known = {name: one[name].copy() for name in (*_OF_STATE, "force")}
        return Moving(State(**known, moment=one["moment"][:-1].copy()), one["mean"].copy())

    def numbers_of(self, fixtures: Fixtures) -> FloatArray:
        """Fixtures as a dlo_fixtures."""
        node = self.cable.model.node
        pose = np.zeros(EndConditions.size(node) + node.twists)
        pose[: EndConditions.size(node)] = fixtures.pose[: EndConditions.size(node)]
        rates = (fixtures.velocities, fixtures.accelerations)
        return np.concatenate([pose, *(x.ravel() for x in rates)])

    # ---- functions -----------------------------------------------------------------------------

    def rest(self, fixtures: Fixtures, shape: NDArray[Any]) -> tuple[NDArray[Any], str]:
        """The cable at rest in a dlo_shape, and one of STATUSES; so below."""
        return self._made("dlo_rest", self.numbers_of(fixtures), shape)

    def start(self, now: NDArray[Any], fixtures: Fixtures, dt: float) -> tuple[NDArray[Any], str]:
        """A motion with its first accelerations and forces, means over a step dt [s]."""
        return self._made("dlo_start", self.numbers_of(fixtures), dt, now)

    def advance(self, now: NDArray[Any], fixtures: Fixtures, dt: float) -> tuple[NDArray[Any], str]:
        """The motion dt [s] later, where fixtures are as given."""
        return self._made("dlo_advance", self.numbers_of(fixtures), dt, now)

    def modes(self, fixtures: Fixtures, rest: NDArray[Any], count: int) -> tuple[FloatArray, str]:
        """Natural frequencies [Hz] and damping ratios (2, count) about a dlo_motion at rest."""
        out, size = np.zeros((2, count)), self._c.dlo_modes_workspace_size
        size.restype = ctypes.c_size_t
        work = np.empty(int(size()))
        given = (self.numbers_of(fixtures), rest, np.int32(count), out[0], out[1], work, work.size)
        return out, STATUSES[self._c.dlo_modes(*map(_passed, given))]

    def slopes(
        self,
        before: NDArray[Any],
        after: NDArray[Any],
        fixtures: Fixtures,
        given: NDArray[Any],
        columns: NDArray[Any],
    ) -> tuple[NDArray[Any], str]:
        """Derivatives (q,) of `after` by q numbers: `columns` (q,) of `before`, `given` (q,)."""
        out, numbers = np.zeros(len(columns), self.slope), self.numbers_of(fixtures)
        moved = (numbers, before, after, len(columns), given, columns, out)
        return out, self.call("dlo_advance_slopes", *moved)

    def _made(self, name: str, *arguments: Any) -> tuple[NDArray[Any], str]:
        out = np.zeros(1, self.record)
        return out, self.call(name, *arguments, out)

    def call(self, name: str, *arguments: Any) -> str:
        """Call a function of the library with the workspace; one of STATUSES."""
        given = map(_passed, (*arguments, self._work, self._work.size))
        return STATUSES[getattr(self._c, name)(*given)]


def _passed(argument: Any) -> Any:
    """An argument for C."""
    if isinstance(argument, float):
        return ctypes.c_double(argument)
    if isinstance(argument, np.int32):
        return ctypes.c_int(int(argument))
    if isinstance(argument, np.ndarray):
        return ctypes.c_void_p(argument.ctypes.data)
    return ctypes.c_size_t(argument)


def _doubles(shapes: dict[str, tuple[int, ...]]) -> np.dtype[Any]:
    return np.dtype([(name, float, shape) for name, shape in shapes.items()])
