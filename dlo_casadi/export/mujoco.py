"""Export to MuJoCo: a chain of bodies, each joined to the one before by three sprung hinges.

No plugin is used: `mujoco.elasticity.cable` has one stiffness for the whole cable, takes the
initial shape (or, with `flat`, a straight one) as the shape without load, and no longer exists in
MuJoCo 4. Hinges with springs work in MuJoCo 3 and 4 and in MJX.
"""

from collections.abc import Callable, Sequence

import numpy as np
from scipy.spatial.transform import Rotation

from dlo_casadi.arrays import FloatArray
from dlo_casadi.export.common import Relaxed, relax
from dlo_casadi.export.rod import Rod
from dlo_casadi.rod.node import Frame, Heading

# Time step [s]; ratio of a joint's damping to its stiffness [s] where it is not known.
STEP, DAMPING = 0.002, 0.03
# How a fixture that moves is driven: the rate [1/s] at which its joints settle, and their inertia
# over that of the cable, which then moves them by some 1e-8 of its length.
_RATE, _HEAVY = 50.0, 1e5
# Largest number of values of one `numeric` in MuJoCo 3.2.
_NUMERIC = 500
# Moduli [Pa] in bending and twist of MuJoCo 3's own cable example (model/plugin/elasticity).
DEFAULT = (4e6, 1e7)
# From an end that may roll to a second point of its axis [m], which is held, too.
_LEVER = np.array([0.02, 0.0, 0.0])
# Joint of a pin and its position in a frame, by the axes about which the cable turns.
_PINS: dict[tuple[str, ...], tuple[str, Callable[[Rotation], FloatArray]]] = {
    Heading.about: ('type="hinge" axis="0 0 1"', lambda frame: frame.as_rotvec()[2:]),
    Frame.about: ('type="ball"', lambda frame: np.roll(frame.as_quat(), 1)),
}


def write(rod: Rod, head: Sequence[str]) -> str:
    """The model as MJCF."""
    comment = "\n".join(f"  {line}".rstrip().replace("--", "–") for line in head)
    bodies = "\n".join(_bodies(rod))
    ends = ""
    if rod.end.kind.place:
        ends = f"\n    {_gripper(rod, 'end')}\n    {_closed(rod, 'end')}"
    return f"""<mujoco model="{_escaped(rod.name)}">
  <!--
{comment}
  -->
  <compiler angle="radian"/>
  <option timestep="{_step(rod):g}" gravity="{_row(rod.gravity)}" integrator="implicitfast"/>
  <default>
    <default class="cable">
      <geom type="capsule" size="{rod.radius:.9g}" fromto="0 0 0 {rod.h:.9g} 0 0" \
contype="0" conaffinity="1" rgba="0.1 0.4 0.6 1"/>
    </default>
  </default>
  <worldbody>
    {_gripper(rod, "start")}
{bodies}
    {"</body>" * len(rod.masses)}{_closed(rod, "start")}{ends}
  </worldbody>{_held(rod)}{_driven(rod)}
  <keyframe>
    <key name="pose" qpos="{_row(_angles(rod))}"/>
  </keyframe>
</mujoco>
"""


def _step(rod: Rod) -> float:
    """Time step [s]."""
    return STEP if rod.driven is None else rod.driven.step


def _damping_time(rod: Rod) -> float:
    """Ratio [s] of a joint's damping to its stiffness."""
    return DAMPING if rod.damping_time is None else rod.damping_time


def _row(values: FloatArray) -> str:
    return " ".join(f"{value:.9g}" for value in np.ravel(values))


def _escaped(text: str) -> str:
    return text.translate({ord(c): f"&#{ord(c)};" for c in '&<>"'})


def _turned(frame: Rotation) -> str:
    return _row(np.roll(frame.as_quat(), 1))  # MuJoCo puts w first


