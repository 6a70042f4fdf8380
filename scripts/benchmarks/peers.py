"""What a user would reach for: PyElastica and MuJoCo's cable, relaxed to rest on our cable.

Both simulate the dynamics of a rod in space, with contacts, actuators and more, and are not built
for the question asked here, the shape at rest of one cable in a plane. The comparison is therefore
not about whose method is better, but about what the shape costs with the tool at hand.

All start from the same regular polygon on the arc through both ends and stop by the same rule. The
damping of each was chosen by hand so that it comes to rest fast; building the model and
PyElastica's compilation are not timed. Errors are distances of nodes to the curve of a mesh of 320
quadratic elements. Bending stiffness and weight are equal; what else differs:

- PyElastica: Young's modulus is EI / I, so that its axial and shear stiffness are those of a solid
  round rod. The largest stretch is returned.
- MuJoCo: the start is the composite's own ball joint, which is exact, the end a connect
  constraint, which is soft: with MuJoCo's own settings ("mujoco, soft pin") and as stiff as it
  allows. How far the end is from its pin is returned. Its elasticity plugin is gone in MuJoCo 4.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from importlib.util import find_spec
from time import process_time
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline
from scipy.optimize import brentq

from benchmarks import speed
from dlo_casadi.codegen import CompiledSolver
from dlo_casadi.effects import CableData
from dlo_casadi.equilibrium.pose import HeldPose
from dlo_casadi.equilibrium.solve import solve_equilibrium
from dlo_casadi.model.cable_model import CableModel
from dlo_casadi.rod.chain import ELEMENTS

FloatArray = NDArray[np.floating]
CABLE = CableData(length=0.8125, mass=0.23, diameter=0.0128, bending_stiffness=0.3)
RADIUS = CABLE.diameter / 2
# Of a solid round section: both peers derive stiffness from a modulus and this.
AREA, SECOND_MOMENT = np.pi * RADIUS**2, np.pi * RADIUS**4 / 4
MODULUS = CABLE.bending_stiffness / SECOND_MOMENT
GRAVITY = -9.81
SIZES = (10, 20, 40)
# At rest: no node faster than this [m/s] on average over two intervals [s] one after the other.
REST_SPEED, INTERVAL = 1e-5, 0.02
COURANT = 0.5  # time step over the largest stable one of either on its own
PATIENCE = 20.0  # simulated time after which a relaxation has failed [s]
# Damping [1/s] of PyElastica, and of a joint in MuJoCo relative to its stiffness [s].
UNIFORM_DAMPING, JOINT_DAMPING = 10.0, 0.1


def run(poses: int = 4, sizes: tuple[int, ...] = SIZES) -> dict[str, Any]:
    """All methods on the paper's first poses; rows by method and number of elements."""
    ends = speed.poses()[:poses]
    curves = [reference(end) for end in ends]
    out: dict[str, Any] = {"poses": poses, "load_before": os.getloadavg()}
    rows: list[dict[str, Any]] = []
    for element in ELEMENTS:
        rows.append(_row(f"C solver, {element}", 10, ends, curves, compiled(10, element)))
        rows.append(_row(f"IPOPT, {element}", 10, ends, curves, ipopt(10, element)))
    for name, missing, make in (
        ("pyelastica", missing_elastica(), elastica),
        ("mujoco", missing_mujoco(), mujoco),
        ("mujoco, soft pin", missing_mujoco(), lambda n: mujoco(n, soft=True)),
    ):
        if missing:
            print(f"{name}: not measured, {missing}", flush=True)
            out.setdefault("not_measured", {})[name] = missing
            continue
        rows += [_row(name, n, ends, curves, make(n)) for n in sizes]
    return out | {"rows": rows, "load_after": os.getloadavg()}


# A method takes an end (2,) and returns nodes (n + 1, 2), seconds and what else is worth telling.
Method = Callable[[FloatArray], tuple[FloatArray, float, dict[str, float]]]


def _row(
    name: str, n: int, ends: FloatArray, curves: list[CubicSpline], method: Method
) -> dict[str, Any]:
    """Median time and steps, errors and the worst of everything else; printed as it is found."""
    results = [method(end) for end in ends]
    distances = [distance(curve, found[0]) for curve, found in zip(curves, results, strict=True)]
    row: dict[str, Any] = {
        "method": name,
        "n": n,
        "seconds": float(np.median([found[1] for found in results])),
        "rms_m": float(np.sqrt(np.mean(np.square(distances)))),
        "largest_m": float(np.max(distances)),
    }
    for key in results[0][2]:
        values = [found[2][key] for found in results]
        row[key] = float(np.median(values) if key in ("steps", "simulated_s") else np.max(values))
    print(
        f"{name:20s} n {n:3d} {1e3 * row['seconds']:11.3f} ms   RMS {1e3 * row['rms_m']:8.4f} mm  ",
        {key: float(f"{row[key]:.3g}") for key in results[0][2]},
        flush=True,
    )
    return row


