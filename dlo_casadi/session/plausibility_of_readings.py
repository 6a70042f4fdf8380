"""Mistakes of readings: signs, frames, units, and where moments are taken about.

Pure functions on arrays, as `plausibility`: what was read beside the forces and moments that the
shapes need, which are known up to the mass.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from dlo_casadi.session.plausibility import Suspicion
from dlo_casadi.thresholds import FITTED_READINGS, MISREAD, MUCH_BETTER, READ_OTHERWISE, READ_SCALE

FloatArray = NDArray[np.floating]

# Over newtons, and over newton metres.
UNITS: Mapping[str, Mapping[str, float]] = {
    "force": {"grams-force": 101.97, "kilograms-force": 0.10197, "millinewtons": 1e3},
    "moment": {"N mm": 1e3, "N cm": 1e2, "kgf cm": 10.197},
}


@dataclass(frozen=True)
class Compared:
    """One kind of reading on one side of the cable, of m poses.

    Parameters
    ----------
    name : str
        As in a configuration, such as end_force.
    measured, model : (m, c) [N] or [N m]
    frames : (m, d, d) or None
        Of the clamp there, columns its axes in the world; None at a pin.
    forces : (m, d) or None [N]
        Of a moment: of the model, on the same side.
    """

    name: str
    measured: FloatArray
    model: FloatArray
    frames: FloatArray | None = None
    forces: FloatArray | None = None


def misread(readings: Sequence[Compared], *, sized: bool = True) -> tuple[Suspicion, ...]:
    """What was read otherwise than the configuration says, the likeliest of each reading.

    Parameters
    ----------
    sized : bool
        Whether the shapes tell stiffness over weight: else only how forces and moments compare.
    """
    found = []
    scales = {}
    for one in readings:
        if len(one.measured) * one.measured.shape[1] < 3 or not one.model.any():
            continue
        own = _misfit(one.measured, one.model)
        said, rows = "", one.measured
        if own > MISREAD:
            others = [(_misfit(other, one.model), said, other) for said, other in _otherwise(one)]
            least = min(misfit for misfit, _, _ in others)
            # In the order of likelihood: a turn of all or an arm fits as well as any it contains.
            misfit, said, rows = next(x for x in others if x[0] < READ_OTHERWISE * least + 1e-9)
            if misfit > MUCH_BETTER * own:
                continue
            found.append(
                Suspicion(
                    f"{one.name} is {own:.0%} off what the shapes need, but {misfit:.0%} {said}",
                    True,
                )
            )
        scales[one.name] = float((rows * one.model).sum() / (one.model**2).sum())
    for name, scale in scales.items():
        if sized or (name.endswith("moment") and any(x.endswith("force") for x in scales)):
            found += _other_unit(name, scale, scales)
    return tuple(found)


def _misfit(measured: FloatArray, model: FloatArray) -> float:
    """Distance from the nearest multiple of the model, over the size of what was measured."""
    size = float((measured**2).sum() * (model**2).sum())
    along = max(float((measured * model).sum()), 0.0) / np.sqrt(max(size, 1e-300))
    return float(np.sqrt(max(1 - along**2, 0.0)))


def _otherwise(one: Compared) -> Iterator[tuple[str, FloatArray]]:
    """Other ways to read what was measured: in words, and what it then is."""
    a, (count, size) = one.measured, one.measured.shape
    turned = "with the other sign. Try: what the cable does to the fixture, not the fixture to it."
    yield turned, -a
    if one.frames is not None and size > 1:
        world = np.einsum("mij,mj->mi", one.frames, a)
        text = "once turned from the clamp's axes into the world's"
        yield f"{text}. Try: world axes, R f with the clamp's frame R of each pose.", world
        yield f"{text}, with the other sign. Try: -R f, with the clamp's frame R.", -world
    # Forces of few poses are nearly parallel: a turn or an arm that is fitted explains any error.
    if count < FITTED_READINGS:
        return
    if one.forces is not None:
        yield from _about_elsewhere(one)
    if size > 1:
        u, _, v = np.linalg.svd(a.T @ one.model)
        hand = np.diag([*np.ones(size - 1), np.sign(np.linalg.det(u @ v))])
        turn = (u @ hand @ v).T
        angle = (
            np.degrees(Rotation.from_matrix(turn).magnitude())
            if size == 3
            else np.degrees(np.arctan2(turn[1, 0], turn[0, 0]))
        )
        text = f"once all are turned by {angle:.0f} degrees. Try: the axes of start and end."
        yield text, a @ turn.T


def _about_elsewhere(one: Compared) -> Iterator[tuple[str, FloatArray]]:
    """Moments about a point that is fixed to the clamp: M + (fixture - point) x F, least squares.

    The point and the scale are found together: both are linear in what was measured.
    """
    assert one.forces is not None
    d = one.forces.shape[1]
    frames = (
        one.frames if one.frames is not None else np.broadcast_to(np.eye(d), (len(one.model), d, d))
    )
    arms = np.stack([_crossed(frames[:, :, k], one.forces) for k in range(d)], axis=2)
    columns = np.concatenate([one.model[..., None], arms], axis=2).reshape(-1, 1 + d)
    scale, *arm = np.linalg.lstsq(columns, one.measured.ravel(), rcond=None)[0]
    if scale <= 0:
        return
    point = -np.array(arm) / scale
    told = ", ".join(f"{x:.3g}" for x in 1e3 * point)
    axes = "of the clamp" if one.frames is not None else "of gravity's frame"
    yield (
        f"once taken about a point ({told}) mm from the fixture along the axes {axes}, where the "
        "sensor may be. Try: moments about the fixture, M + (sensor - fixture) x F.",
        one.measured - arms @ np.array(arm),
    )


def _crossed(a: FloatArray, b: FloatArray) -> FloatArray:
    """Cross products (m, 3), in a plane (m, 1)."""
    if a.shape[1] == 3:
        return np.cross(a, b)
    return a[:, :1] * b[:, 1:] - a[:, 1:] * b[:, :1]


def _other_unit(name: str, scale: float, scales: Mapping[str, float]) -> Iterator[Suspicion]:
    """A scale that no mass explains; of moments, beside that of forces on the same cable."""
    kind = name.split("_")[1]
    forces = [known for other, known in scales.items() if other.endswith("force")]
    beside = float(np.median(forces)) if forces and kind == "moment" else 1.0
    if 1 / READ_SCALE < scale / beside < READ_SCALE:
        return
    units = UNITS[kind]
    unit = min(units, key=lambda one: abs(np.log(scale / units[one])))
    named = 0.5 < scale / units[unit] < 2.0
    cure = f": in {unit}? Try: divide by {units[unit]:g}." if named else ". Try: N and N m."
    yield Suspicion(f"{name} is {scale:.3g} times what shapes and mass need{cure}", named)
