"""A fitted cable as the file of a simulator, at rest or with fixtures that move."""

from __future__ import annotations

from collections.abc import Mapping
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from dlo_casadi.arrays import FloatArray
from dlo_casadi.cable.motion import CableInMotion, fixture_path, times_of
from dlo_casadi.cable.move import Move
from dlo_casadi.cable.moving_table import read_fixtures
from dlo_casadi.errors import DloError
from dlo_casadi.export.driven import Driven
from dlo_casadi.export.targets import check_counts, samples_of, step_of, target_of, write_rods

AnyMotion = Move | Mapping[str, Any] | str | PathLike[str]


# Steps of a motion at least: a short one swings fast.
_LEAST = 1000


class ExportedCable(CableInMotion):
    """A fitted cable that is written for simulators."""

    if TYPE_CHECKING:

        def solve(self, *pose: Any, **held: Any) -> Any:
            """See `FittedCable.solve`."""

    def export(
        self,
        target: str,
        path: str | PathLike[str],
        *,
        segments: int | None = None,
        samples: int = 0,
        seed: int = 0,
        motion: AnyMotion | None = None,
        **held: Any,
    ) -> list[Path]:
        """Write the cable for a simulator, its ends `held` as in `solve`; return the files.

        Parameters
        ----------
        target : str
            One of `export.targets.TARGETS`.
        segments : int, optional
            Number of links; by default joints turn by 0.1 rad at most.
        samples : int
            Number of further cables drawn from the fit's covariance: <path>_001, ...
        motion : Move, mapping or path, optional
            How the fixtures move, for MuJoCo: the result of `move`, arguments of `simulate`, or a
            table as of `dlo simulate`. The cable begins at rest in the first row.

        Raises
        ------
        DloError
            If there is no such target, if a number is too small, if a file cannot be written, if
            the target knows no fixtures that move, or as in `solve`.
        """
        if not isinstance(path, str | PathLike):
            raise DloError(f"path: a file name belongs here, found {path!r}")
        check_counts(segments, samples, seed)
        to, known = target_of(target), self.metadata
        driven = None
        if motion is not None:
            given = given_motion(self, motion, step_of(to), held)
            driven, held = given.driven, given.first
        first = self.solve(**held).held
        fitted = (known.coefficients, known.covariance.names, known.covariance.values)
        others = samples_of(first, *fitted, samples, seed)
        kind = "fitted" if known.covariance.names else "known"
        origin = f"{kind} cable {known.model_hash[:16]} of {known.config}"
        return write_rods(to, Path(path), [first, *others], origin, segments, seed, driven)


class Given(NamedTuple):
    """A motion that is exported: times (T,) [s], what is held and moves, and what is held first."""

    t: FloatArray
    held: dict[str, Any]
    first: dict[str, Any]
    driven: Driven


def given_motion(
    cable: CableInMotion, motion: AnyMotion, step: float, held: Mapping[str, Any]
) -> Given:
    """Fixtures at steps of at most `step` [s], beside what is `held`.

    Raises as `ExportedCable.export`.
    """
    if isinstance(motion, str | PathLike):
        t, given = read_fixtures(cable.model.node, Path(motion))
    else:
        table = motion.table(_LEAST / motion.duration) if isinstance(motion, Move) else motion
        if not isinstance(table, Mapping) or "t" not in table:
            raise DloError(
                "motion: a table, the result of `move`, or arguments of `simulate` belong here."
                '\n  Try: {"t": t, "start": places}'
            )
        given = dict(table)
        t = given.pop("t")
    if twice := sorted(held.keys() & given.keys()):
        raise DloError(f"{twice[0]} is held, and moves.\n  Try: one of both")
    times = times_of(t)
    step = float(f"{min(step, (times[-1] - times[0]) / _LEAST):.3g}")
    pose, path = fixture_path(cable, times, {**held, **given})
    count = int(np.ceil((times[-1] - times[0]) / step - 1e-9))
    rows = path.declared(times[0] + step * np.arange(count + 1))[0]
    first = {
        key: x[0] if np.ndim(x) > np.ndim(getattr(pose, key)) else x for key, x in given.items()
    }
    driven = Driven.of(cable.model.node, step, rows)
    return Given(times, {**held, **given}, {**held, **first}, driven)
