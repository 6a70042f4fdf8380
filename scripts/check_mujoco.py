"""Cables on a table beside MuJoCo: python scripts/check_mujoco.py [--links 40].

Three cables that are held over a table and lie on it, relaxed with MuJoCo's elasticity plugin of a
cable, without friction (condim 1), beside our statics with contact. The greatest distance of
MuJoCo's nodes from our curve is at most 1 % of the length, or the exit code is 1. MuJoCo starts
from our shape on a table that is higher, and falls. It is no dependency: `pip install "mujoco<4"`
(version 4 has no such plugin any more).
"""

from __future__ import annotations

import sys
import time
from dataclasses import dataclass, replace
from functools import partial

import mujoco as mj
import numpy as np
from harness import options, run
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation, Slerp

from dlo_casadi.effects import CableData
from dlo_casadi.equilibrium.curve import NodeCurve
from dlo_casadi.equilibrium.equilibrium import Equilibrium
from dlo_casadi.equilibrium.pose import HeldPose
from dlo_casadi.equilibrium.solve import solve_equilibrium
from dlo_casadi.model.assembly import Assembly, Inputs
from dlo_casadi.model.cable_model import CableModel
from dlo_casadi.rod.obstacles import Plane

FloatArray = NDArray[np.floating]

ALLOWED = 0.01
# Of our mesh.
ELEMENTS = 60
CABLE = CableData(0.8, 0.06, 0.006, 0.004, torsional_stiffness=0.003)
# From what height above the table MuJoCo's cables fall [m].
FALL = 0.03
# Of a wave that travels along the links; the plugin's moments are explicit.
COURANT = 0.3
# A cable is at rest that moves by less than STILL lengths in an INTERVAL [s], twice: contacts never
# stop to shake it by some micrometres. Longest wait [s].
INTERVAL, STILL, PATIENCE = 0.25, 1e-4, 40.0
# Damping of a joint over its stiffness [s]: it does not change where the cable rests.
DAMPING = 0.02


@dataclass(frozen=True)
class Case:
    """A cable and how it is held: clamped at the start; its end free, or on a ball joint."""

    name: str
    start: tuple[float, float, float]
    turned: tuple[float, float, float]
    end: tuple[float, float, float] | None
    stiffness: float = CABLE.bending_stiffness

    @property
    def cable(self) -> CableData:
        """The cable."""
        return replace(CABLE, bending_stiffness=self.stiffness)

    @property
    def orientation(self) -> tuple[float, ...]:
        """Frame of the clamp."""
        return tuple(Rotation.from_rotvec(self.turned).as_quat().tolist())


CASES = (
    Case("laid down from a clamp, its end free", (0.0, 0.0, 0.08), (0.0, 0.0, 0.0), None),
    Case("a belly on the table", (0.0, 0.0, 0.15), (0.0, 0.6, 0.0), (0.66, 0.05, 0.12)),
    Case("bent aside", (0.0, 0.0, 0.12), (0.0, 0.5, 0.6), (0.45, -0.15, 0.05), 0.012),
)

XML = """
<mujoco>
  <extension><plugin plugin="mujoco.elasticity.cable"/></extension>
  <option timestep="{step}" gravity="0 0 -9.81" integrator="implicitfast" tolerance="1e-12"/>
  <worldbody>
    <geom name="table" type="plane" size="5 5 0.1" condim="1" solref="{hard} 1"
      solimp="0.99 0.9999 0.0001"/>
    <site name="pin" pos="{end}"/>
    <body name="clamp" pos="{start}" quat="{frame}">
      <composite type="cable" curve="s" count="{nodes} 1 1" size="{length}" initial="none">
        <plugin plugin="mujoco.elasticity.cable">
          <config key="bend" value="{bend}"/>
          <config key="twist" value="{twist}"/>
        </plugin>
        <joint kind="main" damping="{damping}"/>
        <geom type="capsule" size="{radius}" mass="{mass}" condim="1" solref="{hard} 1"
          solimp="0.99 0.9999 0.0001"/>
      </composite>
    </body>
  </worldbody>
  {held}
</mujoco>
"""


def ours(case: Case, height: float) -> tuple[CableModel, Equilibrium, NodeCurve]:
    """Our statics, the table at a height [m]."""
    end = "free" if case.end is None else "pinned"
    model = CableModel(
        case.cable,
        ELEMENTS,
        start="clamped",
        end=end,
        gravity=(0.0, 0.0, -9.81),
        n_rest=0,
        obstacles=(Plane((0.0, 0.0, height), (0.0, 0.0, 1.0), "table"),),
    )
    pose = HeldPose(case.start, case.end, start_orientation=case.orientation)
    rest = np.zeros(model.chain.n_rests)
    found = solve_equilibrium(model, model.nominal, rest, pose)
    given = Inputs.of(model.nominal, rest, pose.vector[None])
    curve = NodeCurve.of(CABLE.length, Assembly(model, found.shapes, given).curve()[0])
    return model, found, curve


