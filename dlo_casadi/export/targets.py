"""Simulators that a fitted cable can be written for, their limits, and their files."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from difflib import get_close_matches
from importlib.util import find_spec
from pathlib import Path

import numpy as np

from dlo_casadi.arrays import FloatArray, root_of
from dlo_casadi.effects import ContactEffect
from dlo_casadi.equilibrium.spread import SolvedCable
from dlo_casadi.errors import DloError, EquilibriumError, OutputError
from dlo_casadi.export import mujoco, newton, pyelastica, usd
from dlo_casadi.export.common import Relaxed, printable
from dlo_casadi.export.driven import Driven
from dlo_casadi.export.rod import Feature, Rod
from dlo_casadi.io.files import is_marked, write_file

# Text that identifies a written file.
MARK = "written by dlo-casadi for"
CHAIN: frozenset[Feature] = frozenset(
    {"rest shape", "anisotropy", "stiffness along the cable", "lumped mass"}
)


@dataclass(frozen=True)
class Target:
    """A simulator.

    Parameters
    ----------
    suffix : str
        End of the names of its files, unless a name is given.
    packages : tuple of str
        Modules needed to relax a cable in it; `extra` installs them.
    write : callable
        Makes the text of a file from a rod and the lines of its head.
    settle : callable
        Relaxes a written file in the simulator.
    default : (float, float) [Pa]
        Moduli in bending and twist of the simulator's own cable example; `default_of` names it.
    places : tuple of str
        Where the file contains our numbers.
    step : float, optional [s]
        Of a file in which fixtures move; None where they cannot.
    follow : callable, optional
        Makes the nodes (T, n + 1, 3) [m] along that motion, one row a step.
    """

    title: str
    suffix: str
    packages: tuple[str, ...]
    extra: str
    carries: frozenset[Feature]
    write: Callable[[Rod, Sequence[str]], str]
    settle: Callable[[str, Rod], Relaxed]
    default: tuple[float, float]
    default_of: str
    places: tuple[str, ...]
    step: float | None = None
    follow: Callable[[str, Rod], FloatArray] | None = None

    @property
    def installed(self) -> bool:
        """Whether a cable can be relaxed in it on this computer."""
        return all(find_spec(name) is not None for name in self.packages)

    def default_stiffness(self, radius: float) -> tuple[float, float]:
        """EI and GJ [N m^2] from its own example's moduli for a round section."""
        second = np.pi * radius**4 / 4
        return self.default[0] * second, self.default[1] * 2 * second

    def dropped(self, rod: Rod) -> list[Feature]:
        """Features of a rod that it does not support."""
        return [feature for feature in rod.features if feature not in self.carries]