def _gripper(rod: Rod, side: str) -> str:
    """The body that holds an end; for the end, also the site at which it holds the cable."""
    fixture = rod.start if side == "start" else rod.end
    place, frame = fixture.offset
    site = f'<site name="{side}" pos="{_row(place)}" quat="{_turned(frame)}"/>'
    if fixture.rolls:
        site += f'<site name="{side}_axis" pos="{_row(place + frame.apply(_LEVER))}"/>'
    site = site if side == "end" else ""
    at, turn = f'pos="{_row(fixture.place)}"', f'quat="{_turned(fixture.frame)}"'
    if rod.driven is None or side not in rod.driven.carriages:
        return f'<body name="{side}" mocap="true" {at} {turn}>{site}'
    carriage, (mass, inertia) = rod.driven.carriages[side], _heavy(rod)
    unit = {axis: _row(row) for axis, row in zip("xyz", np.eye(3), strict=True)}
    slides = "".join(
        f'<joint name="{side}_{x}" type="slide" axis="{row}" armature="{mass:.9g}"/>'
        for x, row in unit.items()
    )
    hinges = "".join(
        f'<joint name="{side}_turn_{x}" axis="{unit[x]}" armature="{inertia:.9g}"/>'
        for x in carriage.axes * carriage.turns
    )
    turning = _row(inertia / _HEAVY * np.ones(3))
    own = f'<inertial pos="0 0 0" mass="{mass / _HEAVY:.9g}" diaginertia="{turning}"/>'
    return (
        f'<body name="{side}_carriage" {at} gravcomp="1">{own}{slides}'
        f'<body name="{side}" {turn} gravcomp="1">{own}{hinges}{site}'
    )


def _closed(rod: Rod, side: str) -> str:
    """The end of the body, or of the two bodies, of a gripper."""
    return "</body>" * (1 + (rod.driven is not None and side in rod.driven.carriages))


def _heavy(rod: Rod) -> tuple[float, float]:
    """Mass [kg] and inertia [kg m^2] of what drives a fixture."""
    mass, length = _HEAVY * float(rod.link_masses.sum()), rod.h * len(rod.masses)
    return mass, mass * length**2 / 3


def _driven(rod: Rod) -> str:
    """Servos of the joints that drive fixtures, and what is asked of them in each step."""
    if rod.driven is None:
        return ""
    servos = "".join(
        f"""
    <position name="{name}" joint="{name}" kp="{size * _RATE**2:.9g}" \
kv="{2 * size * _RATE:.9g}"/>"""
        for name in rod.driven.names
        for size in (_heavy(rod)["_turn_" in name],)
    )
    values = rod.driven.controls(_RATE).ravel()
    rows = "".join(
        f"""
    <numeric name="motion_{k:04d}" data="{_row(values[at : at + _NUMERIC])}"/>"""
        for k, at in enumerate(range(0, len(values), _NUMERIC))
    )
    return f"""
  <actuator>{servos}
  </actuator>
  <custom>{rows}
  </custom>"""