def reference(end: FloatArray) -> CubicSpline:
    """Curve of the fine mesh by arc length."""
    model = CableModel(CABLE, n=320, element="quadratic")
    rest = np.zeros(model.chain.n_cells)
    found = solve_equilibrium(model, model.nominal, rest, _pose(end))
    return CubicSpline(np.linspace(0, CABLE.length, 321), found.points)


def distance(curve: CubicSpline, nodes: FloatArray) -> FloatArray:
    """Distance of every node to the curve [m]: Gauss-Newton from the node's own arc length."""
    s = np.linspace(0, CABLE.length, len(nodes))
    for _ in range(10):
        slope = curve(s, 1)
        s = s + np.sum((nodes - curve(s)) * slope, axis=1) / np.sum(slope**2, axis=1)
        s = np.clip(s, 0, CABLE.length)
    return np.hypot(*(nodes - curve(s)).T)


def _pose(end: FloatArray) -> HeldPose:
    return HeldPose((0.0, 0.0), (float(end[0]), float(end[1])), branch="ccw")


def compiled(n: int, element: str, repeats: int = 200) -> Method:
    """The generated C solver, called from Python."""
    model = CableModel(CABLE, n=n, element=element)  # type: ignore[arg-type]
    solver = CompiledSolver(model, model.nominal, np.zeros(model.chain.n_cells))

    def solve(end: FloatArray) -> tuple[FloatArray, float, dict[str, float]]:
        seconds, pose = [], _pose(end)
        for _ in range(repeats):
            begin = process_time()
            shape = solver.solve(pose)
            seconds.append(process_time() - begin)
        return shape.points, float(np.median(seconds)), {}

    return solve


def ipopt(n: int, element: str, repeats: int = 5) -> Method:
    """IPOPT from all its first guesses, the check of stability included."""
    model = CableModel(CABLE, n=n, element=element)  # type: ignore[arg-type]
    rest = np.zeros(model.chain.n_cells)
    solve_equilibrium(model, model.nominal, rest, _pose(np.array([0.5, 0.0])))  # builds the solver

    def solve(end: FloatArray) -> tuple[FloatArray, float, dict[str, float]]:
        seconds = []
        for _ in range(repeats):
            begin = process_time()
            found = solve_equilibrium(model, model.nominal, rest, _pose(end))
            seconds.append(process_time() - begin)
        return found.points, float(np.median(seconds)), {}

    return solve


def polygon(n: int, end: FloatArray) -> FloatArray:
    """Headings (n,) of n equal links that turn evenly, counterclockwise, from the origin to `end`.

    The chord of such a polygon is h sin(n d / 2) / sin(d / 2) for a turn d at each node.
    """
    h, chord = CABLE.length / n, np.hypot(*end)
    turn = brentq(
        lambda d: h * np.sin(n * d / 2) - chord * np.sin(d / 2), 1e-6, 2 * np.pi / n, xtol=1e-15
    )
    return np.arctan2(end[1], end[0]) + turn * (np.arange(n) - (n - 1) / 2)


def relax(advance: Callable[[int], FloatArray], step: float) -> tuple[FloatArray, float, int]:
    """Nodes at rest, seconds and steps; `advance(m)` makes m steps and returns the nodes."""
    many = max(1, round(INTERVAL / step))
    begin, steps, still = process_time(), 0, 0
    nodes = advance(0)
    while still < 2:
        before, nodes = nodes, advance(many)
        steps += many
        fastest = np.linalg.norm(nodes - before, axis=1).max() / (many * step)
        if not np.isfinite(fastest) or steps * step > PATIENCE:
            raise RuntimeError(f"not at rest after {steps} steps of {step:.3g} s")
        still = still + 1 if fastest < REST_SPEED else 0
    return nodes, process_time() - begin, steps


def missing_elastica() -> str:
    """What is missing for PyElastica, or nothing."""
    return "" if find_spec("elastica") else "PyElastica is not installed; try the extra `peers`"


def relax_rod(
    rod: Any,
    held: dict[str, tuple[int, ...]],
    damping: float,
    step: float,
    gravity: tuple[float, float, float],
) -> tuple[FloatArray, float, int]:
    """Nodes (n + 1, 3) of PyElastica's rod at rest, what is `held` fixed; seconds and steps."""
    import elastica as ea

    class Simulator(
        ea.BaseSystemCollection, ea.Constraints, ea.Forcing, ea.Damping
    ):  # its features are mixed in by inheritance
        pass

    simulator = Simulator()
    simulator.append(rod)
    simulator.constrain(rod).using(ea.FixedConstraint, **held)
    simulator.add_forcing_to(rod).using(ea.GravityForces, acc_gravity=np.array(gravity))
    simulator.dampen(rod).using(
        ea.AnalyticalLinearDamper, uniform_damping_constant=damping, time_step=step
    )
    simulator.finalize()
    stepper, time = ea.PositionVerlet(), 0.0

    def advance(many: int) -> FloatArray:
        nonlocal time
        for _ in range(many):
            time = stepper.step(simulator, time, step)
        return np.array(rod.position_collection.T)

    advance(1)  # compiles
    return relax(advance, step)


