"""Export to Newton: a Python file that adds a rod of capsules and holds its ends (solver VBD)."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any
from warnings import catch_warnings, simplefilter

import numpy as np
from scipy.spatial.transform import Rotation

from dlo_casadi.arrays import FloatArray
from dlo_casadi.export.common import Relaxed, array, head_of_python, relax
from dlo_casadi.export.rod import Rod

# Moduli [Pa] of the softest cable in Newton's example cable_twist: 100 N m/rad per 0.1 m, r 20 mm.
DEFAULT = (8e7, 4e7)
# Rows are y, z, x of a link: in Newton the tangent is last.
AXES = Rotation.from_matrix([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
# EA and GA over weight and buckling load, if no stretch was found: a strain of 1 % at that load.
# With stiffer values cables come to rest elsewhere, probably due to single-precision rounding.
STIFF = 100.0
# Time step relative to the largest of an explicit solver, and iterations per step. They also change
# the shape at rest: a part of each step's free fall remains uncorrected.
_COURANT, ITERATIONS = 2.0, 40
# At rest [m/s]: in single precision nodes keep creeping at about 1e-4.
_REST_SPEED = 5e-4
_BODY = '''

def add_cable(builder: newton.ModelBuilder) -> tuple[list[int], list[int]]:
    """Add the cable in the pose, with its ends held; return its bodies and joints."""
    rod = newton.Rod(
        NODES,
        quaternions=QUATERNIONS,
        rest_points=REST_NODES,
        rest_quaternions=REST_QUATERNIONS,
        radius=RADIUS,
    )
    shape = builder.default_shape_cfg.copy()
    shape.density = float(MASSES.mean() / (np.pi * RADIUS**2 * H))
    bodies, joints = builder.add_rod(
        rod=rod,
        cfg=shape,
        stretch_stiffness=EA / H,
        shear_stiffness=GA / H,
        bend_stiffness=BENDING[0] / H,
        twist_stiffness=TORSION[0] / H,
    )
    for joint, bending, torsion in zip(joints, BENDING.tolist(), TORSION.tolist()):
        first = builder.joint_qd_start[joint] + 3  # after shear, shear, stretch
        builder.joint_target_ke[first : first + 3] = [bending / H, bending / H, torsion / H]
    for body, mass in zip(bodies, MASSES.tolist()):
        _set_mass(builder, body, mass, INERTIA)
    for end in CLAMPED:
        _set_mass(builder, bodies[end], 0.0, 0.0)  # moves as it is told to
    for end, side in PINNED:
        builder.add_joint_ball(
            parent=-1,
            child=bodies[end],
            parent_xform=wp.transform(wp.vec3(*NODES[end]), wp.quat_identity()),
            child_xform=wp.transform(wp.vec3(0.0, 0.0, side * H / 2), wp.quat_identity()),
        )
    return bodies, joints


def make_model(device: str | None = None) -> newton.Model:
    """The cable alone under its gravity, for `newton.solvers.SolverVBD(model, ITERATIONS)`."""
    builder = newton.ModelBuilder(gravity=wp.vec3(*GRAVITY))
    add_cable(builder)
    builder.color()
    return builder.finalize(device=device)


def _set_mass(builder, body, mass, inertia):
    builder.body_mass[body] = mass
    builder.body_inv_mass[body] = 1.0 / mass if mass else 0.0
    builder.body_inertia[body] = wp.mat33(*(inertia * np.eye(3)).ravel())
    inverse = 1.0 / inertia if inertia else 0.0
    builder.body_inv_inertia[body] = wp.mat33(*(inverse * np.eye(3)).ravel())
'''


def write(rod: Rod, head: Sequence[str]) -> str:
    """The rod as a Python file: `add_cable(builder)`, `make_model()`."""
    masses, stiff = rod.link_masses, rod.inextensible(STIFF)
    rest_nodes, rest_frames = rod.unloaded
    step, inertia = rod.explicit(masses, stiff, _COURANT)
    sides = [(rod.start, 0, -1), (rod.end, -1, 1)]
    pinned = [(end, side) for fixture, end, side in sides if fixture.kind.turns]
    numbers = [
        ("H", f"{rod.h:.12g}", "length of a link [m]"),
        ("RADIUS", f"{rod.radius:.9g}", "[m]"),
        ("GRAVITY", array(rod.gravity), "[m/s^2]"),
        ("EA", f"{min(rod.axial, stiff):.9g}", "[N]"),
        ("GA", f"{stiff:.9g}", "[N], so stiff that shear does not matter"),
        ("INERTIA", f"{inertia:.9g}", "of a link [kg m^2], raised for STEP"),
        ("STEP", f"{step:.6g}", "time step [s]: not larger, see above"),
        ("ITERATIONS", f"{ITERATIONS}", "of the solver in a step, or more"),
        ("CLAMPED", str([end for f, end, _ in sides if f.kind.direction]), ""),
        ("PINNED", str(pinned), "node, and side of its link"),
        ("NODES", array(rod.nodes), "[m]"),
        ("QUATERNIONS", array((rod.frames * AXES).as_quat()), "frames of the links (x, y, z, w)"),
        ("REST_NODES", array(rest_nodes), "without load [m]"),
        ("REST_QUATERNIONS", array((rest_frames * AXES).as_quat()), ""),
        ("MASSES", array(masses), "of the links [kg]"),
        ("BENDING", array(rod.mean_bending), "EI of the joints [N m^2]"),
        ("TORSION", array(rod.torsion), "GJ of the joints [N m^2]"),
    ]
    libraries = ["newton", "numpy as np", "warp as wp"]
    return head_of_python(head, libraries, numbers) + _BODY


def settle(text: str, rod: Rod) -> Relaxed:
    """Relax a written model in Newton, on the CPU."""
    made: dict[str, Any] = {}
    with quietly():
        exec(compile(text, "export", "exec"), made)
        model = made["make_model"]("cpu")
    return settled(model, rod, "Newton")


@contextmanager
def quietly() -> Iterator[None]:
    """Suppress messages of compilation, and of pins beside the free joint of a rod."""
    import warp as wp

    wp.config.log_level = wp.LOG_WARNING
    with catch_warnings():
        simplefilter("ignore")
        yield


def settled(model: Any, rod: Rod, name: str) -> Relaxed:
    """Relax a Newton model whose first bodies and last joints are the links of a rod."""
    import newton
    import warp as wp

    stiff = rod.inextensible(STIFF)
    step, _ = rod.explicit(rod.link_masses, stiff, _COURANT)
    solver = newton.solvers.SolverVBD(model, iterations=ITERATIONS)
    states, control = [model.state(), model.state()], model.control()
    count = len(rod.masses)

    def two_steps() -> None:
        for one, next_one in (states, states[::-1]):
            one.clear_forces()
            solver.step(one, next_one, control, None, step)

    with wp.ScopedCapture(device="cpu") as captured:
        two_steps()

    def advance(many: int) -> FloatArray:
        for _ in range((many + 1) // 2):
            wp.capture_launch(captured.graph)
        x = states[0].body_q.numpy()[:count].astype(float)
        half = Rotation.from_quat(x[:, 3:]).apply([0.0, 0.0, rod.h / 2])
        ends = x[:, :3] + half
        return np.vstack([x[0, :3] - half[0], ends])

    def energy() -> float:
        return float((states[0].body_qd.numpy()[:, :3] ** 2).sum())

    halt = states[0].body_qd.zero_
    nodes = relax(advance, energy, halt, step, name, _REST_SPEED)
    x = states[0].body_q.numpy()[count - 2 : count].astype(float)
    along = Rotation.from_quat(x[:, 3:]).apply([0.0, 0.0, 1.0])
    gap = x[1, :3] - x[0, :3] - rod.h / 2 * along.sum(axis=0)
    stretch = gap @ along[0] * along[0]
    pull = (stiff * (gap - stretch) + min(rod.axial, stiff) * stretch) / rod.h
    weight = rod.link_masses[-1] * rod.gravity
    return Relaxed(nodes, (weight - pull) * rod.end.kind.place)
