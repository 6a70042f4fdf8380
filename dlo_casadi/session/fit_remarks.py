"""What a fit cannot promise: a remark is a row, its sentence and what fills it."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from dlo_casadi.diagnosis.structure import alike, limiting_spread
from dlo_casadi.errors import worded
from dlo_casadi.estimation.fit import allowed_mesh_error
from dlo_casadi.estimation.prediction import noise_distance
from dlo_casadi.estimation.result import Fit
from dlo_casadi.model.pose_scatter import PoseScatter
from dlo_casadi.rod.quantities import QUANTITIES
from dlo_casadi.session.outcome import PoseInput
from dlo_casadi.session.outliers import outliers_of
from dlo_casadi.session.sentences import Sentence, Values, said_of
from dlo_casadi.thresholds import BEYOND_CHANCE, DIFFERENT, FIXTURES


@dataclass(frozen=True)
class Judged:
    """A fit, and what its remarks need beside it.

    Parameters
    ----------
    mesh_error : float [m]
    declared : float, optional [m]
        Noise of the points.
    poses : sequence of PoseInput
        As they were measured, those in which outliers are sought.
    """

    fit: Fit
    mesh_error: float
    declared: float | None = None
    poses: Sequence[PoseInput] = ()

    @cached_property
    def floor(self) -> float:
        """Distance [m] of points from their prediction by noise alone."""
        return noise_distance(self.fit.problem.history, self.fit.noise.std)

    @cached_property
    def spread(self) -> float | None:
        """Distance [m] of repeats of a pose from their mean, where it limits predictions."""
        return limiting_spread(self.fit)

    @property
    def scatter(self) -> PoseScatter:
        """What differs from pose to pose."""
        return self.fit.problem.priors.pose_scatter


def fit_warnings(
    fit: Fit, error: float, declared: float | None = None, poses: Sequence[PoseInput] = ()
) -> list[str]:
    """What `REMARKS` say of a fit; parameters as of `Judged`."""
    return said_of(Judged(fit, error, declared, poses), REMARKS)


# ---- noise and repeats --------------------------------------------------------------------------


def _noisier(x: Judged) -> Iterator[Values]:
    points = x.fit.noise.of_points
    if x.declared is not None and points.source == "estimated":
        cure = f"Try: std: {points.std:.2g}, or no std"
        if x.poses and (outliers := outliers_of(x.fit, x.poses)).names:
            cure = f"There are {outliers}. Try: estimation: {{robust: true}}"
        yield {"declared": x.declared, "std": points.std, "cure": cure}


def _repeats(x: Judged) -> Iterator[Values]:
    if x.spread is None:
        return
    noise = x.fit.noise
    beside = "noise alone gives {floor:mm.2g}, and intervals from this session are too narrow"
    if noise.source == "repeats":
        beside = (
            "which counts as noise of {std:mm.2g}, correlated over {length:mm.2g} of cable, in "
            "place of measurement.std. It would not with {different} poses or more that differ, "
            "or with a declared rest_curvature_drift if the cable takes a set"
        )
    values = {"floor": x.floor, "std": noise.std, "length": noise.length, "different": DIFFERENT}
    yield {"spread": x.spread, "beside": worded(beside, **values)}


def _misfit(x: Judged) -> Iterator[Values]:
    if x.fit.noise.source == "misfit":
        read = any(item.reactions for item in x.fit.problem.measured)
        yield {"what": "points or readings" if read else "points", "std": x.fit.noise.std}


def _no_return(x: Judged) -> Iterator[Values]:
    if x.scatter.std > 0 and x.scatter.shown:
        two = np.sqrt(2)
        apart, floor = two * x.fit.repeat_error, two * x.floor
        yield {"apart": apart, "floor": floor, "own": _own(x.scatter, x.fit)}


def _unknown_return(x: Judged) -> Iterator[Values]:
    if x.scatter.std > 0 and not x.scatter.shown:
        yield {"own": _own(x.scatter, x.fit)}


def _alike(x: Judged) -> Iterator[Values]:
    if x.spread is not None or x.scatter.std > 0:
        yield from ({"group": group} for group in alike(x.fit))


def _own(scatter: PoseScatter, fit: Fit) -> str:
    """What differs from pose to pose, with its size, and what cannot be distinguished from it."""
    each = []
    for one in (scatter, *scatter.rivals):
        std, unit = one.size(fit.model, float(fit.p[0]))
        each.append(f"{one.words} of {std:.2g} {unit}")
    return " or ".join(each)


# ---- declared values ----------------------------------------------------------------------------


def _loose_fixtures(x: Judged) -> Iterator[Values]:
    fit = x.fit
    # Where ends differ at random beyond the tolerances, another remark has told by how much.
    random = fit.problem.random_std[fit.problem.fixture_std > 0].any()
    if len(fit.problem.used) > 1 and fit.fixture_error > FIXTURES * x.floor and not random:
        apart = float(np.hypot(fit.fixture_error, x.floor))
        yield {"scatter": _fixture_scatter(fit), "apart": apart, "floor": x.floor}


def _fixture_scatter(fit: Fit) -> list[str]:
    """Standard deviations of the fixtures' places about the declared ones."""
    scatter = dict(zip(fit.model.deviation_names, fit.problem.priors.scatter, strict=True))
    # All components of a position, or of a rotation, share one scatter.
    place, turn = fit.model.node.axes[0], fit.model.node.turns[0]
    parts = {
        f"end_{place}": "{std:mm.2g} at the end",
        f"start_{turn}": "{std:.2g} rad at the start clamp",
        f"end_{turn}": "{std:.2g} rad at the end clamp",
        f"clip_0_{place}": "{std:mm.2g} at the clips",
    }
    return [worded(parts[x], std=scatter[x]) for x in fit.model.deviations if x in parts]