TARGETS = {
    "mujoco": Target(
        title="MuJoCo",
        suffix=".xml",
        packages=("mujoco",),
        extra="peers",
        carries=CHAIN | {"free roll of an end"},
        write=mujoco.write,
        settle=mujoco.settle,
        default=mujoco.DEFAULT,
        default_of="the cable that comes with MuJoCo 3 (model/plugin/elasticity/cable.xml)",
        places=(
            "joint stiffness [N m/rad]: EI / h about y, z; GJ / h about x; h: the length of a link",
            "joint springref [rad]: h times the curvature and twist without load (the cable plugin",
            "of MuJoCo 3 would take the initial shape for that; it is gone in MuJoCo 4)",
            "geom mass [kg]; geom size [m]: half the diameter; option gravity [m/s^2]",
            "body start, body end: the clamps (mocap), move them; key pose: the shape in this pose",
            "joint damping [N m s/rad]: damping_time times stiffness, 0.03 s where it is unknown;",
            "armature and the softness of the end's constraint are chosen for this timestep: they",
            "change motion, not rest (the end by < 0.1 %)",
        ),
        step=mujoco.STEP,
        follow=mujoco.follow,
    ),
    "pyelastica": Target(
        title="PyElastica",
        suffix="_pyelastica.py",
        packages=("elastica",),
        extra="peers",
        carries=CHAIN | {"stretch"},
        write=pyelastica.write,
        settle=pyelastica.settle,
        default=pyelastica.DEFAULT,
        default_of="its first example (Timoshenko beam)",
        places=(
            "BENDING [N m^2]: EI about y and z, GJ; into bend_matrix. REST_KAPPA [1/m]",
            "MASSES [kg] of the nodes; GRAVITY [m/s^2]; NODES [m] and QUATERNIONS: the shape",
            "EA, GA [N], INERTIA, STEP, DAMPING are not measured: they change motion, not rest",
            "(unless a stretch was found, EA and GA leave a strain of at most 0.02 %)",
        ),
    ),
    "newton": Target(
        title="Newton",
        suffix="_newton.py",
        packages=("newton",),
        extra="newton",
        carries=CHAIN - {"anisotropy"} | {"stretch"},
        write=newton.write,
        settle=newton.settle,
        default=newton.DEFAULT,
        default_of="the softest cable of its example cable_twist",
        places=(
            "BENDING, TORSION [N m^2]: EI, GJ; over H the stiffness [N m/rad] of each joint. Of a",
            "flat cable the mean EI: the solver takes one bending stiffness a joint",
            "REST_NODES, REST_QUATERNIONS: the shape without load; MASSES [kg] of the links",
            "NODES [m], QUATERNIONS: the shape; the first and the last link are the clamps",
            "EA, GA [N], INERTIA are not measured, and there is no damping",
            "(unless a stretch was found, EA and GA leave a strain of 1 % at most)",
            "STEP, ITERATIONS: with larger steps SolverVBD comes to rest elsewhere",
        ),
    ),
    "usd": Target(
        title="USD",
        suffix=".usda",
        packages=("newton", "pxr"),
        extra="newton",
        carries=frozenset({"rest shape", "lumped mass", "stretch"}),
        write=usd.write,
        settle=usd.settle,
        default=usd.DEFAULT,
        default_of="the AOUSD proposal's of a material without values (E 1 MPa, Poisson 0.3)",
        places=(
            "material curvesBendStiffness, curvesTwistStiffness [N m^2]: EI, GJ, one for the cable",
            "(means along it, and about both axes); curvesStretchStiffness, curvesShearStiffness:",
            "EA, kGA [N], not measured (unless a stretch was found, a strain of 1 % at most)",
            "cable restShapePoints [m], restNormals: the shape without load; masses [kg] of links",
            "cable points [m], normals: the shape in this pose; start, end: the clamps",
            "Importers that do not read restShapePoints drop the rest curvature: they take the",
            "shape in this pose, or a straight one, for that without load. Newton 1.8 reads it",
        ),
    ),
}
# Simulators that cannot represent a cable -> why, and what to use.
REFUSED = {
    "mjx": "MJX ignores bend and twist of MuJoCo's cable plugin: every cable is limp in it.\n"
    "  Try: --to mujoco: hinges with springs and no plugin. MJX loads it; shapes there were not "
    "checked."
}


def check_counts(segments: int | None, samples: int, seed: int) -> None:
    """Raise DloError if a number is too small, or is no whole number; see `FittedCable.export`."""
    for name, value, least in (
        ("segments", 4 if segments is None else segments, 4),
        ("samples", samples, 0),
        ("seed", seed, 0),
    ):
        whole = isinstance(value, int | np.integer) and not isinstance(value, bool)
        if not whole or value < least:
            text = f"{name}: a whole number, {least} or more, found {value!r}"
            raise DloError(f"{text}\n  Try: {name}={least}")


def target_of(name: str) -> Target:
    """Find a target by name.

    Raises DloError with the nearest name if there is none, or with the reason if it cannot
    represent a cable.
    """
    if name in REFUSED:
        raise DloError(REFUSED[name])
    if name not in TARGETS:
        near = get_close_matches(str(name), [*TARGETS, *REFUSED], 1)
        hint = f"; did you mean {near[0]!r}?" if near else ""
        raise DloError(f"no simulator is called {name!r}{hint}\n  Try: {', '.join(TARGETS)}")
    return TARGETS[name]


