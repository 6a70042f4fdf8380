"""Files of simulators: a cable in a pose, and samples of what is known of it."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from dlo_casadi.arrays import FloatArray
from dlo_casadi.errors import DloError, EquilibriumError, OutputError
from dlo_casadi.export.rod import Feature, Held, Rod
from dlo_casadi.export.targets import MARK, Target, head
from dlo_casadi.io.files import is_marked, write_file

# Draws per sample before it is said that the fit leaves none that is physical.
_DRAWS = 200


def write_rods(
    target: Target,
    path: Path,
    cables: Sequence[Held],
    origin: str,
    segments: int | None,
    seed: int,
) -> list[Path]:
    """Write cables, the first to `path` and the others to <path>_001, ...; return the files.

    Parameters
    ----------
    origin : str
        Where the first comes from; the others are samples of it, drawn with the seed.

    Raises
    ------
    OutputError
        If a file cannot be written, or is there and no export.
    """
    count = len(cables) - 1
    names = [path, *(path.with_stem(f"{path.stem}_{k:03d}") for k in range(1, count + 1))]
    for name in names:
        if not is_marked(name, MARK):
            raise OutputError(
                f"{name} is from elsewhere and would be replaced.\n"
                "  Try: another name, or move it away.",
                name,
            )
    texts = []
    for k, cable in enumerate(cables):
        rod = Rod.of(cable, segments)
        segments = len(rod.masses)  # samples are cut as the cable is
        said = [origin, *[f"sample {k} of {count}, seed {seed}"] * (k > 0)]
        texts.append(target.write(rod, head(target, rod, losses(cable, target, rod), said)))
    for name, text in zip(names, texts, strict=True):
        write_file(name, text)
    return names


def losses(cable: Held, target: Target, rod: Rod) -> dict[Feature, str]:
    """Features that a target cannot carry: which effects, and how far the shape moves without."""
    return {item: _cost(cable, rod, item) for item in target.dropped(rod)}


def _cost(cable: Held, rod: Rod, feature: Feature) -> str:
    labels = rod.features[feature]
    model, pose, rest = cable.model, cable.pose, cable.rest
    length, known = model.cable.length, dict(zip(model.names, cable.p, strict=True))
    if feature == "clips":
        model, pose = replace(model, clips=()), replace(pose, clips=())
    if feature in ("anisotropy", "stiffness along the cable"):  # what is left is the mean
        known["bending_stiffness"] = float(rod.mean_bending.mean())
        known["torsional_stiffness"] = float(rod.torsion.mean())
    if feature == "obstacles":
        model = replace(model, obstacles=())
    if feature == "rest shape":
        rest = np.zeros_like(rest)
    for label in labels:
        model = model.without_effect(label)
    p = np.array([known[name] for name in model.names])
    named = f"{', '.join(labels)} left out; " if labels else ""
    try:
        plain = Held.solved(model, p, rest, pose)
    except EquilibriumError:
        return f"{named}without it this pose has no equilibrium"
    s = np.linspace(0.0, length, 101)
    moved = float(np.linalg.norm(plain.curve.at(s) - cable.curve.at(s), axis=1).max())
    return f"{named}without it this shape moves by up to {100 * moved / length:.2g} % of the length"


def samples_of(
    cable: Held,
    coefficients: FloatArray,
    names: Sequence[str],
    covariance: FloatArray,
    count: int,
    seed: int,
) -> list[Held]:
    """Cables in the same pose, drawn from a covariance: positive and within all physical bounds.

    What is estimated as a logarithm is drawn as one; what lies outside its bounds is drawn again,
    and so is a cable without an equilibrium in the pose.

    Parameters
    ----------
    coefficients : (n_coefficients,) [1/m]
        Of the rest curvature.
    names, covariance : (N,), (N, N)
        Fitted parameters, and `rest_curvature[k]`.

    Raises
    ------
    DloError
        If the fit leaves hardly anything within the bounds, or the rest shape changed from pose to
        pose, which is not known together with the parameters.
    """
    model = cable.model
    if count and model.has_state:
        raise DloError(
            f"{model.cable.name!r} has a rest shape that changed from pose to pose: the covariance "
            "is not that of its rest shape now, and no samples can be drawn"
        )
    values = dict(zip(model.names, cable.p, strict=True))
    values |= {f"rest_curvature[{k}]": c for k, c in enumerate(coefficients)}
    kept = [k for k, name in enumerate(names) if name in values]
    fitted = [names[k] for k in kept]
    mean = np.array([values[name] for name in fitted])
    logarithms = {q.name for q in model.parameters if q.log}
    log = np.array([name in logarithms for name in fitted], dtype=bool)
    # The covariance of log(v) is that of v over v.
    scale = np.where(log, mean, 1.0)
    root = _root(covariance[np.ix_(kept, kept)] / np.outer(scale, scale))
    generator, out = np.random.default_rng(seed), list[Held]()
    for _ in range(_DRAWS * count):
        if len(out) == count:
            break
        step = root @ generator.standard_normal(len(mean))
        drawn = np.where(log, mean * np.exp(np.where(log, step, 0.0)), mean + step)
        found = _cable(cable, values | dict(zip(fitted, drawn, strict=True)), len(coefficients))
        if found is not None:
            out.append(found)
    if len(out) < count:
        raise DloError(
            f"{model.cable.name!r}: {_DRAWS * count} draws from the covariance gave {len(out)} of "
            f"{count} cables within their physical bounds.\n"
            "  Try: more poses, or poses that tell more: dlo diagnose names one."
        )
    return out


def _cable(cable: Held, values: Mapping[str, float], count: int) -> Held | None:
    """The cable with other values; None if they are outside their bounds, or it has no shape."""
    model = cable.model
    if not all(q.lower <= values[q.name] <= q.upper for q in model.parameters):
        return None
    p = np.array([values[name] for name in model.names])
    rest = model.rest_basis @ np.array([values[f"rest_curvature[{k}]"] for k in range(count)])
    try:
        return Held.solved(model, p, rest, cable.pose)
    except EquilibriumError:
        return None


def _root(covariance: FloatArray) -> FloatArray:
    """Matrix A with A A^T = the covariance, which rounding may have made indefinite."""
    values, vectors = np.linalg.eigh(covariance)
    root: FloatArray = vectors * np.sqrt(np.maximum(values, 0.0))
    return root