def elastica(n: int) -> Method:
    """PyElastica: position Verlet, uniform damping, both end nodes held, all directors free."""
    import elastica as ea

    density = CABLE.mass / (AREA * CABLE.length)
    # The shear mode of an element on its own small rotary inertia limits explicit steps.
    shear = MODULUS / 3
    step = COURANT * 2 / np.sqrt(shear * AREA / (density * SECOND_MOMENT))

    def solve(end: FloatArray) -> tuple[FloatArray, float, dict[str, float]]:
        phi = polygon(n, end)
        tangents = np.stack([np.cos(phi), np.sin(phi), np.zeros(n)])
        nodes = np.zeros((3, n + 1))
        nodes[:, 1:] = np.cumsum(CABLE.length / n * tangents, axis=1)
        normal = np.array([0.0, 0.0, 1.0])
        directors = np.zeros((3, 3, n))
        directors[0] = normal[:, None]
        directors[1] = np.cross(tangents.T, normal).T
        directors[2] = tangents
        rod = ea.CosseratRod.straight_rod(
            *(n, nodes[:, 0], tangents[:, 0], normal, CABLE.length, RADIUS, density),
            youngs_modulus=MODULUS,
            shear_modulus=shear,
            position=nodes,
            directors=directors,
        )
        held = {"constrained_position_idx": (0, -1)}
        found, seconds, steps = relax_rod(rod, held, UNIFORM_DAMPING, step, (0.0, GRAVITY, 0.0))
        stretch = float(np.abs(rod.dilatation - 1).max())
        told = {"steps": steps, "simulated_s": steps * step, "stretch": stretch}
        return found[:, :2], seconds, told

    return solve


def missing_mujoco() -> str:
    """What is missing for MuJoCo, or nothing."""
    if not find_spec("mujoco"):
        return "MuJoCo is not installed; try the extra `peers`"
    import mujoco as mj

    if int(mj.__version__.split(".")[0]) > 3:
        return f"MuJoCo {mj.__version__} has no mujoco.elasticity.cable; try mujoco<4"
    return ""


CABLE_XML = """
<mujoco>
  <extension><plugin plugin="mujoco.elasticity.cable"/></extension>
  <option timestep="{step}" gravity="0 {gravity} 0" integrator="implicitfast" tolerance="1e-12">
    <flag contact="disable"/>
  </option>
  <worldbody>
    <site name="pin" pos="{x} {y} 0"/>
    <composite type="cable" curve="s" count="{nodes} 1 1" size="{length}" initial="ball">
      <plugin plugin="mujoco.elasticity.cable">
        <config key="bend" value="{modulus}"/>
        <config key="twist" value="{modulus}"/>
      </plugin>
      <joint kind="main" damping="{damping}"/>
      <geom type="capsule" size="{radius}" mass="{mass}"/>
    </composite>
  </worldbody>
  <equality><connect site1="S_last" site2="pin" {softness}/></equality>
</mujoco>
"""


def mujoco(n: int, *, soft: bool = False) -> Method:
    """MuJoCo: links on ball joints, the plugin's moments EI / h, semi-implicit damping."""
    import mujoco as mj

    h = CABLE.length / n
    # The plugin's moments are explicit: the shortest wave of a thin beam limits the step.
    step = COURANT * h**2 / 2 * np.sqrt(CABLE.mass / (CABLE.length * CABLE.bending_stiffness))

    def solve(end: FloatArray) -> tuple[FloatArray, float, dict[str, float]]:
        stiff = f'solref="{2 * step} 1" solimp="0.9999 0.9999 0.001"'
        model = mj.MjModel.from_xml_string(
            CABLE_XML.format(
                step=step,
                gravity=GRAVITY,
                x=end[0],
                y=end[1],
                nodes=n + 1,
                length=CABLE.length,
                modulus=MODULUS,
                damping=JOINT_DAMPING / n * CABLE.bending_stiffness / h,
                radius=RADIUS,
                mass=CABLE.mass / n,
                softness="" if soft else stiff,
            )
        )
        data = mj.MjData(model)
        phi = polygon(n, end)
        turns = np.concatenate([phi[:1], np.diff(phi)])
        data.qpos[:] = np.stack(
            [np.cos(turns / 2), 0 * turns, 0 * turns, np.sin(turns / 2)], axis=1
        ).ravel()
        last = model.site("S_last").id

        def advance(many: int) -> FloatArray:
            if many:
                mj.mj_step(model, data, nstep=many)
            mj.mj_kinematics(model, data)
            return np.vstack([data.xpos[1:, :2], data.site_xpos[last, :2]])

        found, seconds, steps = relax(advance, step)
        gap = float(np.hypot(*(found[-1] - end)))
        return found, seconds, {"steps": steps, "simulated_s": steps * step, "end_off_m": gap}

    return solve