def step_of(target: Target) -> float:
    """The step [s] of a target's files; raises DloError if fixtures do not move in them."""
    if target.step is None:
        able = ", ".join(name for name, one in TARGETS.items() if one.step is not None)
        raise DloError(f"{target.title}: fixtures do not move in its files.\n  Try: {able}")
    return target.step


def require(target: Target) -> None:
    """Raise DloError if cables cannot be relaxed in a target on this computer."""
    if not target.installed:
        raise DloError(
            f"{' and '.join(target.packages)} is not installed.\n"
            f"  Try: pip install 'dlo-casadi[{target.extra}]'"
        )


def head(target: Target, rod: Rod, lost: Mapping[Feature, str], origin: Sequence[str]) -> list[str]:
    """First lines of a file: which number went where, and what is lost.

    `lost`: unsupported feature -> its effect on the shape. `origin`: description of the cable.
    """
    bends, masses = rod.bending[:, [0, 1], [0, 1]], rod.masses.sum() + rod.lumps[:, 0].sum()
    known = [
        f"EI {_range(bends)} N m^2, GJ {_range(rod.torsion)} N m^2, mass {masses:.4g} kg",
        f"rest: twist {_range(rod.rest[:, 0])}, curvature about y {_range(rod.rest[:, 1])}, "
        f"about z {_range(rod.rest[:, 2])} 1/m",
        *(f"compact mass of {m:.4g} kg at {s:.4g} m" for m, s in rod.lumps),
        f"{len(rod.masses)} links of {rod.h:.6g} m; a clamp holds the middle of one",
    ]
    if not rod.node.twists:
        known.append(
            "measured in a plane, z = 0 here: GJ is taken as EI / 1.3, and out of the plane nothing"
            " is known"
        )
    costs = [f"{feature}: {cost}" for feature, cost in lost.items()]
    return [
        f"{rod.name}: {MARK} {target.title}",
        *map(printable, origin),
        "SI units: m, kg, s, N, rad.",
        "",
        *known,
        "",
        "Meaning of the numbers:",
        *(f"  {line}" for line in target.places),
        *(f"  {line}" for line in _PLAYED if rod.driven is not None),
        "",
        "Not represented:",
        *(f"  {line}" for line in costs or ["nothing"]),
    ]


# How fixtures that move are played.
_PLAYED = (
    "custom numeric motion: what the servos of the joints start_x, ... are asked in each step:",
    "  rows = model.numeric_data.reshape(-1, model.nu)",
    "  for row in rows: data.ctrl[:] = row; mujoco.mj_step(model, data)",
    "start_carriage, end_carriage: what they drive, 100000 times as heavy as the cable",
)


def _range(values: np.ndarray) -> str:
    low, high = float(values.min()), float(values.max())
    return f"{low:.4g}" if high - low <= 1e-6 * abs(high) else f"{low:.4g} to {high:.4g}"


# Draws per sample after which the fit counts as leaving no physical samples.
_DRAWS = 200


def write_rods(
    target: Target,
    path: Path,
    cables: Sequence[SolvedCable],
    origin: str,
    segments: int | None,
    seed: int,
    driven: Driven | None = None,
) -> list[Path]:
    """Write cables, the first to `path` and the others to <path>_001, ...; return the files.

    `origin`: source of the first cable; the others are samples of it, drawn with the seed.
    `driven`: how fixtures move, for targets with a step. Raises
    OutputError if a file cannot be written, or if it exists and is not an export.
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
        rod = replace(Rod.of(cable, segments), driven=driven)
        segments = len(rod.masses)  # samples get the same segments as the cable
        said = [origin, *[f"sample {k} of {count}, seed {seed}"] * (k > 0)]
        texts.append(target.write(rod, head(target, rod, losses(cable, target, rod), said)))
    for name, text in zip(names, texts, strict=True):
        write_file(name, text)
    return names


def losses(cable: SolvedCable, target: Target, rod: Rod) -> dict[Feature, str]:
    """Features that a target does not support: their effects, and the shape's change without."""
    return {item: _cost(cable, rod, item) for item in target.dropped(rod)}