def _bodies(rod: Rod) -> list[str]:
    stiffness, axes = principal(rod)
    stiffness[1::2] = stiffness[1::2, ::-1]
    rest = _in_axes(rod.rest_turns, axes)
    place, frame = rod.start.offset
    middle = len(rod.masses) - 1
    lines = []
    for k, mass in enumerate(rod.masses):
        if k == 0 and rod.start.kind.direction:
            inside = place - frame.apply([rod.h / 2, 0.0, 0.0])
            lines.append(f'<body name="cable_0" pos="{_row(inside)}" quat="{_turned(frame)}">')
            if rod.start.rolls:
                damping = _damping_time(rod) * float(rod.torsion[0]) / rod.h
                lines[-1] += f'<joint name="start_roll" axis="1 0 0" damping="{damping:.9g}"/>'
        elif k == 0:
            lines.append(f'<body name="cable_0" pos="{_row(place)}">{_pin(rod)}')
        else:
            joints = _hinges(rod, k, stiffness[k - 1] / rod.h, axes[k - 1], rest[k - 1])
            lines.append(f'<body name="cable_{k}" pos="{rod.h:.9g} 0 0">{joints}')
        lines[-1] += f'<geom class="cable" mass="{mass:.9g}"/>'
        if k == middle and rod.end.kind.place:
            at = rod.h / 2 if rod.end.kind.direction else rod.h
            lines[-1] += f'<site name="cable_end" pos="{at:.9g} 0 0"/>'
            if rod.end.rolls:
                axis = np.array([at, 0.0, 0.0]) + _LEVER
                lines[-1] += f'<site name="cable_end_axis" pos="{_row(axis)}"/>'
        for carried, s in rod.lumps:
            if k == np.clip(np.searchsorted(rod.s, s) - 1, 0, middle):
                at = (s - rod.s[k]) / (rod.s[1] - rod.s[0]) * rod.h
                lines[-1] += (
                    f'<geom type="sphere" pos="{at:.9g} 0 0" size="{2 * rod.radius:.9g}" '
                    f'mass="{carried:.9g}" contype="0" conaffinity="1"/>'
                )
    return [f"    {line}" for line in lines]


def principal(rod: Rod) -> tuple[FloatArray, Rotation]:
    """Principal stiffnesses (n - 1, 3) [N m^2] of each joint, and the axes.

    First GJ about x, then the two of bending. The axes (n - 1,) are given in the material frame;
    for an isotropic section they equal that frame.
    """
    values, vectors = np.linalg.eigh(rod.bending)
    round_ = np.ptp(values, axis=1) < 1e-9 * values[:, 1]
    angle = np.where(round_, 0.0, np.arctan2(vectors[:, 1, 0], vectors[:, 0, 0]))
    axes = Rotation.from_rotvec(angle[:, None] * [1.0, 0.0, 0.0])
    return np.column_stack([rod.torsion, values]), axes


def _pin(rod: Rod) -> str:
    """A pin at the start, damped like a joint so that nothing spins forever."""
    damping = _damping_time(rod) * float(np.linalg.eigvalsh(rod.bending[0])[0]) / rod.h
    return f'<joint name="start_pin" {_PINS[rod.node.about][0]} damping="{damping:.9g}"/>'


def _hinges(rod: Rod, k: int, stiffness: FloatArray, axes: Rotation, rest: FloatArray) -> str:
    """Hinges about the principal axes; for a cable in a plane only the one normal to it.

    Their armature keeps the chain, whose fastest mode has four times the stiffness of a joint, from
    oscillating by more than a radian per step: MuJoCo integrates springs explicitly, and a link of
    a few millimetres has almost no inertia about its axis.
    """
    about = dict(zip("xyz", axes.as_matrix().T, strict=True))
    text = ""
    for name, value, angle in zip(_order(k), stiffness, rest, strict=True):
        if name in rod.node.about:
            text += (
                f'<joint name="{name}_{k}" axis="{_row(about[name])}" stiffness="{value:.9g}" '
                f'springref="{angle:.9g}" damping="{_damping_time(rod) * value:.9g}" '
                f'armature="{(2 * _step(rod)) ** 2 * value:.9g}"/>'
            )
    return text


def _order(k: int) -> str:
    """Order of the hinges of joint k, where 1 is the first.

    Successive rotations b, c, ... also cause one of b c / 2 about the third axis. The opposite
    order in the next joint cancels it, which leaves an error of second order in h.
    """
    return "xyz" if k % 2 else "zyx"


def _in_axes(turns: Rotation, axes: Rotation) -> FloatArray:
    """Angles (n - 1, 3) [rad] of each joint's hinges, in their order, for these rotations."""
    local = axes.inv() * turns * axes
    odd = np.arange(len(local)) % 2 == 0
    return np.where(odd[:, None], local.as_euler("XYZ"), local.as_euler("ZYX"))


