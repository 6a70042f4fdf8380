"""Find mistakes in readings of forces and moments, by comparing them with what shapes need.

Shapes determine forces only as far as something of known size acts: weight fixes the stiffness.
Whatever it does not fix is free here: without weight any common scale, and between clamps the
moment of a constant rest curvature. Only what all such cables have in common is judged.
"""

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from dlo_casadi.arrays import FloatArray
from dlo_casadi.config import Config, Pose
from dlo_casadi.effects.mass_error import HEAVIEST
from dlo_casadi.equilibrium.pose import HeldPose
from dlo_casadi.estimation.prediction import predict_each
from dlo_casadi.estimation.result import Fit
from dlo_casadi.model.cable_model import CableModel
from dlo_casadi.rod.ends import reaction_rows
from dlo_casadi.rod.quantities import FORCE, quantity_of
from dlo_casadi.rod.supports import SupportKind
from dlo_casadi.session.axes import clamp_axes
from dlo_casadi.session.coarse_fit import MESH, POSES, coarse_fit
from dlo_casadi.session.compared_readings import ComparedReading, ReadAlone, Readings
from dlo_casadi.session.fitting import declared_model, straight
from dlo_casadi.session.mistakes import READINGS, READINGS_ALONE
from dlo_casadi.session.questions import Alternatives, Suspicion
from dlo_casadi.session.read_session import ReadSession, spread
from dlo_casadi.thresholds import (
    MISREAD,
    MUCH_BETTER,
    READ_OTHERWISE,
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
    compared, poses = [], [session.declared[item.name] for item in shown]
    for name, at in rows.items():
        own = [k for k, item in enumerate(poses) if name in item.readings]
        if not own:
            continue
        side, quantity = name.rpartition("_")[0], quantity_of(name)
        noise = getattr(measurement, quantity.std_key) or 0.0
        compared.append(
            ComparedReading(
                name,
                np.array([poses[k].readings[name] for k in own]),
                felt[own, at],
                felt[own, rows[f"{side}_force"]] if quantity.turning else None,
                float(np.hypot(noise, getattr(known, quantity.bias_key))),
                uncertain[own, at],
                frames=_frames(fit.model, [poses[k] for k in own], name),
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
    names = [name for name in read if not quantity_of(name).turning] or read
    if not len(felt) or not names:
        return ()
    own = {name: [k for k, pose in enumerate(shown) if name in pose.readings] for name in names}
    parts = []
    for name in names:
        measured = np.array([np.atleast_1d(shown[k].readings[name]) for k in own[name]])
        size = float(np.sqrt(np.mean(measured**2))) or 1.0
        frames = _frames(model, [shown[k] for k in own[name]], name)
        parts.append(ReadAlone(name, measured, felt[:, own[name], rows[name]], size, frames=frames))
    readings = Readings(tuple(parts), weightless=not any(model.gravity))
    return _ALONE.suspicions([readings])


def _frames(model: CableModel, poses: Sequence[Pose], name: str) -> FloatArray | None:
    """Axes (m, d, d) in columns of the clamps that a reading is of; None at a pin."""
    side = name.rpartition("_")[0]
    if not getattr(model, side, SupportKind.FREE).direction:
        return None
    return np.array([clamp_axes(pose, side) for pose in poses])


_ALONE = Alternatives(
    READINGS_ALONE,
    lambda readings: readings.misfit,
    MUCH_BETTER,
    share=MUCH_BETTER,
    words="{was.said}: {own:.0%} off what a straight cable of any stiffness gives, but {left:.0%} "
    "{row}",
)


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


# A fitted rotation or lever arm fits at least as well as its special cases.
_BESIDE_SHAPES = Alternatives(
    READINGS,
    lambda one: one.misfit,
    MISREAD,
    share=MUCH_BETTER,
    near=READ_OTHERWISE,
    words="{was.name} is {own:.0%} off what the shapes need, but {left:.0%} {row}",
)


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
        own = one.misfit
        if MISREAD < own < UNSEEN * one.noise:
            continue
        if (meant := _BESIDE_SHAPES.likeliest(one)) is not None:
            found.append(_BESIDE_SHAPES.suspicion(meant))
            one = meant.meant
        elif own > MISREAD:
            doubted = explained and own > MUCH_BETTER
            found += [Suspicion(_UNLIKE.format(one.name, own), False)] * doubted
            continue
        scales[one.name] = one.scale
    forces = {name: scale for name, scale in scales.items() if not quantity_of(name).turning}
    if not sized:  # only what all readings have in common is unknown
        first = next(iter(forces or scales), "")
        for name in [name for name in scales if name != first]:
            found += _other_unit(name, scales[name] / scales[first], first, told=True)
        return tuple(found)
    # Forces in a known other unit count in newtons.
    newtons = [x / FORCE.others.get(_unit_of(name, x), 1.0) for name, x in forces.items()]
    for name, scale in scales.items():
        if name not in forces and newtons:
            found += _other_unit(name, scale / float(np.median(newtons)), "forces")
        else:
            found += _other_unit(name, scale, "mass")
    return tuple(found)


def _unit_of(name: str, scale: float) -> str:
    """The unit that a scale of readings is near; empty if there is none."""
    units = quantity_of(name).others
    unit = min(units, key=lambda one: abs(np.log(scale / units[one])))
    return unit if 0.5 < scale / units[unit] < 2.0 else ""


def _other_unit(name: str, scale: float, beside: str, *, told: bool = False) -> Iterator[Suspicion]:
    """A scale of readings that no mass explains; of moments beside the forces, if there are any.

    `told`: `beside` is a reading, whose unit may as well be the wrong one.
    """
    if 1 / HEAVIEST < scale < HEAVIEST:  # a wrong mass scales the forces that shapes need
        return
    cures, pairs = [], [("", name, scale), (f"{beside} ", beside, 1 / scale)]
    for whose, one, factor in pairs[: 1 + told]:
        if unit := _unit_of(one, factor):
            size = quantity_of(one).others[unit]
            cures.append(f"{whose}in {unit}? Try: divide {whose}by {size:g}.")
    cure = f": {' Or '.join(cures)}" if cures else ". Try: N and N m."
    text = f"{name} is {scale:.3g} times what shapes and {beside} need{cure}"
    yield Suspicion(text, bool(cures))