def _cost(cable: SolvedCable, rod: Rod, feature: Feature) -> str:
    labels = rod.features[feature]
    model, pose, rest = cable.model, cable.pose, cable.rest
    length, known = model.cable.length, dict(zip(model.names, cable.p, strict=True))
    if feature == "clips":
        model, pose = replace(model, clips=()), replace(pose, clips=())
    if feature in ("anisotropy", "stiffness along the cable"):  # the mean remains
        known["bending_stiffness"] = float(rod.mean_bending.mean())
        known["torsional_stiffness"] = float(rod.torsion.mean())
    if feature == "obstacles":
        model, _ = replace(model, obstacles=()).without_kind(ContactEffect, cable.p)
    if feature == "rest shape":
        rest = np.zeros_like(rest)
    for label in labels:
        model = model.without_effect(label)
    p = np.array([known[name] for name in model.names])
    named = f"{', '.join(labels)} left out; " if labels else ""
    if feature == "damping beside the cable's own":
        return f"{named}it changes motions, not shapes at rest"
    if feature == "feeding through an end":
        between = float(np.ptp(cable.places))
        return f"the {1e3 * between:.1f} mm between the ends of this shape stay between them"
    try:
        plain = SolvedCable.of(model, p, rest, pose)
    except EquilibriumError:
        return f"{named}without it this pose has no equilibrium"
    s = np.linspace(0.0, length, 101)
    moved = float(np.linalg.norm(plain.curve.at(s) - cable.curve.at(s), axis=1).max())
    return f"{named}without it this shape moves by up to {100 * moved / length:.2g} % of the length"


def samples_of(
    cable: SolvedCable,
    coefficients: FloatArray,
    names: Sequence[str],
    covariance: FloatArray,
    count: int,
    seed: int,
) -> list[SolvedCable]:
    """Draw cables in the same pose from a covariance: positive and within all physical bounds.

    A value estimated as a logarithm is drawn as one. Values outside their bounds, and cables
    without an equilibrium in the pose, are drawn again.

    Parameters
    ----------
    coefficients : (n_coefficients,) [1/m]
        Of the rest curvature.
    names, covariance : (N,), (N, N)
        Fitted parameters, and `rest_curvature[k]`.

    Raises
    ------
    DloError
        If nothing is uncertain, if the fit leaves almost nothing within the bounds, or if the rest
        shape changed from pose to pose: its covariance with the parameters is then unknown.
    """
    model = cable.model
    if count and not names:
        text = "is known exactly: all samples would be the same.\n  Try: samples=0"
        raise DloError(f"{model.cable.name!r} {text}")
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
    # The covariance of log(v) is the covariance of v divided by v.
    scale = np.where(log, mean, 1.0)
    root = root_of(covariance[np.ix_(kept, kept)] / np.outer(scale, scale))
    generator, out = np.random.default_rng(seed), list[SolvedCable]()
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


def _cable(cable: SolvedCable, values: Mapping[str, float], count: int) -> SolvedCable | None:
    """The cable with other values; None if they are outside their bounds, or if it has no shape."""
    model = cable.model
    bounds = {q.name: q.bounds(estimated=False) for q in model.parameters}
    if not all(least <= values[name] <= most for name, (least, most) in bounds.items()):
        return None
    p = np.array([values[name] for name in model.names])
    rest = model.rest_basis @ np.array([values[f"rest_curvature[{k}]"] for k in range(count)])
    try:
        return SolvedCable.of(model, p, rest, cable.pose)
    except EquilibriumError:
        return None
