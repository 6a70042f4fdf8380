"""What is known of a cable that is tracked: its values and their uncertainty."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from typing import Self

import numpy as np

from dlo_casadi.arrays import BoolArray, FloatArray
from dlo_casadi.effects import MeasurementEffect
from dlo_casadi.equilibrium.pose import HeldPose
from dlo_casadi.equilibrium.spread import Uncertainty
from dlo_casadi.model.cable_model import CableModel
from dlo_casadi.model.functions import MODELS

# Largest change of a logarithm in an update.
_LOGS = 3.0


@dataclass(frozen=True, eq=False)
class Known:
    """A cable's model with its values and their uncertainty.

    Parameters
    ----------
    model : CableModel
    p : (n_parameters,), in the order of `model.names` (SI)
    rest : (n_rests,) [1/m]
    uncertainty : Uncertainty
    """

    model: CableModel
    p: FloatArray
    rest: FloatArray
    uncertainty: Uncertainty

    def without_photographs(self) -> Self:
        """The same cable without what photographs do to the points that are measured in them.

        Poses of a tracked cable are numbers, not photographs. A sensor of forces remains the same.
        """
        measuring = [x for x in self.model.effects if isinstance(x, MeasurementEffect)]
        if not any(item.photographed for item in measuring):
            return self
        of_points = {type(x) for x in measuring if type(x).observe != MeasurementEffect.observe}
        model, p = self.model.without_kind((*of_points,), self.p)
        gone, own = {*self.model.names} - {*model.names}, self.uncertainty
        kept = [k for k, name in enumerate(own.names) if name not in gone]
        uncertainty = replace(
            own,
            names=tuple(own.names[k] for k in kept),
            covariance=own.covariance[np.ix_(kept, kept)],
            added={name: std for name, std in own.added.items() if name not in gone},
        )
        return replace(self, model=model, p=p, uncertainty=uncertainty)

    def between(self, held: HeldPose) -> Self:
        """The same cable with the clips of a pose."""
        clips = tuple(clip.kind for clip in held.clips)
        by_length = held.free_length is not None
        if (clips, by_length) == (self.model.clips, self.model.fed_by_length):
            return self
        return replace(self, model=replace(self.model, clips=clips, fed_by_length=by_length))

    def moved(self, by_p: FloatArray, by_rest: FloatArray) -> Self:
        """The cable with other values, within their bounds; logarithms change by a share."""
        rise = np.exp(np.clip(self.rises(by_p, self.p), -_LOGS, _LOGS))
        new = np.where(self._logs, self.p * rise, self.p + by_p)
        p = np.where(by_p == 0, self.p, np.clip(new, *_bounds(self.model)))
        return replace(self, p=p, rest=self.rest + by_rest)

    def at(self, ways: Sequence[FloatArray], step: FloatArray) -> Self:
        """The cable after a step of its unknowns, of stiffnesses in logarithms.

        `ways`: directions of parameters and rests, the unknowns first.
        """
        by_p, by_rest = (way[:, : len(step)] for way in ways[:2])
        return self.moved(by_p @ (self.scale * step), by_rest @ step)

    @cached_property
    def scale(self) -> FloatArray:
        """Derivatives (n,) of the values by the unknowns: stiffnesses, for their logarithms."""
        values = dict(zip(self.model.names, np.where(self._logs, self.p, 1.0), strict=True))
        return np.array([values.get(x, 1.0) for x in self.uncertainty.names])

    @cached_property
    def root(self) -> FloatArray:
        """A (n, n) with A A^T the covariance of the unknowns, of stiffnesses of logarithms."""
        return np.asarray(self.uncertainty.root / self.scale[:, None])

    def with_root(self, root: FloatArray) -> Self:
        """The cable with the covariance A A^T of its unknowns, of stiffnesses of logarithms."""
        own = self.scale[:, None] * root
        return self.with_covariance(own @ own.T)

    @cached_property
    def unknowns(self) -> FloatArray:
        """Values (n,) of the unknowns, of stiffnesses their logarithms."""
        model, names = self.model, self.uncertainty.names
        own = np.log(self.p, out=self.p.copy(), where=self._logs)
        values = dict(zip(model.names, own, strict=True))
        if any(name not in values for name in names):
            rest = np.linalg.lstsq(model.rest_basis, self.rest, rcond=None)[0]
            values |= {f"rest_curvature[{k}]": x for k, x in enumerate(rest)}
        return np.array([values[name] for name in names])

    @cached_property
    def are_logs(self) -> BoolArray:
        """Whether each unknown (n,) is a logarithm."""
        logs = dict(zip(self.model.names, self._logs, strict=True))
        return np.array([logs.get(name, False) for name in self.uncertainty.names], dtype=bool)

    @cached_property
    def _logs(self) -> BoolArray:
        """Whether each parameter is Gaussian in its logarithm, as in the fit."""
        return np.array([q.log for q in self.model.parameters], dtype=bool)

    def rises(self, new: FloatArray, old: FloatArray) -> FloatArray:
        """Ratios of values that are logarithms, 1 for others."""
        return np.divide(new, old, out=np.ones(len(old)), where=self._logs)

    def with_covariance(self, covariance: FloatArray) -> Self:
        """The cable with another covariance of its unknowns."""
        return replace(self, uncertainty=replace(self.uncertainty, covariance=covariance))

    @property
    def stds(self) -> dict[str, float]:
        """Standard deviations of the unknowns."""
        known = self.uncertainty
        roots = np.sqrt(np.maximum(np.diag(known.covariance), 0.0))
        return dict(zip(known.names, roots.tolist(), strict=True))

    def value(self, name: str, start: Known) -> float:
        """A parameter, or the change of a rest coefficient from the start."""
        if name in self.model.names:
            return float(self.p[self.model.names.index(name)])
        change = np.linalg.lstsq(self.model.rest_basis, self.rest - start.rest, rcond=None)[0]
        return float(change[coefficient(name)])

    def with_unknowns(
        self, model: CableModel, values: Mapping[str, float], std: Mapping[str, float]
    ) -> Self:
        """The cable with more unknowns, or less known ones.

        Parameters
        ----------
        model : CableModel
            With all effects that have these unknowns.
        values : mapping
            Their first values, rest coefficients among them.
        std : mapping
            Their standard deviations, in addition to what the cable's covariance has of them.
        """
        old = self.uncertainty
        names = (*old.names, *(name for name in std if name not in old.names))
        covariance = np.pad(old.covariance, [(0, len(names) - len(old.names))] * 2)
        covariance += np.diag([std.get(name, 0.0) ** 2 for name in names])
        known = dict(zip(self.model.names, self.p, strict=True)) | dict(values)
        p = np.array([known.get(q.name, q.nominal) for q in model.parameters])
        rest = self.rest.copy()
        for name, value in values.items():
            if name not in model.names:
                rest += model.rest_basis[:, coefficient(name)] * value
        free = np.array([name in std for name in model.names])
        p = np.where(free, np.clip(p, *_bounds(model)), p)
        uncertainty = replace(old, names=names, covariance=covariance)
        return replace(self, model=model, p=p, rest=rest, uncertainty=uncertainty)


@lru_cache(maxsize=MODELS)
def _bounds(model: CableModel) -> FloatArray:
    """Bounds (2, n_parameters) of parameters that are estimated."""
    return np.array([q.bounds(estimated=True) for q in model.parameters]).T


def coefficient(name: str) -> int:
    """Number of a coefficient of the rest curvature, from its name."""
    return int(name.removeprefix("rest_curvature[").removesuffix("]"))
