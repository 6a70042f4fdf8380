"""The simulators that a fitted cable can be written for, and what each of them cannot carry."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from difflib import get_close_matches
from importlib.util import find_spec

import numpy as np

from dlo_casadi.errors import DloError
from dlo_casadi.export import mujoco, newton, pyelastica, usd
from dlo_casadi.export.common import Relaxed
from dlo_casadi.export.rod import Feature, Rod

# Text by which a written file is recognised.
MARK = "written by dlo-casadi for"
CHAIN: frozenset[Feature] = frozenset(
    {"rest shape", "anisotropy", "stiffness along the cable", "lumped mass"}
)


@dataclass(frozen=True)
class Target:
    """A simulator.

    Parameters
    ----------
    title : str
    suffix : str
        End of the names of its files, where none is given.
    packages : tuple of str
        Modules that have to be installed to relax a cable in it, and the `extra` that has them.
    carries : frozenset of Feature
    write : callable
        The text of a file: of a rod, and the lines of its head.
    settle : callable
        Relaxes a written file in the simulator.
    default : (float, float) [Pa]
        Moduli in bending and twist that its own example of a cable has, and `default_of` it.
    places : tuple of str
        Where our numbers stand in the file.
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

    @property
    def installed(self) -> bool:
        """Whether a cable can be relaxed in it here."""
        return all(find_spec(name) is not None for name in self.packages)

    def default_stiffness(self, radius: float) -> tuple[float, float]:
        """EI and GJ [N m^2] of its own example's moduli with a round section."""
        second = np.pi * radius**4 / 4
        return self.default[0] * second, self.default[1] * 2 * second

    def dropped(self, rod: Rod) -> list[Feature]:
        """Features of a rod that it cannot carry."""
        return [feature for feature in rod.features if feature not in self.carries]


TARGETS = {
    "mujoco": Target(
        title="MuJoCo",
        suffix=".xml",
        packages=("mujoco",),
        extra="peers",
        carries=CHAIN,
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
            "joint damping, armature, and the softness of the end's constraint are not measured:",
            "they are chosen for a step of 2 ms, and change motion, not rest (the end by < 0.1 %)",
        ),
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
# Simulators that cannot take a cable -> why, and what to use.
REFUSED = {
    "mjx": "MJX ignores bend and twist of MuJoCo's cable plugin: every cable is limp in it.\n"
    "  Try: --to mujoco: hinges with springs and no plugin. MJX loads it; shapes there were not "
    "checked."
}


def target_of(name: str) -> Target:
    """The target of a name.

    Raises
    ------
    DloError
        If there is none, with the nearest name, or it cannot take a cable, with the reason.
    """
    if name in REFUSED:
        raise DloError(REFUSED[name])
    if name not in TARGETS:
        near = get_close_matches(str(name), [*TARGETS, *REFUSED], 1)
        hint = f"; did you mean {near[0]!r}?" if near else ""
        raise DloError(f"no simulator is called {name!r}{hint}\n  Try: {', '.join(TARGETS)}")
    return TARGETS[name]


def require(target: Target) -> None:
    """Raise DloError if cables cannot be relaxed in a target here."""
    if not target.installed:
        raise DloError(
            f"{' and '.join(target.packages)} is not installed.\n"
            f"  Try: pip install 'dlo-casadi[{target.extra}]'"
        )


def head(target: Target, rod: Rod, lost: Mapping[Feature, str], origin: Sequence[str]) -> list[str]:
    """Lines that a file begins with: which number went where, and what is lost.

    Parameters
    ----------
    lost : dict
        Feature that is not carried -> what that costs.
    origin : sequence of str
        What the cable is.
    """
    bends, masses = rod.bending[:, [0, 1], [0, 1]], rod.masses.sum() + rod.lumps[:, 0].sum()
    known = [
        f"EI {_range(bends)} N m^2, GJ {_range(rod.torsion)} N m^2, mass {masses:.4g} kg",
        f"rest: twist {_range(rod.rest[:, 0])}, curvature about y {_range(rod.rest[:, 1])}, "
        f"about z {_range(rod.rest[:, 2])} 1/m",
        *(f"compact mass of {m:.4g} kg at {s:.4g} m" for m, s in rod.lumps),
        f"{len(rod.masses)} links of {rod.h:.6g} m; a clamp holds the middle of one",
    ]
    if not rod.in_space:
        known.append(
            "measured in a plane, z = 0 here: GJ is taken as EI / 1.3, and out of the plane nothing"
            " is known"
        )
    costs = [f"{feature}: {cost}" for feature, cost in lost.items()]
    return [
        f"{rod.name}: {MARK} {target.title}",
        *origin,
        "SI units: m, kg, s, N, rad.",
        "",
        *known,
        "",
        "Where it stands:",
        *(f"  {line}" for line in target.places),
        "",
        "Not carried:",
        *(f"  {line}" for line in costs or ["nothing"]),
    ]


def _range(values: np.ndarray) -> str:
    low, high = float(values.min()), float(values.max())
    return f"{low:.4g}" if high - low <= 1e-6 * abs(high) else f"{low:.4g} to {high:.4g}"
