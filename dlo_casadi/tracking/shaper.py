"""Equilibria of a cable that is tracked, and their derivatives, with one matrix for both."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from dlo_casadi.arrays import FloatArray
from dlo_casadi.codegen import CompiledShape, CompiledSolver
from dlo_casadi.codegen.segments import compile_segments
from dlo_casadi.equilibrium.batch import BatchEquilibrium
from dlo_casadi.equilibrium.curve import Observed, ObservedChange
from dlo_casadi.equilibrium.minima import damped, size_of, stepped
from dlo_casadi.equilibrium.pose import HeldPose
from dlo_casadi.equilibrium.solve import MOST_MOVED, MOST_TURNED, solve_equilibrium
from dlo_casadi.errors import EquilibriumError
from dlo_casadi.model.assembly import Shapes, Tangents
from dlo_casadi.model.cable_model import CableModel
from dlo_casadi.rod.band import DenseFactor, Vector
from dlo_casadi.tracking.known import Known

# Largest last step [rad] of Newton's method: a thousandth of what any camera sees.
_EXACT = 1e-7
# Newton steps, and the largest way of a node [rad], beyond which a shape is sought anew.
_STEPS, _FAR = 15, 1.5


@dataclass(frozen=True, eq=False)
class Linear:
    """An equilibrium, what is seen of it, and the derivatives of both along directions."""

    shapes: Shapes
    along: Tangents
    told: Observed
    change: ObservedChange

    def ahead(self, batch: BatchEquilibrium, step: FloatArray) -> Shapes:
        """The shapes after a step along the first directions, to first order."""
        q, along = len(step), self.along
        x, lam = along.x[..., :q] @ step, along.lam[..., :q] @ step
        return batch.moved(self.shapes, Vector(x[..., None], lam[..., None]))


def linearized(
    batch: BatchEquilibrium,
    start: Shapes,
    known: Known,
    ways: Sequence[FloatArray],
    *,
    stable: bool = True,
) -> Linear | None:
    """The equilibrium of one pose near a shape, by Newton's method; None if there is no such one.

    `ways`: directions of parameters, rests and deviations. `stable`: whether it must be. The matrix
    of the last step serves the derivatives, too, and tells whether the equilibrium is stable.
    """
    model, shapes, last = batch.model, start, np.full(1, np.inf)
    by_p, by_rest, by_deviation = (way[None] for way in ways)
    x = np.zeros((1, model.chain.n_nodes, model.node.increment, by_p.shape[2]))
    still = Tangents(x, np.zeros((1, model.n_border, x.shape[3])), by_p, by_rest, by_deviation)
    for _ in range(_STEPS):
        here = batch.at(shapes, known.p, known.rest)
        _, force, matrix = here.balance()
        try:
            factor = DenseFactor(matrix)
            step = factor.solve(Vector(-force.x, -force.y))
        except np.linalg.LinAlgError:
            return None
        size = size_of(model, step)
        shapes = stepped(here, *damped(model, step, size, last)).shapes
        if not np.abs(model.node.difference(start.x, shapes.x)).max() <= _FAR:
            return None
        if size[0] < _EXACT:
            break
        last = size
    else:
        return None
    if stable and factor.negative != model.n_multipliers:
        return None
    found = factor.solve(here.balance_along(still))
    along = replace(still, x=-found.x, lam=-found.y, tangent=matrix)
    ((told, change),) = batch.observe(shapes, known.p, known.rest, along)
    return Linear(shapes, along, told, change)


@dataclass(frozen=True, eq=False)
class _Last:
    """The last pose, its shape, and that in C."""

    model: CableModel
    held: HeldPose
    shapes: Shapes
    compiled: CompiledShape | None


@dataclass(eq=False)
class Shaper:
    """Finds equilibria: near the last one, by compiled C, or anew.

    Parameters
    ----------
    compiled : bool
        Whether a cable is compiled; it is once for each number and kind of clips.
    """

    compiled: bool = False
    _last: _Last | None = None
    _solvers: dict[Any, CompiledSolver] = field(default_factory=dict)
    _found: CompiledShape | None = None
    _ways: tuple[Any, tuple[FloatArray, ...]] | None = None

    @classmethod
    def after(cls, model: CableModel, held: HeldPose, shapes: Shapes) -> Shaper:
        """One that has found the shape of a pose."""
        shaper = cls()
        shaper.keep(model, held, shapes)
        return shaper

    def keep(self, model: CableModel, held: HeldPose, shapes: Shapes) -> None:
        """Remember the shape of a pose, from which that of the next one is found."""
        self._last = _Last(model, held, shapes, self._found)

    @property
    def knows(self) -> bool:
        """Whether there is a last shape."""
        return self._last is not None

    def ways(self, known: Known) -> tuple[FloatArray, ...]:
        """Directions of parameters, rests and deviations: the unknowns, then what a pose varies.

        See `Uncertainty.ways_in`; the unknowns one by one, in their own units.
        """
        of, model = known.uncertainty, known.model
        same = self._ways is not None and self._ways[0][1:] == (of.names, model)
        if self._ways is None or not (same and self._ways[0][0] is of.scatter):
            one_by_one = replace(of, covariance=np.eye(len(of.names)))
            self._ways = (of.scatter, of.names, model), one_by_one.ways_in(model)
        return self._ways[1]

    def found(
        self,
        batch: BatchEquilibrium,
        known: Known,
        ways: Sequence[FloatArray],
        start: Shapes | None,
    ) -> Linear:
        """The equilibrium near a shape, or else the lowest one.

        Raises
        ------
        EquilibriumError
            If there is none.
        """
        found = None if start is None else linearized(batch, declared(batch, start), known, ways)
        if found is None:
            (held,) = batch.poses
            lowest = solve_equilibrium(known.model, known.p, known.rest, held).shapes
            found = linearized(batch, declared(batch, lowest), known, ways, stable=False)
        if found is None:
            raise EquilibriumError("no equilibrium: Newton's method did not converge", held.name)
        return found

    def start(self, batch: BatchEquilibrium, known: Known, *, anew: bool) -> Shapes | None:
        """A shape near that of a pose, if one is known; not the last one if `anew`."""
        (held,) = batch.poses
        last = None if anew else self._near(known.model, held)
        if self.compiled:
            return self._by_c(batch, known, held, last)
        return None if last is None else last.shapes

    def _near(self, model: CableModel, held: HeldPose) -> _Last | None:
        """The last pose if the fixtures have hardly moved since."""
        last = self._last
        if last is None or (last.model.clips, last.model.n) != (model.clips, model.n):
            return None
        if replace(last.held, name=held.name, **_places(held)) != held:
            return None
        gaps, d = np.abs(held.ends - last.held.ends), model.node.dimension
        turned = MOST_TURNED if d == 2 else MOST_TURNED / 2  # parts of a quaternion
        near = (
            gaps[: 2 * d].max() <= MOST_MOVED * model.cable.length and gaps[2 * d :].max() <= turned
        )
        return last if near else None

    def _by_c(
        self, batch: BatchEquilibrium, known: Known, held: HeldPose, last: _Last | None
    ) -> Shapes | None:
        """A shape by C, moved by what the cable has learned since it was compiled.

        That moves it as in the last pose.
        """
        key, model = known.model.clips, known.model
        if key not in self._solvers:
            self._solvers[key] = CompiledSolver(model, known.p, known.rest)
            compile_segments(batch.model)
        before = None if last is None else last.compiled
        found = self._solvers[key].solve(held, warm=before, throw=False)
        self._found = found if found.status == "ok" else None
        if self._found is None:
            return None if last is None else last.shapes
        if last is None or before is None:
            return batch.start_shapes(found.x[None])
        x = model.node.moved(found.x, model.node.difference(before.x, last.shapes.x))
        lam = last.shapes.lam.copy()
        if model.end_pull:
            lam[:, model.end_pull] += found.end_force - before.end_force
        return replace(last.shapes, x=x, lam=lam)


def _places(held: HeldPose) -> dict[str, Any]:
    """What may differ between poses that are near each other."""
    turned = ("start_heading", "end_heading", "start_orientation", "end_orientation")
    return {name: getattr(held, name) for name in ("start", "end", *turned)}


def declared(batch: BatchEquilibrium, shapes: Shapes) -> Shapes:
    """Shapes with fixtures where they are declared, for a batch's model."""
    still = np.zeros((len(shapes.x), len(batch.model.deviation_names)))
    return replace(shapes, deviation=still)
