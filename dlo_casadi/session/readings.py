"""Find mistakes in readings of forces and moments, by comparing them with what shapes need.

Shapes determine forces only as far as something of known size acts: weight fixes the stiffness.
Whatever it does not fix is free here: without weight any common scale, and between clamps the
moment of a constant rest curvature. Only what all such cables have in common is judged.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.spatial.transform import Rotation

from dlo_casadi.arrays import FloatArray
from dlo_casadi.config import Config
from dlo_casadi.equilibrium.pose import HeldPose
from dlo_casadi.estimation.prediction import predict_each
from dlo_casadi.estimation.result import Fit
from dlo_casadi.model.cable_model import CableModel
from dlo_casadi.rod.ends import reaction_rows
from dlo_casadi.rod.supports import SupportKind
from dlo_casadi.session.coarse_fit import MESH, POSES, coarse_fit
from dlo_casadi.session.fitting import declared_model, straight
from dlo_casadi.session.hypotheses import (
    NEAR_AXES,
    Hypothesis,
    ReadSession,
    Suspicion,
    clamp_axes,
    exchanges,
    likeliest,
    listed,
    read_as,
    spread,
)
from dlo_casadi.thresholds import (
    FITTED_READINGS,
    MISREAD,
    MUCH_BETTER,
    READ_ALONE,
    READ_OTHERWISE,
    READ_SCALE,
    TURNED,
    UNEXPLAINED,
    UNSEEN,
)

_UNLIKE = (
    "{} is {:.0%} off what the shapes need, and no other way to read it is near. Try: the fixture, "
    "axes and sign of its sensor. A large effect that the model lacks could look the same."
)
# Decades about the first guess of the stiffness at which readings without shapes are predicted; a
# cable's forces between two of them are taken as linear in the stiffness.
DECADES = np.linspace(-3.0, 3.0, 13)
# Possible units of sensor readings, relative to newtons and newton metres.
_UNITS: Mapping[str, Mapping[str, float]] = {
    "force": {"grams-force": 101.97, "kilograms-force": 0.10197, "millinewtons": 1e3},
    "moment": {"N mm": 1e3, "N cm": 1e2, "kgf cm": 10.197},
}


def wrong_readings(session: ReadSession) -> tuple[Suspicion, ...]:
    """Readings compared with the forces that the shapes need, by a coarse fit of some poses."""
    fitted = [item for item in session.read if item.role == "fit" and not item.views]
    fitted = [item for item in fitted if session.declared[item.name].readings]
    shown = [fitted[k] for k in spread(len(fitted), POSES)]
    if not shown:
        return ()
    found = coarse_fit(replace(session, read=tuple(shown)))
    fit = found.fit
    if fit is None:
        return ()
    if any(fit.model.gravity) and not found.sized:
        # The shapes leave open how much of the forces is weight: as if there were no shapes.
        return wrong_without_shapes(session.config, [item.name for item in shown])
    felt = fit.problem.equilibria.readings(*fit.problem.state(fit.point))
    uncertain = _by_unknowns(fit)
    rows = reaction_rows(fit.model.node, len(fit.model.clips))
    measurement, known = session.config.experiment.measurement, session.config.experiment.tolerances
    stds = {
        "force": np.hypot(measurement.force_std or 0.0, known.force_bias),
        "moment": np.hypot(measurement.moment_std or 0.0, known.moment_bias),
    }
    compared = []
    for name, at in rows.items():
        side, _, kind = name.rpartition("_")
        poses = [session.declared[item.name] for item in shown]
        own = [k for k, pose in enumerate(poses) if name in pose.readings]
        if not own:
            continue
        held = getattr(fit.model, side, SupportKind.FREE).direction
        forces = felt[own, rows[f"{side}_force"]]
        compared.append(
            ComparedReading(
                name,
                np.array([poses[k].readings[name] for k in own]),
                felt[own, at],
                np.array([clamp_axes(poses[k], side) for k in own]) if held else None,
                forces if kind == "moment" else None,
                float(stds[kind]),
                uncertain[own, at],
            )
        )
    explained = found.rms <= UNEXPLAINED * session.config.cable.length
    return misread(compared, sized=found.sized, explained=explained)


def wrong_without_shapes(config: Config, names: Sequence[str]) -> tuple[Suspicion, ...]:
    """Readings of poses that nothing else shows, compared with a straight cable of any stiffness.

    Forces where there are any, else moments. Rest curvature is unknown: only readings that differ
    by half their size or more are doubted, and only where another way to read them is near.
    """
    poses = [pose for pose in config.experiment.poses if pose.name in names and pose.role == "fit"]
    shown = [poses[k] for k in spread(len(poses), POSES)]
    model = straight(declared_model(config, known=True).model).with_mesh(MESH)
    felt = _of_any_stiffness(model, [pose.held for pose in shown])
    rows = reaction_rows(model.node, len(model.clips))
    read = [name for name in rows if any(name in pose.readings for pose in shown)]
    forces = [name for name in read if name.endswith("force")]
    parts: list[tuple[str, FloatArray, FloatArray, FloatArray | None]] = []
    for name in forces or read:
        own = [k for k, pose in enumerate(shown) if name in pose.readings]
        side = name.rpartition("_")[0]
        axes = [clamp_axes(shown[k], side) for k in own]
        held = getattr(model, side, SupportKind.FREE).direction
        measured = np.array([np.atleast_1d(shown[k].readings[name]) for k in own])
        frames = np.array(axes) if held and measured.shape[1] > 1 else None
        parts.append((name, measured, felt[:, own, rows[name]], frames))
    if not len(felt) or not parts:
        return ()
    sizes = [float(np.sqrt(np.mean(measured**2))) or 1.0 for _, measured, _, _ in parts]

    def misfit(changed: Sequence[FloatArray]) -> float:
        """Distance of readings from the nearest stiffness, relative to their size as declared."""
        y = np.concatenate([x.ravel() / size for x, size in zip(changed, sizes, strict=True)])
        every = [
            x.reshape((len(x), -1)) / size for (_, _, x, _), size in zip(parts, sizes, strict=True)
        ]
        path = np.concatenate(every, axis=1)
        if not any(model.gravity):
            path = np.concatenate([np.zeros_like(path), 1e6 * path])
        steps = np.diff(path, axis=0)
        along = ((y - path[:-1]) * steps).sum(axis=1) / np.maximum((steps**2).sum(axis=1), 1e-300)
        near = path[:-1] + np.clip(along, 0.0, 1.0)[:, None] * steps
        return float(np.linalg.norm(y - near, axis=1).min() / max(np.linalg.norm(y), 1e-300))

    given = [measured for _, measured, _, _ in parts]
    off = misfit(given)
    if off < READ_ALONE:
        return ()
    said = " and ".join(name for name, *_ in parts)
    meant = likeliest(_ways_to_read(parts), misfit, MUCH_BETTER * off)
    if meant is None:
        return ()
    (text, _, certain), left = meant
    what = f"{said}: {off:.0%} off what a straight cable of any stiffness gives, but {left:.0%} "
    return (Suspicion(what + text, certain),)


def _ways_to_read(
    parts: Sequence[tuple[str, FloatArray, FloatArray, FloatArray | None]],
) -> Iterator[Hypothesis[Sequence[FloatArray]]]:
    """Other interpretations of the readings of one kind, the likely ones first."""
    given = [measured for _, measured, _, _ in parts]
    turned = "with the other sign. Try: what the cable does to the fixture, not the fixture to it."
    yield Hypothesis(turned, [-x for x in given])
    kind = parts[0][0].split("_")[-1]
    for unit, size in _UNITS[kind].items():
        text = f"once they are taken as {unit}. Try: divide by {size:g}."
        yield Hypothesis(text, [x / size for x in given])
    clamped = [(frames, x) for _, x, _, frames in parts if frames is not None]
    if len(clamped) == len(parts):
        world = [(frames @ x[..., None])[..., 0] for frames, x in clamped]
        text = "once turned from the clamp's axes into the world's"
        yield Hypothesis(f"{text}. Try: world axes, R f with the clamp's frame R.", world)
        minus = f"{text}, with the other sign. Try: -R f, with the clamp's frame R."
        yield Hypothesis(minus, [-x for x in world])


def _of_any_stiffness(model: CableModel, poses: Sequence[HeldPose]) -> FloatArray:
    """Readings (k, m, n_reactions) of poses at k stiffnesses, in rising order.

    Without gravity one stiffness; stiffnesses at which a pose has no equilibrium are left out.
    """
    decades = DECADES if any(model.gravity) else (0.0,)
    felt = []
    for decade in decades:
        p = model.nominal.copy()
        p[model.stiffness_indices] *= 10.0**decade
        found = predict_each(model, p, np.zeros(model.chain.n_rests), poses)
        felt += [[x.seen.readings for x in found if x is not None]] * all(
            x is not None for x in found
        )
    return np.array(felt)


def _by_unknowns(fit: Fit) -> FloatArray:
    """Change (m, n_reactions, q) of all readings by what the shapes leave uncertain.

    One column for each principal direction of the covariance of the unknowns: one standard
    deviation.
    """
    problem, size = fit.problem, fit.problem.unknowns.size
    here = problem.equilibria.at(*problem.state(fit.point))
    along = here.readings_along(fit.linearization.shapes)[..., :size]
    values, vectors = np.linalg.eigh(fit.marginal_covariance)
    return np.asarray(along @ (vectors * np.sqrt(np.maximum(values, 0.0))))


@dataclass(frozen=True)
class ComparedReading:
    """One kind of reading on one side of the cable, of m poses.

    Parameters
    ----------
    name : str
        As in a configuration, such as end_force.
    measured, model : (m, c) [N] or [N m]
        Readings, and the values that the shapes need; known only up to the mass.
    frames : (m, d, d) or None
        Axes of the clamp in the world, as columns; None at a pin.
    forces : (m, d) or None [N]
        Only for moments: the model's forces on the same side.
    std : float [N] or [N m]
        Of one component: noise and a constant offset, as far as they are declared.
    uncertain : (m, c, q) or None
        Changes of `model` by one standard deviation of what the shapes leave uncertain.
    """

    name: str
    measured: FloatArray
    model: FloatArray
    frames: FloatArray | None = None
    forces: FloatArray | None = None
    std: float = 0.0
    uncertain: FloatArray | None = None

    @property
    def noise(self) -> float:
        """Noise of the readings relative to their size."""
        size = np.sqrt(np.mean(self.measured**2))
        return self.std / max(float(size), 1e-300)

    @cached_property
    def _free(self) -> FloatArray:
        """Directions (m c, k), orthonormal, in which the shapes hardly determine the readings.

        Across the model itself, whose scale is always free; those of more than MISREAD of its size.
        """
        model = self.model.ravel()
        if self.uncertain is None or not model.any():
            return np.zeros((len(model), 0))
        along, size = model / np.linalg.norm(model), np.linalg.norm(model)
        ways = self.uncertain.reshape((len(model), -1))
        ways = ways - np.outer(along, along @ ways)
        left, values, _ = np.linalg.svd(ways, full_matrices=False)
        return np.asarray(left[:, values > MISREAD * size])

    def judged(self, readings: FloatArray) -> FloatArray:
        """The part (m c, ...) of readings (m, c, ...) that the shapes determine up to a scale."""
        rows = readings.reshape((self.model.size, *readings.shape[2:]))
        return np.asarray(rows - self._free @ (self._free.T @ rows))

    @property
    def judgeable(self) -> bool:
        """Whether anything is left to judge: three numbers, more of model and readings than doubts.

        Readings that lie where the shapes hardly determine them fit with a scale of zero.
        """
        enough = self.model.size - self._free.shape[1] >= 3
        return enough and all(
            np.linalg.norm(self.judged(x)) > MISREAD * np.linalg.norm(x)
            for x in (self.model, self.measured)
        )

    def misfit(self, measured: FloatArray) -> float:
        """Distance from the nearest multiple of the model, relative to the size of the readings."""
        rows, model = self.judged(measured), self.judged(self.model)
        along = max(float(rows @ model), 0.0) / max(float(np.linalg.norm(model)), 1e-300)
        left = max(float(rows @ rows) - along**2, 0.0)
        return float(np.sqrt(left) / max(float(np.linalg.norm(measured)), 1e-300))

    def scale(self, measured: FloatArray) -> float:
        """Multiple of the model that is nearest to readings."""
        rows, model = self.judged(measured), self.judged(self.model)
        return float(rows @ model / (model @ model))


def misread(
    readings: Sequence[ComparedReading], *, sized: bool = True, explained: bool = True
) -> tuple[Suspicion, ...]:
    """Readings that were taken in another way than declared: the likeliest way for each.

    `sized`: whether the shapes determine stiffness over weight; if not, readings are known up to a
    common factor, and only their ratios are checked. `explained`: whether the model comes close to
    the shapes; if not, readings that no mistake explains are not doubted.
    """
    found, scales = [], {}
    for one in readings:
        if not one.judgeable:
            continue
        own, rows = one.misfit(one.measured), one.measured
        if MISREAD < own < UNSEEN * one.noise:
            continue
        if own > MISREAD:
            # A general rotation or lever arm fits at least as well as its special cases.
            meant = likeliest(_otherwise(one), one.misfit, MUCH_BETTER * own, READ_OTHERWISE)
            if meant is None:
                doubted = explained and own > TURNED
                found += [Suspicion(_UNLIKE.format(one.name, own), False)] * doubted
                continue
            (said, rows, certain), left = meant
            text = f"{one.name} is {own:.0%} off what the shapes need, but {left:.0%} {said}"
            found.append(Suspicion(text, certain))
        scales[one.name] = one.scale(rows)
    forces = {name: scale for name, scale in scales.items() if name.endswith("force")}
    if not sized:  # only what all readings have in common is unknown
        first = next(iter(forces or scales), "")
        for name in [name for name in scales if name != first]:
            found += _other_unit(name, scales[name] / scales[first], first, told=True)
        return tuple(found)
    # Forces in a known other unit count in newtons.
    newtons = [x / _UNITS["force"].get(_unit_of(name, x), 1.0) for name, x in forces.items()]
    for name, scale in scales.items():
        if name.endswith("moment") and newtons:
            found += _other_unit(name, scale / float(np.median(newtons)), "forces")
        else:
            found += _other_unit(name, scale, "mass")
    return tuple(found)


def _otherwise(one: ComparedReading) -> Iterator[Hypothesis[FloatArray]]:
    """Other interpretations of the readings, the likely ones first."""
    a, (count, size) = one.measured, one.measured.shape
    turned = "with the other sign. Try: what the cable does to the fixture, not the fixture to it."
    yield Hypothesis(turned, -a)
    if one.frames is not None and size > 1:
        world = np.einsum("mij,mj->mi", one.frames, a)
        text = "once turned from the clamp's axes into the world's"
        yield Hypothesis(
            f"{text}. Try: world axes, R f with the clamp's frame R of each pose.", world
        )
        yield Hypothesis(
            f"{text}, with the other sign. Try: -R f, with the clamp's frame R.", -world
        )
    # Forces of few poses are nearly parallel: a fitted rotation or lever arm explains any error.
    if count < FITTED_READINGS:
        return
    # The hypothesis must also halve the misfit caused by effects: a real effect leaves no doubt.
    yield from (way for way in _fitted(one) if one.misfit(way.meant) < MISREAD)


def _fitted(one: ComparedReading) -> Iterator[Hypothesis[FloatArray]]:
    """Interpretations with parameters that are fitted to what the shapes need."""
    a, size = one.measured, one.measured.shape[1]
    if one.forces is not None:
        yield from _about_elsewhere(one, one.forces)
    if size > 1:
        for axes in exchanges(size)[1:]:
            text = f"once read as ({read_as(axes)}). Try: the axes of start and end."
            if not np.array_equal(axes, -np.eye(size)):  # the other sign
                yield Hypothesis(text, a @ axes.T, one.misfit(a) > TURNED)
        u, _, v = np.linalg.svd(a.T @ one.model)
        hand = np.diag([*np.ones(size - 1), np.sign(np.linalg.det(u @ v))])
        turn, whole = (u @ hand @ v).T, np.eye(3)
        if min(np.linalg.norm(turn - axes) for axes in exchanges(size)[1:]) < NEAR_AXES:
            return
        whole[:size, :size] = turn
        vector = Rotation.from_matrix(whole).as_rotvec()
        angle = np.degrees(np.linalg.norm(vector) if size > 2 else vector[2])
        text = f"once all are turned by {angle:.0f} degrees. Try: the axes of start and end."
        yield Hypothesis(text, a @ turn.T, one.misfit(a) > TURNED)


def _about_elsewhere(one: ComparedReading, forces: FloatArray) -> Iterator[Hypothesis[FloatArray]]:
    """Moments about a point fixed to the clamp, by least squares: M + (fixture - point) x F.

    Point and scale are found together: the equations are linear in both.
    """
    m, d = forces.shape
    frames = np.broadcast_to(np.eye(d), (m, d, d)) if one.frames is None else one.frames
    # Cross products; in a plane only the component normal to it.
    space = [np.pad(x, ((0, 0), (0, 3 - d))) for x in (*np.moveaxis(frames, 2, 0), forces)]
    arms = np.stack([np.cross(axis, space[-1])[:, -one.model.shape[1] :] for axis in space[:d]], 2)
    columns = one.judged(np.concatenate([one.model[..., None], arms], axis=2))
    scale, *arm = np.linalg.lstsq(columns, one.judged(one.measured), rcond=None)[0]
    if scale <= 0:
        return
    told = listed(-1e3 * np.array(arm) / scale, ".3g")
    axes = "of the clamp" if one.frames is not None else "of gravity's frame"
    yield Hypothesis(
        f"once taken about a point ({told}) mm from the fixture along the axes {axes}, where the "
        "sensor may be. Try: moments about the fixture, M + (sensor - fixture) x F.",
        one.measured - arms @ np.array(arm),
    )


def _unit_of(name: str, scale: float) -> str:
    """The unit that a scale of readings is near; empty if there is none."""
    units = _UNITS[name.split("_")[-1]]
    unit = min(units, key=lambda one: abs(np.log(scale / units[one])))
    return unit if 0.5 < scale / units[unit] < 2.0 else ""


def _other_unit(name: str, scale: float, beside: str, *, told: bool = False) -> Iterator[Suspicion]:
    """A scale of readings that no mass explains; of moments beside the forces, if there are any.

    `told`: `beside` is a reading, whose unit may as well be the wrong one.
    """
    if 1 / READ_SCALE < scale < READ_SCALE:
        return
    cures, pairs = [], [("", name, scale), (f"{beside} ", beside, 1 / scale)]
    for whose, one, factor in pairs[: 1 + told]:
        if unit := _unit_of(one, factor):
            size = _UNITS[one.split("_")[-1]][unit]
            cures.append(f"{whose}in {unit}? Try: divide {whose}by {size:g}.")
    cure = f": {' Or '.join(cures)}" if cures else ". Try: N and N m."
    text = f"{name} is {scale:.3g} times what shapes and {beside} need{cure}"
    yield Suspicion(text, bool(cures))