def _held(rod: Rod) -> str:
    if not rod.end.kind.place:
        return ""
    kind = "weld" if rod.end.kind.direction and not rod.end.rolls else "connect"
    held = "".join(
        f"""
    <{kind} name="{name}" site1="cable_{name}" site2="{name}" solref="{2 * _step(rod):g} 1" \
solimp="0.9999 0.9999 0.001"/>"""
        for name in ("end", "end_axis")[: 1 + rod.end.rolls]
    )
    return f"""
  <equality>{held}
  </equality>"""


def _angles(rod: Rod) -> FloatArray:
    """Positions of all joints in the pose."""
    about = rod.node.about
    start = (
        _PINS[about][1](rod.frames[0]) if rod.start.kind.turns else np.zeros(int(rod.start.rolls))
    )
    angles = _in_axes(rod.turns, principal(rod)[1])
    free = np.array([[name in about for name in _order(k + 1)] for k in range(len(angles))])
    carried = [
        np.zeros(
            0 if rod.driven is None else sum(x.startswith(f"{side}_") for x in rod.driven.names)
        )
        for side in ("start", "end")
    ]
    return np.concatenate([carried[0], start, angles[free], carried[1]])


class _Chain:
    """A written model in MuJoCo, at its keyframe."""

    def __init__(self, text: str, rod: Rod) -> None:
        import mujoco as mj

        self.mj, self.h = mj, rod.h
        self.model = mj.MjModel.from_xml_string(text)
        self.model.opt.disableflags |= mj.mjtDisableBit.mjDSBL_AUTORESET
        self.data = mj.MjData(self.model)
        mj.mj_resetDataKeyframe(self.model, self.data, 0)
        self.links = [self.model.body(f"cable_{k}").id for k in range(len(rod.masses))]

    @property
    def nodes(self) -> FloatArray:
        """Places (n + 1, 3) [m] of the ends of the links."""
        places, last = self.data.xpos[self.links], self.links[-1]
        ahead = self.data.xmat[last].reshape(3, 3)[:, 0]
        return np.vstack([places, self.data.xpos[last] + self.h * ahead])

    def advance(self, many: int) -> FloatArray:
        """The nodes after steps."""
        if many:
            self.mj.mj_step(self.model, self.data, nstep=many)
        self.mj.mj_forward(self.model, self.data)
        return self.nodes

    def energy(self) -> float:
        """Kinetic energy [J], without that of the servos, whose noise would hide it."""
        self.mj.mj_energyVel(self.model, self.data)
        squares = self.model.dof_armature * self.data.qvel**2
        driven = self.model.actuator_trnid[:, 0]
        return float(self.data.energy[1] - squares[self.model.jnt_dofadr[driven]].sum() / 2)

    def halt(self) -> None:
        """Stop all that moves."""
        self.data.qvel[:] = 0.0

    def at_rest(self) -> FloatArray:
        """The nodes at rest."""
        return relax(self.advance, self.energy, self.halt, self.model.opt.timestep, "MuJoCo")


def settle(text: str, rod: Rod) -> Relaxed:
    """Relax a written model in MuJoCo."""
    chain = _Chain(text, rod)
    nodes = chain.at_rest()
    kinds, forces = chain.data.efc_type, chain.data.efc_force
    on_cable = forces[kinds == chain.mj.mjtConstraint.mjCNSTR_EQUALITY]
    places = on_cable[: 3 * (1 + rod.end.rolls)].reshape((-1, 3))
    return Relaxed(nodes, -places.sum(axis=0))


def follow(text: str, rod: Rod) -> FloatArray:
    """Nodes (T, n + 1, 3) [m] of a written model, from rest along the motion of its fixtures."""
    chain = _Chain(text, rod)
    found = [chain.at_rest()]
    for row in chain.model.numeric_data.reshape((-1, chain.model.nu))[:-1]:
        chain.data.ctrl[:] = row
        found.append(chain.advance(1))
    return np.array(found)