def relaxed(case: Case, links: int) -> tuple[FloatArray, float]:
    """MuJoCo's nodes (links + 1, 3) [m] at rest, and the simulated time [s]."""
    cable, h = case.cable, CABLE.length / links
    radius, density = cable.diameter / 2, cable.mass / cable.length
    step = COURANT * h**2 / 2 * np.sqrt(density / cable.bending_stiffness)
    stiff = f'solref="{2 * step} 1" solimp="0.9999 0.9999 0.001"'
    pinned = f'<equality><connect site1="S_last" site2="pin" {stiff}/></equality>'
    model = mj.MjModel.from_xml_string(
        XML.format(
            step=step,
            hard=4 * step,
            start=_row(case.start),
            frame=_row(np.roll(case.orientation, 1)),
            end=_row(case.end or (0.0, 0.0, 0.0)),
            nodes=links + 1,
            length=cable.length,
            bend=cable.bending_stiffness / (np.pi * radius**4 / 4),
            twist=cable.torsional_stiffness / (np.pi * radius**4 / 2),
            damping=DAMPING * cable.bending_stiffness / h,
            radius=radius,
            mass=cable.mass / links,
            held="" if case.end is None else pinned,
        )
    )
    data, last = mj.MjData(model), model.site("S_last").id
    above, found, _ = ours(case, FALL)
    middles = (np.arange(links) + 0.5) * h
    frames = Slerp(above.chain.places, Rotation.from_quat(found.x))(middles)
    frames = Rotation.concatenate([Rotation.from_quat(case.orientation), frames[1:]])
    data.qpos[:] = np.roll((frames[:-1].inv() * frames[1:]).as_quat(), 1, axis=1).ravel()
    bodies = [k for k in range(model.nbody) if model.body(k).name.startswith("B_")]

    def advance(many: int) -> FloatArray:
        if many:
            mj.mj_step(model, data, nstep=many)
        mj.mj_kinematics(model, data)
        return np.vstack([data.xpos[bodies], data.site_xpos[last]])

    many, nodes, still, simulated = round(INTERVAL / step), advance(0), 0, 0.0
    while still < 2 and simulated < PATIENCE:
        before, nodes = nodes, advance(many)
        moved = float(np.linalg.norm(nodes - before, axis=1).max())
        still = still + 1 if moved < STILL * cable.length else 0
        simulated += many * step
    if still < 2:
        raise SystemExit(f"{case.name}: MuJoCo still moves by {1e3 * moved:.2g} mm in {INTERVAL} s")
    return nodes, simulated


def _row(values: object) -> str:
    return " ".join(f"{x:.9g}" for x in np.ravel(values))


def main() -> int:
    """Compare all three, print a line for each."""
    parser = options(__doc__, jobs=True)
    parser.add_argument("--links", type=int, default=40, help="of MuJoCo's cable")
    chosen = parser.parse_args()
    work = partial(compared, links=chosen.links)
    rows = run(work, CASES, chosen, lambda case, row, seconds: row[0])
    return int(any(share > ALLOWED for _, share in rows))


def compared(case: Case, links: int) -> tuple[str, float]:
    """A line of the table, and how far MuJoCo's shape is from ours, as a share of the length."""
    began = time.process_time()
    _, found, curve = ours(case, 0.0)
    nodes, simulated = relaxed(case, links)
    here = curve.at(np.linspace(0.0, CABLE.length, len(nodes)))
    apart = np.linalg.norm(nodes - here, axis=1)
    share = float(apart.max()) / CABLE.length
    touched = ", ".join(f"{one.start:.3f} to {one.end:.3f} m" for one in found.contacts)
    text = (
        f"{case.name}: {1e3 * apart.max():.2f} mm apart, {share:.2%} of the length; touches "
        f"from {touched}; MuJoCo's lowest node {1e3 * nodes[:, 2].min():.2f} mm, ours "
        f"{1e3 * found.points[:, 2].min():.2f} mm; {simulated:.1f} s simulated, "
        f"{time.process_time() - began:.0f} s"
    )
    return text, share


if __name__ == "__main__":
    sys.exit(main())
