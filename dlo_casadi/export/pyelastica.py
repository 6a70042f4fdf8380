"""Export to PyElastica: a Python file that makes a CosseratRod and holds its ends."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from dlo_casadi.arrays import FloatArray
from dlo_casadi.export.common import Relaxed, array, head_of_python, relax
from dlo_casadi.export.rod import Fixture, Rod

# Young's modulus and shear modulus [Pa] of PyElastica's first examples (Timoshenko beam).
DEFAULT = (1e6, 1e4)
# EA and GA over the cable's weight and buckling load, if no stretch was found: a strain of 2e-4.
_STIFF = 5e3
# Time step relative to the largest stable one.
_COURANT = 0.4
_BODY = '''

def make_rod() -> ea.CosseratRod:
    """The rod in the pose, with its rest shape, stiffness and masses."""
    first = QUATERNIONS[0]
    rod = ea.CosseratRod.straight_rod(
        n_elements=len(QUATERNIONS),
        start=NODES[0],
        direction=NODES[1] - NODES[0],
        normal=_directors(first)[0],
        base_length=H * len(QUATERNIONS),
        base_radius=RADIUS,
        density=MASSES.sum() / (np.pi * RADIUS**2 * H * len(QUATERNIONS)),
        youngs_modulus=4 * BENDING.max() / (np.pi * RADIUS**4),
        position=NODES.T.copy(),
        directors=np.stack([_directors(q) for q in QUATERNIONS], axis=2),
        rest_kappa=REST_KAPPA.T.copy(),
    )
    for k, (xx, xy, yy, zz) in enumerate(BENDING):
        rod.bend_matrix[..., k] = [[xx, xy, 0.0], [xy, yy, 0.0], [0.0, 0.0, zz]]
    for k in range(len(QUATERNIONS)):
        rod.shear_matrix[..., k] = np.diag([GA, GA, EA])
        rod.mass_second_moment_of_inertia[..., k] = INERTIA * np.eye(3)
        rod.inv_mass_second_moment_of_inertia[..., k] = np.eye(3) / INERTIA
    rod.mass[:] = MASSES
    return rod


def hold(simulator: ea.BaseSystemCollection, rod: ea.CosseratRod) -> None:
    """Put the rod under gravity and hold its ends where they are in the pose."""
    simulator.append(rod)
    simulator.constrain(rod).using(
        ea.FixedConstraint,
        constrained_position_idx=HELD_NODES,
        constrained_director_idx=HELD_ELEMENTS,
    )
    simulator.add_forcing_to(rod).using(ea.GravityForces, acc_gravity=GRAVITY)
    simulator.dampen(rod).using(
        ea.AnalyticalLinearDamper, uniform_damping_constant=DAMPING, time_step=STEP
    )


def _directors(quaternion):
    """Rows y, z, x of a frame (x, y, z, w): PyElastica has the tangent last."""
    x, y, z, w = quaternion
    frame = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )
    return frame.T[[1, 2, 0]]
'''


def write(rod: Rod, head: Sequence[str]) -> str:
    """The rod as a Python file: `make_rod()`, `hold(simulator, rod)`."""
    masses = rod.lumps_at(rod.s)
    masses[1:] += rod.masses / 2
    masses[:-1] += rod.masses / 2
    stiff = rod.inextensible(_STIFF)
    step, inertia = rod.explicit(masses, stiff, _COURANT)
    held = [_held(rod.start, 0, 1), _held(rod.end, -1, -2)]
    about = [rod.bending[:, 0, 0], rod.bending[:, 0, 1], rod.bending[:, 1, 1], rod.torsion]
    numbers = [
        ("H", f"{rod.h:.12g}", "length of an element [m]"),
        ("RADIUS", f"{rod.radius:.9g}", "[m]"),
        ("GRAVITY", array(rod.gravity), "[m/s^2]"),
        ("EA", f"{min(rod.axial, stiff):.9g}", "[N]"),
        ("GA", f"{stiff:.9g}", "[N], so stiff that shear does not matter"),
        ("INERTIA", f"{inertia:.9g}", "of an element [kg m^2], raised until STEP is stable"),
        ("STEP", f"{step:.6g}", "time step [s]"),
        ("DAMPING", "10.0", "[1/s]: chosen, not measured"),
        ("HELD_NODES", str(sum((nodes for nodes, _ in held), ())), ""),
        ("HELD_ELEMENTS", str(sum((elements for _, elements in held), ())), ""),
        ("NODES", array(rod.nodes), "[m]"),
        ("QUATERNIONS", array(rod.frames.as_quat()), "frames of the elements (x, y, z, w)"),
        ("MASSES", array(masses), "of the nodes [kg]"),
        ("BENDING", array(np.column_stack(about)), "yy, yz, zz, torsion [N m^2]"),
        ("REST_KAPPA", array(rod.rest[:, [1, 2, 0]]), "about y, z, and twist [1/m]"),
    ]
    return head_of_python(head, ["elastica as ea", "numpy as np"], numbers) + _BODY


def _held(fixture: Fixture, first: int, second: int) -> tuple[tuple[int, ...], tuple[int, ...]]:
    """Nodes and elements held by a fixture."""
    nodes = (first, second) if fixture.kind.direction else (first,) * fixture.kind.place
    return nodes, (first,) * fixture.kind.direction


def settle(text: str, rod: Rod) -> Relaxed:
    """Relax a written rod in PyElastica."""
    import elastica as ea

    made: dict[str, Any] = {}
    exec(compile(text, "export", "exec"), made)

    class Simulator(ea.BaseSystemCollection, ea.Constraints, ea.Forcing, ea.Damping):
        """PyElastica adds its features by inheritance."""

    simulator, cable = Simulator(), made["make_rod"]()
    made["hold"](simulator, cable)
    simulator.finalize()
    stepper, time, step = ea.PositionVerlet(), 0.0, made["STEP"]

    def advance(many: int) -> FloatArray:
        nonlocal time
        for _ in range(many):
            time = stepper.step(simulator, time, step)
        return np.array(cable.position_collection.T)

    def energy() -> float:
        return float((cable.mass * cable.velocity_collection**2).sum())

    def halt() -> None:
        cable.velocity_collection[:] = cable.omega_collection[:] = 0.0

    nodes = relax(advance, energy, halt, step, "PyElastica")
    at_end = [k for k in made["HELD_NODES"] if k < 0]
    weight = np.outer(made["GRAVITY"], cable.mass[at_end])
    return Relaxed(nodes, (cable.internal_forces[:, at_end] + weight).sum(axis=1))