def _beyond_tolerances(x: Judged) -> Iterator[Values]:
    """Declared values that the fit has moved by many of their tolerances."""
    fit = x.fit
    hidden = tuple(f"{effect.label}." for effect in fit.model.effects if not effect.shown)
    for q in fit.model.parameters:
        tolerance = fit.model.priors.get(q.name)
        of_sensor = q.unit in {own.unit for own in QUANTITIES}  # its bias tells of wrong readings
        if tolerance is None or (q.name.startswith(hidden) and not of_sensor):
            continue
        moved = fit.value(q.name) - q.nominal
        if abs(moved) > BEYOND_CHANCE * tolerance:
            times = abs(moved) / tolerance
            unit = f" {q.unit}".rstrip()
            yield {
                "name": q.name,
                "moved": moved,
                "unit": unit,
                "times": times,
                "tolerance": tolerance,
            }


# ---- the solution -------------------------------------------------------------------------------


def _slow(x: Judged) -> Iterator[Values]:
    if not x.fit.converged and not x.fit.failed:
        yield {}


def _unstable(x: Judged) -> Iterator[Values]:
    pairs = zip(x.fit.problem.measured, x.fit.stable, strict=True)
    if names := [item.pose.name for item, ok in pairs if item.readable and not ok]:
        yield {"names": names}


def _no_finer_mesh(x: Judged) -> Iterator[Values]:
    if not np.isfinite(x.mesh_error):
        yield {"n": x.fit.model.n}


def _coarse_mesh(x: Judged) -> Iterator[Values]:
    allowed = allowed_mesh_error(x.fit)
    if np.isfinite(x.mesh_error) and x.mesh_error > allowed:
        yield {"n": x.fit.model.n, "off": x.mesh_error, "allowed": allowed}


REMARKS: tuple[Sentence[Judged], ...] = (
    Sentence(
        "the points scatter more about any shape that a cable could take than measurement.std "
        "declares, {declared:mm.2g}: their noise is estimated instead, {std:mm.2g}. {cure}",
        _noisier,
    ),
    Sentence(
        "the same pose repeats only within {spread:mm.2g} (each from the mean of the others), "
        "{beside}: repeatability limits any prediction",
        _repeats,
    ),
    Sentence(
        "the model misses the {what} by far more than their noise: the fit weighs the points as if "
        "that were {std:mm.2g}",
        _misfit,
    ),
    Sentence(
        "the cable does not come back to the same shape: two repeats of a pose would differ by "
        "{apart:mm.2g} RMS beyond the noise ({floor:mm.2g}), as if each had {own}. A model "
        "predicts their mean",
        _no_return,
    ),
    Sentence(
        "poses have too few points to tell whether the cable comes back to the same shape: "
        "intervals and bands include {own}",
        _unknown_return,
    ),
    Sentence("cannot be told apart in this session: {group}", _alike),
    Sentence(
        "fixtures may vary from pose to pose by about {scatter}, as far as tolerances and data "
        "tell: a new pose is then measured {apart:mm.2g} from its prediction, however good the "
        "model ({floor:mm.2g} by noise alone). Try: measure the ends in each pose, or smaller "
        "tolerances if they are known better",
        _loose_fixtures,
    ),
    Sentence(
        "{name} is {moved:.3g}{unit} from its declared value, {times:.0f} times its tolerance of "
        "{tolerance:g}{unit}: other parameters may be wrong, too. Try: measure it again, or "
        "declare a larger tolerance",
        _beyond_tolerances,
    ),
    Sentence("the fit is slow: it stopped within a standard deviation of its minimum", _slow),
    Sentence("not a stable equilibrium at the fitted parameters: {names}", _unstable),
    Sentence(
        "the fitted shapes cannot be followed to a mesh finer than {n:# element}: some pose is "
        "close to losing its stability",
        _no_finer_mesh,
    ),
    Sentence(
        "the mesh of {n:# element} is off by {off:mm}, more than the {allowed:mm.2g} that noise or "
        "misfit hide: model.n larger?",
        _coarse_mesh,
    ),
)
