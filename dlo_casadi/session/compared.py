"""The fits that the batch estimate is compared with: prior, stiffness alone, the paper's loop."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass

from dlo_casadi.config.options import EstimationOptions
from dlo_casadi.estimation.algorithm1 import applies, run_algorithm1
from dlo_casadi.estimation.observation import MeasuredPose
from dlo_casadi.estimation.stiffness import fit_stiffness
from dlo_casadi.model import CableModel
from dlo_casadi.session.declared import straight
from dlo_casadi.session.fitting import first_mesh
from dlo_casadi.session.outcome import Stage
from dlo_casadi.session.stages import algorithm1_stage, initial_stage, stiffness_stage


@dataclass(frozen=True)
class Compared:
    """Stages of simpler fits.

    Parameters
    ----------
    stages : sequence of Stage
    algorithm1_seconds : float [s]
        That the paper's loop took.
    """

    stages: tuple[Stage, ...]
    algorithm1_seconds: float


def simpler_fits(
    options: EstimationOptions, model: CableModel, measured: Sequence[MeasuredPose], n: int
) -> Compared:
    """Stages of the simpler fits on a mesh of n elements.

    Parameters
    ----------
    model : CableModel
        As declared; they are of the same cable, straight at rest, without its effects.
    """
    plain = straight(model).with_mesh(n)
    # One number of a model that is far off by itself: a coarse mesh finds it.
    coarse = plain.with_mesh(min(n, first_mesh(plain)))
    alone = fit_stiffness(coarse, measured)
    stages = initial_stage(plain, measured), stiffness_stage(plain, measured, alone)
    missing, result, seconds = _not_applicable(options, model, measured), None, 0.0
    if not missing:
        began = time.perf_counter()
        result = run_algorithm1(
            model.cable,
            [item for item in measured if item.readable and not item.held_out],
            model.gravity,
            n=options.algorithm1_n,
            inner=options.algorithm1_inner,
        )
        seconds = time.perf_counter() - began
    return Compared((*stages, algorithm1_stage(result, measured, plain, missing)), seconds)


def _not_applicable(
    options: EstimationOptions, model: CableModel, measured: Sequence[MeasuredPose]
) -> str:
    """Why the paper's loop does not run; empty if it does."""
    if not options.algorithm1:
        return "switched off"
    if not applies(model):
        return "the paper's loop needs a plane and two pinned ends"
    if any(sensor.marked for item in measured for sensor in item.sensors):
        return "the paper's loop needs lines along the cable, not single markers"
    return ""
