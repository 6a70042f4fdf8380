"""What a session of measurements has found: plain results, computed elsewhere."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any, Literal, cast

import numpy as np

from dlo_casadi.arrays import BoolArray, Brief, FloatArray
from dlo_casadi.cable.estimate import Estimate
from dlo_casadi.cable.limits import LimitCheck
from dlo_casadi.config import Config, Pose
from dlo_casadi.diagnosis.diagnose import Verdict
from dlo_casadi.diagnosis.found import Ranked
from dlo_casadi.diagnosis.if_hidden import IfHidden
from dlo_casadi.diagnosis.next_measurement import NextPose
from dlo_casadi.diagnosis.next_motion import NextMotion
from dlo_casadi.diagnosis.structure import Structure
from dlo_casadi.diagnosis.unknown_force import UnknownForce
from dlo_casadi.estimation.repeats import enough_poses, repeatability
from dlo_casadi.estimation.result import Fit
from dlo_casadi.io.points import MeasuredPoints
from dlo_casadi.rod.obstacles import Obstacle
from dlo_casadi.rod.quantities import QUANTITIES, Quantity, quantity_of
from dlo_casadi.runtime.work import Part
from dlo_casadi.sensing.pixels import ViewInput
from dlo_casadi.session.found_effects import FoundEffect
from dlo_casadi.session.in_motion import MotionStage
from dlo_casadi.session.measured_modes import MeasuredModes
from dlo_casadi.session.pose_shape import BranchShape, EitherSide, PoseShape

StageName = Literal["initial", "stiffness_only", "algorithm1", "batch", "closed"]
# Name of the cable's mass among a stage's parameters.
MASS = "mass"
STAGE_LABELS: dict[StageName, str] = {
    "initial": "initial guess",
    "stiffness_only": "stiffness alone",
    "algorithm1": "Algorithm 1",
    "batch": "declared model, fitted",
    "closed": "with added effects",
}
# Stages that a batch fit must not be worse than.
SIMPLER: tuple[StageName, ...] = ("initial", "stiffness_only")


@dataclass(frozen=True, repr=False)
class RestCurvatureEstimate(Brief):
    """Rest curvature along the cable: s (M,) [m], value and standard deviation [1/m].

    (M,) in a plane; (2, M) in space, about the material axes y and z. `determined`: where the
    measurements more than halve the variance that the prior alone leaves; elsewhere it is unknown.
    """

    s: FloatArray
    value: FloatArray
    std: FloatArray
    determined: BoolArray | None = None

    @property
    def known(self) -> tuple[FloatArray, FloatArray]:
        """Value and standard deviation, NaN where they are not determined."""
        kept = np.ones_like(self.value, bool) if self.determined is None else self.determined
        return np.where(kept, self.value, np.nan), np.where(kept, self.std, np.nan)


@dataclass(frozen=True)
class ReadingErrors:
    """RMS differences between measured and predicted readings of one role; None without readings.

    `force` [N], `moment` [N m].
    """

    force: float | None = None
    moment: float | None = None

    def of(self, quantity: Quantity) -> float | None:
        """That of one kind of reading."""
        return cast(float | None, getattr(self, quantity.name))


@dataclass(frozen=True, repr=False)
class Stage(Brief):
    """One stage of the fit.

    Parameters
    ----------
    name : StageName
    rmse_fit, rmse_held_out : float or None [m]
        Over all measured points of that role; None if there are none, or if a pose of that role
        has no prediction.
    chi2_per_dof : float or None
    parameters : dict of Estimate
    rest_curvature : RestCurvatureEstimate
    shapes : dict of PoseShape
        By pose name; poses without a prediction are absent.
    note : str
        Why the stage is empty or ended early, otherwise empty.
    rmse_fit_measured_branch, rmse_held_out_measured_branch : float or None [m]
        The same errors, except that poses measured in another stable equilibrium than the predicted
        one are compared with the one in which they were measured.
    unpredicted : tuple of str
        Measured held-out poses without a prediction.
    readings_fit, readings_held_out : ReadingErrors
        The same errors for forces and moments on the fixtures.
    explains : bool or None
        Whether the model explains the measurements; None where that was not judged. If it does not,
        its parameters have no intervals.
    surfaces : tuple of Obstacle
        All surfaces that the cable may touch, if the fit has them.
    motion : MotionStage or None
        The recorded motions by this model, if there are any.
    """

    name: StageName
    rmse_fit: float | None
    rmse_held_out: float | None
    chi2_per_dof: float | None
    parameters: dict[str, Estimate]
    rest_curvature: RestCurvatureEstimate
    shapes: dict[str, PoseShape]
    note: str = ""
    rmse_fit_measured_branch: float | None = None
    rmse_held_out_measured_branch: float | None = None
    unpredicted: tuple[str, ...] = ()
    readings_fit: ReadingErrors = ReadingErrors()
    readings_held_out: ReadingErrors = ReadingErrors()
    explains: bool | None = None
    surfaces: tuple[Obstacle, ...] = ()
    motion: MotionStage | None = None

    @property
    def label(self) -> str:
        """Its name in words."""
        return STAGE_LABELS[self.name]

    @property
    def other_branch(self) -> dict[str, BranchShape]:
        """Poses, by name, that were measured in another equilibrium than the predicted one."""
        return {name: found for name, x in self.shapes.items() if (found := x.measured_branch)}

    @property
    def measured_side(self) -> dict[str, BranchShape]:
        """Fit poses, by name, compared in another equilibrium than the predicted one."""
        return {name: found for name, x in self.shapes.items() if (found := x.measured_side)}


@dataclass(frozen=True, repr=False)
class PoseInput(Brief):
    """One pose as it was measured.

    Parameters
    ----------
    name : str
        File stem.
    role : "fit" or "held_out"
    points : (K, d) [m]
        Line or markers from start to end; empty if they could not be read.
    image : Path, optional
        The photograph.
    pixels : (K, 2), optional
        The points in the photograph.
    to_pixels : callable, optional
        Maps board metres (M, 2) to the photograph's pixels.
    problem : str
        Why the pose could not be read; empty if it was.
    center : (float, float), optional [m]
        Middle of the photograph in the board frame.
    camera_center : (float, float, float), optional [m]
        Place of a calibrated camera, see `HeldPose`.
    pixel : float, optional [m]
        Size of a pixel on the board.
    weight : (K,), optional
        Relative standard deviations of the points.
    coverage : float, optional
        Share of the cable that was seen; 0 to 1.
    confidence : float, optional
        Share of the line that was measured reliably; 0 to 1.
    markers : tuple of int, optional
        Numbers of the board's markers that were used.
    messages : tuple of str
        Remarks of the camera step.
    s : (K,), optional [m]
        Known arc lengths of markers.
    means : MeasuredPoints, optional
        Means of neighbouring points, for the fit, where more were measured than `points` holds.
    views : tuple of ViewInput
        Usable photographs of a cable in space; `points` is the line that they show together, empty
        where fewer than two agree.
    unseen : bool
        Whether it has readings of forces and moments alone, and no points.
    """

    name: str
    role: Literal["fit", "held_out"]
    points: FloatArray
    image: Path | None = None
    pixels: FloatArray | None = None
    to_pixels: Any = None
    problem: str = ""
    center: tuple[float, float] | None = None
    camera_center: tuple[float, float, float] | None = None
    pixel: float | None = None
    weight: FloatArray | None = None
    coverage: float | None = None
    confidence: float | None = None
    markers: tuple[int, ...] | None = None
    messages: tuple[str, ...] = ()
    s: FloatArray | None = None
    means: MeasuredPoints | None = None
    views: tuple[ViewInput, ...] = ()
    unseen: bool = False

    @classmethod
    def unread(cls, config: Config, pose: Pose | PoseInput, problem: str = "") -> PoseInput:
        """A pose of which nothing is known but why it could not be read."""
        nothing = np.zeros((0, len(config.experiment.gravity)))
        return cls(pose.name, pose.role, nothing, problem=problem)

    @property
    def readable(self) -> bool:
        """Whether there is anything to compare with."""
        return len(self.points) > 0 or len(self.views) > 0 or self.unseen


@dataclass(frozen=True)
class MeasurementSummary:
    """Quality of the measured centre-lines.

    Parameters
    ----------
    poses_fit, poses_held_out : int
        Poses with a measured line or readings.
    held_out_missing : tuple of str
        Held-out poses without either: no error includes them.
    points : int
    std, correlation_length : float [m]
        Of the noise of one coordinate of a point; the std is None without points.
    noise_distance : float or None [m]
        RMS distance of the points from the predicted shapes that is due to this noise alone.
    readings : int
        Number of forces and moments on the fixtures, held-out poses included.
    force_std, moment_std : float or None [N], [N m]
        Of one component; None where there is no such reading.
    """

    kind: Literal["images", "centerlines"]
    poses_fit: int
    poses_held_out: int
    points: int
    std: float | None
    std_source: Literal["declared", "estimated"]
    correlation_length: float
    noise_distance: float | None
    readings: int = 0
    force_std: float | None = None
    moment_std: float | None = None
    held_out_missing: tuple[str, ...] = ()

    def std_of(self, reading: str) -> tuple[float, str]:
        """Standard deviation of one component of a reading, by its name, and its unit."""
        quantity = quantity_of(reading)
        return getattr(self, quantity.std_key), quantity.unit

    @property
    def reading_noise(self) -> str:
        """Standard deviations of what was read, in words."""
        stds = ((getattr(self, x.std_key), x.unit) for x in QUANTITIES)
        return ", ".join(f"{std:.2g} {unit}" for std, unit in stds if std is not None)


@dataclass(frozen=True)
class HeldOut:
    """Number of declared held-out poses that a stage has predicted, and names of the others."""

    predicted: int
    declared: int
    missing: tuple[str, ...]


@dataclass(frozen=True)
class Repeatability:
    """How well the cable returns to the same shape.

    Parameters
    ----------
    expected_spread : float [m]
        RMS distance at the measured points. If the source is "poses", of two repeats of a pose,
        without noise; if it is "repeats", of each repeat from the mean of the others, noise
        included.
    source : "repeats", "poses" or None
        "repeats": repeats of few poses, see `with_repeats`. "poses": the scatter between poses that
        nothing common to all of them explains. None: it could not be estimated.
    """

    expected_spread: float
    source: Literal["repeats", "poses"] | None


@dataclass(frozen=True)
class Outcome:
    """Everything that a run has found. `report/` turns it into files and figures.

    Parameters
    ----------
    verdict : Verdict or None
        None where no diagnosis was made, so that nothing is claimed.
    doubts : tuple of str
        Why the last stage's numbers are unreliable, see `doubts_of`; with doubts no verdict is
        `complete` or `effect_found`.
    serious : tuple of str
        Those of the warnings that question the session itself: likely mistakes, poses far off.
    effects : tuple of FoundEffect
        Effects added to the declared model.
    candidates : tuple of Ranked
        All effects that were tried, the likely ones first.
    unexplained : UnknownForce or None
        Fitted load that assumes no cause.
    next_pose : NextPose or None
        The pose that best separates rival explanations.
    next_motion : NextMotion or None
        The motion that does, if the session has none.
    structure : (Structure, Structure) or None
        Tests of the residual before and after.
    cross_validated : float or None [m]
        Cross-validated error of the declared model, if nothing was added and all are predicted.
    mesh_error : float [m]
        Largest error of a shape due to the mesh of the last fit, from two meshes.
    fit : Fit
        The last stage's fit, from which parameters.yaml is written.
    if_hidden : dict
        By stiffness, what one effect that the data do not exclude could do to it.
    limits : tuple of LimitCheck
        Of all predicted poses, where the session declares limits.
    cut_off : bool
        Whether the diagnosis has met the bound on its work before everything was tried.
    as_likely : tuple of str
        If no effect was added: those that explain what was measured as well.
    motion_scores : dict
        Score of each effect that only motion shows, see `search_in_motion`.
    modes : MeasuredModes, optional
        Small motions at the end of a recording, if there are recordings.
    work : Part
        What the parts of the run took, in steps and seconds.
    """

    config: Config
    poses: tuple[PoseInput, ...]
    measurement: MeasurementSummary
    stages: tuple[Stage, ...]
    mesh_error: float
    timing: dict[str, float]
    fit: Fit
    verdict: Verdict | None = None
    doubts: tuple[str, ...] = ()
    warnings: tuple[str, ...] = ()
    serious: tuple[str, ...] = ()
    effects: tuple[FoundEffect, ...] = ()
    candidates: tuple[Ranked, ...] = ()
    unexplained: UnknownForce | None = None
    next_pose: NextPose | None = None
    next_motion: NextMotion | None = None
    structure: tuple[Structure, Structure] | None = None
    cross_validated: float | None = None
    if_hidden: Mapping[str, IfHidden] = field(default_factory=dict)
    limits: tuple[LimitCheck, ...] = ()
    versions: dict[str, str] = field(default_factory=dict)
    cut_off: bool = False
    as_likely: tuple[str, ...] = ()
    motion_scores: Mapping[str, float] = field(default_factory=dict)
    modes: MeasuredModes | None = None
    work: Part = field(default_factory=Part)

    @cached_property
    def repeatability(self) -> Repeatability:
        """How well the cable returns to the same shape."""
        history, model = self.fit.problem.history, self.fit.model
        if enough_poses(history, model):
            return Repeatability(float(np.sqrt(2) * self.fit.repeat_error), "poses")
        spread = repeatability(history, model)
        return Repeatability(spread or 0.0, None if spread is None else "repeats")

    def stage(self, name: StageName) -> Stage | None:
        """Return the stage of that name, or None."""
        return next((stage for stage in self.stages if stage.name == name), None)

    @property
    def inside_band(self) -> float | None:
        """Share of held-out points inside the last stage's 90 % band, which includes their noise.

        None without held-out points.
        """
        stage, inside = self.stages[-1], []
        noise = self.fit.noise.of_points.beside_repeats
        for pose in self.poses:
            shape = stage.shapes.get(pose.name)
            if pose.role == "fit" or not len(pose.points) or shape is None or shape.spread is None:
                continue
            inside.append(shape.inside_band(self.fit.model.cable.length, noise))
        return float(np.concatenate(inside).mean()) if inside else None

    @property
    def either_side(self) -> dict[str, EitherSide]:
        """Held-out poses, by name, whose side must be reported, as the last stage predicts them."""
        shapes = self.stages[-1].shapes.items()
        return {name: found for name, x in shapes if (found := x.either_side) and found.told}

    def held_out(self, stage: Stage) -> HeldOut:
        """Number of declared held-out poses that a stage has predicted."""
        measurement = self.measurement
        missing = (*measurement.held_out_missing, *stage.unpredicted)
        declared = measurement.poses_held_out + len(measurement.held_out_missing)
        return HeldOut(declared - len(missing), declared, missing)
